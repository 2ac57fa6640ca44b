"""Ground control points as people have them: a table of formats, each told by its content.

A reader says what its file holds (`Table`): places in the file's own reference system, altitudes as they stand, image
points, which `FORMATS` brings to (0, 0) at the centre of the first pixel. GDAL leaves the meaning of its tags to the
application: they are taken as they stand, as those of CSV, GeoJSON and ASP are.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from barpc.base.errors import BarpcError, InputError, listed, plain
from barpc.base.geodesy import FAR, INFERRED, Array, HeightDatum
from barpc.base.sidefile import GEOJSON, TABLE, encoding_of, opened_text, parse_xml, read_head, read_json
from barpc.pointio.correspondences import GROUND_SIGMA, IMAGE_SIGMA, TURNS
from barpc.pointio.crs import to_wgs84
from barpc.pointio.names import ViewNames
from barpc.pointio.tables import (
    Names,
    Texts,
    degrees,
    guessed,
    number_of,
    numbered,
    numbers_of,
    read_columns,
    row_of,
)
from barpc.rasters.dem import HeightGrid, datum_of, geoid_of
from barpc.rasters.raster import driver_of, open_raster
from barpc.rasters.vertical import ELLIPSOID, Vertical
from barpc.scene import GroundPoints, IntArray

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
_KNOWN: Names = {
    **_NAMES, **_SIGMAS, "enable": ("enable", "enabled"), "crs": ("crs", "epsg", "srid"),
    "east": ("east",), "north": ("north",),
}  # fmt: skip
_TEXTS = "id", "image", "enable", "crs"
_ALONE = (GROUND_SIGMA,) * 3


@dataclass(frozen=True)
class Frame:
    """What is known beside a file of control points."""

    crs: str | None = None  # the reference system of its places, whatever the file says
    geoid: str | None = None  # of altitudes that the file says count from one (see `Dem.open`)
    heights: str | None = None  # what altitudes count from where the file does not say it: a geoid, or "ellipsoidal"
    others: tuple[str, ...] = ()  # the files that are given: ground points and image points may be apart


_Row = tuple[Any, ...]
"""Name, image (None: not named) and the nine numbers of a GCP in an image."""


class Table(NamedTuple):
    """GCPs (K,) as a file holds them: it repeats the ground point for each of its images."""

    names: Sequence[str]  # empty: called by its place among the points
    images: Texts | None  # None: the file names none
    numbers: Array  # (K, 9): x, y, altitude (NaN: none), their sigmas east, north, up [m], col, row, their sigma [px]
    apart: str = ""  # "ground" or "image" points alone: the other columns are NaN
    crs: str | None = None  # as the file says it; None: longitude and latitude, or nothing said
    vertical: Vertical = Vertical()  # what altitudes count from, and their unit, as a column says it
    said: str = ""  # what was taken for what, where that had to be guessed

    @staticmethod
    def of_rows(rows: Iterable[_Row], apart: str = "") -> Table:
        """Gather the rows that a reader yields."""
        names, images, numbers = list[str](), dict[str | None, int](), array("d")
        index = array("q")
        for name, image, *values in rows:
            names.append(name)
            index.append(images.setdefault(image, len(images)))
            numbers.extend(values)
        of = None if None in images else Texts([str(image) for image in images], np.array(index, dtype=np.int64))
        return Table(names, of, np.array(numbers).reshape(-1, 9), apart)


class Format(NamedTuple):
    """One syntax: how its files begin, its reader, and what its image points have more than barpc's [px]."""

    sniff: Callable[[str, bytes], bool]  # of a file's beginning, as a text and as bytes
    read: Callable[[Path], Table]
    more: float = 0.0


