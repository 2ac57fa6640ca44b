"""The images of a run, measured: their residuals and corrections, and the accuracy of each image's centre."""

from __future__ import annotations

from functools import cache
from operator import attrgetter
from typing import Any

import numpy as np
from scipy.special import erf

from barpc.ba import Adjustment
from barpc.ba.parameters.priors import USABLE_ACCURACY
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis
from barpc.report.outcome import Run
from barpc.report.summary.views import (
    COVERAGE_CELLS,
    CenterEntry,
    CorrectionEntry,
    EllipseEntry,
    FitEntry,
    SourceEntry,
    ViewEntry,
    cell_numbers,
)
from barpc.scene import IntArray, View
from barpc.sensor.corrected import Corrected
from barpc.sensor.geometry import Several, ground_sample_distance, view_angles
from barpc.sensor.image_corrections import ImageCorrected, RowSpline, Splined
from barpc.sensor.pushbroom import Pushbroom
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import Sample

_SPLINE_ROWS = 400  # of an image, over which a spline is averaged

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
            fit=FitEntry(*_FIT(run.fits[i])) if run.fits else None,
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
    shown = [np.hstack([one.ground, one.image]) for one in (Sample.grids(ends, (3, 2)) if run.written else ())]
    return [
        {
            "systematic_px": found.smooth.rms[i],
            "systematic_p": found.smooth.significance[i],
            "neighbour_correlated_px": found.smooth.shared[i],
            "held_out_px": found.held_out_rms[i],
            "prior_scale": found.prior.scale[i],
            "correction": _correction(found, i, middle[i], seen[i] if seen else None),
            "certified": tuple(map(tuple, shown[i].tolist())) if shown else None,
        }
        for i in range(num)
    ]


def rmse_by_view(residuals: Array, view: IntArray, num_views: int) -> Array:
    """Return RMS of each view (N,) [px]: sqrt(mean(dcol^2 + drow^2)) over those residuals (K, 2) that are not NaN."""
    use = np.isfinite(residuals).all(axis=1)
    squares = np.bincount(view[use], (residuals[use] ** 2).sum(axis=1), minlength=num_views)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(squares / np.bincount(view[use], minlength=num_views)))


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
    if isinstance(sensor, Corrected):
        shared = None if strange else _shared_errors(adjustment, i, middle)
        moved, uncertain, place = moved_in_space(sensor, covariance, model, middle, seen, shared)
        known: dict[str, Any] = {
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
    if not strange:
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
    if len(spline.splines):
        rows = spline.row_offset + spline.row_scale * np.linspace(-1, 1, _SPLINE_ROWS)
        along = RowSpline(spline.splines, spline.row_offset, spline.row_scale).at(np.column_stack([rows, rows]))
        found |= {"jitter_px": _rms_size(along), "jitter_rows": spline.spacing}
    if len(spline.detector_steps):
        edges = tuple((spline.detector_edges + 0.5).tolist())
        found |= {"detector_px": _rms_size(spline.detector_steps), "detectors": edges}
    if len(spline.steps):
        found["step_px"] = _rms_size(spline.step_sizes)
    if len(spline.amplitudes):
        size = float(np.sqrt((spline.amplitudes**2).sum()))  # of all together
        found |= {"sinusoid_px": size, "sinusoid_rows": tuple(spline.periods.tolist())}
    return found


def _rms_size(displacement: Array) -> float:
    return float(np.sqrt((displacement**2).sum(axis=-1).mean()))


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
