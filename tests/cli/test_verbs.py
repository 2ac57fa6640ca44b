"""The verbs on cameras and points, as hands type them."""

from __future__ import annotations

import io
import json
import logging
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barpc.base.verb_options import DsmOptions
from barpc.cli.terminal import Lines, progress_told
from barpc.dsm import stereo, surface
from barpc.rasters.raster import open_raster
from barpc.rpcio import read_rpc, write_rpc, write_rpc_copy
from barpc.sensor.geometry import base_to_height
from barpc.sensor.triangulation import triangulate
from tests.cli.test_main import run
from tests.rpcio.conftest import dimap_v2, make_rpc, write_image

POINT = ["5.4005", "43.1995", "200"]


@pytest.fixture
def image(tmp_path: Path) -> Path:
    raw = write_image(tmp_path / "raw.tif", shape=(1, 400, 600))
    write_rpc_copy(make_rpc().crop(900, 900), raw, tmp_path / "in" / "scene.tif")
    return tmp_path / "in" / "scene.tif"


@pytest.fixture
def other(tmp_path: Path) -> Path:
    raw = write_image(tmp_path / "raw2.tif", shape=(1, 400, 600))
    rpc = make_rpc().crop(880, 910)
    tilted = np.array(rpc.coeffs)
    tilted[0, 3] += 0.09
    write_rpc_copy(type(rpc)(tilted, rpc.ground_offset, rpc.ground_scale, rpc.image_offset, rpc.image_scale),
                   raw, tmp_path / "in" / "other.tif")  # fmt: skip
    return tmp_path / "in" / "other.tif"


def test_project_and_localize_are_each_other_s_inverse(image, capsys):
    assert run("project", image, *POINT) == 0
    header, line = capsys.readouterr().out.splitlines()
    assert header == "col,row"
    expected = read_rpc(image).project([float(v) for v in POINT])
    np.testing.assert_allclose([float(v) for v in line.split(",")], expected, atol=1e-6)
    assert run("localize", image, *line.split(","), "--alt", "200", "--json") == 0
    (point,) = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose([point["lon"], point["lat"], point["alt"]], [float(v) for v in POINT], atol=1e-8)


def test_negative_numbers_are_numbers(image, capsys):
    assert run("project", image, "5.4", "43.2", "-3.5") == 0
    assert run("localize", image, "-10", "-20.5", "--alt", "-3") == 0
    assert "nan" not in capsys.readouterr().out


@pytest.mark.parametrize(
    "text",
    [
        "lon,lat,alt\n5.4005,43.1995,200\n5.4015,43.1985,100\n",
        "# comment\n5.4005 43.1995 200\n\n5.4015 43.1985 100\n",
        "alt, name, lat, lon\n200,a,43.1995,5.4005\n100,b,43.1985,5.4015\n",
    ],
)
def test_points_come_from_a_file_or_standard_input(text, image, tmp_path, capsys, monkeypatch):
    (tmp_path / "points.csv").write_text(text)
    assert run("project", image, "--points", tmp_path / "points.csv") == 0
    from_file = capsys.readouterr().out
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    assert run("project", image, "--points", "-") == 0
    assert capsys.readouterr().out == from_file
    assert len(from_file.splitlines()) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lon,lat\n5,43\n", ""),
        ("x,y,z\n1,2,3\n", "columns lon, lat, alt expected"),
        ("5,43,abc\n", "is no number"),
    ],
)
def test_a_table_that_does_not_fit_is_an_error_that_names_it(text, message, image, tmp_path, capsys):
    (tmp_path / "points.csv").write_text(text)
    assert run("project", image, "--points", tmp_path / "points.csv") == 1
    error = capsys.readouterr().err
    assert "points.csv" in error
    assert message in error


def test_a_point_that_fails_is_nan_counted_and_null_in_json(image, capsys):
    assert run("localize", image, "1e12", "0") == 3
    captured = capsys.readouterr()
    assert captured.out.splitlines()[1].startswith("nan,nan")
    assert "1 of 1 points" in captured.err
    assert run("localize", image, "1e12", "0", "--json") == 3
    assert json.loads(capsys.readouterr().out)[0]["lon"] is None


@pytest.mark.parametrize("args", [["5", "43"], ["5"], [], ["5", "43", "1", "2"]])
def test_a_wrong_number_of_numbers_is_a_usage_error(args, image, capsys):
    assert run("project", image, *args) == 2
    assert "LON LAT ALT" in capsys.readouterr().err


