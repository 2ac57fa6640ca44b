"""Verdicts in plain words: of each image, of the block, of what the images cannot tell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from barpc.ba import Adjustment, check_residuals
from barpc.ba.apart import APART
from barpc.ba.judging.snooping import ControlTest
from barpc.ba.usual import SURE
from barpc.geodesy import Array
from barpc.report.dem_lines import dem_lines, dem_reasons
from barpc.report.outcome import MANY_REJECTED, Run
from barpc.report.records import plain
from barpc.report.reservations import NOISE_LIMIT, anywhere, is_smooth, lost, stands_out, view_status
from barpc.report.summary import LeftOutEntry, Summary, measure_run
from barpc.report.summary.findings import RIVALS, explanations, held_out_place, left_entries
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import NAMED, counted, listed, median, metres
from barpc.scene import GroundPoints
from barpc.tie.reference import PEAK

PRIOR_WIDENED = 2.0  # Cameras that are farther off than stated by more than this factor need a look
MOVED = 3.0  # A scene that moved by more than so many times what its cameras' accuracies let expect needs a look
_SAY_REJECTED = (
    "contradicted",
    "rejected",
    "wrong_matches",
)  # causes whose sentence says how many were rejected
_SAY_WHERE = "rejected", "place"  # causes whose sentence says where in the image
_LOOKED_AT = "The image was looked at"
_ALL_WELL = {
    "adjust": ("The image is adjusted", "Both images are adjusted", "All {} images are adjusted"),
    "check": (_LOOKED_AT, "The cameras of both images agree", "The cameras of all {} images agree"),
    "match": (_LOOKED_AT, "Both images are tied together", "All {} images are tied together"),
}
"""Kind of a run -> what is said of one, two and more images of which all is well."""
_CONTROL_WORDS = {
    "rejected": "{} rejected, contradicted by the rest: check coordinates, axes and image positions",
    "contradicts": "{} off by more than 4 standard deviations, used all the same: the stated accuracies are too good, "
    "or more than one is wrong",
}


def _block_reasons(run: Run, views: Sequence[ViewEntry]) -> list[str]:
    """Return what the adjustment says of itself that does not fit: priors, noise, the scene's move."""
    if run.adjustment is None or not len(run.tracks):
        return []
    prior, gauge, noise = run.adjustment.prior, run.adjustment.gauge, run.adjustment.noise
    out = []
    common = float(np.min(prior.scale)) if len(prior.scale) else 1.0
    if common > PRIOR_WIDENED:
        out.append(
            f"The cameras are {common:.1f} times farther off than stated: their standard deviations were widened, and "
            "what is known of the scene's place with them."
        )
    if (in_space := run.adjustment.in_space_rms) is not None:
        tilts, bends = (_lengths(gauge.motion_sigma[part]) for part in (slice(3, 5), slice(7, 10)))
        out.append(
            f"Rotations and translations leave {in_space:.3f} px of tie points that took no part; an affine in each "
            f"image leaves {median(run.adjustment.held_out_rms):.3f} px and was taken: images that were turned, "
            "resampled or cropped otherwise than their RPCs say, or RPCs of other images. Its tilts are known to "
            f"{tilts} (east, north) only, its twist and bending to {bends} (twist, east, north)."
        )
    names = run.adjustment.names
    if (apart := run.adjustment.apart) is not None and not apart.clear:
        what = "RPC, or most tie points of one image," if apart.look.as_stated else "RPC"
        out.append(
            f"One {what} among those of {listed([names[v] for v in apart.views])} is not its own: without any one of "
            "these images the others agree, with all they do not. The tie points do not tell which: check the RPCs, "
            "or add an image."
        )
    out += _left_reasons(run, views) + _ambiguous(run.adjustment)
    for group in run.adjustment.two_groups:
        i, j = group.views
        if not any(prior.odd[v] or is_smooth(v, run.adjustment) for v in (i, j)):
            out.append(
                f"Tie points of {names[i]} and {names[j]} fall into two groups, {100 * group.share:.0f} % lying "
                f"{group.apart:.2f} px from the others: there are two solutions, and this is the one between them. "
                "Look for a moving cloud or a repeated pattern, or add an image."
            )
    if noise > NOISE_LIMIT:
        out.append(
            f"Tie points scatter {noise:.1f} times as much as stated: wrong matches, or errors that these unknowns "
            "cannot follow."
        )
    with np.errstate(all="ignore"):
        moved = np.abs(gauge.shift) / gauge.delivered_sigma
    if _place_is_free(run) and (moved[np.isfinite(moved)] > MOVED).any():
        out.append(
            f"The scene moved by {_enu(gauge.shift)}, more than {MOVED:g} times what the accuracies of its "
            "cameras let expect: something is not as stated; control points or a DEM would tell."
        )
    return out


