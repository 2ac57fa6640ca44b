"""A pushbroom camera, corrected or not, as a state of the Community Sensor Model that USGS' library and ASP read."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from barpc.errors import RpcError
from barpc.geodesy import WGS84_A, WGS84_B, Array, ecef_from_ground, ground_from_ecef
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected
from barpc.sensor.csm import FLIP, LINESCAN
from barpc.sensor.pushbroom import Pushbroom

_STEP = 0.02  # s, from sample to sample, at most
_BEYOND = 4  # samples before and after the image: readers interpolate through eight
_COLUMNS = 9  # of a row, through which its attitude goes
_FAR = 1e6  # m: of the points that tell a motion

_PLAIN: dict[str, Any] = {
    "m_centerEphemerisTime": 0.0,
    "m_covariance": [0.0] * 256,
    "m_currentParameterValue": [0.0] * 16,
    "m_detectorLineOrigin": 0.0,
    "m_detectorLineSumming": 1.0,
    "m_detectorSampleOrigin": 0.0,
    "m_detectorSampleSumming": 1.0,
    "m_distortionType": 0,
    "m_ikCode": 0,
    "m_imageIdentifier": "",
    "m_majorAxis": WGS84_A,
    "m_minorAxis": WGS84_B,
    "m_maxElevation": 10000.0,
    "m_minElevation": -10000.0,
    "m_modelName": LINESCAN,
    "m_opticalDistCoeffs": [0.0] * 3,
    "m_parameterType": [2] * 16,
    "m_platformFlag": 1,
    "m_platformIdentifier": "",
    "m_sensorIdentifier": "barpc",
    "m_sensorName": "USGSAstroLineScanner",
    "m_startingDetectorLine": 0.0,
    "m_startingDetectorSample": 0.0,
    "m_startingEphemerisTime": 0.0,
    "m_sunPosition": [0.0] * 3,
    "m_sunVelocity": [0.0] * 3,
    "m_zDirection": 1.0,
}


def is_writable(model: SensorModel) -> bool:
    """Return whether a camera is a pushbroom one of a straight detector, behind corrections in space only."""
    while isinstance(model, Corrected):
        model = model.sensor
    return isinstance(model, Pushbroom) and model.look.shape[1] == 2 and bool(model.line_period > 0)


def state_text(model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float]) -> str:
    """Return the state of a camera that `is_writable`, of an image of `size` (width, height) [px].

    Orbit and attitude are sampled with the corrections in them. What bends light is a turn of the camera that changes
    with the row, true in the middle of the altitudes; what that lacks is measured by opening the state again.
    RpcError for another camera, or one that does not see the ground over its image.
    """
    base = _base(model)
    count = int(np.ceil((size[1] - 1) * base.line_period / _step(base))) + 1
    step = (size[1] - 1) * base.line_period / (count - 1)
    late = step * np.arange(-_BEYOND, count + _BEYOND)
    rows: Array = np.asarray(late / base.line_period, dtype=np.float64)
    positions = _positions(model, rows)
    attitude = _attitude(model, base, rows, positions, (size[0], float(np.mean(alt_range))))
    velocities = np.gradient(positions, step, axis=0)
    middle = model.localize((np.array(size) - 1.0) / 2, np.array(np.mean(alt_range)))
    last = base.line_period * (size[1] - 1)
    sides = np.array([[0.0, 0.0], [1.0, 0.0], [size[0] - 1.0, 0.0]])
    near = ecef_from_ground(model.localize(sides, np.full(3, float(np.mean(alt_range)))))
    state = {
        **_PLAIN,
        **_detector(base),
        "m_nSamples": size[0],
        "m_nLines": size[1],
        "m_intTimeLines": [1.0, float(size[1])],
        "m_intTimeStartTimes": [0.0, last],
        "m_intTimes": [base.line_period] * 2,
        "m_t0Ephem": float(late[0]),
        "m_dtEphem": step,
        "m_t0Quat": float(late[0]),
        "m_dtQuat": step,
        "m_numPositions": positions.size,
        "m_positions": positions.ravel().tolist(),
        "m_velocities": velocities.ravel().tolist(),
        "m_numQuaternions": 4 * len(rows),
        "m_quaternions": attitude.as_quat().ravel().tolist(),
        "m_referencePointXyz": ecef_from_ground(middle).tolist(),
        "m_flyingHeight": float(ground_from_ecef(positions[len(rows) // 2])[2]),
        "m_gsd": float(np.linalg.norm(near[1] - near[0])),
        "m_halfSwath": float(np.linalg.norm(near[2] - near[0])) / 2,
        "m_halfTime": last / 2,
    }
    return f"{LINESCAN}\n{json.dumps(dict(sorted(state.items())), indent=1)}\n"


def _base(model: SensorModel) -> Pushbroom:
    if not is_writable(model):
        raise RpcError("only pushbroom cameras of a straight detector are written as a CSM state")
    while isinstance(model, Corrected):
        model = model.sensor
    assert isinstance(model, Pushbroom)
    return model


def _step(base: Pushbroom) -> float:
    """Return the sampling step [s]: half of the camera's own."""
    own = np.diff(base.attitude.knots)
    return min(_STEP, float(np.median(own)) / 2) if len(own) > 1 else _STEP


