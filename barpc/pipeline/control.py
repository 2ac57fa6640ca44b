"""Ground points and altimetry of a run: files are read, and their points checked against the cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from barpc.ba.constraints.ground import DEM_BIAS, KNOWN_BIAS
from barpc.base.errors import InputError, listed
from barpc.base.frozen import join_fields
from barpc.base.geodesy import Array, ecef_from_ground, ground_from_ecef, metres_per_unit, wrap_longitude
from barpc.base.options import RunOptions
from barpc.base.statistics import robust_spread
from barpc.pipeline.exchanged import FEWER
from barpc.pointio.correspondences import read_altimetry
from barpc.pointio.gcps import ControlReference, read_gcps
from barpc.rasters.dem import Dem
from barpc.rasters.vertical import metres_of
from barpc.scene import Altimetry, BoolArray, GroundPoints, View
from barpc.sensor.geometry import footprint, ground_sample_distance
from barpc.sensor.triangulation import triangulate
from barpc.tie.pairing.overlaps import reach_of

IMAGE_MARGIN = 1.5  # px beyond the centres of the outermost pixels that points of a matcher may lie
_MAX_CAMERA_ERROR = 1000.0  # m: ten times the error of poor cameras as delivered
_ALT_REACH = 500.0  # m beyond a camera's altitude range: 100 of geoid height, and some hundred of relief that it misses
_LEAST_FOR_UNIT, _LEAST_MISFIT = 3, 3.0
"""Least number of points in several images, and least scatter of altitudes [m], to suspect another unit."""
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
"""Mistake in coordinates -> columns that hold longitude and latitude, then the pairs of signs to try."""


def load_gcps(
    paths: Sequence[str], views: Sequence[View], options: RunOptions, dem: Dem | None = None
) -> GroundPoints | None:
    """Return the ground points of several files, one after the other; None without files.

    InputError for implausible points, names of images that are not in the run, and files that cannot be read. With
    `keep_going` these are left out instead and listed in `left_out`. Missing altitudes are taken from `dem`.
    """
    frame = ControlReference(options.gcp_crs, options.geoid, options.heights, tuple(paths))
    parts = [_load_control(path, views, options, dem, frame) for path in paths]
    if not parts:
        return None
    starts = np.cumsum([0, *(len(part.names) for part in parts)])[:-1]
    point = np.concatenate([part.point + start for part, start in zip(parts, starts, strict=True)])
    columns = join_fields(parts)
    return GroundPoints(**columns | {"point": point, "strangers": tuple(dict.fromkeys(columns["strangers"]))})


def _load_control(
    path: str, views: Sequence[View], options: RunOptions, dem: Dem | None, frame: ControlReference
) -> GroundPoints:
    try:
        points = read_gcps(path, [view.name for view in views], frame)
    except InputError as error:
        if not options.keep_going:
            raise
        return replace(GroundPoints.none(), left_out=(f"{error}; the file is left out",))
    points, said = _gcps_with_altitudes(_with_height_above_dem(dem, points, options), views, options, dem)
    out, keep = [], np.ones(len(points.names), dtype=bool)
    search = np.array([reach_of(view, options.tie.search) for view in views])[points.view]
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
    lines = *(f"{path}: {line}" for line in said), *(f"{path}: {line}; left out" for line in out)
    return replace(points.select(keep), left_out=lines)


def _gcps_with_altitudes(
    points: GroundPoints, views: Sequence[View], options: RunOptions, dem: Dem | None
) -> tuple[GroundPoints, list[str]]:
    """Return the points, missing altitudes (0, as programs write for unknown ones) taken from a DEM, and remarks.

    Points without a height of the DEM constrain the images horizontally only: they get the middle of the cameras'
    altitude ranges, and a sigma that leaves their mean as uncertain as these.
    """
    unknown = points.lonlatalt[:, 2] == 0.0
    if not unknown.any():
        return points, []
    ground, sigma, count = points.lonlatalt.copy(), points.sigma.copy(), int(unknown.sum())
    what = f"{count} of {len(unknown)} points have no altitude, or a default (0, or one for all)"
    if dem is not None:
        height = dem(*ground[unknown, :2].T)
        known = unknown.copy()
        known[unknown] = np.isfinite(height)
        ground[known, 2] = height[np.isfinite(height)]
        given = options.adjust.dem_bias_sigma or (KNOWN_BIAS if dem.known else DEM_BIAS)
        # the error common to all n heights does not average out: times sqrt(n), the mean keeps it
        sigma[known, 2] = np.hypot(options.adjust.dem_sigma, given * np.sqrt(max(known.sum(), 1)))
        points = replace(points, said=(*points.said, f"{what}: the DEM's are taken for {known.sum()} of them"))
        unknown &= ~known
    low, high = min(view.alt_range[0] for view in views), max(view.alt_range[1] for view in views)
    ground[unknown, 2], sigma[unknown, 2] = 0.5 * (low + high), (high - low) * np.sqrt(max(unknown.sum(), 1))
    many = " and" if unknown.sum() == count else f"; {int(unknown.sum())} of them"
    said = f"{what}{many} constrain the images horizontally only: give their altitudes, or --dem"
    return replace(points, lonlatalt=ground, sigma=sigma), [said] if unknown.any() else []


def _with_height_above_dem(dem: Dem | None, points: GroundPoints, options: RunOptions) -> GroundPoints:
    """Return the points, `datums` with their median height above a DEM of known datum: evidence on their own."""
    ground = points.lonlatalt[points.lonlatalt[:, 2] != 0.0]
    if dem is None or not dem.known or not points.datums:
        return points
    off = ground[:, 2] - dem(*ground[:, :2].T)
    off = off[np.isfinite(off)]
    if not len(off):
        return points
    bias, single = options.adjust.dem_bias_sigma or KNOWN_BIAS, max(robust_spread(off), options.adjust.dem_sigma)
    above = float(np.median(off)), float(np.hypot(bias, single / np.sqrt(len(off))))
    return replace(points, datums=tuple(replace(one, above=(above,)) for one in points.datums))


def _implausible(points: GroundPoints, views: Sequence[View], search: Array) -> Iterator[tuple[BoolArray, str]]:
    """Yield masks of implausible points (G,), and why; the first reason counts. `search` (M,): camera errors [px]."""
    low, high = np.array([view.alt_range for view in views])[points.view].T
    alt = points.lonlatalt[points.point, 2]
    shown, pixel = _image_positions(points, views, np.clip(alt, low, high))
    reach = np.maximum(_MAX_CAMERA_ERROR, search * pixel)
    away = _distance(points, shown, (0, 1), (1, 1))
    yield _any(points, ~np.isfinite(away)), "no ground is seen at the position in the image"
    far = _any(points, away > reach) | (np.abs(points.lonlatalt[:, 1]) > 90.0)
    beyond = _beyond(points, views, points.xy)
    if beyond.any():
        beyond &= ~_beyond(points, views, _gcp_pixels(points, views))
    outside = _any(points, beyond)
    for what, (columns, *signs) in _MISTAKES.items():
        near = [_distance(points, shown, columns, sign) <= reach for sign in signs]
        mistaken = far & _any(points, np.asarray(np.any(near, axis=0)))
        yield mistaken, what
        far &= ~mistaken
    yield outside, "outside its image, and inside it by the camera: col from the left, row from the top, in its pixels"
    most = np.nanmax(away[far[points.point]], initial=0.0) / 1e3
    yield far, f"as far as {most:,.0f} km from where the images show it, by their cameras"
    wild = (alt < low - _ALT_REACH) | (alt > high + _ALT_REACH)
    ends = f"{np.min(low, initial=np.inf):.0f} to {np.max(high, initial=-np.inf):.0f} m"
    yield (
        _any(points, wild),
        f"altitudes far outside {ends}, where the cameras are used: metres above the ellipsoid are needed",
    )
    if what := _in_another_unit(points, views):
        yield np.ones(len(points.names), dtype=bool), what


def _beyond(points: GroundPoints, views: Sequence[View], xy: Array) -> BoolArray:
    """Return the mask (M,) of observations whose positions `xy` (M, 2) [px] are outside their images."""
    size = np.array([view.size for view in views])[points.view]
    return np.asarray(((xy < -IMAGE_MARGIN) | (xy > size - 1 + IMAGE_MARGIN)).any(axis=1))


def _gcp_pixels(points: GroundPoints, views: Sequence[View]) -> Array:
    """Return the projected points of the observations (M, 2) [px], their altitudes clipped to the cameras' ranges."""
    ground, xy = points.lonlatalt[points.point].copy(), np.empty_like(points.xy)
    for v in np.unique(points.view):
        rows = points.view == v
        ground[rows, 2] = np.clip(ground[rows, 2], *views[v].alt_range)
        xy[rows] = views[v].sensor.project(ground[rows])
    return xy


