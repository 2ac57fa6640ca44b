"""What a block leaves for the next one: written, read, refused where it is damaged, and put where it belongs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from barpc.ba.constraints.incremental import BlockPrior, apply_prior
from barpc.ba.parameters.additional_parameters import AdditionalParameters
from barpc.ba.parameters.priors import CameraPrior, EarlierScene
from barpc.ba.result import block_prior
from barpc.base.errors import InputError
from barpc.base.geodesy import Array
from barpc.simulate import simulate_block
from tests.ba.conftest import solve
from tests.constants import Sized


def prior_of(names: tuple[str, ...] = ("a", "c"), size: int = 3) -> BlockPrior:
    rng = np.random.default_rng(0)
    n = len(names)
    root = rng.normal(size=(n * size, n * size))
    params, information = rng.normal(size=(n, size)), root.T @ root + np.eye(n * size)
    return BlockPrior(names, "rotation", 0, params, information, rng.normal(size=(n, 3)))


def same(a: BlockPrior, b: BlockPrior) -> bool:
    arrays = all(np.array_equal(getattr(a, x), getattr(b, x)) for x in ("params", "information", "center"))
    return arrays and (a.names, a.model, a.drift) == (b.names, b.model, b.drift)


def again(prior: BlockPrior, folder: Path) -> BlockPrior:
    """A prior, written and read."""
    prior.save(folder / "prior.npz")
    return BlockPrior.load(folder / "prior.npz")


def refused(prior: BlockPrior, folder: Path) -> str:
    """What is said of a prior that is written and refused."""
    with pytest.raises(InputError, match=r"prior\.npz: not the prior of an adjusted block") as caught:
        again(prior, folder)
    return str(caught.value)


def test_a_prior_is_read_as_it_was_written(tmp_path) -> None:
    for prior in (prior_of(), prior_of(("one",)), replace(prior_of(), model="affine", drift=2)):
        assert same(again(prior, tmp_path), prior)


STRIPS = np.random.default_rng(3).uniform(0.0, 9.0, (2, 3, 5))
SWINGS = np.array([[200.0, 80.5], [600.0, np.inf]])


@pytest.mark.parametrize(
    ("kind", "given", "size", "wrong"),
    [
        ("steps", STRIPS, 6, (STRIPS[:1], STRIPS[..., :4], STRIPS[0])),
        ("periods", SWINGS, 8, (SWINGS[:1], SWINGS[0], -SWINGS, SWINGS * np.nan)),
    ],
    ids=["strips", "swings"],
)
def test_strips_and_swings_are_read_as_they_were_written_and_a_new_view_has_none(
    tmp_path, kind: str, given: Array, size: int, wrong: tuple[Array, ...]
) -> None:
    def prior(value: Array) -> BlockPrior:
        return replace(prior_of(), layout=AdditionalParameters(0, **{kind: value}))

    found = again(prior(given), tmp_path).waves(("c", "new", "a"))
    np.testing.assert_array_equal(getattr(found, kind)[[2, 0]], given)
    assert np.isinf(getattr(found, kind)[1]).all()
    assert found.size == size
    for damaged in wrong:
        refused(prior(damaged), tmp_path)


def test_a_scene_is_read_as_it_was_written_and_a_damaged_one_is_refused(tmp_path) -> None:
    rng = np.random.default_rng(1)
    scene = EarlierScene(rng.normal(size=(10, 6)), np.eye(10), 300.0)
    found = again(replace(prior_of(), scene=scene), tmp_path).scene
    np.testing.assert_array_equal(found.by_unknown, scene.by_unknown)
    np.testing.assert_array_equal(found.own, scene.own)
    assert found.radius == 300.0
    by_unknown, own = scene.by_unknown, scene.own
    wrong: list[dict[str, Any]] = [
        *({"by_unknown": one} for one in (by_unknown[:7], by_unknown[:, :5], by_unknown * np.nan)),
        *({"own": one} for one in (own[:7], own.astype(int), own * 1e101)),
        *({"radius": one} for one in (0.0, -1.0, np.nan, np.inf, np.ones(2), "wide")),
    ]
    for damaged in wrong:
        refused(replace(prior_of(), scene=replace(scene, **damaged)), tmp_path)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("names", lambda x: ("a", "a")),
        ("names", lambda x: ("a",)),
        ("names", lambda x: ("a", "b", "c")),
        ("names", lambda x: ()),
        ("params", lambda x: x[:, :2]),
        ("params", lambda x: x[0]),
        ("params", lambda x: np.float64(3.0)),
        ("params", lambda x: x[:, :0]),
        ("params", lambda x: np.where(x == x[1, 2], np.nan, x)),
        ("params", lambda x: x.astype(np.float32)),
        ("information", lambda x: x[:5, :5]),
        ("information", lambda x: x[:5]),
        ("information", lambda x: np.where(np.eye(6) * (np.arange(6) == 4), 0.0, x)),
        ("information", lambda x: np.where(np.eye(6) * (np.arange(6) == 4), -1.0, x)),
        ("information", lambda x: np.where(x == x[0, 1], np.inf, x)),
        ("information", lambda x: np.where(x == x[0, 1], 1e101, x)),
        ("params", lambda x: np.where(x == x[1, 2], -1e308, x)),
        ("information", lambda x: x.astype(int)),
        ("center", lambda x: x[:1]),
        ("center", lambda x: x[:, :2]),
        ("center", lambda x: np.where(x == x[0, 0], np.nan, x)),
    ],
)
def test_arrays_that_do_not_go_together_are_refused(tmp_path, name: str, change: Any) -> None:
    prior = prior_of()
    refused(replace(prior, **{name: change(getattr(prior, name))}), tmp_path)


def test_a_prior_stands_at_its_views_wherever_they_are_now() -> None:
    prior = prior_of(("c", "a"))
    own = CameraPrior(np.full((4, 3), 7.0), np.arange(12.0).reshape(4, 3) + 1)
    cameras, joint = apply_prior(prior, ("a", "b", "c", "d"), "rotation", 0, own)
    np.testing.assert_array_equal(cameras.mean, [prior.params[1], [7.0] * 3, prior.params[0], [7.0] * 3])
    np.testing.assert_array_equal(np.isinf(cameras.sigma).all(axis=1), [True, False, True, False])
    np.testing.assert_array_equal(cameras.sigma[[1, 3]], own.sigma[[1, 3]])
    assert joint.index.tolist() == [6, 7, 8, 0, 1, 2]
    np.testing.assert_array_equal(joint.mean, prior.params.ravel())
    np.testing.assert_allclose(joint.information, prior.information)
    assert np.isfinite(own.sigma).all()  # what was given is not touched


@pytest.mark.parametrize(
    ("prior", "names", "model", "drift", "message"),
    [
        (prior_of(), ("a", "c"), "rotation", 1, "use the same"),
        (prior_of(), ("a", "c"), "affine", 0, "use the same"),
        (prior_of(size=4), ("a", "c"), "rotation", 0, "has 4 unknowns a view, not 3"),
    ],
)  # fmt: skip
def test_a_prior_of_another_block_is_refused(prior, names, model, drift, message) -> None:
    with pytest.raises(InputError, match=message):
        apply_prior(prior, names, model, drift, CameraPrior(np.zeros((len(names), 3)), np.ones((len(names), 3))))


def test_a_block_leaves_what_it_knows_of_its_free_views() -> None:
    made = simulate_block(3, 100, seed=5)
    found = solve(made, drift=0, fixed=("view_0001",))
    prior = block_prior(found)
    assert prior.names == ("view_0000", "view_0002")
    assert (prior.model, prior.drift) == ("rotation+translation", 0)
    np.testing.assert_array_equal(prior.params, found.params[[0, 2]])
    np.testing.assert_array_equal(prior.center, found.cameras.unknowns.center[[0, 2]])
    free = np.r_[0:6, 12:18]
    np.testing.assert_allclose(
        np.linalg.inv(prior.information), found.covariance.full[np.ix_(free, free)], rtol=1e-5, atol=1e-9
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*constrained in height")
def test_a_large_block_leaves_a_sparse_matrix_that_says_the_same(sized: Sized, tmp_path) -> None:
    made = simulate_block(6, 300, seed=5)
    dense = block_prior(solve(made, fixed=("view_0001",), min_convergence=60.0))
    sized(dense_views=0)
    read = again(block_prior(solve(made, fixed=("view_0001",), min_convergence=60.0)), tmp_path)
    assert len(read.less) == 3  # all heights are held, and wrong together
    scale = np.sqrt(np.outer(dense.information.diagonal(), dense.information.diagonal()))
    np.testing.assert_allclose(read.dense() / scale, dense.information / scale, atol=2e-8)
    assert np.abs((read.information.plain() - dense.information) / scale).max() > 5e-8
    for name, damaged in (("less", np.full((3, 45), np.nan)), ("less", np.zeros((3, 44)))):
        assert "do not go together" in refused(replace(read, **{name: damaged}), tmp_path)


@pytest.mark.parametrize(
    ("splines", "edges", "whole"),
    [
        (0, np.zeros((2, 0)), True),
        (3, np.zeros((2, 0)), False),  # fewer than a cubic has
        (4, np.zeros((2, 0)), True),
        (5, np.zeros((2, 0)), True),
        (6, np.zeros((2, 0)), False),  # more than unknowns
        (0, np.zeros((3, 1)), False),
        (0, np.zeros(2), False),
    ],
)
def test_a_layout_of_splines_that_no_block_has_is_refused(tmp_path, splines: int, edges: Any, whole: bool) -> None:
    given = replace(prior_of(size=5), layout=AdditionalParameters(splines, edges))
    if not whole:
        assert "do not go together" in refused(given, tmp_path)
        return
    read = again(given, tmp_path)
    assert read.layout.count == splines
    np.testing.assert_array_equal(read.layout.edges, edges)


def test_views_go_on_with_their_own_detectors_and_new_ones_with_none() -> None:
    edges = np.array([[5.0, np.inf], [7.0, 9.0]])
    prior = replace(prior_of(), layout=AdditionalParameters(9, edges))
    waves = prior.waves(("new", "c", "a"))
    assert waves.count == 9
    np.testing.assert_array_equal(waves.edges, [[np.inf] * 2, [7.0, 9.0], [5.0, np.inf]])
    none = np.zeros((2, 0))
    for layout, some in ((None, False), (AdditionalParameters(0, none), False), (AdditionalParameters(9, none), True)):
        assert (replace(prior, layout=layout).waves(("a",)) is not None) == some
    only_edges = replace(prior, layout=AdditionalParameters(0, edges)).waves(("a",))
    assert only_edges.count == 0
