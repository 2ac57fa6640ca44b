"""For neural renderers, splatting and COLMAP: RPCs as dictionaries, and cameras near them with their errors."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from rasterio.warp import transform

from barpc.errors import InputError
from barpc.export.approx import (
    Pinhole,
    factored,
    fit_affine,
    fit_pinhole,
    fit_projective,
    project_affine,
    project_projective,
)
from barpc.export.shots import Scene, Shot, relative_link
from barpc.geodesy import Array, ecef_from_ground, polygon, utm, wrap_longitude
from barpc.remote import is_url
from barpc.report.records import plain
from barpc.report.tables import ply
from barpc.rpcio import WRITABLE
from barpc.sensor.geometry import footprint, image_grid

Files = dict[str, bytes]

_BANDS = "CDEFGHJKLMNPQRSTUVWXX"  # of latitude, 8 degrees each, in the names of UTM zones
_CORNER = 0.5  # px from the corner of the first pixel, where some count from, to its centre
_MOVED = np.array([[1.0, 0.0, _CORNER], [0.0, 1.0, _CORNER], [0.0, 0.0, 1.0]])
_GL = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes right, down, forward -> right, up, backward


def as_json(value: Any) -> bytes:
    """Return a JSON text; what is not finite is null."""
    return (json.dumps(plain(value), indent=1, ensure_ascii=False) + "\n").encode()


def rpc_of(shot: Shot) -> dict[str, Any]:
    """Return the corrected RPC in the names of rpcm."""
    write = WRITABLE["json"].write
    assert write is not None
    found: dict[str, Any] = json.loads(write(shot.rpc))["rpc"]
    return found


# --- Sat-NeRF and EOGS ------------------------------------------------------------------------------------


def _record(scene: Scene, shot: Shot, img: str) -> dict[str, Any]:
    """Return the record of an image that Sat-NeRF and its relatives read."""
    low, high = scene.alt_range
    ring = footprint(shot.rpc, shot.size, scene.origin[2])
    middle = shot.rpc.localize((np.array(shot.size) - 1.0) / 2, np.array(scene.origin[2]))
    top = shot.rpc.localize(shot.xy, np.full(len(shot.xy), high))
    depth = np.linalg.norm(ecef_from_ground(top) - ecef_from_ground(scene.points[shot.index]), axis=1)
    return {
        "img": img,
        "height": shot.size[1],
        "width": shot.size[0],
        "sun_elevation": shot.light.elevation,
        "sun_azimuth": shot.light.azimuth,
        "acquisition_date": shot.light.time,
        "geojson": {**(polygon(ring) or {}), "center": [float(wrap_longitude(middle[0])), float(middle[1])]},
        "min_alt": low,
        "max_alt": high,
        "rpc": rpc_of(shot),
        "keypoints": {"2d_coordinates": shot.xy, "pts3d_indices": shot.index, "depths": depth},
    }


def satnerf(scene: Scene, out: Path) -> Files:
    """Write ``<image>.json`` each, the points in ``pts3d.npy`` (ECEF), ``train.txt`` and ``test.txt``."""
    rows = zip(scene.shots, scene.file_names(out), strict=True)
    files = {f"{shot.name}.json": as_json(_record(scene, shot, img)) for shot, img in rows}
    names = list(files)
    points = io.BytesIO()
    np.save(points, ecef_from_ground(scene.points), allow_pickle=False)
    # no end of line after the last
    lists = {"train.txt": "\n".join(names).encode(), "test.txt": names[-1].encode()}
    return {**files, **lists, "pts3d.npy": points.getvalue()}


def eogs(scene: Scene, out: Path) -> Files:
    """Write what `satnerf` writes, and ``affine_models.json``: affine cameras in UTM metres, with their errors."""
    frame = _Utm(scene)
    rows = zip(scene.shots, scene.file_names(out), strict=True)
    models = [_record(scene, shot, img) | frame.models(scene, shot) for shot, img in rows]
    return {**satnerf(scene, out), "affine_models.json": as_json(models)}


class _Utm:
    """The frame of EOGS: UTM easting, northing and altitude, moved and scaled: the scene fits into a unit ball."""

    def __init__(self, scene: Scene) -> None:
        lon, lat, _ = scene.origin
        self.zone, self._crs = utm(lon, lat)
        self.band = _BANDS[int(np.clip((lat + 80.0) // 8.0, 0, len(_BANDS) - 1))]
        corners = np.concatenate([self.metres(_grid(scene, shot, (2, 2))[0]) for shot in scene.shots])
        self.center = np.append(corners[:, :2].mean(axis=0), scene.alt_range[0])
        self.scale = float(np.linalg.norm(corners - self.center, axis=1).max())
        self.corners = (corners - self.center) / self.scale

    def metres(self, ground: Array) -> Array:
        """Return the UTM easting, northing, altitude (N, 3) [m] of ground points (N, 3)."""
        lon = wrap_longitude(ground[:, 0])
        east, north = transform("EPSG:4326", self._crs, lon.tolist(), ground[:, 1].tolist())
        return np.column_stack([east, north, ground[:, 2]])

    def models(self, scene: Scene, shot: Shot) -> dict[str, Any]:
        """Return the affine camera of a shot: -1 to 1 over the image, altitudes in metres; the sun's where known."""
        ground, image = _grid(scene, shot, (21, 9))
        world = (self.metres(ground) - self.center) / self.scale
        size = np.array(shot.size)
        view = np.column_stack([(image + 0.5) / size * 2.0 - 1.0, ground[:, 2]])
        rows = np.column_stack([world, np.ones(len(world))])
        found = np.linalg.lstsq(rows, view)[0]
        off = (rows @ found - view)[:, :2] * size / 2
        linear, shift = found[:3].T, found[3]
        model = {
            "coef_": linear,
            "intercept_": shift,
            "scale": self.scale,
            "n": self.zone,
            "l": self.band,
            "center": self.center,
            "min_world": self.corners.min(axis=0),
            "max_world": self.corners.max(axis=0),
        }
        error = float(np.linalg.norm(off, axis=1).max())
        return {"model": model, "affine_error_px": error, "sun_model": _sun(shot, linear, shift)}


