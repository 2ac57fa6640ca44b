"""Kill a run at a random moment, give the same command again, compare every byte; as often as asked.

::

    python -m tests.reliability.trials 50 --seed 1 --jobs 1
    python -m tests.reliability.trials --every-output 1        (kill between any two outputs, of every verb)
    python -m tests.reliability.trials 20 --of-runs            (kill at random, commands that take a finished run)

Everything is imported once; each run is a fork of this process, which itself never works on an image.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
import warnings
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.windows import Window

import barpc.cli.adjust  # (imported before the forks)
import barpc.cli.terminal
import barpc.dsm.surface
import barpc.pipeline.calibrate
import barpc.verbs.orthoimages  # noqa: F401
from barpc.cli import main as barpc_main
from barpc.workspace import code_version
from tests.geotiffs import write_image

SAMPLES = sorted((Path(__file__).resolve().parents[2] / "data_samples").glob("*.tif"))
SIDE = 160  # px of a crop: a third of a second a run


def crop(source: Path, target: Path, side: int = SIDE, start: int = 300) -> Path:
    """A corner of a sample with its exact RPC."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(source) as image:
            pixels, rpcs = image.read(1, window=Window(start, start, side, side)), image.rpcs
        rpcs.samp_off -= start
        rpcs.line_off -= start
    return write_image(target, pixels, rpcs=rpcs)


def outputs(folder: Path) -> dict[str, bytes]:
    """The final files of a run by name: all but states, and folders of files on their way."""
    names = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()}
    own = {name: path for name, path in names.items() if "/.barpc" not in f"/{name}"}
    return {name: path.read_bytes() for name, path in own.items()}


