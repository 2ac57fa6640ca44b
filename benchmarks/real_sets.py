"""The sets of `benchmarks/real.py`: real images as they are, and sets that are made of real cameras.

What is made: an image whose RPC is changed by what is known (moved, turned about the vertical, enlarged); images of
real cameras on a surface that no tool knows, with exact check points; an orthoimage as the image of a camera, whose
right place is on the grid of another date. Check points come from the RPC formula of tools/epi_check.py beside the
data and from PROJ, not from this package.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np
import rasterio
import rasterio.rpc
import rasterio.warp
from scipy import ndimage

from barpc.base.geodesy import Array
from barpc.fit import fit_rpc_points
from barpc.rpcio import read_rpc
from barpc.sensor.rational import monomials
from barpc.sensor.rpc import RPC
from tests.geotiffs import write_image
from tests.scenes.render import Radiometry, expose, render
from tests.scenes.terrain import Buildings, Grid, Plane, Terrain
from tests.scenes.texture import Date, make_surfaces

PASS_SIZE = 800  # px a side: some 0.15 km2 of Toulouse


@dataclass(frozen=True)
class Change:
    """A known error of an RPC: a turn about the vertical of the image's middle, a scale about it, a shift."""

    shift: tuple[float, float] = (0.0, 0.0)  # col, row [px]
    yaw: float = 0.0  # [rad]
    scale: float = 0.0  # of both axes, less one


@dataclass(frozen=True)
class Scene:
    """Images of one place, with the options that go with them."""

    name: str
    images: tuple[Path, ...]  # IMAGE arguments of barpc adjust
    options: tuple[str, ...] = ()
    change: Change | None = None  # of the RPC of the last image
    ties: tuple[Path, ...] = ()  # check points, named as A__B__... after the stems of images
    gcps: Path | None = None  # check points on the ground, with `held` control points
    held: bool = False  # whether each is held out in turn, while the others are control points
    corners: bool = False  # a camera without pixels: the check points are the vendor's corners of the image
    missing: str = ""
    make: Callable[[Path], Scene] | None = None  # the set itself, made in a folder


def scenes(data: Path) -> Iterator[Scene]:
    """The sets of the data, absent ones with the reason."""
    optical, cross, ties = data / "optical", data / "cross_sensor", data / "truth/ties"
    north = tuple(sorted((optical / "phr_triplet_north").glob("img_*.tif")))
    checks = tuple(sorted(ties.glob("phr_triplet_north__*ncc_check.csv")))
    ventoux = optical / "phr_ventoux"
    left, right = (ventoux / f"{side}_image.tif" for side in ("left", "right"))
    of_ventoux = tuple(sorted(ties.glob("phr_ventoux__*ncc_check.csv")))
    aerial, quickbird = cross / "ngi_2015", optical / "qb2_single/qb2_basic1b.tif"
    truth = quickbird.with_name("gcps.geojson")
    terrain = ("--dem", str(aerial / "dem.tif"), "--geoid", str(data / "dem/egm96_15.gtx"))
    orthos = itertools.chain(*(("--reference", str(one)) for one in sorted(aerial.glob("ortho_*.tif"))))
    frames = tuple(sorted(aerial.glob("ngi_*.tif")))
    toulouse = tuple(sorted((data / "passes/phr_toulouse").glob("*.XML")))
    dates = tuple(sorted((optical / "s2_two_dates").glob("*.tif")))
    turned = Change((12.0, 16.0), yaw=3e-3, scale=2e-3)
    found = [
        Scene("Pleiades triplet", north, ties=checks),
        Scene("the same, 20 px of bias in one RPC", north, change=Change((12.0, 16.0)), ties=checks),
        Scene("the same, and 3 mrad of yaw, 0.2 % of scale", north, change=turned, ties=checks),
        Scene("Pleiades pair, Ventoux", (left, right), ties=of_ventoux),
        Scene("Ventoux PAN and XS", (cross / "phr_ventoux_xs/left_xs.tif", right)),
        Scene("QuickBird 2003 and aerial 2015", (quickbird, *frames[:1]), terrain),
        Scene("QuickBird on four orthoimages", (quickbird,), (*orthos, *terrain), gcps=truth),
        Scene("QuickBird, each of five GCPs held out", (quickbird,), gcps=truth, held=True),
        Scene("aerial frames", frames),
        Scene("Pleiades pass over Toulouse, rendered", toulouse, make=partial(rendered_pass, data)),
        Scene("Sentinel-2 on another date", dates, make=partial(two_dates, dates)),
        Scene("WorldView-1, the vendor's corners", (data / "physical_maxar/10200100A1865800.r100.xml",), corners=True),
    ]  # fmt: skip
    for one in found:
        absent = [path for path in one.images if not path.exists()]
        reason = f"{absent[0]} is absent" if absent else "" if one.images else "no images"
        yield replace(one, missing=one.missing or reason)


