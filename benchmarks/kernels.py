"""The kernels of the RPC against rpcm, GDAL and shareloc, in one run: ns a point, ratios, accuracy.

Every figure is CPU time (one thread), the median of interleaved rounds. Peers that cannot be imported are
left out; `--python` runs the script under an interpreter that has them.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from barpc.base.geodesy import ecef_from_ground, ground_from_ecef
from barpc.rpcio import read_rpc, write_rpc
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.rpc import RPC
from barpc.sensor.triangulation import triangulate

Job = tuple[Callable[[], Any], int]
"""What to run, and how many points it works on."""


def default_rpc() -> RPC:
    """A camera 25 degrees off nadir with all of its coefficients at work, GSD near 0.5 m."""
    rng = np.random.default_rng(3)
    coeffs = rng.normal(0, 2e-6, (4, 20))
    coeffs[0, :4] += [1e-3, 1.0, 0.02, -0.04]
    coeffs[2, :4] += [-2e-3, 0.03, -1.0, 0.025]
    coeffs[1::2, 0] = 1.0
    return RPC(coeffs, [5.4, 43.2, 500.0], [0.06, 0.045, 500.0], [10000.0, 9500.0], [10100.0, 9800.0])


def measure(jobs: dict[str, Job], rounds: int) -> dict[str, float]:
    """Median CPU time of each job, taken in turns [ns a point]."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, (job, count) in jobs.items():
            start = time.process_time()
            try:
                job()
            except Exception as error:  # noqa: BLE001 - a peer that gives up is a finding, too
                print(f"  {name} raised {type(error).__name__}: {error}")
                times[name].append(float("nan"))
                continue
            times[name].append((time.process_time() - start) / count * 1e9)
    return {name: median(values) for name, values in times.items()}


def report(title: str, jobs: dict[str, Job], rounds: int, note: str = "") -> None:
    """Print a table of one operation; the first job is barpc's."""
    found = measure(jobs, rounds)
    own = next(iter(found.values()))
    print(f"\n{title}" + (f"  ({note})" if note else ""))
    for name, value in found.items():
        print(f"  {name:24s} {value:10.1f} ns/point  {value / own:8.1f} x")


class Peers:
    """The same camera in the tools that are here."""

    def __init__(self, rpc: RPC, folder: Path) -> None:
        text, geom = folder / "a_RPC.TXT", folder / "a.geom"
        write_rpc(rpc, text)
        write_rpc(rpc, geom)
        self.rpcm: Any = None
        self.shareloc: Any = None
        if find_spec("rpcm"):
            from rpcm.rpc_model import rpc_from_rpc_file

            self.rpcm = rpc_from_rpc_file(str(text))
        if find_spec("shareloc"):
            from shareloc.geomodels import rpc as shareloc_rpc

            self.shareloc = shareloc_rpc.RPC.load(str(geom))
        import rasterio.rpc

        fields = dict(line.split(": ") for line in text.read_text().splitlines())
        lists = {
            f"{axis}_{part}_coeff": [float(fields[f"{axis}_{part}_coeff_{i}".upper()]) for i in range(1, 21)]
            for axis in ("line", "samp")
            for part in ("num", "den")
        }
        single = {k.lower(): float(v) for k, v in fields.items() if k.endswith(("_OFF", "_SCALE"))}
        self.gdal = rasterio.rpc.RPC(**single, **lists)

    def gdal_project(self, ground: np.ndarray) -> np.ndarray:
        """col, row by GDAL's transformer."""
        from rasterio.transform import RPCTransformer

        with RPCTransformer(self.gdal) as transformer:
            row, col = transformer.rowcol(*ground.T, op=lambda v: v)
        return np.column_stack([col, row]) - 0.5

    def gdal_localize(self, image: np.ndarray, alt: np.ndarray) -> np.ndarray:
        """lon, lat by GDAL's transformer."""
        from rasterio.transform import RPCTransformer

        with RPCTransformer(self.gdal) as transformer:
            lon, lat = transformer.xy(image[:, 1], image[:, 0], alt, offset="center")
        return np.column_stack([lon, lat])


def projection(rpc: RPC, peers: Peers, ground: np.ndarray, rounds: int) -> None:
    """Ground to image."""
    jobs: dict[str, Job] = {"barpc": (lambda: rpc.project(ground), len(ground))}
    if peers.rpcm is not None:
        jobs["rpcm"] = (lambda: peers.rpcm.projection(*ground.T), len(ground))
    jobs["GDAL"] = (lambda: peers.gdal_project(ground), len(ground))
    if peers.shareloc is not None:
        columns = np.ascontiguousarray(ground.T)
        jobs["shareloc"] = (lambda: peers.shareloc.inverse_loc(*columns), len(ground))
    report("projection", jobs, rounds, "bound: 35 ns, 5 x rpcm")


