"""The result of an adjustment, the prior of a later run, and the height accuracy of pairs of views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg as la

from barpc.ba.altimetry import AltimetryTest
from barpc.ba.constraints.gauge import GaugeReport
from barpc.ba.constraints.ground import TerrainTest
from barpc.ba.constraints.incremental import BlockPrior
from barpc.ba.constraints.shape import Deformation
from barpc.ba.control.snooping import ControlTest
from barpc.ba.evidence.scan import Interval
from barpc.ba.interior import CommonErrors
from barpc.ba.parameters.priors import EarlierScene
from barpc.ba.parameters.projected import Cameras
from barpc.ba.robust.consensus import TwoGroups
from barpc.ba.robust.systematic_residuals import SmoothTest
from barpc.ba.robust.variances import PriorTest
from barpc.ba.select.foreign_camera import ForeignCamera
from barpc.ba.solving.covariance import Covariance
from barpc.ba.terms.term import Finding
from barpc.ba.unseen import UnseenSteps
from barpc.base.geodesy import Array, enu_basis, ground_from_ecef
from barpc.base.options import AdjustOptions
from barpc.base.statistics import MANY
from barpc.scene import BoolArray, IntArray
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.image_corrections import ImageAffine, ImageCorrected, RowSpline, Splined


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Corrections of a block of views, and how far they can be trusted.

    Parameters
    ----------
    names : tuple of str
        Views, as given.
    sensors : tuple of SensorModel
        P_BA of every view: the delivered sensor behind its correction.
    params : (N, q)
        The unknowns in metres (or px for image models), see `barpc.ba.parameters.unknowns`.
    points : (P, 3)
        Ground points of the tracks, ECEF [m]; NaN for a track of which nothing was kept.
    residuals_before, residuals : (K, 2)
        Projected - observed [px], in the order of the tracks given; before: cameras as they came (those of
        an earlier block as it left them), points triangulated with them.
    inlier : (K,)
        Observations that were kept.
    held_out : (K,)
        Observations of check tie points; their residuals are those of points triangulated anew.
    held_out_rms, held_out_noise : (N,)
        Root mean square residual [px] of every view's held-out observations, from their median, and over the
        stated one; NaN without any.
    view : (K,)
        The tracks' views.
    noise : float
        Observed over stated standard deviation of the observations.
    cost_history : tuple of float
        Sum of squared whitened residuals at each linearisation of the passes, and where each pass ended.
    steps : int
        Linearisations of the passes in all.
    status : str
        One line: what the solver did.
    cameras : Cameras
        The views as the solver saw them.
    covariance : Covariance
        Covariance of corrections, points and relative heights.
    gauge : GaugeReport
        Shift of the scene, its standard deviation, the weakest modes.
    datum : mapping
        Source (`barpc.ba.constraints.gauge.SOURCES`) -> its share (10,) of the information on the scene's `MOTIONS`.
    prior : PriorTest
        Comparison of the corrections with the priors given, and the priors learnt.
    told : (N,)
        What tie points tell of each view, before what all of a view share caps it [1/px^2].
    smooth : SmoothTest
        Smooth part of the residuals that are left, with its test.
    asked : mapping
        "drift" or "jitter" -> the smooth part that asked for another degree, or for splines and steps.
    findings : tuple of Finding
        Explanations of tie points beside the cameras' errors as stated, the first taken first.
    moving : (K,)
        Observations of tie points that were found to move together; they were excluded.
    left : tuple of Interval
        Rows and columns in which ties were cut, or are off, more than elsewhere and chance allow, at the end.
    alike : (N,)
        Evidence that neighbours among a view's rejected tie points are displaced in the same direction, which wrong
        matches do
        not (`barpc.ba.evidence.scan.neighbours_alike`) [nats].
    in_space_rms : float or None
        Where an affine in the image was chosen: RMS of held-out tracks under rotations, translations and drifts
        [px].
    changed : float
        By how much the terms beside the plain model move images against each other, the largest median of a band of
        eighths of their rows or columns [px]; 0 for the plain model.
    two_groups : tuple of TwoGroups
        Pairs of views whose tie points fall into two groups.
    held : (P,)
        Tracks constrained in height because their convergence angle is too small.
    terrain : TerrainTest or None
        Result of holding tie points to a terrain; None without one.
    altimetry : AltimetryTest or None
        Result of registering heights without image coordinates; None without any.
    left_out : tuple of str
        Views outside the largest group (`AdjustOptions.keep_largest`); they keep their cameras.
    apart : Apart or None
        A view whose RPC does not match the image: the others were adjusted without it, it alone against their points,
        or not at all. Its points, residuals and observations kept are by these; in the covariance it is as its prior.
        Where it may be one of several, nothing was done.
    control : ControlTest or None
        Ground control points against each other and the cameras.
    gcp_w, reference_w : (M,), (R,)
        Baarda's w of the observations of GCPs and of a reference's points (`control.snooping.image_test`);
        NaN for those that do not count, and of a large reference for all but every n-th.
    gcp_inlier : (M,)
        Observations of GCPs that were kept.
    reference_inlier : (M,)
        Observations of a reference's points that were kept.
    gcp_residuals : (G, 3)
        East, north, up [m] of the adjusted GCPs minus their given place.
    seconds : float
        CPU time.
    common : CommonErrors or None
        Errors that images have in common, which are in the covariance.
    deformed : Deformation or None
        A deformation of an image by control, which tie points do not show; drifts were held to what these show.
    unseen : UnseenSteps or None
        Of two images without findings: displaced rows and columns that nothing would have shown; they are in `gauge`.
    earlier : BlockPrior or None
        What an earlier block knew of those of its views that are among these.
    options : AdjustOptions
        As given.
    """

    names: tuple[str, ...]
    sensors: tuple[SensorModel, ...]
    params: Array
    points: Array
    residuals_before: Array
    residuals: Array
    inlier: BoolArray
    held_out: BoolArray
    held_out_rms: Array
    held_out_noise: Array
    view: IntArray
    noise: float
    cost_history: tuple[float, ...]
    steps: int
    status: str
    cameras: Cameras
    covariance: Covariance
    gauge: GaugeReport
    datum: Mapping[str, Array]
    prior: PriorTest
    told: Array
    smooth: SmoothTest
    asked: Mapping[str, SmoothTest]
    findings: tuple[Finding, ...]
    moving: BoolArray
    left: tuple[Interval, ...]
    alike: Array
    in_space_rms: float | None
    changed: float
    two_groups: tuple[TwoGroups, ...]
    held: BoolArray
    terrain: TerrainTest | None
    left_out: tuple[str, ...]
    control: ControlTest | None
    gcp_w: Array
    reference_w: Array
    gcp_inlier: BoolArray
    reference_inlier: BoolArray
    gcp_residuals: Array
    options: AdjustOptions = field(repr=False)
    seconds: float = 0.0
    apart: ForeignCamera | None = None
    altimetry: AltimetryTest | None = None
    earlier: BlockPrior | None = field(default=None, repr=False)
    common: CommonErrors | None = field(default=None, repr=False)
    deformed: Deformation | None = None
    unseen: UnseenSteps | None = None

    def __repr__(self) -> str:
        used = f"{np.count_nonzero(self.inlier)} of {len(self.inlier)} observations"
        return f"Adjustment({len(self.names)} views, {len(self.points)} tie points, {used}: {self.status})"

    @property
    def splines(self) -> tuple[RowSpline | None, ...]:
        """Corrections in the image behind each view's camera; None: nothing."""
        return tuple(sensor.correction if isinstance(sensor, Splined) else None for sensor in self.sensors)

    @property
    def bases(self) -> tuple[SensorModel, ...]:
        """The sensors without corrections that act in the image alone."""
        return tuple(sensor.sensor if isinstance(sensor, Splined) else sensor for sensor in self.sensors)

    @property
    def corrections(self) -> tuple[Correction | ImageAffine, ...]:
        """The correction of every view."""
        found = []
        for sensor in self.bases:
            assert isinstance(sensor, Corrected | ImageCorrected)
            found.append(sensor.correction)
        return tuple(found)

    @property
    def observations(self) -> IntArray:
        """Observations kept, of every view (N,)."""
        return np.bincount(self.view[self.inlier], minlength=len(self.names))

    def rmse(self, before: bool = False) -> Array:
        """Return the root mean square reprojection error (N,) [px] of every view's kept observations."""
        residual = self.residuals_before if before else self.residuals
        square = (residual[self.inlier] ** 2).sum(axis=1)
        total = np.bincount(self.view[self.inlier], square, len(self.names))
        with np.errstate(invalid="ignore"):
            rmse: Array = np.sqrt(total / self.observations)
        return rmse


