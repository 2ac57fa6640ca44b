"""Which model corrects a block, and when the data may choose another one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks, block_prior
from barpc.ba import solution as solved
from barpc.ba.constraints.block import join, make_problem
from barpc.ba.robust.rounds import Outcome
from barpc.ba.select import models
from barpc.ba.select.beam import Selection
from barpc.ba.solution import Solution
from barpc.ba.solving.structure import make_structure
from barpc.base.errors import BarpcWarning, DisconnectedError, TiePointError
from barpc.base.geodesy import ground_from_ecef
from barpc.scene import GroundPoints, Tracks
from barpc.sensor.image_corrections import ImageAffine, ImageCorrected
from barpc.sensor.triangulation import triangulate
from barpc.simulate import SimulatedBlock, simulate_block
from tests.ba.conftest import as_stated, centers_of, solve
from tests.ba.residuals import started
from tests.constants import chosen

CALM = {"hold_out": False}


@dataclass(frozen=True)
class Said:
    """What the choice of a model asks of a solution."""

    model: str
    after: Any
    is_skew: bool = False
    has_trend: bool = False
    has_waves: bool = False
    goes_on: bool = False
    geometric: bool = True
    findings: tuple[Any, ...] = ()
    outcome: None = None
    tested: None = None
    final: Any = field(default_factory=lambda: SimpleNamespace(params=np.zeros((3, 6))))

    @property
    def problem(self) -> Any:
        return SimpleNamespace(cameras=SimpleNamespace(unknowns=SimpleNamespace(geometric=self.geometric)))


@pytest.fixture(scope="module")
def made() -> SimulatedBlock:
    return simulate_block(3, 150, seed=5)


def searched(monkeypatch, solve_block: Any, options: AdjustOptions | None = None, **scripted: Any) -> tuple[str, Any]:
    """The model chosen among scripted solutions, and what is known of the one in space.

    Nothing moves, no part of an image and no spline is found, but for what is scripted.
    """
    fakes = {
        "significant_intervals": lambda *_: [],
        "with_splines": lambda found, *_: found,
        "with_terms": lambda found, *_: found,
        "_without_moving_ground": lambda found, parts, *_: (found, parts, Selection()),
        **scripted,
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(models, name, fake)
    parts: Any = SimpleNamespace(inner=None, outer=None)
    options = AdjustOptions() if options is None else options
    model: Any = models._search_models(solve_block(None, None, options), parts, options, solve_block)
    return model.found.model, model.in_space_rms


def choose(monkeypatch, skew: bool, trend: bool, error: float, rms: float, **given: Any) -> tuple[str, Any, list[str]]:
    """The model chosen where the one in space leaves 1 (error) and 1 px (rms); what is known of it; models solved."""
    asked: list[str] = []
    prior = given.pop("prior", None)

    def by_script(block: Any, outer: Any, options: AdjustOptions, *rest: Any) -> Any:
        asked.append(options.model)
        after = SimpleNamespace(error=1.0, whole_rms=1.0)
        if options.model == "affine":
            after = SimpleNamespace(error=error, whole_rms=rms)
        trending = trend and options.model != "affine"
        return Said(options.model, after, is_skew=skew, has_trend=trending, goes_on=prior is not None)

    return *searched(monkeypatch, by_script, AdjustOptions(**given)), asked


@pytest.mark.parametrize(
    ("skew", "trend", "error", "rms", "model"),
    [
        (False, False, 0.1, 0.1, "auto"),  # nothing asks for another model
        (False, True, 0.66, 0.9, "affine"),
        (False, True, 0.71, 0.9, "auto"),
        (True, False, 0.79, 0.9, "affine"),
        (True, True, 0.79, 0.9, "affine"),
        (True, False, 0.81, 0.9, "auto"),
        (True, True, 0.1, 0.975, "affine"),  # more than the floor is worth it
        (True, True, 0.1, 0.985, "auto"),
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


@pytest.mark.parametrize(
    ("left", "out", "judged"),
    [("", [], False), ("", ["an interval"], True), ("has_trend", [], True), ("has_waves", [], True)],
)
def test_what_an_affine_explains_wholly_no_parts_of_images_are_asked_to(monkeypatch, left, out, judged) -> None:
    """Strips and ties that move can be laid like steps along what grows evenly over an image."""
    asked: list[str] = []

    def solve_block(block: Any, outer: Any, options: AdjustOptions, *_: Any) -> Any:
        affine = options.model == "affine"
        says = dict.fromkeys(("is_skew", "has_trend", "has_waves"), not affine)
        if affine and left:
            says[left] = True
        rms = 0.1 if affine else 1.0
        return Said(options.model, SimpleNamespace(error=rms, whole_rms=rms), geometric=not affine, **says)

    def without_moving(found: Any, parts: Any, *_: Any) -> Any:
        asked.append("moving")
        return found, parts, Selection()

    def without_strips(found: Any, *_: Any) -> Any:
        asked.append("strips")
        return found

    scripted = {"with_terms": without_strips, "_without_moving_ground": without_moving}
    found = searched(monkeypatch, solve_block, significant_intervals=lambda *_: out, **scripted)
    assert found == ("affine", 1.0)
    # beside the affine, with it and in space; then beside the model in space
    assert asked == (["moving", "strips", "strips", "moving", "strips"] if judged else [])


@pytest.fixture(scope="module")
def turned() -> SimulatedBlock:
    """Three images, one of which was turned a little in its plane: no camera in space explains that."""
    made = simulate_block(3, 400, seed=11)
    view = made.views[1]
    slope = np.array([[0.0, -3e-3], [3e-3, 0.0]])
    sensor = ImageCorrected(view.sensor, ImageAffine(-slope @ (np.array(view.size) / 2.0), slope))
    return replace(made, views=(made.views[0], replace(view, sensor=sensor), made.views[2]))


@pytest.mark.nightly
@as_stated()
def test_an_image_that_was_turned_a_little_is_met_in_the_image_with_all_its_ties(turned) -> None:
    found = adjust_tracks(turned.views, turned.tracks, AdjustOptions())
    assert found.cameras.unknowns.model == "affine"
    assert found.findings == ()
    assert (found.inlier | found.held_out).mean() > 0.97


@pytest.mark.nightly
@pytest.mark.parametrize("view", [0, 1])
@as_stated()
def test_a_step_beside_an_image_that_was_turned_is_the_only_one_found_and_is_followed(turned, view) -> None:
    """Beside a model in space what the turn leaves looks like steps, too."""
    tracks = turned.tracks
    behind = (tracks.view == view) & (tracks.xy[:, 0] > 8000.0)
    moved = replace(tracks, xy=tracks.xy + np.where(behind[:, None], [1.5, 0.0], 0.0))
    found = adjust_tracks(turned.views, moved, AdjustOptions())
    assert found.cameras.unknowns.model == "affine"
    (step,) = found.findings
    assert (step.kind, step.view, step.where[0]) == ("step", view, 0)
    assert min(abs(end - 8000.0) for end in step.where[1:3]) < 100.0
    # the corrected sensors have it, too
    at = np.array([[7000.0, 9000.0], [9000.0, 9000.0]])
    ground = turned.views[view].sensor.localize(at, np.full(2, 200.0))
    whole = adjust_tracks(turned.views, tracks, AdjustOptions())
    apart = [np.diff(one.sensors[view].project(ground), axis=0)[0] for one in (found, whole)]
    # what lies along the epipolar lines is told by the third image alone
    np.testing.assert_array_less(np.abs(apart[0] - apart[1] - [1.5, 0.0]), [0.15, 0.3])


def outcome_of(rms: float, noise: float = 1.0, drift: tuple[float, ...] = ()) -> Any:
    smooth = SimpleNamespace(found=lambda least: np.array([False, rms > least]))
    return SimpleNamespace(smooth=smooth, noise=noise, prior=SimpleNamespace(drift_sigma=drift))


def solution(outcome: Outcome, error: float = 1.0, problem: Any = None) -> Solution:
    state = SimpleNamespace(params=None, points=None)
    outcome.state = state  # type: ignore[misc]
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


@pytest.mark.slow
def test_an_earlier_blocks_drift_goes_on(made) -> None:
    centers = centers_of(made)
    for drift in (0, 2):
        first = solve(made, drift=drift, **CALM)
        prior = block_prior(first)
        assert prior.drift == drift
        found = adjust_tracks(made.views, made.tracks, AdjustOptions(noise_floor=0.0), centers=centers, prior=prior)
        assert found.params.shape[1] == 6 + 3 * drift
    assert solve(made, **CALM).params.shape[1] in (9, 12)


@pytest.mark.parametrize(
    ("model", "drift"), [("auto", 1), ("rotation", 1), ("translation", 0), ("affine", 0), ("shift", 0)]
)
def test_a_model_that_turns_starts_with_a_drift(made, model: str, drift: int) -> None:
    assert started(made, model=model).problem.cameras.unknowns.drift == drift


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


def uneven(made: SimulatedBlock) -> SimulatedBlock:
    """Observations of three sigmas, and noise to go with them."""
    sigma = np.array([0.1, 0.5, 2.0])[np.arange(len(made.tracks)) % 3]
    xy = made.tracks.xy + sigma[:, None] * np.random.default_rng(0).normal(size=made.tracks.xy.shape)
    return replace(made, tracks=replace(made.tracks, xy=xy, sigma=sigma))


def triangulated(sensors: Any, tracks: Tracks, xy: np.ndarray, sigma: np.ndarray | None) -> np.ndarray:
    return triangulate(list(sensors), tracks.view, tracks.point, xy, sigma, alt=300.0).points


def test_points_start_where_the_delivered_cameras_see_them_by_their_sigmas(made) -> None:
    given = uneven(made)
    state = started(given, centers_of(made), drift=0).state
    sensors = [view.sensor for view in given.views]
    weighted, equal = (triangulated(sensors, given.tracks, given.tracks.xy, s) for s in (given.tracks.sigma, None))
    off = [np.linalg.norm(state.points - there, axis=1) for there in (weighted, equal)]
    assert np.median(off[0]) < 0.02 < 0.3 < np.median(off[1])


def test_a_track_that_one_view_sees_is_weak_and_one_that_none_sees_is_none(made) -> None:
    keep = np.ones(len(made.tracks), dtype=bool)
    first, second = (np.flatnonzero(made.tracks.point == point) for point in (3, 8))
    keep[first[1:]] = keep[second] = False
    block = join(made.views, made.tracks, None, AdjustOptions())
    block = block.without(~keep[np.argsort(made.tracks.view, kind="stable")])
    heights = started(block, centers_of(made), drift=0).heights
    assert heights.weak[[2, 3, 4, 8]].tolist() == [False, True, False, False]
    assert np.setdiff1d(np.arange(150), heights.tracks).tolist() == [8]


@pytest.mark.few(1)
@pytest.mark.parametrize("kept", [1.0, 0.993, 0.5])
def test_the_scenes_move_is_from_where_the_delivered_cameras_put_what_is_seen_now(made, kept: float) -> None:
    """What was cut is mended before: places are those of the adjusted cameras."""
    given = uneven(made)
    block, problem, state, heights = started(given, centers_of(made), drift=0)
    params = np.random.default_rng(1).normal(0, 3, (3, 6))
    final = replace(state, params=params, points=state.points + 5.0)
    inlier = np.arange(len(block.view)) < kept * len(block.view)
    residual = problem.residuals(params, final.points)
    outcome: Any = SimpleNamespace(inlier=inlier, residual=residual, state=final)
    solution = Solution(problem, state, None, heights, outcome, None, None, None)  # type: ignore[arg-type]
    found = solution.first_points(block, np.ones(block.num_points, dtype=bool))
    few = np.arange(block.num_points) % 7 == 3
    some = solution.first_points(block, few)
    np.testing.assert_allclose(some[few], found[few], atol=1e-6)
    assert np.isnan(some[~few]).all()
    sensors = problem.cameras.unknowns.corrected(params, given.views)
    ground = ground_from_ecef(final.points)
    seen = np.array([sensors[v].project(ground[p]) for v, p in zip(given.tracks.view, given.tracks.point, strict=True)])
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


@pytest.mark.slow
def test_groups_are_listed_the_largest_first_five_views_of_five() -> None:
    assert chain((3,)).left_out == ()
    with pytest.raises(DisconnectedError) as caught:
        chain((5, 6, 2))
    assert [len(group) for group in caught.value.groups] == [6, 5, 2]
    text = "v05, v06, v07, v08, v09 and 1 more; v00, v01, v02, v03, v04; v11, v12; add"
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
    with pytest.raises(TiePointError, match=r"v09 \(0\) and 2 more: at least 4 tie points are needed"):
        join(views, empty, None, AdjustOptions())


# --- which rounds are taken ---------------------------------------------------------------------------------------


def script(
    monkeypatch, noises: list[float], kept: list[tuple[int, int]], found: bool = False,
    options: AdjustOptions | None = None, drift: int = 1, prior: Any = None,
) -> tuple[Any, list[tuple[int, str]]]:  # fmt: skip
    """The solution of rounds by script; every start, as drift and what was used.

    Of two views with 60 observations each, of which 50 are to be used; noise, and so many that are kept in each round.
    """
    view, point = np.repeat([0, 1], 60), np.tile(np.arange(60), 2)
    structure, use = make_structure(view, point, 2, 60), point < 50
    starts: list[tuple[int, str]] = []
    unknowns = SimpleNamespace(drift=drift, center="centres")

    def problem_of(block: Any, options: Any, centers: Any, prior: Any, drift: int | None = None) -> Any:
        degree = unknowns.drift if drift is None else drift
        cameras = SimpleNamespace(unknowns=SimpleNamespace(drift=degree, center="centres"))
        return SimpleNamespace(
            cameras=cameras, structure=structure, xy=None, project_points=lambda *_: None, camera_prior=None
        )

    @dataclass(frozen=True)
    class Start:
        params: Any
        points: Any

    class Scripted:
        def __init__(self, problem: Any, block: Any, state: Any, heights: Any, use: Any) -> None:
            starts.append((problem.cameras.unknowns.drift, use))
            self.number, self.residual, self.params = len(starts) - 1, "before", state.params
            self.projected = None

        def run(self) -> Any:
            inlier = point < np.repeat(kept[self.number], 60)
            smooth = SimpleNamespace(found=lambda least: np.array([found and least == 0.06]))
            return SimpleNamespace(
                number=self.number,
                noise=noises[self.number],
                inlier=inlier,
                smooth=smooth,
                state=Start(np.zeros((2, 9)), None),
                residual=None,
            )

    start = Start(np.zeros((2, 9)), None)
    monkeypatch.setattr(solved, "make_problem", problem_of)
    monkeypatch.setattr(solved, "first_state", lambda *_: (start, None))
    monkeypatch.setattr(solved, "measure", lambda *_: None)
    monkeypatch.setattr(solved, "Rounds", Scripted)
    monkeypatch.setattr(solved, "agreeing", lambda *_: Agreed(80))
    monkeypatch.setattr(solved, "retriangulate_rejected", lambda problem, state, *_: (state, None))
    monkeypatch.setattr(solved, "finished", lambda found, *_: found)
    monkeypatch.setattr(solved, "_without_deformation", lambda found, *_: found)
    seen = {"view": view, "point": point, "num_tracks": 60}
    block: Any = SimpleNamespace(use=use, sigma=1.0, views=("a", "b"), gcps=GroundPoints.none(), reference=None, **seen)
    options = AdjustOptions() if options is None else options
    made = solved.solve_block(block, None, options, None, None, prior)  # type: ignore[arg-type]
    named = [
        (drift, "all" if given is use else "agreed" if isinstance(given, Agreed) else "kept") for drift, given in starts
    ]
    return made, named


class Agreed:
    """So many observations that agree."""

    def __init__(self, count: int) -> None:
        self.count = count

    def sum(self) -> int:
        return self.count


@pytest.mark.parametrize(
    ("noise", "kept", "taken"), [(1.58, (21, 20), 1), (1.62, (21, 20), 0), (1.58, (20, 19), 0), (0.1, (20, 20), 0)]
)
def test_an_agreement_is_taken_that_leaves_a_fifth_less_noise_and_half_of_what_agrees(
    monkeypatch, noise: float, kept: tuple[int, int], taken: int
) -> None:
    found, starts = script(monkeypatch, [2.0, noise], [(35, 35), kept])
    assert found.outcome.number == taken
    assert starts == [(1, "all"), (1, "agreed")]


@pytest.mark.parametrize(
    ("noise", "kept", "asked"),
    [
        (1.5, (40, 40), False),  # four fifths of each view's
        (1.51, (50, 50), True),
        (1.0, (39, 50), True),
        (1.0, (50, 39), True),
    ],
)
def test_an_agreement_is_asked_for_where_rounds_leave_much_noise_or_less_than_most_of_a_view(
    monkeypatch, noise: float, kept: tuple[int, int], asked: bool
) -> None:
    assert script(monkeypatch, [noise, 9.0], [kept, kept])[1] == [(1, "all"), (1, "agreed")][: 1 + asked]


@pytest.mark.parametrize(
    ("given", "degrees"),
    [
        ({}, [1, 2]),
        ({"found": False}, [1]),  # nothing smooth above 0.06 px is left
        ({"drift": 0}, [0]),  # nothing turns
        ({"options": AdjustOptions(drift=1)}, [1]),
        ({"prior": "an earlier block"}, [1]),
    ],
)
def test_a_drift_of_another_degree_is_taken_where_it_may_be_and_something_smooth_is_left(
    monkeypatch, given: dict[str, Any], degrees: list[int]
) -> None:
    found, starts = script(monkeypatch, [1.0, 1.0], [(50, 50), (45, 45)], **{"found": True, **given})
    assert [drift for drift, _ in starts] == degrees
    assert found.problem.cameras.unknowns.drift == degrees[-1]
    assert set(found.asked) == ({"drift"} if len(degrees) > 1 else set())
    if len(degrees) > 1:
        assert starts[1][1] == "kept"
        assert found.outcome.number == 1


def test_a_camera_that_turns_faster_and_faster_is_followed_by_a_drift_of_a_further_degree() -> None:
    """Of a pair: by one degree a sixth of its ties is cut, and check tie points are off by a pixel."""
    made = simulate_block(2, 800, seed=3, attitude=10e-6, position=2.0)
    of_it, xy = made.tracks.view == 1, made.tracks.xy.copy()
    bend = 6.0 * ((2.0 * xy[:, 1] / made.views[1].size[1] - 1.0) ** 2 - 1.0 / 3.0)
    found = adjust_tracks(made.views, replace(made.tracks, xy=xy + (of_it * bend)[:, None] * [1.0, 0.5]))
    assert found.cameras.unknowns.drift == 2
    assert found.findings == ()
    assert found.cameras.unknowns.waves is None
    assert (found.inlier | found.held_out).mean() > 0.98
    assert found.held_out_rms.max() < 0.11


@pytest.mark.parametrize(("rms", "shared", "waves"), [(0.029, 0.029, False), (0.031, 0.0, True), (0.0, 0.031, True)])
def test_waves_are_what_is_smooth_or_what_neighbours_share(rms, shared, waves) -> None:
    outcome = outcome_of(rms)
    outcome.smooth.shared = np.array([0.0, shared])
    assert solution(outcome).has_waves == waves


def followed(monkeypatch, error: float, prior: Any = None, affine: float = 0.5) -> tuple[str, Any]:
    """What is taken of an affine with half of the error and what follows the model in space, and the error noted."""

    def solve_block(block: Any, outer: Any, options: AdjustOptions, *_: Any) -> Any:
        after = SimpleNamespace(error=affine if options.model == "affine" else 1.0, whole_rms=1.0)
        if options.model == "affine":
            after.whole_rms = 0.5
        return Said(options.model, after, has_trend=True, has_waves=True, goes_on=prior is not None)

    def follow(found: Any, *_: Any) -> Any:
        assert found.model == "auto"
        return Said("followed", SimpleNamespace(error=error))

    return searched(monkeypatch, solve_block, with_splines=follow, search_terms=lambda *_, **__: Selection())


def test_what_follows_the_model_in_space_is_taken_before_an_affine_that_is_not_much_better(monkeypatch) -> None:
    assert followed(monkeypatch, 0.33) == ("followed", None)  # two thirds of 0.5
    assert followed(monkeypatch, 0.34) == ("affine", 1.0)
    assert followed(monkeypatch, 0.9, affine=0.67) == ("followed", None)  # no affine was chosen
    assert followed(monkeypatch, 0.1, prior="an earlier block") == ("auto", None)
