"""The images of the repository, whole or a part of them, with what is true of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.geodesy import ecef_from_ground, enu_basis
from barpc.pointio.matches import write_matches
from barpc.rpcio import read_rpc
from barpc.rpcio.images import put_tag
from barpc.scene import Tracks, View
from barpc.sensor.rpc import RPC
from barpc.sensor.triangulation import triangulate
from tests.everywhere import rows_of
from tests.geotiffs import write_blank, write_image
from tests.reliability.trials import SAMPLES as SAMPLES
from tests.reliability.trials import crop

FOLDER = SAMPLES[0].parent
START, SIDE = 300, 288  # of a part


@dataclass(frozen=True)
class Known:
    """Images, their truth as truth.json has it, and a file of GCPs."""

    images: list[Path]
    truth: dict[str, Any]
    gcps: Path
    whole: bool


def whole() -> Known:
    """The images as they lie in the repository."""
    return Known(SAMPLES, json.loads((FOLDER / "truth.json").read_text()), FOLDER / "gcps.geojson", True)


def part(folder: Path, side: int = SIDE, start: int = START, gcps: int = 5) -> Known:
    """A window of each image: a run takes less than a second. Its first check points are its GCPs."""
    images = [crop(path, folder / path.name, side=side, start=start) for path in SAMPLES]
    truth = json.loads((FOLDER / "truth.json").read_text())
    points = [_moved(point, start, side) for point in truth["check_points"]]
    points = [point for point in points if len(point["image"]) == len(images)]
    gcps = min(gcps, len(points))
    (folder / "gcps.geojson").write_text(json.dumps(_features(points[:gcps])))
    return Known(images, {**truth, "check_points": points[gcps:]}, folder / "gcps.geojson", False)


def write_block(
    folder: Path, views: Sequence[View], tracks: Tracks, pixels: Callable[[int], np.ndarray] | None = None
) -> list[Path]:
    """Images of simulated views with their RPCs, blank or of the pixels of each number, and ties.npz."""
    paths = [folder / f"{view.name}.tif" for view in views]
    for number, (path, view) in enumerate(zip(paths, views, strict=True)):
        assert isinstance(view.sensor, RPC)
        if pixels is None:
            write_blank(path, view.size)
        else:
            write_image(path, pixels(number), compress="deflate")
        put_tag(path, view.sensor)
    write_matches(folder / "ties.npz", tracks, [view.name for view in views])
    return paths


def _moved(point: dict[str, Any], start: int, side: int) -> dict[str, Any]:
    """A check point in the windows that show it."""
    image = {name: [value - start for value in xy] for name, xy in point["image"].items()}
    seen = {name: xy for name, xy in image.items() if all(0 <= value <= side - 1 for value in xy)}
    return {"ground": point["ground"], "image": seen}


def _features(points: list[dict[str, Any]]) -> dict[str, Any]:
    features = [
        {
            "type": "Feature",
            "properties": {"filename": f"{name}.tif", "ji": xy, "id": f"gcp_{number:03d}"},
            "geometry": {"type": "Point", "coordinates": point["ground"]},
        }
        for number, point in enumerate(points)
        for name, xy in point["image"].items()
    ]
    return {"type": "FeatureCollection", "features": features}


def exact(truth: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Ground (N, 3) and image points (N, views, 2) of the check points that every view sees."""
    names = [view["name"] for view in truth["views"]]
    points = [point for point in truth["check_points"] if set(names) <= set(point["image"])]
    assert len(points) > (100 if len(truth["check_points"]) > 100 else 5)
    ground = np.array([point["ground"] for point in points])
    return ground, np.array([[point["image"][name] for name in names] for point in points])


def errors_of_run(out: Path, truth: dict[str, Any]) -> tuple[float, np.ndarray]:
    """`errors_at_check_points` of the cameras that a run wrote into a folder."""
    return errors_at_check_points([read_rpc(out / f"{view['name']}.vrt") for view in truth["views"]], truth)


def errors_at_check_points(sensors: Any, truth: dict[str, Any]) -> tuple[float, np.ndarray]:
    """RMS [px] of exact image points against their intersections, and the mean error (3,) of these [m, ENU].

    Reprojecting an intersection removes what tie points cannot tell: where the scene is as a whole.
    """
    ground, image = exact(truth)
    result = triangulate(sensors, *rows_of(image), alt=250.0)
    assert result.ok.all()
    offset = (result.points - ecef_from_ground(ground)).mean(axis=0)
    return float(np.sqrt((result.residuals**2).mean())), enu_basis(ground.mean(axis=0)) @ offset
