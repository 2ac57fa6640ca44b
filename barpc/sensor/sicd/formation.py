"""What a pixel of a radar image states: the range and its rate at the centre of its aperture.

(x, y) [m] are the image's own coordinates, along its rows' and its columns' numbers, from the scene centre point
(SCP). Equations: SICD volume 3, "Image Projections Description", sections 4 and 5; names are the document's.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from barpc.errors import RpcError
from barpc.frozen import Frozen
from barpc.geodesy import Array
from barpc.sensor.circle import dot
from barpc.sensor.curve import Curve


class Aperture(NamedTuple):
    """Position and velocity of the radar for N pixels, and the range and range rate measured there."""

    position: Array  # (3, N): ECEF [m]
    velocity: Array  # (3, N): [m/s]
    distance: Array  # (N,): R [m]
    rate: Array  # (N,): dR/dt [m/s]
    time: Array  # (N,): of the centre of the aperture [s]


@dataclass(frozen=True, eq=False)
class Formation(Frozen, ABC):
    """Image formation: from pixels to range and range rate.

    Parameters
    ----------
    time : (K, L), TimeCOAPoly: coefficients of x^k y^l [s]
    """

    time: Array

    def __post_init__(self) -> None:
        self._array("time", (None, None), RpcError)

    def at(self, x: Array, y: Array, orbit: Curve) -> Aperture:
        """Return the apertures of N pixels at x, y (N,) [m]."""
        time: Array = np.asarray(polynomial.polyval2d(x, y, self.time), dtype=np.float64)
        position, velocity = orbit(time)
        return Aperture(position, velocity, *self._contour(x, y, time, position, velocity, orbit), time)

    @abstractmethod
    def _contour(
        self, x: Array, y: Array, time: Array, position: Array, velocity: Array, orbit: Curve
    ) -> tuple[Array, Array]: ...


def _to(point: Array, position: Array, velocity: Array) -> tuple[Array, Array]:
    """Return the range and its rate (N,) of a point (3, N) or (3, 1)."""
    sight = position - point
    distance = np.sqrt(dot(sight, sight))
    return distance, dot(velocity, sight) / distance


@dataclass(frozen=True, eq=False)
class PolarFormat(Formation):
    """Grid RGAZIM made by the polar format algorithm (PFA).

    Parameters
    ----------
    scp : (3,), ECEF [m]
    angle : (K,), PolarAngPoly: coefficients by time [rad]
    scale : (K,), SpatialFreqSFPoly: coefficients by that angle
    """

    scp: Array
    angle: Array
    scale: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, length in (("scp", 3), ("angle", None), ("scale", None)):
            self._array(name, (length,), RpcError)

    def _contour(
        self, x: Array, y: Array, time: Array, position: Array, velocity: Array, orbit: Curve
    ) -> tuple[Array, Array]:
        distance, rate = _to(self.scp[:, None], position, velocity)
        angle = polynomial.polyval(time, self.angle)
        turning = polynomial.polyval(time, polynomial.polyder(self.angle))
        scale = polynomial.polyval(angle, self.scale)
        by_angle = polynomial.polyval(angle, polynomial.polyder(self.scale))
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        return distance + scale * along, rate + (by_angle * along + scale * across) * turning


@dataclass(frozen=True, eq=False)
class RangeAzimuth(Formation):
    """Grid RGAZIM made by range-azimuth compression (RGAZCOMP); `factor` is AzSF [1/m]."""

    scp: Array
    factor: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self._array("scp", (3,), RpcError)

    def _contour(
        self, x: Array, y: Array, time: Array, position: Array, velocity: Array, orbit: Curve
    ) -> tuple[Array, Array]:
        distance, rate = _to(self.scp[:, None], position, velocity)
        return distance + x, rate - np.sqrt(dot(velocity, velocity)) * self.factor * y


@dataclass(frozen=True, eq=False)
class ZeroDoppler(Formation):
    """Grid RGZERO made by range migration with imaging near closest approach (RMA, INCA).

    Parameters
    ----------
    closest_time : (K,), TimeCAPoly: time of closest approach by y [s]
    closest : R_CA_SCP, range of closest approach of the SCP [m]
    scale : (K, L), DRateSFPoly
    """

    closest_time: Array
    closest: float
    scale: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        self._array("closest_time", (None,), RpcError)
        self._array("scale", (None, None), RpcError)

    def _contour(
        self, x: Array, y: Array, time: Array, position: Array, velocity: Array, orbit: Curve
    ) -> tuple[Array, Array]:
        closest_time = np.asarray(polynomial.polyval(y, self.closest_time), dtype=np.float64)
        _, speed = orbit(closest_time)
        late, closest = time - closest_time, self.closest + x
        bend = polynomial.polyval2d(x, y, self.scale) * dot(speed, speed)
        distance = np.sqrt(closest**2 + bend * late**2)
        return distance, bend * late / distance


@dataclass(frozen=True, eq=False)
class ImagePlane(Formation):
    """Grids XRGYCR, XCTYAT and PLANE: a pixel is a point of a plane.

    Parameters
    ----------
    scp : (3,), ECEF [m]
    along_x, along_y : (3,), unit vectors of the rows' and the columns' numbers (Row and Col UVectECF)
    """

    scp: Array
    along_x: Array
    along_y: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("scp", "along_x", "along_y"):
            self._array(name, (3,), RpcError)

    def _contour(
        self, x: Array, y: Array, time: Array, position: Array, velocity: Array, orbit: Curve
    ) -> tuple[Array, Array]:
        point = self.scp[:, None] + self.along_x[:, None] * x + self.along_y[:, None] * y
        return _to(point, position, velocity)
