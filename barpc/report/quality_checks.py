"""Reservations on an image or the scene, with their figures; sentences on control, reference and DEM."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.parameters.priors import is_stated
from barpc.ba.select.foreign_camera import ForeignCamera
from barpc.base.errors import listed
from barpc.base.geodesy import Array
from barpc.base.statistics import SURE
from barpc.report.measures.block import left_entries, matters, strangeness
from barpc.report.outcome import LEAST_MOVED, MANY_REJECTED, WHOLE_PIXELS, Run
from barpc.report.ranking import GOOD_RMSE, SMOOTH_LEFT
from barpc.report.summary.block import AXES, LeftEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import CAUSES, counted, known, metres, two_digits
from barpc.sensor.geometry import Several
from barpc.sensor.image_corrections import Splined
from barpc.sensor.rpc import RPC

MIN_TIE_POINTS = 30  # Of a view, used or rejected: they tell a standard deviation to an eighth, 1 / sqrt(2 n)
ENOUGH_GCPS = 3  # Control points that constrain a view without any tie point
WORST_LEFT = 0.15  # px: a larger misfit of one RPC anywhere needs review
NOISE_LIMIT = 2.5  # Scatter of tie points over the accuracy that the matcher states: more needs review

_PARALLEL = 0.05  # sine of the angle between lines and axis under which a part across tells nothing of that along
_WHOLE_IMAGE = 0.9  # share of the rows or columns that is the whole image


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
