"""What the adjustment says it does not know is what it does not know: Monte-Carlo against prediction."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import chdtri, ndtr

from barpc.ba import AdjustOptions, adjust_tracks, block_prior
from barpc.ba.constraints.incremental import BlockPrior
from barpc.ba.parameters.priors import DRIFT_SIGMA
from barpc.base.errors import InputError
from barpc.base.geodesy import ecef_from_ground, enu_basis
from barpc.scene import Tracks
from barpc.simulate import SimulatedBlock, simulate_block
from tests.ba.conftest import as_stated, centers_of, of_noise_as_stated, seen, solve
from tests.lanes import known

SIGMA_ATTITUDE, SIGMA_POSITION, NOISE = 4.0, 1.0, 0.1
DEFAULTS = AdjustOptions(
    sigma_attitude=SIGMA_ATTITUDE, sigma_position=SIGMA_POSITION, noise_floor=0.0, min_convergence=0.01
)
"""All that is on by default: robust rounds, estimated noise, drift, priors that learn; noise that averages away."""
OPTIONS = replace(DEFAULTS, drift=0)


@dataclass(frozen=True)
class Trials:
    """Errors of many adjustments of one block, each with corrections and noise of its own, by their sigmas."""

    nees: np.ndarray
    scene: np.ndarray  # (trials, 3) of the mean of all points, east, north, up
    unknowns: int

    def scene_as_predicted(self) -> None:
        """Squared errors by the variance that each trial states itself: chi-square, within four sigma.

        A trial whose priors are widened states more than others, and is rightly asked less.
        """
        count = len(self.scene)
        few, many = chdtri(count, [1.0 - ndtr(-4.0), ndtr(-4.0)])
        squares = (self.scene**2).sum(axis=0)
        assert (few < squares).all()
        assert (squares < many).all()


def run_trials(block: SimulatedBlock, count: int, options: AdjustOptions = OPTIONS) -> Trials:
    """Draw corrections from the prior and noise, adjust, compare."""
    rng = np.random.default_rng(5)
    centers = centers_of(block)
    tracks, n = block.tracks, len(block.views)
    truth = ecef_from_ground(block.truth.ground)
    enu = enu_basis(block.truth.ground[0])
    first = adjust_tracks(block.views, tracks, options, centers=centers)
    unknowns = first.cameras.unknowns
    sigma = [SIGMA_ATTITUDE] * 3 + [SIGMA_POSITION] * 3 + [DRIFT_SIGMA] * 3 * unknowns.drift
    nees, scene = [], []
    for _ in range(count):
        params = rng.normal(0, sigma, (n, len(sigma)))
        noisy = seen(tracks, block.truth.ground, unknowns.corrected(params, block.views), rng, NOISE)
        found = adjust_tracks(block.views, noisy, options, centers=centers)
        error = (found.params - params).ravel()
        nees.append(error @ (found.covariance.reduced.matrix @ error))
        scene.append(enu @ np.nanmean(found.points - truth, axis=0) / found.gauge.sigma)
    return Trials(np.array(nees), np.array(scene), len(sigma) * n)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("views", "tracks"),
    [
        (3, 150),
        pytest.param(10, 300, marks=known("57 % of trials lie below the median: sigmas are somewhat too large")),
    ],
)
def test_errors_of_the_corrections_are_as_large_as_predicted(views, tracks):
    trials = run_trials(simulate_block(views, tracks, seed=1, noise=NOISE), 1000)
    assert trials.nees.mean() / trials.unknowns == pytest.approx(1.0, abs=0.05)
    trials.scene_as_predicted()
    # chi-square: half of the trials below its median
    assert np.mean(trials.nees < trials.unknowns - 2 / 3) == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize(("tracks", "count"), [(50, 6), pytest.param(100, 100, marks=pytest.mark.slow)])
def test_some_trials_agree_with_the_prediction(tracks, count):
    trials = run_trials(simulate_block(3, tracks, seed=2, noise=NOISE), count)
    spread = np.sqrt(2 / (trials.unknowns * count))
    assert trials.nees.mean() / trials.unknowns == pytest.approx(1.0, abs=4 * spread)


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("views", "tracks", "count", "near"),
    [
        (3, 60, 10, 0.35),
        pytest.param(10, 300, 40, 0.1, marks=pytest.mark.slow),
        pytest.param(3, 200, 150, 0.1, marks=pytest.mark.nightly),
    ],
)
def test_with_every_default_on_errors_are_as_large_as_predicted(views, tracks, count, near):
    trials = run_trials(simulate_block(views, tracks, seed=4, noise=NOISE), count, DEFAULTS)
    assert trials.nees.mean() / trials.unknowns == pytest.approx(1.0, abs=near)
    trials.scene_as_predicted()


@pytest.mark.slow
def test_points_err_as_predicted_neither_more_nor_less():
    """Squared errors over their covariance, over three, in a dozen blocks: one. Within a block they go together."""
    ratio = []
    for seed in range(12):
        block = simulate_block(3, 60, seed=seed, noise=NOISE)
        found = solve(block)
        error = found.points - ecef_from_ground(block.truth.ground)
        inverse = np.linalg.inv(found.covariance.points(np.arange(60)))
        ratio.append(np.einsum("ni,nij,nj->n", error, inverse, error).mean() / 3.0)
    assert 0.6 < np.mean(ratio) < 1.6


def test_the_gauge_report_names_the_height_as_the_weakest_mode(adjusted):
    assert adjusted.gauge.modes[0].meaning == "up"
    assert adjusted.gauge.modes[0].sigma > adjusted.gauge.modes[-1].sigma
    assert (adjusted.gauge.sigma > 0).all()
    assert (np.abs(adjusted.gauge.shift) < 5 * np.linalg.norm(adjusted.gauge.sigma)).all()


def _divided(block: SimulatedBlock, old: int) -> tuple[Tracks, Tracks, np.ndarray]:
    """Tracks among the first views, the others, and how old tracks are counted in the whole."""
    tracks = block.tracks
    last = np.zeros(tracks.num_points, dtype=int)
    np.maximum.at(last, tracks.point, tracks.view)
    is_old = last[tracks.point] < old
    return tracks.select(is_old), tracks.select(~is_old), is_old


@pytest.mark.slow
def test_views_added_to_an_adjusted_block_end_where_the_joint_adjustment_puts_them(tmp_path):
    block = simulate_block(12, 2500, seed=3)
    old, new, _ = _divided(block, 9)
    centers = centers_of(block)
    with as_stated(), of_noise_as_stated():
        first = adjust_tracks(block.views[:9], old, OPTIONS, centers=centers[:9], hold_out=False)
        block_prior(first).save(tmp_path / "prior.npz")
        prior = BlockPrior.load(tmp_path / "prior.npz")
        second = adjust_tracks(block.views, new, OPTIONS, centers=centers, prior=prior, hold_out=False)
        joint = adjust_tracks(block.views, block.tracks, OPTIONS, centers=centers, hold_out=False)
    sigma = np.sqrt(np.diag(joint.covariance.full)).reshape(joint.params.shape)
    assert (np.abs(second.params - joint.params) / sigma).max() < 0.01
    again = np.sqrt(np.diag(second.covariance.full)).reshape(joint.params.shape)
    np.testing.assert_allclose(again, sigma, rtol=0.01)
    assert (np.abs(first.params - joint.params[:9]) / sigma[:9]).max() > 0.02  # the old views did move


def test_a_prior_of_other_views_is_refused(block, adjusted):
    strangers = tuple(replace(view, name=f"other_{view.name}") for view in block.views)
    with pytest.raises(InputError, match="none of these views"):
        adjust_tracks(strangers, block.tracks, AdjustOptions(), prior=block_prior(adjusted))
