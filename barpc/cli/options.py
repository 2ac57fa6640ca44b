"""The flags that set options, made of the declarations in `barpc.options`, and those of every run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import click

from barpc.errors import InputError
from barpc.options import Declared, RunOptions, checked, declared, read_options, with_values

Function = TypeVar("Function", bound=Callable[..., Any])

TIE = ("tie.band", "matches", "overlap_list", "aoi", "tie.keypoints_per_image", "tie.search")
ADJUSTMENT = (
    *("adjust.model", "adjust.drift", "adjust.sigma_attitude", "adjust.sigma_position", "adjust.fixed"),
    *("gcp", "check_points", "fixed_run", "dem", "adjust.dem_sigma", "geoid"),
)
MATCH = ("overwrite", "keep_going")
RUN = (*MATCH, "images", "rpc_formats")
"""Fields of RunOptions that have flags, by what their verbs do, with their table before a dot."""
_NAMES = {"tie.keypoints_per_image": "--ip-per-image", "rpc_formats": "--rpc-format"}


def flag_name(target: str) -> str:
    """The flag that sets a field."""
    return _NAMES.get(target) or "--" + target.rpartition(".")[2].replace("_", "-")


def field_of(target: str) -> Declared:
    """What is declared of a field, by its name with its table before a dot."""
    *table, name = target.split(".")
    record = type(declared(RunOptions)[table[0]].default) if table else RunOptions
    return declared(record)[name]


class _Value(click.ParamType):  # type: ignore[type-arg]  # newer versions of click have an argument
    """A value of a flag, as its field takes it: one of those that may stand several times, several at once."""

    def __init__(self, target: str) -> None:
        one = field_of(target)
        self.field, self.rule, self.kind = target.rpartition(".")[2], one.rule, one.kind
        if get_origin(self.kind) is tuple and not self.rule.rows:
            self.kind = get_args(self.kind)[0]
        listed = "" if self.rule.rows else "|".join(map(str, self.rule.choices(self.kind)))
        plain = self.rule.unit or getattr(self.kind, "__name__", "")
        self.name = "NAMES" if self.rule.rows else f"[{listed}]" if listed else plain.upper()

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """What stands for the value in the help."""
        return self.name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The field's value of a text."""
        try:
            if get_origin(self.kind) is tuple:
                value = [name.strip() for name in value.split(",")]
            elif self.kind in (int, float):
                value = self.kind(value)
        except ValueError:
            pass  # said by what follows
        try:
            return checked(self.field, self.kind, self.rule, value)
        except InputError as error:
            self.fail(str(error), param, ctx)


def flag(target: str) -> Callable[[Function], Function]:
    """The click option that sets a field: its type, range, choices, help and default are the field's own."""
    one, name, parameter = field_of(target), flag_name(target), "flag_" + target.replace(".", "_")
    if one.kind is bool:
        return click.option(
            name, parameter, help=one.rule.help, is_flag=True, default=None
        )  # the file decides
    several = get_origin(one.kind) is tuple
    notes = [f"default: {_shown(one.default)}"] if one.default not in (None, ()) else []
    if one.kind in (int, float) and (bounds := replace(one.rule, unit="").bounds()):
        notes.append(bounds.strip())
    how = " Names of 'barpc convert --help', commas between." if one.rule.rows else " (repeatable)"
    text = one.rule.help + (how if several else "")
    text += f"  [{'; '.join(notes)}]" if notes else ""
    return click.option(
        name, parameter, help=text, type=_Value(target), multiple=several and not one.rule.rows
    )


def _shown(default: Any) -> str:
    return ",".join(default) if isinstance(default, tuple) else str(default)


def with_flags(*targets: str) -> Callable[[Function], Function]:
    """Give a verb the flags of these fields, and those of every run: image and options files, workers, JSON."""

    def decorate(function: Function) -> Function:
        for option in (*_RUN_OPTIONS[::-1], *map(flag, targets[::-1])):
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
        *("-j", "--jobs"),
        metavar="N|ADDRESS",
        callback=_jobs,
        default="1",
        help="Worker processes, or a dask.distributed cluster (tcp://host:8786).  [default: 1]",
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
    options = RunOptions() if options_file is None else read_options(options_file)
    values: dict[str, Any] = {}
    for target in (*TIE, *ADJUSTMENT, *RUN, "fit.tolerance"):
        value = flags.get("flag_" + target.replace(".", "_"))
        if value is None or value == ():
            continue
        *table, name = target.split(".")
        (values.setdefault(table[0], {}) if table else values)[name] = value
    return with_values(options, values, "command line")
