"""Other tools on a run's cameras: each run for real, with the cameras as delivered and with the corrected ones.

    python benchmarks/handover.py RUN [TOOL ...]      RUN: the folder of barpc adjust, with its images where they were

A tool counts as here when its command is on PATH; the others are named with the reason. What is measured:
  gdal, orthority, otb  two orthoimages at one height: what lies between them across the stereo base [px]
  s2p                   the pointing correction that it asks for [px]; with that correction off, the height offset
                        between the pairs of the first image, its spread (NMAD) [m] and the share of heights
  cars                  before_correction_epi_error of its own metadata [px]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.warp import transform
from rasterio.windows import from_bounds

from barpc import read_rpc
from barpc.export.shots import Scene, Shot, pairs_of, read_scene
from barpc.export.targets import export_run
from barpc.rpcio import WRITABLE

Figures = dict[str, list[str]]
COMMANDS = {
    "gdal": "gdalwarp",
    "orthority": "oty",
    "otb": "otbcli_OrthoRectification",
    "s2p": "s2p",
    "cars": "cars",
}
REACH, PATCH, HALF, STEP = (
    24,
    15,
    90.0,
    0.5,
)  # px searched, px of half a patch, m of half an orthoimage, m a pixel
S2P = """
import sys, numpy as np, s2p
if "off" in sys.argv:
    s2p.pointing_accuracy.local_translation = lambda *a: np.eye(3)
if "heights" in sys.argv:
    s2p.global_mean_heights = lambda *a: sys.exit()
