"""Whose a file is: barpc writes free names and replaces its own files; nothing comes before an input's RPC."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
import rasterio

from barpc.rpcio import read_rpc, read_rpc_source, write_rpc
from tests.lanes import diagonal, rest_slow

from .conftest import Said, assert_one_line, barpc, hashes
from .test_interruption import posix, relative, sweep
from .trials import outputs

OTHERS = (
    "summary.json",
    "tables/pairs.csv",
    "report.html",
    "tables/footprints.geojson",
    "view_00_RPC.TXT",
    "view_00.vrt",
)


def assert_untouched(folder: Path, before: dict[Path, str], said: Said, *words: str) -> None:
    """One line with the way out, and not a file more or less."""
    assert_one_line(said, 1, *words)
    assert hashes([folder]) == before
    assert not list(folder.rglob(".barpc*"))


# -- the folder of the images --------------------------------------------------------------------------


@pytest.mark.parametrize("more", [(), ("--overwrite",), ("--overwrite", "--images", "copy")])
@pytest.mark.parametrize("formats", ["txt", "rpb", "geom"])
def test_the_folder_of_the_images_is_refused_before_any_work(crops, tmp_path, formats, more):
    before = hashes([tmp_path])
    said = barpc("adjust", *crops, "-o", crops[0].parent, "--rpc-format", formats, *more)
    assert_untouched(tmp_path, before, said, "the input", "view_00.tif", "give another -o")


def test_nor_by_another_name_of_folder_or_image(crops, tmp_path):
    (tmp_path / "alias").symlink_to(crops[0].parent)
    (tmp_path / "links").mkdir()
    capitals = crops[0].rename(crops[0].with_name("VIEW_00.TIF"))
    links = [tmp_path / "links" / f"{name}.tif" for name in ("one", "two")]
    for link, image in zip(links, (capitals, crops[1]), strict=True):
        link.symlink_to(image)
    before = hashes([tmp_path])
    cases = [
        ([capitals, crops[1]], tmp_path / "alias"),
        ([capitals, crops[1]], tmp_path / "in/../in"),
        ([tmp_path / "alias/VIEW_00.TIF", tmp_path / "alias/view_01.tif"], tmp_path / "in"),
        (links, tmp_path / "links"),
    ]
    for images, out in cases:
        said = barpc("adjust", *images, "-o", out, "--overwrite")
        assert_untouched(tmp_path, before, said, "the input", "give another -o")


def test_nor_beside_an_image_that_is_no_input(crops, tmp_path):
    """A product of another day that happens to have a view's name keeps its RPC."""
    (tmp_path / "out").mkdir()
    shutil.copy(crops[1], tmp_path / "out/view_00.tif")
    before = hashes([tmp_path])
    said = barpc("adjust", *crops, "-o", tmp_path / "out", "--overwrite")
    assert_untouched(tmp_path, before, said, "out/view_00.tif", "give another -o")


@pytest.mark.slow
def test_a_folder_above_or_below_the_images_is_fine(crops, out, tmp_path):
    shutil.copytree(out / ".barpc/cache", tmp_path / ".barpc/cache")  # what needs not be done again
    shutil.copytree(out / ".barpc/cache", crops[0].parent / "below/out/.barpc/cache")
    shutil.rmtree(out)
    before = hashes(crops)
    for out, more in ((crops[0].parent / "below/out", ()), (tmp_path, ("--overwrite",))):
        assert barpc("adjust", *crops, "-o", out, *more).code == 0
        assert (out / "view_00_RPC.TXT").is_file()
    assert hashes(crops) == before
    assert [read_rpc_source(path).format for path in crops] == ["tag", "tag"]


# -- files of others in the run folder -----------------------------------------------------------------


