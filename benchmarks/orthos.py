"""Orthoimages of the same cameras on the same DEM by `barpc ortho`, GDAL's warper and orthority: a row a tool.

    python benchmarks/orthos.py [--data ../shared/data] [--orthority PYTHON] [--keep FOLDER]

GDAL's are those of `gdalwarp -rpc -of COG`, whose code rasterio carries, with gdalwarp's own error threshold. What is
measured, in pixels of the image:
  error    a made image of SIDE px, whose two bands are its own columns and rows, under a real camera of Mont Ventoux on
           SRTM heights: what the map shows minus where the camera sees the map's ground; RMS, the 99.9th centile
  seam     the largest change of that error from a row or column of the map to the next, mean along it
  CPU      seconds of a millionth of that map's image pixels and of the start, as shares of barpc's, told by an image of
           SMALL px; peak memory
  views    two views of the Pleiades triplet by their corrected cameras, on the surface that s2p ships, holes filled:
           median shift between the maps, col and row, and spread, by the matching of tools/ncc_check.py beside the data
The places that the camera should see come from PROJ, numpy and the RPC formula of that tool, not from this package.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402  (the thread counts come first)
import pyproj  # noqa: E402
import rasterio  # noqa: E402
from rasterio.fill import fillnodata  # noqa: E402
from rasterio.windows import from_bounds  # noqa: E402
from scipy.ndimage import map_coordinates  # noqa: E402

from barpc.rpcio import read_rpc  # noqa: E402
from benchmarks.dsm import nmad  # noqa: E402
from benchmarks.real import ROOT, measured  # noqa: E402
from benchmarks.real_crops import load_tool  # noqa: E402
from benchmarks.real_sets import as_rasterio  # noqa: E402
from tests.geotiffs import write_image  # noqa: E402

SIDE, SMALL, GSD, CRS, GEOID = 2048, 256, 0.5, 32631, 51.0
"""Of the made images [px], of a map's pixel [m], EPSG code; height of the geoid at Mont Ventoux [m]."""
CORNER = np.array([9000.0, 9000.0])  # of the made image in its product [px]: 1 km
STEP, HALF, HOLE = 12, 12, 10  # px between matched places, of half a patch, across a hole
Tool = Callable[[list[Path], Path, Path], list[str]]
GDAL = """
import sys, numpy as np, rasterio, rasterio.shutil
from rasterio.warp import Resampling, reproject, transform_bounds
dem, crs, gsd, out, *images = sys.argv[1:]
gsd = float(gsd)
with rasterio.open(dem) as file:
    bounds = transform_bounds(file.crs, crs, *file.bounds)
for image in images:
    name = f"{out}/{image.rpartition('/')[2].rpartition('.')[0]}"
    with rasterio.open(image) as file:
        place, width, height = rasterio.warp.calculate_default_transform(
            "EPSG:4326", crs, file.width, file.height, rpcs=file.rpcs, resolution=gsd, RPC_DEM=dem)
        west, north = np.floor(place.c / gsd) * gsd, np.ceil(place.f / gsd) * gsd
        what = {"dtype": file.dtypes[0], "nodata": file.nodata if file.nodata is not None else 0, "crs": crs}
        what |= {"transform": rasterio.Affine(gsd, 0, west, 0, -gsd, north), "tiled": True}
        with rasterio.open(name + ".rough", "w", "GTiff", width + 1, height + 1, file.count, **what) as to:
            bands = list(range(1, file.count + 1))
            reproject(rasterio.band(file, bands), rasterio.band(to, bands), rpcs=file.rpcs, src_crs="EPSG:4326",
                      resampling=Resampling.cubic, RPC_DEM=dem)
    rasterio.shutil.copy(name + ".rough", name + ".tif", driver="COG", COMPRESS="DEFLATE", PREDICTOR="YES")
"""


def by_barpc(images: list[Path], dem: Path, out: Path) -> list[str]:
    """Command that makes barpc's maps."""
    given = [*map(str, images), "--dem", str(dem), "--geoid", "none", "--gsd", str(GSD), "--crs", f"EPSG:{CRS}"]
    return [sys.executable, "-m", "barpc", "-q", "ortho", *given, "-o", str(out), "--overwrite"]


