"""Where tie points are wanted: polygons from a file, pairs and windows and tracks inside them."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from barpc.base.errors import DisconnectedError, InputError, TiePointError
from barpc.base.geodesy import ground_from_ecef
from barpc.scene import Tracks
from barpc.sensor.triangulation import triangulate
from barpc.tie import Scope, TieOptions, find_tracks, read_area
from barpc.tie.pairing.area import Area
from barpc.tie.pairing.overlaps import Footprints, shared_tiles
from barpc.tie.pixels import tiles
from tests.constants import chosen
from tests.tie.stages import select_pairs

from .conftest import Rendered, altered
from .test_pairs import METRE, camera
from .test_pairs import views as views_of


def written(path: Path, data: object) -> Path:
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def box(west: float, south: float, east: float, north: float) -> dict[str, object]:
    return {
        "type": "Polygon",
        "coordinates": [[[west, south], [east, south], [east, north], [west, north], [west, south]]],
    }


def wrapped(geometry: object) -> dict[str, object]:
    feature = {"type": "Feature", "properties": {}, "geometry": geometry}
    return {"type": "FeatureCollection", "features": [feature]}


PLACES = np.array([[5.0, 43.0], [365.0, 43.0], [5.2, 43.0], [np.nan, 43.0], [-5.0, 43.0]])


@pytest.mark.parametrize(
    "data",
    [
        box(4.9, 42.9, 5.1, 43.1),
        box(364.9, 42.9, 365.1, 43.1),
        wrapped(box(4.9, 42.9, 5.1, 43.1)),
        {"type": "GeometryCollection", "geometries": [box(4.9, 42.9, 5.0, 43.1), box(5.0, 42.9, 5.1, 43.1)]},
        {"type": "MultiPolygon", "coordinates": [box(4.9, 42.9, 5.1, 43.1)["coordinates"]]},
        {**box(4.9, 42.9, 5.1, 43.1), "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}},
    ],
    ids=["polygon", "0..360", "features", "collection", "multi", "crs"],
)  # fmt: skip
def test_any_geojson_of_polygons_is_an_area(tmp_path, data) -> None:
    assert read_area(written(tmp_path / "a.json", data)).contains(PLACES).tolist() == [True, True] + [False] * 3


def ring(points: np.ndarray) -> dict[str, object]:
    return {"type": "Polygon", "coordinates": [[*points.tolist(), points[0].tolist()]]}


def test_an_outline_that_crosses_itself_is_two_areas_and_may_have_altitudes(tmp_path) -> None:
    bow = ring(np.array([[0.0, 0.0, 7.0], [1.0, 1.0, 7.0], [1.0, 0.0, 7.0], [0.0, 1.0, 7.0]]))
    inside = np.array([[0.9, 0.5], [0.1, 0.5], [360.1, 0.5], [0.5, 0.9], [0.5, 0.1]])
    area = read_area(written(tmp_path / "a.json", bow))
    assert area.contains(inside).tolist() == [True, True, True, False, False]


def test_an_outline_is_untangled_of_as_many_crossings_as_allowed_and_no_more(tmp_path, sized) -> None:
    turns = 0.8 * np.pi * np.arange(5)
    star = written(tmp_path / "star.json", ring(np.column_stack([np.sin(turns), np.cos(turns)])))  # five crossings
    sized(sides_crossed=5)
    read_area(star)
    sized(sides_crossed=4)
    with pytest.raises(InputError, match="an outline crosses itself more than 4 times"):
        read_area(star)
    sized(sides_together=1)  # found from both sides of a side, whatever is looked at together
    with pytest.raises(InputError, match="more than 4 times"):
        read_area(star)
    sized(sides_crossed=0)
    read_area(written(tmp_path / "square.json", box(0.0, 0.0, 1.0, 1.0)))


@pytest.mark.slow
def test_a_tangle_is_refused_at_once(tmp_path) -> None:
    path = written(tmp_path / "tangle.json", ring(np.random.default_rng(0).uniform(0.0, 1.0, (5000, 2))))
    start = time.process_time()
    with pytest.raises(InputError, match="crosses itself more than 2000 times"):
        read_area(path)
    assert time.process_time() - start < 20.0  # CPU s; some tenths on a machine of its own, and else days


def test_a_hole_is_outside(tmp_path) -> None:
    outer, inner = box(4.0, 42.0, 6.0, 44.0), box(364.9, 42.9, 365.1, 43.1)
    data = {"type": "Polygon", "coordinates": [*outer["coordinates"], *inner["coordinates"]]}
    assert read_area(written(tmp_path / "a.json", data)).contains(PLACES).tolist()[:3] == [False, False, True]


@pytest.mark.parametrize(
    "data",
    [
        box(179.9, -1, -179.9, 1),
        box(179.9, -1, 180.1, 1),
        box(-180.1, -1, -179.9, 1),
        {
            "type": "MultiPolygon",
            "coordinates": [box(179.9, -1, 180, 1)["coordinates"], box(-180, -1, -179.9, 1)["coordinates"]],
        },
    ],
    ids=["jump", "beyond 180", "beyond -180", "cut"],
)  # fmt: skip
def test_an_area_may_cross_the_antimeridian(tmp_path, data) -> None:
    area = read_area(written(tmp_path / "a.json", data))
    places = np.array([[179.95, 0.0], [-179.95, 0.0], [180.0, 0.0], [-180.0, 0.5], [0.0, 0.0], [179.8, 0.0]])
    assert area.contains(places).tolist() == [True] * 4 + [False] * 2
    for origin in (180.0, -180.0, 179.99, 540.0):
        plane = area.plane(np.array([origin, 0.0]), np.array([100.0, 100.0]))
        near = shapely.intersection(plane, shapely.box(-100, -100, 100, 100))
        assert near.area == pytest.approx(0.2 * 100 * 200, rel=1e-6)
        assert near.geom_type == "Polygon"


def test_a_hole_may_lie_beyond_the_antimeridian(tmp_path) -> None:
    rings = [*box(179, -1, -179, 1)["coordinates"], *box(-179.6, -0.5, -179.4, 0.5)["coordinates"]]
    area = read_area(written(tmp_path / "a.json", {"type": "Polygon", "coordinates": rings}))
    places = np.array([[179.5, 0.0], [-179.7, 0.0], [-179.5, 0.0], [180.5, 0.0], [-179.5, 0.7]])
    assert area.contains(places).tolist() == [True, True, False, False, True]


def test_the_whole_world_is_an_area(tmp_path) -> None:
    area = read_area(written(tmp_path / "a.json", box(-180, -90, 180, 90)))
    assert area.contains(np.array([[0.0, 0.0], [179.0, 89.0], [-179.0, -89.0]])).all()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("{", "not a GeoJSON file"),
        ("[]", "not an area of interest"),
        ("{}", "not an area of interest"),
        ({"type": "Point", "coordinates": [5, 43]}, "a Point is no polygon"),
        ({"type": "Feature", "geometry": None}, "not an area of interest"),
        ({"type": "Polygon", "coordinates": [[[5, 43], [6, 44]]]}, "not an area of interest"),
        ({"type": "Polygon", "coordinates": [[["a", 43], [6, 44], [5, 44], [5, 43]]]}, "not an area of interest"),
        ({"type": "Polygon", "coordinates": [[[1], [2], [3], [1]]]}, "not an area of interest"),
        ({"type": "Polygon", "coordinates": []}, "not an area of interest"),
        (box(500000, 4800000, 501000, 4801000), "not a longitude and a latitude"),
        (box(5, 89, 6, 90.5), "not a longitude and a latitude"),
        (box(539, 43, 540.5, 44), "not a longitude and a latitude"),
        ('{"type": "Polygon", "coordinates": [[[5, NaN], [6, 44], [5, 44], [5, 43]]]}', "NaN is no finite number"),
        (box(5, 43, 5, 44), "of any extent"),
        (wrapped({"type": "MultiPolygon", "coordinates": []}), "of any extent"),
        ({**box(1, 2, 3, 4), "crs": {"properties": {"name": "EPSG:32631"}}}, "EPSG:32631"),
        ('{"type": "FeatureCollection", "features":' * 5000, "nested too deep"),
        ('{"type": "GeometryCollection", "geometries":[' * 900 + "]}" * 900, "nested too deep"),
        ('{"type": "GeometryCollection", "geometries":[' * 50 + "]}" * 50, "of any extent"),
    ],
)  # fmt: skip
def test_what_is_no_area_is_refused_in_one_line(tmp_path, data, message) -> None:
    path = written(tmp_path / "a.json", data)
    with pytest.raises(InputError, match=message) as caught:
        read_area(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


NUMBERS = st.one_of(
    st.integers(-(10**400), 10**400), st.floats(), st.integers(-180, 180), st.none(), st.text(max_size=2)
)
POSITIONS = st.one_of(st.lists(NUMBERS, max_size=4), st.lists(st.floats(-90, 90), min_size=2, max_size=2))
JSON = st.recursive(
    st.one_of(NUMBERS, POSITIONS, st.lists(st.lists(POSITIONS, max_size=6), max_size=3)),
    lambda inner: st.fixed_dictionaries(
        {"type": st.sampled_from(["Polygon", "MultiPolygon", "Feature", "FeatureCollection", "GeometryCollection"])},
        optional={
            "coordinates": inner,
            "geometry": inner,
            "features": st.one_of(inner, st.lists(inner, max_size=3)),
            "geometries": st.lists(inner, max_size=3),
            "crs": inner,
        },
    ),
    max_leaves=8,
)


@pytest.mark.slow
@pytest.mark.parametrize("examples", [30, pytest.param(300, marks=pytest.mark.nightly)])
def test_any_json_is_an_area_or_one_line(tmp_path, examples) -> None:
    path = tmp_path / "any.json"

    @settings(max_examples=examples, deadline=None, suppress_health_check=list(HealthCheck))
    @given(JSON)
    def area_or_one_line(data: object) -> None:
        try:
            area, said = read_area(written(path, data)), ""
        except InputError as error:
            area, said = None, str(error)
        assert said == "" or (said.startswith(str(path)) and "\n" not in said and len(said) < 1000)
        assert area is None or (area.outline.is_valid and area.contains(PLACES).shape == (5,))

    area_or_one_line()


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match=r"gone\.json: no such file"):
        read_area(tmp_path / "gone.json")
    (tmp_path / "b.json").write_bytes(b"\x80\x81\xc0")
    with pytest.raises(InputError, match="not a UTF-8 text"):
        read_area(tmp_path / "b.json")


@pytest.mark.parametrize("lon", [0.0, 180.0, -180.0, 359.9999])
def test_only_windows_in_the_area_are_read(tmp_path, lon) -> None:
    two = views_of(camera(lon, lean=0.0), camera(lon, lean=0.0))  # 500 m a side
    side = METRE * np.array([-240, -240, -140, 240])  # the western quarter, not up to its border
    west, south, east, north = side + [lon, 0.0, lon, 0.0]
    area = read_area(written(tmp_path / "a.json", box(west, south, east, north)))
    with chosen(TieOptions, search=10, tile=250, cell=50) as options:
        (pair,) = select_pairs(two, options, Scope(area=area))
        boxes, shared = (
            tiles((1000, 1000), options.tile),
            shared_tiles(two, [pair], [tiles((1000, 1000), options.tile)] * 2, options.search, area),
        )
    assert pair.overlap == pytest.approx(1.0)
    for kept in shared:
        assert [box in kept for box in boxes] == [True, False, False, False] * 4


def test_outlines_and_the_area_grow_by_as_much_as_the_cameras_may_be_wrong(tmp_path) -> None:
    two = views_of(camera(0.0, lean=0.0), camera(0.0, lean=0.0))  # half a metre a pixel
    west, south, east, north = METRE * np.array([-400, -100, 50, 100])
    area = read_area(written(tmp_path / "a.json", box(west, south, east, north)))
    plain = Footprints(two, 100.0)
    for reach, metres in ((0.0, 0.0), (40.0, 20.0)):
        grown = Footprints(two, 100.0, [reach] * 2)
        inside = Footprints(two, 100.0, [reach] * 2, area)
        for outline, grew, part in zip(plain.outlines, grown.outlines, inside.outlines, strict=True):
            edge = np.array(outline.bounds) + metres * np.array([-1, -1, 1, 1])
            np.testing.assert_allclose(grew.bounds, edge, atol=0.1)
            corner = plain.plane(np.array([east, north]))
            width, height = edge[2] - edge[0], 200.0 + 2 * metres
            np.testing.assert_allclose(part.bounds[0], edge[0], atol=0.1)
            np.testing.assert_allclose(part.bounds[2:], corner + metres, rtol=0.01)
            assert part.bounds[3] - part.bounds[1] == pytest.approx(height, rel=0.01)
            assert part.bounds[2] - part.bounds[0] == pytest.approx(0.6 * (width - 2 * metres) + 2 * metres, rel=0.03)


def test_outlines_of_an_oblong_image_grow_by_whole_pixels_too() -> None:
    (square,) = views_of(camera(0.0, lean=0.0))
    oblong = replace(square, size=(1000, 250))
    plain, grown = (Footprints([oblong], 100.0, [reach]).outlines[0] for reach in (0.0, 40.0))
    np.testing.assert_allclose(np.subtract(grown.bounds, plain.bounds), [-20, -20, 20, 20], atol=0.1)


def test_views_that_do_not_see_the_area_are_named(tmp_path) -> None:
    three = views_of(camera(0.0), camera(100 * METRE), camera(400 * METRE))
    area = read_area(written(tmp_path / "a.json", box(-200 * METRE, -0.001, -100 * METRE, 0.001)))
    assert len(select_pairs(three, TieOptions())) == 3
    with pytest.raises(DisconnectedError, match=r"v0, v1; v2.*inside the area of interest"):
        select_pairs(three, TieOptions(search=10), Scope(area=area))


def corner(scene, share: float) -> dict[str, object]:
    """A box over the south-western part of the first view's footprint, `share` of a side."""
    view = scene.views[0]
    image = np.array([[0.0, view.size[1]], [share * view.size[0], (1 - share) * view.size[1]]])
    (west, south, _), (east, north, _) = view.sensor.localize(image, np.full(2, np.mean(view.alt_range)))
    return box(*sorted((west, east))[:1], min(south, north), max(west, east), max(south, north))


