"""Correspondences from files: tables of points (CSV, npz, GeoJSON) and direct-localisation grids.

`READERS` is the table of kinds. Image coordinates come out with (0, 0) at the centre of the top-left pixel.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from barpc.errors import InputError
from barpc.geodesy import Array
from barpc.raster import open_raster
from barpc.record import load_npz
from barpc.sidefile import GEOJSON, TABLE, Kind, read_head, read_json, read_text

_FAR = 1e9  # px and m: no node comes near
GRID_POINTS = Kind("a localisation grid", TABLE.most)

_COLUMNS = {
    "lon": ("lon", "long", "longitude", "lng"),
    "lat": ("lat", "latitude"),
    "alt": ("alt", "altitude", "height", "h", "z", "elevation", "height_above_datum"),
    "col": ("col", "column", "samp", "sample", "pixel", "x"),
    "row": ("row", "line", "y"),
}
_SIGMA = ("sigma", "sigma_px")


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Ground points and where an image shows them.

    Parameters
    ----------
    ground : (N, 3)
        lon, lat [deg], alt [m above the ellipsoid].
    image : (N, 2)
        col, row [px].
    sigma : (N,) or None
        Standard deviation of the image points [px].
    """

    ground: Array
    image: Array
    sigma: Array | None = None


def read_correspondences(path: Path | str, *, altitudes: Sequence[float] | None = None) -> Correspondences:
    """Read a table of points or a direct-localisation grid, whichever the file is.

    Parameters
    ----------
    path : Path or str
        CSV (a header of names, or the columns lon, lat, alt, col, row), npz (arrays ``ground`` and ``image``
        or one a column), GeoJSON (GCPs with ``ji`` = [col, row]), or a GeoTIFF whose bands are longitude and
        latitude of one altitude layer after the other, on a regular grid of image points.
    altitudes : sequence of float, optional
        Altitudes of the layers of a grid that does not state them [m].

    Raises
    ------
    InputError
        No such file, not one of these, columns that are missing or do not parse.
    """
    path = Path(path)
    kind = correspondence_kind(path, altitudes)
    if kind is None:
        raise InputError(f"{path}: neither a table of points (CSV, npz, GeoJSON) nor a localisation grid")
    if kind == "grid":
        return read_grid(path, altitudes)
    return READERS[kind](path)


def correspondence_kind(path: Path, altitudes: Sequence[float] | None = None) -> str | None:
    """What a file is: a row of `READERS`, "grid", or None for neither (an image or an RPC file)."""
    head = read_head(path, TABLE, 65536)
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        with open_raster(path) as dataset:
            return "grid" if altitudes is not None or "ALTITUDE_B0" in dataset.tags() else None
    if head[:2] == b"PK":
        return "npz"
    if head.lstrip()[:1] == b"{":
        return "geojson" if b'"FeatureCollection"' in head else None
    return "csv" if _is_table(head) else None


def _is_table(head: bytes) -> bool:
    """Whether a text begins with a header that names columns, or with a line of five numbers."""
    try:
        lines = head.decode("utf-8-sig", errors="strict" if len(head) < 65536 else "ignore").splitlines()
    except UnicodeDecodeError:
        return False
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    words = _split(first)
    return (_numbers(words) is not None and len(words) >= 5) or {"lon", "lat"} <= set(_header(words))


def _split(line: str) -> list[str]:
    return [word.strip().strip('"') for word in re.split(r"[,;\t]|\s+", line.strip()) if word.strip()]


def _numbers(words: Sequence[str]) -> list[float] | None:
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


def _header(words: Sequence[str]) -> dict[str, int]:
    """Column of each quantity that a header names."""
    lower = [re.sub(r"[\[(].*", "", word.lower()).strip() for word in words]
    names = {**_COLUMNS, "sigma": _SIGMA}
    found = {key: [lower.index(a) for a in aliases if a in lower] for key, aliases in names.items()}
    return {key: hits[0] for key, hits in found.items() if hits}


def read_csv(path: Path) -> Correspondences:
    """A text table: separated by commas, semicolons, tabs or blanks; ``#`` begins a comment."""
    rows: list[list[float]] = []
    columns: dict[str, int] = {}
    for number, raw in enumerate(read_text(path, TABLE).splitlines(), start=1):
        words = _split(raw.split("#", 1)[0])
        if not words:
            continue
        if not columns:
            columns = dict(zip(_COLUMNS, range(5), strict=True)) if _numbers(words) else _header(words)
            missing = [name for name in _COLUMNS if name not in columns]
            if missing:
                raise InputError(f"{path}: no column {', '.join(missing)}; found {', '.join(words)}")
            if not _numbers(words):
                continue
        values = _numbers(words)
        if values is None or len(values) <= max(columns.values()):
            raise InputError(
                f"{path}, line {number}: expected numbers in {max(columns.values()) + 1} columns"
            )
        rows.append([values[columns[name]] for name in columns])
    if not rows:
        raise InputError(f"{path}: no points in it")
    table = np.array(rows)
    return _assembled(path, {name: table[:, i] for i, name in enumerate(columns)})


