"""Points through cameras: `project`, `localize`, `triangulate`; and the altitude of an image's ground."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from barpc.base.errors import BarpcError, BarpcWarning, InputError, Remark, UsageError
from barpc.base.geodesy import Array, as_ground, as_image, as_numbers, ground_from_ecef, is_lonlat, wrap_longitude
from barpc.base.keywords import Files, PathLike
from barpc.base.remote import PathOrUrl
from barpc.cameras import ImageLike, open_camera
from barpc.scene import BoolArray, Camera
from barpc.sensor import SensorModel, triangulation
from barpc.sensor.rpc import RPC
from barpc.verbs.images import one_or_many, place_of

if TYPE_CHECKING:
    from barpc.rasters.dem import Dem

_SAME_PLACE = 0.01  # deg: places that are one; others that are seen alike lie degrees away


def project(
    image: ImageLike | SensorModel,
    ground: npt.ArrayLike,
    *,
    alt: npt.ArrayLike | None = None,
    dem: Files | None = None,
    geoid: PathLike | None = None,
) -> Array:
    """Project ground points into an image.

    Parameters
    ----------
    image : path, open rasterio dataset, View, Camera or SensorModel
    ground : (..., 3), lon, lat [deg], altitude [m above the ellipsoid]; (..., 2) with `alt` or `dem`
    alt : (...), optional, altitudes of points without one [m]
    dem : path or paths, optional, DEMs to take all altitudes from
    geoid : str, optional, of DEMs that do not state theirs: a name or a file

    Returns
    -------
    image points : (..., 2), col, row [px], (0, 0) the centre of the first pixel; NaN where a point is not seen

    Raises
    ------
    InputError
        An axis of another length, altitudes given twice or not at all; of an image: as of `open_camera`.

    Warns
    -----
    BarpcWarning
        Points beyond the image by more than its size, or that it covers with longitude and latitude exchanged.

    Examples
    --------
    >>> barpc.project("data_samples/view_00.tif", [5.4, 43.3, 120.0]).round(2)
    array([509.77, 494.61])
    """
    camera, terrain = open_camera(image), terrain_of(dem, geoid)
    points = with_altitudes(ground, alt, terrain)
    if wrong := far_outside(camera, points.reshape(-1, 3)):
        warnings.warn(f"{camera.path}: {wrong}", BarpcWarning, stacklevel=3)
    return camera.model.project(points)


def localize(
    image: ImageLike | SensorModel,
    at: npt.ArrayLike,
    alt: npt.ArrayLike | None = None,
    *,
    dem: Files | None = None,
    geoid: PathLike | None = None,
) -> Array:
    """Localise image points on the ground, at an altitude or on a DEM.

    Parameters
    ----------
    image : path, open rasterio dataset, View, Camera or SensorModel
    at : (..., 2), col, row [px]
    alt : (...), optional
        Altitudes [m above the ellipsoid]. Without, and without `dem`: of the tie points of the image's run, else the
        middle of the camera's altitudes.
    dem, geoid : as of `barpc.project`

    Returns
    -------
    ground points : (..., 3), lon, lat [deg], altitude [m]; NaN where there is none

    Raises
    ------
    InputError
        As of `barpc.project`.

    Warns
    -----
    Remark
        An altitude was assumed.
    BarpcWarning
        Points beyond the image by more than its size.

    Examples
    --------
    >>> barpc.localize("data_samples/view_00.tif", [[0, 0], [500, 500]], alt=120.0).round(4)
    array([[  5.3975,  43.3027, 120.    ],
           [  5.3999,  43.3   , 120.    ]])
    """
    camera, terrain, points = open_camera(image), terrain_of(dem, geoid, alt), as_image(at)
    if terrain is None:
        level = altitude_of(camera, place_of(image)) if alt is None else alt
        found = camera.model.localize(points, as_numbers(level, "altitudes"))
    else:
        found = ground_at(camera, points.reshape(-1, 2), 0.0, terrain).reshape(*points.shape[:-1], 3)
    if wrong := far_outside(camera, found.reshape(-1, 3)):
        warnings.warn(f"{camera.path}: {wrong}", BarpcWarning, stacklevel=3)
    return found


def triangulate(images: Sequence[ImageLike | SensorModel], at: npt.ArrayLike) -> tuple[Array, Array]:
    """Intersect the lines of sight of corresponding image points.

    Parameters
    ----------
    images : sequence of two images or more, V of them: paths, open datasets, Views, Cameras or SensorModels
    at : (..., V, 2), col, row of each point in each image [px]; NaN in an image that does not see it

    Returns
    -------
    ground points : (..., 3), lon, lat [deg], altitude [m above the ellipsoid]; NaN where rays do not intersect
    errors : (...), root mean square distance [px] of a point's projections from its image points

    Raises
    ------
    InputError
        Fewer than two images, an axis of another length.

    Examples
    --------
    >>> images = ["data_samples/view_00.tif", "data_samples/view_02.tif"]
    >>> at = [barpc.project(image, [5.4, 43.3, 120.0]) for image in images]
    >>> ground, error = barpc.triangulate(images, at)
    >>> ground.round(3), bool(error < 1e-6)
    (array([  5.4,  43.3, 120. ]), True)
    """
    cameras = [open_camera(image) for image in one_or_many(images)[0]]
    if len(cameras) < 2:
        raise UsageError("one image; the lines of sight of at least two can meet")
    xy = as_image(at)
    if xy.shape[-2:-1] != (len(cameras),):
        expected = f"(..., {len(cameras)}, 2) is expected"
        raise InputError(f"image points of shape {xy.shape} for {len(cameras)} images: {expected}")
    lead, xy = xy.shape[:-2], xy.reshape(-1, len(cameras), 2)
    point, view = np.nonzero(np.isfinite(xy).all(axis=2))
    models = [camera.model for camera in cameras]
    found = triangulation.triangulate(models, view, point, xy[point, view], alt=cameras[0].altitude)
    ground, error, count = np.full((len(xy), 3), np.nan), np.full(len(xy), np.nan), len(found.points)
    square = np.bincount(point, (found.residuals**2).sum(axis=1), minlength=count)
    ground[:count] = ground_from_ecef(found.points)
    with np.errstate(invalid="ignore", divide="ignore"):
        error[:count] = np.sqrt(square / np.bincount(point, minlength=count))
    return ground.reshape(*lead, 3), error.reshape(lead)


# --- altitudes --------------------------------------------------------------------------------------------


def terrain_of(dem: Files | None = None, geoid: PathLike | None = None, alt: npt.ArrayLike | None = None) -> Dem | None:
    """Return the terrain of DEMs, if any are given; UsageError for a geoid alone, or beside an altitude."""
    if geoid is not None and not dem:
        raise UsageError("--geoid goes with --dem")
    if dem and alt is not None:
        raise UsageError("give either --alt or --dem")
    if not dem:
        return None
    from barpc.rasters.dem import Dem

    return Dem.open(dem, geoid)


def with_altitudes(ground: npt.ArrayLike, alt: npt.ArrayLike | None, terrain: Dem | None) -> Array:
    """Return ground points (..., 3) of such, or of (..., 2) and their altitudes [m] or a terrain, which goes first."""
    points = as_numbers(ground, "ground points")
    if points.shape[-1:] == (2,) and (alt is not None or terrain is not None):
        level = as_numbers(np.nan if alt is None else alt, "altitudes")[..., None]
        lead = np.broadcast_shapes(points.shape[:-1], level.shape[:-1])
        points = np.concatenate([np.broadcast_to(part, (*lead, part.shape[-1])) for part in (points, level)], axis=-1)
    points = as_ground(points)
    if terrain is not None:
        height = terrain.covering(*points[..., :2].reshape(-1, 2).T).reshape(*points.shape[:-1], 1)
        points = np.concatenate([points[..., :2], height], axis=-1)
    return points


def altitude_of(camera: Camera, image: PathOrUrl, given: float | None = None) -> float:
    """Return the altitude of an image's ground [m]: as given, of the tie points of its run, as its RPC states it, else
    the middle of the camera's.

    Where nothing is known of the ground a Remark says so, and what that may be worth.
    """
    if given is not None:
        return given
    for path in (camera.path, image):
        known = _altitudes_beside(path.absolute()).get(path.name) if isinstance(path, Path) else None
        if known is not None:
            return known
    stated = camera.model.height_default if isinstance(camera.model, RPC) else None
    if stated is not None:
        return stated
    warnings.warn(f"{image}: {_unknown(camera)}; give an altitude or a DEM", Remark, stacklevel=4)
    return camera.altitude


def _unknown(camera: Camera) -> str:
    """Return the error by an unknown terrain height, in words."""
    text = f"terrain height unknown, {camera.altitude:g} m assumed (the middle of the camera's altitude range)"
    if camera.size is None:
        return text
    at = camera.model.localize((np.array(camera.size) - 1) / 2, np.array(camera.altitude))
    _, jacobian = camera.model.project_jacobian(at)
    return f"{text}: an error of 100 m shifts the result by {100 * float(np.linalg.norm(jacobian[:, 2])):.3g} px"


def _altitudes_beside(path: Path) -> dict[str, float]:
    """Return the files of the run that wrote into the folder of a file, and the run's altitude [m]; else none."""
    summary = path.parent / "summary.json"
    try:
        return _run_altitudes(path.parent, summary.stat().st_mtime_ns)
    except (BarpcError, OSError):
        return {}


