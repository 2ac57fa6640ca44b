"""`barpc adjust`, `match` and `check`: runs of the pipeline."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from barpc.cli.dsm import BESIDE, interrupted, made
from barpc.cli.flags import ADJUSTMENT, MATCH, RUN, TIE, Grouped, image_paths, paper, run_options, with_flags
from barpc.cli.progress import executor_for, progress_told
from barpc.cli.specs import Config, corrected, expanded, read_config, with_cameras
from barpc.cli.terminal import echo, output_width, print_summary, say, tell_gate, wants_json
from barpc.options import DsmOptions

if TYPE_CHECKING:
    from barpc.options import RunOptions
    from barpc.pipeline import AdjustResult

_images = click.argument("images", nargs=-1, required=False, metavar="IMAGE...")
_out_dir = click.option("-o", "--out-dir", required=True, metavar="DIR", help="Folder for the results.")


@click.command("adjust", cls=Grouped)
@_images
@_out_dir
@click.option(
    "--from",
    "source",
    type=(click.Choice(["s2p", "cars", "sat-bundleadjust"]), str),
    metavar="TOOL FILE",
    help="Images and cameras of a configuration of s2p, cars (both are written back with the corrected cameras) or "
    "sat-bundleadjust.",
)
@paper
@click.option("--surface", is_flag=True, help="Make a first surface, dsm.tif, too, as `barpc dsm` does.")
@with_flags(*RUN, *TIE, *ADJUSTMENT)
@click.pass_obj
def adjust(
    obj: dict[str, Any],
    /,
    images: tuple[str, ...],
    out_dir: str,
    source: tuple[str, str] | None,
    surface: bool,
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
      barpc adjust img_a.tif img_b.tif --rpc img_a.tif=cameras/1.xml --rpc img_b.tif=cameras/2.xml -o adjusted
      barpc adjust --from s2p config.json -o adjusted

    IMAGE may be a folder or a pattern: its rasters in the order of their names.
    """
    from barpc import pipeline

    config = None if source is None else read_config(*source)
    if surface:
        given = _given(images, flags) if config is None else [item.image for item in config.items]
        if interrupted(Path(out_dir), given):
            flags["flag_overwrite"] = True
    if config is None:
        code = _run(obj, pipeline.adjust, images, flags, out_dir=out_dir)
    else:
        code = _run_from(obj, config, images, flags, out_dir)
    if surface:
        options, place = DsmOptions(overwrite=True), Path(out_dir)
        if made(obj, place, place / BESIDE, options, flags["jobs"]) is None:
            return 3
    return code


@click.command("match", cls=Grouped)
@_images
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
    from barpc import pipeline

    return _run(obj, pipeline.adjust, images, flags, {"stop_after": "matching"}, out_dir=out_dir)


@click.command("check", cls=Grouped)
@_images
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
    from barpc import pipeline

    if against is not None:
        return _compare(_given(images, flags), Path(against))
    return _run(obj, pipeline.check, images, flags)


def _run(
    obj: Mapping[str, Any],
    work: Callable[..., AdjustResult],
    images: tuple[str, ...],
    flags: dict[str, Any],
    fixed: Mapping[str, Any] | None = None,
    **where: str,
) -> int:
    """Run an entry of the pipeline with what the command line says and what the verb has `fixed`, and tell."""
    paths = _given(images, flags)
    options = replace(run_options(flags, flags["options_file"]), **(fixed or {}))
    return _tell(obj, _result(obj, work, paths, options, flags, where))


def _given(images: tuple[str, ...], flags: Mapping[str, Any]) -> list[str]:
    return with_cameras(expanded(image_paths(images, flags["image_list"])), flags["rpcs"])


def _result(
    obj: Mapping[str, Any],
    work: Callable[..., AdjustResult],
    images: Sequence[Any],
    options: RunOptions,
    flags: Mapping[str, Any],
    where: Mapping[str, str],
) -> AdjustResult:
    with executor_for(flags["jobs"]) as executor, progress_told(obj["quiet"], obj["verbose"]) as progress:
        return work(images, options=options, executor=executor, progress=progress, **where)


def _run_from(
    obj: Mapping[str, Any], config: Config, images: tuple[str, ...], flags: dict[str, Any], out_dir: str
) -> int:
    """Adjust the images of a configuration, and write it with their corrected cameras into the run folder."""
    if images or flags["image_list"]:
        raise click.UsageError("images come from the command line or from --from, not from both")
    from barpc import pipeline
    from barpc.pipeline.outputs import output_names
    from barpc.workspace import Workspace

    options = run_options(flags, flags["options_file"])
    if config.tool == "cars":
        options = replace(options, rpc_formats=tuple(dict.fromkeys((*options.rpc_formats, "geom"))))
    name = config.path.name
    if name in output_names((), options, Path(out_dir)):
        raise click.UsageError(f"{config.path}: a run writes a file of this name itself; rename it")
    found = config.images(options.allow_remote)
    result = _result(obj, pipeline.adjust, found, options, flags, {"out_dir": out_dir})
    if len(result.views) < len(config.items) or not result.run.fits:
        say(f"{name} is not written: not every image that it lists has a new RPC")
    elif config.tool != "sat-bundleadjust":
        with Workspace(out_dir, overwrite=True, keep=[config.path], names=[name], adds=True) as workspace:
            workspace.write_text(name, corrected(config, workspace.folder, result.views))
    return _tell(obj, result)


def _tell(obj: Mapping[str, Any], result: AdjustResult) -> int:
    if wants_json():
        echo(json.dumps(result.summary, indent=1))
    elif not obj["quiet"]:
        print_summary(result.record)
    if result.passed:
        return 0
    # on the screen: every reason once
    said = output_width() is not None and not (wants_json() or obj["quiet"])
    return tell_gate(result.record.headline, [] if said else list(result.record.reasons))


def _compare(images: list[str], against: Path) -> int:
    from barpc.cameras import open_camera
    from barpc.handoff import TOLERANCE, difference
    from barpc.pipeline import load_views
    from barpc.rpcio import find_rpc

    found = []
    for view in load_views(images, min_views=1, distinct=False).views:
        other = find_rpc(against, Path(view.path)) if against.is_dir() else against
        far = difference(view.sensor, open_camera(other).model, view.size, view.alt_range)
        found.append((view.path, str(other), far))
    if wants_json():
        rows = [dict(zip(("image", "against", "max_px"), row, strict=True)) for row in found]
        echo(json.dumps(rows, indent=1))
    else:
        for path, compared, px in found:
            echo(f"{path}  {compared}  max {px:.3g} px")
    off = [f"{path}: {px:.3g} px." for path, _, px in found if not px <= TOLERANCE]
    return tell_gate(f"{len(off)} of {len(found)} RPCs differ.", off) if off else 0
