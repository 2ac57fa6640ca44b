"""Ground points and where images show them: GCPs, correspondences that an RPC is fitted to, heights by a laser.

Image coordinates have (0, 0) at the centre of the top-left pixel. Those of GCPs are taken as they stand, as ASP and
orthority mean them; GDAL leaves the meaning of its tags to the application. Altitudes are ellipsoidal.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.errors import InputError, listed
from barpc.base.frozen import load_npz
from barpc.base.geodesy import ALTITUDES, FAR, Array
from barpc.base.remote import Place
from barpc.base.sidefile import GEOJSON, NUMBER, TABLE, Kind, opened_text, read_head, read_json
from barpc.pointio.names import ViewNames
from barpc.pointio.tables import COLUMNS, Names, first_words, header_of, numbered, numbers_of, read_table
from barpc.rasters.raster import driver_of, open_raster
from barpc.scene import Altimetry, GroundPoints, IntArray

GROUND_SIGMA = 1.0  # standard deviation [m] along an axis of a GCP, or of the place of a height, whose file states none
IMAGE_SIGMA = 0.5  # standard deviation of each image coordinate [px], of GCPs and tie points whose file states none
HEIGHT_SIGMA = 0.5  # m, of a height whose file states none: ICESat-2 and GEDI over gentle ground
GRID_TAG = "ALTITUDE_B0"  # of a raster that is a localisation grid
TURNS = 540.0  # deg: longitudes are taken by whole turns

_NAMES: Names = {
    "id": ("id", "name", "gcp", "gcp_id", "point", "point_id", "label"),
    "image": ("image", "file", "filename", "image_name", "img", "view"),
}
_SIGMAS: Names = {
    "sigma": ("sigma", "sigma_m", "accuracy"),  # east, north and up
    "sigma_xy": ("sigma_xy", "sigma_en", "sigma_horizontal", "accuracy_xy"),
    "sigma_x": ("sigma_x", "sigma_e", "sigma_east", "sigma_lon", "sx"),
    "sigma_y": ("sigma_y", "sigma_n", "sigma_north", "sigma_lat", "sy"),
    "sigma_z": ("sigma_z", "sigma_u", "sigma_up", "sigma_alt", "sigma_height", "sz", "accuracy_z"),
    "sigma_px": ("sigma_px", "sigma_image", "sigma_pixel"),
    "sigma_col": ("sigma_col", "scol"),
    "sigma_row": ("sigma_row", "srow"),
}
_POINTS: Names = {**COLUMNS, "sigma": ("sigma", "sigma_px")}
_HEIGHTS: Names = {
    "lon": (*COLUMNS["lon"], "lon_lowestmode"),
    "lat": (*COLUMNS["lat"], "lat_lowestmode"),
    "alt": (
        *("alt", "altitude", "height", "h", "z", "elevation", "elev"),
        *("h_ph", "h_li", "h_te_best_fit", "h_mean", "elev_lowestmode"),
    ),
    "sigma": ("sigma", "sigma_m", "sigma_z", "sigma_alt", "accuracy", "h_li_sigma", "h_te_uncertainty"),
    "sigma_flat": ("sigma_flat", "sigma_xy", "sigma_horizontal", "accuracy_xy"),
}
"""As ICESat-2's ATL03, ATL06 and ATL08 and GEDI's L2A call it, too."""


@dataclass(frozen=True, eq=False)
class _Observed:
    """GCPs (K,) as images show them: the files repeat the ground point for each of its images."""

    names: Sequence[str]  # empty: called by its place among the points
    view: IntArray  # (K,)
    numbers: Array  # (K, 9): lon, lat, alt, their sigmas east, north, up [m], col, row, their sigma [px]

    @staticmethod
    def of_rows(rows: Iterable[_Row]) -> _Observed:
        """Gather the rows that a reader yields."""
        names, views, numbers = list[str](), array("q"), array("d")
        for name, view, *values in rows:
            names.append(name)
            views.append(view)
            numbers.extend(values)
        return _Observed(names, np.array(views, dtype=np.int64), np.array(numbers).reshape(-1, 9))


_Row = tuple[Any, ...]
"""Name, view and the nine numbers of a GCP in an image."""


def read_gcps(path: Path | str, names: Sequence[str]) -> GroundPoints:
    """Read GCPs and where they are seen, of a CSV or `.gcp` file, a GeoJSON file, or an image with GCP tags.

    Observations in other images than the views called `names` are left out, and these named in `strangers`. InputError
    where the file does not parse, or holds no point of these views.
    """
    path = Path(path)
    head = read_head(path, TABLE)
    views = ViewNames(names, str(path))
    if head.lstrip().startswith(b"{"):
        found = _Observed.of_rows(_read_geojson(path, views))
    elif driver_of(head) is not None or b"\0" in head:
        found = _Observed.of_rows(_read_tags(path, views))
    else:
        words = first_words(head)
        named = not any(numbers_of([word]) for word in words[1:4]) and header_of(words, _POINTS)
        found = _read_csv(path, views) if named else _Observed.of_rows(_read_asp(path, views))
    if not len(found.view):
        others = f"; it names {listed(list(views.strangers))}" if views.strangers else ""
        raise InputError(f"{path}: no GCP of {listed(names)}{others}")
    try:
        return replace(_assembled(found), strangers=tuple(views.strangers))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _read_asp(path: Path, views: ViewNames) -> Iterator[_Row]:
    """Read the lines `id lat lon alt sigma_x sigma_y sigma_z image col row sigma_col sigma_row [image ...]`."""
    with opened_text(path, TABLE) as lines:
        for number, raw in enumerate(lines, start=1):
            line = re.split(r"(?:^|\s)#", raw, maxsplit=1)[0] if "#" in raw else raw
            words = line.replace(",", " ").split()
            if not words:
                continue
            try:
                lat, lon, *ground = map(float, words[1:7])
                if len(words) < 12 or len(words) % 5 != 2:
                    raise ValueError(f"{len(words)} words")
                for i in range(7, len(words), 5):
                    col, row, *spread = map(float, words[i + 1 : i + 5])
                    view = views.find(words[i])
                    if view is not None:
                        yield words[0], view, lon, lat, *ground, col, row, max(spread)
            except ValueError as error:
                raise InputError(
                    f"{path}, line {number}: expected 'id lat lon alt sx sy sz image col row scol srow ...', or a CSV "
                    f"that begins with its columns' names ({error})"
                ) from error


def _read_csv(path: Path, views: ViewNames) -> _Observed:
    """Read a header of column names, then a line for each point and image; sigmas not stated are the default."""
    needed = [*COLUMNS, "image"][: len(COLUMNS) + (len(views.names) > 1)]
    columns = {**COLUMNS, **_NAMES, **_SIGMAS}
    words, table = read_table(path, columns, needed, texts=_NAMES, blank=_SIGMAS)
    for word in (word for i, word in enumerate(words) if i not in header_of(words, columns).values()):
        if re.match("sigma|std|stdev|acc|err", word.lower()):
            raise InputError(
                f"{path}: column {word[:40]!r} is none that is read; accuracies are called {', '.join(_SIGMAS)}"
            )
    num = len(table["lon"])

    def stated(key: str, default: Array) -> Array:
        cells = table.get(key, [None] * num)
        known = np.array([cell is not None for cell in cells], dtype=bool)
        return np.where(known, np.array(cells, dtype=np.float64), default)

    every = stated("sigma", np.full(num, GROUND_SIGMA))
    level = stated("sigma_xy", every)
    sigmas = (stated("sigma_x", level), stated("sigma_y", level), stated("sigma_z", every))
    pixels = np.max([stated(key, np.full(num, -np.inf)) for key in ("sigma_px", "sigma_col", "sigma_row")], axis=0)
    pixels[pixels == -np.inf] = IMAGE_SIGMA
    numbers = np.column_stack(
        [*(table[key] for key in ("lon", "lat", "alt")), *sigmas, table["col"], table["row"], pixels]
    )
    view = (
        views.of(map(str, table["image"].different))[table["image"].index]
        if "image" in table
        else np.zeros(num, np.int64)
    )
    names = [name.strip() for name in table["id"].per_row()] if "id" in table else [""] * num
    kept = np.flatnonzero(view >= 0)
    return _Observed([names[i] for i in kept], view[kept], numbers[kept])


def _read_geojson(path: Path, views: ViewNames) -> Iterator[_Row]:
    """Yield the features with a 3-D point and the properties `ji` (col, row), `filename`, perhaps `id` and sigmas."""
    for (lon, lat, alt, col, row), properties in geojson_points(path, "filename"):
        view = views.find(str(properties["filename"]))
        if view is not None:
            name = "" if properties.get("id") is None else str(properties["id"])
            try:
                east, north, up = (float(value) for value in properties.get("sigma_m", (GROUND_SIGMA,) * 3))
                spread = float(properties.get("sigma_px", IMAGE_SIGMA))
            except (TypeError, ValueError) as error:
                raise InputError(f"{path}: sigma_m is [east, north, up], sigma_px a number ({error})") from error
            yield name, view, lon, lat, alt, east, north, up, col, row, spread


def _read_tags(path: Path, views: ViewNames) -> Iterator[_Row]:
    """Yield the GCP tags of an image: they are seen in that image alone."""
    view = views.index(str(path))
    for name, lon, lat, alt, col, row in _tags(path)[0]:
        yield name, view, lon, lat, alt, *(GROUND_SIGMA,) * 3, col, row, IMAGE_SIGMA


def _tags(path: Place) -> tuple[list[_Row], tuple[int, int]]:
    """Return the GCP tags of an image, each a name, lon, lat, alt and col, row as they stand; its width and height."""
    with open_raster(path) as dataset:
        (gcps, crs), size = dataset.gcps, (int(dataset.width), int(dataset.height))
    if gcps and crs is not None and not crs.is_geographic:
        raise InputError(f"{path}: its GCPs are in {crs}; longitude and latitude on WGS84 are needed")
    for n, gcp in enumerate(gcps, 1):
        if gcp.z is None:
            raise InputError(f"{path}: GCP {gcp.id or n} has no altitude")
    return [(str(gcp.id or n), gcp.x, gcp.y, gcp.z, gcp.col, gcp.row) for n, gcp in enumerate(gcps, 1)], size


def _assembled(found: _Observed) -> GroundPoints:
    """Return the observations of points of the same name and place as those of one point, in their first order."""
    keys = np.column_stack([numbered(found.names, {}), found.numbers[:, :3]])
    order = np.lexsort(keys.T)
    new = np.append(True, (np.diff(keys[order], axis=0) != 0).any(axis=1))
    first = order[new]  # the sort is stable
    point = np.empty(len(order), dtype=np.int64)
    point[order] = np.argsort(np.argsort(first))[np.cumsum(new) - 1]
    first.sort()
    names = tuple(found.names[i] or f"gcp_{n}" for n, i in enumerate(first, 1))
    ground = found.numbers[first]
    wrong = ~(np.abs(ground[:, :3]) <= (TURNS, TURNS, FAR)).all(axis=1)  # NaN fails, too
    if wrong.any():
        raise InputError(
            f"GCP {names[int(wrong.argmax())]}: a coordinate is not finite, or no longitude and latitude in degrees; "
            "map coordinates are not read"
        )
    return GroundPoints(
        names=names,
        lonlatalt=ground[:, :3],
        sigma=ground[:, 3:6],
        point=point,
        view=found.view,
        xy=found.numbers[:, 6:8],
        xy_sigma=found.numbers[:, 8],
    )


# --- correspondences --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Ground points and where an image shows them."""

    ground: Array  # (N, 3): lon, lat [deg], alt [m above the ellipsoid]
    image: Array  # (N, 2): col, row [px]
    sigma: Array | None = None  # (N,): standard deviation of the image points [px]
    note: str = ""  # how they were understood


