"""What scenes of one sensor tell of its detector line, and what that does to heights of scenes that it never saw.

Scenes are simulated: three or four pushbroom images of one place from looks and scans of any direction, orbits and
attitudes off by metres and microradians, drifts, tie points of 0.1 px over relief of any size. The detector line bends
(`KINDS`: low polynomials; random waves and kinks), has eight chips, and every line takes 1e-4 longer than stated. Each
scene is adjusted as by `barpc adjust`, the curve is learnt from all (`barpc calibrate`, but for files), and new pairs,
along one track and crossing, are adjusted without and with it.

px: the RMS of curve found less truth, beside a constant and a slope, columns within 5 px of a step left out; said: what
it says of itself over that. bent: RMS of heights of a pair beside a plane, a twist and bends along the axes [m].

    OMP_NUM_THREADS=1 python benchmarks/calibrate.py                    # 50 scenes
    OMP_NUM_THREADS=1 python benchmarks/calibrate.py --scenes 12 --kind waves --tails
    OMP_NUM_THREADS=1 python benchmarks/calibrate.py --table refusals           # what is refused of 20 sensors
    OMP_NUM_THREADS=1 python benchmarks/calibrate.py --table said               # error over said, RMS of 20 sensors
    OMP_NUM_THREADS=1 python benchmarks/calibrate.py --table sizes --count 1000 # CPU and memory by runs
    OMP_NUM_THREADS=1 python benchmarks/calibrate.py --table prior              # without a calibration
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from barpc.ba import Adjustment, adjust_tracks
from barpc.ba.calibration import Learnt, Line, SensorTies, contradicts, learn, share_shown
from barpc.ba.interior import Calibration, CommonErrors
from barpc.base.errors import InputError
from barpc.base.geodesy import Array, enu_basis, ground_from_ecef, metres_per_unit
from barpc.base.statistics import SURE
from barpc.fit import fit_rpc
from barpc.scene import IntArray, Tracks, View
from barpc.sensor.centers import camera_center
from barpc.sensor.corrected import Corrected, Correction
from barpc.simulate import Look, fly

SIZE, GSD = (20000, 12000), 0.5
SMALL = (6000, 4000)
FEWEST = 300  # observations of a block of parts that tells something
LINE_RATE = 1e-4
Curve = Callable[[Array], Array]
"""Columns (n,) -> what a detector line does there (n, 2) [px]."""


def _polynomials(u: Array, rng: np.random.Generator) -> Array:
    legendre = np.polynomial.legendre.legval(
        u, rng.normal(0, 1, (6, 2)) * np.array([0, 0, 0.3, 0.2, 0.15, 0.1])[:, None]
    )
    return np.asarray(legendre.T)


def _waves(u: Array, rng: np.random.Generator) -> Array:
    """Return random waves, to an eighth of the line, and three kinks."""
    out = np.zeros((len(u), 2))
    for k in range(1, 9):
        phase, size = rng.uniform(0, 2 * np.pi, 2), rng.normal(0, 0.3, 2) / k
        out += size * np.sin(np.pi * k * u[:, None] + phase)
    for at in rng.uniform(-0.9, 0.9, 3):
        out += rng.normal(0, 0.3, 2) * np.abs(u[:, None] - at)
    return out


KINDS = {"polynomials": _polynomials, "waves": _waves}


@dataclass(frozen=True)
class Sensor:
    """A detector line: its curve, and where its chips begin."""

    curve: Curve
    edges: Array

    @classmethod
    def made(cls, kind: str, seed: int, chips: int = 8, size: tuple[int, int] = SIZE) -> Sensor:
        """Return a sensor whose chips are 0.1 to 0.5 px off each other, in any direction."""
        rng = np.random.default_rng(seed)
        edges = size[0] * (np.arange(1, chips) + rng.uniform(-0.2, 0.2, chips - 1)) / chips
        turn, length = rng.uniform(0, 2 * np.pi, chips - 1), rng.uniform(0.1, 0.5, chips - 1)
        steps = np.stack([np.cos(turn), np.sin(turn)], axis=1) * length[:, None]
        begun = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        shape = rng.integers(1 << 31)

        def curve(col: Array) -> Array:
            u = (2.0 * col + 1.0) / size[0] - 1.0
            return KINDS[kind](u, np.random.default_rng(shape)) + begun[np.searchsorted(edges, col, side="right")]

        return cls(curve, edges)

    def seen(self, image: Array, size: tuple[int, int]) -> Array:
        """Return where points that a perfect line has at (n, 2) [px] are seen."""
        image = image + LINE_RATE * np.stack([np.zeros(len(image)), image[:, 1] - size[1] / 2], axis=1)
        out = image
        for _ in range(20):
            out = image + self.curve(out[:, 0])
        return out


PERFECT = Sensor(lambda col: np.zeros((len(col), 2)), np.zeros(0))


@dataclass(frozen=True)
class Scene:
    """Images of a place as they are delivered, their tie points, and the ground of these."""

    views: tuple[View, ...]
    tracks: Tracks
    ground: Array
    cameras: tuple[Corrected, ...]  # exact, but for the detector line


def any_looks(count: int, rng: np.random.Generator) -> list[Look]:
    """Return looks from any side, scanning in any direction."""
    return [
        Look(rng.uniform(5, 25), rng.uniform(0, 360), heading=rng.choice([192, 348]), scan=rng.uniform(0, 360))
        for _ in range(count)
    ]


def in_track(rng: np.random.Generator) -> list[Look]:
    """Return a stereo pair of one pass, whose images stand a tenth of the swath beside each other."""
    side = rng.uniform(2, 8, 2) * [1, -1]
    return [Look(14.0, (192 + a + s) % 360) for a, s in zip((0, 180), side, strict=True)]


def crossing(rng: np.random.Generator) -> list[Look]:
    """Return a pair that scans across each other."""
    turn = rng.uniform(60, 120)
    return [Look(14.0, 12.0, scan=192.0), Look(14.0, 192.0, scan=(192.0 + turn) % 360)]


def scene(
    looks: list[Look],
    sensor: Sensor,
    rng: np.random.Generator,
    tracks: int = 900,
    tails: bool = False,
    size: tuple[int, int] = SIZE,
    noise: float = 0.1,
    wrong: float = 0.02,
) -> Scene:
    """Return a scene: off by 10 urad, 1 m and a drift of 2 urad; with `tails` noise is Student's of 2.5."""
    target = np.array([rng.uniform(-60, 60), rng.uniform(-50, 50), 300.0])
    relief = rng.choice([20.0, 200.0, 1500.0]) * min(size[0] / SIZE[0], 1.0)
    alts = (300.0 - relief, 300.0 + relief)
    views, cameras = [], []
    for i, look in enumerate(looks):
        place = target + np.array([*rng.uniform(-0.1, 0.1, 2) * np.array(size) * GSD, 0.0]) / metres_per_unit(target)
        rpc = fit_rpc(fly(place, look, size, GSD), size, (alts[0] - 50, alts[1] + 50), strict=False).rpc
        views.append(View(f"v{i}", "", size, rpc, (alts[0] - 50, alts[1] + 50), "2020-01-01"))
        centre = camera_center(rpc, size, alts, "line").ecef
        drift = rng.normal(0, 2e-6, (1, 3))
        turned = Correction(rng.normal(0, 1e-5, 3), rng.normal(0, 1, 3), centre, drift, size[1] / 2, size[1] / 2)
        cameras.append(Corrected(rpc, turned))
    reach = 0.7 * max(size) * GSD
    ground = target + np.column_stack([rng.uniform(-reach, reach, (12 * tracks, 2)), np.zeros(12 * tracks)]) / (
        metres_per_unit(target)
    )
    ground[:, 2] = rng.uniform(*alts, len(ground))
    rows: list[list[Array]] = [[], [], []]
    for v, camera in enumerate(cameras):
        image = sensor.seen(camera.project(ground), size)
        inside = np.flatnonzero(((image >= 0) & (image <= np.array(size) - 1)).all(axis=1))
        for part, one in zip(rows, (np.full(len(inside), v), inside, image[inside]), strict=True):
            part.append(one)
    view, point, xy = (np.concatenate(part) for part in rows)
    count = np.bincount(point, minlength=len(ground))
    used = np.flatnonzero(count >= 2)[:tracks]
    keep = np.isin(point, used)
    view, point, xy = view[keep], np.searchsorted(used, point[keep]), xy[keep]
    order = np.lexsort((view, point))
    scatter = rng.standard_t(2.5, xy.shape) if tails else rng.normal(0, 1, xy.shape)
    xy = xy + noise * scatter + (rng.random(len(xy)) < wrong)[:, None] * rng.uniform(-30, 30, xy.shape)
    return Scene(
        tuple(views), Tracks(view[order], point[order], xy[order], np.full(len(xy), 0.1)), ground[used], tuple(cameras)
    )


