"""`barpc crop`: a window of an image with its exact RPC."""

from __future__ import annotations

import json

import click
import numpy as np

from barpc.cameras import Camera, open_camera
from barpc.cli.points import as_json, check_target
from barpc.cli.terminal import echo
from barpc.rpcio import write_crop
from barpc.sensor.geometry import image_border


@click.command("crop")
@click.argument("image")
@click.argument("output")
@click.option("--window", type=(int, int, int, int), help="COL ROW WIDTH HEIGHT [px].")
@click.option("--bbox", type=(float, float, float, float), help="WEST SOUTH EAST NORTH [deg].")
@click.option("--alt", type=float, help="Altitude of the ground for --bbox [m].  [default: the RPC's middle]")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@as_json
def command(
    image: str,
    output: str,
    window: tuple[int, int, int, int] | None,
    bbox: tuple[float, float, float, float] | None,
    alt: float | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    r"""Write a window of an image as GeoTIFF, with the RPC of exactly that window.

    \b
    Examples:
      barpc crop image.tif part.tif --window 1000 2000 512 512
      barpc crop image.tif part.tif --bbox 5.43 43.25 5.44 43.26 --alt 180
    """
    if (window is None) == (bbox is None):
        raise click.UsageError("give either --window or --bbox")
    camera = open_camera(image)
    if bbox is not None:
        window = _window(camera, bbox, camera.altitude if alt is None else alt)
    assert window is not None
    check_target(output, [image], overwrite)
    write_crop(camera.rpc, image, output, window, overwrite=overwrite)
    text = f"{output}: col {window[0]}, row {window[1]}, {window[2]} x {window[3]} px"
    echo(json.dumps({"path": output, "window": window}) if as_json else text)


def _window(camera: Camera, bbox: tuple[float, float, float, float], alt: float) -> tuple[int, int, int, int]:
    """The pixels that a box on the ground covers, cut to the image."""
    west, south, east, north = bbox
    east += 360.0 * (east < west)  # a box across the antimeridian
    t = (image_border((1, 1), 16) + 0.5) * [east - west, north - south] + [west, south]
    image = camera.rpc.project(np.column_stack([t, np.full(len(t), alt)]))
    width, height = camera.extent
    low = np.maximum(np.floor(image.min(axis=0) + 0.5), 0)
    high = np.minimum(np.ceil(image.max(axis=0) + 0.5), [width, height])
    if not (np.isfinite(image).all() and (high > low).all()):
        raise click.UsageError(f"--bbox {bbox} does not meet {camera.path} at {alt:g} m")
    col, row = (int(v) for v in low)
    return col, row, int(high[0]) - col, int(high[1]) - row
