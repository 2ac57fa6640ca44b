"""Images as the verbs take them: one or many paths, patterns and folders, open datasets, views and cameras."""

from __future__ import annotations

import glob
import os
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from barpc.base.errors import BarpcError, InputError, Remark
from barpc.base.manifest import LAST
from barpc.base.remote import PathOrUrl, is_url
from barpc.base.safe_io import unread
from barpc.cameras import ImageLike, file_of, open_camera, split_spec
from barpc.scene import Camera, View
from barpc.sensor import SensorModel


def one_or_many(images: ImageLike | Iterable[ImageLike]) -> tuple[list[ImageLike], bool]:
    """Return images as a list, open datasets as their paths, and whether several were asked for."""
    alone = isinstance(images, (str, os.PathLike, View, Camera, SensorModel)) or file_of(images) is not images
    return [file_of(image) for image in ([images] if alone else images)], not alone


def every(images: ImageLike | Iterable[ImageLike]) -> list[Any]:
    """Return images as a list, with folders and patterns expanded."""
    found = list[Any]()
    for image in one_or_many(images)[0]:
        found += expanded([os.fspath(image)]) if isinstance(image, (str, os.PathLike)) else [image]
    return found


def place_of(image: ImageLike | SensorModel) -> PathOrUrl:
    """Return the file of an image, as given."""
    given = file_of(image)
    return split_spec(os.fspath(given))[0] if isinstance(given, (str, os.PathLike)) else open_camera(given).path


# --- folders and patterns ---------------------------------------------------------------------------------


_ENDS = (".tif", ".tiff", ".ntf", ".nitf", ".nsf", ".jp2", ".j2k", ".pix", ".img", ".dat", ".vrt")


def expanded(specs: Sequence[str]) -> list[str]:
    """Return files instead of folders (their rasters; a radar product is one) and of patterns that no shell took.

    InputError for an empty name, a folder that holds no raster, a pattern that finds nothing.
    """
    found: list[str] = []
    for spec in specs:
        if not spec:  # what an unset variable of a shell leaves, and the current folder to all who open it
            raise InputError("an empty name among the images; give '.' for the current folder")
        name, choices = spec, ""
        if not os.path.lexists(spec) and not is_url(spec):
            name = os.fspath(name_of(spec))
            choices = spec[len(name) :]
        found += [one + choices for one in _matching_files(name)]
    return found


def name_of(spec: str) -> str:
    """Return the file name of an argument with choices behind it, as typed."""
    with suppress(BarpcError):
        _, choices = split_spec(spec)
        for key, text in choices.items():
            spec = spec.removesuffix(f",{key}={text}")
        return spec.partition(",")[0] if choices and not os.path.lexists(spec) else spec
    return spec


def _matching_files(name: str) -> list[str]:
    path = Path(name)
    if is_url(name) or not (path.is_dir() or any(char in name for char in "*?[")):
        return [name]
    if path.is_dir():
        if (path / "manifest.safe").exists() or path.suffix.upper() == ".SAFE":
            return [name]
        inside = sorted(entry.name for entry in os.scandir(path) if entry.is_file())
        rasters = [str(path / one) for one in inside if one.lower().endswith(_ENDS) and _is_raster(path / one)]
        if not rasters:
            from barpc.sensor.terrasar import find_annotation

            if find_annotation(path):
                return [name]
            raise InputError(f"{name}: a folder without images ({', '.join(_ENDS)}){unread(path)}")
        from barpc.report.finished import FinishedRun  # after all: most images are given by their names

        FinishedRun.refuse_edited(path, map(Path, rasters), of_images=True)
        if (path / LAST).is_file():
            said = "the folder of a finished run: its cameras are adjusted already"
            warnings.warn(f"{name}: {said}", Remark, stacklevel=2)
        return rasters
    if os.path.lexists(name):
        return [name]
    matching = sorted(glob.glob(name))  # noqa: PTH207  (a Path would take the ./ away)
    if not matching:
        raise InputError(f"{name}: no file has such a name")
    return matching


def _is_raster(path: Path) -> bool:
    from barpc.rasters.raster import driver_at

    with suppress(BarpcError):
        return driver_at(path) is not None
    return False
