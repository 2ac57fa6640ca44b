"""What a run knows at its end, and the summary drawn from it."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from importlib.metadata import version as package_version
from typing import Any

import numpy as np

from barpc import __version__
from barpc.ba import Adjustment
from barpc.fit import RpcFit
from barpc.geodesy import ground_from_ecef
from barpc.report.measures import (
    PairOffset,
    PairTies,
    pair_angle,
    pair_offset,
    pair_ties,
    rmse_by_view,
    triangulate_tracks,
)
from barpc.rpcio import RpcSource
from barpc.scene import Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Correction
from barpc.sensor.geometry import CameraCenter, Triangulation
from barpc.tie import PairReport

SCHEMA = 1
"""Version of summary.json; docs/summary.schema.json describes it."""

GOOD_RMSE = 0.5
"""A view whose tie points are left with more than this [px] is called doubtful."""
FEW_OBSERVATIONS = 30
"""A view with fewer is called weakly tied."""


@dataclass(frozen=True, eq=False)
class Run:
    """Everything that a run found out.

    Parameters
    ----------
    kind : {"adjust", "check"}
        Whether cameras were adjusted.
    views : tuple of View
        The images.
    sources : tuple of RpcSource
        Where their RPCs came from.
    tracks : Tracks
        Tie points.
    matched : tuple of PairReport
        Pairs that were matched; empty for tie points from a file.
    adjustment : Adjustment or None
        None for a check.
    centers : tuple of CameraCenter
        Camera centres, for an adjustment.
    fits : tuple of RpcFit
        Refitted RPCs, for an adjustment that went so far.
    written : tuple of mapping
        Per view: output name to the largest difference to P_BA [px] when reopened.
    left_out : tuple of (str, str)
        Files that were left out, and why.
    options : object
        The options of the run, a dataclass.
    stages : sequence of mapping
        Seconds and peak memory of the stages so far.
    out_dir : str
        Where results are.
    """

    kind: str
    views: tuple[View, ...]
    sources: tuple[RpcSource, ...]
    tracks: Tracks
    matched: tuple[PairReport, ...] = ()
    adjustment: Adjustment | None = None
    centers: tuple[CameraCenter, ...] = ()
    fits: tuple[RpcFit, ...] = ()
    written: tuple[Mapping[str, float], ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    options: object = None
    stages: Sequence[Mapping[str, Any]] = field(default_factory=list)
    out_dir: str = ""

    @property
    def before(self) -> tuple[SensorModel, ...]:
        """The cameras as delivered."""
        return tuple(view.sensor for view in self.views)

    @property
    def after(self) -> tuple[SensorModel, ...] | None:
        """The refitted cameras; P_BA where they were not refitted; None for a check."""
        if self.fits:
            return tuple(fit.rpc for fit in self.fits)
        return None if self.adjustment is None else self.adjustment.sensors

    @property
    def start_altitude(self) -> float:
        """Where triangulation starts [m]: the middle of the views' altitude ranges."""
        return float(np.mean([view.alt_range for view in self.views]))


def summarize(run: Run) -> dict[str, Any]:
    """The summary: what summary.json holds. Only plain numbers, texts, lists and mappings; NaN is null."""
    alt = run.start_altitude
    keep = None if run.adjustment is None else run.adjustment.inlier
    before = triangulate_tracks(run.tracks, run.before, alt)
    after = None if run.after is None else triangulate_tracks(run.tracks, run.after, alt)
    views = _views(run, before, after)
    pairs = [_pair(run, ties, before, alt) for ties in pair_ties(run.tracks, keep)]
    summary = {
        "schema": SCHEMA,
        "barpc": __version__,
        "kind": run.kind,
        "verdict": _verdict(run, views),
        "passed": not run.left_out and all(view["status"] != "failed" for view in views),
        "out_dir": run.out_dir,
        "views": views,
        "pairs": pairs,
        "left_out": [{"path": path, "reason": reason} for path, reason in run.left_out],
        "tracks": _tracks(run.tracks),
        "scene": None if run.adjustment is None else _scene(run.adjustment),
        "stages": list(run.stages),
        "options": plain(run.options),
        "versions": _versions(),
    }
    plain_summary: dict[str, Any] = plain(summary)
    return plain_summary


def _views(run: Run, before: Triangulation, after: Triangulation | None) -> list[dict[str, Any]]:
    num, tracks = len(run.views), run.tracks
    keep = np.ones(len(tracks), dtype=bool) if run.adjustment is None else run.adjustment.inlier
    count = np.bincount(tracks.view[keep], minlength=num)
    first = rmse_by_view(before.residuals[keep], tracks.view[keep], num)
    last = None if after is None else rmse_by_view(after.residuals[keep], tracks.view[keep], num)
    out = []
    for i, (view, source) in enumerate(zip(run.views, run.sources, strict=True)):
        entry: dict[str, Any] = {
            "name": view.name,
            "path": view.path,
            "size": list(view.size),
            "alt_range_m": list(view.alt_range),
            "rpc_source": {"format": source.format, "path": str(source.path), "notes": list(source.notes)},
            "num_observations": int(count[i]),
            "num_rejected": int((~keep[tracks.view == i]).sum()),
            "rmse_before": first[i],
            "rmse_after": None if last is None else last[i],
            "correction": None if run.adjustment is None else _correction(run.adjustment, i),
            "camera_center": None if not run.centers else _center(run.centers[i]),
            "fit": None if not run.fits else _fit(run.fits[i]),
            "outputs": dict(run.written[i]) if run.written else {},
        }
        out.append({**entry, **_status(entry, run)})
    return out


