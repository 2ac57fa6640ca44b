"""What an adjustment costs as numbers grow: GCPs, references, images less accurate than stated, edges, control sets.

One table a subject: its sizes, CPU seconds of this process (one thread), those over the first size's, and the exponent
of the last step, at which time grows as a power of the size: wanted is 1.15 at most. Blocks are simulated:

- gcps: three images, 2000 tie points, and GCPs, all right;
- wrong: the same with 2 % of the GCPs off by 20 m (RMS) in any direction;
- understated: 50 tie points an image, of which one in twenty is 60 px (RMS) off and states 4 m;
- reference: three images, 2000 tie points, and points of an orthoimage;
- edges: three images whose detector has so many edges, given as options;
- cameras: images with the side file of a vendor each, read by names relative to their folder (needs ../shared/data);
- cameras, whole XML: the same with all of Maxar's metadata, 0.9 MB an image, nearly all of it orbit and attitudes;
- one pass: images with parallel lines of sight, of which none is a band of another;
- sets: the search for GCPs that agree alone: 2 % off, a third in another datum, and all less accurate than stated.

    OMP_NUM_THREADS=1 python benchmarks/costs.py
    OMP_NUM_THREADS=1 python benchmarks/costs.py --only wrong --sizes 309 1084 4337 17000
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import rasterio

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.ba.control.agreement import Offsets, agreement
from barpc.base.geodesy import Array, metres_per_unit
from barpc.pipeline.acquisitions import one_each
from barpc.pipeline.loading import load_views
from barpc.rpcio import read_rpc
from barpc.scene import Reference
from barpc.sensor.rpc import RPC
from barpc.simulate import simulate_block

Made = Callable[[], object]


def with_gcps(count: int, wrong: float = 0.0) -> Made:
    """Return the adjustment of a block with GCPs, a share of them wrong."""
    block, rng = simulate_block(3, 2000, seed=1, num_gcps=count, num_checks=0), np.random.default_rng(1)
    gcps = block.gcps
    off = rng.normal(0.0, 20.0, (count, 3)) * (rng.permutation(count) < wrong * count)[:, None]
    gcps = replace(gcps, lonlatalt=gcps.lonlatalt + off / metres_per_unit(gcps.lonlatalt.mean(axis=0)))
    return lambda: adjust_tracks(block.views, block.tracks, None, gcps)


def understated(count: int) -> Made:
    """Return the adjustment of a block in which one image of twenty is far less accurate than stated."""
    block, rng = simulate_block(count, 50 * count, seed=1, num_checks=0), np.random.default_rng(1)
    views = list(block.views)
    for v in rng.permutation(count)[: count // 20]:
        views[v] = replace(views[v], sensor=views[v].sensor.crop(*rng.normal(0.0, 60.0, 2)))
    return lambda: adjust_tracks(views, block.tracks, AdjustOptions(sigma_attitude=4.0, sigma_position=1.0))


def with_reference(count: int) -> Made:
    """Return the adjustment of a block with points of an orthoimage."""
    block = simulate_block(3, 2000, seed=1, num_gcps=count, num_checks=0)
    points = replace(block.gcps, sigma=np.full((count, 3), 0.5), xy_sigma=np.full(len(block.gcps.xy), 0.3))
    reference = Reference(points, np.full(3, 2.0), np.zeros((3, 2)))
    return lambda: adjust_tracks(block.views, block.tracks, None, reference=reference)


def with_edges(count: int) -> Made:
    """Return the adjustment of a block whose detector has edges at known columns."""
    block = simulate_block(3, 20_000, seed=1, num_checks=0)
    columns = tuple(np.linspace(0, block.views[0].size[0], count + 2)[1:-1].round().tolist())
    return lambda: adjust_tracks(block.views, block.tracks, AdjustOptions(detectors=columns))


def offsets(count: int, wrong: float = 0.0, datum: float = 0.0, times: float = 1.0) -> Offsets:
    """Return offsets of GCPs of 0.3 m under tilts of 1.5 m: shares are wrong, and alike in another datum."""
    rng = np.random.default_rng(count)
    e, n = rng.uniform(-1.0, 1.0, (2, count))
    zero = np.zeros(count)
    tilts = [np.stack(form, axis=1) for form in ((zero, zero, e), (zero, zero, n), (-n, e, zero), (e, n, zero))]
    motions = np.concatenate([np.stack(tilts, axis=2) * 1.5, np.tile(1e4 * np.eye(3), (count, 1, 1))], axis=2)
    own = motions[..., :4] @ rng.normal(size=4) + rng.normal(0.0, 0.3 * times, (count, 3))
    own[: int(wrong * count)] += rng.normal(0.0, 20.0, (int(wrong * count), 3))
    own[: int(datum * count)] += [25.0, -10.0, 4.0]
    return Offsets(own / 0.3, motions / 0.3)


def sets(**how: float) -> Callable[[int], Made]:
    """Return the search for GCPs that agree, by their number."""

    def made(count: int) -> Made:
        given = offsets(count, **how)
        return lambda: agreement(given, np.ones(count, dtype=bool))

    return made


SIDE_FILES = {
    "{}.XML": "rpc_formats/rpc_WV2.xml",
    "{}.RPB": "rpc_formats/md_dg.RPB",
    "{}_RPC.TXT": "rpc_formats/20191015_073816_ssc1d3_0011_basic_l1a_panchromatic_dn_RPC.TXT",
}
WHOLE_XML = {"{}.XML": "physical_maxar/1040010074793300.xml"}


def with_side_files(count: int, files: Mapping[str, str] = SIDE_FILES) -> Made:
    """Return the reading of images whose cameras are vendors' files, each with other numbers."""
    data = Path(__file__).resolve().parents[2] / "shared/data"
    folder = tempfile.TemporaryDirectory()
    for n, (name, given) in zip(range(count), itertools.cycle(files.items()), strict=False):
        stem, text = f"image_{n:05d}", (data / given).read_text()
        width, height = np.rint(2.0 * read_rpc(data / given).image_offset).astype(int).tolist()
        shape = {"driver": "GTiff", "count": 1, "dtype": "uint8", "sparse_ok": True, "tiled": True}
        with rasterio.open(f"{folder.name}/{stem}.tif", "w", width=width, height=height, **shape):
            pass
        other = re.sub(r"(?i)(line_?off(?:set)?\W+)(\d+)", lambda m, n=n: m[1] + str(int(m[2]) + n), text, count=1)
        Path(folder.name, name.format(stem)).write_text(other)

    def read() -> None:
        with folder as place, contextlib.chdir(place):
            load_views(sorted(path.name for path in Path().glob("*.tif")))

    return read


