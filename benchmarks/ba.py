"""The bundle adjustment against finite-difference scipy, and how it grows.

The baseline is what the closest peer does, on the same observations: `least_squares` over rotations and points
(ECEF) together, derivatives by finite differences with `jac_sparsity`, steps by LSMR, `x_scale="jac"`, at most 300
evaluations; projections by barpc's own RPC, which is faster than the peer's. CPU seconds of this process, one
thread, three comparisons:

- whole: everything that `adjust_tracks` does (robust rounds, cuts, noise, covariance) against the peer's two passes
  (soft L1 at 1 px, rejection, least squares) with the peer's tolerances;
- as it stops: the same against one pass with the peer's tolerances, which ends above the minimum;
- to the minimum: the same against one pass with LSMR's tolerances at 1e-9, as nobody runs it, which
  does reach the minimum: the strongest form of the baseline.

The excess is the baseline's cost over barpc's, less one.

    OMP_NUM_THREADS=1 python benchmarks/ba.py             # ratios for 3, 10, 30 (and --all: 100) views
    python benchmarks/ba.py --growth                      # CPU seconds for 5k .. 800k observations
    python benchmarks/ba.py --large 1000 200000           # views, tracks: seconds and peak memory
    python benchmarks/ba.py --blocks 1000 3000 10000      # growth with views, by stage, and how far from the optimum
    python benchmarks/ba.py --fill 1000 10000             # what other orders of elimination would cost
    python benchmarks/ba.py --against 26f82d8             # with defaults beside another commit (here 0.2.0), in turns
    python benchmarks/ba.py --series 1000                 # views of one place: seconds and peak memory
    python benchmarks/ba.py --jump                        # one flawed view of 36 beside the same block without
    python benchmarks/ba.py --ceres                       # plain, beside Ceres, in turns (needs libceres-dev and g++)
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import ceres
import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.sparse import bsr_array, coo_matrix
from scipy.sparse.linalg import splu

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks, solution
from barpc.ba.constraints.block import join, make_problem
from barpc.ba.robust.systematic_residuals import Smooth
from barpc.ba.solving import structure
from barpc.ba.solving.linear import Cholesky
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State, camera_step, minimise
from barpc.base.geodesy import ecef_from_ground, ground_from_ecef
from barpc.scene import Tracks
from barpc.sensor.curve import rotation_matrix
from barpc.sensor.triangulation import triangulate
from barpc.simulate import SimulatedBlock, simulate_block

PEER = {"ftol": 1e-4, "xtol": 1e-10}
"""The peer's tolerances."""

TIGHT = {"ftol": 1e-8, "xtol": 1e-15, "gtol": 1e-15, "tr_options": {"atol": 1e-9, "btol": 1e-9}}
"""Tolerances with which finite differences reach the minimum to 1e-6 with the fewest evaluations."""

PLAIN = {"noise_floor": 0.0, "min_convergence": 0.0, "drift": 0, "jitter": "off"}
"""Unknowns that the baseline does not have, off: both solve for rotations and points, of all observations."""


def adjust(block: SimulatedBlock, model: str = "rotation", **options: object) -> Adjustment:
    """The block by barpc, plain least squares."""
    centers = np.array([correction.center for correction in block.truth.corrections])
    chosen = AdjustOptions(**{**PLAIN, "model": model, "sigma_attitude": 1e4, **options})
    return adjust_tracks(block.views, block.tracks, chosen, centers=centers, hold_out=False)


