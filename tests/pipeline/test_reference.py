"""A block that an orthoimage of another season brings to its place, and one that a wrong one leaves where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rasterio

from barpc.base.errors import TiePointError
from barpc.base.options import RunOptions
from barpc.cli import main
from barpc.pipeline import adjust
from barpc.pointio.gcps import read_gcps
from barpc.rpcio import read_rpc
from tests.geotiffs import write_image
from tests.lanes import rest_slow
from tests.pipeline.known import errors_of_run, part, whole
from tests.scenes import ImageOptions, Scene
from tests.scenes.season import other_season, write_dem, write_reference
from tests.scenes.terrain import Grid

DEM_BIAS = 2.0


@pytest.fixture(scope="module", params=["windows", pytest.param("whole", marks=pytest.mark.nightly)])
def shown(request, tmp_path_factory):
    """Three images with truth: windows of 600 px, at night the whole, too."""
    return whole() if request.param == "whole" else part(tmp_path_factory.mktemp("windows"), side=600, start=200)


@pytest.fixture(scope="module")
def truth(shown):
    return shown.truth


@pytest.fixture(scope="module")
def place(shown, truth, tmp_path_factory):
    """A folder with a reference, a mirrored one, a terrain and tie points."""
    out = tmp_path_factory.mktemp("place")
    options = {key: tuple(v) if isinstance(v, list) else v for key, v in truth["options"].items()}
    scene = Scene(ImageOptions(**options))
    season = other_season(scene, 5)
    mirrored = Grid(season.origin, season.step, np.ascontiguousarray(season.values[:, ::-1]))
    write_reference(out / "ref.tif", scene, season, 2.0)
    write_reference(out / "wrong.tif", scene, mirrored, 2.0)
    write_dem(out / "dem.tif", scene, 5, error=1.0, bias=DEM_BIAS)
    adjust(shown.images, out / "ties", RunOptions(stop_after="matching"))
    return out


@pytest.fixture(scope="module")
def options(place):
    return RunOptions(
        matches=str(place / "ties/matches.npz"),
        matches_only=True,
        dem=str(place / "dem.tif"),
        reference=(str(place / "ref.tif"),),
    )


@pytest.fixture(scope="module")
def held(shown, place, options):
    return adjust(shown.images, place / "held", options)


@pytest.mark.slow
def test_the_scene_stands_where_the_reference_says(held, place, truth):
    error, sigma = errors_of_run(place / "held", truth)[1], np.array(held.summary["scene"]["sigma_enu_m"])
    assert np.hypot(*error[:2]) < 1.0
    assert abs(error[2]) < DEM_BIAS + 2.0  # of the terrain's own noise, a metre
    assert (np.abs(error) <= 3 * sigma).all()
    assert sigma == pytest.approx([0.5, 0.5, 5.4], rel=0.15)
    assert held.passed
    delivered = np.array([view["offset_en_m"] for view in held.summary["reference"]["views"]])
    assert (np.linalg.norm(delivered, axis=1) > 5.0).all()


@pytest.mark.slow
def test_the_run_says_what_the_reference_did(held, place):
    found = held.summary["reference"]
    assert found["used"]
    assert found["step_m"] == pytest.approx(2.0, rel=1e-3)
    assert all(view["num_points"] <= view["num_passed"] <= view["num_tried"] for view in found["views"])
    (line,) = [line for line in held.summary["verdict"] if line.startswith("The reference was matched")]
    assert "in 3 images" in line
    assert not [line for line in held.summary["verdict"] if "Without ground control" in line]
    points = read_gcps(place / "held/tables/gcps.geojson", [view.name for view in held.run.views])
    assert len(points.names) == found["num_points"]
    assert len(points.view) == sum(view["num_points"] for view in found["views"])


@pytest.mark.slow
def test_its_points_can_be_read_as_gcps(held, place):
    points = read_gcps(place / "held/tables/gcps.geojson", [view.name for view in held.run.views])
    image = np.array(
        [
            held.adjustment.sensors[v].project(points.lonlatalt[p])
            for v, p in zip(points.view, points.point, strict=True)
        ]
    )
    assert np.median(np.linalg.norm(image - points.xy, axis=1)) < 8.0  # px, of 2 m pixels and single heights


@pytest.mark.nightly  # before: the option's row, and tests/ba/test_reference
def test_a_stated_sigma_is_the_scene_s(shown, options, tmp_path):
    run = adjust(shown.images, tmp_path / "run", replace(options, reference_sigma=2.0, stop_after="adjustment"))
    assert run.summary["scene"]["sigma_enu_m"][:2] == pytest.approx([2.0, 2.0], rel=0.1)


@pytest.mark.nightly
def test_a_reference_of_another_place_moves_nothing(shown, place, options, tmp_path, capsys):
    alone = adjust(shown.images, tmp_path / "alone", replace(options, reference=()))
    flags = [
        "--matches",
        *options.matches,
        "--matches-only",
        "--dem",
        *options.dem,
        "--reference",
        str(place / "wrong.tif"),
    ]
    with pytest.raises(SystemExit) as stopped:
        main(["adjust", *map(str, shown.images), *flags, "-o", str(tmp_path / "wrong")])
    assert stopped.value.code == 3
    assert "does not show what the images show" in capsys.readouterr().out
    assert not (tmp_path / "wrong/tables/gcps.geojson").exists()
    for view in alone.run.views:
        name = f"{view.name}_RPC.TXT"
        assert (tmp_path / "wrong" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()


@pytest.mark.slow
def test_one_image_is_enough(shown, options, truth, tmp_path):
    run = adjust(shown.images[:1], tmp_path / "run", replace(options, matches=(), matches_only=False))
    points = [p for p in truth["check_points"] if run.run.views[0].name in p["image"]]
    ground = np.array([p["ground"] for p in points])
    image = np.array([p["image"][run.run.views[0].name] for p in points])
    before, after = (
        np.linalg.norm((sensor.project(ground) - image).mean(axis=0))
        for sensor in (run.run.before[0], run.run.after[0])
    )
    assert before > 10.0
    assert after < 3.0  # px of half a metre: 1 m of it the terrain's bias, seen from the side


@pytest.fixture(scope="module")
def quickbird(shared_data, tmp_path_factory):
    """A QuickBird image of 2003 by aerial orthoimages of 2015 at a resolution: the run, and its five surveyed points.

    Their RMS (2,) in the image [px], which took no part.
    """
    folder, optical = shared_data / "cross_sensor" / "ngi_2015", shared_data / "optical" / "qb2_single"
    out = tmp_path_factory.mktemp("quickbird")
    image = optical / "qb2_basic1b.tif"
    points = read_gcps(optical / "gcps.geojson", [image.stem])

    def run(step: float, **options):
        paths = [coarser(path, step, out) for path in sorted(folder.glob("ortho_*.tif"))]
        options.setdefault("dem", str(folder / "dem.tif"))
        given = RunOptions(reference=tuple(map(str, paths)), overwrite=True, **options)
        result = adjust([image], out / "run", given)
        error = read_rpc(out / "run" / f"{image.stem}.vrt").project(points.lonlatalt)[points.point] - points.xy
        return result, np.sqrt((error**2).mean(axis=0))

    return run


def coarser(path, step: float, folder):
    """An orthoimage with the means of its pixels of 5 m."""
    with rasterio.open(path) as file:
        times = round(step / file.res[0])
        if times == 1:
            return path
        shape = file.height // times, file.width // times
        pixels = file.read(1)[: shape[0] * times, : shape[1] * times]
        pixels = pixels.reshape(shape[0], times, shape[1], times).mean(axis=(1, 3)).astype(pixels.dtype)
        a, b, c, d, e, f = file.transform[:6]
        place = rasterio.Affine(times * a, times * b, c, times * d, times * e, f)
        how = {"crs": file.crs, "transform": place, "nodata": file.nodata}
    return write_image(folder / f"{path.stem}_{step:g}.tif", pixels, **how)


@pytest.mark.costs(3)
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::barpc.base.errors.BarpcWarning")
@pytest.mark.parametrize(
    ("step", "most"),
    [
        (10.0, (0.25, 0.15)),
        *(pytest.param(*row, marks=pytest.mark.nightly) for row in ((5.0, (0.16, 0.12)), (20.0, (0.65, 0.25)))),
    ],
)
def test_a_real_image_comes_to_its_place_by_finer_and_coarser_references(quickbird, shared_data, step, most):
    """2.98, 2.09 px as delivered; what a reference of 20 m leaves (0.5 px of 6.5 m) is its noise, and no jitter."""
    result, rms = quickbird(step, geoid=str(shared_data / "dem" / "egm96_15.gtx"))
    assert (rms < most).all()
    assert (rms > 0.02).all()
    assert result.passed
    assert np.hypot(*rms) * 6.5 < 2.0 * np.hypot(*result.summary["scene"]["sigma_enu_m"][:2])


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore::barpc.base.errors.BarpcWarning")
def test_a_geoid_that_was_left_out_is_the_reason(quickbird, shared_data, tmp_path):
    """The terrain names EGM2008, and is right without a word; the same heights in a file that names none are not."""
    named, rms = quickbird(5.0)
    assert (rms < (0.16, 0.12)).all()
    assert named.passed
    with rasterio.open(shared_data / "cross_sensor" / "ngi_2015" / "dem.tif") as file:
        profile, heights = file.profile, file.read(1)
    profile["crs"] = "+proj=tmerc +lat_0=0 +lon_0=25 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +axis=enu"
    write_image(tmp_path / "dem.tif", heights, **profile)
    result, rms = quickbird(5.0, dem=str(tmp_path / "dem.tif"))
    assert np.hypot(*rms) > 0.6
    (why,) = result.summary["reasons"]
    assert "--geoid" in why
    assert "jitter" not in why


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore::barpc.base.errors.BarpcWarning")
@pytest.mark.parametrize("wrong", rest_slow(["mirrored", "of another place", "one height"], mark=pytest.mark.nightly))
def test_heights_of_another_terrain_under_a_reference_are_the_reason(quickbird, shared_data, tmp_path, wrong):
    """The image was placed 12-75 m off by them, at 1.25 m stated, exit code 0 or for jitter."""
    path = tmp_path / "dem.tif"
    with rasterio.open(shared_data / "cross_sensor" / "ngi_2015" / "dem.tif") as file:
        heights, profile = file.read(1), file.profile
    known = heights != profile["nodata"]
    made = {
        "of another place": np.roll(heights, 60, axis=1),
        "mirrored": heights[::-1],
        "one height": np.zeros_like(heights),
    }[wrong]
    write_image(path, np.where(known, made, heights), **profile)
    result, rms = quickbird(10.0, dem=str(path), geoid=str(shared_data / "dem" / "egm96_15.gtx"))
    assert np.hypot(*rms) > 0.5
    assert not result.passed
    (why,) = result.summary["reasons"]
    assert why.startswith("The heights of the DEM under the reference are less accurate than stated")
    assert result.summary["scene"]["sigma_enu_m"][2] > 30.0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::barpc.base.errors.BarpcWarning")
def test_one_image_that_a_reference_does_not_show_is_told_so_and_not_to_loosen_the_matching(quickbird):
    with pytest.raises(TiePointError, match=r"the reference does not show what the images show \(its highest peak"):
        quickbird(60.0)
