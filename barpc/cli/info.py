"""`barpc info`: camera and coverage of an image or RPC file, and a test of the installation."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import click
import numpy as np

from barpc.base.errors import InputError, RpcError
from barpc.base.geodesy import feature_collection, geojson_feature, polygon
from barpc.cameras import open_camera, split_spec
from barpc.cli.flags import expanded
from barpc.cli.project import altitude_of, exchanged, ground_at, with_heights
from barpc.cli.terminal import echo, wants_json
from barpc.fit.poles import smallest_denominator
from barpc.rasters.dem import Dem
from barpc.scene import Camera
from barpc.sensor import geometry
from barpc.sensor.rpc import RPC


@click.command("info")
@click.argument("images", nargs=-1, metavar="IMAGE...")
@click.option(
    "--at", type=(float, float, float), help="Ground point of the angles: LON LAT ALT.  [default: the centre]"
)
@with_heights("Altitude of the ground [m].  [default: of the run's tie points, else the middle of the camera's]")
@click.option("--footprint", "outlines", is_flag=True, help="Print outlines on the ground as GeoJSON instead.")
def info(
    images: tuple[str, ...],
    at: tuple[float, float, float] | None,
    alt: float | None,
    terrain: Dem | None,
    outlines: bool,
) -> int:
    r"""Print the source of a camera, its coverage and view angles; of several, each pair's angle.

    The azimuth is that of the direction from the ground to the sensor, clockwise from north. A pair's convergence
    angle is taken at the first image's centre, or at --at. An IMAGE is a file with an RPC, a Sentinel-1 or TerraSAR-X
    product or annotation, a SICD image (XML or NITF), a CSM state, or a localisation grid; choices stand behind:
    ",size=W:H" and ",camera=FILE" (all); ",first_pixel=0.5" and ",band=2" (RPC); ",swath=iw1" (or mosaic),
    ",pol=vv", ",burst=3", ",orbit=X.EOF", ",atmosphere=yes", ",bistatic=full" (Sentinel-1); ",altitudes=0:500"
    (grid, CSM).
    ",model=physical" takes the orbit and attitude in Maxar's or Airbus' XML, given or beside an image, in place of the
    RPC; with it ",aberration=no", ",refraction=no", ",band=N", ",altitudes=0:500".

    \b
    Examples:
      barpc info left.tif right.tif
      barpc info vendor.RPB,size=20000:19000
      barpc info --footprint scene/*.tif > footprints.geojson
    """
    if not images:
        raise click.UsageError("give at least one IMAGE")
    images = tuple(expanded(images))
    cameras = [open_camera(image) for image in images]
    if outlines:
        echo(json.dumps(_outlines_geojson(images, cameras, alt, terrain)))
        return 0
    if at is not None and (wrong := exchanged(cameras[0], np.array([at]))):
        raise InputError(f"--at {at}: {wrong}")
    alts = [_altitude(image, camera, alt, terrain) for image, camera in zip(images, cameras, strict=True)]
    reports = [_describe(camera, height, at) for camera, height in zip(cameras, alts, strict=True)]
    if len(cameras) > 1:
        for i, report in enumerate(reports):
            report["pairs"] = _viewed_together(images, cameras, i, alts[i], at)
    if wants_json():
        echo(json.dumps(reports))
    else:
        for image, report in zip(images, reports, strict=True):
            echo("\n".join([image, *(f"  {label:<13}{line}" for label, line in _labelled_sentences(report))]))
    return 0


_CENTRE_METHODS = {
    "line": "where the rays of an image line meet",
    "stated": "by its orbit",
    "nominal": "assumed, as the rays of an image line meet in no orbit",
}


def _labelled_sentences(report: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the label and sentence of each line on a camera."""
    is_rpc = "domain" in report
    yield "camera", f"RPC ({report['rpc'].replace(' in ', ') in ', 1)}" if is_rpc else report["rpc"]
    yield from (("note", note) for note in report["notes"])
    if "size_px" not in report:
        yield "image", "size unknown: give FILE,size=WIDTH:HEIGHT for angles and positions"
    else:
        yield "image", "{} x {} px; (0, 0) is the centre of the first pixel".format(*report["size_px"])
    yield "altitudes", "{:.5g} to {:.5g} m above the ellipsoid".format(*report["altitude_range_m"])
    if is_rpc:
        yield from _lines_of_rpc(report)
    if "problem" in report:
        yield "problem", report["problem"]
    elif "size_px" in report:
        yield from _lines_of_geometry(report)
    for pair in report.get("pairs", ()):
        angle = "with {with}: {convergence_deg:.2f} deg between the rays, B/H {b_over_h:.3f}"
        yield "pair", angle.format(**pair)


def _lines_of_rpc(report: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield (
        "made for",
        "lon {0[0]:.5f} to {0[1]:.5f}, lat {1[0]:.5f} to {1[1]:.5f} deg".format(*report["domain"].values()),
    )
    stated = {"common to the image": report["err_bias_m"], "of each point": report["err_rand_m"]}
    known = [f"{value:.3g} m {what}" for what, value in stated.items() if value is not None]
    yield "accuracy", ", ".join(known) or "not stated"
    least = report["smallest_denominator"]
    pole = "no pole" if least > 0 else "a pole may lie in or near these bounds"
    yield "denominators", f"at least {least:.3g} of their value at the centre: {pole}"


def _lines_of_geometry(report: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield (
        "centre",
        "lon {:.6f}, lat {:.6f} deg".format(*report["center_deg"]) + f" at {report['center_alt_m']:.5g} m",
    )
    yield "pixel", "{col:.3f} m a column, {row:.3f} m a row on the ground".format(**report["gsd_m"])
    yield (
        "looks",
        "{incidence_deg:.2f} deg off the vertical, from {azimuth_deg:.2f} deg (north is 0)".format(**report),
    )
    stand = report["camera_altitude_m"]
    yield "sensor", f"{stand['value'] / 1e3:.1f} km high, {_CENTRE_METHODS[stand['method']]}"


def _altitude(image: str, camera: Camera, alt: float | None, terrain: Dem | None) -> float:
    """Return the altitude of the ground in the middle of an image [m]; the camera's where no size tells the middle."""
    if camera.size is None:
        return camera.altitude if alt is None else alt
    if terrain is None:
        return altitude_of(camera, split_spec(image)[0], alt)
    found = ground_at(camera, (np.array([camera.size]) - 1) / 2, 0.0, terrain)[0, 2]
    if not np.isfinite(found):
        raise InputError(f"{image}: the DEM has no height in the middle of it")
    return float(found)


def _outlines_geojson(
    images: Sequence[str], cameras: Sequence[Camera], alt: float | None, terrain: Dem | None
) -> dict[str, Any]:
    """Return GeoJSON (RFC 7946: cut at the antimeridian) of the images' outlines."""
    features = []
    for image, camera in zip(images, cameras, strict=True):
        height = _altitude(image, camera, alt, terrain)
        border = geometry.image_border(camera.extent)
        level = height if terrain is None else ground_at(camera, border, height, terrain)[:, 2]
        ring = geometry.footprint(camera.model, camera.extent, level)
        if not np.isfinite(ring).all():
            raise RpcError(f"{image}: no ground point at its image's border at {height:g} m")
        path = split_spec(image)[0]
        features.append(geojson_feature(ring, name=path.stem, path=str(path), alt=height))
    return feature_collection(features)


def _viewed_together(
    images: Sequence[str], cameras: Sequence[Camera], i: int, alt: float, at: tuple[float, ...] | None
) -> list[dict[str, Any]]:
    """Return the convergence angle and B/H of an image and each later one at its centre."""
    first, height = cameras[i], np.asarray(alt)
    point = first.model.localize((np.array(first.extent) - 1) / 2, height) if at is None else np.array(at)
    rows = []
    for image, camera in list(zip(images, cameras, strict=True))[i + 1 :]:
        both = (first.model, camera.model, point)
        angle, ratio = float(geometry.convergence_angle(*both)), float(geometry.base_to_height(*both))
        rows.append({"with": split_spec(image)[0].stem, "convergence_deg": angle, "b_over_h": ratio})
    return rows


def _describe(camera: Camera, alt: float, at: tuple[float, ...] | None) -> dict[str, Any]:
    """Return all figures of a camera as plain values."""
    report: dict[str, Any] = {
        "rpc": f"{camera.format} in {camera.path}",
        "notes": list(camera.notes),
        "first_pixel": "its centre is (0, 0)",
        "altitude_range_m": list(camera.alt_range),
    }
    if isinstance(camera.model, RPC):
        report |= _box(camera.model)
    if camera.size is not None:
        report |= _geometry(camera, camera.size, alt, at)
    return report


def _box(rpc: RPC) -> dict[str, Any]:
    """Return the figures of an RPC alone: its ground box, stated accuracy and smallest denominator there."""
    low, high = rpc.ground_offset - np.abs(rpc.ground_scale), rpc.ground_offset + np.abs(rpc.ground_scale)
    lon, lat, _ = np.stack([low, high], axis=1).tolist()
    return {
        "domain": {"lon_deg": lon, "lat_deg": lat},
        "err_bias_m": rpc.err_bias,
        "err_rand_m": rpc.err_rand,
        "smallest_denominator": smallest_denominator(rpc, low, high),
    }


def _geometry(camera: Camera, size: tuple[int, int], alt: float, at: tuple[float, ...] | None) -> dict[str, Any]:
    """Return the figures by camera and image size: angles, ground sample distance, footprint."""
    model = camera.model
    middle = (np.array(size) - 1) / 2
    center = model.localize(middle, np.asarray(alt))
    report: dict[str, Any] = {"size_px": list(size), "center_deg": center[:2].tolist(), "center_alt_m": alt}
    if not np.isfinite(center).all():
        return report | {"problem": "no ground point at the image's centre"}
    incidence, azimuth = geometry.view_angles(model, center if at is None else np.array(at))
    metres, _ = geometry.ground_sample_distance(model, center)
    stand = geometry.camera_center(model, size, camera.alt_range)
    return report | {
        "incidence_deg": float(incidence),
        "azimuth_deg": float(azimuth),
        "gsd_m": {"col": float(metres[0]), "row": float(metres[1])},
        "camera_altitude_m": {"value": stand.altitude, "method": stand.method},
        "footprint": polygon(geometry.footprint(model, size, alt)),
    }
