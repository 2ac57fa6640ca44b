"""What a summary says on one screen, whatever its size: the worst first, what is alike said once."""

from __future__ import annotations

from collections.abc import Sequence

from barpc.report.reservations import GOOD_RMSE
from barpc.report.summary import Summary
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import CAUSES, NAMED, STATUS_WORDS, listed

SHOWN = 10  # rows of a table on the terminal, images and pairs alike
ALONE = 3  # images of one cause that have a sentence each; more share one


def worst_first(views: Sequence[ViewEntry]) -> list[ViewEntry]:
    """Return images by verdict, by what is wrong, by error; those without reservation as they come."""
    return sorted(views, key=_badness)


def _badness(view: ViewEntry) -> tuple[int, int, float]:
    if not view.advice:
        return 1, 0, 0.0
    cause = list(CAUSES).index(view.cause) if view.cause in CAUSES else len(CAUSES)
    errors = (view.rmse_after, view.held_out_px, view.rmse_before if view.rmse_after is None else None)
    worst = max((error for error in errors if error is not None), default=0.0)
    return -list(STATUS_WORDS).index(view.status), cause, -worst


def flagged(views: Sequence[ViewEntry]) -> list[ViewEntry]:
    """Return images that need a look, the worst first."""
    return [view for view in worst_first(views) if view.advice]


def offset_of(pair: PairEntry) -> float:
    """Return the epipolar offset (RMS) of a pair at the end of its run [px]; 0 where it is not known."""
    before, after = pair.offset_rms
    return (before if pair.epipolar_after is None else after) or 0.0


def worst_pairs(pairs: Sequence[PairEntry]) -> list[PairEntry]:
    """Return pairs by their epipolar offset, the largest first, where it is more than stereo wants; then the others."""
    return sorted(pairs, key=lambda pair: -max(offset_of(pair), GOOD_RMSE))


def torn(pairs: Sequence[PairEntry]) -> list[PairEntry]:
    """Return pairs whose epipolar offset is more than stereo wants, the worst first."""
    return [pair for pair in worst_pairs(pairs) if offset_of(pair) > GOOD_RMSE]


def sentences(summary: Summary) -> list[str]:
    """Return the verdict, one sentence for all images of one cause, one for all files left out for one reason."""
    alike: dict[tuple[str, str], list[tuple[str, str]]] = {}  # names and what is said of each
    for view in flagged(summary.views):
        alike.setdefault((view.status, view.cause or view.advice), []).append((view.name, view.reservation))
    for file in summary.left_out:  # a reason often begins with the file
        why = file.reason.replace(file.path, "").lstrip(": ")
        alike.setdefault(("", why), []).append((file.path, file.reason_text))
    own = {text for found in alike.values() for _, text in found}
    rest = [line for line in summary.verdict if line not in own]
    place = next((k for k, line in enumerate(summary.verdict) if line in own), len(rest))
    return [*rest[:place], *(line for why, found in alike.items() for line in _said(*why, found)), *rest[place:]]


def _said(status: str, why: str, alike: Sequence[tuple[str, str]]) -> list[str]:
    """Return sentences of images of a status, or of files, and why."""
    names = listed([name for name, _ in alike], NAMED)
    if len(alike) <= ALONE or (status and why not in CAUSES):
        return [text for _, text in alike]
    if not status:
        return [f"{len(alike)} files were left out, {names}: {why}"]
    start = f"{len(alike)} images are {STATUS_WORDS[status]}, {CAUSES[why].label}: {names}"
    remedy = CAUSES[why].remedy.format(image="IMAGE")
    return [". ".join(filter(None, (start, remedy[:1].upper() + remedy[1:]))) + "."]
