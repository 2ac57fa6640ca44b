"""Standard streams that are closed, full or broken, and signals that come once, twice or at the wrong moment."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from barpc.cli import process
from barpc.cli.process import Interrupt, interruptible
from tests.cli.test_main import run
from tests.lanes import rest_slow
from tests.reliability.test_interruption import ROOT, posix
from tests.reliability.trials import SAMPLES, crop, outputs

COMMAND = f"{sys.executable} -m barpc"
FULL = Path("/dev/full")
TOLD = "barpc: interrupted; nothing was kept\n"


# --- streams ----------------------------------------------------------------------------------------------


def shell(line: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = ["bash", "-o", "pipefail", "-c", line]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd, env=environment, timeout=600)


ENDS = {
    ">&-": (0, "", ""),
    "2>&-": (0, "out", ""),
    "<&- >&- 2>&-": (0, "", ""),
    ">/dev/full": (1, "", "barpc: stdout: cannot be written (No space left on device); what was written to files "
                          "is whole\n"),
    "2>/dev/full": (0, "out", ""),
    ">/dev/full 2>/dev/full": (1, "", ""),
    "| true": (1, "", ""),
}  # fmt: skip


def needed(how: str) -> None:
    if "full" in how and not FULL.exists():
        pytest.skip("no /dev/full on this system")


def assert_ended(said: subprocess.CompletedProcess[str], how: str, whole: str) -> None:
    code, out, err = ENDS[how]
    assert (said.returncode, said.stderr) == (code, err), said
    assert said.stdout == (whole if out else "")


@pytest.mark.landing(5)
@posix
@pytest.mark.parametrize("how", rest_slow(ENDS))
@pytest.mark.parametrize(
    "words", rest_slow(["adjust --help", "--version", "-q project data_samples/view_00.tif 5.4 43.3 9"])
)
def test_a_stream_that_is_closed_full_or_broken(words: str, how: str) -> None:
    needed(how)
    plain = shell(f"{COMMAND} {words}")
    assert (plain.returncode, plain.stderr) == (0, "")
    assert_ended(shell(f"{COMMAND} {words} {how}"), how, plain.stdout)


@pytest.mark.nightly
@posix
@pytest.mark.parametrize("how", ENDS)
@pytest.mark.parametrize("jobs", [1, 2])
def test_what_is_written_to_files_is_whole_whatever_becomes_of_the_streams(
    pristine: list[Path], tmp_path: Path, jobs: int, how: str
) -> None:
    needed(how)
    for path in pristine[:2]:
        shutil.copy(path, tmp_path)
    line = f"{COMMAND} -v adjust view_00.tif view_01.tif -j {jobs} -o"
    plain = shell(f"{line} plain", tmp_path)
    assert plain.returncode in (0, 3), plain
    said = shell(f"{line} out {how}", tmp_path)
    code, _, err = ENDS[how]
    assert said.returncode == (code or plain.returncode), said
    assert said.stderr.endswith(err)
    assert "bug" not in said.stderr
    assert outputs(tmp_path / "out").keys() == outputs(tmp_path / "plain").keys()
    made, other = (
        {k: v for k, v in outputs(tmp_path / name).items() if k.endswith(".csv")} for name in ("out", "plain")
    )
    assert made == other


@pytest.mark.landing(3)
@posix
@pytest.mark.parametrize("how", ["2>&-", pytest.param("2>/dev/full", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("words", "code"), [("info nothing.tif", 1), ("info --nonsense", 2), ("", 2)])
def test_an_error_that_nobody_can_be_told_has_its_exit_code(words: str, code: int, how: str) -> None:
    needed(how)
    assert shell(f"{COMMAND} {words} {how}").returncode == code


@posix
def test_no_file_of_a_run_gets_the_number_of_a_closed_stream() -> None:
    """A library's word on descriptor 2 would stand in the file that has it."""
    code = (
        "import os, sys; from barpc.cli import process; process.hold_streams(); f = open('/dev/null')\n"
        "assert f.fileno() > 2 and all(os.get_inheritable(n) for n in (0, 1, 2))\n"
        "print('x', file=sys.stderr, flush=True); print('y', flush=True); assert sys.stdin.read() == ''; os._exit(7)"
    )
    for how in ("<&-", ">&-", "2>&-", "<&- >&- 2>&-", "<&- 2>&-"):
        assert shell(f'{sys.executable} -c "{code}" {how} 3>&- 4>&-').returncode == 7, how


