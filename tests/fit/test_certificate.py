"""What is certified holds: against many points that no fit and no certificate has seen, of models that are not ours."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from barpc.fit import FitOptions, RpcFit, fit_rpc, fit_rpc_points
from barpc.fit.poles import Region, smallest_denominator
from barpc.sensor.rational import monomials
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import SAMPLE_CELLS, Scattered
from tests.costs import once
from tests.fit.cameras import synthetic
from tests.fit.models import FLAT, Bent, bump, hard, pushbroom, quotient, waves
from tests.lanes import rest_slow

EASY = ("wide pushbroom", "frame, k1 0.02", "waves 0.25")  # that are fitted in a moment, one of each kind
HARD = sorted(hard().keys() - EASY)


def truth(name: str, count: int = 100_000, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Ground and image points all over the image and the altitudes."""
    model, size, alt_range = hard()[name]
    rng = np.random.default_rng(seed)
    image = rng.uniform([-0.5, -0.5], np.array(size) - 0.5, (count, 2))
    ground = model.localize(image, rng.uniform(*alt_range, count))
    assert np.isfinite(ground).all()
    return ground, image


@once
def fitted(name: str) -> RpcFit:
    return fit_rpc(*hard()[name], strict=False)


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize("name", [*rest_slow(EASY, keep=2), *rest_slow(HARD, keep=0, mark=pytest.mark.nightly)])
def test_the_largest_error_certified_is_that_of_a_hundred_thousand_points(name):
    fit = fitted(name)
    ground, image = truth(name)
    error = np.abs(fit.rpc.project(ground) - image)
    assert error.max() <= 1.2 * fit.max_ckp.max()
    assert fit.max_ckp.max() <= 2.5 * error.max()  # edges and corners are among its points
    # one point of 2025 may be a bump's only one
    np.testing.assert_allclose(np.sqrt((error**2).mean()), np.sqrt((fit.rmse_ckp**2).mean()), rtol=0.3)
    assert 2000 < fit.num_ckp <= SAMPLE_CELLS**2
    assert fit.beyond == pytest.approx(3.0 / fit.num_ckp, rel=0.01)
    assert (error > fit.max_ckp).any(axis=1).mean() < fit.beyond
    assert fit.min_denominator > 0.1


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("width", "at"),
    [
        (250.0, (0.37, 0.61)),
        (300.0, (0.013, 0.987)),
        pytest.param(250.0, (0.5, 0.5), marks=pytest.mark.slow),
        pytest.param(400.0, (0.99, 0.4), marks=pytest.mark.slow),
    ],
)
def test_a_bump_of_a_fortieth_of_the_image_is_found_wherever_it_is(width, at):
    size = (20000, 20000)
    fit = fit_rpc(Bent(pushbroom(45.0), bump(size, width, 0.5, at)), size, (0.0, 1500.0), strict=False)
    assert 0.37 < fit.max_ckp[0] < 0.55  # in a corner an RPC leans over it
    assert fit.max_ckp[1] < 1e-6


@pytest.mark.landing(3)
@pytest.mark.slow
@pytest.mark.parametrize("cycles", rest_slow([11.0, 0.7, 0.25, 3.0, 23.0, 60.0]))
def test_waves_over_the_rows_are_seen_at_their_height(cycles):
    size = (20000, 20000)
    model = Bent(pushbroom(45.0), waves(size[1], cycles, 0.5))
    fit = fit_rpc(model, size, (0.0, 1500.0), strict=False)
    rng = np.random.default_rng(3)
    image = rng.uniform(0, 1, (50_000, 2)) * size - 0.5
    error = fit.rpc.project(model.localize(image, rng.uniform(0, 1500, len(image)))) - image
    assert np.abs(error).max() <= 1.2 * fit.max_ckp.max()


@pytest.mark.slow
def test_one_bad_node_of_a_grid_of_positions_is_seen():
    size, knots = (20000, 20000), np.linspace(0, 20000, 25)

    def moves(image):
        hats = [
            np.maximum(1 - np.abs(image[..., i] - knots[k]) / (knots[1] - knots[0]), 0) for i, k in ((0, 7), (1, 17))
        ]
        return np.stack([0.0 * hats[0], 2.0 * hats[0] * hats[1]], axis=-1)

    fit = fit_rpc(Bent(pushbroom(45.0), moves), size, (0.0, 1500.0), strict=False)
    assert 1.6 < fit.max_ckp[1] < 2.1


