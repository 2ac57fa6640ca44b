"""Machine outputs: residuals, pairs, outlines and tie points of a run as CSV, GeoJSON and PLY.

Residual tables carry the column names of ASP's ``bundle_adjust``. Every file is a function of the run alone:
the same run gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable

import numpy as np

from barpc import __version__
from barpc.geodesy import Array, ecef_from_ground, enu_basis
from barpc.geojson import collection, feature
from barpc.pointio.names import cell
from barpc.report.records import value_of
from barpc.report.run import Run
from barpc.report.summary import PairEntry, Summary, ViewEntry
from barpc.sensor.geometry import footprint

RESIDUALS = ("lon", "lat", "height_above_datum", "mean_residual", "num_observations", "mean_residual_before")
"""Columns of residuals.csv, properties of residuals.geojson; one row a track. Heights: above the ellipsoid."""

OBSERVATIONS = ("view", "track", "col", "row", "col_before", "row_before", "col_after", "row_after", "used")
"""Columns of observations.csv, one row an observation: residuals are projected - observed [px]."""

_NUMBERS = "{:.3f},{:.3f},{:.4f},{:.4f},{:.4f},{:.4f}".format


def _per_track(run: Run) -> Array:
    """Rows of `RESIDUALS` (n, 6)."""
    tracks, keep, num = run.tracks, run.keep, run.tracks.num_points
    count = np.bincount(tracks.point[keep], minlength=num)
    means = []
    for ties in (run.ties_after or run.ties_before, run.ties_before):
        norm = np.hypot(*ties.residuals[keep].T)
        with np.errstate(invalid="ignore"):
            means.append(np.bincount(tracks.point[keep], norm, minlength=num) / count)
    return np.asarray(np.column_stack([run.ground, means[0], count, means[1]])[run.written_tracks])


def _residual_rows(run: Run, empty: str) -> Iterable[list[str]]:
    for lon, lat, alt, mean, count, before in _per_track(run).tolist():
        yield [
            f"{lon:.9f}", f"{lat:.9f}", f"{alt:.4f}", f"{mean:.4f}", f"{count:.0f}", _number(before, 4, empty)
        ]  # fmt: skip


def _residuals_csv(run: Run, _: Summary) -> str:
    return "".join(",".join(row) + "\n" for row in (RESIDUALS, *_residual_rows(run, "")))


def _residuals_geojson(run: Run, _: Summary) -> str:
    features = []
    for row in _residual_rows(run, "null"):
        place = f'{{"type": "Point", "coordinates": [{", ".join(row[:3])}]}}'
        properties = ", ".join(f'"{name}": {value}' for name, value in zip(RESIDUALS, row, strict=True))
        features.append(f'{{"type": "Feature", "geometry": {place}, "properties": {{{properties}}}}}')
    return '{"type": "FeatureCollection", "features": [\n' + ",\n".join(features) + "\n]}\n"


def _observations_csv(run: Run, _: Summary) -> str:
    tracks, wanted = run.tracks, np.zeros(run.tracks.num_points, dtype=bool)
    wanted[run.written_tracks] = True
    rows = np.flatnonzero(wanted[tracks.point])
    before = run.ties_before.residuals[rows]
    after = np.full_like(before, np.nan) if run.ties_after is None else run.ties_after.residuals[rows]
    numbers = np.column_stack([tracks.xy[rows], before, after])
    names = [cell(view.name) for view in run.views]
    whole = np.isfinite(numbers).all(axis=1)
    columns = (tracks.view[rows], tracks.point[rows], numbers, run.keep[rows], whole)
    lines = [",".join(OBSERVATIONS)]
    for view, track, row, used, full in zip(*(column.tolist() for column in columns), strict=True):
        text = _NUMBERS(*row) if full else ",".join(_number(value, 4) for value in row)
        lines.append(f"{names[view]},{track},{text},{used:d}")
    return "\n".join(lines) + "\n"


def _pairs_csv(_: Run, summary: Summary) -> str:
    lines = [[path.replace(".", "_") + "_px" * ("." in path) for path in PairEntry.CSV.split()]]
    lines += [[_cell(value_of(pair, path)) for path in PairEntry.CSV.split()] for pair in summary.pairs]
    return "".join(",".join(line) + "\n" for line in lines)


def _cell(value: str | float | None) -> str:
    return (
        cell(value) if isinstance(value, str) else str(value) if isinstance(value, int) else _number(value, 5)
    )


def _number(value: float | None, digits: int, empty: str = "") -> str:
    return empty if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _footprints(run: Run, summary: Summary) -> str:
    """Every image at the scene's altitude, through the adjusted cameras, or the cameras as they are for a check."""
    features = []
    for view, sensor, entry in zip(run.views, run.after or run.before, summary.views, strict=True):
        ring = np.round(footprint(sensor, view.size, run.altitude), 9)
        properties = {key: getattr(entry, key) for key in ViewEntry.FOOTPRINT.split()}
        features.append(feature(ring, **properties, altitude_m=summary.altitude_m))
    return json.dumps(collection(features)) + "\n"


def _points_ply(run: Run, _: Summary) -> bytes:
    """Tie points in metres east, north, up of an origin that the header states, binary."""
    rows = _per_track(run)
    origin = rows[:, :3].mean(axis=0) if len(rows) else np.zeros(3)
    if len(rows):
        origin[0] = rows[0, 0]  # a mean of longitudes may fall on the other side of the Earth
    local = (ecef_from_ground(rows[:, :3]) - ecef_from_ground(origin)) @ enu_basis(origin).T
    kind = np.dtype([(n, "<f8") for n in "xyz"] + [("mean_residual", "<f4"), ("num_observations", "<i4")])
    records = np.empty(len(rows), dtype=kind)
    for k, name in enumerate("xyz"):
        records[name] = local[:, k]
    records["mean_residual"], records["num_observations"] = rows[:, 3], rows[:, 4]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment barpc {__version__}: x east, y north, z up [m] of lon {origin[0]:.9f} lat {origin[1]:.9f}"
        f" alt {origin[2]:.4f} (WGS84, above the ellipsoid)",
        f"element vertex {len(rows)}",
        *(f"property double {name}" for name in "xyz"),
        "property float mean_residual",
        "property int num_observations",
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + records.tobytes()


def _encoded(made: Callable[[Run, Summary], str]) -> Callable[[Run, Summary], bytes]:
    return lambda run, summary: made(run, summary).encode()


TABLES: dict[str, Callable[[Run, Summary], bytes]] = {
    "residuals.csv": _encoded(_residuals_csv),
    "residuals.geojson": _encoded(_residuals_geojson),
    "observations.csv": _encoded(_observations_csv),
    "pairs.csv": _encoded(_pairs_csv),
    "footprints.geojson": _encoded(_footprints),
    "points.ply": _points_ply,
}
"""File name -> its bytes, of a run and its summary."""
