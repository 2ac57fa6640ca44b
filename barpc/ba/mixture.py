"""A block near its solution as a mixture: each observation, kept or cut, is noise about the model, or lies anywhere.

With probability 1 - eps of its view an observation is normal about the model, else it is uniform over the area in
which matches were found. Of a track of n views any subset of two or more may be right, its ground point integrated
out, or none. Camera unknowns and what is tried beside them have normal priors; all is linear in them. The logarithm
of the evidence is that of all observations, of the priors, and of the room that they leave (Laplace), so that
explanations with different unknowns compare; eps and the noise are found by expectation and maximisation, cooled from
gross errors down (MacKay 2003, "Information Theory, Inference, and Learning Algorithms", chapters 22 and 28).

Beside them tracks may belong to a group that moves on the ground while the views are taken (`Group`): every subset
then counts twice, still and moved, and of every cell of the ground the share that moves is found with the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from barpc.ba.problem import Problem
from barpc.ba.solve import State
from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray

_HOTTEST = 200.0  # times the noise stated, where it is cooled from: 20 px of 0.1
_COOLED = 0.6  # from one iteration to the next, at most
_LEAST_NOISE = 0.2  # of what is stated
_ITERATIONS = 60
_BEGINNINGS = 6  # reweightings of a first guess
_STANDS = 1e-3, 0.05  # change of the noise (logarithm) and of the log-likelihood at the end
WRONG = 1.0, 10.0  # of so many observations of a view so many are wrong, before any is seen
_EPS = 1e-3, 0.98
_MOST_SUBSETS = (
    4  # views of a track up to which every subset may be right; of more, all of them or all but one
)
NEAR_LIMIT = (
    4.5  # log(wrong area / 2 pi sigma^2), at least: while the noise is large wrong ones lie no nearer
)


@dataclass(frozen=True, eq=False)
class _Tracks:
    """Tracks of n views each."""

    rows: IntArray  # (T, n) their observations, sorted by what views they are of
    sets: IntArray  # where tracks of other views begin
    view: IntArray  # (T, n)
    subsets: BoolArray  # (S, n) which may be right together
    project: Array  # (T, S, 2n, 2n) takes away what the ground point follows; zero outside the subset
    volume: Array  # (T, S) log of what the integral over the ground point leaves
    by_unknown: Array  # (T, n, 2, q)


@dataclass(frozen=True, eq=False)
class Linear:
    """Tie points linearised at a state, in units of their stated standard deviations, and the cameras' priors."""

    view: IntArray  # (K,)
    residual: Array  # (2, K)
    by_unknown: Array  # (2, q, K)
    sigma: Array  # (K,) [px]
    tracks: tuple[_Tracks, ...]
    shape: tuple[int, int]  # N views, q unknowns
    precision: Array  # (N q,) of the priors
    offset: Array  # (N q,) unknowns at the state, less the priors' means
    area: float  # in which a wrong match may lie
    image: float  # of an image

    @property
    def views(self) -> int:
        """N."""
        return self.shape[0]

    def left(self, step: Array) -> Array:
        """Residuals (2, K) after a step (N, q) of the cameras."""
        left: Array = self.residual + np.einsum("cqk,kq->ck", self.by_unknown, step[self.view])
        return left


@dataclass(frozen=True, eq=False)
class Group:
    """Tracks that may have moved while the views were taken, those of every cell of the ground with their share."""

    by_move: Array  # (2, m, K) how a unit of each of its unknowns moves observations [px]
    sigma: Array  # (m,) their prior
    cell: IntArray  # (K,) of the ground, where an observation's track lies
    share: Array  # (K,) probability that its track moves, before anything is known


@dataclass(frozen=True, eq=False)
class Fit:
    """What one explanation makes of a block."""

    evidence: float  # log, but for a constant of the block
    step: Array  # (N, q) of the cameras' unknowns from the state
    extra: Array  # (e,) of what was tried beside them
    noise: float  # observed over stated
    eps: Array  # (N,) part of each view's observations that is wrong
    right: Array  # (K,) probability that an observation is; 0 for those that take no part
    move: Array = field(default_factory=lambda: np.zeros(0))  # (m,) unknowns of a group that moves
    moving: Array = field(default_factory=lambda: np.zeros(0))  # (K,) probability that the track is of it
    scatter: float = 0.0  # its noise, observed over stated


