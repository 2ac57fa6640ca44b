"""Interior distortion and detector steps of one sensor, from the tie points of many finished blocks.

The detector line of a pushbroom stands in the same columns of all its images: x = P(X) + c(col), where c is a spline
of the column with steps where another detector begins. One block does not tell c along its epipolar lines; blocks of
other directions do. Every view has nuisances, 1, col, row, col row and row^2 of either coordinate, the effects of
rotations, drifts and orbits. c has no constant and no slope: a camera's correction absorbs them. A focal scale or a
line rate that all images share scales the ground with them, and tie points alone do not determine it.

Points are eliminated, then nuisances: every block leaves normal equations of c. Tests on blocks left out, or on those
before and after a day, are sums of these.
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

from barpc.ba.interior import LINE_SPLINES, STEP_SIGMA, LineCurve
from barpc.base.errors import InputError
from barpc.base.geodesy import Array, ecef_from_ground_jacobian
from barpc.base.statistics import BACKFITTING, CRITICAL, ROUNDING, STEPS, SURE, robust_spread
from barpc.scene import IntArray, Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.geometry import Several
from barpc.sensor.image_corrections import ColumnSpline

_ROUGHNESS = 10.0 ** np.arange(-4.0, 0.5, 0.5)  # px: standard deviations of third differences that are compared
_CANDIDATES = 128  # places of a step that are looked at first; each turn looks at `_FINER` times as many around it
_FINER = 12
_PLACES = 65  # of a view on the line, over three standard deviations either way, then over a sixteenth of that
_MOST_STEPS = 40  # taken one by one; focal planes have up to some thirty detectors
_NUISANCES = 5  # nuisances of a coordinate of a view
_LOOSE = 100.0  # px: standard deviation of nuisances, some of which a block does not determine
_BEST_NOISE = 2e-3  # px: no tie points are better, whatever they say of each other
# standard deviations up to which tie points count alike: were they weighted by size, what contradicts the curve so far
# would count less, and a turn would keep a third of its error
_CUT = 3.0
_SHOWN = 0.75  # of a curve, by a block of its sensor: halfway from 1 to 0.5, where it harms as much as it helps


@dataclass(frozen=True, eq=False)
class SensorTies:
    """Tie points of a finished block, seen by one sensor, linearised at its cameras without corrections in the image.

    Parameters
    ----------
    name, date : str, the block; its first day (ISO 8601), empty where not stated
    width : int, columns of the line
    view, point : (K,), indices
    col : (K,), column of the line in which a point is seen [px]
    place : (K, 2), where its camera has it, from -1 to 1 over the image: what is weakly known takes the noise of places
        for information
    residual : (K, 2), projected - observed [px]
    by_point : (K, 2, 3), derivative of the projection by the point, ECEF [px/m]
    loose : (V,), standard deviation of the place of each view on the line [px], 0: known
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
        """Linearise a block at cameras without corrections in the image, and at the tracks' ground points (P, 3) [deg].

        `line`: its columns and where the views' lie on it; without, each view is the whole line. InputError where
        widths differ then, or less than two views of a tie point have a place.
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
        """Return the same with views that lie elsewhere on the line, by (V,) [px]."""
        return replace(self, col=self.col + by[self.view])


@dataclass(frozen=True, eq=False)
class Line:
    """Columns of a line, places of views on it (N,), each the column of its first one, and their sigmas (N,) [px]."""

    width: int
    start: Array
    loose: Array


class _Eliminated:
    """A block, weighted by (K,) [1/px], with points and nuisances eliminated."""

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
        self._nuisances = self.both(
            terms, 2 * _NUISANCES * ties.view[:, None] + np.arange(_NUISANCES), _NUISANCES, self.num_views
        )
        self._residual = (residual * weight[:, None]).ravel()
        loose = sp.eye_array(self._nuisances.shape[1]) / _LOOSE**2
        normal = (self.product(self._nuisances) + loose).tocsc()
        self._solve = splu(normal, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve
        self._half = self.gradient(self._nuisances)

    def both(self, values: Array, place: IntArray, apart: int, times: int = 1) -> sp.csr_array:
        """Return the derivatives (2 K, 2 `apart` `times`), weighted, of both coordinates by unknowns: of the columns
        values (K, m) at `place`, of the rows `apart` behind.
        """
        columns = np.stack([place, place + apart], axis=1)
        return _rows(np.repeat((values * self.weight[:, None])[:, None], 2, axis=1), columns, 2 * apart * times)

    def product(self, one: sp.csr_array, other: sp.csr_array | None = None) -> sp.csr_array:
        """Return the normal matrix of two sets of unknowns with the points eliminated."""
        of_points = self._points.T @ one
        by_other = of_points if other is None else self._points.T @ other
        found: sp.csr_array = one.T @ (one if other is None else other) - of_points.T @ by_other
        return found

    def gradient(self, one: sp.csr_array) -> Array:
        """Return the derivative of half the cost by unknowns, the points eliminated."""
        return np.asarray(one.T @ self._off_points(self._residual))

    def _off_points(self, residual: Array) -> Array:
        return np.asarray(residual - self._points @ (self._points.T @ residual))

    def left(self) -> Array:
        """Return the residuals (K, 2) [px] that points and nuisances leave."""
        moved = self._residual - self._nuisances @ self._solve(self._half)
        return self._off_points(moved).reshape(-1, 2) / self.weight[:, None]

    def cost(self, residual: Array) -> float:
        """Return the cost of residuals (K, 2) [px] in place of its own, points and nuisances eliminated."""
        whitened = (residual * self.weight[:, None]).ravel()
        off = self._off_points(whitened)
        half = self._nuisances.T @ off
        return float(off @ off - half @ self._solve(half))

    def told(self, unknowns: sp.csr_array) -> Told:
        """Return the block's normal equations of the unknowns."""
        cross = self.product(self._nuisances, unknowns).toarray()
        solved = self._solve(np.column_stack([cross, self._half]))
        off = self._off_points(self._residual)
        return Told(
            self.product(unknowns).toarray() - cross.T @ solved[:, :-1],
            self.gradient(unknowns) - cross.T @ solved[:, -1],
            float(off @ off - self._half @ solved[:, -1]),
            float(self._residual.size - 3 * self.num_points - 2 * _NUISANCES * self.num_views),
        )


