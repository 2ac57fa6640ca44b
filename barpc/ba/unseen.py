"""Displaced rows or columns that two images do not show, and the height errors that they would cause.

Tie points of two images show a displacement only across the epipolar lines. All rows after an edge may be displaced
along the row axis: lines are lost, or a clock jumps. All columns after an edge may be displaced along the column axis:
detectors overlap less than calibrated. The smaller the angle between epipolar lines and axis, the larger is the
displacement that tie points do not show. Heights of a DEM are a second limit of this displacement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.constraints.gauge import MOTIONS, SIMILAR, GaugeReport, motions_of_moves, weakest_modes
from barpc.ba.constraints.terrain import quadratic_basis, variance_inflation, without_outliers
from barpc.ba.evidence.scan import BINS, price
from barpc.ba.parameters.additional_parameters import DRIFTS
from barpc.ba.terms.term import SIZE_PRICE
from barpc.base.geodesy import Array, enu_basis, ground_from_ecef, metres_per_unit, wrap_longitude
from barpc.base.statistics import CRITICAL, MANY, SURE

CHANCES = np.array([0.14, 0.05])
"""Probabilities that columns, and that rows, of an image are displaced.

They are Jeffreys' estimates (n + 1/2) / (N + 1) from N = 10 real images of line scanners with independent points
(Pleiades 5, QuickBird 1, Sentinel-2 2, Reunion 2). n = 1 of them has displaced columns (a step between detectors), and
n = 0 displaced rows.
"""
LARGEST_STEPS = np.array([1.0, 5.0])
"""Largest displacements of columns and of rows [px]; displacements up to these have a uniform distribution.

