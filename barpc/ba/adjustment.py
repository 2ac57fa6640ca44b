"""The entry point of bundle adjustment: from tracks to corrected cameras."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from barpc.ba.altimetry import hold_by_altimetry
from barpc.ba.constraints.block import Block, join
from barpc.ba.constraints.gauge import GaugeReport, datum_shares, earlier_scene, gauge_report
from barpc.ba.constraints.ground import MAX_INDEPENDENT_ERRORS
from barpc.ba.constraints.incremental import BlockPrior
from barpc.ba.constraints.terrain import Terrain
from barpc.ba.control.snooping import image_test
from barpc.ba.evidence.scan import neighbours_alike
from barpc.ba.interior import CommonErrors
from barpc.ba.resection import resect
from barpc.ba.result import Adjustment, height_derivatives
from barpc.ba.robust.consensus import two_groups
from barpc.ba.robust.heldout import enu_offsets, keep_out, measure
from barpc.ba.robust.rounds import Outcome
from barpc.ba.select.anomalies import unexplained_intervals
from barpc.ba.select.champion import largest_offset
from barpc.ba.select.foreign_camera import ForeignCamera, Solver
from barpc.ba.select.models import SelectedModel, select_model
from barpc.ba.select.parts import Parts
from barpc.ba.solution import Solution, solve_block
from barpc.ba.solving.covariance import Covariance
from barpc.ba.terms.term import Finding
from barpc.ba.unseen import unseen_steps, with_unseen
from barpc.base.errors import AdjustError, BarpcWarning
from barpc.base.geodesy import Array, ground_from_ecef
from barpc.base.options import OFF, AdjustOptions
from barpc.base.process import one_blas_thread
from barpc.base.statistics import ITERATIONS, MANY, evenly
from barpc.scene import Altimetry, BoolArray, GroundPoints, Reference, Tracks, View
from barpc.sensor.centers import camera_center
from barpc.sensor.radar import Radar


@one_blas_thread()
def adjust_tracks(
    views: Sequence[View],
    tracks: Tracks,
    options: AdjustOptions | None = None,
    gcps: GroundPoints | None = None,
    dem: Terrain | None = None,
    *,
    centers: Array | None = None,
    prior: BlockPrior | None = None,
    reference: Reference | None = None,
    altimetry: Altimetry | None = None,
    known: BoolArray | None = None,
    keep_largest: bool = False,
    hold_out: bool = True,
    common: CommonErrors | None = None,
) -> Adjustment:
    """Correct the cameras of a block so that its tie points agree.

    Parameters
    ----------
    views, tracks : sequence of View, Tracks
        N views and their tie points; `Tracks.view` has indices of the views.
    options : AdjustOptions or None, None: the defaults
    gcps : GroundPoints or None, points of known position with their image coordinates
    dem : callable or None, lon, lat (n,) [deg] -> altitude (n,) [m above the ellipsoid], NaN outside
    centers : (N, 3) or None, camera centres [m], ECEF; None: regressed from the sensors
    prior : BlockPrior or None
        An earlier block, some of whose views are among these: the prior is their corrections and joint covariance.
        They need no tie points; `tracks` only has tie points seen in a new view.
    known : (K,) or None
        Mask of observations that `prior` contains, or may contain: only the information that new observations of the
        same tie points add is used. None: all are new.
    reference : Reference or None, points matched in an orthoimage, with heights of `dem`
    altimetry : Altimetry or None, heights without image coordinates
    keep_largest, hold_out : bool
        Continue with the largest group of connected views; exclude a tenth of the tracks to check the result.
    common : CommonErrors or None, uncertainty of common errors of images, already subtracted from `tracks`

    Returns
    -------
    Adjustment

    Raises
    ------
    TiePointError, DisconnectedError
        A view has too few observations; the views fall into groups that share no tie point.
    AdjustError, InputError
        There is no usable solution; views, tracks and options contradict each other.
    """
    start = time.process_time()
    options = AdjustOptions() if options is None else options
    common = common if common is not None and common.count else None
    if centers is None and options.center != "line":
        centers = np.array([camera_center(v.sensor, v.size, v.alt_range, options.center).ecef for v in views])
    prior = None if prior is None else prior.marginal([view.name for view in views])
    held = () if prior is None else prior.names
    block = join(tuple(views), tracks, gcps, options, keep_largest, reference, held)
    if known is not None and prior is not None:
        given = np.append(known & np.isin([view.name for view in views], held)[tracks.view], np.zeros(block.num_rows))
        block = replace(block, known=given[block.order].astype(bool))
    rows = keep_out(block) if hold_out else np.zeros_like(block.use)
    parts = Parts(block, rows, np.zeros(len(rows), dtype=np.int64))

    def solve(inner: Block, outer: Block, options: AdjustOptions) -> Solution:
        return solve_block(inner, outer, options, dem, centers, prior)

    found = _solved_adjustment(parts, options, solve, altimetry, common)
    return replace(found, earlier=prior, common=common, seconds=time.process_time() - start)


def consistent_observations(views: Sequence[View], tracks: Tracks, options: AdjustOptions | None = None) -> BoolArray:
    """Return the mask (K,) of inliers with the cameras fixed as delivered.

    Raises the errors of `adjust_tracks`.
    """
    names = tuple(view.name for view in views)
    held = replace(options or AdjustOptions(), fixed=names, drift=0, terms="none", jitter=OFF, detectors=())
    return adjust_tracks(views, tracks, held, hold_out=False).inlier


def _solved_adjustment(
    parts: Parts, options: AdjustOptions, solve: Solver, altimetry: Altimetry | None, common: CommonErrors | None
) -> Adjustment:
    """Solve the block with the selected model, and with altimetry if given."""
    given = parts.inner, parts.outer
    try:
        model = select_model(parts, options, solve)
        found, parts, apart = model.found, model.parts, model.foreign
        heights = None
        if altimetry is not None:
            found, heights = hold_by_altimetry(found, parts.inner, parts.outer, altimetry)
        found.heights.warn()
        _warn(found.outcome)
        whole = replace(_adjustment(model, found, options, common), altimetry=heights)
        whole = _with_undetectable(whole, found, parts.inner)
        if apart is None or not apart.clear:
            return replace(whole, apart=apart)
        return _with_foreign_view(whole, apart, found, parts.inner, given)
    except np.linalg.LinAlgError as error:
        raise AdjustError(
            f"the normal equations cannot be solved ({error}): is a standard deviation among the options, or of a "
            "point, beyond anything real?"
        ) from error


def _warn(outcome: Outcome) -> None:
    """Warn if the last solve did not converge, or if prior variances could not be estimated."""
    if not outcome.settled:
        message = f"the adjustment did not settle in {ITERATIONS} steps: check its residuals before its result is used"
        warnings.warn(message, BarpcWarning, stacklevel=4)
    if outcome.prior.failed:
        message = "the accuracy of the cameras is taken as it is given: the normal equations are too weak to learn it"
        warnings.warn(message, BarpcWarning, stacklevel=4)


def _with_foreign_view(
    whole: Adjustment, apart: ForeignCamera, found: Solution, others: Block, parts: tuple[Block, Block]
) -> Adjustment:
    """Return the result with the foreign view added: resected, or as delivered.

    `parts`: adjusted and check observations with that view. Its residuals are at the points of the other views.
    """
    v, params = apart.view, whole.params.copy()
    placed = None if apart.placed is None else resect(found, others, parts[0], v)
    if placed is not None and not placed.meets:
        placed = None
    if placed is not None:
        params[v] = placed.params
    sensors = found.problem.cameras.unknowns.corrected(params, others.views)
    names = "view", "inlier", "held_out", "residuals_before", "residuals", "held_out_rms", "held_out_noise"
    new = {name: getattr(whole, name).copy() for name in names}
    new["gcp_w"] = np.where(others.gcps.view == v, np.nan, whole.gcp_w)
    if others.reference is not None:
        new["reference_w"] = np.where(others.reference.points.view == v, np.nan, whole.reference_w)
    for part in parts:
        ties = (part.view == v) & (part.point < part.num_tracks)
        rows, ground = part.order[ties], ground_from_ecef(whole.points[part.point[ties]])
        new["view"][rows], new["held_out"][rows] = v, part is parts[1]
        new["residuals_before"][rows] = others.views[v].sensor.project(ground) - part.xy[:, ties].T
        new["residuals"][rows] = sensors[v].project(ground) - part.xy[:, ties].T
    if placed is not None:
        new["inlier"][parts[0].order[placed.rows]] = placed.agree
        measured = measure(found.problem, params, parts[1])
        new["held_out_noise"][v], new["held_out_rms"][v] = measured.noise[v], measured.rms[v]
    scale, odd = whole.prior.scale.copy(), whole.prior.odd.copy()
    scale[v], odd[v] = apart.scale, apart.scale > 1.0
    tested = replace(whole.prior, scale=scale, odd=odd)
    as_resected = replace(apart, placed=placed)
    return replace(whole, apart=as_resected, params=params, sensors=sensors, prior=tested, **new)


def _adjustment(
    model: SelectedModel, found: Solution, options: AdjustOptions, common: CommonErrors | None
) -> Adjustment:
    """Assemble the `Adjustment`, with points and observations in the order of the input tracks."""
    parts, outcome, final = model.parts, found.outcome, found.final
    block = parts.inner
    covariance = outcome.covariance(found.problem.free)
    if common is not None:
        covariance = replace(covariance, shared=common.respond(outcome.problem, final, outcome.weight, covariance))
    method = covariance.factor.method
    cameras, is_tie = found.problem.cameras, found.problem.structure.point < block.num_tracks
    points, before, after = _points_and_residuals(found, parts)
    inlier = block.in_order(outcome.inlier)
    of_reference = 0 if block.reference is None else len(block.reference.points.view)
    ties = slice(0, len(inlier) - len(block.gcps.view) - of_reference)
    gauge, shares = _scene_accuracy(found, block, covariance)
    return Adjustment(
        names=block.names,
        sensors=cameras.unknowns.corrected(final.params, block.views),
        params=final.params,
        points=points[: block.num_tracks],
        residuals_before=before[ties],
        residuals=after[ties],
        inlier=inlier[ties],
        held_out=parts.outer.in_order(np.ones(len(parts.outer.view), dtype=bool))[ties],
        held_out_rms=found.after.rms,
        held_out_noise=found.after.noise,
        view=parts.block.in_order(parts.block.view)[ties],
        noise=outcome.noise,
        cost_history=final.history,
        steps=len(final.history) - outcome.passes,
        status=f"{outcome.passes} passes of cutting; {outcome.status}; {method} factorisation",
        cameras=cameras,
        covariance=covariance,
        gauge=gauge,
        datum=shares,
        prior=outcome.prior,
        told=outcome.told,
        smooth=outcome.smooth,
        asked=found.asked,
        findings=tuple(_reported_findings(found, parts, points)),
        moving=parts.block.in_order(parts.group > 0)[ties],
        left=(*unexplained_intervals(outcome, block, options.noise_floor), *parts.mostly_moving(outcome.inlier)),
        alike=_neighbour_correlation(block, outcome, is_tie),
        in_space_rms=model.in_space_rms,
        changed=model.changed,
        two_groups=two_groups(found.problem.structure, outcome.residual, outcome.by_point, outcome.inlier & is_tie),
        held=found.heights.weak[: block.num_tracks],
        terrain=found.heights.test(final.points, found.seen),
        left_out=block.left_out,
        deformed=found.deformed,
        **_control(found, block, covariance, inlier[ties.stop :]),
        options=options,
    )


def _points_and_residuals(found: Solution, parts: Parts) -> tuple[Array, Array, Array]:
    """Return the points (P, 3) [m], NaN without an inlier, and the residuals of all observations before and after.

    Points of check tracks and moving groups are triangulated with fixed cameras.
    """
    outer, cameras = parts.outer, (found.problem.camera_prior.mean, found.final.params)
    moving = [measure(found.problem, params, parts.moving) for params in cameras]
    points = np.where(found.seen[:, None], found.final.points, np.nan)
    for one in (found.after, moving[1]):
        points[one.index] = one.points
    inner = found.before, found.outcome.residual
    before, after = (
        parts.inner.in_order(one.T) + outer.in_order(out.residual.T) + parts.moving.in_order(of_moving.residual.T)
        for one, out, of_moving in zip(inner, (found.start, found.after), moving, strict=True)
    )
    return points, before, after


def _neighbour_correlation(block: Block, outcome: Outcome, is_tie: BoolArray) -> Array:
    """Return the evidence (N,) [nats] that rejected tie points of a view have residuals like their neighbours."""
    wrong = is_tie & block.use & ~outcome.inlier & np.isfinite(outcome.residual).all(axis=0)
    return neighbours_alike(block.view[wrong], block.xy[:, wrong], outcome.residual[:, wrong], len(block.views))


def _reported_findings(found: Solution, parts: Parts, points: Array) -> Iterator[Finding]:
    """Yield the findings for the report; moving groups get their position and displacement."""
    number = 0
    for one in found.findings:
        if one.moved is None:
            yield one
        else:
            number += 1
            size = largest_offset(found, parts.block.without(parts.group != number)) * one.moved.ground.pixel
            moved = replace(one.moved, metres=max(one.moved.metres, size))
            yield replace(one, moved=None, motion=parts.motion(number, moved, points))


def _control(found: Solution, block: Block, covariance: Covariance, inlier: BoolArray) -> dict[str, Any]:
    """Return the fields of `Adjustment` on GCPs and reference points; `inlier` (M + R,) has their observations."""
    w, gcps = block.in_order(_control_w(found, block, covariance.of_noise)), len(block.gcps.view)
    w = w[len(w) - len(inlier) :]
    return {
        "control": found.tested,
        "gcp_inlier": inlier[:gcps],
        "reference_inlier": inlier[gcps:],
        "gcp_w": w[:gcps],
        "reference_w": w[gcps:],
        "gcp_residuals": enu_offsets(found.final.points[block.num_tracks : block.num_known], block.gcps.lonlatalt),
    }


def _control_w(found: Solution, block: Block, covariance: Covariance) -> Array:
    """Return Baarda's w (K,) of observations of points with priors; NaN for outliers, and for those not sampled."""
    outcome, w = found.outcome, np.full(len(block.point), np.nan)
    prior = outcome.problem.point_prior
    has_prior = outcome.inlier & (False if prior is None else np.isin(block.point, prior.index))
    of_gcps = np.flatnonzero(has_prior & (block.point >= block.num_tracks) & (block.point < block.num_known))
    others = np.flatnonzero(has_prior & (block.point >= block.num_known))
    rows = np.union1d(of_gcps, others[evenly(len(others))])
    if len(rows):
        at_end = (found.final, outcome.residual, outcome.weight)
        w[rows] = image_test(covariance, outcome.problem, *at_end, rows)
    return w


