"""What is off along the lines of sight - turns, and scale - against what is off in place: who is widened, who blamed.

Cameras and errors are those of `benchmarks/worlds_cameras.py`, which share no code with the simulator here.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from barpc.ba import Adjustment, adjust_tracks
from barpc.ba.parameters.priors import CameraPrior
from barpc.base.errors import BarpcWarning
from benchmarks.worlds import judge
from benchmarks.worlds_families import PRIOR, draw, fly
from tests.lanes import known

Array = Any


@dataclass(frozen=True)
class Ended:
    """An adjusted world: the result, what is left at check points [px], mean of the squared errors over those said."""

    found: Adjustment
    left: float
    nees: float


def ended(
    seed: int, views: int, place: float, turn: float, heavy: bool, alike: bool = False, wrong: int | None = None
) -> Ended:
    """Cameras that are off by `place` [m] in attitude and in position, or one of them, and by turns [rad], or `alike`,
    which their scale is then, too.
    """
    rng = np.random.default_rng([seed, 11])
    plan = draw(rng, views, side=(6000, 9000))
    plan.tracks = 800
    if heavy:
        plan.tails, plan.bias = 4.0, (0.04, 12)
    for v, look in enumerate(plan.looks):
        metres = plan.altitude / np.cos(np.radians(np.hypot(look.pitch, look.roll)))
        off = place if wrong in (None, v) else PRIOR / 2
        attitude = np.append(rng.normal(0, off / metres, 2), turn if alike else turn * rng.normal())
        scale = turn if alike else 0.0
        plan.flaw(v, attitude=attitude, place=rng.normal(0, off, 3), focal=scale, rate=scale)
    world = fly(plan, "turns", seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BarpcWarning)
        found = adjust_tracks(world.views, world.tracks)
    told = judge(world, found.sensors)
    return Ended(found, told.left, float(np.mean((np.array(told.move) / found.gauge.sigma) ** 2)))


@pytest.mark.nightly
@pytest.mark.parametrize(("turn", "alike"), [(60e-6, False), (-2.5e-3, True)])
@pytest.mark.parametrize("heavy", [True, False])
def test_turns_that_ties_see_say_nothing_of_the_place(
    turn: float, alike: bool, heavy: bool, request: pytest.FixtureRequest
) -> None:
    """Of cameras whose place is as stated: nobody is blamed, no affine taken, and the place as well known as before."""
    if heavy and alike:
        request.applymarker(
            known("one of four blocks says half the uncertainty of the place that it says without turns")
        )
    nees, turned = [], []
    for seed, views in enumerate((3, 4, 6, 8)):
        plain, one = (ended(seed, views, PRIOR, t, heavy, alike) for t in (0.0, turn))
        assert one.found.apart is None
        assert not one.found.prior.odd.any()
        assert one.found.in_space_rms is None
        assert one.found.prior.scale.min() < 1.2 * plain.found.prior.scale.min()
        assert one.left < max(1.5 * plain.left, 0.1)
        np.testing.assert_allclose(one.found.gauge.sigma, plain.found.gauge.sigma, rtol=0.3)
        nees.append(one.nees)
        turned.append(one.found.prior.wide[-1] * PRIOR / np.abs(turn) / one.found.cameras.unknowns.distance.mean())
    assert 0.15 < np.mean(nees) < 3.0
    assert alike or 0.2 < np.mean(turned) < 2.0  # as large as they are: but a move along the line is none


@pytest.mark.nightly
@pytest.mark.parametrize("times", [8.0, 25.0])
@pytest.mark.parametrize("turns", [True, False])
def test_cameras_that_are_all_worse_than_stated_are_said_to_be_and_none_is_blamed(times: float, turns: bool) -> None:
    """Whether their turns are as bad as their places or not."""
    nees = []
    for seed, views in ((100, 3), (101, 3), (102, 3), (105, 3), (103, 4), (104, 6), (106, 12)):
        one = ended(seed, views, times * PRIOR, times * PRIOR / 6e5 if turns else 2e-6, heavy=True)
        assert one.found.apart is None
        assert not one.found.prior.odd.any()
        assert 0.25 * times < one.found.prior.scale.min() < 5.0 * times
        nees.append(one.nees)
    assert 0.15 < np.mean(nees) < 3.0


@pytest.mark.landing(1)
@pytest.mark.few(1)
@pytest.mark.parametrize("views", [4, 6, 12])
def test_one_that_is_far_off_among_others_that_hold_is_named(views: int) -> None:
    one = ended(7, views, 40.0 * PRIOR, 2e-6, heavy=True, wrong=1)
    odd = np.flatnonzero(one.found.prior.odd).tolist()
    assert odd == [1] or (one.found.apart is not None and one.found.apart.views == (1,))
    np.testing.assert_array_equal(np.delete(one.found.prior.scale, 1), 1.0)


def test_what_is_wider_along_a_line_is_as_wide_in_no_other_direction() -> None:
    """Whitened residuals and information, against the covariance by hand; the loosest holds no direction more."""
    rng = np.random.default_rng(0)
    line = rng.normal(size=3)
    line /= np.linalg.norm(line)
    sight = np.zeros((2, 9))
    sight[0, :3] = line  # the second view has none, as a radar
    sigma = np.repeat(rng.uniform(1, 5, (2, 3)), 3, axis=1)
    prior = CameraPrior(rng.normal(size=(2, 9)), sigma, sight, np.array([[7.0], [4.0]]))
    along = np.kron(np.diag([1.0, 0.0, 0.0]), np.outer(line, line))
    covariance = np.diag(sigma[0]) @ (np.eye(9) + (7.0**2 - 1.0) * along) @ np.diag(sigma[0])
    np.testing.assert_allclose(prior.precision()[0], np.linalg.inv(covariance), atol=1e-12)
    np.testing.assert_allclose(prior.precision()[1], np.diag(sigma[1] ** -2.0), atol=1e-12)
    params = rng.normal(size=(2, 9))
    off = params - prior.mean
    wanted = np.einsum("nq,nqk,nk->n", off, prior.precision(), off)
    np.testing.assert_allclose((prior.residual(params) ** 2).sum(axis=1), wanted)
    loosest = np.diag(prior.loosest()[0] ** 2)
    assert np.linalg.eigvalsh(loosest - covariance).min() > -1e-9
    np.testing.assert_array_equal(replace(prior, wider=1.0).loosest(), sigma)
