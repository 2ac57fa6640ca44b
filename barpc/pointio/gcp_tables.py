"""The table of GCPs of a file: names of its columns, and defaults of values that are not stated."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from barpc.base.errors import InputError, listed
from barpc.base.geodesy import Array
from barpc.pointio.columns import guessed
from barpc.pointio.tables import GROUND_SIGMA, IMAGE_SIGMA, Names, Texts, lacking
from barpc.rasters.vertical import Vertical

GCP_NAMES: Names = {
    "id": ("id", "name", "gcp", "gcp_id", "point", "point_id", "label"),
    "image": ("image", "file", "filename", "image_name", "img", "view"),
}
SIGMAS: Names = {
    "sigma": ("sigma", "sigma_m", "accuracy"),  # east, north and up
    "sigma_xy": ("sigma_xy", "sigma_en", "sigma_horizontal", "accuracy_xy"),
    "sigma_x": ("sigma_x", "sigma_e", "sigma_east", "sigma_lon", "sx"),
    "sigma_y": ("sigma_y", "sigma_n", "sigma_north", "sigma_lat", "sy"),
    "sigma_z": ("sigma_z", "sigma_u", "sigma_up", "sigma_alt", "sigma_height", "sz", "accuracy_z"),
    "sigma_px": ("sigma_px", "sigma_image", "sigma_pixel"),
    "sigma_col": ("sigma_col", "scol"),
    "sigma_row": ("sigma_row", "srow"),
}
KNOWN: Names = {
    **GCP_NAMES, **SIGMAS, "enable": ("enable", "enabled"), "crs": ("crs", "epsg", "srid"),
    "east": ("east",), "north": ("north",),
}  # fmt: skip
TEXTS = "id", "image", "enable", "crs"
ALONE = (GROUND_SIGMA,) * 3
NAN = float("nan")

Row = tuple[Any, ...]
"""Name, image (None: not named) and the nine numbers of a GCP in an image."""


class GcpTable(NamedTuple):
    """GCPs (K,) as a file holds them: it repeats the ground point for each of its images."""

    names: Sequence[str]  # empty: called by its place among the points
    images: Texts | None  # None: the file names none
    numbers: Array  # (K, 9): x, y, altitude (NaN: none), their sigmas east, north, up [m], col, row, their sigma [px]
    apart: str = ""  # "ground" or "image" points alone: the other columns are NaN
    crs: str | None = None  # as the file says it; None: longitude and latitude, or nothing said
    vertical: Vertical = Vertical()  # what altitudes count from, and their unit, as a column says it
    said: str = ""  # what was taken for what, where that had to be guessed

    @staticmethod
    def of_rows(rows: Iterable[Row], apart: str = "") -> GcpTable:
        """Gather the rows that a reader yields."""
        names, images, numbers = list[str](), dict[str | None, int](), array("d")
        index = array("q")
        for name, image, *values in rows:
            names.append(name)
            index.append(images.setdefault(image, len(images)))
            numbers.extend(values)
        of = None if None in images else Texts([str(image) for image in images], np.array(index, dtype=np.int64))
        return GcpTable(names, of, np.array(numbers).reshape(-1, 9), apart)


def named(path: Path, words: Sequence[str], lax: bool = False) -> tuple[dict[str, int], GcpTable]:
    """Return the columns of a table by their names, and an empty table with their datum and units.

    In a `lax` table columns of errors may stand that are no accuracies. InputError where the names do not tell.
    """
    try:
        columns, said, vertical = guessed(words, KNOWN)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    left = [word for i, word in enumerate(words) if i not in columns.values() and not lax]
    if stray := next(filter(re.compile("sigma|std|stdev|acc|err", re.IGNORECASE).match, left), None):
        raise InputError(
            f"{path}: column {stray[:40]!r} is none that is read; accuracies are called {', '.join(SIGMAS)}"
        )
    place = {"lon", "lat"} <= columns.keys() or {"east", "north"} <= columns.keys()
    seen = {"col", "row"} <= columns.keys()
    apart = {(True, True): "", (True, False): "ground", (False, True): "image"}.get((place, seen))
    if apart is None or (apart and "id" not in columns):
        needed = ("lon", "lat", "col", "row")[2 * place :]
        raise lacking(path, [name for name in needed if name not in columns], words)
    return columns, GcpTable([], None, np.empty((0, 9)), apart, None, vertical, ", ".join(said))


def of_columns(path: Path, columns: Mapping[str, Any], empty: GcpTable) -> GcpTable:
    """Return a table of its columns: numbers (NaN or None: blank) or `Texts`; sigmas not stated are the default.

    InputError for points of several reference systems.
    """
    num = max(len(cells.index if isinstance(cells, Texts) else cells) for cells in columns.values())

    def stated(key: str, default: float | Array) -> Array:
        cells = columns.get(key)
        if cells is None:
            return np.broadcast_to(np.asarray(default, dtype=np.float64), num)
        if isinstance(cells, np.ndarray):
            return cells
        known = np.array([cell is not None for cell in cells], dtype=bool)
        return np.where(known, np.array(cells, dtype=np.float64), default)

    level = stated("sigma_xy", every := stated("sigma", GROUND_SIGMA))
    pixels = np.max([stated(key, -np.inf) for key in ("sigma_px", "sigma_col", "sigma_row")], axis=0)
    x, y = ("lon", "lat") if {"lon", "lat"} <= columns.keys() else ("east", "north")
    values = [stated(x, NAN), stated(y, NAN), stated("alt", NAN)]
    values += [stated("sigma_x", level), stated("sigma_y", level), stated("sigma_z", every)]
    values += [stated("col", NAN), stated("row", NAN), np.where(pixels == -np.inf, IMAGE_SIGMA, pixels)]
    names = [name.strip() for name in columns["id"].per_row()] if "id" in columns else [""] * num
    systems = [str(text).strip() for text in (columns["crs"].different if "crs" in columns else ())]
    if len(systems) > 1:
        raise InputError(f"{path}: points of {len(systems)} reference systems, {listed(systems, 3)}; one file each")
    crs = "EPSG:" * "".join(systems).isdecimal() + "".join(systems) or None
    table = empty._replace(names=names, images=columns.get("image"), numbers=np.column_stack(values), crs=crs)
    return _switched_on(table, columns["enable"]) if "enable" in columns else table


def _switched_on(table: GcpTable, enable: Texts) -> GcpTable:
    """Return a table without the points that its file switches off."""
    off = [str(text).strip().lower() in ("0", "0.0", "false") for text in enable.different]
    kept = np.flatnonzero(~np.array(off, dtype=bool)[enable.index]).tolist()
    left_out = len(table.names) - len(kept)
    words = f"points that it switches off: {left_out}, left out" if left_out else ""
    return table._replace(
        names=[table.names[i] for i in kept],
        images=table.images and Texts(table.images.different, table.images.index[kept]),
        numbers=table.numbers[kept],
        said=", ".join(filter(None, (table.said, words))),
    )
