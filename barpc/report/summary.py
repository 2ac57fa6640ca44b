"""The summary of a run: what summary.json holds, and what everything else on show is drawn from."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from barpc import __version__
from barpc.ba import Adjustment, check_residuals
from barpc.fit import RpcFit
from barpc.report.measures import (
    PairOffset,
    PairTies,
    coverage,
    ground_sampling,
    pair_geometry,
    pair_offset,
    rmse_by_view,
    shift_in_image,
)
from barpc.report.run import Run
from barpc.report.tables import written_tracks
from barpc.report.verdict import block_verdict, mode_in_words, view_status
from barpc.scene import Tracks
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.geometry import CameraCenter, view_angles
from barpc.tie import PairReport

SCHEMA = 2
"""Version of summary.json; `summary.schema.json` beside this module describes it."""


def summarize(run: Run) -> dict[str, Any]:
    """The summary: what summary.json holds. Only plain numbers, texts, lists and mappings; NaN is null."""
    views = _views(run)
    reports = {report.names: report for report in run.matched}
    block = block_verdict(run, views)
    summary = {
        "schema": SCHEMA,
        "barpc": __version__,
        "kind": run.kind,
        "status": block["status"],
        "headline": block["headline"],
        "verdict": block["lines"],
        "reasons": block["reasons"],
        "passed": block["status"] == "good",
        "out_dir": run.out_dir,
        "altitude_m": run.altitude,
        "views": views,
        "pairs": [_pair(run, ties, reports) for ties in run.pairs],
        "left_out": [{"path": path, "reason": reason} for path, reason in run.left_out],
        "tracks": _tracks(run.tracks),
        "tables": _tables(run),
        "scene": None if run.adjustment is None else _scene(run.adjustment),
        "gcps": _gcps(run),
        "check_points": _check_points(run),
        "stages": list(run.stages),
        "options": plain(run.options),
        "versions": _versions(),
    }
    plain_summary: dict[str, Any] = plain(summary)
    return plain_summary


def _views(run: Run) -> list[dict[str, Any]]:
    num, tracks, keep = len(run.views), run.tracks, run.keep
    count = np.bincount(tracks.view[keep], minlength=num)
    first = rmse_by_view(run.ties_before.residuals[keep], tracks.view[keep], num)
    after = run.ties_after
    last = None if after is None else rmse_by_view(after.residuals[keep], tracks.view[keep], num)
    out = []
    for i, view in enumerate(run.views):
        of_view = tracks.view == i
        entry: dict[str, Any] = {
            "name": view.name,
            "path": view.path,
            "size": list(view.size),
            "alt_range_m": list(view.alt_range),
            "rpc_source": _source(run, i),
            **_geometry(run, i),
            "num_observations": int(count[i]),
            "num_rejected": int((~keep & of_view).sum()),
            "num_gcps": 0 if run.gcps is None else int((run.gcps.view == i).sum()),
            "tie_coverage": coverage(tracks.xy[keep & of_view], view.size),
            "rmse_before": first[i],
            "rmse_after": None if last is None else last[i],
            "smooth_px": None if run.adjustment is None else run.adjustment.smooth.rms[i],
            "prior_scale": None if run.adjustment is None else run.adjustment.prior.scale[i],
            "correction": None if run.adjustment is None else _correction(run, run.adjustment, i),
            "camera_center": None if not run.centers else _center(run.centers[i]),
            "fit": None if not run.fits else _fit(run.fits[i]),
            "outputs": dict(run.written[i]) if run.written else {},
        }
        out.append({**entry, **view_status(entry, run)})
    return out


def _source(run: Run, i: int) -> dict[str, Any] | None:
    if not run.sources:
        return None
    source = run.sources[i]
    return {"format": source.format, "path": str(source.path), "notes": list(source.notes)}


def _geometry(run: Run, i: int) -> dict[str, float]:
    """Ground sampling and view angles in the middle of the image, at the scene's altitude."""
    view = run.views[i]
    middle = view.sensor.localize((np.array(view.size) - 1) / 2, np.array(run.altitude))
    incidence, azimuth = view_angles(view.sensor, middle)
    return {
        "gsd_m": float(ground_sampling(view.sensor, middle)),
        "incidence_deg": float(incidence),
        "azimuth_deg": float(azimuth),
    }


