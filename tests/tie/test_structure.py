"""Matching of structure: seasons that keypoints refuse, wrong places refused, decoys that say so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from scipy import ndimage

from barpc.base.errors import TiePointError
from barpc.pipeline.loading import load_views
from barpc.scene import View
from barpc.tie import Matches, PairReport, TieOptions, find_tracks
from barpc.tie.matchers import matching, structural
from barpc.tie.matchers.features import join_keypoints
from barpc.tie.matchers.matcher import NO_MATCHES, Prediction
from barpc.tie.matchers.matching import FINE_STRUCTURE, STRUCTURE, GroundAltitudes, _match_within, match_pair
from barpc.tie.matchers.structural import _GridSearch, adjacency, lattice_points, supported
from barpc.tie.pairing.epipolar import EpipolarSegments, epipolar_segments, robust_affine
from barpc.tie.patches.oriented import ImageFiles, PatchTile, Sampling, register_oriented, resolution
from tests.geotiffs import write_image
from tests.scenes.redrawn import redrawn
from tests.scenes.season import SEASONS, disguised
from tests.tie.conftest import altered, checks
from tests.tie.stages import common_tracks, select_pairs
from tests.tie.test_pairs import camera, views


@pytest.fixture(scope="module")
def winter(render, tmp_path_factory) -> tuple[View, View]:
    """Two views of a scene, the second under half a metre of snow for 40 %, a quarter of its classes turned over."""
    first, second = render(views=2).views
    snow = tmp_path_factory.mktemp("winter")
    return first, altered(second, snow, lambda d: disguised(d, 1, *SEASONS["winter"]))


@pytest.fixture(scope="module")
def tied(winter):
    return find_tracks(winter)


@pytest.mark.costs(3)
@pytest.mark.slow
def test_what_keypoints_find_too_little_of_is_tied_by_structure(render, winter, tied) -> None:
    report = tied.pairs[0]
    assert report.matcher == STRUCTURE
    assert 0.0 <= report.control_share <= 0.05
    errors = render(views=2).errors_of(tied.tracks)
    assert 200 < len(errors) < 800
    spread = 1.4826 * np.median(np.abs(errors - np.median(errors, axis=0)), axis=0)
    assert 0.02 < spread.min() < 0.2
    assert spread.max() < 0.4
    assert (np.abs(np.median(errors, axis=0)) < 0.1).all()
    assert (np.abs(errors).max(axis=1) > 2.0).mean() <= 0.05
    assert 0.05 < tied.tracks.sigma.mean() < 0.2  # half of the variance at either end


@pytest.mark.nightly
def test_the_same_images_give_the_same_bytes(winter) -> None:
    one, two = (find_tracks(winter, TieOptions(matcher=STRUCTURE)).tracks for _ in range(2))
    assert one.xy.tobytes() == two.xy.tobytes()


@pytest.mark.nightly
def test_another_place_is_refused(render, winter) -> None:
    other = render(views=2, seed=5).views[1]
    with pytest.raises(TiePointError, match=r"no common offset|too few matches"):
        find_tracks([winter[0], replace(winter[1], path=other.path)], TieOptions(matcher=STRUCTURE, search=90.0))


@pytest.mark.nightly
def test_as_delivered_it_is_a_tenth_of_a_pixel_off(render) -> None:
    scene = render(views=2)
    found = find_tracks(scene.views, TieOptions(matcher=STRUCTURE))
    spread = scene.typical(found.tracks)
    assert len(scene.errors_of(found.tracks)) > 500
    assert 0.01 < spread.min() < 0.1  # across the epipolar lines
    assert 0.01 < spread.max() < 0.25  # along them: a patch sees more than its middle's altitude
    assert found.keypoints == (0, 0)


@pytest.mark.parametrize(
    ("side", "axis", "most"),
    [
        (300, np.arange(50.0, 250.0, 20.0), (0.25, 0.3)),
        pytest.param(600, np.arange(100.0, 500.0, 40.0), (0.15, 0.25), marks=pytest.mark.nightly),
    ],
)
def test_a_patch_is_registered_where_the_truth_says(render, side, axis, most) -> None:
    scene = render(views=2, size=(side, side))
    a, b = scene.views
    at = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    known = [scene.errors(0, 1, one[None], np.zeros((1, 2))) for one in at]
    at = at[[len(one) > 0 for one in known]]  # not beside a step
    truth = np.concatenate(known)
    assert len(at) > 50
    linear = np.broadcast_to(np.eye(2), (len(at), 2, 2))
    xy, ok, score = register_oriented([(v.path, v.size) for v in (a, b)], 1, at, truth + [1.0, -1.0], linear)
    assert ok.mean() > 0.8
    assert (np.abs(np.median((xy - truth)[ok], axis=0)) < 0.05).all()
    assert (1.4826 * np.median(np.abs((xy - truth)[ok]), axis=0) < most).all()
    assert ((score[ok] > 0.1) & (score[ok] < 1.0)).all()


@pytest.mark.slow
@pytest.mark.parametrize("step", [120.0, pytest.param(40.0, marks=pytest.mark.nightly)])
def test_two_dates_of_a_satellite_lie_where_they_lie(shared_data, step: float) -> None:
    """Fields ten days apart on one grid, a corner of one under clouds, another without data."""
    paths = sorted((shared_data / "optical/s2_two_dates").glob("*.tif"))
    grid = np.stack(np.meshgrid(np.arange(200.0, 920.0, step), np.arange(200.0, 1160.0, step)), -1).reshape(-1, 2)
    files, linear = [(str(path), (1200, 1200)) for path in paths], np.broadcast_to(np.eye(2), (len(grid), 2, 2))
    xy, ok, _ = register_oriented(files, 1, grid, grid + [-0.6, 1.9], linear)
    common = [robust_affine(grid[ok], (xy - grid)[ok, k]) for k in (0, 1)]
    apart = np.hypot(*((xy - grid)[:, k] - fit(grid) for k, fit in enumerate(common)))
    assert (ok & (apart < 1.0)).mean() >= 0.95
    assert 0.03 < np.median(apart[ok]) <= 0.15
    assert np.abs([fit.coefficients[0] for fit in common] - np.array([-0.66, 1.85])).max() < 0.1


@pytest.fixture(scope="module")
def small(scene) -> tuple[View, ...]:
    """Used for 320 m of altitude about the scene's."""
    return tuple(replace(view, alt_range=(80.0, 400.0)) for view in scene.views)


