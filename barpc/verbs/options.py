"""Options of a run as the verbs take them: a record, a mapping or a TOML file, and keywords."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

from barpc.base.declarations import Options, declared, with_values
from barpc.base.errors import InputError
from barpc.base.keywords import PathLike
from barpc.base.options import RunOptions, read_options

if TYPE_CHECKING:
    from typing import Unpack

    from barpc.base.keywords import RunKeywords

OptionsLike = RunOptions | Mapping[str, Any] | PathLike | None
FLAG_NAMES = {"rpc_formats": "rpc_format"}
"""Fields whose flags, and keywords, have another name."""


@cache
def _tables() -> dict[str, tuple[str, str]]:
    """Return the table ("" at the top) and field of every keyword: names are unique over all tables."""
    top = declared(RunOptions)
    tables = {name: type(one.default) for name, one in top.items() if isinstance(one.default, Options)}
    found = {name: (table, name) for table, record in tables.items() for name in declared(record)}
    found |= {name: ("", name) for name in top}
    return found | {flag: found[name] for name, flag in FLAG_NAMES.items()}


def run_options(options: OptionsLike = None, /, **keywords: Unpack[RunKeywords]) -> RunOptions:
    """Return the options of a run.

    Parameters
    ----------
    options : RunOptions, mapping as of a TOML file, or path of one; None: the defaults
    **keywords : any option by its name, or that of its flag: ``gcp="points.csv"``, ``matcher="oriented"``

    Raises
    ------
    InputError
        An unknown option, or a value of the wrong type or out of range.

    Examples
    --------
    >>> run_options({"tie": {"band": 2}}, gcp="points.csv", drift=0)
    RunOptions(tie=TieOptions(band=2), adjust=AdjustOptions(drift=0), gcp=('points.csv',))
    """
    if isinstance(options, (str, os.PathLike)):
        options = read_options(os.fspath(options))
    elif not isinstance(options, RunOptions):
        options = with_keywords(RunOptions(), options or {})
    return with_keywords(options, keywords)


def with_keywords(options: RunOptions, keywords: Mapping[str, Any], where: str = "options") -> RunOptions:
    """Return options with some changed, by their names in any table; whole tables may be records."""
    values: dict[str, Any] = {}
    for keyword, value in keywords.items():
        if keyword not in _tables():
            near = difflib.get_close_matches(keyword, _tables(), n=1)
            raise InputError(f"{where}: unknown option {keyword!r}" + (f"; is {near[0]!r} meant?" if near else ""))
        table, name = _tables()[keyword]
        if isinstance(value, Options):
            value = {field: getattr(value, field) for field in declared(type(value))}
        if isinstance(value, Mapping) or table:
            of = values.setdefault(table or name, {})
            of |= {name: value} if table else value
        else:
            values[name] = value
    return with_values(options, values, where)
