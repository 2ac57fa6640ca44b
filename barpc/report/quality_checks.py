"""What keeps an image or the scene from being good, with its figures, and what holds the scene, in words."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.apart import ForeignCamera
from barpc.ba.judging.snooping import ControlTest
from barpc.base.errors import listed
from barpc.base.geodesy import Array
from barpc.base.statistics import FEW, SURE, SURELY
from barpc.report.outcome import MANY_REJECTED, SMOOTH_LEFT, WHOLE_PIXELS, Run
from barpc.report.summary.block import AXES, LeftEntry, left_entries, strangeness
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import CAUSES, NAMED, counted, known, metres
from barpc.scene import GroundPoints
from barpc.sensor.rpc import RPC
from barpc.tie.reference import PEAK

GOOD_RMSE = 0.5  # A view whose tie points are left with more than this [px] is called doubtful
ENOUGH_GCPS = 3  # Control points that hold a view without any tie point
WORST_LEFT = 0.15  # px: an image with more anywhere is called doubtful
NOISE_LIMIT = 2.5  # Tie points that scatter by more than so many times what the matcher states need a look

_CONTROL_WORDS = {
    "rejected": "{} rejected, contradicted by the rest: check coordinates, axes and image positions",
    "contradicts": "{} off by more than 4 standard deviations, used all the same: the stated accuracies are too good, "
    "or more than one is wrong",
}

PASSED_STATUS = {"adjust": "adjusted", "check": "consistent", "match": "tied"}
"""Kind of a run -> the status of a view without reservation."""

Causes = Iterator[tuple[str, Mapping[str, object]]]
"""Causes that hold, with their figures."""


def view_status(view: ViewEntry, run: Run) -> dict[str, str | None]:
    """Return the verdict on a view: a word of `STATUS_WORDS`, what to do (empty when all is well), and the cause."""
    for cause, figures in _reservations(view, run):  # the first that holds is the reason
        return {"status": CAUSES[cause].status, "advice": CAUSES[cause].advice(**figures), "cause": cause}
    return {"status": PASSED_STATUS[run.kind], "advice": "", "cause": None}


def _reservations(view: ViewEntry, run: Run) -> Causes:
    adjustment = run.adjustment
    if adjustment is not None:
        yield from _failed(view, run, adjustment)
    yield from _weakly_tied(view, run)
    if run.kind == "match":  # how well cameras agree is not what was asked
        return
    if view.name in run.copies:
        yield "copy", {"other": run.copies[view.name]}
    if adjustment is not None:
        yield from _of_camera(view, run, adjustment)
        yield from _of_tie_points(view, run, adjustment)
        yield from _beyond_one_rpc(view, run)
    error = known(view.rmse_after if run.kind == "adjust" else view.rmse_before)
    if view.num_observations and not error <= GOOD_RMSE:
        disagrees = "disagrees" if run.kind == "check" else "left"
        yield disagrees if np.isfinite(error) else "unseen", {"error": error}
    moving = view.num_moving / max(view.num_moving + view.num_rejected + view.num_observations, 1)
    if moving > MANY_REJECTED:
        yield "moving", {"share": 100 * moving}
    if adjustment is not None:
        yield from _poorly_fitted_parts(view, adjustment)


def _poorly_fitted_parts(view: ViewEntry, adjustment: Adjustment) -> Causes:
    """Return what rows and columns say that stand out."""
    for one in left_entries(adjustment):
        if one.image == view.name and (what := stands_out(one)):
            place, cause = f"{one.axis} {one.first:.0f}-{one.last:.0f}", "clouds, water, change there"
            if one.axis == AXES[0] and one.rejected <= MANY_REJECTED:  # nothing on the ground is as long as the pass
                place, cause = f"{place}, over all rows,", "detectors or resampling"
            yield "place", {"place": place, "what": what, "cause": cause}


def _weakly_tied(view: ViewEntry, run: Run) -> Causes:
    """Say that a view has few tie points, some that may all be off alike, or a part without where there is detail."""
    by_reference = run.reference is not None and any(v.points and v.name == view.name for v in run.reference.views)
    controlled = by_reference or view.num_gcps >= ENOUGH_GCPS
    held = view.name in run.known  # by an earlier run: it needs no tie points of its own
    if view.num_observations < FEW and not controlled and not held:
        gcps = f"{view.num_gcps} GCP{'s' * (view.num_gcps > 1)}"
        what = "few" if view.num_observations else "few_gcps" if view.num_gcps else "none"
        yield what, {"few": view.num_observations, "gcps": gcps}
    if view.name in run.whole_pixels and run.kind != "match" and not controlled:
        yield "whole_pixels", {"shared": WHOLE_PIXELS}
    if (gap := run.gaps.get(run.number[view.name])) is not None:
        place = f"{AXES[gap.axis]} {gap.first:.0f}-{gap.last:.0f}"
        yield "gap", {"place": place, "found": gap.found, "due": gap.expected}


def _failed(view: ViewEntry, run: Run, adjustment: Adjustment) -> Causes:
    """Say why an image was not adjusted, or that most of its tie points contradict the others."""
    apart = _foreign_camera_of(view, run)
    if view.name in adjustment.left_out:
        tried = sum(view.name in report.names for report in run.matched)
        words = f" ({tried} pair{'s' * (tried > 1)} with it tried)" if tried else ""
        yield "no_overlap" if run.matched and not tried else "untied", {"tried": words}
    if apart is not None and apart.placed is None:
        yield "contradicts_all" if apart.look.as_stated else "other_rpc", {"strangeness": strangeness(apart)}
    tolerance = getattr(getattr(run.options, "fit", None), "tolerance", np.inf)
    # grids hold what the RPC does not
    beyond = _follows_more(view, run) or getattr(run.options, "grids", False)
    if view.fit is not None and not beyond and not all(known(v) <= tolerance for v in view.fit.max_px):
        yield "one_rpc_misses", {"tolerance": tolerance}
    # where most contradict the others these are right by majority, and all over it: not as wrong matches do
    many = run.kind == "adjust" and view.num_rejected >= max(FEW, view.num_observations + 1)
    if many and apart is None and not anywhere(view, run) and not _most_in(view, adjustment):
        yield "contradicted", {"share": 100 * view.lost}


def _of_camera(view: ViewEntry, run: Run, adjustment: Adjustment) -> Causes:
    """Say that an RPC is not an image's own, is farther off than stated, or that no correction follows what is left."""
    i, prior, smooth = run.number[view.name], adjustment.prior, adjustment.smooth
    if (apart := _foreign_camera_of(view, run)) is not None:
        stated = f"{apart.scale:.0f} times farther off than stated" if apart.scale > 1.0 else "not its own"
        yield "apart", {"stated": stated, "strangeness": strangeness(apart)}
    if prior.odd[i]:
        others = [adjustment.names[j] for j in np.flatnonzero(prior.odd) if j != i]
        either = f" (or that of {listed(others)}: the tie points cannot tell)" if others else ""
        yield "odd", {"scale": prior.scale[i], "either": either}
    if is_smooth(i, adjustment):
        along = "along the rows" if smooth.by_row[i] > 0.5 else "over the image"
        yield "smooth", {"size": smooth.of_cameras()[i], "along": along, "why": _why_smooth(adjustment)}


