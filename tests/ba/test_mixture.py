"""The mixture of a linearised block, against likelihoods worked out otherwise."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from barpc.ba.evidence import linearised, mixture
from barpc.ba.evidence.linearised import Linear, TrackGroup
from barpc.ba.evidence.mixture import fit_mixture, log_likelihoods, residuals_from_inliers
from barpc.base.geodesy import Array
from barpc.base.statistics import SLIGHT
from barpc.simulate import simulate_block
from tests.ba.residuals import started
from tests.distributions import multivariate_normal


def linear_of(views: int = 3, tracks: int = 200, seed: int = 1, **options: object) -> Linear:
    """A block at its delivered cameras."""
    return started(simulate_block(views, tracks, seed=seed, **options)).linear()


@pytest.fixture(scope="module")
def linear() -> Linear:
    return linear_of()


def projector(tracks: TrackGroup) -> Array:
    """What takes away what the ground point follows (T, 2n, 2n), all views right."""
    weight = np.zeros((len(tracks.rows), len(tracks.subsets)))
    weight[:, 0] = 1.0
    return tracks.projectors(weight)


def test_all_views_or_all_but_one_may_be_right_and_two_at_least() -> None:
    tracks = {one.rows.shape[1]: one.subsets for one in linear_of(7, 60, per_site=7, visible=0.7).tracks}
    assert {2, 3, 4, 7} <= set(tracks)
    for n, found in tracks.items():
        assert found[0].all()
        assert len(np.unique(found, axis=0)) == len(found) == (n + 1 if n > 2 else 1)
        assert (found[1:].sum(axis=1) == n - 1).all()


def test_what_the_ground_point_follows_is_taken_away(linear: Linear) -> None:
    for tracks in linear.tracks:
        project = projector(tracks)
        np.testing.assert_allclose(project @ project, project, atol=1e-6)
        free = 2 * tracks.rows.shape[1] - 3
        np.testing.assert_allclose(np.trace(project, axis1=1, axis2=2), free, atol=1e-6)


def test_a_track_s_likelihood_is_the_integral_over_its_ground_point(linear: Linear) -> None:
    """A normal prior on the point, as wide as can be, in place of the integral."""
    tracks = linear.tracks[-1]
    n, noise, eps = tracks.rows.shape[1], 1.3, np.array([0.1, 0.2, 0.3])
    rng = np.random.default_rng(0)
    residual = linear.residual * 0.0
    residual[:, tracks.rows[0]] = rng.normal(size=(2, n))
    r = residual[:, tracks.rows[0]].T.ravel()
    found, subsets = mixture._track_posteriors(linear, residual, noise, eps), linear.subsets
    at = len(subsets.views) - len(tracks.rows)  # the first of the last group
    full = projector(tracks)[0]
    # what is left over of the identity is the space that the point spans
    ground = np.linalg.svd(np.eye(2 * n) - full)[0][:, :3] * 1e4
    marginal = multivariate_normal(np.zeros(2 * n), noise**2 * np.eye(2 * n) + ground @ ground.T).logpdf(r)
    flat = marginal + 0.5 * np.linalg.slogdet(2.0 * np.pi * (ground.T @ ground))[1]
    expected = flat + tracks.log_volume[0, 0] + np.log1p(-eps)[tracks.view[0]].sum()
    square = r @ full @ r
    said = (
        np.log1p(-eps)[tracks.view[0]].sum() + tracks.log_volume[0, 0] - square / (2 * noise**2)
        - 0.5 * (2 * n - 3) * np.log(2 * np.pi * noise**2)
    )  # fmt: skip
    assert said == pytest.approx(expected, abs=1e-4)
    assert found.subsets[0].square[subsets.begins[1][at]] == pytest.approx(square)
    assert found.log[at] >= said - 1e-9
    np.testing.assert_allclose(np.bincount(subsets.of_subset, found.shares[0]) <= 1.0 + 1e-12, True)


@pytest.mark.slow
def test_the_true_noise_and_the_true_share_of_outliers_are_found() -> None:
    found = fit_mixture(linear_of(3, 1500, outliers=0.2))
    assert found.noise == pytest.approx(1.0, rel=0.05)
    assert found.eps.mean() == pytest.approx(0.2, abs=0.04)
    assert 0.75 < found.right.mean() < 0.85


def test_noise_ends_where_it_is_held_and_explains_less_then() -> None:
    block = linear_of(tracks=400)
    free = fit_mixture(block)
    held = fit_mixture(block, noisiest=0.5 * free.noise)
    assert held.noise == 0.5 * free.noise
    assert held.evidence < free.evidence
    assert held.right.sum() < free.right.sum()
    assert fit_mixture(block, noisiest=2.0 * free.noise).noise == free.noise


def test_an_unknown_that_explains_nothing_costs_the_room_that_it_takes(linear: Linear) -> None:
    base = fit_mixture(linear)
    extra = np.zeros((2, 1, len(linear.view)))
    extra[0, 0, linear.view == 1] = np.where(np.arange((linear.view == 1).sum()) % 2, 1.0, -1.0)
    costs = [base.evidence - fit_mixture(linear, extra, np.array([sigma])).evidence for sigma in (1.0, 10.0, 100.0)]
    np.testing.assert_allclose(np.diff(costs), np.log(10.0), atol=0.02)
    assert costs[0] > 2.0


def test_what_was_put_in_comes_out_warm_or_cold(linear: Linear) -> None:
    rows = (linear.view == 0) & (np.arange(len(linear.view)) % 3 == 0)
    extra = np.zeros((2, 2, len(rows)))
    extra[0, 0] = extra[1, 1] = rows
    moved = replace(linear, residual=linear.residual - rows * np.array([[8.0], [-5.0]]))
    found = [fit_mixture(moved, extra, np.full(2, 1.0), warm) for warm in (None, fit_mixture(moved))]
    for one in found:
        np.testing.assert_allclose(one.extra, np.array([8.0, -5.0]) * 0.1, atol=0.05)
    assert found[0].evidence == pytest.approx(found[1].evidence, abs=0.5)
    assert found[0].evidence > fit_mixture(moved).evidence + 100.0


def test_a_track_s_likelihood_falls_where_it_is_displaced(linear: Linear) -> None:
    found = fit_mixture(linear)
    left = linear.residual_after(found.step)
    away = left.copy()
    away[:, linear.view == 0] += 20.0
    change = log_likelihoods(linear, away, found) - log_likelihoods(linear, left, found)
    assert (change[linear.view == 0] < 1e-6).mean() > 0.95


def test_the_same_block_gives_the_same_bits(linear: Linear) -> None:
    one, other = fit_mixture(linear), fit_mixture(linear)
    assert (one.step == other.step).all()
    assert one.evidence == other.evidence


def test_what_is_wrong_is_seen_from_where_the_right_ones_put_the_point(linear: Linear) -> None:
    """Noise of one standard deviation, of right and wrong ones alike, and an offset that only the others can tell."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=linear.residual.shape)
    wrong = linear.in_tracks & (linear.view == 1)
    right = (~wrong).astype(np.float64)
    off, known = residuals_from_inliers(linear, noise, right)
    tracks = {tracks.rows.shape[1]: tracks for tracks in linear.tracks}
    pairs, triples = tracks[2].rows, tracks[3].rows
    assert not known[pairs].any()  # one other does not tell a point
    assert known[triples][tracks[3].view == 1].all()
    assert not known[triples][tracks[3].view != 1].any()
    of_wrong = triples[tracks[3].view == 1]
    assert off[:, of_wrong].std() == pytest.approx(1.0, abs=0.12)
    moved = noise + 8.0 * wrong
    seen, _ = residuals_from_inliers(linear, moved, right)
    assert np.median((seen - off)[:, of_wrong]) > 5.0
    others = triples[tracks[3].view != 1]
    np.testing.assert_allclose(seen[:, others], off[:, others], atol=1e-3)  # nothing of it is theirs
    all_alike, _ = residuals_from_inliers(linear, moved, np.ones_like(right))
    assert np.median(np.abs(all_alike - off)[:, others]) > 1.0
    with_point = linear.tracks[-1]
    project = projector(with_point)  # with all of them right: what the mixture takes away
    left = (project @ noise.T[with_point.rows].reshape(len(project), -1, 1))[..., 0]
    spread = np.sqrt(np.maximum(np.diagonal(project, axis1=1, axis2=2), 0.1))
    whole, _ = residuals_from_inliers(linear, noise, np.ones_like(right))
    np.testing.assert_allclose(whole.T[with_point.rows].reshape(left.shape), left / spread, atol=1e-4)


