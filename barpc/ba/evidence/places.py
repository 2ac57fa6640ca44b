"""Where in an image tie points that took no part are met worse than in the rest of it: what one median hides.

Rows, columns and cells of each image, halved again and again, are tested against the rest of their image. That no
place is worse than another is the one assumption, so that neither how much ties scatter nor how many are wrong
matters. Two tests, each bounded over all places (Bonferroni): of how many lie far off by the same, which wrong matches
do not (exact, hypergeometric), and of what the near ones have in common (Hotelling). Neighbours share errors: of a
small part of an image one observation is taken, and what is shared and no larger than any adjustment is asked to be is
let be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc, gammaln

from barpc.ba.evidence.scan import LINE
from barpc.ba.usual import CHANCE, FEWEST
from barpc.base.geodesy import Array
from barpc.scene import BoolArray, IntArray

_FINEST = 32  # parts of rows or columns, and a side of the parts of which one observation is taken


@dataclass(frozen=True)
class Place:
    """Rows, columns or a cell of an image in which held-out tie points are met worse than in the rest."""

    view: int
    columns: tuple[float, float] | None  # from, to [px]; None: all
    rows: tuple[float, float] | None
    count: int  # observations of it that were looked at
    far: float  # their share that lies far off by the same
    off: float  # what the far ones are off by, half of them, else what the near ones have in common [px]
    chance: float  # of as much anywhere where all places are alike, at most


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


def met_worse(unused: Unused, size: Array, limit: float, least: float, share: float) -> list[Place]:
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
    found = [_worst(one, size[:, one.view[0]], limit, least, share) for one in whole]
    sure = [replace(one, chance=one.chance * tests) for one in found if one and one.chance * tests < CHANCE]
    return sorted(sure, key=lambda one: one.chance)


def _places() -> IntArray:
    """Return (4, P) of every place parts of the columns, and which, parts of the rows, and which; one part is all.

    Of cells as many as of the finest lines.
    """
    halved = [2**n for n in range(1, _FINEST.bit_length())]
    lines = [(n, k, 1, 0) for n in halved for k in range(n)]
    cells = [(n, k % n, n, k // n) for n in halved if n * n <= 2 * _FINEST for k in range(n * n)]
    return np.array([*lines, *((rows, n, cols, k) for cols, k, rows, n in lines), *cells]).T


_PLACES = _places()


def _held() -> BoolArray:
    """Return (P, C) which places hold which of the smallest parts of an image."""
    columns, k, rows, n = _PLACES[:, :, None]
    row, col = np.divmod(np.arange(_FINEST**2), _FINEST)
    return np.asarray((col * columns // _FINEST == k) & (row * rows // _FINEST == n))


_HELD = _held()


def _part(unused: Unused, size: Array) -> IntArray:
    """Return (2, K) of so many columns and rows of an image, which."""
    return np.clip(unused.xy / size[:, None] * _FINEST, 0, _FINEST - 1).astype(np.int64)


def _thinned(unused: Unused, size: Array) -> Unused:
    """Return one observation, the first, of every small part of an image."""
    col, row = _part(unused, size)
    return unused.part(np.unique(row * _FINEST + col, return_index=True)[1])


def _worst(one: Unused, size: Array, limit: float, least: float, share: float) -> Place | None:
    """Return the place of one image of which chance leaves least, not yet times the places; None without any."""
    col, row = _part(one, size)
    inside = _HELD[:, row * _FINEST + col]
    count = inside.sum(axis=1)
    standard = one.residual / one.deviation
    near = np.hypot(*standard) <= limit
    if near.sum() < 2:
        return None
    axes, spread = _axes(standard[:, near])
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
            sure = _at_least(found - 1, int(count[place]) - 1, int(alike.sum()) - 1, len(near) - 1)
            chances[0, place] = min(1.0, sure * int(of_place.sum()))
    of_near = (inside & near).astype(np.float64)
    here = of_near.sum(axis=1)
    mean = of_near @ along.T / np.maximum(here, 1.0)[:, None]
    common = np.hypot(*mean.T) * float(np.median(one.deviation))
    along = along - along[:, near].mean(axis=1, keepdims=True)
    rest = of_near @ along.T / np.maximum(here, 1.0)[:, None]
    told = (here > 1) & (here < near.sum()) & (common > least)
    known = spread > LINE * spread.max()
    variance = _variances(along * near, of_near, rest, _cells(near, col, row))
    squared = (rest[told][:, known] ** 2 / variance[told][:, known]).sum(axis=1)
    free, others = int(known.sum()), max(float(near.sum() - known.sum() - 1), 1.0)
    chances[1, told] = fdtrc(free, others, squared / free)  # Hotelling's T^2, the variance one of so many
    if not (chances < CHANCE).any():
        return None
    test, worst = divmod(int(chances.argmin()), len(count))
    off, far = float(common[worst]), 0.0
    if test == 0:
        off = float(np.median(np.hypot(*one.residual[:, together[worst]])))
        far = float(together[worst].sum() / count[worst])
    ends = _ends(size[0], *_PLACES[:2, worst]), _ends(size[1], *_PLACES[2:, worst])
    return Place(int(one.view[0]), *ends, int(count[worst]), far, off, float(chances[test, worst]))


def _at_least(found: int, count: int, alike: int, whole: int) -> float:
    """Return the hypergeometric probability of at least so many found among a count, of all that are alike."""
    k = np.arange(found, min(count, alike) + 1)

    def ways(n: int, m: IntArray | int) -> Array:
        return np.asarray(gammaln(n + 1.0) - gammaln(m + 1.0) - gammaln(n - m + 1.0))

    return float(np.exp(ways(alike, k) + ways(whole - alike, count - k) - ways(whole, count)).sum())


def _axes(standard: Array) -> tuple[Array, Array]:
    """Return the axes along which residuals (2, K) scatter most and least, as columns, and their scatter."""
    off = standard - standard.mean(axis=1, keepdims=True)
    variance, axes = np.linalg.eigh(off @ off.T / standard.shape[1])
    return axes[:, ::-1], np.sqrt(np.maximum(variance[::-1], 0.0))


def _cells(near: BoolArray, col: IntArray, row: IntArray) -> Array:
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
