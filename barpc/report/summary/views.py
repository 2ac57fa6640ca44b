"""The images of a run: their records, how these are measured, and the accuracy of each image's centre."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from operator import attrgetter
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta
from scipy.special import erf

from barpc.ba import Adjustment
from barpc.ba.parameters.priors import USABLE_ACCURACY
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, metres_per_unit
from barpc.fit import RpcFit
from barpc.report.outcome import Run
from barpc.report.records import Cell, Column, Number, Record, column, value_of
from barpc.report.summary.words import ABOVE, CAUSES, STATUS_WORDS, Count, Pixel, Share, Side, Vector, largest
from barpc.scene import IntArray, View
from barpc.sensor.corrected import Corrected
from barpc.sensor.geometry import Several, ground_grids, ground_sample_distance, view_angles
from barpc.sensor.image_corrections import ImageCorrected, RowSpline, Splined
from barpc.sensor.pushbroom import Pushbroom
from barpc.sensor.rpc import RPC
from barpc.sensor.timing import Timed

COVERAGE_CELLS = 8  # Cells of an image from left to right and from top to bottom
_SPLINE_ROWS = 400  # of an image, over which a spline is averaged


class EllipseEntry(Record):
    """Error ellipse of the ground point at the image centre, at a given altitude."""

    major_m: Number = column("Larger semi-axis of the one-sigma ellipse", "m", "major semi-axis", ".2f")
    minor_m: Number = column("Smaller semi-axis", "m", "minor semi-axis", ".2f")
    azimuth_deg: Number = column("Direction of the larger one, clockwise from north", "deg", "azimuth", ".0f")
    ce90_m: Number = column("Radius of the circle that contains 90 %", "m", "CE90", ".2f")


def moved_in_space(
    model: Corrected,
    covariance: Array,
    unknowns: str,
    ground: Array,
    seen: tuple[Array, ...] | None = None,
    shared: tuple[Array, Array] | None = None,
) -> tuple[Array, Array, EllipseEntry]:
    """Return the shift (2,) [px] by P_BA of a ground point near the image centre, its sigma (2,), and its ellipse.

    `covariance` (q, q) is of rotation (metres: angle x distance), translation [m], then any drift, which is zero in the
    middle row; `unknowns`: "rotation", "translation" or "rotation+translation"; `ground` (3,): lon, lat [deg], alt [m].
    `seen`, if known: the result of `project_ecef`, and its projection by the delivered camera. `shared`: what k errors
    that images have in common do with the unknowns (q, k), which `covariance` has, and displace in the image (2, k).
    """
    ecef = ecef_from_ground(ground)
    image, by_point, by_rotation, by_translation, before = seen or (
        *model.project_ecef(ecef),
        model.sensor.project(ground),
    )
    distance = np.linalg.norm(ecef - model.correction.center)
    parts = {"rotation": by_rotation / distance, "translation": by_translation}
    jacobian = np.hstack([part for name, part in parts.items() if name in unknowns])
    return _ground_accuracy(image - before, jacobian, covariance, by_point @ enu_basis(ground)[:2].T, shared)


def moved_by_clocks(model: Timed, covariance: Array, ground: Array) -> tuple[Array, Array, EllipseEntry]:
    """As `moved_in_space`, for radar timing: `covariance` begins with range and position along the flight [m]."""
    image, by_timing = model.timing_jacobian(ground)
    by_level = (model.project_jacobian(ground)[1] / metres_per_unit(ground))[:, :2]
    return _ground_accuracy(
        image - model.sensor.project(ground), by_timing / [1.0, model.sensor.speed], covariance, by_level
    )


def _ground_accuracy(
    moved: Array, jacobian: Array, covariance: Array, by_level: Array, shared: tuple[Array, Array] | None = None
) -> tuple[Array, Array, EllipseEntry]:
    """`jacobian` (2, q): [px] by the first unknowns; `by_level` (2, 2): [px/m] by east and north, at one altitude."""
    q = jacobian.shape[1]
    variance = jacobian @ covariance[:q, :q] @ jacobian.T
    if shared is not None:  # the camera follows displacements of the image: what is left of them counts
        response = jacobian @ shared[0][:q]
        variance += (left := response - shared[1]) @ left.T - response @ response.T
    seen = np.linalg.inv(by_level)
    values, axes = np.linalg.eigh(seen @ variance @ seen.T)
    minor, major = np.sqrt(np.maximum(values, 0.0)).tolist()
    azimuth = float(np.degrees(np.arctan2(axes[0, 1], axes[1, 1]))) % 180.0
    sigma = np.sqrt(np.maximum(np.diag(variance), 0.0))
    return moved, sigma, EllipseEntry(major, minor, azimuth, ce90(major, minor))


def stated_ce90(view: View) -> float | None:
    """Return CE90 [m] of a delivered camera from its stated accuracies per axis; None without any."""
    sensor, sigma = view.sensor, None
    if isinstance(sensor, Pushbroom) and sensor.accuracy is not None:
        sigma = float(np.hypot(*sensor.accuracy))
    elif isinstance(sensor, RPC) and sensor.err_bias is not None and sensor.err_bias > USABLE_ACCURACY:
        sigma = float(np.hypot(sensor.err_bias, sensor.err_rand or 0.0))
    return None if sigma is None else ce90(sigma, sigma)


def ce90(major: float, minor: float) -> float:
    """Return the radius that contains 90 % of a normal distribution with the given standard deviations.

    Examples
    --------
    >>> [round(ce90(1.0, minor), 3) for minor in (1.0, 0.5, 0.0)]
    [2.146, 1.737, 1.645]
    """
    if not major > 0.0:
        return major
    radius, along, weights = _circles()
    with np.errstate(divide="ignore"):
        held = erf(along / (np.sqrt(2.0) * np.float64(minor / major)))
    share = (held * weights).sum(axis=1)  # the integral over x of the share in y
    return major * float(np.interp(0.9, share, radius))  # to some 1e-6


@cache  # every image asks
def _circles() -> tuple[Array, Array, Array]:
    """Return radii [major axes]; across their halves the extent of y at points, and the weight of each, of x."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    angle, radius = 0.25 * np.pi * (nodes + 1.0), np.linspace(1.6, 2.2, 200)[:, None]
    along = radius * np.cos(angle)
    density = np.exp(-0.5 * (radius * np.sin(angle)) ** 2) * along
    return radius[:, 0], along, np.sqrt(2.0 / np.pi) * 0.25 * np.pi * density * weights


