"""Whether an RPC can be the camera of the image that it is given for: asked before any pixel is matched.

An RPC names the ground and, where its image begins at (0, 0), the size of the picture that it was made for; a
geotransform places the same pixels on a map. None of these needs pixels or another image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from rasterio.crs import CRS
from rasterio.errors import RasterioError
from rasterio.warp import transform as warp_points

from barpc.base.geodesy import Array, ecef_from_ground, wrap_longitude
from barpc.scene import Doubt
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC

BEYOND, FAR_BEYOND = 1.5, 4.0
"""Half widths of the ground that an RPC is made for, from its middle to a corner of its image: right images have 0.99
at most (23 public ones), those shifted by half a side 1.5 to 2.0, with RPCs of products 2, 3 and 4 times coarser 2.6,
4.2 and 5.9 at least."""
_ANOTHER_SIZE = 0.02  # of a side: vendors' scales are half the sides to a pixel, or padded by more
_MAP_SHAPE = 0.005, 0.05  # of the longer side: a map on its axes is exact, a turned geotransform fitted to corners
_MAP_SHIFT = 0.1, 0.5  # of the longer side: by the pointing that somebody corrected in one of both
_LEAST_SHAPE = 4.0  # px
_OFF_CORNERS = 30.0  # m: seven public SPOT scenes 2.7 at most; corners rounded to seconds are 22 off
_TRIED_ALTITUDES = 33  # altitudes of the RPC at which its image may lie on the map


@dataclass(frozen=True)
class RasterFrame:
    """A raster's width and height [px], and where its geotransform places its pixels (counted from their corners)."""

    size: tuple[int, int]
    transform: Any
    crs: Any


def doubts_of(rpc: RPC, size: tuple[int, int], frame: RasterFrame | None = None) -> tuple[Doubt, ...]:
    """Return the reasons why an RPC is not that of an image of a size [px], and of a geotransform, if it has one."""
    found = (_another_map(rpc, size, frame), _another_ground(rpc, size), _another_size(rpc, size))
    return tuple(sorted((one for one in found if one is not None), key=lambda one: not one.refused))


def corners_off(model: SensorModel, corners: Array) -> tuple[str, tuple[Doubt, ...]]:
    """Return the distance of a camera from its producer's corners (N, 4), `Linescan.corners`, in words, and doubts."""
    stated = np.column_stack([corners[:, :2], np.zeros(len(corners))])
    ground = ecef_from_ground(model.localize(corners[:, 2:], np.zeros(len(corners))))
    off = float(np.linalg.norm(ground - ecef_from_ground(stated), axis=1).max())
    said = f"the corners that its producer states are met within {off:.1f} m"
    doubtful = not off <= _OFF_CORNERS
    return said, (Doubt(f"the corners that its producer states lie {off:.0f} m from the camera's"),) * doubtful


def reach_of_corners(rpc: RPC, size: tuple[int, int]) -> float:
    """Return how far the corners of an image lie from the middle of its RPC's ground, in half widths of that ground.

    At the middle of the RPC's altitudes; NaN where a corner has no ground there.
    """
    return float(np.abs((_corners_on_ground(rpc, size) - rpc.ground_offset)[:, :2] / rpc.ground_scale[:2]).max())


def made_for(rpc: RPC) -> tuple[float, float] | None:
    """Return the width and height [px] of the picture that an RPC was made for; None where it does not tell.

    It does where its image begins at (0, 0), so that the scales are half the sides: not of a crop.
    """
    begins = np.abs(rpc.image_offset / rpc.image_scale - 1.0) < _ANOTHER_SIZE
    width, height = (2.0 * rpc.image_scale).tolist()
    return (width, height) if begins.all() else None


def _pixel_corners(size: tuple[int, int]) -> Array:
    return np.array([(col, row) for col in (0.0, size[0] - 1.0) for row in (0.0, size[1] - 1.0)])


def _corners_on_ground(rpc: RPC, size: tuple[int, int]) -> Array:
    ground = rpc.localize(_pixel_corners(size), np.full(4, rpc.ground_offset[2]))
    ground[:, 0] = wrap_longitude(ground[:, 0], rpc.ground_offset[0])
    return ground


def _another_size(rpc: RPC, size: tuple[int, int]) -> Doubt | None:
    made = made_for(rpc)
    if made is None or max(abs(one / side - 1.0) for one, side in zip(made, size, strict=True)) <= _ANOTHER_SIZE:
        return None
    wide, high = (one / side for one, side in zip(made, size, strict=True))
    how = "cropped after its RPC was made, and the RPC not moved with it"
    if abs(wide / high - 1.0) < _ANOTHER_SIZE:
        times = max(wide, 1.0 / wide)
        smaller, finer = ("reduced or cropped", "finer") if wide > 1.0 else ("enlarged", "coarser")
        how = f"{smaller} after its RPC was made, or the RPC is of a product {times:.3g} times {finer}"
    return Doubt(f"it is {size[0]} x {size[1]} px, and its RPC was made for {made[0]:.0f} x {made[1]:.0f} px: {how}")


def _another_ground(rpc: RPC, size: tuple[int, int]) -> Doubt | None:
    found = reach_of_corners(rpc, size)
    if not found > BEYOND:
        return None
    return Doubt(
        f"its corners lie outside of the ground that its RPC was made for, {found:.1f} half widths from the middle: it "
        "may be the RPC of another image, of a coarser product, or of other pixels of this one",
        refused=found > FAR_BEYOND,
    )


def _another_map(rpc: RPC, size: tuple[int, int], frame: RasterFrame | None) -> Doubt | None:
    """Return the doubt where no altitude brings the RPC to the pixels that a geotransform places on the ground.

    An image resampled to a map at one altitude (ortho-ready) agrees with its RPC at that altitude; one resampled on
    terrain agrees with no RPC of a camera.
    """
    if frame is None or frame.crs is None:
        return None
    corners, side = _pixel_corners(size), float(max(size))
    a, b, c, d, e, f = frame.transform[:6]
    col, row = corners.T + 0.5
    try:
        lon, lat = warp_points(frame.crs, CRS.from_epsg(4326), a * col + b * row + c, d * col + e * row + f)
    except RasterioError:
        return None  # a reference system of no place on Earth
    levels = rpc.ground_offset[2] + np.linspace(-1.0, 1.0, _TRIED_ALTITUDES) * rpc.ground_scale[2]
    ground = np.stack(np.broadcast_arrays(np.array(lon), np.array(lat), levels[:, None]), axis=-1)
    off = rpc.project(ground) - corners
    shift = off.mean(axis=1, keepdims=True)
    shape = np.abs(off - shift).max(axis=(1, 2))
    best = int(np.argmin(np.where(np.isfinite(shape), shape + 1e-3 * np.abs(shift).max(axis=(1, 2)), np.inf)))
    on_axes = b == d == 0.0
    most, far = (limits[0 if on_axes else 1] * side for limits in (_MAP_SHAPE, _MAP_SHIFT))
    if shape[best] <= max(most, _LEAST_SHAPE) and np.abs(shift[best]).max() <= far:
        return None
    px = np.abs(off[best]).max()
    apart = f"{px:.0f} px apart" if px < 1e6 else "on different ground"
    kept = "an orthoimage with the RPC of the image it was made of" if on_axes else "one of both is another image's"
    return Doubt(f"its geotransform and its RPC place its corners {apart} at any altitude of the RPC: {kept}")
