"""Interior distortion and detector steps of one sensor, from the tie points of many finished blocks.

The detectors of a pushbroom line take the same columns in all its images: x = P(X) + c(col), where c is a spline of the
column with steps where another detector begins. One block does not determine c along its epipolar lines; blocks with
other directions do. Every view has nuisance parameters (1, col, row, col row and row^2 of each coordinate) for errors
of rotation, drift and orbit. c has no constant and no slope: the correction of a camera absorbs them. A focal scale or
line rate common to all images scales the ground with them, and tie points alone do not determine it.

Points are eliminated, then nuisances: every block leaves normal equations of c. Tests with blocks left out, or with
blocks before and after a date, only add these equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import accumulate
from operator import add

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from barpc.ba.interior import LINE_SPLINES, LineCurve
from barpc.ba.parameters.additional_parameters import FIRST_SIGMA
from barpc.base.errors import InputError
from barpc.base.geodesy import Array, ecef_from_ground_jacobian
from barpc.base.statistics import BACKFITTING, CRITICAL, ROUNDING, STEPS, SURE, robust_spread
from barpc.scene import IntArray, Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.geometry import Several
from barpc.sensor.image_corrections import ColumnSpline

_ROUGHNESS = 10.0 ** np.arange(-4.0, 0.5, 0.5)  # px: candidate sigmas of the third differences of splines
_CANDIDATES = 128  # intervals of the line, between which steps are tried first
_FINER = 12  # factor by which each pass reduces the spacing of the candidates, around the steps found
_POSITIONS = (
    65  # tried positions of a view on the line: over +-`CRITICAL` standard deviations, then over a 16th of that
)
_NUISANCE_SIGMA = 100.0  # px: a wide prior, as a block may not determine all nuisances
_MOST_STEPS = 40  # limit of the number of steps; focal planes have up to about thirty detectors
_BEST_NOISE = 2e-3  # px: least noise of tie points, even if they agree better
_LEAST_SHARE = 0.75  # of a curve in a block of its sensor: halfway between 1 and 0.5, where correcting does not help


@dataclass(frozen=True, eq=False)
class SensorTies:
    """Tie points of a finished block of one sensor, linearised at its cameras without image corrections.

    Parameters
    ----------
    name, date : str, of the block; the date is its first day (ISO 8601), empty if not stated
    width : int, number of columns of the line
    view, point : (K,), indices
    col : (K,), observed column on the line [px]
    place : (K, 2), projected image position, -1 to 1 over the image. (With observed positions, their noise would pass
        for information on weakly determined nuisances.)
    residual : (K, 2), projected - observed [px]
    by_point : (K, 2, 3), derivatives of the projection by the point, ECEF [px/m]
    loose : (V,), standard deviation of the position of each view on the line [px]; 0: known
    """

    name: str
    date: str
    width: int
    view: IntArray
    point: IntArray
    col: Array
    place: Array
    residual: Array
    by_point: Array
    loose: Array

    @classmethod
    def of(
        cls,
        name: str,
        views: Sequence[View],
        tracks: Tracks,
        sensors: Sequence[SensorModel],
        ground: Array,
        line: Line | None = None,
    ) -> SensorTies:
        """Linearise a block at cameras without image corrections and at the ground points (P, 3) of the tracks.

        `line` has the positions of the views on the line; None: each view is the whole line. Raises InputError if
        widths differ then, or if no tie point can be projected into two views.
        """
        if line is None:
            widths = {view.size[0] for view in views}
            if len(widths) > 1:
                raise InputError(f"{name}: images of {', '.join(map(str, sorted(widths)))} columns are not of one line")
            line = Line(widths.pop(), np.zeros(len(views)), np.zeros(len(views)))
        places = ground[tracks.point]
        image, by_ground = Several(sensors, tracks.view).project_jacobian(places)
        known = np.isfinite(image).all(axis=1) & np.isfinite(by_ground).all(axis=(1, 2))
        kept = known & (np.bincount(tracks.point[known], minlength=tracks.num_points)[tracks.point] >= 2)
        if not kept.any():
            raise InputError(f"{name}: no tie point has a place in two images")
        view, xy = tracks.view[kept], tracks.xy[kept]
        by_point = by_ground[kept] @ np.linalg.inv(ecef_from_ground_jacobian(places[kept]))
        place = (2.0 * image[kept] + 1.0) / np.array([view.size for view in views])[view] - 1.0
        dates = sorted(view.date for view in views if view.date)
        point = np.unique(tracks.point[kept], return_inverse=True)[1]
        number, used = np.unique(view, return_inverse=True)
        first, col = dates[0] if dates else "", xy[:, 0] + line.start[view]
        return cls(name, first, line.width, used, point, col, place, image[kept] - xy, by_point, line.loose[number])

    def moved(self, by: Array) -> SensorTies:
        """Return the tie points with views shifted on the line `by` (V,) [px]."""
        return replace(self, col=self.col + by[self.view])


@dataclass(frozen=True, eq=False)
class Line:
    """A line of `width` columns, the column (N,) at which each view begins, and the sigma (N,) of that [px]."""

    width: int
    start: Array
    loose: Array


class _Eliminated:
    """Linearised observations of a block, with weights (K,) [1/px], points and nuisances eliminated."""

    def __init__(self, ties: SensorTies, residual: Array, weight: Array) -> None:
        count, self.num_points, self.num_views = len(ties.view), ties.point.max() + 1, ties.view.max() + 1
        by_point = ties.by_point * weight[:, None, None]
        square = np.einsum("kij,kil->kjl", by_point, by_point).reshape(count, 9)
        sums = np.stack([np.bincount(ties.point, part, self.num_points) for part in square.T], axis=1)
        matrix = sums.reshape(-1, 3, 3)
        matrix += ROUNDING * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        lower = np.linalg.cholesky(matrix)[ties.point]
        points = np.linalg.solve(lower, np.swapaxes(by_point, 1, 2))
        self._points = _rows(np.swapaxes(points, 1, 2), 3 * ties.point[:, None] + np.arange(3), 3 * self.num_points)
        col, row = ties.place.T
        terms = np.stack([np.ones(count), col, row, col * row, row**2], axis=1)
        self.weight = weight
        each = terms.shape[1]
        self._nuisances = self.derivatives(terms, 2 * each * ties.view[:, None] + np.arange(each), each, self.num_views)
        self._residual = (residual * weight[:, None]).ravel()
        loose = sp.eye_array(self._nuisances.shape[1]) / _NUISANCE_SIGMA**2
        normal = (self.product(self._nuisances) + loose).tocsc()
        self._solve = splu(normal, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve
        self._half = self.gradient(self._nuisances)

    def derivatives(self, values: Array, place: IntArray, apart: int, times: int = 1) -> sp.csr_array:
        """Return weighted derivatives (2 K, 2 `apart` `times`) of both coordinates by `times` groups of unknowns.

        Those of col are the `values` (K, m) at indices `place` (K, m); those of row have indices larger by `apart`.
        """
        columns = np.stack([place, place + apart], axis=1)
        return _rows(np.repeat((values * self.weight[:, None])[:, None], 2, axis=1), columns, 2 * apart * times)

    def product(self, first: sp.csr_array, other: sp.csr_array | None = None) -> sp.csr_array:
        """Return the normal matrix of one or two sets of unknowns, with the points eliminated."""
        of_points = self._points.T @ first
        by_other = of_points if other is None else self._points.T @ other
        found: sp.csr_array = first.T @ (first if other is None else other) - of_points.T @ by_other
        return found

    def gradient(self, one: sp.csr_array) -> Array:
        """Return the gradient of half the cost by the unknowns, with the points eliminated."""
        return np.asarray(one.T @ self._off_points(self._residual))

    def _off_points(self, residual: Array) -> Array:
        return np.asarray(residual - self._points @ (self._points.T @ residual))

    def residuals(self) -> Array:
        """Return the residuals (K, 2) [px] at the best points and nuisances."""
        moved = self._residual - self._nuisances @ self._solve(self._half)
        return self._off_points(moved).reshape(-1, 2) / self.weight[:, None]

    def cost(self, residual: Array) -> float:
        """Return the cost with other residuals (K, 2) [px], at the best points and nuisances."""
        whitened = (residual * self.weight[:, None]).ravel()
        off = self._off_points(whitened)
        half = self._nuisances.T @ off
        return float(off @ off - half @ self._solve(half))

    def equations(self, unknowns: sp.csr_array) -> Told:
        """Return the normal equations of the unknowns with these derivatives (2 K, n)."""
        cross = self.product(self._nuisances, unknowns).toarray()
        solved = self._solve(np.column_stack([cross, self._half]))
        off = self._off_points(self._residual)
        return Told(
            self.product(unknowns).toarray() - cross.T @ solved[:, :-1],
            self.gradient(unknowns) - cross.T @ solved[:, -1],
            float(off @ off - self._half @ solved[:, -1]),
            float(self._residual.size - 3 * self.num_points - self._nuisances.shape[1]),
        )


def _rows(values: Array, columns: IntArray, size: int) -> sp.csr_array:
    """Return the sparse matrix (2 K, size) with values (K, 2, m) at columns (K, m) or (K, 2, m)."""
    columns = np.broadcast_to(columns if columns.ndim == 3 else columns[:, None], values.shape)
    bounds = np.arange(0, values.size + 1, values.shape[2])
    return sp.csr_array((values.ravel(), columns.ravel(), bounds), shape=(2 * len(values), size))


@dataclass(frozen=True, eq=False)
class Told:
    """Normal equations of a sensor's curve, (n, n) and (n,), the cost without the curve, and the degrees of freedom."""

    matrix: Array
    gradient: Array
    cost: float
    freedom: float

    def __add__(self, other: Told) -> Told:
        return Told(
            self.matrix + other.matrix,
            self.gradient + other.gradient,
            self.cost + other.cost,
            self.freedom + other.freedom,
        )

    def times(self, factor: float) -> Told:
        """Return the equations with all weights (1 / variance) multiplied by `factor`."""
        return replace(self, matrix=self.matrix * factor, gradient=self.gradient * factor, cost=self.cost * factor)

    def without(self, one: Told) -> Told:
        """Return the equations, a sum over blocks, without one of these."""
        return self + replace(one.times(-1.0), freedom=-one.freedom)

    def by_steps(self, curve: LineCurve) -> Told:
        """Return the equations by splines and steps, from those by splines and detectors."""
        change = la.block_diag(*2 * [curve.by_detector])
        return replace(self, matrix=change.T @ self.matrix @ change, gradient=change.T @ self.gradient)

    def part(self, index: IntArray) -> Told:
        """Return the equations of the unknowns `index`, the others being 0."""
        return replace(self, matrix=self.matrix[np.ix_(index, index)], gradient=self.gradient[index])

    def solved(self, prior: Array) -> tuple[Array, Array, float]:
        """Return the unknowns (n,), their covariance (n, n), and the log evidence [nats]; `prior` is information."""
        factor = la.cho_factor(self.matrix + prior)
        found = -la.cho_solve(factor, self.gradient)
        log_volume = np.log(np.diag(factor[0])).sum() - 0.5 * np.linalg.slogdet(prior)[1]
        return found, la.cho_solve(factor, np.eye(len(found))), float(-0.5 * self.gradient @ found - log_volume)

    def gain(self, unknowns: Array) -> float:
        """Return the decrease of the cost by unknowns (n,)."""
        return float(-(2.0 * self.gradient + self.matrix @ unknowns) @ unknowns)


