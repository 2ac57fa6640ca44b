"""Parts of images in which tie points are wrong, or displaced, more than elsewhere.

`scan` tests all intervals of rows and columns of the adjusted tie points, by two log-likelihood ratios: of the share of
wrong observations (Kulldorff 1997, "A spatial scan statistic"), and of a displacement that is common to all
observations of the interval.

`worst_regions` compares the check tie points of each part of an image with those of the rest. Parts are rows, columns
and cells of several sizes. The null hypothesis is that all parts have the same distribution: neither the noise nor the
share of wrong matches matters. One test is of the number of outliers with the same displacement, which wrong matches do
not have (exact, hypergeometric). The other is of the mean of the inliers (Hotelling, confirmed by permutation). Both
have Bonferroni's bound. Errors of neighbours are correlated. Therefore one observation is taken in each of the smallest
cells, and a common displacement within the tolerance is ignored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import entr, fdtrc, gammaln, xlogy

from barpc.ba.parameters.additional_parameters import DRIFTS
from barpc.base.geodesy import CHUNK, Array, parts
from barpc.base.statistics import BANDS, CHANCE, FEWEST, OUTLIER, SURE
from barpc.scene import BoolArray, IntArray

BINS = 40  # number of bins of equal size along the rows or columns of an image
_STARTS, _STOPS = np.triu_indices(BINS + 1, 1)  # first bin of each interval, and the bin after its last
_FEWEST_INSIDE = 8  # least number of check observations of a tested region
_FINEST = 32  # smallest cells along each side of an image; one check observation is taken in each
# residuals of two views have one direction: a component is ignored if its spread is below this share of the largest
MIN_EXTENT_RATIO = 0.05


@dataclass(frozen=True)
class Interval:
    """An interval of the rows or columns of an image, and its significance."""

    view: int
    axis: int  # 0: columns, 1: rows
    start: float  # [px]
    stop: float  # [px]
    gain: float  # log-likelihood ratio less the price of the choice among all intervals [nats]
    share: float  # of wrong observations in the interval
    off: float  # common displacement of its other observations, in the unit of the residuals
    by_share: bool  # whether the gain is that of the share; else it is that of the displacement
    apart: float = 0.0  # median residual of the wrong observations [px]; 0: not measured
    moves: bool = False  # whether the share is of observations of a moving group, not of wrong ones
    part: float = 1.0  # length over the length of the image


def price(views: int) -> float:
    """Return the log of the number of intervals of rows and of columns in all views [nats]."""
    return float(np.log(BINS * (BINS + 1) / 2 * 2 * views))


def scan(
    view: IntArray,
    place: Array,
    size: Array,
    wrong: Array,
    off: Array,
    weight: Array,
    floor: float = 0.0,
    least: float = SURE,
) -> list[Interval]:
    """Find the best interval of rows and of columns of each view by each statistic, if its gain exceeds `least` [nats].

    The one of largest gain is first.

    Parameters
    ----------
    view : (K,), of observations
    place : (2, K), image coordinates [px], in images of `size` (2, N)
    wrong : (K,), probability that an observation is wrong
    off : (2, K), residuals of all observations, in standard deviations of inliers
    weight : (K,), weights of the residuals for the displacement
    floor : float, size of displacements that are tolerated [standard deviations]
    """
    views, found = size.shape[1], []
    off, cost = np.clip(off, -OUTLIER, OUTLIER), price(views)
    for axis in (0, 1):
        bin_ = (place[axis] / size[axis][view] * BINS).astype(np.int64).clip(0, BINS - 1)
        rows = np.array([np.ones(len(view)), wrong])
        sums = np.array([np.bincount(view * BINS + bin_, row, views * BINS) for row in rows])
        whole = sums.reshape(2, views, BINS)
        shares = share_log_ratios(whole)
        gains, displaced = _displacements(view, bin_, off, weight, views, floor)
        for by_share, gain in zip((True, False), (shares, gains), strict=True):
            gain[BINS - 1] = 0.0  # the whole image is no interval
            for v, at in enumerate(gain.argmax(axis=0).tolist()):
                surplus, common = float(gain[at, v]) - cost, float(displaced[at, v])
                i, j = int(_STARTS[at]), int(_STOPS[at])
                if not by_share and 2 * (j - i) > BINS and (i == 0 or j == BINS):
                    i, j = (0, i) if j == BINS else (j, BINS)  # the shorter part is the displaced one
                step = size[axis, v] / BINS
                inside, count_wrong = whole[:, v, i:j].sum(axis=1).tolist()
                ends = float(i * step), float(j * step)
                statistics = surplus, count_wrong / max(inside, 1.0), common, by_share
                found.append(Interval(v, axis, *ends, *statistics, part=(j - i) / BINS))
    return sorted((one for one in found if one.gain > least), key=lambda one: -one.gain)


def _interval_sums(bins: Array) -> Array:
    """Return the sums (I, ...) of bins (..., `BINS`) over each of all I intervals."""
    edges = np.zeros((BINS + 1, *bins.shape[:-1]))
    np.moveaxis(bins, -1, 0).cumsum(axis=0, out=edges[1:])
    return np.asarray(edges[_STOPS] - edges[_STARTS])


def _displacements(
    view: IntArray, bin_: IntArray, off: Array, weight: Array, views: int, floor: float
) -> tuple[Array, Array]:
    """Return the gain [nats] of a common displacement of each interval, and its size, both (I, N).

    A score test. A constant, a slope and a bend along the axis are projected out, because the drift of a camera absorbs
    them. It absorbs the ends of a displaced interval, too: a significant interval may be too short.
    """
    at = view * BINS + bin_
    sums = [np.bincount(at, row, views * BINS) for row in (weight, *(weight * off))]
    count, *shifts = np.array(sums, dtype=np.float64).reshape(3, views, BINS)
    smooth = np.vander(np.linspace(-1.0, 1.0, BINS), DRIFTS, increasing=True)
    weighted = count[:, :, None] * smooth
    normal = np.swapaxes(weighted, 1, 2) @ smooth + 1e-9 * np.eye(DRIFTS) * (count.sum(axis=1) + 1.0)[:, None, None]
    shift = np.stack(shifts, axis=2)  # (N, bins, 2)
    followed = smooth @ np.linalg.solve(normal, smooth.T @ shift)
    left = (off - np.ascontiguousarray(followed.reshape(-1, 2).T).take(at, axis=1)) * np.sqrt(weight)
    scatter = [[np.bincount(view, a * b, views) for a in left] for b in left]
    size, axes = np.linalg.eigh(np.moveaxis(np.array(scatter), 2, 0) / (count.sum(axis=1) + 1.0)[:, None, None])
    rest = np.swapaxes((shift - count[:, :, None] * followed) @ axes, 1, 2)
    across = np.linalg.solve(np.linalg.cholesky(normal), np.swapaxes(weighted, 1, 2))
    size = np.maximum(size, 1.0)
    gain, displaced = np.empty((2, len(_STARTS), views))
    for some in parts(views, CHUNK // BINS):
        squares = (_interval_sums(bins) ** 2 for bins in (*rest[some].swapaxes(0, 1), *across[some].swapaxes(0, 1)))
        information, (one, other, *by_smooth) = _interval_sums(count[some]), squares
        information = np.maximum(information - sum(by_smooth), 0.5)
        tolerated = information * floor**2
        gain[:, some] = 0.5 / information * (one / (size[some, 0] + tolerated) + other / (size[some, 1] + tolerated))
        displaced[:, some] = np.sqrt(one + other) / information
    return gain, displaced


def neighbours_alike(view: IntArray, place: Array, residual: Array, views: int) -> Array:
    """Return the evidence (N,) [nats] that neighbours' residuals have equal signs more often than by chance.

    Signs of random wrong matches are equal in half of the cases; of moving objects, bends and jitter in more. The log
    of the number of tests, four in each view, is subtracted.

    Parameters
    ----------
    view, place, residual : (K,), (2, K), (2, K), of wrong observations: views, image coordinates [px], residuals [px]
    views : int, number of views N
    """
    out = np.full(views, -np.inf)
    for v in range(views):
        rows = np.flatnonzero(view == v)
        if len(rows) < 2:
            continue
        axes, size = np.linalg.svd(residual[:, rows], full_matrices=False)[:2]
        # residuals of a pair of views have one direction: the other component has no information
        along = axes.T[size > MIN_EXTENT_RATIO * size[0]] @ residual[:, rows]
        along[1:] -= np.median(along[1:], axis=1, keepdims=True)
        for axis in (0, 1):
            signs = along[:, np.argsort(place[axis, rows], kind="stable")] > 0.0
            alike, count = (signs[:, 1:] == signs[:, :-1]).sum(axis=1), float(len(rows) - 1)
            share = np.maximum(alike / count, 0.5)
            found = count * (np.log(2.0) - entr(share) - entr(1.0 - share))
            out[v] = max(out[v], float(found.max()))
    return out - float(np.log(4 * views))


def share_log_ratios(bins: Array) -> Array:
    """Return the log-likelihood ratios (I, N) of a larger share of wrong ones in an interval, against a constant share.

    `bins` (2, N, `BINS`) are the numbers of observations and of wrong observations.
    """

    def binomial_log_likelihood(k: Array, n: Array) -> Array:
        good = np.maximum(n - k, 0.0)
        return np.asarray(xlogy(k, k) + xlogy(good, good) - xlogy(n, n))

    total, all_bad = bins.sum(axis=2)
    whole, gain = binomial_log_likelihood(all_bad, total), np.zeros((len(_STARTS), bins.shape[1]))
    may_differ = whole < -SURE  # else no interval can be significant
    total, all_bad = total[may_differ], all_bad[may_differ]
    count, bad = _interval_sums(bins[:, may_differ]).swapaxes(0, 1)
    outside, bad_outside = total - count, all_bad - bad
    more = bad * np.maximum(outside, 1e-9) > bad_outside * count
    parted = binomial_log_likelihood(bad, count) + binomial_log_likelihood(bad_outside, outside)
    gain[:, may_differ] = np.where(more, parted - whole[may_differ], 0.0)
    return gain


@dataclass(frozen=True)
class ImageRegion:
    """Rows, columns or a cell of an image in which residuals of check tie points are larger than in the rest."""

    view: int
    columns: tuple[float, float] | None  # from, to [px]; None: all
    rows: tuple[float, float] | None
    count: int  # number of tested observations
    far: float  # share of outliers with the same displacement
    off: float  # median residual of these outliers; if there are none, mean residual of the inliers [px]
    chance: float  # upper bound of the p-value over all regions
    moved: float  # mean displacement of the eighth of all rows or columns around the region [px]; 0 for a cell


@dataclass(frozen=True, eq=False)
class CheckTies:
    """Observations of check tie points, and their residuals."""

    view: IntArray  # (K,)
    xy: Array  # (2, K) observed image coordinates [px]
    residual: Array  # (2, K) projected - observed, points triangulated by the cameras [px]
    deviation: Array  # (K,) standard deviation of the residuals [px]

    def part(self, rows: BoolArray | IntArray) -> CheckTies:
        """Return some of the observations, by mask or indices."""
        return CheckTies(self.view[rows], self.xy[:, rows], self.residual[:, rows], self.deviation[rows])


def worst_regions(checks: CheckTies, size: Array, limit: float, least: float, share: float) -> list[ImageRegion]:
    """Find the region of each image with significantly larger residuals of check tie points; most significant first.

    Parameters
    ----------
    checks : CheckTies
    size : (2, N), of the images [px]
    limit : float, least length of the residual of an outlier [standard deviations]
    least, share : float
        Tolerated mean displacement of inliers [px] and share of outliers in a region.
    """
    whole = [_thinned(checks.part(checks.view == v), size[:, v]) for v in range(size.shape[1])]
    whole = [one for one in whole if len(one.view) >= FEWEST]
    tests = 2.0 * len(whole) * _REGIONS.shape[1]  # two tests of each region
    found = [_worst(one, size[:, one.view[0]], limit, least, share, tests) for one in whole]
    return sorted((one for one in found if one), key=lambda one: one.chance)


def _regions() -> IntArray:
    """Return (4, P) of P regions: number of parts of the columns, index of the part, and both for the rows.

    One part means all columns, or all rows. There are about as many cells as rows or columns of the least size.
    """
    halved = [2**n for n in range(1, _FINEST.bit_length())]
    lines = [(n, k, 1, 0) for n in halved for k in range(n)]
    cells = [(n, k % n, n, k // n) for n in halved if n * n <= 2 * _FINEST for k in range(n * n)]
    return np.array([*lines, *((rows, n, cols, k) for cols, k, rows, n in lines), *cells]).T


_REGIONS = _regions()


def _cells_of_regions() -> BoolArray:
    """Return the mask (P, C) of the smallest cells of an image that are in each region."""
    columns, k, rows, n = _REGIONS[:, :, None]
    row, col = np.divmod(np.arange(_FINEST**2), _FINEST)
    return np.asarray((col * columns // _FINEST == k) & (row * rows // _FINEST == n))


_CELLS_OF_REGIONS = _cells_of_regions()


def _cell_indices(checks: CheckTies, size: Array) -> IntArray:
    """Return column and row number (2, K) of the smallest cell in which each observation is."""
    return np.clip(checks.xy / size[:, None] * _FINEST, 0, _FINEST - 1).astype(np.int64)


def _thinned(checks: CheckTies, size: Array) -> CheckTies:
    """Return the first observation in each of the smallest cells of an image."""
    col, row = _cell_indices(checks, size)
    return checks.part(np.unique(row * _FINEST + col, return_index=True)[1])


def _worst(one: CheckTies, size: Array, limit: float, least: float, share: float, tests: float) -> ImageRegion | None:
    """Return the most significant region of one image, or None; p-values are multiplied by the number of `tests`."""
    col, row = _cell_indices(one, size)
    inside = _CELLS_OF_REGIONS[:, row * _FINEST + col]
    count = inside.sum(axis=1)
    inside[count < _FEWEST_INSIDE] = False
    standard = one.residual / one.deviation
    near = np.hypot(*standard) <= limit
    if near.sum() < 2:
        return None
    axes, spread = principal_axes(standard[:, near])
    along = axes.T @ standard
    chances, together = np.ones((2, len(count))), np.zeros((len(count), len(near)), dtype=bool)
    for place in np.flatnonzero((inside[:, ~near]).sum(axis=1) > np.maximum(share * count, 1)):
        # wrong matches scatter, displaced parts have one residual: count the outliers near the median outlier
        of_place = inside[place] & ~near
        center = np.median(standard[:, of_place], axis=1, keepdims=True)
        alike = ~near & (np.hypot(*(standard - center)) <= limit)
        together[place] = alike & inside[place]
        found = int(together[place].sum())
        if found > share * count[place]:  # the outlier at the median is not counted below
            tail = hypergeometric_tail(found - 1, int(count[place]) - 1, int(alike.sum()) - 1, len(near) - 1)
            chances[0, place] = min(1.0, tail * int(of_place.sum()))
    of_near = (inside & near).astype(np.float64)
    here = of_near.sum(axis=1)
    mean = of_near @ along.T / np.maximum(here, 1.0)[:, None]
    common = np.hypot(*mean.T) * float(np.median(one.deviation))
    along = along - along[:, near].mean(axis=1, keepdims=True)
    rest = of_near @ along.T / np.maximum(here, 1.0)[:, None]
    tested = (count >= _FEWEST_INSIDE) & (here > 1) & (here < near.sum()) & (common > least)
    determined = spread > MIN_EXTENT_RATIO * spread.max()
    variance = _variances(along * near, of_near, rest, _image_cells(near, col, row))
    squared = (rest[tested][:, determined] ** 2 / variance[tested][:, determined]).sum(axis=1)
    free, others = int(determined.sum()), max(float(near.sum() - determined.sum() - 1), 1.0)
    chances[1, tested] = fdtrc(free, others, squared / free)  # Hotelling's T^2 has an F distribution
    chances *= tests
    if (chances[1] < CHANCE).any():
        permuted = _permutation_p_values(along[:, near][determined], of_near[tested][:, near])
        chances[1, tested] = np.where(permuted < CHANCE, chances[1, tested], 1.0)
    if not (chances < CHANCE).any():
        return None
    test, worst = divmod(int(chances.argmin()), len(count))
    off, far = float(common[worst]), 0.0
    if test == 0:
        off = float(np.median(np.hypot(*one.residual[:, together[worst]])))
        far = float(together[worst].sum() / count[worst])
    ends = _limits(size[0], *_REGIONS[:2, worst]), _limits(size[1], *_REGIONS[2:, worst])
    whole = min(BANDS / _REGIONS[[0, 2], worst].max(), 1.0) if None in ends else 0.0
    moved = off * (far or 1.0) * whole
    return ImageRegion(int(one.view[0]), *ends, int(count[worst]), far, off, float(chances[test, worst]), moved)


def _permutation_p_values(along: Array, of_near: Array) -> Array:
    """Return p-values (P,) of the means of regions: shares of permutations in which any region has a larger mean.

    No distribution is assumed, because residuals are not normal. `along` (d, k) are residuals of k inliers along their
    principal axes. `of_near` (P, k) is 1 for the inliers of a region, else 0.
    """
    rng, here, count = np.random.default_rng(0), of_near.sum(axis=1), along.shape[1]
    permutations = round(2.0 / CHANCE)  # twice as many as a p-value of `CHANCE` needs
    along = along - along.mean(axis=1, keepdims=True)
    scale = (1.0 / here - 1.0 / count)[:, None] * (along**2).mean(axis=1)

    def squared_means_over_variances(values: Array) -> Array:
        return np.asarray(((of_near @ values.T / here[:, None]) ** 2 / scale).sum(axis=1))

    found = squared_means_over_variances(along)
    drawn = [squared_means_over_variances(along[:, rng.permutation(count)]).max() for _ in range(permutations)]
    return np.asarray(1.0 - np.searchsorted(np.sort(drawn), found, side="left") / (permutations + 1.0))


def hypergeometric_tail(found: int, count: int, marked: int, whole: int) -> float:
    """Return the probability of at least `found` marked items in a sample of `count` items.

    The sample is drawn without replacement from `whole` items, of which `marked` are marked; 0 if it is impossible.
    """
    k = np.arange(found, min(count, marked) + 1)

    def log_choose(n: int, m: IntArray | int) -> Array:
        return np.asarray(gammaln(n + 1.0) - gammaln(m + 1.0) - gammaln(n - m + 1.0))

    return float(np.exp(log_choose(marked, k) + log_choose(whole - marked, count - k) - log_choose(whole, count)).sum())


def principal_axes(standard: Array) -> tuple[Array, Array]:
    """Return the principal axes (2, 2) of residuals (2, K), as columns, and the standard deviations (2,) along them.

    The axis with the larger standard deviation is first.
    """
    off = standard - standard.mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(off @ off.T / standard.shape[1])
    return axes[:, ::-1], np.sqrt(np.maximum(variance[::-1], 0.0))


def _image_cells(near: BoolArray, col: IntArray, row: IntArray) -> Array:
    """Return indicators (K, C) of the inliers in C cells of an image, about `FEWEST` in each."""
    parts = max(int(np.sqrt(near.sum() / FEWEST)), 1)
    cell = row * parts // _FINEST * parts + col * parts // _FINEST
    return np.asarray((cell[:, None] == np.arange(parts**2)) * near[:, None].astype(np.float64))


def _variances(along: Array, of_near: Array, mean: Array, cells: Array) -> Array:
    """Return the variance (P, 2) of the mean of the inliers of each region.

    `mean` (P, 2) is subtracted inside the region. The variance of inliers is estimated in each of the `cells` (K, C) of
    the image; that of the whole image is taken where it is larger.
    """
    count, in_place = cells.sum(axis=0), of_near @ cells
    here = np.maximum(of_near.sum(axis=1), 1.0)
    found = []
    for values, own in zip(along, mean.T[:, :, None], strict=True):
        left = values**2 @ cells - 2.0 * own * (of_near @ (cells * values[:, None])) + own**2 * in_place
        whole = left.sum(axis=1, keepdims=True) / max(count.sum() - 2.0, 1.0)
        variance = np.maximum(left / np.maximum(count - 1.0, 1.0), whole)
        found.append((in_place * variance).sum(axis=1) / here**2 * (1.0 - here / count.sum()))
    return np.stack(found, axis=1)


def _limits(size: float, parts: int, k: int) -> tuple[float, float] | None:
    """Return start and end [px] of part k of a side of length `size` [px]; None if it is not divided."""
    return None if parts == 1 else (float(k * size / parts), float((k + 1) * size / parts))
