"""The weight of a DEM's relief: scale by scale, as far as the tie points' own heights confirm it.

A DEM is h = t + e, terrain and errors. Where its small slopes are errors, least squares that take them for the
terrain's find a place where the errors happen to fit, and believe it. What may pull is the best guess of the terrain
given the DEM: the sum of gain x band over bands of scales, gain = var t / (var t + var e), for what the terrain has
beyond it has nothing to do with its slopes. The gains are those of a regression of the tie points' heights on the
bands (regression calibration: Carroll, Ruppert, Stefanski, Crainiceanu, Measurement Error in Nonlinear Models, 2006,
chapter 4). The residuals of single heights, and their correlation, are taken from the residuals.
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
    STATED_FREEDOM,
    SURELY,
    robust_spread,
)
from barpc.scene import BoolArray, IntArray
from barpc.scene import Terrain as Terrain

SLOPE_STEP = 15.0  # m: slopes of the DEM itself are taken over twice this distance
SURFACE_DEGREE = 3  # of the surfaces of which a DEM's are taken whole, wrong by what all its heights are
_SURFACE_POWERS = [(n - j, j) for n in range(SURFACE_DEGREE + 1) for j in range(n + 1)]  # powers: level, x, y, x^2, ...
NUM_BENDS = len(_SURFACE_POWERS)
_DEM_NODES = 300  # of the grid on which a DEM is smoothed, along the scene's longer side: 30 m of 10 km
_DEM_MARGIN = 300.0  # m around the scene at least, or as much as that: cameras may be off
_VARIANCE_CELLS = (6, 10, 16)  # along the scene's longer side: 36 sums tell a variance to a quarter
_WIDEST = _VARIANCE_CELLS[-1]  # the widest smoothing is as wide as the smallest of these, as a standard deviation
_HILLS = 45.0  # slopes that are alike count as one: 49-133 of them in the scenes that hold, 33 in 250 m by SRTM
_EDGE_TO_RMS_DISTANCE = 2.0  # the scene's edges lie at most about so many times as far out as its points' RMS distance
_MAX_RELIEF_DIFFERENCE = 0.5  # DEMs whose relief is farther from once that of the tie points are of another terrain


@dataclass(frozen=True, eq=False)
class Bands:
    """A DEM in bands of scales over a scene, the finest first."""

    terrain: Terrain
    origin: Array  # (2,) lon, lat of the first node [deg]
    unit: Array  # (2,) metres a degree
    step: float  # m between nodes
    smoothed: tuple[Array, ...]  # the DEM smoothed, each twice as wide as the one before

    @classmethod
    def of(cls, terrain: Terrain, ground: Array) -> Bands:
        """Split a DEM into bands of scales over ground points (n, 3)."""
        from scipy.ndimage import gaussian_filter  # a tenth of a second, of blocks with a DEM alone

        lon = wrap_longitude(ground[:, 0], ground[0, 0])
        low, high = np.percentile(np.column_stack([lon, ground[:, 1]]), [1, 99], axis=0)  # wrong matches lie far out
        unit = metres_per_unit(np.append((low + high) / 2.0, np.median(ground[:, 2])))[:2]
        side = (high - low) * unit
        extent = float(side.max())
        margin = max(extent / _WIDEST, _DEM_MARGIN)
        step = max((extent + 2.0 * margin) / _DEM_NODES, SLOPE_STEP)
        origin = low - margin / unit
        cols, rows = (np.arange(int((s + 2.0 * margin) / step) + 2) * step for s in side)
        lon, lat = np.meshgrid(origin[0] + cols / unit[0], origin[1] + rows / unit[1])
        heights = np.asarray(terrain(lon.ravel(), lat.ravel()), dtype=np.float64).reshape(lon.shape)
        least, most = np.percentile(ground[:, 2], [1, 99])
        room = most - least + _DEM_MARGIN
        known = (heights > least - room) & (heights < most + room)  # a hole may be filled with any number
        middle = float(np.median(heights[known])) if known.any() else 0.0
        filled, smoothed, width = np.where(known, heights - middle, 0.0), [], step
        while width * _WIDEST <= max(extent, _WIDEST * step):
            total, weight = (
                gaussian_filter(a, width / step, mode="nearest", truncate=3.0)
                for a in (filled, known.astype(np.float64))
            )
            smoothed.append(middle + total / np.maximum(weight, 1e-6))
            width *= 2.0
        return cls(terrain, origin, unit, step, tuple(smoothed))

    def local(self, ground: Array) -> Array:
        """Return the positions (n, 2) [m] east and north of the first node, of ground points (n, 3)."""
        lon = wrap_longitude(ground[:, 0], self.origin[0])
        return np.asarray((np.column_stack([lon, ground[:, 1]]) - self.origin) * self.unit)

    def at(self, ground: Array) -> tuple[Array, Array]:
        """Return the heights (K, n) [m] of the bands at ground points (n, 3), in all the DEM's; slopes (K, n, 2)."""
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
    """Return the slopes (n, 2) of a terrain towards east and north at ground points (n, 3); NaN where it is unknown."""
    step = SLOPE_STEP / metres_per_unit(ground)[:, :2]
    lon, lat = ground[:, 0], ground[:, 1]
    east = terrain(lon + step[:, 0], lat) - terrain(lon - step[:, 0], lat)
    north = terrain(lon, lat + step[:, 1]) - terrain(lon, lat - step[:, 1])
    return np.column_stack([east, north]) / (2.0 * SLOPE_STEP)


