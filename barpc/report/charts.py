"""Charts of the report, each one SVG text, and what they are made of.

Colours are CSS variables of the page. A chart is drawn on a sheet `WIDTH` units wide, so that its text stays readable
on a phone, where a unit is about 0.85 pixels, and is not blown up on a desk, where the page caps the width.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from barpc.geodesy import Array

WIDTH = 420.0  # Units of a chart from left to right
MAX_DRAWN = 400  # Images, and ground points, on the map and in the matrix
_RIGHT = WIDTH - 12.0
_BINS = 48
MAX_DOTS = 1500  # tie points on the map


def tag(name: str, *children: str, **attributes: object) -> str:
    """Return an SVG element; `class_` is class, underscores are hyphens, numbers have two decimals at most.

    Examples
    --------
    >>> tag("text", "a &lt; b", x=1.0, text_anchor="end", class_="tick")
    '<text x="1" text-anchor="end" class="tick">a &lt; b</text>'
    >>> tag("path", d="M0 0")
    '<path d="M0 0"/>'
    """
    words = "".join(f' {key.rstrip("_").replace("_", "-")}="{_value(value)}"' for key, value in attributes.items())
    return f"<{name}{words}>{''.join(children)}</{name}>" if children else f"<{name}{words}/>"


def _value(value: object) -> str:
    return coordinate(value) if isinstance(value, (int, float)) else escape(str(value))


def coordinate(value: float) -> str:
    """Return a coordinate in as few characters as two decimals take."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def label(x: float, y: float, text: str, anchor: str = "start", class_: str = "tick") -> str:
    """Return the text at a place."""
    return tag("text", escape(text), x=x, y=y, text_anchor=anchor, class_=class_)


def shortened(name: str, most: int) -> str:
    """A name of so many characters at most: its end, which tells images of a series apart.

    Examples
    --------
    >>> shortened("view_0137", 10), shortened("IMG_PHR1A_P_0001", 6)
    ('view_0137', '…_0001')
    """
    return name if len(name) <= most else f"…{name[len(name) - most + 1 :]}"


def line(x1: float, y1: float, x2: float, y2: float, class_: str) -> str:
    """Return a straight line."""
    return tag("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=class_)


def path(points: Iterable[Sequence[float] | Array], class_: str, closed: bool = False) -> str:
    """Return a line through points."""
    text = "L".join(f"{coordinate(x)} {coordinate(y)}" for x, y in points)
    return tag("path", d=f"M{text}{'Z' if closed else ''}", class_=class_)


def titled(shape: str, title: str, **attributes: object) -> str:
    """Return a shape that says `title` under the pointer and to screen readers."""
    return tag("g", tag("title", escape(title)), shape, **attributes)


def sheet(key: str, title: str, description: str, height: float, body: Sequence[str], **more: object) -> str:
    """Return a whole chart: a key unique on the page, what it is, what it shows for those who do not see it."""
    width = more.pop("width", WIDTH)
    return tag(
        "svg",
        tag("title", escape(title), id=f"{key}-t"),
        tag("desc", escape(description), id=f"{key}-d"),
        *body,
        viewBox=f"0 0 {_value(width)} {coordinate(height)}",
        role="img",
        aria_labelledby=f"{key}-t {key}-d",
        **more,
    )


@dataclass(frozen=True)
class Scale:
    """A map from values between `low` and `high` to units between `start` and `stop`.

    `log`: equal steps are equal ratios; values below `low` go to `start`.
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
    """Return at most `most` values of a step of 1, 2 or 5 times a power of ten in an interval.

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


def x_axis(scale: Scale, top: float, bottom: float, title: str) -> list[str]:
    """Draw ticks with grid lines, numbers below, and the title with its unit below these."""
    parts = []
    for value in scale.ticks:
        x = scale(value)
        parts += [line(x, top, x, bottom, "grid"), label(x, bottom + 13, f"{value:g}", "middle")]
    return [*parts, label(scale.stop, bottom + 29, title, "end", "axis")]


def histogram(before: Array, after: Array) -> str:
    """Draw the distributions of reprojection errors (n,) [px], each to its own peak, on a logarithmic axis."""
    series = [(name, norm[norm > 0]) for name, norm in (("before", before), ("after", after))]
    series = [(name, norm) for name, norm in series if len(norm)]
    low, high = np.quantile(np.concatenate([np.ones(0), *(norm for _, norm in series)]), [0.002, 0.9995])
    scale = Scale(max(low, high * 1e-4) / 1.2, high * 1.2, 12.0, _RIGHT, log=True)
    edges = np.geomspace(scale.low, scale.high, _BINS + 1)
    top, bottom = 26.0, 170.0
    parts = x_axis(scale, top, bottom, "reprojection error [px], logarithmic")
    words = []
    for name, norm in series:
        share = np.histogram(norm.clip(scale.low, scale.high), edges)[0] / len(norm)
        up = Scale(0.0, float(share.max()), bottom, top)
        steps = [(scale(edges[0]), bottom)]
        for k, value in enumerate(share.tolist()):
            steps += [(scale(edges[k]), up(value)), (scale(edges[k + 1]), up(value))]
        area = path([*steps, (scale(edges[-1]), bottom)], f"area {name}")
        words.append(f"median {name} {np.median(norm):.3g} px")
        parts.append(titled(area, words[-1]))
    parts += legend([name for name, _ in series], _RIGHT, 14)
    title = "Histogram of reprojection errors"
    return sheet("errors-chart", title, f"{'; '.join(words)}.", bottom + 32, parts)


def legend(names: Sequence[str], right: float, y: float) -> list[str]:
    """Draw coloured dots with the names of the series, ending at `right`."""
    parts = []
    for name in reversed(names):
        parts.append(label(right, y, name, "end"))
        right -= 6.6 * len(name) + 12
        parts.append(tag("circle", cx=right, cy=y - 4, r=4.5, class_=f"dot {name}"))
        right -= 14
    return parts


def evenly(rows: Any, most: int) -> Any:
    """Return all rows, or a number of them at even steps."""
    return rows[:: max(1, -(-len(rows) // most))]