def all_inside(scene: Rendered, tracks: Tracks, everywhere: Tracks, area: Area) -> None:
    """Tracks are those of a scene that lie in an area."""
    sensors = [view.sensor for view in scene.views]
    ground, whole = (ground_from_ecef(triangulate(sensors, t.view, t.point, t.xy).points) for t in (tracks, everywhere))
    assert area.contains(ground[:, :2]).all()
    expected = area.contains(whole[:, :2]).sum()
    assert expected > 50
    assert tracks.num_points >= 0.9 * expected


@pytest.mark.slow  # before a commit: tests/pipeline/test_pairs_and_area.py
def test_all_tie_points_lie_in_the_area_and_other_tiles_are_not_even_read(render, tmp_path) -> None:
    scene = render(views=2, size=(450, 450))
    blocks = {"tiled": True, "blockxsize": 64, "blockysize": 64}  # strips are read whole
    views = [altered(view, tmp_path, lambda d: d, **blocks) for view in scene.views]
    area = read_area(written(tmp_path / "a.json", corner(scene, 0.4)))
    options, told = TieOptions(tile=150, search=30), []
    result, everywhere = (
        find_tracks(views, options, scope, progress=lambda *step: told.append(step))
        for scope in (Scope(area=area), Scope())
    )
    limited, every = (total for stage, done, total in told if stage == "detect" and done == total)
    assert 0 < limited < 0.7 * every
    all_inside(scene, result.tracks, everywhere.tracks, area)


@pytest.mark.slow
def test_an_area_without_tie_points_is_said(scene, tmp_path) -> None:
    area = read_area(written(tmp_path / "a.json", corner(scene, 0.004)))
    with pytest.raises(TiePointError, match=r"none of [0-9]+ tie points lies in the area of interest"):
        find_tracks(scene.views, scope=Scope(area=area))
