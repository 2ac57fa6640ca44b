"""The RPC fit beside rpcfit: accuracy, CPU time and memory, in one run.

P_BA is every vendor's RPC behind 30 microradians about its camera centre and 10 m, over the full image and
the RPC's altitude range. CPU time is the median of interleaved repetitions of one thread.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/fit.py --rpcfit SITE_PACKAGES --data DATA
"""

from __future__ import annotations

import argparse
import importlib
import os
import statistics
import sys
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from barpc.base.geodesy import Array
from barpc.fit import FitOptions, fit_rpc, fit_rpc_points
from barpc.fit.points import control_points
from barpc.fit.poles import smallest_denominator
from barpc.rpcio import read_rpc, write_rpc
from barpc.sensor.rpc import RPC
from tests.fit.cameras import Camera, random_points, synthetic, vendor
from tests.geotiffs import write_image

Space = Literal["image", "ground"]
PECULIAR = "rpc_formats/md_ov_rpc.txt"


class Peer:
    """rpcfit, from a folder of installed packages."""

    def __init__(self, folder: str | None) -> None:
        self.module: Any = None
        if folder:
            sys.path.append(folder)
            self.module = importlib.import_module("rpcfit.rpc_fit")

    def fit(self, ground: Array, image: Array, joint: bool = True) -> RPC:
        """The paper's solver by its authors, at the tolerance of the paper."""
        p = self.module.calibrate_rpc(image, ground, separate=not joint, tol=1e-10, max_iter=20)
        coeffs = np.array([p.col_num, p.col_den, p.row_num, p.row_den], dtype=np.float64)
        ground_offset, ground_scale = (
            [getattr(p, f"{axis}_{what}") for axis in ("lon", "lat", "alt")] for what in ("offset", "scale")
        )
        image_offset, image_scale = (
            [getattr(p, f"{axis}_{what}") for axis in ("col", "row")] for what in ("offset", "scale")
        )
        return RPC(coeffs, ground_offset, ground_scale, image_offset, image_scale)


def grid_of(camera: Camera, grid: tuple[int, int, int], space: Space = "image") -> tuple[Array, Array, Array, Array]:
    """Control and check points of a uniform grid over an image, or a box around it: ground and image of each."""
    options = FitOptions(grid=grid, space=space)
    ground, image = control_points(camera.model, camera.size, camera.alt_range, options)
    check = ground
    for axis in range(3):
        check = 0.5 * (check.take(range(1, check.shape[axis]), axis) + check.take(range(check.shape[axis] - 1), axis))
    check = check.reshape(-1, 3)
    return ground.reshape(-1, 3), image.reshape(-1, 2), check, camera.model.project(check)


def cpu(functions: list[Callable[[], object]], repeat: int) -> list[float]:
    """Median CPU seconds of each, interleaved."""
    seconds: list[list[float]] = [[] for _ in functions]
    for _ in range(repeat):
        for function, taken in zip(functions, seconds, strict=True):
            start = time.process_time()
            function()
            taken.append(time.process_time() - start)
    return [statistics.median(taken) for taken in seconds]


def rms(values: Array) -> Array:
    return np.asarray(np.sqrt((values**2).mean(axis=0)))


def accuracy(cameras: list[Camera], peer: Peer, grid: tuple[int, int, int]) -> None:
    print(f"\nP_BA of {len(cameras)} RPC files, {grid[0]} x {grid[1]} x {grid[2]} control points [px]")
    for name in ("barpc", "rpcfit joint", "rpcfit separate"):
        rows = []
        for camera in cameras:
            ground, image, check, truth = grid_of(camera, grid)
            if name == "barpc":
                options = FitOptions(grid=grid)
                fit = fit_rpc(camera.model, camera.size, camera.alt_range, options=options, strict=False)
                rpc = fit.rpc
            elif peer.module is None:
                continue
            else:
                try:
                    rpc = peer.fit(ground, image, joint=name.endswith("joint"))
                except Exception as error:  # noqa: BLE001 - whatever a peer raises is its result
                    print(f"  {name}: {camera.name}: {error}")
                    continue
            error = rpc.project(check) - truth
            rows.append((camera.name, rms(error), np.abs(error).max()))
        for label, chosen in (
            ("all", rows),
            ("without OrbView", [row for row in rows if row[0] != PECULIAR]),
        ):
            if chosen:
                mean = np.mean([row[1] for row in chosen], axis=0)
                worst = np.max([row[1] for row in chosen])
                print(
                    f"  {name:16s}{label:16s} mean rmse row {mean[1]:.2e} col {mean[0]:.2e}   worst image "
                    f"{worst:.2e}   worst point {max(row[2] for row in chosen):.2e}"
                )