def normal_equations(curve: LineCurve, ties: SensorTies, weight: Array) -> Told:
    """Return the normal equations of splines and detectors of a block, with weights (K,) [1/px]."""
    block, (values, place) = _Eliminated(ties, ties.residual, weight), curve.local(ties.col)
    return block.equations(block.derivatives(values, place, curve.size + 1))


def _weights(ties: SensorTies, curve: ColumnSpline | None) -> Array:
    """Return the robust weights (K,) [1/px] of the observations of a block, from residuals at the current curve."""
    residual = ties.residual if curve is None else ties.residual + curve.at(ties.col)
    count = np.bincount(ties.point)[ties.point]
    redundancy = (2.0 * count - 3.0) / (2.0 * count)  # redundancy: a point has three unknowns
    adjusted, weight = residual - np.median(residual, axis=0), np.ones(len(count))
    for _ in range(BACKFITTING):
        length = np.linalg.norm(adjusted, axis=1) / np.sqrt(2.0 * redundancy)
        spread = max(robust_spread(length), 1e-6)
        # full weight up to there: a smoother loss would give less weight to observations that contradict the current
        # curve, and each pass would keep a third of its error
        weight = np.minimum(1.0, CRITICAL * spread / np.maximum(length, 1e-9)) ** 2
        adjusted = _Eliminated(ties, residual, weight).residuals()
    noise = np.sqrt((weight**2 * (adjusted**2).sum(axis=1)).sum() / (weight**2 * 2.0 * redundancy).sum())
    return np.asarray(weight / max(noise, _BEST_NOISE))


