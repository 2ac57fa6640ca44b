"""Reservations on an image or the scene, with their figures; sentences on control, reference and DEM."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.control.snooping import ControlTest
from barpc.ba.parameters.priors import is_stated
from barpc.ba.select.foreign_camera import ForeignCamera
from barpc.base.errors import listed
from barpc.base.geodesy import Array
from barpc.base.statistics import SURE, SURELY
from barpc.report.measures.block import left_entries, matters, strangeness
from barpc.report.outcome import LEAST_MOVED, MANY_REJECTED, WHOLE_PIXELS, Run
from barpc.report.ranking import GOOD_RMSE, SMOOTH_LEFT
from barpc.report.summary.block import AXES, LeftEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import CAUSES, NAMED, counted, enu, known, metres, two_digits
from barpc.scene import GroundPoints
from barpc.sensor.geometry import Several
from barpc.sensor.image_corrections import Splined
from barpc.sensor.rpc import RPC
from barpc.tie.reference import FAR_RADIUS, PEAK

MIN_TIE_POINTS = 30  # Of a view, used or rejected: they tell a standard deviation to an eighth, 1 / sqrt(2 n)
ENOUGH_GCPS = 3  # Control points that constrain a view without any tie point
WORST_LEFT = 0.15  # px: a larger misfit of one RPC anywhere needs review
NOISE_LIMIT = 2.5  # Scatter of tie points over the accuracy that the matcher states: more needs review

_PARALLEL = 0.05  # sine of the angle between lines and axis under which a part across tells nothing of that along
_WHOLE_IMAGE = 0.9  # share of the rows or columns that is the whole image
_CONTROL_WORDS = {
    "rejected": ("{} rejected, as the others contradict {}", "Check coordinates, axes and image positions"),
    "contradicts": ("{} used, with residuals above 4 standard deviations", "Check coordinates and stated accuracies"),
}

_CHECK_DEM = "Check its heights, their datum, and the cameras."

PASSED_STATUS = {"adjust": "adjusted", "check": "consistent", "match": "tied"}
"""Kind of a run -> the status of a view without reservation."""

Causes = Iterator[tuple[str, Mapping[str, object]]]
"""Causes that apply, with their figures."""


def view_status(view: ViewEntry, run: Run) -> dict[str, str | None]:
    """Return the verdict on a view: `status`, `advice` (empty without reservation) and `cause`."""
    for cause, figures in _reservations(view, run):  # the first that holds is the reason
        return {"status": CAUSES[cause].status, "advice": CAUSES[cause].advice(**figures), "cause": cause}
    return {"status": PASSED_STATUS[run.kind], "advice": "", "cause": None}


def _reservations(view: ViewEntry, run: Run) -> Causes:
    adjustment = run.adjustment
    if adjustment is not None:
        yield from _failed(view, run, adjustment)
    if run.kind == "match":  # cameras are not judged
        yield from _weakly_tied(view, run)
        return
    for doubt in run.sources[run.number[view.name]].doubts if run.sources else ():
        yield "other_pixels", {"doubt": doubt.sentence}
    yield from _weakly_tied(view, run)
    if view.name in run.copies:
        yield "copy", {"other": run.copies[view.name]}
    if adjustment is not None:
        yield from _of_camera(view, run, adjustment)
        yield from _of_tie_points(view, run, adjustment)
        for part in unseen_parts(run, run.number[view.name]):
            yield "along_lines", {"place": part.place, "metres": metres(part.metres)}
        yield from _beyond_one_rpc(view, run)
    error = known(view.rmse_after if run.kind == "adjust" else view.rmse_before)
    if view.num_observations and not error <= GOOD_RMSE:
        disagrees = "disagrees" if run.kind == "check" else "left"
        yield disagrees if np.isfinite(error) else "unseen", {"error": error}
    moving = view.num_moving / max(view.num_moving + view.num_rejected + view.num_observations, 1)
    if adjustment is not None and moving > MANY_REJECTED and adjustment.changed > LEAST_MOVED:
        yield "moving_objects", {"share": 100 * moving}
    if adjustment is not None:
        yield from _poorly_fitted_parts(view, adjustment)


def _poorly_fitted_parts(view: ViewEntry, adjustment: Adjustment) -> Causes:
    """Yield the rows and columns that are inconsistent with the rest of a view."""
    for one in left_entries(adjustment):
        if one.image == view.name and matters(one) and (what := inconsistency(one)):
            place, cause = one.place, "clouds, water, change there"
            if one.axis == AXES[0] and one.rejected <= MANY_REJECTED:  # nothing on the ground is as long as the pass
                place, cause = f"{place}, over all rows", "detectors or resampling"
            yield "place", {"place": place, "what": what, "cause": cause}


def _weakly_tied(view: ViewEntry, run: Run) -> Causes:
    """Yield few tie points, tie points at whole pixels, and detailed parts of a view with few tie points."""
    by_reference = run.reference is not None and any(v.points and v.name == view.name for v in run.reference.views)
    controlled = by_reference or view.num_gcps >= ENOUGH_GCPS
    held = view.name in run.known  # by an earlier run: it needs no tie points of its own
    if view.num_observations < MIN_TIE_POINTS and not controlled and not held:
        what = "few" if view.num_observations else "few_gcps" if view.num_gcps else "none"
        yield what, {"few": view.num_observations, "gcps": counted(view.num_gcps, "GCP")}
    if view.name in run.whole_pixels and run.kind != "match" and not controlled:
        yield "whole_pixels", {"shared": WHOLE_PIXELS}
    if (gap := run.gaps.get(run.number[view.name])) is not None:
        place = f"{AXES[gap.axis]} {gap.first:.0f}-{gap.last:.0f}"
        yield "gap", {"place": place, "found": gap.found, "due": gap.expected}


def _failed(view: ViewEntry, run: Run, adjustment: Adjustment) -> Causes:
    """Yield the reasons why an image was not adjusted, or the rejection of most of its tie points."""
    apart = _foreign_camera_of(view, run)
    if view.name in adjustment.left_out:
        tried = sum(view.name in report.names for report in run.matched)
        words = f" ({tried} pair{'s' * (tried > 1)} with it tried)" if tried else ""
        yield "no_overlap" if run.matched and not tried else "untied", {"tried": words}
    if apart is not None and apart.placed is None:
        yield "contradicts_all" if apart.look.as_stated else "other_rpc", {"strangeness": strangeness(apart)}
    tolerance = run.options.fit.tolerance
    # grids represent the camera where the RPC does not
    beyond = _follows_more(view, run) or run.options.grids
    if view.fit is not None and not beyond and not all(known(v) <= tolerance for v in view.fit.max_px):
        yield "one_rpc_misses", {"tolerance": tolerance}
    # where most contradict the others these are right by majority, and all over it: not as wrong matches do
    many = run.kind == "adjust" and view.num_rejected >= max(MIN_TIE_POINTS, view.num_observations + 1)
    if many and apart is None and not anywhere(view, run) and not _most_in(view, adjustment):
        yield "contradicted", {"share": 100 * view.lost}


def _of_camera(view: ViewEntry, run: Run, adjustment: Adjustment) -> Causes:
    """Yield a foreign camera, an RPC less accurate than stated, and systematic residuals."""
    i, prior, smooth = run.number[view.name], adjustment.prior, adjustment.smooth
    if (apart := _foreign_camera_of(view, run)) is not None:
        stated = (
            f"is {apart.scale:.0f} times less accurate than stated" if apart.scale > 1.0 else "does not match the image"
        )
        yield "foreign_camera", {"stated": stated, "strangeness": strangeness(apart)}
    if prior.odd[i] and is_stated(run.views[i], adjustment.options):
        others = [adjustment.names[j] for j in np.flatnonzero(prior.odd) if j != i]
        either = f" (or that of {listed(others)}: undetermined by tie points)" if others else ""
        yield "odd", {"scale": prior.scale[i], "either": either}
    if is_smooth(i, adjustment):
        along = "along the rows" if smooth.by_row[i] > 0.5 else "over the image"
        yield "systematic", {"size": smooth.of_cameras()[i], "along": along, "why": _why_smooth(adjustment)}


def is_smooth(i: int, adjustment: Adjustment) -> bool:
    """Return whether view i has systematic residuals that no correction models."""
    smooth = adjustment.smooth
    return bool(smooth.found(SMOOTH_LEFT)[i] or smooth.shared[i] > SMOOTH_LEFT)


def _why_smooth(adjustment: Adjustment) -> str:
    if adjustment.options.drift == 0:
        return "drift was disabled (--drift 0)"
    why = "attitude jitter, optics or detector steps, which one RPC cannot represent, or correlated matching errors"
    if not adjustment.reference_inlier.any():
        return why
    if adjustment.terrain is not None and not adjustment.terrain.is_known:
        return f"heights of the DEM without --geoid, or {why}"
    return f"{why}, or distortions of the reference or of the heights under it"


def _of_tie_points(view: ViewEntry, run: Run, adjustment: Adjustment) -> Causes:
    """Yield reservations by rejected and check tie points: those in use were selected to agree."""
    i, many, in_any = run.number[view.name], view.lost > MANY_REJECTED, anywhere(view, run)
    if many and not in_any:
        yield "rejected", {"share": 100 * view.lost, "place": _most_in(view, adjustment)}
    noise, error = adjustment.held_out_noise[i], adjustment.held_out_rms[i]
    if noise > NOISE_LIMIT:
        cause = "wrong_matches" if many and in_any else "beside" if i in run.beside else "held_out"
        other = adjustment.names[run.beside[i]] if i in run.beside else ""
        yield cause, {"share": 100 * view.lost, "error": error, "noise": noise, "other": other}


def inconsistency(one: LeftEntry) -> str:
    """Return the error of a region's tie points in words; empty where it is too small to need review."""
    if one.moving:
        return ""
    if one.rejected > MANY_REJECTED:
        far = two_digits(one.rejected_median_px)
        return (
            f"{100 * one.rejected:.0f} % of the tie points disagree with the rest of the image, typically by {far} px"
        )
    return f"the tie points share a residual of {one.off_px:.2f} px" if one.off_px > SMOOTH_LEFT else ""


