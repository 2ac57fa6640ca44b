"""Candidate pairs, footprints that overlap under a useful angle, and the choice among them.

Without dates, overlap and angle decide, and pairs that fail are replaced as long as views are not connected. Two dates
may share no grey value: where the views are of several, pairs are compared by a few keypoints first
(`quick_score` of the matchers), those most alike are tried, and two paths lead to every view where there are two.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import compress, pairwise
from math import isfinite
from typing import Any

import numpy as np
import shapely

from barpc.base.errors import DisconnectedError, TiePointError, listed
from barpc.base.geodesy import Array, Box, metres_per_unit, wrap_longitude
from barpc.base.options import TieOptions
from barpc.scene import Terrain as Terrain
from barpc.scene import View, connected_groups, connected_labels
from barpc.sensor.geometry import Several, convergence_angle, footprint, ground_sample_distance
from barpc.tie.pairing.area import Area
from barpc.tie.pairing.epipolar import common_range

logger = logging.getLogger(__name__)

Link = tuple[int, int]

_BEST_ANGLE = 15.0  # deg; matches are many and heights still well determined; so many more, and it is worth 1 / e
RELATIVE_POINTING_ERROR = 700.0
"""How far two cameras may be wrong about each other [m]: by 350 m each, as SPOT 1 to 4 state it, the worst of all."""
_SEARCH_LIMITS = 20.0, 700.0  # px that are searched at least and at most, unless another number is asked for
GIVEN_PAIR = "given"
"""Why a pair is tried that others have matched."""


@dataclass(frozen=True, eq=False)
class Scope:
    """Restrictions of the search for tie points, and information beside the cameras.

    Parameters
    ----------
    only : sequence of (int, int), these pairs, all that overlap, and no others; empty: the best
    area : Area, optional, in which tie points are looked for, as the cameras see it; None: everywhere
    given : mapping of (int, int), ascending, to Matches: verified and registered as those of the other pairs, which are
        matched here. Where too few can be registered, they keep their places with the measured standard deviation
    terrain : callable, optional, lon, lat (n,) [deg] -> altitude [m above the ellipsoid], NaN outside: narrows the
        search for structure
    joined : sequence of int, views that are tied to each other already, by an earlier adjustment
    """

    only: Sequence[Link] = ()
    area: Area | None = None
    given: Mapping[Link, Any] = field(default_factory=dict)
    terrain: Terrain | None = None
    joined: Sequence[int] = ()


WHOLE_SCOPE = Scope()


@dataclass(frozen=True)
class Pair:
    """Two views to be matched."""

    views: tuple[int, int]  # their indices, ascending
    overlap: float  # common area over that of the smaller footprint
    angle: float  # of convergence in the middle of the common area [deg]
    reason: str = "overlap and angle"  # why it is tried
    likeness: int | None = None  # its quick score: of a few keypoints so many match; None: not asked

    @property
    def score(self) -> float:
        """Worth of the pair: large overlap, moderate angle."""
        return self.overlap * float(np.exp(-max(0.0, self.angle - _BEST_ANGLE) / _BEST_ANGLE))


class Footprints:
    """Outlines of views at one altitude [m], as far as they lie in an area, in a common plane [m east, north].

    They grow, as the area does, by as much as each camera may be wrong (`reaches` [px]); empty where no ground is seen.
    """

    def __init__(
        self, views: Sequence[View], alt: float, reaches: Sequence[float] = (), area: Area | None = None
    ) -> None:
        rings = [footprint(view.sensor, view.size, alt)[:, :2] for view in views]
        usable = [ring[np.isfinite(ring).all(axis=1)] for ring in rings]
        self._origin = next((ring[0] for ring in usable if len(ring)), np.zeros(2))
        self._scale = metres_per_unit(np.array([*self._origin, alt]))[:2]
        self.alt = alt
        wanted = None if area is None else area.plane(self._origin, self._scale)
        self.outlines: list[shapely.Geometry] = []
        for view, ring, reach in zip(views, usable, reaches or [0.0] * len(views), strict=True):
            outline = shapely.make_valid(shapely.Polygon(self.plane(ring) if len(ring) > 3 else ring[:0]))
            more = reach * float(np.sqrt(outline.area / (view.size[0] * view.size[1])))
            near = wanted
            if reach:  # None stays None
                outline, near = shapely.buffer([outline, wanted], more)
            self.outlines.append(outline if near is None else shapely.intersection(outline, near))

    def plane(self, lonlat: Array) -> Array:
        """Return the east and north (..., 2) [m] of longitudes and latitudes (..., 2) [deg]."""
        lon = wrap_longitude(lonlat[..., 0], self._origin[0])
        return (np.stack([lon, lonlat[..., 1]], axis=-1) - self._origin) * self._scale

    def ground(self, points: Array) -> Array:
        """Return the lon, lat [deg], alt [m] (N, 3) of points (N, 2) of the plane [m]."""
        return np.column_stack([points / self._scale + self._origin, np.full(len(points), self.alt)])


def reach_of(view: View, search: float | None) -> float:
    """Return the largest error of a view's camera, in any direction [px]: the option `search`, if it is given."""
    if search is not None:
        return search
    ground = view.sensor.localize((np.array(view.size) - 1.0) / 2.0, np.array(view.altitude))
    pixel = float(ground_sample_distance(view.sensor, ground)[1])
    return float(np.clip(RELATIVE_POINTING_ERROR / pixel, *_SEARCH_LIMITS)) if pixel > 0.0 else _SEARCH_LIMITS[1]


