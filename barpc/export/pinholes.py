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

_DISTANCE_FACTORS = None, 1.0, 2.0, 3.0  # any; an image that is affine along its flight is best seen from farther away
_PINHOLE_STEPS = 100  # at most
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


def fit_pinhole(samples: Sampled, sight: Array, far: float | None = None) -> Pinhole:
    """Return the pinhole camera without skew that shows the points nearest to their image points, in least squares.

    A camera (a.X + a4, b.X + b4) / (c.X + 1) has no skew where (a x c).(b x c) = 0. From the direct linear
    transformation (Abdel-Aziz and Karara 1971), Gauss-Newton steps that hold this constraint in its linear form
    (sequential quadratic programming: Nocedal and Wright 2006, 18.1) end after some ten: the image points are nearly
    linear in the eleven unknowns.

    Parameters
    ----------
    sight : (3,), unit vector to the sensor
    far : float, optional, the distance along it that the camera shall have [m]; else the best one, which may be
        behind the ground, as an image says little of its distance
    """
    span, middle = np.abs(samples.world).max(), samples.image.mean(axis=0)
    world, image = samples.world / span, samples.image - middle
    unknowns = np.linalg.lstsq(_derivative(world, image, np.ones(len(world))), image.ravel(), rcond=None)[0]
    for _ in range(_PINHOLE_STEPS):
        depth = world @ unknowns[8:] + 1.0
        seen = (world @ unknowns[:8].reshape(2, 4)[:, :3].T + unknowns[[3, 7]]) / depth[:, None]
        slope = _derivative(world, seen, depth)
        size = np.linalg.norm(slope, axis=0)
        skew, normal = _skew(unknowns)
        gaps, normals = np.array([skew]), normal[None]
        if far is not None:
            gaps = np.append(gaps, unknowns[8:] @ sight + span / far)
            normals = np.vstack([normals, np.append(np.zeros(8), sight)])
        normals /= size
        steep = np.linalg.norm(normals, axis=1)
        if not (np.isfinite(slope).all() and steep.all()):  # parallel rays, or points beside the camera
            break
        left, values, axes = np.linalg.svd(normals / steep[:, None])
        held, free = axes[: len(gaps)], axes[len(gaps) :]
        step = -(left.T @ (gaps / steep) / values) @ held
        missed = (image - seen).ravel() - slope @ (step / size)
        step += np.linalg.lstsq(slope / size @ free.T, missed, rcond=None)[0] @ free
        unknowns = unknowns + step / size
        if np.linalg.norm(step) < 1e-12 * np.linalg.norm(unknowns * size):
            break
    return _of_unknowns(unknowns, span, middle)


def _derivative(world: Array, seen: Array, depth: Array) -> Array:
    """Return the derivative (2 N, 11) of the image points `seen` by the unknowns a, a4, b, b4, c."""
    out = np.zeros((len(world), 2, 11))
    out[:, 0, :4] = out[:, 1, 4:8] = np.column_stack([world, np.ones(len(world))]) / depth[:, None]
    out[:, :, 8:] = -seen[:, :, None] * (world / depth[:, None])[:, None]
    return out.reshape(-1, 11)


def _skew(unknowns: Array) -> tuple[float, Array]:
    """Return (a x c).(b x c), which is zero without skew, and its derivative (11,)."""
    a, b, c = unknowns[:3], unknowns[4:7], unknowns[8:]
    normal = np.zeros(11)
    normal[:3], normal[4:7] = b * (c @ c) - c * (b @ c), a * (c @ c) - c * (a @ c)
    normal[8:] = 2.0 * (a @ b) * c - a * (b @ c) - b * (a @ c)
    return float((a @ b) * (c @ c) - (a @ c) * (b @ c)), normal


def _of_unknowns(unknowns: Array, span: float, middle: Array) -> Pinhole:
    """Return the camera of the unknowns, of places in `span` metres and image points from `middle`."""
    rows = unknowns[:8].reshape(2, 4)
    far = 1.0 / np.linalg.norm(unknowns[8:])
    forward = far * unknowns[8:]
    center = far * rows[:, :3] @ forward
    across = far * rows[:, :3] - np.outer(center, forward)
    right = across[0] / np.linalg.norm(across[0])
    rotation = np.array([right, np.cross(forward, right), forward])
    focal = (across * rotation[:2]).sum(axis=1)
    return Pinhole(focal, center + middle, rotation, np.append((rows[:, 3] - center) / focal, 1.0) * far * span)


# --- the model ----------------------------------------------------------------------------------------------


def pinhole_of(scene: Scene, shot: Shot) -> tuple[Pinhole, float]:
    """Return the nearest pinhole of a shot, and its largest error over the scene [px]."""
    samples, checked = scene.samples(shot), scene.samples(shot, checked=True)
    sight, far = scene.sight_of(shot)
    found = [fit_pinhole(samples, sight, times and times * far) for times in _DISTANCE_FACTORS]
    shown = [(checked.error(one.project(checked.world)), n) for n, one in enumerate(found) if (one.focal > 0).all()]
    error, best = min(shown, default=(np.inf, 0))
    if not np.isfinite(error):
        raise InputError(f"{shot.name}: shows the ground mirrored, or no pinhole camera comes near its RPC")
    return found[best], error


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