def finished(made: Scene, name: str) -> tuple[Adjustment, SensorTies]:
    """Return a scene adjusted, and what it tells."""
    found = adjust_tracks(made.views, made.tracks)
    return found, SensorTies.of(name, made.views, made.tracks, found.bases, ground_from_ecef(found.points))


def off(found: Learnt, sensor: Sensor, width: int = SIZE[0]) -> tuple[Array, Array]:
    """Return the errors (2,) of the two coordinates [px], and what they are said to be."""
    cols = np.arange(5.0, width - 5.0, 3.0)
    cols = cols[np.abs(cols[:, None] - sensor.edges).min(axis=1, initial=np.inf) > 5.0]
    wrong = found.spline.at(cols) - sensor.curve(cols)
    wrong -= np.polynomial.polynomial.polyval(cols, np.polynomial.polynomial.polyfit(cols, wrong, 1)).T
    return np.sqrt((wrong**2).mean(axis=0)), found.curve.sizes(found.covariance)


def with_curve(made: Scene, found: Learnt) -> Adjustment:
    """Return a scene adjusted with a calibration."""
    used = Calibration("", found.spline, found.covariance, "", "")
    tracks = replace(made.tracks, xy=found.spline.undo(made.tracks.xy))
    return adjust_tracks(made.views, tracks, common=CommonErrors((used,) * len(made.views)))