class SourceEntry(Record):
    """Source of a camera."""

    format: str = column("Syntax of its file", head="RPC read from")
    path: str = column("File with the camera")
    notes: tuple[str, ...] = column("Remarks")


class CorrectionEntry(Record):
    """Correction of a camera: in space, or by a shift and slope in the image (no `center_shift_px` then)."""

    model: str = column("Unknowns of the adjustment")
    unknowns: tuple[float, ...] = column("In metres (rotation: angle x distance), or px in the image")
    sigma: tuple[float, ...] = column("Their posterior standard deviations, in the same units")
    center_shift_px: Pixel | None = column("Shift at the image centre", "px", "shift col, row", "+.2f", adjusted=True)
    center_sigma_px: Pixel | None = column(
        "Its posterior standard deviation, including that of the scene's position", "px"
    )
    shift_px: Pixel | None = column("Models in the image: shift col, row", "px", default=None)
    slope: tuple[Pixel, ...] | None = column("Models in the image: by (col, row)", "px/px", default=None)
    rotation_urad: Vector | None = column("Rotation vector R, ECEF axes", "urad", default=None)
    angle_urad: Number = column("Angle of R", "urad", "rotation", ".2f", default=None)
    translation_m: Vector | None = column("Translation T, ECEF", "m", default=None)
    translation_norm_m: Number = column("Length of T", "m", "translation", ".2f", default=None)
    drift_urad: tuple[Vector, ...] | None = column("Drift, for each power of the row", "urad", default=None)
    range_m: Number = column("Radar: correction of the range", "m", "range", "+.3f", default=None)
    azimuth_ms: Number = column("Radar: correction of the azimuth time", "ms", "azimuth", "+.4f", default=None)
    timing_sigma: Pixel | None = column("Posterior standard deviations of both, m and ms", default=None)
    timing_slopes: tuple[Pixel, ...] | None = column(
        "Radar: further correction at the end, m and ms, by power", default=None
    )
    jitter_px: Number = column("RMS of the spline over the rows", "px", "jitter", ".2f", default=None)
    jitter_rows: Number = column("Rows between its knots", "px", default=None)
    detector_px: Number = column("RMS of the steps between detectors", "px", "detectors", ".2f", default=None)
    step_px: Number = column("RMS of the displaced rows or columns (steps)", "px", "steps", ".2f", default=None)
    sinusoid_px: Number = column("Amplitude of the sinusoids along the rows", "px", "sinusoids", ".2f", default=None)
    sinusoid_rows: tuple[float, ...] | None = column("Their periods", "px", default=None)
    ellipse: EllipseEntry | None = column(
        "Error ellipse of the image centre, including the scene's position", default=None
    )
    detectors: tuple[float, ...] | None = column("Columns at which another detector begins", "px", default=None)


