"""How options are declared: a record's fields state type, range, unit and meaning once.

A record checks what is put into it, whoever does it: Python, an options file, a flag, or `replace`. The flags of the
command line, the page of options, the JSON schema and `help(AdjustOptions)` are made of the same declarations.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import reprlib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cache
from importlib import import_module
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, dataclass_transform, get_args, get_origin, get_type_hints

from barpc.base.errors import InputError
from barpc.base.fields import Value, given

T = TypeVar("T")
OptionsRecord = TypeVar("OptionsRecord", bound="Options")

HOOK = r"[A-Za-z_][\w.]*:[A-Za-z_]\w*"  # a name in a module
_MAX_EXACT_INTEGER = 1 << 53  # whole numbers stay below: beyond, not every one has a double of its own
_REAL = 1e30  # no option is larger, or smaller and not 0: squares, and squares of them, are numbers then
_SHORT = reprlib.Repr()
_SHORT.maxstring, _SHORT.maxother = 60, 200


@dataclass(frozen=True)
class Rule:
    """Bounds, unit and meaning of a field."""

    help: str  # sentences; Markdown's back quotes mark code
    unit: str = ""  # of numbers; of texts what they are: "file", "dir", "name"
    least: float | None = None  # bounds of a number, or of each in a list
    above: float | None = None  # not reached
    most: float | None = None
    below: float | None = None  # not reached
    rows: str = ""  # the table whose keys are the values allowed, as module and name
    hook: bool = False  # or `module:name`, of a user's own
    removed: Mapping[str, str] = field(default_factory=dict)  # value of earlier releases -> what it was, what to use
    only: str = ""  # the flag that sets it, where no options file may
    metavar: str = ""  # names of the values on the command line, with the commas that stand between them

    def holds(self, number: float) -> bool:
        """Return whether a number lies within the bounds; NaN and the infinities do not."""
        return (
            math.isfinite(number)
            and (self.least is None or number >= self.least)
            and (self.above is None or number > self.above)
            and (self.most is None or number <= self.most)
            and (self.below is None or number < self.below)
        )

    def bounds(self) -> str:
        """Return the bounds and the unit in words, with a blank before them."""
        ends = {"at least": self.least, "above": self.above, "at most": self.most, "below": self.below}
        words = " and ".join(f"{word} {value:g}" for word, value in ends.items() if value is not None)
        if self.least is not None and self.most is not None:
            words = f"from {self.least:g} to {self.most:g}"
        return (f" {words}" if words else "") + (f" [{self.unit}]" if self.unit else "")

    def choices(self, kind: Any) -> tuple[Any, ...]:
        """Return the values allowed where they are listed: of a Literal, or the rows of a table; else none."""
        if get_origin(kind) is Literal:
            return get_args(kind)
        if self.rows:
            module, _, name = self.rows.rpartition(".")
            return tuple(getattr(import_module(module), name))
        return ()


_FREE = Rule("")


def option(default: T, help: str, **rule: Any) -> T:
    """Declare a field of an option record: its default, its meaning, and the rest of its `Rule`."""
    metadata = {"rule": Rule(" ".join(help.split()), **rule)}
    made: T = field(default=default, metadata=metadata)
    return made


@dataclass(frozen=True)
class Declared:
    """A field as declared: its type (without None), whether it may be None, its rule and its default."""

    kind: Any
    optional: bool
    rule: Rule
    default: Any


def declared(record: type[Options]) -> Mapping[str, Declared]:
    """Return the declaration of each field of an option record; a nested record has an empty rule."""
    kind: Any = record  # a class can be hashed
    found: Mapping[str, Declared] = _declared(kind)
    return found


@cache
def _declared(record: Any) -> Mapping[str, Declared]:
    hints, found = get_type_hints(record), {}
    for one in fields(record):
        kind, optional = hints[one.name], False
        if get_origin(kind) in (Union, UnionType):
            kind, optional = next(part for part in get_args(kind) if part is not NoneType), True
        default = one.default if one.default_factory is MISSING else one.default_factory()
        found[one.name] = Declared(kind, optional, one.metadata.get("rule", _FREE), default)
    return found


@dataclass_transform(frozen_default=True)
class Options(Value):
    """Base of the option records: its children are frozen dataclasses, checked when made, short when printed."""

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, eq=False, repr=False)(cls)
        rows = [str(cls.__doc__), "", "Parameters", "----------"]
        for name, one in declared(cls).items():
            rows += [f"{name} : {wanted(one.kind, _FREE if one.rule.rows else one.rule)}"]
            rows += [f"    {one.rule.help or 'See there.'} Default: {one.default!r}."]
        cls.__doc__ = "\n".join(rows)

    def __post_init__(self) -> None:
        for name, one in declared(type(self)).items():
            value = getattr(self, name)
            known = value is None if one.optional else bool(one.rule.rows) and value == one.default
            if not known:  # a default is a row of its table: it is not imported for that
                object.__setattr__(self, name, checked(name, one.kind, one.rule, value))

    def _told(self) -> str:
        known = declared(type(self))
        return ", ".join(f"{name}={_SHORT.repr(v)}" for name, v in given(self).items() if v != known[name].default)


def wanted(kind: Any, rule: Rule) -> str:
    """Return the values that a field may hold, in words."""
    parts = get_args(kind)
    if get_origin(kind) is tuple:
        count = "a list" if parts[-1] is ... else f"{len(parts)} values"
        return f"{count}, each {wanted(parts[0], rule)}"
    if choices := rule.choices(kind):
        return f"one of {', '.join(map(str, choices))}" + (", or module:name" if rule.hook else "")
    words = {
        bool: "true or false",
        int: "a whole number",
        float: "a number",
        str: f"a {rule.unit}" if rule.unit else "text",
    }
    return words.get(kind, f"of class {kind.__name__}") + (rule.bounds() if kind in (int, float) else "")


def checked(name: str, kind: Any, rule: Rule, value: Any) -> Any:
    """Return a value converted to its field's type; InputError names the field where type or range is wrong."""
    parts, found = get_args(kind), None
    if get_origin(kind) is tuple and rule.unit == "file" and isinstance(value, (str, os.PathLike)):
        value = (value,)  # of files one is as good as a list of one
    if get_origin(kind) is tuple:
        value = value.tolist() if hasattr(value, "tolist") else value  # numpy's arrays
        if isinstance(value, (list, tuple)) and (parts[-1] is ... or len(parts) == len(value)):
            return tuple(checked(name, parts[0], rule, item) for item in value)
    elif rule.hook and isinstance(value, str) and re.fullmatch(HOOK, value):
        found = value
    elif choices := rule.choices(kind):
        if type(value) not in (str, int) or value not in choices:
            why = rule.removed.get(str(value))
            raise InputError(f"{name} {value!r} is not {wanted(kind, rule)}" + (f"; removed: {why}" if why else ""))
        found = value
    else:
        found = _as_type(kind, rule, value)
    if found is None:
        raise InputError(f"{name} must be {wanted(kind, rule)}, found {value!r}")
    return found


