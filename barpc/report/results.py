"""Results in sentences: of an adjustment, of a check, of a match."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from barpc.ba import Adjustment, check_residuals
from barpc.ba.parameters.priors import DEFAULT_ACCURACY, is_stated
from barpc.ba.select.foreign_camera import FOREIGN_CAMERA
from barpc.base.errors import listed
from barpc.base.geodesy import Array
from barpc.report.constraints import dem_lines, held_lines, lengths, reference_lines
from barpc.report.measures.block import explanations, held_out_places, left_entries, matters
from barpc.report.outcome import LEAST_MOVED, MANY_REJECTED, Added, Run
from barpc.report.quality_checks import anywhere, inconsistency
from barpc.report.records import value_of
from barpc.report.summary.block import AXES, HeldOutEntry, LeftEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import NAMED, counted, enu, median, metres, two_digits

PRIOR_WIDENED = 2.0  # Cameras less accurate than stated by more than this factor need review
_LEAST_DETECTORS = 3  # least displaced column ranges of an image that one sentence summarises
_SAY_REJECTED = "contradicted", "rejected", "wrong_matches"  # reservations whose sentence gives the share rejected
_SAY_WHERE = "rejected", "place"  # reservations whose sentence names the region of the image


def common_scale(found: Adjustment) -> float:
    """Return the factor on the prior standard deviations of all cameras: the smallest, as single ones may have more."""
    return float(np.min(found.prior.scale)) if len(found.prior.scale) else 1.0


def unmet_places(run: Run, adjustment: Adjustment, views: Sequence[ViewEntry], *, matter: bool) -> Iterator[str]:
    """Yield the worst region of each image: if `matter`, where it exceeds `LEAST_MOVED`, else where it does not."""
    said = {view.name for view in views if view.cause in _SAY_WHERE}
    worst: dict[str, tuple[bool, str]] = {}
    regions: list[tuple[LeftEntry | HeldOutEntry, str]] = [
        (one, f"In {one.place} of {one.image} {what}.")
        for one in left_entries(adjustment)
        if (what := inconsistency(one))
    ]
    # used tie points may agree with a distortion that they caused, check tie points do not
    regions += [(one, f"{one.sentence}.") for one in held_out_places(run.met_worse, adjustment.names)]
    for region, sentence in sorted(regions, key=lambda row: not matters(row[0])):
        worst.setdefault(region.image, (matters(region), sentence))
    cure = " Check for clouds, water, change there." * matter
    yield from (line + cure for image, (large, line) in worst.items() if image not in said and large == matter)


def by_altimetry(found: Adjustment) -> bool:
    """Whether altimetry constrains the scene."""
    return found.altimetry is not None and not found.altimetry.why_not


def adjusted_lines(run: Run, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield the sentences of an adjustment: residuals, position, model terms, an earlier run, control."""
    assert run.adjustment is not None
    before, after = (median([getattr(view, key) for view in views]) for key in ("rmse_before", "rmse_after"))
    gauge, gcps = run.adjustment.gauge, run.gcps
    tied = counted(sum(view.num_observations > 0 for view in views), "image")
    if len(run.tracks) and np.isfinite(after):
        was = f"; before: {before:.3f} px" if np.isfinite(before) else ""
        yield f"Tie points of {tied} have residuals of {after:.3f} px (median of the images' RMS{was})."
    else:
        yield "There are no tie points: control alone constrains the cameras."
    if len(run.tracks) or gcps is not None:
        yield f"The adjustment moved the scene by {enu(gauge.shift)}."
    yield from _position_lines(run, run.adjustment, views)
    unsaid = [view for view in views if view.lost > MANY_REJECTED and view.cause not in _SAY_REJECTED]
    if many := [view.name for view in unsaid if anywhere(view, run)]:
        # errors in one image reject tie points of the others, too
        alike = [view.name for view in unsaid if view.name not in many]
        why = f"but in {listed(alike)} in the same direction" if alike else "as mismatches do"
        yield (
            f"More than {100 * MANY_REJECTED:.0f} % of the tie points of {listed(many)} were rejected; neighbours err "
            f"in random directions, {why}."
        )
    yield from (f"{sentence[0].upper()}{sentence[1:]}." for sentence in _explanation_sentences(run.adjustment))
    yield from _pointing_lines(run, run.adjustment, views)
    yield from unmet_places(run, run.adjustment, views, matter=False)
    yield from _unseen_lines(run.adjustment)
    if run.added is not None:
        yield from _added_lines(run.added, len(views))
    yield from reference_lines(run)
    if (heights := run.adjustment.altimetry) is not None and not heights.why_not:
        yield (
            f"{heights.agree} of {heights.near} altimetry heights agree with the surface of the tie points to "
            f"{metres(heights.spread)} ({metres(heights.expected)} expected); they shifted it by {enu(heights.motion)}."
        )
    yield from dem_lines(run.adjustment)
    if run.check_points is not None and run.after is not None:
        yield _residual_sentence(check_residuals(run.after, run.check_points).rms(), len(run.check_points.names))


def _explanation_sentences(found: Adjustment) -> Iterator[str]:
    """Yield a sentence per explanation of the residuals; one for `_LEAST_DETECTORS` or more detectors of an image."""
    rows = [one for one in explanations(found) if one.name != FOREIGN_CAMERA]
    detectors = [one for one in rows if (one.name, one.axis) == ("step", AXES[0]) and not one.candidates]
    for one in rows:
        alike = [each for each in detectors if each.image == one.image]
        if len(alike) < _LEAST_DETECTORS or all(one is not each for each in alike):
            yield one.sentence
        elif one is alike[0]:
            edges = sorted(each.first for each in alike if each.first)
            size = max(each.size_px or 0.0 for each in alike)
            places = listed([f"{edge:.0f}" for edge in edges])
            yield (
                f"{len(alike)} parts of the columns of {one.image} are displaced by up to {size:.2f} px, as by "
                f"detectors with edges at {places}"
            )


