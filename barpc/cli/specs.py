"""What stands for images on the command line: files, folders, patterns, lists."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from barpc.errors import BarpcError, InputError
from barpc.remote import is_url
from barpc.sidefile import IMAGE, read_head, read_names

_ENDS = (".tif", ".tiff", ".ntf", ".nitf", ".nsf", ".jp2", ".j2k", ".vrt")


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
        found += [one + choices for one in _files(name)]
    return found


def image_paths(images: tuple[str, ...], image_list: str | None) -> list[str]:
    """Return images of the command line, then those of a list file (blank lines and # comments are skipped)."""
    paths = list(images)
    if image_list is not None:
        folder, lines = Path(image_list).parent, read_names(image_list, "a list of images")
        named = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
        paths += [name if is_url(name) else str(folder / name) for name in named]
    return paths


def name_of(spec: str) -> str:
    """Return the file's part of a name with choices behind it, as it was typed."""
    from barpc.cameras import split_spec

    with suppress(BarpcError):
        _, choices = split_spec(spec)
        for key, text in choices.items():
            spec = spec.removesuffix(f",{key}={text}")
        return spec.partition(",")[0] if choices and not os.path.lexists(spec) else spec
    return spec


def _files(name: str) -> list[str]:
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
            raise InputError(f"{name}: a folder without images ({', '.join(_ENDS)})")
        return rasters
    if os.path.lexists(name):
        return [name]
    matching = sorted(glob.glob(name))  # noqa: PTH207  (a Path would take the ./ away)
    if not matching:
        raise InputError(f"{name}: no file has such a name")
    return matching


def _is_raster(path: Path) -> bool:
    from barpc.raster import driver_of

    with suppress(BarpcError):
        return driver_of(read_head(path, IMAGE, 64)) is not None
    return False
