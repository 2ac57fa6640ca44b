"""Typed records: the declaration of a field gives its JSON schema, its column in tables and its line in the docs.

A field with a default is optional: it is left out of the file while it is None, and older files need not have it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from functools import cache, partial
from types import NoneType, UnionType
from typing import Any, ClassVar, Self, Union, dataclass_transform, get_args, get_origin, get_type_hints

import numpy as np

from barpc.base.options import schema_of

Number = float | None  # A number; None (null) stands for what is not finite


def column(
    text: str,
    unit: str = "",
    head: str | tuple[str, ...] = "",
    form: str = "",
    *,
    adjusted: bool = False,
    default: Any = MISSING,
    **schema: Any,
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
    default, **schema
        None for an optional value; more words of its JSON schema.
    """
    end = f" [{unit}]" if unit else ""
    heads = f"{head}{end}" if isinstance(head, str) else tuple(f"{words}{end}" for words in head)
    more = {**schema, "description": f"{text}{end}."}
    return field(default=default, metadata={"schema": more, "column": (heads, form, adjusted)})


@dataclass_transform(frozen_default=True, field_specifiers=(column,))
class Record:
    """A part of the summary: its children are frozen dataclasses whose fields are declared by `column`."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    OWN: ClassVar[Mapping[str, Column]] = {}
    """Columns of tables that are no fields."""
    MORE: ClassVar[Any] = None
    """Type of values beyond the fields that a file may hold; None: there must be none."""

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True)(cls)

    @classmethod
    def read(cls, found: Mapping[str, Any]) -> Self:
        """Return the record of a file's validated content; what it does not know is passed over."""
        readers = _field_readers(cls)  # type: ignore[arg-type]  # a class can be hashed
        known = ((key, value, readers[key]) for key, value in found.items() if key in readers)
        return cls(**{key: read(item) if read and item is not None else item for key, item, read in known})

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """Return its JSON schema."""
        hints = get_type_hints(cls, include_extras=True)
        words = {one.name: {**schema_of(hints[one.name]), **one.metadata["schema"]} for one in fields(cls)}
        return {
            "type": "object",
            "properties": words,
            "required": [field.name for field in fields(cls) if field.default is MISSING],
            "additionalProperties": False if cls.MORE is None else schema_of(cls.MORE),
        }


@cache
def _hints(record: Any) -> dict[str, Any]:
    """Return types of a record's fields; Python evaluates their texts anew whenever it is asked."""
    return get_type_hints(record)


@cache
def _field_readers(record: Any) -> dict[str, Callable[[Any], Any] | None]:
    hints = _hints(record)
    return {field.name: _reader(hints[field.name]) for field in fields(record)}


def _reader(kind: Any) -> Callable[[Any], Any] | None:
    """Return the function from JSON to a value of a type; None where it stays as it is."""
    if get_origin(kind) in (Union, UnionType):
        kind = next(part for part in get_args(kind) if part is not NoneType)
    if isinstance(kind, type) and issubclass(kind, Record):
        return kind.read
    if get_origin(kind) is not tuple:
        return None
    item = _reader(get_args(kind)[0])
    return tuple if item is None else lambda values: tuple(map(item, values))


_PLAIN = frozenset({str, int, bool, NoneType})


def json_form(value: Any, keep: bool = False) -> Any:
    """Return the JSON form of a value: arrays as lists, records as mappings, numbers that are not finite as null.

    With `keep` as it is read from there: records stay what they are, lists become tuples.
    """
    kind: Any = type(value)
    if kind is float:  # most values
        return value if math.isfinite(value) else None
    if kind in _PLAIN or isinstance(value, (int, str)):
        return value
    if isinstance(value, (list, tuple)):
        found = [json_form(item, keep) for item in value]
        return tuple(found) if keep else found
    if is_dataclass(value) and not isinstance(value, type):
        held = ((name, getattr(value, name), optional) for name, optional in _serialized_fields(kind))
        items = {name: json_form(item, keep) for name, item, optional in held if item is not None or not optional}
        return kind(**items) if keep else items
    if isinstance(value, (np.ndarray, np.generic)):
        return json_form(value.tolist(), keep)
    return {str(k): json_form(v) for k, v in value.items()} if isinstance(value, Mapping) else str(value)


@cache
def _serialized_fields(kind: Any) -> list[tuple[str, bool]]:
    """Return the fields of a dataclass, and whether they are left out while None."""
    of_record = issubclass(kind, Record)
    return [(f.name, of_record and f.default is None) for f in fields(kind) if f.name[0] != "_"]


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

    `marks`: the indices of each row's images, for the page's script: one, or two with a hyphen.
    """

    key: str
    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    marks: Sequence[str] = ()

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
    heads = [[column.head] if isinstance(column.head, str) else column.head for column in found]
    words = [head if adjusted else head.replace("before", "now") for some in heads for head in some]
    return Table(key, caption, words, cells)


@cache
def column_of(kind: Any, path: str) -> Column:
    """Return one of its own columns, or that of a field, of a part of the record where the path has dots."""
    if path in kind.OWN:
        return kind.OWN[path]  # type: ignore[no-any-return]
    for name in path.split("."):
        hint, declared = _hints(kind)[name], kind.__dataclass_fields__[name]
        parts = (hint, *get_args(hint))
        kind = next((part for part in parts if isinstance(part, type) and issubclass(part, Record)), kind)
    heads, form, adjusted = declared.metadata["column"]
    return Column(heads, partial(value_of, path=path), form, adjusted)


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