def _bends(made: Scene, index: IntArray) -> Array:
    """Return what takes a plane, a twist and bends along the axes, which cameras' drifts make, off heights (n,)."""
    middle = made.ground.mean(axis=0)
    east, north = ((made.ground - middle) * metres_per_unit(middle))[index, :2].T / 5e3
    rows = np.stack([np.ones_like(east), east, north, east * north, east**2, north**2], axis=1)
    return np.asarray(np.eye(len(rows)) - rows @ np.linalg.pinv(rows))


def bent(made: Scene, found: Adjustment) -> float:
    """Return how far heights are bent [m], the RMS."""
    height = (ground_from_ecef(found.points) - made.ground)[:, 2]
    index = np.flatnonzero(np.isfinite(height))
    return float(np.sqrt(np.mean((_bends(made, index) @ height[index]) ** 2)))


def bent_as_said(made: Scene, found: Adjustment) -> tuple[float, float, float]:
    """Return how far heights are bent [m], the RMS; its standard deviation by the cameras, and with common errors."""
    ground, inliers = (
        ground_from_ecef(found.points),
        np.bincount(made.tracks.point[found.inlier], minlength=len(made.ground)),
    )
    index = np.flatnonzero(np.isfinite(ground).all(axis=1) & (inliers >= 2) & ~found.held)[::2]
    bends, up, covariance = _bends(made, index), enu_basis(ground[index])[:, 2], found.covariance
    by_unknown = covariance.reduced.carried(
        np.eye(len(covariance.free)).reshape(len(made.views), -1, len(covariance.free)), index
    )
    height = bends @ (ground - made.ground)[index, 2]
    rows = bends @ np.einsum("ni,nik->nk", up, by_unknown)
    cameras = np.einsum("nk,kl,nl->n", rows, covariance.of_noise.full, rows).mean()
    assert covariance.shared is not None
    shared = ((bends @ np.einsum("ni,nik->nk", up, covariance.shared_moves(index))) ** 2).sum(axis=1).mean()
    return float(np.sqrt((height**2).mean())), float(np.sqrt(cameras)), float(np.sqrt(cameras + shared))