@pytest.mark.parametrize("most", [1, 2, 4, 60])
def test_the_evidence_is_of_the_curvature_at_the_end(linear: Linear, monkeypatch, most: int) -> None:
    """However many iterations: the last sum is that of the last expectations, and few are summed in all."""
    seen, summed = [], []
    expected, curvature = mixture.Mixture._expectations, mixture.Mixture._curvature
    monkeypatch.setattr(mixture.Mixture, "_expectations", lambda self: seen.append(expected(self)) or seen[-1])
    monkeypatch.setattr(
        mixture.Mixture,
        "_curvature",
        lambda self, weight, beside: summed.append(weight) or curvature(self, weight, beside),
    )
    one = mixture.Mixture(linear, None, None, None)
    found = one.run(most)
    assert summed[-1] is seen[-1].kinds[0].weight
    assert len(seen) <= most
    if most == 60:
        assert len(summed) < len(seen)
    matrix = one.curvature[0] / found.noise**2 + np.diag(linear.precision)
    away = linear.offset + found.step.ravel()
    if most == 60:  # the noise stands
        room = np.linalg.slogdet(matrix)[1] - np.log(linear.precision).sum()
        said = seen[-1].log - 0.5 * linear.precision @ away**2 - 0.5 * room
        assert found.evidence == pytest.approx(said, abs=0.5)


