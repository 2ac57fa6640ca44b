"""The result of an adjustment, the prior that it gives a later run, and the height accuracy of pairs of views."""

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
from barpc.base.statistics import MANY, evenly
from barpc.scene import BoolArray, IntArray
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.image_corrections import ImageAffine, ImageCorrected, RowSpline, Splined


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Corrections of a block of N views, with their uncertainty and the results of tests.

    Parameters
    ----------
    names : tuple of str
        Names of the views, in the order given.
    sensors : tuple of SensorModel
        Corrected camera (P_BA) of each view: the delivered sensor with its correction.
    params : (N, q)
        Unknowns in metres (px for image models), see `barpc.ba.parameters.unknowns`.
    points : (P, 3)
        Ground points of the tracks, ECEF [m]; NaN for a track without inliers.
    residuals_before, residuals : (K, 2)
        Projected - observed [px], in the order of the tracks given. Before: with delivered cameras (after an earlier
        block, those of its result) and points triangulated with them.
    inlier : (K,)
        Mask of the observations that were kept.
    held_out : (K,)
        Mask of the observations of check tie points. Their residuals are from points triangulated with fixed cameras.
    held_out_rms, held_out_noise : (N,)
        RMS residual [px] of the check observations of each view, from their median, and the ratio of this to the
        stated one; NaN without such observations.
    view : (K,)
        View of each observation.
    noise : float
        Ratio of the observed to the stated standard deviation of the observations.
    cost_history : tuple of float
        Sum of squared whitened residuals at each linearisation, and at the end of each pass of outlier rejection.
    steps : int
        Number of linearisations in all passes.
    status : str
        Summary of the solver runs, one line.
    cameras : Cameras
        The cameras and the layout of their unknowns.
    covariance : Covariance
        Covariance of corrections, points and relative heights.
    gauge : GaugeReport
        Shift of the scene, its standard deviation, and the weakest modes.
    datum : mapping
        Source (`barpc.ba.constraints.gauge.SOURCES`) -> share (10,) of the information on the `MOTIONS` of the scene.
    prior : PriorTest
        Comparison of the corrections with the given priors, and the estimated priors.
    told : (N,)
        Information of the tie points of each view [1/px^2], not limited by the common error of the view.
    smooth : SmoothTest
        Systematic (smooth) part of the final residuals, and its test.
    asked : mapping
        "drift" or "jitter" -> systematic residuals for which the degree was raised, or splines and steps were added.
    findings : tuple of Finding
        Additional terms and moving groups that explain residuals, in order of selection.
    moving : (K,)
        Mask of the observations of tie points on ground that moved; they were excluded.
    left : tuple of Interval
        Intervals of rows and columns with significantly more rejected tie points, or larger residuals, than elsewhere.
    alike : (N,)
        Evidence for each view [nats] that neighbouring rejected tie points have similar residuals, unlike wrong matches
        (`barpc.ba.evidence.scan.neighbours_alike`).
    in_space_rms : float or None
        If an affine in the image was selected: RMS of check tie points with rotation, translation and drift instead
        [px].
    changed : float
        Displacement of images relative to each other by additional terms [px]: the largest median over an eighth of
        the rows or columns. 0 without additional terms.
    two_groups : tuple of TwoGroups
        Pairs of views whose tie points fall into two groups.
    held : (P,)
        Mask of the tracks constrained in height because their convergence angle is too small.
    terrain : TerrainTest or None
        Comparison of the DEM with the tie points; None without a DEM.
    altimetry : AltimetryTest or None
        Result of the registration to altimetry; None without altimetry.
    left_out : tuple of str
        Views outside the largest connected group (`keep_largest`); they keep their cameras.
    apart : ForeignCamera or None
        A view whose RPC does not match the image. The others were adjusted without it; it was resected on their points,
        or keeps its RPC. Its residuals and inliers refer to these points; in the covariance it has its prior. Nothing
        was changed if several views are candidates.
    control : ControlTest or None
        Tests of the GCPs against each other and the cameras.
    gcp_w, reference_w : (M,), (R,)
        Baarda's w of the observations of GCPs and of reference points (`control.snooping.image_test`). NaN for outliers
        and for points without a prior; of a large reference, only a sample is tested.
    gcp_inlier : (M,)
        Mask of the observations of GCPs that were kept.
    reference_inlier : (R,)
        Mask of the observations of reference points that were kept.
    gcp_residuals : (G, 3)
        Adjusted minus given positions of the GCPs, east, north, up [m].
    seconds : float
        CPU time.
    common : CommonErrors or None
        Errors common to several images; the covariance includes them.
    deformed : Deformation or None
        A deformation of an image by control that tie points do not confirm; then only tie points determined the drift
        priors.
    unseen : UnseenSteps or None
        For two images without findings: undetectable displacements of rows and columns; `gauge` includes them.
    earlier : BlockPrior or None
        Marginal prior from an earlier block on those of its views that are among these.
    options : AdjustOptions
        The options given.
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
        """Image correction of each view, applied after its camera; None: there is none."""
        return tuple(sensor.correction if isinstance(sensor, Splined) else None for sensor in self.sensors)

    @property
    def bases(self) -> tuple[SensorModel, ...]:
        """The sensors without these image corrections."""
        return tuple(sensor.sensor if isinstance(sensor, Splined) else sensor for sensor in self.sensors)

    @property
    def corrections(self) -> tuple[Correction | ImageAffine, ...]:
        """The correction of the camera of each view."""
        found = []
        for sensor in self.bases:
            assert isinstance(sensor, Corrected | ImageCorrected)
            found.append(sensor.correction)
        return tuple(found)

    @property
    def observations(self) -> IntArray:
        """Number of inliers of each view (N,)."""
        return np.bincount(self.view[self.inlier], minlength=len(self.names))

    def rmse(self, before: bool = False) -> Array:
        """Return the root mean square reprojection error (N,) [px] of the inliers of each view."""
        residual = self.residuals_before if before else self.residuals
        square = (residual[self.inlier] ** 2).sum(axis=1)
        total = np.bincount(self.view[self.inlier], square, len(self.names))
        with np.errstate(invalid="ignore"):
            rmse: Array = np.sqrt(total / self.observations)
        return rmse


