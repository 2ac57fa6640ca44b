"""A finished run read back from its files: all that the report is made from."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from barpc.errors import InputError
from barpc.geodesy import Array
from barpc.pointio.names import from_cell
from barpc.report.summary import SCHEMA, Summary, published_schema
from barpc.report.tables import OBSERVATIONS, RESIDUALS
from barpc.scene import BoolArray, IntArray
from barpc.sidefile import GEOJSON, SUMMARY, TABLE, Kind, parse_json, read_json, read_text

_FAR = 1e12  # px, deg and m: no number of a table comes near


@dataclass(frozen=True, eq=False)
class Observations:
    """observations.csv: index of the view (K,), col, row (K, 2) [px], whether it was kept (K,).

    `before`, `after` (K, 2): projected - observed [px]; NaN where there is none.
    """

    view: IntArray
    xy: Array
    before: Array
    after: Array
    used: BoolArray


@dataclass(frozen=True, eq=False)
class RunFiles:
    """What lies in the folder of a run.

    `points` (n, 4): lon, lat [deg], altitude [m], mean residual [px] of the tie points; `outlines`: the rings (m, 2) of
    every view's footprint, lon, lat [deg], closed, cut at the antimeridian.
    """

    summary: Summary
    observations: Observations
    points: Array
    outlines: Sequence[Sequence[Array]]

    @property
    def number(self) -> dict[str, int]:
        """Name of an image -> its index."""
        return {view.name: k for k, view in enumerate(self.summary.views)}


def read_summary(folder: Path) -> Summary:
    """summary.json of a run folder.

    Raises
    ------
    InputError
        There is none, it does not parse, or another release's schema.
    """
    path = folder / "summary.json"
    if not path.exists():
        raise InputError(f"{folder}: no summary.json, so no finished run")
    found = read_json(path, SUMMARY)
    version = found.get("schema") if isinstance(found, dict) else None
    if version != SCHEMA:
        raise InputError(f"{path}: schema {version!r}, this release reads {SCHEMA}: run the adjustment again")
    try:
        _validate()(found)
    except ValueError as error:  # fastjsonschema's own are some
        raise _damaged(path, str(error).replace("data", "summary", 1)) from None
    summary = Summary.read(found)
    names = {view.name for view in summary.views}
    if len(names) < len(summary.views):
        raise _damaged(path, "two images have one name")
    for pair in summary.pairs:
        if pair.a == pair.b or not {pair.a, pair.b} <= names:
            raise _damaged(path, f"no pair of its images is {pair.a} - {pair.b}")
    return summary


def _damaged(path: Path, why: str) -> InputError:
    return InputError(f"{path}: damaged, {why}: run the adjustment again")


@cache
def _validate() -> Callable[[Any], Any]:
    import fastjsonschema

    found: Callable[[Any], Any] = fastjsonschema.compile(published_schema())
    return found


def read_tables(summary: Summary, folder: Path) -> RunFiles:
    """The tables of a run folder, beside a summary that is at hand.

    Raises
    ------
    InputError
        A table is missing or damaged; the message names it.
    """
    names = [view.name for view in summary.views]
    outlines = _read(folder / "footprints.geojson", GEOJSON, _outlines)
    if len(outlines) != len(names):
        raise InputError(f"{folder / 'footprints.geojson'}: {len(outlines)} outlines of {len(names)} images")
    observations = _read(folder / "observations.csv", TABLE, lambda text: _observations(text, names))
    return RunFiles(summary, observations, _read(folder / "residuals.csv", TABLE, _points), outlines)


def _read(path: Path, kind: Kind, parse: Any) -> Any:
    text = read_text(path, kind)
    try:
        return parse(text)
    except (ValueError, LookupError, TypeError, AttributeError, StopIteration, csv.Error) as error:
        raise InputError(f"{path}: damaged ({error!r}); run the adjustment again") from error


def _columns(text: str, header: Sequence[str]) -> list[list[str]]:
    rows = csv.reader(io.StringIO(text, newline=""))
    if tuple(next(rows)) != tuple(header):
        raise ValueError(f"its columns are not {', '.join(header)}")
    columns = [list(column) for column in zip(*rows, strict=True)]
    if columns and len(columns) != len(header):
        raise ValueError(f"rows of {len(columns)} cells")
    return columns or [[] for _ in header]


def _floats(columns: Sequence[Sequence[str]], known: int) -> Array:
    """Columns (n, len(columns)) of numbers, of which only those after the first `known` may be empty (NaN)."""
    table = np.array([[float(cell or "nan") for cell in column] for column in columns], dtype=np.float64).T
    if np.isnan(table[:, :known]).any() or (np.abs(table) > _FAR).any():
        raise ValueError("a number is missing or absurdly large")
    return table


def _observations(text: str, names: Sequence[str]) -> Observations:
    columns = _columns(text, OBSERVATIONS)
    index = {name: i for i, name in enumerate(names)}
    view = np.array([index[from_cell(name)] for name in columns[0]], dtype=np.int64)
    numbers = _floats(columns[2:8], 2)
    used = np.array([cell == "1" for cell in columns[8]], dtype=bool)
    return Observations(view, numbers[:, :2], numbers[:, 2:4], numbers[:, 4:], used)


def _points(text: str) -> Array:
    return _in_degrees(_floats(_columns(text, RESIDUALS)[:4], 3))


def _in_degrees(places: Array) -> Array:
    if not (np.abs(places[:, :2]) <= (540.0, 90.0)).all():
        raise ValueError("a place is no longitude and latitude")
    return places


def _outlines(text: str) -> list[list[Array]]:
    outlines = []
    for feature in parse_json(text)["features"]:
        geometry = feature["geometry"] or {"type": "MultiPolygon", "coordinates": []}
        parts = geometry["coordinates"]
        parts = [parts] if geometry["type"] == "Polygon" else parts
        outlines.append([_ring(part[0]) for part in parts])
    return outlines


def _ring(positions: Any) -> Array:
    """A closed outline (m, 2) [deg]."""
    ring = np.array(positions, dtype=np.float64)
    if ring.ndim != 2 or ring.shape[1] != 2 or len(ring) < 4:
        raise ValueError(f"an outline of shape {ring.shape}")
    return _in_degrees(ring)