def _in_another_unit(points: GroundPoints, views: Sequence[View]) -> str:
    """Return the message that triangulated points show another unit of the altitudes; empty if they do not."""
    several = np.bincount(points.point, minlength=len(points.names)) > 1
    if several.sum() < _LEAST_FOR_UNIT:
        return ""
    seen = triangulate(
        [view.sensor for view in views], points.view, points.point, points.xy, alt=np.mean([v.altitude for v in views])
    )
    shown = np.full(len(points.names), np.nan)
    shown[: len(seen.points)] = ground_from_ecef(seen.points)[:, 2]
    known = np.isfinite(shown) & several
    if known.sum() < _LEAST_FOR_UNIT:
        return ""
    shown, given = shown[known], points.lonlatalt[known, 2]
    foot = metres_of("foot") or np.nan
    as_given, feet, metres = (float(np.std(shown - times * given)) for times in (1.0, foot, 1.0 / foot))
    if as_given < FEWER * min(feet, metres) or as_given < _LEAST_MISFIT:
        return ""
    unit, left = ("feet", feet) if feet < metres else ("metres and not feet", metres)
    return (
        f"altitudes scatter by {as_given:.1f} m from where the images show the points, and by {left:.1f} m if they are "
        f"in {unit}: name the unit in the column (alt_ft)"
    )


