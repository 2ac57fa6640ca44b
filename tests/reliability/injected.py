"""Faults at single calls of the system: the n-th open, write, fsync, rename, read or recv of a run fails.

::

    python -m tests.reliability.injected --every 1           # each n of each call; 20: each twentieth

A run is a fork of this process, which has imported everything, and strace is attached to it before its first step: so
the calls of a run are counted from its beginning, those of the interpreter's start apart. strace makes the n-th of a
kind return an error in place of what it does. A first run without faults tells how many there are, and of which files.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from barpc.cli import main as barpc_main
from barpc.workspace import code_version

from .trials import SAMPLES, crop, outputs

CALLS = {
    "openat": "open",
    "write": "write",
    "writev": "write",
    "pwrite64": "write",
    "fsync": "fsync",
    "fdatasync": "fsync",
    "rename": "rename",
    "renameat2": "rename",
    "link": "rename",
    "mkdir": "mkdir",
    "read": "read",
    "pread64": "read",
    "recvfrom": "recv",
}
"""Call of Linux -> what it does, in the words of the tables."""
ERRORS = ("ENOSPC", "EIO", "EINTR")
_LINE = re.compile(r"^(\d+)\s+(\w+)\((.*)$")
_SHOWN, _NO_PICTURE = ("SHA256SUMS", "tables/pictures.json", "report.html"), "no picture"  # which is said, not refused
_CODES = (0, 1, 3)  # of a run that nobody interrupts (docs/reliability.md)
_ANYBODY, _PTRACER = ctypes.c_ulong(-1), 0x59616D61  # PR_SET_PTRACER: where only ancestors may trace
_GO = signal.SIGUSR1
_LONGEST = 60.0  # s: a run takes one


def missing() -> str | None:
    """Why no faults can be injected here."""
    if sys.platform != "linux" or shutil.which("strace") is None:
        return "no faults are injected: there is no strace here"
    done = subprocess.run(
        ["strace", "-f", "-o", os.devnull, "-e", "inject=fsync:error=EIO:when=1", "true"],
        capture_output=True,
        check=False,
        text=True,
    )
    return f"no faults are injected: strace says {done.stderr.strip()[:200]!r}" if done.returncode else None


@dataclass(frozen=True)
class Fault:
    """The `when`-th call of a name fails with an error."""

    call: str
    error: str
    when: int

    def __str__(self) -> str:
        return f"{self.call} {self.when} {self.error}"


@dataclass(frozen=True)
class Ended:
    """How a run ended: its exit code (None: it hung) and what it said."""

    code: int | None
    said: str


def run(command: Sequence[str], log: Path, *tracing: str) -> Ended:
    """Run a command in a fork, under strace with these arguments where there are any."""
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [_GO])
    try:
        pid = os.fork()
        if pid == 0:
            _child(command, log)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    tracer = _attach(pid, tracing) if tracing else None
    os.kill(pid, _GO)
    code = _finish(pid)
    if tracer is not None:
        tracer.wait()
        assert tracer.stderr is not None
        tracer.stderr.close()
    return Ended(code, log.read_text(errors="replace"))


def _child(command: Sequence[str], log: Path) -> None:
    code = 99
    try:
        ctypes.CDLL(None).prctl(_PTRACER, _ANYBODY, 0, 0, 0)
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")  # a test's may be no files
        logging.root.handlers.clear()
        signal.sigwait([_GO])  # none of the calls that are counted
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [_GO])
        barpc_main(list(command))
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 98
    except BaseException as error:  # noqa: BLE001  (the parent's code is not to be run twice)
        os.write(2, f"{error!r}\n".encode())
    finally:
        with suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _attach(pid: int, tracing: Sequence[str]) -> subprocess.Popen[str]:
    tracer = subprocess.Popen(["strace", "-f", "-p", str(pid), *tracing], stderr=subprocess.PIPE, text=True)
    assert tracer.stderr is not None
    said = tracer.stderr.readline()
    if "attached" not in said:
        os.kill(pid, signal.SIGKILL)
        raise RuntimeError(f"strace says {said!r}")
    return tracer


def _finish(pid: int) -> int | None:
    began = time.monotonic()
    while time.monotonic() - began < _LONGEST:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return None


def counted(command: Sequence[str], log: Path, places: Sequence[str]) -> tuple[Ended, dict[str, list[int]]]:
    """Run without faults; the ordinals of the calls that touch what has one of `places` in its name, by call.

    Ordinals count the calls of a name within its thread, as strace does when it injects.
    """
    trace = log.with_suffix(".trace")
    ended = run(command, log, "-y", "-s", "0", "-o", str(trace), "-e", f"trace={','.join(CALLS)}")
    seen: dict[tuple[str, str], int] = {}
    found: dict[str, list[int]] = {}
    for line in trace.read_text(errors="replace").splitlines():
        parsed = _LINE.match(line)
        if parsed and parsed[2] in CALLS:
            number = seen[parsed[1], parsed[2]] = seen.get((parsed[1], parsed[2]), 0) + 1
            if any(place in parsed[3] for place in places):
                found.setdefault(parsed[2], []).append(number)
    return ended, {call: sorted(set(numbers)) for call, numbers in found.items()}


def faults(calls: dict[str, list[int]], every: int, errors: Sequence[str] = ERRORS) -> Iterator[Fault]:
    """Every so many of the calls, each error beginning at another one; the first and the last of each always."""
    for call, numbers in calls.items():
        for k, error in enumerate(errors):
            chosen = {*numbers[k::every], numbers[0], numbers[-1]}
            yield from (Fault(call, error, number) for number in sorted(chosen))


@dataclass
class Scene:
    """A command, what it leaves when nothing fails, and where it may touch what."""

    command: list[str]
    out: Path
    log: Path
    inputs: list[Path]
    truth: dict[str, bytes]
    code: int
    calls: dict[str, list[int]]

    @classmethod
    def of(cls, command: Sequence[str], folder: Path, inputs: list[Path], *places: str) -> Scene:
        """Run once without faults. `places`: what else than the output folder and the inputs a fault may hit."""
        out, log = folder / "out", folder / "log.txt"
        code_version()  # every source file is read for it, once a process
        whole = [*command, "-o", str(out)]
        run(whole, log)  # what is compiled and kept once a machine
        shutil.rmtree(out)
        ended, calls = counted(whole, log, [str(out), *map(str, inputs), *places])
        if ended.code not in (0, 3):
            raise RuntimeError(f"the undisturbed run ended with {ended.code}: {ended.said}")
        scene = cls(whole, out, log, inputs, outputs(out), ended.code, calls)
        return scene

    def hashes(self) -> list[str]:
        """Of the inputs."""
        return [sha256(path.read_bytes()).hexdigest() for path in self.inputs]

    def meet(self, fault: Fault) -> str | None:
        """What went wrong beside the fault; None where all is as it should be."""
        shutil.rmtree(self.out, ignore_errors=True)
        before = self.hashes()
        inject = f"inject={fault.call}:error={fault.error}:when={fault.when}"
        ended = run(self.command, self.log, *("-o", os.devnull, "-e", f"trace={fault.call}", "-e", inject))
        if (odd := self._judged(ended)) is not None:
            return f"{odd}: {ended.said.strip()[-600:]}"
        if self.hashes() != before:
            return "an input was changed"
        for name, data in outputs(self.out).items() if self.out.is_dir() else ():
            if self.truth.get(name) != data and not (name in _SHOWN and _NO_PICTURE in ended.said):
                return f"{name} is not what it should be (exit {ended.code}: {ended.said.strip()[-300:]})"
        if ended.code == self.code:
            missing_ones = self.truth.keys() - outputs(self.out).keys()
            return f"says it is done, and lacks {sorted(missing_ones)}" if missing_ones else None
        again = run(self.command, self.log)
        if again.code != self.code:
            return f"the same command again ends with {again.code}: {again.said.strip()[-600:]}"
        if outputs(self.out) != self.truth:
            return "the same command again leaves other files"
        return None

    def _judged(self, ended: Ended) -> str | None:
        if ended.code is None:
            return "hangs"
        if ended.code not in _CODES:
            return f"exit code {ended.code}"
        if "Traceback" in ended.said or "this is a bug" in ended.said:
            return f"exit {ended.code} with no clear line"
        lines = ended.said.strip().splitlines()
        if ended.code == 1 and not (lines and lines[-1].startswith("barpc: ")):
            return "exit 1 without a line of its own"
        return None


# --- what is run ------------------------------------------------------------------------------------------


def _serve(folder: str, connection: Any) -> None:
    from tests.remote.conftest import Web

    web = Web(Path(folder))
    web.server.handle_error = lambda *_: None  # type: ignore[method-assign]  # runs that failed have hung up
    connection.send(web.host)
    with suppress(EOFError):  # whoever started it has gone
        connection.recv()


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The host of a web server in a process of its own, which no fork shares."""
    context = get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(str(folder), there), daemon=True)
    process.start()
    try:
        yield here.recv()
    finally:
        here.send(None)
        process.join()


