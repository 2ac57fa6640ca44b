"""A radar's clocks: range and azimuth time are off by an amount and a slope along the flight, not by an attitude."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self, TypeGuard

import numpy as np
from numpy.polynomial import polynomial

from barpc.errors import RpcError
from barpc.frozen import Frozen
from barpc.geodesy import Array
from barpc.sensor import SensorModel


@dataclass(frozen=True, eq=False)
class Timing(Frozen):
    """Corrections of a radar's range and azimuth time: polynomials of the position along the flight.

    Parameters
    ----------
    coeffs : (D + 1, 2)
        Range [m] and azimuth time [s], one way, by the powers 1, u, u^2, ... of u = (along - offset) / scale.
    offset, scale : float, of the coordinate along the flight where u = 0, and from there to u = 1
    """

    coeffs: Array
    offset: float = 0.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        self._array("coeffs", (None, 2), RpcError)
        if not (len(self.coeffs) and np.isfinite(self.offset) and np.isfinite(self.scale) and self.scale > 0):
            raise RpcError(f"timing: {len(self.coeffs)} terms, offset {self.offset}, scale {self.scale}")

    def at(self, along: Array) -> Array:
        """Return the range [m] and azimuth time [s] (2, N) that are added at coordinates (N,)."""
        return np.asarray(polynomial.polyval((along - self.offset) / self.scale, self.coeffs))

    def rate(self, along: Array) -> Array:
        """Return the derivative (2, N) of range and azimuth time by the coordinate."""
        slopes = polynomial.polyder(self.coeffs) / self.scale
        return np.asarray(polynomial.polyval((along - self.offset) / self.scale, slopes))


class Clocked(SensorModel, Protocol):
    """A radar model whose clocks can be corrected."""

    azimuth_axis: int
    """The image coordinate that goes along the flight: 0 (col) or 1 (row)."""

    @property
    def accuracy(self) -> tuple[float, float] | None:
        """Stated standard deviations of range and of the position along the flight [m]."""
        ...

    @property
    def speed(self) -> float:
        """Speed of the flight [m/s]."""
        ...

    def timed(self, timing: Timing) -> Self:
        """Return the model with a timing, its coordinate in pixels, in place of its own."""
        ...

    def timing_jacobian(self, ground: Array) -> tuple[Array, Array, Array, Array]:
        """Return image points (..., 2) [px] of ground points (..., 3), their derivatives by range and azimuth
        time, and the coordinate along the flight.

        d(image)/d(ground) (..., 2, 3), d(image)/d(range, azimuth time) (..., 2, 2) [px/m, px/s], and (...) [px].
        """
        ...


def is_clocked(sensor: SensorModel) -> TypeGuard[Clocked]:
    """Return whether a model is a radar whose clocks can be corrected: asking the protocol itself costs 70 us
    a view.
    """
    return hasattr(sensor, "timed")


@dataclass(frozen=True)
class Timed:
    """A radar model behind the correction of its clocks; itself a `SensorModel`."""

    sensor: Clocked  # the model as delivered
    correction: Timing  # its coordinate is the image's, along the flight [px]

    @cached_property
    def _model(self) -> Clocked:
        return self.sensor.timed(self.correction)

    @property
    def advice(self) -> str:
        """What to do where no RPC follows the model; empty where it does not know."""
        return str(getattr(self.sensor, "advice", ""))

    def project(self, ground: Array) -> Array:
        """Project ground points (..., 3) [deg, deg, m] to image points (..., 2) [px]."""
        return self._model.project(ground)

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return image points (..., 2) [px] and their derivatives (..., 2, 3) [px/deg, px/deg, px/m]."""
        return self._model.project_jacobian(ground)

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points (..., 2) [px] at altitudes (...) [m]: ground points (..., 3)."""
        return self._model.localize(image, alt)

    def timing_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return the image points (..., 2) [px], and their derivative by range and azimuth time (..., 2, 2)
        [px/m, px/s].
        """
        image, _, by_timing, _ = self._model.timing_jacobian(ground)
        return image, by_timing
