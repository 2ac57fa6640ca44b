"""Image files to views: what each file must have before any work starts."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from barpc.errors import BarpcError, ImageError, InputError, RpcError
from barpc.pipeline.twins import Twins
from barpc.plain import plain_path
from barpc.pointio.names import unique_names
from barpc.raster import open_raster
from barpc.rpcio import RpcSource, read_rpc_source
from barpc.scene import View
from barpc.sensor.geometry import altitude_range, footprint

logger = logging.getLogger(__name__)

MIN_ALTITUDE_SPAN = 100.0
"""Altitude ranges narrower than this [m] are widened to it: an RPC with a zero height scale is usable."""
ALTITUDE_LIMITS = (-1000.0, 9500.0)
"""The Earth's ground stays inside this [m], with a margin; RPCs that state more are cut to it."""


@dataclass(frozen=True, eq=False)
class LoadedViews:
    """Views, where their RPCs came from, and what was left out.

    Parameters
    ----------
    views : tuple of View
        In the order of their names.
    sources : tuple of RpcSource
        One a view.
    left_out : tuple of (str, str)
        Path and reason of each file that was left out.
    """

    views: tuple[View, ...]
    sources: tuple[RpcSource, ...]
    left_out: tuple[tuple[str, str], ...] = ()


def load_views(
    paths: Sequence[str | Path],
    *,
    min_views: int = 2,
    keep_going: bool = False,
    band: int = 1,
    distinct: bool = True,
) -> LoadedViews:
    """Read the camera of every image, in the order of their names, whatever order they are given in.

    Parameters
    ----------
    paths : sequence of path
        The image files.
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
    files = [plain_path(Path(path).absolute()) for path in paths]
    if len(files) < min_views:
        found = files[0] if files else "none"
        raise InputError(
            f"{len(files)} image(s) given ({found}): at least {min_views} that overlap are needed"
        )
    views: list[View] = []
    sources: list[RpcSource] = []
    left_out: list[tuple[str, str]] = []
    twins = Twins(band)
    for name, file in sorted(zip(unique_names(files), files, strict=True)):
        try:
            view, source = _load(name, file, band)
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


def _load(name: str, file: Path, band: int) -> tuple[View, RpcSource]:
    with open_raster(file) as image:
        size = (int(image.width), int(image.height))
        if not 1 <= band <= image.count:
            raise ImageError(f"{file}: has {image.count} band(s), no band {band}")
    source = read_rpc_source(file)
    low, high = altitude_range(source.rpc)
    low, high = max(low, ALTITUDE_LIMITS[0]), min(high, ALTITUDE_LIMITS[1])
    if high - low < MIN_ALTITUDE_SPAN:
        middle = min(max((low + high) / 2, ALTITUDE_LIMITS[0]), ALTITUDE_LIMITS[1])
        low, high = middle - MIN_ALTITUDE_SPAN / 2, middle + MIN_ALTITUDE_SPAN / 2
    view = View(name, str(file), size, source.rpc, (low, high))
    ring = footprint(view.sensor, size, (low + high) / 2)
    if not (abs(ring[:, 1]) <= 90).all():  # NaN fails, too
        raise RpcError(f"{file}: its RPC does not reach the ground over the image ({size[0]} x {size[1]} px)")
    return view, source
