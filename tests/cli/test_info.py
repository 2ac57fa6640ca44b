"""What `barpc info` prints: figures computed a second time from points of the camera, and every sentence."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from barpc.base.errors import RpcError
from barpc.cameras import open_camera
from barpc.cli.info import _labelled_sentences
from barpc.rpcio import write_rpc
from barpc.sensor.rpc import RPC
from barpc.verbs.describe import described, outlines_geojson
from tests.cli.test_main import run
from tests.rpcio.conftest import make_rpc

SIZE = (2000, 1900)


def tilted(across: float = 0.0, along: float = 0.0) -> RPC:
    """A camera that looks from another side."""
    rpc = make_rpc()
    coeffs = np.array(rpc.coeffs)
    coeffs[[0, 2], 3] += across, along
    return replace(rpc, coeffs=coeffs)


@pytest.fixture
def pair(tmp_path: Path) -> list[str]:
    """Two RPC files with the size of their images."""
    write_rpc(tilted(), tmp_path / "left.RPB")
    write_rpc(tilted(0.15, -0.2), tmp_path / "right.RPB")
    return [f"{tmp_path / name}.RPB,size={SIZE[0]}:{SIZE[1]}" for name in ("left", "right")]


# --- by hand: WGS84, east, north and up, and the ray between two altitudes --------------------------------

A, E2 = 6378137.0, 6.69437999014e-3


def ecef(ground: Any) -> np.ndarray:
    lon, lat, alt = np.radians(ground[0]), np.radians(ground[1]), ground[2]
    n = A / math.sqrt(1 - E2 * math.sin(lat) ** 2)
    return np.array([
        (n + alt) * math.cos(lat) * math.cos(lon),
        (n + alt) * math.cos(lat) * math.sin(lon),
        (n * (1 - E2) + alt) * math.sin(lat),
    ])  # fmt: skip


def enu(ground: Any, vector: np.ndarray) -> np.ndarray:
    lon, lat = np.radians(ground[0]), np.radians(ground[1])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    return np.array([east @ vector, np.cross(up, east) @ vector, up @ vector])


def ray(rpc: RPC, ground: Any) -> np.ndarray:
    """The direction to the sensor, in east, north and up of a ground point."""
    pixel = rpc.project(ground)
    above = rpc.localize(pixel, ground[2] + 100.0)
    found = enu(ground, ecef(above) - ecef(ground))
    return found / np.linalg.norm(found)


def describe(spec: str, alt: float = 150.0, at: Any = None) -> dict[str, Any]:
    return described([spec], at, alt, None)[0]


@pytest.mark.parametrize("at", [None, (5.402, 43.199, 80.0)])
def test_angles_and_pixels_are_those_of_the_rays(at: Any, pair: list[str]) -> None:
    for spec in pair:
        rpc, report = open_camera(spec).rpc, describe(spec, 150.0, at)
        centre = rpc.localize([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2], 150.0)
        assert report["center_deg"] == pytest.approx(centre[:2].tolist(), abs=1e-9)
        assert report["center_alt_m"] == 150.0
        assert report["size_px"] == list(SIZE)
        up = ray(rpc, centre if at is None else at)
        assert report["incidence_deg"] == pytest.approx(math.degrees(math.acos(up[2])), abs=0.02)
        turn = report["azimuth_deg"] - math.degrees(math.atan2(up[0], up[1]))
        assert (turn + 180) % 360 - 180 == pytest.approx(0.0, abs=0.1)
        middle = rpc.project(centre)
        for axis, key in enumerate(("col", "row")):
            step = np.eye(2)[axis]
            ends = [ecef(rpc.localize(middle + sign * step, 150.0)) for sign in (-0.5, 0.5)]
            assert report["gsd_m"][key] == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=1e-3)


def test_the_outline_is_the_image_s_border_on_the_ground(pair: list[str]) -> None:
    rpc, report = open_camera(pair[0]).rpc, describe(pair[0], 90.0)
    ring = np.array(report["footprint"]["coordinates"][0])[:, :2]
    image = rpc.project(np.column_stack([ring, np.full(len(ring), 90.0)]))
    np.testing.assert_allclose(image.min(axis=0), -0.5, atol=0.02)
    np.testing.assert_allclose(image.max(axis=0), np.array(SIZE) - 0.5, atol=0.02)
    assert ring[0].tolist() == ring[-1].tolist()


def test_a_box_is_the_rpc_s_offset_and_scale_on_either_side(tmp_path: Path) -> None:
    write_rpc(make_rpc(), tmp_path / "a.RPB")
    report = describe(str(tmp_path / "a.RPB"))
    assert report["domain"]["lon_deg"] == pytest.approx([5.4 - 0.0062, 5.4 + 0.0062])
    assert report["domain"]["lat_deg"] == pytest.approx([43.2 - 0.0045, 43.2 + 0.0045])
    assert report["altitude_range_m"] == pytest.approx([166.6667 - 142.8571, 166.6667 + 142.8571])
    assert (report["err_bias_m"], report["err_rand_m"]) == (3.1, 0.7)
    assert 0.9 < report["smallest_denominator"] <= 1.0
    assert "size_px" not in report
    assert "problem" not in report
    assert report["first_pixel"] == "its centre is (0, 0)"


def test_the_angle_of_a_pair_is_that_between_the_rays(pair: list[str]) -> None:
    cameras = [open_camera(spec) for spec in pair]
    for at in (None, (5.402, 43.199, 80.0)):
        first, second = described(pair, at, 150.0, None)
        (found,) = first["pairs"]
        assert second["pairs"] == []
        place = cameras[0].rpc.localize((np.array(SIZE) - 1) / 2, 150.0) if at is None else at
        one, two = (ray(camera.rpc, place) for camera in cameras)
        angle = math.degrees(math.acos(one @ two))
        assert found["convergence_deg"] == pytest.approx(angle, abs=0.02)
        base = np.linalg.norm(one[:2] / one[2] - two[:2] / two[2])
        assert found["b_over_h"] == pytest.approx(base, rel=0.01)
        assert found["with"] == "right"
    three = described([*pair, pair[0]], None, 150.0, None)[0]["pairs"]
    assert [row["with"] for row in three] == ["right", "left"]
    assert three[1]["convergence_deg"] == pytest.approx(0.0, abs=1e-4)


# --- sentences --------------------------------------------------------------------------------------------

REPORT: dict[str, Any] = {
    "rpc": "rpb in a in b.RPB",
    "notes": ["one", "two"],
    "altitude_range_m": [-100.0, 1234.567],
    "size_px": [30, 20],
    "center_deg": [5.5, -43.25],
    "center_alt_m": 567.89,
    "gsd_m": {"col": 0.5, "row": 0.75},
    "incidence_deg": 12.345,
    "azimuth_deg": 98.765,
    "camera_altitude_m": {"value": 694321.0, "method": "stated"},
}
BOX: dict[str, Any] = {
    "domain": {"lon_deg": [5.0, 6.0], "lat_deg": [43.0, 44.0]},
    "err_bias_m": 3.0,
    "err_rand_m": None,
    "smallest_denominator": 0.5,
}


def told(**changes: Any) -> list[tuple[str, str]]:
    """What is said of the report, changed; `...` leaves a key out."""
    return list(_labelled_sentences({key: value for key, value in {**REPORT, **changes}.items() if value is not ...}))


def test_a_camera_that_is_no_rpc_says_where_it_is() -> None:
    assert told() == [
        ("camera", "rpb in a in b.RPB"),
        ("note", "one"),
        ("note", "two"),
        ("image", "30 x 20 px; (0, 0) is the centre of the first pixel"),
        ("altitudes", "-100 to 1234.6 m above the ellipsoid"),
        ("centre", "lon 5.500000, lat -43.250000 deg at 567.89 m"),
        ("pixel", "0.500 m a column, 0.750 m a row on the ground"),
        ("looks", "12.35 deg off the vertical, from 98.77 deg (north is 0)"),
        ("sensor", "694.3 km high, by its orbit"),
    ]
    for method, words in (
        ("line", "where the rays of an image line meet"),
        ("nominal", "assumed, as the rays of an image line meet in no orbit"),
    ):
        assert told(camera_altitude_m={"value": 7e5, "method": method})[-1] == ("sensor", f"700.0 km high, {words}")


def test_an_rpc_says_what_it_is_made_for() -> None:
    lines = dict(told(**BOX))
    assert " ".join(lines) == "camera note image altitudes made for accuracy denominators centre pixel looks sensor"
    assert lines["camera"] == "RPC (rpb) in a in b.RPB"
    assert lines["made for"] == "lon 5.00000 to 6.00000, lat 43.00000 to 44.00000 deg"
    assert lines["accuracy"] == "3 m common to the image"
    assert lines["denominators"] == "at least 0.5 of their value at the centre: no pole"
    for least in (0.0, -0.25):
        assert "a pole may lie" in dict(told(**{**BOX, "smallest_denominator": least}))["denominators"]
    accuracy = dict(told(**{**BOX, "err_bias_m": 0.0, "err_rand_m": 1.2345}))["accuracy"]
    assert accuracy == "0 m common to the image, 1.23 m of each point"
    assert dict(told(**{**BOX, "err_bias_m": None}))["accuracy"] == "not stated"


def test_what_cannot_be_told_is_left_out() -> None:
    lines = dict(told(size_px=..., center_deg=..., notes=[]))
    assert list(lines) == ["camera", "image", "altitudes"]
    assert "size unknown" in lines["image"]
    assert list(dict(told(problem="none there", notes=[]))) == ["camera", "image", "altitudes", "problem"]
    pairs = [{"with": "b", "convergence_deg": 12.345, "b_over_h": 0.2166}]
    assert dict(told(pairs=pairs))["pair"] == "with b: 12.35 deg between the rays, B/H 0.217"


class Blind:
    """A camera that sees nothing."""

    def localize(self, image: Any, alt: Any) -> np.ndarray:
        return np.full((*np.shape(image)[:-1], 3), np.nan)

    def project(self, ground: Any) -> np.ndarray:
        return np.full((*np.shape(ground)[:-1], 2), np.nan)


def test_a_camera_that_sees_no_ground_has_a_problem(pair: list[str]) -> None:
    camera = replace(open_camera(pair[0]), model=Blind())
    assert described([camera], None, 1.0, None)[0]["problem"] == "no ground point at the image's centre"
    with pytest.raises(RpcError, match=r"left.*: no ground point at its image's border at 7 m"):
        outlines_geojson([camera], 7.0, None)


# --- altitudes and outlines -------------------------------------------------------------------------------


def test_outlines_name_their_images(pair: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run("info", "--footprint", *pair, "--alt", "60") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["type"] == "FeatureCollection"
    features = document["features"]
    assert [one["properties"]["name"] for one in features] == ["left", "right"]
    assert [one["properties"]["path"] for one in features] == [spec.split(",")[0] for spec in pair]
    assert [one["properties"]["alt"] for one in features] == [60.0, 60.0]
    assert features[0]["geometry"] == describe(pair[0], 60.0)["footprint"]


def test_the_page_has_an_image_s_name_and_its_lines_behind(pair: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run("info", *pair, "--alt", "60") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if not line.startswith("  ")] == pair
    assert lines[1].startswith("  camera       RPC (rpb) in ")
    assert [line.split()[2] for line in lines if line.startswith("  pair")] == ["right:"]
    assert run("info", *pair, "--alt", "60", "--json") == 0
    reports = json.loads(capsys.readouterr().out)
    assert [len(report["pairs"]) for report in reports] == [1, 0]
    assert run("info", pair[0], "--alt", "60", "--json") == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert "pairs" not in report
    assert report["center_alt_m"] == 60.0
    at = (5.402, 43.199, 80.0)
    assert run("info", pair[0], "--alt", "60", "--at", *at, "--json") == 0
    (elsewhere,) = json.loads(capsys.readouterr().out)
    assert elsewhere["incidence_deg"] == describe(pair[0], 60.0, at)["incidence_deg"] != report["incidence_deg"]
    assert run("info") == 2
