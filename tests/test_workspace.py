"""The run folder: what is kept, what is refused, what a killed run leaves behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass

import numpy as np
import pytest

from barpc.errors import OutputError, TiePointError
from barpc.workspace import Workspace, code_version, fingerprint, key_of, peak_memory


@dataclass(frozen=True)
class Options:
    cells: int = 64
    ratio: float = 0.8


def test_a_stage_is_made_once_and_read_back_to_the_bit(tmp_path):
    made = []

    def make():
        made.append(1)
        return {"x": np.arange(6.0).reshape(2, 3) / 7, "name": np.array("é")}

    with Workspace(tmp_path / "run") as run:
        first = run.cached("detect", key_of("a"), make)
    with Workspace(tmp_path / "run", overwrite=True) as run:
        second = run.cached("detect", key_of("a"), make)
        run.cached("detect", key_of("b"), make)
    assert len(made) == 2
    np.testing.assert_array_equal(first["x"], second["x"])
    assert str(second["name"]) == "é"


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 not a zip", None])
def test_a_damaged_result_is_made_again(tmp_path, damage, caplog):
    with Workspace(tmp_path / "run") as run:
        run.store("detect", "k", {"x": np.zeros(1000)})
        path = run.folder / ".barpc/cache/detect/k.npz"
        path.write_bytes(path.read_bytes()[:500] if damage is None else damage)
        assert run.load("detect", "k") is None
        assert "damaged" in caplog.text
        np.testing.assert_array_equal(run.cached("detect", "k", lambda: {"x": np.ones(3)})["x"], np.ones(3))


def test_a_result_with_python_objects_is_refused(tmp_path):
    with Workspace(tmp_path / "run") as run, pytest.raises(ValueError, match="allow_pickle"):
        run.store("detect", "k", {"x": np.array([{"a": 1}], dtype=object)})


def test_the_key_depends_on_everything_that_goes_in():
    keys = [
        key_of("detect", Options()),
        key_of("detect", Options(cells=65)),
        key_of("detect", Options(), "file"),
        key_of("match", Options()),
        key_of("match", np.arange(3.0)),
        key_of("match", np.arange(3)),
    ]
    assert len(set(keys)) == len(keys)
    assert key_of("match", np.arange(3.0)) == keys[4]
    assert len(code_version()) == 16
    with pytest.raises(TypeError, match="key"):
        key_of(object())


def test_the_fingerprint_is_of_the_content(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    a.write_bytes(b"one")
    b.write_bytes(b"one")
    assert fingerprint(a) == fingerprint(b)
    b.write_bytes(b"two")
    assert fingerprint(a) != fingerprint(b)


def test_a_folder_with_other_things_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"):
        Workspace(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]
    with pytest.raises(OutputError, match="is a file"):
        Workspace(tmp_path / "thesis.txt")


def test_a_finished_run_is_not_written_over_and_an_unfinished_one_is_gone_on_with(tmp_path):
    with Workspace(tmp_path / "run") as run:
        run.write_text("summary.json", "{}")
    with pytest.raises(OutputError, match="--overwrite"):
        Workspace(tmp_path / "run")
    with pytest.raises(RuntimeError), Workspace(tmp_path / "run", overwrite=True) as run:
        raise RuntimeError
    with Workspace(tmp_path / "run") as run:
        assert json.loads((run.folder / ".barpc/state.json").read_text())["status"] == "running"


def test_two_runs_in_one_folder_are_refused(tmp_path):
    with Workspace(tmp_path / "run"), pytest.raises(OutputError, match="another run"):
        Workspace(tmp_path / "run", overwrite=True)


def test_an_input_is_never_written(tmp_path):
    image = tmp_path / "run" / "a.tif"
    image.parent.mkdir()
    image.write_bytes(b"pixels")
    with Workspace(image.parent, overwrite=True, keep=frozenset([image])) as run:
        with pytest.raises(OutputError, match="input"):
            run.write_text("a.tif", "x")
    assert image.read_bytes() == b"pixels"


def test_an_output_appears_whole_or_not_at_all(tmp_path):
    with Workspace(tmp_path / "run") as run:
        with pytest.raises(RuntimeError), run.output("a.vrt") as partial:
            partial.write_text("half")
            raise RuntimeError
        assert [p.name for p in run.folder.iterdir()] == [".barpc"]
        run.write_text("b/a.vrt", "whole")
        assert (run.folder / "b/a.vrt").read_text() == "whole"
        assert run.outputs == ["b/a.vrt"]


def test_what_an_earlier_run_wrote_and_this_one_did_not_goes_away(tmp_path):
    with Workspace(tmp_path / "run") as run:
        run.write_text("old.vrt", "old")
        run.write_text("both.vrt", "old")
    (tmp_path / "run/note.txt").write_text("mine")
    with Workspace(tmp_path / "run", overwrite=True) as run:
        run.write_text("both.vrt", "new")
        run.remove_stale()
    names = sorted(p.name for p in (tmp_path / "run").iterdir())
    assert names == [".barpc", "both.vrt", "note.txt"]
    assert (tmp_path / "run/both.vrt").read_text() == "new"


def test_leftovers_of_a_killed_run_are_cleaned_and_its_stages_stay(tmp_path):
    code = (
        "import os, signal, numpy as np\n"
        "from barpc.workspace import Workspace\n"
        f"run = Workspace({str(tmp_path / 'run')!r})\n"
        "run.store('detect', 'k', {'x': np.ones(3)})\n"
        "run.output('a.vrt').__enter__().write_text('half')\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    process = subprocess.run([sys.executable, "-c", code], check=False)
    assert process.returncode == -9
    assert any("partial" in p.name for p in (tmp_path / "run").iterdir())
    with Workspace(tmp_path / "run") as run:
        assert [p.name for p in run.folder.iterdir()] == [".barpc"]
        assert run.load("detect", "k") is not None


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_place_is_named(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="cannot be written"):
        Workspace(tmp_path / "run")


def test_a_run_killed_before_its_first_state_is_gone_on_with(tmp_path):
    (tmp_path / "run/.barpc/cache").mkdir(parents=True)
    (tmp_path / "run/.barpc/lock").touch()
    with Workspace(tmp_path / "run") as run:
        run.write_text("summary.json", "{}")
    with pytest.raises(OutputError, match="--overwrite"):
        Workspace(tmp_path / "run")


def test_a_run_that_is_refused_at_once_leaves_nothing(tmp_path):
    with pytest.raises(TiePointError), Workspace(tmp_path / "new/run") as run:
        run.store("detect", "k", {"x": np.ones(3)})
        raise TiePointError
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_is_refused_late_keeps_its_stages(tmp_path, monkeypatch):
    monkeypatch.setattr("barpc.workspace.KEEP_AFTER", 0.0)
    with pytest.raises(TiePointError), Workspace(tmp_path / "run") as run:
        run.store("detect", "k", {"x": np.ones(3)})
        raise TiePointError
    with Workspace(tmp_path / "run") as run:
        assert run.load("detect", "k") is not None


def test_stages_are_timed(tmp_path):
    with Workspace(tmp_path / "run") as run:
        with run.stage("detect"):
            sum(range(1000))
    stage = json.loads((tmp_path / "run/.barpc/state.json").read_text())["stages"][0]
    assert stage["stage"] == "detect"
    assert stage["seconds"] >= 0
    assert peak_memory() > 1e6