def read_gcps(path: Path | str, names: Sequence[str], frame: Frame | None = None) -> GroundPoints:
    """Read GCPs and where they are seen, in any of `FORMATS`.

    Observations in other images than the views called `names` are left out, and these named in `strangers`; altitudes
    that the file does not hold are 0, as other tools write them. InputError where it does not parse, or holds no point
    of these views.
    """
    path, frame = Path(path), frame or Frame()
    kind, table = _opened(path)
    views, given = ViewNames(names, str(path)), [Path(one) for one in frame.others if Path(one) != path]
    if table.apart == "image" and any(_opened(one)[1].apart == "ground" for one in given):
        return GroundPoints.none()  # that file takes the image points of this one
    table = _joined(path, kind, table, given) if table.apart else table
    view = _views_of(table, path, views)
    kept = np.flatnonzero(view >= 0)
    if not len(kept):
        others = f"; it names {listed(list(views.strangers))}" if views.strangers else ""
        raise InputError(f"{path}: {kind}, no GCP of {listed(names)}{others}")
    try:
        points, words = _assembled(
            [table.names[i] for i in kept.tolist()], view[kept], table.numbers[kept], table, frame
        )
    except InputError as error:
        raise InputError(f"{path}: {kind}, {error}") from error
    more = FORMATS[kind].more
    centre = f"the centre of its first pixel is ({more:g}, {more:g})" if more else ""
    said = "; ".join(part for part in (centre, table.said, words, views.said()) if part)
    return replace(points, strangers=tuple(views.strangers), said=(f"{path}: {kind}; {said}",) if said else ())


def _opened(path: Path) -> tuple[str, Table]:
    """Return the name of a file's format and what it holds."""
    head = read_head(path, TABLE, 65536)
    start = head.decode(encoding_of(head), "replace").lstrip("\ufeff \t\r\n")
    name = next(name for name, form in FORMATS.items() if form.sniff(start, head))
    table = FORMATS[name].read(path)
    table.numbers[:, 6:8] -= FORMATS[name].more
    if table.apart == "image" and table.images is None:  # of the image that the file is called as
        table = table._replace(images=Texts([path.name], np.zeros(len(table.names), dtype=np.int64)))
    return name, table


def _joined(path: Path, kind: str, table: Table, given: Sequence[Path]) -> Table:
    """Return ground points with the image points of their names in the files `given`, or MicMac's beside them."""
    if table.apart == "image":
        raise InputError(f"{path}: {kind}, image points alone; give the file of ground points with another --gcp")
    files = [one for one in given if _opened(one)[1].apart == "image"]
    if not files and kind == MICMAC:
        beside = [one for one in sorted(path.parent.glob("*.xml")) if b"SetOfMesureAppuis" in read_head(one, TABLE)]
        files = [one for one in beside if one != path and _opened(one)[1].apart == "image"]
    if not files or (len(files) > 1 and not set(files) <= set(given)):
        many = f", and image points in {listed([one.name for one in files])}" if files else ""
        raise InputError(
            f"{path}: {kind}, ground points (no column col, row){many}; give a file of image points with another --gcp"
        )
    ground = dict(zip(table.names, table.numbers, strict=True))
    pictured = [_opened(one)[1] for one in files]
    if nameless := [one.name for one, seen in zip(files, pictured, strict=True) if seen.images is None]:
        raise InputError(f"{path}: {kind}, whose image points in {listed(nameless)} name no image")
    rows = [
        (name, image, *ground[name][:6], *numbers[6:])
        for seen in pictured
        for name, image, numbers in zip(seen.names, (seen.images or _NONE).per_row(), seen.numbers, strict=True)
        if name in ground
    ]
    said = "; ".join(filter(None, (table.said, f"image points of {listed([one.name for one in files])}")))
    return Table.of_rows(rows)._replace(crs=table.crs, vertical=table.vertical, said=said)


_NONE = Texts([], np.zeros(0, dtype=np.int64))


def _views_of(table: Table, path: Path, views: ViewNames) -> IntArray:
    """Return the view (K,) of each row, -1: none; a file that names no image is of the one of its name, or the only."""
    if table.images is not None:
        return views.of(map(str, table.images.different))[table.images.index]
    found = 0 if len(views.names) == 1 else views.among(path.name)
    if found is None:
        raise InputError(
            f"{path}: no column image, and its name begins with none of {listed(views.names)}; call it as its image, "
            "or give one image alone"
        )
    return np.full(len(table.names), found, dtype=np.int64)


