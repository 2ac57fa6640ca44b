"""The yardstick: how accurate `barpc adjust` is on real images and on crops of them, by independent points.

    python benchmarks/real_crops.py [--data ../shared/data] [--folder FOLDER]... [--only SET]... [--crops 20] [--seed 0]
                                    [--checkout DIR] [--jobs 1] [--cache DIR] [--json FILE] [-- OPTIONS of adjust...]
    python benchmarks/real_crops.py --only ventoux --crops 4 -- --drift 0 --jitter off
    python benchmarks/real_crops.py --checkout ../old --json old.json    # another version, on the same crops

Sets: whole and north (Pleiades triplets), ventoux (Pleiades pair), quickbird (QuickBird and aerial frames), xs
(multispectral and panchromatic), and each --folder. Cases of a set:
  whole       the set as it is delivered
  crop N      a random window of the first image, 40-95 % of a side, and of the others one about as large around the
              same ground; it depends on the set's name, --seed and N alone. Images that see too little of it are left
              out; where the others are not connected by pairs of 30 points, it is drawn again
  shift20     the RPC of the last image is moved by 12, -16 px
  yaw         it is turned by 3 mrad and enlarged by 0.2 %
  along300    it is moved by 300 m of ground along the rows
  pointing31  the RPCs of all images are moved, 31 px RMS, each in a direction of its own
Every image is written as a GeoTIFF with its RPC in the tag. The independent points are those of tools/ncc_check.py
beside the data (dense correlation and least-squares matching of the whole images, made once, kept in --cache); where
it finds fewer than 30 in a pair, SIFT matches filtered by a fundamental matrix, as benchmarks/real.py makes them. All
count, outliers too. Cameras are read through GDAL and measured by that tool's own formula.

Columns, each of the worst pair of a case:
  median      median epipolar residual [px]; asked: 0.02 at most. Beside it its pair's points, and its standard error,
              1.2533 * 1.4826 MAD / sqrt(points): below twice that it is noise
  band        how much larger the median of an eighth of the rows or columns of a pair's first image is than that of
              the delivered cameras moved by one shift a pair [px]; asked: 0.03 at most
  from whole  of changed RPCs: how far medians and bands are from those of the case `whole` [px]; asked: 0.02 at most
A row that misses any of these, or does not end with exit code 0, is marked; what it misses is in bold.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import itertools
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402  (the thread counts come first)
import rasterio  # noqa: E402
from rasterio.errors import NotGeoreferencedWarning  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import barpc  # noqa: E402
from barpc.base.geodesy import Array, ecef_from_ground  # noqa: E402
from barpc.sensor.rpc import RPC  # noqa: E402
from benchmarks.real import check_points, measured  # noqa: E402
from benchmarks.real_sets import Change, Scene, as_rasterio, change_tag, of_folder  # noqa: E402
from tests.geotiffs import write_image  # noqa: E402

STEP = 16  # px between independent points
FEWEST = 30  # points of a pair
MARGIN = 12.0  # px from the edge of a crop: half a patch of the points
BANDS, FEWEST_IN_BAND = 8, 12
SIDE = 0.40, 0.95  # of a crop, in sides of the image
JITTER, SEEN = 0.1, 0.15  # of a crop's side: its place in other images; what of it they must show
DRAWS, ALONE = 20, "one image sees it"
MEDIAN, BAND, FROM_WHOLE = 0.02, 0.03, 0.02  # px: asked
ALONG, POINTING = 300.0, 31.0  # m, px

Window = tuple[int, int, int, int]
"""First col and row, width and height [px]."""


@dataclass(frozen=True, eq=False)
class Image:
    """An image of a set: its pixels (rows, cols) and the RPC delivered."""

    name: str
    pixels: Array
    rpc: RPC

    @property
    def size(self) -> tuple[int, int]:
        """Width, height [px]."""
        return self.pixels.shape[1], self.pixels.shape[0]

    @property
    def window(self) -> Window:
        """All of it."""
        return (0, 0, *self.size)

    def write(self, folder: Path, window: Window) -> Path:
        """Write a part of the image with its RPC; return the file."""
        col, row, width, height = window
        path, rpcs = folder / f"{self.name}.tif", as_rasterio(self.rpc, np.array([col, row]))
        rpcs.err_bias, rpcs.err_rand = self.rpc.err_bias, self.rpc.err_rand
        write_image(path, self.pixels[row : row + height, col : col + width], rpcs=rpcs, nodata=0)
        return path


@dataclass(frozen=True, eq=False)
class Pair:
    """Independent points of two images of a set."""

    i: int
    j: int
    points: Array  # (N, 4): col, row, col, row [px] in the whole images
    how: str = "dense"
    delivered: Array = field(default_factory=lambda: np.empty(0))  # (N,) residuals [px] of the cameras delivered

    def inside(self, case: Case) -> Array:
        """Return which points both windows of a case show (N,)."""
        shown = np.ones(len(self.points), bool)
        for image, places in ((self.i, self.points[:, :2]), (self.j, self.points[:, 2:])):
            col, row, width, height = case.windows[image]
            low, high = np.array([col, row]), np.array([col + width, row + height]) - 1
            shown &= ((places >= low + case.margin) & (places <= high - case.margin)).all(axis=1)
        return shown


@dataclass(frozen=True, eq=False)
class Block:
    """A set with its independent points."""

    name: str
    images: tuple[Image, ...]
    pairs: tuple[Pair, ...] = ()
    altitude: float = 0.0  # median of the points [m]
    left_out: tuple[str, ...] = ()  # pairs, with the reason


@dataclass(frozen=True)
class Case:
    """What is adjusted: parts of images by the number of the image, and the changes of RPCs."""

    name: str
    windows: Mapping[int, Window]
    margin: float = 0.0
    changes: Mapping[int, Change] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Measured:
    """The cameras of a pair by its independent points."""

    pair: str
    points: int
    median: float
    error: float  # standard error of the median
    delivered: float  # median of the cameras delivered
    bands: Array  # (2 * BANDS,) medians of rows, columns; NaN where there are few points
    excess: Array  # (2 * BANDS,) what their absolute values have more than those of one shift a pair

    def told(self) -> dict[str, object]:
        """For a file."""
        return {key: _plain(value) for key, value in asdict(self).items()}


@dataclass(frozen=True, eq=False)
class Result:
    """What became of a case."""

    set: str
    case: str
    code: int | None  # None: not run
    said: str
    cpu: float = np.nan
    pairs: tuple[Measured, ...] = ()
    missing: tuple[str, ...] = ()  # images without a camera
    windows: Mapping[str, Window] = field(default_factory=dict)
    whole: Result | None = None  # of changed RPCs: the case without changes

    @property
    def worst(self) -> Measured | None:
        """The pair of the largest median."""
        return max(self.pairs, key=lambda one: abs(one.median), default=None)

    @property
    def median(self) -> float:
        """The largest median, with its sign [px]; NaN where a camera is missing."""
        return self.worst.median if self.worst and not self.missing else np.nan

    @property
    def band(self) -> float:
        """The largest excess of a band [px]; NaN where there is none."""
        all_of_them = [one.excess for one in self.pairs] if not self.missing else []
        return _largest(all_of_them)

    @property
    def from_whole(self) -> float:
        """The largest difference of a median or band from those of the case without changes [px]."""
        if self.whole is None or self.missing or self.whole.missing:
            return np.nan
        both = zip(self.pairs, self.whole.pairs, strict=True)
        return _largest([np.abs(np.append(a.bands - b.bands, a.median - b.median)) for a, b in both])

    def meets(self) -> dict[str, bool]:
        """Whether it has what is asked, by columns; a set without bands of enough points misses no band."""
        bandless = bool(self.pairs) and not self.missing and np.isnan(self.band)
        asked = {"exit": self.code == 0, "median": abs(self.median) <= MEDIAN, "band": self.band <= BAND or bandless}
        if self.whole is not None:
            asked["from whole"] = self.from_whole <= FROM_WHOLE
        return {key: bool(met) for key, met in asked.items()}

    def row(self) -> str:
        """For the table."""
        if self.code is None:
            return f"| {self.case} | - | - | - | - | - | - | - | - | {_cell(self.said)} |"
        meets, worst = self.meets(), self.worst
        told = {"exit": str(self.code), "median": _pixels(self.median), "band": _pixels(self.band)}
        told["from whole"] = "" if self.whole is None else _pixels(self.from_whole)
        cells = {key: text if meets.get(key, True) else f"**{text}**" for key, text in told.items()}
        of, points, error = (worst.pair, worst.points, f"{worst.error:.3f}") if worst else ("", 0, "")
        said = "; ".join([self.said, *(f"no camera of {name}" for name in self.missing)])
        mark = "" if all(meets.values()) else "MISSED"
        of_pair = [cells["median"], error, f"{points} {of}".strip(), cells["band"], cells["from whole"]]
        return f"| {' | '.join([self.case, mark, cells['exit'], *of_pair, f'{self.cpu:.1f}', _cell(said)])} |"

    def told(self) -> dict[str, object]:
        """For a file."""
        numbers = {key: _plain(getattr(self, key)) for key in ("median", "band", "from_whole", "cpu")}
        meets = self.meets() if self.code is not None else {}
        return {
            "set": self.set, "case": self.case, "code": self.code, "said": self.said, **numbers, "meets": meets,
            "points": self.worst.points if self.worst else 0, "error": _plain(self.worst.error) if self.worst else None,
            "missing": self.missing, "windows": self.windows, "pairs": [one.told() for one in self.pairs],
        }  # fmt: skip


HEAD = (
    "| case | | exit | median [px] | s.e. | points | band [px] | from whole [px] | CPU s | result |\n"
    + "|---" * 10
    + "|"
)
SUMMARY = (
    f"| set | cases | exit 0 | median <= {MEDIAN} | or within 2 s.e. of it | bands <= {BAND} | "
    f"from whole <= {FROM_WHOLE} | CPU s |\n" + "|---" * 8 + "|"
)


def summary(name: str, results: Iterable[Result]) -> str:
    """The row of a set."""
    ran = [one for one in results if one.code is not None]
    meets, changed = [one.meets() for one in ran], [one for one in ran if one.whole is not None]

    def share(found: Sequence[bool]) -> str:
        return f"{sum(found)}/{len(found)}"

    near = [abs(one.median) <= MEDIAN + 2 * one.worst.error if one.worst else False for one in ran]
    cells = [share([one[key] for one in meets]) for key in ("exit", "median", "band")]
    cells.insert(2, share(near))
    cells.append(share([one.meets()["from whole"] for one in changed]))
    return f"| {name} | {len(ran)} | {' | '.join(cells)} | {sum(one.cpu for one in ran):.0f} |"


def _cell(text: str) -> str:
    short = " ".join(text.replace("|", "/").split())
    return short if len(short) <= 140 else f"{short[:137]}..."


def _pixels(value: float) -> str:
    return f"{value:+.3f}" if np.isfinite(value) else "-"


def _plain(value: Any) -> Any:
    """A value as JSON has it: no arrays, and null where it has no number."""
    if isinstance(value, np.ndarray):
        return [_plain(one) for one in value.tolist()]
    return (round(value, 5) if np.isfinite(value) else None) if isinstance(value, float) else value


def _largest(parts: Sequence[Array]) -> float:
    values = np.concatenate([np.empty(0), *parts])
    return float(np.nanmax(values)) if np.isfinite(values).any() else np.nan


# --- sets ----------------------------------------------------------------------------------------------------


def sets(data: Path) -> Iterator[Scene]:
    """The sets of the data, absent ones with the reason."""
    optical, cross = data / "optical", data / "cross_sensor"
    left, right = (optical / f"phr_ventoux/{side}_image.tif" for side in ("left", "right"))
    frames = sorted((cross / "ngi_2015").glob("ngi_*.tif"))
    found = {
        "whole": sorted((optical / "phr_triplet_whole").glob("img_0?.tif")),
        "north": sorted((optical / "phr_triplet_north").glob("img_0?.tif")),
        "ventoux": [left, right],
        "quickbird": [optical / "qb2_single/qb2_basic1b.tif", *frames],
        "xs": [cross / "phr_ventoux_xs/left_xs.tif", right],
    }
    for name, paths in found.items():
        absent = next((f"{path} is absent" for path in paths if not path.is_file()), "")
        yield Scene(name, tuple(paths), missing=absent or ("" if len(paths) > 1 else "fewer than two images"))


def load(path: Path) -> Image:
    """The first band of an image and its RPC, wherever that is."""
    with rasterio.open(path) as file:
        return Image(path.stem, file.read(1), barpc.open_camera(path).rpc)


def load_tool(path: Path) -> ModuleType:
    """The module of `ncc_check.py`."""
    spec = importlib.util.spec_from_file_location("ncc_check", path)
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool


def make_block(scene: Scene, tool: ModuleType, cache: Path) -> Block:
    """Load a set and find its independent points, or take them from the cache."""
    images = tuple(load(path) for path in scene.images)
    with tempfile.TemporaryDirectory() as folder:
        paths = [image.write(Path(folder), image.window) for image in images]
        found = independent(paths, tool, cache)
        cameras = [tool.Cam.gdal(path) for path in paths]
    pairs, left_out, heights = [], [], []
    for one in found:
        if len(one.points) < FEWEST:
            left_out.append(f"{images[one.i].name} {images[one.j].name}: {len(one.points)} {one.how}")
            continue
        off, alt = tool.epi(cameras[one.i], cameras[one.j], one.points[:, :2], one.points[:, 2:])
        pairs.append(Pair(one.i, one.j, one.points, one.how, off))
        heights.append(alt)
    altitude = float(np.median(np.concatenate(heights))) if heights else np.nan
    return Block(scene.name, images, tuple(pairs), altitude, tuple(left_out))


def independent(paths: Sequence[Path], tool: ModuleType, cache: Path) -> list[Pair]:
    """Independent points of all pairs of images, which are kept in a folder of the cache."""
    digest = hashlib.sha256(Path(str(tool.__file__)).read_bytes() + f"{STEP} {FEWEST}".encode())
    for path in paths:
        digest.update(path.name.encode() + path.read_bytes())
    place = cache / f"real_crops_{digest.hexdigest()[:16]}"
    place.mkdir(parents=True, exist_ok=True)
    sift: dict[tuple[str, str], Path] | None = None
    found = []
    for i, j in itertools.combinations(range(len(paths)), 2):
        kept = place / f"{i}_{j}.npz"
        if not kept.is_file():
            points, how = _dense(tool, paths[i], paths[j]), "dense"
            if len(points) < FEWEST:
                sift = check_points(Scene("", tuple(paths)), paths[0].parent) if sift is None else sift
                how = f"SIFT (dense {len(points)})"
                points = _of_table(sift.get((paths[i].stem, paths[j].stem)))
            with tempfile.NamedTemporaryFile(dir=place, suffix=".npz", delete=False) as file:
                np.savez(file, points=points, how=np.array(how))
            Path(file.name).replace(kept)
        with np.load(kept) as told:
            found.append(Pair(i, j, told["points"], str(told["how"])))
    return found


def _dense(tool: ModuleType, a: Path, b: Path) -> Array:
    """Points (N, 4) of a pair, none where the coarse stage finds no place of one image in the other."""
    A, B, first, second = tool.Cam.gdal(a), tool.Cam.gdal(b), tool.read(a), tool.read(b)
    if tool.coarse(A, B, first, second) is None:
        return np.empty((0, 4))
    points: Array = np.asarray(tool.dense(A, B, first, second, step=STEP)[0], float).reshape(-1, 4)
    return points


def _of_table(path: Path | None) -> Array:
    return np.empty((0, 4)) if path is None else np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)


# --- cases ---------------------------------------------------------------------------------------------------


def cases(block: Block, crops: int, seed: int) -> Iterator[Case | Result]:
    """The cases of a set but `whole`; a crop that cannot be had is a result that says why."""
    for number in range(1, crops + 1):
        drawn = draw(block, number, seed)
        yield drawn if isinstance(drawn, Case) else Result(block.name, f"crop {number}", None, f"skipped: {drawn}")
    everything = whole(block).windows
    for name, changes in perturbations(block, seed).items():
        yield Case(name, everything, changes=changes)


def whole(block: Block) -> Case:
    """The set as it is."""
    return Case("whole", {number: image.window for number, image in enumerate(block.images)})


def draw(block: Block, number: int, seed: int) -> Case | str:
    """Draw a crop of a set, or say why there is none; it depends on the set's name, the seed and its number."""
    reason = ""
    for attempt in range(DRAWS):
        rng = np.random.default_rng([seed, number, attempt, *block.name.encode()])
        case = Case(f"crop {number}", _windows(block, rng), MARGIN)
        lacks = _unconnected(block, case)
        if not lacks:
            return case
        reason = reason if reason and lacks == ALONE else lacks
    return f"{reason}, of {DRAWS} draws"


