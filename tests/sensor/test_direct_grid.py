"""Localisation grids as cameras: true between the nodes, invertible, honest off the grid."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.errors import RpcError
from barpc.fit import fit_rpc
from barpc.pointio.ground import read_grid
from barpc.rpcio import read_rpc
from barpc.sensor.direct_grid import DirectGrid
from barpc.simulate.orbit import Look, fly

SIZE = (20000, 20000)
PHYSICAL = fly(np.array([5.4, 43.3, 500.0]), Look(22.0, 140.0), SIZE, 0.5)


def sampled(cols, rows, alts) -> DirectGrid:
    nodes = np.stack(np.meshgrid(cols, rows), axis=-1)
    return DirectGrid(cols, rows, alts, PHYSICAL.localize(nodes, alts[:, None, None])[..., :2])


@pytest.fixture(scope="module")
def grid() -> DirectGrid:
    return sampled(np.linspace(0, 20000, 33), np.linspace(0, 20000, 29), np.linspace(-30.0, 4900.0, 5))


@pytest.fixture
def points():
    rng = np.random.default_rng(2)
    return rng.uniform(0, 19999, (3000, 2)), rng.uniform(0, 4800, 3000)


def test_between_the_nodes_the_grid_is_the_physical_model(grid, points):
    """Nodes every 600 px and 1200 m, as vendors deliver them: what is left is rounding."""
    image, alt = points
    assert np.abs(grid.project(PHYSICAL.localize(image, alt)) - image).max() < 1e-7


def test_the_nodes_are_met_exactly(grid):
    nodes = np.stack(np.meshgrid(grid.cols, grid.rows), axis=-1)
    ground = grid.localize(nodes, grid.alts[:, None, None])
    assert np.abs(ground[..., :2] - grid.lonlat).max() < 1e-12
    assert np.abs(grid.project(ground) - nodes).max() < 1e-7


def test_projection_inverts_localisation(grid, points):
    image, alt = points
    assert np.abs(grid.project(grid.localize(image, alt)) - image).max() < 5e-8


@pytest.mark.parametrize("swing", [0.0, 20.0, 150.0])
def test_a_grid_that_no_cubic_follows_is_inverted_as_well(points, swing):
    """Waves of 4000 px: the slope of the image changes by up to a quarter within a thousand pixels."""
    cols, rows, alts = np.linspace(0, 20000, 65), np.linspace(0, 20000, 65), np.linspace(-30.0, 4900.0, 3)
    nodes = np.stack(np.meshgrid(cols, rows), axis=-1)
    nodes = nodes + swing * np.sin(2 * np.pi * nodes[..., ::-1] / 4000)
    waves = DirectGrid(cols, rows, alts, PHYSICAL.localize(nodes, alts[:, None, None])[..., :2])
    image, alt = points
    ground = waves.localize(image, alt)
    assert np.abs(waves.project(ground) - image).max() < 5e-8
    found, jacobian = waves.project_jacobian(ground[:100])
    step = np.array([1e-6, 0.0, 0.0])
    difference = (waves.project(ground[:100] + step) - waves.project(ground[:100] - step)) / 2e-6
    assert np.abs(found - image[:100]).max() < 5e-8
    assert np.nanmax(np.abs(difference - jacobian[..., 0])) < 1e-5 * np.abs(jacobian[..., 0]).max()


def test_the_derivative_is_the_central_difference(grid, points):
    ground = grid.localize(*points)
    _, jacobian = grid.project_jacobian(ground)
    for axis, step in enumerate((1e-5, 1e-5, 1.0)):
        delta = step * np.eye(3)[axis]
        difference = (grid.project(ground + delta) - grid.project(ground - delta)) / (2 * step)
        inside = np.isfinite(difference).all(axis=1)
        assert inside.mean() > 0.99
        error = np.abs(difference - jacobian[..., axis])[inside].max()
        assert error < 1e-6 * np.abs(jacobian[..., axis]).max()


def test_off_the_grid_points_are_nan(grid):
    image = np.array([[-400.0, 100.0], [-800.0, 100.0], [100.0, 22000.0], [np.nan, 0.0], [100.0, 100.0]])
    off = np.array([False, True, True, True, False])
    assert np.array_equal(np.isnan(grid.localize(image, np.array(10.0))[:, 0]), off)
    assert np.isnan(grid.localize(np.array([10.0, 10.0]), np.array([-600.0, 5500.0]))[:, 0]).all()
    far = np.array([[5.4, 44.5, 100.0], [-174.6, 43.3, 0.0], [np.nan, 43.3, 0.0]])
    image, jacobian = grid.project_jacobian(far)
    assert np.isnan(image).all()
    assert np.isnan(jacobian).all()


def test_the_grid_goes_on_for_a_cell_and_a_tenth_of_its_altitudes():
    """Nodes every 500 columns and 1000 rows up to 4000, altitudes 0 to 1000: the last cell's end belongs to it."""
    small = sampled(
        np.arange(0.0, 4001.0, 500.0), np.arange(0.0, 4001.0, 1000.0), np.array([0.0, 500.0, 1000.0])
    )
    middle = np.array([2000.0, 2000.0, 500.0])
    for axis, (low, high) in enumerate(((-500.0, 4500.0), (-1000.0, 5000.0), (-100.0, 1100.0))):
        for value, known in ((low, True), (high, True), (low - 0.01, False), (high + 0.01, False)):
            place = middle.copy()
            place[axis] = value
            ground = small.localize(place[:2], place[2])
            assert np.isfinite(ground).all() == known, (axis, value)
            if known:
                there = PHYSICAL.localize(place[:2], place[2])
                np.testing.assert_allclose(ground[:2], there[:2], atol=2e-8)


