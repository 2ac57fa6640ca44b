"""A call of the system that fails, whichever: one line, nothing lost, and the same command again finishes.

In this process the calls of a run folder are counted and each fails once; of the whole command, under strace, those
that `tests.reliability.injected` chooses.
"""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from barpc.base.errors import OutputError
from barpc.workspace import Workspace
from tests.lanes import rest_slow

from .injected import CALLS, ERRORS, Fault, Scene, faults, missing, sweep
from .trials import SAMPLES, crop

FILES = {"a.vrt": "one", "b_RPC.TXT": "two", "summary.json": "three"}


def work(folder: Path) -> None:
    """A run as small as can be: a kept result, three outputs, the end."""
    with Workspace(folder, names=FILES) as workspace:
        workspace.store.write(f"stage/{'0' * 32}", {"x": np.arange(3)})
        for name, text in FILES.items():
            with workspace.stage(name):
                workspace.write_text(name, text)


@contextmanager
def failing(monkeypatch: pytest.MonkeyPatch, where: Any, name: str, when: int, code: int) -> Iterator[list[int]]:
    """The `when`-th call of `where.name` raises; the list gets a number for each call."""
    real: Callable[..., Any] = getattr(where, name)
    seen: list[int] = []

    def counted(*args: Any, **kwargs: Any) -> Any:
        seen.append(len(seen))
        if len(seen) == when:
            raise OSError(code, os.strerror(code))
        return real(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(where, name, counted)
        yield seen


@pytest.mark.landing(5)
@pytest.mark.parametrize(
    ("where", "name", "least"),
    [
        pytest.param(os, "fsync", 15, id="fsync"),
        pytest.param(Path, "replace", 8, id="rename", marks=pytest.mark.slow),
        pytest.param(os, "open", 15, id="open of a descriptor", marks=pytest.mark.slow),
        pytest.param(Path, "open", 8, id="open"),
        pytest.param(Path, "mkdir", 8, id="mkdir", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("code", rest_slow([errno.ENOSPC, errno.EIO]))
def test_a_call_of_a_run_folder_that_fails_loses_nothing(tmp_path, monkeypatch, where, name, least, code):
    met = 0
    for when in range(1, 1000):
        folder = tmp_path / str(when)
        refused = False
        with failing(monkeypatch, where, name, when, code) as seen:
            try:
                work(folder)
            except OutputError:
                refused = True
        if len(seen) < when:
            break
        met += 1
        found = {p.name: p.read_text() for p in folder.glob("*") if p.is_file()}
        assert found.items() <= FILES.items()  # whole, or not there
        if refused:
            work(folder)
            found = {p.name: p.read_text() for p in folder.glob("*") if p.is_file()}
        assert found == FILES
        assert not any((folder / ".barpc/partial").glob("*/*"))
    assert met >= least


def test_an_output_is_known_where_only_the_disk_was_not_told_of_its_name(tmp_path, monkeypatch):
    # of the state and its folder, the note, the file, and then of the folder with its new name
    with failing(monkeypatch, os, "fsync", 5, errno.EIO), pytest.raises(OutputError, match=r"summary\.json"):
        with Workspace(tmp_path / "out") as workspace:
            workspace.write_text("summary.json", "x")
    assert (tmp_path / "out" / "summary.json").read_text() == "x"
    with Workspace(tmp_path / "out") as workspace:
        assert workspace.owns("summary.json")


# --- the whole command, under strace ----------------------------------------------------------------------


def test_faults_are_spread_over_the_calls():
    chosen = list(faults({"fsync": [3, 4, 5, 8, 9]}, 2, ("EIO", "EINTR")))
    assert chosen == [
        *(Fault("fsync", "EIO", n) for n in (3, 5, 9)),
        *(Fault("fsync", "EINTR", n) for n in (3, 4, 8, 9)),
    ]
    assert set(CALLS.values()) == {"open", "write", "fsync", "rename", "mkdir", "read", "recv"}


@pytest.fixture
def traced() -> None:
    if (why := missing()) is not None:
        pytest.skip(why)


def passes_alone(request: pytest.FixtureRequest) -> bool:
    """Run a test in a process of its own, where an oracle's threads let no fork of this one live."""
    if "numba.np.ufunc.omppool" not in sys.modules:
        return False
    again = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-m", "slow or not slow", request.node.nodeid]
    done = subprocess.run(again, cwd=request.config.rootpath, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    return True


@pytest.mark.nightly
def test_the_last_rename_and_the_last_sync_of_a_run_fail(traced, tmp_path, request):
    if passes_alone(request):
        return
    (tmp_path / "in").mkdir()
    images = [crop(path, tmp_path / "in" / path.name) for path in SAMPLES[:2]]
    scene = Scene.of(["adjust", *map(str, images), "-j", "1"], tmp_path, images)
    for call, error in (("rename", "ENOSPC"), ("fsync", "EIO"), ("write", "EINTR")):
        assert scene.meet(Fault(call, error, scene.calls[call][-1])) is None


@pytest.mark.nightly
def test_whatever_call_fails_nothing_is_lost(traced, tmp_path, request):
    if passes_alone(request):
        return
    result = sweep(25, tmp_path)
    assert result["found"] == []
    assert {kind.split()[1] for kind in result["by_kind"]} == set(CALLS.values())
    assert result["faults"] > 10 * len(ERRORS)