def _windows(block: Block, rng: np.random.Generator) -> dict[int, Window]:
    """Windows of the images that pairs connect: one at random, the others around its ground."""
    first, *others = sorted({number for pair in block.pairs for number in (pair.i, pair.j)})
    size = np.array(block.images[first].size)
    extent = np.rint(size * rng.uniform(*SIDE, 2)).astype(int)
    corner = rng.integers(0, size - extent, endpoint=True)
    found = {first: _window(corner, corner + extent)}
    ring = corner + (extent - 1) * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5]])
    ground = block.images[first].rpc.localize(ring, np.full(len(ring), block.altitude))
    for number in others:
        image = block.images[number]
        seen = image.rpc.project(ground)
        extent = np.ptp(seen[:4], axis=0)
        middle = seen[4] + JITTER * extent * rng.uniform(-1, 1, 2)
        low, high = (np.clip(np.rint(middle + by * extent / 2), 0, image.size).astype(int) for by in (-1, 1))
        if (high - low >= np.maximum(SEEN * extent, 1)).all():
            found[number] = _window(low, high)
    return found


def _window(low: Array, high: Array) -> Window:
    (col, row), (width, height) = low.tolist(), (high - low).tolist()
    return col, row, width, height


def _unconnected(block: Block, case: Case) -> str:
    """Say what lacks for all images of a case to be connected by pairs with enough points; nothing: it is well."""
    if len(case.windows) < 2:
        return ALONE
    counts = {
        (pair.i, pair.j): int(pair.inside(case).sum())
        for pair in block.pairs
        if {pair.i, pair.j} <= case.windows.keys()
    }
    reached = {min(case.windows)}
    for _ in case.windows:
        reached |= {n for ends, count in counts.items() if count >= FEWEST and reached & {*ends} for n in ends}
    few = ", ".join(f"{block.images[i].name} {block.images[j].name} {n}" for (i, j), n in counts.items() if n < FEWEST)
    return "" if reached == case.windows.keys() else f"points of pairs: {few or 'none'}"


