"""Sensor models: ground to image and back.

A sensor model is anything with the three methods of `SensorModel`. Models do not inherit from each
other and do not know each other; they are frozen, picklable and compare by content.

`ground` is (lon [deg], lat [deg], alt [m above the WGS84 ellipsoid]); `image` is (col, row) [px] with
(0, 0) at the CENTRE of the top-left pixel. Both stand on the last axis; leading axes broadcast. A point
that fails is NaN: one bad point of a million is never an exception.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from barpc.geodesy import Array


@runtime_checkable
class SensorModel(Protocol):
    """The protocol of every camera: projection, its derivative, localisation."""

    def project(self, ground: Array) -> Array:
        """Project ground points (..., 3) [deg, deg, m] to image points (..., 2) [px]."""
        ...

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return image points (..., 2) [px] and their derivatives (..., 2, 3) [px/deg, px/deg, px/m]."""
        ...

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points (..., 2) [px] at altitudes (...) [m]: ground points (..., 3)."""
        ...


__all__ = ["SensorModel"]
