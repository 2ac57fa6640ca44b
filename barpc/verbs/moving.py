"""A motion of the ground brought back into cameras; and cameras refitted into RPCs."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from barpc.base.errors import BarpcWarning, FitError, InputError, Remark
from barpc.base.geodesy import Array, as_points, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.fit import FitOptions, RpcFit, fit_rpc
from barpc.pointio.motions import read_transform
from barpc.scene import Camera
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected, Correction, correction_of
from barpc.sensor.geometry import image_border
from barpc.sensor.rpc import RPC

_DEEPEST, _HIGHEST = -12e3, 10e3
"""Altitudes between which all ground on Earth lies [m], that of the sea's bottom, too."""
_NOTEWORTHY_ROUNDING = 0.01  # m: rounding of a matrix that is told
_EXACT_REFIT = 1e-5  # px, a thousandth of the tolerance: over all that an RPC states; else its image goes first
_MOVED_NOTE = "moved and refitted"


def moved(cameras: Sequence[Camera], move: npt.ArrayLike | None, transform: str | Path | None) -> list[Camera]:
    """Return cameras that show the moved ground where these show it unmoved, each refitted into an RPC and certified.

    The motion is `move` (3,) [m], east, north and up at the middle of all the images, or that of the file
    `transform`: it takes the points that these cameras make to their true place. One motion for all cameras: rays that
    met still meet, where the motion takes the point. FitError where no RPC holds a moved camera, InputError for a
    motion that leaves the Earth's surface or is a position.
    """
    corners = [_border_ground(camera) for camera in cameras]
    middle = np.mean([ecef_from_ground(ground).mean(axis=0) for ground in corners], axis=0)
    at = ground_from_ecef(middle)
    if transform is not None:
        matrix = read_transform(transform)
    else:
        metres = as_points(() if move is None else move, 3, "a motion", "metres east, north, up")
        _check_position(metres, np.concatenate(corners))
        matrix = np.column_stack([np.eye(3), enu_basis(at).T @ metres])
    out = []
    for camera, ground in zip(cameras, corners, strict=True):
        there = ground_from_ecef(ecef_from_ground(ground) @ matrix[:, :3].T + matrix[:, 3])
        low, high = float(there[:, 2].min()), float(there[:, 2].max())
        if not _DEEPEST < (low + high) / 2 < _HIGHEST:  # an RPC may state more altitudes than there is ground
            what = "a matrix of other coordinates than ECEF?" if transform else "give metres"
            file, ends = transform or "--move", f"{low:.0f} to {high:.0f} m"
            raise InputError(f"{file}: takes the ground of {camera.path} to altitudes of {ends}: {what}")
        out.append(_refitted(camera, correction_of(matrix, middle), (low, high), FitOptions()))
    _tell_motion(matrix, middle)
    return out


def _border_ground(camera: Camera) -> Array:
    """Return ground (n, 3) along the border of a camera's image, at its lowest and highest altitude."""
    edge = image_border(camera.extent, 4)
    levels = (np.full(len(edge), alt) for alt in camera.alt_range)
    ground = np.concatenate([camera.model.localize(edge, level) for level in levels])
    found: Array = ground[np.isfinite(ground).all(axis=1)]
    if not len(found):
        raise InputError(f"{camera.path}: shows no ground along the border of its image")
    return found


def _check_position(move: Array, ground: Array) -> None:
    """Refuse metres east and north that are the longitude and latitude of a place in the images."""
    low, high = ground[:, :2].min(axis=0), ground[:, :2].max(axis=0)
    for place in (move[:2], move[1::-1]):
        if ((low <= place) & (place <= high)).all():
            raise InputError(
                f"--move {','.join(f'{value:g}' for value in move)}: is a longitude and latitude in the images; metres "
                "east, north and up are needed"
            )


def _refitted(camera: Camera, correction: Correction, alt_range: tuple[float, float], options: FitOptions) -> Camera:
    """Return a camera behind a correction, refitted; an RPC over all that it states, where one holds that exactly.

    The image may be a crop of what the RPC is made for: fitted over the crop alone it is no camera of the rest.
    """
    if isinstance(camera.model, RPC):
        low, high = _domain(camera.model, camera.extent)
        moving = Corrected(camera.model.crop(*low), correction)
        with suppress(FitError):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", BarpcWarning)  # of what lies beyond the image
                size, ridge = (high[0] - low[0], high[1] - low[1]), replace(options, method="ridge")
                fit = fit_rpc(moving, size, alt_range, options=ridge, strict=False)
            if fit.max_ckp.max() <= _EXACT_REFIT and not fit.verdict(options.tolerance):
                back = replace(camera, model=fit.rpc.crop(-low[0], -low[1]), alt_range=alt_range)
                return _announced(back, fit, _MOVED_NOTE)
    return refitted(camera, Corrected(camera.model, correction), alt_range, options, _MOVED_NOTE)


def _domain(rpc: RPC, size: tuple[int, int]) -> tuple[list[int], list[int]]:
    """Return the first and last pixel [px] of all the ground that an RPC states, and of an image of `size`."""
    nodes = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    image = rpc.project(rpc.ground_offset + nodes * rpc.ground_scale)
    known = np.vstack([image[np.isfinite(image).all(axis=1)], [[0.0, 0.0], size]])
    return np.floor(known.min(axis=0)).astype(int).tolist(), np.ceil(known.max(axis=0)).astype(int).tolist()


def refitted(
    camera: Camera, model: SensorModel, alt_range: tuple[float, float], options: FitOptions, done: str
) -> Camera:
    """Return a camera with the RPC of a model, and say how near it comes; FitError where none holds it."""
    fit = fit_rpc(model, camera.extent, alt_range, options=options, strict=False)
    if wrong := fit.verdict(options.tolerance):
        raise FitError(f"{camera.path}: {wrong} ('barpc fit --keep-going' writes it all the same)")
    return _announced(replace(camera, model=fit.rpc, alt_range=alt_range), fit, done)


def _announced(camera: Camera, fit: RpcFit, done: str) -> Camera:
    warnings.warn(f"{camera.path}: {done} to {float(fit.max_ckp.max()):.1g} px", Remark, stacklevel=3)
    return camera


def _tell_motion(matrix: Array, middle: Array) -> None:
    """Print the motion at the image centres, and the effect of the digits of its matrix there."""
    at, stretch = ground_from_ecef(middle), np.linalg.svd(matrix[:, :3], compute_uv=False)
    rounding = float((stretch[0] - stretch[-1]) / stretch.mean() * np.linalg.norm(middle))
    if rounding > _NOTEWORTHY_ROUNDING:
        warnings.warn(
            f"the matrix is written with few digits: it determines the ground to some {rounding:.2g} m only",
            Remark,
            stacklevel=3,
        )
    east, north, up = enu_basis(at) @ (matrix @ np.append(middle, 1.0) - middle)
    scale, place = float(stretch.mean()), f"lon {at[0]:.7f}, lat {at[1]:.7f}"
    turn = float(np.arccos(np.clip((np.trace(matrix[:, :3]) / scale - 1.0) / 2.0, -1.0, 1.0)))
    more = f", turned by {1e6 * turn:.3g} urad, scaled by {scale:.9g}"
    more *= bool((matrix[:, :3] != np.eye(3)).any())
    motion = f"the ground moves by {east:+.3f} m east, {north:+.3f} m north, {up:+.3f} m up at its middle"
    warnings.warn(f"{motion}, {place}{more}", Remark, stacklevel=3)
