"""`barpc convert`: RPCs in other formats, in windows of images, and in folders of images with a proof."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import click

from barpc.cli.project import with_heights
from barpc.cli.terminal import progress_told, remark, tell, tell_gate, wants_json
from barpc.pipeline.verify_outputs import Reading
from barpc.rpcio import WRITABLE
from barpc.scene import Camera
from barpc.verbs import converting
from barpc.verbs.converting import Converted


def read_move(_: click.Context, __: click.Parameter, text: str | None) -> list[float] | None:
    """Return the three numbers of --move, metres east, north and up."""
    if text is None:
        return None
    try:
        east, north, up = (float(word) for word in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not three numbers E,N,U [m] with commas between") from None
    return [east, north, up]


@click.command("convert")
@click.argument("files", nargs=-1, required=True, metavar="SOURCE... [TARGET]")
@click.option("-o", "--out-dir", metavar="DIR", help="New folder for images of the same names, with proof.")
@click.option("--rpc", "rpc", metavar="PATH", help="With -o: an RPC file, or a folder of them by image name.")
@click.option("--images", "images", type=click.Choice(["vrt", "copy"]), help="With -o.  [default: vrt]")
@click.option(
    "--rpc-format",
    "rpc_format",
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
@click.pass_obj
def convert(obj: dict[str, Any], /, files: tuple[str, ...], out_dir: str | None, **flags: Any) -> int:
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
    if out_dir is None and len(files) != 2:
        raise click.UsageError("give SOURCE and TARGET, or images and -o DIR")
    source, target = (files[:1], files[1]) if out_dir is None else (files, None)
    with progress_told(obj["quiet"], obj["verbose"]) as progress:
        done = converting.convert(source, target, out_dir=out_dir, progress=progress, **flags)
    if done.source is not None:
        _tell_file(done, done.source)
    else:
        _tell_readings(done.readings)
    for line in () if wants_json() and target else done.notes:
        remark(line)
    reasons = ["The hand-off needs review."] * (target is None) + [*done.reasons]
    code = tell_gate(reasons[0], reasons[1:]) if done.reasons else 0
    if target is None and not wants_json():
        tell(done)
    return code


def _tell_file(done: Converted, source: Camera) -> None:
    """Print one file with the difference of its RPC when it is read back."""
    (target,) = map(str, done.paths)
    row: dict[str, Any] = {"source": str(source.path), "format": source.format, "target": target}
    text = f"{source.path} ({source.format}) -> {target}"
    if done.window is not None:
        row, text = (
            {"path": target, "window": done.window},
            "{}: col {}, row {}, {} x {} px".format(target, *done.window),
        )
    lost = done.readings[0].max_error
    tell(json.dumps({**row, "max_px": lost}) if wants_json() else f"{text} (read back: {lost:.1g} px)")


def _tell_readings(readings: Sequence[Reading]) -> None:
    rows = [(str(r.path), r.consumer, None if r.note else r.max_error, r.note) for r in readings]
    if wants_json():
        keys = ("path", "consumer", "max_px", "note")
        tell(json.dumps([dict(zip(keys, row, strict=True)) for row in rows]))
        return
    for path, consumer, error, note in rows:
        tell(f"{path}: {consumer} {note or f'{error:.1e} px'}")