def _assembled(
    called: Sequence[str], view: IntArray, numbers: Array, table: Table, frame: Frame
) -> tuple[GroundPoints, str]:
    """Return the observations of points of the same name and place as those of one point, in their first order."""
    keys = np.column_stack([numbered(called, {}), np.nan_to_num(numbers[:, :3])])
    order = np.lexsort(keys.T)
    new = np.append(True, (np.diff(keys[order], axis=0) != 0).any(axis=1))
    first = order[new]  # the sort is stable
    point = np.empty(len(order), dtype=np.int64)
    point[order] = np.argsort(np.argsort(first))[np.cumsum(new) - 1]
    first.sort()
    names = tuple(called[i] or f"gcp_{n}" for n, i in enumerate(first, 1))
    ground, datums, words = _placed(numbers[first, :3], table, frame)
    wrong = ~(np.abs(ground) <= (TURNS, TURNS, FAR)).all(axis=1)  # NaN fails, too
    if wrong.any():
        name, (x, y, z) = names[int(wrong.argmax())], ground[int(wrong.argmax())]
        if np.isfinite([x, y]).all() and abs(z) <= FAR and not (frame.crs or table.crs):
            raise InputError(
                f"GCP {name} at {x:.10g}, {y:.10g}: map coordinates? Say their reference system with --gcp-crs, as "
                "EPSG:32631"
            )
        raise InputError(f"GCP {name}: a coordinate is not finite, or no longitude and latitude in degrees")
    made = GroundPoints(
        names=names,
        lonlatalt=ground,
        sigma=numbers[first, 3:6],
        point=point,
        view=view,
        xy=numbers[:, 6:8],
        xy_sigma=numbers[:, 8],
        datums=datums,
    )
    return made, words


def _placed(place: Array, table: Table, frame: Frame) -> tuple[Array, tuple[HeightDatum, ...], str]:
    """Return lon, lat, altitude [m above the ellipsoid; 0: none], what is known of the altitudes' datum, and words."""
    crs, vertical, words = frame.crs or table.crs, table.vertical, list[str]()
    if frame.crs and table.crs and frame.crs != table.crs:
        words.append(f"not its own reference system {table.crs[:40]!r}")
    if crs:
        place, own, name = to_wgs84(place, crs, f"{'--gcp-crs' if frame.crs else 'its reference system'}")
        words.append(name)
        if own.stated and vertical.unit and own.metres != vertical.metres:
            raise InputError(f"altitudes in {vertical.unit} by their column, in another unit by {crs[:40]!r}")
        vertical = own if own.stated else vertical
    ground = place * (1.0, 1.0, vertical.metres)
    known = ~np.isnan(ground[:, 2]) & (ground[:, 2] != 0.0)  # 0 is what tools write where none is known
    words += ["no altitudes"] if np.isnan(ground[:, 2]).all() else []
    if vertical.metres != 1.0 and known.any():
        words.append(f"altitudes in units of {vertical.metres:.12g} m")
    by_person = frame.heights
    if vertical.stated:
        by_person = frame.geoid if vertical.reference != ELLIPSOID else None
    said = vertical.by(by_person)
    if said.geoid is not None and known.any():
        file, done, _ = geoid_of(vertical, said, by_person is not None)
        words.append(f"altitudes above {vertical.reference if vertical.stated else by_person} {done}")
        if file is not None:
            ground[known, 2] += HeightGrid.open(file).sample(*ground[known, :2].T)
    ground[np.isnan(place[:, 2]), 2] = 0.0
    datums = datum_of(
        None if by_person else said, ground[known], "gcps", f"{known.sum()} GCP{'s' * int(known.sum() > 1)}"
    )
    return ground, datums, "; ".join(words)


# --- tables -----------------------------------------------------------------------------------------------


def _named(path: Path, words: Sequence[str], lax: bool = False) -> tuple[dict[str, int], Table]:
    """Return the columns of a table by their names, and an empty table that says what these say.

    In a `lax` table columns of errors may stand that are no accuracies.
    """
    try:
        columns, said, vertical = guessed(words, _KNOWN)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    for word in (word for i, word in enumerate(words) if i not in columns.values() and not lax):
        if re.match("sigma|std|stdev|acc|err", word.lower()):
            raise InputError(
                f"{path}: column {word[:40]!r} is none that is read; accuracies are called {', '.join(_SIGMAS)}"
            )
    place = {"lon", "lat"} <= columns.keys() or {"east", "north"} <= columns.keys()
    seen = {"col", "row"} <= columns.keys()
    if not (place or seen) or ("id" not in columns and not (place and seen)):
        lacking = [*(() if place else ("lon", "lat")), *("col", "row")]
        lacking = [name for name in lacking if name not in columns]
        raise InputError(f"{path}: no column {', '.join(lacking)} among the {len(words)} of its first line")
    apart = "" if place and seen else "ground" if place else "image"
    return columns, Table([], None, np.empty((0, 9)), apart, None, vertical, ", ".join(said))


