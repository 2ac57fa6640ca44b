"""Verdicts say in plain words what can be used, why not, and what to do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import adjust_tracks
from barpc.ba.gauge import MOTIONS, Mode
from barpc.errors import BarpcWarning
from barpc.fit import FitOptions
from barpc.options import RunOptions
from barpc.report import Run, summarize
from barpc.report.verdict import metres, mode_in_words


def test_a_block_that_came_out_well_needs_no_advice(block_run):
    summary = block_run.summary
    assert summary["status"] == "good"
    assert summary["headline"] == "All 9 images are adjusted."
    assert {view["status"] for view in summary["views"]} == {"adjusted"}
    assert summary["passed"]


def test_a_check_of_wrong_cameras_says_to_adjust_them(check_run):
    summary = check_run.summary
    assert summary["status"] == "look"
    assert summary["headline"] == "9 need a look (of 9)."
    assert all(view["advice"].endswith("adjust the cameras") for view in summary["views"])
    assert not summary["passed"]


def test_a_view_with_few_tie_points_is_weakly_tied(block_run):
    run = block_run.run
    rows = np.flatnonzero(run.tracks.view == 4)
    keep = np.ones(len(run.tracks), dtype=bool)
    keep[rows[20:]] = False
    tracks = run.tracks.select(keep)
    summary = summarize(Run("adjust", run.views, (), tracks, adjustment=adjust_tracks(run.views, tracks)))
    view = summary["views"][4]
    assert view["status"] == "weak"
    assert str(view["num_observations"]) in view["advice"]
    assert summary["headline"] == "1 needs a look (of 9)."
    assert any(line.startswith(f"{view['name']}: weakly tied: only") for line in summary["verdict"])


def test_a_view_without_tie_points_to_the_others_is_not_adjusted(block_run):
    run = block_run.run
    tracks = run.tracks.select(run.tracks.view != 8)
    with pytest.warns(BarpcWarning, match="keep their cameras"):
        adjustment = adjust_tracks(run.views, tracks, keep_largest=True)
    summary = summarize(Run("adjust", run.views, (), tracks, adjustment=adjustment))
    assert summary["views"][8]["status"] == "failed"
    assert summary["headline"] == "1 image is not adjusted (of 9)."
    assert summary["status"] == "bad"
    assert not summary["passed"]


def test_an_rpc_that_misses_its_tolerance_fails_its_view(block_run):
    options = RunOptions(fit=FitOptions(tolerance=1e-15))
    summary = summarize(replace(block_run.run, options=options))
    assert {view["status"] for view in summary["views"]} == {"failed"}
    assert "cannot hold the corrected camera" in summary["views"][0]["advice"]


def test_a_file_that_was_left_out_is_named(block_run):
    summary = summarize(replace(block_run.run, left_out=(("bad.tif", "has no RPC"),)))
    assert summary["status"] == "bad"
    assert "bad.tif was left out: has no RPC" in summary["verdict"]
    assert not summary["passed"]


def test_ground_control_changes_what_is_said_about_the_place(block_run):
    with_control = " ".join(block_run.summary["verdict"])
    without = " ".join(summarize(replace(block_run.run, gcps=None))["verdict"])
    assert "With 6 GCPs its place is known" in with_control
    assert "Without ground control its place is known" in without


@pytest.mark.parametrize("meaning", MOTIONS)
def test_every_weak_mode_has_its_sentence(meaning):
    words = mode_in_words(Mode(0.25, np.zeros(7), meaning))
    assert "25.0 cm" in words
    assert len(words) > 30


@pytest.mark.parametrize(
    ("value", "text"), [(1234.5, "1234.5 m"), (0.5, "50.0 cm"), (-0.02, "-2.0 cm"), (0.0, "0.0 mm")]
)
def test_lengths_are_readable(value, text):
    assert metres(value) == text