def is_smooth(i: int, adjustment: Adjustment) -> bool:
    """Return whether something smooth is left of view i that no correction follows."""
    smooth = adjustment.smooth
    return bool(smooth.found(SMOOTH_LEFT)[i] or smooth.shared[i] > SMOOTH_LEFT)


def _why_smooth(adjustment: Adjustment) -> str:
    if adjustment.options.drift == 0:
        return "a drift was not allowed (--drift 0)"
    why = "attitude jitter, optics, steps between detectors, which one RPC does not follow, or matches that err alike"
    if not adjustment.reference_inlier.any():
        return why
    if adjustment.terrain is not None and not adjustment.terrain.is_known:
        return f"the heights of the DEM (no --geoid), or {why}"
    return f"{why}; or the reference bends, or the heights under it do"


def _of_tie_points(view: ViewEntry, run: Run, adjustment: Adjustment) -> Causes:
    """Return what tie points say that were rejected, or took no part: the others were chosen to agree."""
    i, many, in_any = run.number[view.name], view.lost > MANY_REJECTED, anywhere(view, run)
    if many and not in_any:
        yield "rejected", {"share": 100 * view.lost, "place": _most_in(view, adjustment)}
    noise, error = adjustment.held_out_noise[i], adjustment.held_out_rms[i]
    if noise > NOISE_LIMIT:
        cause = "wrong_matches" if many and in_any else "beside" if i in run.beside else "held_out"
        other = adjustment.names[run.beside[i]] if i in run.beside else ""
        yield cause, {"share": 100 * view.lost, "error": error, "noise": noise, "other": other}


