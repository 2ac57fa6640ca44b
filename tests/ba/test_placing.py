"""A view placed by itself, piece by piece: what it meets, how robustly, and what its RPC looks like."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import resection
from barpc.ba.resection import Placed, _Sight, diagnose_rpc, median_noise, retained_tracks
from barpc.base.geodesy import ecef_from_ground, enu_basis
from tests.distributions import chi2

XY = np.random.default_rng(1).uniform(0.0, 900.0, (2, 80))


def placed(left: np.ndarray, noise: float = 1.0, squared: np.ndarray | None = None) -> Placed:
    rows = np.ones(left.shape[1], dtype=bool)
    squares = (left**2).sum(axis=0) if squared is None else squared
    return Placed(np.zeros(6), np.eye(6), rows, XY[:, : left.shape[1]], squares, left, noise)


def test_the_median_of_squares_of_two_coordinates_is_one_where_they_are_as_stated() -> None:
    assert median_noise(9.0 * chi2.ppf((np.arange(999) + 0.5) / 999, 2)) == pytest.approx(3.0, rel=1e-6)


@pytest.mark.parametrize(("size", "far"), [(3.99, False), (4.01, True)])
def test_what_is_far_is_farther_than_so_many_deviations_of_both_coordinates(size: float, far: bool) -> None:
    left = np.zeros((2, 40))
    left[:, :10] = size  # sqrt(2) times that
    one = placed(left)
    assert one.contradicted == (0.25 if far else 0.0)
    np.testing.assert_array_equal(one.agree, (np.arange(40) >= 10) | (not far))
    left[0, 39] = np.nan
    assert placed(left).contradicted == pytest.approx(0.025 + 0.25 * far)
    assert placed(left, squared=np.zeros(40)).agree.all()  # of what is left with splines nothing
    assert placed(left, resection.MUCH_NOISE * 0.99).meets
    assert not placed(left, resection.MUCH_NOISE).meets


def test_a_camera_is_wrong_where_neighbours_lie_off_alike() -> None:
    rng = np.random.default_rng(1)
    smooth = 30.0 * np.stack([np.sin(XY[0] / 300.0), np.cos(XY[1] / 300.0)]) + 20.0
    anywhere = rng.normal(0.0, 30.0, (2, 80))
    assert placed(smooth).is_coherent
    assert not placed(anywhere).is_coherent
    few = smooth.copy()
    few[:, 29:] = 0.0
    assert not placed(few).is_coherent  # 29 say nothing
    few[:, 29] = smooth[:, 29]
    assert placed(few).is_coherent
    blind = anywhere.copy()
    blind[0, :40] = np.nan
    assert not placed(blind).is_coherent
    blind[0, 40] = np.inf
    assert placed(blind).is_coherent  # more than half is not seen at all


def test_points_that_two_kept_observations_tell_are_known() -> None:
    found: Any = SimpleNamespace(outcome=SimpleNamespace(inlier=np.array([1, 1, 0, 1, 1, 1, 1], dtype=bool)))
    block: Any = SimpleNamespace(point=np.array([0, 0, 1, 1, 2, 2, 3]), num_points=4, num_tracks=2)
    np.testing.assert_array_equal(retained_tracks(found, block), [True, False, False, False])


def sight(n: int = 80, size: int = 3) -> tuple[_Sight, np.ndarray, np.ndarray]:
    """Observations of a view that its unknowns move linearly; their derivatives and covariances."""
    rng = np.random.default_rng(3)
    along, spread = rng.normal(size=(2, size, n)), rng.uniform(0.1, 0.4, (n, 2))
    one = object.__new__(_Sight)
    one.view, one.xy = 1, XY[:, :n]
    one.covariance = np.einsum("nc,cd->ncd", spread**2, np.eye(2)) + 0.004
    truth = np.array([3.0, -2.0, 1.0])[:size]
    off = np.einsum("cqn,q->cn", along, truth) + np.einsum(
        "ncd,nd->cn", np.linalg.cholesky(one.covariance), rng.normal(size=(n, 2))
    )
    off[:, :20] += rng.uniform(-300.0, 300.0, (2, 20))
    prior = SimpleNamespace(mean=np.zeros((2, size)), sigma=np.full((2, size), 0.7))
    one.problem = SimpleNamespace(camera_prior=prior)  # type: ignore[assignment]

    def project(params: np.ndarray) -> Any:
        image = one.xy - off + np.einsum("cqn,q->cn", along, params[1])
        return SimpleNamespace(image=image, by_unknown=along)

    one.project = project  # type: ignore[method-assign]
    return one, along, off


@pytest.mark.parametrize("count", [0, 2])
def test_a_view_s_unknowns_are_those_of_robust_steps(count: int) -> None:
    """By Geman and McClure, whose scale falls to three deviations of both coordinates, by a quarter at most a step."""
    one, along, off = sight()
    splines = np.random.default_rng(5).uniform(0.0, 1.0, (count, 80))
    found, covariance, residual = one.fit(splines if count else None)
    beside = np.zeros((2, 2 * count, 80))
    beside[0, :count] = beside[1, count:] = splines
    every = np.concatenate([along, beside], axis=1)
    precision = np.r_[np.full(3, (100 * 0.7) ** -2.0), np.full(2 * count, 30.0**-2)]
    root = np.linalg.inv(np.linalg.cholesky(one.covariance))
    rows = np.einsum("ncd,dqn->ncq", root, every)
    x, scale = np.zeros(3 + 2 * count), np.inf
    for _ in range(30):
        left = rows @ x - np.einsum("ncd,dn->nc", root, off)
        squared = (left**2).sum(axis=1)
        last = left
        usual = np.sqrt(np.median(squared) / (2 * np.log(2)))
        scale = 3.0 * max(usual, 1.0) if np.isinf(scale) else max(3.0, 0.25 * scale)
        weight = 1.0 / (1.0 + squared / (2.0 * scale**2)) ** 2
        normal = np.einsum("n,ncp,ncq->pq", weight, rows, rows) + np.diag(precision)
        x = x - np.linalg.solve(normal, np.einsum("n,ncp,nc->p", weight, rows, left) + precision * x)
    np.testing.assert_allclose(found, x[:3], atol=1e-9)
    np.testing.assert_allclose(covariance, np.linalg.inv(normal)[:3, :3], rtol=1e-8)
    np.testing.assert_allclose(residual, last.T, atol=1e-8)
    assert np.abs(found - [3.0, -2.0, 1.0]).max() < 0.5


def test_a_view_that_sees_nothing_stays_where_it_is() -> None:
    one, _, _ = sight()
    one.project = lambda params: SimpleNamespace(image=np.full((2, 80), np.nan), by_unknown=np.zeros((2, 3, 80)))  # type: ignore[method-assign]
    found, _, residual = one.fit()
    np.testing.assert_array_equal(found, 0.0)
    assert np.isinf(residual).all()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda image, up: image + 40.0, ((40.0, 40.0), None, False, False)),
        (lambda image, up: image + 25.0 * up, ((0.0, 37.5), 25.0, False, False)),
        (lambda image, up: image + 120.0 * up, ((0.0, 180.0), None, False, False)),  # no surface is so far
        (lambda image, up: image[::-1], (None, None, True, False)),
        (lambda image, up: image + 0.9, (None, None, False, True)),
        (lambda image, up: image + 40.0 * np.sin(XY / 40.0), (None, None, False, False)),
        # half may be seen nowhere, and no more
        *(
            (lambda image, up, k=k: np.where(np.arange(80) < k, np.nan, image + 40.0), found)
            for k, found in ((39, ((40.0, 40.0), None, False, False)), (41, (None, None, False, False)))
        ),
    ],
)
def test_what_would_make_an_rpc_as_good_as_stated_is_said(change, expected) -> None:
    """Of a camera stated to 1 m, 2 px a metre east, 1.5 up: an offset, a height, axes that are swapped."""
    offset, height, swapped, as_stated = expected
    ecef = ecef_from_ground(np.column_stack([5.0 + XY[0] * 1e-5, 44.0 + XY[1] * 1e-5, np.full(80, 300.0)]))
    basis = enu_basis(np.array([5.0, 44.0, 300.0]))
    by_point = np.repeat(np.stack([2.0 * basis[0], 1.5 * basis[2]])[:, :, None], 80, axis=2)
    up = np.array([[0.0], [1.5]]) * np.ones(80)
    image = change(XY, up)

    def project(params: Any, points: Any, bounds: np.ndarray, what: str) -> SimpleNamespace:
        assert (bounds.tolist(), points.shape, what) == ([0, 80], (3, 80), "points")  # all are the view's
        return SimpleNamespace(image=image, by_point=by_point)

    cameras = SimpleNamespace(seeing=lambda xy: SimpleNamespace(project=project), unknowns=SimpleNamespace(constants=6))
    sigma = np.array([[0.6, 9.0, 9.0, 0.8, 9.0, 9.0]])
    prior = SimpleNamespace(mean=np.zeros((1, 6)), sigma=sigma)
    found: Any = SimpleNamespace(
        problem=SimpleNamespace(cameras=cameras, camera_prior=prior), final=SimpleNamespace(points=ecef)
    )
    block: Any = SimpleNamespace(point=np.arange(80), xy=XY, views=[None])
    one = placed(np.zeros((2, 80)), 99.0)
    said = diagnose_rpc(found, block, one, 0)
    assert (said.swapped, said.as_stated) == (swapped, as_stated)
    if offset is None:
        assert said.offset is None
    else:
        np.testing.assert_allclose(said.offset, offset, atol=0.5)
    assert said.height == (pytest.approx(height, abs=0.3) if height else None)
    if as_stated:  # one that meets its points is asked for the rest
        assert not diagnose_rpc(found, block, placed(np.zeros((2, 80)), 0.5), 0).as_stated
