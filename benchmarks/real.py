"""Real images, each set by barpc and by the peers that are installed: one table, a row a set.

    python benchmarks/real.py [--data ../shared/data] [--folder FOLDER] [--cars PYTHON] [--orthority PYTHON]
                              [--only SET]...

A cell has the epipolar offset of independent points (median, spread 1.4826 MAD [px] and their number, the worst pair
of a set), CPU seconds, peak memory, the exit code and the first sentence of the result. The points are those of the
data's truth (SIFT or correlation without any RPC); of a --folder, and where the truth has none, SIFT matches made here,
filtered by a fundamental matrix; of rendered images the exact ones. Of one image it is the RMS at surveyed points, col
and row. The offset is measured by tools/epi_check.py beside the data, which has its own RPC formula and reads files
through GDAL. Tools:
  delivered  the cameras as they are
  barpc      `barpc adjust` with its defaults, and what a set gives (GCPs, DEM, reference)
  cars       cars-bundleadjustment of the interpreter given, its .geom as written and half a pixel back
  orthority  orthority's refinement by GCPs, `shift` and `shift-drift`, of the interpreter given
A set or a tool that is absent is named with the reason. The sets are in benchmarks/real_sets.py; surfaces and
orthoimages beside those of others in benchmarks/surfaces.py and orthos.py.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import cv2  # noqa: E402  (the thread counts come first)
import numpy as np  # noqa: E402
import rasterio  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from barpc.rpcio import read_rpc  # noqa: E402
from benchmarks.real_sets import (  # noqa: E402
    Scene,
    as_rasterio,
    change_tag,
    formula,
    of_folder,
    scenes,
)
from tests.geotiffs import write_image  # noqa: E402

Cameras = dict[str, Path]
"""Files by the stems of the images."""
TOOLS = (
    "delivered", "barpc", "cars, as written", "cars, half a pixel back", "orthority, shift", "orthority, shift-drift",
)  # fmt: skip
ABSENT = {"cars": "no interpreter given (--cars)", "orthority": "no interpreter given (--orthority)"}
BESIDE = """
import json, resource, subprocess, sys
code = subprocess.call(sys.argv[2:])
used = resource.getrusage(resource.RUSAGE_CHILDREN)
with open(sys.argv[1], "w") as file:
    json.dump([used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0, code], file)
"""
"""Runs a command for a process of any size, whose own peak the system would count as that of the command."""
CORNERS = ("UL", "UR", "LR", "LL")
Features = tuple[np.ndarray, np.ndarray | None]
"""Places (N, 2) [px] and descriptors of an image's keypoints."""


@dataclass
class Row:
    """One set by one tool."""

    tool: str
    offset: str = ""
    cpu: float = np.nan
    peak: float = np.nan
    code: int = 0
    said: str = ""

    def cell(self) -> str:
        """For the table."""
        cost = f"; {self.cpu:.1f} s, {self.peak:.0f} MB, exit {self.code}" if np.isfinite(self.cpu) else ""
        return f"{self.offset}{cost}{f'; {self.said}' if self.said else ''}"


def measured(command: list[str], folder: Path, log: Path) -> tuple[float, float, int]:
    """CPU seconds, peak memory [MB] and exit code of a command, run in a folder, its output in a file."""
    told = log.with_suffix(".used")
    with log.open("w") as out:
        start = [sys.executable, "-c", BESIDE, str(told), *command]
        subprocess.run(start, cwd=folder, stdout=out, stderr=subprocess.STDOUT, check=True)
    cpu, peak, code = json.loads(told.read_text())
    return cpu, peak, code


