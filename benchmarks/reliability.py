"""The longer sweeps behind docs/reliability.md: kills, faults, damaged input, what tasks and hashes cost, memory.

    python benchmarks/reliability.py kill --trials 200 --jobs 1     # SIGKILL, the same command, same bytes
    python benchmarks/reliability.py fuzz --runs 1000000            # damaged files of every kind
    python benchmarks/reliability.py faults --every 5               # the n-th open, write, ... fails (needs strace)
    python benchmarks/reliability.py identity                       # what knowing the inputs costs
    python benchmarks/reliability.py task                           # a task in a pool and over dask, by batch
    python benchmarks/reliability.py memory IMAGE IMAGE --jobs 4    # peak memory of a run with its workers

Under atheris, with coverage, the fuzzer runs as `python -m tests.fuzz --atheris FOLDER -atheris_runs=1000000`.
"""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]


def run_module(*args: object) -> None:
    """One of the tests' engines, as a command."""
    subprocess.run([sys.executable, "-m", *map(str, args)], check=True, cwd=ROOT)


def nothing(number: int) -> float:
    """A task that takes no time."""
    return float(number)


def cost_of_a_task() -> None:
    """Milliseconds a task takes on its way, handed in one by one and by CachingExecutor."""
    from barpc.pipeline.executor import CachingExecutor
    from barpc.workspace import Workspace

    def measure(name: str, pool: Executor, tasks: int) -> None:
        pool.submit(nothing, 0).result()
        began = time.perf_counter()
        for future in [pool.submit(nothing, n) for n in range(tasks)]:
            future.result()
        alone = 1e3 * (time.perf_counter() - began) / tasks
        with (
            tempfile.TemporaryDirectory() as folder,
            Workspace(Path(folder) / "run") as workspace,
            CachingExecutor(workspace, {}, pool) as caching,
        ):
            began = time.perf_counter()
            for future in [caching.submit(nothing, n) for n in range(tasks)]:
                future.result()
        cached = 1e3 * (time.perf_counter() - began) / tasks
        print(f"{name:22} one by one {alone:6.2f} ms, by CachingExecutor (result kept on disk) {cached:6.2f} ms")

    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        measure("process pool, 2", pool, 2000)
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        print("dask: not installed")
        return
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        measure("dask, 2 workers", client.get_executor(), 2000)