def localisation(rpc: RPC, peers: Peers, ground: np.ndarray, rounds: int) -> None:
    """Image to ground at known altitudes, and how far the result projects from where it was asked."""
    image, alt = rpc.project(ground), ground[:, 2]
    few = slice(0, len(ground) // 10)
    jobs: dict[str, Job] = {"barpc": (lambda: rpc.localize(image, alt), len(ground))}
    if peers.rpcm is not None:
        jobs["rpcm"] = (lambda: peers.rpcm.localization(*image[few].T, alt[few]), len(alt[few]))
    jobs["GDAL"] = (lambda: peers.gdal_localize(image[few], alt[few]), len(alt[few]))
    if peers.shareloc is not None:
        rows, cols = image[few, 1] + 0.5, image[few, 0] + 0.5
        jobs["shareloc"] = (
            lambda: peers.shareloc.direct_loc_inverse_iterative(rows, cols, alt[few], fill_nan=False),
            len(alt[few]),
        )
    report("localisation", jobs, rounds, "bound: 120 ns, 20 x rpcm")
    rng = np.random.default_rng(1)
    anywhere = rpc.image_offset + rng.uniform(-1, 1, (len(alt), 2)) * rpc.image_scale
    own = np.abs(rpc.project(rpc.localize(anywhere, alt)) - anywhere).max()
    lonlat = peers.gdal_localize(anywhere[few], alt[few])
    gdal = np.abs(rpc.project(np.column_stack([lonlat, alt[few]])) - anywhere[few]).max()
    print(f"  largest miss [px]: barpc {own:.1e} (bound 1e-9 and the rounding of degrees), GDAL {gdal:.1e}")


def jacobians(rpc: RPC, ground: np.ndarray, rounds: int) -> None:
    """Projection with its derivative; what finite differences would cost."""
    still = Corrected(rpc, Correction([0.0] * 3, [0.0] * 3, [7e6, 0.0, 0.0]))
    ecef = ecef_from_ground(ground)

    def differences() -> None:
        for axis in range(3):
            for sign in (-1.0, 1.0):
                rpc.project(ground_from_ecef(ecef + sign * np.eye(3)[axis]))

    jobs: dict[str, Job] = {
        "by lon, lat, alt": (lambda: rpc.project_jacobian(ground), len(ground)),
        "P_BA by ECEF, R and T": (lambda: still.project_ecef(ecef), len(ground)),
        "finite differences, ECEF": (differences, len(ground)),
    }
    report("projection with Jacobian", jobs, rounds, "bound: 80 ns")


def intersections(rpc: RPC, peers: Peers, rounds: int, count: int) -> None:
    """Tracks of two and three views, residuals included."""
    rng = np.random.default_rng(2)
    tilts = np.array(rpc.coeffs)
    sensors = [rpc]
    for slope in (0.03, -0.03):
        tilted = tilts.copy()
        tilted[2, 3] += slope
        sensors.append(RPC(tilted, rpc.ground_offset, rpc.ground_scale, rpc.image_offset, rpc.image_scale))
    ground = rpc.ground_offset + rng.uniform(-0.9, 0.9, (count, 3)) * rpc.ground_scale
    xy = np.stack([s.project(ground) for s in sensors], axis=1) + rng.normal(0, 0.2, (count, 3, 2))
    jobs: dict[str, Job] = {}
    middle = float(rpc.ground_offset[2])
    for views in (2, 3):
        view, point = np.tile(np.arange(views), count), np.repeat(np.arange(count), views)
        seen = xy[:, :views].reshape(-1, 2)
        jobs[f"barpc, {views} views"] = (
            lambda s=sensors[:views], v=view, p=point, o=seen: triangulate(s, v, p, o, alt=middle),
            count,
        )
    if peers.shareloc is not None:
        from shareloc.geofunctions.triangulation import sensor_triangulation
        from shareloc.geomodels import rpc as shareloc_rpc

        with tempfile.TemporaryDirectory() as folder:
            models = []
            for i, sensor in enumerate(sensors[:2]):
                write_rpc(sensor, Path(folder) / f"{i}.geom")
                models.append(shareloc_rpc.RPC.load(str(Path(folder) / f"{i}.geom")))
        matches = xy[:, :2].reshape(-1, 4) + 0.5
        jobs["shareloc, 2 views"] = (lambda: sensor_triangulation(matches, *models, residues=True), count)
    report("triangulation, a track", jobs, rounds, "bound: 3000 ns")


def main() -> None:
    """Run all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--points", type=int, default=1_000_000, help="points a call (default 1e6)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds, of which the median counts (default 5)")
    parser.add_argument("--rpc", help="image or RPC file (default: a synthetic camera)")
    parser.add_argument(
        "--python",
        default=os.environ.get("BARPC_PEER_PYTHON"),
        help="interpreter that has the peers (default: $BARPC_PEER_PYTHON, else this one)",
    )
    args = parser.parse_args()
    if (
        args.python
        and Path(args.python).absolute() != Path(sys.executable).absolute()
        and "BARPC_PEERS" not in os.environ
    ):
        own = str(Path(__file__).resolve().parents[1])
        environment = os.environ | {"PYTHONPATH": own, "BARPC_PEERS": "1"}
        sys.exit(subprocess.call([args.python, *sys.argv], env=environment))
    warnings.simplefilter("ignore")
    rpc = read_rpc(args.rpc) if args.rpc else default_rpc()
    rng = np.random.default_rng(0)
    ground = rpc.ground_offset + rng.uniform(-1, 1, (args.points, 3)) * rpc.ground_scale
    with tempfile.TemporaryDirectory() as folder:
        peers = Peers(rpc, Path(folder))
    projection(rpc, peers, ground, args.rounds)
    localisation(rpc, peers, ground, args.rounds)
    jacobians(rpc, ground, args.rounds)
    intersections(rpc, peers, args.rounds, max(args.points // 20, 1000))


if __name__ == "__main__":
    main()
