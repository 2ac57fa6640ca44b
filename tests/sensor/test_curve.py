"""Curves, rotations and orbits against their plain definitions, to the rounding of their numbers."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
from numpy.polynomial import polynomial

from barpc.base.errors import RpcError
from barpc.sensor.curve import (
    EXTRAPOLATION,
    ORBIT_DEGREES,
    ORBIT_MARGIN,
    Curve,
    Turn,
    _fit_orbit,
    attitude_through,
    fit_orbit,
    rotation_left_jacobian,
)

RNG = np.random.default_rng(0)


def series(w: np.ndarray, first: int) -> np.ndarray:
    """Sum over k of [w]x^k / (k + first)!: the rotation matrix (0), its left Jacobian (1), to rounding."""
    bent = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    out, term = np.zeros((3, 3)), np.eye(3)
    for k in range(1, first + 1):
        term = term / k
    for k in range(first + 1, first + 40):
        out, term = out + term, term @ bent / k
    return out


# every size alone takes the short series or the closed form; together a size below the border takes the long way
SIZES = [0.0, 1e-9, 1e-4, 5e-3, 9.9e-3, 1.01e-2, 0.1, 1.0, 2.5]


@pytest.mark.parametrize("together", [False, True])
def test_a_turn_is_the_exponential_of_its_vector_and_has_its_jacobian(together: bool) -> None:
    way = np.array([0.6, -0.48, 0.64])
    v = RNG.normal(size=(3, 4))
    turns = [Turn(np.outer(way, SIZES))] if together else [Turn(np.outer(way, [s])) for s in SIZES]
    for n, size in enumerate(SIZES):
        turn, column = (turns[0], n) if together else (turns[n], 0)
        for given in v.T:
            many = np.zeros((3, len(SIZES) if together else 1))
            many[:, column] = given
            # R(w + dw) = R(w) R(J(-w) dw)
            expected = series(size * way, 0), series(-size * way, 0), series(-size * way, 1)
            for one, other in zip(turn.back_and_rate(many, 0.0), (turn.back(many), turn.rate(many)), strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-14)
            for found, matrix in zip((turn.forth(many), turn.back(many), turn.rate(many)), expected, strict=True):
                np.testing.assert_allclose(found[:, column], matrix @ given, rtol=0, atol=4e-16 * (2 + 10 * size))
    for size in SIZES[1:-1]:
        np.testing.assert_allclose(rotation_left_jacobian(size * way), series(size * way, 1), rtol=0, atol=2e-15)


# --- orbits --------------------------------------------------------------------------------------------------

ORBIT = np.array(
    [
        [7.0e6, 1e5, -2e5],
        [-300.0, 7400.0, 900.0],
        [-3.9, -0.1, 0.2],
        [5e-5, -1.3e-3, -1e-4],
        [3e-7, 2e-9, 1e-8],
    ]
)


def vectors(time: np.ndarray, sigma: tuple[float, float, float] = (0.0, 0.0, 0.0), seed: int = 0):
    """Positions and velocities of a quartic; errors along and across the track [m] and of velocities [m/s]."""
    position, velocity = (polynomial.polyval(time, c).T for c in (ORBIT, polynomial.polyder(ORBIT)))
    rng = np.random.default_rng(seed)
    along = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    error = rng.normal(size=position.shape)
    parts = (error * along).sum(axis=1, keepdims=True) * along
    noisy = position + sigma[0] * parts + sigma[1] * (error - parts)
    return noisy, velocity + sigma[2] * rng.normal(size=velocity.shape)


@pytest.mark.few(1)
@pytest.mark.parametrize(("count", "degree"), [(12, 5), (9, 4), (20, 8)])
def test_standard_deviations_of_state_vectors_are_found_as_large_as_they_are(count: int, degree: int) -> None:
    time, true = np.linspace(-60, 60, count), (3e-3, 8e-4, 2e-3)
    found = [_fit_orbit(time, *vectors(time, true, seed), degree).sigma for seed in range(40)]
    ratio = np.mean(np.square(found), axis=0) / np.square(true)
    # of an orbit's 6 N numbers; which of them the unknowns take up is shared evenly
    assert ratio @ [1, 2, 3] / 6 == pytest.approx(1.0, abs=0.06)
    assert (np.abs(np.sqrt(ratio) - 1.0) < 0.3).all()


def test_what_is_known_better_counts_more() -> None:
    """Positions across the track to 0.1 mm beside poor velocities, and the other way round."""
    time, between = np.linspace(-60, 60, 13), np.linspace(-50, 50, 30)
    for sigma, bounds in (((1e-4, 1e-4, 0.1), (4e-4, 0.05)), ((0.3, 0.3, 1e-5), (0.4, 5e-4))):
        miss = []
        for seed in range(5):
            orbit = fit_orbit(time, *vectors(time, sigma, seed), (-5.0, 5.0))
            exact = vectors(between)
            miss.append([np.abs(f.T - e).max() for f, e in zip(orbit(between), exact, strict=True)])
        assert (np.median(miss, axis=0) < bounds).all()


def test_the_degree_is_the_lowest_that_serves() -> None:
    time = np.linspace(-60, 60, 17)
    position, velocity = vectors(time, (1e-5, 1e-5, 1e-5))
    assert fit_orbit(time, position, velocity, (0.0, 5.0)).coeffs.shape[1] - 1 == 5
    sway = 0.5 * np.array([0.3, -0.5, 0.8])
    fast = sway * np.sin(2 * np.pi * time / 60)[:, None]
    rate = sway * 2 * np.pi / 60 * np.cos(2 * np.pi * time / 60)[:, None]
    degree = fit_orbit(time, position + fast, velocity + rate, (0.0, 5.0)).coeffs.shape[1] - 1
    assert 7 <= degree <= ORBIT_DEGREES[-1]


def test_state_vectors_near_the_image_take_part_and_no_others() -> None:
    time = np.arange(-100.0, 130.0, 10.0)
    position, velocity = vectors(time)
    window = (0.0, 30.0)
    far = (time < window[0] - ORBIT_MARGIN) | (time > window[1] + ORBIT_MARGIN)
    assert far.sum() == 5
    orbit = fit_orbit(time, position, velocity, window)
    assert fit_orbit(time, position + 1e4 * far[:, None], velocity, window) == orbit
    assert orbit.knots.tolist() == [-70.0, 100.0]
    for k in np.flatnonzero(~far)[[0, -1]]:
        moved = position.copy()
        moved[k] += 0.1
        assert fit_orbit(time, moved, velocity, window) != orbit


@pytest.mark.parametrize(
    ("window", "ok"),
    [
        ((-0.9, 20.0), True),
        ((-1.1, 20.0), False),
        ((20.0, 60.9), True),
        ((20.0, 61.1), False),
        ((-0.9, 60.9), True),
    ],
)
def test_an_orbit_is_believed_for_a_second_beyond_its_vectors(window, ok: bool) -> None:
    time = np.arange(0.0, 61.0, 10.0)
    if ok:
        assert fit_orbit(time, *vectors(time), window).span == (-EXTRAPOLATION, 60.0 + EXTRAPOLATION)
    else:
        with pytest.raises(RpcError, match=r"the image lasts from .* the state vectors from 0\.0 to 60\.0 s"):
            fit_orbit(time, *vectors(time), window)


@pytest.mark.parametrize(("count", "ok"), [(3, False), (4, True)])
def test_an_orbit_needs_four_vectors(count: int, ok: bool) -> None:
    time = 10.0 * np.arange(count)
    position, velocity = vectors(time)
    with nullcontext() if ok else pytest.raises(RpcError, match="3 state vectors within 70 s"):
        orbit = fit_orbit(time, position, velocity, (0.0, 5.0))
        assert orbit.coeffs.shape[1] - 1 == 4  # no degree higher than there are vectors
        np.testing.assert_allclose(orbit(time)[0].T, position, atol=1e-4)


@pytest.mark.few(1)
@pytest.mark.parametrize(("scatter", "ok"), [(0.5, True), (2.0, False)])
def test_vectors_that_scatter_by_more_than_a_metre_are_no_orbit(scatter: float, ok: bool) -> None:
    time = np.linspace(-60, 60, 25)
    for sigma in ((scatter, 0.0, 1e-4), (0.0, scatter, 1e-4)):
        given = vectors(time, sigma)
        with nullcontext() if ok else pytest.raises(RpcError, match="scatter"):
            assert fit_orbit(time, *given, (0.0, 5.0)).sigma.max() == pytest.approx(scatter, rel=0.4)


# --- curves --------------------------------------------------------------------------------------------------


def test_samples_that_do_not_belong_to_a_curve_are_refused() -> None:
    time, values = np.arange(4.0), np.zeros((4, 3))
    assert Curve.through(time, values)(np.array([1.5]))[0].tolist() == [[0.0]] * 3
    for wrong in (
        (time[:, None], values), (time[:1], values[:1]), (time, values[:3]), (time, np.zeros((4, 2))),
        (time[[0, 2, 1, 3]], values), (time[[0, 1, 1, 3]], values), (time, np.where(values == 0, np.nan, 0.0)),
        (np.array([0.0, 1.0, 2.0, np.inf]), values),
    ):  # fmt: skip
        with pytest.raises(RpcError, match="curve"):
            Curve.through(*wrong)


def test_an_attitude_may_turn_by_two_radians_from_its_middle() -> None:
    time = np.arange(5.0)

    def turned(angle: float) -> np.ndarray:
        angles = np.linspace(-angle, angle, 5)
        return np.column_stack([np.cos(angles / 2), 0 * angles, np.sin(angles / 2), 0 * angles])

    mount, curve = attitude_through(time, turned(1.9))
    np.testing.assert_allclose(mount, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(curve(time)[0], [[0] * 5, np.linspace(-1.9, 1.9, 5), [0] * 5], atol=1e-12)
    with pytest.raises(RpcError, match="more than 2 rad"):
        attitude_through(time, turned(2.1))
    for wrong in (turned(1.0)[:, :3], turned(1.0)[0], 0 * turned(1.0), np.where(time[:, None] == 3, 0.0, turned(1.0)),
                  turned(np.nan)):  # fmt: skip
        with pytest.raises(RpcError, match="quaternions"):
            attitude_through(time, wrong)
