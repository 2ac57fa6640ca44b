"""Blocks brought to their place by a reference orthoimage of another season: error, statement and peak, case by case.

    python benchmarks/reference.py                 all cases, as a Markdown table (half an hour)
    python benchmarks/reference.py --seeds 1 --cases 2.5

Scenes are rendered (`tests/scenes`), their RPCs wrong by 60 m or 8 m (one sigma of each component), the terrain model
by 3 m, correlated over some 300 m. Every class of grey has another grey in the reference, half of them inverted
within, the sun stands elsewhere, 15 % are snow, there are three new houses a hectare; `changed` of the ground is
something else. Errors are those of exact check points, intersected by the cameras as written.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import warnings
from pathlib import Path
from typing import NamedTuple

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402  (the thread counts come first)

from barpc.base.geodesy import ecef_from_ground, enu_basis  # noqa: E402
from barpc.base.options import RunOptions  # noqa: E402
from barpc.pipeline import adjust  # noqa: E402
from barpc.rasters.dem import Dem  # noqa: E402
from barpc.rpcio import read_rpc  # noqa: E402
from barpc.sensor.triangulation import triangulate  # noqa: E402
from tests.everywhere import rows_of  # noqa: E402
from tests.scenes import ImageOptions, Scene, write_scene  # noqa: E402
from tests.scenes.season import other_season, write_dem, write_reference  # noqa: E402

DISTANCE = 694e3  # m: of the first date's satellite


class Case(NamedTuple):
    """References of one resolution on one kind of scene."""

    gsd: float  # of the reference [m]
    changed: float
    most: float  # m, horizontally
    image: dict[str, float] = {}  # noqa: RUF012 - never changed


FULL = {"gsd": 2.0, "size": 2000, "buildings": 1.0, "relief": 200.0}
CASES = (
    Case(0.5, 0.1, 0.3),
    Case(0.5, 0.8, 0.5),
    Case(2.0, 0.1, 1.0),
    Case(2.5, 0.1, 1.0),
    Case(10.0, 0.1, 2.0, FULL),
)


def scene_of(case: Case, off: float, seed: int) -> Scene:
    given = dict(case.image)
    side = int(given.pop("size", 1000))
    return Scene(ImageOptions(size=(side, side), seed=seed, attitude=off / DISTANCE, checks=300, **given))


def errors(scene: Scene, folder: Path, images: list[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Mean error (3,) of check points through the written cameras, east, north, up [m]; these points (n, 3)."""
    sensors = [read_rpc(folder / f"{path.stem}.vrt") for path in images]
    ground = scene.candidates(1000)
    seen = [scene.shots[i].exact.project(ground) for i in range(len(images))]
    size = np.array(scene.options.size)
    inside = np.array([((xy > 0) & (xy < size - 1)).all(axis=1) for xy in seen]).all(axis=0)
    ground, image = ground[inside], np.array(seen)[:, inside]
    found = triangulate(sensors, *rows_of(image.swapaxes(0, 1)), alt=scene.options.alt)
    offset = found.points - ecef_from_ground(ground)
    return np.einsum("nij,nj->ni", enu_basis(ground), offset).mean(axis=0), ground


def row(case: Case, off: float, seed: int, folder: Path) -> tuple[np.ndarray, float, np.ndarray, float, float]:
    """Error (3,) [m], mean error of the terrain [m], what is stated (3,), lowest peak, farthest camera as delivered."""
    scene = scene_of(case, off, seed)
    kind = folder / f"scene_{scene.options.gsd:g}_{off:g}_{seed}"
    if not kind.exists():
        write_scene(kind, scene.options)
        write_dem(kind / "dem.tif", scene, seed)
    images, out = sorted(kind.glob("view*.tif")), folder / "adjusted"
    if not (kind / "ties").exists():
        adjust(images, kind / "ties", RunOptions(stop_after="matching"))
    season = other_season(scene, seed, changed=case.changed)
    reference = write_reference(folder / "reference.tif", scene, season, case.gsd)
    options = RunOptions(
        reference=(str(reference),),
        dem=str(kind / "dem.tif"),
        matches=str(kind / "ties/matches.npz"),
        matches_only=True,
        overwrite=True,
    )
    result = adjust(images, out, options)
    error, ground = errors(scene, out, images)
    truth = scene.terrain.relief(*scene.terrain.plane.xy(ground).T)
    bias = float((Dem.open(kind / "dem.tif")(ground[:, 0], ground[:, 1]) - truth).mean())
    views = result.summary["reference"]["views"]
    far = max((float(np.hypot(*v["offset_en_m"])) for v in views if v["offset_en_m"]), default=np.nan)
    sigma = np.array(result.summary["scene"]["sigma_enu_m"])
    return error, bias, sigma, min(v["peak"] for v in views), far


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--cases", type=float, nargs="*", help="resolutions of references [m]; default: all")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    print(
        "| reference | changed | RPCs off by | horizontally | asked | height (terrain's own) | error / sigma | peak |"
    )
    print("|---|---|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as name:
        for case in CASES:
            if given.cases and case.gsd not in given.cases:
                continue
            for off in (60.0, 8.0):
                found = [row(case, off, seed, Path(name)) for seed in range(given.seeds)]
                flat = max(float(np.hypot(*error[:2])) for error, *_ in found)
                high, bias = max(((float(e[2]), b) for e, b, *_ in found), key=lambda pair: abs(pair[0]))
                ratio = max(float((np.abs(e) / s).max()) for e, _, s, *_ in found)
                peak, far = min(r[3] for r in found), max(r[4] for r in found)
                first = f"| {case.gsd:g} m | {100 * case.changed:.0f} % | up to {far:.0f} m | {flat:.2f} m "
                last = f"| {case.most:g} m | {high:+.1f} m ({bias:+.1f} m) | {ratio:.2f} | {peak:.1f} |"
                print(first + last, flush=True)


if __name__ == "__main__":
    main()