def _scene_accuracy(found: Solution, block: Block, covariance: Covariance) -> tuple[GaugeReport, Mapping[str, Array]]:
    """Return motion and accuracy of the scene (in a continued run, of the earlier one), and the shares of sources."""
    known, outcome = (block.num_tracks, block.num_known), found.outcome
    gauge = _with_survey_errors(_datum_report(found, block, covariance), found, block)
    shares = datum_shares(covariance, gauge.by_unknown, outcome.problem, found.final, outcome.weight, known)
    return gauge, shares


def _with_undetectable(whole: Adjustment, found: Solution, block: Block) -> Adjustment:
    """Return the result; for two images without findings, with the uncertainty by undetectable displacements."""
    cameras = found.problem.cameras
    index = np.flatnonzero(np.isfinite(whole.points[:, 0]) & ~whole.held)
    other = any(isinstance(sensor, Radar) for sensor in cameras.sensors) or found.problem.joint_prior is not None
    if len(cameras.sensors) != 2 or other or whole.findings or len(index) < MANY:
        return whole
    points, terrain = whole.points[index[evenly(len(index))]], found.heights.dem
    ground, known = ground_from_ecef(points), np.full(len(points), np.nan)
    if terrain is not None and whole.terrain is not None and whole.terrain.shows and whole.terrain.agrees:
        known = np.asarray(terrain(ground[:, 0], ground[:, 1]), dtype=np.float64)
    _, pull, image = height_derivatives(cameras, whole.params, (0, 1), points)
    sizes = np.array([view.size for view in block.views], dtype=np.float64)
    # a residual is half the offset of two rays; the sample stands for all points
    sigma = float(whole.rmse().sum() * np.sqrt(len(points) / len(index)))
    unseen = unseen_steps(sizes, ground, image, pull, (sigma, whole.options.noise_floor), known)
    held = bool(found.heights.kinds) or whole.altimetry is not None
    return replace(whole, unseen=unseen, gauge=with_unseen(whole.gauge, points, unseen.heights(image, pull), held))