@dataclass(frozen=True)
class PairHeights:
    """Standard deviations of heights measured in two views, due to the uncertainty of their corrections alone.

    Parameters
    ----------
    views : tuple of int
        The pair.
    absolute : float
        Standard deviation of a height [m].
    relative : float
        Standard deviation of a height relative to the mean height of the common tie points [m].
    count : int
        Number of tie points at which these were evaluated.
    """

    views: tuple[int, int]
    absolute: float
    relative: float
    count: int


def pair_heights(adjustment: Adjustment, first: int, second: int) -> PairHeights:
    """Return the height uncertainty of a pair at the tie points seen in both views.

    Parameters
    ----------
    adjustment : Adjustment
        A result of `barpc.ba.adjust_tracks`.
    first, second : int
        Indices of the views.

    Returns
    -------
    PairHeights
        NaN if the views share no point.
    """
    structure = adjustment.covariance.reduced.structure
    by_view = [structure.point[slice(*structure.bounds[v : v + 2])] for v in (first, second)]
    seen = np.intersect1d(by_view[0], by_view[1])
    seen = seen[seen < len(adjustment.points)]
    seen = seen[np.isfinite(adjustment.points[seen, 0])]
    if not len(seen):
        return PairHeights((first, second), np.nan, np.nan, 0)
    points = adjustment.points[seen[evenly(len(seen), MANY)]]
    n, pair = len(points), (min(first, second), max(first, second))
    cameras, params = adjustment.cameras, adjustment.params
    by_camera, pull, image = height_derivatives(cameras, params, pair, points)
    by_camera, covariance = by_camera.reshape(n, -1), adjustment.covariance.joint(np.array(pair))
    if adjustment.common is not None:
        by_camera, covariance = _extended_by_common(adjustment, pair, points, (by_camera, pull, covariance))
    if adjustment.unseen is not None:
        steps = adjustment.unseen.heights(image, pull)
        by_camera, covariance = np.hstack([by_camera, steps]), la.block_diag(covariance, np.eye(steps.shape[1]))
    relative = by_camera - by_camera.mean(axis=0)
    return PairHeights(
        (first, second), _rms_uncertainty(by_camera, covariance), _rms_uncertainty(relative, covariance), n
    )


def _extended_by_common(
    adjustment: Adjustment, pair: tuple[int, int], points: Array, given: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """Return the derivatives of heights by unknowns and common errors, and the joint covariance of these."""
    common, (by_camera, pull, covariance) = adjustment.common, given
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
    """Return the derivatives of heights measured in two views, and the image points.

    Parameters
    ----------
    cameras : Cameras, of N views
    params : (N, q), their unknowns
    pair : (int, int), the views, ascending
    points : (n, 3), ECEF [m]

    Returns
    -------
    by_unknown, pull, image : (n, 2, q), (n, 2, 2), (n, 2, 2)
        Derivatives by the unknowns of each view, and by its image points [m/px]; image points [px].
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
    """Return the prior for a later run; after a run that continued an earlier block, it has the views of both.

    Parameters
    ----------
    adjustment : Adjustment
        A finished block.

    Returns
    -------
    BlockPrior
    """
    reduced, n = adjustment.covariance.reduced, len(adjustment.names)
    used = ~np.isin(adjustment.names, adjustment.left_out)  # left-out views were not adjusted, and may be added later
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
    """Return the displacements (n,) [px] of the cameras of a block by its extension with other views.

    Parameters
    ----------
    before, after : BlockPrior
        A block of n views, and the extended one, which begins with these.
    places : (n, 3)
        Ground point at the middle of each image, ECEF [m].
    pixel : (n,)
        Pixel size on the ground there [m].

    Returns
    -------
    moved : (n,)
        Largest displacement of first, middle and last row across the line of sight; an upper bound for image models.
    """
    change, n = after.params[: len(before.names)] - before.params, len(before.names)
    if not {"rotation", "translation"} & set(before.model.split("+")):
        return np.asarray(np.abs(change).sum(axis=1))
    rotates, translates = (word in before.model for word in ("rotation", "translation"))
    rotation = change[:, :3] if rotates else np.zeros((n, 3))
    translation = change[:, 3 * rotates : 3 * rotates + 3] if translates else np.zeros((n, 3))
    first = 3 * (rotates + translates)
    drift = change[:, first : first + 3 * before.drift].reshape(n, before.drift, 3)
    sight = places - before.center
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    up = enu_basis(ground_from_ecef(places))[:, 2]
    # pixel size across the line of sight
    side = pixel * np.sqrt(np.abs((sight * up).sum(axis=1)))
    most = np.zeros(n)
    for row in (-1.0, 0.0, 1.0):
        powers = row ** np.arange(1, before.drift + 1)
        vector = rotation + np.einsum("d,ndx->nx", powers, drift)
        moved = np.cross(vector, sight) - translation
        moved -= (moved * sight).sum(axis=1, keepdims=True) * sight
        most = np.maximum(most, np.linalg.norm(moved, axis=1))
    return np.asarray(most / side)
