"""The weight of a DEM as a constraint, for each spatial scale: as far as tie-point heights confirm its relief.

A DEM is h = t + e, terrain plus errors. If its errors at fine scales counted as terrain, least squares would shift the
scene until they fit by chance. Therefore points are constrained to the best linear estimate of the terrain: the sum of
gain x band over bands of spatial scales, gain = var t / (var t + var e). The gains are estimated by a regression of
the heights of the tie points on the bands (regression calibration: Carroll, Ruppert, Stefanski, Crainiceanu,
Measurement Error in Nonlinear Models, 2006, chapter 4). Its residuals give the standard deviation of single heights,
and their correlation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barpc.base.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.base.statistics import (
    BACKFITTING,
    CRITICAL,
    MANY,
    MUCH_NOISE,
    OUTLIER,
    SURELY,
    pooled_variance,
    robust_spread,
)
from barpc.scene import BoolArray, IntArray
from barpc.scene import Terrain as Terrain

SLOPE_STEP = 15.0  # m: slopes of the DEM are height differences over twice this distance
SURFACE_DEGREE = 3  # degree of the polynomial of common errors; the DEM's own polynomial has gain 1
_SURFACE_POWERS = [(n - j, j) for n in range(SURFACE_DEGREE + 1) for j in range(n + 1)]  # 1, x, y, x^2, ...
NUM_BENDS = len(_SURFACE_POWERS)
_DEM_NODES = 300  # nodes along the longer side of the scene, of the grid for smoothing: 33 m apart for 10 km
_DEM_MARGIN = 300.0  # m: least margin around the scene, horizontally and in altitude, for errors of the cameras
# cells along the longer side of the scene; 6 x 6 of them determine a variance with a relative error of a quarter
_VARIANCE_CELLS = (6, 10, 16)
_MIN_SIDE_TO_WIDTH = _VARIANCE_CELLS[-1]  # least ratio of the longer side of the scene to a smoothing width
_MIN_INDEPENDENT_SLOPES = 45.0  # scenes with valid gains have 49 to 133, 250 m of SRTM have 33
# typical ratio of the distance of the edges of a scene from its centre to the RMS distance of its points
_EDGE_TO_RMS_DISTANCE = 2.0
# largest deviation from 1 of the ratio of the DEM's relief to that of the tie points; else it shows another terrain
_MAX_RELIEF_DIFFERENCE = 0.5


@dataclass(frozen=True, eq=False)
class Bands:
    """A DEM over a scene, split into bands of spatial scales, the finest first."""

    terrain: Terrain
    origin: Array  # (2,) lon, lat of the first node [deg]
    unit: Array  # (2,) metres per degree
    step: float  # m between nodes
    smoothed: tuple[Array, ...]  # DEMs, each smoothed with twice the width of the previous one

    @classmethod
    def of(cls, terrain: Terrain, ground: Array) -> Bands:
        """Split a DEM into bands of spatial scales over ground points (n, 3)."""
        from scipy.ndimage import gaussian_filter  # slow to import (0.1 s)

        lon = wrap_longitude(ground[:, 0], ground[0, 0])
        low, high = np.percentile(np.column_stack([lon, ground[:, 1]]), [1, 99], axis=0)  # without wrong matches
        unit = metres_per_unit(np.append((low + high) / 2.0, np.median(ground[:, 2])))[:2]
        side = (high - low) * unit
        extent = float(side.max())
        margin = max(extent / _MIN_SIDE_TO_WIDTH, _DEM_MARGIN)
        step = max((extent + 2.0 * margin) / _DEM_NODES, SLOPE_STEP)
        origin = low - margin / unit
        cols, rows = (np.arange(int((s + 2.0 * margin) / step) + 2) * step for s in side)
        lon, lat = np.meshgrid(origin[0] + cols / unit[0], origin[1] + rows / unit[1])
        heights = np.asarray(terrain(lon.ravel(), lat.ravel()), dtype=np.float64).reshape(lon.shape)
        least, most = np.percentile(ground[:, 2], [1, 99])
        room = most - least + _DEM_MARGIN
        known = (heights > least - room) & (heights < most + room)  # holes may have any fill value
        middle = float(np.median(heights[known])) if known.any() else 0.0
        filled, smoothed, width = np.where(known, heights - middle, 0.0), [], step
        while width * _MIN_SIDE_TO_WIDTH <= max(extent, _MIN_SIDE_TO_WIDTH * step):
            total, weight = (
                gaussian_filter(a, width / step, mode="nearest") for a in (filled, known.astype(np.float64))
            )
            smoothed.append(middle + total / np.maximum(weight, 1e-6))
            width *= 2.0
        return cls(terrain, origin, unit, step, tuple(smoothed))

    def local(self, ground: Array) -> Array:
        """Return the positions (n, 2) [m] of ground points (n, 3), east and north of the first node."""
        lon = wrap_longitude(ground[:, 0], self.origin[0])
        return np.asarray((np.column_stack([lon, ground[:, 1]]) - self.origin) * self.unit)

    def at(self, ground: Array) -> tuple[Array, Array]:
        """Return heights (K, n) [m] and slopes (K, n, 2) of the bands at points (n, 3); all heights sum to the DEM."""
        heights = [np.asarray(self.terrain(ground[:, 0], ground[:, 1]), dtype=np.float64)]
        slopes = [np.nan_to_num(terrain_slopes(self.terrain, ground))]
        at = self.local(ground).T[::-1] / self.step
        for layer in self.smoothed:
            rising = [np.gradient(layer, self.step, axis=axis) for axis in (1, 0)]
            heights.append(_layer_values(layer, at))
            slopes.append(np.column_stack([_layer_values(np.asarray(a), at) for a in rising]))
        return _differences(np.array(heights)), _differences(np.array(slopes))


def _layer_values(layer: Array, at: Array) -> Array:
    from scipy.ndimage import map_coordinates

    return np.asarray(map_coordinates(layer, at, order=1, mode="nearest"), dtype=np.float64)


def terrain_slopes(terrain: Terrain, ground: Array) -> Array:
    """Return the slopes (n, 2) of a DEM towards east and north at ground points (n, 3); NaN where it has no height."""
    step = SLOPE_STEP / metres_per_unit(ground)[:, :2]
    lon, lat = ground[:, 0], ground[:, 1]
    east = terrain(lon + step[:, 0], lat) - terrain(lon - step[:, 0], lat)
    north = terrain(lon, lat + step[:, 1]) - terrain(lon, lat - step[:, 1])
    return np.column_stack([east, north]) / (2.0 * SLOPE_STEP)


def _differences(layers: Array) -> Array:
    """Return the bands (K, ...) of ever smoother layers (K, ...).

    A band is a layer minus the next one. The last band is the last layer.
    """
    return np.concatenate([layers[:-1] - layers[1:], layers[-1:]])


def quadratic_basis(at: Array) -> Array:
    """Return the monomials (n, `NUM_BENDS`), up to `SURFACE_DEGREE`, of the smooth surface at positions (n, 2)."""
    x, y = at.T
    return np.column_stack([x**i * y**j for i, j in _SURFACE_POWERS])


def _bend_slopes(at: Array) -> Array:
    """Return the derivatives (n, `NUM_BENDS`, 2) of `quadratic_basis` by the positions."""
    x, y = at.T
    by_x = [i * x ** max(i - 1, 0) * y**j for i, j in _SURFACE_POWERS]
    by_y = [j * x**i * y ** max(j - 1, 0) for i, j in _SURFACE_POWERS]
    return np.stack([np.column_stack(by_x), np.column_stack(by_y)], axis=-1)


@dataclass(frozen=True, eq=False)
class RegularisedDem:
    """A DEM weighted by its gains, at n points."""

    alt: Array  # (n,) altitudes to which points are constrained [m]; NaN: no DEM height, or an outlier
    slopes: Array  # (n, 2) slopes of that surface, east and north
    bends: Array  # (n, `NUM_BENDS`) common errors per unit: monomials, about 1 at the edges of the scene
    gains: Array  # (K,) weight of each band, the finest first
    sigma: float  # standard deviation of single altitudes [m]
    alike: float  # number of (correlated) heights per independent one
    relief: float  # ratio of the relief of the DEM to that of the tie points
    shows: bool  # whether this ratio can be 1; False: the DEM shows another terrain

    @property
    def effective_sigma(self) -> float:
        """Standard deviation of single altitudes [m], enlarged to treat correlated ones as independent."""
        return float(self.sigma * self.alike**0.5)


@dataclass(frozen=True, eq=False)
class Relief:
    """Comparison of a DEM with triangulated heights of P tie points."""

    bands: Bands | None  # None: too few points
    tell: BoolArray  # (P,) points whose triangulated heights are more accurate than the DEM
    delivered: Array  # (3,) offset, and tilts east and north, of the points above the DEM, with delivered cameras [m]
    fit: Array  # (3, P) derivatives of `delivered` by the heights of the points
    cameras: Array  # (3,) standard deviation of `delivered` by the camera priors [m]; NaN: unknown
    posts: Array | None = None  # (P, 4) indices of the grid posts of the DEM around each point, if it is a grid

    def beyond(self, bias: float) -> Array:
        """Return the absolute values (3,) of `delivered` divided by their standard deviations.

        `bias` [m] is the standard deviation of the common error of the DEM.
        """
        return np.asarray(np.abs(self.delivered) / np.hypot(self.cameras, bias))

    def common_sigma(self, bias: float) -> Array:
        """Return the sigmas (`NUM_BENDS`,) [m] of common errors: `bias`, or more where `delivered` contradicts it."""
        sigma = np.full(NUM_BENDS, bias)
        contradicts = self.beyond(bias) > SURELY
        sigma[:3][contradicts] = _EDGE_TO_RMS_DISTANCE * np.abs(self.delivered)[contradicts]
        return sigma

    @classmethod
    def of(cls, terrain: Terrain, ground: Array, strong: BoolArray, sharp: Array, stated: float) -> Relief:
        """Compare a DEM with triangulated ground points (P, 3).

        Rays determine the heights of the points in the mask `strong` (P,), with standard deviations `sharp` (P,) [m].
        The regression uses points whose `sharp` is below the standard deviation of DEM heights: the larger of `stated`
        [m] and the observed one. Tilts are heights at the RMS distance of the points from their centre.
        """
        index = np.flatnonzero(strong)
        above = ground[index, 2] - np.asarray(terrain(ground[index, 0], ground[index, 1]))
        index, above = index[np.isfinite(above)], above[np.isfinite(above)]
        tell, fit, unknown = np.zeros(len(strong), dtype=bool), np.zeros((3, len(strong))), np.full(3, np.nan)
        posts_of = getattr(terrain, "posts", None)
        posts = None if posts_of is None else posts_of(ground[:, 0], ground[:, 1])
        if len(index) < MANY:
            return cls(None, tell, unknown, fit, unknown)
        bands = Bands.of(terrain, ground[index])
        at = bands.local(ground[index])
        at -= at.mean(axis=0)
        plane = np.column_stack([np.ones(len(at)), at / np.sqrt((at**2).sum(axis=1).mean())])
        near = without_outliers(above)
        for _ in range(BACKFITTING):
            delivered = _least_squares_fit(plane[near], above[near])
            residual = np.abs(above - plane @ delivered)
            near = residual <= OUTLIER * robust_spread(residual)
        tell[index[sharp[index] < max(robust_spread(residual), stated)]] = True
        fit[:, index] = np.linalg.pinv(plane)
        return cls(bands, tell, delivered, fit, unknown, posts)

    def independent(self, points: IntArray) -> float:
        """Return an upper limit of the number of independent DEM heights at the points with these indices (n,).

        It is the number of grid posts around the points, or infinity if the DEM is not a grid.
        """
        return np.inf if self.posts is None else float(len(np.unique(self.posts[points])))


def believe(relief: Relief, index: IntArray, ground: Array, stated: float) -> RegularisedDem | None:
    """Estimate the accuracy of a DEM at the points `index` (n,), with ground coordinates (n, 3).

    `stated` [m] is the a-priori standard deviation of single DEM heights. The regression attributes part of the height
    difference between a point and the weighted DEM to a motion or bend of the scene. A point with an accurate height is
    constrained to its own height minus this part. The residual is an error of the DEM and must not move the point.
    Other points are constrained to the weighted DEM. Returns None if too few points have accurate heights.
    """
    if relief.bands is None:
        return None
    heights, slopes = relief.bands.at(ground)
    known = np.isfinite(heights[0])
    tell = relief.tell[index] & known
    if tell.any():
        tell[tell] = without_outliers((ground[:, 2] - heights.sum(axis=0))[tell])
    if tell.sum() < MANY:
        return None
    at = relief.bands.local(ground)
    at = at - at[tell].mean(axis=0)
    half = max(float(np.abs(at[tell]).max()), 1.0)
    smooth, by_place = quadratic_basis(at / half), _bend_slopes(at / half) / half
    trend = _least_squares_fit(smooth[tell], heights[:, tell].T)
    polynomial, detrended = (smooth @ trend).sum(axis=1), heights.T - smooth @ trend
    detrended_slopes = slopes - np.einsum("nmx,mk->knx", by_place, trend)
    above = ground[:, 2] - polynomial
    found = _regress_on_bands(at, above, detrended, detrended_slopes, smooth, tell, relief.independent(index[tell]))
    fits, residual, weighted_slopes = found.fits, found.residual, found.weighted_slopes
    freedom = max(int(fits.sum()) - found.unknowns, 1)
    pull = weighted_slopes[fits] - smooth[fits] @ _least_squares_fit(smooth[fits], weighted_slopes[fits])
    alt = np.where(tell, ground[:, 2] - found.part, polynomial + detrended @ found.gains)
    is_held = known & (fits | ~relief.tell[index])
    ratio, shows = _relief_ratio(detrended[fits].sum(axis=1), above[fits], smooth[fits], stated)
    return RegularisedDem(
        np.where(is_held, alt, np.nan),
        weighted_slopes + np.einsum("nmx,mk->nx", by_place, trend),
        smooth,
        found.gains,
        float(np.sqrt(pooled_variance((residual[fits] ** 2).sum(), freedom, stated**2))),
        max(variance_inflation(at[fits], pull * residual[fits, None]), fits.sum() / relief.independent(index[fits])),
        ratio,
        shows,
    )


@dataclass(frozen=True, eq=False)
class _BandRegression:
    """Regression of the heights of n points on the bands of a DEM."""

    gains: Array  # (K,) of the bands
    weighted_slopes: Array  # (n, 2) slopes of the weighted sum of the bands
    part: Array  # (n,) part of the heights due to a motion or bend of the scene [m]
    residual: Array  # (n,) [m]
    fits: BoolArray  # (n,) inliers among the points used
    unknowns: int  # number of estimated coefficients


def _regress_on_bands(
    at: Array, above: Array, bands: Array, slopes: Array, smooth: Array, tell: BoolArray, independent: float
) -> _BandRegression:
    """Regress the heights `above` (n,) [m] of points at (n, 2) on the bands of a DEM, with a motion and a bend.

    `bands` (n, K) are the heights of the bands, and `slopes` (K, n, 2) their slopes. `smooth` (n, m) are the monomials
    of the bend. Only the points in the mask `tell` (n,) are used. The number of independent slopes is at most
    `independent`. If it is too small to distinguish hills from errors of the DEM, the gains of all bands are zero.
    """
    from scipy.optimize import lsq_linear  # slow to import (0.2 s)

    gains, fits, both, use_bands = np.ones(bands.shape[1]), tell, np.column_stack([above, bands]), True
    for _ in range(BACKFITTING):
        rising = np.einsum("k,knx->nx", gains, slopes)
        count = fits.sum() / variance_inflation(at[fits], rising[fits] - rising[fits].mean(axis=0))
        use_bands = use_bands and min(count, independent) > _MIN_INDEPENDENT_SLOPES
        motion_and_bend = smooth
        if use_bands:  # motion: shift, rotation, scale
            motion_and_bend = np.column_stack([smooth, *(rising * smooth[:, k, None] for k in range(3))])
            free = both[fits] - motion_and_bend[fits] @ _least_squares_fit(motion_and_bend[fits], both[fits])
            gains = lsq_linear(free[:, 1:], free[:, 0], (0.0, 1.0)).x
        else:
            gains, rising = np.zeros(bands.shape[1]), np.zeros_like(rising)
        rest = above - bands @ gains
        part = motion_and_bend @ _least_squares_fit(motion_and_bend[fits], rest[fits])
        residual = rest - part
        spread = robust_spread(residual[fits])
        fits = tell & (np.abs(residual) <= max(OUTLIER * spread, 1e-6))
    return _BandRegression(gains, rising, part, residual, fits, motion_and_bend.shape[1] + len(gains))


def without_outliers(values: Array) -> BoolArray:
    """Return the mask (n,) of values (n,) that are not outliers relative to their median."""
    off = np.abs(values - np.median(values))
    return np.asarray(off <= OUTLIER * robust_spread(off))


def _least_squares_fit(design: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(design, values, rcond=1e-9)[0], dtype=np.float64)


def variance_inflation(at: Array, pull: Array) -> float:
    """Return the number of (correlated) points at (n, 2) per independent one, from their gradients `pull` (n, 2).

    Gradients are summed over the cells of a grid. The sum of the squared sums is divided by its expectation for
    independent gradients: the sum of their squares. The largest ratio of several grids is returned, at least 1.
    """
    size, of_single, found = max(float(np.ptp(at, axis=0).max()), 1.0), (pull**2).sum(axis=0), 1.0
    for count in _VARIANCE_CELLS:
        column, row = np.floor((at - at.min(axis=0)) / size * count).astype(np.int64).T
        cell = np.unique(column * (count + 1) + row, return_inverse=True)[1]
        sums = np.stack([np.bincount(cell, one) for one in pull.T])
        found = max(found, float(((sums**2).sum(axis=1) / np.maximum(of_single, 1e-30)).max()))
    return found


def relief_ratio(ground: Array, dem: Array, stated: float) -> tuple[float, bool]:
    """Return the ratio of the relief of a DEM (n,) to that of adjusted ground points (n, 3), and whether it can be 1.

    Offset and tilts are removed from both. `stated` [m] is the sigma of single DEM heights.
    """
    if len(dem) < MANY:
        return float("nan"), True
    near = without_outliers(ground[:, 2] - dem)
    at = (ground - ground[near].mean(axis=0))[near, :2] * metres_per_unit(ground[near].mean(axis=0))[:2]
    plane = np.column_stack([np.ones(len(at)), at / max(float(np.abs(at).max()), 1.0)])
    relief = dem[near] - plane @ _least_squares_fit(plane, dem[near])
    return _relief_ratio(relief, ground[near, 2], plane, stated)


def _relief_ratio(relief: Array, above: Array, smooth: Array, stated: float) -> tuple[float, bool]:
    """Return the ratio of a DEM relief (n,) to that of tie points (n,) [m], and whether it can be 1.

    It cannot be 1 if its difference from 1 is large and significant, and the heights differ by much more than `stated`
    [m]. Combinations of the columns of `smooth` (n, m) are removed from the heights of the tie points.
    """
    seen = above - smooth @ _least_squares_fit(smooth, above)
    size = max(float(seen @ seen), 1e-12)
    ratio = float(relief @ seen) / size
    off, rest = relief - seen, relief - ratio * seen
    sigma = float(np.sqrt(rest @ rest / size / len(seen)) if len(seen) else np.inf)
    deviation = abs(ratio - 1.0)
    wrong = (
        deviation > _MAX_RELIEF_DIFFERENCE
        and deviation > CRITICAL * sigma
        and float(off @ off) > len(off) * (MUCH_NOISE * stated) ** 2
    )
    return ratio, not wrong