def _rows(values: Array, columns: IntArray, size: int) -> sp.csr_array:
    """Return a sparse matrix (2 K, size) of values (K, 2, m) at columns (K, m) or (K, 2, m)."""
    columns = np.broadcast_to(columns if columns.ndim == 3 else columns[:, None], values.shape)
    bounds = np.arange(0, values.size + 1, values.shape[2])
    return sp.csr_array((values.ravel(), columns.ravel(), bounds), shape=(2 * len(values), size))


@dataclass(frozen=True, eq=False)
class Told:
    """Normal equations of a sensor's curve, (n, n) and (n,); its cost without one, and degrees of freedom."""

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
        """Return the same with another variance of the noise."""
        return replace(self, matrix=self.matrix * factor, gradient=self.gradient * factor, cost=self.cost * factor)

    def without(self, one: Told) -> Told:
        """Return the sum without one of its blocks."""
        return self + replace(one.times(-1.0), freedom=-one.freedom)

    def by_steps(self, curve: LineCurve) -> Told:
        """Return the equations of splines and steps instead of those of splines and detectors."""
        change = la.block_diag(*2 * [curve.by_detector])
        return replace(self, matrix=change.T @ self.matrix @ change, gradient=change.T @ self.gradient)

    def part(self, index: IntArray) -> Told:
        """Return the equations of some of the unknowns, the others 0."""
        return replace(self, matrix=self.matrix[np.ix_(index, index)], gradient=self.gradient[index])

    def solved(self, prior: Array) -> tuple[Array, Array, float]:
        """Return the unknowns (n,), their covariance (n, n), and how probable that makes the data [nats]."""
        factor = la.cho_factor(self.matrix + prior)
        found = -la.cho_solve(factor, self.gradient)
        lost = np.log(np.diag(factor[0])).sum() - 0.5 * np.linalg.slogdet(prior)[1]
        return found, la.cho_solve(factor, np.eye(len(found))), float(-0.5 * self.gradient @ found - lost)

    def gain(self, unknowns: Array) -> float:
        """Return the reduction of the cost by unknowns (n,)."""
        return float(-(2.0 * self.gradient + self.matrix @ unknowns) @ unknowns)


