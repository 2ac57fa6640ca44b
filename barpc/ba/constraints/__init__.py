"""Constraints of a block: observations, points, heights, earlier runs; its start, and the accuracy of its position."""
