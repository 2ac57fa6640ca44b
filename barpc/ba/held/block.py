"""Tracks and GCPs as one block of observations sorted by view, checked for what cannot be adjusted."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from barpc.ba.algebra.structure import Structure, counting_sort, make_structure
from barpc.base.errors import BarpcWarning, DisconnectedError, InputError, TiePointError
from barpc.base.geodesy import Array, ecef_from_ground
from barpc.base.options import AdjustOptions
from barpc.scene import BoolArray, GroundPoints, IntArray, Reference, Tracks, View, connected_groups
from barpc.sensor.rpc import localize_stack

MIN_OBSERVATIONS = 4  # of a view, or it stops: six unknowns need three points, and one to check them
_LISTED = 10  # views named in a message

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class Block:
    """Observations of tracks and of GCPs together, sorted by view."""

    views: tuple[View, ...]  # N views
    view: IntArray  # (K,)
    point: IntArray  # (K,) those from `num_tracks` on are GCPs, those from `num_known` on a reference's
    xy: Array  # (2, K) observed col, row [px]
    sigma: Array  # (K,) [px], view weights applied
    order: IntArray  # (K,) row of each observation in the tracks, then in the GCPs and the reference, as given
    use: BoolArray  # (K,) false for observations in views that are left out
    gcps: GroundPoints  # none where there are none
    reference: Reference | None
    num_tracks: int
    num_known: int  # tracks and GCPs
    num_points: int  # and points of the reference
    num_rows: int  # given, used or not
    left_out: tuple[str, ...]  # views outside the largest group

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the views."""
        return tuple(view.name for view in self.views)

    @property
    def alt_range(self) -> tuple[float, float]:
        """Lowest and highest altitude [m] that any view is used for."""
        return min(v.alt_range[0] for v in self.views), max(v.alt_range[1] for v in self.views)

    def without(self, rows: BoolArray) -> Block:
        """Return the block without some of its observations (K,)."""
        keep = ~rows
        return replace(
            self,
            view=self.view[keep],
            point=self.point[keep],
            xy=np.ascontiguousarray(self.xy[:, keep]),
            sigma=self.sigma[keep],
            order=self.order[keep],
            use=self.use[keep],
        )

    def in_order(self, rows: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
        """Return rows (K, ...) in the order in which observations were given; zeros where the block has none."""
        out = np.zeros((self.num_rows, *rows.shape[1:]), rows.dtype)
        out[self.order] = rows
        return out

    def first_points(self) -> Array:
        """Return the points (P, 3), ECEF [m], on the first observing view's rays at its middle altitude."""
        return self._first_points.copy()

    @cached_property
    def own_points(self) -> tuple[IntArray, Structure]:
        """The points (Q,) that are observed, and who sees them, counted by these."""
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
) -> Block:
    """Join tracks and GCPs into one block; arguments and errors as in `barpc.ba.adjust_tracks`."""
    names = [view.name for view in views]
    _check_names(names, options)
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
    few = [f"{names[v]} ({count[v]})" for v in np.flatnonzero(count < MIN_OBSERVATIONS)]
    few = few if len(few) <= _LISTED else [*few[:_LISTED], f"{len(few) - _LISTED} more"]
    if few and not keep_largest:
        raise TiePointError(
            f"too few observations in {', '.join(few)}: at least {MIN_OBSERVATIONS} are needed; "
            "give more matches (--matches) or leave these views out (--keep-going)"
        )
    left_out = _left_out(names, view[rows], point[rows], tracks.num_points, keep_largest)
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


def _check_names(names: Sequence[str], options: AdjustOptions) -> None:
    if len(set(names)) < len(names):
        raise InputError("two views have the same name")
    if unknown := set(options.fixed) - set(names):
        raise InputError(f"no view is named {', '.join(sorted(unknown))}; there are {', '.join(names[:_LISTED])}")


def _left_out(
    names: Sequence[str], view: IntArray, point: IntArray, num_tracks: int, keep_largest: bool
) -> tuple[str, ...]:
    """Return the views outside the largest group, rows sorted by point; GCPs tie their views to each other."""
    point = np.where(point >= num_tracks, num_tracks, point)
    same = point[1:] == point[:-1]
    keys = np.unique((view[:-1] * len(names) + view[1:])[same])
    groups = connected_groups(len(names), [divmod(int(key), len(names)) for key in keys])
    if len(groups) == 1:
        return ()
    named = [[names[v] for v in group] for group in groups]
    listed = "; ".join(", ".join(group[:5]) + (", ..." if len(group) > 5 else "") for group in named[:5])
    if not keep_largest:
        raise DisconnectedError(
            f"the views fall into {len(groups)} groups without common tie points: {listed}; add overlapping "
            "views or matches (--matches), or adjust the largest group only (--keep-going)",
            named,
        )
    rest = tuple(name for group in named[1:] for name in group)
    listed = ", ".join(rest[:_LISTED])
    message = f"{len(rest)} views are not tied to the largest group and keep their cameras: {listed}"
    warnings.warn(message, BarpcWarning, stacklevel=4)
    return rest
