"""Tracks to corrections: the bundle adjustment."""
