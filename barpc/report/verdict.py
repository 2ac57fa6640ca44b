"""Verdicts in sentences: on each image, the block, its datum and weak modes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.constraints.gauge import MOTIONS
from barpc.ba.parameters.priors import is_stated
from barpc.ba.terms import TERMS
from barpc.base.errors import listed
from barpc.base.statistics import SURE, SURELY
from barpc.report.constraints import control_reasons, deformation_reasons, dem_reasons, reference_reasons
from barpc.report.datum import datum_reasons
from barpc.report.measures import measure_run
from barpc.report.measures.block import explanations, left_entries
from barpc.report.measures.views import measure_views
from barpc.report.next_steps import next_steps
from barpc.report.outcome import LEAST_MOVED, Run
from barpc.report.quality_checks import NOISE_LIMIT, is_smooth, view_status
from barpc.report.records import json_form
from barpc.report.results import (
    PRIOR_WIDENED,
    adjusted_lines,
    by_altimetry,
    by_cameras_alone,
    checked_lines,
    common_scale,
    lines_of_earlier,
    matched_lines,
    unmet_places,
)
from barpc.report.summary import LeftOutEntry, Summary
from barpc.report.summary.block import AXES
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import NAMED, counted, enu, median, metres, two_digits

_SHAPE = [MOTIONS.index(name) for name in ("tilt east", "tilt north", "twist", "bend east", "bend north")]
_IMAGE_CHECKED = "The image was checked"
_ALL_WELL = {
    "adjust": ("The image is adjusted", "Both images are adjusted", "All {} images are adjusted"),
    "check": (_IMAGE_CHECKED, "The cameras of both images agree", "The cameras of all {} images agree"),
    "match": (_IMAGE_CHECKED, "Both images are matched", "All {} images are matched"),
}
"""Kind of a run -> its headline for one, two and more images without reservation."""


def summarize(run: Run) -> Summary:
    """Return the summary of a run with the verdict on it; numbers that are not finite are None."""
    views = tuple(replace(view, **view_status(view, run)) for view in measure_views(run))  # type: ignore[arg-type]
    summary = Summary.read(json_form(measure_run(run, views, block_verdict(run, views))))
    return replace(summary, next=next_steps(summary, run.added))


def block_verdict(run: Run, views: Sequence[ViewEntry]) -> dict[str, Any]:
    """Return the verdict: `status`, `passed`, `headline`, `verdict` (sentences), and `reasons`, its reservations.

    The one rule of what passes: `status` is "good" when no image, no control point and no file has a reservation;
    "bad" when an image was not adjusted or a file left out; else "look". All but "good" end with exit code 3.
    """
    bad = [view for view in views if view.status == "failed"]
    look = [view for view in views if view.advice and view.status != "failed"]
    reasons = [view.reservation for view in bad + look]
    reasons += [LeftOutEntry(path, reason).reason_text for path, reason in run.left_out]
    whole, points = [*_block_reasons(run, views)], [*_ground_reasons(run, views)]
    reasons += whole + points
    bands = [*_carried_lines(run)]
    words = {"adjust": adjusted_lines, "check": checked_lines, "match": matched_lines}[run.kind]
    num_bad = len(bad) + len(run.left_out)
    more = "the block needs" if whole else "ground points need" * bool(points)
    return {
        "status": "bad" if num_bad else "look" if reasons else "good",
        "passed": not (num_bad or reasons),
        "headline": _headline(run, len(views), num_bad, len(look), more),
        "verdict": [*words(run, views), *bands, *reasons],
        "reasons": reasons,
    }


def _carried_lines(run: Run) -> Iterator[str]:
    """Yield the images that get the correction of another one of their acquisition."""
    led: dict[str, list[str]] = {}
    for one in run.carried:
        led.setdefault(one.lead, []).append(one.view.name)
    gets = "gets its correction" if run.kind == "adjust" else "was left out"
    for lead, names in led.items():
        yield f"{listed(names)}: of one acquisition with {lead} (the same RPC up to scale and shift), and {gets}."


def _headline(run: Run, num: int, bad: int, look: int, more: str) -> str:
    text, word = _ALL_WELL[run.kind][min(num, 3) - 1].format(num), "adjusted" if run.kind == "adjust" else "usable"
    parts = [f"{bad} {'is' if bad == 1 else 'are'} not {word}"] * bool(bad)
    parts += [f"{look} {'needs' if look == 1 else 'need'} review"] * bool(look)
    if parts:
        text = ", ".join(parts).replace(" ", f" of {counted(num + len(run.left_out), 'image')} ", 1)
    return f"{text}; {more} review." if more else f"{text}."


# --- reservations -----------------------------------------------------------------------------------------


def _block_reasons(run: Run, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield the reservations on the adjustment: priors, noise, the shift of the scene, the DEM."""
    if (found := run.adjustment) is None:
        return
    if len(run.tracks):
        yield from (
            *_of_cameras(run, found),
            *_of_places(run, found, views),
            *_of_same_ground(run, found),
            *_of_solution(run, found),
            *_of_known_heights(found),
        )
    yield from lines_of_earlier(run.added)
    yield from deformation_reasons(found)
    yield from dem_reasons(found)
    yield from datum_reasons(run.datums, found, common_lean(views))


