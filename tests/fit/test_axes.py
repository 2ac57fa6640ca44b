"""Handedness refuses no model; its lines of sight tell exchanged axes, and never those of an honest one."""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from barpc.base.errors import FitError
from barpc.base.geodesy import Array, ecef_from_ground
from barpc.cameras import open_camera
from barpc.fit import FitOptions, fit_rpc, fit_rpc_points
from barpc.fit.refit import bundle_of_lines, wrong_axes, wrong_axes_of_grid
from barpc.sensor.direct_grid import DirectGrid
from barpc.simulate import Look, fly
from tests.costs import once
from tests.fit.cameras import adjusted, synthetic_rpc
from tests.fit.models import Bent, Frame, Radar, hard, waves

SIZE, ALTS = (12000, 9000), (0.0, 1000.0)
EXCHANGED, NEGATIVE = "with longitude and latitude exchanged", "with the altitude's sign changed"
Case = tuple[Any, tuple[int, int], tuple[float, float]]


@dataclass(frozen=True)
class Changed:
    """Two methods of a model, all that a fit asks for, and what is done to its ground or its image."""

    model: Any
    change: str = ""
    size: tuple[int, int] = SIZE

    def _ground(self, ground: Array) -> Array:
        if self.change == EXCHANGED:
            return ground[..., [1, 0, 2]]
        return ground * [1.0, 1.0, -1.0] if self.change == NEGATIVE else ground

    def _image(self, image: Array) -> Array:
        if self.change == "transposed":
            return image[..., ::-1]
        flipped = [name in self.change for name in ("columns", "rows")]
        return np.where(flipped, np.array(self.size) - 1 - image, image)

    def project(self, ground: Array) -> Array:
        return self._image(self.model.project(self._ground(ground)))

    def localize(self, image: Array, alt: Array) -> Array:
        alt = -alt if self.change == NEGATIVE else alt
        return self._ground(self.model.localize(self._image(image), alt))


@once
def own() -> dict[str, Case]:
    """Name -> model, size, altitude range of models of many kinds, made without a file."""
    found: dict[str, Case] = {}
    for place in ((5.4, 0.7), (48.0, 43.2), (-71.0, -33.0), (128.0, 70.0)):
        for scan in (0, 90, 190, 280):
            look = Look(incidence=3.0 + scan / 12, azimuth=float(scan) + 77.0, scan=float(scan))
            found[f"pushbroom {place}, scan {scan}"] = fly(np.array([*place, 200.0]), look, SIZE, 0.5), SIZE, ALTS
    found["pushbroom near the meridian of 90 E"] = (
        fly(np.array([89.99, 10.0, 200.0]), Look(incidence=10.0, azimuth=77.0, scan=30.0), (1000, 1000), 0.5),
        (1000, 1000),
        ALTS,
    )
    plain = found["pushbroom (48.0, 43.2), scan 190"][0]
    for change in ("columns", "rows", "rows and columns"):
        found[f"pushbroom, {change} reversed"] = Changed(plain, change), SIZE, ALTS
    found["pushbroom, transposed"] = Changed(plain, "transposed"), SIZE[::-1], ALTS
    found["pushbroom, a crop"] = plain, (400, 300), ALTS
    found["grid of a pushbroom"] = DirectGrid.of(plain, SIZE, ALTS), SIZE, ALTS
    frame, size = Frame(5.4, 43.2, 5000.0, 4000.0, (4000, 3000), -0.05), (4000, 3000)
    found["frame"] = frame, size, (0.0, 600.0)
    found["frame, columns reversed"] = Changed(frame, "columns", size), size, (0.0, 600.0)
    for side in (-1.0, 1.0):
        for flat in (False, True):
            heading = 190.0 + 160.0 * flat
            found[f"radar, side {side}, ground range {flat}"] = Radar(11.0, 46.0, heading, side, flat), SIZE, ALTS
    return found


def changed(case: Case, change: str) -> Case:
    """What a case is with its ground changed."""
    model, size, (low, high) = case
    return Changed(model, change, size), size, ((-high, -low) if change == NEGATIVE else (low, high))


def files(folder: Path) -> dict[str, Case]:
    """Cameras in files of others: physical models, states, radars, and vendors' RPCs without their type."""
    kinds = {"csm": "*.json", "physical_maxar": "*.xml", "sar": "*.xml", "radar": "TDX1*.xml"}
    names = [str(path) for kind, pattern in kinds.items() for path in sorted((folder / kind).glob(pattern))]
    names = [f"{name},model=physical" if "physical" in name else name for name in names]
    names += [str(folder / "physical" / "GRID_P1BP--2017092838284574CP.tif")]
    found = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in names:
            camera = open_camera(name)
            found[Path(name).name] = camera.model, camera.extent, camera.alt_range
    return found


