"""The flags that set options, made of the declarations in `barpc.base.options`, and those of every run."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import click

from barpc.base.declarations import Declared, Options, checked, declared, with_values
from barpc.base.errors import InputError
from barpc.base.options import PAPER, RunOptions, read_options
from barpc.base.remote import is_url
from barpc.base.safe_io import read_names
from barpc.cli.terminal import echo
from barpc.verbs.options import FLAG_NAMES, with_keywords

Function = TypeVar("Function", bound=Callable[..., Any])

REMOTE = "allow_remote"
_ALL = "barpc.help_all"  # key of a context whose help shows every flag
TIE = ("tie.band", "tie.matcher", "matches", "matches_only", "overlap_list", "aoi")
CAMERA = ("adjust.model", "adjust.drift", "adjust.jitter", "adjust.terms", "adjust.fixed", "calibration")
GROUND = (
    "gcp",
    "gcp_crs",
    "altimetry",
    "check_points",
    "add_to",
    "update",
    "dem",
    "geoid",
    "heights",
    "reference",
)
ADJUSTMENT = (*CAMERA, *GROUND)
MATCH = ("overwrite", "keep_going")
RUN = (*MATCH, "images", "rpc_formats", "grids")
"""Fields of RunOptions that have flags, by what their verbs do, with their table before a dot."""


def flag_name(target: str) -> str:
    """Return the flag that sets a field."""
    name = target.rpartition(".")[2]
    return "--" + FLAG_NAMES.get(name, name).replace("_", "-")


def field_of(target: str) -> Declared:
    """Return the declaration of a field, by its name with its table before a dot."""
    *table, name = target.split(".")
    record = type(declared(RunOptions)[table[0]].default) if table else RunOptions
    return declared(record)[name]


_LISTED_FLAGS = {
    "--out-dir", "--overwrite", "--keep-going", "--images", "--image-list", "--options", "--jobs",
    "--help", "--help-all", "--matches", "--aoi", "--gcp", "--check-points", "--dem", "--geoid", "--reference",
}  # fmt: skip
"""Flags that `--help` lists; `--help-all` has the rest."""
_GROUPS = {"Tie points": TIE, "Cameras": CAMERA, "Ground": GROUND}


class Grouped(click.Command):
    """A verb of a run: its help groups the usual flags by subject, `--help-all` lists every one."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        words = "Show every flag, those for cameras and matching too, and exit."
        how: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False, "callback": _help_all}
        self.params.append(click.Option(["--help-all"], help=words, **how))

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the flags of input files first, then those of tie points, cameras and ground."""
        of = {_parameter(target): words for words, targets in _GROUPS.items() for target in targets}
        rows: dict[str, list[tuple[str, str]]] = {"Files and the run": [], **{words: [] for words in _GROUPS}}
        for option in self.get_params(ctx):
            usual = not isinstance(option, click.Option) or not _LISTED_FLAGS.isdisjoint(option.opts)
            row = option.get_help_record(ctx) if usual or ctx.meta.get(_ALL) else None
            if row is not None:
                rows[of.get(option.name or "", "Files and the run")].append(row)
        for words, listed in rows.items():
            if listed:
                with formatter.section(words):
                    formatter.write_dl(listed)


def _help_all(context: click.Context, _parameter: click.Parameter, value: bool) -> None:
    """Print the whole help and end."""
    if value and not context.resilient_parsing:
        context.meta[_ALL] = True
        echo(context.get_help())
        context.exit()


def _parameter(target: str) -> str:
    """Return click's parameter name of the flag of a field."""
    return "flag_" + target.replace(".", "_")


def flag(target: str) -> Callable[[Function], Function]:
    """Return the click option that sets a field of a run's options: None where it is not given."""
    return _field_flag(field_of(target), target.rpartition(".")[2], _parameter(target))


def flags_of(record: type[Options], **others: str) -> Callable[[Function], Function]:
    """Give a verb the flags of all fields of a record; `others`: other words for some of them."""

    def decorate(function: Function) -> Function:
        for name, one in reversed([*declared(record).items()]):
            rule = replace(one.rule, help=others.get(name, one.rule.help))
            function = _field_flag(replace(one, rule=rule), name, name)(function)
        return function

    return decorate


def given_flags(flags: Mapping[str, Any]) -> dict[str, Any]:
    """Return the flags that were given."""
    return {name: value for name, value in flags.items() if value is not None}