def _pair(run: Run, ties: PairTies, reports: Mapping[tuple[str, str], PairReport]) -> dict[str, Any]:
    i, j = ties.views
    names = (run.views[i].name, run.views[j].name)
    report = reports.get(names)
    some = ties.a[:: max(1, len(ties.a) // 100)]
    convergence, base_to_height, height = pair_geometry(ties, run.before, run.ground[run.tracks.point[some]])
    offsets = {}
    for when, sensors, alt in (
        ("before", run.before, run.altitudes_before),
        ("after", run.after, run.ground[:, 2]),
    ):
        found = None if sensors is None else pair_offset(ties, run.tracks, sensors, alt)
        offsets[f"epipolar_{when}"] = None if found is None else _offset(found)
    return {
        "a": names[0],
        "b": names[1],
        "num_matches": len(ties.a),
        "convergence_deg": convergence,
        "base_to_height": base_to_height,
        "height_m_per_px": height,
        **offsets,
        "matching": None if report is None else plain(report),
    }


def _offset(offset: PairOffset) -> dict[str, float | int] | None:
    if not offset.count:
        return None
    return {"median": offset.median, "spread": offset.spread, "rms": offset.rms, "count": offset.count}


def _correction(run: Run, adjustment: Adjustment, i: int) -> dict[str, Any]:
    sensor = adjustment.sensors[i]
    correction, covariance = adjustment.corrections[i], adjustment.covariance.view(i)
    out: dict[str, Any] = {
        "model": adjustment.cameras.unknowns.model,
        "unknowns": adjustment.params[i],
        "sigma": np.sqrt(np.maximum(np.diag(covariance), 0.0)),
        "center_shift_px": None,
        "center_sigma_px": None,
    }
    if not isinstance(correction, Correction):
        return {**out, "shift_px": correction.shift, "slope": correction.slope}
    assert isinstance(sensor, Corrected)
    middle = sensor.sensor.localize((np.array(run.views[i].size) - 1) / 2, np.array(run.altitude))
    shift, sigma = shift_in_image(sensor, covariance, adjustment.cameras.unknowns.model, middle)
    return {
        **out,
        "center_shift_px": shift,
        "center_sigma_px": sigma,
        "rotation_urad": correction.rotation * 1e6,
        "angle_urad": float(np.linalg.norm(correction.rotation)) * 1e6,
        "translation_m": correction.translation,
        "translation_norm_m": float(np.linalg.norm(correction.translation)),
        "drift_urad": correction.drift * 1e6,
    }


def _center(center: CameraCenter) -> dict[str, Any]:
    return {"ecef_m": center.ecef, "altitude_m": center.altitude, "method": center.method}


def _fit(fit: RpcFit) -> dict[str, Any]:
    return {
        "rmse_px": fit.rmse_ckp,
        "max_px": fit.max_ckp,
        "min_denominator": fit.min_denominator,
        "roundtrip_px": fit.roundtrip,
        "coverage": fit.coverage,
        "method": fit.method,
        "num_check_points": fit.num_ckp,
    }


def _tracks(tracks: Tracks) -> dict[str, Any]:
    length = np.bincount(np.bincount(tracks.point)) if len(tracks) else np.zeros(0, dtype=np.int64)
    return {
        "num_tracks": tracks.num_points,
        "num_observations": len(tracks),
        "by_length": {str(n): int(count) for n, count in enumerate(length) if n > 0 and count},
    }


def _tables(run: Run) -> dict[str, Any]:
    """How much of the tie points the tables hold."""
    usable = int(np.isfinite(run.ground).all(axis=1).sum())
    written = len(written_tracks(run))
    return {"num_usable_tracks": usable, "num_written_tracks": written, "complete": written == usable}


def _scene(adjustment: Adjustment) -> dict[str, Any]:
    gauge = adjustment.gauge
    modes = [
        {
            "sigma_m": mode.sigma,
            "meaning": mode.meaning,
            "motion_m": mode.motion,
            "words": mode_in_words(mode),
        }
        for mode in gauge.modes
    ]
    return {
        "shift_enu_m": gauge.shift,
        "sigma_enu_m": gauge.sigma,
        "radius_m": gauge.radius,
        "weakest_modes": modes,
        "noise": adjustment.noise,
        "drift_degree": adjustment.cameras.unknowns.drift,
        "drift_sigma_m": list(adjustment.prior.drift_sigma),
        "prior_ratio": adjustment.prior.ratio,
        "cost_history": list(adjustment.cost_history),
        "num_held_in_height": int(np.count_nonzero(adjustment.held)),
        "gcp_residuals_enu_m": adjustment.gcp_residuals,
        "solver": adjustment.status,
    }


def _gcps(run: Run) -> list[dict[str, Any]]:
    if run.gcps is None:
        return []
    left = (
        run.adjustment.gcp_residuals
        if run.adjustment is not None
        else np.full((len(run.gcps.names), 3), np.nan)
    )
    return [
        {
            "name": name,
            "lon": place[0],
            "lat": place[1],
            "alt_m": place[2],
            "sigma_m": sigma,
            "residual_enu_m": r,
        }
        for name, place, sigma, r in zip(
            run.gcps.names, run.gcps.lonlatalt, run.gcps.sigma, left, strict=True
        )
    ]


def _check_points(run: Run) -> list[dict[str, Any]]:
    """Points that stayed out of the adjustment: image residuals of each observation, and the ground error."""
    if run.check_points is None:
        return []
    points = run.check_points
    left = check_residuals(run.before if run.after is None else run.after, points)
    return [
        {
            "name": name,
            "lon": place[0],
            "lat": place[1],
            "alt_m": place[2],
            "residual_enu_m": left.ground[i],
            "observations": [
                {"view": run.views[points.view[row]].name, "residual_px": left.image[row]}
                for row in np.flatnonzero(points.point == i)
            ],
        }
        for i, (name, place) in enumerate(zip(points.names, points.lonlatalt, strict=True))
    ]


def _versions() -> dict[str, str]:
    names = ("numpy", "scipy", "opencv-python-headless", "rasterio", "shapely")
    return {"python": platform.python_version(), **{name: package_version(name) for name in names}}


def plain(value: Any) -> Any:
    """A value as JSON holds it: arrays as lists, records as mappings, what is not finite as null."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value) if f.name[0] != "_"}
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)
