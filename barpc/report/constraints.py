"""Sentences on the constraints of the scene: control, reference, DEM."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.control.snooping import ControlTest
from barpc.base.errors import listed
from barpc.base.statistics import SURELY
from barpc.report.outcome import Run
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import NAMED, counted, enu, metres
from barpc.scene import GroundPoints
from barpc.tie.reference import FAR_RADIUS, PEAK

CONTROL_WORDS = {"dem": "the DEM", "gcps": "the GCPs", "reference": "the reference"}
"""Kind of control -> its words in a sentence."""


_GCP_WORDS = {
    "rejected": ("{} rejected, as the others contradict {}", "Check coordinates, axes and image positions"),
    "contradicts": ("{} used, with residuals above 4 standard deviations", "Check coordinates and stated accuracies"),
}
"""Status of GCPs -> sentence about their number, advice."""


_CHECK_DEM = "Check its heights, their datum, and the cameras."


def held_lines(tested: ControlTest | None, gcps: GroundPoints, views: Sequence[ViewEntry], known: str) -> Iterator[str]:
    """Yield whether GCPs are used, agree and are checked; `known`: clause on the uncertainty of the scene."""
    is_seen = np.bincount(gcps.point, minlength=len(gcps.names)) > 0
    is_used = is_seen if tested is None else is_seen & tested.used
    held = int(np.count_nonzero(is_used))
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
    # a rejected GCP shows that the others are checked
    if held == is_seen.sum() > 0 and tested is not None and tested.agrees and not tested.checked:
        yield f"Nothing checks {'it' if held == 1 else 'them'}: an error in a GCP would not show."
    alone = np.unique(gcps.view[is_used[gcps.point]])
    if len(alone) == 1 and len(views) > 1:
        name = views[alone[0]].name
        yield f"Only {name} shows GCPs that are used: they do not constrain the scene along its lines of sight."


def reference_lines(run: Run) -> Iterator[str]:
    """Yield the number of matches with a reference, and the offsets of the delivered cameras from it."""
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
    for word, (words, cure) in () if tested.torn else _GCP_WORDS.items():
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
    """Yield reservations on the reference: not used, distorted, or its DEM less accurate than `stated` [m]."""
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
    by_reference = bool(adjustment.reference_inlier.any())  # its points have heights of the DEM
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


def deformation_reasons(adjustment: Adjustment) -> Iterator[str]:
    """Yield the reservation on control that would deform an image while its tie points do not require this."""
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
    """Return lengths [m] as text in readable units."""
    return ", ".join(map(metres, values))
