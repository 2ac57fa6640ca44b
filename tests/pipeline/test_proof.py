"""Whether a run is what it was, finding by finding; the command around it: tests/cli/test_verify.py."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.pipeline import outputs as proof
from barpc.pipeline.beyond import REOPENED
from barpc.pipeline.outputs import CHANGED, GOOD, MISSING, MOVED, SAME, UNKNOWN, Proved, prove
from barpc.rpcio import write_rpc
from tests.rpcio.conftest import make_rpc

POINTS = [[5.4, 43.2, alt] for alt in (60.0, 120.0, 250.0)]


def noted(path: Path, name: str = "path") -> Any:
    return SimpleNamespace(
        **{name: path.name if name == "file" else str(path), "sha256": sha256(path.read_bytes()).hexdigest()}
    )


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """What a summary says; its folder is `out`."""
    summary = SimpleNamespace(inputs=[], outputs=[], views=[])
    (tmp_path / "out").mkdir()
    monkeypatch.setattr(proof, "read_summary", lambda folder: summary)
    return summary


def test_the_words_are_those_of_the_page() -> None:
    assert (SAME, MOVED, CHANGED, MISSING, UNKNOWN) == ("same", "moved", "changed", "missing", "not asked")
    assert GOOD == (SAME, MOVED)
    assert Proved("input", "a", SAME).note == ""


@pytest.mark.parametrize("lacks", ["inputs", "outputs"])
def test_a_run_without_hashes_is_refused(told, tmp_path, lacks) -> None:
    setattr(told, lacks, None)
    with pytest.raises(InputError, match="out: its summary holds no hashes"):
        prove(tmp_path / "out")


def test_an_input_is_looked_for_in_the_run_beside_it_and_where_one_says(told, tmp_path) -> None:
    (path := tmp_path / "in.tif").write_bytes(b"one")
    told.inputs = [noted(path)]
    assert prove(tmp_path / "out") == [Proved("input", str(path), SAME)]
    path.write_bytes(b"two")
    assert prove(tmp_path / "out") == [Proved("input", str(path), CHANGED)]
    for place in (tmp_path / "out", tmp_path / "elsewhere"):
        place.mkdir(exist_ok=True)
        (place / "in.tif").write_bytes(b"one")
        (found,) = prove(tmp_path / "out", [tmp_path / "elsewhere"])
        assert found == Proved("input", str(path), MOVED, f"it is {place / 'in.tif'}")
        (place / "in.tif").unlink()
    path.unlink()
    assert prove(tmp_path / "out") == [Proved("input", str(path), MISSING)]
    told.inputs = [SimpleNamespace(path=str(tmp_path / "old" / "in.tif"), sha256=sha256(b"one").hexdigest())]
    path.write_bytes(b"one")  # beside the run
    (found,) = prove(tmp_path / "out")
    assert (found.now, found.note) == (MOVED, f"it is {path}")


def test_an_input_on_another_host_is_not_asked(told, tmp_path) -> None:
    told.inputs = [SimpleNamespace(path="https://a.org/x.tif", sha256="0")]
    assert prove(tmp_path / "out") == [Proved("input", "https://a.org/x.tif", UNKNOWN, "on another host")]


def test_an_output_is_the_same_changed_or_missing(told, tmp_path) -> None:
    (path := tmp_path / "out" / "a.csv").write_bytes(b"one")
    told.outputs = [noted(path, "file")]
    assert prove(tmp_path / "out") == [Proved("output", "a.csv", SAME)]
    path.write_bytes(b"two")
    assert prove(tmp_path / "out") == [Proved("output", "a.csv", CHANGED)]
    path.unlink()
    assert prove(tmp_path / "out") == [Proved("output", "a.csv", MISSING)]
    path.mkdir()
    assert prove(tmp_path / "out") == [Proved("output", "a.csv", MISSING)]


def test_what_cannot_be_read_counts_as_missing(told, tmp_path, monkeypatch) -> None:
    (path := tmp_path / "out" / "a.csv").write_bytes(b"one")
    told.outputs = [noted(path, "file")]

    def refuse(path: Path) -> None:
        raise PermissionError(path)

    monkeypatch.setattr(proof, "take", refuse)
    assert prove(tmp_path / "out") == [Proved("output", "a.csv", MISSING)]


@pytest.fixture
def camera(told, tmp_path) -> Any:
    """A view with an RPC file and what it was certified to show."""
    rpc = make_rpc()
    write_rpc(rpc, tmp_path / "out" / "a_RPC.TXT")
    points = np.array(POINTS)
    view = SimpleNamespace(
        certified=np.hstack([points, rpc.project(points)]).tolist(), outputs={"a_RPC.TXT": {"barpc": 1e-9}}
    )
    told.views = [view]
    return view


def test_a_camera_that_reads_as_certified_is_the_same(camera, tmp_path) -> None:
    assert prove(tmp_path / "out") == [Proved("camera", "a_RPC.TXT", SAME)]


@pytest.mark.parametrize(("off", "now"), [(0.9, SAME), (1.2, CHANGED)])
def test_a_camera_may_be_off_by_what_is_stated_and_the_rounding_of_its_file(camera, tmp_path, off, now) -> None:
    camera.outputs["a_RPC.TXT"]["barpc"] = 0.3
    camera.certified[1][3] += off * (0.3 + REOPENED)
    (found,) = prove(tmp_path / "out")
    assert found.now == now
    if now == CHANGED:
        assert found.note == "reads 0.36 px off the certified camera, 0.3 stated"


def test_one_point_that_is_off_is_enough_in_both_directions(camera, tmp_path) -> None:
    camera.certified[2][4] -= 5.0
    said = "reads 5 px off the certified camera, 1e-09 stated"
    assert prove(tmp_path / "out") == [Proved("camera", "a_RPC.TXT", CHANGED, said)]


def test_a_camera_that_cannot_be_opened_says_why(camera, tmp_path) -> None:
    (tmp_path / "out" / "a_RPC.TXT").write_text("LINE_OFF: 1\n")
    (found,) = prove(tmp_path / "out")
    assert (found.kind, found.now) == ("camera", CHANGED)
    assert "a_RPC.TXT" in found.note
    (tmp_path / "out" / "a_RPC.TXT").unlink()
    (found,) = prove(tmp_path / "out")
    assert found.now == MISSING


@pytest.mark.parametrize(
    ("name", "stated", "certified"),
    [
        ("a_RPC.TXT", "no RPC", True),  # nobody read it then
        ("a_RPC.TXT", None, True),
        ("a_RPC.TXT", 1e-9, False),
        ("a.csv", 1e-9, True),
    ],
)
def test_what_holds_no_certified_camera_is_not_opened(camera, tmp_path, name, stated, certified) -> None:
    camera.outputs = {name: {} if stated is None else {"barpc": stated, "gdal": 0.0}}
    camera.certified = camera.certified if certified else []
    assert prove(tmp_path / "out") == []


def test_a_grid_holds_the_camera_of_its_image_and_a_resampled_one_does_not() -> None:
    from barpc.pipeline.beyond import RESAMPLED
    from barpc.rpcio.grids import CORRECTION, GRID

    for end, holds in (
        (GRID, True),
        (CORRECTION, True),
        (RESAMPLED, False),
        ("_RPC.TXT", True),
    ):
        assert proof._holds_camera(Path(f"view{end}")) is holds, end
