"""The run folder: what is kept, what is refused, what a killed run leaves behind."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from barpc import __version__
from barpc.base.errors import OutputError, TiePointError
from barpc.base.identity import fingerprint
from barpc.base.process import peak_memory
from barpc.base.sealed import noted_outputs
from barpc.workspace import Workspace, code_version, key_of, own_files, timed


@dataclass(frozen=True)
class Options:
    cells: int = 64
    ratio: float = 0.8


def test_a_result_is_kept_and_read_back_to_the_bit(tmp_path):
    made = {"x": np.arange(6.0).reshape(2, 3) / 7, "name": np.array("é")}
    with Workspace(tmp_path / "run") as run:
        assert run.store.read(f"detect/{key_of('a')}") is None
        run.store.write(f"detect/{key_of('a')}", made)
    with Workspace(tmp_path / "run", overwrite=True) as run:
        found = run.store.read(f"detect/{key_of('a')}")
        assert run.store.read(f"detect/{key_of('b')}") is None
    np.testing.assert_array_equal(found["x"], made["x"])
    assert str(found["name"]) == "é"


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 not a zip", None])
def test_a_damaged_result_is_made_again(tmp_path, damage, caplog):
    with Workspace(tmp_path / "run") as run:
        run.store.write("detect/k", {"x": np.zeros(1000)})
        path = run.folder / ".barpc/cache/detect/k.npz"
        path.write_bytes(path.read_bytes()[:500] if damage is None else damage)
        assert run.store.read("detect/k") is None
        assert "damaged" in caplog.text
        run.store.write("detect/k", {"x": np.ones(3)})
        np.testing.assert_array_equal(run.store.read("detect/k")["x"], np.ones(3))


def test_a_result_with_python_objects_is_refused(tmp_path):
    with Workspace(tmp_path / "run") as run, pytest.raises(ValueError, match="allow_pickle"):
        run.store.write("detect/k", {"x": np.array([{"a": 1}], dtype=object)})


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


def test_in_a_key_a_path_counts_by_its_name_and_a_set_by_its_members_in_any_order():
    assert key_of(Path("a/b.tif")) == key_of(str(Path("a/b.tif"))) != key_of(Path("a/c.tif"))
    for members in ({"left", "right", "nadir"}, frozenset(("nadir", "right", "left"))):
        assert key_of(members) == key_of(["left", "nadir", "right"])


def test_the_fingerprint_is_of_the_content(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    a.write_bytes(b"one")
    b.write_bytes(b"one")
    assert fingerprint(a).key == fingerprint(b).key == fingerprint(a).sha256
    b.write_bytes(b"two")
    one, other = fingerprint(a), fingerprint(b)
    made = one, other, fingerprint(a, [other]), fingerprint(b, [one]), fingerprint(a, [one])
    assert len({found.key for found in made}) == 5


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
        with pytest.raises(OutputError, match="is an input and is never written"):
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
        assert run.outputs == {"b/a.vrt": hashlib.sha256(b"whole").hexdigest()}


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


@pytest.mark.slow
def test_leftovers_of_a_killed_run_are_cleaned_and_its_stages_stay(tmp_path):
    code = (
        "import os, signal, numpy as np\n"
        "from barpc.workspace import Workspace\n"
        f"run = Workspace({str(tmp_path / 'run')!r})\n"
        "run.store.write('detect/k', {'x': np.ones(3)})\n"
        "output = run.output('a.vrt')\n"
        "output.__enter__().write_text('half')\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    process = subprocess.run([sys.executable, "-c", code], check=False)
    assert process.returncode == -9
    assert list((tmp_path / "run/.barpc/partial").rglob("a.vrt"))
    with Workspace(tmp_path / "run") as run:
        assert [p.name for p in run.folder.iterdir()] == [".barpc"]
        assert not run.partial.exists() or not list(run.partial.iterdir())
        assert run.store.read("detect/k") is not None


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
        run.store.write("detect/k", {"x": np.ones(3)})
        raise TiePointError
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_is_refused_late_keeps_its_stages(tmp_path, sized):
    sized(kept_after=0.0)
    with pytest.raises(TiePointError), Workspace(tmp_path / "run") as run:
        run.store.write("detect/k", {"x": np.ones(3)})
        raise TiePointError
    with Workspace(tmp_path / "run") as run:
        assert run.store.read("detect/k") is not None


def test_stages_are_timed(tmp_path):
    with Workspace(tmp_path / "run") as run:
        with run.stage("detect"):
            sum(range(1000))
    stage = json.loads((tmp_path / "run/.barpc/state.json").read_text())["stages"][0]
    assert stage["stage"] == "detect"
    assert stage["seconds"] >= 0
    assert peak_memory() > 1e6


def test_times_are_kept_in_milliseconds_and_those_of_workers_count(monkeypatch):
    clock, processor = iter([10.0, 11.23456]), iter([3.0, 3.54321])
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(time, "process_time", lambda: next(processor))
    stages = []
    with timed("fit", stages) as workers:
        workers += [1.0, 2.25]
    peak = round(peak_memory() / 1e6, 1)
    assert stages == [{"stage": "fit", "seconds": 1.235, "cpu_seconds": 3.793, "peak_memory_mb": peak}]


# -- whose a file is -----------------------------------------------------------------------------------


def sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def put_state(folder: Path, outputs: object, status: str = "done") -> None:
    (folder / ".barpc").mkdir(parents=True, exist_ok=True)
    (folder / ".barpc/state.json").write_text(json.dumps({"status": status, "outputs": outputs}))


def finished(folder: Path, **texts: str) -> Path:
    with Workspace(folder, overwrite=True) as run:
        for name, text in texts.items():
            run.write_text(name, text)
    return folder


def test_the_state_holds_every_output_with_its_hash(tmp_path):
    folder = finished(tmp_path / "run", summary="{}", pairs="a,b")
    text = (folder / ".barpc/state.json").read_text()
    state = json.loads(text)
    assert text == json.dumps(state, indent=1) + "\n"
    assert state["outputs"] == {"pairs": sha("a,b"), "summary": sha("{}")}
    assert sorted(p.name for p in (folder / ".barpc").iterdir()) == ["cache", "lock", "partial", "state.json"]


@pytest.mark.parametrize("early", [True, False])
@pytest.mark.parametrize("whose", ["the user's", "edited by the user", "of a release without hashes"])
def test_overwriting_replaces_nothing_but_what_a_run_wrote(tmp_path, whose, early):
    folder = finished(tmp_path / "run", theirs="theirs" if whose == "edited by the user" else "old", b="old")
    if whose == "the user's":
        put_state(folder, {"b": sha("old")})
    if whose == "of a release without hashes":
        put_state(folder, ["theirs", "b"])
    (folder / "theirs").write_text("work of years")
    before = sorted(p.name for p in folder.iterdir())
    with pytest.raises(OutputError, match=r"theirs: not written by a run .* give another -o"):
        with Workspace(folder, overwrite=True, names=["theirs"] * early) as run:
            run.write_text("theirs", "new")
    assert (folder / "theirs").read_text() == "work of years"
    assert sorted(p.name for p in folder.iterdir()) == before
    with Workspace(folder, overwrite=True) as run:
        run.remove_stale()
    assert (folder / "theirs").read_text() == "work of years"


def test_a_file_that_comes_while_an_output_is_written_is_left_alone(tmp_path):
    with pytest.raises(OutputError, match="not written by a run"):
        with Workspace(tmp_path / "run") as run, run.output("notes.txt") as partial:
            partial.write_text("new")
            (run.folder / "notes.txt").write_text("mine")
    assert (tmp_path / "run/notes.txt").read_text() == "mine"


def test_what_is_in_the_way_is_refused_before_the_folder_is_touched(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run/summary.json").write_text("mine")
    with pytest.raises(OutputError, match=r"summary\.json: not written"):
        Workspace(tmp_path / "run", overwrite=True, names=["summary.json"])
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["summary.json"]


LISTED = [
    "../thesis.doc", "{root}/thesis.doc", "link/thesis.doc", "sub/../thesis.doc", "./thesis.doc", ".", "",
    "thesis.doc/", "a\0b", "\udcff", "x" * 5000, ".barpc/lock", "hidden/summary.json", "dir", "fifo",
]  # fmt: skip


@pytest.mark.parametrize("text", ["thesis", "another"])
@pytest.mark.parametrize("notes", [False, True])
def test_nothing_is_deleted_because_a_state_lists_it(tmp_path, text, notes):
    """Whatever the name, and whatever the hash where the file is not the folder's own."""
    folder = tmp_path / "run"
    finished(folder / "hidden", **{"summary.json": "thesis"})
    (folder / "sub").mkdir()
    (folder / "dir").mkdir()
    (tmp_path / "elsewhere").mkdir()
    for place in (tmp_path, folder, tmp_path / "elsewhere"):
        (place / "thesis.doc").write_text("thesis")
    (folder / "link").symlink_to(tmp_path / "elsewhere")
    if hasattr(os, "mkfifo"):
        os.mkfifo(folder / "fifo")
    names = [name.format(root=tmp_path) for name in LISTED]
    put_state(folder, {name: sha(text) for name in names} if not notes else {})
    if notes:
        lines = [json.dumps([name, sha(text)]) for name in names]
        (folder / ".barpc/outputs.jsonl").write_text("\n".join([*lines, "[", "7", '["a"]', "[[]]", "[" * 9999]))
    if text != "thesis":
        put_state(folder, {"thesis.doc": sha(text)})
    before = {p for p in tmp_path.rglob("*") if ".barpc" not in p.parts}
    with Workspace(folder, overwrite=True) as run:
        run.remove_stale()
    assert {p for p in tmp_path.rglob("*") if ".barpc" not in p.parts} == before
    assert (folder / "thesis.doc").read_text() == "thesis"
    assert (folder / "hidden/.barpc/state.json").is_file()


