"""`barpc match`: tie points only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from barpc.cli.options import MATCH_FLAGS, TIE_FLAGS, with_flags
from barpc.cli.runs import run

if TYPE_CHECKING:
    from barpc.pipeline import AdjustResult, RunOptions


@click.command("match")
@click.argument("images", nargs=-1, required=False, metavar="IMAGE...")
@click.option("-o", "--out-dir", required=True, metavar="DIR", help="Folder for the results.")
@with_flags(*MATCH_FLAGS, *TIE_FLAGS)
@click.pass_obj
def command(obj: dict[str, Any], /, images: tuple[str, ...], out_dir: str, **flags: Any) -> int:
    r"""Match tie points and stop, for `barpc adjust --matches` and other tools.

    Writes matches.csv and matches.npz, and a text match file for each pair as ASP reads them (folder asp).

    \b
    Examples:
      barpc match scene/*.tif -o ties
      barpc adjust scene/*.tif --matches ties/matches.npz -o adjusted
    """
    from barpc.pipeline import adjust

    def work(paths: list[str], options: RunOptions, **workers: Any) -> AdjustResult:
        return adjust(paths, out_dir, options, **workers)

    return run(obj, work, images, flags, stop_after="matching")
