"""For COLMAP, trainers of Gaussian splatting and nerfstudio: pinhole cameras, pictures, and coloured tie points."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from html import escape
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import numpy.typing as npt

from barpc.base.errors import InputError, UsageError
from barpc.base.geodesy import Array, Box, ByteImage
from barpc.base.remote import is_url
from barpc.base.verb_options import ExportOptions
from barpc.export.files import FileContents, as_json, ply
from barpc.export.light import lit
from barpc.export.pinholes import Picture, Pinhole, mapped, pictures_of, pinhole_of
from barpc.export.shots import Scene, Shot, relative_link
from barpc.rasters.raster import open_raster
from barpc.report.records import flat_options
from barpc.scene import BoolArray, IntArray

PINHOLE_TOLERANCE = 0.1
"""px that a picture's pinhole may miss: as much as tie points of good images scatter (0.04 to 0.2 px)."""
_CORNER = 0.5  # px from the corner of the first pixel, where COLMAP counts from, to its centre
_SPLINE_MARGIN = 8  # px around what a picture shows: of the spline
_GCP_NODES = 5  # a side: GDAL's polynomials of order 2 follow the homographies of satellites to 1e-4 px


@dataclass(frozen=True, eq=False)
class _ModelImage:
    """An image of the model: its name in ``images``, size, camera, largest error [px] and tie points.

    `index` (n,), `xy` (n, 2): tie points, places among the scene's points, and where the picture shows them [px],
    counted from the corner of the first pixel; `picture`: how it is made of the image, None of the image itself.
    """

    shot: Shot
    name: str
    size: tuple[int, int]
    pinhole: Pinhole
    error: float
    index: IntArray
    xy: Array
    picture: Picture | None = None


def colmap(scene: Scene, out: Path, how: ExportOptions) -> FileContents:
    """Write a model of pinhole cameras in COLMAP's text, tie points as PLY, and ``transforms.json`` of nerfstudio.

    ``world.json`` places the model on Earth. Cameras are central: square pixels, the principal point in the middle; the
    images are resampled for it, into ``images`` and ``masks``, or by the user (``warp.sh``). With `how.exact` they are
    the nearest cameras of the images as they are, which are linked (`image_links`).

    Raises
    ------
    InputError
        A pinhole misses more than the tolerance; of images on other hosts no pictures are made; a name has a space.
    """
    if how.exact and (how.images or how.tolerance is not None):
        raise UsageError("--exact takes the images as they are: --images and --tolerance go with pictures made of them")
    scene = lit(scene, needed=False)
    if how.exact:
        entries = _whole_images(scene)
        return _written_model(scene, out, entries, np.full((len(scene.points), 3), 128, np.uint8))
    tolerance = PINHOLE_TOLERANCE if how.tolerance is None else how.tolerance
    entries = _pictures(scene, tolerance, ".png" if how.images else ".tif")
    pixels = {shot.name: _ShotPixels(shot) for shot in scene.shots}
    files = _written_model(
        scene, out, entries, _colours(scene, entries, pixels), masks=how.images, tolerance_px=tolerance
    )
    if how.images:
        return {**files, **_resampled(entries, pixels)}
    return {**files, **_for_gdal(entries, pixels, out)}


def _whole_images(scene: Scene) -> list[_ModelImage]:
    entries = []
    for shot, name in zip(scene.shots, _called(scene), strict=True):
        if any(char.isspace() for char in name):
            raise InputError(
                f"{shot.file}: COLMAP ends the name of an image at a space; rename it, or give a link without one"
            )
        pinhole, error = pinhole_of(scene, shot)
        entries.append(_ModelImage(shot, name, shot.size, pinhole, error, shot.index, shot.xy + _CORNER))
    return entries


def _pictures(scene: Scene, tolerance: float, suffix: str) -> list[_ModelImage]:
    """Return the pictures of all images; a tie point is of the part that holds it, so that it counts once an image."""
    entries = []
    for shot, name in zip(scene.shots, _called(scene), strict=True):
        if is_url(shot.file) or not shot.file:
            raise InputError(f"{shot.file or shot.name}: pictures are made of images on this host; or export --exact")
        pictures = pictures_of(scene, shot, tolerance)
        stem = re.sub(r"[^\w-]", "_", PurePath(name).stem)  # trainers end a name at its first dot
        for picture in pictures:
            col, row, width, height = picture.window
            place = f"_{row}_{col}" * (len(pictures) > 1)
            inside = ((shot.xy >= [col - 0.5, row - 0.5]) & (shot.xy < [col + width - 0.5, row + height - 0.5])).all(
                axis=1
            )
            xy = mapped(picture.inverse, shot.xy[inside] + _CORNER)
            one = picture.size, picture.pinhole, picture.error, shot.index[inside], xy, picture
            entries.append(_ModelImage(shot, f"{stem}{place}{suffix}", *one))
    if len({one.name for one in entries}) < len(entries):
        entries = [replace(one, name=f"{k}_{one.name}") for k, one in enumerate(entries)]
    return entries