def read_correspondences(path: Path | str, *, altitudes: Sequence[float] | None = None) -> Correspondences:
    """Read a table of points or a direct-localisation grid, whichever the file is.

    Parameters
    ----------
    path : Path or str
        CSV (a header of names, or the columns lon, lat, alt, col, row), npz (arrays ``ground`` and ``image`` or one a
        column), GeoJSON (GCPs with ``ji`` = [col, row]), or a GeoTIFF whose bands are longitude and latitude of one
        altitude layer after the other, on a regular grid of image points; else an InputError.
    altitudes : sequence of float, optional, altitudes of the layers of a grid that does not state them [m]
    """
    path = Path(path)
    kind = correspondence_kind(path, altitudes)
    if kind is None:
        raise InputError(f"{path}: neither a table of points (CSV, npz, GeoJSON) nor a localisation grid")
    if kind == "grid":
        return read_grid(path, altitudes)
    columns: dict[str, Any] = dict.fromkeys(COLUMNS, ())
    if kind == "npz":
        columns = _columns_of_npz(path)
    elif kind == "csv":  # without a header: lon, lat, alt, col, row
        _, columns = read_table(path, _POINTS, list(COLUMNS), unnamed=list(COLUMNS))
    elif points := geojson_points(path):
        columns = dict(zip(COLUMNS, zip(*(numbers for numbers, _ in points), strict=True), strict=True))
    arrays = {name: np.array(column, dtype=np.float64) for name, column in columns.items()}
    if not arrays["lon"].size:
        raise InputError(f"{path}: no points in it")
    if {array.shape for array in arrays.values()} != {(arrays["lon"].size,)}:
        raise InputError(f"{path}: columns of different lengths")
    ground, image = (np.column_stack([arrays[key] for key in keys]) for keys in (("lon", "lat", "alt"), ("col", "row")))
    return Correspondences(ground, image, arrays.get("sigma"))


