"""Tie points that move together on the ground between the views: clouds, water, shadows.

Such a group fits a block as well as the still ground does, so outlier rejection may keep both, or the wrong one. The
smaller group is taken as moving. Its share is free in each of `GROUND_CELLS` x `GROUND_CELLS` cells of the ground. The
fit starts from several hypotheses, on a sample of tracks: the rejected observations move, or those of a region do.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import gammainccinv

from barpc.ba.constraints.block import Block
from barpc.ba.evidence.linearised import Linear, linearise
from barpc.ba.evidence.mixture import COOLED, Group, Mixture, MixtureFit, moving
from barpc.ba.robust.heldout import problem_of_block
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.base.geodesy import Array, enu_basis, ground_from_ecef
from barpc.base.statistics import LEVEL, SURE, TIMES
from barpc.scene import BoolArray, IntArray

GROUND_CELLS = 6  # cells along each side of the ground
_BEST_REGIONS = 8  # regions, those of the best score, from which a fit starts


@dataclass(frozen=True, eq=False)
class GroundMotion:
    """Ground points of the tracks of a block in a local frame, and the derivatives of observations by their motion."""

    center: Array  # (3,) [m], ECEF
    low: Array  # (2,) least east and north of the points [m]
    high: Array  # (2,) largest
    place: Array  # (2, K) east and north of the point of each observation [m]
    by_ground: Array  # (2, 3, K) derivative of observations by a motion east, north and up [px/m]

    @classmethod
    def of(cls, problem: Problem, state: State, like: GroundMotion | None = None) -> GroundMotion:
        """Return the ground motion of the points of a problem; `like` gives the frame, else the points do."""
        points = state.points[problem.structure.point]
        center = np.nanmedian(points, axis=0) if like is None else like.center
        basis = enu_basis(ground_from_ecef(center))
        place = (basis[:2] @ (points - center).T) if len(points) else np.zeros((2, 0))
        by_point = problem.project_points(state.params, state.points).by_point
        by_ground = np.einsum("cpk,gp->cgk", by_point, basis)
        if like is None:
            return cls(center, np.nanmin(place, axis=1), np.nanmax(place, axis=1), place, by_ground)
        return cls(center, like.low, like.high, place, by_ground)

    def part(self, rows: IntArray) -> GroundMotion:
        """Return the ground motion of the observations `rows`."""
        return replace(self, place=self.place[:, rows], by_ground=self.by_ground[..., rows])

    @cached_property
    def pixel(self) -> float:
        """Ground sample distance [m], median of all observations."""
        return self.pixel_of(np.arange(self.by_ground.shape[2]))

    def pixel_of(self, rows: IntArray) -> float:
        """Return the ground sample distance [m], median of the observations `rows`."""
        return float(1.0 / np.nanmedian(np.sqrt((self.by_ground[:, :2, rows] ** 2).sum(axis=(0, 1)) / 2.0)))

    def cells(self, number: int) -> IntArray:
        """Return the cell (K,) of the point of each observation, of `number` x `number` cells of the ground."""
        part = (self.place - self.low[:, None]) / np.maximum(self.high - self.low, 1e-9)[:, None]
        row, col = np.nan_to_num(part * number).astype(np.int64).clip(0, number - 1)
        return np.asarray(row * number + col)

    def by_moves(self, view: IntArray, views: int) -> Array:
        """Return the displacements (2, 2 N - 2, K) [px] by motions of `pixel` east and north in views but the first."""
        out = np.zeros((2, 2 * (views - 1), len(view)))
        for v in range(1, views):
            rows = np.flatnonzero(view == v)
            out[:, 2 * v - 2 : 2 * v, rows] = self.by_ground[:, :2, rows] * self.pixel
        return out


@dataclass(frozen=True)
class Motion:
    """The record of a moving group for the report."""

    metres: float  # largest motion between two views, without the part that a height would explain [m]
    between: tuple[int, int]  # these two views
    share: float  # of the tracks of the block
    box: tuple[float, float, float, float]  # west, south, east, north [deg]: 5 % and 95 % quantiles of its tracks
    side: str  # of the block, as "north-west"; "": on no single side
    gcps: tuple[str, ...] = ()  # names of control points among them
    dates: tuple[str, str] = ("", "")  # of the two views; empty: unknown


@dataclass(frozen=True, eq=False)
class MovingGroup:
    """A fitted moving group of tie points."""

    metres: float  # as in `Motion`
    between: tuple[int, int]
    member: BoolArray  # (K,) observations of its tracks
    shares: Array  # (GROUND_CELLS^2,) share of moving tracks in each cell
    ground: GroundMotion
    fit: MixtureFit  # the fit with the group


def may_move(linear: Linear, ground: GroundMotion, base: MixtureFit, extra: Array, sigma: Array) -> bool:
    """Return whether a region of the ground may move: its score on a sample of tracks exceeds the price of a group.

    The largest score expected by chance among R regions is subtracted: half the chi-square quantile exceeded with
    probability 1 / R.
    """
    few, group = linear.thinned(), _uniform_group(linear, ground)
    if not few.tracks:
        return False
    chance = float(gammainccinv(0.5 * len(group.sigma), 1.0 / len(_GROUND_REGIONS)))
    all_of, some = (sum(tracks.rows.size for tracks in one.tracks) for one in (linear, few))
    gain = _region_gains(few, group, base, extra, sigma).max() - chance
    return bool(gain * all_of / some > price_of_group(linear, group.cell) + SURE)


def _uniform_group(linear: Linear, ground: GroundMotion) -> Group:
    """Return a group to which each track belongs with prior probability 0.5."""
    by_move, cell = ground.by_moves(linear.view, linear.views), ground.cells(GROUND_CELLS)
    return Group(by_move, np.full(by_move.shape[1], TIMES), cell, np.full(len(cell), 0.5))


def proposal(linear: Linear, ground: GroundMotion, base: MixtureFit, extra: Array, sigma: Array) -> Group:
    """Return the start of a fit of the most likely moving group, beside the fit `base`."""
    few, group = linear.thinned(), _uniform_group(linear, ground)
    cell, rows = group.cell, few.in_tracks
    starts = [replace(group, share=share) for share in _start_shares(linear, group, base, extra, sigma)]
    # fits are iterated to the end, as a few iterations do not show which start is the best
    ended = [(Mixture(few, extra, sigma, base, one).run(cooled=COOLED**2), one) for one in starts]
    found, start = max(ended, key=lambda row: row[0].evidence)
    shares = _cell_shares(found.moving, cell, rows)[cell]
    member = moving(linear, extra, replace(start, share=shares), found)
    larger = bool(np.mean(member[rows] > 0.5) > 0.5)  # the larger group stands still
    share = (1.0 - member if larger else member).clip(LEVEL, 1.0 - LEVEL)
    return replace(group, share=share, start=None if larger else found)


def price_of_group(linear: Linear, cell: IntArray) -> float:
    """Return the price of the shares of the cells [nats]: half the log of the number of tracks in each."""
    first = np.concatenate([tracks.rows[:, 0] for tracks in linear.tracks])
    count = np.bincount(cell[first])
    return float(0.5 * np.log(count[count > 0]).sum())


def _start_shares(linear: Linear, group: Group, base: MixtureFit, extra: Array, sigma: Array) -> Iterator[Array]:
    """Yield start values (K,) of the probability that tracks move: of rejected ones, then of the likeliest regions."""
    cut = np.where(base.right < 0.5, 1.0 - LEVEL, LEVEL)
    if (cut[linear.in_tracks] > 0.5).any():
        yield cut
    gains = _region_gains(linear, group, base, extra, sigma)
    for region in _distinct_regions(_GROUND_REGIONS, gains):
        yield np.where(region[group.cell], 1.0 - LEVEL, LEVEL)


def _region_gains(linear: Linear, group: Group, base: MixtureFit, extra: Array, sigma: Array) -> Array:
    """Return the gain (R,) [nats] of a common motion of each region of the ground: a score test.

    Cameras and terms are eliminated (Schur complement of the curvature at the fit `base`).
    """
    scores = Mixture(linear, extra, sigma, base).scores(group.by_move, group.cell, GROUND_CELLS**2)
    regions = _GROUND_REGIONS.astype(np.float64)
    curvature, pull, across = (np.tensordot(regions, one, axes=1) for one in scores)
    curvature = curvature - np.swapaxes(across, 1, 2) @ across + np.diag(1.0 / group.sigma**2)
    return np.asarray(0.5 * (pull * np.linalg.solve(curvature, pull[..., None])[..., 0]).sum(axis=1))


def _ground_regions() -> BoolArray:
    """Return regions of the ground (R, GROUND_CELLS^2): rectangles, half-planes and bands in eight directions."""
    row, col = np.divmod(np.arange(GROUND_CELLS**2), GROUND_CELLS)
    low, high = np.triu_indices(GROUND_CELLS)
    inside = [(one >= low[:, None]) & (one <= high[:, None]) for one in (row, col)]
    found = [(inside[0][:, None] & inside[1]).reshape(-1, len(row))]
    for angle in np.arange(8) * np.pi / 8:
        away = np.cos(angle) * col + np.sin(angle) * row
        edges = np.quantile(away, np.arange(GROUND_CELLS + 1) / GROUND_CELLS)
        edges[-1] += 1.0
        low, high = np.triu_indices(GROUND_CELLS + 1, 1)
        found.append((away >= edges[low, None]) & (away < edges[high, None]))
    every = np.unique(np.concatenate(found), axis=0)
    return every[every.any(axis=1) & ~every.all(axis=1)]


_GROUND_REGIONS = _ground_regions()


def _distinct_regions(regions: BoolArray, gains: Array) -> list[BoolArray]:
    """Return the `_BEST_REGIONS` best regions, none of which shares more than half of their union with a better one."""
    found: list[BoolArray] = []
    for n in np.argsort(-gains, kind="stable"):
        one = regions[n]
        same = (2 * (one & other).sum() > (one | other).sum() for other in found)
        if not any(same) and len(found) < _BEST_REGIONS:
            found.append(one)
    return found


def _cell_shares(member: Array, cell: IntArray, rows: BoolArray) -> Array:
    """Return the share (GROUND_CELLS^2,) of members among the observations `rows` of each cell."""
    moving_count, count = (np.bincount(cell[rows], w, GROUND_CELLS**2) for w in (member[rows], np.ones(rows.sum())))
    return np.asarray((moving_count + 0.5) / (count + 1.0))


def group_of(linear: Linear, ground: GroundMotion, group: Group, found: MixtureFit) -> MovingGroup:
    """Return the moving group of a fit, with its largest motion between two views."""
    rows = linear.in_tracks
    member = rows & (found.moving > 0.5)
    moved = np.vstack([np.zeros(2), found.move.reshape(-1, 2)]) * ground.pixel
    seen = np.flatnonzero(np.bincount(linear.view[member], minlength=linear.views))
    up = np.array([ground.by_ground[:, :, member & (linear.view == v)].mean(axis=2) for v in seen])
    apart = np.zeros((1, 1)), (0, 0)
    if len(seen) >= 2:
        # a shift common to all views is no motion, and a part along their parallax may be a height
        parallax = -np.linalg.solve(up[:, :, :2], up[:, :, 2:])[..., 0]
        design = np.column_stack([np.tile(np.eye(2), (len(seen), 1)), parallax.ravel()])
        flat = moved[seen].ravel()
        flat = (flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]).reshape(-1, 2)
        between = np.linalg.norm(flat[:, None] - flat, axis=2)
        i, j = np.unravel_index(int(between.argmax()), between.shape)
        apart = between, (int(seen[min(i, j)]), int(seen[max(i, j)]))
    shares = _cell_shares(found.moving, group.cell, rows)
    return MovingGroup(float(apart[0].max()), apart[1], member, shares, ground, found)


def motion_of(problem: Problem, params: Array, one: MovingGroup, block: Block) -> Array:
    """Return the displacements (2, K) [px] of the observations of a block if their tracks moved with a group."""
    part, points = problem_of_block(problem, params, block)
    ground = GroundMotion.of(part, State(params, points), one.ground)
    return np.asarray(np.einsum("cmk,m->ck", ground.by_moves(block.view, len(block.views)), one.fit.move))


def members(problem: Problem, params: Array, one: MovingGroup, block: Block) -> BoolArray:
    """Return the mask (K,) of observations of a block that belong to a group, with camera unknowns (N, q)."""
    if not len(block.view):
        return np.zeros(0, dtype=bool)
    part, points = problem_of_block(problem, params, block)
    state = State(params, points)
    low, high = block.alt_range
    linear = linearise(part, state, np.ones(len(block.view), dtype=bool), block.sigma, high - low)
    ground = GroundMotion.of(part, state, one.ground)
    by_move, cell = ground.by_moves(block.view, len(block.views)), ground.cells(GROUND_CELLS)
    group = Group(by_move, np.full(by_move.shape[1], TIMES), cell, one.shares[cell])
    found = replace(one.fit, extra=np.zeros(0))
    none = np.zeros((2, 0, len(block.view)))
    return moving(linear, none, group, found) > 0.5
