"""Registering images to an orthoimage of another season: how far every camera is off, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy import ndimage

from barpc import open_camera
from barpc.base.errors import InputError
from barpc.base.geodesy import metres_per_unit
from barpc.base.tasks import HERE
from barpc.pipeline.loading import load_views
from barpc.rasters.dem import Dem
from barpc.rpcio import read_rpc
from barpc.scene import View
from barpc.sensor.rpc import RPC
from barpc.tie.patches.channels import INVALID_MARGIN, Patch, of_image, of_reference
from barpc.tie.reference import (
    PEAK,
    Accuracy,
    ReferenceControl,
    ViewMatch,
    _ReferenceWork,
    affine_of_shifts,
    peak,
    register_views,
    vote,
)
from barpc.verbs.moving import moved
from tests.geotiffs import write_image
from tests.lanes import rest_slow
from tests.scenes import ImageOptions, Scene
from tests.scenes.season import other_season, write_dem, write_reference

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"
GSD = 2.0


@pytest.fixture(scope="module")
def truth():
    return json.loads((SAMPLES / "truth.json").read_text())


@pytest.fixture(scope="module")
def scene(truth):
    options = {key: tuple(v) if isinstance(v, list) else v for key, v in truth["options"].items()}
    return Scene(ImageOptions(**options))


@pytest.fixture(scope="module")
def season(scene):
    return other_season(scene, 3)


@pytest.fixture(scope="module")
def reference(scene, season, tmp_path_factory):
    return str(write_reference(tmp_path_factory.mktemp("reference") / "ref.tif", scene, season, GSD))


@pytest.fixture(scope="module")
def dem(scene, tmp_path_factory):
    return Dem.open(write_dem(tmp_path_factory.mktemp("dem") / "dem.tif", scene, 3, error=1.0))


@pytest.fixture(scope="module")
def views():
    return load_views(sorted(SAMPLES.glob("*.tif"))).views[:1]


def off(view: View, truth) -> np.ndarray:
    """How far a camera shows the check points from their place, east, north (2,) [m]."""
    points = [point for point in truth["check_points"] if view.name in point["image"]]
    ground = np.array([point["ground"] for point in points])
    image = np.array([point["image"][view.name] for point in points])
    there = view.sensor.localize(image, ground[:, 2])
    return ((there - ground)[:, :2] * metres_per_unit(ground)[:, :2]).mean(axis=0)


def shifted(view: View, px: tuple[float, float]) -> View:
    sensor = view.sensor
    assert isinstance(sensor, RPC)
    return replace(view, sensor=replace(sensor, image_offset=sensor.image_offset + px))


@pytest.mark.costs(4)
@pytest.mark.slow
@pytest.mark.parametrize("px", rest_slow([(120.0, -90.0), (0.0, 0.0)], mark=pytest.mark.nightly))
def test_the_camera_is_off_by_what_was_done_to_it(px, views, reference, dem, truth):
    view = shifted(views[0], px)
    found = register_views([view], [reference], dem, 1)
    (match,) = found.views
    assert match.peak > PEAK
    assert match.points > 100
    east, north = np.abs(match.offset - off(view, truth))
    assert east < 0.2
    assert north < 1.0  # along the line of sight: houses, and what of the terrain's error does not average out
    assert np.linalg.norm(off(view, truth)) > (5.0 if px == (0.0, 0.0) else 60.0)
    points = found.control.points
    exact = read_rpc_of(truth, view.name).project(points.lonlatalt[points.point])
    error = (points.xy - exact) * 0.5  # m
    assert np.median(np.linalg.norm(error, axis=1)) < 1.2
    assert found.step == pytest.approx(GSD, rel=1e-3)
    assert found.sigma == 0.5


def read_rpc_of(truth, name: str) -> RPC:
    (record,) = (view["exact_rpc"] for view in truth["views"] if view["name"] == name)
    return RPC(**{key: np.array(value) for key, value in record.items()})


@pytest.mark.nightly
def test_a_reference_that_lies_off_moves_what_it_finds(views, scene, season, dem, reference, truth, tmp_path):
    there = str(write_reference(tmp_path / "ref.tif", scene, season, GSD, shift=(6.0, -4.0)))
    first, second = (register_views(views, [path], dem, 1, accuracy=Accuracy(5.0)) for path in (reference, there))
    moved = np.subtract(second.views[0].offset, first.views[0].offset)
    assert moved == pytest.approx([-6.0, 4.0], abs=0.2)
    assert second.control.bias[:2] == pytest.approx([5.0, 5.0])


def test_a_raster_without_a_place_is_refused(views):
    with pytest.raises(InputError, match="no place on the ground"):
        register_views(views, [views[0].path], flat, 1)
    assert read_rpc(views[0].path) is not None


# --- a plain of texture, whose truth is a formula ------------------------------------------------------------

SIDE, WIDE, LEVEL = 180, 460, 40.0
DEGREES = 2.0 / 111_000.0  # a pixel of the reference, about two metres on either axis


def flat(lon, lat):
    return np.full(np.shape(lon), LEVEL)


def camera(lean: float, east: float = 0.0) -> RPC:
    """Of 180 pixels of 2.09 m about the origin; `lean` px for a hundred metres."""
    coeffs, half = np.zeros((4, 20)), np.full(2, (SIDE - 1) / 2)
    coeffs[1::2, 0] = 1.0
    coeffs[0, 1], coeffs[2, 2], coeffs[0, 3] = 1.0, -1.0, lean / half[0]
    span = 187.0 / 111_000.0
    return RPC(coeffs, np.array([east / 111_000.0, 0.0, 100.0]), np.array([span, span, 100.0]), half, half)


def ground(seed: int) -> np.ndarray:
    """Grey values of the plain on the reference's grid."""
    rng = np.random.default_rng(seed)
    fine, coarse = (ndimage.gaussian_filter(rng.normal(size=(WIDE, WIDE)), s) for s in (1.5, 6.0))
    return 1500 + 250 * fine / fine.std() + 250 * coarse / coarse.std()


