"""Displaced rows or columns that two images do not show, and the errors of heights that they would cause.

Two images show a displacement only across their epipolar lines. Behind an edge, rows are displaced along the axis of
the rows (lost lines, clocks that jump: no platform turns by pixels between two lines), columns along that of the
columns (detectors that overlap less than calibrated). The smaller the angle between epipolar lines and axis, the larger
is the displacement that tie points do not show. Heights known from a DEM are a second limit of this displacement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.constraints.gauge import MOTIONS, SIMILAR, GaugeReport, motions_of_moves, weakest_modes
from barpc.ba.constraints.terrain import quadratic_basis, variance_inflation
from barpc.ba.evidence.scan import price
from barpc.ba.parameters.additional_parameters import DRIFTS
from barpc.ba.terms.term import SIZE_PRICE
from barpc.base.geodesy import Array, enu_basis, ground_from_ecef, metres_per_unit, wrap_longitude
from barpc.base.statistics import CRITICAL, MANY, OUTLIER, SURE, robust_spread

CHANCES = np.array([0.14, 0.05])
"""Probabilities that columns, and that rows, of an image are displaced.

They are Jeffreys' estimates (n + 1/2) / (N + 1) from N = 10 real images of line scanners with independent points
(Pleiades 5, QuickBird 1, Sentinel-2 2, Reunion 2). n = 1 of them has displaced columns (a step between detectors), and
n = 0 displaced rows.
"""
LARGEST_STEPS = np.array([1.0, 5.0])
"""Largest displacements of columns and of rows [px]; smaller ones have a uniform distribution.

