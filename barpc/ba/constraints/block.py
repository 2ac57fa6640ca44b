"""A block: observations of tracks, GCPs and reference points, sorted by view, and its state with delivered cameras."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from barpc.ba.constraints.ground import PointConstraints, convergence_angles, ground_control, reference_control
from barpc.ba.constraints.incremental import BlockPrior, apply_prior
from barpc.ba.constraints.terrain import Relief, Terrain
from barpc.ba.parameters.additional_parameters import AdditionalParameters
from barpc.ba.parameters.priors import CameraPrior, JointPrior, prior_sigmas
from barpc.ba.parameters.projected import Cameras
from barpc.ba.parameters.unknowns import make_unknowns
from barpc.ba.solving.normal import cholesky3, point_products, solve_lower, solve_transposed
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.ba.solving.structure import Structure, counting_sort, make_structure
from barpc.base.errors import BarpcWarning, DisconnectedError, InputError, TiePointError, listed
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.base.options import AdjustOptions
from barpc.scene import BoolArray, GroundPoints, IntArray, Reference, Tracks, View, connected_groups
from barpc.sensor.rpc import localize_stack

MIN_OBSERVATIONS = 4  # least tie points of a view: six unknowns need three points, and a fourth is a check

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class Block:
    """Observations of tracks, GCPs and reference points, sorted by view."""

    views: tuple[View, ...]  # N views
    view: IntArray  # (K,)
    point: IntArray  # (K,) below `num_tracks`: tracks; then below `num_known`: GCPs; then points of the reference
    xy: Array  # (2, K) observed col, row [px]
    sigma: Array  # (K,) [px], view weights applied
    order: IntArray  # (K,) index of each observation in the input: tracks, then GCPs, then reference
    use: BoolArray  # (K,) False for observations in left-out views
    gcps: GroundPoints  # may be empty
    reference: Reference | None
    num_tracks: int
    num_known: int  # number of tracks and GCPs
    num_points: int  # number of tracks, GCPs and reference points
    num_rows: int  # number of observations in the input
    left_out: tuple[str, ...]  # views outside the largest connected group
    known: BoolArray | None = None  # (K,) observations contained in the prior of an earlier block; None: no prior

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the views."""
        return tuple(view.name for view in self.views)

    @property
    def alt_range(self) -> tuple[float, float]:
        """Lowest and highest altitude [m] of the altitude ranges of all views."""
        return min(v.alt_range[0] for v in self.views), max(v.alt_range[1] for v in self.views)

    def without(self, rows: BoolArray) -> Block:
        """Return the block without the observations in the mask `rows` (K,)."""
        keep = ~rows
        return replace(
            self,
            view=self.view[keep],
            point=self.point[keep],
            xy=np.ascontiguousarray(self.xy[:, keep]),
            sigma=self.sigma[keep],
            order=self.order[keep],
            use=self.use[keep],
            known=None if self.known is None else self.known[keep],
        )

    def in_order(self, rows: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
        """Return values (K, ...) in the order of the input observations; zeros for those not in the block."""
        out = np.zeros((self.num_rows, *rows.shape[1:]), rows.dtype)
        out[self.order] = rows
        return out

    def groups(self, rows: BoolArray) -> list[list[int]]:
        """Return the groups of views connected by common points in the mask `rows` (K,), the largest first."""
        order = np.flatnonzero(rows)
        order = order[np.lexsort((self.view[order], self.point[order]))]
        same = np.flatnonzero(np.diff(self.point[order]) == 0)
        pairs = np.unique(np.column_stack([self.view[order[same]], self.view[order[same + 1]]]), axis=0)
        return connected_groups(len(self.views), [(int(i), int(j)) for i, j in pairs])

    def first_points(self) -> Array:
        """Return points (P, 3), ECEF [m]: rays of the first views at their middle altitudes, and control as given."""
        return self._first_points.copy()

    @cached_property
    def own_points(self) -> tuple[IntArray, Structure]:
        """Indices (Q,) of the observed points, and a structure that numbers its points 0 to Q - 1 in this order."""
        index, point = np.unique(self.point, return_inverse=True)
        return index, make_structure(self.view, point, len(self.views), len(index))

    @cached_property
    def _first_points(self) -> Array:
        seen, first = np.unique(self.point, return_index=True)
        points = np.full((self.num_points, 3), np.nan)
        order = np.argsort(first)
        first, seen = first[order], seen[order]
        bounds = np.searchsorted(self.view[first], np.arange(len(self.views) + 1))
        alt = np.array([view.altitude for view in self.views])[self.view[first]]
        ground = localize_stack([view.sensor for view in self.views], self.xy[:, first].T, alt, bounds)
        points[seen] = ecef_from_ground(ground)
        points[self.num_tracks : self.num_known] = ecef_from_ground(self.gcps.lonlatalt)
        if self.reference is not None:
            points[self.num_known :] = ecef_from_ground(self.reference.points.lonlatalt)
        return points


def join(
    views: tuple[View, ...],
    tracks: Tracks,
    gcps: GroundPoints | None,
    options: AdjustOptions,
    keep_largest: bool = False,
    reference: Reference | None = None,
    held: Collection[str] = (),
) -> Block:
    """Join tracks and GCPs into one block; arguments and errors as in `barpc.ba.adjust_tracks`.

    Views `held` are those with the prior of an earlier block, which connects them: they need no tie points.
    """
    names = [view.name for view in views]
    _check_fixed_names(names, options)
    gcps = GroundPoints.none() if gcps is None else gcps
    known = [gcps] if reference is None else [gcps, reference.points]
    starts = tracks.num_points + np.cumsum([0, *(len(points.names) for points in known)])
    view = np.concatenate([tracks.view, *(points.view for points in known)])
    if len(view) and view.max() >= len(views):
        raise InputError(f"tracks name view {view.max()}, but there are {len(views)} views")
    point = np.concatenate([tracks.point, *(s + p.point for s, p in zip(starts, known, strict=False))])
    xy = np.concatenate([tracks.xy, *(points.xy for points in known)])
    sigma = np.concatenate([tracks.sigma, *(points.xy_sigma for points in known)])
    key = point * len(views) + view
    rows = np.arange(len(key)) if (np.diff(key) > 0).all() else np.argsort(key, kind="stable")
    if not (np.diff(key[rows]) > 0).all():
        raise InputError("tracks: a track is observed twice in one view; keep one observation or none")
    count = np.bincount(view, minlength=len(views))
    is_held = np.isin(names, list(held))
    controlled = np.bincount(view[len(tracks.view) :], minlength=len(views)) > 0  # by known points
    controlled |= is_held
    few = [f"{names[v]} ({count[v]})" for v in np.flatnonzero((count < MIN_OBSERVATIONS) & ~controlled)]
    if few and not keep_largest:
        raise TiePointError(
            f"too few observations in {listed(few)}: at least {MIN_OBSERVATIONS} tie points are needed, or one ground "
            "control point (--gcp); give more matches (--matches) or leave these views out (--keep-going)"
        )
    left_out = _disconnected_views(names, view[rows], point[rows], tracks.num_points, keep_largest, is_held)
    order, _ = counting_sort(view, len(views))
    use = ~np.isin(view, np.flatnonzero(np.isin(names, left_out)))
    return Block(
        views,
        view[order],
        point[order],
        np.ascontiguousarray(xy[order].T),
        sigma[order],
        order,
        use[order],
        gcps,
        reference,
        tracks.num_points,
        int(starts[1]),
        int(starts[-1]),
        len(order),
        left_out,
    )


def _check_fixed_names(names: Sequence[str], options: AdjustOptions) -> None:
    if len(set(names)) < len(names):
        raise InputError("two views have the same name")
    if unknown := set(options.fixed) - set(names):
        raise InputError(f"no view is named {listed(sorted(unknown))}; there are {listed(names)}")


def _disconnected_views(
    names: Sequence[str], view: IntArray, point: IntArray, num_tracks: int, keep_largest: bool, is_held: BoolArray
) -> tuple[str, ...]:
    """Return the views outside the largest group, for observations sorted by point. GCPs connect all their views."""
    point = np.where(point >= num_tracks, num_tracks, point)
    same = point[1:] == point[:-1]
    keys = np.unique((view[:-1] * len(names) + view[1:])[same])
    held = np.flatnonzero(is_held).tolist()
    groups = connected_groups(len(names), [*(divmod(int(key), len(names)) for key in keys), *pairwise(held)])
    if len(groups) == 1:
        return ()
    named = [[names[v] for v in group] for group in groups]
    listing = "; ".join(listed(group, 5) for group in named[:5])
    if not keep_largest:
        raise DisconnectedError(
            f"the views fall into {len(groups)} groups without common tie points: {listing}; add overlapping "
            "views or matches (--matches), or adjust the largest group only (--keep-going)",
            named,
        )
    rest = tuple(name for group in named[1:] for name in group)
    message = f"{len(rest)} views are not tied to the largest group and keep their cameras: {listed(rest)}"
    warnings.warn(message, BarpcWarning, stacklevel=4)
    return rest


def make_problem(
    block: Block,
    options: AdjustOptions,
    centers: Array | None,
    prior: BlockPrior | None,
    drift: int | None = None,
    waves: AdditionalParameters | None = None,
) -> Problem:
    """Return the problem of a block, without priors on points; `drift` replaces the degree in the options."""
    views = block.views
    drift = _first_drift(options, prior) if drift is None else drift
    if prior is not None:
        waves = prior.waves(block.names)
        centers = _known_centers(block, options, centers, prior)
    unknowns = make_unknowns(views, options.first_model, drift, centers, waves)
    off = None if block.reference is None else np.linalg.norm(block.reference.offset, axis=1)
    sigma = prior_sigmas(views, options, drift, off, 0 if waves is None else waves.size)
    on_cameras, jointly = CameraPrior(np.zeros_like(sigma), sigma, unknowns.sight), None
    if prior is not None:
        on_cameras, jointly = apply_prior(prior, block.names, options.first_model, drift, on_cameras)
    elif waves is not None:
        jointly = JointPrior.of_alike(waves, len(views), unknowns.size)
    joined = None if jointly is None else np.unique(jointly.index // unknowns.size)
    return Problem(
        Cameras(views, unknowns, block.xy),
        make_structure(block.view, block.point, len(views), block.num_points, unknowns.place, joined),
        block.xy,
        on_cameras,
        np.repeat([name not in options.fixed for name in block.names], unknowns.size),
        jointly,
    )


def _first_drift(options: AdjustOptions, prior: BlockPrior | None) -> int:
    """Return the first degree of the drift."""
    if options.drift is not None:
        return options.drift
    if prior is not None:
        return prior.drift
    return int("rotation" in options.first_model)


def _known_centers(block: Block, options: AdjustOptions, centers: Array | None, prior: BlockPrior) -> Array:
    """Return the camera centres (N, 3) [m], ECEF; views of the earlier block keep the centres in its prior."""
    if centers is None:
        centers = make_unknowns(block.views, options.first_model, prior.drift).center
    known = dict(zip(prior.names, prior.center, strict=True))
    return np.array([known.get(name, center) for name, center in zip(block.names, centers, strict=True)])


def first_state(
    problem: Problem, block: Block, options: AdjustOptions, dem: Terrain | None
) -> tuple[State, PointConstraints]:
    """Triangulate the points with the delivered cameras; also return the constraints on points."""
    params = problem.camera_prior.mean
    points = block.first_points()
    points[~np.isfinite(points)] = 0.0
    control = [ground_control(block.gcps, np.arange(block.num_tracks, block.num_known))]
    if block.reference is not None:
        control.append(reference_control(block.reference, np.arange(block.num_known, block.num_points)))
    projected = problem.project_points(params, points)
    seen = np.bincount(block.point, minlength=block.num_points) > 0
    angles = convergence_angles(problem.structure, projected, points)
    weak = seen & (angles < np.radians(options.min_convergence))
    tracks = np.flatnonzero(seen[: block.num_tracks])
    heights = PointConstraints(tuple(control), weak, tracks, block.alt_range, options, dem, block.reference)
    weight = block.use / block.sigma
    points = heights.hold(problem, points).triangulate(points, projected, weight)
    projected = problem.project_points(params, points)
    points = heights.hold(problem, points).triangulate(points, projected, weight)
    if heights.is_judged and len(tracks):
        heights = replace(heights, relief=_relief(problem, heights, points, weight))
    return State(params, points), heights


def _relief(problem: Problem, heights: PointConstraints, points: Array, weight: Array) -> Relief:
    """Return the comparison of the DEM with points (P, 3) [m] triangulated by the delivered cameras.

    Its standard deviations by the camera priors are linearised: camera changes dp move points by -V^-1 A^T B dp.
    """
    assert heights.dem is not None
    structure, sigma = problem.structure, problem.camera_prior.sigma
    projected, ground = problem.linearise(problem.camera_prior.mean, points), ground_from_ecef(points)
    by_point = projected.by_point * weight
    lower = cholesky3(structure.sum_points(point_products(by_point, np.zeros_like(problem.xy))[:6]))
    up = enu_basis(ground)[:, 2].T
    is_strong = np.zeros(len(points), dtype=bool)
    is_strong[heights.tracks[~heights.weak[heights.tracks]]] = True
    sigma_up = np.linalg.norm(solve_lower(lower, up), axis=0)
    found = Relief.of(heights.dem, ground, is_strong, sigma_up, heights.options.dem_sigma)
    deviations = np.zeros(3)
    for m, fit in enumerate(found.fit):
        solved = solve_transposed(lower, solve_lower(lower, up * fit))
        pull = np.einsum("cxk,xk->ck", by_point, solved.take(structure.point, axis=1)) * weight
        by_unknown = structure.sum_views(np.einsum("ck,cqk->qk", pull, projected.by_unknown))
        free = problem.free.reshape(by_unknown.shape)
        deviations[m] = np.sqrt(((by_unknown * sigma)[free] ** 2).sum()) if np.isfinite(sigma[free]).all() else np.nan
    return replace(found, cameras=deviations)