def rpcs(folder: Path) -> dict[str, Case]:
    """Vendors' RPCs behind the two methods alone."""
    found = {}
    for path in sorted((folder / "rpc_formats").iterdir()):
        if path.suffix != ".gcp":
            camera = open_camera(str(path))
            size = camera.size or tuple(int(n) for n in camera.rpc.image_offset + np.abs(camera.rpc.image_scale))
            found[path.name] = Changed(camera.model, "", size), size, camera.alt_range
    return found


@pytest.mark.parametrize("name", own())
def test_of_an_honest_model_nothing_is_said_and_of_exchanged_axes_which(name: str) -> None:
    case = own()[name]
    assert wrong_axes(*case) == ""
    assert EXCHANGED in wrong_axes(*changed(case, EXCHANGED))
    assert NEGATIVE in wrong_axes(*changed(case, NEGATIVE))


@pytest.mark.parametrize("name", [name for name in own() if "scan 90" in name or "radar" in name or name == "frame"])
def test_points_that_are_a_grid_are_told_as_a_model_is(name: str) -> None:
    model, size, alts = own()[name]
    axes = [np.linspace(-0.5, side - 0.5, 7) for side in size]
    nodes = np.stack(np.meshgrid(*axes, [*alts, np.mean(alts)]), axis=-1).reshape(-1, 3)
    nodes = np.random.default_rng(0).permutation(nodes)
    ground, image = model.localize(nodes[:, :2], nodes[:, 2]), nodes[:, :2]
    ground[:, 2] = nodes[:, 2]
    assert wrong_axes_of_grid(ground, image) == ""
    assert EXCHANGED in wrong_axes_of_grid(ground[:, [1, 0, 2]], image)
    assert NEGATIVE in wrong_axes_of_grid(ground * [1, 1, -1], image)
    assert wrong_axes_of_grid(ground[1:, [1, 0, 2]], image[1:]) == ""  # a node is missing
    for axis in (0, 1):  # five nodes along a line tell, four do not
        for count, told in ((4, False), (5, True)):
            few = np.isin(image[:, axis], axes[axis][:count])
            assert (EXCHANGED in wrong_axes_of_grid(ground[few][:, [1, 0, 2]], image[few])) == told
    level = ground[:, 2] == alts[0]
    assert wrong_axes_of_grid(ground[level][:, [1, 0, 2]], image[level]) == ""
    ground[:] = ground[0]  # of no use, and no error
    assert wrong_axes_of_grid(np.column_stack([ground[:, :2], nodes[:, 2]]), image) == ""


def test_a_grid_of_exchanged_axes_is_refused() -> None:
    model, size, alts = own()["pushbroom (48.0, 43.2), scan 190"]
    nodes = np.stack(np.meshgrid(*[np.linspace(0, side - 1, 9) for side in size], np.linspace(*alts, 4)), axis=-1)
    ground, image = model.localize(nodes[..., :2], nodes[..., 2]).reshape(-1, 3), nodes.reshape(-1, 3)[:, :2]
    assert fit_rpc_points(ground, image).axes == ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(FitError, match=EXCHANGED):
            fit_rpc_points(ground[:, [1, 0, 2]], image)
        assert EXCHANGED in fit_rpc_points(ground[:, [1, 0, 2]], image, strict=False).axes


@pytest.mark.parametrize("name", ["columns", "rows", "transposed", "frame, columns"])
def test_a_mirrored_model_is_fitted_without_a_word(name: str) -> None:
    name = next(key for key in own() if name in key)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = fit_rpc(*own()[name], options=FitOptions(method="ridge"))
    assert fit.axes == ""
    assert fit.max_ckp.max() < 0.01


def test_exchanged_axes_are_refused_or_left_to_who_judges_by_the_verdict() -> None:
    case = changed(own()["pushbroom, columns reversed"], EXCHANGED)  # handedness as from above: nothing is mirrored
    with pytest.raises(FitError, match=EXCHANGED):
        fit_rpc(*case)
    fit = fit_rpc(*case, strict=False)
    assert fit.max_ckp.max() < 1e-3  # the fit itself is as good as any
    assert EXCHANGED in fit.verdict(1.0)
    assert fit.as_written(fit.rpc).axes == fit.axes


def test_models_of_files_are_told_all_and_none_falsely(shared_data: Path) -> None:
    for name, case in files(shared_data).items():
        assert wrong_axes(*case) == "", name
        for change in ("columns", "rows"):
            assert wrong_axes(Changed(case[0], change, case[1]), *case[1:]) == "", name
        assert EXCHANGED in wrong_axes(*changed(case, EXCHANGED)), name
        assert NEGATIVE in wrong_axes(*changed(case, NEGATIVE)), name