def one_pass(count: int) -> Made:
    """Return the search for bands among images of one pass."""
    (view,) = simulate_block(2, 20, seed=1, num_checks=0).views[:1]
    assert isinstance(view.sensor, RPC)
    ground, offsets = view.sensor.ground_offset, np.random.default_rng(1).uniform(-0.2, 0.2, (count, 2))
    moved = [replace(view.sensor, ground_offset=ground + np.append(offset, 0.0)) for offset in offsets]
    views = [replace(view, name=f"v{n}", sensor=one) for n, one in enumerate(moved)]
    return lambda: one_each(views, [None] * count, 1)  # type: ignore[list-item]  # cameras are handed on alone


GCPS = 309, 1084, 4337
SUBJECTS: dict[str, tuple[Callable[[int], Made], tuple[int, ...]]] = {
    "gcps": (with_gcps, GCPS),
    "wrong": (lambda count: with_gcps(count, 0.02), GCPS),
    "understated": (understated, (100, 300, 1000)),
    "reference": (with_reference, GCPS),
    "edges": (with_edges, (1, 4, 16)),
    "cameras": (with_side_files, (100, 300, 1000)),
    "cameras, whole XML": (lambda count: with_side_files(count, WHOLE_XML), (100, 300, 1000)),
    "one pass": (one_pass, (100, 300, 1000, 3000)),
    "sets, 2 % wrong": (sets(wrong=0.02), (*GCPS, 17_000)),
    "sets, a third in another datum": (sets(datum=0.3), GCPS),
    "sets, understated": (sets(times=3.0), GCPS),
}
"""What is timed: the function that makes what is run, and its sizes."""


def table(name: str, sizes: tuple[int, ...]) -> None:
    """Print the costs of a subject."""
    made, seconds = SUBJECTS[name][0], list[float]()
    print(f"{name}\n      n   CPU s   ratio")
    for size in sizes:
        run = made(size)
        start = time.process_time()
        run()
        seconds.append(max(time.process_time() - start, 1e-3))
        print(f"{size:7d} {seconds[-1]:7.2f} {seconds[-1] / seconds[0]:7.2f}", flush=True)
    print(f"exponent {exponent(sizes, seconds):.2f}\n", flush=True)


def exponent(sizes: tuple[int, ...], seconds: list[float]) -> float:
    """Return the power of the size with which time grew in the last step; NaN of one size."""
    steps: Array = np.diff(np.log(seconds)) / np.diff(np.log(sizes))
    return float(steps[-1]) if len(steps) else np.nan


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="SUBJECT", help="subjects that begin with this")
    parser.add_argument("--sizes", nargs="+", type=int, help="instead of each subject's own")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for name, (_, sizes) in SUBJECTS.items():
        if name.startswith(arguments.only or ""):
            table(name, tuple(arguments.sizes or sizes))


if __name__ == "__main__":
    main()
