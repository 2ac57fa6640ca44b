"""States of the Community Sensor Model, as USGS' library and the Ames Stereo Pipeline keep them.

A state is JSON, ``image.json`` or ``image.adjusted_state.json``, mostly behind a line with the model's name. Line l and
sample s of CSM have the first pixel's centre at (0.5, 0.5). The place in the focal plane is where iTransS and iTransL
(offset, by x, by y) give the detector's sample and line; a pixel looks along -(x z, y z, f) with z = m_zDirection
(linescan), (x, y, f) (frame), or the other way if that is towards the ground. Line r is taken at m_intTimeStartTimes +
m_intTimes (l - m_intTimeLines + 0.5). Quaternions are ecef_from_camera, scalar last. Linescan and frame states are
read; pushbroom cameras, corrected or not, are written.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.polynomial import Polynomial

from barpc.base.errors import InputError, RpcError, RpcFormatError, plain
from barpc.base.geodesy import WGS84_A, WGS84_B, Array, ecef_from_ground, ground_from_ecef
from barpc.base.safe_io import CAMERA_STATE, parse_json, read_text
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected
from barpc.sensor.document import LINE_TIME_TOLERANCE, XmlFields, padded
from barpc.sensor.pushbroom import Frame, Pushbroom
from barpc.sensor.samples import ATTITUDE_STEP, Detector, Samples, camera_of_samples, unit

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

STATE_END = ".adjusted_state.json"
"""End of the name of a state, as ASP writes it."""
LINESCAN, FRAME = "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL", "USGS_ASTRO_FRAME_SENSOR_MODEL"

_EARTH = 100.0  # m: by which the axes of an Earth's ellipsoid may differ from WGS84's
FLIP = np.diag([1.0, -1.0, -1.0])
_EXTRA_SAMPLES = 4  # samples before and after the image: readers interpolate through eight
_ATTITUDE_COLUMNS = 9  # of a row, through which its attitude goes

_DEFAULT_STATE: dict[str, Any] = {
    **{f"m_starting{what}": 0.0 for what in ("DetectorLine", "DetectorSample", "EphemerisTime")},
    **dict.fromkeys(("m_centerEphemerisTime", "m_detectorLineOrigin", "m_detectorSampleOrigin"), 0.0),
    **dict.fromkeys(("m_detectorLineSumming", "m_detectorSampleSumming", "m_zDirection"), 1.0),
    "m_covariance": [0.0] * 256,
    "m_currentParameterValue": [0.0] * 16,
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
    "m_sunPosition": [0.0] * 3,
    "m_sunVelocity": [0.0] * 3,
}


def is_state(head: bytes) -> bool:
    """Return whether the first bytes of a file begin a state."""
    return re.match(rb"\s*(USGS_ASTRO_\w+\s*)?\{", head) is not None and (
        b"USGS_ASTRO_" in head or b'"m_centerEphemerisTime"' in head or b'"m_modelName"' in head
    )


def open_state(path: Path) -> tuple[Pushbroom | Frame, tuple[int, int]]:
    """Return the camera of a state and the size (width, height) [px] of its image.

    Raises
    ------
    RpcFormatError
        No state, or a damaged one.
    InputError
        A state of another model, body or distortion than is read.
    """
    text = read_text(path, CAMERA_STATE)
    try:
        found = parse_json(text[max(text.find("{"), 0) :])
    except ValueError as error:
        raise RpcFormatError(f"{path}: no CSM state that can be read ({plain(error)})") from error
    state = _StateFields(found if isinstance(found, dict) else {}, str(path))
    model = str(state.content.get("m_modelName"))
    if model not in _MODEL_READERS:
        raise InputError(f"{path}: a CSM state of {model[:60]}, read are {' and '.join(_MODEL_READERS)}")
    axes = np.array([state.number("m_majorAxis"), state.number("m_minorAxis")])
    if not (np.abs(axes - (WGS84_A, WGS84_B)) < _EARTH).all():
        raise InputError(f"{path}: an ellipsoid of {axes[0]:g} and {axes[1]:g} m, which is not the Earth's")
    return _MODEL_READERS[model](state), state.image_size


class _StateFields(XmlFields):
    """The fields of a state; what is missing or malformed is refused by name."""

    def __init__(self, content: Mapping[str, Any], name: str) -> None:
        self.content, self.name = content, name

    def _listed(self, path: str, between: str) -> Array:
        found = self.content.get(path)
        value = found if isinstance(found, list) else [found]
        if not all(type(v) in (int, float) for v in value):
            raise RpcFormatError(f"{self.name}: {path} is missing or no number; is the file complete?")
        return np.array(value, dtype=np.float64)

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.size("m_nSamples", "m_nLines")

    def plane(self, origin: tuple[float, float]) -> Array:
        """Return (2, 3): detector's sample and line of CSM's (sample, line, 1) to the place in the focal plane."""
        by_sample, by_line = self.numbers("m_iTransS", 3), self.numbers("m_iTransL", 3)
        forth = np.stack([by_sample[1:], by_line[1:]])
        if not abs(np.linalg.det(forth)) > 0:
            raise RpcFormatError(f"{self.name}: m_iTransS and m_iTransL span no plane")
        detector = np.array(
            [
                [self.number(f"m_detector{axis}Summing") * (k == i) for k in range(2)]
                + [self.number(f"m_startingDetector{axis}") - origin[i] - (by_sample, by_line)[i][0]]
                for i, axis in enumerate(("Sample", "Line"))
            ]
        )
        return np.linalg.solve(forth, detector)

    def distortion(self) -> Array:
        """Return the coefficients (3,) by powers of the squared distance from the axis, in focal lengths."""
        given = np.trim_zeros(self.numbers("m_opticalDistCoeffs"), "b")
        # type 0, radial: 1 - k0 - k1 r^2 - k2 r^4 times the place
        if len(given) and (self.number("m_distortionType") or len(given) > 3):
            raise InputError(
                f"{self.name}: a distortion of type {self.number('m_distortionType'):g}, only radial (0) is read"
            )
        return np.asarray(np.pad(given, (0, 3 - len(given))) * self.positive("m_focalLength") ** np.array([0, 2, 4]))


def _linescan(state: _StateFields) -> Pushbroom:
    from scipy.spatial.transform import Rotation  # a tenth of a second, of physical models alone

    size, name = state.image_size, state.name
    if np.any(state.numbers("m_currentParameterValue")):
        raise InputError(f"{name}: adjustable parameters that are not 0, which are not read")
    first, period = _line_timing(state)
    times, positions = _state_samples(state, "positions", "Ephem", 3, first)
    _, velocities = _state_samples(state, "velocities", "Ephem", 3, first)
    ticks, quaternions = _state_samples(state, "quaternions", "Quat", 4, first)
    if len(velocities) != len(positions):
        raise RpcFormatError(f"{name}: {len(velocities)} velocities of {len(positions)} positions")
    rotation = Rotation.from_quat(unit(quaternions, name))
    middle = len(rotation) // 2
    look, origin = _look_polynomial(state, size[0])
    if rotation[middle].as_matrix()[:, 2] @ positions[len(positions) // 2] > 0:  # away from the Earth
        rotation, look = rotation * Rotation.from_matrix(FLIP), look * [[-1.0], [1.0]]
    samples = Samples(name, times, positions, velocities, ticks, rotation.as_quat(scalar_first=True))
    return camera_of_samples(samples, Detector(look, origin, period, size)).model


def _line_timing(state: _StateFields) -> tuple[float, float]:
    """Time of row 0 and from one row to the next [s]."""
    line, start, step = (state.numbers(f"m_intTime{what}") for what in ("Lines", "StartTimes", "s"))
    if not 0 < len(line) == len(start) == len(step):
        raise RpcFormatError(f"{state.name}: {len(line)} m_intTimeLines, {len(start)} times, {len(step)} steps")
    rows, period = line - 1.0, float(step[0])  # the centre of row r is line r + 0.5, half a line after its start
    first = float(start[0] - period * rows[0])
    here = rows < state.image_size[1]
    bent = np.abs(start - first - period * rows)[here].max(initial=0.0)
    if not (period and bent <= LINE_TIME_TOLERANCE * abs(period) and (np.abs(step[here] / period - 1) < 1e-6).all()):
        raise RpcFormatError(f"{state.name}: the line rate changes, or is none, which is not read")
    return first, period


def _state_samples(state: _StateFields, what: str, kind: str, width: int, first: float) -> tuple[Array, Array]:
    """Return the times [s from row 0] and rows of a list of samples at equal steps."""
    values = state.numbers(f"m_{what}")
    stated = state.content.get(f"m_num{what.capitalize()}", len(values))
    if len(values) % width or stated != len(values):
        raise RpcFormatError(f"{state.name}: m_{what} holds {len(values)} of {stated} numbers; is the file complete?")
    step = state.positive(f"m_dt{kind}", 100.0)
    times: Array = state.number(f"m_t0{kind}") - first + step * np.arange(float(len(values) // width))
    return np.asarray(times, np.float64), values.reshape(-1, width)


def _look_polynomial(state: _StateFields, width: int) -> tuple[Array, float]:
    """Return `Pushbroom.look` of the column and its origin, the middle of the image; exact, distortion too."""
    origin = (width - 1) / 2.0
    plane = state.plane((state.number("m_detectorSampleOrigin"), state.number("m_detectorLineOrigin")))
    plane = plane / state.positive("m_focalLength") * np.sign(state.number("m_zDirection"))
    at = [Polynomial([part[0] * (origin + 0.5) + part[2], part[0]]) for part in plane]  # of line 0 of the detector
    square = at[0] ** 2 + at[1] ** 2
    bend = 1.0 - Polynomial(state.distortion())(square)
    look = padded((part * bend).coef for part in at)
    degree = max(1, int(np.flatnonzero(look.any(axis=0)).max(initial=1)))
    return look[:, : degree + 1], origin


def _frame_camera(state: _StateFields) -> Frame:
    from scipy.spatial.transform import Rotation

    pose = state.numbers("m_currentParameterValue", 7)
    if np.any(state.content.get("m_lineTimes") or 0):
        raise InputError(f"{state.name}: a rolling shutter with jitter, which is not read")
    center, quaternion = pose[:3], pose[3:]
    if not np.linalg.norm(quaternion) > 0:
        raise RpcFormatError(f"{state.name}: m_currentParameterValue holds a quaternion of length 0")
    rotation = Rotation.from_quat(quaternion).as_matrix()
    origin = state.numbers("m_ccdCenter", 2)
    plane = state.plane((origin[1], origin[0])) / state.positive("m_focalLength")
    plane[:, 2] += 0.5 * plane[:, :2].sum(axis=1)  # of CSM's (0.5, 0.5) to ours
    if rotation[:, 2] @ center > 0:  # away from the Earth
        rotation, plane = rotation @ FLIP, plane * [[-1.0], [1.0]]
    return Frame(center, rotation, plane, state.distortion())


_MODEL_READERS: dict[str, Callable[[_StateFields], Pushbroom | Frame]] = {LINESCAN: _linescan, FRAME: _frame_camera}


# --- writing -----------------------------------------------------------------------------------------------------


def is_writable(model: SensorModel) -> bool:
    """Return whether a camera is a pushbroom one of a straight detector, behind corrections in space only."""
    return _base(model) is not None


def state_text(model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float]) -> str:
    """Return the state of a camera that `is_writable`, of an image of `size` (width, height) [px].

    Orbit and attitude are sampled with the corrections in them. What bends light is a turn of the camera that changes
    with the row, true in the middle of the altitudes; what that lacks is measured by opening the state again.
    RpcError for another camera, or one that does not see the ground over its image.
    """
    if (base := _base(model)) is None:
        raise RpcError("only pushbroom cameras of a straight detector are written as a CSM state")
    count = int(np.ceil((size[1] - 1) * base.line_period / _step(base))) + 1
    step = (size[1] - 1) * base.line_period / (count - 1)
    late = step * np.arange(-_EXTRA_SAMPLES, count + _EXTRA_SAMPLES)
    rows: Array = np.asarray(late / base.line_period, dtype=np.float64)
    positions = _positions(model, base, rows)
    attitude = _row_rotations(model, base, rows, positions, (size[0], float(np.mean(alt_range))))
    velocities = np.gradient(positions, step, axis=0)
    middle = model.localize((np.array(size) - 1.0) / 2, np.array(np.mean(alt_range)))
    last = base.line_period * (size[1] - 1)
    sides = np.array([[0.0, 0.0], [1.0, 0.0], [size[0] - 1.0, 0.0]])
    near = ecef_from_ground(model.localize(sides, np.full(3, float(np.mean(alt_range)))))
    state: dict[str, Any] = {
        **_DEFAULT_STATE,
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


def _base(model: SensorModel) -> Pushbroom | None:
    while isinstance(model, Corrected):
        model = model.sensor
    return model if isinstance(model, Pushbroom) and model.look.shape[1] == 2 and model.line_period > 0 else None


def _step(base: Pushbroom) -> float:
    """Return the sampling step [s]: half of the camera's own."""
    own = np.diff(base.attitude.knots)
    return min(ATTITUDE_STEP, float(np.median(own)) / 2) if len(own) > 1 else ATTITUDE_STEP


