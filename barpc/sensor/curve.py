"""A vector that changes with time: the orbit or the attitude of a satellite, as polynomial pieces."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from barpc.errors import RpcError
from barpc.frozen import Frozen
from barpc.geodesy import Array


@dataclass(frozen=True, eq=False)
class Curve(Frozen):
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
        knots = self._array("knots", (None,), RpcError)
        self._array("coeffs", (len(knots) - 1, None, 3), RpcError)
        if not (np.diff(knots) > 0).all():
            raise RpcError("Curve knots: they must ascend")

    @classmethod
    def polynomial(cls, coeffs: npt.ArrayLike, start: float, stop: float) -> Curve:
        """One polynomial, sum over k of coeffs[k] (t - start)^k, used from `start` to `stop` [s]."""
        return cls(np.array([start, stop]), np.asarray(coeffs, dtype=np.float64)[None])

    @classmethod
    def through(cls, times: npt.ArrayLike, values: npt.ArrayLike, degree: int = 5) -> Curve:
        """The spline through samples: smooth to the second but one derivative, not-a-knot at its ends.

        Parameters
        ----------
        times : (N,)
            [s], ascending.
        values : (N, 3)
            Positions [m] or rotation vectors [rad].
        degree : int
            3 or 5; less where there are too few samples. A quintic through positions every 10 s is true to
            1e-4 m between them.

        Raises
        ------
        RpcError
            Fewer than two samples, times that do not ascend, numbers that are not finite.
        """
        times = np.asarray(times, dtype=np.float64)
        values = np.asarray(values, dtype=np.float64)
        if times.ndim != 1 or len(times) < 2 or values.shape != (len(times), 3):
            raise RpcError(f"curve: {values.shape} values at {times.shape} times; two samples or more needed")
        if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()):
            raise RpcError("curve: sample times must ascend and all numbers must be finite")
        order = min(degree, len(times) - 1)
        spline = make_interp_spline(times, values, k=order - (order + 1) % 2)
        knots = np.unique(spline.t)
        taylor = [spline(knots[:-1], nu=k) / math.factorial(k) for k in range(spline.k + 1)]
        return cls(knots, np.stack(taylor, axis=1))

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


def attitude_through(times: npt.ArrayLike, quaternions: npt.ArrayLike) -> tuple[Array, Curve]:
    """Attitude from quaternions: axes at the middle sample, and the rotation vector from there.

    Parameters
    ----------
    times : (N,)
        [s], ascending.
    quaternions : (N, 4)
        ecef_from_camera, scalar first; of any sign and length but zero.

    Returns
    -------
    mount : (3, 3)
        ecef_from_camera at the middle sample.
    attitude : Curve
        Rotation vector [rad] in the axes of `mount`: a cubic spline.

    Raises
    ------
    RpcError
        A quaternion that is zero or not finite, an attitude that turns by more than 2 rad from the middle.
    """
    q = np.asarray(quaternions, dtype=np.float64)
    if q.ndim != 2 or q.shape[1] != 4 or not (np.isfinite(q).all() and q.any(axis=1).all()):
        raise RpcError(f"attitude: quaternions {q.shape} must be finite, not zero, four numbers each")
    rotations = Rotation.from_quat(np.roll(q, -1, axis=1))
    middle = rotations[len(q) // 2]
    vectors = (middle.inv() * rotations).as_rotvec()
    if np.linalg.norm(vectors, axis=1).max() > 2.0:
        raise RpcError("attitude: it turns by more than 2 rad; cut the samples to the image")
    return np.asarray(middle.as_matrix()), Curve.through(times, vectors, degree=3)
