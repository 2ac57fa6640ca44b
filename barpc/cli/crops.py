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
from barpc.sensor.geometry import image_border
from barpc.tie.pairs import read_area

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


def windows_of(
    images: Sequence[tuple[Path, Camera]], window: Callable[[Camera, Path], Window]
) -> list[tuple[Path, Camera, Window]]:
    """Return the images that show what is asked for, and where; a usage error where none does, else it is said."""
    found = []
    for path, camera in images:
        try:
            found.append((path, camera, window(camera, path)))
        except click.UsageError as error:
            if len(images) == 1:
                raise
            say(f"{path} is left out: {error.message}")
    if not found:
        raise click.UsageError("no image shows what is to be cut out")
    return found
