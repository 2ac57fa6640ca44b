"""Fields of the XML documents in which vendors state a camera: read by path, refused by name."""

from __future__ import annotations

from typing import Self
from xml.etree.ElementTree import Element

import numpy as np

from barpc.errors import RpcFormatError
from barpc.geodesy import Array

LARGEST = 1e9
"""No number of a document comes near."""


class Fields:
    """Fields of an XML element; what is missing or malformed is refused by name."""

    def __init__(self, element: Element, name: str) -> None:
        self.element, self.name = element, name

    def text(self, path: str) -> str:
        """The text of a field; RpcFormatError where there is none."""
        text = self.element.findtext(path)
        if text is None or not text.strip():
            raise RpcFormatError(f"{self.name}: no {path} below <{self.element.tag}>; is the file complete?")
        return text.strip()

    def all(self, path: str) -> list[Self]:
        """Every element of this path, none too."""
        return [type(self)(element, self.name) for element in self.element.findall(path)]

    def numbers(self, path: str) -> Array:
        """The finite numbers (N,) of a field; RpcFormatError where it is missing or holds others."""
        try:
            numbers = np.array(self.text(path).split(), dtype=np.float64)
        except ValueError as error:
            raise RpcFormatError(f"{self.name}: {path} is not a list of numbers ({error})") from error
        if not (np.abs(numbers) <= LARGEST).all():
            raise RpcFormatError(f"{self.name}: {path} holds a number that is not finite or absurdly large")
        return numbers

    def positive(self, path: str, most: float = LARGEST) -> float:
        """The first number of a field; RpcFormatError where it is not above 0 and at most `most`."""
        value = float(self.numbers(path)[0])
        if not 0 < value <= most:
            raise RpcFormatError(f"{self.name}: {path} is {value:g}, expected above 0 and at most {most:g}")
        return value
