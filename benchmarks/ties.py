"""Tie points: CPU time, spread across the epipolar lines and memory, beside peers that install from PyPI.

    python benchmarks/ties.py IMG IMG [IMG...]          this project, stage by stage, and OpenCV's SIFT + FLANN
    python benchmarks/ties.py IMG IMG --cars PYTHON     and cars-bundleadjustment, run by that interpreter
    python benchmarks/ties.py --size SIDE               evenness, memory, CPU on a made-up pair of SIDE x SIDE pixels
    python benchmarks/ties.py --size SIDE --area 0.3    the same with an area of interest, so much of a side wide
    python benchmarks/ties.py --size SIDE --unrelated   two textures that have nothing in common: what a refusal takes
    python benchmarks/ties.py IMG IMG --refused         the first and the second image mirrored: what a refusal takes

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
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # tests, where barpc is installed as a package

import cv2  # noqa: E402  (the thread counts come first)
import numpy as np  # noqa: E402
import rasterio  # noqa: E402
from rasterio.windows import Window  # noqa: E402

from barpc.base.errors import BarpcError  # noqa: E402
from barpc.base.statistics import robust_spread  # noqa: E402
from barpc.pipeline.executor import CachingExecutor  # noqa: E402
from barpc.pipeline.loading import load_views  # noqa: E402
from barpc.scene import View  # noqa: E402
from barpc.sensor.rpc import RPC  # noqa: E402
from barpc.tie import Area, Scope, TieOptions, find_tracks, link, match_pairs, read_area, refine  # noqa: E402
from barpc.tie.pairing.epipolar import coherent, epipolar_segments  # noqa: E402
from barpc.tie.pixels import read_pixels, sample_stretch  # noqa: E402
from barpc.workspace import Workspace  # noqa: E402
from tests.geotiffs import write_image  # noqa: E402
from tests.tie.stages import common_tracks, detect, select_pairs  # noqa: E402


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
    matched = match_pairs(views, keypoints, pairs, options)
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
    across = epipolar_segments(first, second, xy_first).errors(xy_second)[:, 1]
    return robust_spread(coherent(xy_first, across)[1])


def opencv(views: list[View]) -> float:
    """CPU seconds of SIFT on whole images, FLANN with the ratio test and a fundamental matrix."""
    cv2.setNumThreads(1)
    start = time.process_time()
    found = []
    for view in views:
        stretch = sample_stretch(view.path, 1)
        pixels, valid = read_pixels(view.path, (0, 0, *view.size), 1)
        found.append(cv2.SIFT.create().detectAndCompute(stretch.apply(pixels, valid), None))
    for i in range(len(views)):
        for j in range(i + 1, len(views)):
            (points_a, described_a), (points_b, described_b) = found[i], found[j]
            flann = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 64})
            pairs = [m for m, n in flann.knnMatch(described_a, described_b, k=2) if m.distance < 0.7 * n.distance]
            a = np.float64([points_a[m.queryIdx].pt for m in pairs])
            b = np.float64([points_b[m.trainIdx].pt for m in pairs])
            _, mask = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, 1.0, 0.999, 10000)
            keep = mask.ravel() > 0
            print(f"  {i} - {j}: {keep.sum()} inliers, spread {spread(views[i], views[j], a[keep], b[keep]):.3f} px")
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


def scene(side: int, folder: str, layout: dict[str, object], unrelated: bool = False) -> list[View]:
    """A pair of `side` x `side` px: turned crops of one texture, the left half with a third of the contrast.

    `unrelated`: the second is mirrored in its middle row, column by column of crops: the same places, other ground.
    """
    rng = np.random.default_rng(0)
    paths = [Path(folder) / f"{k}.tif" for k in range(2)]
    profile = {"driver": "GTiff", "width": side, "height": side, "count": 1, "dtype": "uint16", **layout}
    files = [rasterio.open(path, "w", BIGTIFF="YES", **profile) for path in paths]
    fine, coarse = (cv2.GaussianBlur(rng.normal(0, 1, (1500, 1500)).astype(np.float32), (0, 0), s) for s in (1.2, 5.0))
    texture = 150 * fine / fine.std() + 250 * coarse / coarse.std()
    noise = rng.normal(0, 10, (1024 + 64, side + 64)).astype(np.float32)
    quiet = np.where(np.arange(side) < side / 2, 1 / 3, 1.0).astype(np.float32)
    above = None
    for row in range(0, side, 1024):
        blocks = [texture[r : r + 1024, c : c + 1024] for r, c in rng.integers(0, 470, (-(-side // 1024) + 1, 2))]
        turned = [np.rot90(block, n) for block, n in zip(blocks, rng.integers(0, 4, len(blocks)), strict=True)]
        band = np.hstack(turned)
        both = np.vstack([band[:8] if above is None else above[-8:], band])
        above = band
        for k, file in enumerate(files):
            height, (right, down) = min(1024, side - row), rng.integers(0, 64, 2)
            part = both[8 - 2 * k :][:height, 8 - 3 * k :][:, :side]
            part = part[::-1] if unrelated and k else part
            part = 900 + quiet * part + noise[down : down + height, right : right + side]
            file.write(part.clip(1, 4095).astype(np.uint16), 1, window=Window(0, row, side, height))
    for file in files:
        file.close()
    return [
        View(path.stem, str(path), (side, side), linear_rpc(side, 0.1 * k), (0.0, 200.0))
        for k, path in enumerate(paths)
    ]


LAYOUTS: dict[str, dict[str, object]] = {
    "tiles": {"tiled": True, "blockxsize": 512, "blockysize": 512, "compress": "zstd", "zstd_level": 1},
    "strips": {"compress": "deflate", "zlevel": 1, "blockysize": 16},
}


def mirrored(path: Path, folder: str) -> Path:
    """An image turned over in its middle column, with its RPC: other ground at the same place."""
    with rasterio.open(path) as file:
        pixels, rpcs = file.read(1), file.rpcs
    return write_image(Path(folder) / f"mirrored_{path.stem}.tif", np.ascontiguousarray(pixels[:, ::-1]), rpcs=rpcs)


def refused(views: list[View]) -> None:
    """CPU seconds and memory of a pair of which nothing can be said, all in this process."""
    start = time.process_time()
    try:
        found = find_tracks(views)
        said = f"tied by {found.pairs[0].means}: {found.tracks.num_points} tracks"
    except BarpcError as error:
        said = " ".join(str(error).split())[:100]
    seconds, area = time.process_time() - start, 1e-6 * sum(v.size[0] * v.size[1] for v in views)
    print(f"  {seconds:.1f} CPU s, {seconds / area:.3f} s a Mpx, peak {peak(os.getpid()):.0f} MB: {said}")


def size(side: int, share: float | None, layout: str) -> None:
    """Evenness, memory, files and CPU seconds of a pair of `side` x `side` images, in a run folder with one worker."""
    with tempfile.TemporaryDirectory() as folder, Workspace(Path(folder) / "run") as workspace:
        views = scene(side, folder, LAYOUTS[layout])
        area = None if share is None else middle(share, 0.25 * side / 111000.0, folder)
        kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        start = [resource.getrusage(kind) for kind in kinds]
        fresh = resident()
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            with CachingExecutor(workspace, {}, pool) as caching:
                result = find_tracks(views, scope=Scope(area=area), executor=caching)
            worker = peak(next(iter(pool._processes)))
        seconds = [u.ru_utime + u.ru_stime for u in (resource.getrusage(kind) for kind in kinds)]
        seconds = [now - was.ru_utime - was.ru_stime for now, was in zip(seconds, start, strict=True)]
        kept = sum(file.stat().st_size for file in workspace.cache.rglob("*.npz"))
    tracks = result.tracks
    left = np.mean(tracks.xy[tracks.view == 0, 0] < side / 2)
    print(f"{side} x {side}, {layout}: {result.keypoints} keypoints, {tracks.num_points} tracks")
    print(f"  {left:.3f} of them in the half with a third of the contrast")
    print(f"  {sum(seconds):.0f} CPU s (caller {seconds[0]:.0f}), {sum(seconds) / (2e-6 * side * side):.3f} s a Mpx")
    print(f"  caller grew by {peak(os.getpid()) - fresh:.0f} MB to its peak, worker's peak {worker:.0f} MB")
    print(f"  {kept / 2e6:.1f} MB an image in the run folder")


def peak(process: int) -> float:
    """Peak resident memory [MB]."""
    return _status(process, "VmHWM")


def resident() -> float:
    """Resident memory of this process, from which its peak counts from now on [MB]."""
    Path("/proc/self/clear_refs").write_text("5")
    return _status(os.getpid(), "VmRSS")


def _status(process: int, name: str) -> float:
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) / 1e3


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", nargs="*", type=Path, metavar="IMG")
    parser.add_argument("--cars", metavar="PYTHON", help="interpreter of an environment with cars")
    parser.add_argument("--size", type=int, metavar="SIDE", help="evenness, memory and time of a made-up pair")
    parser.add_argument("--layout", choices=LAYOUTS, default="tiles", help="how that pair is stored")
    parser.add_argument("--area", type=float, metavar="SHARE", help="only in the middle of that pair")
    parser.add_argument("--unrelated", action="store_true", help="a made-up pair that has nothing in common")
    parser.add_argument("--refused", action="store_true", help="the first image and the second mirrored")
    given = parser.parse_args()
    if given.unrelated or given.refused:
        with tempfile.TemporaryDirectory() as folder:
            if given.refused:
                first, second = given.images
                refused(list(load_views([first, mirrored(second, folder)]).views))
            else:
                refused(scene(given.size, folder, LAYOUTS[given.layout], unrelated=True))
        return 0
    if given.size:
        size(given.size, given.area, given.layout)
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
    elif not given.size:
        parser.print_usage(sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
