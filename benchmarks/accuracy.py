"""Measure how exact the whole chain is, and write docs/accuracy.md.

Everything is measured again in this run: on data_samples and on simulated blocks, where the truth is known, and on
vendors' RPC files of a data folder (left out without one).

python benchmarks/accuracy.py --data DATA              prints the page
python benchmarks/accuracy.py --data DATA --write      writes docs/accuracy.md
"""

# ruff: noqa: E402  (the thread counts and the path come first)

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs" / "figures"))

from concepts import SAMPLES, cameras, errors_of_place

import barpc
from barpc.ba import AdjustOptions, adjust_tracks
from barpc.base.errors import BarpcError, BarpcWarning
from barpc.pipeline import RunOptions
from barpc.sensor.centers import camera_center
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.rpc import altitude_range
from barpc.simulate import simulate_block

HEAD = """# Accuracy

<!-- printed by: python benchmarks/accuracy.py --data DATA -->

All figures of this page come from one run of `python benchmarks/accuracy.py --data DATA`: {versions}.
Methods and tests: [adjustment](adjustment.md), [tie points](tie_points.md),
[RPC fit](fit.md), [the RPC](rpc.md), [Sentinel-1](sensors.md), [SICD](sensors_sicd.md),
[pushbroom](sensors_pushbroom.md). Real images beside other tools: [benchmarks](benchmarks.md).
"""


def row(*cells: object) -> str:
    """One row of a table."""
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def table(*heads: str) -> list[str]:
    """The head of a table."""
    return ["", row(*heads), row(*["---"] * len(heads))]


def samples(work: Path) -> Iterator[str]:
    """The sample images: truth is known."""
    truth = json.loads((SAMPLES / "truth.json").read_text(encoding="utf-8"))
    images = sorted(SAMPLES.glob("*.tif"))
    yield "\n## The sample images, against their truth\n"
    yield (
        "Triangulated check points minus true ones, metres; 200 points that no run sees. *Shape* is the RMS "
        "about the mean."
    )
    yield from table("cameras", "tie points [px]", "place: mean east, north, up", "shape: RMS east, north, up")
    steps = {
        "as delivered": None,
        "adjusted": RunOptions(),
        "adjusted, 5 GCPs": RunOptions(gcp=(str(SAMPLES / "gcps.geojson"),)),
    }
    before = np.nan
    for name, options in steps.items():
        models, rms = cameras(SAMPLES, ".tif"), before
        if options is not None:
            out = work / name.replace(" ", "_")
            result = barpc.adjust(images, out, options)
            models = cameras(out, ".vrt")
            rms = np.sqrt(np.mean([view["rmse_after"] ** 2 for view in result.summary["views"]]))
        errors = errors_of_place(models, truth)
        mean, shape = errors.mean(axis=0), errors.std(axis=0)
        yield row(name, "-" if options is None else f"{rms:.4f}", triple(mean, "+.3f"), triple(shape, ".4f"))


def triple(values: np.ndarray, form: str) -> str:
    """Three numbers."""
    return ", ".join(format(value, form) for value in values)


def blocks() -> Iterator[str]:
    """Simulated blocks: held-out points."""
    yield "\n## Simulated blocks, on held-out points\n"
    yield (
        "Images of 20,000 x 20,000 px, noise 0.1 px and 10 % false observations, attitude 15 microradians "
        "and position 1 m wrong; the median of five. Error of the adjusted cameras on 500 points that the "
        "adjustment does not see, exact image points. `noise_floor = 0` is right for these independent "
        "errors, the default (0.02 px) for real images."
    )
    yield from table("views, tie points", "as delivered [px]", "default [px]", "`noise_floor = 0` [px]")
    for views, tracks in ((3, 2000), (10, 5000), (30, 10_000)):
        figures = []
        for seed in range(5):
            block = simulate_block(views, tracks, seed=seed, outliers=0.1)
            delivered = block.held_out_rms([view.sensor for view in block.views])
            found = [
                block.held_out_rms(list(adjust_tracks(block.views, block.tracks, AdjustOptions(**o)).sensors))
                for o in ({}, {"noise_floor": 0.0})
            ]
            figures.append([delivered, *found])
        middle = np.median(figures, axis=0)
        yield row(f"{views}, {tracks}", f"{middle[0]:.1f}", f"{middle[1]:.4f}", f"{middle[2]:.4f}")


def refits(data: Path) -> Iterator[str]:
    """Vendors' RPCs behind a correction, refitted."""
    yield "\n## Refitted RPCs\n"
    yield (
        "P_BA of 30 microradians and 10 m in front of each vendor's RPC, over its whole domain and altitude "
        "range; errors on check points between the control points."
    )
    found = []
    for path in sorted((data / "rpc_formats").iterdir()):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                rpc = barpc.read_rpc(path)
        except BarpcError:
            continue
        size = tuple(int(n) for n in np.ceil(rpc.image_offset + abs(rpc.image_scale)))
        alts = altitude_range(rpc)
        center = camera_center(rpc, size, alts).ecef
        correction = Correction(30e-6 * np.array([0.6, -0.5, 0.62]), 10 * np.array([0.6, 0.5, -0.62]), center)
        fit = barpc.fit_rpc(Corrected(rpc, correction), size, alts)
        found.append((max(fit.max_ckp), len(found), fit.min_denominator, path.name))
    largest, _, _, worst = max(found)
    yield (
        f"{len(found)} files: largest error {np.median([one[0] for one in found]):.1e} px (median), {largest:.1e} "
        f"(`{worst}`); denominators at least {min(one[2] for one in found):.2f} of those at the centre."
    )


def page(data: Path | None) -> str:
    """The whole page."""
    names = ("numpy", "scipy", "opencv-python-headless", "rasterio")
    versions = ", ".join([f"barpc {barpc.__version__}", *(f"{name} {version(name)}" for name in names)])
    with tempfile.TemporaryDirectory() as folder:
        lines = [HEAD.format(versions=versions), *samples(Path(folder)), *blocks()]
        if data is not None:
            lines += refits(data)
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, then print or write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with rpc_formats/")
    parser.add_argument("--write", action="store_true", help="write docs/accuracy.md")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", BarpcWarning)  # rays under less than one degree in some blocks
    text = page(arguments.data)
    if arguments.write:
        (ROOT / "docs" / "accuracy.md").write_text(text, encoding="utf-8")
    else:
        print(text, end="")


if __name__ == "__main__":
    main()