def _status(view: Mapping[str, Any], run: Run) -> dict[str, str]:
    """The verdict on a view: a word, and a sentence that says what to do."""
    tolerance = getattr(getattr(run.options, "fit", None), "tolerance", np.inf)
    if run.adjustment is not None and view["name"] in run.adjustment.left_out:
        return {"status": "failed", "advice": "not tied to the other images: its camera was left as it was"}
    if view["fit"] is not None and max(view["fit"]["max_px"]) > tolerance:
        return {
            "status": "failed",
            "advice": f"one RPC cannot hold the corrected camera to {tolerance:g} px: lower --drift or the range",
        }
    if view["num_observations"] < FEW_OBSERVATIONS:
        few = view["num_observations"]
        return {"status": "weak", "advice": f"only {few} tie points: check overlap, clouds and dates"}
    error = view["rmse_after"] if run.kind == "adjust" else view["rmse_before"]
    if not error <= GOOD_RMSE:
        return {
            "status": "doubtful",
            "advice": f"tie points are left with {error:.2f} px: try --drift 1, or look for wrong matches",
        }
    return {"status": "adjusted" if run.kind == "adjust" else "consistent", "advice": ""}


def _pair(run: Run, ties: PairTies, before: Triangulation, alt: float) -> dict[str, Any]:
    i, j = ties.views
    names = (run.views[i].name, run.views[j].name)
    report = next((r for r in run.matched if r.names == names), None)
    after = None if run.after is None else _offset(pair_offset(ties, run.tracks, run.after, alt))
    return {
        "a": names[0],
        "b": names[1],
        "num_matches": len(ties.a),
        "convergence_deg": pair_angle(ties, run.tracks, run.before, ground_from_ecef(before.points)),
        "epipolar_before": _offset(pair_offset(ties, run.tracks, run.before, alt)),
        "epipolar_after": after,
        "matching": None if report is None else plain(report),
    }


def _offset(offset: PairOffset) -> dict[str, float | int] | None:
    if not offset.count:
        return None
    return {"median": offset.median, "spread": offset.spread, "rms": offset.rms, "count": offset.count}


def _correction(adjustment: Adjustment, i: int) -> dict[str, Any]:
    correction = adjustment.corrections[i]
    covariance = adjustment.covariance.view(i)
    out: dict[str, Any] = {
        "model": adjustment.options.model,
        "unknowns": adjustment.params[i],
        "sigma": np.sqrt(np.maximum(np.diag(covariance), 0.0)),
    }
    if not isinstance(correction, Correction):
        return {**out, "shift_px": correction.shift, "slope": correction.slope}
    return {
        **out,
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


def _scene(adjustment: Adjustment) -> dict[str, Any]:
    gauge = adjustment.gauge
    return {
        "shift_enu_m": gauge.shift,
        "sigma_enu_m": gauge.sigma,
        "weakest_modes": [{"sigma_m": mode.sigma, "meaning": mode.meaning} for mode in gauge.modes],
        "noise": adjustment.noise,
        "cost_history": list(adjustment.cost_history),
        "num_held_in_height": int(np.count_nonzero(adjustment.held)),
        "gcp_residuals_enu_m": adjustment.gcp_residuals,
        "solver": adjustment.status,
    }


def _verdict(run: Run, views: Sequence[Mapping[str, Any]]) -> list[str]:
    """A few plain sentences: what was reached, what is unknown, what needs a look."""
    lines = []
    if run.adjustment is not None:
        before = float(np.nanmedian([view["rmse_before"] for view in views]))
        after = float(np.nanmedian([view["rmse_after"] for view in views]))
        lines.append(
            f"{len(views)} images adjusted: tie points agree to {after:.3f} px (before: {before:.3f} px)."
        )
        shift, sigma = run.adjustment.gauge.shift, run.adjustment.gauge.sigma
        moved = ", ".join(f"{s:+.2f} m {w}" for s, w in zip(shift, ("east", "north", "up"), strict=True))
        known = ", ".join(f"{s:.1f}" for s in sigma)
        lines.append(
            f"The scene as a whole moved by {moved}; without control its place is known to {known} m "
            "(east, north, up) only."
        )
    else:
        rmse = float(np.nanmedian([view["rmse_before"] for view in views]))
        lines.append(f"{len(views)} images: tie points agree to {rmse:.3f} px as the cameras are.")
    lines += [f"{view['name']}: {view['status']}: {view['advice']}." for view in views if view["advice"]]
    lines += [f"{path} was left out: {reason}" for path, reason in run.left_out]
    return lines


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
