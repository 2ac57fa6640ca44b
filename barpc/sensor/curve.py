"""A vector that changes with time: the orbit or the attitude of a satellite, as polynomial pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from barpc.errors import RpcError
from barpc.geodesy import Array


@dataclass(frozen=True, eq=False)
class Curve:
    """A piecewise polynomial of time with values in three dimensions.

    Parameters
    ----------
    knots : (M + 1,)
        Times [s], ascending; piece m holds between knots m and m + 1.
    coeffs : (M, K, 3)
        Piece m is the sum over k of coeffs[m, k] (t - knots[m])^k.
    """

    knots: Array
    coeffs: Array

    def __post_init__(self) -> None:
        knots = np.array(self.knots, dtype=np.float64)
        coeffs = np.array(self.coeffs, dtype=np.float64)
        if knots.ndim != 1 or coeffs.ndim != 3 or coeffs.shape[0] != len(knots) - 1 or coeffs.shape[2] != 3:
            raise RpcError(
                f"curve: knots {knots.shape} and coefficients {coeffs.shape} do not belong together"
            )
        if not (np.isfinite(knots).all() and np.isfinite(coeffs).all() and (np.diff(knots) > 0).all()):
            raise RpcError("curve: knots must ascend and all numbers must be finite")
        for name, value in (("knots", knots), ("coeffs", coeffs)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def polynomial(cls, coeffs: npt.ArrayLike, start: float, stop: float) -> Curve:
        """One polynomial, sum over k of coeffs[k] (t - start)^k, used from `start` to `stop` [s]."""
        return cls(np.array([start, stop]), np.asarray(coeffs, dtype=np.float64)[None])

    def __call__(self, time: Array) -> tuple[Array, Array]:
        """Values and their derivatives by time.

        Parameters
        ----------
        time : (N,)
            [s].

        Returns
        -------
        value, rate : (3, N)
        """
        if len(self.coeffs) == 1:
            powers = self.coeffs[0][:, :, None]
            dt = time - self.knots[0]
        else:
            piece = np.searchsorted(self.knots[1:-1], time, side="right")
            powers = np.moveaxis(self.coeffs[piece], 0, 2)
            dt = time - self.knots[piece]
        value = np.broadcast_to(powers[-1], (3, len(dt)))
        rate = np.zeros((3, 1))
        for power in powers[-2::-1]:
            rate = rate * dt + value
            value = value * dt + power
        return value, np.broadcast_to(rate, value.shape)

    def content(self) -> tuple[object, ...]:
        """Numbers that decide equality."""
        return (*self.knots.tolist(), self.coeffs.shape, *self.coeffs.ravel().tolist())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Curve) and self.content() == other.content()

    def __hash__(self) -> int:
        return hash(self.content())
