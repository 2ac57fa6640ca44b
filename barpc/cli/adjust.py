"""`barpc adjust`, `match` and `check`: runs of the pipeline."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from barpc.cli.flags import ADJUSTMENT, MATCH, RUN, TIE, Grouped, image_paths, paper, run_options, with_flags
from barpc.cli.terminal import (
    echo,
    executor_for,
    output_width,
    print_summary,
    progress_told,
    tell,
    tell_gate,
    wants_json,
)

if TYPE_CHECKING:
    from barpc.pipeline import AdjustResult

_images_argument = click.argument("images", nargs=-1, required=False, metavar="IMAGE...")
_out_dir = click.option("-o", "--out-dir", required=True, metavar="DIR", help="Folder for the results.")


@click.command("adjust", cls=Grouped)
@_images_argument
@_out_dir
@paper
@with_flags(*RUN, *TIE, *ADJUSTMENT)
@click.pass_obj
def adjust(
    obj: dict[str, Any],
    /,
    images: tuple[str, ...],
    out_dir: str,
    **flags: Any,
) -> int:
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

    return _run_pipeline(obj, runs.adjust, images, flags, out_dir=out_dir)


@click.command("match", cls=Grouped)
@_images_argument
@_out_dir
@with_flags(*MATCH, *TIE)
@click.pass_obj
def match(obj: dict[str, Any], /, images: tuple[str, ...], out_dir: str, **flags: Any) -> int:
    r"""Match tie points and stop, for `barpc adjust --matches` and other tools.

    Writes matches.csv and matches.npz, and a text match file for each pair as ASP reads them (folder asp).

    \b
    Examples:
      barpc match scene/*.tif -o ties
      barpc adjust scene/*.tif --matches ties/matches.npz --matches-only -o adjusted
    """
    from barpc.verbs import runs

    return _run_pipeline(obj, runs.match, images, flags, out_dir=out_dir)


@click.command("check", cls=Grouped)
@_images_argument
@click.option("--against", metavar="PATH", help="Compare with this RPC (one image), or those of this folder.")
@with_flags(*TIE)
@click.pass_obj
def check(obj: dict[str, Any], /, images: tuple[str, ...], against: str | None, **flags: Any) -> int:
    r"""Measure how well the cameras of overlapping images agree, without adjusting or writing anything.

    With --against, no tie points are matched: each image's RPC is compared with another one over the image and
    its altitudes; exit 3 where one differs by more than a millionth of a pixel.

    \b
    Examples:
      barpc check adjusted/*.vrt
      barpc check adjusted/*.vrt --against delivered/
    """
    from barpc.verbs import runs

    if against is not None:
        return _compare(image_paths(images, flags["image_list"]), Path(against))
    return _run_pipeline(obj, runs.check, images, flags)


def _run_pipeline(
    obj: Mapping[str, Any],
    work: Callable[..., AdjustResult],
    images: tuple[str, ...],
    flags: dict[str, Any],
    **where: str,
) -> int:
    """Run a verb of the pipeline with the options of the flags, and print the result."""
    options = run_options(flags, flags["options_file"])
    paths = image_paths(images, flags["image_list"], options.keep_going)
    with executor_for(flags["jobs"]) as executor, progress_told(obj["quiet"], obj["verbose"]) as progress:
        return _tell_result(obj, work(paths, options=options, executor=executor, progress=progress, **where))


def _tell_result(obj: Mapping[str, Any], result: AdjustResult) -> int:
    if wants_json():
        echo(json.dumps(result.summary, indent=1))
    elif not obj["quiet"]:
        print_summary(result.record, result.root)
    if result.passed:
        return 0
    # on the screen: every reason once
    said = output_width() is not None and not (wants_json() or obj["quiet"])
    reasons = [] if said else list(result.record.reasons)
    return tell_gate("" if obj["quiet"] and reasons else result.record.headline, reasons)


def _compare(images: list[str], against: Path) -> int:
    from barpc.pipeline.verify_outputs import READING_TOLERANCE
    from barpc.verbs.runs import compared

    found = compared(images, against)
    if wants_json():
        rows = [dict(zip(("image", "against", "max_px"), row, strict=True)) for row in found]
        echo(json.dumps(rows, indent=1))
    else:
        for path, other, px in found:
            tell(f"{path}  {other}  max {px:.3g} px")
    off = [f"{path}: {px:.3g} px." for path, _, px in found if not px <= READING_TOLERANCE]
    return tell_gate(f"{len(off)} of {len(found)} RPCs differ.", off) if off else 0
