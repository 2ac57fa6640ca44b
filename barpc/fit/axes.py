"""Test of a model's longitude, latitude and altitude axes by its lines of sight.

A mirrored image tells nothing: detectors are numbered to the left of the flight or to the right. But the lines of sight
of a row of an optical image meet where the camera stood, or those of a column, and a radar's row lies in a plane, that
of its beam. On a round Earth both hold in the right order and with the right sign only. A camera stands above.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from barpc.base.geodesy import WGS84_A, Array, ecef_from_ground
from barpc.sensor import SensorModel
from barpc.sensor.geometry import LEAST_RANGE

_POINT, _PLANE = 100.0, 1e4
"""Times that another reading is better before it is accepted. Errors of a model are common to all its readings: of 160
honest models none was better by more than 2.2 in a wrong one; one over a flat Earth may be by tens, its planes by 2000.
Of models with axes exchanged or upside down physical ones were better by 320 and more, the planes of radars by 5e6."""
_FLAT_CONVERGENCE = (
    2.0 / WGS84_A
)  # 1/m: of the distance of a camera; verticals meet at the Earth's centre, -1 / WGS84_A
_ECEF_ROUNDING = 1e-8  # m: of places in ECEF, and of what iterations leave
_MIN_NODES = 5  # nodes along a line: of few lines of sight any two or three meet
_LINE_POSITIONS, _POINT_POSITIONS = np.linspace(0.1, 0.9, 5), np.linspace(0.02, 0.98, 9)  # of the image's sides


def wrong_axes(model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float]) -> str:
    """Return the fault in the ground axes of a model over an image of `size` and altitudes [m], in words; or empty.

    Exchanged longitude and latitude, or altitudes that grow downwards; of models with a noise of some 1e-3 px, of
    places where both orders are about the same (lon = lat = 0) and lines of sight of neither kind nothing is said.
    """
    rows = np.stack(np.meshgrid(_POINT_POSITIONS, _LINE_POSITIONS), axis=-1)
    places = np.stack([rows, rows[..., ::-1]]) * size - 0.5
    image = np.repeat(places[..., None, :], 2, axis=-2)
    alt = np.broadcast_to(alt_range, image.shape[:-1])
    ground = model.localize(image, alt)
    return _geometry_fault(np.concatenate([ground[..., :2], alt[..., None]], axis=-1))  # whatever altitude it gave back


def wrong_axes_of_grid(ground: Array, image: Array) -> str:
    """Return the same of points (N, 3), (N, 2) that are all the nodes of a grid; of others nothing is said."""
    values = (ground[:, 2], image[:, 1], image[:, 0])
    axes, places = zip(*(np.unique(value, return_inverse=True) for value in values), strict=True)
    shape = tuple(len(axis) for axis in axes)
    if len(ground) != np.prod(shape) or np.ptp(axes[0]) < LEAST_RANGE or min(shape[1:]) < _MIN_NODES:
        return ""
    nodes = np.full((*shape, 3), np.nan)
    nodes[places] = ground
    nodes = np.moveaxis(nodes[[0, -1]], 0, 2)  # rows, columns, low and high
    picked = [
        [(part * (side - 1)).round().astype(int) for part in (_LINE_POSITIONS, _POINT_POSITIONS)] for side in shape[1:]
    ]
    (row, rows), (col, cols) = picked
    return _geometry_fault(np.stack([nodes[np.ix_(row, cols)], nodes[np.ix_(rows, col)].swapaxes(0, 1)]))


def _geometry_fault(ground: Array) -> str:
    """Return the fault of ground points (2, lines, points, 2, 3) of rows and of columns, at two altitudes."""
    point, plane, _ = _sights(ground)
    for what, other in _interpretations(ground):
        at, within, near = _sights(other)
        if near > _FLAT_CONVERGENCE and (point > _POINT * at or plane > _PLANE * within):
            return f"the model's lines of sight are those of a camera only {what}: give lon, lat [deg], alt [m], up"
    return ""


def _interpretations(ground: Array) -> Iterator[tuple[str, Array]]:
    """Yield alternative axes, in words and as ground points, the lower altitude first."""
    yield "with the altitude's sign changed", ground[..., ::-1, :] * [1.0, 1.0, -1.0]
    if np.nanmax(np.abs(ground[..., 0]), initial=0.0) < 90.0:
        yield "with longitude and latitude exchanged", ground[..., [1, 0, 2]]


def _sights(ground: Array) -> tuple[float, float, float]:
    """Return how far lines of sight are from a point and a plane, of rows or columns, whichever are nearer.

    Of ground points (2, lines, points, 2, 3) at two altitudes: root mean square angles [rad], thickness over length,
    and the largest 1 / distance of the point [1/m], above positive; NaN where no line is all on the ground.
    """
    known = [np.array([_bundle(ecef_from_ground(one)) for one in lines if np.isfinite(one).all()]) for lines in ground]
    known = [bundles for bundles in known if len(bundles)]
    if not known:
        return np.nan, np.nan, np.nan
    point, plane = np.min([np.sqrt((bundles[:, :2] ** 2).mean(axis=0)) for bundles in known], axis=0).tolist()
    return point, plane, max(float(bundles[:, 2].mean()) for bundles in known)


def _bundle(ecef: Array) -> tuple[float, float, float]:
    """Return how far lines through points (n, 2, 3) [m] are from a point and a plane, and 1 / distance of the point.

    A line through o with the slope t across the mean direction m passes the point at the distance h along m where
    o + h t is one for all: (o - (o m) (m + t)) / h - g = -t, linear in 1 / h and g.
    """
    ecef = ecef - ecef.mean(axis=(0, 1))
    sight = ecef[:, 1] - ecef[:, 0]
    mean = sight.sum(axis=0) / np.linalg.norm(sight.sum(axis=0))
    slope, depth = sight / (sight @ mean)[:, None] - mean, (ecef[:, 0] @ mean)[:, None]
    across = ecef[:, 0] - depth * (mean + slope)
    width = np.abs(across).max() or 1.0
    system = np.column_stack([across.ravel() / width, np.tile(np.eye(3), (len(ecef), 1))])
    found = np.linalg.lstsq(system, -slope.ravel(), rcond=None)[0]
    off, rounding = system @ found + slope.ravel(), _ECEF_ROUNDING / np.linalg.norm(sight, axis=1).min()
    spread = np.linalg.svd(ecef.reshape(-1, 3), compute_uv=False)
    thickness = (spread[2] + _ECEF_ROUNDING) / spread[0]
    return float(np.sqrt((off**2).mean()) + rounding), float(thickness), float(found[0] / width)
