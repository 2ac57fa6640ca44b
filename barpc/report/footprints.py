"""Outlines of the images on the ground as GeoJSON (RFC 7946)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from shapely import Polygon, box
from shapely.affinity import translate
from shapely.geometry.polygon import orient

from barpc.geodesy import Array
from barpc.report.run import Run
from barpc.sensor.geometry import footprint


def footprints_geojson(run: Run, summary: Mapping[str, Any]) -> dict[str, Any]:
    """A FeatureCollection with the outline of every image at the scene's altitude.

    Through the adjusted cameras, or the cameras as they are for a check.

    Parameters
    ----------
    run : Run
        The run.
    summary : mapping
        Its summary: name, status and errors become properties.
    """
    cameras = run.after or run.before
    features = []
    for view, sensor, entry in zip(run.views, cameras, summary["views"], strict=True):
        ring = footprint(sensor, view.size, run.altitude)
        keys = ("name", "path", "status", "num_observations", "rmse_before", "rmse_after", "gsd_m")
        properties = {key: entry[key] for key in keys} | {"altitude_m": summary["altitude_m"]}
        features.append({"type": "Feature", "geometry": polygon_geometry(ring), "properties": properties})
    return {"type": "FeatureCollection", "features": features}


def polygon_geometry(ring: Array) -> dict[str, Any] | None:
    """An outline as a geometry of RFC 7946: counter-clockwise, cut where it crosses the antimeridian.

    Parameters
    ----------
    ring : (N, 2)
        lon, lat [deg], not closed; longitudes run on continuously beyond +-180.

    Returns
    -------
    geometry : dict or None
        A Polygon, or a MultiPolygon of the parts on both sides of the antimeridian; None for an outline with
        points that are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> square = np.array([[179.0, 1.0], [181.0, 1.0], [181.0, 0.0], [179.0, 0.0]])
    >>> polygon_geometry(square)["type"]
    'MultiPolygon'
    """
    if not np.isfinite(ring).all():
        return None
    shape = Polygon(ring)
    parts = []
    for turn in (-360.0, 0.0, 360.0):
        part = translate(shape, turn).intersection(box(-180.0, -90.0, 180.0, 90.0))
        parts += [p for p in getattr(part, "geoms", [part]) if isinstance(p, Polygon) and p.area > 0]
    rings = [[np.round(orient(part).exterior.coords, 9).tolist()] for part in parts]
    if len(rings) == 1:
        return {"type": "Polygon", "coordinates": rings[0]}
    return {"type": "MultiPolygon", "coordinates": rings}
