"""The place of an image on the line of detectors of its sensor: which column of the line its first column is.

An image may be a whole product or a part of one. A physical camera model is of a whole product. An RPC states the
columns that it was made for: of a part whose RPC was moved with it they are those of the whole product. Nothing else is
guessed: an RPC fitted to a part alone states that part, whose place is not known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barpc.base.errors import InputError
from barpc.scene import Camera
from barpc.sensor.radar import Radar
from barpc.sensor.rpc import RPC

LEAST_LINE = 2000
"""Columns: the shortest lines and frames of sensors with RPCs have 2560 (SkySat, PlanetScope); parts are often less."""
STATED_TO = 2.0  # px: vendors count from 0 or from 1, and round a half
_PADDED = 0.03  # of a line: RPCs of whole products reach beyond their images by up to 1 %
_GROUND_SPAN = 0.9, 3.0  # columns of an RPC's ground over its own: 1.0 to 2.9, as ground is a box in lon, lat


@dataclass(frozen=True)
class LinePlace:
    """Column of the line that an image's first column is [px], columns of the line, the place's standard deviation
    [px], and its source in words.
    """

    start: float
    columns: float
    sigma: float
    source: str


def line_place(camera: Camera, size: tuple[int, int]) -> LinePlace:
    """Return the place of an image of a size [px] on its sensor's line; InputError, with the reason, where none is
    known.
    """
    width, model = size[0], camera.model
    if isinstance(model, Radar):
        raise InputError("a radar has no line of detectors")
    for doubt in camera.doubts:
        raise InputError(f"its camera may not be its own ({doubt.sentence})")
    if not isinstance(model, RPC):
        if camera.size != size:
            raise InputError(f"its camera model is of {camera.size} px, the image of {size} px")
        return _long_enough(LinePlace(0.0, float(width), STATED_TO, "its camera model"))
    middle, half = float(model.image_offset[0]), float(model.image_scale[0])
    first, columns = middle - half, 2.0 * half + 1.0
    begins = abs(first) <= _PADDED * columns and abs(columns / width - 1.0) <= _PADDED
    if begins or abs(2.0 * middle - width) <= STATED_TO:
        return _long_enough(LinePlace(0.0, float(width), STATED_TO, "its RPC is of the whole image"))
    corners = np.array([(a, b, 0.0) for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
    of_ground = float(np.ptp(model.project(model.ground_offset + corners * model.ground_scale)[:, 0])) / columns
    inside = first - STATED_TO <= 0.0 and width <= first + columns + STATED_TO
    if not (inside and _GROUND_SPAN[0] <= of_ground <= _GROUND_SPAN[1]):
        raise InputError(
            f"its RPC states columns {first:.0f} to {first + columns - 1:.0f} for an image of {width}, and the ground "
            f"of {of_ground * columns:.0f} columns: these are not the columns of a whole product"
        )
    return _long_enough(LinePlace(-first, columns, STATED_TO, "the columns that its RPC states"))


def _long_enough(place: LinePlace) -> LinePlace:
    if place.columns < LEAST_LINE:
        raise InputError(
            f"{place.source}, and {place.columns:.0f} columns are no whole line of a sensor ({LEAST_LINE} at least): "
            "it is reduced, or a part with an RPC of the part alone"
        )
    return place
