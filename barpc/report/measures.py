"""What tie points say about cameras: errors of views, epipolar offsets and geometry of pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barpc.geodesy import Array, ecef_from_ground, ground_from_ecef, metres_per_unit
from barpc.scene import BoolArray, IntArray, Tracks
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected
from barpc.sensor.geometry import Triangulation, convergence_angle, epipolar_offset, sight_enu, triangulate

MAX_PER_PAIR = 1000
"""Matches of a pair that its epipolar offset is measured on, evenly taken."""
WHOLE, MOST, LEAST = 0.05, 0.9, 20
"""A whole shift [px], the share of a pair's matches that must have it, and how many there must be."""


def robust_spread(values: Array) -> float:
    """1.4826 times the median absolute deviation: the standard deviation of a normal core."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def rmse_by_view(residuals: Array, view: IntArray, num_views: int) -> Array:
    """Root mean square reprojection error of each view.

    Parameters
    ----------
    residuals : (K, 2)
        Projected - observed [px]; rows with NaN do not count.
    view : (K,)
        View of each row.
    num_views : int
        Number of views N.

    Returns
    -------
    rmse : (N,)
        sqrt(mean(dcol^2 + drow^2)) [px]; NaN for a view without rows.
    """
    use = np.isfinite(residuals).all(axis=1)
    squares = np.bincount(view[use], (residuals[use] ** 2).sum(axis=1), minlength=num_views)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(squares / np.bincount(view[use], minlength=num_views)))


@dataclass(frozen=True, eq=False)
class PairOffset:
    """Epipolar offset of a pair's matches.

    Parameters
    ----------
    median, spread, rms : float
        Across the epipolar line [px]; the spread is 1.4826 times the median absolute deviation.
    count : int
        Matches measured.
    """

    median: float
    spread: float
    rms: float
    count: int


@dataclass(frozen=True, eq=False)
class PairTies:
    """The observations that two views have in common.

    Parameters
    ----------
    views : (int, int)
        The pair, ascending.
    a, b : (M,)
        Rows of the tracks: the observations in the first view and in the second.
    """

    views: tuple[int, int]
    a: IntArray
    b: IntArray


def pair_ties(tracks: Tracks, keep: BoolArray | None = None) -> list[PairTies]:
    """All pairs of views with tracks in common, in ascending order.

    Parameters
    ----------
    tracks : Tracks
        Tie points.
    keep : (K,), optional
        Observations to count.
    """
    rows = np.arange(len(tracks)) if keep is None else np.flatnonzero(keep)
    rows = rows[np.lexsort((tracks.view[rows], tracks.point[rows]))]
    point = tracks.point[rows]
    found_a, found_b = [], []
    for step in range(1, int(np.bincount(point).max(initial=1))):
        together = point[step:] == point[:-step]
        found_a.append(rows[:-step][together])
        found_b.append(rows[step:][together])
    if not found_a:
        return []
    a, b = np.concatenate(found_a), np.concatenate(found_b)
    num = int(tracks.view.max()) + 1
    code = tracks.view[a] * num + tracks.view[b]
    order = np.argsort(code, kind="stable")
    a, b, code = a[order], b[order], code[order]
    starts = np.flatnonzero(np.diff(code, prepend=-1))
    ends = np.append(starts[1:], len(code))
    return [
        PairTies((int(code[s] // num), int(code[s] % num)), np.sort(a[s:e]), b[s:e][np.argsort(a[s:e])])
        for s, e in zip(starts, ends, strict=True)
    ]


def whole_shift(ties: PairTies, tracks: Tracks) -> Array | None:
    """The shift (2,) [px] by whole pixels that the matches of a pair share; None where there is none.

    Two images of one scene never match so: only one that is a part, or a copy, of the other.
    """
    shift = tracks.xy[ties.b] - tracks.xy[ties.a]
    whole: Array = np.rint(np.median(shift, axis=0))
    same = np.mean((np.abs(shift - whole) <= WHOLE).all(axis=1))
    return whole if len(shift) >= LEAST and same >= MOST else None


def pair_offset(ties: PairTies, tracks: Tracks, sensors: Sequence[SensorModel], alt: Array) -> PairOffset:
    """The epipolar offset of a pair's matches.

    Parameters
    ----------
    ties : PairTies
        The pair.
    tracks : Tracks
        Tie points.
    sensors : sequence of SensorModel
        The cameras of all views.
    alt : (P,)
        Altitudes of the tracks through these cameras [m]: so near to where the pair's own rays pass each other
        that two steps arrive.
    """
    pick = np.linspace(0, len(ties.a) - 1, min(len(ties.a), MAX_PER_PAIR)).astype(np.int64)
    start = alt[tracks.point[ties.a[pick]]]
    pick, start = pick[np.isfinite(start)], start[np.isfinite(start)]
    i, j = ties.views
    image_a, image_b = tracks.xy[ties.a[pick]], tracks.xy[ties.b[pick]]
    offset, _ = epipolar_offset(sensors[i], sensors[j], image_a, image_b, start, steps=2)
    offset = offset[np.isfinite(offset)]
    if not len(offset):
        return PairOffset(float("nan"), float("nan"), float("nan"), 0)
    rms = float(np.sqrt((offset**2).mean()))
    return PairOffset(float(np.median(offset)), robust_spread(offset), rms, len(offset))


def pair_geometry(ties: PairTies, sensors: Sequence[SensorModel], at: Array) -> tuple[float, float, float]:
    """Median over ground points (n, 3) of a pair's convergence angle, B/H, and metres of height a pixel.

    Parameters
    ----------
    ties : PairTies
        The pair.
    sensors : sequence of SensorModel
        The cameras of all views.
    at : (n, 3)
        lon, lat [deg], alt [m].

    Returns
    -------
    convergence : float
        Angle between the lines of sight [deg].
    base_to_height : float
        Distance of two cameras at the height 1 over the horizontal plane, along these lines of sight.
    height_per_px : float
        Height [m] whose parallax is one pixel (of the finer image); infinite for parallel rays.
    """
    at = at[np.isfinite(at).all(axis=1)]
    if not len(at):
        return float("nan"), float("nan"), float("nan")
    a, b = (sensors[i] for i in ties.views)
    sight_a, sight_b = sight_enu(a, at), sight_enu(b, at)
    base = np.linalg.norm(sight_a[:, :2] / sight_a[:, 2:] - sight_b[:, :2] / sight_b[:, 2:], axis=1)
    finer = np.minimum(ground_sampling(a, at), ground_sampling(b, at))
    with np.errstate(divide="ignore"):
        height = float(np.median(finer / base))
    return float(np.median(convergence_angle(a, b, at))), float(np.median(base)), height


def ground_sampling(sensor: SensorModel, ground: Array) -> Array:
    """Side [m] (...) of the square on level ground that has the area of a pixel, at points (..., 3)."""
    _, jacobian = sensor.project_jacobian(ground)
    metric = jacobian[..., :2] / metres_per_unit(ground)[..., None, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(1.0 / np.sqrt(np.abs(np.linalg.det(metric))))


def coverage(xy: Array, size: tuple[int, int], cells: int = 8) -> float:
    """Share of the cells of a square grid over an image that hold one of the image points (n, 2) or more."""
    place = ((xy + 0.5) / size * cells).astype(np.int64).clip(0, cells - 1)
    return len(np.unique(place[:, 0] * cells + place[:, 1])) / cells**2


def shift_in_image(model: Corrected, covariance: Array, unknowns: str, ground: Array) -> tuple[Array, Array]:
    """How far a correction moves a ground point in the image, and the standard deviation of that.

    Parameters
    ----------
    model : Corrected
        P_BA.
    covariance : (q, q)
        Of its unknowns: rotation (metres: angle x distance), translation [m], then any drift, which is zero
        in the middle row.
    unknowns : str
        Which there are: "rotation", "translation", "rotation+translation".
    ground : (3,)
        A ground point near the middle of the image.

    Returns
    -------
    shift, sigma : (2,)
        col, row [px].
    """
    ecef = ecef_from_ground(ground)
    image, _, by_rotation, by_translation = model.project_ecef(ecef)
    distance = np.linalg.norm(ecef - model.correction.center)
    parts = {"rotation": by_rotation / distance, "translation": by_translation}
    jacobian = np.hstack([part for name, part in parts.items() if name in unknowns])
    q = jacobian.shape[1]
    variance = np.einsum("ij,jk,ik->i", jacobian, covariance[:q, :q], jacobian)
    return image - model.sensor.project(ground), np.sqrt(np.maximum(variance, 0.0))


def triangulate_tracks(
    tracks: Tracks, sensors: Sequence[SensorModel], alt: float, keep: BoolArray
) -> Triangulation:
    """All tracks intersected through given cameras from the observations that count.

    Parameters
    ----------
    tracks : Tracks
        Tie points.
    sensors : sequence of SensorModel
        The cameras.
    alt : float
        Where the iteration starts [m].
    keep : (K,)
        Observations that count; the residuals of the others are measured against the same points.

    Returns
    -------
    Triangulation
        Of all tracks; a track with fewer than two observations that count is NaN.
    """
    point, view = tracks.point[keep], tracks.view[keep]
    found = triangulate(sensors, view, point, tracks.xy[keep], tracks.sigma[keep], alt=alt)
    points = np.full((tracks.num_points, 3), np.nan)
    points[: len(found.points)] = found.points
    residuals = np.full((len(tracks), 2), np.nan)
    residuals[keep] = found.residuals
    ground = ground_from_ecef(points)
    for i in np.unique(tracks.view[~keep]):
        rows = np.flatnonzero(~keep & (tracks.view == i))
        residuals[rows] = sensors[i].project(ground[tracks.point[rows]]) - tracks.xy[rows]
    return Triangulation(points, residuals, np.isfinite(points).all(axis=1))
