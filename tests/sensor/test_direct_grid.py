"""Localisation grids as cameras: true between the nodes, invertible, honest off the grid."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from barpc.base.errors import RpcError
from barpc.fit import fit_rpc
from barpc.pointio.correspondences import read_grid
from barpc.rpcio import read_rpc
from barpc.sensor.direct_grid import DirectGrid, linear_axes
from barpc.simulate import Look, fly
from tests.lanes import rest_slow

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
    small = sampled(np.arange(0.0, 4001.0, 500.0), np.arange(0.0, 4001.0, 1000.0), np.array([0.0, 500.0, 1000.0]))
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


# --- how dense a grid is made ----------------------------------------------------------------------------------


def chord(bend: float, step: float) -> float:
    """By how much a parabola of the second derivative `bend` leaves its chord over a step, at most."""
    return bend * step**2 / 8


@pytest.mark.parametrize(("bend", "tolerance"), [(1e-6, 0.01), (4e-6, 0.01), (1e-6, 0.0005)])
def test_an_axis_has_as_many_nodes_as_its_bend_asks_for_and_few_more(bend, tolerance):
    """Of two axes each may take half of the tolerance; the second is straight and keeps the longest cells."""

    def value(points):
        return bend / 2 * points[..., :1] ** 2 + 0.3 * points[..., 1:] - 7.0

    bent, straight = linear_axes(
        value, np.array([-100.0, 50.0]), np.array([8092.0, 4146.0]), np.array([1024.0, 1000.0]), tolerance
    )
    step = bent[1] - bent[0]
    assert chord(bend, step) <= 1.05 * tolerance / 2  # the middle of a cell is hardly ever tried
    assert chord(bend, step) > 0.6 * tolerance / 2
    assert len(straight) == 6  # 4096 m in cells of up to 1000
    for axis, ends in ((bent, (-100.0, 8092.0)), (straight, (50.0, 4146.0))):
        assert (axis[0], axis[-1]) == ends
        np.testing.assert_allclose(np.diff(axis), axis[1] - axis[0])


def test_what_is_straight_keeps_the_longest_cells_and_three_of_them_at_least():
    def value(points):
        return points @ np.array([[1.0, 2.0], [3.0, -4.0]])

    axes = linear_axes(value, np.zeros(2), np.array([10_240.0, 90.0]), np.array([1024.0, 1024.0]), 1e-3)
    assert [len(axis) for axis in axes] == [11, 4]


def test_the_errors_of_all_values_count_together():
    """Of (x^2, x^2) the error is larger by the root of two than that of x^2 alone."""
    low, high, longest = np.zeros(1), np.full(1, 8192.0), np.full(1, 1024.0)
    one = linear_axes(lambda p: 1e-6 * p**2, low, high, longest, 0.005)[0]
    both = linear_axes(lambda p: 1e-6 * np.concatenate([p**2, p**2], axis=-1), low, high, longest, 0.005)[0]
    assert len(one) < len(both) < 1.35 * len(one)


def test_more_nodes_than_millions_are_bought_off_by_twice_the_tolerance():
    """Waves that would take 260 cells along each axis: the promise is loosened until four million nodes do."""

    def value(points):
        return np.sin(points).sum(axis=-1, keepdims=True)

    def nodes(tolerance):
        axes = linear_axes(value, np.zeros(3), np.full(3, 60.0), np.full(3, 60.0), tolerance)
        return float(np.prod([len(axis) for axis in axes]))

    # a wave of height 1 leaves the chord of a step h by h^2 / 8; a third of the tolerance for each axis
    asked = {tolerance: (60.0 / np.sqrt(8 * tolerance / 3)) ** 3 for tolerance in (0.02, 0.1)}
    assert asked[0.02] > 4e6 > asked[0.1]
    assert 0.9 * asked[0.02] / 8 < nodes(0.02) < 4e6  # twice and twice again
    assert asked[0.1] * 0.9 < nodes(0.1) < 1.6 * asked[0.1]


def test_a_grid_of_a_camera_spans_its_image_and_its_altitudes():
    grid = DirectGrid.of(PHYSICAL, (3000, 2000), (100.0, 700.0))
    assert (grid.cols[0], grid.cols[-1]) == (-0.5, 2999.5)
    assert (grid.rows[0], grid.rows[-1]) == (-0.5, 1999.5)
    assert (grid.alts[0], grid.alts[-1]) == (100.0, 700.0)
    nodes = np.stack(np.meshgrid(grid.cols, grid.rows), axis=-1)
    for alt, layer in zip(grid.alts, grid.lonlat, strict=True):
        there = PHYSICAL.localize(nodes, np.full(nodes.shape[:2], alt))[..., :2]
        np.testing.assert_allclose(layer, there, rtol=0, atol=1e-12)


@pytest.mark.parametrize("tolerance", rest_slow([0.02, 0.002]))
def test_a_grid_of_a_camera_is_true_to_its_tolerance_in_pixels_and_not_by_far_better(tolerance):
    """Linear interpolation along each axis alone, at the middle of the cells, where it misses most."""
    grid = DirectGrid.of(PHYSICAL, (20000, 20000), (0.0, 4000.0), tolerance)
    total = 0.0
    for axis in range(3):
        ends = [[slice(None)] * 3 for _ in range(2)]
        ends[0][axis], ends[1][axis] = slice(None, -1), slice(1, None)
        between = (grid.lonlat[tuple(ends[0])] + grid.lonlat[tuple(ends[1])]) / 2
        places = [grid.alts, grid.rows, grid.cols]
        places[axis] = (places[axis][1:] + places[axis][:-1]) / 2
        alt, row, col = np.meshgrid(*places, indexing="ij")
        seen = PHYSICAL.project(np.concatenate([between, alt[..., None]], axis=-1))
        total += np.linalg.norm(seen - np.stack([col, row], axis=-1), axis=-1).max()
    assert total < 1.1 * tolerance
    assert total > tolerance / 20


def test_pixels_of_the_tolerance_are_those_in_the_middle_of_the_image():
    """A camera whose pixels grow by e every 2000 columns: at the end they are seven times those of the middle."""

    class Growing:
        def localize(self, image, alt):
            image = np.asarray(image, dtype=float)
            lon = 5.0 + 0.02 * np.exp(image[..., 0] / 2000.0)
            lonlat = np.stack([lon, 44.0 - 1e-5 * image[..., 1] + 0 * lon], axis=-1)
            return np.concatenate([lonlat, np.broadcast_to(alt, lon.shape)[..., None]], axis=-1)

        def project_jacobian(self, ground):
            lon, lat, _ = ground
            image = np.array([2000.0 * np.log((lon - 5.0) / 0.02), (44.0 - lat) * 1e5])
            return image, np.array([[2000.0 / (lon - 5.0), 0.0, 0.0], [0.0, -1e5, 0.0]])

    tolerance = 0.3
    grid = DirectGrid.of(Growing(), (8000, 3000), (0.0, 100.0), tolerance)
    step, pixel = grid.cols[1] - grid.cols[0], 0.02 / 2000.0 * np.exp(2.0)
    missed = chord(0.02 / 2000.0**2 * np.exp(4.0), step) / pixel
    assert 0.65 * tolerance / 3 < missed < 1.05 * tolerance / 3
    assert (len(grid.rows), len(grid.alts)) == (4, 4)


@pytest.mark.parametrize("power", [1.5, 2.5])
def test_nodes_that_no_cubic_follows_are_found_again_to_the_last_one(power):
    """A map in closed form whose pixels grow from one side to the other: lon = u^power, lat along the rows alone."""
    cols, rows, alts = (
        np.arange(0.0, 2001.0, 50.0),
        np.arange(0.0, 1001.0, 50.0),
        np.array([0.0, 100.0, 200.0]),
    )

    def place(col, row, alt):
        lon = 3.0 + 0.02 * ((col + 1000.0) / 1000.0) ** power + 1e-6 * alt
        return np.stack([lon, 44.0 - 1e-5 * row - 2e-6 * alt + 0 * col], axis=-1)

    alt, row, col = np.meshgrid(alts, rows, cols, indexing="ij")
    grid = DirectGrid(cols, rows, alts, place(col, row, alt))
    rng = np.random.default_rng(1)
    image, height = rng.uniform([-45.0, -45.0], [2045.0, 1045.0], (400, 2)), rng.uniform(-15.0, 215.0, 400)
    image[:2] = [[-45.0, -45.0], [2045.0, 1045.0]]
    ground = np.column_stack([place(*image.T, height), height])
    np.testing.assert_allclose(grid.localize(image, height)[:, :2], ground[:, :2], rtol=0, atol=1e-6)
    found, jacobian = grid.project_jacobian(grid.localize(image, height))
    np.testing.assert_allclose(found, image, rtol=0, atol=1e-6)
    by_col = 0.02 * power / 1000.0 * ((image[:, 0] + 1000.0) / 1000.0) ** (power - 1)
    expected = np.zeros((400, 2, 3))
    expected[:, 0, 0], expected[:, 0, 2] = 1 / by_col, -1e-6 / by_col
    expected[:, 1, 1], expected[:, 1, 2] = -1e5, -0.2
    np.testing.assert_allclose(jacobian, expected, rtol=5e-3, atol=1e-2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c, r, a, v: (c, r, a, np.where(v == v[0, 0, 0, 0], 539.0, v)), ""),
        (lambda c, r, a, v: (c, r, a, np.where(v == v[0, 0, 0, 0], 541.0, v)), "localisation grid"),
        (lambda c, r, a, v: (c, r, a, np.where(v == v[0, 0, 0, 0], np.nan, v)), "no ground point"),
        (lambda c, r, a, v: (c, r, a, np.where(v == v[0, 0, 0, 1], -89.9, v)), ""),
        (lambda c, r, a, v: (c, r, a, np.where(v == v[0, 0, 0, 1], -90.1, v)), "localisation grid"),
        (lambda c, r, a, v: (c + 1.1e9, r, a, v), "localisation grid"),
        (lambda c, r, a, v: (c, r, a * 4e5, v), "localisation grid"),
        (lambda c, r, a, v: (c, np.where(r == r[1], r[0], r), a, v), "localisation grid"),
        (lambda c, r, a, v: (c[::-1], r, a, v), "ascend"),
        (lambda c, r, a, v: (c[:1], r, a, v[:, :, :1]), "localisation grid"),
        (lambda c, r, a, v: (c, r, a[:1], v[:1]), "nodes"),
        (lambda c, r, a, v: (c, r, a, v[..., :1]), "nodes"),
        (lambda c, r, a, v: (c[:2], r[:2], a[:2], v[:2, :2, :2]), ""),
    ],
)
def test_nodes_lie_on_earth_and_in_an_image(change, words):
    grid = sampled(np.linspace(0, 2000, 5), np.linspace(0, 2000, 4), np.linspace(0.0, 4900.0, 3))
    given = change(grid.cols, grid.rows, grid.alts, grid.lonlat)
    with pytest.raises(RpcError, match=words) if words else nullcontext():
        assert DirectGrid(*given).lonlat.shape[-1] == 2
