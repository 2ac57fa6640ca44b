"""Priors on points: GCPs, a terrain, and heights for tracks that rays alone do not determine."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.constraints.terrain import (
    NUM_BENDS,
    RegularisedDem,
    Relief,
    Terrain,
    believe,
    relief_ratio,
    terrain_slopes,
)
from barpc.ba.parameters.priors import PointPrior
from barpc.ba.parameters.projected import Projected
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.structure import Structure
from barpc.base.errors import BarpcWarning
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef, parts
from barpc.base.options import AdjustOptions
from barpc.base.statistics import robust_spread
from barpc.scene import BoolArray, GroundPoints, IntArray, Reference
from barpc.sensor.curve import cross

FIRST_PLACED = NUM_BENDS
"""Errors in common in front of altimetry's own: a terrain's bends, or a terrain's and a reference's."""
DEM_BIAS = 20.0  # m, where none is stated
KNOWN_BIAS = 5.0  # m: the same, where it is known what its heights count from
MAX_INDEPENDENT_ERRORS = (
    25.0  # independent errors that those of a reference are worth together, at most: they resemble each other
)
_STAYS = 1.0  # m: rays of weak points tell heights to hundreds of metres (0.05 m under 0.01 degrees: 290 m)
_FLAT_SIGMA = 50.0  # m: least spread of altitudes that tracks held without a DEM are given


def _join_priors(priors: Sequence[PointPrior | None]) -> PointPrior | None:
    """Return one block of several that speak of different points, and share their errors; None where all are empty."""
    given = [prior for prior in priors if prior is not None and len(prior.index)]
    if not given:
        return None
    most = max(prior.common.shape[2] for prior in given)
    common = [np.pad(p.common, ((0, 0), (0, 0), (0, most - p.common.shape[2]))) for p in given]
    index, mean, rows = (np.concatenate([getattr(p, name) for p in given]) for name in ("index", "mean", "rows"))
    return PointPrior(index, mean, rows, np.concatenate(common))


def ground_control(gcps: GroundPoints, index: IntArray) -> PointPrior:
    """Return GCPs as priors on the points `index` (G,): east, north and up by their sigmas."""
    rows = enu_basis(gcps.lonlatalt) / gcps.sigma[..., None]
    return PointPrior(index, ecef_from_ground(gcps.lonlatalt), rows, np.zeros((len(index), 3, 0)))


def reference_control(reference: Reference, index: IntArray) -> PointPrior:
    """Return the points of a reference as priors on the points `index` (R,).

    What they share: the height and slopes of the terrain, as points held to it do, the orthoimage's own place, and
    that what was matched may stand above the terrain (houses, trees). A terrain's errors reach over many points: all
    of these are worth `MAX_INDEPENDENT_ERRORS` independent heights, at most.
    """
    sigma = reference.points.sigma * [1.0, 1.0, np.sqrt(max(len(index) / MAX_INDEPENDENT_ERRORS, 1.0))]
    alone = ground_control(replace(reference.points, sigma=sigma), index)
    common = np.zeros((len(index), 3, 6))
    common[:, 2, 0] = reference.bias[2] / sigma[:, 2]
    common[:, 2, 1:3] = _slopes(alone.mean, alone.mean) * (reference.bias[2] / sigma[:, 2:])
    common[:, 2, 5] = reference.points.sigma[:, 2] / sigma[:, 2]
    common[:, 0, 3], common[:, 1, 4] = reference.bias[0] / sigma[:, 0], reference.bias[1] / sigma[:, 1]
    return replace(alone, common=common)


def terrain_heights(
    points: Array,
    index: IntArray,
    terrain: Terrain,
    sigma: float,
    common_sigma: float,
    span: Array | None = None,
    level: BoolArray | None = None,
) -> PointPrior:
    """Return priors that hold points `index` (Q,) of (P, 3) to a terrain: their height above its tangent
    plane.

    Single altitudes are known to `sigma` [m]; all of them may be wrong by `common_sigma` [m], and by a slope that
    is as much at the scene's edges. Points where the terrain is unknown are left out.
    The edges are the points' own, or those of `span` (n, 3) [m], with which they share these errors. Points that are
    `level` (Q,) are constrained in height alone.
    """
    ground = ground_from_ecef(points[index])
    alt = terrain(ground[:, 0], ground[:, 1])
    slopes = np.nan_to_num(terrain_slopes(terrain, ground))
    if level is not None:
        slopes[level] = 0.0
    normal = np.column_stack([-slopes, np.ones(len(alt))])
    return _heights(np.column_stack([ground[:, :2], alt]), index, normal, sigma, common_sigma, span)


def _believed_heights(ground: Array, index: IntArray, believed: RegularisedDem, common_sigma: Array) -> PointPrior:
    """Return the constraints of points `index` (Q,), at ground points (Q, 3), to a DEM of estimated accuracy.

    All of it may be wrong by a level, slopes and bends that are as much as `common_sigma` (`NUM_BENDS`,) [m] at the
    scene's edges.
    """
    normal, sigma = np.column_stack([-believed.slopes, np.ones(len(ground))]), believed.effective_sigma
    held = _heights(np.column_stack([ground[:, :2], believed.alt]), index, normal, sigma, 0.0)
    common = np.zeros((len(held.index), 3, NUM_BENDS))
    common[:, 0] = believed.bends[np.isfinite(believed.alt)] * (common_sigma / sigma)
    return replace(held, common=common)


def flat_heights(points: Array, index: IntArray, alt: float, sigma: float, common_sigma: float) -> PointPrior:
    """Return priors that hold points to one altitude [m]: each within `sigma`, all within `common_sigma` [m]."""
    ground = ground_from_ecef(points[index])
    ground[:, 2] = alt
    return _heights(ground, index, np.tile([0.0, 0.0, 1.0], (len(index), 1)), sigma, common_sigma)


def staying(points: Array, index: IntArray) -> PointPrior:
    """Return priors that hold points `index` (Q,) of (P, 3), ECEF [m], each to its present altitude."""
    ground = ground_from_ecef(points[index])
    return _heights(ground, index, np.tile([0.0, 0.0, 1.0], (len(index), 1)), _STAYS, 0.0)


def _heights(
    foot: Array, index: IntArray, normal: Array, sigma: float, common_sigma: float, span: Array | None = None
) -> PointPrior:
    known = np.isfinite(foot[:, 2])
    foot = foot[known]
    rows, common = np.zeros((len(foot), 3, 3)), np.zeros((len(foot), 3, 3))
    rows[:, 0] = np.einsum("qe,qex->qx", normal[known], enu_basis(foot)) / sigma
    common[:, 0, 0] = common_sigma / sigma
    mean = ecef_from_ground(foot)
    if len(foot):
        common[:, 0, 1:] = _slopes(mean, mean if span is None else span) * (common_sigma / sigma)
    return PointPrior(index[known], mean, rows, common)


def _slopes(points: Array, span: Array) -> Array:
    """Return the positions east and north of points (n, 3) in a scene, 1 at the edges of `span` (m, 3), ECEF [m]."""
    middle = span.mean(axis=0)
    enu = enu_basis(ground_from_ecef(middle))[:2]
    edge = np.abs((span - middle) @ enu.T).max(axis=0)
    return np.asarray((points - middle) @ enu.T / np.maximum(edge, 1.0))


def convergence_angles(structure: Structure, projected: Projected, points: Array) -> Array:
    """Return the convergence angle (P,) [rad] of each point's rays: twice the largest angle to their mean."""
    count, up = len(structure.point), np.ascontiguousarray(points.T)
    rays, apart = np.empty((3, count)), np.empty(count)
    for part in parts(count):
        ray = cross(*projected.by_point[..., part])
        with np.errstate(all="ignore"):
            ray *= np.sign((ray * up.take(structure.point[part], axis=1)).sum(axis=0)) / np.linalg.norm(ray, axis=0)
        rays[:, part] = np.nan_to_num(ray)
    mean = structure.sum_points(rays)
    mean /= np.maximum(np.linalg.norm(mean, axis=0), 1e-12)
    for part in parts(count):
        apart[part] = np.linalg.norm(rays[:, part] - mean.take(structure.point[part], axis=1), axis=0)
    largest = np.zeros(structure.num_points)
    np.maximum.at(largest, structure.point, apart)
    return 4.0 * np.arcsin(np.minimum(0.5 * largest, 1.0))


