"""The map of the images on the ground."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from barpc.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.report.load import RunFiles
from barpc.report.svg import WIDTH, label, line, path, round_ticks, sheet, tag, titled

_MARGIN = 34.0
_DOTS = 1500
_APART = 26.0


@dataclass(frozen=True, eq=False)
class Plane:
    """Local map: true to scale in its middle, north up.

    Parameters
    ----------
    lon, lat : float
        Its middle [deg].
    unit : (2,)
        Units of the sheet per degree of longitude and latitude.
    height : float
        Of the sheet.
    scale : float
        Units of the sheet a metre.
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


def plane_of(lonlat: Array) -> Plane:
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
    known = {kind: _lonlat(summary[kind]) for kind in ("gcps", "check_points")}
    plane = plane_of(np.concatenate([*rings, files.points[:, :2], *known.values()]))
    grid, degrees = _graticule(plane)
    points = plane(files.points[:: max(1, -(-len(files.points) // _DOTS)), :2])
    parts = [*grid, *(tag("circle", cx=x, cy=y, r=1.1, class_="point") for x, y in points)]
    for view, outline in zip(summary["views"], files.outlines, strict=True):
        shape = "".join(path(plane(ring[:-1]), f"outline {view['status']}", closed=True) for ring in outline)
        parts.append(titled(shape, f"{view['name']}: {view['num_observations']} tie points"))
    stacks = _stacks(plane, files.outlines)
    parts += _pair_lines(stacks, summary)
    if len(stacks) <= 100:
        parts += [
            label(stack.place[0], stack.place[1] + 4, stack.text, "middle", "stack") for stack in stacks
        ]
    for kind, places in known.items():
        for point, (x, y) in zip(summary[kind], plane(places), strict=True):
            ends = (
                [(x, y - 6), (x + 5, y + 4), (x - 5, y + 4)]
                if kind == "gcps"
                else [(x, y + 6), (x + 5, y - 4), (x - 5, y - 4)]
            )
            parts.append(titled(path(ends, kind, closed=True), point["name"]))
    described = (
        f"{len(summary['views'])} outlines, {len(summary['pairs'])} pairs, {len(known['gcps'])} GCPs, "
        f"{len(known['check_points'])} check points."
    )
    return sheet("ground", "Map of the images", described, plane.height, [*parts, *degrees])


def _lonlat(points: Sequence[Mapping[str, Any]]) -> Array:
    return np.array([[point["lon"], point["lat"]] for point in points], dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Stack:
    """Images that lie over each other on the map: their indices, and the place (2,) of their middle."""

    views: list[int]
    place: Array

    @property
    def text(self) -> str:
        """Their numbers, runs of them as 1-3."""
        runs: list[list[int]] = []
        for k in self.views:
            if runs and k == runs[-1][-1] + 1:
                runs[-1].append(k)
            else:
                runs.append([k])
        words = [f"{run[0] + 1}" if len(run) == 1 else f"{run[0] + 1}-{run[-1] + 1}" for run in runs]
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


def _pair_lines(stacks: Sequence[Stack], summary: Mapping[str, Any]) -> list[str]:
    """From stack to stack, stronger with more matches between them."""
    index = {view["name"]: k for k, view in enumerate(summary["views"])}
    stack_of = {k: number for number, stack in enumerate(stacks) for k in stack.views}
    matches: Counter[tuple[int, int]] = Counter()
    for pair in summary["pairs"]:
        ends = sorted({stack_of[k] for k in (index[pair["a"]], index[pair["b"]]) if k in stack_of})
        if len(ends) == 2:
            matches[ends[0], ends[1]] += pair["num_matches"]
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
