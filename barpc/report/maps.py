"""The map of the images on the ground."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barpc.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.report.load import RunFiles
from barpc.report.svg import WIDTH, label, line, path, round_ticks, sheet, tag, titled

_MARGIN = 34.0
_DOTS = 1500


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
    """Footprints, pairs coloured by their matches, tie points, GCPs, on a graticule with a scale bar."""
    summary = files.summary
    rings = [ring for outline in files.outlines for ring in outline]
    gcps = np.array([[gcp["lon"], gcp["lat"]] for gcp in summary["gcps"]]).reshape(-1, 2)
    plane = plane_of(np.concatenate([*rings, files.points[:, :2], gcps]))
    parts = _graticule(plane)
    points = plane(files.points[:: max(1, -(-len(files.points) // _DOTS)), :2])
    parts += [tag("circle", cx=x, cy=y, r=1.1, class_="point") for x, y in points]
    for view, outline in zip(summary["views"], files.outlines, strict=True):
        shape = "".join(path(plane(ring[:-1]), f"outline {view['status']}", closed=True) for ring in outline)
        parts.append(titled(shape, f"{view['name']}: {view['num_observations']} tie points"))
    parts += _pair_lines(plane, files)
    for k, outline in enumerate(files.outlines):
        parts += _number(plane, k, len(files.outlines), outline)
    for gcp, (x, y) in zip(summary["gcps"], plane(gcps), strict=True):
        parts.append(
            titled(path([(x, y - 6), (x + 5, y + 4), (x - 5, y + 4)], "gcp", closed=True), gcp["name"])
        )
    described = f"{len(summary['views'])} outlines, {len(summary['pairs'])} pairs, {len(gcps)} GCPs."
    return sheet("map", "Map of the images", described, plane.height, parts)


def _pair_lines(plane: Plane, files: RunFiles) -> list[str]:
    """From middle to middle of the images of each pair."""
    middle = {}
    for view, outline in zip(files.summary["views"], files.outlines, strict=True):
        if outline:
            middle[view["name"]] = plane(np.concatenate([ring[:-1] for ring in outline])).mean(axis=0)
    pairs = [pair for pair in files.summary["pairs"] if pair["a"] in middle and pair["b"] in middle]
    most = max([pair["num_matches"] for pair in pairs], default=1)
    parts = []
    for pair in sorted(pairs, key=lambda p: p["num_matches"])[-1500:]:
        (x1, y1), (x2, y2) = middle[pair["a"]], middle[pair["b"]]
        opacity = 0.15 + 0.75 * math.sqrt(pair["num_matches"] / most)
        link = tag("line", x1=x1, y1=y1, x2=x2, y2=y2, class_="tie", stroke_opacity=opacity, stroke_width=1.6)
        parts.append(titled(link, f"{pair['a']} - {pair['b']}: {pair['num_matches']} matches"))
    return parts


def _number(plane: Plane, k: int, num: int, outline: Sequence[Array]) -> list[str]:
    """The image's number on its outline, at another place for each so that stacks of images stay readable."""
    if not outline or num > 100:
        return []
    ring = plane(outline[0][:-1])
    x, y = ring[(k * len(ring)) // num]
    circle = tag("circle", cx=x, cy=y, r=8, class_="badge")
    return [circle, label(x, y + 4, str(k + 1), "middle", "badgename")]


def _graticule(plane: Plane) -> list[str]:
    """Lines of longitude and latitude with their degrees, the frame and the scale bar."""
    right, bottom = WIDTH - 4, plane.height - 24
    reach = np.array([WIDTH / 2, plane.height / 2]) / plane.unit
    parts = []
    for lon in round_ticks(plane.lon - reach[0], plane.lon + reach[0], 4):
        x, _ = plane(np.array([lon, plane.lat]))
        shown = (lon + 180.0) % 360.0 - 180.0
        if 40 < x < right - 30:
            parts += [line(x, 4, x, bottom, "grid"), label(x, bottom - 4, _degrees(shown, "EW"), "middle")]
    for lat in round_ticks(plane.lat - reach[1], plane.lat + reach[1], 4):
        _, y = plane(np.array([plane.lon, lat]))
        if 16 < y < bottom - 20:
            parts += [line(4, y, right, y, "grid"), label(8, y - 3, _degrees(lat, "NS"))]
    length = max(round_ticks(0.0, 110.0 / plane.scale, 3))
    text = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    x = right - length * plane.scale
    parts += [tag("rect", x=x, y=bottom + 9, width=right - x, height=4, class_="scalebar")]
    return [*parts, label(x - 6, bottom + 15, text, "end"), label(4, bottom + 15, "north is up")]


def _degrees(value: float, letters: str) -> str:
    return f"{abs(value):g}° {letters[value < 0]}" if value else "0°"
