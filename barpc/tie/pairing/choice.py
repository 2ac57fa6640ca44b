"""Which of the pairs that can be matched are tried, and what in place of those that fail.

Without dates, overlap and angle decide, and pairs that fail are replaced as long as views are not connected. Two dates
may share no grey value: where the views are of several, pairs are compared by a few keypoints first
(`quick_score` of the matchers), those most alike are tried, and two paths lead to every view where there are two.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import replace
from math import isfinite

from barpc.options import TieOptions
from barpc.scene import View, connected_labels
from barpc.tie.pairing.area import Area
from barpc.tie.pairing.overlaps import GIVEN, Pair, possible_pairs

Link = tuple[int, int]

SAME_DATE, CONNECTS, PATH, BEYOND = "same date", "connects all", "second path", "between groups"
"""Why a pair is tried."""
COMPARED = 48
"""Partners of a view, the best by overlap and angle, that are compared with it."""
TRIES = (2, 4, 8)
"""Round by round: so many pairs lead to what is not tied yet, where there are so many."""
_BEYOND = 4  # partners of a view, for each of which one more is of another group


def select_pairs(
    views: Sequence[View],
    options: TieOptions,
    *,
    only: Sequence[Link] = (),
    area: Area | None = None,
    given: Collection[Link] = (),
) -> list[Pair]:
    """Choose the pairs of views to match, ascending, by overlap and angle: the best partners of every view,
    and a spanning tree.

    Parameters and errors are those of `possible_pairs`; `options.neighbours` counts, too.
    """
    pairs = possible_pairs(views, options, only=only, area=area, given=given)
    return pairs if only else best_pairs(pairs, len(views), options.neighbours)


def several_dates(views: Sequence[View]) -> bool:
    """Return whether the views are known to be of more than one date."""
    return len({view.date for view in views if view.date}) > 1


def judged(views: Sequence[View], pair: Pair, likeness: int) -> Pair:
    """Return a pair with its quick score and the reason for choosing it."""
    dates = {views[i].date for i in pair.views}
    same = len(dates) == 1 and dates != {""} and likeness
    return replace(pair, likeness=likeness, reason=SAME_DATE if same else f"quick score {likeness}")


def _order(pair: Pair) -> tuple[int, int, float, Link]:
    """Return the pairs of one date, then by what they have in common, then by overlap and angle; last what
    has nothing.
    """
    if not isfinite(pair.score):
        return 3, 0, 0.0, pair.views
    if pair.reason == SAME_DATE:
        return 0, 0, -pair.score, pair.views
    return 1 + (pair.likeness == 0), -(pair.likeness or 0), -pair.score, pair.views


def best_pairs(pairs: Sequence[Pair], num_views: int, neighbours: int, twice: bool = False) -> list[Pair]:
    """Choose the best partners of every view, and pairs that connect all views, `twice` by two paths,
    ascending.

    Pairs of one date take half of a view's partners at first, then what others leave. Pairs that are given are kept.
    """
    ranked = sorted(pairs, key=_order)
    tree = {ranked[k].views for k in forests([pair.views for pair in ranked], num_views, 1)}
    chosen = {pair.views: pair for pair in ranked if pair.reason == GIVEN}
    taken, half = [0] * num_views, (neighbours + 1) // 2
    seen: set[Link] = set()
    for again in (False, True):
        for pair in ranked:
            i, j = pair.views
            most = half if pair.reason == SAME_DATE and not again else neighbours
            wanted = min(taken[i], taken[j]) < most
            if pair.views not in seen and (wanted or pair.views in tree):
                seen.add(pair.views)
                chosen.setdefault(pair.views, pair if wanted else replace(pair, reason=CONNECTS))
                taken[i] += 1
                taken[j] += 1
    left = [pair for pair in ranked if pair.views not in chosen]
    more = _beyond(left, num_views, list(chosen), neighbours // _BEYOND) if twice else []
    links = [*chosen, *(pair.views for pair in more)]
    known = set(links)
    left = [pair for pair in left if pair.views not in known]
    more += further_pairs(left, num_views, links, TRIES[0], twice=True) if twice else []
    return sorted([*chosen.values(), *more], key=lambda pair: pair.views)


def _beyond(left: Sequence[Pair], num_views: int, links: Sequence[Link], count: int) -> list[Pair]:
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
            found.append(replace(pair, reason=BEYOND))
    return found


def further_pairs(
    pairs: Sequence[Pair], num_views: int, links: Sequence[Link], tries: int, twice: bool = False
) -> list[Pair]:
    """Return the best pairs not tried yet, to add `tries` paths between views that no path ties, or (`twice`)
    only one.

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


def _root(tree: list[int], node: int) -> int:
    while tree[node] != node:
        tree[node] = tree[tree[node]]
        node = tree[node]
    return node


def forests(links: Sequence[Link], num: int, count: int) -> list[int]:
    """Return the numbers of the links, the best first, of `count` spanning forests: each link goes to the
    first in which it joins two trees.

    Together they keep what paths there are between two nodes, up to `count` (Nagamochi and Ibaraki 1992).
    """
    kept, trees = [], [list(range(num)) for _ in range(count)]
    for number, (i, j) in enumerate(links):
        for tree in trees:
            first, second = _root(tree, i), _root(tree, j)
            if first != second:
                tree[second] = first
                kept.append(number)
                break
    return kept


def twice_tied(num: int, links: Sequence[Link]) -> list[int]:
    """Return a label (num,) shared by nodes between which there are two paths without a link in common."""
    tree = set(forests(links, num, 1))
    near: list[list[int]] = [[] for _ in range(num)]
    for i, j in (links[k] for k in tree):
        near[i].append(j)
        near[j].append(i)
    above, depth = list(range(num)), [-1] * num
    for start in range(num):
        queue = deque([start] if depth[start] < 0 else [])
        depth[start] = max(depth[start], 0)
        while queue:
            node = queue.popleft()
            for other in near[node]:
                if depth[other] < 0:
                    above[other], depth[other] = node, depth[node] + 1
                    queue.append(other)
    part = list(range(num))
    for i, j in (link for k, link in enumerate(links) if k not in tree):  # closes a ring with the tree
        i, j = _root(part, i), _root(part, j)
        while i != j:
            i, j = (i, j) if depth[i] >= depth[j] else (j, i)
            part[i] = above[i]
            i = _root(part, i)
    return [_root(part, node) for node in range(num)]
