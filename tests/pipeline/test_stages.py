"""What joins the stages of a run: which files are named, what is kept of a block, where heights come from."""

from __future__ import annotations

import sys
import warnings
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rasterio import Affine

from barpc.base.errors import BarpcWarning, FitError, ImageError, InputError
from barpc.base.options import AdjustOptions, RunOptions
from barpc.base.tasks import HERE, Work
from barpc.fit import FitOptions, fit_rpc
from barpc.pipeline import adjusting
from barpc.pipeline import run as stages
from barpc.pipeline.control import load_altimetry
from barpc.pipeline.earlier import of_new
from barpc.pipeline.inputs import (
    IMAGES,
    PRIOR_FILE,
    given_matches,
    given_tracks,
    input_files,
    read_pairs,
    side_inputs,
    with_located,
)
from barpc.pipeline.outputs import output_names
from barpc.report import Run
from barpc.scene import Tracks, View
from barpc.tie.reference import Accuracy
from tests.rasters.test_dem import write_dem, write_geoid
from tests.rpcio.conftest import make_rpc

NONE = Tracks(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)), np.empty(0))


def views(count: int = 3) -> tuple[View, ...]:
    return tuple(View(f"v{n}", f"/x/v{n}.tif", (100, 80), make_rpc(), (0.0, 300.0)) for n in range(count))


# --- inputs -----------------------------------------------------------------------------------------------


def test_every_file_that_options_name_is_an_input() -> None:
    given = RunOptions(
        add_to="earlier", matches=("a.csv", "b.npz"), gcp=("g.csv",), check_points=("c.csv", "d.csv"),
        dem=("dem.tif", "e.tif"), geoid="geoid.gtx", reference=("r.tif",), overlap_list="pairs.txt", aoi="area.json",
    )  # fmt: skip
    names = [
        "a.csv",
        "b.npz",
        "g.csv",
        "c.csv",
        "d.csv",
        "dem.tif",
        "e.tif",
        "geoid.gtx",
        "r.tif",
        "pairs.txt",
        "area.json",
    ]
    found = input_files(given)
    assert found[:2] == [Path("earlier/tables") / name for name in (PRIOR_FILE, IMAGES)]
    assert sorted(map(str, found[2:])) == sorted(names)
    assert input_files(RunOptions()) == []


def test_files_of_this_machine_stay_as_they_are_named() -> None:
    given = RunOptions(dem="dem.tif", geoid="geoid.gtx", reference=("r.tif",))
    assert with_located(given) == given
    assert with_located(RunOptions()) == RunOptions()


def test_a_terrain_covers_a_part_of_the_images_at_least(tmp_path) -> None:
    """Of three images one is beyond it: that is borne; all beyond it are not."""
    far = replace(make_rpc(), ground_offset=np.array([15.4, 43.2, 166.0]))
    where = Affine(0.001, 0, 5.3, 0, -0.001, 43.3)
    dem = write_dem(tmp_path / "d.tif", "EPSG:4979", np.full((200, 200), 200.0, np.float32), transform=where)
    options = RunOptions(dem=str(dem))
    here = views(1)[0]
    there = View("far", "/x/far.tif", (100, 80), far, (0.0, 300.0))
    assert side_inputs(options, [there, here]) is not None
    with pytest.raises(InputError, match=r"has no height at the images' position \(15\.\d+, 43\.\d+\)"):
        side_inputs(options, [there])
    assert side_inputs(RunOptions(), [there]) is None


def test_a_terrain_counts_from_what_the_options_say_and_every_reference_is_looked_at(tmp_path) -> None:
    """One that is none stops the run before any work."""
    where = Affine(0.001, 0, 5.3, 0, -0.001, 43.3)
    dem = str(write_dem(tmp_path / "d.tif", "EPSG:4326", np.full((200, 200), 200.0, np.float32), transform=where))
    geoid = str(write_geoid(tmp_path / "g.gtx", 40.0))
    above_it, above_none = RunOptions(dem=dem, geoid=geoid), RunOptions(dem=dem, heights="ellipsoidal")
    for options, height in ((above_it, 240.0), (above_none, 200.0)):
        found = side_inputs(options, views(1))
        assert found is not None
        assert found(5.4, 43.2) == pytest.approx(height)
    (tmp_path / "r.tif").write_bytes(b"no image")
    with pytest.raises(ImageError, match=r"r\.tif"):
        side_inputs(replace(above_none, reference=(dem, str(tmp_path / "r.tif"))), views(1))


