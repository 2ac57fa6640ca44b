"""Foundations: errors, files opened and written safely, frozen values, options, the ellipsoid."""