@pytest.mark.parametrize("name", OTHERS)
def test_a_user_s_file_is_never_replaced_and_refused_by_name(crops, tmp_path, name):
    (tmp_path / "out" / name).parent.mkdir(parents=True)
    (tmp_path / "out" / name).write_text("mine")
    before = hashes([tmp_path])
    said = barpc("adjust", *crops, "-o", tmp_path / "out", "--overwrite")
    assert_untouched(tmp_path, before, said, name, "give another -o")


WORDS = {"adjust": ("{a}", "{b}"), "convert": ("{a}", "--rpc", "{b}"), "match": ("{a}", "{b}")}


@pytest.mark.parametrize("verb", rest_slow(WORDS, 2))
def test_a_file_that_was_edited_is_refused_and_all_others_are_as_they_were(crops, out, tmp_path, verb):
    command = (verb, *(word.format(a=crops[0], b=crops[1]) for word in WORDS[verb]), "-o", out)
    if verb != "adjust":
        kept = (tmp_path / "out").rename(tmp_path / "kept") / ".barpc/cache"
        shutil.copytree(kept, out / ".barpc/cache")
        assert barpc(*command).code == 0
    assert_one_line(barpc(*command), 1, "--overwrite")
    edited = out / ("asp/view_00__view_01.txt" if verb == "match" else "view_00_RPC.TXT")
    edited.write_text(edited.read_text() + "\n")
    before = hashes([tmp_path])
    assert_one_line(barpc(*command, "--overwrite"), 1, edited.name, "changed since", "not replaced")
    assert hashes([tmp_path]) == before
    edited.unlink()
    assert barpc(*command, "--overwrite").code == 0
    assert edited.is_file()


def test_a_folder_of_a_release_without_hashes_is_left_as_it_is(crops, out, tmp_path):
    state = json.loads((out / ".barpc/state.json").read_text())
    (out / ".barpc/state.json").write_text(json.dumps({**state, "outputs": sorted(state["outputs"])}))
    before = hashes([tmp_path])
    assert_one_line(barpc("adjust", *crops, "-o", out, "--overwrite"), 1, "not written by a run", "another -o")
    assert hashes([tmp_path]) == before


def test_a_prior_is_not_replaced_by_the_run_that_starts_from_it(crops, out, tmp_path):
    before = hashes([tmp_path])
    said = barpc("adjust", *crops, "-o", out, "--add-to", out, "--overwrite")
    assert_one_line(said, 1, "none to add")
    assert hashes([tmp_path]) == before


@pytest.mark.slow
def test_a_report_is_made_again_only_where_it_is_barpc_s(crops, out):
    assert barpc("report", out).code == 0
    assert barpc("adjust", *crops, "-o", out, "--overwrite").code == 0
    (out / "report.html").write_text("mine")
    assert_one_line(barpc("report", out), 1, "report.html", "not written")
    assert (out / "report.html").read_text() == "mine"
    (out / "report.html").unlink()
    assert barpc("report", out).code == 0
    assert barpc("adjust", *crops, "-o", out, "--overwrite").code == 0


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("number", rest_slow([9, 2]))
def test_stopped_between_two_outputs_the_same_command_finishes(crops, ran, out, tmp_path, monkeypatch, number):
    rename, seen = Path.replace, []

    def counted(path: Path, target: Path) -> Path:
        seen.extend([target] * ("cache" not in Path(target).parts))
        if len(seen) == number:
            raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "replace", counted)
    command = ("adjust", *crops, "-o", out, "--overwrite")
    assert_one_line(barpc(*command), 130, "interrupted")
    monkeypatch.undo()
    assert len(seen) >= number
    assert barpc(*command).code == 0
    assert relative(outputs(out), tmp_path) == relative(outputs(ran / "out"), ran)


@posix
@pytest.mark.nightly
@pytest.mark.parametrize("step", [5, 1])
def test_killed_between_any_two_outputs_the_same_command_finishes(step):
    """adjust in all formats, with copies, over a finished run; match, apply: the same bytes."""
    for name, found in sweep("--every-output", step).items():
        assert found["identical"] == found["killed"], name
        assert found["killed"] >= found["outputs"] // step, name