@pytest.fixture(scope="module")
def matched(small) -> tuple[Matches, PairReport]:
    """What structure finds of a pair."""
    pair = select_pairs(small, TieOptions())[0]
    return match_pair(small, (join_keypoints([]), join_keypoints([])), pair, TieOptions(matcher=STRUCTURE))


def test_terrain_or_other_ties_narrow_the_altitudes(scene, small, matched) -> None:
    pair, (found, report) = small, matched
    low, high = pair[0].alt_range
    middle = 0.5 * (low + high)
    flat = GroundAltitudes(lambda lon, lat: np.full(len(lon), middle)).within(pair, (low, low), 150.0)
    assert flat[0].alt_range == flat[1].alt_range == (max(low, middle - 150), min(high, middle + 150))
    nowhere = GroundAltitudes(lambda lon, lat: np.full(len(lon), np.nan))
    assert nowhere.within(pair, (low, low), 150.0)[0].alt_range[1] == min(high, low + 150)
    known = GroundAltitudes(None, [(pair, found)]).altitudes()
    seen = scene.altitude[0]
    assert known is not None
    assert abs(known[0] - np.nanpercentile(seen, 2)) < 40  # cameras as delivered
    assert abs(known[1] - np.nanpercentile(seen, 98)) < 40
    assert GroundAltitudes().altitudes() is None
    assert (report.matcher, report.status) == (STRUCTURE, "ok")
    assert report.verified > 20


