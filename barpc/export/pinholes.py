"""Pinhole cameras nearest to RPCs: of whole images as they are, and central ones of pictures made of their parts.

A pinhole sees points in metres east, north, up of the scene's origin, and image points as barpc counts them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from barpc.base.errors import InputError
from barpc.base.geodesy import Array, Box
from barpc.export.shots import Scene, Shot
from barpc.sensor.sampler import Sample, image_grid

_DISTANCE_FACTORS = None, 1.0, 2.0, 3.0  # any; an image that is affine along its flight is best seen from farther away
_PINHOLE_STEPS = 100  # at most
_MAX_SIDE = 1600  # px a side of a picture: trainers reduce larger ones, and with them what they learn
_MIN_SIDE = 64  # px a side of a part: below, relief asks for thousands of pictures


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


def fit_camera(samples: Sample, sight: Array, far: float | None = None, skewed: bool = False) -> Array:
    """Return the projective camera (3, 4) that shows the points nearest to their image points, in least squares.

    A camera (a.X + a4, b.X + b4) / (c.X + 1) has no skew where (a x c).(b x c) = 0. From the direct linear
    transformation (Abdel-Aziz and Karara 1971), Gauss-Newton steps that hold this constraint in its linear form
    (sequential quadratic programming: Nocedal and Wright 2006, 18.1) end after some ten: the image points are nearly
    linear in the eleven unknowns.

    Parameters
    ----------
    sight : (3,), unit vector to the sensor
    far : float, optional, the distance along it that the camera shall have [m]; else the best one, which may be
        behind the ground, as an image says little of its distance
    skewed : bool, any skew will do
    """
    span, middle = np.abs(samples.ground).max(), samples.image.mean(axis=0)
    world, image = samples.ground / span, samples.image - middle
    unknowns = np.linalg.lstsq(_derivative(world, image, np.ones(len(world))), image.ravel(), rcond=None)[0]
    for _ in range(_PINHOLE_STEPS):
        depth = world @ unknowns[8:] + 1.0
        seen = (world @ unknowns[:8].reshape(2, 4)[:, :3].T + unknowns[[3, 7]]) / depth[:, None]
        slope = _derivative(world, seen, depth)
        size = np.linalg.norm(slope, axis=0)
        skew, normal = _skew(unknowns)
        gaps, normals = np.array([skew] * (not skewed)), np.array([normal] * (not skewed)).reshape(-1, 11)
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
    camera: Array = np.append(unknowns, 1.0).reshape(3, 4) / [span, span, span, 1.0]
    camera[:2] += np.outer(middle, camera[2])
    return camera


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


def pinhole_camera(camera: Array) -> Pinhole:
    """Return a projective camera (3, 4) without skew as a rotation, a translation and K."""
    far = 1.0 / np.linalg.norm(camera[2, :3])
    forward = far * camera[2, :3]
    center = far * camera[:2, :3] @ forward
    across = far * camera[:2, :3] - np.outer(center, forward)
    right = across[0] / np.linalg.norm(across[0])
    rotation = np.array([right, np.cross(forward, right), forward])
    focal = (across * rotation[:2]).sum(axis=1)
    away = far * camera[:, 3] / camera[2, 3]
    return Pinhole(focal, center, rotation, np.append((away[:2] - center * away[2]) / focal, away[2]))


def pinhole_of(scene: Scene, shot: Shot) -> tuple[Pinhole, float]:
    """Return the nearest pinhole of a shot, and its largest error over the scene [px]."""
    samples, checked = scene.samples(shot), scene.samples(shot, checked=True)
    sight, far = scene.sight_of(shot)
    found = [pinhole_camera(fit_camera(samples, sight, times and times * far)) for times in _DISTANCE_FACTORS]
    shown = [(checked.compare(one.project), n) for n, one in enumerate(found) if (one.focal > 0).all()]
    error, best = min(shown, default=(np.inf, 0))
    if not np.isfinite(error):
        raise InputError(f"{shot.name}: shows the ground mirrored, or no pinhole camera comes near its RPC")
    return found[best], error


# --- pictures -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Picture:
    """A part of an image, `window`, seen by a pinhole camera with square pixels and its principal point in the middle.

    `homography` (3, 3) takes points of the picture to the image, both counted from the corner of the first pixel;
    `error`: the largest distance [px] of a ground point in the picture from its projection by `pinhole`.
    """

    window: Box
    size: tuple[int, int]
    pinhole: Pinhole
    homography: Array
    error: float

    @property
    def inverse(self) -> Array:
        """The homography from the image to the picture."""
        return np.asarray(np.linalg.inv(self.homography))


def mapped(homography: Array, points: Array) -> Array:
    """Return points (N, 2) behind a homography (3, 3)."""
    found = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(found[:, :2] / found[:, 2:])


def pictures_of(scene: Scene, shot: Shot, tolerance: float) -> list[Picture]:
    """Return the fewest equal parts of a shot of which central pinholes miss nothing by more than a tolerance [px].

    Raises
    ------
    InputError
        They would be too small, or no pinhole camera comes near the RPC.
    """
    side, error = float(_MAX_SIDE), np.inf
    while side >= _MIN_SIDE:
        error, pictures = 0.0, list[Picture]()
        for window in _boxes(shot.size, side):
            pictures.append(central_picture(scene, shot, window))
            error = max(error, pictures[-1].error)
            if error > tolerance:
                break
        if error <= tolerance:
            return pictures
        side *= min(0.9, max(0.3, 0.95 * tolerance / error))  # the error is nearly linear in it
    raise InputError(
        f"{shot.name}: parts of {_MIN_SIDE} px are not within {tolerance:g} px of a central pinhole over altitudes "
        f"{scene.alt_range[0]:g} to {scene.alt_range[1]:g} m: a larger --tolerance, a narrower --alt"
    )


def _boxes(size: tuple[int, int], side: float) -> list[Box]:
    """Return the windows of equal parts of an image, at most `side` large, row by row."""
    ends = [np.linspace(0, n, int(np.ceil(n / side)) + 1).round().astype(int).tolist() for n in size]
    (lefts, tops) = ([(a, b - a) for a, b in pairwise(e)] for e in ends)
    return [(left, top, width, height) for top, height in tops for left, width in lefts]


def central_picture(scene: Scene, shot: Shot, window: Box) -> Picture:
    """Return the picture of a part of a shot.

    Cameras of one centre differ by a homography of their pictures: what counts is the centre, that of the projective
    camera nearest to the RPC. The picture keeps its axes and the size of its pixels as far as it can.
    """
    samples = scene.samples(shot, window)
    sight, far = scene.sight_of(shot)
    middle = np.array(window[:2]) + (np.array(window[2:]) - 1.0) / 2
    ground = shot.rpc.localize(middle, np.array(scene.origin[2]))
    pictures = []
    for times in _DISTANCE_FACTORS:
        camera = fit_camera(samples, sight, times and times * far, skewed=True)
        if np.isfinite(camera).all() and np.linalg.cond(camera[:, :3]) < 1e15:
            center = -np.linalg.solve(camera[:, :3], camera[:, 3])
            aim = scene.world(ground[None])[0] - center
            if aim @ sight < 0:  # above the ground
                pictures.append(_seen_from(scene, shot, window, camera, aim))
    if not pictures:
        raise InputError(f"{shot.name}: no pinhole camera comes near its RPC")
    return min(pictures, key=lambda one: one.error)


def _seen_from(scene: Scene, shot: Shot, window: Box, camera: Array, aim: Array) -> Picture:
    """Return the picture that a projective camera (3, 4) sees towards the ground, `aim` (3,) from its centre."""
    forward = aim / np.linalg.norm(aim)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    shape = camera[:, :3] @ rotation.T  # of directions, as this camera turns them, to the image
    where = shape[:2, 2] / shape[2, 2]
    spread = (shape[:2, :2] - np.outer(where, shape[2, :2])) / shape[2, 2]
    left, values, axes = np.linalg.svd(spread)
    if np.linalg.det(left @ axes) < 0:  # an image that shows the ground mirrored
        left[:, 1] *= -1
    turn = np.eye(3)
    turn[:2, :2] = left @ axes
    rotation, focal = turn @ rotation, float(np.sqrt(values.prod()))
    inner = np.diag([focal, focal, 1.0])
    to_image = camera[:, :3] @ rotation.T @ np.linalg.inv(inner)
    to_image /= to_image[2, 2]
    col, row, width, height = window
    corners = np.array([[col, row], [col + width, row], [col, row + height], [col + width, row + height]]) - 0.5
    half = np.abs(mapped(np.linalg.inv(to_image), corners)).max(axis=0)
    size = tuple(int(n) for n in np.ceil(2 * half - 1e-6))
    shift, corner = np.eye(3), np.eye(3)
    shift[:2, 2], corner[:2, 2] = -np.array(size) / 2, 0.5
    center = -np.linalg.solve(camera[:, :3], camera[:, 3])
    pinhole = Pinhole(np.full(2, focal), (np.array(size) - 1.0) / 2, rotation, -rotation @ center)
    homography = corner @ to_image @ shift
    return Picture(window, (size[0], size[1]), pinhole, homography, _max_error(scene, shot, size, pinhole, homography))


def _max_error(scene: Scene, shot: Shot, size: tuple[int, ...], pinhole: Pinhole, homography: Array) -> float:
    """Return the largest error [px] of a picture's pinhole over the pixels that the image has in it."""
    nodes, alt = image_grid((size[0] + 1, size[1] + 1), scene.alt_range, (21, 9))  # from border to border
    image = mapped(homography, nodes) - 0.5
    inside = ((image >= -0.5) & (image <= np.array(shot.size) - 0.5)).all(axis=1)
    ground = shot.rpc.localize(image[inside], alt[inside])
    seen = np.isfinite(ground).all(axis=1)
    return Sample(scene.world(ground[seen]), nodes[inside][seen] - 0.5).compare(pinhole.project)
