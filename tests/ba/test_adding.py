"""An image more for a finished block: as the whole block adjusted again has it, by the neighbours alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from barpc.ba import Adjustment, BlockPrior, adjust_tracks, block_prior
from barpc.ba.parameters.priors import EarlierScene
from barpc.ba.result import moved_px
from barpc.ba.solving.linear import Blocks
from barpc.base.errors import DisconnectedError, InputError, TiePointError
from barpc.base.geodesy import ecef_from_ground
from barpc.scene import IntArray
from barpc.sensor.geometry import ground_sample_distance
from barpc.simulate import SimulatedBlock, simulate_block
from tests.ba.grown import corners, part


def met(made: SimulatedBlock, have: IntArray, new: IntArray) -> IntArray:
    """The new views, and those that they share tie points with."""
    every = np.union1d(have, new)
    return np.union1d(every[np.unique(part(made, every, new)[1].view)], new)


def add(made: SimulatedBlock, have: IntArray, new: IntArray, prior: BlockPrior, **given: Any) -> Adjustment:
    views, tracks = part(made, met(made, have, new), new)
    return adjust_tracks(views, tracks, prior=prior, known=np.ones(len(tracks), dtype=bool), **given)


def random_prior(count: int, size: int = 3, less: int = 0) -> BlockPrior:
    """A block in a row: each view is tied to the two behind it."""
    rng = np.random.default_rng(count)
    matrix = 0.1 * np.eye(count * size)
    for first in range(count - 2):
        at = slice(first * size, (first + 3) * size)
        root = rng.normal(size=(3 * size, 3 * size))
        matrix[at, at] += root.T @ root
    low = np.linalg.eigvalsh(matrix)[0]
    rows = rng.normal(size=(less, count * size))
    rows *= np.sqrt(0.5 * low / max(np.linalg.norm(rows, 2) ** 2, 1e-9)) if less else 1.0
    scene = EarlierScene(rng.normal(size=(10, count * size)), np.eye(10), 100.0)
    names = tuple(f"v{i:03d}" for i in range(count))
    centers = rng.normal(size=(count, 3)) + 7e6
    params, blocks = rng.normal(size=(count, size)), Blocks.of(matrix, size)
    return BlockPrior(names, "rotation", 0, params, blocks, centers, rows, scene=scene, told=np.ones(count))


@pytest.mark.parametrize("less", [0, 2])
@pytest.mark.parametrize("kept", [[0], [3, 4, 30], [69, 2], list(range(70))])
def test_a_block_that_views_are_taken_off_knows_of_the_others_what_it_knew(kept: list[int], less: int) -> None:
    """Covariance, and that of the scene's motions; in the order of the block, whatever order is asked for."""
    prior = random_prior(70, less=less)
    found = prior.marginal([prior.names[i] for i in kept])
    at = (np.sort(kept)[:, None] * 3 + np.arange(3)).ravel()
    covariance = np.linalg.inv(prior.dense())
    np.testing.assert_allclose(np.linalg.inv(found.dense()), covariance[np.ix_(at, at)], rtol=1e-8, atol=1e-9)
    assert found.names == tuple(prior.names[i] for i in sorted(kept))
    np.testing.assert_array_equal(found.params, prior.params[np.sort(kept)])
    whole = prior.scene.own + prior.scene.by_unknown @ covariance @ prior.scene.by_unknown.T
    marginal = found.scene.own + found.scene.by_unknown @ covariance[np.ix_(at, at)] @ found.scene.by_unknown.T
    np.testing.assert_allclose(marginal, whole, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("less", [0, 2])
def test_what_a_later_run_found_is_put_where_it_belongs(less: int) -> None:
    """Against the dense algebra: the others move as their covariance says, and the new one stands behind."""
    prior = random_prior(70, less=less)
    known = prior.marginal(["v010", "v011", "v050"])
    rng = np.random.default_rng(5)
    root, moved = rng.normal(size=(12, 12)), rng.normal(size=(3, 3))
    information = root.T @ root
    information[:9, :9] += known.dense()
    later = replace(
        known,
        names=(*known.names, "new"),
        params=np.vstack([known.params + moved, rng.normal(size=(1, 3))]),
        information=information,
        center=np.vstack([known.center, np.ones((1, 3))]),
        told=np.ones(4),
        layout=None,
        rest=None,
    )  # fmt: skip
    grown = known.joined(later)
    at = (np.array([10, 11, 50, 70])[:, None] * 3 + np.arange(3)).ravel()
    wanted = np.zeros((213, 213))
    wanted[:210, :210] = prior.dense()
    wanted[np.ix_(at, at)] += root.T @ root
    np.testing.assert_allclose(grown.dense(), wanted, atol=1e-9 * np.abs(wanted).max())
    covariance = np.linalg.inv(prior.dense())
    shift = covariance[:, at[:9]] @ np.linalg.solve(covariance[np.ix_(at[:9], at[:9])], moved.ravel())
    np.testing.assert_allclose(grown.params[:70].ravel(), prior.params.ravel() + shift, atol=1e-8)
    np.testing.assert_array_equal(grown.params[70], later.params[3])
    assert grown.names[-1] == "new"


def test_a_grown_block_is_read_as_it_was_written_and_a_damaged_one_is_refused(tmp_path) -> None:
    prior = random_prior(40, less=2)
    prior.save(tmp_path / "block.npz")
    read = BlockPrior.load(tmp_path / "block.npz")
    np.testing.assert_array_equal(read.dense(), prior.dense())
    np.testing.assert_array_equal(read.told, prior.told)
    with np.load(tmp_path / "block.npz") as file:
        arrays = dict(file)
    pairs = arrays["pair_view"]
    wrong = [
        {"pair_view": pairs[::-1]}, {"pair_view": pairs[:, ::-1]}, {"pair_view": pairs + 1}, {"pair_view": pairs - 1},
        {"pair_view": pairs.astype(float)}, {"pair_view": pairs[:-1]}, {"pairs": arrays["pairs"][:-1]},
        {"pairs": arrays["pairs"] * np.nan}, {"diagonal": -arrays["diagonal"]}, {"diagonal": arrays["diagonal"][1:]},
        {"told": -np.ones(40)}, {"told": np.ones(39)}, {"shown": np.ones((5, 2))}, {"shown": np.full((4, 2), np.nan)},
    ]  # fmt: skip
    for damaged in wrong:
        np.savez(tmp_path / "block.npz", **{**arrays, **damaged})
        with pytest.raises(InputError, match=r"block\.npz: not the prior of an adjusted block"):
            BlockPrior.load(tmp_path / "block.npz")
    low = prior.dense() - 2.0 * np.linalg.eigvalsh(prior.dense())[3] * np.eye(120)
    with pytest.raises(InputError, match="information is damaged"):
        replace(prior, information=Blocks.of(low, 3), less=None).marginal(["v000"])
    with pytest.raises(InputError, match="none of these views"):
        prior.marginal(["another"])


@pytest.fixture(scope="module")
def sixty() -> tuple[SimulatedBlock, IntArray, IntArray, BlockPrior, Adjustment]:
    made, new = simulate_block(61, 61 * 60, seed=7), np.array([30])
    have = np.setdiff1d(np.arange(61), new)
    prior = block_prior(adjust_tracks(*part(made, have), hold_out=False))
    return made, have, new, prior, adjust_tracks(made.views, made.tracks, hold_out=False)


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore:.*constrained in height")
def test_an_image_more_is_adjusted_as_with_the_whole_block(sixty) -> None:
    """Its camera, what is known of it and of its neighbours, and the block of all; by the neighbours alone."""
    made, have, new, prior, whole = sixty
    found = add(made, have, new, prior, hold_out=False)
    assert 3 < len(found.names) < 30
    v, view = found.names.index("view_0030"), made.views[30]
    off = found.sensors[v].project(corners(view)) - whole.sensors[30].project(corners(view))
    assert np.linalg.norm(off, axis=1).max() < 0.02
    grown, again = block_prior(found), block_prior(whole)
    assert grown.names == (*prior.names, "view_0030")
    known = [np.linalg.inv(one.marginal(grown.names).dense()).diagonal().reshape(61, -1) for one in (grown, again)]
    order = np.argsort(grown.names)
    ratio = np.sqrt(known[0][order] / known[1])
    assert ratio.min() > 0.98  # old tie points that the new image observes do not count twice
    assert ratio.max() < 1.02


@pytest.mark.filterwarnings("ignore:.*constrained in height")
def test_images_that_move_are_said_to_by_as_much_as_they_do(sixty) -> None:
    """Against the corrected cameras themselves, where each image sees the middle of its scene."""
    made, have, new, prior, _ = sixty
    grown = block_prior(add(made, have, new, prior, hold_out=False))
    views = [made.views[i] for i in have]
    middle = np.array([view.sensor.localize((np.array(view.size) - 1) / 2, view.altitude) for view in views])
    pixel = np.array([ground_sample_distance(v.sensor, g)[1] for v, g in zip(views, middle, strict=True)])
    said = moved_px(prior, grown, ecef_from_ground(middle), pixel)
    unknowns = adjust_tracks(*part(made, have), hold_out=False).cameras.unknowns
    before, after = (unknowns.corrected(one.params[:60], views) for one in (prior, grown))
    pairs = zip(before, after, middle, strict=True)
    true = np.array([np.linalg.norm(b.project(g) - a.project(g)) for b, a, g in pairs])
    assert true.max() > 0.02  # or nothing is tested
    assert (said > 0.8 * true - 0.005).all()
    assert np.median(said / true) < 1.5


def test_old_views_need_no_tie_points_and_new_ones_do(sixty) -> None:
    made, _, new, prior, _ = sixty
    views, tracks = part(made, np.arange(61), new)
    found = adjust_tracks(views, tracks, prior=prior)
    assert len(found.names) == 61
    assert (found.observations == 0).sum() > 20
    far = np.array([0, 1, 30])
    with pytest.raises((TiePointError, DisconnectedError)):
        adjust_tracks(*part(made, far, new), prior=prior)


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*constrained in height")
@pytest.mark.parametrize("seed", range(12))
def test_a_block_that_grows_by_one_and_two_knows_its_cameras_as_the_whole_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(9, 22))
    made = simulate_block(count, 40 * count, seed=seed)
    have = np.sort(rng.choice(count, int(0.6 * count), replace=False))
    rest = rng.permutation(np.setdiff1d(np.arange(count), have))
    found = adjust_tracks(*part(made, have))
    while len(rest):
        new, rest = np.sort(rest[: 1 + seed % 2]), rest[1 + seed % 2 :]
        found = add(made, have, new, block_prior(found))
        have = np.union1d(have, new)
    grown, whole = block_prior(found), block_prior(adjust_tracks(made.views, made.tracks))
    order = [grown.names.index(name) for name in whole.names]
    known = [np.linalg.inv(one.marginal(one.names).dense()).diagonal().reshape(count, -1) for one in (grown, whole)]
    ratio = np.sqrt(known[0][order] / known[1])[:, :6]  # (drifts are as the first run thought they would be)
    assert ratio.min() > 0.9
    assert ratio.max() < 1.1