def normal_equations(curve: LineCurve, ties: SensorTies, weight: Array) -> Told:
    """Return a block's normal equations of splines and detectors, its observations weighted by (K,) [1/px]."""
    block, (values, place) = _Eliminated(ties, ties.residual, weight), curve.local(ties.col)
    return block.told(block.both(values, place, curve.size + 1))


def _weights(ties: SensorTies, curve: ColumnSpline | None) -> Array:
    """Return the weights (K,) [1/px] of a block's observations by their residuals at the present curve."""
    residual = ties.residual if curve is None else ties.residual + curve.at(ties.col)
    count = np.bincount(ties.point)[ties.point]
    free = (2.0 * count - 3.0) / (2.0 * count)  # of a track's coordinates three go into its point
    left, weight = residual - np.median(residual, axis=0), np.ones(len(count))
    for _ in range(BACKFITTING):
        off = np.linalg.norm(left, axis=1) / np.sqrt(2.0 * free)
        spread = max(robust_spread(off), 1e-6)
        weight = np.minimum(1.0, _CUT * spread / np.maximum(off, 1e-9)) ** 2
        left = _Eliminated(ties, residual, weight).left()
    noise = np.sqrt((weight**2 * (left**2).sum(axis=1)).sum() / (weight**2 * 2.0 * free).sum())
    return np.asarray(weight / max(noise, _BEST_NOISE))


