"""Ground without tie points is said where there is as much to see as beside it, and nowhere else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from scipy import ndimage

from barpc.rasters.raster import open_raster
from barpc.scene import View
from barpc.sensor.geometry import footprint
from barpc.tie import Area, Scope, find_tracks
from barpc.tie.detail import PARTS_PER_SIDE, Gap, gap, in_parts, seen_detail
from barpc.tie.matchers.features import Keypoints
from barpc.tie.tracks import TieResult
from tests.geotiffs import write_image

SIZE = (640, 1280)


def counts(rng: np.random.Generator, share: np.ndarray, a_part: float = 60.0) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints, alike in all columns, and ties, of which rows have so large a share."""
    keypoints = rng.poisson(a_part, (2, PARTS_PER_SIDE))
    ties = rng.binomial(keypoints[1], share)
    return keypoints, np.stack([rng.multinomial(ties.sum(), np.full(PARTS_PER_SIDE, 1 / PARTS_PER_SIDE)), ties])


@pytest.mark.parametrize(("first", "last"), [(20, 26), (0, 9), (50, 64), (12, 44)])
def test_rows_without_ties_are_found_and_nothing_beside_them(first: int, last: int) -> None:
    """With a false one now and then; where half of the rows lack most of them are named."""
    for seed in range(20):
        share = np.full(PARTS_PER_SIDE, 0.5)
        share[first:last] = 0.001
        found = gap(*counts(np.random.default_rng(seed), share), SIZE)
        assert found is not None
        assert found.axis == 1
        assert found.first >= 20 * first
        assert found.last < 20 * last
        assert found.last + 1 - found.first >= 0.6 * 20 * (last - first)
        assert found.found <= 0.05 * found.expected


@pytest.mark.parametrize("seed", range(5))
def test_what_varies_is_no_gap(seed: int) -> None:
    """Even ties, shares that fall to a fifth, a slope to nothing, and few keypoints of all."""
    rng, x = np.random.default_rng(seed), np.linspace(0, 1, PARTS_PER_SIDE)
    for share in (np.full(PARTS_PER_SIDE, 0.4), np.where((x > 0.3) & (x < 0.6), 0.1, 0.5), 0.5 * x):
        for a_part in (2.0, 20.0, 300.0):
            assert gap(*counts(rng, share, a_part), SIZE) is None
    none = np.zeros((2, PARTS_PER_SIDE), np.int64)
    assert gap(none, none, SIZE) is None
    assert gap(np.full((2, PARTS_PER_SIDE), 50), none, SIZE) is None  # it is not tied by keypoints at all


@pytest.mark.parametrize("lost", [0, 3, 10])
def test_where_there_is_nothing_to_see_nothing_lacks(lost: int) -> None:
    """Water with a shore that no tie is found on, and rows at an end that no partner sees."""
    rng = np.random.default_rng(lost)
    keypoints, ties = counts(rng, np.full(PARTS_PER_SIDE, 0.5))
    water = slice(20, 40)
    keypoints[1, water] = rng.poisson(0.3, 20)
    keypoints[1, [20, 39]] = 200
    ties[1, water] = rng.poisson(lost / 20, 20)
    assert gap(keypoints, ties, SIZE) is None
    keypoints[1, 50:] = 0
    ties[1, 52:] = 0  # some stand where relief may hide them
    assert gap(keypoints, ties, SIZE) is None


def test_few_of_many_are_found_where_chance_would_not_hide_them() -> None:
    """Once in a million images: so few as none of 19 are borne, none of 38 are not."""
    detail = np.full((2, PARTS_PER_SIDE), 10)
    for parts, told in ((2, False), (4, True)):
        ties = np.full((2, PARTS_PER_SIDE), 10)
        ties[1, 30 : 30 + parts] = 0
        found = gap(detail, ties, SIZE)
        assert (found == Gap(1, 600.0, 679.0, 0, 38)) if told else found is None