def read_gcp_grid(path: Place) -> tuple[Correspondences | None, tuple[int, int]]:
    """Return the GCP tags of an image, None without any, as the points of its camera; and its width and height [px].

    A grid from 0 to the last pixel, as Sentinel-1's, counts from the centre of the first pixel; any other from its
    corner, as GDAL does: half a pixel is taken off.
    """
    found, size = _tags(path)
    if not found:
        return None, size
    ground, image = (np.array([row[part] for row in found], dtype=np.float64) for part in (slice(1, 4), slice(4, 6)))
    centres = (image.min(axis=0) == 0).all() and (image.max(axis=0) == np.array(size) - 1).all()
    where = "centre" if centres else "corner"
    note = f"{len(found)} GCPs of {path.name}, counted from the {where} of the first pixel"
    return Correspondences(ground, image - (0.0 if centres else 0.5), note=note), size


def correspondence_kind(path: Place, altitudes: Sequence[float] | None = None) -> str | None:
    """Return the kind of a file: "csv", "npz", "geojson", "grid", or None for neither (an image or an RPC file)."""
    head = read_head(path, TABLE, 65536)
    if driver_of(head) == "GTiff":
        with open_raster(path) as dataset:
            return "grid" if altitudes is not None or GRID_TAG in dataset.tags() else None
    if head[:2] == b"PK":
        return "npz"
    if head.lstrip()[:1] == b"{":
        return "geojson" if b'"FeatureCollection"' in head else None
    words = first_words(head)  # a header that names columns, or a line of five numbers
    table = (numbers_of(words) is not None and len(words) >= 5) or {"lon", "lat"} <= set(header_of(words, _POINTS))
    return "csv" if table else None


