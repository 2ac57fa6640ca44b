"""The fields of dataclasses: the one walk over them for keys, kept results, JSON, notebooks, options and docs."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from typing import Any


def is_record(value: object) -> bool:
    """Return whether a value is an instance of a dataclass."""
    return hasattr(type(value), "__dataclass_fields__")


@cache
def field_names(kind: Any) -> tuple[str, ...]:
    """Return the names of the fields that the constructor of a dataclass is given."""
    return tuple(one.name for one in fields(kind) if one.init)


def given(record: Any) -> dict[str, Any]:
    """Return the values that the constructor of a record was given, by name."""
    return {name: getattr(record, name) for name in field_names(record.__class__)}


class Value:
    """Base of frozen dataclasses declared with ``eq=False, repr=False``: equal by what they were given, in one line.

    Written here once: for each class apart they cost a fifth of its import.
    """

    def _told(self) -> str:
        """Return the fields to be printed."""
        return ", ".join(f"{name}={value!r}" for name, value in given(self).items())

    def _content(self) -> tuple[object, ...]:
        return tuple(given(self).values())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._told()})"

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and isinstance(other, Value) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())
