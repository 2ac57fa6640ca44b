"""Images through a rigorous camera: every sub-pixel is a line of sight, and meets what hides the rest.

A line of sight is straight in the plane's (x, y, altitude) to 1e-4 px over the height of a scene, so two
localisations, at its lowest and highest altitude, are all of it; they are computed exactly on a grid of nodes
and interpolated by cubic splines. Relief is met by the secant method, buildings in closed form.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.interpolate import CubicSpline

from barpc.base.errors import InputError
from barpc.base.geodesy import Array
from barpc.sensor import SensorModel
from tests.scenes.terrain import Float32, Ray, Terrain, fractal
from tests.scenes.texture import Surface

STRIP = 128
"""Rows rendered at a time."""
_NODE = 48  # px between the nodes where lines of sight are computed exactly


@dataclass(frozen=True)
class Radiometry:
    """How brightness becomes numbers.

    Parameters
    ----------
    blur : float
        Standard deviation of the optics' and the motion's blur [px].
    gain : float
        Number of a white plane in full sun.
    gamma : float
        Power that is applied to the brightness first.
    offset : float
        Number of black.
    snr : float
        Ratio of signal to noise at brightness 1; shot noise falls with its root. 0: no noise.
    saturation : int
        Largest number.
    clouds : float
        Part of the image under clouds.
    """

    blur: float = 0.5
    gain: float = 2000.0
    gamma: float = 1.0
    offset: float = 60.0
    snr: float = 100.0
    saturation: int = 4095
    clouds: float = 0.0


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees.

    Parameters
    ----------
    brightness : (H, W)
        float32; 1 is a white plane in full sun.
    altitude : (H, W)
        Of what is seen [m], float32; NaN where a pixel sees more than one surface.
    """

    brightness: Float32
    altitude: Float32


def render(
    sensor: SensorModel,
    size: tuple[int, int],
    surface: Surface,
    samples: int = 2,
    rows: tuple[int, int] | None = None,
) -> Rendering:
    """The exact image of a surface: means over samples x samples lines of sight a pixel.

    Parameters
    ----------
    sensor : SensorModel
        The exact camera.
    size : tuple of int
        Width, height [px].
    surface : Surface
        What is there.
    samples : int
        Lines of sight a pixel and axis.
    rows : tuple of int, optional
        First row and the one after the last of what is rendered; all without.

    Returns
    -------
    rendering : Rendering, of these rows

    Raises
    ------
    InputError
        The camera does not see the ground everywhere.
    """
    width, (first, end) = size[0], rows or (0, size[1])
    brightness, altitude = np.empty((end - first, width), np.float32), np.empty((end - first, width), np.float32)
    boxes = _boxes(sensor, surface.terrain)
    for top, rays in _strips(sensor, size, surface.terrain, samples, (first, end)):
        count = rays.x.shape[0] // samples
        shown, alt = _seen(surface, rays, boxes, top, samples)
        blocks = (count, samples, width, samples)
        part = slice(top - first, top - first + count)
        brightness[part] = shown.reshape(blocks).mean(axis=(1, 3))
        cells = alt.reshape(blocks)
        mean = cells.mean(axis=(1, 3))
        altitude[part] = np.where(np.ptp(cells, axis=(1, 3)) < 1.0, mean, np.nan)
    return Rendering(brightness, altitude)


def expose(brightness: Float32, radiometry: Radiometry, rng: np.random.Generator) -> npt.NDArray[np.uint16]:
    """Numbers (H, W) that the detector delivers: blur, clouds, gamma, gain, offset, noise, saturation, rounding."""
    light = ndimage.gaussian_filter(brightness, radiometry.blur, mode="nearest")
    if radiometry.clouds:
        light = _clouded(light, radiometry.clouds, rng)
    signal = radiometry.gain * np.power(light, np.float32(radiometry.gamma))
    if radiometry.snr:
        sigma = np.sqrt(signal * np.float32(radiometry.gain)) / np.float32(radiometry.snr)
        signal = signal + sigma * rng.standard_normal(signal.shape, dtype=np.float32)
    numbers = np.clip(np.rint(signal + radiometry.offset), 1, radiometry.saturation)
    return numbers.astype(np.uint16)


