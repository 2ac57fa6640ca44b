"""`barpc adjust`, `match` and `check`: runs of the pipeline."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from barpc.cli.flags import ADJUSTMENT, MATCH, RUN, TIE, Grouped, image_paths, options_of_flags, paper, with_flags
from barpc.cli.process import Kept
from barpc.cli.terminal import EXIT_GATE, at_work, is_quiet, output_width, print_summary, tell, tell_gate, wants_json

if TYPE_CHECKING:
    from barpc.pipeline import AdjustResult, Plan

MOST_PAIRS = 10  # of a plan on the terminal
_images_argument = click.argument("images", nargs=-1, required=False, metavar="IMAGE...")
_out_dir = partial(click.option, "-o", "--out-dir", "--output", metavar="DIR")


@click.command("adjust", cls=Grouped)
@_images_argument
@_out_dir(help="Folder for the results; needed unless with --dry-run.")
@paper
@click.option("--dry-run", is_flag=True, help="Say pairs, time, memory, datum and doubts; write nothing.")
@with_flags(*RUN, *TIE, *ADJUSTMENT)
def adjust(dry_run: bool, **flags: Any) -> int:
    r"""Correct the cameras of overlapping images and write fresh RPCs.

    Tie points are matched across the images, a bundle adjustment estimates a rotation and a translation of
    each camera, and the corrected cameras are fitted into new RPCs, written as a VRT (which points at the
    untouched image) and an _RPC.TXT file an image.

    \b
    Examples:
      barpc adjust scene/*.tif -o adjusted
      barpc adjust a.tif b.tif --gcp points.gcp --dem srtm.tif --geoid egm96 -o adjusted
      barpc adjust scene/*.tif --reference ortho.tif --dem srtm.tif --geoid egm96 -o adjusted
      barpc adjust --image-list images.txt -j 8 --keep-going -o adjusted
      barpc adjust a.tif,model=physical b.tif,model=physical -o adjusted
      barpc adjust a.tif,camera=cameras/1.xml b.tif,camera=cameras/2.xml -o adjusted

    IMAGE may be a folder or a pattern: its rasters in the order of their names.
    """
    from barpc.verbs import runs

    if flags["out_dir"] is None and not dry_run:
        raise click.MissingParameter(param_type="option", param_hint="'-o' / '--out-dir'")
    return _run_pipeline(runs.plan, flags, _tell_plan) if dry_run else _run_pipeline(runs.adjust, flags)


@click.command("match", cls=Grouped)
@_images_argument
@_out_dir(required=True, help="Folder for the results.")
@with_flags(*MATCH, *TIE)
def match(**flags: Any) -> int:
    r"""Match tie points and stop, for `barpc adjust --matches` and other tools.

    Writes matches.csv and matches.npz, and a text match file for each pair as ASP reads them (folder asp).

    \b
    Examples:
      barpc match scene/*.tif -o ties
      barpc adjust scene/*.tif --matches ties/matches.npz --matches-only -o adjusted
    """
    from barpc.verbs import runs

    return _run_pipeline(runs.match, flags)


@click.command("check", cls=Grouped)
@_images_argument
@with_flags(*TIE)
def check(**flags: Any) -> int:
    r"""Measure how well the cameras of overlapping images agree, without adjusting or writing anything.

    \b
    Example:
      barpc check adjusted/*.vrt
    """
    from barpc.verbs import runs

    return _run_pipeline(runs.check, flags)


def _run_pipeline(work: Callable[..., Any], flags: dict[str, Any], tell_of: Callable[[Any], int] | None = None) -> int:
    """Run a verb of the pipeline with the options of the flags, and print the result."""
    options, where = options_of_flags(flags, flags["options_file"]), [flags["out_dir"]] if "out_dir" in flags else []
    images = image_paths(flags["images"], flags["image_list"], options.keep_going)
    kept = click.get_current_context().find_object(Kept) or Kept()
    kept.folder = Path(where[0]) if where and where[0] else None
    with at_work() as progress:
        result = work(images, *where, options, jobs=flags["jobs"], progress=kept.following(progress))
    return (tell_of or _tell_result)(result)


def _tell_plan(plan: Plan) -> int:
    rows = (f"{a} - {b}: {share:.0%} in common, {angle:.1f} deg" for a, b, share, angle in plan.pairs[:MOST_PAIRS])
    more = [f"and {len(plan.pairs) - MOST_PAIRS} more (--json has all)"] * (len(plan.pairs) > MOST_PAIRS)
    fast, slow = plan.cpu_seconds
    cost = f"about {fast:.0f} to {slow:.0f} CPU s and {plan.memory_mb / 1000:.1f} GB"
    pairs = f"{len(plan.pairs)} pair{'s' * (len(plan.pairs) != 1)} to match first"
    head = f"{len(plan.views)} image{'s' * (len(plan.views) != 1)}, {pairs}: {cost}"
    tell(plan, head, *rows, *more, *plan.datum)
    return tell_gate("the input has reservations:", list(plan.doubts)) if plan.doubts else 0


def _tell_result(result: AdjustResult) -> int:
    if wants_json():
        tell(result.summary)
    elif not is_quiet():
        print_summary(result.record)
    if result.passed:
        return 0
    if output_width() is not None and not (wants_json() or is_quiet()):  # on the screen: every reason once
        return EXIT_GATE
    reasons = list(result.record.reasons)
    return tell_gate("" if is_quiet() and reasons else result.record.headline, reasons)