def _positions(model: SensorModel, rows: Array) -> Array:
    """Return the camera positions (N, 3) [m], ECEF, at rows (N,), corrections included."""
    if not isinstance(model, Corrected):
        return np.asarray(_base(model).position(rows))
    stands, correction = _positions(model.sensor, rows), model.correction
    at = correction.center + _FAR * np.vstack([np.zeros(3), np.eye(3)])
    moved = correction.apply(np.broadcast_to(at[:, None], (4, len(rows), 3)), np.broadcast_to(rows, (4, len(rows))))
    matrix = np.moveaxis(moved[1:] - moved[0], 0, -1) / _FAR  # (N, 3, 3)
    return np.asarray(correction.center + np.linalg.solve(matrix, (stands - moved[0])[..., None])[..., 0])


def _attitude(model: SensorModel, base: Pushbroom, rows: Array, positions: Array, seen: tuple[int, float]) -> Rotation:
    """Return the rotation ecef_from_camera, z away from the ground, nearest to the lines of sight of each row."""
    cols = np.linspace(0.0, seen[0] - 1.0, _COLUMNS)
    image = np.stack(np.broadcast_arrays(cols, rows[:, None]), axis=-1)
    away = ecef_from_ground(model.localize(image, np.full(image.shape[:2], seen[1]))) - positions[:, None]
    if not np.isfinite(away).all():
        raise RpcError("a camera that does not see the ground over its image is not written as a CSM state")
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    tangents = base.look @ np.stack([np.ones(_COLUMNS), cols - base.look_origin])
    inside = np.vstack([tangents, np.ones(_COLUMNS)]).T
    inside /= np.linalg.norm(inside, axis=1, keepdims=True)
    left, _, right = np.linalg.svd(np.einsum("nki,kj->nij", away, inside))  # Wahba's problem
    turn = np.ones((len(rows), 3))
    turn[:, 2] = np.linalg.det(left @ right)
    return Rotation.from_matrix((left * turn[:, None]) @ right @ FLIP)


def _detector(base: Pushbroom) -> dict[str, Any]:
    """Return the focal length [px] and where iTransS and iTransL put the detector: line 0, sample = column + 0.5."""
    slope = base.look[:, 1]
    focal = 1.0 / float(np.linalg.norm(slope))
    first = base.look @ np.array([1.0, -0.5 - base.look_origin])
    (x, y), (u, v) = focal * first * [-1.0, 1.0], focal * slope * [-1.0, 1.0]
    return {
        "m_focalLength": focal,
        "m_iTransS": [-(u * x + v * y), u, v],
        "m_iTransL": [v * x - u * y, -v, u],
    }
