"""What keeps an image from being good: which of the causes there are holds, with its figures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.apart import Apart
from barpc.ba.usual import SURE
from barpc.report.dem_lines import holds_reference
from barpc.report.outcome import MANY_REJECTED, SMOOTH_LEFT, Run
from barpc.report.summary.causes import CAUSES, Reservation
from barpc.report.summary.findings import LeftEntry, left_entries, strangeness
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import known, listed
from barpc.sensor.rpc import RPC

GOOD_RMSE = 0.5  # A view whose tie points are left with more than this [px] is called doubtful
FEW_OBSERVATIONS = 30  # A view with fewer is called weakly tied, unless control points hold it
ENOUGH_GCPS = 3  # Control points that hold a view without any tie point
WORST_LEFT = 0.15  # px: an image with more anywhere is called doubtful
NOISE_LIMIT = 2.5  # Tie points that scatter by more than so many times what the matcher states need a look
MOST = 0.5  # of a view's tie points: where more contradict the others, these are right by majority

GOOD = {"adjust": "adjusted", "check": "consistent", "match": "tied"}
"""Kind of a run -> the status of a view without reservation."""


def view_status(view: ViewEntry, run: Run) -> dict[str, str | None]:
    """Return the verdict on a view: a word of `STATUS_WORDS`, what to do (empty when all is well), and the cause."""
    for reason in _RESERVATIONS:
        if (found := reason(view, run)) is not None:
            return {"status": CAUSES[found.cause].status, "advice": found.advice, "cause": found.cause}
    return {"status": GOOD[run.kind], "advice": "", "cause": None}


def _untied(view: ViewEntry, run: Run) -> Reservation | None:
    if run.adjustment is None or view.name not in run.adjustment.left_out:
        return None
    tried = sum(view.name in report.names for report in run.matched)
    if run.matched and not tried:
        return Reservation.of("no_overlap")
    return Reservation.of("untied", tried=f" ({tried} pair{'s' * (tried > 1)} with it tried)" if tried else "")


def _left_alone(view: ViewEntry, run: Run) -> Reservation | None:
    apart = _apart(view, run)
    if apart is None or apart.placed is not None:
        return None
    cause = "contradicts_all" if apart.look.as_stated else "other_rpc"
    return Reservation.of(cause, strangeness=strangeness(apart))


def _misses(view: ViewEntry, run: Run) -> Reservation | None:
    tolerance = getattr(getattr(run.options, "fit", None), "tolerance", np.inf)
    # grids hold what the RPC does not
    beyond = _follows_more(view, run) or getattr(run.options, "grids", False)
    if view.fit is not None and not beyond and not all(known(v) <= tolerance for v in view.fit.max_px):
        return Reservation.of("one_rpc_misses", tolerance=tolerance)
    return None


def _contradicted(view: ViewEntry, run: Run) -> Reservation | None:
    """Say that most tie points of a view contradict the others all over it, not as wrong matches do."""
    many = run.kind == "adjust" and view.num_rejected >= FEW_OBSERVATIONS and lost(view) > MOST
    if not many or _apart(view, run) is not None or anywhere(view, run) or _most_in(view, run):
        return None
    return Reservation.of("contradicted", share=100 * lost(view))


def _weakness(view: ViewEntry, run: Run) -> Reservation | None:
    few = view.num_observations
    if few >= FEW_OBSERVATIONS or view.num_gcps >= ENOUGH_GCPS:
        return None
    if run.reference is not None and any(found.points and found.name == view.name for found in run.reference.views):
        return None
    return Reservation.of("few", few=few) if few else Reservation.of("none")


def _copied(view: ViewEntry, run: Run) -> Reservation | None:
    if run.kind == "match" or view.name not in run.copies:  # how well cameras agree is not what was asked
        return None
    return Reservation.of("copy", other=run.copies[view.name])


def _adjusted_alone(view: ViewEntry, run: Run) -> Reservation | None:
    if run.kind == "match" or (apart := _apart(view, run)) is None:
        return None
    stated = f"{apart.scale:.0f} times farther off than stated" if apart.scale > 1.0 else "not its own"
    return Reservation.of("apart", stated=stated, strangeness=strangeness(apart))


def _odd(view: ViewEntry, run: Run) -> Reservation | None:
    """Say that an RPC is farther off than stated, beside the others."""
    if run.kind == "match" or run.adjustment is None:
        return None
    prior, i = run.adjustment.prior, run.number[view.name]
    if not prior.odd[i]:
        return None
    others = [run.adjustment.names[j] for j in np.flatnonzero(prior.odd) if j != i]
    either = f" (or that of {listed(others)}: the tie points cannot tell)" if others else ""
    return Reservation.of("odd", scale=prior.scale[i], either=either)


def _smooth(view: ViewEntry, run: Run) -> Reservation | None:
    """Say that something smooth is left that no correction follows."""
    if run.kind == "match" or run.adjustment is None:
        return None
    i, smooth = run.number[view.name], run.adjustment.smooth
    if not is_smooth(i, run.adjustment):
        return None
    along = "along the rows" if smooth.by_row[i] > 0.5 else "over the image"
    size = max(smooth.rms[i], smooth.shared[i])
    return Reservation.of("smooth", size=size, along=along, why=_why_smooth(run.adjustment))


def is_smooth(i: int, adjustment: Adjustment) -> bool:
    """Return whether something smooth is left of view i that no correction follows."""
    smooth = adjustment.smooth
    return bool(smooth.found(SMOOTH_LEFT)[i] or smooth.shared[i] > SMOOTH_LEFT)


def _why_smooth(adjustment: Adjustment) -> str:
    if adjustment.options.drift == 0:
        return "a drift was not allowed (--drift 0)"
    why = "attitude jitter, optics, or steps between detectors, which one RPC does not follow"
    if not holds_reference(adjustment):
        return why
    unstated = adjustment.terrain is not None and not adjustment.terrain.is_known
    if unstated:
        return f"the heights of the DEM (no --geoid), or {why}"
    return f"{why}; or the reference bends, or the heights under it do"


def _rejected_alike(view: ViewEntry, run: Run) -> Reservation | None:
    if run.kind == "match" or not (share := lost(view)) > MANY_REJECTED or anywhere(view, run):
        return None
    return Reservation.of("rejected", share=100 * share, place=_most_in(view, run))


def _unused(view: ViewEntry, run: Run) -> Reservation | None:
    """Return what tie points that took no part say of a view: the others were chosen to agree."""
    if run.kind == "match" or run.adjustment is None:
        return None
    i = run.number[view.name]
    noise, error = run.adjustment.held_out_noise[i], run.adjustment.held_out_rms[i]
    if not noise > NOISE_LIMIT:
        return None
    if lost(view) > MANY_REJECTED and anywhere(view, run):
        return Reservation.of("wrong_matches", share=100 * lost(view), error=error)
    if i in run.beside:
        return Reservation.of("beside", error=error, other=run.adjustment.names[run.beside[i]])
    return Reservation.of("held_out", error=error, noise=noise)


def _one_place(view: ViewEntry, run: Run) -> Reservation | None:
    """Name rows or columns of a view in which tie points contradict the others, or are off together."""
    if run.kind == "match" or run.adjustment is None:
        return None
    for one in left_entries(run.adjustment):
        if one.image == view.name and (what := stands_out(one)):
            return Reservation.of("place", place=f"{one.axis} {one.first:.0f}-{one.last:.0f}", what=what)
    return None


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


def _most_in(view: ViewEntry, run: Run) -> str:
    """Return where most of a view's rejected tie points are, if the adjustment found them to stand out somewhere."""
    found = () if run.adjustment is None else left_entries(run.adjustment)
    for one in found:
        if one.image == view.name and one.rejected > MANY_REJECTED and not one.moving:
            return (
                f"; most in {one.axis} {one.first:.0f}-{one.last:.0f}, where {100 * one.rejected:.0f} % were, half of "
                f"these by more than {one.apart_px:.2f} px"
            )
    return ""


