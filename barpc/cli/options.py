"""Options that several verbs share: their flags, and how flags and an options file fill a RunOptions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from barpc.pipeline.options import RunOptions

Function = TypeVar("Function", bound=Callable[..., Any])


class Flag:
    """A flag and the field of RunOptions that it sets.

    Parameters
    ----------
    name : str
        As typed.
    target : str
        The field, with its table before a dot.
    help : str
        A sentence.
    **kwargs
        For `click.option`.
    """

    def __init__(self, name: str, target: str, help: str, **kwargs: Any) -> None:
        self.target = target
        self.parameter = "flag_" + target.replace(".", "_")
        if kwargs.get("is_flag"):
            kwargs["default"] = None  # not given: the options file decides
        self.decorate = click.option(name, self.parameter, help=help, **kwargs)


COUNT = click.IntRange(1)
TIE_FLAGS = (
    Flag("--band", "tie.band", "Band of multi-band images, from 1.", type=COUNT),
    Flag(
        "--matches", "matches", "Tie points (CSV, npz, ASP text) to use instead of matching.", metavar="FILE"
    ),
    Flag("--overlap-list", "overlap_list", "Match only these pairs: two image names a line.", metavar="FILE"),
    Flag("--aoi", "aoi", "Tie points only inside: polygons in lon/lat (GeoJSON).", metavar="FILE"),
    Flag("--ip-per-image", "tie.keypoints_per_image", "Keypoints an image, at most.", type=COUNT),
    Flag("--search", "tie.search", "How far an RPC may be wrong.", type=float, metavar="PX"),
)
ADJUSTMENT_FLAGS = (
    Flag(
        "--model",
        "adjust.model",
        "Unknowns: rotation+translation, rotation, translation, shift, shift-drift or affine.",
        metavar="NAME",
    ),
    Flag(
        "--drift",
        "adjust.drift",
        "Degree of the rotation along the rows.  [default: 1, and 2 where the residuals ask for it]",
        type=click.IntRange(0, 2),
    ),
    Flag(
        "--sigma-attitude",
        "adjust.sigma_attitude",
        "Prior of the rotation, metres on the ground.",
        type=float,
        metavar="M",
    ),
    Flag("--sigma-position", "adjust.sigma_position", "Prior of the translation.", type=float, metavar="M"),
    Flag(
        "--fixed", "adjust.fixed", "A view that keeps its camera (repeatable).", multiple=True, metavar="NAME"
    ),
    Flag("--gcp", "gcp", "Ground control points: .gcp, GeoJSON, image tags.", multiple=True, metavar="FILE"),
    Flag(
        "--check-points",
        "check_points",
        "Ground points measured after the adjustment, not used in it.",
        multiple=True,
        metavar="FILE",
    ),
    Flag(
        "--fixed-run",
        "fixed_run",
        "Go on from an earlier run: its views keep what it knows about them.",
        metavar="DIR",
    ),
    Flag("--dem", "dem", "Terrain heights that hold weakly seen tie points.", metavar="FILE"),
    Flag("--dem-sigma", "adjust.dem_sigma", "Standard deviation of the DEM.", type=float, metavar="M"),
    Flag("--geoid", "geoid", "Geoid grid for a DEM of orthometric heights.", metavar="FILE"),
)
RUN_FLAGS = (
    Flag("--overwrite", "overwrite", "Replace the results of an earlier run.", is_flag=True),
    Flag(
        "--images",
        "images",
        "Carry the new RPC in a small VRT that points at the image, in a full copy, or not.  [default: vrt]",
        type=click.Choice(["vrt", "copy", "none"]),
    ),
    Flag(
        "--rpc-format",
        "rpc_formats",
        "RPC files to write, of those that 'barpc convert --help' lists.",
    ),
    Flag(
        "--keep-going",
        "keep_going",
        "Leave bad files out, keep the largest connected group, write RPCs that miss the tolerance; exit 3.",
        is_flag=True,
    ),
)
MATCH_FLAGS = tuple(flag for flag in RUN_FLAGS if flag.target in ("overwrite", "keep_going"))
_BY_PARAMETER = {flag.parameter: flag for flag in (*TIE_FLAGS, *ADJUSTMENT_FLAGS, *RUN_FLAGS)}


def with_flags(*flags: Flag) -> Callable[[Function], Function]:
    """Give a verb these flags, and those of every run: image and options files, workers, JSON."""

    def decorate(function: Function) -> Function:
        for option in (*_RUN_OPTIONS[::-1], *(flag.decorate for flag in flags[::-1])):
            function = option(function)
        return function

    return decorate


def _jobs(_context: click.Context, _parameter: click.Parameter, value: str) -> int | str:
    """A number of processes, or the address of a cluster."""
    if "://" in value:
        return value
    if not value.isdecimal() or not 1 <= len(value) <= 4 or int(value) < 1:
        raise click.BadParameter(f"{value!r} is no number of processes, and no address (tcp://host:8786)")
    return int(value)


_RUN_OPTIONS = (
    click.option("--image-list", metavar="FILE", help="More image paths from a file, one a line."),
    click.option("--options", "options_file", metavar="FILE", help="Options from a TOML file; flags win."),
    click.option(
        "-j",
        "--jobs",
        metavar="N|ADDRESS",
        callback=_jobs,
        default="1",
        show_default=True,
        help="Worker processes, or a dask.distributed cluster (tcp://host:8786).",
    ),
    click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON on stdout."),
)


def image_paths(images: tuple[str, ...], image_list: str | None) -> list[str]:
    """Images of the command line, then those of a list file (blank lines and # comments are skipped)."""
    from barpc.sidefile import read_names

    paths = list(images)
    if image_list is not None:
        folder, lines = Path(image_list).parent, read_names(image_list, "a list of images")
        paths += [str(folder / line.strip()) for line in lines if line.strip() and not line.startswith("#")]
    return paths


def run_options(flags: Mapping[str, Any], options_file: str | None) -> RunOptions:
    """Defaults, then the options file, then the flags that were given."""
    from barpc.pipeline.options import RunOptions, read_options, with_values

    options = RunOptions() if options_file is None else read_options(options_file)
    values: dict[str, Any] = {}
    for parameter, value in flags.items():
        if value is None or value == ():
            continue
        target = _BY_PARAMETER[parameter].target
        *table, field = target.split(".")
        place = values.setdefault(table[0], {}) if table else values
        if target == "rpc_formats":
            value = [name.strip() for name in value.split(",")]
        place[field] = list(value) if isinstance(value, tuple) else value
    result: RunOptions = with_values(options, values, "command line")
    return result
