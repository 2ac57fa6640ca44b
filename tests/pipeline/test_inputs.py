"""Control points, terrain, tie points from files, earlier blocks, stray images."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.base.errors import DisconnectedError, InputError
from barpc.pipeline import RunOptions, adjust
from barpc.rpcio import read_rpc
from barpc.rpcio.images import put_tag
from tests.pointio.stages import read_matches

from .known import errors_of_run


@pytest.mark.slow
def test_tie_points_from_a_file_give_the_same_answer(known, matched, tmp_path):
    result, out = matched
    runs = []
    for name in ("matches.csv", "matches.npz"):
        given = RunOptions(matches_only=True, matches=str(out / name), stop_after="adjustment")
        again = adjust(known.images, tmp_path / name, given)
        np.testing.assert_array_equal(again.tracks.xy, result.tracks.xy)
        np.testing.assert_array_equal(again.tracks.sigma, result.tracks.sigma)
        runs.append(again.adjustment.params)
    np.testing.assert_array_equal(*runs)


@pytest.mark.slow  # before a commit: the same tie points from a table, and ASP's in tests/pointio
def test_asp_text_matches_hold_the_same_tie_points(matched):
    result, out = matched
    assert sorted(path.name for path in (out / "asp").iterdir()) == [
        "view_00__view_01.txt",
        "view_00__view_02.txt",
        "view_01__view_02.txt",
    ]
    back = read_matches(out / "asp", [view.name for view in result.views])
    # the format knows a keypoint by its place only: the few tracks that share one are ambiguous and left out
    assert result.tracks.num_points >= back.num_points > 0.97 * result.tracks.num_points
    ours = {(view, *xy) for view, xy in zip(result.tracks.view.tolist(), result.tracks.xy.tolist(), strict=True)}
    theirs = {(view, *xy) for view, xy in zip(back.view.tolist(), back.xy.tolist(), strict=True)}
    assert theirs <= ours


def test_control_points_put_the_scene_in_its_place(known, matched, tmp_path):
    options = RunOptions(matches_only=True, matches=str(matched[1] / "matches.npz"), gcp=(str(known.gcps),))
    result = adjust(known.images, tmp_path / "out", options)
    rms, offset = errors_of_run(tmp_path / "out", known.truth)
    sigma = np.array(result.summary["scene"]["sigma_enu_m"])
    assert rms <= 0.02
    assert (sigma < 1.0).all()
    assert (np.abs(offset) <= 2 * sigma).all()
    assert len(result.summary["gcps"]) == 5


@pytest.mark.slow
def test_one_image_and_control_points_are_enough(shared_data, tmp_path):
    image = shared_data / "optical/qb2_single/qb2_basic1b.tif"
    gcps = shared_data / "optical/qb2_single/gcps.geojson"
    result = adjust([image], tmp_path / "out", RunOptions(gcp=(str(gcps),)))
    before, after = result.run.views[0].sensor, read_rpc(tmp_path / "out/qb2_basic1b.vrt")
    points = result.run.gcps

    def error(rpc):
        return np.sqrt(((rpc.project(points.lonlatalt[points.point]) - points.xy) ** 2).sum(axis=1).mean())

    assert error(before) > 3
    assert error(after) < 0.4 * error(before)
    assert result.summary["passed"]
    assert "nan" not in " ".join(result.summary["verdict"])


def test_control_points_of_other_images_are_refused_before_any_work(corner, tmp_path):
    text = corner.gcps.read_text().replace("view_0", "photo_")
    (tmp_path / "gcps.geojson").write_text(text)
    with pytest.raises(InputError, match=r"gcps\.geojson"):
        adjust(corner.images, tmp_path / "out", RunOptions(gcp=(str(tmp_path / "gcps.geojson"),)))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow  # before a commit: a list that leaves an image alone, and the option
def test_a_stray_image_is_named_and_left_out_when_asked(known, tmp_path):
    stray = tmp_path / "img_01.tif"
    elsewhere(known.images[0], stray)
    with pytest.raises(DisconnectedError) as caught:
        adjust([*known.images, stray], tmp_path / "out", RunOptions(stop_after="matching"))
    assert caught.value.groups[1] == ("img_01",)
    options = RunOptions(keep_going=True, overwrite=True)
    result = adjust([*known.images, stray], tmp_path / "out", options)  # what was found is not found again
    assert [view.name for view in result.views] == ["view_00", "view_01", "view_02"]
    assert not result.passed
    assert result.summary["left_out"][0]["path"] == "../img_01.tif"  # from the folder of the run
    assert not (tmp_path / "out/img_01.vrt").exists()


def elsewhere(source: Path, target: Path) -> None:
    """An image of a place far to the east."""
    shutil.copy(source, target)
    with rasterio.open(target, "r+") as image:
        image.write(np.ascontiguousarray(image.read()[:, ::-1, ::-1]))
    rpc = read_rpc(source)
    put_tag(target, replace(rpc, ground_offset=rpc.ground_offset + [1.0, 0.0, 0.0]))


@pytest.mark.slow
def test_a_real_stray_image_is_left_out(corner, shared_data, tmp_path):
    stray = shared_data / "optical/phr_triplet_north/img_01.tif"
    result = adjust([*corner.images, stray], tmp_path / "out", RunOptions(keep_going=True))
    assert [view.name for view in result.views] == ["view_00", "view_01", "view_02"]
    assert not result.passed
    assert (tmp_path / "out" / result.summary["left_out"][0]["path"]).resolve() == stray.resolve()


@pytest.mark.slow  # before a commit: the option
def test_a_later_run_goes_on_from_an_earlier_block(known, matched, tmp_path):
    given = RunOptions(matches_only=True, matches=str(matched[1] / "matches.npz"))
    two = tmp_path / "two.csv"
    rows = (matched[1] / "matches.csv").read_text().splitlines(keepends=True)
    two.write_text("".join(row for row in rows if not row.startswith("view_02")))
    half = replace(given, matches=str(two), stop_after="adjustment")
    adjust(known.images[:2], tmp_path / "two", half)
    joint = adjust(known.images, tmp_path / "joint", replace(given, stop_after="adjustment"))
    result = adjust(known.images, tmp_path / "three", replace(given, add_to=str(tmp_path / "two")))
    assert errors_of_run(tmp_path / "three", known.truth)[0] <= 0.03
    sigma = [np.sqrt(np.diag(run.adjustment.covariance.view(2))) for run in (joint, result)]
    np.testing.assert_allclose(sigma[1], sigma[0], rtol=0.2)


@pytest.mark.slow
def test_a_dem_holds_heights_and_says_what_it_took(shared_data, tmp_path):
    source = shared_data / "optical/phr_ventoux"
    for path in source.glob("*_image.*"):
        shutil.copy(path, tmp_path / path.name)
    images = [tmp_path / "left_image.tif", tmp_path / "right_image.tif"]
    base = RunOptions()
    options = replace(
        base,
        dem=str(shared_data / "dem/N44E005.hgt"),
        geoid=str(shared_data / "dem/egm96_15.gtx"),
    )
    free, held = adjust(images, tmp_path / "free"), adjust(images, tmp_path / "held", options)
    sigma = [run.summary["scene"]["sigma_enu_m"][2] for run in (free, held)]
    assert sigma[0] > 20
    assert sigma[1] < 20  # as well as a DEM is known as a whole, and no better
    # the crops' terrain stands 0-30 m above the radar DEM's (trees, 90 m cells)
    assert abs(held.adjustment.gauge.shift[2] - free.adjustment.gauge.shift[2]) < 60
    assert abs(held.summary["pairs"][0]["epipolar_after"]["median"]) < 0.1


@pytest.mark.slow
def test_paths_with_spaces_and_accents_and_equal_stems(corner, tmp_path):
    folders = [tmp_path / "été 1", tmp_path / "été 2"]
    for folder, path in zip(folders, corner.images, strict=False):
        folder.mkdir()
        shutil.copy(path, folder / "scène.tif")
    result = adjust([folder / "scène.tif" for folder in folders], tmp_path / "out à moi")
    names = [view.name for view in result.views]
    assert names == ["été 1_scène", "été 2_scène"]
    for name in names:
        assert read_rpc(Path(tmp_path / "out à moi" / f"{name}.vrt")) is not None


@pytest.mark.slow
def test_check_points_are_measured_and_not_used(known, matched, tmp_path):
    given = RunOptions(matches_only=True, matches=str(matched[1] / "matches.npz"), stop_after="adjustment")
    free = adjust(known.images, tmp_path / "free", given)
    checked = adjust(known.images, tmp_path / "checked", replace(given, check_points=(str(known.gcps),)))
    np.testing.assert_array_equal(checked.adjustment.params, free.adjustment.params)
    points = checked.summary["check_points"]
    assert len(points) == 5
    height = np.array([point["residual_enu_m"][2] for point in points])
    sigma = checked.summary["scene"]["sigma_enu_m"][2]
    assert (np.abs(height) < 3 * sigma).all()
    assert np.abs(height).min() > 10  # without control the scene floats, and that is what they show
    assert any("5 check points" in line for line in checked.summary["verdict"])