def of_folder(folder: Path) -> Scene:
    """A set of all rasters of a folder."""
    images = tuple(
        sorted(path for path in folder.iterdir() if path.suffix.lower() in (".tif", ".tiff", ".ntf", ".jp2"))
    )
    return Scene(folder.name, images, missing="" if len(images) > 1 else f"{folder} has fewer than two images")


def formula(check: Path) -> ModuleType:
    """The module of `epi_check.py`."""
    spec = importlib.util.spec_from_file_location("epi_check", check)
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool


def change_tag(path: Path, change: Change) -> None:
    """Give an image an RPC that is wrong by a known change."""
    with rasterio.open(path, "r+") as file:
        middle = np.array([file.width - 1.0, file.height - 1.0]) / 2
        file.rpcs = changed(file.rpcs, middle, change, read_rpc(path).localize(middle, np.array(file.rpcs.height_off)))


def changed(rpcs: rasterio.rpc.RPC, middle: Array, change: Change, ground: Array) -> rasterio.rpc.RPC:
    """An RPC that is wrong by a known change, exactly: cubics of turned coordinates are cubics.

    `middle` (2,) is the place [px], `ground` (3,) the ground point that stay where they are but for the shift.
    """
    offset = np.array([rpcs.long_off, rpcs.lat_off, rpcs.height_off])
    scale = np.array([rpcs.long_scale, rpcs.lat_scale, rpcs.height_scale])
    narrow = np.array([np.cos(np.radians(ground[1])), 1.0])  # a degree of longitude, in degrees of latitude
    some = np.random.default_rng(0).uniform(-1.2, 1.2, (400, 3))
    x, y = ((some * scale + offset - ground)[:, :2] * narrow).T
    cosine, sine = np.cos(change.yaw), np.sin(change.yaw)
    turned = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1) / narrow + ground[:2]
    before = np.column_stack([(turned - offset[:2]) / scale[:2], some[:, 2]])
    fields = rpcs.to_dict()
    for axis in ("samp", "line"):
        names = [f"{axis}_{part}_coeff" for part in ("num", "den")]
        values = monomials(before.T).T @ np.array([fields[name] for name in names]).T
        coeffs = np.linalg.lstsq(monomials(some.T).T, values, rcond=None)[0].T
        fields |= dict(zip(names, (coeffs / coeffs[1, 0]).tolist(), strict=True))
    larger = 1.0 + change.scale
    for axis, at, by in zip(("samp", "line"), middle, change.shift, strict=True):
        fields[f"{axis}_scale"] *= larger
        fields[f"{axis}_off"] = float(at + larger * (fields[f"{axis}_off"] - at) + by)
    return rasterio.rpc.RPC(**fields)


