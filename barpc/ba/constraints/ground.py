"""Priors on points: GCPs, a reference, a DEM, and altitudes of tracks with small convergence angles."""

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
from barpc.base.frozen import join_fields
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef, parts
from barpc.base.options import AdjustOptions
from barpc.base.statistics import robust_spread
from barpc.scene import BoolArray, GroundPoints, IntArray, Reference
from barpc.sensor.curve import cross

FIRST_PLACED = NUM_BENDS
"""Index of the first common error of altimetry. The errors before it are those of a DEM and a reference."""
DEM_BIAS = 20.0  # m: standard deviation of the common error of a DEM, if not stated
KNOWN_BIAS = 5.0  # m: the same, if the vertical datum of the DEM is known
MAX_INDEPENDENT_ERRORS = 25.0  # effective number of independent points of a DEM or reference with correlated errors
_ALTITUDE_SIGMA = 1.0  # m: keeps the altitude of points whose rays are nearly parallel and do not determine it
_FLAT_SIGMA = 50.0  # m: least prior sigma of altitudes without a DEM


def _join_priors(priors: Sequence[PointPrior | None]) -> PointPrior | None:
    """Concatenate priors on different points; None if all are empty.

    Common errors with the same index are the same error.
    """
    given = [prior for prior in priors if prior is not None and len(prior.index)]
    if not given:
        return None
    most = max(prior.common.shape[2] for prior in given)
    common = [np.pad(p.common, ((0, 0), (0, 0), (0, most - p.common.shape[2]))) for p in given]
    return PointPrior(**join_fields([replace(p, common=wide) for p, wide in zip(given, common, strict=True)]))


def ground_control(gcps: GroundPoints, index: IntArray) -> PointPrior:
    """Return GCPs as priors on the points `index` (G,), with their sigmas east, north and up."""
    rows = enu_basis(gcps.lonlatalt) / gcps.sigma[..., None]
    return PointPrior(index, ecef_from_ground(gcps.lonlatalt), rows, np.zeros((len(index), 3, 0)))


def reference_control(reference: Reference, index: IntArray) -> PointPrior:
    """Return the points of a reference as priors on the points `index` (R,).

    The six common errors are: offset and two tilts of the DEM (also those of points constrained to the DEM), east and
    north offset of the orthoimage, and the height of matched features (houses, trees) above the DEM. DEM errors are
    correlated, so the height sigmas are enlarged: all weigh at most as `MAX_INDEPENDENT_ERRORS` independent heights.
    """
    sigma = reference.points.sigma * [1.0, 1.0, np.sqrt(max(len(index) / MAX_INDEPENDENT_ERRORS, 1.0))]
    alone = ground_control(replace(reference.points, sigma=sigma), index)
    common = np.zeros((len(index), 3, 6))
    common[:, 2, 0] = reference.bias[2] / sigma[:, 2]
    common[:, 2, 1:3] = _normalised(alone.mean, alone.mean) * (reference.bias[2] / sigma[:, 2:])
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
    """Return priors that constrain points `index` (Q,) of (P, 3) to the local tangent planes of a DEM.

    `sigma` [m] is the standard deviation of single heights. `common_sigma` [m] is that of the common offset and, at the
    edges of the scene, of the common tilts. The scene is the points, or `span` (n, 3) [m], ECEF, if other priors
    share the errors. Planes are level at points in the mask `level` (Q,). Points without DEM height get no prior.
    """
    ground = ground_from_ecef(points[index])
    alt = terrain(ground[:, 0], ground[:, 1])
    slopes = np.nan_to_num(terrain_slopes(terrain, ground))
    if level is not None:
        slopes[level] = 0.0
    normal = np.column_stack([-slopes, np.ones(len(alt))])
    return _heights(np.column_stack([ground[:, :2], alt]), index, normal, sigma, common_sigma, span)