@posix
@pytest.mark.nightly
def test_commands_on_finished_runs_that_are_killed_at_random_end_with_the_same_bytes():
    """Of `--add-to`, with `--update`, `ortho`, `dsm` beside and in its run, `calibrate`."""
    found = sweep(20, "--of-runs", "--seed", 3)
    assert len(found) == 6
    for name, one in found.items():
        assert one["odd"] == [], name
        assert one["identical"] == one["trials"] == 20, name
        assert one["killed"] >= 5, name


# -- verbs that write one file, or into a folder of images ---------------------------------------------


def test_a_converted_rpc_is_written_beside_its_image_and_another_one_only_when_that_is_meant(crops):
    image, target = crops[0], crops[0].with_name("view_00_RPC.TXT")
    assert barpc("convert", image, target).code == 0  # the same RPC: nothing changes for the image
    target.unlink()
    before = hashes([image.parent])
    said = barpc("convert", crops[1], target)
    assert_one_line(said, 1, "view_00_RPC.TXT", "view_00.tif", "--overwrite")
    assert_one_line(barpc("fit", image, "-o", target), 1, "view_00_RPC.TXT", "view_00.tif", "--overwrite")
    assert_one_line(barpc("convert", image, target, "--window", 0, 0, 64, 64), 1, "view_00.tif")
    assert hashes([image.parent]) == before
    said = barpc("convert", crops[1], target, "--overwrite")
    assert said.code == 0
    assert "is read in place of the RPC that" in said.err
    assert (
        read_rpc(image).project([[5.4, 43.3, 100]]).tolist() == read_rpc(crops[1]).project([[5.4, 43.3, 100]]).tolist()
    )


@pytest.mark.parametrize(
    ("verb", "end"), diagonal(["convert", "fit", "convert --window"], ["_RPC.TXT", ".RPB", ".geom"])
)
def test_the_vendor_s_file_of_an_input_is_never_replaced(crops, verb, end):
    vendor = crops[0].with_name(f"view_00{end}")
    write_rpc(read_rpc(crops[0]), vendor)
    before = hashes([crops[0].parent])
    more = {"convert": [crops[0], vendor], "convert --window": [crops[0], vendor, "--window", 0, 0, 64, 64]}
    for target in (vendor, crops[0]):
        words = [str(target) if word == vendor else word for word in more.get(verb, [crops[0], "-o", vendor])]
        said = barpc(verb.split()[0], *words, "--overwrite")
        assert_one_line(said, 1, target.name, "never replaced")
        assert hashes([crops[0].parent]) == before


def test_convert_adds_to_a_folder_and_hides_no_input(crops, tmp_path):
    for image in crops:
        assert barpc("convert", image, "--rpc", image, "-o", tmp_path / "out").code == 0
    assert len(list((tmp_path / "out").glob("*.vrt"))) == 2
    shutil.copy(crops[0], tmp_path / "copy.tif")
    os.link(crops[0], tmp_path / "linked.tif")
    (tmp_path / "alias").symlink_to(crops[0].parent)
    before = hashes([tmp_path])
    said = barpc("convert", tmp_path / "alias/view_00.tif", "--rpc", crops[1], "-o", tmp_path / "in")
    assert_one_line(said, 1, "in")
    said = barpc("convert", crops[0], "--rpc", tmp_path / "out", "-o", tmp_path / "out", "--overwrite")
    assert_one_line(said, 1, "input")
    assert hashes([tmp_path]) == before


def test_gdal_sees_the_input_s_own_rpc_after_every_refusal(crops):
    """The reason for all of it, by a reader that is not barpc's."""
    with rasterio.open(crops[0]) as image:
        own = image.rpcs.to_gdal()
    barpc("adjust", *crops, "-o", crops[0].parent, "--overwrite")
    barpc("convert", crops[1], crops[0].with_suffix(".RPB"))
    with rasterio.open(crops[0]) as image:
        assert image.rpcs.to_gdal() == own
