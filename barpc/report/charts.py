"""Charts of the report: errors before and after, pairs, geometry, corrections. Each is one SVG text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from barpc.geodesy import Array
from barpc.report.svg import (
    MAX_ROWS,
    ROW,
    WIDTH,
    Scale,
    label,
    line,
    log_scale,
    path,
    sheet,
    tag,
    titled,
    x_axis,
)

Record = Mapping[str, Any]

_NAMES = 128.0  # units kept free for names on the left
_RIGHT = WIDTH - 12.0
_BINS = 48


def histogram(before: Array, after: Array) -> str:
    """Distributions of reprojection errors (n,) [px], before and after, each to its own peak, on a logarithmic axis."""
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
    return sheet(
        "errors-chart", "Histogram of reprojection errors", f"{'; '.join(words)}.", bottom + 32, parts
    )


def legend(names: Sequence[str], right: float, y: float) -> list[str]:
    """Coloured dots with the names of the series, ending at `right`."""
    parts = []
    for name in reversed(names):
        parts.append(label(right, y, name, "end"))
        right -= 6.6 * len(name) + 12
        parts.append(tag("circle", cx=right, cy=y - 4, r=4.5, class_=f"dot {name}"))
        right -= 14
    return parts


@dataclass(frozen=True)
class Row:
    """A row of a list chart: its short label, its full name, its value before and after (None: there is none)."""

    label: str
    name: str
    before: float | None
    after: float | None

    @property
    def last(self) -> float:
        """The value that counts."""
        return (self.before if self.after is None else self.after) or 0.0


def dumbbells(key: str, title: str, axis: str, rows: Sequence[Row]) -> str:
    """A row a name with a value before and one after, on a logarithmic axis.

    Parameters
    ----------
    key, title, axis : str
        Identity; what it is; the axis' title with its unit.
    rows : sequence of Row
        Of more than `MAX_ROWS` the largest are shown.
    """
    shown = most_telling(rows, lambda row: -row.last)
    scale = log_scale([value for row in shown for value in (row.before, row.after) if value], _NAMES, _RIGHT)
    bottom = 24 + ROW * len(shown)
    parts = x_axis(scale, 24, bottom, axis)
    for k, row in enumerate(shown):
        y = 24 + ROW * (k + 0.5)
        parts.append(titled(label(_NAMES - 8, y + 4, row.label, "end"), row.name))
        if row.before and row.after:
            parts.append(line(scale(row.before), y, scale(row.after), y, "link"))
        for when, value in (("before", row.before), ("after", row.after)):
            if value:
                dot = tag("circle", cx=scale(value), cy=y, r=4.5, class_=f"dot {when}")
                parts.append(titled(dot, f"{row.name}: {when} {value:.3g}"))
    parts += legend(["before", "after"] if any(row.after for row in shown) else ["before"], _RIGHT, 13)
    described = f"{len(shown)} of {len(rows)} rows; the figures are in the table."
    return sheet(key, title, described, bottom + 34, parts)


def most_telling(rows: Sequence[Any], order: Any) -> list[Any]:
    """All rows as they come, or the first `MAX_ROWS` by an order where there are more."""
    return list(rows) if len(rows) <= MAX_ROWS else sorted(rows, key=order)[:MAX_ROWS]


def connections(views: Sequence[Record], pairs: Sequence[Record]) -> str:
    """The images on a circle, numbered as in the table; a line for each pair, thicker with more matches."""
    num, middle, radius = len(views), WIDTH / 2, 150.0
    angle = [2 * math.pi * k / num - math.pi / 2 for k in range(num)]
    place = [(middle + radius * math.cos(a), 175 + radius * math.sin(a)) for a in angle]
    index = {view["name"]: k for k, view in enumerate(views)}
    most = max([pair["num_matches"] for pair in pairs], default=1)
    parts = []
    for pair in sorted(pairs, key=lambda p: p["num_matches"])[-1500:]:
        (x1, y1), (x2, y2) = place[index[pair["a"]]], place[index[pair["b"]]]
        share = math.sqrt(pair["num_matches"] / most)
        link = tag(
            "line", x1=x1, y1=y1, x2=x2, y2=y2, class_="tie", stroke_width=0.5 + 5.5 * share / max(num / 8, 1),
            stroke_opacity=0.15 + 0.65 * share,
        )  # fmt: skip
        parts.append(titled(link, f"{pair['a']} - {pair['b']}: {pair['num_matches']} matches"))
    size = 12.0 if num <= 24 else max(3.0, 290.0 / num)
    for k, view in enumerate(views):
        x, y = place[k]
        node = tag("circle", cx=x, cy=y, r=size, class_=f"node {view['status']}")
        text = label(x, y + 4, str(k + 1), "middle", "nodename") if num <= 40 else ""
        parts.append(titled(node + text, f"{k + 1} {view['name']}: {view['num_observations']} tie points"))
    described = f"{num} images, {len(pairs)} pairs with tie points in common; up to {most} matches a pair."
    return sheet("graph-chart", "Graph of the images and their pairs", described, 350, parts)


def convergence(pairs: Sequence[Record]) -> str:
    """Matches of each pair over its convergence angle; heights are weak on the left, matching on the right."""
    shown = [pair for pair in pairs if pair["convergence_deg"] is not None]
    high = max([pair["convergence_deg"] for pair in shown], default=1.0)
    x = Scale(0.0, max(high * 1.08, 8.0), 44.0, _RIGHT)
    y = log_scale([pair["num_matches"] for pair in shown], 190.0, 44.0)
    parts = []
    for low, up, words in ((0.0, 5.0, "weak heights"), (5.0, 35.0, "good"), (35.0, 180.0, "hard to match")):
        if low < x.high:
            left, right = x(low), x(min(up, x.high))
            parts.append(
                tag("rect", x=left, y=30, width=right - left, height=160, class_=f"zone {words.split()[0]}")
            )
            if right - left > 6.6 * len(words):
                parts.append(label((left + right) / 2, 26, words, "middle"))
    parts += x_axis(x, 30, 190, "convergence angle [deg]")
    for value in y.ticks:
        parts += [line(44, y(value), _RIGHT, y(value), "grid"), label(40, y(value) + 4, f"{value:g}", "end")]
    parts.append(label(4, 12, "matches", class_="axis"))
    for pair in shown:
        dot = tag(
            "circle", cx=x(pair["convergence_deg"]), cy=y(pair["num_matches"]), r=4.5, class_="dot after see"
        )
        words = f"{pair['a']} - {pair['b']}: {pair['convergence_deg']:.1f} deg, {pair['num_matches']} matches"
        parts.append(titled(dot, words))
    described = f"{len(shown)} pairs, up to {high:.1f} degrees."
    return sheet("angles-chart", "Matches of each pair over its convergence angle", described, 222, parts)


def corrections(views: Sequence[Record], labels: Sequence[str]) -> str:
    """How far each camera was moved in its image, col and row; with one sigma where that fits on the chart."""
    rows = [
        (text, v["name"], v["correction"]["center_shift_px"], v["correction"]["center_sigma_px"])
        for text, v in zip(labels, views, strict=True)
    ]
    shown = most_telling(rows, lambda row: -max(map(abs, row[2])))
    largest = max(abs(value) for row in shown for value in row[2]) or 1e-3
    spread = max(sigma for row in shown for sigma in row[3])
    bars = spread <= 2 * largest
    reach = 1.1 * (largest + spread * bars)
    scale = Scale(-reach, reach, _NAMES, _RIGHT)
    bottom = 24 + ROW * len(shown)
    parts = x_axis(
        scale, 24, bottom, f"shift in the middle of the image{', with one sigma' if bars else ''} [px]"
    )
    parts.append(line(scale(0), 24, scale(0), bottom, "zero"))
    for k, (text, name, shift, sigma) in enumerate(shown):
        middle = 24 + ROW * (k + 0.5)
        parts.append(titled(label(_NAMES - 8, middle + 4, text, "end"), name))
        for axis, value, error, y in zip(("col", "row"), shift, sigma, (middle - 4, middle + 4), strict=True):
            left, right = (value - error, value + error) if bars else (min(value, 0.0), max(value, 0.0))
            dot = tag("circle", cx=scale(value), cy=y, r=3.5, class_=f"dot {axis}")
            words = f"{name}, {axis}: {value:+.2f} ± {error:.2f} px"
            parts.append(titled(line(scale(left), y, scale(right), y, f"bar {axis}") + dot, words))
    parts += legend(["col", "row"], _RIGHT, 13)
    described = f"{len(shown)} of {len(rows)} images; the largest shift is {largest:.2g} px."
    return sheet("moves-chart", "Shift of each camera in its image", described, bottom + 34, parts)