def _differences(layers: Array) -> Array:
    """Return the bands (K, ...) of layers (K, ...): each minus the next, which is smoother."""
    return np.concatenate([layers[:-1] - layers[1:], layers[-1:]])


def quadratic_basis(at: Array) -> Array:
    """Return the level, slopes and bends (n, `NUM_BENDS`) of a surface at places (n, 2)."""
    x, y = at.T
    return np.column_stack([x**i * y**j for i, j in _SURFACE_POWERS])


def _bend_slopes(at: Array) -> Array:
    """Return the derivatives (n, `NUM_BENDS`, 2) of `quadratic_basis` by the places."""
    x, y = at.T
    by_x = [i * x ** max(i - 1, 0) * y**j for i, j in _SURFACE_POWERS]
    by_y = [j * x**i * y ** max(j - 1, 0) for i, j in _SURFACE_POWERS]
    return np.stack([np.column_stack(by_x), np.column_stack(by_y)], axis=-1)


@dataclass(frozen=True, eq=False)
class RegularisedDem:
    """Heights and slopes of a regularised DEM at n points."""

    alt: Array  # (n,) altitudes to hold the points to [m]; NaN where the DEM has none, or they are far from it
    slopes: Array  # (n, 2) of the terrain towards east and north
    bends: Array  # (n, `NUM_BENDS`) at most about 1 at the scene's edges: what all heights may be wrong by
    gains: Array  # (K,) of the bands, the finest first
    sigma: float  # standard deviation of single altitudes [m]
    alike: float  # as many points are worth one: their errors resemble each other
    relief: float  # the DEM's relief as a multiple of the tie points'
    shows: bool  # whether that may be one

    @property
    def effective_sigma(self) -> float:
        """Standard deviation of single altitudes, as if their errors were independent [m]."""
        return float(self.sigma * self.alike**0.5)


