"""`barpc angle`: where a camera looks from, and under what angles several cameras see a point."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path
from typing import Any

import click
import numpy as np

from barpc.cameras import open_camera
from barpc.cli.points import as_json
from barpc.cli.terminal import echo
from barpc.sensor.geometry import convergence_angle, view_angles


@click.command("angle")
@click.argument("images", nargs=-1, required=True, metavar="IMAGE...")
@click.option("--at", type=(float, float, float), help="Ground point: lon, lat, alt.  [default: each centre]")
@as_json
def command(
    images: tuple[str, ...],
    at: tuple[float, float, float] | None,
    as_json: bool,
) -> None:
    r"""Print incidence and azimuth of each image, convergence angle and B/H of each pair, in degrees.

    The azimuth is that of the direction from the ground to the sensor, clockwise from north. A pair's angle
    is taken at the first image's point.

    \b
    Example:
      barpc angle left.tif right.tif
    """
    cameras = [open_camera(image) for image in images]
    points = []
    for camera in cameras:
        if at is not None:
            points.append(np.array(at))
            continue
        center = (np.array(camera.extent) - 1) / 2
        points.append(camera.model.localize(center, np.asarray(camera.altitude)))
    views: list[dict[str, Any]] = []
    for image, camera, point in zip(images, cameras, points, strict=True):
        incidence, azimuth = view_angles(camera.model, point)
        views.append({"name": Path(image).stem, "incidence": float(incidence), "azimuth": float(azimuth)})
    pairs: list[dict[str, Any]] = []
    for (i, a), (j, b) in combinations(enumerate(cameras), 2):
        angle = float(convergence_angle(a.model, b.model, points[i]))
        ratio = 2 * float(np.tan(np.radians(angle) / 2))
        pairs.append({"a": views[i]["name"], "b": views[j]["name"], "convergence": angle, "b_over_h": ratio})
    if as_json:
        echo(json.dumps({"views": views, "pairs": pairs}))
        return
    for view in views:
        echo(f"{view['name']}: incidence {view['incidence']:.3f}, azimuth {view['azimuth']:.3f}")
    for pair in pairs:
        echo(f"{pair['a']} - {pair['b']}: {pair['convergence']:.3f}, B/H {pair['b_over_h']:.3f}")
