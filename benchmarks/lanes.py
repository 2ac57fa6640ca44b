"""CPU seconds of the tests, folder by folder: what a person waits for before a commit.

    python benchmarks/lanes.py                                # the fast tests: -m "not slow"
    python benchmarks/lanes.py -m "slow and not nightly" tests/ba tests/tie

Every folder is one process of pytest with one thread, with what it starts: its own start, a second or two, counts.
What is compiled is kept, as it is at a prompt: the first run of a fresh tree takes 10 CPU seconds more in all. Other
work on the machine lengthens CPU seconds, too, by half where it takes all cores.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOP = "tests/test_*.py"
NO_TESTS = 5  # pytest's exit code


def folders() -> list[str]:
    """The folders of tests, and the files beside them."""
    return [
        *(f"tests/{path.name}" for path in sorted((ROOT / "tests").iterdir()) if any(path.glob("test_*.py"))),
        TOP,
    ]


def cpu() -> float:
    """CPU seconds of all processes that were waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", help="all by default")
    parser.add_argument("-m", dest="lane", default="not slow", help="pytest's expression of markers")
    args = parser.parse_args()
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else every process compiles barpc and its tests anew
    total, failed = 0.0, []
    print(f"| {args.lane} | tests | CPU s | s |\n|---|---|---|---|", flush=True)
    for folder in args.folders or folders():
        paths = sorted(map(str, ROOT.glob(folder))) if "*" in folder else [folder]
        before, start = cpu(), time.monotonic()
        command = [sys.executable, "-m", "pytest", "-q", "-m", args.lane, "-p", "no:cacheprovider", *paths]
        found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        seconds, count = cpu() - before, re.findall(r"(\d+) passed", found.stdout)
        total += seconds
        print(
            f"| {folder} | {(count or ['0'])[-1]} | {seconds:.1f} | {time.monotonic() - start:.0f} |",
            flush=True,
        )
        if found.returncode not in (0, NO_TESTS):
            failed.append(folder)
            print(found.stdout[-2000:], file=sys.stderr)
    print(f"| all | | {total:.0f} | |")
    if failed:
        raise SystemExit(f"failed: {' '.join(failed)}")


if __name__ == "__main__":
    main()