class Baseline:
    """Rotations and points in one vector, finite differences."""

    def __init__(self, block: SimulatedBlock) -> None:
        self.block = block
        self.centers = np.array([correction.center for correction in block.truth.corrections])
        tracks = block.tracks
        self.keep = np.ones(len(tracks), dtype=bool)
        self.rows = [np.flatnonzero(tracks.view == v) for v in range(len(block.views))]
        start = triangulate([v.sensor for v in block.views], tracks.view, tracks.point, tracks.xy)
        self.start = np.concatenate([np.zeros(3 * len(block.views)), start.points.ravel()])

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Whitened residuals (2 K,); zero for what was rejected."""
        tracks, n = self.block.tracks, len(self.block.views)
        rotation, points = x[: 3 * n].reshape(n, 3), x[3 * n :].reshape(-1, 3)
        out = np.empty((len(tracks), 2))
        for v, rows in enumerate(self.rows):
            lever = points[tracks.point[rows]] - self.centers[v]
            moved = lever @ rotation_matrix(rotation[v]).T + self.centers[v]
            out[rows] = self.block.views[v].sensor.project(ground_from_ecef(moved)) - tracks.xy[rows]
        return (out * (self.keep / tracks.sigma)[:, None]).ravel()

    def sparsity(self) -> coo_matrix:
        """Which residual depends on which unknown."""
        tracks, n = self.block.tracks, len(self.block.views)
        k = np.arange(len(tracks))
        row, col = [], []
        for base, index in ((0, tracks.view), (3 * n, tracks.point)):
            for component in range(3):
                for coordinate in range(2):
                    row.append(2 * k + coordinate)
                    col.append(base + 3 * index + component)
        row, col = np.concatenate(row), np.concatenate(col)
        return coo_matrix((np.ones(len(row)), (row, col)), shape=(2 * len(tracks), len(self.start)))

    def solve(self, x: np.ndarray, **options: object) -> OptimizeResult:
        """One pass from `x`."""
        return least_squares(
            self.residual, x, jac="2-point", jac_sparsity=self.sparsity(), method="trf",
            tr_solver="lsmr", x_scale="jac", max_nfev=300, **options,
        )  # fmt: skip

    def two_passes(self) -> OptimizeResult:
        """Soft L1 at one pixel, rejection at four robust standard deviations, least squares."""
        first = self.solve(self.start, loss="soft_l1", f_scale=1.0 / np.median(self.block.tracks.sigma), **PEER)
        size = np.linalg.norm(first.fun.reshape(-1, 2), axis=1)
        self.keep = size <= 4.0 * np.median(size) / 1.18
        return self.solve(first.x, **PEER)


def timed(func):
    start = time.process_time()
    value = func()
    return time.process_time() - start, value


def ratios(sizes: list[tuple[int, int]], repeat: int) -> None:
    print("               | barpc  | whole        | as it stops           | to the minimum")
    print("views  tracks  |     s  |     s  ratio |     s  ratio   excess |     s  ratio   excess")
    for views, tracks in sizes:
        block = simulate_block(views, tracks, seed=1, attitude=6e-6, position=1e-6)
        runs = {
            "barpc": lambda block=block: adjust(block),
            "stops": lambda block=block: _one_pass(block, PEER),
            "tight": lambda block=block: _one_pass(block, TIGHT),
            "passes": lambda block=block: Baseline(block).two_passes(),
        }
        found = {name: [] for name in runs}
        for n in range(repeat):
            for name, run in runs.items():
                if n == 0 or name == "barpc" or views < 10:
                    found[name].append(timed(run))
        cpu = {name: statistics.median(seconds for seconds, _ in times) for name, times in found.items()}
        ours = found["barpc"][0][1]
        least = float(np.nansum((ours.residuals / block.tracks.sigma[:, None]) ** 2))  # of those cut, too, as the peer
        stops, tight = (2.0 * found[name][0][1].cost / least - 1.0 for name in ("stops", "tight"))
        print(
            f"{views:5d} {tracks:7d}  | {cpu['barpc']:6.3f}  "
            f"| {cpu['passes']:5.1f}  {cpu['passes'] / cpu['barpc']:5.1f} "
            f"| {cpu['stops']:5.2f}  {cpu['stops'] / cpu['barpc']:5.1f}  {stops:.1e} "
            f"| {cpu['tight']:5.2f}  {cpu['tight'] / cpu['barpc']:5.1f}  {tight:.1e}",
            flush=True,
        )


def _one_pass(block: SimulatedBlock, options: dict[str, object]) -> OptimizeResult:
    baseline = Baseline(block)
    return baseline.solve(baseline.start, **options)


def growth(views: int) -> None:
    """CPU seconds over observations, at a fixed number of views."""
    counts, seconds = [], []
    for tracks in (1200, 5000, 20000, 80000, 200000):
        block = simulate_block(views, tracks, seed=1, attitude=6e-6, num_checks=0)
        runs = [adjust(block, "rotation+translation", sigma_attitude=4.0).seconds for _ in range(3)]
        counts.append(len(block.tracks))
        seconds.append(statistics.median(runs))
        print(f"{counts[-1]:8d} observations: {seconds[-1]:7.3f} s, {1e6 * seconds[-1] / counts[-1]:.2f} us each")
    slope = np.polyfit(np.log(counts), np.log(seconds), 1)[0]
    print(f"CPU grows as observations^{slope:.2f}")


def large(views: int, tracks: int) -> None:
    """A large block, both models."""
    block = simulate_block(views, tracks, seed=1, attitude=6e-6, num_checks=0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    for model in ("rotation", "rotation+translation"):
        found = adjust(block, model, sigma_attitude=4.0)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(
            f"{views} views, {tracks} tracks, {len(block.tracks)} observations, {model}: {found.seconds:.1f} s, "
            f"{found.steps} linearisations, {found.status}; peak {peak:.2f} GB ({before:.2f} before)",
            flush=True,
        )
        del found


def series(views: int) -> None:
    """Views of one place, each tied to its next 39 by points seen three times, with defaults: no cut parts them."""
    made, rng = simulate_block(views, 400, seed=1, per_site=views, num_checks=0), np.random.default_rng(1)
    seen = made.tracks
    begin = np.searchsorted(seen.point, np.arange(401))
    of = rng.integers(400, size=40 * views)  # the point of every track
    count = np.diff(begin)[of]
    first = begin[of] + np.clip(rng.integers(-20, count - 20), 0, count - 40)
    rows = (first[:, None] + np.sort(rng.permuted(np.tile(np.arange(40), (len(of), 1)), axis=1)[:, :3])).ravel()
    tracks = Tracks(seen.view[rows], np.repeat(np.arange(len(of)), 3), seen.xy[rows], seen.sigma[rows])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    seconds, found = timed(lambda: adjust_tracks(made.views, tracks))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"{views} views, {len(of)} tracks: {seconds:.1f} s, {found.status}; peak {peak:.2f} GB ({before:.2f} before)")


STAGES = {
    "start": [(solution, "make_problem"), (solution, "first_state")],
    "linearise": [(Problem, "reduce")],
    "order": [(structure, "dissect")],
    "factorise": [(Cholesky, "factorize")],
    "solve": [(Cholesky, "solve")],
    "smooth": [(Smooth, "fit"), (Smooth, "test")],
    "held out": [(solution, "measure")],
}
"""Functions whose CPU seconds are counted; those of one stage may call each other."""


class Stages:
    """CPU seconds in the functions of every stage, and the last linearisation asked for."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self.busy: list[str] = []
        self.last: tuple = ()
        for stage, functions in STAGES.items():
            for owner, name in functions:
                setattr(owner, name, self._timed(stage, getattr(owner, name)))

    def _timed(self, stage, func):
        def timed_func(*args):
            if stage == "linearise":
                self.last = args
            if stage in self.busy:
                return func(*args)
            self.busy.append(stage)
            start = time.process_time()
            try:
                return func(*args)
            finally:
                self.busy.remove(stage)
                self.seconds[stage] += time.process_time() - start

        return timed_func