def pairs(found: Learnt, sensor: Sensor, rng: np.random.Generator, count: int) -> None:
    """Print what the curve does to pairs that it was not learnt from, of tie points with next to no noise."""
    for name, looks in (("in track", in_track), ("crossing", crossing)):
        for _ in range(count):
            at, seed = looks(rng), int(rng.integers(1 << 31))
            made, best = (
                scene(at, line, np.random.default_rng(seed), 600, noise=0.005, wrong=0.0) for line in (sensor, PERFECT)
            )
            before, after = bent(made, adjust_tracks(made.views, made.tracks)), bent(made, with_curve(made, found))
            least = bent(best, adjust_tracks(best.views, best.tracks))
            print(f"{name}: heights bent by {before:.3f} m, with the calibration {after:.3f} m, of a perfect line "
                  f"{least:.3f} m", flush=True)  # fmt: skip


def said(sensors: int, kind: str, scenes: int = 12) -> Array:
    """Return the RMS over sensors of errors over what is said (2,): 1 where it is said right, neither more nor less."""
    ratio = []
    for seed in range(sensors):
        rng, sensor = np.random.default_rng(seed), Sensor.made(kind, seed, chips=4, size=SMALL)
        found = learn([exact(scene(any_looks(3, rng), sensor, rng, 700, size=SMALL)) for _ in range(scenes)])
        wrong, sigma = off(found, sensor, SMALL[0])
        ratio.append(wrong / sigma)
    return np.asarray(np.sqrt(np.mean(np.square(ratio), axis=0)))


def exact(made: Scene, name: str = "") -> SensorTies:
    """Return what a scene tells whose cameras are known but for the detector line."""
    return SensorTies.of(name, made.views, made.tracks, made.cameras, made.ground)


def parts(made: Scene, rng: np.random.Generator, share: float, loose: float = 0.0) -> tuple[Scene, Line]:
    """Return a scene whose images are random parts of the line, and where they lie on it; `loose`: to how many px."""
    width = made.views[0].size[0]
    count, views, cameras = round(width * share), [], []
    start = np.round(rng.uniform(0.0, width - count, len(made.views)))
    for view, camera, first in zip(made.views, made.cameras, start, strict=True):
        views.append(replace(view, size=(count, view.size[1]), sensor=view.sensor.crop(first, 0.0)))
        cameras.append(Corrected(camera.sensor.crop(first, 0.0), camera.correction))
    tracks = made.tracks
    xy = tracks.xy - np.stack([start[tracks.view], np.zeros(len(tracks))], axis=1)
    keep = (xy[:, 0] >= 0) & (xy[:, 0] <= count - 1)
    keep &= (np.bincount(tracks.point[keep], minlength=tracks.num_points) >= 2)[tracks.point]
    used = np.unique(tracks.point[keep])
    some = Tracks(tracks.view[keep], np.searchsorted(used, tracks.point[keep]), xy[keep], tracks.sigma[keep])
    guess = start + rng.normal(0.0, loose, len(start)) if loose else start
    line = Line(width, guess, np.full(len(start), loose))
    return Scene(tuple(views), some, made.ground[used], tuple(cameras)), line


def crops_row(seed: int, kind: str, runs: int, share: float, tracks: int = 3000) -> str:
    """Return the error of a curve by runs of random parts of the line, and the error over what is said."""
    rng, sensor, blocks = np.random.default_rng(seed), Sensor.made(kind, seed, chips=4, size=SMALL), list[SensorTies]()
    while len(blocks) < runs:
        made, line = parts(scene(any_looks(3, rng), sensor, rng, tracks, size=SMALL), rng, share)
        if len(made.tracks) > FEWEST and len(np.unique(made.tracks.view)) > 1:
            blocks.append(SensorTies.of("", made.views, made.tracks, made.cameras, made.ground, line))
    found = learn(blocks)
    (wrong, said), some = off(found, sensor, SMALL[0]), int(np.median([len(one.view) for one in blocks]))
    over = f"{wrong[0] / said[0]:.2f} / {wrong[1] / said[1]:.2f}"
    return f"{runs} runs of parts of {share:.1f}, {some} ties: {wrong[0]:.4f} / {wrong[1]:.4f} px, over said {over}"


