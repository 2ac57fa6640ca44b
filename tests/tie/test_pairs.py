"""Which views are matched: overlap, angle, a connected graph without all pairs."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.base.errors import DisconnectedError, TiePointError
from barpc.scene import View
from barpc.sensor.rpc import RPC
from barpc.tie import Scope, TieOptions
from barpc.tie.pairing.overlaps import shared_tiles
from barpc.tie.pixels import tiles
from tests.constants import chosen
from tests.tie.stages import select_pairs


def camera(lon: float, lat: float = 0.0, lean: float = 0.1) -> RPC:
    """A linear camera of 1000 x 1000 half-metre pixels about a point; `lean` px a metre of altitude."""
    coeffs = np.zeros((4, 20))
    coeffs[1::2, 0] = 1.0
    coeffs[0, 1], coeffs[2, 2], coeffs[0, 3] = 1.0, -1.0, 100.0 * lean / 500.0
    degrees = 250.0 / 111_000.0
    half = np.full(2, 499.5)
    return RPC(coeffs, np.array([lon, lat, 100.0]), np.array([degrees, degrees, 100.0]), half, half)


def views(*cameras: RPC) -> list[View]:
    return [View(f"v{i}", "", (1000, 1000), rpc, (0.0, 200.0)) for i, rpc in enumerate(cameras)]


METRE = 1 / 111_000.0


@pytest.mark.parametrize("lon", [0.0, 180.0, -180.0, 359.9999])
def test_pairs_do_not_depend_on_where_longitudes_wrap(lon: float) -> None:
    other = (lon + 100 * METRE + 180.0) % 360.0 - 180.0
    (pair,) = select_pairs(views(camera(lon, lean=0.0), camera(other, lean=0.0)), TieOptions())
    assert pair.overlap == pytest.approx(0.8, abs=0.01)
    assert pair.angle == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.nightly)])
def test_a_thousand_views_get_their_best_partners_and_not_all_pairs(count: int) -> None:
    grid = [camera(400 * METRE * (k % 40), 400 * METRE * (k // 40)) for k in range(count)]
    pairs = select_pairs(views(*grid), TieOptions(neighbours=3))
    assert count - 1 <= len(pairs) < 4 * count
    assert all(p.views[0] < p.views[1] for p in pairs)


def test_views_that_share_no_ground_are_named_group_by_group() -> None:
    far = views(camera(0.0), camera(100 * METRE), camera(1.0), camera(2.0))
    with pytest.raises(DisconnectedError, match=r"3 groups \(v0, v1; v2; v3\): no overlap") as caught:
        select_pairs(far, TieOptions())
    assert caught.value.groups == (("v0", "v1"), ("v2",), ("v3",))


def test_views_are_tried_whose_cameras_may_be_wrong_by_more_than_the_overlap() -> None:
    (pair,) = select_pairs(views(camera(0.0), camera(600 * METRE)), TieOptions(search=500))
    assert pair.views == (0, 1)
    with pytest.raises(DisconnectedError):
        select_pairs(views(camera(0.0), camera(600 * METRE)), TieOptions(search=50))


def test_one_image_is_refused() -> None:
    with pytest.raises(TiePointError, match="1 image given"):
        select_pairs(views(camera(0.0)), TieOptions())


def test_the_listed_pairs_and_no_others_are_chosen_however_many_partners_a_view_then_has() -> None:
    many = views(*(camera(10 * METRE * k) for k in range(6)))
    listed = [(0, k) for k in range(1, 6)] + [(1, 2)]
    pairs = select_pairs(many, TieOptions(neighbours=1), Scope(only=[(b, a) for a, b in listed]))
    assert [p.views for p in pairs] == sorted(listed)


def test_a_listed_pair_is_tried_where_the_cameras_may_be_wrong_and_named_where_it_cannot_overlap(caplog) -> None:
    four = views(*(camera(400 * METRE * k) for k in range(4)))
    listed = [(0, 1), (1, 2), (2, 3), (0, 2), (0, 3)]
    pairs = select_pairs(four, TieOptions(search=400), Scope(only=listed))
    assert [p.views for p in pairs] == [(0, 1), (0, 2), (1, 2), (2, 3)]
    assert [r.message for r in caplog.records] == ["v0 - v3: listed, but they do not overlap as asked"]


def test_listed_pairs_that_leave_groups_are_refused() -> None:
    with pytest.raises(DisconnectedError, match=r"v0, v1; v2\).*among the listed pairs"):
        select_pairs(views(camera(0.0), camera(50 * METRE), camera(100 * METRE)), TieOptions(), Scope(only=[(0, 1)]))


def test_only_windows_that_a_partner_may_see_are_read() -> None:
    two = views(camera(0.0, lean=0.0), camera(250 * METRE, lean=0.0))
    with chosen(TieOptions, search=50, tile=250, cell=50) as options:
        pairs = select_pairs(two, options)
        boxes = tiles((1000, 1000), options.tile)
        left, right = ([box in kept for box in boxes] for kept in shared_tiles(two, pairs, [boxes] * 2, options.search))
    assert left == [False, True, True, True] * 4  # the second one within the search
    assert right == [True, True, True, False] * 4