def _sun(shot: Shot, linear: Array, shift: Array) -> dict[str, Any] | None:
    """Return the affine camera that looks from the sun: shadows fall where it sees two points in one place."""
    if shot.light.elevation is None or shot.light.azimuth is None:
        return None
    up, around = np.radians([shot.light.elevation, shot.light.azimuth])
    sun = np.array([np.sin(around) * np.cos(up), np.cos(around) * np.cos(up), np.sin(up)])
    sun = sun / (linear @ sun)[2]
    seen = linear @ sun
    turn = np.array([[1.0, 0.0, -seen[0]], [0.0, 1.0, -seen[1]], [0.0, 0.0, 1.0]])
    return {"coef_": turn @ linear, "intercept_": shift, "sun_dir_ecef": sun, "camera_to_sun": turn}


def _grid(scene: Scene, shot: Shot, nodes: tuple[int, int]) -> tuple[Array, Array]:
    image, alt = image_grid(shot.size, scene.alt_range, nodes)
    ground = shot.rpc.localize(image, alt)
    known = np.isfinite(ground).all(axis=1)
    return ground[known], image[known]


# --- pinholes ---------------------------------------------------------------------------------------------


def pinhole_of(scene: Scene, shot: Shot) -> tuple[Pinhole, float]:
    """Return the nearest pinhole of a shot, and its largest error over the scene [px]."""
    pinhole = fit_pinhole(scene.samples(shot), **scene.view_of(shot))
    checked = scene.samples(shot, checked=True)
    error = checked.error(pinhole.project(checked.world))
    if not (np.isfinite(error) and (pinhole.focal > 0).all()):
        raise InputError(f"{shot.name}: shows the ground mirrored, or no pinhole camera comes near its RPC")
    return pinhole, error


def nerfstudio(scene: Scene, out: Path) -> Files:
    """Write ``transforms.json``: pinhole, pose and largest error of every image, simpler and nearer cameras beside."""
    frames = [_frame(scene, shot, out) for shot in scene.shots]
    found = {
        "camera_model": "PINHOLE",
        "orientation_override": "none",
        "world_to_ecef": scene.world_to_ecef,
        "alt_range": scene.alt_range,
        "ply_file_path": "points.ply",
        "frames": frames,
    }
    return {"transforms.json": as_json(found), "points.ply": _cloud(scene)}


