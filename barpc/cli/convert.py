"""`barpc convert`: RPCs in other formats, in windows of images, and in folders of images with a proof."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import click

from barpc.base.verb_options import ConvertOptions
from barpc.cli.flags import flags_of, given_flags
from barpc.cli.terminal import at_work, remark, tell, tell_gate, wants_json
from barpc.pipeline.verify_outputs import Reading
from barpc.rpcio import WRITABLE
from barpc.scene import Camera
from barpc.verbs import converting
from barpc.verbs.converting import Converted

_FORMAT_NAMES = ", ".join(f"{name} ({row.suffixes[0]})" for name, row in WRITABLE.items())


@click.command("convert")
@click.argument("files", nargs=-1, required=True, metavar="SOURCE... [TARGET]")
@click.option("-o", "--out-dir", "--output", metavar="DIR", help="New folder for images of the same names, with proof.")
@flags_of(ConvertOptions, rpc_format=f"Of {_FORMAT_NAMES}. Without: that of TARGET's name; in a folder txt.")
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
    if out_dir is None and len(files) != 2:
        raise click.UsageError("give SOURCE and TARGET, or images and -o DIR")
    source, target = (files[:1], files[1]) if out_dir is None else (files, None)
    with at_work() as progress:
        done = converting.convert(source, target, out_dir=out_dir, progress=progress, **given_flags(flags))
    if done.source is not None:
        _tell_file(done, done.source)
    else:
        _tell_readings(done.readings)
    for line in () if wants_json() and target else done.notes:
        remark(line)
    reasons = ["The hand-off needs review."] * (target is None) + [*done.reasons]
    code = tell_gate(reasons[0], reasons[1:]) if done.reasons else 0
    if target is None and not wants_json():
        tell(None, done)
    return code


def _tell_file(done: Converted, source: Camera) -> None:
    """Print one file with the difference of its RPC when it is read back."""
    (target,), lost = map(str, done.paths), done.readings[0].max_error
    row: dict[str, Any] = {"source": str(source.path), "format": source.format, "target": target}
    text = f"{source.path} ({source.format}) -> {target}"
    if done.window is not None:
        row = {"path": target, "window": done.window}
        text = "{}: col {}, row {}, {} x {} px".format(target, *done.window)
    tell({**row, "max_px": lost}, f"{text} (read back: {lost:.1g} px)")


def _tell_readings(readings: Sequence[Reading]) -> None:
    rows = [(str(r.path), r.consumer, None if r.note else r.max_error, r.note) for r in readings]
    tell(
        [dict(zip(("path", "consumer", "max_px", "note"), row, strict=True)) for row in rows],
        *(f"{path}: {consumer} {note or f'{error:.1e} px'}" for path, consumer, error, note in rows),
    )