@pytest.mark.parametrize(("there", "own"), [("old", True), ("new", True), ("mine", False)])
def test_a_file_that_a_killed_run_wrote_again_is_its_own_with_either_content(tmp_path, there, own):
    put_state(tmp_path, {"a.txt": sha("old")})
    (tmp_path / ".barpc/outputs.jsonl").write_text(json.dumps(["a.txt", sha("new")]) + "\n")
    (tmp_path / "a.txt").write_text(there)
    assert own_files(tmp_path) == ({"a.txt"} if own else set())
    with Workspace(tmp_path, overwrite=True) as run:
        run.remove_stale()
    assert (tmp_path / "a.txt").exists() != own


STATES = {
    "empty": b"",
    "cut": b'{"status": "run',
    "a list": b"[1, 2]",
    "a number of 5000 digits": b'{"outputs": ' + b"9" * 5000 + b"}",
    "deep": b"[" * 100_000,
    "deep outputs": b'{"outputs": ' + b"[" * 100_000,
    "no text": b"\xff\xfe\x00",
    "other types": b'{"status": ["done"], "outputs": {"a": 1, "b": ["c"], "": "x"}, "stages": 3}',
    "huge": b" " * (33 << 20) + b'{"outputs": {}}',
}


@pytest.mark.parametrize("name", STATES)
def test_a_state_of_any_content_counts_as_missing_and_loses_nothing(tmp_path, name):
    folder = tmp_path / "run"
    (folder / ".barpc").mkdir(parents=True)
    (folder / ".barpc/state.json").write_bytes(STATES[name])
    (folder / "a").write_text("mine")
    with pytest.raises(OutputError, match="not empty"):
        Workspace(folder)
    with Workspace(folder, overwrite=True) as run:
        run.write_text("new", "new")
        run.remove_stale()
    assert (folder / "a").read_text() == "mine"