def _most_in(view: ViewEntry, adjustment: Adjustment) -> str:
    """Return the region with most of a view's rejected tie points in words; empty without one."""
    for one in left_entries(adjustment):
        if one.image == view.name and one.rejected > MANY_REJECTED and not one.moving:
            whole = one.last - one.first > _WHOLE_IMAGE * view.size[AXES.index(one.axis)]
            far = f"typically by {two_digits(one.rejected_median_px)} px"
            return f", {far}" if whole else f"; most in {one.place} ({100 * one.rejected:.0f} %, {far})"
    return ""


def _beyond_one_rpc(view: ViewEntry, run: Run) -> Causes:
    """Yield the misfit of one RPC to a camera with corrections for jitter or detector steps."""
    if view.fit is None or view.correction is None or run.options.grids or not _follows_more(view, run):
        return
    left, most = float(np.linalg.norm([known(v) for v in view.fit.rmse_px])), max(map(known, view.fit.max_px))
    follows = "attitude jitter or detector steps"
    if view.correction.step_px:
        follows = "displaced rows or columns"
    elif view.correction.sinusoid_px:
        follows = "a sinusoidal motion of its rows"
    elif not isinstance(run.views[run.number[view.name]].sensor, RPC):
        follows = "the orbit and attitude of its physical model"
    if left > SMOOTH_LEFT or most > WORST_LEFT:
        yield "follows_more", {"follows": follows, "left": left, "most": most, "image": view.name}