def test_of_vendors_rpcs_some_are_told_and_none_falsely(shared_data: Path) -> None:
    """They follow their cameras to some 1e-3 px, about as far as exchanged axes bend lines of sight."""
    cases = rpcs(shared_data)
    assert [name for name, case in cases.items() if wrong_axes(*case)] == []
    for change, fewest in ((EXCHANGED, 9), (NEGATIVE, 5)):
        told = [wrong_axes(*changed(case, change)) for case in cases.values()]
        assert sum(change in words for words in told) >= fewest
        assert all(change in words for words in told if words)


def test_a_state_with_its_detectors_reversed_is_fitted(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "csm" / "1040010074793300.adjusted_state.json"
    text = path.read_text()
    state = json.loads(text[text.index("{") :])
    state["m_iTransS"] = [-value for value in state["m_iTransS"]]
    sign = state["m_detectorSampleOrigin"]
    state["m_detectorSampleOrigin"] = state["m_nSamples"] - sign
    (tmp_path / path.name).write_text(text[: text.index("{")] + json.dumps(state))
    plain, turned = open_camera(str(path)), open_camera(str(tmp_path / path.name))
    at, size = np.array([[1000.0, 500.0]]), plain.extent
    there = plain.model.localize(at, np.array([50.0]))
    np.testing.assert_allclose(turned.model.project(there), [[size[0] - 1 - 1000.0, 500.0]], atol=1e-3)
    fit = fit_rpc(turned.model, (size[0], 5000), (0.0, 500.0), options=FitOptions(method="ridge", tolerance=0.1))
    assert fit.axes == ""


@pytest.mark.parametrize("noise", [1e-4, 1e-2, 1.0])
@pytest.mark.parametrize("name", ["pushbroom (48.0, 43.2), scan 190", "frame", "pushbroom, a crop", "pushbroom near"])
def test_noise_of_a_model_is_never_taken_for_exchanged_axes(name: str, noise: float) -> None:
    model, size, alts = own()[next(key for key in own() if key.startswith(name))]

    class Noisy:
        def localize(self, image: Array, alt: Array) -> Array:
            return model.localize(image + np.random.default_rng(2).normal(0, noise, np.shape(image)), alt)

    assert wrong_axes(Noisy(), size, alts) == ""  # type: ignore[arg-type]


@pytest.mark.parametrize("tilted", [0.0, 1e-6, 1e-5])
def test_verticals_and_affine_maps_have_no_camera(tilted: float) -> None:
    """A map's lines of sight meet at the Earth's centre, or nowhere: whatever order is better, none is of a camera."""
    rng = np.random.default_rng(1)

    class Map:
        def __init__(self) -> None:
            self.centre, self.tilt = rng.uniform(-80, 80, 2), tilted * rng.normal(size=2)
            self.step = _turned(rng.uniform(0, 360)) * [1e-5, -7e-6]

        def localize(self, image: Array, alt: Array) -> Array:
            lonlat = self.centre + (image - 5000.0) @ self.step.T + self.tilt * alt[..., None]
            return np.concatenate([lonlat, alt[..., None]], axis=-1)

    for _ in range(100):
        assert wrong_axes(Map(), (10000, 10000), ALTS) == ""  # type: ignore[arg-type]


def _turned(degrees: float) -> Array:
    turn = np.radians(degrees)
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


@pytest.mark.parametrize(("lon", "lat"), [(5.4, 70.0), (5.4, 45.0), (-60.0, 45.0), (5.4, -75.0)])
def test_a_frame_over_a_flat_earth_is_no_exchange_either(lon: float, lat: float) -> None:
    """Degrees taken for lengths: nearer to a camera in the other order, near the equator, by ten and not a hundred."""
    size = np.array([20000, 20000])

    class Flat:
        def localize(self, image: Array, alt: Array) -> Array:
            away = np.degrees((7e5 - alt)[..., None] * (image - size / 2) * [1.0, -1.0] / 1.4e6 / 6.378e6)
            return np.concatenate([[lon, lat] + away / [np.cos(np.radians(lat)), 1.0], alt[..., None]], axis=-1)

    assert wrong_axes(Flat(), (20000, 20000), ALTS) == ""  # type: ignore[arg-type]


def test_lines_of_sight_meet_where_the_camera_is() -> None:
    camera = np.array([4.2e6, 1.0e5, 5.1e6])
    ground = 0.9 * camera + np.column_stack([np.zeros(9), np.linspace(-1e4, 1e4, 9), np.linspace(-3e3, 3e3, 9)])
    ecef = np.stack([ground, ground + 1e-3 * (camera - ground)], axis=1)
    point, plane, nearness = bundle_of_lines(ecef)
    assert point < 1e-10
    assert plane < 1e-10
    assert 1 / nearness == pytest.approx(np.linalg.norm(0.1 * camera), rel=1e-3)  # from the middle of the lines' ends
    assert min(point * 700.0, plane * 3e4) > 1e-8  # no farther than to the rounding of places
    assert bundle_of_lines(ecef[:, ::-1])[2] == pytest.approx(-nearness, rel=2e-3)
    bent = ecef + [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]] * np.cos(np.arange(9.0))[:, None, None]
    assert 1e-4 < bundle_of_lines(bent)[0] < 3e-3  # a metre at the end of 660 m
    assert 1e-5 < bundle_of_lines(bent)[1] < 1e-3


