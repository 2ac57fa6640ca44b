"""One camera that belongs to another image: found, named, and the others as without it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.ba.resection import RpcDiagnosis
from barpc.ba.select import foreign_camera, models
from barpc.ba.select.foreign_camera import find_foreign_camera
from barpc.ba.select.models import select_model
from barpc.ba.select.parts import Parts
from barpc.base.errors import AdjustError
from barpc.base.statistics import FEW
from barpc.scene import Tracks, View
from barpc.sensor.rpc import RPC
from barpc.sensor.triangulation import triangulate
from barpc.simulate import SimulatedBlock, simulate_block
from benchmarks.worlds import judge
from benchmarks.worlds_families import World, make

pytestmark = pytest.mark.filterwarnings("ignore:.*constrained in height")
Change = Callable[[RPC], RPC]
OFFSET = np.array([400.0, -900.0])


def swapped(rpc: RPC) -> RPC:
    """Line for sample."""
    turned = {name: getattr(rpc, name)[::-1] for name in ("image_offset", "image_scale")}
    return replace(rpc, coeffs=rpc.coeffs[[2, 3, 0, 1]], **turned)


def shifted(rpc: RPC) -> RPC:
    """Of another tile."""
    return replace(rpc, image_offset=rpc.image_offset + OFFSET)


def raised(rpc: RPC) -> RPC:
    """Heights above a surface 100 m lower."""
    return replace(rpc, ground_offset=rpc.ground_offset + np.array([0.0, 0.0, 100.0]))


def block_with(view: int, change: Change, views: int = 3, tracks: int = 300, seed: int = 1) -> SimulatedBlock:
    """A simulated block of which one view has an RPC that was changed."""
    made = simulate_block(views, tracks, seed=seed, attitude=5e-6, position=1.0)
    given = [replace(v, sensor=change(v.sensor)) if n == view else v for n, v in enumerate(made.views)]  # type: ignore[arg-type]
    return replace(made, views=tuple(given))


def without(block: SimulatedBlock, view: int) -> tuple[tuple[View, ...], Tracks]:
    tracks = block.tracks.select(block.tracks.view != view)
    views = tuple(v for n, v in enumerate(block.views) if n != view)
    number = np.cumsum(np.arange(len(block.views)) != view) - 1
    return views, Tracks(number[tracks.view], tracks.point, tracks.xy, tracks.sigma)


def met(found: Adjustment, block: SimulatedBlock, view: int) -> float:
    """RMS [px] at which a camera meets exact check points, intersected by all."""
    check = block.truth.check
    left = triangulate(found.sensors, check.view, check.point, check.xy).residuals[check.view == view]
    return float(np.sqrt(np.nanmean((left**2).sum(axis=1))))


@pytest.mark.parametrize(
    ("change", "look"),
    [
        pytest.param(shifted, "offset", id="another tile"),
        pytest.param(swapped, "axes", id="axes swapped", marks=pytest.mark.slow),  # before a commit: test_placing
        pytest.param(raised, "height", id="another datum", marks=pytest.mark.slow),
    ],
)
def test_a_wrong_rpc_is_named_and_the_others_are_as_without_it(monkeypatch, change: Change, look: str) -> None:
    block = block_with(2, change)
    if look == "height":  # a prior tells of one view where the others agree, which a pair always does
        assert adjust_tracks(block.views, block.tracks).apart is None
    if look != "axes":
        monkeypatch.setattr(foreign_camera, "AMBIGUOUS_VIEWS", 2)
    found, alone = adjust_tracks(block.views, block.tracks), adjust_tracks(*without(block, 2))
    assert found.apart.views == (2,)
    assert found.in_space_rms is None
    assert not found.findings
    np.testing.assert_allclose(found.params[:2], alone.params, atol=0.25)
    np.testing.assert_allclose(found.rmse()[:2], alone.rmse(), atol=0.01)
    said = found.apart.look
    if look == "axes":
        assert said.swapped
        assert found.apart.placed is None
        assert not found.params[2].any()
        assert not found.inlier[block.tracks.view == 2].any()
        assert found.apart.gain > 100.0
    else:
        assert said.offset is not None
        if look == "offset":
            np.testing.assert_allclose(said.offset, OFFSET, atol=20.0)
            assert said.height is None
        else:
            assert said.height == pytest.approx(-100.0, abs=20.0)
        assert found.apart.placed is not None
        assert met(found, block, 2) < 0.1
        assert 0.8 < found.held_out_noise[2] < 1.3
        seen = np.bincount(block.tracks.point)[block.tracks.point] == 3  # by two others
        taking_part = (block.tracks.view == 2) & ~found.held_out & seen
        assert found.inlier[taking_part].mean() > 0.9


@pytest.mark.slow
def test_nothing_is_tried_where_the_block_agrees(monkeypatch) -> None:
    tried: list[Any] = []

    def watched(first: Any, block: Any, outer: Any, options: Any, solve: Any) -> Any:
        tried.append(find_foreign_camera(first, block, outer, options, pytest.fail))
        return tried[-1]

    monkeypatch.setattr(models, "find_foreign_camera", watched)
    made = simulate_block(3, 400, seed=3, attitude=10e-6, position=2.0)
    wrong = np.random.default_rng(1).uniform(size=len(made.tracks)) < 0.1
    noisy = replace(made.tracks, xy=made.tracks.xy + wrong[:, None] * [9.0, -14.0])
    for tracks in (made.tracks, noisy):
        assert adjust_tracks(made.views, tracks).apart is None
    assert tried == [(None, None)] * 2


@pytest.mark.slow
def test_a_view_of_wrong_matches_is_no_foreign_one() -> None:
    made, rng = simulate_block(3, 150, seed=3, attitude=10e-6, position=2.0), np.random.default_rng(1)
    wrong = (made.tracks.view == 2) & (rng.uniform(size=len(made.tracks)) < 0.7)
    off = rng.uniform(-30.0, 30.0, made.tracks.xy.shape)
    found = adjust_tracks(made.views, replace(made.tracks, xy=made.tracks.xy + wrong[:, None] * off))
    assert found.apart is None
    assert found.inlier[(made.tracks.view == 2) & ~wrong & ~found.held_out].mean() > 0.9


@pytest.mark.landing(2)
@pytest.mark.few(2)
@pytest.mark.parametrize("num", [14, 20, 30])
@pytest.mark.parametrize("views", [3, 5])
def test_of_few_tie_points_those_of_one_view_may_all_be_wrong(views: int, num: int) -> None:
    """As of another date, cloud or scale: it is named, or its ties are rejected, and the others are adjusted."""
    for seed in range(3):
        made, bad = simulate_block(views, num, seed=seed, per_site=views, num_checks=200), seed % views
        of_it, xy = made.tracks.view == bad, made.tracks.xy.copy()
        xy[of_it] += np.random.default_rng(seed).uniform(-300.0, 300.0, (of_it.sum(), 2))
        found = adjust_tracks(made.views, replace(made.tracks, xy=xy), AdjustOptions(min_convergence=0.01))
        assert (found.apart is None) == (views == 5)
        assert found.apart is None or found.apart.views == (bad,)
        assert found.apart is None or np.isnan(found.apart.contradicted)  # too few to place it, and so to say
        assert found.inlier[of_it].sum() <= 2
        assert found.inlier[~of_it & ~found.held_out].mean() > 0.9
        assert np.abs(found.residuals[found.inlier]).max() < 0.5
        np.testing.assert_allclose(found.params[bad], 0.0, atol=1e-9 if views == 3 else 30.0)


@pytest.mark.parametrize("seed", [2, 4])
def test_no_view_is_left_out_for_a_drift_where_few_tracks_are_of_three_views(seed: int) -> None:
    """Small images that drift by 0.4 % of their side, all ties right; a pair of any two of the views agrees."""
    made = simulate_block(
        3, 90, seed=seed, size=(750, 750), gsd=0.5, per_site=3, drift=4e-6, noise=0.06, visible=0.5,
        alt_range=(100.0, 400.0), attitude=10e-6, position=3.0,
    )  # fmt: skip
    assert (np.bincount(made.tracks.point) == 3).sum() < FEW
    found = adjust_tracks(made.views, made.tracks)
    assert found.apart is None
    assert made.held_out_rms(list(found.sensors)) < 0.03


@pytest.mark.parametrize("num", [20, 30])
def test_of_two_views_whose_ties_are_all_wrong_too_few_agree(num: int) -> None:
    made = simulate_block(2, num, seed=1)
    xy = made.tracks.xy + np.random.default_rng(1).uniform(-300.0, 300.0, made.tracks.xy.shape)
    with pytest.raises(AdjustError, match=f"of {2 * num} observations . are inliers, and an image needs 4"):
        adjust_tracks(made.views, replace(made.tracks, xy=xy), AdjustOptions(min_convergence=0.01), hold_out=False)


@pytest.mark.parametrize("given", [{"model": "affine"}, {"drift": 0}])
def test_who_asks_for_less_than_cameras_have_gets_it_of_all(given) -> None:
    block: Any = SimpleNamespace(views=(None,) * 4)
    assert find_foreign_camera(None, block, block, AdjustOptions(**given), pytest.fail) == (None, None)


def no_solve(*_: Any) -> Any:
    raise AdjustError("no step lowers the cost")


def scripted(monkeypatch, evidence: list[float], contradicted: list[float]) -> Any:
    """A block of which each view's leaving makes the others agree with so much evidence; all together do not."""
    num = len(evidence)

    def agreeing(views: Any, *_: Any) -> Any:
        for v in views:
            yield v, SimpleNamespace(views=(None,) * num), "solved"

    def placed(found: Any, others: Any, block: Any, view: int) -> Any:
        told = {"contradicted": contradicted[view], "is_coherent": True}
        return SimpleNamespace(meets=False, squared=np.zeros(200), **told)

    monkeypatch.setattr(foreign_camera, "_leave_one_view_out", agreeing)
    monkeypatch.setattr(foreign_camera, "resect", placed)
    monkeypatch.setattr(foreign_camera.LeaveOneOut, "usual", 0.02)
    monkeypatch.setattr(foreign_camera, "_tie_evidence", lambda one, block: evidence[one.view])
    monkeypatch.setattr(foreign_camera, "diagnose_rpc", lambda *_: "looked")
    return SimpleNamespace(views=(None,) * num, names=tuple("abcdef"[:num]))