def shorter_row(seed: int, kind: str, missing: int = 88) -> str:
    """Return the error of the place of shorter products, whose columns are cut off at one side, and of the curve."""
    rng, sensor, blocks, cut = np.random.default_rng(seed), Sensor.made(kind, seed, chips=4, size=SMALL), [], SMALL[0]
    for i in range(8):
        made = scene(any_looks(3, rng), sensor, rng, 700, size=SMALL)
        line = Line(cut, np.zeros(3), np.zeros(3))
        if i % 2:
            made, where = parts(made, np.random.default_rng(0), 1.0 - missing / cut)
            line = Line(cut, np.full(3, missing / 2.0), np.full(3, missing / np.sqrt(12.0)))
            true = where.start
        blocks.append((SensorTies.of("", made.views, made.tracks, made.cameras, made.ground, line), made, line))
    found = learn([one[0] for one in blocks])
    places = [line.start + shift - true for (_, _, line), shift in list(zip(blocks, found.shifts, strict=True))[1::2]]
    wrong, said = off(found, sensor, SMALL[0])
    place = f"{np.abs(places).max():.1f} px (said {np.max(np.concatenate(found.shift_sigmas)):.1f})"
    over = f"{wrong[0] / said[0]:.2f} / {wrong[1] / said[1]:.2f}"
    return f"shorter products: places to {place}, curve to {wrong[0]:.4f} / {wrong[1]:.4f} px, over said {over}"


def others(sensor: Sensor, seed: int, width: int) -> dict[str, Sensor]:
    """Return lines that a calibration of a sensor is not of; binned: of half of its columns, two in one."""
    curve = sensor.curve
    return {
        "another sensor": Sensor.made("polynomials", 1000 + seed, chips=4, size=(width, 0)),
        "columns mirrored": Sensor(lambda col: np.array([-1.0, 1.0]) * curve(width - 1.0 - col), sensor.edges),
        "binned by 2": Sensor(lambda col: curve(col / 2.0) * 2.0, 2.0 * sensor.edges),
        "without distortion": PERFECT,
    }


def shown(made: Scene, found: Learnt) -> tuple[float, float]:
    """Return the share of a calibration that the tie points of a block adjusted with it show, and its sigma."""
    adjusted = with_curve(made, found)
    bases, ground = adjusted.bases, ground_from_ecef(adjusted.points)
    seen = np.isfinite(ground[made.tracks.point]).all(axis=1)
    rows = Tracks(*(part[seen] for part in (made.tracks.view, made.tracks.point, made.tracks.xy, made.tracks.sigma)))
    return share_shown(SensorTies.of("", made.views, rows, bases, ground), found.spline)


def refusals(seed: int) -> dict[str, bool]:
    """Return what was refused of a sensor: by its name what should be, and its own new block, which should not."""
    rng, sensor = np.random.default_rng(seed), Sensor.made("polynomials", seed, chips=4, size=SMALL)
    blocks = [exact(scene(any_looks(3, rng), sensor, rng, 500, size=SMALL)) for _ in range(8)]
    found, out, looks = learn(blocks), dict[str, bool](), any_looks(3, rng)
    for name, line in {"its own": sensor, **others(sensor, seed, SMALL[0])}.items():
        made = scene(looks, line, np.random.default_rng(seed), 500, size=SMALL)
        out[name] = contradicts(*shown(made, found))
    later = Sensor(lambda col: sensor.curve(col) + 0.2 * np.cos(col[:, None] / 700.0), sensor.edges)
    more = [exact(scene(any_looks(3, rng), later, rng, 500, size=SMALL)) for _ in range(5)]
    out["changed, 8 + 5 runs"], out["unchanged"] = learn([*blocks, *more]).change[1] > SURE, found.change[1] > SURE
    with suppress(InputError):
        learn(blocks[:2])
        out["two runs"] = False
    return {"two runs": True, **out}


def size_row(runs: int) -> str:
    """Return CPU seconds and memory of learning from so many runs: those of 20 scenes, their noise drawn anew."""
    rng, sensor = np.random.default_rng(1), Sensor.made("polynomials", 1)
    made = [exact(scene(any_looks(3, rng), sensor, rng)) for _ in range(min(runs, 20))]
    blocks = []
    for i in range(runs):
        one = made[i % len(made)]
        noise = rng.normal(0, 0.1, one.xy.shape)
        blocks.append(replace(one, xy=one.xy + noise, residual=one.residual - noise))
    start, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = learn(blocks)
    used = time.process_time() - start
    more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return f"{runs} runs: {used:.1f} CPU s, {more:.0f} MB more, {len(found.curve.edges)} steps"


