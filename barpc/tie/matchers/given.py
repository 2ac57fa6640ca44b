"""Matches of others: verified as our own are, and used as given where patches cannot be registered."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from barpc.base.options import TieOptions
from barpc.scene import View
from barpc.tie.matchers.features import Keypoints
from barpc.tie.matchers.matcher import Matches, Prediction
from barpc.tie.matchers.matching import PairReport, match_pair
from barpc.tie.pairing.overlaps import Pair
from barpc.tie.tasks import Work

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


_GIVEN = f"{__name__}:{GivenMatcher.__name__}"


def verify_given(
    views: Sequence[View], given: GivenMatches, pairs: Sequence[Pair], options: TieOptions, work: Work
) -> list[tuple[Matches, PairReport]]:
    """Verify given matches of each pair against the cameras, with its report: `match_pair` with what is given."""
    chosen = replace(options, matcher=_GIVEN)
    tasks = []
    for pair in pairs:
        ends = (views[pair.views[0]], views[pair.views[1]])
        points = (_keypoints(given[pair.views], 0), _keypoints(given[pair.views], 1))
        tasks.append((ends, points, pair, chosen))
    verified = []
    for pair, (found, report) in zip(pairs, work.ordered(match_pair, tasks, "verify"), strict=True):
        if report.status == "too few keypoints":
            report = replace(report, status="too few matches given")
        if report.status != "ok":
            words = "%s - %s: the matches given are not used: %s (matches_only takes them as they are)"
            logger.warning(words, *report.names, report.status)
        report = replace(report, matcher="given")
        verified.append((replace(found, index=given[pair.views].index[found.index[:, 0]]), report))
    return verified


def _keypoints(matches: Matches, end: int) -> Keypoints:
    """Return the points of one view; nothing is known of them but their places."""
    none = np.zeros(len(matches))
    xy = np.ascontiguousarray(matches.xy[:, end])
    return Keypoints(xy, none, none, none, np.empty((len(xy), 0), np.uint8))
