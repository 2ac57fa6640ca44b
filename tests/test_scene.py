"""Views, tracks and ground points check what they are given and cannot be changed."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.errors import InputError
from barpc.scene import GroundPoints, Tracks, View, connected_groups

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


@pytest.mark.parametrize(
    ("view", "point", "xy", "sigma"),
    [
        ([0, 1], [0], np.zeros((2, 2)), np.ones(2)),
        ([0, 1], [0, 0], np.zeros((2, 3)), np.ones(2)),
        ([0, 1], [0, 0], np.full((2, 2), np.nan), np.ones(2)),
        ([0, 1], [0, 0], np.zeros((2, 2)), np.zeros(2)),
        ([0, -1], [0, 0], np.zeros((2, 2)), np.ones(2)),
    ],
)
def test_tracks_that_do_not_fit_together_are_refused(view, point, xy, sigma):
    with pytest.raises(InputError):
        Tracks(view, point, xy, sigma)


def test_selecting_drops_tracks_that_are_left_with_one_view():
    kept = make_tracks().select(np.array([True, False, True, False, True]))
    assert kept.view.tolist() == [0, 2]
    assert kept.point.tolist() == [0, 0]
    assert kept.num_points == 1


def test_no_tracks_are_tracks_too():
    assert Tracks([], [], np.empty((0, 2)), []).num_points == 0


def test_a_view_needs_a_size_and_an_altitude_interval():
    with pytest.raises(InputError, match="size"):
        View("a", "", (0, 10), make_rpc(), (0.0, 1.0))
    with pytest.raises(InputError, match="altitude"):
        View("a", "", (10, 10), make_rpc(), (2.0, 1.0))


def test_ground_points_refuse_an_observation_of_no_point():
    with pytest.raises(InputError, match="does not exist"):
        GroundPoints(("a",), [[5, 43, 1]], [[1, 1, 1]], [1], [0], [[1, 1]], [1])
    with pytest.raises(InputError, match="finite"):
        GroundPoints(("a",), [[np.nan, 43, 1]], [[1, 1, 1]], [0], [0], [[1, 1]], [1])


def test_connected_groups_are_largest_first():
    assert connected_groups(6, [(4, 5), (0, 2), (2, 3)]) == [[0, 2, 3], [4, 5], [1]]
    assert connected_groups(0, []) == []
