"""`ortho`: orthoimages by GDAL's RPC warper, on a DEM whose heights are above the ellipsoid, as COGs on one grid."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj
import rasterio
import rasterio.shutil
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.enums import MaskFlags, Resampling
from rasterio.warp import reproject, transform
from rasterio.windows import Window

from barpc import __version__
from barpc.base.declarations import with_values
from barpc.base.errors import InputError, Remark
from barpc.base.geodesy import parts as chunks
from barpc.base.geodesy import wrap_longitude
from barpc.base.tasks import Progress
from barpc.base.verb_options import OrthoOptions
from barpc.cameras import ImageLike, open_camera
from barpc.export.shots import read_scene
from barpc.fit.points import terrain_range
from barpc.pointio.names import unique_names
from barpc.rasters.dem import Dem, localize_on_terrain
from barpc.rasters.raster import GDAL_OPTIONS, map_crs, open_raster
from barpc.rasters.vertical import WORDS, geoid_places
from barpc.rasters.vrt import BLOCK_SIZE
from barpc.report.finished import FinishedRun
from barpc.scene import Camera
from barpc.sensor.geometry import footprint, ground_sample_distance
from barpc.sensor.sampler import image_grid
from barpc.verbs.images import every, one_or_many, place_of
from barpc.verbs.points import altitude_of, terrain_of
from barpc.verbs.runs import run_folder
from barpc.workspace import Workspace

if TYPE_CHECKING:
    from typing import Unpack

    from barpc.base.keywords import OrthoKeywords, PathLike

_SIDE = 2 * BLOCK_SIZE  # px of the map warped at once
_MOST_FINER, _MOST_COARSER = 10.0, 64.0  # times an image's pixel: a hundred pixels of one, blocks of 16 px a side
_STRETCH = 100.0  # of lengths by a map: Mercator's is 57 at a latitude of 89 degrees
_MARGIN = 8  # px around the pixels that a block shows: of the kernel, and of the ground between the nodes
_HEIGHT_MARGIN = 50.0  # m around a DEM's heights at sampled places
_NODES = 17
_SPHERE = 6378137.0  # m: radius of a map on which degrees are lengths
_COG = {"COMPRESS": "DEFLATE", "PREDICTOR": "YES", "BLOCKSIZE": str(BLOCK_SIZE), "BIGTIFF": "IF_SAFER"}
_WGS84 = CRS.from_epsg(4326)


@dataclass(frozen=True)
class Ortho:
    """An orthoimage: its file, CRS, side of a pixel [m], width and height [px], and the heights it was made with.

    `doubts`: reasons why the camera is not that of its image, in sentences.
    """

    path: Path
    crs: str
    gsd: float
    size: tuple[int, int]
    heights: str
    doubts: tuple[str, ...] = ()


def ortho(
    images: ImageLike | Iterable[ImageLike],
    out_dir: PathLike,
    *,
    progress: Progress | None = None,
    **keywords: Unpack[OrthoKeywords],
) -> list[Ortho]:
    """Make orthoimages of images with RPCs, by GDAL's warper, as Cloud-Optimised GeoTIFFs on one grid.

    Parameters
    ----------
    images : path of a finished run, with its DEMs, or one or many images: paths, patterns, folders, open rasterio
        datasets, Views, Cameras
    out_dir : path, folder for the orthoimages, each with the name of its image
    progress : callable, optional, `progress(stage, done, total)`
    **keywords : fields of `OrthoOptions`: dem, geoid, alt, gsd, crs, overwrite

    Returns
    -------
    list of Ortho, an image each: path, crs, gsd [m], size [px], heights

    Raises
    ------
    InputError, FitError, RpcError
        A camera without an RPC, or not its image's; complex pixels; a DEM without heights under an image.
    OutputError
        A file that exists or cannot be written.

    Warns
    -----
    Remark : an altitude was assumed, or a part of an image has no height and so no pixels

    Examples
    --------
    >>> (done,) = barpc.ortho("data_samples/view_00.tif", "maps", alt=120, gsd=2)
    >>> done.crs, done.gsd, done.path.name
    ('EPSG:32631', 2.0, 'view_00.tif')
    """
    choices, (given, _) = with_values(OrthoOptions(), keywords, "ortho"), one_or_many(images)
    alt, terrain = choices.alt, terrain_of(choices.dem, choices.geoid, choices.alt)
    if (run := run_folder(given)) is None:
        cameras, files = zip(*((open_camera(image), Path(place_of(image))) for image in every(given)), strict=True)
    else:
        scene = read_scene(run)
        files = tuple(Path(shot.file) for shot in scene.shots)
        cameras = tuple(Camera(shot.rpc, Path(shot.file), "run", shot.size, scene.alt_range) for shot in scene.shots)
        terrain = _terrain_of_run(scene.run) if terrain is None and alt is None else terrain
        alt = scene.summary.altitude_m if alt is None else alt
    for camera, file in zip(cameras, files, strict=True):
        camera.require_usable(file)
    middles = [one.model.localize((np.array(one.extent) - 1) / 2, np.array(one.altitude)) for one in cameras]
    sides = [float(ground_sample_distance(one.rpc, at)[1]) for one, at in zip(cameras, middles, strict=True)]
    grid = map_crs(choices.crs, middles[0]), float(choices.gsd or 0.0) or float(f"{min(sides):.2g}")
    names, done = [f"{name}.tif" for name in unique_names(files)], list[Ortho]()
    with Workspace(Path(out_dir), overwrite=choices.overwrite, keep=files, names=names, adds=True) as workspace:
        for name, camera, file in zip(names, cameras, files, strict=True):
            doubts = tuple(f"{file.name}: {one.sentence}." for one in camera.doubts)
            warp = _Warp.of(camera, file, terrain, alt, grid, workspace.partial)
            warp.write(rough := workspace.partial / "rough.tif", file, progress)
            with workspace.output(name) as partial, rasterio.Env(**GDAL_OPTIONS):
                rasterio.shutil.copy(rough, partial, driver="COG", **_COG)
            done.append(Ortho(workspace.folder / name, grid[0].to_string(), grid[1], warp.size, warp.words, doubts))
    return done


def _terrain_of_run(run: FinishedRun) -> Dem | None:
    """Return the terrain that a run was made with; InputError where a DEM or geoid of it is not what it was."""
    given: Any = run.summary.options or {}
    dems = [given["dem"]] if isinstance(given.get("dem"), str) else given.get("dem") or ()
    if not dems:
        return None
    said = [given.get("geoid"), given.get("heights")]
    for k, name in enumerate(said):
        word = name and Path(name).name.lower()  # which runs keep as a path, too
        said[k] = word if word in WORDS else name and run.input(name, geoid_places())
    terrain = Dem.open([run.input(name) for name in dems], *said)
    for part in terrain.parts:
        if part.geoid is not None:
            run.ask(part.geoid.path)
    return terrain


@dataclass(frozen=True)
class _Warp:
    """The map of one image: its camera, the altitudes of its ground [m], and GDAL's settings for the heights."""

    camera: Camera
    levels: tuple[float, float]
    heights: dict[str, Any]
    words: str
    crs: CRS
    place: Affine
    size: tuple[int, int]
    side: int  # of a block [px], which shows as many pixels of the image, however large its own

    @classmethod
    def of(
        cls, camera: Camera, file: Path, terrain: Dem | None, alt: float | None, grid: tuple[CRS, float], room: Path
    ) -> _Warp:
        """Return the map that covers an image at an altitude, or on a terrain, which goes to a file."""
        (crs, gsd), model = grid, camera.model
        if terrain is None:
            level = altitude_of(camera, file, alt)
            levels, words = (level, level), f"all ground at {level:.5g} m"
            heights: dict[str, Any] = {"RPC_HEIGHT": level}
        else:
            low, high = terrain_range(model, camera.extent, camera.alt_range, terrain.covering, _HEIGHT_MARGIN)
            levels, words = (low, high), f"heights of {terrain.description}"
            heights = {"RPC_DEM": str(_write_terrain(room / "terrain.tif", camera, terrain, levels))}
            at = image_grid(camera.extent, (0.0, 0.0), (_NODES, 1))[0]
            unknown = float(np.isnan(localize_on_terrain(model, at, terrain, levels)[:, 2]).mean())
            if unknown:
                share = f"the DEM has no height under {unknown:.2g} of the image: no pixels there"
                warnings.warn(f"{file}: {share}", Remark, stacklevel=3)
        rings = np.concatenate([footprint(model, camera.extent, level) for level in levels])
        pixel = float(ground_sample_distance(model, np.append(rings[0], levels[0]))[1])
        if not (np.isfinite(rings).all() and np.isfinite(pixel)):
            raise InputError(f"{file}: shows no ground at {levels[0]:.5g} m")
        if not 1.0 / _MOST_FINER <= gsd / pixel <= _MOST_COARSER:
            raise InputError(f"--gsd {gsd:g}: an image pixel of {pixel:.2g} m: give {pixel / _MOST_FINER:.2g} m to "
                             f"{pixel * _MOST_COARSER:.2g} m")  # fmt: skip
        east, north = transform(_WGS84, crs, *rings.T)
        west, south, east, north = np.array([min(east), min(north), max(east), max(north)]) / gsd
        if not max(east - west, north - south) * gsd < _STRETCH * pixel * np.hypot(*camera.extent):
            raise InputError(f"{file}: --crs {crs.to_string()}: lies at both ends of this map; give another projection")
        west, north = float(np.floor(west)), float(np.ceil(north))
        size = int(np.ceil(east - west)), int(np.ceil(north - south))
        side = min(_SIDE, int(_SIDE * pixel / gsd))
        return cls(camera, levels, heights, words, crs, Affine(gsd, 0, west * gsd, 0, -gsd, north * gsd), size, side)

    def write(self, out: Path, image: Path, progress: Progress | None) -> None:
        """Write the map of an image, a block at a time."""
        blocks = [
            Window(col, row, min(self.side, self.size[0] - col), min(self.side, self.size[1] - row))
            for row in range(0, self.size[1], self.side)
            for col in range(0, self.size[0], self.side)
        ]
        with open_raster(image) as source, rasterio.Env(**GDAL_OPTIONS):
            kind = np.dtype(source.dtypes[0])
            if kind.kind == "c":
                raise InputError(f"{image}: complex pixels; an orthoimage needs their amplitude")
            none = source.nodata if source.nodata is not None else 0 if kind.kind in "iu" else np.nan
            layout = {"tiled": True, "blockxsize": BLOCK_SIZE, "blockysize": BLOCK_SIZE, "SPARSE_OK": True}
            what = {"dtype": kind, "nodata": none, "crs": self.crs, "transform": self.place, "BIGTIFF": "IF_SAFER"}
            with rasterio.open(out, "w", "GTiff", *self.size, source.count, **what, **layout) as file:
                file.update_tags(BARPC=__version__, IMAGE=image.name, HEIGHTS=self.words)
                for number, block in enumerate(blocks, start=1):
                    if (part := self._pixels(block)) is not None:
                        file.write(self._warped(source, part, block, none), window=block)
                    if progress is not None:
                        progress(f"ortho {image.stem}", number, len(blocks))

    def _pixels(self, block: Window) -> Window | None:
        """Return the part of the image that a block of the map shows; None where it shows none."""
        nodes = np.linspace(0.0, 1.0, _NODES)
        col, row = np.meshgrid(block.col_off + nodes * block.width, block.row_off + nodes * block.height)
        lon, lat = transform(self.crs, _WGS84, *(self.place @ (col.ravel(), row.ravel())))
        ground = np.array([(x, y, level) for level in self.levels for x, y in zip(lon, lat, strict=True)])
        at = self.camera.model.project(ground)
        at = at[np.isfinite(at).all(axis=1)]
        if not len(at):
            return None
        low = np.maximum(np.floor(at.min(axis=0)) - _MARGIN, 0).astype(int)
        high = np.minimum(np.ceil(at.max(axis=0)) + _MARGIN, self.camera.extent).astype(int)
        return Window(*low, *(high - low)) if (high > low).all() else None

    def _warped(self, source: Any, part: Window, block: Window, none: float) -> Any:
        """Return the pixels (bands, rows, cols) of a block of the map."""
        whole = MaskFlags.all_valid in source.mask_flag_enums[0]
        pixels = source.read(window=part) if whole else source.read(window=part, masked=True).filled(none)
        out = np.full((source.count, int(block.height), int(block.width)), none, pixels.dtype)
        reproject(
            pixels,
            out,
            rpcs=self.camera.rpc.crop(int(part.col_off), int(part.row_off)).to_rasterio(),
            src_crs=_WGS84,
            src_nodata=None if whole else none,
            dst_transform=self.place @ Affine.translation(block.col_off, block.row_off),
            dst_crs=self.crs,
            dst_nodata=none,
            resampling=Resampling.cubic,
            **self.heights,
        )
        return out


