"""Whole runs by the number of images: CPU seconds and memory of every stage of `barpc adjust`.

Simulated blocks as files: small images with simulated RPCs, and matches.npz given with --matches, so that everything
but the matching is measured; or small images of one ground, which are matched; or large blank ones, whose matches
given are verified and looked for in the pixels (--matches alone). Prints, for each size, pairs, CPU
seconds (whole process tree) and peak memory; then the CPU seconds of every stage and the share of the run's time that
stages account for; then the exponent of CPU seconds over images between the sizes. Of matched images it says, too,
what the exact tie points of the simulation are left with.

    python benchmarks/tail.py --views 100 300 1000 --folder /somewhere
    python benchmarks/tail.py --matching 192 --views 100 300 1000
    python benchmarks/tail.py --blank 20000 --views 250 --tracks 200
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # tests, where barpc is installed as a package

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline
from whole import ROOT, RUN, as_installed

from barpc.base.geodesy import metres_per_unit
from barpc.pointio.matches import write_matches
from barpc.rpcio import read_rpc
from barpc.rpcio.images import put_tag
from barpc.sensor.corrected import Corrected
from barpc.sensor.triangulation import triangulate
from barpc.simulate import simulate_block
from tests.geotiffs import write_blank, write_image
from tests.pointio.stages import read_matches

SIDE, GSD = 512, 20.0  # px, m: images of ten kilometres
LAYOUT = {"size": (SIDE, SIDE), "gsd": GSD, "attitude": 5e-5, "overlap": 0.1}
PICTURES = {"gsd": 2.0, "overlap": 0.5, "alt_range": (0.0, 60.0)}  # to be matched
PACKED = {"compress": "deflate", "predictor": 2}


@dataclass(frozen=True)
class Trial:
    """What a run cost: CPU seconds and wall of the process tree, peak memory [MB], and its summary."""

    cpu: float
    wall: float
    memory: float
    summary: dict
    page: float  # MB of report.html


def write_block(folder: Path, num_views: int, tracks: int, blank: int | None = None) -> Path:
    """The files of a block, or of one of so many blank pixels a side on the same ground; the list of its images."""
    listed = folder / "images.txt"
    if listed.exists():
        return listed
    folder.mkdir(parents=True)
    layout = LAYOUT if blank is None else LAYOUT | {"size": (blank, blank), "gsd": GSD * SIDE / blank}
    block = simulate_block(num_views, tracks * num_views, seed=1, num_checks=0, **layout)
    ramp = np.add.outer(np.arange(SIDE), np.arange(SIDE)).astype(np.uint16)
    paths = [folder / f"{view.name}.tif" for view in block.views]
    for n, (path, view) in enumerate(zip(paths, block.views, strict=True)):
        if blank is None:
            write_image(path, ramp + n, **PACKED)
        else:
            write_blank(path, (blank, blank), dtype="uint16", tiled=True)
        put_tag(path, view.sensor)
    write_matches(folder / "matches.npz", block.tracks, [view.name for view in block.views])
    listed.write_text("".join(f"{path.name}\n" for path in paths))
    return listed


def write_pictures(folder: Path, num_views: int, side: int) -> Path:
    """Images of one ground as the exact cameras of a block see it; the list of them."""
    listed = folder / "images.txt"
    if listed.exists():
        return listed
    folder.mkdir(parents=True)
    block = simulate_block(num_views, 20 * num_views, seed=1, num_checks=0, size=(side, side), **PICTURES)
    write_matches(folder / "exact.npz", block.tracks, [view.name for view in block.views])
    exact = [Corrected(view.sensor, c) for view, c in zip(block.views, block.truth.corrections, strict=True)]
    origin = block.truth.ground.min(axis=0) - (0.01, 0.01, 0.0)
    size = np.ceil((np.ptp(block.truth.ground, axis=0) + 0.02)[:2] * metres_per_unit(origin)[:2]).astype(int)
    ground = _texture(*size)
    paths = []
    for view, camera in zip(block.views, exact, strict=True):
        east, north = _seen(camera, side, origin).astype(np.float32)
        pixels = cv2.remap(ground, east, north, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        paths.append(write_image(folder / f"{view.name}.tif", pixels.astype(np.uint16), **PACKED))
        put_tag(paths[-1], view.sensor)
    listed.write_text("".join(f"{path.name}\n" for path in paths))
    return listed


def _texture(width: int, height: int) -> np.ndarray:
    """Brightness of every square metre: noise of several scales."""
    rng, out = np.random.default_rng(0), np.full((height, width), 500.0, dtype=np.float32)
    for step in (2, 4, 8, 16):
        coarse = rng.normal(0.0, 60.0, (height // step + 2, width // step + 2)).astype(np.float32)
        out += cv2.resize(coarse, None, fx=step, fy=step, interpolation=cv2.INTER_CUBIC)[:height, :width]
    return out.clip(1.0, 2000.0)


def _seen(camera: Corrected, side: int, origin: np.ndarray) -> np.ndarray:
    """Metres east and north (2, side, side) of an origin that every pixel shows, on waves of 20 m."""
    nodes = np.linspace(0, side - 1, 33)
    row, col = (axis.ravel() for axis in np.meshgrid(nodes, nodes, indexing="ij"))
    alt = np.zeros(len(row))
    for _ in range(3):  # lines of sight are steeper than the waves
        at = (camera.localize(np.column_stack([col, row]), alt) - origin)[:, :2] * metres_per_unit(origin)[:2]
        alt = 30.0 + 20.0 * np.sin(at[:, 0] / 150.0) * np.cos(at[:, 1] / 200.0)
    every = np.arange(side)
    splines = (RectBivariateSpline(nodes, nodes, axis.reshape(33, 33)) for axis in at.T)
    return np.stack([spline(every, every) for spline in splines])


def put_side_files(listed: Path, metadata: Path) -> None:
    """Lay a maker's metadata, without its RPC, beside every image of a list."""
    text = re.sub(r"<RPB>.*</RPB>", "", metadata.read_text(encoding="utf-8"), flags=re.DOTALL)
    for line in listed.read_text().splitlines():
        (listed.parent / line).with_suffix(".xml").write_text(text, encoding="utf-8")


