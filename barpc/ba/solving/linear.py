"""Solving with the reduced camera matrix: dense Cholesky, or front by front where it is sparse (multifrontal).

A front (`barpc.ba.solving.structure`) is a small dense matrix of its pivots and its border: the matrix's own blocks and
what the fronts below it leave. Its pivots are eliminated, what that leaves of the border goes to the parent (Duff and
Reid 1983). The blocks of the inverse where the matrix has some follow from the last front to the first (Takahashi
1973): that of a border is part of the parent's.
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

IN_MEMORY = 1.5e9  # bytes of a factor; the rest goes to a temporary file


@dataclass(frozen=True, eq=False)
class Blocks:
    """A symmetric matrix of blocks (q, q): N on the diagonal, and those of pairs of views."""

    diagonal: Array  # (N, q, q)
    pairs: Array  # (M, q, q) block i, j of pair i < j
    pair_view: IntArray  # (M, 2) sorted

    def plain(self) -> Array:
        """Return the matrix (N q, N q) as an array."""
        n, q, _ = self.diagonal.shape
        i, j = self.pair_view.T
        dense = np.zeros((n, q, n, q))
        dense[np.arange(n), :, np.arange(n), :] = self.diagonal
        dense[i, :, j, :] = self.pairs
        dense[j, :, i, :] = self.pairs.transpose(0, 2, 1)
        return dense.reshape(n * q, n * q)

    def select(self, views: IntArray) -> Blocks:
        """Return the matrix of some of its views (n,), ascending."""
        place = np.full(len(self.diagonal), -1)
        place[views] = np.arange(len(views))
        kept = (place[self.pair_view] >= 0).all(axis=1)
        return Blocks(self.diagonal[views], self.pairs[kept], place[self.pair_view[kept]])

    def sparse(self) -> sp.csr_array:
        """Return the matrix (N q, N q) as scipy has it."""
        n, q, _ = self.diagonal.shape
        (i, j), every = self.pair_view.T, np.arange(n)
        row, col = np.concatenate([every, i, j]), np.concatenate([every, j, i])
        order = np.lexsort((col, row))
        data = np.concatenate([self.diagonal, self.pairs, self.pairs.transpose(0, 2, 1)])[order]
        indptr = np.searchsorted(row[order], np.arange(n + 1))
        return sp.csr_array(sp.bsr_array((data, col[order], indptr), shape=(n * q, n * q)))

    @classmethod
    def of(cls, matrix: Array | sp.csr_array, size: int) -> Blocks:
        """Return a symmetric matrix (N q, N q) as blocks of q = `size` unknowns a view."""
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
    """Arrays in the order they came; in a temporary file once they are more than so many bytes."""

    def __init__(self, in_memory: float | None = None) -> None:
        self.in_memory = IN_MEMORY if in_memory is None else in_memory
        self.kept: list[Array | tuple[int, tuple[int, int]]] = []
        self.size = 0
        self.file: IO[bytes] | None = None

    def append(self, array: Array) -> None:
        """Keep one more."""
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
    """The factor L of a matrix of blocks, of the views that are eliminated."""

    blocks: Blocks
    order: Dissection
    # of every front L of its pivots (p q, p q), above whose diagonal nothing is meant, then of its border (b q, p q)
    parts: ArrayStore = field(default_factory=ArrayStore)

    @property
    def _size(self) -> int:
        return int(self.blocks.diagonal.shape[1])

    @cached_property
    def _owned(self) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Pairs by the front of their first view eliminated; that view and the other; bounds of each front's part."""
        rank, owner = self.order.rank, self.order.owner
        pairs = np.flatnonzero((rank[self.blocks.pair_view] >= 0).all(axis=1))
        i, j = self.blocks.pair_view[pairs].T
        early, late = np.where(rank[i] < rank[j], (i, j), (j, i))
        by_front = np.argsort(owner[early], kind="stable")
        bounds = np.searchsorted(owner[early][by_front], np.arange(len(self.order.fronts) + 1))
        return pairs[by_front], early[by_front], late[by_front], bounds

    def _entries(self, number: int, front: Front) -> tuple[IntArray, IntArray, IntArray, BoolArray]:
        """Return the pairs of a front's pivots: which, their rows and columns in it, and whether row, col is j, i."""
        pairs, early, late, bounds = self._owned
        part = slice(*bounds[number : number + 2])
        return (
            pairs[part],
            self._local(front, late[part]),
            self._local(front, early[part]),
            early[part] < late[part],
        )

    def _local(self, front: Front, views: IntArray) -> IntArray:
        """Return the places of views in a front."""
        rank = self.order.rank
        own = rank[views] - rank[front.pivots[0]]
        beyond = len(front.pivots) + np.searchsorted(rank[front.border], rank[views])
        return np.where(own < len(front.pivots), own, beyond)

    def factorize(self, damping: float) -> float:
        """Factorise a matrix, its diagonal larger by a share `damping` of itself; the logarithm of its determinant."""
        left: dict[int, list[tuple[IntArray, Array]]] = {}
        volume = 0.0
        for number, front in enumerate(self.order.fronts):
            matrix, split = self._assembled(number, front, damping), len(front.pivots) * self._size
            for views, rest in left.pop(number, ()):
                _add(matrix, unknowns_of(self._local(front, views), self._size), rest)
            upper, failed = dpotrf(matrix[:split, :split], lower=1, clean=0)
            if failed:
                raise np.linalg.LinAlgError(f"{failed}-th leading minor not positive definite")
            volume += 2.0 * float(np.log(upper.diagonal()).sum())
            lower = dtrsm(1.0, upper, matrix[split:, :split], side=1, lower=1, trans_a=1)
            self.parts.append(upper)
            self.parts.append(lower)
            if front.parent >= 0:
                rest = dsyrk(-1.0, lower, beta=1.0, c=matrix[split:, split:], lower=1)
                left.setdefault(front.parent, []).append((front.border, rest))
        return volume

    def _assembled(self, number: int, front: Front, damping: float) -> Array:
        """Return the matrix's own part of a front: the lower triangle of its pivots."""
        q, count = self._size, len(front.pivots) + len(front.border)
        matrix = np.zeros((count, q, count, q))  # its transpose: as LAPACK has it
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
        """Return the reduced matrix (m, m) of the unknowns of the last front once all others are eliminated."""
        lower = np.tril(self._of(len(self.order.fronts) - 1)[0])
        return np.asarray(lower @ lower.T)

    def solve(self, b: Array) -> Array:
        """Return the solutions of right-hand sides (n,) or (n, m), n unknowns of the views that are
        eliminated, as given.
        """
        q, rank = self._size, self.order.rank
        chosen = unknowns_of(np.argsort(rank[rank >= 0], kind="stable"), q)
        # rank of the m-th view in use -> place in b
        y = np.ascontiguousarray(b.reshape(len(b), -1)[chosen])
        for number, front in enumerate(self.order.fronts):
            own, border = self._rows(front)
            upper, lower = self._of(number)
            y[own] = dtrsm(1.0, upper, y[own].T, side=1, lower=1, trans_a=1).T
            y[border] -= lower @ y[own]
        for number in range(len(self.order.fronts) - 1, -1, -1):
            own, border = self._rows(self.order.fronts[number])
            upper, lower = self._of(number)
            rest = y[own] - lower.T @ y[border]
            y[own] = dtrsm(1.0, upper, rest.T, side=1, lower=1).T
        out = np.empty_like(y)
        out[chosen] = y
        return out.reshape(b.shape)

    def _of(self, number: int) -> tuple[Array, Array]:
        """Return L of a front: of its pivots and of its border."""
        return self.parts[2 * number], self.parts[2 * number + 1]

    def _rows(self, front: Front) -> tuple[slice, IntArray]:
        """Return the unknowns of a front's pivots and its border, in the order of elimination."""
        first = int(self.order.rank[front.pivots[0]])
        q = self._size
        return slice(first * q, (first + len(front.pivots)) * q), unknowns_of(self.order.rank[front.border], q)

    def inverse(self) -> Blocks:
        """Return the inverse's blocks where the matrix has some; zero for views that are not eliminated."""
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
            self._take(out, number, front, whole)
        return out

    def _inverse_of(self, number: int, front: Front, known: dict[int, Array]) -> Array:
        """Return the inverse's part (m q, m q) of a front, by that of its parent."""
        (upper, lower), split = self._of(number), len(front.pivots) * self._size
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

    def _take(self, out: Blocks, number: int, front: Front, whole: Array) -> None:
        """Put the blocks of a front's pivots where they belong."""
        count = len(front.pivots) + len(front.border)
        blocks = whole.reshape(count, self._size, count, self._size)
        own = np.arange(len(front.pivots))
        out.diagonal[front.pivots] = blocks[own, :, own, :]
        pairs, row, col, flipped = self._entries(number, front)
        found = blocks[row, :, col, :]
        out.pairs[pairs] = np.where(flipped[:, None, None], found.transpose(0, 2, 1), found)