def _columns_of_npz(path: Path) -> dict[str, Array]:
    """Return the arrays ``ground`` (N, 3) and ``image`` (N, 2), or one array a column; ``sigma`` (N,) if known."""
    found = load_npz(path)
    try:
        arrays = {name: np.asarray(value, dtype=np.float64) for name, value in found.items()}
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: not an npz of numbers ({error})") from error
    if "ground" in arrays and "image" in arrays:
        shapes = [arrays[key].shape for key in ("ground", "image", "sigma") if key in arrays]
        n = shapes[0][0] if shapes[0] else 0
        if shapes != [(n, 3), (n, 2), (n,)][: len(shapes)]:
            raise InputError(f"{path}: arrays of shapes {shapes}, not (N, 3), (N, 2), (N,)")
        columns = dict(zip(COLUMNS, (*arrays["ground"].T, *arrays["image"].T), strict=True))
        return columns | {key: arrays[key] for key in ("sigma",) if key in arrays}
    columns = {key: arrays[list(arrays)[i]] for key, i in header_of(list(arrays), _POINTS).items()}
    if missing := [name for name in COLUMNS if name not in columns]:
        raise InputError(f"{path}: neither ground and image nor {', '.join(missing)}; has {', '.join(arrays)}")
    return columns


def geojson_points(path: Path, *needed: str) -> list[tuple[list[float], dict[str, Any]]]:
    """Return the points of a GeoJSON: lon, lat, alt, col, row (property ``ji``, or ``col``, ``row``); properties.

    InputError where it is no such file, or has not all properties that are `needed`.
    """
    document = read_json(path, GEOJSON)
    try:
        return [_feature(feature, needed) for feature in document["features"]]
    except (ValueError, KeyError, TypeError, IndexError) as error:
        words = ", ".join(("ji", *needed))
        raise InputError(f"{path}: not a GeoJSON of 3-D points with {words} ({error!r})") from error


