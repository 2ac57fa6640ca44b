"""What a run decided, and the figures that it decided by: sentences made from its summary."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from barpc.ba.apart import APART
from barpc.ba.usual import LARGEST, SURE
from barpc.report.records import Table, table
from barpc.report.summary import Summary
from barpc.report.summary.findings import RIVALS, ExplanationEntry
from barpc.report.summary.known import GcpEntry
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.whole import AskedEntry, SceneEntry
from barpc.report.summary.words import NAMED, known, listed, metres

SHARED = 0.03  # px: what neighbours share and is less is not followed
_LEFT = 3  # places


def decisions(summary: Summary) -> list[str]:
    """Return the decisions on the whole run: what ties its pairs, what each camera may do, what was cut."""
    found = _matching(summary)
    if (scene := summary.scene) is not None:
        found += [
            *_model(scene, summary),
            *_explained(scene, summary),
            *_drift(scene, summary),
            *_jitter(scene, summary),
            *_priors(scene, summary),
        ]
        found += [*_cut(scene, summary.views), *_control(summary.gcps)]
    return [*found, control_sentence(summary)] if summary.control_test else found


def second_attempts(pairs: Sequence[PairEntry]) -> Table | None:
    """Return the pairs that were tried more than once; None without any."""
    again = [pair for pair in pairs if pair.beaten]
    caption = "Pairs that were tried again, and what found fewer matches than were wanted"
    return table("again", caption, again, PairEntry, PairEntry.AGAIN).fold() if again else None


def control_sentence(summary: Summary) -> str:
    """Return what the test of every residual of control says; empty without control."""
    test = summary.control_test
    if test is None:
        return ""
    largest = f"the largest: w = {known(test.largest_w):.1f}, {test.point} in {test.image}"
    of_all = f"of {test.num} residuals of control in the images"
    each = f"{test.critical:g} times its own standard deviation"
    if not test.num_beyond:
        return f"None {of_all} exceeds {each} ({largest})."
    chance = f"{test.expected:.1f}" if test.expected >= 0.1 else "none"
    verb = "exceeds" if test.num_beyond == 1 else "exceed"
    return f"{test.num_beyond} {of_all} {verb} {each}, where chance puts {chance} ({largest})."


def _matching(summary: Summary) -> list[str]:
    pairs = summary.pairs
    tied = [pair for pair in pairs if pair.tied_by]
    if not tied:
        return ["Tie points were taken as given: nothing was matched."] * bool(pairs)
    matcher = _option(summary, "tie", "matcher")
    asked = f"; the matcher asked for is {matcher}" if matcher else ""
    found = [f"{len(tied)} pairs are tied: {_counts((pair.tied_by for pair in tied), 'by ')}{asked}."]
    if again := sum(bool(pair.beaten) for pair in tied):
        verb = "was" if again == 1 else "were"
        found[0] += f" {again} {verb} tried again, as fewer matches were found than wanted."
    shares = [(pair.decoy_share, f"{pair.a} - {pair.b}") for pair in tied if pair.decoy_share is not None]
    if shares:
        share, names = max(shares)
        words = f"say that at most {100 * share:.2g} % of a pair's matches are false ({names})"
        found.append(f"Bands that hold no true match {words}.")
    if reasons := [pair.chosen_by for pair in tied if pair.chosen_by]:
        found.append(f"Why these pairs were tried: {_counts(reasons)}.")
    return found


def _model(scene: SceneEntry, summary: Summary) -> list[str]:
    if scene.in_space_px is None:
        return [f"Each camera is corrected by {scene.model}."] * bool(scene.model)
    in_image = [view.held_out_px for view in summary.views if view.held_out_px is not None]
    affine = f", an affine in each image at most {max(in_image):.3f} px, which was taken" if in_image else ""
    left = f"{scene.in_space_px:.3f} px of tie points that took no part"
    return [f"Rotations and translations leave {left}{affine}."]


def _explained(scene: SceneEntry, summary: Summary) -> list[str]:
    """Return what explains the tie points beside the cameras' errors as stated, what was refused, and what is left."""
    found = [_won(one) for one in scene.explanations]
    tested = scene.held_out_places is not None  # not by earlier releases
    if not found and tested:
        why = "Nothing stood out that the cameras' errors as stated do not explain: nothing else was tried."
        if sum(len(view.correction.unknowns) for view in summary.views if view.correction) > LARGEST:
            why = f"Nothing else was tried: in blocks of more than {LARGEST:,} unknowns explanations do not compete."
        elif scene.left:
            why = f"None of what was tried explains what is left ({', '.join(RIVALS.values())}): refused."
        found = [why]
    if scene.left:
        rows = [
            f"{one.axis} {one.first:.0f}-{one.last:.0f} of {one.image} ({one.gain:.0f} nats; "
            f"{100 * one.rejected:.0f} % {'move' if one.moving else 'cut'}, {one.off_px:.2f} px in common)"
            for one in scene.left
        ]
        found.append(f"Still standing out: {listed(rows, _LEFT)}.")
    if scene.held_out_places:
        found += [f"{one.sentence} (p < {one.chance:.0e})." for one in scene.held_out_places[:_LEFT]]
    elif tested and scene.num_held_out:
        found += ["Tie points that took no part are met alike over rows, columns and cells of every image."]
    return found


