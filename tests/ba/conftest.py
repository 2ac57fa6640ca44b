"""Blocks of simulated views, and how they are adjusted in the tests."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeVar
from unittest import mock

import numpy as np
import pytest

from barpc import simulate
from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.ba.constraints.block import first_state, join, make_problem
from barpc.ba.constraints.ground import PointConstraints
from barpc.ba.parameters.priors import PointPrior
from barpc.ba.robust.variances import Variances
from barpc.ba.robust.weights import Observations
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import Minimum, minimise
from barpc.fit import fit_rpc
from barpc.scene import GroundPoints, Terrain, Tracks
from barpc.simulate import SimulatedBlock, simulate_block
from tests.constants import chosen

Observed = TypeVar("Observed", Tracks, GroundPoints)

INDEPENDENT = {"noise_floor": 0.0, "sigma_attitude": 10.4, "sigma_position": 1.0, "min_convergence": 0.01}
"""What simulated blocks are: white noise, 15 urad at 694 km, 1 m."""


def centers_of(block: SimulatedBlock) -> np.ndarray:
    """The camera centres that the block was made with."""
    return np.array([correction.center for correction in block.truth.corrections])


def solve(block: SimulatedBlock, **options: Any) -> Adjustment:
    """The block adjusted with priors that are true of it."""
    hold_out = options.pop("hold_out", True)
    with chosen(AdjustOptions, **{**INDEPENDENT, **options}) as given:
        return adjust_tracks(block.views, block.tracks, given, centers=centers_of(block), hold_out=hold_out)


def least_squares(
    block: SimulatedBlock, options: AdjustOptions, noise: float = 1.0, dem: Terrain | None = None
) -> tuple[Problem, Minimum]:
    """All observations by their sigmas times `noise`, once: what moves these moves the solution in proportion."""
    joined = join(block.views, block.tracks, None, options)
    problem = make_problem(joined, options, centers_of(block), None)
    with as_stated():
        state, heights = first_state(problem, joined, options, dem)
        for _ in range(2):  # heights are held where points end
            problem = heights.hold(problem, state.points)
            minimum = minimise(problem, state, 1.0 / (noise * joined.sigma), options.solver, 1e-12)
            state = minimum.state
    return problem, minimum


@contextmanager
def as_stated() -> Iterator[None]:
    """Priors and DEMs count as they are stated."""
    with mock.patch.object(Variances, "learns", False), mock.patch.object(PointConstraints, "is_judged", False):
        yield


@contextmanager
def of_noise_as_stated() -> Iterator[None]:
    """Observations count as they are stated, and none is cut."""
    with mock.patch.object(Observations, "noise", return_value=1.0), chosen(AdjustOptions, robust_threshold=99.0):
        yield


@pytest.fixture(scope="session", autouse=True)
def _delivered() -> Iterator[None]:
    """The RPC that a simulated camera is delivered with is fitted once, in whichever blocks it flies."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "fit_rpc", cache(fit_rpc))
        yield


@pytest.fixture(scope="session")
def block() -> SimulatedBlock:
    """Ten views, 2000 tie points, noise of a tenth of a pixel."""
    return simulate_block(10, 2000, seed=11)


@pytest.fixture(scope="session")
def adjusted(block: SimulatedBlock) -> Adjustment:
    """`block`, adjusted."""
    return solve(block)


def seen(
    given: Observed, ground: np.ndarray, sensors: Iterable[Any], seed: int | np.random.Generator, noise: float = 0.05
) -> Observed:
    """The observations where sensors show ground points (P, 3), with noise [px]."""
    xy = np.random.default_rng(seed).normal(0.0, noise, given.xy.shape)
    for v, sensor in enumerate(sensors):
        rows = given.view == v
        xy[rows] += sensor.project(ground[given.point[rows]])
    return replace(given, xy=xy)


@dataclass(frozen=True)
class Held:
    """What `PointConstraints.hold` gives its priors to."""

    point_prior: Any = None


def held_by(given: PointConstraints, points: np.ndarray) -> PointPrior:
    problem: Any = Held()
    prior = given.hold(problem, points).point_prior
    assert prior is not None
    return prior
