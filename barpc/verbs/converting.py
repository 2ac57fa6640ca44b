"""`convert`: RPCs in other formats, in windows of images, and in folders of images with a proof."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from barpc.base.declarations import with_values
from barpc.base.errors import InputError, OutputError, Remark, UsageError
from barpc.base.geodesy import Box, wrap_longitude
from barpc.base.safe_io import plain_path
from barpc.base.tasks import Progress
from barpc.base.verb_options import ConvertOptions
from barpc.cameras import ImageLike, open_camera
from barpc.fit import FitOptions
from barpc.fit.points import widened
from barpc.pipeline.verify_outputs import Reading, unverified, verify, verify_grid
from barpc.rasters.dem import Dem
from barpc.rasters.raster import open_raster
from barpc.report.finished import FinishedRun
from barpc.rpcio import (
    CARRIERS,
    FORMATS,
    WRITABLE,
    find_rpc,
    format_for,
    hidden_by,
    read_rpc,
    shadows,
    sidecars,
    write_camera,
    write_crop,
    write_rpc,
)
from barpc.rpcio.formats import GRID_SUFFIX
from barpc.rpcio.grids import write_grid
from barpc.scene import Camera
from barpc.sensor.direct_grid import LINEAR, DirectGrid
from barpc.sensor.geometry import image_border
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import Sample, Scattered
from barpc.tie import read_area
from barpc.verbs.images import every, place_of
from barpc.verbs.moving import moved, refitted
from barpc.verbs.points import altitude_of, exchanged, terrain_of
from barpc.workspace import Workspace

if TYPE_CHECKING:
    from typing import Unpack

    from barpc.base.keywords import ConvertKeywords, PathLike

GroundBox = tuple[float, float, float, float]
_READ_BACK = "barpc"  # the reader of a single file


@dataclass(frozen=True, repr=False)
class Converted:
    """Files written, and how their readers read them; printed, a sentence.

    `images`: number of images; `reasons`: what needs review, empty where every reader reads the camera meant; `notes`:
    what the user should know besides; `window`: col, row, width, height [px] of the part of a single image.
    """

    paths: tuple[Path, ...]
    readings: tuple[Reading, ...]
    images: int = 1
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    window: Box | None = None
    source: Camera | None = None

    @property
    def passed(self) -> bool:
        """Whether every file holds the camera that was meant."""
        return not self.reasons

    @property
    def max_error(self) -> float:
        """Largest difference of any reader from the camera that was meant [px]; NaN where none read it."""
        return max((one.max_error for one in self.readings if not one.note), default=float("nan"))

    def __repr__(self) -> str:
        written, total = f"{self.images} image{'s' * (self.images > 1)} written", len(self.readings)
        read = [one for one in self.readings if not one.note]
        if not read:
            return f"{written}, no reader opened them."
        who = "all readers" if len(read) == total else f"{len(read)} of {total} readings"
        agree = "agree to" if all(one.passed for one in read) else "differ from the camera by up to"
        return f"{written}, {who} {agree} {self.max_error:.1g} px."


def convert(
    source: ImageLike | Iterable[ImageLike],
    target: PathLike | None = None,
    /,
    *,
    out_dir: PathLike | None = None,
    progress: Progress | None = None,
    **keywords: Unpack[ConvertKeywords],
) -> Converted:
    """Write the RPC of an image in another format, or those of many images into a folder, and read them back.

    Parameters
    ----------
    source : one or many: paths, patterns, folders, open rasterio datasets, Views, Cameras
    target : path, optional, the file for one image: its name chooses the format (`barpc convert --help`)
    out_dir : path, optional, in place of it: a new folder for images with their RPCs, each opened as its readers do
    progress : callable, optional, `progress(stage, done, total)`
    **keywords : fields of `ConvertOptions`: rpc, images, rpc_format, move, transform, window, bbox,
        aoi, alt, dem, geoid, overwrite

    Returns
    -------
    Converted, the files and how they are read: `passed`, `max_error` [px], `reasons`

    Raises
    ------
    UsageError
        Arguments that do not go together, a part that the image does not have.
    OutputError
        A file that exists, belongs to the input, or would be read in place of another RPC.
    FitError
        A grid or a moved camera that no RPC holds.

    Examples
    --------
    >>> done = barpc.convert("data_samples/view_00.tif", "view_00.RPB")
    >>> done.passed, done.max_error < 1e-9
    (True, True)
    >>> print(barpc.convert("data_samples/*.tif", out_dir="handoff"))
    3 images written, all readers agree to ...e-... px.
    """
    given, choices = every(source), with_values(ConvertOptions(), keywords, "convert")
    if (target is None) == (out_dir is None) or (target is not None and len(given) != 1):
        raise UsageError("give SOURCE and TARGET, or images and -o DIR")
    if target is not None:
        return _to_target(given[0], os.fspath(target), choices)
    assert out_dir is not None
    return _to_folder(given, Path(out_dir), choices, progress)


def _to_folder(images: list[ImageLike], folder: Path, choices: ConvertOptions, progress: Progress | None) -> Converted:
    """Write images with their RPCs, or others, moved or not, into a new folder."""
    if choices.window is not None:
        raise UsageError("--window goes with a TARGET, not with -o: images differ in where their pixels are")
    if choices.cut and choices.images is not None:
        raise UsageError("--images goes with whole images, not with --bbox or --aoi")
    carrier, words = choices.images or "vrt", choices.rpc_format or ("" if choices.cut else "txt")
    names = [name.strip() for name in words.split(",") if name.strip()]
    own = [open_camera(image) for image in images] if choices.rpc is None else []
    files = [Path(place_of(image)) for image in images]
    _refuse_source_folder(files, folder, names)
    cameras = own or _cameras(files, Path(choices.rpc or ""))
    if choices.move is not None or choices.transform is not None:
        cameras = moved(cameras, choices.move, choices.transform)
    ends = [".tif" if choices.cut else CARRIERS[carrier].suffixes[0], *(WRITABLE[name].beside for name in names)]
    shown = list(zip(files, cameras, strict=True))
    parts = windows_of(shown, _window_chooser(choices)) if choices.cut else [(*one, None) for one in shown]
    keep = [*files, *(Path(camera.path) for camera in cameras)]
    together = [file.stem + end for file, *_ in parts for end in ends]
    with Workspace(folder, overwrite=choices.overwrite, keep=keep, names=together, adds=True) as workspace:
        return _hand_off(parts, workspace, ends, progress)


# --- one file ---------------------------------------------------------------------------------------------


def _to_target(source: ImageLike, target: str, choices: ConvertOptions) -> Converted:
    """Write one RPC in another syntax, as a grid, or with a part of its image."""
    if any(one is not None for one in (choices.rpc, choices.images, choices.move, choices.transform)):
        raise UsageError("give SOURCE and TARGET, or images and -o DIR (with it: --rpc, --images, --move, --transform)")
    camera = open_camera(source)
    image = Path(place_of(source))
    if target.endswith(GRID_SUFFIX) and not choices.cut:
        check_target(target, [image, camera.path], choices.overwrite)
        return _as_grid(camera, target, choices.overwrite)
    if camera.format in ("grid", "correction"):
        camera = refitted(camera, camera.model, camera.alt_range, FitOptions(), camera.format + ", fitted")
    check_target(target, [image, camera.path], choices.overwrite, None if choices.cut else camera.rpc)
    if not choices.cut:
        return _copy(camera, image, target, choices)
    if format_for(target) is not CARRIERS["copy"]:
        ends = ", ".join(CARRIERS["copy"].suffixes)
        raise UsageError(f"{target}: a part of an image goes into a file whose name ends in {ends}")
    window = _window_chooser(choices)(camera, image)
    write_crop(camera.rpc, image, target, window, overwrite=choices.overwrite)
    return replace(_read_back(camera, camera.rpc.crop(*window[:2]), target), window=window)


def _copy(camera: Camera, image: Path, target: str, choices: ConvertOptions) -> Converted:
    """Write an RPC unchanged, and read it back."""
    if choices.rpc_format is None:
        write_camera(camera.rpc, target, image, overwrite=choices.overwrite, size=camera.size)
    else:
        write_rpc(camera.rpc, target, format=choices.rpc_format, overwrite=choices.overwrite, size=camera.size)
    return replace(_read_back(camera, camera.rpc, target), notes=camera.remarks)


def _read_back(camera: Camera, rpc: RPC, target: str) -> Converted:
    """Return the difference of an RPC when it is read back."""
    reading = Reading(Path(target), _READ_BACK, float(rpc.off(read_rpc(target)).max()))
    reason = f"{target} reads back with an error of {reading.max_error:.2g} px: another RPC file beside it?"
    return Converted((Path(target),), (reading,), reasons=() if reading.passed else (reason,), source=camera)


def _as_grid(camera: Camera, target: str, overwrite: bool) -> Converted:
    """Write a camera as a localisation grid, with the error of linear interpolation in it."""
    alts = widened(camera.alt_range)
    write_grid(DirectGrid.of(camera.model, camera.extent, alts), target, overwrite=overwrite)
    readings = verify_grid(Path(target), Scattered.over(camera.model, camera.extent, alts))
    off = [f"{one.consumer}: {one.note or one.max_error}" for one in readings if not one.max_error <= LINEAR]
    reasons = [f"{target} does not hold the camera to {LINEAR:g} px", *off] if off else []
    return Converted((Path(target),), tuple(readings), reasons=tuple(reasons))


def check_target(target: str | Path, sources: Sequence[str | Path], overwrite: bool, rpc: RPC | None = None) -> None:
    """Raise if a file to be written is an input, or would be read in place of the RPC that an image has.

    The RPC files beside the sources belong to them; none is ever replaced. With `overwrite` an image may get another
    RPC, and that is said; where it is the `rpc` that the file will hold, nothing changes for it.
    """
    target = Path(target)
    inputs = {Path(p).resolve() for s in sources for p in (s, *(sidecar.path for sidecar in sidecars(s)))}
    if os.path.lexists(target) and target.resolve() in inputs:
        raise OutputError(f"{target}: belongs to the input and is never replaced; give another name")
    text = FORMATS["txt"].write
    assert text is not None
    for _, image, now in hidden_by([target]):
        if rpc is not None and text(rpc) == text(now):
            continue
        if not overwrite:
            raise OutputError(
                f"{target}: would be read in place of the RPC that {image} has; give another folder or name, or "
                "--overwrite if that is meant"
            )
        warnings.warn(f"{target} is read in place of the RPC that {image} had", Remark, stacklevel=3)


# --- windows -----------------------------------------------------------------------------------------------


def _window_chooser(choices: ConvertOptions) -> Callable[[Camera, Path], Box]:
    """Return a function from an image to its window: the one given, or that of a box or area on the ground."""
    if sum(one is not None for one in (choices.window, choices.bbox, choices.aoi)) != 1:
        raise UsageError("give one of --window, --bbox and --aoi")
    if choices.window is not None:
        window = choices.window
        return lambda *_: window
    west, south, east, north = choices.bbox or box_of(choices.aoi or "")
    terrain = terrain_of(choices.dem, choices.geoid, choices.alt)
    return lambda camera, path: window_of(camera, path, (west, south, east, north), choices.alt, terrain)


def box_of(path: str | Path) -> GroundBox:
    """Return west, south, east, north [deg] of an area of interest; east is less than west across the antimeridian."""
    outline = read_area(path).outline  # three times, a whole turn apart
    found = [shapely.clip_by_rect(outline, west, -90.0, west + 360.0, 90.0).bounds for west in (-180.0, 0.0)]
    west, south, east, north = min(found, key=lambda bounds: bounds[2] - bounds[0])
    return west, south, float(wrap_longitude(east)), north


def window_of(camera: Camera, path: Path, bbox: GroundBox, alt: float | None, dem: Dem | None) -> Box:
    """Return the pixels that a box on the ground covers, cut to the image; a usage error where it does not meet it."""
    west, south, east, north = bbox
    east += 360.0 * (east < west)  # a box across the antimeridian
    t = (image_border((1, 1), 16) + 0.5) * [east - west, north - south] + [west, south]
    level = np.full(len(t), altitude_of(camera, path, alt)) if dem is None else dem(t[:, 0], t[:, 1])
    ground = np.column_stack([t, level])
    image = camera.model.project(ground)
    whole = np.array([np.floor(image.min(axis=0) + 0.5), np.ceil(image.max(axis=0) + 0.5)])
    low, high = np.maximum(whole[0], 0), np.minimum(whole[1], camera.extent)
    if not (np.isfinite(image).all() and (high > low).all()):
        missed = exchanged(camera, np.nan_to_num(ground)) or f"does not meet {camera.path}"
        raise UsageError(f"--bbox {bbox}: {missed} (ground at {np.median(level):g} m)")
    if (kept := float(np.prod((high - low) / (whole[1] - whole[0])))) < 1.0:
        beyond = f"{path}: --bbox reaches beyond the image; {100 * (1 - kept):.2g} % of it is cut off"
        warnings.warn(beyond, Remark, stacklevel=3)
    (col, row), (width, height) = low.astype(int).tolist(), (high - low).astype(int).tolist()
    return col, row, width, height


def windows_of(
    images: Sequence[tuple[Path, Camera]], window: Callable[[Camera, Path], Box]
) -> list[tuple[Path, Camera, Box]]:
    """Return the images that cover the requested window or area, and their windows.

    Others are named in a remark; a usage error where none covers it.
    """
    found = []
    for path, camera in images:
        try:
            found.append((path, camera, window(camera, path)))
        except UsageError as error:
            if len(images) == 1:
                raise
            warnings.warn(f"{path} is left out: {error}", Remark, stacklevel=3)
    if not found:
        raise UsageError("no image covers the area to be cut out")
    return found


# --- a folder ---------------------------------------------------------------------------------------------


def _cameras(files: Sequence[Path], rpcs: Path) -> list[Camera]:
    """Return the cameras of images in a file or a folder of RPCs, for images of that size."""
    holders = [find_rpc(rpcs, file) if rpcs.is_dir() else rpcs for file in files]
    if rpcs.is_dir():
        FinishedRun.refuse_edited(rpcs, holders, of_images=False)
    of = [open_camera(holder) for holder in holders]
    return [replace(camera, size=_image_size(file)) for camera, file in zip(of, files, strict=True)]


def _hand_off(
    images: Sequence[tuple[Path, Camera, Box | None]],
    workspace: Workspace,
    ends: Sequence[str],
    progress: Progress | None,
) -> Converted:
    """Write images, or windows of them, with their RPCs, and reopen every file as its readers do."""
    readings, reasons, notes, paths = list[Reading](), list[str](), list[str](), list[Path]()
    tell = progress or (lambda *_: None)
    for number, (path, camera, window) in enumerate(images):
        tell("convert", number, len(images))
        rpc, written = camera.rpc, [workspace.folder / (path.stem + end) for end in ends]
        size = _image_size(path) if window is None else window[2:]
        for place in written:
            with workspace.output(place.name) as partial:
                if window is not None and place is written[0]:
                    rpc = write_crop(rpc, path, partial, window, overwrite=True)
                else:
                    write_camera(rpc, partial, path, place=place, overwrite=True, size=size)
        readings += verify(written, Sample.grid(rpc, size, camera.alt_range))
        if window is None:
            reasons += _shadow_reasons(path, written)
            notes += unverified(written) if not paths else []
        paths += written
    tell("convert", len(images), len(images))
    off = [one for one in readings if not one.passed]
    reasons += [f"{r.path}: {r.consumer} {r.note or f'reads it with an error of {r.max_error:.1e} px'}." for r in off]
    return Converted(tuple(paths), tuple(readings), len(images), tuple(reasons), tuple(notes))


def _shadow_reasons(image: Path, written: Sequence[Path]) -> list[str]:
    """Return sentences on files that take precedence over the RPC of a new file; beside the image: a Remark."""
    for sidecar in shadows(image):
        hides = f"beside {image}: {sidecar.path.name} hides an RPC put into the image"
        warnings.warn(hides, Remark, stacklevel=4)
    hiding = [sidecar.path for sidecar in shadows(written[0]) if sidecar.path not in written]
    return [f"{path} hides the RPC of {written[0]}: move it away." for path in hiding]


def _image_size(image: Path) -> tuple[int, int]:
    with open_raster(image) as dataset:
        return dataset.width, dataset.height


def _refuse_source_folder(images: list[Path], folder: Path, formats: list[str]) -> None:
    for name in formats:
        if name not in WRITABLE:
            raise UsageError(f"--rpc-format {name}: not a format that is written")
    for path in (*images, folder):
        plain_path(path.absolute())
    stems = Counter(image.stem for image in images)
    if twins := sorted(stem for stem, count in stems.items() if count > 1):
        raise InputError(f"several images named {twins[0]}: apply them one folder at a time")
    if any(image.resolve().parent == folder.resolve() for image in images):
        raise InputError(f"{folder}: the folder of the images; choose a new one")
