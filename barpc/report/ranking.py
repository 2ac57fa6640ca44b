"""Images and pairs in the order in which they are shown, the worst first, and one sentence for those of one cause."""

from __future__ import annotations

from collections.abc import Sequence

from barpc.base.errors import listed
from barpc.report.summary import Summary
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import CAUSES, NAMED, STATUS_WORDS, capital

GOOD_RMSE = 0.5  # px: a view with a larger RMS of its tie points needs review
SMOOTH_LEFT = 0.06  # px: a view with larger systematic residuals needs review
VERDICT_SENTENCES = 20  # sentences of the verdict that are shown at least
TABLE_ROWS_SHOWN = 10  # rows of a table on the terminal, images and pairs alike
MIN_PAIR_MATCHES = 30  # Of a pair that is called good for heights: they tell its offset to a fifth of its scatter


def worst_first(views: Sequence[ViewEntry]) -> list[ViewEntry]:
    """Return images sorted by verdict, cause and error; those without reservation last, in their order."""
    return sorted(views, key=_badness)


def _badness(view: ViewEntry) -> tuple[int, int, float]:
    if not view.advice:
        return 1, 0, 0.0
    cause = list(CAUSES).index(view.cause) if view.cause in CAUSES else len(CAUSES)
    errors = (view.rmse_after, view.held_out_px, view.rmse_before if view.rmse_after is None else None)
    worst = max((error for error in errors if error is not None), default=0.0)
    return -list(STATUS_WORDS).index(view.status), cause, -worst


def flagged(views: Sequence[ViewEntry]) -> list[ViewEntry]:
    """Return images with a reservation, the worst first."""
    return [view for view in worst_first(views) if view.advice]


def offset_of(pair: PairEntry) -> float:
    """Return the epipolar offset (RMS) of a pair at the end of its run [px]; 0 where unknown."""
    before, after = pair.offset_rms
    return (before if pair.epipolar_after is None else after) or 0.0


def worst_pairs(pairs: Sequence[PairEntry]) -> list[PairEntry]:
    """Return pairs with an epipolar offset above the limit of stereo, the largest first, then the others."""
    return sorted(pairs, key=lambda pair: -max(offset_of(pair), GOOD_RMSE))


def sure_pairs(views: Sequence[ViewEntry], pairs: Sequence[PairEntry]) -> list[PairEntry]:
    """Return pairs of images without reservation, with at least `MIN_PAIR_MATCHES` matches."""
    doubted = {view.name for view in views if view.advice}
    return [pair for pair in pairs if pair.num_matches >= MIN_PAIR_MATCHES and not {pair.a, pair.b} & doubted]


def torn(pairs: Sequence[PairEntry]) -> list[PairEntry]:
    """Return pairs whose epipolar offset exceeds the limit of stereo, the worst first."""
    return [pair for pair in worst_pairs(pairs) if offset_of(pair) > GOOD_RMSE]


def sentences(summary: Summary) -> tuple[list[str], list[str]]:
    """Return the results and the reservations: a sentence for all images of a cause, or files of a reason."""
    alike: dict[tuple[str, str], list[tuple[str, str]]] = {}  # names and sentences
    for view in flagged(summary.views):
        alike.setdefault((view.status, view.cause or view.advice), []).append((view.name, view.reservation))
    for file in summary.left_out:  # a reason often begins with the file
        why = file.reason.replace(file.path, "").lstrip(": ")
        alike.setdefault(("", why), []).append((file.path, file.reason_text))
    own = {text for found in alike.values() for _, text in found}
    wrong = [line for why, found in alike.items() for line in _status_sentences(*why, found)]
    results = [line for line in summary.verdict if line not in {*own, *summary.reasons}]
    return results, wrong + [line for line in summary.reasons if line not in own]


def _status_sentences(status: str, why: str, alike: Sequence[tuple[str, str]]) -> list[str]:
    """Return sentences of images of a status, or of files, and why."""
    names = listed([name for name, _ in alike], NAMED)
    if status and (len(alike) <= NAMED or why not in CAUSES):
        same: dict[str, list[str]] = {}
        for name, text in alike:
            same.setdefault(text.removeprefix(name), []).append(name)
        return [listed(named, NAMED) + text for text, named in same.items()]
    if len(alike) <= NAMED:
        return [text for _, text in alike]
    if not status:
        return [f"{len(alike)} files were left out, {names}: {why}"]
    start = f"{len(alike)} images: {STATUS_WORDS[status]}, {CAUSES[why].label}: {names}"
    return [". ".join(filter(None, (start, capital(CAUSES[why].remedy.format(image="IMAGE"))))) + "."]
