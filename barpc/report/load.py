"""A finished run read back from its files: all that the report is made from."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from barpc.errors import InputError
from barpc.geodesy import Array
from barpc.pointio.names import from_cell
from barpc.report.summary import SCHEMA
from barpc.report.tables import OBSERVATIONS, RESIDUALS
from barpc.scene import BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class Observations:
    """observations.csv.

    Parameters
    ----------
    view : (K,)
        Index of the view in the summary.
    xy : (K, 2)
        col, row [px].
    before, after : (K, 2)
        Projected - observed [px]; NaN where there is none.
    used : (K,)
        Whether the adjustment kept it.
    """

    view: IntArray
    xy: Array
    before: Array
    after: Array
    used: BoolArray


@dataclass(frozen=True, eq=False)
class RunFiles:
    """What lies in the folder of a run.

    Parameters
    ----------
    summary : mapping
        summary.json.
    observations : Observations
        observations.csv.
    points : (n, 4)
        lon, lat [deg], altitude [m], mean residual [px] of the tie points.
    outlines : sequence of sequence of (m, 2)
        The rings of every view's footprint; lon, lat [deg], closed, cut at the antimeridian.
    """

    summary: Mapping[str, Any]
    observations: Observations
    points: Array
    outlines: Sequence[Sequence[Array]]


def read_summary(folder: Path) -> dict[str, Any]:
    """summary.json of a run folder.

    Raises
    ------
    InputError
        There is none, it does not parse, or another release's schema.
    """
    path = folder / "summary.json"
    try:
        summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{folder}: no summary.json, so no finished run") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    found = summary.get("schema") if isinstance(summary, dict) else None
    if found != SCHEMA:
        raise InputError(f"{path}: schema {found}, this release reads {SCHEMA}: run the adjustment again")
    return summary


def read_tables(summary: Mapping[str, Any], folder: Path) -> RunFiles:
    """The tables of a run folder, beside a summary that is at hand.

    Raises
    ------
    InputError
        A table is missing or damaged; the message names it.
    """
    names = [view["name"] for view in summary["views"]]
    outlines = _read(folder / "footprints.geojson", _outlines)
    if len(outlines) != len(names):
        raise InputError(f"{folder / 'footprints.geojson'}: {len(outlines)} outlines of {len(names)} images")
    observations = _read(folder / "observations.csv", lambda text: _observations(text, names))
    return RunFiles(summary, observations, _read(folder / "residuals.csv", _points), outlines)


def _read(path: Path, parse: Any) -> Any:
    try:
        return parse(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise InputError(f"{path}: cannot be read ({error!r}); run the adjustment again") from error


def _columns(text: str, header: Sequence[str]) -> list[list[str]]:
    rows = csv.reader(io.StringIO(text, newline=""))
    if tuple(next(rows)) != tuple(header):
        raise ValueError(f"its columns are not {', '.join(header)}")
    columns = [list(column) for column in zip(*rows, strict=True)]
    return columns or [[] for _ in header]


def _floats(columns: Sequence[Sequence[str]]) -> Array:
    """Columns (n, len(columns)) of numbers; an empty cell is NaN."""
    return np.array([[float(cell or "nan") for cell in column] for column in columns], dtype=np.float64).T


def _observations(text: str, names: Sequence[str]) -> Observations:
    columns = _columns(text, OBSERVATIONS)
    index = {name: i for i, name in enumerate(names)}
    view = np.array([index[from_cell(name)] for name in columns[0]], dtype=np.int64)
    numbers = _floats(columns[2:8])
    used = np.array([cell == "1" for cell in columns[8]], dtype=bool)
    return Observations(view, numbers[:, :2], numbers[:, 2:4], numbers[:, 4:], used)


def _points(text: str) -> Array:
    return _floats(_columns(text, RESIDUALS)[:4])


def _outlines(text: str) -> list[list[Array]]:
    outlines = []
    for feature in json.loads(text)["features"]:
        geometry = feature["geometry"] or {"type": "MultiPolygon", "coordinates": []}
        parts = geometry["coordinates"]
        parts = [parts] if geometry["type"] == "Polygon" else parts
        outlines.append([np.array(part[0], dtype=np.float64) for part in parts])
    return outlines