def test_triangulate_finds_the_point_that_two_images_see(image, other, capsys):
    rpcs = [read_rpc(image), read_rpc(other)]
    ground = rpcs[0].localize([300.0, 200.0], 150.0)
    seen = [rpc.project(ground) for rpc in rpcs]
    args = [a for xy in seen for a in ("--at", *xy)]
    assert run("triangulate", image, other, *args, "--json") == 0
    (point,) = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose([point["lon"], point["lat"], point["alt"]], ground, atol=1e-4)
    assert point["error"] == pytest.approx(0.0, abs=1e-4)
    noisy = triangulate(rpcs, [0, 1], [0, 0], np.array(seen) + [[0, 0], [0, 2.1]])
    args = [a for xy in np.array(seen) + [[0, 0], [0, 2.1]] for a in ("--at", *xy)]
    assert run("triangulate", image, other, *args, "--json") == 3  # more than a pixel apart
    expected = np.sqrt((noisy.residuals**2).sum(axis=1).mean())
    assert json.loads(capsys.readouterr().out)[0]["error"] == pytest.approx(expected, abs=1e-3)


def test_triangulate_from_a_table_skips_what_an_image_does_not_see(image, other, tmp_path, capsys):
    rows = "col1,row1,col2,row2\n300,200,320,190\n300,200,nan,nan\n"
    (tmp_path / "ties.csv").write_text(rows)
    assert run("triangulate", image, other, "--points", tmp_path / "ties.csv") == 3
    captured = capsys.readouterr()
    assert [("nan" in line) for line in captured.out.splitlines()[1:]] == [False, True]
    assert "1 of 2 points could not be intersected" in captured.err
    assert run("triangulate", image, "--at", 1, 2) == 2


def test_info_tells_the_angle_between_several_images(image, other, capsys):
    assert run("info", image, other, "--json") == 0
    first, second = json.loads(capsys.readouterr().out)
    (pair,) = first["pairs"]
    assert pair["with"] == "other"
    assert second["pairs"] == []
    place = np.array([*first["center_deg"], np.mean(first["altitude_range_m"])])
    assert pair["b_over_h"] == pytest.approx(float(base_to_height(read_rpc(image), read_rpc(other), place)))
    assert 1 < pair["convergence_deg"] < 60
    assert run("info", image, other) == 0
    text = f"pair         with other: {pair['convergence_deg']:.2f} deg between the rays, B/H {pair['b_over_h']:.3f}\n"
    assert capsys.readouterr().out.count(text) == 1
    assert run("info", image, "--at", 5.5, 43.3, 100, "--json") == 0
    (elsewhere,) = json.loads(capsys.readouterr().out)
    assert elsewhere["incidence_deg"] != first["incidence_deg"]
    assert run("info") == 2


def test_footprint_is_geojson_with_a_polygon_an_image(image, other, capsys):
    assert run("info", "--footprint", image, other) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["type"] == "FeatureCollection"
    assert [f["properties"]["name"] for f in document["features"]] == ["scene", "other"]
    assert run("info", "--footprint", image, "--alt", 50) == 0
    higher = json.loads(capsys.readouterr().out)["features"][0]
    assert higher["properties"]["alt"] == 50.0
    assert higher["geometry"] != document["features"][0]["geometry"]


def test_an_rpc_file_has_no_size_and_asks_for_it(tmp_path, capsys):
    write_rpc(make_rpc(), tmp_path / "a.RPB")
    assert run("info", "--footprint", tmp_path / "a.RPB") == 1
    assert "size=" in capsys.readouterr().err
    assert run("info", "--footprint", f"{tmp_path / 'a.RPB'},size=2000:1900") == 0


