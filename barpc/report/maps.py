"""Maps of the report, each one SVG text: the images on the ground, residuals over an image."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from barpc.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.report.charts import (
    MAX_DOTS,
    MAX_DRAWN,
    WIDTH,
    evenly,
    label,
    line,
    path,
    round_ticks,
    sheet,
    shortened,
    tag,
    titled,
)
from barpc.report.digest import SHOWN, flagged
from barpc.report.summary import Summary
from barpc.report.summary.known import CheckPointEntry, GcpEntry
from barpc.report.summary.views import CELLS, ViewEntry, cell_numbers
from barpc.report.tables import ObservationTable, RunFiles

_MOST_LINKS = 1500
_MARGIN = 34.0
_APART = 26.0
_AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
_MOST = 60  # images on the page: those with the largest systematic part
_VECTORS = 6000
_PANEL = 180.0
_MANY = 30  # stacks of images, or those that need a look: of more there are fewer names, and thinner lines
_LONGEST = 16  # characters of a name there
_REACH = 12.0  # units of a long residual
_DARKEST = 0.7  # opacity where all tie points move

Link = tuple[Sequence[float] | Array, Sequence[float] | Array, int, str]
"""Two places (x, y), the matches between them, a title."""
Known = GcpEntry | CheckPointEntry


def _ties(links: Sequence[Link], width: tuple[float, float], opacity: tuple[float, float]) -> list[str]:
    """Return lines of least width and opacity, and what the link with the most matches has beyond these."""
    most, parts = max([count for *_, count, _ in links], default=1), []
    for (x1, y1), (x2, y2), count, title in sorted(links, key=itemgetter(2))[-_MOST_LINKS:]:
        share = math.sqrt(count / most)
        ends = {"x1": x1, "y1": y1, "x2": x2, "y2": y2}
        style = {
            "stroke_width": width[0] + width[1] * share,
            "stroke_opacity": opacity[0] + opacity[1] * share,
        }
        shape = tag("line", **ends, class_="tie", **style)
        parts.append(titled(shape, f"{title}: {count} matches"))
    return parts


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
    points_of: dict[str, Sequence[Known]] = {"gcps": summary.gcps, "check_points": summary.check_points}
    known = {
        kind: np.array([(point.lon, point.lat) for point in places], dtype=np.float64).reshape(-1, 2)
        for kind, places in points_of.items()
    }
    plane = _plane_of(np.concatenate([*rings, files.points[:, :2], *known.values()]))
    grid, degrees, taken = _graticule(plane)
    points = plane(evenly(files.points, MAX_DOTS)[:, :2])
    parts = [
        *grid,
        *_moving_ground(plane, summary),
        tag("path", d="".join(f"M{x:.1f} {y:.1f}h0" for x, y in points.tolist()) or "M0 0", class_="point"),
    ]
    for k, view, outline in _drawn(files):
        shape = "".join(path(plane(ring[:-1]), f"outline {view.status}", closed=True) for ring in outline)
        parts.append(titled(shape, f"{view.name}: {view.num_observations} tie points", data_v=k))
    stacks = _stacks(plane, files.outlines, list(files.number))
    parts += _pair_lines(stacks, files)
    marked, number = _marked(plane, files), files.number
    bad = [Stack([number[view.name]], middle, view.name, view.status) for view, middle in marked]
    named = [*bad[:_MANY], *(stacks if len(stacks) <= 100 else ())]
    parts += _stack_names(named, len(stacks) > _MANY, taken)
    for kind, places in known.items():
        up = 1 if kind == "gcps" else -1
        for point, (x, y) in evenly(list(zip(points_of[kind], plane(places), strict=True)), MAX_DRAWN):
            ends = [(x, y - 6 * up), (x + 5, y + 4 * up), (x - 5, y + 4 * up)]
            parts.append(titled(path(ends, kind, closed=True), point.name))
    described = (
        f"{len(summary.views)} outlines, {len(summary.pairs)} pairs, {len(known['gcps'])} GCPs, "
        f"{len(known['check_points'])} check points."
    )
    many = {"class_": "many"} if len(stacks) > _MANY else {}
    return sheet("ground", "Map of the images", described, plane.height, [*parts, *degrees], **many)


def _moving_ground(plane: Plane, summary: Summary) -> list[str]:
    """Return cells of the ground in which tie points move together, darker with more, and where each group lies."""
    scene = summary.scene
    if scene is None:
        return []
    parts = []
    for one in scene.moving:
        shape = _box(plane, one.box, "moves", fill_opacity=_DARKEST * one.share)
        parts.append(titled(shape, f"{100 * one.share:.0f} % of {one.count} tie points move together"))
    groups = [one for one in scene.explanations if one.box is not None]
    return parts + [titled(_box(plane, one.box or (), "group"), one.sentence) for one in groups]


def _box(plane: Plane, box: Sequence[float], class_: str, **style: float) -> str:
    west, south, east, north = box
    (x, y), (right, bottom) = plane(np.array([(west, north), (east, south)])).tolist()
    return tag("rect", x=x, y=y, width=right - x, height=bottom - y, class_=class_, **style)


@dataclass(frozen=True, eq=False)
class Stack:
    """Images that lie over each other on the map.

    Their indices, the place (2,) of the first one's middle and its name; of one that needs a look its status.
    """

    views: list[int]
    place: Array
    name: str
    status: str = ""

    @property
    def text(self) -> str:
        """The name of the first, and how many more."""
        return shortened(self.name, _LONGEST) + f" + {len(self.views) - 1}" * (len(self.views) > 1)


def _drawn(files: RunFiles) -> list[tuple[int, ViewEntry, Sequence[Array]]]:
    """Return images whose outlines are drawn, with their indices: those that need a look last, so on top."""
    whole = {view.name: (k, view, files.outlines[k]) for k, view in enumerate(files.summary.views)}
    bad = flagged(files.summary.views)[:MAX_DRAWN]
    good = [row for name, row in whole.items() if name not in {view.name for view in bad}]
    room = MAX_DRAWN - len(bad)
    return [*(evenly(good, room) if room else ()), *(whole[view.name] for view in bad[::-1])]


def _marked(plane: Plane, files: RunFiles) -> list[tuple[ViewEntry, Array]]:
    """Return images that need a look and the places (2,) of their middles, the worst first."""
    found = [(view, files.outlines[files.number[view.name]]) for view in flagged(files.summary.views)]
    return [(view, _middle(plane, outline)) for view, outline in found if outline]


def _middle(plane: Plane, outline: Sequence[Array]) -> Array:
    middle: Array = plane(np.concatenate([ring[:-1] for ring in outline])).mean(axis=0)
    return middle


def _stacks(plane: Plane, outlines: Sequence[Sequence[Array]], names: Sequence[str]) -> list[Stack]:
    """Return images whose middles stand nearer than a name is tall."""
    stacks: list[Stack] = []
    cells: dict[tuple[int, int], list[int]] = {}  # of a width of _APART: their stacks
    for k, outline in ((k, outline) for k, outline in enumerate(outlines) if outline):
        place = _middle(plane, outline)
        col, row = (place // _APART).astype(int).tolist()
        around = [n for i, j in _AROUND for n in cells.get((col + i, row + j), ())]
        near = min((n for n in around if math.dist(stacks[n].place, place) < _APART), default=None)
        if near is None:
            cells.setdefault((col, row), []).append(len(stacks))
            stacks.append(Stack([k], place, names[k]))
        else:
            stacks[near].views.append(k)
    return stacks


def _stack_names(stacks: Sequence[Stack], many: bool, taken: Sequence[tuple[float, float, float]] = ()) -> list[str]:
    """Return the names of stacks, without those that would stand on others or on what is taken: x, y, half width."""
    taken, names, gap = list(taken), [], 14 if many else 0
    for stack in stacks:
        (x, y), half = stack.place.tolist(), 3.6 * len(stack.text)
        x = min(max(x, half), WIDTH - half)
        if all(abs(x - u) > half + other + gap or abs(y - v) > 14 + gap for u, v, other in taken):
            taken.append((x, y, half))
            names.append(label(x, y + 4, stack.text, "middle", f"stack {stack.status}".strip()))
    return names


def _pair_lines(stacks: Sequence[Stack], files: RunFiles) -> list[str]:
    """Draw lines from stack to stack, stronger with more matches between them."""
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


def _graticule(plane: Plane) -> tuple[list[str], list[str], list[tuple[float, float, float]]]:
    """Return lines of longitude and latitude; degrees and scale bar, which go on top; places x, y, half widths."""
    right, bottom = WIDTH - 4, plane.height - 24
    reach = np.array([WIDTH / 2, plane.height / 2]) / plane.unit
    lines, texts, taken = [], [], []
    for lon in round_ticks(plane.lon - reach[0], plane.lon + reach[0], 4):
        x, _ = plane(np.array([lon, plane.lat]))
        if 50 < x < right - 40:
            words = _degrees((lon + 180.0) % 360.0 - 180.0, "EW")
            lines.append(line(x, 4, x, bottom, "grid"))
            texts.append(label(x, bottom - 4, words, "middle", "degrees"))
            taken.append((float(x), bottom - 8, 3.6 * len(words)))
    for lat in round_ticks(plane.lat - reach[1], plane.lat + reach[1], 4):
        _, y = plane(np.array([plane.lon, lat]))
        if 16 < y < bottom - 20:
            lines.append(line(4, y, right, y, "grid"))
            texts.append(label(4, y - 3, words := _degrees(lat, "NS"), class_="degrees"))
            taken.append((4 + 3.6 * len(words), float(y) - 7, 3.6 * len(words)))
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
