"""Stripes in surface models by jitter, and which file of a camera takes them away.

Two strips of a scene with relief and houses are rendered through pushbroom cameras that swing while they scan, +-12
degrees along the flight. Both images are orthorectified onto the true ground with each kind of camera file, and
what is left between them is measured window by window in the pixels: along the flight it is a height (a stripe), across
what stereo matchers call vertical parallax. The cameras are the true ones: what an adjustment knows of them is not the
question here, only what files hold.

    python benchmarks/stripes.py [--rows 4000] [--period 1200] [--pixels 0.5]
    python benchmarks/stripes.py --dense --cols 4000 --rows 3000 [--cars FOLDER]

--dense: a wide strip, matched densely (OpenCV's DIS flow between the two orthoimages), every pixel a height.
--cars: images, cameras and CARS's configuration for each kind of camera file are left in FOLDER: `cars cars_grid.yaml`
there.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import warnings
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # tests, where barpc is installed as a package

from barpc.base.options import RunOptions
from barpc.cameras import open_camera
from barpc.fit import fit_rpc
from barpc.pipeline.grid_outputs import write_grids
from barpc.rpcio import WRITABLE
from barpc.scene import View
from barpc.simulate import Look, fly
from barpc.workspace import Workspace
from tests.geotiffs import write_image
from tests.jitter import Delivered, jittered
from tests.scenes.render import render
from tests.scenes.terrain import Plane, make_terrain
from tests.scenes.texture import Date, make_surfaces

GSD, ANGLE, WINDOW, EDGE, GAIN = (
    0.5,
    12.0,
    40,
    30,
    2000.0,
)  # grey values of white: CARS's SIFT asks for contrast
TARGET = np.array([5.4, 43.3, 230.0])
ALTS = (180.0, 280.0)


def scene(size: tuple[int, int], period: float, pixels: float):
    """Views with their RPCs as delivered, true cameras, images, and the ground (H, W, 3) in the middle."""
    cols, rows = size
    nadir = fly(TARGET, Look(0.0, 12.0), size, GSD)
    reach = np.abs(np.array([nadir.localize(np.array([c, r]), np.array(230.0)) for c in (0, cols) for r in (0, rows)]))
    plane = Plane(5.4, 43.3)
    edge = float(np.abs(plane.xy(reach)).max()) + 60.0
    rng = np.random.default_rng(5)
    terrain = make_terrain(rng, plane, (-edge, -edge, edge, edge), 230.0, 30.0, 3.0)
    surface = make_surfaces(rng, terrain, 0.5, [Date()])[0]
    middle = render(nadir, size, surface, samples=1).altitude
    at = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), axis=-1).astype(float)
    ground = nadir.localize(at, np.nan_to_num(middle.astype(float), nan=230.0))
    shots = []
    for number, (name, azimuth) in enumerate((("aft", 12.0), ("fore", 192.0))):
        nominal = fly(TARGET, Look(ANGLE, azimuth), size, GSD)
        true = jittered(nominal, period * (1.0 + 0.3 * number), pixels)
        image = ndimage.gaussian_filter(render(true, size, surface).brightness, 0.7)
        shots.append((name, Delivered(fit_rpc(nominal, size, ALTS).rpc, true), image))
    return shots, np.where(np.isnan(middle)[..., None], np.nan, ground)


def orthoimages(images, cameras, ground):
    """Both images on the true ground (H, W, 3), NaN where they do not reach."""
    return [
        ndimage.map_coordinates(image, np.moveaxis(camera.project(ground), -1, 0)[::-1], order=3, cval=np.nan)
        for image, camera in zip(images, cameras, strict=True)
    ]


def dense(images, cameras, ground):
    """What is left between two orthoimages (N, 2), across and along [px]: each row's median of a dense flow."""
    ortho = orthoimages(images, cameras, ground)
    known = np.isfinite(ortho[0]) & np.isfinite(ortho[1])
    low, high = np.percentile(ortho[0][known], [0.5, 99.5])
    pair = [np.clip(np.nan_to_num((o - low) / (high - low)) * 254, 0, 255).astype(np.uint8) for o in ortho]
    matcher = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    matcher.setFinestScale(0)
    flow = matcher.calc(*pair, None)
    seen = ndimage.binary_erosion(known, iterations=EDGE)[EDGE:-EDGE, EDGE:-EDGE]
    inner = np.where(seen[..., None], -flow[EDGE:-EDGE, EDGE:-EDGE], np.nan)
    return np.nanmedian(inner[seen.mean(axis=1) > 0.5], axis=1)