def _clouded(light: Float32, part: float, rng: np.random.Generator) -> Float32:
    """Brightness under clouds with soft edges that hide `part` of the image."""
    noise = fractal(rng, (light.shape[0], light.shape[1]), 1.9, 8.0)
    edge = np.quantile(noise, 1.0 - part)
    veil = np.clip((noise - edge) / 0.25 + 0.5, 0.0, 1.0)
    white = 0.9 + 0.08 * noise
    out: Float32 = (light + veil * (white - light)).astype(np.float32)
    return out


def _strips(
    sensor: SensorModel, size: tuple[int, int], terrain: Terrain, samples: int, part: tuple[int, int]
) -> Iterator[tuple[int, Ray]]:
    """First row and lines of sight (rows x samples, width x samples) of strip after strip of a part of the rows."""
    width = size[0]
    low, high = terrain.alt_range()
    high = max(high, low + 10.0)
    cols, rows = (np.linspace(-0.5, n - 0.5, max(4, -(-n // _NODE) + 1)) for n in size)
    nodes = np.stack(np.meshgrid(cols, rows), axis=-1)
    ends = [terrain.plane.xy(sensor.localize(nodes, np.array(alt))) for alt in (low, high)]
    if not np.isfinite(ends).all():
        raise InputError("render: the camera does not see the ground in all of the image")
    slope = (ends[1] - ends[0]) / (high - low)
    values = np.moveaxis(np.concatenate([ends[0], slope], axis=-1), -1, 0)  # x, y, dx, dy at the nodes
    fine = (np.arange(width * samples) + 0.5) / samples - 0.5
    across = CubicSpline(cols, np.eye(len(cols)))(fine).T
    values = values @ across
    for top in range(*part, STRIP):
        count = min(STRIP, part[1] - top)
        fine = top + (np.arange(count * samples) + 0.5) / samples - 0.5
        along = CubicSpline(rows, np.eye(len(rows)))(fine)
        x, y, dx, dy = along @ values
        yield top, Ray(x, y, dx, dy, low)


def _boxes(sensor: SensorModel, terrain: Terrain) -> Array:
    """First col, first row, last col, last row (B, 4) [px] of what buildings cover."""
    corners = sensor.project(terrain.plane.ground(terrain.buildings.corners()))
    return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)


def _seen(surface: Surface, rays: Ray, boxes: Array, top: int, samples: int) -> tuple[Float32, Array]:
    """Brightness and altitude of what lines of sight meet first."""
    terrain = surface.terrain
    alt = _ground(terrain, rays, samples)
    shown = surface.ground(*rays.at(alt))
    index = np.full(alt.shape, -1, dtype=np.int32)
    wall = np.zeros(alt.shape, dtype=np.int8)
    height, width = alt.shape
    edges = np.concatenate([boxes[:, :2] - 1.0, boxes[:, 2:] + 2.0], axis=1) - [0, top, 0, top]
    edges = np.clip(edges * samples, 0, [width, height, width, height]).astype(np.int64)
    for i, (left, first, right, last) in enumerate(edges):
        if left >= right or first >= last:
            continue
        part = slice(first, last), slice(left, right)
        low, high, side = terrain.buildings.inside(i, rays.part(*part))
        hit = high > np.maximum(low, alt[part])
        alt[part][hit], index[part][hit], wall[part][hit] = high[hit], i, side[hit]
    on = index >= 0
    if on.any():
        x, y = rays.at(alt)
        shown[on] = surface.building(index[on], wall[on], x[on], y[on], alt[on])
    return shown, alt


def _ground(terrain: Terrain, rays: Ray, samples: int) -> Array:
    """Altitudes where lines of sight meet the relief: every pixel's first line, then all from there."""
    coarse = (slice(None, None, samples),) * 2
    guess = terrain.trace(rays.part(*coarse))
    alt = np.repeat(np.repeat(guess, samples, axis=0), samples, axis=1)
    for _ in range(2):
        alt = terrain.relief(*rays.at(alt)).astype(np.float64)
    return alt