def found_in(block: Any) -> Any:
    return find_foreign_camera(None, block, block, AdjustOptions(), pytest.fail)


def test_of_two_views_as_likely_none_is_taken_out_and_without_a_solution_both_are_named(monkeypatch) -> None:
    block = scripted(monkeypatch, [-100.0, -96.0, -300.0], [0.9, 0.9, 0.1])
    found, solved = found_in(block)
    assert (found.views, found.clear, solved) == ((1, 0), False, None)
    assert (found.gap, found.runner_up) == (204.0, 2)
    with pytest.raises(AdjustError, match=r"no step lowers the cost\. Without any one of b, a the other views agree"):
        select_model(SimpleNamespace(inner=block, outer=block), AdjustOptions(), no_solve)  # type: ignore[arg-type]
    found, solved = found_in(scripted(monkeypatch, [-100.0, -94.0, -300.0], [0.9, 0.9, 0.1]))
    assert (found.views, found.clear, solved) == ((1,), True, "solved")
    assert (found.gap, found.runner_up) == (6.0, 0)


@pytest.mark.parametrize(("covered", "worth"), [((4, 3), 50.0 - 2 * np.log(5e4)), (None, -9 * np.log(5e4))])
def test_ties_that_the_others_do_not_explain_lie_anywhere_in_their_images(monkeypatch, covered, worth) -> None:
    """Nine of tracks are in use, in images of 2000 px^2, 50,000 times the square of their sigma of 0.2 px."""
    asked: list[Any] = []

    def looked(outcome: Any, block: Any, views: Any) -> Any:
        asked.append((outcome.problem, block, views.tolist()))
        rows = None if covered is None else [SimpleNamespace(rows=np.zeros((n, 1))) for n in covered]
        return None if rows is None else (SimpleNamespace(tracks=rows), "state")

    def fitted(linear: Any) -> Any:
        assert linear.area == linear.image_area == pytest.approx(5e4)
        return SimpleNamespace(evidence=50.0)

    monkeypatch.setattr(foreign_camera, "linearised_among", looked)
    monkeypatch.setattr(foreign_camera, "fit_mixture", fitted)
    monkeypatch.setattr(foreign_camera, "replace", lambda of, **more: SimpleNamespace(**{**vars(of), **more}))
    rest = SimpleNamespace(views=(None,) * 2)
    outcome = SimpleNamespace(problem=SimpleNamespace(camera_prior="learnt"))
    found = SimpleNamespace(outcome=outcome, problem=SimpleNamespace(camera_prior="stated"))
    size = [SimpleNamespace(size=one) for one in ((10, 200), (20, 100), (50, 100))]
    block: Any = SimpleNamespace(
        use=np.arange(11) > 0, point=np.arange(11), num_tracks=10, views=size, sigma=np.full(11, 0.2)
    )
    assert foreign_camera._tie_evidence(SimpleNamespace(found=found, block=rest), block) == pytest.approx(worth)  # type: ignore[arg-type]
    ((problem, given, views),) = asked
    assert (problem.camera_prior, given, views) == ("stated", rest, [0, 1])