def start(command: list[str], log: Path) -> int:
    """Fork, and run a command in the child; its process id."""
    pid = os.fork()
    if pid:
        return pid
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    code = 99
    try:
        barpc_main(command)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 98
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def finish(pid: int) -> int:
    """Exit code of a child; -9 when it was killed."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def sweep(trials: int, seed: int, jobs: int, folder: Path) -> dict[str, object]:
    """Kill so many runs; how many came out identical, and what was found on the way."""
    rng = np.random.default_rng(seed)
    code_version()
    images = [crop(path, folder / path.name) for path in SAMPLES[:2]]
    before = [sha256(path.read_bytes()).digest() for path in images]
    out, log = folder / "out", folder / "log.txt"
    command = ["-q", "adjust", *map(str, images), "-o", str(out), "-j", str(jobs)]
    command += ["--grids"]
    began = time.monotonic()
    code = finish(start(command, log))
    seconds = time.monotonic() - began
    if code:
        raise SystemExit(f"the undisturbed run ended with {code}: {log.read_text()}")
    truth = outputs(out)
    identical = killed = leftovers = resumed = 0
    odd: set[str] = set()
    for _ in range(trials):
        shutil.rmtree(out)
        pid = start(command, log)
        time.sleep(rng.uniform(0.0, seconds))
        os.kill(pid, signal.SIGKILL)
        if finish(pid) == -signal.SIGKILL:
            killed += 1
        else:  # the machine is less busy than when the first run was timed
            seconds *= 0.7
        leftovers += any(out.glob(".barpc/partial/*/*"))
        resumed += len(list(out.glob(".barpc/cache/*/*.npz"))) > 0
        again = finish(start(command, log))  # 1: it had been finished, and is not written over
        state = json.loads((out / ".barpc/state.json").read_text())["status"]
        clean = not any(out.glob(".barpc/partial/*/*"))
        found = outputs(out)
        right = {f"exit code {again}": again in (0, 1), f"state {state}": state == "done", "partial files": clean}
        right |= {name: found.get(name) == truth.get(name) for name in found | truth}
        identical += all(right.values())
        odd |= {what for what, is_so in right.items() if not is_so}
    unchanged = [sha256(path.read_bytes()).digest() for path in images] == before
    return {
        "trials": trials,
        "identical": identical,
        "odd": sorted(odd),
        "killed_at_work": killed,
        "resumed_from_kept_results": resumed,
        "left_partial_files": leftovers,
        "inputs_unchanged": unchanged,
        "seconds_of_a_run": round(seconds, 2),
    }


def killed_at(number: int, command: list[str], log: Path) -> int:
    """Run a command that is killed when it is about to rename a file for the `number`-th time, caches apart."""
    rename, seen = Path.replace, 0

    def counted(self: Path, target: Path) -> Path:
        nonlocal seen
        seen += "cache" not in Path(target).parts
        if seen == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return rename(self, target)

    Path.replace = counted  # type: ignore[method-assign]  # (the child's is a copy)
    try:
        return finish(start(command, log))
    finally:
        Path.replace = rename  # type: ignore[method-assign]


def boundaries(command: list[str], before: Path, folder: Path, step: int = 1) -> dict[str, int]:
    """Kill a command between any two outputs, and give it again: how often, and how often all was as it should.

    Parameters
    ----------
    command : list of str
        A verb that writes into ``folder/out``.
    before : Path
        What is in that folder when the command starts: caches, or a finished run.
    folder : Path
        Where to work.
    step : int
        Kill at every so many.
    """
    out, log = folder / "out", folder / "log.txt"
    shutil.copytree(before, out)
    if code := finish(start(command, log)):
        raise SystemExit(f"the undisturbed run ended with {code}: {log.read_text()}")
    truth = outputs(out)
    killed = identical = 0
    for number in range(1, 1000, step):
        shutil.rmtree(out)
        shutil.copytree(before, out)
        if killed_at(number, command, log) != -signal.SIGKILL:
            break
        killed += 1
        again = finish(start(command, log))
        state = json.loads((out / ".barpc/state.json").read_text())["status"]
        identical += again == 0 and state == "done" and outputs(out) == truth
    return {"killed": killed, "identical": identical, "outputs": len(truth)}


def at_every_output(step: int, folder: Path) -> dict[str, dict[str, int]]:
    """`boundaries` of every verb that writes into a folder."""
    images = [str(crop(path, folder / path.name)) for path in SAMPLES[:2]]
    first, cached, empty = folder / "first", folder / "cached", folder / "empty"
    adjust = ["-q", "adjust", *images]
    if code := finish(start([*adjust, "-o", str(first), "--rpc-format", "txt,geom"], folder / "log.txt")):
        raise SystemExit(f"the undisturbed run ended with {code}: {(folder / 'log.txt').read_text()}")
    shutil.copytree(first / ".barpc/cache", cached / ".barpc/cache")
    empty.mkdir()
    commands = {
        "adjust": ([*adjust, "--rpc-format", "txt,rpb,geom,json,xml"], cached),
        "adjust --images copy": ([*adjust, "--images", "copy"], cached),
        "adjust --overwrite": ([*adjust, "--overwrite", "--model", "translation"], first),
        "match": (["-q", "match", *images], cached),
        "convert": (["-q", "convert", *images, "--rpc", str(first)], empty),
    }
    found = {}
    for name, (command, before) in commands.items():
        (place := folder / name).mkdir()
        found[name] = boundaries([*command, "-o", str(place / "out")], before, place, step)
    return found


def of_runs(trials: int, seed: int, folder: Path) -> dict[str, dict[str, Any]]:
    """Kill commands that take finished runs at random, and give them again: how often, and how often all was right."""
    from tests.pipeline import test_calibrate as sensor  # a scene that gives a calibration

    (before := folder / "before").mkdir()
    images = [str(crop(path, before / path.name, side=260)) for path in SAMPLES]
    run, place, log = ["-q", "adjust", *images[:2], "-o", str(before / "run")], folder / "place", folder / "log.txt"
    if code := finish(start(run, log)):
        raise SystemExit(f"the first run ended with {code}: {log.read_text()}")
    if not (pid := os.fork()):
        rng, line = np.random.default_rng(5), sensor.Sensor.made("polynomials", 3, chips=4, size=sensor.SIZE)
        for number in range(sensor.RUNS):
            made = sensor.scene(sensor.any_looks(3, rng), line, rng, 300, size=sensor.SIZE)
            sensor.run(sensor.files(made, before / f"scene{number}"))
        os._exit(0)
    if code := finish(pid):
        raise SystemExit(f"the scenes of a sensor ended with {code}")
    added = ["adjust", str(place / Path(images[2]).name), "--add-to", str(place / "run"), "-o", str(place / "added")]
    runs = [str(place / f"scene{number}/adjusted") for number in range(sensor.RUNS)]
    commands = {
        "add-to": added,
        "update": [*added, "--update"],
        "ortho": ["ortho", str(place / "run"), "-o", str(place / "ortho")],
        "dsm": ["dsm", str(place / "run"), "-o", str(place / "dsm.tif")],
        "dsm in its run": ["dsm", str(place / "run"), "-o", str(place / "run/dsm.tif")],
        "calibrate": ["calibrate", *runs, "-o", str(place / "s.cal")],
    }
    rng, found = np.random.default_rng(seed), {}
    for name, words in commands.items():
        command = ["-q", *words]
        shutil.copytree(before, place)
        began = time.monotonic()
        if (code := finish(start(command, log))) not in (0, 3):
            raise SystemExit(f"{name}, undisturbed, ended with {code}: {log.read_text()}")
        seconds, truth = time.monotonic() - began, outputs(place)
        killed = identical = 0
        odd: set[str] = set()
        for _ in range(trials):
            shutil.rmtree(place)
            shutil.copytree(before, place)
            pid = start(command, log)
            time.sleep(rng.uniform(0.0, seconds))
            os.kill(pid, signal.SIGKILL)
            cut = finish(pid) == -signal.SIGKILL
            killed += cut
            again = finish(start(command, log))  # 1: it had been finished, and is not written over
            made = outputs(place)
            odd |= {one for one in made | truth if made.get(one) != truth.get(one)}
            odd |= {f"exit code {again}"} - ({"exit code 0", "exit code 1", "exit code 3"} if cut else {"exit code 1"})
            identical += made == truth
        shutil.rmtree(place)
        found[name] = {"trials": trials, "killed": killed, "identical": identical, "odd": sorted(odd)}
    return found


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trials", type=int, nargs="?", default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1, help="worker processes of the killed runs")
    parser.add_argument("--every-output", type=int, metavar="STEP", help="kill at every STEP-th output instead")
    parser.add_argument("--of-runs", action="store_true", help="kill commands that take finished runs instead")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if given.every_output:
            found = at_every_output(given.every_output, Path(folder))
            print(json.dumps(found))
            sys.exit(any(one["identical"] < one["killed"] for one in found.values()))
        if given.of_runs:
            found = of_runs(given.trials, given.seed, Path(folder))
            print(json.dumps(found))
            sys.exit(any(one["odd"] for one in found.values()))
        told = sweep(given.trials, given.seed, given.jobs, Path(folder))
        print(json.dumps(told))
        sys.exit(bool(told["odd"]) or not told["inputs_unchanged"])


if __name__ == "__main__":
    main()