def anywhere(view: ViewEntry, run: Run) -> bool:
    """Return whether rejected tie points of a view have errors in random directions, typical of mismatches."""
    return run.adjustment is not None and bool(-np.inf < run.adjustment.alike[run.number[view.name]] <= SURE)


def _foreign_camera_of(view: ViewEntry, run: Run) -> ForeignCamera | None:
    """Return the foreign-camera diagnosis of a view; None without one."""
    apart = None if run.adjustment is None else run.adjustment.apart
    return apart if apart is not None and apart.is_view(run.number[view.name]) else None


def _follows_more(view: ViewEntry, run: Run) -> bool:
    """Return whether a camera is more than one RPC represents: physical, or corrected beyond rotation and shift."""
    one = view.correction
    physical = not isinstance(run.views[run.number[view.name]].sensor, RPC)
    return one is not None and any((physical, one.jitter_px, one.detector_px, one.step_px, one.sinusoid_px))


# --- heights behind a displaced part -----------------------------------------------------------------------

# Two images show a displacement across their epipolar lines and none along them: there the points of the part move up
# or down with it. Rows that are displaced as a whole (a clock that jumps) are displaced along the rows' axis; the part
# along the lines then follows from that across them. A whole number of lines is taken for lost and held
# (`barpc.ba.select.image_terms.with_lines_lost`).