def linearise(problem: Problem, state: State, use: BoolArray, sigma: Array, span: float) -> Linear:
    """Tie points in use (K,) of a problem at a state where they may all be seen; heights span so much [m]."""
    structure = problem.structure
    projected = problem.linearise(state.params, state.points)
    residual = (projected.image - problem.xy) / sigma
    by_point, by_unknown = projected.by_point / sigma, projected.by_unknown / sigma
    finite = np.isfinite(residual).all(axis=0) & np.isfinite(by_point).all(axis=(0, 1))
    order = structure.by_point[(use & finite)[structure.by_point]]
    point = structure.point[order]
    start = np.flatnonzero(np.diff(point, prepend=-1))
    count = np.diff(np.append(start, len(point)))
    half, held = problem.cameras.unknowns.half, problem.point_terms(state.points)[0]
    image = float(np.median(4.0 * half[0] * half[1]) / np.median(sigma) ** 2)
    pixels = float(np.median(np.linalg.norm(by_point[:, :, order], axis=1)))  # a metre
    volume = image / pixels**2 * max(span, 1.0)
    tracks, bases = [], [np.zeros(0)]
    for n in np.unique(count[count >= 2]).tolist():
        rows = order[start[count == n][:, None] + np.arange(n)]
        rows = rows[np.lexsort(structure.view[rows].T)]
        changes = (np.diff(structure.view[rows], axis=0, prepend=-1) != 0).any(axis=1)
        ground = by_point[:, :, rows].transpose(2, 3, 0, 1).reshape(len(rows), 2 * n, 3)
        subsets = _subsets(n)
        project, room = _projectors(ground, subsets, _matrices(held[:, structure.point[rows[:, 0]]]))
        of_cameras = np.ascontiguousarray(by_unknown[:, :, rows].transpose(2, 3, 0, 1))
        seen = np.flatnonzero(changes), structure.view[rows]
        tracks.append(_Tracks(rows, *seen, subsets, project, room - np.log(volume), of_cameras))
        ends = ground.reshape(len(rows), n, 2, 3)[:, [0, -1]].reshape(len(rows), 4, 3)
        bases.append(np.sqrt(np.maximum(np.linalg.det(np.swapaxes(ends, 1, 2) @ ends), 0.0)))
    far = (
        max(float(np.quantile(np.linalg.norm(residual[:, order], axis=0), 0.99)), 5.0) if len(order) else 5.0
    )
    parallax = float(np.median(np.concatenate(bases))) * volume / image if len(order) else 0.0
    prior = problem.camera_prior
    return Linear(
        structure.view,
        residual,
        by_unknown,
        sigma,
        tuple(tracks),
        (structure.num_views, by_unknown.shape[1]),
        (1.0 / prior.sigma**2).ravel(),
        (state.params - prior.mean).ravel(),
        2.0 * far * max(2.0 * far, parallax),
        image,
    )


def _subsets(n: int) -> BoolArray:
    """Which views of n may be right together (S, n): all, then fewer."""
    sizes = range(n, 1, -1) if n <= _MOST_SUBSETS else range(n, n - 2, -1)
    chosen = [subset for size in sizes for subset in combinations(range(n), size)]
    out = np.zeros((len(chosen), n), dtype=bool)
    for row, subset in zip(out, chosen, strict=True):
        row[list(subset)] = True
    return out


def _matrices(triangle: Array) -> Array:
    """Symmetric matrices (T, 3, 3) of their upper triangles (6, T)."""
    a, b, c, d, e, f = triangle
    return np.stack([np.stack(row, -1) for row in ((a, b, c), (b, d, e), (c, e, f))], -2)


def _projectors(ground: Array, subsets: BoolArray, held: Array) -> tuple[Array, Array]:
    """I - J (J' J + held)^-1 J' of each subset's rows (T, S, 2n, 2n), and -1/2 log det of the matrix (T, S)."""
    size = ground.shape[1]
    project = np.empty((len(ground), len(subsets), size, size))
    room = np.empty((len(ground), len(subsets)))
    for k, subset in enumerate(subsets):
        mask = np.repeat(subset, 2).astype(np.float64)
        part = ground * mask[:, None]
        matrix = np.swapaxes(part, 1, 2) @ part + held
        matrix += 1e-12 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        project[:, k] = np.diag(mask) - part @ np.linalg.solve(matrix, np.swapaxes(part, 1, 2))
        room[:, k] = -0.5 * np.linalg.slogdet(matrix)[1]
    return project, room