@pytest.mark.parametrize("seen", [False, True])
def test_only_terrain_that_both_may_see_counts(seen) -> None:
    first, second = views(camera(0.0), camera(0.0, lean=0.2))
    middle, flat = 0.5 * sum(first.alt_range), first.sensor.localize(np.array([[180.0, 540.0]]), np.array([0.0]))
    half = replace(second, sensor=second.sensor.crop(0.0 if seen else 600.0, 0.0), size=(150, 1000))

    def hilly(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        """A hill where the first image has its column 180."""
        away = np.hypot((lon - flat[0, 0]) * np.cos(np.radians(lat)), lat - flat[0, 1]) * 111e3
        return np.where(away < 60.0, middle + 20.0, middle)

    found = GroundAltitudes(hilly).within((first, half), None, 50.0)[0].alt_range[1]
    assert found == min(first.alt_range[1], middle + (70.0 if seen else 50.0))


def test_fewer_altitudes_are_tried_where_all_find_few(small, monkeypatch) -> None:
    asked = []
    wide, narrow = ((replace(small[0], alt_range=around), small[1]) for around in ((0.0, 300.0), (100.0, 200.0)))

    def few(pair: tuple[View, View], *_: object) -> tuple[Matches, PairReport]:
        asked.append(pair[0].alt_range)
        return NO_MATCHES, PairReport(("a", "b"), "ok", (0, 0), verified=most // len(asked))

    monkeypatch.setattr(matching, "match_pair", few)
    for most, tries in ((99, 2), (100, 1)):
        asked.clear()
        report = _match_within(
            [wide, narrow], (join_keypoints([]), join_keypoints([])), select_pairs(small, TieOptions())[0], TieOptions()
        )[1]
        assert report.verified == most
        assert asked == [(0.0, 300.0), (100.0, 200.0)][:tries]


# --- pieces -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("side", "pixels"),
    [(1.0, 1), (2.0, 1), (0.72, 1), (0.70, 2), (0.5, 2), (0.36, 2), (0.35, 4), (0.01, 64), (1e-4, 64)],
)
def test_pictures_are_as_coarse_as_the_coarser_image_by_a_power_of_two(side, pixels) -> None:
    """A pixel of A measures `side` px of B; with any turn, and mirrored."""
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    for linear in (side * np.eye(2), side * turn, side * turn @ np.diag([1.0, -1.0])):
        assert resolution(linear) == pixels


def test_a_lattice_holds_the_multiples_of_its_pitch_in_a_box() -> None:
    at = lattice_points((10, 20, 31, 11), 10)
    assert at.tolist() == [[10, 20], [20, 20], [30, 20], [40, 20], [10, 30], [20, 30], [30, 30], [40, 30]]
    assert lattice_points((11, 21, 9, 9), 10).tolist() == []
    assert lattice_points((11, 21, 10, 10), 10).tolist() == [[20, 30]]


def level(half: float, width: float, height: float, probes: int | None = None, band: float = 3.0, least: int = 1):
    """Step and number of points of a look at a window, and their pitch."""
    search = _GridSearch.__new__(_GridSearch)
    search._least, search._whole = least, False
    search._prediction = Prediction(None, band, lambda: [], probes)  # type: ignore[arg-type]
    step, points = search._level(half, [(0, 0, int(width), int(height))])
    return step, np.diff(np.unique(points[:, 0]))[0]


@pytest.mark.parametrize(("half", "step", "count"), [(47.9, 2, 1000), (48.1, 2, 500), (129.9, 2, 500), (130.1, 4, 500)])
def test_long_bands_are_looked_at_in_coarser_pictures_at_fewer_points(half, step, count) -> None:
    found, pitch = level(half, 2000, 2000)
    assert found == step
    assert pitch == step * int((2000 * 2000 / count) ** 0.5 / step)
    assert level(half, 4000, 4000, least=4)[0] == 4 * step


@pytest.mark.parametrize(
    ("band", "half", "step"),
    [(20.0, 10.0, 2), (39.0, 10.0, 2), (61.0, 10.0, 4), (90.0, 10.0, 4), (101.0, 10.0, 8), (20.0, 129.0, 2),
     (20.0, 131.0, 4), (20.0, 1e4, 4)],
)  # fmt: skip
def test_the_cameras_error_is_looked_for_in_pictures_as_coarse_as_the_search_is_wide(band, half, step) -> None:
    """A twentieth of its half width, powers of two, or as coarse as the length of bands asks for."""
    found, pitch = level(half, 3000, 3000, probes=1500, band=band)
    assert found == step
    assert pitch == step * int((3000 * 3000 / 200) ** 0.5 / step)


@pytest.mark.parametrize(("half", "step"), [(20.0, 2), (129.0, 2), (131.0, 4), (200.0, 4)])
def test_how_long_bands_are_is_measured_in_the_middles_of_the_windows(half, step) -> None:
    """Half of the length; a window that B does not see says nothing."""

    def where(at: np.ndarray) -> EpipolarSegments:
        length = np.where(at[:, 0] < 2000.0, half, np.nan)
        nothing = np.zeros(len(at))
        return EpipolarSegments(
            np.array([1.0, 0.0]), nothing, nothing, nothing, -0.5 * length, 1.5 * length, lambda: np.eye(2)
        )

    view: View = SimpleNamespace(path="", size=(4000, 2000))  # type: ignore[assignment]
    for windows, found in (([(0, 0, 2000, 2000), (3000, 0, 900, 900)], step), ([(3000, 0, 900, 900)], 2), ([], 1)):
        search = _GridSearch(view, view, 1, Prediction(where, 3.0, lambda windows=windows: windows))
        assert search._step == found
        assert bool(len(search._points)) == bool(windows)
    assert not len(search.matches().xy)  # without a window nothing is searched


@pytest.mark.parametrize(("side", "step"), [(480, 8), (479, 4), (240, 4), (239, 2), (100, 2), (20, 2)])
def test_a_picture_has_sixty_pixels_a_side_where_it_can(side, step) -> None:
    assert level(10.0, 1000, side, probes=1500, band=120.0)[0] == step


def test_points_are_eight_pixels_apart_at_least() -> None:
    assert level(10.0, 200, 200)[1] == 2 * 8
    assert level(200.0, 500, 500)[1] == 4 * 8


@pytest.mark.parametrize(
    ("start", "axis", "most", "expected"),
    [
        ((500.0, 400.0), (1.0, 0.0), 100.0, (0.0, 100.0)),  # all of the segment
        ((50.0, 400.0), (1.0, 0.0), 100.0, (20.0, 80.0)),  # from ten pixels before the image on
        ((960.0, 400.0), (1.0, 0.0), 100.0, (-25.0, 75.0)),  # to ten behind it
        ((500.0, 780.0), (0.0, 1.0), 100.0, (-35.0, 65.0)),
        ((500.0, 15.0), (0.0, 1.0), 100.0, (37.5, 62.5)),
        ((-500.0, 400.0), (1.0, 0.0), 100.0, (0.0, 0.0)),  # nothing of it
    ],
)
def test_a_segment_is_looked_at_as_far_as_it_lies_in_the_image(start, axis, most, expected) -> None:
    search = _GridSearch.__new__(_GridSearch)
    search._files = (("a", (1, 1)), ("b", (1000, 800)))
    (x, y), half = axis, np.full(1, most)
    along, across = start[0] * x + start[1] * y, start[1] * x - start[0] * y
    where = EpipolarSegments(
        np.array(axis), np.array([along]), np.array([across]), np.zeros(1), -half, half, lambda: np.eye(2)
    )
    found = search._part_in_b(where, np.zeros(1), np.array([0]), 10.0)
    assert found == pytest.approx(expected)


def test_neighbours_speak_for_a_place_and_bend_a_little() -> None:
    """Three points in a row see one place, some pixels apart; the middle one another one better. One is far away."""
    at = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [500.0, 0.0]])
    near = adjacency(at, 10.0)
    assert near.tolist() == [[1, 1, 0, 0], [1, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 1]]
    seen = np.zeros((4, 9, 9), np.float32)
    seen[0, 4, 3] = seen[1, 4, 5] = seen[2, 4, 7] = seen[3, 1, 1] = 0.3
    seen[1, 8, 0] = 0.4
    found = supported(seen, near, 4.0)
    assert np.unravel_index(found[1].argmax(), (9, 9)) == (4, 5)
    assert found[1, 4, 5] == pytest.approx(0.3)
    assert found[1, 8, 0] == pytest.approx(0.4 / 5)
    assert found[1, 4, 3] == pytest.approx(4 * 0.3 / 2 / 5)  # the third one lies four pixels beside
    assert found[0, 4, 2] == 0.0  # three from where the second one lies
    np.testing.assert_allclose(found[3], seen[3] / 5)


