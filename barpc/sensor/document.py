"""Fields of the XML documents in which vendors state a camera: read by path, refused by name."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import zip_longest
from typing import Any, Self, TypeVar
from xml.etree.ElementTree import Element

import numpy as np
import numpy.typing as npt

from barpc.base.errors import BarpcWarning, RpcFormatError, plain
from barpc.base.geodesy import MAX_COORDINATE, Array

T = TypeVar("T")
RELIEF_AROUND = 1000.0
"""Altitudes about that of a scene [m] that it is used for, where its document says nothing."""
MOST_PIXELS = 1_000_000
"""No image has more rows, or columns."""
LINE_TIME_TOLERANCE = 0.01
"""Rows by which line times may leave a straight line."""
GRID_TOLERANCE = 5.0
"""A grid that misses by more [px] does not belong to the orbit."""

_ISO_TIME = re.compile(r"(UTC=)?(?P<time>(?:19|20)\d\d-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d{1,9})?)Z?")


def seconds(time: Any, epoch: np.datetime64) -> Any:
    """Return the seconds (float) from an epoch, exact to the nanosecond."""
    return (time - epoch) / np.timedelta64(1, "ns") * 1e-9


def padded(rows: Iterable[npt.NDArray[Any] | list[float]]) -> Array:
    """Return rows (k, N) of coefficients of any number, with zeros behind the shorter ones."""
    return np.array([*zip_longest(*rows, fillvalue=0.0)], dtype=np.float64).T


def parse_time(text: str, name: str) -> np.datetime64:
    """Parse a UTC time such as "2021-02-16T15:12:07.524369", from 1900, perhaps with a Z behind it or "UTC=" before."""
    match = _ISO_TIME.fullmatch(text.strip())
    try:
        return np.datetime64(match["time"] if match else "none", "ns")
    except ValueError as error:
        raise RpcFormatError(f"{name}: {text[:40]!r} is not a UTC time") from error


def warn_off_grid(name: str, off: Array) -> None:
    """Warn where a product's geolocation grid misses its orbit: `off` (N, 2), samples and lines [px]."""
    worst = np.abs(off).max(axis=0)
    if not (worst <= GRID_TOLERANCE).all():
        warnings.warn(
            f"{name}: the geolocation grid does not belong to the orbit (difference {worst[0]:.1f} samples, "
            f"{worst[1]:.1f} lines); the model follows the orbit",
            BarpcWarning,
            stacklevel=4,
        )


class XmlFields:
    """Fields of an XML element; what is missing or malformed is refused by name."""

    def __init__(self, element: Element, name: str) -> None:
        self.element, self.name = element, name

    def text(self, path: str) -> str:
        """Return the text of a field; RpcFormatError where there is none."""
        text = self.element.findtext(path)
        if text is None or not text.strip():
            raise RpcFormatError(f"{self.name}: no {path} below <{self.element.tag}>; is the file complete?")
        return text.strip()

    def all(self, path: str) -> list[Self]:
        """Return every element of this path, or an empty list."""
        return [type(self)(element, self.name) for element in self.element.findall(path)]

    def one(self, path: str) -> Self:
        """Return the first element of this path; RpcFormatError where there is none."""
        found = self.element.find(path)
        if found is None:
            raise RpcFormatError(f"{self.name}: no {path} below <{self.element.tag}>; is the file complete?")
        return type(self)(found, self.name)

    def time(self, path: str) -> np.datetime64:
        """Return a UTC time; RpcFormatError where it is missing or none."""
        return parse_time(self.text(path), self.name)

    def _listed(self, path: str, between: str) -> Array:
        try:
            return np.array(self.text(path).replace(between, " ").split(), dtype=np.float64)
        except ValueError as error:
            raise RpcFormatError(f"{self.name}: {path} is not a list of numbers ({plain(error)})") from error

    def numbers(self, path: str, count: int | None = None, between: str = " ") -> Array:
        """Return the finite numbers (N,) of a field; RpcFormatError where there are none, or not `count`.

        `between` is a character that may separate them, beside blanks.
        """
        numbers = self._listed(path, between)
        if not (np.abs(numbers) <= MAX_COORDINATE).all():
            raise RpcFormatError(f"{self.name}: {path} holds a number that is not finite or absurdly large")
        if count not in (None, len(numbers)):
            raise RpcFormatError(f"{self.name}: {path} holds {len(numbers)} numbers, expected {count}")
        return numbers

    def chosen(self, path: str, choices: Mapping[str, T]) -> T:
        """Return the meaning of a field's word; RpcFormatError where it is none of the `choices`."""
        word = self.text(path)
        if word not in choices:
            raise RpcFormatError(f"{self.name}: {path} is {word[:20]!r}, expected {' or '.join(choices)}")
        return choices[word]

    def number(self, path: str) -> float:
        """Return the only number of a field."""
        return float(self.numbers(path, 1)[0])

    def size(self, cols: str, rows: str) -> tuple[int, int]:
        """Return the width and height [px] of an image."""
        return int(self.positive(cols, MOST_PIXELS)), int(self.positive(rows, MOST_PIXELS))

    def positive(self, path: str, most: float = MAX_COORDINATE) -> float:
        """Return the first number of a field; RpcFormatError where it is not above 0 and at most `most`."""
        value = float(self.numbers(path)[0])
        if not 0 < value <= most:
            raise RpcFormatError(f"{self.name}: {path} is {value:g}, expected above 0 and at most {most:g}")
        return value


def table_of(rows: Sequence[XmlFields], tags: Sequence[str]) -> Array:
    """Return a finite number of each tag (N, K) of elements (N,); RpcFormatError where one is missing or none.

    24,000 detectors at once: field by field they take a second.
    """
    with suppress(TypeError, ValueError):
        found = np.array([[row.element.findtext(tag) for tag in tags] for row in rows], dtype=np.float64)
        if (np.abs(found) <= MAX_COORDINATE).all():
            return found.reshape(-1, len(tags))
    return np.array([[row.number(tag) for tag in tags] for row in rows])