def as_rasterio(rpc: RPC, corner: Array) -> rasterio.rpc.RPC:
    """An RPC for the part of its image that begins at a corner (2,) [px]."""
    names = [f"{axis}_{part}_coeff" for axis in ("samp", "line") for part in ("num", "den")]
    fields: dict[str, object] = {name: row.tolist() for name, row in zip(names, rpc.coeffs, strict=True)}
    for kind, values in (("off", rpc.ground_offset), ("scale", rpc.ground_scale)):
        fields |= {f"{axis}_{kind}": float(v) for axis, v in zip(("long", "lat", "height"), values, strict=True)}
    for kind, values in (("off", rpc.image_offset - corner), ("scale", rpc.image_scale)):
        fields |= {f"{axis}_{kind}": float(v) for axis, v in zip(("samp", "line"), values, strict=True)}
    return rasterio.rpc.RPC(**fields)


def rendered_pass(data: Path, place: Path) -> Scene:
    """Images of the pass's cameras on a part of the Ventoux' SRTM heights, laid under Toulouse.

    The RPCs delivered are moved by 5 px at random, which vendors' are; check points are exact.
    """
    tool, rng = formula(data.parent / "tools/epi_check.py"), np.random.default_rng(3)
    plane = Plane(1.4, 43.55)
    relief = _srtm_relief(data)
    terrain = Terrain(plane, relief, Buildings(np.empty((0, 2)), np.empty((0, 2)), *np.empty((3, 0))))
    (surface,) = make_surfaces(rng, terrain, 0.25, [Date()])
    middle = np.array([plane.lon, plane.lat, float(relief(np.zeros(1), np.zeros(1))[0])])
    images, exact = [], []
    for number, path in enumerate(sorted((data / "passes/phr_toulouse").glob("*.XML"))):
        corner = np.floor(read_rpc(path).project(middle)) - PASS_SIZE // 2
        rpcs, image = as_rasterio(read_rpc(path), corner), place / f"toulouse_{number}.tif"
        write_image(image, np.ones((PASS_SIZE, PASS_SIZE), np.uint16), rpcs=rpcs, nodata=0)
        exact.append(tool.Rpc(image))
        seen = render(read_rpc(image), (PASS_SIZE, PASS_SIZE), surface)
        write_image(image, expose(seen.brightness, Radiometry(), rng), rpcs=rpcs, nodata=0)
        change_tag(image, Change(tuple(rng.normal(0.0, 5.0, 2))))
        images.append(image)
    ties = []
    for (i, a), (j, b) in itertools.combinations(enumerate(images), 2):
        ties.append(place / f"made__{a.stem}__{b.stem}__exact.csv")
        _exact_ties(exact[i], exact[j], plane, relief, ties[-1])
    return Scene("", tuple(images), ties=tuple(ties))


def _srtm_relief(data: Path) -> Grid:
    """0.9 km of SRTM heights by splines, stretched to 60 m about the altitudes that the pass's RPCs are made for."""
    with rasterio.open(data / "dem/N44E005.hgt") as file:
        posts = file.read(1)[980:991, 330:341].astype(np.float64)
    fine = ndimage.zoom(posts[::-1], 41, order=3)
    low, high = fine.min(), fine.max()
    heights = 190.0 + 60.0 * (fine - low) / (high - low)
    half = np.array(fine.shape[::-1]) - 1.0
    return Grid(-half, 2.0, heights.astype(np.float32))


def _exact_ties(a: object, b: object, plane: Plane, relief: Grid, path: Path) -> None:
    """Check points on a grid over one image, where another sees them: the ground by fixed-point iteration."""
    axis = np.linspace(20.0, PASS_SIZE - 21.0, 25)
    seen = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    alt = np.full(len(seen), float(relief.values.mean()))
    for _ in range(12):
        ground = a.localize(seen, alt)  # type: ignore[attr-defined]
        alt = relief(*plane.xy(ground).T).astype(np.float64)
    other = b.project(ground)  # type: ignore[attr-defined]
    inside = ((other > 10) & (other < PASS_SIZE - 11)).all(axis=1)
    rows = np.hstack([seen, other])[inside]
    np.savetxt(path, rows, delimiter=",", header="col_a,row_a,col_b,row_b", comments="")


