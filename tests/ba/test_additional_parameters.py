"""Splines, steps, parts of images and sinusoids as unknowns: their columns, bands and corrections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.ba.parameters.additional_parameters import AdditionalParameters


def test_unknowns_of_waves_are_about_as_large_within_half_an_octave() -> None:
    bands = AdditionalParameters(13, np.zeros((2, 3))).bands
    m, s, strips, swings = AdditionalParameters(13, np.zeros((2, 3))).parts
    assert strips == swings == 0
    assert (m, s) == (10, 2)  # a shift and a scale of the columns are not theirs
    # of 3, 4, 5, ... half waves: between powers of the root of two
    expected = [0, 1, 1, 2, 2, 3, 3, 3, 3, 4]
    assert bands.tolist() == [*expected, *expected, *[5] * 2 * s]
    assert AdditionalParameters(0, np.zeros((1, 1))).bands.tolist() == [0, 0]
    assert AdditionalParameters(0, np.zeros((1, 1))).parts == (0, 1, 0, 0)
    both = AdditionalParameters(13, np.zeros((2, 3)), np.zeros((2, 4, 5)))  # strips are as large as each other
    assert both.bands.tolist() == [*expected, *expected, *[5] * 2 * s, *[6] * 8]
    assert AdditionalParameters(0, np.zeros((2, 0)), np.zeros((2, 4, 5))).bands.tolist() == [0] * 8
    assert AdditionalParameters(9).size == 2 * 6


def test_unknowns_of_another_layout_are_gone_on_from_where_they_are_the_same() -> None:
    """Splines of as many, strips and one more, swings of as many; detectors are asked again."""
    strips, edges = np.zeros((2, 2, 5)), np.zeros((2, 1))
    known = AdditionalParameters(9, edges, strips[:, :1], np.zeros((2, 1)))
    more = replace(known, steps=strips)
    params = np.random.default_rng(0).normal(size=(2, known.size))
    found = more.carried(params, known)
    for kind in (0, 3):
        np.testing.assert_array_equal(found[:, more.kinds[kind]], params[:, known.kinds[kind]])
    assert not found[:, more.kinds[1]].any()
    col, row = params[:, known.kinds[2]].T
    np.testing.assert_array_equal(found[:, more.kinds[2]].T, [col, 0.0 * col, row, 0.0 * row])
    assert not replace(known, count=11).carried(params, known)[:, : 2 * 8].any()
    assert not AdditionalParameters(0, periods=np.zeros((2, 2))).carried(params, known).any()
    assert not AdditionalParameters(0, steps=strips).carried(params[:, known.kinds[0]], AdditionalParameters(9)).any()


PERIODS = np.array([[200.0, 31.5], [np.inf, np.inf], [700.0, np.inf]])


def test_swings_are_cosines_and_sines_of_the_row_seen() -> None:
    waves = AdditionalParameters(0, np.zeros((3, 0)), np.zeros((3, 0, 5)), PERIODS)
    assert waves.parts == (0, 0, 0, 4)
    assert waves.size == 8
    assert waves.bands.tolist() == [0] * 8
    row, index = np.tile([0.0, 50.0, 333.3], 3), np.repeat([0, 1, 2], 3)
    (basis,) = waves.basis(np.zeros(9), np.stack([row * 0.0, row]), index)
    assert not basis[:, 3:6].any()
    params = np.arange(1.0, 9.0)
    for view in range(3):
        made = waves.correction(params, view, 0.0, 1.0)
        assert made.periods.tolist() == PERIODS[view][np.isfinite(PERIODS[view])].tolist()
        moved = made.at(np.column_stack([np.zeros(3), row[:3]]))
        here = slice(3 * view, 3 * view + 3)
        np.testing.assert_allclose(moved, (params.reshape(2, 4) @ basis[:, here]).T, atol=1e-12)
    # a column's cosine of the first swing of view 0
    np.testing.assert_allclose(basis[0, :3], np.cos(2 * np.pi * row[:3] / 200.0), atol=1e-12)


def test_an_error_that_neighbours_share_is_another_in_every_half_of_a_wave() -> None:
    none, strips = np.zeros((3, 0)), np.zeros((3, 0, 5))
    assert AdditionalParameters(13, none, strips).stretches(9000.0) == AdditionalParameters(13).size
    of_waves = 9000.0 / 200.0 + 9000.0 / 31.5
    assert AdditionalParameters(0, none, strips, PERIODS).stretches(9000.0) == pytest.approx(4.0 * of_waves)
    assert AdditionalParameters(13, none, strips, PERIODS).stretches(9000.0) == pytest.approx(
        AdditionalParameters(13).size + 4.0 * of_waves
    )
    assert AdditionalParameters(0, none, strips, 1e9 * PERIODS).stretches(9000.0) == 8  # as many as there are unknowns


@pytest.mark.parametrize("count", [1, 2, 7])
def test_steps_leave_a_shift_and_a_scale_to_others(count: int) -> None:
    waves, col = AdditionalParameters(0, np.arange(count)[None] + 0.5), np.arange(count + 1.0)  # one of each detector
    steps = waves.basis(0.0 * col, np.stack([col, col]), np.zeros(count + 1, dtype=int))[0].T
    assert steps.shape == (count + 1, max(count - 1, 1))
    place = np.linspace(-1, 1, count + 1)
    np.testing.assert_allclose(steps.T @ np.ones(count + 1), 0.0, atol=1e-12)
    if count > 1:
        np.testing.assert_allclose(steps.T @ place, 0.0, atol=1e-12)
    np.testing.assert_allclose(steps.T @ steps, np.eye(steps.shape[1]), atol=1e-12)


def test_a_view_without_edges_has_no_steps_and_one_with_fewer_its_own() -> None:
    waves = AdditionalParameters(0, np.array([[5.0, 9.0], [7.0, np.inf], [np.inf, np.inf]]))
    col, index = np.tile([4.9, 5.0, 8.0, 9.5], 3), np.repeat([0, 1, 2], 4)
    (basis,) = waves.basis(np.zeros(12), np.stack([col, col * 0.0]), index)
    levels = np.array([1.0, -2.0, 1.0]) / np.sqrt(6.0)  # of three detectors all that is left
    place = [0, 1, 1, 2, 0, 0, 1, 1]
    np.testing.assert_allclose(np.sign(basis[0, 0]) * basis[:, :8], levels[None, place])
    assert not basis[:, 8:].any()
    params = np.array([0.5, -0.25])
    for view, edges in ((0, [5.0, 9.0]), (1, [7.0]), (2, [])):
        made = waves.correction(params, view, 0.0, 1.0)
        assert made.detector_edges.tolist() == edges
        moved = made.at(np.column_stack([col[:4], np.zeros(4)]))
        expected = np.outer(basis[0, 4 * view : 4 * view + 4], params)
        np.testing.assert_allclose(moved, expected, atol=1e-12)