class Terminal(io.StringIO):
    """What stderr is when somebody looks."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("quiet", [False, True])
def test_progress_is_drawn_for_a_terminal_only(quiet, monkeypatch):
    monkeypatch.setattr("sys.stderr", Terminal() if not quiet else io.StringIO())
    with progress_told(False, 0) as progress:
        for stage, total in (("detect", 3), ("match", 2), ("detect", 3)):  # a second pass begins again
            for done in range(1, total + 1):
                progress(stage, done, total)
    drawn = sys.stderr.getvalue()
    assert [f"{stage:<22}" in drawn for stage in ("detect", "match")] == [not quiet] * 2
    assert [drawn.count("3/3") > 0, drawn.count("2/2") > 0] == [not quiet] * 2
    assert drawn.count("\n") == (0 if quiet else 3)


@pytest.mark.parametrize("groups", [False, True])
def test_in_a_pipe_a_line_a_minute_says_where_the_run_is(groups):
    now, said = [0.0], []
    progress = Lines(groups, clock=lambda: now[0], say=said.append)
    progress.look()  # nothing has begun
    progress("match", 0, 40)
    for second in range(1, 31):
        now[0] = 10.0 * second
        progress("match", second, 40)
    minutes = [f"match: {n} of 40, about {left} left" for n, left in
               ((6, "5.7 min"), (12, "4.7 min"), (18, "3.7 min"), (24, "2.7 min"), (30, "1.7 min"))]  # fmt: skip
    tenths = [f"match: {n} of 40" for n in range(4, 31, 4)]
    assert said == minutes if not groups else [line.split(",")[0] for line in said] == tenths
    said.clear()
    progress("adjustment", 0, 1)  # one task: only the clock tells
    now[0] += 39.0
    progress.look()
    assert said == []
    now[0] += 62.0
    progress.look()
    progress.look()
    assert said == ["adjustment: at work for 1.7 min"]


def test_general_flags_stand_before_and_after_the_verb(image, tmp_path, capsys, monkeypatch):
    levels: list[int] = []
    monkeypatch.setattr(logging, "basicConfig", lambda **given: levels.append(given["level"]))
    points = ("localize", image, "1e12", "0")
    for words in (("-vv", *points), (*points, "-vv"), (points[0], "-v", *points[1:], "--verbose")):
        assert run(*words) == 3
        assert levels.pop() == logging.DEBUG
    for words in (("-q", "fit", image), ("fit", image, "-q"), ("fit", "--quiet", image)):
        capsys.readouterr()
        assert run(*words) == 0
        assert capsys.readouterr().out == ""
    assert run("info", tmp_path / "no.tif", "--debug") == 1
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(("words", "shown"), [((), [True, False]), (("-v",), [True, True])])
def test_what_libraries_log_is_shown_with_v(words, shown, image, monkeypatch):
    handlers: list[logging.Handler] = []
    monkeypatch.setattr(logging, "basicConfig", lambda **given: handlers.extend(given["handlers"]))
    run(*words, "info", image)
    records = [logging.LogRecord(name, logging.ERROR, "", 0, "x", (), None) for name in ("barpc.a", "gcsfs")]
    assert [bool(handlers[0].filter(record)) for record in records] == shown


def test_info_says_where_the_rpc_comes_from_and_what_was_passed_over(image, capsys):
    write_rpc(make_rpc(), image.with_suffix(".RPB"))
    assert run("info", image, "--json") == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert report["rpc"].startswith("rpb in ")
    assert report["notes"] == ["not used: the image's own RPC"]
    assert report["size_px"] == [600, 400]
    assert report["err_bias_m"] == 3.1
    assert 0.9 < report["smallest_denominator"] <= 1.0
    assert 0 < report["incidence_deg"] < 60
    assert run("info", image) == 0
    told = capsys.readouterr().out
    (lon_min, lon_max), (lat_min, lat_max) = report["domain"]["lon_deg"], report["domain"]["lat_deg"]
    low, high = report["altitude_range_m"]
    gsd, stand, least = report["gsd_m"], report["camera_altitude_m"]["value"], report["smallest_denominator"]
    (lon, lat), angle, side = report["center_deg"], report["incidence_deg"], report["azimuth_deg"]
    assert told.splitlines()[1:] == [
        f"  camera       RPC (rpb) in {image.with_suffix('.RPB')}",
        "  note         not used: the image's own RPC",
        "  image        600 x 400 px; (0, 0) is the centre of the first pixel",
        f"  altitudes    {low:.5g} to {high:.5g} m above the ellipsoid",
        f"  made for     lon {lon_min:.5f} to {lon_max:.5f}, lat {lat_min:.5f} to {lat_max:.5f} deg",
        "  accuracy     3.1 m common to the image, 0.7 m of each point",
        f"  denominators at least {least:.3g} of their value at the centre: no pole",
        f"  centre       lon {lon:.6f}, lat {lat:.6f} deg at {(low + high) / 2:.5g} m",
        f"  pixel        {gsd['col']:.3f} m a column, {gsd['row']:.3f} m a row on the ground",
        f"  looks        {angle:.2f} deg off the vertical, from {side:.2f} deg (north is 0)",
        f"  sensor       {stand / 1e3:.1f} km high, assumed, as the rays of an image line meet in no orbit",
    ]


def test_info_says_in_words_what_is_not_known_of_a_camera(tmp_path, capsys):
    rpc = make_rpc()
    coeffs = rpc.coeffs.copy()
    coeffs[1, 1] = 2.0  # the denominator of the column falls through 0 to the west
    write_rpc(replace(rpc, coeffs=coeffs, err_bias=None, err_rand=None), tmp_path / "a.RPB")
    assert run("info", tmp_path / "a.RPB") == 0
    told = capsys.readouterr().out
    assert "  image        size unknown: give FILE,size=WIDTH:HEIGHT for angles" in told
    assert "  accuracy     not stated\n" in told
    assert re.search(r"  denominators at least -\d\.\d+ of .*: a pole may lie", told)
    assert "centre of the first" not in told


@pytest.mark.parametrize("name", ["b_RPC.TXT", "b.RPB", "b.geom", "b.XML", "b.json", "b.vrt", "b.tif"])
def test_convert_by_the_target_s_name(name, image, tmp_path):
    assert run("convert", image, tmp_path / "out" / name) == 0
    assert read_rpc(tmp_path / "out" / name) == read_rpc(image)
    assert run("convert", image, tmp_path / "out" / name) == 1  # exists


def test_convert_can_be_told_the_pixel_convention(tmp_path, capsys):
    (tmp_path / "RPC_S6.XML").write_text(dimap_v2(make_rpc()))
    for convention, shift in (("auto", 0), ("0", 1), ("0.5", 0.5)):
        target = tmp_path / f"{convention}.geom"
        assert run("convert", f"{tmp_path / 'RPC_S6.XML'},first_pixel={convention}", target) == 0
        np.testing.assert_allclose(read_rpc(target).image_offset, make_rpc().image_offset + shift, atol=1e-9)
    assert run("convert", tmp_path / "RPC_S6.XML", tmp_path / "c.doc") == 1
    assert "choose one of" in capsys.readouterr().err


def test_convert_cuts_by_window_and_by_box(image, tmp_path, capsys):
    assert run("convert", image, tmp_path / "w.tif", "--window", 50, 60, 100, 80) == 0
    rpc = read_rpc(image)
    np.testing.assert_allclose(read_rpc(tmp_path / "w.tif").image_offset, rpc.image_offset - [50, 60], atol=1e-9)
    corners = rpc.localize([[100.0, 100.0], [200.0, 150.0]], [200.0, 200.0])
    west, east = sorted(corners[:, 0])
    south, north = sorted(corners[:, 1])
    box = ("--bbox", west, south, east, north, "--alt", 200)
    capsys.readouterr()
    assert run("convert", image, tmp_path / "b.tif", *box, "--json") == 0
    window = json.loads(capsys.readouterr().out)["window"]
    assert window[0] <= 100
    assert window[0] + window[2] >= 200
    assert window[1] <= 100
    assert window[1] + window[3] >= 150
    assert window[2] < 130
    with open_raster(tmp_path / "b.tif") as crop:
        assert (crop.width, crop.height) == (window[2], window[3])
    assert run("convert", image, tmp_path / "x.tif", "--bbox", 0, 0, 1, 1) == 2
    assert run("convert", image) == 2
    assert run("convert", image, tmp_path / "x.tif", "--window", 590, 0, 100, 80) == 1
    assert not (tmp_path / "x.tif").exists()


@pytest.mark.parametrize("carrier", ["vrt", "copy"])
def test_convert_gives_images_other_rpcs_and_proves_it(carrier, image, tmp_path, capsys):
    better = read_rpc(image).crop(0.25, -0.5)
    write_rpc(better, tmp_path / "rpcs" / "scene_RPC.TXT")
    before = image.read_bytes()
    args = (
        "--rpc",
        tmp_path / "rpcs",
        "-o",
        tmp_path / "out",
        "--images",
        carrier,
        "--rpc-format",
        "txt,geom",
    )
    assert run("convert", image, *args, "--json") == 0
    readings = json.loads(capsys.readouterr().out)
    assert all(reading["max_px"] <= 1e-9 for reading in readings)
    assert {Path(reading["path"]).suffix for reading in readings} == {
        ".vrt" if carrier == "vrt" else ".tif",
        ".TXT",
        ".geom",
    }
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "scene.vrt" if carrier == "vrt" else "scene.tif",
        "scene_RPC.TXT",
        "scene.geom",
        ".barpc",
    }
    assert image.read_bytes() == before
    assert list(image.parent.iterdir()) == [image]
    assert run("convert", image, *args) == 1  # exists


def test_convert_names_what_hides_the_rpc_beside_the_input_and_in_the_new_folder(image, tmp_path, capsys):
    rpc = read_rpc(image)
    write_rpc(rpc.crop(5, 5), image.with_suffix(".RPB"))
    write_rpc(rpc.crop(5, 5), tmp_path / "out" / "scene.RPB")
    write_rpc(rpc, tmp_path / "new.geom")
    assert run("convert", image, "--rpc", tmp_path / "new.geom", "-o", tmp_path / "out", "--images", "copy") == 3
    error = capsys.readouterr().err
    assert "scene.RPB hides an RPC put into the image" in error
    assert f"{tmp_path / 'out' / 'scene.RPB'} hides the RPC of" in error


def test_convert_reports_a_file_that_a_tool_cannot_read_as_valid_json(image, tmp_path, capsys, monkeypatch):
    from barpc.pipeline import verify_outputs

    def broken(path):
        raise RuntimeError("no such\nfield")

    monkeypatch.setitem(verify_outputs.CONSUMERS, "gdal", verify_outputs.Consumer("rasterio", broken))
    write_rpc(read_rpc(image), tmp_path / "a.geom")
    assert run("convert", image, "--rpc", tmp_path / "a.geom", "-o", tmp_path / "out", "--json") == 3
    rows = {row["consumer"]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["gdal"]["max_px"] is None
    assert rows["gdal"]["note"] == "RuntimeError: no such field"
    assert rows["barpc"]["max_px"] == 0.0


def test_convert_refuses_the_images_own_folder_and_missing_rpcs(image, tmp_path, capsys):
    write_rpc(read_rpc(image), tmp_path / "a.geom")
    assert run("convert", image, "--rpc", tmp_path / "a.geom", "-o", image.parent) == 1
    assert "choose a new one" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert run("convert", image, "--rpc", tmp_path / "empty", "-o", tmp_path / "out") == 1
    assert "no RPC of scene.tif there" in capsys.readouterr().err
    assert run("convert", image, "--rpc", tmp_path / "a.geom", "-o", tmp_path / "out", "--rpc-format", "doc") == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("verb", ["info", "project", "localize", "triangulate", "convert"])
def test_a_file_that_is_missing_is_one_line_and_exit_code_1(verb, tmp_path, capsys):
    extra = [tmp_path / "x.RPB"] if verb == "convert" else []
    extra += ["--points", tmp_path / "p.csv"] if verb in ("project", "localize", "triangulate") else []
    assert run(verb, tmp_path / "nothing.tif", *extra) == 1
    error = capsys.readouterr().err
    assert "nothing.tif: no such file" in error
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize("verb", ["info", "project", "localize", "triangulate", "convert", "report"])
def test_every_verb_explains_itself(verb, capsys):
    assert run(verb, "--help") == 0
    assert "Example" in capsys.readouterr().out


def test_a_surface_is_told_in_three_lines_or_as_json_and_its_flags_are_its_options(tmp_path, monkeypatch, capsys):
    given: list[tuple[object, str, DsmOptions]] = []

    def make(source, out, options, **_):
        given.append((source, str(out), options))
        if options.band == 2:
            raise stereo.NoSurfaceError("nothing to match")
        return surface.Surface(str(out), ("a - b", "a - c"), 2.5, (4, 3), 7, 0.5, 0.25, 0.5, np.nan, 1.125)

    monkeypatch.setattr(surface, "make_dsm", make)
    (tmp_path / "run").mkdir()
    (tmp_path / "run/summary.json").write_text("{}")
    flags = ["--gsd", 2.5, "--alt", 10, 20, "--pairs", 2, "--minus", "first", "--overwrite"]
    assert run("dsm", tmp_path / "run", "-o", "x.tif", *flags) == 0
    assert capsys.readouterr().out.splitlines() == [
        "7 of 12 cells of 2.5 m have a height, by a - b, a - c",
        "pairs disagree by 0.25 m, sigma by matching 0.50 m, shared by all cells 1.12 m (medians)",
        "Written to x.tif",
    ]
    expected = DsmOptions(gsd=2.5, alt=(10.0, 20.0), pairs=2, minus="first", overwrite=True)
    assert given == [(tmp_path / "run", "x.tif", expected)]
    assert run("-q", "dsm", "a.tif", "b.tif", "-o", "x.tif") == 0
    assert capsys.readouterr().out == ""
    assert given[1] == (["a.tif", "b.tif"], "x.tif", DsmOptions())
    assert run("dsm", "a.tif", "b.tif", "-o", "x.tif", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["size"], told["known"], told["sigma_cameras"]) == ([4, 3], 7, None)
    assert run("dsm", "a.tif", "b.tif", "-o", "x.tif", "--band", 2) == 3
    assert "no surface: nothing to match" in capsys.readouterr().err
    assert run("dsm", tmp_path / "run", "b.tif", "-o", "x.tif") == 2
    assert "is a finished run: give it alone" in capsys.readouterr().err
    assert run("dsm", "a.tif", "b.tif", "-o", "x.tif", "--minus", "first") == 2
    assert "--minus goes with a RUN" in capsys.readouterr().err