# --- signals ----------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _heard() -> Iterator[None]:
    """Ctrl-C is heard, also where the tests run behind a shell, which has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_like_ctrl_c_and_is_left_as_it_was(number: int) -> None:
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt), interruptible(own=False):
        signal.raise_signal(number)
    assert signal.getsignal(number) is before


def test_a_ctrl_c_that_is_ignored_stays_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a shell has it for what runs behind it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interruptible(own=False):
            signal.raise_signal(signal.SIGINT)
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_in_a_thread_no_signal_is_touched() -> None:
    found = list[object]()

    def work() -> None:
        with interruptible(own=False):
            found.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.getsignal(signal.SIGTERM)]


@pytest.fixture
def ended(monkeypatch: pytest.MonkeyPatch) -> tuple[list[float], list[object]]:
    """A clock of one's own, and what would have been said and the codes of ends at once."""
    now, found = [10.0], list[object]()
    monkeypatch.setattr(process.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(process.os, "_exit", found.append)
    monkeypatch.setattr(process.os, "write", lambda number, text: found.append((number, text.decode())))
    return now, found


def test_the_second_signal_changes_nothing_and_a_late_one_ends_it(ended) -> None:
    now, found = ended
    assert process.CLEAN_UP == 2.0
    interrupt = Interrupt()
    with pytest.raises(KeyboardInterrupt):
        interrupt(2, None)
    for now[0] in (10.0, 10.5, 12.0):
        interrupt(15, None)
    assert found == []
    now[0] = 12.1
    interrupt(2, None)
    assert found == [(2, "barpc: interrupted\n"), 130]


@pytest.mark.parametrize("code", [0, 1, 3, 130])
def test_a_signal_after_the_last_word_has_no_word_and_changes_no_code(ended, code: int) -> None:
    now, found = ended
    interrupt = Interrupt()
    interrupt.done(code)
    interrupt(2, None)
    assert found == []
    now[0] = 12.1
    interrupt(2, None)
    assert found == [(2, ""), code]


@pytest.mark.parametrize("error", [RuntimeError("x"), ImportError("x"), KeyboardInterrupt()])
def test_what_an_interruption_makes_of_other_code_is_no_error(verb, capsys, error: BaseException) -> None:
    """Class bodies, callbacks of C, imports turn it into theirs."""

    def work() -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            signal.raise_signal(signal.SIGTERM)  # in its clean-up
            raise error from None

    verb(work)
    assert run("info") == 130
    assert capsys.readouterr().err == TOLD


@pytest.mark.nightly
@posix
@pytest.mark.parametrize("jobs", [2, 1])
def test_ctrl_c_pressed_again_is_one_line_and_loses_nothing(tmp_path: Path, jobs: int) -> None:
    """Whenever the second comes, and to the workers too, as from a terminal."""
    images = [crop(path, tmp_path / path.name, side=300) for path in SAMPLES[:2]]
    command = [sys.executable, "-m", "barpc", "adjust", *map(str, images), "-j", str(jobs), "-o"]
    plain = tmp_path / "plain"
    assert subprocess.run([*command, plain], cwd=ROOT, capture_output=True, check=False).returncode in (0, 3)
    hits, state = 0, tmp_path / "out/.barpc/state.json"
    for k in range(12):
        before = state.stat().st_mtime_ns if state.exists() else 0  # of the run that was interrupted
        run = subprocess.Popen(
            [*command, tmp_path / "out"],
            cwd=ROOT,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        while run.poll() is None and not (state.exists() and state.stat().st_mtime_ns != before):
            time.sleep(0.01)
        time.sleep(0.1 * k)
        for gap in (0.0, 0.001 * 4 ** (k % 5), 0.02):
            time.sleep(gap)
            if run.poll() is None:
                os.killpg(run.pid, signal.SIGINT)
        out, err = run.communicate(timeout=600)
        if run.returncode in (0, 3):  # it had been finished
            shutil.rmtree(tmp_path / "out")
            continue
        assert (run.returncode, out) == (130, "")
        if "Ran out of input" in err:  # a worker that Python was just starting says so; nothing can keep it from that
            assert jobs > 1
            assert TOLD[:18] in err
        else:
            assert err.lstrip().startswith(TOLD[:18])
        hits += 1
    assert hits >= 4
    again = subprocess.run([*command, tmp_path / "out"], cwd=ROOT, capture_output=True, check=False)
    assert again.returncode in (0, 3)
    made, truth = (outputs(folder)["tables/observations.csv"] for folder in (tmp_path / "out", plain))
    assert made == truth
