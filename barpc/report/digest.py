"""What a summary says on one screen, whatever its size: the worst first, what is alike said once; what was decided."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

from barpc.ba.usual import LARGEST
from barpc.report.reservations import GOOD_RMSE
from barpc.report.summary import Summary
from barpc.report.summary.known import ControlTestEntry
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.whole import AskedEntry, SceneEntry
from barpc.report.summary.words import CAUSES, NAMED, STATUS_WORDS, counted, known, listed, metres

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


# --- decisions: what it was done by -------------------------------------------------------------------


def decisions(summary: Summary) -> list[str]:
    """Return the decisions on the whole run: what ties its pairs, what each camera may do, what was cut."""
    options: Any = summary.options or {}
    asked = options.get("adjust") or {}
    found = [*_matching(summary.pairs, (options.get("tie") or {}).get("matcher"))]
    if (scene := summary.scene) is not None:
        found += [*_model(scene, summary.views), *_drift(scene, asked.get("drift")), *_jitter(scene, summary.views)]
        found += [*_priors(scene, summary.views), *_cut(scene, summary.views)]
        if seen := [point for point in summary.gcps if point.images]:
            found.append(f"{sum(point.used for point in seen)} of {len(seen)} GCPs that are seen hold the block.")
    return [*found, *_control(summary.control_test)]


def _matching(pairs: Sequence[PairEntry], asked: str | None) -> Iterator[str]:
    tied = [pair for pair in pairs if pair.tied_by]
    if not tied:
        yield from ["Tie points were taken as given: nothing was matched."] * bool(pairs)
        return
    matcher = f"; the matcher asked for is {asked}" if asked else ""
    by = Counter(pair.tied_by for pair in tied).most_common()
    yield f"{counted(len(tied), 'pair')} tied: {', '.join(f'{num} by {word}' for word, num in by)}{matcher}."
    if again := sum(bool(pair.beaten) for pair in tied):
        yield f"{counted(again, 'pair')} tried again, as fewer matches were found than wanted."
    if shares := [(pair.decoy_share, f"{pair.a} - {pair.b}") for pair in tied if pair.decoy_share is not None]:
        share, names = max(shares)
        yield f"Bands that hold no true match say that at most {100 * share:.2g} % of a pair's are false ({names})."
    if reasons := Counter(pair.chosen_by for pair in tied if pair.chosen_by).most_common():
        yield f"Why these pairs were tried: {', '.join(f'{num} {word}' for word, num in reasons)}."


def _model(scene: SceneEntry, views: Sequence[ViewEntry]) -> Iterator[str]:
    if scene.in_space_px is not None:
        affine = max((view.held_out_px for view in views if view.held_out_px is not None), default=0.0)
        yield (
            f"Rotations and translations leave {scene.in_space_px:.3f} px of tie points that took no part, an affine "
            f"in each image at most {affine:.3f} px, which was taken."
        )
    elif scene.model:
        yield f"Each camera is corrected by {scene.model}."
    if scene.explanations or scene.held_out_places is None:  # None: of an earlier release
        return
    if sum(len(view.correction.unknowns) for view in views if view.correction) > LARGEST:
        yield f"Nothing else was tried: in blocks of more than {LARGEST:,} unknowns explanations do not compete."
    elif scene.left:
        yield "None of what was tried beside the cameras' errors explains what stands out."
    else:
        yield "Nothing stood out that the cameras' errors as stated do not explain: nothing else was tried."


def _drift(scene: SceneEntry, asked: int | None) -> Iterator[str]:
    degree, sigmas = scene.drift_degree, scene.drift_sigma_m
    words = f"Rotations change along the rows with degree {degree}"
    if asked is not None:
        yield f"A drift of degree {degree} was asked for."
    elif not degree:
        yield "No drift was solved for: nothing rotates, or an earlier run had none."
    elif None in sigmas:
        yield f"{words}, as those of the earlier run do."
    else:
        sizes = ", ".join(metres(known(sigma)) for sigma in sigmas)
        why = "no F test asked for more"
        if scene.drift_asked is not None:
            why = f"degree {degree - 1} left {_left(scene.drift_asked)}"
        yield f"{words} (standard deviation at the first and last row: {sizes}): {why}."


def _left(asked: AskedEntry) -> str:
    shared = f", and neighbours shared {asked.shared_px:.2f} px" if asked.shared_px else ""
    tested = f"F test: p = {known(asked.smooth_p):.1g}; below 1e-4 in {counted(asked.num_images, 'image')}"
    return f"{known(asked.smooth_px):.2f} px that was smooth in {asked.image} ({tested}){shared}"


def _jitter(scene: SceneEntry, views: Sequence[ViewEntry]) -> Iterator[str]:
    corrections = [(view.correction, view.name) for view in views if view.correction]
    if sizes := [(one.jitter_px, name, one.jitter_rows) for one, name in corrections if one.jitter_px is not None]:
        size, worst, rows = max(sizes, key=lambda of_image: of_image[0])
        before = f": without them there was {_left(scene.jitter_asked)}" if scene.jitter_asked else ""
        follow = f"follow jitter in {counted(len(sizes), 'image')}, up to {size:.2f} px RMS ({worst}){before}"
        yield f"Splines with a knot every {known(rows):.0f} rows {follow}."
    if steps := [len(one.detectors) for one, _ in corrections if one.detectors]:
        yield f"Detectors begin at up to {counted(max(steps), 'column')} of {counted(len(steps), 'image')}."


def _priors(scene: SceneEntry, views: Sequence[ViewEntry]) -> Iterator[str]:
    if scene.prior_ratio is None:
        return
    widened = [(view.prior_scale, view.name) for view in views if (view.prior_scale or 1.0) > 1.005]
    scale, worst = max(widened, default=(1.0, ""))
    most = f"those of {counted(len(widened), 'image')} were widened, {scale:.1f} times at most ({worst})"
    words = f"Squared corrections are {scene.prior_ratio:.2g} times what the accuracies stated let expect"
    shared = scene.prior_shared or 1.0
    together = f" Taken as shared by all images, the accuracies stated were widened {shared:.1f} times."
    yield f"{words}: {most if widened else 'none was widened'}.{together * (shared > 1.005)}"


def _cut(scene: SceneEntry, views: Sequence[ViewEntry]) -> Iterator[str]:
    cut, kept = (sum(getattr(view, name) for view in views) for name in ("num_rejected", "num_observations"))
    if cut:
        share, worst = max((view.lost, view.name) for view in views)
        most = f"the most in {worst}: {100 * share:.1f} %"
        whole = f"{cut} of {cut + kept} observations of tie points ({100 * cut / (cut + kept):.1f} %)"
        yield f"{whole} were cut as wrong, {most}."
    elif kept:
        yield "No observation of a tie point was cut."
    if scene.num_held_out:
        yield f"{scene.num_held_out} more took no part, so that the result is measured on them."
        if scene.held_out_places == ():
            yield "Tie points that took no part are met alike over rows, columns and cells of every image."


def _control(test: ControlTestEntry | None) -> Iterator[str]:
    if test is not None:
        yield (
            f"{test.num_beyond} of {counted(test.num, 'residual')} of control in the images beyond {test.critical:g} "
            f"times its own standard deviation, where chance puts {test.expected:.1f} (the largest: "
            f"w = {known(test.largest_w):.1f}, {test.point} in {test.image})."
        )
