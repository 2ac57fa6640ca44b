"""Interior distortion that images of a sensor share: against blocks adjusted anew, and lines of other shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks, pair_heights
from barpc.ba.interior import Calibration, CommonErrors
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.report import Run, summarize
from barpc.sensor.image_corrections import ColumnSpline
from barpc.sensor.triangulation import intersect_pair
from barpc.simulate import SimulatedBlock, simulate_block
from benchmarks.calibrate import PERFECT, Scene, Sensor, bent_as_said, crossing, in_track, scene
from tests.ba.conftest import as_stated, centers_of, least_squares
from tests.constants import Sized

WIDTH = 2000
STATED = AdjustOptions(jitter="off", drift=1, noise_floor=0.0, min_convergence=0.01, sigma_attitude=2.0,
                       sigma_position=1.0, model="rotation+translation")  # fmt: skip


def of_two_modes(seed: int, key: str) -> Calibration:
    """A sensor whose curve has two errors, of all columns, and a detector of its own."""
    rng = np.random.default_rng(seed)
    spline = ColumnSpline(WIDTH, rng.normal(0, 0.1, (28, 2)), np.array([900.5]), np.array([[0.1, -0.2]]))
    root = rng.normal(0, 0.05, (2 * 29, 2))
    return Calibration("", spline, root @ root.T, "", key)


def terrain(block: SimulatedBlock) -> dict[str, object]:
    def flat(lon: Array, lat: Array) -> Array:
        return np.full(np.shape(lon), block.truth.ground[:, 2].mean())

    return {"dem": flat}


@pytest.mark.parametrize("held", [False, True])
@as_stated()
def test_points_and_the_scene_move_as_in_a_block_adjusted_anew(held: bool) -> None:
    """Observations that one error moved by its standard deviation; with heights whose errors are common, too."""
    block = simulate_block(4, 250, seed=3, size=(WIDTH, 2000), noise=0.05, alt_range=(200.0, 210.0))
    common = CommonErrors((of_two_modes(1, "a"), of_two_modes(2, "b"), None, of_two_modes(1, "a")))
    given = {"hold_out": False, "centers": centers_of(block), **(terrain(block) if held else {})}
    options = replace(STATED, dem_sigma=5.0, dem_bias_sigma=2.0) if held else STATED
    found = adjust_tracks(block.views, block.tracks, options, common=common, **given)
    plain = adjust_tracks(block.views, block.tracks, options, **given)
    np.testing.assert_array_equal(found.points, plain.points)
    assert (found.covariance.reduced.common is not None) == held
    shared = found.covariance.shared.by_unknown
    np.testing.assert_allclose(found.covariance.full, plain.covariance.full + shared @ shared.T)
    index = np.flatnonzero(np.isfinite(plain.points).all(axis=1))
    moves, moved = found.covariance.shared_moves(index), common.moved(block.tracks.view, block.tracks.xy[:, 0])
    view, seen = block.views[0], np.zeros((2, 0))
    middle = view.sensor.localize((np.array(view.size) - 1) / 2, view.altitude)
    in_image = common.moved(np.array([0]), plain.sensors[0].project(middle)[:1])[:, 0].T
    assert moves.shape[2] == len(moved) == common.count == 4
    assert not moved[:, block.tracks.view == 2].any()
    rows = [np.flatnonzero(block.tracks.view == view) for view in (0, 1)]
    both, *at = np.intersect1d(*(block.tracks.point[own] for own in rows), return_indices=True)
    rows, heights = [own[one] for own, one in zip(rows, at, strict=True)], np.zeros((len(both), 0))
    alt = ground_from_ecef(plain.points[both])[:, 2]
    for k in range(4):
        ends, levels = [], []
        for sign in (1, -1):
            tracks = replace(block.tracks, xy=block.tracks.xy + sign * moved[k])
            problem, end = least_squares(
                replace(block, tracks=tracks.select(plain.inlier)), options, plain.noise, given.get("dem")
            )
            sensors = problem.cameras.unknowns.corrected(end.state.params, block.views)
            ends.append((sensors[0], end.state))
            levels.append(intersect_pair(sensors[:2], [tracks.xy[own] for own in rows], alt)[:, 2])
        heights = np.column_stack([heights, (levels[0] - levels[1]) / 2])
        wanted = (ends[0][1].params - ends[1][1].params).ravel() / 2
        np.testing.assert_allclose(shared[:, k], wanted, atol=0.02 * np.abs(wanted).max())
        wanted = (ends[0][1].points - ends[1][1].points)[index] / 2
        np.testing.assert_allclose(moves[..., k], wanted, atol=0.02 * np.abs(wanted).max())
        change = (ends[0][0].project(middle) - ends[1][0].project(middle)) / 2
        seen = np.column_stack([seen, change - in_image[:, k]])
    pairs = [pair_heights(one, 0, 1) for one in (plain, found)]
    for name, off in (("absolute", heights), ("relative", heights - heights.mean(axis=0))):
        before, after = (getattr(one, name) for one in pairs)
        assert after**2 - before**2 == pytest.approx((off**2).sum(axis=1).mean(), rel=0.05), name
    # what cameras follow of a displacement is not off in the image
    runs = [Run("adjust", block.views, (), block.tracks, adjustment=one) for one in (plain, found)]
    before, after = (np.array(summarize(run).views[0].correction.center_sigma_px) for run in runs)
    np.testing.assert_allclose(after**2 - before**2, (seen**2).sum(axis=1), rtol=0.03)
    some = index[::7]
    more = found.covariance.points(some) - plain.covariance.points(some)
    np.testing.assert_allclose(more, moves[::7] @ np.swapaxes(moves[::7], 1, 2), atol=1e-9)
    # the mean of the points is the scene's place
    enu = enu_basis(ground_from_ecef(plain.points[index].mean(axis=0)))
    mean = enu @ moves.mean(axis=0)
    wanted = np.sqrt(plain.gauge.sigma**2 + (mean**2).sum(axis=1))
    np.testing.assert_allclose(found.gauge.sigma, wanted, rtol=1e-3)
    assert plain.datum.keys() == found.datum.keys()
    for source, shares in plain.datum.items():  # of what is known, not of what is not
        np.testing.assert_allclose(found.datum[source], shares, atol=1e-9)


@pytest.mark.parametrize("most", [0, 10**6])
@as_stated()
def test_what_images_share_is_in_every_covariance_sparse_and_dense(sized: Sized, most: int) -> None:
    sized(dense_views=most)
    block = simulate_block(6, 250, seed=3, size=(WIDTH, 2000), noise=0.05)
    common = CommonErrors((of_two_modes(1, "a"), None, of_two_modes(2, "b"), *(of_two_modes(1, "a"),) * 3))
    given = {"hold_out": False, "centers": centers_of(block)}
    options = replace(STATED, solver="sparse")
    own, found = (adjust_tracks(block.views, block.tracks, options, common=one, **given).covariance
                  for one in (CommonErrors((None,) * 6), common))  # fmt: skip
    assert found.factor.method == ("dense" if most else "multifrontal")
    q, shared = own.num_unknowns, found.shared.by_unknown
    more = shared @ shared.T
    whole = own.joint(np.arange(6)) + more
    tolerance = 1e-7 * np.abs(whole).max()
    blocks = whole.reshape(6, q, 6, q)
    for i, j in ((0, 0), (0, 1), (1, 0), (5, 2), (2, 4)):
        np.testing.assert_allclose(found.view(i, j), blocks[i, :, j], atol=tolerance)
    np.testing.assert_allclose(found.of_views(), blocks[np.arange(6), :, np.arange(6)], atol=tolerance)
    np.testing.assert_allclose(found.variances().ravel(), np.diag(whole), atol=tolerance)
    np.testing.assert_allclose(
        found.joint(np.array([4, 0])), blocks[[4, 0]][:, :, [4, 0]].reshape(2 * q, -1), atol=tolerance
    )
    assert np.sqrt(np.diag(more)).max() > 1e-3 * np.sqrt(np.diag(whole)).max()


def curves(width: int, cols: Array) -> Array:
    """The curves (n, k) of the independent errors of a sensor's prior, along columns."""
    one = Calibration.prior("A", width)
    return np.asarray(one.curve.basis(cols) @ one.root[: one.curve.size])