def _weighted_heights(ground: Array, index: IntArray, weighted: RegularisedDem, common_sigma: Array) -> PointPrior:
    """Return priors that constrain points `index` (Q,), at ground points (Q, 3), to a DEM of estimated accuracy.

    `common_sigma` (`NUM_BENDS`,) [m] are the sigmas of the DEM's offset, tilts and bends at the edges of the scene.
    """
    normal, sigma = np.column_stack([-weighted.slopes, np.ones(len(ground))]), weighted.effective_sigma
    prior = _heights(np.column_stack([ground[:, :2], weighted.alt]), index, normal, sigma, 0.0)
    common = np.zeros((len(prior.index), 3, NUM_BENDS))
    common[:, 0] = weighted.bends[np.isfinite(weighted.alt)] * (common_sigma / sigma)
    return replace(prior, common=common)


def flat_heights(points: Array, index: IntArray, alt: float, sigma: float, common_sigma: float) -> PointPrior:
    """Return priors that constrain points to the altitude `alt` [m], with sigmas of single and of common errors [m]."""
    ground = ground_from_ecef(points[index])
    ground[:, 2] = alt
    return _heights(ground, index, np.tile([0.0, 0.0, 1.0], (len(index), 1)), sigma, common_sigma)


def staying(points: Array, index: IntArray) -> PointPrior:
    """Return priors that constrain points `index` (Q,) of (P, 3), ECEF [m], to their current altitudes."""
    ground = ground_from_ecef(points[index])
    return _heights(ground, index, np.tile([0.0, 0.0, 1.0], (len(index), 1)), _ALTITUDE_SIGMA, 0.0)


def _heights(
    foot: Array, index: IntArray, normal: Array, sigma: float, common_sigma: float, span: Array | None = None
) -> PointPrior:
    """Return priors that constrain points to planes through ground points `foot` (Q, 3), with normals (Q, 3) (ENU)."""
    known = np.isfinite(foot[:, 2])
    foot = foot[known]
    rows, common = np.zeros((len(foot), 3, 3)), np.zeros((len(foot), 3, 3))
    rows[:, 0] = np.einsum("qe,qex->qx", normal[known], enu_basis(foot)) / sigma
    common[:, 0, 0] = common_sigma / sigma
    mean = ecef_from_ground(foot)
    if len(foot):
        common[:, 0, 1:] = _normalised(mean, mean if span is None else span) * (common_sigma / sigma)
    return PointPrior(index[known], mean, rows, common)


def _normalised(points: Array, span: Array) -> Array:
    """Return normalised positions (n, 2), east and north, of points (n, 3): +-1 at the edges of `span` (m, 3) [m]."""
    middle = span.mean(axis=0)
    enu = enu_basis(ground_from_ecef(middle))[:2]
    edge = np.abs((span - middle) @ enu.T).max(axis=0)
    return np.asarray((points - middle) @ enu.T / np.maximum(edge, 1.0))


def convergence_angles(structure: Structure, projected: Projected, points: Array) -> Array:
    """Return the convergence angle (P,) [rad] of the rays of each point: twice the largest angle to their mean."""
    count, up = len(structure.point), np.ascontiguousarray(points.T)
    rays, to_mean = np.empty((3, count)), np.empty(count)
    for part in parts(count):
        ray = cross(*projected.by_point[..., part])
        with np.errstate(all="ignore"):
            ray *= np.sign((ray * up.take(structure.point[part], axis=1)).sum(axis=0)) / np.linalg.norm(ray, axis=0)
        rays[:, part] = np.nan_to_num(ray)
    mean = structure.sum_points(rays)
    mean /= np.maximum(np.linalg.norm(mean, axis=0), 1e-12)
    for part in parts(count):
        to_mean[part] = np.linalg.norm(rays[:, part] - mean.take(structure.point[part], axis=1), axis=0)
    largest = np.zeros(structure.num_points)
    np.maximum.at(largest, structure.point, to_mean)
    return 4.0 * np.arcsin(np.minimum(0.5 * largest, 1.0))


