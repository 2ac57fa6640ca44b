"""Observations that agree before any camera has moved, and pairs of views that have two solutions."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.optimize import brentq, minimize

from barpc.ba import AdjustOptions
from barpc.ba.constraints.block import join, make_problem
from barpc.ba.robust.consensus import TwoGroups, agreeing, two_groups, two_normals
from barpc.ba.solving.problem import Problem
from barpc.base.geodesy import ecef_from_ground
from barpc.simulate import simulate_block
from tests import distributions as stats
from tests.ba.conftest import centers_of


def groups(count: int, share: float, apart: float, sigma: float = 0.3) -> np.ndarray:
    """Offsets that two normal distributions would have, without chance, their mean 0."""
    few = round(share * count)
    parts = [c + sigma * stats.norm.ppf((np.arange(n) + 0.5) / n) for c, n in ((0.0, count - few), (apart, few))]
    return np.random.default_rng(0).permutation(np.concatenate(parts)) - share * apart


def likeliest(z: np.ndarray, logits: tuple[float, ...] = (-2.0, 0.0, 2.0)) -> tuple[float, float, float]:
    """Part of the smaller, distance of the centres, gain in log-likelihood, by a general minimiser."""

    def cost(x: np.ndarray) -> float:
        part, width = 1 / (1 + np.exp(-x[0])), np.exp(x[3])
        return -float(np.log(part * stats.norm.pdf(z, x[1], width) + (1 - part) * stats.norm.pdf(z, x[2], width)).sum())

    starts = ([logit, *np.quantile(z, [0.1, 0.9]), np.log(0.5 * z.std())] for logit in logits)
    few = {"maxiter": 2000, "xatol": 1e-6, "fatol": 1e-8}
    found = min((minimize(cost, x, method="Nelder-Mead", options=few) for x in starts), key=lambda found: found.fun)
    part = 1 / (1 + np.exp(-found.x[0]))
    gain = -found.fun - stats.norm.logpdf(z, 0, z.std()).sum()
    return min(part, 1 - part), abs(found.x[2] - found.x[1]), float(gain)


def pair_of(offset: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
    """Structure of a pair of views whose epipolar lines are rows, residuals (2, 2 n) with so much across, rays."""
    n = len(offset)
    index = np.arange(n)
    structure = SimpleNamespace(
        first=index, second=n + index, pair_bounds=np.array([0, n]), pair_view=np.array([[0, 1]]),
        num_views=2, num_points=n, point=np.tile(index, 2),
    )  # fmt: skip
    rays = np.array([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]])
    return structure, np.vstack([np.r_[np.zeros(n), offset], np.zeros(2 * n)]), np.repeat(rays, n, 0).transpose(1, 2, 0)


def told(z: np.ndarray) -> TwoGroups | None:
    found = two_groups(*pair_of(z), np.ones(2 * len(z), dtype=bool))
    return found[0] if found else None


def on_one_plane(place: np.ndarray, offset: np.ndarray, spread: np.ndarray) -> np.ndarray:
    structure, residual, rays = pair_of(offset)
    projected: Any = SimpleNamespace(by_point=rays)
    every, sigma = np.ones(2 * len(offset), dtype=bool), np.tile(spread, 2) / np.sqrt(2.0)
    keep = agreeing(structure, np.tile(place, 2), residual, projected, sigma, every)
    np.testing.assert_array_equal(*np.split(keep, 2))
    return keep[: len(offset)]


@pytest.mark.parametrize("share", [0.3, 0.5])
@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-7])
def test_groups_without_noise_are_two(share: float, noise: float) -> None:
    z = np.repeat([0.0, 1.0], [round(100 * share), round(100 * (1 - share))])
    found = told(z + noise * np.random.default_rng(0).standard_normal(100))
    assert (found.share, found.apart) == pytest.approx((share, 1.0), abs=1e-6)


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize(("share", "apart"), [(0.9, 1.5), (0.3, 1.2), (0.5, 1.0), (0.25, 3.0)])
def test_a_mixture_is_the_likeliest_one(share: float, apart: float) -> None:
    z = groups(400, share, apart)
    found, expected = told(z), likeliest(z)
    assert found.share == pytest.approx(expected[0], abs=2e-3)
    assert found.apart == pytest.approx(expected[1], rel=2e-3)
    assert (found.share, found.apart) == pytest.approx((min(share, 1 - share), apart), rel=0.05)


@pytest.mark.parametrize(("apart", "found"), [(0.0, False), (1.8, False), (2.2, True)])
def test_centres_are_apart_from_two_standard_deviations_on(apart: float, found: bool) -> None:
    part, distance, _ = two_normals(groups(4000, 0.5, apart * 0.3))
    assert (part > 0.4) == found
    assert (distance > 0) == found


def test_nothing_is_gained_where_one_group_takes_all() -> None:
    lone = np.r_[np.zeros(50), 1e6]  # so far out that it is a group of no width
    part, distance, gain = two_normals(lone - lone.mean())
    assert 0 <= part < 0.05
    assert np.isfinite([part, distance, gain]).all()
    with np.errstate(invalid="ignore"):
        assert two_normals(np.ones(50)) == (0.0, 0.0, 0.0)
    assert told(np.r_[np.zeros(150), 1e6]) is None
    assert told(np.ones(150)) is None


@pytest.fixture(scope="module")
def seen() -> tuple[Problem, Any]:
    """Three views that all see 400 points, and their image points there."""
    made = simulate_block(3, 440, seed=3, visible=1.0)
    whole = np.flatnonzero(np.bincount(made.tracks.point) == 3)[:400]
    options, tracks = AdjustOptions(drift=0), made.tracks.select(np.isin(made.tracks.point, whole))
    problem = make_problem(join(made.views, tracks, None, options), options, centers_of(made), None)
    points = ecef_from_ground(made.truth.ground[whole])
    return problem, problem.project_points(np.zeros((3, 6)), points)


def across(problem: Problem, projected: Any, pair: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of a pair of views' observations, and the four residuals (Q, 4) that no move of the point explains."""
    structure = problem.structure
    rows = slice(*structure.pair_bounds[pair : pair + 2])
    first, second = structure.first[rows], structure.second[rows]
    normal = []
    for i, j in zip(first, second, strict=True):
        (one,) = null_space(np.vstack([projected.by_point[:, :, i], projected.by_point[:, :, j]]).T).T
        normal.append(one * np.sign(one[0]) if abs(one[0]) > abs(one[1]) else one * np.sign(one[1]))
    return first, second, np.array(normal)