def _with_survey_errors(gauge: GaugeReport, found: Solution, block: Block) -> GaugeReport:
    """Return the accuracy of the scene with the common errors of GCPs, as from one survey.

    Any number of GCPs weighs at most as much as `MAX_INDEPENDENT_ERRORS` independent ones.
    """
    used = np.ones(len(block.gcps.names), dtype=bool) if found.tested is None else found.tested.used
    if not found.heights.has_control or used.sum() <= MAX_INDEPENDENT_ERRORS:
        return gauge
    common = np.median(block.gcps.sigma[used], axis=0) ** 2 * (1.0 / MAX_INDEPENDENT_ERRORS - 1.0 / used.sum())
    motions = gauge.motion_sigma.copy()
    motions[:3] = np.sqrt(motions[:3] ** 2 + common)
    return replace(gauge, sigma=np.sqrt(gauge.sigma**2 + common), motion_sigma=motions)


def _datum_report(found: Solution, block: Block, covariance: Covariance) -> GaugeReport:
    """Return motion and accuracy of the scene, without common errors of GCPs."""
    joint = found.problem.joint_prior
    if joint is not None and joint.scene is not None:
        return earlier_scene(covariance, joint, joint.scene, found.final.params)
    number = np.arange(len(found.seen))
    # control does not move with the cameras: it represents the scene only if there are no tracks
    kinds = (found.seen & (number < last) for last in (block.num_tracks, block.num_known, len(number)))
    counted = next((kind for kind in kinds if kind.any()), found.seen)
    prior = found.outcome.problem.camera_prior.sigma
    before = found.first_points(block, counted)
    return gauge_report(covariance, found.final.points, before, counted, prior)
