"""Heights behind a jump that no image shows along its epipolar lines are said to be unknown, to the metre."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import adjust_tracks, pair_heights
from barpc.ba.unseen import unseen_steps
from barpc.base.geodesy import ground_from_ecef
from barpc.report import Run, summarize
from barpc.report.measures.block import explanations
from barpc.report.quality_checks import unseen_parts
from barpc.simulate import simulate_block

FROM = 350  # row


def jumped(lines: float, views: int = 2, axis: int = 1, seed: int = 0) -> tuple[Run, np.ndarray]:
    """A block whose second image has its last rows, or columns, displaced along their axis; its true heights."""
    made = simulate_block(views, 1500, seed=seed, per_site=views, size=(600, 600), attitude=5e-6, position=0.3, noise=0)
    xy = made.tracks.xy.copy()
    part = (made.tracks.view == 1) & (xy[:, axis] > FROM)
    xy[part, axis] -= lines
    noise = np.random.default_rng(seed).normal(0.0, 0.05, xy.shape)
    tracks = replace(made.tracks, xy=xy + noise)
    return Run("adjust", made.views, (), tracks, adjustment=adjust_tracks(made.views, tracks)), made.truth.ground


def apart(run: Run, true: np.ndarray) -> float:
    """By how much heights behind the jump are off beside those before it [m]."""
    ground = ground_from_ecef(run.adjustment.points)
    off = ground[:, 2] - true[:, 2]
    row = np.full(len(ground), np.nan)
    of = run.tracks.view == 1
    row[run.tracks.point[of]] = run.tracks.xy[of, 1]
    return float(np.nanmedian(off[row > FROM + 30]) - np.nanmedian(off[row < FROM - 30]))


def test_a_pair_with_a_jump_says_by_how_much_heights_behind_are_off() -> None:
    run, true = jumped(1.6)
    (part,) = unseen_parts(run, 1)
    assert not list(unseen_parts(run, 0))
    first, last = (int(word) for word in part.place.removeprefix("rows ").split("-"))
    assert min(abs(first - FROM), abs(last - FROM)) < 25
    assert part.metres == pytest.approx(abs(apart(run, true)), rel=0.15)
    (view,) = [view for view in summarize(run).views if view.cause == "along_lines"]
    assert "may be off by" in view.advice
    assert not summarize(run).passed


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize(("lines", "word"), [(3.0, "3 lines were lost"), (-5.0, "5 lines were repeated")])
def test_a_whole_number_of_lines_is_lost_and_heights_behind_are_right(lines: float, word: str) -> None:
    run, true = jumped(lines)
    assert abs(apart(run, true)) < 0.05  # 3.9 and 6.5 m by the part across the epipolar lines alone
    (told,) = explanations(run.adjustment)
    edge = re.fullmatch(rf"{word} at row (\d+) of view_0001.*", told.sentence)
    assert edge is not None
    assert abs(int(edge[1]) - FROM) < 25
    assert summarize(run).passed


@pytest.mark.nightly
def test_rows_displaced_in_both_coordinates_are_no_lost_lines() -> None:
    made = simulate_block(3, 1000, seed=0, per_site=3, size=(600, 600), attitude=5e-6, position=0.3, noise=0.05)
    xy = made.tracks.xy.copy()
    xy[(made.tracks.view == 1) & (xy[:, 1] > FROM)] += [0.5, -2.0]
    found = adjust_tracks(made.views, replace(made.tracks, xy=xy))
    assert [one.kind for one in found.findings] == ["step"]


@pytest.mark.parametrize(("lines", "views"), [pytest.param(3.0, 3, marks=pytest.mark.nightly), (0.0, 2)])
def test_a_third_image_sees_it_and_where_nothing_jumped_nothing_is_said(lines: float, views: int) -> None:
    run, _ = jumped(lines, views)
    assert not [part for i in range(views) for part in unseen_parts(run, i)]


def hidden(pixels: float) -> tuple[Run, float]:
    """A pair with a step along the epipolar lines of its second image; by how much heights behind it are off [m]."""
    made = simulate_block(2, 1500, seed=1, per_site=2, size=(600, 600), attitude=5e-6, position=0.3, noise=0)
    first, second = (view.sensor for view in made.views)
    low, high = (first.localize(np.array([300.0, 300.0]), np.array(alt)) for alt in (200.0, 300.0))
    along = second.project(high) - second.project(low)
    xy = made.tracks.xy + np.random.default_rng(1).normal(0.0, 0.05, made.tracks.xy.shape)
    xy[(made.tracks.view == 1) & (made.tracks.xy[:, 1] > FROM)] += pixels * along / np.hypot(*along)
    tracks = replace(made.tracks, xy=xy)
    run = Run("adjust", made.views, (), tracks, adjustment=adjust_tracks(made.views, tracks))
    return run, pixels * 100.0 / float(np.hypot(*along))


def said(run: Run) -> str:
    return " ".join(summarize(run).verdict)


def test_a_pair_says_what_step_it_would_not_have_seen_and_passes() -> None:
    run, off = hidden(2.0)
    summary, unseen = summarize(run), run.adjustment.unseen
    assert not run.adjustment.findings
    assert unseen is not None
    assert summary.passed
    assert "would not show in two images. Heights behind it would be off by up to" in said(run)
    largest = max(summary.scene.unseen, key=lambda one: one.height_m)
    assert largest.height_m / largest.largest_px == pytest.approx(off / 2.0, rel=0.3)
    heights, without = (pair_heights(replace(run.adjustment, unseen=u), 0, 1) for u in (unseen, None))
    assert heights.relative > without.relative
    assert heights.absolute < 1.1 * without.absolute


@pytest.mark.parametrize(("rise", "sigma"), [(0.0, 5.0), (12.0, 5.0), (0.0, np.nan)])
def test_heights_good_to_metres_show_a_step_or_bound_it(rise: float, sigma: float) -> None:
    """Lines along the rows' axis, 1.3 m of height a pixel."""
    rng, n = np.random.default_rng(0), 1000
    image = np.repeat(rng.uniform(0.0, 600.0, (n, 1, 2)), 2, axis=1)
    pull = np.tile([[0.0, 1.3], [0.0, -1.3]], (n, 1, 1))
    ground = np.column_stack([image[:, 0] * 5e-6, 200.0 + 0.05 * image[:, 0, 0] + rise * (image[:, 0, 1] > FROM)])
    known = 200.0 + 0.05 * image[:, 0, 0] + rng.normal(0.0, 1.0, n) * sigma
    found = unseen_steps(np.full((2, 2), 600.0), ground, image, pull, (0.1, 0.02), known)
    np.testing.assert_allclose(found.pixels[:, 0], 0.14, atol=0.03)  # across the lines tie points show it
    np.testing.assert_allclose(found.metres, found.pixels * [0.0, 1.3])
    if np.isnan(sigma):
        np.testing.assert_allclose(found.pixels[:, 1], 5.0)
        assert found.shown is None
        return
    # four standard deviations beside a cubic, of which a step in the middle leaves 0.035 of its square
    assert np.all(found.metres[:, 1] < 2.0 * 4.0 * sigma / np.sqrt(0.035 * n))
    assert (found.shown is None) == (rise == 0.0)
    if found.shown is not None:
        assert abs(found.shown.edge - FROM) < 40
        assert found.shown.metres == pytest.approx(rise, rel=0.25)