def common_lean(views: Sequence[ViewEntry]) -> float:
    """Return the tangent of the angle from the vertical that the lines of sight of all views have in common.

    The length of the mean of their tangents as vectors by azimuth; views of unknown angles do not count, 0: none.
    """
    angles = np.array([(view.incidence_deg, view.azimuth_deg) for view in views], dtype=np.float64)
    incidence, azimuth = np.radians(angles.reshape(-1, 2)).T
    leans = np.tan(incidence) * np.exp(1j * azimuth)
    known = np.isfinite(leans)
    return float(np.abs(leans[known].sum())) / max(int(known.sum()), 1)


def _of_cameras(run: Run, found: Adjustment) -> Iterator[str]:
    common = common_scale(found)
    if common > PRIOR_WIDENED and any(is_stated(view, found.options) for view in run.views):
        alone, perhaps = by_cameras_alone(run, found), found.prior.perhaps_odd
        first = listed([] if perhaps is None else [found.names[v] for v in np.flatnonzero(perhaps)], NAMED)
        either = " Tie points of two images cannot show which camera is wrong." * (len(run.views) == 2)
        either += f" Errors of {first} alone explain the corrections about as well." * bool(first)
        more = " or more" * bool(np.max(found.prior.scale) > 1.1 * common)
        yield (
            "The corrections are larger than the stated accuracies of the cameras allow. The stated sigmas were "
            f"multiplied by {common:.1f}{more}{', and that of the position with them' * alone}.{either} Check the RPCs "
            f"and the stated accuracies{f', first of {first}' * bool(first)}{', or add GCPs or a DEM' * alone}."
        )
    yield from _of_image_model(run, found)
    if found.apart is not None and not found.apart.clear:
        error = "wrong tie points or " * found.apart.look.as_stated + "an RPC that does not match it"
        yield (
            f"One of the images {listed([found.names[v] for v in found.apart.views])} has {error}: the rest agree "
            "without any one of them. Check the RPCs, or add an image."
        )


def _of_image_model(run: Run, found: Adjustment) -> Iterator[str]:
    """Yield the selection of an affine in the image, and the uncertainty of the scene's shape with it.

    Or that alone, where heights are less certain than the position that `_known_lines` says.
    """
    if found.in_space_rms is None:
        if by_cameras_alone(run, found) and found.gauge.motion_sigma[_SHAPE].max() > found.gauge.sigma[2]:
            yield _shape_sentence(found)
        return
    yield (
        f"Rotations and translations leave {found.in_space_rms:.3f} px at check tie points, an affine transform per "
        f"image {median(found.held_out_rms):.3f} px: the affine is used. This is unusual: check that no image was "
        "resampled, and that each RPC belongs to its image."
    )
    yield _shape_sentence(found)


def _shape_sentence(found: Adjustment) -> str:
    (east, north), (*bends,) = (found.gauge.motion_sigma[part] for part in (_SHAPE[:2], _SHAPE[2:]))
    return (
        f"The scene may be tilted, by {metres(east)} at its eastern and {metres(north)} at its northern edge "
        f"({metres(found.gauge.radius)} out), and bent, by {metres(max(bends))}. Add GCPs or a DEM before using "
        "heights."
    )