ODD = [".barpc", ".barpc/state.json", ".barpc/lock", ".barpc/outputs.jsonl"]
ODD += [".barpc/partial", ".barpc/cache", ".barpc/cache/detect"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="links and FIFOs")
@pytest.mark.parametrize("kind", ["link", "dangling link", "FIFO", "hard link"])
@pytest.mark.parametrize("name", ODD)
def test_no_link_is_followed_in_the_place_of_barpc_s_own_files(tmp_path, name, kind):
    victim, path = tmp_path / "victim", tmp_path / "run" / name
    path.parent.mkdir(parents=True)
    is_folder = name.endswith((".barpc", "partial", "cache", "detect"))
    if is_folder:
        victim.mkdir()
        (victim / "thesis.doc").write_text("thesis")
    else:
        victim.write_text("thesis")
    if kind == "hard link":
        if is_folder or path.name == "state.json":  # that one is renamed over, not written to
            pytest.skip("no such link, or it does no harm")
        os.link(victim, path)
    elif kind == "FIFO":
        if path.name == "detect":
            pytest.skip("no folder: the stage cannot be kept, and says so")
        os.mkfifo(path)
    else:
        path.symlink_to(victim if kind == "link" else tmp_path / "nowhere")
    before = {p: p.read_text() for p in victim.rglob("*")} if is_folder else victim.read_text()
    with pytest.raises(OutputError, match=f"{path.name}: cannot be written: it is not barpc's own"):
        Workspace(tmp_path / "run", overwrite=True)
    assert ({p: p.read_text() for p in victim.rglob("*")} if is_folder else victim.read_text()) == before
    assert not (tmp_path / "nowhere").exists()
    assert path.exists(follow_symlinks=False) if sys.version_info >= (3, 12) else os.path.lexists(path)