Detectors are calibrated in flight to a fraction of a pixel. Larger displacements of rows tear the image visibly.
"""
_LEAST_SHOWN = 1.0  # px: one row; heights of woods and houses look like smaller displacements


@dataclass(frozen=True)
class Shown:
    """A displacement of part of an image that heights from another source show, but tie points do not."""

    view: int
    axis: int  # 0: columns, 1: rows
    edge: float  # column or row where it begins [px]
    pixels: float  # size of the displacement [px]
    metres: float  # height error after the edge [m]


@dataclass(frozen=True, eq=False)
class UnseenSteps:
    """Largest displacements of columns and rows that two images do not show."""

    sizes: Array  # (2, 2) width and height of the views [px]
    pixels: Array  # (2, 2) largest unseen displacements, for each view of columns and of rows [px]
    metres: Array  # (2, 2) height errors after the edges [m]
    shown: Shown | None = None  # displacement shown by heights from another source

    def heights(self, image: Array, pull: Array) -> Array:
        """Return the errors of heights (n, k) [m] caused by k independent displacements of one standard deviation.

        `image` (n, 2, 2) are the image points of n ground points in both views, `pull` (n, 2, 2) the derivatives of the
        heights by their coordinates [m/px].
        """
        # mean square of unseen displacements, for a uniform distribution from 0 to the largest displacement
        sigma = np.sqrt(CHANCES / BINS * self.pixels**3 / (3.0 * LARGEST_STEPS))
        return np.asarray((sigma[..., None] * _steps(image, self.sizes) * pull[..., None]).reshape(len(pull), -1))


def _steps(image: Array, sizes: Array) -> Array:
    """Return 1 for image points (n, 2, 2) after an edge, else 0, for equally probable edges (n, 2, 2, `BINS`)."""
    edges = (np.arange(BINS) + 0.5) / BINS
    return np.asarray((image / sizes)[..., None] > edges, dtype=np.float64)


def unseen_steps(
    sizes: Array, ground: Array, image: Array, pull: Array, limits: tuple[float, float], known: Array
) -> UnseenSteps:
    """Return the largest displacements that tie points and known heights of two views do not show.

    Parameters
    ----------
    sizes : (2, 2), of the views [px]
    ground, image, pull : (n, 3), (n, 2, 2), (n, 2, 2), tie points and derivatives as for `UnseenSteps.heights`
    limits : (float, float)
        Standard deviation of the epipolar offsets of the tie points, and their tolerated common offset [px].
    known : (n,), heights from another source [m]; NaN: unknown
    """
    # components of both axes across the epipolar lines, whose direction is that of the height derivatives
    across = pull[:, :, ::-1] * [1.0, -1.0] / np.linalg.norm(pull, axis=2, keepdims=True)
    steps, found, (sigma, floor) = _steps(image, sizes), np.zeros((2, 2)), limits
    least = np.sqrt(2.0 * (SURE + price(2) + SIZE_PRICE))  # least detected step, in standard deviations
    shown, by_heights = _by_heights(ground, steps * pull[..., None], known)
    for v, axis in np.ndindex(2, 2):
        smooth = np.vander(2.0 * image[:, v, axis] / sizes[v, axis] - 1.0, DRIFTS)  # absorbed by the cameras
        seen, even = (_rough(smooth, s) for s in (steps[:, v, axis] * across[:, v, axis, None], steps[:, v, axis]))
        size = np.linalg.norm(seen, axis=0) / np.sqrt(sigma**2 + floor**2 * (even**2).sum(axis=0))
        limit = least / np.maximum(size, least / LARGEST_STEPS[axis])
        found[v, axis] = np.median(np.minimum(limit, by_heights[v, axis]))
    metres = np.median(np.abs(pull), axis=0)
    if shown is not None:
        shown = replace(shown, edge=shown.edge * sizes[shown.view, shown.axis])
        shown = replace(shown, metres=shown.pixels * metres[shown.view, shown.axis])
    return UnseenSteps(sizes, found, found * metres, shown)


def _by_heights(ground: Array, rises: Array, known: Array) -> tuple[Shown | None, Array]:
    """Return the displacement that known heights (n,) show (None: none), and limits (2, 2, k) [px] of unseen ones.

    `rises` (n, 2, 2, k) are the height errors [m] by a displacement of one pixel at each edge. Smooth height errors are
    removed first: they are errors of the cameras.
    """
    limits, fits = np.full(rises.shape[1:], np.inf), np.isfinite(known)
    if fits.sum() < MANY:
        return None, limits
    error, at = ground[:, 2] - known, np.column_stack([wrap_longitude(ground[:, 0], ground[0, 0]), ground[:, 1]])
    at = (at - at[fits].mean(axis=0)) * metres_per_unit(ground[0])[:2]
    fits[fits] = without_outliers(error[fits])
    smooth, columns = quadratic_basis(at / np.abs(at[fits]).max()), rises.reshape(len(rises), -1)
    error, columns = _rough(smooth[fits], error[fits, None])[:, 0], _rough(smooth[fits], columns[fits])
    square = np.maximum((columns**2).sum(axis=0), 1e-9)
    pixels = columns.T @ error / square
    best = int(np.argmax(pixels**2 * square))
    residual = error - columns[:, best] * pixels[best]
    # errors of a DEM are correlated over hundreds of metres
    inflation = variance_inflation(at[fits], np.column_stack([residual, residual]))
    sigma = np.sqrt(residual @ residual / len(residual) * inflation / square)
    v, axis, edge = np.unravel_index(best, limits.shape)
    shown = Shown(int(v), int(axis), (int(edge) + 0.5) / BINS, abs(float(pixels[best])), np.nan)
    is_shown = shown.pixels > max(CRITICAL * float(sigma[best]), _LEAST_SHOWN)
    return shown if is_shown else None, np.maximum(CRITICAL * sigma, np.abs(pixels)).reshape(limits.shape)


def _rough(smooth: Array, columns: Array) -> Array:
    """Return the residuals of columns (n, k) after a least-squares fit of smooth columns (n, m)."""
    return np.asarray(columns - smooth @ np.linalg.lstsq(smooth, columns, rcond=None)[0])


def with_unseen(gauge: GaugeReport, points: Array, heights: Array, held: bool) -> GaugeReport:
    """Return the report with the uncertainty by height errors (n, k) [m] at points (n, 3), ECEF [m], added.

    With control (`held`) the errors only bend the scene, as control corrects shifts, tilts, turn and scale.
    """
    middle = points.mean(axis=0)
    local = (points - middle) @ enu_basis(ground_from_ecef(middle)).T / gauge.radius
    moves = motions_of_moves(local)[:, :, 2] @ heights
    moves[: SIMILAR if held else 0] = 0.0
    covariance = moves @ moves.T
    for mode in gauge.modes:
        covariance[:, MOTIONS.index(mode.meaning)] += mode.motion * mode.sigma
    sigma = np.sqrt(np.diag(covariance))
    return replace(gauge, sigma=sigma[:3], motion_sigma=sigma, modes=weakest_modes(covariance))