def one_block(views: int, tracks: int) -> None:
    """One block with every default, by stage; then what a further step would gain, and how exactly it is solved."""
    simulated, made = timed(lambda: simulate_block(views, tracks, seed=1, num_checks=0))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    stages = Stages()
    centers = np.array([correction.center for correction in made.truth.corrections])
    start = time.process_time()
    found = adjust_tracks(made.views, made.tracks, AdjustOptions(), centers=centers)
    all_of_it = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    by_stage = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in stages.seconds.items())
    rest = all_of_it - sum(stages.seconds.values())
    print(
        f"{views} views, {len(made.tracks)} observations: {all_of_it:.1f} s ({by_stage}, rest {rest:.1f}), "
        f"{found.steps} linearisations, peak {peak:.2f} GB ({before:.2f} before, simulated in {simulated:.0f} s)",
        flush=True,
    )
    del found, made
    problem, params, _, weight = stages.last
    points = problem.triangulate(stages.last[2], problem.project_points(params, stages.last[2]), weight)
    stages.last = ()
    state = minimise(problem, State(params, points), weight, "sparse", 1e-6).state
    reduced = problem.reduce(state.params, state.points, weight)
    _, gain, factor = camera_step(problem, reduced)
    i, j = reduced.matrix.pair_view.T
    wanted = np.random.default_rng(0).normal(size=len(reduced.gradient))
    solution = factor.solve(wanted).reshape(views, -1)
    product = np.einsum("nij,nj->ni", reduced.matrix.diagonal, solution)
    np.add.at(product, i, np.einsum("nij,nj->ni", reduced.matrix.pairs, solution[j]))
    np.add.at(product, j, np.einsum("nji,nj->ni", reduced.matrix.pairs, solution[i]))
    product = product.ravel()
    if reduced.common is not None:
        product -= reduced.common.by_camera.T @ (reduced.common.by_camera @ solution.ravel())
    left = np.linalg.norm(product - wanted) / np.linalg.norm(wanted)
    print(f"    a further step would gain {gain / reduced.cost:.1e} of the cost; what is solved is left to {left:.1e}")
    inverse, _ = timed(factor.inverse)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"    covariance of every view and of those that share points {inverse:.1f} s, peak {peak:.2f} GB",
        flush=True,
    )