@dataclass(frozen=True, eq=False)
class Relief:
    """A DEM beside the heights that rays alone give to tie points."""

    bands: Bands | None  # None where there are too few points
    tell: BoolArray  # (P,) points whose rays tell their heights better than the DEM does
    delivered: Array  # (3,) how they lie to the DEM as delivered: level, rise to the east, to the north [m]
    fit: Array  # (3, P) that by the heights of the points
    cameras: Array  # (3,) what the cameras' accuracies let expect of that [m]; NaN where they do not say
    posts: Array | None = None  # (P, 4) numbers of the DEM's posts about the points, where it has some

    def beyond(self, bias: float) -> Array:
        """Return level and slopes (3,) above the DEM as delivered, over their standard deviations."""
        return np.asarray(np.abs(self.delivered) / np.hypot(self.cameras, bias))

    def common_sigma(self, bias: float) -> Array:
        """Return the sigmas (`NUM_BENDS`,) [m] of errors in common: `bias`, or more where points contradict it."""
        sigma = np.full(NUM_BENDS, bias)
        contradicts = self.beyond(bias) > SURELY
        sigma[:3][contradicts] = _EDGE_TO_RMS_DISTANCE * np.abs(self.delivered)[contradicts]
        return sigma

    @classmethod
    def of(cls, terrain: Terrain, ground: Array, strong: BoolArray, sharp: Array, stated: float = 0.0) -> Relief:
        """Compare a DEM with points (P, 3) by rays alone; heights of the `strong` (P,) ones are known to
        `sharp` (P,) [m].

        Those tell that are known better than single heights of the DEM are, as `stated` [m] or as they lie to it.
        Rises are measured at the RMS distance of the points from their middle.
        """
        index = np.flatnonzero(strong)
        off = ground[index, 2] - np.asarray(terrain(ground[index, 0], ground[index, 1]))
        index, off = index[np.isfinite(off)], off[np.isfinite(off)]
        tell, fit, unknown = np.zeros(len(strong), dtype=bool), np.zeros((3, len(strong))), np.full(3, np.nan)
        posts_of = getattr(terrain, "posts", None)
        posts = None if posts_of is None else posts_of(ground[:, 0], ground[:, 1])
        if len(index) < MANY:
            return cls(None, tell, unknown, fit, unknown)
        bands = Bands.of(terrain, ground[index])
        at = bands.local(ground[index])
        at -= at.mean(axis=0)
        flat = np.column_stack([np.ones(len(at)), at / np.sqrt((at**2).sum(axis=1).mean())])
        near = _middling(off)
        for _ in range(BACKFITTING):
            delivered = _least_squares_fit(flat[near], off[near])
            left = np.abs(off - flat @ delivered)
            near = left <= OUTLIER * robust_spread(left)
        tell[index[sharp[index] < max(robust_spread(left), stated)]] = True
        fit[:, index] = np.linalg.pinv(flat)
        return cls(bands, tell, delivered, fit, unknown, posts)

    def independent(self, points: IntArray) -> float:
        """Return the number of independent heights that a DEM has at points (n,), at most: of its posts there."""
        return np.inf if self.posts is None else float(len(np.unique(self.posts[points])))


def believe(relief: Relief, index: IntArray, ground: Array, stated: float) -> RegularisedDem | None:
    """Estimate the accuracy of a DEM at the points `index` (n,), at (n, 3); None where too few heights
    tell.

    Single altitudes are stated to be known to `stated` [m]. Points that tell are held where they are, less what a
    motion or a bend of the scene explains of their distance: what else they have is the DEM's error, and no ray is
    bent for it.
    """
    if relief.bands is None:
        return None
    heights, slopes = relief.bands.at(ground)
    known = np.isfinite(heights[0])
    tell = relief.tell[index] & known
    if tell.any():
        tell[tell] = _middling((ground[:, 2] - heights.sum(axis=0))[tell])
    if tell.sum() < MANY:
        return None
    at = relief.bands.local(ground)
    at = at - at[tell].mean(axis=0)
    half = max(float(np.abs(at[tell]).max()), 1.0)
    smooth, by_place = quadratic_basis(at / half), _bend_slopes(at / half) / half
    trend = _least_squares_fit(smooth[tell], heights[:, tell].T)
    kept, bent = (smooth @ trend).sum(axis=1), heights.T - smooth @ trend
    bent_slopes = slopes - np.einsum("nmx,mk->knx", by_place, trend)
    above = ground[:, 2] - kept
    found = _compared(at, above, bent, bent_slopes, smooth, tell, relief.independent(index[tell]))
    fits, left, rising = found.fits, found.left, found.rising
    freedom = max(int(fits.sum()) - found.unknowns, 1)
    pull = rising[fits] - smooth[fits] @ _least_squares_fit(smooth[fits], rising[fits])
    alt = np.where(tell, ground[:, 2] - found.part, kept + bent @ found.gains)
    is_held = known & (fits | ~relief.tell[index])
    times, shows = _relief_ratio(bent[fits].sum(axis=1), above[fits], smooth[fits], stated)
    return RegularisedDem(
        np.where(is_held, alt, np.nan),
        rising + np.einsum("nmx,mk->nx", by_place, trend),
        smooth,
        found.gains,
        float(np.sqrt((STATED_FREEDOM * stated**2 + (left[fits] ** 2).sum()) / (STATED_FREEDOM + freedom))),
        max(variance_inflation(at[fits], pull * left[fits, None]), fits.sum() / relief.independent(index[fits])),
        times,
        shows,
    )


@dataclass(frozen=True, eq=False)
class _Compared:
    """Heights of n points against the bands of a DEM."""

    gains: Array  # (K,) of the bands
    rising: Array  # (n, 2) slopes of what is believed of them
    part: Array  # (n,) what moving and bending the scene explains [m]
    left: Array  # (n,) what is left [m]
    fits: BoolArray  # (n,) points that tell, and are not far off
    unknowns: int


