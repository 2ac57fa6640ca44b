"""Real images, each set by barpc and by the peers that are installed: one table, a row a set.

    python benchmarks/real.py [--data ../shared/data] [--folder FOLDER] [--cars PYTHON] [--only SET]...

A cell has the epipolar offset of independent points (median, spread 1.4826 MAD [px] and their number, the worst pair
of a set), CPU seconds, peak memory, the exit code and the first sentence of the result. The points are those of the
data's truth (SIFT or correlation without any RPC); of a --folder, and where the truth has none, SIFT matches made here,
filtered by a fundamental matrix. The offset is measured by tools/epi_check.py beside the data, which has its own RPC
formula and reads files through GDAL. Tools:
  delivered  the cameras as they are
  barpc      `barpc adjust` with its defaults, and what a set gives (GCPs, DEM, reference)
  cars       cars-bundleadjustment of the interpreter given, its .geom as written and half a pixel back
A set or a tool that is absent is named with the reason.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import cv2  # noqa: E402  (the thread counts come first)
import numpy as np  # noqa: E402
import rasterio  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
Features = tuple[np.ndarray, np.ndarray | None]
"""Places (N, 2) [px] and descriptors of an image's keypoints."""


@dataclass(frozen=True)
class Scene:
    """Images of one place, with the options that go with them."""

    name: str
    images: tuple[Path, ...]  # IMAGE arguments of barpc adjust, `,camera=` included
    options: tuple[str, ...] = ()
    bias: tuple[float, float] = (0.0, 0.0)  # added to the RPC of the last image [px]
    ties: tuple[Path, ...] = ()  # check points, named as A__B__... after the stems of images
    gcps: Path | None = None  # check points on the ground
    missing: str = ""


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


def scenes(data: Path) -> Iterator[Scene]:
    """The sets of the data, absent ones with the reason."""
    optical, cross, ties = data / "optical", data / "cross_sensor", data / "truth/ties"
    north = tuple(sorted((optical / "phr_triplet_north").glob("img_*.tif")))
    checks = tuple(sorted(ties.glob("phr_triplet_north__*ncc_check.csv")))
    ventoux = optical / "phr_ventoux"
    left, right = (ventoux / f"{side}_image.tif" for side in ("left", "right"))
    of_ventoux = tuple(sorted(ties.glob("phr_ventoux__*ncc_check.csv")))
    quickbird, aerial = optical / "qb2_single", cross / "ngi_2015"
    truth = quickbird / "gcps.geojson"
    terrain = ("--dem", str(aerial / "dem.tif"), "--geoid", str(data / "dem/egm96_15.gtx"))
    orthos = itertools.chain(*(("--reference", str(one)) for one in sorted(aerial.glob("ortho_*.tif"))))
    frames = tuple(sorted(aerial.glob("ngi_*.tif")))
    found = [
        Scene("Pleiades triplet", north, ties=checks),
        Scene("the same, 20 px of bias in one RPC", north, bias=(12.0, 16.0), ties=checks),
        Scene("Pleiades pair, Ventoux", (left, right), ties=of_ventoux),
        Scene("Ventoux PAN and XS", (cross / "phr_ventoux_xs/left_xs.tif", right)),
        Scene("QuickBird 2003 and aerial 2015", (quickbird / "qb2_basic1b.tif", *frames[:1]), terrain),
        Scene("QuickBird on four orthoimages", (quickbird / "qb2_basic1b.tif",),
              (*orthos, *terrain), gcps=truth),
        Scene("aerial frames", frames),
    ]  # fmt: skip
    for one in found:
        absent = [path for path in one.images if not path.exists()]
        yield replace(one, missing=f"{absent[0]} is absent" if absent else "" if one.images else "no images")


def of_folder(folder: Path) -> Scene:
    """A set of all rasters of a folder."""
    images = tuple(
        sorted(path for path in folder.iterdir() if path.suffix.lower() in (".tif", ".tiff", ".ntf", ".jp2"))
    )
    return Scene(folder.name, images, missing="" if len(images) > 1 else f"{folder} has fewer than two images")


