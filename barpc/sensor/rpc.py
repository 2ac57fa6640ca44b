"""The rational polynomial camera (RPC), in RPC00B order; many cameras at once, each at its own points.

col and row are quotients of two cubic polynomials of (longitude, latitude, altitude), every coordinate
normalised by an offset and a scale. Of many cameras RPCs go by their numbers stacked, others one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any, ClassVar

import numpy as np

from barpc.base.errors import RpcError
from barpc.base.geodesy import CHUNK, NEWTON_STEPS, Array, BoolArray, IntArray, wrap_longitude
from barpc.sensor import Pointwise, SensorModel
from barpc.sensor.rational import DERIVATIVE, TRUSTED_REACH, Rational, monomials

_RASTERIO = [
    *(f"{axis}_{part}" for part in ("off", "scale") for axis in ("line", "samp", "lat", "long", "height")),
    *(f"{axis}_{part}_coeff" for axis in ("line", "samp") for part in ("num", "den")),
]
RPCM_NAMES = [
    *(f"{axis}_{part}" for part in ("offset", "scale") for axis in ("row", "col", "lat", "lon", "alt")),
    *(f"{axis}_{part}" for axis in ("row", "col") for part in ("num", "den")),
]
_ACCURACIES = ["err_bias", "err_rand"]
_AXIS_ORDER, _POLYNOMIALS = (
    [1, 0, 3, 2, 4],
    [2, 3, 0, 1],
)  # of files (row, col, lat, lon, alt; row's first) and, alike, of ours
_ACCURACY = 1e-9  # px: a localised point must project this near to where it was asked (plus rounding)
_MAX_BATCHED_POINTS = 1024  # points of a view: its own inverse is sooner made
_NEWTON_SHRINK = 0.25  # of the step before: nothing singular is near (Kantorovich: a half)
_ARRIVED = 1e-6  # of the box's half width: a step is squared, and what it leaves is below rounding


@dataclass(frozen=True, eq=False, repr=False)
class RPC(Pointwise):
    """A rational polynomial camera: itself a `SensorModel`.

    Longitudes are taken by whole turns to within 180 degrees of the offset: across the antimeridian, and as 0..360.

    Parameters
    ----------
    coeffs : (4, 20), numerator and denominator of the column, then of the row, in RPC00B order (`MONOMIALS`)
    ground_offset, ground_scale : (3,), lon, lat [deg], alt [m]
    image_offset, image_scale : (2,), col, row [px]; (0, 0) is the centre of the top-left pixel
    err_bias, err_rand : float or None
        Stated accuracy [m], RMS per horizontal axis: common to the image, of each point; None where unknown.
    height_default : float or None, altitude of the ground [m], where the file states it (HEIGHT_DEFAULT of GDAL)

    Raises
    ------
    RpcError
        A wrong shape, a value that is not finite, a scale or a denominator that is zero.

    Examples
    --------
    >>> rpc = barpc.read_rpc("data_samples/view_00.tif")
    >>> rpc.project([5.4, 43.3, 120.0]).round(2)
    array([509.77, 494.61])
    >>> rpc.localize([509.77, 494.61], 120.0).round(5)
    array([  5.4,  43.3, 120. ])
    """

    coeffs: Array
    ground_offset: Array
    ground_scale: Array
    image_offset: Array
    image_scale: Array
    err_bias: float | None = None
    err_rand: float | None = None
    height_default: float | None = None
    _map: Rational = field(init=False, repr=False)
    _memory: ClassVar[int] = 27  # monomials, normalised coordinates, polynomials

    def __post_init__(self) -> None:
        shapes = {"ground_offset": (3,), "ground_scale": (3,), "image_offset": (2,), "image_scale": (2,)}
        for name, shape in {"coeffs": (4, 20), **shapes}.items():
            value = self._array(name, shape, RpcError)
            if name.endswith("scale") and (value == 0).any():
                raise RpcError(f"RPC {name}: a scale is zero")
        if not self.coeffs[1::2].any(axis=1).all():
            raise RpcError("RPC coeffs: a denominator is zero everywhere")
        self._keep("_map", Rational(self.coeffs, _ACCURACY / np.abs(self.image_scale)))

    def _told(self) -> str:
        offset = np.append(self.ground_offset, self.image_offset)
        scale = np.abs(np.append(self.ground_scale, self.image_scale))
        words = "lon {:.4f} to {:.4f}, lat {:.4f} to {:.4f}, {:g} to {:g} m, col {:g} to {:g}, row {:g} to {:g}"
        return words.format(*np.column_stack([offset - scale, offset + scale]).ravel())

    @classmethod
    def of_numbers(cls, values: Sequence[Any], bias: float | None = None, rand: float | None = None) -> RPC:
        """Return the RPC of fourteen values in the order of `numbers`, and accuracies.

        An accuracy of zero and below means that nobody knows it, not that it is perfect.
        """
        offset, scale = (np.array(values[i : i + 5], dtype=np.float64)[_AXIS_ORDER] for i in (0, 5))
        bias, rand = (float(error) if error and 0 < error < np.inf else None for error in (bias, rand))
        coeffs = np.array(values[10:], dtype=np.float64)[_POLYNOMIALS]
        return cls(coeffs, offset[2:], scale[2:], offset[:2], scale[:2], bias, rand)

    def numbers(self) -> list[Any]:
        """Return fourteen values in the order of RPC files.

        Offsets of row, col, lat, lon, alt, their scales, then lists of twenty: numerator and denominator of the row, of
        the column.
        """
        offset = np.append(self.image_offset, self.ground_offset)[_AXIS_ORDER]
        scale = np.append(self.image_scale, self.ground_scale)[_AXIS_ORDER]
        return [*offset.tolist(), *scale.tolist(), *self.coeffs[_POLYNOMIALS].tolist()]

    @classmethod
    def from_rasterio(cls, rpcs: Any) -> RPC:
        """Return the RPC of rasterio's ``dataset.rpcs``; RpcError where it is None or lacks a number.

        >>> from rasterio.rpc import RPC as Rasterio
        >>> rpc = RPC([[1.0] * 20] * 4, [5.4, 43.2, 100.0], [0.1, 0.2, 500.0], [999.5, 499.5], [1000.0, 500.0])
        >>> rpc.to_rasterio().long_off, rpc.to_rasterio().line_off
        (5.4, 499.5)
        >>> isinstance(rpc.to_rasterio(), Rasterio) and RPC.from_rasterio(rpc.to_rasterio()) == rpc
        True
        """
        return cls._of_attributes(rpcs, _RASTERIO)

    def to_rasterio(self) -> Any:
        """Return a ``rasterio.rpc.RPC``, for ``dataset.rpcs`` of an output file or for warping."""
        named = dict(zip(_RASTERIO, self.numbers(), strict=True))
        # by name: the mathematics stands without rasterio
        return import_module("rasterio.rpc").RPC(**named, err_bias=self.err_bias, err_rand=self.err_rand)

    @classmethod
    def from_rpcm(cls, model: Any) -> RPC:
        """Return the RPC of an ``rpcm.RPCModel``; RpcError where it lacks a number."""
        return cls._of_attributes(model, RPCM_NAMES)

    def to_rpcm_dict(self) -> dict[str, Any]:
        """Return the dictionary for ``rpcm.RPCModel(d, dict_format="rpcm")``; known accuracies stand at its end.

        >>> from types import SimpleNamespace
        >>> rpc = RPC([[1.0] * 20] * 4, [5.4, 43.2, 100.0], [0.1, 0.2, 500.0], [999.5, 499.5], [1000.0, 500.0])
        >>> rpc.to_rpcm_dict()["row_offset"]
        499.5
        >>> RPC.from_rpcm(SimpleNamespace(**rpc.to_rpcm_dict())) == rpc
        True
        """
        named = dict(zip(RPCM_NAMES, self.numbers(), strict=True))
        return named | {key: value for key in _ACCURACIES if (value := getattr(self, key))}

    @classmethod
    def _of_attributes(cls, given: Any, names: Sequence[str]) -> RPC:
        if given is None:
            raise RpcError("None instead of an RPC: the image has none")
        values = [getattr(given, name, None) for name in names]
        for name, value, size in zip(names, values, (*[1] * 10, *[20] * 4), strict=True):
            if value is None or np.size(value) != size:
                what = "is missing" if value is None else f"has {np.size(value)} numbers, expected {size}"
                raise RpcError(f"RPC of a {type(given).__name__}: {name} {what}")
        return cls.of_numbers(values, *(getattr(given, key, None) for key in _ACCURACIES))

    def normalize(self, ground: Array, out: Array | None = None) -> Array:
        """Return longitude, latitude, altitude (3, N) of points (N, 3), from -1 to 1 in the RPC's box."""
        out = np.subtract(ground.T, self.ground_offset[:, None], out=out, order="C")
        if not np.abs(out[0]).max(initial=0.0) <= 180.0:
            out[0] = wrap_longitude(ground[:, 0], self.ground_offset[0]) - self.ground_offset[0]
        out /= self.ground_scale[:, None]
        return out

    def off(self, other: RPC) -> Array:
        """Return the differences (729, 2) [px] of another RPC's image points over the box; 0 where neither has any."""
        places = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 3), axis=-1).reshape(-1, 3)
        image, seen = (rpc.project(self.ground_offset + places * self.ground_scale) for rpc in (self, other))
        return np.where(np.isnan(image) & np.isnan(seen), 0.0, np.abs(seen - image))

    def _project(self, ground: Array, work: Array) -> Array:
        value = self._map.value(self.normalize(ground, work[20:23]), work[:20], work[23:])
        return self._in_pixels(value).T

    def _derivatives(self, ground: Array, work: Array) -> tuple[Array, ...]:
        value, gradient = self._map.value_and_gradient(self.normalize(ground), work=work[:20])
        gradient *= (self.image_scale / self.ground_scale[:, None])[..., None]
        image = self._in_pixels(value)
        if not np.isfinite(image.sum()):
            gradient[..., np.isnan(image[0])] = np.nan
        return image.T, gradient.T

    def _in_pixels(self, value: Array) -> Array:
        """Return the image points (2, N) of normalised ones, in place; NaN where a denominator vanishes."""
        value *= self.image_scale[:, None]
        value += self.image_offset[:, None]
        if not np.isfinite(value.sum()):
            value[:, ~np.isfinite(value).all(axis=0)] = np.nan
        return value

    def _localize(self, image: Array, alt: Array, work: Array) -> Array:
        """Return the ground points (N, 3) by a cubic inverse, fitted once per RPC, and one Newton step.

        More, and damped, where that is not proven to be enough; NaN where no point was found that projects to `image`.
        """
        target = np.subtract(image.T, self.image_offset[:, None], order="C")
        target /= self.image_scale[:, None]
        x, ok = self._map.solve(target, (alt - self.ground_offset[2]) / self.ground_scale[2], work[:20])
        reach = max(x.max(initial=0.0), -x.min(initial=0.0))
        x *= self.ground_scale[:, None]
        x += self.ground_offset[:, None]
        x[2] = alt
        ground = x.T
        span = TRUSTED_REACH * np.abs(self.ground_scale)
        if not (reach <= TRUSTED_REACH and span[0] < 180.0 and np.abs(self.ground_offset[1]) + span[1] < 90.0):
            ok &= self._holds(ground, image)
        ground[~ok] = np.nan
        return ground

    def _holds(self, ground: Array, image: Array) -> BoolArray:
        """Return whether ground points (N, 3) are on Earth and project to `image`: far out an ulp can be pixels."""
        tolerance = 10 * _ACCURACY + 1e-12 * np.abs(image)
        on_earth = (np.abs(ground[:, 0] - self.ground_offset[0]) <= 180.0) & (np.abs(ground[:, 1]) <= 90.0)
        return np.asarray(on_earth & (np.abs(self.project(ground) - image) <= tolerance).all(axis=1))

    def crop(self, col: float, row: float) -> RPC:
        """Return the RPC of a crop whose top-left pixel is (col, row) [px] of this image: exact, no refit."""
        return replace(self, image_offset=self.image_offset - np.array([col, row], dtype=np.float64))

    def window(self, col: float, row: float, step_col: float = 1.0, step_row: float = 1.0) -> RPC:
        """Return the RPC of an image cut out of this one and resampled: exact, no refit.

        Parameters
        ----------
        col, row : float, the new image's top-left CORNER, counted from this image's top-left corner [px of this image]
        step_col, step_row : float, size of a new pixel [px of this image]; 2 halves the resolution
        """
        step = np.array([step_col, step_row], dtype=np.float64)
        corner = np.array([col, row], dtype=np.float64)
        if (step == 1).all():
            return self.crop(col, row)  # the same, without a rounding
        offset = (self.image_offset + 0.5 - corner) / step - 0.5
        return replace(self, image_offset=offset, image_scale=self.image_scale / step)