Detectors are calibrated in flight to a fraction of a pixel. A larger displacement of rows is visible as a tear in the
image.
"""
_LEAST_SHOWN = 1.0  # px: one row; the heights of woods and houses can have the same effect as smaller displacements
_EDGES = 16  # number of equally probable positions of the edge along an axis


@dataclass(frozen=True)
class Shown:
    """A displacement of part of an image: heights from another source show it, but tie points do not."""

    view: int
    axis: int  # 0: columns, 1: rows
    edge: float  # [px]
    pixels: float
    metres: float  # error of heights behind the edge


@dataclass(frozen=True, eq=False)
class UnseenSteps:
    """Largest displacements of columns and rows that two images do not show."""

    sizes: Array  # (2, 2) width and height of the views [px]
    pixels: Array  # (2, 2) displacements of columns and rows of each view [px]
    metres: Array  # (2, 2) errors of heights behind the edges [m]
    shown: Shown | None = None  # displacement shown by heights from another source

    def heights(self, image: Array, pull: Array) -> Array:
        """Return the errors of heights (n, k) [m] caused by k independent displacements of one standard deviation.

        `image` (n, 2, 2) are the image points of n ground points in both views. `pull` (n, 2, 2) are the derivatives of
        the heights by the coordinates of these.
        """
        # mean square of displacements that are not seen, if all are uniform between 0 and the largest
        sigma = np.sqrt(CHANCES / _EDGES * self.pixels**3 / (3.0 * LARGEST_STEPS))
        return np.asarray((sigma[..., None] * _steps(image, self.sizes) * pull[..., None]).reshape(len(pull), -1))


def _steps(image: Array, sizes: Array) -> Array:
    """Return 1 where image points (n, 2, 2) lie behind an edge, else 0, for each edge (n, 2, 2, `_EDGES`)."""
    edges = (np.arange(_EDGES) + 0.5) / _EDGES
    return np.asarray((image / sizes)[..., None] > edges, dtype=np.float64)


def unseen_steps(
    sizes: Array, ground: Array, image: Array, pull: Array, limits: tuple[float, float], known: Array
) -> UnseenSteps:
    """Return the displacements that tie points and known heights of two views do not show.

    Parameters
    ----------
    sizes : (2, 2), of the views [px]
    ground, image, pull : (n, 3), (n, 2, 2), (n, 2, 2), tie points and derivatives as for `UnseenSteps.heights`
    limits : (float, float)
        Standard deviation of the epipolar offsets of the tie points, and their tolerated common offset [px].
    known : (n,), heights from another source [m]; NaN: unknown
    """
    # components of both axes across the epipolar lines; the gradients of heights have the direction of these lines
    across = pull[:, :, ::-1] * [1.0, -1.0] / np.linalg.norm(pull, axis=2, keepdims=True)
    steps, found, (sigma, floor) = _steps(image, sizes), np.zeros((2, 2)), limits
    least = np.sqrt(2.0 * (SURE + price(2) + SIZE_PRICE))  # least detected step, in standard deviations
    shown, by_heights = _by_heights(ground, steps * pull[..., None], known)
    for v, axis in np.ndindex(2, 2):
        smooth = np.vander(2.0 * image[:, v, axis] / sizes[v, axis] - 1.0, DRIFTS)  # absorbed by the cameras
        seen, even = (_beside(smooth, s) for s in (steps[:, v, axis] * across[:, v, axis, None], steps[:, v, axis]))
        size = np.linalg.norm(seen, axis=0) / np.sqrt(sigma**2 + floor**2 * (even**2).sum(axis=0))
        limit = least / np.maximum(size, least / LARGEST_STEPS[axis])
        found[v, axis] = np.median(np.minimum(limit, by_heights[v, axis]))
    metres = np.median(np.abs(pull), axis=0)
    if shown is not None:
        shown = replace(shown, edge=shown.edge * sizes[shown.view, shown.axis])
        shown = replace(shown, metres=shown.pixels * metres[shown.view, shown.axis])
    return UnseenSteps(sizes, found, found * metres, shown)


def _by_heights(ground: Array, rises: Array, known: Array) -> tuple[Shown | None, Array]:
    """Return the displacement that known heights (n,) show, and the limits (2, 2, k) of those that they do not [px].

    The displacement is None if they show none. `rises` (n, 2, 2, k) are the errors of heights [m] by a displacement of
    one pixel. Smooth errors of heights are removed first: they are errors of the cameras.
    """
    limits, fits = np.full(rises.shape[1:], np.inf), np.isfinite(known)
    if fits.sum() < MANY:
        return None, limits
    off, at = ground[:, 2] - known, np.column_stack([wrap_longitude(ground[:, 0], ground[0, 0]), ground[:, 1]])
    at = (at - at[fits].mean(axis=0)) * metres_per_unit(ground[0])[:2]
    off -= np.median(off[fits])
    fits &= np.abs(off) <= OUTLIER * robust_spread(off[fits])
    smooth, columns = quadratic_basis(at / np.abs(at[fits]).max()), rises.reshape(len(rises), -1)
    off, columns = _beside(smooth[fits], off[fits, None])[:, 0], _beside(smooth[fits], columns[fits])
    square = np.maximum((columns**2).sum(axis=0), 1e-9)
    pixels = columns.T @ off / square
    best = int(np.argmax(pixels**2 * square))
    left = off - columns[:, best] * pixels[best]
    # errors of a DEM are correlated over hundreds of metres
    alike = variance_inflation(at[fits], np.column_stack([left, left]))
    sigma = np.sqrt(left @ left / len(left) * alike / square)
    v, axis, edge = np.unravel_index(best, limits.shape)
    shown = Shown(int(v), int(axis), (int(edge) + 0.5) / _EDGES, abs(float(pixels[best])), np.nan)
    is_shown = shown.pixels > max(CRITICAL * float(sigma[best]), _LEAST_SHOWN)
    return shown if is_shown else None, np.maximum(CRITICAL * sigma, np.abs(pixels)).reshape(limits.shape)


def _beside(smooth: Array, columns: Array) -> Array:
    """Return the residuals of columns (n, k) after a least-squares fit of smooth columns (n, m)."""
    return np.asarray(columns - smooth @ np.linalg.lstsq(smooth, columns, rcond=None)[0])


def with_unseen(gauge: GaugeReport, points: Array, heights: Array, held: bool) -> GaugeReport:
    """Return the report on a scene with the errors (n, k) [m] of heights at points (n, 3), ECEF [m], added.

    If control constrains the scene (`held`), it corrects shifts, tilts, turn and scale; the errors only bend the scene.
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