def _of_columns(path: Path, columns: Mapping[str, Any], empty: Table) -> Table:
    """Return a table of its columns: numbers (NaN or None: blank) or `Texts`; sigmas not stated are the default."""
    num = len(
        next(iter(columns.values())).index
        if isinstance(next(iter(columns.values())), Texts)
        else next(iter(columns.values()))
    )

    def stated(key: str, default: Array) -> Array:
        cells = columns.get(key, [None] * num)
        known = np.array([cell is not None for cell in cells], dtype=bool)
        return np.where(known, np.array(cells, dtype=np.float64), default)

    none = np.full(num, np.nan)
    every = stated("sigma", np.full(num, GROUND_SIGMA))
    level = stated("sigma_xy", every)
    sigmas = (stated("sigma_x", level), stated("sigma_y", level), stated("sigma_z", every))
    pixels = np.max([stated(key, np.full(num, -np.inf)) for key in ("sigma_px", "sigma_col", "sigma_row")], axis=0)
    pixels[pixels == -np.inf] = IMAGE_SIGMA
    x, y = ("lon", "lat") if {"lon", "lat"} <= columns.keys() else ("east", "north")
    place = [columns.get(x, none), columns.get(y, none), stated("alt", none)]
    numbers = np.column_stack([*place, *sigmas, columns.get("col", none), columns.get("row", none), pixels])
    names = [name.strip() for name in columns["id"].per_row()] if "id" in columns else [""] * num
    crs, said, images = None, empty.said, columns.get("image")
    if "crs" in columns:
        systems = [str(text).strip() for text in columns["crs"].different]
        if len(systems) > 1:
            raise InputError(f"{path}: points of {len(systems)} reference systems, {listed(systems, 3)}; one file each")
        crs = next((f"EPSG:{text}" if text.isdecimal() else text for text in systems if text), None)
    if "enable" in columns:
        off = [str(text).strip().lower() in ("0", "0.0", "false") for text in columns["enable"].different]
        kept = np.flatnonzero(~np.array(off, dtype=bool)[columns["enable"].index])
        said += f", points that it switches off: {num - len(kept)}, left out" if len(kept) < num else ""
        names, numbers = [names[i] for i in kept], numbers[kept]
        images = images and Texts(images.different, images.index[kept])
    return empty._replace(names=names, images=images, numbers=numbers, crs=crs, said=said.lstrip(", "))


# --- formats ----------------------------------------------------------------------------------------------

_STATED = re.compile(r"^#\s*(?:CRS|SRS|CoordinateSystem|Projection)\s*[:=]\s*(\S.*)|^#\s*(EPSG:\S+)", re.IGNORECASE)
_ODM = re.compile(r"(EPSG:\d+(?:\+\d+)?|\+proj=.*)|WGS84\s+UTM\s+(\d+)\s*([NS])", re.IGNORECASE)
_ENVI = re.compile(
    r"projection info\s*=\s*\{\s*(?:UTM\s*,\s*(?:1\s*,\s*)?(\d+)\s*,\s*(North|South)|(Geographic))", re.I
)
_AGISOFT = re.compile(r"^#\s*CoordinateSystem|X/(?:Longitude|East)", re.IGNORECASE | re.MULTILINE)
MICMAC = "MicMac XML"


def _utm(zone: str, hemisphere: str) -> str:
    """Return the code of a zone on WGS84."""
    return f"EPSG:{32600 + 100 * (hemisphere[:1] in 'sS') + int(zone)}"


