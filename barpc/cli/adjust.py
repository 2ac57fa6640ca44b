"""`barpc adjust`: the main job."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from barpc.cli.options import ADJUSTMENT_FLAGS, RUN_FLAGS, TIE_FLAGS, with_flags
from barpc.cli.runs import run

if TYPE_CHECKING:
    from barpc.pipeline import AdjustResult, RunOptions


@click.command("adjust")
@click.argument("images", nargs=-1, required=False, metavar="IMAGE...")
@click.option("-o", "--out-dir", required=True, metavar="DIR", help="Folder for the results.")
@with_flags(*RUN_FLAGS, *TIE_FLAGS, *ADJUSTMENT_FLAGS)
@click.pass_obj
def command(obj: dict[str, Any], /, images: tuple[str, ...], out_dir: str, **flags: Any) -> int:
    r"""Correct the cameras of overlapping images and write fresh RPCs.

    Tie points are matched across the images, a bundle adjustment estimates a rotation and a translation of
    each camera, and the corrected cameras are fitted into new RPCs, written as a VRT (which points at the
    untouched image) and an _RPC.TXT file an image.

    \b
    Examples:
      barpc adjust scene/*.tif -o adjusted
      barpc adjust a.tif b.tif --gcp points.gcp --dem srtm.tif --geoid egm96.gtx -o adjusted
      barpc adjust --image-list images.txt -j 8 --keep-going -o adjusted
    """
    from barpc.pipeline import adjust

    def work(paths: list[str], options: RunOptions, **workers: Any) -> AdjustResult:
        return adjust(paths, out_dir, options, **workers)

    return run(obj, work, images, flags)