@pytest.mark.parametrize("projection", ["+proj=utm +zone={zone}", "+proj=eqc +lat_ts={lat}", "+proj=webmerc"])
def test_cameras_straight_in_a_map_are_wrong_of_the_earth_and_not_of_its_axes(projection: str) -> None:
    """Aerial cameras stand in coordinates of a map as if it were flat: no line of sight is straight on the Earth."""
    rng, size = np.random.default_rng(5), np.array([12000, 9000])

    class InMap:
        def __init__(self, lon: float, lat: float, turn: Array) -> None:
            zone = 1 + int((lon + 180) // 6)
            self.to_map = pyproj.Transformer.from_crs(4326, projection.format(zone=zone, lat=lat), always_xy=True)
            self.centre = np.array([*self.to_map.transform(lon, lat), 5000.0])
            self.turn = Rotation.from_euler("zyx", turn, degrees=True).as_matrix()

        def localize(self, image: Array, alt: Array) -> Array:
            beam = (image - size / 2) / [10000.0, -10000.0]
            sight = np.concatenate([beam, -np.ones((*beam.shape[:-1], 1))], axis=-1) @ self.turn.T
            place = self.centre + sight * ((alt - self.centre[2]) / sight[..., 2])[..., None]
            lonlat = self.to_map.transform(place[..., 0], place[..., 1], direction="INVERSE")
            return np.stack([*lonlat, alt], axis=-1)

    for _ in range(20):
        model = InMap(rng.uniform(-80, 80), rng.uniform(0, 75), rng.normal(size=3) * [90.0, 8.0, 8.0])
        assert wrong_axes(model, (12000, 9000), (0.0, 600.0)) == ""  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(4))
def test_any_place_and_scan_of_any_size_is_told(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for size in ((20000, 15000), (2000, 3000), (300, 300)):
        look = Look(incidence=rng.uniform(0, 35), azimuth=rng.uniform(0, 360), scan=rng.uniform(0, 360))
        case = fly(np.array([rng.uniform(-89, 89), rng.uniform(-80, 80), 200.0]), look, size, 0.5), size, ALTS
        assert wrong_axes(*case) == ""
        assert EXCHANGED in wrong_axes(*changed(case, EXCHANGED))
        assert NEGATIVE in wrong_axes(*changed(case, NEGATIVE))


def test_models_that_no_rpc_follows_are_honest_all_the_same() -> None:
    for name, case in hard().items():
        assert wrong_axes(*case) == "", name
    shaken = Bent(own()["pushbroom (128.0, 70.0), scan 0"][0], waves(9000, 60.0, 2.0))
    assert wrong_axes(shaken, SIZE, ALTS) == ""  # type: ignore[arg-type]


def test_an_rpc_and_its_correction_are_not_asked() -> None:
    """Whatever made it: cubics of few terms may look like anything, as here an RPC of exchanged axes does."""
    size, alts = (12000, 9000), (0.0, 1000.0)
    wrong = fit_rpc(*changed(own()["pushbroom (48.0, 43.2), scan 190"], EXCHANGED), strict=False).rpc
    assert EXCHANGED in wrong_axes(wrong, size, alts)
    centre = ecef_from_ground([*wrong.ground_offset[:2], 7e5])
    for model in (wrong, adjusted(wrong, centre, 0)):
        assert fit_rpc(model, size, alts, options=FitOptions(method="ridge")).axes == ""
    mirrored = turned_over(synthetic_rpc())
    assert wrong_axes(mirrored, (20000, 19000), alts) == ""


def turned_over(rpc: Any) -> Any:
    """An RPC whose columns count the other way."""
    return type(rpc)(rpc.coeffs, rpc.ground_offset, rpc.ground_scale, rpc.image_offset, rpc.image_scale * [-1.0, 1.0])


def test_rows_beside_the_ground_are_left_out_and_without_any_nothing_is_said() -> None:
    model, size, alts = own()["pushbroom (48.0, 43.2), scan 190"]

    class Part:
        share = 0.3

        def localize(self, image: Array, alt: Array) -> Array:
            ground = model.localize(image, alt)[..., [1, 0, 2]]
            return np.where(image[..., 1:] < self.share * size[1], np.nan, ground)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert EXCHANGED in wrong_axes(Part(), size, alts)  # type: ignore[arg-type]
        Part.share = 1.1
        assert wrong_axes(Part(), size, alts) == ""  # type: ignore[arg-type]