@dataclass(frozen=True)
class UnseenPart:
    """Rows or columns of an image, and by how much their heights may be off [m]."""

    place: str
    metres: float


def unseen_parts(run: Run, i: int) -> Iterator[UnseenPart]:
    """Yield the displaced parts of view i of which no image shows the displacement along the epipolar lines."""
    adjustment = run.adjustment
    assert adjustment is not None
    if not any(one.view == i and one.where is not None for one in adjustment.findings):
        return
    unknowns, camera = adjustment.cameras.unknowns, adjustment.sensors[i]
    waves = unknowns.waves
    if waves is None or not isinstance(camera, Splined):
        return
    of_parts = waves.kinds[2]
    count = (of_parts.stop - of_parts.start) // 2
    first = unknowns.in_waves.start + of_parts.start
    moved = adjustment.params[i, first : first + 2 * count].reshape(2, count)
    for n in np.flatnonzero(np.isfinite(waves.steps[i, :, 1])).tolist():
        own = first + np.array([n, count + n])
        variance, axes = np.linalg.eigh(adjustment.covariance.view(i)[np.ix_(own, own)])
        if not np.sqrt(variance[1]) > max(LEAST_MOVED, 2.0 * np.sqrt(max(variance[0], 0.0))):
            continue  # seen from several sides
        axis, start, stop = int(waves.steps[i, n, 0]), *waves.steps[i, n, 1:3]
        along, across = axes[:, 1], axes[:, 0]
        if not abs(across[axis]) > _PARALLEL:
            continue
        displaced = float(moved[:, n] @ across / across[axis])  # along the axis, were that all of it
        metres = abs(displaced * along[axis]) * _metres_a_pixel(run, i, along)
        low, high = max(start, 0.0), min(stop, run.views[i].size[axis] - 1.0)
        if abs(displaced * along[axis]) > LEAST_MOVED and np.isfinite(metres):
            yield UnseenPart(f"{AXES[axis]} {low:.0f}-{high:.0f}", metres)


def _metres_a_pixel(run: Run, i: int, along: Array) -> float:
    """Return by how much a point's height changes [m] where view i moves by a pixel along a direction (2,).

    By the view that shares most of its tie points: the point stays on that one's ray.
    """
    shared = {ties.views: len(ties.a) for ties in run.pairs if i in ties.views}
    if not shared:
        return float("nan")
    views = max(shared, key=lambda pair: shared[pair])
    other = views[1 - views.index(i)]
    points = np.unique(run.tracks.point[(run.tracks.view == other) & run.keep])
    ground = run.ground[points]
    ground = ground[np.isfinite(ground).all(axis=1)]
    ray = Several(run.cameras, np.full(len(ground), other))
    higher = ray.localize(ray.project(ground), ground[:, 2] + 1.0)
    seen = Several(run.cameras, np.full(len(ground), i))
    rate = np.nanmedian((seen.project(higher) - seen.project(ground)) @ along)
    return float(1.0 / abs(rate)) if abs(rate) > 0.0 else float("nan")


# --- constraints of the scene: control, reference, DEM -----------------------------------------------------


def held_lines(tested: ControlTest | None, gcps: GroundPoints, views: Sequence[ViewEntry], known: str) -> Iterator[str]:
    """Yield the effect of ground control; `known`: the uncertainty of the scene's position, as a clause."""
    is_seen = np.bincount(gcps.point, minlength=len(gcps.names)) > 0
    held = int(np.count_nonzero(is_seen if tested is None else is_seen & tested.used))
    with_points = f"With {counted(held, 'GCP')}" if held else "Without ground control"
    scale = 1.0 if tested is None or tested.agreed is None else tested.agreed.scale
    if tested is None or tested.agrees:
        yield f"{with_points}, {known}."
    elif not held:
        yield f"Without consistent ground control, {known}."
    elif scale > 1.0:
        yield f"{with_points}, {scale:.0f} times less accurate than stated, {known}."
    else:
        yield f"The {counted(held, 'GCP')} in use do not agree: the uncertainty of the scene's position is unknown."
    # rejected ones have checked them
    if held == is_seen.sum() > 0 and tested is not None and tested.agrees and not tested.checked:
        yield f"Nothing checks {'it' if held == 1 else 'them'}: an error in a GCP would not show."
    alone = np.unique(gcps.view)
    if held and len(alone) == 1 and len(views) > 1:
        yield f"Only {views[alone[0]].name} shows GCPs: they do not constrain the scene along its lines of sight."