class Spent:
    """CPU seconds and calls of some functions."""

    def __init__(self) -> None:
        self.seconds, self.calls = 0.0, 0

    def timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, counted."""

        def wrapped(*args: object) -> Any:
            began = time.process_time()
            try:
                return function(*args)
            finally:
                self.seconds += time.process_time() - began
                self.calls += 1

        return wrapped


def identity_of_a_run(side: int = 1000) -> None:
    """What a whole run of three images spends on hashing its inputs, and on asking whether they are still the same."""
    import numpy as np
    import rasterio

    import barpc
    from barpc.base import identity
    from barpc.base.options import RunOptions
    from barpc.pipeline import inputs

    hashing, asking = Spent(), Spent()
    ask = asking.timed(identity.Input.ask)
    with tempfile.TemporaryDirectory() as folder:
        images = []
        for source in sorted((ROOT / "data_samples").glob("*.tif")):
            with rasterio.open(source) as image:
                pixels, rpcs = image.read(1), image.rpcs
            images.append(Path(folder) / source.name)
            shape = {"width": side, "height": side, "count": 1, "dtype": pixels.dtype, "rpcs": rpcs}
            with rasterio.open(images[-1], "w", driver="GTiff", **shape) as out:  # what is missing is black
                whole = np.zeros((side, side), pixels.dtype)
                whole[: pixels.shape[0], : pixels.shape[1]] = pixels[:side, :side]
                out.write(whole, 1)
        barpc.adjust(images, Path(folder) / "warm", RunOptions())
        with (
            mock.patch.object(inputs, "hashed", hashing.timed(inputs.hashed)),
            mock.patch.object(identity.Input, "ask", lambda one: ask(one)),
        ):
            began = time.process_time()
            barpc.adjust(images, Path(folder) / "out", RunOptions())
            seconds = time.process_time() - began
    print(
        f"a run of {len(images)} x {side**2 / 1e6:.1f} Mpx: {seconds:.2f} CPU s, of which hashing "
        f"{hashing.seconds:.4f} ({hashing.calls} files), {asking.calls} questions {asking.seconds:.4f}"
    )


def identity_of_sparse_images(count: int = 100, side: int = 4000) -> None:
    """What hashing costs of files that are nearly all holes, which read as zeros, beside reading their pixels."""
    import rasterio

    from barpc.rasters.raster import hashed

    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{number}.tif" for number in range(count)]
        shape = {"width": side, "height": side, "count": 1, "dtype": "uint16", "tiled": True}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with rasterio.open(Path(folder) / "whole.tif", "w", driver="GTiff", **shape):
                pass
        data = (Path(folder) / "whole.tif").read_bytes()
        for path in paths:
            with path.open("wb") as file:  # what is zero becomes a hole of the disk
                for start in range(0, len(data), 1 << 16):
                    if (part := data[start : start + (1 << 16)]).strip(b"\0"):
                        file.seek(start)
                        file.write(part)
                file.truncate(len(data))
        began = time.process_time()
        found = [hashed(path) for path in paths]
        hashing = time.process_time() - began
        began = time.process_time()
        for one in found:
            one.ask()
        asking = time.process_time() - began
        began = time.process_time()
        for path in paths:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with rasterio.open(path) as image:
                    image.read(1)
        reading = time.process_time() - began
        size = sum(path.stat().st_size for path in paths)
    print(
        f"{count} sparse images of {side} x {side} px, {size / 1e9:.1f} GB: hashing {hashing:.2f} CPU s, asking "
        f"{asking:.4f}, reading their pixels {reading:.2f}"
    )


def resident(pid: int) -> int:
    """Proportional set size [bytes] of a process and all that it has started: shared pages count once."""
    total = 0
    with contextlib.suppress(OSError, ValueError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                total += int(line.split()[1]) << 10
        for task in Path(f"/proc/{pid}/task").iterdir():
            total += sum(resident(int(child)) for child in (task / "children").read_text().split())
    return total


def memory(images: list[str], jobs: int) -> None:
    """Peak memory of `barpc adjust`, all its processes together."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "barpc", "adjust", *images, "-o", f"{folder}/out", "-j", str(jobs)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        began, most = time.monotonic(), 0
        while process.poll() is None:
            most = max(most, resident(process.pid))
            time.sleep(0.1)
    seconds = time.monotonic() - began
    print(f"exit {process.returncode}, {jobs} workers: {most / 1e9:.2f} GB at most, {seconds:.0f} s")


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    kill = verbs.add_parser("kill")
    kill.add_argument("--trials", type=int, default=200)
    kill.add_argument("--jobs", type=int, default=1)
    verbs.add_parser("fuzz").add_argument("--runs", type=int, default=1_000_000)
    verbs.add_parser("faults").add_argument("--every", type=int, default=5, help="each so many-th call of a kind")
    verbs.add_parser("identity")
    verbs.add_parser("task")
    peak = verbs.add_parser("memory")
    peak.add_argument("images", nargs="+")
    peak.add_argument("--jobs", type=int, default=4)
    given = parser.parse_args()
    if given.verb == "kill":
        run_module("tests.reliability.trials", given.trials, "--jobs", given.jobs)
    elif given.verb == "fuzz":
        run_module("tests.fuzz", given.runs)
    elif given.verb == "faults":
        run_module("tests.reliability.injected", "--every", given.every)
    elif given.verb == "identity":
        identity_of_a_run()
        identity_of_sparse_images()
    elif given.verb == "task":
        cost_of_a_task()
    else:
        memory(given.images, given.jobs)


if __name__ == "__main__":
    main()
