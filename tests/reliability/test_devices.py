"""Pipes and endless devices in place of every side file of every verb: one line at once."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.rasters.test_dem import write_dem

from .conftest import barpc

RUN = (
    "--gcp",
    "--check-points",
    "--dem",
    "--geoid",
    "--matches",
    "--overlap-list",
    "--aoi",
    "--options",
    "--image-list",
)
CASES: list[tuple[str, str]] = [
    *(("adjust", flag) for flag in (*RUN, "--image-list", "--add-to")),
    *(("match", flag) for flag in ("--overlap-list", "--aoi", "--options", "--image-list")),
    *(("check", flag) for flag in ("--matches", "--image-list", "--options")),
    *((verb, flag) for verb in ("localize", "project") for flag in ("--points", "--dem", "--geoid")),
    ("triangulate", "--points"),
    *(("fit", flag) for flag in ("--dem", "--geoid", "")),
    *((verb, "") for verb in ("info", "convert", "report", "report report", "adjust")),
]
"""Verb and option; without an option it is the verb's own argument."""


@pytest.fixture(autouse=True)
def no_waiting() -> Iterator[None]:
    """What waits for a pipe's writer, or for the end of a device, is interrupted."""

    def stop(*_: object) -> None:
        raise TimeoutError("it waits")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def command(verb: str, flag: str, given: Path, crops: list[Path], tmp_path: Path) -> list[object]:
    if flag == "--add-to" or verb.startswith("report"):
        name = "block.npz" if flag else "summary.json"
        (tmp_path / "run").mkdir()
        if flag:
            (tmp_path / "run" / "summary.json").write_text("{}")
            (tmp_path / "run" / "images.json").write_text('{"images": []}')
        (tmp_path / "run" / name).symlink_to(given)
        if not flag:
            return [tmp_path / "run"] * len(verb.split())
        return [*crops, flag, tmp_path / "run", "-o", tmp_path / "out"]
    more: list[object] = [flag, given] if flag else []
    if flag == "--geoid":
        more += ["--dem", write_dem(tmp_path / "dem.tif", 4326)]
    if verb in ("adjust", "match"):
        images: list[object] = [*crops] if flag else [given, *crops]
        return [*images, *more, "-o", tmp_path / "out"]
    if verb == "check":
        return [*crops, *more]
    source: list[object] = [crops[0] if flag else given]
    rest: dict[str, list[object]] = {
        "localize": [] if flag == "--points" else [10, 10],
        "project": [] if flag == "--points" else [5.4, 43.2],
        "triangulate": [crops[1]],
        "fit": ["-o", tmp_path / "x_RPC.TXT"],
        "convert": [tmp_path / "x.RPB"],
    }
    return [*source, *rest.get(verb, []), *more]


@pytest.mark.few(22)
@pytest.mark.parametrize("what", ["pipe", "/dev/zero"])
@pytest.mark.parametrize(("verb", "flag"), CASES)
def test_what_has_no_end_is_refused_in_one_line(verb, flag, what, crops, tmp_path):
    given = tmp_path / "pipe"
    if what == "pipe":
        os.mkfifo(given)
    else:
        given = Path(what)
    said = barpc(verb.split()[0], *command(verb, flag, given, crops, tmp_path))
    assert said.code == 1, said
    *_, line = said.err.strip().splitlines()
    assert line.startswith("barpc: "), said
    assert given.name in line or "run/" in line, said
    assert "unexpected" not in line, said
    assert "it waits" not in line, said
