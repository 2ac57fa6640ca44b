"""Ground control points of any file that people have them in: joined to the images of a run, on WGS84.

What a file holds is read by `barpc.pointio.gcp_formats`; places of other reference systems are brought to longitude and
latitude by pyproj, which is imported when one is asked.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.errors import InputError, listed
from barpc.base.geodesy import MAX_COORDINATE, STATED, TURNS, Array, BoolArray, HeightDatum
from barpc.base.safe_io import TABLE, read_head
from barpc.pointio.gcp_formats import GCP_FORMATS, MICMAC, open_gcps
from barpc.pointio.gcp_tables import GcpTable, Row
from barpc.pointio.names import ViewNames
from barpc.pointio.tables import Texts, distinct, index_texts
from barpc.rasters.crs import crs_of
from barpc.rasters.dem import HeightGrid, datum_of
from barpc.rasters.vertical import ELLIPSOID, FLAT, Vertical, geoid_of, vertical_of
from barpc.scene import GroundPoints, IntArray


@dataclass(frozen=True)
class ControlReference:
    """Settings and files beside a file of control points."""

    crs: str | None = None  # the reference system of its places, whatever the file says
    geoid: str | None = None  # of altitudes that the file says count from one (see `Dem.open`)
    heights: str | None = None  # what altitudes count from where the file does not say it: a geoid, or "ellipsoidal"
    others: tuple[str, ...] = ()  # the files that are given: ground points and image points may be apart


def read_gcps(path: Path | str, names: Sequence[str], frame: ControlReference | None = None) -> GroundPoints:
    """Read GCPs and where they are seen, in any of `GCP_FORMATS`.

    Observations in other images than the views called `names` are left out, and these named in `strangers`; altitudes
    that the file does not hold are 0, as other tools write them. InputError where it does not parse, or holds no point
    of these views.
    """
    path, frame = Path(path), frame or ControlReference()
    kind, table = open_gcps(path)
    views, given = ViewNames(names, str(path)), [Path(one) for one in frame.others if Path(one) != path]
    if table.apart == "image" and any(open_gcps(one)[1].apart == "ground" for one in given):
        return GroundPoints.none()  # that file takes the image points of this one
    table = _with_image_points(path, kind, table, given) if table.apart else table
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
    more = GCP_FORMATS[kind].more
    centre = f"the centre of its first pixel is ({more:g}, {more:g})" if more else ""
    said = "; ".join(filter(None, (centre, table.said, words, views.said())))
    return replace(points, strangers=tuple(views.strangers), said=(f"{path}: {kind}; {said}",) if said else ())


def _with_image_points(path: Path, kind: str, table: GcpTable, given: Sequence[Path]) -> GcpTable:
    """Return ground points with the image points of their names in the files `given`, or MicMac's beside them."""
    if table.apart == "image":
        raise InputError(f"{path}: {kind}, image points alone; give the file of ground points with another --gcp")
    files = _of_image_points(given)
    if not files and kind == MICMAC:
        beside = (one for one in sorted(path.parent.glob("*.xml")) if one != path)
        files = _of_image_points([one for one in beside if b"SetOfMesureAppuis" in read_head(one, TABLE)])
    if len(files) != 1 and not (files and set(files) <= set(given)):
        many = f", and image points in {listed([one.name for one in files])}" if files else ""
        raise InputError(
            f"{path}: {kind}, ground points (no column col, row){many}; give a file of image points with another --gcp"
        )
    said = "; ".join(filter(None, (table.said, f"image points of {listed([one.name for one in files])}")))
    rows = _joined(table, [open_gcps(one)[1] for one in files])
    return GcpTable.of_rows(rows)._replace(crs=table.crs, vertical=table.vertical, said=said)


def _of_image_points(files: Sequence[Path]) -> list[Path]:
    return [one for one in files if open_gcps(one)[1].apart == "image"]


def _joined(table: GcpTable, parts: Sequence[GcpTable]) -> Iterator[Row]:
    """Yield the ground points of a table at the image points of their names in others."""
    ground = dict(zip(table.names, table.numbers, strict=True))
    for seen in parts:
        images = (seen.images or Texts.of(())).per_row()
        for name, image, numbers in zip(seen.names, images, seen.numbers, strict=True):
            if name in ground:
                yield name, image, *ground[name][:6], *numbers[6:]


def _views_of(table: GcpTable, path: Path, views: ViewNames) -> IntArray:
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
    called: Sequence[str], view: IntArray, numbers: Array, table: GcpTable, frame: ControlReference
) -> tuple[GroundPoints, str]:
    """Return the observations of points of the same name and place as those of one point, in their first order."""
    first, point = distinct(np.column_stack([index_texts(called, {}), np.nan_to_num(numbers[:, :3])]))
    point, first = np.argsort(np.argsort(first))[point], np.sort(first)
    names = tuple(called[i] or f"gcp_{n}" for n, i in enumerate(first, 1))
    ground, datums, words = _geolocated(numbers[first, :3], table, frame)
    wrong = ~(np.abs(ground) <= (TURNS, TURNS, MAX_COORDINATE)).all(axis=1)  # NaN fails, too
    if wrong.any():
        name, (x, y, z) = names[int(wrong.argmax())], ground[int(wrong.argmax())]
        if np.isfinite([x, y]).all() and abs(z) <= MAX_COORDINATE and not (frame.crs or table.crs):
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


