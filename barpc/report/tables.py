"""The tables of a run as they are written: residuals, pairs and outlines as CSV and GeoJSON, layers of a map.

Residual tables carry the column names of ASP's ``bundle_adjust``. Every file is a function of the run alone:
the same run gives the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from barpc.base.geodesy import CHUNK, Array, feature_collection, geojson_feature
from barpc.pointio.matches import matches_npz
from barpc.pointio.names import cell
from barpc.report.geopackage import MapLayer, point_shapes
from barpc.report.outcome import Run
from barpc.report.records import value_of
from barpc.report.runfiles import MATCHES, OBSERVATION_COLUMNS, RESIDUALS
from barpc.report.summary import Summary
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.sensor.geometry import footprints

_RESIDUAL_CELLS = "{:.3f},{:.3f},{:.4f},{:.4f},{:.4f},{:.4f}".format


def _per_track(run: Run) -> Array:
    """Return the rows of `RESIDUALS` (n, 7)."""
    tracks, keep, num = run.tracks, run.keep, run.tracks.num_points
    count = np.bincount(tracks.point[keep], minlength=num)
    means = []
    for ties in (run.ties_after or run.ties_before, run.ties_before):
        norm = np.hypot(*ties.residuals[keep].T)
        with np.errstate(invalid="ignore"):
            means.append(np.bincount(tracks.point[keep], norm, minlength=num) / count)
    table = np.column_stack([run.ground, means[0], count, means[1], np.arange(num)])
    return np.asarray(table[run.written_tracks])


def _csv(header: Sequence[str], lines: Iterable[str]) -> Iterator[bytes]:
    """Yield a table, a part of its lines at a time."""
    yield f"{','.join(header)}\n".encode()
    rest = iter(lines)
    while part := [*islice(rest, CHUNK)]:
        yield "\n".join([*part, ""]).encode()


def _cells_by_row(*columns: npt.NDArray[Any]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of columns as Python's values."""
    for start in range(0, len(columns[0]), CHUNK):
        yield from zip(*(column[start : start + CHUNK].tolist() for column in columns), strict=True)


def _residuals_csv(run: Run, _: Summary) -> Iterable[bytes]:
    rows = (
        f"{lon:.9f},{lat:.9f},{alt:.4f},{mean:.4f},{count:.0f},{_rounded(before, 4)},{track:.0f}"
        for lon, lat, alt, mean, count, before, track in _cells_by_row(*_per_track(run).T)
    )
    return _csv(RESIDUALS, rows)


def _observation_lines(run: Run) -> Iterator[str]:
    tracks, names = run.tracks, [cell(view.name) for view in run.views]
    rows = np.flatnonzero(np.isin(tracks.point, run.written_tracks))
    for part in np.split(rows, range(CHUNK, len(rows), CHUNK)):
        before = run.ties_before.residuals[part]
        after = np.full_like(before, np.nan) if run.ties_after is None else run.ties_after.residuals[part]
        numbers = np.column_stack([tracks.xy[part], before, after])
        whole = np.asarray(np.isfinite(numbers).all(axis=1))
        for view, track, row, used, full in _cells_by_row(
            tracks.view[part], tracks.point[part], numbers, run.keep[part], whole
        ):
            text = _RESIDUAL_CELLS(*row) if full else ",".join(_rounded(value, 4) for value in row)
            yield f"{names[view]},{track},{text},{used:d}"


def _pairs_csv(_: Run, summary: Summary) -> Iterable[bytes]:
    paths = PairEntry.CSV.split()
    lines = (",".join(_formatted_cell(value_of(pair, path)) for path in paths) for pair in summary.pairs)
    return _csv([path.replace(".", "_") + "_px" * ("." in path) for path in paths], lines)


def _formatted_cell(value: str | float | None) -> str:
    if isinstance(value, str):
        return cell(value)
    return str(value) if isinstance(value, int) else _rounded(value, 5)


