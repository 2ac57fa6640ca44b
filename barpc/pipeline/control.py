"""Files of ground points and altimetry against the cameras: what cannot be meant is said before any work starts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from barpc.errors import InputError
from barpc.geodesy import Array, ecef_from_ground, metres_per_unit, wrap_longitude
from barpc.options import RunOptions
from barpc.pointio.correspondences import read_altimetry, read_gcps
from barpc.report.summary.words import listed
from barpc.scene import Altimetry, BoolArray, GroundPoints, View
from barpc.sensor.geometry import footprint, ground_sample_distance
from barpc.tie.pairing.overlaps import reach_of

_REACH = 1000.0  # m: ten times what delivered cameras are wrong by where they are bad
_ALT_REACH = 500.0  # m beyond a camera's altitudes: a geoid is 100 m, and ranges miss relief by some hundred

_MISTAKES = {
    "longitude and latitude are exchanged: GeoJSON and image tags give longitude first, .gcp files latitude, and a CSV "
    "names its columns": ((1, 0), (1, 1)),
    "the sign of a longitude or latitude is wrong: west and south are negative": (
        (0, 1),
        (-1, 1),
        (1, -1),
        (-1, -1),
    ),
}
"""What people do to coordinates -> the columns that longitude and latitude are taken from, and their signs."""


def load_gcps(paths: Sequence[str], views: Sequence[View], options: RunOptions) -> GroundPoints | None:
    """Return the ground points of several files, one after the other; None without files.

    Points that cannot be where they are said to be, images that are no views, and files that cannot be read are an
    InputError, or with `keep_going` left out and named in `left_out`.
    """
    parts = [_load(path, views, options) for path in paths]
    if not parts:
        return None
    starts = np.cumsum([0, *(len(part.names) for part in parts)])[:-1]
    point = np.concatenate([part.point + start for part, start in zip(parts, starts, strict=True)])
    columns = ("lonlatalt", "sigma", "view", "xy", "xy_sigma")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in columns}
    names = tuple(name for part in parts for name in part.names)
    strangers = tuple(dict.fromkeys(name for part in parts for name in part.strangers))
    left_out = tuple(line for part in parts for line in part.left_out)
    return GroundPoints(names, point=point, **joined, strangers=strangers, left_out=left_out)


def _load(path: str, views: Sequence[View], options: RunOptions) -> GroundPoints:
    try:
        points = read_gcps(path, [view.name for view in views])
    except InputError as error:
        if not options.keep_going:
            raise
        return replace(GroundPoints.none(), left_out=(f"{error}; the file is left out",))
    out, keep = [], np.ones(len(points.names), dtype=bool)
    search = np.array([reach_of(view, options.tie) for view in views])[points.view]
    for wrong, what in _implausible(points, views, search):
        names = [points.names[g] for g in np.flatnonzero(wrong & keep)]
        if names:
            many = f"{len(names)} of {len(keep)} points ({listed(names)})"
            out.append(f"{many if len(names) > 1 else f'point {names[0]}'}: {what}")
        keep &= ~wrong
    if points.strangers:
        out.append(f"it names images that are not in this run: {listed(points.strangers)}")
    if out and not options.keep_going:
        raise InputError(f"{path}: {out[0]}; correct it, or leave it out with --keep-going")
    return replace(points.select(keep), left_out=tuple(f"{path}: {line}; left out" for line in out))


def _implausible(points: GroundPoints, views: Sequence[View], search: Array) -> Iterator[tuple[BoolArray, str]]:
    """Yield the points (G,) that cannot be meant, and why; the first reason counts. `search` (M,): `reach_of` [px]."""
    low, high = np.array([view.alt_range for view in views])[points.view].T
    alt = points.lonlatalt[points.point, 2]
    shown, pixel = _shown(points, views, np.clip(alt, low, high))
    reach = np.maximum(_REACH, search * pixel)
    away = _distance(points, shown, (0, 1), (1, 1))
    yield _any(points, ~np.isfinite(away)), "no ground is seen at the position in the image"
    far = _any(points, away > reach) | (np.abs(points.lonlatalt[:, 1]) > 90.0)
    for what, (columns, *signs) in _MISTAKES.items():
        near = [_distance(points, shown, columns, sign) <= reach for sign in signs]
        mistaken = far & _any(points, np.asarray(np.any(near, axis=0)))
        yield mistaken, what
        far &= ~mistaken
    most = np.max(away[far[points.point]], initial=0.0) / 1e3
    yield far, f"as far as {most:,.0f} km from where the images show it, by their cameras"
    wild = (alt < low - _ALT_REACH) | (alt > high + _ALT_REACH)
    ends = f"{np.min(low, initial=np.inf):.0f} to {np.max(high, initial=-np.inf):.0f} m"
    yield (
        _any(points, wild),
        f"altitudes far outside {ends}, where the cameras are used: metres above the ellipsoid are needed",
    )


def _any(points: GroundPoints, observed: BoolArray) -> BoolArray:
    """Return the points (G,) for which a condition holds in any of their observations (M,)."""
    return np.bincount(points.point, observed, minlength=len(points.names)) > 0


def _shown(points: GroundPoints, views: Sequence[View], alt: Array) -> tuple[Array, Array]:
    """Return where each image shows a point (M, 3) at altitudes (M,) [m], and the pixel size there (M,) [m]."""
    ground, pixel = np.empty((len(alt), 3)), np.empty(len(alt))
    for v in np.unique(points.view):
        rows = points.view == v
        ground[rows] = views[v].sensor.localize(points.xy[rows], alt[rows])
        pixel[rows] = ground_sample_distance(views[v].sensor, ground[rows])[1]
    return ground, np.nan_to_num(pixel)


def _distance(points: GroundPoints, shown: Array, columns: tuple[int, int], signs: tuple[int, int]) -> Array:
    """Return the metres (M,) from where images show points to where these are said to be, taken from `columns`."""
    level = points.lonlatalt[points.point][:, columns] * signs
    given = np.column_stack([level, shown[:, 2]])
    return np.asarray(np.linalg.norm(ecef_from_ground(given) - ecef_from_ground(shown), axis=1))


def load_altimetry(paths: Sequence[str], views: Sequence[View]) -> Altimetry | None:
    """Return the heights of several files in the images, one after the other; None without files.

    InputError for a file that cannot be read or has no height in the images.
    """
    parts = [_heights_of(path, views) for path in paths]
    if not parts:
        return None
    columns = ("lonlatalt", "sigma", "sigma_flat")
    return Altimetry(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in columns})


def _heights_of(path: str, views: Sequence[View]) -> Altimetry:
    given = read_altimetry(path)
    inside = _inside(given.lonlatalt, views)
    if not inside.any():
        swapped = given.lonlatalt[:, [1, 0, 2]]
        at = f"{len(inside)} heights about {', '.join(f'{x:.4f}' for x in np.median(given.lonlatalt[:, :2], axis=0))}"
        what = "are longitude and latitude exchanged?" if _inside(swapped, views).any() else "another place?"
        raise InputError(f"{path}: none of its {at} (lon, lat) lies in the images: {what}")
    return Altimetry(given.lonlatalt[inside], given.sigma[inside], given.sigma_flat[inside])


def _inside(lonlatalt: Array, views: Sequence[View]) -> BoolArray:
    """Return the places (n, 3) within the ground bounds of any image, or near them."""
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
