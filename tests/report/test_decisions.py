"""The sentences that say what was decided: there when they are true, another one when they are not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from barpc.report.decisions import decisions
from barpc.report.summary import Summary
from barpc.report.summary.block import ExplanationEntry, HeldOutEntry, JustificationEntry, LeftEntry
from barpc.report.summary.ground_points import ControlTestEntry

from .made import files_of, section

STRIP = ExplanationEntry("step", "Rows lie off", "B", 120.4, 33.0, "low_frequency", "rows", 5.0, 9.0, 1.0)
LEFT = LeftEntry("B", "columns", 10.0, 99.0, 0.42, 0.031, 2.0, 17.0)
WORSE = HeldOutEntry("B", "Rows 0-99 of B: they lie off", None, (0.0, 100.0), 20, 0.0, 0.2, 3e-7)


def said(summary: Summary, **scene: Any) -> str:
    return "\n".join(decisions(replace(summary, scene=replace(summary.scene, **scene)) if scene else summary))


def with_views(summary: Summary, *changes: dict[str, Any]) -> Summary:
    """The first views changed; parts of a correction by names that it has."""
    views = list(summary.views)
    for k, change in enumerate(changes):
        own = {key: value for key, value in change.items() if hasattr(views[k], key)}
        rest = {key: value for key, value in change.items() if key not in own}
        views[k] = replace(views[k], **own, correction=replace(views[k].correction, **rest))
    return replace(summary, views=tuple(views))


@pytest.fixture
def record(block_run) -> Summary:
    return block_run.record


def matched(record: Summary, **fields: Any) -> Summary:
    """All pairs tied by keypoints, the first one otherwise."""
    pairs = [replace(pair, tied_by="guided", decoy_share=0.004, beaten=()) for pair in record.pairs]
    return replace(record, pairs=(replace(pairs[0], **fields), *pairs[1:]))


def test_what_tied_the_pairs_is_said_with_what_found_fewer(record):
    assert "nothing was matched" in said(record)
    count = len(record.pairs)
    plain = said(matched(record))
    assert "Not all pairs were matched" not in plain
    assert "Pairs by selection" not in plain
    assert "nothing was matched" not in plain
    fewer = ("guided 12 of 100", "guided, loosened 20 of 100")
    other = matched(record, tied_by="structure", decoy_share=0.03, beaten=fewer, num_matches=240, chosen_by="same date")
    text = said(other)
    assert f"Not all pairs were matched by guided: {count - 1} by guided, 1 by structure." in text
    first = record.pairs[0]
    assert f"The matcher estimates that at most 3 % of a pair's matches are false ({first.a} - {first.b})." in text
    assert "Pairs by selection criterion: 1 same date." in text


def test_the_matcher_is_said_to_be_asked_for(record):
    options = {**record.options, "tie": {**record.options["tie"], "matcher": "structure"}}
    assert "Not all pairs were matched by structure: " in said(replace(matched(record), options=options))


def test_a_drift_is_learnt_asked_for_or_an_earlier_runs(record):
    given = JustificationEntry(
        image="B", systematic_px=0.31, systematic_p=3e-12, neighbour_correlated_px=0.12, num_images=3
    )
    assert record.options["adjust"]["drift"] is None
    plain = said(record, drift_degree=1, drift_sigma_m=(0.12,))
    assert "degree 1. The prior sigma of the drift is 12 cm on the ground, at the first and last row." in plain
    assert "left" not in plain
    more = said(record, drift_degree=2, drift_sigma_m=(0.12, 0.3), drift_justification=given)
    assert (
        "degree 2. The prior sigma of the drift is 12 cm, 30 cm (by degree) on the ground, at the first and last row."
        in more
    )
    left = "systematic residuals of 0.31 px in B, and 0.12 px correlated between neighbours."
    assert f"Degree 1 left {left}" in more
    surely = said(
        record, drift_degree=2, drift_justification=replace(given, systematic_p=0.0, neighbour_correlated_px=0.0)
    )
    assert "Degree 1 left systematic residuals of 0.31 px in B." in surely
    assert "as in the earlier run" in said(record, drift_degree=1, drift_sigma_m=(None,))
    assert "No attitude drift was estimated" in said(record, drift_degree=0, drift_sigma_m=())
    adjust = {**record.options["adjust"], "drift": 2}
    text = said(replace(record, options={**record.options, "adjust": adjust}), drift_degree=2)
    assert "The degree of the attitude drift, 2, was set by an option." in text


def test_residuals_that_nothing_explains_are_not_beside_a_word_that_nothing_was_selected(record):
    plain = said(with_views(record, *[{"systematic_p": 0.3}] * 9), held_out_places=())
    assert "No further parameters of the images were selected." in plain
    assert "than the rest" in plain
    for cause in ("systematic", "held_out", "wrong_matches", "left"):
        text = said(with_views(record, {"cause": cause, "advice": "look"}), held_out_places=())
        assert "No further parameters of the images were selected." not in text
        assert "None of the additional parameters that were tested explains the inconsistent residuals." in text
        assert "than the rest" not in text
    odd = with_views(record, {"cause": "odd", "advice": "look"})
    assert "No further parameters of the images were selected." in said(odd, held_out_places=())
    untested = said(with_views(record, {"held_out_px": None}), held_out_places=())
    assert "than the rest" not in untested
    nothing = said(with_views(record, *[{"num_observations": 0}] * 9))
    assert "parameters" not in nothing


def test_priors_hold_or_were_widened(record):
    held = with_views(record, *[{"prior_scale": 1.0}] * 9)
    assert "prior sigmas of the cameras" not in said(held, prior_ratio=0.7)
    first, second = (view.name for view in record.views[:2])
    for scales, widened in (
        ((1.5, 3.2), f"2 images were multiplied by up to 3.2 ({second})"),
        ((3.2, 1.0), f"1 image were multiplied by up to 3.2 ({first})"),
        ((3.2, 3.2), "2 images were multiplied by 3.2"),  # as of a pair, which does not show whose is wrong
    ):
        text = said(with_views(held, *({"prior_scale": scale} for scale in scales)), prior_ratio=9.0)
        start = "The corrections are larger than the prior sigmas of the cameras allow. The prior sigmas of "
        assert f"{start}position and attitude of {widened}." in text.splitlines()
    assert "prior sigmas of the cameras" not in said(with_views(held, {"prior_scale": 3.2}), prior_ratio=None)
    assert "common to all" not in text
    shared = said(held, prior_ratio=0.7, prior_shared=1.84)
    assert "The prior sigmas of an error common to all images were multiplied by 1.8." in shared


def test_the_model_is_said(record):
    assert "Each camera is corrected by rotation and translation." in said(record)


def test_what_was_cut_and_kept_out_is_counted(record):
    none = with_views(record, *[{"num_rejected": 0, "num_observations": 100}] * 9)
    assert "900 used, 0 check (independent of the adjustment), 0 rejected (false or imprecise)." in said(
        none, num_held_out=0
    )
    text = said(with_views(none, {"num_moving": 4}, {"num_rejected": 100}), num_held_out=70)
    counts = "900 used, 70 check (independent of the adjustment), 100 rejected (false or imprecise), 4 excluded (they"
    assert f"Observations of tie points: {counts} move together)." in text


def test_splines_are_said_with_the_rows_between_the_knots_of_the_largest_and_what_was_left_without(record):
    before = JustificationEntry(
        image="B", systematic_px=0.5, systematic_p=1e-9, neighbour_correlated_px=0.0, num_images=2
    )
    waving = with_views(
        record,
        {"jitter_px": 0.1, "jitter_rows": 500.0},
        {"jitter_px": 0.3, "jitter_rows": 400.0},
        {"detectors": (1.0,)},
    )
    text, name = said(waving), record.views[1].name
    assert f"Splines with a knot every 400 rows model attitude jitter in 2 images, up to 0.30 px RMS ({name})." in text
    assert "Without splines" not in text
    assert "Steps between detectors are estimated at up to 1 column of 1 image." in text
    left = "Without splines, systematic residuals of 0.50 px in B remained."
    assert left in said(waving, jitter_justification=before)
    assert "Splines" not in said(record)


def test_a_test_of_control_says_what_chance_does(record):
    test = ControlTestEntry(200, 3.29, 1, 0.4, 4.6, "B", "P3")
    assert decisions(replace(record, control_test=test))[-1] == (
        "Of 200 residuals of control points in the images, 1 has Baarda's w above 3.29 in column or row (0.4 expected "
        "by chance). The largest w is 4.6 (P3 in B)."
    )
    assert "residuals of control" not in said(replace(record, control_test=None))


def test_a_check_and_an_older_summary_say_what_they_know(check_run, record):
    assert decisions(check_run.record) == ["Tie points were given: nothing was matched."]
    bare = replace(
        record.scene, drift_justification=None, prior_ratio=None, model="", num_held_out=0, held_out_places=None
    )
    older = with_views(record, *[{"neighbour_correlated_px": None, "systematic_p": None, "num_rejected": 0}] * 9)
    found = decisions(replace(older, scene=bare, options=None, control_test=None, gcps=(), pairs=()))
    assert [line.split()[0] for line in found] == ["The", "Observations"]


def test_an_accuracy_is_widened_from_half_a_percent_on(record):
    calm = with_views(record, *[{"prior_scale": 1.0}] * 9)
    for scale, widened in ((1.005, False), (1.006, True), (None, False)):
        text = said(with_views(calm, {"prior_scale": scale}), prior_ratio=1.0)
        assert ("of 1 image were multiplied by up to 1.0" in text) == widened
        assert ("prior sigmas of the cameras" in text) == widened
    given = JustificationEntry(
        image="B", systematic_px=None, systematic_p=None, neighbour_correlated_px=0.0, num_images=1
    )
    unknown = said(calm, drift_degree=2, drift_justification=given)
    assert "systematic residuals of nan px in B." in unknown


def test_where_nothing_won_it_is_said_why(record):
    assert "No further parameters of the images were selected." in said(record)
    nothing = "None of the additional parameters that were tested explains the inconsistent residuals."
    text = said(record, left=(LEFT,))
    assert nothing in text
    assert "No further parameters of the images were selected." not in text
    many = with_views(record, *[{"unknowns": (0.0,) * 1500}] * 9)
    assert "were tested: the block has more than 12,000 unknowns." in said(many, left=(LEFT,))
    assert nothing not in said(record, left=(LEFT,), explanations=(STRIP,))
    assert "No further parameters" not in said(record, held_out_places=None)  # of an earlier release


def test_what_was_taken_and_what_stands_out_are_tables(record):
    pair = replace(record.pairs[0], tied_by="structure", num_matches=240, beaten=("guided 12 of 100", "x 20 of 100"))
    scene = replace(record.scene, explanations=(STRIP,), left=(LEFT,), held_out_places=(WORSE,))
    told = section(files_of(replace(record, scene=scene, pairs=(pair, *record.pairs[1:]))), "decisions")
    found = {table.key: [[cell.text for cell in row] for row in table.rows] for table in told.tables}
    assert found["explained"] == [["Rows lie off", "120", "33", "low_frequency"]]
    assert found["left"] == [["B", "columns", "10", "99", "42%", "0.03", "2.00", "17"]]
    assert found["worse"] == [["Rows 0-99 of B: they lie off", "20", "3e-07"]]
    assert found["again"] == [[f"{pair.a} - {pair.b}", "structure", "240", "guided 12 of 100; x 20 of 100"]]


def test_what_took_no_part_is_said_to_agree(record):
    agrees = "No part of an image has significantly larger residuals of check tie points than the rest."
    assert agrees in said(record)
    assert agrees not in said(record, num_held_out=0)
    assert agrees not in said(record, held_out_places=(WORSE,))
    assert agrees not in said(record, held_out_places=None)  # of an earlier release
