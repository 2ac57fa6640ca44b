"""Errors planted into real pixels, and what barpc makes and says of them.

One image of a set is resampled (cubic splines): from some row on, or some column, its content lies elsewhere, or rows
of it are lost; its RPC stays. Truth: the cameras that the untouched set ends with, and the warp of that image.

Points on a grid over the warped image, at the altitudes of the nearest tie points, have their true places in all
images by the truth, and are intersected from these by the cameras adjusted (P_BA), so that what a block may do freely,
move as a whole and put points at any altitude, does not count. The error of a point is the longest difference between
the residuals of two images: a jump that nothing followed counts as what of it shows. Points within half a patch of the
edge do not count: their pixels are of both sides. The table has the RMS over all points, by the untouched cameras and
by those adjusted, and that of the worst 5 % of rows or columns.

    python -m benchmarks.planted --data DATA                       # all sets, one of each kind and size an image
    python -m benchmarks.planted --data DATA --set triplet --kind jump --seeds 0-4 --json planted.json
    python -m tests.scenes large --views 2 --size 5000 5000 && python -m benchmarks.planted --images large/view_0*.tif
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402  (the thread counts come first)
import numpy.typing as npt  # noqa: E402
import rasterio  # noqa: E402
from rasterio.errors import NotGeoreferencedWarning  # noqa: E402
from scipy.ndimage import shift  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

import barpc  # noqa: E402
from barpc.base.errors import BarpcError  # noqa: E402
from barpc.base.geodesy import ground_from_ecef  # noqa: E402
from barpc.pipeline.loading import load_views  # noqa: E402
from barpc.scene import View  # noqa: E402
from barpc.sensor import SensorModel  # noqa: E402
from barpc.sensor.triangulation import triangulate  # noqa: E402
from tests.everywhere import rows_of  # noqa: E402
from tests.geotiffs import write_image  # noqa: E402

Array = npt.NDArray[np.float64]

_NORTH = [f"phr_triplet_north/img_0{n}.tif" for n in (1, 2, 3)]
SETS = {
    "triplet": _NORTH,
    "pair 12": _NORTH[:2],
    "pair 23": _NORTH[1:],
    "pair 13": _NORTH[::2],
    "ventoux": ["phr_ventoux/left_image.tif", "phr_ventoux/right_image.tif"],
}
SIZES = {"jump": (0.6, 1.0, 1.5, 2.0, 3.0, 6.0, 12.0), "detector": (0.5, 1.0, 2.0, 3.0), "lost": (1.0, 2.0, 3.0, 6.0)}
GOOD, FOLLOWED = 0.15, 0.05  # px
_EDGE = 11.0  # px: half a patch that is registered, and the sampler's taps


@dataclass(frozen=True)
class Plant:
    """An error in one image: from `start` to `stop` along `axis` (0 columns, 1 rows) content is moved by `by` [px].

    `lost`: that many rows are missing, so that the image is shorter.
    """

    kind: str
    view: int
    axis: int
    start: int
    by: tuple[float, float]
    stop: int | None = None  # None: to the image's end

    def pixels(self, image: Array) -> Array:
        """Return the image as it is delivered."""
        if self.kind == "lost":
            return np.delete(image, np.s_[self.start : self.start - round(self.by[1])], axis=0)
        moved = shift(image, self.by[::-1], order=3, mode="nearest") if any(self.by) else image
        ends = np.s_[self.start : self.stop]
        part = (np.s_[:], ends) if self.axis == 0 else ends
        out = image.copy()
        out[part] = moved[part]
        return out

    def before(self, xy: Array) -> Array:
        """Return the places (N, 2) in the untouched image of what is shown at places (N, 2)."""
        place, stop = xy[:, self.axis, None], np.inf if self.stop is None else self.stop - 0.5
        return xy - np.where((place > self.start - 0.5) & (place < stop), np.array(self.by), 0.0)

    def __str__(self) -> str:
        along, end = "rows" if self.axis else "columns", "on" if self.stop is None else f"to {self.stop}"
        return f"{self.kind} {self.by[0]:+.1f}, {self.by[1]:+.1f} px from {self.start} of the {along} {end}"


@dataclass(frozen=True, eq=False)
class Clean:
    """A set as it is: its views, and the cameras that it ends with."""

    name: str
    views: tuple[View, ...]
    sensors: tuple[SensorModel, ...]
    ground: cKDTree  # tie points, lon, lat [deg]
    heights: Array  # [m]
    seconds: float

    @property
    def altitude(self) -> float:
        """Median [m]."""
        return float(np.median(self.heights))

    def on_ground(self, view: int, xy: Array) -> Array:
        """Return the ground points (N, 3) that a view shows at places (N, 2) [px]."""
        sensor, heights = self.sensors[view], np.full(len(xy), self.altitude)
        for _ in range(4):
            near = self.ground.query(sensor.localize(xy, heights)[:, :2], k=5)[1]
            heights = np.median(self.heights[near], axis=1)
        return sensor.localize(xy, heights)


@dataclass(frozen=True)
class Result:
    """What became of one case."""

    set: str
    image: str
    size: float
    plant: str
    code: int
    status: str
    error: float
    worst: float
    shown: float  # the error of the untouched cameras: what of the plant these images can show
    named: tuple[str, ...]
    right: bool
    seconds: float
    words: tuple[str, ...]

    def line(self) -> str:
        """One row of the table."""
        said = " ".join(self.words)[:150]
        fault = "GOOD AND WRONG" if self.code == 0 and self.worst > GOOD else ""
        cells = [
            f"{self.set:8s} {self.image:12s} {self.plant:48s}",
            f"{self.code} {self.status:8s} {self.shown:6.2f} -> {self.error:5.3f} {self.worst:6.3f}",
            f"{'+'.join(self.named) or '-':24s} {'right' if self.right else '-':5s} {self.seconds:5.1f} s",
            f"{fault} {said}",
        ]
        return " | ".join(cells)


def run(views: Sequence[View]) -> tuple[barpc.AdjustResult | None, str, float]:
    """Adjust; also why it could not be done, and the CPU seconds."""
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return barpc.adjust(views, Path(folder) / "out"), "", time.process_time() - start
        except BarpcError as error:
            return None, f"{type(error).__name__}: {error}", time.process_time() - start


def clean(name: str, data: Path) -> Clean:
    """Run a set as it is."""
    views = load_views([data / "optical" / path for path in SETS[name]]).views
    result, said, seconds = run(views)
    if result is None:
        raise SystemExit(f"{name}: {said}")
    points = result.adjustment.points
    ground = ground_from_ecef(points[np.isfinite(points).all(axis=1)])
    return Clean(name, views, result.adjustment.sensors, cKDTree(ground[:, :2]), ground[:, 2], seconds)


def shared(clean: Clean, view: int) -> Array:
    """Return the first and last (col, row) of the part of a view that all others see (2, 2) [px]."""
    xy, seen = _shown(clean, view, clean.views[view].size, None)
    return np.stack([xy[seen].min(axis=0), xy[seen].max(axis=0)])


def _shown(clean: Clean, view: int, size: tuple[int, int], plant: Plant | None) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return places on a grid over a view (N, 2) [px], and which of them all views see."""
    step = max(8.0, max(size) / 128.0)
    axes = [np.arange(4.0, length - 4.0, step) for length in size]
    xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    places = _places(clean, view, xy, plant)
    inside = [((p > 10) & (p < np.array(v.size) - 11)).all(axis=1) for p, v in zip(places, clean.views, strict=True)]
    return xy, np.all(inside, axis=0)