def test_a_kept_result_that_is_a_link_or_a_fifo_is_made_again(tmp_path):
    with Workspace(tmp_path / "run") as run:
        run.store.write("detect/a", {"x": np.ones(3)})
        place = run.cache / "detect"
        shutil.move(place / "a.npz", tmp_path / "a.npz")
        (place / "a.npz").symlink_to(tmp_path / "a.npz")
        (tmp_path / "thesis").write_text("thesis")
        (place / "b.npz").symlink_to(tmp_path / "thesis")
        os.mkfifo(place / "c.npz")
        for key in "abc":
            assert run.store.read(f"detect/{key}") is None
            run.store.write(f"detect/{key}", {"x": np.zeros(3)})
            np.testing.assert_array_equal(run.store.read(f"detect/{key}")["x"], np.zeros(3))
    assert (tmp_path / "thesis").read_text() == "thesis"
    assert np.load(tmp_path / "a.npz")["x"].sum() == 3


def test_an_output_does_not_go_through_a_linked_sub_folder(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "run/asp").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="asp: is no folder of barpc's own"):
        with Workspace(tmp_path / "run", overwrite=True) as run:
            run.write_text("asp/a__b.txt", "x")
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_foreign_partial_files_stay_and_a_run_below_is_left_alone(tmp_path):
    (tmp_path / "run/sub").mkdir(parents=True)
    foreign = [tmp_path / "run" / name for name in (".barpc-partial-x", "sub/.barpc-partial-y")]
    for path in foreign:
        path.write_text("mine")
    with Workspace(tmp_path / "run/sub/below") as below, below.output("a.vrt") as partial:
        partial.write_text("whole")
        with Workspace(tmp_path / "run", overwrite=True) as run:
            run.write_text("b.vrt", "b")
            run.remove_stale()
    assert (tmp_path / "run/sub/below/a.vrt").read_text() == "whole"
    assert [path.read_text() for path in foreign] == ["mine", "mine"]


@pytest.fixture
def full_disk(monkeypatch):
    """Sets that states of a run with some text in them cannot be saved any more."""
    rename = Path.replace

    def of(text):
        def replace(path, target):
            if Path(target).name == "state.json" and text in path.read_text():
                raise OSError(errno.ENOSPC, "no space left")
            return rename(path, target)

        monkeypatch.setattr(Path, "replace", replace)

    return of


def test_a_run_that_cannot_save_its_first_state_leaves_nothing_and_no_lock(tmp_path, monkeypatch, full_disk):
    full_disk("status")
    with pytest.raises(OutputError, match="no space"):
        Workspace(tmp_path / "new/run")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    with Workspace(tmp_path / "new/run"):
        pass


def test_a_refused_run_keeps_the_results_of_a_longer_one_before_it(tmp_path):
    with pytest.raises(RuntimeError), Workspace(tmp_path / "run") as run:
        run.store.write("detect/k", {"x": np.ones(3)})
        raise RuntimeError
    with pytest.raises(TiePointError), Workspace(tmp_path / "run"):
        raise TiePointError
    with Workspace(tmp_path / "run") as run:
        assert run.store.read("detect/k") is not None


def test_an_added_file_joins_what_is_there_and_replaces_its_own_only(tmp_path):
    folder = finished(tmp_path / "run", a="a")
    with Workspace(folder, adds=True) as run:
        run.write_text("b", "b")
    with pytest.raises(OutputError, match="b: exists already; give --overwrite"):
        Workspace(folder, adds=True, names=["b"])
    with Workspace(folder, adds=True, overwrite=True, names=["b"]) as run:
        run.write_text("b", "new")
    assert json.loads((folder / ".barpc/state.json").read_text())["outputs"] == {"a": sha("a"), "b": sha("new")}


