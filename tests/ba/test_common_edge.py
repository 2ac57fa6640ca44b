"""An edge at the same column of all images: found where only some see the ground beyond it, and one displacement."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import Adjustment, adjust_tracks
from barpc.ba.parameters.additional_parameters import AdditionalParameters
from barpc.ba.parameters.priors import ALIKE_SIGMA, JointPrior
from barpc.ba.terms import CommonEdge
from barpc.ba.terms.common_edge import edge_gains
from barpc.report.measures.block import explanations
from barpc.report.outcome import triangulate_tracks
from barpc.simulate import simulate_block
from tests.ba.residuals import Displacement, residuals_of, step
from tests.costs import once

Edges = tuple[tuple[float, tuple[float, float]], ...]


@once
def adjusted(edges: Edges, views: int = 3, seed: int = 11, only: int = -1) -> tuple[Adjustment, np.ndarray]:
    """A simulated block with its columns displaced from edges on, and the RMS left of exact tie points [px]."""
    rng = np.random.default_rng(seed)
    made = simulate_block(
        views, 1000, seed=seed, per_site=views, size=(600, 600), attitude=5e-6, position=0.3, noise=0.0
    )
    xy = made.tracks.xy.copy()
    for col, size in edges:
        xy[(made.tracks.xy[:, 0] >= col) & ((only < 0) | (made.tracks.view == only))] += size
    found = adjust_tracks(made.views, replace(made.tracks, xy=xy + rng.normal(0.0, 0.05, xy.shape)))
    exact = replace(made.tracks, xy=xy)
    left = triangulate_tracks(exact, found.sensors, made.views[0].altitude, np.ones(len(xy), dtype=bool)).residuals
    return found, np.sqrt([(left[exact.view == v] ** 2).sum(axis=1).mean() for v in range(views)])


@pytest.mark.landing(1)
@pytest.mark.few(1)
@pytest.mark.parametrize(
    "edges",
    [((200.0, (0.3, 0.4)),), ((350.0, (0.0, -0.5)),), ((200.0, (0.3, 0.4)), (400.0, (-0.5, 0.3)))],
    ids=["both coordinates", "rows alone", "two edges"],
)
def test_edges_of_all_images_are_found_where_they_are_with_their_sizes(edges: Edges) -> None:
    found, left = adjusted(edges)
    told = sorted({(one.where[1], tuple(one.size)) for one in found.findings if one.where is not None})
    assert {one.kind for one in found.findings} == {CommonEdge.NAME}
    np.testing.assert_allclose([col for col, _ in told], [col for col, _ in edges], atol=2.0)
    np.testing.assert_allclose([size for _, size in told], [size for _, size in edges], atol=0.05)
    assert left.max() < 0.03  # 0.03 to 0.11 px without


def test_an_edge_of_all_images_is_told_once() -> None:
    (one,) = explanations(adjusted(((200.0, (0.3, 0.4)),))[0])
    assert one.image is None
    assert one.axis == "columns"
    words = r"about (\d+) on are displaced by (0\.\d+) px in all images.*`detectors = \[(\d+)\]`"
    said = re.search(words, one.sentence)
    assert 198 <= int(said[1]) <= 202
    assert int(said[1]) == int(said[3])
    assert float(said[2]) == pytest.approx(0.5, abs=0.03)


@pytest.mark.nightly
def test_an_edge_of_one_image_is_not_of_all() -> None:
    found, left = adjusted(((250.0, (0.3, 0.4)),), only=1)
    assert [(one.kind, one.view) for one in found.findings] == [("step", 1)]
    assert left.max() < 0.02


@pytest.mark.slow
def test_of_two_images_the_part_across_their_epipolar_lines_is_told_as_a_least() -> None:
    found, left = adjusted(((200.0, (0.3, 0.4)),), views=2)
    assert {one.kind for one in found.findings} == {CommonEdge.NAME}
    assert "by at least 0." in explanations(found)[0].sentence
    assert left.max() < 0.03


def test_all_images_are_displaced_by_the_same_at_a_common_edge() -> None:
    waves = adjusted(((200.0, (0.3, 0.4)),))[0].cameras.unknowns
    params = adjusted(((200.0, (0.3, 0.4)),))[0].params[:, waves.in_waves]
    assert np.ptp(params, axis=0).max() < 3.0 * ALIKE_SIGMA


# --- the prior that holds them together -------------------------------------------------------------------------------


def places(*rows: tuple[float, float]) -> AdditionalParameters:
    """Additional parameters of views with a part each: (axis, start)."""
    return AdditionalParameters(0, steps=np.array([[[axis, at, 1200.0, 0.0, 0.0]] for axis, at in rows]))


def test_only_columns_from_the_same_place_in_all_images_are_alike() -> None:
    assert places((0, 200.0), (0, 200.0)).alike.tolist() == [0]
    assert places((0, 200.0), (0, 201.0)).alike.tolist() == []
    assert places((1, 200.0), (1, 200.0)).alike.tolist() == []
    assert places((0, 200.0), (0, np.inf)).alike.tolist() == []
    assert places((0, 200.0)).alike.tolist() == []


def test_the_prior_is_of_differences_alone() -> None:
    prior = JointPrior.of_alike(places((0, 200.0), (0, 200.0), (0, 200.0)), 3, 5)
    same = np.tile([7.0, 7.0, 7.0, 0.4, -0.3], (3, 1))
    assert prior.cost(same) == pytest.approx(0.0, abs=1e-6)
    other = same.copy()
    other[1, 3] += ALIKE_SIGMA
    assert prior.cost(other) == pytest.approx(2.0 / 3.0)  # of three, one differs from their mean
    other[1, :3] = 100.0
    assert prior.cost(other) == pytest.approx(2.0 / 3.0)


# --- the score of every place -----------------------------------------------------------------------------------------


def test_the_score_is_that_of_every_place_by_itself() -> None:
    seen = residuals_of(step(0.5, 1, 0.4, 1.0, axis=0), tracks=60)
    col, gain = edge_gains(seen)
    linear, left = seen.linear, seen.linear.residual_after(seen.base.step)
    for n in (0, len(col) // 3, len(col) // 2, len(col) - 1):
        pull, known = np.zeros(2), np.eye(2)
        for tracks in linear.tracks:
            for rows, follow in zip(tracks.rows, tracks.point_bases[:, :3], strict=True):
                settled = np.eye(2 * len(rows)) - follow.T @ follow  # the ground point taken off
                off = settled @ left[:, rows].T.ravel()
                beyond = np.kron(((seen.place[0, rows] > col[n]) / linear.sigma[rows])[:, None], np.eye(2))
                weight = 1.0 / np.sqrt(off @ off + seen.base.noise**2)
                pull += weight * beyond.T @ off
                known += weight * beyond.T @ settled @ beyond
        np.testing.assert_allclose(gain[n], 0.5 * pull @ np.linalg.solve(known, pull), rtol=1e-9)


def displaced(px: float, start: float) -> Displacement:
    """Columns of all views are displaced from a place on."""
    return lambda of, at: np.array([[0.0], [px]]) * (at[0] >= start)


def test_the_largest_score_is_at_the_edge() -> None:
    seen = residuals_of(displaced(3.0, 0.4), tracks=300)
    col, gain = edge_gains(seen)
    assert abs(col[gain.argmax()] - 0.4 * seen.size[0, 0]) < 0.02 * seen.size[0, 0]
