"""Blocks whose images are a texture resampled by exact cameras: what is left of their errors, and what is said.

A third kind of generator beside `tests.scenes` (lines of sight through pixels) and `benchmarks.worlds` (tie points):
the ground is a texture of octaves of noise and rectangles on hills that are given by a formula, so that an image is one
interpolation, and tie points scatter by 0.005 px where the images have little noise. Every block is sound: one that
needs review, but for noise that hides the texture, is a false alarm. Truth: held-out points by the exact cameras.

    python -m benchmarks.resampled --seeds 0 30
    python -m benchmarks.resampled --full 20000     # one triplet of that many pixels a side: CPU, memory
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2  # noqa: E402  (the thread counts come first)
import numpy as np  # noqa: E402
import numpy.typing as npt  # noqa: E402
import rasterio  # noqa: E402
from rasterio.errors import NotGeoreferencedWarning  # noqa: E402
from scipy.interpolate import CubicSpline  # noqa: E402
from scipy.ndimage import map_coordinates  # noqa: E402

import barpc  # noqa: E402
from barpc.rpcio import write_rpc  # noqa: E402
from barpc.sensor.corrected import Corrected  # noqa: E402
from barpc.simulate import simulate_block  # noqa: E402

Array = npt.NDArray[np.float64]
GSD, NODE, ROWS = 0.5, 32, 512  # metres of a pixel; pixels between exact lines of sight; rows made at a time


def texture(side: int, seed: int, city: bool = True) -> npt.NDArray[np.float32]:
    """Grey values (side, side): noise of nine octaves, and, in a city, a rectangle on every 50 x 50 px."""
    rng, found = np.random.default_rng(seed), np.full((side, side), 110.0, np.float32)
    for octave in range(9):
        step = max(2, int(side / 2.0 ** (octave + 3)))
        count = -(-side // step) + 3
        height = 14.0 * (1.0 if city or octave < 3 else 0.25)
        coarse = rng.normal(0.0, height, (count, count)).astype(np.float32)
        found += cv2.resize(coarse, None, fx=step, fy=step)[:side, :side]
    count = side * side // 2500 if city else 0
    drawn = rng.integers(0, side, (count, 2)), rng.gamma(2.0, 12.0, (count, 2)) + 6.0, rng.integers(30, 230, count)
    for place, size, grey, turn in zip(*drawn, rng.uniform(0.0, 180.0, count), strict=True):
        corners = cv2.boxPoints((place.tolist(), size.tolist(), float(turn))).astype(np.int32)
        cv2.fillConvexPoly(found, corners, int(grey), lineType=cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(np.clip(found, 5.0, 250.0), (0, 0), 0.7), np.float32)


def write_block(
    folder: Path, size: int, views: int, seed: int, city: bool, noise: float, change: float, **how: Any
) -> Any:
    """Write the images of a block and their delivered RPCs; return the block and the files."""
    block = simulate_block(
        views, 100, seed=seed, size=(size, size), gsd=GSD, per_site=views, alt_range=(0.0, 600.0), **how
    )
    lon, lat, ground = how.get("lon", 5.4), how.get("lat", 43.3), texture(int(1.3 * size) + 1200, seed, city)
    scale, files = 111_000.0 * np.array([np.cos(np.radians(lat)), 1.0]), []

    def heights(place: Array) -> Array:
        x, y = place[..., 0], place[..., 1]
        hills = 130.0 * np.sin(x / 900.0 + 1.0) * np.cos(y / 1100.0) + 60.0 * np.sin(x / 310.0 + y / 270.0)
        return np.asarray(300.0 + hills + 12.0 * np.sin(x / 61.0 - y / 83.0) + 5.0 * np.cos(x / 37.0 + y / 29.0))

    truth = zip(block.views, block.truth.corrections, block.truth.drift, strict=True)
    for number, (view, correction, drift) in enumerate(truth):
        rng, shown = np.random.default_rng([seed, number]), ground.copy() if change and number else ground
        for _ in range(int(change * ground.size / 900.0) if number else 0):
            (row, col), (high, wide) = rng.integers(0, len(ground), 2), rng.integers(10, 40, 2)
            shown[row : row + high, col : col + wide] = rng.integers(20, 240)
        turned = replace(correction, drift=drift[None], row_offset=size / 2, row_scale=size)
        exact, files = Corrected(view.sensor, turned), [*files, folder / f"view_{number}.tif"]
        with rasterio.open(files[-1], "w", driver="GTiff", width=size, height=size, count=1, dtype="uint16") as file:
            for top in range(0, size, ROWS):
                bottom = min(top + ROWS, size)
                ends = (-NODE, size + 2 * NODE), (top - NODE, bottom + 2 * NODE)
                cols, rows = (np.arange(*end, NODE, dtype=np.float64) for end in ends)
                nodes, alt = np.stack(np.meshgrid(cols, rows), axis=-1), np.full((len(rows), len(cols)), 300.0)
                for _ in range(12):
                    place = exact.localize(nodes, alt)[..., :2] - [lon, lat]
                    place = np.stack([(place[..., 0] + 180.0) % 360.0 - 180.0, place[..., 1]], axis=-1) * scale
                    alt = heights(place)
                at = np.stack([-place[..., 1], place[..., 0]]) / GSD + len(ground) / 2
                at = CubicSpline(cols, at, axis=2)(np.arange(size))
                at = CubicSpline(rows, at, axis=1)(np.arange(top, bottom))
                low, high = np.floor(at[0].min()).astype(int) - 12, np.ceil(at[0].max()).astype(int) + 13
                low, high = max(low, 0), min(high, len(ground))
                grey = map_coordinates(shown[low:high], [at[0] - low, at[1]], order=3, mode="mirror")
                grey = 8.0 * grey + 60.0 + rng.normal(0.0, noise, grey.shape)
                file.write(grey.clip(1, 4095).astype(np.uint16), 1, window=((top, bottom), (0, size)))
        write_rpc(view.sensor, files[-1].with_name(f"view_{number}_RPC.TXT"))
    return block, [str(file) for file in files]


def row(name: str, block: Any, files: list[str], folder: Path) -> str:
    """Adjust a block; its row of the table."""
    begun = time.process_time()
    found = barpc.adjust(files, folder / "adjusted")
    cpu, left = time.process_time() - begun, block.held_out_rms([view.sensor for view in found.views])
    before, memory = block.held_out_rms([view.sensor for view in block.views]), resource.getrusage(resource.RUSAGE_SELF)
    said = "good" if found.passed else "; ".join(found.summary["reasons"])[:150]
    return f"| {name} | {before:.2f} | {left:.4f} | {cpu:.1f} s, {memory.ru_maxrss // 1024} MB | {said} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 10), metavar=("FIRST", "STOP"))
    parser.add_argument("--full", type=int, default=0, help="one triplet of so many pixels a side instead")
    args = parser.parse_args()
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    print("| block | delivered [px] | left [px] | adjusted in | said |\n|---|---|---|---|---|")
    for seed in [0] if args.full else range(*args.seeds):
        rng = np.random.default_rng([seed, 7])
        views, size, city = int(rng.integers(2, 6)), int(rng.integers(800, 2000)), bool(rng.random() < 0.67)
        noise, change, drift = rng.uniform(3.0, 60.0), rng.choice([0.0, 0.0, 0.1, 0.3]), rng.choice([0.0, 1e-6, 3e-6])
        where = {
            "lat": rng.uniform(-65.0, 65.0),
            "lon": rng.uniform(-179.0, 179.0),
            "attitude": rng.uniform(3e-6, 15e-6),
        }
        if args.full:
            views, size, city, noise, change, drift, where = 3, args.full, True, 6.0, 0.0, 2e-6, {"attitude": 10e-6}
        name = f"{seed}: {views} x {size} px, {'city' if city else 'sand'}, noise {noise:.0f}, changed {change:.0%}"
        with tempfile.TemporaryDirectory() as temporary:
            how = {**where, "drift": drift, "position": 3.0}
            block, files = write_block(Path(temporary), size, views, seed, city, noise, change, **how)
            print(row(name, block, files, Path(temporary)), flush=True)


if __name__ == "__main__":
    main()
