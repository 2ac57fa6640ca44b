"""For COLMAP: the pinhole camera nearest to each RPC, without skew, with its largest error.

A pinhole sees points in metres east, north, up of the scene's origin, and image points as barpc counts them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePath

import numpy as np
from scipy.spatial.transform import Rotation

from barpc.base.errors import InputError
from barpc.base.geodesy import Array
from barpc.base.remote import is_url
from barpc.export.files import Files, as_json
from barpc.export.shots import Sampled, Scene, Shot, relative_link
from barpc.sensor.curve import rotation_left_jacobian, rotation_matrix

_DISTANCE_FACTORS = 1.0, 2.0, 3.0  # an image that is affine along its flight is best seen from farther away than it was
_CORNER = 0.5  # px from the corner of the first pixel, where COLMAP counts from, to its centre


@dataclass(frozen=True, eq=False)
class Pinhole:
    """K (R X + t): rotation (3, 3) and translation (3,) of the world into right, down, forward; K without skew."""

    focal: Array  # (2,) [px]
    center: Array  # (2,) principal point [px], seldom inside the image: it takes the place of a skew
    rotation: Array
    translation: Array

    def project(self, world: Array) -> Array:
        """Return the image points (N, 2) [px] of points (N, 3) [m]."""
        seen = world @ self.rotation.T + self.translation
        return np.asarray(seen[:, :2] / seen[:, 2:] * self.focal + self.center)


def fit_pinhole(samples: Sampled, at: Array, pixel: Array, rows: Array, sight: Array, far: float) -> Pinhole:
    """Return the nearest pinhole camera without skew.

    Parameters
    ----------
    at, pixel : (3,), (2,), a point in the middle of the scene [m] and where the image shows it [px]
    rows : (2, 3), derivative of the image point there [px/m]
    sight : (3,), unit vector to the sensor there
    far : float, distance of the sensor [m]
    """
    starts = [_start(sign, at, pixel, rows, sight, times * far) for times in _DISTANCE_FACTORS for sign in (1.0, -1.0)]
    found = [_least_squares_pinhole(start, samples) for start in starts]
    return min(found, key=lambda pinhole: samples.error(pinhole.project(samples.world)))


def _start(sign: float, at: Array, pixel: Array, rows: Array, sight: Array, far: float) -> Pinhole:
    """Return the pinhole of a derivative: axes that are not perpendicular are seen far from the principal point."""
    length = np.linalg.norm(rows, axis=1)
    axes = rows / length[:, None]
    mirrored = 1.0 if np.cross(axes[0], axes[1]) @ sight < 0 else -1.0
    axes[1] *= mirrored
    skew = float(axes[0] @ axes[1])
    a = sign * np.sqrt(abs(skew) / (1.0 - abs(skew)))
    ray = np.array([a, np.copysign(a, a * skew) if skew else 0.0, 1.0])  # to the point, in the camera
    size = np.linalg.norm(ray)
    tilted = np.array([[1.0, 0.0, -ray[0]], [0.0, 1.0, -ray[1]], ray / size])
    long = np.linalg.norm(tilted[:2], axis=1)
    left, _, right = np.linalg.svd(np.linalg.solve(tilted, np.vstack([axes * long[:, None], -sight])))
    rotation, depth = left @ right, far / size
    focal = length * depth / long * [1.0, mirrored]
    return Pinhole(focal, pixel - focal * ray[:2], rotation, -rotation @ (at + far * sight))


def _least_squares_pinhole(start: Pinhole, samples: Sampled) -> Pinhole:
    """Return the least squares solution: Levenberg-Marquardt on turn, move, logarithms of focal lengths, centre."""
    from scipy.optimize import least_squares  # a tenth of a second, of pinholes alone

    def left(step: Array) -> Array:
        return (_stepped(start, step).project(samples.world) - samples.image).ravel()

    def slope(step: Array) -> Array:
        jacobian = _jacobian(_stepped(start, step), samples.world)
        jacobian[:, :3] = jacobian[:, :3] @ rotation_left_jacobian(step[:3])
        return jacobian

    found = least_squares(left, np.zeros(10), slope, method="lm", x_scale="jac", ftol=1e-12, xtol=1e-12, gtol=1e-12)
    return _stepped(start, found.x)


def _jacobian(pinhole: Pinhole, world: Array) -> Array:
    """Return the derivative (2 N, 10) of the projections by a further small turn and the other unknowns."""
    turned = world @ pinhole.rotation.T
    x, y, depth = (turned + pinhole.translation).T
    out = np.zeros((len(world), 2, 10))
    for axis, over in enumerate((x, y)):
        by_point = np.zeros((len(world), 3))
        by_point[:, axis], by_point[:, 2] = 1.0 / depth, -over / depth**2
        by_point *= pinhole.focal[axis]
        out[:, axis, :3] = np.cross(turned, by_point)  # of a small turn w: w x (R X)
        out[:, axis, 3:6] = by_point
        out[:, axis, 6 + axis] = over / depth * pinhole.focal[axis]
        out[:, axis, 8 + axis] = 1.0
    return out.reshape(-1, 10)


def _stepped(pinhole: Pinhole, step: Array) -> Pinhole:
    turn = rotation_matrix(step[:3])
    return Pinhole(
        pinhole.focal * np.exp(step[6:8]),
        pinhole.center + step[8:],
        turn @ pinhole.rotation,
        pinhole.translation + step[3:6],
    )


# --- the model ----------------------------------------------------------------------------------------------


def pinhole_of(scene: Scene, shot: Shot) -> tuple[Pinhole, float]:
    """Return the nearest pinhole of a shot, and its largest error over the scene [px]."""
    pinhole = fit_pinhole(scene.samples(shot), **scene.view_of(shot))
    checked = scene.samples(shot, checked=True)
    error = checked.error(pinhole.project(checked.world))
    if not (np.isfinite(error) and (pinhole.focal > 0).all()):
        raise InputError(f"{shot.name}: shows the ground mirrored, or no pinhole camera comes near its RPC")
    return pinhole, error


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
        cameras.append(_text_line(number, "PINHOLE", *numbers))
        turn = Rotation.from_matrix(pinhole.rotation).as_quat(canonical=True, scalar_first=True).tolist()
        images.append(_text_line(number, *turn, *pinhole.translation.tolist(), number, name))
        places = zip((shot.xy + _CORNER).tolist(), (shot.index + 1).tolist(), strict=True)
        images.append(" ".join(_text_line(*xy, point) for xy, point in places))
        miss = np.linalg.norm(pinhole.project(world[shot.index]) - shot.xy, axis=1)
        for place, (point, error) in enumerate(zip(shot.index.tolist(), miss.tolist(), strict=True)):
            seen.setdefault(point, []).append((number, place, error))
    points = []
    for point in sorted(seen):
        track = [value for image, place, _ in seen[point] for value in (image, place)]
        mean = float(np.mean([error for *_, error in seen[point]]))
        points.append(_text_line(point + 1, *world[point].tolist(), 128, 128, 128, mean, *track))
    about = {"world_to_ecef": scene.world_to_ecef, "alt_range": scene.alt_range, "pinhole_error_px": errors}
    named = zip(scene.shots, _called(scene), strict=True)
    about["images"] = {name: relative_link(shot.file, out) for shot, name in named}
    texts = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}
    return {f"sparse/0/{name}": ("\n".join(lines) + "\n").encode() for name, lines in texts.items()} | {
        "world.json": as_json(about)
    }


def _called(scene: Scene) -> list[str]:
    """Return the names of the images in the model: of their files where these differ, else of the run."""
    names = [PurePath(shot.file).name for shot in scene.shots]
    if len(set(names)) == len(names):
        return names
    return [shot.name + PurePath(shot.file).suffix for shot in scene.shots]


def image_links(scene: Scene) -> dict[str, str]:
    """Return the links in the folder of a COLMAP model and the local images that they point at: nothing is copied."""
    rows = zip(scene.shots, _called(scene), strict=True)
    return {f"images/{name}": shot.file for shot, name in rows if not is_url(shot.file)}


def _text_line(*values: float | str) -> str:
    return " ".join(value if isinstance(value, str) else repr(value) for value in values)
