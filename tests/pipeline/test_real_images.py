"""The whole tool on real images, measured on check points that it never saw."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.base.geodesy import ground_from_ecef
from barpc.fit import fit_rpc
from barpc.rpcio import read_rpc
from barpc.scene import View
from barpc.sensor.image_corrections import ImageAffine, ImageCorrected
from barpc.sensor.sampler import Sample
from barpc.sensor.triangulation import epipolar_offset, triangulate
from tests.constants import chosen
from tests.everywhere import rows_of, tied
from tests.lanes import rest_slow

from .conftest import check_points

PAIRS = [("img_01", "img_02"), ("img_01", "img_03"), ("img_02", "img_03")]


def epipolar(rpc_a, rpc_b, points):
    offset, _ = epipolar_offset(rpc_a, rpc_b, points[:, :2], points[:, 2:], 200.0)
    median = np.median(offset)
    return median, 1.4826 * np.median(np.abs(offset - median))


@pytest.mark.slow
@pytest.mark.parametrize(("pair", "delivered"), list(zip(PAIRS, (0.69, 1.20, 0.53), strict=True)))
def test_the_triplets_check_points_meet_within_three_hundredths_of_a_pixel(shared_data, triplet, pair, delivered):
    _, out = triplet
    points = check_points(shared_data, *pair)
    before = [read_rpc(shared_data / f"optical/phr_triplet_north/{name}.tif") for name in pair]
    after = [read_rpc(out / f"{name}.vrt") for name in pair]
    assert abs(epipolar(*before, points)[0]) == pytest.approx(delivered, abs=0.02)
    median, spread = epipolar(*after, points)
    assert abs(median) <= 0.02
    noise = {
        entry["pair"]: entry["ncc"]["mad"] for entry in json.loads((shared_data / "truth/ties_index.json").read_text())
    }
    assert spread <= 1.1 * noise["-".join(pair)]


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_points_of_another_detector_meet_without_a_bias(shared_data, triplet, pair):
    """The check points found by template matching lie 0.02 px off both these and the tool's own."""
    result, _ = triplet
    cameras = {view.name: view.sensor for view in result.views}
    rows = np.loadtxt(
        shared_data / f"truth/ties/phr_triplet_north__{pair[0]}__{pair[1]}__sift.csv",
        delimiter=",",
        skiprows=1,
    )[:, :4]
    offset, _ = epipolar_offset(*(cameras[name] for name in pair), rows[:, :2], rows[:, 2:], 200.0)
    offset = offset[np.abs(offset - np.median(offset)) < 1.0]
    assert len(offset) > 1000
    assert abs(offset.mean()) < 3 * offset.std() / np.sqrt(len(offset)) < 0.025


def spoilt(view, turn=0.0, scale=0.0, shift=(0.0, 0.0)):
    """A view whose RPC was made for the image turned [rad], enlarged and shifted [px] about its middle."""
    middle = (np.array(view.size) - 1.0) / 2.0
    cos, sin = np.cos(turn), np.sin(turn)
    slope = (1.0 + scale) * np.array([[cos, -sin], [sin, cos]]) - np.eye(2)
    moved = ImageCorrected(view.sensor, ImageAffine(np.array(shift) - slope @ middle, slope))
    return replace(view, sensor=fit_rpc(moved, view.size, view.alt_range).rpc)


