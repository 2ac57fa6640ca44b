"""A run that is killed, interrupted, or out of disk: the same command goes on, and the bytes are the same."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from barpc.workspace import Workspace
from tests.lanes import rest_slow

from .conftest import assert_one_line, barpc, hashes
from .trials import SAMPLES, crop, outputs

ROOT = Path(__file__).resolve().parents[2]
posix = pytest.mark.skipif(os.name != "posix", reason="signals and forks")


def sweep(*words: object) -> dict[str, object]:
    """The trials in a process of their own, which may fork."""
    command = [sys.executable, "-m", "tests.reliability.trials", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, timeout=3600)
    assert done.returncode == 0, (done.stdout, done.stderr)
    return json.loads(done.stdout)


@pytest.mark.costs(4)
@posix
@pytest.mark.parametrize(
    "trials", [pytest.param(2, marks=pytest.mark.slow), pytest.param(50, marks=pytest.mark.nightly)]
)
def test_a_killed_run_goes_on_and_ends_with_the_same_bytes(trials):
    found = sweep(trials, "--seed", trials)
    assert found["identical"] == trials
    assert found["inputs_unchanged"]
    assert found["killed_at_work"] >= trials / 5
    assert trials < 50 or found["resumed_from_kept_results"] >= trials / 4


def started(*args: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "barpc", *map(str, args)]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background shell's jobs ignore it
    )


def wait_for(condition, process: subprocess.Popen[str], seconds: float = 600.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def kept_in(folder: Path) -> dict[Path, int]:
    """Results of tasks that a run folder keeps, and when they were made."""
    return {path: path.stat().st_mtime_ns for path in folder.glob(".barpc/cache/*/*.npz")}


def children(pid: int) -> list[int]:
    """Processes that a process has started, and theirs."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        for word in (task / "children").read_text().split():
            found += [int(word), *children(int(word))]
    return found


def working(pid: int) -> list[int]:
    """Workers of a process pool among the children."""
    found = []
    for child in children(pid):
        with contextlib.suppress(OSError):
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(child)
    return found


@pytest.fixture(scope="module")
def wide(tmp_path_factory) -> list[Path]:
    """Two larger crops: time enough to be interrupted."""
    folder = tmp_path_factory.mktemp("wide")
    return [crop(path, folder / path.name, side=360, start=300) for path in SAMPLES[:2]]


@pytest.mark.landing(1)
@posix
@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "jobs"),
    [(signal.SIGINT, 1), (signal.SIGTERM, 2), pytest.param(signal.SIGINT, 2, marks=pytest.mark.nightly)],
)
def test_an_interrupted_run_leaves_its_work_and_says_how_to_go_on(wide, tmp_path, number, jobs):
    command = ("adjust", *wide, "-o", tmp_path / "out", "-j", jobs)
    process = started(*command)
    wait_for(lambda: kept_in(tmp_path / "out"), process)
    workers = working(process.pid)
    assert len(workers) == (jobs if jobs > 1 else 0)
    process.send_signal(number)
    out, err = process.communicate(timeout=600)
    assert process.returncode == 130
    assert out == ""
    assert re.fullmatch(r"barpc: interrupted; finished tasks are kept: the same command goes on at \w.*", err.strip())
    assert not [path for path in (tmp_path / "out").iterdir() if path.name != ".barpc"]  # it did not finish
    for worker in workers:
        wait_until_gone(worker)
    kept = kept_in(tmp_path / "out")
    assert kept
    assert barpc(*command).code == 0
    assert kept.items() < kept_in(tmp_path / "out").items()  # nothing finished was made again


def wait_until_gone(pid: int) -> None:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return
        except OSError:
            return
        time.sleep(0.02)
    pytest.fail(f"process {pid} is still there")


@pytest.mark.nightly
@posix
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="children are listed in /proc")
def test_a_worker_that_dies_is_one_line_and_the_same_command_goes_on(wide, tmp_path):
    command = ("adjust", *wide, "-o", tmp_path / "out", "-j", 2)
    process = started(*command)
    wait_for(lambda: kept_in(tmp_path / "out"), process)
    os.kill(working(process.pid)[0], signal.SIGKILL)
    out, err = process.communicate(timeout=600)
    assert (process.returncode, out) == (1, "")
    assert err.startswith("barpc: a worker process died")
    assert len(err.strip().splitlines()) == 1
    assert barpc(*command).code == 0
    alone = barpc("adjust", *wide, "-o", tmp_path / "alone")
    assert alone.code == 0
    assert outputs(tmp_path / "out") == outputs(tmp_path / "alone")


@posix
@pytest.mark.slow
def test_workers_end_with_a_parent_that_was_killed(wide, tmp_path):
    process = started("adjust", *wide, "-o", tmp_path / "out", "-j", 2)
    wait_for(lambda: kept_in(tmp_path / "out"), process)
    workers = working(process.pid)
    assert len(workers) == 2
    process.kill()
    process.communicate()
    for worker in workers:
        wait_until_gone(worker)


# -- caches and folders -------------------------------------------------------------------------------


def relative(found: dict[str, bytes], folder: Path) -> dict[str, bytes]:
    """The outputs with the folder that the images lie in left out."""
    return {name: content.replace(str(folder).encode(), b"") for name, content in found.items()}


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def other_content(path: Path) -> None:
    path.write_bytes(b"PK\x03\x04" + b"\0" * 200)


def flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)