@contextmanager
def scenes(folder: Path) -> Iterator[dict[str, Scene]]:
    """One small run with files of this machine, and one over http, whose calls are those of the network."""
    (folder / "in").mkdir()
    images = [crop(path, folder / "in" / path.name) for path in SAMPLES[:2]]
    for name in ("here", "http"):
        (folder / name).mkdir()
    here = Scene.of(["adjust", *map(str, images), "-j", "1"], folder / "here", images)
    with served(folder / "in") as host:
        urls = [f"{host}/{path.name}" for path in images]
        command = ["adjust", *urls, "--allow-remote", host, "--images", "none", "-j", "1"]
        http = Scene.of(command, folder / "http", [], "TCP:", "socket:")
        http.calls = {call: numbers for call, numbers in http.calls.items() if CALLS[call] == "recv"}
        yield {"here": here, "http": http}


def sweep(every: int, folder: Path, only: str = "") -> dict[str, Any]:
    """All scenes and faults: how many of each kind, and what was found."""
    counts: dict[str, int] = {}
    found: list[str] = []
    with scenes(folder) as all_scenes:
        for name, scene in all_scenes.items():
            for fault in faults(scene.calls, every):
                if only in f"{name} {fault}":
                    kind = f"{name} {CALLS[fault.call]}"
                    counts[kind] = counts.get(kind, 0) + 1
                    if (odd := scene.meet(fault)) is not None:
                        found.append(f"{name}: {fault}: {odd}")
                        print(found[-1], file=sys.stderr, flush=True)
    return {"faults": sum(counts.values()), "by_kind": counts, "found": found}


def main() -> int:
    """Parse, run, print; 1 where anything was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--every", type=int, default=5, help="each so many-th call of a kind")
    parser.add_argument("--only", default="", help="scenes, calls and errors with this in their name")
    given = parser.parse_args()
    if (why := missing()) is not None:
        print(why)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        result = sweep(given.every, Path(folder), given.only)
    print(json.dumps(result, indent=1))
    return 1 if result["found"] else 0


if __name__ == "__main__":
    sys.exit(main())
