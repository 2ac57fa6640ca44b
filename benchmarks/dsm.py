"""A first surface: how much of the ground has a height, how well pairs agree, what it costs.

For each run of `barpc adjust` the surface of its corrected cameras and, with the same altitudes, that of the images as
delivered:
  cells   with a height, and the share of the pixels that both images of a pair show that was matched
  nmad    disagreement of the pairs in a cell, median [m]; - of a single pair
  against the same of heights minus another tool's DSM (`--against`, of s2p or CARS), with the share of its cells
  CPU     seconds a million pixels of the smaller image of a pair, and the peak memory [MB]

python benchmarks/dsm.py RUN... [--against DSM] [--rendered SIDE [--kinds]] [--triplets SIDE]

`--rendered` makes images of SIDE px of a scene whose ground is known: nmad is of heights minus the truth, and `within`
the share of cells within one sigma. `--kinds`: of scenes that differ in slopes, buildings, noise, pixel and dates.
`--triplets`: of three views of each kind the share of the cells that are more than 10 pixels off all ground within a
cell (5 m of 0.5 m), by the median of all pairs and by that of those that agree; and of the cells that are void for it.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np
import rasterio
from rasterio.warp import Resampling, reproject
from rasterio.windows import Window
from scipy.ndimage import maximum_filter, minimum_filter

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from barpc.base.verb_options import DsmOptions
from barpc.dsm import stereo
from barpc.dsm.stereo import NoSurfaceError, Tile, block_of_images, gathered, surface_tile
from barpc.dsm.surface import Grid, make_dsm
from barpc.export.shots import read_scene
from tests.scenes import ImageOptions, Scene
from tests.scenes.files import image_file

LOOKED_AT = 40
"""Tiles of a rendered surface that are compared with the ground, at most."""
KINDS: dict[str, dict[str, object]] = {
    "usual": {},
    "flat": {"relief": 12.0, "buildings": 2.0, "seed": 3},
    "steep": {"relief": 300.0, "buildings": 4.0, "seed": 4},
    "town": {"relief": 20.0, "buildings": 25.0, "seed": 6},
    "noisy": {"relief": 30.0, "snr": 30.0, "seed": 7},
    "clean": {"relief": 30.0, "snr": 400.0, "seed": 8},
    "bare": {"buildings": 0.0, "seed": 10},
    "coarse": {"gsd": 2.0, "relief": 200.0, "buildings": 1.0, "seed": 12},
    "dark": {"relief": 30.0, "snr": 8.0, "seed": 17},
    "two dates": {"relief": 30.0, "sun_azimuth": (150.0, 190.0), "change": 0.3, "seed": 13},
}
"""Kinds of scenes, by what differs from `tests.scenes.ImageOptions`."""


def nmad(values: np.ndarray) -> float:
    """Robust spread of what is finite."""
    known = values[np.isfinite(values)]
    return 1.4826 * float(np.median(np.abs(known - np.median(known)))) if len(known) else float("nan")


def against(path: Path, other: Path) -> tuple[float, float]:
    """NMAD of heights minus those of another DSM [m], and the share of its cells that have one here."""
    with rasterio.open(path) as ours, rasterio.open(other) as theirs:
        heights = np.full((ours.height, ours.width), np.nan, np.float32)
        given = {"src_nodata": theirs.nodata, "dst_nodata": np.nan, "resampling": Resampling.nearest}
        reproject(rasterio.band(theirs, 1), heights, dst_transform=ours.transform, dst_crs=ours.crs, **given)
        own = ours.read(1)
    both = np.isfinite(own) & np.isfinite(heights)
    return nmad((own - heights)[both]), float(both.sum() / max(np.isfinite(heights).sum(), 1))


def measure(source: str | list[str], alt: tuple[float, float] | None, other: Path | None) -> dict[str, object]:
    """One surface."""
    with tempfile.TemporaryDirectory() as folder:
        out, start = Path(folder) / "dsm.tif", time.process_time()
        surface = make_dsm(source, out, DsmOptions(alt=alt))
        cpu = time.process_time() - start
        found = {"cells": surface.known, "pairs": len(surface.pairs), "share": surface.share}
        found |= {"nmad": surface.nmad, "sigma": surface.sigma, "cpu": cpu}
        if other is not None:
            found["against"] = against(out, other)
    return found | {"peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def written(scene: Scene, index: int, path: Path) -> np.ndarray:
    """Render a view into a file, part by part; the altitudes that it shows, on the disk, too."""
    size, rpc = scene.options.size, scene.shots[index].exact_rpc
    shown = np.lib.format.open_memmap(path.with_suffix(".npy"), "w+", np.float32, size[::-1])
    with image_file(path, size, rpc) as file:
        for top, part in scene.strips(index):
            file.write(part.numbers, 1, window=Window(0, top, *part.numbers.shape[::-1]))
            shown[top : top + len(part.altitude)] = part.altitude
    return shown


class Ground:
    """Rendered images of a kind with exact cameras, in a folder, and the ground that they show."""

    def __init__(self, side: int, kind: str, folder: Path, views: int = 2) -> None:
        scene = Scene(ImageOptions(views=views, size=(side, side), **KINDS[kind]))
        self.shots, self.paths = scene.shots, [str(folder / f"{shot.name}.tif") for shot in scene.shots]
        self.shown = [written(scene, i, Path(path)) for i, path in enumerate(self.paths)]
        edges = [(np.nanmin(part), np.nanmax(part)) for one in self.shown for part in np.array_split(one, 8)]
        self.alt = float(np.min(edges)) - 10.0, float(np.max(edges)) + 10.0

    def truth(self, tile: Tile) -> np.ndarray:
        """Median altitude of what the images show in each cell; through the exact pushbroom cameras."""
        corners = np.vstack([np.column_stack([tile.nodes(), np.full(25, alt)]) for alt in self.alt])
        ground = []
        for shot, shown in zip(self.shots, self.shown, strict=True):
            at = shot.exact.project(corners)
            low, high = (np.clip(edge, 0, len(shown)).astype(int) for edge in (at.min(axis=0), at.max(axis=0) + 2))
            part = np.array(shown[low[1] : high[1], low[0] : high[0]])
            row, col = np.nonzero(np.isfinite(part))
            place = np.column_stack([col, row]) + low.astype(np.float64)
            ground.append(shot.exact.localize(place, part[row, col].astype(np.float64)))
        every = np.concatenate(ground)
        return gathered(tile, tile.on_map(every), np.ones(len(every)))[0]


def rendered(side: int, kind: str = "usual") -> dict[str, object]:
    """The surface of a pair of rendered images against the ground that they show, in up to `LOOKED_AT` tiles of it."""
    with tempfile.TemporaryDirectory() as folder:
        made = Ground(side, kind, Path(folder))
        out, call = Path(folder) / "dsm.tif", json.dumps([made.paths, made.alt])
        code = (
            "import json,sys,time; from barpc.dsm.surface import make_dsm\n"
            "from barpc.base.verb_options import DsmOptions\n"
            "paths, alt = json.loads(sys.argv[1]); start = time.process_time()\n"
            "make_dsm(paths, sys.argv[2], DsmOptions(alt=tuple(alt))); cpu = time.process_time() - start\n"
            "print(cpu, open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
        )
        done = subprocess.run([sys.executable, "-c", code, call, str(out)], capture_output=True, text=True, check=True)
        cpu, peak = map(float, done.stdout.split())  # (what getrusage says is the parent's, where that was larger)
        with rasterio.open(out) as file:
            windows = [window for _, window in file.block_windows(1)]
            known, errors, sigmas = int(np.isfinite(file.read(1)).sum()), [], []
            for window in windows[:: -(-len(windows) // LOOKED_AT)]:
                place, size = file.window_transform(window), (window.width, window.height)
                tile = Tile(file.crs.to_wkt(), place.c, place.f, place.a, size, (0.0, 1.0))
                height, sigma = file.read([1, 4], window=window)
                error = height - made.truth(tile)
                errors.append(error[np.isfinite(error)])
                sigmas.append(sigma[np.isfinite(error)])
        error = np.concatenate(errors)
        within = float(np.mean(np.abs(error) < np.concatenate(sigmas)))
        found = {"cells": known, "nmad": nmad(error), "within": within, "cpu": cpu}
        return found | {"peak": peak / 1024, "tiles": len(windows)}


def triplet(side: int, kind: str) -> tuple[float, float, float]:
    """Shares of wrong cells by the median of all pairs and of those that agree, and of the cells that are void."""
    with tempfile.TemporaryDirectory() as folder:
        made = Ground(side, kind, Path(folder), views=3)
        block, found = block_of_images(made.paths, made.alt, 1), []
        for _, tile, (group,) in Grid(block, DsmOptions(alt=made.alt)).tiles:
            truth, pairs = made.truth(tile), [(block.views[i], block.views[j]) for i, j in group]
            low = minimum_filter(np.where(np.isfinite(truth), truth, np.inf), 3) - 5.0 * tile.step
            high = maximum_filter(np.where(np.isfinite(truth), truth, -np.inf), 3) + 5.0 * tile.step
            agreeing = surface_tile(pairs, tile, 1)[0]
            with patch.object(stereo, "consensus", lambda heights, _: np.isfinite(heights)):
                every = surface_tile(pairs, tile, 1)[0]
            found += [(one[at], low[at], high[at]) for one in (every, agreeing) for at in [np.isfinite(one + truth)]]
        both = [[np.concatenate(part) for part in zip(*found[k::2], strict=True)] for k in range(2)]
        wrong = [float(np.mean((one < low) | (one > high))) for one, low, high in both]
        return wrong[0], wrong[1], 1.0 - len(both[1][0]) / len(both[0][0])


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--rendered", type=int)
    parser.add_argument("--kinds", action="store_true")
    parser.add_argument("--triplets", type=int)
    arguments = parser.parse_args()
    for run in arguments.runs:
        views = json.loads((run / "summary.json").read_text())["views"]
        smallest = min(w * h for w, h in (view["size"] for view in views)) / 1e6
        after = measure(str(run), None, arguments.against)
        paths = [str(run / view["path"]) for view in views]
        try:
            before = measure(paths, read_scene(run).alt_range, arguments.against)
        except NoSurfaceError as error:
            print(f"{run.name:12}{'delivered':11}{error}")
            before = None
        for name, row in (("corrected", after), ("delivered", before)):
            if row is None:
                continue
            cost = row["cpu"] / (smallest * row["pairs"])
            more = "" if "against" not in row else " against {:.2f} m, {:.1%} of its cells".format(*row["against"])
            print(
                f"{run.name:12}{name:11}{row['pairs']} pairs {row['cells']:8} cells {row['share']:6.1%} matched "
                f"nmad {row['nmad']:.2f} m sigma {row['sigma']:.2f} m {cost:5.1f} CPU s/Mpx {row['peak']:.0f} MB{more}"
            )
    for kind in KINDS if arguments.triplets else ():
        every, agreeing, lost = triplet(arguments.triplets, kind)
        words = f"wrong {every:.2%} by all pairs, {agreeing:.2%} by those that agree, {lost:.2%} void"
        print(f"triplet {arguments.triplets} px, {kind}: {words}", flush=True)
    for kind in (KINDS if arguments.kinds else ["usual"]) if arguments.rendered else ():
        row, area = rendered(arguments.rendered, kind), arguments.rendered**2 / 1e6
        print(
            f"rendered {arguments.rendered} px, {kind}: {row['tiles']} tiles, {row['cells']} cells, "
            f"nmad {row['nmad']:.2f} m, within sigma {row['within']:.1%}, {row['cpu'] / area:.1f} CPU s/Mpx, "
            f"{row['peak']:.0f} MB",
            flush=True,
        )


if __name__ == "__main__":
    main()