def test_heights_count_within_the_images_and_some_way_around_them(tmp_path) -> None:
    """An image that shows no ground has none; files follow each other; none in the images are another place."""
    here, blind = views(1)[0], View("b", "/x/b.tif", (100, 80), make_rpc().crop(1e12, 0.0), (0.0, 300.0))
    lon, lat, _ = here.sensor.localize(np.array([50.0, 40.0]), np.array(150.0))
    near, far, turned = (tmp_path / name for name in ("near.csv", "far.csv", "turned.csv"))
    near.write_text(f"lon,lat,alt\n{lon + 360},{lat},120\n{lon},{lat + 0.5},121\n{lon},{lat},122\n")
    far.write_text(f"lon,lat,alt\n{lon},{lat + 0.5},120\n")
    turned.write_text(f"lon,lat,alt\n{lat},{lon},120\n")
    found = load_altimetry([str(near), str(near)], (blind, here))
    assert found is not None
    assert found.lonlatalt[:, 2].tolist() == [120.0, 122.0] * 2
    assert load_altimetry([], (here,)) is None
    for path, view, what in ((far, here, "another place"), (turned, here, "exchanged"), (near, blind, "3 heights")):
        with pytest.raises(InputError, match=what):
            load_altimetry([str(path)], (view,))


# --- given matches ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("read", [given_matches, given_tracks])
@pytest.mark.parametrize(
    ("col", "row", "inside"),
    [
        (-1.5, 5.0, True), (-1.6, 5.0, False), (5.0, -1.5, True), (5.0, -1.6, False),
        (100.5, 5.0, True), (100.6, 5.0, False), (5.0, 80.5, True), (5.0, 80.6, False),
        (90.0, 79.0, True), (79.0, 90.0, False),
    ],
)  # fmt: skip
def test_points_lie_within_a_pixel_and_a_half_of_their_images(tmp_path, read, col, row, inside) -> None:
    path = tmp_path / "m.csv"
    path.write_text(f"image,col,row,track\nv0,{col},{row},0\nv1,9,9,0\nv0,1,2,1\nv1,3,4,1\n")
    if inside:
        assert read([path], views(2))
        return
    said = rf"m\.csv: 1 of 4 points lie outside their images, as \({col:g}, {row:g}\) in v0, 100 x 80 pixels"
    with pytest.raises(InputError, match=said):
        read([path], views(2))


def test_matches_of_a_pair_are_the_same_whatever_the_order_of_the_file(tmp_path) -> None:
    rows = [f"v{i},{n + 10 * i},{(7 * n + i) % 50},{n}" for n in range(12) for i in (0, 1, 2)]
    found = []
    for order in (rows, rows[::-1], rows[5:] + rows[:5]):
        (tmp_path / "m.csv").write_text("\n".join(["image,col,row,track", *order]) + "\n")
        matches = given_matches([tmp_path / "m.csv"], views())
        assert set(matches) <= {(0, 1), (1, 2), (0, 2)}
        found.append({pair: one.xy.tolist() for pair, one in matches.items()})
        for (i, j), one in matches.items():
            np.testing.assert_array_equal(one.xy[:, 1, 0] - one.xy[:, 0, 0], np.full(len(one.xy), 10.0 * (j - i)))
            assert (one.score == 0).all()
    assert found[0] == found[1] == found[2]