def _compared(
    at: Array, above: Array, bent: Array, slopes: Array, smooth: Array, tell: BoolArray, independent: float
) -> _Compared:
    """Return the heights (n,) [m] of points that `tell` (n,) by bands (n, K) of slopes (K, n, 2), a motion
    and a bend (n, m).

    Where hills are too few to be distinguished from errors, no slope is used: as many as the slopes show,
    and as the DEM has `independent` heights at most.
    """
    from scipy.optimize import lsq_linear  # a fifth of a second, of blocks with a DEM alone

    gains, fits, both, believes = np.ones(bent.shape[1]), tell, np.column_stack([above, bent]), True
    for _ in range(BACKFITTING):
        rising = np.einsum("k,knx->nx", gains, slopes)
        hills = fits.sum() / variance_inflation(at[fits], rising[fits] - rising[fits].mean(axis=0))
        believes = believes and min(hills, independent) > _HILLS
        moved = smooth
        if believes:  # a shift, a turn, a growth
            moved = np.column_stack([smooth, *(rising * smooth[:, k, None] for k in range(3))])
            free = both[fits] - moved[fits] @ _least_squares_fit(moved[fits], both[fits])
            gains = lsq_linear(free[:, 1:], free[:, 0], (0.0, 1.0)).x
        else:
            gains, rising = np.zeros(bent.shape[1]), np.zeros_like(rising)
        rest = above - bent @ gains
        part = moved @ _least_squares_fit(moved[fits], rest[fits])
        left = rest - part
        spread = robust_spread(left[fits])
        fits = tell & (np.abs(left) <= max(OUTLIER * spread, 1e-6))
    return _Compared(gains, rising, part, left, fits, moved.shape[1] + len(gains))


def _middling(values: Array) -> BoolArray:
    """Return the mask of n values about their median."""
    off = np.abs(values - np.median(values))
    return np.asarray(off <= OUTLIER * robust_spread(off))


def _least_squares_fit(design: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(design, values, rcond=1e-9)[0], dtype=np.float64)


def variance_inflation(at: Array, pull: Array) -> float:
    """Return the number of points at places (n, 2) that count as one, by their pulls (n, 2) to the east and north.

    Squared sums over cells against those of independent pulls, at the size of cells at which they are largest.
    """
    size, of_single, found = max(float(np.ptp(at, axis=0).max()), 1.0), (pull**2).sum(axis=0), 1.0
    for count in _VARIANCE_CELLS:
        column, row = np.floor((at - at.min(axis=0)) / size * count).astype(np.int64).T
        cell = np.unique(column * (count + 1) + row, return_inverse=True)[1]
        sums = np.stack([np.bincount(cell, one) for one in pull.T])
        found = max(found, float(((sums**2).sum(axis=1) / np.maximum(of_single, 1e-30)).max()))
    return found


def relief_ratio(ground: Array, dem: Array, stated: float) -> tuple[float, bool]:
    """Return the relief of a DEM's heights (n,) as a multiple of that of ground points (n, 3); whether it may be one.

    At the end, when cameras are adjusted: no more than a level and slopes are of these. Heights are known to
    `stated` [m].
    """
    if len(dem) < MANY:
        return float("nan"), True
    near = _middling(ground[:, 2] - dem)
    at = (ground - ground[near].mean(axis=0))[near, :2] * metres_per_unit(ground[near].mean(axis=0))[:2]
    plane = np.column_stack([np.ones(len(at)), at / max(float(np.abs(at).max()), 1.0)])
    relief = dem[near] - plane @ _least_squares_fit(plane, dem[near])
    return _relief_ratio(relief, ground[near, 2], plane, stated)


def _relief_ratio(relief: Array, above: Array, smooth: Array, stated: float) -> tuple[float, bool]:
    """Return a DEM's relief (n,) as a multiple of that of the tie points (n,) [m], and whether it may be theirs."""
    seen = above - smooth @ _least_squares_fit(smooth, above)
    size = max(float(seen @ seen), 1e-12)
    times = float(relief @ seen) / size
    off, rest = relief - seen, relief - times * seen
    sigma = float(np.sqrt(rest @ rest / size / len(seen)) if len(seen) else np.inf)
    far = abs(times - 1.0)
    wrong = (
        far > _MAX_RELIEF_DIFFERENCE
        and far > CRITICAL * sigma
        and float(off @ off) > len(off) * (MUCH_NOISE * stated) ** 2
    )
    return times, not wrong