# --- the curve from many blocks ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Learnt:
    """A sensor's curve, and tests of the agreement between blocks.

    Parameters
    ----------
    curve : LineCurve, layout of the unknowns
    unknowns, covariance : (n,), (n, n), without constant and slope
    gain : (R,), decrease of the cost of each block by the curve of the other blocks, in variances of its noise
    rms : (float, float), ratio of residuals to noise per degree of freedom, without and with the curve of other blocks
    noise_px : float, median noise of the blocks [px]
    scatter : float, ratio of the variance between blocks to that expected from their noise
    change : (int, float), number of blocks before the most probable change of the curve in time, and log evidence of a
        change against none [nats]
    shifts, shift_sigmas : for each block (V,), shifts of its views on the line from the given positions [px]
    """

    curve: LineCurve
    unknowns: Array
    covariance: Array
    gain: Array
    rms: tuple[float, float]
    noise_px: float
    scatter: float
    change: tuple[int, float]
    shifts: tuple[Array, ...] = ()
    shift_sigmas: tuple[Array, ...] = ()

    @property
    def spline(self) -> ColumnSpline:
        """The image correction."""
        return self.curve.spline(self.unknowns)


def learn(blocks: Sequence[SensorTies]) -> Learnt:
    """Estimate the curve of a sensor from blocks in the order of time.

    Raises
    ------
    InputError
        Less than three blocks, or lines of different widths.
    """
    widths = {block.width for block in blocks}
    if len(blocks) < 3 or len(widths) > 1:
        raise InputError(f"{len(blocks)} blocks of images of {len(widths)} widths: three of one are needed at least")
    width = widths.pop()
    curve, bend, weights, spline = _fit_curve(blocks, width, None)
    shifts, sigmas = [np.zeros(len(block.loose)) for block in blocks], [np.zeros(len(block.loose)) for block in blocks]
    for _ in range(STEPS if any(block.loose.any() for block in blocks) else 0):
        placed = [_fit_positions(*one, spline) for one in zip(blocks, shifts, weights, strict=True)]
        shifts, sigmas = [one[0] for one in placed], [one[1] for one in placed]
        moved = [block.moved(by) for block, by in zip(blocks, shifts, strict=True)]
        curve, bend, weights, spline = _fit_curve(moved, width, spline)
    blocks = [block.moved(by) for block, by in zip(blocks, shifts, strict=True)]
    equations = [normal_equations(curve, *one).by_steps(curve) for one in zip(blocks, weights, strict=True)]
    noise = float(np.median([1.0 / one.max() for one in weights]))
    found = _cross_validated(curve, equations, curve.prior(bend), noise)
    return replace(found, shifts=tuple(shifts), shift_sigmas=tuple(sigmas))