def test_a_match_is_told_from_the_earlier_image_of_its_pair_in_the_order_of_its_places(tmp_path) -> None:
    """Ordered by column, then row in the earlier image, then by those in the later one."""
    places = {"v2": [(9, 1), (3, 7), (3, 2), (3, 2)], "v0": [(4, 4), (5, 5), (6, 6), (1, 8)]}
    rows = [f"{name},{col},{row},{t}\n" for name, seen in places.items() for t, (col, row) in enumerate(seen)]
    (tmp_path / "m.csv").write_text("image,col,row,track\n" + "".join(rows))
    ((pair, found),) = given_matches([tmp_path / "m.csv"], views()).items()
    assert pair == (0, 2)
    wanted = sorted(
        [[list(map(float, a)), list(map(float, b))] for a, b in zip(places["v0"], places["v2"], strict=True)]
    )
    assert found.xy.tolist() == wanted
    assert found.score.tolist() == [0.0] * 4
    assert (found.index < 0).all()  # numbers of keypoints begin at 0: these are of files
    assert len(set(found.index[:, 0].tolist())) == 4


def test_matches_of_an_image_with_itself_are_none_of_a_pair(tmp_path) -> None:
    rows = "v0,1,1,0\nv1,2,2,0\nv1,50,50,1\nv1,60,60,1\n"
    (tmp_path / "m.csv").write_text("image,col,row,track\n" + rows)
    assert given_matches([tmp_path / "m.csv"], views()).keys() <= {(0, 1)}


def test_of_files_with_nothing_for_a_part_of_the_images_that_is_said(tmp_path, caplog) -> None:
    (tmp_path / "m.csv").write_text("image,col,row,track\nother,1,1,0\nmore,2,2,0\n")
    with pytest.raises(InputError, match="no track is seen in two"):
        given_matches([tmp_path / "m.csv"], views())
    assert given_matches([tmp_path / "m.csv"], views(), partly=True) == {}
    assert "no track is seen in two" in caplog.text
    (tmp_path / "out.csv").write_text("image,col,row,track\nv0,1000,1,0\nv1,2,2,0\n")
    with pytest.raises(InputError, match="1 of 2 points lie outside"):
        given_matches([tmp_path / "out.csv"], views(), partly=True)


def test_paths_of_a_list_start_where_it_lies_or_from_here(tmp_path, monkeypatch) -> None:
    """Images of one stem in several folders: only their paths tell them apart."""
    folders = [tmp_path / name for name in ("list", "here", "far")]
    for folder in folders:
        folder.mkdir()
    given = [replace(view, path=str(folder / "i.tif")) for view, folder in zip(views(), folders, strict=True)]
    path = folders[0] / "p.txt"
    path.write_text(f"i.tif ../here/i.tif\nhere/i.tif {folders[2]}/i.tif\n")
    monkeypatch.chdir(tmp_path)
    assert read_pairs(path, given) == [(0, 1), (1, 2)]
    assert read_pairs(path, given[:2], [folders[2] / "i.tif"]) == [(0, 1)]
    with pytest.raises(InputError, match=r"p\.txt: lists no pair of the images given"):
        read_pairs(path, given[:1], [folder / "i.tif" for folder in folders[1:]])


# --- what an earlier block knew ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_of_each_track_with_something_new_all_observations_are_kept(seed) -> None:
    """Against the rule, track by track."""
    rng = np.random.default_rng(seed)
    seen = [(t, v) for t in range(30) for v in range(5) if rng.random() < 0.6]
    point = np.unique([t for t, _ in seen], return_inverse=True)[1]
    xy = np.column_stack([np.arange(len(seen)), np.zeros(len(seen))])
    given = Tracks(np.array([v for _, v in seen]), point, xy.astype(float), np.ones(len(seen)))
    old, wanted = np.array([True, False, True, True, False]), list[int]()
    for t in range(given.num_points):
        rows = np.flatnonzero(given.point == t)
        if (~old[given.view[rows]]).any() and len(rows) > 1:  # one alone is no tie
            wanted += rows.tolist()
    assert of_new(given, old).xy[:, 0].tolist() == wanted


# --- outputs ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drawn", [True, False])
def test_the_page_is_named_where_it_can_be_drawn(tmp_path, monkeypatch, drawn) -> None:
    if not drawn:
        monkeypatch.setitem(sys.modules, "jinja2", None)
    names = output_names(views(), RunOptions(), tmp_path)
    assert ("report.html" in names) is drawn
    assert ("tables/gcps.geojson" in output_names(views(), RunOptions(dem="d", reference=("r",)), tmp_path)) is True
    assert "tables/gcps.geojson" not in names
    assert names[-1] == f"tables/{PRIOR_FILE}"


