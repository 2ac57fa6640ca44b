"""A reference of a rendered scene: an orthoimage of another season, and a terrain model with errors of its own."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.warp import transform as warp_points
from scipy import ndimage

from tests.geotiffs import write_image
from tests.scenes.images import Scene
from tests.scenes.terrain import Float32, Grid, fractal
from tests.scenes.texture import AMBIENT, Date, _albedo, _cast, _light, _resampled

UTM = CRS.from_epsg(32631)
CLASSES = 8


def _lit(scene: Scene, date: Date, shape: tuple[int, int], step: float) -> Float32:
    relief = scene.terrain.relief
    lit = Grid(relief.origin, step, _resampled(_light(relief, date), relief.step / step, shape))
    _cast(scene.terrain, lit, date)
    return ndimage.gaussian_filter(lit.values, 0.7)


def unlit(scene: Scene) -> tuple[Float32, Float32, Float32, np.ndarray]:
    """Of the first date's ground its light, its reflectance, the mean of that around, and the class of that mean."""
    surface = scene.surfaces[0]
    ground, step = surface.ground.values, surface.ground.step
    light = _lit(scene, surface.date, (ground.shape[0], ground.shape[1]), step)
    albedo, wide = ground / light, 2 * int(1.0 / step) + 1
    local = cv2.medianBlur(np.clip(albedo * 400, 0, 255).astype(np.uint8), wide).astype(np.float32) / 400
    edges = np.quantile(local[::7, ::7], np.linspace(0, 1, CLASSES + 1)[1:-1])
    return light, albedo, local, np.digitize(local, edges)


def other_season(scene: Scene, seed: int, *, inverted: float = 0.5, snow: float = 0.15, changed: float = 0.1) -> Grid:
    """Brightness of the scene from straight above on another date.

    Every class of grey has another grey, and `inverted` of the classes the contrast within turned over; the sun stands
    elsewhere, `snow` of the ground is white, `changed` of it something else altogether, and there are new houses.
    """
    rng = np.random.default_rng([seed, 77])
    surface = scene.surfaces[0]
    shape, step = surface.ground.values.shape, surface.ground.step
    _, albedo, local, kind = unlit(scene)
    tone = rng.permutation(np.linspace(0.08, 0.5, CLASSES)).astype(np.float32)
    sign = np.where(np.arange(CLASSES) < inverted * CLASSES, -1.0, 1.0).astype(np.float32)
    sign = rng.permutation(sign)
    today = tone[kind] + sign[kind] * (albedo - local) * rng.uniform(0.6, 1.2)
    if changed:
        other, _ = _albedo(rng, shape, fractal(rng, shape, 0.9), step)
        today = np.where(_part(rng, shape, changed, 30.0 / step), other, today)
    if snow:
        detail = 0.02 * fractal(rng, shape, 0.9)
        today = np.where(_part(rng, shape, snow, 15.0 / step), 0.85 + detail, today)
    for _ in range(int(3e-4 * shape[0] * shape[1] * step * step)):  # 3 a hectare
        high, wide = (rng.uniform(4.0, 20.0, 2) / step).astype(int)
        row, col = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        today[row : row + high, col : col + wide] = rng.uniform(0.05, 0.8)
    today = np.clip(today, 0.03, 0.95) * _lit(scene, Date(225.0, 35.0), shape, step)
    x, y = surface.ground.axes()
    buildings = scene.terrain.buildings
    for i in range(len(buildings)):  # roofs, where they stand
        low, high = buildings.corners()[i, :, :2].min(axis=0), buildings.corners()[i, :, :2].max(axis=0)
        rows, cols = (
            slice(*np.searchsorted(y, (low[1], high[1]))),
            slice(*np.searchsorted(x, (low[0], high[0]))),
        )
        today[rows, cols][buildings.under(i, *np.meshgrid(x[cols], y[rows]))] = rng.uniform(0.1, 0.8) * (
            AMBIENT + (1 - AMBIENT) * 0.5
        )
    return Grid(surface.ground.origin, step, today.astype(np.float32))


