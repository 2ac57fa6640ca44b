"""Everything but the matching, by the number of images: CPU seconds and memory of every stage of `barpc adjust`.

Simulated blocks as files: small images with simulated RPCs, and matches.npz given with --matches. Prints, for each
size, pairs, CPU seconds (whole process tree) and peak memory; then the CPU seconds of every stage and the share of
the run's time that stages account for; then the exponent of CPU seconds over images between the sizes.

    python benchmarks/tail.py --views 100 300 1000 --folder /somewhere
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from barpc.pointio.matches import write_matches
from barpc.rpcio.tiff import put_tag
from barpc.scene import View
from barpc.simulate import simulate_block

SIDE, GSD = 512, 20.0  # px, m: images of ten kilometres
LAYOUT = {"size": (SIDE, SIDE), "gsd": GSD, "attitude": 5e-5, "overlap": 0.1}
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Trial:
    """What a run cost: CPU seconds and wall of the process tree, peak memory [MB], and its summary."""

    cpu: float
    wall: float
    memory: float
    summary: dict
    page: float  # MB of report.html


def write_block(folder: Path, num_views: int, tracks: int) -> Path:
    """The files of a block; the list of its images."""
    listed = folder / "images.txt"
    if listed.exists():
        return listed
    folder.mkdir(parents=True)
    block = simulate_block(num_views, tracks * num_views, seed=1, num_checks=0, **LAYOUT)
    paths = [_write_image(folder, n, view) for n, view in enumerate(block.views)]
    write_matches(folder / "matches.npz", block.tracks, [view.name for view in block.views])
    listed.write_text("".join(f"{path}\n" for path in paths))
    return listed


def _write_image(folder: Path, number: int, view: View) -> Path:
    path = folder / f"{view.name}.tif"
    ramp = np.add.outer(np.arange(SIDE), np.arange(SIDE)) + number
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    profile = {"driver": "GTiff", "width": SIDE, "height": SIDE, "count": 1, "dtype": "uint16"}
    with rasterio.open(path, "w", compress="deflate", predictor=2, **profile) as image:
        image.write(ramp.astype(np.uint16), 1)
    put_tag(path, view.sensor)
    return path


def run(listed: Path, out: Path, jobs: int) -> Trial:
    """`barpc adjust` in a process of its own."""
    matches = listed.parent / "matches.npz"
    command = [sys.executable, "-m", "barpc", "-q", "adjust", "--image-list", listed, "--matches", matches]
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [str(word) for word in (*command, "--matches-only", "-o", out, "--overwrite", "-j", jobs)]
    done = subprocess.run(words, capture_output=True, text=True, env=os.environ | THREADS, check=False)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 3):
        raise SystemExit(done.stderr)
    cpu = sum(getattr(after, name) - getattr(before, name) for name in ("ru_utime", "ru_stime"))
    summary = json.loads((out / "summary.json").read_text())
    page = (out / "report.html").stat().st_size / 1e6 if (out / "report.html").exists() else 0.0
    return Trial(cpu, wall, after.ru_maxrss / 1e3, summary, page)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--views", type=int, nargs="+", default=[100, 300, 1000], help="images, ascending")
    parser.add_argument("--tracks", type=int, default=95, help="tracks an image")
    parser.add_argument("--jobs", type=int, default=1, help="worker processes")
    parser.add_argument("--folder", type=Path, help="where the files go and stay; default: a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        print(" images   tracks    pairs  CPU [s]  clock [s]  memory [MB]  report.html [MB]", flush=True)
        trials = {}
        for num in options.views:
            listed = write_block(folder / f"block_{num}", num, options.tracks)
            trials[num] = found = run(listed, folder / f"run_{num}", options.jobs)
            counts = f"{num:7d}  {found.summary['tracks']['num_tracks']:7d}  {len(found.summary['pairs']):7d}"
            print(
                f"{counts}  {found.cpu:7.1f}  {found.wall:9.1f}  {found.memory:11.0f}  {found.page:16.2f}",
                flush=True,
            )
    by_stage(trials)


def by_stage(trials: dict[int, Trial]) -> None:
    """CPU seconds of every stage, and the exponent between the smallest and the largest block."""
    sizes = list(trials)
    stages = list(dict.fromkeys(s["stage"] for trial in trials.values() for s in trial.summary["stages"]))
    print(f"\n{'CPU seconds':<24}" + "".join(f"{num:>10d}" for num in sizes) + "  exponent")
    rows = {name: [_seconds(trials[num], name) for num in sizes] for name in stages}
    rows["whole process"] = [trials[num].cpu for num in sizes]
    for name, row in rows.items():
        power = ""
        if len(sizes) > 1 and min(row[0], row[-1]) > 0:
            power = f"{np.log(row[-1] / row[0]) / np.log(sizes[-1] / sizes[0]):10.2f}"
        print(f"{name:<24}" + "".join(f"{value:10.2f}" for value in row) + power)
    shares = [sum(s["seconds"] for s in t.summary["stages"]) / t.wall for t in trials.values()]
    print(f"{'in stages, of the clock':<24}" + "".join(f"{share:10.1%}" for share in shares))


def _seconds(trial: Trial, stage: str) -> float:
    return sum(s["cpu_seconds"] for s in trial.summary["stages"] if s["stage"] == stage)


if __name__ == "__main__":
    main()
