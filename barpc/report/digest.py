"""What of a summary stands on one screen, whatever its size: the worst first, what is alike said once."""

from __future__ import annotations

from collections.abc import Sequence

from barpc.report.reservations import GOOD_RMSE
from barpc.report.summary import LeftOutEntry, Summary
from barpc.report.summary.causes import CAUSES
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import NAMED, STATUS_WORDS, listed

SHOWN = 10  # rows of a table on the terminal, images and pairs alike
ALONE = 3  # images of one cause that have a sentence each; more share one
_ORDER = list(STATUS_WORDS)[::-1]
_CAUSES = list(CAUSES)


def worst_first(views: Sequence[ViewEntry]) -> list[ViewEntry]:
    """Return images by verdict, by what is wrong, by error; those without reservation as they come."""
    return sorted(views, key=_badness)


def _badness(view: ViewEntry) -> tuple[int, int, float]:
    if not view.advice:
        return len(_ORDER), 0, 0.0
    cause = _CAUSES.index(view.cause) if view.cause in CAUSES else len(_CAUSES)
    errors = (view.rmse_after, view.held_out_px, view.rmse_before if view.rmse_after is None else None)
    worst = max((error for error in errors if error is not None), default=0.0)
    return _ORDER.index(view.status), cause, -worst


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
    own = {view.reservation for view in summary.views if view.advice}
    own |= {one.reason_text for one in summary.left_out}
    together = [*_of_views(flagged(summary.views)), *_of_files(summary.left_out)]
    rest = [line for line in summary.verdict if line not in own]
    place = next((k for k, line in enumerate(summary.verdict) if line in own), len(rest))
    return [*rest[:place], *together, *rest[place:]]


def _of_views(views: Sequence[ViewEntry]) -> list[str]:
    found: dict[tuple[str, str], list[ViewEntry]] = {}
    for view in views:
        found.setdefault((view.status, view.cause or view.advice), []).append(view)
    out = []
    for (status, cause), alike in found.items():
        if len(alike) <= ALONE or cause not in CAUSES:
            out += [view.reservation for view in alike]
            continue
        names, words = listed([view.name for view in alike], NAMED), CAUSES[cause]
        start = f"{len(alike)} images are {STATUS_WORDS[status]}, {words.label}: {names}"
        remedy = words.remedy.format(image="IMAGE")
        out.append(". ".join(filter(None, (start, remedy[:1].upper() + remedy[1:]))) + ".")
    return out


def _of_files(files: Sequence[LeftOutEntry]) -> list[str]:
    """Return the reasons of files, without the file that a reason often begins with."""
    found: dict[str, list[LeftOutEntry]] = {}
    for one in files:
        found.setdefault(one.reason.replace(one.path, "").lstrip(": "), []).append(one)
    out = []
    for reason, alike in found.items():
        if len(alike) <= ALONE:
            out += [one.reason_text for one in alike]
        else:
            names = listed([one.path for one in alike], NAMED)
            out.append(f"{len(alike)} files were left out, {names}: {reason}")
    return out
