"""Sentinel-1: Range-Doppler models from the annotation XML alone.

`open_product` makes the model of a product, `RangeDoppler.from_annotation` that of one file, `mosaic` that
of several swaths. The rest says where bursts and swaths lie, and how the model agrees with the product's
own geolocation grid.
"""

from __future__ import annotations

from barpc.sensor.sentinel1.annotation import Annotation, read_annotation
from barpc.sensor.sentinel1.build import (
    BurstRows,
    burst_rows,
    from_annotation,
    grid_residuals,
    mosaic,
    mosaic_offsets,
    open_product,
)
from barpc.sensor.sentinel1.frames import Delays, GroundFrame, SlantFrame
from barpc.sensor.sentinel1.orbit import Orbit, fit_orbit
from barpc.sensor.sentinel1.range_doppler import RangeDoppler

__all__ = [
    "Annotation",
    "BurstRows",
    "Delays",
    "GroundFrame",
    "Orbit",
    "RangeDoppler",
    "SlantFrame",
    "burst_rows",
    "fit_orbit",
    "from_annotation",
    "grid_residuals",
    "mosaic",
    "mosaic_offsets",
    "open_product",
    "read_annotation",
]