def _field_flag(one: Declared, name: str, parameter: str) -> Callable[[Function], Function]:
    """Return the click option that sets a field: its type, range, choices, help and default are the field's own."""
    rule, kind, words = one.rule, one.kind, flag_name(name)
    if kind is bool:  # None: the options file, or the default, decides
        return click.option(words, parameter, help=rule.help, is_flag=True, default=None)
    parts = get_args(kind) if get_origin(kind) is tuple else ()
    several, item = ... in parts, parts[0] if parts else kind
    commas = bool(rule.rows) or "," in rule.metavar

    def convert(_context: click.Context, _parameter: click.Parameter, value: Any) -> Any:
        if value is None or value == ():
            return None
        if parts and commas:
            value = [word.strip() for word in value.split(",")]
        if item in (int, float):
            value = [_as_number(item, word) for word in value] if parts else _as_number(item, value)
        try:
            return checked(name, kind, rule, value)
        except InputError as error:
            raise click.BadParameter(str(error)) from error

    choices = [] if rule.rows else [str(choice) for choice in rule.choices(kind)]

    def complete(_context: click.Context, _parameter: click.Parameter, begun: str) -> list[str]:
        return [choice for choice in choices if choice.startswith(begun)]

    how: dict[str, Any] = {"multiple": several and not commas, "shell_complete": complete, "callback": convert}
    how["nargs"] = len(parts) if parts and not (several or commas) else 1
    return click.option(words, parameter, help=_help(one, several), metavar=_metavar(one, several, choices), **how)


def _as_number(kind: type, word: str) -> Any:
    """Return a word as a number; one that is none stays, and is refused by its field."""
    with suppress(ValueError):
        return kind(word)
    return word


def _metavar(one: Declared, several: bool, choices: Sequence[str]) -> str:
    rule = one.rule
    listed = f"[{'|'.join(choices)}]" if choices else (rule.unit or one.kind.__name__).upper()
    return rule.metavar or ("NAME" + "S" * several if rule.rows else listed)


def _help(one: Declared, several: bool) -> str:
    """Return the help of a flag: the words of its field, unit and bounds, and the default."""
    rule, numbers = one.rule, {int, float} & {one.kind, *get_args(one.kind)}
    default = ",".join(one.default) if isinstance(one.default, tuple) else one.default
    notes = [rule.unit] if rule.metavar and rule.unit and numbers else []  # else it stands for the value
    notes += [f"default: {default}"] if default not in (None, "") else []
    notes += [bounds.strip()] if numbers and (bounds := replace(rule, unit="").bounds()) else []
    how = " Names of 'barpc convert --help', commas between." if rule.rows else " (repeatable)"
    return rule.help + how * several + (f"  [{'; '.join(notes)}]" if notes else "")


paper = click.option(
    "--paper",
    is_flag=True,
    help="The method of Akiki et al. (IGARSS 2021) whole: one rotation and translation about a projective centre, no "
    "drift, no splines, RPCs by the joint L-curve on a grid in lon and lat. Options and flags win.",
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
    click.option(
        "--image-list",
        metavar="FILE",
        help="More image paths from a file, one a line, relative to its folder.",
    ),
    click.option("--options", "options_file", metavar="FILE", help="Options from a TOML file; flags win."),
    jobs_option,
)


def options_of_flags(flags: Mapping[str, Any], options_file: str | None) -> RunOptions:
    """Return defaults, or the paper's options, then the options file, then the flags that were given."""
    options = with_values(RunOptions(), PAPER if flags.get("paper") else {})
    options = options if options_file is None else read_options(options_file, options)
    targets = (*TIE, *ADJUSTMENT, *RUN, REMOTE, "fit.tolerance")
    found = {target.rpartition(".")[2]: flags.get(_parameter(target)) for target in targets}
    return with_keywords(options, given_flags(found), "command line")


# --- images -----------------------------------------------------------------------------------------------


def image_paths(images: tuple[str, ...], image_list: str | None, keep_going: bool = False) -> list[str]:
    """Return images of the command line, then those of a list file (blank lines and # comments are skipped).

    Relative paths of a list count from its folder; InputError for a line whose file is missing, unless `keep_going`.
    """
    paths = list(images)
    if image_list is None:
        return paths
    folder = Path(image_list).parent
    from barpc.verbs.images import name_of  # with all that opens cameras

    for number, line in enumerate(read_names(image_list, "a list of images"), start=1):
        name = line.strip()
        if not name or line.startswith("#"):
            continue
        image, choice, camera = name.partition(",camera=")
        if choice and not is_url(camera):
            name = f"{image}{choice}{folder / camera}"
        paths.append(name if is_url(name) else str(folder / name))
        file = name_of(paths[-1])
        if not (keep_going or is_url(name) or os.path.lexists(file) or glob.glob(file)):  # noqa: PTH207
            where = f"relative paths count from the list's folder, {folder.absolute()}"
            raise InputError(f"{image_list}, line {number}: {file}: no such file; {where}")
    return paths
