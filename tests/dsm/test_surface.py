"""The surface against the ground that was rendered: its heights, its sigma, its file; what is refused."""

from __future__ import annotations

import base64
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio

from barpc.base.errors import BarpcError, InputError, OutputError
from barpc.base.manifest import Layer
from barpc.base.sealed import Sealed
from barpc.base.verb_options import DsmOptions
from barpc.dsm import stereo
from barpc.dsm import surface as surface_module
from barpc.dsm.stereo import CORRECTION, PRIOR_FILE, NoSurfaceError, Tile, _ranked_pairs, block_of_images
from barpc.dsm.surface import _delivered, draped, make_dsm, show_in_report
from barpc.pipeline import load_views
from barpc.report.finished import FinishedRun
from barpc.report.runfiles import run_key
from barpc.rpcio import read_rpc
from barpc.sensor.sentinel1 import RangeDoppler, read_annotation
from barpc.workspace import Workspace, own_files
from tests.cli.test_main import run
from tests.dsm.conftest import ALTS, SMALL, Rendered
from tests.lanes import rest_slow
from tests.scenes import Scene
from tests.scenes.files import _write_image
from tests.sensor.s1_product import Product

OPTIONS = DsmOptions(alt=ALTS)


def nmad(values: np.ndarray) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


@pytest.fixture(scope="module")
def made(rendered, tmp_path_factory):
    out = tmp_path_factory.mktemp("dsm") / "dsm.tif"
    return make_dsm(rendered.paths[:2], out, OPTIONS), out


def test_heights_are_those_of_the_ground_and_sigma_says_how_well(made, rendered):
    surface, out = made
    with rasterio.open(out) as file:
        bands = file.read()
    error = bands[0] - rendered.truth(out)
    known = np.isfinite(error)
    assert surface.known == np.isfinite(bands[0]).sum()
    assert known.mean() > 0.65  # of the rectangle about what both images show
    assert abs(np.median(error[known])) < 0.1
    assert nmad(error[known]) < 0.5  # a pixel of disparity is 2.4 m
    within = np.mean(np.abs(error[known]) < bands[3][known])
    assert 0.60 < within < 0.76
    assert np.isnan(bands[2]).all()  # one pair disagrees with nobody
    assert np.isnan(bands[4]).all()
    assert np.array_equal(bands[1] == 1.0, np.isfinite(bands[0]))


def test_the_file_is_a_cog_in_utm_that_says_what_it_is(made):
    surface, out = made
    with rasterio.open(out) as file:
        assert file.crs.to_epsg() == 32631
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.transform.a == surface.gsd == 1.0
        assert file.transform.c % 1.0 == file.transform.f % 1.0 == 0.0
        assert file.tags()["VERTICAL_REFERENCE"] == "WGS84 ellipsoid"
        assert "SIGMA_SHARED_BY_ALL_CELLS_M" not in file.tags()
        assert file.descriptions[0].startswith("height above the WGS84 ellipsoid")
    assert sorted(path.name for path in out.parent.iterdir()) == ["dsm.tif"]


@pytest.mark.slow
def test_the_same_bytes_whoever_works_and_in_whatever_order_images_are_given(made, rendered, tmp_path):
    with ThreadPoolExecutor(2) as executor:
        make_dsm(rendered.paths[1::-1], tmp_path / "again.tif", OPTIONS, executor=executor)
    assert (tmp_path / "again.tif").read_bytes() == made[1].read_bytes()


@pytest.mark.slow
def test_an_interrupted_command_goes_on_where_it_was(rendered, tmp_path, monkeypatch, sized):
    sized(surface_block=128)
    asked = []
    whole = surface_module.surface_tile

    def surface_tile(pairs, tile, band):
        asked.append(tile)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return whole(pairs, tile, band)

    surface_tile.__module__, surface_tile.__qualname__ = whole.__module__, whole.__qualname__
    monkeypatch.setattr(surface_module, "surface_tile", surface_tile)
    options = replace(OPTIONS, gsd=1.5)
    with pytest.raises(KeyboardInterrupt):
        make_dsm(rendered.paths[:2], tmp_path / "dsm.tif", options)
    assert not (tmp_path / "dsm.tif").exists()
    make_dsm(rendered.paths[:2], tmp_path / "dsm.tif", options)
    assert len({(t.west, t.north) for t in asked}) == len(asked) - 1  # the first was not made again
    assert [path.name for path in tmp_path.iterdir()] == ["dsm.tif"]


