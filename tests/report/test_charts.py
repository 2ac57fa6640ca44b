"""Charts: every dot, bar and word stands where its value puts it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from barpc.report import charts
from barpc.report.charts import (
    Row,
    Scale,
    evenly,
    log_scale,
    most_telling,
    number,
    numbered,
    round_ticks,
    tag,
)

from .made import Drawing, a_correction, a_pair, a_view

# --- pieces -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.0, "1"), (1.5, "1.5"), (1.256, "1.26"), (100.0, "100"), (-0.001, "0"), (-0.5, "-0.5"), (0.0, "0")],
)
def test_a_coordinate_takes_as_few_characters_as_two_decimals_do(value, text):
    assert number(value) == text


def test_words_in_a_drawing_carry_no_markup():
    assert tag("text", x='a"<b>') == '<text x="a&quot;&lt;b&gt;"/>'
    assert charts.label(1, 2, "a<b") == '<text x="1" y="2" text-anchor="start" class="tick">a&lt;b</text>'
    assert charts.titled("<g/>", "a<b", data_v=3) == '<g data-v="3"><title>a&lt;b</title><g/></g>'


def test_a_path_is_open_unless_it_is_closed():
    assert charts.path([(0, 0), (1.5, 2)], "x") == '<path d="M0 0L1.5 2" class="x"/>'
    assert charts.path([(0, 0), (1.5, 2)], "x", closed=True) == '<path d="M0 0L1.5 2Z" class="x"/>'


def test_a_sheet_is_as_wide_as_a_chart_unless_it_says_so():
    assert Drawing(charts.sheet("k", "t", "d", 50.25, [])).box == (420.0, 50.25)
    assert Drawing(charts.sheet("k", "t", "d", 50.0, [], width=180.0)).box == (180.0, 50.0)


def test_a_scale_leads_its_ends_to_its_ends_and_is_even_between():
    scale = Scale(10.0, 30.0, 100.0, 0.0)
    assert [scale(value) for value in (10.0, 15.0, 30.0, 40.0)] == pytest.approx([100.0, 75.0, 0.0, -50.0])
    ratios = Scale(0.1, 1000.0, 0.0, 8.0, log=True)
    places = [ratios(value) for value in (0.1, 1.0, 100.0, 1000.0, 0.001, -5.0)]
    assert places == pytest.approx([0.0, 2.0, 6.0, 8.0, 0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (0.02, 30.0, [0.1, 1, 10]),  # four powers
        (0.2, 99.0, [0.3, 1, 3, 10, 30]),  # three
        (0.2, 9.0, [0.2, 0.5, 1, 2, 5]),  # two
        (1.0, 10.0, [1, 2, 5, 10]),
        (1.0009, 9.991, [1, 2, 5, 10]),  # a thousandth beyond either end
        (1.002, 9.98, [2, 5]),
    ],
)
def test_ticks_of_ratios_are_powers_of_ten_with_more_between_where_there_is_room(low, high, ticks):
    assert Scale(low, high, 0, 1, log=True).ticks == pytest.approx(ticks)


@pytest.mark.parametrize(
    ("low", "high", "most", "ticks"),
    [
        (0.0, 6.0, 6, [0, 1, 2, 3, 4, 5, 6]),
        (0.0, 6.1, 6, [0, 2, 4, 6]),
        (-7.0, 5.0, 6, [-6, -4, -2, 0, 2, 4]),
        (0.0, 30.0, 3, [0, 10, 20, 30]),
        (0.0, 31.0, 3, [0, 20]),
        (0.0, 61.0, 3, [0, 50]),
        (0.0, 160.0, 3, [0, 100]),
        (0.1, 0.31, 6, [0.1, 0.15, 0.2, 0.25, 0.3]),
        (-0.01, 0.3, 3, [0, 0.2]),
    ],
)
def test_round_ticks_are_multiples_of_a_one_a_two_or_a_five(low, high, most, ticks):
    found = round_ticks(low, high, most)
    assert found == pytest.approx(ticks, abs=1e-12)
    assert "-0" not in map("{:g}".format, found)


def test_linear_ticks_of_a_scale_are_six_steps_at_most():
    assert Scale(0.0, 6.0, 0, 1).ticks == [0, 1, 2, 3, 4, 5, 6]
    assert Scale(0.0, 6.1, 0, 1).ticks == [0, 2, 4, 6]


def test_a_scale_of_ratios_holds_its_values_with_a_quarter_to_spare_and_a_factor_of_five_at_least():
    found = log_scale([0.5, 40.0, 0.0, -3.0], 1.0, 2.0)
    assert (found.low, found.high, found.start, found.stop, found.log) == pytest.approx(
        (0.4, 50.0, 1, 2, True)
    )
    narrow = log_scale([1.0, 2.0], 0, 1)
    assert (narrow.low, narrow.high) == pytest.approx((0.8, 4.0))
    nothing = log_scale([0.0], 0, 1)
    assert (nothing.low, nothing.high) == pytest.approx((0.8, 4.0))
    assert log_scale([1e-13, 1e-11], 0, 1).low == pytest.approx(0.8e-11)  # rounding is no value
    assert log_scale([3.0, 3.2], 0, 1).high == pytest.approx(12.0)  # four times the least


def test_names_are_numbered_and_cut_in_their_middle():
    assert numbered(["abcdefghijklm"]) == ["1 abcdefghijklm"]  # 15 characters
    assert numbered(["abcdefghijklmn"]) == ["1 abcdef…ijklmn"]
    long = numbered(["abcdefghijklmn"] * 10)[9]
    assert (long, len(long)) == ("10 abcdef…jklmn", 15)
    assert numbered(["abcdef"], most=7) == ["1 ab…ef"]


def test_of_many_rows_the_most_telling_or_some_evenly(monkeypatch):
    monkeypatch.setattr(charts, "MAX_ROWS", 3)
    assert most_telling([2, 9, 1], lambda row: -row) == [2, 9, 1]
    assert most_telling([2, 9, 1, 5], lambda row: -row) == [9, 5, 2]
    assert list(evenly(range(4), 4)) == [0, 1, 2, 3]
    assert list(evenly(range(5), 4)) == [0, 2, 4]
    assert list(evenly(range(9), 4)) == [0, 3, 6]
    assert list(evenly([], 4)) == []


def test_how_much_is_shown_at_most():
    assert (charts.MAX_ROWS, charts.MAX_DRAWN, charts.MAX_DOTS, charts.PAIR_DOTS) == (24, 400, 1500, 300)


def test_an_axis_has_a_line_and_a_number_a_tick_and_its_title_below():
    drawn = Drawing(
        charts.sheet("k", "t", "d", 9, charts.x_axis(Scale(0.0, 2.0, 100.0, 200.0), 10.0, 50.0, "s [m]"))
    )
    assert drawn.lines("grid")[::2] == [(100, 10, 100, 50), (150, 10, 150, 50), (200, 10, 200, 50)]
    assert drawn.texts("tick")[::2] == [
        ("0", 100, 63, "middle"),
        ("1", 150, 63, "middle"),
        ("2", 200, 63, "middle"),
    ]
    assert drawn.texts("axis") == [("s [m]", 200, 79, "end")]


def test_a_legend_ends_at_the_right_with_a_dot_before_each_name():
    drawn = Drawing(charts.sheet("k", "t", "d", 9, charts.legend(["one", "three"], 400.0, 14.0)))
    assert drawn.texts("tick") == [("three", 400, 14, "end"), ("one", 341, 14, "end")]
    assert drawn.of("circle", "dot three", "cx", "cy", "r") == [(355, 10, 4.5)]
    assert drawn.of("circle", "dot one", "cx", "cy", "r") == [(pytest.approx(309.2), 10, 4.5)]


# --- charts -----------------------------------------------------------------------------------------------


def test_a_histogram_holds_every_error_and_each_curve_reaches_its_own_peak():
    before, after = np.geomspace(1.0, 8.0, 401), np.repeat(0.25, 90)
    drawn = Drawing(charts.histogram(np.append(before, 0.0), after))
    assert drawn.box == (420, 202)
    low, high = np.quantile(np.concatenate([before, after]), [0.002, 0.9995])
    scale = Scale(low / 1.2, high * 1.2, 12.0, 408.0, log=True)
    for name, values in (("before", before), ("after", after)):
        (points,) = drawn.points(f"area {name}")
        x, y = np.array(points).T
        assert len(x) == 2 * 48 + 2
        assert (x[0], x[-1], y[0], y[-1]) == (12, 408, 170, 170)
        assert y.min() == 26  # the peak, below the legend
        edges = x[1::2]
        share = (170 - y[1:-1:2]) / 144
        counts = np.histogram([scale(value) for value in values.clip(scale.low, scale.high)], edges)[0]
        assert np.abs(share - counts / counts.max()).max() < 0.06  # an edge has two decimals
        assert np.diff(edges) == pytest.approx(396 / 48, abs=0.011)
        assert y[1:-1:2].tolist() == y[2:-1:2].tolist()  # steps
    assert drawn.titles() == ["median before 2.83 px", "median after 0.25 px"]
    assert drawn.described == "median before 2.83 px; median after 0.25 px."
    assert drawn.texts("axis") == [("reprojection error [px], logarithmic", 408, 199, "end")]
    assert drawn.texts("tick")[-2:] == [("after", 408, 14, "end"), ("before", 349, 14, "end")]
    assert drawn.lines("grid")[0][1::2] == (26, 170)


def test_a_histogram_of_what_was_not_adjusted_has_one_curve_and_no_error_of_nought_widens_it():
    drawn = Drawing(charts.histogram(np.array([0.5, 1.0, 2.0]), np.zeros(0)))
    assert [element.get("class") for element in drawn.all("path")] == ["area before"]
    wide = Drawing(charts.histogram(np.array([1e-9] * 5 + [1.0] * 5), np.array([0.0])))
    ticks = [float(words) for words, *_ in wide.texts("tick")[:-1]]
    assert ticks == pytest.approx([1e-4, 1e-3, 1e-2, 1e-1, 1.0])  # down to a ten thousandth of the largest


def test_a_dumbbell_has_its_dots_at_its_values_and_a_link_between_them():
    rows = [
        Row("1 A", "image A", 8.0, 0.5),
        Row("2 B", "image B", 2.0, None),
        Row("3 C", "image C", None, None),
    ]
    drawn = Drawing(charts.dumbbells("k", "t", "error [px]", rows))
    scale = Scale(0.4, 10.0, 128.0, 408.0, log=True)
    assert drawn.box == (420, 24 + 3 * 17 + 34)

    def at(value):
        return pytest.approx(scale(value), abs=0.006)

    assert drawn.of("circle", "dot before", "cx", "cy")[:2] == [(at(8.0), 32.5), (at(2.0), 49.5)]
    assert drawn.of("circle", "dot after", "cx", "cy")[:1] == [(at(0.5), 32.5)]
    assert drawn.lines("link") == [(at(8.0), 32.5, at(0.5), 32.5)]
    assert drawn.texts("tick")[-5:-2] == [
        ("1 A", 120, 36.5, "end"),
        ("2 B", 120, 53.5, "end"),
        ("3 C", 120, 70.5, "end"),
    ]
    assert drawn.titles("dot before") == ["image A: before 8", "image B: before 2"]
    assert drawn.titles("dot after") == ["image A: after 0.5"]
    assert drawn.titles("tick") == ["image A", "image B", "image C"]
    assert drawn.lines("grid")[0][1::2] == (24, 75)
    assert drawn.texts("tick")[-2:] == [("after", 408, 13, "end"), ("before", 349, 13, "end")]
    assert drawn.described == "3 of 3 rows; the figures are in the table."
    assert {e.get("r") for e in drawn.all("circle")} == {"4.5"}
    alone = Drawing(charts.dumbbells("k", "t", "error [px]", rows[1:]))
    assert [words for words, *_ in alone.texts("tick")][-1] == "before"
    assert not alone.all("circle", "dot after")


def test_of_many_dumbbells_those_with_the_largest_last_value_are_shown(monkeypatch):
    monkeypatch.setattr(charts, "MAX_ROWS", 2)
    rows = [
        Row("a", "a", 9.0, 0.1),
        Row("b", "b", 3.0, None),
        Row("c", "c", 5.0, 0.2),
        Row("d", "d", None, None),
    ]
    assert [row.last for row in rows] == [0.1, 3.0, 0.2, 0.0]
    drawn = Drawing(charts.dumbbells("k", "t", "x", rows))
    assert drawn.titles("tick") == ["b", "c"]
    assert drawn.described.startswith("2 of 4 rows")
    assert drawn.titles("dot before")[0] == "b: before 3"


def test_pairs_stand_over_their_angle_by_their_matches():
    pairs = [a_pair(num=100, convergence_deg=20.0), a_pair("A", "C", 1000, convergence_deg=50.0)]
    pairs.append(a_pair("B", "C", 30, convergence_deg=None))
    drawn = Drawing(charts.convergence(pairs))
    x, y = Scale(0.0, 54.0, 44.0, 408.0), Scale(24.0, 1250.0, 190.0, 44.0, log=True)
    assert drawn.box == (420, 222)
    dots = [tuple(float(e.get(key)) for key in ("cx", "cy", "r")) for e in drawn.all("circle")]
    expected = [
        (round(x(angle), 1), round(y(num), 1), 4.5) for angle, num in ((20, 100), (50, 1000), (0, 30))
    ]
    assert np.array(dots) == pytest.approx(np.array(expected), abs=0.011)
    words = [e.findtext("title") for e in drawn.all("circle")]
    assert words == [
        "A - B: 20.0 deg, 100 matches",
        "A - C: 50.0 deg, 1000 matches",
        "B - C: 0.0 deg, 30 matches",
    ]
    limits = {"zone weak": (0, 5), "zone good": (5, 35), "zone hard": (35, 54)}
    for zone, (low, high) in limits.items():
        assert drawn.rects(zone) == [pytest.approx((x(low), 30, x(high) - x(low), 160), abs=0.011)]
    ticks = drawn.texts("tick")
    middle = pytest.approx((x(5) + x(35)) / 2, abs=0.006)
    assert ticks[0] == ("good", middle, 26, "middle")  # "weak heights" is wider than its zone
    assert ticks[1] == ("hard to match", pytest.approx((x(35) + x(54)) / 2, abs=0.006), 26, "middle")
    assert ("100", 40, pytest.approx(y(100) + 4, abs=0.006), "end") in ticks
    rows = [line for line in drawn.lines("grid") if line[1] == line[3]]
    assert rows[0] == (44, pytest.approx(y(30), abs=0.006), 408, pytest.approx(y(30), abs=0.006))
    assert next(line for line in drawn.lines("grid") if line[0] == line[2]) == (44, 30, 44, 190)
    assert ("matches", 4, 12, "start") in drawn.texts("axis")
    assert drawn.described == "3 pairs, up to 50.0 degrees."


def test_narrow_angles_have_a_chart_of_eight_degrees_and_room_for_their_words():
    drawn = Drawing(charts.convergence([a_pair(convergence_deg=1.0)]))
    assert [words for words, x, y, _ in drawn.texts("tick") if y == 26] == ["weak heights", "good"]
    assert drawn.rects("zone good") == [pytest.approx((44 + 364 * 5 / 8, 30, 364 * 3 / 8, 160), abs=0.01)]
    assert not drawn.rects("zone hard")
    wider = Drawing(charts.convergence([a_pair(convergence_deg=10.0)]))
    assert wider.rects("zone weak") == [pytest.approx((44, 30, 364 * 5 / 10.8, 160), abs=0.01)]
    assert len(Drawing(charts.convergence([a_pair(num=n) for n in range(1, 302)])).all("circle")) == 151


def test_a_camera_s_move_has_a_dot_a_coordinate_with_one_sigma():
    views = [
        a_view("A", correction=a_correction()),
        a_view("B", correction=a_correction(center_shift_px=(-4.0, 0.5))),
    ]
    drawn = Drawing(charts.corrections(views))
    scale = Scale(-1.1 * 4.1, 1.1 * 4.1, 128.0, 408.0)

    def at(value):
        return pytest.approx(scale(value), abs=0.006)

    assert drawn.box == (420, 24 + 2 * 17 + 34)
    assert drawn.of("circle", "dot col", "cx", "cy", "r")[:2] == [(at(1.0), 28.5, 3.5), (at(-4.0), 45.5, 3.5)]
    assert drawn.of("circle", "dot row", "cx", "cy", "r")[:2] == [(at(-2.0), 36.5, 3.5), (at(0.5), 53.5, 3.5)]
    assert drawn.lines("bar col")[0] == (at(0.9), 28.5, at(1.1), 28.5)
    assert drawn.lines("bar row")[0] == (at(-2.1), 36.5, at(-1.9), 36.5)
    assert drawn.lines("zero") == [(268, 24, 268, 58)]
    assert drawn.texts("axis")[0][0] == "shift in the middle of the image, with one sigma [px]"
    assert drawn.titles("dot col") == ["A, col: +1.00 ± 0.10 px", "B, col: -4.00 ± 0.10 px"]
    assert ("1 A", 120, 36.5, "end") in drawn.texts("tick")
    assert drawn.texts("tick")[-2:] == [("row", 408, 13, "end"), ("col", pytest.approx(362.2), 13, "end")]
    assert drawn.described == "2 of 2 images; the largest shift is 4 px."


@pytest.mark.parametrize(("sigma", "bars"), [(3.9, True), (4.0, True), (4.1, False)])
def test_a_sigma_of_more_than_twice_the_largest_shift_has_no_bar(sigma, bars):
    drawn = Drawing(charts.corrections([a_view(correction=a_correction(center_sigma_px=(0.1, sigma)))]))
    reach = 1.1 * (2.0 + sigma * bars)
    scale = Scale(-reach, reach, 128.0, 408.0)
    ends = (-2.0 - sigma, -2.0 + sigma) if bars else (-2.0, 0.0)
    (found,) = drawn.lines("bar row")
    assert found == pytest.approx((scale(ends[0]), 36.5, scale(ends[1]), 36.5), abs=0.011)
    assert ("with one sigma" in drawn.texts("axis")[0][0]) == bars
    if not bars:
        assert drawn.lines("bar col")[0] == pytest.approx((268, 28.5, scale(1.0), 28.5), abs=0.011)


def test_cameras_that_did_not_move_have_a_chart_and_those_that_moved_most_come_first(monkeypatch):
    still = a_view(correction=a_correction(center_shift_px=(0.0, 0.0), center_sigma_px=(1e-4, 1e-4)))
    scale = Scale(-1.1 * 1.1e-3, 1.1 * 1.1e-3, 128.0, 408.0)
    assert Drawing(charts.corrections([still])).lines("bar col")[0][2] == pytest.approx(scale(1e-4), abs=0.01)
    monkeypatch.setattr(charts, "MAX_ROWS", 2)
    views = [
        a_view(n, correction=a_correction(center_shift_px=s))
        for n, s in zip("ABC", [(1, 0), (0, -3), (2, 0)], strict=True)
    ]
    drawn = Drawing(charts.corrections(views))
    assert drawn.titles("tick") == ["B", "C"]
    assert drawn.described == "2 of 3 images; the largest shift is 3 px."


@pytest.mark.parametrize(
    "correction",
    [
        None,
        {"center_shift_px": None},
        {"center_sigma_px": None},
        {"center_sigma_px": (0.1, None)},
        {"center_shift_px": (None, 1.0)},
    ],
)
def test_a_view_whose_move_is_not_stated_has_none(correction):
    views = [
        a_view(correction=correction and a_correction(**correction)),
        a_view("B", correction=a_correction()),
    ]
    assert charts.moves_of(views) == [((1.0, -2.0), (0.1, 0.1))]


def test_a_scale_of_one_decade_is_that_of_its_logarithm():
    assert Scale(1.0, 10.0, 0.0, 1.0, log=True)(2.0) == pytest.approx(math.log10(2.0))


def test_a_chart_of_moves_is_of_images_that_all_have_one():
    with pytest.raises(ValueError, match="zip"):
        charts.corrections([a_view("A", correction=a_correction()), a_view("B")])