def area(cameras: list[Camera], peer: Peer) -> None:
    print("\nGrowth of the error from 5 % to 100 % of the area (largest rmse / smallest), worst file")
    for name in ("barpc", "rpcfit joint"):
        growth = []
        for camera in cameras:
            if camera.name == PECULIAR or (name != "barpc" and peer.module is None):
                continue
            errors = []
            for share in (0.05, 0.25, 1.0):
                width, height = (max(1, round(n * np.sqrt(share))) for n in camera.size)
                part = Camera(camera.name, camera.rpc, camera.model, (width, height), camera.alt_range)
                ground, image, check, truth = grid_of(part, (10, 10, 10))
                rpc = fit_rpc_points(ground, image, strict=False).rpc if name == "barpc" else peer.fit(ground, image)
                errors.append(rms(rpc.project(check) - truth).max())
            growth.append(max(errors) / min(errors))
        if growth:
            print(f"  {name:16s} {max(growth):.1f} x, median {statistics.median(growth):.1f} x")


def noise(cameras: list[Camera], peer: Peer) -> None:
    print("\n0.3 px of noise: rmse against truth relative to rpcfit joint; smallest denominator")
    rng = np.random.default_rng(1)
    for count in (60, 300, 4000):
        ratios, ours, theirs = [], [], []
        for camera in cameras:
            ground, image = random_points(camera, count, rng)
            noisy = image + rng.normal(0, 0.3, image.shape)
            truth_ground, truth = random_points(camera, 2000, rng)
            fit = fit_rpc_points(ground, noisy, options=FitOptions(tolerance=20.0), strict=False)
            ours.append(fit.min_denominator)
            if peer.module is None:
                continue
            try:
                other = peer.fit(ground, noisy)
            except Exception as error:  # noqa: BLE001
                print(f"  rpcfit: {camera.name}, {count} points: {error}")
                continue
            theirs.append(smallest_denominator(other, ground.min(axis=0), ground.max(axis=0)))
            missed = np.linalg.norm(rms(other.project(truth_ground) - truth))
            if np.isfinite(missed):
                ratios.append(np.linalg.norm(rms(fit.rpc.project(truth_ground) - truth)) / missed)
        line = f"  {count:5d} points: smallest denominator {min(ours):.2f}"
        if ratios:
            line += f" (rpcfit {min(theirs):.2f}), ratio median {np.median(ratios):.2f} worst {max(ratios):.2f}"
        print(line)


def radar(data: Path, peer: Peer) -> None:
    folder = data / "sar" / "rpcfit"
    train = [np.load(folder / f"s1_train{d}d.npy") for d in (3, 2)]
    test = [np.load(folder / f"s1_test{d}d.npy") for d in (3, 2)]
    print("\nThe paper's Sentinel-1 points, rmse on its test points [px]")
    fit = fit_rpc_points(*train, check=(test[0], test[1]))
    print(f"  barpc            row {fit.rmse_ckp[1]:.4e} col {fit.rmse_ckp[0]:.4e}")
    for joint in (True, False) if peer.module else ():
        error = rms(peer.fit(*train, joint=joint).project(test[0]) - test[1])
        print(f"  rpcfit {'joint   ' if joint else 'separate'}  row {error[1]:.4e} col {error[0]:.4e}")


def physical(data: Path) -> None:
    from barpc.pointio.correspondences import read_correspondences

    points = read_correspondences(data / "physical" / "GRID_P1BP--2017092838284574CP.tif")
    vendors = read_rpc(data / "physical" / "RPC_P1BP--2017092838284574CP.XML")
    low = points.ground[:, 2] <= 1202.5
    print("\nGrid of the physical model, altitudes to 1,202 m, standard deviation col row [px]")
    for name, rpc in (
        ("vendor", vendors),
        ("fit to 2 layers", fit_rpc_points(points.ground[low], points.image[low]).rpc),
        ("fit to 5 layers", fit_rpc_points(points.ground, points.image).rpc),
    ):
        print(f"  {name:16s} {(rpc.project(points.ground[low]) - points.image[low]).std(axis=0)}")


def outside(cameras: list[Camera], peer: Peer) -> None:
    print("\n25 % outside in lon/lat and 2,500 m in altitude, Pleiades, largest error [px]")
    worst = {"barpc": 0.0, "rpcfit joint": 0.0}
    for camera in cameras:
        if "PHR1B" not in camera.name and "PLEIADES" not in camera.name:
            continue
        ground, image, _, _ = grid_of(camera, (10, 10, 10))
        rpc = fit_rpc(camera.model, camera.size, camera.alt_range).rpc
        t = np.linspace(-1.25, 1.25, 9)
        lon, lat = (rpc.ground_offset[i] + t * rpc.ground_scale[i] for i in (0, 1))
        alt = np.linspace(camera.alt_range[0] - 2500, camera.alt_range[1] + 2500, 9)
        far = np.stack(np.meshgrid(lon, lat, alt), axis=-1)
        truth = camera.model.project(far)
        worst["barpc"] = max(worst["barpc"], np.abs(rpc.project(far) - truth).max())
        if peer.module:
            error = np.abs(peer.fit(ground, image).project(far) - truth).max()
            worst["rpcfit joint"] = max(worst["rpcfit joint"], error)
    print("  " + "   ".join(f"{name} {value:.2e}" for name, value in worst.items() if value))


