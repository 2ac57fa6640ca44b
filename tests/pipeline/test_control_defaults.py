"""Altitudes of control that nobody measured, in feet, or above sea level are told from right ones."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import barpc
from barpc.base.errors import InputError, ReservationError
from barpc.pipeline.run import AdjustResult
from barpc.pointio.gcps import read_gcps
from barpc.pointio.matches import write_matches
from barpc.scene import View
from tests.geotiffs import write_blank
from tests.pipeline.known import FOLDER
from tests.pipeline.known import SAMPLES as VIEWS

POINTS = read_gcps(FOLDER / "gcps.geojson", [view.stem for view in VIEWS])
GEOID = 48.98


def written(path: Path, altitude: Callable[[float], float], column: str = "alt", moved: float = 0.0) -> Path:
    lines = [f"id,lon,lat,{column},image,col,row"]
    for point, view, (col, row) in zip(POINTS.point, POINTS.view, POINTS.xy + (moved, 0.0), strict=True):
        lon, lat, alt = POINTS.lonlatalt[point].tolist()
        lines.append(f"{POINTS.names[point]},{lon!r},{lat!r},{altitude(alt)!r},view_0{view},{col:.4f},{row:.4f}")
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> list[View]:
    """The images with cameras that have no pointing error, and state no accuracy."""
    folder = tmp_path_factory.mktemp("right")
    found = barpc.adjust(VIEWS, folder / "run", gcp=str(written(folder / "g.csv", float)), points_per_image=600)
    return [replace(view, sensor=replace(view.sensor, err_bias=None, err_rand=None)) for view in found.views]


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., AdjustResult]:
    """The images adjusted with control; they are matched once."""
    ties = tmp_path_factory.mktemp("ties") / "ties.npz"
    write_matches(ties, barpc.check(VIEWS, points_per_image=400).tracks, [view.stem for view in VIEWS])

    def run(views: list[View] | list[Path], gcp: Path, folder: Path, **options: object) -> AdjustResult:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return barpc.adjust(views, folder / "run", gcp=str(gcp), matches=ties, matches_only=True, **options)

    return run


@pytest.mark.few(1)
@pytest.mark.parametrize("level", [1.0, 200.0, -3.5])
def test_altitudes_that_are_all_the_same_are_a_default(level: float, adjusted, tmp_path: Path) -> None:
    with pytest.raises(ReservationError) as caught:  # which has the result
        adjusted(VIEWS, written(tmp_path / "g.csv", lambda _: level), tmp_path, check=True)
    found = caught.value.result
    assert isinstance(found, AdjustResult)
    said = " ".join([found.record.headline, *found.record.reasons])
    assert str(caught.value) == said.replace("--dem", "dem")  # keywords
    assert found.record.status == "look"
    assert any("5 of 5 points have no altitude, or a default" in reason for reason in found.record.reasons)
    assert found.adjustment.gauge.sigma[2] > 30.0
    assert found.adjustment.gauge.sigma[:2].max() < 1.0
    given = read_gcps(tmp_path / "g.csv", [view.stem for view in VIEWS])
    assert "--heights flat" in given.said[0]


def test_altitudes_that_a_person_says_are_flat_are_used(adjusted, tmp_path: Path) -> None:
    found = adjusted(VIEWS, written(tmp_path / "g.csv", lambda _: 222.0), tmp_path, heights="flat")
    assert found.adjustment.gauge.sigma[2] < 3.0
    two = "\n".join((tmp_path / "g.csv").read_text().splitlines()[:3]) + "\n"
    (tmp_path / "two.csv").write_text(two)
    assert (read_gcps(tmp_path / "two.csv", [view.stem for view in VIEWS]).lonlatalt[:, 2] == 222.0).all()


@pytest.mark.parametrize(("times", "unit"), [(1 / 0.3048, "in feet"), (0.3048, "in metres and not feet")])
def test_altitudes_in_another_unit_are_refused(times: float, unit: str, adjusted, tmp_path: Path) -> None:
    gcp = written(tmp_path / "g.csv", lambda alt: alt * times)
    with pytest.raises(InputError, match=rf"altitudes scatter by [\d.]+ m .* by 0\.\d m if they are {unit}"):
        adjusted(VIEWS, gcp, tmp_path)
    if times > 1.0:
        named = written(tmp_path / "named.csv", lambda alt: alt * times, "alt_ft")
        assert adjusted(VIEWS, named, tmp_path).record.status == "good"


def test_a_point_outside_its_image_is_refused(adjusted, tmp_path: Path) -> None:
    gcp = written(tmp_path / "g.csv", float, moved=100.0)
    with pytest.raises(InputError, match="point gcp_004: outside its image, and inside it by the camera"):
        adjusted(VIEWS, gcp, tmp_path)
    kept = adjusted(VIEWS, gcp, tmp_path, keep_going=True)
    assert any("outside its image" in reason for reason in kept.record.reasons)


@pytest.mark.costs(3)
@pytest.mark.few(1)
@pytest.mark.parametrize("column", ["alt", "height_ellipsoidal"])
def test_control_that_moves_right_cameras_by_the_geoid_is_named(
    column: str, right: list[View], adjusted, tmp_path: Path
) -> None:
    """Whatever its column is called: 49 m are within the accuracy that nobody stated."""
    above_sea = adjusted(right, written(tmp_path / "g.csv", lambda alt: alt - GEOID, column), tmp_path)
    assert above_sea.record.status == "look"
    (why,) = [reason for reason in above_sea.record.reasons if "above sea level" in reason]
    assert ("Give --heights egm96" in why) == (column == "alt")
    well = adjusted(right, written(tmp_path / "w.csv", float, column), tmp_path, overwrite=True)
    assert well.record.status == "good"
    higher = adjusted(right, written(tmp_path / "h.csv", lambda alt: alt + 20.0, column), tmp_path, overwrite=True)
    assert not any("above sea level" in reason for reason in higher.record.reasons)


def test_pointing_errors_are_no_geoid(adjusted, tmp_path: Path) -> None:
    """The delivered cameras put the scene 89 m too low, and 7 m aside."""
    assert adjusted(VIEWS, written(tmp_path / "g.csv", float), tmp_path, check=True).record.status == "good"


def test_height_default_is_the_altitude_where_none_is_given(shared_data: Path, tmp_path: Path) -> None:
    write_blank(tmp_path / "a.tif", (1000, 1000))
    (tmp_path / "a.tif.aux.xml").write_bytes((shared_data / "field_cases/height_default.tif.aux.xml").read_bytes())
    assert barpc.localize(tmp_path / "a.tif", [500, 500])[2] == 123.5
    barpc.convert(tmp_path / "a.tif", tmp_path / "b.vrt")
    assert barpc.localize(tmp_path / "b.vrt", [500, 500])[2] == 123.5
    assert barpc.localize(tmp_path / "a.tif", [500, 500], 10.0)[2] == 10.0
