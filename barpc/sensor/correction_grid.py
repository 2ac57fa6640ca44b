"""What an RPC lacks, as displacements on a grid over the image: true image position = RPC's + (dcol, drow)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from barpc.errors import RpcError
from barpc.frozen import Frozen
from barpc.geodesy import Array
from barpc.sensor import SensorModel
from barpc.sensor.direct_grid import LINEAR, linear_axes

_LONGEST = 1024.0  # px, from node to node


@dataclass(frozen=True, eq=False)
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

    def __post_init__(self) -> None:
        for name in ("cols", "rows"):
            axis = self._array(name, (None,), RpcError)
            if len(axis) < 2 or not (np.diff(axis) > 0).all():
                raise RpcError(f"correction grid: {name} must ascend")
        self._array("shift", (len(self.rows), len(self.cols), 2), RpcError)

    @classmethod
    def between(
        cls,
        rpc: SensorModel,
        model: SensorModel,
        size: tuple[int, int],
        alt: float,
        tolerance: float = LINEAR,
    ) -> CorrectionGrid:
        """What takes the image points of `rpc` to those of `model`, seen on ground of one altitude [m].

        Linear interpolation misses by no more than `tolerance` [px]. RpcError where a camera sees no ground.
        """

        def lacking(points: Array) -> Array:
            return model.project(rpc.localize(points, np.full(points.shape[:-1], alt))) - points

        low, high = np.full(2, -0.5), np.asarray(size) - 0.5
        cols, rows = linear_axes(lacking, low, high, np.full(2, _LONGEST), tolerance)
        nodes = np.stack(np.meshgrid(cols, rows), axis=-1)
        return cls(cols, rows, lacking(nodes).astype(np.float32).astype(np.float64))

    def at(self, image: Array) -> Array:
        """Displacements (..., 2) [px] at image points (..., 2) [px] of the RPC; NaN at NaN."""
        ends = np.array([(axis[0], axis[-1]) for axis in (self.cols, self.rows)]).T
        inside = np.clip(image, *ends)[..., ::-1]
        return np.asarray(RegularGridInterpolator((self.rows, self.cols), self.shift)(inside))

    def apply(self, image: Array) -> Array:
        """True image points (..., 2) [px] of those of the RPC (..., 2) [px]."""
        return np.asarray(image + self.at(image))