def _feature(feature: dict[str, Any], needed: Sequence[str]) -> tuple[list[float], dict[str, Any]]:
    lon, lat, alt = feature["geometry"]["coordinates"]
    properties = feature["properties"]
    col, row = properties["ji"] if "ji" in properties else (properties["col"], properties["row"])
    if missing := [key for key in needed if key not in properties]:
        raise KeyError(missing[0])
    return [float(value) for value in (lon, lat, alt, col, row)], properties


def read_grid(path: Place, altitudes: Sequence[float] | None = None) -> Correspondences:
    """Read a direct-localisation grid: bands lon, lat of each altitude layer, nodes by the geotransform.

    The geotransform counts from the corner of the first pixel, as GDAL does; half a pixel is taken off. Altitudes of
    the layers [m] are those given, or of the tags ``ALTITUDE_B0``, ``ALTITUDE_B2``, ...
    """
    with open_raster(path) as dataset:
        Kind("a localisation grid", TABLE.most).check(
            f"{path}, read", NUMBER * dataset.count * dataset.width * dataset.height
        )
        bands = np.real(dataset.read()).astype(np.float64)
        to_image, tags = dataset.transform, dataset.tags()
    layers = len(bands) // 2
    if altitudes is None:
        stated = [numbers_of([tags.get(f"ALTITUDE_B{2 * i}", "nan")]) for i in range(layers)]
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
    if (np.abs(ground[ok]) > (TURNS, 90.0, FAR)).any() or not (np.abs(image) <= FAR).all():
        raise InputError(f"{path}: a node of it is no longitude, latitude and altitude, or no image point")
    return Correspondences(ground[ok], image[ok])


# --- altimetry --------------------------------------------------------------------------------------------


def read_altimetry(path: Path | str) -> Altimetry:
    """Read the heights of a text: a header that names columns, or lines of lon, lat, alt, perhaps sigma, sigma_flat.

    Lines whose height is blank or none on Earth, as fill values are, are left out. InputError where a line does not
    parse, a place is none in degrees, or no height is left.
    """
    path = Path(path)
    order = list(_HEIGHTS)
    _, table = read_table(path, _HEIGHTS, order[:3], unnamed=order, blank=order)
    lon, lat, alt = (np.array(table[name], dtype=np.float64) for name in order[:3])
    known = (alt >= ALTITUDES[0]) & (alt <= ALTITUDES[1])
    if not known.any():
        raise InputError(f"{path}: holds no height")
    ground = np.column_stack([lon, lat, alt])[known]
    wrong = ~(np.abs(ground[:, :2]) <= (TURNS, 90.0)).all(axis=1)  # NaN fails, too
    if wrong.any():
        lon, lat = ground[wrong.argmax(), :2]
        raise InputError(
            f"{path}: {lon:g}, {lat:g} is no longitude and latitude in degrees; map coordinates are not read"
        )
    sigma, flat = (np.array(table.get(name, [None] * len(known)), dtype=np.float64)[known] for name in order[3:])
    sigma[np.isnan(sigma)], flat[np.isnan(flat)] = HEIGHT_SIGMA, GROUND_SIGMA
    try:
        return Altimetry(ground, sigma, flat)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
