"""Cells of a map and where ground points lie among them, against pyproj; what all cells share."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pyproj import CRS, Transformer

from barpc.dsm.cells import Tile
from barpc.dsm.grid import Grid


@pytest.mark.parametrize(("code", "west"), [(32631, 450_000.0), (32760, 810_000.0)])
def test_places_among_cells_are_those_of_the_map(code: int, west: float) -> None:
    """To a hundredth of a millimetre over a kilometre; beyond the antimeridian, too, whichever way longitudes turn."""
    tile = Tile(CRS.from_epsg(code).to_wkt(), west, 4_900_000.0, 2.0, (500, 400), (0.0, 1.0))
    rng = np.random.default_rng(0)
    cells = rng.uniform(0.0, 1.0, (50, 2)) * [500, 400]
    to_lonlat = Transformer.from_crs(code, 4326, always_xy=True)
    lon, lat = to_lonlat.transform(west + 2.0 * cells[:, 0], 4_900_000.0 - 2.0 * cells[:, 1])
    for turn in (0.0, 360.0, -360.0):
        np.testing.assert_allclose(tile.places()(np.column_stack([lon + turn, lat])), cells, atol=5e-6)
    x, y = west + 2.0 * (np.arange(500) + 0.5), 4_900_000.0 - 2.0 * (np.arange(400) + 0.5)
    middles = np.column_stack(to_lonlat.transform(*(part.ravel() for part in np.meshgrid(x, y))))
    apart = tile.centres() - middles
    np.testing.assert_allclose((apart + 180.0) % 360.0 - 180.0, 0.0, atol=1e-9)


@pytest.mark.parametrize("count", [2, 9])
def test_what_all_cells_share_is_a_mean_over_all_tiles(count: int) -> None:
    """Of the pairs of each tile, and of a difference less that of the other date's."""
    by_pair = {(0, 1): 1.0, (0, 2): 4.0, (3, 4): 7.0}

    def rows(pair: tuple[int, int], ground: np.ndarray) -> np.ndarray:
        return np.column_stack([np.full(len(ground), by_pair[pair]), ground[:, 0]])

    made: Any = SimpleNamespace(block=SimpleNamespace(errors=SimpleNamespace(rows=rows)))
    made._rows = lambda tile, groups: Grid._rows(made, tile, groups)
    tiles: list[Any] = [
        SimpleNamespace(nodes=lambda n=n: np.full((2, 2), float(n)), alts=(0.0, 1.0)) for n in range(count)
    ]
    seen: list[Any] = [((n, 0), tile, (((0, 1), (0, 2)),)) for n, tile in enumerate(tiles)]
    np.testing.assert_allclose(Grid.shared(made, seen), [2.5, (count - 1) / 2])
    minus: list[Any] = [((n, 0), tile, (((0, 1),), ((3, 4),))) for n, tile in enumerate(tiles)]
    np.testing.assert_allclose(Grid.shared(made, minus), [-6.0, 0.0])
    made.block.errors = None
    assert Grid.shared(made, seen).shape == (0,)