def _write_terrain(path: Path, camera: Camera, terrain: Dem, levels: tuple[float, float]) -> Path:
    """Write heights above the ellipsoid on the posts of a DEM, around the ground of an image, without a vertical datum.

    GDAL adds no geoid to such a file.
    """
    grid, to_map = terrain.grid, ~terrain.grid.to_pixel
    ring = np.concatenate([footprint(camera.model, camera.extent, level) for level in levels])
    ring[:, 0] = wrap_longitude(ring[:, 0], ring[0, 0])
    row, col = grid.locate(*ring.T)
    if grid.crs.is_geographic:  # columns run on where the DEM begins
        col = col[0] + (ring[:, 0] - ring[0, 0]) * grid.to_pixel.a
    (left, top), (right, bottom) = (np.floor([col.min(), row.min()]) - 1, np.ceil([col.max(), row.max()]) + 2)
    place, size = to_map @ Affine.translation(left, top), (int(right - left), int(bottom - top))
    whole = pyproj.CRS(grid.crs.to_wkt())
    flat = (whole.sub_crs_list[0] if whole.is_compound else whole).to_2d().to_wkt()
    if grid.crs.is_geographic:
        half = place.a * size[0] / 2
        east = wrap_longitude(place.c + half)
        place, flat = Affine(place.a, 0.0, east - half, 0.0, place.e, place.f), "EPSG:4326"
        if abs(east) + half > 180.0:  # where GDAL has no posts: the same in a map, at half as much CPU again
            place = Affine.scale(np.radians(_SPHERE)) @ Affine.translation(-east, 0.0) @ place
            flat = f"+proj=eqc +lon_0={east} +R={_SPHERE}"
    what = {"dtype": "float32", "nodata": -32768.0, "crs": flat, "transform": place, "tiled": True}
    with rasterio.open(path, "w", "GTiff", *size, 1, **what) as file:
        for rows in chunks(size[1], BLOCK_SIZE):
            at = np.meshgrid(left + np.arange(size[0]), top + np.arange(rows.start, rows.stop))
            heights = terrain(*grid.place(at[1].ravel(), at[0].ravel())).reshape(at[0].shape)
            known = np.where(np.isfinite(heights), heights, what["nodata"]).astype(np.float32)
            file.write(known, 1, window=Window(0, rows.start, size[0], len(known)))
    return path