def stands_out(one: LeftEntry) -> str:
    """Return what is wrong in rows or columns that stand out; empty where it is not so much as to need a look."""
    if one.moving:
        return ""
    if one.rejected > MANY_REJECTED:
        return (
            f"{100 * one.rejected:.0f} % of their tie points contradict the others, half of these by more than "
            f"{one.apart_px:.2f} px"
        )
    return f"their tie points are left with {one.off_px:.2f} px in common" if one.off_px > SMOOTH_LEFT else ""


def _most_in(view: ViewEntry, adjustment: Adjustment) -> str:
    """Return where most of a view's rejected tie points are, if the adjustment found them to stand out somewhere."""
    for one in left_entries(adjustment):
        if one.image == view.name and one.rejected > MANY_REJECTED and not one.moving:
            place = f"{one.axis} {one.first:.0f}-{one.last:.0f}"
            return (
                f"; most in {place}, where {100 * one.rejected:.0f} % were, half of these by more than "
                f"{one.apart_px:.2f} px"
            )
    return ""


def _beyond_one_rpc(view: ViewEntry, run: Run) -> Causes:
    """Return what one RPC does not hold of a camera that jitter or steps between detectors are corrected in."""
    told = any(getattr(run.options, name, None) for name in ("grids", "tiles", "resample"))
    if view.fit is None or view.correction is None or told or not _follows_more(view, run):
        return
    left, most = float(np.linalg.norm([known(v) for v in view.fit.rmse_px])), max(map(known, view.fit.max_px))
    follows = "attitude jitter or steps between detectors"
    if view.correction.strip_px:
        follows = "rows or columns that lie off by themselves"
    elif view.correction.swing_px:
        follows = "a swing of its rows"
    elif not isinstance(run.views[run.number[view.name]].sensor, RPC):
        follows = "its own orbit and attitude"
    if left > SMOOTH_LEFT or most > WORST_LEFT:
        yield "follows_more", {"follows": follows, "left": left, "most": most, "image": view.name}


def anywhere(view: ViewEntry, run: Run) -> bool:
    """Return whether the tie points of a view that were rejected lie off in any direction, as wrong matches do."""
    return run.adjustment is not None and bool(-np.inf < run.adjustment.alike[run.number[view.name]] <= SURE)


def _foreign_camera_of(view: ViewEntry, run: Run) -> ForeignCamera | None:
    """Return what is known of a view if its RPC is not its own."""
    apart = None if run.adjustment is None else run.adjustment.apart
    return apart if apart is not None and apart.is_view(run.number[view.name]) else None


def _follows_more(view: ViewEntry, run: Run) -> bool:
    """Return whether a camera is more than one RPC holds, as it was delivered or by what it was corrected by."""
    one = view.correction
    physical = not isinstance(run.views[run.number[view.name]].sensor, RPC)
    return one is not None and any((physical, one.jitter_px, one.detector_px, one.strip_px, one.swing_px))


# --- what holds the scene: control, a reference, a DEM; what they did, and what is wrong with them --------