def blocks(sizes: list[int], tracks: int) -> None:
    """Blocks of some sizes, `tracks` tracks a view, each in a process of its own."""
    for views in sizes:
        given = ["--one-block", str(views), str(tracks * views)]
        subprocess.run([sys.executable, __file__, *given], check=True)


def fill(sizes: list[int]) -> None:
    """Numbers in the factor, and CPU seconds, by SuperLU in some orders and by fronts in ours."""
    for views in sizes:
        made = simulate_block(views, 50 * views, seed=1, num_checks=0)
        _fill_of(views, made)


def _fill_of(views: int, made: SimulatedBlock) -> None:
    options = AdjustOptions(**PLAIN)
    joined = join(made.views, made.tracks, None, options)
    centers = np.array([correction.center for correction in made.truth.corrections])
    problem = make_problem(joined, options, centers, None)
    reduced = problem.reduce(problem.camera_prior.mean, ecef_from_ground(made.truth.ground), 1.0 / joined.sigma)
    seconds, order = timed(lambda: problem.structure.order(np.ones(views, dtype=bool)))
    factorised, _ = timed(lambda: reduced.factor(problem.free))
    count = sum(len(f.pivots) * (len(f.pivots) + len(f.border)) for f in order.fronts) * 81
    print(
        f"{views} views, fronts: {count:.2e} numbers, {seconds:.2f} s to order, {factorised:.2f} s",
        flush=True,
    )
    (i, j), pairs = reduced.matrix.pair_view.T, reduced.matrix.pairs
    row, col = np.concatenate([np.arange(views), i, j]), np.concatenate([np.arange(views), j, i])
    data = np.concatenate([reduced.matrix.diagonal, pairs, pairs.transpose(0, 2, 1)])
    at = np.lexsort((col, row))
    sparse = bsr_array((data[at], col[at], np.searchsorted(row[at], np.arange(views + 1)))).tocsc()
    ours = (np.argsort(order.rank)[:, None] * 9 + np.arange(9)).ravel()
    symmetric = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    for name, matrix, how in (
        ("NATURAL", sparse[ours][:, ours], symmetric),
        ("MMD_AT_PLUS_A", sparse, symmetric),
        ("COLAMD", sparse, {}),
    ):
        try:
            seconds, lu = timed(lambda m=matrix, n=name, h=how: splu(m, permc_spec=n, **h))
            print(f"    SuperLU {name}: {lu.L.nnz:.2e} numbers, {seconds:.2f} s", flush=True)
        except (MemoryError, RuntimeError) as error:
            print(f"    SuperLU {name}: {error}", flush=True)


SIZES = (3, 1500, 0), (10, 5000, 0), (30, 10000, 0), (100, 15000, 0), (300, 30000, 0), (30, 10000, 2), (300, 30000, 2)
"""Views and tracks of the blocks that are compared with another commit's, and which per cent of observations are wrong.
"""
ONE_RUN = """
import sys, time, warnings
warnings.simplefilter("ignore")
from barpc.ba import adjust_tracks
from dataclasses import replace
import numpy as np
from barpc.simulate import simulate_block
views, tracks, wrong, seed = map(int, sys.argv[1:])
block, rng = simulate_block(views, tracks, seed=seed), np.random.default_rng(seed)
ties = block.tracks
ties = replace(ties, xy=ties.xy + (rng.random(len(ties)) < wrong / 100)[:, None] * rng.normal(0, 20, ties.xy.shape))
adjust_tracks(block.views, ties)
best = 1e9
for _ in range(3):
    start = time.process_time()
    adjust_tracks(block.views, ties)
    best = min(best, time.process_time() - start)
print(best)
"""


