"""Which of the pairs that can be matched are: those that look most alike, and two paths to every view.

A pair of two dates may share no grey value. Where the views are of several dates, all pairs are compared by a few
keypoints first (`barpc.tie.matching.quick_score`), and the choice goes by what was found; without dates by overlap and
angle. What fails is replaced as long as a view hangs by one pair or none.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import replace
from math import isfinite

from barpc.options import TieOptions
from barpc.scene import View
from barpc.tie.pairs import GIVEN, Area, Pair, possible_pairs

Link = tuple[int, int]

SAME_DATE, CONNECTS, PATH = "same date", "connects all", "second path"
"""Why a pair is tried."""
COMPARED = 32
"""Partners of a view, the best by overlap and angle, that are compared with it."""
TRIES = (2, 4, 8)
"""Round by round: so many pairs lead to what hangs by one pair or none, where there are so many."""


def select_pairs(
    views: Sequence[View],
    options: TieOptions,
    *,
    only: Sequence[Link] = (),
    area: Area | None = None,
    given: Collection[Link] = (),
) -> list[Pair]:
    """The pairs of views to match, ascending, by overlap and angle: the best partners of every view, two paths to it.

    Parameters and errors are those of `possible_pairs`; `options.neighbours` counts, too.
    """
    pairs = possible_pairs(views, options, only=only, area=area, given=given)
    return pairs if only else best_pairs(pairs, len(views), options.neighbours)


def several_dates(views: Sequence[View]) -> bool:
    """Whether the views are known to be of more than one date."""
    return len({view.date for view in views if view.date}) > 1


def judged(views: Sequence[View], pair: Pair, likeness: int) -> Pair:
    """A pair with its quick score, and what speaks for it."""
    dates = {views[i].date for i in pair.views}
    same = len(dates) == 1 and dates != {""} and likeness
    return replace(pair, likeness=likeness, reason=SAME_DATE if same else f"quick score {likeness}")


def _order(pair: Pair) -> tuple[int, int, float, Link]:
    """Pairs of one date, then by what they have in common, then by overlap and angle; last what has nothing."""
    if not isfinite(pair.score):
        return 3, 0, 0.0, pair.views
    if pair.reason == SAME_DATE:
        return 0, 0, -pair.score, pair.views
    return 1 + (pair.likeness == 0), -(pair.likeness or 0), -pair.score, pair.views


def best_pairs(pairs: Sequence[Pair], num_views: int, neighbours: int) -> list[Pair]:
    """The best partners of every view, what connects all views, and a second path to each, ascending.

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
    more = further_pairs(left, num_views, list(chosen), TRIES[0])
    return sorted([*chosen.values(), *more], key=lambda pair: pair.views)


def further_pairs(pairs: Sequence[Pair], num_views: int, links: Sequence[Link], tries: int) -> list[Pair]:
    """Of pairs not tried yet the best, to make `tries` paths to what the links tie by one of them or by none."""
    part = twice_tied(num_views, links)
    crossing = sorted((p for p in pairs if part[p.views[0]] != part[p.views[1]]), key=_order)
    ends = [(part[i], part[j]) for i, j in [*links, *(pair.views for pair in crossing)]]
    kept = (k - len(links) for k in forests(ends, num_views, tries))
    return [replace(crossing[k], reason=PATH) for k in kept if k >= 0]


def _root(tree: list[int], node: int) -> int:
    while tree[node] != node:
        tree[node] = tree[tree[node]]
        node = tree[node]
    return node


def forests(links: Sequence[Link], num: int, count: int) -> list[int]:
    """Which links, the best first, `count` forests take: each the first in which it joins two trees.

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
    """A label (num,) that nodes share between which there are two paths without a link in common."""
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
