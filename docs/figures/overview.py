"""Draw docs/figures/overview.png: epipolar lines in the samples before and after `barpc adjust`.

    python docs/figures/overview.py adjusted

where `adjusted` is the result of `barpc adjust data_samples/*.tif -o adjusted`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import rasterio

from barpc import read_rpc
from barpc.pipeline import load_views
from barpc.tie import find_tracks

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"
HALF = 28


def patch(image, x, y):
    """A window about a point, stretched to 0..1, and its corner."""
    c, r = round(x), round(y)
    pixels = image[r - HALF : r + HALF + 1, c - HALF : c + HALF + 1]
    low, high = np.percentile(pixels, [1, 99])
    return np.clip((pixels - low) / (high - low), 0, 1), (c - HALF, r - HALF)


def main(adjusted: str) -> None:
    """Draw the figure from the samples and the run in `adjusted`."""
    loaded = load_views(sorted(SAMPLES.glob("*.tif")))
    tracks = find_tracks(loaded.views).tracks
    images = []
    for view in loaded.views:
        with rasterio.open(view.path) as dataset:
            images.append(dataset.read(1).astype(float))
    after = [read_rpc(Path(adjusted) / f"{view.name}.vrt") for view in loaded.views]
    before = [view.sensor for view in loaded.views]
    three = np.flatnonzero(np.bincount(tracks.point) == 3)
    rows = {p: np.flatnonzero(tracks.point == p) for p in three}
    a, b = 0, 2
    inside = [
        p
        for p in three
        if all((abs(tracks.xy[rows[p]] - 500) < 380).all(axis=1)) and np.ptp(tracks.xy[rows[p]], axis=0).max() < 60
    ]
    strong = sorted(inside, key=lambda p: -np.std(patch(images[a], *tracks.xy[rows[p][a]])[0]))
    picks = [strong[i] for i in (0, 40, 90, 150)]
    figure, axes = plt.subplots(3, len(picks), figsize=(9.2, 7.1), facecolor="white")
    titles = ("a tie point in view_00", "view_02, cameras as delivered", "view_02, after barpc adjust")
    for column, p in enumerate(picks):
        xa, xb = tracks.xy[rows[p][a]], tracks.xy[rows[p][b]]
        for row, (view, at, cameras, color) in enumerate(
            ((a, xa, None, "#ffd23f"), (b, xb, before, "#ff5a5f"), (b, xb, after, "#3ddc97"))
        ):
            axis = axes[row, column]
            pixels, (c0, r0) = patch(images[view], *at)
            axis.imshow(
                pixels,
                cmap="gray",
                interpolation="nearest",
                extent=(c0 - 0.5, c0 + 2 * HALF + 0.5, r0 + 2 * HALF + 0.5, r0 - 0.5),
            )
            axis.plot(*at, "+", color="#ffd23f", ms=13, mew=2)
            if cameras is not None:
                alt = np.linspace(0, 700, 60)
                line = cameras[b].project(cameras[a].localize(np.broadcast_to(xa, (60, 2)), alt))
                axis.plot(*line.T, color=color, lw=2.2)
            axis.set(
                xlim=(c0 - 0.5, c0 + 2 * HALF + 0.5),
                ylim=(r0 + 2 * HALF + 0.5, r0 - 0.5),
                xticks=[],
                yticks=[],
            )
            if column == 0:
                axis.set_ylabel(titles[row], fontsize=10)
    figure.tight_layout(pad=0.6)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main(sys.argv[1])
