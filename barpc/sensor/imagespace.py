"""A sensor model whose image points are corrected in the image: shift, drift, affine.

The bias corrections of Fraser and Hanley ("Bias compensation in rational functions for Ikonos satellite
imagery", 2003) and Grodecki and Dial ("Block adjustment of high-resolution satellite images described by
rational polynomials", 2003), for comparison with the correction in space and for users who know them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barpc.errors import RpcError
from barpc.frozen import Frozen
from barpc.geodesy import Array
from barpc.sensor import SensorModel


@dataclass(frozen=True, eq=False)
class ImageAffine(Frozen):
    """image + shift + slope @ image.

    Parameters
    ----------
    shift : (2,)
        col, row [px].
    slope : (2, 2)
        Change of (col, row) by (col, row) [px/px].
    """

    shift: Array
    slope: Array

    def __post_init__(self) -> None:
        self._array("shift", (2,), RpcError)
        self._array("slope", (2, 2), RpcError)


@dataclass(frozen=True)
class ImageCorrected:
    """`sensor` with its image points corrected by `correction`; itself a `SensorModel`.

    Parameters
    ----------
    sensor : SensorModel
        The model as delivered.
    correction : ImageAffine
        What is added to its image points.
    """

    sensor: SensorModel
    correction: ImageAffine

    def project(self, ground: Array) -> Array:
        """Image points (..., 2) [px] of ground points (..., 3) [deg, deg, m]."""
        return self.sensor.project(ground) @ self._matrix.T + self.correction.shift

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Image points (..., 2) [px] and their derivative (..., 2, 3) [px/deg, px/deg, px/m]."""
        image, jacobian = self.sensor.project_jacobian(ground)
        return image @ self._matrix.T + self.correction.shift, self._matrix @ jacobian

    def localize(self, image: Array, alt: Array) -> Array:
        """Ground points (..., 3) seen at image points (..., 2) [px] at altitudes (...) [m]."""
        image = np.asarray(image, dtype=np.float64) - self.correction.shift
        return self.sensor.localize(image @ np.linalg.inv(self._matrix).T, alt)

    @property
    def _matrix(self) -> Array:
        return np.eye(2) + self.correction.slope
