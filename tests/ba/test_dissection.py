"""The order of elimination, of sites and of graphs that adversaries would tie: cut at once, and if it can be, well."""

from __future__ import annotations

import signal
import time
from contextlib import contextmanager

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.optimize import linear_sum_assignment

from barpc.ba.solving import structure
from barpc.ba.solving.structure import Dissection, dissect
from tests.lanes import rest_slow

KINDS = ("ring", "grid", "clique", "star", "two cliques", "time series", "random", "parts", "path of cliques")


def _pairs(kind: str, n: int, rng: np.random.Generator) -> np.ndarray:
    """Who is tied to whom, in an order of the views that says nothing."""
    every = np.stack(np.triu_indices(n, 1), axis=1)
    i, j = every.T
    near = int(rng.integers(3, 40))
    column, row = np.arange(n) % int(np.ceil(np.sqrt(n))), np.arange(n) // int(np.ceil(np.sqrt(n)))
    tied = {
        "ring": lambda: (j - i <= near // 4) | (n - (j - i) <= near // 4),
        "grid": lambda: np.maximum(abs(column[i] - column[j]), abs(row[i] - row[j])) <= 1 + near // 20,
        "clique": lambda: np.ones(len(i), dtype=bool),
        "star": lambda: i == 0,
        "two cliques": lambda: (i < n // 3) == (j < n // 3),
        "time series": lambda: j - i <= near,
        "random": lambda: rng.random(len(i)) < near / n,
        "parts": lambda: (i // 70 == j // 70) & (j - i < near),
        "path of cliques": lambda: (i // near == j // near) | (j - i == near),
    }[kind]()
    if kind == "two cliques":  # 8 ties between them
        tied[np.flatnonzero((i < n // 3) & (j >= n // 3))[:: n**2 // 30]] = True
    return np.sort(rng.permutation(n)[every[tied]], axis=1)


def sites_of(columns: int, rows: int, a_site: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of views tied to those of the eight sites around theirs, and where all stand."""
    row, column = np.divmod(np.arange(columns * rows * a_site) // a_site, columns)
    i, j = np.triu_indices(len(row), 1)
    near = (abs(row[i] - row[j]) <= 1) & (abs(column[i] - column[j]) <= 1)
    place = np.stack([column, row], axis=1) + np.random.default_rng(0).normal(0, 0.05, (len(row), 2))
    return np.stack([i[near], j[near]], axis=1), 1e4 * place


def _size(order: Dissection, power: int = 1) -> int:
    """Blocks in the factor; of power 2 the products of blocks that it costs."""
    return sum(len(f.pivots) * (len(f.pivots) + len(f.border)) ** power for f in order.fronts)


@contextmanager
def _ends(seconds: int):
    """A guard against hanging: far above what is needed."""

    def late(*_: object) -> None:
        raise AssertionError(f"not ended in {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def assert_sound(order: Dissection, pairs: np.ndarray, use: np.ndarray) -> None:
    """Views in use are ordered, each once; those parted are tied through borders only, which belong to later fronts."""
    every = np.concatenate([front.pivots for front in order.fronts])
    assert sorted(every) == np.flatnonzero(use).tolist()
    assert (order.rank[every] == np.arange(len(every))).all()
    assert (order.rank[~use] == -1).all()
    pairs = pairs[use[pairs].all(axis=1)]
    early, late = np.where(order.rank[pairs[:, 0]] < order.rank[pairs[:, 1]], pairs.T, pairs.T[::-1])
    known = [set(front.pivots) | set(front.border) for front in order.fronts]
    assert all(j in known[order.owner[i]] for i, j in zip(early.tolist(), late.tolist(), strict=True))
    for number, front in enumerate(order.fronts):
        if len(front.border):
            assert front.parent > number
            assert set(front.border) <= known[front.parent]
            assert (np.diff(order.rank[front.border]) > 0).all()


@pytest.mark.few(4)
@pytest.mark.parametrize("kind", KINDS)
def test_graphs_of_every_kind_are_cut_soundly(kind) -> None:
    rng = np.random.default_rng(KINDS.index(kind))
    n = 300
    pairs = _pairs(kind, n, rng)
    place = rng.normal(0, 110, (n, 2)) if kind != "star" else np.zeros((n, 2))
    with _ends(60):
        order = dissect(pairs, place, np.ones(n, dtype=bool))
    assert_sound(order, pairs, np.ones(n, dtype=bool))


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_who_is_parted_is_tied_through_the_border_only(turn) -> None:
    pairs, place = sites_of(12, 9)
    place = place @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    use = np.random.default_rng(1).random(len(place)) < 0.95
    assert_sound(dissect(pairs, place, use), pairs, use)


@pytest.mark.slow
def test_little_fills_in() -> None:
    """A line across a square of 24 sites of 3 is 72 views; a strip fills as many blocks a view however long it is."""
    pairs, place = sites_of(24, 24)
    order = dissect(pairs, place, np.ones(len(place), dtype=bool))
    assert 60 <= max(len(front.pivots) for front in order.fronts) <= 90
    banded = len(place) * (3 * (24 + 2)) ** 2
    assert 0.3 * banded < _size(order, 2) < 0.9 * banded
    a_view = []
    for length in (60, 240):
        pairs, place = sites_of(length, 2)
        a_view.append(_size(dissect(pairs, place, np.ones(len(place), dtype=bool))) / len(place))
    assert 0.8 < a_view[1] / a_view[0] < 1.25
    order = dissect(pairs, place[np.random.default_rng(0).permutation(len(place))], np.ones(len(place), dtype=bool))
    assert _size(order) < 1.1 * a_view[1] * len(place)  # places that lie cost nothing: ties tell


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("seed", rest_slow(range(25), mark=pytest.mark.nightly))
@pytest.mark.parametrize("kind", KINDS[:8])
def test_graphs_of_a_hundred_to_three_thousand_views_are_cut_at_once(kind, seed) -> None:
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    n = int(rng.integers(100, 3001))
    pairs = _pairs(kind, n, rng)
    place = rng.normal(0, 110, (n, 2)) if seed % 3 else np.zeros((n, 2))
    start = time.process_time()
    with _ends(120):
        dissect(pairs, place, np.ones(n, dtype=bool))
    assert time.process_time() - start < 5.0  # 0.9 at most, alone


@pytest.mark.parametrize("spread", [0.0, 110.0])
def test_views_of_one_place_are_ordered_by_their_ties(spread) -> None:
    """A series in which each view is tied to its next k needs n (2 k)^2 products or so wherever its views stand."""
    rng = np.random.default_rng(0)
    n, k = 1000, 39
    first = np.repeat(np.arange(n), k)
    pairs = np.stack([first, first + np.tile(np.arange(1, k + 1), n)], axis=1)
    pairs = np.sort(rng.permutation(n)[pairs[pairs[:, 1] < n]], axis=1)
    order = dissect(pairs, rng.normal(0, spread, (n, 2)), np.ones(n, dtype=bool))
    assert n * k**2 < _size(order, 2) < 3 * n * (2 * k) ** 2
    assert max(len(front.pivots) + len(front.border) for front in order.fronts) < 6 * k


def test_two_cliques_are_parted_between_them_whatever_their_sizes() -> None:
    n = 240
    pairs = _pairs("two cliques", n, np.random.default_rng(0))
    order = dissect(pairs, np.zeros((n, 2)), np.ones(n, dtype=bool))
    sizes = sorted(len(front.pivots) for front in order.fronts)
    assert sizes[-1] > 145
    assert 60 < sizes[-2] <= 80


@pytest.mark.parametrize("seed", range(6))
def test_of_all_cuts_of_an_order_the_best_parts_most_for_the_views_that_touch_it(seed) -> None:
    """Counted view by view, those before a cut and those behind it: the fewer ones are taken out of their side."""
    n, rng = 24, np.random.default_rng(seed)
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    tied = rng.random((n, n)) < np.where(apart < 4, 0.4, 0.01)
    tied[:, int(rng.integers(n))] |= rng.random(n) < 0.5  # a view that many are tied to
    tied |= tied.T | np.eye(n, dtype=bool)
    order = rng.permutation(n)
    graph = sp.csr_array(tied[np.ix_(np.argsort(order), np.argsort(order))].astype(np.int8))
    costs = []
    for cut in range(1, n):
        across = tied[:cut, cut:]
        before, behind = int(across.any(axis=1).sum()), int(across.any(axis=0).sum())
        near, far = (cut - before, n - cut) if before < behind else (cut, n - cut - behind)
        costs.append((min(before, behind) + 1) / (near * far) if near * far else np.inf)
    _, cut, cost = structure.best_cut(graph, order)
    assert cost == pytest.approx(min(costs))
    assert costs[cut - 1] == pytest.approx(min(costs))


def _layered(levels: int) -> sp.csr_array:
    """A row may be reached along 2^levels ways, none of which ends at a free column (scipy issue 26147)."""
    tied = [(2 * d + k, 2 * d + k) for d in range(levels) for k in range(2)]
    tied += [(2 * d + k, 2 * d + 2 + m) for d in range(levels - 1) for k in range(2) for m in range(2)]
    beside = 2 * levels  # a chain as long as that, at whose end a column is free
    tied += [(beside + d, beside + d + m) for d in range(levels) for m in range(2)]
    top = beside + levels
    tied += [(top, 0), (top, 1), (top + 1, beside)]
    row, col = np.array(sorted(tied)).T
    return sp.csr_array((np.ones(len(row), dtype=np.int8), (row, col)), shape=(top + 2, beside + levels + 1))


def _covered(graph: sp.csr_array) -> np.ndarray:
    """What `_vertex_cover` takes, of rows then columns of a bipartite graph."""
    rows, cols = graph.shape
    whole = sp.csr_array(sp.block_array([[None, graph], [graph.T, None]]))
    cover = structure._vertex_cover(whole, np.arange(rows), rows + np.arange(cols))
    row, col = graph.nonzero()
    assert (np.isin(row, cover) | np.isin(rows + col, cover)).all()
    return cover


def test_a_cover_ends_where_a_search_that_forgets_would_not() -> None:
    with _ends(60):
        assert len(_covered(_layered(60))) == 181  # every column is matched


@pytest.mark.parametrize("seed", range(20))
def test_a_cut_takes_as_few_views_as_any_could(seed) -> None:
    """König: the fewest rows and columns that touch all ties are as many as ties that share none."""
    rng = np.random.default_rng(seed)
    tied = rng.random(rng.integers(3, 30, 2)) < rng.uniform(0.02, 0.5)
    row, col = linear_sum_assignment(tied, maximize=True)
    assert len(_covered(sp.csr_array(tied.astype(np.int8)))) == tied[row, col].sum()


def test_parts_that_nothing_ties_are_parted_by_nobody() -> None:
    group = np.random.default_rng(0).permutation(60) % 2
    i, j = np.triu_indices(60, 1)
    pairs = np.stack([i, j], axis=1)[group[i] == group[j]]
    order = dissect(pairs, np.random.default_rng(1).normal(size=(60, 2)), np.ones(60, dtype=bool))
    found = sorted(sorted(front.pivots.tolist()) for front in order.fronts)
    assert found == sorted(np.flatnonzero(group == part).tolist() for part in (0, 1))
    assert all(not len(front.border) and front.parent == -1 for front in order.fronts)
    assert len(_covered(sp.csr_array(np.zeros((3, 4), dtype=np.int8)))) == 0
