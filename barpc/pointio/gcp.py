"""Ground control points: ASP's `.gcp`, GeoJSON as orthority writes it, the GCP tags of an image.

Image coordinates are taken as they stand, (0, 0) at the centre of the top-left pixel, as ASP and orthority mean
them; GDAL leaves the meaning of its tags to the application. Altitudes are ellipsoidal.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from barpc.errors import InputError
from barpc.pointio.names import ViewNames
from barpc.raster import open_raster
from barpc.scene import GroundPoints
from barpc.sidefile import GEOJSON, TABLE, read_head, read_json, read_text

GROUND_SIGMA = 1.0
"""East, north, up standard deviation [m] of a GCP whose file states none."""
IMAGE_SIGMA = 0.5
"""Standard deviation of each image coordinate [px] where the file states none."""

_HEAD = 4096


@dataclass(frozen=True)
class _Point:
    """One GCP in one image: the files repeat the ground point for each of its images."""

    name: str
    lonlatalt: tuple[float, float, float]
    sigma: tuple[float, float, float]
    view: int
    xy: tuple[float, float]
    xy_sigma: float


def read_gcps(
    path: Path | str,
    names: Sequence[str],
    *,
    sigma: float | None = None,
    image_sigma: float | None = None,
) -> GroundPoints:
    """GCPs and where they are seen.

    Parameters
    ----------
    path : path
        A `.gcp` file, a GeoJSON file, or an image with GCP tags.
    names : sequence of str
        The views; observations in other images are left out, and these named in `strangers`.
    sigma : float or None
        East, north, up standard deviation [m] instead of the file's.
    image_sigma : float or None
        Standard deviation of image coordinates [px] instead of the file's.

    Returns
    -------
    GroundPoints

    Raises
    ------
    InputError
        The file does not parse, or holds no point of these views.
    """
    path = Path(path)
    head = read_head(path, TABLE, _HEAD)
    views = ViewNames(names, str(path))
    found = list(_reader(head)(path, views))
    if not found:
        raise InputError(f"{path}: no GCP of {', '.join(names[:10])}")
    try:
        return replace(_assembled(found, sigma, image_sigma), strangers=tuple(views.strangers))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _reader(head: bytes) -> Callable[[Path, ViewNames], Iterator[_Point]]:
    if head.lstrip().startswith(b"{"):
        return _read_geojson
    if head[:2] in (b"II", b"MM") or b"\0" in head:
        return _read_tags
    return _read_asp


def _read_asp(path: Path, views: ViewNames) -> Iterator[_Point]:
    """Lines `id lat lon alt sigma_x sigma_y sigma_z image col row sigma_col sigma_row [image ...]`."""
    for number, raw in enumerate(read_text(path, TABLE).split("\n"), start=1):
        words = re.split(r"(?:^|\s)#", raw, maxsplit=1)[0].replace(",", " ").split()
        if not words:
            continue
        try:
            lat, lon, alt, *sigma = (float(word) for word in words[1:7])
            images = [words[i : i + 5] for i in range(7, len(words), 5)]
            east, north, up = sigma
            if not images:
                raise ValueError("no image")
            for image, *numbers in images:
                col, row, sigma_col, sigma_row = (float(word) for word in numbers)
                view = views.find(image)
                if view is not None:
                    spread = max(sigma_col, sigma_row)
                    yield _Point(words[0], (lon, lat, alt), (east, north, up), view, (col, row), spread)
        except ValueError as error:
            raise InputError(
                f"{path}, line {number}: expected 'id lat lon alt sx sy sz image col row scol srow ...' ({error})"
            ) from error


def _read_geojson(path: Path, views: ViewNames) -> Iterator[_Point]:
    """Features with a 3-D point and the properties `ji` (col, row), `filename` and `id`."""
    document = read_json(path, GEOJSON)
    try:
        features = document["features"]
        for n, feature in enumerate(features):
            lon, lat, alt = (float(value) for value in feature["geometry"]["coordinates"])
            properties = feature["properties"]
            col, row = (float(value) for value in properties["ji"])
            view = views.find(str(properties["filename"]))
            if view is not None:
                name = str(properties.get("id") or f"gcp_{n + 1}")
                yield _Point(name, (lon, lat, alt), (GROUND_SIGMA,) * 3, view, (col, row), IMAGE_SIGMA)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: not a GeoJSON of GCPs with ji, filename and 3-D points ({error!r})"
        ) from error


def _read_tags(path: Path, views: ViewNames) -> Iterator[_Point]:
    """The GCP tags of an image: they are seen in that image alone."""
    view = views.index(str(path))
    with open_raster(path) as dataset:
        gcps, crs = dataset.gcps
    if gcps and crs is not None and not crs.is_geographic:
        raise InputError(f"{path}: its GCPs are in {crs}; longitude and latitude on WGS84 are needed")
    for n, gcp in enumerate(gcps):
        if gcp.z is None:
            raise InputError(f"{path}: GCP {gcp.id or n + 1} has no altitude")
        place, sigma = (float(gcp.x), float(gcp.y), float(gcp.z)), (GROUND_SIGMA,) * 3
        yield _Point(str(gcp.id or n + 1), place, sigma, view, (float(gcp.col), float(gcp.row)), IMAGE_SIGMA)


def _assembled(found: list[_Point], sigma: float | None, image_sigma: float | None) -> GroundPoints:
    """Observations of points of the same name and place belong to one point."""
    places: dict[tuple[str, tuple[float, float, float]], int] = {}
    for point in found:
        places.setdefault((point.name, point.lonlatalt), len(places))
    first = {places[point.name, point.lonlatalt]: point for point in reversed(found)}
    points = [first[i] for i in range(len(places))]
    numbers = np.array([point.lonlatalt for point in points])
    wrong = ~(np.isfinite(numbers).all(axis=1) & (np.abs(numbers[:, 1]) <= 90.0))
    if wrong.any():
        raise InputError(
            f"GCP {points[int(wrong.argmax())].name}: a coordinate is not finite, or its latitude beyond 90 degrees"
        )
    return GroundPoints(
        names=tuple(point.name for point in points),
        lonlatalt=numbers,
        sigma=np.array([point.sigma if sigma is None else (sigma,) * 3 for point in points]),
        point=np.array([places[point.name, point.lonlatalt] for point in found]),
        view=np.array([point.view for point in found]),
        xy=np.array([point.xy for point in found]),
        xy_sigma=np.array([point.xy_sigma if image_sigma is None else image_sigma for point in found]),
    )