def held_lines(tested: ControlTest | None, gcps: GroundPoints, views: Sequence[ViewEntry], known: str) -> Iterator[str]:
    """Return what ground control says of the scene's place; `known` is what the adjustment states of it."""
    is_seen = np.bincount(gcps.point, minlength=len(gcps.names)) > 0
    held = int(np.count_nonzero(is_seen if tested is None else is_seen & tested.used))
    with_points = f"With {counted(held, 'GCP')}"
    scale = 1.0 if tested is None or tested.agreed is None else tested.agreed.scale
    if tested is None or tested.agrees:
        yield f"{with_points} {known}{'' if held else ' only'}."
    elif not held:
        yield f"Without ground control that agrees {known} only."
    elif scale > 1.0:
        yield f"{with_points}, taken for {scale:.0f} times less accurate than stated, {known}."
    else:
        yield f"{counted(held, 'GCP')} that hold the scene do not agree: what is known of its place they do not tell."
    # others that were rejected have been held against them
    if held == is_seen.sum() > 0 and tested is not None and tested.agrees and not tested.checked:
        yield f"Nothing checks {'it' if held == 1 else 'them'}: an error in a GCP would not show."
    alone = np.unique(gcps.view)
    if held and len(alone) == 1 and len(views) > 1:
        yield f"They are seen in {views[alone[0]].name} alone, which says nothing along its lines of sight."


def reference_lines(run: Run) -> Iterator[str]:
    """Return what a reference was good for."""
    found = run.reference
    if found is None or found.control is None:
        return
    if matched := [view for view in found.views if view.points]:
        used, tried = sum(view.points for view in matched), sum(view.tried for view in matched)
        off = listed([f"{np.hypot(*view.offset):.1f} m ({view.name})" for view in matched], NAMED)
        pixels = found.step / max(view.gsd for view in matched)
        told = f" Bends of an image by less than its pixel, {pixels:.2g} px here, it does not tell."
        yield (
            f"Reference: {used} of {counted(tried, 'point')} matched at {metres(found.step)} in "
            f"{counted(len(matched), 'image')}, peak {min(view.peak for view in matched):.1f} or more; as delivered "
            f"they were off by {off}.{told * bool(np.isfinite(pixels))}"
        )
    if rest := listed([view.name for view in found.views if not view.points]):
        yield f"The reference holds no point of {rest}."


def control_reasons(names: Sequence[str], tested: ControlTest) -> Iterator[str]:
    """Name ground control that is wrong."""
    status = [tested.status(g) for g in range(len(names))]
    for word, words in () if tested.torn else _CONTROL_WORDS.items():
        wrong = [
            f"{names[g]} ({enu(tested.residual[g])}, w = {tested.w[g]:.1f})"
            if np.isfinite(tested.w[g])
            else f"{names[g]} (too few images show it to tell by how much)"
            for g in range(len(names))
            if status[g] == word
        ]
        if wrong:
            alike = word == "rejected" and tested.agreed is not None and tested.agreed.alike
            datum = " They agree with each other: is their datum, or their height, another one?" * alike
            yield f"{words.format(counted(len(wrong), 'GCP'))}: {listed(wrong)}.{datum}"
    if tested.sets:
        one, other = (listed([names[g] for g in np.flatnonzero(points).tolist()], NAMED) for points in tested.sets)
        middle = [tested.residual[points & np.isfinite(tested.w)] for points in tested.sets]
        apart = ""
        if all(len(residual) for residual in middle):
            apart = f" ({enu(middle[0].mean(axis=0) - middle[1].mean(axis=0))} between them)"
        yield (
            f"GCPs contradict each other, and no set of them outweighs the others: {one} against {other}{apart}. None "
            "of them was used: check coordinates, axes, datum and image positions, or add a point."
        )
    if tested.torn:
        without, held = tested.torn
        yield (
            f"Held by the GCPs the images would agree less with each other: {without:.3f} px became {held:.3f} px at "
            "tie points that took no part. None of the GCPs was used: check coordinates, image positions and stated "
            "accuracies."
        )
    if not tested.fits and "contradicts" not in status:
        yield (
            f"{counted(int(tested.used.sum()), 'GCP')} scatter {tested.scatter:.1f} times as much as stated: the "
            "accuracies are too good, or more than one is wrong."
        )


