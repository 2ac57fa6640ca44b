"""Sensor models: ground to image and back.

A sensor model is anything with the three methods of `SensorModel`. Models do not know each other; they are frozen,
picklable and compare by content. Those that stand on their own are `Pointwise`, those that are another one behind a
correction `Behind`.

`ground` is (lon [deg], lat [deg], alt [m above the WGS84 ellipsoid]); `image` is (col, row) [px] with
(0, 0) at the CENTRE of the top-left pixel. Both stand on the last axis; leading axes broadcast. A point
that fails is NaN: one bad point of a million is never an exception.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from barpc.base.frozen import Frozen
from barpc.base.geodesy import Array, as_ground, as_image, pointwise

ITERATION_TOLERANCE = 1e-7
"""Last step of iterated image points [px]: the remaining error is a hundredth of it."""
_MAX_ITERATIONS = 100  # a step leaves a hundredth of the error: four suffice where it converges at all


@runtime_checkable
class SensorModel(Protocol):
    """The protocol of every camera: projection, its derivative, localisation.

    Examples
    --------
    >>> isinstance(barpc.read_rpc("data_samples/view_00.tif"), barpc.SensorModel)
    True
    """

    def project(self, ground: Array) -> Array:
        """Project ground points (..., 3) [deg, deg, m] to image points (..., 2) [px]."""
        ...

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return image points (..., 2) [px] and their derivatives (..., 2, 3) [px/deg, px/deg, px/m]."""
        ...

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points (..., 2) [px] at altitudes (...) [m]: ground points (..., 3)."""
        ...


class Pointwise(Frozen):
    """Base of the models that stand on their own: itself a `SensorModel`.

    Of n points they give `_project` (n, 3) -> image (n, 2); `_derivatives` (n, 3) -> image, jacobian (n, 2, 3) and
    perhaps more; `_localize` (n, 2), (n,) -> ground (n, 3). Each takes memory (`_memory`, n) to overwrite, too, if any.
    """

    _memory: ClassVar[int] = 0
    _project: Callable[..., Array]
    _derivatives: Callable[..., tuple[Array, ...]]
    _localize: Callable[..., Array]

    def project(self, ground: Array) -> Array:
        """Project ground points (..., 3) [deg, deg, m] to image points (..., 2) [px]; NaN where they are not seen."""
        return pointwise(lambda *part: [self._project(*part)], [(2,)], as_ground(ground), rows=self._memory)[0]

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return image points (..., 2) [px] and their derivatives (..., 2, 3) [px/deg, px/deg, px/m]."""
        shapes = [(2,), (2, 3)]
        ground = as_ground(ground)
        image, jacobian = pointwise(lambda *part: self._derivatives(*part)[:2], shapes, ground, rows=self._memory)
        return image, jacobian

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points (..., 2) [px] at altitudes (...) [m]: ground points (..., 3).

        Longitudes run on across the antimeridian; NaN outside the model's validity, or off the ground.
        """
        return pointwise(lambda *part: [self._localize(*part)], [(3,)], as_image(image), alt, rows=self._memory)[0]


@dataclass(frozen=True)
class Behind:
    """Base of models that are another one, `sensor`, behind a correction."""

    sensor: Any

    @property
    def advice(self) -> str:
        """Remedy where no RPC represents the model; empty where it does not know."""
        return str(getattr(self.sensor, "advice", ""))


def fixed_point(follow: Callable[[Array], Array], image: Array) -> Array:
    """Return the fixed point (..., 2) [px] of the iteration `follow`, from a first guess."""
    change = np.zeros(())
    for _ in range(_MAX_ITERATIONS):
        before, image = image, follow(image)
        last, change = change, np.abs(image - before)
        with np.errstate(all="ignore"):  # a step leaves a hundredth of itself, or what it was of the step before
            left = np.fmin(change, 100.0 * change * change / last)
        if not (left.max(initial=0.0, where=np.isfinite(left)) > ITERATION_TOLERANCE):
            break
    return image


__all__ = ["Behind", "Pointwise", "SensorModel", "fixed_point"]
