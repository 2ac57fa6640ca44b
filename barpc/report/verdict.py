"""Verdicts in plain words: of each image, of the block, of what the images cannot tell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from barpc.ba import Adjustment, check_residuals
from barpc.ba.apart import FOREIGN_CAMERA
from barpc.ba.constraints.gauge import MOTIONS
from barpc.base.errors import listed
from barpc.base.geodesy import Array
from barpc.base.statistics import FEW, SURE, SURELY
from barpc.report.datum import datum_reasons
from barpc.report.outcome import MANY_REJECTED, Added, Run
from barpc.report.quality_checks import (
    GOOD_RMSE,
    NOISE_LIMIT,
    anywhere,
    control_reasons,
    dem_lines,
    dem_reasons,
    enu,
    held_lines,
    is_smooth,
    lengths,
    reference_lines,
    reference_reasons,
    stands_out,
    view_status,
)
from barpc.report.records import json_form, value_of
from barpc.report.summary import LeftOutEntry, Summary, measure_run
from barpc.report.summary.block import EXPLANATION_WORDS, explanations, held_out_places, left_entries
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import CAUSES, NAMED, STATUS_WORDS, counted, median, metres

TABLE_ROWS_SHOWN = 10  # rows of a table on the terminal, images and pairs alike
VERDICT_SENTENCES = 20  # sentences of the verdict that are shown at least
PRIOR_WIDENED = 2.0  # Cameras that are farther off than stated by more than this factor need a look
_SHAPE = [MOTIONS.index(name) for name in ("tilt east", "tilt north", "twist", "bend east", "bend north")]
_SAY_REJECTED = "contradicted", "rejected", "wrong_matches"  # causes whose sentence says how many were rejected
_SAY_WHERE = "rejected", "place"  # causes whose sentence says where in the image
_LOOKED_AT = "The image was looked at"
_ALL_WELL = {
    "adjust": ("The image is adjusted", "Both images are adjusted", "All {} images are adjusted"),
    "check": (_LOOKED_AT, "The cameras of both images agree", "The cameras of all {} images agree"),
    "match": (_LOOKED_AT, "Both images are tied together", "All {} images are tied together"),
}
"""Kind of a run -> what is said of one, two and more images of which all is well."""


def summarize(run: Run) -> Summary:
    """Return the summary of a run with the verdict on it; a number that is not finite is None, as a file has it."""
    found = measure_run(run)
    views = tuple(replace(view, **view_status(view, run)) for view in found.views)  # type: ignore[arg-type]
    verdict = block_verdict(run, views)
    summary: Summary = json_form(replace(found, views=views, passed=verdict["status"] == "good", **verdict), keep=True)
    return summary


def block_verdict(run: Run, views: Sequence[ViewEntry]) -> dict[str, Any]:
    """Return the verdict on the whole: `status`, a `headline`, the `verdict`, and which of its lines are `reasons`.

    The one rule of what passes: `status` is "good" when no image, no control point and no file has a reservation;
    "bad" when an image was not adjusted or a file left out; else "look". What is not good ends with exit code 3.
    """
    bad = [view for view in views if view.status == "failed"]
    look = [view for view in views if view.advice and view.status != "failed"]
    reasons = [view.reservation for view in bad + look]
    reasons += [LeftOutEntry(path, reason).reason_text for path, reason in run.left_out]
    whole, points = [*_block_reasons(run, views)], [*_ground_reasons(run)]
    reasons += whole + points
    words = {"adjust": _adjusted_lines, "check": _checked_lines, "match": _matched_lines}[run.kind]
    num_bad = len(bad) + len(run.left_out)
    more = "the block needs" if whole else "ground points need" * bool(points)
    return {
        "status": "bad" if num_bad else "look" if reasons else "good",
        "headline": _headline(run, len(views), num_bad, len(look), more),
        "verdict": [*words(run, views), *reasons],
        "reasons": reasons,
    }


def _headline(run: Run, num: int, bad: int, look: int, more: str) -> str:
    text, parts = _ALL_WELL[run.kind][min(num, 3) - 1].format(num), []
    if bad:
        word = "not adjusted" if run.kind == "adjust" else "not usable"
        parts.append(f"{bad} {'image is' if bad == 1 else 'images are'} {word}")
    if look:
        parts.append(f"{look} {'needs' if look == 1 else 'need'} a look")
    if parts:
        text = f"{', '.join(parts)} (of {num + len(run.left_out)})"
    return f"{text}; {more} a look." if more else f"{text}."


# --- what needs a look ------------------------------------------------------------------------------------


def _block_reasons(run: Run, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Return what the adjustment says of itself that does not fit: priors, noise, the scene's move, the DEM."""
    if (found := run.adjustment) is None:
        return
    if len(run.tracks):
        yield from (*_of_cameras(found), *_of_places(run, found, views), *_of_solution(run, found))
    yield from dem_reasons(found)
    yield from datum_reasons(run.datums, found)