def delivered(scene: Scene, place: Path) -> tuple[Cameras, list[str]]:
    """Links to the images in a folder, the RPC of the last changed; their delivered cameras as VRTs."""
    place.mkdir()
    arguments: list[str] = []
    for path in scene.images:
        for beside in path.parent.glob(f"{path.stem}*"):
            (place / beside.name).symlink_to(beside.resolve())
        arguments.append(str(place / path.name))
    if scene.change is not None:
        last = place / scene.images[-1].name
        last.unlink()
        shutil.copy(scene.images[-1].resolve(), last)
        last.chmod(0o644)
        change_tag(last, scene.change)
    out = place / "delivered"
    run = [sys.executable, "-m", "barpc", "-q", "convert", *arguments, "-o", str(out)]
    measured(run, ROOT, place / "convert.log")
    return {Path(path).stem: out / f"{Path(path).stem}.vrt" for path in arguments}, arguments


def check_points(scene: Scene, place: Path) -> dict[tuple[str, str], Path]:
    """Files of check points by the stems of two images: given, or SIFT matches that one fundamental matrix explains."""
    if scene.ties:
        return {tuple(path.stem.split("__")[1:3]): path for path in scene.ties}  # type: ignore[misc]
    found, seen = {}, {path.stem: features(_grey(path)) for path in scene.images}
    for (a, first), (b, second) in itertools.combinations(seen.items(), 2):
        rows = matched(first, second)
        if len(rows) >= 30:
            _, kept = cv2.findFundamentalMat(rows[:, :2], rows[:, 2:], cv2.USAC_MAGSAC, 1.0, 0.999, 10000)
            found[a, b] = place / f"{a}__{b}.csv"
            header = "col_a,row_a,col_b,row_b"
            np.savetxt(found[a, b], rows[kept.ravel() > 0], delimiter=",", header=header, comments="")
    return found


def features(grey: np.ndarray) -> Features:
    """SIFT keypoints and descriptors. OpenCV's default places all points a quarter of a pixel aside in col and row:
    nothing between images of one orientation, half a pixel between images that are turned by 180 degrees.
    """
    points, described = cv2.SIFT_create(8000, enable_precise_upscale=True).detectAndCompute(grey, None)
    return np.array([point.pt for point in points]).reshape(-1, 2), described


def matched(first: Features, second: Features) -> np.ndarray:
    """Rows of col, row, col, row [px] that are nearest to each other by far."""
    if first[1] is None or second[1] is None:
        return np.empty((0, 4))
    sides = []
    for one, other in ((first, second), (second, first)):
        pairs = (pair for pair in cv2.BFMatcher().knnMatch(one[1], other[1], k=2) if len(pair) == 2)
        sides.append({near.queryIdx: near.trainIdx for near, far in pairs if near.distance < 0.7 * far.distance})
    both = np.array([(i, j) for i, j in sides[0].items() if sides[1].get(j) == i], int).reshape(-1, 2)
    return np.hstack([first[0][both[:, 0]], second[0][both[:, 1]]])


def _grey(path: Path) -> np.ndarray:
    with rasterio.open(path) as file:
        band = file.read(1).astype(np.float64)
    low, high = np.percentile(band[band > 0], (1, 99))
    return np.clip(255.0 * (band - low) / (high - low), 0, 255).astype(np.uint8)


def offsets(check: Path, cameras: Cameras, points: dict[tuple[str, str], Path]) -> str:
    """Median and spread of the epipolar offset in the pair where the median is largest."""
    worst: tuple[float, float, int] | None = None
    for (a, b), ties in points.items():
        if not (cameras.get(a, Path()).is_file() and cameras.get(b, Path()).is_file()):
            return "a camera is missing"
        run = subprocess.run(
            [sys.executable, str(check), cameras[a], cameras[b], ties],
            capture_output=True,
            text=True,
            check=False,
        )
        if run.returncode:
            return (run.stderr.strip().splitlines() or ["failed"])[-1][:80]
        said = json.loads(run.stdout)
        if worst is None or abs(said["median"]) > abs(worst[0]):
            worst = said["median"], said["spread"], said["n"]
    return "no check points" if worst is None else "{:+.3f} +- {:.3f} ({})".format(*worst)