@dataclass(frozen=True)
class TerrainTest:
    """Comparison of a DEM with the tie points, and its use as a constraint."""

    held: int  # tie points constrained to the DEM
    known: int  # tie points with a DEM height
    total: int  # tie points in use
    offset: float  # median of adjusted altitudes minus the DEM [m]; NaN: no DEM height
    spread: float  # 1.4826 times their median absolute deviation (NMAD) [m]
    bias: float  # standard deviation of the DEM's common error [m]
    sigma: float = np.nan  # standard deviation of single DEM heights, from the tie points [m]; NaN: as stated
    alike: float = 1.0  # number of (correlated) DEM heights per independent one
    gains: tuple[float, ...] = ()  # weight (0 to 1) of the relief of the DEM at each scale, the finest first
    relief: float = np.nan  # ratio of the relief of the DEM to that of the tie points
    shows: bool = True  # whether this ratio can be 1; False: the DEM shows another terrain and is not used
    agrees: bool = True  # whether it can be 1 after the adjustment, too
    is_known: bool = True  # whether the vertical datum of the DEM is known
    # (3,) offset, and tilts east and north, of the tie points above the DEM before the adjustment [m]
    delivered: tuple[float, ...] = (np.nan,) * 3
    beyond: tuple[float, ...] = (np.nan,) * 3  # |`delivered`| over its sigma, by DEM and camera errors