def _read_asp(path: Path) -> Table:
    """Read the lines `id lat lon alt sigma_x sigma_y sigma_z image col row sigma_col sigma_row [image ...]`."""

    def rows() -> Iterator[_Row]:
        for number, words in _words_of(path):
            try:
                lat, lon, *ground = map(float, words[1:7])
                if len(words) < 12 or len(words) % 5 != 2:
                    raise ValueError(f"{len(words)} words")
                for i in range(7, len(words), 5):
                    col, row, *spread = map(float, words[i + 1 : i + 5])
                    yield words[0], words[i], lon, lat, *ground, col, row, max(spread)
            except ValueError as error:
                raise InputError(
                    f"{path}, line {number}: in no format that is read ({', '.join(FORMATS)}): a CSV begins with its "
                    "columns' names, a line of ASP's is 'id lat lon alt sx sy sz image col row scol srow ...' "
                    f"({plain(error)})"
                ) from error

    return Table.of_rows(rows())._replace(vertical=Vertical(ELLIPSOID, provenance=INFERRED))


def _words_of(path: Path, sign: str = "#") -> Iterator[tuple[int, list[str]]]:
    """Yield the lines of words between blanks and commas that are no comments, by their numbers."""
    with opened_text(path, TABLE) as lines:
        for number, raw in enumerate(lines, start=1):
            line = re.split(rf"(?:^|\s){sign}", raw, maxsplit=1)[0] if sign in raw else raw
            if words := line.replace(",", " ").split():
                yield number, words


def _in_order(path: Path, order: str, lines: Iterable[tuple[int, list[str]]]) -> Table:
    """Read lines whose words stand in an order of x, y, alt, col, row, image and id, of which the latter may lack."""

    def rows() -> Iterator[_Row]:
        for number, words in lines:
            of = dict(zip(order.split(), words, strict=False))
            try:
                x, y, col, row = (number_of(of[key]) for key in ("x", "y", "col", "row"))
                alt = number_of(of.get("alt", "nan"))
            except (KeyError, ValueError) as error:
                raise InputError(f"{path}, line {number}: expected '{order}' ({plain(error)})") from error
            yield of.get("id", ""), of.get("image"), x, y, alt, *_ALONE, col, row, IMAGE_SIGMA

    return Table.of_rows(rows())


def _read_odm(path: Path) -> Table:
    """Read a reference system, then lines `x y z col row image [name]`."""
    lines = _words_of(path)
    found = _ODM.match(" ".join(next(lines)[1]))
    crs = None if found is None else found[1] or _utm(found[2], found[3])
    return _in_order(path, "x y alt col row image id", lines)._replace(crs=crs)


def _read_envi(path: Path) -> Table:
    """Read comments that say the reference system and the order, then lines `x y col row`."""
    head = read_head(path, TABLE).decode("utf-8", "replace")
    if re.search(r"^;.*\b(Base|Warp)\b", head, re.MULTILINE):
        raise InputError(f"{path}: ENVI .pts of two images; one from image to map is needed")
    found, turned = _ENVI.search(head), re.search(r"^;\s*Image.*Map", head, re.MULTILINE | re.IGNORECASE)
    crs = None if found is None or found[3] else _utm(found[1], found[2])
    return _in_order(path, "col row x y" if turned else "x y col row", _words_of(path, ";"))._replace(crs=crs)


def _read_csv(path: Path) -> Table:
    """Read a header of names, perhaps behind `#`, and comments that say the reference system."""
    head = read_head(path, TABLE, 65536)
    text = head.decode(encoding_of(head), "replace")
    at, delimiter, words = _header(text)
    columns, empty = _named(path, words, lax=_AGISOFT.search(text) is not None)
    blank = {"alt", *_SIGMAS} & columns.keys()
    read = read_columns(path, at + 1, delimiter, columns, columns.keys() & {*_TEXTS}, blank)
    table = _of_columns(path, read, empty)
    stated = next(filter(None, map(_STATED.match, _LINES.split(text))), None)
    return table if stated is None or table.crs else table._replace(crs=stated[1] or stated[2])


_LINES = re.compile(r"\r\n|\r|\n")


