"""-q with every verb: nothing but errors, and the numbers, tables and JSON that were asked for."""

from __future__ import annotations

import shutil

import pytest

from barpc.cli import COMMANDS
from tests.reliability.conftest import barpc

DONE = {
    "adjust": ("{in}/view_00.tif", "{in}/view_01.tif", "-o", "{new}"),
    "match": ("{in}/view_00.tif", "{in}/view_01.tif", "-o", "{new}"),
    "check": ("{out}/view_00.vrt", "{out}/view_01.vrt"),
    "fit": ("{out}/view_00.vrt", "-o", "{new}_RPC.TXT"),
    "convert": ("{in}/view_00.tif", "{new}_RPC.TXT"),
    "convert --window": ("{in}/view_00.tif", "{new}.tif", "--window", "0", "0", "64", "64"),
    "convert --bbox": ("{in}/view_00.tif", "{new}.tif", "--bbox", "5.0", "43.0", "6.0", "44.0"),
    "convert -o": ("{in}/view_00.tif", "--rpc", "{out}", "-o", "{new}"),
    "export": ("{out}", "{new}", "--to", "stac", "--date", "2026-01-02"),
    "verify": ("{out}",),
    "report": ("{out}",),
    "ortho": ("{out}", "-o", "{new}"),
    "dsm": ("{out}", "-o", "{new}.tif"),
}
"""Verbs that do something."""
ASKED = {
    "info": ("{in}/view_00.tif",),
    "project": ("{in}/view_00.tif", "5.4", "43.3", "230"),
    "localize": ("{in}/view_00.tif", "10", "20", "--alt", "230"),
    "triangulate": ("{out}/view_00.vrt", "{out}/view_01.vrt", "--at", "90", "90", "--at", "90", "90"),
    "report": ("{out}", "{out}"),
}
"""Verbs that answer."""
SLOW = ("adjust", "match", "check", "convert -o", "dsm")


@pytest.fixture
def places(ran, tmp_path):
    """A run of one's own, and a name for what is new."""
    shutil.copytree(ran, tmp_path / "ran")
    return {"in": tmp_path / "ran/in", "out": tmp_path / "ran/out", "new": tmp_path / "new"}


def words(verb: str, given: tuple[str, ...], places: dict[str, object]) -> list[str]:
    return [verb.split()[0], *(word.format(**places) for word in given)]


def test_every_verb_does_or_answers_something():
    # `calibrate` needs three runs of one sensor: tests/pipeline/test_calibrate.py
    assert {verb.split()[0] for verb in (*DONE, *ASKED)} == set(COMMANDS) - {"calibrate"}


@pytest.mark.landing(7)
@pytest.mark.parametrize("verb", [pytest.param(verb, marks=[pytest.mark.slow] * (verb in SLOW)) for verb in DONE])
def test_a_verb_that_does_something_says_nothing_when_quiet(verb, places):
    said = barpc(*words(verb, DONE[verb], places), "-q")
    assert (said.code, said.out, said.err) == (0, "", "")
    again = [*words(verb, DONE[verb], {**places, "new": f"{places['new']}_again"})]
    assert barpc(*again).out != ""


@pytest.mark.parametrize("verb", ASKED)
def test_what_was_asked_for_is_answered_all_the_same(verb, places):
    asked = words(verb, ASKED[verb], places)
    plain, quiet = barpc(*asked), barpc("-q", *asked)
    assert quiet.out == plain.out != ""
    assert (quiet.code, quiet.err) == (plain.code, "" if not plain.code else plain.err)


@pytest.mark.parametrize("verb", ["convert", "verify"])
def test_json_and_errors_come_all_the_same(verb, places):
    asked = words(verb, DONE[verb], places)
    assert barpc("-q", *asked, "--json").out[0] in "[{"
    for path in (*places["out"].glob("*.vrt"), places["new"].with_name("new_RPC.TXT")):
        path.write_text("")
    said = barpc("-q", *asked)
    assert said.out == ""
    assert said.code in (1, 3)
    assert said.err.count("\n") == 1
