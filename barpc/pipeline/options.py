"""Everything a run may be told, in one record; `--options FILE` and the flags fill it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from barpc.ba import AdjustOptions
from barpc.errors import FitError, InputError
from barpc.fit import FitOptions
from barpc.sidefile import OPTIONS, read_text
from barpc.tie import TieOptions

_MOST = 1 << 53

IMAGES = ("vrt", "copy", "none")
STAGES = ("matching", "adjustment", "all")


@dataclass(frozen=True)
class RunOptions:
    """How `barpc.adjust` runs.

    Parameters
    ----------
    tie : TieOptions
        Tie points.
    adjust : AdjustOptions
        The adjustment.
    fit : FitOptions
        The refit of each RPC.
    images : {"vrt", "copy", "none"}
        What carries the corrected RPC: a small VRT that points at the untouched image, a full copy, or
        no image at all.
    rpc_formats : tuple of str
        RPC files written beside it: "txt", "rpb", "geom", "json", "xml".
    num_passes : int
        Passes of matching and adjustment; the second matches with the adjusted cameras.
    stop_after : {"matching", "adjustment", "all"}
        End early: after the tracks, or before RPCs are written.
    keep_going : bool
        Do what can be done instead of stopping: leave out a file that cannot be used and images that the largest
        connected group is not tied to, write an RPC that misses the fit's tolerance. Such a run ends with exit
        code 3.
    overwrite : bool
        Replace the results of an earlier run in the same folder.
    matches : str or None
        A tie-point table to use instead of matching.
    overlap_list : str or None
        A file of two image names or paths a line: only these pairs are matched.
    aoi : str or None
        A GeoJSON file of polygons: tie points only inside, and only what may show it is read.
    gcp : tuple of str
        Files of ground control points.
    check_points : tuple of str
        Files of ground points that stay out of the adjustment and are measured after it.
    fixed_run : str or None
        Folder of an earlier run whose views are among these: what it knows about them is carried over.
    dem : str or None
        A raster of terrain heights.
    geoid : str or None
        Geoid grid that turns the DEM's orthometric heights into ellipsoidal ones.
    """

    tie: TieOptions = field(default_factory=TieOptions)
    adjust: AdjustOptions = field(default_factory=AdjustOptions)
    fit: FitOptions = field(default_factory=FitOptions)
    images: str = "vrt"
    rpc_formats: tuple[str, ...] = ("txt",)
    num_passes: int = 1
    stop_after: str = "all"
    keep_going: bool = False
    overwrite: bool = False
    matches: str | None = None
    overlap_list: str | None = None
    aoi: str | None = None
    gcp: tuple[str, ...] = ()
    check_points: tuple[str, ...] = ()
    fixed_run: str | None = None
    dem: str | None = None
    geoid: str | None = None

    def __post_init__(self) -> None:
        for name, allowed in (("images", IMAGES), ("stop_after", STAGES)):
            if getattr(self, name) not in allowed:
                raise InputError(f"{name} {getattr(self, name)!r} is not one of {', '.join(allowed)}")
        if self.num_passes < 1:
            raise InputError(f"num_passes must be at least 1, found {self.num_passes}")
        if self.geoid is not None and self.dem is None:
            raise InputError("geoid is given without dem: there are no heights to convert")
        for name in ("overlap_list", "aoi"):
            if self.matches is not None and getattr(self, name) is not None:
                raise InputError(
                    f"{name} is given with matches: nothing is matched then; leave one of them out"
                )


def with_values(options: Any, values: Mapping[str, Any], where: str = "options") -> Any:
    """A copy of an options record with some fields changed, nested records by nested mappings.

    Parameters
    ----------
    options : dataclass
        The record.
    values : mapping of str to object
        New values.
    where : str
        What a message calls the source.

    Raises
    ------
    InputError
        An unknown field, or a value of the wrong type; the message names it.
    """
    known = {f.name: getattr(options, f.name) for f in fields(options)}
    kinds = get_type_hints(type(options))
    changed: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            raise InputError(f"{where}: unknown option {name!r}; known are {', '.join(known)}")
        old = known[name]
        if is_dataclass(old) and not isinstance(old, type):
            if not isinstance(value, Mapping):
                raise InputError(f"{where}: [{name}] must be a table, found {value!r}")
            changed[name] = with_values(old, value, f"{where} [{name}]")
        else:
            changed[name] = _as(kinds[name], value, f"{where}: {name}")
    try:
        return replace(options, **changed)
    except (TypeError, ValueError, FitError) as error:
        raise InputError(f"{where}: {error}") from error


def _as(kind: Any, value: Any, where: str) -> Any:
    """`value` as the declared type of an option, or an error."""
    parts = get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return _as(next(part for part in parts if part is not NoneType), value, where)
    if get_origin(kind) is tuple:
        return _as_tuple(parts, value, where)
    if get_origin(kind) is Literal:
        if value not in parts:
            raise InputError(f"{where} must be one of {', '.join(map(str, parts))}, found {value!r}")
        return value
    if get_origin(kind) is Mapping:
        if not isinstance(value, Mapping):
            raise InputError(f"{where} must be a table, found {value!r}")
        return {str(key): _as(parts[1], item, f"{where}.{key}") for key, item in value.items()}
    if type(value) is int and abs(value) >= _MOST:
        raise InputError(f"{where} is a whole number beyond {_MOST}")
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind or value != value:  # NaN
        raise InputError(f"{where} must be a {kind.__name__}, found {value!r}")
    return value


def _as_tuple(kinds: Sequence[Any], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise InputError(f"{where} must be a list, found {value!r}")
    if kinds[-1] is ...:
        kinds = [kinds[0]] * len(value)
    if len(value) != len(kinds):
        raise InputError(f"{where} must have {len(kinds)} values, found {value!r}")
    return tuple(_as(kind, item, where) for kind, item in zip(kinds, value, strict=True))


def read_options(path: str | Path, options: RunOptions | None = None) -> RunOptions:
    """Options from a TOML file: top-level keys, and the tables [tie], [adjust], [fit].

    Raises
    ------
    InputError
        The file does not exist or parse, or names an option that does not exist.
    """
    text = read_text(path, OPTIONS)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a date or a number that is none is not its own class
        raise InputError(f"{path}: not an options file (TOML): {error}") from error
    result: RunOptions = with_values(options or RunOptions(), data, str(path))
    return result
