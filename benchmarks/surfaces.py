"""Surfaces of the same corrected cameras by `barpc dsm`, s2p and CARS: a row a pair of images and tool.

    python benchmarks/surfaces.py [--data ../shared/data] [--s2p PYTHON] [--cars PYTHON] [--only PAIR] [--keep FOLDER]
    python benchmarks/surfaces.py --shipped [--data ../shared/data] [--keep FOLDER]

Each set is adjusted, and every pair of it made into a surface of 1 m cells: by barpc and CARS with their defaults (of
CARS one resolution, as the images are small), by s2p with its pointing correction off, which wants none.
  cells    share of the cells that any tool knows
  from X   NMAD of the differences to each other tool [m], their median, the share above 5 m
  sigma    share of cells within one sigma of barpc (matching) of the others' heights, which have errors of their own
  CPU      seconds a million pixels of the smaller image (s2p, CARS: their processes, too)
Below a set of several pairs, of each tool: the median difference of two pairs' heights, and the standard deviation of
the medians of nine parts of the scene over three, which is the noise that matching leaves in the first.
--shipped: of the whole triplet, all pairs, beside the surface that s2p ships for it: UTM 31 N, cells of 0.5 m, above
the ellipsoid, of 700 x 700 px in the middle of the second image, seen with each of the others.
--keep leaves runs and surfaces in a folder, where a second call finds them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import Affine
from rasterio.warp import Resampling, reproject

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from barpc.export.shots import read_scene
from barpc.export.targets import export_run
from benchmarks.dsm import nmad
from benchmarks.handover import S2P
from benchmarks.real import ROOT, measured
from tests.geotiffs import write_image

CELL, FAR, PARTS = 1.0, 5.0, 3
"""Cells [m]; difference that is an error of matching [m]; parts of a scene a side."""
Pair = tuple[str, str]
Tool = Callable[[Path, Pair, Path], list[str]]


def sets(data: Path) -> dict[str, list[Path]]:
    """Name -> images."""
    optical = data / "optical"
    ventoux = [optical / "phr_ventoux" / f"{side}_image.tif" for side in ("left", "right")]
    return {"triplet": sorted((optical / "phr_triplet_north").glob("img_*.tif")), "Ventoux": ventoux}


def by_barpc(run: Path, pair: Pair, place: Path) -> list[str]:
    """Command that writes barpc's surface."""
    low, high = read_scene(run).alt_range
    images = [str(run / f"{name}.vrt") for name in pair]
    call = [sys.executable, "-m", "barpc", "-q", "dsm", *images, "--alt", str(low), str(high), "--gsd", str(CELL)]
    return [*call, "-o", str(place / "dsm.tif")]


def by_s2p(python: str) -> Tool:
    """Command that writes s2p's."""

    def command(run: Path, pair: Pair, place: Path) -> list[str]:
        export_run(run, "s2p", place / "export")
        config = json.loads((place / "export/config.json").read_text())
        config["images"] = [one for one in config["images"] if Path(one["img"]).stem in pair]
        for one in config["images"]:
            one["img"] = str((place / "export" / one["img"]).resolve())
        config |= {"out_dir": str(place), "temporary_dir": str(place / "tmp"), "max_processes": 1}
        config |= {"dsm_resolution": CELL}
        (place / "config.json").write_text(json.dumps(config))
        return [python, "-c", S2P, str(place / "config.json"), "off"]

    return command


def by_cars(python: str) -> Tool:
    """Command that writes CARS'."""

    def command(run: Path, pair: Pair, place: Path) -> list[str]:
        export_run(run, "cars", place / "export")
        config = json.loads((place / "export/inputs.yaml").read_text())
        sensors = config["input"]["sensors"]
        config["input"] = {"sensors": {name: sensors[name] for name in pair}, "pairing": [list(pair)]}
        config |= {"subsampling": {"advanced": {"resolutions": [1]}}, "orchestrator": {"mode": "sequential"}}
        config["output"] = {"directory": str(place / "out"), "resolution": CELL}
        lon, lat, alt = np.median(read_scene(run).points, axis=0)
        config["input"]["initial_elevation"] = {
            name: str(level(place / f"{name}.tif", (lon, lat), value)) for name, value in (("dem", alt), ("geoid", 0.0))
        }
        (place / "export/pair.json").write_text(json.dumps(config))
        return [str(Path(python).parent / "cars"), str(place / "export/pair.json")]

    return command