class CenterEntry(Record):
    """Projection centre of a camera."""

    ecef_m: Vector = column("Position, ECEF", "m")
    altitude_m: Number = column("Altitude above the ellipsoid", "m", "camera centre", ",.0f")
    method: str = column(
        "line: intersection of the rays of an image line; nominal: assumed where implausible", head="centre from"
    )


class FitEntry(Record):
    """The certificate of a refitted RPC: its error against P_BA on independent check points."""

    rmse_px: Pixel = column("Error col, row on check points", "px", "RMSE col, row", ".1e")
    max_px: Pixel = column("Largest error col, row on check points", "px")
    min_denominator: Number = column(
        "Smallest denominator over the image's ground, relative to the centre", "", "smallest denominator", ".3f"
    )
    roundtrip_px: Number = column(
        "Largest change by projection and localisation; null where it fails", "px", "round trip", ".1e"
    )
    coverage: Number = column("Share of the image covered by the fit's points", head="covered", form=".0%")
    method: str = column("Solver", head="solver")
    num_check_points: Count = column("Check points", head="check points")
    localisation_m: Number = column(
        "Largest error of the localisation RPC against P_BA on the ground", "m", default=None
    )


def _moves(view: ViewEntry) -> list[Cell]:
    shift, sigma = (value_of(view, f"correction.center_{what}_px") for what in ("shift", "sigma"))
    return [Cell(f"{value:+.3f} ± {error:.2f}", value) for value, error in zip(shift, sigma, strict=True)]


def _verdict(view: ViewEntry) -> Cell:
    return Cell(STATUS_WORDS[view.status], list(STATUS_WORDS).index(view.status), f"status {view.status}")


