"""What blocks tell of a detector line: against a dense solution, truth of other models, and time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg as la

from barpc.ba.calibration import (
    Learnt,
    Line,
    SensorTies,
    Told,
    _cross_validated,
    contradicts,
    learn,
    normal_equations,
    share_shown,
)
from barpc.ba.interior import LineCurve
from barpc.base.errors import InputError
from barpc.sensor.image_corrections import Calibrated, ColumnSpline
from barpc.simulate import simulate_block
from benchmarks.calibrate import SMALL, Scene, Sensor, any_looks, off, others, parts, said, scene

SIZE = (6000, 4000)


def ties(made: Scene, name: str = "") -> SensorTies:
    """What a scene tells whose cameras are known but for the detector line."""
    return SensorTies.of(name, made.views, made.tracks, made.cameras, made.ground)


def scenes(count: int, sensor: Sensor, seed: int, **given: object) -> list[SensorTies]:
    rng = np.random.default_rng(seed)
    return [ties(scene(any_looks(3, rng), sensor, rng, 700, size=SIZE, **given)) for _ in range(count)]  # type: ignore[arg-type]


def test_points_and_nuisances_are_eliminated_as_a_dense_solution_does() -> None:
    rng = np.random.default_rng(1)
    made = ties(scene(any_looks(3, rng), Sensor.made("waves", 1, size=SIZE), rng, 60, size=SIZE))
    count, points, views = len(made.view), int(made.point.max()) + 1, int(made.view.max()) + 1
    weight, curve = rng.uniform(5, 10, count), LineCurve(SIZE[0], np.array([1500.5, 4200.5]))
    told = normal_equations(curve, made, weight).by_steps(curve)
    col, row = made.place.T
    terms = np.stack([np.ones(count), col, row, col * row, row**2], axis=1)
    others, own = np.zeros((2 * count, 3 * points + 10 * views)), np.zeros((2 * count, 2 * curve.size))
    basis = curve.basis(made.col)
    for k in range(count):
        for i in range(2):
            at = 3 * made.point[k], 3 * points + 10 * made.view[k] + 5 * i
            others[2 * k + i, at[0] : at[0] + 3] = made.by_point[k, i] * weight[k]
            others[2 * k + i, at[1] : at[1] + 5] = terms[k] * weight[k]
            own[2 * k + i, i * curve.size : (i + 1) * curve.size] = basis[k] * weight[k]
    residual, loose = (made.residual * weight[:, None]).ravel(), np.zeros(others.shape[1])
    loose[3 * points :] = 1e-4
    inverse = la.inv(others.T @ others + np.diag(loose + 1e-12))
    cross = others.T @ own
    matrix = own.T @ own - cross.T @ inverse @ cross
    gradient = own.T @ residual - cross.T @ inverse @ (others.T @ residual)
    # but for what keeps points along parallel rays where they are
    np.testing.assert_allclose(told.matrix, matrix, atol=0.02 * np.abs(matrix).max())
    np.testing.assert_allclose(told.gradient, gradient, atol=0.02 * np.abs(gradient).max())


def test_a_camera_with_the_curve_has_the_slope_of_central_differences() -> None:
    rng = np.random.default_rng(2)
    spline = ColumnSpline(1000, rng.normal(0, 0.5, (28, 2)))
    view = simulate_block(1, 0, num_checks=0, size=(1000, 800)).views[0]
    camera, image = Calibrated(view.sensor, spline), rng.uniform(0, 800, (50, 2))
    ground = camera.localize(image, np.full(50, 200.0))
    seen, slope = camera.project_jacobian(ground)
    step = np.array([2e-7, -1e-7, 0.01])
    moved = camera.project(ground + step) - camera.project(ground - step)
    np.testing.assert_allclose(slope @ (2 * step), moved, atol=1e-4 * np.abs(moved).max())
    np.testing.assert_allclose(seen, image, atol=1e-6)


@pytest.fixture(scope="module")
def sensor() -> Sensor:
    return Sensor.made("polynomials", 4, chips=4, size=SIZE)


@pytest.fixture(scope="module")
def found(sensor: Sensor) -> Learnt:
    return learn(scenes(10, sensor, 7))


@pytest.mark.nightly
def test_curve_steps_and_what_is_said_of_them_are_right(found: Learnt, sensor: Sensor) -> None:
    wrong, said = off(found, sensor, SIZE[0])
    assert np.linalg.norm(wrong) < 0.03
    assert 0.3 < np.linalg.norm(wrong) / np.linalg.norm(said) < 2.5
    near = np.abs(found.curve.edges[:, None] - sensor.edges).min(axis=1)
    assert len(near) >= 2
    assert near.max() < 5.0
    assert (found.gain > 0).all()
    assert 0.5 < found.scatter < 2.0
    assert found.change[1] < 0.0


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["polynomials", "waves"])
def test_heavy_tails_and_curves_of_another_model_are_met(kind: str) -> None:
    line = Sensor.made(kind, 8, chips=3, size=SIZE)
    wrong, said = off(learn(scenes(10, line, 5, tails=True)), line, SIZE[0])
    assert np.linalg.norm(wrong) < 0.05
    assert 0.3 < np.linalg.norm(wrong) / np.linalg.norm(said) < 2.5


@pytest.mark.nightly
def test_a_curve_that_changes_is_dated(sensor: Sensor) -> None:
    other = Sensor(lambda col: sensor.curve(col) + 0.2 * np.cos(col[:, None] / 700.0), sensor.edges)
    at, nats = learn([*scenes(5, sensor, 1), *scenes(4, other, 2)]).change
    assert at == 5
    assert nats > 20.0


@pytest.mark.costs(3)
@pytest.mark.slow
def test_a_block_shows_its_own_curve_whole_and_none_of_another(found: Learnt, sensor: Sensor) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed + 50)
        looks = any_looks(3, rng)
        shown, sigma = share_shown(ties(scene(looks, sensor, rng, 700, size=SIZE)), found.spline)
        assert abs(shown - 1.0) < 5.0 * sigma + 0.1
        assert not contradicts(shown, sigma)
        for name, line in others(sensor, seed, SIZE[0]).items():
            made = scene(looks, line, np.random.default_rng(seed), 700, size=SIZE)
            assert contradicts(*share_shown(ties(made), found.spline)), name


def test_blocks_of_one_curve_scatter_as_their_noise_does() -> None:
    """Of few blocks, too: each is compared with a curve that it is part of."""
    rng, curve = np.random.default_rng(3), LineCurve(SIZE[0], np.zeros(0))
    prior, scatter = curve.prior(1e-2), []
    truth = np.linalg.cholesky(la.inv(prior)) @ rng.normal(size=2 * curve.size)
    for count in 8 * [4] + 8 * [12]:
        told = []
        for _ in range(count):
            rows = rng.normal(size=(300, 2 * curve.size)) * 3.0
            matrix = rows.T @ rows
            told.append(Told(matrix, -matrix @ truth - rows.T @ rng.normal(size=300), 0.0, 300.0))
        scatter.append(_cross_validated(curve, told, prior, 0.1).scatter)
    assert 0.83 < np.mean(scatter[:8]) < 1.2
    assert np.mean(scatter[8:]) == pytest.approx(1.0, abs=0.075)


def test_ties_show_a_curve_as_large_as_it_is_and_how_surely() -> None:
    rng = np.random.default_rng(3)
    curve = ColumnSpline(SIZE[0], rng.normal(0, 0.3, (28, 2)))
    bent = ties(scene(any_looks(3, rng), Sensor(curve.at, curve.edges), rng, 250, size=SIZE))
    straight = ties(scene(any_looks(3, rng), Sensor(lambda col: 0.0 * curve.at(col), curve.edges), rng, 250, size=SIZE))
    shown, sigma = share_shown(bent, curve)
    assert 0.001 < sigma < 0.05
    assert shown == pytest.approx(1.0, abs=5.0 * sigma)
    assert share_shown(bent, replace(curve, coeffs=2.0 * curve.coeffs))[0] == pytest.approx(0.5, abs=0.05)
    shown, sigma = share_shown(straight, curve)
    assert shown == pytest.approx(0.0, abs=5.0 * sigma)


def test_a_curve_is_contradicted_where_much_of_it_is_surely_missing() -> None:
    for shown, sigma, wanted in ((0.52, 0.04, True), (-1.0, 0.2, True), (0.7, 0.1, False), (0.9, 0.001, False),
                                 (1.6, 0.01, False), (0.0, 0.3, False)):  # fmt: skip
        assert contradicts(shown, sigma) == wanted, (shown, sigma)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["polynomials", "waves"])
def test_what_is_said_of_a_curve_is_right_over_many_sensors(kind: str) -> None:
    """Neither less nor more than errors are; one line alone may be off by half."""
    ratio = said(8, kind)
    assert ratio.max() < 1.5  # 1.34 along rows, 0.95 along columns: some three weak modes of each line
    assert ratio.min() > 0.6


def test_blocks_of_other_widths_and_too_few_are_refused() -> None:
    rng = np.random.default_rng(3)
    made = ties(scene(any_looks(2, rng), Sensor.made("waves", 1, size=SIZE), rng, 30, size=SIZE))
    with pytest.raises(InputError, match="2 blocks"):
        learn([made, made])
    with pytest.raises(InputError, match="of 2 widths"):
        learn([made, made, replace(made, width=50)])
    assert learn([made] * 3).curve.width == SIZE[0]  # three are enough


@pytest.mark.nightly
def test_shorter_products_find_their_place_on_the_line() -> None:
    """Cut off somewhere within 88 columns: 25 px is where their middle would put them."""
    rng, sensor, blocks, true = np.random.default_rng(3), Sensor.made("polynomials", 3, chips=4, size=SMALL), [], []
    for i in range(6):
        made = scene(any_looks(3, rng), sensor, rng, 700, size=SMALL)
        line = Line(SMALL[0], np.zeros(3), np.zeros(3))
        if i % 2:
            made, where = parts(made, np.random.default_rng(0), 1.0 - 88 / SMALL[0])
            line = Line(SMALL[0], np.full(3, 44.0), np.full(3, 88 / np.sqrt(12.0)))
            true.append(where.start)
        blocks.append(SensorTies.of("", made.views, made.tracks, made.cameras, made.ground, line))
    found = learn(blocks)
    off = np.array([44.0 + shift for shift in found.shifts[1::2]]) - np.array(true)
    said = np.array(found.shift_sigmas[1::2])
    assert np.sqrt((off**2).mean()) < 15.0
    assert 0.4 < np.sqrt((off**2).mean() / (said**2).mean()) < 2.5
    assert not np.concatenate(found.shifts[::2]).any()