def _levels(views: Sequence[View]) -> tuple[float, float, float]:
    """Return the middle, lowest and highest altitude [m] of the common range of the views."""
    low, high = common_range(*views)
    return 0.5 * (low + high), low, high


def overlapping_pairs(
    views: Sequence[View], options: TieOptions, reaches: Sequence[float] = (), area: Area | None = None
) -> list[Pair]:
    """Return all pairs with enough overlap at some altitude, under an allowed convergence angle, ascending."""
    best: dict[tuple[int, int], Pair] = {}
    for alt in _levels(views):
        for pair in _overlapping_at(Footprints(views, alt, reaches, area), views, options):
            if pair.views not in best or pair.overlap > best[pair.views].overlap:
                best[pair.views] = pair
    return [best[pair] for pair in sorted(best)]


def _overlapping_at(prints: Footprints, views: Sequence[View], options: TieOptions) -> list[Pair]:
    outlines = np.array(prints.outlines, dtype=object)
    ends = shapely.STRtree(outlines).query(outlines, predicate="intersects")
    first, second = ends[:, ends[0] < ends[1]]
    common, area = shapely.intersection(outlines[first], outlines[second]), shapely.area(outlines)
    overlap = shapely.area(common) / np.maximum(np.minimum(area[first], area[second]), 1e-9)
    enough = overlap >= max(options.min_overlap, 1e-9)
    first, second, overlap = first[enough], second[enough], overlap[enough]
    ground = prints.ground(shapely.get_coordinates(shapely.point_on_surface(common[enough])))
    sensors = [view.sensor for view in views]
    angle = convergence_angle(Several(sensors, first), Several(sensors, second), ground)
    useful = (options.angles[0] <= angle) & (angle <= options.angles[1])
    found = (part[useful].tolist() for part in (first, second, overlap, angle))
    return [Pair((i, j), share, turn) for i, j, share, turn in zip(*found, strict=True)]


def possible_pairs(views: Sequence[View], options: TieOptions, scope: Scope = WHOLE_SCOPE) -> list[Pair]:
    """Return the pairs of views that can be matched, ascending; those that are given, overlap or not.

    Raises
    ------
    TiePointError
        Fewer than two views.
    DisconnectedError
        The pairs leave the views in more than one group.
    """
    if len(views) < 2:
        raise TiePointError(f"{len(views)} image given: tie points need at least two that overlap")
    wanted = {(min(pair), max(pair)) for pair in scope.only}
    pairs = _candidates(views, options, wanted, scope.area)
    where = "between them" + (" among the listed pairs" if wanted else "")
    where += " inside the area of interest" if scope.area is not None else ""
    require_connected(
        views,
        [*(pair.views for pair in pairs), *scope.given, *pairwise(scope.joined)],
        f"no overlap of at least {options.min_overlap:.0%} under {options.angles[0]:g} to "
        f"{options.angles[1]:g} deg {where}; remove the stray images (--keep-going keeps the largest group), or lower "
        "min_overlap ([tie] of a file given with --options)",
    )
    for i, j in sorted(wanted - {pair.views for pair in pairs}):
        logger.warning("%s - %s: listed, but they do not overlap as asked", views[i].name, views[j].name)
    found = {pair: Pair(pair, *(float("nan"),) * 2) for pair in scope.given}
    found |= {pair.views: pair for pair in pairs}
    said = {**dict.fromkeys(wanted, "listed"), **dict.fromkeys(scope.given, GIVEN_PAIR)}
    return [replace(p, reason=said.get(views, p.reason)) for views, p in sorted(found.items())]