# --- what many blocks tell --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Learnt:
    """A sensor's curve, and how far blocks agree on it.

    Parameters
    ----------
    curve : LineCurve, its layout
    unknowns, covariance : (n,), (n, n), without a constant and a slope
    gain : (R,), what the curve of the other blocks takes off each block's cost, in variances of its noise
    rms : (float, float), of blocks' residuals a degree of freedom over their noise, without and with that curve
    noise_px : float, the median of the blocks' noise [px]
    scatter : float, variance of blocks against each other over what their noise says
    change : (int, float), first of the blocks, in the order given, after which the curve may be another one, and how
        much more probable that is than that it stays [nats]
    shifts, shift_sigmas : of each block (V,), how far its views lie on the line from where they were stated to [px]
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
        """The correction."""
        return self.curve.spline(self.unknowns)


def learn(blocks: Sequence[SensorTies]) -> Learnt:
    """Learn the curve of a sensor from blocks in the order of time.

    Raises
    ------
    InputError
        Less than three blocks, or of images of other widths.
    """
    widths = {block.width for block in blocks}
    if len(blocks) < 3 or len(widths) > 1:
        raise InputError(f"{len(blocks)} blocks of images of {len(widths)} widths: three of one are needed at least")
    width = widths.pop()
    curve, bend, weights, spline = _shape(blocks, width, None)
    shifts, sigmas = [np.zeros(len(block.loose)) for block in blocks], [np.zeros(len(block.loose)) for block in blocks]
    for _ in range(STEPS if any(block.loose.any() for block in blocks) else 0):
        placed = [_placed(*one, spline) for one in zip(blocks, shifts, weights, strict=True)]
        shifts, sigmas = [one[0] for one in placed], [one[1] for one in placed]
        moved = [block.moved(by) for block, by in zip(blocks, shifts, strict=True)]
        curve, bend, weights, spline = _shape(moved, width, spline)
    blocks = [block.moved(by) for block, by in zip(blocks, shifts, strict=True)]
    told = [normal_equations(curve, *one).by_steps(curve) for one in zip(blocks, weights, strict=True)]
    found = _judged(curve, told, curve.prior(bend), float(np.median([1.0 / one.max() for one in weights])))
    return replace(found, shifts=tuple(shifts), shift_sigmas=tuple(sigmas))


def _shape(
    blocks: Sequence[SensorTies], width: int, spline: ColumnSpline | None
) -> tuple[LineCurve, float, list[Array], ColumnSpline]:
    """Return the layout of the curve of some blocks, the size of its third differences, the weights of the blocks'
    observations at a curve so far, and the new curve.
    """
    spacing, bend = width / _CANDIDATES, float(_ROUGHNESS[len(_ROUGHNESS) // 2])
    places = np.arange(1, _CANDIDATES) * spacing
    for turn in range(STEPS):
        candidates = LineCurve(width, np.unique(np.round(places)) - 0.5)
        weights = [_weights(block, spline) for block in blocks]
        total = reduce(add, (normal_equations(candidates, *one) for one in zip(blocks, weights, strict=True))).by_steps(
            candidates
        )
        chosen, bend = _best(total, candidates)
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


def _placed(ties: SensorTies, shift: Array, weight: Array, spline: ColumnSpline) -> tuple[Array, Array]:
    """Return where the loose views of a block fit a curve best, from their places by a shift (V,) [px], and the
    standard deviation of that (V,) [px].

    Each view is tried at places over three standard deviations, then at finer ones around the best; views of a block
    take turns, as they have points in common.
    """
    shift, sigma = shift.copy(), np.zeros(len(shift))
    if not ties.loose.any():
        return shift, sigma
    block = _Eliminated(ties, ties.residual, weight)
    for _ in range(STEPS):
        for v in np.flatnonzero(ties.loose).tolist():
            middle, reach, sigma[v] = 0.0, 3.0 * ties.loose[v], 0.0
            for _ in range(STEPS):  # to a 4000th of the first reach
                tried = middle + np.linspace(-reach, reach, _PLACES)
                at = np.tile(shift, (_PLACES, 1))
                at[:, v] = tried
                cost = np.array([block.cost(ties.residual + spline.at(ties.col + one[ties.view])) for one in at])
                cost += (tried / ties.loose[v]) ** 2
                best = int(np.argmin(cost))
                near = np.ptp(tried[cost <= cost[best] + 4.0]) / 4.0  # four more: two standard deviations
                middle, reach = float(tried[best]), 4.0 * reach / (_PLACES - 1)
                shift[v], sigma[v] = middle, max(near, sigma[v])  # a finer level may end within it
    return shift, sigma


def _best(total: Told, curve: LineCurve) -> tuple[list[int], float]:
    """Return which steps to take, and the size of third differences, that make the data most probable."""
    found = [_forward(total, curve, float(bend)) for bend in _ROUGHNESS]
    best = max(range(len(found)), key=lambda i: found[i][1])
    return found[best][0], float(_ROUGHNESS[best])


def _forward(total: Told, curve: LineCurve, bend: float) -> tuple[list[int], float]:
    """Return the steps that are taken one by one while each makes the data clearly more probable, and how probable."""
    size, count = curve.size, len(curve.edges)
    smooth = np.r_[0:LINE_SPLINES, size : size + LINE_SPLINES]
    steps = np.r_[LINE_SPLINES:size, size + LINE_SPLINES : 2 * size]
    prior = curve.prior(bend)[np.ix_(smooth, smooth)]
    alone = Told(total.matrix[np.ix_(smooth, smooth)], total.gradient[smooth], 0.0, 0.0)
    (found, _, evidence), cross = alone.solved(prior), total.matrix[np.ix_(smooth, steps)]
    matrix = total.matrix[np.ix_(steps, steps)] - cross.T @ la.solve(alone.matrix + prior, cross, assume_a="pos")
    gradient, chosen, pairs = total.gradient[steps] + cross.T @ found, list[int](), np.arange(count)
    while count and len(chosen) < _MOST_STEPS:
        own = np.stack([pairs, pairs + count], axis=1)
        blocks = matrix[own[:, :, None], own[:, None, :]] + np.eye(2) / STEP_SIGMA**2
        pull = gradient[own]
        gains = 0.5 * np.einsum("ni,ni->n", pull, np.linalg.solve(blocks, pull[..., None])[..., 0])
        gains -= 0.5 * np.linalg.slogdet(blocks * STEP_SIGMA**2)[1] + np.log(count)
        best = int(np.argmax(gains))
        if not gains[best] > SURE:
            break
        chosen.append(best)
        evidence += float(gains[best])
        down = np.linalg.solve(blocks[best], matrix[own[best]])
        gradient = gradient - down.T @ pull[best]
        matrix = matrix - matrix[:, own[best]] @ down
    return chosen, evidence


def _judged(curve: LineCurve, told: Sequence[Told], prior: Array, noise: float) -> Learnt:
    """Return the curve with its tests between blocks."""
    at, halves = _split(told, prior)
    scatter = _between_blocks(told, [halves[int(i >= at)] for i in range(len(told))], prior)
    told = [one.times(1.0 / scatter) for one in told]
    total = reduce(add, told)
    found, covariance, evidence = total.solved(prior)
    sides = [reduce(add, part).solved(prior)[2] for part in (told[:at], told[at:])]
    change = at, sum(sides) - evidence - float(np.log(len(told)))
    others = [total.without(one).solved(prior)[0] for one in told]
    gain = np.array([one.gain(other) for one, other in zip(told, others, strict=True)])
    freedom = sum(one.freedom for one in told)
    rms = tuple(float(np.sqrt(max(scatter * cost, 0.0) / freedom)) for cost in (total.cost, total.cost - gain.sum()))
    bent = curve.bent
    return Learnt(curve, bent @ found, bent @ covariance @ bent.T, gain, (rms[0], rms[1]), noise, scatter, change)


_Solved = tuple[Array, Array]
"""A curve (n,), and its covariance (n, n)."""


def _split(told: Sequence[Told], prior: Array) -> tuple[int, tuple[_Solved, _Solved]]:
    """Return the split of the blocks by time with the largest evidence, and the curves of both parts."""
    none, total = (np.zeros(0), np.zeros(0)), reduce(add, told)
    best = -np.inf, 1, (none, none)
    for at, before in enumerate(accumulate(told[:-1], add), 1):
        (*first, one), (*second, other) = (part.solved(prior) for part in (before, total.without(before)))
        best = max(best, (one + other, at, (tuple(first), tuple(second))), key=lambda row: row[0])
    return best[1:]


def _between_blocks(told: Sequence[Told], curves: Sequence[_Solved], prior: Array) -> float:
    """Return the variance of blocks' gradients over that of their noise, each at the curve of its part of the time."""
    seen = expected = 0.0
    for one, (curve, covariance) in zip(told, curves, strict=True):
        factor = la.cho_factor(one.matrix + prior)
        pull = one.gradient + one.matrix @ curve
        seen += float(pull @ la.cho_solve(factor, pull))
        expected += float(np.trace(la.cho_solve(factor, one.matrix - one.matrix @ covariance @ one.matrix)))
    return max(seen / max(expected, 1.0), ROUNDING)


def share_shown(ties: SensorTies, spline: ColumnSpline) -> tuple[float, float]:
    """Return how much of a curve the tie points of a block show, 1: all of it, and its standard deviation."""
    block = _Eliminated(ties, ties.residual, _weights(ties, spline))
    shown = spline.at(ties.col)
    rows = (shown * block.weight[:, None]).reshape(-1, 1)
    one = block.told(sp.csr_array(rows))
    information = max(float(one.matrix[0, 0]), ROUNDING)
    return float(-one.gradient[0] / information), float(information**-0.5)


def contradicts(shown: float, sigma: float) -> bool:
    """Return whether tie points that show so much of a curve contradict it."""
    return shown < _SHOWN and 1.0 - shown > CRITICAL * sigma
