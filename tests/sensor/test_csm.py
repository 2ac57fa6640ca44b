"""CSM states: against the equations of USGS' library, written out here, and what delivered states say of themselves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pyproj import Geod
from scipy.interpolate import BarycentricInterpolator
from scipy.spatial.transform import Rotation

from barpc.base.errors import BarpcError, InputError, RpcError, RpcFormatError
from barpc.base.geodesy import ecef_from_ground, ground_from_ecef
from barpc.cameras import open_camera
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.csm import FRAME, LINESCAN, is_state, is_writable, open_state, state_text
from tests.sensor.conftest import slopes_off

State = dict[str, object]
SIZE = (3000, 4000)
STEP, PERIOD, FIRST = 0.02, 1e-4, 3.0  # s


def base(focal: float, **changes: object) -> State:
    """Fields that both models have; a detector that is turned, stretched, binned and begins elsewhere."""
    return {
        "m_nSamples": SIZE[0],
        "m_nLines": SIZE[1],
        "m_majorAxis": 6378137.0,
        "m_minorAxis": 6356752.314245179,
        "m_focalLength": focal,
        "m_opticalDistCoeffs": [2e-4, -3e-6, 4e-9],
        "m_distortionType": 0,
        "m_iTransS": [0.3, 99.0, 0.7],
        "m_iTransL": [-0.2, -0.6, 101.0],
        "m_detectorSampleSumming": 2.0,
        "m_detectorLineSumming": 2.0,
        "m_startingDetectorSample": 40.0,
        "m_startingDetectorLine": 7.0,
        **changes,
    }


def nadir(position: np.ndarray, flipped: bool) -> np.ndarray:
    """ecef_from_camera (3, 3) of a camera above a place, z down, or up where it is `flipped`."""
    z = position / np.linalg.norm(position) * (1.0 if flipped else -1.0)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z]) @ Rotation.from_euler("xyz", [0.1, -0.06, 0.4]).as_matrix()


def linescan(flipped: bool = False, direction: float = 1.0, **changes: object) -> State:
    """A satellite at 600 km over 44 N."""
    times = STEP * np.arange(400)
    angle = 1.08e-3 * times[:, None]
    start = ecef_from_ground(np.array([5.0, 44.0, 6e5]))
    along = np.cross(start, [0.3, -1.0, 0.2])
    along *= np.linalg.norm(start) / np.linalg.norm(along)
    positions = np.cos(angle) * start + np.sin(angle) * along
    velocities = 1.08e-3 * (np.cos(angle) * along - np.sin(angle) * start)
    swing = Rotation.from_rotvec(np.outer(np.sin(times), [2e-4, 1e-4, -3e-4]) + np.outer(times, [1e-3, -1e-3, 2e-3]))
    turned = Rotation.from_matrix(nadir(start, flipped)) * swing
    return (
        base(
            800.0,
            m_modelName=LINESCAN,
            m_zDirection=direction,
            m_detectorSampleOrigin=3000.0,
            m_detectorLineOrigin=5.0,
            m_intTimeLines=[1.0, 2001.0],
            m_intTimeStartTimes=[FIRST, FIRST + 2000 * PERIOD],
            m_intTimes=[PERIOD, PERIOD],
            m_currentParameterValue=[0.0] * 16,
            **{"m_t0Ephem": 0.25, "m_dtEphem": STEP, "m_t0Quat": 0.5, "m_dtQuat": STEP},
            m_numPositions=positions.size,
            m_positions=positions.ravel().tolist(),
            m_velocities=velocities.ravel().tolist(),
            m_numQuaternions=4 * len(times),
            m_quaternions=turned.as_quat().ravel().tolist(),
        )
        | changes
    )


def frame(flipped: bool = False, **changes: object) -> State:
    """An aerial camera 9 km up."""
    center = ecef_from_ground(np.array([5.0, 44.0, 9e3]))
    quaternion = 1.7 * Rotation.from_matrix(nadir(center, flipped)).as_quat()  # of any length
    return (
        base(
            100.0,
            m_modelName=FRAME,
            m_ccdCenter=[4003.0, 3001.0],
            m_currentParameterValue=[*center.tolist(), *quaternion.tolist()],
        )
        | changes
    )


def write(state: State, path: Path, before: str | None = None) -> Path:
    path.write_text((f"{state['m_modelName']}\n" if before is None else before) + json.dumps(state))
    return path


def _place(state: State, line: float, sample: float, origin: tuple[float, float]) -> np.ndarray:
    """The undistorted place in the focal plane of a detector's (line, sample) before binning."""
    s, t = (np.array(state[f"m_iTrans{k}"]) for k in "SL")
    at_sample = sample * state["m_detectorSampleSumming"] + state["m_startingDetectorSample"] - origin[0]
    at_line = line * state["m_detectorLineSumming"] + state["m_startingDetectorLine"] - origin[1]
    x, y = np.linalg.solve([s[1:], t[1:]], [at_sample - s[0], at_line - t[0]])
    k, r2 = state["m_opticalDistCoeffs"], x * x + y * y
    return np.array([x, y]) * (1.0 - (k[0] + r2 * (k[1] + r2 * k[2])))