@dataclass(frozen=True)
class PairHeights:
    """Standard deviations of heights measured in two views, from the uncertainty of their corrections alone.

    Parameters
    ----------
    views : tuple of int
        The pair.
    absolute : float
        Standard deviation of a height [m].
    relative : float
        Standard deviation of a height against the mean height of the pair's tie points [m].
    count : int
        Tie points that it was evaluated at.
    """

    views: tuple[int, int]
    absolute: float
    relative: float
    count: int


def pair_heights(adjustment: Adjustment, first: int, second: int) -> PairHeights:
    """Return the height uncertainty of a pair at the tie points that both views see.

    Parameters
    ----------
    adjustment : Adjustment
        A result of `barpc.ba.adjust_tracks`.
    first, second : int
        Indices of the views.

    Returns
    -------
    PairHeights
        NaN where the views share no point.
    """
    structure = adjustment.covariance.reduced.structure
    by_view = [structure.point[slice(*structure.bounds[v : v + 2])] for v in (first, second)]
    seen = np.intersect1d(by_view[0], by_view[1])
    seen = seen[seen < len(adjustment.points)]
    seen = seen[np.isfinite(adjustment.points[seen, 0])]
    if not len(seen):
        return PairHeights((first, second), np.nan, np.nan, 0)
    points = adjustment.points[seen[:: len(seen) // MANY + 1]]
    n, pair = len(points), (min(first, second), max(first, second))
    cameras, params = adjustment.cameras, adjustment.params
    by_camera, pull, image = height_derivatives(cameras, params, pair, points)
    by_camera, covariance = by_camera.reshape(n, -1), adjustment.covariance.joint(np.array(pair))
    if adjustment.common is not None:
        by_camera, covariance = _with_common(adjustment, pair, points, (by_camera, pull, covariance))
    if adjustment.unseen is not None:
        steps = adjustment.unseen.heights(image, pull)
        by_camera, covariance = np.hstack([by_camera, steps]), la.block_diag(covariance, np.eye(steps.shape[1]))
    relative = by_camera - by_camera.mean(axis=0)
    return PairHeights(
        (first, second), _rms_uncertainty(by_camera, covariance), _rms_uncertainty(relative, covariance), n
    )


def _with_common(
    adjustment: Adjustment, pair: tuple[int, int], points: Array, known: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Return the derivative of heights by unknowns and by errors in common, and the covariance of both together."""
    common, (by_camera, pull, covariance) = adjustment.common, known
    assert common is not None
    assert adjustment.covariance.shared is not None
    shared = adjustment.covariance.shared.by_unknown
    ground, direct = ground_from_ecef(points), np.zeros((shared.shape[1], len(points)))
    for at, view in enumerate(pair):
        col = adjustment.sensors[view].project(ground)[:, 0]
        direct += (common.moved(np.full(len(col), view), col) * pull[:, at]).sum(axis=2)
    moves = shared.reshape(len(adjustment.names), -1, shared.shape[1])[list(pair)].reshape(-1, shared.shape[1])
    both = np.concatenate([moves, np.eye(shared.shape[1])])
    whole = both @ both.T
    whole[: len(moves), : len(moves)] = covariance
    return np.concatenate([by_camera, direct.T], axis=1), whole


def height_derivatives(
    cameras: Cameras, params: Array, pair: tuple[int, int], points: Array
) -> tuple[Array, Array, Array]:
    """Return the derivatives of heights that two views measure, and where these see the points.

    Parameters
    ----------
    cameras : Cameras, of N views
    params : (N, q), their unknowns
    pair : (int, int), the views, ascending
    points : (n, 3), ECEF [m]

    Returns
    -------
    by_unknown, pull, image : (n, 2, q), (n, 2, 2), (n, 2, 2)
        Derivatives by the unknowns of either view, and by its image points [m/px]; image points [px].
    """
    n, num, ground = len(points), len(cameras.sensors), ground_from_ecef(points)
    image = np.stack([cameras.sensors[view].project(ground) for view in pair], axis=1)
    cameras = cameras.seeing(image.swapaxes(0, 1).reshape(-1, 2).T)
    bounds = np.searchsorted(np.repeat(pair, n), np.arange(num + 1))
    projected = cameras.project(params, np.concatenate([points, points]).T, bounds)
    by_point = projected.by_point.reshape(2, 3, 2, n).transpose(3, 2, 0, 1)  # point, view, coordinate, axis
    by_unknown = projected.by_unknown.reshape(2, -1, 2, n).transpose(3, 2, 0, 1)
    up = enu_basis(ground)[:, 2]
    stacked = by_point.reshape(n, 4, 3)
    normal = np.swapaxes(stacked, 1, 2) @ stacked
    weights = np.linalg.solve(normal, up[..., None])[..., 0]
    pull = np.einsum("nvca,na->nvc", by_point, weights)
    return -np.einsum("nvc,nvcq->nvq", pull, by_unknown), pull, image


def _rms_uncertainty(rows: Array, covariance: Array) -> float:
    return float(np.sqrt(np.einsum("ni,ij,nj->n", rows, covariance, rows).mean()))


def block_prior(adjustment: Adjustment) -> BlockPrior:
    """Return the prior that a later run starts from: of a run that goes on from a block, of all views of both.

    Parameters
    ----------
    adjustment : Adjustment
        A finished block.

    Returns
    -------
    BlockPrior
    """
    reduced, n = adjustment.covariance.reduced, len(adjustment.names)
    used = ~np.isin(adjustment.names, adjustment.left_out)  # others are as they came, and may be given again
    free = adjustment.covariance.free & np.repeat(used, len(adjustment.covariance.free) // n)
    waves = adjustment.cameras.unknowns.waves
    views, matrix = np.flatnonzero(free.reshape(n, -1)[:, 0]), reduced.matrix
    found = BlockPrior(
        tuple(adjustment.names[v] for v in views),
        adjustment.cameras.unknowns.model,
        adjustment.cameras.unknowns.drift,
        adjustment.params[views],
        reduced.plain(free) if isinstance(matrix, np.ndarray) else matrix.select(views),
        adjustment.cameras.unknowns.center[views],
        None if isinstance(matrix, np.ndarray) or reduced.common is None else reduced.common.by_camera[:, free],
        None if waves is None else waves.select(views),
        EarlierScene(adjustment.gauge.by_unknown[:, free], adjustment.gauge.own, adjustment.gauge.radius),
        adjustment.told[views],
        adjustment.prior.shown,
    )
    if adjustment.earlier is None:
        return found
    return adjustment.earlier.joined(found)


def moved_px(before: BlockPrior, after: BlockPrior, places: Array, pixel: Array) -> Array:
    """Return how far (n,) [px] the cameras of a block move, where it has grown out of another.

    Parameters
    ----------
    before, after : BlockPrior
        A block of n views, and one whose first n views are these.
    places : (n, 3)
        ECEF [m] of a ground point in the middle of each image.
    pixel : (n,)
        Side of a pixel on the ground there [m].

    Returns
    -------
    moved : (n,)
        The largest of the first, middle and last row, across the line of sight; of models in the image an upper bound.
    """
    change, n = after.params[: len(before.names)] - before.params, len(before.names)
    if not {"rotation", "translation"} & set(before.model.split("+")):
        return np.asarray(np.abs(change).sum(axis=1))
    rotates, translates = (word in before.model for word in ("rotation", "translation"))
    turned = change[:, :3] if rotates else np.zeros((n, 3))
    shifted = change[:, 3 * rotates : 3 * rotates + 3] if translates else np.zeros((n, 3))
    first = 3 * (rotates + translates)
    drift = change[:, first : first + 3 * before.drift].reshape(n, before.drift, 3)
    sight = places - before.center
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    up = enu_basis(ground_from_ecef(places))[:, 2]
    # as wide as it is seen, along the line of sight
    side = pixel * np.sqrt(np.abs((sight * up).sum(axis=1)))
    most = np.zeros(n)
    for row in (-1.0, 0.0, 1.0):
        powers = row ** np.arange(1, before.drift + 1)
        vector = turned + np.einsum("d,ndx->nx", powers, drift)
        moved = np.cross(vector, sight) - shifted
        moved -= (moved * sight).sum(axis=1, keepdims=True) * sight
        most = np.maximum(most, np.linalg.norm(moved, axis=1))
    return np.asarray(most / side)
