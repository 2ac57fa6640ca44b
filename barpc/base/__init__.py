"""What everything stands on: errors, files opened and written safely, frozen values, options, the ellipsoid."""