@pytest.mark.slow
def test_three_views_are_better_than_two_and_say_so(rendered, tmp_path):
    one = make_dsm(rendered.paths[:2], tmp_path / "two.tif", OPTIONS)
    three = make_dsm(rendered.paths, tmp_path / "three.tif", OPTIONS)
    assert len(one.pairs) == 1
    assert len(three.pairs) == 3
    (of_two, _), (of_three, sigma) = (rendered.missed(tmp_path / f"{name}.tif") for name in ("two", "three"))
    known = np.isfinite(of_three)
    assert nmad(of_three[known]) < nmad(of_two[np.isfinite(of_two)])
    assert 0.60 < np.mean(np.abs(of_three[known]) < sigma[known]) < 0.82
    assert three.sigma < one.sigma


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    "scene",
    rest_slow(
        [
            {"snr": 30.0},
            {"sun_azimuth": (150.0, 190.0), "change": 0.3},
            {"snr": 300.0},
            {"relief": 4.0, "buildings": 1.0},
            {"relief": 200.0, "buildings": 0.0},
        ],
        2,
        pytest.mark.nightly,
    ),
    ids=["noisy", "two dates", "clean", "flat", "steep"],
)
def test_sigma_follows_noise_slopes_and_change(scene, tmp_path):
    found = Rendered(Scene(replace(SMALL, views=2, size=(500, 500), **scene)), tmp_path).write()
    make_dsm(found.paths, tmp_path / "dsm.tif", DsmOptions(alt=found.alts))
    error, sigma = found.missed(tmp_path / "dsm.tif")
    known = np.isfinite(error)
    assert 0.60 < np.mean(np.abs(error[known]) < sigma[known]) < 0.76


def test_images_on_the_surface_are_alike_and_beside_it_are_not(made, rendered):
    surface, out = made
    views = load_views(rendered.paths[:2]).views
    with rasterio.open(out) as file:
        height, place = file.read(1), file.transform
        tile = Tile(file.crs.to_wkt(), place.c, place.f, place.a, surface.size, ALTS)
    known = np.isfinite(height)

    def likeness(metres):
        first, second = (draped(view, tile, height + np.float32(metres), 1)[known] for view in views)
        return np.corrcoef(first, second)[0, 1]

    assert likeness(0.0) > 0.9
    assert likeness(10.0) < likeness(0.0) - 0.2
    assert (draped(views[0], tile, height, 1)[~known] == 0).all()


def test_pairs_with_a_flagged_image_come_after_the_others_and_a_line_says_so(rendered, caplog):
    views = load_views(rendered.paths).views
    worth = {(0, 1): 500.0, (0, 2): 900.0, (1, 2): 1.0}
    plain = _ranked_pairs(views, worth)
    assert plain.index((1, 2)) == 2
    flagged = _ranked_pairs(views, worth, flagged=frozenset({0}))
    assert flagged == [(1, 2), *(pair for pair in plain if pair != (1, 2))]
    assert "view_00: the verdict of the run has a reservation" in caplog.text
    caplog.clear()
    assert _ranked_pairs(views, worth, flagged=frozenset(range(3))) == plain  # as all are: there is nothing better
    assert not caplog.text


def test_a_surface_by_the_delivered_cameras_is_by_those_that_came_with_the_images(rendered):

    def of_source(source):
        return SimpleNamespace(summary=SimpleNamespace(views=[SimpleNamespace(rpc_source=source)]), input=str)

    view = load_views(rendered.paths).views[0]
    moved = replace(view, sensor=view.sensor.crop(10.0, 0.0))
    at = np.array([5.0, 5.0])
    for now, path in ((view, rendered.paths[0]), (moved, rendered.paths[0])):
        came = _delivered(now, of_source(SimpleNamespace(path=path)), 0).sensor
        np.testing.assert_array_equal(came.localize(at, 100.0), view.sensor.localize(at, 100.0))
    with pytest.raises(BarpcError, match=f"{view.name}: no file holds its delivered camera"):
        _delivered(view, of_source(None), 0)


