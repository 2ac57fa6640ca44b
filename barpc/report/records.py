"""Typed records: the declaration of a field gives its JSON schema, its column in tables and its line in the docs.

A field with a default is optional: it is left out of the file while it is None, and older files need not have it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field
from functools import cache, partial
from inspect import get_annotations
from itertools import groupby
from operator import itemgetter
from types import NoneType
from typing import Annotated, Any, ClassVar, Literal, Self, dataclass_transform, get_args, get_type_hints

import msgspec
import numpy as np

from barpc.base.fields import OfFields, field_names, is_record

Number = float | None  # A number; None (null) stands for what is not finite


def column(
    text: str,
    unit: str = "",
    head: str | tuple[str, ...] = "",
    form: str = "",
    *,
    adjusted: bool = False,
    default: Any = MISSING,
    **limits: Any,
) -> Any:
    """Return a field of a record with its declaration.

    Parameters
    ----------
    text, unit : str
        Its meaning in a line without full stop; its unit.
    head : str or tuple of str
        Over its column in tables; several: its numbers stand in columns of their own.
    form : str
        How its numbers are written there; empty for whole numbers and names.
    adjusted : bool
        Whether only an adjustment has it: other runs leave its column out.
    default, **limits
        None for an optional value; `enum`, the texts that it may be, and those of `msgspec.Meta`: ge, le, min_length,
        max_length, pattern.
    """
    end = f" [{unit}]" if unit else ""
    heads = f"{head}{end}" if isinstance(head, str) else tuple(f"{words}{end}" for words in head)
    enum = limits.pop("enum", None)
    meta = msgspec.Meta(description=f"{text}{end}.", **limits)
    texts: Any = enum and Literal[*enum]
    of_file = {"kind": texts | None if enum and default is None else texts, "meta": meta}
    return field(default=default, metadata={**of_file, "column": (heads, form, adjusted, text)})


@dataclass_transform(frozen_default=True, field_specifiers=(column,))
class Record(OfFields):
    """A part of the summary: its children are frozen dataclasses whose fields are declared by `column`."""

    OWN: ClassVar[Mapping[str, Column]] = {}
    """Columns of tables that are no fields."""

    def __init_subclass__(cls) -> None:
        kinds = get_annotations(cls)
        for name, one in vars(cls).items():
            if isinstance(one, Field):
                kind, meta = (one.metadata[key] for key in ("kind", "meta"))
                kinds[name] = Annotated[kind or kinds[name], meta]
        cls.__annotations__ = kinds
        dataclass(frozen=True, eq=False, repr=False)(cls)

    @classmethod
    def read(cls, found: Any) -> Self:
        """Return the record of a parsed file; keys it does not know are passed over. ValueError where it is damaged."""
        try:
            return msgspec.convert(found, cls)
        except (msgspec.ValidationError, OverflowError) as error:
            raise ValueError(str(error)) from error
        except UnicodeEncodeError as error:
            raise ValueError(f"the name {error.object!a} is no text") from error


@cache
def _hints(record: Any) -> dict[str, Any]:
    """Return types of a record's fields; Python evaluates their texts anew whenever it is asked."""
    return get_type_hints(record)


_PLAIN = frozenset({str, int, bool, NoneType})


def json_form(value: Any) -> Any:
    """Return the JSON form of a value: arrays as lists, records as mappings, numbers that are not finite as null."""
    kind: Any = type(value)
    if kind is float:  # most values
        return value if math.isfinite(value) else None
    if kind in _PLAIN or isinstance(value, (int, str)):
        return value
    if isinstance(value, (list, tuple)):
        return [json_form(item) for item in value]
    if is_record(value):
        held = ((name, getattr(value, name), optional) for name, optional in _serialized_fields(kind))
        return {name: json_form(item) for name, item, optional in held if item is not None or not optional}
    if isinstance(value, (np.ndarray, np.generic)):
        return json_form(value.tolist())
    return {str(k): json_form(v) for k, v in value.items()} if isinstance(value, Mapping) else str(value)


@cache
def _serialized_fields(kind: Any) -> list[tuple[str, bool]]:
    """Return the fields of a dataclass, and whether they are left out while None."""
    of_record = issubclass(kind, Record)  # a default is an attribute of its class
    return [(name, of_record and getattr(kind, name, 0) is None) for name in field_names(kind) if name[0] != "_"]