def level(path: Path, middle: tuple[float, float], height: float) -> Path:
    """A raster of one height [m] for a degree around a place: for CARS, which finds no disparities without any."""
    side, step = 100, 0.01
    place = Affine(step, 0.0, middle[0] - side * step / 2, 0.0, -step, middle[1] + side * step / 2)
    return write_image(path, np.full((side, side), height, np.float32), crs="EPSG:4326", transform=place)


def surface(tool: Tool, run: Path, pair: Pair, place: Path) -> tuple[Path | None, float]:
    """The surface of a pair and the CPU seconds that it took; None where the tool fails."""
    told = place / "cpu.json"
    if not told.is_file():
        place.mkdir(parents=True, exist_ok=True)
        cpu, _, code = measured(tool(run, pair, place), place if tool is not by_barpc else ROOT, place / "log")
        told.write_text(json.dumps([cpu, code]))
    cpu, code = json.loads(told.read_text())
    found = [path for path in (place / "dsm.tif", place / "out/dsm/dsm.tif") if path.is_file()]
    if code or not found:
        print(f"{place}: exit {code}: {(place / 'log').read_text().strip().splitlines()[-1:]}", file=sys.stderr)
        return None, cpu
    return found[0], cpu


def heights(path: Path, like: Path, band: int = 1) -> np.ndarray:
    """A surface on the cells of another, the nearest ones."""
    with rasterio.open(like) as grid, rasterio.open(path) as file:
        own = file.read(band, masked=True).astype(np.float32).filled(np.nan)
        out = np.full((grid.height, grid.width), np.nan, np.float32)
        reproject(
            own, out, src_transform=file.transform, src_crs=file.crs, dst_transform=grid.transform, dst_crs=grid.crs,
            src_nodata=np.nan, dst_nodata=np.nan, resampling=Resampling.nearest,
        )  # fmt: skip
    return out


def rows(made: dict[str, Path], cost: dict[str, float]) -> Iterator[str]:
    """Lines of a pair: name of a tool and its figures."""
    first = made["barpc"]
    known = {name: heights(path, first) for name, path in made.items()}
    sigma = heights(first, first, 4)
    some = int(np.isfinite(np.stack(list(known.values()))).any(axis=0).sum())
    for name, one in known.items():
        cells = [f"{name} | {np.isfinite(one).sum() / some:.1%} | {cost[name]:.1f}"]
        for other in (n for n in made if n != name):
            apart = (one - known[other])[np.isfinite(one) & np.isfinite(known[other])]
            text = f"{other}: {nmad(apart):.2f}, {np.median(apart):+.2f}, {np.mean(np.abs(apart) > FAR):.2%}"
            if name == "barpc":
                both = np.isfinite(known[other] + one + sigma)
                within = np.abs(one - known[other] - np.median(apart))[both] < sigma[both]
                text += f", {within.mean():.0%} within sigma"
            cells.append(text)
        yield " | ".join(cells)


