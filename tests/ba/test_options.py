"""Every option of the adjustment changes the result, and in the direction that its description says."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import fields, replace
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pytest
import scipy.optimize

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.ba.parameters.priors import prior_sigmas, stated_accuracy
from barpc.base.errors import BarpcWarning, TiePointError
from barpc.base.geodesy import ground_from_ecef
from barpc.scene import Tracks
from barpc.sensor.centers import camera_center
from barpc.simulate import SimulatedBlock, simulate_block
from tests.ba.conftest import as_stated, centers_of
from tests.constants import CONSTANTS, chosen

BASE: dict[str, Any] = {"noise_floor": 0.0, "min_convergence": 0.01}


class Row(NamedTuple):
    """An option from one value to another, and what grows (1) or shrinks (-1) by it, at least by a factor."""

    field: str
    low: Any
    high: Any
    observable: Callable[[Adjustment], float]
    sign: int
    factor: float = 1.2
    rest: dict[str, Any] = {}  # noqa: RUF012 - never changed
    dem: float | None = None


def unknowns(found: Adjustment) -> float:
    return found.params.shape[1]


def rotation(found: Adjustment) -> float:
    return float(np.abs(found.params[:, :3]).mean())


def last(found: Adjustment) -> float:
    return float(np.abs(found.params[:, -3:]).mean())


def kept(found: Adjustment) -> float:
    return float(found.inlier.sum())


def variance(found: Adjustment) -> float:
    return float(np.linalg.eigvalsh(found.covariance.full)[0])  # of what is known best: the noise alone


def off_dem(found: Adjustment) -> float:
    return float(np.abs(ground_from_ecef(found.points[np.isfinite(found.points[:, 0])])[:, 2] - 400.0).mean())


def steps(found: Adjustment) -> float:
    return float(found.steps)


ROWS = [
    Row("model", "rotation", "rotation+translation", unknowns, 1),
    Row("model", "shift", "affine", unknowns, 1),
    Row("drift", 0, 2, unknowns, 1),
    Row("jitter", "off", "5000", unknowns, 1),
    Row("detectors", (), (10000.0,), unknowns, 1),
    Row("sigma_attitude", 0.2, 20.0, rotation, 1),
    Row("sigma_position", 0.2, 20.0, last, 1, rest={"drift": 0}),
    Row("sigma_drift", 0.01, 10.0, last, 1, rest={"drift": 1}),
    Row("sigma_shift", 0.1, 50.0, rotation, 1, rest={"model": "affine"}),
    Row("noise_floor", 0.0, 0.5, variance, 1),
    Row("robust_threshold", 1.5, 6.0, kept, 1, 1.02),
    Row("num_passes", 1, 6, lambda found: len(found.cost_history), 1, rest={"robust_threshold": 1.2, "drift": 0}),
    Row("fixed", (), ("view_0000",), lambda found: 1e-9 + np.abs(found.params[0]).max(), -1, 1e6),
    Row("dem_sigma", 0.5, 500.0, off_dem, 1, rest={"dem_bias_sigma": 0.5}, dem=400.0),
    Row("dem_bias_sigma", 0.5, 50.0, lambda found: found.gauge.sigma[2], 1, rest={"dem_sigma": 0.5}, dem=400.0),
    Row("min_convergence", 0.01, 90.0, lambda found: 1 + found.held.sum(), 1, 10.0),
    Row("tolerance", 1e-14, 1e-2, steps, -1, rest={"solver": "sparse"}),
]
ELSEWHERE = {
    "terms": "test_no_terms_is_the_plain_model_and_needs_no_search",
    "center": "test_views_turn_about_the_centre_that_is_asked_for",
    "min_observations": "test_a_view_needs_as_many_observations_as_asked_for",
    "solver": "test_the_solver_that_is_asked_for_is_the_one_that_runs",
}
ELSEWHERE_TOO = (
    "model", "drift", "jitter", "detectors", "fixed", "dem_sigma", "tolerance",
    "sigma_position", "num_passes", "sigma_drift", "sigma_shift",
)  # fmt: skip
"""What tests of its own have among the fast ones, too."""


@pytest.fixture(scope="module")
def dirty() -> SimulatedBlock:
    """Four views, tie points with twice the stated noise and a tenth of them wrong."""
    made = simulate_block(4, 150, seed=21, noise=0.2, outliers=0.1)
    tracks = made.tracks
    told = Tracks(tracks.view, tracks.point, tracks.xy, np.full(len(tracks), 0.1))
    return replace(made, tracks=told)


def run(block: SimulatedBlock, dem: float | None = None, hold_out: bool = True, **options: Any) -> Adjustment:
    terrain = None if dem is None else lambda lon, lat: np.full(len(lon), dem)
    # among ties of twice the stated noise a foreign RPC is looked for in every run: test_apart.py
    unasked = mock.patch("barpc.ba.select.models.find_foreign_camera", return_value=(None, None))
    with warnings.catch_warnings(), unasked, chosen(AdjustOptions, **{**BASE, **options}) as given:
        warnings.simplefilter("ignore", BarpcWarning)
        centers = centers_of(block)
        return adjust_tracks(block.views, block.tracks, given, dem=terrain, centers=centers, hold_out=hold_out)


@pytest.fixture(scope="module")
def ended() -> Callable[[SimulatedBlock, float | None, dict[str, Any]], Adjustment]:
    """As `run`; what differs in no option from what was asked for before is not adjusted again."""
    known = {field.name: field.default for field in fields(AdjustOptions)} | BASE
    found: dict[tuple[float | None, str], Adjustment] = {}

    def end(block: SimulatedBlock, dem: float | None, options: dict[str, Any]) -> Adjustment:
        told = {name: value for name, value in options.items() if name not in known or known[name] != value}
        key = (dem, repr(sorted(told.items())))
        if key not in found:
            with as_stated() if dem is not None else nullcontext():
                found[key] = run(block, dem, **options)
        return found[key]

    return end


@pytest.mark.slow
def test_a_tenth_of_the_tracks_takes_no_part():
    dirty = simulate_block(4, 1200, seed=21, noise=0.2, outliers=0.1)
    dirty = replace(dirty, tracks=replace(dirty.tracks, sigma=np.full(len(dirty.tracks), 0.1)))
    found = run(dirty)
    every = run(dirty, hold_out=False)
    assert not every.held_out.any()
    assert np.isnan(every.held_out_rms).all()
    out, tracks = found.held_out, dirty.tracks
    assert not (out & found.inlier).any()
    assert out.mean() == pytest.approx(0.1, rel=0.25)
    # 0.2 px a coordinate where 0.1 px is stated; of the tracks a quarter holds something wrong, by up to 20 px
    assert (found.held_out_noise > 1.6).all()
    assert (found.held_out_noise < 5.0).all()
    assert (found.held_out_rms < 2.5 * found.rmse()).all()
    # what took no part tells nothing: spoilt within the quarters of a pixel by which it is drawn, it changes no camera
    xy = np.where(out[:, None], np.rint(4.0 * tracks.xy) / 4.0, tracks.xy)
    spoilt = run(replace(dirty, tracks=replace(tracks, xy=xy)))
    np.testing.assert_array_equal(spoilt.params, found.params)
    assert (spoilt.held_out_noise != found.held_out_noise).all()


def test_every_option_has_a_row():
    assert {row.field for row in ROWS} | set(ELSEWHERE) == {field.name for field in fields(AdjustOptions)} | set(
        CONSTANTS[AdjustOptions]
    )
    assert set(ELSEWHERE.values()) <= set(globals())


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "row",
    [pytest.param(row, marks=pytest.mark.nightly if row.field in ELSEWHERE_TOO else ()) for row in ROWS],
    ids=[f"{row.field}: {row.low} to {row.high}" for row in ROWS],
)
def test_an_option_changes_the_result_in_its_direction(dirty, ended, row):
    few, many = (row.observable(ended(dirty, row.dem, {**row.rest, row.field: value})) for value in (row.low, row.high))
    ratio = many / few if row.sign > 0 else few / many
    assert ratio > row.factor, (few, many)


def test_a_view_needs_as_many_observations_as_asked_for(dirty):
    count = np.bincount(dirty.tracks.view)
    least = int(count.min())
    assert run(dirty, min_observations=least).params.any()
    with pytest.raises(TiePointError, match=f"view_000{count.argmin()} \\({least}\\)"):
        run(dirty, min_observations=least + 1)


@pytest.mark.slow
def test_the_solver_that_is_asked_for_is_the_one_that_runs(dirty, caplog):
    for asked, runs in (("sparse", ["sparse"]), ("auto", ["scipy", "sparse"])):
        caplog.clear()
        with caplog.at_level(logging.INFO, logger="barpc.ba.solving.solve"):
            found = run(dirty, solver=asked)
        names = [record.getMessage().split(":")[0] for record in caplog.records]
        assert sorted(set(names)) == runs
        assert names[-1] == ("sparse" if asked == "sparse" else "scipy")  # which has the last word
        assert ("scipy least_squares" in found.status) == (names[-1] == "scipy")


def test_a_block_is_minimised_by_the_least_squares_of_scipy_by_default(monkeypatch):
    entered = []

    def counting(*args, **kwargs):
        entered.append(real(*args, **kwargs))
        return entered[-1]

    real = scipy.optimize.least_squares
    monkeypatch.setattr(scipy.optimize, "least_squares", counting)
    block = simulate_block(3, 180, seed=21)
    found = adjust_tracks(block.views, block.tracks, AdjustOptions(min_convergence=0.01))
    assert entered[-1].message.rstrip(".") in found.status
    assert f"{entered[-1].nfev} evaluations" in found.status


def test_prior_sigmas_stand_at_their_unknowns(dirty):
    with chosen(AdjustOptions, drift=2, sigma_attitude=2.0, sigma_position=3.0, sigma_drift=5.0) as options:
        found = prior_sigmas(dirty.views, options, 2, None, 0)
    np.testing.assert_array_equal(found, [np.repeat([2, 3, 5, 5], 3)] * 4)
    for model, size in (("shift", 2), ("shift-drift", 4), ("affine", 6)):
        with chosen(AdjustOptions, model=model, sigma_shift=7.0) as given:
            sigma = prior_sigmas(dirty.views, given, 0, None, 0)
        np.testing.assert_array_equal(sigma, np.full((4, size), 7.0))


@pytest.mark.parametrize(("stated", "taken"), [(None, 7.5), (0.1, 7.5), (0.11, 0.11), (8.0, 8.0), (0.02, 7.5)])
def test_a_camera_is_as_accurate_as_it_states_in_metres(dirty, stated, taken):
    view = dirty.views[0]
    told = replace(view, sensor=replace(view.sensor, err_bias=stated))
    assert stated_accuracy(told) == taken
    np.testing.assert_array_equal(prior_sigmas((told,), AdjustOptions(), 0, None, 0), np.full((1, 6), taken))
    # what is asked for counts though it is known to be off by more
    asked = prior_sigmas((told,), AdjustOptions(sigma_attitude=2.0), 0, np.array([60.0]), 0)
    np.testing.assert_array_equal(asked, [np.repeat([2.0, 60.0], 3)])


def test_views_turn_about_the_centre_that_is_asked_for(dirty):
    """A view stands where its own camera says; asked for as the paper has it, farther off along the same sight."""
    line, whole = (
        adjust_tracks(dirty.views, dirty.tracks, AdjustOptions(drift=0, jitter="off", center=how))
        for how in ("line", "projective")
    )
    for view, near, far in zip(dirty.views, line.corrections, whole.corrections, strict=True):
        wanted = camera_center(view.sensor, view.size, view.alt_range, "projective").ecef
        np.testing.assert_array_equal(far.center, wanted)
        assert np.linalg.norm(far.center - near.center) > 1e4


@pytest.mark.slow
def test_no_terms_is_the_plain_model_and_needs_no_search(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="barpc.ba.select")
    block = simulate_block(3, 1500, seed=21)
    xy = block.tracks.xy.copy()
    xy[(block.tracks.view == 1) & (np.abs(xy[:, 1] - 9000.0) < 1500.0)] += (1.0, 2.0)
    jumped = replace(block.tracks, xy=xy)
    found = adjust_tracks(block.views, jumped, AdjustOptions(terms="none"))
    assert found.cameras.unknowns.drift == 1
    assert found.cameras.unknowns.waves is None
    assert (found.findings, found.changed) == ((), 0.0)
    assert not found.moving.any()
    assert not caplog.records
    followed = adjust_tracks(block.views, jumped)
    assert "step of view 1" in caplog.text
    assert [one.kind for one in followed.findings] == ["step"]
    assert followed.changed > 0.5  # of two pixels, beside what the plain model bends