@pytest.mark.parametrize(("minus", "shown"), [(None, ["run/dsm.tif"]), ("date", [])])
def test_the_report_of_a_run_shows_its_surface_but_no_change_and_images_have_none(minus, shown, tmp_path, monkeypatch):
    """Without matching: whose surface it is, alone."""
    told = []

    def block(source, alt=None, other=None):
        return SimpleNamespace(views=[], run=None if isinstance(source, list) else source.name)

    def write(out, made, *rest):
        made.write_bytes(b"cells")
        return "surface"

    monkeypatch.setattr(surface_module, "block_of_run", block)
    monkeypatch.setattr(surface_module, "block_of_images", block)
    monkeypatch.setattr(surface_module, "Grid", lambda block, options: SimpleNamespace(tiles=[], write=write))
    monkeypatch.setattr(surface_module, "show_in_report", lambda run, *rest: told.append(f"{run}/dsm.tif"))
    assert make_dsm(tmp_path / "run", tmp_path / "dsm.tif", replace(OPTIONS, minus=minus)) == "surface"
    assert told == shown
    assert make_dsm(["a.tif", "b.tif"], tmp_path / "images.tif", OPTIONS) == "surface"
    assert told == shown
    assert {path.name for path in tmp_path.iterdir()} == {"dsm.tif", "images.tif"}


@pytest.mark.nightly
@pytest.mark.slow
def test_a_run_makes_its_surface_as_one_of_its_own_files(rendered, tmp_path, capsys):
    folder = tmp_path / "run"
    assert run("adjust", *rendered.paths, "-o", folder, "-q") in (0, 3)
    call = "dsm", folder, "-o", folder / "dsm.tif"
    assert run(*call, "-q") == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Which ground do they reconstruct?" in page
    assert 'class="swipe"' in page
    assert {"dsm.tif", "tables/surface.json"} <= own_files(folder)
    assert {path.name for path in folder.iterdir() if "unfinished" in path.name} == set()
    run(*call, "--overwrite")
    assert "cells of 1 m have a height" in capsys.readouterr().out
    (folder / "dsm.tif").write_bytes(b"mine")
    assert run(*call, "--overwrite") == 1
    assert "dsm.tif: not written by a run in this folder" in capsys.readouterr().err
    assert (folder / "dsm.tif").read_bytes() == b"mine"


# --- what is refused --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_other_ground_is_refused_with_exit_code_3_and_leaves_nothing(rendered, tmp_path, capsys):
    other = Scene(replace(SMALL, seed=77))
    path = tmp_path / "other.tif"
    _write_image(path, other.picture(1).numbers, rendered.scene.shots[1].exact_rpc)
    out = tmp_path / "out" / "dsm.tif"
    assert run("dsm", rendered.paths[0], path, "-o", out, "--alt", *ALTS) == 3
    said = capsys.readouterr().err
    assert "no surface: of the pixels that both images show" in said
    assert said.count("\n") == 1
    assert not out.exists()
    assert not any(tmp_path.rglob("*.unfinished"))


def test_too_large_an_angle_and_radar_are_refused_with_exit_code_3(rendered, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stereo, "CONVERGENCE_RANGE", (2.0, 3.0))
    assert run("dsm", *rendered.paths[:2], "-o", tmp_path / "dsm.tif") == 3
    assert "no pair has a convergence angle of 2 to 3 degrees for SGBM (view_00 and view_01" in capsys.readouterr().err
    monkeypatch.undo()
    views = load_views(rendered.paths[:2]).views
    radar = replace(views[0], sensor=RangeDoppler.from_annotation(read_annotation(Product().xml(), name="slc")))
    with pytest.raises(NoSurfaceError, match="view_00: a radar image"):
        stereo.block_of_images([radar, views[1]], None, 1)
    assert not list(tmp_path.iterdir())


