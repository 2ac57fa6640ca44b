"""A line of detectors as one hypothesis: the edges found, what a trend and a single step give, and what is selected."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.ba import adjust_tracks
from barpc.ba.select.beam import TermSearch
from barpc.ba.terms.detector_line import DetectorLine, change_points
from barpc.ba.terms.term import Residuals
from barpc.base.geodesy import Array
from barpc.scene import IntArray
from benchmarks.worlds import DEM_AS_STATED, judge
from benchmarks.worlds_families import CHIPS, make
from tests.ba.residuals import Displacement, residuals_of, step
from tests.ba.test_terms import interval

EDGES = np.array([0.2, 0.45, 0.7])
SIZES = np.array([[0.0, 0.9, -0.3, 0.5], [0.0, -0.4, 0.6, 0.2]])


def detectors(view: int = 1) -> Displacement:
    """Four detectors of a view, each displaced by itself."""
    return lambda of, at: SIZES[:, np.searchsorted(EDGES, at[0])] * (of == view)


def trend(of: IntArray, at: Array) -> Array:
    """A bend of the columns of one view, as cameras have."""
    return np.stack([3.0 * at[0] ** 2, -2.0 * at[0]]) * (of == 1)


def edges_of(seen: Residuals, view: int = 1) -> Array:
    return np.array(change_points(seen, view, seen.base, np.zeros_like(seen.place))) / seen.size[0, view]


@pytest.mark.parametrize("moved", [(detectors(),), (detectors(), trend)], ids=["alone", "beside a bend"])
def test_edges_lie_between_the_ties_about_them(moved: tuple[Displacement, ...]) -> None:
    seen = residuals_of(*moved, tracks=900)
    found = edges_of(seen)
    assert len(found) == len(EDGES)
    np.testing.assert_allclose(found, EDGES, atol=0.01)


def test_a_bend_without_edges_has_none() -> None:
    assert not len(edges_of(residuals_of(trend, tracks=900)))
    assert not len(edges_of(residuals_of(tracks=900)))


def test_a_single_edge_is_no_line() -> None:
    seen = residuals_of(step(0.8, 1, 0.6, 1.0, axis=0), tracks=900)
    assert len(edges_of(seen)) == 1
    assert DetectorLine.propose(seen, interval(0.0, 100.0, axis=0)) == []


def test_rows_are_no_line_of_detectors() -> None:
    seen = residuals_of(detectors(), tracks=900)
    assert DetectorLine.propose(seen, interval(0.0, 100.0, axis=1)) == []
    assert not DetectorLine.may_be(seen, [interval(0.0, 100.0, axis=1)])
    assert DetectorLine.may_be(seen, [interval(0.0, 100.0, axis=0)])


def test_a_line_costs_as_much_as_its_steps() -> None:
    seen = residuals_of(detectors(), tracks=300)
    one = DetectorLine.at(seen, 1, [100.0, 250.0])
    assert one.price == pytest.approx(2.0 * one.parts[0].price)
    assert one.columns.shape[1] == 4
    own, col = seen.linear.view == 1, seen.place[0]
    np.testing.assert_array_equal(one.columns[0, 0], own & (col >= 100.0) & (col < 250.0))
    np.testing.assert_array_equal(one.columns[1, 3], own & (col >= 250.0))


def test_all_detectors_of_an_image_are_one_hypothesis() -> None:
    """The search ends with one term, whose displacements are those of the detectors relative to the first."""
    seen = residuals_of(detectors(), tracks=900)
    found = TermSearch(seen, [], 0.02, 0.1).run()
    assert {(one.kind, one.view) for one in found.findings} == {("step", 1)}
    assert len(found.findings) == len(EDGES)
    for n, one in enumerate(sorted(found.findings, key=lambda row: row.where[1])):  # type: ignore[index]
        assert one.where[1] / seen.size[0, 1] == pytest.approx(EDGES[n], abs=0.01)
        # cameras may follow a trend of the columns: three parameters of either coordinate
        np.testing.assert_allclose(one.size, SIZES[:, n + 1], atol=0.1)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [6102, 7202])
def test_eight_detectors_end_where_they_do(seed: int) -> None:
    """Three and two images by cameras of another model."""
    world = make("plane", seed)
    found = adjust_tracks(world.views, world.tracks, DEM_AS_STATED, world.gcps, world.dem)
    (view,), steps = world.plan.injected[0].views, [one for one in found.findings if one.kind == "step"]
    assert {one.view for one in steps} == {view}
    width = world.views[view].size[0] / CHIPS
    edges = np.array([end for one in steps for end in one.where[1:3]]) / width  # type: ignore[index]
    inside = edges[(edges > 0.0) & (edges < CHIPS)]
    assert len(np.unique(np.rint(inside))) >= 5
    np.testing.assert_allclose(inside, np.rint(inside), atol=0.04)
    assert judge(world, found.sensors).left < 0.08
