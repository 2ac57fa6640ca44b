"""A damaged summary.json is one line: every field missing or of another kind; it names no file elsewhere."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Iterator
from copy import deepcopy
from itertools import islice, product
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from barpc.base.errors import BarpcWarning, InputError
from barpc.cli import cli
from barpc.pipeline.remake import remake_report
from barpc.report import Run
from barpc.report.compare import compare_runs
from barpc.report.page import report_html
from barpc.report.runfiles import read_summary
from barpc.rpcio import write_rpc
from tests.rpcio.conftest import make_rpc
from tests.sealing import seal

from .conftest import Finished, run_of_block, written

DEEP = {"a": {"a": {"a": {}}}}
VALUES: tuple[Any, ...] = (None, True, 0, 1.0, -1, 1e99, 10**400, float("nan"), "", "x", [], [None], {}, DEEP)


def places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every field, of the first item of a list."""
    if at:
        yield at
    items = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    for key, item in items:
        yield from places(item, (*at, key))


def kinds(summary: dict[str, Any]) -> list[str]:
    """The paths of all fields of records, without keys that are names of files or numbers."""
    return [".".join(map(str, at)) for at in places(summary) if not {"outputs", "by_length"} & set(at)]


def changed(summary: dict[str, Any], at: tuple[Any, ...], *value: Any) -> dict[str, Any]:
    """A copy with the field at a place replaced, or taken out."""
    out = deepcopy(summary)
    holder: Any = out
    for key in at[:-1]:
        holder = holder[key]
    if value:
        holder[at[-1]] = value[0]
    else:
        del holder[at[-1]]
    return out


def look(folder: Path, summary: dict[str, Any]) -> bool:
    """Whether report and compare take a summary; what they refuse they refuse in one line."""
    (folder / "summary.json").write_text(json.dumps(summary))
    try:
        read = read_summary(folder)
    except InputError as error:
        message = str(error)
    else:
        message = ""
    if message:
        assert message.isprintable()
        assert str(folder) in message
        return False
    with contextlib.suppress(InputError):  # tables that do not go with it
        report_html(read, folder)
    with contextlib.suppress(InputError):  # no image in common
        compare_runs(seal(folder), folder)
    return True


@pytest.fixture(scope="session")
def small_runs(tmp_path_factory) -> dict[str, Finished]:
    """Every kind of field on three views: adjusted with control points and outliers; and only looked at."""
    adjusted = run_of_block(3, 400, gcps=True, outliers=0.05)
    runs = {"adjust": adjusted, "check": Run("check", adjusted.views, (), adjusted.tracks)}
    folder = tmp_path_factory.mktemp("small")
    return {name: Finished(run, written(run, folder / name), folder / name) for name, run in runs.items()}


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "step"),
    [
        pytest.param("check", 11, marks=pytest.mark.costs(3)),
        pytest.param("check", 1, marks=pytest.mark.slow),
        pytest.param("adjust", 7, marks=pytest.mark.nightly),
        pytest.param("adjust", 1, marks=pytest.mark.nightly),
    ],
)
def test_every_field_may_be_anything(verb, step, small_runs, block_run, copied):
    """All cases at night; before that every few-th, which is each field some times and each value in turn."""
    run = small_runs[verb]
    if verb == "adjust":  # no kind of field that a larger block has is missed
        assert set(kinds(run.summary)) == set(kinds(block_run.summary))
    folder = copied(run)
    assert look(folder, run.summary)
    cases = product(places(run.summary), ((), *((value,) for value in VALUES)))
    taken = 0
    for at, value in islice(cases, 0, None, step):
        taken += look(folder, changed(run.summary, at, *value))
    assert taken


@pytest.mark.parametrize("key", ["views", "pairs", "scene", "tracks", "tables", "versions"])
def test_what_is_missing_is_named(block_run, tmp_path, key):
    (tmp_path / "summary.json").write_text(json.dumps(changed(block_run.summary, (key,))))
    for verb in (["report", tmp_path], ["report", tmp_path, tmp_path]):
        result = CliRunner().invoke(cli, [str(word) for word in verb])
        assert isinstance(result.exception, InputError)
        assert f"{tmp_path}/summary.json: damaged" in str(result.exception)
        assert key in str(result.exception)


@pytest.mark.parametrize("name", ["../outside.json", "/outside.json", "inside/../../outside.json", "..", "link.json"])
def test_compare_opens_nothing_outside_the_folder(block_run, copied, tmp_path, name):
    outputs = {name.replace("/outside", f"{tmp_path}/outside", name[0] == "/"): {}}
    folder = copied(block_run, change=lambda summary: summary["views"][0].update(outputs=outputs))
    write_rpc(make_rpc(), tmp_path / "outside.json")
    (folder / "link.json").symlink_to(tmp_path / "outside.json")
    seal(folder)
    with contextlib.suppress(InputError):
        differences = [view["rpc_difference_px"] for view in compare_runs(folder, folder)["views"]]
        assert differences == [None, *[0.0] * 8]


def test_a_name_that_is_no_text_does_not_keep_the_report_away(block_run, copied):
    folder = seal(copied(block_run, change=lambda summary: summary.update(headline="of \udce9t\udce9")))
    assert "of \\udce9t\\udce9" in remake_report(folder).read_text()


@pytest.mark.parametrize(("half", "said"), [("\ud800", "is half of a character"), ("\udce9", "is no text")])
def test_a_key_that_is_no_text_is_named_in_one_line(half, said, block_run, tmp_path):
    (tmp_path / "summary.json").write_text(json.dumps({**block_run.summary, f"a{half}": 1}))
    with pytest.raises(InputError, match=rf"summary\.json: .*{said}") as told:
        read_summary(tmp_path)
    assert "codec" not in str(told.value)


@pytest.mark.parametrize("at", [(), ("views", 2), ("views", 0, "correction", "ellipse"), ("scene",), ("tracks",)])
def test_a_key_that_no_record_has_is_named_and_passed_over(at: tuple[Any, ...], block_run: Finished, tmp_path: Path):
    summary = deepcopy(block_run.summary)
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        known = read_summary(tmp_path)
    holder: Any = summary
    for key in at:
        holder = holder[key]
    holder |= {"of_later": {"a": 1}, "none": None}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    place = ".".join(key for key in at if isinstance(key, str))
    with pytest.warns(BarpcWarning, match=rf"summary\.json: has {place}{'.' * bool(place)}of_later, which") as told:
        assert read_summary(tmp_path) == known
    assert len(told) == 1
