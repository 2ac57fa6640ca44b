"""`barpc match`: tie points only."""

from __future__ import annotations

import json
from typing import Any

import click

from barpc.cli.main import EXIT_GATE
from barpc.cli.options import MATCH_FLAGS, TIE_FLAGS, image_paths, run_options, with_flags
from barpc.cli.progress import executor_for, progress_bars


@click.command("match")
@click.argument("images", nargs=-1, required=False, metavar="IMAGE...")
@click.option("-o", "--out-dir", required=True, metavar="DIR", help="Folder for the results.")
@with_flags(*MATCH_FLAGS, *TIE_FLAGS)
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
    r"""Match tie points and stop: matches.csv and matches.npz, for `barpc adjust --matches` and other tools.

    \b
    Examples:
      barpc match scene/*.tif -o ties
      barpc adjust scene/*.tif --matches ties/matches.npz -o adjusted
    """
    from dataclasses import replace

    from barpc.pipeline import adjust

    options = replace(run_options(flags, options_file), stop_after="matching")
    with executor_for(jobs, dask) as executor, progress_bars(obj["quiet"]) as progress:
        paths = image_paths(images, image_list)
        result = adjust(paths, out_dir, options, executor=executor, progress=progress)
    if as_json:
        click.echo(json.dumps(result.summary, indent=1))
    elif not obj["quiet"]:
        from barpc.cli.tables import print_summary

        print_summary(result.summary)
    return 0 if result.passed else EXIT_GATE