def perturbations(block: Block, seed: int) -> dict[str, dict[int, Change]]:
    """Changes of RPCs by the number of their image."""
    last = len(block.images) - 1
    rng = np.random.default_rng([seed, *block.name.encode()])
    shifts = rng.normal(size=(len(block.images), 2))
    shifts *= POINTING / np.sqrt((shifts**2).sum(axis=1).mean())
    rows = ALONG / row_size(block.images[last], block.altitude)
    return {
        "shift20": {last: Change((12.0, -16.0))},
        "yaw": {last: Change(yaw=3e-3, scale=2e-3)},
        "along300": {last: Change((0.0, rows))},
        "pointing31": {number: Change((float(col), float(row))) for number, (col, row) in enumerate(shifts)},
    }


def row_size(image: Image, altitude: float) -> float:
    """Ground from a row to the next in the image's middle [m]."""
    middle = np.array(image.size) / 2
    ends = image.rpc.localize(middle + np.array([[0.0, -5.0], [0.0, 5.0]]), np.full(2, altitude))
    return float(np.linalg.norm(np.diff(ecef_from_ground(ends), axis=0))) / 10


# --- runs ----------------------------------------------------------------------------------------------------


def run(block: Block, tool: ModuleType, options: Sequence[str], reference: Result | None, case: Case) -> Result:
    """Write the images of a case, adjust them, and measure the cameras."""
    with tempfile.TemporaryDirectory() as folder:
        paths = {}
        for number, window in case.windows.items():
            paths[number] = block.images[number].write(Path(folder), window)
            if number in case.changes:
                change_tag(paths[number], case.changes[number])
        out = Path(folder, "out")
        arguments = [*map(str, paths.values()), *options, "-o", str(out)]
        command = [sys.executable, "-m", "barpc", "-q", "adjust", *arguments]
        cpu, _, code = measured(command, Path(folder), Path(folder, "log"))
        files = {number: out / f"{block.images[number].name}.vrt" for number in paths}
        missing = tuple(block.images[number].name for number, file in files.items() if not file.is_file())
        cameras = {number: tool.Cam.gdal(file) for number, file in files.items() if file.is_file()}
        said = _said(out / "summary.json", Path(folder, "log"))
    pairs = tuple(measure(block, case, cameras, tool.epi))
    windows = {block.images[number].name: window for number, window in case.windows.items()}
    return Result(block.name, case.name, code, said, cpu, pairs, missing, windows, reference if case.changes else None)