def _candidates(
    views: Sequence[View], options: TieOptions, wanted: set[tuple[int, int]], area: Area | None
) -> list[Pair]:
    """Return the pairs that overlap, of those wanted (none: all); outlines grow where something is left out."""
    pairs = overlapping_pairs(views, options, area=area)
    pairs = [pair for pair in pairs if not wanted or pair.views in wanted]
    known = {pair.views for pair in pairs}
    partners = np.bincount([i for pair in known for i in pair], minlength=len(views))
    lonely = partners < min(2, len(views) - 1)
    lonely |= ~np.isin(np.arange(len(views)), connected_groups(len(views), sorted(known))[0])
    if not (wanted - known if wanted else lonely.any()):
        return pairs
    grown = overlapping_pairs(views, options, [reach_of(view, options.search) for view in views], area)
    for pair in grown:
        worth = pair.views in wanted if wanted else lonely[list(pair.views)].any()
        if worth and pair.views not in known:
            pairs.append(pair)
    return sorted(pairs, key=lambda pair: pair.views)


def require_connected(
    views: Sequence[View], links: Sequence[tuple[int, int]], why: str, said: Mapping[str, str] | None = None
) -> None:
    """Raise DisconnectedError unless links connect all views; `why`: reason and remedy, `said`: faults of views."""
    groups = connected_groups(len(views), links)
    if len(groups) < 2:
        return
    names = [[views[i].name for i in group] for group in groups]
    told = "; ".join(listed(group, 5) for group in names[:6])
    raise DisconnectedError(f"the images fall into {len(groups)} groups ({told}): {why}", names, said)


def shared_tiles(
    views: Sequence[View],
    pairs: Sequence[Pair],
    boxes: Sequence[Sequence[Box]],
    search: float | None,
    area: Area | None = None,
) -> list[list[Box]]:
    """Return those boxes of every view that a partner may see in the area, with camera errors up to `reach_of`."""
    seen = [np.zeros(len(of_view), dtype=bool) for of_view in boxes]
    partners: list[list[int]] = [[] for _ in views]
    for pair in pairs:
        i, j = pair.views
        partners[i].append(j)
        partners[j].append(i)
    reaches = [reach_of(view, search) for view in views]
    for alt in _levels(views):
        prints = Footprints(views, alt, reaches, area)
        for i, of_view in enumerate(boxes):
            partly = shapely.union_all([prints.outlines[j] for j in partners[i]])
            corners = np.array([[(c, r), (c + w, r), (c + w, r + h), (c, r + h)] for c, r, w, h in of_view]).reshape(
                -1, 4, 2
            )
            ground = views[i].sensor.localize(corners - 0.5, np.array(alt))
            unknown = ~np.isfinite(ground).all(axis=(1, 2))
            ground[unknown] = 0.0
            windows = shapely.polygons(prints.plane(ground[..., :2]))
            seen[i] |= unknown | np.asarray(shapely.intersects(windows, partly))
    return [list(compress(*both)) for both in zip(boxes, seen, strict=True)]


SAME_DATE, CONNECTS, PATH, BETWEEN_GROUPS = "same date", "connects all", "second path", "between groups"
"""Why a pair is tried."""
COMPARED = 48
"""Partners of a view, the best by overlap and angle, that are compared with it."""
TRIES = (2, 4, 8)
"""Round by round: so many pairs lead to what is not tied yet, where there are so many."""


def several_dates(views: Sequence[View]) -> bool:
    """Return whether the views are known to be of more than one date."""
    return len({view.date for view in views if view.date}) > 1


def scored_pair(views: Sequence[View], pair: Pair, likeness: int) -> Pair:
    """Return a pair with its quick score and the reason for choosing it."""
    dates = {views[i].date for i in pair.views}
    same = len(dates) == 1 and dates != {""} and likeness
    return replace(pair, likeness=likeness, reason=SAME_DATE if same else f"quick score {likeness}")


def _order(pair: Pair) -> tuple[int, int, float, Link]:
    """Return the sort key: one date, then by likeness, then by overlap and angle; no likeness last."""
    if not isfinite(pair.score):
        return 3, 0, 0.0, pair.views
    if pair.reason == SAME_DATE:
        return 0, 0, -pair.score, pair.views
    return 1 + (pair.likeness == 0), -(pair.likeness or 0), -pair.score, pair.views


