"""Every way to solve with the reduced matrix, against dense linear algebra."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
import scipy.linalg as la

from barpc.ba import Adjustment, adjust_tracks
from barpc.ba.constraints.block import join, make_problem
from barpc.ba.constraints.incremental import BlockPrior
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.linear import Blocks, factorize, factorize_blocks
from barpc.ba.solving.solve import camera_step
from barpc.ba.solving.structure import counting_sort, dissect
from barpc.base.errors import AdjustError
from barpc.base.geodesy import ecef_from_ground
from barpc.base.options import AdjustOptions
from barpc.scene import GroundPoints, Tracks
from barpc.simulate import SimulatedBlock, simulate_block
from tests.ba.conftest import INDEPENDENT, centers_of, solve
from tests.ba.test_dissection import sites_of
from tests.constants import Sized
from tests.costs import once
from tests.lanes import diagonal


def _matrix(pairs: np.ndarray, n: int, q: int, seed: int = 0) -> Blocks:
    rng = np.random.default_rng(seed)
    diagonal = rng.normal(size=(n, q, q))
    return Blocks(diagonal + diagonal.swapaxes(1, 2) + 30 * q * np.eye(q), rng.normal(size=(len(pairs), q, q)), pairs)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("sites", "leaf", "kept"), diagonal([(4, 15, 1), (7, 6, 3), (60, 1, 2), (1, 1, 1)], [7, 1, 32, 1000], [0.0, 1e9])
)
def test_solutions_and_blocks_of_the_inverse_are_those_of_the_dense_matrix(sized: Sized, sites, leaf, kept) -> None:
    sized(front_views=leaf)
    sized(fronts_in_memory=kept)
    pairs, place = sites_of(*sites)
    n, q = len(place), 3
    matrix, rng = _matrix(pairs, n, q), np.random.default_rng(0)
    use = rng.random(n) < 0.8 if n > 1 else np.ones(1, dtype=bool)
    free = np.repeat(use, q)
    for damping, less in ((0.0, None), (0.3, rng.normal(size=(3, free.sum())) / np.sqrt(free.sum()))):
        dense = matrix.plain()
        dense = (dense + damping * np.diag(dense.diagonal()))[np.ix_(free, free)]
        dense -= 0.0 if less is None else less.T @ less
        inverse = np.zeros((n * q, n * q))
        inverse[np.ix_(free, free)] = np.linalg.inv(dense)
        blocks = inverse.reshape(n, q, n, q)
        factor = factorize_blocks(matrix, dissect(pairs, place, use), damping, less)
        rhs = rng.normal(size=(free.sum(), 3))
        np.testing.assert_allclose(factor.solve(rhs), np.linalg.solve(dense, rhs), atol=1e-13)
        np.testing.assert_allclose(factor.solve(rhs[:, 0]), np.linalg.solve(dense, rhs[:, 0]), atol=1e-13)
        found = factor.inverse()
        i, j = pairs.T
        np.testing.assert_allclose(found.diagonal, blocks[np.arange(n), :, np.arange(n), :], atol=1e-13)
        np.testing.assert_allclose(found.pairs, blocks[i, :, j, :], atol=1e-13)


def test_the_block_of_a_pair_is_found_where_it_is_and_nowhere_else() -> None:
    pairs = np.array([[0, 1], [0, 4], [1, 2], [1, 3], [3, 4]])
    matrix = _matrix(pairs, 5, 2)
    found = {(i, j): matrix.pair(i, j) for j in range(5) for i in range(j)}
    assert {pair: at for pair, at in found.items() if at is not None} == {
        (int(i), int(j)): at for at, (i, j) in enumerate(pairs)
    }


def test_a_matrix_that_is_not_positive_definite_is_said() -> None:
    pairs, place = sites_of(6, 6)
    matrix = _matrix(pairs, len(place), 2)
    matrix.diagonal[50] *= -1.0
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        factorize_blocks(matrix, dissect(pairs, place, np.ones(len(place), dtype=bool)), 0.0)


def _weakly_tied(block: SimulatedBlock, few: int) -> Tracks:
    """The tracks without all but a few of those that views of both halves see."""
    tracks, half = block.tracks, len(block.views) // 2
    last = np.zeros(tracks.num_points, dtype=bool)
    last[tracks.point[tracks.view >= half]] = True
    first = np.zeros_like(last)
    first[tracks.point[tracks.view < half]] = True
    across = np.flatnonzero(first & last)
    keep = ~np.isin(tracks.point, across[few:])
    renamed = np.unique(tracks.point[keep], return_inverse=True)[1].ravel()
    return Tracks(tracks.view[keep], renamed, tracks.xy[keep], tracks.sigma[keep])


def _reduced(block: SimulatedBlock, tracks: Tracks, gcps: GroundPoints | None = None, **options: Any) -> Any:
    """The problem and its linearisation where it starts, and 1 / sigma."""
    chosen = AdjustOptions(**{**INDEPENDENT, **options})
    joined = join(block.views, tracks, gcps, chosen, keep_largest=True)
    problem = make_problem(joined, chosen, centers_of(block), options.get("prior"))
    points = joined.first_points()
    points = np.where(np.isfinite(points), points, ecef_from_ground(block.truth.ground[0]))
    weight = joined.use / joined.sigma
    for _ in range(2):
        projected = problem.project_points(problem.camera_prior.mean, points)
        points = problem.triangulate(points, projected, weight)
    return problem, points, weight


CASES: dict[str, dict[str, Any]] = {
    "as it is": {},
    "no drift": {"drift": 0},
    "hardly held": {"sigma_attitude": 1e3, "sigma_position": 1e3},
    "fixed": {"fixed": ("view_0003", "view_0040", "view_0041")},
    "in the image": {"model": "affine"},
}


@once
def _square(views: int) -> SimulatedBlock:
    """So many views in a square."""
    return simulate_block(views, 20 * views, seed=3, num_gcps=5, num_checks=0)


@pytest.mark.landing(2)
@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("views", "case", "ties", "leaf"),
    [
        (48, "as it is", "weak", 4),
        (48, "fixed", "all", 8),
        (48, "hardly held", "none", 8),
        (48, "in the image", "all", 32),
        *(
            pytest.param(200, *row, marks=pytest.mark.nightly if n > 1 else pytest.mark.slow)
            for n, row in enumerate(
                (
                    *(("fixed", "all", 32), ("hardly held", "none", 32)),
                    *((case, "all", 32) for case in CASES if case != "fixed"),
                    *(("as it is", "weak", 32), ("as it is", "none", 32), ("hardly held", "weak", 32)),
                    ("as it is", "all", 4),
                )
            )
        ),
    ],
)
def test_a_step_and_its_covariance_are_those_of_the_dense_solve(sized: Sized, views, case, ties, leaf) -> None:
    many = _square(views)
    if views < 200:
        sized(dense_views=0)
    sized(front_views=leaf)
    tracks = many.tracks if ties == "all" else _weakly_tied(many, 6 if ties == "weak" else 0)
    gcps = many.gcps if ties == "all" else None
    with pytest.warns(match="not tied") if ties == "none" else nullcontext():
        problem, points, weight = _reduced(many, tracks, gcps, **CASES[case])
    reduced = problem.reduce(problem.camera_prior.mean, points, weight)
    step, gain, factor = camera_step(problem, reduced)
    assert factor.method == "multifrontal"
    dense, free, q = reduced.plain(problem.free), problem.free, problem.cameras.unknowns.size
    rest = dense @ step.ravel()[free] + reduced.gradient[free]
    assert np.linalg.norm(rest) < 1e-13 * np.linalg.norm(reduced.gradient)
    covariance = np.zeros((len(free),) * 2)
    covariance[np.ix_(free, free)] = la.cho_solve(la.cho_factor(dense), np.eye(len(dense)))
    sigma = np.sqrt(covariance.diagonal()).clip(1e-30)
    bound = 1e-9 if case != "hardly held" else 1e-4  # dense ways differ by as much: a condition of 1e11
    expected = np.zeros(len(free))
    expected[free] = -np.linalg.solve(dense, reduced.gradient[free])
    assert (np.abs(step.ravel() - expected) / sigma)[free].max() < 100.0 * bound
    assert not step.ravel()[~free].any()
    assert gain == pytest.approx(reduced.gain - reduced.gradient @ expected, rel=1e-8)
    found, n = factor.inverse(), len(many.views)
    blocks = (covariance / np.outer(sigma, sigma)).reshape(n, q, n, q)
    sigma, (i, j) = sigma.reshape(n, q), found.pair_view.T
    own = found.diagonal / (sigma[:, :, None] * sigma[:, None, :])
    across = found.pairs / (sigma[i, :, None] * sigma[j, None, :])
    np.testing.assert_allclose(own, blocks[np.arange(n), :, np.arange(n), :], atol=bound)
    np.testing.assert_allclose(across, blocks[i, :, j, :], atol=bound)
    if case == "as it is":  # well enough tied that thirty probes tell all
        off = Covariance(reduced, factor, free).probed_views().diagonal(axis1=1, axis2=2) / sigma**2 - 1.0
        assert np.sqrt((off**2).mean()) < 0.5
        assert abs(off.mean()) < 0.1


def test_a_prior_of_an_earlier_block_ties_its_views_whatever_they_share(sized: Sized) -> None:
    """Views of an earlier run far apart, whose unknowns are correlated: in the matrix as in the dense one."""
    many, names = _square(48), ("view_0045", "view_0002", "view_0020")
    root = np.random.default_rng(0).normal(size=(27, 27)) + 3.0 * np.eye(27)
    prior = BlockPrior(
        names, "rotation+translation", 1, np.ones((3, 9)), root.T @ root, np.array(centers_of(many))[[45, 2, 20]]
    )
    both = []
    for most in (0, 10**6):
        sized(dense_views=most)
        chosen = AdjustOptions(**INDEPENDENT)
        joined = join(many.views, many.tracks, None, chosen)
        problem = make_problem(joined, chosen, centers_of(many), prior)
        points = np.vstack([ecef_from_ground(many.truth.ground)])
        reduced = problem.reduce(problem.camera_prior.mean, points, joined.use / joined.sigma)
        both.append((reduced.plain(problem.free), camera_step(problem, reduced)[0]))
    np.testing.assert_allclose(both[0][0], both[1][0], rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(both[0][1], both[1][1], atol=1e-9 * np.abs(both[1][1]).max())
    assert np.abs(both[0][0].reshape(48, 9, 48, 9)[2, :, 45]).max() > 1.0


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "n"),
    [
        pytest.param({"dem_sigma": 1000.0}, 24, id="terrain-24"),
        pytest.param({}, 24, id="alone-24"),
        pytest.param({"dem_sigma": 1000.0}, 110, id="terrain-110", marks=pytest.mark.nightly),
        pytest.param({}, 110, id="alone-110", marks=pytest.mark.nightly),
    ],
)
def test_a_block_is_adjusted_as_in_dense_form(monkeypatch, sized: Sized, options, n) -> None:
    """Rounds, variances and covariance: nothing else may change. Heights held by a terrain are wrong together."""
    made = simulate_block(n, 20 * n, seed=4, num_checks=0)
    chosen = AdjustOptions(**{**INDEPENDENT, "solver": "sparse", **options})
    dem = (lambda lon, lat: np.full(len(lon), 300.0)) if options else None
    found = []
    for name in ("TOLERANCE", "STANDS"):  # both end at the minimum, not a step before it
        monkeypatch.setattr(f"barpc.ba.robust.rounds.{name}", 1e-10)
    for most in (0, 10**6):
        sized(dense_views=most)
        found.append(adjust_tracks(made.views, made.tracks, chosen, dem=dem, centers=centers_of(made)))
    one, other = found
    assert [f.covariance.factor.method for f in found] == ["multifrontal", "dense"]
    assert (one.covariance.reduced.common is not None) == bool(options)
    np.testing.assert_allclose(one.params, other.params, atol=1e-7)
    # not of costs, which rounding alone moves by a billionth
    assert ((one.residuals - other.residuals) ** 2).sum() < 1e-10 * (other.residuals**2).sum()
    np.testing.assert_allclose(one.gauge.sigma, other.gauge.sigma, rtol=1e-7)
    views = np.arange(n)
    sigma = [np.sqrt(np.diag(f.covariance.view(4))) for f in found]
    np.testing.assert_allclose(*sigma, rtol=1e-7)
    for i, j in ((0, 0), (17, 18), (18, 17), (3, n - 5)):
        expected = other.covariance.view(i, j)
        np.testing.assert_allclose(one.covariance.view(i, j), expected, atol=1e-7 * np.abs(expected).max())
    joint = [f.covariance.joint(views[n // 2 : n // 2 + 3]) for f in found]
    np.testing.assert_allclose(*joint, atol=1e-7 * np.abs(joint[1]).max())
    index = np.array([0, 10 * n, 20 * n - 1])
    expected = other.covariance.points(index)
    np.testing.assert_allclose(one.covariance.points(index), expected, atol=1e-7 * np.abs(expected).max())


# --- every way to solve ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def block() -> SimulatedBlock:
    """Four views, 300 tie points."""
    return simulate_block(4, 300, seed=11)


@pytest.fixture(scope="module")
def adjusted(block: SimulatedBlock) -> Adjustment:
    """`block`, adjusted."""
    return solve(block)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_a_dense_matrix_is_damped_and_solved(damping):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(40, 40))
    matrix, rhs = root @ root.T + np.eye(40), rng.normal(size=(40, 3))
    expected = np.linalg.solve(matrix + damping * np.diag(matrix.diagonal()), rhs)
    factor = factorize(matrix, damping)
    assert factor.method == "dense"
    np.testing.assert_allclose(factor.solve(rhs), expected, rtol=1e-9)


def test_nothing_is_solved_without_unknowns():
    assert factorize(np.zeros((0, 0)), 0.0).solve(np.zeros((0, 2))).shape == (0, 2)


def test_a_matrix_that_is_not_finite_is_an_adjust_error():
    with pytest.raises(AdjustError, match="not finite"):
        factorize(np.full((3, 3), np.nan), 0.0)
    pairs = np.zeros((0, 2), dtype=np.int64)
    blocks = Blocks(np.full((2, 3, 3), np.nan), np.zeros((0, 3, 3)), pairs)
    with pytest.raises(AdjustError, match="not finite"):
        factorize_blocks(blocks, dissect(pairs, np.zeros((2, 2)), np.ones(2, dtype=bool)), 0.0)


def test_a_large_block_is_solved_in_sparse_form_as_in_dense_form(block, adjusted, sized):
    sized(dense_views=0)
    sparse = solve(block)
    assert sparse.covariance.factor.method == "multifrontal"
    np.testing.assert_allclose(sparse.params, adjusted.params, atol=1e-4)
    np.testing.assert_allclose(sparse.gauge.sigma, adjusted.gauge.sigma, rtol=1e-4)


def test_what_a_large_block_does_not_keep_it_works_out_again(block, adjusted, sized):
    """Derivatives from one step to the next, and the terms of the smooth parts."""
    sized(products_kept=0)
    sized(terms_kept=0)
    found = solve(block)
    np.testing.assert_allclose(found.params, adjusted.params, atol=1e-7)
    np.testing.assert_allclose(found.smooth.rms, adjusted.smooth.rms, atol=1e-9)
    np.testing.assert_array_equal(found.inlier, adjusted.inlier)


def test_a_failing_decomposition_inside_scipy_is_survived(block, adjusted, monkeypatch):
    def fails(*_, **__):
        raise la.LinAlgError("SVD did not converge")

    monkeypatch.setattr("scipy.optimize.least_squares", fails)
    found = solve(block)
    np.testing.assert_allclose(found.params, adjusted.params, atol=1e-4)


def test_counting_sorts_as_a_stable_sort_does():
    key = np.random.default_rng(0).integers(0, 40, 500)
    order, bounds = counting_sort(key, 41)
    np.testing.assert_array_equal(order, np.argsort(key, kind="stable"))
    np.testing.assert_array_equal(bounds, np.searchsorted(np.sort(key), np.arange(42)))