def against(commit: str, repeat: int) -> None:
    """CPU seconds of an adjustment with defaults by this tree and by a commit, in turns, a scene each."""
    root = Path(__file__).resolve().parents[1]
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        git = ["git", "-C", str(root), "worktree"]
        subprocess.run([*git, "add", "--detach", str(other), commit], check=True, capture_output=True)
        try:
            print(f"views  tracks  wrong |  this [s]  {commit} [s]  ratio")
            for views, tracks, wrong in SIZES:
                found: dict[Path, list[float]] = {root: [], other: []}
                for seed in range(repeat):
                    for tree, seconds in found.items():
                        command = [sys.executable, "-c", ONE_RUN, str(views), str(tracks), str(wrong), str(seed)]
                        ran = subprocess.run(command, cwd=tree, check=True, capture_output=True, text=True)
                        seconds.append(float(ran.stdout.split()[-1]))
                this, that = (statistics.median(seconds) for seconds in found.values())
                ratio = statistics.median(np.array(found[root]) / np.array(found[other]))
                print(f"{views:5d} {tracks:7d} {wrong:4d} % | {this:9.3f} {that:12.3f} {ratio:6.2f}", flush=True)
        finally:
            subprocess.run([*git, "remove", "--force", str(other)], check=True, capture_output=True)


def jump(repeat: int) -> None:
    """CPU seconds of 36 views of which one jumps by 3 px in its middle row, and without that."""
    cpu: dict[str, list[float]] = {"clean": [], "jump": []}
    for seed in range(2, 2 + repeat):
        made = simulate_block(36, 700, seed=seed)
        below = (made.tracks.view == 18) & (made.tracks.xy[:, 1] > 0.5 * made.views[18].size[1])
        moved = replace(made.tracks, xy=made.tracks.xy + np.outer(below, [3.0, 1.0]))
        for name, tracks in (("clean", made.tracks), ("jump", moved)):
            seconds, found = timed(lambda m=made, t=tracks: adjust_tracks(m.views, t))
            cpu[name].append(seconds)
            kinds = [finding.kind for finding in found.findings]
            print(f"seed {seed} {name}: {seconds:.2f} s, {kinds}", flush=True)
    print({name: round(statistics.median(seconds), 2) for name, seconds in cpu.items()})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="ratios for 100 views, too (minutes)")
    parser.add_argument("--repeat", type=int, default=3, help="interleaved runs, of which the median counts")
    parser.add_argument("--growth", action="store_true", help="CPU over the number of observations")
    parser.add_argument("--large", nargs=2, type=int, metavar=("VIEWS", "TRACKS"), help="a large block")
    parser.add_argument("--blocks", nargs="+", type=int, metavar="VIEWS", help="growth with views, by stage")
    parser.add_argument("--a-view", type=int, default=50, help="tracks a view of these blocks")
    parser.add_argument("--one-block", nargs=2, type=int, help=argparse.SUPPRESS)
    parser.add_argument("--fill", nargs="+", type=int, metavar="VIEWS", help="other orders of elimination")
    parser.add_argument("--against", metavar="COMMIT", help="adjustments with defaults beside another commit's")
    parser.add_argument("--series", type=int, metavar="VIEWS", help="views of one place")
    parser.add_argument("--jump", action="store_true", help="one flawed view of 36")
    parser.add_argument("--ceres", action="store_true", help="plain adjustments beside Ceres")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    asked = {
        growth: arguments.growth and (10,),
        large: arguments.large,
        one_block: arguments.one_block,
        blocks: arguments.blocks and (arguments.blocks, arguments.a_view),
        against: arguments.against and (arguments.against, arguments.repeat),
        jump: arguments.jump and (arguments.repeat,),
        series: arguments.series and (arguments.series,),
        ceres.compare: arguments.ceres and (arguments.repeat,),
        fill: arguments.fill and (arguments.fill,),
    }
    sizes = [(3, 2000), (10, 5000), (30, 10000), (100, 30000)]
    for function, values in asked.items():
        if values:
            function(*values)
    if not any(asked.values()):
        ratios(sizes if arguments.all else sizes[:3], arguments.repeat)


if __name__ == "__main__":
    main()