def _fit_curve(
    blocks: Sequence[SensorTies], width: int, spline: ColumnSpline | None
) -> tuple[LineCurve, float, list[Array], ColumnSpline]:
    """Return the layout of the curve, the sigma of its third differences, the weights of the observations of each block
    at the previous curve, and the new curve. `spline` is the curve to start with, if there is one.
    """
    spacing, bend = width / _CANDIDATES, float(_ROUGHNESS[len(_ROUGHNESS) // 2])
    places = np.arange(1, _CANDIDATES) * spacing
    for turn in range(STEPS):
        candidates = LineCurve(width, np.unique(np.round(places)) - 0.5)
        weights = [_weights(block, spline) for block in blocks]
        total = reduce(add, (normal_equations(candidates, *one) for one in zip(blocks, weights, strict=True))).by_steps(
            candidates
        )
        chosen, bend = _select_steps(total, candidates)
        chosen.sort()
        curve = LineCurve(width, candidates.edges[chosen])
        own = np.r_[:LINE_SPLINES, LINE_SPLINES + np.array(chosen, dtype=np.int64)]
        spline = curve.spline(total.part(np.r_[own, candidates.size + own]).solved(curve.prior(bend))[0])
        if turn + 1 < STEPS:
            around = np.arange(-1.5 * _FINER, 1.5 * _FINER + 1) * max(spacing / _FINER, 1.0)
            places = (curve.edges[:, None] + 0.5 + around).clip(1.0, width - 1.0).ravel()
            spacing = max(spacing / _FINER, 1.0)
    assert spline is not None
    return curve, bend, weights, spline


def _fit_positions(ties: SensorTies, shift: Array, weight: Array, spline: ColumnSpline) -> tuple[Array, Array]:
    """Return the shifts (V,) [px] with which the loose views of a block fit a curve best, and their sigmas (V,) [px].

    Each view is tried at positions within `CRITICAL` sigmas, then at finer ones around the best. The views take
    turns, as they have points in common. `shift` are the start values.
    """
    shift, sigma = shift.copy(), np.zeros(len(shift))
    if not ties.loose.any():
        return shift, sigma
    block = _Eliminated(ties, ties.residual, weight)
    for _ in range(STEPS):
        for v in np.flatnonzero(ties.loose).tolist():
            middle, reach, sigma[v] = 0.0, CRITICAL * ties.loose[v], 0.0
            for _ in range(STEPS):  # in the end a 4000th of the first reach
                tried = middle + np.linspace(-reach, reach, _POSITIONS)
                at = np.tile(shift, (_POSITIONS, 1))
                at[:, v] = tried
                cost = np.array([block.cost(ties.residual + spline.at(ties.col + one[ties.view])) for one in at])
                cost += (tried / ties.loose[v]) ** 2
                best = int(np.argmin(cost))
                spread = np.ptp(tried[cost <= cost[best] + 4.0]) / 4.0  # a cost larger by 4: two standard deviations
                middle, reach = float(tried[best]), 4.0 * reach / (_POSITIONS - 1)
                shift[v], sigma[v] = middle, max(spread, sigma[v])  # a finer range may be narrower than this
    return shift, sigma


def _select_steps(total: Told, curve: LineCurve) -> tuple[list[int], float]:
    """Return the candidate steps and the sigma of third differences with the largest evidence."""
    found = [_forward_selection(total, curve, float(bend)) for bend in _ROUGHNESS]
    best = max(range(len(found)), key=lambda i: found[i][1])
    return found[best][0], float(_ROUGHNESS[best])


def _forward_selection(total: Told, curve: LineCurve, bend: float) -> tuple[list[int], float]:
    """Return steps added one by one while each raises the log evidence by `SURE`, and the log evidence [nats]."""
    size, count = curve.size, len(curve.edges)
    smooth = np.r_[0:LINE_SPLINES, size : size + LINE_SPLINES]
    steps = np.r_[LINE_SPLINES:size, size + LINE_SPLINES : 2 * size]
    prior = curve.prior(bend)[np.ix_(smooth, smooth)]
    alone = Told(total.matrix[np.ix_(smooth, smooth)], total.gradient[smooth], 0.0, 0.0)
    (found, _, evidence), cross = alone.solved(prior), total.matrix[np.ix_(smooth, steps)]
    matrix = total.matrix[np.ix_(steps, steps)] - cross.T @ la.solve(alone.matrix + prior, cross, assume_a="pos")
    gradient, chosen, pairs = total.gradient[steps] + cross.T @ found, list[int](), np.arange(count)
    while count and len(chosen) < _MOST_STEPS:
        of_steps = np.stack([pairs, pairs + count], axis=1)
        blocks = matrix[of_steps[:, :, None], of_steps[:, None, :]] + np.eye(2) / FIRST_SIGMA**2
        pull = gradient[of_steps]
        gains = 0.5 * np.einsum("ni,ni->n", pull, np.linalg.solve(blocks, pull[..., None])[..., 0])
        gains -= 0.5 * np.linalg.slogdet(blocks * FIRST_SIGMA**2)[1] + np.log(count)
        best = int(np.argmax(gains))
        if not gains[best] > SURE:
            break
        chosen.append(best)
        evidence += float(gains[best])
        weights = np.linalg.solve(blocks[best], matrix[of_steps[best]])
        gradient = gradient - weights.T @ pull[best]
        matrix = matrix - matrix[:, of_steps[best]] @ weights
    return chosen, evidence


def _cross_validated(curve: LineCurve, equations: Sequence[Told], prior: Array, noise: float) -> Learnt:
    """Return the curve with its tests of agreement between blocks."""
    at, halves = _split_in_time(equations, prior)
    scatter = _scatter(equations, [halves[int(i >= at)] for i in range(len(equations))], prior)
    equations = [one.times(1.0 / scatter) for one in equations]
    total = reduce(add, equations)
    found, covariance, evidence = total.solved(prior)
    sides = [reduce(add, part).solved(prior)[2] for part in (equations[:at], equations[at:])]
    change = at, sum(sides) - evidence - float(np.log(len(equations)))
    others = [total.without(one).solved(prior)[0] for one in equations]
    gain = np.array([one.gain(other) for one, other in zip(equations, others, strict=True)])
    freedom = sum(one.freedom for one in equations)
    rms = tuple(float(np.sqrt(max(scatter * cost, 0.0) / freedom)) for cost in (total.cost, total.cost - gain.sum()))
    bent = curve.bent
    return Learnt(curve, bent @ found, bent @ covariance @ bent.T, gain, (rms[0], rms[1]), noise, scatter, change)


_Solved = tuple[Array, Array]
"""A curve (n,), and its covariance (n, n)."""


def _split_in_time(equations: Sequence[Told], prior: Array) -> tuple[int, tuple[_Solved, _Solved]]:
    """Return the split of the blocks by time with the largest evidence, and the curves of both parts."""
    none, total = (np.zeros(0), np.zeros(0)), reduce(add, equations)
    best = -np.inf, 1, (none, none)
    for at, before in enumerate(accumulate(equations[:-1], add), 1):
        (*first, one), (*second, other) = (part.solved(prior) for part in (before, total.without(before)))
        best = max(best, (one + other, at, (tuple(first), tuple(second))), key=lambda row: row[0])
    return best[1:]


def _scatter(equations: Sequence[Told], curves: Sequence[_Solved], prior: Array) -> float:
    """Return the ratio of the variance of the gradients of blocks, at the curves of their periods, to that by noise."""
    seen = expected = 0.0
    for one, (curve, covariance) in zip(equations, curves, strict=True):
        factor = la.cho_factor(one.matrix + prior)
        pull = one.gradient + one.matrix @ curve
        seen += float(pull @ la.cho_solve(factor, pull))
        expected += float(np.trace(la.cho_solve(factor, one.matrix - one.matrix @ covariance @ one.matrix)))
    return max(seen / max(expected, 1.0), ROUNDING)


def share_shown(ties: SensorTies, spline: ColumnSpline) -> tuple[float, float]:
    """Return the share of a curve that the tie points of a block show (1: all of it), and its standard deviation."""
    block = _Eliminated(ties, ties.residual, _weights(ties, spline))
    shown = spline.at(ties.col)
    rows = (shown * block.weight[:, None]).reshape(-1, 1)
    one = block.equations(sp.csr_array(rows))
    information = max(float(one.matrix[0, 0]), ROUNDING)
    return float(-one.gradient[0] / information), float(information**-0.5)


def contradicts(shown: float, sigma: float) -> bool:
    """Return whether tie points that show this share of a curve contradict it."""
    return shown < _LEAST_SHARE and 1.0 - shown > CRITICAL * sigma