def fit(
    linear: Linear,
    extra: Array | None = None,
    sigma: Array | None = None,
    warm: Fit | None = None,
    group: Group | None = None,
) -> Fit:
    """The block with cameras and, beside them, unknowns of which each moves observations by `extra` (2, e, K) [px].

    Their prior standard deviations are `sigma` (e,) [px]. From a fit that is `warm`, whose unknowns may be fewer, it
    is cooled again only from where the further ones begin; with a `group` that moves from the top.
    """
    return _Mixture(linear, extra, sigma, warm, group).run()


def thinned(linear: Linear, most: int) -> Linear:
    """The same with every n-th track, about so many of them."""
    every = -(-sum(len(tracks.rows) for tracks in linear.tracks) // most)
    if every <= 1:
        return linear
    few = []
    for tracks in linear.tracks:
        view = tracks.view[::every]
        sets = np.flatnonzero((np.diff(view, axis=0, prepend=-1) != 0).any(axis=1))
        parts = (tracks.project[::every], tracks.volume[::every], tracks.by_unknown[::every])
        few.append(_Tracks(tracks.rows[::every], sets, view, tracks.subsets, *parts))
    return replace(linear, tracks=tuple(few))


def moving(linear: Linear, extra: Array, group: Group, found: Fit) -> Array:
    """Probability (K,) that the track of an observation is of a group, by a fit with it, of these tracks or others."""
    left = linear.left(found.step) + np.einsum("cek,e->ck", extra, found.extra) / linear.sigma
    away = np.einsum("cmk,m->ck", group.by_move, found.move) / linear.sigma
    moved = _Moved(left + away, group.share, found.scatter)
    out = np.zeros(len(linear.view))
    for tracks in linear.tracks:
        out[tracks.rows] = _expect(linear, tracks, left, found.noise, found.eps, moved).gone[:, None]
    return out


def log_likelihoods(linear: Linear, residual: Array, found: Fit) -> Array:
    """Log-likelihood (K,) of the track of every observation, at residuals (2, K) in stated standard deviations."""
    out = np.zeros(len(linear.view))
    for tracks in linear.tracks:
        weight = _expect(linear, tracks, residual, found.noise, found.eps)
        out[tracks.rows] = weight.log[:, None]
    return out


def settled(linear: Linear, residual: Array, found: Fit) -> Array:
    """Residuals (2, K) of the right observations once the ground points have moved to where these are smallest.

    In standard deviations that they would have then; 0 of the wrong ones.
    """
    out = np.zeros_like(residual)
    for tracks in linear.tracks:
        weight = _expect(linear, tracks, residual, found.noise, found.eps)
        count, n = tracks.rows.shape
        project = np.einsum("ts,tsij->tij", weight.of_subset, tracks.project)
        r = residual[:, tracks.rows].transpose(1, 2, 0).reshape(count, 2 * n, 1)
        free = np.trace(project, axis1=1, axis2=2)[:, None, None] / (2 * n)
        off = (project @ r) / np.sqrt(np.maximum(free, 0.1)) / found.noise
        out[:, tracks.rows] = off.reshape(count, n, 2).transpose(2, 0, 1)
    return out


def first_guess(
    linear: Linear, found: Fit, extra: Array, new: Array, precision: Array
) -> tuple[Array, float, float]:
    """Unknowns (e,) that move observations by `new` (2, e, K) [px], beside a fit's with its `extra` [px].

    They have the least sum of what all tracks are off by, not of its squares; also the median of that, and the sum over
    the noise. Their prior's precisions are the last of `precision`.
    """
    left = linear.left(found.step) + np.einsum("cek,e->ck", extra, found.extra) / linear.sigma
    prior = np.diag(precision[len(precision) - new.shape[1] :])
    parts = []
    for tracks in linear.tracks:
        count, n = tracks.rows.shape
        beside = (
            (new[:, :, tracks.rows] / linear.sigma[tracks.rows])
            .transpose(2, 3, 0, 1)
            .reshape(count, 2 * n, -1)
        )
        some = np.flatnonzero(beside.any(axis=(1, 2)))
        off = tracks.project[some, 0] @ left[:, tracks.rows[some]].transpose(1, 2, 0).reshape(
            len(some), 2 * n, 1
        )
        parts.append((off, tracks.project[some, 0] @ beside[some]))
    moved, far = np.zeros(new.shape[1]), [np.zeros(0)]
    for _ in range(_BEGINNINGS):
        matrix, gradient, far = prior.copy(), prior @ moved, []
        for off, turned in parts:
            now = off + turned @ moved[:, None]
            far.append(np.sqrt((now**2).sum(axis=(1, 2)) + found.noise**2))
            weight = turned / far[-1][:, None, None]
            matrix += (np.swapaxes(weight, 1, 2) @ turned).sum(axis=0)
            gradient = gradient + (np.swapaxes(weight, 1, 2) @ now).sum(axis=0)[:, 0]
        moved = moved - np.linalg.solve(matrix, gradient)
    distances = np.concatenate(far)
    middle = float(np.median(distances)) if len(distances) else 0.0
    return moved, middle, float(distances.sum()) / found.noise


@dataclass(frozen=True, eq=False)
class _Moved:
    """Observations as they are for tracks of a group that moves."""

    residual: Array  # (2, K)
    share: Array  # (K,) of the track's cell
    noise: float


@dataclass(frozen=True, eq=False)
class _Expected:
    log: Array  # (T,) log-likelihood of a track
    of_subset: Array  # (T, S) probability of each subset
    right: Array  # (T, n) of each observation, alone or with others
    square: Array  # (T, S) squared residuals of the subsets
    moved: _Expected | None = None  # the same of tracks that move

    @property
    def sums(self) -> tuple[float, Array]:
        """Squared residuals of subsets as often as they are right, and how often each is."""
        return float((self.of_subset * self.square).sum()), self.of_subset.sum(axis=0)

    @property
    def gone(self) -> Array:
        """Probability (T,) that a track of which something is right moves."""
        assert self.moved is not None
        still, gone = self.of_subset.sum(axis=1), self.moved.of_subset.sum(axis=1)
        return np.asarray(gone / np.maximum(still + gone, 1e-300))


def _expect(
    linear: Linear, tracks: _Tracks, residual: Array, noise: float, eps: Array, moved: _Moved | None = None
) -> _Expected:
    n, size = tracks.rows.shape[1], len(tracks.subsets)
    area = max(linear.area, 2.0 * np.pi * noise**2 * np.exp(NEAR_LIMIT))
    right, wrong = np.log1p(-eps)[tracks.view], np.log(eps)[tracks.view]
    subsets = tracks.subsets.astype(np.float64)
    log, square = _of_subsets(tracks, residual, noise, area)
    both = [log]
    if moved is not None:
        share = moved.share[tracks.rows[:, 0], None]
        log_moved, square_moved = _of_subsets(tracks, moved.residual, moved.noise, area)
        both = [log + np.log1p(-share), log_moved + np.log(share)]
    chance = right @ subsets.T + wrong @ (1.0 - subsets).T
    log = np.concatenate([one + chance for one in both], axis=1)
    odds = np.exp(right - wrong)
    alone = wrong.sum(axis=1) + np.log1p(odds.sum(axis=1)) - np.log(linear.image) - (n - 1) * np.log(area)
    top = np.maximum(log.max(axis=1), alone)
    share, of_none = np.exp(log - top[:, None]), np.exp(alone - top)
    total = share.sum(axis=1) + of_none
    share /= total[:, None]
    single = (of_none / total / (1.0 + odds.sum(axis=1)))[:, None] * odds
    all_log, still = top + np.log(total), share[:, :size]
    if moved is None:
        return _Expected(all_log, still, still @ subsets + single, square)
    gone = share[:, size:]
    right_of_all = (still + gone) @ subsets + single
    of_moved = _Expected(all_log, gone, gone @ subsets, square_moved)
    return _Expected(all_log, still, right_of_all, square, of_moved)


def _of_subsets(tracks: _Tracks, residual: Array, noise: float, area: float) -> tuple[Array, Array]:
    """Log-likelihoods (T, S) of residuals (2, K) if a subset is right, and their squares."""
    count, n = tracks.rows.shape
    r = residual[:, tracks.rows].transpose(1, 2, 0).reshape(count, 1, 2 * n, 1)
    square = (r * (tracks.project @ r))[..., 0].sum(axis=-1)
    members = tracks.subsets.sum(axis=1)
    log = tracks.volume - square / (2.0 * noise**2)
    log -= (n - members) * np.log(area) + 0.5 * (2 * members - 3) * np.log(2.0 * np.pi * noise**2)
    return log, square


class _Mixture:
    """One fit at work: unknowns x = (cameras N q, extra e, those of a group that moves m)."""

    def __init__(
        self,
        linear: Linear,
        extra: Array | None,
        sigma: Array | None,
        warm: Fit | None,
        group: Group | None = None,
    ) -> None:
        self.linear, self.group = linear, group
        self.extra = np.zeros((2, 0, len(linear.sigma))) if extra is None else extra / linear.sigma
        own = np.zeros(0) if sigma is None else 1.0 / sigma**2
        further = own if group is None else np.append(own, 1.0 / group.sigma**2)
        self.precision = np.concatenate([linear.precision, further])
        self.offset = np.concatenate([linear.offset, np.zeros(len(further))])
        self.x = np.zeros(len(self.precision))
        self.left = linear.residual
        self.noise, self.eps = _HOTTEST, np.full(linear.views, WRONG[0] / WRONG[1])
        if warm is not None:
            known = warm.step.size + len(warm.extra)
            self.x[:known] = *warm.step.ravel(), *warm.extra
            self.noise, self.eps = warm.noise, warm.eps
            if extra is not None and group is None and known < len(self.x):
                old, new = np.split(extra, [len(warm.extra)], axis=1)
                self.x[known:], far, _ = first_guess(linear, warm, old, new, own)
                self.noise = max(self.noise, far)
        if group is not None:
            self.noise, self.eps = _HOTTEST, np.full(linear.views, WRONG[0] / WRONG[1])
            self.beside = np.concatenate([self.extra, group.by_move / linear.sigma], axis=1)
            self.moved = _Moved(linear.residual, group.share, self.noise)

    def run(self) -> Fit:
        """Expect and maximise until nothing changes."""
        linear, last, size = self.linear, -np.inf, self.extra.shape[1]
        right, matrix, log = np.zeros(len(linear.sigma)), np.zeros((0, 0)), 0.0
        moving = np.zeros(len(linear.sigma) if self.group is not None else 0)
        for _ in range(_ITERATIONS):
            normal = _Normal(*linear.shape, len(self.x) - linear.precision.size)
            wrong, count = np.zeros(linear.views), np.zeros(linear.views)
            sums, log = np.zeros((2, 2)), 0.0  # squares and freedom, of what stands still and what moves
            for tracks, found in self._expected():
                log += float(found.log.sum())
                right[tracks.rows] = found.right
                wrong += np.bincount(tracks.view.ravel(), (1.0 - found.right).ravel(), linear.views)
                count += np.bincount(tracks.view.ravel(), minlength=linear.views)
                freedom = 2 * tracks.subsets.sum(axis=1) - 3
                square, often = found.sums
                sums[0] += square, float(often @ freedom)
                self._add(tracks, found, self.left, self.extra, self.noise, normal)
                if found.moved is not None:
                    square, often = found.moved.sums
                    sums[1] += square, float(often @ freedom)
                    moving[tracks.rows] = found.gone[:, None]
                    self._add(tracks, found.moved, self.moved.residual, self.beside, self.moved.noise, normal)
            matrix = normal.whole(self.precision)
            gradient = self.precision * (self.offset + self.x)
            gradient += np.concatenate([normal.pull.ravel(), normal.pull_beside])
            inverse = np.linalg.inv(matrix)
            self.x = self.x - inverse @ gradient
            known = len(self.x) - float(inverse.diagonal() @ self.precision)
            seen = max(np.sqrt(sums[0, 0] / max(sums[0, 1] - known, 1.0)), _LEAST_NOISE)
            noise = seen if self.noise <= seen else max(seen, _COOLED * self.noise)
            self.eps = np.clip((wrong + WRONG[0]) / (count + WRONG[1]), *_EPS)
            if self.group is not None:
                self._group(moving, right, sums[1], noise, noise <= seen)
            settled = abs(np.log(noise / self.noise)) < _STANDS[0] and abs(log - last) < _STANDS[1]
            self.noise, last = float(noise), log
            if settled:
                break
        away = self.offset + self.x
        room = float(np.linalg.slogdet(matrix)[1] - np.log(self.precision).sum())
        evidence = log - 0.5 * float(self.precision @ away**2) - 0.5 * room
        camera = linear.precision.size
        step, extra, move = np.split(self.x, [camera, camera + size])
        scatter = 0.0 if self.group is None else self.moved.noise
        step = step.reshape(linear.shape)
        return Fit(evidence, step, extra, self.noise, self.eps, right, move, moving, scatter)

    def _group(self, moving: Array, right: Array, sums: Array, noise: float, cold: bool) -> None:
        """The share of every cell that moves, once it is cold, and how much its tracks scatter."""
        assert self.group is not None
        share, scatter = self.group.share, noise
        if cold:
            rows = np.concatenate([tracks.rows[:, 0] for tracks in self.linear.tracks])
            cell = self.group.cell
            weights = moving[rows], np.ones(len(rows))
            gone, all_of = (np.bincount(cell[rows], w, cell.max() + 1) for w in weights)
            share = ((gone + 0.5) / (all_of + 1.0))[cell]
            scatter = max(float(np.sqrt(sums[0] / max(sums[1], 1.0))), noise)
        self.moved = _Moved(self.moved.residual, share, scatter)

    def _expected(self) -> Iterator[tuple[_Tracks, _Expected]]:
        camera, size = self.linear.precision.size, self.extra.shape[1]
        step, extra, move = np.split(self.x, [camera, camera + size])
        self.left = self.linear.left(step.reshape(self.linear.shape))
        self.left += np.einsum("cek,e->ck", self.extra, extra)
        moved = None
        if self.group is not None:
            away = np.einsum("cmk,m->ck", self.beside[:, size:], move)
            moved = self.moved = replace(self.moved, residual=self.left + away)
        for tracks in self.linear.tracks:
            yield tracks, _expect(self.linear, tracks, self.left, self.noise, self.eps, moved)

    def _add(
        self, tracks: _Tracks, found: _Expected, left: Array, beside: Array, noise: float, normal: _Normal
    ) -> None:
        """Add the normal matrix and gradient of some tracks, with the first of the unknowns beside the cameras'."""
        count, n = tracks.rows.shape
        weight = np.einsum("ts,tsij->tij", found.of_subset, tracks.project) / noise**2
        residual = left[:, tracks.rows].transpose(1, 2, 0).reshape(count, 2 * n, 1)
        pull, parts = weight @ residual, tracks.by_unknown
        first = tracks.view[tracks.sets]
        pulls = np.einsum("tna,tnap->tnp", pull.reshape(count, n, 2), parts)
        np.add.at(normal.pull, first, np.add.reduceat(pulls, tracks.sets, axis=0))
        turned = np.ascontiguousarray(np.swapaxes(parts, 2, 3))
        for j in range(n):
            of_all = weight[:, :, 2 * j : 2 * j + 2] @ parts[:, j]
            for i in range(j + 1):
                sums = np.add.reduceat(turned[:, i] @ of_all[:, 2 * i : 2 * i + 2], tracks.sets, axis=0)
                np.add.at(normal.blocks, (first[:, i], first[:, j]), sums)
                if i < j:
                    np.add.at(normal.blocks, (first[:, j], first[:, i]), np.swapaxes(sums, 1, 2))
        size = beside.shape[1]
        if size:
            columns = beside[:, :, tracks.rows].transpose(2, 3, 0, 1).reshape(count, 2 * n, -1)
            some = np.flatnonzero(columns.any(axis=(1, 2)))
            columns = columns[some]
            weighted = weight[some] @ columns
            normal.beside[:size, :size] += np.einsum("tie,tif->ef", columns, weighted, optimize=True)
            normal.pull_beside[:size] += (columns * pull[some]).sum(axis=(0, 1))
            cross = turned[some] @ weighted.reshape(len(some), n, 2, size)
            of_set = np.searchsorted(tracks.sets, some, side="right") - 1
            begin = np.flatnonzero(np.diff(of_set, prepend=-1))
            if len(some):
                sums = np.add.reduceat(cross, begin, axis=0)
                np.add.at(normal.cross[:, :, :size], first[of_set[begin]], sums)


class _Normal:
    """Sums of a normal matrix, view by view."""

    def __init__(self, views: int, q: int, extra: int) -> None:
        self.blocks, self.pull = np.zeros((views, views, q, q)), np.zeros((views, q))
        self.cross, self.beside = np.zeros((views, q, extra)), np.zeros((extra, extra))
        self.pull_beside = np.zeros(extra)

    def whole(self, precision: Array) -> Array:
        """The matrix, with the precisions of the priors."""
        size = self.pull.size
        cross = self.cross.reshape(size, -1)
        out = np.block([[np.swapaxes(self.blocks, 1, 2).reshape(size, size), cross], [cross.T, self.beside]])
        out[np.diag_indices(len(out))] += precision
        return out