def test_noise_that_falls_does_not_stand(linear: Linear) -> None:
    one = mixture.Mixture(linear, None, None, None)
    one.cooled, noises, stands = mixture.COOLED, [one.noise], list[bool]()
    for _ in range(30):
        stands.append(one._update_noise(one._expectations(), 0.0))
        noises.append(one.noise)
    falls = np.array(noises[1:]) / noises[:-1]
    assert falls[0] == pytest.approx(mixture.COOLED)
    assert stands == [abs(np.log(part)) < SLIGHT for part in falls]
    assert (stands[0], stands[-1]) == (False, True)


@pytest.mark.parametrize("wrong", [-1, 2])
def test_a_first_guess_has_the_least_sum_of_distances(linear: Linear, wrong: int) -> None:
    """Of what all tracks are off by, points following, against the same steps written track by track.

    Without a view its observations, where there are two others, neither count nor hold the point.
    """
    rng = np.random.default_rng(2)
    moved = replace(linear, residual=linear.residual + rng.normal(0.0, 3.0, linear.residual.shape))
    base = replace(fit_mixture(linear), noise=1.5)
    old, new = rng.normal(size=(2, 1, len(linear.view))), np.zeros((2, 2, len(linear.view)))
    new[0, 0] = new[1, 1] = (linear.view == 1) & (np.arange(len(linear.view)) % 2 == 0)
    base = replace(base, extra=np.array([0.2]))
    precision = np.array([7.0, 0.5, 0.25])
    left = moved.residual_after(base.step) + old[:, 0] * 0.2 / linear.sigma
    parts = []
    for tracks in linear.tracks:
        project = projector(tracks)
        for k in np.flatnonzero((tracks.view == wrong).any(axis=1) & (tracks.rows.shape[1] > 2)):
            subset = (tracks.subsets == (tracks.view[k] != wrong)).all(axis=1)
            project[k] = tracks.projectors(np.tile(subset.astype(float), (len(tracks.rows), 1)))[k]
        for row, one in zip(tracks.rows, project, strict=True):
            columns = (new / linear.sigma)[:, :, row].transpose(2, 0, 1).reshape(-1, 2)
            if columns.any():
                parts.append((one @ left[:, row].T.ravel(), one @ columns))
    found, without = np.zeros(2), sum(np.sqrt((off**2).sum() + 1.5**2) for off, _ in parts)
    for _ in range(6):
        far = [np.sqrt(((off + by @ found) ** 2).sum() + 1.5**2) for off, by in parts]
        matrix = np.diag(precision[1:])
        gradient = precision[1:] * found
        for (off, by), d in zip(parts, far, strict=True):
            matrix = matrix + by.T @ by / d
            gradient = gradient + by.T @ (off + by @ found) / d
        found = found - np.linalg.solve(matrix, gradient)
    guess, middle, total = mixture.first_guess(moved, base, old, new, precision, wrong)
    np.testing.assert_allclose(guess, found, rtol=1e-6)
    assert middle == pytest.approx(np.median(far), rel=1e-6)
    assert total == pytest.approx((sum(far) - without) / 1.5, rel=1e-6)
    assert total < -1.0