def _any(points: GroundPoints, observed: BoolArray) -> BoolArray:
    """Return the mask of points (G,) with a condition `observed` (M,) true in any of their observations."""
    return np.bincount(points.point, observed, minlength=len(points.names)) > 0


def _image_positions(points: GroundPoints, views: Sequence[View], alt: Array) -> tuple[Array, Array]:
    """Return the observations localized at altitudes `alt` (M,) [m]: lon, lat, alt (M, 3), and pixel size (M,) [m]."""
    ground, pixel = np.empty((len(alt), 3)), np.empty(len(alt))
    for v in np.unique(points.view):
        rows = points.view == v
        ground[rows] = views[v].sensor.localize(points.xy[rows], alt[rows])
        pixel[rows] = ground_sample_distance(views[v].sensor, ground[rows])[1]
    return ground, np.nan_to_num(pixel)


def _distance(points: GroundPoints, shown: Array, columns: tuple[int, int], signs: tuple[int, int]) -> Array:
    """Return the distances (M,) [m] from localized positions `shown` to those given, lon and lat from `columns`."""
    level = points.lonlatalt[points.point][:, columns] * signs
    given = np.column_stack([level, shown[:, 2]])
    return np.asarray(np.linalg.norm(ecef_from_ground(given) - ecef_from_ground(shown), axis=1))


def load_altimetry(paths: Sequence[str], views: Sequence[View], heights: str | None = None) -> Altimetry | None:
    """Return the altimetry of several files, one after the other, as far as images cover it; None without files.

    InputError for a file that cannot be read or has no height in the images.
    """
    parts = [_heights_of(path, views, heights) for path in paths]
    return Altimetry(**join_fields(parts)) if parts else None


def _heights_of(path: str, views: Sequence[View], heights: str | None) -> Altimetry:
    given = read_altimetry(path, heights)
    inside = _within_bounds(given.lonlatalt, views)
    if not inside.any():
        swapped = given.lonlatalt[:, [1, 0, 2]]
        at = f"{len(inside)} heights about {', '.join(f'{x:.4f}' for x in np.median(given.lonlatalt[:, :2], axis=0))}"
        what = "are longitude and latitude exchanged?" if _within_bounds(swapped, views).any() else "another place?"
        raise InputError(f"{path}: none of its {at} (lon, lat) lies in the images: {what}")
    return Altimetry(given.lonlatalt[inside], given.sigma[inside], given.sigma_flat[inside], given.datums)


def _within_bounds(lonlatalt: Array, views: Sequence[View]) -> BoolArray:
    """Return the mask of places (n, 3) in the ground bounds of any image, with a margin for camera errors."""
    found = np.zeros(len(lonlatalt), dtype=bool)
    for view in views:
        ring = footprint(view.sensor, view.size, view.altitude)
        ring = ring[np.isfinite(ring).all(axis=1)]
        if not len(ring):
            continue
        middle = ring.mean(axis=0)
        margin = _MAX_CAMERA_ERROR / metres_per_unit([*middle, 0.0])[:2]
        ring[:, 0] = wrap_longitude(ring[:, 0], middle[0])
        place = np.column_stack([wrap_longitude(lonlatalt[:, 0], middle[0]), lonlatalt[:, 1]])
        low, high = ring.min(axis=0) - margin, ring.max(axis=0) + margin
        found |= ((place >= low) & (place <= high)).all(axis=1)
    return found