@pytest.mark.parametrize(("lost", "own"), [(0.3, 0.6), (0.7, 0.7), (1.0, 0.999)])
def test_the_gain_of_an_own_share_is_that_of_two_binomials_less_the_choice(lost, own) -> None:
    """Beside others of which 2 in 100 ties are cut in the middle one."""
    view, row = np.divmod(np.arange(400), 100)
    placed: Any = SimpleNamespace(squared=np.zeros(200))
    block: Any = SimpleNamespace(views=(None,) * 4, view=view, point=row, num_tracks=100, use=np.ones(400, dtype=bool))
    found: Any = SimpleNamespace(outcome=SimpleNamespace(inlier=row >= np.array([0, 50, 2, 9])[view]))
    one = foreign_camera.LeaveOneOut(1, block, found, placed, 0.6, True)
    expected = 200 * (own * np.log(own / 0.02) + (1.0 - own) * np.log((1.0 - own) / 0.98)) - np.log(4.0)
    assert one.gain(lost) == pytest.approx(expected)


def test_a_view_of_which_half_agrees_is_its_own(monkeypatch) -> None:
    assert found_in(scripted(monkeypatch, [0.0, 0.0, 0.0], [0.50, 0.3, 0.02])) == (None, None)
    assert found_in(scripted(monkeypatch, [0.0, -9.0, -9.0], [0.52, 0.3, 0.02]))[0].views == (0,)


