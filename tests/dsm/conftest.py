"""A rendered scene whose ground is known, as images with exact or delivered cameras."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.dsm.stereo import Tile, gathered
from tests.scenes import ImageOptions, Scene
from tests.scenes.files import _write_image

SMALL = ImageOptions(views=3, size=(360, 320), seed=5, buildings=4.0, relief=30.0)
ALTS = SMALL.alt - 25.0, SMALL.alt + 55.0


@dataclass(frozen=True)
class Rendered:
    """Images in a folder, and the surface that they show."""

    scene: Scene
    folder: Path

    def write(self) -> Rendered:
        for shot, picture in zip(self.scene.shots, self.pictures, strict=True):
            _write_image(self.folder / f"{shot.name}.tif", picture.numbers, shot.exact_rpc)
        return self

    @cached_property
    def pictures(self):
        return [self.scene.picture(i) for i in range(len(self.scene.shots))]

    @property
    def paths(self) -> list[str]:
        return [str(self.folder / f"{shot.name}.tif") for shot in self.scene.shots]

    @property
    def alts(self) -> tuple[float, float]:
        """Altitudes [m] of what the images show, and 10 m around them."""
        shown = np.concatenate([one.altitude.ravel() for one in self.pictures])
        return float(np.nanmin(shown)) - 10.0, float(np.nanmax(shown)) + 10.0

    def missed(self, path: Path) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the heights of a file, NaN where there is none, and their sigma [m]."""
        with rasterio.open(path) as file:
            return file.read(1) - self.truth(path), file.read(4)

    def truth(self, path: Path) -> np.ndarray:
        """Median altitude of what the images show in each cell of a file; through the exact pushbroom cameras."""
        with rasterio.open(path) as file:
            place = file.transform
            tile = Tile(file.crs.to_wkt(), place.c, place.f, place.a, (file.width, file.height), (0.0, 1.0))
        return self.truth_in(tile)

    def truth_in(self, tile: Tile) -> np.ndarray:
        """The same in each cell of a tile."""
        ground = []
        for shot, picture in zip(self.scene.shots, self.pictures, strict=True):
            row, col = np.nonzero(np.isfinite(picture.altitude))
            at = np.column_stack([col, row]).astype(np.float64)
            ground.append(shot.exact.localize(at, picture.altitude[row, col].astype(np.float64)))
        every = np.concatenate(ground)
        return gathered(tile, tile.on_map(every), np.ones(len(every)))[0]


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Rendered:
    return Rendered(Scene(SMALL), tmp_path_factory.mktemp("rendered")).write()