def test_an_existing_file_stays_and_an_image_is_never_written(rendered, tmp_path):
    out = tmp_path / "dsm.tif"
    out.write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists already"):
        make_dsm(rendered.paths[:2], out, OPTIONS)
    assert out.read_bytes() == b"mine"
    before = read_rpc(rendered.paths[0])
    with pytest.raises(OutputError, match="one of the images"):
        make_dsm(rendered.paths[:2], rendered.paths[0], replace(OPTIONS, overwrite=True))
    assert read_rpc(rendered.paths[0]) == before


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"crs": "EPSG:4326"}, "projected reference system in metres"),
        ({"crs": "EPSG:99999999"}, "PROJ knows"),
        ({"crs": "EPSG:2154x"}, "PROJ knows"),
        ({"crs": "nonsense"}, "PROJ knows"),
        ({"gsd": 0.2}, "a pixel of 0.5[0-9]* m has one match, so fewer than 20 %"),
        ({"gsd": 600.0}, "a cell of more than 1024 pixels"),
    ],
)
def test_a_map_without_metres_and_cells_with_hardly_a_match_or_too_many_are_refused(given, said, rendered, tmp_path):
    with pytest.raises(InputError, match=said):
        make_dsm(rendered.paths[:2], tmp_path / "missing" / "dsm.tif", replace(OPTIONS, **given))
    assert not list(tmp_path.iterdir())


def test_a_tile_shows_as_many_pixels_whatever_the_cells(rendered):
    block = block_of_images(rendered.paths[:2], None, 1)
    usual, coarse = (surface_module.Grid(block, replace(OPTIONS, gsd=side)) for side in (None, 8.0))
    assert usual.side == 512
    assert coarse.side * coarse.whole.step <= 1.1 * usual.side * usual.whole.step
    whole = coarse.tiles[0][1]
    parts = whole.quarters()
    assert {part.size for part in parts} == {whole.size}
    corners = np.array([[part.west, part.north, part.step] for part in parts])
    west, north, step = corners.T
    assert (west.min(), north.max()) == (whole.west, whole.north)
    assert west.max() + step[0] * whole.size[0] == pytest.approx(whole.west + whole.step * whole.size[0])
    assert north.min() - step[0] * whole.size[1] == pytest.approx(whole.north - whole.step * whole.size[1])


@pytest.mark.slow
def test_coarse_cells_have_the_median_of_their_ground(rendered, tmp_path):
    make_dsm(rendered.paths[:2], tmp_path / "dsm.tif", replace(OPTIONS, gsd=8.0))
    error, _ = rendered.missed(tmp_path / "dsm.tif")
    assert np.isfinite(error).mean() > 0.6
    assert nmad(error[np.isfinite(error)]) < 0.5


@pytest.mark.slow
def test_a_refusal_after_long_work_leaves_nothing_either(rendered, tmp_path, monkeypatch, sized):
    """Not even what a run that is gone on with would need: it is refused each time."""
    sized(kept_after=0.0)
    monkeypatch.setattr(stereo, "MATCHED", 1.1)
    with pytest.raises(NoSurfaceError, match="nothing is written"):
        make_dsm(rendered.paths[:2], tmp_path / "dsm.tif", OPTIONS)
    assert not list(tmp_path.iterdir())


def test_a_cell_is_larger_than_nothing_and_no_larger_than_a_kilometre():
    assert [DsmOptions(gsd=side).gsd for side in (0.25, 1000.0)] == [0.25, 1000.0]
    for side in (0.0, -1.0, 1000.5):
        with pytest.raises(InputError, match="gsd"):
            DsmOptions(gsd=side)