def _said(summary: Path, log: Path) -> str:
    """The verdict and its first reason, or the last line of a run that has none."""
    if summary.is_file():
        told = json.loads(summary.read_text(encoding="utf-8"))
        return "; ".join([told["status"], *told["reasons"][:1]])
    return (log.read_text(encoding="utf-8").strip().splitlines() or ["no summary"])[-1]


def measure(
    block: Block, case: Case, cameras: Mapping[int, Any], epi: Callable[..., tuple[Array, Array]]
) -> Iterator[Measured]:
    """Measure the cameras of a case, each pair by all its independent points in both windows."""
    for pair in block.pairs:
        if not {pair.i, pair.j} <= cameras.keys():
            continue
        shown = pair.inside(case)
        if shown.sum() < FEWEST:
            continue
        first, second = (np.array(case.windows[number][:2]) for number in (pair.i, pair.j))
        a, b = pair.points[shown, :2] - first, pair.points[shown, 2:] - second
        off, _ = epi(cameras[pair.i], cameras[pair.j], a, b)
        name = f"{block.images[pair.i].name} {block.images[pair.j].name}"
        yield compare(name, off, pair.delivered[shown], a, case.windows[pair.i][2:])


def compare(pair: str, off: Array, delivered: Array, places: Array, size: tuple[int, int]) -> Measured:
    """Measure residuals beside those of the delivered cameras with one shift.

    Parameters
    ----------
    pair : str
        Names of the two images.
    off, delivered : (N,) arrays
        Residuals [px] of the cameras adjusted and of those delivered.
    places : (N, 2) array
        Col, row [px] in the first image, of `size` (width, height).
    """
    middle, shift = float(np.median(off)), float(np.median(delivered))
    error = 1.2533 * 1.4826 * float(np.median(np.abs(off - middle))) / np.sqrt(len(off))
    ours, shifted = (bands(values, places, size) for values in (off, delivered - shift))
    return Measured(pair, len(off), middle, float(error), shift, ours, np.abs(ours) - np.abs(shifted))


