"""What lies on the ground of a map: where tie points move together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from barpc.geodesy import Array
from barpc.report.charts import tag, titled
from barpc.report.summary import Summary

Plane = Callable[[Array], Array]
"""Places (..., 2) on a sheet of lon, lat [deg] (..., 2)."""
_DARKEST = 0.7  # where all tie points move


def moving_ground(plane: Plane, summary: Summary) -> list[str]:
    """Cells of the ground in which tie points move together, stronger with more of them, and where each group lies."""
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