# --- the run itself ---------------------------------------------------------------------------------------


def test_a_run_without_some_of_its_views_keeps_what_belongs_to_the_others() -> None:
    sources = tuple(SimpleNamespace(path=Path(f"{n}.RPB")) for n in range(3))
    run = Run("adjust", views(), sources, NONE, left_out=(("/x/bad.tif", "bad"),))  # type: ignore[arg-type]
    kept = adjusting._only(run, frozenset(["v0", "v2"]), {})
    assert [view.name for view in kept.views] == ["v0", "v2"]
    assert kept.sources == (sources[0], sources[2])
    assert kept.left_out == (
        ("/x/bad.tif", "bad"),
        ("/x/v1.tif", "it shares no tie points with the largest group of images"),
    )
    assert (kept.adjustment, kept.reference) == (None, None)
    known = adjusting._only(run, frozenset(["v0", "v2"]), {"v1": "shows the picture mirrored"})
    assert known.left_out[1] == ("/x/v1.tif", "shows the picture mirrored")


@pytest.mark.parametrize(
    ("stated", "known", "used"), [(None, True, 5.0), (None, False, 20.0), (3.0, True, 3.0), (0.5, False, 0.5)]
)
def test_heights_of_a_reference_are_as_sure_as_what_they_count_from(monkeypatch, stated, known, used) -> None:
    seen = {}
    monkeypatch.setattr(adjusting, "register_views", lambda *given: seen.update(accuracy=given[4]))
    options = RunOptions(
        dem="d.tif", reference=("r.tif",), reference_sigma=7.0,
        adjust=AdjustOptions(dem_bias_sigma=stated, dem_sigma=4.0),
    )  # fmt: skip
    adjusting._register_to_reference(
        SimpleNamespace(views=views(), options=options), SimpleNamespace(known=known), HERE
    )  # type: ignore[arg-type]
    assert seen["accuracy"] == Accuracy(7.0, 4.0, used)


def test_cameras_are_fitted_each_and_what_fails_says_why() -> None:
    rpc = make_rpc()
    cameras = [(rpc, (2000, 1900), (30.0, 300.0)), (rpc.crop(5, 6), (900, 800), (0.0, 200.0))]
    options = FitOptions(grid=(6, 6, 4))
    good = stages.fit_group(cameras, options, True)
    assert [error for _, error, _ in good] == ["", ""]
    for (fit, _, _), (model, size, alts) in zip(good, cameras, strict=True):
        assert fit is not None
        assert fit.rpc == fit_rpc(model, size, alts, options=options).rpc
    hard = replace(options, tolerance=1e-15)
    (fit, error, _), _ = stages.fit_group(cameras, hard, True)
    assert fit is None
    assert "1e-15" in error
    (fit, error, warned), _ = stages.fit_group(cameras, hard, False)
    assert fit is not None
    assert (error, warned) == ("", ())


