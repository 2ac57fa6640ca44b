"""Ground points without a camera: correspondences that an RPC is fitted to, heights by a laser.

Image coordinates have (0, 0) at the centre of the top-left pixel. Altitudes are ellipsoidal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.errors import InputError, plain
from barpc.base.frozen import load_npz
from barpc.base.geodesy import ALTITUDES, FAR, INFERRED, Array
from barpc.base.remote import Place
from barpc.base.sidefile import GEOJSON, NUMBER, TABLE, Kind, read_head, read_json
from barpc.pointio.tables import (
    COLUMNS,
    Names,
    first_words,
    header_of,
    like_altitudes,
    numbers_of,
    read_table,
    vertical_of_column,
)
from barpc.rasters.dem import HeightGrid, datum_of, geoid_of
from barpc.rasters.raster import driver_of, open_raster
from barpc.rasters.vertical import ELLIPSOID, Vertical
from barpc.scene import Altimetry

GROUND_SIGMA = 1.0  # standard deviation [m] along an axis of a GCP, or of the place of a height, whose file states none
IMAGE_SIGMA = 0.5  # standard deviation of each image coordinate [px], of GCPs and tie points whose file states none
HEIGHT_SIGMA = 0.5  # m, of a height whose file states none: ICESat-2 and GEDI over gentle ground
GRID_TAG = "ALTITUDE_B0"  # of a raster that is a localisation grid
TURNS = 540.0  # deg: longitudes are taken by whole turns

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


def _tags(path: Place) -> tuple[list[tuple[Any, ...]], tuple[int, int]]:
    """Return the GCP tags of an image, each a name, lon, lat, alt and col, row as they stand; its width and height."""
    with open_raster(path) as dataset:
        (gcps, crs), size = dataset.gcps, (int(dataset.width), int(dataset.height))
    if gcps and crs is not None and not crs.is_geographic:
        raise InputError(f"{path}: its GCPs are in {crs}; longitude and latitude on WGS84 are needed")
    for n, gcp in enumerate(gcps, 1):
        if gcp.z is None:
            raise InputError(f"{path}: GCP {gcp.id or n} has no altitude")
    return [(str(gcp.id or n), gcp.x, gcp.y, gcp.z, gcp.col, gcp.row) for n, gcp in enumerate(gcps, 1)], size


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
        raise InputError(f"{path}: not an npz of numbers ({plain(error)})") from error
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
        raise InputError(f"{path}: not a GeoJSON of 3-D points with {words} ({plain(error)})") from error


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


def read_altimetry(path: Path | str, heights: str | None = None) -> Altimetry:
    """Read the heights of a text: a header that names columns, or lines of lon, lat, alt, perhaps sigma, sigma_flat.

    They are brought to the ellipsoid and to metres from what the name of their column says; `heights` is what they
    count from where it says nothing: a geoid, or "ellipsoidal".
    Lines whose height is blank or none on Earth, as fill values are, are left out. InputError where a line does not
    parse, a place is none in degrees, or no height is left.
    """
    path = Path(path)
    order = list(_HEIGHTS)
    head = first_words(read_head(path, TABLE))
    like = [] if "alt" in header_of(head, _HEIGHTS) else like_altitudes(head)
    if len(like) > 1:
        raise InputError(f"{path}: columns {', '.join(like)} could be the altitude; rename one alt")
    names = {**_HEIGHTS, "alt": (*_HEIGHTS["alt"], *like)}
    words, table = read_table(path, names, order[:3], unnamed=order, blank=order)
    lon, lat, alt = (np.array(table[name], dtype=np.float64) for name in order[:3])
    at = header_of(words, names).get("alt")
    own = Vertical(ELLIPSOID, provenance=INFERRED) if at is None else vertical_of_column(words[at])
    by_person = None if own.stated else heights
    file, _, _ = geoid_of(own, own.by(by_person), by_person is not None)
    alt = alt * own.metres + (0.0 if file is None else HeightGrid.open(file).sample(lon, lat))
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
        name = f"the altimetry of {path.name}"
        datums = datum_of(None if by_person else own, ground, "altimetry", name)
        return Altimetry(ground, sigma, flat, datums)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
