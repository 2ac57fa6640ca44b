"""Solutions with additional parameters in the images: selected terms, splines over the rows (jitter), given edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.constraints.block import Block, make_problem
from barpc.ba.parameters.additional_parameters import MIN_SPLINES, AdditionalParameters, most_splines
from barpc.ba.parameters.priors import JointPrior
from barpc.ba.robust.heldout import is_admitted, is_better
from barpc.ba.robust.rounds import Rounds, retriangulate_rejected
from barpc.ba.select.anomalies import correlated_noise_gain, significant_intervals
from barpc.ba.select.beam import Selection
from barpc.ba.select.parts import Parts
from barpc.ba.solution import Solution, finished
from barpc.ba.terms import TERMS, LinesLost, Sinusoid
from barpc.ba.terms.step import Step
from barpc.ba.terms.term import Finding
from barpc.base.geodesy import Array
from barpc.base.options import AUTO, OFF, AdjustOptions
from barpc.base.statistics import CRITICAL, LARGEST, MUCH_NOISE, SURE, SURELY

_SPACING = 2000.0  # rows between knots of the fewest splines: platforms oscillate with periods of seconds
_SPLINE_FACTOR = 1.5  # ratio of successive numbers of splines: 7, 10, 15, 22, 33
_LINE_TOLERANCE = 0.1  # lines: distance from a whole number; measured 2.95 for 3 and 5.07 for 5 lost lines
_MAX_FAILURES = 2  # successive numbers of splines that may fail to reduce check residuals


@dataclass(frozen=True, eq=False)
class _Layout:
    """Additional parameters to solve with."""

    additional: AdditionalParameters  # splines, steps, displaced parts, sinusoids
    start: Array | None = None  # (N, additional.size) start values
    drift: int | None = None  # degree of the drift; None: unchanged


def with_terms(found: Solution, selected: Selection, parts: Parts, options: AdjustOptions) -> Solution:
    """Solve the block with the terms in images that the search selected.

    The result is kept only if check residuals do not grow, and are smaller than with splines and detector steps. If
    the drift was raised by a degree before, the lower degree is tried again beside the terms.
    """
    terms = [one for one in selected.findings if TERMS[one.kind].FOLLOWED]
    if not terms or options.jitter == OFF or options.is_plain:
        return found
    outer = parts.outer
    at, layout = _at_selection(found, selected, parts.inner), _layout_of(terms, len(parts.inner.views))
    tried = _solve_with(at, parts, options, layout)
    if "drift" in found.asked:
        less = found.problem.cameras.unknowns.drift - 1
        plain = _solve_with(at, parts, options, replace(layout, drift=less))
        tried = tried if is_admitted(tried.after, plain.after, outer) else replace(plain, asked={})
    without = replace(found, findings=tuple(one for one in found.findings if one.moved is not None))
    if not is_admitted(tried.after, found.after, outer, sum(one.gain for one in terms)):
        return without
    # the search compared terms with row-wise errors of single images, but not with errors that all images have in
    # common: detector steps and platform jitter
    in_all = len({one.view for one in terms}) == len(parts.inner.views)
    # jitter of the platform is determined relative to one image, so its sinusoids may be absent from that one
    in_most = len({one.view for one in terms if one.kind == Sinusoid.NAME}) >= max(len(parts.inner.views) - 1, 2)
    if not (in_all or in_most):
        return tried
    smooth = with_splines(found, parts, options)
    intervals = [significant_intervals(of.outcome, parts.inner, options.noise_floor) for of in (smooth, tried)]
    left = [sum(one.gain for one in rows) for rows in intervals]
    fits = smooth is not found and left[0] <= left[1]
    # the first has more unknowns, so it must be significantly better than the second
    first, second = (tried, smooth) if in_all else (smooth, tried)
    if not fits or is_better(first.after, second.after, outer) == in_all:
        return tried
    return without if in_all or in_most else found


def with_terms_beside_splines(smooth: Solution, selected: Selection, parts: Parts, options: AdjustOptions) -> Solution:
    """Solve the block with its splines and the terms that a search beside them selected, unless check residuals grow.

    Jitter may hide smaller displacements, as those of detectors.
    """
    terms = [one for one in selected.findings if TERMS[one.kind].FOLLOWED]
    if not terms or options.is_plain:
        return smooth
    at, layout = _at_selection(smooth, selected, parts.inner), _layout_of(terms, len(parts.inner.views))
    tried = _solve_with(at, parts, options, layout)
    if not is_admitted(tried.after, smooth.after, parts.outer, sum(one.gain for one in terms)):
        return smooth
    return replace(tried, findings=(*smooth.findings, *terms))


def with_lines_lost(found: Solution, parts: Parts, options: AdjustOptions) -> Solution:
    """Solve the block with steps of rows constrained to whole numbers of lines, where they are nearly whole.

    No platform turns by pixels between two lines. If all rows from one on are displaced, lines were lost, and the step
    is a whole number of rows, without any columns (within `_LINE_TOLERANCE`), the only one that is not rejected. A pair
    observes only its component across epipolar lines; the constraint determines the other one.
    """
    findings = list(found.findings)
    steps = [at for at, one in enumerate(findings) if _ends_with_its_image(one, parts.inner)]
    if not steps or found.problem.joint_prior is not None:
        return found
    problem, waves = found.problem, found.problem.cameras.unknowns.waves
    if waves is None:  # the steps are reported, not estimated
        return found
    first = problem.cameras.unknowns.in_waves.start + waves.kinds[2].start
    covariance, index, mean = found.outcome.covariance(problem.free), list[int](), list[float]()
    for at in steps:
        one = findings[at]
        n = int((waves.steps[one.view] == one.where).all(axis=1).argmax())
        own = first + np.array([n, waves.steps.shape[1] + n])
        known = np.linalg.inv(covariance.view(one.view)[np.ix_(own, own)])
        pull = known @ found.final.params[one.view, own]  # right-hand side: the prior, of mean zero, adds nothing
        known -= np.diag(found.outcome.problem.camera_prior.sigma[one.view, own] ** -2.0)
        lines, sigma = float(pull[1] / known[1, 1]), float(known[1, 1] ** -0.5)
        misfit = float(pull @ np.linalg.solve(known, pull) - lines * pull[1])
        off = abs(lines - round(lines))
        is_only_one = SURELY * sigma < 1.0 - off  # a pair may not observe the rows: any number would be nearly whole
        if round(lines) and off < _LINE_TOLERANCE and is_only_one and misfit < CRITICAL**2:
            findings[at] = replace(one, kind=LinesLost.NAME, size=np.array([0.0, round(lines)]))
            index += [one.view * found.final.params.shape[1] + int(k) for k in own]
            mean += [0.0, float(round(lines))]
    if not index:
        return found
    prior = JointPrior.of_values(np.array(index), np.array(mean), found.final.params.shape)
    held = _solve_with(replace(found, findings=tuple(findings)), parts, options, _Layout(waves), held=prior)
    return found if is_better(found.after, held.after, parts.outer) else held


def _ends_with_its_image(one: Finding, block: Block) -> bool:
    """Return whether a finding is a step of all rows up to an end of its image."""
    if one.kind != Step.NAME or one.where is None or one.where[0] != 1:
        return False
    return one.where[1] <= 0.0 or one.where[2] >= block.views[one.view].size[1]


def with_splines(found: Solution, parts: Parts, options: AdjustOptions) -> Solution:
    """Solve the block with splines over the rows, if residuals are correlated, and the detector steps of options.

    The result is cached: terms and moving ground are compared with it, and it may also be the selected model.
    """
    key = id(found.outcome), options
    if key not in parts.splined:
        parts.splined[key] = found, _with_splines(found, parts, options)
    given, best = parts.splined[key]
    return found if best is given else replace(best, findings=found.findings)


def _with_splines(found: Solution, parts: Parts, options: AdjustOptions) -> Solution:
    """Solve as `with_splines`, without the cache.

    The number of splines grows until residuals are uncorrelated, observations are too few, or `_MAX_FAILURES`
    successive numbers did not reduce check residuals.
    """
    block = parts.inner
    given, asked = options.jitter != AUTO, bool(options.spacing or options.detectors)
    best, misses = found, 0
    for count in spline_counts(block, options, found.has_waves):
        if misses == _MAX_FAILURES or not (best.has_waves or (asked and best is found)):
            break
        layout = _Layout(AdditionalParameters(count, _given_edges(block, options)))
        tried = _solve_with(found, parts, options, layout, once=not options.detectors)
        # if the first round makes check residuals much larger, further rounds do not repair it
        if not options.detectors and (given or asked or not tried.after.error > MUCH_NOISE * best.after.error):
            tried = _solve_with(tried, parts, options, layout)
        better = given or (asked and best is found) or is_admitted(tried.after, best.after, parts.outer)
        best, misses = (tried, 0) if better else (best, misses + (best is not found))
    if best is found or not (given or asked or _explains(best, found, block)):
        return found
    return replace(best, asked={**found.asked, "jitter": found.outcome.smooth})


def _explains(tried: Solution, found: Solution, block: Block) -> bool:
    """Return whether splines remove half of the evidence for correlated noise, or check residuals fall much.

    Check tie points share matching errors with their neighbours, so a smaller fall may be a fit to noise.
    """
    left, before = (correlated_noise_gain(one.outcome, block) for one in (tried, found))
    return left <= max(0.5 * before, SURE) or MUCH_NOISE * tried.after.error < found.after.error


def _at_selection(found: Solution, selected: Selection, block: Block) -> Solution:
    """Return the solution with the cameras of the search, and its inliers (probability above 0.5)."""
    outcome, is_tie = found.outcome, block.point < block.num_tracks
    inlier = np.where(is_tie, block.use & (selected.right > 0.5), outcome.inlier)
    moved = replace(outcome.state, params=outcome.state.params + selected.step)
    return replace(found, outcome=replace(outcome, inlier=inlier, state=moved))


def _layout_of(terms: list[Finding], views: int) -> _Layout:
    """Return the terms as additional parameters: image parts and periods of `views` images, padded with infinity."""
    own = [
        [[one for one in terms if one.view == v and (one.period is None) == of_parts] for v in range(views)]
        for of_parts in (True, False)
    ]
    most = [max(map(len, of_kind)) for of_kind in own]
    places, periods = np.full((views, most[0], 5), np.inf), np.full((views, most[1]), np.inf)
    moved, amplitudes = np.zeros((views, 2, most[0])), np.zeros((views, 2, 2, most[1]))
    for v, (of_parts, of_periods) in enumerate(zip(*own, strict=True)):
        for n, one in enumerate(of_parts):
            assert one.where is not None
            places[v, n], moved[v, :, n] = one.where, one.unknowns
        for n, one in enumerate(of_periods):
            assert one.period is not None
            periods[v, n], amplitudes[v, :, :, n] = one.period, one.unknowns.reshape(2, 2)
    params = np.hstack([moved.reshape(views, -1), amplitudes.reshape(views, -1)])
    return _Layout(AdditionalParameters(0, np.zeros((views, 0)), places, periods), params)


def _given_edges(block: Block, options: AdjustOptions) -> Array:
    """Return the columns (N, e) [px] of the detector edges given as options, the same in all images."""
    return np.tile(np.array(options.detectors, dtype=np.float64) - 0.5, (len(block.views), 1))


def spline_counts(block: Block, options: AdjustOptions, has_waves: bool) -> list[int]:
    """Return the numbers of splines in each image to try, ascending (0: detector steps alone; empty: nothing).

    With `options.spacing` [rows between knots] there is one number. Else splines are tried only if residuals are
    correlated along rows (`has_waves`): one each `_SPACING` rows, then `_SPLINE_FACTOR` times as many, and so on. Each
    needs `FEW` observations (median of the images), and `LARGEST` limits the unknowns of all images.
    """
    rows = max(view.size[1] for view in block.views)
    if options.jitter == OFF or options.is_plain:
        return [0] if options.detectors else []
    most = most_splines(block.view[block.use])
    if options.spacing:
        return [max(min(int(np.ceil(rows / options.spacing)) + 3, most), MIN_SPLINES)]
    most = min(most, LARGEST // (2 * len(block.views)))
    if not has_waves or most < MIN_SPLINES:
        return [0] * bool(options.detectors)
    counts = [min(max(int(np.ceil(rows / _SPACING)) + 3, MIN_SPLINES), most)]
    while counts[-1] < most:
        counts.append(min(int(_SPLINE_FACTOR * counts[-1]), most))
    return counts


def _solve_with(
    found: Solution,
    parts: Parts,
    options: AdjustOptions,
    layout: _Layout,
    once: bool = False,
    held: JointPrior | None = None,
) -> Solution:
    """Solve the block with additional parameters, from the last state; rejected observations are tested again.

    With `once` there is one round of rejection only. `held` is a joint prior on some of the unknowns.
    """
    block, additional, start = parts.inner, layout.additional, layout.start
    outcome, ended, unknowns = found.outcome, found.outcome.state, found.problem.cameras.unknowns
    if unknowns.waves is not None and start is None:  # selected terms stay
        additional = replace(additional, steps=unknowns.waves.steps, periods=unknowns.waves.periods)
    elif unknowns.waves is not None and start is not None:
        additional, start = unknowns.waves.beside(ended.params[:, unknowns.in_waves], additional, start)
    drift = unknowns.drift if layout.drift is None else layout.drift
    problem = make_problem(block, options, unknowns.center, None, drift, additional)
    problem = problem if held is None else replace(problem, joint_prior=held)
    params, first = np.zeros_like(problem.camera_prior.mean), problem.cameras.unknowns.in_waves.start
    params[:, :first] = ended.params[:, :first]
    if start is not None:
        params[:, first:] = start
    elif unknowns.waves is not None:
        params[:, unknowns.in_waves.start :] = additional.carried(ended.params[:, unknowns.in_waves], unknowns.waves)
    weight, known = block.use / block.sigma, outcome.inlier
    if start is not None:  # the cameras have moved: all points are triangulated again
        count = np.bincount(block.point[known], minlength=problem.structure.num_points)
        weight, known = weight * (known | (count < 2)[block.point]), np.zeros_like(known)
    there, _ = retriangulate_rejected(problem, replace(ended, params=params), outcome.residual, known, weight)
    outcome = Rounds(problem, block, there, found.heights, block.use, outcome).run(once)
    return finished(found, problem, block, parts.outer, outcome)