@pytest.mark.parametrize("ended", ["running", "failed", "done"])
def test_what_is_added_to_a_finished_run_leaves_it_finished(tmp_path, ended):
    """Killed or failed in between: no other command may take the folder for an unfinished one of its own."""
    folder = finished(tmp_path / "run", a="a")
    if ended == "running":
        left = f"import os; from barpc.workspace import Workspace; Workspace({str(folder)!r}, adds=True); os._exit(9)"
        assert subprocess.run([sys.executable, "-c", left], check=False).returncode == 9
    elif ended == "failed":
        with pytest.raises(RuntimeError), Workspace(folder, adds=True):
            raise RuntimeError
    else:
        with Workspace(folder, adds=True) as run:
            run.write_text("b", "b")
    with pytest.raises(OutputError, match="exists and is not empty; give --overwrite"):
        Workspace(folder)


KILLED = """
import os, pathlib, signal, sys
from barpc.workspace import Workspace
left, after = int(sys.argv[2]), sys.argv[3] == "after"
rename = pathlib.Path.replace
def counted(self, target):
    global left
    left -= 1
    if left == 0 and not after:
        os.kill(os.getpid(), signal.SIGKILL)
    moved = rename(self, target)
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return moved
pathlib.Path.replace = counted
with Workspace(sys.argv[1], overwrite=sys.argv[4] == "overwrite", names=["a", "b", "asp/c"]) as run:
    for name in ("a", "b", "asp/c"):
        run.write_text(name, "new " + name)
    run.remove_stale()
"""


@pytest.mark.skipif(os.name != "posix", reason="no SIGKILL here")
@pytest.mark.parametrize(
    ("mode", "numbers"),
    [
        pytest.param("overwrite", [3], marks=pytest.mark.slow),
        pytest.param("fresh", range(1, 6), marks=pytest.mark.nightly),
        pytest.param("overwrite", range(1, 6), marks=pytest.mark.nightly),
    ],
)
def test_killed_at_any_rename_the_same_command_finishes(tmp_path, mode, numbers):
    """Every rename: of each output and of the state; the moment before it and the moment after it."""
    for number in numbers:
        for when in ("before", "after"):
            folder = tmp_path / f"{number}{when}"
            if mode == "overwrite":
                finished(folder, a="old a", b="old b", stale="old")
            command = [sys.executable, "-c", KILLED, folder, str(number), when, mode]
            killed = subprocess.run(command, check=False, capture_output=True)
            assert killed.returncode == -9, killed.stderr
            command[4] = "0"
            again = subprocess.run(command, check=False, capture_output=True)
            if again.returncode:  # all was done: a finished folder is not written over
                assert (mode, number, when) == ("fresh", 5, "after"), again.stderr
            found = {p.name: p.read_text() for p in folder.rglob("*") if ".barpc" not in p.parts and p.is_file()}
            assert found == {"a": "new a", "b": "new b", "c": "new asp/c"}
            assert json.loads((folder / ".barpc/state.json").read_text())["status"] == "done"


def test_a_run_whose_last_state_cannot_be_saved_is_not_taken_for_finished(tmp_path, monkeypatch, full_disk):
    full_disk('"done"')
    with pytest.raises(OutputError, match="no space left"), Workspace(tmp_path / "run") as run:
        run.write_text("a_RPC.TXT", "a")
        run.write_text("summary.json", "{}")
    monkeypatch.undo()
    assert (tmp_path / "run/a_RPC.TXT").exists()
    assert not (tmp_path / "run/summary.json").exists()
    with Workspace(tmp_path / "run") as again:  # the same command goes on
        again.write_text("summary.json", "{}")
    assert (tmp_path / "run/summary.json").exists()


# --- the root of a folder, and paths that do not depend on its place ---------------------------------------


def test_a_sealed_folder_lists_its_outputs_and_names_what_they_were_made_from(tmp_path):
    with Workspace(tmp_path / "run") as run:
        run.write_text("b/c.txt", "1")
        run.write_text("a.txt", "2")
        root = run.seal("f" * 64, {"link.tif": "0" * 64})
    sums = (tmp_path / "run/SHA256SUMS").read_bytes()
    assert root == hashlib.sha256(sums).hexdigest() == noted_outputs(tmp_path / "run")["SHA256SUMS"]
    head, *lines = sums.decode().splitlines()
    assert head == f"# barpc {__version__}, code {code_version()}, after {'f' * 64}"
    hashes = {"a.txt": hashlib.sha256(b"2").hexdigest(), "b/c.txt": hashlib.sha256(b"1").hexdigest()}
    assert lines == [f"{sha}  {name}" for name, sha in {**hashes, "link.tif": "0" * 64}.items()]
    assert "link.tif" not in own_files(tmp_path / "run")


