"""`barpc adjust`: the main job."""

from __future__ import annotations

import json
from typing import Any

import click

from barpc.cli.main import EXIT_GATE
from barpc.cli.options import ADJUSTMENT_FLAGS, RUN_FLAGS, TIE_FLAGS, image_paths, run_options, with_flags
from barpc.cli.progress import executor_for, progress_bars


@click.command("adjust")
@click.argument("images", nargs=-1, required=False, metavar="IMAGE...")
@click.option("-o", "--out-dir", required=True, metavar="DIR", help="Folder for the results.")
@with_flags(*RUN_FLAGS, *TIE_FLAGS, *ADJUSTMENT_FLAGS)
@click.pass_obj
def command(
    obj: dict[str, Any],
    /,
    images: tuple[str, ...],
    out_dir: str,
    image_list: str | None,
    options_file: str | None,
    jobs: int,
    dask: str | None,
    as_json: bool,
    **flags: Any,
) -> int:
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

    options = run_options(flags, options_file)
    with executor_for(jobs, dask) as executor, progress_bars(obj["quiet"]) as progress:
        paths = image_paths(images, image_list)
        result = adjust(paths, out_dir, options, executor=executor, progress=progress)
    if as_json:
        click.echo(json.dumps(result.summary, indent=1))
    elif not obj["quiet"]:
        from barpc.cli.tables import print_summary

        print_summary(result.summary)
    return 0 if result.passed else EXIT_GATE
