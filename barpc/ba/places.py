"""Where in an image tie points that took no part are met worse than in the rest of it: what one median hides.

Rows, columns and cells of each image, halved again and again, are tested against the rest of their image. That no
place is worse than another is the one assumption, so that neither how much ties scatter nor how many are wrong
matters. Two tests, each bounded over all places (Bonferroni): of how many lie far off in the same direction, which
wrong matches do not (exact, hypergeometric), and of what the near ones have in common (chi-square). Neighbours share
errors: of a small part of an image one observation is taken, and what is shared and no larger than any adjustment
is asked to be is let be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, hypergeom

from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray

CHANCE = 1e-3  # that any place of a block is named where all are alike
_FINEST = 32  # parts of rows or columns, and a side of the parts of which one observation is taken
_CELLS = 8  # a side of the finest cells
_FEWEST = 20  # observations of an image that tell nothing by themselves
_LINE = 0.5  # of the larger spread: a smaller one is that of epipolar lines, which turn over an image


@dataclass(frozen=True)
class Place:
    """Rows, columns or a cell of an image that is met worse than the rest of it."""

    view: int
    columns: tuple[float, float] | None  # from, to [px]; None: all
    rows: tuple[float, float] | None
    count: int  # observations of it that were looked at
    far: float  # their share that lies far off in one direction
    off: float  # what the far ones are off by, half of them, else what the near ones have in common [px]
    chance: float  # of as much anywhere where all places are alike, at most


@dataclass(frozen=True, eq=False)
class Unused:
    """Observations of tie points that took no part."""

    view: IntArray  # (K,)
    xy: Array  # (2, K) where they are [px]
    residual: Array  # (2, K) projected - observed, points triangulated by the cameras [px]
    deviation: Array  # (K,) that residuals have [px]

    def part(self, rows: BoolArray | IntArray) -> Unused:
        """Some of them."""
        return Unused(self.view[rows], self.xy[:, rows], self.residual[:, rows], self.deviation[rows])


def met_worse(unused: Unused, size: Array, limit: float, least: float, share: float) -> list[Place]:
    """The place of every image that is met worst beside the rest of it, where chance hardly leaves as much.

    Parameters
    ----------
    unused : Unused
    size : (2, N), of the images [px]
    limit : float, standard deviations from which on an observation is far off
    least, share : float
        What near ones may have in common [px], and the part of a place that may be far off: no more is named.
    """
    whole = [_thinned(unused.part(unused.view == v), size[:, v]) for v in range(size.shape[1])]
    whole = [one for one in whole if len(one.view) >= _FEWEST]
    tests = 3.0 * len(whole) * _PLACES.shape[1]  # of each place the near ones, and each of two axes
    found = [_worst(one, size[:, one.view[0]], limit, least, share) for one in whole]
    sure = [replace(one, chance=one.chance * tests) for one in found if one and one.chance * tests < CHANCE]
    return sorted(sure, key=lambda one: one.chance)


def _places() -> IntArray:
    """(4, P) of every place parts of the columns, and which, parts of the rows, and which; one part is all."""
    halved = [2**n for n in range(1, _FINEST.bit_length())]
    lines = [(n, k, 1, 0) for n in halved for k in range(n)]
    cells = [(n, k % n, n, k // n) for n in halved if n <= _CELLS for k in range(n * n)]
    return np.array([*lines, *((rows, n, cols, k) for cols, k, rows, n in lines), *cells]).T


_PLACES = _places()


def _part(unused: Unused, size: Array) -> IntArray:
    """(2, K) of so many columns and rows of an image, which."""
    return np.clip(unused.xy / size[:, None] * _FINEST, 0, _FINEST - 1).astype(np.int64)


def _thinned(unused: Unused, size: Array) -> Unused:
    """One observation, the first, of every small part of an image."""
    col, row = _part(unused, size)
    return unused.part(np.unique(row * _FINEST + col, return_index=True)[1])


def _worst(one: Unused, size: Array, limit: float, least: float, share: float) -> Place | None:
    """The place of one image of which chance leaves least, not yet times the places; None where none stands out."""
    columns, k, rows, n = _PLACES[:, :, None]
    col, row = _part(one, size)
    inside = (col * columns // _FINEST == k) & (row * rows // _FINEST == n)  # (P, K)
    count = inside.sum(axis=1)
    standard = one.residual / one.deviation
    near = np.hypot(*standard) <= limit
    if near.sum() < 2:
        return None
    axes, spread = _axes(standard[:, near])
    along = axes.T @ standard
    far = [along[axis] * sign > limit for axis in range(2) for sign in (1.0, -1.0)]
    wrong = np.array([inside @ off.astype(np.float64) for off in far])
    chances = np.ones((len(far) + 1, len(count)))
    for chance, off, bad in zip(chances, far, wrong, strict=False):
        many = np.flatnonzero(bad > share * count)
        sure = hypergeom.sf(bad[many] - 1.0, len(near), int(off.sum()), count[many])
        chance[many] = 2.0 * sure  # of either direction
    here = (inside & near).sum(axis=1)
    mean = (inside & near) @ along.T / np.maximum(here, 1)[:, None]
    common = np.hypot(*mean.T) * float(np.median(one.deviation))
    rest = mean - along[:, near].mean(axis=1)
    left = 1.0 / np.maximum(here, 1) - 1.0 / near.sum()
    told = (here > 1) & (left > 0.0) & (common > least)
    known = spread > _LINE * spread.max()
    squared = (rest[told][:, known] ** 2 / spread[known] ** 2).sum(axis=1) / left[told]
    chances[-1, told] = chi2.sf(squared, int(known.sum()))
    if not (chances < CHANCE).any():
        return None
    test, place = (int(index) for index in np.unravel_index(int(chances.argmin()), chances.shape))
    is_far = test < len(far)
    off_px = float(common[place])
    if is_far:
        off_px = float(np.median(np.hypot(*one.residual[:, inside[place] & far[test]])))
    return Place(
        int(one.view[0]),
        _ends(size[0], *_PLACES[:2, place]),
        _ends(size[1], *_PLACES[2:, place]),
        int(count[place]),
        float(wrong[test, place] / max(count[place], 1)) if is_far else 0.0,
        off_px,
        float(chances[test, place]),
    )


def _axes(standard: Array) -> tuple[Array, Array]:
    """Along which residuals (2, K) scatter most and least, as columns, and how much; of two views along one line."""
    axes, size, _ = np.linalg.svd(standard - standard.mean(axis=1, keepdims=True), full_matrices=False)
    return axes, np.asarray(size / np.sqrt(standard.shape[1]))


def _ends(size: float, parts: int, k: int) -> tuple[float, float] | None:
    return None if parts == 1 else (float(k * size / parts), float((k + 1) * size / parts))