def by_barpc(arguments: list[str], options: Iterable[str], place: Path) -> tuple[Row, Cameras]:
    """`barpc adjust` with its defaults."""
    out = place / "barpc"
    command = [sys.executable, "-m", "barpc", "-q", "adjust", *arguments, *options, "-o", str(out)]
    cpu, peak, code = measured(command, ROOT, place / "barpc.log")
    row = Row("barpc", "", cpu, peak, code)
    if (out / "summary.json").is_file():
        told = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        row.said = "; ".join([told["status"], *told["reasons"][:1]])
    else:
        row.said = (place / "barpc.log").read_text().strip().splitlines()[-1]
    return row, {Path(path).stem: out / f"{Path(path).stem}.vrt" for path in arguments}


def by_cars(interpreter: str, arguments: list[str], place: Path) -> list[tuple[Row, Cameras]]:
    """cars-bundleadjustment, its cameras as written and with the half pixel that all have in common taken back."""
    program = Path(interpreter).parent / "cars-bundleadjustment"
    names = [Path(path).stem for path in arguments]
    sensors: dict[str, dict[str, object]] = {}
    for name, path in zip(names, arguments, strict=True):
        beside = Path(path).with_suffix(".geom")
        given = {"geomodel": str(beside)} if beside.is_file() else {}
        sensors[name] = {"image": path, **given}
    pairing = [[names[0], name] for name in names[1:]]
    wanted = {"pairing": pairing, "separate": True, "nb_decimals": 0, "min_matches": 50}
    config = {
        "input": {"sensors": sensors, "pairing": pairing},
        "orchestrator": {"mode": "sequential"},
        "tie_points": {"applications": {"bundle_adjustment": wanted}},
        "output": {"directory": str(place / "cars")},
    }
    (place / "cars.json").write_text(json.dumps(config))
    cpu, peak, code = measured([str(program), str(place / "cars.json")], place, place / "cars.log")
    made = next((place / "cars").rglob("*.geom"), None)  # without rpcfit it says so, and ends with exit code 0
    said = "" if code == 0 and made else (place / "cars.log").read_text().strip().splitlines()[-1][:100]
    found = []
    for kind, back in (("as written", 0.0), ("half a pixel back", 0.5)):
        shifted = {}
        for name, path in zip(names, arguments, strict=True):
            geom = next(iter(sorted((place / "cars").rglob(f"*{name}*.geom"))), None)
            if geom is not None:
                shifted[Path(path)] = place / f"{name}_{back}.geom"
                shifted[Path(path)].write_text(_shifted(geom, path, back))
        cameras = dict.fromkeys(names, Path("absent")) | converted(shifted, place / f"cars_{back}")
        found.append((Row(f"cars, {kind}", "", cpu, peak, code, said), cameras))
    return found


def _shifted(geom: Path, image: str, pixels: float) -> str:
    """Take pixels from the places of an image in its .geom, and the crop's corner where it is that of a whole image."""
    with rasterio.open(image) as file:
        corner = (file.transform.c, file.transform.f) if file.rpcs is None and file.crs is None else (0.0, 0.0)
    less = {"samp_off": pixels + corner[0], "line_off": pixels + corner[1]}
    lines = []
    for line in geom.read_text().splitlines():
        key, _, value = line.partition(":")
        lines.append(f"{key}: {float(value) - less[key.strip()]!r}" if key.strip() in less else line)
    return "\n".join(lines) + "\n"


def converted(files: dict[Path, Path], out: Path) -> Cameras:
    """VRTs of images with cameras of other files."""
    arguments = [f"{image},camera={camera}" for image, camera in files.items()]
    if arguments:
        run = [sys.executable, "-m", "barpc", "-q", "convert", *arguments, "-o", str(out)]
        measured(run, ROOT, out.with_suffix(".log"))
    return {image.stem: out / f"{image.stem}.vrt" for image in files}


def by_orthority(interpreter: str, method: str, image: Path, gcps: Path, place: Path) -> tuple[Row, Cameras]:
    """Refinement of an RPC by orthority, from GCPs."""
    place.mkdir(parents=True)
    program = [str(Path(interpreter).parent / "oty"), "rpc", "--export-params", "--gcp-refine", str(gcps)]
    program += ["--refine-method", method, "--out-dir", str(place), str(image)]
    cpu, peak, code = measured(program, place, place / "orthority.log")
    return Row(f"orthority, {method}", "", cpu, peak, code), converted({image: place / "rpc_param.yaml"}, place / "vrt")