def emptied(path: Path) -> None:
    path.write_bytes(b"")


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("damage", rest_slow([flipped, cut_short, other_content, Path.unlink, emptied]))
def test_damaged_results_are_made_again(crops, ran, out, tmp_path, damage):
    kept = kept_in(out)
    assert kept
    for path in kept:
        damage(path)
    assert barpc("adjust", *crops, "-o", out, "--overwrite").code == 0
    assert relative(outputs(out), tmp_path) == relative(outputs(ran / "out"), ran)


@pytest.mark.slow
def test_results_of_another_version_are_not_used(crops, out, monkeypatch):
    kept = kept_in(out)
    assert barpc("adjust", *crops, "-o", out, "--overwrite").code == 0
    assert kept_in(out) == kept
    monkeypatch.setattr("barpc.workspace.code_version", lambda: "another")
    assert barpc("adjust", *crops, "-o", out, "--overwrite").code == 0
    assert kept.items() < kept_in(out).items()
    assert len(kept_in(out)) == 2 * len(kept)


@pytest.mark.slow  # before a commit: one that is replaced at work, in test_identity
def test_an_image_that_changed_is_worked_on_again_whatever_its_date(crops, out):
    first = outputs(out)["tables/observations.csv"]
    times = crops[0].stat()
    data = bytearray(crops[0].read_bytes())
    data[20000:60000] = bytes(40000)
    crops[0].write_bytes(data)
    os.utime(crops[0], ns=(times.st_atime_ns, times.st_mtime_ns))
    assert barpc("adjust", *crops, "-o", out, "--overwrite").code == 0
    assert outputs(out)["tables/observations.csv"] != first


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("year", rest_slow([1971, 2099]))
def test_a_clock_that_goes_wrong_changes_nothing(crops, ran, out, tmp_path, year):
    then = (year - 1970) * 365.25 * 86400
    for path in [*crops, *out.rglob("*")]:
        os.utime(path, (then, then))
    assert barpc("adjust", *crops, "-o", out, "--overwrite").code == 0
    assert relative(outputs(out), tmp_path) == relative(outputs(ran / "out"), ran)


def test_a_folder_in_use_is_left_alone(crops, tmp_path):
    with Workspace(tmp_path / "out"):
        before = hashes([tmp_path])
        assert_one_line(barpc("adjust", *crops, "-o", tmp_path / "out"), 1, "another run")
        assert hashes([tmp_path]) == before


def test_existing_results_are_left_alone(crops, out, tmp_path):
    before = hashes([tmp_path])
    assert_one_line(barpc("adjust", *crops, "-o", out), 1, "--overwrite")
    assert hashes([tmp_path]) == before


@pytest.mark.parametrize("where", ["/proc/barpc", "/dev/null/out"])
def test_a_place_that_cannot_be_written_is_named(crops, where):
    assert_one_line(barpc("adjust", *crops, "-o", where), 1, where)


def test_a_cache_that_cannot_be_written_is_named(crops, tmp_path):
    (tmp_path / "out/.barpc").mkdir(parents=True)
    (tmp_path / "out/.barpc/cache").write_text("in the way")
    said = barpc("adjust", *crops, "-o", tmp_path / "out", "--overwrite")
    assert_one_line(said, 1, "out", "cannot be written")
    assert (tmp_path / "out/.barpc/cache").read_text() == "in the way"


@pytest.fixture
def fails_with(monkeypatch) -> Callable[[Exception], None]:
    """Sets what the adjustment of every run raises."""

    def sets(error: Exception) -> None:
        def fail(*_args, **_kwargs):
            raise error

        monkeypatch.setattr("barpc.pipeline.adjusting.adjust_tracks", fail)

    return sets


@pytest.mark.parametrize(
    "error", rest_slow([MemoryError(), RecursionError("deep"), OSError(24, "Too many open files")])
)
def test_an_error_of_the_machine_is_one_line(crops, out, monkeypatch, fails_with, error):
    fails_with(error)
    said = barpc("adjust", *crops, "-o", out, "--overwrite")
    assert said.code == 1
    assert len(said.err.strip().splitlines()) == 1
    assert said.err.startswith("barpc: ")
    assert "Traceback" not in said.err
    monkeypatch.undo()
    assert barpc("adjust", *crops, "-o", out, "--overwrite").code == 0


def test_debug_shows_the_traceback_of_a_bug(crops, out, fails_with):
    fails_with(ZeroDivisionError("a bug"))
    said = barpc("--debug", "adjust", *crops, "-o", out, "--overwrite")
    assert said.code == 1
    assert "Traceback" in said.err
    assert "report" in said.err.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("whole", "share"), [(False, 0.7), pytest.param(True, 0.95, marks=pytest.mark.nightly)], ids=["part", "whole"]
)
def test_stages_are_told_with_seconds_and_memory(crops, tmp_path, caplog, whole, share):
    """What no stage has, the command line and the notes of the run's state, is a part of a small run."""
    start = time.process_time()
    with caplog.at_level("INFO"):
        assert barpc("-v", "adjust", *(SAMPLES if whole else crops), "-o", tmp_path / "out").code == 0
    spent = time.process_time() - start
    stages = json.loads((tmp_path / "out/.barpc/state.json").read_text())["stages"]
    names = [stage["stage"] for stage in stages]
    told = "inputs, fingerprints, tie points, adjustment, fit, write, verify, block, summary, pictures, tables, report"
    assert names == told.split(", ")
    told = sum(stage["cpu_seconds"] for stage in stages)
    assert share * spent < told <= spent + 0.0005 * len(names)  # of rounding
    for stage in stages:
        assert stage["seconds"] >= 0
        assert stage["peak_memory_mb"] > 20
        assert f"{stage['stage']}: " in caplog.text
