"""The few pieces that charts are made of: tags, scales, axes. Colours are CSS variables of the page.

A chart is drawn on a sheet `WIDTH` units wide, so that its text stays readable on a phone, where a unit is
about 0.85 pixels, and is not blown up on a desk, where the page caps the width.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

WIDTH = 420.0
"""Units of a chart from left to right."""
ROW = 17.0
"""Units from one row of a list chart to the next."""
MAX_ROWS = 24
"""A list chart shows so many rows, the most telling ones."""


def tag(name: str, *children: str, **attributes: object) -> str:
    """An element; `class_` is class, underscores are hyphens, numbers have two decimals at most.

    Examples
    --------
    >>> tag("text", "a &lt; b", x=1.0, text_anchor="end", class_="tick")
    '<text x="1" text-anchor="end" class="tick">a &lt; b</text>'
    >>> tag("path", d="M0 0")
    '<path d="M0 0"/>'
    """
    words = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{_value(value)}"' for key, value in attributes.items()
    )
    return f"<{name}{words}>{''.join(children)}</{name}>" if children else f"<{name}{words}/>"


def _value(value: object) -> str:
    return number(value) if isinstance(value, (int, float)) else escape(str(value))


def number(value: float) -> str:
    """A coordinate in as few characters as two decimals take."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def label(x: float, y: float, text: str, anchor: str = "start", class_: str = "tick") -> str:
    """Text at a place."""
    return tag("text", escape(text), x=x, y=y, text_anchor=anchor, class_=class_)


def line(x1: float, y1: float, x2: float, y2: float, class_: str) -> str:
    """A straight line."""
    return tag("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=class_)


def path(points: Iterable[Sequence[float]], class_: str, closed: bool = False) -> str:
    """A line through points."""
    text = "L".join(f"{number(x)} {number(y)}" for x, y in points)
    return tag("path", d=f"M{text}{'Z' if closed else ''}", class_=class_)


def titled(shape: str, title: str) -> str:
    """A shape that says `title` under the pointer and to screen readers."""
    return tag("g", tag("title", escape(title)), shape)


def sheet(key: str, title: str, description: str, height: float, body: Sequence[str], **more: object) -> str:
    """A whole chart: an SVG image with its title and description.

    Parameters
    ----------
    key : str
        Unique on the page.
    title, description : str
        What it is; what it shows, in words, for those who do not see it.
    height : float
        Units.
    body : sequence of str
        Elements.
    **more
        `width` where it is not `WIDTH`; other attributes.
    """
    width = more.pop("width", WIDTH)
    return tag(
        "svg",
        tag("title", escape(title), id=f"{key}-t"),
        tag("desc", escape(description), id=f"{key}-d"),
        *body,
        viewBox=f"0 0 {_value(width)} {number(height)}",
        role="img",
        aria_labelledby=f"{key}-t {key}-d",
        **more,
    )


@dataclass(frozen=True)
class Scale:
    """A map from values to units of the sheet.

    Parameters
    ----------
    low, high : float
        The values at the ends.
    start, stop : float
        The units there.
    log : bool
        Whether equal steps are equal ratios; values below `low` go to `start`.
    """

    low: float
    high: float
    start: float
    stop: float
    log: bool = False

    def __call__(self, value: float) -> float:
        """The place of a value."""
        low, high = self.low, self.high
        if self.log:
            low, high, value = math.log10(low), math.log10(high), math.log10(max(value, low))
        share = (value - low) / (high - low)
        return self.start + (self.stop - self.start) * share

    @property
    def ticks(self) -> list[float]:
        """Round values between the ends: powers of ten of a logarithmic scale, with 2 and 5 where few."""
        if not self.log:
            return round_ticks(self.low, self.high)
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        steps = (1, 2, 5) if last - first <= 2 else (1, 3) if last - first <= 3 else (1,)
        values = [step * 10.0**power for power in range(first, last + 1) for step in steps]
        return [value for value in values if self.low * 0.999 <= value <= self.high * 1.001]


def round_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """At most `most` values of a step of 1, 2 or 5 times a power of ten in an interval.

    Examples
    --------
    >>> round_ticks(-0.3, 1.1)
    [0.0, 0.5, 1.0]
    """
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * s for s in (1, 2, 5, 10) if power * s >= raw * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, last + 1)]


def log_scale(values: Sequence[float], start: float, stop: float, floor: float = 1e-12) -> Scale:
    """A logarithmic scale that holds all positive values with a margin."""
    positive = [value for value in values if value > floor] or [1.0]
    low, high = min(positive), max(positive)
    return Scale(low / 1.25, max(high * 1.25, low * 4), start, stop, log=True)


def x_axis(scale: Scale, top: float, bottom: float, title: str) -> list[str]:
    """Ticks with grid lines, numbers below, and the title with its unit below these."""
    parts = []
    for value in scale.ticks:
        x = scale(value)
        parts += [line(x, top, x, bottom, "grid"), label(x, bottom + 13, f"{value:g}", "middle")]
    return [*parts, label(scale.stop, bottom + 29, title, "end", "axis")]


def numbered(names: Sequence[str], most: int = 15) -> list[str]:
    """Names behind their number in the table of images, cut in their middle, where they tell least apart.

    Examples
    --------
    >>> numbered(["IMG_PHR1A_P_201304171032_SEN_001", "a"])
    ['1 IMG_PH…EN_001', '2 a']
    """
    out = []
    for k, name in enumerate(names):
        room = most - len(str(k + 1)) - 1
        tail = (room - 1) // 2
        short = name if len(name) <= room else f"{name[: room - 1 - tail]}…{name[-tail:]}"
        out.append(f"{k + 1} {short}")
    return out