def _won(one: ExplanationEntry) -> str:
    """Return an explanation that was taken, and by how much over what."""
    words = f"{one.sentence[0].upper()}{one.sentence[1:]}: {one.gain:.0f} nats more likely than without"
    if one.runner_up is None:
        return f"{words}; nothing else gained anything."
    rival = RIVALS.get(one.runner_up, f"the RPC of {one.runner_up.removeprefix(f'{APART}: ')} is not its own")
    if one.gap < SURE:
        return f"{words}, and no surer than what was refused, that {rival} ({one.gap:.0f} nats more)."
    return f"{words}, {one.gap:.0f} more than the best of what was refused, that {rival}."


def _drift(scene: SceneEntry, summary: Summary) -> list[str]:
    degree, sigmas = scene.drift_degree, scene.drift_sigma_m
    if _option(summary, "adjust", "drift") is not None:
        return [f"A drift of degree {degree} was asked for."]
    if not degree:
        return ["No drift was solved for: nothing rotates, or an earlier run had none."]
    words = f"Rotations change along the rows with degree {degree}"
    known = [sigma for sigma in sigmas if sigma is not None]
    if len(known) < len(sigmas):
        return [f"{words}, as those of the earlier run do."]
    sizes = f"standard deviation at the first and last row: {', '.join(map(metres, known))}"
    if scene.drift_asked is None:
        return [f"{words} ({sizes}): no F test asked for more."]
    return [f"{words} ({sizes}): degree {degree - 1} left {_left(scene.drift_asked)}."]


def _left(asked: AskedEntry) -> str:
    shared = f", and neighbours shared {asked.shared_px:.2f} px" if asked.shared_px else ""
    tested = f"F test: {_probability(asked.smooth_p)}; below 1e-4 in {asked.num_images} images"
    return f"{known(asked.smooth_px):.2f} px that was smooth in {asked.image} ({tested}){shared}"


def _jitter(scene: SceneEntry, summary: Summary) -> list[str]:
    found = []
    corrections = [(view.correction, view.name) for view in summary.views if view.correction]
    sizes = [(one.jitter_px, name, one.jitter_rows) for one, name in corrections if one.jitter_px is not None]
    if sizes:
        size, worst, rows = max(sizes, key=lambda of_image: of_image[0])
        before = f": without them there was {_left(scene.jitter_asked)}" if scene.jitter_asked else ""
        follow = f"follow jitter in {len(sizes)} images, up to {size:.2f} px RMS ({worst}){before}"
        found.append(f"Splines with a knot every {known(rows):.0f} rows {follow}.")
    if steps := [len(one.detectors) for one, _ in corrections if one.detectors]:
        found.append(f"Detectors begin at up to {max(steps)} columns of {len(steps)} images.")
    if found:
        return found
    if _option(summary, "adjust", "jitter") == "off":
        return ["Jitter was not looked for, as asked."]
    if _option(summary, "adjust", "drift") == 0 and _option(summary, "adjust", "jitter") == "auto":
        return ["Jitter was not looked for, as one rotation an image was asked for."]
    if any(one.axis or one.period for one in scene.explanations):  # they are followed, as is said above
        return []
    return [_calm(summary.views)] if any(view.shared_px is not None for view in summary.views) else []