def plain(path: Path, grey: np.ndarray, left: int = 0) -> str:
    """A reference of the plain, from a column of the whole one on."""
    corner = rasterio.Affine(DEGREES, 0, (left - WIDE / 2) * DEGREES, 0, -DEGREES, WIDE / 2 * DEGREES)
    return str(write_image(path, grey.astype(np.uint16), crs="EPSG:4326", transform=corner, nodata=0))


def taken(path: Path, grey: np.ndarray, sensor: RPC) -> View:
    """What a camera sees of the plain."""
    image = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2).astype(float)
    lon, lat, _ = sensor.localize(image, np.full(len(image), LEVEL)).T
    place = [WIDE / 2 - 0.5 - lat / DEGREES, WIDE / 2 - 0.5 + lon / DEGREES]
    pixels = ndimage.map_coordinates(grey, place, order=3).reshape(SIDE, SIDE)
    write_image(path, pixels.clip(1, 4000).astype(np.uint16))
    return View(path.stem, str(path), (SIDE, SIDE), sensor, (0.0, 200.0))


@pytest.fixture(scope="module")
def plains(tmp_path_factory):
    """Two views of a plain, the first sees it as it is; its reference, with dark and bright turned over."""
    folder, grey = tmp_path_factory.mktemp("plain"), ground(1)
    seen = [taken(folder / f"{k}.tif", grey, camera(12.0 * k)) for k in range(2)]
    return seen, grey, plain(folder / "ref.tif", 3000 - grey), folder


def wrong(view: View, px: tuple[float, float]) -> tuple[View, np.ndarray]:
    """A view whose camera is wrong by pixels, and how far off it shows the ground, east, north [m]."""
    there = shifted(view, px)
    place = np.array([[0.0, 0.0, LEVEL]])
    off = (there.sensor.localize(view.sensor.project(place), np.array([LEVEL])) - place) * metres_per_unit(place)
    return there, off[0, :2]