def residual_of(problem: Problem, projected: Any, offset: np.ndarray, pair: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (2, K) of which a pair's first ones are across the epipolar lines by so much; the rows in use."""
    first, second, normal = across(problem, projected, pair)
    residual = np.zeros((2, len(problem.structure.view)))
    use = np.zeros(residual.shape[1], dtype=bool)
    for n, value in enumerate(offset):
        residual[:, first[n]] += value / np.sqrt(2) * normal[n, :2]
        residual[:, second[n]] += value / np.sqrt(2) * normal[n, 2:]
        use[[first[n], second[n]]] = True
    return residual, use


def test_two_groups_are_told_by_their_pair_share_and_distance(seen) -> None:
    for pair, views in enumerate([(0, 1), (0, 2), (1, 2)]):
        offset = groups(300, 0.3, 2.0) + 5.0  # what all have in common is a camera's error
        found = two_groups(seen[0].structure, *_given(seen, offset, pair))
        assert [group.views for group in found] == [views]
        assert found[0].share == pytest.approx(0.3, abs=0.01)
        assert found[0].apart == pytest.approx(2.0, abs=0.02)


def _given(seen, offset: np.ndarray, pair: int = 0) -> tuple[np.ndarray, Any, np.ndarray]:
    residual, use = residual_of(*seen, offset, pair)
    return residual, seen[1].by_point, use


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("offset", "said"),
    [
        (groups(100, 0.3, 2.0), True),
        (groups(99, 0.3, 2.0), False),  # of too few nothing is said
        (groups(400, 0.0575, 3.0), True),
        (groups(400, 0.0425, 3.0), False),  # a twentieth may be wrong
        (np.zeros(200), False),  # there is no spread to divide
        (groups(400, 0.5, 0.6 * 1.37), True),  # Sarle's coefficient 0.47
        (groups(400, 0.5, 0.6 * 1.23), False),  # and 0.44
    ],
)
def test_groups_are_told_where_they_are_evident(seen, offset: np.ndarray, said: bool) -> None:
    assert len(two_groups(seen[0].structure, *_given(seen, offset))) == said


@pytest.mark.few(1)
@pytest.mark.parametrize("share", [0.5, 0.3, 0.2])
def test_what_looks_like_one_group_by_skewness_and_kurtosis_is_one(seen, monkeypatch, share) -> None:
    def coefficient(distance: float) -> float:
        z = groups(400, share, distance)
        return (stats.skew(z) ** 2 + 1) / stats.kurtosis(z)

    monkeypatch.setattr("barpc.ba.robust.consensus.two_normals", lambda z: (0.5, 1.0, 100.0))
    for bound, said in ((1.02, True), (0.98, False)):
        distance = brentq(lambda d, bound=bound: coefficient(d) - bound * 4.0 / 9.0, 0.5, 1.2)
        assert len(two_groups(seen[0].structure, *_given(seen, groups(400, share, distance)))) == said


