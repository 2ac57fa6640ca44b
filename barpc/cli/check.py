"""`barpc check`: the residuals of cameras as they are."""

from __future__ import annotations

import json
from typing import Any

import click

from barpc.cli.main import EXIT_GATE
from barpc.cli.options import TIE_FLAGS, image_paths, run_options, with_flags
from barpc.cli.progress import executor_for, progress_bars


@click.command("check")
@click.argument("images", nargs=-1, required=False, metavar="IMAGE...")
@with_flags(*TIE_FLAGS)
@click.pass_obj
def command(
    obj: dict[str, Any],
    /,
    images: tuple[str, ...],
    image_list: str | None,
    options_file: str | None,
    jobs: int,
    dask: str | None,
    as_json: bool,
    **flags: Any,
) -> int:
    r"""Measure how well the cameras of overlapping images agree, without adjusting or writing anything.

    \b
    Example:
      barpc check adjusted/*.vrt
    """
    from barpc.pipeline import check

    options = run_options(flags, options_file)
    with executor_for(jobs, dask) as executor, progress_bars(obj["quiet"]) as progress:
        result = check(image_paths(images, image_list), options, executor=executor, progress=progress)
    if as_json:
        click.echo(json.dumps(result.summary, indent=1))
    elif not obj["quiet"]:
        from barpc.cli.tables import print_summary

        print_summary(result.summary)
    return 0 if result.passed else EXIT_GATE