def test_every_camera_of_a_plain_is_off_by_what_was_done_to_it(plains):
    seen, _, reference, _ = plains
    (first, one), (second, two) = wrong(seen[0], (20.0, -11.0)), wrong(seen[1], (-7.5, 4.25))
    assert one == pytest.approx([-41.7, -23.0], abs=0.5)  # of 2.08 m; rows run south
    found = register_views([first, second], [reference], flat, 1, accuracy=Accuracy(None, 7.0, 3.0))
    for match, off in zip(found.views, (one, two), strict=True):
        assert match.offset == pytest.approx(off, abs=0.2)
        assert match.peak > 3 * PEAK
        assert 0.75 * match.tried < match.passed <= match.tried
        assert 0.9 * match.passed < match.points <= match.passed
        assert 0.0 < match.scatter < 0.15
    assert 370 < found.views[0].tried < 430  # eight pixels apart, but for the margins
    assert found.step == pytest.approx(2.08, abs=0.03)
    assert found.sigma == pytest.approx(0.25 * 2.0, abs=0.01)
    points = found.control.points
    assert points.sigma == pytest.approx(np.tile([0.1 * found.step, 0.1 * found.step, 7.0], (len(points.lonlatalt), 1)))
    assert found.control.bias == pytest.approx([found.sigma, found.sigma, 3.0])
    assert found.control.width == pytest.approx(33 * found.step)  # of a template
    assert np.array(found.control.offset) == pytest.approx(np.array([m.offset for m in found.views]))
    assert np.unique(points.point).tolist() == list(range(len(points.lonlatalt)))  # none is not seen
    assert len(points.lonlatalt) < 0.7 * len(points.point)  # most are seen by both
    for k, view in enumerate(seen):
        own = points.view == k
        error = points.xy[own] - view.sensor.project(points.lonlatalt[points.point[own]])
        assert np.sqrt((error**2).mean()) < 0.1
        stated = points.xy_sigma[own]
        assert stated == pytest.approx(np.full_like(stated, found.views[k].scatter / 2.08), rel=0.02)


def test_a_block_votes_by_its_correlation_where_it_and_the_reference_show_enough(plains, tmp_path):
    """Of half of a block, and of 0.3 of what lies around it, the edge of which is not used."""
    (view, _), grey, reference, _ = plains
    side, reach = 60, 8
    wide, metres = side + 2 * reach, 111_000.0

    def block(east: float = 0.0, moved: tuple[float, float] = (0.0, 0.0)) -> Patch:
        corner = np.array([east - wide, wide]) / metres
        return Patch.on(flat, corner, 2.0, (wide, wide), np.array(moved))

    found = vote(view, 1, (reference,), block(moved=(6.0, -4.0)), reach)
    assert found.shape == (2 * reach + 1,) * 2
    assert np.subtract(np.unravel_index(found.argmax(), found.shape), reach).tolist() == [2, 3]  # south, east
    mine, area = of_image(view, 1, block())[:, reach:-reach, reach:-reach], of_reference([reference], block())
    part = area[:, 5 : 5 + side, 12 : 12 + side]
    expected = (mine * part).sum() / np.sqrt((mine**2).sum() * (part**2).sum())
    assert vote(view, 1, (reference,), block(), reach)[5, 12] == pytest.approx(expected, abs=1e-4)
    for share, shown in ((0.57, True), (0.43, False)):  # east of the middle the image ends
        end = view.sensor.localize(np.array([SIDE - 1.0, SIDE / 2]), np.array(LEVEL))[0] * metres
        east = end + side - 2.0 * (side * share + INVALID_MARGIN)
        assert (vote(view, 1, (reference,), block(east), reach) is not None) == shown
    for share, shown in ((0.37, True), (0.23, False)):
        columns = WIDE // 2 - wide // 2 + round(wide * share + INVALID_MARGIN)
        cut = plain(tmp_path / "cut.tif", (3000 - grey)[:, :columns])
        assert (vote(view, 1, (cut,), block(), reach) is not None) == shown