# --- cameras that are not barpc's simulator's -----------------------------------------------------------------------


def beside(world: World, odd: int) -> tuple[Adjustment, float, float]:
    """A world adjusted, and by how much the others' check points [px] and their shape [m] are worse than without it."""
    rest = world.without(odd)
    found, alone = adjust_tracks(world.views, world.tracks), adjust_tracks(rest.views, rest.tracks)
    kept = [sensor for v, sensor in enumerate(found.sensors) if v != odd]
    one, other = judge(rest, kept), judge(rest, alone.sensors)
    return found, float(np.max(np.subtract(one.rms, other.rms))), one.shape - other.shape


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(5, id="tile of 4"),
        pytest.param(4, id="axes of 3"),
        pytest.param(10, id="date of 5"),
        pytest.param(0, id="date of 3", marks=pytest.mark.nightly),
    ],
)
def test_a_foreign_rpc_leaves_the_others_as_without_it(seed: int) -> None:
    world = make("foreign", seed)
    (odd,) = world.plan.deliver
    found, worse, shape = beside(world, odd)
    assert found.apart.views == (odd,)
    assert found.in_space_rms is None
    assert abs(worse) < 0.005
    assert abs(shape) < 0.02
    assert found.apart.look.swapped == (seed == 4)
    assert (found.apart.look.offset is not None) == (seed == 5)
    assert (found.apart.placed is not None) == (seed == 5)
    if seed == 5:  # adjusted alone it is as good as the others
        assert judge(world, found.sensors).rms[odd] < 0.03


