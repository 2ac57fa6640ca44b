"""Which model corrects a block, and when the data may choose another one."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks, adjustment, block_prior
from barpc.ba.block import join
from barpc.ba.rounds import Outcome
from barpc.ba.solution import Solution
from barpc.ba.starting import first_state, make_problem
from barpc.errors import BarpcWarning, DisconnectedError, InputError, TiePointError
from barpc.geodesy import ground_from_ecef
from barpc.scene import Tracks
from barpc.sensor.geometry import triangulate
from barpc.simulate import Block, simulate_block
from tests.ba.conftest import centers_of, solve
from tests.constants import chosen

CALM = {"learn_priors": False, "hold_out": False}


@pytest.fixture(scope="module")
def made() -> Block:
    return simulate_block(3, 150, seed=5)


def choose(
    monkeypatch, skew: bool, trend: bool, error: float, rms: float, **given: Any
) -> tuple[str, Any, list[str]]:
    """The model chosen where the one in space leaves 1 (error) and 1 px (rms); what is known of it; models solved."""
    asked: list[str] = []

    def solved(block: Any, outer: Any, options: AdjustOptions, *rest: Any) -> Any:
        asked.append(options.model)
        after = SimpleNamespace(error=1.0, whole_rms=1.0)
        if options.model == "affine":
            after = SimpleNamespace(error=error, whole_rms=rms)
        in_space = SimpleNamespace(cameras=SimpleNamespace(unknowns=SimpleNamespace(geometric=True)))
        said = {"is_skew": skew, "has_trend": trend, "has_waves": False, "tested": None}
        return SimpleNamespace(**said, after=after, model=options.model, problem=in_space)

    monkeypatch.setattr(adjustment, "solve_block", solved)
    monkeypatch.setattr(adjustment, "follow", lambda found, *_: found)
    prior = given.pop("prior", None)
    found, in_space = adjustment._choose_model(None, None, AdjustOptions(**given), None, None, prior)
    return found.model, in_space, asked


@pytest.mark.parametrize(
    ("skew", "trend", "error", "rms", "model"),
    [
        (False, False, 0.1, 0.1, "auto"),  # nothing asks for another model
        (False, True, 0.69, 0.9, "affine"),
        (False, True, 0.71, 0.9, "auto"),
        (True, False, 0.89, 0.9, "affine"),
        (True, True, 0.89, 0.9, "affine"),
        (True, False, 0.91, 0.9, "auto"),
        (True, True, 0.1, 0.9955, "affine"),  # 4.5 thousandths of a pixel are worth it
        (True, True, 0.1, 0.9965, "auto"),
        (True, True, 0.1, float("nan"), "auto"),
    ],
)
def test_an_affine_is_taken_where_it_is_clearly_better(monkeypatch, skew, trend, error, rms, model) -> None:
    found, in_space, asked = choose(monkeypatch, skew, trend, error, rms)
    assert found == model
    assert in_space == (1.0 if model == "affine" else None)
    assert asked == (["auto", "affine"] if skew or trend else ["auto"])


@pytest.mark.parametrize(
    "given",
    [
        {"model": "rotation+translation"},
        {"model": "rotation"},
        {"drift": 1},
        {"drift": 0},
        {"prior": "an earlier block"},
    ],
)
def test_a_model_that_is_asked_for_is_the_only_one(monkeypatch, given) -> None:
    assert choose(monkeypatch, True, True, 0.1, 0.1, **given)[1:] == (None, [given.get("model", "auto")])


def outcome_of(rms: float, noise: float = 1.0, drift: tuple[float, ...] = ()) -> Any:
    smooth = SimpleNamespace(found=lambda least: np.array([False, rms > least]))
    return SimpleNamespace(smooth=smooth, noise=noise, prior=SimpleNamespace(drift_sigma=drift))


def solution(outcome: Outcome, error: float = 1.0, problem: Any = None) -> Solution:
    state = SimpleNamespace(params=None, points=None)
    outcome.minimum = SimpleNamespace(state=state)  # type: ignore[misc]
    return Solution(problem, None, None, None, outcome, None, SimpleNamespace(error=error), None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("rms", "error", "noise", "trend"),
    [
        (0.029, 1.0, 1.0, False),
        (0.031, 1.0, 1.0, True),
        (0.0, 2.9, 2.0, False),
        (0.0, 3.1, 2.0, True),
        (0.0, np.nan, 1.0, False),
    ],
)
def test_a_trend_is_what_is_smooth_or_what_was_cut(rms, error, noise, trend) -> None:
    assert solution(outcome_of(rms, noise), error).has_trend == trend


@pytest.mark.parametrize(
    ("drift", "half", "pixel", "skew"),
    [
        ((), 5000.0, 0.7, False),
        ((0.39,), 10.0, 0.7, False),  # no more than twice what platforms do
        ((0.41,), 10.0, 0.7, True),
        ((3.4,), 5000.0, 0.7, False),  # a thousandth of 5000 px of 0.7 m is 3.5 m
        ((3.6,), 5000.0, 0.7, True),
        ((3.6,), 5000.0, 0.75, False),
        ((3.6,), 5300.0, 0.7, False),
    ],
)
def test_a_drift_that_no_platform_flies_is_a_skew(drift, half, pixel, skew) -> None:
    by_point = np.zeros((2, 3, 5))
    by_point[1, 0], by_point[0] = 1 / pixel, 9.0
    by_point[:, :, 4] = np.nan
    problem = SimpleNamespace(
        project_points=lambda params, points: SimpleNamespace(by_point=by_point),
        cameras=SimpleNamespace(unknowns=SimpleNamespace(half=np.array([[1.0] * 3, [half, half, 9 * half]]))),
    )
    assert solution(outcome_of(0.0, drift=drift), problem=problem).is_skew == skew


def test_an_earlier_blocks_drift_goes_on(made) -> None:
    centers = centers_of(made)
    for drift in (0, 2):
        first = solve(made, drift=drift, **CALM)
        prior = block_prior(first)
        assert prior.drift == drift
        found = adjust_tracks(
            made.views, made.tracks, AdjustOptions(noise_floor=0.0), centers=centers, prior=prior
        )
        assert found.params.shape[1] == 6 + 3 * drift
    assert solve(made, **CALM).params.shape[1] in (9, 12)
    with pytest.raises(InputError, match="use the same"):
        adjust_tracks(made.views, made.tracks, AdjustOptions(drift=1), centers=centers, prior=prior)


@pytest.mark.parametrize(
    ("model", "drift"), [("auto", 1), ("rotation", 1), ("translation", 0), ("affine", 0), ("shift", 0)]
)
def test_a_model_that_turns_starts_with_a_drift(made, model: str, drift: int) -> None:
    options = AdjustOptions(model=model)
    problem = make_problem(join(made.views, made.tracks, None, options), options, None, None)
    assert problem.cameras.unknowns.drift == drift


def test_an_earlier_blocks_centres_are_kept_and_the_others_regressed(made) -> None:
    centers = centers_of(made)
    options = AdjustOptions(drift=0)
    two = made.tracks.select(made.tracks.view < 2)
    first = adjust_tracks(made.views[:2], two, options, centers=centers[:2] + 7.0, hold_out=False)
    block = join(made.views, made.tracks, None, options)
    given = make_problem(block, options, centers, block_prior(first)).cameras.unknowns.center
    np.testing.assert_array_equal(given, np.vstack([centers[:2] + 7.0, centers[2:]]))
    found = make_problem(block, options, None, block_prior(first)).cameras.unknowns.center
    np.testing.assert_array_equal(found[:2], centers[:2] + 7.0)
    assert 0 < np.linalg.norm(found[2] - centers[2]) < 0.1 * 694e3


# --- where it starts ----------------------------------------------------------------------------------------------


def uneven(made: Block) -> Block:
    """Observations of three sigmas, and noise to go with them."""
    sigma = np.array([0.1, 0.5, 2.0])[np.arange(len(made.tracks)) % 3]
    xy = made.tracks.xy + sigma[:, None] * np.random.default_rng(0).normal(size=made.tracks.xy.shape)
    return replace(made, tracks=replace(made.tracks, xy=xy, sigma=sigma))


def triangulated(sensors: Any, tracks: Tracks, xy: np.ndarray, sigma: np.ndarray | None) -> np.ndarray:
    return triangulate(list(sensors), tracks.view, tracks.point, xy, sigma, alt=300.0).points


def test_points_start_where_the_delivered_cameras_see_them_by_their_sigmas(made) -> None:
    given = uneven(made)
    options = AdjustOptions(drift=0)
    block = join(given.views, given.tracks, None, options)
    problem = make_problem(block, options, centers_of(made), None)
    state, _ = first_state(problem, block, options, None)
    sensors = [view.sensor for view in given.views]
    weighted, equal = (
        triangulated(sensors, given.tracks, given.tracks.xy, s) for s in (given.tracks.sigma, None)
    )
    off = [np.linalg.norm(state.points - there, axis=1) for there in (weighted, equal)]
    assert np.median(off[0]) < 0.02 < 0.3 < np.median(off[1])


@pytest.mark.parametrize("kept", [1.0, 0.5])
def test_the_scenes_move_is_from_where_the_delivered_cameras_put_what_is_seen_now(made, kept: float) -> None:
    """Where much was cut, what it was cut for is mended before: its places are those of the adjusted cameras."""
    given = uneven(made)
    options = AdjustOptions(drift=0)
    block = join(given.views, given.tracks, None, options)
    problem = make_problem(block, options, centers_of(made), None)
    state, _ = first_state(problem, block, options, None)
    params = np.random.default_rng(1).normal(0, 3, (3, 6))
    final = replace(state, params=params, points=state.points + 5.0)
    inlier = np.arange(len(block.view)) < kept * len(block.view)
    outcome: Any = SimpleNamespace(inlier=inlier, minimum=SimpleNamespace(state=final))
    found = Solution(problem, state, None, None, outcome, None, None, None).first_points(block)  # type: ignore[arg-type]
    if kept == 1.0:
        np.testing.assert_array_equal(found, state.points)
        return
    sensors = problem.cameras.unknowns.corrected(params, given.views)
    ground = ground_from_ecef(final.points)
    seen = np.array(
        [sensors[v].project(ground[p]) for v, p in zip(given.tracks.view, given.tracks.point, strict=True)]
    )
    delivered = [view.sensor for view in given.views]
    weighted, equal = (triangulated(delivered, given.tracks, seen, s) for s in (given.tracks.sigma, None))
    off = [np.linalg.norm(found - there, axis=1) for there in (weighted, equal)]
    assert np.median(off[0]) < 0.02 < 0.1 < np.median(off[1])


# --- what is no block ---------------------------------------------------------------------------------------------


def chain(sizes: tuple[int, ...], keep_largest: bool = False) -> Any:
    """Groups of so many views each; the views of a group share one track."""
    made = simulate_block(2, 5, seed=1)
    view = np.arange(sum(sizes))
    group = np.repeat(np.arange(len(sizes)), sizes)
    views = tuple(replace(made.views[0], name=f"v{v:02}") for v in view)
    tracks = Tracks(view, group, np.zeros((len(view), 2)), np.ones(len(view)))
    with chosen(AdjustOptions, min_observations=1) as options:
        return join(views, tracks, None, options, keep_largest)


def test_groups_are_listed_the_largest_first_five_views_of_five() -> None:
    assert chain((3,)).left_out == ()
    with pytest.raises(DisconnectedError) as caught:
        chain((5, 6, 2))
    assert [len(group) for group in caught.value.groups] == [6, 5, 2]
    text = "v05, v06, v07, v08, v09, ...; v00, v01, v02, v03, v04; v11, v12; add"
    assert f"fall into 3 groups without common tie points: {text}" in str(caught.value)
    with pytest.raises(DisconnectedError) as caught:
        chain((2,) * 7)
    assert "fall into 7 groups" in str(caught.value)
    assert str(caught.value).count(";") == 5
    with pytest.warns(
        BarpcWarning, match=r"^2 views are not tied to the largest group and keep their cameras: v00, v01$"
    ):
        assert chain((2, 4), keep_largest=True).left_out == ("v00", "v01")


def test_views_with_too_few_observations_are_listed_up_to_ten(made) -> None:
    tracks = made.tracks
    for gone, text in (
        ({1}, r"view_0001 \(0\): at least"),
        ({0, 2}, r"view_0000 \(0\), view_0001 \(2\), view_0002 \(0\):"),
    ):
        keep = ~np.isin(tracks.view, list(gone))
        if len(gone) == 2:
            keep[np.flatnonzero(keep)[2:]] = False
        with pytest.raises(TiePointError, match=text):
            join(made.views, Tracks(*(column[keep] for column in (tracks.view, tracks.point, tracks.xy, tracks.sigma))),
                 None, AdjustOptions())  # fmt: skip
    views = tuple(replace(made.views[0], name=f"v{v:02}") for v in range(12))
    empty = Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))
    with pytest.raises(TiePointError, match=r"v09 \(0\), 2 more: at least 4 are needed"):
        join(views, empty, None, AdjustOptions())