def two_dates(images: tuple[Path, ...], place: Path) -> Scene:
    """The orthoimage of one date as the image of a camera 786 km above, whose RPC is moved; the other as reference.

    On level ground at altitude 0 the image is the orthoimage. The grids of two dates are up to two pixels apart: check
    points are what correlation of gradients finds of one in the other.
    """
    reference, image = images
    with rasterio.open(reference) as file:
        first, size = file.read(1), np.array([file.width, file.height])
    with rasterio.open(image) as file:
        band, crs, transform = file.read(1), file.crs, file.transform
    corners = np.array([transform * (0, 0), transform * tuple(size)])
    station = np.array([corners[0, 0] - 80e3, corners[:, 1].mean()])  # of an image at the side of the swath

    def ground(at: Array, alt: Array) -> Array:
        flat = np.stack(transform * (at[:, 0] + 0.5, at[:, 1] + 0.5), axis=1)
        flat += (alt / 786e3)[:, None] * (station - flat)
        return np.column_stack([*rasterio.warp.transform(crs, "EPSG:4326", *flat.T), alt])

    axes = [np.linspace(-0.5, n - 0.5, 15) for n in size]
    cols, rows, alts = (one.ravel() for one in np.meshgrid(*axes, np.linspace(-500.0, 1500.0, 7)))
    at = np.column_stack([cols, rows])
    made, level, gcps = place / "s2_image.tif", place / "level.tif", place / "points.geojson"
    write_image(
        made, band, rpcs=as_rasterio(fit_rpc_points(ground(at, alts), at).rpc, np.zeros(2)), nodata=0
    )  # exact to 1e-6 px
    change_tag(made, Change((3.0, -4.0)))
    seen, there = correlated(band, first)
    features = [
        {"properties": {"ji": one}, "geometry": {"coordinates": other}}
        for one, other in zip(seen.tolist(), ground(there, np.zeros(len(there))).tolist(), strict=True)
    ]
    gcps.write_text(json.dumps({"features": features}))
    coarse = transform * rasterio.Affine.translation(-50, -50) * rasterio.Affine.scale(100)
    heights = np.zeros((size[1] // 100 + 2, size[0] // 100 + 2), np.float32)
    write_image(level, heights, crs=crs, transform=coarse)
    options = "--reference", str(reference.resolve()), "--dem", str(level), "--geoid", "none"
    return Scene("", (made,), options, gcps=gcps)


def correlated(image: Array, other: Array, side: int = 96, reach: int = 8, step: int = 48) -> tuple[Array, Array]:
    """Places (N, 2) [px] in an image and in another on the same grid: windows of gradients, those near the median."""
    edges = [np.hypot(*np.gradient(np.log(np.maximum(one, 1).astype(np.float64)))) for one in (image, other)]
    edges = [one.astype(np.float32) for one in edges]
    found = []
    for row in range(reach, image.shape[0] - side - reach, step):
        for col in range(reach, image.shape[1] - side - reach, step):
            part = np.s_[row : row + side, col : col + side]
            wide = np.s_[row - reach : row + side + reach, col - reach : col + side + reach]
            if image[part].min() == 0 or other[wide].min() == 0:  # no data
                continue
            score = cv2.matchTemplate(edges[1][wide], edges[0][part], cv2.TM_CCOEFF_NORMED)
            _, best, _, (x, y) = cv2.minMaxLoc(score)
            if best > 0.3 and 0 < x < 2 * reach and 0 < y < 2 * reach:
                fine = [
                    0.5 * (low - high) / (low - 2 * best + high)
                    for low, high in ((score[y, x - 1], score[y, x + 1]), (score[y - 1, x], score[y + 1, x]))
                ]
                middle = 0.5 * (side - 1)
                found.append([col + middle, row + middle, x + fine[0] - reach, y + fine[1] - reach])
    at, shift = np.split(np.array(found), 2, axis=1)
    off = np.abs(shift - np.median(shift, axis=0))
    near = (off < 5.0 * np.median(off, axis=0)).all(axis=1)
    return at[near], (at + shift)[near]
