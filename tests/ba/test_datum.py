"""What holds the scene is told by its name, in shares that add up; sizes against a dense solution: test_oracle.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks, block_prior
from barpc.ba.constraints.gauge import SOURCES
from barpc.base.geodesy import enu_basis, ground_from_ecef
from barpc.report import Run, summarize
from barpc.scene import GroundPoints
from barpc.simulate import simulate_block
from tests.ba.conftest import INDEPENDENT, as_stated, centers_of
from tests.ba.test_uncertainty import _divided

BLOCK = simulate_block(4, 400, seed=4, num_gcps=6, alt_range=(200.0, 260.0))
OPTIONS = AdjustOptions(**INDEPENDENT)
PLACE = slice(0, 3)  # east, north, up


def level(lon, lat):
    return np.full(len(lon), 230.0)


def solved(gcps: GroundPoints | None = None, **more):
    dem, hold_out = more.pop("dem", None), more.pop("hold_out", True)
    options = replace(OPTIONS, **more)
    return adjust_tracks(BLOCK.views, BLOCK.tracks, options, gcps, dem, centers=centers_of(BLOCK), hold_out=hold_out)


def test_without_control_the_cameras_as_delivered_hold_the_scene():
    found = solved()
    assert set(found.datum) == set(SOURCES)
    np.testing.assert_allclose(sum(found.datum.values()), 1.0, atol=1e-9)
    assert (found.datum["cameras"][PLACE] > 0.99).all()
    for other in ("earlier_run", "fixed_views", "gcps", "heights"):
        assert (found.datum[other] == 0.0).all()


def test_control_points_hold_the_scene_which_is_the_tie_points():
    found = solved(replace(BLOCK.gcps, sigma=np.full((6, 3), 0.1)))
    assert (found.datum["gcps"][PLACE] > 0.93).all()
    for other in ("heights", "reference", "altimetry", "fixed_views", "earlier_run"):
        assert (found.datum[other] == 0.0).all()
    ties = found.points[np.isfinite(found.points[:, 0])]
    middle = ties.mean(axis=0)
    flat = (ties - middle) @ enu_basis(ground_from_ecef(middle))[:2].T
    assert found.gauge.radius == pytest.approx(np.sqrt((flat**2).sum(axis=1).mean()), rel=0.02)  # of those in use


@as_stated()
def test_heights_hold_as_much_as_they_take_from_the_variance_of_the_place():
    """Of 300 m each, and hardly any in common: together they know the height about as well as the cameras do."""
    alone = solved()
    found = solved(dem=level, dem_sigma=300.0, dem_bias_sigma=0.1)
    taken = 1.0 - (found.gauge.sigma[2] / alone.gauge.sigma[2]) ** 2
    assert 0.3 < taken < 0.9
    assert found.datum["heights"][2] == pytest.approx(taken, abs=0.02)


def test_an_earlier_run_holds_the_views_that_are_added():
    old, new, _ = _divided(BLOCK, 3)
    centers = centers_of(BLOCK)
    first = adjust_tracks(BLOCK.views[:3], old, OPTIONS, centers=centers[:3])
    both = adjust_tracks(BLOCK.views, new, OPTIONS, centers=centers, prior=block_prior(first))
    assert (both.datum["earlier_run"][PLACE] > 0.5).all()
    np.testing.assert_allclose(sum(both.datum.values()), 1.0, atol=1e-6)


@pytest.mark.slow
def test_the_summary_has_it_in_a_table_without_the_sources_that_tell_nothing():
    gcps = replace(BLOCK.gcps, sigma=np.full((6, 3), 0.2))
    found = solved(gcps)
    summary = summarize(Run("adjust", BLOCK.views, (), BLOCK.tracks, adjustment=found, gcps=gcps))
    assert [entry.part for entry in summary.scene.datum] == [
        "east", "north", "up", "tilt east", "tilt north", "turn", "scale", "twist", "bend east", "bend north"
    ]  # fmt: skip
    for m, entry in enumerate(summary.scene.datum):
        assert entry.sigma_m == pytest.approx(found.gauge.motion_sigma[m])
        for source in SOURCES:
            assert getattr(entry, source) == pytest.approx(found.datum[source][m])
    columns = type(entry).columns(summary.scene.datum).split()
    assert "gcps" in columns
    assert not {"earlier_run", "fixed_views", "heights"} & set(columns)


NOWHERE = "the DEM has no height where one is needed"
HELD = "DEM heights constrain 400 of 400 used tie points"
ASSUMED = "DEM accuracy assumed: 20 m shared by all points, 10 m each; measured: the tie points lie "


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("options", "dem", "says"),
    [
        ({}, level, ASSUMED),
        pytest.param({"min_convergence": 90.0}, level, HELD, marks=pytest.mark.slow),
        pytest.param({}, lambda lon, lat: np.full(len(lon), np.nan), NOWHERE, marks=pytest.mark.slow),
    ],
)
@pytest.mark.filterwarnings("ignore::barpc.BarpcWarning")
@as_stated()
def test_what_a_terrain_did_is_said(options, dem, says):
    found = solved(dem=dem, hold_out=False, **options)
    summary = summarize(Run("adjust", BLOCK.views, (), BLOCK.tracks, adjustment=found))
    assert any(says in line for line in summary.verdict), summary.verdict
    if dem is level:
        assert f"{HELD}." in summary.verdict
        assert summary.scene.dem.num_known == summary.scene.dem.num_tracks
        assert summary.scene.dem.offset_m == pytest.approx(found.terrain.offset)
        assert abs(summary.scene.dem.offset_m) < 60.0
        assert found.datum["heights"][2] > 0.5


@as_stated()
def test_the_scene_lies_above_a_terrain_that_is_too_low():
    low, high = (
        solved(dem=lambda lon, lat, alt=alt: np.full(len(lon), alt), dem_bias_sigma=1e4).terrain
        for alt in (130.0, 230.0)
    )
    assert low.offset == pytest.approx(high.offset + 100.0, abs=0.01)
    assert low.spread == pytest.approx(high.spread, abs=0.01)


@pytest.mark.parametrize("count", [5, 25, 60, 400])
def test_points_of_one_survey_are_worth_twenty_five_at_most(count: int) -> None:
    """A single frame with 4,337 GCPs of a metre was known to 1.5 cm."""
    made = simulate_block(1, 0, num_gcps=count, per_site=1, seed=1, num_checks=0)
    found = adjust_tracks(made.views, made.tracks, gcps=made.gcps).gauge
    stated = np.median(made.gcps.sigma, axis=0)
    np.testing.assert_allclose(found.sigma, stated / np.sqrt(min(count, 25)), rtol=0.05)
    np.testing.assert_allclose(found.motion_sigma[:3], found.sigma, rtol=1e-6)
