"""Tie-point tables: written and read back to the bit; ASP's pairs become tracks; errors name the file."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.pointio.matches import IMAGE_SIGMA, write_matches
from barpc.scene import Tracks
from tests.pointio.conftest import refused
from tests.pointio.stages import read_matches

NAMES = ["a", "b", "c"]


def _tracks() -> Tracks:
    rng = np.random.default_rng(0)
    view = [0, 1, 0, 1, 2, 1, 2]
    return Tracks(view, [0, 0, 1, 1, 1, 2, 2], rng.uniform(0, 1e4, (7, 2)), rng.uniform(0.05, 0.5, 7))


@pytest.mark.parametrize("names", [NAMES, ["%20", 'q"t', " lead"], [" b", "b", "a,b"]])
@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_tracks_come_back_to_the_bit(tmp_path, ending, names):
    tracks = _tracks()
    path = tmp_path / f"t.{ending}"
    write_matches(path, tracks, names)
    again = read_matches(path, names)
    for name in ("view", "point", "xy", "sigma"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tracks, name))


@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_views_may_stand_in_another_order_and_others_are_left_out(tmp_path, ending):
    path = tmp_path / f"t.{ending}"
    write_matches(path, _tracks(), NAMES)
    again = read_matches(path, ["c", "b"])
    assert again.num_points == 2
    np.testing.assert_array_equal(again.view, [0, 1, 0, 1])


def test_a_csv_by_hand_needs_four_columns_in_any_order(tmp_path):
    path = tmp_path / "hand.csv"
    path.write_text('# mine\ntrack, row, col, image\nx7, 2.5, 1.5, /data/a.tif\nx7, 4, 3, "b.tif"\n')
    found = read_matches(path, NAMES)
    np.testing.assert_array_equal(found.xy, [[1.5, 2.5], [3, 4]])
    assert (found.sigma == IMAGE_SIGMA).all()


def _asp(path, left, right):
    lines = [f"{len(left)} {len(right)}"]
    lines += [f"{x} {y} {round(x)} {round(y)} 0 1 0.5 0 0 0 0" for x, y in [*left, *right]]
    path.write_text("\n".join(lines) + "\n")


def test_asp_pairs_that_share_a_keypoint_are_one_track(tmp_path):
    _asp(tmp_path / "run-a__b.txt", [(1, 2), (5, 6)], [(3, 4), (7, 8)])
    _asp(tmp_path / "run-b__c.txt", [(3, 4)], [(9, 9)])
    found = read_matches(tmp_path, NAMES)
    assert sorted(np.bincount(found.point).tolist()) == [2, 3]
    assert len(read_matches(tmp_path / "run-a__b.txt", NAMES)) == 4


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("t.csv", "image,col,row\na,1,2\n", "no column track"),
        ("t.csv", "image,col,row,track\na,1,2,1\n", "no track is seen in two"),
        ("t.csv", "image,col,row,track\n", "no track is seen in two"),
        ("t.csv", "", "the file is empty"),
        ("a__b.txt", "2 2\n1 2\n", "holds 1"),
        ("a__b.txt", "rubbish\n", "not an ASP text match file"),
        ("t.npz", "rubbish", "npz"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path, name, text, says):
    (tmp_path / name).write_text(text)
    refused(partial(read_matches, names=NAMES), tmp_path / name, says)


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"\.csv or \.npz"):
        write_matches(tmp_path / "t.txt", _tracks(), NAMES)