def redrawn_pair(shared_data, folder: Path, change) -> list[View]:
    """Two Pleiades images, the second on another date; changed."""
    source = shared_data / "optical/phr_triplet_north"
    with rasterio.open(source / "img_03.tif") as file:
        pixels, rpcs = redrawn(file.read(1), 1), file.rpcs
    path = write_image(folder / "other.tif", change(pixels), rpcs=rpcs)
    return list(load_views([source / "img_02.tif", path]).views)


@pytest.mark.nightly
def test_lines_that_coarser_pictures_lose_tie_a_pair_where_it_lies(shared_data, tmp_path) -> None:
    """Half of what snow leaves has grown anew, the rest is turned over: check points of the images as they were."""
    views = redrawn_pair(shared_data, tmp_path, lambda pixels: pixels)
    found = find_tracks(views, TieOptions(matcher=STRUCTURE))
    assert found.pairs[0].matcher == FINE_STRUCTURE
    a, b = common_tracks(found.tracks, 0, 1)
    at, xy = checks(shared_data, "phr_triplet_north__img_02__img_03")
    where = epipolar_segments(*views, at)
    true = robust_affine(at, where.errors(xy)[:, 1])
    off = epipolar_segments(*views, a, where.axis).errors(b)[:, 1] - true(a)
    assert len(off) > 30
    assert np.abs(np.median(off)) < 0.1
    assert np.sqrt((off**2).mean()) < 0.4