def _near(values: np.ndarray, start: float, step: float, time: float) -> np.ndarray:
    """Lagrange's polynomial through the eight samples around a time."""
    first = min(max(int((time - start) // step) - 3, 0), len(values) - 8)
    nodes = start + step * np.arange(first, first + 8)
    return BarycentricInterpolator(nodes, values[first : first + 8])(time)


def ray(state: State, col: float, row: float) -> tuple[np.ndarray, np.ndarray]:
    """Centre and direction, of either sign, of a pixel by the equations of USGS' library."""
    line, sample = row + 0.5, col + 0.5
    if state["m_modelName"] == FRAME:
        pose = np.array(state["m_currentParameterValue"])
        origin = state["m_ccdCenter"][::-1]
        look = [*_place(state, line, sample, origin), state["m_focalLength"]]
        return pose[:3], Rotation.from_quat(pose[3:]).apply(look)
    at = int(np.searchsorted(state["m_intTimeLines"], line, side="right")) - 1
    at = max(at, 0)
    late = line - state["m_intTimeLines"][at] + 0.5
    time = state["m_intTimeStartTimes"][at] + state["m_intTimes"][at] * late
    origin = (state["m_detectorSampleOrigin"], state["m_detectorLineOrigin"])
    look = -np.array([*(_place(state, 0.0, sample, origin) * state["m_zDirection"]), state["m_focalLength"]])
    center = _near(np.reshape(state["m_positions"], (-1, 3)), state["m_t0Ephem"], state["m_dtEphem"], time)
    quaternion = _near(np.reshape(state["m_quaternions"], (-1, 4)), state["m_t0Quat"], state["m_dtQuat"], time)
    return center, Rotation.from_quat(quaternion).apply(look)


def offset(state: State, ground: np.ndarray, image: np.ndarray) -> float:
    """How far [m] the lines of sight of pixels (N, 2) pass by points (N, 3), at most."""
    far = []
    for point, (col, row) in zip(ecef_from_ground(ground), image, strict=True):
        center, look = ray(state, col, row)
        look = look / np.linalg.norm(look)
        far.append(np.linalg.norm(np.cross(point - center, look)))
    return max(far)


STATES = {
    "linescan": linescan(),
    "linescan, z up": linescan(flipped=True),
    "linescan, direction -1": linescan(direction=-1.0),
    "linescan, z up, direction -1": linescan(flipped=True, direction=-1.0),
    "frame": frame(),
    "frame, z up": frame(flipped=True),
}


@pytest.mark.few(2)
@pytest.mark.parametrize("name", STATES)
def test_pixels_look_where_the_library_says(name, tmp_path):
    state = STATES[name]
    model, size = open_state(write(state, tmp_path / "a.json"))
    assert size == SIZE
    rng = np.random.default_rng(3)
    image, alt = rng.uniform(0, SIZE, (60, 2)), rng.uniform(-300.0, 3000.0, 60)
    ground = model.localize(image, alt)
    assert np.isfinite(ground).all()
    assert offset(state, ground, image) < (2e-4 if state["m_modelName"] == LINESCAN else 1e-7)  # m
    np.testing.assert_allclose(model.project(ground), image, rtol=0, atol=1e-6)
    np.testing.assert_allclose(model.project_jacobian(ground)[0], image, rtol=0, atol=1e-6)
    assert slopes_off(model, ground, np.array([1e-6, 1e-6, 0.1])) < 1e-5


def test_a_state_is_a_camera_whatever_stands_before_it(tmp_path):
    named = open_camera(write(frame(), tmp_path / "a.adjusted_state.json"))
    plain = open_camera(write(frame(), tmp_path / "b.json", before=""))
    assert (named.format, named.size) == ("csm", SIZE)
    assert plain.model == named.model


@pytest.mark.parametrize(
    ("head", "told"),
    [
        (b'USGS_ASTRO_FRAME_SENSOR_MODEL\n{"a": 1}', True),
        (b' {"m_centerEphemerisTime": 0.0}', True),
        (b'{"m_modelName": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"}', True),
        (b'{"m_modelName": "another"}', True),
        (b'{"a": "USGS_ASTRO_"}', True),
        (b'{"a": 1}', False),
        (b'[{"m_modelName": 1}]', False),
        (b"USGS_ASTRO_FRAME_SENSOR_MODEL", False),
    ],
)
def test_a_state_is_known_by_its_first_bytes(head, told):
    assert is_state(head) is told


def test_a_frame_camera_sees_nothing_behind_it(tmp_path):
    model, _ = open_state(write(frame(), tmp_path / "a.json"))
    assert np.isnan(model.project([5.0, 44.0, 2e4])).all()
    assert np.isfinite(model.project([5.0, 44.0, 0.0])).all()


LIES: dict[str, tuple[State, str]] = {
    "another model": (
        {"m_modelName": "USGS_ASTRO_SAR_SENSOR_MODEL"},
        "state of USGS_ASTRO_SAR_SENSOR_MODEL, read are",
    ),
    "a model that is a list": ({"m_modelName": [LINESCAN]}, r"state of \['USGS_ASTRO_LINE_SCANNER"),
    "another body": ({"m_majorAxis": 1737400.0}, "not the Earth's"),
    "another distortion": ({"m_distortionType": 4}, "type 4, only radial"),
    "no size": ({"m_nSamples": None}, "m_nSamples is missing"),
    "a word": ({"m_nLines": "4000"}, "m_nLines is missing or no number"),
    "a size of nothing": ({"m_nLines": 0}, "m_nLines is 0, expected above 0"),
    "a detector of no area": ({"m_iTransL": [0.0, 99.0, 0.7]}, "span no plane"),
    "too few terms": ({"m_iTransS": [0.0, 1.0]}, "m_iTransS holds 2 numbers, expected 3"),
    "positions cut off": (
        {"m_positions": linescan()["m_positions"][:-3]},
        "1197 of 1200 numbers; is the file complete",
    ),
    "positions of another planet": ({"m_positions": [7e7] * 1200}, "no satellite's orbit"),
    "a quaternion of no length": ({"m_quaternions": [0.0] * 1600}, "quaternion of length 0"),
    "another rate": ({"m_intTimes": [PERIOD, 2 * PERIOD]}, "the line rate changes"),
    "a jump of time": ({"m_intTimeStartTimes": [FIRST, FIRST + 2001 * PERIOD]}, "the line rate changes"),
    "parameters": ({"m_currentParameterValue": [0.0] * 15 + [1.0]}, "adjustable parameters that are not 0"),
    "a time of elsewhere": ({"m_t0Quat": 40.0}, "is the list complete"),
}


@pytest.mark.few(6)
@pytest.mark.parametrize("lie", LIES)
def test_a_state_that_lies_is_said_in_one_line(lie, tmp_path):
    change, words = LIES[lie]
    path = write(linescan(**change), tmp_path / "a.json", before=f"{LINESCAN}\n")
    with pytest.raises((InputError, RpcFormatError), match=words) as told:
        open_camera(path)
    assert str(told.value).startswith(str(path))
    assert "\n" not in str(told.value)


def test_a_state_cut_off_anywhere_is_one_line(tmp_path):
    text = write(linescan(), tmp_path / "a.json").read_text()
    for end in range(80, len(text) - 1, len(text) // 40):
        (tmp_path / "b.json").write_text(text[:end])
        with pytest.raises(BarpcError) as told:
            open_state(tmp_path / "b.json")
        assert "\n" not in str(told.value)


def delivered(folder: Path, name: str) -> tuple[object, State]:
    path = folder / "csm" / name
    text = path.read_text()
    return open_camera(path), json.loads(text[text.index("{") :])


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("1040010074793300.adjusted_state.json", (43008, 38912)),
        ("csm-104001001427B900.r100.adjusted_state.json", (42500, 294448)),
    ],
)
def test_delivered_states_look_where_the_library_says(name, size, shared_data):
    camera, state = delivered(shared_data, name)
    assert camera.size == size
    rng = np.random.default_rng(1)
    image, alt = rng.uniform(0, size, (100, 2)), rng.uniform(-100.0, 3000.0, 100)
    assert offset(state, camera.model.localize(image, alt), image) < 0.02  # m: pixels of 0.36
    if name.startswith("csm"):  # the library's own word: what the middle of the image sees
        seen = camera.model.project(ground_from_ecef(np.array(state["m_referencePointXyz"])))
        np.testing.assert_allclose(seen, (np.array(size) - 1) / 2, rtol=0, atol=1e-3)


def test_a_delivered_state_is_its_vendor_s_camera_adjusted_by_pixels(shared_data):
    camera, _ = delivered(shared_data, "1040010074793300.adjusted_state.json")
    vendor = open_camera(f"{shared_data / 'physical_maxar' / '1040010074793300.xml'},model=physical,refraction=no")
    image = np.random.default_rng(0).uniform(0, camera.size, (300, 2))
    moved = camera.model.project(vendor.model.localize(image, np.full(300, 100.0))) - image
    assert np.abs(moved.mean(axis=0)).max() < 3.0  # px; another order of quaternions or lines: thousands
    assert moved.std(axis=0).max() < 0.4


# --- written ----------------------------------------------------------------------------------------------


def corrected(model: object, rows: int) -> Corrected:
    """The camera turned by 10 urad, drifting, and moved by metres."""
    turn, move, drift = [8e-6, -5e-6, 3e-6], [5.0, -3.0, 2.0], [[2e-6, 3e-6, -1e-6]]
    middle = rows / 2
    return Corrected(model, Correction(turn, move, model.position(middle), drift, row_offset=middle, row_scale=middle))


@pytest.mark.few(2)
@pytest.mark.parametrize("changes", [{"m_opticalDistCoeffs": [0.0] * 3}, {"m_opticalDistCoeffs": [1e-3, 0.0, 0.0]}])
@pytest.mark.parametrize("flipped", [False, True])
def test_a_corrected_camera_is_written_as_a_state_that_the_library_reads_as_meant(changes, flipped, tmp_path):
    model, _ = open_state(write(linescan(flipped=flipped, **changes), tmp_path / "a.json"))
    moved = corrected(model, SIZE[1])
    (tmp_path / "b.json").write_text(state_text(moved, SIZE, (0.0, 1000.0)))
    again = open_camera(tmp_path / "b.json")
    rng = np.random.default_rng(4)
    image, alt = rng.uniform(0, SIZE, (40, 2)), rng.uniform(0.0, 1000.0, 40)
    ground = moved.localize(image, alt)
    np.testing.assert_allclose(again.model.project(ground), image, rtol=0, atol=1e-5)
    text = (tmp_path / "b.json").read_text()
    state = json.loads(text[text.index("{") :])
    assert state["m_centerEphemerisTime"] == state["m_detectorLineOrigin"] == 0.0  # times count from the first row's
    assert offset(state, ground, image) < 1e-3  # m: pixels of 7
    sides = moved.localize(np.array([[0.0, 0.0], [1.0, 0.0], [SIZE[0] - 1.0, 0.0]]), np.full(3, 500.0)).T
    wide, far = Geod(ellps="WGS84").inv(*np.repeat(sides[:2, :1], 2, axis=1), *sides[:2, 1:])[2] * (1 + 500.0 / 6.37e6)
    assert (state["m_gsd"], state["m_halfSwath"]) == pytest.approx((wide, far / 2.0), rel=1e-4)
    off = np.abs(model.project(ground) - image).max()
    assert off > 0.5  # the correction is seen


@pytest.mark.parametrize("rows", [2, 4000])
def test_a_state_is_sampled_from_the_first_row_to_the_last_and_as_far_beyond_as_readers_look(rows, tmp_path):
    model, _ = open_state(write(linescan(m_opticalDistCoeffs=[0.0] * 3), tmp_path / "a.json"))
    state = json.loads(state_text(model, (SIZE[0], rows), (0.0, 1000.0)).partition("\n")[2])
    before, step, count = -state["m_t0Ephem"], state["m_dtEphem"], state["m_numPositions"] // 3
    after = (count - 1) * step - before - (rows - 1) * PERIOD
    assert (before, after) == pytest.approx((4.0 * step, 4.0 * step))  # they interpolate through eight samples
    assert step <= STEP / 2.0


def test_a_delivered_state_goes_out_again_as_it_came_in(shared_data, tmp_path):
    """All that ASP's own files hold is in what is written."""
    camera, given = delivered(shared_data, "1040010074793300.adjusted_state.json")
    text = state_text(camera.model, camera.size, (-100.0, 2000.0))
    (tmp_path / "b.json").write_text(text)
    assert set(json.loads(text[text.index("{") :])) == set(given)
    assert {k: type(v) for k, v in json.loads(text[text.index("{") :]).items()} == {
        k: type(v) for k, v in given.items()
    }
    again = open_camera(tmp_path / "b.json").model
    image = np.random.default_rng(0).uniform(0, camera.size, (300, 2))
    off = again.project(camera.model.localize(image, np.full(300, 500.0))) - image
    assert np.abs(off).max() < 1e-3


def test_only_straight_pushbroom_cameras_are_written(tmp_path):
    bent, _ = open_state(write(linescan(), tmp_path / "a.json"))  # radial distortion
    whole, _ = open_state(write(frame(), tmp_path / "b.json"))
    for model in (bent, whole):
        assert not is_writable(model)
        with pytest.raises(RpcError, match="only pushbroom cameras of a straight detector"):
            state_text(model, SIZE, (0.0, 1000.0))
