"""What the report shows of the pixels: patches lie over each other exactly where the cameras are right."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from rasterio.io import MemoryFile

from barpc.errors import ImageError
from barpc.pipeline import RunOptions, adjust
from barpc.pipeline import pictures as part
from barpc.pipeline.pictures import HALF, pictures
from barpc.remote import Remote
from barpc.simulate import simulate_block

pytest.importorskip("jinja2")
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def pixels(text: str) -> np.ndarray:
    with MemoryFile(base64.b64decode(text)) as memory, memory.open() as image:
        return image.read(1).astype(float)


def alike(a: str, b: str) -> float:
    return float(np.corrcoef(pixels(a).ravel(), pixels(b).ravel())[0, 1])


def test_after_the_adjustment_the_patches_of_a_tie_point_show_the_same(adjusted, known):
    found = json.loads((adjusted[1] / "pictures.json").read_text())
    kinds = [tie["kind"] for tie in found["ties"]]
    least = 5 if known.whole else 0  # patches that leave the image are not shown
    assert kinds.count("worst") > least
    assert kinds.count("random") > least
    before, after = (
        np.array([alike(t["patches"][0], t["patches"][k]) for t in found["ties"]]) for k in (1, 2)
    )
    assert np.median(after) > 0.9
    assert np.median(before) < 0.7
    assert (after > before).all()
    offsets = np.abs([tie["offset_px"] for tie in found["ties"]])
    assert (offsets[:, 0] > 5).all()
    assert (offsets[:, 1] < 0.3).all()
    assert pixels(found["ties"][0]["patches"][0]).shape == (2 * HALF + 1, 2 * HALF + 1)


def test_a_camera_that_is_moved_shows_in_the_patches(adjusted):
    """Of a run whose new cameras are those as delivered, "after" looks as bad as "before"."""
    run = adjusted[0].run
    same = replace(run, adjustment=None, fits=(), matched=())
    found = json.loads(pictures(same, 1))
    likeness = [alike(*tie["patches"]) for tie in found["ties"]]
    assert all(len(tie["patches"]) == 2 for tie in found["ties"])
    assert np.median(likeness) < 0.7


def test_quicklooks_show_the_images_and_the_report_holds_them(adjusted):
    found = json.loads((adjusted[1] / "pictures.json").read_text())
    assert set(found["quicklooks"]) == {view.name for view in adjusted[0].run.views}
    assert all(100 < max(pixels(look).shape) <= 360 for look in found["quicklooks"].values())
    html = (adjusted[1] / "report.html").read_text()
    assert all(look in html for look in found["quicklooks"].values())
    assert all(patch in html for tie in found["ties"] for patch in tie["patches"])
    assert "http" not in html.replace("http-equiv", "").replace("http://www.w3.org", "")


def test_no_pixel_leaves_where_that_is_not_wanted(corner, tmp_path):
    adjust(corner.images[:2], tmp_path / "out", RunOptions(pictures=False))
    assert not (tmp_path / "out/pictures.json").exists()
    assert "data:image/jpeg" not in (tmp_path / "out/report.html").read_text()


def test_an_image_that_is_gone_has_no_pictures_and_that_is_said(adjusted, caplog):
    run = adjusted[0].run
    gone = replace(run.views[0], path="/nowhere/at/all.tif")
    found = json.loads(pictures(replace(run, views=(gone, *run.views[1:])), 1))
    assert 1 <= len(caplog.messages) <= 2
    assert all("/nowhere/at/all.tif" in line and "does not show it" in line for line in caplog.messages)
    assert set(found["quicklooks"]) == {view.name for view in run.views[1:]}
    assert found["ties"]
    assert all(gone.name not in (tie["a"], tie["b"]) for tie in found["ties"])


# --- its parts ---------------------------------------------------------------------------------------------


def test_grey_values_go_from_the_second_to_the_98th_percentile() -> None:
    found = part._stretched(np.arange(101.0))
    assert (found[:3] == 0).all()
    assert (found[98:] == 255).all()
    assert found[50] == 127
    np.testing.assert_array_equal(np.diff(found[2:99].astype(int)) > 0, np.ones(96, bool))
    with_nan = part._stretched(np.array([np.nan, *range(101)]))
    assert with_nan[0] == 0
    np.testing.assert_array_equal(with_nan[1:], found)
    assert (part._stretched(np.full((3, 3), 7.0)) == 0).all()
    assert (part._stretched(np.full((3, 3), np.nan)) == 0).all()


@pytest.mark.parametrize(
    ("width", "height", "step"), [(360, 200, 1), (361, 200, 2), (200, 720, 2), (200, 721, 3), (50, 40, 1)]
)
def test_a_quicklook_takes_every_so_many_pixel_from_the_middle_of_each(tmp_path, width, height, step) -> None:
    values = np.random.default_rng(1).integers(0, 2000, (2, height, width)).astype(np.uint16)
    with rasterio.open(tmp_path / "a.tif", "w", "GTiff", width, height, 2, dtype="uint16") as out:
        out.write(values)
    for band in (1, 2):
        expected = part._stretched(values[band - 1, step // 2 :: step, step // 2 :: step].astype(float))
        np.testing.assert_array_equal(part._quicklook(tmp_path / "a.tif", band), expected)


def test_a_large_image_has_no_quicklook(tmp_path, monkeypatch) -> None:
    with rasterio.open(tmp_path / "a.tif", "w", "GTiff", 50, 40, 1, dtype="uint8") as out:
        out.write(np.ones((1, 40, 50), np.uint8))
    monkeypatch.setattr(part, "_LARGEST", 2000)
    assert part._quicklook(tmp_path / "a.tif", 1) is not None
    monkeypatch.setattr(part, "_LARGEST", 1999)
    assert part._quicklook(tmp_path / "a.tif", 1) is None
    assert (part.SIDE, part.TIES, part.MOST) == (360, 10, 60)


def image(tmp_path, width=120, height=100):
    """A plane of grey values 3 col + 5 row: linear interpolation is exact."""
    rows, cols = np.indices((height, width))
    with rasterio.open(tmp_path / "a.tif", "w", "GTiff", width, height, 1, dtype="uint16") as out:
        out.write((3 * cols + 5 * rows).astype(np.uint16)[None])
    return rasterio.open(tmp_path / "a.tif")


def test_a_patch_is_interpolated_linearly_at_any_place(tmp_path) -> None:
    turned = part._grid() @ np.array([[0.9, 0.3], [-0.2, 1.1]]) + [60.3, 48.6]
    with image(tmp_path) as opened:
        found = part._patch(opened, 1, turned)
    np.testing.assert_allclose(found, 3 * turned[..., 0] + 5 * turned[..., 1], rtol=1e-12)


@pytest.mark.parametrize(
    ("middle", "inside"),
    [
        ((26.0, 50.0), True), ((25.9, 50.0), False), ((60.0, 26.0), True), ((60.0, 25.9), False),
        ((93.0, 50.0), True), ((93.1, 50.0), False), ((60.0, 73.0), True), ((60.0, 73.1), False),
        ((np.nan, 50.0), False),
    ],
)  # fmt: skip
def test_a_patch_and_two_pixels_about_it_lie_in_the_image(tmp_path, middle, inside) -> None:
    assert HALF == 24
    with image(tmp_path) as opened:
        found = part._patch(opened, 1, part._grid() + middle)
    assert (found is not None) == inside


def test_a_patch_that_is_spread_over_much_of_an_image_is_none(tmp_path) -> None:
    with image(tmp_path, 1200, 600) as opened:
        assert part._patch(opened, 1, part._grid() * [9.8, 1.0] + [600.0, 300.0]) is not None
        assert part._patch(opened, 1, part._grid() * [10.1, 1.0] + [600.0, 300.0]) is None


def test_a_patch_is_brought_over_by_both_cameras_on_level_ground() -> None:
    """Against each of its pixels by the cameras themselves: a patch is small enough for straight lines."""
    block = simulate_block(2, 4, seed=2, num_checks=0)
    a, b = (view.sensor for view in block.views)
    corners, alts = np.array([[300.0, 400.0], [700.0, 150.0]]), np.array([100.0, 180.0])
    found = part._brought(a, b, corners, alts)
    assert found.shape == (2, 2 * HALF + 1, 2 * HALF + 1, 2)
    for n in range(2):
        at = (part._grid() + corners[n]).reshape(-1, 2)
        exact = b.project(a.localize(at, np.full(len(at), alts[n])))
        np.testing.assert_allclose(found[n].reshape(-1, 2), exact, atol=0.02)
    grid = part._grid()
    np.testing.assert_array_equal(grid[0, 0], [-HALF, -HALF])
    np.testing.assert_array_equal(grid[0, -1], [HALF, -HALF])


class Ran:
    """As much of a run as the choice of tie points asks for: track t has residuals t in its second view."""

    def __init__(self, count: int, drop: tuple[int, ...] = ()) -> None:
        self.tracks = SimpleNamespace(point=np.repeat(np.arange(count), 3), num_points=count)
        self.tracks.view = np.tile([0, 1, 2], count)
        self.keep = ~np.isin(self.tracks.point, drop) | (self.tracks.view == 0)
        size = np.where(self.tracks.view == 1, self.tracks.point, 0.1 * self.tracks.view * self.tracks.point)
        residuals = np.column_stack([0.6 * size, 0.8 * size])
        self.ties_after, self.ties_before = SimpleNamespace(residuals=residuals), None


def test_the_worst_tie_points_are_shown_and_as_many_others_at_random() -> None:
    found = part._chosen(Ran(50, drop=(48,)))  # of 48 one observation is left: no patches to compare
    assert found[:10] == [("worst", track) for track in (49, *range(47, 38, -1))]
    others = [track for kind, track in found[10:] if kind == "random"]
    assert len(others) == len(set(others)) == 10
    assert others == sorted(others)
    assert set(others) <= set(range(1, 39))  # 0 misses by nothing
    assert part._chosen(Ran(50, drop=(48,))) == found
    few = part._chosen(Ran(13))
    assert [kind for kind, _ in few] == ["worst"] * 10 + ["random"] * 2


def test_a_tie_point_is_shown_in_its_best_and_its_worst_image() -> None:
    assert part._pair(Ran(9), "worst", 4) == ("worst", (0, 1), (12, 13))
    before = Ran(9)
    before.ties_after, before.ties_before = None, before.ties_after
    before.ties_before.residuals = before.ties_before.residuals[:, ::-1] * [[1.0, -1.0]]
    assert part._pair(before, "random", 4) == ("random", (0, 1), (12, 13))


def test_of_many_images_at_most_sixty_are_shown(adjusted, monkeypatch) -> None:
    run = adjusted[0].run
    for most, shown in ((3, 3), (2, 2), (1, 1)):
        monkeypatch.setattr(part, "MOST", most)
        looks = json.loads(pictures(run, 1))["quicklooks"]
        assert len(looks) == shown
        assert run.views[0].name in looks


# --- tie points in two images, small ones ------------------------------------------------------------------


class Flat:
    """A camera whose columns and rows are a ten-thousandth of a degree; moved by some pixels."""

    def __init__(self, col: float = 0.0, row: float = 0.0) -> None:
        self.move = np.array([col, row])

    def localize(self, image, alt):
        return np.column_stack([(np.asarray(image) - self.move) * 1e-4, alt])

    def project(self, ground):
        return np.asarray(ground)[:, :2] * 1e4 + self.move


@pytest.fixture
def shown(tmp_path, monkeypatch):
    """A run of three images of one scene, each moved by (7, 3) px more than its camera said before the adjustment."""
    scene = np.random.default_rng(3).integers(0, 250, (2, 160, 160)).astype(np.uint8)
    views = []
    for n in range(3):
        path = tmp_path / f"v{n}.tif"
        with rasterio.open(path, "w", "GTiff", 110, 100, 2, dtype="uint8") as out:
            out.write(scene[:, 3 * n : 3 * n + 100, 7 * n : 7 * n + 110])
        views.append(SimpleNamespace(name=f"v{n}", path=str(path)))
    xy = np.array(
        [[60.0, 55.0], [53.0, 52.0], [50.0, 60.0], [43.0, 57.0], [5.0, 5.0], [1.0, 2.0], [58.0, 50.0]]
    )
    tracks = SimpleNamespace(
        point=np.array([0, 0, 1, 1, 2, 2, 0]), view=np.array([0, 1, 1, 2, 0, 1, 1]), xy=xy, num_points=3
    )
    # the first is best in image 0, the second in image 2, the third lies at the edge
    size = np.array([1.0, 5.0, 4.0, 2.0, 0.5, 0.6, 9.0])
    tied = SimpleNamespace(residuals=np.column_stack([size, 0 * size]))
    found = SimpleNamespace(
        views=views, tracks=tracks, keep=np.array([True] * 6 + [False]), ties_after=tied, ties_before=None,
        ground=np.array([[0.0, 0.0, 30.0]] * 3), before=[Flat()] * 3,
        after=[Flat(-7.0 * n, -3.0 * n) for n in range(3)],
    )  # fmt: skip

    def offset(a, b, first, second, alt, steps):
        """Rows that the second is beside the first; the altitude is what was asked for."""
        assert steps == 2
        np.testing.assert_array_equal(alt, np.full(len(first), 30.0))
        return (second - b.project(a.localize(first, alt)))[:, 1], alt

    monkeypatch.setattr(part, "epipolar_offset", offset)
    monkeypatch.setattr(part, "_text", lambda grey: grey.tolist())
    return found


def test_patches_of_a_tie_point_are_its_place_and_where_the_cameras_see_it(shown) -> None:
    first, second = part._ties(shown, 2)
    assert [(tie["kind"], tie["a"], tie["b"]) for tie in (first, second)] == [
        ("worst", "v0", "v1"),
        ("worst", "v2", "v1"),
    ]
    np.testing.assert_allclose(first["offset_px"], [-3.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(second["offset_px"], [3.0, 0.0], atol=1e-9)
    for tie, place in ((first, (60, 55)), (second, (43, 57))):
        here, before, after = map(np.array, tie["patches"])
        assert here.shape == (49, 49)
        np.testing.assert_allclose(after, here, atol=1)  # the same ground
        assert np.abs(before - here).mean() > 50  # noise at another place
        with rasterio.open(shown.views[int(tie["a"][1])].path) as image:
            col, row = place
            wanted = image.read(2)[row - 24 : row + 25, col - 24 : col + 25].astype(float)
        np.testing.assert_array_equal(here, part._stretched(wanted))


@pytest.mark.parametrize(
    ("change", "left"),
    [
        ({}, 2), ({"path": ""}, 1), ({"path": "/nowhere/v0.tif"}, 1),
        ({"path": Remote("https://example.org/v0.tif", "https")}, 1),
    ],
    ids=["all", "none", "gone", "remote"],
)  # fmt: skip
def test_a_tie_point_needs_both_its_images_here(shown, change, left) -> None:
    vars(shown.views[0]).update(change)
    assert [tie["a"] for tie in part._ties(shown, 1)] == ["v0", "v2"][2 - left :]


def test_a_check_has_patches_by_the_cameras_as_delivered_only(shown) -> None:
    shown.after, shown.ties_before, shown.ties_after = None, shown.ties_after, None
    for tie in part._ties(shown, 1):
        assert (len(tie["patches"]), len(tie["offset_px"])) == (2, 1)


def test_a_track_in_one_image_alone_is_not_shown(shown) -> None:
    shown.tracks.view = np.array([1, 1, 1, 2, 0, 1, 1])
    assert [tie["a"] for tie in part._ties(shown, 1)] == ["v2"]


def test_a_patch_that_one_camera_brings_out_of_its_image_is_not_shown(shown) -> None:
    for moved, left in ((0.0, 2), (60.0, 1)):
        shown.before = [Flat(), Flat(moved), Flat(moved)]
        assert len(part._ties(shown, 1)) == left


@pytest.mark.parametrize(("count", "every"), [(59, 1), (60, 1), (61, 2), (120, 2), (121, 3)])
def test_quicklooks_are_of_every_so_many_images(monkeypatch, count, every) -> None:
    """Images on other hosts and those without a file do not count; one that shows nothing has none."""
    away = [
        SimpleNamespace(name="r", path=Remote("https://example.org/r.tif", "https")),
        SimpleNamespace(name="n", path=""),
    ]
    views = [*away, *(SimpleNamespace(name=f"v{n}", path=f"v{n}.tif") for n in range(count))]
    asked = []

    def look(path, band):
        asked.append(path)
        if path == "v0.tif":
            return None
        if path == f"v{every}.tif":
            raise ImageError("gone")
        return np.zeros((2, 2), np.uint8) + band

    monkeypatch.setattr(part, "_quicklook", look)
    monkeypatch.setattr(part, "_ties", lambda run, band: [band])
    found = json.loads(pictures(SimpleNamespace(views=views), 7))  # type: ignore[arg-type]
    assert asked == [f"v{n}.tif" for n in range(0, count, every)]
    assert list(found["quicklooks"]) == [f"v{n}" for n in range(2 * every, count, every)]
    assert found["ties"] == [7]
    assert (pixels(found["quicklooks"][f"v{2 * every}"]) == 7).all()


def test_grey_values_of_a_narrow_range_are_stretched_as_far() -> None:
    """Of 0 to 1e-6 as of 0 to 1; rounding is downwards."""
    values = np.arange(101.0)
    np.testing.assert_array_equal(part._stretched(values * 1e-6), part._stretched(values))
    np.testing.assert_array_equal(part._stretched(values - 1000.0), part._stretched(values))
    np.testing.assert_array_equal(part._stretched(np.array([0.0, np.inf, 1.0])), [0, 255, 255])