# --- many cameras at once ----------------------------------------------------------------------------------


def altitude_range(rpc: RPC) -> tuple[float, float]:
    """Return the altitudes [m] that an RPC states: its offset -/+ its scale."""
    offset, scale = float(rpc.ground_offset[2]), abs(float(rpc.ground_scale[2]))
    return offset - scale, offset + scale


class RpcStack:
    """The RPCs among the sensors, their numbers stacked (V of N rows are used, the others stay zero).

    Points are sorted by view: those of view v are bounds[v] : bounds[v + 1].
    """

    def __init__(self, sensors: Sequence[SensorModel]) -> None:
        n, self.sensors = len(sensors), tuple(sensors)
        self.coeffs, self.gradient = np.zeros((n, 4, 20)), np.zeros((n, 12, 10))
        self.ground_offset, self.ground_scale = np.zeros((n, 3)), np.ones((n, 3))
        self.is_rpc = np.array([isinstance(sensor, RPC) for sensor in sensors], dtype=bool)
        rpcs = {i: sensor for i, sensor in enumerate(sensors) if isinstance(sensor, RPC)}
        if rpcs:
            rows = list(rpcs)
            for name in ("coeffs", "ground_offset", "ground_scale"):
                getattr(self, name)[rows] = [getattr(rpc, name) for rpc in rpcs.values()]
            for row, rpc in rpcs.items():  # quotients of pixels
                above = rpc.coeffs[::2] * rpc.image_scale[:, None] + rpc.coeffs[1::2] * rpc.image_offset[:, None]
                self.coeffs[row, ::2] = above
            slopes = np.einsum("npi,aij->npaj", self.coeffs, DERIVATIVE)  # of four polynomials by three axes
            self.gradient = (slopes / self.ground_scale[:, None, :, None]).reshape(n, 12, 10)

    def runs(self, bounds: IntArray, together: BoolArray) -> Iterator[slice]:
        """Yield the views with points: those `together` (N,) by about CHUNK points, others one by one."""
        run: slice | None = None
        for v in np.flatnonzero(np.diff(bounds)).tolist():
            if run is not None:
                if together[run.start] and together[v] and bounds[v + 1] - bounds[run.start] <= CHUNK:
                    run = slice(run.start, v + 1)
                    continue
                yield run
            run = slice(v, v + 1)
        if run is not None:
            yield run

    def seen(self, ground: Array, bounds: IntArray) -> Array:
        """Return the image points (2, n) of ground points (n, 3), as each camera's `project`."""

        def stacked(views: slice, within: IntArray, ground: Array) -> list[Array]:
            return [_blank(self.image(ground.T, views, within))]

        return self._of("project", stacked, [(2,)], bounds, ground)[0]

    def seen_jacobian(self, ground: Array, bounds: IntArray) -> list[Array]:
        """Return the image points (2, n) of ground points (n, 3) and derivatives (2, 3, n), as `project_jacobian`."""

        def stacked(views: slice, within: IntArray, ground: Array) -> list[Array]:
            image, jacobian = self.project(ground.T, views, within)
            return [_blank(image), _blank(jacobian)]

        return self._of("project_jacobian", stacked, [(2,), (2, 3)], bounds, ground)

    def localize(self, image: Array, alt: Array, bounds: IntArray) -> Array:
        """Return the ground points (3, n) of image points (n, 2) [px] at altitudes (n,) [m], as each `localize`."""
        lost = np.zeros(len(self.sensors), dtype=bool)

        def stacked(views: slice, within: IntArray, image: Array, alt: Array) -> list[Array]:
            ground, found = _invert(self, image.T, alt, views, within)
            lost[views] = np.bincount(np.repeat(np.arange(len(within) - 1), np.diff(within)), ~found) > 0
            return [ground]

        (ground,) = self._of("localize", stacked, [(3,)], bounds, image, alt)
        for v in np.flatnonzero(lost).tolist():
            part = slice(bounds[v], bounds[v + 1])
            ground[:, part] = self.sensors[v].localize(image[part], alt[part]).T
        return ground

    def _of(
        self,
        name: str,
        stacked: Callable[..., list[Array]],
        shapes: Sequence[tuple[int, ...]],
        bounds: IntArray,
        *given: Array,
    ) -> list[Array]:
        """Return values (..., n) of cameras at points: few of RPCs together, else by the camera's method `name`."""
        out = [np.empty((*shape, len(given[0]))) for shape in shapes]
        few = self.is_rpc & (np.diff(bounds) <= _MAX_BATCHED_POINTS) & (len(self.sensors) > 1)
        for views in self.runs(bounds, few):
            rows = slice(bounds[views.start], bounds[views.stop])
            part = [array[rows] for array in given]
            if few[views.start]:
                found = stacked(views, bounds[views.start : views.stop + 1] - rows.start, *part)
            else:
                alone = getattr(self.sensors[views.start], name)(*part)
                found = [np.moveaxis(piece, 0, -1) for piece in (alone if len(shapes) > 1 else [alone])]
            for whole, piece in zip(out, found, strict=True):
                whole[..., rows] = piece
        return out

    def image(self, ground: Array, views: slice, bounds: IntArray) -> Array:
        """Return the image points (2, n) of ground points (3, n) seen by consecutive views."""
        count = np.diff(bounds)
        poly = _polynomials(self.coeffs[views], self._basis(ground, views, count), bounds)
        with np.errstate(all="ignore"):
            value: Array = poly[::2] / poly[1::2]
        return value

    def project(self, ground: Array, views: slice, bounds: IntArray) -> tuple[Array, Array]:
        """Return the image points (2, n) and derivative (2, 3, n) of ground points (3, n) seen by consecutive views."""
        count = np.diff(bounds)
        basis = self._basis(ground, views, count)
        poly = _polynomials(self.coeffs[views], basis, bounds)
        slope = _polynomials(self.gradient[views], basis[:10], bounds).reshape(4, 3, -1)
        with np.errstate(all="ignore"):
            inverse = 1.0 / poly[1::2]
            value = poly[::2] * inverse
            jacobian = value[:, None] * slope[1::2]
            np.subtract(slope[::2], jacobian, out=jacobian)
            jacobian *= inverse[:, None]
        return value, jacobian

    def _basis(self, ground: Array, views: slice, count: IntArray) -> Array:
        """Return the monomials (20, n) of the normalised coordinates of ground points, `count` of each view."""
        normalized = ground - np.repeat(self.ground_offset[views].T, count, axis=1)
        if not np.abs(normalized[0]).max(initial=0.0) <= 180.0:
            normalized[0] = wrap_longitude(normalized[0])
        normalized *= np.repeat(1.0 / self.ground_scale[views].T, count, axis=1)
        return monomials(normalized)