def _left_reasons(run: Run, views: Sequence[ViewEntry] = ()) -> list[str]:
    """Name where tie points were cut, or are off, more than elsewhere, or took no part and are; each image's worst.

    What an image's own reason says is not said again.
    """
    assert run.adjustment is not None
    said = {view.name for view in views if view.cause in _SAY_WHERE}
    worst: dict[str, str] = {}
    found, names = left_entries(run.adjustment), run.adjustment.names
    moving = [f"rows {one.first:.0f}-{one.last:.0f} of {one.image}" for one in found if one.moving]
    if moving:
        worst[""] = (
            f"Most tie points of {listed(moving, 3)} are of what moves: it may as well be these rows that lie off, "
            "and no camera follows them."
        )
    for one in found:
        if what := stands_out(one):
            place = f"{one.axis.capitalize()} {one.first:.0f}-{one.last:.0f} of {one.image}"
            worst.setdefault(one.image, f"{place} stand out: {what}.")
    for unmet in run.met_worse:  # what was solved with may agree with what it bent
        worst.setdefault(names[unmet.view], f"{held_out_place(unmet, names)}.")
    return [line for image, line in worst.items() if image not in said]


def _ambiguous(adjustment: Adjustment) -> list[str]:
    """Name groups that move, where something else explains tie points as well."""
    rivals = [one.runner_up for one in adjustment.findings if one.motion is not None and one.gap < SURE]
    return [
        f"That tie points move together explains them no better than that {RIVALS[rival]}: look at where they are."
        for rival in dict.fromkeys(rivals)
        if rival
    ]


def _place_is_free(run: Run) -> bool:
    """Return whether nothing but the cameras' priors holds the scene's place: control moves it as far as it must."""
    given = [getattr(run.options, name, None) for name in ("dem", "fixed_run")]
    assert run.adjustment is not None
    tested = run.adjustment.control
    held = tested is not None and bool(tested.used.any())
    heights = run.adjustment.altimetry
    held |= heights is not None and not heights.why_not
    return not held and not run.adjustment.options.fixed and not any(given)