def _frame(scene: Scene, shot: Shot, out: Path) -> dict[str, Any]:
    pinhole, error = pinhole_of(scene, shot)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = pinhole.rotation.T, -pinhole.rotation.T @ pinhole.translation
    fitted, checked = scene.samples(shot), scene.samples(shot, checked=True)
    matrix, affine = fit_projective(fitted), fit_affine(fitted)
    calibration, rotation, translation = factored(matrix)
    return {
        "file_path": relative_link(shot.file, out),
        "w": shot.size[0],
        "h": shot.size[1],
        "fl_x": pinhole.focal[0],
        "fl_y": pinhole.focal[1],
        "cx": pinhole.center[0] + _CORNER,
        "cy": pinhole.center[1] + _CORNER,
        "transform_matrix": pose @ _GL,
        "pinhole_error_px": error,
        "skew_pinhole": {
            "K": _MOVED @ calibration,
            "R": rotation,
            "t": translation,
            "error_px": checked.error(project_projective(matrix, checked.world)),
        },
        "affine": {
            "matrix": affine + np.array([0.0, 0.0, 0.0, _CORNER]),
            "error_px": checked.error(project_affine(affine, checked.world)),
        },
    }


def _cloud(scene: Scene) -> bytes:
    """Return the tie points in the world's frame, as renderers start from them: with a colour."""
    places = dict(zip("xyz", scene.world(scene.points).T.astype(np.float32), strict=True))
    grey = np.full(len(scene.points), 128, dtype=np.uint8)
    return ply(places | dict.fromkeys(("red", "green", "blue"), grey))


# --- COLMAP -----------------------------------------------------------------------------------------------


def colmap(scene: Scene, out: Path) -> Files:
    """Write a text model of pinhole cameras, tie points and their places; ``world.json`` places it on Earth.

    Images are called by their names in the folder ``images`` (`image_links`).
    """
    world = scene.world(scene.points)
    cameras, images, errors = [], [], {}
    seen: dict[int, list[tuple[int, int, float]]] = {}
    for number, (shot, name) in enumerate(zip(scene.shots, _called(scene), strict=True), start=1):
        if any(char.isspace() for char in name):
            raise InputError(
                f"{shot.file}: COLMAP ends the name of an image at a space; rename it, or give a link without one"
            )
        pinhole, errors[name] = pinhole_of(scene, shot)
        center = pinhole.center + _CORNER
        numbers = [*shot.size, *pinhole.focal.tolist(), *center.tolist()]
        cameras.append(_line(number, "PINHOLE", *numbers))
        turn = _quaternion(pinhole.rotation).tolist()
        images.append(_line(number, *turn, *pinhole.translation.tolist(), number, name))
        places = zip((shot.xy + _CORNER).tolist(), (shot.index + 1).tolist(), strict=True)
        images.append(" ".join(_line(*xy, point) for xy, point in places))
        miss = np.linalg.norm(pinhole.project(world[shot.index]) - shot.xy, axis=1)
        for place, (point, error) in enumerate(zip(shot.index.tolist(), miss.tolist(), strict=True)):
            seen.setdefault(point, []).append((number, place, error))
    points = []
    for point in sorted(seen):
        track = [value for image, place, _ in seen[point] for value in (image, place)]
        mean = float(np.mean([error for *_, error in seen[point]]))
        points.append(_line(point + 1, *world[point].tolist(), 128, 128, 128, mean, *track))
    about = {"world_to_ecef": scene.world_to_ecef, "alt_range": scene.alt_range, "pinhole_error_px": errors}
    named = zip(scene.shots, _called(scene), strict=True)
    about["images"] = {name: relative_link(shot.file, out) for shot, name in named}
    texts = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}
    return {f"sparse/0/{name}": ("\n".join(lines) + "\n").encode() for name, lines in texts.items()} | {
        "world.json": as_json(about)
    }


def _called(scene: Scene) -> list[str]:
    """Return what the model calls the images: as their files where these names differ, else as the run."""
    names = [PurePath(shot.file).name for shot in scene.shots]
    if len(set(names)) == len(names):
        return names
    return [shot.name + PurePath(shot.file).suffix for shot in scene.shots]


def image_links(scene: Scene) -> dict[str, str]:
    """Return the links in the folder of a COLMAP model and the local images that they point at: nothing is copied."""
    rows = zip(scene.shots, _called(scene), strict=True)
    return {f"images/{name}": shot.file for shot, name in rows if not is_url(shot.file)}


def _line(*values: float | str) -> str:
    return " ".join(value if isinstance(value, str) else repr(value) for value in values)


def _quaternion(rotation: Array) -> Array:
    """Return the w, x, y, z of a rotation (3, 3), w not negative."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return np.array([w, x, y, z])


NEURAL: Mapping[str, Any] = {"satnerf": satnerf, "eogs": eogs, "nerfstudio": nerfstudio, "colmap": colmap}
