"""One rule: a run passes when nothing has a reservation; whatever has one is said, with exit code 3."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.report.summary import STATUS_WORDS, measure
from barpc.report.verdict import GOOD, block_verdict
from tests.report.conftest import summarize

ADVICE = {"weak": "only 3 tie points", "doubtful": "tie points are left with 2 px", "failed": "not tied"}
OVERALL = {"weak": "look", "doubtful": "look", "failed": "bad"}


def verdict(run, status, kind="adjust", **changes):
    views = [replace(view, status=GOOD[kind], advice="") for view in measure(run).views]
    views[1] = replace(views[1], status=status, advice=ADVICE.get(status, ""))
    return block_verdict(replace(run, kind=kind, **changes), views)


@pytest.mark.parametrize("kind", GOOD)
@pytest.mark.parametrize("status", STATUS_WORDS)
def test_every_status_of_an_image_decides_the_whole(status, kind, block_run):
    found = verdict(block_run.run, status, kind)
    assert found["status"] == OVERALL.get(status, "good")
    assert bool(found["reasons"]) == (status in OVERALL)
    assert set(found["reasons"]) <= set(found["lines"])
    if status in OVERALL:
        assert ADVICE[status] in found["reasons"][0]
        assert "(of 9)" in found["headline"]


@pytest.mark.parametrize("kind", GOOD)
def test_a_file_that_was_left_out_never_passes(kind, block_run):
    found = verdict(block_run.run, GOOD[kind], kind, left_out=(("bad.tif", "has no RPC"),))
    assert found["status"] == "bad"
    assert found["reasons"] == ["bad.tif was left out: has no RPC"]


def rejected(run):
    keep = np.ones(len(run.gcps.point), dtype=bool)
    keep[run.gcps.point == 2] = False
    return replace(run, adjustment=replace(run.adjustment, gcp_inlier=keep))


def gcps_of_strangers(run):
    return replace(run, gcps=replace(run.gcps, strangers=("unknown.tif",)))


def check_points_of_strangers(run):
    return replace(run, check_points=replace(run.gcps, strangers=("unknown.tif",)))


@pytest.mark.parametrize(
    ("change", "word"),
    [(rejected, "rejected"), (gcps_of_strangers, "unknown.tif"), (check_points_of_strangers, "unknown.tif")],
)
def test_ground_points_with_a_reservation_need_a_look(change, word, block_run):
    summary = summarize(change(block_run.run))
    assert summary["status"] == "look"
    assert not summary["passed"]
    assert summary["headline"] == "All 9 images are adjusted; ground points need a look."
    assert len(summary["reasons"]) == 1
    assert word in summary["reasons"][0]


def test_images_held_by_control_points_alone_are_not_weak(block_run):
    run = block_run.run
    tracks = run.tracks.select(np.zeros(len(run.tracks), dtype=bool))
    adjustment = replace(run.adjustment, inlier=np.zeros(0, dtype=bool), view=np.zeros(0, dtype=np.int64))
    summary = summarize(replace(run, tracks=tracks, adjustment=adjustment))
    assert {view["status"] for view in summary["views"] if view["num_gcps"] >= 3} == {"adjusted"}
    assert {view["status"] for view in summary["views"] if view["num_gcps"] < 3} <= {"weak"}


def test_passed_is_status_good(block_run, check_run):
    for summary in (block_run.summary, check_run.summary):
        assert summary["passed"] == (summary["status"] == "good") == (not summary["reasons"])
