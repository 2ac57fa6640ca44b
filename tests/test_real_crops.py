"""The yardstick of real crops: what is cut, changed and measured is what it says."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.base.geodesy import ecef_from_ground
from barpc.rpcio import read_rpc
from benchmarks import real_crops
from benchmarks.real_crops import BANDS, Block, Case, Image, Measured, Pair, Result
from benchmarks.real_sets import change_tag
from tests.fit.cameras import synthetic_rpc

ALTITUDE = 480.0


def image(name: str, size: tuple[int, int], corner: tuple[int, int], lean: float = 0.0) -> Image:
    """A part of a synthetic camera's image; `lean` sees heights along the rows."""
    rpc = synthetic_rpc()
    coeffs = rpc.coeffs.copy()
    coeffs[2, 3] += lean
    pixels = np.random.default_rng(len(name)).integers(1, 4000, size[::-1]).astype(np.uint16)
    moved = replace(rpc, coeffs=coeffs, image_offset=rpc.image_offset - corner, err_bias=7.5)
    return Image(name, pixels, moved)


def block(name: str = "made") -> Block:
    """Two images that overlap by some two thirds, with exact points on a grid."""
    left, right = image("left", (420, 360), (10000, 9000)), image("right", (400, 380), (10090, 9060), 0.1)
    cols, rows = np.meshgrid(np.arange(4.0, 417, 8), np.arange(4.0, 357, 8))
    seen = np.column_stack([cols.ravel(), rows.ravel()])
    other = right.rpc.project(left.rpc.localize(seen, np.full(len(seen), ALTITUDE)))
    kept = ((other >= 0) & (other <= np.array(right.size) - 1)).all(axis=1)
    points = np.hstack([seen, other])[kept]
    return Block(name, (left, right), (Pair(0, 1, points, delivered=np.zeros(len(points))),), ALTITUDE)


@pytest.fixture(scope="module")
def made() -> Block:
    return block()


def drawn(of: Block, number: int, seed: int = 0) -> Case:
    found = real_crops.draw(of, number, seed)
    assert isinstance(found, Case), found
    return found


# --- crops -------------------------------------------------------------------------------------------------


def test_a_crop_depends_on_the_name_the_seed_and_its_number_alone(made: Block) -> None:
    crops = [drawn(made, number) for number in range(1, 9)]
    assert [drawn(block(), number) for number in range(8, 0, -1)] == crops[::-1]
    windows = {
        one.windows[0] for one in (*crops, drawn(made, 1, seed=1), drawn(replace_name(made), 1))
    }  # all of them differ
    assert len(windows) == 10


def replace_name(of: Block) -> Block:
    return Block("another", of.images, of.pairs, of.altitude)


def test_a_crop_is_inside_its_images_and_shows_enough_points_of_the_same_ground(made: Block) -> None:
    for number in range(1, 31):
        case = drawn(made, number)
        for which, (col, row, width, height) in case.windows.items():
            size = made.images[which].size
            assert min(col, row) >= 0
            assert col + width <= size[0]
            assert row + height <= size[1]
        sides = np.array(case.windows[0][2:]) / made.images[0].size
        assert ((sides > 0.395) & (sides < 0.955)).all()
        shown = made.pairs[0].inside(case)
        assert shown.sum() >= real_crops.FEWEST
        for which, places in enumerate(np.hsplit(made.pairs[0].points[shown], 2)):
            low = np.array(case.windows[which][:2])
            assert (places - low >= 12).all()
            assert (low + case.windows[which][2:] - 1 - places >= 12).all()


def test_a_crop_that_never_shows_enough_points_is_skipped_with_the_reason(made: Block) -> None:
    few = Block("few", made.images, (Pair(0, 1, made.pairs[0].points[:29]),), ALTITUDE)
    said = real_crops.draw(few, 1, 0)
    assert isinstance(said, str)
    assert "left right" in said
    results = [one for one in real_crops.cases(few, 2, 0) if isinstance(one, Result)]
    assert [(one.case, one.code) for one in results] == [("crop 1", None), ("crop 2", None)]
    assert "skipped" in results[0].row()