@lru_cache(maxsize=8)
def _run_altitudes(folder: Path, _changed: int) -> dict[str, float]:
    """Return the files that a run wrote for its images into a folder, and the median altitude of its tie points [m]."""
    from barpc.report.finished import FinishedRun  # with all of it: as long again as the cameras take

    summary = FinishedRun.open(folder).summary
    alt = summary.altitude_m
    return {} if alt is None else {name: alt for view in summary.views for name in view.outputs}


def ground_at(camera: Camera, image: Array, alt: Array | float, dem: Dem | None) -> Array:
    """Return ground points (N, 3) of image points (N, 2), on the DEM where there is one, else at altitudes [m]."""
    if dem is not None:
        from barpc.rasters.dem import localize_on_terrain

        found = localize_on_terrain(camera.model, image, dem, camera.alt_range)
        if np.isnan(found).all():
            dem.covering(*camera.model.localize(image, np.full(len(image), camera.altitude))[:, :2].T)
        return found
    return camera.model.localize(image, np.broadcast_to(np.asarray(alt, dtype=np.float64), len(image)))


# --- coordinates in another order -------------------------------------------------------------------------


def far_outside(camera: Camera, ground: Array) -> str:
    """Return a remark on points (N, 3) beyond an image by more than its size, empty where there are none."""
    if wrong := exchanged(camera, np.nan_to_num(ground)):
        return wrong
    if not len(ground) or (camera.size is None and not isinstance(camera.model, RPC)):
        return ""
    known = np.isfinite(ground).all(axis=1)
    off = np.zeros(len(ground), dtype=bool)
    off[known] = ~_on_image(camera, ground[known]) & np.isfinite(camera.model.project(ground[known])).all(axis=1)
    if not (count := int(off.sum())):
        return ""
    return f"{count} of {len(off)} points lie beyond the image by more than its size: its camera is not made for them"