def _of_places(run: Run, adjustment: Adjustment, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield the worst region of each image: rejected tie points, common residuals, or large check residuals.

    Regions named by the reservation of their image are left out.
    """
    found = left_entries(adjustment)
    moving = [f"{one.place} of {one.image}" for one in found if one.moving]
    if moving and adjustment.changed > LEAST_MOVED:
        yield (
            f"Most tie points of {listed(moving)} move together: moving objects, or displaced rows. Check for clouds "
            "and water there."
        )
    yield from unmet_places(run, adjustment, views, matter=True)
    rivals = [one.runner_up for one in adjustment.findings if one.motion is not None and one.gap < SURE]
    for rival in filter(None, dict.fromkeys(rivals)):
        yield (
            f"Moving objects explain the tie points that move together hardly better than {TERMS[rival].NOUN}. Check "
            "where these tie points lie."
        )


def _of_same_ground(run: Run, found: Adjustment) -> Iterator[str]:
    """Yield displaced rows of several images that show the same ground: cameras err by their times, not by places."""
    rows = [one for one in explanations(found) if (term := TERMS.get(one.name)) and term.LOCAL and one.axis == AXES[1]]
    for one, other in combinations(rows, 2):
        first, second = (run.number[str(each.image)] for each in (one, other))
        middle = np.array([(0.5 * run.views[first].size[0], row) for row in (one.first, one.last)])
        ground = run.cameras[first].localize(middle, np.full(2, run.altitude))
        low, high = np.sort(run.cameras[second].project(ground)[:, 1])
        common = min(high, other.last) - max(low, other.first)
        if first != second and 2.0 * common > max(high, other.last) - min(low, other.first):
            said = " and ".join(f"{each.first:.0f}-{each.last:.0f} of {each.image}" for each in (one, other))
            yield (
                f"Rows {said} show the same ground: moving objects are likelier than displaced rows in both images. "
                "Check for clouds and water there."
            )


def _of_solution(run: Run, found: Adjustment) -> Iterator[str]:
    for group in found.two_groups:
        i, j = group.views
        if group.apart * group.share > LEAST_MOVED and not any(
            found.prior.odd[v] or is_smooth(v, found) for v in (i, j)
        ):
            yield (
                f"Tie points of {found.names[i]} and {found.names[j]} form two groups, {100 * group.share:.0f} % "
                f"displaced by {group.apart:.2f} px from the others. The solution lies between them: check for a "
                "moving cloud or a repeated pattern, or add an image."
            )
    if found.noise > NOISE_LIMIT:
        yield (
            f"Tie points scatter {found.noise:.1f} times as much as stated: wrong matches, or camera errors beyond the "
            "model. Check for repeated patterns, or supply matches (--matches)."
        )
    with np.errstate(all="ignore"):
        moved = np.abs(found.gauge.shift) / found.gauge.delivered_sigma
    # control, an earlier run and fixed views move it as far as they must, a DEM and altimetry in height
    used = found.control is not None and bool(found.control.used.any())
    held = used or bool(found.reference_inlier.any()) or bool(found.options.fixed or run.known)
    by_heights = by_altimetry(found) or (found.terrain is not None and found.terrain.shows and found.terrain.held > 0)
    moved = moved[:2] if by_heights else moved
    stated = by_heights or any(is_stated(view, found.options) for view in run.views)
    if stated and not held and (moved[np.isfinite(moved)] > SURELY).any():
        which = "check that the heights are of this place, or add GCPs" if by_heights else "add GCPs or a DEM"
        yield (
            f"The scene moved by {enu(found.gauge.shift)}, more than {SURELY:g} times the standard deviation expected "
            f"from the stated accuracies. One of them is wrong: {which}."
        )


def _of_known_heights(found: Adjustment) -> Iterator[str]:
    """Yield a displacement that a pair does not show along its epipolar lines, and the DEM does."""
    if found.unseen is not None and (one := found.unseen.shown) is not None:
        axis = AXES[one.axis]
        yield (
            f"Heights behind {axis.removesuffix('s')} {one.edge:.0f} of {found.names[one.view]} are off the DEM's by "
            f"{metres(one.metres)}, as if these {axis} were displaced by {one.pixels:.1f} px along the epipolar "
            "lines, which two images do not show: add an image or GCPs."
        )


def _ground_reasons(run: Run, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield reservations on ground points, their files, the reference and altimetry."""
    adjustment, gcps = run.adjustment, run.gcps
    if adjustment is not None:
        yield from reference_reasons(run, adjustment.options.dem_sigma)
        if (heights := adjustment.altimetry) is not None:
            counts = f"{heights.agree} of {heights.near} on the tie points' surface agree, of {heights.given} given"
            check = f"({counts}). Check its positions and vertical datum, or leave it out."
            if heights.why_not:
                yield f"The altimetry was not used: {heights.why_not} {check}"
            elif heights.spread > max(NOISE_LIMIT * heights.expected, median([view.gsd_m for view in views])):
                ratio = two_digits(heights.spread / heights.expected)
                yield f"The altimetry scatters about the surface by {ratio} times what is expected {check}"
        if gcps is not None and adjustment.control is not None:
            yield from control_reasons(gcps.names, adjustment.control)
    for points in (gcps, run.check_points):
        yield from (f"{line}." for line in (() if points is None else points.left_out))
