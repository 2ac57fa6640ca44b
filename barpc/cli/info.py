"""`barpc info`: what an image or an RPC file is."""

from __future__ import annotations

import json
from typing import Any

import click
import numpy as np

from barpc.cli.points import Camera, camera_options, load_camera, middle_altitude
from barpc.cli.terminal import echo
from barpc.fit.certificate import smallest_denominator
from barpc.geojson import polygon
from barpc.sensor.geometry import (
    altitude_range,
    camera_center,
    footprint,
    ground_sample_distance,
    view_angles,
)
from barpc.sensor.rpc import RPC


@click.command("info")
@click.argument("images", nargs=-1, required=True, metavar="IMAGE...")
@click.option("--size", type=(int, int), help="Width and height of the image, for RPC files.")
@camera_options
def command(
    images: tuple[str, ...], size: tuple[int, int] | None, pixel_convention: str, band: int, as_json: bool
) -> None:
    r"""Say where an RPC comes from, what it covers and how it looks at the ground.

    \b
    Example:
      barpc info image.tif
    """
    reports = [describe(load_camera(image, pixel_convention, band, size)) for image in images]
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
    rpc = camera.rpc
    low, high = altitude_range(rpc)
    report: dict[str, Any] = {
        "rpc": f"{camera.source.format} in {camera.source.path}",
        "notes": list(camera.source.notes),
        "first_pixel": "its centre is (0, 0)",
        "altitude_range_m": [low, high],
        "domain": _domain(rpc),
        "err_bias_m": rpc.err_bias,
        "err_rand_m": rpc.err_rand,
        "smallest_denominator": smallest_denominator(
            rpc, rpc.ground_offset - np.abs(rpc.ground_scale), rpc.ground_offset + np.abs(rpc.ground_scale)
        ),
    }
    if camera.size is not None:
        report |= _geometry(rpc, camera.size)
    return report


def _domain(rpc: RPC) -> dict[str, list[float]]:
    low = rpc.ground_offset - np.abs(rpc.ground_scale)
    high = rpc.ground_offset + np.abs(rpc.ground_scale)
    return {"lon_deg": [float(low[0]), float(high[0])], "lat_deg": [float(low[1]), float(high[1])]}


def _geometry(rpc: RPC, size: tuple[int, int]) -> dict[str, Any]:
    """What follows from the RPC and the image's size: angles, ground sample distance, footprint."""
    alt = middle_altitude(rpc)
    middle = (np.array(size) - 1) / 2
    center = rpc.localize(middle, np.asarray(alt))
    report: dict[str, Any] = {"size_px": list(size), "center_deg": center[:2].tolist()}
    if not np.isfinite(center).all():
        return report | {"problem": "the RPC has no ground point at the image's centre"}
    incidence, azimuth = view_angles(rpc, center)
    metres = ground_sample_distance(rpc, middle, alt)
    stand = camera_center(rpc, size, altitude_range(rpc))
    ring = footprint(rpc, size, alt)
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