def _part(rng: np.random.Generator, shape: tuple[int, int], share: float, shortest: float) -> np.ndarray:
    """Patches that cover a share of the ground."""
    thin = max(int(shortest / 4), 1)
    coarse = (shape[0] // thin + 2, shape[1] // thin + 2)
    noise = _resampled(fractal(rng, coarse, 1.5, 4.0), float(thin), shape)
    return noise > np.quantile(noise[::7, ::7], 1.0 - share)


def write_reference(
    path: Path, scene: Scene, season: Grid, gsd: float, shift: tuple[float, float] = (0.0, 0.0)
) -> Path:
    """A season as a GeoTIFF in UTM, `gsd` [m], its own place off by `shift` [m]."""
    plane = scene.terrain.plane
    x, y = season.axes()
    corners = plane.ground(np.array([[x[0], y[0], 0.0], [x[-1], y[0], 0.0], [x[0], y[-1], 0.0], [x[-1], y[-1], 0.0]]))
    east, north = (np.array(a) for a in warp_points("EPSG:4326", UTM, corners[:, 0], corners[:, 1]))
    left, top = gsd * np.floor(east.min() / gsd), gsd * np.ceil(north.max() / gsd)
    width, height = int((east.max() - left) / gsd), int((top - north.min()) / gsd)
    blurred = Grid(season.origin, season.step, ndimage.gaussian_filter(season.values, 0.5 * gsd / season.step))
    out = np.zeros((height, width), np.uint16)
    for row in range(0, height, 256):
        grid = np.meshgrid(
            left + gsd * (np.arange(width) + 0.5), top - gsd * (np.arange(row, min(row + 256, height)) + 0.5)
        )
        lon, lat = warp_points(UTM, "EPSG:4326", grid[0].ravel(), grid[1].ravel())
        xy = plane.xy(np.column_stack([lon, lat, np.zeros(len(lon))])).reshape(*grid[0].shape, 2)
        at = [(xy[..., k] - season.origin[k]) / season.step for k in (0, 1)]
        inside = (at[0] >= 0) & (at[1] >= 0) & (at[0] < season.values.shape[1]) & (at[1] < season.values.shape[0])
        out[row : row + 256] = np.where(inside, 1 + 900 * blurred(xy[..., 0], xy[..., 1]), 0)
    layout = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate"}
    place = rasterio.Affine(gsd, 0.0, left + shift[0], 0.0, -gsd, top + shift[1])
    return write_image(path, out, crs=UTM, transform=place, nodata=0, **layout)


def write_dem(
    path: Path, scene: Scene, seed: int, error: float = 3.0, bias: float = 0.0, spacing: float = 30.0
) -> Path:
    """The bare ground as a GeoTIFF of ellipsoidal heights, with an error that is correlated over some 300 m."""
    relief, rng = scene.terrain.relief, np.random.default_rng([seed, 78])
    x, y = relief.axes()
    pad = 10 * spacing
    px, py = np.arange(x[0] - pad, x[-1] + pad, spacing), np.arange(y[-1] + pad, y[0] - pad, -spacing)
    heights = relief(*np.meshgrid(px, py)).astype(np.float64)
    noise = ndimage.gaussian_filter(rng.normal(size=[n + 60 for n in heights.shape]), 5.0)[30:-30, 30:-30]
    heights += bias + error * noise / noise.std()
    first = scene.terrain.plane.ground(np.array([px[0], py[0], 0.0]))
    last = scene.terrain.plane.ground(np.array([px[-1], py[-1], 0.0]))
    step = (last - first)[:2] / (len(px) - 1, len(py) - 1)
    place = rasterio.Affine(step[0], 0.0, first[0] - 0.5 * step[0], 0.0, step[1], first[1] - 0.5 * step[1])
    return write_image(path, heights.astype(np.float32), crs="EPSG:4979", transform=place)


SEASONS = {"mild": (0.0, 0.1), "winter": (0.25, 0.4), "extreme": (0.5, 0.6)}
"""Level -> share of the classes of grey that are turned over, share of the ground under snow."""


def disguised(pixels: np.ndarray, seed: int, inverted: float, snow: float) -> np.ndarray:
    """A picture on another date, uint16: classes of grey with other tones, `inverted` of them turned over; snow.

    Everything keeps its place; snow hides what is beneath.
    """
    rng = np.random.default_rng([seed, 79])
    low, high = np.percentile(pixels, [0.5, 99.5])
    grey = np.clip((pixels.astype(np.float32) - low) / (high - low), 0, 1)
    local = cv2.medianBlur(cv2.medianBlur((grey * 255).astype(np.uint8), 5), 5).astype(np.float32) / 255
    kind = np.digitize(local, np.quantile(local[::7, ::7], np.linspace(0, 1, CLASSES + 1)[1:-1]))
    tone = np.linspace(0.1, 0.7, CLASSES)
    tone = rng.permutation(tone) if inverted else np.sort(tone + rng.normal(0, 0.05, CLASSES))
    sign = rng.permutation(np.where(np.arange(CLASSES) < inverted * CLASSES, -1.0, 1.0))
    today = tone[kind] + (sign * rng.uniform(0.6, 1.2, CLASSES))[kind] * (grey - local)
    if snow:
        cover = _part(rng, grey.shape, snow, 60.0)
        today = np.where(cover, 0.85 + 0.02 * fractal(rng, grey.shape, 0.9), today)
    today = cv2.GaussianBlur(today.astype(np.float32), (0, 0), 0.6) + rng.normal(0, 0.004, grey.shape)
    return np.clip(100 + 1500 * today, 1, 4000).astype(np.uint16)
