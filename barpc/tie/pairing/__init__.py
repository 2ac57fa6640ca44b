"""Pairs of views, their common ground and epipolar geometry."""
