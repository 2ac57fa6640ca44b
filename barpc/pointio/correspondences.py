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
from barpc.base.geodesy import ALTITUDES, INFERRED, MAX_COORDINATE, Array, is_lonlat
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import BYTES_PER_NUMBER, TABLE, Kind, read_head
from barpc.pointio.columns import COLUMNS, like_altitudes, vertical_of_column
from barpc.pointio.gcp_formats import read_geojson, read_tags
from barpc.pointio.gcp_tables import GcpTable
from barpc.pointio.tables import GROUND_SIGMA, Names, first_words, header_of, numbers_of, read_table
from barpc.rasters.dem import HeightGrid, datum_of
from barpc.rasters.raster import GRID_TAG, driver_of, open_raster, transformed
from barpc.rasters.vertical import ELLIPSOID, Vertical, geoid_of
from barpc.scene import Altimetry

HEIGHT_SIGMA = 0.5  # m, of a height whose file states none: ICESat-2 and GEDI over gentle ground

_CORRESPONDENCE_COLUMNS: Names = {**COLUMNS, "sigma": ("sigma", "sigma_px")}
_HEIGHT_COLUMNS: Names = {
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
    if kind == "geojson":
        return _of_control(path, read_geojson(path))
    if kind == "npz":
        columns: dict[str, Any] = _columns_of_npz(path)
    else:  # without a header: lon, lat, alt, col, row
        _, columns = read_table(path, _CORRESPONDENCE_COLUMNS, list(COLUMNS), unnamed=list(COLUMNS))
    arrays = {name: np.array(column, dtype=np.float64) for name, column in columns.items()}
    if not arrays["lon"].size:
        raise InputError(f"{path}: no points in it")
    if {array.shape for array in arrays.values()} != {(arrays["lon"].size,)}:
        raise InputError(f"{path}: columns of different lengths")
    ground, image = (np.column_stack([arrays[key] for key in keys]) for keys in (("lon", "lat", "alt"), ("col", "row")))
    return Correspondences(ground, image, arrays.get("sigma"))


def _of_control(path: PathOrUrl, table: GcpTable) -> Correspondences:
    """Return ground control points as those of a camera; InputError where they are no lon, lat, alt, col and row."""
    if table.crs not in (None, "EPSG:4979"):
        raise InputError(f"{path}: its GCPs are in {str(table.crs)[:60]}; longitude and latitude on WGS84 are needed")
    if not table.names or table.apart:
        raise InputError(f"{path}: no points in it that have lon, lat, alt and col, row (or ji)")
    if (flat := np.isnan(table.numbers[:, 2])).any():
        raise InputError(f"{path}: GCP {table.names[n := int(flat.argmax())] or n + 1} has no altitude")
    ground = table.numbers[:, :3] * (1.0, 1.0, table.vertical.metres)
    return Correspondences(ground, table.numbers[:, 6:8], note=table.said)


def read_gcp_grid(path: PathOrUrl) -> tuple[Correspondences | None, tuple[int, int]]:
    """Return the GCP tags of an image, None without any, as the points of its camera; and its width and height [px].

    InputError where they are no longitude, latitude and altitude. `read_tags` decides where they count from.
    """
    table, size = read_tags(path)
    return _of_control(path, table) if table.names else None, size


def correspondence_kind(path: PathOrUrl, altitudes: Sequence[float] | None = None) -> str | None:
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
    table = (numbers_of(words) is not None and len(words) >= 5) or {"lon", "lat"} <= set(
        header_of(words, _CORRESPONDENCE_COLUMNS)
    )
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
    columns = {key: arrays[list(arrays)[i]] for key, i in header_of(list(arrays), _CORRESPONDENCE_COLUMNS).items()}
    if missing := [name for name in COLUMNS if name not in columns]:
        raise InputError(f"{path}: neither ground and image nor {', '.join(missing)}; has {', '.join(arrays)}")
    return columns


def read_grid(path: PathOrUrl, altitudes: Sequence[float] | None = None) -> Correspondences:
    """Read a direct-localisation grid: bands lon, lat of each altitude layer, nodes by the geotransform.

    The geotransform counts from the corner of the first pixel, as GDAL does; half a pixel is taken off. Altitudes of
    the layers [m] are those given, or of the tags ``ALTITUDE_B0``, ``ALTITUDE_B2``, ...
    """
    with open_raster(path) as dataset:
        Kind("a localisation grid", TABLE.most).check(
            f"{path}, read", BYTES_PER_NUMBER * dataset.count * dataset.width * dataset.height
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
    nodes = np.stack(transformed(to_image, col, row), axis=-1) - 0.5
    image = np.broadcast_to(nodes, (layers, *nodes.shape)).reshape(-1, 2)
    alt = np.broadcast_to(np.asarray(altitudes, dtype=np.float64)[:, None, None], (layers, *col.shape))
    ground = np.stack([bands[::2], bands[1::2], alt], axis=-1).reshape(-1, 3)
    ok = np.isfinite(ground).all(axis=1)
    if not (is_lonlat(ground[ok]).all() and (np.abs(np.append(ground[ok, 2], image)) <= MAX_COORDINATE).all()):
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
    order = list(_HEIGHT_COLUMNS)
    head = first_words(read_head(path, TABLE))
    like = [] if "alt" in header_of(head, _HEIGHT_COLUMNS) else like_altitudes(head)
    if len(like) > 1:
        raise InputError(f"{path}: columns {', '.join(like)} could be the altitude; rename one alt")
    names = {**_HEIGHT_COLUMNS, "alt": (*_HEIGHT_COLUMNS["alt"], *like)}
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
    wrong = ~is_lonlat(ground)
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
