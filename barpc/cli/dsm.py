"""`barpc dsm`: a first surface of a run or of images, with its uncertainty."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from barpc.cli.flags import Function, jobs_option
from barpc.cli.progress import executor_for, progress_told
from barpc.cli.specs import expanded
from barpc.cli.terminal import echo, tell_gate, wants_json
from barpc.options import DsmOptions, declared

if TYPE_CHECKING:
    from barpc.dsm import Surface


def _flag(name: str, kind: Any, metavar: str | None = None) -> Callable[[Function], Function]:
    """Return a click option whose words and default are the field's own."""
    one = declared(DsmOptions)[name]
    default = "" if one.default in (None, False) else f"  [default: {one.default}]"
    if kind is bool:
        return click.option(f"--{name}", help=one.rule.help, is_flag=True)
    return click.option(f"--{name}", type=kind, metavar=metavar, help=one.rule.help + default)


@click.command("dsm")
@click.argument("source", nargs=-1, required=True, metavar="RUN | IMAGE IMAGE...")
@click.option("-o", "--out", required=True, metavar="FILE", help="The GeoTIFF to write.")
@_flag("gsd", float, "M")
@_flag("crs", str, "NAME")
@_flag("alt", (float, float), "LOW HIGH")
@_flag("pairs", int, "N")
@_flag("band", int, "N")
@_flag("minus", str, "OTHER_RUN")
@jobs_option
@_flag("overwrite", bool)
@click.pass_obj
def dsm(obj: dict[str, Any], /, source: tuple[str, ...], out: str, jobs: int | str, **flags: Any) -> int:
    r"""Make a first surface model (DSM) of a finished run, or of images with the cameras that come with them.

    The best pairs of images are matched pixel by pixel, matches are intersected with the corrected cameras, and every
    cell of a map gets the median of its pairs. The file, a Cloud-Optimised GeoTIFF, has five bands: height above the
    ellipsoid, number of pairs, their disagreement, and the height's standard deviation by matching and by cameras; its
    tag SIGMA_SHARED_BY_ALL_CELLS_M says how well the height of the whole is known. Only a run knows its cameras'.

    The run's report.html then shows a window of the ground by the delivered and by the corrected cameras.

    Exit code 3: nothing is written, as the images cannot be matched in this way, and a line says why.

    \b
    Examples:
      barpc dsm adjusted -o dsm.tif
      barpc dsm adjusted/*.vrt -o dsm.tif --alt 80 320
      barpc dsm both_dates -o change.tif --minus first_date
      barpc dsm adjusted -o dsm.tif --gsd 2 --crs EPSG:2154 -j 4
    """
    runs = [Path(one) for one in source if (Path(one) / "summary.json").is_file()]
    if runs and len(source) > 1:
        raise click.UsageError(f"{runs[0]} is a finished run: give it alone (--minus OTHER_RUN is for two dates)")
    run = runs[0] if runs else None
    options = DsmOptions(**{name: value for name, value in flags.items() if value is not None})
    if run is None and options.minus is not None:
        raise click.UsageError("--minus goes with a RUN: what two dates share is not known of images")
    surface = made(obj, run or expanded(source), out, options, jobs)
    if surface is not None and wants_json():
        echo(json.dumps({key: _plain(value) for key, value in asdict(surface).items()}, indent=1))
    return 3 if surface is None else 0


def made(
    obj: dict[str, Any], source: Path | list[str], out: str | Path, options: DsmOptions, jobs: int | str
) -> Surface | None:
    """Make a surface and tell of it; None where the images cannot be matched, and a line says why."""
    from barpc.dsm import NoSurfaceError, make_dsm

    try:
        with executor_for(jobs) as executor, progress_told(obj["quiet"], obj["verbose"]) as progress:
            surface = make_dsm(source, out, options, executor=executor, progress=progress)
    except NoSurfaceError as error:
        tell_gate(f"no surface: {error}", [])
        return None
    if not (wants_json() or obj["quiet"]):
        _tell(surface)
    return surface


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and value != value else value


def _tell(surface: Surface) -> None:
    cells = surface.size[0] * surface.size[1]
    echo(f"{surface.known} of {cells} cells of {surface.gsd:g} m have a height, by {', '.join(surface.pairs)}")
    said = {
        "pairs disagree by": surface.nmad,
        "sigma by matching": surface.sigma,
        "by cameras": surface.sigma_cameras,
        "shared by all cells": surface.datum,
    }
    echo(", ".join(f"{words} {value:.2f} m" for words, value in said.items() if value == value) + " (medians)")
    echo(f"Written to {surface.path}")
