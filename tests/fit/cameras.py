"""Cameras that the fit is tried on: synthetic ones with every coefficient at work, and vendors' RPCs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barpc.base.errors import BarpcError
from barpc.base.geodesy import Array, ecef_from_ground
from barpc.fit import Normalization
from barpc.rasters.raster import open_raster
from barpc.rpcio import read_rpc
from barpc.sensor.centers import camera_center
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.rpc import RPC, altitude_range


@dataclass(frozen=True)
class Camera:
    """An RPC, P_BA made of it, and where it is used."""

    name: str
    rpc: RPC
    model: Corrected
    size: tuple[int, int]
    alt_range: tuple[float, float]

    @property
    def norm(self) -> Normalization:
        """The offsets and scales of the RPC."""
        rpc = self.rpc
        return Normalization(rpc.ground_offset, rpc.ground_scale, rpc.image_offset, rpc.image_scale)


def synthetic_rpc(lon: float = 5.4, lat: float = 43.2, seed: int = 3) -> RPC:
    """An RPC some 15 km wide with twenty distinct coefficients in each polynomial."""
    rng = np.random.default_rng(seed)
    coeffs = rng.normal(0, 5e-6, (4, 20))
    coeffs[0, :4] += [1e-3, 1.0, 0.02, -0.04]
    coeffs[2, :4] += [-2e-3, 0.03, -1.0, 0.025]
    coeffs[1::2, 1:4] += rng.normal(0, 1e-3, (2, 3))
    coeffs[1::2, 0] = 1.0
    return RPC(coeffs, [lon, lat, 500.0], [0.12, 0.09, 500.0], [10000.0, 9500.0], [10100.0, 9800.0])


def adjusted(rpc: RPC, center: Array, seed: int) -> Corrected:
    """P_BA: 30 microradians about a camera centre and 10 m, in directions that the seed draws."""
    rng = np.random.default_rng(seed)
    rotation, translation = rng.normal(size=(2, 3))
    rotation *= 30e-6 / np.linalg.norm(rotation)
    translation *= 10.0 / np.linalg.norm(translation)
    return Corrected(rpc, Correction(rotation, translation, center))


def synthetic(seed: int = 0, lon: float = 5.4) -> Camera:
    rpc = synthetic_rpc(lon)
    center = ecef_from_ground([lon + 2.0, 42.2, 7e5])
    return Camera("synthetic", rpc, adjusted(rpc, center, seed), (20000, 19000), (0.0, 1000.0))


def vendor(shared_data: Path) -> list[Camera]:
    """Every optical RPC file that is read, over its full image and altitude range."""
    files = [p for folder in ("optical", "rpc_formats", "physical") for p in (shared_data / folder).rglob("*")]
    cameras = []
    for path in sorted(files):
        try:
            rpc = read_rpc(path)
        except BarpcError:
            continue
        try:
            with open_raster(path) as dataset:
                size = (dataset.width, dataset.height)
        except BarpcError:
            size = tuple(int(n) for n in np.ceil(rpc.image_offset + rpc.image_scale))
        alt_range = altitude_range(rpc)
        center = camera_center(rpc, size, alt_range).ecef
        name = f"{path.parent.name}/{path.name}"
        seed = 1000 * len(cameras)
        while _moved(rpc, size, adjusted(rpc, center, seed)) < 2.0:  # a rotation about the view is no test
            seed += 1
        cameras.append(Camera(name, rpc, adjusted(rpc, center, seed), size, alt_range))
    return cameras


def _moved(rpc: RPC, size: tuple[int, int], model: Corrected) -> float:
    """How far [px] the middle of the image is from where the RPC alone puts it."""
    middle = np.array(size) / 2.0
    ground = model.localize(middle, rpc.ground_offset[2])
    return float(np.abs(rpc.project(ground) - middle).max())


def random_points(camera: Camera, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Ground points (N, 3) and their exact image points (N, 2), at random over image and altitudes."""
    image = rng.uniform(0, 1, (3 * count, 2)) * camera.size - 0.5
    ground = camera.model.localize(image, rng.uniform(*camera.alt_range, len(image)))
    ok = np.flatnonzero(np.isfinite(ground).all(axis=1))[:count]
    return ground[ok], image[ok]