def _places(clean: Clean, view: int, xy: Array, plant: Plant | None) -> list[Array]:
    """Return where all views show what one shows at places (N, 2) [px]."""
    source = xy if plant is None else plant.before(xy)
    ground = clean.on_ground(view, source)
    return [xy if v == view else sensor.project(ground) for v, sensor in enumerate(clean.sensors)]


def measured(clean: Clean, plant: Plant, size: tuple[int, int], sensors: Sequence[SensorModel]) -> tuple[float, float]:
    """Return the RMS of the error [px], and that of the worst 5 % of the planted view's rows or columns."""
    xy, seen = _shown(clean, plant.view, size, plant)
    xy = xy[seen & (np.abs(xy[:, plant.axis] - plant.start + 0.5) > _EDGE)]
    places = np.stack(_places(clean, plant.view, xy, plant), axis=1)  # (N, V, 2)
    found = triangulate(sensors, *rows_of(places), alt=clean.altitude)
    off = found.residuals.reshape(places.shape)
    apart = np.linalg.norm(off[:, :, None] - off[:, None], axis=-1).max(axis=(1, 2))
    worst = 0.0
    for axis in (0, 1):
        part = np.floor(20.0 * xy[:, axis] / size[axis])
        worst = max(worst, *(_rms(apart[part == p]) for p in np.unique(part) if (part == p).sum() >= 12))
    return _rms(apart), worst


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def plants(clean: Clean, kinds: Sequence[str], seed: int) -> Iterator[tuple[float, Plant]]:
    """Yield one plant an image, kind and size: direction, sign and place (10-90 % of what is shared) by the seed."""
    for view in range(len(clean.views)):
        low, high = shared(clean, view)
        for kind in kinds:
            for size in SIZES[kind]:
                rng = np.random.default_rng([seed, view, int(10 * size), *map(ord, kind + clean.name)])
                axis = 0 if kind == "detector" else 1
                start = round(low[axis] + rng.uniform(0.1, 0.9) * (high[axis] - low[axis]))
                along = 1 if kind == "lost" else int(rng.integers(2))
                sign = -1.0 if kind == "lost" else float(rng.choice([-1.0, 1.0]))
                by = np.zeros(2)
                by[along] = sign * size
                yield size, Plant(kind, view, axis, start, (float(by[0]), float(by[1])))