def _unseen_lines(found: Adjustment) -> Iterator[str]:
    """Yield the undetectable displacement of rows or columns that causes the largest height error."""
    unseen = found.unseen
    if unseen is None or unseen.shown is not None:
        return
    view, axis = np.unravel_index(int(unseen.metres.argmax()), unseen.metres.shape)
    if (pixels := float(unseen.pixels[view, axis])) > LEAST_MOVED:
        yield (
            f"A jump between {AXES[axis]} of {found.names[view]} by up to {two_digits(pixels)} px would not show in "
            f"two images. Heights behind it would be off by up to {metres(float(unseen.metres[view, axis]))}."
        )


def _pointing_lines(run: Run, found: Adjustment, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield the corrections of cameras without a stated accuracy that exceed the default."""
    assumed = np.sqrt(2.0) * DEFAULT_ACCURACY / median([view.gsd_m for view in views])  # rotation and translation
    common, off = common_scale(found) > PRIOR_WIDENED, list[str]()
    for view, given, odd in zip(views, run.views, found.prior.odd, strict=False):
        size = np.hypot(*(value_of(view, "correction.center_shift_px") or (0.0, 0.0)))
        if size > assumed and (common or odd) and not is_stated(given, found.options):
            off.append(f"{view.name} ({size:.0f} px)")
    if off:
        yield (
            f"Corrections exceed the pointing error of {assumed:.0f} px that is assumed where no file states one: "
            f"{listed(off, NAMED)}."
        )


def _added_lines(added: Added, num: int) -> Iterator[str]:
    """Yield the number of images added to an earlier run, and the changes of its cameras that they require."""
    new = counted(num - added.met, "image")
    old = counted(added.images, "image")
    yield f"{new} added to the {old} of {added.run}; {added.met} of these have new tie points."
    name, far = added.largest
    if not added.updated:
        moves = f"they move by up to {far:.2f} px ({name}) where --update adjusts all together"
        yield f"The cameras of {added.run} were held as they are written; {moves}."
        return
    if not added.beyond:
        yield f"Their cameras stay valid: the largest change, of {name}, is {far:.3f} px (limit: {added.floor:g} px)."
        return
    some = listed([f"{one} ({px:.2f} px)" for one, px in added.beyond], NAMED)
    many = counted(len(added.beyond), "image")
    yield (
        f"The cameras of {many} of {added.run} change by more than {added.floor:g} px: {some}; their new cameras are "
        "written here."
    )


def lines_of_earlier(added: Added | None) -> Iterator[str]:
    """Yield the contradiction between new images and the fixed cameras of an earlier run."""
    if added is not None and added.contradicted is not None:
        name, held, free = added.contradicted
        yield (
            f"Check tie points of {name} have residuals of {held:.3f} px with the cameras of {added.run} as they are "
            f"written, and of {free:.3f} px with all cameras free. Run again with --update, which adjusts all."
        )


def _is_position_given(run: Run, found: Adjustment) -> bool:
    """Whether altimetry, a reference or fixed cameras constrain the scene's position."""
    return bool(by_altimetry(found) or (run.reference and run.reference.control) or run.known or found.options.fixed)


def by_cameras_alone(run: Run, found: Adjustment) -> bool:
    """Whether nothing but the accuracies of the cameras constrains the scene's position."""
    by_terrain = found.terrain is not None and bool(found.terrain.shows and found.terrain.held)
    return run.gcps is None and not by_terrain and not _is_position_given(run, found)


def _position_lines(run: Run, found: Adjustment, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield the uncertainty of the scene's position, and its source."""
    known = f"the scene's position is uncertain by {lengths(found.gauge.sigma)} (east, north, up; 1 sigma)"
    if run.gcps is not None:
        yield from held_lines(found.control, run.gcps, views, known)
    elif by_cameras_alone(run, found):
        yield f"Without ground control, {known}."
    elif _is_position_given(run, found):
        yield f"{known[0].upper()}{known[1:]}."
    else:
        yield f"With the DEM, {known}."


def _residual_sentence(rms: tuple[Array, Array], num: int) -> str:
    """Return the sentence on RMS residuals of check points: (2,) in the images [px], (3,) on the ground [m]."""
    image, ground = rms
    points = counted(num, "check point")
    if not np.isfinite(image).all():
        return f"{points}: no camera can project {'it' if num == 1 else 'them'}."
    on_ground = f", {lengths(ground)} on the ground (east, north, up)" if np.isfinite(ground).all() else ""
    return f"Residuals of {points} (RMS): {np.hypot(*image):.2f} px in the images{on_ground}."


def checked_lines(run: Run, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield the sentences of a check: the residuals of the cameras as delivered."""
    rmse = median([view.rmse_before for view in views])
    if np.isfinite(rmse):
        yield (
            f"Tie points of {counted(len(views), 'image')} have residuals of {rmse:.3f} px with the cameras as given "
            "(median of the images' RMS)."
        )
    elif len(run.tracks):
        yield "No residual could be computed: no camera projects tie points of another image."
    else:
        yield "There are no tie points: nothing shows whether the cameras agree."


def matched_lines(run: Run, views: Sequence[ViewEntry]) -> Iterator[str]:
    """Yield the sentences of a match: its counts."""
    counts = counted(len(views), "image"), counted(len(run.tracks), "observation")
    yield f"{counted(run.tracks.num_points, 'tie point')} of {counts[0]}, {counts[1]}."
