"""The rational polynomial camera (RPC), in RPC00B order.

col and row are quotients of two cubic polynomials of (longitude, latitude, altitude), every coordinate
normalised by an offset and a scale.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from barpc.errors import RpcError
from barpc.frozen import Frozen
from barpc.geodesy import Array, wrap_longitude
from barpc.sensor.rational import CHUNK, MONOMIALS, REACH, BoolArray, Rational, monomials

_ACCURACY = 1e-9  # px: a localised point must project this near to where it was asked (plus rounding)


@dataclass(frozen=True, eq=False)
class RPC(Frozen):
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
    _map: Rational = field(init=False, repr=False)

    def __post_init__(self) -> None:
        shapes = {
            "coeffs": (4, 20),
            "ground_offset": (3,),
            "ground_scale": (3,),
            "image_offset": (2,),
            "image_scale": (2,),
        }
        for name, shape in shapes.items():
            value = self._array(name, shape, RpcError)
            if name.endswith("scale") and (value == 0).any():
                raise RpcError(f"RPC {name}: a scale is zero")
        if not self.coeffs[1::2].any(axis=1).all():
            raise RpcError("RPC coeffs: a denominator is zero everywhere")
        self._keep("_map", Rational(self.coeffs, _ACCURACY / np.abs(self.image_scale)))

    def normalize(self, ground: Array, out: Array | None = None) -> Array:
        """Normalised longitude, latitude, altitude, one row each.

        Parameters
        ----------
        ground : (N, 3)
            lon, lat [deg], alt [m].
        out : (3, N), optional
            Where to put them.

        Returns
        -------
        normalized : (3, N)
            Without unit; -1 to 1 in the RPC's box.
        """
        if out is None:
            out = np.empty((3, len(ground)))
        np.subtract(ground.T, self.ground_offset[:, None], out=out)
        if not (out[0].max(initial=0.0) <= 180.0 and out[0].min(initial=0.0) >= -180.0):
            out[0] = wrap_longitude(ground[:, 0], self.ground_offset[0]) - self.ground_offset[0]
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
        buffer = np.empty(
            (27, min(len(flat), CHUNK))
        )  # kept for all pieces: fresh memory costs more than sums
        with np.errstate(all="ignore"):
            for start in range(0, len(flat), CHUNK):
                piece = flat[start : start + CHUNK]
                work = buffer[:, : len(piece)]
                value = self._map.value(self.normalize(piece, work[20:23]), work[:20], work[23:])
                value *= self.image_scale[:, None]
                value += self.image_offset[:, None]
                if not np.isfinite(value.sum()):
                    value[:, ~np.isfinite(value).all(axis=0)] = np.nan
                out[start : start + CHUNK] = value.T
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
        work = np.empty((20, min(len(flat), CHUNK)))
        scale = (self.image_scale / self.ground_scale[:, None])[..., None]  # (3, 2, 1)
        with np.errstate(all="ignore"):
            for start in range(0, len(flat), CHUNK):
                piece = flat[start : start + CHUNK]
                value, gradient = self._map.value_and_gradient(
                    self.normalize(piece), work=work[:, : len(piece)]
                )
                value *= self.image_scale[:, None]
                value += self.image_offset[:, None]
                gradient *= scale
                if not np.isfinite(value.sum()):
                    bad = ~np.isfinite(value).all(axis=0)
                    value[:, bad], gradient[..., bad] = np.nan, np.nan
                image[start : start + CHUNK] = value.T
                jacobian[start : start + CHUNK] = gradient.T
        return image.reshape(*ground.shape[:-1], 2), jacobian.reshape(*ground.shape[:-1], 2, 3)

    def localize(self, image: Array, alt: Array) -> Array:
        """Ground points seen at image points, at known altitudes (the inverse of `project`).

        A cubic inverse, fitted once per RPC, and one Newton step; more, and damped, where that is not
        proven to be enough. No point raises, and none is returned that does not project to `image`.

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
        work = np.empty((20, min(len(flat), CHUNK)))
        with np.errstate(all="ignore"):
            for start in range(0, len(flat), CHUNK):
                part = slice(start, start + CHUNK)
                out[part] = self._localize(flat[part], height[part], work)
        return out.reshape(*shape, 3)

    def _localize(self, image: Array, alt: Array, work: Array) -> Array:
        target = np.subtract(image.T, self.image_offset[:, None])
        target /= self.image_scale[:, None]
        z = (alt - self.ground_offset[2]) / self.ground_scale[2]
        x, ok = self._map.solve(target, z, work[:, : len(alt)])
        reach = max(x.max(initial=0.0), -x.min(initial=0.0))
        x *= self.ground_scale[:, None]
        x += self.ground_offset[:, None]
        ground = np.empty((len(alt), 3))
        ground[:, :2], ground[:, 2] = x[:2].T, alt
        span = REACH * np.abs(self.ground_scale)
        if not (reach <= REACH and span[0] < 180.0 and np.abs(self.ground_offset[1]) + span[1] < 90.0):
            ok &= self._holds(ground, image)
        ground[~ok] = np.nan
        return ground

    def _holds(self, ground: Array, image: Array) -> BoolArray:
        """Whether ground points (N, 3), as rounded to degrees, are on Earth and project to `image` (N, 2).

        Far out a unit in the last place of a degree can be many pixels; beyond half a turn a longitude
        would wrap, and beyond a pole there is no latitude.
        """
        tolerance = 10 * _ACCURACY + 1e-12 * np.abs(image)
        on_earth = (np.abs(ground[:, 0] - self.ground_offset[0]) <= 180.0) & (np.abs(ground[:, 1]) <= 90.0)
        return np.asarray(on_earth & (np.abs(self.project(ground) - image) <= tolerance).all(axis=1))

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


__all__ = ["CHUNK", "MONOMIALS", "RPC", "monomials"]