def left(images, cameras, ground):
    """What is left between two orthoimages (N, 2), across and along the flight [px], window by window."""
    ortho = orthoimages(images, cameras, ground)
    drow, dcol = np.gradient((ortho[0] + ortho[1]) / 2)
    rows = []
    for top in range(0, len(ground) - WINDOW + 1, WINDOW):
        part = slice(top, top + WINDOW), slice(EDGE, -EDGE)
        a, b, c = (v[part].ravel() for v in (dcol, drow, ortho[1] - ortho[0]))
        known = np.isfinite(a) & np.isfinite(b) & np.isfinite(c)
        if known.mean() > 0.8:
            keep = known & (np.abs(c) < 0.1)  # walls that only one of them sees
            rows.append(np.linalg.lstsq(np.column_stack([a, b])[keep], c[keep], rcond=None)[0])
    return np.array(rows)


def for_cars(place: Path, fitted) -> None:
    """CARS's configuration for each kind of camera file, beside the images that `kinds` wrote."""
    write = WRITABLE["geom"].write
    for kind in ("delivered", "rpc", "grid"):
        sensors = {}
        for view, fit, _ in fitted:
            model = {"path": f"{view.name}_{kind}.geom", "model_type": "RPC"}
            if kind == "grid":
                model = {"path": f"out/{view.name}_grid.tif", "model_type": "GRID"}
            else:
                (place / model["path"]).write_text(write(fit.rpc if kind == "rpc" else view.sensor))
            sensors[view.name] = {"image": f"{view.name}.tif", "geomodel": model}
        pairing = [[view.name for view, *_ in fitted]]
        whole = {"input": {"sensors": sensors, "pairing": pairing}, "output": {"directory": f"cars_{kind}"}}
        whole["subsampling"] = {"advanced": {"resolutions": [1]}}
        (place / f"cars_{kind}.yaml").write_text(json.dumps(whole, indent=1))  # JSON is YAML


def kinds(place: Path, shots, arguments):
    """Kind of camera file -> images and cameras, written into `place`."""
    size, fitted = (arguments.cols, arguments.rows), []
    for name, camera, image in shots:
        path = write_image(place / f"{name}.tif", (GAIN * image).astype(np.float32))
        view = View(name, str(path), size, camera.sensor, ALTS)
        fitted.append((view, fit_rpc(camera, size, ALTS, strict=False), camera))
    out = place / "out"
    with Workspace(out) as run:
        write_grids(run, fitted, RunOptions(grids=True))
    if arguments.cars:
        for_cars(place, fitted)
    images = [image for *_, image in shots]

    def files(end):
        return [open_camera(out / f"{name}{end}").model for name, *_ in shots]

    found = {
        "as delivered": (images, [camera.sensor for _, camera, _ in shots]),
        "one RPC": (images, [fit.rpc for _, fit, _ in fitted]),
        "_grid.tif": (images, files("_grid.tif")),
        "_correction.tif": (images, files("_correction.tif")),
    }
    return found | {"truth": (images, [camera for _, camera, _ in shots])}


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rows", type=int, default=4000)
    parser.add_argument("--cols", type=int, default=240)
    parser.add_argument("--period", type=float, default=1200.0, help="of the swing [rows]")
    parser.add_argument("--pixels", type=float, default=0.5, help="of the swing")
    parser.add_argument("--dense", action="store_true", help="every pixel's disparity")
    parser.add_argument("--cars", type=Path, help="leave files for CARS in this new folder")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    shots, ground = scene((arguments.cols, arguments.rows), arguments.period, arguments.pixels)
    height, step = GSD / (2 * np.tan(np.radians(ANGLE))), 1 if arguments.dense else WINDOW
    with tempfile.TemporaryDirectory() as folder:
        place = arguments.cars or Path(folder)
        place.mkdir(exist_ok=True)
        found = kinds(place, shots, arguments)
        print(
            f"{'cameras':18}{'across RMS [px]':>17}{'stripes RMS [m]':>17}{'largest [m]':>13}{'at the swing [m]':>18}"
        )
        for kind, (pictures, cameras) in found.items():
            rest = (dense if arguments.dense else left)(pictures, cameras, ground)
            heights = (rest[:, 1] - rest[:, 1].mean()) * height
            line = np.arange(len(heights)) * step
            waves = np.concatenate([[np.sin(2 * np.pi * line / p), np.cos(2 * np.pi * line / p)]
                                    for p in (arguments.period, 1.3 * arguments.period)])  # fmt: skip
            wave = waves.T @ np.linalg.lstsq(waves.T, heights, rcond=None)[0]
            across = float(np.sqrt((rest[:, 0] ** 2).mean()))
            print(f"{kind:18}{across:17.3f}{heights.std():17.3f}{np.abs(heights).max():13.3f}{wave.std():18.3f}")


if __name__ == "__main__":
    main()
