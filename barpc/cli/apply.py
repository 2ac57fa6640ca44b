"""`barpc apply`: give images the RPCs that belong to them, in a new folder, and prove that tools read them."""

from __future__ import annotations

import json
from pathlib import Path

import click

from barpc.cameras import open_camera
from barpc.cli.points import as_json
from barpc.cli.terminal import echo, say, tell_gate
from barpc.errors import InputError
from barpc.handoff import Reading, refuse_hiding, verify
from barpc.plain import plain_path
from barpc.raster import open_raster
from barpc.rpcio import FORMATS, rpc_vrt, shadows, write_rpc, write_rpc_copy
from barpc.sensor.geometry import altitude_range
from barpc.sensor.rpc import RPC
from barpc.workspace import Workspace

_ENDS = [*dict.fromkeys(s for row in FORMATS.values() for s in row.suffixes), ".vrt", ".tif"]


@click.command("apply")
@click.argument("images", nargs=-1, required=True, metavar="IMAGE...")
@click.option(
    "--rpc", "rpcs", required=True, metavar="PATH", help="An RPC file, or a folder of them by image name."
)
@click.option("-o", "--out-dir", required=True, metavar="DIR", help="New folder.")
@click.option("--images", "carrier", type=click.Choice(["vrt", "copy"]), default="vrt", show_default=True)
@click.option(
    "--rpc-format", default="txt", show_default=True, help="Files to write beside: txt,rpb,geom,xml,json."
)
@click.option("--overwrite", is_flag=True, help="Replace files of an earlier run.")
@as_json
def command(
    images: tuple[str, ...],
    rpcs: str,
    out_dir: str,
    carrier: str,
    rpc_format: str,
    overwrite: bool,
    as_json: bool,
) -> int:
    r"""Write images with other RPCs into a new folder, then open every file as GDAL, rpcm and others do.

    The images themselves stay as they are; a vendor's file beside one, which would hide an RPC put into it,
    is named.

    \b
    Example:
      barpc apply scene/*.tif --rpc adjusted -o handoff
    """
    folder = Path(out_dir)
    formats = [name.strip() for name in rpc_format.split(",") if name.strip()]
    _check(images, folder, formats)
    sources = [_rpc_file(Path(rpcs), Path(image)) for image in images]
    names = [_names(Path(image), carrier, formats) for image in images]
    together = [name for row in names for name in row]
    inputs = [*map(Path, images), *sources]
    refuse_hiding(folder, together, inputs)
    readings: list[Reading] = []
    reasons: list[str] = []
    with Workspace(folder, overwrite=overwrite, keep=inputs, names=together, adds=True) as workspace:
        for image, source, row in zip(images, sources, names, strict=True):
            rpc = open_camera(str(source)).rpc
            _write(workspace, Path(image), rpc, row, formats)
            written = [folder / name for name in row]
            readings += verify(written, rpc, _size(image), altitude_range(rpc))
            reasons += _shadow_reasons(image, written)
    if as_json:
        rows = [
            {
                "path": str(r.path),
                "consumer": r.consumer,
                "max_px": None if r.note else r.max_error,
                "note": r.note,
            }
            for r in readings
        ]
        echo(json.dumps(rows))
    else:
        for reading in readings:
            echo(f"{reading.path}: {reading.consumer} {reading.note or f'{reading.max_error:.1e} px'}")
    reasons += [
        f"{r.path}: {r.consumer} {r.note or f'reads it {r.max_error:.1e} px off'}."
        for r in readings
        if not r.passed
    ]
    return tell_gate("The hand-off needs a look.", reasons) if reasons else 0


def _shadow_reasons(image: str, written: list[Path]) -> list[str]:
    """What lies beside a new file and hides its RPC; what lies beside the image is only said."""
    for sidecar in shadows(image):
        say(f"beside {image}: {sidecar.path.name} hides an RPC put into the image")
    return [
        f"{sidecar.path} hides the RPC of {written[0]}: move it away."
        for sidecar in shadows(written[0])
        if sidecar.path not in written
    ]


def _size(image: str) -> tuple[int, int]:
    """Width and height of an image [px]."""
    with open_raster(image) as dataset:
        return dataset.width, dataset.height


def _check(images: tuple[str, ...], folder: Path, formats: list[str]) -> None:
    for name in formats:
        if name not in FORMATS or FORMATS[name].write is None:
            raise click.UsageError(f"--rpc-format {name}: not a format that is written")
    for path in (*map(Path, images), folder):
        plain_path(path.absolute())
    stems = [Path(image).stem for image in images]
    twins = sorted({stem for stem in stems if stems.count(stem) > 1})
    if twins:
        raise InputError(f"several images named {twins[0]}: apply them one folder at a time")
    if any(Path(image).resolve().parent == folder.resolve() for image in images):
        raise InputError(f"{folder}: the folder of the images; choose a new one")


def _rpc_file(rpcs: Path, image: Path) -> Path:
    if not rpcs.is_dir():
        return rpcs
    present = {entry.name.lower(): entry for entry in rpcs.iterdir()}
    for end in _ENDS:
        found = present.get(f"{image.stem}{end}".lower())
        if found is not None:
            return found
    raise InputError(
        f"{rpcs}: no RPC of {image.name} there (looked for {image.stem}_RPC.TXT, .RPB, .geom, .vrt, ...)"
    )


def _names(image: Path, carrier: str, formats: list[str]) -> list[str]:
    """What is written for an image: the raster, then a file for each format."""
    ends = [".vrt" if carrier == "vrt" else ".tif", *(FORMATS[name].suffixes[0] for name in formats)]
    return [image.stem + end for end in ends]


def _write(workspace: Workspace, image: Path, rpc: RPC, names: list[str], formats: list[str]) -> None:
    raster, *files = names
    with workspace.output(raster) as partial:
        if raster.endswith(".vrt"):
            partial.write_text(rpc_vrt(rpc, image, workspace.folder / raster), encoding="utf-8")
        else:
            write_rpc_copy(rpc, image, partial, overwrite=True)
    for name, format in zip(files, formats, strict=True):
        with workspace.output(name) as partial:
            write_rpc(rpc, partial, format=format, overwrite=True)
