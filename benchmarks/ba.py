"""The bundle adjustment against finite-difference scipy, and how it grows.

The baseline is what the closest peer does, on the same observations: `least_squares` over rotations and points
together, derivatives by finite differences with `jac_sparsity`, steps by LSMR, `x_scale="jac"`, projections by rpcm
where it is installed (else by barpc, several times faster). Both solve the plain least-squares problem; the baseline
until it stops by itself, which is not at the minimum: the last column says how far above. CPU seconds of this
process, one thread.

    OMP_NUM_THREADS=1 python benchmarks/ba.py             # ratios for 3, 10, 30 (and --all: 100) views
    python benchmarks/ba.py --growth                      # CPU seconds for 5k .. 800k observations
    python benchmarks/ba.py --large 1000 200000           # views, tracks: seconds and peak memory
    python benchmarks/ba.py --step 10000 500000           # one step of the solver
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time
import warnings

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.ba.adjustment import make_problem
from barpc.ba.block import join
from barpc.ba.rounds import Observations
from barpc.ba.solve import State, camera_step
from barpc.geodesy import ecef_from_ground, ground_from_ecef
from barpc.sensor.corrected import rotation_matrix
from barpc.sensor.geometry import triangulate
from barpc.sensor.rpc import RPC
from barpc.simulate import Block, simulate_block

try:
    import rpcm
except ImportError:
    rpcm = None

PLAIN = {"loss": "linear", "estimate_noise": False, "noise_floor": 0.0, "min_convergence": 0.0}


def adjust(block: Block, model: str = "rotation", **options: object) -> Adjustment:
    """The block by barpc, plain least squares."""
    centers = np.array([correction.center for correction in block.truth.corrections])
    chosen = AdjustOptions(**{**PLAIN, "model": model, "sigma_attitude": 1e4, **options})
    return adjust_tracks(block.views, block.tracks, chosen, centers=centers)


class Baseline:
    """Rotations and points in one vector, finite differences."""

    def __init__(self, block: Block) -> None:
        self.block = block
        self.centers = np.array([correction.center for correction in block.truth.corrections])
        tracks = block.tracks
        self.rows = [np.flatnonzero(tracks.view == v) for v in range(len(block.views))]
        start = triangulate([v.sensor for v in block.views], tracks.view, tracks.point, tracks.xy)
        self.project = [_projection(view.sensor) for view in block.views]
        self.middle = start.points.mean(axis=0)
        self.start = np.concatenate([np.zeros(3 * len(block.views)), (start.points - self.middle).ravel()])

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Whitened residuals (2 K,)."""
        tracks, n = self.block.tracks, len(self.block.views)
        rotation, points = x[: 3 * n].reshape(n, 3), x[3 * n :].reshape(-1, 3) + self.middle
        out = np.empty((len(tracks), 2))
        for v, rows in enumerate(self.rows):
            lever = points[tracks.point[rows]] - self.centers[v]
            moved = lever @ rotation_matrix(rotation[v]).T + self.centers[v]
            out[rows] = self.project[v](ground_from_ecef(moved)) - tracks.xy[rows]
        return (out / tracks.sigma[:, None]).ravel()

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

    def solve(self) -> float:
        """Twice the cost at which it stops."""
        found = least_squares(
            self.residual, self.start, jac="2-point", jac_sparsity=self.sparsity(), method="trf",
            tr_solver="lsmr", x_scale="jac", ftol=1e-10, xtol=1e-15, gtol=1e-15, max_nfev=400,
        )  # fmt: skip
        return 2.0 * float(found.cost)


def _projection(rpc: RPC):
    """Ground (n, 3) -> image (n, 2): rpcm's, where it is installed."""
    if rpcm is None:
        return rpc.project
    names = ("col_num", "col_den", "row_num", "row_den")
    fields = {name: list(row) for name, row in zip(names, rpc.coeffs, strict=True)}
    pairs = zip(("lon", "lat", "alt", "col", "row"), (*rpc.ground_offset, *rpc.image_offset), strict=True)
    fields |= {f"{name}_offset": value for name, value in pairs}
    pairs = zip(("lon", "lat", "alt", "col", "row"), (*rpc.ground_scale, *rpc.image_scale), strict=True)
    fields |= {f"{name}_scale": value for name, value in pairs}
    model = rpcm.RPCModel(fields, dict_format="rpcm")
    return lambda ground: np.stack(model.projection(*ground.T), axis=-1)


