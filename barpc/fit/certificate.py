"""The certificate: what a fitted RPC does on points that the fit has not seen."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from barpc.geodesy import Array, wrap_longitude
from barpc.sensor.rpc import RPC, monomials

_BEYOND = 1.25  # the box and 25 %


@dataclass(frozen=True, eq=False)
class RpcFit:
    """A fitted RPC and its certificate.

    Parameters
    ----------
    rpc : RPC
        The result.
    rmse_cnp, max_cnp : (2,)
        Root mean square and largest error of col, row on the control points [px].
    rmse_ckp, max_ckp : (2,)
        The same on the check points, which the fit has not seen [px].
    min_denominator : float
        Smallest value of a denominator over the ground box and 25 % around it, relative to the value at
        its centre; near or below zero there is a pole.
    roundtrip : float
        Largest distance between a check point and where the RPC localises its projection [px]; infinite
        where localisation fails.
    coverage : float
        Share of the image inside the convex hull of the control points.
    h : (2,)
        Regularisation used for col, row.
    iterations : int
        Passes over the points.
    num_cnp, num_ckp : int
        Number of points.
    method : str
        The solver whose result this is.
    """

    rpc: RPC
    rmse_cnp: Array
    max_cnp: Array
    rmse_ckp: Array
    max_ckp: Array
    min_denominator: float
    roundtrip: float
    coverage: float
    h: Array
    iterations: int
    num_cnp: int
    num_ckp: int
    method: str

    def summary(self) -> dict[str, Any]:
        """The certificate as plain numbers and lists, col before row, lengths in px."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "rpc"}
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}

    def verdict(self, tolerance: float) -> str:
        """What is wrong with this fit at a tolerance [px], in words; empty if nothing is."""
        worst = float(self.max_ckp.max())
        if not worst <= tolerance:
            return (
                f"the RPC misses its check points by up to {worst:.3g} px (RMSE col {self.rmse_ckp[0]:.3g}, "
                f"row {self.rmse_ckp[1]:.3g}), wanted {tolerance:g}: fit a smaller altitude range or a "
                "smaller image, or raise the tolerance"
            )
        if not self.min_denominator > 0:
            return "the RPC has a pole near the scene: use more control points or a stronger regularisation"
        if not self.roundtrip <= max(tolerance, 1e-6):
            return f"the RPC cannot be inverted over the scene (round trip {self.roundtrip:.3g} px)"
        return ""


@dataclass
class Errors:
    """Running root mean square and largest error of (N, 2) residuals [px]."""

    count: int = 0
    squares: Array = field(default_factory=lambda: np.zeros(2))
    largest: Array = field(default_factory=lambda: np.zeros(2))

    def add(self, residual: Array) -> None:
        """Take in residuals (N, 2); one that is NaN makes the result NaN."""
        if len(residual):
            self.count += len(residual)
            self.squares = self.squares + np.einsum("ij,ij->j", residual, residual)
            self.largest = np.maximum(self.largest, np.abs(residual.T).max(axis=1))

    @property
    def rmse(self) -> Array:
        """Root mean square (2,) [px]."""
        return np.asarray(np.sqrt(self.squares / self.count)) if self.count else np.full(2, np.nan)


def smallest_denominator(rpc: RPC, low: Array, high: Array) -> float:
    """Smallest denominator over a ground box and 25 % around it, relative to its centre.

    Parameters
    ----------
    rpc : RPC
        The model.
    low, high : (3,)
        Corners of the box; lon, lat [deg], alt [m].
    """
    corner = rpc.normalize(np.stack([low, high]))
    middle, half = corner.mean(axis=1), 0.5 * np.abs(corner[:, 1] - corner[:, 0])
    t = np.linspace(-_BEYOND, _BEYOND, 11)
    lattice = np.stack(np.meshgrid(t, t, t, indexing="ij")).reshape(3, -1)
    value = rpc.coeffs[1::2] @ monomials(middle[:, None] + half[:, None] * lattice)
    center = value[:, [lattice.shape[1] // 2]]
    return float((value / center).min())


def roundtrip(rpc: RPC, ground: Array) -> float:
    """Largest distance [px] between ground points (N, 3) and where their projections are localised."""
    image, jacobian = rpc.project_jacobian(ground)
    back = rpc.localize(image, ground[:, 2])
    miss = back - ground
    miss[:, 0] = wrap_longitude(miss[:, 0])
    distance = np.abs(np.einsum("nij,nj->ni", jacobian, miss))
    return float(distance.max(initial=0.0)) if np.isfinite(distance).all() else float("inf")


def coverage(image: Array, low: Array, high: Array) -> float:
    """Share of a rectangle of the image inside the convex hull of image points.

    Parameters
    ----------
    image : (N, 2)
        col, row [px].
    low, high : (2,)
        Top-left and bottom-right corner of the rectangle [px].
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])  # outside is beyond all in one direction
    reach = np.full(len(angle), -np.inf)
    for start in range(0, len(image), 1024):
        part = (image[start : start + 1024] - low) / (high - low)
        reach = np.maximum(reach, (direction @ part.T).max(axis=1))
    t = (np.arange(20) + 0.5) / 20
    cells = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    return float((cells @ direction.T <= reach + 1e-9).all(axis=1).mean())