def between(a: Path, b: Path) -> str:
    """Median difference of two surfaces' heights, and its noise by parts of the scene [m]."""
    apart = heights(a, a) - heights(b, a)
    row, col = np.nonzero(np.isfinite(apart))
    places = [np.minimum(PARTS * (v - v.min()) // (np.ptp(v) + 1), PARTS - 1) for v in (row, col)]
    part = places[0] * PARTS + places[1]
    values = apart[row, col]
    medians = [np.median(values[part == k]) for k in range(PARTS**2) if (part == k).sum() > 200]
    noise = np.std(medians, ddof=1) / np.sqrt(len(medians))
    return f"{np.median(values):+.3f} +- {noise:.3f} m ({len(values)} cells, {len(medians)} parts)"


def shipped(data: Path, place: Path) -> None:
    """Print the rows of barpc's surfaces of the whole triplet beside the one that s2p ships."""
    theirs = data / "optical/phr_triplet_whole/s2p_dsm.tif"
    images = sorted(theirs.parent.glob("img_*.tif"))
    run = adjusted(images, place)
    known, (low, high) = heights(theirs, theirs), read_scene(run).alt_range
    names = [shot.name for shot in read_scene(run).shots]
    print("| cameras, pairs | of s2p's cells | to s2p's heights: median, NMAD [m]; > 5 m |\n|---|---|---|")
    for kind, views in {"corrected, all": names, "delivered, all": []}.items():
        given = [run / f"{view}.vrt" for view in views] or images
        call = [sys.executable, "-m", "barpc", "-q", "dsm", *map(str, given), "--alt", str(low), str(high)]
        call += ["--gsd", "0.5", "-o", str(place / "dsm.tif"), "--overwrite"]
        measured(call, ROOT, place / "log")
        ours = heights(place / "dsm.tif", theirs)
        apart = (ours - known)[np.isfinite(ours + known)]
        median, far = float(np.median(apart)), float(np.mean(np.abs(apart) > FAR))
        share = len(apart) / np.isfinite(known).sum()
        print(f"| {kind} | {share:.1%} | {median:+.2f}, {nmad(apart):.2f}; {far:.2%} |", flush=True)


def adjusted(images: list[Path], place: Path) -> Path:
    """The run of a set, made where it is not there."""
    if not (place / "run/summary.json").is_file():
        given = [*map(str, images), "--rpc-format", "txt,geom", "-o", str(place / "run")]
        measured([sys.executable, "-m", "barpc", "-q", "adjust", *given], ROOT, place / "log")
    return place / "run"


def of_set(name: str, images: list[Path], tools: dict[str, Tool], only: list[str], place: Path) -> None:
    """Print the rows of a set."""
    run = adjusted(images, place)
    every: dict[str, dict[Pair, Path]] = {tool: {} for tool in tools}
    for pair in itertools.combinations([path.stem for path in images], 2):
        label = " - ".join(pair)
        if only and not any(part in f"{name} {label}" for part in only):
            continue
        sizes = [shot.size for shot in read_scene(run).shots if shot.name in pair]
        area = min(width * height for width, height in sizes) / 1e6
        made, cost = {}, {}
        for tool, make in tools.items():
            path, cpu = surface(make, run, pair, place / f"{pair[0]}__{pair[1]}" / tool)
            if path is not None:
                made[tool], cost[tool], every[tool][pair] = path, cpu / area, path
        for line in rows(made, cost) if "barpc" in made else ():
            print(f"| {name}, {label} | {line} |", flush=True)
    for tool, pairs in every.items():
        for (a, left), (b, right) in itertools.combinations(pairs.items(), 2):
            print(f"{name}, {tool}: heights of {'/'.join(a)} less those of {'/'.join(b)}: {between(left, right)}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--s2p", metavar="PYTHON", help="interpreter that has s2p")
    parser.add_argument("--cars", metavar="PYTHON", help="interpreter that has CARS")
    parser.add_argument("--only", nargs="+", default=[], help="parts of the names of pairs")
    parser.add_argument("--keep", type=Path, help="folder for runs and surfaces")
    parser.add_argument("--shipped", action="store_true", help="beside the surface that s2p ships")
    given = parser.parse_args()
    if given.shipped:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(given.keep or folder).absolute()
            place.mkdir(parents=True, exist_ok=True)
            shipped(given.data, place)
        return
    tools: dict[str, Tool] = {"barpc": by_barpc}
    tools |= {"s2p": by_s2p(given.s2p)} if given.s2p else {}
    tools |= {"cars": by_cars(given.cars)} if given.cars else {}
    print("| pair | tool | cells | CPU s / Mpx | to each other: NMAD [m], median [m], above 5 m |")
    with tempfile.TemporaryDirectory() as folder:
        for name, images in sets(given.data).items():
            place = Path(given.keep or folder, name).absolute()
            place.mkdir(parents=True, exist_ok=True)
            of_set(name, images, tools, given.only, place)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