def test_the_prior_has_the_size_that_is_stated_and_no_slope() -> None:
    """0.3 px of a whole line, next to none of a part of one detector; of steps at random columns beyond a detector."""
    size = {width: float(Calibration.prior("A", width).curve.sizes(Calibration.prior("A", width).covariance)[0])
            for width in (500, 6000, 30000)}  # fmt: skip
    assert size[30000] == pytest.approx(0.3, rel=0.02)
    assert size[500] < 0.07
    assert size[500] < size[6000] < size[30000]
    cols = np.arange(0.0, 30000.0, 100.0)
    found = curves(30000, cols)
    line = np.polynomial.polynomial.polyfit(cols / 3e4, found, 1)
    assert np.abs(line).max() < 0.02 * np.sqrt((found**2).sum(axis=1).max())

    def apart(distance: int) -> float:
        step = found[distance // 100 :] - found[: -(distance // 100)]
        return float((step**2).sum(axis=1).mean())

    assert apart(9000) / apart(3000) == pytest.approx((1 - np.exp(-3)) / (1 - np.exp(-1)), rel=0.15)


def test_sensors_err_apart_and_images_of_one_together() -> None:
    a, b = Calibration.prior("A", WIDTH), Calibration.prior("B", WIDTH)
    cols, one, other = np.linspace(0, WIDTH - 1.0, 5), np.zeros(5, dtype=int), np.ones(5, dtype=int)

    def covariance(common: CommonErrors, first: np.ndarray, second: np.ndarray) -> Array:
        moved = [common.moved(view, cols)[..., 1] for view in (first, second)]
        return np.asarray(moved[0].T @ moved[1])

    same, apart = CommonErrors((a, Calibration.prior("A", WIDTH))), CommonErrors((a, b))
    np.testing.assert_allclose(covariance(same, one, other), covariance(same, one, one))
    assert not covariance(apart, one, other).any()
    np.testing.assert_allclose(covariance(apart, other, other), covariance(apart, one, one))


def test_a_block_without_such_errors_has_none() -> None:
    block = simulate_block(2, 60, seed=1, size=(WIDTH, 2000))
    found = adjust_tracks(block.views, block.tracks, STATED, common=CommonErrors((None, None)), hold_out=False)
    assert found.covariance.shared is None
    assert np.isfinite(pair_heights(found, 0, 1).relative)


def with_prior(made: Scene) -> Adjustment:
    prior = Calibration.prior("A", made.views[0].size[0])
    return adjust_tracks(made.views, made.tracks, common=CommonErrors((prior,) * len(made.views)))


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["polynomials", "waves"])
@pytest.mark.parametrize("looks", [in_track, crossing])
def test_heights_that_a_distortion_bends_are_within_what_is_said(kind: str, looks: object) -> None:
    """Lines of other shapes than the prior's: unsaid before, now within three standard deviations, and not of ten."""
    ratio = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        made = scene(looks(rng), Sensor.made(kind, seed), rng, 400, noise=0.005, wrong=0.0)  # type: ignore[operator]
        ratio.append(bent_as_said(made, with_prior(made)))
    bent, cameras, said = np.array(ratio).T
    assert (bent < 3.0 * said).all()
    assert np.mean((bent / said) ** 2) > 0.01
    assert (bent > 3.0 * cameras).any() or looks is crossing


@pytest.mark.slow
def test_cameras_and_points_of_a_clean_block_stay_to_the_bit_and_nothing_is_known_better() -> None:
    rng = np.random.default_rng(5)
    made = scene(in_track(rng), PERFECT, rng, 300)
    plain, found = adjust_tracks(made.views, made.tracks), with_prior(made)
    np.testing.assert_array_equal(found.params, plain.params)
    np.testing.assert_array_equal(found.points, plain.points)
    np.testing.assert_array_equal(found.gcp_w, plain.gcp_w)
    index = np.flatnonzero(np.isfinite(plain.points).all(axis=1))[::10]
    more = found.covariance.points(index) - plain.covariance.points(index)
    assert np.linalg.eigvalsh(more).min() > -1e-9
    assert (found.gauge.motion_sigma >= plain.gauge.motion_sigma * (1 - 1e-9)).all()
    pairs = [pair_heights(one, 0, 1) for one in (plain, found)]
    assert pairs[1].relative > pairs[0].relative
    truth = ecef_from_ground(made.ground[index])
    assert np.linalg.norm(found.points[index] - truth, axis=1).max() < 60.0