@dataclass(frozen=True)
class PointConstraints:
    """All priors on points: GCPs, reference, DEM, and heights of weak tracks."""

    control: tuple[PointPrior, ...]  # GCPs, then a reference if there is one
    weak: BoolArray  # (P,) points whose convergence angle is too small
    tracks: IntArray  # (T,) points that are tracks
    alt_range: tuple[float, float]  # altitudes [m] of weak tracks if there are few others
    options: AdjustOptions  # `dem_sigma`, `dem_bias_sigma`
    dem: Terrain | None  # None: weak tracks are constrained to the median altitude of the others
    reference: Reference | None = None  # its points have heights of the DEM
    has_control: bool = False  # whether GCPs are used
    relief: Relief | None = None  # comparison of the DEM with triangulated heights
    placed: PointPrior | None = None  # height priors from altimetry; these tracks get no other prior
    # (D + 1,) upper limits of the factors on the prior sigmas of D drifts and of rotations about the lines of sight
    widest: tuple[float, ...] | None = None  # estimated without control; None: no limit

    def loose(self, sigma: float) -> PointConstraints:
        """Return the priors with a sigma of the GCPs of `sigma` [m]."""
        first = self.control[0]
        rows = enu_basis(ground_from_ecef(first.mean)) / sigma
        return replace(self, control=(replace(first, rows=rows), *self.control[1:]), has_control=False)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of control in use: `dem`, `gcps`, `reference`."""
        given = {"dem": self.dem is not None, "gcps": self.has_control, "reference": self.reference is not None}
        return tuple(kind for kind, there in given.items() if there)

    def without_control(self, sigma: float) -> PointConstraints:
        """Return the priors without a DEM, and with `sigma` [m] for GCPs and reference points."""
        control = [
            replace(one, rows=enu_basis(ground_from_ecef(one.mean)) / sigma, common=one.common[..., :0])
            for one in self.control
        ]
        return replace(self, control=tuple(control), dem=None, relief=None, reference=None, has_control=False)

    @property
    def is_judged(self) -> bool:
        """Whether the weight of the DEM is estimated from the tie points."""
        return self.dem is not None and self.reference is None

    def hold(self, problem: Problem, points: Array) -> Problem:
        """Return the problem with the priors on points, computed at `points` (P, 3), ECEF [m]."""
        return replace(problem, point_prior=_join_priors([*self.control, self._height_priors(points), self.placed]))

    def _weighted_dem(self, points: Array) -> RegularisedDem | None:
        """Return the DEM weighted by its comparison with the tie points; None: no comparison."""
        if self.relief is None:
            return None
        return believe(self.relief, self.tracks, ground_from_ecef(points[self.tracks]), self.options.dem_sigma)

    def _height_priors(self, points: Array) -> PointPrior | None:
        """Return the height priors of tracks without altimetry; None: there are none.

        The tracks that get a prior depend on the DEM:

        - Accuracy estimated from tie points: all tracks. (A DEM of another terrain is treated as no DEM.)
        - Accuracy as given: all tracks. With a reference or a comparison, sigma is enlarged for correlated errors.
        - Still to be compared with the tie points: weak tracks.
        - No DEM: weak tracks, constrained to the median altitude of the other tracks or, with fewer than ten of
          these, to the middle of the altitude range.
        """
        weak, weighted = self.weak[self.tracks], self._weighted_dem(points)
        without_altimetry = np.ones(len(weak), dtype=bool)
        if self.placed is not None:
            without_altimetry = ~np.isin(self.tracks, self.placed.index)
        if weighted is not None and weighted.shows:
            ground = ground_from_ecef(points[self.tracks])
            assert self.relief is not None
            common = self.relief.common_sigma(self._bias)
            prior = _weighted_heights(ground, self.tracks, weighted, common)
            return prior.select(np.isin(prior.index, self.tracks[without_altimetry]))
        dem = self.dem if weighted is None else None
        judged_later = self.is_judged and self.relief is None
        use_all = dem is not None and not judged_later
        chosen = without_altimetry if use_all else without_altimetry & weak
        index = self.tracks[chosen]
        if not len(index):
            return None
        if dem is not None:
            correlated, span = 1.0, None
            if self.reference is not None:
                correlated, span = max(len(index) / MAX_INDEPENDENT_ERRORS, 1.0), self.control[1].mean
            elif self.relief is not None:
                correlated = max(len(index) / MAX_INDEPENDENT_ERRORS, 1.0)
            level = None if self.relief is None else ~weak[chosen]
            sigma = self.options.dem_sigma * correlated**0.5
            return terrain_heights(points, index, dem, sigma, self._bias, span, level)
        others, (lowest, highest) = self.tracks[~weak], self.alt_range
        middle, sigma = 0.5 * (lowest + highest), 0.5 * (highest - lowest)
        if len(others) >= 10:
            low, middle, high = np.percentile(ground_from_ecef(points[others])[:, 2], [5, 50, 95])
            sigma = high - low
        # the common sigma is wide: the cameras determine the common altitude, as the altitudes of other tracks may be
        # biased, and the altitude range of an RPC is only a limit
        return flat_heights(points, index, float(middle), max(float(sigma), _FLAT_SIGMA), highest - lowest)

    @property
    def _bias(self) -> float:
        """Standard deviation of the common error of the DEM [m]."""
        if self.reference is not None:
            return float(self.reference.bias[2])
        return self.options.dem_bias_sigma or (KNOWN_BIAS if self._is_known is True else DEM_BIAS)

    @property
    def _is_known(self) -> bool | None:
        """Whether the vertical datum of the DEM is known; None if the DEM is a plain function."""
        return getattr(self.dem, "known", None)

    def test(self, points: Array, seen: BoolArray) -> TerrainTest | None:
        """Compare the DEM with the adjusted positions of the tracks `seen` (P,); None without a DEM."""
        if self.dem is None:
            return None
        index = self.tracks[seen[self.tracks]]
        ground = ground_from_ecef(points[index])
        dem = self.dem(ground[:, 0], ground[:, 1])
        above = ground[:, 2] - dem
        known = np.isfinite(above)
        weighted = self._weighted_dem(points)
        prior, shows = self._height_priors(points), weighted is None or weighted.shows
        count = 0 if prior is None or not shows else int(np.isin(index[known], prior.index).sum())
        offset = float(np.median(above[known])) if known.any() else np.nan
        spread = robust_spread(above[known], offset) if known.any() else np.nan
        found = TerrainTest(count, int(known.sum()), len(index), offset, spread, self._bias)
        found = replace(found, is_known=self._is_known is not False)
        if self.relief is not None:
            delivered, beyond = self.relief.delivered, self.relief.beyond(self._bias)
            found = replace(found, delivered=tuple(map(float, delivered)), beyond=tuple(map(float, beyond)))
        if weighted is not None:
            judged = {name: getattr(weighted, name) for name in ("sigma", "alike", "relief", "shows")}
            found = replace(found, gains=tuple(map(float, weighted.gains)), **judged)
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
