"""Cells of a map and where ground points lie among them, against pyproj; what all cells share."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pyproj import CRS, Transformer

from barpc.base.verb_options import DsmOptions
from barpc.dsm import stereo
from barpc.dsm.stereo import TILE_NODES, CameraErrors, NoSurfaceError, Tile, gathered
from barpc.dsm.surface import Grid
from tests.tie.test_pairs import camera, views


@pytest.mark.parametrize(("code", "west"), [(32631, 450_000.0), (32760, 810_000.0)])
def test_places_among_cells_are_those_of_the_map(code: int, west: float) -> None:
    """To a hundredth of a millimetre from a cell's edges; beyond the antimeridian, too, whichever way longitudes
    turn.
    """
    tile = Tile(CRS.from_epsg(code).to_wkt(), west, 4_900_000.0, 2.0, (500, 400), (0.0, 1.0))
    rng = np.random.default_rng(0)
    to_lonlat = Transformer.from_crs(code, 4326, always_xy=True)
    picked = rng.integers(0, [500, 400], (50, 2))
    for inside in (np.full((50, 2), 5e-6), np.full((50, 2), 1.0 - 5e-6), rng.uniform(0.0, 1.0, (50, 2))):
        at = picked + inside
        lon, lat = to_lonlat.transform(west + 2.0 * at[:, 0], 4_900_000.0 - 2.0 * at[:, 1])
        for turn in (0.0, 360.0, -360.0):
            points = tile.on_map(np.column_stack([lon + turn, lat, np.full(50, 7.0)]))
            found = gathered(tile, points, np.ones(50))
            assert set(map(tuple, np.argwhere(found[0] == 7.0)[:, ::-1])) == set(map(tuple, picked))
            assert np.isfinite(found[1]).sum() == len(set(map(tuple, picked)))
    x, y = west + 2.0 * (np.arange(500) + 0.5), 4_900_000.0 - 2.0 * (np.arange(400) + 0.5)
    middles = np.column_stack(to_lonlat.transform(*(part.ravel() for part in np.meshgrid(x, y))))
    apart = tile.nodes(tile.size, 0.5) - middles
    np.testing.assert_allclose((apart + 180.0) % 360.0 - 180.0, 0.0, atol=1e-9)


@pytest.mark.parametrize("count", [2, 9])
def test_what_all_cells_share_is_a_mean_over_all_tiles(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the pairs of each tile, and of a difference less that of the other date's."""
    by_pair = {(0, 1): 1.0, (0, 2): 4.0, (3, 4): 7.0}

    def derivatives(cameras: Any, params: Any, pair: tuple[int, int], points: np.ndarray) -> Any:
        """Of either view half of what its pair has; and so of the place."""
        rows = np.column_stack([np.full(len(points), by_pair[pair]), points[:, 0]])
        return np.stack([rows / 2, rows / 2], axis=1), None, None

    monkeypatch.setattr(stereo, "height_derivatives", derivatives)
    monkeypatch.setattr(stereo, "ecef_from_ground", np.asarray)
    cameras: Any = SimpleNamespace(sensors=range(5), unknowns=SimpleNamespace(size=2))
    tiles = [SimpleNamespace(ground=lambda n=n: np.full((4, 3), float(n))) for n in range(count)]

    def shared(*groups: tuple[tuple[int, int], ...]) -> np.ndarray:
        made: Any = SimpleNamespace(block=SimpleNamespace(errors=CameraErrors(cameras, np.eye(10))))
        made.tiles = [((n, 0), tile, groups) for n, tile in enumerate(tiles)]
        return Grid.shared(made).reshape(5, 2)

    mean = (count - 1) / 2
    np.testing.assert_allclose(shared(((0, 1), (0, 2))).sum(axis=0), [2.5, mean])
    np.testing.assert_allclose(shared(((0, 1), (0, 2)))[:3, 0], [1.25, 0.25, 1.0])
    minus = shared(((0, 1),), ((3, 4),))
    np.testing.assert_allclose(minus.sum(axis=0), [-6.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(minus[:, 1], [mean / 2, mean / 2, 0.0, -mean / 2, -mean / 2])
    none: Any = SimpleNamespace(block=SimpleNamespace(errors=None))
    assert Grid.shared(none).shape == (0,)


def test_the_cameras_share_is_that_of_each_cells_centre() -> None:
    """Of pairs that see some of the cells: what is asked at the nodes, corner to corner, is read at the middle of a
    cell; columns to the east, rows to the south.
    """
    tile = Tile(CRS.from_epsg(32631).to_wkt(), 450_000.0, 4_900_000.0, 2.0, (8, 6), (0.0, 1.0))
    east, south = (
        part.ravel() for part in np.meshgrid(np.linspace(0.0, 8.0, TILE_NODES), np.linspace(0.0, 6.0, TILE_NODES))
    )

    def rows(chosen: Any, ground: np.ndarray) -> np.ndarray:
        assert len(ground) == TILE_NODES**2
        return 10.0 * len(chosen[0]) + east + 100.0 * south

    made: Any = SimpleNamespace(block=SimpleNamespace(errors=SimpleNamespace(rows=rows, sigma=np.asarray)))
    height, seen = np.full((6, 8), 5.0, np.float32), np.full((6, 8), 3.0, np.float32)
    seen[:2], height[5, 3] = 1.0, np.nan
    found = Grid._bands(made, tile, [[(0, 1), (0, 2)]], [(height, height, 4.0 * np.ones((6, 8)), seen)], np.array(7.0))
    row, col = np.mgrid[:6, :8] + 0.5
    expected = np.where(row < 2, 10.0, 20.0) + col + 100.0 * row - 7.0
    expected[5, 3] = np.nan
    np.testing.assert_allclose(found[4], expected, atol=1e-4)
    np.testing.assert_array_equal(found[1][:5], np.where(row < 2, 1.0, 2.0)[:5])
    np.testing.assert_allclose(found[3][:5], np.where(row < 2, 4.0, 4.0 / np.sqrt(2.0))[:5])


def test_coarser_pictures_are_framed_by_the_middles_of_their_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Places of the first look are those of the images, of a picture of means of 4 px a side (x + 0.5) / 4 - 0.5."""
    tile = Tile(CRS.from_epsg(32631).to_wkt(), 450_000.0, 4_900_000.0, 2.0, (8, 6), (100.0, 300.0))
    asked: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    sizes: list[Any] = []
    sight = {"a": np.array([7.0]), "b": np.array([9.5]), "sigma": np.array([0.1])}
    coarse = SimpleNamespace(share=1.0, alt=np.linspace(140.0, 240.0, 101), **sight)

    def framed(a: np.ndarray, b: np.ndarray, alt: np.ndarray) -> Any:
        asked.append((a, b, alt))
        return SimpleNamespace(num=2 * 64 * 4 - 1, across=0.0, metres=3.0)

    def matched(paths: Any, size: Any, frame: Any, band: int, near: Any) -> Any:
        sizes.append(size if near is None else (size, near))
        return coarse if near is None else None

    monkeypatch.setattr(stereo, "epipolar_frame", framed)
    monkeypatch.setattr(stereo, "dense_matches", matched)
    project = [lambda ground, k=k: (1 + k) * ground[:, :2] + ground[:, 2:] for k in range(2)]
    pair: Any = [SimpleNamespace(sensor=SimpleNamespace(project=one), size=(403, 80), path="") for one in project]
    assert stereo._tile_points(pair, tile, 1) == []
    ground = np.column_stack([np.tile(tile.nodes(), (3, 1)), np.repeat([100.0, 200.0, 300.0], TILE_NODES**2)])
    for (*seen, alt), side in zip(asked[:2], (1, 4), strict=True):
        for found, one in zip(seen, project, strict=True):
            np.testing.assert_allclose(found, (one(ground) + 0.5) / side - 0.5)
        np.testing.assert_array_equal(alt, ground[:, 2])
    assert sizes[0] == [(100, 20), (100, 20)]
    size, near = sizes[1]  # of half as coarse pictures, near the matches of the coarse ones, among their altitudes
    assert size == [(201, 40), (201, 40)]
    assert near == ([14.5], [19.5], 2.0)
    ends = 141.0 - 3.0 * 4.0, 239.0 + 3.0 * 4.0
    assert (asked[-1][2].min(), asked[-1][2].max()) == pytest.approx(np.clip(ends, 100.0, 300.0))


@pytest.mark.parametrize(("east", "width"), [(0.0, 500.0), (300.0, 200.0), (-350.0, 150.0), (520.0, 0.0)])
def test_cells_of_two_dates_are_where_pairs_of_both_see_the_ground(east: float, width: float) -> None:
    """Pairs of 500 m squares of half-metre pixels, those of the other date to the east."""
    made = views(*(camera(east / 111_320.0 * date, lean=lean) for date in (0, 1) for lean in (0.0, 0.2)))
    made = [replace(view, alt_range=(99.0, 101.0)) for view in made]
    block: Any = SimpleNamespace(views=made, groups=[[(0, 1)], [(2, 3)]])
    if not width:
        with pytest.raises(NoSurfaceError, match="the images do not overlap at the altitudes that they are used for"):
            Grid(block, DsmOptions(gsd=2.0))
        return
    found = Grid(block, DsmOptions(gsd=2.0))
    assert np.array(found.whole.size) == pytest.approx([width / 2.0, 250.0], abs=4)
    assert [tile.size for _, tile, _ in found.tiles] == [found.whole.size]
    assert [groups for *_, groups in found.tiles] == [[[(0, 1)], [(2, 3)]]]


@pytest.mark.parametrize(("at", "size"), [((0, 0), (5, 5)), ((5, 0), (3, 5)), ((0, 5), (5, 1)), ((5, 5), (3, 1))])
def test_a_part_of_a_tile_is_as_large_as_what_is_left_of_it(at, size):
    tile = Tile(CRS.from_epsg(32631).to_wkt(), 450_000.0, 4_900_000.0, 2.0, (8, 6), (0.0, 1.0))
    part = tile.part(*at, 5)
    assert (part.size, part.step, part.alts) == (size, tile.step, tile.alts)
    assert (part.west, part.north) == (450_000.0 + 2.0 * at[0], 4_900_000.0 - 2.0 * at[1])
