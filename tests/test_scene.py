"""Views, tracks and ground points check what they are given and cannot be changed."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from barpc.base.errors import InputError
from barpc.scene import (
    Altimetry,
    GroundPoints,
    Reference,
    Tracks,
    View,
    connected_groups,
    connected_labels,
    middle_altitude,
    row_pairs,
)

from .sensor.conftest import make_rpc


def make_tracks():
    return Tracks([0, 1, 0, 1, 2], [0, 0, 1, 1, 1], np.arange(10.0).reshape(5, 2), np.full(5, 0.2))


def test_tracks_are_read_only_copies():
    xy = np.zeros((2, 2))
    tracks = Tracks([0, 1], [0, 0], xy, [1.0, 1.0])
    xy[0, 0] = 5
    assert tracks.xy[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        tracks.xy[0, 0] = 1
    assert (len(tracks), tracks.num_points) == (2, 1)
    assert Tracks([], [], np.empty((0, 2)), []).num_points == 0


def test_a_record_shares_the_arrays_of_another_and_nobody_elses():
    given = np.array([[10.0, 20.0], [11.0, 21.0]])
    locked = given.copy()
    base = locked[:]
    base.setflags(write=False)  # who has what it is a part of writes to it
    one, other = (Tracks([0, 1], [0, 0], xy, [0.3, 0.3]) for xy in (given, base))
    given += 1.0
    locked += 1.0
    assert one.xy[0, 0] == other.xy[0, 0] == 10.0
    again = replace(one, sigma=[0.1, 0.1])
    assert np.shares_memory(again.xy, one.xy)
    assert again.sigma[0] == 0.1


@pytest.mark.parametrize(
    ("view", "point", "xy", "sigma", "told"),
    [
        ([0, 1], [0], np.zeros((2, 2)), np.ones(2), "point: shape"),
        ([0, 1], [0, 0], np.zeros((2, 3)), np.ones(2), "xy: shape"),
        ([0, 1], [0, 0], np.full((2, 2), np.nan), np.ones(2), "finite"),
        ([0, 1], [0, 0], np.zeros((2, 2)), np.zeros(2), "positive"),
        ([0, -1], [0, 0], np.zeros((2, 2)), np.ones(2), "negative"),
        ([0, 1], [0, -1], np.zeros((2, 2)), np.ones(2), "negative"),
    ],
)
def test_tracks_that_do_not_fit_together_are_refused(view, point, xy, sigma, told):
    with pytest.raises(InputError, match=told):
        Tracks(view, point, xy, sigma)


# --- at the bounds, and in words -----------------------------------------------------------------------------


def test_the_smallest_size_and_an_interval_of_one_altitude_are_enough():
    view = View("a", "", (1, 1), make_rpc(), (7.0, 7.0))
    assert view.altitude == 7.0
    assert View("a", "", (3, 4), make_rpc(), (-10.0, 30.0)).altitude == 10.0
    for size, interval, told in (
        ((1, 0), (0.0, 1.0), "size"), ((0, 10), (0.0, 1.0), "size"), ((10, 10), (2.0, 1.0), "altitude"),
        ((1, 1), (0.0, np.nan), "altitude"), ((1, 1), (-np.inf, 1.0), "altitude"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=told):
            View("a", "", size, make_rpc(), interval)


def test_what_a_record_says_of_itself():
    view = View("a", "", (30, 40), make_rpc(), (-10.0, 30.0))
    assert repr(view) == "View('a', 30 x 40 px, RPC for -10 to 30 m)"
    assert "RPC for -10 to 30 m, 2020-02-03)" in repr(View("a", "", (3, 4), make_rpc(), (-10.0, 30.0), "2020-02-03"))
    assert repr(make_tracks()) == "Tracks(2 tie points, 5 observations in 3 views, to 0.2 px)"
    assert repr(GroundPoints.none()) == "GroundPoints(0 points, no observations)"


def ground_points(sigma: float = 0.5, xy_sigma: float = 0.3, point: int = 1) -> GroundPoints:
    place = [[5.0, 43.0, 100.0], [5.1, 43.1, 200.0], [5.2, 43.2, 300.0]]
    return GroundPoints(
        ("a", "b", "c"), place, np.full((3, 3), sigma), [0, 2, point, 2], [1, 0, 3, 2],
        np.arange(8.0).reshape(4, 2), np.full(4, xy_sigma), ("stranger",), ("left",),
    )  # fmt: skip


@pytest.mark.parametrize("which", ["sigma", "xy_sigma"])
@pytest.mark.parametrize(
    ("sigma", "taken"),
    [(1e-6, True), (0.9e-6, False), (1e9, True), (1.1e9, False), (0.0, False), (np.nan, False)],
)
def test_sigmas_of_ground_points_have_squares_that_can_be_reckoned_with(which, sigma, taken):
    if taken:
        assert len(ground_points(**{which: sigma}).names) == 3
    else:
        with pytest.raises(InputError, match="sigmas positive, from 1e-06 to 1e\\+09"):
            ground_points(**{which: sigma})


@pytest.mark.parametrize(
    ("sigma", "flat", "taken"),
    [
        (1e-6, 0.0, True), (1e9, 1e9, True), (0.9e-6, 0.0, False), (1.1e9, 0.0, False), (1.0, -1e-9, False),
        (1.0, 1.1e9, False),
    ],
)  # fmt: skip
def test_heights_may_be_of_no_width_and_no_less_sure_than_ground_points(sigma, flat, taken):
    place = [[5.0, 43.0, 100.0], [5.1, 43.1, 200.0]]
    if taken:
        assert len(Altimetry(place, [1.0, sigma], [1.0, flat]).sigma) == 2
    else:
        with pytest.raises(InputError, match="sigmas positive, from 1e-06 to 1e\\+09"):
            Altimetry(place, [1.0, sigma], [1.0, flat])


@pytest.mark.parametrize(("point", "taken"), [(0, True), (2, True), (3, False), (-1, False)])
def test_an_observation_is_of_a_point_that_is_there(point, taken):
    if taken:
        assert ground_points(point=point).point[2] == point
    else:
        with pytest.raises(InputError, match="does not exist"):
            ground_points(point=point)


def test_a_position_in_an_image_that_is_none_spoils_no_other_point():
    """Whoever reads control names the point and leaves it out: the others must get so far."""
    place = [[5.0, 43.0, 100.0], [5.1, 43.1, 200.0]]
    seen = (np.ones((2, 3)), [0, 1], [0, 0], [[np.nan, 3.0], [4.0, 5.0]], [1, 1])
    points = GroundPoints(("a", "b"), place, *seen)
    with pytest.raises(InputError, match="finite"):
        GroundPoints(("a", "b"), [place[0], [np.nan, 43.1, 200.0]], *seen)
    assert points.select(np.isfinite(points.xy).all(axis=1)).xy.tolist() == [[4.0, 5.0]]


def test_selected_ground_points_keep_their_own_observations():
    kept = ground_points().select(np.array([True, False, True]))
    assert kept.names == ("a", "c")
    assert kept.lonlatalt[:, 2].tolist() == [100.0, 300.0]
    assert kept.point.tolist() == [0, 1, 1]
    assert kept.view.tolist() == [1, 0, 2]
    assert kept.xy.tolist() == [[0, 1], [2, 3], [6, 7]]
    assert (kept.strangers, kept.left_out) == (("stranger",), ("left",))
    nobody = ground_points().select(np.zeros(3, dtype=bool))
    assert (nobody.names, len(nobody.view)) == ((), 0)


def test_a_reference_has_a_positive_bias():
    for bias in ([1.0, 1.0, 0.0], [1.0, -1.0, 1.0]):
        with pytest.raises(InputError, match="positive"):
            Reference(ground_points(), bias, [[0.0, 0.0]])
    for width in (-1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="templates"):
            Reference(ground_points(), [1, 2, 3], [[0.0, 0.0]], width)
    assert np.isnan(Reference(ground_points(), [1, 2, 3], [[np.nan, np.nan], [1, 2]]).offset[0]).all()


def test_the_middle_altitude_of_views_is_the_mean_of_theirs():
    views = [View("a", "", (3, 4), make_rpc(), alts) for alts in ((0.0, 100.0), (200.0, 500.0))]
    assert middle_altitude(views) == 200.0


def test_labels_are_numbered_by_the_first_node():
    assert connected_labels(5, [(3, 1), (4, 0)]).tolist() == [0, 1, 2, 1, 0]
    assert connected_labels(3, []).tolist() == [0, 1, 2]
    rng = np.random.default_rng(1)
    for num in (1, 2, 7, 30, 400):  # sparse, and the longest chain, in any order
        for links in (*(rng.integers(0, num, (m, 2)) for m in (num // 3, num)), pairwise(rng.permutation(num))):
            pairs = np.array([*links], dtype=np.int64).reshape(-1, 2)
            graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(num, num))
            np.testing.assert_array_equal(connected_labels(num, pairs), connected_components(graph, directed=False)[1])
    assert connected_groups(5, [(0, 1), (2, 3)]) == [[0, 1], [2, 3], [4]]
    assert connected_groups(5, [(3, 4), (4, 2)]) == [[2, 3, 4], [0], [1]]
    assert connected_groups(6, [(4, 5), (0, 2), (2, 3)]) == [[0, 2, 3], [4, 5], [1]]  # the largest first
    assert connected_groups(0, []) == []


def test_selecting_keeps_tracks_of_two_and_closes_up_their_numbers():
    tracks = Tracks([0, 1, 0, 1, 1, 2], [0, 0, 1, 1, 2, 2], np.arange(12.0).reshape(6, 2), np.arange(1.0, 7.0))
    kept = tracks.select(np.array([True, False, True, True, True, True]))
    assert (kept.point.tolist(), kept.num_points) == ([0, 0, 1, 1], 2)
    assert kept.view.tolist() == [0, 1, 1, 2]
    assert kept.sigma.tolist() == [3.0, 4.0, 5.0, 6.0]
    assert kept.xy[0].tolist() == [4.0, 5.0]


@pytest.mark.parametrize("most", [1, 2, np.inf])
def test_pairs_of_rows_are_those_of_one_label_that_stand_near_each_other(most) -> None:
    label = np.array([4, 4, 4, 4, 1, 7, 7, 0])
    wanted = {(i, j) for j in range(8) for i in range(j) if label[i] == label[j] and j - i <= most}
    assert {*map(tuple, row_pairs(label, most).T.tolist())} == wanted
    assert row_pairs(label, most).shape == (2, len(wanted))
    assert row_pairs(np.arange(3), most).shape == row_pairs(np.zeros(0, int), most).shape == (2, 0)
