"""A summary.json of release 0.3 is read under the names of this one: every value at its new place, none lost."""

from __future__ import annotations

import json
import re
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from barpc.base.errors import BarpcWarning, InputError
from barpc.report.compare import compare_runs
from barpc.report.page import can_render, report_html
from barpc.report.records import json_form
from barpc.report.renamed import OLD_SCHEMA, RENAMED_KEYS, RENAMED_VALUES
from barpc.report.runfiles import read_summary
from barpc.report.summary import SCHEMA, published_schema

OLD = json.loads((Path(__file__).parent / "summary_0_3.json").read_text(encoding="utf-8"))
"""As release 0.3 wrote it, with an explanation of each kind."""


def put(folder: Path, found: Any) -> Path:
    (folder / "summary.json").write_text(json.dumps(found), encoding="utf-8")
    return folder


def at(found: Any, place: str) -> list[Any]:
    """The records at a place, those of lists each."""
    some = [found]
    for step in place.split("."):
        some = [one[step] for one in some if one.get(step) is not None]
        some = [item for one in some for item in (one if isinstance(one, list) else [one])]
    return some


def in_old_names(found: dict[str, Any]) -> dict[str, Any]:
    """A summary of today as release 0.3 would have written it."""
    old = json.loads(json.dumps(found))
    for place, names in reversed(RENAMED_KEYS.items()):
        for record in at(old, place):
            record.update({was: record.pop(now) for was, now in names.items() if now in record})
    return {**old, "schema": OLD_SCHEMA}


def test_the_old_file_has_every_old_name() -> None:
    """Else the tests below could not notice one that is not read."""
    assert OLD["schema"] == OLD_SCHEMA
    before = {"drift_justification": "drift_asked", "jitter_justification": "jitter_asked"}
    for place, names in RENAMED_KEYS.items():
        was = ".".join(before.get(step, step) for step in place.split("."))
        assert {old for record in at(OLD, was) for old in names if record.get(old) is not None} == set(names), place
    for (place, key), values in RENAMED_VALUES.items():
        found = {str(record.get(key)).partition(":")[0] for record in at(OLD, place)}
        assert found >= set(values) if key != "runner_up" else found & set(values), (place, key)


def test_every_new_name_is_one_of_the_schema_and_no_old_one_is() -> None:
    for place, names in RENAMED_KEYS.items():
        records, part = published_schema()["$defs"], "Summary"
        for step in place.split("."):
            part = re.findall(r"/(\w+)'", str(records[part]["properties"][step]))[0]
        declared = set(records[part]["properties"])
        assert set(names.values()) <= declared, place
        assert not set(names) & declared, place


def test_values_of_an_old_summary_are_found_under_the_new_names(tmp_path: Path) -> None:
    with pytest.warns(BarpcWarning, match=r"summary\.json: has the names of release 0\.3.*run the adjustment") as said:
        summary = read_summary(put(tmp_path, OLD))
    assert len(said) == 1
    found, scene = json.loads(json.dumps(json_form(summary))), OLD["scene"]
    assert found["schema"] == SCHEMA
    assert [one["name"] for one in found["scene"]["explanations"]] == [
        "foreign_camera", "step", "decay", "transient", "low_frequency", "sinusoid", "moving_objects",
    ]  # fmt: skip
    assert found["scene"]["explanations"][0]["runner_up"] == f"foreign_camera: {OLD['views'][0]['name']}"
    assert found["scene"]["explanations"][3]["runner_up"] == "moving_objects"
    assert [view["cause"] for view in found["views"]] == ["moving_objects", "systematic", "foreign_camera"]
    assert found["scene"]["rigid_model_px"] == scene["in_space_px"] == 0.5
    assert found["scene"]["drift_justification"]["systematic_px"] == scene["drift_asked"]["smooth_px"]
    assert found["scene"]["left"][0]["rejected_median_px"] == scene["left"][0]["apart_px"]
    # and nothing else has changed: the way back leads to the same file, but for words that are values
    back = in_old_names(found)
    assert [view.pop("num_check") for view in back["views"]] == [0, 0, 0]  # counted by later releases
    for place, key in RENAMED_VALUES:
        for record, was in zip(at(back, place), at(OLD, place), strict=True):
            record[key] = was[key]
    assert {key: value for key, value in back.items() if value} == {key: value for key, value in OLD.items() if value}


def test_a_summary_of_today_is_read_without_a_warning(tmp_path: Path) -> None:
    with pytest.warns(BarpcWarning):
        today = json_form(read_summary(put(tmp_path, OLD)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_summary(put(tmp_path, today))


def changed(place: str, **names: Any) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(OLD))
    for record in at(found, place):
        record.update(names)
    return found


def damaged() -> Iterator[Any]:
    yield {**OLD, "schema": SCHEMA}, "enum value"  # old names are none of the new schema
    yield changed("views", systematic_px=1.0), "smooth_px"  # both names: which of them holds?
    for value in (3, "text", [[1]], None):
        yield {**OLD, "views": value}, "views"
        yield {**OLD, "scene": {**OLD["scene"], "explanations": value}}, "explanations"
    yield changed("scene.explanations", name=["strip"]), "name"
    yield changed("scene.explanations", name="no such"), "name"
    yield {**OLD, "schema": True}, "schema True"
    yield {**OLD, "schema": 1}, "schema 1, this release reads 3"


@pytest.mark.filterwarnings("ignore:.*has the names of release")
@pytest.mark.parametrize(("found", "message"), list(damaged()))
def test_a_damaged_old_summary_is_one_line(tmp_path: Path, found: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read_summary(put(tmp_path, found))
    assert "summary.json" in str(error.value)


@pytest.mark.filterwarnings("ignore:.*has the names of release")
def test_an_old_run_is_compared_and_shown_as_a_new_one(block_run: Any, tmp_path: Path) -> None:
    old = shutil.copytree(folder := block_run.folder, tmp_path / "old")
    put(old, in_old_names(json.loads((folder / "summary.json").read_text(encoding="utf-8"))))
    (old / "SHA256SUMS").unlink()  # it wrote none
    lines = compare_runs(old, folder)["lines"]
    assert lines[1].startswith("Their RPCs differ by up to 0 px")
    assert not any(line.startswith("Option") for line in lines)
    if can_render():
        pages = [report_html(read_summary(place), place) for place in (old, folder)]
        assert pages[0] == pages[1]
