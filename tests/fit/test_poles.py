"""Denominators over the image's own ground: bounded, no smaller than they may be, and no farther up than they must."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

from barpc.base.geodesy import Array
from barpc.fit import FitOptions, RpcFit, fit_rpc
from barpc.fit.poles import MIN_DENOMINATOR_RATIO, Region, bounded
from barpc.fit.system import TriangularSystem
from barpc.sensor.rpc import RPC
from tests.costs import once
from tests.fit.models import Bent, pushbroom, quotient

ALL = np.arange(20)

SIZE, ALTS = (20000, 20000), (0.0, 1500.0)


def detector(rate: float) -> Bent:
    """A detector whose columns lie off by 20 px exp(rate (u - 1)), u from 0 to 1 across it: smooth, and no cubic."""

    def moves(image):
        off = 20.0 * np.exp(rate * (image[..., 0] / SIZE[0] - 1.0))
        return np.stack([off, 0.0 * off], axis=-1)

    return Bent(pushbroom(45.0), moves)


@once
def fitted(rate: float, margin: float = 0.25) -> RpcFit:
    return fit_rpc(detector(rate), SIZE, ALTS, options=FitOptions(pole_margin=margin), strict=False)


def terms(x: Array) -> Array:
    """The twenty terms of RPC00B (20, N), written out, at normalised lon, lat, alt (N, 3)."""
    a, b, c = x.T
    return np.stack(
        [
            *(a**0, a, b, c, a * b, a * c, b * c, a * a, b * b, c * c, a * b * c, a**3, a * b * b, a * c * c),
            *(a * a * b, b**3, b * c * c, a * a * c, b * b * c, c**3),
        ]
    )


def spread(model, count: int, margin: float, rpc: RPC, seed: int = 7) -> Array:
    """Normalised ground (N, 3) at random over image and altitudes, moved away from its middle by a margin."""
    rng = np.random.default_rng(seed)
    image = rng.uniform(0, 1, (count, 2))
    image[: count // 2] = np.rint(image[: count // 2])  # corners
    image[count // 4 : count // 2, 0] = rng.uniform(0, 1, count // 2 - count // 4)  # and edges
    ground = model.localize(image * SIZE - 0.5, rng.choice([*ALTS, 400.0], count))
    x = (ground - rpc.ground_offset) / rpc.ground_scale
    middle = 0.5 * (x.min(axis=0) + x.max(axis=0))
    return middle + (1.0 + margin) * (x - middle)


@pytest.mark.parametrize(
    ("rate", "before", "wanted"),
    # the RMSE [px] under the rule of a box in lon, lat and alt and 25 % around it, and that of least squares
    [(6.0, 9.7e-3, 3.4e-4), pytest.param(8.0, 0.131, 1.1e-3, marks=pytest.mark.slow)],
)
def test_a_smooth_detector_is_followed_as_least_squares_follow_it(rate, before, wanted):
    fit = fitted(rate)
    rng = np.random.default_rng(3)
    image = rng.uniform(0, 1, (4000, 2)) * SIZE - 0.5
    ground = detector(rate).localize(image, rng.uniform(*ALTS, 4000))
    x = (ground - fit.rpc.ground_offset) / fit.rpc.ground_scale
    basis, y = terms(x), (image[:, 0] - fit.rpc.image_offset[0]) / fit.rpc.image_scale[0]

    start = np.concatenate([np.linalg.lstsq(basis.T, y, rcond=None)[0], np.zeros(19)])
    least = least_squares(lambda x: quotient(x, basis) - y, start, method="lm", max_nfev=20_000)
    best = np.sqrt((least.fun**2).mean())
    rmse = np.sqrt(((fit.rpc.project(ground) - image)[:, 0] ** 2).mean())
    assert rmse <= 1.05 * best * fit.rpc.image_scale[0]
    assert rmse < wanted < before / 20


@pytest.mark.parametrize(
    ("rate", "margin"),
    [(12.0, 0.0), *(pytest.param(*row, marks=pytest.mark.slow) for row in ((12.0, 0.25), (8.0, 0.6)))],
)
def test_no_denominator_is_small_over_the_image_and_its_margin(rate, margin):
    fit = fitted(rate, margin)
    x = spread(detector(rate), 20_000, margin, fit.rpc)
    below = fit.rpc.coeffs[1::2] @ terms(x)
    assert below.min() >= MIN_DENOMINATOR_RATIO - 1e-4  # the middle of these points is not quite that of the fit's
    middle = fit.rpc.coeffs[1::2] @ terms(0.5 * (x.min(axis=0) + x.max(axis=0))[None])
    assert MIN_DENOMINATOR_RATIO * 0.9 < fit.min_denominator <= (below / middle).min() + 1e-4
    assert (below / middle).min() < 1.6 * MIN_DENOMINATOR_RATIO  # what binds is there, and not far outside


def test_a_region_is_the_images_own_ground_and_not_the_box_around_it():
    """An image that stands at 45 degrees: a cubic that is negative in the corners of the box is not so over it."""
    u = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    u[:8] = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    turn = np.array([[0.5, 0.5], [-0.5, 0.5]])
    ground = np.column_stack([u[:, :2] @ turn, u[:, 2]])
    cubic = np.eye(20)[0] - 0.6 * np.eye(20)[4]  # 1 - 0.6 x y: 0.4 in a corner of the box, 0.85 at the image's edge
    for margin, least in ((0.0, 0.85), (0.25, 1 - 0.15 * 1.25**2), (1.0, 0.4)):
        assert Region.around(ground, u[:, :2], margin).least(cubic) == pytest.approx(least, abs=0.01)
    assert Region.box(np.array([[-1.0, 1.0]] * 3)).least(cubic) == pytest.approx(0.4)
    round_ = u[np.hypot(u[:, 0], u[:, 1]) < 1.0]  # a round image: corners of its square are not its own
    ground = round_ * [1.0, 1.0, 1.0]
    assert Region.around(ground, round_[:, :2], 0.0).least(cubic) > 0.5 > 0.4


@pytest.mark.slow
def test_a_bounded_least_squares_is_that_of_another_solver():
    rng = np.random.default_rng(4)
    region = Region.box(np.array([[-1.0, 1.0]] * 3))
    rows = rng.normal(size=(80, 39)) / 10
    want = np.concatenate([rng.normal(size=20), rng.normal(0, 0.4, 19)])
    triangle = np.triu(np.linalg.qr(np.column_stack([rows, rows @ want]), mode="complete")[1][:40])
    system = TriangularSystem(triangle, 80)
    found = bounded(system, region, ALL)
    least = region.bernstein(np.append(1.0, found[20:])).min()
    assert least == pytest.approx(MIN_DENOMINATOR_RATIO, abs=1e-6)
    lines = region.rows(np.arange(len(region.bernstein(np.eye(20)[0]))))

    def cost(x):
        return float(((rows @ (x - want)) ** 2).sum())

    bound = {
        "type": "ineq",
        "fun": lambda x: ((lines - MIN_DENOMINATOR_RATIO * region.there[0]) @ np.append(1.0, x[20:]))[::7],
    }
    other = minimize(
        cost,
        np.zeros(39),
        jac=lambda x: 2 * rows.T @ (rows @ (x - want)),
        constraints=bound,
        method="SLSQP",
        options={"ftol": 1e-12, "maxiter": 300},
    )
    assert cost(found) >= other.fun - 1e-6  # which is held to every seventh bound only
    assert cost(found) <= 1.1 * other.fun + 1e-6
    free = TriangularSystem(np.triu(np.linalg.qr(np.column_stack([rows, rows @ (0.1 * want)]))[1]), 80)
    np.testing.assert_allclose(bounded(free, region, ALL), 0.1 * want, atol=1e-9)  # within the bound: as it is