def reference_lines(run: Run) -> Iterator[str]:
    """Yield the matches with a reference and the offsets of the delivered cameras."""
    found = run.reference
    if found is None or found.control is None:
        return
    if matched := [view for view in found.views if view.points]:
        used, tried = sum(view.points for view in matched), sum(view.tried for view in matched)
        off = listed([f"{np.hypot(*view.offset):.1f} m ({view.name})" for view in matched], NAMED)
        pixels = found.step / max(view.gsd for view in matched)
        yield (
            f"The reference was matched at {used} of {counted(tried, 'point')} in {counted(len(matched), 'image')}, to "
            f"{metres(found.step)}" + f" ({pixels:.2g} px)" * bool(np.isfinite(pixels)) + "."
        )
        yield f"By the reference, the delivered cameras are off by {off}."
    if rest := listed([view.name for view in found.views if not view.points]):
        yield f"No point of the reference was matched in {rest}."


def control_reasons(names: Sequence[str], tested: ControlTest) -> Iterator[str]:
    """Yield the reservations on ground control."""
    status = [tested.status(g) for g in range(len(names))]
    for word, (words, cure) in () if tested.torn else _CONTROL_WORDS.items():
        wrong = [
            f"{names[g]} ({enu(tested.residual[g])}, w = {tested.w[g]:.1f})"
            if np.isfinite(tested.w[g])
            else f"{names[g]} (in too few images to determine its error)"
            for g in range(len(names))
            if status[g] == word
        ]
        if wrong:
            alike = word == "rejected" and tested.agreed is not None and tested.agreed.alike
            datum = " They agree with each other: check their datum and heights, too." * alike
            start = words.format(counted(len(wrong), "GCP"), "it" if len(wrong) == 1 else "them")
            sign = ", predicted minus given" * any(", w = " in one for one in wrong)
            yield f"{start}: {listed(wrong)}{sign}. {cure}.{datum}"
    if tested.sets:
        one, other = (listed([names[g] for g in np.flatnonzero(points).tolist()], NAMED) for points in tested.sets)
        middle = [tested.residual[points & np.isfinite(tested.w)] for points in tested.sets]
        apart = ""
        if all(len(residual) for residual in middle):
            apart = f" (predicted minus given differs by {enu(middle[0].mean(axis=0) - middle[1].mean(axis=0))})"
        yield (
            f"GCPs contradict each other, {one} against {other}{apart}, and none was used. Check coordinates, axes, "
            "datum and image positions, or add a point."
        )
    if tested.torn:
        without, held = tested.torn
        yield (
            f"With the GCPs the images would agree less: the RMS of check tie points rises from {without:.3f} to "
            f"{held:.3f} px. None was used. Check coordinates, image positions and stated accuracies."
        )
    if not tested.fits and "contradicts" not in status:
        yield (
            f"{counted(int(tested.used.sum()), 'GCP')} scatter {tested.scatter:.1f} times as much as stated. Check "
            "their coordinates and stated accuracies."
        )


def reference_reasons(run: Run, stated: float) -> Iterator[str]:
    """Yield reservations on the reference: refused, distorted, or on heights less accurate than `stated` [m]."""
    found = run.reference
    if found is None:
        return
    if found.control is None:
        whys = "check the place of the DEM under it, or give a newer or finer one"
        if all(view.peak < PEAK for view in found.views):
            whys = f"check its place and that cameras are not more than {FAR_RADIUS / 1e3:g} km off, or give another"
        yield f"The reference {found.refusal} and was not used: {whys}."
    used = [view for view in found.views if view.points]
    if wide := [f"{view.name} ({metres(view.scatter)})" for view in used if view.scatter > found.step]:
        yield (
            f"Points of the reference scatter across the lines of sight by more than the resolution of "
            f"its matches, {metres(found.step)}, in {listed(wide, NAMED)}. Check it for distortions, and the images."
        )
    if wrong := [view for view in used if view.shows_heights(stated)]:
        named = listed([f"{metres(view.along)} in {view.name}" for view in wrong], NAMED)
        yield (
            f"The heights of the DEM under the reference are less accurate than stated: points scatter along the "
            f"lines of sight by {named}, as with height errors of {metres(max(view.heights for view in wrong))} "
            f"({metres(stated)} stated). Check the DEM: an error common to all heights would shift the scene unseen."
        )