def bands(values: Array, places: Array, size: tuple[int, int]) -> Array:
    """Return medians (2 * BANDS,) of eighths of the rows, then of the columns; NaN where there are few points."""
    found = np.full((2, BANDS), np.nan)
    for line, axis in zip(found, (1, 0), strict=True):
        part = np.clip(np.floor(BANDS * (places[:, axis] + 0.5) / size[axis]), 0, BANDS - 1)
        for band in range(BANDS):
            if (part == band).sum() >= FEWEST_IN_BAND:
                line[band] = np.median(values[part == band])
    return found.ravel()


def results_of(block: Block, tool: ModuleType, given: argparse.Namespace) -> Iterator[Result]:
    """Run the cases of a set, `whole` first."""
    reference = run(block, tool, given.options, None, whole(block))
    yield reference
    one = partial(run, block, tool, given.options, reference)
    with ThreadPoolExecutor(given.jobs) as pool:
        yield from pool.map(
            lambda case: case if isinstance(case, Result) else one(case), cases(block, given.crops, given.seed)
        )


def arguments(argv: Sequence[str]) -> argparse.Namespace:
    """The command line; `options` are those after the first ``--``."""
    own = list(argv[: argv.index("--")] if "--" in argv else argv)
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="%(prog)s [...] [-- OPTIONS...]",
    )
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--folder", type=Path, action="append", default=[], help="images of one place, with RPCs")
    parser.add_argument("--only", action="append", default=[], metavar="SET", help="names of sets or folders")
    parser.add_argument("--crops", type=int, default=20, help="of a set")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--checkout", type=Path, default=ROOT, help="folder that holds the barpc to be run")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()), help="keeps the independent points")
    parser.add_argument("--json", type=Path, help="the figures of every case and pair")
    given = parser.parse_args(own)
    given.options = list(argv[len(own) + 1 :])
    return given


