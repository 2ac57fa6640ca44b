"""Maps of the report, each one SVG text: the images on the ground, residuals over an image.

Colours are CSS variables of the page. A map is drawn on a sheet `WIDTH` units wide, so that its text stays readable
on a phone, where a unit is about 0.85 pixels, and is not blown up on a desk, where the page caps the width.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from barpc.base.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.report.digest import SHOWN, flagged, worst_first
from barpc.report.records import MAX_SHOWN
from barpc.report.summary.known import CheckPointEntry, GcpEntry
from barpc.report.summary.views import CELLS, ViewEntry, cell_numbers
from barpc.report.tables import ObservationTable, RunFiles

WIDTH = 420.0  # Units of a map from left to right
MAX_MARKS = 1500  # Tie points on the map, and lines between images
_MARGIN = 34.0
_MOST = 60  # images on the page: those with the largest systematic part
_VECTORS = 6000
_PANEL = 180.0
_LONGEST = 16  # characters of a name on the map
_SAME = 7  # px on the map: half a line of names
_REACH = 12.0  # units of a long residual


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


def evenly(rows: Any, most: int) -> Any:
    """Return all rows, or a number of them at even steps."""
    return rows[:: max(1, -(-len(rows) // most))]


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
        """Return places (..., 2) on the sheet of lon, lat [deg] (..., 2)."""
        east = (wrap_longitude(lonlat[..., 0], self.lon) - self.lon) * self.unit[0]
        north = (lonlat[..., 1] - self.lat) * self.unit[1]
        return np.stack([WIDTH / 2 + east, self.height / 2 - north], axis=-1)


def _plane_of(lonlat: Array) -> Plane:
    """Return the map on which points (n, 2) [deg] fill the sheet."""
    lonlat = np.column_stack([wrap_longitude(lonlat[:, 0], lonlat[0, 0]), lonlat[:, 1]])
    low, high = lonlat.min(axis=0), lonlat.max(axis=0)
    lon, lat = ((low + high) / 2).tolist()
    per_degree = metres_per_unit(np.array([lon, lat, 0.0]))[:2]
    extent = np.maximum((high - low) * per_degree, 1.0)
    scale = float(min((WIDTH - 2 * _MARGIN) / extent[0], 420.0 / extent[1]))
    return Plane(lon, lat, per_degree * scale, float(extent[1] * scale) + 2 * _MARGIN + 24, scale)


def ground_map(files: RunFiles) -> str:
    """Draw footprints, pairs by their matches, tie points, GCPs, on a graticule with a scale bar."""
    summary = files.summary
    rings = [ring for outline in files.outlines for ring in outline]
    points_of: dict[str, Sequence[GcpEntry | CheckPointEntry]]
    points_of = {"gcps": summary.gcps, "check_points": summary.check_points}
    known = {
        kind: np.array([(point.lon, point.lat) for point in places], dtype=np.float64).reshape(-1, 2)
        for kind, places in points_of.items()
    }
    plane = _plane_of(np.concatenate([*rings, files.points[:, :2], *known.values()]))
    grid, degrees, taken = _graticule(plane)
    points = plane(evenly(files.points, MAX_MARKS)[:, :2])
    parts = [
        *grid,
        tag("path", d="".join(f"M{x:.1f} {y:.1f}h0" for x, y in points.tolist()) or "M0 0", class_="point"),
    ]
    for one in () if summary.scene is None else summary.scene.explanations:
        if one.box is not None:
            west, south, east, north = one.box
            (x, y), (right, bottom) = plane(np.array([(west, north), (east, south)])).tolist()
            shape = tag("rect", x=x, y=y, width=right - x, height=bottom - y, class_="group")
            parts.append(titled(shape, one.sentence))
    drawn = _drawn(files)
    for k, view, outline in drawn:
        shape = "".join(path(plane(ring[:-1]), f"outline {view.status}", closed=True) for ring in outline)
        parts.append(titled(shape, f"{view.name}: {view.num_observations} tie points", data_v=k))
    middles = {
        view.name: plane(np.concatenate([ring[:-1] for ring in outline])).mean(axis=0)
        for view, outline in zip(summary.views, files.outlines, strict=True)
        if outline
    }
    parts += _pair_lines(middles, files)
    named = worst_first([view for _, view, _ in drawn if view.name in middles])
    parts += _names([(view, middles[view.name]) for view in named], taken)
    for kind, places in known.items():
        up = 1 if kind == "gcps" else -1
        for point, (x, y) in evenly(list(zip(points_of[kind], plane(places), strict=True)), MAX_SHOWN):
            ends = [(x, y - 6 * up), (x + 5, y + 4 * up), (x - 5, y + 4 * up)]
            parts.append(titled(path(ends, kind, closed=True), point.name))
    described = f"{len(summary.views)} outlines, {len(summary.pairs)} pairs, {len(summary.gcps)} GCPs, "
    described += f"{len(summary.check_points)} check points."
    return sheet("ground", "Map of the images", described, plane.height, [*parts, *degrees])


def _drawn(files: RunFiles) -> list[tuple[int, ViewEntry, Sequence[Array]]]:
    """Return images whose outlines are drawn, with their indices: those that need a look last, so on top."""
    whole = {view.name: (k, view, files.outlines[k]) for k, view in enumerate(files.summary.views)}
    bad = flagged(files.summary.views)[:MAX_SHOWN]
    good = [row for name, row in whole.items() if name not in {view.name for view in bad}]
    room = MAX_SHOWN - len(bad)
    return [*(evenly(good, room) if room else ()), *(whole[view.name] for view in bad[::-1])]


def _names(places: Sequence[tuple[ViewEntry, Array]], taken: Sequence[tuple[float, float, float]]) -> list[str]:
    """Return names of images at places (2,), but those that would stand on others or on what is taken: x, y, half.

    A name tells how many images have their middle in the same place.
    """
    taken, names = list(taken), []
    for view, place in places:
        alike = sum(bool(np.abs(other - place).max() < _SAME) for _, other in places) - 1
        name = view.name if len(view.name) <= _LONGEST else f"…{view.name[1 - _LONGEST :]}"  # its end tells of a series
        name += f" + {alike}" * bool(alike)
        (x, y), half = place.tolist(), 3.6 * len(name)
        x = min(max(x, half), WIDTH - half)
        if all(abs(x - u) > half + other or abs(y - v) > 14 for u, v, other in taken):
            taken.append((x, y, half))
            names.append(label(x, y + 4, name, "middle", f"name {view.status if view.advice else ''}".strip()))
    return names


def _pair_lines(middles: Mapping[str, Array], files: RunFiles) -> list[str]:
    """Draw lines between images, stronger with more matches, the strongest on top."""
    pairs = [pair for pair in files.summary.pairs if pair.a in middles and pair.b in middles]
    pairs = sorted(pairs, key=lambda pair: pair.num_matches)[-MAX_MARKS:]
    parts = []
    for pair in pairs:
        share = math.sqrt(pair.num_matches / max(pairs[-1].num_matches, 1))
        (x1, y1), (x2, y2) = middles[pair.a], middles[pair.b]
        style = {"class_": "tie", "stroke_width": 0.6 + 2.4 * share, "stroke_opacity": 0.2 + 0.7 * share}
        shape = tag("line", x1=x1, y1=y1, x2=x2, y2=y2, **style)
        parts.append(titled(shape, f"{pair.a} - {pair.b}: {pair.num_matches} matches"))
    return parts


def _graticule(plane: Plane) -> tuple[list[str], list[str], list[tuple[float, float, float]]]:
    """Return lines of longitude and latitude; degrees and scale bar, which go on top; places x, y, half widths."""
    right, bottom = WIDTH - 4, plane.height - 24
    reach = np.array([WIDTH / 2, plane.height / 2]) / plane.unit
    lines, texts, taken = [], [], []
    for lon in round_ticks(plane.lon - reach[0], plane.lon + reach[0], 4):
        x, words = float(plane(np.array([lon, plane.lat]))[0]), _degrees((lon + 180.0) % 360.0 - 180.0, "EW")
        if 50 < x < right - 40:
            lines.append(line(x, 4, x, bottom, "grid"))
            texts.append(label(x, bottom - 4, words, "middle", "degrees"))
            taken.append((x, bottom - 8, 3.6 * len(words)))
    for lat in round_ticks(plane.lat - reach[1], plane.lat + reach[1], 4):
        y, words = float(plane(np.array([plane.lon, lat]))[1]), _degrees(lat, "NS")
        if 16 < y < bottom - 20:
            lines.append(line(4, y, right, y, "grid"))
            texts.append(label(4, y - 3, words, class_="degrees"))
            taken.append((4 + 3.6 * len(words), y - 7, 3.6 * len(words)))
    length = max(round_ticks(0.0, 110.0 / plane.scale, 3))
    words = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    x = right - length * plane.scale
    texts.append(tag("rect", x=x, y=bottom + 9, width=right - x, height=4, class_="scalebar"))
    texts += [label(x - 6, bottom + 15, words, "end"), label(4, bottom + 15, "north is up")]
    return lines, texts, taken


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


def residual_cells(xy: Array, residuals: Array, size: Sequence[int]) -> Cells:
    """Return mean and spread of residuals (m, 2) [px] over a grid of cells on the image."""
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
    views: Sequence[ViewEntry], observations: ObservationTable, when: str, first: Sequence[int] = ()
) -> tuple[list[tuple[str, str]], list[float], str]:
    """Draw small maps of the residuals "before" or "after", with captions: `first`, then by their systematic part.

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
        residual_cells(observations.xy[rows], residuals[rows], view.size)
        for view, rows in zip(views, rows_of, strict=True)
    ]
    shares = [cells.share for cells in grids]
    charts = []
    rest = [k for k in range(len(views)) if k not in first]
    if len(views) > SHOWN:
        rest.sort(key=lambda k: -shares[k])
    for k in [*first, *rest][:_MOST]:
        rows = evenly(rows_of[k], most)
        svg = _panel(when, k, views[k], grids[k], np.hstack([observations.xy[rows], residuals[rows]]), longest)
        charts.append((svg, f"{views[k].name}: {_note(grids[k])}"))
    words = f"A thin line of a {_PANEL / _REACH:.0f}th of a panel's width is {longest:.2g} px"
    key = f"{words}; bold arrows are drawn twice as long."
    if len(charts) < len(views):
        key += f" Of {len(views)} images {len(charts)} are shown: "
        key += "those that need a look, then " * bool(first) + "those with the largest systematic part."
    return charts, shares, key