def test_two_runs_or_a_run_and_images_are_not_one_source(tmp_path, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "summary.json").write_text("{}")
    for source in ([folder, folder], [folder, "image.tif"], ["image.tif", folder]):
        assert run("dsm", *source, "-o", tmp_path / "x.tif") == 2
        assert f"{folder} is a finished run: give it alone (--minus OTHER_RUN" in " ".join(
            capsys.readouterr().err.split()
        )
    assert [one.name for one in tmp_path.iterdir()] == ["run"]


# --- a run's own ------------------------------------------------------------------------------------------


def shot(name: str, outputs=(), source="rpc", file=None, advice=""):
    entry = SimpleNamespace(rpc_source=source and SimpleNamespace(format=source), advice=advice)
    place = f"/x/{name}.tif" if file is None else file
    return SimpleNamespace(name=name, entry=entry, file=place, size=(9, 8), rpc=f"rpc {name}", written=outputs,
                           writer=SimpleNamespace(sealed=SimpleNamespace(file=Path)),
                           light=SimpleNamespace(time=f"2020-01-0{'abcd'.index(name) + 1}T10:00:00Z"))  # fmt: skip


@pytest.fixture
def run_of_shots(monkeypatch, tmp_path):
    """The block of a run of these images, of which tie points join some pairs; what is asked of pairs."""
    asked = []

    def best(views, worth, flagged, part):
        asked.append((worth, flagged, part))
        return part

    def made(shots, pairs=(), minus=None, there=()):
        pairs = [SimpleNamespace(a=a, b=b, num_matches=num) for a, b, num in pairs]
        opened = SimpleNamespace(table=tmp_path.joinpath)
        scene = SimpleNamespace(shots=shots, alt_range=(5.0, 9.0), pairs=pairs, run=opened)
        earlier = SimpleNamespace(views=[SimpleNamespace(name=name) for name in there])
        before = SimpleNamespace(summary=earlier)
        monkeypatch.setattr(stereo, "read_scene", lambda folder, alts: scene)
        monkeypatch.setattr(stereo.FinishedRun, "open", lambda folder: SimpleNamespace(lineage=(before,)))
        return stereo.block_of_run(tmp_path, None, minus)

    monkeypatch.setattr(stereo, "open_camera", lambda path: SimpleNamespace(model=path.name))
    monkeypatch.setattr(stereo, "_ranked_pairs", best)
    monkeypatch.setattr(stereo.BlockPrior, "load", lambda path: path.name)
    monkeypatch.setattr(stereo.CameraErrors, "of", lambda prior, views: (prior, len(views)))
    return made, asked


def test_a_run_s_images_have_its_cameras_and_its_pairs_their_tie_points(run_of_shots, tmp_path):
    made, asked = run_of_shots
    shots = [shot("a", advice="look"), shot("b", outputs={"b" + CORRECTION: {}}), shot("c", source=None)]
    block = made(shots, [("c", "a", 70), ("b", "a", 30)])
    assert [(v.name, v.path, v.size, v.sensor, v.alt_range, v.date) for v in block.views] == [
        ("a", "/x/a.tif", (9, 8), "rpc a", (5.0, 9.0), "2020-01-01"),
        ("b", "/x/b.tif", (9, 8), "b" + CORRECTION, (5.0, 9.0), "2020-01-02"),
        ("c", "/x/c.tif", (9, 8), "rpc c", (5.0, 9.0), "2020-01-03"),
    ]
    assert asked == [({(0, 1): 30.0, (0, 2): 70.0, (1, 2): 0.0}, frozenset({0}), [0, 1, 2])]
    assert (block.groups, block.source, block.errors) == ([[0, 1, 2]], "a, b, c", (PRIOR_FILE, 3))


def test_of_two_dates_the_images_that_the_earlier_run_has_are_taken_away(run_of_shots, tmp_path):
    made, asked = run_of_shots
    shots = [shot(name) for name in "abcd"]
    block = made(shots, minus="first", there=("d", "b", "z"))
    assert block.groups == [[0, 2], [1, 3]]
    assert [part for *_, part in asked] == block.groups
    assert block.source == "a, c minus b, d"
    for there, num in (("a", 1), ("abd", 3), ("abcd", 4)):
        with pytest.raises(InputError, match=f"first: has {num} of the 4 images of .* at least two images of each"):
            made(shots, minus="first", there=there)