def _rounded(value: float | None, digits: int) -> str:
    return "" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _footprints_geojson(run: Run, summary: Summary) -> Iterable[bytes]:
    """Return every image at the scene's altitude, through the adjusted cameras, or for a check as they are."""
    return [(json.dumps(feature_collection(outline_features(run, summary))) + "\n").encode()]


def outline_features(run: Run, summary: Summary) -> list[dict[str, Any]]:
    """Return the outlines of the images as features of GeoJSON, with their figures."""
    rings = footprints(run.after or run.before, [view.size for view in run.views], run.altitude)
    names, altitude = ViewEntry.FOOTPRINT.split(), {"altitude_m": summary.altitude_m}
    return [
        geojson_feature(ring, **{key: getattr(entry, key) for key in names}, **altitude)
        for ring, entry in zip(np.round(rings, 9), summary.views, strict=True)
    ]


def map_layers(run: Run, summary: Summary) -> list[MapLayer]:
    """Return the layers of a run for a GIS: footprints, tie points, GCPs and check points, with their residuals."""
    outlines, ties = [one for one in outline_features(run, summary) if one["geometry"]], _per_track(run)
    kinds = ("TEXT", "TEXT", "TEXT", "INTEGER", "DOUBLE", "DOUBLE", "DOUBLE", "DOUBLE")
    columns = [f"{name} {kind}" for name, kind in zip((*ViewEntry.FOOTPRINT.split(), "altitude_m"), kinds, strict=True)]
    shapes = [shapely.geometry.shape(one["geometry"]) for one in outlines]
    layers = [MapLayer("footprints", shapes, columns, [tuple(one["properties"].values()) for one in outlines])]
    words = ["residual_px DOUBLE", "observations INTEGER", "residual_before_px DOUBLE", "track INTEGER"]
    rows = ((mean, int(count), before, int(track)) for mean, count, before, track in ties[:, 3:].tolist())
    layers.append(MapLayer("tie_points", point_shapes(ties[:, :3]), words, rows))
    words = ["name TEXT", "status TEXT", "east_m DOUBLE", "north_m DOUBLE", "up_m DOUBLE"]
    for name, entries in (("gcps", summary.gcps), ("check_points", summary.check_points)):
        places = np.array([(one.lon, one.lat, one.alt_m) for one in entries]).reshape(-1, 3)
        table = [(one.name, getattr(one, "status", "check"), *one.residual_enu_m) for one in entries]
        layers.append(MapLayer(name, point_shapes(places), words, table))
    return layers


def gcps_geojson(run: Run) -> bytes:
    """Return the reference points that constrain the block, as `--gcp` reads them: a feature an observation."""
    control = None if run.reference is None else run.reference.control
    assert control is not None
    assert run.adjustment is not None
    points, kept = control.points, run.adjustment.reference_inlier
    places, sigmas = points.lonlatalt.round(9).tolist(), points.sigma.tolist()
    pixels, features = points.xy.round(4).tolist(), []
    for row in np.flatnonzero(kept).tolist():
        g, view = int(points.point[row]), run.views[points.view[row]]
        where = {"id": points.names[g], "filename": Path(view.path).name}
        properties = {**where, "ji": pixels[row], "sigma_m": sigmas[g]}
        place = {"type": "Point", "coordinates": places[g]}
        features.append(json.dumps({"type": "Feature", "geometry": place, "properties": properties}))
    text = ",\n".join(features)
    return f'{{"type": "FeatureCollection", "features": [\n{text}\n]}}\n'.encode()


TABLES: dict[str, Callable[[Run, Summary], Iterable[bytes]]] = {
    "residuals.csv": _residuals_csv,
    "observations.csv": lambda run, _: _csv(OBSERVATION_COLUMNS, _observation_lines(run)),
    "pairs.csv": _pairs_csv,
    "footprints.geojson": _footprints_geojson,
    MATCHES: lambda run, _: [matches_npz(run.tracks, [view.name for view in run.views])],
}
"""File name -> the parts of its bytes, of a run and its summary."""