@pytest.mark.nightly
def test_detectors_that_lie_off_make_a_camera_no_other_images() -> None:
    """Eight of a pixel each: more than half of its ties contradict the others wherever it is, but its columns do it."""
    world = make("plane", 6)
    found = adjust_tracks(world.views, world.tracks)
    assert found.apart is None
    assert judge(world, [view.sensor for view in world.views]).left > 20.0
    assert judge(world, found.sensors).left < 0.15
    (fault,) = world.plan.injected
    (odd,) = fault.views
    of_it = ~found.held_out & (world.tracks.view == odd) & ~world.bad
    assert found.inlier[of_it].mean() > 0.97


def test_a_view_is_its_own_where_a_solution_keeps_its_ties_and_none_move() -> None:
    view, every = np.repeat(np.arange(3), 4), np.ones(12, dtype=bool)
    block: Any = SimpleNamespace(
        view=view, views=(None,) * 3, point=0 * view, num_tracks=1, use=every, without=lambda rows: block
    )
    for kept, moves, own in ((2, False, True), (1, False, False), (4, True, False)):
        inlier = np.ones(12, dtype=bool)
        inlier[: 4 - kept] = False
        found: Any = SimpleNamespace(outcome=SimpleNamespace(inlier=inlier))
        group = np.where(np.arange(12) == 11, int(moves), 0)
        assert Parts(block, np.zeros(12, dtype=bool), group).fits_view(found, 0) == own
        assert Parts(block, np.zeros(12, dtype=bool), group).fits_view(found, 1) == (not moves)


@pytest.mark.parametrize(
    ("look", "placed", "views", "own"),
    [
        (RpcDiagnosis(as_stated=True), None, (1,), True),
        (RpcDiagnosis(offset=np.array([5.0, 3.0])), None, (1,), True),
        (RpcDiagnosis(), None, (1,), False),  # it does not see the place at all
        (RpcDiagnosis(swapped=True), None, (1,), False),
        (RpcDiagnosis(as_stated=True), "placed", (1,), False),  # it meets the others where it was found
        (RpcDiagnosis(as_stated=True), None, (1, 2), False),
    ],
)
def test_an_image_of_the_place_may_be_distorted(
    look: RpcDiagnosis, placed: Any, views: tuple[int, ...], own: bool
) -> None:
    assert foreign_camera.ForeignCamera(views, 9.0, 9.0, None, 0.6, look, placed).may_be_distorted == own


@pytest.mark.nightly
@pytest.mark.parametrize(("family", "seed"), [("cloud", 1), ("clean", 9), ("wander", 3), ("priors", 0), ("local", 4)])
def test_what_is_wrong_otherwise_is_no_foreign_rpc(family: str, seed: int) -> None:
    world = make(family, seed)
    assert adjust_tracks(world.views, world.tracks).apart is None