def _note(cells: Cells) -> str:
    return f"{100 * cells.share:.0f} % systematic" if np.isfinite(cells.rms).any() else "no tie points"


def _panel(when: str, number: int, view: ViewEntry, cells: Cells, drawn: Array, longest: float) -> str:
    """Draw the map of an image, with the residuals that are drawn (m, 4): col, row, dcol, drow [px]."""
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
    start = (drawn[:, :2] + 0.5) * stretch
    end = start + drawn[:, 2:] * (_REACH / longest)
    ends = np.hstack([start, end]).tolist()
    shafts = "".join(f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}" for x, y, u, v in ends)
    parts.append(tag("path", d=shafts or "M0 0", class_="vector"))
    for i, j in np.argwhere(cells.systematic):
        middle = side * (j + 0.5, i + 0.5)
        parts.append(_arrow(middle, cells.mean[i, j] * (2 * _REACH / longest)))
    described = f"{len(drawn)} residuals are drawn; {_note(cells)}."
    title = f"Residuals over {view.name}"
    return sheet(f"panel-{when}{number}", title, described, tall, parts, width=_PANEL, class_="panel", data_v=number)


def _arrow(middle: Array, vector: Array) -> str:
    """Draw an arrow centred on a cell, not longer than reaches its neighbours' middles."""
    length = float(np.hypot(*vector))
    vector, length = vector * min(1.0, 24.0 / max(length, 1e-9)), min(length, 24.0)
    tip, tail = middle + vector / 2, middle - vector / 2
    along = vector / max(length, 1e-9) * min(5.0, length / 2)
    across = np.array([-along[1], along[0]]) * 0.6
    barbs = [tip - along + across, tip, tip - along - across]
    return path([tail, tip], "mean") + path(barbs, "mean")
