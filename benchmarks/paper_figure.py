"""The paper's two experiments redrawn: error against the area of a crop and against the grid length, beside rpcfit.

Area: squares around the middle of the image, up to its shorter side, 50 x 50 x 10 control points in each. Grid length:
n x n x 10 points over the whole image. Check points lie in the middle of the control points' cells. Optical: every
vendor's RPC behind 30 microradians and 10 m. Radar: the paper's Sentinel-1 points (20 x 20 x 10 at most), cut around
their middle or thinned, on its own test points; and the fifteen swaths of five Sentinel-1 images, alone and mosaicked
to whole images, their parts of the same shape. RMSE over col and row: a thin line a file, mean and standard deviation.

    python benchmarks/paper_figure.py --data DATA --rpcfit SITE_PACKAGES -o docs/figures/paper_figure.svg
    python benchmarks/paper_figure.py --data DATA --rpcfit SITE_PACKAGES --sensors swaths
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from barpc.base.errors import FitError
from barpc.base.geodesy import Array
from barpc.fit import FitOptions, fit_rpc_points
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC
from barpc.sensor.sentinel1 import Annotation, RangeDoppler, mosaic, read_annotation
from benchmarks.fit import Peer, Space, grid_of, rms
from tests.fit.cameras import Camera, vendor

LENGTHS = (5, 7, 10, 15, 20, 30, 40, 50)
SHARES = (0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
SENSORS = ["optical", "points", "single", "swaths"]
LONGEST, RADAR_LENGTH = 50, 20
"""Grid lengths of the paper's experiment on areas, and of its radar points."""
Fit = Callable[[Array, Array], RPC]
Points = tuple[Array, Array, Array, Array]


def paper(ground: Array, image: Array) -> RPC:
    """The paper's solver as kept here."""
    options = FitOptions(tolerance=10.0, method="lcurve-joint")
    return fit_rpc_points(ground, image, options=options, strict=False).rpc


def ours(ground: Array, image: Array) -> RPC:
    """The default fit."""
    return fit_rpc_points(ground, image, options=FitOptions(tolerance=10.0), strict=False).rpc


@dataclass(frozen=True)
class Window:
    """A camera whose image begins at `corner` [px] of another's."""

    model: SensorModel
    corner: Array

    def project(self, ground: Array) -> Array:
        """Image points (..., 2) [px] of ground points (..., 3)."""
        return self.model.project(ground) - self.corner

    def localize(self, image: Array, alt: Array) -> Array:
        """Ground points (..., 3) of image points (..., 2) [px] at altitudes (...)."""
        return self.model.localize(image + self.corner, alt)


def optical(camera: Camera, length: int, share: float | None) -> Points:
    """Control and check points of a square around the middle, or of the whole image."""
    if share is not None:
        side = max(1, round(min(camera.size) * np.sqrt(share)))
        corner = np.floor((np.array(camera.size) - side) / 2)
        camera = replace(camera, size=(side, side), model=Window(camera.model, corner))
    return grid_of(camera, (length, length, 10))


@dataclass(frozen=True)
class Swaths:
    """The mosaic of three swaths."""

    name: str
    model: SensorModel
    size: tuple[int, int]
    alt_range: tuple[float, float]


def three_swaths(data: Path, altitudes: tuple[float, float] | None = None) -> list[Swaths]:
    """Every whole image of three swaths, over the altitudes of its scene, or others."""
    products: dict[str, list[Annotation]] = {}
    for path in sorted((data / "radar" / "s1_three_swaths").glob("*_iw?.xml")):
        products.setdefault(path.stem[17:48], []).append(read_annotation(path))
    models = {name: mosaic(swaths) for name, swaths in products.items()}
    return [Swaths(name, m, m.size, altitudes or m.alt_range) for name, m in models.items()]


def single_swaths(data: Path, altitudes: tuple[float, float] | None = None) -> list[Swaths]:
    """Every swath of these images alone."""
    found = []
    for path in sorted((data / "radar" / "s1_three_swaths").glob("*_iw?.xml")):
        model = RangeDoppler.from_annotation(read_annotation(path))
        found.append(Swaths(path.stem[17:], model, model.size, altitudes or model.alt_range))
    return found


def swath(camera: Swaths, length: int, share: float | None, space: Space) -> Points:
    """Control and check points of a part of the image around its middle, or of all of it."""
    full = np.array(camera.size)
    part = np.round(full * np.sqrt(share or 1.0)).astype(int)
    corner = np.floor((full - part) / 2)
    cut = replace(camera, size=(int(part[0]), int(part[1])), model=Window(camera.model, corner))
    return grid_of(cut, (length, length, 10), space)


def radar(data: Path, length: int, share: float | None) -> Points:
    """The paper's points: thinned to a length, cut to a part of the swath around its middle."""
    ground, image, check, truth = (
        np.load(data / "sar" / "rpcfit" / f"s1_{part}{d}d.npy") for part in ("train", "test") for d in (3, 2)
    )
    low, high = ground[:, :2].min(axis=0), ground[:, :2].max(axis=0)
    half = 0.5 * (high - low) * np.sqrt(share or 1.0) + 1e-9
    lines = [np.unique(ground[:, i].round(9)) for i in (0, 1)]
    middle = 0.5 * (low + high)
    lines = [line[np.abs(line - middle[i]) <= half[i]] for i, line in enumerate(lines)]
    wanted = [line[np.unique(np.linspace(0, len(line) - 1, min(length, len(line))).astype(int))] for line in lines]
    used = np.all([np.isin(ground[:, i].round(9), wanted[i]) for i in (0, 1)], axis=0)
    inside = np.all(np.abs(check[:, :2] - middle) <= half, axis=1)
    return ground[used], image[used], check[inside], truth[inside]


