"""The matrix of the pairs: which cell a pair has, how dark it is, and what it says."""

from __future__ import annotations

from itertools import pairwise

import pytest

from barpc.report import matrix
from barpc.report.matrix import MEASURES, facts, pair_matrix

from .made import Drawing, a_pair, a_summary, a_view, files_of

MATCHES, OFFSET, ANGLE = MEASURES


def files(num: int, *pairs):
    return files_of(a_summary([a_view(name, num_observations=10 * k) for k, name in enumerate(names(num))], pairs))


def names(num: int) -> list[str]:
    return [chr(ord("A") + k) for k in range(num)]


@pytest.mark.parametrize(
    ("measure", "limits"),
    [(MATCHES, (10, 30, 100, 300, 1000)), (OFFSET, (0.05, 0.1, 0.2, 0.5, 1)), (ANGLE, (1, 5, 15, 35, 60))],
)
def test_a_shade_begins_at_its_limit(measure, limits):
    assert measure.shade(0.99 * limits[0]) == 0
    for number, limit in enumerate(limits, start=1):
        assert (measure.shade(limit), measure.shade(0.99 * limit)) == (number, number - 1)
    assert len(measure.legend) == len(limits) + 1


def test_the_legend_says_what_each_shade_is():
    assert ANGLE.legend == ["below 1", "1 to 5", "5 to 15", "15 to 35", "35 to 60", "60 and more"]


def test_what_is_measured_of_a_pair():
    pair = a_pair(num=240, convergence_deg=12.0)
    assert [measure.value(pair) for measure in MEASURES] == [240, 0.1, 12.0]
    assert OFFSET.value(a_pair(epipolar_after=None)) is None


def test_a_pair_stands_above_the_diagonal_in_the_row_of_its_first_image():
    found = files(4, a_pair("B", "D", 50, convergence_deg=40.0), a_pair("C", "A", 2000, epipolar_after=None))
    drawn = Drawing(pair_matrix(found))
    side = (420 - 30 - 4) / 4  # 96.5
    assert drawn.box == (420, 18 + 386 + 4)
    assert drawn.rects("empty") == [(30, 18, 386, 386)]
    assert drawn.rects("cursor") == [(0, 0, side, side)]
    layers = [drawn.all("g", f"layer l{k}")[0] for k in range(3)]
    cells = [[(e.get("class"), e.get("d")) for e in layer.iter("path")] for layer in layers]
    box = "h96.5v96.5h-96.5z"
    of_b, of_a = f"M{30 + 3 * 96.5:g} {18 + 96.5:g}{box}", f"M{30 + 2 * 96.5:g} 18{box}"
    assert cells == [
        [("cell s2", of_b), ("cell s5", of_a)],
        [("cell s2", of_b)],
        [("cell s3", of_a), ("cell s4", of_b)],
    ]
    assert drawn.texts("value")[:2] == [("50", 367.75, 166.75, "middle"), ("2000", 271.25, 70.25, "middle")]
    assert [words for words, *_ in drawn.texts("value")[2:]] == ["0.10", "40.0", "20.0"]
    assert [layer.get("data-words") for layer in layers] == [measure.words for measure in MEASURES]
    assert [drawn.root.get(f"data-{key}") for key in ("side", "left", "top")] == ["96.5", "30", "18"]
    assert drawn.described == "4 images, 2 pairs; the figures are in the table of pairs."


def test_the_legend_stands_in_the_lower_left_where_no_pair_does():
    drawn = Drawing(pair_matrix(files(3, a_pair())))
    whole = 386.0
    top = 18 + whole - 18 * 6 - 6
    assert drawn.texts("axis")[0] == ("matches", 38, pytest.approx(top - 6, abs=0.01), "start")
    assert drawn.rects("cell s0")[0] == (38, pytest.approx(top, abs=0.01), 14, 14)
    assert drawn.rects("cell s5")[0] == (38, pytest.approx(top + 90, abs=0.01), 14, 14)
    assert ("below 10", 58, pytest.approx(top + 11, abs=0.01), "start") in drawn.texts("tick")
    assert ("1000 and more", 58, pytest.approx(top + 101, abs=0.01), "start") in drawn.texts("tick")


@pytest.mark.parametrize(
    ("num", "digits", "step"),
    [(3, 1, 1), (25, 1, 1), (26, 1, 2), (9, 9, 2), (52, 2, 5), (200, 3, 20), (400, 4, 50), (3000, 4, 500)],
)
def test_as_many_names_stand_at_the_sides_as_have_room(num, digits, step):
    side, called = 386 / num, [f"{k:0{digits}d}"[-digits:] for k in range(num)]
    drawn = Drawing(f"<svg>{''.join(matrix._names(called, side, 30.0))}</svg>")
    across = [text for text in drawn.texts("tick") if text[3] == "middle"]
    down = [text for text in drawn.texts("tick") if text[3] == "end"]
    assert [text[0] for text in across] == [text[0] for text in down] == called[::step]
    for k, (word, x, y, _), (_, u, v, _) in zip(range(0, num, step), across, down, strict=True):
        place = side * (k + 0.5)
        assert (y, u, v) == pytest.approx((13, 26, 18 + place + 4), abs=0.006)
        assert x == pytest.approx(min(30 + place, 420 - 4.1 * len(word)), abs=0.006)
    ends = [(x - 4.1 * digits, x + 3.75 * digits) for _, x, _, _ in across]
    assert all(a[1] < b[0] for a, b in pairwise(ends[:-1]))


def test_long_names_leave_room_at_the_left_and_are_cut_to_their_ends():
    views = [a_view(f"IMG_PHR1A_P_{k:04d}") for k in range(3)]
    drawn = Drawing(pair_matrix(files_of(a_summary(views), [a_pair("IMG_PHR1A_P_0000", "IMG_PHR1A_P_0002")])))
    assert [text[0] for text in drawn.texts("tick") if text[3] == "end"] == [
        f"…R1A_P_{k:04d}"[:1] + f"R1A_P_{k:04d}"[-9:] for k in range(3)
    ]
    assert drawn.root.get("data-left") == "88"
    assert drawn.rects("empty")[0][0] == 88


@pytest.mark.parametrize(("num", "written"), [(12, True), (13, False)])
def test_figures_stand_in_the_cells_of_twelve_images_at_most(num, written):
    assert bool(Drawing(pair_matrix(files(num, a_pair()))).texts("value")) == written


def test_the_page_s_script_knows_names_and_figures():
    found = facts(files(3, a_pair("C", "B", 50, epipolar_after=None), a_pair("A", "B", 7, convergence_deg=12.34)))
    assert found["views"] == [["A", 0], ["B", 10], ["C", 20]]
    assert found["pairs"] == [[1, 2, "50", "", "20.0"], [0, 1, "7", "0.10", "12.3"]]