Refine = Callable[[Path, Path], tuple[Row, Cameras]]
"""The row and the camera of the control points of a file, made in a new folder."""


def held_out(refine: Refine, check: Path, points: Path, place: Path) -> Row:
    """A tool's row, by residuals of control points each of which was held out of one run."""
    told = json.loads(points.read_text(encoding="utf-8"))
    all_of_them, row, off, cpu = told["features"], Row(""), [], 0.0
    for number, one in enumerate(all_of_them):
        part = place / f"without_{number}"
        part.mkdir(parents=True)
        (part / "rest.geojson").write_text(
            json.dumps(told | {"features": [*all_of_them[:number], *all_of_them[number + 1 :]]})
        )
        (part / "one.geojson").write_text(json.dumps({"features": [one]}))
        row, cameras = refine(part / "rest.geojson", part / "run")
        (camera,) = cameras.values()
        if not camera.is_file():
            return replace(row, offset="a camera is missing")
        off.append(residuals(check, camera, part / "one.geojson"))
        cpu += row.cpu
    return replace(row, offset=_rms_of(np.concatenate(off)), cpu=cpu / len(all_of_them))


def rows(scene: Scene, check: Path, tools: argparse.Namespace) -> Iterator[Row]:
    """The rows of a set."""
    if scene.missing:
        yield Row("delivered", said=scene.missing)
        return
    with tempfile.TemporaryDirectory() as folder:
        if scene.corners:
            yield from _rows_of_corners(scene.images[0], check, Path(folder))
            return
        if scene.make is not None:
            Path(folder, "made").mkdir()
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:  # its memory is not that of the tools
                scene = pool.submit(scene.make, Path(folder, "made")).result()
        place = Path(folder, "set")
        cameras, arguments = delivered(scene, place)
        if scene.held and scene.gcps is not None:
            yield from _rows_of_gcps(scene.gcps, check, tools, cameras, arguments, place)
            return
        points = check_points(scene, place)
        measure: Callable[[Cameras], str] = lambda found: offsets(check, found, points)  # noqa: E731
        if scene.gcps is not None:
            measure = lambda found: of_gcps(check, found, scene.gcps)  # noqa: E731
        yield Row("delivered", measure(cameras))
        for row, found in _runs(scene, tools, arguments, place):
            yield replace(row, offset=measure(found))


def _runs(scene: Scene, tools: argparse.Namespace, arguments: list[str], place: Path) -> Iterator[tuple[Row, Cameras]]:
    """What every tool makes of a set."""
    yield by_barpc(arguments, scene.options, place)
    if tools.cars and len(arguments) > 1:
        yield from by_cars(tools.cars, arguments, place)


def _rows_of_gcps(
    points: Path, check: Path, tools: argparse.Namespace, cameras: Cameras, arguments: list[str], place: Path
) -> Iterator[Row]:
    """Rows of one image whose control points are held out in turn."""
    yield Row("delivered", of_gcps(check, cameras, points))
    (argument,) = arguments

    def ours(gcps: Path, out: Path) -> tuple[Row, Cameras]:
        out.mkdir()
        return by_barpc(arguments, ("--gcp", str(gcps)), out)

    yield replace(held_out(ours, check, points, place / "held"), tool="barpc")
    for method in ("shift", "shift-drift") if tools.orthority else ():
        refine: Refine = lambda gcps, out: by_orthority(tools.orthority, method, Path(argument), gcps, out)  # noqa: B023, E731
        yield held_out(refine, check, points, place / method)