def _as_type(kind: Any, rule: Rule, value: Any) -> Any:
    """Return a single value as its type, numpy's numbers and paths included; None if it is none, or out of range."""
    if kind is str:
        text = os.fspath(value) if isinstance(value, (str, os.PathLike)) else None
        return text if isinstance(text, str) else None
    if kind not in (int, float):
        return value if isinstance(value, kind) else None
    if isinstance(value, bool) or not isinstance(value, Integral if kind is int else Real):
        return None
    if isinstance(value, Integral) and abs(int(value)) >= _MAX_EXACT_INTEGER:
        return None
    number = kind(value)
    beyond = kind is float and number != 0 and not 1 / _REAL <= abs(number) <= _REAL
    return number if rule.holds(number) and not beyond else None


def with_values(
    options: OptionsRecord, values: Mapping[str, Any], where: str = "options", *, of_file: bool = False
) -> OptionsRecord:
    """Return a copy of a record with some fields changed, nested records by nested mappings.

    InputError for an unknown field, or a value of the wrong type or out of range, of the source called `where`; of a
    file (`of_file`) also for a host, or a module that would be run.
    """
    known, changed = declared(type(options)), dict(values)
    for name, value in values.items():
        if name not in known:
            near = difflib.get_close_matches(str(name), known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
            raise InputError(f"{where}: unknown option {name!r}; {hint}")
        nested, rule = getattr(options, name), known[name].rule
        runs = rule.hook and isinstance(value, str) and re.fullmatch(HOOK, value)
        if of_file and (rule.only or runs):
            why = f"{value!r} would run code: it" if runs else "stands in a file, where it"
            raise InputError(f"{where}: {name} {why} is not accepted; give the flag {rule.only or f'--{name}'}")
        if isinstance(nested, Options):
            if not isinstance(value, Mapping):
                raise InputError(f"{where}: [{name}] must be a table, found {value!r}")
            changed[name] = with_values(nested, value, f"{where} [{name}]", of_file=of_file)
    try:
        return replace(options, **changed)  # type: ignore[type-var]  # children are dataclasses
    except InputError as error:
        raise type(error)(f"{where}: {error}") from error


def schema(record: type[Options]) -> dict[str, Any]:
    """Return the JSON schema (2020-12) of a record, as an options file spells it."""
    import msgspec

    return msgspec.json.schema(_spelled(record))


def _spelled(record: type[Options]) -> Any:
    """Return the type of a record's table in an options file."""
    from msgspec import UNSET, Meta, UnsetType, defstruct

    rows: list[Any] = []
    for name, one in declared(record).items():
        rule, kind = one.rule, one.kind
        if rule.only:
            continue
        if isinstance(one.default, Options):
            rows.append((name, _spelled(type(one.default)), {}))
            continue
        origin, parts = get_origin(kind), get_args(kind)
        item = parts[0] if origin is tuple else kind
        if item in (int, float):
            ends: Any = {"ge": rule.least, "gt": rule.above, "le": rule.most, "lt": rule.below}
            limited: Any = Annotated[item, Meta(**ends)]
        else:
            limited = Literal[rule.choices(item)] if rule.choices(item) else item
        if origin is tuple:
            limited = origin[tuple(... if part is ... else limited for part in parts)]
        default = UNSET if one.default is None else one.default  # TOML has no null
        rows.append((name, Annotated[limited | UnsetType, Meta(description=rule.help)], default))
    return defstruct(record.__name__, rows, forbid_unknown_fields=True)
