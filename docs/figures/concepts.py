"""Draw the figures of docs/concepts.md from data_samples and simulated blocks.

python docs/figures/concepts.py ADJUSTED ADJUSTED_GCP     results of barpc adjust on data_samples, without and with
                                                          --gcp data_samples/gcps.geojson
"""

from __future__ import annotations

import argparse
import json
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from barpc import RPC, read_rpc
from barpc.ba import AdjustOptions, adjust_tracks
from barpc.base.geodesy import ecef_from_ground, enu_basis
from barpc.sensor.triangulation import triangulate
from barpc.simulate import simulate_block

HERE = Path(__file__).resolve().parent
SAMPLES = HERE.parents[1] / "data_samples"
COLORS = ("#d1495b", "#2e86ab", "#3a7d44")
STYLE = {
    "svg.hashsalt": "barpc",
    "svg.fonttype": "none",
    "font.size": 10,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "figure.facecolor": "white",
}


def pyplot() -> Any:
    """matplotlib, loaded when a figure is drawn: what is only measured here does without it."""
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    mpl.rcParams |= STYLE
    return plt


def cameras(folder: Path, ending: str) -> list[RPC]:
    """The samples' cameras, as delivered or adjusted."""
    return [read_rpc(folder / f"view_{i:02}{ending}") for i in range(3)]


def save(figure: Any, name: str) -> None:
    """As SVG, the same bytes each time."""
    figure.tight_layout()
    figure.savefig(HERE / f"{name}.svg", metadata={"Date": None})
    pyplot().close(figure)


def rays(delivered: list[RPC], adjusted: list[RPC], truth: dict[str, Any]) -> None:
    """How far apart the rays of one point pass each other, over altitude."""
    point = next(p for p in truth["check_points"] if len(p["image"]) == 3)
    xy = [np.array(point["image"][f"view_{i:02}"]) for i in range(3)]
    alt = np.linspace(0, 300, 2401)
    figure, axes = pyplot().subplots(1, 2, figsize=(8.6, 3.2), sharey=True)
    for axis, name, models in zip(axes, ("as delivered", "adjusted"), (delivered, adjusted), strict=True):
        ground = [m.localize(np.broadcast_to(p, (2401, 2)), alt) for m, p in zip(models, xy, strict=True)]
        ecef = [ecef_from_ground(g) for g in ground]
        for color, (i, j) in zip(COLORS, combinations(range(3), 2), strict=True):
            gap = np.linalg.norm(ecef[i] - ecef[j], axis=1)
            axis.plot(alt, gap, color=color, label=f"views {i} and {j}: at least {gap.min():.2f} m")
        axis.set(title=name, xlabel="altitude [m]", ylim=(0, 60))
        axis.legend(fontsize=8)
    axes[0].set_ylabel("distance between two rays [m]")
    save(figure, "rays")


def errors_of_place(models: list[RPC], truth: dict[str, Any]) -> np.ndarray:
    """Triangulated check points minus true ones, east, north, up [m]."""
    points = truth["check_points"]
    rows = [
        (i, k, p["image"][f"view_{i:02}"])
        for k, p in enumerate(points)
        for i in range(3)
        if f"view_{i:02}" in p["image"]
    ]
    view, point, xy = (np.array(column) for column in zip(*rows, strict=True))
    ground = np.array([p["ground"] for p in points])
    found = triangulate(models, view, point, xy)
    return ((found.points - ecef_from_ground(ground)) @ enu_basis(ground.mean(axis=0)).T)[found.ok]


def gauge(steps: dict[str, list[RPC]], truth: dict[str, Any]) -> None:
    """Shape and place: what tie points repair and what only ground control does."""
    figure, axes = pyplot().subplots(1, 2, figsize=(8.6, 3.0))
    errors = {name: errors_of_place(models, truth) for name, models in steps.items()}
    shape = [np.linalg.norm((e - e.mean(axis=0)).std(axis=0)) for e in errors.values()]
    place = [np.linalg.norm(e.mean(axis=0)) for e in errors.values()]
    for axis, title, values in zip(
        axes, ("shape: RMS about the mean", "place: mean error"), (shape, place), strict=True
    ):
        bars = axis.bar(list(steps), values, color=COLORS)
        axis.bar_label(bars, [f"{v:.3g} m" for v in values])
        axis.set(title=title, yscale="log", ylim=(1e-3, 1e3), ylabel="metres")
    save(figure, "gauge")
    print("shape", shape, "place", place)


def tie_points() -> None:
    """What noise, number and false matches do to cameras, measured on points that the adjustment does not see."""
    figure, axes = pyplot().subplots(1, 2, figsize=(8.6, 3.2))
    counts = (20, 50, 150, 500, 1500)
    for color, noise in zip(COLORS, (0.3, 0.1, 0.03), strict=True):
        rms = [held_out(count, noise, 0.0) for count in counts]
        axes[0].loglog(counts, rms, "o-", color=color, label=f"noise {noise} px")
    axes[0].set(title="noise and number", xlabel="tie points", ylabel="error of the cameras [px]")
    shares = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4)
    rms = [held_out(500, 0.1, share) for share in shares]
    axes[1].semilogy([100 * s for s in shares], rms, "o-", color=COLORS[0], label="robust")
    axes[1].set(title="false matches", xlabel="false observations [%]")
    for axis in axes:
        axis.legend(fontsize=8)
    save(figure, "tie_points")


def held_out(count: int, noise: float, outliers: float) -> float:
    """Median error of adjusted cameras over five blocks of three views [px]."""
    rms = []
    for seed in range(5):
        block = simulate_block(3, count, seed=seed, noise=noise, outliers=outliers)
        options = AdjustOptions(noise_floor=0.0)
        rms.append(block.held_out_rms(list(adjust_tracks(block.views, block.tracks, options).sensors)))
    print(count, noise, outliers, np.median(rms))
    return float(np.median(rms))


def main() -> None:
    """Draw all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("adjusted", type=Path)
    parser.add_argument("adjusted_gcp", type=Path)
    arguments = parser.parse_args()
    truth = json.loads((SAMPLES / "truth.json").read_text(encoding="utf-8"))
    delivered, adjusted = cameras(SAMPLES, ".tif"), cameras(arguments.adjusted, ".vrt")
    rays(delivered, adjusted, truth)
    steps = {
        "delivered": delivered,
        "tie points": adjusted,
        "and 5 GCPs": cameras(arguments.adjusted_gcp, ".vrt"),
    }
    gauge(steps, truth)
    tie_points()


if __name__ == "__main__":
    main()