@dataclass(frozen=True)
class TerrainTest:
    """Result of holding tie points to a terrain, and their heights above it."""

    held: int  # tie points that it holds
    known: int  # tie points where it has a height
    total: int  # tie points in use
    offset: float  # median of the adjusted altitudes minus the terrain's [m]; NaN where it has none
    spread: float  # 1.4826 times their median absolute deviation [m]
    bias: float  # what its heights may be wrong by together [m]
    sigma: float = np.nan  # standard deviation of single heights, as the tie points show it [m]; NaN: as stated
    alike: float = 1.0  # as many single heights are worth one
    gains: tuple[float, ...] = ()  # how much of its relief is believed, scale by scale, the finest first
    relief: float = np.nan  # its relief as a multiple of the tie points'
    shows: bool = True  # whether that may be one: else it is of another terrain, and holds nothing
    agrees: bool = True  # whether it may be one still beside the adjusted tie points, which it holds
    is_known: bool = True  # whether it is known what its heights count from
    # (3,) how the tie points lie to it as delivered, level, rise to the east and to the north [m]
    delivered: tuple[float, ...] = (np.nan,) * 3

    beyond: tuple[float, ...] = (np.nan,) * 3  # times what its accuracy and the cameras' let expect of that


@dataclass(frozen=True)
class PointConstraints:
    """The priors on points: GCPs, and heights for tracks that need (or are given) them."""

    control: tuple[PointPrior, ...]  # GCPs, then a reference if there is one
    weak: BoolArray  # (P,) points whose rays meet under too small an angle
    tracks: IntArray  # (T,) points that are tracks (GCPs are held already)
    alt_range: tuple[float, float]  # altitudes [m] to expect where no other track tells
    options: AdjustOptions  # `dem_sigma`, `dem_bias_sigma`
    dem: Terrain | None  # none: weak tracks resemble the others in height, wherever these are
    reference: Reference | None = None  # whose heights are the DEM's
    has_control: bool = False  # whether GCPs hold the scene's place
    relief: Relief | None = None  # the DEM beside what rays alone say of heights, where these may judge it
    placed: PointPrior | None = None  # tracks that altimetry holds, which nothing else does then
    # (D + 1,) largest factors on the priors of drifts and turns: those of tie points alone; None: of all observations
    widest: tuple[float, ...] | None = None

    def loose(self, sigma: float) -> PointConstraints:
        """Return the priors with GCPs known to `sigma` [m] only."""
        first = self.control[0]
        rows = enu_basis(ground_from_ecef(first.mean)) / sigma
        return replace(self, control=(replace(first, rows=rows), *self.control[1:]), has_control=False)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of control beside the tie points: `dem`, `gcps`, `reference`."""
        given = {"dem": self.dem is not None, "gcps": self.has_control, "reference": self.reference is not None}
        return tuple(kind for kind, there in given.items() if there)

    def without_control(self, sigma: float) -> PointConstraints:
        """Return the priors of tie points alone: no DEM, the points of GCPs and of a reference known to `sigma` [m]."""
        control = [
            replace(one, rows=enu_basis(ground_from_ecef(one.mean)) / sigma, common=one.common[..., :0])
            for one in self.control
        ]
        return replace(self, control=tuple(control), dem=None, relief=None, reference=None, has_control=False)

    @property
    def is_judged(self) -> bool:
        """Whether the tie points decide the weight of the DEM."""
        given = self.dem is None or self.reference is not None
        return not given and self.options.learn_priors

    def hold(self, problem: Problem, points: Array) -> Problem:
        """Return the problem with priors on points that stand at `points` (P, 3), ECEF [m]."""
        return replace(problem, point_prior=_join_priors([*self.control, self._held(points), self.placed]))

    def _believed(self, points: Array) -> RegularisedDem | None:
        if self.relief is None:
            return None
        return believe(self.relief, self.tracks, ground_from_ecef(points[self.tracks]), self.options.dem_sigma)

    def _held(self, points: Array) -> PointPrior | None:
        weak, believed = self.weak[self.tracks], self._believed(points)
        free = np.ones(len(weak), dtype=bool)
        if self.placed is not None:
            free = ~np.isin(self.tracks, self.placed.index)
        if believed is not None and believed.shows:
            ground = ground_from_ecef(points[self.tracks])
            assert self.relief is not None
            common = self.relief.common_sigma(self._bias)
            held = _believed_heights(ground, self.tracks, believed, common)
            return held.select(np.isin(held.index, self.tracks[free]))
        dem = self.dem if believed is None else None
        judged_later = self.is_judged and self.relief is None
        is_whole = dem is not None and not judged_later
        chosen = free if is_whole else free & weak
        index = self.tracks[chosen]
        if not len(index):
            return None
        if dem is not None:
            alike, span = 1.0, None
            if self.reference is not None:
                alike, span = max(len(index) / MAX_INDEPENDENT_ERRORS, 1.0), self.control[1].mean
            elif self.relief is not None:
                alike = max(len(index) / MAX_INDEPENDENT_ERRORS, 1.0)
            level = None if self.relief is None else ~weak[chosen]
            sigma = self.options.dem_sigma * alike**0.5
            return terrain_heights(points, index, dem, sigma, self._bias, span, level)
        others, (lowest, highest) = self.tracks[~weak], self.alt_range
        middle, sigma = 0.5 * (lowest + highest), 0.5 * (highest - lowest)
        if len(others) >= 10:
            low, middle, high = np.percentile(ground_from_ecef(points[others])[:, 2], [5, 50, 95])
            sigma = high - low
        # what they all are off by is told by the cameras, as far as they tell it: that heights of tracks just above
        # the least angle are right is known to nobody, and of the altitudes of an RPC that they lie within its range
        return flat_heights(points, index, float(middle), max(float(sigma), _FLAT_SIGMA), highest - lowest)

    @property
    def _bias(self) -> float:
        """Standard deviation of an offset of a whole terrain [m]."""
        if self.reference is not None:
            return float(self.reference.bias[2])
        return self.options.dem_bias_sigma or (KNOWN_BIAS if self._is_known is True else DEM_BIAS)

    @property
    def _is_known(self) -> bool | None:
        """Whether the vertical datum of a DEM is known; None of a function."""
        return getattr(self.dem, "known", None)

    def test(self, points: Array, seen: BoolArray) -> TerrainTest | None:
        """Compare the terrain with the tracks `seen` (P,), at their adjusted places; None without a terrain."""
        if self.dem is None:
            return None
        index = self.tracks[seen[self.tracks]]
        ground = ground_from_ecef(points[index])
        dem = self.dem(ground[:, 0], ground[:, 1])
        above = ground[:, 2] - dem
        known = np.isfinite(above)
        believed = self._believed(points)
        held, shows = self._held(points), believed is None or believed.shows
        count = 0 if held is None or not shows else int(np.isin(index[known], held.index).sum())
        offset = float(np.median(above[known])) if known.any() else np.nan
        spread = robust_spread(above[known], offset) if known.any() else np.nan
        found = TerrainTest(count, int(known.sum()), len(index), offset, spread, self._bias)
        found = replace(found, is_known=self._is_known is not False)
        if self.relief is not None:
            delivered, beyond = self.relief.delivered, self.relief.beyond(self._bias)
            found = replace(found, delivered=tuple(map(float, delivered)), beyond=tuple(map(float, beyond)))
        if believed is not None:
            judged = {name: getattr(believed, name) for name in ("sigma", "alike", "relief", "shows")}
            found = replace(found, gains=tuple(map(float, believed.gains)), **judged)
        if self.relief is not None and shows:
            times, agrees = relief_ratio(ground[known], dem[known], self.options.dem_sigma)
            found = replace(found, relief=times, agrees=agrees)
        return found

    def warn(self) -> None:
        """Warn that tracks are constrained in height without a DEM."""
        count = int(self.weak[self.tracks].sum())
        if count and self.dem is None:
            message = (
                f"{count} of {len(self.tracks)} tracks are seen under less than "
                f"{self.options.min_convergence:g} deg: without a DEM they are constrained in height"
            )
            warnings.warn(message, BarpcWarning, stacklevel=3)
