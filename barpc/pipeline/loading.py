"""Image files to views: the requirements on each file before any work starts, and each image once.

The same image twice ties itself to itself, perfectly and uselessly.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Hashable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.windows import Window

from barpc.base.errors import BarpcError, ImageError, InputError, MissingRpcError, RpcError
from barpc.base.geodesy import ALTITUDES
from barpc.base.identity import Stamp, also_seen, recorded
from barpc.base.remote import PathOrUrl, here, located
from barpc.base.safe_io import IMAGE, plain_path, versioned
from barpc.base.tasks import Progress
from barpc.cameras import checked_camera, open_split, split_spec
from barpc.pipeline.executor import GROUP, by_groups
from barpc.pointio.names import unique_names
from barpc.rasters.raster import open_raster
from barpc.rpcio.acquisition import read_acquisition
from barpc.scene import Camera, View
from barpc.sensor.geometry import LEAST_RANGE, footprint

logger = logging.getLogger(__name__)

_WINDOW_POSITIONS = ((0.5, 0.5), (0.25, 0.25), (0.75, 0.75))  # of width and height: where the sampled windows lie
_MORE = tuple((x / 5, y / 5) for x in range(6) for y in range(6))  # where nothing varies there
_SAMPLE_SIDE = (256, 16)  # px: many columns and few rows, so that few strips are decoded
_GIVE_RPC = "name its file behind it, {},camera=FILE, or leave the image out (--keep-going of adjust and match)"

Image = str | Path | View


@dataclass(frozen=True, eq=False)
class LoadedViews:
    """Views in the order of their names, the sources of their cameras, and path and reason of those left out."""

    views: tuple[View, ...]
    sources: tuple[Camera, ...]
    left_out: tuple[tuple[str, str], ...] = ()
    worker_seconds: float = 0.0  # of CPU, spent in other processes


_OpenedImage = tuple[View, Camera, bytes | None, Mapping[str, Stamp]]
"""An image that was opened: the mark of its sampled pixels (see `Twins`), and all files that were opened for it."""
_ImageRequest = tuple[str, PathOrUrl, Image]  # name, file, and what was given


def image_path(image: Image, hosts: Sequence[str] = ()) -> PathOrUrl:
    """Return the file with the pixels, absolute; on another host where it is one of `hosts`."""
    path = located(image.path, hosts) if isinstance(image, View) else split_spec(image, hosts)[0]
    return path.absolute()


def load_views(
    images: Sequence[Image],
    *,
    min_views: int = 2,
    control: bool = False,
    keep_going: bool = False,
    band: int = 1,
    distinct: bool = True,
    executor: Executor | None = None,
    progress: Progress | None = None,
    hosts: Sequence[str] = (),
) -> LoadedViews:
    """Read the camera of every image, in the order of their names: files, perhaps with choices behind them, or views.

    `control`: one image would be enough with control. With `keep_going` a bad file (ImageError, RpcError) is left out
    instead of stopping; `band` will be read, from 1; `distinct`: an image that is there twice, also as other files or
    under another RPC (see `Twins`), is refused; `hosts`: others than this machine from which files may be read
    (`RunOptions.allow_remote`). InputError for too few
    images, the same image twice, or a name that the files of a run cannot carry.
    """
    files = [plain_path(image_path(image, hosts)) for image in images]
    if len(files) < min_views:
        found = files[0] if files else "none"
        alone = "; one alone is adjusted by ground control points (--gcp)" if control and len(files) == 1 else ""
        num = f"{len(files)} image{'s' * (len(files) != 1)}"
        raise InputError(f"{num} given ({found}): at least {min_views} that overlap are needed{alone}")
    given = sorted(zip(unique_names(files), files, images, strict=True), key=lambda row: row[:2])
    how = (band, distinct, tuple(hosts))
    opened, spent = _read_all(given, how, executor if len(given) > GROUP else None, progress)
    twins, left_out = Twins(band), list[tuple[str, str]]()
    used: list[tuple[View, Camera]] = []
    for (_, file, _), read in zip(given, opened, strict=True):
        try:
            if isinstance(read, BarpcError):
                raise read
            view, camera, sampled, seen = read
            also_seen(seen)
            if distinct:
                twins.add(view, sampled)
            used.append((view, camera))
        except BarpcError as error:
            if not keep_going:
                if isinstance(error, MissingRpcError):
                    raise MissingRpcError(f"{error}; {_GIVE_RPC.format(file.name)}") from error
                raise
            logger.warning("%s is left out: %s", file, error)
            left_out.append((str(file), str(error)))
    if len(used) < min_views:
        raise InputError(f"{len(used)} of {len(files)} images can be used: at least {min_views} are needed")
    views, sources = zip(*used, strict=True) if used else ((), ())
    return LoadedViews(views, sources, tuple(left_out), spent)


def _read_all(
    given: list[_ImageRequest],
    how: tuple[int, bool, tuple[str, ...]],
    executor: Executor | None,
    progress: Progress | None,
) -> tuple[list[_OpenedImage | BarpcError], float]:
    """Return every image read, and the CPU seconds of worker processes."""
    groups = by_groups(executor, read_group, given, how, "cameras", progress)
    spent = 0.0 if executor is None else sum(seconds for _, seconds in groups)
    return [read for group, _ in groups for read in group], spent


def read_group(
    given: Sequence[_ImageRequest], band: int, distinct: bool, hosts: Sequence[str] = ()
) -> tuple[list[_OpenedImage | BarpcError], float]:
    """Read some images in a worker; an error of one leaves the others theirs. Returns CPU seconds, too."""
    start, out = time.thread_time(), list[_OpenedImage | BarpcError]()
    for name, file, image in given:
        try:
            with recorded({}) as files:
                out.append((*_open_image(name, file, image, band, hosts, distinct), files))
        except BarpcError as error:
            out.append(error)
    return out, time.thread_time() - start


def _open_image(
    name: str, file: PathOrUrl, image: Image, band: int, hosts: Sequence[str], distinct: bool
) -> tuple[View, Camera, bytes | None]:
    file = versioned(file, IMAGE)
    with open_raster(file) as dataset:
        size = (int(dataset.width), int(dataset.height))
        if not 1 <= band <= dataset.count:
            raise ImageError(f"{file}: has {dataset.count} band(s), no band {band}")
        tags = dataset.tags()
        if isinstance(image, View):
            camera = checked_camera(Camera(image.sensor, file, "given", image.size, image.alt_range), dataset)
            if image.size != size:
                raise InputError(f"{file}: is {size} px large, but its view says {image.size}")
        else:
            _, choices = split_spec(image, hosts)
            if "camera" in choices:  # as the image: no file has two names in a run
                choices["camera"] = os.fspath(located(choices["camera"], hosts).absolute())
            camera = open_split(file, choices, dataset=dataset)
            if camera.format in ("grid", "correction") and "camera" not in choices:
                raise ImageError(f"{file}: a grid and no image; give it behind its image: IMAGE,camera={file}")
        taken = read_acquisition(file, camera.path, tags)
        camera = replace(camera, sensor=taken.sensor)
        camera.require_usable(file)
        day = (image.date if isinstance(image, View) else "") or taken.day(tags)
        view = View(name, os.fspath(file), size, camera.model, _altitudes_used(camera), day)
        ring = footprint(view.sensor, size, view.altitude)
        if not (abs(ring[:, 1]) <= 90).all():  # NaN fails, too
            raise RpcError(f"{file}: its RPC does not reach the ground over the image ({size[0]} x {size[1]} px)")
        return view, camera, _sampled_digest(dataset, band) if distinct else None


def _altitudes_used(camera: Camera) -> tuple[float, float]:
    """Return the altitudes that a camera is used for [m]: an RPC with a zero height scale is usable."""
    low, high = max(camera.alt_range[0], ALTITUDES[0]), min(camera.alt_range[1], ALTITUDES[1])
    if high - low < LEAST_RANGE:
        middle = min(max((low + high) / 2, ALTITUDES[0]), ALTITUDES[1])
        low, high = middle - LEAST_RANGE / 2, middle + LEAST_RANGE / 2
    return low, high


class Twins:
    """Finds an image that was given before: the same file, the same camera, or the same pixels.

    Pixels of a band are compared as decoded values: copies in another compression, layout, number type or behind a VRT
    are found. Three small windows of each image are read; images in which these agree are then read whole, each once.
    An image in which nothing varies, in these and in 36 more, is compared with none. Work is linear in the images.
    """

    def __init__(self, band: int) -> None:
        self._band = band
        self._known: dict[Hashable, str] = {}
        self._alike: dict[Hashable, str | None] = {}

    def add(self, view: View, sampled: bytes | None) -> None:
        """Add a view with the hash of its sampled pixels; InputError names both views where it was added before."""
        marks: dict[Hashable, str] = {
            _identity(view.path): "is the same file as {}",
            (view.size, view.sensor): "is the same size and the same RPC as {}",
        }
        self._refuse(view, marks)
        pixels = None if sampled is None else self._pixels(view, sampled)
        if pixels is not None:
            marks[pixels] = "shows the same pixels as {} under another RPC"
            self._refuse(view, marks)
        self._known.update(dict.fromkeys(marks, view.path))

    def _refuse(self, view: View, marks: dict[Hashable, str]) -> None:
        for mark, what in marks.items():
            if mark in self._known:
                raise InputError(f"{view.path}: {what.format(self._known[mark])}; give each image once")

    def _pixels(self, view: View, sampled: bytes) -> Hashable | None:
        """Return a mark of the whole image where another is like it in the samples; None for the first of its like."""
        like = (view.size, sampled)
        if like not in self._alike:
            self._alike[like] = view.path
            return None
        with open_raster(view.path) as image:
            mark = _whole_digest(image, self._band)
        first, self._alike[like] = self._alike[like], None
        if first is not None:
            with open_raster(first) as image:
                before = _whole_digest(image, self._band)
            if before is not None:
                self._known[view.size, before] = first
        return None if mark is None else (view.size, mark)


def _sampled_digest(image: Any, band: int) -> bytes | None:
    """Return a mark of the pixels in a few windows; None where nothing varies in them."""
    size = image.width, image.height
    # fill, perhaps: more is asked before anything is read whole
    return _pixel_digest(image, band, _samples(*size)) or _pixel_digest(image, band, _samples(*size, _MORE))


def _identity(path: str) -> Hashable:
    if not here([path]):
        return str(path)
    file = Path(path).stat()
    return file.st_dev, file.st_ino


def _samples(width: int, height: int, at: Sequence[tuple[float, float]] = _WINDOW_POSITIONS) -> list[Window]:
    wide, high = (min(side, size) for side, size in zip(_SAMPLE_SIDE, (width, height), strict=True))
    return [Window(int(x * (width - wide)), int(y * (height - high)), wide, high) for x, y in at]


def _whole_digest(image: Any, band: int) -> bytes | None:
    """Return a hash of all pixels, row by row; None for an image in which nothing varies: it shows nothing."""
    rows = image.block_shapes[band - 1][0]  # whole blocks, so that each is decoded once
    tops = range(0, image.height, rows)
    return _pixel_digest(image, band, [Window(0, top, image.width, min(rows, image.height - top)) for top in tops])


def _pixel_digest(image: Any, band: int, windows: list[Window]) -> bytes | None:
    found = blake2b(digest_size=16)
    low = high = np.nan
    for window in windows:
        raw = image.read(band, window=window)
        for top in range(0, len(raw), _SAMPLE_SIDE[1]):
            rows = _as_floats(raw[top : top + _SAMPLE_SIDE[1]])
            found.update(rows.tobytes())
            low, high = np.fmin(low, np.fmin.reduce(rows, axis=None)), np.fmax(high, np.fmax.reduce(rows, axis=None))
    return found.digest() if high > low else None


def _as_floats(raw: Any) -> Any:
    """Return the pixels as 8-byte floats (complex ones as two), with one kind of zero and one of NaN."""
    parts = raw.astype(np.complex128).view(np.float64) if np.iscomplexobj(raw) else raw
    numbers = parts.astype(np.float64) + 0.0
    numbers[np.isnan(numbers)] = np.nan
    return numbers