def changed(view: View, folder: Path, rows: slice, sigma: float) -> View:
    """The image with a texture of its own in some rows."""
    with open_raster(view.path) as image:
        pixels = image.read(1)
    noise = ndimage.gaussian_filter(np.random.default_rng(1).normal(0, 1, pixels[rows].shape), 1.5)
    pixels[rows] = (np.median(pixels) + sigma * noise / noise.std()).clip(1, 60000)
    return replace(view, path=str(write_image(folder / f"{view.name}_changed.tif", pixels)))


def lacking(views: list[View], ties: TieResult) -> list[Gap | None]:
    tracks = ties.tracks
    each = [in_parts(tracks.xy[tracks.view == v], view.size) for v, view in enumerate(views)]
    return [gap(detail, own, view.size) for view, detail, own in zip(views, ties.detail, each, strict=True)]


@pytest.mark.parametrize(("sigma", "told"), [(300.0, True), (0.5, False)])
def test_rows_of_another_texture_are_told_of_the_image_that_has_them(three, tmp_path, sigma: float, told: bool) -> None:
    """Of three images; where it is water, of which the others show the land, nothing of its own lacks."""
    views = [three.views[0], changed(three.views[1], tmp_path, slice(100, 200), sigma), three.views[2]]
    without, found, other = lacking(views, find_tracks(views))
    assert (without, other) == (None, None)
    assert (found is not None) is told
    if found is not None:
        assert found.axis == 1
        assert 90 <= found.first <= 120
        assert 180 <= found.last <= 210


def cloud(pixels: np.ndarray) -> np.ndarray:
    """Brighter than all else, with a texture of its own."""
    rng, bright = np.random.default_rng(2), np.percentile(pixels, 99)
    soft, fine = (ndimage.gaussian_filter(rng.normal(0, 1, pixels.shape), blur) for blur in (6.0, 0.8))
    return bright * (1.0 + 0.1 * soft / soft.std()) + 6.0 * fine / fine.std()


def sea(pixels: np.ndarray) -> np.ndarray:
    noise = ndimage.gaussian_filter(np.random.default_rng(3).normal(0, 1, pixels.shape), 0.5)
    return np.percentile(pixels, 2) + 3.0 * noise / noise.std()


def turned(pixels: np.ndarray) -> np.ndarray:
    """The same ground, in a place where no matcher looks for it."""
    return pixels[::-1, ::-1]


BANDS = (
    (turned, 1, 200, 300),
    (cloud, 1, 200, 300),
    (cloud, 1, 200, 240),
    (cloud, 1, 0, 60),  # strips along the edges, of which partners show the ground
    (cloud, 1, 480, 530),
    (cloud, 0, 0, 80),
    (turned, 0, 400, 500),
    (sea, 1, 200, 300),
)


@pytest.mark.landing(2)
@pytest.mark.few(1)
@pytest.mark.parametrize(("content", "axis", "first", "last"), BANDS)
def test_bands_of_a_real_image_are_told_and_water_is_not(triplet, tmp_path, content, axis, first, last) -> None:
    """Of the image that has them alone; at its ends as far as partners see its rows."""
    views = list(triplet)
    with open_raster(views[1].path) as image:
        pixels = image.read(1)
    part = np.s_[first:last] if axis else np.s_[:, first:last]
    pixels[part] = np.rint(content(pixels[part].astype(float)).clip(1, 60000))
    views[1] = replace(views[1], path=str(write_image(tmp_path / "changed.tif", pixels)))
    without, found, other = lacking(views, find_tracks(views))
    assert (without, other) == (None, None)
    assert (found is None) is (content is sea)
    if found is not None:
        side = pixels.shape[1 - axis] / PARTS_PER_SIDE
        assert found.axis == axis
        assert first - 2 * side <= found.first <= first + 2.5 * side
        assert last - 2 * side <= found.last <= last + 2 * side
        assert 30 < found.expected < 300


