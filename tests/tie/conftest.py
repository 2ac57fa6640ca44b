"""Real and rendered images for the tests of the tie points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from barpc.rasters.raster import open_raster
from barpc.rpcio import read_rpc
from barpc.scene import Tracks, View
from barpc.sensor.rpc import RPC, altitude_range
from barpc.tie import TieResult, find_tracks
from barpc.tie.matchers.pair_search import MATCHERS
from tests.geotiffs import write_image
from tests.scenes import ImageOptions, Scene
from tests.tie.stages import common_tracks

SIDES = [300, pytest.param(600, marks=pytest.mark.nightly)]
"""Rows and columns of a rendered scene: a quarter of the ground, all of it at night."""


def view_of(path: Path, rpc: RPC) -> View:
    with open_raster(path) as dataset:
        size = (dataset.width, dataset.height)
    return View(path.stem, str(path), size, rpc, altitude_range(rpc))


def altered(view: View, folder: Path, change: Callable[[Any], np.ndarray], **profile: object) -> View:
    """The view with other pixels, which `change` makes of its own."""
    with open_raster(view.path) as dataset:
        pixels = change(dataset.read(1))
    path = write_image(folder / f"{view.name}.tif", pixels, **profile)
    return replace(view, path=str(path), size=pixels.shape[:-3:-1])


def checks(shared_data: Path, pair: str) -> tuple[np.ndarray, np.ndarray]:
    """Independent places in both images (N, 2) [px]: correlation, no camera (`shared/data/README.md`)."""
    table = np.genfromtxt(shared_data / f"truth/ties/{pair}__ncc_check.csv", delimiter=",", names=True)
    return tuple(np.column_stack([table[f"col_{end}"], table[f"row_{end}"]]) for end in "ab")  # type: ignore[return-value]


@pytest.fixture(scope="session")
def triplet(shared_data: Path) -> list[View]:
    folder = shared_data / "optical/phr_triplet_north"
    return [view_of(path, read_rpc(path)) for path in sorted(folder.glob("*.tif"))]


@pytest.fixture(scope="session")
def ventoux(shared_data: Path) -> list[View]:
    folder = shared_data / "optical/phr_ventoux"
    views = []
    for name in ("left_image", "right_image"):
        with open_raster(folder / f"{name}.tif") as dataset:
            corner = dataset.transform.c, dataset.transform.f
        views.append(view_of(folder / f"{name}.tif", read_rpc(folder / f"{name}.geom").crop(*corner)))
    return views


@pytest.fixture(scope="session")
def triplet_ties(triplet: list[View]) -> TieResult:
    return find_tracks(triplet)


@pytest.fixture(scope="session")
def ventoux_ties(ventoux: list[View]) -> TieResult:
    return find_tracks(ventoux)


class Rendered:
    """A rendered scene on disk, and the true place of its tie points."""

    def __init__(self, folder: Path, options: ImageOptions) -> None:
        self.scene = Scene(options)
        self.views, self.altitude = [], []
        for index, shot in enumerate(self.scene.shots):
            picture = self.scene.picture(index)
            path = write_image(folder / f"{shot.name}.tif", picture.numbers)
            self.views.append(View(shot.name, str(path), options.size, shot.delivered, self.scene.alt_range))
            altitude = picture.altitude.astype(np.float64)
            filled = np.where(np.isfinite(altitude), altitude, 1e6)
            step = ndimage.maximum_filter(filled, 3) - ndimage.minimum_filter(filled, 3) > 3.0
            self.altitude.append(np.where(step, np.nan, altitude))

    @cached_property
    def tied(self) -> TieResult:
        """Its tie points as anybody finds them."""
        return find_tracks(self.views)

    def errors(self, first: int, second: int, xy_first: np.ndarray, xy_second: np.ndarray) -> np.ndarray:
        """True place in the second view minus the measured one (M, 2) [px], where the truth is known."""
        errors = self.place(first, second, xy_first) - xy_second
        return errors[np.isfinite(errors).all(axis=1)]

    def errors_of(self, tracks: Tracks, first: int = 0, second: int = 1) -> np.ndarray:
        """Such errors of the tie points of two views."""
        return self.errors(first, second, *common_tracks(tracks, first, second))

    def typical(self, tracks: Tracks, first: int = 0, second: int = 1) -> np.ndarray:
        """Robust standard deviation (2,) of their true error [px]."""
        return 1.4826 * np.median(np.abs(self.errors_of(tracks, first, second)), axis=0)

    def place(self, first: int, second: int, xy_first: np.ndarray) -> np.ndarray:
        """True place in the second view (M, 2) [px]; NaN where it is not known.

        Beside a step of the ground (one pixel) it is not: what is seen may be the one side or the other.
        """
        corner = np.minimum(np.floor(xy_first).astype(int), np.subtract(self.scene.options.size, 2))
        x, y = (xy_first - corner).T
        alt, (col, row) = self.altitude[first], corner.T
        upper = alt[row, col] * (1 - x) + alt[row, col + 1] * x
        lower = alt[row + 1, col] * (1 - x) + alt[row + 1, col + 1] * x
        ground = self.scene.shots[first].exact.localize(xy_first, upper * (1 - y) + lower * y)
        return self.scene.shots[second].exact.project(ground)


@pytest.fixture(scope="session")
def render(tmp_path_factory) -> Callable[..., Rendered]:
    """Render a scene: `render(views=2, clouds=0.5)`; the same options are rendered once."""
    made: dict[tuple[tuple[str, object], ...], Rendered] = {}

    def make(**options: object) -> Rendered:
        key = tuple(sorted(options.items()))
        if key not in made:
            chosen = ImageOptions(**{"size": (600, 600), "seed": 1, **options})  # type: ignore[arg-type]
            made[key] = Rendered(tmp_path_factory.mktemp("rendered"), chosen)
        return made[key]

    return make


@pytest.fixture(scope="session")
def scene(render) -> Rendered:
    """Two views of a little ground."""
    return render(views=2, size=(300, 300))


@pytest.fixture(scope="session")
def three(render) -> Rendered:
    """Three of them."""
    return render(views=3, size=(300, 300))


@pytest.fixture
def in_table(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], str]:
    """`in_table(Matcher)`: the name of a matcher that stands beside barpc's own as long as a test runs."""

    def put(matcher: Any) -> str:
        monkeypatch.setitem(MATCHERS, "another", matcher)
        return "another"

    return put