def error(fit: Fit, points: Points) -> float:
    """RMSE [px] over col and row of the check points; NaN where the fit fails."""
    ground, image, check, truth = points
    try:
        return float(np.sqrt((rms(fit(ground, image).project(check) - truth) ** 2).mean()))
    except (FitError, ValueError, np.linalg.LinAlgError):
        return float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of vendors' RPC files and radar points")
    parser.add_argument("--rpcfit", metavar="DIR", help="site-packages folder that holds rpcfit")
    parser.add_argument("--every", type=int, default=1, help="take every so many optical files")
    parser.add_argument("--sensors", nargs="+", default=SENSORS, choices=SENSORS, help="which of these")
    parser.add_argument("--altitudes", nargs=2, type=float, help="of the three swaths, in place of the scene's [m]")
    parser.add_argument("--space", choices=("image", "ground"), default="image", help="grids of the three swaths")
    parser.add_argument("--longest", type=int, default=LONGEST, help="largest grid length")
    parser.add_argument("-o", "--output", type=Path, help="figure to write (svg, png)")
    args = parser.parse_args()
    cameras = vendor(args.data)[:: args.every] if "optical" in args.sensors else []
    altitudes = args.altitudes and tuple(args.altitudes)
    kinds = {"three swaths": ("swaths", three_swaths), "one swath": ("single", single_swaths)}
    images = {kind: make(args.data, altitudes) for kind, (name, make) in kinds.items() if name in args.sensors}
    fits: dict[str, Fit] = {"barpc": ours, "barpc, lcurve-joint": paper}
    if args.rpcfit:
        fits["rpcfit"] = Peer(args.rpcfit).fit
    lengths = [n for n in LENGTHS if n <= args.longest]
    sweeps: dict[str, tuple[list[tuple[int, float | None]], list[float]]] = {
        "area [% of the largest square]": ([(args.longest, s) for s in SHARES], [100 * s for s in SHARES]),
        "grid length": ([(n, None) for n in lengths], list(map(float, lengths))),
    }
    results: dict[tuple[str, str, str], Array] = {}
    for sweep, (settings, values) in sweeps.items():
        for name, fit in fits.items():
            found: dict[str, tuple[list[list[float]], list[str]]] = {}
            if cameras:
                errors = [[error(fit, optical(c, n, s)) for c in cameras] for n, s in settings]
                found["optical"] = errors, [c.name for c in cameras]
            if "points" in args.sensors:
                errors = [
                    [error(fit, radar(args.data, n, s))] if s or n <= RADAR_LENGTH else [np.nan] for n, s in settings
                ]
                found["Sentinel-1"] = errors, ["points"]
            for kind, models in images.items():
                errors = [[error(fit, swath(c, n, s, args.space)) for c in models] for n, s in settings]
                found[kind] = errors, [c.name for c in models]
            for sensor, (table, names) in found.items():
                results[sensor, sweep, name] = np.array(table)
                tell(f"{sensor}, {sweep}, {name}", values, np.array(table), names)
    if args.output:
        draw(results, {name: xs for name, (_, xs) in sweeps.items()}, args.output)


def tell(what: str, values: list[float], table: Array, names: list[str]) -> None:
    """A line a setting; which file makes the mean."""
    print(f"{what}: rmse [px] over {table.shape[1]} file(s)", flush=True)
    for value, row in zip(values, table, strict=True):
        good = row[np.isfinite(row)]
        if not len(good):
            continue
        worst = f"  worst {good.max():.2e} ({names[int(np.nanargmax(row))]})" if len(row) > 1 else ""
        missing = f"  ({len(good)} ok)" if len(good) < len(row) else ""
        print(
            f"  {value:6.0f}  mean {good.mean():.2e} sd {good.std():.2e} median {np.median(good):.2e}{worst}{missing}"
        )


def draw(results: dict[tuple[str, str, str], Array], axes: dict[str, list[float]], output: Path) -> None:
    """A panel a sensor and sweep: files as thin lines, their mean, a band of one standard deviation on either side."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "barpc"
    import matplotlib.pyplot as plt

    sensors = list(dict.fromkeys(sensor for sensor, _, _ in results))
    figure, panels = plt.subplots(
        len(sensors), 2, figsize=(8.5, 3.0 * len(sensors)), sharey="row", layout="constrained", squeeze=False
    )
    colors = {"barpc": "tab:blue", "barpc, lcurve-joint": "tab:green", "rpcfit": "tab:red"}
    for (sensor, sweep, name), value in results.items():
        panel = panels[sensors.index(sensor), list(axes).index(sweep)]
        rows = np.ma.masked_invalid(value)
        mean, spread = rows.mean(axis=1), rows.std(axis=1)
        panel.plot(axes[sweep], mean, color=colors[name], label=f"{name}, mean", marker=".", linewidth=2)
        if value.shape[1] > 1:
            panel.plot(axes[sweep], rows, color=colors[name], alpha=0.35, linewidth=0.5)
            low = np.maximum(mean - spread, rows.min())
            panel.fill_between(axes[sweep], low, mean + spread, color=colors[name], alpha=0.12, linewidth=0)
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
