"""Solving with the reduced camera matrix: dense Cholesky, or multifrontal Cholesky where it is sparse.

A front (`barpc.ba.solving.structure`) is a small dense matrix of its pivots and its border. It sums blocks of the
matrix itself and the update matrices of its child fronts. Eliminating its pivots leaves an update matrix of the border,
for the parent (Duff and Reid 1983). The inverse is computed only at the nonzero blocks of the matrix, from the last
front to the first (Takahashi 1973): the inverse of a border is part of the parent's.
"""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import IO

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf, dpotri

from barpc.ba.solving.structure import Dissection, Front, unknowns_of
from barpc.base.errors import AdjustError
from barpc.base.geodesy import Array
from barpc.scene import BoolArray, IntArray

IN_MEMORY = 1.5e9  # bytes of a factor in memory; the rest goes to a temporary file


@dataclass(frozen=True, eq=False)
class Blocks:
    """A symmetric matrix of blocks (q, q): one for each of N views, one for each pair of views with a nonzero block."""

    diagonal: Array  # (N, q, q)
    pairs: Array  # (M, q, q) block i, j of pair i < j
    pair_view: IntArray  # (M, 2) sorted

    def plain(self) -> Array:
        """Return the matrix (N q, N q) as a dense array."""
        n, q, _ = self.diagonal.shape
        i, j = self.pair_view.T
        dense = np.zeros((n, q, n, q))
        dense[np.arange(n), :, np.arange(n), :] = self.diagonal
        dense[i, :, j, :] = self.pairs
        dense[j, :, i, :] = self.pairs.transpose(0, 2, 1)
        return dense.reshape(n * q, n * q)

    def select(self, views: IntArray) -> Blocks:
        """Return the submatrix of the views (n,), ascending."""
        place = np.full(len(self.diagonal), -1)
        place[views] = np.arange(len(views))
        kept = (place[self.pair_view] >= 0).all(axis=1)
        return Blocks(self.diagonal[views], self.pairs[kept], place[self.pair_view[kept]])

    @classmethod
    def of(cls, matrix: Array | sp.csr_array, size: int) -> Blocks:
        """Return the blocks of a symmetric matrix (N q, N q) of q = `size` unknowns per view."""
        whole = sp.csr_array(matrix).tobsr((size, size))
        whole.sort_indices()
        n = len(whole.indptr) - 1
        row, col = np.repeat(np.arange(n), np.diff(whole.indptr)), whole.indices.astype(np.int64)
        diagonal, above = np.zeros((n, size, size)), row < col
        diagonal[row[row == col]] = whole.data[row == col]
        return cls(diagonal, whole.data[above], np.column_stack([row[above], col[above]]))

    def pair(self, i: int, j: int) -> int | None:
        """Return the index of the pair i < j; None where the block is zero."""
        start, stop = np.searchsorted(self.pair_view[:, 0], [i, i + 1])
        at = start + int(np.searchsorted(self.pair_view[start:stop, 1], j))
        return at if at < stop and self.pair_view[at, 1] == j else None


class ArrayStore:
    """A list of arrays, to append to and read; those beyond `in_memory` bytes are in a temporary file."""

    def __init__(self, in_memory: float | None = None) -> None:
        self.in_memory = IN_MEMORY if in_memory is None else in_memory
        self.kept: list[Array | tuple[int, tuple[int, int]]] = []
        self.size = 0
        self.file: IO[bytes] | None = None

    def append(self, array: Array) -> None:
        """Append an array."""
        self.size += array.nbytes
        if self.size <= self.in_memory or not array.size:
            self.kept.append(array)
            return
        if self.file is None:
            self.file = tempfile.TemporaryFile()  # noqa: SIM115
            weakref.finalize(self, self.file.close)
        self.kept.append((self.file.seek(0, 2), array.shape))
        self.file.write(np.ascontiguousarray(array.T).data)

    def __getitem__(self, number: int) -> Array:
        kept = self.kept[number]
        if isinstance(kept, np.ndarray):
            return kept
        assert self.file is not None
        at, (rows, cols) = kept
        out = np.empty((cols, rows))
        self.file.seek(at)
        self.file.readinto(out.data)  # type: ignore[attr-defined]
        return out.T