class ViewEntry(Record):
    """One image."""

    OWN: ClassVar = {
        "verdict": Column("verdict", _verdict),
        "wrong": Column("reservation", lambda view: CAUSES[view.cause].label if view.cause in CAUSES else None),
        "lost": Column(
            "rejected [%]", lambda view: 100.0 * view.lost if view.num_observations + view.num_rejected else None, ".1f"
        ),
        "moves": Column(("col [px]", "row [px]"), _moves, ".3f"),
        "largest": Column("RPC misfit [px]", lambda view: largest(value_of(view, "fit.max_px")), ".1e", adjusted=True),
    }
    PAGE: ClassVar = (
        "name verdict wrong num_observations num_check lost tie_coverage rmse_before rmse_after held_out_px "
        "correction.center_shift_px gsd_m incidence_deg rpc_source.format"
    )
    TERMINAL: ClassVar = "name verdict num_observations lost rmse_before rmse_after correction.center_shift_px"
    CORRECTIONS: ClassVar = (
        "name moves correction.angle_urad correction.translation_norm_m camera_center.altitude_m camera_center.method"
    )
    PLACES: ClassVar = (
        "name correction.ellipse.major_m correction.ellipse.minor_m correction.ellipse.azimuth_deg "
        "correction.ellipse.ce90_m stated_ce90_m"
    )
    DECISIONS: ClassVar = (
        "name prior_scale num_observations num_check num_rejected num_moving systematic_px systematic_p "
        "neighbour_correlated_px correction.jitter_px correction.detector_px correction.step_px correction.sinusoid_px"
    )
    FOOTPRINT: ClassVar = "name path status num_observations rmse_before rmse_after gsd_m"
    CONTROL: ClassVar = "name control_w control_w_point"
    CLOCKS: ClassVar = " correction.range_m correction.azimuth_ms"
    FITS: ClassVar = (
        "name fit.rmse_px largest fit.min_denominator fit.roundtrip_px fit.coverage fit.num_check_points fit.method"
    )

    @property
    def lost(self) -> float:
        """Share of its tie points that were rejected."""
        return self.num_rejected / max(self.num_rejected + self.num_observations, 1)

    @property
    def counts(self) -> dict[str, int]:
        """Its tie points by their names in all sentences and tables: in use, then others of which it has some."""
        found = {"check": self.num_check, "rejected": self.num_rejected, "excluded": self.num_moving}
        return {"used": self.num_observations, **{name: count for name, count in found.items() if count}}

    @property
    def reservation(self) -> str:
        """Its verdict and advice as a sentence; without meaning for an image without reservation."""
        return f"{self.name}: {STATUS_WORDS[self.status]}: {self.advice}."

    name: str = column("Unique in the run", head="image", min_length=1)
    path: str = column("The image; empty for a view without pixels")
    size: tuple[Side, Side] = column("Width, height", "px")
    alt_range_m: tuple[float, float] = column("Altitude range of the camera", ABOVE)
    rpc_source: SourceEntry | None = column("Source of the camera; null: not from a file")
    gsd_m: Number = column("Ground sampling distance at the image centre", "m", "GSD", ".2f")
    incidence_deg: Number = column("Incidence angle, from the vertical to the sensor", "deg", "incidence", ".1f")
    azimuth_deg: Number = column("Direction to the sensor, clockwise from north", "deg")
    num_observations: Count = column("Tie-point observations in use", head="used")
    num_rejected: Count = column("Observations rejected as outliers", head="rejected")
    num_gcps: Count = column("Observations of ground control points")
    tie_coverage: Share = column("Share of the cells of an 8 x 8 grid with a tie point", head="covered", form=".0%")
    rmse_before: Number = column("RMS reprojection error through the delivered cameras", "px", "before", ".3f")
    rmse_after: Number = column(
        "The same through the new cameras; null for a check", "px", "after", ".3f", adjusted=True
    )
    systematic_px: Number = column("RMS of systematic residuals, noise subtracted", "px", "systematic", ".3f")
    prior_scale: Number = column(
        "Factor by which the camera's stated standard deviations were widened", "", "prior widened", ".1f"
    )
    correction: CorrectionEntry | None = column("The correction; null for a check")
    camera_center: CenterEntry | None = column("Projection centre, about which the camera was rotated")
    fit: FitEntry | None = column("Certificate of the refitted RPC; null where none was fitted")
    outputs: Mapping[Annotated[str, Meta(pattern="^[^/]+$")], Mapping[str, float | str | None]] = column(
        "File -> consumer -> difference to P_BA in px, or the reason without one"
    )
    status: Literal["adjusted", "consistent", "tied", "weak", "doubtful", "failed"] = column("Verdict on the image")
    advice: str = column("Reservation and remedy; empty without reservation")
    cause: str | None = column("Name of the reservation; null without one", default=None, enum=CAUSES)
    num_moving: Count = column("Excluded observations of tie points that move together", head="excluded", default=0)
    num_check: Count = column("Observations of check tie points", head="check", default=0)
    held_out_px: Number = column("RMS of check tie points", "px", "check", ".3f", default=None)
    stated_ce90_m: Number = column("CE90 of the delivered camera", "m", "CE90 stated", ".1f", default=None)
    systematic_p: Number = column(
        "Probability of systematic_px by noise alone (F test)", "", "F test p", ".0e", default=None
    )
    neighbour_correlated_px: Number = column(
        "Error correlated between neighbours in row or column", "px", "correlated", ".3f", default=None
    )
    control_w: Number = column("Largest w of its control (Baarda)", "", "w", ".1f", default=None)
    control_w_point: str | None = column("Control point of that w", head="largest at", default=None)
    date: str | None = column("Acquisition date, where its metadata state it", default=None)
    certified: tuple[tuple[float, float, float, float, float], ...] | None = column(
        "Ground points (lon, lat, alt) and their image points (col, row)", default=None
    )
    gap: tuple[tuple[float, float, float, float], ...] | None = column(
        "Corners of rows or columns with few tie points (lon, lat, col, row)", default=None
    )