def read_npz(path: Path) -> Correspondences:
    """Arrays ``ground`` (N, 3) and ``image`` (N, 2), or one array a column; ``sigma`` (N,) if known."""
    try:
        arrays = {name: np.asarray(value, dtype=np.float64) for name, value in load_npz(path).items()}
    except (ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not an npz of numbers ({error})") from error
    if "ground" in arrays and "image" in arrays:
        return _checked(path, arrays["ground"], arrays["image"], arrays.get("sigma"))
    columns = {key: arrays[list(arrays)[i]] for key, i in _header(list(arrays)).items()}
    missing = [name for name in _COLUMNS if name not in columns]
    if missing:
        raise InputError(
            f"{path}: neither ground and image nor {', '.join(missing)}; has {', '.join(arrays)}"
        )
    return _assembled(path, columns)


def _assembled(path: Path, columns: dict[str, Array]) -> Correspondences:
    if len({column.shape for column in columns.values()}) > 1:
        raise InputError(f"{path}: columns of different lengths")
    ground = np.stack([columns[name] for name in ("lon", "lat", "alt")], axis=-1)
    return _checked(path, ground, np.stack([columns["col"], columns["row"]], axis=-1), columns.get("sigma"))


def _checked(path: Path, ground: Array, image: Array, sigma: Array | None) -> Correspondences:
    """The points, whose arrays must have one length."""
    shapes = [array.shape for array in (ground, image, sigma) if array is not None]
    n = len(ground) if ground.ndim else 0
    if shapes != [(n, 3), (n, 2), (n,)][: len(shapes)]:
        raise InputError(f"{path}: arrays of shapes {shapes}, not (N, 3), (N, 2), (N,)")
    return Correspondences(ground, image, sigma)


def read_geojson(path: Path) -> Correspondences:
    """GCPs as points lon, lat, alt with their image position in the property ``ji`` or ``col``, ``row``."""
    document = read_json(path, GEOJSON)
    try:
        points = [_feature(feature) for feature in document["features"]]
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(f"{path}: not a GeoJSON of 3-D points with a property ji ({error!r})") from error
    if not points:
        raise InputError(f"{path}: no points in it")
    table = np.array(points)
    return Correspondences(table[:, :3], table[:, 3:])


def _feature(feature: dict[str, Any]) -> list[float]:
    lon, lat, alt = feature["geometry"]["coordinates"]
    properties = feature["properties"]
    col, row = properties["ji"] if "ji" in properties else (properties["col"], properties["row"])
    return [float(value) for value in (lon, lat, alt, col, row)]


def read_grid(path: Path, altitudes: Sequence[float] | None = None) -> Correspondences:
    """A direct-localisation grid: bands lon, lat of each altitude layer, nodes by the geotransform.

    The geotransform counts from the corner of the first pixel, as GDAL does; half a pixel is taken off.

    Parameters
    ----------
    path : Path
        GeoTIFF.
    altitudes : sequence of float, optional
        Of the layers [m]; by default from the tags ``ALTITUDE_B0``, ``ALTITUDE_B2``, ...
    """
    with open_raster(path) as dataset:
        GRID_POINTS.check(f"{path}, read", 8 * dataset.count * dataset.width * dataset.height)
        bands = np.real(dataset.read()).astype(np.float64)
        to_image, tags = dataset.transform, dataset.tags()
    layers = len(bands) // 2
    if altitudes is None:
        stated = [_numbers([tags.get(f"ALTITUDE_B{2 * i}", "nan")]) for i in range(layers)]
        altitudes = [np.nan if value is None else value[0] for value in stated]
    if len(bands) % 2 or len(altitudes) != layers or not np.isfinite(altitudes).all():
        raise InputError(
            f"{path}: {len(bands)} bands are {layers} layers of lon and lat, but {len(altitudes)} altitudes "
            "are known; give one altitude a layer"
        )
    row, col = np.indices(bands.shape[1:], dtype=np.float64)
    a, b, c, d, e, f = to_image[:6]
    nodes = np.stack([a * col + b * row + c, d * col + e * row + f], axis=-1) - 0.5
    image = np.broadcast_to(nodes, (layers, *nodes.shape)).reshape(-1, 2)
    alt = np.broadcast_to(np.asarray(altitudes, dtype=np.float64)[:, None, None], (layers, *col.shape))
    ground = np.stack([bands[::2], bands[1::2], alt], axis=-1).reshape(-1, 3)
    ok = np.isfinite(ground).all(axis=1)
    if (np.abs(ground[ok]) > (540.0, 90.0, _FAR)).any() or not (np.abs(image) <= _FAR).all():
        raise InputError(f"{path}: a node of it is no longitude, latitude and altitude, or no image point")
    return Correspondences(ground[ok], image[ok])


READERS: dict[str, Callable[[Path], Correspondences]] = {
    "csv": read_csv,
    "npz": read_npz,
    "geojson": read_geojson,
}
"""Kind of table -> reader."""
