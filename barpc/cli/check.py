"""`barpc check`: the residuals of cameras as they are."""

from __future__ import annotations

from typing import Any

import click

from barpc.cli.options import TIE_FLAGS, with_flags
from barpc.cli.runs import run


@click.command("check")
@click.argument("images", nargs=-1, required=False, metavar="IMAGE...")
@with_flags(*TIE_FLAGS)
@click.pass_obj
def command(obj: dict[str, Any], /, images: tuple[str, ...], **flags: Any) -> int:
    r"""Measure how well the cameras of overlapping images agree, without adjusting or writing anything.

    \b
    Example:
      barpc check adjusted/*.vrt
    """
    from barpc.pipeline import check

    return run(obj, check, images, flags)