def _positions(model: SensorModel, base: Pushbroom, rows: Array) -> Array:
    """Return the camera positions (N, 3) [m], ECEF, at rows (N,), corrections included."""
    if not isinstance(model, Corrected):
        return np.asarray(base.position(rows))
    return model.correction.undo(_positions(model.sensor, base, rows), rows)


def _row_rotations(
    model: SensorModel, base: Pushbroom, rows: Array, positions: Array, seen: tuple[int, float]
) -> Rotation:
    """Return the rotation ecef_from_camera, z away from the ground, nearest to the lines of sight of each row."""
    from scipy.spatial.transform import Rotation

    cols = np.linspace(0.0, seen[0] - 1.0, _ATTITUDE_COLUMNS)
    image = np.stack(np.broadcast_arrays(cols, rows[:, None]), axis=-1)
    away = ecef_from_ground(model.localize(image, np.full(image.shape[:2], seen[1]))) - positions[:, None]
    if not np.isfinite(away).all():
        raise RpcError("a camera that does not see the ground over its image is not written as a CSM state")
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    tangents = base.look @ np.stack([np.ones(_ATTITUDE_COLUMNS), cols - base.look_origin])
    inside = np.vstack([tangents, np.ones(_ATTITUDE_COLUMNS)]).T
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
    return {"m_focalLength": focal, "m_iTransS": [-(u * x + v * y), u, v], "m_iTransL": [v * x - u * y, -v, u]}