def best_pairs(pairs: Sequence[Pair], num_views: int, neighbours: int, twice: bool = False) -> list[Pair]:
    """Choose the best partners of every view and pairs that connect all, `twice` by two paths; ascending.

    Pairs of one date take half of a view's partners at first, then what others leave. Pairs that are given are kept.
    """
    ranked = sorted(pairs, key=_order)
    tree = {ranked[k].views for k in forests([pair.views for pair in ranked], num_views, 1)}
    chosen = _partners(ranked, num_views, neighbours, tree)
    for more in (_connecting_pairs, partial(further_pairs, twice=True)) if twice else ():
        left = [pair for pair in ranked if pair.views not in chosen]
        chosen |= {pair.views: pair for pair in more(left, num_views, list(chosen), TRIES[0])}
    return [chosen[views] for views in sorted(chosen)]


def _partners(ranked: Sequence[Pair], num_views: int, neighbours: int, tree: set[Link]) -> dict[Link, Pair]:
    """Return the given pairs, those of the best partners of every view, and those of a `tree` that connects all."""
    chosen = {pair.views: pair for pair in ranked if pair.reason == GIVEN_PAIR}
    taken, half = [0] * num_views, (neighbours + 1) // 2
    seen: set[Link] = set()
    for pair, again in [*((pair, False) for pair in ranked), *((pair, True) for pair in ranked)]:
        i, j = pair.views
        most = half if pair.reason == SAME_DATE and not again else neighbours
        wanted = min(taken[i], taken[j]) < most
        if pair.views not in seen and (wanted or pair.views in tree):
            seen.add(pair.views)
            chosen.setdefault(pair.views, pair if wanted else replace(pair, reason=CONNECTS))
            taken[i] += 1
            taken[j] += 1
    return chosen


def _connecting_pairs(left: Sequence[Pair], num_views: int, links: Sequence[Link], count: int) -> list[Pair]:
    """Return the best pairs of each view with views that have no partner in common with it, `count` at most.

    The partners most alike are of one season. Two views of a season and two of another tie the seasons by one pair's
    epipolar lines, along which both may slide.
    """
    near = [{v} for v in range(num_views)]
    for i, j in links:
        near[i].add(j)
        near[j].add(i)
    taken, found = [0] * num_views, []
    for pair in left:
        i, j = pair.views
        if min(taken[i], taken[j]) < count and pair.likeness and not near[i] & near[j]:
            taken[i] += 1
            taken[j] += 1
            found.append(replace(pair, reason=BETWEEN_GROUPS))
    return found


def further_pairs(
    pairs: Sequence[Pair], num_views: int, links: Sequence[Link], tries: int, twice: bool = False
) -> list[Pair]:
    """Return the best untried pairs, to add `tries` paths between views tied by no path, or (`twice`) by one.

    Pairs that have nothing in common are only worth it where there is no path at all.
    """
    group = connected_labels(num_views, list(links)).tolist()
    part = twice_tied(num_views, links) if twice else group
    if len(set(part)) < 2:
        return []
    crossing = []
    for pair in sorted(pairs, key=_order):
        i, j = pair.views
        if group[i] != group[j] or (part[i] != part[j] and pair.likeness != 0):
            crossing.append(pair)
    ends = [(part[i], part[j]) for i, j in [*links, *(pair.views for pair in crossing)]]
    kept = (k - len(links) for k in forests(ends, num_views, tries))
    return [replace(crossing[k], reason=PATH if twice else CONNECTS) for k in kept if k >= 0]


def _component_root(tree: list[int], node: int) -> int:
    while tree[node] != node:
        tree[node] = tree[tree[node]]
        node = tree[node]
    return node


def forests(links: Sequence[Link], num: int, count: int) -> list[int]:
    """Return the indices of the links, best first, of `count` spanning forests: each in the first that it extends.

    Together they keep what paths there are between two nodes, up to `count` (Nagamochi and Ibaraki 1992).
    """
    kept, trees = [], [list(range(num)) for _ in range(count)]
    for number, (i, j) in enumerate(links):
        for tree in trees:
            first, second = _component_root(tree, i), _component_root(tree, j)
            if first != second:
                tree[second] = first
                kept.append(number)
                break
    return kept


def twice_tied(num: int, links: Sequence[Link]) -> list[int]:
    """Return a label (num,) shared by nodes between which there are two paths without a link in common."""
    every, bridges = np.array(links, dtype=np.int64).reshape(-1, 2), []
    for k in forests(links, num, 1):  # a link that is no part of a ring is one of any spanning tree
        label = connected_labels(num, np.delete(every, k, axis=0))
        if label[every[k, 0]] != label[every[k, 1]]:
            bridges.append(k)
    out: list[int] = connected_labels(num, np.delete(every, bridges, axis=0)).tolist()
    return out
