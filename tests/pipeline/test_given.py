"""`--matches`: real matches, made noisy, through the whole tool; what a user gets wrong; `--matcher` in workers."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.base.statistics import robust_spread
from barpc.pipeline import RunOptions, adjust, check
from barpc.pipeline.inputs import given_matches, given_tracks, linked_names
from barpc.pipeline.loading import load_views
from barpc.tie.pairing.epipolar import coherent, epipolar_segments
from tests.pointio.stages import read_matches
from tests.pointio.test_foreign import binary
from tests.tie.stages import common_tracks

from .conftest import check_points
from .known import SAMPLES as IMAGES

NOISE = 0.4  # px a coordinate


def noisy(shared_data: Path, folder: Path, *pairs: tuple[str, str]) -> Path:
    """Points that SIFT and a fundamental matrix gave, with more noise, as ASP's binary files."""
    folder.mkdir(exist_ok=True)
    for first, second in pairs:
        (path,) = (shared_data / "truth/ties").glob(f"*__{first}__{second}__sift.csv")
        table = np.genfromtxt(path, delimiter=",", names=True)
        xy = np.stack([table[name] for name in ("col_a", "row_a", "col_b", "row_b")], axis=1)
        xy = np.maximum(xy + np.random.default_rng(len(xy)).normal(0, NOISE, xy.shape), 0)
        (folder / f"run-{first}__{second}.match").write_bytes(binary(xy[:, :2], xy[:, 2:], 3))
    return folder


def spread(views, tracks, i: int, j: int) -> float:
    """Across the epipolar lines [px], both ends together."""
    first, second = common_tracks(tracks, i, j)
    return robust_spread(coherent(first, epipolar_segments(views[i], views[j], first).errors(second)[:, 1])[1])


@pytest.mark.slow
def test_noisy_matches_of_real_images_become_as_exact_as_our_own(shared_data, tmp_path) -> None:
    images = sorted((shared_data / "optical/phr_triplet_north").glob("*.tif"))
    ties = noisy(shared_data, tmp_path / "ties", ("img_01", "img_02"), ("img_02", "img_03"))
    result = adjust(images, tmp_path / "out", RunOptions(matches=str(ties)))
    raw = read_matches(ties, [view.name for view in result.views])
    reports = {report.names: report for report in result.run.matched}
    for i, j in ((0, 1), (1, 2)):
        assert spread(result.run.views, raw, i, j) > 0.55
        assert 0.03 < spread(result.run.views, result.tracks, i, j) <= 0.1
        assert 1400 < reports[f"img_0{i + 1}", f"img_0{j + 1}"].verified <= 1500
    assert reports["img_01", "img_03"].verified > 500  # matched here, at a first look
    cameras = result.adjustment.sensors
    for i, j in ((0, 1), (0, 2), (1, 2)):
        xy = check_points(shared_data, f"img_0{i + 1}", f"img_0{j + 1}")
        pair = [replace(view, sensor=camera) for view, camera in zip(result.run.views, cameras, strict=True)]
        across = epipolar_segments(pair[i], pair[j], xy[:, :2]).errors(xy[:, 2:])[:, 1]
        assert abs(np.median(across)) <= 0.05


def test_the_old_images_that_have_matches_with_new_ones_are_named(tmp_path) -> None:
    """Matches among old images, or among new ones, link nobody."""
    pairs = [("new_a", "old_b"), ("old_a", "old_c"), ("new_a", "new_b"), ("old_d", "new_b")]
    rows = [f"{name},{5 + n},7,{n}\n" for n, pair in enumerate(pairs) for name in pair]
    (tmp_path / "m.csv").write_text("image,col,row,track\n" + "".join(rows))
    old = ["old_a", "old_b", "old_c", "old_d"]
    assert linked_names([tmp_path / "m.csv"], ["new_a", "new_b"], old) == ["old_b", "old_d"]


@pytest.mark.parametrize("read", [given_matches, given_tracks])
@pytest.mark.parametrize(("astray", "fails"), [(1, False), (15, False), (16, True)])
def test_a_few_points_beyond_their_image_are_left_out_and_counted(tmp_path, caplog, read, astray, fails) -> None:
    """One in twenty of 300 points; what else sees them keeps its own partners."""
    views = load_views(IMAGES).views
    (width, height), names = views[0].size, [view.name for view in views]
    rows = [
        f"{names[i]},{width + 40 if t < astray and i == 0 else t + 5 + i},{7 + i},{t}\n"
        for t in range(100)
        for i in range(3)
    ]
    (tmp_path / "m.csv").write_text("image,col,row,track\n" + "".join(rows))
    said = f"m.csv: {astray} of 300 points lie outside their images, as .* in view_00, {width} x {height} pixels"
    if fails:
        with pytest.raises(InputError, match=said):
            read([tmp_path / "m.csv"], views)
        return
    found = read([tmp_path / "m.csv"], views)
    assert re.search(f"{said}: they are left out", caplog.text)
    if read is given_tracks:
        assert np.bincount(np.bincount(found.point)).tolist() == [0, 0, astray, 100 - astray]
        first = (found.xy[:, 0] - found.view)[np.searchsorted(found.point, np.arange(100))]
        np.testing.assert_array_equal(found.xy[:, 0] - found.view, first[found.point])
        return
    for pair, lost in (((0, 1), astray), ((0, 2), astray), ((1, 2), 0)):
        xy = found[pair].xy
        assert sorted(xy[:, 0, 0] - pair[0] - 5) == [*range(lost, 100)]
        np.testing.assert_array_equal(xy[:, 1, 0] - xy[:, 0, 0], pair[1] - pair[0])


