"""Maps of the report: the images on the ground, and each image's residuals: are they random, and where worse?"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barpc.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.report.charts import WIDTH, label, line, path, round_ticks, sheet, tag, titled
from barpc.report.load import Observations, RunFiles
from barpc.report.summary import CELLS, CheckPointEntry, GcpEntry, ViewEntry, cell_numbers

_MARGIN = 34.0
_DOTS = 1500
_APART = 26.0
_MOST = 60  # images on the page: those with the largest systematic part
_VECTORS = 6000
_PANEL = 180.0
_REACH = 12.0  # units of a long residual


Known = GcpEntry | CheckPointEntry


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
    lon, lat = (low + high) / 2
    per_degree = metres_per_unit(np.array([lon, lat, 0.0]))[:2]
    extent = np.maximum((high - low) * per_degree, 1.0)
    scale = min((WIDTH - 2 * _MARGIN) / extent[0], 420.0 / extent[1])
    return Plane(
        float(lon), float(lat), per_degree * scale, float(extent[1] * scale) + 2 * _MARGIN + 24, float(scale)
    )


def ground_map(files: RunFiles) -> str:
    """Footprints, pairs by their matches, tie points, GCPs, on a graticule with a scale bar."""
    summary = files.summary
    rings = [ring for outline in files.outlines for ring in outline]
    points_of: dict[str, Sequence[Known]] = {"gcps": summary.gcps, "check_points": summary.check_points}
    known = {kind: _lonlat(places) for kind, places in points_of.items()}
    plane = _plane_of(np.concatenate([*rings, files.points[:, :2], *known.values()]))
    grid, degrees = _graticule(plane)
    points = plane(files.points[:: max(1, -(-len(files.points) // _DOTS)), :2])
    parts = [*grid, *(tag("circle", cx=x, cy=y, r=1.1, class_="point") for x, y in points)]
    for view, outline in zip(summary.views, files.outlines, strict=True):
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
        for point, (x, y) in zip(points_of[kind], plane(places), strict=True):
            ends = [(x, y - 6 * up), (x + 5, y + 4 * up), (x - 5, y + 4 * up)]
            parts.append(titled(path(ends, kind, closed=True), point.name))
    described = (
        f"{len(summary.views)} outlines, {len(summary.pairs)} pairs, {len(known['gcps'])} GCPs, "
        f"{len(known['check_points'])} check points."
    )
    return sheet("ground", "Map of the images", described, plane.height, [*parts, *degrees])


def _lonlat(points: Sequence[Known]) -> Array:
    return np.array([[point.lon, point.lat] for point in points], dtype=np.float64).reshape(-1, 2)


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
    for k, outline in enumerate(outlines):
        if not outline:
            continue
        place = plane(np.concatenate([ring[:-1] for ring in outline])).mean(axis=0)
        near = next((stack for stack in stacks if np.hypot(*(stack.place - place)) < _APART), None)
        if near is None:
            stacks.append(Stack([k], place))
        else:
            near.views.append(k)
    return stacks


def _pair_lines(stacks: Sequence[Stack], files: RunFiles) -> list[str]:
    """From stack to stack, stronger with more matches between them."""
    index = files.number
    stack_of = {k: number for number, stack in enumerate(stacks) for k in stack.views}
    matches: Counter[tuple[int, int]] = Counter()
    for pair in files.summary.pairs:
        ends = sorted({stack_of[k] for k in (index[pair.a], index[pair.b]) if k in stack_of})
        if len(ends) == 2:
            matches[ends[0], ends[1]] += pair.num_matches
    most = max(matches.values(), default=1)
    parts = []
    for (i, j), count in sorted(matches.items(), key=lambda item: item[1])[-1500:]:
        (x1, y1), (x2, y2) = stacks[i].place, stacks[j].place
        share = math.sqrt(count / most)
        style = {"stroke_width": 0.6 + 2.4 * share, "stroke_opacity": 0.2 + 0.7 * share}
        link = tag("line", x1=x1, y1=y1, x2=x2, y2=y2, class_="tie", **style)
        parts.append(titled(link, f"{stacks[i].text} - {stacks[j].text}: {count} matches"))
    return parts


def _graticule(plane: Plane) -> tuple[list[str], list[str]]:
    """Lines of longitude and latitude; their degrees and the scale bar, which go on top."""
    right, bottom = WIDTH - 4, plane.height - 24
    reach = np.array([WIDTH / 2, plane.height / 2]) / plane.unit
    lines, texts = [], []
    for lon in round_ticks(plane.lon - reach[0], plane.lon + reach[0], 4):
        x, _ = plane(np.array([lon, plane.lat]))
        if 50 < x < right - 40:
            lines.append(line(x, 4, x, bottom, "grid"))
            texts.append(
                label(x, bottom - 4, _degrees((lon + 180.0) % 360.0 - 180.0, "EW"), "middle", "degrees")
            )
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

    `systematic` (n, n): whether the mean is larger than chance allows, three times its standard error, in cells of ten
    or more observations.
    """

    rms: Array
    mean: Array
    systematic: Array

    @property
    def share(self) -> float:
        """Part of the filled cells that are systematic."""
        filled = np.isfinite(self.rms).sum()
        return float(self.systematic.sum() / filled) if filled else 0.0


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
    grids, shares = [], []
    for k, view in enumerate(views):
        rows = np.flatnonzero(use & (observations.view == k))
        grids.append((rows, cells_of(observations.xy[rows], residuals[rows], view.size)))
        shares.append(grids[-1][1].share)
    charts = []
    for k in sorted(sorted(range(len(views)), key=lambda k: -shares[k])[:_MOST]):
        rows, cells = grids[k]
        rows = rows[:: max(1, -(-len(rows) // most))]
        svg = _panel(f"{when}{k}", views[k], cells, observations.xy[rows], residuals[rows], longest)
        charts.append((svg, f"{k + 1} {views[k].name}: {_note(cells)}"))
    key = (
        f"A thin line of a {_PANEL / _REACH:.0f}th of a panel's width is {longest:.2g} px;"
        " bold arrows are drawn twice as long."
    )
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
    shafts = "".join(
        f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}"
        for (x, y), (u, v) in zip(start.tolist(), end.tolist(), strict=True)
    )
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
    vector = vector * min(1.0, 24.0 / max(length, 1e-9))
    length = min(length, 24.0)
    tip, tail = middle + vector / 2, middle - vector / 2
    along = vector / max(length, 1e-9) * min(5.0, length / 2)
    across = np.array([-along[1], along[0]]) * 0.6
    barbs = [tip - along + across, tip, tip - along - across]
    return path(np.array([tail, tip]).tolist(), "mean") + path(np.array(barbs).tolist(), "mean")
