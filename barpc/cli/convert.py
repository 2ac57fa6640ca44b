"""`barpc convert`: RPCs in other formats, in windows of images, and in folders of images with a proof."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import shapely

from barpc.base.errors import InputError, OutputError
from barpc.base.safe_io import plain_path
from barpc.cameras import open_camera, split_spec
from barpc.cli.flags import expanded
from barpc.cli.moving import moved, read_move, refitted
from barpc.cli.project import altitude_of, exchanged, with_heights
from barpc.cli.terminal import remark, tell, tell_gate, wants_json
from barpc.fit import FitOptions
from barpc.fit.points import Sample, widened
from barpc.pipeline.verify_outputs import READING_TOLERANCE, Reading, unverified, verify, verify_grid
from barpc.rasters.dem import Dem
from barpc.rasters.raster import open_raster
from barpc.report.summary.words import counted
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
from barpc.rpcio.grids import GRID_SUFFIX, write_grid
from barpc.scene import Camera
from barpc.sensor.direct_grid import LINEAR, DirectGrid
from barpc.sensor.geometry import image_border
from barpc.sensor.rpc import RPC
from barpc.tie import read_area
from barpc.workspace import Workspace

Window = tuple[int, int, int, int]
GroundBox = tuple[float, float, float, float]


@click.command("convert")
@click.argument("files", nargs=-1, required=True, metavar="SOURCE... [TARGET]")
@click.option("-o", "--out-dir", metavar="DIR", help="New folder for images of the same names, with proof.")
@click.option("--rpc", "rpcs", metavar="PATH", help="With -o: an RPC file, or a folder of them by image name.")
@click.option("--images", "carrier", type=click.Choice(["vrt", "copy"]), help="With -o.  [default: vrt]")
@click.option(
    "--rpc-format",
    "formats",
    metavar="NAMES",
    help=f"Of {', '.join(f'{name} ({row.suffixes[0]})' for name, row in WRITABLE.items())}."
    "  [default: TARGET's name; txt]",
)
@click.option(
    "--move",
    callback=read_move,
    metavar="E,N,U",
    help="With -o: shift the ground by metres east, north, up, from its position by the cameras to the true one.",
)
@click.option(
    "--transform",
    metavar="FILE",
    help="With -o: the same by a 4 x 4 (or 3 x 4) matrix of ECEF coordinates, as pc_align writes it.",
)
@click.option("--window", type=(int, int, int, int), help="Cut out COL ROW WIDTH HEIGHT [px].")
@click.option(
    "--bbox",
    type=(float, float, float, float),
    help="Cut out WEST SOUTH EAST NORTH [deg]; with -o of every image that covers it.",
)
@click.option("--aoi", metavar="FILE", help="Cut out the box around polygons in lon/lat (GeoJSON), as --bbox.")
@with_heights("Altitude of the ground of --bbox [m].  [default: of the run's tie points, else the camera's middle]")
@click.option("--overwrite", is_flag=True, help="Replace an existing file, or files of an earlier run.")
def convert(files: tuple[str, ...], out_dir: str | None, **flags: Any) -> int:
    r"""Write the RPC of SOURCE to TARGET, whose name chooses the format, or those of many images to a folder.

    TARGET ends as --rpc-format says (xml is Maxar's, json rpcm's); .vrt, .tif and .ntf carry the image, too;
    _grid.tif is a localisation grid. A SOURCE that is a grid goes into an RPC where one holds it. With --window,
    --bbox or --aoi the .tif or .ntf is a part of the image, with the RPC of exactly that part. With -o images get
    their RPCs, or those of --rpc, in a new folder; every file is then opened as GDAL, rpcm and others do, and what
    lies beside an image and would hide an RPC put into it is named. Images stay as they are. --move and --transform
    bring an alignment of a DEM or a point cloud back into the cameras that it was made with.

    \b
    Examples:
      barpc convert RPC_PHR1A.XML image_RPC.TXT
      barpc convert image.tif,camera=vendor.XML with_rpc.vrt
      barpc convert image.tif part.tif --bbox 5.43 43.25 5.44 43.26 --alt 180
      barpc convert scene/*.tif --rpc adjusted -o crops --bbox 5.43 43.25 5.44 43.26
      barpc convert scene/*.tif --rpc adjusted -o handoff
      barpc convert scene/*.tif --rpc adjusted -o aligned --transform run-transform.txt
    """
    if flags["move"] is not None and flags["transform"] is not None:
        raise click.UsageError("give either --move or --transform")
    return _to_target(files, flags) if out_dir is None else _to_folder(files, Path(out_dir), flags)


def _to_folder(files: tuple[str, ...], folder: Path, flags: Mapping[str, Any]) -> int:
    """Write images with their RPCs, or those of --rpc, moved or not, into a new folder."""
    if flags["window"] is not None:
        raise click.UsageError("--window goes with a TARGET, not with -o: images differ in where their pixels are")
    cut = flags["bbox"] is not None or flags["aoi"] is not None
    if cut and flags["carrier"] is not None:
        raise click.UsageError("--images goes with whole images, not with --bbox or --aoi")
    carrier: str = flags["carrier"] or "vrt"
    names = [name.strip() for name in (flags["formats"] or ("" if cut else "txt")).split(",") if name.strip()]
    images = tuple(expanded(files))
    files_of = [Path(split_spec(image)[0]) for image in images]
    _refuse_source_folder(files_of, folder, names)
    cameras = _cameras(images, flags["rpcs"])
    if flags["move"] is not None or flags["transform"] is not None:
        cameras = moved(cameras, flags["move"], flags["transform"], carrier)
    ends = [".tif" if cut else CARRIERS[carrier].suffixes[0], *(WRITABLE[name].beside for name in names)]
    shown = list(zip(files_of, cameras, strict=True))
    keep = [*files_of, *(Path(camera.path) for camera in cameras)]
    parts = windows_of(shown, _window_chooser(flags)) if cut else [(file, camera, None) for file, camera in shown]
    return _hand_off(parts, folder, ends, keep, flags["overwrite"])


# --- one file ---------------------------------------------------------------------------------------------


def _to_target(files: tuple[str, ...], flags: Mapping[str, Any]) -> int:
    """Write one RPC in another syntax, as a grid, or with a part of its image."""
    overwrite: bool = flags["overwrite"]
    if len(files) != 2 or any(flags[name] is not None for name in ("rpcs", "carrier", "move", "transform")):
        with_it = "--rpc, --images, --move, --transform"
        raise click.UsageError(f"give SOURCE and TARGET, or images and -o DIR (with it: {with_it})")
    source, target = files
    camera, image = open_camera(source), Path(split_spec(source)[0])
    cut = any(flags[name] is not None for name in ("window", "bbox", "aoi"))
    if target.endswith(GRID_SUFFIX) and not cut:
        check_target(target, [image, camera.path], overwrite)
        return _as_grid(camera, target, overwrite)
    if camera.format in ("grid", "correction"):
        camera = refitted(camera, camera.model, camera.alt_range, FitOptions(), camera.format + ", fitted")
    check_target(target, [image, camera.path], overwrite, None if cut else camera.rpc)
    if not cut:
        return _copy(camera, image, target, flags["formats"], overwrite)
    if format_for(target) not in (CARRIERS["copy"], CARRIERS["nitf"]):
        ends = ", ".join((*CARRIERS["copy"].suffixes, *CARRIERS["nitf"].suffixes))
        raise click.UsageError(f"{target}: a part of an image goes into a file whose name ends in {ends}")
    window = _window_chooser(flags)(camera, image)
    write_crop(camera.rpc, image, target, window, overwrite=overwrite)
    text = f"{target}: col {window[0]}, row {window[1]}, {window[2]} x {window[3]} px"
    return _read_back(camera.rpc.crop(*window[:2]), target, {"path": target, "window": window}, text)


def _copy(camera: Camera, image: Path, target: str, formats: str | None, overwrite: bool) -> int:
    """Write an RPC unchanged, read it back and report the largest difference."""
    if formats is None:
        write_camera(camera.rpc, target, image, overwrite=overwrite, size=camera.size)
    else:
        write_rpc(camera.rpc, target, format=formats, overwrite=overwrite, size=camera.size)
    for line in () if wants_json() else camera.notes:
        remark(line)
    row = {"source": str(camera.path), "format": camera.format, "target": target}
    return _read_back(camera.rpc, target, row, f"{camera.path} ({camera.format}) -> {target}")


def _read_back(rpc: RPC, target: str, row: Mapping[str, object], text: str) -> int:
    """Report the files written, and the difference of an RPC when it is read back; the exit code."""
    lost = float(rpc.off(read_rpc(target)).max())
    tell(json.dumps({**row, "max_px": lost}) if wants_json() else f"{text} (read back: {lost:.1g} px)")
    if lost <= READING_TOLERANCE:
        return 0
    return tell_gate(
        f"{target} reads back with an error of {lost:.2g} px: too few digits for this RPC ('barpc fit' makes another), "
        "or another RPC file beside it",
        [],
    )


def _as_grid(camera: Camera, target: str, overwrite: bool) -> int:
    """Write a camera as a localisation grid, and report the error of linear interpolation in it."""
    alts = widened(camera.alt_range)
    write_grid(DirectGrid.of(camera.model, camera.extent, alts), target, overwrite=overwrite)
    readings = verify_grid(Path(target), Sample.of(camera.model, camera.extent, alts))
    _tell_readings(readings)
    off = [f"{one.consumer}: {one.note or one.max_error}" for one in readings if not one.max_error <= LINEAR]
    return tell_gate(f"{target} does not hold the camera to {LINEAR:g} px", off) if off else 0


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
        remark(f"{target} is read in place of the RPC that {image} had")


# --- windows -----------------------------------------------------------------------------------------------


def _window_chooser(flags: Mapping[str, Any]) -> Callable[[Camera, Path], Window]:
    """Return a function from an image to its window: the one given, or that of a box or area on the ground."""
    if sum(flags[name] is not None for name in ("window", "bbox", "aoi")) != 1:
        raise click.UsageError("give one of --window, --bbox and --aoi")
    window: Window | None = flags["window"]
    if window is not None:
        return lambda *_: window
    bbox = box_of(flags["aoi"]) if flags["aoi"] else flags["bbox"]
    return lambda camera, path: window_of(camera, path, bbox, flags["alt"], flags["terrain"])


def box_of(path: str) -> GroundBox:
    """Return west, south, east, north [deg] of an area of interest; east is less than west across the antimeridian."""
    outline = read_area(path).outline  # three times, a whole turn apart
    found = [shapely.clip_by_rect(outline, west, -90.0, west + 360.0, 90.0).bounds for west in (-180.0, 0.0)]
    west, south, east, north = min(found, key=lambda bounds: bounds[2] - bounds[0])
    return west, south, east - 360.0 * (east > 180.0), north


def window_of(camera: Camera, path: Path, bbox: GroundBox, alt: float | None, dem: Dem | None) -> Window:
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
        raise click.UsageError(f"--bbox {bbox}: {missed} (ground at {np.median(level):g} m)")
    if (kept := float(np.prod((high - low) / (whole[1] - whole[0])))) < 1.0:
        remark(f"{path}: --bbox reaches beyond the image; {100 * (1 - kept):.2g} % of it is cut off")
    (col, row), (width, height) = low.astype(int).tolist(), (high - low).astype(int).tolist()
    return col, row, width, height


def windows_of(
    images: Sequence[tuple[Path, Camera]], window: Callable[[Camera, Path], Window]
) -> list[tuple[Path, Camera, Window]]:
    """Return the images that cover the requested window or area, and their windows.

    Others are named in a remark; a usage error where none covers it.
    """
    found = []
    for path, camera in images:
        try:
            found.append((path, camera, window(camera, path)))
        except click.UsageError as error:
            if len(images) == 1:
                raise
            remark(f"{path} is left out: {error.message}")
    if not found:
        raise click.UsageError("no image covers the area to be cut out")
    return found


# --- a folder ---------------------------------------------------------------------------------------------


def _cameras(images: Sequence[str], rpcs: str | None) -> list[Camera]:
    """Return the cameras of images: their own, or those of a file or a folder of RPCs, for images of that size."""
    if rpcs is None:
        return [open_camera(image) for image in images]
    cameras = []
    for file in (Path(split_spec(image)[0]) for image in images):
        camera = open_camera(str(find_rpc(Path(rpcs), file)) if Path(rpcs).is_dir() else rpcs)
        cameras.append(replace(camera, size=_image_size(file)))
    return cameras


def _hand_off(
    images: Sequence[tuple[Path, Camera, Window | None]],
    folder: Path,
    ends: Sequence[str],
    keep: Sequence[Path],
    overwrite: bool,
) -> int:
    """Write images, or windows of them, with their RPCs, reopen every file as its readers do, and report the errors."""
    names = [[path.stem + end for end in ends] for path, *_ in images]
    together = [name for row in names for name in row]
    readings: list[Reading] = []
    reasons: list[str] = []
    with Workspace(folder, overwrite=overwrite, keep=keep, names=together, adds=True) as workspace:
        for (path, camera, window), row in zip(images, names, strict=True):
            rpc, written = camera.rpc, [folder / name for name in row]
            size = _image_size(path) if window is None else window[2:]
            for name in row:
                with workspace.output(name) as partial:
                    if window is not None and name == row[0]:
                        rpc = write_crop(rpc, path, partial, window, overwrite=True)
                    else:
                        write_camera(rpc, partial, path, place=folder / name, overwrite=True, size=size)
            readings += verify(written, rpc, size, camera.alt_range)
            reasons += _shadow_reasons(path, written) if window is None else []
    whole = images[0][2] is None
    code = _exit_code(readings, reasons, unverified([folder / name for name in names[0]]) if whole else ())
    if not wants_json():
        tell(_readers_agreement(len(images), readings))
    return code


def _readers_agreement(num: int, readings: Sequence[Reading]) -> str:
    """Return the number of images written and the largest difference of their readers, in a sentence."""
    read = [reading for reading in readings if not reading.note]
    written, total = f"{counted(num, 'image')} written", len(readings)
    if not read:
        return f"{written}, no reader opened them."
    worst = max(reading.max_error for reading in read)
    who = "all readers" if len(read) == total else f"{len(read)} of {total} readings"
    agree = "agree to" if all(reading.passed for reading in read) else "differ from the camera by up to"
    return f"{written}, {who} {agree} {worst:.1g} px."


def _image_size(image: Path) -> tuple[int, int]:
    with open_raster(image) as dataset:
        return dataset.width, dataset.height


def _exit_code(readings: list[Reading], reasons: Sequence[str] = (), notes: Sequence[str] = ()) -> int:
    """Report the errors of the reopened files; return the exit code."""
    _tell_readings(readings)
    for sentence in notes:
        remark(sentence)
    off = [reading for reading in readings if not reading.passed]
    wrong = (f"{r.path}: {r.consumer} {r.note or f'reads it with an error of {r.max_error:.1e} px'}." for r in off)
    reasons = [*reasons, *wrong]
    return tell_gate("The hand-off needs review.", reasons) if reasons else 0


def _tell_readings(readings: list[Reading]) -> None:
    rows = [(str(r.path), r.consumer, None if r.note else r.max_error, r.note) for r in readings]
    if wants_json():
        keys = ("path", "consumer", "max_px", "note")
        tell(json.dumps([dict(zip(keys, row, strict=True)) for row in rows]))
        return
    for path, consumer, error, note in rows:
        tell(f"{path}: {consumer} {note or f'{error:.1e} px'}")


def _shadow_reasons(image: Path, written: list[Path]) -> list[str]:
    """Return sentences on files that take precedence over the RPC of a new file; beside the image: a remark."""
    for sidecar in shadows(image):
        remark(f"beside {image}: {sidecar.path.name} hides an RPC put into the image")
    hiding = [sidecar.path for sidecar in shadows(written[0]) if sidecar.path not in written]
    return [f"{path} hides the RPC of {written[0]}: move it away." for path in hiding]


def _refuse_source_folder(images: list[Path], folder: Path, formats: list[str]) -> None:
    for name in formats:
        if name not in WRITABLE:
            raise click.UsageError(f"--rpc-format {name}: not a format that is written")
    for path in (*images, folder):
        plain_path(path.absolute())
    stems = Counter(image.stem for image in images)
    if twins := sorted(stem for stem, count in stems.items() if count > 1):
        raise InputError(f"several images named {twins[0]}: apply them one folder at a time")
    if any(image.resolve().parent == folder.resolve() for image in images):
        raise InputError(f"{folder}: the folder of the images; choose a new one")
