"""`barpc info`: what an image or an RPC file is."""

from __future__ import annotations

import json
from typing import Any

import click
import numpy as np

from barpc.cameras import Camera, open_camera
from barpc.cli.points import as_json
from barpc.cli.terminal import echo
from barpc.fit.certificate import smallest_denominator
from barpc.geojson import polygon
from barpc.sensor.geometry import (
    camera_center,
    footprint,
    ground_sample_distance,
    view_angles,
)
from barpc.sensor.rpc import RPC


@click.command("info")
@click.argument("images", nargs=-1, required=True, metavar="IMAGE...")
@as_json
def command(images: tuple[str, ...], as_json: bool) -> None:
    r"""Say where an RPC comes from, what it covers and how it looks at the ground.

    \b
    Example:
      barpc info image.tif
    """
    reports = [describe(open_camera(image)) for image in images]
    if as_json:
        echo(json.dumps(reports))
        return
    for image, report in zip(images, reports, strict=True):
        echo(image)
        for key, value in report.items():
            if key != "footprint":
                echo(f"  {key.replace('_', ' ')}: {_text(value)}")


def describe(camera: Camera) -> dict[str, Any]:
    """Everything that `barpc info` tells, with plain values."""
    report: dict[str, Any] = {
        "rpc": f"{camera.format} in {camera.path}",
        "notes": list(camera.notes),
        "first_pixel": "its centre is (0, 0)",
        "altitude_range_m": list(camera.alt_range),
    }
    if isinstance(camera.model, RPC):
        report |= _box(camera.model)
    if camera.size is not None:
        report |= _geometry(camera, camera.size)
    return report


def _box(rpc: RPC) -> dict[str, Any]:
    """What an RPC alone states: its box on the ground, its accuracy, and how near to a pole it comes there."""
    low, high = rpc.ground_offset - np.abs(rpc.ground_scale), rpc.ground_offset + np.abs(rpc.ground_scale)
    return {
        "domain": {"lon_deg": [float(low[0]), float(high[0])], "lat_deg": [float(low[1]), float(high[1])]},
        "err_bias_m": rpc.err_bias,
        "err_rand_m": rpc.err_rand,
        "smallest_denominator": smallest_denominator(rpc, low, high),
    }


def _geometry(camera: Camera, size: tuple[int, int]) -> dict[str, Any]:
    """What follows from the camera and the image's size: angles, ground sample distance, footprint."""
    model, alt = camera.model, camera.altitude
    middle = (np.array(size) - 1) / 2
    center = model.localize(middle, np.asarray(alt))
    report: dict[str, Any] = {"size_px": list(size), "center_deg": center[:2].tolist()}
    if not np.isfinite(center).all():
        return report | {"problem": "no ground point at the image's centre"}
    incidence, azimuth = view_angles(model, center)
    metres = ground_sample_distance(model, middle, alt)
    stand = camera_center(model, size, camera.alt_range)
    ring = footprint(model, size, alt)
    return report | {
        "incidence_deg": float(incidence),
        "azimuth_deg": float(azimuth),
        "gsd_m": {"col": float(metres[0]), "row": float(metres[1])},
        "camera_altitude_m": {"value": stand.altitude, "method": stand.method},
        "footprint": polygon(ring) if np.isfinite(ring).all() else None,
    }


def _text(value: Any) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(v)}" for key, v in value.items())
    if isinstance(value, list):
        return " .. ".join(_text(v) for v in value) if value else "none"
    return str(value)
