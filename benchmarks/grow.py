"""An image more for a finished block: what that costs, and how far its camera is from that of the whole run.

A simulated block (three views a site, 20,000 px of 0.5 m, 0.1 px) is adjusted without the view in its middle. Then that
view is added (`barpc adjust --add-to`, but for files of images and matching): the earlier block is read, marginalised
to the views that the new one shares tie points with, these are adjusted, and the block of all is written. CPU seconds
and peak memory of a process of its own, one thread; beside it the whole block adjusted again.

px: the largest distance between the new view's two cameras, in its corners at either end of its altitudes. sigma: the
smallest and largest ratio of the standard deviations of its nine unknowns. A tenth of the tie points is kept out of
each adjustment, another one in the two; `--all-tracks` keeps none out.

    OMP_NUM_THREADS=1 python benchmarks/grow.py                 # 60 + 1, 180 + 1, 1000 + 1
    OMP_NUM_THREADS=1 python benchmarks/grow.py 10000 --tracks 150 --no-whole
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from barpc.ba import BlockPrior, adjust_tracks, block_prior
from barpc.base.geodesy import Array
from barpc.scene import Tracks, View
from barpc.simulate import simulate_block
from tests.ba.grown import corners, part


def added(
    folder: str, views: Sequence[View], tracks: Tracks, new: int, hold_out: bool
) -> tuple[float, float, Array, Array]:
    """Add the view to the block in a folder: CPU seconds, MB, what its camera sees, and how well that is known."""
    warnings.simplefilter("ignore")
    start, known = time.process_time(), np.ones(len(tracks), dtype=bool)
    found = adjust_tracks(
        views, tracks, prior=BlockPrior.load(Path(folder) / "block.npz"), known=known, hold_out=hold_out
    )
    block_prior(found).save(Path(folder) / "grown.npz")
    seconds, peak = time.process_time() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return seconds, peak, found.sensors[new].project(corners(views[new])), np.sqrt(np.diag(found.covariance.view(new)))


def row(count: int, per_view: int, seed: int, whole: bool, hold_out: bool) -> str:
    """Return a line of the table."""
    block, new = simulate_block(count + 1, per_view * (count + 1) // 3, seed=seed), (count + 1) // 2
    every = np.arange(count + 1)
    with tempfile.TemporaryDirectory() as folder, multiprocessing.get_context("spawn").Pool(1) as pool:
        block_prior(adjust_tracks(*part(block, every[every != new]), hold_out=hold_out)).save(
            Path(folder) / "block.npz"
        )
        near = np.unique(part(block, every, new)[1].view)
        at = int(np.searchsorted(near, new))
        given = (folder, *part(block, near, new), at, hold_out)
        seconds, peak, image, sigma = pool.apply(added, given)
    text = f"{count:6d} + 1  {len(near) - 1:4d}  {seconds:6.2f}  {peak:5.0f}"
    if not whole:
        return text
    start = time.process_time()
    found = adjust_tracks(block.views, block.tracks, hold_out=hold_out)
    off = np.linalg.norm(image - found.sensors[new].project(corners(block.views[new])), axis=1).max()
    ratio = sigma / np.sqrt(np.diag(found.covariance.view(new)))
    return f"{text}  {off:6.4f}  {ratio.min():.4f}-{ratio.max():.4f}  {time.process_time() - start:6.2f}"


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("counts", nargs="*", type=int, default=[60, 180, 1000])
    parser.add_argument("--tracks", type=int, default=300, help="tie points a view")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--no-whole", action="store_true", help="the whole is not adjusted again")
    parser.add_argument("--all-tracks", action="store_true", help="keep no tie points out of the adjustments")
    given = parser.parse_args()
    print("    block   met   CPU s     MB      px          sigma  whole CPU s")
    for count in given.counts:
        print(row(count, given.tracks, given.seed, not given.no_whole, not given.all_tracks), flush=True)


if __name__ == "__main__":
    main()