@pytest.mark.nightly
def test_another_place_is_no_more_like_it_by_its_neighbours(shared_data, tmp_path) -> None:
    for name, change in (("mirrored", np.fliplr), ("turned", lambda pixels: pixels[::-1, ::-1])):
        (tmp_path / name).mkdir()
        views = redrawn_pair(shared_data, tmp_path / name, change)
        with pytest.raises(TiePointError, match=r"no common offset|too few matches"):
            find_tracks(views, TieOptions(matcher=STRUCTURE, search=20.0))


@pytest.fixture(scope="module")
def textured(tmp_path_factory) -> tuple[ImageFiles, np.ndarray]:
    """Files of an image and of the same moved by as much as is said: x, y [px]."""
    folder, moved = tmp_path_factory.mktemp("textured"), np.array([20, -10])
    grey = 2000 + 400 * ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(300, 300)), 1.5)
    files = []
    for name, pixels in (("a", grey), ("b", np.roll(grey, moved[::-1], axis=(0, 1)))):
        path = write_image(folder / f"{name}.tif", pixels.astype(np.uint16))
        files.append((str(path), (300, 300)))
    return files, moved


@pytest.mark.parametrize(("aside", "beyond", "seen"), [(0.0, 0.0, True), (24.0, 0.0, False), (0.0, 30.0, False)])
def test_a_place_beyond_the_band_and_its_sides_is_not_found_however_alike(
    textured, monkeypatch, aside, beyond, seen
) -> None:
    """It goes diagonally, 25 px either way, and 12 px to its sides are looked at; chance finds others there."""
    files, moved = textured
    at = np.array([[140.0, 150.0], [150.0, 160.0], [160.0, 140.0]])
    axis = np.array([0.6, 0.8])
    along, across = (at + moved) @ axis + beyond, (at + moved) @ [-0.8, 0.6] + aside
    half = np.full(3, 25.0)
    where = EpipolarSegments(axis, along, across, np.zeros(3), -half, half, lambda: np.eye(2))
    monkeypatch.setattr(structural, "linear_map", lambda *_: np.eye(2))
    search = _GridSearch.__new__(_GridSearch)
    search._views, search._files, search._band, search._whole = (), files, 1, False  # type: ignore[assignment]
    search._points, search._step = at, 1
    search._prediction = Prediction(lambda _: where, 2.0, list)
    found, xy, _ = search._tile(where, np.arange(3))
    off = where.errors(at + moved)[0]
    assert (np.abs(off) <= [25.0, 12.0]).all() == seen
    true = np.abs(xy - found - moved).max(axis=1, initial=0.0) < 0.1
    assert true.sum() == (3 if seen else 0)


