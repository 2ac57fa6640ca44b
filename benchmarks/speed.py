"""Run the benchmarks beside their peers and write docs/speed.md.

Each is a script of this folder that measures barpc and its peer in turns, in one run; this one collects what they
print. Peers that are not given are left out. Options name site-packages folders or interpreters of other environments.

python benchmarks/speed.py --data DATA --peers PYTHON --rpcfit SITE_PACKAGES --write
"""

# ruff: noqa: E402  (the path comes first)

from __future__ import annotations

import argparse
import os
import platform
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from barpc import __version__

THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

FIRST = "ad47de3"
"""The commit of release 0.1."""

HEAD = """# Speed

<!-- Written by benchmarks/speed.py --write. Do not edit. -->

What the scripts in `benchmarks/` printed in one run, barpc and each peer in turns, one thread, CPU seconds (not the
clock): {machine}. {versions}.
Load {load:.1f} on {cores} cores: take the ratios.

`python benchmarks/speed.py --data DATA --peers PYTHON --rpcfit SITE_PACKAGES --write` makes this page again.
"""


@dataclass(frozen=True)
class Benchmark:
    """A script, what it is about, and its arguments."""

    script: str
    title: str
    arguments: tuple[str, ...] = ()
    page: str = ""


def benchmarks(data: Path | None, peers: str | None, rpcfit: str | None, cars: str | None) -> list[Benchmark]:
    """What is run with what is given."""
    chosen = [
        Benchmark("kernels.py", "Kernels of the RPC", given("--python", peers), "rpc.md"),
        Benchmark("ba.py", "Bundle adjustment, beside scipy with finite differences", (), "adjustment.md"),
        Benchmark("ba.py", "The same, plain, beside Ceres", ("--ceres",), "adjustment.md"),
        Benchmark("ba.py", "With defaults, beside release 0.1", ("--against", FIRST), "adjustment.md"),
        Benchmark("ba.py", "A jump, and views of one place", ("--jump", "--series", "1000"), "adjustment.md"),
        Benchmark("tail.py", "Whole runs, matches given, by the number of images", ("--totals",), "report.md"),
        Benchmark("simulate.py", "Simulation", (), "simulate.md"),
        Benchmark("report.py", "Summary, tables and report", ("--views", "3", "50"), "report.md"),
    ]
    if data is not None:
        images = sorted(str(path) for path in (data / "optical" / "phr_triplet_north").glob("*.tif"))
        fit = ("--data", str(data), "--only", "speed", *given("--rpcfit", rpcfit))
        chosen[1:1] = [
            Benchmark("fit.py", "Fitting an RPC", fit, "fit.md"),
            Benchmark("ties.py", "Tie points", (*images, *given("--cars", cars)), "tie_points.md"),
            Benchmark("whole.py", "The whole of an adjustment", tuple(images), "tie_points.md"),
        ]
    return chosen


def given(option: str, value: str | None) -> tuple[str, ...]:
    """An option and its value, where there is one."""
    return () if value is None else (option, value)


def section(benchmark: Benchmark) -> str:
    """Run a script; its output under a heading."""
    script = ROOT / "benchmarks" / benchmark.script
    command = [sys.executable, str(script), *benchmark.arguments]
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | THREADS, check=False)
    print(f"{benchmark.script}: {time.perf_counter() - start:.0f} s", file=sys.stderr)
    text = done.stdout.rstrip() if done.returncode == 0 else f"failed: {done.stderr.strip().splitlines()[-1]}"
    text = re.sub(r"(?:/[\w.+-]+)+/", "", text)  # folders of this machine say nothing
    source = f"`benchmarks/{benchmark.script}`; method: [{benchmark.page}]({benchmark.page})"
    return f"\n## {benchmark.title}\n\n{source}\n\n```text\n{text}\n```\n"


def machine() -> str:
    """Processor and system."""
    names = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    return f"{names[0] if names else platform.machine()}, {platform.system()}, Python {platform.python_version()}"


def main() -> None:
    """Run, then print or write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of real images and RPC files")
    parser.add_argument("--peers", metavar="PYTHON", help="interpreter that has rpcm and shareloc")
    parser.add_argument("--rpcfit", metavar="DIR", help="site-packages folder that holds rpcfit")
    parser.add_argument("--cars", metavar="PYTHON", help="interpreter that has cars")
    parser.add_argument("--only", metavar="SCRIPT", help="one of the scripts, printed")
    parser.add_argument("--write", action="store_true", help="write docs/speed.md")
    arguments = parser.parse_args()
    chosen = benchmarks(arguments.data, arguments.peers, arguments.rpcfit, arguments.cars)
    if arguments.only:
        chosen = [benchmark for benchmark in chosen if benchmark.script == arguments.only]
    names = ("numpy", "scipy", "opencv-python-headless", "rasterio")
    head = HEAD.format(
        machine=machine(),
        versions=", ".join([f"barpc {__version__}", *(f"{name} {version(name)}" for name in names)]),
        load=os.getloadavg()[0],
        cores=os.cpu_count(),
    )
    text = head + "".join(section(benchmark) for benchmark in chosen)
    if arguments.write:
        (ROOT / "docs" / "speed.md").write_text(text, encoding="utf-8")
    else:
        print(text, end="")


if __name__ == "__main__":
    main()