def _geolocated(place: Array, table: GcpTable, frame: ControlReference) -> tuple[Array, tuple[HeightDatum, ...], str]:
    """Return lon, lat, altitude [m above the ellipsoid; 0: none], their assumed datums, and remarks."""
    crs, vertical, words = frame.crs or table.crs, table.vertical, list[str]()
    if frame.heights != FLAT and len(place) >= _ALIKE and place[0, 2] != 0.0 and (place[:, 2] == place[0, 2]).all():
        words.append(f"all altitudes are {place[0, 2]:.10g}: a default, taken as none (--heights {FLAT} if measured)")
        place = place * (1.0, 1.0, 0.0)
    if frame.crs and table.crs and frame.crs != table.crs:
        words.append(f"instead of the file's reference system {table.crs[:40]!r}")
    if crs:
        place, own, name = to_wgs84(place, crs, f"{'--gcp-crs' if frame.crs else 'its reference system'}")
        words.append(name)
        if own.stated and vertical.unit and own.metres != vertical.metres:
            raise InputError(f"altitudes in {vertical.unit} by their column, in another unit by {crs[:40]!r}")
        vertical = own if own.stated else vertical
    ground = place * (1.0, 1.0, vertical.metres)
    known = ~np.isnan(ground[:, 2]) & (ground[:, 2] != 0.0)  # 0 is what tools write where none is known
    by_person = frame.heights
    if vertical.stated:
        by_person = frame.geoid if vertical.reference != ELLIPSOID else None
    words += _lift(ground, known, vertical, by_person)
    ground[np.isnan(place[:, 2]), 2] = 0.0
    name = f"{known.sum()} GCP{'s' * int(known.sum() > 1)}"
    said = None if by_person else vertical.by(by_person)
    return ground, datum_of(said, ground[known], "gcps", name), "; ".join(words)


def _lift(ground: Array, known: BoolArray, vertical: Vertical, by_person: str | None) -> Iterator[str]:
    """Add the geoid to the altitudes of those points (N, 3) that are `known`, in place; yield what was done."""
    if np.isnan(ground[:, 2]).all():
        yield "no altitudes"
    if vertical.metres != 1.0 and known.any():
        yield f"altitudes in units of {vertical.metres:.12g} m"
    if (said := vertical.by(by_person)).geoid is not None and known.any():
        file, done, _ = geoid_of(vertical, said, by_person is not None)
        yield f"altitudes above {vertical.reference if vertical.stated else by_person} {done}"
        if file is not None:
            ground[known, 2] += HeightGrid.open(file).sample(*ground[known, :2].T)


_ALIKE = 3  # points whose altitudes are the same to the last digit: no survey has them
# --- reference systems ----------------------------------------------------------------------------------


_NOTEWORTHY_ACCURACY = 1.0  # m: better known transformations need no word; ensembles as WGS84 are no better


@contextmanager
def _offline() -> Iterator[None]:
    """Take no grid from the network, whatever PROJ is set to: results are not to depend on it, nor to fail without."""
    network: Any = import_module("pyproj.network")

    was = network.is_network_enabled()
    network.set_network_enabled(False)
    try:
        yield
    finally:
        network.set_network_enabled(was)


def to_wgs84(place: Array, crs: str, source: str) -> tuple[Array, Vertical, str]:
    """Bring places (N, 3), east, north and altitude in the units of a reference system, to lon, lat [deg] and altitude.

    Returns the places, what their altitudes (still in their unit) count from, and words: the system's name and how well
    it is known on WGS84. InputError where PROJ knows no such system of places; `source` says so for messages.
    """
    from pyproj import Transformer
    from pyproj.exceptions import CRSError, ProjError

    try:
        system = crs_of(crs, source)
        level, *upper = system.sub_crs_list if system.is_compound else [system]
        if not (level.is_geographic or level.is_projected or level.is_geocentric):
            raise CRSError("no places")
        solid = len(level.axis_info) == 3
        with _offline(), warnings.catch_warnings():  # of missing grids: how well the others know the place is said
            warnings.simplefilter("ignore")
            to = Transformer.from_crs(level, "EPSG:4979" if solid else "EPSG:4326", always_xy=True)
            x, y, z = to.transform(place[:, 0], place[:, 1], np.nan_to_num(place[:, 2]))
            known = 0.0
            with suppress(ProjError):  # WGS84 itself: nothing was done
                known = to.get_last_used_operation().accuracy
        vertical = (
            vertical_of(system.to_wkt()) if upper else Vertical(ELLIPSOID, provenance=STATED) if solid else Vertical()
        )
    except (CRSError, ProjError, UnicodeError) as error:
        raise InputError(
            f"{source}: {crs[:60]!r} is no reference system of places that PROJ knows; say it with --gcp-crs, such as "
            "EPSG:32631, or EPSG:26910+5703 with its heights"
        ) from error
    alt = np.where(np.isnan(place[:, 2]), np.nan, z) if solid else place[:, 2]
    return (
        np.column_stack([x, y, alt]),
        vertical,
        system.name + (f", known to {known:g} m" if known > _NOTEWORTHY_ACCURACY else ""),
    )
