"""`barpc footprint`: outlines of images on the ground as GeoJSON."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np

from barpc.atomic import write_text
from barpc.cameras import open_camera
from barpc.cli.points import as_json, check_target
from barpc.cli.terminal import echo
from barpc.errors import RpcError
from barpc.geojson import collection, feature
from barpc.sensor.geometry import footprint


@click.command("footprint")
@click.argument("images", nargs=-1, required=True, metavar="IMAGE...")
@click.option("--alt", type=float, help="Altitude of the ground [m].  [default: the RPC's middle]")
@click.option("-o", "--output", metavar="FILE", help="Write here instead of to standard output.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@as_json
def command(
    images: tuple[str, ...],
    alt: float | None,
    output: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    r"""Print the footprints of images as GeoJSON (RFC 7946: cut at the antimeridian).

    \b
    Example:
      barpc footprint *.tif -o footprints.geojson
    """
    if output is not None:
        check_target(output, images, overwrite)
    features = []
    for image in images:
        camera = open_camera(image)
        at = camera.altitude if alt is None else alt
        ring = footprint(camera.model, camera.extent, at)
        if not np.isfinite(ring).all():
            raise RpcError(f"{image}: the RPC has no ground point at its image's border at {at:g} m")
        features.append(feature(ring, name=Path(image).stem, path=str(image), alt=at))
    text = json.dumps(collection(features)) + "\n"
    if output is None:
        echo(text, nl=False)
    else:
        write_text(output, text, overwrite=overwrite)