def best_possible(name: str, axis: int, start: RPC) -> float:
    """RMSE [px] of the least squares of y - a / b by scipy, from several starts, on points of its own.

    Denominators below a fifth of their constant cost something, over a quarter more than the box.
    """
    ground, image = truth(name, 4000, 11)
    basis = monomials(start.normalize(ground))
    y = (image[:, axis] - start.image_offset[axis]) / start.image_scale[axis]
    t = np.linspace(-1.25, 1.25, 9)
    around = monomials(np.stack(np.meshgrid(t, t, t)).reshape(3, -1))
    cost = 1e-2 * float(np.ptp(y))

    def residual(x):
        below = np.append(1.0, x[20:])
        pole = cost * np.maximum(0.2 - below @ around, 0.0)
        return np.concatenate([quotient(x, basis) - y, pole])

    def jacobian(x):
        below = np.append(1.0, x[20:])
        value = (x[:20] @ basis) / (below @ basis)
        points = np.vstack([basis, -value * basis[1:]]) / (below @ basis)
        pole = np.where(below @ around < 0.2, -cost * around[1:], 0.0)
        return np.hstack([points, np.vstack([np.zeros_like(around), pole])]).T

    rng, found = np.random.default_rng(2), []
    pair = start.coeffs[2 * axis : 2 * axis + 2] / start.coeffs[2 * axis + 1, 0]
    near = np.concatenate([pair[0], pair[1, 1:]])
    plain = np.concatenate([np.linalg.lstsq(basis.T, y, rcond=None)[0], np.zeros(19)])
    ground, image = truth(name, 30_000, 12)
    fresh = monomials(start.normalize(ground))
    for x in (near, plain, plain + 1e-3 * rng.normal(size=39)):
        end = least_squares(residual, x, jacobian, method="lm", xtol=1e-12, ftol=1e-10, max_nfev=100).x
        below = np.append(1.0, end[20:])
        if Region.box(np.full((3, 2), [-1.25, 1.25])).least(below) > 0.1:
            error = start.image_scale[axis] * quotient(end, fresh) + start.image_offset[axis] - image[:, axis]
            found.append(float(np.sqrt((error**2).mean())))
    return min(found)


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [*rest_slow(EASY[:2]), *rest_slow([*EASY[2:], *HARD], keep=0, mark=pytest.mark.nightly)]
)
def test_no_optimiser_finds_a_better_rpc_without_a_pole(name):
    ground, image = truth(name, 30_000, 12)
    rmse = np.sqrt(((fitted(name).rpc.project(ground) - image) ** 2).mean(axis=0))
    for axis in range(2):
        assert rmse[axis] <= 1.05 * best_possible(name, axis, fitted(name).rpc) + 1e-7


def test_given_points_say_nothing_of_the_rest_of_the_image():
    ground, image = truth("distortion", 400)
    assert fit_rpc_points(ground, image).beyond == 1.0


def test_a_least_value_is_never_above_and_hardly_below_what_a_dense_lattice_finds():
    rng, t = np.random.default_rng(0), np.linspace(0.0, 1.0, 31)
    for _ in range(20):
        cubic = rng.normal(0, 0.3, 20)
        low = rng.uniform(-2, 1, 3)
        box = np.stack([low, low + rng.uniform(0.1, 2.5, 3)], axis=1)
        axes = [a + t * (b - a) for a, b in box]
        value = cubic @ monomials(np.stack(np.meshgrid(*axes, indexing="ij")).reshape(3, -1))
        found = Region.box(box).least(cubic)
        assert value.min() - 0.02 * np.ptp(value) <= found <= value.min() + 1e-12


def test_a_pole_between_the_points_of_a_lattice_is_not_missed():
    """1 - the square of how far x is from 0.13: below zero in a slit that eleven samples a side step over."""
    rpc = synthetic().rpc
    coeffs = rpc.coeffs.copy()
    coeffs[1] = 0.0
    coeffs[1, [0, 1, 7]] = np.array([0.13**2 - 1e-4, -0.26, 1.0]) / (0.13**2 - 1e-4)
    slit = RPC(coeffs, rpc.ground_offset, rpc.ground_scale, rpc.image_offset, rpc.image_scale)
    low, high = rpc.ground_offset - rpc.ground_scale, rpc.ground_offset + rpc.ground_scale
    assert smallest_denominator(slit, low, high) < 0


def test_points_are_all_over_the_image_and_its_altitudes():
    camera = synthetic()
    sample = Scattered.over(camera.model, camera.size, camera.alt_range)
    inside = sample.points[: sample.count]
    cells = np.floor((inside[:, :2] + 0.5) / camera.size * SAMPLE_CELLS).astype(int)
    assert len(np.unique(cells, axis=0)) == SAMPLE_CELLS**2  # one each
    heights = np.sort(inside[:, 2])
    assert max(b - a for a, b in pairwise(heights.tolist())) < 3 * np.ptp(heights) / len(heights)
    corners = {(col, row) for col in (-0.5, 19999.5) for row in (-0.5, 18999.5)}
    assert corners <= {(col, row) for col, row, _ in sample.points.tolist()}
    again = Scattered.over(camera.model, camera.size, camera.alt_range)
    np.testing.assert_array_equal(again.points, sample.points)


def test_an_rpc_without_an_image_point_has_no_largest_error():
    camera = synthetic()
    sample = Scattered.over(camera.model, camera.size, camera.alt_range)

    class Blind:
        def project(self, ground):
            return np.full((len(ground), 2), np.nan)

    assert np.isinf(sample.compare(Blind().project).largest).all()


def test_a_method_that_is_asked_for_is_the_only_one_tried():
    model, size, alt_range = hard()["waves 1"]
    found = {
        m: fit_rpc(model, size, alt_range, options=FitOptions(method=m, tolerance=1.0))
        for m in ("ridge", "gauss-newton")
    }
    assert {name: fit.method for name, fit in found.items()} == {name: name for name in found}
    assert found["gauss-newton"].rmse_ckp.max() < 0.3 * found["ridge"].rmse_ckp.max()
    assert found["gauss-newton"].num_cnp > 5 * found["ridge"].num_cnp


def test_what_was_seen_once_is_seen_again() -> None:
    """A step is narrower than points lie apart: who looks for it with another camera is told where it was seen."""
    sample = Scattered.over(FLAT, (9000, 8000), (0.0, 400.0))

    def read(at: np.ndarray) -> np.ndarray:
        return at[:, :2] + np.where(abs(at[:, :1] - 4321.7) < 1e-3, [[0.09, 0.0]], 1e-6)

    assert sample.compare(read).largest.max() < 1e-5
    there = np.array([[4321.7, 777.0, 55.0]])
    errors = sample.also(there).compare(read)
    np.testing.assert_allclose(errors.largest, [0.09, 1e-6], atol=1e-11)
    np.testing.assert_allclose(errors.worst[0], there[0], atol=1e-9)
    np.testing.assert_allclose(
        errors.rmse, 1e-6, atol=1e-11
    )  # of the points all over the image: the new one is none of them