def of_set(scene: Scene, tool: ModuleType, given: argparse.Namespace) -> tuple[str, dict[str, object]]:
    """Print the table of a set; return its row of the summary, empty where it was not run, and it for a file."""
    print(f"\n## {scene.name}", flush=True)
    if scene.missing:
        print(f"Not run: {scene.missing}.", flush=True)
        return "", {"set": scene.name, "missing": scene.missing}
    block = make_block(scene, tool, given.cache)
    pairs = [
        {
            "pair": f"{block.images[one.i].name} {block.images[one.j].name}", "points": len(one.points),
            "how": one.how, "delivered": round(float(np.median(one.delivered)), 3),
        }
        for one in block.pairs
    ]  # fmt: skip
    words = [f"{one['pair']} {one['points']} {one['how']} ({one['delivered']:+.3f} px)" for one in pairs]
    print(f"Independent points (median as delivered): {'; '.join(words) or 'none'}.")
    if block.left_out:
        print(f"Pairs left out, fewer than {FEWEST} points: {'; '.join(block.left_out)}.")
    told = {"set": block.name, "points": pairs, "left_out": block.left_out}
    if not block.pairs:
        print("Not run: no pair has independent points.", flush=True)
        return "", told
    print(f"\n{HEAD}", flush=True)
    results = []
    for result in results_of(block, tool, given):
        results.append(result)
        print(result.row(), flush=True)
    return summary(block.name, results), told | {"cases": [result.told() for result in results]}


def main(argv: Sequence[str] | None = None) -> None:
    """Print the tables."""
    given = arguments(sys.argv[1:] if argv is None else argv)
    path, checkout = given.data.parent / "tools/ncc_check.py", given.checkout.resolve()
    if not path.is_file():
        sys.exit(f"{path}, which makes the independent points, is absent")
    if not (checkout / "barpc/__init__.py").is_file():
        sys.exit(f"{checkout} holds no barpc")
    os.environ["PYTHONPATH"] = str(checkout)  # of the runs
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    tool, rows, told = load_tool(path), [], []
    print(f"barpc of {checkout}, seed {given.seed}, options: {' '.join(given.options) or 'none'}", flush=True)
    for scene in (*sets(given.data), *map(of_folder, given.folder)):
        if given.only and scene.name not in given.only:
            continue
        row, of_it = of_set(scene, tool, given)
        rows += [row] if row else []
        told.append(of_it)
        if given.json:
            whole_run = {"checkout": str(checkout), "seed": given.seed, "options": given.options, "sets": told}
            given.json.write_text(json.dumps(whole_run, indent=1) + "\n", encoding="utf-8")
    if rows:
        print("\n".join(["", "## Summary", SUMMARY, *rows]))


if __name__ == "__main__":
    main()
