"""Tie points: CPU time, spread across the epipolar lines and memory, beside peers that install from PyPI.

    python benchmarks/ties.py IMG IMG [IMG...]          this project, stage by stage, and OpenCV's SIFT + FLANN
    python benchmarks/ties.py IMG IMG --cars PYTHON     and cars-bundleadjustment, run by that interpreter
    python benchmarks/ties.py --memory SIDE             peak memory on a made-up pair of SIDE x SIDE pixels
    python benchmarks/ties.py --memory SIDE --area 0.3  the same with an area of interest, so much of a side wide

Ratios are of CPU seconds, measured in the same run, one thread.
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
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import cv2  # noqa: E402  (the thread counts come first)
import numpy as np  # noqa: E402
import rasterio  # noqa: E402
from rasterio.windows import Window  # noqa: E402

from barpc.pipeline.views import load_views  # noqa: E402
from barpc.scene import View  # noqa: E402
from barpc.sensor.rpc import RPC  # noqa: E402
from barpc.tie import (  # noqa: E402
    Area,
    TieOptions,
    common_tracks,
    detect,
    find_tracks,
    link,
    match,
    read_area,
    refine,
    select_pairs,
)
from barpc.tie.epipolar import agreeing, frame, robust_spread  # noqa: E402
from barpc.tie.raster import read_pixels, sample_stretch  # noqa: E402


def stages(views: list[View]) -> float:
    """CPU seconds of every stage, and what it leaves."""
    options, total = TieOptions(), 0.0

    def lap(label: str, start: float, text: str) -> None:
        nonlocal total
        seconds = time.process_time() - start
        total += seconds
        print(f"  {label:8s} {seconds:7.2f} s   {text}")

    start = time.process_time()
    keypoints = detect(views, options)
    lap("detect", start, f"{[len(k) for k in keypoints]} keypoints")
    start = time.process_time()
    pairs = select_pairs(views, options)
    matched = match(views, keypoints, pairs, options)
    lap("match", start, f"{[r.verified for _, r in matched]} verified")
    start = time.process_time()
    linked = link([pair.views for pair in pairs], [found for found, _ in matched])
    lap("link", start, f"{linked.num_points} tracks")
    start = time.process_time()
    refined = refine(
        views,
        linked,
        {p.views: r.spread for p, (m, r) in zip(pairs, matched, strict=True) if len(m)},
        options,
    )
    lap("refine", start, f"{refined.num_points} tracks")
    registered = len(linked) - linked.num_points
    print(f"  {1e6 * (time.process_time() - start) / max(registered, 1):.0f} us a registered observation")
    for (found, report), pair in zip(matched, pairs, strict=True):
        i, j = pair.views
        raw = spread(views[i], views[j], found.xy[:, 0], found.xy[:, 1])
        sharp = spread(views[i], views[j], *common_tracks(refined, i, j))
        print(
            f"  {report.names[0]} - {report.names[1]}: spread {raw:.3f} -> {sharp:.3f} px (x {sharp / raw:.2f}), "
            f"inliers {report.inlier_share:.3f}, false {report.control_share:.4f}"
        )
    return total


def spread(first: View, second: View, xy_first: np.ndarray, xy_second: np.ndarray) -> float:
    """Robust standard deviation across the epipolar line after an affine fit [px]."""
    across = frame(first, second, xy_first).errors(xy_second)[:, 1]
    return robust_spread(agreeing(xy_first, across)[1])


def opencv(views: list[View]) -> float:
    """CPU seconds of SIFT on whole images, FLANN with the ratio test and a fundamental matrix."""
    cv2.setNumThreads(1)
    start = time.process_time()
    found = []
    for view in views:
        stretch = sample_stretch(view.path)
        pixels, valid = read_pixels(view.path, (0, 0, *view.size))
        found.append(cv2.SIFT.create().detectAndCompute(stretch.apply(pixels, valid), None))
    for i in range(len(views)):
        for j in range(i + 1, len(views)):
            (points_a, described_a), (points_b, described_b) = found[i], found[j]
            flann = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 64})
            pairs = [
                m for m, n in flann.knnMatch(described_a, described_b, k=2) if m.distance < 0.7 * n.distance
            ]
            a = np.float64([points_a[m.queryIdx].pt for m in pairs])
            b = np.float64([points_b[m.trainIdx].pt for m in pairs])
            _, mask = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, 1.0, 0.999, 10000)
            keep = mask.ravel() > 0
            print(
                f"  {i} - {j}: {keep.sum()} inliers, spread {spread(views[i], views[j], a[keep], b[keep]):.3f} px"
            )
    return time.process_time() - start


def cars(interpreter: str, images: list[Path]) -> float:
    """CPU seconds of cars-bundleadjustment on the same images."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [str(Path(interpreter).parent / "cars-bundleadjustment")]
    with tempfile.TemporaryDirectory() as folder:
        names = [f"img{k}" for k in range(len(images))]
        sensors = {name: {"image": str(path.absolute())} for name, path in zip(names, images, strict=True)}
        pairing = [[names[0], name] for name in names[1:]]
        wanted = {"pairing": pairing, "separate": True, "nb_decimals": 0, "min_matches": 50}
        config = Path(folder) / "config.json"
        config.write_text(
            json.dumps(
                {
                    "input": {"sensors": sensors, "pairing": pairing},
                    "orchestrator": {"mode": "sequential"},
                    "tie_points": {"applications": {"bundle_adjustment": wanted}},
                    "output": {"directory": f"{folder}/out"},
                }
            )
        )
        done = subprocess.run([*command, str(config)], capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        print(f"  it failed: {done.stderr.strip().splitlines()[-1:]}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def adjust(images: list[Path]) -> float:
    """CPU seconds of the whole `barpc adjust` on the same images."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "barpc", "-q", "adjust", *map(str, images), "-o", f"{folder}/out"]
        subprocess.run(command, capture_output=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def linear_rpc(side: int, parallax: float) -> RPC:
    """A camera that is linear in longitude, latitude and altitude: 0.5 m pixels, `parallax` px a metre."""
    coeffs = np.zeros((4, 20))
    coeffs[1::2, 0] = 1.0
    coeffs[0, 1], coeffs[2, 2], coeffs[0, 3] = 1.0, -1.0, 100.0 * parallax / (0.5 * side)
    degrees = 0.25 * side / 111000.0
    half = np.full(2, 0.5 * side)
    return RPC(coeffs, np.array([5.0, 0.0, 100.0]), np.array([degrees, degrees, 100.0]), half, half)


def middle(share: float, degrees: float, folder: str) -> Area:
    """The middle of the made-up scene, as an area of interest."""
    reach = share * degrees
    ring = [[5 + x * reach, y * reach] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
    path = Path(folder) / "area.json"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    return read_area(path)


def memory(side: int, share: float | None) -> None:
    """Peak memory of a pair of `side` x `side` images, textured in spots, empty between them."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{k}.tif" for k in range(2)]
        profile = {
            "driver": "GTiff", "width": side, "height": side, "count": 1, "dtype": "uint16", "tiled": True,
            "blockxsize": 256, "blockysize": 256, "compress": "deflate", "SPARSE_OK": True,
        }  # fmt: skip
        files = [rasterio.open(path, "w", **profile) for path in paths]
        for _ in range(max(4, side * side // 20_000_000)):
            noise = cv2.GaussianBlur(rng.uniform(0, 4000, (1100, 1100)).astype(np.float32), (0, 0), 2.0)
            col, row = rng.integers(0, side - 1200, 2).tolist()
            for k, file in enumerate(files):
                file.write(noise.astype(np.uint16), 1, window=Window(col + 3 * k, row + 2 * k, 1100, 1100))
        for file in files:
            file.close()
        views = [
            View(path.stem, str(path), (side, side), linear_rpc(side, 0.1 * k), (0.0, 200.0))
            for k, path in enumerate(paths)
        ]
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        start = time.process_time()
        area = None if share is None else middle(share, 0.25 * side / 111000.0, folder)
        result = find_tracks(views, area=area)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"{side} x {side}: {result.keypoints} keypoints, {result.tracks.num_points} tracks")
    print(
        f"peak {peak / 1024:.0f} MB ({before / 1024:.0f} MB before), {time.process_time() - start:.1f} CPU s"
    )


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("images", nargs="*", type=Path, metavar="IMG")
    parser.add_argument("--cars", metavar="PYTHON", help="interpreter of an environment with cars")
    parser.add_argument("--memory", type=int, metavar="SIDE", help="measure memory on a made-up pair")
    parser.add_argument("--area", type=float, metavar="SHARE", help="only in the middle of that pair")
    given = parser.parse_args()
    if given.memory:
        memory(given.memory, given.area)
    if given.images:
        views = list(load_views(given.images).views)
        start = time.process_time()
        find_tracks(views)
        whole = time.process_time() - start
        print("barpc, stage by stage, nothing thinned")
        stages(views)
        print(f"barpc, images to tracks   {whole:7.2f} s")
        print("OpenCV: SIFT, FLANN, MAGSAC")
        print(f"OpenCV                    {(seconds := opencv(views)):7.2f} s   x {seconds / whole:.1f}")
        if given.cars:
            seconds = cars(given.cars, given.images)
            print(f"barpc adjust, all of it   {(ours := adjust(given.images)):7.2f} s")
            print(f"cars-bundleadjustment     {seconds:7.2f} s   x {seconds / ours:.1f}")
    elif not given.memory:
        parser.print_usage(sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