def _add(matrix: Array, place: IntArray, rest: Array) -> None:
    """Add the remainder of a front below, run by run of its places: they mostly follow each other."""
    starts = np.flatnonzero(np.diff(place, prepend=-2) != 1)
    stops = np.append(starts[1:], len(place))
    for a, b in zip(starts, stops, strict=True):
        for c, d in zip(starts, stops, strict=True):
            if d <= b:
                matrix[place[a] : place[a] + b - a, place[c] : place[c] + d - c] += rest[a:b, c:d]


Matrix = Array | Blocks


@dataclass(frozen=True)
class Factor:
    """A factorised symmetric positive definite matrix."""

    solve: Callable[[Array], Array]  # (n,) or (n, m) right-hand sides -> solutions
    method: str  # "dense" or "multifrontal"
    inverse: Callable[[], Blocks] | None = None  # the inverse's blocks where the matrix has some, if it has blocks
    whole_inverse: Callable[[], Array] | None = None  # (n, n), of a dense one
    log_determinant: float = np.nan  # of the matrix


def factorize(matrix: Array, damping: float = 0.0) -> Factor:
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


def factorize_blocks(matrix: Blocks, order: Dissection, damping: float = 0.0, less: Array | None = None) -> Factor:
    """Factorise S, of the views in an order of elimination, less B^T B of a few rows `less` (m, n)."""
    _require_finite(matrix.diagonal)
    cholesky = Cholesky(matrix, order)
    volume = cholesky.factorize(damping)
    factor = Factor(cholesky.solve, "multifrontal", cholesky.inverse, log_determinant=volume)
    return factor if less is None else _updated(factor, less, order)


def _require_finite(diagonal: Array) -> None:
    if not np.isfinite(diagonal).all():
        raise AdjustError("the normal equations are not finite: a camera cannot be evaluated at its tie points")


def woodbury(solve: Callable[[Array], Array], less: Array) -> tuple[Array, Array]:
    """Return R (n, m) of (S - B^T B)^-1 = S^-1 + R R^T by solutions with S and B = `less` (m, n); U of I - B S^-1 B^T.

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