SPOILT = {
    "as delivered": lambda views: views,
    "all": lambda views: [
        spoilt(v, s * 3e-3, t * 2e-3, (3 * s, -2 * t))
        for v, s, t in zip(views, (1, -1, 0.5), (-1, 0.7, 1), strict=True)
    ],
    "turned": lambda views: [spoilt(views[0], turn=1e-2), *views[1:]],
    "turned a little": lambda views: [spoilt(views[0], turn=3e-3), *views[1:]],
    "enlarged": lambda views: [views[0], spoilt(views[1], scale=1e-2), views[2]],
    "enlarged a little": lambda views: [views[0], spoilt(views[1], scale=2e-3), views[2]],
    "swapped": lambda views: [
        replace(v, sensor=other.sensor) for v, other in zip(views, (views[1], views[0], views[2]), strict=True)
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", rest_slow(SPOILT, mark=pytest.mark.nightly))
def test_an_image_that_was_turned_or_resampled_is_met_all_the_same(shared_data, triplet, name):
    result, _ = triplet
    found = adjust_tracks(SPOILT[name](list(result.run.views)), result.tracks)
    cameras = dict(zip(found.names, found.sensors, strict=True))
    assert found.held_out_rms.max() < 0.12
    for pair in PAIRS:
        points = check_points(shared_data, *pair)
        median, spread = epipolar(*(cameras[n] for n in pair), points)
        best = epipolar(*(result.views[int(n[-1]) - 1].sensor for n in pair), points)
        assert abs(median) < 0.03
        assert spread < 1.05 * best[1]
    in_image = found.cameras.unknowns.model == "affine"
    assert in_image == (found.in_space_rms is not None)
    assert in_image == (name != "as delivered")
    assert found.findings == ()  # nothing but the image as a whole
    assert not found.moving.any()
    if name == "as delivered":
        assert np.abs(found.gauge.shift).max() < 0.2  # of 7 m, 7 m and 67 m that are not known


@pytest.mark.slow
def test_check_points_seen_in_three_images_are_met_to_a_tenth_of_a_pixel(shared_data, triplet):
    _, out = triplet
    second, third = (check_points(shared_data, "img_01", name) for name in ("img_02", "img_03"))
    by_place = {tuple(row[:2]): row[2:] for row in third}
    chained = np.array([[*row, *by_place[tuple(row[:2])]] for row in second if tuple(row[:2]) in by_place])
    assert len(chained) > 300

    chained = chained.reshape(-1, 3, 2)

    def errors(sensors):
        residuals = triangulate(sensors, *rows_of(chained), alt=200.0).residuals
        return (residuals.reshape(-1, 6) ** 2).mean(axis=1)

    folder = shared_data / "optical/phr_triplet_north"
    delivered = [read_rpc(folder / f"img_0{i}.tif") for i in (1, 2, 3)]
    assert np.sqrt(errors(delivered).mean()) > 0.3
    adjusted = errors([read_rpc(out / f"img_0{i}.vrt") for i in (1, 2, 3)])
    # one in a hundred of the chained check points is a gross mismatch (up to 2.4 px)
    assert np.sqrt(np.sort(adjusted)[: int(0.99 * len(adjusted))].mean()) <= 0.10
    # with them, nobody can do better than cameras adjusted to the check points themselves
    views = [View(f"img_0{i}", "", (1024, 560), rpc, (0.0, 1000.0)) for i, rpc in enumerate(delivered, start=1)]
    with chosen(AdjustOptions, robust_threshold=1e9) as options:  # least squares of all
        best = adjust_tracks(views, tied(chained, 0.1), options, hold_out=False)
    assert best.inlier.all()
    assert np.sqrt(adjusted.mean()) <= 1.01 * np.sqrt((best.residuals**2).mean())


@pytest.mark.slow  # whole images; before a commit: the same pair's tie points, tests/tie/test_real_images.py
@pytest.mark.parametrize(("which", "delivered"), [("ventoux_biased", 20.6), ("ventoux", 4.8)])
def test_ventoux_with_little_overlap_is_met_within_five_hundredths_of_a_pixel(request, shared_data, which, delivered):
    result, out = request.getfixturevalue(which)
    points = check_points(shared_data, "left_image", "right_image")
    before = [view.sensor for view in result.run.views]
    assert abs(epipolar(*before, points)[0]) == pytest.approx(delivered, abs=0.1)
    after = [read_rpc(out / f"{name}.vrt") for name in ("left_image", "right_image")]
    median, spread = epipolar(*after, points)
    assert abs(median) <= 0.05
    assert spread <= 1.1 * 0.184


@pytest.mark.slow
@pytest.mark.parametrize("which", rest_slow(["ventoux_biased", "triplet", "ventoux"]))
def test_the_files_hold_p_ba_to_a_millionth_of_a_pixel(request, which):
    result, out = request.getfixturevalue(which)
    for view, model in zip(result.run.views, result.adjustment.sensors, strict=True):
        sample = Sample.grid(model, view.size, view.alt_range)
        assert len(sample.ground) == 11 * 11 * 5
        assert sample.compare(view.sensor.project) > 0.05  # doing nothing does not pass
        for name in (f"{view.name}.vrt", f"{view.name}_RPC.TXT"):
            assert sample.compare(read_rpc(out / name).project) <= 1e-6


@pytest.mark.parametrize("which", rest_slow(["ventoux_biased", "triplet", "ventoux"]))
def test_the_images_are_not_shifted_as_a_set(request, which):
    result, _ = request.getfixturevalue(which)
    views, tracks = result.run.views, result.tracks
    keep = result.adjustment.inlier
    ground = triangulate([v.sensor for v in views], tracks.view, tracks.point, tracks.xy, alt=200.0).points
    shift = np.zeros((len(views), 2))
    for i, view in enumerate(views):
        at = ground_from_ecef(ground[tracks.point[keep & (tracks.view == i)]])
        shift[i] = np.median(result.adjustment.sensors[i].project(at) - view.sensor.project(at), axis=0)
    # half a pixel of a wrong convention would stand here as (0.5, 0.5)
    assert np.abs(shift.mean(axis=0)).max() < 0.15
    if which != "triplet":
        assert np.abs(shift).max() > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("which", ["triplet", "ventoux"])
def test_the_scene_stays_where_the_cameras_put_it(request, which):
    result, _ = request.getfixturevalue(which)
    assert np.abs(result.adjustment.gauge.shift).max() <= 1.0
    scene = result.summary["scene"]
    assert min(scene["sigma_enu_m"]) > 1.0  # and says that this is all that is known


@pytest.mark.slow
def test_camera_centres_are_at_the_height_of_the_orbit(triplet):
    for view in triplet[0].summary["views"]:
        assert view["camera_center"]["method"] == "line"
        assert view["camera_center"]["altitude_m"] == pytest.approx(694e3, rel=0.05)


@pytest.mark.slow
def test_the_summary_is_plain_json_and_says_what_was_reached(triplet):
    result, out = triplet
    summary = json.loads((out / "summary.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    of_this_run = ("out_dir", "stages")
    assert summary == {k: v for k, v in json.loads(json.dumps(result.summary)).items() if k not in of_this_run}
    assert summary["passed"] is True
    for view in summary["views"]:
        assert view["status"] == "adjusted"
        assert view["rmse_after"] < 0.3 * view["rmse_before"] + 0.05
        assert view["num_observations"] > 1000
        for consumers in view["outputs"].values():
            assert max(consumers.values()) <= 1e-6
            assert "barpc" in consumers
    for pair in summary["pairs"]:
        assert abs(pair["epipolar_after"]["median"]) < 0.03 < abs(pair["epipolar_before"]["median"])
    assert {stage["stage"] for stage in result.summary["stages"]} >= {
        "tie points",
        "adjustment",
        "fit",
        "write",
        "verify",
    }
    assert summary["verdict"][1].startswith("The adjustment moved the scene by ")


@pytest.mark.slow
def test_inputs_are_left_as_they_were(shared_data, triplet):
    for path in (shared_data / "optical/phr_triplet_north").iterdir():
        assert path.suffix == ".tif"