def by_gdal(images: list[Path], dem: Path, out: Path) -> list[str]:
    """Command that makes GDAL's."""
    return [sys.executable, "-c", GDAL, str(dem), f"EPSG:{CRS}", str(GSD), str(out), *map(str, images)]


def by_orthority(python: str) -> Tool:
    """Command that makes orthority's, on heights between posts as the others take them."""

    def command(images: list[Path], dem: Path, out: Path) -> list[str]:
        given = ["--dem", str(dem), "--dem-interp", "bilinear", "--res", str(GSD), "-ap", "--crs", f"EPSG:{CRS}"]
        given += ["--overwrite", "--out-dir", str(out), *map(str, images)]
        return [str(Path(python).parent / "oty"), "-q", "rpc", *given]

    return command


def made(tool: Tool, images: list[Path], dem: Path, out: Path) -> tuple[list[Path], float, float]:
    """Maps of images, the CPU seconds and the peak memory [MB] that they took."""
    out.mkdir(parents=True, exist_ok=True)
    log = out.with_suffix(".log")
    cpu, peak, code = measured(tool(images, dem, out), ROOT if tool is by_barpc else out, log)
    if code:
        sys.exit(f"{out.name}: exit {code}: {log.read_text().strip().splitlines()[-1:]}")
    found = [next(path for end in ("", "_ORTHO") if (path := out / f"{one.stem}{end}.tif").is_file()) for one in images]
    return found, cpu, peak


def made_images(data: Path, place: Path) -> tuple[list[Path], Path]:
    """Images whose bands are their columns and rows, and the heights above the ellipsoid that they lie on."""
    images, dem = [place / f"made_{side}.tif" for side in (SMALL, SIDE)], place / "ellipsoidal.tif"
    with rasterio.open(data / "dem/N44E005.hgt") as file:
        heights, layout = file.read(1).astype(np.float32) + np.float32(GEOID), file.profile
    write_image(dem, heights, **layout | {"driver": "GTiff", "dtype": "float32"})
    rpcs = as_rasterio(read_rpc(data / "optical/phr_ventoux/left_image.geom"), CORNER)
    for image, side in zip(images, (SMALL, SIDE), strict=True):
        pixels = np.stack(np.meshgrid(*2 * [np.arange(1, side + 1, dtype=np.float32)]))  # 0 is no data
        write_image(image, pixels, nodata=0, tiled=True, rpcs=rpcs)
    return images, dem


def errors(made: Path, image: Path, dem: Path, tool: ModuleType) -> np.ndarray:
    """What a map shows (rows, cols, 2) minus where the camera sees its ground, NaN within 20 px of the image's edge."""
    with rasterio.open(made) as file:
        shown = np.moveaxis(file.read(), 0, -1) - 1.0
        x, y = file.transform @ np.meshgrid(np.arange(file.width) + 0.5, np.arange(file.height) + 0.5)
    lon, lat = pyproj.Transformer.from_crs(CRS, 4326, always_xy=True).transform(x, y)
    with rasterio.open(dem) as file:
        col, row = ~file.transform @ (lon, lat)
        alt = map_coordinates(file.read(1).astype(np.float64), [row - 0.5, col - 0.5], order=1)
    ground = np.stack([lon, lat, alt], axis=-1).reshape(-1, 3)
    seen = tool.Cam.gdal(image).project(ground).reshape(shown.shape)
    inside = ((seen > 20) & (seen < SIDE - 21)).all(axis=-1, keepdims=True)
    return np.where(inside, shown - seen, np.nan)


def seam(off: np.ndarray) -> float:
    """The largest change of an error (rows, cols, 2) between neighbouring lines, mean along them."""
    found = []
    for axis in (0, 1):
        change = np.linalg.norm(np.diff(off, axis=axis), axis=-1)
        known = np.isfinite(change).sum(axis=1 - axis) > SIDE / 4
        found.append(np.nanmean(change.compress(known, axis=axis), axis=1 - axis).max())
    return float(max(found))


def filled(surface: Path, place: Path) -> Path:
    """A surface without its holes of some cells."""
    with rasterio.open(surface) as file:
        heights, layout = file.read(1), file.profile
    with rasterio.open(place / "filled.tif", "w", **layout) as file:
        file.write(fillnodata(heights, np.isfinite(heights), max_search_distance=HOLE), 1)
    return place / "filled.tif"