def test_images_must_be_connected_by_pairs_of_enough_points() -> None:
    images = tuple(image(name, (200, 200), (10000, 9000)) for name in ("a", "b", "c"))
    points = np.tile(np.linspace(20, 180, 4000)[:, None], (1, 4))
    few = Pair(0, 2, points[:5])
    drawn(Block("chain", images, (Pair(0, 1, points), Pair(1, 2, points), few)), 1)
    apart = Block("apart", images, (Pair(0, 1, points), Pair(1, 2, points[:: len(points) // 28]), few))
    assert re.search(r"b c \d+", str(real_crops.draw(apart, 1, 0)))


def test_the_rpc_of_a_crop_gives_the_same_pixel_less_the_corner(made: Block, tmp_path: Path) -> None:
    window = (37, 121, 200, 150)
    path = made.images[0].write(tmp_path, window)
    with rasterio.open(path) as file:
        assert (file.driver, file.dtypes, file.shape) == ("GTiff", ("uint16",), (150, 200))
        np.testing.assert_array_equal(file.read(1), made.images[0].pixels[121:271, 37:237])
    rng = np.random.default_rng(0)
    ground = made.images[0].rpc.localize(rng.uniform(0, 400, (40, 2)), rng.uniform(100, 900, 40))
    inside = read_rpc(path).project(ground)
    np.testing.assert_allclose(inside + [37, 121], made.images[0].rpc.project(ground), atol=1e-8)
    assert read_rpc(path).err_bias == 7.5


def test_residuals_do_not_depend_on_the_crop(made: Block, shared_data: Path, tmp_path: Path) -> None:
    """And a camera that is moved across the epipolar lines is seen by as much."""
    tool = real_crops.load_tool(shared_data.parent / "tools/ncc_check.py")
    case = drawn(made, 3)
    cameras = {n: tool.Cam.gdal(made.images[n].write(tmp_path, window)) for n, window in case.windows.items()}
    (found,) = real_crops.measure(made, case, cameras, tool.epi)
    assert found.points == made.pairs[0].inside(case).sum()
    assert abs(found.median) < 1e-5
    assert np.nanmax(np.abs(found.bands)) < 1e-5
    across = {**cameras, 1: cameras[1].moved(0.3, 0.0)}  # heights move points along the rows
    (moved,) = real_crops.measure(made, case, across, tool.epi)
    assert abs(moved.median) == pytest.approx(0.3, abs=0.02)


# --- bands -------------------------------------------------------------------------------------------------


SIZE = (400, 240)
PLACES = np.stack(np.meshgrid(np.arange(4.0, 400, 8), np.arange(4.0, 240, 6)), axis=-1).reshape(-1, 2)
THIRD = (PLACES[:, 1] >= 60) & (PLACES[:, 1] < 90)  # of the eighths of the rows
LAST = PLACES[:, 0] >= 350  # of the eighths of the columns


@pytest.mark.parametrize("by", [0.1, -0.1])
@pytest.mark.parametrize(("where", "band"), [(THIRD, 2), (LAST, 2 * BANDS - 1)])
def test_a_planted_band_is_seen_with_its_sign_and_size(by: float, where: np.ndarray, band: int) -> None:
    noise = np.random.default_rng(5).normal(0, 0.05, len(PLACES))
    found = real_crops.compare("a b", noise + by * where, noise - 4.8, PLACES, SIZE)
    assert found.bands[band] == pytest.approx(by, abs=0.02)
    assert found.excess[band] == pytest.approx(0.1, abs=0.02)
    assert np.argmax(found.excess) == band
    assert np.abs(np.delete(found.bands, band)).max() < 0.03
    assert found.delivered == pytest.approx(-4.8, abs=0.01)
    corrected = real_crops.compare("a b", noise, noise + by * where, PLACES, SIZE)  # what was there and is no more
    assert corrected.excess[band] == pytest.approx(-0.1, abs=0.02)


def test_outliers_count_and_bands_of_few_points_do_not() -> None:
    off = np.zeros(len(PLACES))
    off[: len(off) // 2 + 1] = 50.0
    assert real_crops.compare("a b", off, off, PLACES, SIZE).median == 50.0
    kept = ~THIRD | (np.cumsum(THIRD) <= 11)
    medians = real_crops.bands(np.ones(kept.sum()), PLACES[kept], SIZE)
    assert np.flatnonzero(np.isnan(medians)).tolist() == [2]


def test_the_standard_error_of_a_median_is_its_spread_over_draws() -> None:
    rng = np.random.default_rng(7)
    places = rng.uniform(0, 200, (200, 2))
    found = [
        real_crops.compare("a b", off, off, places, (200, 200)) for off in rng.normal(0.5, 0.1, (300, len(places)))
    ]
    assert np.mean([one.error for one in found]) == pytest.approx(np.std([one.median for one in found]), rel=0.15)


# --- changes -----------------------------------------------------------------------------------------------


def changed(made: Block, name: str, place: Path, seed: int = 0) -> dict[int, Path]:
    """The images whose RPCs a case changes, written."""
    found = {}
    for number, change in real_crops.perturbations(made, seed)[name].items():
        found[number] = made.images[number].write(place, made.images[number].window)
        change_tag(found[number], change)
    return found


def test_a_shift_is_of_the_last_image_by_20_px(made: Block, tmp_path: Path) -> None:
    ((number, path),) = changed(made, "shift20", tmp_path).items()
    assert number == 1
    rpc = made.images[1].rpc
    ground = rpc.localize(np.array([[10.0, 20.0], [350.0, 340.0]]), np.array([200.0, 700.0]))
    off = read_rpc(path).project(ground) - rpc.project(ground)
    np.testing.assert_allclose(off, [[12.0, -16.0]] * 2, atol=1e-6)


def test_a_yaw_is_3_mrad_and_a_scale_of_a_fifth_of_a_percent(made: Block, tmp_path: Path) -> None:
    ((_, path),) = changed(made, "yaw", tmp_path).items()
    rpc = made.images[1].rpc
    ends = rpc.localize(np.array([[50.0, 190.0], [350.0, 190.0]]), np.full(2, 500.0))
    (before,), (after,) = (np.diff(camera.project(ends), axis=0) for camera in (rpc, read_rpc(path)))
    assert np.linalg.norm(after) / np.linalg.norm(before) == pytest.approx(1.002, abs=5e-4)
    turn = np.arctan2(after[1], after[0]) - np.arctan2(before[1], before[0])
    assert abs(turn) == pytest.approx(3e-3, rel=0.2)  # pixels of these cameras are no squares


def test_along_300_m_is_that_on_the_ground(made: Block, tmp_path: Path) -> None:
    ((_, path),) = changed(made, "along300", tmp_path).items()
    middle = np.array([[200.0, 190.0]])
    ends = [camera.localize(middle, np.array([ALTITUDE])) for camera in (made.images[1].rpc, read_rpc(path))]
    apart = np.linalg.norm(np.subtract(*(ecef_from_ground(end) for end in ends)))
    assert apart == pytest.approx(300.0, rel=1e-3)
    (col, row), *_ = read_rpc(path).project(ends[0]) - middle
    assert abs(col) < 1e-6
    assert row > 0


def test_pointing_is_31_px_rms_of_all_images_in_directions_of_their_own(made: Block) -> None:
    shifts = np.array([one.shift for one in real_crops.perturbations(made, 0)["pointing31"].values()])
    assert shifts.shape == (2, 2)
    assert np.sqrt((shifts**2).sum(axis=1).mean()) == pytest.approx(31.0)
    assert np.linalg.norm(shifts[0] - shifts[1]) > 1.0
    again = [one.shift for one in real_crops.perturbations(block(), 0)["pointing31"].values()]
    np.testing.assert_array_equal(again, shifts)
    other = [one.shift for one in real_crops.perturbations(made, 1)["pointing31"].values()]
    assert not np.isclose(other, shifts).any()


# --- what is told --------------------------------------------------------------------------------------------


def measured(median: float, band: float, pair: str = "a b", error: float = 0.004) -> Measured:
    bands = np.full(2 * BANDS, np.nan)
    bands[3] = median
    return Measured(pair, 200, median, error, -0.7, bands, np.where(np.arange(2 * BANDS) == 3, band, np.nan))


def test_a_row_says_what_it_misses() -> None:
    whole = Result("s", "whole", 0, "good", 5.0, (measured(-0.01, 0.01), measured(0.012, -0.2, "b c")))
    assert all(whole.meets().values())
    assert "MISSED" not in whole.row()
    assert "| +0.012 | 0.004 | 200 b c | +0.010 |" in whole.row()
    crop = Result("s", "crop 1", 0, "good", 5.0, (measured(-0.03, 0.04), measured(0.0, 0.0, "b c")))
    assert crop.meets() == {"exit": True, "median": False, "band": False}
    assert "MISSED" in crop.row()
    assert "**-0.030**" in crop.row()
    moved = (measured(-0.01, 0.01), measured(0.035, -0.2, "b c"))
    yaw = Result("s", "yaw", 3, "look; a | b", 7.0, moved, whole=whole)
    assert yaw.from_whole == pytest.approx(0.023)
    assert yaw.meets() == {"exit": False, "median": False, "band": True, "from whole": False}
    assert "look; a / b" in yaw.row()
    skipped = Result("s", "crop 2", None, "skipped: few")
    row = real_crops.summary("s", [whole, crop, yaw, skipped])
    assert row == "| s | 3 | 2/3 | 1/3 | 1/3 | 2/3 | 0/1 | 17 |"
    json.dumps([one.told() for one in (whole, crop, yaw, skipped)], allow_nan=False)


def test_a_missing_camera_misses_all_that_is_measured() -> None:
    whole = Result("s", "whole", 0, "good", 5.0, (measured(0.0, 0.0),))
    lost = Result("s", "yaw", 1, "no ties", 5.0, (measured(0.0, 0.0),), missing=("b",), whole=whole)
    none = Result("s", "crop 1", 1, "no ties", 5.0, missing=("a", "b"))
    assert not any(lost.meets().values())
    assert not any(none.meets().values())
    assert "no camera of b" in lost.row()
    assert real_crops.summary("s", [lost, none]) == "| s | 2 | 0/2 | 0/2 | 0/2 | 0/2 | 0/1 | 10 |"
    json.dumps([one.told() for one in (lost, none)], allow_nan=False)


def test_options_behind_two_dashes_are_those_of_adjust() -> None:
    given = real_crops.arguments(["--only", "xs", "--only", "north", "--crops", "2", "--", "--drift", "0", "--jitter"])
    assert (given.only, given.crops, given.options) == (["xs", "north"], 2, ["--drift", "0", "--jitter"])
    assert real_crops.arguments([]).options == []


FAKE = """
import json, pathlib, shutil, sys
*images, o, out = [one for one in sys.argv[3:]]
assert (sys.argv[1:3], o) == (["-q", "adjust"], "-o"), sys.argv
pathlib.Path(out).mkdir()
for path in map(pathlib.Path, images[:2]):
    shutil.copy(path, pathlib.Path(out, path.stem + ".vrt"))
told = {"status": "look", "reasons": images[2:]}
pathlib.Path(out, "summary.json").write_text(json.dumps(told))
sys.exit(3)
"""


def test_the_barpc_of_the_path_is_run_on_the_crop_with_the_options(
    made: Block, shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A barpc of another folder, which gives the cameras back as they are."""
    (tmp_path / "barpc").mkdir()
    (tmp_path / "barpc/__main__.py").write_text(FAKE)
    (tmp_path / "barpc/__init__.py").write_text("")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    tool = real_crops.load_tool(shared_data.parent / "tools/ncc_check.py")
    result = real_crops.run(made, tool, ["--drift"], None, drawn(made, 1))
    assert (result.code, result.said, result.missing) == (3, "look; --drift", ())
    assert abs(result.median) < 1e-5
    assert result.windows == {made.images[n].name: window for n, window in drawn(made, 1).windows.items()}
