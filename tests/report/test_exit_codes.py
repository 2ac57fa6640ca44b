"""One rule: a run passes when nothing has a reservation; whatever has one is said, with exit code 3."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.report.measures.views import measure_views
from barpc.report.quality_checks import PASSED_STATUS
from barpc.report.summary.words import STATUS_WORDS
from barpc.report.verdict import block_verdict
from tests.lanes import diagonal
from tests.report.conftest import summarize

ADVICE = {"weak": "only 3 tie points", "doubtful": "tie points are left with 2 px", "failed": "not tied"}
OVERALL = {"weak": "look", "doubtful": "look", "failed": "bad"}


@pytest.fixture(scope="module")
def verdict(block_run):
    """What is said of the block with a status of its second image."""
    run, measured = block_run.run, measure_views(block_run.run)

    def said(status, kind="adjust", **changes):
        views = [replace(view, status=PASSED_STATUS[kind], advice="") for view in measured]
        views[1] = replace(views[1], status=status, advice=ADVICE.get(status, ""))
        return block_verdict(replace(run, kind=kind, **changes), views)

    return said


@pytest.mark.parametrize(("kind", "status"), diagonal(PASSED_STATUS, STATUS_WORDS))
def test_every_status_of_an_image_decides_the_whole(status, kind, verdict):
    found = verdict(status, kind)
    assert found["status"] == OVERALL.get(status, "good")
    assert bool(found["reasons"]) == (status in OVERALL)
    assert set(found["reasons"]) <= set(found["verdict"])
    if status in OVERALL:
        assert ADVICE[status] in found["reasons"][0]
        assert "1 of 9 images" in found["headline"]


@pytest.mark.parametrize("kind", PASSED_STATUS)
def test_a_file_that_was_left_out_never_passes(kind, verdict):
    found = verdict(PASSED_STATUS[kind], kind, left_out=(("bad.tif", "has no RPC"),))
    assert found["status"] == "bad"
    assert found["reasons"] == ["bad.tif was left out: has no RPC"]


def test_a_rejected_gcp_of_unknown_error_needs_a_look(block_run):
    run = block_run.run
    tested = run.adjustment.control
    used = np.arange(len(tested.used)) != 2
    unknown = np.where(used[:, None], tested.residual, np.nan)
    control = replace(tested, used=used, w=np.where(used, tested.w, np.nan), residual=unknown)
    summary = summarize(replace(run, adjustment=replace(run.adjustment, control=control)))
    assert (summary["status"], summary["passed"]) == ("look", False)
    assert summary["headline"] == "All 9 images are adjusted; ground points need review."
    (reason,) = summary["reasons"]
    assert reason.startswith("1 GCP rejected")
    assert "too few images" in reason


@pytest.mark.few(1)
@pytest.mark.parametrize(("noise", "said"), [(2.4, False), (2.6, True), (float("nan"), False)])
def test_an_image_is_judged_by_tie_points_that_took_no_part(noise, said, block_run):
    run = block_run.run
    of_views, rms = run.adjustment.held_out_noise.copy(), run.adjustment.held_out_rms.copy()
    of_views[3], rms[3] = noise, 0.31
    summary = summarize(replace(run, adjustment=replace(run.adjustment, held_out_noise=of_views, held_out_rms=rms)))
    view = summary["views"][3]
    assert view["held_out_px"] == 0.31
    assert (view["status"] == "doubtful") == said
    if said:
        assert "Check tie points have residuals of 0.31 px, 2.6 times" in view["advice"]
        assert not summary["passed"]


def test_what_takes_no_part_is_counted_apart(block_run):
    run, summary = block_run.run, block_run.summary
    adjustment = run.adjustment
    assert adjustment.held_out.any()
    assert summary["scene"]["num_held_out"] == adjustment.held_out.sum()
    for i, view in enumerate(summary["views"]):
        of_view = run.tracks.view == i
        assert view["num_observations"] == (adjustment.inlier & of_view).sum()
        assert view["num_rejected"] == (~(adjustment.inlier | adjustment.held_out) & of_view).sum()
        if view["held_out_px"] is not None:
            assert 0.3 * view["rmse_after"] < view["held_out_px"] < 2.0 * view["rmse_after"]


def test_images_held_by_control_points_alone_are_not_weak(block_run):
    run = block_run.run
    tracks = run.tracks.select(np.zeros(len(run.tracks), dtype=bool))
    none = np.zeros(0, dtype=bool)
    adjustment = replace(run.adjustment, inlier=none, held_out=none, moving=none, view=np.zeros(0, dtype=np.int64))
    summary = summarize(replace(run, tracks=tracks, adjustment=adjustment))
    assert {view["status"] for view in summary["views"] if view["num_gcps"] >= 3} == {"adjusted"}
    assert {view["status"] for view in summary["views"] if view["num_gcps"] < 3} <= {"weak"}