# --- the model ----------------------------------------------------------------------------------------------


def _written_model(
    scene: Scene, out: Path, entries: Sequence[_ModelImage], colours: ByteImage, masks: bool = False, **about: Any
) -> FileContents:
    """Return the text model, its points and ``transforms.json``, and ``world.json`` with more keys, `about` it."""
    from scipy.spatial.transform import Rotation  # of no other tool

    world = scene.world(scene.points)
    cameras, images = [], []
    seen: dict[int, list[tuple[int, int, float]]] = {}
    for number, one in enumerate(entries, start=1):
        numbers = [*one.size, *one.pinhole.focal.tolist(), *(one.pinhole.center + _CORNER).tolist()]
        cameras.append(_text_line(number, "PINHOLE", *numbers))
        turn = Rotation.from_matrix(one.pinhole.rotation).as_quat(canonical=True, scalar_first=True).tolist()
        images.append(_text_line(number, *turn, *one.pinhole.translation.tolist(), number, one.name))
        places = zip(one.xy.tolist(), (one.index + 1).tolist(), strict=True)
        images.append(" ".join(_text_line(*xy, point) for xy, point in places))
        miss = np.linalg.norm(one.pinhole.project(world[one.index]) + _CORNER - one.xy, axis=1)
        for place, (point, error) in enumerate(zip(one.index.tolist(), miss.tolist(), strict=True)):
            seen.setdefault(point, []).append((number, place, error))
    points, means = [], []
    for point in sorted(seen):
        track = [value for image, place, _ in seen[point] for value in (image, place)]
        means.append(float(np.mean([error for *_, error in seen[point]])))
        points.append(_text_line(point + 1, *world[point].tolist(), *colours[point].tolist(), means[-1], *track))
    texts = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}
    known = np.array(sorted(seen), dtype=np.int64)
    columns: dict[str, npt.NDArray[Any]] = dict(zip("xyz", world[known].T.astype(np.float32), strict=True))
    columns |= {name: np.zeros(len(known), np.float32) for name in ("nx", "ny", "nz")}
    columns |= dict(zip(("red", "green", "blue"), colours[known].T.copy(), strict=True))
    about["mean_reprojection_error_px"] = float(np.mean(means)) if means else None
    return {f"sparse/0/{name}": ("\n".join(lines) + "\n").encode() for name, lines in texts.items()} | {
        "sparse/0/points3D.ply": ply(columns),
        "transforms.json": as_json(_transforms(entries, masks)),
        "world.json": as_json(_world(scene, entries, out) | about),
    }


def _transforms(entries: Iterable[_ModelImage], masks: bool) -> dict[str, Any]:
    """Return the cameras in nerfstudio's JSON: they look along -z, y is up."""
    frames = []
    for one in entries:
        pose = np.eye(4)
        pose[:3, :3] = one.pinhole.rotation.T * [1.0, -1.0, -1.0]
        pose[:3, 3] = -one.pinhole.rotation.T @ one.pinhole.translation
        numbers = *one.pinhole.focal, *(one.pinhole.center + _CORNER), *one.size
        frame = dict(zip(("fl_x", "fl_y", "cx", "cy", "w", "h"), numbers, strict=True))
        frame |= {"file_path": f"images/{one.name}", "transform_matrix": pose}
        frames.append(frame | ({"mask_path": f"masks/{one.name}"} if masks else {}))
    return {"camera_model": "PINHOLE", "frames": frames, "ply_file_path": "sparse/0/points3D.ply"}


def _world(scene: Scene, entries: Sequence[_ModelImage], out: Path) -> dict[str, Any]:
    """Return the place of the model on Earth, and the image and homography of each picture."""
    lon, lat, alt = scene.origin
    found: dict[str, Any] = {
        "frame": "metres east, north, up of the origin; (x, y, z, 1) behind world_to_ecef is ECEF (EPSG:4978), "
        "which EPSG:4979 has as lon, lat, altitude above the ellipsoid",
        "origin": {"lon": lon, "lat": lat, "alt": alt},
        "world_to_ecef": scene.world_to_ecef,
        "alt_range": scene.alt_range,
        "pinhole_error_px": {one.name: one.error for one in entries},
        "images": {one.name: relative_link(one.shot.file, out) for one in entries},
        "pictures": {
            one.name: {"window": one.picture.window, "homography": one.picture.homography}
            for one in entries if one.picture
        },
        "sun": {
            one.name: {"elevation": elevation, "azimuth": azimuth, "toward": _toward(elevation, azimuth)}
            for one in entries
            if (elevation := one.shot.light.elevation) is not None and (azimuth := one.shot.light.azimuth) is not None
        },
        "time": {one.name: one.shot.light.time for one in entries if one.shot.light.time},
    }  # fmt: skip
    return {key: value for key, value in found.items() if not isinstance(value, dict) or value}