def reference_reasons(run: Run, stated: float) -> Iterator[str]:
    """Say that a reference shows something else, bends, or stands on heights that are `stated` better than they are."""
    found = run.reference
    if found is None:
        return
    if found.control is None:
        whys = "the DEM under it is of another place, or it is too old or too coarse"
        if all(view.peak < PEAK for view in found.views):
            whys = "another place, too old, or without texture"
        yield f"The reference {found.refusal}: {whys}. It was not used, and moved nothing."
    used = [view for view in found.views if view.points]
    if wide := [f"{view.name} ({metres(view.scatter)})" for view in used if view.scatter > found.step]:
        yield (
            f"Points of the reference lie off each other, across the lines of sight, by more than the "
            f"{metres(found.step)} of a pixel that finding them may leave, in {listed(wide, NAMED)}: it bends, or the "
            "images do."
        )
    if wrong := [view for view in used if view.shows_heights(stated)]:
        named = listed([f"{metres(view.along)} in {view.name}" for view in wrong], NAMED)
        yield (
            f"The heights of the DEM under the reference are not the terrain's: along the lines of sight its points "
            f"lie off each other by {named}, as heights wrong by {metres(max(view.heights for view in wrong))} would "
            f"make them ({metres(stated)} stated). What all of them are wrong by does not show, and moves the scene: "
            "check the DEM."
        )


def dem_lines(adjustment: Adjustment) -> Iterator[str]:
    """Return what the DEM did."""
    terrain, options = adjustment.terrain, adjustment.options
    if terrain is None or not terrain.shows:
        return
    by_reference = bool(adjustment.reference_inlier.any())  # which stands on it: no tie point does
    if not terrain.total:
        yield from ["The DEM constrains nothing: there are no tie points."] * (not by_reference)
        return
    held = f"DEM heights constrain {terrain.held} of {counted(terrain.total, 'tie point')}"
    if terrain.held:
        single = f"{metres(terrain.sigma if np.isfinite(terrain.sigma) else options.dem_sigma)} per point"
        if np.isfinite(terrain.sigma) and terrain.alike >= 1.05:
            single += f" ({terrain.alike:.1f} correlated heights count as one)"
        yield f"{held}. Assumed error: {single}, and {metres(terrain.bias)} common to all."
    else:
        yield f"{held}: the DEM has no height where one is needed."
    lie = f"; they lie {terrain.offset:+.1f} m above it (median; NMAD {terrain.spread:.1f} m)" if terrain.known else ""
    yield f"The DEM covers {100 * terrain.known / terrain.total:.0f} % of the tie points{lie}."


def dem_reasons(adjustment: Adjustment) -> Iterator[str]:
    """Return what is wrong with the DEM: it shows something else, or contradicts the cameras as delivered."""
    terrain = adjustment.terrain
    if terrain is None:
        return
    if not terrain.shows:
        yield (
            f"The DEM does not show the terrain of the tie points: its relief is {terrain.relief:.2g} times theirs. "
            "Another place, other units, heights that are all alike, or cameras that are farther off than its hills "
            "are wide. It was not used, and moved nothing."
        )
        return
    (level, *rises), (off, *tilts) = terrain.beyond, terrain.delivered
    if level > SURELY:
        why = "its heights, the datum that they count from, or the cameras are not as stated"
        yield (
            f"The DEM is {abs(off):.1f} m {'below' if off > 0 else 'above'} the tie points as the delivered cameras "
            f"put them, {level:.1f} times what the accuracies of both let expect: {why}."
        )
    sides = zip(tilts, rises, ("east", "north"), strict=True)
    if tilted := [f"{abs(tilt):.1f} m to the {side}" for tilt, times, side in sides if times > SURELY]:
        yield (
            f"The DEM is tilted against the tie points as delivered, by {' and '.join(tilted)} at the scene's edge, "
            f"more than {SURELY:g} times what the accuracies of it and of the cameras let expect."
        )


def lengths(values: Iterable[float]) -> str:
    """Return lengths in readable units."""
    return ", ".join(map(metres, values))


def enu(shift: Sequence[float] | Array) -> str:
    """Return a move (3,) [m] with its directions."""
    return ", ".join(f"{s:+.2f} m {word}" for s, word in zip(shift, ("east", "north", "up"), strict=True))