# --- measurement ------------------------------------------------------------------------------------------

_SOURCE_FIELDS = attrgetter("format", "path", "notes")
_CENTER = attrgetter("ecef", "altitude", "method")
_FIT = attrgetter("rmse_ckp", "max_ckp", "min_denominator", "roundtrip", "coverage", "method", "num_ckp")


def measure_views(run: Run) -> tuple[ViewEntry, ...]:
    """Return the record of every image of a run, without its verdict."""
    num, tracks, keep, after = len(run.views), run.tracks, run.keep, run.ties_after
    first = rmse_by_view(run.ties_before.residuals[keep], tracks.view[keep], num)
    last = [None] * num if after is None else rmse_by_view(after.residuals[keep], tracks.view[keep], num)
    unused = run.held_out & ~keep  # of a check all that agree with its cameras are in use
    parts = keep, ~(keep | unused | run.moving), run.moving, unused & ~run.moving
    count, cut, moving, check = (np.bincount(tracks.view[rows], minlength=num).tolist() for rows in parts)
    gcps = np.zeros(num, np.int64) if run.gcps is None else np.bincount(run.gcps.view, minlength=num)
    cells = cell_numbers(tracks.xy[keep], np.array([view.size for view in run.views])[tracks.view[keep]])
    filled = np.unique(cells + tracks.view[keep] * COVERAGE_CELLS**2) // COVERAGE_CELLS**2
    covered = np.bincount(filled, minlength=num) / COVERAGE_CELLS**2
    before = Several(run.before, np.arange(num))
    middle = before.localize((np.array([view.size for view in run.views]) - 1) / 2, np.full(num, run.altitude))
    incidence, azimuth = view_angles(before, middle)
    pixel = ground_sample_distance(before, middle)[1]
    control = {test.view: test for test in sorted(run.control_tests, key=lambda test: test.w)}  # the largest is last
    return tuple(
        ViewEntry(
            name=view.name,
            path=view.path,
            size=view.size,
            alt_range_m=view.alt_range,
            rpc_source=SourceEntry(*_SOURCE_FIELDS(run.sources[i])) if run.sources else None,
            gsd_m=float(pixel[i]),
            incidence_deg=float(incidence[i]),
            azimuth_deg=float(azimuth[i]),
            num_observations=count[i],
            num_rejected=cut[i],
            num_moving=moving[i],
            num_check=check[i],
            num_gcps=int(gcps[i]),
            tie_coverage=float(covered[i]),
            rmse_before=first[i],
            rmse_after=last[i],
            camera_center=CenterEntry(*_CENTER(run.centers[i])) if run.centers else None,
            fit=_fit_entry(run.fits[i]) if run.fits else None,
            outputs=dict(run.written[i]) if run.written else {},
            date=view.date or None,
            stated_ce90_m=stated_ce90(view),
            control_w=control[i].w if i in control else None,
            control_w_point=control[i].point if i in control else None,
            gap=_gap_corners(run, i),
            status="adjusted",
            advice="",
            **adjusted,
        )
        for i, (view, adjusted) in enumerate(zip(run.views, _adjustment_values(run, middle), strict=True))
    )


