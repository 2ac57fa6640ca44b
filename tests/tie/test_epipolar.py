"""Where a point of one image lies in another: segments, affine functions, what agrees with them."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.base.statistics import robust_spread
from barpc.tie.pairing.epipolar import (
    Affine,
    coherent,
    common_range,
    epipolar_segments,
    grouped,
    linear_map,
    robust_affine,
)
from tests.tie.conftest import Rendered


def test_a_frame_predicts_where_a_point_lies_at_any_altitude(scene: Rendered) -> None:
    one, two = (view.sensor for view in scene.views)
    xy = np.random.default_rng(0).uniform(0, 300, (50, 2))
    low, high = common_range(*scene.views)
    where = epipolar_segments(*scene.views, xy)
    assert np.hypot(*where.axis) == pytest.approx(1.0)
    for alt in np.linspace(low, high, 5):
        seen = two.project(one.localize(xy, np.full(50, alt)))
        errors = where.errors(seen)
        expected = where.after * (2 * (alt - low) / (high - low) - 1)
        np.testing.assert_allclose(errors[:, 0], expected, atol=0.02)
        np.testing.assert_allclose(errors[:, 1], 0, atol=0.05)
    np.testing.assert_array_equal(where.before, -where.after)
    np.testing.assert_allclose(where.place(where.after), seen, atol=1e-6)
    along = np.linspace(-30, 30, 50)
    np.testing.assert_allclose(where.errors(where.place(along)), np.stack([along, 0 * along], 1), atol=1e-9)
    moved = where.moved(-2.0).errors(seen) - where.errors(seen)
    np.testing.assert_allclose(moved, [[0.0, 2.0]] * 50, atol=1e-9)
    turned = epipolar_segments(*scene.views, xy[:7], np.array([0.0, 1.0]))
    np.testing.assert_array_equal(turned.axis, [0.0, 1.0])
    np.testing.assert_allclose(turned.errors(turned.place(where.after[:7]))[:, 1], 0, atol=1e-9)


def test_the_linear_map_is_the_central_difference_at_one_altitude(scene: Rendered) -> None:
    one, two = (view.sensor for view in scene.views)
    xy, alt = np.array([[100.0, 200.0], [30.0, 40.0]]), np.full(2, np.mean(common_range(*scene.views)))
    found = linear_map(*scene.views, xy)
    for axis in (0, 1):
        step = np.eye(2)[axis]
        high, low = (two.project(one.localize(xy + s * step, alt)) for s in (0.5, -0.5))
        np.testing.assert_allclose(found[..., axis], high - low, atol=1e-4)


def test_an_affine_function_is_found_among_outliers_with_its_spread() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 5000, (400, 2))
    truth = 3.0 + 2e-4 * xy[:, 0] - 5e-4 * xy[:, 1]
    values = truth + rng.normal(0, 0.2, 400)
    values[::4] += rng.uniform(5, 50, 100)
    found = robust_affine(xy, values)
    assert isinstance(found, Affine)
    np.testing.assert_allclose(found(xy), truth, atol=0.1)
    assert 0.2 < found.spread < 0.4  # a quarter is wrong
    clean = robust_affine(xy, truth + rng.normal(0, 0.2, 400))
    assert clean.spread == pytest.approx(0.2, rel=0.12)
    constant = robust_affine(xy[:29], truth[:29])
    assert (constant.coefficients[1:] == 0).all()
    assert (robust_affine(xy[:30], truth[:30]).coefficients[1:] != 0).all()


def test_an_affine_function_is_that_of_its_own_weights() -> None:
    """Tukey's biweight at the end of the iteration: the weighted residuals are orthogonal to 1, x and y."""
    rng = np.random.default_rng(6)
    xy = rng.uniform(0, 5000, (400, 2))
    values = 1e-3 * xy[:, 0] + rng.normal(0, 0.2, 400)
    values[:120] += rng.uniform(1, 10, 120)
    residual = values - robust_affine(xy, values)(xy)
    weight = np.maximum(0.0, 1.0 - (residual / (4.685 * robust_spread(residual))) ** 2) ** 2
    design = np.column_stack([np.ones(400), (xy - 2500) / 5000])
    assert np.abs(design.T @ (weight * residual)).max() < 1e-3 * np.abs(design.T @ np.abs(residual)).max()