def _of_cameras(found: Adjustment) -> Iterator[str]:
    common = float(np.min(found.prior.scale)) if len(found.prior.scale) else 1.0
    if common > PRIOR_WIDENED:
        yield (
            f"The cameras are {common:.1f} times farther off than stated: their standard deviations were widened, and "
            "what is known of the scene's place with them."
        )
    if _is_bent(found):
        yield from _of_image_model(found)
    if found.apart is not None and not found.apart.clear:
        what = "RPC, or most tie points of one image," if found.apart.look.as_stated else "RPC"
        yield (
            f"One {what} among those of {listed([found.names[v] for v in found.apart.views])} is not its own: without "
            "any one of these images the others agree, with all they do not. The tie points do not tell which: check "
            "the RPCs, or add an image."
        )


def _is_bent(found: Adjustment) -> bool:
    """Return whether heights at the scene's edge are known worse by its tilts, twist and bending than by its place."""
    return bool(found.gauge.motion_sigma[_SHAPE].max() > found.gauge.sigma[2])


def _of_image_model(found: Adjustment) -> Iterator[str]:
    """Say that a model in the image was taken, and what it leaves open of the scene's shape."""
    if found.in_space_rms is None:
        return
    tilts, bends = (lengths(found.gauge.motion_sigma[part]) for part in (_SHAPE[:2], _SHAPE[2:]))
    yield (
        f"Rotations and translations leave {found.in_space_rms:.3f} px of tie points that took no part; an affine "
        f"in each image leaves {median(found.held_out_rms):.3f} px and was taken: images that were turned, "
        "resampled or cropped otherwise than their RPCs say, or RPCs of other images. At "
        f"{metres(found.gauge.radius)} from the scene's middle its heights are known to {tilts} by its tilts (east, "
        f"north), over the scene to {bends} by its twist and bending (twist, east, north)."
    )


