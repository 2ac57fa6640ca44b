"""What an RPC lacks, as displacements on a grid over the image: true image position = RPC's + (dcol, drow)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from barpc.base.errors import RpcError
from barpc.base.frozen import Frozen
from barpc.base.geodesy import Array
from barpc.sensor import Displaced, SensorModel, fixed_point
from barpc.sensor.direct_grid import LINEAR, LONGEST, linear_axes

if TYPE_CHECKING:
    from scipy.interpolate import RegularGridInterpolator


@dataclass(frozen=True, eq=False, repr=False)
class CorrectionGrid(Frozen):
    """Displacements (dcol, drow) over an image, linear between the nodes and constant beyond them.

    Parameters
    ----------
    cols, rows : (W,), (H,), nodes [px], evenly spaced and ascending; (0, 0) is the centre of the top-left pixel
    shift : (H, W, 2), what is added to the image point of the RPC to get the true one [px]
    """

    cols: Array
    rows: Array
    shift: Array
    _linear: RegularGridInterpolator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("cols", "rows"):
            axis = self._array(name, (None,), RpcError)
            if len(axis) < 2 or not (np.diff(axis) > 0).all():
                raise RpcError(f"correction grid: {name} must ascend")
        shift = self._array("shift", (len(self.rows), len(self.cols), 2), RpcError)
        from scipy.interpolate import RegularGridInterpolator  # a quarter of a second, of grids alone

        self._keep("_linear", RegularGridInterpolator((self.rows, self.cols), shift, bounds_error=False))

    @classmethod
    def between(
        cls,
        rpc: SensorModel,
        model: SensorModel,
        size: tuple[int, int],
        alt: float,
        tolerance: float = LINEAR,
    ) -> CorrectionGrid:
        """Return the displacements from the image points of `rpc` to those of `model` for ground of one
        altitude [m].

        Linear interpolation misses by no more than `tolerance` [px]. RpcError where a camera sees no ground.
        """

        def lacking(points: Array) -> Array:
            return model.project(rpc.localize(points, np.full(points.shape[:-1], alt))) - points

        low, high = np.full(2, -0.5), np.asarray(size) - 0.5
        cols, rows = linear_axes(lacking, low, high, np.array(LONGEST[:2]), tolerance)
        nodes = np.stack(np.meshgrid(cols, rows), axis=-1)
        return cls(cols, rows, lacking(nodes).astype(np.float32).astype(np.float64))

    def at(self, image: Array) -> Array:
        """Return the displacements (..., 2) [px] at image points (..., 2) [px] of the RPC; NaN at NaN."""
        low, high = np.array([(axis[0], axis[-1]) for axis in (self.cols, self.rows)]).T
        inside = np.clip(image, low, high)[..., ::-1]
        return np.asarray(self._linear(inside)).reshape(inside.shape)

    def apply(self, image: Array) -> Array:
        """Return the true image points (..., 2) [px] of those of the RPC (..., 2) [px]."""
        return np.asarray(image + self.at(image))

    def linearised(self, image: Array) -> tuple[Array, Array]:
        """Return the same, and its derivative (..., 2, 2), over a tenth of a cell around the image points."""
        reach = 0.05 * np.array([self.cols[1] - self.cols[0], self.rows[1] - self.rows[0]])
        by_axis = [(self.apply(image + step) - self.apply(image - step)) / (2 * step.sum()) for step in np.diag(reach)]
        return self.apply(image), np.stack(by_axis, axis=-1)

    def undo(self, image: Array) -> Array:
        """Return the image points (..., 2) [px] of the RPC that belong to true ones."""
        return fixed_point(lambda of_rpc: image - self.at(of_rpc), image)


@dataclass(frozen=True)
class GridCorrected(Displaced):
    """`sensor`, an RPC, and what it lacks; itself a `SensorModel`."""

    correction: CorrectionGrid  # what is added to its image points