@pytest.mark.slow
def test_what_a_plain_does_not_show_is_not_found_and_what_two_files_share_is(plains):
    seen, grey, _, folder = plains
    far = plain(folder / "far.tif", grey, left=3000)
    others = {"other": ground(2), "mirrored": grey[:, ::-1], "bare": np.full_like(grey, 900.0)}
    for path in (far, *(plain(folder / f"{name}.tif", there) for name, there in others.items())):
        found = register_views(seen[:1], [path], flat, 1)
        assert found.control is None
        assert found.views[0].peak < PEAK - 1.0
        assert (found.views[0].peak == 0.0) == (path == far)
        assert (found.views[0].tried, found.views[0].points) == (0, 0)
    halves = [
        plain(folder / "w.tif", grey[:, : WIDE // 2]),
        plain(folder / "e.tif", grey[:, WIDE // 2 :], WIDE // 2),
    ]
    mixed = register_views(seen[:1], [far, *halves], flat, 1, accuracy=Accuracy(5.0))
    assert 150 < mixed.views[0].points < 260
    assert mixed.views[0].offset == pytest.approx([0.0, 0.0], abs=0.1)
    east = mixed.control.points.lonlatalt[:, 0] / DEGREES
    assert (east.min() < -60) & (east.max() > 60)
    assert np.abs(east).min() > 16  # none of them beside the edge between the files
    alone = register_views(seen[:1], halves[1:], flat, 1).control.points.lonlatalt[:, 0] / DEGREES
    assert alone.min() > 16
    assert alone.max() == pytest.approx(east.max(), abs=8)
    assert mixed.sigma == 5.0
    assert mixed.control.bias == pytest.approx([5.0, 5.0, 5.0])
    assert mixed.control.points.sigma[0] == pytest.approx([0.1 * mixed.step, 0.1 * mixed.step, 10.0])


@pytest.mark.parametrize(("metres", "sigma"), [(0.5, 0.5), (1.6, 0.5), (4.0, 1.0), (10.0, 2.5)])
def test_a_reference_is_good_to_a_quarter_of_its_pixel_and_to_half_a_metre_at_best(metres, sigma, plains, tmp_path):
    """Of a reference that shows nothing."""
    path, degrees = tmp_path / "ref.tif", metres / 111_000.0
    corner = rasterio.Affine(degrees, 0, -25 * degrees, 0, -degrees, 25 * degrees)
    write_image(path, np.ones((50, 50), np.uint8), transform=corner, crs="EPSG:4326")
    view = plains[0][0]
    assert register_views([view], [str(path)], flat, 1).sigma == pytest.approx(sigma, rel=0.02)
    assert register_views([view], [str(path)], flat, 1, accuracy=Accuracy(7.0)).sigma == 7.0


# --- pieces -------------------------------------------------------------------------------------------------


def test_in_the_north_points_are_looked_for_where_the_vote_says_that_they_are_seen():
    """At 60 degrees, where a degree of longitude is half as long: those within the image that is 100 m off."""
    sensor = camera(0.0)
    scale = sensor.ground_scale * [2.0, 1.0, 1.0]
    sensor = replace(sensor, ground_offset=np.array([10.0, 60.0, 100.0]), ground_scale=scale)
    view = View("north", "", (SIDE, SIDE), sensor, (0.0, 200.0))
    metres = metres_per_unit(np.array([10.0, 60.0, 0.0]))[:2]
    local = np.stack(np.meshgrid(*[np.arange(-300.0, 301.0, 20.0)] * 2), axis=-1).reshape(-1, 2)
    work = _ReferenceWork((view,), [], flat, 1, step=2.0, work=HERE)
    tiles = work._tiles(view, np.array([100.0, 0.0]), [10.0, 60.0] + local / metres, np.full(len(local), LEVEL), 8)
    found = np.isin(np.arange(len(local)), np.concatenate([tile.points for tile in tiles]))
    edge = scale[:2] * metres - 16.0  # half a template from the border
    away = (np.abs(local + [100.0, 0.0]) - edge).max(axis=1)
    assert found[away < -5.0].all()
    assert not found[away > 5.0].any()


def test_the_peak_of_all_votes_is_told_in_robust_standard_deviations_from_the_middle():
    rng = np.random.default_rng(0)
    votes = [rng.normal(0, 0.1, (9, 9)).astype(np.float32) for _ in range(3)]
    for one in votes:
        one[2, 7] += 1.0
    z, at = peak([votes[0], None, *votes[1:]])
    total = np.sum(votes, axis=0)
    away = np.abs(total - np.median(total))
    assert z == pytest.approx((total.max() - np.median(total)) / (1.4826 * np.median(away)), rel=1e-5)
    assert at.tolist() == [3.0, -2.0]  # right of the middle, above it
    for nothing in ([], [None], [np.full((5, 5), 0.3, np.float32)]):
        assert peak(nothing)[0] == 0.0
    assert peak([None])[1].tolist() == [0.0, 0.0]


def shifts(agree: int, others: int):
    """Places on a square, shifts that an affine makes, and some that are anywhere."""
    rng = np.random.default_rng(agree)
    local = rng.uniform(-100, 100, (agree + others, 2))
    true = np.array([4.0, -3.0]) + local @ np.array([[0.01, -0.02], [0.005, 0.01]])
    shift = true + rng.normal(0, 0.1, true.shape)
    shift[agree:] += rng.choice([-1.0, 1.0], (others, 2)) * rng.uniform(15, 60, (others, 2))
    return local, shift, true


@pytest.mark.parametrize(("agree", "others"), [(200, 0), (60, 100), (12, 3)])
def test_most_shifts_lie_about_one_affine(agree, others):
    local, shift, true = shifts(agree, others)
    fitted, keep, both = affine_of_shifts(local, shift, np.ones(len(local), dtype=bool), 2.0)
    assert not keep[agree:].any()
    assert keep.sum() >= min(agree, max(12, 0.9 * agree))
    np.testing.assert_allclose(fitted[keep], true[keep], atol=0.15)
    if agree > 12:
        for axis, scatter in enumerate(both):
            assert 0.05 < scatter < 0.13
            left = np.abs(shift - fitted)[:, axis]
            assert scatter == pytest.approx(1.4826 * np.median(left[keep]), rel=1e-3)


def test_points_that_scatter_along_the_line_of_sight_show_what_heights_are_wrong_by():
    """A fifth of a metre aside for a metre of height: 30 m of wrong heights are 6 m, beside 1 m of finding them."""
    seen = ViewMatch("A", 9.0, (0.0, 0.0), 90, 50, 40, 1.0, float(np.hypot(1.0, 6.0)), 0.2)
    assert seen.heights == pytest.approx(30.0)
    assert seen.shows_heights(8.0)  # 6.1 m beside 3 x 1.9 m
    assert not seen.shows_heights(10.0)  # 3 x 2.2 m
    assert not replace(seen, slope=0.0).heights
    assert not replace(seen, along=2.9, slope=0.0).shows_heights(0.0)  # from right above heights do not show
    assert replace(seen, along=0.5).heights == 0.0
    assert replace(seen, along=float(np.hypot(2.0, 6.0)), scatter=2.0).heights == pytest.approx(30.0)
    assert not ViewMatch("A", 3.0, (0.0, 0.0)).shows_heights(1.0)


def test_what_is_refused_is_refused_for_what_it_lacks():
    low = (ViewMatch("A", 3.2, (0.0, 0.0)), ViewMatch("B", 5.1, (0.0, 0.0)))
    assert "highest peak has 5.1 standard deviations, 6.5 are needed" in ReferenceControl(None, low, 5.0, 1.25).refusal
    found = (*low, ViewMatch("C", 14.4, (3.0, 0.0), tried=900, passed=9))
    why = ReferenceControl(None, found, 5.0, 1.25).refusal
    assert "are needed" not in why
    assert "has 14.4 standard deviations), but of 900 points looked for there no 12 of an image agree" in why
    assert "(9 found at most)" in why
    assert "has 0.0 standard" in ReferenceControl(None, (), 5.0, 1.25).refusal


def test_fewer_than_twelve_that_agree_are_none():
    local, shift, _ = shifts(40, 0)
    for count in (11, 12):
        passed = np.arange(40) < count
        assert (affine_of_shifts(local, shift, passed, 2.0) is None) == (count < 12)
    local, shift, _ = shifts(11, 60)
    assert affine_of_shifts(local, shift, np.ones(len(local), dtype=bool), 2.0) is None


def test_shifts_without_any_scatter_are_good_to_a_thirtieth_of_a_pixel():
    local, _, true = shifts(50, 0)
    fitted, keep, scatter = affine_of_shifts(local, true, np.ones(50, dtype=bool), 2.0)
    assert keep.all()
    assert scatter == pytest.approx([1.4826 * 0.02 * 2.0] * 2)
    np.testing.assert_allclose(fitted, true, atol=1e-9)


# --- a real orthoimage --------------------------------------------------------------------------------------


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore::barpc.base.errors.BarpcWarning")
@pytest.mark.parametrize("off", [(0.0, 0.0), (150.0, 0.0), (400.0, -300.0), (-700.0, 500.0), (2500.0, -1500.0)])
def test_cameras_far_off_are_found_on_a_real_orthoimage_which_does_not_show_other_places(shared_data, off):
    folder = shared_data / "cross_sensor/ngi_2015"
    camera = open_camera(folder / "ngi_05_0182.tif")
    (there,) = moved([camera], (*off, 0.0), None)
    view = View("a", str(folder / "ngi_05_0182.tif"), camera.extent, there.model, camera.alt_range)
    terrain = Dem.open([str(folder / "dem.tif")], None, None)
    found = register_views([view], [str(folder / "ortho_05_0182.tif")], terrain, 1)
    if max(off) > 1000.0:
        assert found.control is None
        return
    (match,) = found.views
    assert match.peak > 10.0
    assert match.points > 300
    np.testing.assert_allclose(match.offset, off, atol=0.5)
