"""The table of docs/recipes/dates.md: how far two dates of a place disagree, by images of known truth.

    python benchmarks/two_dates.py

Two dates, two images each, other sun, a third of the vegetation changed: ground points of the second date, by its two
cameras, minus those of the first, at the points whose true image positions the scene states.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import barpc
from barpc.base.geodesy import Array, metres_per_unit

ROOT = Path(__file__).resolve().parents[1]
SCENE = "dates --views 4 --size 700 700 --seed 3 --sun-azimuth 150 --sun-azimuth 215 --change 0.3"


def ground(cameras: Sequence[Path], truth: dict) -> Array:
    """Return the points (n, 3), lon, lat [deg], alt [m], of the check points that all four images show, by a pair."""
    points = [one["image"] for one in truth["check_points"] if len(one["image"]) == 4]
    at = np.array([[one[camera.stem.removesuffix("_RPC")] for camera in cameras] for one in points])
    return barpc.triangulate([barpc.read_rpc(camera) for camera in cameras], at)[0]


def row(name: str, first: Sequence[Path], second: Sequence[Path], truth: dict) -> str:
    """Return a row of the table."""
    one, other = ground(first, truth), ground(second, truth)
    off = (other - one) * metres_per_unit(one)
    east, north, up = off.mean(axis=0)
    return f"| {name} | {east:+.3f}, {north:+.3f}, {up:+.3f} | {off[:, 2].std():.3f} |"


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as place:
        work = Path(place)
        made = [sys.executable, "-m", "tests.scenes", str(work / "dates"), *SCENE.split()[1:]]
        subprocess.run(made, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        truth = json.loads((work / "dates/truth.json").read_text())
        images = sorted((work / "dates").glob("*.tif"))
        day = {view["name"]: view["date"] for view in truth["views"]}
        early = [image for image in images if day[image.stem] == 0]
        late = [image for image in images if image not in early]
        barpc.adjust(early, work / "first")
        barpc.adjust(late, work / "second")
        barpc.adjust(images, work / "together")
        barpc.adjust(late, work / "added", add_to=str(work / "first"))

        def of(run: str, some: Sequence[Path]) -> list[Path]:
            return [work / run / f"{image.stem}.vrt" for image in some]

        print("| | mean difference east, north, up [m] | spread, up [m] |\n|---|---|---|")
        print(row("as delivered", early, late, truth))
        print(row("each date adjusted by itself", of("first", early), of("second", late), truth))
        print(row("all together", of("together", early), of("together", late), truth))
        print(row("second date onto the first (`--add-to`)", of("first", early), of("added", late), truth))


if __name__ == "__main__":
    main()