def flat_options(options: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return the nested options as one level, names joined by dots.

    Examples
    --------
    >>> flat_options({"tie": {"band": 1}, "overwrite": False})
    {'tie.band': 1, 'overwrite': False}
    """
    flat: dict[str, Any] = {}
    for key, value in options.items():
        if isinstance(value, Mapping) and value:
            flat |= flat_options(value, f"{before}{key}.")
        else:
            flat[before + key] = value
    return flat


# --- tables -----------------------------------------------------------------------------------------------

MAX_SHOWN = 400  # Rows of a table of the page, sentences, images and ground points on its map; files have all


@dataclass(frozen=True)
class Cell:
    """A cell: its text, its sort key, and its CSS class: a status, "number" or "name"."""

    text: str
    key: float | str
    kind: str = "number"


@dataclass(frozen=True)
class Table:
    """A table with its caption and the heads of its columns, units in them.

    `marks`: the indices of each row's images, for the page's script: one, or two with a hyphen. `meanings`: those of
    the columns, empty without one.
    """

    key: str
    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    marks: Sequence[str] = ()
    meanings: Sequence[str] = ()

    @property
    def legend(self) -> list[tuple[str, str]]:
        """Columns beside the first, which names the row, and their meaning; columns of one meaning together."""
        alike = groupby(zip(self.meanings[1:], self.columns[1:], strict=False), key=itemgetter(0))
        return [(", ".join(head for _, head in columns), meaning) for meaning, columns in alike if meaning]

    @property
    def texts(self) -> list[list[str]]:
        """Heads and cells as text, for a terminal."""
        return [list(self.columns), *([cell.text for cell in row] for row in self.rows)]


@dataclass(frozen=True)
class Column:
    """A column: its head (several: a column for each of its values), its value in a row, and as in `column`."""

    head: str | tuple[str, ...]
    value: Callable[[Any], Any]
    form: str = ""
    adjusted: bool = False
    text: str = ""

    def cells(self, row: Record) -> list[Cell]:
        """Return its cells in a row."""
        value = self.value(row)
        values = [value] if isinstance(self.head, str) else [None] * len(self.head) if value is None else value
        return [cell_of(item, self.form) for item in values]


def table(
    key: str, caption: str, rows: Sequence[Record], kind: type[Record], columns: str, adjusted: bool = True
) -> Table:
    """Return the table of records, a row each; words of `columns`: fields (``part.field``), columns of `OWN`.

    Of cameras that are not `adjusted` nothing is before or after.
    """
    found = [column_of(kind, name) for name in columns.split()]  # type: ignore[arg-type]
    found = [column for column in found if adjusted or not column.adjusted]
    cells = [[cell for column in found for cell in column.cells(row)] for row in rows]
    heads = [
        (head, column.text)
        for column in found
        for head in ([column.head] if isinstance(column.head, str) else column.head)
    ]
    words = [head if adjusted else head.replace("before", "now") for head, _ in heads]
    return Table(key, caption, words, cells, meanings=[text for _, text in heads])


@cache
def column_of(kind: Any, path: str) -> Column:
    """Return one of its own columns, or that of a field, of a part of the record where the path has dots."""
    if path in kind.OWN:
        return kind.OWN[path]  # type: ignore[no-any-return]
    for name in path.split("."):
        hint, declared = _hints(kind)[name], kind.__dataclass_fields__[name]
        parts = (hint, *get_args(hint))
        kind = next((part for part in parts if isinstance(part, type) and issubclass(part, Record)), kind)
    heads, form, adjusted, text = declared.metadata["column"]
    return Column(heads, partial(value_of, path=path), form, adjusted, text)


def value_of(record: Any, path: str) -> Any:
    """Return a field of a record, or of a part of it that may be None."""
    for name in path.split("."):
        record = None if record is None else getattr(record, name)
    return record


def cell_of(value: Any, form: str = "") -> Cell:
    """Return a value as a cell; nothing is a dash that sorts last."""
    if isinstance(value, Cell):
        return value
    if value is None or (isinstance(value, tuple) and None in value):
        return Cell("-", 1e300) if form else Cell("-", "-", "name")
    if isinstance(value, str):
        return Cell(value, 1e301) if form else Cell(value, value, "name")  # why there is no number
    if isinstance(value, tuple):
        return Cell(", ".join(format(item, form) for item in value), _key(max(map(abs, value))))
    return Cell(format(value, form) if value else "0", _key(value))


def _key(value: float) -> float:
    return float(f"{value:.6g}")
