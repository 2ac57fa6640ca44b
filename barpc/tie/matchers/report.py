"""Result of matching a pair: number of matches, best attempt, and reasons why a block cannot be tied."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from barpc.base.errors import TiePointError
from barpc.base.statistics import FEW, MANY
from barpc.scene import View
from barpc.tie.matchers.features import ample_matches
from barpc.tie.matchers.matcher import Matches
from barpc.tie.matchers.placings import Placings, misplaced
from barpc.tie.pairing.overlaps import Pair, require_connected

STRUCTURE = "structure"
"""Matcher of pairs for which another one finds few matches."""
FINE_STRUCTURE = "fine-structure"
"""Matcher of pairs for which structure finds none."""
SUFFICIENT_SHARE = 0.3
"""A pair of fewer than `MANY` is not tried again where they are this share of the keypoints in its common area, and
`FEW`: small images have no more to give; nor is a wider pass where this share of the matches stands in the peak."""


@dataclass(frozen=True)
class PairReport:
    """Result of matching a pair of views."""

    names: tuple[str, str]
    status: str  # "ok", or what went wrong
    keypoints: tuple[int, int]  # of the two views; 0 for a matcher that wants none
    matches: int = 0  # after the tight pass
    verified: int = 0  # of them, after the verification
    inlier_share: float = 0.0  # verified / matches
    control_share: float = 0.0  # of the verified matches: what chance alone would give
    offset: tuple[float, float] = (float("nan"), float("nan"))
    """Median distance along and across the epipolar line from the prediction at the middle altitude [px]."""
    spread: float = float("nan")  # robust, across the epipolar line after the affine fit [px]
    angle: float = float("nan")  # of convergence [deg]
    overlap: float = float("nan")  # common area over that of the smaller footprint
    matcher: str = "guided"  # that found the matches
    loosened: bool = False  # whether with loosened thresholds, in a second attempt
    reason: str = ""  # why the pair was tried
    beaten: tuple[str, ...] = ()
    """Attempts that found fewer: matcher, whether loosened, verified matches of those wanted, as "guided 12 of 100"."""
    placings: Placings = (None, None)
    unregistered: int = 0  # of its tracks stand where keypoints were found: their patches could not be registered

    @property
    def structural(self) -> bool:
        """Whether its matches are places of like structure, not of like grey values."""
        return self.matcher in (STRUCTURE, FINE_STRUCTURE)

    @property
    def means(self) -> str:
        """Method that found the matches, whether with loosened thresholds, and whether keypoints tie the pair."""
        return self.matcher + ", loosened" * self.loosened + ", by keypoints" * bool(self.unregistered)


def ample(report: PairReport, points_per_image: int) -> bool:
    """Return whether matching at reduced resolution found enough matches."""
    return report.status == "ok" and report.verified >= ample_matches(points_per_image)


def enough(report: PairReport) -> bool:
    """Return whether a pair has enough matches not to be tried again."""
    return report.status == "ok" and report.verified >= _wanted_matches(report)


def worth_more(report: PairReport) -> bool:
    """Return whether a matcher by structure may find matches where keypoints found few."""
    return not any(report.placings) and "keypoints" not in report.status


def _wanted_matches(report: PairReport) -> int:
    """Return the number of matches expected of a pair: fewer for a small common area."""
    common = report.overlap * min(report.keypoints)
    return math.ceil(min(MANY, max(FEW, SUFFICIENT_SHARE * common))) if common > 0 else MANY


def better(*attempts: tuple[Matches, PairReport]) -> tuple[Matches, PairReport]:
    """Return the attempt with most verified matches, of those that count; the earlier one of equals."""
    best = max(attempts, key=lambda attempt: attempt[1].verified if attempt[1].status == "ok" else -1)
    beaten: list[str] = []
    for _, report in attempts:
        beaten += report.beaten
        if report is not best[1]:
            beaten.append(f"{report.means} {report.verified} of {_wanted_matches(report)}")
    return best[0], replace(best[1], beaten=tuple(beaten))


def require_matches(
    views: Sequence[View], pairs: Sequence[Pair], reports: Sequence[PairReport], joined: Sequence[int] = ()
) -> None:
    """Raise TiePointError where two views do not match, DisconnectedError where more fall into groups.

    Views that are `joined` are one group without matches.
    """
    links = [pair.views for pair, report in zip(pairs, reports, strict=True) if report.status == "ok"]
    placings = {pair.views: report.placings for pair, report in zip(pairs, reports, strict=True)}
    said = misplaced(views, links, placings)
    failed = [report for report in reports if report.status != "ok"]
    why = "; ".join(f"{view.path}: {said[view.name]}" for view in views if view.name in said) or _failures(failed)
    if len(views) == 2 and failed:
        raise TiePointError(f"too few tie points: {why}")
    links += pairwise(joined)
    require_connected(views, links, f"no tie points between them: {why}", said)


def _failures(failed: Sequence[PairReport]) -> str:
    listed = "; ".join(
        f"{r.names[0]} - {r.names[1]}: {r.status} ({r.keypoints[0]} and {r.keypoints[1]} keypoints, "
        f"{r.verified} of {r.matches} matches verified)"
        for r in failed[:4]
    )
    bare = [r for r in failed if r.status == "too few keypoints"]
    if blank := sorted({name for r in bare for name, n in zip(r.names, r.keypoints, strict=True) if not n}):
        return (
            f"{listed}: no detail in {', '.join(blank[:4])} (one value? no valid pixels? clouds?): look at the images"
        )
    loosen = "loosen ratio, search or min_matches ([tie] of a file given with --options)"
    return f"{listed}: look at the images (clouds? dates? band?), or {loosen}"
