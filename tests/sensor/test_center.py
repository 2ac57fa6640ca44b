"""Camera centres of a camera that has one, and of models that fail over their image."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyproj
import pytest

from barpc.base.errors import RpcError
from barpc.cameras import open_camera
from barpc.sensor.centers import NOMINAL_ALTITUDE, PLAUSIBLE_ALTITUDE, camera_center
from barpc.simulate import Look, fly

TO_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
TO_GROUND = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
SIZE, ALTITUDES = (4000, 3000), (100.0, 900.0)


class Pinhole:
    """A perspective camera above 5.4 E, 43.2 N that looks aside; half a metre a pixel from 700 km."""

    def __init__(self, altitude: float = 7e5, columns: float = np.inf) -> None:
        self.center = np.array(TO_ECEF.transform(5.9, 43.4, altitude))
        target = np.array(TO_ECEF.transform(5.4, 43.2, 500.0))
        axis = target - self.center
        z = axis / np.linalg.norm(axis)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        self.frame = np.array([x, np.cross(z, x), z])
        self.focal = np.linalg.norm(axis) / 0.5
        self.columns = columns

    def localize(self, image: Any, alt: Any) -> Any:
        image, alt = np.asarray(image, dtype=float), np.asarray(alt, dtype=float)
        pixel = image - [(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2]
        ray = np.concatenate([pixel / self.focal, np.ones((*pixel.shape[:-1], 1))], axis=-1) @ self.frame
        distance = np.full(ray.shape[:-1], self.focal * 0.5)
        for _ in range(30):
            ground = np.stack(TO_GROUND.transform(*np.moveaxis(self.center + distance[..., None] * ray, -1, 0)), -1)
            distance = distance + (ground[..., 2] - alt) * 1.1
        ground[..., 2] = alt
        return np.where(image[..., :1] <= self.columns, ground, np.nan)


@pytest.mark.parametrize("altitude", [4e5, 7e5])
def test_the_centre_of_a_perspective_camera_is_found(altitude) -> None:
    camera: Any = Pinhole(altitude)
    found = camera_center(camera, SIZE, ALTITUDES)
    assert found.method == "line"
    assert np.linalg.norm(found.ecef - camera.center) < 1e-3 * altitude
    assert found.altitude == pytest.approx(altitude, rel=1e-3)


@pytest.mark.parametrize(("altitude", "method"), [
    (PLAUSIBLE_ALTITUDE[0] * 0.95, "nominal"), (PLAUSIBLE_ALTITUDE[0] * 1.05, "line"),
    (PLAUSIBLE_ALTITUDE[1] * 0.95, "line"), (PLAUSIBLE_ALTITUDE[1] * 1.05, "nominal"),
])  # fmt: skip
def test_a_centre_where_no_satellite_is_makes_way_for_a_nominal_one(altitude, method) -> None:
    camera: Any = Pinhole(altitude)
    found = camera_center(camera, SIZE, ALTITUDES)
    assert found.method == method
    expected = altitude if method == "line" else NOMINAL_ALTITUDE
    assert found.altitude == pytest.approx(expected, rel=1e-3)


def test_a_model_that_sees_no_ground_at_its_images_centre_has_no_centre() -> None:
    half: Any = Pinhole(columns=SIZE[0] / 2 + 1)
    assert camera_center(half, SIZE, ALTITUDES).method == "nominal"
    blind: Any = Pinhole(columns=SIZE[0] / 2 - 1)
    with pytest.raises(RpcError, match="no ground point at its image's centre"):
        camera_center(blind, SIZE, ALTITUDES)


def test_a_flat_altitude_range_still_gives_a_centre() -> None:
    camera: Any = Pinhole()
    found = camera_center(camera, SIZE, (300.0, 300.0))
    assert np.linalg.norm(found.ecef - camera.center) < 0.02 * 7e5


@pytest.mark.parametrize(
    ("name", "low", "high", "method"),
    [
        ("rpc_IKONOS.txt", 500, 700, "nominal"),  # flown at 681 km; the rows of this product meet at 293 km
        ("rpc_PLEIADES.xml", 690, 715, "line"),
        ("rpc_SPOT6.xml", 690, 715, "line"),
        ("qb-1.geom", 440, 465, "line"),
        ("wv3_20.NTF", 610, 635, "line"),
        ("rpc_PLANET_L1A.txt", 470, 540, "line"),
    ],
)
def test_centres_of_real_cameras_are_where_their_satellites_fly(shared_data, name, low, high, method) -> None:
    camera = open_camera(shared_data / "rpc_formats" / name)
    width, height = (2 * camera.rpc.image_scale).astype(int).tolist()
    found = camera_center(camera.rpc, (width, height), camera.alt_range)
    assert found.method == method
    assert low * 1e3 < found.altitude < high * 1e3


def test_the_line_method_finds_the_orbit_of_the_pleiades_crops(shared_data) -> None:
    for path in sorted((shared_data / "optical/phr_triplet_north").glob("*.tif")):
        camera = open_camera(path)
        line = camera_center(camera.rpc, camera.size, camera.alt_range)
        assert line.method == "line"
        assert line.altitude == pytest.approx(694e3, rel=0.05)


def test_a_projective_camera_of_a_perspective_one_stands_where_it_stands() -> None:
    camera: Any = Pinhole()
    found = camera_center(camera, SIZE, ALTITUDES, "projective")
    assert found.method == "projective"
    assert np.linalg.norm(found.ecef - camera.center) < 1e-3 * 7e5


def test_a_projective_camera_over_a_pushbroom_image_stands_at_about_twice_its_distance() -> None:
    """Perspective across the track, affine along it: what Pleiades shows, 1420 to 1630 km for 694."""
    sensor = fly(np.array([5.4, 43.2, 0.0]), Look(10.0, 100.0), (20000, 20000), 0.5)
    line, whole = (camera_center(sensor, (20000, 20000), (0.0, 2000.0), how) for how in ("line", "projective"))
    assert whole.altitude / line.altitude == pytest.approx(2.1, abs=0.3)
    blind: Any = Pinhole(columns=100.0)
    with pytest.raises(RpcError):
        camera_center(blind, SIZE, ALTITUDES, "projective")


def test_the_rays_that_meet_are_those_of_the_middle_row() -> None:
    """Of a camera that flies on while its rows are seen; from end to end of the row, at both ends of its heights."""
    fly, seen = np.array([0.0, 700.0, 0.0]), []

    class Flying(Pinhole):
        def localize(self, image: np.ndarray, alt: np.ndarray) -> np.ndarray:
            seen.append((image, alt))
            (row,) = np.unique(image[..., 1])
            there = Pinhole()
            there.center = there.center + row * fly
            return there.localize(image, alt)

    camera: Any = Flying()
    found = camera_center(camera, SIZE, ALTITUDES)
    middle = camera.center + (SIZE[1] - 1) / 2 * fly
    assert np.linalg.norm(found.ecef - middle) < 1e-3 * 7e5
    ((image, alt),) = seen
    half = len(image) // 2
    np.testing.assert_allclose(image[:half, 0], np.linspace(0.0, SIZE[0] - 1, half))
    np.testing.assert_array_equal(image[half:], image[:half])
    np.testing.assert_array_equal(image[:, 1], (SIZE[1] - 1) / 2)
    np.testing.assert_array_equal(alt, np.repeat(ALTITUDES, half))


def test_the_centre_of_a_matrix_is_the_same_whatever_the_unit_of_the_image() -> None:
    """Where cells are not seen exactly; in pixels a thousandth as large as in the image itself."""
    size = (301, 226)

    def moved(scale: float) -> Any:
        camera: Any = Pinhole()
        noise = np.random.default_rng(1)

        class Seen:
            def localize(self, image: Any, alt: Any) -> Any:
                ground = camera.localize(np.asarray(image) * scale, alt)
                return ground + noise.normal(0.0, 1e-7, ground.shape) * [1.0, 1.0, 0.0]

        return Seen()

    one = camera_center(moved(10.0), size, ALTITUDES, "projective").ecef
    other = camera_center(moved(0.01), tuple(1000 * (n - 1) + 1 for n in size), ALTITUDES, "projective").ecef
    np.testing.assert_allclose(one, other, rtol=1e-6)
    assert np.linalg.norm(one - Pinhole().center) < 0.2 * 7e5
