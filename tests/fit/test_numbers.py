"""Points that cannot be: refused with what is wrong, from the first number beyond the range on."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from barpc.base.errors import FitError
from barpc.fit.points import checked_points, column_ranges, screened, spaced, widened

RNG = np.random.default_rng(0)
GROUND = np.column_stack([RNG.uniform(5, 6, 60), RNG.uniform(43, 44, 60), RNG.uniform(0, 900, 60)])
IMAGE = np.column_stack([(GROUND[:, 0] - 5) * 8e3, (44 - GROUND[:, 1]) * 11e3]) + RNG.uniform(0, 1, (60, 2))


@pytest.mark.parametrize(
    ("column", "value", "name"),
    [
        (0, -360.0, None), (0, -360.1, "longitude"), (0, 720.0, None), (0, 720.1, "longitude"),
        (1, -90.0, None), (1, -90.1, "latitude"), (1, 90.0, None), (1, 90.1, "latitude"),
        (2, -12e3, None), (2, -12.1e3, "altitude"), (2, 100e3, None), (2, 100.1e3, "altitude"),
    ],
)  # fmt: skip
def test_numbers_are_longitudes_latitudes_and_altitudes(column: int, value: float, name: str | None) -> None:
    ground = GROUND.copy()
    ground[7, column] = value
    if name is None:
        np.testing.assert_array_equal(checked_points(ground, IMAGE)[0][:, 1:], ground[:, 1:])
    else:
        with pytest.raises(FitError, match=f"^points: {value:g} is not a {name}: are the columns swapped"):
            checked_points(ground, IMAGE)


@pytest.mark.parametrize(
    ("ground", "image"),
    [
        (GROUND[:, :2], IMAGE), (GROUND[0], IMAGE[0]), (GROUND, IMAGE[:59]), (GROUND, IMAGE[:, :1]),
        (GROUND, np.column_stack([IMAGE, IMAGE[:, 0]])), (GROUND[None], IMAGE),
    ],
)  # fmt: skip
def test_arrays_of_other_shapes_are_refused(ground: np.ndarray, image: np.ndarray) -> None:
    with pytest.raises(FitError, match=r"expected \(N, 3\) and \(N, 2\)"):
        checked_points(ground, image)


def test_the_first_point_that_is_not_finite_is_named() -> None:
    for wrong in (np.nan, np.inf):
        for array, column in ((0, 0), (0, 2), (1, 0), (1, 1)):
            given = [GROUND.copy(), IMAGE.copy()]
            given[array][[3, 9], column] = wrong
            with pytest.raises(FitError, match=r"2 of 60 are not finite \(the first is point 3\)"):
                checked_points(*given)
    with pytest.raises(FitError, match="none at all"):
        checked_points(GROUND[:0], IMAGE[:0])


def test_longitudes_across_the_antimeridian_run_on() -> None:
    ground = GROUND.copy()
    ground[:, 0] = np.where(np.arange(60) % 2, 179.9, -179.9)
    found = checked_points(ground, IMAGE)[0]
    assert np.ptp(found[:, 0]) == pytest.approx(0.2)
    assert np.ptp(checked_points(GROUND, IMAGE)[0][:, 0]) < 1.0
    np.testing.assert_array_equal(checked_points(GROUND, IMAGE)[0], GROUND)


@pytest.mark.parametrize(("column", "name"), [(0, "lon"), (1, "lat"), (2, "col"), (3, "row")])
@pytest.mark.parametrize("value", [0.0, 43.25, -1e4])
def test_points_of_one_value_determine_no_image(column: int, name: str, value: float) -> None:
    given = [GROUND.copy(), IMAGE.copy()]
    value = min(max(value, -80.0), 80.0) if column < 2 else value
    given[column // 2][:, column % 2] = value
    with pytest.raises(FitError, match=f"^points: all have {name} {value:g}: they determine no image"):
        screened(*given)


@pytest.mark.parametrize(("spread", "ok"), [(0.7e-12, False), (1.5e-12, True)])
@pytest.mark.parametrize("value", [43.25, -43.25])
def test_a_value_that_differs_by_parts_in_a_million_millions_is_one(value: float, spread: float, ok: bool) -> None:
    ground = GROUND.copy()
    ground[:, 1] = value * (1.0 - spread * (ground[:, 1] - ground[:, 1].min()) / np.ptp(ground[:, 1]))
    with nullcontext() if ok else pytest.raises(FitError, match="they determine no image"):
        assert len(screened(ground, IMAGE)[0]) == len(ground)


def test_points_on_a_line_or_in_a_plane_are_refused_and_those_at_one_altitude_taken() -> None:
    line = IMAGE.copy()
    line[:, 1] = 3.0 * line[:, 0] + 7.0
    with pytest.raises(FitError, match="in the image they lie on a line"):
        screened(GROUND, line)
    plane = GROUND.copy()
    plane[:, 2] = 100.0 + 300.0 * (plane[:, 0] - 5.0) + 200.0 * (plane[:, 1] - 43.0)
    with pytest.raises(FitError, match="on the ground they lie in a plane"):
        screened(plane, IMAGE)
    flat = GROUND.copy()
    flat[:, 2] = 100.0
    screened(flat, IMAGE)
    flat[0, 2] += 5e-4  # half a millimetre is one altitude, too
    screened(flat, IMAGE)
    flat[0, 2] += 5.0  # one point above the others: nothing tells its slope in altitude
    plane[0, 2] += 50.0
    screened(plane, IMAGE)
    steep = GROUND.copy()
    steep[:, 1] = 43.0 + 0.5 * (steep[:, 0] - 5.0)
    with pytest.raises(FitError, match="on the ground they lie in a plane"):
        screened(steep, IMAGE)


@pytest.mark.parametrize("lat", [0.0, 60.0, -80.0])
def test_a_mirrored_image_is_found_at_any_latitude(lat: float) -> None:
    """Pixels are square in metres, not in degrees, which are shorter near the poles."""
    image = np.random.default_rng(3).uniform(0, 1e4, (300, 2))
    ground = np.column_stack(
        [
            5.0 + image[:, 0] * 1e-5 / np.cos(np.radians(lat)),
            lat - image[:, 1] * 1e-5,
            np.random.default_rng(4).uniform(0, 500, 300),
        ]
    )
    assert [screened(ground, image * [sign, 1.0])[2] for sign in (1.0, -1.0)] == [False, True]
    oblong = ground * [2.3, 1.0, 1.0]  # pixels twice as wide as high are no swapped columns
    assert not screened(oblong, image * [-1.0, 1.0])[2]


@pytest.mark.parametrize(("spread", "plane"), [(0.9e-3, False), (1.2e-3, True)])
def test_altitudes_within_a_millimetre_are_one(spread: float, plane: bool) -> None:
    """A plane that rises by so little is taken for level ground, which is fitted for its altitude; one more is none."""
    given = GROUND.copy()
    given[:, 2] = 100.0 + spread * (given[:, 0] - given[:, 0].min()) / np.ptp(given[:, 0])
    with pytest.raises(FitError, match="on the ground they lie in a plane") if plane else nullcontext():
        assert len(screened(given, IMAGE)[0]) == len(GROUND)


@pytest.mark.parametrize(("distinct", "ok"), [(39, False), (40, True)])
def test_points_that_repeat_are_too_few(distinct: int, ok: bool) -> None:
    rows = np.arange(60) % distinct
    with nullcontext() if ok else pytest.raises(FitError, match="only 39 of 60 are distinct"):
        assert len(screened(GROUND[rows], IMAGE[rows])[0]) == 60


def test_nodes_run_from_end_to_end() -> None:
    for even in (True, False):
        for low, high in ((-0.5, 99.5), (100.0, 300.0), (-7.0, -7.0), (1e6, 1e6 + 1)):
            found = spaced(low, high, 7, even)
            assert found[[0, 3, 6]] == pytest.approx([low, 0.5 * (low + high), high], abs=1e-9)
            assert (np.diff(found) >= 0).all()
    np.testing.assert_allclose(np.diff(spaced(0.0, 6.0, 7, even=True)), 1.0)
    np.testing.assert_allclose(spaced(0.0, 2.0, 5), 1 - np.cos(np.pi * np.arange(5) / 4))


def test_an_altitude_range_is_an_interval_of_a_hundred_metres_or_more() -> None:
    assert widened((0.0, 900.0)) == (0.0, 900.0)
    assert widened((10.0, 30.0)) == pytest.approx((-30.0, 70.0))
    for wrong in ((1.0, 0.0), (np.nan, 1.0), (0.0, np.nan), (0.0, np.inf), (-np.inf, 0.0)):
        with pytest.raises(FitError, match="is not an interval"):
            widened(wrong)
    np.testing.assert_array_equal(column_ranges(GROUND), [GROUND.min(axis=0), GROUND.max(axis=0)])
