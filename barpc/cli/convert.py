"""`barpc convert`: an RPC from one format into another."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import click

from barpc.cameras import open_camera
from barpc.cli.points import as_json, check_target
from barpc.cli.terminal import echo, say
from barpc.rpcio import FORMATS, write_rpc, write_rpc_copy, write_rpc_nitf, write_rpc_vrt

_RASTERS: dict[str, Callable[..., None]] = {
    ".vrt": write_rpc_vrt,
    ".tif": write_rpc_copy,
    ".tiff": write_rpc_copy,
    ".ntf": write_rpc_nitf,
}
_WRITABLE = [name for name, row in FORMATS.items() if row.write is not None]


@click.command("convert")
@click.argument("source")
@click.argument("target")
@click.option("--format", "name", type=click.Choice(_WRITABLE), help="Whatever the target's name says.")
@click.option("--image", metavar="FILE", help="Pixels of a .vrt, .tif or .ntf.  [default: SOURCE]")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@as_json
def command(
    source: str,
    target: str,
    name: str | None,
    image: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    r"""Write the RPC of SOURCE (an image or an RPC file) to TARGET; its name chooses the format.

    _RPC.TXT, .RPB, .geom, .XML (Maxar), .json (rpcm); .vrt, .tif and .ntf carry an image, too.

    \b
    Examples:
      barpc convert RPC_PHR1A.XML image_RPC.TXT
      barpc convert vendor.XML with_rpc.vrt --image image.tif
    """
    camera = open_camera(source)
    check_target(target, [source, *([image] if image else [])], overwrite, camera.rpc)
    writer = _RASTERS.get(Path(target).suffix.lower()) if name is None else None
    if writer is not None:
        writer(camera.rpc, image or source, target, overwrite=overwrite)
    else:
        write_rpc(camera.rpc, target, format=name, overwrite=overwrite)
    if as_json:
        echo(json.dumps({"source": str(camera.path), "format": camera.format, "target": target}))
    else:
        echo(f"{camera.path} ({camera.format}) -> {target}")
        for note in camera.notes:
            say(note)
