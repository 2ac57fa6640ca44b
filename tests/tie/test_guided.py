"""Search, keypoints and stretches against plain loops over all candidates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.tie import TieOptions
from barpc.tie.matchers.features import Keypoints, Sift, join_keypoints, quota, ranked
from barpc.tie.matchers.guided import Guided, _Described, _pairs_in_band
from barpc.tie.matchers.matcher import Matches, Prediction
from barpc.tie.pairing.epipolar import EpipolarSegments
from barpc.tie.pixels import PIECE, tiles
from tests.constants import Sized, chosen
from tests.tie.stages import part_of

ACROSS = 4.0
LINEAR = np.array([[1.1, 0.2], [-0.1, 0.9]])


def keypoints(rng: np.random.Generator, xy: np.ndarray, descriptors: np.ndarray) -> Keypoints:
    n = len(xy)
    return Keypoints(xy, rng.uniform(2, 5, n), rng.uniform(-0.6, 0.6, n), rng.uniform(0, 1, n), descriptors)


@pytest.fixture(scope="module")
def pair() -> tuple[Keypoints, Keypoints, EpipolarSegments]:
    """Five hundred points a side in 300 px; half of B shows what A shows, some twice, a few pixels apart."""
    rng = np.random.default_rng(3)
    described = rng.integers(0, 120, (500, 128)).astype(np.uint8)
    predicted = rng.uniform(0, 300, (500, 2))
    again = np.clip(described[:250].astype(int) + rng.integers(-25, 25, (250, 128)), 0, 255).astype(np.uint8)
    place = predicted[:250] + rng.uniform(-12, 12, (250, 2)) * [1.5, 0.4]
    twin = place[:100] + rng.choice([1.0, 1.9, 2.2, 6.0], (100, 1)) * [1, 0]
    b = keypoints(
        rng,
        np.vstack([place, twin, rng.uniform(0, 300, (150, 2))]),
        np.vstack([again, again[:100], described[350:]]),
    )
    a = keypoints(rng, rng.uniform(0, 300, (500, 2)), described)
    slope = rng.uniform(-0.05, 0.05, 500)
    slope[::50] = np.nan
    before, after = rng.uniform(-16, -8, 500), rng.uniform(8, 16, 500)
    return a, b, EpipolarSegments(np.array([1.0, 0.0]), *predicted.T, slope, before, after, lambda: LINEAR)


def brute(a: Keypoints, b: Keypoints, where: EpipolarSegments) -> dict[tuple[int, int], tuple[float, float]]:
    """Mutual best pairs: (distance, ambiguity), one point after the other."""
    unit = [k.descriptors / np.linalg.norm(k.descriptors.astype(float), axis=1)[:, None] for k in (a, b)]
    likeness = np.full((len(a), len(b)), -np.inf)
    for i in range(len(a)):
        sight = LINEAR @ [np.cos(a.angle[i]), np.sin(a.angle[i])]
        expected = np.arctan2(sight[1], sight[0])
        du = b.xy[:, 0] - where.along[i]
        dw = b.xy[:, 1] - where.across[i] - where.slope[i] * du
        turn = np.angle(np.exp(1j * (b.angle - expected)))
        near = (where.before[i] <= du) & (du <= where.after[i]) & (np.abs(dw) <= ACROSS)
        for j in np.flatnonzero(near & (np.abs(turn) <= np.radians(30))):
            likeness[i, j] = unit[0][i] @ unit[1][j]
    found = {}
    for i in range(len(a)):
        j = int(likeness[i].argmax())
        if likeness[i, j] < -1 or likeness[:, j].argmax() != i:
            continue
        apart = np.abs(b.xy - b.xy[j])
        du = b.xy[:, 0] - b.xy[j, 0]
        apart[:, 1] = np.abs(b.xy[:, 1] - b.xy[j, 1] - where.slope[i] * du)
        others = np.where((apart <= 2.0).all(axis=1), -np.inf, likeness[i])
        distance = np.sqrt(max(0.0, 2 - 2 * likeness[i, j]))
        second = others.max()
        found[i, j] = (distance, distance / np.sqrt(2 - 2 * second) if second > -1 else distance)
    return found


def guided(a: Keypoints, b: Keypoints, where: EpipolarSegments, ratio: float, probes: int | None = None) -> Matches:
    prediction = Prediction(lambda xy: where, ACROSS, list, probes)
    return Guided(TieOptions(ratio=ratio), (a, b)).match(None, None, prediction)  # type: ignore[arg-type]


@pytest.mark.parametrize("ratio", [1.0, 0.85, 0.6])
def test_the_matcher_finds_what_a_loop_over_all_pairs_finds(pair, ratio) -> None:
    a, b, where = pair
    every = brute(a, b, where)
    expected = {key: distance for key, (distance, ambiguity) in every.items() if ambiguity <= ratio}
    found = guided(a, b, where, ratio)
    assert len(every) >= len(expected) > 40
    assert {(int(i), int(j)) for i, j in found.index} == set(expected)
    for (i, j), xy, distance in zip(found.index, found.xy, found.score, strict=True):
        assert distance == pytest.approx(expected[int(i), int(j)], abs=2e-3)
        np.testing.assert_array_equal(xy, [a.xy[i], b.xy[j]])


def test_where_the_cameras_error_is_looked_for_some_points_and_clear_matches_are_enough(pair) -> None:
    a, b, where = pair
    chosen = np.linspace(0, 499, 120).astype(int)
    clear = brute(a.select(chosen), b, part_of(where, chosen))
    for ratio, bound in ((0.95, 0.8), (0.6, 0.6)):
        expected = {(int(chosen[i]), j) for (i, j), (_, ambiguity) in clear.items() if ambiguity <= bound}
        found = guided(a, b, where, ratio, probes=120)
        assert {(int(i), int(j)) for i, j in found.index} == expected
        assert len(expected) > 10


def test_without_points_there_are_no_matches(pair) -> None:
    a, b, where = pair
    nobody = np.empty(0, dtype=np.int64)
    assert not len(guided(a, b.select(nobody), where, 1.0))
    assert not len(guided(a.select(nobody), b, part_of(where, nobody), 1.0))


# --- keypoints ---------------------------------------------------------------------------------------------


def test_a_cell_keeps_its_strongest_and_cells_begin_at_the_corner_of_a_pixel() -> None:
    xy = np.array([[-0.4, 0.0], [9.4, 0.0], [9.6, 0.0], [0.0, 9.6], [25.0, 9.6], [5.0, 5.0]])
    response = np.array([1.0, 3.0, 1.0, 2.0, 9.0, 2.0])
    assert quota(xy, response, 10.0, 1).tolist() == [1, 2, 3, 4]
    assert quota(xy, response, 10.0, 2).tolist() == [1, 2, 3, 4, 5]
    assert quota(xy, response, 10.0, 9).tolist() == [0, 1, 2, 3, 4, 5]
    assert quota(xy + [1000.0, 2000.0], response, 10.0, 1).tolist() == [1, 2, 3, 4]
    assert len(quota(xy[:0], response[:0], 10.0, 1)) == 0
    tied = np.array([[5.0, 7.0], [4.0, 7.0], [6.0, 3.0]])
    assert quota(tied, np.ones(3), 10.0, 2).tolist() == [1, 2]


def test_cells_take_their_strongest_in_turns() -> None:
    xy = np.array([[1.0, 1.0], [2.0, 1.0], [3.0, 1.0], [70.0, 1.0], [80.0, 1.0]])
    assert ranked(xy, np.array([9.0, 8.0, 7.0, 2.0, 1.0]), 64, 5).tolist() == [0, 3, 1, 4, 2]
    assert ranked(xy, np.array([9.0, 8.0, 7.0, 2.0, 1.0]), 64, 3).tolist() == [0, 3, 1]


@pytest.mark.parametrize(
    ("size", "tile", "cell", "edges"),
    [
        ((1000, 500), 512, 64, ([0, 512], [0])), ((1000, 500), 300, 50, ([0, 250, 500, 750], [0, 250])),
        ((1025, 128), 1024, 64, ([0, 576], [0])), ((100, 100), 128, 64, ([0], [0])),
        ((1000, 700), 256, 64, ([0, 256, 512, 768], [0, 256, 512])),
    ],
)  # fmt: skip
def test_tiles_are_equal_and_cut_at_whole_cells(size, tile, cell, edges) -> None:
    with chosen(TieOptions, tile=tile, cell=cell) as options:
        boxes = tiles(size, options.tile)
    assert [(c, r) for c, r, _, _ in boxes] == [(c, r) for r in edges[1] for c in edges[0]]
    for c, r, w, h in boxes:
        right = min((e for e in edges[0] if e > c), default=size[0])
        below = min((e for e in edges[1] if e > r), default=size[1])
        assert (w, h) == (right - c, below - r)


def test_descriptors_are_square_roots_of_shares_and_angles_are_radians() -> None:
    picture = np.full((200, 200), 40, np.uint8)
    picture[90:112, 95:107] = 220
    everything = Sift().detect(picture, lambda xy, scale, response: np.arange(len(xy)))
    assert len(everything)
    np.testing.assert_allclose((everything.descriptors.astype(float) ** 2).sum(axis=1), 255.0**2, rtol=0.03)
    assert (everything.angle >= 0).all()
    assert (everything.angle < 2 * np.pi + 1e-6).all()
    assert everything.angle.max() > 1.0
    nothing = Sift().detect(picture, lambda xy, scale, response: np.arange(0))
    assert len(nothing) == 0
    assert join_keypoints([]).descriptors.shape == (0, 128)


@pytest.mark.parametrize("slope", [0.4, -0.4, 0.02, 0.0])
@pytest.mark.parametrize("reach", [(-150.0, 20.0), (-20.0, 150.0), (30.0, 150.0), (-150.0, -30.0)])
def test_all_points_of_slanted_bands_are_looked_at_and_few_others(slope: float, reach: tuple[float, float]) -> None:
    """Bands that rise or fall by some strips along their length, to one side of the prediction or to both."""
    rng = np.random.default_rng(0)
    turned = rng.uniform(0, 2000, (4000, 2))
    place = rng.uniform(-100, 2100, (1500, 2))
    where = EpipolarSegments(
        np.array([1.0, 0.0]), *place.T, *(np.full(1500, x) for x in (slope, *reach)), lambda: np.eye(2)
    )
    first, second = (
        _Described.of(replace(keypoints(rng, xy, np.ones((len(xy), 128), np.uint8)), angle=angle), np.eye(2))
        for xy, angle in ((place, rng.uniform(0, 7, 1500)), (turned, rng.uniform(0, 7, 4000)))
    )
    asked, seen, tilt = np.arange(0, 1500, 3), [], 3.0 + abs(slope) * max(abs(end) for end in reach)
    for rows, cols in _pairs_in_band(where, 3.0, asked, turned, first, second):
        seen.append(np.stack([rows, cols], axis=1))
        assert (np.diff(rows) >= 0).all()
        du, dw = (turned[cols] - place[rows]).T
        assert ((du >= reach[0]) & (du <= reach[1])).all()
        assert (np.abs(dw) <= 4.0 * tilt).all()
        turn = np.angle(second.direction[cols] / first.direction[rows])
        assert (np.abs(turn) <= np.radians(90.001)).all()
    pairs = np.concatenate(seen)
    du, dw = np.moveaxis(turned - place[asked, None], -1, 0)
    inside = (du >= reach[0]) & (du <= reach[1]) & (np.abs(dw - slope * du) <= 3.0)
    inside &= (second.direction * first.direction.conj()[asked, None]).real >= np.cos(np.radians(29.99))
    wanted = {(int(asked[i]), int(j)) for i, j in np.argwhere(inside)}
    assert len(wanted) > 40
    assert wanted <= set(map(tuple, pairs.tolist()))
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    in_boxes = len(asked) * len(turned) / 2000**2 * (reach[1] - reach[0]) * 4.0 * tilt / 3.0
    assert len(pairs) < 1.2 * in_boxes  # at random: two of six sectors, two strips
    most = np.bincount(pairs[:, 0]).max()
    assert max(len(part) for part in seen) <= PIECE // 128 + most
    assert len({int(row) for part in seen for row in np.unique(part[:, 0])}) == sum(
        len(np.unique(part[:, 0])) for part in seen
    )


def test_candidates_come_in_portions_that_hold_all_of_a_point(pair, sized: Sized) -> None:
    a, b, where = pair
    whole = guided(a, b, where, 0.85)
    sized(candidates_together=7 * 128)
    parts = guided(a, b, where, 0.85)
    np.testing.assert_array_equal(whole.index, parts.index)
    assert len(whole) > 40