def _written(plant: Plant, source: str, folder: Path) -> tuple[Path, tuple[int, int]]:
    """Write the image as it is delivered; return its path and size."""
    with rasterio.open(source) as file:
        pixels = file.read(1)
    kept = np.iinfo(pixels.dtype)
    warped = np.clip(np.rint(plant.pixels(pixels.astype(np.float64))), kept.min, kept.max).astype(pixels.dtype)
    return write_image(folder / Path(source).name, warped), warped.shape[::-1]


def planted(clean: Clean, plant: Plant, size: float, folder: Path) -> Result:
    """Plant an error, run, and measure."""
    views, one = list(clean.views), clean.views[plant.view]
    path, shape = _written(plant, one.path, folder)
    views[plant.view] = replace(one, path=str(path), size=shape)
    result, said, seconds = run(views)
    names = [view.name for view in clean.views]
    if result is None:
        numbers, said = (float("nan"),) * 3, said.replace(str(folder), "")
        return Result(clean.name, one.name, size, str(plant), 1, "refused", *numbers, (), False, seconds, (said,))
    sensors = dict(zip(result.adjustment.names, result.adjustment.sensors, strict=True))
    error, worst = measured(clean, plant, shape, [sensors[name] for name in names])
    told = result.summary
    words = (told["headline"], *told["verdict"], *told["reasons"])
    named = tuple(name for name in names if any(name in text for text in words))
    right = named == (one.name,) if len(names) > 2 else one.name in named
    shown = measured(clean, plant, shape, clean.sensors)[0]
    code, status, numbers = 0 if result.passed else 3, told["status"], (error, worst, shown)
    return Result(clean.name, one.name, size, str(plant), code, status, *numbers, named, right, seconds, words)


def _summary(results: Sequence[Result]) -> str:
    wrong = sum(r.code == 0 and r.worst > GOOD for r in results)
    followed = sum(r.error <= FOLLOWED for r in results)
    seen = [r for r in results if not r.shown <= GOOD]
    return (
        f"{len(results)} cases: {wrong} good and wrong by more than {GOOD} px, {followed} followed to {FOLLOWED} px; "
        f"of {len(seen)} that show more than {GOOD} px {sum(r.right for r in seen)} name the image, alone of three; "
        f"median {np.median([r.seconds for r in results] or [0.0]):.1f} CPU s"
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(), help="folder that holds optical/")
    parser.add_argument("--images", nargs="+", help="a set of these images instead")
    parser.add_argument("--set", nargs="*", choices=[*SETS], default=[*SETS])
    parser.add_argument("--kind", nargs="*", choices=[*SIZES], default=[*SIZES])
    parser.add_argument("--sizes", nargs="*", type=float, help="of the plants [px]; all by default")
    parser.add_argument("--seeds", default="0", help="as 0-4")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(argv)
    first, _, last = given.seeds.partition("-")
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    SETS["images"] = [str(Path(path).resolve()) for path in given.images or ()]
    results = []
    for name in ["images"] if given.images else given.set:
        start = clean(name, given.data)
        print(f"{name}: untouched {start.seconds:.1f} CPU s", flush=True)
        for seed in range(int(first), int(last or first) + 1):
            for size, plant in plants(start, given.kind, seed):
                if given.sizes and size not in given.sizes:
                    continue
                with tempfile.TemporaryDirectory() as folder:
                    results.append(planted(start, plant, size, Path(folder)))
                print(results[-1].line(), flush=True)
    print(_summary(results))
    if given.json:
        given.json.write_text(json.dumps([asdict(r) for r in results], indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
