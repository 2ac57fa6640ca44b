"""The files of a run: where they lie, their columns, and how they are read back."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from barpc.base.errors import BarpcError, BarpcWarning, InputError, listed, plain
from barpc.base.geodesy import Array, is_lonlat
from barpc.base.manifest import LAST
from barpc.base.safe_io import GEOJSON, SUMMARY, parse_json, read_json, read_text
from barpc.report.records import Number, Record, column, json_form
from barpc.report.summary import SCHEMA, Summary
from barpc.report.summary.words import NAMED, Share, Side
from barpc.scene import BoolArray, IntArray

FOLDER = "tables"
"""Folder in that of a run for what is neither a corrected camera, nor its report and summary."""
PRIOR_FILE, IMAGES = "block.npz", "images.json"  # the files in it that a later run starts from

MATCHES = "matches.npz"  # all tie points, in use or not, to the bit

_PLACE = "lon", "lat", "height_above_datum"
RESIDUALS = (*_PLACE, "mean_residual", "num_observations", "mean_residual_before", "track")
"""Columns of residuals.csv, one row a track. Heights: above the ellipsoid."""

OBSERVATION_COLUMNS = ("view", "track", "col", "row", "col_before", "row_before", "col_after", "row_after", "used")
"""Columns of observations.csv, one row an observation: residuals are projected - observed [px]."""

_BASE64 = r"^[A-Za-z0-9+/]{4,400000}={0,2}\Z"


def table_path(folder: Path, name: str) -> Path:
    """Where a run keeps a table: in its `FOLDER`."""
    return folder / FOLDER / name


SURFACE = "surface.json"
"""Two reliefs and two images on the surface for the report, of a run of which one was made, and which run (`run_key`).
"""
PICTURES = "pictures.json"
"""Thumbnails of images, and a strip of the worst pair: to look at, no result."""
MAX_PICTURES = 60  # images of which the page shows a picture, and the residuals

_MAX_TABLE_VALUE = 1e12  # px, deg and m: no number of a table comes near


@dataclass(frozen=True, eq=False)
class ObservationTable:
    """observations.csv: index of the view, number of the track (K,), col, row (K, 2) [px], whether it was kept (K,).

    `before`, `after` (K, 2): projected - observed [px]; NaN where there is none.
    """

    view: IntArray
    track: IntArray
    xy: Array
    before: Array
    after: Array
    used: BoolArray


class ReliefWindow(Record):
    """A window of the ground, as one of two kinds of cameras give it."""

    cameras: Literal["delivered", "corrected"] = column("Which cameras")
    size: tuple[Side, Side] = column("Width and height of the picture", "px")
    share: Share = column("Part of the window that has heights")
    nmad_m: Number = column("How far pairs of images disagree, by median", "m")
    picture: str = column("A shaded relief, a JPEG in base64", pattern=_BASE64)


class Draped(Record):
    """A picture of an image: small, or on the surface in the window of the reliefs."""

    image: str = column("Its name")
    size: tuple[Side, Side] = column("Width and height of the picture", "px")
    picture: str = column("The image, a JPEG in base64", pattern=_BASE64)


class PairStrip(Draped):
    """Tiles of a pair along its epipolar lines, a row of them an image and kind of cameras."""

    rows: tuple[str, ...] = column("What each row shows", min_length=1, max_length=3)
    tiles: Side = column("Tiles of a row")
    half_px: float = column("From the middle of a tile to its edge, in the first image", "px")


@dataclass(frozen=True, eq=False)
class RunFiles:
    """Files in the folder of a run.

    `points` (n, 4): lon, lat [deg], altitude [m], mean residual [px] of the tie points, whose numbers are `tracks`
    (n,); `outlines`: the rings (m, 2) of every view's footprint, lon, lat [deg], closed, cut at the antimeridian.
    """

    summary: Summary
    observations: ObservationTable
    points: Array
    tracks: IntArray
    outlines: Sequence[Sequence[Array]] = ()
    reliefs: Sequence[ReliefWindow] = ()
    draped: Sequence[Draped] = ()
    thumbnails: Sequence[Draped] = ()
    strips: Sequence[PairStrip] = ()

    @property
    def number(self) -> dict[str, int]:
        """Name of an image -> its index."""
        return {view.name: k for k, view in enumerate(self.summary.views)}


def read_summary(folder: Path) -> Summary:
    """Read the summary.json of a run folder.

    Keys of no record are named in a warning, and passed over.
    InputError where there is none, it does not parse, or has another release's schema.
    """
    path = folder / LAST
    if not path.exists():
        raise InputError(f"{folder}: no {LAST}, so no finished run; give the folder of one")
    found = read_json(path, SUMMARY)
    version = found.get("schema") if isinstance(found, dict) else None
    if version != SCHEMA:
        raise InputError(f"{path}: schema {version!r}, this release reads {SCHEMA}: run the adjustment again")
    try:
        summary = Summary.read(found)
        names = {view.name for view in summary.views}
        if len(names) < len(summary.views):
            raise ValueError("two images have one name")
        for pair in summary.pairs:
            if pair.a == pair.b or not {pair.a, pair.b} <= names:
                raise ValueError(f"no pair of its images is {pair.a} - {pair.b}")
    except ValueError as error:
        raise InputError(f"{path}: damaged, {error}: run the adjustment again") from None
    if unknown := sorted(set(_unknown_keys(found, json_form(summary)))):
        more = "which this release does not know and passes over"
        warnings.warn(f"{path}: has {listed(unknown, NAMED)}, {more}", BarpcWarning, stacklevel=2)
    return summary


def _unknown_keys(found: Any, read: Any, place: str = "") -> Iterator[str]:
    """Yield the keys of parsed JSON that its record has not, after those that lead to them, without numbers of rows."""
    if isinstance(found, list):
        for row, known in zip(found, read, strict=True):
            yield from _unknown_keys(row, known, place)
    elif isinstance(found, dict):
        for key, value in found.items():
            if key in read:
                yield from _unknown_keys(value, read[key], f"{place}{key}.")
            elif value is not None:  # a field that is None is left out
                yield place + key


TIE_TABLES = "observations.csv", "residuals.csv"
PAGE_TABLES = *TIE_TABLES, "footprints.geojson", SURFACE, PICTURES


def read_tables(summary: Summary, folder: Path, of_page: bool = True) -> RunFiles:
    """Read the tables of a run folder for a given summary, of tie points and `of_page`: outlines and pictures.

    InputError names a table that is missing or damaged.
    """
    names = [view.name for view in summary.views]
    ties, outlines_file = (table_path(folder, name) for name in TIE_TABLES), table_path(folder, PAGE_TABLES[2])
    outlines = _parsed(outlines_file, read_text(outlines_file, GEOJSON), _parse_outlines) if of_page else None
    if outlines is not None and len(outlines) != len(names):
        raise InputError(f"{outlines_file}: {len(outlines)} outlines of {len(names)} images")
    observations = _parsed_observations(next(ties), names)
    points, tracks = _parsed_points(next(ties))
    if outlines is None:
        return RunFiles(summary, observations, points, tracks)
    surface = table_path(folder, SURFACE)
    made = summary.outputs and os.path.lexists(surface)  # none of a run that is at work: an earlier one's
    of_run = partial(_parse_surface, run=run_key(summary))
    shown = _parsed(surface, read_text(surface, SUMMARY), of_run) if made else ((), ())
    pictures = table_path(folder, PICTURES)
    small = _parsed(pictures, read_text(pictures, SUMMARY), _parse_pictures) if os.path.lexists(pictures) else ((), ())
    return RunFiles(summary, observations, points, tracks, outlines, *shown, *small)


def run_key(summary: Summary) -> str:
    """Return the key of a run, a hash of its results: products of other results are not shown beside them."""
    results = [(one.file, one.sha256) for one in summary.outputs or ()]
    return hashlib.sha256(repr(results).encode()).hexdigest()


def _parse_surface(text: str, run: str) -> tuple[tuple[ReliefWindow, ...], tuple[Draped, ...]]:
    found = parse_json(text)
    rows = found["shown"]
    if found["run"] != run:
        return (), ()
    reliefs, draped = tuple(map(ReliefWindow.read, rows[:2])), tuple(map(Draped.read, rows[2:]))
    if [one.cameras for one in reliefs] != ["delivered", "corrected"] or len(draped) not in (0, 2):
        raise ValueError("reliefs that are not one before and one after, images that are not two")
    return reliefs, draped


def _parse_pictures(text: str) -> tuple[tuple[Draped, ...], tuple[PairStrip, ...]]:
    found = parse_json(text)
    if not isinstance(found, dict) or not all(isinstance(found.get(key), list) for key in ("images", "pairs")):
        raise ValueError("no lists of images and of pairs")
    return tuple(map(Draped.read, found["images"])), tuple(map(PairStrip.read, found["pairs"]))


def _parsed(path: Path, text: Any, parse: Any) -> Any:
    try:
        return parse(text)
    except (BarpcError, UnicodeDecodeError):
        raise
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: damaged ({plain(error)}); run the adjustment again") from error


def _parsed_observations(path: Path, names: Sequence[str]) -> ObservationTable:
    """Return observations.csv, of images in the order of their names."""
    table = _parsed_columns(path, OBSERVATION_COLUMNS, OBSERVATION_COLUMNS[4:8], ("view",))
    numbers = np.stack([table[name] for name in OBSERVATION_COLUMNS[2:8]], axis=-1)
    index = {name: i for i, name in enumerate(names)}

    def of_images(seen: Any) -> Any:
        return np.array([index[str(name)] for name in seen.different], dtype=np.int64)[seen.index]

    view, used = _parsed(path, table["view"], of_images), table["used"] == 1.0
    return ObservationTable(view, table["track"], numbers[:, :2], numbers[:, 2:4], numbers[:, 4:], used)


def _parsed_points(path: Path) -> tuple[Array, IntArray]:
    """Return lon, lat [deg], altitude [m] and mean residual [px] (n, 4) of the tracks (n,) of residuals.csv."""
    table = _parsed_columns(path, RESIDUALS, ("mean_residual", "mean_residual_before"))
    places = np.stack([table[name] for name in RESIDUALS[:4]], axis=-1)
    return _parsed(path, places, _in_degrees), table["track"]


def _parsed_columns(
    path: Path, header: Sequence[str], blank: Sequence[str], texts: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the columns of a table by their names: texts, numbers of tracks, and numbers, NaN for blank ones."""
    from barpc.pointio.tables import read_table  # with what knows of heights: a summary alone needs none

    _, found = read_table(path, {name: (name,) for name in header}, header, texts=texts, blank=blank)

    def numbers(name: str) -> Array:
        values = np.array(found[name], dtype=np.float64)
        if (name not in blank and np.isnan(values).any()) or (np.abs(values) > _MAX_TABLE_VALUE).any():
            raise ValueError(f"{name}: a number is missing or absurdly large")
        if name == "track" and not ((values >= 0.0) & (values == np.rint(values))).all():
            raise ValueError("a number of a track is none")
        return values.astype(np.int64) if name == "track" else values

    return {name: column if name in texts else _parsed(path, name, numbers) for name, column in found.items()}


def _in_degrees(places: Array) -> Array:
    if not is_lonlat(places).all():
        raise ValueError("a place is no longitude and latitude")
    return places


def _parse_outlines(text: str) -> list[list[Array]]:
    outlines = []
    for item in parse_json(text)["features"]:
        geometry = item["geometry"] or {"type": "MultiPolygon", "coordinates": []}
        parts = geometry["coordinates"]
        parts = [parts] if geometry["type"] == "Polygon" else parts
        outlines.append([_closed_ring(part[0]) for part in parts])
    return outlines


def _closed_ring(positions: Any) -> Array:
    """Return a closed outline (m, 2) [deg]."""
    ring = np.array(positions, dtype=np.float64)
    if ring.ndim != 2 or ring.shape[1] != 2 or len(ring) < 4:
        raise ValueError(f"an outline of shape {ring.shape}")
    return _in_degrees(ring)
