"""Verdicts say in plain words what can be used, why not, and what to do."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from barpc.ba import adjust_tracks
from barpc.ba.resection import RpcDiagnosis
from barpc.ba.select.foreign_camera import ForeignCamera
from barpc.base.errors import BarpcWarning
from barpc.report import Run
from barpc.simulate import simulate_block
from tests.report.conftest import summarize

pytestmark = pytest.mark.filterwarnings("ignore:.*constrained in height")


def test_a_block_that_came_out_well_needs_no_advice(block_run):
    summary = block_run.summary
    assert summary["status"] == "good"
    assert summary["headline"] == "All 9 images are adjusted."
    assert {view["status"] for view in summary["views"]} == {"adjusted"}
    assert summary["passed"]


def test_a_check_of_wrong_cameras_says_to_adjust_them(check_run):
    summary = check_run.summary
    assert summary["status"] == "look"
    assert summary["headline"] == "9 of 9 images need review."
    assert all(view["advice"].endswith("Adjust the cameras") for view in summary["views"])
    assert not summary["passed"]


def test_a_view_without_tie_points_to_the_others_is_not_adjusted():
    made = simulate_block(4, 200, seed=5, attitude=3e-6)
    tracks = made.tracks.select(made.tracks.view != 3)
    with pytest.warns(BarpcWarning, match="keep their cameras"):
        adjustment = adjust_tracks(made.views, tracks, keep_largest=True)
    summary = summarize(Run("adjust", made.views, (), tracks, adjustment=adjustment))
    assert summary["views"][3]["status"] == "failed"
    assert summary["headline"] == "1 of 4 images is not adjusted."
    assert summary["status"] == "bad"
    assert not summary["passed"]


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("placed", "scale", "status", "said"),
    [
        (None, 1.0, "failed", "Its RPC does not match the image: with its axes swapped"),
        (
            SimpleNamespace(covariance=0.04 * np.eye(9)),
            1.0,
            "doubtful",
            "Its RPC does not match the image: with its axes",
        ),
        (SimpleNamespace(covariance=0.04 * np.eye(9)), 33.0, "doubtful", "Its RPC is 33 times less accurate than"),
    ],
)
def test_a_view_whose_rpc_is_not_its_own_is_named(block_run, placed, scale, status, said):
    run = block_run.run
    told = ForeignCamera((2,), 400.0, 400.0, None, 1.0, RpcDiagnosis(swapped=True), placed, scale)
    summary = summarize(replace(run, adjustment=replace(run.adjustment, apart=told)))
    view = summary["views"][2]
    assert view["status"] == status
    assert view["advice"].startswith(said)
    alone = "was not changed" if placed is None else "resected from the tie points of the other images"
    assert alone in view["advice"]
    assert summary["status"] == ("bad" if placed is None else "look")
    assert not summary["passed"]
    assert [one["name"] for one in summary["scene"]["explanations"]] == ["foreign_camera"]
    assert view["correction"]["center_sigma_px"] is view["correction"].get("ellipse") is None
    if placed is not None:  # with the others' points as they are
        assert view["correction"]["sigma"] == pytest.approx([0.2] * 9)


@pytest.mark.slow
def test_a_view_among_several_whose_rpc_may_be_strange_needs_a_look(block_run):
    run = block_run.run
    told = ForeignCamera((2, 0), 400.0, 9.0, None, 1.0, RpcDiagnosis(), None)
    summary = summarize(replace(run, adjustment=replace(run.adjustment, apart=told)))
    assert summary["status"] == "look"
    names = f"{summary['views'][2]['name']}, {summary['views'][0]['name']}"
    assert any(f"One of the images {names} has an RPC that does not match it" in line for line in summary["reasons"])
    assert {view["status"] for view in summary["views"]} == {"adjusted"}
    assert not summary["scene"]["explanations"]