def test_the_nodes_may_be_listed_in_any_order(grid):
    alt, row, col = np.meshgrid(grid.alts, grid.rows, grid.cols, indexing="ij")
    ground = np.concatenate([grid.lonlat, alt[..., None]], axis=-1).reshape(-1, 3)
    image = np.stack([col, row], axis=-1).reshape(-1, 2)
    order = np.random.default_rng(0).permutation(len(image))
    again = DirectGrid.from_points(ground[order], image[order])
    assert again == grid
    assert hash(again) == hash(grid)
    with pytest.raises(RpcError, match="do not fill"):
        DirectGrid.from_points(ground[1:], image[1:])


@pytest.mark.parametrize("layers", [2, 3])
def test_few_layers_are_enough_where_the_altitudes_are_close(layers):
    grid = sampled(np.linspace(0, 20000, 25), np.linspace(0, 20000, 25), np.linspace(0.0, 100.0, layers))
    image = np.random.default_rng(0).uniform(0, 20000, (500, 2))
    error = grid.project(PHYSICAL.localize(image, np.array(40.0))) - image
    assert np.abs(error).max() < (2e-3 if layers == 2 else 1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, r, a, v: (c[::-1], r, a, v), "ascend"),
        (lambda c, r, a, v: (c, r, a[:1], v[:1]), "nodes"),
        (lambda c, r, a, v: (c, r, a, v[..., :1]), "nodes"),
        (lambda c, r, a, v: (c, r, a, np.where(v == v[0, 0, 0, 0], np.nan, v)), "no ground point"),
    ],
)
def test_a_grid_that_cannot_be_is_refused(grid, change, message):
    with pytest.raises(RpcError, match=message):
        DirectGrid(*change(grid.cols, grid.rows, grid.alts, grid.lonlat))


def test_a_vendor_grid_and_the_vendor_rpc_agree_inside_the_rpc_domain(shared_data):
    """The physical model's grid of a Pleiades image against the RPC delivered with it: 0.0006 px of spread."""
    folder = shared_data / "physical"
    nodes = read_grid(folder / "GRID_P1BP--2017092838284574CP.tif")
    grid = DirectGrid.from_points(nodes.ground, nodes.image)
    rng = np.random.default_rng(0)
    image = rng.uniform([0, 0], [39999, 22900], (2000, 2))
    ground = grid.localize(image, rng.uniform(40, 1120, 2000))
    difference = read_rpc(folder / "RPC_P1BP--2017092838284574CP.XML").project(ground) - image
    assert np.abs(difference.mean(axis=0)).max() < 1e-4
    assert difference.std(axis=0).max() < 6e-4
    assert np.abs(difference).max() < 2.5e-3


def test_a_vendor_grid_is_smooth_enough_to_be_interpolated(shared_data):
    """Left-out nodes come back from the others: every second column and row, every second layer."""
    nodes = read_grid(shared_data / "physical" / "GRID_P1BP--2017092838284574CP.tif")
    full = DirectGrid.from_points(nodes.ground, nodes.image)
    coarse = DirectGrid(full.cols[::2], full.rows[::2], full.alts, full.lonlat[:, ::2, ::2])
    assert np.abs(coarse.project(nodes.ground) - nodes.image).max() < 1e-6
    flat = DirectGrid(full.cols, full.rows, full.alts[::2], full.lonlat[::2])
    assert np.abs(flat.project(nodes.ground) - nodes.image).max() < 1e-4


def test_an_rpc_is_fitted_to_a_vendor_grid_by_the_one_function(shared_data):
    nodes = read_grid(shared_data / "physical" / "GRID_P1BP--2017092838284574CP.tif")
    fit = fit_rpc(DirectGrid.from_points(nodes.ground, nodes.image), (39999, 22900), (40.0, 1120.0))
    assert fit.rmse_ckp.max() < 2e-5
    assert fit.max_ckp.max() < 5e-5
