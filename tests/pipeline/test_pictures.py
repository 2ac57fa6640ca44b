"""What the report shows of the pixels: patches lie over each other exactly where the cameras are right."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rasterio.io import MemoryFile

from barpc.pipeline import RunOptions, adjust
from barpc.pipeline.pictures import HALF, pictures

pytest.importorskip("jinja2")
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
SAMPLES = sorted((Path(__file__).resolve().parents[2] / "data_samples").glob("*.tif"))


def pixels(text: str) -> np.ndarray:
    with MemoryFile(base64.b64decode(text)) as memory, memory.open() as image:
        return image.read(1).astype(float)


def alike(a: str, b: str) -> float:
    return float(np.corrcoef(pixels(a).ravel(), pixels(b).ravel())[0, 1])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures") / "out"
    return adjust(SAMPLES, folder), folder


def test_after_the_adjustment_the_patches_of_a_tie_point_show_the_same(finished):
    found = json.loads((finished[1] / "pictures.json").read_text())
    kinds = [tie["kind"] for tie in found["ties"]]
    assert kinds.count("worst") > 5
    assert kinds.count("random") > 5
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


def test_a_camera_that_is_moved_shows_in_the_patches(finished):
    """Of a run whose new cameras are those as delivered, "after" looks as bad as "before"."""
    run = finished[0].run
    same = replace(run, adjustment=None, fits=(), matched=())
    found = json.loads(pictures(same, 1))
    likeness = [alike(*tie["patches"]) for tie in found["ties"]]
    assert all(len(tie["patches"]) == 2 for tie in found["ties"])
    assert np.median(likeness) < 0.7


def test_quicklooks_show_the_images_and_the_report_holds_them(finished):
    found = json.loads((finished[1] / "pictures.json").read_text())
    assert set(found["quicklooks"]) == {path.stem for path in SAMPLES}
    assert all(100 < max(pixels(look).shape) <= 360 for look in found["quicklooks"].values())
    html = (finished[1] / "report.html").read_text()
    assert all(look in html for look in found["quicklooks"].values())
    assert all(patch in html for tie in found["ties"] for patch in tie["patches"])
    assert "http" not in html.replace("http-equiv", "").replace("http://www.w3.org", "")


def test_no_pixel_leaves_where_that_is_not_wanted(tmp_path):
    adjust(SAMPLES, tmp_path / "out", RunOptions(pictures=False))
    assert not (tmp_path / "out/pictures.json").exists()
    assert "data:image/jpeg" not in (tmp_path / "out/report.html").read_text()


def test_an_image_that_is_gone_has_no_pictures(finished):
    run = finished[0].run
    gone = replace(run.views[0], path="/nowhere/at/all.tif")
    found = json.loads(pictures(replace(run, views=(gone, *run.views[1:])), 1))
    assert set(found["quicklooks"]) == {view.name for view in run.views[1:]}
    assert found["ties"]
    assert all(gone.name not in (tie["a"], tie["b"]) for tie in found["ties"])
