"""Types and words that the records of summary.json share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any

import numpy as np

from barpc.report.records import Number

STATUS_WORDS = {
    "adjusted": "adjusted",
    "consistent": "consistent",
    "tied": "tied",
    "weak": "weakly tied",
    "doubtful": "doubtful",
    "failed": "not adjusted",
}
"""Status of a view -> what people read, from good to bad."""

Count = Annotated[int, {"minimum": 0}]
Side = Annotated[int, {"minimum": 1}]
Share = Annotated[float, {"minimum": 0, "maximum": 1}]
Pixel = tuple[Number, Number]
Vector = tuple[Number, Number, Number]
ABOVE = "m above the ellipsoid"


def largest(values: Sequence[float | None] | None) -> float | None:
    """Return the largest number; None where one is missing, which may be larger."""
    return None if not values or None in values else max(value for value in values if value is not None)


NAMED = 5
"""Images, points or reasons that one sentence names."""


def listed(names: Sequence[str], most: int = 10) -> str:
    """Return the names in a sentence."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def counted(number: int, what: str) -> str:
    """A number of things.

    Examples
    --------
    >>> counted(1, "image"), counted(2, "image")
    ('1 image', '2 images')
    """
    return f"{number} {what}{'' if number == 1 else 's'}"


def median(values: Iterable[float | None]) -> float:
    """Return the median of the finite numbers; NaN without any."""
    found = np.array(list(values), dtype=np.float64)
    found = found[np.isfinite(found)]
    return float(np.median(found)) if len(found) else float("nan")


def known(value: float | None) -> float:
    """Return a number, NaN where there is none."""
    return float("nan") if value is None else value


def percent(share: float | None) -> float | None:
    """Return a share in percent."""
    return None if share is None else 100 * share


def percent_of(name: str) -> Callable[[Any], float | None]:
    """Return what makes percent of a field of a record."""
    return lambda record: percent(getattr(record, name))


def metres(value: float) -> str:
    """Return a length with a unit that keeps it readable.

    Examples
    --------
    >>> metres(3.14159), metres(0.0421), metres(0.00012)
    ('3.1 m', '4.2 cm', '0.1 mm')
    """
    for factor, unit in ((1.0, "m"), (1e2, "cm"), (1e3, "mm")):
        if abs(value) * factor >= 1.0:
            return f"{value * factor:.1f} {unit}"
    return f"{value * 1e3:.1f} mm"
