"""Lines, bars and workers: what is told while a run works, and by whom it is done."""

from __future__ import annotations

import gc
import io
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import CancelledError
from contextlib import suppress
from types import SimpleNamespace

import click
import pytest

from barpc.base.errors import InputError
from barpc.cli.terminal import MINUTE, Lines, progress_told
from barpc.verbs.workers import THREADS, executor_for
from tests.lanes import rest_slow


class Told:
    """Lines by a clock that is set by hand."""

    def __init__(self, groups: bool = False, start: float = 500.0) -> None:
        self.now, self.said = start, list[str]()
        self.lines = Lines(groups, clock=lambda: self.now, say=self.said.append)


def test_a_line_comes_when_a_minute_is_over_and_not_before() -> None:
    told = Told()
    told.lines.look(now=True)  # nothing has begun
    told.lines("match", 0, 40)
    told.now += MINUTE - 0.1
    told.lines("match", 3, 40)
    assert told.said == []
    told.now += 0.1
    told.lines.look()
    told.lines.look()
    assert told.said == ["match: 3 of 40, about 12.3 min left"]
    assert MINUTE == 60.0
    told.lines("detect", 0, 40)  # of what nothing is done no end is told
    told.now += MINUTE
    told.lines.look()
    assert told.said[1:] == ["detect: 0 of 40"]


def test_the_time_left_counts_from_the_beginning_of_the_stage() -> None:
    told = Told()
    told.now += 1000.0
    told.lines("detect", 5, 5)
    told.said.clear()
    told.lines("match", 0, 2)  # the clock of the stage begins anew, that of the lines does not
    told.now += 30.0
    told.lines("match", 1, 2)
    assert told.said == []
    told.now += 30.0
    told.lines.look()
    assert told.said == ["match: 1 of 2, about 1.0 min left"]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0, "0 s"), (1.6, "2 s"), (59.0, "59 s"), (60.0, "1.0 min"), (90.0, "1.5 min"), (3599.0, "60.0 min"),
     (3600.0, "1.0 h"), (9000.0, "2.5 h")],
)  # fmt: skip
def test_a_single_task_tells_how_long_it_is_at_work_in_a_time_of_its_unit(seconds: float, text: str) -> None:
    told = Told()
    told.lines("adjustment", 0, 1)
    told.now += seconds
    told.lines("adjustment", 0, 1)
    assert told.said == [f"adjustment: at work for {text}"] * (seconds >= MINUTE)
    told.said.clear()
    told.lines.look(now=True)
    assert told.said == [f"adjustment: at work for {text}"]


@pytest.mark.slow
@pytest.mark.landing(6)
def test_the_verdict_begins_a_line_behind_the_last_bar(pristine) -> None:
    screen, side = pytest.importorskip("pty").openpty()
    with subprocess.Popen([sys.executable, "-m", "barpc", "check", *pristine[:2]], stdout=side, stderr=side):
        os.close(side)
        shown = b""
        with suppress(OSError):  # the end of a terminal
            while part := os.read(screen, 4096):
                shown += part
    os.close(screen)
    lines = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.decode()).splitlines()
    assert any(line.startswith(("The cameras of both", "2 of 2 images need")) for line in lines), lines[-8:]


def test_tenths_are_told_only_where_they_are_asked_for() -> None:
    said = list[str]()
    lines = Lines(clock=lambda: 0.0, say=said.append)
    for done in range(11):
        lines("match", done, 10)
    assert said == []


def test_with_v_a_line_comes_at_every_tenth_of_more_than_one_task() -> None:
    told = Told(groups=True)
    for done in range(21):
        told.lines("match", done, 20)
    assert [line.split(",")[0] for line in told.said] == [f"match: {n} of 20" for n in range(2, 21, 2)]
    told.said.clear()
    told.lines("detect", 1, 20)  # another stage: its tenths begin at none
    assert told.said == []
    told.lines("detect", 2, 20)
    told.lines("adjustment", 1, 1)
    assert told.said == ["detect: 2 of 20, about 0 s left"]
    told.lines("few", 1, 2)
    assert told.said[1:] == ["few: 1 of 2, about 0 s left"]


def test_passes_of_an_unknown_number_are_told_without_a_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    told = Told()
    for done in range(3):
        told.lines("adjustment", done, 0)
        told.now += 20.0
    told.lines.look(now=True)
    assert told.said == ["adjustment: pass 2, at work for 1.0 min"]
    monkeypatch.setattr(sys, "stderr", Window())
    with progress_told(False, 0) as progress:
        for done, total in ((0, 0), (1, 0), (12, 0)):
            progress("adjustment", done, total)
        text = sys.stderr.getvalue()  # type: ignore[attr-defined]
        assert text.rstrip().endswith("12")
        assert not {"/", "%"} & {*text}
        progress("adjustment", 12, 12)


def test_who_watches_looks_each_second_until_it_is_over() -> None:
    told, waits = Told(), list[float]()
    told.lines("adjustment", 0, 1)

    def wait(seconds: float) -> bool:
        waits.append(seconds)
        told.now += 61.0
        return len(waits) > 2

    told.lines.watch(SimpleNamespace(wait=wait))  # type: ignore[arg-type]
    assert waits == [1.0] * 3
    assert told.said == ["adjustment: at work for 1.0 min", "adjustment: at work for 2.0 min"]


