"""`--overlap-list` and `--aoi`: which pairs are matched, and where."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import DisconnectedError, InputError
from barpc.base.geodesy import ground_from_ecef
from barpc.pipeline import RunOptions, adjust
from barpc.pipeline.earlier import chosen_pairs
from barpc.pipeline.inputs import read_pairs
from barpc.pipeline.loading import load_views
from barpc.scene import View
from barpc.sensor.triangulation import triangulate
from barpc.tie import TieOptions, read_area
from tests.pointio.stages import read_matches
from tests.reliability.conftest import barpc
from tests.tie.test_pairs import camera
from tests.tie.test_pairs import views as overlapping

from .known import SAMPLES

IMAGES = [str(path) for path in SAMPLES]


@pytest.fixture(scope="module")
def views() -> tuple[View, ...]:
    return load_views(IMAGES).views


@pytest.mark.parametrize(
    "text",
    [
        "view_00 view_01\nview_01 view_02\n",
        "# by hand\nview_00.tif view_01.tif  # the best\n\nsomewhere/view_01.tif\tview_02.tif",
        "{0} {1}\n{1} {2}\n",
        "\ufeff'view_00' \"view_01\"\r\nview_01 view_02\r\n",
        "view_00 view_01\nview_01 view_02\nview_01 gone.tif\nelsewhere/gone.tif view_00\n",
    ],
    ids=["names", "files and comments", "paths", "quotes", "left out"],
)
def test_a_list_names_images_in_any_way(views, tmp_path, text) -> None:
    path = tmp_path / "pairs.txt"
    path.write_bytes(text.format(*IMAGES).encode())
    assert read_pairs(path, views, [tmp_path / "elsewhere/gone.tif"]) == [(0, 1), (1, 2)]


def test_only_pairs_with_an_image_that_was_left_out_are_passed_over(views, tmp_path) -> None:
    """By path or by name; another name of no view is an error, also beside one that was left out."""
    path, gone = tmp_path / "pairs.txt", [tmp_path / "elsewhere/gone.tif"]
    path.write_text("gone.tif view_00\nview_00 gone\nelsewhere/gone.tif view_01\nview_02 view_01\n")
    assert read_pairs(path, views, gone) == [(2, 1)]
    path.write_text("view_00 gone\n")
    with pytest.raises(InputError, match="lists no pair"):
        read_pairs(path, views, gone)
    for line in ("view_00 going", "gone going"):
        path.write_text(f"view_00 view_01\n{line}\n")
        with pytest.raises(InputError, match="line 2: the list of pairs: no view is named 'going'"):
            read_pairs(path, views, gone)
    with pytest.raises(InputError, match="no view is named 'gone'"):
        path.write_text("view_00 gone\n")
        read_pairs(path, views)


def test_a_view_goes_before_an_image_of_its_name_that_was_left_out(views, tmp_path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("view_00 view_01\n")
    assert read_pairs(path, views, [tmp_path / "twice/view_00.tif"]) == [(0, 1)]
    path.write_text("twice/view_00.tif view_01\nview_00 view_02\n")
    assert read_pairs(path, views, [tmp_path / "twice/view_00.tif"]) == [(0, 2)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("view_00 view_07\n", "line 1: the list of pairs: no view is named 'view_07'"),
        ("view_00 view_01\nview_02\n", "line 2: two image names are expected, found 1; quote names with spaces"),
        ("view_00 view_01 view_02\n", "line 1: two image names are expected, found 3"),
        ("view_00 view_00.tif\n", "line 1: view_00 is paired with itself"),
        ("\n# a\nview_01 view_01\n", "line 3: view_01 is paired with itself"),
        ("view_00 view_01\nview_00 {0}\n", "line 2: view_00 is paired with itself"),
        ("view_00 'view_01\n", "line 1: No closing quotation"),
        ("# nothing\n", "lists no pair"),
        ("", "the file is empty"),
        ("\0 \0", "line 1"),
    ],
)
def test_a_bad_list_is_refused_in_one_line(views, tmp_path, text, message) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text(text.format(*IMAGES))
    with pytest.raises(InputError, match=message) as caught:
        read_pairs(path, views)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00"], ids=["missing", "no text"])
def test_a_list_that_cannot_be_read_is_refused(views, tmp_path, content) -> None:
    path = tmp_path / "pairs.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match="a list of pairs"):
        read_pairs(path, views)


def test_new_images_are_matched_with_their_best_partners_and_farther_where_none_is_old() -> None:
    """Of 500 m on the ground, with cameras wrong by up to 250 m."""

    def of(*east: float, old: int, neighbours: int = 4) -> list[tuple[int, int]]:
        made = overlapping(*(camera(metres / 111_000.0) for metres in east))
        return chosen_pairs(made, [k < old for k in range(len(made))], TieOptions(search=500, neighbours=neighbours))

    assert of(620.0, 0.0, 100.0, old=1) == [(0, 1), (0, 2), (1, 2)]  # none overlaps the old one as delivered
    assert of(450.0, 0.0, 600.0, -20.0, old=1) == [(0, 1), (0, 2), (0, 3), (1, 3)]  # 1, 2 and 2, 3 only by errors
    assert of(0.0, 50.0, 110.0, 180.0, 160.0, old=4, neighbours=2) == [(2, 4), (3, 4)]
    assert of(0.0, 60.0, 100.0, old=1, neighbours=1) == [(0, 1), (1, 2)]
    assert [pair for pair in of(100.0, *range(12), old=1) if 0 in pair] == [(0, 12)]  # to the others each is nearer


def run(*args: object) -> tuple[int, str]:
    said = barpc("-q", *args)
    return said.code, said.err


def area_file(path: Path, views: tuple[View, ...]) -> Path:
    """The northern half of what the first image shows."""
    view = views[0]
    image = np.array([[0.0, 0.0], [view.size[0], 0.5 * view.size[1]]])
    (west, north, _), (east, south, _) = view.sensor.localize(image, np.full(2, np.mean(view.alt_range)))
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    return path


@pytest.mark.slow
def test_only_the_listed_pairs_are_matched_and_only_in_the_area(known, tmp_path) -> None:
    views = load_views(known.images).views
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("view_00 view_01\nview_02 view_01\n")
    area = area_file(tmp_path / "area.json", views)
    out = tmp_path / "out"
    code, err = run("match", *known.images, "-o", out, "--overlap-list", pairs, "--aoi", area)
    assert (code, err) == (0, "")
    summary = json.loads((out / "summary.json").read_text())
    assert summary["options"]["aoi"] == "../area.json"  # from the folder of the run
    tracks = read_matches(out / "matches.npz", [view.name for view in views])
    assert tracks.num_points > (500 if known.whole else 50)
    assert (np.bincount(tracks.point[tracks.view == 1]) == 1).all(), "a track without the middle view"
    sensors = [view.sensor for view in views]
    ground = ground_from_ecef(triangulate(sensors, tracks.view, tracks.point, tracks.xy).points)
    assert read_area(area).contains(ground[:, :2]).all()


@pytest.mark.parametrize(("flag", "word"), [("--overlap-list", "list of pairs"), ("--aoi", "no such file")])
def test_a_missing_file_ends_the_run_with_one_line(tmp_path, flag, word) -> None:
    gone = tmp_path / "gone.txt"
    code, err = run("match", *IMAGES, "-o", tmp_path / "out", flag, gone)
    assert code == 1
    (line,) = err.splitlines()
    assert line.startswith(f"barpc: {gone}: ")
    assert word in line


@pytest.mark.slow
def test_an_image_that_the_list_leaves_alone_can_be_left_out(known, tmp_path) -> None:
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("view_00 view_01\n")
    options = RunOptions(overlap_list=str(pairs), stop_after="matching")
    with pytest.raises(DisconnectedError, match=r"view_00, view_01; view_02\).*among the listed pairs"):
        adjust(known.images, tmp_path / "out", options)
    kept = adjust(known.images, tmp_path / "out", replace(options, keep_going=True))
    assert [view.name for view in kept.run.views] == ["view_00", "view_01"]
    assert kept.tracks.num_points > (500 if known.whole else 100)
