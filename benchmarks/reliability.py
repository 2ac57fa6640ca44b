"""The longer sweeps behind docs/reliability.md: kills, damaged input, what a task costs on its way, memory.

    python benchmarks/reliability.py kill --trials 200 --jobs 1     # SIGKILL, the same command, same bytes
    python benchmarks/reliability.py fuzz --runs 1000000            # damaged files of every kind
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
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

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
        print(
            f"{name:22} one by one {alone:6.2f} ms, by CachingExecutor (result kept on disk) {cached:6.2f} ms"
        )

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
    verbs.add_parser("task")
    peak = verbs.add_parser("memory")
    peak.add_argument("images", nargs="+")
    peak.add_argument("--jobs", type=int, default=4)
    given = parser.parse_args()
    if given.verb == "kill":
        run_module("tests.reliability.trials", given.trials, "--jobs", given.jobs)
    elif given.verb == "fuzz":
        run_module("tests.fuzz", given.runs)
    elif given.verb == "task":
        cost_of_a_task()
    else:
        memory(given.images, given.jobs)


if __name__ == "__main__":
    main()
