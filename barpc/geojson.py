"""GeoJSON as RFC 7946 asks: longitudes -180 to 180, polygons cut at the antimeridian, closed at a pole."""

from __future__ import annotations

from typing import Any

import numpy as np

from barpc.geodesy import Array


def polygon(ring: Array) -> dict[str, Any] | None:
    """Return the geometry of a footprint: counter-clockwise, closed; led to the pole if it goes around one.

    Of a ring (N, 2) as `barpc.sensor.geometry.footprint` gives it; a MultiPolygon where the antimeridian cuts it, None
    for an outline that is not finite.
    """
    ring = np.asarray(ring, dtype=np.float64)
    if not np.isfinite(ring).all():
        return None
    step = np.diff(ring[:, 0], append=ring[:1, 0])
    step -= 360.0 * np.rint(step / 360.0)
    turn = 360.0 * np.rint(step.sum() / 360.0)
    if turn:
        ring = _clip(_around_pole(ring, step, turn), -180.0)
    if _area(ring) < 0:
        ring = ring[::-1]
    first = int(np.floor((ring[:, 0].min() + 180.0) / 360.0))
    last = int(np.ceil((ring[:, 0].max() + 180.0) / 360.0))
    parts = []
    for world in range(first, max(last, first + 1)):
        part = _clip(ring, 360.0 * world - 180.0)
        if len(part) >= 3 and _area(part):
            part = part - [360.0 * world, 0.0]
            parts.append([[*part.tolist(), part[0].tolist()]])
    if len(parts) == 1:
        return {"type": "Polygon", "coordinates": parts[0]}
    return {"type": "MultiPolygon", "coordinates": parts}


def feature(ring: Array, **properties: Any) -> dict[str, Any]:
    """Return a Feature of a footprint with its properties."""
    return {"type": "Feature", "properties": properties, "geometry": polygon(ring)}


def collection(features: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a FeatureCollection."""
    return {"type": "FeatureCollection", "features": features}


def _around_pole(ring: Array, step: Array, turn: float) -> Array:
    """Return the area between an outline around a pole and that pole, three turns of it: from it one is cut."""
    lon = ring[0, 0] % 360.0 - 1.5 * turn + np.concatenate([[0.0], np.cumsum(np.tile(step, 3))])
    lat = np.append(np.tile(ring[:, 1], 3), ring[0, 1])
    pole = 90.0 if lat.mean() > 0 else -90.0
    return np.column_stack([np.concatenate([lon, lon[[-1, 0]]]), np.concatenate([lat, [pole, pole]])])


def _area(ring: Array) -> float:
    x, y = ring.T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def _clip(ring: Array, west: float) -> Array:
    """Return the part of a polygon within 360 degrees east of a meridian (Sutherland and Hodgman)."""
    for lon, side in ((west, 1.0), (west + 360.0, -1.0)):
        out: list[Array] = []
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            inside_a, inside_b = side * (a[0] - lon) >= 0, side * (b[0] - lon) >= 0
            if inside_a:
                out.append(a)
            if inside_a != inside_b:
                t = (lon - a[0]) / (b[0] - a[0])
                out.append(np.array([lon, a[1] + t * (b[1] - a[1])]))
        ring = np.array(out).reshape(-1, 2)
    return ring
