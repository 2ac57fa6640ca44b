"""A rendered scene as files: GeoTIFFs with the delivered RPCs, truth.json, GCPs."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from barpc import __version__
from barpc.base.geodesy import Array
from barpc.rpcio.images import put_tag
from barpc.scene import BoolArray
from barpc.sensor.rpc import RPC
from barpc.workspace import Workspace
from tests.scenes.images import ImageOptions, Scene, Shot

CONVENTION = (
    "ground = lon [deg], lat [deg], altitude above the WGS84 ellipsoid [m]; image = col, row [px], (0, 0) "
    "the centre of the top-left pixel. exact camera(X) = delivered RPC(R (X - T - C) + C), X in ECEF [m], R "
    "the rotation vector `rotation` [rad], T `translation` [m], C `center` [m]. `drift` [rad] is what the "
    "delivered camera turns too far over the image's height, about its axes x (along the scan), y, z (down)."
)


def write_scene(
    out: Path | str,
    options: ImageOptions | None = None,
    *,
    overwrite: bool = False,
) -> list[Path]:
    """Render a scene into a folder.

    Parameters
    ----------
    out : Path or str
        Folder; made where it is missing.
    options : ImageOptions
        The scene.
    overwrite : bool
        Replace what an earlier run wrote here and nobody has changed since.

    Returns
    -------
    paths : list of Path
        The images. Beside them stand truth.json and, where GCPs were asked for, gcps.geojson.

    Raises
    ------
    InputError
        Options that contradict each other.
    OutputError
        The folder holds something and `overwrite` was not given, or a file that is in the way.
    """
    options = options or ImageOptions()
    scene = Scene(options)
    names = [
        *(f"{shot.name}.tif" for shot in scene.shots),
        "truth.json",
        *["gcps.geojson"] * (options.gcps > 0),
    ]
    with Workspace(out, overwrite=overwrite, names=names) as workspace:
        _write_scene(workspace, scene, options)
        workspace.remove_stale()
    return [Path(out) / f"{shot.name}.tif" for shot in scene.shots]


def _write_scene(workspace: Workspace, scene: Scene, options: ImageOptions) -> None:
    ground = scene.candidates(4 * (options.checks + options.gcps) + 64)
    images, in_sight = [], []
    for i, shot in enumerate(scene.shots):
        picture = scene.picture(i)
        with workspace.output(f"{shot.name}.tif") as partial:
            _write_image(partial, picture.numbers, shot.delivered)
        image, visible = scene.shows(i, ground, picture.altitude)
        images.append(image)
        in_sight.append(visible)
    xy, seen = np.array(images), np.array(in_sight)
    good = np.flatnonzero(seen.sum(axis=0) >= min(2, options.views))
    gcps, checks = good[: options.gcps], good[options.gcps :][: options.checks]
    truth = _truth(scene, ground[checks], xy[:, checks], seen[:, checks])
    workspace.write_text("truth.json", json.dumps(truth, indent=1) + "\n")
    if options.gcps:
        rng = np.random.default_rng([options.seed, 99])
        noisy = xy[:, gcps] + rng.normal(0, options.gcp_noise, (*seen[:, gcps].shape, 2))
        points = _gcp_collection(scene.shots, ground[gcps], noisy, seen[:, gcps])
        workspace.write_text("gcps.geojson", json.dumps(points, indent=1) + "\n")


def _write_image(path: Path, numbers: npt.NDArray[np.uint16], rpc: RPC) -> None:
    with image_file(path, numbers.shape[::-1], rpc) as file:
        file.write(numbers, 1)


@contextmanager
def image_file(path: Path, size: tuple[int, ...], rpc: RPC) -> Iterator[Any]:
    """Open a deflated, tiled GeoTIFF of a size to be written; with the RPC in its tag when it is closed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        layout: dict[str, Any] = {"tiled": True, "blockxsize": 256, "blockysize": 256}
        packing = {"compress": "deflate", "predictor": 2, "zlevel": 9}
        with rasterio.open(path, "w", "GTiff", *size, 1, dtype="uint16", nodata=0, **layout, **packing) as dataset:
            yield dataset
    put_tag(path, rpc)


def _truth(scene: Scene, ground: Array, xy: Array, seen: BoolArray) -> dict[str, Any]:
    """What truth.json holds."""
    return {
        "generator": f"barpc simulate {__version__}",
        "conventions": CONVENTION,
        "options": asdict(scene.options),
        "alt_range": scene.alt_range,
        "dates": [asdict(surface.date) for surface in scene.surfaces],
        "views": [_shot_record(shot) for shot in scene.shots],
        "check_points": [
            {
                "ground": point.tolist(),
                "image": {s.name: xy[k, i].tolist() for k, s in enumerate(scene.shots) if seen[k, i]},
            }
            for i, point in enumerate(ground)
        ],
    }


def _shot_record(shot: Shot) -> dict[str, Any]:
    correction = shot.correction
    return {
        "name": shot.name,
        "file": f"{shot.name}.tif",
        "date": shot.date,
        "look": asdict(shot.look),
        "radiometry": asdict(shot.radiometry),
        "rotation": correction.rotation.tolist(),
        "translation": correction.translation.tolist(),
        "center": correction.center.tolist(),
        "drift": shot.drift.tolist(),
        "exact_rpc": _rpc_record(shot.exact_rpc),
    }


def _rpc_record(rpc: RPC) -> dict[str, Any]:
    """The constructor's arguments of an RPC."""
    fields = ("coeffs", "ground_offset", "ground_scale", "image_offset", "image_scale")
    return {name: getattr(rpc, name).tolist() for name in fields}


def _gcp_collection(shots: tuple[Shot, ...], ground: Array, xy: Array, seen: BoolArray) -> dict[str, Any]:
    """GCPs as GeoJSON, a feature an observation: `ji` is (col, row), `filename` the image."""
    features = [
        {
            "type": "Feature",
            "properties": {"ji": xy[k, i].tolist(), "filename": f"{shot.name}.tif", "id": f"gcp_{i:03d}"},
            "geometry": {"type": "Point", "coordinates": ground[i].tolist()},
        }
        for i in range(len(ground))
        for k, shot in enumerate(shots)
        if seen[k, i]
    ]
    return {"type": "FeatureCollection", "features": features}
