"""`barpc report`, `export`, `verify`, `dsm`: commands on a finished run."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import click

from barpc.base.verb_options import CalibrateOptions, DsmOptions, ExportOptions, OrthoOptions, VerifyOptions
from barpc.cli.flags import flags_of, given_flags, jobs_option
from barpc.cli.terminal import at_work, echo, print_comparison, remark, tell, tell_gate, wants_json

_VERIFIED = "input", "output", "camera", "figure"  # that `verify` compares
_TARGET_NAMES = ("satnerf", "colmap", "s2p", "cars", "asp", "stac", "points")


@click.command("report")
@click.argument("run_dirs", nargs=-1, required=True, metavar="RUN [OTHER_RUN]")
@click.option("--csv", is_flag=True, help="A line for each of any number of runs: verdict, figures, reasons.")
def report(run_dirs: tuple[str, ...], csv: bool) -> int:
    r"""Make report.html of a finished run again, from its summary.json and tables; compare two runs; or list many.

    Two finished runs of the same images are compared on the terminal: errors, cameras, options. Exit code 3 with
    --csv: a folder holds no finished run; its line has the reason.

    \b
    Examples:
      barpc report adjusted
      barpc report adjusted adjusted_with_drift
      barpc report --csv scenes/*/adjusted > scenes.csv
    """
    from barpc.verbs import runs

    if wants_json() and len(run_dirs) == 1 and not csv:
        raise click.UsageError("--json goes with two runs or --csv; the summary.json of one is there already")
    found = runs.report(*run_dirs, csv=csv)
    if csv:
        from barpc.report.overview import NO_RUN, as_csv

        echo(json.dumps(found, indent=1) if wants_json() else as_csv(found))
        lacking = [row["run"] for row in found if row["status"] == NO_RUN]
        return tell_gate(f"{len(lacking)} of {len(found)} folders hold no finished run:", lacking) if lacking else 0
    if len(run_dirs) == 1:
        tell(None, found)
    elif wants_json():
        echo(json.dumps(found, indent=1))
    else:
        print_comparison(found)
    return 0


@click.command("export")
@click.argument("run_dir", metavar="RUN_DIR")
@click.argument("out_dir", metavar="OUT_DIR")
@click.option("--to", "target", type=click.Choice(_TARGET_NAMES), required=True, help="The tool.")
@flags_of(ExportOptions)
def export(run_dir: str, out_dir: str, target: str, **flags: Any) -> int:
    r"""Export a finished run to another tool: its images, corrected cameras and tie points in files that it reads.

    satnerf: JSON for Sat-NeRF and EOGS; colmap: central pinholes for splatting, nerfstudio; s2p, cars, asp: a
    configuration that is ready to run; stac: a collection for catalogues; points: tie points with their covariance.
    Images are pointed at, relative to OUT_DIR. Exit code 3: nothing is written, as no file states the time that
    satnerf and stac need.

    \b
    Examples:
      barpc export adjusted nerf --to satnerf --time 2013-04-17T10:36:44
      barpc export adjusted splats --to colmap --images --tolerance 0.05
      barpc export adjusted stereo --to s2p && s2p stereo/config.json
    """
    from barpc.export.light import UnknownTimeError
    from barpc.verbs import runs

    try:
        paths = runs.export(run_dir, out_dir, target, **given_flags(flags))
    except UnknownTimeError as error:
        return tell_gate(f"nothing is written: {error}", [])
    tell([str(path) for path in paths], *paths)
    alone = target == "points" or flags.get("images")  # names no image of the run
    if not wants_json() and not alone and any(Path(run_dir).glob("*.vrt")):
        remark("the images are not copied: move them together with both folders, or adjust with --images copy")
    return 0


@click.command("verify")
@click.argument("run_dir", metavar="RUN_DIR")
@click.argument("places", nargs=-1, metavar="[FOLDER...]")
@flags_of(VerifyOptions)
def verify(run_dir: str, places: tuple[str, ...], **flags: Any) -> int:
    r"""List changed, missing and added files of a run or export, and check that cameras read as certified.

    SHA256SUMS lists all (but .barpc), also for `sha256sum -c`; its own SHA-256 is the root. Only --expect detects
    edits of a file together with the list. Missing inputs are searched by name beside the run, in it, and in the
    folders given; other hosts are not accessed. --figures measures what the run printed again, by the files on disk as
    another tool reads them, to 0.005 px. Exit code 0: everything is unchanged; 3: something is not; 1: no SHA256SUMS
    (interrupted), or a damaged one.

    \b
    Examples:
      barpc verify adjusted
      barpc verify adjusted --figures
      barpc verify adjusted --expect 4a1e...c09f /archive/images
    """
    from barpc.pipeline.proof import SAME
    from barpc.verbs import runs

    with at_work() as progress:
        found = runs.verify(run_dir, places, progress=progress, **given_flags(flags))
    wrong, counts = [one for one in found if not one.passed], Counter((one.kind, one.now) for one in found)
    changed = (
        f"{one.kind} {one.file}: {one.now}{one.note and f', {one.note}'}"
        for one in found
        if one.now != SAME or one.kind in ("root", "figure")
    )
    kinds = {kind: [f"{n} {now}" for (of, now), n in counts.items() if of == kind] for kind in _VERIFIED}
    if not flags.get("figures"):
        del kinds["figure"]
    tell(found, *changed, *(f"{kind}s: {', '.join(told) or 'none'}" for kind, told in kinds.items()))
    if not wrong:
        return 0
    return tell_gate("the run has changed:", list(dict.fromkeys(f"{one.file} {one.now}" for one in wrong)))


@click.command("calibrate")
@click.argument("runs", nargs=-1, required=True, metavar="RUN...")
@click.option("-o", "--out", "--output", required=True, metavar="FILE", help="The calibration to write: SENSOR.cal.")
@flags_of(CalibrateOptions)
def calibrate(runs: tuple[str, ...], out: str, **flags: Any) -> int:
    r"""Estimate the interior distortion and detector steps of one sensor from finished runs.

    `barpc adjust --calibration FILE` corrects for it. Images may be parts of products; their place on the line of
    detectors is that which their camera states. Exit code 1, and nothing written, where such a place is not known, the
    distortion changes with time, directions do not suffice, or the residuals of runs left out do not improve.

    \b
    Example:
      barpc calibrate archive/*/adjusted -o WV02_P.cal
    """
    from barpc.pipeline.calibrate import calibrate as learn

    with at_work() as progress:
        found = learn(runs, out, progress=progress, **given_flags(flags))
    sizes, better = (*found["size_px"], *found["sigma_px"]), sum(run["gain"] > 0 for run in found["runs"])
    words = (
        "{}: {:.3f} px across and {:.3f} px along the flight, standard deviations {:.4f} and {:.4f} px; {} steps; of "
        "{} runs left out in turn the residuals of {} improve"
    )
    tell(found, words.format(found["sensor"], *sizes, len(found["edges"]), len(runs), better), out)
    return 0


@click.command("ortho")
@click.argument("images", nargs=-1, required=True, metavar="RUN | IMAGE...")
@click.option("-o", "--out-dir", "--output", required=True, metavar="DIR", help="Folder for the orthoimages.")
@flags_of(OrthoOptions)
def ortho(images: tuple[str, ...], out_dir: str, **flags: Any) -> int:
    r"""Make orthoimages of images with RPCs: Cloud-Optimised GeoTIFFs whose pixels lie on one grid.

    A RUN brings its corrected cameras and the DEMs that it was made with. GDAL warps each image by its RPC on the
    heights, which are above the ellipsoid first, whatever the DEM counts from. Where the DEM has no height, there are
    no pixels; without a DEM all ground is at one altitude.

    Exit code 3: the camera of an image may be another's; a line states the reason.

    \b
    Examples:
      barpc ortho adjusted --dem srtm.tif --geoid egm96 -o maps
      barpc ortho image.tif --alt 180 --gsd 0.5 --crs EPSG:2154 -o maps
    """
    from barpc.verbs import orthoimages

    with at_work() as progress:
        done = orthoimages.ortho(images, out_dir, progress=progress, **given_flags(flags))
    lines = (f"{one.path}: {one.size[0]} x {one.size[1]} px of {one.gsd:g} m, {one.crs}, {one.heights}" for one in done)
    tell(done, *lines)
    doubts = [doubt for one in done for doubt in one.doubts]
    return tell_gate("Cameras may not be those of their images.", doubts) if doubts else 0


@click.command("dsm")
@click.argument("source", nargs=-1, required=True, metavar="RUN | IMAGE IMAGE...")
@click.option("-o", "--out", "--output", required=True, metavar="FILE", help="The GeoTIFF to write.")
@flags_of(DsmOptions)
@jobs_option
def dsm(source: tuple[str, ...], out: str, jobs: int | str, **flags: Any) -> int:
    r"""Make a first surface model (DSM) of a finished run, or of images with their delivered cameras.

    The best pairs of images are matched pixel by pixel, matches are intersected with the corrected cameras, and every
    cell of a map gets the median of the pairs that agree. The file, a Cloud-Optimised GeoTIFF, has five bands: height
    above the ellipsoid, number of pairs, their disagreement, and the height's standard deviation by matching and by
    cameras; its tag SIGMA_SHARED_BY_ALL_CELLS_M is the standard deviation of the height common to all cells. Those by
    cameras exist for a run only.

    The run's report.html then shows a window of the ground by the delivered and by the corrected cameras.

    Exit code 3: nothing is written, as the images cannot be matched in this way; a line states the reason.

    \b
    Examples:
      barpc dsm adjusted -o dsm.tif
      barpc dsm adjusted/*.vrt -o dsm.tif --alt 80 320
      barpc dsm both_dates -o change.tif --minus first_date
      barpc dsm adjusted -o dsm.tif --gsd 2 --crs EPSG:2154 -j 4
    """
    from barpc.dsm.stereo import NoSurfaceError
    from barpc.report.records import json_form
    from barpc.verbs import runs

    try:
        with at_work() as progress:
            surface = runs.dsm(source, out, jobs=jobs, progress=progress, **given_flags(flags))
    except NoSurfaceError as error:
        return tell_gate(f"no surface: {error}", [])
    cells = surface.size[0] * surface.size[1]
    said = {
        "pairs disagree by": surface.nmad,
        "sigma by matching": surface.sigma,
        "by cameras": surface.sigma_cameras,
        "shared by all cells": surface.datum,
    }
    medians = (f"{words} {value:.2f} m" for words, value in said.items() if value == value)
    tell(
        json_form(surface),
        f"{surface.known} of {cells} cells of {surface.gsd:g} m have a height, by {', '.join(surface.pairs)}",
        f"{', '.join(medians)} (medians)",
        f"Written to {surface.path}",
    )
    return 0
