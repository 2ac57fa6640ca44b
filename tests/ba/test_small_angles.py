"""Pairs whose rays meet under about the least angle: what is said of the scene's height must hold, and go on smoothly.

The cameras are pushbrooms that are rolled, their errors those of attitude and position, their RPCs fits to them.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.base.errors import BarpcWarning
from barpc.base.geodesy import Array, ground_from_ecef
from barpc.fit import fit_rpc
from barpc.scene import Tracks, View
from barpc.sensor.corrected import Corrected, Correction
from barpc.simulate import Look, fly
from tests.costs import once
from tests.everywhere import tied
from tests.lanes import known

ATTITUDE, POSITION, NOISE, SIZE = 5e-6, 2.0, 0.3, (10_000, 10_000)
TARGET = np.array([5.5, 44.5, 900.0])
RANGE = (500.0, 1500.0)  # the terrain's mean is 100 m below its middle
TRUE_PRIORS = {"sigma_attitude": ATTITUDE * 694e3, "sigma_position": POSITION}


def relief(lon: Array, lat: Array) -> Array:
    """Altitudes [m] of ridges and valleys, some 200 m up and down."""
    east, north = (lon - TARGET[0]) * 79e3, (lat - TARGET[1]) * 111e3
    return 900.0 + 150.0 * np.sin(east / 900.0 + north / 2100.0) + 60.0 * np.cos(north / 300.0) * np.sin(east / 410.0)


@once
def pair(angle: float, seed: int, num: int = 1200) -> tuple[tuple[View, ...], Tracks, Array]:
    """Two views under an angle [deg], their tracks and where these are, lon, lat, alt (P, 3)."""
    rng = np.random.default_rng(seed)
    nearer = rng.uniform(1.0, 10.0)
    views, true = [], []
    for k, incidence in enumerate((nearer, nearer + angle)):
        camera = fly(TARGET, Look(incidence, 102.0), SIZE, 0.7)
        rpc = fit_rpc(camera, size=SIZE, alt_range=RANGE).rpc
        center = camera.position(0.5 * SIZE[1])
        off = Correction(rng.normal(0, ATTITUDE, 3), rng.normal(0, POSITION, 3), center)
        true.append(Corrected(rpc, off))
        views.append(View(f"view_{k}", "", SIZE, rpc, RANGE))
    lon, lat = TARGET[:2, None] + rng.uniform(-0.025, 0.025, (2, num))
    ground = np.column_stack([lon, lat, relief(lon, lat)])
    xy = np.stack([camera.project(ground) + rng.normal(0, NOISE, (num, 2)) for camera in true], axis=1)
    return tuple(views), tied(xy, NOISE), ground


def height(angle: float, seed: int, **options: float) -> tuple[float, float, Adjustment]:
    """How far up the scene ends off, and what is said of that [m]."""
    views, tracks, ground = pair(angle, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BarpcWarning)  # tracks are constrained in height
        found = adjust_tracks(views, tracks, AdjustOptions(**options))
    up = ground_from_ecef(found.points)[:, 2] - ground[:, 2]
    return float(np.nanmedian(up)), float(found.gauge.sigma[2]), found


@pytest.mark.nightly
@pytest.mark.parametrize("angle", [1.0, 0.3, 0.9, 0.95, 0.99, 1.01, 1.05, 1.1])
def test_what_is_said_of_the_height_holds_on_both_sides_of_the_least_angle(angle: float) -> None:
    """Under priors that are true, over five blocks; with the least angle some tracks are on either side of it."""
    ends = [height(angle, seed, **TRUE_PRIORS) for seed in range(5)]
    z = np.array([off / said for off, said, _ in ends])
    assert np.abs(z).max() < 3.0
    assert 0.15 < np.sqrt(np.mean(z**2)) < 1.7
    held = np.mean([found.held.mean() for *_, found in ends])
    assert (0.02 < held < 0.98) if angle == 1.0 else held == (0.0 if angle > 1.0 else pytest.approx(0.9, abs=0.1))


@pytest.mark.nightly
def test_what_is_said_of_the_height_goes_on_smoothly_through_the_least_angle() -> None:
    for options in ({}, TRUE_PRIORS):
        said = [height(angle, 0, **options)[1] for angle in (0.9, 0.95, 0.99, 1.0, 1.01, 1.05, 1.1)]
        steps = np.array(said[1:]) / said[:-1]
        assert (steps > 0.8).all()
        assert (steps < 1.35).all()  # above it the range of altitudes, 1000 m here, is not what tells: sqrt(1 + 0.85^2)


@pytest.mark.nightly
@pytest.mark.parametrize("angle", [pytest.param(0.02, marks=known("1076 m are said of a range of 1000 m")), 0.2])
def test_images_of_one_direction_are_known_within_the_range_of_their_altitudes(angle: float) -> None:
    """Rays tell nothing there, and nobody else does: not that tracks lie in the middle of that range."""
    off, said, found = height(angle, 1)
    assert abs(off) < said
    assert 500.0 < said <= 1000.0
    assert np.abs(found.residuals[found.inlier]).max() < 5 * NOISE
