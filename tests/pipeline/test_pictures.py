"""Pictures of a run for its report: small, of the images as they are, along epipolar lines that rays confirm."""

from __future__ import annotations

import base64
import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rasterio

from barpc.base.errors import InputError
from barpc.pipeline import pictures
from barpc.pipeline.remake import remake_report
from barpc.simulate import simulate_block
from tests.geotiffs import write_image
from tests.sealing import seal

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def decoded(text: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize("order", [1, -1])
def test_rows_of_tiles_are_epipolar_lines_and_what_the_cameras_miss_is_across_them(order):
    """Rays, not the code of tiles: ground points along a line of sight at other heights stand on the middle row."""
    block = simulate_block(2, 40, seed=3)
    a, b = (view.sensor for view in block.views[::order])
    here = np.array([[300.0, 400.0], [1200.0, 900.0], [2000.0, 1500.0]])
    alt = np.full(3, float(np.mean(block.views[0].alt_range)))
    there = b.project(np.column_stack([a.localize(here, alt)[:, :2], alt]))
    first, second = pictures._along_lines([a, b], (here, there), alt, 20.0)
    size = first.shape[1]
    assert first.shape == second.shape == (3, size, size, 2)
    for nodes, middle in ((first, here), (second, there)):
        assert nodes[:, [0, 0, -1, -1], [0, -1, 0, -1]].mean(axis=1) == pytest.approx(middle, abs=1e-3)
    assert np.linalg.norm(first[:, 0, -1] - first[:, 0, 0], axis=1) == pytest.approx(40.0)
    assert (first[:, :, -1, 0] > first[:, :, 0, 0]).all()
    ends = second[:, [0, -1]].mean(axis=1)  # the line of middles of columns: the middle row
    axis = (ends[:, -1] - ends[:, 0]) / np.linalg.norm(ends[:, -1] - ends[:, 0], axis=1, keepdims=True)
    across = np.column_stack([-axis[:, 1], axis[:, 0]])
    for rise in (-30.0, 15.0, 40.0):
        seen = b.project(np.column_stack([a.localize(here, alt + rise)[:, :2], alt + rise])) - there
        assert np.abs((seen * across).sum(axis=1)).max() < 0.02
        assert np.abs((seen * axis).sum(axis=1)).min() > 1.0
    for miss in (-3.0, 5.0):  # px: the tile stays on its line, so the point stands that far from it
        off = pictures._along_lines([a, b], (here, there + miss * across + 4.0 * axis), alt, 20.0)[1]
        moved = off[:, [0, 0, -1, -1], [0, -1, 0, -1]].mean(axis=1) - there
        assert moved == pytest.approx(4.0 * axis, abs=0.02)


def test_cameras_without_a_parallax_and_unknown_heights_end_no_run(tmp_path):
    view = simulate_block(2, 40, seed=3).views[0]
    here = np.array([[300.0, 400.0], [500.0, 600.0]])
    first, second = pictures._along_lines([view.sensor, view.sensor], (here, here), np.array([100.0, np.nan]), 20.0)
    assert np.isnan(first[1]).all()
    assert np.isnan(second[1]).all()
    ramp = write_image(tmp_path / "ramp.tif", np.add.outer(np.arange(900), 2 * np.arange(1300)).astype(np.uint16))
    shown = replace(view, path=str(ramp), size=(1300, 900))
    assert not pictures._tile(shown, 1, first[1]).any()
    assert pictures._tile(shown, 1, second[0]).shape == (120, 120)


def test_a_run_keeps_small_pictures_of_what_it_saw_and_they_are_no_results(adjusted):
    result, out = adjusted
    found = json.loads((out / "tables/pictures.json").read_text())
    assert [one["image"] for one in found["images"]] == [view.name for view in result.run.views]
    for one, view in zip(found["images"], result.run.views, strict=True):
        grey = decoded(one["picture"])
        assert grey.shape[::-1] == tuple(one["size"])
        assert max(one["size"]) == min(480, max(view.size))
        assert len(one["picture"]) < 80_000
        with rasterio.open(view.path) as file:
            own = cv2.resize(file.read(1).astype(np.float32), tuple(one["size"]), interpolation=cv2.INTER_AREA)
        assert np.corrcoef(grey.ravel(), own.ravel())[0, 1] > 0.95
    (strip,) = found["pairs"]
    tiles = decoded(strip["picture"]).astype(float).reshape(3, 120, strip["tiles"], 120).transpose(0, 2, 1, 3)
    assert strip["rows"][1].endswith("delivered cameras")
    assert "tables/pictures.json" not in {one["file"] for one in result.summary["outputs"]}
    assert "tables/pictures.json" in (out / "SHA256SUMS").read_text()
    after = [cv2.phaseCorrelate(a, b)[0][1] for a, b in zip(tiles[0], tiles[2], strict=True)]
    assert np.median(np.abs(after)) < 1.0  # px of a tile: 0.2 to 1.3 of the image
    page = (out / "report.html").read_text()
    assert page.count("data:image/jpeg") == len(found["images"]) + 1
    assert len(page) < 2.5e6


def test_the_page_is_made_again_without_the_images_and_of_a_run_without_pictures(adjusted, tmp_path):
    out, page = tmp_path / "run", (adjusted[1] / "report.html").read_bytes()
    assert adjusted[0].report() == adjusted[1] / "report.html"
    assert adjusted[0].report().read_bytes() == page
    shutil.copytree(adjusted[1], out)
    assert remake_report(out).read_bytes() == page
    (out / "tables/pictures.json").unlink()  # of an earlier release
    seal(out)
    assert b"data:image/jpeg" not in remake_report(out).read_bytes()


@pytest.mark.parametrize(
    "text", ["{", "{}", '{"images": [{"image": "a", "size": [1, 1], "picture": "\\"><b>"}], "pairs": []}']
)
def test_damaged_pictures_are_named_in_one_line(adjusted, tmp_path, text):
    out = tmp_path / "run"
    shutil.copytree(adjusted[1], out)
    (out / "tables/pictures.json").write_text(text)
    with pytest.raises(InputError, match=r"pictures\.json"):
        remake_report(out)


def test_an_image_that_is_gone_or_elsewhere_is_left_out(matched, tmp_path):
    first, second, _ = matched[0].run.views
    gone = [first, replace(second, path=str(tmp_path / "no.tif")), replace(second, path="https://example.org/a.tif")]
    shown, unread = pictures.thumbnails(gone, 1, 60_000)
    assert (shown["image"], unread["image"]) == (first.name, second.name)
    assert "picture" in shown
    assert unread.keys() == {"image", "error"}
    assert "no.tif" in unread["error"]
