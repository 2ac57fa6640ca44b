"""Heights without image coordinates: laser altimetry of ICESat-2, GEDI or lidar, as text."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from barpc.errors import InputError
from barpc.pointio.correspondences import TURNS, cells_of, header_of, numbers_of, require_columns
from barpc.scene import Altimetry
from barpc.sidefile import TABLE, read_text

HEIGHT_SIGMA = 0.5  # m, of a height whose file states none: ICESat-2 and GEDI over gentle ground
FLAT_SIGMA = 1.0  # m, of its place along an axis, each point's own
_HIGHEST = 12e3  # m: what is higher or lower stands for "no height" (-9999 is so low, and is no place on land)
_FILL = -9999.0  # m: of GEDI and many others

COLUMNS = {
    "lon": ("lon", "long", "longitude", "lng", "lon_lowestmode"),
    "lat": ("lat", "latitude", "lat_lowestmode"),
    "alt": (
        *("alt", "altitude", "height", "h", "z", "elevation", "elev"),
        *("h_ph", "h_li", "h_te_best_fit", "h_mean", "elev_lowestmode"),
    ),
    "sigma": ("sigma", "sigma_m", "sigma_z", "sigma_alt", "accuracy", "h_li_sigma", "h_te_uncertainty"),
    "sigma_flat": ("sigma_flat", "sigma_xy", "sigma_horizontal", "accuracy_xy"),
}
"""Quantity -> what files call it: ICESat-2's ATL03, ATL06 and ATL08, GEDI's L2A, too."""


def read_altimetry(path: Path | str) -> Altimetry:
    """Read the heights of a text: a header that names columns, or lines of lon, lat, alt, perhaps sigma, sigma_flat.

    Cells between commas, semicolons, tabs or blanks. Lines whose height is blank, no number or a fill value are left
    out. InputError where a line does not parse, a place is none in degrees, or no height is left.
    """
    path = Path(path)
    columns: dict[str, int] = {}
    delimiter, rows = ",", []
    for number, raw in enumerate(read_text(path, TABLE).splitlines(), start=1):
        if not raw.strip() or raw.lstrip().startswith("#"):
            continue
        if not columns:
            delimiter = next((sign for sign in "\t;," if sign in raw), " ")
            words = cells_of(raw, delimiter)
            columns = _columns(path, words)
            if numbers_of(words[:3]) is None:
                continue
        try:
            row = cells_of(raw, delimiter)
            cells = [row[place] if place < len(row) else "" for place in columns.values()]
            if delimiter == ";":  # where numbers have decimal commas
                cells = [cell.replace(",", ".") for cell in cells]
            rows.append([float(cell) if cell else np.nan for cell in cells])
        except (ValueError, csv.Error) as error:
            raise InputError(f"{path}, line {number}: expected {', '.join(columns)} ({error})") from error
    return _checked(path, columns, rows)


def _columns(path: Path, words: Sequence[str]) -> dict[str, int]:
    """Return each quantity's column by the first line: its names, or the order lon, lat, alt, sigma, sigma_flat."""
    if numbers_of(words[:3]) is not None and 3 <= len(words) <= len(COLUMNS):
        return dict(zip(COLUMNS, range(len(words)), strict=False))
    found = header_of(words, COLUMNS)
    require_columns(path, ("lon", "lat", "alt"), found, words)
    return found


def _checked(path: Path, columns: dict[str, int], rows: Sequence[Sequence[float]]) -> Altimetry:
    values = np.array(rows, dtype=np.float64).reshape(-1, max(len(columns), 1))
    given = {name: values[:, place] for place, name in enumerate(columns)}
    if len(values):
        with np.errstate(invalid="ignore"):
            known = (np.abs(given["alt"]) < _HIGHEST) & (given["alt"] != _FILL)
        given = {name: column[known] for name, column in given.items()}
    if not len(values) or not len(given["alt"]):
        raise InputError(f"{path}: holds no height")
    place = np.column_stack([given["lon"], given["lat"]])
    wrong = ~(np.abs(place) <= (TURNS, 90.0)).all(axis=1)  # NaN fails, too
    if wrong.any():
        lon, lat = place[wrong.argmax()]
        raise InputError(
            f"{path}: {lon:g}, {lat:g} is no longitude and latitude in degrees; map coordinates are not read"
        )
    count = len(place)
    sigma = given.get("sigma", np.full(count, np.nan))
    flat = given.get("sigma_flat", np.full(count, np.nan))
    try:
        return Altimetry(
            np.column_stack([place, given["alt"]]),
            np.where(np.isnan(sigma), HEIGHT_SIGMA, sigma),
            np.where(np.isnan(flat), FLAT_SIGMA, flat),
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