@dataclass(frozen=True, eq=False)
class Cholesky:
    """The Cholesky factor L of a block matrix, for the views in the elimination order."""

    blocks: Blocks
    order: Dissection
    # two per front: L of its pivots (p q, p q), lower triangle only, and L of its border (b q, p q)
    parts: ArrayStore = field(default_factory=ArrayStore)

    @property
    def _size(self) -> int:
        return int(self.blocks.diagonal.shape[1])

    @cached_property
    def _pairs_by_front(self) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Pairs sorted by the front of their earlier view; the earlier views; the later ones; bounds of each front."""
        rank, owner = self.order.rank, self.order.owner
        pairs = np.flatnonzero((rank[self.blocks.pair_view] >= 0).all(axis=1))
        i, j = self.blocks.pair_view[pairs].T
        early, late = np.where(rank[i] < rank[j], (i, j), (j, i))
        by_front = np.argsort(owner[early], kind="stable")
        bounds = np.searchsorted(owner[early][by_front], np.arange(len(self.order.fronts) + 1))
        return pairs[by_front], early[by_front], late[by_front], bounds

    def _entries(self, number: int, front: Front) -> tuple[IntArray, IntArray, IntArray, BoolArray]:
        """Return index, row and column of the pairs with a pivot in the front, and whether a block is transposed."""
        pairs, early, late, bounds = self._pairs_by_front
        part = slice(*bounds[number : number + 2])
        return (
            pairs[part],
            self._local(front, late[part]),
            self._local(front, early[part]),
            early[part] < late[part],
        )

    def _local(self, front: Front, views: IntArray) -> IntArray:
        """Return the positions of views in a front: its pivots, then its border."""
        rank = self.order.rank
        own = rank[views] - rank[front.pivots[0]]
        beyond = len(front.pivots) + np.searchsorted(rank[front.border], rank[views])
        return np.where(own < len(front.pivots), own, beyond)

    def factorize(self, damping: float) -> float:
        """Factorise the matrix, its diagonal multiplied by 1 + `damping`; return the logarithm of the determinant."""
        updates: dict[int, list[tuple[IntArray, Array]]] = {}
        log_determinant = 0.0
        for number, front in enumerate(self.order.fronts):
            matrix, split = self._assembled(number, front, damping), len(front.pivots) * self._size
            for views, update in updates.pop(number, ()):
                _add_update(matrix, unknowns_of(self._local(front, views), self._size), update)
            upper, failed = dpotrf(matrix[:split, :split], lower=1, clean=0)
            if failed:
                raise np.linalg.LinAlgError(f"{failed}-th leading minor not positive definite")
            log_determinant += 2.0 * float(np.log(upper.diagonal()).sum())
            lower = dtrsm(1.0, upper, matrix[split:, :split], side=1, lower=1, trans_a=1)
            self.parts.append(upper)
            self.parts.append(lower)
            if front.parent >= 0:
                update = dsyrk(-1.0, lower, beta=1.0, c=matrix[split:, split:], lower=1)
                updates.setdefault(front.parent, []).append((front.border, update))
        return log_determinant

    def _assembled(self, number: int, front: Front, damping: float) -> Array:
        """Return a front with only the blocks of the matrix itself (lower triangle, columns of the pivots)."""
        q, count = self._size, len(front.pivots) + len(front.border)
        matrix = np.zeros((count, q, count, q))  # transposed at the end: LAPACK expects Fortran order
        diagonal = self.blocks.diagonal[front.pivots]
        if damping:
            diagonal = diagonal + damping * diagonal * np.eye(q)
        own = np.arange(len(front.pivots))
        matrix[own, :, own, :] = diagonal
        pairs, row, col, flipped = self._entries(number, front)
        block = self.blocks.pairs[pairs]
        matrix[col, :, row, :] = np.where(flipped[:, None, None], block, block.transpose(0, 2, 1))
        return matrix.reshape(count * q, count * q).T

    def last(self) -> Array:
        """Return the reduced matrix (m, m) of the unknowns of the last front, all others being eliminated."""
        lower = np.tril(self._front_factor(len(self.order.fronts) - 1)[0])
        return np.asarray(lower @ lower.T)

    def solve(self, b: Array) -> Array:
        """Return the solutions of right-hand sides (n,) or (n, m): unknowns of the eliminated views, ascending."""
        q, rank = self._size, self.order.rank
        by_rank = unknowns_of(np.argsort(rank[rank >= 0], kind="stable"), q)
        y = np.ascontiguousarray(b.reshape(len(b), -1)[by_rank])  # in the order of elimination
        for number, front in enumerate(self.order.fronts):
            own, border = self._rows(front)
            upper, lower = self._front_factor(number)
            y[own] = dtrsm(1.0, upper, y[own].T, side=1, lower=1, trans_a=1).T
            y[border] -= lower @ y[own]
        for number in range(len(self.order.fronts) - 1, -1, -1):
            own, border = self._rows(self.order.fronts[number])
            upper, lower = self._front_factor(number)
            rest = y[own] - lower.T @ y[border]
            y[own] = dtrsm(1.0, upper, rest.T, side=1, lower=1).T
        out = np.empty_like(y)
        out[by_rank] = y
        return out.reshape(b.shape)

    def _front_factor(self, number: int) -> tuple[Array, Array]:
        """Return the two parts of L of a front: its pivots and its border."""
        return self.parts[2 * number], self.parts[2 * number + 1]

    def _rows(self, front: Front) -> tuple[slice, IntArray]:
        """Return the indices of the unknowns of a front's pivots and border, in the order of elimination."""
        first = int(self.order.rank[front.pivots[0]])
        q = self._size
        return slice(first * q, (first + len(front.pivots)) * q), unknowns_of(self.order.rank[front.border], q)

    def inverse(self) -> Blocks:
        """Return the inverse at the nonzero blocks of the matrix; zero for views that are not eliminated."""
        fronts = self.order.fronts
        out = Blocks(np.zeros_like(self.blocks.diagonal), np.zeros_like(self.blocks.pairs), self.blocks.pair_view)
        known: dict[int, Array] = {}
        children = np.bincount([f.parent for f in fronts if f.parent >= 0], minlength=len(fronts))
        for number in range(len(fronts) - 1, -1, -1):
            front = fronts[number]
            whole = self._inverse_of(number, front, known)
            if children[number]:
                known[number] = whole
            if front.parent >= 0:
                children[front.parent] -= 1
                if not children[front.parent]:
                    del known[front.parent]
            self._copy_blocks(out, number, front, whole)
        return out

    def _inverse_of(self, number: int, front: Front, known: dict[int, Array]) -> Array:
        """Return the inverse (m q, m q) for the views of a front; `known` has that of its parent."""
        (upper, lower), split = self._front_factor(number), len(front.pivots) * self._size
        found, failed = dpotri(upper, lower=1)
        if failed:
            raise np.linalg.LinAlgError(f"{failed}-th pivot is zero")
        own: Array = np.tril(found)
        own += np.tril(own, -1).T
        if not len(front.border):
            return own
        whole = np.empty((split + len(front.border) * self._size,) * 2)
        place = unknowns_of(self._local(self.order.fronts[front.parent], front.border), self._size)
        beyond = known[front.parent][np.ix_(place, place)]
        weights = dtrsm(1.0, upper, lower, side=1, lower=1)
        across = beyond @ weights
        whole[split:, split:], whole[split:, :split], whole[:split, split:] = beyond, -across, -across.T
        whole[:split, :split] = own + weights.T @ across
        return whole

    def _copy_blocks(self, out: Blocks, number: int, front: Front, whole: Array) -> None:
        """Copy the blocks of a front's pivots from its inverse `whole` into `out`."""
        count = len(front.pivots) + len(front.border)
        blocks = whole.reshape(count, self._size, count, self._size)
        own = np.arange(len(front.pivots))
        out.diagonal[front.pivots] = blocks[own, :, own, :]
        pairs, row, col, flipped = self._entries(number, front)
        found = blocks[row, :, col, :]
        out.pairs[pairs] = np.where(flipped[:, None, None], found.transpose(0, 2, 1), found)