def test_a_run_that_fails_after_its_summary_has_none(tmp_path):
    """A disk that is full when the list of outputs is written, last of all."""
    with pytest.raises(OutputError), Workspace(tmp_path / "out") as run:
        run.write_text("a.txt", "a")
        run.write_text("summary.json", "{}")
        raise OutputError("No space left on device")
    assert (tmp_path / "out/a.txt").exists()
    assert not (tmp_path / "out/summary.json").exists()


def test_what_is_added_to_a_sealed_folder_is_a_layer_and_the_same_again_is_none(tmp_path):
    folder = tmp_path / "run"
    with Workspace(folder) as run:
        run.write_text("a", "1")
        first = run.seal()
    sums = folder / "SHA256SUMS"
    for text, layers in (("2", 2), ("2", 2), ("3", 3), ("2", 4)):
        with Workspace(folder, adds=True, overwrite=True, names=["b"]) as run:
            run.write_text("b", text)
        assert sums.read_text().count("# barpc ") == layers
    assert f", after {first}\n" in sums.read_text()
    assert sums.read_text().count("  b\n") == 3
    assert sum(line.endswith("  b") and line[0] != "#" for line in sums.read_text().splitlines()) == 1
    with pytest.raises(RuntimeError), Workspace(folder, adds=True, overwrite=True, names=["b"]) as run:
        run.write_text("b", "of a command that fails")
        raise RuntimeError
    assert sums.read_text().count("# barpc ") == 4
    with Workspace(folder, overwrite=True) as run:  # another run begins anew
        run.write_text("a", "5")
        run.seal()
    assert sums.read_text().count("# barpc ") == 1
    shutil.rmtree(folder / ".barpc")  # the notes may be deleted
    with Workspace(folder, adds=True, names=["c"]) as run:
        run.write_text("c", "4")
    assert sums.read_text().count("# barpc ") == 2


def test_sums_that_somebody_changed_are_neither_replaced_nor_built_on(tmp_path):
    folder = tmp_path / "run"
    with Workspace(folder) as run:
        run.write_text("a", "1")
        run.seal()
    for text in (b"# barpc 9, code 0\n" + b"0" * 64 + b"  a\n", b"mine"):
        (folder / "SHA256SUMS").write_bytes(text)
        with Workspace(folder, adds=True, overwrite=True, names=["b"]) as run:
            run.write_text("b", text.decode())
        assert (folder / "SHA256SUMS").read_bytes() == text
        with pytest.raises(OutputError, match="SHA256SUMS: not written by a run in this folder, or changed since"):
            Workspace(folder, overwrite=True, names=["SHA256SUMS"])


def test_stages_and_the_place_of_a_run_outlast_what_is_added_to_it(tmp_path):
    with Workspace(tmp_path / "run") as run:
        with run.stage("match"):
            pass
        run.write_text("a", "1")
    (tmp_path / "run").rename(tmp_path / "moved")
    with Workspace(tmp_path / "moved", adds=True) as run, run.stage("dsm"):
        pass
    state = json.loads((tmp_path / "moved/.barpc/state.json").read_text())
    assert [stage["stage"] for stage in state["stages"]] == ["match", "dsm"]
    assert state["folder"] == str(tmp_path / "run")
    (tmp_path / "moved/.barpc/state.json").write_text('{"status": "done", "stages": 5, "folder": [1]}')
    with Workspace(tmp_path / "moved", adds=True):
        pass
    assert json.loads((tmp_path / "moved/.barpc/state.json").read_text())["stages"] == []


def test_every_name_read_beside_an_image_may_hide_its_rpc():
    from barpc.rpcio.sources import _sidecar_names
    from barpc.workspace import SIDECAR_ENDS

    for image in ("a.tif", "IMG_PHR1A_P_001_R1C1.TIF", "IMG-HH-ALPSMW.tif", "10APR-P2AS_R1C1-012_P001.NTF", "noend"):
        assert all(name.lower().endswith(SIDECAR_ENDS) for _, name, _ in _sidecar_names(image))
