"""Third-party matches: verified as own matches are, unregistered where patches cannot be registered."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from scipy.special import bdtrc

from barpc.base.options import TieOptions
from barpc.base.statistics import CHANCE
from barpc.base.tasks import Work
from barpc.scene import View
from barpc.tie.matchers.features import Keypoints
from barpc.tie.matchers.matcher import NO_MATCHES, Matches, Prediction
from barpc.tie.matchers.matching import match_pair
from barpc.tie.matchers.pair_search import Ends
from barpc.tie.matchers.report import PairReport, better
from barpc.tie.pairing.epipolar import epipolar_segments, robust_affine
from barpc.tie.pairing.overlaps import GIVEN_PAIR, Pair

logger = logging.getLogger(__name__)

GivenMatches = Mapping[tuple[int, int], Matches]
"""Two views, ascending -> their matches, numbered so that equal numbers of a view are one point, below 0."""


class GivenMatcher:
    """Matches given by others: row i of the first view's points belongs to row i of the second's."""

    detects: ClassVar[bool] = True

    def __init__(self, options: TieOptions, keypoints: tuple[Keypoints, Keypoints]) -> None:
        self._first, self._second = (points.xy for points in keypoints)

    def match(self, a: View, b: View, prediction: Prediction) -> Matches:
        """Return the given matches inside the bands; the nearer to a band's middle, the more credible."""
        rows, first = prediction.chosen(len(self._first)), self._first
        first = first if len(rows) == len(first) else first[rows]
        inside, score = prediction.judge(first, self._second[rows])
        xy = np.stack([first, self._second[rows]], axis=1)
        return Matches(xy, score, np.stack([rows, rows], axis=1)).select(inside)


_GIVEN_MATCHER = f"{__name__}:{GivenMatcher.__name__}"


def verify_given(
    views: Sequence[View], given: GivenMatches, pairs: Sequence[Pair], options: TieOptions, work: Work
) -> list[tuple[Matches, PairReport]]:
    """Verify the given matches of each pair against the cameras, by `match_pair`, with its report."""
    chosen = replace(options, matcher=_GIVEN_MATCHER)
    tasks = []
    for pair in pairs:
        ends = (views[pair.views[0]], views[pair.views[1]])
        points = (_keypoints(given[pair.views], 0), _keypoints(given[pair.views], 1))
        tasks.append((ends, points, pair, chosen))
    verified = []
    for task, pair, (found, report) in zip(tasks, pairs, work.ordered(match_pair, tasks, "verify"), strict=True):
        if report.status == "too few keypoints":
            report = replace(report, status="too few matches given")
        if report.status == "ok" and not _stand_out(task[0], given[pair.views], found):
            found, report = NO_MATCHES, replace(report, status="no more agree than by chance", verified=0)
        report = replace(report, matcher=GIVEN_PAIR)
        verified.append((replace(found, index=given[pair.views].index[found.index[:, 0]]), report))
    return verified


def beside_given(
    own: tuple[Matches, PairReport], given: tuple[Matches, PairReport] | None
) -> tuple[Matches, PairReport]:
    """Return the larger set of own matches of a pair and of given ones, few of which were verified; log the choice."""
    if given is None:
        return own
    best, report = better(own, given), given[1]
    words = "%s - %s: of %d matches given %d are verified (%s): %s"
    used = f"own are used, {best[1].status}, {best[1].verified}" if best[0] is own[0] else "they are used"
    logger.warning(words, *report.names, report.keypoints[0], report.verified, report.status, used)
    return best


def _stand_out(ends: Ends, given: Matches, found: Matches) -> bool:
    """Return whether the given matches are significantly denser about the fit of the verified ones than beside it.

    The band holds all verified matches; a margin beside it, as wide, holds as many false ones, whatever their origin.
    """
    rows, places = found.index[:, 0], given.xy[:, 0]
    across = epipolar_segments(*ends, places).errors(given.xy[:, 1])[:, 1]
    off = np.abs(across - robust_affine(places[rows], across[rows])(places))
    within, about = (int((off <= reach).sum()) for reach in off[rows].max() * np.array([1.0, 2.0]))
    return bool(bdtrc(within - 1, about, 0.5) < CHANCE)


def _keypoints(matches: Matches, end: int) -> Keypoints:
    """Return the points of one view; nothing is known of them but their places."""
    none = np.zeros(len(matches))
    xy = np.ascontiguousarray(matches.xy[:, end])
    return Keypoints(xy, none, none, none, np.empty((len(xy), 0), np.uint8))