def _add_update(matrix: Array, place: IntArray, update: Array) -> None:
    """Add a child front's update matrix at indices `place`, by slices: most indices are consecutive."""
    starts = np.flatnonzero(np.diff(place, prepend=-2) != 1)
    stops = np.append(starts[1:], len(place))
    for a, b in zip(starts, stops, strict=True):
        for c, d in zip(starts, stops, strict=True):
            if d <= b:
                matrix[place[a] : place[a] + b - a, place[c] : place[c] + d - c] += update[a:b, c:d]


Matrix = Array | Blocks


@dataclass(frozen=True)
class Factor:
    """A factorised symmetric positive definite matrix."""

    solve: Callable[[Array], Array]  # (n,) or (n, m) right-hand sides -> solutions
    method: str  # "dense" or "multifrontal"
    inverse: Callable[[], Blocks] | None = None  # inverse at the nonzero blocks; None: dense
    whole_inverse: Callable[[], Array] | None = None  # (n, n) inverse; None: not dense
    log_determinant: float = np.nan  # of the matrix


def factorize(matrix: Array, damping: float) -> Factor:
    """Factorise S + damping diag(S).

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not positive definite.
    AdjustError
        The matrix is not finite.
    """
    diagonal = matrix.diagonal()
    _require_finite(diagonal)
    if not len(diagonal):
        return Factor(lambda b: b, "none", whole_inverse=lambda: matrix, log_determinant=0.0)
    damped = matrix + np.diag(damping * diagonal) if damping else matrix
    cholesky = la.cho_factor(damped, lower=True, check_finite=False)

    def inverse() -> Array:
        lower = np.tril(la.lapack.dpotri(cholesky[0], lower=True)[0])
        return np.asarray(lower + np.tril(lower, -1).T)

    volume = 2.0 * float(np.log(cholesky[0].diagonal()).sum())
    return Factor(
        lambda b: la.cho_solve(cholesky, b, check_finite=False),
        "dense",
        whole_inverse=inverse,
        log_determinant=volume,
    )


