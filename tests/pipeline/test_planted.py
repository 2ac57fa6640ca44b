"""Errors in the pixels of real images: said, followed, and the image that has them is named."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from barpc.scene import View
from benchmarks.planted import FOLLOWED, GOOD, Clean, Plant, clean, planted, plants, run
from tests.geotiffs import write_image
from tests.lanes import known


@pytest.fixture(scope="module")
def start(shared_data):
    """A set of real images as it is, run once."""
    done: dict[str, Clean] = {}

    def made(name: str) -> Clean:
        if name not in done:
            done[name] = clean(name, shared_data)
        return done[name]

    return made


@pytest.mark.costs(9)
@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "size", "view", "seed"),
    [
        ("triplet", "jump", 2.0, 0, 0),  # of the others' ties a tenth agreed, and the third was another image's
        ("triplet", "jump", 12.0, 0, 0),  # the control band shows the other rows
        ("triplet", "lost", 6.0, 0, 0),  # its grid has no place for what was lost
        ("ventoux", "detector", 3.0, 0, 0),  # with more drift no tie was left
        pytest.param(
            *("ventoux", "jump", 12.0, 1, 0),  # delivered 5 px off
            marks=known("said, with exit code 3, and 5.2 px are left"),
        ),
        ("pair 23", "detector", 0.5, 1, 0),  # steps of both explain as much
        ("triplet", "detector", 1.0, 2, 0),
        ("triplet", "jump", 1.5, 1, 0),
        ("pair 12", "jump", 12.0, 1, 0),
    ],
)
def test_what_is_planted_is_followed_and_named(start, tmp_path, name, kind, size, view, seed) -> None:
    untouched = start(name)
    ((_, plant),) = [row for row in plants(untouched, [kind], seed) if row[0] == size and row[1].view == view]
    found = planted(untouched, plant, size, tmp_path)
    assert found.shown > GOOD  # there is something to see
    assert found.code == 3
    assert found.error <= FOLLOWED, found.line()
    assert found.worst <= GOOD, found.line()
    where = re.compile(r"\b(rows?|columns?|lines?|RPC)\b", re.IGNORECASE)  # not what the scene or tie points do
    assert any(found.image in line and where.search(line) for line in found.words), found.line()


@pytest.mark.nightly
@pytest.mark.parametrize(("view", "px"), [(1, 3.0), (0, 3.0), (2, -1.5), (1, -1.5)])
def test_a_band_of_columns_displaced_along_the_rays_is_one_term_of_its_image(start, tmp_path, view, px) -> None:
    """Terms in the other images explain a step of the middle one as well, but for the correlated noise of matches."""
    untouched = start("triplet")
    found = planted(untouched, Plant("band", view, 0, 600, (0.0, px), 760), abs(px), tmp_path)
    (said,) = [text for text in found.words if "are displaced by" in text and text.startswith("Columns")]
    assert f" of {found.image} " in said
    assert float(said.split()[-2]) == pytest.approx(abs(px), abs=0.05)
    assert found.error <= 0.3 * found.shown, found.line()  # its ends are where tie points tell them


def moved(untouched: Clean, box: tuple[int, int, int, int], by: tuple[float, float], folder: Path) -> list[View]:
    """The images with the ground of a box (first and last col and row of the first image) moved by `by` (col, row) px
    from each to the next, as clouds move while a satellite passes."""
    inside = np.stack(np.meshgrid(*(np.linspace(*ends, 9) for ends in (box[:2], box[2:]))), axis=-1).reshape(-1, 2)
    ground, views = untouched.on_ground(0, inside), []
    for number, (view, sensor) in enumerate(zip(untouched.views, untouched.sensors, strict=True)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(view.path) as file:
                pixels, profile = file.read(1), {**file.profile, "driver": "GTiff"}
            step = (number * by[0], number * by[1])
            shifted = Plant("jump", number, 1, 0, step).pixels(pixels.astype(np.float64))
            there = np.rint(np.median(sensor.project(ground) - inside, axis=0)).astype(int)
            (left, top), (right, bottom) = ([box[::2], box[1::2]] + there).clip(0)
            part = np.s_[top:bottom, left:right]
            pixels[part] = np.rint(shifted[part]).clip(1, 60000)
            path = write_image(folder / f"{view.name}.tif", pixels, **profile)
        views.append(replace(view, path=str(path)))
    return views


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "box", "by", "said"),
    [
        ("triplet", (300, 620, 150, 330), (2.0, 0.0), "8 % of the tie points"),  # across the baseline
        ("triplet", (0, 1024, 200, 300), (2.0, 0.0), "show the same ground: moving objects"),  # of all columns
        ("pair 12", (0, 1024, 200, 300), (2.0, 0.0), "or it moves) are displaced by"),  # two images do not tell
        ("pair 12", (300, 620, 150, 330), (1.0, 1.0), "of the tie points"),
        ("triplet", (300, 620, 150, 330), (0.0, 6.0), "of the tie points"),  # along it: a height, and an image too far
        ("triplet", (0, 1024, 200, 300), (1.0, 1.0), "show the same ground: moving objects"),
    ],
)
def test_ground_that_moves_within_a_pass_is_said_to_move(start, tmp_path, name, box, by, said) -> None:
    result = run(moved(start(name), box, by, tmp_path))[0]
    words = result.summary["verdict"]
    assert any(said in text for text in words), words
    local = "of the tie points" in said
    assert any("move together" in text for text in words) is local
    assert any("displaced" in text for text in words) is not local
    if local:
        assert sum(view["num_moving"] for view in result.summary["views"]) > 0