def apart(paths: list[Path], surface: Path, tool: ModuleType) -> str:
    """How far two maps lie apart on a surface."""
    with rasterio.open(surface) as file:
        bounds, size = file.bounds, {"width": file.width, "height": file.height}
    shown = []
    for path in paths:
        with rasterio.open(path) as file:
            window = from_bounds(*bounds, file.transform).round_offsets()
            window = rasterio.windows.Window(window.col_off, window.row_off, *size.values())
            shown.append(file.read(1, window=window, boundless=True, fill_value=0).astype(np.float32))
    both = (shown[0] > 0) & (shown[1] > 0)
    shift = np.array(list(_shifts(shown[0], shown[1], both, tool)))
    middle, spread = np.median(shift, axis=0), [nmad(one) for one in shift.T]
    words = ", ".join(f"{m:+.3f}±{s:.3f}" for m, s in zip(middle, spread, strict=True))
    return f"{words} ({len(shift)})"


def _shifts(a: np.ndarray, b: np.ndarray, known: np.ndarray, tool: ModuleType) -> Iterator[np.ndarray]:
    """Shifts (2,) of places of one map in another: there and back."""
    edge, same = HALF + 8, np.eye(2, 3)
    for row in range(edge, a.shape[0] - edge, STEP):
        for col in range(edge, a.shape[1] - edge, STEP):
            if not known[row - edge : row + edge, col - edge : col + edge].all():
                continue
            at = np.array([col, row], float)
            there = tool.lsm(a, b, at, same, at, HALF)
            if there is None or there[1] < 0.85:
                continue
            back = tool.lsm(b, a, there[0], same, at, HALF)
            if back is not None and np.linalg.norm(back[0] - at) < 0.25:
                yield there[0] - at


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--orthority", metavar="PYTHON", help="interpreter that has orthority")
    parser.add_argument("--keep", type=Path, help="folder for runs and maps")
    given = parser.parse_args()
    tools: dict[str, Tool] = {"barpc": by_barpc, "GDAL": by_gdal}
    tools |= {"orthority": by_orthority(given.orthority)} if given.orthority else {}
    check = load_tool(given.data.parent / "tools/ncc_check.py")
    surface = given.data / "optical/phr_triplet_whole/s2p_dsm.tif"
    with tempfile.TemporaryDirectory() as folder:
        place = Path(given.keep or folder).absolute()
        place.mkdir(parents=True, exist_ok=True)
        images, surface = sorted(surface.parent.glob("img_*.tif")), filled(surface, place)
        run = [sys.executable, "-m", "barpc", "-q", "adjust", *map(str, images), "-o", str(place / "run")]
        if not (place / "run/summary.json").is_file():
            measured(run, ROOT, place / "log")
        pair = [place / "run" / f"{one.stem}.vrt" for one in (images[0], images[2])]
        (small, image), dem = made_images(given.data, place)
        print("| tool | error: RMS, 99.9 % [px] | seam [px] | CPU / Mpx, start | MB | views apart [px] |")
        print("|---|---|---|---|---|---|")
        first = np.empty(0)
        for name, tool in tools.items():
            _, least, _ = made(tool, [small], dem, place / f"{name}_small")
            (one,), cpu, peak = made(tool, [image], dem, place / f"{name}_made")
            each = (cpu - least) / (SIDE**2 - SMALL**2) * 1e6
            cost = np.array([each, least - each * SMALL**2 / 1e6])
            first = cost if name == "barpc" else first
            off = errors(one, image, dem, check)
            length = np.linalg.norm(off, axis=-1)
            size = f"{np.sqrt(np.nanmean(length**2)):.3f}, {np.nanpercentile(length, 99.9):.3f}"
            two, _, _ = made(tool, pair, surface, place / f"{name}_pair")
            share = ", ".join(f"{one:.0%}" for one in cost / first)
            print(
                f"| {name} | {size} | {seam(off):.3f} | {share} | {peak:.0f} | {apart(two, surface, check)} |",
                flush=True,
            )
            print(f"{name}: {cost[0]:.2f} CPU s a Mpx, {cost[1]:.2f} s to start", file=sys.stderr)


if __name__ == "__main__":
    main()