@pytest.mark.slow
@pytest.mark.parametrize(("count", "said"), [(120, False), (340, True)])
def test_groups_are_told_where_two_are_likelier_by_a_factor_of_three_million(seen, count: int, said: bool) -> None:
    z = groups(count, 0.5, 0.6 * 1.4)
    gain = likeliest(z, (0.0,))[2]
    assert 5 < gain < 14 if not said else 16 < gain < 29
    assert len(two_groups(seen[0].structure, *_given(seen, z))) == said


# --- agreement -----------------------------------------------------------------------------------------------


def plane(place: np.ndarray) -> np.ndarray:
    return 3.0 + 2e-3 * place[0] - 1e-3 * place[1]


def test_offsets_on_one_plane_are_those_within_ten_sigmas_of_it() -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform(100, 9000, (2, 200))
    spread = rng.uniform(0.1, 0.3, 200)
    offset = plane(place) + spread * rng.normal(0, 0.3, 200)
    offset[:40] += 200.0  # together: a plane of their own
    offset[40:50] = (plane(place) + 8.5 * spread)[40:50]
    offset[50:60] = (plane(place) - 11.5 * spread)[50:60]
    found = on_one_plane(place, offset, spread)
    assert np.flatnonzero(~found).tolist() == [*range(40), *range(50, 60)]


def test_a_plane_may_be_steep_in_either_direction() -> None:
    place = np.random.default_rng(0).uniform(100, 9000, (2, 60))
    for slope in ([0.1, 0.0], [0.0, -0.1], [0.07, 0.07]):
        offset = slope @ place
        offset[:20] += 50.0
        assert np.flatnonzero(~on_one_plane(place, offset, np.full(60, 0.1))).tolist() == list(range(20))


def test_offsets_of_one_place_in_the_image_are_compared_all_the_same() -> None:
    offset = np.r_[np.zeros(30), np.full(10, 50.0)]
    for place in (np.full((2, 40), 7.0), np.vstack([np.linspace(0, 9e3, 40), np.full(40, 5.0)])):
        assert on_one_plane(place, offset, np.full(40, 0.1)).tolist() == [True] * 30 + [False] * 10


def _agreeing(seen, wrong: np.ndarray, view: int, use: np.ndarray, sigma: float = 0.2) -> np.ndarray:
    """With some points' observations in a view moved across all of its epipolar lines."""
    problem, projected = seen
    residual = np.zeros(problem.xy.shape)
    moved = (problem.structure.view == view) & np.isin(problem.structure.point, wrong)
    residual[0, moved] = 60.0
    return agreeing(problem.structure, problem.xy, residual, projected, np.full(len(use), sigma), use)


def test_the_observation_that_two_others_contradict_is_put_aside_alone(seen) -> None:
    structure = seen[0].structure
    use = np.ones(len(structure.view), dtype=bool)
    wrong = np.arange(0, 150)
    for view in range(3):
        keep = _agreeing(seen, wrong, view, use)
        np.testing.assert_array_equal(keep, ~((structure.view == view) & np.isin(structure.point, wrong)))
    assert _agreeing(seen, wrong[:0], 0, use).all()
    assert _agreeing(seen, wrong, 0, use, sigma=8.0).all()  # 60 px are no ten sigmas


def test_of_two_that_contradict_each_other_both_are_put_aside_and_what_is_not_used_stays_unused(seen) -> None:
    structure = seen[0].structure
    use = structure.view < 2
    use[structure.point == 300] = False
    wrong = np.arange(0, 150)
    keep = _agreeing(seen, wrong, 0, use)
    np.testing.assert_array_equal(keep, use & ~np.isin(structure.point, wrong))


@pytest.mark.parametrize(("count", "looked"), [(29, False), (30, True)])
def test_a_pair_of_few_matches_is_not_judged(seen, count: int, looked: bool) -> None:
    structure = seen[0].structure
    use = (structure.view < 2) & (structure.point < count)
    assert (_agreeing(seen, np.arange(5), 0, use) != use).any() == looked


def test_the_sigmas_of_both_ends_count(seen) -> None:
    """30 px across in one end, of which no move of the points takes a part, against 3 or 30 px of an end."""
    problem, projected = seen
    structure = problem.structure
    for end in (0, 1):
        for share, same in ((0.05, False), (0.15, True)):
            residual, use = residual_of(problem, projected, np.r_[np.full(100, 30.0), np.zeros(300)])
            move = np.random.default_rng(1).normal(0, 3, (3, structure.num_points))
            residual += np.einsum("ijk,jk->ik", projected.by_point, move[:, structure.point])
            sigma = np.where(structure.view == end, share * 30.0, 0.001)
            keep = agreeing(structure, problem.xy, residual, projected, sigma, use)
            assert (keep == use).all() == same
