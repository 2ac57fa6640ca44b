"""The paper's experiments redrawn: error against grid length and against area, barpc beside rpcfit.

Grid length 5 to 50 over the full image, and 5 to 100 % of the area at grid length 10, ten altitude layers
(six for the radar). Optical: vendors' RPCs behind 30 microradians and 10 m, a subset that rpcfit survives.
Radar: the paper's Sentinel-1 points, thinned or cut. RMSE on check points: mean over files, band from the
smallest to the largest.

    python benchmarks/paper_figure.py --data DATA --rpcfit SITE_PACKAGES -o docs/figures/paper_figure.svg
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from barpc.errors import FitError
from barpc.fit import FitOptions, fit_rpc_points
from barpc.geodesy import Array
from barpc.sensor.rpc import RPC
from benchmarks.fit import PECULIAR, Peer, grid_of, rms
from tests.fit.cameras import Camera, vendor

LENGTHS = (5, 7, 10, 15, 20, 30, 40, 50)
SHARES = (0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
RADAR_LENGTH = 20
"""Grid length of the paper's radar points."""
Fit = Callable[[Array, Array], RPC]
Points = tuple[Array, Array, Array, Array]


def ours(ground: Array, image: Array) -> RPC:
    """The default fit."""
    return fit_rpc_points(ground, image, options=FitOptions(tolerance=10.0), strict=False).rpc


def optical(camera: Camera, length: int, share: float) -> Points:
    """Control and check points of a part of an image."""
    width, height = (max(1, round(n * np.sqrt(share))) for n in camera.size)
    return grid_of(replace(camera, size=(width, height)), (length, length, 10))


def radar(data: Path, length: int, share: float) -> Points:
    """The paper's control points (20 x 20 x 10), thinned to a length and cut to a part of the swath."""
    ground, image, check, truth = (
        np.load(data / "sar" / "rpcfit" / f"s1_{part}{d}d.npy") for part in ("train", "test") for d in (3, 2)
    )
    low, high = ground[:, :2].min(axis=0), ground[:, :2].max(axis=0)
    edge = low + (high - low) * np.sqrt(share) + 1e-9
    lines = [np.unique(ground[:, i].round(9)) for i in (0, 1)]
    lines = [line[line <= edge[i]] for i, line in enumerate(lines)]
    wanted = [
        line[np.unique(np.linspace(0, len(line) - 1, min(length, len(line))).astype(int))] for line in lines
    ]
    used = np.all([np.isin(ground[:, i].round(9), wanted[i]) for i in (0, 1)], axis=0)
    inside = np.all(check[:, :2] <= edge, axis=1)
    return ground[used], image[used], check[inside], truth[inside]


def errors(fit: Fit, points: Points) -> Array:
    """RMSE of col, row on the check points; NaN where the fit fails."""
    ground, image, check, truth = points
    try:
        return rms(fit(ground, image).project(check) - truth)
    except (FitError, ValueError, np.linalg.LinAlgError):
        return np.full(2, np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, required=True, help="folder of vendors' RPC files and radar points"
    )
    parser.add_argument("--rpcfit", metavar="DIR", help="site-packages folder that holds rpcfit")
    parser.add_argument("--files", type=int, default=6, help="optical files, spread over all")
    parser.add_argument("--longest", type=int, default=50, help="largest grid length")
    parser.add_argument("-o", "--output", type=Path, help="figure to write (svg, png)")
    args = parser.parse_args()
    cameras = [camera for camera in vendor(args.data) if camera.name != PECULIAR]
    cameras = cameras[:: max(1, len(cameras) // args.files)][: args.files]
    fits: dict[str, Fit] = {"barpc": ours}
    if args.rpcfit:
        fits["rpcfit"] = Peer(args.rpcfit).fit
    lengths = [n for n in LENGTHS if n <= args.longest]
    sweeps = {
        "grid length": ([(n, 1.0) for n in lengths], lengths),
        "area [%]": ([(10, s) for s in SHARES], [100 * s for s in SHARES]),
    }
    results: dict[tuple[str, str, str], Array] = {}
    for sweep, (settings, _) in sweeps.items():
        for name, fit in fits.items():
            table = [[errors(fit, optical(c, n, s)) for c in cameras] for n, s in settings]
            results["optical", sweep, name] = np.array(table)
            table = [
                [errors(fit, radar(args.data, n, s)) if n <= RADAR_LENGTH else np.full(2, np.nan)]
                for n, s in settings
            ]
            results["Sentinel-1", sweep, name] = np.array(table)
    for (sensor, sweep, name), value in results.items():
        print(f"{sensor}, {sweep}, {name}: mean rmse [px] over {value.shape[1]} file(s)")
        for x, rows in zip(sweeps[sweep][1], value, strict=True):
            good = rows[np.isfinite(rows).all(axis=1)]
            col, row = good.mean(axis=0) if len(good) else (np.nan, np.nan)
            print(
                f"  {x:6.0f}  row {row:.2e}  col {col:.2e}"
                + ("" if len(good) == len(rows) else f"  ({len(good)} ok)")
            )
    if args.output:
        draw(results, {name: xs for name, (_, xs) in sweeps.items()}, args.output)


def draw(results: dict[tuple[str, str, str], Array], axes: dict[str, list[float]], output: Path) -> None:
    """A panel a sensor and sweep; solid lines rows, dashed lines columns, bands over the files."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "barpc"
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, 2, figsize=(8.5, 6.0), sharey="row", layout="constrained")
    colors = {"barpc": "tab:blue", "rpcfit": "tab:red"}
    for (sensor, sweep, name), value in results.items():
        panel = panels[["optical", "Sentinel-1"].index(sensor), list(axes).index(sweep)]
        for axis, style in ((1, "-"), (0, "--")):
            rows = np.ma.masked_invalid(value[..., axis])
            mean, low, high = rows.mean(axis=1), rows.min(axis=1), rows.max(axis=1)
            label = f"{name} {'row' if axis else 'col'}"
            panel.plot(axes[sweep], mean, style, color=colors[name], label=label, marker=".")
            if value.shape[1] > 1:
                panel.fill_between(axes[sweep], low, high, color=colors[name], alpha=0.12, linewidth=0)
        panel.set_yscale("log")
        panel.set_title(sensor)
        panel.set_xlabel(sweep)
        panel.grid(alpha=0.3)
    for row in panels:
        row[0].set_ylabel("RMSE on check points [px]")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4)
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, metadata={"Date": None} if output.suffix == ".svg" else None)


if __name__ == "__main__":
    main()
