"""Pairs whose grey values do not compare: what ties them, and how well their cameras agree afterwards.

    python benchmarks/seasons.py DATA                      the table (DATA: the folder of the shared test data)
    python benchmarks/seasons.py DATA --judge TOOL.py      judged by another program: TOOL IMAGE_A IMAGE_B TIES.csv
    python benchmarks/seasons.py DATA --seeds 1 --only winter
    python benchmarks/seasons.py DATA --only angles        rendered pairs alone, up to 60 degrees apart

The second image of a real pair is disguised (`tests/scenes/season.py`), and the pair adjusted. Judged on check points
of the pair as it was: the RMS distance from the epipolar lines [px], as delivered, after the adjustment of the pair as
it was (the floor), and of the disguised one. Tie points of rendered pairs are judged by what was rendered.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2  # noqa: E402  (the thread counts come first)
import numpy as np  # noqa: E402
import rasterio  # noqa: E402

from barpc import simulate  # noqa: E402
from barpc.base.errors import BarpcError  # noqa: E402
from barpc.base.options import RunOptions, TieOptions  # noqa: E402
from barpc.pipeline import adjust  # noqa: E402
from barpc.rpcio import read_rpc  # noqa: E402
from barpc.scene import View  # noqa: E402
from barpc.sensor.rpc import altitude_range  # noqa: E402
from barpc.sensor.triangulation import epipolar_offset  # noqa: E402
from barpc.tie import find_tracks, match_pairs  # noqa: E402
from barpc.tie.matchers.features import join_keypoints  # noqa: E402
from barpc.tie.pairing.epipolar import epipolar_segments, robust_affine  # noqa: E402
from barpc.tie.patches.oriented import TEMPLATE_REACH, register_oriented  # noqa: E402
from barpc.tie.pixels import read_pixels  # noqa: E402
from tests.geotiffs import write_image  # noqa: E402
from tests.scenes import ImageOptions  # noqa: E402
from tests.scenes.redrawn import redrawn  # noqa: E402
from tests.scenes.season import SEASONS, _part, disguised  # noqa: E402
from tests.tie.conftest import Rendered  # noqa: E402
from tests.tie.stages import common_tracks, select_pairs  # noqa: E402

warnings.simplefilter("ignore")
TRIPLET = [("img_01", "img_02"), ("img_01", "img_03"), ("img_02", "img_03")]
Change = Callable[[np.ndarray, int], np.ndarray]


def covered(share: float) -> Change:
    """Clouds over a share of the image."""

    def change(pixels: np.ndarray, seed: int) -> np.ndarray:
        rng = np.random.default_rng([seed, 80])
        return np.where(_part(rng, pixels.shape, share, 60.0), 3000, pixels).astype(np.uint16)

    return change


def speckled(pixels: np.ndarray, seed: int) -> np.ndarray:
    """Classes of grey in other tones under the speckle of four looks: no radar image, but as noisy as one."""
    rng = np.random.default_rng([seed, 81])
    return (disguised(pixels, seed, 0.5, 0.0) * rng.gamma(4.0, 0.25, pixels.shape)).clip(1, 9e3).astype(np.uint16)


def banded(pixels: np.ndarray, seed: int) -> np.ndarray:
    """Classes of grey in other tones, a quarter of them turned over, as plants are in the near infrared."""
    return disguised(pixels, seed, 0.25, 0.0)


def season(level: str) -> Change:
    return lambda pixels, seed: disguised(pixels, seed, *SEASONS[level])


CASES: dict[str, tuple[Change, int]] = {level: (season(level), 1) for level in SEASONS}
CASES["redrawn"] = redrawn, 1
CASES |= {f"clouds {share:.0%}": (covered(share), 1) for share in (0.1, 0.4)}
CASES |= {"winter, x2 coarser": (season("winter"), 2), "as it was, x4 coarser": (lambda p, _: p, 4)}
CASES |= {"mild, x4 coarser": (season("mild"), 4), "4-look speckle": (speckled, 1)}
CASES |= {f"other band{words}": (banded, coarser) for words, coarser in (("", 1), (", x4 coarser", 4))}


def write(source: Path, target: Path, change: Change, seed: int, coarser: int) -> None:
    """An image disguised, perhaps averaged, with its RPC."""
    with rasterio.open(source) as file:
        pixels, rpcs = change(file.read(1), seed), file.rpcs
    height, width = (n // coarser for n in pixels.shape)
    pixels = pixels[: height * coarser, : width * coarser].astype(np.float32)
    pixels = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    for axis in ("line", "samp"):
        setattr(rpcs, f"{axis}_off", (getattr(rpcs, f"{axis}_off") + 0.5) / coarser - 0.5)
        setattr(rpcs, f"{axis}_scale", getattr(rpcs, f"{axis}_scale") / coarser)
    write_image(target, np.rint(pixels).astype(np.uint16), rpcs=rpcs)


def rms(a: Path, b: Path, ties: Path, coarser: int, judge: str | None, folder: Path) -> float:
    """RMS distance of check points from the epipolar lines [px of the second image as it was]."""
    table = np.genfromtxt(ties, delimiter=",", names=True)
    xy = [np.stack([table[f"col_{k}"], table[f"row_{k}"]], axis=1) for k in "ab"]
    xy[1] = (xy[1] + 0.5) / coarser - 0.5
    if judge is None:
        rpcs = read_rpc(a), read_rpc(b)
        offset, _ = epipolar_offset(*rpcs, *xy, np.full(len(xy[0]), rpcs[0].ground_offset[2]))
        return coarser * float(np.sqrt((offset**2).mean()))
    scaled = folder / "ties.csv"
    np.savetxt(scaled, np.hstack(xy), "%.4f", ",", header="col_a,row_a,col_b,row_b", comments="")
    done = subprocess.run([sys.executable, judge, a, b, scaled], capture_output=True, text=True, check=True)
    return coarser * float(json.loads(done.stdout)["rms"])


def adjusted(images: list[Path], out: Path, ties: Path, coarser: int, judge: str | None) -> tuple[float, str]:
    """RMS after the adjustment, and what tied the pair in how many CPU seconds."""
    start = time.process_time()
    try:
        result = adjust(images, out, RunOptions(overwrite=True))
    except BarpcError as error:
        return float("nan"), " ".join(str(error).split())[:70]
    seconds = time.process_time() - start
    after = [Path(out) / f"{path.stem}.vrt" for path in images]
    pair = result.summary["pairs"][0]
    kind, report = pair["matching"]["matcher"], pair["matching"]
    kind += ", loosened" * report["loosened"]
    words = f"{kind}: {pair['num_matches']} tracks, decoys {report['control_share']:.3f}, {seconds:.1f} s"
    return rms(after[0], after[1], ties, coarser, judge, out), words


def table(data: Path, seeds: int, only: str, judge: str | None) -> None:
    """All cases over all pairs and seeds."""
    print("| case | pair | seed | delivered | floor | after | tied by |\n|---|---|---|---|---|---|---|")
    folder = data / "optical/phr_triplet_north"
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        for first, second in TRIPLET:
            ties = data / f"truth/ties/phr_triplet_north__{first}__{second}__ncc_check.csv"
            paths = [folder / f"{first}.tif", folder / f"{second}.tif"]
            delivered = rms(*paths, ties, 1, judge, work)
            floor, _ = adjusted(paths, work / "clean", ties, 1, judge)
            for case, (change, coarser) in CASES.items():
                if only not in case:
                    continue
                for seed in range(seeds):
                    other = work / f"{second}_x.tif"
                    write(paths[1], other, change, seed, coarser)
                    after, words = adjusted([paths[0], other], work / "out", ties, coarser, judge)
                    figures = f"{delivered:.3f} | {floor:.3f} | {after:.3f}"
                    print(f"| {case} | {first[-1]}-{second[-1]} | {seed} | {figures} | {words} |", flush=True)


def sentinel2(data: Path) -> None:
    """Two dates on one grid, through one camera: matches of a regular grid about their common affine."""
    rpc = read_rpc(data / "optical/phr_triplet_north/img_01.tif")
    views = [
        View(path.stem, str(path), (1200, 1200), rpc, altitude_range(rpc))
        for path in sorted((data / "optical/s2_two_dates").glob("*.tif"))
    ]
    options = TieOptions(matcher="structure")
    found, report = match_pairs(views, [join_keypoints([])] * 2, select_pairs(views, options), options)[0]
    at, shift = found.xy[:, 0], found.xy[:, 1] - found.xy[:, 0]
    common = [robust_affine(at, shift[:, k]) for k in (0, 1)]
    grid = np.stack(np.meshgrid(*[np.arange(40.0, 1160.0, 40.0)] * 2), axis=-1).reshape(-1, 2)
    start = grid + np.stack([fit(grid) for fit in common], axis=1)
    files = [(view.path, view.size) for view in views]
    xy, ok, _ = register_oriented(files, 1, grid, start, np.broadcast_to(np.eye(2), (len(grid), 2, 2)))
    fine = [robust_affine(grid[ok], (xy - grid)[ok, k]) for k in (0, 1)]
    rest = np.hypot(*((xy - grid)[:, k] - fit(grid) for k, fit in enumerate(fine)))
    print(f"Sentinel-2: {report.status}, {len(found)} matches, shift {np.median(shift, axis=0).round(2)} px;")
    for name, asked in ("all", np.ones(len(grid), dtype=bool)), ("that show ground", ground(files, grid)):
        good = ok & asked
        print(
            f"of {asked.sum()} places of a grid ({name}) {good.sum() / asked.sum():.1%} are found, "
            f"{(rest[good] < 1).mean():.1%} of these within 1 px of their common affine, "
            f"median {np.median(rest[good]):.2f} px"
        )
    print()


def ground(files: list[tuple[str, tuple[int, int]]], at: np.ndarray) -> np.ndarray:
    """Places about which both dates have data, and the first one, which has clouds, is not far brighter than usual."""
    images = [read_pixels(path, (0, 0, *size), 1) for path, size in files]
    data = images[0][1] & images[1][1]
    grey = images[0][0]
    white = data & (grey > 1.8 * np.percentile(grey[images[0][1]], 80))
    col, row = at.astype(int).T
    share = [cv2.blur(one.astype(np.float32), (2 * TEMPLATE_REACH + 1,) * 2)[row, col] for one in (data, white)]
    return (share[0] > 0.9) & (share[1] < 0.05)


def angles(seeds: int) -> None:
    """Tie points of rendered pairs against what was rendered, the second image disguised."""
    print("| rays apart [deg] | case | seed | tracks | across, along [px] | more than 1, 2 px off across | tied by |")
    print("|---|---|---|---|---|---|---|")
    for apart, seed in itertools.product((15, 30, 45, 58), range(seeds)):
        simulate.PITCH = 0.5 * apart
        with tempfile.TemporaryDirectory() as name:
            scene = Rendered(Path(name), ImageOptions(views=2, size=(700, 700), seed=seed))
            first, second = scene.views
            pixels, _ = read_pixels(second.path, (0, 0, *second.size), 1)
            for case, level in SEASONS.items():
                path = write_image(Path(name) / "other.tif", disguised(pixels, seed, *level))
                start = f"| {apart} | {case} | {seed} |"
                try:
                    found = find_tracks((first, replace(second, path=str(path))))
                except BarpcError as error:
                    print(f"{start} {' '.join(str(error).split())[:90]} |", flush=True)
                    continue
                errors = scene.errors(0, 1, *common_tracks(found.tracks, 0, 1))
                errors = np.abs(epipolar_segments(first, second, np.array([[350.0, 350.0]])).turn(errors))[:, ::-1]
                spread, report = 1.4826 * np.median(errors, axis=0), found.pairs[0]
                off = [f"{(errors[:, 0] > most).mean():.3f}" for most in (1.0, 2.0)]
                kind = report.matcher + ", loosened" * report.loosened
                print(
                    f"{start} {len(errors)} | {spread[0]:.2f}, {spread[1]:.2f} | {', '.join(off)} | {kind} |",
                    flush=True,
                )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("--judge", metavar="TOOL", help="program that prints JSON with rms")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", default="", help="cases with this in their name")
    given = parser.parse_args()
    if not given.only:
        sentinel2(given.data)
    if given.only in "angles":
        angles(given.seeds)
    table(given.data, given.seeds, given.only, given.judge)


if __name__ == "__main__":
    main()
