"""Machine outputs: residuals, pairs and tie points of a run as CSV, GeoJSON and PLY.

Residual tables carry the column names of ASP's ``bundle_adjust``. Every file is a function of the run alone:
the same run gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from barpc import __version__
from barpc.geodesy import Array, ecef_from_ground, enu_basis
from barpc.pointio.names import cell
from barpc.report.footprints import footprints_geojson
from barpc.report.run import Run
from barpc.scene import IntArray

MAX_TRACKS = 200_000
"""Of more tracks, every n-th is written, so that the files of a huge run can still be opened."""

RESIDUALS = ("lon", "lat", "height_above_datum", "mean_residual", "num_observations", "mean_residual_before")
"""Columns of residuals.csv, properties of residuals.geojson; one row a track. Heights: above the ellipsoid."""

OBSERVATIONS = ("view", "track", "col", "row", "col_before", "row_before", "col_after", "row_after", "used")
"""Columns of observations.csv, one row an observation: residuals are projected - observed [px]."""

_PAIR_NUMBERS = ("num_matches", "convergence_deg", "base_to_height", "height_m_per_px")
_NUMBERS = "{:.3f},{:.3f},{:.4f},{:.4f},{:.4f},{:.4f}".format
_OFFSETS = ("median", "spread", "rms")


def written_tracks(run: Run) -> IntArray:
    """Indices of the tracks that the tables hold: those with a ground point, evenly taken above `MAX_TRACKS`."""
    usable = np.flatnonzero(np.isfinite(run.ground).all(axis=1))
    return usable[:: -(-len(usable) // MAX_TRACKS)] if len(usable) else usable


def _per_track(run: Run) -> Array:
    """Rows of `RESIDUALS` (n, 6)."""
    tracks, keep, wanted = run.tracks, run.keep, written_tracks(run)
    count = np.bincount(tracks.point[keep], minlength=tracks.num_points)
    means = []
    for ties in (run.ties_after or run.ties_before, run.ties_before):
        norm = np.hypot(*ties.residuals[keep].T)
        with np.errstate(invalid="ignore"):
            means.append(np.bincount(tracks.point[keep], norm, minlength=tracks.num_points) / count)
    columns = np.column_stack([run.ground, means[0], count, means[1]])
    return np.asarray(columns[wanted])


def _residuals_csv(run: Run) -> Iterable[str]:
    yield ",".join(RESIDUALS) + "\n"
    for lon, lat, alt, mean, count, before in _per_track(run).tolist():
        yield f"{lon:.9f},{lat:.9f},{alt:.4f},{mean:.4f},{count:.0f},{_number(before, 4)}\n"


def _residuals_geojson(run: Run) -> Iterable[str]:
    yield '{"type": "FeatureCollection", "features": [\n'
    separator = ""
    for lon, lat, alt, mean, count, before in _per_track(run).tolist():
        place = f'{{"type": "Point", "coordinates": [{lon:.9f}, {lat:.9f}, {alt:.4f}]}}'
        values = (
            f"{lon:.9f}",
            f"{lat:.9f}",
            f"{alt:.4f}",
            f"{mean:.4f}",
            f"{count:.0f}",
            _number(before, 4, "null"),
        )
        properties = ", ".join(f'"{name}": {value}' for name, value in zip(RESIDUALS, values, strict=True))
        yield f'{separator}{{"type": "Feature", "geometry": {place}, "properties": {{{properties}}}}}'
        separator = ",\n"
    yield "\n]}\n"


def _observations_csv(run: Run) -> Iterable[str]:
    yield ",".join(OBSERVATIONS) + "\n"
    tracks = run.tracks
    wanted = np.zeros(tracks.num_points, dtype=bool)
    wanted[written_tracks(run)] = True
    rows = np.flatnonzero(wanted[tracks.point])
    before = run.ties_before.residuals[rows]
    after = run.ties_after.residuals[rows] if run.ties_after is not None else np.full((len(rows), 2), np.nan)
    numbers = np.column_stack([tracks.xy[rows], before, after])
    names = [cell(view.name) for view in run.views]
    columns = (
        tracks.view[rows],
        tracks.point[rows],
        numbers,
        run.keep[rows],
        np.isfinite(numbers).all(axis=1),
    )
    for view, track, row, used, whole in zip(*(column.tolist() for column in columns), strict=True):
        text = _NUMBERS(*row) if whole else ",".join(_number(value, 4) for value in row)
        yield f"{names[view]},{track},{text},{used:d}\n"


def _pairs_csv(run: Run, pairs: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    offsets = [f"epipolar_{when}_{what}_px" for when in ("before", "after") for what in _OFFSETS]
    yield ",".join(["a", "b", *_PAIR_NUMBERS, *offsets]) + "\n"
    for pair in pairs:
        values = [pair[name] for name in _PAIR_NUMBERS]
        for when in ("epipolar_before", "epipolar_after"):
            values += [None if pair[when] is None else pair[when][what] for what in _OFFSETS]
        cells = [str(v) if isinstance(v, int) else _number(v, 5) for v in values]
        yield ",".join([cell(pair["a"]), cell(pair["b"]), *cells]) + "\n"


def _number(value: float | None, digits: int, empty: str = "") -> str:
    return empty if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _points_ply(run: Run) -> bytes:
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


TABLES: dict[str, Callable[[Run, Mapping[str, Any]], bytes]] = {
    "residuals.csv": lambda run, _: "".join(_residuals_csv(run)).encode(),
    "residuals.geojson": lambda run, _: "".join(_residuals_geojson(run)).encode(),
    "observations.csv": lambda run, _: "".join(_observations_csv(run)).encode(),
    "pairs.csv": lambda run, summary: "".join(_pairs_csv(run, summary["pairs"])).encode(),
    "footprints.geojson": lambda run, summary: (json.dumps(footprints_geojson(run, summary)) + "\n").encode(),
    "points.ply": lambda run, _: _points_ply(run),
}
"""File name -> its bytes, of a run and its summary."""
