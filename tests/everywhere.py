"""Observations of points that all views see."""

from __future__ import annotations

import numpy as np

from barpc.base.geodesy import Array
from barpc.scene import IntArray, Tracks


def rows_of(xy: Array) -> tuple[IntArray, IntArray, Array]:
    """View, point and place (P V, 2) [px] of points that all views see at (P, V, 2), point by point."""
    points, views = xy.shape[:2]
    return np.tile(np.arange(views), points), np.repeat(np.arange(points), views), xy.reshape(-1, 2)


def tied(xy: Array, sigma: float) -> Tracks:
    """Their tracks, of a standard deviation [px]."""
    return Tracks(*rows_of(xy), np.full(xy.shape[0] * xy.shape[1], sigma))
