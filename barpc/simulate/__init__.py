"""Known truth: cameras, tie points and images whose exact geometry is on record."""
