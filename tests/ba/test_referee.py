"""Full scenes flown by errors that are not the adjustment's: what is corrected, and what is said of the rest."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from itertools import product, starmap

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks
from benchmarks.referee import Case, Errors, cases, judge, make, referee, referee_run, solve
from tests.ba.conftest import as_stated
from tests.costs import once
from tests.lanes import known, rest_slow

SEEDS = (0, 1, 2)
ONE_OR_ALL = rest_slow([SEEDS[1:2], SEEDS], mark=pytest.mark.nightly)
TABLE = cases()


def hills(lon, lat):
    """Relief that needs no file: valleys and ridges of some hundred metres."""
    x, y = (lon - 5.45) * 79e3, (lat - 44.5) * 111e3
    waves = [
        np.sin(x / s + p) * np.cos(y / (1.3 * s) - p) * s / 12.0 for s, p in ((4000, 0.3), (1500, 1.1), (400, 2.0))
    ]
    return 900.0 + sum(waves)


@once
def verdict(name, seed, stated=False, **options):
    with as_stated() if stated else nullcontext():
        return referee(replace(TABLE[name], seed=seed), AdjustOptions(**options), hills)


def verdicts(name, seeds=SEEDS, **options):
    return [verdict(name, seed, **options) for seed in seeds]


def median(found, value):
    return float(np.median([value(v) for v in found]))


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "across", "shape", "seeds"),
    rest_slow(
        starmap(
            pytest.param,
            [
                ("drift 1", 0.03, 2.0, SEEDS[1:2]),
                ("no drift", 0.015, 0.2, SEEDS),
                ("drift 1", 0.03, 2.0, SEEDS),
                ("drift 0.3", 0.03, 0.7, SEEDS),
                ("drift 3", 0.03, 5.0, SEEDS),
                ("quadratic 1", 0.05, 2.0, SEEDS),
                ("drift 1, 2 views", 0.03, 4.0, SEEDS),
                ("drift 1, 6 views", 0.03, 0.7, SEEDS),
                ("drift 1, 5k rows", 0.04, 2.0, SEEDS),
                ("drift 1, 40k rows", 0.03, 2.0, SEEDS),
                ("3 x the prior", 0.03, 0.5, SEEDS),
            ],
        ),
        2,
        pytest.mark.nightly,
    ),
)
def test_what_a_drifting_attitude_does_is_corrected_by_default(name, across, shape, seeds):
    found = verdicts(name, seeds)
    assert median(found, lambda v: v.before.across) > 5.0
    assert median(found, lambda v: v.after.across) < across
    assert median(found, lambda v: v.after.shape) < shape
    assert median(found, lambda v: v.lost) <= (0.015 if name.startswith("quadratic") else 0.01)  # right tie points


@pytest.mark.nightly
@pytest.mark.parametrize("seeds", [SEEDS[:1], SEEDS])
def test_without_a_drift_in_the_model_the_same_scene_is_not_met(seeds):
    """With priors as stated; where they learn, that of one image may be wide enough to take up a part of it."""
    plain = {"drift": 0, "stated": True}
    stated, learnt, drifting = (
        median(verdicts("drift 1", seeds, **options), lambda v: v.after.across) for options in (plain, {"drift": 0}, {})
    )
    assert 0.15 < stated < 1.5
    assert 3.0 * drifting < learnt < 1.5


@pytest.mark.nightly
def test_the_drift_is_learnt_as_large_as_it_is():
    sizes = {name: [solve(make(replace(TABLE[name], seed=s), hills))[1].prior.drift_sigma[0] for s in SEEDS]
             for name in ("no drift", "drift 1", "drift 3")}  # fmt: skip
    quiet, one, three = (float(np.median(sizes[name])) for name in sizes)
    assert quiet < 0.25
    assert 0.25 < one < 1.8  # 0.7 m is flown, of which half is seen; what is not expected is taken rather too wide
    assert 1.5 < three < 6.0


@pytest.mark.slow
def test_priors_three_times_too_narrow_are_widened_and_the_stated_place_with_them():
    found = verdicts("3 x the prior")
    told = verdicts("3 x the prior", stated=True)
    assert median(found, lambda v: v.sigma[2]) > 2 * median(told, lambda v: v.sigma[2])
    assert median(found, lambda v: v.nees) < 0.5 * median(told, lambda v: v.nees)


@pytest.mark.nightly
def test_priors_that_hold_are_left_as_they_are():
    true = Case("as stated", Errors(attitude=5e-6, position=1.0))
    scales = [solve(make(replace(true, seed=seed), hills))[1].prior.scale for seed in range(6)]
    assert np.median(scales) == 1.0
    assert np.max(scales) < 1.5


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [
        (0, 200.0, 0.0),
        (1, 200.0, 0.0),
        pytest.param((0, 0.0, 800.0), marks=known("named; 0.085 px are left of 800 m along the flight, 0.05 before")),
        (2, -200.0, 100.0),
    ],
)
def test_one_wrong_rpc_of_three_is_named_and_the_place_of_the_scene_still_covered(wrong):
    named = []
    for seed in SEEDS:
        scene = make(replace(TABLE["no drift"], wrong=wrong, seed=seed), hills)
        sensors, found = solve(scene)
        after = judge(scene, sensors)
        named.append(found.prior.odd[wrong[0]])
        assert found.prior.scale[wrong[0]] == found.prior.scale.max() > 3
        assert after.across < 0.05
        assert (np.abs(after.move) <= 4 * found.gauge.sigma).all()  # the others are twice as far off as stated, too


def test_two_views_that_contradict_each_other_are_both_widened_and_none_is_named():
    pair = replace(TABLE["no drift, 2 views"], wrong=(0, 400.0, 0.0))
    _, found = solve(make(pair, hills))
    assert not found.prior.odd.any()
    assert (found.prior.scale > 3).all()


@pytest.mark.nightly
def test_forty_percent_of_a_view_moved_together_is_left_out():
    found = verdicts("40 % moved")
    assert median(found, lambda v: v.after.across) < 0.05
    assert median(found, lambda v: v.caught) > 0.99
    clean = verdicts("no drift")
    for verdict, other in zip(found, clean, strict=True):  # the same scene: how it moved is not what was moved in it
        offset = np.abs(np.subtract(verdict.shift, other.shift))
        assert (offset < [0.5, 0.5, 5.0]).all()  # 7 m without: pairs of delivered cameras meet at many heights


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("seeds", ONE_OR_ALL)
def test_a_pair_whose_tie_points_fall_into_two_groups_says_so(seeds):
    for seed in seeds:
        _, found = solve(make(replace(TABLE["pair, 30 % moved"], seed=seed), hills))
        (groups,) = found.two_groups
        assert groups.views == (0, 1)
        assert groups.share == pytest.approx(0.3, abs=0.04)
        assert groups.apart == pytest.approx(0.4, abs=0.05)


@pytest.mark.landing(2)
@pytest.mark.parametrize("seeds", ONE_OR_ALL)
@pytest.mark.parametrize(
    "name", rest_slow(["no drift, 2 views", "no drift", "drift 3", "quadratic 1", "no drift, 10 % outliers"])
)
def test_a_pair_whose_tie_points_are_of_one_kind_says_nothing(name, seeds):
    for seed in seeds:
        assert not solve(make(replace(TABLE[name], seed=seed), hills))[1].two_groups


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "status", "word"),
    [
        ("no drift", "good", ""),
        ("drift 3", "good", ""),
        pytest.param("jitter 0.5 at 1 Hz", "look", "includes attitude jitter", marks=pytest.mark.nightly),
        ("jitter 0.1 at 5 Hz", "look", "px with a period of 27"),
        pytest.param(
            *("clouds 60 %", "bad", "check for clouds, water and change"),
            marks=known("needs review as wrong matches or camera errors; no image is left out"),
        ),
        ("RPC 200 px wrong", "good", "exceed the pointing error"),
    ],
)
def test_what_is_said_is_true(name, status, word):
    found = referee_run(replace(TABLE[name], seed=1), hills)
    assert found.status == status
    assert found.code == (0 if status == "good" else 3)
    assert word in " ".join(found.words)
    if status == "good":
        assert found.after.across < 0.15


def weak_pair(angle, seed):
    """Two views whose rays meet under `angle` [deg], flown with the errors that the priors state."""
    pitch = (-0.44 * angle, 0.44 * angle)
    errors = Errors(attitude=10.8e-6, position=7.5)
    return make(Case("weak pair", errors, pitch=pitch, roll=0.0, tracks=600, seed=seed), hills)


def heights_of(scenes, dem=None):
    """Errors of the scenes' heights, and what was stated [m]."""
    found = [adjust_tracks(scene.views, scene.tracks, dem=dem) for scene in scenes]
    errors = [judge(scene, f.sensors).move[2] for scene, f in zip(scenes, found, strict=True)]
    return np.array(errors), np.array([f.gauge.sigma[2] for f in found])


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore::barpc.BarpcWarning")
@pytest.mark.parametrize("angle", [1.1, 0.5, 0.9, 1.3, 1.5])
def test_what_is_stated_of_weak_heights_is_as_large_as_it_is(angle):
    true, said = heights_of([weak_pair(angle, seed) for seed in range(12)])
    assert 0.5 < np.sqrt((said**2).mean() / (true**2).mean()) < 2.0


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::barpc.BarpcWarning")
@pytest.mark.parametrize(
    ("bias", "seeds"), rest_slow(starmap(pytest.param, product([30.0, 0.0], [range(1), range(1, 3)])))
)
def test_heights_of_a_dem_are_wrong_together(bias, seeds):
    true, said = heights_of([weak_pair(0.6, seed) for seed in seeds], dem=lambda lon, lat: hills(lon, lat) + bias)
    assert (np.abs(true) < 2 * said).all()
    np.testing.assert_allclose(true, bias, atol=2.0)  # nothing else tells: the scene stands on the DEM
    assert (said < 25.0).all()


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("bias", [-30.0, 30.0])
def test_a_dem_that_holds_a_good_block_is_not_believed_to_the_centimetre(bias):
    scene = make(replace(TABLE["no drift"], seed=2), hills)
    options = AdjustOptions(sigma_attitude=10.4, sigma_position=2.0)
    found = adjust_tracks(scene.views, scene.tracks, options, dem=lambda lon, lat: hills(lon, lat) + bias)
    true = judge(scene, found.sensors).move
    assert (np.abs(true) < 2 * found.gauge.sigma).all()
    assert 5.0 < found.gauge.sigma[2] < 20.0
    assert np.sign(true[2]) == np.sign(bias)
    assert found.terrain.held > 0.99 * found.terrain.total
    assert found.datum["heights"][2] > 0.3