def exchanged(camera: Camera, ground: Array) -> str:
    """Return a remark on points (N, 3) outside an image that covers them with lon and lat exchanged; else empty."""
    if not len(ground) or (camera.size is None and not isinstance(camera.model, RPC)):
        return ""
    swapped = ground[:, [1, 0, 2]]
    if _on_image(camera, ground).any() or not _on_image(camera, swapped[is_lonlat(swapped)]).any():
        return ""
    return "far off the image, and on it with longitude and latitude exchanged: give LON first, then LAT"


def _on_image(camera: Camera, ground: Array) -> BoolArray:
    """Return which points (N, 3) are on the image, or less than its size off it: as stated, or that of an RPC alone.

    Far out an RPC comes near its image again; there it shows another place.
    """
    if camera.size is None:
        middle, side = camera.rpc.image_offset, 2.0 * np.abs(camera.rpc.image_scale)
    else:
        middle, side = np.array(camera.size) / 2, np.array(camera.size)
    image = camera.model.project(ground)
    near = np.asarray((np.abs(image - middle) <= 1.5 * side).all(axis=1))
    off = camera.model.localize(image[near], ground[near, 2]) - ground[near]
    near[near] = (np.abs(np.column_stack([wrap_longitude(off[:, 0]), off[:, 1]])) <= _SAME_PLACE).all(axis=1)
    return near