def _gap_corners(run: Run, i: int) -> tuple[tuple[float, float, float, float], ...] | None:
    """Return the corners of the rows or columns of view i with few tie points, by its final camera."""
    if i not in run.gaps:
        return None
    gap, size = run.gaps[i], run.views[i].size
    ends = [(-0.5, length - 0.5) for length in size]
    ends[gap.axis] = gap.first - 0.5, gap.last + 0.5
    (left, right), (top, bottom) = ends
    corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
    ground = (run.after or run.before)[i].localize(corners, np.full(4, run.altitude))[:, :2]
    found = tuple(
        (lon, lat, col, row) for (lon, lat), (col, row) in zip(ground.tolist(), corners.tolist(), strict=True)
    )
    return found if np.isfinite(ground).all() else None


def _fit_entry(fit: RpcFit) -> FitEntry:
    return replace(FitEntry(*_FIT(fit)), localisation_m=None if fit.localisation is None else fit.localisation.max_m)


def _adjustment_values(run: Run, middle: Array) -> list[dict[str, Any]]:
    """Return the results of an adjustment for every image, at the ground points (N, 3) of the image centres.

    `certified`: ground points at its ends, and their projections by its new camera.
    """
    found, num = run.adjustment, len(run.views)
    if found is None:
        return [{"systematic_px": None, "prior_scale": None, "correction": None}] * num
    inner = [model.sensor if isinstance(model, Splined) else model for model in found.sensors]
    behind, seen = Several(inner, np.arange(num)).behind, list[tuple[Array, ...]]()
    if behind is not None:
        seen = list(zip(*behind.project_ecef(ecef_from_ground(middle)), behind.sensor.project(middle), strict=True))
    ends = [(model, view.size, view.alt_range) for model, view in zip(run.cameras, run.views, strict=True)]
    grids = ground_grids(ends, (3, 2)) if run.written else None
    return [
        {
            "systematic_px": found.smooth.rms[i],
            "systematic_p": found.smooth.significance[i],
            "neighbour_correlated_px": found.smooth.shared[i],
            "held_out_px": found.held_out_rms[i],
            "prior_scale": found.prior.scale[i],
            "correction": _correction(found, i, middle[i], seen[i] if seen else None),
            "certified": tuple(map(tuple, grids[i].tolist())) if grids else None,
        }
        for i in range(num)
    ]


def rmse_by_view(residuals: Array, view: IntArray, num_views: int) -> Array:
    """Return RMS of each view (N,) [px]: sqrt(mean(dcol^2 + drow^2)) over those residuals (K, 2) that are not NaN."""
    use = np.isfinite(residuals).all(axis=1)
    squares = np.bincount(view[use], (residuals[use] ** 2).sum(axis=1), minlength=num_views)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(squares / np.bincount(view[use], minlength=num_views)))


def cell_numbers(xy: Array, size: Sequence[int] | IntArray) -> IntArray:
    """Return the cell numbers (n,), of `COVERAGE_CELLS` x `COVERAGE_CELLS` cells, of points (n, 2) [px] in an image.

    `size`: width and height of the image, or (n, 2) of the image of each point [px].
    """
    col, row = ((xy + 0.5) / np.asarray(size) * COVERAGE_CELLS).astype(np.int64).clip(0, COVERAGE_CELLS - 1).T
    return np.asarray(row * COVERAGE_CELLS + col)