def prior_row(name: str, seed: int) -> tuple[float, float, float]:
    """Return how far heights of a block are bent, and that by what is said without and with the prior (see `main`)."""
    rng = np.random.default_rng(seed)
    looks = {"in track": in_track, "crossing": crossing}.get(name, lambda rng: any_looks(3, rng))(rng)
    line = PERFECT if name == "no distortion" else Sensor.made(list(KINDS)[seed % 2], seed)
    made = scene(looks, line, rng, 600, noise=0.005, wrong=0.0)
    prior = Calibration.prior("", SIZE[0])
    common = CommonErrors((prior,) * len(made.views))
    bent_by, cameras, both = bent_as_said(made, adjust_tracks(made.views, made.tracks, common=common))
    return bent_by, bent_by / cameras, bent_by / both


def print_refusals(count: int) -> None:
    """Print what was refused of some sensors, and how often each."""
    found = []
    for seed in range(count):
        found.append(refusals(seed))
        print(", ".join(name for name, is_refused in found[-1].items() if is_refused), flush=True)
    for name in found[0]:
        print(f"{name}: refused {sum(one[name] for one in found)} of {count}")


def tables(which: str, count: int, kind: str) -> None:
    """Print a table beside that of the scenes."""
    if which == "said":
        print(f"{count} sensors, 12 small scenes each: error over said, RMS {np.round(said(count, kind), 2)}")
    elif which == "refusals":
        print_refusals(count)
    elif which == "sizes":
        for runs in (3, 12, 50, 200, 1000):
            if runs <= count:
                subprocess.run([sys.executable, __file__, "--table", "size", "--count", str(runs)], check=True)
    elif which == "crops":
        for seed in range(count):
            print(crops_row(seed, kind, 12, 0.7), shorter_row(seed, kind), sep="\n", flush=True)
    elif which == "size":
        print(size_row(count), flush=True)
    else:
        for name, blocks in {"in track": 6, "crossing": 6, "any": 6, "no distortion": 20}.items():
            rows = np.array([prior_row(name, seed) for seed in range(min(blocks, count))])
            square = (rows[:, 1:] ** 2).mean(axis=0)
            print(f"{name}: heights bent by {np.median(rows[:, 0]):.3f} m, at most {rows[:, 0].max():.3f}; squared "
                  f"over said {square[0]:.2f} without, {square[1]:.2f} with the prior", flush=True)  # fmt: skip


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--tracks", type=int, default=900)
    parser.add_argument("--kind", choices=list(KINDS), default="polynomials")
    parser.add_argument("--tails", action="store_true", help="noise with heavy tails")
    parser.add_argument("--pairs", type=int, default=3, help="pairs of either kind to try it on")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--table", choices=["scenes", "said", "crops", "refusals", "sizes", "size", "prior"], default="scenes"
    )
    parser.add_argument("--count", type=int, default=20, help="sensors, blocks or, at most, runs of another table")
    given = parser.parse_args()
    if given.table != "scenes":
        tables(given.table, given.count, given.kind)
        return
    rng, sensor = np.random.default_rng(given.seed), Sensor.made(given.kind, given.seed)
    start, blocks = time.process_time(), []
    for i in range(given.scenes):
        made = scene(any_looks(rng.integers(3, 5), rng), sensor, rng, given.tracks, given.tails)
        blocks.append(finished(made, f"scene {i}")[1])
    made_in = time.process_time() - start
    start = time.process_time()
    found = learn(blocks)
    seconds = time.process_time() - start
    (wrong, said), size = off(found, sensor), np.sqrt((sensor.curve(np.arange(0.0, SIZE[0], 10)) ** 2).mean(axis=0))
    print(f"{given.scenes} scenes ({made_in:.1f} CPU s to adjust), curve of {size[0]:.3f} / {size[1]:.3f} px: to "
          f"{wrong[0]:.4f} / {wrong[1]:.4f} px, over said {wrong[0] / said[0]:.2f} / {wrong[1] / said[1]:.2f}, "
          f"{len(found.curve.edges)} steps, scatter {found.scatter:.2f}, {seconds:.2f} CPU s")  # fmt: skip
    print(
        f"held out: {found.rms[0]:.4f} -> {found.rms[1]:.4f} of the noise, {np.sum(found.gain > 0)} of {given.scenes} "
        "met better"
    )
    pairs(found, sensor, rng, given.pairs)


if __name__ == "__main__":
    main()