@pytest.mark.slow
def test_an_image_that_is_left_out_leaves_the_rest_of_the_matches(shared_data, corner, tmp_path) -> None:
    """The stray image is the only one that the file ties: what is left is matched here."""
    stray = sorted((shared_data / "optical/phr_triplet_north").glob("*.tif"))[:2]
    ties = noisy(shared_data, tmp_path / "ties", ("img_01", "img_02"))
    result = check([*corner.images, *stray], RunOptions(matches=str(ties), keep_going=True))
    assert [view.name for view in result.views] == [path.stem for path in corner.images]
    assert len(result.run.matched) == 3


@pytest.mark.landing(2)
@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("name", "content"), [("a.txt", b""), ("a.txt", b"0 0\n"), ("a.match", bytes(16)), ("a.match", b"")]
)
def test_a_file_without_a_match_of_its_pair_is_as_none_and_said(corner, tmp_path, caplog, name, content) -> None:
    """A matcher that found nothing writes one; a folder without any file of these images is a mistake."""
    first, second = corner.images[:2]
    ties = tmp_path / "ties"
    ties.mkdir()
    with pytest.raises(InputError, match="ties: no track is seen in two of the views"):
        check([first, second], RunOptions(matches=str(ties)))
    (ties / f"{first.stem}__{second.stem}{name[1:]}").write_bytes(content)
    result = check([first, second], RunOptions(matches=str(ties)))
    assert "holds no match" in caplog.text
    assert result.tracks.xy.tolist() == check([first, second]).tracks.xy.tolist()
    with pytest.raises(InputError, match="no track is seen in two of the views"):
        check([first, second], RunOptions(matches=str(ties), matches_only=True))


def test_several_files_are_one(tmp_path) -> None:
    """Points at the same place of an image are one, with the smaller sigma; a file that says nothing is an error."""
    views = load_views(IMAGES).views
    one, two, none = (tmp_path / name for name in ("one.csv", "two.csv", "none.csv"))
    names = [view.name for view in views]
    rows = [f"{names[i]},{5 + t},{7 + i},{t},{sigma}\n" for t in range(9) for i, sigma in ((0, 0.3), (1, 0.2))]
    one.write_text("image,col,row,track,sigma\n" + "".join(rows))
    rows = [f"{names[i]},{5 + t},{7 + i},x{t},0.25\n" for t in range(4, 12) for i in (1, 2)]
    two.write_text("image,col,row,track,sigma\n" + "".join(rows))
    tracks = given_tracks([one, two], views)
    assert np.bincount(np.bincount(tracks.point)).tolist() == [0, 0, 7, 5]
    assert sorted(tracks.sigma[tracks.view == 1]) == [0.2] * 9 + [0.25] * 3
    assert {pair: len(found) for pair, found in given_matches([one, two], views).items()} == {
        (0, 1): 9,
        (1, 2): 8,
    }
    assert given_tracks([two, one], views).xy.tolist() == tracks.xy.tolist()
    none.write_text("image,col,row,track\n")
    with pytest.raises(InputError, match=r"none\.csv: no track"):
        given_matches([one, none], views)
    assert given_matches([none, one], views, partly=True).keys() == {(0, 1)}
    assert given_matches([none], views, partly=True) == {}


MODULE = """
import cv2, numpy as np
from pathlib import Path
from barpc.rasters.raster import open_raster
def match(a, b, prediction):
    Path(__file__).with_name("called").write_text("yes")
    found = []
    for view in (a, b):
        with open_raster(view.path) as image:
            grey = cv2.normalize(image.read(1), None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
        found.append(cv2.SIFT.create(2000).detectAndCompute(grey, None))
    pairs = cv2.BFMatcher(crossCheck=True).match(found[0][1], found[1][1])
    return np.array([[found[0][0][m.queryIdx].pt, found[1][0][m.trainIdx].pt] for m in pairs])
"""


@pytest.mark.nightly
def test_a_matcher_by_name_works_in_worker_processes_with_the_same_bytes(tmp_path) -> None:
    (tmp_path / "mine.py").write_text(MODULE)
    written = []
    for jobs in ("1", "2"):
        out = tmp_path / jobs
        run = [
            sys.executable,
            "-m",
            "barpc",
            "-q",
            "match",
            *map(str, IMAGES[:2]),
            "-j",
            jobs,
            "-o",
            str(out),
        ]
        places = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
        env = {**os.environ, "PYTHONPATH": places, "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run([*run, "--matcher", "mine:match"], env=env, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")
        written.append((out / "matches.csv").read_bytes())
        (tmp_path / "called").unlink()
    assert written[0] == written[1]
    assert json.loads((tmp_path / "1/summary.json").read_text())["options"]["tie"]["matcher"] == "mine:match"