class Window(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("seen", "quiet", "verbose", "kind"),
    [(True, False, 0, "bars"), (True, False, 1, "groups"), (False, False, 0, "lines"), (False, False, 2, "groups"),
     (True, True, 0, "none"), (False, True, 1, "none")],
)  # fmt: skip
def test_who_looks_sees_bars_and_a_log_gets_lines(
    seen: bool, quiet: bool, verbose: int, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stderr", Window() if seen else io.StringIO())
    threads = list[SimpleNamespace]()
    monkeypatch.setattr(threading, "Thread", lambda **given: threads.append(SimpleNamespace(**given)) or Started())
    with progress_told(quiet, verbose) as told:
        assert isinstance(told, Lines) == (kind in ("lines", "groups"))
        for done in range(1, 11):
            told("match", done, 10)
        for thread in threads:
            assert thread.daemon
            assert thread.target == told.watch
            (over,) = thread.args
            assert not over.is_set()
    assert len(threads) == (kind in ("lines", "groups"))
    assert all(thread.args[0].is_set() for thread in threads)
    text = sys.stderr.getvalue()  # type: ignore[attr-defined]
    assert ("10/10" in text) == (kind == "bars")
    assert ("barpc: match: 4 of 10" in text) == (kind == "groups")
    if kind in ("lines", "none"):
        assert text == ""


class Started:
    def start(self) -> None:
        pass


def test_a_bar_follows_the_numbers_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Window())
    made = list[SimpleNamespace]()

    def progressbar(**given: object) -> SimpleNamespace:
        bar = SimpleNamespace(**given, pos=0, ended=0)
        bar.update = lambda step: setattr(bar, "pos", bar.pos + step)
        bar.render_finish = lambda: setattr(bar, "ended", bar.ended + 1)
        made.append(bar)
        return bar

    monkeypatch.setattr(click, "progressbar", progressbar)
    with progress_told(False, 0) as told:
        told("match", 1, 4)
        told("match", 3, 8)
        (bar,) = made
        assert (bar.pos, bar.length, bar.ended, bar.show_pos) == (3, 8, 0, True)
        assert bar.label == "match" + 17 * " "
        told("fit\x1b", 2, 2)
        assert (made[0].ended, made[1].ended) == (1, 0)
        assert made[1].label.startswith("fit\\u001b")
    assert [bar.ended for bar in made] == [1, 1]


# --- workers ----------------------------------------------------------------------------------------------


def test_one_process_is_this_one() -> None:
    with executor_for(1) as executor:
        assert executor is None


def seen_by_a_worker() -> tuple[object, ...]:
    with warnings.catch_warnings(record=True) as heard:
        warnings.warn("nobody hears this", stacklevel=1)
    ear = signal.getsignal(signal.SIGINT)
    return os.getpid(), [os.environ[name] for name in THREADS], ear, len(heard), gc.get_threshold()[0]


def test_several_processes_are_spawned_and_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with one thread of BLAS, deaf to Ctrl-C and to warnings."""
    for name in THREADS:
        monkeypatch.setenv(name, "8")
    with executor_for(2) as pool:
        assert pool is not None
        number, *rest = pool.submit(seen_by_a_worker).result()
        own = [child for child in multiprocessing.active_children() if child.pid == number]
        last = pool.submit(time.sleep, 0.2)
    assert rest == [["1"] * 3, signal.SIG_IGN, 0, 50_000]
    assert last.done()
    assert [(type(child).__name__, child.exitcode) for child in own] == [("SpawnProcess", 0)]


@pytest.mark.parametrize("error", rest_slow([KeyboardInterrupt, ValueError]))
def test_after_an_error_nobody_waits_for_workers(error: type[BaseException]) -> None:
    host = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(600,))
    host.start()
    with pytest.raises(error), executor_for(2) as pool:
        assert pool is not None
        *_, last = [pool.submit(time.sleep, 30) for _ in range(9)]
        own = {child for child in multiprocessing.active_children() if child.pid != host.pid}
        raise error
    until = time.monotonic() + 60
    while None in (codes := {child.exitcode for child in own}) and time.monotonic() < until:
        time.sleep(0.01)  # the pool's own thread asks, too, and what the system tells it is here a moment later
    assert codes == {-signal.SIGKILL}
    with pytest.raises(CancelledError):
        last.result(60)
    assert host.is_alive()
    host.kill()
    host.join()


def test_a_worker_leaves_with_its_parent() -> None:
    """Which says nothing any more; what they print to has an end when both have gone."""
    work = "import os; from barpc.verbs.workers import executor_for\nwith executor_for(2) as pool:\n "
    work += "print(pool.submit(os.getpid).result(), flush=True); os.kill(os.getpid(), 9)"
    found = subprocess.run([sys.executable, "-c", work], stdout=subprocess.PIPE, timeout=60)
    assert (found.returncode, found.stdout.strip().isdigit()) == (-signal.SIGKILL, True)


def test_a_cluster_needs_its_package_and_an_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"-j tcp://a:1: an address needs the extra"), executor_for("tcp://a:1"):
        pass
    asked, closed = list[tuple[str, float]](), list[bool]()

    class Client:
        def __init__(self, address: str, timeout: float) -> None:
            asked.append((address, timeout))
            if "no" in address:
                raise OSError("refused")

        def __enter__(self) -> None:
            pass

        def __exit__(self, *_: object) -> None:
            closed.append(True)

        def get_executor(self) -> str:
            return "executor"

    monkeypatch.setitem(sys.modules, "distributed", SimpleNamespace(Client=Client))
    with pytest.raises(InputError, match=r"no scheduler answers there \(refused\)"), executor_for("tcp://no:1"):
        pass
    with executor_for("tcp://yes:1") as executor:
        assert (executor, closed) == ("executor", [])
    assert closed == [True]
    assert asked == [("tcp://no:1", 20), ("tcp://yes:1", 20)]