s2p.main(s2p.read_config_file(sys.argv[1]))
"""


def run(command: Sequence[str | Path], folder: Path) -> str:
    """What a command prints, run in `folder`, outside this program's environment."""
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run([str(c) for c in command], cwd=folder, env=env, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{command[0]}: {(done.stdout + done.stderr)[-2000:]}")
    return done.stdout


# --- orthoimages ------------------------------------------------------------------------------------------


class Square:
    """A square on the ground that both images of the first pair see, in UTM, at the height of its middle."""

    def __init__(self, scene: Scene) -> None:
        names = pairs_of(scene)[0]
        self.pair = [next(s for s in scene.shots if s.name == name) for name in names]
        a, b = (shot.rpc for shot in self.pair)
        both = np.intersect1d(*(shot.index for shot in self.pair))
        lon, lat, alt = np.median(scene.points[both], axis=0)
        self.alt, self.epsg = float(alt), (32600 if lat >= 0 else 32700) + int((lon + 180) // 6) + 1
        x, y = (v[0] for v in transform("EPSG:4326", f"EPSG:{self.epsg}", [lon], [lat]))
        x, y = round(x), round(y)
        self.bounds = (x - HALF, y - HALF, x + HALF, y + HALF)
        foot = [m.localize(m.project(np.array([lon, lat, alt])), np.array(alt + 50.0)) for m in (a, b)]
        east, north = transform("EPSG:4326", f"EPSG:{self.epsg}", *np.array(foot)[:, :2].T)
        base = np.array([east[1] - east[0], north[0] - north[1]])  # rows go south
        self.across = np.array([-base[1], base[0]]) / np.hypot(*base)

    def read(self, path: Path) -> np.ndarray:
        """The square of an orthoimage, however far it reaches."""
        with rasterio.open(path) as data:
            window = from_bounds(*self.bounds, data.transform).round_offsets().round_lengths()
            return data.read(1, window=window, boundless=True, fill_value=0).astype(np.float32)

    def offset(self, paths: Sequence[Path]) -> str:
        """Median and spread (1.4826 MAD) of what lies between two orthoimages across the base [px], over patches."""
        a, b = (self.read(path) for path in paths)
        found, edge = [], PATCH + REACH
        for row in range(edge, a.shape[0] - edge, 12):
            for col in range(edge, a.shape[1] - edge, 12):
                patch = a[row - PATCH : row + PATCH + 1, col - PATCH : col + PATCH + 1]
                area = b[row - edge : row + edge + 1, col - edge : col + edge + 1]
                if not patch.all() or not area.all():
                    continue
                score = cv2.matchTemplate(area, patch, cv2.TM_CCOEFF_NORMED)
                top, at = np.unravel_index(score.argmax(), score.shape)
                if score.max() < 0.85 or not (0 < top < 2 * REACH and 0 < at < 2 * REACH):
                    continue
                down, over = score[top - 1 : top + 2, at], score[top, at - 1 : at + 2]
                fine = [(v[0] - v[2]) / (2 * (v[0] - 2 * v[1] + v[2])) for v in (over, down)]
                found.append(self.across @ (np.array([at, top]) - REACH + fine))
        middle = np.median(found)
        return f"{middle:+.3f} ± {1.4826 * np.median(np.abs(found - middle)):.3f} ({len(found)})"


def gdal(square: Square, image: Path, to: Path) -> None:
    options = [
        "-q",
        "-rpc",
        "-to",
        f"RPC_HEIGHT={square.alt}",
        "-t_srs",
        f"EPSG:{square.epsg}",
        "-r",
        "cubic",
    ]
    run(["gdalwarp", *options, "-te", *map(str, square.bounds), "-tr", STEP, STEP, image, to], to.parent)


def orthority(square: Square, image: Path, to: Path) -> None:
    west, south, east, north = square.bounds
    dem = to.with_suffix(".dem.tif")
    grid = rasterio.transform.from_bounds(west - 60, south - 60, east + 60, north + 60, 50, 50)
    with rasterio.open(dem, "w", "GTiff", 50, 50, 1, f"EPSG:{square.epsg}", grid, "float32") as data:
        data.write(np.full((50, 50), square.alt, np.float32), 1)
    crs = ["--crs", f"EPSG:{square.epsg}", "--res", STEP, "-ap", "--overwrite"]
    run(["oty", "rpc", "--dem", dem, *crs, "--out-dir", to.parent, image], to.parent)
    (to.parent / f"{image.stem}_ORTHO.tif").rename(to)


def otb(square: Square, image: Path, to: Path) -> None:
    west, south, east, north = square.bounds
    where = ["-outputs.ulx", west, "-outputs.uly", north, "-outputs.lrx", east, "-outputs.lry", south]
    where += ["-outputs.spacingx", STEP, "-outputs.spacingy", -STEP, "-outputs.mode", "outputroi"]
    what = ["-map", "epsg", "-map.epsg.code", square.epsg, "-elev.default", square.alt, "-opt.gridspacing", 4]
    geom, write = to.with_suffix(".geom"), WRITABLE["geom"].write
    geom.write_text(write(read_rpc(image)))  # of a VRT's or GeoTIFF's own RPC this application says "no information"
    source = f"{image}?&geom={geom}"
    run(["otbcli_OrthoRectification", "-io.in", source, "-io.out", to, "float", *what, *where], to.parent)


def orthoimages(tool: Callable[[Square, Path, Path], None]) -> Callable[[Path, Path], Figures]:
    """The measure of a tool that makes orthoimages."""

    def measure(folder: Path, place: Path) -> Figures:
        square = Square(read_scene(folder))
        found = []
        for kind in ("delivered", "corrected"):
            paths = [place / f"{kind}_{n}.tif" for n in (0, 1)]
            for shot, path in zip(square.pair, paths, strict=True):
                tool(square, Path(shot.file if kind == "delivered" else shot.carrier or ""), path)
            found.append(square.offset(paths))
        return {"across the base [px]": found}

    return measure


# --- stereo pipelines -------------------------------------------------------------------------------------


def _corner(shot: Shot, width: int = 320, height: int = 240) -> dict[str, int]:
    """A region in the middle of an image."""
    size = [min(n, m) for n, m in zip((width, height), shot.size, strict=True)]
    x, y = ((n - m) // 2 for n, m in zip(shot.size, size, strict=True))
    return {"x": x, "y": y, "w": size[0], "h": size[1]}


def s2p(folder: Path, place: Path) -> Figures:
    scene = read_scene(folder)
    export_run(folder, "s2p", place / "export")
    ready = json.loads((place / "export/config.json").read_text())
    del ready["full_img"]  # a region of it: minutes otherwise
    python = Path(shutil.which("s2p") or "").resolve().parent / "python"
    found: Figures = {}
    for kind in ("delivered", "corrected"):
        for pointing in ("on", "off"):
            out = place / f"{kind}_{pointing}"
            config = ready | {"roi": _corner(scene.shots[0]), "out_dir": str(out), "max_processes": 1}
            config |= {"temporary_dir": str(place / f"tmp_{kind}_{pointing}")}
            if kind == "delivered":
                config["images"] = [{"img": str(Path(shot.file).absolute())} for shot in scene.shots]
            path = place / "export" / f"{kind}_{pointing}.json"
            path.write_text(json.dumps(config))
            whole = kind == "corrected" and pointing == "on"  # once, to the surface model
            run([python, "-c", S2P, path, pointing, "whole" if whole else "heights"], place)
            assert not whole or (out / "dsm.tif").is_file()
            wanted = [np.hypot(*np.loadtxt(p)[:2, 2]) for p in sorted(out.glob("global_pointing_pair_*.txt"))]
            if pointing == "on":
                found.setdefault("wanted pointing correction [px]", []).append(" / ".join(f"{w:.3f}" for w in wanted))
            for name, value in _heights(out).items():
                found.setdefault(f"{name}, pointing correction {pointing}", []).append(value)
    return found


def _heights(out: Path) -> dict[str, str]:
    """What the height maps of two pairs of one region differ by."""
    maps = []
    for path in sorted(out.glob("tiles/*/*/pair_*/height_map.tif")):
        with rasterio.open(path) as data:
            maps.append(data.read(1))
    if len(maps) != 2:
        return {}
    apart = (maps[1] - maps[0])[np.isfinite(maps[0]) & np.isfinite(maps[1])]
    middle = float(np.median(apart))
    return {
        "pairs apart in height [m]": f"{middle:+.2f}",
        "NMAD of the pairs' heights [m]": f"{1.4826 * float(np.median(np.abs(apart - middle))):.2f}",
        "heights in both pairs": f"{len(apart) / maps[0].size:.1%}",
    }


def cars(folder: Path, place: Path) -> Figures:
    """On the first pair alone: minutes a pair. Not yet seen to its end: the docs' figures are of runs by hand."""
    scene = read_scene(folder)
    export_run(folder, "cars", place / "export")
    ready = json.loads((place / "export/inputs.yaml").read_text(encoding="utf-8"))
    ready["input"]["pairing"] = [list(pairs_of(scene)[0])]
    ready["subsampling"] = {"advanced": {"resolutions": [1]}}  # a quarter of a small image matches nothing
    found: Figures = {}
    for kind in ("delivered", "corrected"):
        for shot in scene.shots:
            camera = Path(shot.file).absolute() if kind == "delivered" else f"{shot.name}.geom"
            ready["input"]["sensors"][shot.name]["geomodel"]["path"] = str(camera)
        ready["output"] = {"directory": str(place / kind)}
        (place / "export" / f"{kind}.json").write_text(json.dumps(ready), encoding="utf-8")
        run(["cars", f"{kind}.json"], place / "export")
        told = (place / kind / "intermediate_data/surface_modeling/res1/metadata.yaml").read_text()
        for name in ("mean", "std"):
            (value,) = re.findall(rf"before_correction_epi_error_{name}: (\S+)", told)
            found.setdefault(f"before_correction_epi_error_{name} [px]", []).append(f"{float(value):+.3f}")
        with rasterio.open(place / kind / "dsm/dsm.tif") as data:
            found.setdefault("cells of the DSM", []).append(str(data.read(1, masked=True).count()))
    return found


TOOLS: dict[str, Callable[[Path, Path], Figures]] = {
    "gdal": orthoimages(gdal),
    "orthority": orthoimages(orthority),
    "otb": orthoimages(otb),
    "s2p": s2p,
    "cars": cars,
}


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("tools", nargs="*", choices=[[], *TOOLS], default=[])
    arguments = parser.parse_args()
    for tool, measure in TOOLS.items():
        if arguments.tools and tool not in arguments.tools:
            continue
        if shutil.which(COMMANDS[tool]) is None:
            print(f"{tool}: not run: no {COMMANDS[tool]} on PATH")
            continue
        with tempfile.TemporaryDirectory() as folder:
            for name, (before, after) in measure(arguments.run.absolute(), Path(folder)).items():
                print(f"| {tool} | {name} | {before} | {after} |", flush=True)


if __name__ == "__main__":
    main()
