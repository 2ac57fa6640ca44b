"""What a reference's points share of their noise is not taken for what the cameras leave, and what cameras leave is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from barpc.ba.constraints.block import join
from barpc.ba.constraints.ground import MAX_INDEPENDENT_ERRORS
from barpc.ba.parameters.unknowns import Unknowns
from barpc.ba.robust.systematic_residuals import NUM_TERMS, NoiseCorrelation, Smooth
from barpc.ba.solving.structure import make_structure
from barpc.base.geodesy import metres_per_unit
from barpc.base.options import AdjustOptions
from barpc.scene import GroundPoints, Reference, Tracks
from barpc.simulate import simulate_block
from tests.lanes import rest_slow

STEP = 20.0  # m: of the reference
TEMPLATE = 33  # px of it
SIZE = np.array([850, 1450])  # px of the image
PIXEL = 6.5  # m
NOISE = 0.5  # px of the image


@pytest.fixture(scope="module")
def view():
    return simulate_block(2, 4, seed=1).views[0]


def registered(view, apart: int, kept: float, rng) -> tuple[Reference, np.ndarray, np.ndarray]:
    """A reference on a lattice `apart` px of it, of which a share is kept; their pixels, their noise (2, n) [px].

    A point's noise is the mean of what every pixel of its template is wrong by: white noise under a box.
    """
    shape = (SIZE[::-1] * PIXEL / STEP).astype(int)
    white = rng.normal(size=(2, shape[0] + 2 * TEMPLATE, shape[1] + 2 * TEMPLATE))
    box = np.array([ndimage.uniform_filter(one, TEMPLATE) for one in white]) * TEMPLATE * NOISE
    rows, cols = (a.ravel() for a in np.mgrid[0 : shape[0] : apart, 0 : shape[1] : apart])
    keep = rng.uniform(size=len(rows)) < kept
    rows, cols = rows[keep], cols[keep]
    local = np.column_stack([cols, -rows]) * STEP
    start = np.array([10.0, 45.0, 200.0])
    place = np.column_stack([start[:2] + local / metres_per_unit(start)[:2], np.full(len(rows), 200.0)])
    n = len(rows)
    xy = np.column_stack([cols, rows]) * STEP / PIXEL
    none = np.zeros(n, np.int64)
    names = tuple(map(str, range(n)))
    points = GroundPoints(names, place, np.full((n, 3), 2.0), np.arange(n), none, xy, np.full(n, NOISE))
    reference = Reference(points, np.full(3, 5.0), np.zeros((1, 2)), TEMPLATE * STEP)
    return reference, xy, box[:, rows + TEMPLATE, cols + TEMPLATE]


def smooth_of(view, reference, ties: np.ndarray | None = None) -> Smooth:
    """The smooth model of one image with a reference's points behind its ties (n, 2), which are good to 0.1 px."""
    ties = np.zeros((0, 2)) if ties is None else ties
    n, xy = len(ties), np.concatenate([ties, reference.points.xy])
    tracks = Tracks(np.zeros(n, np.int64), np.arange(n), ties, np.full(n, 0.1))
    block = join((view,), tracks, None, AdjustOptions(), True, reference)
    half = SIZE[:, None] / 2.0
    unknowns = Unknowns("rotation", 0, np.zeros((1, 3)), np.ones(1), half - 0.5, half)
    structure = make_structure(np.zeros(len(xy), np.int64), np.arange(len(xy)), 1, len(xy))
    return Smooth(structure, block.xy, unknowns, NoiseCorrelation.of(block))


def told(smooth: Smooth, residual: np.ndarray) -> tuple[bool, float, float]:
    """Whether a smooth part is found, its RMS, and what neighbours share [px]."""
    use = np.ones(residual.shape[1], dtype=bool)
    found = smooth.test_neighbours(smooth.test(residual, use), residual, use, 1.0)
    return bool(found.found(0.06)[0]), float(found.rms[0]), float(found.shared[0])


