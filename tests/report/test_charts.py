"""Charts: every dot, bar and word stands where its value puts it."""

from __future__ import annotations

import pytest

from barpc.report import maps
from barpc.report.maps import coordinate, round_ticks, thin

# --- pieces -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.0, "1"), (1.5, "1.5"), (1.256, "1.26"), (100.0, "100"), (-0.001, "0"), (-0.5, "-0.5"), (0.0, "0")],
)
def test_a_coordinate_takes_as_few_characters_as_two_decimals_do(value, text):
    assert coordinate(value) == text


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


def test_of_many_rows_some_are_shown_evenly():
    assert list(thin(range(4), 4)) == [0, 1, 2, 3]
    assert list(thin(range(5), 4)) == [0, 2, 4]
    assert list(thin(range(9), 4)) == [0, 3, 6]
    assert list(thin([], 4)) == []


def test_how_much_is_shown_at_most():
    assert (maps.MAX_SHOWN, maps.MAX_MARKS) == (400, 1500)