def _calm(views: Sequence[ViewEntry]) -> str:
    size, worst = max((max(view.shared_px or 0.0, _smooth(view)), view.name) for view in views)
    words = f"No jitter is followed: residuals share {size:.3f} px with their neighbours at most ({worst})"
    if size <= SHARED:
        return f"{words}; {SHARED:g} px would be looked at."
    return f"{words}; splines met tie points that took no part no better, or these are too few for them."


def _smooth(view: ViewEntry) -> float:
    """Return what an F test finds smooth in an image [px]."""
    found = view.smooth_p is not None and view.smooth_p < 1e-4
    return (view.smooth_px or 0.0) if found else 0.0


def _priors(scene: SceneEntry, summary: Summary) -> list[str]:
    if scene.prior_ratio is None:
        return []
    words = f"Squared corrections are {scene.prior_ratio:.2g} times what the accuracies stated let expect"
    widened = [(view.prior_scale, view.name) for view in summary.views if (view.prior_scale or 1.0) > 1.005]
    shared = scene.prior_shared or 1.0
    together = f" Taken as shared by all images, the accuracies stated were widened {shared:.1f} times."
    together *= shared > 1.005
    if not widened:
        return [f"{words}: none was widened.{together}"]
    scale, worst = max(widened)
    most = f"{scale:.1f} times at most ({worst})"
    return [f"{words}: those of {len(widened)} images were widened, {most}.{together}"]


def _cut(scene: SceneEntry, views: Sequence[ViewEntry]) -> list[str]:
    lost, kept = (sum(getattr(view, name) for view in views) for name in ("num_rejected", "num_observations"))
    found = ["No observation of a tie point was cut."] if kept and not lost else []
    if lost:
        share, worst = max(
            (view.num_rejected / max(view.num_rejected + view.num_observations, 1), view.name) for view in views
        )
        most = f"the most in {worst}: {100 * share:.1f} %"
        whole = f"{lost} of {lost + kept} observations of tie points ({100 * lost / (lost + kept):.1f} %)"
        found.append(f"{whole} were cut as wrong, {most}.")
    if scene.num_held_out:
        found.append(f"{scene.num_held_out} more took no part, so that the result is measured on them.")
    return found


def _control(gcps: Sequence[GcpEntry]) -> list[str]:
    seen = [point for point in gcps if point.images]
    if not seen:
        return []
    rejected = [point.name for point in seen if point.status == "rejected"]
    undecided = sum(point.status == "undecided" for point in seen)
    words = f"{len(seen) - len(rejected) - undecided} of {len(seen)} GCPs that are seen hold the block"
    if undecided:
        return [f"{words}: they fall into sets that contradict each other, and none outweighs the others."]
    by = "the images contradict" if len(rejected) == len(seen) else "the rest contradicts"
    return [f"{words}; {by} {listed(rejected, NAMED)}." if rejected else f"{words}."]


def _counts(words: Iterable[str | None], by: str = "") -> str:
    """Return how often each word comes, the most frequent first."""
    return ", ".join(f"{num} {by}{word}" for word, num in Counter(words).most_common())


def _probability(value: float | None) -> str:
    return "p unknown" if value is None else "p < 1e-16" if value < 1e-16 else f"p = {value:.1g}"


def _option(summary: Summary, part: str, name: str) -> Any:
    group = (summary.options or {}).get(part)
    return group.get(name) if isinstance(group, dict) else None