def _header(text: str) -> tuple[int, str, list[str]]:
    """Return which line names columns, what stands between its cells, and these.

    It is counted from 0: the first that is no comment, or a comment before it of as many cells; -1: none.
    """
    last: tuple[int, str, list[str]] = (-1, "", [])
    for i, line in enumerate(_LINES.split(text)):
        bare = line.lstrip("\ufeff").strip()
        if not bare:
            continue
        sign = next((sign for sign in "\t;," if sign in bare), " ")
        words, comment = row_of(bare.lstrip("# "), sign), bare.startswith("#")
        if not comment and len(words) <= len(last[2]):
            return last
        if not any(numbers_of([word]) for word in words[1:4]) and _names_columns(words):
            last = i, sign, words
        if not comment:
            break
    return last if last[0] == i else (-1, "", [])


def _names_columns(words: Sequence[str]) -> bool:
    """Return whether words are a header: three columns of control or more, or two that could be one."""
    try:
        return len(guessed(words, _KNOWN)[0]) > 2
    except InputError:
        return True


def _read_qgis(path: Path) -> Table:
    """Read a CSV whose rows of pixels count upwards."""
    table = _read_csv(path)
    table.numbers[:, 7] *= -1.0
    if (table.numbers[:, 7] < 0.0).any():
        raise InputError(
            f"{path}: QGIS .points above its image (sourceY is positive): of an image with map coordinates of its own; "
            "set the points in the image without them"
        )
    return table


