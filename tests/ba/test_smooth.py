"""What is smooth in residuals is told from what scatters, and as large as it is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.parameters.unknowns import Unknowns
from barpc.ba.robust.systematic_residuals import SPLINES, Smooth, SmoothTest
from barpc.ba.robust.weights import Observations
from barpc.ba.solving.structure import make_structure
from barpc.sensor.image_corrections import bsplines
from tests import distributions as stats
from tests.constants import Sized

SIZE = (10000, 20000)


def made(counts: tuple[int, ...], at: np.ndarray | None = None) -> Smooth:
    """Views of 10000 x 20000 px with so many observations each, anywhere or `at` columns and rows, -1 to 1."""
    n = len(counts)
    view = np.repeat(np.arange(n), counts)
    structure = make_structure(view, np.arange(len(view)), n, len(view))
    half = np.repeat(np.array(SIZE)[:, None] / 2.0, n, axis=1)
    unknowns = Unknowns("rotation", 0, np.zeros((n, 3)), np.ones(n), half - 0.5, half)
    xy = ((anywhere(len(view)) if at is None else at) + 1.0) * half[:, :1] - 0.5
    return Smooth(structure, xy, unknowns)


def anywhere(count: int) -> np.ndarray:
    """Columns and rows of observations, -1 to 1."""
    return np.random.default_rng(0).uniform(0, 1, (2, count)) * 2 - 1


def noise(count: int, sigma: float) -> np.ndarray:
    return np.random.default_rng(1).normal(0, sigma, (2, count))


def test_splines_reproduce_cubics_and_wiggle_a_dozen_times() -> None:
    u = np.linspace(-1, 1, 500)
    basis = bsplines(u, SPLINES)
    assert basis.shape == (SPLINES, 500)
    np.testing.assert_allclose(basis.sum(axis=0), 1.0)
    assert (basis >= 0).all()
    width = 4 * 2 / (SPLINES - 3)  # of a cubic one, in pieces of the image
    for k, spline in enumerate(basis):
        middle = -1 + (k - 1) * width / 4
        assert (spline[np.abs(u - middle) > width / 2 + 1e-9] == 0).all()
        if abs(middle) < 1:
            assert spline[np.abs(u - middle).argmin()] == pytest.approx(2 / 3, abs=1e-3)
    for power in range(4):
        coefficients = np.linalg.lstsq(basis.T, u**power, rcond=None)[0]
        np.testing.assert_allclose(coefficients @ basis, u**power, atol=1e-9)


@pytest.mark.parametrize(
    "shape",
    [
        lambda col, row: np.sin(5 * row),
        lambda col, row: col + 0 * row,
        lambda col, row: 1.5 * col**2 - 0.5,
        lambda col, row: col**3,
        lambda col, row: row * col,
    ],
)  # fmt: skip
def test_what_is_smooth_comes_back_and_what_scatters_does_not(shape) -> None:
    smooth = made((900, 700))
    col, row = anywhere(1600)
    wave = np.stack([0.4 * shape(col, row), -0.2 * shape(col, row)])
    weight = np.ones(1600)
    np.testing.assert_allclose(smooth.part(wave, weight), wave, atol=0.04)
    found = smooth.part(wave + noise(1600, 0.1), weight) - wave
    assert np.sqrt((found**2).mean()) < 0.03


def test_each_observation_counts_by_its_weight() -> None:
    smooth = made((800,))
    _, row = anywhere(800)
    wave = np.stack([np.sin(3 * row), row**2])
    wrong = wave.copy()
    wrong[:, ::4] += 50.0
    weight = np.ones(800)
    weight[::4] = 0.0
    spoilt = wrong.copy()
    spoilt[:, ::4] = np.nan  # what does not count need not be a number
    for given in (wrong, spoilt):
        np.testing.assert_allclose(smooth.part(given, weight), wave, atol=0.02)
    weight[::4] = 1e-4
    lifted = smooth.part(wrong, weight) - wave
    np.testing.assert_allclose(lifted.mean(), 50 * 1e-4 / 3, rtol=0.2)
    # the least squares solution of these weights: 4 : 1 of two levels is a fifth of the way
    steps = np.zeros((2, 800))
    steps[:, ::2] = 1.0
    weight[::2], weight[1::2] = 4.0, 1.0
    assert smooth.part(steps, weight).mean() == pytest.approx(0.8, abs=0.01)


def test_rows_without_observations_go_on_as_their_neighbours() -> None:
    smooth = made((900,))
    _, row = anywhere(900)
    line = np.stack([1.0 + 2.0 * row, -row])
    weight = (np.abs(row - 0.2) > 0.35).astype(float)  # nothing is seen over a sixth of the image
    found = smooth.part(np.where(weight, line, 7.0), weight)
    np.testing.assert_allclose(found, line, atol=0.02)


def test_beyond_the_image_the_edge_goes_on() -> None:
    """Observations may lie somewhat outside: they take no cubic with them."""
    inside = anywhere(900)
    out = np.array([[-1.0, -1.8, 1.8, 0.0, 0.0], [-1.0, -0.7, -0.7, -1.6, 1.9]])
    weight = np.r_[np.ones(900), np.zeros(5)]
    line = np.hstack([np.stack([2 * inside[0], -inside[1]]), np.zeros((2, 5))])
    found = made((905,), np.hstack([inside, out])).part(line, weight)[:, 900:]
    np.testing.assert_allclose(found, [[-2, -2, 2, 0, 0], [1, 0.7, 0.7, 1, -1]], atol=0.03)


def test_a_view_needs_ten_observations_a_term() -> None:
    few, enough = 18 * 10 - 1, 18 * 10
    smooth = made((few, enough, 400))
    assert sorted(smooth.fit(np.ones((2, few + enough + 400)), np.ones(few + enough + 400))) == [1, 2]
    assert sorted(smooth.fit(np.ones((2, few + enough + 400)), np.r_[np.ones(few + enough), np.zeros(400)])) == [1]
    given = np.ones((2, few + enough + 400))
    part = smooth.part(given, given[0])
    assert not part[:, :few].any()
    np.testing.assert_allclose(part[:, few:], 1.0, atol=0.01)
    found = smooth.test(given, given[0] > 0)
    assert found.rms[0] == 0.0
    assert found.significance[0] == 1.0
    assert np.isnan(found.by_row[0])
    assert (found.rms[1:] > 1.0).all()
    assert np.isfinite(found.by_row[1:]).all()


def test_noise_alone_leaves_nothing_and_a_wave_its_root_mean_square() -> None:
    smooth = made((1500, 1500, 1500, 100))
    col, row = anywhere(4600)
    first = smooth.structure.view == 0
    second = smooth.structure.view == 1
    residual = noise(4600, 0.2)
    residual[0, first] += 0.3 * np.sin(5 * row[first])
    residual[1, second] += 0.3 * col[second]
    use = np.ones(len(row), dtype=bool)
    found = smooth.test(residual, use)
    waves = np.sqrt([(0.09 * np.sin(5 * row[first]) ** 2).mean(), (0.09 * col[second] ** 2).mean()])
    np.testing.assert_allclose(found.rms[:2], waves, rtol=0.05)
    assert found.rms[2] < 0.02
    assert found.by_row[0] > 0.9
    assert found.by_row[1] < 0.1
    assert (found.significance[:2] < 1e-12).all()
    assert 1e-3 < found.significance[2] <= 1.0
    assert found.found(0.1).tolist() == [True, True, False, False]
    assert found.found(0.18).tolist() == [True, False, False, False]
    np.testing.assert_array_equal(found.misfit(), [*found.rms[:2], 0.0, 0.0])
    assert not SmoothTest(found.rms, np.full(4, 1.4e-4), found.by_row, found.shared).found(0.0).any()
    assert SmoothTest(np.ones(4), np.full(4, 7e-5), found.by_row, found.shared).found(0.9).all()
    # what is not used has no say
    use[np.flatnonzero(first)[::3]] = False
    spoilt = np.where(use, residual, 99.0)
    part = smooth.test(spoilt, use)
    np.testing.assert_allclose(part.rms[0], waves[0], rtol=0.08)
    np.testing.assert_array_equal(part.rms[1:], found.rms[1:])


def test_the_significance_is_that_of_the_f_test() -> None:
    """Of the 36 coefficients of both coordinates, against what they leave."""
    smooth = made((400,) * 30)
    _, row = anywhere(12000)
    size = np.repeat(np.linspace(0, 0.2, 30), 400)
    residual = noise(12000, 0.3) + size * np.sin(5 * row)
    part = smooth.part(residual, np.ones(12000))
    explained, total = (smooth.structure.sum_views((x**2).sum(axis=0)[None])[:, 0] for x in (part, residual))
    value = (explained / 36) / ((total - explained) / (800 - 36))
    found = smooth.test(residual, np.ones(12000, dtype=bool))
    np.testing.assert_allclose(found.significance, stats.f.sf(value, 36, 800 - 36), rtol=1e-6)
    assert found.significance[0] > 0.05
    assert found.significance[-1] < 1e-6
    noise_of_terms = 36 * (total - explained) / (800 - 36)
    np.testing.assert_allclose(found.rms, np.sqrt(np.maximum(explained - noise_of_terms, 0) / 400), atol=1e-9)
    assert not found.shared.any()  # what neighbours share is asked for by itself


@pytest.mark.parametrize("axis", [0, 1])
def test_what_neighbours_share_is_found_though_it_is_no_smooth_function(axis: int) -> None:
    """Steps every hundredth of the image, of both signs."""
    smooth = made((4000, 4000))
    along = anywhere(8000)[axis]
    step = np.random.default_rng(5).choice([-1.0, 1.0], 101)[((along + 1) * 50).astype(int)]
    mine = smooth.structure.view == 0
    residual = noise(8000, 0.2)
    residual[1, mine] += 0.15 * step[mine]
    use = np.ones(8000, dtype=bool)
    tested = smooth.test(residual, use)
    found = smooth.test_neighbours(tested, residual, use, 1.0)
    np.testing.assert_array_equal(found.rms, tested.rms)
    assert found.shared[0] == pytest.approx(0.15, rel=0.15)
    assert found.shared[1] == 0.0
    for size, found in ((0.9, True), (3.0, False)):  # a mean product of 8 of its standard deviations, of 2
        faint = 0.15 * step * mine + noise(8000, 0.3 * size)
        given = np.stack([0 * step, faint[1]])
        shared = smooth.test_neighbours(smooth.test(given, use), given, use, 1.0).shared
        assert (shared[0] > 0.0) == found  # else it may be chance


@pytest.mark.parametrize(("most", "once"), [(599, False), (600, True)])
def test_terms_of_a_block_that_is_not_large_are_worked_out_once(
    monkeypatch, sized: Sized, most: int, once: bool
) -> None:
    sized(terms_kept=most)
    asked: list[slice] = []
    terms = Smooth._terms
    monkeypatch.setattr(Smooth, "_terms", lambda self, rows: asked.append(rows) or terms(self, rows))
    smooth = made((300, 300))
    for _ in range(3):
        smooth.part(noise(600, 0.1), np.ones(600))
    assert asked == [slice(0, 600)] if once else len(asked) >= 6


def test_terms_that_observations_hardly_tell_apart_stay_small() -> None:
    """All of a view in a narrower and narrower stripe of columns, and in one: its powers are nearly the same."""
    col, row = anywhere(400)
    for width in (0.0, *np.geomspace(1e-3, 0.5, 60)):
        smooth = made((400,), np.stack([0.5 + width * col, row]))
        found = smooth.part(noise(400, 0.1), np.ones(400))
        assert np.sqrt((found**2).mean()) < 0.03


@pytest.mark.parametrize("views", [2, 3, 6])
def test_of_an_error_of_a_camera_points_take_a_part_that_is_said_too(views: int) -> None:
    """Observations of n views tell 2 n - 3 of 2 n numbers of their cameras' errors; the sign and size by hand."""
    tracks = 50
    view, point = np.repeat(np.arange(views), tracks), np.tile(np.arange(tracks), views)
    structure = make_structure(view, point, views, tracks)
    problem: Any = SimpleNamespace(
        structure=structure, point_prior=None, cameras=SimpleNamespace(unknowns=SimpleNamespace(waves=None))
    )
    observations = Observations(problem, np.ones(len(view)), 0.02, np.ones(len(view), dtype=bool))
    redundancy = 0.5 * observations.mean_freedom(np.ones(len(view), dtype=bool))
    np.testing.assert_allclose(redundancy, (2 * views - 3) / (2 * views))
    ones = np.ones(views)
    tested = SmoothTest(0.1 * ones, ones, ones, 0.2 * ones, redundancy)
    np.testing.assert_allclose(tested.of_cameras(), 0.2 / np.sqrt((2 * views - 3) / (2 * views)))
    np.testing.assert_allclose(replace(tested, rms=0.3 * ones, redundancy=1.0).of_cameras(), 0.3)