def _toward(elevation: float, azimuth: float) -> Array:
    up, turn = np.radians([elevation, azimuth])
    return np.array([np.cos(up) * np.sin(turn), np.cos(up) * np.cos(turn), np.sin(up)])


def _called(scene: Scene) -> list[str]:
    """Return the names of the images in the model: of their files where these differ, else of the run."""
    names = [PurePath(shot.file).name for shot in scene.shots]
    if len(set(names)) == len(names):
        return names
    return [shot.name + PurePath(shot.file).suffix for shot in scene.shots]


def image_links(scene: Scene) -> dict[str, str]:
    """Return the links in the folder of an exact model and the local images that they point at: nothing is copied."""
    rows = zip(scene.shots, _called(scene), strict=True)
    return {f"images/{name}": shot.file for shot, name in rows if not is_url(shot.file)}


def _text_line(*values: float | str) -> str:
    return " ".join(value if isinstance(value, str) else repr(value) for value in values)


# --- pixels -------------------------------------------------------------------------------------------------


class _ShotPixels:
    """The pixels of a shot in 8 bits: red, green and blue where its bands are so called, else the band of its run."""

    def __init__(self, shot: Shot) -> None:
        from barpc.tie.pixels import survey  # (OpenCV's)

        self.file = shot.file
        band = int(flat_options(shot.run.summary.options or {}).get("tie.band", 1))
        with open_raster(self.file) as dataset:
            self.held = int(dataset.width), int(dataset.height)
            names = [color.name for color in dataset.colorinterp]
        colours = [names.index(name) + 1 for name in ("red", "green", "blue") if name in names]
        bands = colours if len(colours) == 3 else [band]
        self.surveys = [found for one in bands if (found := survey(self.file, one, shot.size)) is not None]
        self.size = shot.size
        if len(self.surveys) < len(bands):
            raise InputError(f"{self.file}: nothing varies in it: no picture is made of it")

    def read(self, box: Box) -> tuple[ByteImage, BoolArray]:
        """Return the colours (height, width, 3) of a window, and where they are valid."""
        from barpc.tie.pixels import read_picture

        parts = [read_picture(self.file, box, found) for found in self.surveys]
        grey = len(parts) == 1
        return np.stack([one for one, _ in parts] * (3 if grey else 1), axis=-1), np.all([v for _, v in parts], axis=0)


def _colours(scene: Scene, entries: Iterable[_ModelImage], pixels: dict[str, _ShotPixels]) -> ByteImage:
    """Return the mean colours (P, 3) of tie points in the images that show them."""
    sums, counts = np.zeros((len(scene.points), 3)), np.zeros(len(scene.points))
    for one in entries:
        assert one.picture is not None
        if len(one.index):
            at = np.rint(mapped(one.picture.homography, one.xy) - _CORNER).astype(int)
            low = np.clip(at.min(axis=0), 0, None)
            size = np.minimum(at.max(axis=0) + 1, one.shot.size) - low
            shown, _ = pixels[one.shot.name].read((int(low[0]), int(low[1]), int(size[0]), int(size[1])))
            col, row = np.clip(at - low, 0, size - 1).T
            sums[one.index] += shown[row, col]
            counts[one.index] += 1
    return np.rint(sums / np.maximum(counts, 1)[:, None]).astype(np.uint8)


def _resampled(entries: Sequence[_ModelImage], pixels: dict[str, _ShotPixels]) -> FileContents:
    """Return the pictures and their masks, made when they are written, one after the other."""

    @lru_cache(1)
    def render(k: int) -> tuple[ByteImage, BoolArray]:
        return _rendered(entries[k], pixels[entries[k].shot.name])

    files: dict[str, Callable[[], bytes]] = {}
    for k, one in enumerate(entries):
        files[f"images/{one.name}"] = partial(_png, partial(render, k), True)
        files[f"masks/{one.name}"] = partial(_png, partial(render, k), False)
    return files