def test_what_a_fit_warns_of_comes_back_from_its_worker_and_is_said_with_the_view(monkeypatch) -> None:
    rpc, real = make_rpc(), stages.fit_rpc

    def odd(*given, **how):
        warnings.warn("odd", BarpcWarning, stacklevel=1)
        return real(*given, **how)

    monkeypatch.setattr(stages, "fit_rpc", odd)
    block = SimpleNamespace(gauge=SimpleNamespace(sigma=np.array([3.0, 4.0, 99.0])), sensors=[rpc])
    run = replace(Run("adjust", views(1), (), NONE), adjustment=block)  # type: ignore[arg-type]
    with pytest.warns(BarpcWarning, match="^v0: odd$"):
        found = stages._with_refits(run, RunOptions(fit=FitOptions(grid=(5, 5, 4))), HERE)
    assert found.fits[0].rpc.err_bias == pytest.approx(np.sqrt(12.5))  # of the place, east and north


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sigma", "stated"),
    [
        ((3.0, 4.0, 99.0), np.sqrt(12.5)),
        ((np.nan, 1.0, 1.0), None),
        pytest.param((0.0, 0.0, 1.0), None, marks=pytest.mark.slow),
    ],
)
def test_a_new_rpc_states_the_error_of_the_scene_and_the_noise_of_the_old_one(sigma, stated) -> None:
    rpc = make_rpc()
    given = tuple(View(f"v{n}", f"/x/v{n}.tif", (900, 800), rpc, (0.0, 300.0)) for n in range(9))
    block = SimpleNamespace(gauge=SimpleNamespace(sigma=np.array(sigma)), sensors=[rpc] * 9)
    told: list[tuple[str, int, int]] = []
    run = replace(Run("adjust", given, (), NONE), adjustment=block)  # type: ignore[arg-type]
    found = stages._with_refits(
        run, RunOptions(fit=FitOptions(grid=(5, 5, 4))), Work(None, lambda *now: told.append(now))
    )
    assert len(found.fits) == 9
    for fit in found.fits:
        assert fit.rpc.err_bias == (None if stated is None else pytest.approx(stated))
        assert fit.rpc.err_rand == 0.7
    assert told[-2:] == [("fit", 8, 9), ("fit", 9, 9)]
    with pytest.raises(FitError, match="v0: "):
        stages._with_refits(run, RunOptions(fit=FitOptions(grid=(5, 5, 4), tolerance=1e-15)), HERE)


def test_a_check_has_the_images_as_they_were_given_and_adjusts_nothing(corner) -> None:
    given, told = [corner.images[k] for k in (2, 0, 1)], set()
    result = stages.check([*given, "no.tif"], RunOptions(keep_going=True), progress=lambda *now: told.add(now[0]))
    assert [Path(view.path) for view in result.views] == given
    assert len(result.tracks) > 0
    assert result.run.adjustment is None
    assert [Path(one.path).name for one in result.record.left_out] == ["no.tif"]
    assert not result.passed
    assert {"cameras", "detect", "match"} <= told


def test_a_check_of_one_image_has_no_tie_points_to_cut(corner) -> None:
    result = stages.check(corner.images[:1], RunOptions(gcp=(str(corner.gcps),)))
    assert (len(result.views), len(result.tracks), result.run.agreeing) == (1, 0, None)


def test_a_result_prints_its_folder_if_it_has_one_and_of_a_long_name_the_end() -> None:
    run, tracks = Run("check", views(), (), NONE), SimpleNamespace(num_tracks=0, num_observations=0)
    record: Any = SimpleNamespace(kind="check", status="good", views=run.views, tracks=tracks, out_dir=None)
    result = stages.AdjustResult((), run, record)
    assert repr(result) == "AdjustResult(check: 3 views, 0 tie points, 0 observations, good)"
    for length, shown in ((50, "/" * 50), (51, "..." + "/" * 47)):
        record.out_dir = "/" * length
        assert repr(stages.AdjustResult((), run, record)).endswith(f", in {shown})")


@pytest.mark.slow
def test_a_stage_that_is_one_task_says_its_beginning_and_its_end(corner, tmp_path) -> None:
    """Also where it ends in an error its beginning; nobody need listen."""
    told: list[tuple[str, int, int]] = []
    options = RunOptions(stop_after="adjustment")
    result = stages.adjust(corner.images[:2], tmp_path / "out", options, progress=lambda *now: told.append(now))
    single = ("block", "summary", "report")
    assert [now for now in told if now[0] in single] == [(name, done, 1) for name in single for done in (0, 1)]
    passes = [now for now in told if now[0] == "adjustment"]
    assert passes == [
        *(("adjustment", n, 0) for n in range(len(passes) - 1)),
        ("adjustment", len(passes) - 2, len(passes) - 2),
    ]
    took = [stage["stage"] for stage in result.summary["stages"]]
    assert took[-7:] == ["tie points", "adjustment", "block", "summary", "pictures", "tables", "report"]
    told.clear()
    stages._report_progress(None, "x", 0)
    space = SimpleNamespace(stage=nullcontext)
    with pytest.raises(KeyError), stages._stage_progress(space, "x", lambda *now: told.append(now)):  # type: ignore[arg-type]
        raise KeyError
    assert told == [("x", 0, 1)]
