"""Everything a run may be told, in one record; `--options FILE` and the flags fill it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from barpc.ba import AdjustOptions
from barpc.errors import InputError
from barpc.fit import FitOptions
from barpc.tie import TieOptions

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
        Leave out a file that cannot be used instead of stopping; the run then ends with exit code 3.
    force : bool
        Write an RPC that misses the fit's tolerance; the run then ends with exit code 3.
    overwrite : bool
        Replace the results of an earlier run in the same folder.
    matches : str or None
        A tie-point table to use instead of matching.
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
    force: bool = False
    overwrite: bool = False
    matches: str | None = None
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
            changed[name] = _like(old, value, f"{where}: {name}")
    try:
        return replace(options, **changed)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: {error}") from error


def _like(old: object, value: Any, where: str) -> Any:
    """`value` as the type of the default `old`, or an error."""
    if isinstance(old, tuple) and isinstance(value, list):
        return tuple(value)
    if isinstance(old, bool) or old is None or not isinstance(old, (int, float, str)):
        if isinstance(old, bool) and not isinstance(value, bool):
            raise InputError(f"{where} must be true or false, found {value!r}")
        return value
    if isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, type(old)) or isinstance(value, bool):
        raise InputError(f"{where} must be a {type(old).__name__}, found {value!r}")
    return value


def read_options(path: str | Path, options: RunOptions | None = None) -> RunOptions:
    """Options from a TOML file: top-level keys, and the tables [tie], [adjust], [fit].

    Raises
    ------
    InputError
        The file does not exist or parse, or names an option that does not exist.
    """
    try:
        data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: not an options file (TOML): {error}") from error
    result: RunOptions = with_values(options or RunOptions(), data, str(path))
    return result