def test_a_wrong_match_lies_in_an_image_or_along_an_epipolar_line() -> None:
    """Its area in units of the noise: as wide as residuals are far, as long as heights of the span shift the ends."""
    made = simulate_block(4, 60, seed=1)
    block, problem, state, _ = start = started(made)
    projected = problem.project_points(state.params, state.points)
    by_point, left = projected.by_point / block.sigma, (projected.image - problem.xy) / block.sigma
    size = np.array([view.size for view in made.views])
    image = np.median(size.prod(axis=1)) / np.median(block.sigma) ** 2
    metre = np.median(np.sqrt((by_point**2).sum(axis=1)))
    shifts = []
    for point in range(block.num_points):
        rows = np.flatnonzero(block.point == point)
        rows = rows[np.argsort(block.view[rows])][[0, -1]]
        ends = by_point[:, :, rows].transpose(2, 0, 1).reshape(4, 3)
        shifts.append(np.linalg.svd(ends, compute_uv=False).prod() / metre**2)
    far = max(np.quantile(np.hypot(*left), 0.99), 5.0)
    for span in (800.0, 0.5):
        found = start.linear(span)
        assert found.image_area == pytest.approx(image, rel=1e-3)
        assert found.area == pytest.approx(2 * far * max(2 * far, np.median(shifts) * max(span, 1.0)), rel=1e-3)
        assert found.choices == 4
        np.testing.assert_allclose(found.precision, problem.camera_prior.sigma.ravel() ** -2.0)


def test_numbers_of_a_mixture_are_those_of_its_subsets() -> None:
    """Six of each view of every subset: all, and all but one."""
    assert linearised.array_elements(np.array([2, 3, 4])) == 6 * (3 * 2 + 4 * 3 + 5 * 4)
    assert linearised.array_elements(np.array([5, 12])) == 6 * (6 * 5 + 13 * 12)


def test_a_track_moves_by_the_share_of_what_is_right_of_it_that_moves() -> None:
    """Something of three tracks is right with 0.7, 0.3 and 0.2, of which 0.1, 0 and all is where it moved."""
    nothing, stands = np.zeros(3), np.array([0.4, 0.2, 0.3, 0.0, 0.0, 0.0])
    moves = np.array([0.05, 0.05, 0.0, 0.0, 0.2, 0.0])
    subsets = SimpleNamespace(begins=(nothing, np.array([0, 2, 4])))
    gone = mixture._TrackPosteriors(nothing, nothing, [stands, moves], []).moved(subsets)
    np.testing.assert_allclose(gone, [0.1 / 0.7, 0.0, 1.0])
