"""Parts of a simulated block, as it grows image by image."""

from __future__ import annotations

from typing import Any

import numpy as np

from barpc.base.geodesy import Array
from barpc.scene import Tracks, View
from barpc.simulate import SimulatedBlock


def part(made: SimulatedBlock, chosen: Any, new: Any = None) -> tuple[list[View], Tracks]:
    """Some views, ascending, and their tie points; those that `new` ones observe only."""
    chosen = np.asarray(chosen)
    tracks = made.tracks.select(np.isin(made.tracks.view, chosen))
    if new is not None:
        seen = np.bincount(tracks.point, np.isin(tracks.view, new), minlength=tracks.num_points) > 0
        tracks = tracks.select(seen[tracks.point])
    view = np.searchsorted(chosen, tracks.view)
    return [made.views[i] for i in chosen], Tracks(view, tracks.point, tracks.xy, tracks.sigma)


def corners(view: View) -> Array:
    """The ground (8, 3) in the corners of a view at either end of its altitudes."""
    right, low = view.size[0] - 1.0, view.size[1] - 1.0
    at = np.array([[0.0, 0.0], [right, 0.0], [right, low], [0.0, low]])
    return np.concatenate([view.sensor.localize(at, np.full(4, alt)) for alt in view.alt_range])