def run(listed: Path, out: Path, jobs: int, only: bool, environment: dict[str, str]) -> Trial:
    """`barpc adjust` in a process of its own, and from nothing."""
    shutil.rmtree(out, ignore_errors=True)
    matches = listed.parent / "matches.npz"
    command = [sys.executable, "-c", RUN, "-q", "adjust", "--image-list", listed.name]
    command += ["--matches", matches.name, *["--matches-only"] * only] * matches.exists()
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [str(word) for word in (*command, "-o", out, "-j", jobs)]
    done = subprocess.run(words, capture_output=True, text=True, env=environment, cwd=listed.parent, check=False)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 3):
        raise SystemExit(done.stderr)
    cpu = sum(getattr(after, name) - getattr(before, name) for name in ("ru_utime", "ru_stime"))
    summary = json.loads((out / "summary.json").read_text())
    summary["stages"] = json.loads((out / ".barpc/state.json").read_text())["stages"]
    page = (out / "report.html").stat().st_size / 1e6 if (out / "report.html").exists() else 0.0
    return Trial(cpu, wall, after.ru_maxrss / 1e3, summary, page)


def left(listed: Path, out: Path) -> tuple[float, float]:
    """RMS [px] that the simulation's own tie points (0.1 px of noise) are left with by the cameras before and after."""
    images = [listed.parent / line for line in listed.read_text().splitlines()]
    tracks = read_matches(listed.parent / "exact.npz", [path.stem for path in images])
    found = []
    for files in (images, [out / f"{path.stem}_RPC.TXT" for path in images]):
        cameras = [read_rpc(path) for path in files]
        squares = triangulate(cameras, tracks.view, tracks.point, tracks.xy).residuals ** 2
        found.append(float(np.sqrt(np.nanmean(squares.sum(axis=1)))))
    return found[0], found[1]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, nargs="+", default=[100, 300, 1000], help="images, ascending")
    parser.add_argument("--tracks", type=int, default=95, help="tracks an image")
    parser.add_argument("--matching", type=int, metavar="SIDE", help="match images of so many pixels a side")
    parser.add_argument("--blank", type=int, metavar="SIDE", help="verify matches given of blank images of this side")
    parser.add_argument("--jobs", type=int, default=1, help="worker processes")
    parser.add_argument("--totals", action="store_true", help="no table of the stages")
    parser.add_argument("--side-files", type=Path, metavar="XML", help="Maxar's metadata to lie beside each image")
    parser.add_argument("--folder", type=Path, help="where the files go and stay; default: a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = (options.folder or Path(temporary)).resolve()
        print(" images   tracks    pairs  CPU [s]  clock [s]  memory [MB]  report.html [MB]", flush=True)
        trials, environment = {}, as_installed(ROOT, Path(temporary, "compiled"))
        for num in options.views:
            if options.matching is None:
                name = f"block_{num}" if options.blank is None else f"blank_{num}"
                listed = write_block(folder / name, num, options.tracks, options.blank)
            else:
                listed = write_pictures(folder / f"pictures_{num}", num, options.matching)
            if options.side_files:
                put_side_files(listed, options.side_files)
            out = folder / f"run_{listed.parent.name}"
            trials[num] = found = run(listed, out, options.jobs, options.blank is None, environment)
            if options.matching is not None:
                before, after = left(listed, out)
                print(f"{num} images: exact tie points are left with {before:.2f} -> {after:.3f} px", flush=True)
            counts = f"{num:7d}  {found.summary['tracks']['num_tracks']:7d}  {len(found.summary['pairs']):7d}"
            print(
                f"{counts}  {found.cpu:7.1f}  {found.wall:9.1f}  {found.memory:11.0f}  {found.page:16.2f}",
                flush=True,
            )
    if not options.totals:
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
