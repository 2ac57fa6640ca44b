"""Explanations that compete: what lies off is named where it is, and nothing is where nothing is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.scene import Tracks
from barpc.sensor.image_corrections import Splined
from barpc.sensor.triangulation import triangulate
from barpc.simulate import SimulatedBlock, simulate_block
from tests.costs import once
from tests.lanes import rest_slow

pytestmark = pytest.mark.filterwarnings("ignore:.*constrained in height")
Displaced = dict[str, Any]


def profile_of(tracks: Tracks, where: Displaced, size: tuple[int, int]) -> np.ndarray:
    """By how much ties (K, 2) are displaced: as they are, fading over a length, or swinging with a period."""
    place = tracks.xy[:, where["axis"]] / size[where["axis"]]
    inside = (tracks.view == where["view"]) & (place >= where["start"]) & (place < where["stop"])
    shape = np.ones(len(place))
    if "length" in where:
        shape = np.exp(-(place - where["start"]) / where["length"])
    if "period" in where:
        shape = np.sin(2.0 * np.pi * tracks.xy[:, where["axis"]] / where["period"] + 1.0)
    return (inside * shape * where["px"])[:, None] * np.array([np.cos(0.6), np.sin(0.6)])


def flawed(views: int, tracks: int, *all_of: Displaced, seed: int = 0, **options: Any) -> tuple[SimulatedBlock, Tracks]:
    block = simulate_block(views, tracks, seed=seed, attitude=10e-6, position=2.0, **options)
    xy = block.tracks.xy.copy()
    for where in all_of:
        xy += profile_of(block.tracks, where, block.views[where["view"]].size)
    return block, replace(block.tracks, xy=xy)


def adjusted(block: SimulatedBlock, tracks: Tracks, **options: Any) -> Adjustment:
    return adjust_tracks(block.views, tracks, AdjustOptions(**options))


@once
def in_the_middle() -> tuple[SimulatedBlock, Tracks, Adjustment]:
    """A block of which rows in the middle of an image lie off, and its adjustment."""
    block, tracks = flawed(3, 300, MIDDLE)
    return block, tracks, adjusted(block, tracks)


ROWS = {"view": 0, "axis": 1, "start": 0.85, "stop": 1.1, "px": 3.0}
MIDDLE = {"view": 1, "axis": 1, "start": 0.4, "stop": 0.6, "px": 0.8}
DETECTOR = {"view": 2, "axis": 0, "start": 0.25, "stop": 0.375, "px": 1.0}


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("where", rest_slow([MIDDLE, ROWS, DETECTOR]), ids=["middle", "end", "detector"])
def test_rows_and_columns_that_lie_off_are_named_and_followed(where: Displaced) -> None:
    if where is MIDDLE:
        block, tracks, found = in_the_middle()
    else:
        block, tracks = flawed(3, 1500, where)
        found = adjusted(block, tracks)
    one = found.findings[0]
    assert (one.kind, one.view) == ("step", where["view"])
    assert len(found.findings) == 1
    assert found.apart is None  # no RPC of another image
    size = block.views[one.view].size[where["axis"]]
    ends = np.array(one.where[1:3]) / size
    assert one.where[0] == where["axis"]
    np.testing.assert_allclose(ends.clip(0, 1), np.clip([where["start"], where["stop"]], 0, 1), atol=0.01)
    moved = where["px"] * np.array([np.cos(0.6), np.sin(0.6)])
    np.testing.assert_allclose(one.size, -moved if one.size @ moved < 0 else moved, atol=0.1)
    assert one.gain > 50.0
    assert not found.left
    # of the ties that were displaced hardly one is cut, and the cameras have the strip
    inside = (profile_of(block.tracks, where, block.views[one.view].size) != 0).any(axis=1)
    assert found.inlier[inside & ~found.held_out].mean() > 0.9
    sensor = found.sensors[one.view]
    assert isinstance(sensor, Splined)
    assert len(sensor.correction.steps) == 1
    assert np.sqrt((found.residuals[inside & ~found.held_out] ** 2).sum(axis=1).mean()) < 0.16
    others = [s for v, s in enumerate(found.sensors) if v != one.view]
    assert not any(isinstance(s, Splined) and s.correction.step_sizes.any() for s in others)


@pytest.mark.nightly
def test_two_of_them_in_two_images_are_both_found() -> None:
    found = adjusted(*flawed(3, 1500, MIDDLE, {**DETECTOR, "px": 2.0}))
    assert {(one.kind, one.view) for one in found.findings} == {("step", 1), ("step", 2)}
    assert all(one.share < 0.1 and one.off < 0.03 for one in found.left)  # ties beside an end


@pytest.mark.nightly
def test_what_fades_is_named_with_its_length() -> None:
    where = {"view": 1, "axis": 1, "start": 0.0, "stop": 1.1, "px": 4.0, "length": 0.05}
    block, tracks = flawed(3, 2500, where)
    found = adjusted(block, tracks)
    assert [(one.kind, one.view) for one in found.findings] == [("decay", 1)]
    rows = block.views[1].size[1]
    assert 1.0 / found.findings[0].where[4] == pytest.approx(0.05 * rows, rel=0.25)
    assert np.hypot(*found.findings[0].size) == pytest.approx(4.0, rel=0.1)


@pytest.mark.nightly
@pytest.mark.parametrize("first", [0.0, 1.0], ids=["beginning", "end"])
def test_all_images_that_settle_are_explained_together(first: float) -> None:
    """All see the same ground there: their ties agree with each other, as if it moved."""
    block = simulate_block(4, 800, seed=2, attitude=10e-6, position=2.0)
    rows = block.views[0].size[1]
    away = np.abs(block.tracks.xy[:, 1] / rows - first)
    angle = np.array([0.3, 1.9, 3.7, 5.2])[block.tracks.view]
    moved = 8.0 * np.exp(-away / 0.02) * np.array([np.cos(angle), np.sin(angle)])
    found = adjusted(block, replace(block.tracks, xy=block.tracks.xy + moved.T))
    assert [one.kind for one in found.findings] == ["transient"] * 4
    assert sorted(one.view for one in found.findings) == [0, 1, 2, 3]
    for one in found.findings:
        rate = 1.0 / (0.02 * rows)
        assert one.where[4] == pytest.approx(rate if first == 0.0 else -rate, rel=0.1)
    near = (away < 0.1) & ~found.held_out
    assert found.inlier[near].mean() > 0.9  # of all that were displaced
    assert np.median(np.hypot(*found.residuals[near].T)) < 0.12
    assert not found.moving.any()


def swing(px: float, period: float, view: int = 1) -> Displaced:
    """Rows of an image swing."""
    return {"view": view, "axis": 1, "start": 0.0, "stop": 1.1, "px": px, "period": period}


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize("size", rest_slow([(0.15, 200.0), (0.08, 200.0), (0.15, 60.0), (0.3, 600.0)]), ids=str)
def test_rows_that_swing_are_named_with_their_period_and_followed(size: tuple[float, float]) -> None:
    px, period = size
    block, tracks = flawed(3, 1500, swing(px, period))
    found = adjusted(block, tracks)
    (one,) = found.findings
    assert (one.kind, one.view, one.where) == ("sinusoid", 1, None)
    rows = block.views[1].size[1]
    assert rows / one.period == pytest.approx(rows / period, abs=0.2)  # waves of the image
    assert np.hypot(*one.size) == pytest.approx(px, abs=0.02)
    assert one.or_of == ()
    correction = found.sensors[1].correction  # type: ignore[attr-defined]
    assert correction.periods.tolist() == [one.period]
    assert not len(correction.steps)
    row = np.linspace(0.0, rows, 2000)
    moved = correction.at(np.column_stack([row * 0.0, row]))
    true = px * np.sin(2.0 * np.pi * row / period + 1.0)[:, None] * np.array([np.cos(0.6), np.sin(0.6)])
    # a camera's drift may take up a part of it, and ties of 0.1 px do not say more
    assert np.sqrt(((moved - true) ** 2).sum(axis=1).mean()) < 0.02 + 0.1 * px
    others = [s.correction for v, s in enumerate(found.sensors) if v != 1]  # type: ignore[attr-defined]
    assert not any(len(one.periods) or len(one.steps) for one in others)


@pytest.mark.slow
def test_of_a_pair_a_swing_is_that_of_one_or_of_either() -> None:
    found = adjusted(*flawed(2, 2000, swing(0.2, 300.0)))
    (one,) = found.findings
    assert one.kind == "sinusoid"
    assert 1 in (one.view, *one.or_of)
    assert one.period == pytest.approx(300.0, rel=0.02)
    assert 0.03 < np.hypot(*one.size) < 0.22  # what lies along epipolar lines is not seen
    assert np.nanmax(found.held_out_rms) < 0.1


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_swing_below_the_floor_is_none(seed: int) -> None:
    assert not adjusted(*flawed(3, 4000, swing(0.02, 200.0), seed=seed)).findings


@pytest.mark.slow
def test_what_fades_after_a_large_step_is_followed_from_where_the_judge_ends() -> None:
    where = {"view": 0, "axis": 1, "start": 0.6, "stop": 1.1, "px": 25.0, "length": 0.8}
    found = adjusted(*flawed(2, 1500, where))
    assert found.findings[0].kind == "decay"
    assert found.inlier[~found.held_out].mean() > 0.95
    assert np.nanmax(found.held_out_rms) < 0.16


@pytest.mark.landing(8)
@pytest.mark.parametrize("seed", rest_slow(range(8)))
@pytest.mark.parametrize("outliers", rest_slow([0.1, 0.0, 0.3]))
def test_nothing_is_found_where_nothing_is(seed: int, outliers: float) -> None:
    found = adjusted(*flawed(2 + seed % 3, 800, seed=100 + seed, outliers=outliers))
    assert not found.findings
    assert not found.left


@pytest.mark.nightly
def test_rows_that_wander_are_not_taken_for_strips() -> None:
    block = simulate_block(3, 1000, seed=3, attitude=10e-6, position=2.0)
    xy, rows = block.tracks.xy.copy(), block.views[1].size[1]
    u = xy[:, 1] / rows
    xy[:, 0] += (block.tracks.view == 1) * 0.6 * (np.sin(17.0 * u + 1.0) + np.cos(11.0 * u))
    found = adjusted(block, replace(block.tracks, xy=xy))
    assert found.findings[0].kind == "low_frequency"
    assert not any(one.kind in ("step", "decay") for one in found.findings)
    at = np.linspace(0.0, rows - 1.0, 300)
    size = [
        s.correction.at(np.column_stack([at, at]))[:, 0].std() if isinstance(s, Splined) else 0.0 for s in found.sensors
    ]
    assert 0.4 < size[1] < 0.65  # 0.6, of which a drift takes some
    assert max(size[0], size[2]) < 0.4 * size[1]


@pytest.mark.nightly
@pytest.mark.parametrize("options", [{"jitter": "off"}, {"drift": 0}], ids=str)
def test_who_asked_for_no_such_unknowns_is_told_and_gets_none(options: dict[str, Any]) -> None:
    found = adjusted(*flawed(3, 600, MIDDLE), **options)
    assert found.findings
    assert found.left
    assert not any(isinstance(sensor, Splined) for sensor in found.sensors)


def test_exact_points_meet_in_the_strip_and_beside_it() -> None:
    """Points that the adjustment never saw, in the cameras as they flew."""
    _, tracks, found = in_the_middle()
    seen = found.held_out
    points = np.unique(tracks.point[seen])
    rows = np.isin(tracks.point, points)
    index = np.searchsorted(points, tracks.point[rows])
    met = triangulate(found.sensors, tracks.view[rows], index, tracks.xy[rows])
    assert np.isfinite(met.points).all()
    assert np.nanmax(found.held_out_rms) < 0.16


@pytest.mark.slow
def test_what_cannot_be_judged_is_adjusted_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise np.linalg.LinAlgError("7-th leading minor")

    monkeypatch.setattr("barpc.ba.select.search.fit_mixture", fails)
    found = adjusted(*flawed(3, 400, MIDDLE))
    assert not found.findings
    assert {one.view for one in found.left} == {1}  # and what stands out is still said


@pytest.mark.nightly
def test_in_a_block_of_many_views_two_flaws_far_from_each_other_are_followed() -> None:
    """More unknowns than all views may have together, so that explanations are tried on parts of the block."""
    jump = {"view": 30, "axis": 1, "start": 0.5, "stop": 1.1, "px": 3.0}
    rows = 20000
    block, tracks = flawed(60, 3000, jump, swing(0.8, rows / 7.0, view=55), seed=2)
    found = adjusted(block, tracks)
    assert {(one.kind in ("step", "decay"), one.kind == "sinusoid", one.view) for one in found.findings} == {
        (True, False, 30), (False, True, 55),
    }  # fmt: skip
    by_kind = {one.kind == "sinusoid": one for one in found.findings}
    assert by_kind[True].period == pytest.approx(rows / 7.0, rel=0.01)
    assert np.hypot(*by_kind[True].size) == pytest.approx(0.8, abs=0.05)
    ends = np.array(by_kind[False].where[1:3]) / rows
    assert np.abs(ends - 0.5).min() < 0.02
    assert not found.left
    assert found.inlier[np.isin(tracks.view, [30, 55]) & ~found.held_out].mean() > 0.95
