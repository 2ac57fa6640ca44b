"""`barpc export`: a finished run in the words of another tool."""

from __future__ import annotations

import json
from pathlib import Path

import click

from barpc.cli.terminal import echo, say, wants_json

_TARGETS = ("satnerf", "eogs", "nerfstudio", "colmap", "s2p", "cars", "asp", "stac", "points")


@click.command("export")
@click.argument("run_dir", metavar="RUN_DIR")
@click.argument("out_dir", metavar="OUT_DIR")
@click.option("--to", "target", type=click.Choice(_TARGETS), required=True, help="The tool.")
@click.option(
    "--alt",
    type=(float, float),
    metavar="LOW HIGH",
    help="Altitudes of the scene [m above the ellipsoid].  [default: of its tie points, and a margin]",
)
@click.option("--overwrite", is_flag=True, help="Replace what an earlier export wrote.")
def export(run_dir: str, out_dir: str, target: str, alt: tuple[float, float] | None, overwrite: bool) -> int:
    r"""Hand a finished run to another tool: its images, corrected cameras and tie points in files that it reads.

    satnerf, eogs: JSON an image with the RPC; nerfstudio, colmap: pinhole cameras that come near the RPCs, with the
    largest error of each; s2p, cars, asp: a configuration that is ready to run; stac: items of a catalogue; points:
    tie points with their covariance. Images are pointed at, relative to OUT_DIR, and never copied.

    \b
    Examples:
      barpc export adjusted nerf --to satnerf
      barpc export adjusted splats --to nerfstudio --alt 80 320
      barpc export adjusted stereo --to s2p && s2p stereo/config.json
    """
    from barpc.export import export_run

    paths = export_run(run_dir, target, out_dir, alt_range=alt, overwrite=overwrite)
    if wants_json():
        echo(json.dumps([str(path) for path in paths]))
        return 0
    for path in paths:
        echo(path)
    if target != "points" and any(Path(run_dir).glob("*.vrt")):  # (points name no image)
        say(
            "the images stay where they are: move them together with both folders, or adjust with --images copy"
        )
    return 0
