"""`barpc check`: the residuals of cameras as they are, or how far they lie from others."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from barpc.cli.options import TIE_FLAGS, image_paths, with_flags
from barpc.cli.runs import run
from barpc.cli.terminal import echo, tell_gate


@click.command("check")
@click.argument("images", nargs=-1, required=False, metavar="IMAGE...")
@click.option("--against", metavar="PATH", help="Compare with this RPC (one image), or those of this folder.")
@with_flags(*TIE_FLAGS)
@click.pass_obj
def command(obj: dict[str, Any], /, images: tuple[str, ...], against: str | None, **flags: Any) -> int:
    r"""Measure how well the cameras of overlapping images agree, without adjusting or writing anything.

    With --against, no tie points are matched: each image's RPC is compared with another one over the image and
    its altitudes; exit 3 where one differs by more than a millionth of a pixel.

    \b
    Examples:
      barpc check adjusted/*.vrt
      barpc check adjusted/*.vrt --against delivered/
    """
    if against is not None:
        return _compare(image_paths(images, flags["image_list"]), Path(against), flags["as_json"])
    from barpc.pipeline import check

    return run(obj, check, images, flags)


def _compare(images: list[str], against: Path, as_json: bool) -> int:
    from barpc.cameras import open_camera
    from barpc.handoff import TOLERANCE, difference
    from barpc.pipeline import load_views
    from barpc.rpcio import find_rpc

    views = load_views(images, min_views=1, distinct=False).views
    found = {}
    for view in views:
        other = find_rpc(against, Path(view.path)) if against.is_dir() else against
        found[view.path] = (
            str(other),
            difference(view.sensor, open_camera(other).model, view.size, view.alt_range),
        )
    if as_json:
        entries = [{"image": a, "against": b, "max_px": px} for a, (b, px) in found.items()]
        echo(json.dumps(entries, indent=1))
    else:
        for path, (compared, px) in found.items():
            echo(f"{path}  {compared}  max {px:.3g} px")
    off = [f"{path}: {px:.3g} px." for path, (_, px) in found.items() if not px <= TOLERANCE]
    return tell_gate(f"{len(off)} of {len(found)} RPCs differ.", off) if off else 0
