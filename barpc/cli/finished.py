"""`barpc report`, `export`, `verify`: what is done with a finished run."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import click

from barpc.cli.terminal import echo, print_comparison, say, tell_gate, wants_json

_TARGETS = ("satnerf", "colmap", "s2p", "cars", "asp", "ortho", "stac", "points")


@click.command("report")
@click.argument("run_dir", metavar="RUN_DIR")
@click.argument("other", required=False, metavar="[OTHER_RUN]")
def report(run_dir: str, other: str | None) -> int:
    r"""Make report.html of a finished run again, from its summary.json and tables; or compare two runs.

    Two finished runs of the same images are compared on the terminal: errors, cameras, options.

    \b
    Examples:
      barpc report adjusted
      barpc report adjusted adjusted_with_drift
      barpc report --json monday tuesday
    """
    if other is None:
        if wants_json():
            raise click.UsageError("--json goes with two runs; the summary.json of one is there already")
        from barpc.report.page import remake_report

        echo(remake_report(run_dir))
        return 0
    from barpc.report.compare import compare_runs

    comparison = compare_runs(run_dir, other)
    if wants_json():
        echo(json.dumps(comparison, indent=1))
    else:
        print_comparison(comparison)
    return 0


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

    satnerf: JSON an image with the RPC; colmap: pinhole cameras that come near the RPCs, with the largest error of
    each; s2p, cars, asp: a configuration that is ready to run; ortho: GDAL's
    commands for orthoimages; stac: a collection for catalogues; points: tie points with their covariance. Images are
    pointed at, relative to OUT_DIR, and never copied.

    \b
    Examples:
      barpc export adjusted nerf --to satnerf
      barpc export adjusted sparse --to colmap --alt 80 320
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
        say("the images stay where they are: move them together with both folders, or adjust with --images copy")
    return 0


@click.command("verify")
@click.argument("run_dir", metavar="RUN_DIR")
@click.argument("places", nargs=-1, metavar="[FOLDER...]")
def verify(run_dir: str, places: tuple[str, ...]) -> int:
    r"""Say which inputs and outputs of a finished run are still the same, and whether its cameras read as certified.

    Files are compared by the SHA-256 in summary.json. An input that is no longer where it was is looked for by its name
    beside the run, in it, and in the folders given. Exit code 0: all is as it was; 3: something is not.

    \b
    Examples:
      barpc verify adjusted
      barpc verify adjusted /archive/images
    """
    from barpc.pipeline.proof import GOOD, SAME, prove

    found = prove(Path(run_dir), [Path(place) for place in places])
    wrong = [one for one in found if one.now not in GOOD]
    if wants_json():
        echo(json.dumps([asdict(one) for one in found]))
    else:
        for one in found:
            if one.now != SAME:
                echo(f"{one.kind} {one.file}: {one.now}" + (f", {one.note}" if one.note else ""))
        counts = Counter((one.kind, one.now) for one in found)
        for kind in ("input", "output", "camera"):
            told = ", ".join(f"{count} {now}" for (of, now), count in counts.items() if of == kind)
            echo(f"{kind}s: {told or 'none'}")
    if not wrong:
        return 0
    return tell_gate("the run is not what it was:", [f"{one.file} {one.now}" for one in wrong])