def measured(command: list[str], folder: Path, log: Path) -> tuple[float, float, int]:
    """CPU seconds, peak memory [MB] and exit code of a command, run in a folder, its output in a file."""
    with log.open("w") as out:
        process = subprocess.Popen(command, cwd=folder, stdout=out, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0, os.waitstatus_to_exitcode(status)


def delivered(scene: Scene, place: Path) -> tuple[dict[str, Path], list[str]]:
    """Links to the images in a folder, the RPC of the last moved by the bias; their delivered cameras as VRTs."""
    place.mkdir()
    arguments = []
    for path in scene.images:
        for beside in path.parent.glob(f"{path.stem}*"):
            (place / beside.name).symlink_to(beside.resolve())
        arguments.append(str(place / path.name))
    if any(scene.bias):
        last = place / scene.images[-1].name
        last.unlink()
        shutil.copy(scene.images[-1].resolve(), last)
        last.chmod(0o644)
        with rasterio.open(last, "r+") as file:
            rpc = file.rpcs
            rpc.samp_off, rpc.line_off = rpc.samp_off + scene.bias[0], rpc.line_off + scene.bias[1]
            file.rpcs = rpc
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


def offsets(check: Path, cameras: dict[str, Path], points: dict[tuple[str, str], Path]) -> str:
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


def by_barpc(scene: Scene, arguments: list[str], place: Path) -> tuple[Row, dict[str, Path]]:
    """`barpc adjust` with its defaults."""
    out = place / "barpc"
    command = [sys.executable, "-m", "barpc", "-q", "adjust", *arguments, *scene.options, "-o", str(out)]
    cpu, peak, code = measured(command, ROOT, place / "barpc.log")
    row = Row("barpc", "", cpu, peak, code)
    if (out / "summary.json").is_file():
        told = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        row.said = "; ".join([told["status"], *told["reasons"][:1]])
    else:
        row.said = (place / "barpc.log").read_text().strip().splitlines()[-1]
    return row, {Path(path).stem: out / f"{Path(path).stem}.vrt" for path in arguments}


def by_cars(interpreter: str, scene: Scene, arguments: list[str], place: Path) -> list[tuple[Row, dict[str, Path]]]:
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
    said = "" if code == 0 else (place / "cars.log").read_text().strip().splitlines()[-1][:100]
    found = []
    for kind, back in (("as written", 0.0), ("half a pixel back", 0.5)):
        cameras = {name: place / f"cars_{back}/{name}.vrt" for name in names}
        shifted = []
        for name, path in zip(names, arguments, strict=True):
            geom = next(iter(sorted((place / "cars").rglob(f"*{name}*.geom"))), None)
            if geom is not None:
                _shift(geom, path, back)
                shifted.append(f"{path},camera={geom}")
        run = [sys.executable, "-m", "barpc", "-q", "convert", *shifted, "-o", str(place / f"cars_{back}")]
        if shifted:
            measured(run, ROOT, place / "cars_convert.log")
        found.append((Row(f"cars, {kind}", "", cpu, peak, code, said), cameras))
    return found


def _shift(geom: Path, image: str, pixels: float) -> None:
    """Take pixels from the places of an image in its .geom, and the crop's corner where it is that of a whole image."""
    with rasterio.open(image) as file:
        corner = (file.transform.c, file.transform.f) if file.rpcs is None and file.crs is None else (0.0, 0.0)
    less = {"samp_off": pixels + corner[0], "line_off": pixels + corner[1]}
    lines = []
    for line in geom.read_text().splitlines():
        key, _, value = line.partition(":")
        lines.append(f"{key}: {float(value) - less[key.strip()]!r}" if key.strip() in less else line)
    geom.write_text("\n".join(lines) + "\n")


def rows(scene: Scene, check: Path, cars: str | None) -> Iterator[Row]:
    """The rows of a set."""
    if scene.missing:
        yield Row("delivered", said=scene.missing)
        return
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder, "set")
        cameras, arguments = delivered(scene, place)
        points = check_points(scene, place)
        measure: Callable[[dict[str, Path]], str] = lambda found: offsets(check, found, points)  # noqa: E731
        if scene.gcps is not None:
            measure = lambda found: _of_gcps(check, found, scene.gcps)  # noqa: E731
        yield Row("delivered", measure(cameras))
        row, found = by_barpc(scene, arguments, place)
        yield replace(row, offset=measure(found))
        if cars is not None and len(arguments) > 1:
            for other, corrected in by_cars(cars, scene, arguments, place):
                yield replace(other, offset=measure(corrected))


def _of_gcps(check: Path, cameras: dict[str, Path], points: Path) -> str:
    """Root mean square residual of surveyed points in one image, col and row [px], by the RPC formula of `check`."""
    (camera,) = cameras.values()
    if not camera.is_file():
        return "a camera is missing"
    spec = importlib.util.spec_from_file_location("epi_check", check)
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    rows = json.loads(points.read_text(encoding="utf-8"))["features"]
    ground = np.array([one["geometry"]["coordinates"] for one in rows])
    seen = np.array([one["properties"]["ji"] for one in rows])
    col, row = np.sqrt(((tool.Rpc(camera).project(ground) - seen) ** 2).mean(axis=0))
    return f"GCPs {col:.2f}, {row:.2f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--folder", type=Path, action="append", default=[], help="images of one place")
    parser.add_argument("--cars", metavar="PYTHON", help="interpreter that has cars-bundleadjustment")
    parser.add_argument("--only", nargs="+", default=[], help="parts of the names of sets")
    given = parser.parse_args()
    tool = given.data.parent / "tools/epi_check.py"
    if not tool.is_file():
        sys.exit(f"{tool}, which measures the check points, is absent")
    tools = ["delivered", "barpc", *(["cars, as written", "cars, half a pixel back"] if given.cars else [])]
    print(f"| set | {' | '.join(tools)} |\n|{'---|' * (len(tools) + 1)}")
    for scene in (*scenes(given.data), *map(of_folder, given.folder)):
        if not given.only or any(part in scene.name for part in given.only):
            found = {row.tool: row.cell() for row in rows(scene, tool, given.cars)}
            print(f"| {scene.name} | {' | '.join(found.get(name, '-') for name in tools)} |", flush=True)


if __name__ == "__main__":
    main()