def _read_geojson(path: Path) -> Table:
    """Read a GeoJSON, with the reference system that it could name before 2016."""
    document, crs = read_json(path, GEOJSON), None
    try:
        if "crs" in document:
            crs = str(document["crs"]["properties"]["name"])
        features = list(document["features"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not a GeoJSON of points ({plain(error)})") from error
    return _of_features(path, features, None if crs is None or crs.endswith(("CRS84", "EPSG::4326")) else crs)


def _of_features(path: Path, features: Sequence[Any], crs: str | None) -> Table:
    """Read features with points and properties: `ji` (col, row) or names as of columns, `sigma_m` of three numbers."""
    spread, rows = {"ji": ("col", "row"), "sigma_m": ("sx", "sy", "sz")}, list[dict[str, Any]]()
    try:
        for feature in features:
            of = dict(feature["properties"] or {})
            if feature.get("id") is not None and not {key.lower() for key in of} & set(_NAMES["id"]):
                of["id"] = feature["id"]
            for key in spread.keys() & of.keys():
                of |= dict(zip(spread[key], of.pop(key), strict=True))
            x, y, *z = feature["geometry"]["coordinates"]
            rows.append({"lon": x, "lat": y} | ({"alt": z[0]} if z else {}) | of)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise InputError(
            f"{path}: not a GeoJSON of points, each with ji = [col, row], filename; sigma_m is [east, north, up], "
            f"sigma_px a number ({plain(error)})"
        ) from error
    if not rows:
        return Table.of_rows([])
    columns, empty = _named(path, words := list(dict.fromkeys(key for of in rows for key in of)))
    needed = columns.keys() & {"lon", "lat", "col", "row"}
    read: dict[str, Any] = {}
    for key, name in ((key, words[i]) for key, i in columns.items()):
        cells = [of.get(name) for of in rows]
        if key in _TEXTS:
            known: dict[str, int] = {}
            index = numbered(("" if cell is None else str(cell) for cell in cells), known)
            read[key] = Texts(list(known), index)
            continue
        try:
            read[key] = [None if cell is None and key not in needed else _value(key, cell) for cell in cells]
        except ValueError as error:
            raise InputError(f"{path}: {name!r} of a point: {plain(error)}") from error
    return _of_columns(path, read, empty)._replace(crs=crs)


def _value(key: str, cell: Any) -> float:
    if isinstance(cell, bool) or not isinstance(cell, (str, int, float)):
        raise ValueError(f"{str(cell)[:40]!r} is no number")
    return degrees(str(cell), key) if key in ("lon", "lat") else number_of(str(cell))


def _read_vector(path: Path) -> Table:
    """Read the points of a GeoPackage or Shapefile, by pyogrio or fiona."""
    reader = next((name for name in ("pyogrio", "fiona") if find_spec(name)), None)
    if reader is None:
        raise InputError(f"{path}: a GeoPackage or Shapefile, which pyogrio reads: pip install pyogrio")
    try:
        if reader == "fiona":
            with import_module(reader).open(path) as file:
                return _of_features(
                    path, [dict(shape.__geo_interface__, id=None) for shape in file], file.crs_wkt or None
                )
        import shapely

        meta, _, shapes, fields = import_module("pyogrio.raw").read(path)
        rows = zip(shapely.from_wkb(shapes), *(field.tolist() for field in fields), strict=True)
        features = [
            {"geometry": shapely.geometry.mapping(shape), "properties": dict(zip(meta["fields"], cells, strict=True))}
            for shape, *cells in rows
        ]
    except InputError:
        raise
    except (RuntimeError, ValueError, OSError) as error:
        raise InputError(f"{path}: a GeoPackage or Shapefile that {reader} cannot read") from error
    return _of_features(path, features, meta["crs"])


def _read_tags(path: Path) -> Table:
    """Read the GCP tags of an image: they are seen in that image alone."""
    with open_raster(path) as dataset:
        gcps, crs = dataset.gcps
    rows = (
        (str(g.id or n), str(path), g.x, g.y, np.nan if g.z is None else g.z, *_ALONE, g.col, g.row, IMAGE_SIGMA)
        for n, g in enumerate(gcps, 1)
    )
    return Table.of_rows(rows)._replace(crs=None if crs is None or crs.to_epsg() == 4326 else crs.to_wkt())


def _read_micmac(path: Path) -> Table:
    """Read ground points (DicoAppuisFlottant), image points (SetOfMesureAppuisFlottants), or both."""
    try:
        root = parse_xml(path, strip_namespaces=True)
    except BarpcError as error:
        raise InputError(str(error)) from error
    nan = float("nan")
    ground, rows = dict[str, tuple[float, ...]](), list[_Row]()
    try:
        for point in root.iter("OneAppuisDAF"):
            x, y, z = map(number_of, (point.findtext("Pt") or "").split())
            e, n, up = map(number_of, (point.findtext("Incertitude") or "1 1 1").split())
            ground[(point.findtext("NamePt") or "").strip()] = x, y, z, e, n, up
        for image in root.iter("MesureAppuiFlottant1Im"):
            for point in image.iter("OneMesureAF1I"):
                col, row = map(number_of, (point.findtext("PtIm") or "").split())
                name, file = (point.findtext("NamePt") or "").strip(), (image.findtext("NameIm") or "").strip()
                if name in ground or not ground:
                    rows.append((name, file, *ground.get(name, (nan, nan, nan, *_ALONE)), col, row, IMAGE_SIGMA))
    except ValueError as error:
        raise InputError(f"{path}: {MICMAC}, expected Pt of three numbers, PtIm of two ({plain(error)})") from error
    if not rows and not ground:
        raise InputError(f"{path}: XML without OneAppuisDAF or OneMesureAF1I, so no points of MicMac's")
    alone = ((name, None, *place, nan, nan, IMAGE_SIGMA) for name, place in ground.items())
    return Table.of_rows(rows or alone, "" if rows and ground else "image" if rows else "ground")


FORMATS: dict[str, Format] = {
    "GeoPackage or Shapefile": Format(
        lambda _, head: head.startswith((b"SQLite format 3\0", b"\0\0\x27\x0a")), _read_vector
    ),
    "image with GCP tags": Format(lambda text, head: driver_of(head) is not None or "\0" in text, _read_tags),
    "GeoJSON": Format(lambda text, _: text.startswith("{"), _read_geojson),
    MICMAC: Format(lambda text, _: text.startswith("<"), _read_micmac),
    "ENVI .pts": Format(lambda text, _: text.startswith(";"), _read_envi, 1.5),  # corner of the first pixel: (1, 1)
    "QGIS .points": Format(lambda text, _: "mapX" in text[:4096] and _header(text)[0] >= 0, _read_qgis, 0.5),
    "ODM gcp_list.txt": Format(lambda text, _: _ODM.match(text) is not None, _read_odm, 0.5),
    "Metashape CSV": Format(
        lambda text, _: _AGISOFT.search(text) is not None and _header(text)[0] >= 0, _read_csv, 0.5
    ),
    "CSV": Format(lambda text, _: _header(text)[0] >= 0, _read_csv),
    "ASP .gcp": Format(lambda *_: True, _read_asp),
}
"""Name -> row: the first that knows the beginning reads the file. QGIS, ODM and Metashape count from the corner."""