def _rendered(one: _ModelImage, pixels: _ShotPixels) -> tuple[ByteImage, BoolArray]:
    """Return a picture (h, w, 3), by cubic splines, and where it shows valid pixels."""
    from scipy.ndimage import map_coordinates

    assert one.picture is not None
    nodes = np.stack(np.meshgrid(*(np.arange(n) + _CORNER for n in one.size)), axis=-1).reshape(-1, 2)
    at = mapped(one.picture.homography, nodes) - _CORNER
    low = np.clip(np.floor(at.min(axis=0)).astype(int) - _SPLINE_MARGIN, 0, None)
    size = np.minimum(np.ceil(at.max(axis=0)).astype(int) + _SPLINE_MARGIN, one.shot.size) - low
    shown, valid = pixels.read((int(low[0]), int(low[1]), int(size[0]), int(size[1])))
    place, shape = (at - low).T[::-1], one.size[::-1]
    known = map_coordinates(valid.astype(np.float32), place, order=1, cval=0.0) > 0.999
    layers = [map_coordinates(shown[..., k].astype(np.float32), place, order=3, mode="mirror") for k in range(3)]
    picture = np.clip(np.rint(np.stack(layers, axis=-1)), 0, 255) * known[:, None]
    return picture.astype(np.uint8).reshape(*shape, 3), known.reshape(shape)


def _png(render: Callable[[], tuple[ByteImage, BoolArray]], of_picture: bool) -> bytes:
    """Return a picture as PNG, with an alpha band where pixels are missing; or its mask, 255 where it is valid."""
    import cv2

    picture, known = render()
    mask = (known * np.uint8(255)).astype(np.uint8)
    layers = [picture[..., ::-1]] if known.all() else [picture[..., ::-1], mask[..., None]]  # blue first
    return bytes(cv2.imencode(".png", np.concatenate(layers, axis=-1) if of_picture else mask)[1])


def _for_gdal(entries: Iterable[_ModelImage], pixels: dict[str, _ShotPixels], out: Path) -> FileContents:
    """Return ``warp.sh``, with which GDAL makes the pictures, of 8-bit VRTs that have the homography as GCPs."""
    lines, files = ["#!/bin/sh", "# run in this folder", "mkdir -p images"], {}
    for one in entries:
        vrt = f"gdal/{PurePath(one.name).stem}.vrt"
        files[vrt] = _vrt(one, pixels[one.shot.name], out / "gdal")
        width, height = one.size
        lines.append(
            f"gdalwarp -q -order 2 -et 0 -r cubic -te 0 0 {width} {height} -ts {width} {height} {vrt} images/{one.name}"
        )
    return {**files, "warp.sh": ("\n".join(lines) + "\n").encode()}


def _vrt(one: _ModelImage, pixels: _ShotPixels, folder: Path) -> bytes:
    """Return a VRT of an image in 8 bits whose GCPs lie in the picture, y upwards from its lower border."""
    assert one.picture is not None
    nodes = np.stack(np.meshgrid(*(np.linspace(0, n, _GCP_NODES) for n in one.size)), axis=-1).reshape(-1, 2)
    at = mapped(one.picture.homography, nodes)
    lines = [f'<VRTDataset rasterXSize="{pixels.size[0]}" rasterYSize="{pixels.size[1]}">', "<GCPList>"]
    for n, ((x, y), (col, row)) in enumerate(zip(nodes.tolist(), at.tolist(), strict=True)):
        lines.append(f'<GCP Id="{n}" Pixel="{col!r}" Line="{row!r}" X="{x!r}" Y="{one.size[1] - y!r}"/>')
    lines.append("</GCPList>")
    name = escape(relative_link(one.shot.file, folder), quote=False)
    for number, found in enumerate(pixels.surveys, start=1):
        ratio = 255.0 / (found.stretch.high - found.stretch.low)
        lines += [
            f'<VRTRasterBand dataType="Byte" band="{number}"><ComplexSource resampling="average">',
            f'<SourceFilename relativeToVRT="1">{name}</SourceFilename><SourceBand>{found.band}</SourceBand>',
            f'<SrcRect xOff="0" yOff="0" xSize="{pixels.held[0]}" ySize="{pixels.held[1]}"/>',
            f'<DstRect xOff="0" yOff="0" xSize="{pixels.size[0]}" ySize="{pixels.size[1]}"/>',
            f"<ScaleOffset>{-found.stretch.low * ratio!r}</ScaleOffset><ScaleRatio>{ratio!r}</ScaleRatio>",
            "</ComplexSource></VRTRasterBand>",
        ]
    return ("\n".join([*lines, "</VRTDataset>"]) + "\n").encode()
