"""Image files to views: what each file must have before any work starts."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from barpc.cameras import Camera, open_camera, split_spec
from barpc.errors import BarpcError, ImageError, InputError, RpcError
from barpc.pipeline.twins import Twins
from barpc.plain import plain_path
from barpc.pointio.names import unique_names
from barpc.raster import open_raster
from barpc.scene import View
from barpc.sensor.geometry import footprint

logger = logging.getLogger(__name__)

MIN_ALTITUDE_SPAN = 100.0
"""Altitude ranges narrower than this [m] are widened to it: an RPC with a zero height scale is usable."""
ALTITUDE_LIMITS = (-1000.0, 9500.0)
"""The Earth's ground stays inside this [m], with a margin; RPCs that state more are cut to it."""


Image = str | Path | View


@dataclass(frozen=True, eq=False)
class LoadedViews:
    """Views, where their cameras came from, and what was left out.

    Parameters
    ----------
    views : tuple of View
        In the order of their names.
    sources : tuple of Camera
        One a view.
    left_out : tuple of (str, str)
        Path and reason of each file that was left out.
    """

    views: tuple[View, ...]
    sources: tuple[Camera, ...]
    left_out: tuple[tuple[str, str], ...] = ()


def image_path(image: Image) -> Path:
    """The file with the pixels, absolute."""
    return (Path(image.path) if isinstance(image, View) else split_spec(image)[0]).absolute()


def load_views(
    images: Sequence[Image],
    *,
    min_views: int = 2,
    keep_going: bool = False,
    band: int = 1,
    distinct: bool = True,
) -> LoadedViews:
    """Read the camera of every image, in the order of their names, whatever order they are given in.

    Parameters
    ----------
    images : sequence of path or View
        The image files, perhaps with choices behind them (`barpc.cameras.open_camera`), or views of them with
        a camera of one's own.
    min_views : int
        So many are needed.
    keep_going : bool
        Leave a bad file out instead of stopping.
    band : int
        The band that will be read, from 1.
    distinct : bool
        Refuse an image that is there twice, also as other files or under another RPC (see `Twins`).

    Returns
    -------
    LoadedViews

    Raises
    ------
    ImageError, RpcError
        A file cannot be used; the message names it.
    InputError
        Too few images, the same image twice, or a name that the files of a run cannot carry.
    """
    files = [plain_path(image_path(image)) for image in images]
    if len(files) < min_views:
        found = files[0] if files else "none"
        raise InputError(
            f"{len(files)} image(s) given ({found}): at least {min_views} that overlap are needed"
        )
    views: list[View] = []
    sources: list[Camera] = []
    left_out: list[tuple[str, str]] = []
    twins = Twins(band)
    given = zip(unique_names(files), files, images, strict=True)
    for name, file, image in sorted(given, key=lambda row: row[:2]):
        try:
            view, source = _load(name, file, image, band)
            if distinct:
                twins.add(view)
        except BarpcError as error:
            if not keep_going:
                raise
            logger.warning("%s is left out: %s", file, error)
            left_out.append((str(file), str(error)))
            continue
        views.append(view)
        sources.append(source)
    if len(views) < min_views:
        raise InputError(f"{len(views)} of {len(files)} images can be used: at least {min_views} are needed")
    return LoadedViews(tuple(views), tuple(sources), tuple(left_out))


def _load(name: str, file: Path, image: Image, band: int) -> tuple[View, Camera]:
    with open_raster(file) as dataset:
        size = (int(dataset.width), int(dataset.height))
        if not 1 <= band <= dataset.count:
            raise ImageError(f"{file}: has {dataset.count} band(s), no band {band}")
    if isinstance(image, View):
        camera = Camera(image.sensor, file, "given", image.size, image.alt_range)
        if image.size != size:
            raise InputError(f"{file}: is {size} px large, but its view says {image.size}")
    else:
        camera = open_camera(image, size=size)
    view = View(name, str(file), size, camera.model, _altitudes(camera))
    ring = footprint(view.sensor, size, sum(view.alt_range) / 2)
    if not (abs(ring[:, 1]) <= 90).all():  # NaN fails, too
        raise RpcError(f"{file}: its RPC does not reach the ground over the image ({size[0]} x {size[1]} px)")
    return view, camera


def _altitudes(camera: Camera) -> tuple[float, float]:
    """The altitudes that a camera is used for [m]."""
    low, high = max(camera.alt_range[0], ALTITUDE_LIMITS[0]), min(camera.alt_range[1], ALTITUDE_LIMITS[1])
    if high - low < MIN_ALTITUDE_SPAN:
        middle = min(max((low + high) / 2, ALTITUDE_LIMITS[0]), ALTITUDE_LIMITS[1])
        low, high = middle - MIN_ALTITUDE_SPAN / 2, middle + MIN_ALTITUDE_SPAN / 2
    return low, high
