"""Maps of the report, each one SVG text: the images on the ground, residuals over an image.

What stands where is worked out here, and drawn by `drawings.svg.j2`. A map is drawn on a sheet `WIDTH` units wide, so
that its text stays readable on a phone, where a unit is about 0.85 pixels, and is not blown up on a desk, where the
page caps the width.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import Any, ClassVar
from zlib import crc32

import numpy as np

from barpc import __version__
from barpc.base.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.report.ranking import TABLE_ROWS_SHOWN, flagged, worst_first
from barpc.report.records import MAX_SHOWN
from barpc.report.runfiles import MAX_PICTURES, ObservationTable, RunFiles
from barpc.report.summary.ground_points import CheckPointEntry, GcpEntry
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import COVERAGE_CELLS, ViewEntry, cell_numbers
from barpc.report.summary.words import counted, two_digits

WIDTH = 420.0  # Units of a map from left to right
MAX_MARKS = 1500  # Tie points on the map, and lines between images
_MAP_MARGIN = 34.0
_VECTORS = 6000
_PANEL = 300.0  # units from left to right: those of a page that shows them side by side on a desk
_MAX_LABEL_LENGTH = 16  # characters of a name on the map
_LABEL_HEIGHT = 14.0  # units of a line of names
_ARROW_LENGTH = 20.0  # units of a long residual


@cache
def template(name: str) -> Any:
    """Return a template of the page; values are escaped, and an unknown name is an error.

    It is compiled once, and kept beside its source as Python keeps modules.
    """
    import jinja2

    class Compiled(SourceFileLoader):
        def source_to_code(self, data: Any, path: Any) -> Any:  # type: ignore[override]
            return environment.compile(data.decode(), self.name, path)

        def path_stats(self, path: Any) -> dict[str, Any]:  # of another version it is compiled anew
            of_file, versions = super().path_stats(path), f"{__version__} {jinja2.__version__}"
            return {**of_file, "mtime": of_file["mtime"] + crc32(versions.encode())}

    class Loader(jinja2.BaseLoader):
        def load(self, environment: Any, name: str, globals: Any = None) -> Any:
            code = Compiled(name, str(Path(__file__).with_name(name))).get_code(name)
            return environment.template_class.from_code(environment, code, globals or {})

    environment = jinja2.Environment(
        loader=Loader(),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["n"] = coordinate
    return environment.get_template(name)


def coordinate(value: float) -> str:
    """Return a coordinate in as few characters as two decimals take."""
    text = f"{value:.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def round_ticks(low: float, high: float, most: int) -> list[float]:
    """Return at most `most` values of a step of 1, 2 or 5 times a power of ten in an interval.

    Examples
    --------
    >>> round_ticks(-0.3, 1.1, 6)
    [0.0, 0.5, 1.0]
    """
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * s for s in (1, 2, 5, 10) if power * s >= raw * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, last + 1)]


def thin(rows: Any, most: int) -> Any:
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

    WIDTH: ClassVar = WIDTH

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
    scale = float(min((WIDTH - 2 * _MAP_MARGIN) / extent[0], WIDTH / extent[1]))
    return Plane(lon, lat, per_degree * scale, float(extent[1] * scale) + 2 * _MAP_MARGIN + 24, scale)


def ground_map(files: RunFiles) -> str:
    """Draw footprints, pairs by their matches, tie points, GCPs, on a graticule with a scale bar."""
    summary = files.summary
    rings = [ring for outline in files.outlines for ring in outline]
    points: list[tuple[str, int, GcpEntry | CheckPointEntry]]
    points = [*(("gcps", 1, point) for point in thin(summary.gcps, MAX_SHOWN))]
    points += [("check_points", -1, point) for point in thin(summary.check_points, MAX_SHOWN)]
    placed = np.array([(point.lon, point.lat) for *_, point in points], dtype=np.float64).reshape(-1, 2)
    plane = _plane_of(np.concatenate([*rings, files.points[:, :2], placed]))
    lines, words, bar, taken = _graticule(plane)
    triangles = [(x, y, 5.0) for x, y in plane(placed).tolist()]  # half their width
    told = () if summary.scene is None else summary.scene.explanations
    groups = [(one.sentence, np.array([one.box[:2], one.box[2:]])) for one in told if one.box is not None]
    drawn = _drawn(files)
    middles = {
        view.name: plane(np.concatenate([ring[:-1] for ring in outline])).mean(axis=0)
        for view, outline in zip(summary.views, files.outlines, strict=True)
        if outline
    }
    named = worst_first([view for _, view, _ in drawn if view.name in middles])
    shown = map_labels([(view, middles[view.name]) for view in named], taken, triangles)
    taken += [(x, y, _half(name, bold=True)) for _, name, x, y in shown] + triangles
    counts = {"image": summary.views, "pair": summary.pairs, "GCP": summary.gcps, "check point": summary.check_points}
    text: str = template("drawings.svg.j2").module.ground(
        described=", ".join(counted(len(rows), noun) for noun, rows in counts.items() if rows) + ".",
        plane=plane,
        lines=lines,
        words=words,
        bar=bar,
        dots=plane(thin(files.points, MAX_MARKS)[:, :2]).tolist(),
        groups=[(sentence, *plane(ends).ravel()[[0, 3, 2, 1]].tolist()) for sentence, ends in groups],
        outlines=[(k, view, [plane(ring[:-1]).tolist() for ring in outline]) for k, view, outline in drawn],
        gaps=[(view, plane(np.array(view.gap)[:, :2]).tolist()) for _, view, _ in drawn if view.gap],
        pairs=_pair_lines(middles, files),
        shown=shown,
        misses=_misses(summary.gcps, plane),
        labels=_point_labels(
            [(point.name, *plane(at).tolist()) for (*_, point), at in zip(points, placed, strict=True)], taken
        ),
        marks=[
            (kind, "doubted" * doubted(point), point.name, x, y, up)
            for (kind, up, point), (x, y) in zip(points, plane(placed), strict=True)
        ],
    )
    return text


def _misses_in_plan(points: Sequence[GcpEntry]) -> Array:
    """Return residuals (n, 2) of GCPs, east and north [m]; NaN where unknown."""
    return np.array([point.residual_enu_m[:2] for point in points], dtype=np.float64).reshape(-1, 2)


def largest_miss(points: Sequence[GcpEntry]) -> float:
    """Return the longest residual of GCPs in plan [m]; 0 where none is known."""
    return float(np.nan_to_num(np.hypot(*_misses_in_plan(points).T)).max(initial=0.0))


def _misses(points: Sequence[GcpEntry], plane: Plane) -> list[tuple[list[Array], list[Array]]]:
    """Return arrows of the residuals of GCPs in plan, from the points that are drawn; the longest has one length."""
    scale, found = 2 * _ARROW_LENGTH / (largest_miss(points) or 1.0), []
    for point, vector in zip(thin(points, MAX_SHOWN), _misses_in_plan(thin(points, MAX_SHOWN)), strict=True):
        if np.isfinite(vector).all() and vector.any():
            shaft = vector * [scale, -scale]
            found.append(_arrow(plane(np.array([point.lon, point.lat])) + shaft / 2, shaft))
    return found


def _point_labels(points: Sequence[tuple[str, float, float]], taken: OccupiedAreas) -> list[tuple[str, float, float]]:
    """Return names of points with where they begin, right of their marks or left of these, where there is room."""
    taken, found = list(taken), []
    for name, x, y in points:
        half = _half(name)
        for middle in (x + side * (8.0 + half) for side in (1, -1)):
            if half < middle < WIDTH - half and _is_free(middle, y, half, taken):
                taken.append((middle, y, half))
                found.append((name, middle - half, y + 4.0))
                break
    return found


def doubted(point: GcpEntry | CheckPointEntry) -> bool:
    """Return whether a GCP contradicts others."""
    return getattr(point, "status", "used") not in ("used", "not seen")


def _drawn(files: RunFiles) -> list[tuple[int, ViewEntry, Sequence[Array]]]:
    """Return images whose outlines are drawn, with their indices: those that need review last, so on top."""
    whole = {view.name: (k, view, files.outlines[k]) for k, view in enumerate(files.summary.views)}
    bad = flagged(files.summary.views)[:MAX_SHOWN]
    good = [row for name, row in whole.items() if name not in {view.name for view in bad}]
    room = MAX_SHOWN - len(bad)
    return [*(thin(good, room) if room else ()), *(whole[view.name] for view in bad[::-1])]


OccupiedAreas = list[tuple[float, float, float]]  # places that words have on the map: x, y, half their width


def map_labels(
    places: Sequence[tuple[ViewEntry, Array]], taken: OccupiedAreas, marks: OccupiedAreas | None = None
) -> list[tuple[ViewEntry, str, float, float]]:
    """Return labels of images at positions (2,), without those that would cover others or occupied areas.

    Those that would cover `marks`, and of few images or of one that needs review those that would cover others, stand a
    line or two below or above, if there is room. A name tells how many images have their middle in the same place.
    """
    taken, names, every = list(taken), [], np.array([place for _, place in places])
    counted_in = np.zeros(len(places), dtype=bool)
    for k, (view, place) in enumerate(places):
        if counted_in[k]:
            continue
        same = np.abs(every - place).max(axis=1) < _LABEL_HEIGHT / 2
        alike = int(same.sum()) - 1
        name = (
            view.name if len(view.name) <= _MAX_LABEL_LENGTH else f"…{view.name[1 - _MAX_LABEL_LENGTH :]}"
        )  # its end tells of a series
        name += f" and {alike} more" * bool(alike)
        (x, y), half = place.tolist(), _half(name, bold=True)
        x = min(max(x, half), WIDTH - half)
        rows = [y + 1.1 * _LABEL_HEIGHT * k for k in (0, 1, -1, 2, -2)]
        free = [row for row in rows if _is_free(x, row, half, taken)]
        free = free if len(places) <= TABLE_ROWS_SHOWN or view.advice else free if y in free else []
        if free:
            y = next((row for row in free if _is_free(x, row, half, marks or [])), free[0])
            taken.append((x, y, half))
            names.append((view, name, x, y))
            counted_in |= same
    return names


def _half(words: str, bold: bool = False) -> float:
    """Return half the width of words [units], of digits."""
    return (4.1 if bold else 3.6) * len(words)


def _is_free(x: float, y: float, half: float, taken: OccupiedAreas) -> bool:
    return all(abs(x - u) > half + other or abs(y - v) > _LABEL_HEIGHT for u, v, other in taken)


def _pair_lines(middles: Mapping[str, Array], files: RunFiles) -> list[tuple[PairEntry, float, Array, Array]]:
    """Return pairs, the share of their matches (its root) and where they begin and end, the strongest last: on top."""
    pairs = [pair for pair in files.summary.pairs if pair.a in middles and pair.b in middles]
    pairs = sorted(pairs, key=lambda pair: pair.num_matches)[-MAX_MARKS:]
    most = max([1, *(pair.num_matches for pair in pairs)])
    return [(pair, math.sqrt(pair.num_matches / most), middles[pair.a], middles[pair.b]) for pair in pairs]


def _graticule(plane: Plane) -> tuple[list[Any], list[Any], tuple[float, float, float, str], OccupiedAreas]:
    """Return lines of longitude and latitude, their labels (x, y, text, anchor), the scale bar, and occupied areas."""
    right, bottom = WIDTH - 4, plane.height - 24
    reach = np.array([WIDTH / 2, plane.height / 2]) / plane.unit
    lines: list[Any] = []
    texts: list[Any] = []
    taken: OccupiedAreas = []
    for lon in round_ticks(plane.lon - reach[0], plane.lon + reach[0], 4):
        x, words = float(plane(np.array([lon, plane.lat]))[0]), _degree_label((lon + 180.0) % 360.0 - 180.0, "EW")
        if 50 < x < right - 40:
            lines.append((x, 4, x, bottom))
            texts.append((x, bottom - 4, words, "middle"))
            taken.append((x, bottom - 8, _half(words)))
    for lat in round_ticks(plane.lat - reach[1], plane.lat + reach[1], 4):
        y, words = float(plane(np.array([plane.lon, lat]))[1]), _degree_label(lat, "NS")
        if 16 < y < bottom - 20:
            lines.append((4, y, right, y))
            texts.append((4, y - 3, words, "start"))
            taken.append((4 + _half(words), y - 7, _half(words)))
    length = max(round_ticks(0.0, 110.0 / plane.scale, 3))
    words = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    return lines, texts, (right - length * plane.scale, bottom + 9, length * plane.scale, words), taken


def _degree_label(value: float, letters: str) -> str:
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
    cell, num = cell_numbers(xy, size), COVERAGE_CELLS**2
    count = np.bincount(cell, minlength=num)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.stack([np.bincount(cell, r, num) / count for r in residuals.T], axis=-1)
        square = np.bincount(cell, (residuals**2).sum(axis=1), num) / count
        spread = np.maximum(square - (mean**2).sum(axis=1), 0.0)
        systematic = ((mean**2).sum(axis=1) > 9 * spread / count) & (count >= 10)
    shape = (COVERAGE_CELLS, COVERAGE_CELLS)
    return Cells(np.sqrt(square).reshape(shape), mean.reshape(*shape, 2), systematic.reshape(shape))


def residual_panels(
    views: Sequence[ViewEntry], observations: ObservationTable, when: str, first: Sequence[int] = ()
) -> tuple[list[tuple[str, str]], list[float], str]:
    """Draw small maps of the residuals "before" or "after", with captions: `first`, then by their systematic part.

    Darker cells have larger errors; thin lines are single residuals; a bold arrow is the mean of a cell where it is
    significant. Also returns the systematic share of every image's cells, and which images are shown if not all.
    """
    residuals: Array = getattr(observations, when)
    use = observations.used & np.isfinite(residuals).all(axis=1)
    norm = np.hypot(*residuals[use].T)
    longest = (float(np.quantile(norm, 0.95)) if len(norm) else 0.0) or 1.0
    most = min(_VECTORS // min(max(len(views), 20), MAX_PICTURES), 300)
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
    if len(views) > TABLE_ROWS_SHOWN:
        rest.sort(key=lambda k: -shares[k])
    for k in [*first, *rest][:MAX_PICTURES]:
        rows = thin(rows_of[k], most)
        svg = _panel(when, k, views[k], grids[k], np.hstack([observations.xy[rows], residuals[rows]]), longest)
        charts.append((svg, f"{views[k].name}: {_panel_note(grids[k])}"))
    some = "those that need review, then " * bool(first) + "those with the largest systematic part"
    key = f"Of {len(views)} images {len(charts)} are shown: {some}." * (len(charts) < len(views))
    return charts, shares, key


def panel_box(view: ViewEntry) -> Array:
    """Return width and height (2,) of the panel of an image."""
    width, height = view.size
    most = 2.5
    return np.array([_PANEL, _PANEL * min(max(height / width, 1.0 / most), most)])


def _panel_note(cells: Cells) -> str:
    return (
        f"{100 * cells.share:.0f} % of cells with a significant mean"
        if np.isfinite(cells.rms).any()
        else "no tie points"
    )


def _panel(when: str, number: int, view: ViewEntry, cells: Cells, drawn: Array, longest: float) -> str:
    """Draw the map of an image, with the residuals that are drawn (m, 4): col, row, dcol, drow [px]."""
    box = panel_box(view)
    side, start = box / COVERAGE_CELLS, (drawn[:, :2] + 0.5) * (box / view.size)
    heat = [
        (j * side[0], i * side[1], *side, 0.06 + 0.5 * min(float(rms) / (2 * longest), 1.0))
        for (i, j), rms in np.ndenumerate(cells.rms)
        if np.isfinite(rms)
    ]
    gaps = [((np.array(view.gap)[:, 2:] + 0.5) * (box / view.size)).tolist()] if view.gap else []
    found = np.argwhere(cells.systematic)
    arrows = [_arrow(side * (j + 0.5, i + 0.5), cells.mean[i, j] * (2 * _ARROW_LENGTH / longest)) for i, j in found]
    text: str = template("drawings.svg.j2").module.panel(
        when=when,
        number=number,
        view=view,
        width=box[0],
        height=box[1],
        cells=heat,
        gaps=gaps,
        shafts=np.hstack([start, start + drawn[:, 2:] * (_ARROW_LENGTH / longest)]).tolist(),
        arrows=arrows,
        bar=_ARROW_LENGTH,
        length=f"{two_digits(longest)} px",
        described=f"{len(drawn)} residuals are drawn; {_panel_note(cells)}{'; shaded: few tie points' * len(gaps)}.",
    )
    return text


def _arrow(middle: Array, vector: Array) -> tuple[list[Array], list[Array]]:
    """Return shaft and barbs of an arrow centred on a cell, not longer than reaches its neighbours' middles."""
    length = float(np.hypot(*vector))
    vector, length = vector * min(1.0, 2 * _ARROW_LENGTH / max(length, 1e-9)), min(length, 2 * _ARROW_LENGTH)
    tip, tail = middle + vector / 2, middle - vector / 2
    along = vector / max(length, 1e-9) * min(5.0, length / 2)
    across = np.array([-along[1], along[0]]) * 0.6
    return [tail, tip], [tip - along + across, tip, tip - along - across]
