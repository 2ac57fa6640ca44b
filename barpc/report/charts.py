"""Charts and maps of the report, each one SVG text: errors, pairs, geometry, corrections, residuals.

Colours are CSS variables of the page. A chart is drawn on a sheet `WIDTH` units wide, so that its text stays readable
on a phone, where a unit is about 0.85 pixels, and is not blown up on a desk, where the page caps the width.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from operator import itemgetter
from typing import Any

import numpy as np

from barpc.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.report.summary import CELLS, CheckPointEntry, GcpEntry, PairEntry, ViewEntry, cell_numbers
from barpc.report.tables import Observations, RunFiles

WIDTH = 420.0  # Units of a chart from left to right
ROW = 17.0  # Units from one row of a list chart to the next
MAX_ROWS = 24  # A list chart shows so many rows, the most telling ones
MAX_DRAWN = 400  # Images, and ground points, on the map and the graph
_NAMES = 128.0  # units kept free for names on the left
_RIGHT = WIDTH - 12.0
_BINS = 48
_MOST_LINKS = 1500
_MARGIN = 34.0
MAX_DOTS = 1500
_APART = 26.0
_AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
_MOST = 60  # images on the page: those with the largest systematic part
_VECTORS = 6000
_PANEL = 180.0
_REACH = 12.0  # units of a long residual

Link = tuple[Sequence[float] | Array, Sequence[float] | Array, int, str]
"""Two places (x, y), the matches between them, a title."""
Known = GcpEntry | CheckPointEntry


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
    return "0" if text == "-0" else text


def label(x: float, y: float, text: str, anchor: str = "start", class_: str = "tick") -> str:
    """Text at a place."""
    return tag("text", escape(text), x=x, y=y, text_anchor=anchor, class_=class_)


def line(x1: float, y1: float, x2: float, y2: float, class_: str) -> str:
    """A straight line."""
    return tag("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=class_)


def path(points: Iterable[Sequence[float] | Array], class_: str, closed: bool = False) -> str:
    """A line through points."""
    text = "L".join(f"{number(x)} {number(y)}" for x, y in points)
    return tag("path", d=f"M{text}{'Z' if closed else ''}", class_=class_)


def titled(shape: str, title: str) -> str:
    """A shape that says `title` under the pointer and to screen readers."""
    return tag("g", tag("title", escape(title)), shape)


def sheet(key: str, title: str, description: str, height: float, body: Sequence[str], **more: object) -> str:
    """A whole chart: a key unique on the page, what it is, what it shows for those who do not see it, its elements."""
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
    """A row a name with a value before and one after, on a logarithmic axis; of more than `MAX_ROWS` the largest."""
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


def evenly(rows: Sequence[Any], most: int) -> Sequence[Any]:
    """All rows, or so many of them as they come at even steps."""
    return rows[:: max(1, -(-len(rows) // most))]


def connections(files: RunFiles) -> str:
    """The images on a circle, numbered as in the table; a line for each pair, thicker with more matches."""
    views, pairs, index = files.summary.views, files.summary.pairs, files.number
    num, radius = len(views), 150.0
    angle = [2 * math.pi * k / num - math.pi / 2 for k in range(num)]
    place = [(WIDTH / 2 + radius * math.cos(a), 175 + radius * math.sin(a)) for a in angle]
    links = [(place[index[p.a]], place[index[p.b]], p.num_matches, f"{p.a} - {p.b}") for p in pairs]
    parts = _ties(links, (0.5, 5.5 / max(num / 8, 1)), (0.15, 0.65))
    size = 12.0 if num <= 24 else max(3.0, 290.0 / num)
    for k, (view, (x, y)) in enumerate(zip(views, place, strict=True), 1):
        node = tag("circle", cx=x, cy=y, r=size, class_=f"node {view.status}")
        text = label(x, y + 4, str(k), "middle", "nodename") if num <= 40 else ""
        parts.append(titled(node + text, f"{k} {view.name}: {view.num_observations} tie points"))
    most = max([pair.num_matches for pair in pairs], default=1)
    described = f"{num} images, {len(pairs)} pairs with tie points in common; up to {most} matches a pair."
    return sheet("graph-chart", "Graph of the images and their pairs", described, 350, parts)


def _ties(links: Sequence[Link], width: tuple[float, float], opacity: tuple[float, float]) -> list[str]:
    """Lines of least width and opacity, and by how much those of the link with the most matches are above these."""
    most, parts = max([count for *_, count, _ in links], default=1), []
    for (x1, y1), (x2, y2), count, title in sorted(links, key=itemgetter(2))[-_MOST_LINKS:]:
        share = math.sqrt(count / most)
        style = {
            "stroke_width": width[0] + width[1] * share,
            "stroke_opacity": opacity[0] + opacity[1] * share,
        }
        shape = tag("line", x1=x1, y1=y1, x2=x2, y2=y2, class_="tie", **style)
        parts.append(titled(shape, f"{title}: {count} matches"))
    return parts


def convergence(pairs: Sequence[PairEntry]) -> str:
    """Matches of each pair over its convergence angle; heights are weak on the left, matching on the right."""
    angles = [pair.convergence_deg or 0.0 for pair in pairs]
    high = max(angles, default=1.0)
    x = Scale(0.0, max(high * 1.08, 8.0), 44.0, _RIGHT)
    y = log_scale([pair.num_matches for pair in pairs], 190.0, 44.0)
    parts = []
    for low, up, words in ((0.0, 5.0, "weak heights"), (5.0, 35.0, "good"), (35.0, 180.0, "hard to match")):
        if low < x.high:
            left, right = x(low), x(min(up, x.high))
            zone = f"zone {words.split()[0]}"
            parts.append(tag("rect", x=left, y=30, width=right - left, height=160, class_=zone))
            if right - left > 6.6 * len(words):
                parts.append(label((left + right) / 2, 26, words, "middle"))
    parts += x_axis(x, 30, 190, "convergence angle [deg]")
    for value in y.ticks:
        parts += [line(44, y(value), _RIGHT, y(value), "grid"), label(40, y(value) + 4, f"{value:g}", "end")]
    parts.append(label(4, 12, "matches", class_="axis"))
    for pair, angle in evenly(list(zip(pairs, angles, strict=True)), MAX_DOTS):
        dot = tag("circle", cx=x(angle), cy=y(pair.num_matches), r=4.5, class_="dot after see")
        parts.append(titled(dot, f"{pair.a} - {pair.b}: {angle:.1f} deg, {pair.num_matches} matches"))
    described = f"{len(pairs)} pairs, up to {high:.1f} degrees."
    return sheet("angles-chart", "Matches of each pair over its convergence angle", described, 222, parts)


def moves_of(views: Sequence[ViewEntry]) -> list[tuple[Any, Any]]:
    """Shift and sigma (col, row) [px] of the views whose correction states both."""
    moves = [view.correction for view in views if view.correction]
    both = [(move.center_shift_px, move.center_sigma_px) for move in moves]
    return [(shift, sigma) for shift, sigma in both if shift and sigma and None not in (*shift, *sigma)]


def corrections(views: Sequence[ViewEntry]) -> str:
    """How far each camera was moved in its image, col and row; with one sigma where that fits on the chart."""
    names = [view.name for view in views]
    rows = [(*both, *move) for *both, move in zip(numbered(names), names, moves_of(views), strict=True)]
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


# --- maps -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Plane:
    """Local map, true to scale in its middle (lon, lat [deg]), north up.

    `unit` (2,): units of the sheet per degree of longitude and latitude; `scale`: a metre; `height`: of the sheet.
    """

    lon: float
    lat: float
    unit: Array
    height: float
    scale: float

    def __call__(self, lonlat: Array) -> Array:
        """Places (..., 2) on the sheet of lon, lat [deg] (..., 2)."""
        east = (wrap_longitude(lonlat[..., 0], self.lon) - self.lon) * self.unit[0]
        north = (lonlat[..., 1] - self.lat) * self.unit[1]
        return np.stack([WIDTH / 2 + east, self.height / 2 - north], axis=-1)


def _plane_of(lonlat: Array) -> Plane:
    """The map on which points (n, 2) [deg] fill the sheet."""
    lonlat = np.column_stack([wrap_longitude(lonlat[:, 0], lonlat[0, 0]), lonlat[:, 1]])
    low, high = lonlat.min(axis=0), lonlat.max(axis=0)
    lon, lat = ((low + high) / 2).tolist()
    per_degree = metres_per_unit(np.array([lon, lat, 0.0]))[:2]
    extent = np.maximum((high - low) * per_degree, 1.0)
    scale = float(min((WIDTH - 2 * _MARGIN) / extent[0], 420.0 / extent[1]))
    return Plane(lon, lat, per_degree * scale, float(extent[1] * scale) + 2 * _MARGIN + 24, scale)


def ground_map(files: RunFiles) -> str:
    """Footprints, pairs by their matches, tie points, GCPs, on a graticule with a scale bar."""
    summary = files.summary
    rings = [ring for outline in files.outlines for ring in outline]
    points_of: dict[str, Sequence[Known]] = {"gcps": summary.gcps, "check_points": summary.check_points}
    known = {
        kind: np.array([(point.lon, point.lat) for point in places], dtype=np.float64).reshape(-1, 2)
        for kind, places in points_of.items()
    }
    plane = _plane_of(np.concatenate([*rings, files.points[:, :2], *known.values()]))
    grid, degrees = _graticule(plane)
    points = plane(files.points[:: max(1, -(-len(files.points) // MAX_DOTS)), :2])
    parts = [*grid, *(tag("circle", cx=x, cy=y, r=1.1, class_="point") for x, y in points)]
    for view, outline in evenly(list(zip(summary.views, files.outlines, strict=True)), MAX_DRAWN):
        shape = "".join(path(plane(ring[:-1]), f"outline {view.status}", closed=True) for ring in outline)
        parts.append(titled(shape, f"{view.name}: {view.num_observations} tie points"))
    stacks = _stacks(plane, files.outlines)
    parts += _pair_lines(stacks, files)
    if len(stacks) <= 100:
        parts += [
            label(stack.place[0], stack.place[1] + 4, stack.text, "middle", "stack") for stack in stacks
        ]
    for kind, places in known.items():
        up = 1 if kind == "gcps" else -1
        for point, (x, y) in evenly(list(zip(points_of[kind], plane(places), strict=True)), MAX_DRAWN):
            ends = [(x, y - 6 * up), (x + 5, y + 4 * up), (x - 5, y + 4 * up)]
            parts.append(titled(path(ends, kind, closed=True), point.name))
    described = (
        f"{len(summary.views)} outlines, {len(summary.pairs)} pairs, {len(known['gcps'])} GCPs, "
        f"{len(known['check_points'])} check points."
    )
    return sheet("ground", "Map of the images", described, plane.height, [*parts, *degrees])


@dataclass(frozen=True, eq=False)
class Stack:
    """Images that lie over each other on the map: their indices, and the place (2,) of their middle."""

    views: list[int]
    place: Array

    @property
    def text(self) -> str:
        """Their numbers, runs of them as 1-3."""
        numbers = np.array(self.views) + 1
        runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
        words = [f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs]
        return ", ".join(words) if len(words) <= 4 else f"{', '.join(words[:3])} …"


def _stacks(plane: Plane, outlines: Sequence[Sequence[Array]]) -> list[Stack]:
    """Images whose middles stand nearer than their numbers are wide."""
    stacks: list[Stack] = []
    cells: dict[tuple[int, int], list[int]] = {}  # of a width of _APART: their stacks
    for k, outline in ((k, outline) for k, outline in enumerate(outlines) if outline):
        place = plane(np.concatenate([ring[:-1] for ring in outline])).mean(axis=0)
        col, row = (place // _APART).astype(int).tolist()
        around = [n for i, j in _AROUND for n in cells.get((col + i, row + j), ())]
        near = min((n for n in around if math.dist(stacks[n].place, place) < _APART), default=None)
        if near is None:
            cells.setdefault((col, row), []).append(len(stacks))
            stacks.append(Stack([k], place))
        else:
            stacks[near].views.append(k)
    return stacks


def _pair_lines(stacks: Sequence[Stack], files: RunFiles) -> list[str]:
    """From stack to stack, stronger with more matches between them."""
    index = files.number
    stack_of = {k: number for number, stack in enumerate(stacks) for k in stack.views}
    matches: Counter[tuple[int, ...]] = Counter()
    for pair in files.summary.pairs:
        ends = sorted({stack_of[k] for k in (index[pair.a], index[pair.b]) if k in stack_of})
        if len(ends) == 2:
            matches[tuple(ends)] += pair.num_matches
    links = [
        (a.place, b.place, count, f"{a.text} - {b.text}")
        for (a, b), count in (((stacks[i], stacks[j]), count) for (i, j), count in matches.items())
    ]
    return _ties(links, (0.6, 2.4), (0.2, 0.7))


def _graticule(plane: Plane) -> tuple[list[str], list[str]]:
    """Lines of longitude and latitude; their degrees and the scale bar, which go on top."""
    right, bottom = WIDTH - 4, plane.height - 24
    reach = np.array([WIDTH / 2, plane.height / 2]) / plane.unit
    lines, texts = [], []
    for lon in round_ticks(plane.lon - reach[0], plane.lon + reach[0], 4):
        x, _ = plane(np.array([lon, plane.lat]))
        if 50 < x < right - 40:
            words = _degrees((lon + 180.0) % 360.0 - 180.0, "EW")
            lines.append(line(x, 4, x, bottom, "grid"))
            texts.append(label(x, bottom - 4, words, "middle", "degrees"))
    for lat in round_ticks(plane.lat - reach[1], plane.lat + reach[1], 4):
        _, y = plane(np.array([plane.lon, lat]))
        if 16 < y < bottom - 20:
            lines.append(line(4, y, right, y, "grid"))
            texts.append(label(4, y - 3, _degrees(lat, "NS"), class_="degrees"))
    length = max(round_ticks(0.0, 110.0 / plane.scale, 3))
    words = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    x = right - length * plane.scale
    texts.append(tag("rect", x=x, y=bottom + 9, width=right - x, height=4, class_="scalebar"))
    return lines, [*texts, label(x - 6, bottom + 15, words, "end"), label(4, bottom + 15, "north is up")]


def _degrees(value: float, letters: str) -> str:
    return f"{abs(value):g}° {letters[value < 0]}" if value else "0°"


@dataclass(frozen=True, eq=False)
class Cells:
    """Residuals of one image by the cells of a grid: RMS (n, n) [px], NaN where empty, and mean (n, n, 2) [px].

    `systematic` (n, n): whether, in ten or more observations, the mean is above three times its standard error.
    """

    rms: Array
    mean: Array
    systematic: Array

    @property
    def share(self) -> float:
        """Part of the filled cells that are systematic."""
        return float(self.systematic.sum() / max(np.isfinite(self.rms).sum(), 1))


def cells_of(xy: Array, residuals: Array, size: Sequence[int]) -> Cells:
    """Mean and spread of residuals (m, 2) [px] over a grid of cells on the image."""
    cell, num = cell_numbers(xy, size), CELLS**2
    count = np.bincount(cell, minlength=num)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.stack([np.bincount(cell, r, num) / count for r in residuals.T], axis=-1)
        square = np.bincount(cell, (residuals**2).sum(axis=1), num) / count
        spread = np.maximum(square - (mean**2).sum(axis=1), 0.0)
        systematic = ((mean**2).sum(axis=1) > 9 * spread / count) & (count >= 10)
    shape = (CELLS, CELLS)
    return Cells(np.sqrt(square).reshape(shape), mean.reshape(*shape, 2), systematic.reshape(shape))


def residual_panels(
    views: Sequence[ViewEntry], observations: Observations, when: str
) -> tuple[list[tuple[str, str]], list[float], str]:
    """Small maps of the residuals "before" or "after", with captions, of the images with the largest systematic part.

    Cells are darker where the error is larger; thin lines are single residuals; a bold arrow is the mean of a cell
    where it is larger than chance allows. Returns, too, the systematic part of every image's cells, and what lengths
    stand for.
    """
    residuals: Array = getattr(observations, when)
    use = observations.used & np.isfinite(residuals).all(axis=1)
    norm = np.hypot(*residuals[use].T)
    longest = (float(np.quantile(norm, 0.95)) if len(norm) else 0.0) or 1.0
    most = min(_VECTORS // min(max(len(views), 20), _MOST), 300)
    order = np.flatnonzero(use)
    order = order[np.argsort(observations.view[order], kind="stable")]
    rows_of = np.split(order, np.searchsorted(observations.view[order], np.arange(1, len(views))))
    grids = [
        cells_of(observations.xy[rows], residuals[rows], view.size)
        for view, rows in zip(views, rows_of, strict=True)
    ]
    shares = [cells.share for cells in grids]
    charts = []
    for k in sorted(sorted(range(len(views)), key=lambda k: -shares[k])[:_MOST]):
        rows = rows_of[k][:: max(1, -(-len(rows_of[k]) // most))]
        svg = _panel(f"{when}{k}", views[k], grids[k], observations.xy[rows], residuals[rows], longest)
        charts.append((svg, f"{k + 1} {views[k].name}: {_note(grids[k])}"))
    words = f"A thin line of a {_PANEL / _REACH:.0f}th of a panel's width is {longest:.2g} px"
    key = f"{words}; bold arrows are drawn twice as long."
    if len(charts) < len(views):
        key += f" The {len(charts)} of {len(views)} images with the largest systematic part are shown."
    return charts, shares, key


def _note(cells: Cells) -> str:
    return f"{100 * cells.share:.0f} % systematic" if np.isfinite(cells.rms).any() else "no tie points"


def _panel(key: str, view: ViewEntry, cells: Cells, xy: Array, residuals: Array, longest: float) -> str:
    width, height = view.size
    tall = _PANEL * min(max(height / width, 0.4), 2.5)
    stretch = np.array([_PANEL / width, tall / height])
    parts = [tag("rect", x=0, y=0, width=_PANEL, height=tall, class_="empty")]
    side = np.array([_PANEL, tall]) / CELLS
    for (i, j), rms in np.ndenumerate(cells.rms):
        if np.isfinite(rms):
            opacity = 0.06 + 0.5 * min(float(rms) / (2 * longest), 1.0)
            place = {"x": j * side[0], "y": i * side[1], "width": side[0], "height": side[1]}
            parts.append(tag("rect", **place, class_="heat", fill_opacity=opacity))
    start = (xy + 0.5) * stretch
    end = start + residuals * (_REACH / longest)
    ends = np.hstack([start, end]).tolist()
    shafts = "".join(f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}" for x, y, u, v in ends)
    parts.append(tag("path", d=shafts or "M0 0", class_="vector"))
    for i, j in np.argwhere(cells.systematic):
        middle = side * (j + 0.5, i + 0.5)
        parts.append(_arrow(middle, cells.mean[i, j] * (2 * _REACH / longest)))
    described = f"{len(residuals)} residuals are drawn; {_note(cells)}."
    title = f"Residuals over {view.name}"
    return sheet(f"panel-{key}", title, described, tall, parts, width=_PANEL, class_="panel")


def _arrow(middle: Array, vector: Array) -> str:
    """An arrow centred on a cell, not longer than reaches its neighbours' middles."""
    length = float(np.hypot(*vector))
    vector, length = vector * min(1.0, 24.0 / max(length, 1e-9)), min(length, 24.0)
    tip, tail = middle + vector / 2, middle - vector / 2
    along = vector / max(length, 1e-9) * min(5.0, length / 2)
    across = np.array([-along[1], along[0]]) * 0.6
    barbs = [tip - along + across, tip, tip - along - across]
    return path([tail, tip], "mean") + path(barbs, "mean")