@pytest.mark.slow
@pytest.mark.parametrize("band", [None, slice(60, 120), slice(0, 50)])
def test_a_scene_smaller_than_any_window_has_its_bands(triplet, tmp_path, band: slice | None) -> None:
    """200 px of a real triplet: some six keypoints in three rows, of which the poorest three have one by chance."""
    views, side = [], 200
    for number, (view, (col, row)) in enumerate(zip(triplet, [(300, 180), (300, 150), (296, 118)], strict=True)):
        with open_raster(view.path) as image:
            pixels = image.read(1)[row : row + side, col : col + side]
        if band is not None and number == 1:
            pixels[band] = turned(pixels[band])
        path = write_image(tmp_path / f"{number}.tif", pixels)
        views.append(replace(view, path=str(path), size=(side, side), sensor=view.sensor.crop(col, row)))
    without, found, other = lacking(views, find_tracks(views))
    assert (without, other) == (None, None)
    assert (found is None) is (band is None)
    if found is not None:
        assert found.axis == 1
        assert band.start - 10 <= found.first <= band.start + 15
        assert band.stop - 10 <= found.last <= band.stop + 10


def test_few_keypoints_are_counted_in_fewer_parts() -> None:
    """Four a part: the poorest of eight has one, and no gap could be told; in parts of four times that it is."""
    share = np.full(PARTS_PER_SIDE, 0.9)
    share[24:40] = 0.0
    told = [gap(*counts(np.random.default_rng(seed), share, 4.0), SIZE) for seed in range(40)]
    known = [one for one in told if one is not None]
    assert len(known) >= 36
    assert all(one.axis == 1 and one.first >= 440 and one.last <= 840 for one in known)


@pytest.mark.nightly
def test_clean_images_lack_nothing(three, triplet, triplet_ties, ventoux, ventoux_ties) -> None:
    for views, ties in ((three.views, three.tied), (triplet, triplet_ties), (ventoux, ventoux_ties)):
        assert lacking(views, ties) == [None] * len(views)
        assert all(detail.sum() > 200 for detail in ties.detail)


def test_beside_an_area_of_interest_nothing_is_expected(scene) -> None:
    """Half of the images is of interest: the other half has as much to see and no tie point."""
    views = scene.views
    ring = footprint(views[0].sensor, views[0].size, views[0].altitude)[:, :2]
    low, high = ring.min(axis=0), ring.max(axis=0)
    half = Area(shapely.box(low[0], low[1], high[0], 0.5 * (low[1] + high[1])))
    ties = find_tracks(views, scope=Scope(area=half))
    assert ties.tracks.num_points > 50
    assert lacking(views, ties) == [None, None]


@pytest.mark.parametrize("lost", [False, True])
def test_where_only_an_unlike_image_looks_fewer_ties_are_expected(lost: bool) -> None:
    """One partner sees the left third and ties 40 % of its keypoints; one of another side sees all and ties 0.4 %."""
    rng, size = np.random.default_rng(7), (600, 600)
    xy = rng.uniform(0, 599, (6000, 2))
    keypoints = Keypoints(xy, np.ones(6000), np.zeros(6000), rng.uniform(1, 2, 6000), np.zeros((6000, 4), np.uint8))
    first = (xy[:, 0] < 200) & (rng.uniform(size=6000) < 0.4)
    second = rng.uniform(size=6000) < 0.004
    if lost:
        first &= (xy[:, 1] < 250) | (xy[:, 1] > 350)
    moved = xy + [400.0, 0.0], xy + rng.normal(0, 1, xy.shape)
    partners = [(xy[one], there[one], size) for one, there in zip((first, second), moved, strict=True)]
    detail = seen_detail(SimpleNamespace(load=lambda: (keypoints, None)), size, partners)  # type: ignore[arg-type]
    found = gap(detail, in_parts(xy[first | second], size), size)
    assert (found is not None) is lost
    if found is not None:
        assert (found.axis, found.found) == (1, pytest.approx(0, abs=8))
        assert 240 <= found.first < found.last <= 360
