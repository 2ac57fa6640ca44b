"""The flags that set options, made of the declarations in `barpc.options`, and those of every run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeVar, get_origin

import click

from barpc.errors import InputError
from barpc.options import PAPER, Declared, RunOptions, checked, declared, read_options, with_values

Function = TypeVar("Function", bound=Callable[..., Any])

REMOTE = "allow_remote"
TIE = ("tie.band", "tie.matcher", "matches", "matches_only", "overlap_list", "aoi")
CAMERA = ("adjust.model", "adjust.drift", "adjust.jitter", "adjust.fixed")
GROUND = ("gcp", "altimetry", "check_points", "fixed_run", "dem", "adjust.dem_for_weak", "geoid", "reference")
ADJUSTMENT = (*CAMERA, *GROUND)
MATCH = ("overwrite", "keep_going")
RUN = (*MATCH, "images", "rpc_formats", "grids", "resample")
"""Fields of RunOptions that have flags, by what their verbs do, with their table before a dot."""
_NAMES = {"rpc_formats": "--rpc-format"}


def flag_name(target: str) -> str:
    """Return the flag that sets a field."""
    return _NAMES.get(target) or "--" + target.rpartition(".")[2].replace("_", "-")


def field_of(target: str) -> Declared:
    """Return what is declared of a field, by its name with its table before a dot."""
    *table, name = target.split(".")
    record = type(declared(RunOptions)[table[0]].default) if table else RunOptions
    return declared(record)[name]


def _parameter(target: str) -> str:
    """Return what click calls the flag that sets a field."""
    return "flag_" + target.replace(".", "_")


def flag(target: str) -> Callable[[Function], Function]:
    """Return the click option that sets a field: its type, range, choices, help and default are the field's own."""
    one, name = field_of(target), flag_name(target)
    rule, kind, parameter = one.rule, one.kind, _parameter(target)
    if kind is bool:  # None: the options file decides
        return click.option(name, parameter, help=rule.help, is_flag=True, default=None)
    several = get_origin(kind) is tuple

    def convert(_context: click.Context, _parameter: click.Parameter, value: Any) -> Any:
        if value is None or value == ():
            return None
        if rule.rows:
            value = [word.strip() for word in value.split(",")] if several else value
        elif kind in (int, float):
            with suppress(ValueError):  # a text is refused by what follows
                value = kind(value)
        try:
            return checked(target.rpartition(".")[2], kind, rule, value)
        except InputError as error:
            raise click.BadParameter(str(error)) from error

    choices = [] if rule.rows else [str(choice) for choice in rule.choices(kind)]
    listed = "|".join(choices)

    def complete(_context: click.Context, _parameter: click.Parameter, begun: str) -> list[str]:
        return [choice for choice in choices if choice.startswith(begun)]

    metavar = f"[{listed}]" if listed else (rule.unit or kind.__name__).upper()
    if rule.rows:
        metavar = "NAMES" if several else "NAME"
    notes = [f"default: {_shown(one.default)}"] if one.default not in (None, ()) else []
    if kind in (int, float) and (bounds := replace(rule, unit="").bounds()):
        notes.append(bounds.strip())
    how = " Names of 'barpc convert --help', commas between." if rule.rows else " (repeatable)"
    text = rule.help + (how if several else "") + (f"  [{'; '.join(notes)}]" if notes else "")
    how_given: dict[str, Any] = {"multiple": several and not rule.rows, "shell_complete": complete}
    return click.option(name, parameter, help=text, metavar=metavar, callback=convert, **how_given)


def _shown(default: Any) -> str:
    return ",".join(default) if isinstance(default, tuple) else str(default)


paper = click.option(
    "--paper",
    is_flag=True,
    help="The method of Akiki et al. (IGARSS 2021) whole: one rotation and translation about a projective centre, no "
    "drift, no splines, least_squares, RPCs by the joint L-curve on a grid in lon and lat. Options, other flags win.",
)


def with_flags(*targets: str) -> Callable[[Function], Function]:
    """Give a verb the flags of these fields, and those of every run: image and options files, workers, JSON."""

    def decorate(function: Function) -> Function:
        for option in (*_RUN_OPTIONS[::-1], *map(flag, (*targets, REMOTE)[::-1])):
            function = option(function)
        return function

    return decorate


def _jobs(_context: click.Context, _parameter: click.Parameter, value: str) -> int | str:
    """Return a number of processes, or the address of a cluster."""
    if "://" in value:
        return value
    if not value.isdecimal() or not 1 <= len(value) <= 4 or int(value) < 1:
        raise click.BadParameter(f"{value!r} is no number of processes, and no address (tcp://host:8786)")
    return int(value)


jobs_option = click.option(
    "-j",
    "--jobs",
    metavar="N|ADDRESS",
    callback=_jobs,
    default="1",
    help="Worker processes, or a dask.distributed cluster (tcp://host:8786).  [default: 1]",
)
_RUN_OPTIONS = (
    click.option("--image-list", metavar="FILE", help="More image paths from a file, one a line."),
    click.option("--options", "options_file", metavar="FILE", help="Options from a TOML file; flags win."),
    jobs_option,
)


def run_options(flags: Mapping[str, Any], options_file: str | None) -> RunOptions:
    """Return defaults, or the paper's options, then the options file, then the flags that were given."""
    options = with_values(RunOptions(), PAPER if flags.get("paper") else {})
    options = options if options_file is None else read_options(options_file, options)
    values: dict[str, Any] = {}
    for target in (*TIE, *ADJUSTMENT, *RUN, REMOTE, "fit.tolerance", "fit.localisation"):
        value = flags.get(_parameter(target))
        if value is None:
            continue
        *table, name = target.split(".")
        (values.setdefault(table[0], {}) if table else values)[name] = value
    return with_values(options, values, "command line")