def factorize_blocks(matrix: Blocks, order: Dissection, damping: float, less: Array | None = None) -> Factor:
    """Factorise S - B^T B for the views in `order`; B is `less` (m, n), of few rows."""
    _require_finite(matrix.diagonal)
    cholesky = Cholesky(matrix, order)
    volume = cholesky.factorize(damping)
    factor = Factor(cholesky.solve, "multifrontal", cholesky.inverse, log_determinant=volume)
    return factor if less is None else _updated(factor, less, order)


def _require_finite(diagonal: Array) -> None:
    if not np.isfinite(diagonal).all():
        raise AdjustError("the normal equations are not finite: a camera cannot be evaluated at its tie points")


def woodbury(solve: Callable[[Array], Array], less: Array) -> tuple[Array, Array]:
    """Return R (n, m) with (S - B^T B)^-1 = S^-1 + R R^T, and U (m, m) with U^T U = I - B S^-1 B^T; B is `less` (m, n).

    Raises
    ------
    numpy.linalg.LinAlgError
        S - B^T B is not positive definite.
    """
    pulled = solve(np.ascontiguousarray(less.T))
    upper = la.cholesky(np.eye(len(less)) - less @ pulled)
    return np.asarray(la.solve_triangular(upper, pulled.T, trans="T").T), upper


def _updated(factor: Factor, less: Array, order: Dissection) -> Factor:
    """Return the factor of S - B^T B from that of S."""
    root, upper = woodbury(factor.solve, less)

    def solve(b: Array) -> Array:
        first = factor.solve(b)
        return first + root @ (root.T @ b)

    def inverse() -> Blocks:
        assert factor.inverse is not None
        found = factor.inverse()
        by_view = np.zeros((*found.diagonal.shape[:2], len(less)))
        by_view[order.rank >= 0] = root.reshape(-1, *by_view.shape[1:])
        i, j = found.pair_view.T
        found.diagonal[...] += by_view @ by_view.swapaxes(1, 2)
        found.pairs[...] += by_view[i] @ by_view[j].swapaxes(1, 2)
        return found

    volume = factor.log_determinant + 2.0 * float(np.log(upper.diagonal()).sum())
    return Factor(solve, factor.method, inverse, log_determinant=volume)
