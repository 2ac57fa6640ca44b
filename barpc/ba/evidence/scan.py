"""Where in an image ties are wrong, or off, more than elsewhere.

Of ties that took part, all intervals of rows and columns are scanned by two statistics, both about the logarithm of a
likelihood ratio: of the share of observations that are wrong (Kulldorff 1997, "A spatial scan statistic"), and of a
displacement that all observations of the interval have in common.

Of check tie points (`met_worse`: one median hides much), rows, columns and cells of each image, halved again and
again, are tested against the rest of their image. That no place is worse than another is the one assumption, so that
neither how much ties scatter nor how many are wrong matters. Two tests, each bounded over all places (Bonferroni): of
how many lie far off by the same, which wrong matches do not (exact, hypergeometric), and of what the near ones have in
common (Hotelling, then by permutation). Neighbours share errors: of a small part of an image one observation is taken,
and what is shared and no larger than any adjustment is asked to be is let be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import entr, fdtrc, gammaln, xlogy

from barpc.ba.parameters.additional_parameters import DRIFTS
from barpc.base.geodesy import CHUNK, Array, parts
from barpc.base.statistics import BANDS, CHANCE, FEWEST, OUTLIER, SURE
from barpc.scene import BoolArray, IntArray

BINS = 40  # stretches of an image's rows or columns
_STARTS, _STOPS = np.triu_indices(BINS + 1, 1)  # all intervals of these
_FEWEST_INSIDE = 8  # check observations of a place: fewer have no mean
_PERMUTATIONS = 2000  # twice as many as a chance of `CHANCE` takes
_FINEST = 32  # parts of rows or columns, and a side of the parts of which one observation is taken
MIN_EXTENT_RATIO = (
    0.05  # of the larger extent of residuals: a smaller one is that of epipolar lines, which turn over an image
)


@dataclass(frozen=True)
class Interval:
    """A significant interval of an image."""

    view: int
    axis: int  # 0: columns, 1: rows
    start: float  # [px]
    stop: float
    gain: float  # nats, what the choice among all places costs taken off
    share: float  # of its observations that are wrong
    off: float  # what the others have in common, in the units of the residuals
    by_share: bool  # whether the share stands out, or what they have in common
    apart: float = 0.0  # half of those that are wrong are farther off than this, where it was measured
    moves: bool = False  # the share is of a group that moves
    part: float = 1.0  # of its image's rows or columns


def price(views: int) -> float:
    """Return the cost of choosing among the intervals of all views, rows and columns [nats]."""
    return float(np.log(BINS * (BINS + 1) / 2 * 2 * views))


def scan(
    view: IntArray, place: Array, size: Array, wrong: Array, off: Array, told: Array, floor: float = 0.0
) -> list[Interval]:
    """Find the most significant interval, by each statistic, in every view's columns and rows; the best
    first.

    Parameters
    ----------
    view : (K,)
    place : (2, K), where observations are [px], in images of `size` (2, N)
    wrong : (K,), probability that an observation is wrong
    off : (2, K), residuals in standard deviations that they would have, of wrong ones, too
    told : (K,), weights of these; 0 of observations that tell nothing
    floor : float, what displacements are let be [the same]: no adjustment is asked to be better
    """
    views, found = size.shape[1], []
    off, costs = np.clip(off, -OUTLIER, OUTLIER), price(views)
    for axis in (0, 1):
        bin_ = (place[axis] / size[axis][view] * BINS).astype(np.int64).clip(0, BINS - 1)
        rows = np.array([np.ones(len(view)), wrong])
        sums = np.array([np.bincount(view * BINS + bin_, row, views * BINS) for row in rows])
        whole = sums.reshape(2, views, BINS)
        shares = share_log_ratios(whole)
        gains, displaced = _displacements(view, bin_, off, told, views, floor)
        for by_share, gain in zip((True, False), (shares, gains), strict=True):
            gain[BINS - 1] = 0.0  # all of an image is no interval
            for v, at in enumerate(gain.argmax(axis=0).tolist()):
                worth, common = float(gain[at, v]) - costs, float(displaced[at, v])
                i, j = int(_STARTS[at]), int(_STOPS[at])
                if not by_share and 2 * (j - i) > BINS and (i == 0 or j == BINS):
                    i, j = (0, i) if j == BINS else (j, BINS)  # of two parts the smaller one lies off
                step = size[axis, v] / BINS
                inside, wrongs = whole[:, v, i:j].sum(axis=1).tolist()
                ends = float(i * step), float(j * step)
                told_of = worth, wrongs / max(inside, 1.0), common, by_share
                found.append(Interval(v, axis, *ends, *told_of, part=(j - i) / BINS))
    return sorted(found, key=lambda one: -one.gain)


def _intervals(bins: Array) -> Array:
    """Return the sums (intervals, ...) of all intervals of bins (..., `BINS`): rows, which are copied fast."""
    edges = np.zeros((BINS + 1, *bins.shape[:-1]))
    np.moveaxis(bins, -1, 0).cumsum(axis=0, out=edges[1:])
    return np.asarray(edges[_STOPS] - edges[_STARTS])


def _displacements(
    view: IntArray, bin_: IntArray, off: Array, told: Array, views: int, floor: float
) -> tuple[Array, Array]:
    """Return the gain [nats] (N, intervals) by which a displacement of an interval explains residuals, and
    its size.

    The score test beside what a camera follows along an axis: a constant, a slope and a bend are taken off both. Beside
    a step its middle is significant; the step itself explains it.
    """
    at = view * BINS + bin_
    sums = [np.bincount(at, row, views * BINS) for row in (told, *(told * off))]
    count, *shifts = np.array(sums, dtype=np.float64).reshape(3, views, BINS)
    smooth = np.vander(np.linspace(-1.0, 1.0, BINS), DRIFTS, increasing=True)
    weighted = count[:, :, None] * smooth
    normal = np.swapaxes(weighted, 1, 2) @ smooth + 1e-9 * np.eye(DRIFTS) * (count.sum(axis=1) + 1.0)[:, None, None]
    shift = np.stack(shifts, axis=2)  # (N, bins, 2)
    followed = smooth @ np.linalg.solve(normal, smooth.T @ shift)
    left = (off - np.ascontiguousarray(followed.reshape(-1, 2).T).take(at, axis=1)) * np.sqrt(told)
    scatter = [[np.bincount(view, a * b, views) for a in left] for b in left]
    size, axes = np.linalg.eigh(np.moveaxis(np.array(scatter), 2, 0) / (count.sum(axis=1) + 1.0)[:, None, None])
    rest = np.swapaxes((shift - count[:, :, None] * followed) @ axes, 1, 2)
    across = np.linalg.solve(np.linalg.cholesky(normal), np.swapaxes(weighted, 1, 2))
    size = np.maximum(size, 1.0)
    gain, displaced = np.empty((2, len(_STARTS), views))
    for some in parts(views, CHUNK // BINS):
        squares = (_intervals(bins) ** 2 for bins in (*rest[some].swapaxes(0, 1), *across[some].swapaxes(0, 1)))
        own, (one, other, *by_smooth) = _intervals(count[some]), squares
        own = np.maximum(own - sum(by_smooth), 0.5)
        more = own * floor**2
        gain[:, some] = 0.5 / own * (one / (size[some, 0] + more) + other / (size[some, 1] + more))
        displaced[:, some] = np.sqrt(one + other) / own
    return gain, displaced


def neighbours_alike(view: IntArray, place: Array, residual: Array, views: int) -> Array:
    """Return the evidence (N,) [nats] that neighbouring residuals point in the same direction, the choice
    among tests paid for.

    Of wrong matches that lie anywhere they do so in half of the cases; of what moves, bends or shakes, in more.

    Parameters
    ----------
    view : (K,), place : (2, K) [px], residual : (2, K) of observations that are wrong
    views : int, N
    """
    out = np.full(views, -np.inf)
    for v in range(views):
        rows = np.flatnonzero(view == v)
        if len(rows) < 2:
            continue
        axes, size = np.linalg.svd(residual[:, rows], full_matrices=False)[:2]
        # of two views all lie along one line: what is left across it is no direction, or what large ones bend alike
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
    """Return the logarithm (intervals, N) of the likelihood ratio of two shares over one, where that inside is larger.

    `bins` (2, N, `BINS`) are the numbers of observations and of those that are wrong.
    """

    def log(k: Array, n: Array) -> Array:
        good = np.maximum(n - k, 0.0)
        return np.asarray(xlogy(k, k) + xlogy(good, good) - xlogy(n, n))

    total, all_bad = bins.sum(axis=2)
    whole, gain = log(all_bad, total), np.zeros((len(_STARTS), bins.shape[1]))
    told = whole < -SURE  # where all that are wrong lie in one interval, the rest are certain
    total, all_bad = total[told], all_bad[told]
    count, bad = _intervals(bins[:, told]).swapaxes(0, 1)
    outside, bad_outside = total - count, all_bad - bad
    more = bad * np.maximum(outside, 1e-9) > bad_outside * count
    gain[:, told] = np.where(more, log(bad, count) + log(bad_outside, outside) - whole[told], 0.0)
    return gain


@dataclass(frozen=True)
class ImageRegion:
    """Rows, columns or a cell of an image in which residuals of check tie points are larger than in the rest."""

    view: int
    columns: tuple[float, float] | None  # from, to [px]; None: all
    rows: tuple[float, float] | None
    count: int  # observations of it that were looked at
    far: float  # their share that lies far off by the same
    off: float  # what the far ones are off by, half of them, else what the near ones have in common [px]
    chance: float  # of as much anywhere where all places are alike, at most
    moved: float  # mean displacement of an eighth of the rows or columns by it [px]; 0 of a cell, which is no camera's


@dataclass(frozen=True, eq=False)
class Unused:
    """Held-out observations of tie points."""

    view: IntArray  # (K,)
    xy: Array  # (2, K) where they are [px]
    residual: Array  # (2, K) projected - observed, points triangulated by the cameras [px]
    deviation: Array  # (K,) that residuals have [px]

    def part(self, rows: BoolArray | IntArray) -> Unused:
        """Return some of the held-out observations."""
        return Unused(self.view[rows], self.xy[:, rows], self.residual[:, rows], self.deviation[rows])


def met_worse(unused: Unused, size: Array, limit: float, least: float, share: float) -> list[ImageRegion]:
    """Find the place of every image in which held-out tie points are met worst, where chance is unlikely to
    explain it.

    Parameters
    ----------
    unused : Unused
    size : (2, N), of the images [px]
    limit : float, standard deviations from which on an observation is far off
    least, share : float
        Tolerances: displacement that near ones may have in common [px], share of a place that may be far off.
    """
    whole = [_thinned(unused.part(unused.view == v), size[:, v]) for v in range(size.shape[1])]
    whole = [one for one in whole if len(one.view) >= FEWEST]
    tests = 2.0 * len(whole) * _PLACES.shape[1]  # of each place the far ones and the near ones
    found = [_worst(one, size[:, one.view[0]], limit, least, share, tests) for one in whole]
    return sorted((one for one in found if one), key=lambda one: one.chance)


def _region_bounds() -> IntArray:
    """Return (4, P) of every place parts of the columns, and which, parts of the rows, and which; one part is all.

    Of cells as many as of the finest lines.
    """
    halved = [2**n for n in range(1, _FINEST.bit_length())]
    lines = [(n, k, 1, 0) for n in halved for k in range(n)]
    cells = [(n, k % n, n, k // n) for n in halved if n * n <= 2 * _FINEST for k in range(n * n)]
    return np.array([*lines, *((rows, n, cols, k) for cols, k, rows, n in lines), *cells]).T


_PLACES = _region_bounds()


def _cells_of_regions() -> BoolArray:
    """Return (P, C) which places hold which of the smallest parts of an image."""
    columns, k, rows, n = _PLACES[:, :, None]
    row, col = np.divmod(np.arange(_FINEST**2), _FINEST)
    return np.asarray((col * columns // _FINEST == k) & (row * rows // _FINEST == n))


_CELLS_OF_REGIONS = _cells_of_regions()


def _cell_indices(unused: Unused, size: Array) -> IntArray:
    """Return (2, K) of so many columns and rows of an image, which."""
    return np.clip(unused.xy / size[:, None] * _FINEST, 0, _FINEST - 1).astype(np.int64)


def _thinned(unused: Unused, size: Array) -> Unused:
    """Return one observation, the first, of every small part of an image."""
    col, row = _cell_indices(unused, size)
    return unused.part(np.unique(row * _FINEST + col, return_index=True)[1])


def _worst(one: Unused, size: Array, limit: float, least: float, share: float, tests: float) -> ImageRegion | None:
    """Return the place of one image of which chance leaves least, by so many `tests`; None without any."""
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
        # wrong matches lie anywhere, what is moved as a whole lies together: how many do so here, and elsewhere
        of_place = inside[place] & ~near
        center = np.median(standard[:, of_place], axis=1, keepdims=True)
        alike = ~near & (np.hypot(*(standard - center)) <= limit)
        together[place] = alike & inside[place]
        found = int(together[place].sum())
        if found > share * count[place]:  # one of them is where the others are looked for
            sure = hypergeometric_tail(found - 1, int(count[place]) - 1, int(alike.sum()) - 1, len(near) - 1)
            chances[0, place] = min(1.0, sure * int(of_place.sum()))
    of_near = (inside & near).astype(np.float64)
    here = of_near.sum(axis=1)
    mean = of_near @ along.T / np.maximum(here, 1.0)[:, None]
    common = np.hypot(*mean.T) * float(np.median(one.deviation))
    along = along - along[:, near].mean(axis=1, keepdims=True)
    rest = of_near @ along.T / np.maximum(here, 1.0)[:, None]
    told = (count >= _FEWEST_INSIDE) & (here > 1) & (here < near.sum()) & (common > least)
    known = spread > MIN_EXTENT_RATIO * spread.max()
    variance = _variances(along * near, of_near, rest, _image_cells(near, col, row))
    squared = (rest[told][:, known] ** 2 / variance[told][:, known]).sum(axis=1)
    free, others = int(known.sum()), max(float(near.sum() - known.sum() - 1), 1.0)
    chances[1, told] = fdtrc(free, others, squared / free)  # Hotelling's T^2, the variance one of so many
    chances *= tests
    if (chances[1] < CHANCE).any():
        permuted = _by_permutation(along[:, near][known], of_near[told][:, near])
        chances[1, told] = np.where(permuted < CHANCE, chances[1, told], 1.0)
    if not (chances < CHANCE).any():
        return None
    test, worst = divmod(int(chances.argmin()), len(count))
    off, far = float(common[worst]), 0.0
    if test == 0:
        off = float(np.median(np.hypot(*one.residual[:, together[worst]])))
        far = float(together[worst].sum() / count[worst])
    ends = _ends(size[0], *_PLACES[:2, worst]), _ends(size[1], *_PLACES[2:, worst])
    whole = min(BANDS / _PLACES[[0, 2], worst].max(), 1.0) if None in ends else 0.0
    moved = off * (far or 1.0) * whole
    return ImageRegion(int(one.view[0]), *ends, int(count[worst]), far, off, float(chances[test, worst]), moved)


def _by_permutation(along: Array, of_near: Array) -> Array:
    """Return the chance (P,) of as large a mean in some place, by permutations of the residuals among all places.

    Residuals are neither normal nor of one spread: their own values tell what a mean by chance is. `along` (d, k) are
    the residuals along their axes, `of_near` (P, k) tells the places.
    """
    rng, here, count = np.random.default_rng(0), of_near.sum(axis=1), along.shape[1]
    along = along - along.mean(axis=1, keepdims=True)
    scale = (1.0 / here - 1.0 / count)[:, None] * (along**2).mean(axis=1)

    def standard(values: Array) -> Array:
        return np.asarray(((of_near @ values.T / here[:, None]) ** 2 / scale).sum(axis=1))

    found = standard(along)
    drawn = [standard(along[:, rng.permutation(count)]).max() for _ in range(_PERMUTATIONS)]
    return np.asarray(1.0 - np.searchsorted(np.sort(drawn), found, side="left") / (_PERMUTATIONS + 1.0))


def hypergeometric_tail(found: int, count: int, alike: int, whole: int) -> float:
    """Return the probability of `found` or more alike among `count` that are drawn, where `alike` of `whole` are.

    The tail of the hypergeometric distribution, by logarithms of factorials; 0 where so many cannot be drawn.
    """
    k = np.arange(found, min(count, alike) + 1)

    def ways(n: int, m: IntArray | int) -> Array:
        return np.asarray(gammaln(n + 1.0) - gammaln(m + 1.0) - gammaln(n - m + 1.0))

    return float(np.exp(ways(alike, k) + ways(whole - alike, count - k) - ways(whole, count)).sum())


def principal_axes(standard: Array) -> tuple[Array, Array]:
    """Return the axes (2, 2) along which residuals (2, K) about their mean scatter most and least, as columns.

    And their standard deviations (2,), in the unit of the residuals.
    """
    off = standard - standard.mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(off @ off.T / standard.shape[1])
    return axes[:, ::-1], np.sqrt(np.maximum(variance[::-1], 0.0))


def _image_cells(near: BoolArray, col: IntArray, row: IntArray) -> Array:
    """Return the part of the image in which each near observation lies (K, C), 1 or 0."""
    parts = max(int(np.sqrt(near.sum() / FEWEST)), 1)
    cell = row * parts // _FINEST * parts + col * parts // _FINEST
    return np.asarray((cell[:, None] == np.arange(parts**2)) * near[:, None].astype(np.float64))


def _variances(along: Array, of_near: Array, mean: Array, cells: Array) -> Array:
    """Return the variance (P, 2) of the mean of each place about zero, its own part taken off.

    By how much observations scatter in each part of the image, where that is more than in the whole.
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


def _ends(size: float, parts: int, k: int) -> tuple[float, float] | None:
    return None if parts == 1 else (float(k * size / parts), float((k + 1) * size / parts))
