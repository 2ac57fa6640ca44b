"""The exit codes of the command from end to end, and what reaches the terminal."""

from __future__ import annotations

import ast
import json
import logging
import re
import shutil
from pathlib import Path

import pytest

import barpc.cli
from tests.pipeline.known import part
from tests.reliability.conftest import assert_one_line, hashes
from tests.reliability.conftest import barpc as command

CLI = Path(barpc.cli.__file__).parent
CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]")
ESC = "\x1b[31mred\x1b]0;title\x07"


def assert_told(said, *words):
    """Exit code 3, and the last line says why."""
    assert said.code == 3, said
    last = said.err.strip().splitlines()[-1]
    assert last.startswith("barpc: needs review (exit code 3): "), said
    for word in words:
        assert word in last, said


@pytest.fixture(scope="module")
def ties(pristine, tmp_path_factory):
    """Tie points of three crops."""
    folder = tmp_path_factory.mktemp("ties") / "out"
    said = command("match", *pristine, "-o", folder)
    assert said.code == 0, said
    return folder / "matches.csv"


@pytest.mark.slow
def test_a_weak_view_ends_with_3(pristine, ties, tmp_path):
    head, *rows = ties.read_text().splitlines()
    few = [row for row in rows if not row.startswith("view_02")]
    few += [row for row in rows if row.startswith("view_02")][:20]
    (tmp_path / "few.csv").write_text("\n".join([head, *few]))
    said = command("adjust", *pristine, "--matches", tmp_path / "few.csv", "--matches-only", "-o", tmp_path / "out")
    assert_told(said, "1 of 3 images needs review", "view_02: weakly connected")


def test_doubtful_cameras_end_with_3_and_say_so_even_when_quiet(pristine):
    said = command("-q", "check", *pristine[:2])
    assert_told(said, "view_00: needs review", "Adjust the cameras")
    assert said.out == ""
    assert "need review" not in said.err  # the verdict: with -q there is none, only what is wrong


@pytest.mark.slow
def test_a_file_left_out_ends_with_3(pristine, tmp_path):
    (tmp_path / "bad.tif").write_bytes(b"nothing")
    said = command("match", *pristine[:2], tmp_path / "bad.tif", "--keep-going", "-o", tmp_path / "out", "--json")
    assert_told(said, "bad.tif was left out")
    assert json.loads(said.out)["status"] == "bad"


@pytest.mark.slow
def test_a_fit_that_misses_its_tolerance_ends_with_3(pristine, ties, tmp_path):
    (tmp_path / "o.toml").write_text("[fit]\ntolerance = 1e-15\n")
    given = ("adjust", *pristine, "--matches", ties, "--matches-only", "--options", tmp_path / "o.toml", "-o")
    assert command(*given, tmp_path / "none").code == 1
    assert_told(command(*given, tmp_path / "out", "--keep-going"), "not adjusted", "One RPC does not fit")


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("fault", ["stranger", pytest.param("rejected", marks=pytest.mark.slow)])
def test_control_points_that_do_not_count_end_with_3(fault, tmp_path):
    (tmp_path / "in").mkdir()
    found = part(tmp_path / "in")
    control = json.loads(found.gcps.read_text())
    given = ("adjust", *found.images, "--gcp", tmp_path / "gcps.geojson", "-o")
    one = control["features"][0]
    if fault == "rejected":
        for feature in control["features"]:
            if feature["properties"]["id"] == one["properties"]["id"]:
                feature["geometry"]["coordinates"][0] += 0.001
    else:
        control["features"].append({**one, "properties": {**one["properties"], "filename": f"{ESC}.tif"}})
    (tmp_path / "gcps.geojson").write_text(json.dumps(control))
    if fault == "stranger":
        said = command(*given, tmp_path / "out")
        assert_one_line(said, 1, "not in this run")
        assert not CONTROL.search(said.err)
    said = command(*given, tmp_path / "out", "--keep-going")
    assert_told(said, "ground points need review", "rejected" if fault == "rejected" else "not in this run")
    assert not CONTROL.search(said.out + said.err)


# --- the terminal -----------------------------------------------------------------------------------------


def test_nothing_but_the_door_prints():
    for path in CLI.glob("*.py"):
        if path.name == "terminal.py":
            continue
        calls = {ast.unparse(node.func) for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)}
        assert not calls & {"print", "click.echo", "click.secho", "sys.stdout.write", "sys.stderr.write"}, path


@pytest.mark.parametrize("debug", [[], ["--debug"]])
def test_no_control_character_of_a_file_reaches_the_terminal(debug, crops, tmp_path):
    before = hashes(crops)
    folder = tmp_path / "side"
    folder.mkdir()
    (folder / "p.gcp").write_text(f"{ESC} 43.3 5.4 100 1 1 1 {ESC}.tif 1 x 1 1\n")
    (folder / "o.toml").write_text(f'"\\u001b[31m" = 1\n[{chr(34)}a\\u0007{chr(34)}]\n')
    (folder / "m.csv").write_text(f"image,{ESC},row\n")
    (folder / "l.txt").write_text(f"{ESC} view_00\n")
    (folder / "rpc.txt").write_text(f"LINE_OFF: {ESC}\n")
    (folder / "i.txt").write_text(f"{ESC}.tif\n{ESC}2.tif\n")
    out = ("-o", tmp_path / "out")
    for args in (
        ("adjust", *crops, "--gcp", folder / "p.gcp", *out),
        ("adjust", *crops, "--options", folder / "o.toml", *out),
        ("adjust", *crops, "--matches", folder / "m.csv", *out),
        ("adjust", *crops, "--overlap-list", folder / "l.txt", *out),
        ("adjust", "--image-list", folder / "i.txt", *out),
        ("info", folder / "rpc.txt"),
        ("info", f"{ESC}.tif"),
        ("adjust", *crops, f"--{ESC}"),
        (ESC,),
        ("match", *crops, "-j", ESC, *out),
    ):
        said = command(*debug, *args)
        assert said.code in (1, 2), said
        assert not CONTROL.search(said.out + said.err), said
        if not debug:
            assert_one_line(said, said.code)
    assert hashes(crops) == before


def test_the_log_and_warnings_are_single_printable_lines(crops, tmp_path):
    bad = Path(shutil.copy(crops[0], tmp_path / "bad.tif"))
    bad.write_bytes(b"nothing")
    said = command("-vv", "match", *crops, bad, "--keep-going", "-o", tmp_path / "out")
    assert "left out" in said.err
    assert not CONTROL.search(said.err)
    from barpc.cli.terminal import Formatter

    record = logging.LogRecord("a", 30, "", 0, "one\ntwo %s", (ESC,), None)
    text = Formatter("%(message)s").format(record)
    assert "\n" not in text
    assert not CONTROL.search(text)
