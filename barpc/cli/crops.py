"""`barpc convert --bbox` and `--aoi`: the part of the ground that is asked for, out of one image or of many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import click
import numpy as np
import shapely

from barpc.cameras import Camera
from barpc.cli.heights import altitude_of, exchanged
from barpc.cli.terminal import say
from barpc.dem import Dem
from barpc.handoff import Reading, verify
from barpc.rpcio import WRITABLE, write_camera, write_crop
from barpc.sensor.geometry import image_border
from barpc.tie.pairing.area import read_area
from barpc.workspace import Workspace

Window = tuple[int, int, int, int]
Box = tuple[float, float, float, float]


def box_of(path: str) -> Box:
    """Return west, south, east, north [deg] of an area of interest; east is less than west across the antimeridian."""
    outline = read_area(path).outline  # three times, a whole turn apart
    found = [shapely.clip_by_rect(outline, west, -90.0, west + 360.0, 90.0).bounds for west in (-180.0, 0.0)]
    west, south, east, north = min(found, key=lambda bounds: bounds[2] - bounds[0])
    return west, south, east - 360.0 * (east > 180.0), north


def window_of(camera: Camera, path: Path, bbox: Box, alt: float | None, dem: Dem | None) -> Window:
    """Return the pixels that a box on the ground covers, cut to the image; a usage error where it does not meet it."""
    west, south, east, north = bbox
    east += 360.0 * (east < west)  # a box across the antimeridian
    t = (image_border((1, 1), 16) + 0.5) * [east - west, north - south] + [west, south]
    level = np.full(len(t), altitude_of(camera, path, alt)) if dem is None else dem(t[:, 0], t[:, 1])
    ground = np.column_stack([t, level])
    image = camera.model.project(ground)
    whole = np.array([np.floor(image.min(axis=0) + 0.5), np.ceil(image.max(axis=0) + 0.5)])
    low, high = np.maximum(whole[0], 0), np.minimum(whole[1], camera.extent)
    if not (np.isfinite(image).all() and (high > low).all()):
        missed = exchanged(camera, np.nan_to_num(ground)) or f"does not meet {camera.path}"
        raise click.UsageError(f"--bbox {bbox}: {missed} (ground at {np.median(level):g} m)")
    if (kept := float(np.prod((high - low) / (whole[1] - whole[0])))) < 1.0:
        say(f"{path}: --bbox reaches beyond the image; {100 * (1 - kept):.2g} % of it is cut off")
    (col, row), (width, height) = low.astype(int).tolist(), (high - low).astype(int).tolist()
    return col, row, width, height


def crop_all(
    shown: Sequence[tuple[Path, Camera]],
    folder: Path,
    window: Callable[[Camera, Path], Window],
    formats: Sequence[str],
    overwrite: bool,
) -> list[Reading]:
    """Write a part of every image that shows it, with its RPC inside and in files, and open all of them again.

    An image that does not show it is said on stderr and left out; a usage error where none does.
    """
    windows: list[tuple[Path, Camera, Window]] = []
    for path, camera in shown:
        try:
            windows.append((path, camera, window(camera, path)))
        except click.UsageError as error:
            if len(shown) == 1:
                raise
            say(f"{path} is left out: {error.message}")
    if not windows:
        raise click.UsageError("no image shows what is to be cut out")
    names = [
        [path.stem + end for end in (".tif", *(WRITABLE[one].beside for one in formats))]
        for path, *_ in windows
    ]
    inputs = [*(path for path, _ in shown), *(Path(camera.path) for _, camera in shown)]
    readings: list[Reading] = []
    every = [name for row in names for name in row]
    with Workspace(folder, overwrite=overwrite, keep=inputs, names=every, adds=True) as workspace:
        for (path, camera, place), row in zip(windows, names, strict=True):
            with workspace.output(row[0]) as partial:
                rpc = write_crop(camera.rpc, path, partial, place, overwrite=True)
            for name in row[1:]:
                with workspace.output(name) as partial:
                    write_camera(rpc, partial, path, place=folder / name, overwrite=True)
            readings += verify([folder / name for name in row], rpc, place[2:], camera.alt_range)
    return readings
