"""The surface of real images: pairs agree, more so by corrected cameras, and cost what they are said to."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import rasterio

from barpc.ba.result import pair_heights
from barpc.base.errors import InputError
from barpc.base.geodesy import ground_from_ecef
from barpc.base.verb_options import DsmOptions
from barpc.dsm.stereo import block_of_run
from barpc.dsm.surface import make_dsm
from barpc.pipeline import adjust
from barpc.report.runfiles import read_summary, read_tables
from barpc.report.summary.words import metres
from tests.cli.test_main import run as command

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(shared_data, tmp_path_factory):
    images = sorted((shared_data / "optical" / "phr_triplet_north").glob("*.tif"))
    out = tmp_path_factory.mktemp("triplet") / "run"
    return images, out, adjust(images, out)


@pytest.fixture(scope="module")
def surface(run, tmp_path_factory):
    """That of the run with all its pairs, which its report shows."""
    path = tmp_path_factory.mktemp("surface") / "dsm.tif"
    return make_dsm(run[1], path), path


@pytest.fixture
def copied(run, tmp_path):
    """A run folder of one's own."""
    return shutil.copytree(run[1], tmp_path / "run")


@pytest.mark.nightly  # before: of a window, in the report, below
def test_pairs_of_the_triplet_by_delivered_cameras_do_not_agree(run, surface, tmp_path):
    before = make_dsm([str(path) for path in run[0]], tmp_path / "before.tif", DsmOptions(alt=(37.0, 355.0)))
    assert surface[0].nmad < 0.5 * before.nmad


@pytest.mark.costs(6)
def test_pairs_of_the_triplet_agree_to_a_third_of_a_metre(surface):
    after = surface[0]
    assert after.pairs[0] == "img_01 - img_03"  # the largest angle
    assert after.nmad < 0.40
    with rasterio.open(surface[1]) as file:
        bands, tags = file.read(), file.tags()
    known = np.isfinite(bands[0])
    assert 137_800 < known.sum() < 138_550  # m^2: of 138,558 that any pair has, those that pairs contradict are void
    low, high = np.percentile(bands[0][known], [1, 99])
    assert 75.0 < low < 90.0
    assert 305.0 < high < 320.0
    assert (bands[4][known] > 0).all()
    assert np.median(bands[4][known]) < 2.0  # without what all cells share,
    assert 10.0 < float(tags["SIGMA_SHARED_BY_ALL_CELLS_M"]) < 100.0  # which ties do not tell


@pytest.mark.nightly  # before: of rendered images, in test_surface
def test_the_command_says_what_it_made(copied, tmp_path, capsys):
    assert command("-q", "dsm", copied, "-o", tmp_path / "dsm.tif", "--pairs", 1, "--gsd", 2, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["gsd"] == 2.0
    assert told["pairs"] == ["img_01 - img_03"]
    assert told["nmad"] is None
    assert told["known"] > 25_000


def test_what_the_cameras_leave_of_a_height_is_what_their_adjustment_says(run):
    """Of the run's folder alone as of the adjustment that wrote it: the pair's absolute sigma at its tie points."""
    adjustment, block = run[2].adjustment, block_of_run(run[1])
    assert block.errors is not None
    points = adjustment.points[np.isfinite(adjustment.points[:, 0])][::20]
    stated = block.errors.sigma(block.errors.rows([[(0, 2)]], ground_from_ecef(points)))
    assert np.sqrt(np.mean(stated**2)) == pytest.approx(pair_heights(adjustment, 0, 2).absolute, rel=0.01)


def test_the_report_shows_the_same_window_before_and_after(surface, copied):
    before, after = read_tables(read_summary(copied), copied).reliefs
    assert before.nmad_m > 2.0 * after.nmad_m
    assert after.share > 0.4
    page = (copied / "report.html").read_text(encoding="utf-8")
    assert "Which ground do they reconstruct?" in page
    assert page.count("from the delivered cameras, lit") == page.count("from the corrected cameras, lit") == 2
    assert f"differ by {metres(before.nmad_m)} and {metres(after.nmad_m)}" in page
    assert page.count('class="swipe"') == 1
    assert "img_01 (left) and img_03 (right) draped over the surface from the corrected cameras" in page
    assert len(page) < 2_000_000
    (copied / "tables/surface.json").write_text("[]")
    with pytest.raises(InputError, match=r"surface\.json: damaged"):
        read_tables(read_summary(copied), copied)
