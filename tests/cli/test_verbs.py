"""The verbs on cameras and points, as hands type them."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barpc.base.verb_options import DsmOptions
from barpc.dsm import stereo, surface
from barpc.rpcio import read_rpc, write_rpc
from tests.cli.test_main import run
from tests.reliability.conftest import assert_one_line, barpc
from tests.rpcio.conftest import dimap_v2, make_rpc


def test_an_rpc_file_has_no_size_and_asks_for_it(tmp_path):
    write_rpc(make_rpc(), tmp_path / "a.RPB")
    assert_one_line(barpc("info", "--footprint", tmp_path / "a.RPB"), 1, "size=")
    assert run("info", "--footprint", f"{tmp_path / 'a.RPB'},size=2000:1900") == 0


def test_info_says_where_the_rpc_comes_from_and_what_was_passed_over(image, capsys):
    write_rpc(make_rpc(), image.with_suffix(".RPB"))
    assert run("info", image, "--json") == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert report["rpc"] == f"rpb in {image.with_suffix('.RPB')}"
    assert report["notes"] == ["not used: the image's own RPC"]


def test_info_says_in_words_what_is_not_known_of_a_camera(tmp_path, capsys):
    rpc = make_rpc()
    coeffs = rpc.coeffs.copy()
    coeffs[1, 1] = 2.0  # the denominator of the column falls through 0 to the west
    write_rpc(replace(rpc, coeffs=coeffs, err_bias=None, err_rand=None), tmp_path / "a.RPB")
    assert run("info", tmp_path / "a.RPB") == 0
    told, error = capsys.readouterr()
    assert error == ""  # no height is asked for
    assert "  image        size unknown: give FILE,size=WIDTH:HEIGHT for angles" in told
    assert "  accuracy     not stated\n" in told
    assert re.search(r"  denominators at least -\d\.\d+ of .*: a pole may lie", told)
    assert "centre of the first" not in told


@pytest.mark.parametrize("name", ["b_RPC.TXT", "b.RPB", "b.geom", "b.XML", "b.json", "b.vrt", "b.tif"])
def test_convert_by_the_target_s_name(name, image, tmp_path):
    assert run("convert", image, tmp_path / "out" / name) == 0
    assert read_rpc(tmp_path / "out" / name) == read_rpc(image)
    assert run("convert", image, tmp_path / "out" / name) == 1  # exists


def test_convert_can_be_told_the_pixel_convention(tmp_path):
    (tmp_path / "RPC_S6.XML").write_text(dimap_v2(make_rpc()))
    for convention, shift in (("auto", 0), ("0", 1), ("0.5", 0.5)):
        target = tmp_path / f"{convention}.geom"
        assert run("convert", f"{tmp_path / 'RPC_S6.XML'},first_pixel={convention}", target) == 0
        np.testing.assert_allclose(read_rpc(target).image_offset, make_rpc().image_offset + shift, atol=1e-9)
    assert_one_line(barpc("convert", tmp_path / "RPC_S6.XML", tmp_path / "c.doc"), 1, "choose one of")


@pytest.mark.parametrize("carrier", ["vrt", "copy"])
def test_convert_gives_images_other_rpcs_and_proves_it(carrier, image, tmp_path, capsys):
    better = read_rpc(image).crop(0.25, -0.5)
    write_rpc(better, tmp_path / "rpcs" / "scene_RPC.TXT")
    before = image.read_bytes()
    args = ("--rpc", tmp_path / "rpcs", "-o", tmp_path / "out", "--images", carrier, "--rpc-format", "txt,geom")
    assert run("convert", image, *args, "--json") == 0
    readings = json.loads(capsys.readouterr().out)
    assert all(reading["max_px"] <= 1e-9 for reading in readings)
    written = {"scene.vrt" if carrier == "vrt" else "scene.tif", "scene_RPC.TXT", "scene.geom"}
    assert {Path(reading["path"]).name for reading in readings} == written
    assert {path.name for path in (tmp_path / "out").iterdir()} == {*written, ".barpc"}
    assert image.read_bytes() == before
    assert list(image.parent.iterdir()) == [image]
    assert run("convert", image, *args) == 1  # exists


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
    assert_one_line(barpc("dsm", tmp_path / "run", "b.tif", "-o", "x.tif"), 2, "is a finished run: give it alone")
    assert_one_line(barpc("dsm", "a.tif", "b.tif", "-o", "x.tif", "--minus", "first"), 2, "--minus goes with a RUN")
