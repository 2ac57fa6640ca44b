"""What keeps an image from being good: which of the causes there are holds, with its figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.apart import Apart
from barpc.ba.usual import SURE
from barpc.report.outcome import MANY_REJECTED, SMOOTH_LEFT, Run
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.whole import LeftEntry, left_entries, strangeness
from barpc.report.summary.words import CAUSES, known, listed
from barpc.sensor.rpc import RPC

GOOD_RMSE = 0.5  # A view whose tie points are left with more than this [px] is called doubtful
FEW_OBSERVATIONS = 30  # A view with fewer is called weakly tied, unless control points hold it
ENOUGH_GCPS = 3  # Control points that hold a view without any tie point
WORST_LEFT = 0.15  # px: an image with more anywhere is called doubtful
NOISE_LIMIT = 2.5  # Tie points that scatter by more than so many times what the matcher states need a look

GOOD = {"adjust": "adjusted", "check": "consistent", "match": "tied"}
"""Kind of a run -> the status of a view without reservation."""

Found = Iterator[tuple[str, Mapping[str, object]]]
"""Causes that hold, with their figures."""


def view_status(view: ViewEntry, run: Run) -> dict[str, str | None]:
    """Return the verdict on a view: a word of `STATUS_WORDS`, what to do (empty when all is well), and the cause."""
    for cause, figures in _reservations(view, run):  # the first that holds is the reason
        return {"status": CAUSES[cause].status, "advice": CAUSES[cause].advice(**figures), "cause": cause}
    return {"status": GOOD[run.kind], "advice": "", "cause": None}


def _reservations(view: ViewEntry, run: Run) -> Found:
    adjustment = run.adjustment
    if adjustment is not None:
        yield from _failed(view, run, adjustment)
    by_reference = run.reference is not None and any(v.points and v.name == view.name for v in run.reference.views)
    if view.num_observations < FEW_OBSERVATIONS and view.num_gcps < ENOUGH_GCPS and not by_reference:
        yield "few" if view.num_observations else "none", {"few": view.num_observations}
    if run.kind == "match":  # how well cameras agree is not what was asked
        return
    if view.name in run.copies:
        yield "copy", {"other": run.copies[view.name]}
    if adjustment is not None:
        yield from _of_camera(view, run, adjustment)
        yield from _of_tie_points(view, run, adjustment)
        yield from _beyond(view, run)
    error = known(view.rmse_after if run.kind == "adjust" else view.rmse_before)
    if view.num_observations and not error <= GOOD_RMSE:
        disagrees = "disagrees" if run.kind == "check" else "left"
        yield disagrees if np.isfinite(error) else "unseen", {"error": error}
    moving = view.num_moving / max(view.num_moving + view.num_rejected + view.num_observations, 1)
    if moving > MANY_REJECTED:
        yield "moving", {"share": 100 * moving}
    for one in () if adjustment is None else left_entries(adjustment):
        if one.image == view.name and (what := stands_out(one)):
            yield "place", {"place": f"{one.axis} {one.first:.0f}-{one.last:.0f}", "what": what}


def _failed(view: ViewEntry, run: Run, adjustment: Adjustment) -> Found:
    """Say why an image was not adjusted, or that most of its tie points contradict the others."""
    apart = _apart(view, run)
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
    many = run.kind == "adjust" and view.num_rejected >= max(FEW_OBSERVATIONS, view.num_observations + 1)
    if many and apart is None and not anywhere(view, run) and not _most_in(view, adjustment):
        yield "contradicted", {"share": 100 * view.lost}


def _of_camera(view: ViewEntry, run: Run, adjustment: Adjustment) -> Found:
    """Say that an RPC is not an image's own, is farther off than stated, or that no correction follows what is left."""
    i, prior, smooth = run.number[view.name], adjustment.prior, adjustment.smooth
    if (apart := _apart(view, run)) is not None:
        stated = f"{apart.scale:.0f} times farther off than stated" if apart.scale > 1.0 else "not its own"
        yield "apart", {"stated": stated, "strangeness": strangeness(apart)}
    if prior.odd[i]:
        others = [adjustment.names[j] for j in np.flatnonzero(prior.odd) if j != i]
        either = f" (or that of {listed(others)}: the tie points cannot tell)" if others else ""
        yield "odd", {"scale": prior.scale[i], "either": either}
    if is_smooth(i, adjustment):
        along = "along the rows" if smooth.by_row[i] > 0.5 else "over the image"
        size = max(smooth.rms[i], smooth.shared[i])
        yield "smooth", {"size": size, "along": along, "why": _why_smooth(adjustment)}


def is_smooth(i: int, adjustment: Adjustment) -> bool:
    """Return whether something smooth is left of view i that no correction follows."""
    smooth = adjustment.smooth
    return bool(smooth.found(SMOOTH_LEFT)[i] or smooth.shared[i] > SMOOTH_LEFT)


def _why_smooth(adjustment: Adjustment) -> str:
    if adjustment.options.drift == 0:
        return "a drift was not allowed (--drift 0)"
    why = "attitude jitter, optics, or steps between detectors, which one RPC does not follow"
    if not adjustment.reference_inlier.any():
        return why
    if adjustment.terrain is not None and not adjustment.terrain.is_known:
        return f"the heights of the DEM (no --geoid), or {why}"
    return f"{why}; or the reference bends, or the heights under it do"


def _of_tie_points(view: ViewEntry, run: Run, adjustment: Adjustment) -> Found:
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


def _beyond(view: ViewEntry, run: Run) -> Found:
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


def _apart(view: ViewEntry, run: Run) -> Apart | None:
    """Return what is known of a view if its RPC is not its own."""
    apart = None if run.adjustment is None else run.adjustment.apart
    return apart if apart is not None and apart.is_view(run.number[view.name]) else None


def _follows_more(view: ViewEntry, run: Run) -> bool:
    """Return whether a camera is more than one RPC holds, as it was delivered or by what it was corrected by."""
    one = view.correction
    physical = not isinstance(run.views[run.number[view.name]].sensor, RPC)
    return one is not None and any((physical, one.jitter_px, one.detector_px, one.strip_px, one.swing_px))
