"""Model selection for a block: the plain model, unless the data support another.

Hypotheses are tried in this order: an RPC of another image; moving ground; terms in the images; splines and detector
steps; an affine in every image. Evidence is computed from all observations. Check tie points, drawn before, have a
veto. They decide alone where no evidence is computed (`is_admitted`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.control.agreement import ODDS
from barpc.ba.parameters.priors import NOISE_FLOOR
from barpc.ba.robust.heldout import is_better, measure
from barpc.ba.select.anomalies import significant_intervals
from barpc.ba.select.beam import Selection
from barpc.ba.select.champion import compared, is_closer
from barpc.ba.select.foreign_camera import (
    AMBIGUOUS_VIEWS,
    ForeignCamera,
    Solver,
    contradicted_view,
    find_foreign_camera,
)
from barpc.ba.select.image_terms import with_lines_lost, with_splines, with_terms, with_terms_beside_splines
from barpc.ba.select.parts import Parts, lost_shares
from barpc.ba.select.search import search_terms
from barpc.ba.solution import CLEARLY, SURE_TREND, Solution
from barpc.ba.terms.moving_ground import MovingGroup
from barpc.ba.terms.term import Finding
from barpc.base.errors import AdjustError
from barpc.base.options import AUTO, AdjustOptions
from barpc.base.statistics import MUCH_NOISE, RIVALS

MIN_MOTION = 0.2  # px: least motion of ground between images of one pass


@dataclass(frozen=True, eq=False)
class SelectedModel:
    """A block solved with the selected model."""

    found: Solution
    parts: Parts
    in_space_rms: float | None = None  # check RMS [px] of the geometric model, if an affine was selected
    foreign: ForeignCamera | None = None  # the view that was left out, or several candidates
    changed: float = 0.0  # largest median change of epipolar offsets from the plain model [px] (`Comparison`)


def select_model(parts: Parts, options: AdjustOptions, solve: Solver) -> SelectedModel:
    """Solve the block with the model that the data select.

    Raises
    ------
    AdjustError
        There is no solution.
    """
    first, foreign, without = _first_solution(parts, options, solve)
    if foreign is not None and foreign.may_be_distorted and first is not None:
        # if terms of its rows and columns explain its residuals, the RPC is not of another image
        chosen = _select_terms(first, parts, options, solve)
        if chosen.parts.fits_view(chosen.found, foreign.view):
            return chosen
    if foreign is not None and foreign.clear:
        parts = parts.without_view(foreign.view)
    start = first if without is None else without
    assert start is not None
    selected = replace(_select_terms(start, parts, options, solve), foreign=foreign)
    return _without_contradicted(selected, options, solve) if foreign is None and not start.goes_on else selected


def _without_contradicted(selected: SelectedModel, options: AdjustOptions, solve: Solver) -> SelectedModel:
    """Leave out the view with the largest share of rejected tie points, if over half, and if it changes other cameras.

    The other views are adjusted alone. Their model is returned if it differs by more than `SURE_TREND`.
    """
    found, parts = selected.found, selected.parts
    lost = lost_shares(found, parts.inner)
    view = int(lost.argmax())
    others = parts.without_view(view)
    groups = others.inner.groups(others.inner.use)
    if not lost[view] > 0.5 or max(map(len, groups), default=0) < len(lost) - 1 or len(lost) <= AMBIGUOUS_VIEWS:
        return selected
    try:
        alone = _select_terms(solve(others.inner, others.outer, options), others, options, solve)
    except (AdjustError, np.linalg.LinAlgError):
        return selected
    if compared(alone.found, found, alone.parts.ties()).changed <= SURE_TREND:
        return selected
    return replace(alone, foreign=contradicted_view(view))


def _first_solution(
    parts: Parts, options: AdjustOptions, solve: Solver
) -> tuple[Solution | None, ForeignCamera | None, Solution | None]:
    """Return the solution with all views, a foreign camera, and the solution without it; at least one solution.

    A block that continues an earlier run is not searched for foreign cameras.
    """
    block, first, failed = parts.inner, None, None
    try:
        first = solve(block, parts.outer, options)
    except (AdjustError, np.linalg.LinAlgError) as error:
        failed = error
    goes_on = first is not None and first.goes_on
    foreign, without = (None, None) if goes_on else find_foreign_camera(first, block, parts.outer, options, solve)
    if without is not None or first is not None:
        return first, foreign, without
    assert failed is not None
    if foreign is None:
        raise failed
    names = ", ".join(block.names[v] for v in foreign.views)
    raise AdjustError(
        f"{failed}. Without any one of {names} the other views agree: check that their RPCs are of these images, and "
        "leave the wrong one out"
    ) from failed


def _select_terms(first: Solution, parts: Parts, options: AdjustOptions, solve: Solver) -> SelectedModel:
    """Return the model of the search for other hypotheses than foreign cameras, or the plain one if it fits better.

    Both are compared on all tie points. Splines and detector steps that were requested by options stay.
    """
    if options.terms != AUTO:
        return SelectedModel(first, parts)
    selected = _search_models(first, parts, options, solve)
    if selected.found is first and "drift" not in first.asked:
        return selected
    plain = first if "drift" not in first.asked else solve(parts.inner, parts.outer, replace(options, terms="none"))
    beside = compared(selected.found, plain, selected.parts.ties(moving=False))
    if beside.worse and not (options.spacing or options.detectors):
        return SelectedModel(plain, parts)
    return replace(selected, changed=beside.changed)


def _search_models(first: Solution, parts: Parts, options: AdjustOptions, solve: Solver) -> SelectedModel:
    """Return the model of the search among moving ground, terms, splines and affines in the images."""
    geometric = first.problem.cameras.unknowns.geometric and not first.goes_on
    given = not geometric or options.model != AUTO or options.drift is not None
    searched = None if given else _search_with_affine(first, parts, options, solve)
    if searched is not None:
        found, in_images, less = searched
        better = _is_much_better(in_images, found)
        if _explains_all(in_images if better else found, less, options.noise_floor):
            return SelectedModel(in_images, less, found.after.whole_rms) if better else SelectedModel(found, less)
    found = first
    if geometric:
        found, parts, selected = _without_moving_ground(first, parts, options, solve)
        found = with_lines_lost(with_terms(found, selected, parts, options), parts, options)
    smooth = with_splines(found, parts, options) if geometric else found
    if smooth is not found:
        beside = search_terms(smooth.outcome, parts.inner, options.noise_floor, moving=False)  # found before
        smooth = with_terms_beside_splines(smooth, beside, parts, options)
    if searched is None and (given or found.outcome is first.outcome):
        return SelectedModel(smooth, parts)
    affine, less = (_with_image_affine(found, parts, options, solve), parts) if searched is None else searched[1:]
    if affine is None or not _is_much_better(affine, found) or MUCH_NOISE * smooth.after.error < affine.after.error:
        return SelectedModel(smooth, parts)
    return SelectedModel(affine, less, found.after.whole_rms)


def _search_with_affine(
    found: Solution, parts: Parts, options: AdjustOptions, solve: Solver
) -> tuple[Solution, Solution, Parts] | None:
    """Search terms beside an affine in every image, and solve the geometric and the affine model with them.

    Beside the geometric model, residuals that affines explain would be taken for many steps. Return both solutions and
    the parts of the observations; None if the affines are not much better.
    """
    in_images = replace(options, model="affine")
    affine = _with_image_affine(found, parts, options, solve)
    if affine is None or _explains_all(affine, parts, options.noise_floor):
        return None if affine is None else (found, affine, parts)
    affine, less, selected = _without_moving_ground(affine, parts, in_images, solve)
    in_space = found if less is parts else solve(less.inner, less.outer, options)
    in_space = replace(in_space, findings=affine.findings)
    there = replace(selected, step=np.zeros_like(in_space.final.params))
    return with_terms(in_space, there, less, options), with_terms(affine, selected, less, in_images), less


def _with_image_affine(found: Solution, parts: Parts, options: AdjustOptions, solve: Solver) -> Solution | None:
    """Solve the block with an affine in every image; None if that is not much better, or no residual systematic."""
    if not (found.is_skew or found.has_trend):
        return None
    try:
        affine = solve(parts.inner, parts.outer, replace(options, model="affine"))
    except (AdjustError, np.linalg.LinAlgError):  # cameras hundreds of pixels off
        return None
    return affine if _is_much_better(affine, found) else None


def _is_much_better(affine: Solution, found: Solution) -> bool:
    """Return whether an affine in every image has much smaller check residuals than the geometric model."""
    better = affine.after.error < (CLEARLY if found.is_skew else 1.0 / MUCH_NOISE) * found.after.error
    # affines leave the tilts of the scene undetermined, so they must also gain more than the noise floor
    return better and affine.after.whole_rms < found.after.whole_rms - NOISE_FLOOR


def _explains_all(found: Solution, parts: Parts, floor: float) -> bool:
    """Return whether no significant residuals are left for terms of an image, or moving ground, to explain."""
    return not (found.has_trend or found.has_waves or significant_intervals(found.outcome, parts.inner, floor))


def _at_lower_degree(
    found: Solution, parts: Parts, options: AdjustOptions, solve: Solver
) -> tuple[Solution, Parts, Selection] | None:
    """Search moving ground with a drift of one degree less; None if check residuals are not significantly smaller.

    The higher degree may have fitted the motion of the ground, which is then not found.
    """
    less = replace(options, drift=found.problem.cameras.unknowns.drift - 1)
    plain = _without_moving_ground(solve(parts.inner, parts.outer, less), parts, less, solve)
    outer = plain[1].outer
    return plain if is_better(plain[0].after, measure(found.problem, found.final.params, outer), outer) else None


def _is_motion(one: MovingGroup, without: Solution, found: Solution, parts: Parts) -> bool:
    """Return whether the motion of a group is plausible, given the solutions `without` and with (`found`) the group.

    Correlated matching errors may be as large as small motions. Within a pass the motion must be at least `MIN_MOTION`.
    Between dates a smaller one is accepted if the solution without the group fits all tie points better. Images without
    a date count as one pass.
    """
    first, second = (parts.block.views[v].date for v in one.between)
    return parts.motion_pixels(one) >= MIN_MOTION or (first != second and is_closer(without, found, parts.ties()))


def _likelier_ground(found: Solution, parts: Parts, options: AdjustOptions, solve: Solver) -> tuple[Solution, Parts]:
    """Exchange the last moving group and the ground, if the priors of the cameras favour that.

    The smaller group was taken as moving, but in one block of twenty (`ODDS`) clouds may cover most of the ground.
    Cameras that fit the clouds deviate more from their priors. With control nothing is exchanged.
    """
    exchanged = parts.exchanged()
    if found.heights.has_control or not exchanged.is_tied():
        return found, parts
    try:
        other = solve(exchanged.inner, exchanged.outer, options)
    except (AdjustError, np.linalg.LinAlgError):
        return found, parts
    cost, of_other = (float((one.problem.camera_prior.residual(one.final.params) ** 2).sum()) for one in (found, other))
    return (other, exchanged) if 0.5 * (cost - of_other) > ODDS else (found, parts)


def _without_moving_ground(
    found: Solution, parts: Parts, options: AdjustOptions, solve: Solver
) -> tuple[Solution, Parts, Selection]:
    """Exclude moving groups of tie points, one after the other, and search terms in the images beside them.

    `Solution.findings` lists groups and terms; the selection has the terms only.
    """
    noise = MUCH_NOISE * found.outcome.noise * float(np.median(parts.inner.sigma))
    # with too few unknowns all images have systematic residuals, which are no moving ground
    if options.is_plain and bool(found.outcome.smooth.found(noise).all()):
        return found, parts, Selection()
    groups: list[Finding] = []
    while True:
        selected = search_terms(found.outcome, parts.inner, options.noise_floor)
        *findings, last = selected.findings or (None,)
        if last is None or last.moved is None:
            findings = list(selected.findings)
            break
        # an error may look like motion if the plain model has no term for it, or if a larger term leaves a remainder
        if options.is_plain or any(row.gain > last.gain for row in findings):
            break
        less = parts.with_group(found, last.moved)
        if len(groups) == RIVALS or not less.is_tied():
            break
        tried = solve(less.inner, less.outer, options)
        before = measure(found.problem, found.final.params, less.outer)
        if is_better(before, tried.after, less.outer) or not _is_motion(last.moved, tried, found, parts):
            break
        # a motion in each image follows a part of the jitter of many images
        smooth, still = with_splines(found, parts, options), less.without_motion(found, last.moved)
        if not is_closer(tried, smooth, parts.ties(), still):
            break
        tried, less = _likelier_ground(tried, less, options, solve)
        found, parts = tried, less
        groups.append(last)
    unexplained = found.has_trend and not (groups or findings)
    if unexplained and "drift" in found.asked and (plain := _at_lower_degree(found, parts, options, solve)):
        return plain
    selected = replace(selected, findings=tuple(findings))
    return replace(found, findings=(*groups, *findings)), parts, selected