def _of_places(run: Run, adjustment: Adjustment, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Name where tie points were cut, or are off, more than elsewhere, or took no part and are; each image's worst.

    What an image's own reason says is not said again.
    """
    said = {view.name for view in views if view.cause in _SAY_WHERE}
    found = left_entries(adjustment)
    if moving := [f"rows {one.first:.0f}-{one.last:.0f} of {one.image}" for one in found if one.moving]:
        yield (
            f"Most tie points of {listed(moving)} are of what moves: it may as well be these rows that lie off, and no "
            "camera follows them."
        )
    worst: dict[str, str] = {}
    for one in found:
        if what := stands_out(one):
            place = f"{one.axis.capitalize()} {one.first:.0f}-{one.last:.0f} of {one.image}"
            worst.setdefault(one.image, f"{place} stand out: {what}.")
    for unmet in held_out_places(run.met_worse, adjustment.names):  # what was solved with may agree with what it bent
        worst.setdefault(unmet.image, f"{unmet.sentence}.")
    yield from (line for image, line in worst.items() if image not in said)
    rivals = [one.runner_up for one in adjustment.findings if one.motion is not None and one.gap < SURE]
    for rival in filter(None, dict.fromkeys(rivals)):
        words = f"explains them no better than that {EXPLANATION_WORDS[rival]}"
        yield f"That tie points move together {words}: look at where they are."


def _of_solution(run: Run, found: Adjustment) -> Iterator[str]:
    for group in found.two_groups:
        i, j = group.views
        if not any(found.prior.odd[v] or is_smooth(v, found) for v in (i, j)):
            yield (
                f"Tie points of {found.names[i]} and {found.names[j]} fall into two groups, {100 * group.share:.0f} % "
                f"lying {group.apart:.2f} px from the others: there are two solutions, and this is the one between "
                "them. Look for a moving cloud or a repeated pattern, or add an image."
            )
    if found.noise > NOISE_LIMIT:
        yield (
            f"Tie points scatter {found.noise:.1f} times as much as stated: wrong matches, or errors that these "
            "unknowns cannot follow."
        )
    with np.errstate(all="ignore"):
        moved = np.abs(found.gauge.shift) / found.gauge.delivered_sigma
    # control, an earlier run and fixed views move it as far as they must, a DEM and altimetry in height
    used = found.control is not None and bool(found.control.used.any())
    held = used or bool(found.reference_inlier.any()) or bool(found.options.fixed or _option_value(run, "add_to"))
    by_heights = _holds(found) or bool(_option_value(run, "dem"))
    moved = moved[:2] if by_heights else moved
    if not held and (moved[np.isfinite(moved)] > SURELY).any():
        which = "heights may be another place's; control points" if by_heights else "control points or a DEM"
        yield (
            f"The scene moved by {enu(found.gauge.shift)}, more than {SURELY:g} times what the accuracies of its "
            f"cameras let expect: something is not as stated; {which} would tell."
        )


def _option_value(run: Run, name: str) -> object:
    return getattr(run.options, name, None)


def _holds(found: Adjustment) -> bool:
    """Whether heights without image coordinates hold the scene."""
    return found.altimetry is not None and not found.altimetry.why_not


def _ground_reasons(run: Run) -> Iterator[str]:
    """Name ground points that were cut, what was left out of their files, a reference or heights of no use."""
    adjustment, gcps = run.adjustment, run.gcps
    if adjustment is not None:
        yield from reference_reasons(run, adjustment.options.dem_sigma)
        if (heights := adjustment.altimetry) is not None and heights.why_not:
            counts = f"{heights.agree} of {heights.near} on the tie points' surface agree, of {heights.given} given"
            yield f"The altimetry holds nothing: {heights.why_not} ({counts})."
        if gcps is not None and adjustment.control is not None:
            yield from control_reasons(gcps.names, adjustment.control)
    for points in (gcps, run.check_points):
        yield from (f"{line}." for line in (() if points is None else points.left_out))


# --- what was reached -------------------------------------------------------------------------------------


def _adjusted_lines(run: Run, views: Sequence[ViewEntry]) -> Iterator[str]:
    assert run.adjustment is not None
    before, after = (median([getattr(view, key) for view in views]) for key in ("rmse_before", "rmse_after"))
    gauge, gcps = run.adjustment.gauge, run.gcps
    tied = counted(sum(view.num_observations > 0 for view in views), "image")
    if len(run.tracks) and np.isfinite(after):
        was = f" (before: {before:.3f} px)" if np.isfinite(before) else ""
        yield f"Tie points of {tied} agree to {after:.3f} px{was}."
    else:
        yield "There are no tie points: the cameras are held by control alone."
    if radars := [_clocks(view) for view in views if view.correction and view.correction.timing_sigma]:
        yield f"Radar images are corrected by their clocks: {listed(radars, NAMED)}."
    unsaid = [view for view in views if view.lost > MANY_REJECTED and view.cause not in _SAY_REJECTED]
    if many := [view.name for view in unsaid if anywhere(view, run)]:
        # what is wrong in one image takes the tie points of the others with it
        alike = [view.name for view in unsaid if view.name not in many]
        why = f"but those of {listed(alike)} in the same" if alike else "as wrong matches are"
        yield (
            f"More than {100 * MANY_REJECTED:.0f} % of the tie points of {listed(many)} were rejected, neighbours in "
            f"any direction, {why}."
        )
    found = [one.sentence for one in explanations(run.adjustment) if one.name != FOREIGN_CAMERA]
    yield from (f"{sentence[0].upper()}{sentence[1:]}." for sentence in found)
    if run.added is not None:
        yield from _added_lines(run.added, len(views))
    if len(run.tracks) or gcps is not None:
        yield f"The scene as a whole moved by {enu(gauge.shift)}."
    yield from reference_lines(run)
    if (heights := run.adjustment.altimetry) is not None and not heights.why_not:
        yield (
            f"{heights.agree} of {heights.near} altimetry heights agree with the surface of the tie points to "
            f"{metres(heights.spread)} ({metres(heights.expected)} expected); they moved it by {enu(heights.motion)}."
        )
    if not _is_bent(run.adjustment):
        yield from _of_image_model(run.adjustment)
    yield from _known_lines(run, run.adjustment, views)
    yield from dem_lines(run.adjustment)
    if run.check_points is not None and run.after is not None:
        yield _residual_sentence(check_residuals(run.after, run.check_points).rms(), len(run.check_points.names))


def _added_lines(added: Added, num: int) -> Iterator[str]:
    """Say what was added to which run, and whether its own images should move: which, and by how much."""
    new = counted(num - added.met, "image")
    yield f"{new} added to the {counted(added.images, 'image')} of {added.run}, {added.met} of which they meet."
    name, far = added.largest
    if not added.beyond:
        yield f"None of these need move: {name} would by {far:.3f} px, no more than the {added.floor:g} px all share."
        return
    some = listed([f"{one} ({px:.2f} px)" for one, px in added.beyond], NAMED)
    do = "their cameras are written here" if added.updated else "--update writes their cameras, too"
    many = counted(len(added.beyond), "image")
    yield f"{many} of {added.run} should move by more than {added.floor:g} px: {some}; {do}."


def _known_lines(run: Run, found: Adjustment, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Return how well the scene's place is known, and what tells it."""
    known = f"its place is known to {lengths(found.gauge.sigma)} (east, north, up; one sigma)"
    if run.gcps is not None:
        yield from held_lines(found.control, run.gcps, views, known)
    elif _holds(found) or (run.reference is not None and run.reference.control is not None):
        yield f"So {known}."
    elif (terrain := found.terrain) is not None and terrain.shows and terrain.held:
        yield f"With the DEM {known}."
    else:
        yield f"Without ground control {known} only."


def _clocks(view: ViewEntry) -> str:
    by_range, azimuth, sigma = (
        value_of(view, f"correction.{name}") for name in ("range_m", "azimuth_ms", "timing_sigma")
    )
    return f"{view.name}: range {by_range:+.2f} ± {sigma[0]:.2f} m, azimuth {azimuth:+.3f} ± {sigma[1]:.3f} ms"


def _residual_sentence(rms: tuple[Array, Array], num: int) -> str:
    image, ground = rms
    met = f"{counted(num, 'check point')}, not used above, {'is' if num == 1 else 'are'}"
    if not np.isfinite(image).all():
        return f"{met} seen by no camera."
    on_ground = f" and {lengths(ground)} on the ground (east, north, up)" if np.isfinite(ground).all() else ""
    return f"{met} met to {np.hypot(*image):.2f} px in the images{on_ground} (RMS)."


def _checked_lines(_: Run, views: Sequence[ViewEntry]) -> Iterator[str]:
    rmse = median([view.rmse_before for view in views])
    if np.isfinite(rmse):
        yield f"Tie points of {counted(len(views), 'image')} agree to {rmse:.3f} px as the cameras are."
    else:
        yield "No camera sees tie points of another image."


def _matched_lines(run: Run, views: Sequence[ViewEntry]) -> Iterator[str]:
    points = counted(run.tracks.num_points, "tie point")
    yield f"{points} of {counted(len(views), 'image')}, {counted(len(run.tracks), 'observation')}."


# --- what fits on one screen: the worst first, what is alike said once -------------------------------------


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


def sure_pairs(views: Sequence[ViewEntry], pairs: Sequence[PairEntry]) -> list[PairEntry]:
    """Return pairs of images that need no look, with enough matches to know it."""
    doubted = {view.name for view in views if view.advice}
    return [pair for pair in pairs if pair.num_matches >= FEW and not {pair.a, pair.b} & doubted]


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
    return [
        *rest[:place],
        *(line for why, found in alike.items() for line in _status_sentences(*why, found)),
        *rest[place:],
    ]


def _status_sentences(status: str, why: str, alike: Sequence[tuple[str, str]]) -> list[str]:
    """Return sentences of images of a status, or of files, and why."""
    names = listed([name for name, _ in alike], NAMED)
    if len(alike) <= NAMED or (status and why not in CAUSES):
        return [text for _, text in alike]
    if not status:
        return [f"{len(alike)} files were left out, {names}: {why}"]
    start = f"{len(alike)} images are {STATUS_WORDS[status]}, {CAUSES[why].label}: {names}"
    remedy = CAUSES[why].remedy.format(image="IMAGE")
    return [". ".join(filter(None, (start, remedy[:1].upper() + remedy[1:]))) + "."]
