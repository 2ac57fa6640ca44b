"""What a fit can be asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from barpc.errors import FitError
from barpc.frozen import Frozen
from barpc.geodesy import Array

Method = Literal["auto", "ridge", "lcurve", "vendor-denominators"]
Space = Literal["image", "ground"]
Nodes = Literal["uniform", "chebyshev"]
FormatName = Literal["nitf", "rpcm"]

ALTITUDE_FLOOR = 50.0
"""Smallest altitude half range [m] that a model is sampled over, and smallest altitude scale of an RPC."""


@dataclass(frozen=True, eq=False)
class Normalization(Frozen):
    """The offsets and scales of an RPC.

    Parameters
    ----------
    ground_offset, ground_scale : (3,)
        lon, lat [deg], alt [m]. A scale may be negative, not zero.
    image_offset, image_scale : (2,)
        col, row [px].
    """

    ground_offset: Array
    ground_scale: Array
    image_offset: Array
    image_scale: Array

    def __post_init__(self) -> None:
        for name in ("ground_offset", "ground_scale", "image_offset", "image_scale"):
            value = self._array(name, (3 if name.startswith("ground") else 2,), FitError)
            if name.endswith("scale") and not value.all():
                raise FitError(f"Normalization {name}: a scale is zero")


@dataclass(frozen=True)
class FitOptions:
    """How an RPC is fitted to a sensor model or to points.

    Parameters
    ----------
    method : {"auto", "ridge", "lcurve", "vendor-denominators"}
        ``ridge``: QR compression and a noise-scaled ridge. ``lcurve``: the paper's solver.
        ``vendor-denominators``: numerators only. ``auto``: ``ridge``, and another one where the
        certificate says that it is better.
    grid : (int, int, int)
        Control points along col (or lon), row (or lat) and altitude; at least 4 each.
    space : {"image", "ground"}
        Whether the grid is regular in (col, row, alt), or in (lon, lat, alt) as in the paper.
    nodes : {"uniform", "chebyshev"}
        Spacing of the control points; Chebyshev-Lobatto nodes crowd towards the ends.
    tolerance : float
        [px]; a fit whose check points miss by more in one coordinate is refused.
    weighted : int
        Further passes of ``ridge`` with the residuals weighted by 1 / denominator, made where that varies
        by more than 5 %.
    tau : float
        Standard deviation that ``ridge`` expects of a denominator coefficient (no unit).
    joint : bool
        ``lcurve`` with one h for col and row (78 unknowns) instead of one each (39 + 39).
    normalization : Normalization, optional
        Offsets and scales to be used as they are.
    precision : {"nitf", "rpcm"}, optional
        Fit numbers that a format with few digits can hold (`barpc.fit.precision.PRECISIONS`).
    allow_mirrored : bool
        Accept points that show the ground mirrored (as radar images do) without suspecting that two
        columns are swapped.
    """

    method: Method = "auto"
    grid: tuple[int, int, int] = (12, 12, 7)
    space: Space = "image"
    nodes: Nodes = "chebyshev"
    tolerance: float = 0.01
    weighted: int = 1
    tau: float = 0.003
    joint: bool = False
    normalization: Normalization | None = None
    precision: FormatName | None = None
    allow_mirrored: bool = False

    def __post_init__(self) -> None:
        if min(self.grid) < 4 or len(self.grid) != 3:
            raise FitError(f"grid {self.grid}: a cubic needs at least 4 control points along each axis")
        if not (self.tolerance > 0 and self.tau > 0 and self.weighted >= 0):
            raise FitError("tolerance and tau must be positive, weighted not negative")