def without(smooth: Smooth) -> Smooth:
    """The same that knows nothing of resemblance."""
    bare = object.__new__(Smooth)
    bare.__dict__.update(smooth.__dict__, noise=None)
    return bare


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("apart", rest_slow([11, 23, 8], keep=2))
def test_noise_that_templates_share_is_no_jitter(view, apart):
    cried, before = [], []
    for seed in range(10):
        reference, _, noise = registered(view, apart, 0.5 if apart < 20 else 1.0, np.random.default_rng(seed))
        smooth = smooth_of(view, reference)
        found, _, shared = told(smooth, noise)
        cried.append(found or shared > 0.06)
        found, _, shared = told(without(smooth), noise)
        before.append(found or shared > 0.06)
    assert sum(cried) == 0
    if apart < 20:
        assert sum(before) >= 8


@pytest.mark.parametrize("axis", [0, 1])
def test_a_reference_that_bends_is_told_and_by_how_much(view, axis):
    reference, xy, noise = registered(view, 11, 0.5, np.random.default_rng(3))
    bend = np.zeros_like(noise)
    bend[axis] = 1.2 * np.sin(2 * np.pi * 3.0 * xy[:, 1] / SIZE[1])
    found, rms, _ = told(smooth_of(view, reference), bend + noise)
    assert found
    assert rms == pytest.approx(1.2 / np.sqrt(2.0), rel=0.3)


def test_many_points_tell_a_bend_that_is_less_than_their_noise(view):
    """Templates of their own: a bend of 0.42 px RMS under 0.5 px of noise a coordinate, 5000 points."""
    rng = np.random.default_rng(0)
    reference, xy, _ = registered(view, 5, 1.0, rng)
    reference = replace(reference, width=0.0)
    noise = rng.normal(0.0, NOISE, (2, len(xy)))
    bend = np.zeros_like(noise)
    bend[0] = 0.6 * np.sin(2 * np.pi * 2.0 * xy[:, 1] / SIZE[1])
    smooth = smooth_of(view, reference)
    assert told(smooth, bend + noise)[0]
    assert not told(smooth, noise)[0]


def test_ties_tell_what_they_told_beside_a_coarse_reference(view):
    rng = np.random.default_rng(5)
    reference, _, noise = registered(view, 11, 0.5, rng)
    ties = rng.uniform(0, 1, (800, 2)) * (SIZE - 1)
    smooth = smooth_of(view, reference, ties)
    white = rng.normal(0.0, 0.1, (2, len(ties)))
    assert told(smooth, np.concatenate([white, noise], axis=1))[0] is False
    assert told(smooth, np.concatenate([white, noise], axis=1))[2] == 0.0
    bend = 0.2 * np.sin(2 * np.pi * 3.0 * ties[:, 1] / SIZE[1])
    found, rms, _ = told(smooth, np.concatenate([white + [bend, 0 * bend], noise], axis=1))
    assert found
    assert rms == pytest.approx(0.2 / np.sqrt(2.0), rel=0.3)


def test_what_points_have_in_common_is_what_their_templates_cover_together(view):
    rng = np.random.default_rng(1)
    reference, _, _ = registered(view, 11, 1.0, rng)
    smooth = smooth_of(view, reference)
    alike = smooth.noise
    assert alike is not None
    n = len(reference.points.names)
    per_row = int((reference.points.xy[:, 1] == 0).sum())
    assert alike.overlap(np.array([0]), np.array([1]))[0] == pytest.approx(2 / 3, rel=1e-2)
    assert alike.overlap(np.array([0]), np.array([per_row + 1]))[0] == pytest.approx(4 / 9, rel=1e-2)
    assert alike.overlap(np.array([0]), np.array([3]))[0] == pytest.approx(0.0, abs=1e-2)
    assert alike.correlation(np.array([0]), np.array([n - 1]))[0] == pytest.approx(1.0 / MAX_INDEPENDENT_ERRORS)
    # in the middle of a lattice three templates each way cover a place
    assert 1.0 / alike.share[0] == pytest.approx(9.0 + n / (NUM_TERMS * MAX_INDEPENDENT_ERRORS), rel=0.25)
    lonely = smooth_of(view, replace(reference, width=0.0)).noise
    assert lonely is not None
    assert 1.0 / lonely.share[0] == pytest.approx(1.0 + n / (NUM_TERMS * MAX_INDEPENDENT_ERRORS))