def _polynomials(coeffs: Array, basis: Array, bounds: IntArray) -> Array:
    """Return the polynomials (m, n) of consecutive views (v, m, 20), each at its own points: a small product a view."""
    out = np.empty((coeffs.shape[1], basis.shape[1]))
    for matrix, start, stop in zip(coeffs, bounds[:-1], bounds[1:], strict=True):
        np.matmul(matrix, basis[:, start:stop], out=out[:, start:stop])
    return out


def localize_stack(sensors: Sequence[SensorModel], image: Array, alt: Array, bounds: IntArray) -> Array:
    """Localise image points (n, 2) [px] at altitudes (n,) [m]: ground points (n, 3), as each camera's `localize`.

    Those of camera v are bounds[v] : bounds[v + 1].
    """
    return RpcStack(sensors).localize(image, alt, bounds).T


def _blank(found: Array) -> Array:
    """Return values (..., n), NaN at the points of which one is not finite."""
    if not np.isfinite(found.sum()):
        found[..., ~np.isfinite(found).all(axis=tuple(range(found.ndim - 1)))] = np.nan
    return found


def _invert(stack: RpcStack, image: Array, alt: Array, views: slice, bounds: IntArray) -> tuple[Array, BoolArray]:
    """Return ground points (3, n) by Newton from RPCs' centres; which (n,) are certain: in the box, steps fall."""
    count = np.diff(bounds)
    offset, scale = (np.repeat(rows[views].T, count, axis=1) for rows in (stack.ground_offset, stack.ground_scale))
    ground, before = offset.copy(), np.full(len(alt), np.inf)
    ground[2] = alt
    certain = np.ones(len(alt), dtype=bool)
    for _ in range(NEWTON_STEPS):
        value, ((a, b, _), (c, d, _)) = stack.project(ground, views, bounds)
        with np.errstate(all="ignore"):
            col, row = image - value
            step = np.stack([d * col - b * row, a * row - c * col]) / (a * d - b * c)
        ground[:2] += step
        size = np.abs(step / scale[:2]).max(axis=0)
        certain &= size <= np.maximum(_NEWTON_SHRINK * before, _ARRIVED)
        if not certain.any() or size[certain].max() <= _ARRIVED:
            break
        before = size
    certain &= (size <= _ARRIVED) & (np.abs(ground - offset) <= TRUSTED_REACH * np.abs(scale)).all(axis=0)
    return ground, certain