def files(camera: Camera, folder: Path) -> None:

    from barpc.rpcio import write_rpc_copy

    rpc = fit_rpc(camera.model, camera.size, camera.alt_range).rpc
    ground, _ = random_points(camera, 2000, np.random.default_rng(3))
    image = write_image(folder / "image.tif", np.zeros((8, 8), np.uint8))
    write_rpc(rpc, folder / "image_RPC.TXT", overwrite=True)
    write_rpc_copy(rpc, image, folder / "copy.tif", overwrite=True)
    tag = np.abs(read_rpc(folder / "copy.tif").project(ground) - rpc.project(ground)).max()
    print(f"\nAfter its files: tag {tag:.1e} px, text identical: {read_rpc(folder / 'image_RPC.TXT') == rpc}")


def speed(camera: Camera, peer: Peer, repeat: int) -> None:
    print("\nCPU time")
    ground, image, _, _ = grid_of(camera, (50, 50, 10))
    functions: list[Callable[[], object]] = [lambda: fit_rpc_points(ground, image, strict=False)]
    functions.append(lambda: fit_rpc_points(ground, image, check=(ground[:100], image[:100]), strict=False))
    if peer.module:
        functions += [lambda: peer.fit(ground, image), lambda: peer.fit(ground, image, joint=False)]
    seconds = cpu(functions, repeat)
    print(f"  25,000 points, whole fit with leave-one-out certificate {1e3 * seconds[0]:.1f} ms")
    print(f"  25,000 points, with check points given                 {1e3 * seconds[1]:.1f} ms")
    for name, taken in zip(("joint", "separate"), seconds[2:], strict=False):
        print(
            f"  rpcfit {name:9s} {1e3 * taken:.0f} ms: {taken / seconds[0]:.0f} x and "
            f"{taken / seconds[1]:.0f} x as long"
        )
    (whole,) = cpu([lambda: fit_rpc(camera.model, camera.size, camera.alt_range)], 5 * repeat)
    print(f"  default grid through P_BA, whole fit with certificate  {1e3 * whole:.1f} ms")


def memory(camera: Camera, peer: Peer) -> None:
    print("\nPeak traced memory")
    ground, image, _, _ = grid_of(camera, (80, 80, 32))
    for count in (25_000, 200_000):
        jobs: list[tuple[str, Callable[[], object]]] = [
            ("barpc", lambda n=count: fit_rpc_points(ground[:n], image[:n], strict=False))
        ]
        if peer.module and count == 25_000:
            jobs.append(("rpcfit joint", lambda n=count: peer.fit(ground[:n], image[:n])))
        for name, job in jobs:
            tracemalloc.start()
            job()
            print(f"  {count:7d} points, {name:13s} {tracemalloc.get_traced_memory()[1] / 1e6:.1f} MB")
            tracemalloc.stop()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of vendors' RPC files (optical, rpc_formats, physical, sar)")
    parser.add_argument("--rpcfit", metavar="DIR", help="site-packages folder that holds rpcfit")
    parser.add_argument("--repeat", type=int, default=5, help="repetitions of a timing")
    parser.add_argument("--tmp", type=Path, default=Path("/tmp"), help="folder for files that are written")
    parser.add_argument("--only", help="one of accuracy, area, noise, radar, outside, files, speed, memory")
    args = parser.parse_args()
    peer = Peer(args.rpcfit)
    cameras = vendor(args.data) if args.data else [synthetic(seed) for seed in range(3)]
    one = next((c for c in cameras if c.name.endswith("rpc_PLEIADES.xml")), cameras[0])
    parts: dict[str, Callable[[], None]] = {
        "accuracy": lambda: [accuracy(cameras, peer, g) for g in ((50, 50, 10), (10, 10, 6))] and None,
        "area": lambda: area(cameras, peer),
        "noise": lambda: noise(cameras, peer),
        "outside": lambda: outside(cameras, peer),
        "files": lambda: files(one, args.tmp),
        "speed": lambda: speed(one, peer, args.repeat),
        "memory": lambda: memory(one, peer),
    }
    if args.data:
        parts["radar"] = lambda: radar(args.data, peer)
        parts["physical"] = lambda: physical(args.data)
    for name, part in parts.items():
        if args.only in (None, name):
            part()


if __name__ == "__main__":
    main()
