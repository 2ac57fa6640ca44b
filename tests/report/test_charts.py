"""Charts: every dot, bar and word stands where its value puts it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from barpc.report import charts
from barpc.report.charts import (
    Scale,
    coordinate,
    evenly,
    round_ticks,
    tag,
)

from .made import Drawing

# --- pieces -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.0, "1"), (1.5, "1.5"), (1.256, "1.26"), (100.0, "100"), (-0.001, "0"), (-0.5, "-0.5"), (0.0, "0")],
)
def test_a_coordinate_takes_as_few_characters_as_two_decimals_do(value, text):
    assert coordinate(value) == text


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


def test_of_many_rows_some_are_shown_evenly():
    assert list(evenly(range(4), 4)) == [0, 1, 2, 3]
    assert list(evenly(range(5), 4)) == [0, 2, 4]
    assert list(evenly(range(9), 4)) == [0, 3, 6]
    assert list(evenly([], 4)) == []


def test_how_much_is_shown_at_most():
    assert (charts.MAX_DRAWN, charts.MAX_DOTS) == (400, 1500)


def test_an_axis_has_a_line_and_a_number_a_tick_and_its_title_below():
    drawn = Drawing(charts.sheet("k", "t", "d", 9, charts.x_axis(Scale(0.0, 2.0, 100.0, 200.0), 10.0, 50.0, "s [m]")))
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


def test_a_scale_of_one_decade_is_that_of_its_logarithm():
    assert Scale(1.0, 10.0, 0.0, 1.0, log=True)(2.0) == pytest.approx(math.log10(2.0))
