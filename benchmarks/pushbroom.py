"""The rigorous pushbroom camera and localisation grids: accuracy against known truth, CPU against shareloc.

A simulated pushbroom camera is the truth. Its localisation grid is written as vendors deliver it (nodes every
600 px, five altitudes) and read by barpc and by shareloc; both are compared with the camera itself.

    python benchmarks/pushbroom.py --shareloc /venv-shareloc/bin/python
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

POINTS = 25_000
PEER_POINTS = 2_000  # the peer inverts its grid point by point
SIZE = (40_000, 20_000)
ALTS = np.linspace(-30.0, 4900.0, 5)


def cpu(call, repeats: int = 5) -> float:
    """Median CPU seconds of a call."""
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        spent.append(time.process_time() - start)
    return float(np.median(spent))


def peer(folder: Path) -> None:
    """What shareloc makes of the grid: runs in its interpreter."""
    warnings.simplefilter("ignore")
    from shareloc.geomodels import GeoModel

    points = np.load(folder / "points.npz")
    model = GeoModel(str(folder / "grid.tif"), "GRID")
    prepare = cpu(model.estimate_inverse_loc_predictor, 1)
    row, col = points["image"].T[::-1] + 0.5
    few = slice(PEER_POINTS)
    lon, lat, alt = points["ground"][few].T
    found = model.inverse_loc(lon, lat, alt)
    np.savez(
        folder / "peer.npz",
        ground=np.asarray(model.direct_loc_h(row, col, points["ground"][:, 2])),
        image=np.column_stack([found[1], found[0]]) - 0.5,
        localize=cpu(lambda: model.direct_loc_h(row, col, points["ground"][:, 2])) / POINTS,
        project=cpu(lambda: model.inverse_loc(lon, lat, alt), 1) / PEER_POINTS,
        prepare=prepare,
    )


def write_grid(path: Path, cols, rows, lonlat) -> None:
    """The grid as a GeoTIFF: bands lon, lat of every layer; (0.5, 0.5) is the centre of the first pixel."""
    import rasterio

    transform = rasterio.Affine(cols[1] - cols[0], 0, cols[0] + 0.5, 0, rows[1] - rows[0], rows[0] + 0.5)
    profile = {"count": 2 * len(ALTS), "dtype": "float64", "transform": transform}
    with rasterio.open(path, "w", "GTiff", len(cols), len(rows), **profile) as dataset:
        for k in range(2 * len(ALTS)):
            dataset.write(lonlat[k // 2, :, :, k % 2], k + 1)
        dataset.update_tags(REF="EPSG:4326", **{f"ALTITUDE_B{k}": ALTS[k // 2] for k in range(2 * len(ALTS))})


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--shareloc", metavar="PYTHON", help="interpreter that has shareloc")
    parser.add_argument("--peer-run", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.peer_run:
        peer(arguments.peer_run)
        return
    warnings.simplefilter("ignore")

    from barpc.fit import fit_rpc
    from barpc.pointio.correspondences import read_grid
    from barpc.sensor.direct_grid import DirectGrid
    from barpc.simulate import Look, fly

    camera = fly(np.array([5.4, 43.3, 500.0]), Look(22.0, 140.0), SIZE, 0.5)
    cols, rows = (np.arange(0.0, n + 600.0, 600.0) for n in SIZE)
    nodes = np.stack(np.meshgrid(cols, rows), axis=-1)
    rng = np.random.default_rng(0)
    image, alt = rng.uniform(0, np.array(SIZE) - 1.0, (POINTS, 2)), rng.uniform(0, 4800, POINTS)
    ground = camera.localize(image, alt)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_grid(folder / "grid.tif", cols, rows, camera.localize(nodes, ALTS[:, None, None])[..., :2])
        listed = read_grid(folder / "grid.tif")
        grid = DirectGrid.from_points(listed.ground, listed.image)
        np.savez(folder / "points.npz", image=image, ground=ground)
        result = None
        if arguments.shareloc:
            subprocess.run([arguments.shareloc, sys.argv[0], "--peer-run", name], check=True)
            result = dict(np.load(folder / "peer.npz"))

    print(f"{'':34}{'localize':>12}{'project':>12}{'+ Jacobian':>12}   us a point")
    for label, model in (("Pushbroom", camera), ("DirectGrid", grid)):
        times = (
            cpu(lambda m=model: m.localize(image, alt)),
            cpu(lambda m=model: m.project(ground)),
            cpu(lambda m=model: m.project_jacobian(ground)),
        )
        print(f"{label:34}" + "".join(f"{1e6 * t / POINTS:12.2f}" for t in times))
        if label == "DirectGrid" and result:
            peers = (float(result["localize"]), float(result["project"]))
            print(f"{'shareloc Grid':34}" + "".join(f"{1e6 * t:12.2f}" for t in peers))
            print(
                f"{'  times as long':34}"
                + "".join(f"{t * POINTS / o:12.1f}" for t, o in zip(peers, times, strict=False))
            )
    print(f"\n{'error against the camera':34}{'max px':>12}{'rms px':>12}")
    fit = fit_rpc(camera, SIZE, (0.0, 4800.0)).rpc
    errors = [
        ("Pushbroom, there and back", camera.project(ground) - image),
        ("RPC fitted to it", fit.project(ground) - image),
        ("DirectGrid, project", grid.project(ground) - image),
        ("DirectGrid, localize", camera.project(grid.localize(image, alt)) - image),
    ]
    if result:
        errors += [
            ("shareloc Grid, project", result["image"] - image[:PEER_POINTS]),
            ("shareloc Grid, localize", camera.project(result["ground"]) - image),
        ]
    for label, error in errors:
        print(f"{label:34}{np.abs(error).max():12.1e}{np.sqrt(np.mean(error**2)):12.1e}")


if __name__ == "__main__":
    main()
