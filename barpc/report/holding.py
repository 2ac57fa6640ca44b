"""What holds the scene, in words: ground control, a reference, a DEM; what they did, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.judging.snooping import ControlTest
from barpc.ba.usual import SURELY
from barpc.base.geodesy import Array
from barpc.report.outcome import Run
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import NAMED, counted, listed, metres
from barpc.scene import GroundPoints
from barpc.tie.reference import PEAK

_GEOID = 110.0  # m: no geoid lies farther from the ellipsoid
_CONTROL_WORDS = {
    "rejected": "{} rejected, contradicted by the rest: check coordinates, axes and image positions",
    "contradicts": "{} off by more than 4 standard deviations, used all the same: the stated accuracies are too good, "
    "or more than one is wrong",
}


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
    if held and tested is not None and tested.agrees and not tested.checked:
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
        yield from ["The DEM holds nothing: there are no tie points."] * (not by_reference)
        return
    held = f"The DEM holds {terrain.held} of {counted(terrain.total, 'tie point')}"
    if terrain.held:
        single = metres(options.dem_sigma)
        if np.isfinite(terrain.sigma):
            single = f"{metres(terrain.sigma)}, of which {terrain.alike:.1f} are worth one,"
        yield f"{held}, each to {single} and all together to {metres(terrain.bias)}."
    elif options.dem_for_weak and terrain.known and not adjustment.held.any():
        least = f"{options.min_convergence:g} degree{'' if options.min_convergence == 1 else 's'}"
        yield f"{held}: all rays meet under more than {least}; without --dem-for-weak it holds the scene."
    else:
        yield f"{held}: it has no height where it is needed."
    lie = (
        f"; they lie {terrain.offset:+.1f} m above it (median; spread {terrain.spread:.1f} m)" if terrain.known else ""
    )
    yield f"It has a height for {100 * terrain.known / terrain.total:.0f} % of the tie points{lie}."
    if not terrain.is_known and not by_reference:
        why = "Nothing says that its heights count from the ellipsoid"
        yield f"{why}: give --geoid, or they may be wrong by up to 100 m."


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
    no_geoid = level > SURELY and not terrain.is_known and abs(off) < _GEOID
    if level > SURELY:
        why = "its heights, the datum that they count from, or the cameras are not as stated"
        if no_geoid:
            why = "nothing says that its heights count from the ellipsoid: a geoid was left out, give --geoid"
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
    if not terrain.is_known and adjustment.reference_inlier.any() and not no_geoid:
        yield (
            "The reference stands on the DEM, and nothing says that its heights count from the ellipsoid: if a "
            "geoid was left out, give --geoid, or the scene may lie up to 100 m too high or low, and its images aside "
            "by what they look aside over that. If they are ellipsoidal, its CRS should say so (EPSG:4979)."
        )


def lengths(values: Iterable[float]) -> str:
    """Return lengths in readable units."""
    return ", ".join(map(metres, values))


def enu(shift: Sequence[float] | Array) -> str:
    """Return a move (3,) [m] with its directions."""
    return ", ".join(f"{s:+.2f} m {word}" for s, word in zip(shift, ("east", "north", "up"), strict=True))
