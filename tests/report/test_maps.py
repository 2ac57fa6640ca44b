"""Maps: every outline, line, dot, ellipse and arrow stands where the ground or the image has it."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import replace
from itertools import chain
from types import SimpleNamespace

import numpy as np
import pytest

from barpc.report import maps
from barpc.report.maps import Plane, ground_map, residual_cells, residual_panels
from barpc.report.summary.block import ExplanationEntry
from barpc.report.summary.ground_points import CheckPointEntry

from .made import Drawing, a_gcp, a_pair, a_square, a_summary, a_view, corners, files_of, section, seen

jinja2 = pytest.importorskip("jinja2")

LON, LAT = 111319.491, 110574.276  # m of a degree at the equator, WGS84


NAMES = list("ABCDEFGH")


def drawn_graticule(plane: Plane) -> Drawing:
    lines, words, bar, _ = maps._graticule(plane)
    drawings = maps.template("drawings.svg.j2").module
    return Drawing(f"<svg>{drawings.graticule(lines)}{drawings.degrees(words, bar)}</svg>")


def drawn_names(places, taken=()) -> Drawing:
    return Drawing(f"<svg>{maps.template('drawings.svg.j2').module.names(maps.map_labels(places, taken))}</svg>")


def sheet(lonlat):
    """Where places (n, 2) stand on the sheet that they fill, near the equator, and how tall it is."""
    low, high = lonlat.min(axis=0), lonlat.max(axis=0)
    extent = (high - low) * [LON, LAT]
    scale = min(352 / extent[0], 420 / extent[1])
    tall = extent[1] * scale + 92
    return (lambda at: [210, tall / 2] + (at - (low + high) / 2) * np.multiply([LON, -LAT], scale)), tall


def caption(files) -> str:
    return section(files, "map").charts[0][1]


def alone(*places) -> Drawing:
    """The map of some places that two images show."""
    return Drawing(ground_map(files_of(a_summary([]), points=[(*place, 0.0, 0.0) for place in places])))


def plane(height: float = 300.0, unit: float = 100.0) -> Plane:
    return Plane(10.0, 0.0, np.array([unit, 2 * unit]), height, unit / LON)


def test_a_template_is_compiled_once_and_anew_by_another_version(tmp_path, monkeypatch):
    """As a module is: kept in a folder that can be written, and where none can be it works all the same."""
    compiled, compile_it = [], jinja2.Environment.compile

    def watched(self, source, name=None, filename=None, **further):
        compiled.append(name)
        return compile_it(self, source, name, filename, **further)

    monkeypatch.setattr(jinja2.Environment, "compile", watched)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    (tmp_path / "file").touch()
    for folder, versions, times in (("kept", "112", 2), ("file", "111", 3)):
        compiled.clear()
        monkeypatch.setattr(sys, "pycache_prefix", str(tmp_path / folder))
        for version in versions:
            monkeypatch.setattr(jinja2, "__version__", version)
            text = maps.template.__wrapped__("drawings.svg.j2").module.names(
                [(SimpleNamespace(advice=""), "A", 1.0, 2.0)]
            )
            assert ">A<" in text
        assert compiled == ["drawings.svg.j2"] * times


# --- the plane --------------------------------------------------------------------------------------------


def test_a_place_stands_east_to_the_right_and_north_up():
    found = plane()(np.array([[10.0, 0.0], [11.0, 0.5], [9.5, -0.25], [370.5, 0.0]]))
    assert found.tolist() == [[210, 150], [310, 50], [160, 200], [260, 150]]


def test_the_map_of_a_wide_scene_fills_the_sheet_from_side_to_side():
    drawn = alone((10.0, -0.1), (10.4, 0.1), (370.2, 0.0))
    tall = 0.2 * 352 / 0.4 * LAT / LON
    assert drawn.box == (420, pytest.approx(tall + 92, abs=0.006))
    expected = [(34, 46 + tall), (386, 46), (210, 46 + tall / 2)]
    assert np.array(drawn.points("point")[0]) == pytest.approx(np.array(expected), abs=0.06)
    ((x, _, length, _),) = drawn.rects("scalebar")
    assert (x + length, length) == pytest.approx((416, 352 / (0.4 * LON) * 10_000), abs=0.011)


def test_the_map_of_a_tall_scene_is_420_units_tall_and_of_one_place_a_metre_wide():
    tall = alone((10.0, -1.0), (10.4, 1.0))
    assert tall.box == (420, pytest.approx(420 + 92, abs=0.006))
    (low, high) = tall.points("point")[0]
    assert (low[1] - high[1], high[0] - low[0]) == pytest.approx((420, 0.4 * 210 * LON / LAT), abs=0.11)
    one = alone((10.0, 1.0))
    assert one.box == (420, 352 + 92)
    assert one.rects("scalebar")[0][2] == pytest.approx(352 / 5, abs=0.011)  # of 20 cm


def test_a_scene_across_the_antimeridian_is_not_round_the_earth():
    drawn = alone((179.9, 0.0), (-179.9, 0.1))
    (west, east) = drawn.points("point")[0]
    assert (west[0], east[0]) == pytest.approx((34, 386), abs=0.06)
    assert "180° W" in [text for text, *_ in drawn.texts("degrees")]


def test_the_graticule_says_round_degrees_and_the_scale_bar_a_round_length():
    drawn = drawn_graticule(plane(unit=120.0))  # 420 units are 3.5 degrees, 390 km
    assert drawn.lines("grid") == [
        (90, 4, 90, 276), (210, 4, 210, 276), (330, 4, 330, 276), (4, 150, 416, 150), (4, 30, 416, 30),
    ]  # fmt: skip
    assert drawn.texts("degrees") == [
        ("9° E", 90, 272, "middle"), ("10° E", 210, 272, "middle"), ("11° E", 330, 272, "middle"),
        ("0°", 4, 147, "start"), ("0.5° N", 4, 27, "start"),
    ]  # fmt: skip
    length = 100000 * 120 / LON
    assert drawn.rects("scalebar") == [pytest.approx((416 - length, 285, length, 4), abs=0.011)]
    assert drawn.texts("tick") == [
        ("100 km", pytest.approx(416 - length - 6, abs=0.006), 291, "end"),
        ("north is up", 4, 291, "start"),
    ]


@pytest.mark.parametrize(
    ("metres", "words"),
    [(900.0, "500 m"), (990.0, "500 m"), (1090.0, "1 km"), (4e3, "4 km"), (2.5, "2 m"), (7e5, "500 km")],
)
def test_a_short_scale_bar_is_in_metres(metres, words):
    """`metres`: in 110 units."""
    wide = Plane(0.0, 0.0, np.array([110 / metres * LON] * 2), 300.0, 110.0 / metres)
    assert words in [text for text, *_ in drawn_graticule(wide).texts("tick")]


def test_no_number_of_the_graticule_stands_at_the_sheet_s_edge():
    for lon, lat in ((10.0, 0.0), (10.3, 0.13), (179.9, -33.3), *((k / 7.0, k / 9.0) for k in range(14))):
        found = Plane(lon, lat, np.array([77.0, 91.0]), 300.0, 77.0 / LON)
        drawn = drawn_graticule(found)
        across = [line for line in drawn.lines("grid") if line[0] == line[2]]
        down = [line for line in drawn.lines("grid") if line[1] == line[3]]
        assert all(50 < x < 376 for x, *_ in across)
        assert all(16 < y < 256 for _, y, *_ in down)
        step = np.diff([x for x, *_ in across])
        assert len(across) >= 2
        assert across[0][0] - step[0] < 51
        assert across[-1][0] + step[0] > 375
        assert len(down) >= 1


@pytest.mark.parametrize(
    ("axis", "at", "shown"),
    [(0, 50.5, True), (0, 49.5, False), (0, 375.5, True), (0, 376.5, False), (0, 410.0, False),
     (1, 16.5, True), (1, 15.5, False), (1, 255.5, True), (1, 256.5, False), (1, 270.0, False)],
)  # fmt: skip
def test_a_meridian_or_parallel_has_room_for_its_number(axis, at, shown):
    place = (10.25, (at - 150) / 200) if axis else (10.0 - (at - 210) / 200, 0.25)
    lines = drawn_graticule(Plane(*place, np.array([200.0, 200.0]), 300.0, 1e-3)).lines("grid")
    found = [line for line in lines if line[axis] == pytest.approx(at, abs=0.006) and line[axis] == line[axis + 2]]
    assert bool(found) == shown


@pytest.mark.parametrize(("lon", "words"), [(180.0, "180° W"), (181.0, "179° W"), (179.0, "179° E"), (-1.0, "1° W")])
def test_degrees_are_east_or_west_of_greenwich(lon, words):
    found = Plane(lon, 0.0, np.array([130.0, 130.0]), 300.0, 1e-3)
    assert words in [text for text, *_ in drawn_graticule(found).texts("degrees")]


# --- images on the ground ---------------------------------------------------------------------------------


# two images over each other, and one a tenth of a degree to the east
VIEWS = [a_view("A", num_observations=5), a_view("B", status="weak"), a_view("C", status="failed")]
OUTLINES = [a_square(10.0, 0.0), a_square(10.001, 0.001), a_square(10.1, 0.0)]
PAIRS = [a_pair("A", "B", 900), a_pair("A", "C", 30), a_pair("B", "C", 70)]


def test_the_ground_map_has_outlines_dots_lines_and_points():
    known = CheckPointEntry("Q", 10.05, -0.01, 0.0, (None, None, None), ())
    summary = a_summary(VIEWS, PAIRS, gcps=(a_gcp("P", 10.05, 0.005),), check_points=(known,))
    points = [(10.0, 0.0, 5.0, 0.1), (10.1, 0.005, 5.0, 0.1)]
    drawn = Drawing(ground_map(files_of(summary, OUTLINES, points)))
    at, tall = sheet(np.concatenate([*[*chain(*OUTLINES)], np.array(points)[:, :2]]))
    assert drawn.box == (420, pytest.approx(tall, abs=0.006))
    for status, outline in zip(("adjusted", "weak", "failed"), OUTLINES, strict=True):
        (found,) = drawn.points(f"outline {status}")
        assert np.array(found) == pytest.approx(at(outline[0][:-1]), abs=0.006)
    assert [e.get("data-v") for e in drawn.all("g") if e.get("data-v")] == ["0", "1", "2"]
    assert drawn.titles("outline adjusted") == ["A: 5 tie points used"]
    (dots,) = drawn.all("path", "point")
    assert np.array(corners(dots.get("d"))) == pytest.approx(at(np.array(points)[:, :2]), abs=0.06)
    assert drawn.titles("tie") == [
        f"{pair} tie points used" for pair in ("A - C: 30", "B - C: 70", "A - B: 900")
    ]  # strongest on top
    middle = [at(outline[0][:-1]).mean(axis=0) for outline in OUTLINES]
    assert drawn.lines("tie")[0] == pytest.approx(np.concatenate([middle[0], middle[2]]), abs=0.006)
    (*_, widest) = drawn.of("line", "tie", "stroke-width", "stroke-opacity")
    assert widest == (3.0, 0.9)
    weakest, *_ = drawn.of("line", "tie", "stroke-width", "stroke-opacity")
    assert weakest == pytest.approx((0.6 + 2.4 * math.sqrt(30 / 900), 0.2 + 0.7 * math.sqrt(30 / 900)), abs=0.006)
    assert drawn.texts("name") == [  # B has its middle in the same place as A; a line lower there is no GCP
        (name, pytest.approx(x, abs=0.006), pytest.approx(y + 4, abs=0.006), "middle")
        for name, (x, y) in (("A and 1 more", middle[0] + [0.0, 15.4]), ("C", middle[2]))
    ]
    x, y = at(np.array([10.05, 0.005]))
    assert np.array(drawn.points("gcps")[0]) == pytest.approx(
        np.array([(x, y - 6), (x + 5, y + 4), (x - 5, y + 4)]), abs=0.006
    )
    x, y = at(np.array([10.05, -0.01]))
    assert np.array(drawn.points("check_points")[0]) == pytest.approx(
        np.array([(x, y + 6), (x + 5, y - 4), (x - 5, y - 4)]), abs=0.006
    )
    assert (drawn.titles("gcps"), drawn.titles("check_points")) == (["P"], ["Q"])
    assert drawn.described == "3 images, 3 pairs, 1 GCP, 1 check point."


def test_rows_with_few_tie_points_are_shaded_in_their_image_and_on_the_ground():
    """Across the antimeridian, too; images without any have none, and a page says so only where there are some."""
    pixels = [(-0.5, 199.5), (999.5, 199.5), (999.5, 299.5), (-0.5, 299.5)]
    for lon in (10.0, 180.0):
        ground = [(lon - 0.01, 0.005), (lon + 0.01, 0.005), (lon + 0.01, 0.0025), (lon - 0.01, 0.0025)]
        band = tuple((*place, *pixel) for place, pixel in zip(ground, pixels, strict=True))
        views, outlines = [a_view("A"), a_view("B", gap=band, status="doubtful")], [a_square(lon, 0.0)] * 2
        files = files_of(a_summary(views), outlines)
        drawn = Drawing(ground_map(files))
        (shaded,) = drawn.points("gap")
        at, _ = sheet(np.concatenate([*chain(*outlines)]))
        assert np.array(shaded) == pytest.approx(at(np.array(ground)), abs=0.006)
        assert drawn.titles("gap") == ["B: few tie points here"]
        (first, _), (second, _) = residual_panels(views, files.observations, "after")[0]
        assert Drawing(first).points("gap") == []
        assert "few tie points" not in Drawing(first).described
        assert Drawing(second).points("gap") == [[(0, 60), (300, 60), (300, 90), (0, 90)]]  # 800 rows on 240 units
        assert Drawing(second).described.endswith("; shaded: few tie points.")
        assert caption(files).endswith("; shaded: rows or columns with few tie points.")
        plain = files_of(a_summary(views[:1]), outlines[:1])
        assert caption(plain) == "Footprints at the altitude of the scene."


def test_the_caption_names_what_is_on_the_map_and_nothing_else():
    moving = ExplanationEntry("moving_objects", "a cloud", None, 50.0, 40.0, box=(9.996, -0.004, 10.004, -0.001))
    rows = ExplanationEntry("step", "rows lie off", "A", 9.0, 9.0)
    point = a_gcp("P", 10.0, 0.0)
    check = SimpleNamespace(**{**vars(a_gcp("Q", 10.0, 0.0)), "observations": ()})
    words = {
        "dots": "tie points",
        "triangles": "GCPs",
        "inverted triangles": "check points",
        "thicker lines": "more matches",
        "dashed": "tie points that move",
    }
    for known in (set(), {"dots"}, {"triangles"}, {"inverted triangles"}, {"thicker lines"}, {"dashed"}, set(words)):
        found = (moving, rows) if "dashed" in known else (rows,)
        summary = a_summary(
            VIEWS,
            PAIRS if "thicker lines" in known else PAIRS[:1],
            gcps=(point,) * ("triangles" in known),
            check_points=(check,) * ("inverted triangles" in known),
            scene=SimpleNamespace(explanations=found, left=(), held_out_places=()),
        )
        files = files_of(summary, OUTLINES, [(10.0, 0.0, 0.0, 0.0)] * ("dots" in known))
        _, *told = caption(files).rstrip(".").split("; ")
        told = [one for one in told if one != "those that need review on top"]
        assert told == [f"{key}: {word}" for key, word in words.items() if key in known]
        drawn = Drawing(ground_map(files))
        for key, kind in (("triangles", "gcps"), ("inverted triangles", "check_points"), ("dashed", "group")):
            assert bool(drawn.titles(kind)) == (key in known)


@pytest.mark.parametrize("status", ["used", "not seen", "contradicts", "rejected", "undecided"])
def test_a_gcp_that_contradicts_others_is_red_and_the_caption_says_so(status):
    summary = a_summary(VIEWS, gcps=(a_gcp("P", 10.0, 0.0, status=status), a_gcp("Q", 10.001, 0.0)))
    drawn, wrong = Drawing(ground_map(files_of(summary, OUTLINES))), status not in ("used", "not seen")
    classes = [mark.get("class") for mark in drawn.all("path") if "gcps" in (mark.get("class") or "").split()]
    assert classes == ["gcps doubted" if wrong else "gcps", "gcps"]
    told = caption(files_of(summary, OUTLINES))
    assert ("triangles: GCPs, red where they contradict others." in told) == wrong
    assert told.endswith("triangles: GCPs.") != wrong


def test_residuals_of_gcps_are_named_arrows_in_plan_and_the_longest_is_said():
    east, north = a_gcp("E", 10.0, 0.0), a_gcp("N", 10.002, 0.001)
    east, north = replace(east, residual_enu_m=(2.0, 0.0, 9.0)), replace(north, residual_enu_m=(0.0, -1.0, None))
    files = files_of(a_summary(VIEWS, gcps=(east, north, a_gcp("unknown", 10.001, 0.002))), OUTLINES)
    drawn = Drawing(ground_map(files))
    at, _ = sheet(np.concatenate([*chain(*OUTLINES)]))
    shafts = [corners(path.get("d")) for path in drawn.all("path", "miss")][::2]
    for shaft, (lon, lat), (right, down) in zip(
        shafts, ((10.0, 0.0), (10.002, 0.001)), ((40.0, 0.0), (0.0, 20.0)), strict=True
    ):
        start = at(np.array([lon, lat]))
        assert shaft[0] == pytest.approx(start, abs=0.02)
        assert shaft[1] == pytest.approx(start + (right, down), abs=0.02)
    assert "arrows: their residuals in plan (predicted minus given), the longest 2.0 m" in caption(files)
    assert {text[0] for text in drawn.texts("label")} <= {"E", "N", "unknown"}
    assert drawn.texts("label")
    assert "arrows" not in caption(files_of(a_summary(VIEWS, gcps=(a_gcp("P", 10.0, 0.0),)), OUTLINES))


def test_where_tie_points_move_is_outlined_and_says_so():
    box = (9.996, -0.004, 10.004, -0.001)
    groups = (
        ExplanationEntry("moving_objects", "a <group> & more", None, 50.0, 40.0, box=box),
        ExplanationEntry("step", "rows lie off", "A", 9.0, 9.0),
    )
    drawn = Drawing(ground_map(files_of(a_summary(VIEWS, PAIRS, scene=SimpleNamespace(explanations=groups)), OUTLINES)))
    at, _ = sheet(np.concatenate([*chain(*OUTLINES)]))
    assert drawn.titles("group") == ["a <group> & more"]
    (outline,) = drawn.rects("group")
    assert outline[:2] == pytest.approx(at(np.array([box[0], box[3]])), abs=0.006)
    assert np.add(outline[:2], outline[2:]) == pytest.approx(at(np.array([box[2], box[1]])), abs=0.02)
    wide = SimpleNamespace(explanations=(replace(groups[0], box=(179.998, 0.0, -179.998, 0.002)),))
    drawn = Drawing(ground_map(files_of(a_summary([a_view()], scene=wide), [a_square(180.0, 0.0)])))
    ((x, _, width, height),) = drawn.rects("group")
    assert x + width / 2 == pytest.approx(210.0, abs=0.5)
    assert 1.5 * height < width < 2.5 * height


def test_names_stand_in_the_sheet_and_on_nothing_and_long_ones_are_cut_to_their_ends():
    places = [(a_view("view_0137"), np.array([2.0, 100.0])), (a_view("B"), np.array([419.0, 50.0]))]
    drawn = drawn_names(places)
    assert drawn.texts("name") == [("view_0137", 36.9, 104.0, "middle"), ("B", 415.9, 54.0, "middle")]
    assert [row[3] for row in maps.map_labels(places, [(30.0, 90.0, 20.0)])] == [pytest.approx(115.4), 50.0]
    (long,) = drawn_names([(a_view(f"{'x' * 60}_0137"), np.array([210.0, 50.0]))]).texts("name")
    assert (long[0][0], long[0][-5:], len(long[0])) == ("…", "_0137", 16)
    for dx, dy, clear in ((8.3, 0.0, True), (8.1, 0.0, False), (0.0, 14.1, True), (0.0, 13.9, False)):
        two = [(a_view("V"), np.array([50.0, 50.0])), (a_view("V"), np.array([50.0 + dx, 50.0 + dy]))]
        aside = 15.4 * (not clear)  # of few images each has its name, a line lower where it would cover another
        assert maps.map_labels(two, [])[1][3] == pytest.approx(50.0 + dy + aside)
    crowd = [(a_view("V"), np.array([50.0 + 8.1 * k, 50.0])) for k in range(12)]  # of many those that find room
    assert [row[2] for row in maps.map_labels(crowd, [])] == pytest.approx([50.0 + 16.2 * k for k in range(6)])
    crowd[1] = (a_view("W", status="weak", advice="look"), crowd[1][1])  # and any that needs review
    assert ("W", pytest.approx(65.4)) in [(name, y) for _, name, _, y in maps.map_labels(crowd, [])]


def test_a_name_stands_beside_marks_where_there_is_room_and_is_never_lost_to_them():
    place, mark = [(a_view("V"), np.array([50.0, 50.0]))], (52.0, 49.0, 5.0)
    rows = {
        "free": [],
        "below": [mark],
        "above": [mark, (50.0, 66.0, 5.0)],
        "two below": [mark, (50.0, 66.0, 5.0), (50.0, 34.0, 5.0)],
        "nowhere": [(50.0, 50.0 + 16.0 * k, 5.0) for k in range(-2, 3)],
    }
    found = {key: [y for *_, y in maps.map_labels(place, [], marks)] for key, marks in rows.items()}
    rows = {"free": 50.0, "below": 65.4, "above": 34.6, "two below": 80.8, "nowhere": 50.0}
    assert found == {key: [pytest.approx(y)] for key, y in rows.items()}
    words = [(50.0, 50.0 + 16.0 * k, 5.0) for k in (-2, -1, 1, 2)]  # where these stand is no room
    assert maps.map_labels(place, words, [mark])[0][3] == 50.0


def test_a_name_tells_how_many_images_have_their_middle_in_the_same_place():
    # seven pixels are half a line of names; what is farther is another place, whose name stands a line lower
    for away, shown in ((6.9, ["A and 2 more"]), (7.1, ["A", "B and 1 more"]), (14.1, ["A", "B and 1 more"])):
        places = [(a_view(name), np.array([60.0, 50.0 + away * (name != "A")])) for name in "ABC"]
        assert [text for text, *_ in drawn_names(places).texts("name")] == shown


def test_a_point_outside_of_all_images_is_on_the_map_too():
    drawn = Drawing(ground_map(files_of(a_summary(VIEWS, gcps=(a_gcp("P", 10.3, 0.0),)), OUTLINES)))
    assert max(x for x, _ in drawn.points("gcps")[0]) < 420
    assert drawn.points("point") == [[(0.0, 0.0)]]  # no tie point, and a path all the same


def test_of_many_tie_points_and_images_some_are_drawn(sized):
    points = [(10.0 + 1e-6 * k, 0.0, 0.0, 0.0) for k in range(1501)]
    assert len(Drawing(ground_map(files_of(a_summary(VIEWS), OUTLINES, points))).points("point")[0]) == 751
    assert len(Drawing(ground_map(files_of(a_summary(VIEWS), OUTLINES, points[:1500]))).points("point")[0]) == 1500
    sized(shown=2)
    drawn = Drawing(ground_map(files_of(a_summary(VIEWS), OUTLINES)))
    assert [e.get("data-v") for e in drawn.all("g") if e.get("data-v")] == ["0", "2"]


def test_outlines_of_images_that_need_a_look_are_on_top_with_their_names():
    bad = {"status": "doubtful", "advice": "look", "cause": "held_out"}
    worst = {"status": "failed", "advice": "look", "cause": "untied"}
    views = [a_view("A", **bad), a_view("B"), a_view("C", **worst), a_view("D")]
    outlines = [a_square(10.0 + 0.001 * k, 0.0) for k in range(4)]
    drawn = Drawing(ground_map(files_of(a_summary(views), outlines)))
    assert [e.get("data-v") for e in drawn.all("g") if e.get("data-v")] == ["1", "3", "0", "2"]
    assert [text[0] for text in drawn.texts("name failed")] == ["C"]
    assert [text[0] for text in drawn.texts("name")] == ["B", "D"]
    many = [a_view(f"V{k}", **(bad if k in (100, 300) else {})) for k in range(500)]
    drawn = Drawing(ground_map(files_of(a_summary(many), [a_square(10.0 + 0.1 * k, 0.0) for k in range(500)])))
    assert [e.get("data-v") for e in drawn.all("g") if e.get("data-v")][-2:] == ["300", "100"]
    assert len(drawn.all("path", "outline doubtful")) == 2
    assert len(drawn.all("path", "outline adjusted")) <= 398


# --- residuals over an image ------------------------------------------------------------------------------


def test_a_cell_has_the_rms_and_the_mean_of_its_residuals():
    xy = np.array([[10.0, 10.0], [20.0, 20.0], [799.0, 399.0]])
    found = residual_cells(xy, np.array([[3.0, 4.0], [1.0, 0.0], [0.0, -2.0]]), (800, 400))
    assert found.rms[0, 0] == pytest.approx(math.sqrt(13))
    assert found.rms[7, 7] == 2.0
    assert found.mean[0, 0] == pytest.approx([2.0, 2.0])
    assert np.isfinite(found.rms).sum() == 2
    assert found.share == 0.0
    assert residual_cells(np.zeros((0, 2)), np.zeros((0, 2)), (800, 400)).share == 0.0


@pytest.mark.parametrize(
    ("num", "mean", "marked"), [(9, 10.0, False), (10, 10.0, True), (16, 0.74, False), (16, 0.76, True)]
)
def test_a_mean_of_ten_or_more_above_three_times_its_error_is_systematic(num, mean, marked):
    """Scatter of one pixel: of sixteen, the mean is known to a quarter."""
    residuals = np.column_stack([np.full(num, mean), np.where(np.arange(num) % 2, 1.0, -1.0)])
    if num % 2:
        residuals[-1, 1] = 0.0
    found = residual_cells(np.full((num, 2), 10.0), residuals, (800, 800))
    assert bool(found.systematic[0, 0]) == marked
    assert found.systematic.sum() == marked
    assert found.share == float(marked)


def panels(rows, views, when="after"):
    return residual_panels(views, seen(rows), when)


@pytest.mark.parametrize(("size", "said"), [(149.0, "150"), (1234.0, "1200"), (0.0236, "0.024"), (13.2, "13")])
def test_the_scale_of_residuals_is_written_without_powers_of_ten(size, said):
    (((svg, _),), _, _) = panels([(0, k, (60.0, 60.0), (0.0, 0.0), (size, 0.0), True) for k in range(20)], [a_view()])
    assert [text for text, *_ in Drawing(svg).texts("name")] == [f"{said} px"]


def test_a_panel_draws_residuals_cells_and_arrows_to_one_length():
    views = [a_view("A", size=(900, 450)), a_view("B", size=(900, 450))]
    pushed = [(0, k, (60.0 + k % 2, 60.0), (0.0, 0.0), (0.3, 0.02 * (-1) ** k), True) for k in range(40)]
    one = [(1, 99, (899.5, 449.5), (0.0, 0.0), (0.0, 0.6), True), (1, 98, (5.0, 5.0), (0, 0), (9.0, 9.0), False)]
    charts_of, shares, key = panels([*pushed, *one], views)
    longest = float(np.quantile([math.hypot(0.3, 0.02)] * 40 + [0.6], 0.95))
    assert key == ""
    assert shares == [1.0, 0.0]
    assert [caption for _, caption in charts_of] == [
        f"{name} % of cells with a significant mean" for name in ("A: 100", "B: 0")
    ]
    first, second = (Drawing(svg) for svg, _ in charts_of)
    assert first.box == (300, 150)
    assert first.rects("empty") == [(0, 0, 300, 150)]
    (heat,) = first.rects("heat")
    assert heat == (0, 18.75, 37.5, 18.75)
    opacity = 0.06 + 0.5 * min(math.hypot(0.3, 0.02) / (2 * longest), 1.0)
    assert float(first.all("rect", "heat")[0].get("fill-opacity")) == pytest.approx(opacity, abs=0.006)
    vectors = first.all("path", "vector")[0].get("d")
    x, y, u, v = map(float, re.match(r"M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)", vectors).groups())
    assert (x, y) == pytest.approx((60.5 / 3, 60.5 / 3), abs=0.051)
    assert (u - x, v - y) == pytest.approx((0.3 * 20 / longest, 0.02 * 20 / longest), abs=0.11)
    assert vectors.count("M") == 40
    assert first.rects("scalebar") == [(4, 143, 20, 3)]  # as long as a line of `longest`
    assert first.texts("name") == [(f"{longest:.2g} px", 29, 147, "")]
    shaft, barbs = first.points("mean")
    length = 0.3 * 40 / longest
    assert np.array(shaft) == pytest.approx(
        np.array([(18.75 - length / 2, 28.125), (18.75 + length / 2, 28.125)]), abs=0.006
    )
    assert barbs[1] == pytest.approx((18.75 + length / 2, 28.12), abs=0.006)
    assert first.described == "40 residuals are drawn; 100 % of cells with a significant mean."
    assert first.root.get("data-v") == "0"
    assert first.root[0].text == "Residuals over A"
    assert second.rects("heat") == [(262.5, 131.25, 37.5, 18.75)]
    assert float(second.all("rect", "heat")[0].get("fill-opacity")) == pytest.approx(
        0.06 + 0.5 * 0.6 / (2 * longest), abs=0.006
    )
    assert not second.all("path", "mean")


@pytest.mark.parametrize(
    ("size", "tall"), [((100, 100), 300), ((1000, 100), 120), ((100, 1000), 750), ((400, 200), 150)]
)
def test_a_panel_has_the_shape_of_its_image_within_reason(size, tall):
    charts_of, _, _ = panels([], [a_view(size=size)])
    drawn = Drawing(charts_of[0][0])
    assert drawn.box == (300, tall)
    assert charts_of[0][1] == "A: no tie points"
    assert drawn.all("path", "vector")[0].get("d") == "M0 0"


def test_a_very_large_error_is_no_darker_than_dark_and_its_arrow_no_longer_than_a_cell():
    rows = [(0, k, (50.0, 50.0), (0, 0), (0.1, 0.0), True) for k in range(200)]
    rows += [(0, k, (950.0, 950.0), (0, 0), (3.0, 4.0), True) for k in range(200, 210)]
    drawn = Drawing(panels(rows, [a_view(size=(1000, 1000))])[0][0][0])
    opacities = [float(e.get("fill-opacity")) for e in drawn.all("rect", "heat")]
    assert opacities == [0.31, 0.56]
    small, _head, large, barbs = drawn.points("mean")
    assert math.dist(*large) == pytest.approx(40.0, abs=0.02)
    assert np.subtract(large[1], large[0]) == pytest.approx((24.0, 32.0), abs=0.02)
    assert math.dist(*small) == pytest.approx(40.0, abs=0.02)
    tip, along = np.array(large[1]), np.array([3.0, 4.0])
    across = np.array([-4.0, 3.0]) * 0.6
    assert np.array(barbs) == pytest.approx(np.array([tip - along + across, tip, tip - along - across]), abs=0.011)


def test_a_short_arrow_has_a_short_head():
    """Four units of a tenth of a long residual, down the image from its first cell."""
    rows = [(0, k, (50.0, 50.0), (0, 0), (0.0, 0.1), True) for k in range(20)]
    rows += [(0, 20 + k, (950.0, 950.0), (0, 0), (1.0, 0.0), True) for k in range(5)]
    shaft, barbs = Drawing(panels(rows, [a_view(size=(1000, 1000))])[0][0][0]).points("mean")
    x = y = 18.75
    assert np.array(shaft) == pytest.approx(np.array([(x, y - 2), (x, y + 2)]), abs=0.006)
    assert np.array(barbs) == pytest.approx(np.array([(x - 1.2, y), (x, y + 2), (x + 1.2, y)]), abs=0.006)


def test_of_many_residuals_every_few_th_is_drawn_and_of_many_images_the_most_systematic(monkeypatch):
    rows = [(0, k, (50.0, 50.0), (0, 0), (0.1 * (-1) ** k, 0.0), True) for k in range(301)]
    assert Drawing(panels(rows, [a_view()])[0][0][0]).described.startswith("151 ")
    assert Drawing(panels(rows[:300], [a_view()])[0][0][0]).described.startswith("300 ")
    views = [a_view(f"V{k}") for k in range(24)]
    assert Drawing(panels(rows[:250], views)[0][0][0]).described.startswith("250 ")
    assert Drawing(panels(rows[:251], views)[0][0][0]).described.startswith("126 ")
    many = [a_view(f"V{k}") for k in range(61)]
    pushed = [(60, k, (50.0, 50.0), (0, 0), (0.1, 0.0), True) for k in range(20)]
    found, shares, key = panels([*rows[:101], *pushed], many)
    assert Drawing(found[1][0]).described.startswith("51 ")  # a hundred an image of sixty
    assert len(found) == 60
    assert found[0][1].startswith("V60: 100 %")
    flagged = maps.residual_panels(many, seen([*rows[:101], *pushed]), "after", [7, 3])
    assert [caption.split(":")[0] for _, caption in flagged[0][:3]] == ["V7", "V3", "V60"]
    assert flagged[2].endswith("60 are shown: those that need review, then those with the largest systematic part.")
    assert len(shares) == 61
    assert key == "Of 61 images 60 are shown: those with the largest systematic part."
    assert panels(rows, many[:60])[2] == ""


@pytest.mark.parametrize(("count", "first"), [(10, "V0"), (11, "V9")])
def test_panels_of_up_to_ten_images_stand_as_the_images_are_given(count, first):
    pushed = [(9, k, (50.0, 50.0), (0, 0), (0.1, 0.0), True) for k in range(20)]
    found, _, _ = panels(pushed, [a_view(f"V{k}") for k in range(count)])
    assert found[0][1].startswith(f"{first}: ")


def test_before_and_after_are_two_and_what_is_not_known_or_used_is_left_out():
    rows = [(0, 0, (5, 5), (1.0, 0.0), (np.nan, np.nan), True), (0, 1, (5, 5), (3.0, 0.0), (0.5, 0.0), True)]
    before, after = panels(rows, [a_view()], "before"), panels(rows, [a_view()], "after")
    assert Drawing(before[0][0][0]).described.startswith("2 residuals")
    assert Drawing(after[0][0][0]).described.startswith("1 residuals")
    assert Drawing(before[0][0][0]).root.get("aria-labelledby") == "panel-before0-t panel-before0-d"
    none = panels([(0, 1, (5, 5), (0, 0), (0.0, 0.0), True)], [a_view()])
    bars = [[text for text, *_ in Drawing(found[0][0][0]).texts("name")] for found in (after, before, none)]
    assert bars == [["0.5 px"], ["2.9 px"], ["1 px"]]
