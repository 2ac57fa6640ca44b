"""Which views are compared, and where one sees what another shows."""