def _rows_of_corners(xml: Path, check: Path, place: Path) -> Iterator[Row]:
    """Rows of a camera without pixels: how far the vendor's corners, of unknown height, lie off their line of sight."""
    text = xml.read_text(encoding="utf-8")
    said = {key: float(value) for key, value in re.findall(r"<(\w+)>\s*([-+.\d]+)\s*</", text)}
    right, last = said["NUMCOLUMNS"] - 1, said["NUMROWS"] - 1
    seen = np.array([[0.0, 0.0], [right, 0.0], [right, last], [0.0, last]])
    rpcs = as_rasterio(read_rpc(xml), np.zeros(2))
    ground = [(said[f"{one}LON"], said[f"{one}LAT"], rpcs.height_off + up) for up in (-100, 100) for one in CORNERS]
    write_image(place / "rpc.tif", np.ones((8, 8), np.uint8), rpcs=rpcs, nodata=0)
    yield Row("delivered", across(formula(check).Rpc(place / "rpc.tif").project(np.array(ground)), seen))
    np.savetxt(place / "points.csv", ground, delimiter=",", header="lon,lat,alt", comments="", fmt="%.10f")
    command = [sys.executable, "-m", "barpc", "project", f"{xml},model=physical", "--points", str(place / "points.csv")]
    cpu, peak, code = measured(command, ROOT, place / "project.log")
    found = np.loadtxt(place / "project.log", delimiter=",", skiprows=1)
    yield Row("barpc", across(found, seen), cpu, peak, code, "the physical model of the file")


def across(projected: np.ndarray, seen: np.ndarray) -> str:
    """Median and spread of the distance of image points (N, 2) from lines through N points, then N others, (2 N, 2)."""
    low, high = np.split(projected, 2)
    along = (high - low) / np.linalg.norm(high - low, axis=1)[:, None]
    off = along[:, 0] * (seen - low)[:, 1] - along[:, 1] * (seen - low)[:, 0]
    middle = np.median(off)
    return f"{middle:+.3f} +- {1.4826 * np.median(np.abs(off - middle)):.3f} ({len(off)})"


def residuals(check: Path, camera: Path, points: Path) -> np.ndarray:
    """Residuals (N, 2) [px] of surveyed points in one image, by the RPC formula of `check`."""
    rows = json.loads(points.read_text(encoding="utf-8"))["features"]
    ground = np.array([one["geometry"]["coordinates"] for one in rows])
    seen = np.array([one["properties"]["ji"] for one in rows])
    off: np.ndarray = formula(check).Rpc(camera).project(ground) - seen
    return off


def of_gcps(check: Path, cameras: Cameras, points: Path) -> str:
    """Root mean square residual of surveyed points in one image, col and row [px]."""
    (camera,) = cameras.values()
    return _rms_of(residuals(check, camera, points)) if camera.is_file() else "a camera is missing"


def _rms_of(off: np.ndarray) -> str:
    col, row = np.sqrt((off**2).mean(axis=0))
    return f"GCPs {col:.2f}, {row:.2f} ({len(off)})"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--folder", type=Path, action="append", default=[], help="images of one place")
    parser.add_argument("--cars", metavar="PYTHON", help="interpreter that has cars-bundleadjustment")
    parser.add_argument("--orthority", metavar="PYTHON", help="interpreter that has orthority")
    parser.add_argument("--only", nargs="+", default=[], help="parts of the names of sets")
    given = parser.parse_args()
    tool = given.data.parent / "tools/epi_check.py"
    if not tool.is_file():
        sys.exit(f"{tool}, which measures the check points, is absent")
    tools = [name for name in TOOLS if getattr(given, name.split(",")[0], True)]
    print(f"| set | {' | '.join(tools)} |\n|{'---|' * (len(tools) + 1)}")
    for scene in (*scenes(given.data), *map(of_folder, given.folder)):
        if not given.only or any(part in scene.name for part in given.only):
            found = {row.tool: row.cell() for row in rows(scene, tool, given)}
            print(f"| {scene.name} | {' | '.join(found.get(name, '-') for name in tools)} |", flush=True)
    for name, why in ABSENT.items():
        if not getattr(given, name):
            print(f"{name}: {why}")


if __name__ == "__main__":
    main()