def test_patches_that_lie_together_share_a_picture(textured, monkeypatch) -> None:
    """Of 256 px a side, at either resolution: each is read and brought onto A's pixels once."""
    files, moved = textured
    made, real = [], Sampling.seen
    monkeypatch.setattr(Sampling, "seen", lambda *given: made.append(given) or real(*given))
    axis = np.arange(80.0, 241.0, 40.0)
    at = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    turn = np.broadcast_to(np.eye(2), (len(at), 2, 2))
    xy, ok, _ = register_oriented(files, 1, at, at + moved, turn)
    assert ok.all()
    np.testing.assert_allclose(xy, at + moved, atol=0.05)
    assert len(made) == 4  # of both images, whole pixels and halves


def plain_tile(reach: tuple[int, int] = (4, 3), half: int = 5) -> PatchTile:
    """Two points of a picture that is A and B; a pixel of it is two of B, turned by a right angle."""
    noise = np.random.default_rng(0).normal(size=(2, 40, 50)).astype(np.float32)
    at = np.array([[15, 12], [30, 25]])
    matrix = np.array([[0.0, -2.0], [2.0, 0.0]])
    corner = np.array([100.0, 200.0])
    return PatchTile((noise, noise), at, at.copy(), np.zeros((2, 2)), np.array(reach), half, matrix, corner)


def test_the_best_place_of_a_template_is_its_own() -> None:
    tile = plain_tile()
    surface = tile.surfaces()
    assert surface.shape == (2, 7, 9)
    place, score = tile.peaks(surface)
    np.testing.assert_allclose(place, tile.at, atol=0.2)
    np.testing.assert_allclose(score, 1.0, atol=1e-5)
    assert tile.returns(tile.at.astype(float)).all()
    assert tile.returns(tile.at + [1.0, 1.0]).all()  # missed by 1.41
    assert not tile.returns(tile.at + [2.0, 0.0]).any()
    assert not tile.returns(tile.at + [0.0, -2.0]).any()


def test_places_of_a_picture_are_places_of_b() -> None:
    tile = plain_tile()
    np.testing.assert_allclose(tile.in_b(np.array([[0.0, 0.0], [3.0, 1.0]])), [[100, 200], [98, 206]])
    off = tile.offsets()
    assert off.shape == (7, 9, 2)
    np.testing.assert_allclose(off[3, 4], 0.0)
    np.testing.assert_allclose(off[3, 5], [0.0, 2.0])  # one to the right in the picture
    np.testing.assert_allclose(off[6, 0], [-6.0, -8.0])


def test_a_peak_is_that_of_the_parabolas_through_its_neighbours_and_none_on_the_edge() -> None:
    tile = plain_tile()
    x, y = np.arange(-4, 5.0), np.arange(-3, 4.0)[:, None]
    inner = 0.9 - 0.02 * (x - 1.3) ** 2 - 0.05 * (y + 0.6) ** 2
    edge = 0.9 - 0.02 * (x - 4.4) ** 2 - 0.05 * (y + 0.6) ** 2
    place, score = tile.peaks(np.stack([inner, edge]).astype(np.float32))
    np.testing.assert_allclose(place - tile.whole, [[1.3, -0.6], [4.0, -1.0]], atol=1e-4)
    np.testing.assert_allclose(score, [0.9 - 0.02 * 0.09 - 0.05 * 0.16, 0.9 - 0.02 * 0.16 - 0.05 * 0.16], atol=1e-5)


def test_a_template_is_a_picture_where_more_than_nine_tenths_of_it_are_known() -> None:
    tile = plain_tile()
    for rows, known in ((1, True), (2, False)):  # of eleven
        picture = tile.pictures[0].copy()
        picture[:, 7 : 7 + rows, 10:21] = 0.0
        assert replace(tile, pictures=(picture, picture)).shown().tolist() == [known, True]
