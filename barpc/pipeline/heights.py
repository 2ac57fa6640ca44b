"""Files of altimetry against the images: what cannot be meant is said before any work starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from barpc.errors import InputError
from barpc.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.pointio.altimetry import read_altimetry
from barpc.scene import Altimetry, BoolArray, View
from barpc.sensor.geometry import footprint

_REACH = 1000.0  # m: ten times what delivered cameras are wrong by where they are bad


def load_altimetry(paths: Sequence[str], views: Sequence[View]) -> Altimetry | None:
    """The heights of several files in the images, one after the other; None without files.

    InputError for a file that cannot be read or has no height in the images.
    """
    parts = [_load(path, views) for path in paths]
    if not parts:
        return None
    columns = ("lonlatalt", "sigma", "sigma_flat")
    return Altimetry(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in columns})


def _load(path: str, views: Sequence[View]) -> Altimetry:
    given = read_altimetry(path)
    inside = _inside(given.lonlatalt, views)
    if not inside.any():
        swapped = given.lonlatalt[:, [1, 0, 2]]
        at = f"{len(inside)} heights about {', '.join(f'{x:.4f}' for x in np.median(given.lonlatalt[:, :2], axis=0))}"
        what = "are longitude and latitude exchanged?" if _inside(swapped, views).any() else "another place?"
        raise InputError(f"{path}: none of its {at} (lon, lat) lies in the images: {what}")
    return Altimetry(given.lonlatalt[inside], given.sigma[inside], given.sigma_flat[inside])


def _inside(lonlatalt: Array, views: Sequence[View]) -> BoolArray:
    """Which places (n, 3) are within the bounds of any image on the ground, or near them."""
    found = np.zeros(len(lonlatalt), dtype=bool)
    for view in views:
        ring = footprint(view.sensor, view.size, view.altitude)
        ring = ring[np.isfinite(ring).all(axis=1)]
        if not len(ring):
            continue
        middle = ring.mean(axis=0)
        margin = _REACH / metres_per_unit([*middle, 0.0])[:2]
        ring[:, 0] = wrap_longitude(ring[:, 0], middle[0])
        place = np.column_stack([wrap_longitude(lonlatalt[:, 0], middle[0]), lonlatalt[:, 1]])
        low, high = ring.min(axis=0) - margin, ring.max(axis=0) + margin
        found |= ((place >= low) & (place <= high)).all(axis=1)
    return found
