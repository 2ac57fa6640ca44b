"""The whole of `barpc adjust`, from nothing: CPU seconds of every stage, in turns against other checkouts.

    python benchmarks/whole.py IMG IMG [IMG...] [--against FOLDER] [--turns 7] [-- OPTION...]

Each turn is a process of its own with an output folder of its own, so that nothing is kept from one to the next; user
and system time, one thread, the median of the turns after a first one; sources are compiled before, as installing does.
"start" is what no stage counts: the interpreter, imports, the end. Other tools that read RPCs, which a development
environment has, are hidden: to import them takes longer than to verify with them. "floor" is a process that imports
numpy, scipy, OpenCV and rasterio, as far as they are used, and ends. After "whole": verbs that read the run, and the
shortest command of all.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PEERS = ("boto3", "rpcm", "shareloc", "orthority")
FLOOR = "import cv2, numpy, rasterio, scipy.linalg, scipy.optimize, scipy.sparse.csgraph, scipy.spatial"
READING = {
    "--version": ["--version"],
    "verify": ["verify", "out"],
    "report": ["report", "out"],
    "two reports": ["report", "out", "out"],
    "export": ["export", "out", "s2p", "--to", "s2p"],
}
RUN = "from barpc.cli import main; main()"
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def as_installed(checkout: Path, compiled: Path) -> dict[str, str]:
    """The environment of a process, and of its workers, that runs a checkout as if installed alone: its sources are
    compiled once, into a folder, and other tools that read RPCs are hidden.
    """
    hidden = compiled / "hidden"
    for name in PEERS:
        hidden.mkdir(parents=True, exist_ok=True)
        (hidden / f"{name}.py").write_text("raise ImportError\n")
    found = {"PYTHONPATH": f"{checkout}{os.pathsep}{hidden}", "PYTHONDONTWRITEBYTECODE": ""}
    environment = os.environ | THREADS | found | {"PYTHONPYCACHEPREFIX": str(compiled)}
    subprocess.run([sys.executable, "-m", "compileall", "-q", str(checkout / "barpc")], check=True, env=environment)
    return environment


def turn(environment: dict[str, str], arguments: list[str]) -> dict[str, float]:
    """CPU seconds of one run by stage, "start" and "whole"."""
    with tempfile.TemporaryDirectory() as folder:
        given = [
            os.path.relpath(text, folder) if Path(text).is_absolute() else text for text in arguments
        ]  # as users do
        command = [sys.executable, "-c", RUN, "-q", "adjust", *given, "-o", "out"]
        floor = cpu([sys.executable, "-c", FLOOR], environment, folder)
        whole = cpu(command, environment, folder)
        state = json.loads(Path(folder, "out", ".barpc", "state.json").read_text())
        reading = {
            name: cpu([sys.executable, "-c", RUN, "-q", *words], environment, folder) for name, words in READING.items()
        }
    stages = {entry["stage"]: entry["cpu_seconds"] for entry in state["stages"]}
    return {"floor": floor, "start": whole - sum(stages.values()), **stages, "whole": whole, **reading}


def cpu(command: list[str], environment: dict[str, str], folder: str) -> float:
    """CPU seconds of a process."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, env=environment, cwd=folder, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arguments", nargs="+", metavar="IMG", help="images and options of `barpc adjust`")
    parser.add_argument("--against", type=Path, action="append", default=[], metavar="FOLDER")
    parser.add_argument("--turns", type=int, default=7)
    given = parser.parse_args()
    checkouts = [*(folder.resolve() for folder in given.against), ROOT]
    arguments = [str(Path(text).resolve()) if Path(text).exists() else text for text in given.arguments]
    found: dict[Path, list[dict[str, float]]] = {checkout: [] for checkout in checkouts}
    with tempfile.TemporaryDirectory() as compiled:
        environments = {
            checkout: as_installed(checkout, Path(compiled, str(n))) for n, checkout in enumerate(checkouts)
        }
        for number in range(given.turns + 1):
            for checkout in checkouts:
                one = turn(environments[checkout], arguments)
                if number:
                    found[checkout].append(one)
    stages = dict.fromkeys(stage for turns in found.values() for one in turns for stage in one)
    print(f"CPU s, median of {given.turns} turns" + ", the last column this checkout" * (len(checkouts) > 1))
    last = ["whole", *READING]
    for stage in sorted(stages, key=lambda stage: last.index(stage) + 1 if stage in last else 0):
        medians = [statistics.median(one.get(stage, 0.0) for one in found[c]) for c in checkouts]
        ratio = f"   x {medians[-1] / medians[0]:.2f}" if len(medians) > 1 and medians[0] > 0 else ""
        print(f"  {stage:14s}" + "".join(f"{seconds:8.3f}" for seconds in medians) + ratio)
    return 0


if __name__ == "__main__":
    sys.exit(main())
