"""The plain adjustment (rotation and translation a view, no loss) beside Ceres' on the same block, in turns.

Ceres gets analytic derivatives in C++ (`ceres.cpp`), first points for nothing and no covariance to compute; the best
of its dense, sparse and iterative Schur complements counts. barpc's "whole" is `adjust_tracks`: first points, tests of
what is left, and covariance with it; "solve" is its minimisation alone, as Ceres' is. CPU seconds, one thread.

    python benchmarks/ceres.py     # or benchmarks/ba.py --ceres; needs g++ and libceres-dev, or says so
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.ba.constraints.block import Block, first_state, join, make_problem
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State, minimise
from barpc.simulate import simulate_block

SIZES = (3, 1500), (10, 5000), (30, 10000), (100, 15000), (300, 30000), (1000, 100000)
PLAIN = AdjustOptions(
    model="rotation+translation",
    drift=0,
    noise_floor=0.0,
    min_convergence=0.0,
)
WAYS = "dense", "sparse", "iterative"
_DENSE = 300  # views, above which a dense Schur complement is not tried
_SEEN = np.dtype([("view", "i4"), ("point", "i4"), ("col", "f8"), ("row", "f8"), ("sigma", "f8")])


def build(folder: Path) -> Path | None:
    """The compiled program, or None where it cannot be made."""
    if shutil.which("g++") is None:
        return None
    program, source = folder / "ceres", Path(__file__).with_name("ceres.cpp")
    made = [
        "g++",
        "-O3",
        "-march=native",
        "-DNDEBUG",
        "-o",
        str(program),
        str(source),
        "-I/usr/include/eigen3",
    ]
    ran = subprocess.run([*made, "-lceres", "-lglog"], capture_output=True)
    return program if ran.returncode == 0 else None


def begun(views: int, tracks: int, seed: int) -> tuple[Block, Problem, State]:
    """A block, and where its adjustment starts."""
    made = simulate_block(views, tracks, seed=seed, num_checks=0)
    block = join(made.views, made.tracks, None, PLAIN)
    problem = make_problem(block, PLAIN, None, None)
    return block, problem, first_state(problem, block, PLAIN, None)[0]


def write(path: Path, block: Block, problem: Problem, state: State) -> None:
    """The block as `ceres.cpp` reads it."""
    unknowns, rows = problem.cameras.unknowns, []
    for v, view in enumerate(block.views):
        rpc = view.sensor
        places = [*rpc.ground_offset, *rpc.image_offset, *rpc.ground_scale, *rpc.image_scale]
        rows.append([*unknowns.center[v], unknowns.distance[v], *places, *rpc.coeffs.ravel()])
    seen = np.zeros(len(block.view), dtype=_SEEN)
    seen["view"], seen["point"], seen["sigma"] = block.view, block.point, block.sigma
    seen["col"], seen["row"] = block.xy
    with path.open("wb") as file:
        file.write(np.array([len(rows), len(seen), len(state.points)], dtype=np.int64).tobytes())
        file.write(np.hstack([np.array(rows), problem.camera_prior.sigma]).tobytes())
        file.write(seen.tobytes())
        file.write(state.points.tobytes())


def compare(repeat: int) -> None:
    """The table."""
    with tempfile.TemporaryDirectory() as folder:
        program = build(Path(folder))
        if program is None:
            sys.exit("Ceres is not compared: g++ and its headers (libceres-dev) are needed")
        print("views  tracks | whole [s]  solve [s] | Ceres [s]  by         MB | whole / it  solve / it | excess")
        for views, tracks in SIZES:
            one_size(program, Path(folder) / "block", views, tracks, repeat)


def one_size(program: Path, path: Path, views: int, tracks: int, repeat: int) -> None:
    """One row: medians of ratios in turns."""
    ways = [way for way in WAYS if way != "dense" or views <= _DENSE]
    ours, theirs = list[tuple[float, float, float]](), list[tuple[float, float, str, float]]()
    for seed in range(repeat):
        made = simulate_block(views, tracks, seed=seed, num_checks=0)
        block, problem, state = begun(views, tracks, seed)
        write(path, block, problem, state)
        start = time.process_time()
        adjust_tracks(made.views, made.tracks, PLAIN)
        whole, start = time.process_time() - start, time.process_time()
        found = minimise(problem, state, 1.0 / block.sigma, "auto", 1e-6)
        solve = time.process_time() - start
        reduced = problem.reduce(found.state.params, found.state.points, 1.0 / block.sigma)
        ours.append((whole, solve, reduced.cost))
        ran = [subprocess.run([program, path, way], capture_output=True, text=True, check=True) for way in ways]
        told = [[*map(float, one.stdout.split())] for one in ran]
        theirs.append(min((row[0], row[1], way, row[3]) for row, way in zip(told, ways, strict=True)))
    whole, solve, ceres = (
        statistics.median(column)
        for column in ([row[0] for row in ours], [row[1] for row in ours], [row[0] for row in theirs])
    )
    by = [statistics.median(a[n] / b[0] for a, b in zip(ours, theirs, strict=True)) for n in (0, 1)]
    excess = statistics.median(b[1] / a[2] - 1.0 for a, b in zip(ours, theirs, strict=True))
    print(
        f"{views:5d} {tracks:7d} | {whole:9.3f} {solve:10.3f} | {ceres:9.3f}  {theirs[0][2]:9s} {theirs[0][3]:4.0f} "
        f"| {by[0]:10.2f} {by[1]:11.2f} | {excess:.1e}",
        flush=True,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=3, help="scenes of each size, of which the median counts")
    compare(parser.parse_args().repeat)