@pytest.mark.parametrize(
    ("given", "error", "said"),
    [
        ({"source": "sicd"}, NoSurfaceError, "a: a radar image"),
        ({"file": "https://a.b/a.tif"}, InputError, "is on another host"),
        ({"file": ""}, InputError, "a has no pixels"),
    ],
)
def test_images_that_are_not_matched_are_refused_by_name(given, error, said, run_of_shots):
    with pytest.raises(error, match=said):
        run_of_shots[0]([shot("a", **given), shot("b")])


def test_the_report_shows_the_part_of_a_tile_with_most_heights_by_both_kinds_of_cameras(tmp_path, monkeypatch, caplog):
    views = [SimpleNamespace(name=name) for name in "abc"]
    run = SimpleNamespace(views=[SimpleNamespace(rpc_source=f"came with {name}") for name in "abc"], outputs=())
    bands = np.full((5, 4, 12), np.nan, np.float32)
    bands[0, 1:, 8:], bands[2, 1:, 8:] = 7.0, [0.25, 0.5, 0.5, 1.0]
    place = {"crs": "EPSG:32631", "transform": rasterio.Affine(2, 0, 0, 0, -2, 0)}
    with rasterio.open(tmp_path / "dsm.tif", "w", "GTiff", 12, 4, 5, dtype="float32", **place) as file:
        file.write(bands)
    cells = [Tile("", west, 0.0, 2.0, size, (0.0, 9.0)) for west, size in ((0.0, (4, 4)), (8.0, (8, 4)))]
    tiles = [((0, 0), cells[0], [[(0, 1)]]), ((4, 0), cells[1], [[(2, 0), (2, 1)], [(0, 1)]])]
    remade, before = [], np.full((4, 4), 3.0, np.float32)

    def surface(pairs, tile, band):
        assert pairs == [("c/came with c", "a/came with a"), ("c/came with c", "b/came with b")]
        assert (tile, band) == (replace(cells[1], west=16.0, size=(4, 4)), 3)
        return before, np.full((4, 4), np.nan, np.float32), None

    monkeypatch.setattr(surface_module, "_RELIEF_SIDE", 4)
    monkeypatch.setattr(surface_module, "surface_tile", surface)
    monkeypatch.setattr(
        surface_module, "_delivered", lambda view, run, number: f"{view.name}/{run.summary.views[number].rpc_source}"
    )
    monkeypatch.setattr(surface_module, "draped", lambda view, tile, height, band: np.full((4, 4), 9, np.uint8))
    monkeypatch.setattr(surface_module, "remake_report", remade.append)
    monkeypatch.setattr(surface_module, "can_render", lambda: True)
    folder = tmp_path / "run"
    with Workspace(folder):
        pass
    sealed = Sealed(folder, "", [Layer("")], {}, folder, {})
    given = (FinishedRun(sealed, run), SimpleNamespace(views=views), tiles, tmp_path / "dsm.tif", 3)
    show_in_report(*given)
    told = json.loads((folder / "tables/surface.json").read_text())
    assert told["run"] == run_key(run)
    one, two, *images = told["shown"]
    assert (one["cameras"], one["share"], one["nmad_m"], one["size"]) == ("delivered", 1.0, None, [4, 4])
    assert (two["cameras"], two["share"], two["nmad_m"]) == ("corrected", 0.75, 0.5)
    assert [image["image"] for image in images] == ["c", "a"]
    for row in told["shown"]:
        assert base64.b64decode(row["picture"]).startswith(b"\xff\xd8\xff")  # a JPEG
        assert row["size"] == [4, 4]
    assert remade == [folder]
    monkeypatch.setattr(surface_module, "can_render", lambda: False)
    show_in_report(*given)
    assert remade == [folder]
    monkeypatch.setattr(surface_module, "_delivered", _delivered)
    run.views[2].rpc_source = None
    show_in_report(*given)
    assert "the report does not show the surface: c: no file holds its delivered camera" in caplog.text