def timed(func):
    start = time.process_time()
    value = func()
    return time.process_time() - start, value


def ratios(sizes: list[tuple[int, int]], repeat: int) -> None:
    print("views tracks observations | barpc s  baseline s  ratio | baseline's cost over barpc's - 1")
    for views, tracks in sizes:
        block = simulate_block(views, tracks, seed=1, attitude=6e-6, position=1e-6)
        mine, theirs = [], []
        for n in range(repeat):
            mine.append(timed(lambda block=block: adjust(block)))
            if n == 0 or views < 30:
                theirs.append(timed(lambda block=block: Baseline(block).solve()))
        a, b = (statistics.median(seconds for seconds, _ in runs) for runs in (mine, theirs))
        excess = theirs[0][1] / mine[0][1].cost_history[-1] - 1
        print(
            f"{views:5d} {tracks:6d} {len(block.tracks):9d}    | {a:7.3f}  {b:9.2f}  {b / a:6.1f} | {excess:.1e}",
            flush=True,
        )


def growth(views: int) -> None:
    """CPU seconds over observations, at a fixed number of views."""
    counts, seconds = [], []
    for tracks in (1200, 5000, 20000, 80000, 200000):
        block = simulate_block(views, tracks, seed=1, attitude=6e-6, num_checks=0)
        runs = [adjust(block, "rotation+translation", sigma_attitude=4.0).seconds for _ in range(3)]
        counts.append(len(block.tracks))
        seconds.append(statistics.median(runs))
        print(
            f"{counts[-1]:8d} observations: {seconds[-1]:7.3f} s, {1e6 * seconds[-1] / counts[-1]:.2f} us each"
        )
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


def step(views: int, tracks: int) -> None:
    """One linearisation, elimination, factorisation and solution."""
    block = simulate_block(views, tracks, seed=1, attitude=6e-6, num_checks=0)
    centers = np.array([correction.center for correction in block.truth.corrections])
    options = AdjustOptions(**PLAIN)
    joined = join(block.views, block.tracks, None, options)
    problem = make_problem(joined, options, centers, None)
    state = State(problem.camera_prior.mean, ecef_from_ground(block.truth.ground))
    weight = Observations(problem, joined.sigma, 0.0, joined.use).weight(joined.use, 1.0)
    linear, reduced = timed(lambda: problem.reduce(state.params, state.points, weight))
    solved, (_, _, factor) = timed(lambda: camera_step(problem, reduced))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    neighbours = 2 * len(reduced.structure.pair_view) / views
    print(
        f"{views} views, {len(joined.view)} observations, {neighbours:.1f} neighbours a view: linearise and eliminate "
        f"{linear:.1f} s, factorise ({factor.method}) and solve {solved:.1f} s, peak {peak:.2f} GB"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--all", action="store_true", help="ratios for 100 views, too (minutes)")
    parser.add_argument("--repeat", type=int, default=3, help="interleaved runs, of which the median counts")
    parser.add_argument("--growth", action="store_true", help="CPU over the number of observations")
    parser.add_argument("--large", nargs=2, type=int, metavar=("VIEWS", "TRACKS"), help="a large block")
    parser.add_argument(
        "--step", nargs=2, type=int, metavar=("VIEWS", "TRACKS"), help="one step of a large block"
    )
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    if arguments.growth:
        growth(10)
    elif arguments.large:
        large(*arguments.large)
    elif arguments.step:
        step(*arguments.step)
    else:
        sizes = [(3, 2000), (10, 5000), (30, 10000), (100, 30000)]
        ratios(sizes if arguments.all else sizes[:3], arguments.repeat)


if __name__ == "__main__":
    main()
