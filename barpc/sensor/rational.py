"""Two quotients of cubic polynomials in three variables: their values, their derivatives, their inverse.

The kernels behind the RPC, array in and array out, on normalised coordinates. A polynomial is twenty
coefficients in RPC00B order; a batch of points is (3, N), one variable a row, so that every product is one
matrix product. A call works in pieces of `CHUNK` points whose (20, CHUNK) monomials stay in cache.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from barpc.base.geodesy import Array, BoolArray, IntArray

MONOMIALS = (
    "1", "L", "P", "H", "LP", "LH", "PH", "LL", "PP", "HH",
    "PLH", "LLL", "LPP", "LHH", "LLP", "PPP", "PHH", "LLH", "PPH", "HHH",
)  # fmt: skip
"""The twenty monomials in RPC00B order; L = longitude, P = latitude, H = altitude, normalised."""
POWERS = np.array([[monomial.count(letter) for letter in "LPH"] for monomial in MONOMIALS])
"""Powers (20, 3) of L, P and H in them."""

TRUSTED_REACH = 1.25  # the cubic inverse is trusted this far out of the box; what lies beyond is solved with care


def _derivative_matrices() -> Array:
    """Return (3, 20, 10): d(monomial i)/d(L, P, H) as a combination of the first ten monomials."""
    index = {"".join(sorted(m)): i for i, m in enumerate(MONOMIALS[:10])}
    index[""] = index.pop("1")
    out = np.zeros((3, 20, 10))
    for axis, letter in enumerate("LPH"):
        for i, monomial in enumerate(MONOMIALS):
            if power := POWERS[i, axis]:
                out[axis, i, index["".join(sorted(monomial.replace(letter, "", 1)))]] = power
    return out


DERIVATIVE = _derivative_matrices()  # the derivatives of the monomials on the first ten: (3, 20, 10)


def monomials(normalized: Array, out: Array | None = None) -> Array:
    """Return the twenty monomials (20, N), in RPC00B order, of normalised ground points (3, N)."""
    x, y, z = normalized
    if out is None:
        out = np.empty((20, x.shape[0]))
    out[0] = 1.0
    out[1:4] = normalized
    np.multiply(x, y, out=out[4])
    np.multiply(x, z, out=out[5])
    np.multiply(y, z, out=out[6])
    np.multiply(normalized, normalized, out=out[7:10])
    np.multiply(out[4], z, out=out[10])
    for k, factor in enumerate((x, y, z)):  # of the squares: LLL LPP LHH, LLP PPP PHH, LLH PPH HHH
        np.multiply(out[7:10], factor, out=out[11 + 3 * k : 14 + 3 * k])
    return out


@dataclass(frozen=True, eq=False)
class _Inverse:
    """A cubic from (col, row, altitude) to (longitude, latitude), and how far one Newton step repairs it."""

    coeffs: Array  # (2, 20)
    center: Array  # (3, 1), with `scale` brings its arguments to -1..1
    scale: Array
    safe_step: float  # the largest after which the error that is left stays below the accuracy asked for


class Rational:
    """The map (3, N) -> (2, N) of two quotients of cubics."""

    def __init__(self, coeffs: Array, accuracy: Array) -> None:
        self.coeffs = coeffs  # (4, 20): numerator and denominator of the first value, then of the second
        self.accuracy = accuracy  # (2,): what `solve` may be off by in each value; rounding comes on top
        # d/dL, d/dP, d/dH of the four polynomials on the first ten monomials, by axis: (12, 10)
        self.gradients = np.einsum("pi,aij->apj", coeffs, DERIVATIVE).reshape(12, 10)

    def value(self, x: Array, work: Array | None = None, poly: Array | None = None) -> Array:
        """Return the values (2, N) at points (3, N); `work` (20, N) and `poly` (4, N) are overwritten."""
        poly = np.matmul(self.coeffs, monomials(x, work), out=poly)
        return np.divide(poly[::2], poly[1::2], out=poly[::2])

    def value_and_gradient(self, x: Array, axes: int = 3, work: Array | None = None) -> tuple[Array, Array]:
        """Return the values (2, N) and derivatives (axes, 2, N) by the first `axes` variables at points (3, N)."""
        basis = monomials(x, work)
        poly = self.coeffs @ basis
        gradient = (self.gradients[: 4 * axes] @ basis[:10]).reshape(axes, 4, -1)
        inverse = np.reciprocal(poly[1::2])
        value = poly[::2] * inverse
        out = gradient[:, 1::2] * value
        np.subtract(gradient[:, ::2], out, out=out)
        out *= inverse
        return value, out

    def solve(self, target: Array, z: Array, work: Array | None = None) -> tuple[Array, BoolArray]:
        """Return the points (3, N) whose third variable is `z` (N,) and whose values are `target` (2, N).

        The cubic inverse and one Newton step; one more where that was too long to prove it enough; then, and out
        of the box, damped Newton from the centre and a check of value, denominators and orientation. The second result
        (N,) says which were found, on the sheet of the map that holds the centre; `work` (20, N) is overwritten.
        """
        inverse = self._inverse
        x = np.empty((3, len(z)))
        if inverse is None:
            x[2] = z
            return x, self._solve_with_care(target, x, np.arange(len(z)))
        x[:2], x[2] = target, z
        x -= inverse.center
        x /= inverse.scale
        x[:2] = inverse.coeffs @ monomials(x, work)
        x[2] = z
        long = self._step(target, x, work) > inverse.safe_step
        if long.any():
            long = ~(self._step(target, x, work) <= inverse.safe_step)
        out = np.abs(x).max(axis=0)
        bad = np.flatnonzero(long | ~(out <= TRUSTED_REACH))
        ok = np.ones(len(z), dtype=bool)
        if len(bad):
            near = np.abs(self.value(x[:, bad]) - target[:, bad]) <= self._tolerance(target[:, bad])
            bad = bad[~(near.all(axis=0) & self._regular(x[:, bad]))]  # most have arrived, out of the box or not
        if len(bad):
            ok[bad] = self._solve_with_care(target[:, bad], x, bad)
        return x, ok

    def _tolerance(self, target: Array) -> Array:
        return np.asarray(self.accuracy[:, None] + 32 * np.finfo(float).eps * np.abs(target))

    def _step(self, target: Array, x: Array, work: Array | None = None) -> Array:
        """Return one Newton step on `x[:2]`, in place; its length (N,)."""
        value, ((a, c), (b, d)) = self.value_and_gradient(x, axes=2, work=work)
        np.subtract(target, value, out=value)
        det = a * d
        det -= b * c
        np.reciprocal(det, out=det)
        dx = (d * value[0] - b * value[1]) * det
        dy = (a * value[1] - c * value[0]) * det
        x[0] += dx
        x[1] += dy
        return np.asarray(np.maximum(np.abs(dx, out=dx), np.abs(dy, out=dy)))

    @cached_property
    def _inverse(self) -> _Inverse | None:
        """The cubic inverse over the box, from a grid; None where the map is no bijection there."""
        nodes = 1.1 * np.cos(np.pi * (np.arange(9) + 0.5) / 9)
        x = np.stack(np.meshgrid(nodes, nodes, nodes[::2], indexing="ij")).reshape(3, -1)
        with np.errstate(all="ignore"):
            value = self.value(x)
            if not self._regular(x).all():
                return None
            arguments = np.concatenate([value, x[2:]])
            center = (arguments.max(axis=1) + arguments.min(axis=1))[:, None] / 2
            scale = np.maximum(np.ptp(arguments, axis=1)[:, None] / 2, 1e-300)
            basis = monomials((arguments - center) / scale)
            try:
                coeffs = np.asarray(np.linalg.solve(basis @ basis.T, basis @ x[:2].T).T, dtype=np.float64)
            except np.linalg.LinAlgError:  # coefficients at the ends of what doubles hold
                return None
            # what one step leaves of an error of 1e-3: quadratic, so it scales with the step's square
            start = x + np.array([[1e-3], [1e-3], [0.0]])
            length = self._step(value, start)
            left = np.abs(self.value(start) - value) / self.accuracy[:, None]
        growth = float((left / length**2).max())
        safe = np.sqrt(0.1 / growth) if np.isfinite(growth) and growth > 0 else 1e-9
        return _Inverse(coeffs, center, scale, float(min(safe, 1e-3)))

    def _regular(self, x: Array) -> BoolArray:
        """Return whether points lie on the sheet of the centre: no denominator and no determinant changed sign."""
        points = np.concatenate([np.zeros((3, 1)), x], axis=1)
        denominators = self.coeffs[1::2] @ monomials(points)
        _, ((a, c), (b, d)) = self.value_and_gradient(points, axes=2)
        signs = np.sign(np.concatenate([denominators, (a * d - b * c)[None]]))
        return np.asarray((signs[:, 1:] == signs[:, :1]).all(axis=0))

    def _solve_with_care(self, target: Array, x: Array, index: IntArray) -> BoolArray:
        """Solve the columns `index` of `x` (their `x[2]` given) for `target`; return whether each was found."""
        z = x[2, index]
        state = np.zeros((3, len(index)))
        state[2] = z
        usable = np.isfinite(target).all(axis=0) & np.isfinite(z)
        error = self._damped_newton(target, state)
        ok = np.asarray(usable & (error <= self._tolerance(target)).all(axis=0) & self._regular(state))
        x[:2, index] = state[:2]
        return ok

    def _damped_newton(self, target: Array, x: Array, steps: int = 60) -> Array:
        """Step `x[:2]` by Newton, halved until errors fall, never across a pole; return the remaining errors (2, N)."""
        left = np.full(target.shape, np.inf)
        active = np.arange(target.shape[1])
        sign = np.sign(self.coeffs[1::2, :1])
        for _ in range(steps):
            goal, here = target[:, active], x[:, active]
            value, ((a, c), (b, d)) = self.value_and_gradient(here, axes=2)
            residual = goal - value
            left[:, active] = np.abs(residual)
            det = a * d - b * c
            step = np.stack([d * residual[0] - b * residual[1], a * residual[1] - c * residual[0]]) / det
            step /= np.maximum(1.0, np.abs(step).max(axis=0))  # at most one box width at a time
            improved = self._line_search(goal, here, step, sign)
            x[:, active] = here
            active = active[improved]  # so a few stubborn points cost little
            if not len(active):
                break
        return left

    def _line_search(self, target: Array, x: Array, step: Array, sign: Array) -> BoolArray:
        """Move `x[:2]` by the longest of step, step/2, .. step/128 that lowers the error; return whether one did."""
        error = np.abs(target - self.value(x)).sum(axis=0)
        todo = np.flatnonzero(np.isfinite(step).all(axis=0) & np.isfinite(error))
        improved = np.zeros(x.shape[1], dtype=bool)
        for halving in range(8):
            trial = x[:, todo]
            trial[:2] += step[:, todo] * 0.5**halving
            poly = self.coeffs @ monomials(trial)
            trial_error = np.abs(target[:, todo] - poly[::2] / poly[1::2]).sum(axis=0)
            better = (trial_error < error[todo]) & (poly[1::2] * sign > 0).all(axis=0)
            x[:, todo[better]] = trial[:, better]
            improved[todo[better]] = True
            todo = todo[~better]
            if not len(todo):
                break
        return improved
