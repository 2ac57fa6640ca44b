"""The rational polynomial camera (RPC), in RPC00B order.

col and row are quotients of two cubic polynomials of (longitude, latitude, altitude), every coordinate
normalised by an offset and a scale.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from barpc.errors import RpcError
from barpc.geodesy import Array, wrap_longitude

CHUNK = 8192
"""Points worked on at a time: the (20, CHUNK) monomials stay in cache."""

MONOMIALS = (
    "1", "L", "P", "H", "LP", "LH", "PH", "LL", "PP", "HH",
    "PLH", "LLL", "LPP", "LHH", "LLP", "PPP", "PHH", "LLH", "PPH", "HHH",
)  # fmt: skip
"""The twenty monomials in RPC00B order; L = longitude, P = latitude, H = altitude, normalised."""

_ACCURACY = 1e-9  # px: a localised point must project this near to where it was asked (plus rounding)


def _derivative_matrices() -> Array:
    """(3, 20, 10): d(monomial i)/d(L, P, H) as a combination of the first ten monomials."""
    index = {"".join(sorted(m)): i for i, m in enumerate(MONOMIALS[:10])}
    index[""] = index.pop("1")
    out = np.zeros((3, 20, 10))
    for axis, letter in enumerate("LPH"):
        for i, monomial in enumerate(MONOMIALS):
            power = monomial.count(letter)
            if power:
                out[axis, i, index["".join(sorted(monomial.replace(letter, "", 1)))]] = power
    return out


_DERIVATIVE = _derivative_matrices()


def monomials(normalized: Array) -> Array:
    """The twenty monomials of normalised ground points.

    Parameters
    ----------
    normalized : (3, N)
        Normalised longitude, latitude, altitude, one row each.

    Returns
    -------
    monomials : (20, N)
        In RPC00B order (`MONOMIALS`).
    """
    x, y, z = normalized
    out = np.empty((20, x.shape[0]))
    out[0] = 1.0
    out[1:4] = normalized
    np.multiply(x, y, out=out[4])
    np.multiply(x, z, out=out[5])
    np.multiply(y, z, out=out[6])
    np.multiply(normalized, normalized, out=out[7:10])
    xx, yy, zz = out[7:10]
    np.multiply(out[4], z, out=out[10])
    np.multiply(xx, x, out=out[11])
    np.multiply(yy, x, out=out[12])
    np.multiply(zz, x, out=out[13])
    np.multiply(xx, y, out=out[14])
    np.multiply(yy, y, out=out[15])
    np.multiply(zz, y, out=out[16])
    np.multiply(xx, z, out=out[17])
    np.multiply(yy, z, out=out[18])
    np.multiply(zz, z, out=out[19])
    return out


@dataclass(frozen=True, eq=False)
class RPC:
    """A rational polynomial camera: itself a `SensorModel`.

    Parameters
    ----------
    coeffs : (4, 20)
        Rows: numerator and denominator of the column, numerator and denominator of the row, each in
        RPC00B order (`MONOMIALS`).
    ground_offset, ground_scale : (3,)
        lon, lat [deg], alt [m].
    image_offset, image_scale : (2,)
        col, row [px]; (0, 0) is the centre of the top-left pixel.
    err_bias, err_rand : float or None
        Stated accuracy [m], RMS per horizontal axis: the part common to the image, the part of each
        point. None where it is unknown.

    Raises
    ------
    RpcError
        A wrong shape, a value that is not finite, a scale or a denominator that is zero.

    Notes
    -----
    Longitudes are taken by whole turns to within 180 degrees of the offset, so that a scene across the
    antimeridian and longitudes of 0..360 degrees project as any other.
    """

    coeffs: Array
    ground_offset: Array
    ground_scale: Array
    image_offset: Array
    image_scale: Array
    err_bias: float | None = None
    err_rand: float | None = None
    _gradient: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        shapes = {
            "coeffs": (4, 20),
            "ground_offset": (3,),
            "ground_scale": (3,),
            "image_offset": (2,),
            "image_scale": (2,),
        }
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), dtype=np.float64)  # a copy of our own, then read-only
            if value.shape != shape:
                raise RpcError(f"RPC {name}: shape {value.shape}, expected {shape}")
            if not np.isfinite(value).all():
                raise RpcError(f"RPC {name}: not finite ({value[~np.isfinite(value)][0]})")
            if name.endswith("scale") and (value == 0).any():
                raise RpcError(f"RPC {name}: a scale is zero")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if not self.coeffs[1::2].any(axis=1).all():
            raise RpcError("RPC coeffs: a denominator is zero everywhere")
        # (12, 10): d/dL, d/dP, d/dH of the four polynomials on the first ten monomials
        gradient = np.einsum("pi,aij->paj", self.coeffs, _DERIVATIVE).reshape(12, 10)
        gradient.setflags(write=False)
        object.__setattr__(self, "_gradient", gradient)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RPC) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())

    def _content(self) -> tuple[object, ...]:
        arrays = (self.coeffs, self.ground_offset, self.ground_scale, self.image_offset, self.image_scale)
        return (*(tuple(a.ravel().tolist()) for a in arrays), self.err_bias, self.err_rand)

    def normalize(self, ground: Array) -> Array:
        """Normalised longitude, latitude, altitude, one row each.

        Parameters
        ----------
        ground : (N, 3)
            lon, lat [deg], alt [m].

        Returns
        -------
        normalized : (3, N)
            Without unit; -1 to 1 in the RPC's box.
        """
        out = np.empty((3, len(ground)))
        out[0] = wrap_longitude(ground[:, 0], self.ground_offset[0])
        out[1:] = ground[:, 1:].T
        out -= self.ground_offset[:, None]
        out /= self.ground_scale[:, None]
        return out

    def project(self, ground: Array) -> Array:
        """Image points of ground points.

        Parameters
        ----------
        ground : (..., 3)
            lon, lat [deg], alt [m above the WGS84 ellipsoid].

        Returns
        -------
        image : (..., 2)
            col, row [px]; NaN where a denominator vanishes or the input is not finite.
        """
        ground = np.asarray(ground, dtype=np.float64)
        flat = ground.reshape(-1, 3)
        out = np.empty((len(flat), 2))
        with np.errstate(all="ignore"):
            for start in range(0, len(flat), CHUNK):
                part = slice(start, start + CHUNK)
                poly = self.coeffs @ monomials(self.normalize(flat[part]))
                out[part] = (poly[::2] / poly[1::2]).T
            out *= self.image_scale
            out += self.image_offset
        out[~np.isfinite(out).all(axis=1)] = np.nan
        return out.reshape(*ground.shape[:-1], 2)

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Image points of ground points, with the derivative.

        Parameters
        ----------
        ground : (..., 3)
            lon, lat [deg], alt [m].

        Returns
        -------
        image : (..., 2)
            col, row [px].
        jacobian : (..., 2, 3)
            d(col, row) / d(lon, lat, alt) [px/deg, px/deg, px/m].
        """
        ground = np.asarray(ground, dtype=np.float64)
        flat = ground.reshape(-1, 3)
        image = np.empty((len(flat), 2))
        jacobian = np.empty((len(flat), 2, 3))
        with np.errstate(all="ignore"):
            for start in range(0, len(flat), CHUNK):
                part = slice(start, start + CHUNK)
                value, gradient = self._quotients(self.normalize(flat[part]))
                image[part] = (value * self.image_scale[:, None] + self.image_offset[:, None]).T
                scale = self.image_scale[:, None] / self.ground_scale
                jacobian[part] = np.moveaxis(gradient * scale[..., None], 2, 0)
        bad = ~np.isfinite(image).all(axis=1)
        image[bad], jacobian[bad] = np.nan, np.nan
        return image.reshape(*ground.shape[:-1], 2), jacobian.reshape(*ground.shape[:-1], 2, 3)

    def _quotients(self, normalized: Array) -> tuple[Array, Array]:
        """Normalised (col, row) (2, N) and their derivative (2, 3, N) by the normalised ground (3, N)."""
        basis = monomials(normalized)
        poly = self.coeffs @ basis
        gradient = (self._gradient @ basis[:10]).reshape(4, 3, -1)
        inverse = 1.0 / poly[1::2]
        value = poly[::2] * inverse
        return value, (gradient[::2] - value[:, None] * gradient[1::2]) * inverse[:, None]

    def localize(self, image: Array, alt: Array) -> Array:
        """Ground points seen at image points, at known altitudes (the inverse of `project`).

        Newton's method on (lon, lat) with the analytic derivative, started at the RPC's centre; points
        that do not settle are tried again with damped steps.

        Parameters
        ----------
        image : (..., 2)
            col, row [px].
        alt : (...)
            Altitude above the WGS84 ellipsoid [m]; broadcast with `image`.

        Returns
        -------
        ground : (..., 3)
            lon (within 180 deg of the RPC's offset), lat [deg], alt [m]. NaN where no point was found
            that projects to `image`.
        """
        image = np.asarray(image, dtype=np.float64)
        alt = np.asarray(alt, dtype=np.float64)
        shape = np.broadcast_shapes(image.shape[:-1], alt.shape)
        flat = np.broadcast_to(image, (*shape, 2)).reshape(-1, 2)
        height = np.broadcast_to(alt, shape).reshape(-1)
        out = np.empty((len(flat), 3))
        with np.errstate(all="ignore"):
            for start in range(0, len(flat), CHUNK):
                part = slice(start, start + CHUNK)
                out[part] = self._localize(flat[part], height[part])
        return out.reshape(*shape, 3)

    def _localize(self, image: Array, alt: Array) -> Array:
        target = ((image - self.image_offset) / self.image_scale).T
        state = np.zeros((3, len(image)))
        state[2] = (alt - self.ground_offset[2]) / self.ground_scale[2]
        tolerance = _ACCURACY / np.abs(self.image_scale) + 8 * np.finfo(float).eps * np.abs(target).T
        error = self._newton(target, state, steps=6)
        done = np.asarray((error <= tolerance.T).all(axis=0))
        if not done.all():
            todo = np.flatnonzero(~done & np.isfinite(target).all(axis=0) & np.isfinite(state[2]))
            retry = np.zeros((3, len(todo)))
            retry[2] = (alt[todo] - self.ground_offset[2]) / self.ground_scale[2]
            error = self._damped_newton(target[:, todo], retry, steps=60)
            done[todo] = (error <= 4 * tolerance[todo].T).all(axis=0)
            state[:, todo] = retry
        ground = state.T * self.ground_scale + self.ground_offset
        ground[:, 2] = alt
        ground[~done] = np.nan
        return ground

    def _newton(self, target: Array, state: Array, steps: int) -> Array:
        """Undamped steps on `state[:2]` in place; the absolute error (2, N) that is left."""
        for _ in range(steps):
            value, gradient = self._quotients(state)
            residual = target - value
            step = _solve_2x2(gradient[:, :2], residual)
            state[:2] += step
            if not (np.abs(step).max(initial=0.0) > 1e-9):  # quadratic: the next step is below rounding
                break
        return np.abs(target - self._quotients(state)[0])

    def _damped_newton(self, target: Array, state: Array, steps: int) -> Array:
        """Newton with steps halved until the error falls, never across a pole; keeps the best point."""
        sign = np.sign(self.coeffs[1::2, :1])
        value, gradient = self._quotients(state)
        error = np.linalg.norm(target - value, axis=0)
        for _ in range(steps):
            step = _solve_2x2(gradient[:, :2], target - value)
            step /= np.maximum(1.0, np.abs(step).max(axis=0))  # at most one box width at a time
            factor, improved = np.ones_like(error), np.zeros(len(error), dtype=bool)
            for _ in range(8):
                trial = state.copy()
                trial[:2] += factor * step
                denominator = self.coeffs[1::2] @ monomials(trial)
                trial_value, trial_gradient = self._quotients(trial)
                trial_error = np.linalg.norm(target - trial_value, axis=0)
                better = (trial_error < error) & (denominator * sign > 0).all(axis=0) & ~improved
                state[:, better] = trial[:, better]
                value[:, better], gradient[..., better] = trial_value[:, better], trial_gradient[..., better]
                error[better] = trial_error[better]
                improved |= better
                factor[~improved] *= 0.5
                if improved.all():
                    break
            if not improved.any():
                break
        return np.abs(target - value)

    def crop(self, col: float, row: float) -> RPC:
        """The RPC of a crop whose top-left pixel is (col, row) [px] of this image: exact, no refit."""
        return replace(self, image_offset=self.image_offset - np.array([col, row], dtype=np.float64))

    def window(self, col: float, row: float, step_col: float = 1.0, step_row: float = 1.0) -> RPC:
        """The RPC of an image cut out of this one and resampled: exact, no refit.

        Parameters
        ----------
        col, row : float
            The new image's top-left CORNER, counted from this image's top-left corner [px of this image].
        step_col, step_row : float
            Size of a new pixel [px of this image]; 2 halves the resolution.

        Returns
        -------
        rpc : RPC
        """
        step = np.array([step_col, step_row], dtype=np.float64)
        corner = np.array([col, row], dtype=np.float64)
        if (step == 1).all():
            return self.crop(col, row)  # the same, without a rounding
        offset = (self.image_offset + 0.5 - corner) / step - 0.5
        return replace(self, image_offset=offset, image_scale=self.image_scale / step)


def _solve_2x2(matrix: Array, rhs: Array) -> Array:
    """Solve (2, 2, N) systems with right-hand sides (2, N) by Cramer's rule."""
    (a, b), (c, d) = matrix
    det = a * d - b * c
    return np.stack([(d * rhs[0] - b * rhs[1]) / det, (a * rhs[1] - c * rhs[0]) / det])