@pytest.mark.parametrize("scale", [0.02, 1000.0])
def test_an_affine_function_of_values_of_any_size_is_the_same(scale: float) -> None:
    """A third is wrong by up to fifty standard deviations: from the median it takes several steps."""
    rng = np.random.default_rng(6)
    xy = rng.uniform(0, 5000, (400, 2))
    values = 1e-3 * xy[:, 0] + rng.normal(0, 0.2, 400)
    values[:130] += rng.uniform(0.5, 10, 130)
    exact = robust_affine(xy, values)
    found = robust_affine(xy, scale * values)
    np.testing.assert_allclose(found.coefficients / scale, exact.coefficients, atol=2e-3)
    assert found.spread / scale == pytest.approx(exact.spread, rel=2e-3)


def test_the_mad_is_about_zero_or_about_a_centre_of_every_row() -> None:
    shifted = np.array([8.0, 10.0, 13.0])  # of residuals the shift counts, of a sample about its median it does not
    assert robust_spread(shifted) == pytest.approx(1.4826 * 10.0)
    found = robust_spread(np.stack([shifted, -shifted]), np.array([[10.0], [0.0]]))
    assert found == pytest.approx([1.4826 * 2, 1.4826 * 10])


@pytest.mark.parametrize("size", [0.0, 0.5, 3.0, -12.0, 40.0])
@pytest.mark.parametrize(("axis", "part"), [(1, 0.1), (1, 0.5), (1, 0.9), (0, 0.3)])
def test_what_neighbours_share_stays_wherever_an_image_jumps_and_what_stands_alone_goes(axis, part, size) -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 1000, (900, 2))
    beyond = xy[:, axis] > 1000 * part
    values = 3.0 + 2e-3 * xy[:, 0] + rng.normal(0.0, 0.08, 900) + np.where(beyond, size, 0.0)
    alone = rng.choice(900, 90, replace=False)
    away = rng.choice([-1.0, 1.0], 90) * rng.uniform(0.8, 2.0, 90)
    values[alone] += np.where(np.abs(np.abs(away) - abs(size)) < 0.4, 2.4 * np.sign(away), away)
    keep, residual = coherent(xy, values)
    sound = np.delete(np.arange(900), alone)
    assert keep[sound].mean() > 0.99
    assert keep[alone].mean() < 0.02
    near = np.abs(xy[sound, axis] - 1000 * part) < 40  # beside an edge too
    assert keep[sound][near].mean() > 0.93
    assert robust_spread(residual) == pytest.approx(0.09, abs=0.02)  # the jump is no noise


def test_a_swing_is_no_outlier_and_normal_noise_is_cut_at_about_three_deviations() -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, 1000, (2000, 2))
    swing = 1.5 * np.sin(2 * np.pi * xy[:, 1] / 400)
    assert coherent(xy, swing + rng.normal(0.0, 0.1, 2000))[0].mean() > 0.94
    noise = rng.normal(0.0, 1.0, 2000)
    keep = coherent(xy, noise)[0]
    assert keep[np.abs(noise) < 2.5].all()
    assert not keep[np.abs(noise) > 4.0].any()
    few = coherent(xy[:12], np.append(np.zeros(11), 1.0))[0]
    assert np.flatnonzero(~few).tolist() == [11]
    for count in (0, 1):
        assert coherent(xy[:count], noise[:count])[0].tolist() == [True] * count


def test_a_frames_linear_map_is_that_of_the_middle_of_the_points_that_are_seen(scene: Rendered) -> None:
    xy = np.random.default_rng(0).uniform(100, 5000, (51, 2))
    xy[:3] = np.nan
    with np.errstate(all="ignore"):
        where = epipolar_segments(*scene.views, xy)
    expected = linear_map(*scene.views, np.median(xy[3:], axis=0))
    np.testing.assert_array_equal(where.linear, expected)
    assert np.abs(linear_map(*scene.views, np.zeros(2)) - expected).max() > 1e-7
    assert np.isnan(where.slope[:3]).all()
    assert np.isfinite(where.slope[3:]).all()


def test_rows_aregrouped_by_equal_keys() -> None:
    a, b = np.array([1, 0, 1, 1, 0]), np.array([2, 5, 2, 1, 5])
    groups = grouped(a, b)
    assert [group.tolist() for group in groups] == [[1, 4], [3], [0, 2]]
    assert grouped(a[:0], b[:0]) == []
