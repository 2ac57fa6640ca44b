"""summary.json follows its published schema, and its figures are what they say."""

from __future__ import annotations

import json
from typing import ClassVar

import msgspec
import numpy as np
import pytest
from jsonschema import Draft202012Validator

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.report import Run
from barpc.report.outcome import pair_ties
from barpc.report.records import Number, column, json_form, table
from barpc.report.runfiles import read_summary
from barpc.report.summary import published_schema
from barpc.report.summary.views import ViewEntry
from barpc.sensor.geometry import view_angles
from barpc.sensor.triangulation import epipolar_offset
from tests.report.conftest import summarize

SCHEMA = published_schema()


def faults(value, schema):
    """Where a value breaks a schema."""
    return [error.message for error in Draft202012Validator(schema).iter_errors(value)]


@pytest.mark.parametrize("fixture", ["block_run", "check_run", "antimeridian_run"])
def test_summaries_follow_the_published_schema(fixture, request):
    folder = request.getfixturevalue(fixture).folder
    summary = json.loads((folder / "summary.json").read_text())
    assert faults(summary, SCHEMA) == []


def test_the_schema_refuses_what_is_missing_or_of_another_kind(block_run):
    for change in ({"kind": "adjusted"}, {"views": None}, {"views": []}, {"schema": 2}, {"passed": 1}):
        assert faults({**block_run.summary, **change}, SCHEMA)
    assert faults({key: value for key, value in block_run.summary.items() if key != "pairs"}, SCHEMA)


def test_the_schema_is_valid_json_schema_and_every_field_says_what_it_is():
    Draft202012Validator.check_schema(SCHEMA)
    assert len(SCHEMA["$defs"]) > 20
    parts = {f"{name}.{key}": part for name, one in SCHEMA["$defs"].items() for key, part in one["properties"].items()}
    assert [name for name, part in parts.items() if "description" not in part] == []


class Sharper(ViewEntry):
    """A view with one value more: all that a new column takes."""

    PAGE: ClassVar = f"{ViewEntry.PAGE} sharpness_px"
    TERMINAL: ClassVar = f"{ViewEntry.TERMINAL} sharpness_px"

    sharpness_px: Number = column("How sharp it is", "px", "sharpness", ".2f", default=None)


SHARPER = msgspec.json.schema(Sharper)


def test_a_new_value_is_declared_once_and_stands_in_schema_file_and_tables(block_run):
    view = Sharper(**vars(block_run.record.views[0]), sharpness_px=0.125)
    assert json_form(view) == {**block_run.summary["views"][0], "sharpness_px": 0.125}
    assert faults(json_form(view), SHARPER) == []
    told = SHARPER["$defs"]["Sharper"]["properties"]["sharpness_px"]
    assert told.items() >= {"description": "How sharp it is [px].", "default": None}.items()
    for columns in (Sharper.PAGE, Sharper.TERMINAL):
        heads, row = table("views", "", [view], Sharper, columns).texts
        assert (heads[-1], row[-1]) == ("sharpness [px]", "0.12")


def test_an_older_summary_without_a_newer_value_is_read(block_run):
    older = block_run.summary["views"][0]
    assert faults(older, SHARPER) == []
    assert Sharper.read(older).sharpness_px is None
    assert json_form(Sharper.read(older)) == older


def test_a_summary_read_from_its_file_is_the_one_that_was_written(block_run):
    read = read_summary(block_run.folder)
    assert read == block_run.record
    assert json_form(read) == json.loads((block_run.folder / "summary.json").read_text()) == block_run.summary


def test_the_shift_of_a_camera_is_how_far_its_image_points_move(block_run):
    run = block_run.run
    for i, view in enumerate(block_run.summary["views"]):
        middle = run.before[i].localize((np.array(view["size"]) - 1) / 2, np.array(run.altitude))
        moved = run.adjustment.sensors[i].project(middle) - run.before[i].project(middle)
        assert np.abs(moved - view["correction"]["center_shift_px"]).max() < 1e-6
        assert np.abs(moved).max() > 0.05


def test_base_to_height_is_the_distance_of_two_cameras_one_unit_up(block_run):
    run = block_run.run
    names = [view.name for view in run.views]
    for pair in block_run.summary["pairs"][:5]:
        place = run.ground[np.isfinite(run.ground).all(axis=1)].mean(axis=0)
        ends = []
        for name in (pair["a"], pair["b"]):
            incidence, azimuth = np.radians(view_angles(run.before[names.index(name)], place))
            ends.append(np.tan(incidence) * np.array([np.sin(azimuth), np.cos(azimuth)]))
        assert pair["base_to_height"] == pytest.approx(np.hypot(*(ends[0] - ends[1])), rel=0.1)
        assert pair["height_m_per_px"] == pytest.approx(0.5 / pair["base_to_height"], rel=0.1)


def test_two_steps_from_the_tie_points_altitudes_find_the_epipolar_offset(block_run):
    """Of all verified matches; and of those in use, of which there are fewer."""
    run = block_run.run
    for ties, kept in zip(pair_ties(run.tracks)[:4], pair_ties(run.tracks, run.keep)[:4], strict=True):
        assert ties.views == kept.views
        assert len(kept.a) < len(ties.a)
        for sensors, when, of in (
            (run.before, "before", ties), (run.after, "after", ties), (run.after, "kept", kept)
        ):  # fmt: skip
            i, j = of.views
            a, b = run.tracks.xy[of.a], run.tracks.xy[of.b]
            offset, _ = epipolar_offset(sensors[i], sensors[j], a, b, 0.0, steps=20)
            found = next(
                p for p in block_run.summary["pairs"] if (p["a"], p["b"]) == tuple(run.views[k].name for k in (i, j))
            )
            assert found[f"epipolar_{when}"]["count"] == len(a)
            assert found[f"epipolar_{when}"]["rms"] == pytest.approx(np.sqrt(np.mean(offset**2)), rel=1e-4)
            assert found[f"epipolar_{when}"]["median"] == pytest.approx(np.median(offset), abs=1e-6)


def test_the_simulated_camera_sees_half_a_metre(block_run):
    for view in block_run.summary["views"]:
        assert view["gsd_m"] == pytest.approx(0.5, rel=0.05)
        assert 0 < view["incidence_deg"] < 30


def test_an_adjustment_in_the_image_has_no_shift_or_ellipse_of_a_camera_in_space(block_run):
    run = block_run.run
    adjustment = adjust_tracks(run.views, run.tracks, AdjustOptions(model="shift"))
    summary = summarize(Run("adjust", run.views, (), run.tracks, adjustment=adjustment))
    assert faults(json.loads(json.dumps(summary)), SCHEMA) == []
    correction = summary["views"][0]["correction"]
    assert correction["center_shift_px"] is None
    assert "ellipse" not in correction
