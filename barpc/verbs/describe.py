"""`info`: camera, coverage, view angles and pair geometry of images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from barpc.base.declarations import with_values
from barpc.base.errors import InputError, RpcError
from barpc.base.geodesy import feature_collection, geojson_feature, polygon
from barpc.base.verb_options import InfoOptions
from barpc.cameras import ImageLike, open_camera
from barpc.fit.poles import smallest_denominator
from barpc.scene import Camera
from barpc.sensor import geometry
from barpc.sensor.centers import camera_center
from barpc.sensor.rpc import RPC
from barpc.verbs.images import every, one_or_many, place_of
from barpc.verbs.points import altitude_of, exchanged, ground_at, terrain_of

if TYPE_CHECKING:
    from typing import Unpack

    from barpc.base.keywords import InfoKeywords
    from barpc.rasters.dem import Dem


def info(
    images: ImageLike | Iterable[ImageLike],
    **keywords: Unpack[InfoKeywords],
) -> Any:
    """Return the source of a camera, its coverage and view angles; of several images, each pair's angle.

    Parameters
    ----------
    images : one or many: paths, patterns, folders, open rasterio datasets, Views, Cameras
    **keywords : fields of `InfoOptions`: at, alt, dem, geoid

    Returns
    -------
    dict, of several images a list of them: the figures of `barpc info --json`

    Raises
    ------
    InputError
        `at` outside an image that covers it with longitude and latitude exchanged, a DEM without a height there.

    Examples
    --------
    >>> found = barpc.info("data_samples/view_00.tif", alt=120.0)
    >>> found["size_px"], round(found["incidence_deg"], 1), round(found["gsd_m"]["col"], 2)
    ([1000, 1000], 10.0, 0.51)
    >>> [pair["with"] for pair in barpc.info("data_samples/*.tif", alt=120.0)[0]["pairs"]]
    ['view_01', 'view_02']
    """
    _, several = one_or_many(images)
    given = every(images)
    if not given:
        raise InputError("no image is given")
    chosen = with_values(InfoOptions(), keywords, "info")
    found = described(given, chosen.at, chosen.alt, terrain_of(chosen.dem, chosen.geoid, chosen.alt))
    return found if several or len(found) > 1 else found[0]


def described(
    images: Sequence[ImageLike], at: tuple[float, ...] | None, alt: float | None, terrain: Dem | None
) -> list[dict[str, Any]]:
    """Return the figures of every image, with `pairs` those of each with the later ones."""
    cameras = [open_camera(image) for image in images]
    if at is not None and (wrong := exchanged(cameras[0], np.array([at]))):
        raise InputError(f"--at {at}: {wrong}")
    alts = [_altitude(image, camera, alt, terrain) for image, camera in zip(images, cameras, strict=True)]
    reports = [_describe(camera, height, at) for camera, height in zip(cameras, alts, strict=True)]
    for i, report in enumerate(reports if len(cameras) > 1 else ()):
        report["pairs"] = _viewed_together(images, cameras, i, alts[i], at)
    return reports


def _altitude(image: ImageLike, camera: Camera, alt: float | None, terrain: Dem | None) -> float:
    """Return the altitude of the ground in the middle of an image [m]; the camera's where no size tells the middle."""
    if camera.size is None:
        return camera.altitude
    if terrain is None:
        return altitude_of(camera, place_of(image), alt)
    found = ground_at(camera, (np.array([camera.size]) - 1) / 2, 0.0, terrain)[0, 2]
    if not np.isfinite(found):
        raise InputError(f"{image}: the DEM has no height in the middle of it")
    return float(found)


def outlines_geojson(images: Sequence[ImageLike], alt: float | None, terrain: Dem | None) -> dict[str, Any]:
    """Return GeoJSON (RFC 7946: cut at the antimeridian) of the images' outlines."""
    features = []
    for image in images:
        camera = open_camera(image)
        height = _altitude(image, camera, alt, terrain)
        border = geometry.image_border(camera.extent)
        level = height if terrain is None else ground_at(camera, border, height, terrain)[:, 2]
        ring = geometry.footprint(camera.model, camera.extent, level)
        if not np.isfinite(ring).all():
            raise RpcError(f"{image}: no ground point at its image's border at {height:g} m")
        path = place_of(image)
        features.append(geojson_feature(ring, name=path.stem, path=str(path), alt=height))
    return feature_collection(features)


def _viewed_together(
    images: Sequence[ImageLike], cameras: Sequence[Camera], i: int, alt: float, at: tuple[float, ...] | None
) -> list[dict[str, Any]]:
    """Return the convergence angle and B/H of an image and each later one at its centre."""
    first, height = cameras[i], np.asarray(alt)
    point = first.model.localize((np.array(first.extent) - 1) / 2, height) if at is None else np.array(at)
    rows = []
    for image, camera in list(zip(images, cameras, strict=True))[i + 1 :]:
        both = (first.model, camera.model, point)
        angle, ratio = float(geometry.convergence_angle(*both)), float(geometry.base_to_height(*both))
        rows.append({"with": place_of(image).stem, "convergence_deg": angle, "b_over_h": ratio})
    return rows


def _describe(camera: Camera, alt: float, at: tuple[float, ...] | None) -> dict[str, Any]:
    """Return all figures of a camera as plain values."""
    report: dict[str, Any] = {
        "rpc": f"{camera.format} in {camera.path}",
        "notes": list(camera.remarks),
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
    stand = camera_center(model, size, camera.alt_range)
    return report | {
        "incidence_deg": float(incidence),
        "azimuth_deg": float(azimuth),
        "gsd_m": {"col": float(metres[0]), "row": float(metres[1])},
        "camera_altitude_m": {"value": stand.altitude, "method": stand.method},
        "footprint": polygon(geometry.footprint(model, size, alt)),
    }