def _correction(adjustment: Adjustment, i: int, middle: Array, seen: tuple[Array, ...] | None) -> CorrectionEntry:
    """Return the correction of a view, at the ground point (3,) in the middle of its image; `seen`: if known."""
    whole, model = adjustment.sensors[i], adjustment.cameras.unknowns.model
    sensor, spline = (whole.sensor, whole.correction) if isinstance(whole, Splined) else (whole, None)
    covariance, apart = adjustment.covariance.view(i), adjustment.apart
    strange = apart is not None and apart.is_view(i)  # its prior does not state its accuracy
    if strange and apart is not None and apart.placed is not None:
        covariance = apart.placed.covariance
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    common = (model, adjustment.params[i].tolist(), sigma)
    if isinstance(sensor, Timed):
        moved, uncertain, place = moved_by_clocks(sensor, covariance, middle)
        offset, *slopes = (sensor.correction.coeffs * [1.0, 1e3]).tolist()
        known: dict[str, Any] = {"range_m": offset[0], "azimuth_ms": offset[1], "timing_slopes": slopes}
        known["timing_sigma"] = (np.array(sigma[:2]) / [1.0, sensor.sensor.speed / 1e3]).tolist()
    elif isinstance(sensor, Corrected):
        shared = None if strange else _shared_errors(adjustment, i, middle)
        moved, uncertain, place = moved_in_space(sensor, covariance, model, middle, seen, shared)
        known = {
            "rotation_urad": (sensor.correction.rotation * 1e6).tolist(),
            "angle_urad": float(np.linalg.norm(sensor.correction.rotation)) * 1e6,
            "translation_m": sensor.correction.translation.tolist(),
            "translation_norm_m": float(np.linalg.norm(sensor.correction.translation)),
            "drift_urad": (sensor.correction.drift * 1e6).tolist(),
        }
    else:
        assert isinstance(sensor, ImageCorrected)
        shift, slope = sensor.correction.shift.tolist(), sensor.correction.slope.tolist()
        return CorrectionEntry(*common, None, None, shift_px=shift, slope=slope)
    if not strange or isinstance(sensor, Timed):
        known |= {"center_sigma_px": uncertain.tolist(), "ellipse": place}
    return CorrectionEntry(
        *common, moved.tolist(), **{"center_sigma_px": None, **known, **_image_correction_entry(spline)}
    )


def _shared_errors(adjustment: Adjustment, i: int, ground: Array) -> tuple[Array, Array] | None:
    """Return the response (q, k) of a view's unknowns to common errors, and their displacements (2, k) [px] there."""
    if adjustment.common is None or adjustment.covariance.shared is None:
        return None
    by_unknown = adjustment.covariance.shared.by_unknown.reshape(len(adjustment.names), adjustment.params.shape[1], -1)
    col = adjustment.sensors[i].project(ground[None])[:, 0]
    return by_unknown[i], adjustment.common.moved(np.array([i]), col)[:, 0].T


def _image_correction_entry(spline: RowSpline | None) -> dict[str, Any]:
    """Return the fields of a correction that are displacements in the image."""
    found: dict[str, Any] = {}
    if spline is None:
        return found
    if len(spline.coeffs):
        rows = spline.row_offset + spline.row_scale * np.linspace(-1, 1, _SPLINE_ROWS)
        along = RowSpline(spline.coeffs, spline.row_offset, spline.row_scale).at(np.column_stack([rows, rows]))
        found |= {"jitter_px": _rms_size(along), "jitter_rows": spline.spacing}
    if len(spline.steps):
        found |= {"detector_px": _rms_size(spline.steps), "detectors": tuple((spline.edges + 0.5).tolist())}
    if len(spline.strips):
        found["step_px"] = _rms_size(spline.moved)
    if len(spline.swings):
        size = float(np.sqrt((spline.swings**2).sum()))  # of all together
        found |= {"sinusoid_px": size, "sinusoid_rows": tuple(spline.periods.tolist())}
    return found


def _rms_size(displacement: Array) -> float:
    return float(np.sqrt((displacement**2).sum(axis=-1).mean()))