def dem_lines(adjustment: Adjustment) -> Iterator[str]:
    """Yield the heights that the DEM constrains, their assumed errors and their offset."""
    terrain, options = adjustment.terrain, adjustment.options
    if terrain is None or not terrain.shows:
        return
    by_reference = bool(adjustment.reference_inlier.any())  # which stands on it: no tie point does
    if not terrain.total:
        yield from ["The DEM constrains nothing: there are no tie points."] * (not by_reference)
        return
    held = f"DEM heights constrain {terrain.held} of {counted(terrain.total, 'used tie point')}"
    covers = f"; the DEM covers {100 * terrain.known / terrain.total:.0f} %" if terrain.known < terrain.total else ""
    if not terrain.held:
        yield f"{held}: the DEM has no height where one is needed{covers}."
        return
    yield f"{held}{covers}."
    single = metres(terrain.sigma if np.isfinite(terrain.sigma) else options.dem_sigma)
    measured = ""
    if terrain.known:
        lie = f"the tie points lie {metres(abs(terrain.offset))} {'above' if terrain.offset > 0 else 'below'} it"
        measured = f"; measured: {lie} (median; scatter {metres(terrain.spread)})"
    yield f"DEM accuracy assumed: {metres(terrain.bias)} shared by all points, {single} each{measured}."
    if np.isfinite(terrain.sigma) and terrain.alike >= 1.05:
        yield f"DEM errors are correlated: {terrain.alike:.1f} points count as one."


CONTROL_WORDS = {"dem": "the DEM", "gcps": "the GCPs", "reference": "the reference"}
"""Kind of control -> its words in a sentence."""


def deformation_reasons(adjustment: Adjustment) -> Iterator[str]:
    """Yield the reservation on control that asks for another shape of an image than tie points do."""
    if (one := adjustment.deformed) is not None:
        control = listed([CONTROL_WORDS[kind] for kind in one.control])
        yield (
            f"To follow {control}, {adjustment.names[one.view]} would be deformed by {one.px:.1f} px at its corners, "
            f"{one.sigmas:.0f} times the standard deviation of its camera. Tie points do not ask for that, so it was "
            f"not. Check {control}."
        )


def dem_reasons(adjustment: Adjustment) -> Iterator[str]:
    """Yield reservations on the DEM: another terrain, or a contradiction to the delivered cameras."""
    terrain = adjustment.terrain
    if terrain is None:
        return
    if not terrain.shows:
        yield (
            f"The DEM was not used: its relief is {terrain.relief:.2g} times that of the tie points. Check its place, "
            "units and heights, and for camera errors larger than its hills."
        )
        return
    if not terrain.agrees:
        times = round(terrain.relief, 2) + 0.0
        yield (
            f"The DEM has {times:g} times the relief of the adjusted tie points: of another terrain, water, or filled "
            "or smoothed heights. Leave it out, or give another."
        )
    (level, *rises), (off, *tilts) = terrain.beyond, terrain.delivered
    if level > SURELY:
        yield (
            f"The DEM is {abs(off):.1f} m {'below' if off > 0 else 'above'} the tie points of the delivered cameras, "
            f"{level:.1f} times the standard deviation of that difference. {_CHECK_DEM}"
        )
    sides = zip(tilts, rises, ("east", "north"), strict=True)
    if tilted := [f"{abs(tilt):.1f} m to the {side}" for tilt, times, side in sides if times > SURELY]:
        yield (
            f"The DEM is tilted against the tie points of the delivered cameras, by {' and '.join(tilted)} at its "
            f"edge, more than {SURELY:g} times the standard deviation of that tilt. {_CHECK_DEM}"
        )


def lengths(values: Iterable[float]) -> str:
    """Return lengths in readable units."""
    return ", ".join(map(metres, values))
