"""A first surface: how much of the ground has a height, how well pairs agree, what it costs.

For each run of `barpc adjust` the surface of its corrected cameras and, with the same altitudes, that of the images as
delivered:
  cells   with a height, and the share of the pixels that both images of a pair show that was matched
  nmad    disagreement of the pairs in a cell, median [m]; - of a single pair
  against the same of heights minus another tool's DSM (`--against`, of s2p or CARS), with the share of its cells
  CPU     seconds a million pixels of the smaller image of a pair, and the peak memory [MB]

python benchmarks/dsm.py RUN... [--against DSM] [--rendered SIDE [--kinds]]

`--rendered` makes images of SIDE px of a scene whose ground is known: nmad is of heights minus the truth, and `within`
the share of cells within one sigma. `--kinds`: of scenes that differ in slopes, buildings, noise, pixel and dates.
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

import numpy as np
import rasterio
from rasterio.warp import Resampling, reproject

from barpc.dsm import NoSurfaceError, make_dsm
from barpc.export.shots import read_scene
from barpc.options import DsmOptions

KINDS: dict[str, dict[str, object]] = {
    "usual": {},
    "flat": {"relief": 12.0, "buildings": 2.0, "seed": 3},
    "steep": {"relief": 300.0, "buildings": 4.0, "seed": 4},
    "town": {"relief": 20.0, "buildings": 25.0, "seed": 6},
    "noisy": {"relief": 30.0, "snr": 30.0, "seed": 7},
    "clean": {"relief": 30.0, "snr": 400.0, "seed": 8},
    "bare": {"buildings": 0.0, "seed": 10},
    "coarse": {"gsd": 2.0, "relief": 200.0, "buildings": 1.0, "seed": 12},
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


def rendered(side: int, kind: str = "usual") -> dict[str, object]:
    """A pair of rendered images of a kind with exact cameras, against the ground that they show."""
    from tests.dsm.conftest import Rendered
    from tests.scenes import ImageOptions, Scene

    with tempfile.TemporaryDirectory() as folder:
        made = Rendered(Scene(ImageOptions(views=2, size=(side, side), **KINDS[kind])), Path(folder)).write()
        shown = [picture.altitude for picture in made.pictures]
        alt = min(map(np.nanmin, shown)) - 10.0, max(map(np.nanmax, shown)) + 10.0
        out, call = Path(folder) / "dsm.tif", json.dumps([made.paths, [float(one) for one in alt]])
        code = (
            "import json,sys,time; from barpc.dsm import make_dsm; from barpc.options import DsmOptions\n"
            "paths, alt = json.loads(sys.argv[1]); start = time.process_time()\n"
            "make_dsm(paths, sys.argv[2], DsmOptions(alt=tuple(alt))); cpu = time.process_time() - start\n"
            "print(cpu, open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
        )
        done = subprocess.run([sys.executable, "-c", code, call, str(out)], capture_output=True, text=True, check=True)
        cpu, peak = map(float, done.stdout.split())  # (what getrusage says is the parent's, where that was larger)
        with rasterio.open(out) as file:
            height, sigma = file.read(1), file.read(4)
        error = height - made.truth(out)
        known = np.isfinite(error)
        within = float(np.mean(np.abs(error[known]) < sigma[known]))
        return {
            "cells": int(known.sum()),
            "nmad": nmad(error),
            "within": within,
            "cpu": cpu,
            "peak": peak / 1024,
        }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--rendered", type=int)
    parser.add_argument("--kinds", action="store_true")
    arguments = parser.parse_args()
    for run in arguments.runs:
        views = json.loads((run / "summary.json").read_text())["views"]
        smallest = min(w * h for w, h in (view["size"] for view in views)) / 1e6
        after = measure(str(run), None, arguments.against)
        paths = [view["path"] for view in views]
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
    for kind in (KINDS if arguments.kinds else ["usual"]) if arguments.rendered else ():
        row, area = rendered(arguments.rendered, kind), arguments.rendered**2 / 1e6
        print(
            f"rendered {arguments.rendered} px, {kind}: {row['cells']} cells, nmad {row['nmad']:.2f} m, within sigma "
            f"{row['within']:.1%}, {row['cpu'] / area:.1f} CPU s/Mpx, {row['peak']:.0f} MB",
            flush=True,
        )


if __name__ == "__main__":
    main()
