"""Which members of a table of cases run before a commit: one of each kind; the rest wait for the slower lanes."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from typing import Any
from zlib import crc32

import pytest


def rest_slow(values: Iterable[Any], keep: int = 1, mark: pytest.MarkDecorator = pytest.mark.slow) -> list[Any]:
    """Arguments of `parametrize`: the first `keep` are fast, the others are marked.

    >>> [bool(param.marks) for param in rest_slow("abc")]
    [False, True, True]
    """
    return [_param(value, [mark] if number >= keep else []) for number, value in enumerate(values)]


def diagonal(*axes: Iterable[Any], mark: pytest.MarkDecorator = pytest.mark.slow) -> list[Any]:
    """Arguments of `parametrize` for the product of some axes: fast are as few as show every value once.

    >>> [param.values for param in diagonal("ab", (1, 2, 3)) if not param.marks]
    [('a', 1), ('b', 2), ('b', 3)]
    """
    table = [list(axis) for axis in axes]
    longest = max(map(len, table))
    shown = {tuple(min(n, len(axis) - 1) for axis in table) for n in range(longest)}
    places = product(*(range(len(axis)) for axis in table))
    return [
        pytest.param(*(axis[i] for axis, i in zip(table, place, strict=True)), marks=() if place in shown else mark)
        for place in places
    ]


def spread(count: int, few: int) -> set[int]:
    """Which of the numbers below `count` the mark `few(n)` keeps before a commit: n from the first to the last.

    >>> sorted(spread(9, 3)), sorted(spread(9, 1)), sorted(spread(2, 3))
    ([0, 4, 8], [0], [0, 1])
    """
    if few >= count:
        return set(range(count))
    return {round(k * (count - 1) / max(few - 1, 1)) for k in range(few)}


def in_turn(names: Iterable[str], part: str) -> list[str]:
    """Those of the test names whose turn it is: one of so many parts, another with each number, in another order.

    >>> names = [f"tests/test_{file}.py::test[{k}]" for file in "ab" for k in range(9)]
    >>> sorted(name for number in range(3) for name in in_turn(names, f"{number}/3")) == sorted(names)
    True
    """
    number, parts = map(int, part.split("/"))
    chosen = [name for name in names if crc32(name.encode()) % parts == number % parts]
    return sorted(chosen, key=lambda name: crc32(f"{number} {name.partition('::')[0]}".encode()))


def known(reason: str) -> pytest.MarkDecorator:
    """Mark a shortfall that docs/limits.md states, with its figures: a test that passes again fails, to be told."""
    return pytest.mark.xfail(strict=True, reason=reason)


def _param(value: Any, marks: list[pytest.MarkDecorator]) -> Any:
    """A value as a param with more marks; one that is a param already keeps its own and its id."""
    known = pytest.param(value)
    if isinstance(value, type(known)):
        return pytest.param(*value.values, marks=[*value.marks, *marks], id=value.id)
    return pytest.param(value, marks=marks)