def _beyond(view: ViewEntry, run: Run) -> Reservation | None:
    """Return what one RPC does not hold of a camera that jitter or steps between detectors are corrected in."""
    told = any(getattr(run.options, name, None) for name in ("grids", "tiles", "resample"))
    if run.adjustment is None or view.fit is None or told or not _follows_more(view, run):
        return None
    left = float(np.linalg.norm([known(v) for v in view.fit.rmse_px]))
    most = max(map(known, view.fit.max_px))
    if run.kind == "match" or (left <= SMOOTH_LEFT and most <= WORST_LEFT):
        return None
    assert view.correction is not None
    follows = "attitude jitter or steps between detectors"
    if not isinstance(run.views[run.number[view.name]].sensor, RPC):
        follows = "its own orbit and attitude"
    if view.correction.strip_px:
        follows = "rows or columns that lie off by themselves"
    elif view.correction.swing_px:
        follows = "a swing of its rows"
    return Reservation.of("follows_more", follows=follows, left=left, most=most, image=view.name)


def _error(view: ViewEntry, run: Run) -> Reservation | None:
    error = known(view.rmse_after if run.kind == "adjust" else view.rmse_before)
    if run.kind == "match" or error <= GOOD_RMSE or not view.num_observations:
        return None
    if not np.isfinite(error):
        return Reservation.of("unseen")
    return Reservation.of("disagrees" if run.kind == "check" else "left", error=error)


def _moving(view: ViewEntry, run: Run) -> Reservation | None:
    moving = view.num_moving / max(view.num_moving + view.num_rejected + view.num_observations, 1)
    if run.kind == "match" or moving <= MANY_REJECTED:
        return None
    return Reservation.of("moving", share=100 * moving)


_RESERVATIONS: tuple[Callable[[ViewEntry, Run], Reservation | None], ...] = (
    _untied, _left_alone, _misses, _contradicted, _weakness, _copied, _adjusted_alone, _odd, _smooth, _rejected_alike,
    _unused, _beyond, _error, _moving, _one_place,
)  # fmt: skip
"""In this order: the first that holds is the reason."""


def lost(view: ViewEntry) -> float:
    """Return the share of a view's tie points that was rejected."""
    return view.num_rejected / max(view.num_rejected + view.num_observations, 1)


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