def block_verdict(run: Run, views: Sequence[ViewEntry]) -> dict[str, Any]:
    """Return the verdict on the whole: `status`, a `headline`, `lines`, and those of them that are `reasons`.

    The one rule of what passes: `status` is "good" when no image, no control point and no file has a reservation;
    "bad" when an image was not adjusted or a file left out; else "look". What is not good ends with exit code 3.
    """
    bad = [view for view in views if view.status == "failed"]
    look = [view for view in views if view.advice and view.status != "failed"]
    reasons = [view.reservation for view in bad + look]
    reasons += [LeftOutEntry(path, reason).reason_text for path, reason in run.left_out]
    whole, points = _block_reasons(run, views) + dem_reasons(run.adjustment), _control_reasons(run)
    reasons += whole + points
    words = {"adjust": _adjusted_lines, "check": _checked_lines, "match": _matched_lines}[run.kind]
    num_bad = len(bad) + len(run.left_out)
    more = "the block needs" if whole else "ground points need" * bool(points)
    return {
        "status": "bad" if num_bad else "look" if reasons else "good",
        "headline": _headline(run, len(views), num_bad, len(look), more),
        "lines": words(run, views) + reasons,
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


def _control_reasons(run: Run) -> list[str]:
    """Name ground points that were cut, what was left out of their files, a reference of no use."""
    out = []
    if run.reference is not None and run.adjustment is not None and run.reference.control is None:
        whys = "the DEM under it is of another place, or it is too old or too coarse"
        if all(view.peak < PEAK for view in run.reference.views):
            whys = "another place, too old, or without texture"
        out.append(f"The reference {run.reference.refusal}: {whys}. It was not used, and moved nothing.")
    out += _bends(run) + _wrong_heights(run)
    heights = None if run.adjustment is None else run.adjustment.altimetry
    if heights is not None and heights.why_not:
        counts = f"{heights.agree} of {heights.near} on the tie points' surface agree, of {heights.given} given"
        out.append(f"The altimetry holds nothing: {heights.why_not} ({counts}).")
    tested = None if run.adjustment is None else run.adjustment.control
    if run.gcps is not None and tested is not None:
        for status, words in () if tested.torn else _CONTROL_WORDS.items():
            names = [
                f"{name} ({_enu(tested.residual[g])}, w = {tested.w[g]:.1f})"
                if np.isfinite(tested.w[g])
                else f"{name} (too few images show it to tell by how much)"
                for g, name in enumerate(run.gcps.names)
                if tested.status(g) == status
            ]
            if names:
                alike = status == "rejected" and tested.agreed is not None and tested.agreed.alike
                datum = " They agree with each other: is their datum, or their height, another one?" * alike
                out.append(f"{words.format(counted(len(names), 'GCP'))}: {listed(names)}.{datum}")
        out += _undecided(run.gcps.names, tested) + _torn(tested)
        if not tested.fits and not any(tested.status(g) == "contradicts" for g in range(len(tested.used))):
            out.append(
                f"{counted(int(tested.used.sum()), 'GCP')} scatter {tested.scatter:.1f} times as much as stated: the "
                "accuracies are too good, or more than one is wrong."
            )
    return out + [f"{line}." for p in (run.gcps, run.check_points) if p is not None for line in p.left_out]


def _wrong_heights(run: Run) -> list[str]:
    """Say that a reference's points lie off each other along the lines of sight, as the terrain's errors move them."""
    if run.reference is None or run.adjustment is None:
        return []
    stated = run.adjustment.options.dem_sigma
    wrong = [view for view in run.reference.views if view.points and view.shows_heights(stated)]
    named = listed([f"{metres(view.along)} in {view.name}" for view in wrong], NAMED)
    words = (
        f"The heights of the DEM under the reference are not the terrain's: along the lines of sight its points lie "
        f"off each other by {named}, as heights wrong by {metres(max((v.heights for v in wrong), default=0.0))} would "
        f"make them ({metres(stated)} stated). What all of them are wrong by does not show, and moves the scene: check "
        "the DEM."
    )
    return [words] if wrong else []


def _bends(run: Run) -> list[str]:
    """Name images in which a reference's points lie off each other by more than a pixel, which finding them leaves."""
    if run.reference is None:
        return []
    step = run.reference.step
    wide = [view for view in run.reference.views if view.points and view.scatter > step]
    named = listed([f"{view.name} ({metres(view.scatter)})" for view in wide], NAMED)
    words = (
        f"Points of the reference lie off each other, across the lines of sight, by more than the {metres(step)} of a "
        f"pixel that finding them may leave, in {named}: it bends, or the images do."
    )
    return [words] if wide else []


def _undecided(names: Sequence[str], tested: ControlTest) -> list[str]:
    """Name sets of GCPs that contradict each other and weigh the same."""
    if not tested.sets:
        return []
    both = (np.flatnonzero(points).tolist() for points in tested.sets)
    one, other = (listed([names[g] for g in points], NAMED) for points in both)
    middle = [tested.residual[points & np.isfinite(tested.w)] for points in tested.sets]
    apart = ""
    if all(len(residual) for residual in middle):
        apart = f" ({_enu(middle[0].mean(axis=0) - middle[1].mean(axis=0))} between them)"
    return [
        f"GCPs contradict each other, and no set of them outweighs the others: {one} against {other}{apart}. None of "
        "them was used: check coordinates, axes, datum and image positions, or add a point."
    ]


def _torn(tested: ControlTest) -> list[str]:
    """Say that control agrees with itself and not with the images."""
    if not tested.torn:
        return []
    without, held = tested.torn
    return [
        f"Held by the GCPs the images would agree less with each other: {without:.3f} px became {held:.3f} px at tie "
        "points that took no part. None of the GCPs was used: check coordinates, image positions and stated accuracies."
    ]


def _adjusted_lines(run: Run, views: Sequence[ViewEntry]) -> list[str]:
    assert run.adjustment is not None
    before, after = (median([getattr(view, key) for view in views]) for key in ("rmse_before", "rmse_after"))
    gauge, prior = run.adjustment.gauge, run.adjustment.prior
    tied = sum(view.num_observations > 0 for view in views)
    was = f" (before: {before:.3f} px)" if np.isfinite(before) else ""
    lines = [f"Tie points of {counted(tied, 'image')} agree to {after:.3f} px{was}."]
    if not len(run.tracks) or not np.isfinite(after):
        lines = ["There are no tie points: the cameras are held by control alone."]
    drift = f"drift of degree {run.adjustment.cameras.unknowns.drift}"
    if prior.drift_sigma and np.isfinite(prior.drift_sigma).all():  # an earlier run's are in its matrix
        sizes = f"{_lengths(prior.drift_sigma)} at the first and last row"
        lines.append(f"Rotations change along the rows ({drift}; {sizes}).")
    lines += _jitter_lines(views) + _radar_lines(views)
    unsaid = [view for view in views if lost(view) > MANY_REJECTED and view.cause not in _SAY_REJECTED]
    if many := [view.name for view in unsaid if anywhere(view, run)]:
        # what is wrong in one image takes the tie points of the others with it
        alike = [view.name for view in unsaid if view.name not in many]
        why = f"but those of {listed(alike)} in the same" if alike else "as wrong matches are"
        lines.append(
            f"More than {100 * MANY_REJECTED:.0f} % of the tie points of {listed(many)} were rejected, neighbours in "
            f"any direction, {why}."
        )
    lines += [
        f"{one.sentence[0].upper()}{one.sentence[1:]}." for one in explanations(run.adjustment) if one.name != APART
    ]
    if len(run.tracks) or run.gcps is not None:
        lines.append(f"The scene as a whole moved by {_enu(gauge.shift)}.")
    lines += _reference_lines(run) + _altimetry_lines(run.adjustment)
    known = f"its place is known to {_lengths(gauge.sigma)} (east, north, up; one sigma)"
    if run.gcps is None:
        heights = run.adjustment.altimetry
        by_others = (run.reference is not None and run.reference.control is not None) or (
            heights is not None and not heights.why_not
        )
        held_by = "So" if by_others else "Without ground control"
        lines.append(f"{held_by} {known}{' only' if held_by != 'So' else ''}.")
    else:
        lines += _held_lines(run, run.gcps, views, known)
    lines += dem_lines(run.adjustment)
    if run.check_points is not None and run.after is not None:
        image, ground = check_residuals(run.after, run.check_points).rms()
        seen = f"{np.hypot(*image):.2f} px in the images"
        if np.isfinite(ground).all():
            seen += f" and {_lengths(ground)} on the ground (east, north, up)"
        num = len(run.check_points.names)
        met = f"{counted(num, 'check point')}, not used above, {'is' if num == 1 else 'are'}"
        if np.isfinite(image).all():
            lines.append(f"{met} met to {seen} (RMS).")
        else:
            lines.append(f"{met} seen by no camera.")
    return lines


def _held_lines(run: Run, gcps: GroundPoints, views: Sequence[ViewEntry], known: str) -> list[str]:
    """Return what ground control says of the scene's place; `known` is what the adjustment states of it."""
    assert run.adjustment is not None
    is_seen = np.bincount(gcps.point, minlength=len(gcps.names)) > 0
    tested, lines = run.adjustment.control, []
    held = int(np.count_nonzero(is_seen if tested is None else is_seen & tested.used))
    with_points = f"With {counted(held, 'GCP')}"
    scale = 1.0 if tested is None or tested.agreed is None else tested.agreed.scale
    if tested is None or tested.agrees:
        lines.append(f"{with_points} {known}{'' if held else ' only'}.")
    elif not held:
        lines.append(f"Without ground control that agrees {known} only.")
    elif scale > 1.0:
        lines.append(f"{with_points}, taken for {scale:.0f} times less accurate than stated, {known}.")
    else:
        lines.append(
            f"{counted(held, 'GCP')} that hold the scene do not agree: what is known of its place they do not tell."
        )
    if held and tested is not None and tested.agrees and not tested.checked:
        lines.append(f"Nothing checks {'it' if held == 1 else 'them'}: an error in a GCP would not show.")
    alone = np.unique(gcps.view)
    if held and len(alone) == 1 and len(views) > 1:
        name = views[alone[0]].name
        lines.append(f"They are seen in {name} alone, which says nothing along its lines of sight.")
    return lines


def _jitter_lines(views: Sequence[ViewEntry]) -> list[str]:
    """Return what follows the corrections in the images."""
    lines = []
    found = [view.correction for view in views if view.correction is not None]
    if waving := [one for one in found if one.jitter_px is not None]:
        sizes = ", ".join(f"{one.jitter_px:.2f}" for one in waving[:NAMED])
        rows = median([one.jitter_rows for one in waving])
        lines.append(
            f"Jitter along the rows is followed by splines, a knot every {rows:.0f} rows: {sizes} px RMS"
            f"{', ...' if len(waving) > NAMED else ''}. Tie points do not see what all images have in common "
            "along the epipolar lines: control points, a DEM or a reference do."
        )
    if stepping := [one for one in found if one.detectors]:
        most = max(len(one.detectors or ()) for one in stepping)
        size = median([one.detector_px for one in stepping])
        lines += [f"Detectors begin at up to {counted(most, 'column')} of an image, {size:.2f} px RMS apart."]
    return lines


def _radar_lines(views: Sequence[ViewEntry]) -> list[str]:
    """Return what the clocks of radars were off by."""
    found = [
        f"{view.name}: range {one.range_m:+.2f} ± {sigma[0]:.2f} m, azimuth {one.azimuth_ms:+.3f} ± {sigma[1]:.3f} ms"
        for view in views
        if (one := view.correction) is not None and (sigma := one.timing_sigma) is not None
    ]
    return [f"Radar images are corrected by their clocks: {listed(found, NAMED)}."] if found else []


def _altimetry_lines(adjustment: Adjustment) -> list[str]:
    """Return what heights without image coordinates did."""
    test = adjustment.altimetry
    if test is None or test.why_not:
        return []
    agree = f"{test.agree} of {test.near} altimetry heights agree with the surface of the tie points"
    return [
        f"{agree} to {metres(test.spread)} ({metres(test.expected)} expected); they moved it by {_enu(test.motion)}."
    ]


def _reference_lines(run: Run) -> list[str]:
    """Return what a reference was good for."""
    found = run.reference
    if found is None or found.control is None:
        return []
    matched = [view for view in found.views if view.points]
    rest = listed([view.name for view in found.views if not view.points])
    if not matched:
        return [f"The reference holds no point of {rest}."] if rest else []
    used, tried = sum(view.points for view in matched), sum(view.tried for view in matched)
    off = ", ".join(f"{np.hypot(*view.offset):.1f} m ({view.name})" for view in matched[:NAMED])
    more = f" and {len(matched) - NAMED} more" if len(matched) > NAMED else ""
    text = (
        f"Reference: {used} of {counted(tried, 'point')} matched at {metres(found.step)} in "
        f"{counted(len(matched), 'image')}, peak {min(view.peak for view in matched):.1f} or more; as delivered they "
        f"were off by {off}{more}."
    )
    pixels = found.step / max(view.gsd for view in matched)
    if np.isfinite(pixels):
        text += f" Bends of an image by less than its pixel, {pixels:.2g} px here, it does not tell."
    return [text, f"The reference holds no point of {rest}."] if rest else [text]


def _lengths(values: Iterable[float]) -> str:
    return ", ".join(map(metres, values))


def _enu(shift: Array) -> str:
    return ", ".join(f"{s:+.2f} m {word}" for s, word in zip(shift, ("east", "north", "up"), strict=True))


def _checked_lines(_: Run, views: Sequence[ViewEntry]) -> list[str]:
    rmse = median([view.rmse_before for view in views])
    if not np.isfinite(rmse):
        return ["No camera sees tie points of another image."]
    return [f"Tie points of {counted(len(views), 'image')} agree to {rmse:.3f} px as the cameras are."]


def _matched_lines(run: Run, views: Sequence[ViewEntry]) -> list[str]:
    points = counted(run.tracks.num_points, "tie point")
    return [f"{points} of {counted(len(views), 'image')}, {counted(len(run.tracks), 'observation')}."]


def summarize(run: Run) -> Summary:
    """Return the summary of a run with the verdict on it; a number that is not finite is None, as a file has it."""
    found = measure_run(run)
    views = tuple(replace(view, **view_status(view, run)) for view in found.views)  # type: ignore[arg-type]
    block = block_verdict(run, views)
    verdict = {"status": block["status"], "headline": block["headline"], "reasons": block["reasons"]}
    passed = block["status"] == "good"
    whole = replace(found, views=views, verdict=block["lines"], passed=passed, **verdict)
    return Summary.read(plain(whole))
