"""What images may be called: every name goes through every file that is written, or is refused in one line at once."""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
import shutil
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.pointio.names import MAX_NAME, cell, from_cell, require_pair_names, unique_names
from barpc.rpcio import read_rpc
from tests.lanes import rest_slow
from tests.pointio.stages import read_matches

from .conftest import Said, assert_one_line, barpc, hashes

CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")

REFUSED = [
    "back\\slash", "end\\",
    "new\nline", "tab\tbed", "\x1b[31mred", "bell\x07", "\rreturn", "del\x7f", "c1\x9b31m", "nel\x85x", "vt\x0b",
    "fs\x1cx",
    "sep\u2028x", "par\u2029x", "\ufffe", "x\uffff",
    os.fsdecode(b"latin\xe9"), os.fsdecode(b"\xff\xfe"), os.fsdecode(b"cut\xe2\x82"), os.fsdecode(b"\xed\xa0\x80"),
    "n" * (MAX_NAME + 1), "é" * (MAX_NAME // 2 + 1), "L" * 240, "\U0001f6f0" * 60,
]  # fmt: skip
HIDDEN = [".hidden", ".", ".."]  # names of images whose outputs nobody would see
KEPT = [
    '"lead', 'in"ner', '"both"', "'single'", "it's", "`id`", "$(touch x)", "${HOME}", "a;b", "a,b", "a|b", "a&b",
    "<b>bold", "&amp;", "<script>alert(1)<!--", '"><img src=x>', "]]>",
    "<!--", "#hash", "in#side", "100%", "%20", "%s%n",
    " lead", "trail ", "two  spaces", "star*", "who?", "[x]", "{a,b}", "!x", "~user",
    "-dash", "--help", "=1+1", "+cmd", "@SUM(1)", "'=1", "''+2", " =3", "＝4", "a.b.c", "a__b",
    "_",
    "con", "nul", "summary.json", "matches", "report", "residuals.csv", "block.npz", "view.vrt", "C:x",
    "http:x", "vsizip",
    "cafe\u0301", "שלום", "\u202eevil", "zero\u200bwidth", "null", "0", "-1", "1e5", "nan",
    "x" * MAX_NAME, "é" * (MAX_NAME // 2),
    "0:0", "NETCDF:x", "a=b", "^caret", "(paren", "日本語", "\U0001f6f0", "a\u00a0b", "|", "run-a",
    "x_RPC", "y_RPC.TXT",
]  # fmt: skip
THREES = [
    ['"><img src=x>', "$(touch x)", "=1+1, cafe\u0301"],  # what a page, a shell and a table would take for their own
    *[KEPT[i : i + 3] for i in range(0, len(KEPT) - 2, 3)],
    KEPT[-3:],
]
SHORT = 1  # groups; the others are slow tests

FOLDERS = [*KEPT, HIDDEN[0]]


def short(names: object) -> str:
    return ascii(names)[:60]


def placed(folder: Path, pristine: list[Path], names: list[str]) -> list[Path]:
    folder.mkdir(parents=True)
    return [Path(shutil.copy(path, folder / f"{name}.tif")) for path, name in zip(pristine, names, strict=False)]


def assert_printable(said: Said) -> None:
    for text in (said.out, said.err):
        assert not CONTROL.search(text), ascii(text)


class Page(HTMLParser):
    """The texts of a page and the elements that it is made of."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.tags: set[str] = set()
        self.scripts: list[str | None] = []
        self.sources: list[str] = []
        self.attributes: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}
        self.scripts += [dict(attrs).get("type")] * (tag == "script")
        self.sources += [value or "" for name, value in attrs if name in ("src", "href", "srcset")]

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [pytest.param(three, marks=[pytest.mark.nightly] * (k >= SHORT)) for k, three in enumerate(THREES)],
    ids=short,
)
def test_a_name_goes_through_every_file_and_back(names, pristine, tmp_path):
    images = placed(tmp_path / "in", pristine, names)
    before = hashes(images)
    ties, out = tmp_path / "ties", tmp_path / "out"
    listed = tmp_path / "pairs.txt"
    listed.write_text("".join(f"{shlex.quote(a)} {shlex.quote(b)}\n" for a, b in pairwise(names)))
    said = barpc("match", *images, "-o", ties, "--overlap-list", listed)
    assert_printable(said)
    assert said.code in (0, 3), said
    ways = [read_matches(ties / way, names) for way in ("matches.csv", "matches.npz", "asp")]
    counts = [np.bincount(tracks.view, minlength=len(names)) for tracks in ways]
    np.testing.assert_array_equal(counts[0], counts[1])
    # two tracks through one keypoint (it had two orientations) are one to ASP, and contradict each other
    assert (counts[2] <= counts[0]).all()
    assert (counts[2] >= 0.9 * counts[0]).all()
    said = barpc("adjust", *images, "-o", out, "--matches", ties / "matches.csv", "--matches-only")
    assert_printable(said)
    assert said.code in (0, 3), said
    assert_printable(barpc("report", out))
    said = barpc("verify", out)
    assert_printable(said)
    assert said.code == 0, said
    assert hashes(images) == before
    summary = json.loads((out / "summary.json").read_text())
    names = sorted(names)  # as in every table
    assert [view["name"] for view in summary["views"]] == names
    for name, view in zip(names, summary["views"], strict=True):
        assert set(view["outputs"]) == {f"{name}.vrt", f"{name}_RPC.TXT"}
        assert read_rpc(out / f"{name}_RPC.TXT") == read_rpc(out / f"{name}.vrt")
        with rasterio.open(out / f"{name}.vrt") as vrt, rasterio.open(out / view["path"]) as image:
            assert (vrt.read(1) == image.read(1)).all()
    assert [
        f["properties"]["name"] for f in json.loads((out / "tables/footprints.geojson").read_text())["features"]
    ] == names
    for table, columns in (("observations.csv", 1), ("pairs.csv", 2)):
        with (out / "tables" / table).open(encoding="utf-8", newline="") as file:
            rows = list(csv.reader(file))[1:]
        cells = {text for row in rows for text in row[:columns]}
        assert {from_cell(text) for text in cells} == set(names)
        assert not any(text.lstrip(" ").startswith(tuple("=+-@＝＋－＠")) for text in cells)
    page = Page((out / "report.html").read_text(encoding="utf-8"))
    shown = " ".join(page.texts)
    assert all(name.strip() in shown or not name.isprintable() for name in names)
    assert page.scripts == [None]
    assert all(source.startswith(("#", "data:image/jpeg;base64,")) or source == "data:," for source in page.sources)
    assert not any(name.startswith("on") for name in page.attributes)


@pytest.mark.few(30)
@pytest.mark.parametrize("where", ["image", "folder", "output"])
@pytest.mark.parametrize("name", [*REFUSED, *HIDDEN], ids=short)
def test_a_name_that_files_cannot_carry_is_refused_in_one_line(name, where, pristine, tmp_path):
    if where != "image" and (name in HIDDEN or len(name.encode(errors="replace")) > MAX_NAME):
        pytest.skip("a folder may be called so")
    try:
        folder = tmp_path / (name if where == "folder" else "in")
        images = placed(folder, pristine, [name if where == "image" else "a", "b"])
    except OSError:
        pytest.skip("no such name on this file system")
    before = hashes([tmp_path])
    out = tmp_path / (name if where == "output" else "out")
    for verb in ("adjust", "match"):
        said = barpc(verb, *images, "-o", out)
        assert_one_line(said, 1)
        assert_printable(said)
        assert not out.exists()
        assert hashes([tmp_path]) == before


@pytest.mark.nightly
@pytest.mark.slow  # before a commit: names of images, and folders that are refused
def test_folders_may_be_called_so(pristine, tmp_path):
    deep = tmp_path.joinpath(*FOLDERS)
    images = placed(deep, pristine, ["a", "b"])
    for out in (tmp_path / "out", deep / "out"):
        said = barpc("adjust", *images, "-o", out)
        assert_printable(said)
        assert said.code == 0, said
        with rasterio.open(out / "a.vrt") as vrt:
            assert vrt.read(1).any()


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("names", rest_slow([["#a", " b "], ["-c", '"d']]), ids=short)
def test_lists_of_images_hold_every_name(pristine, tmp_path, names):
    folder = tmp_path / "list"
    placed(folder, pristine, names)
    (folder / "list.txt").write_text("# images\n\n" + "".join(f"./{name}.tif\n" for name in names))
    said = barpc("adjust", "--image-list", folder / "list.txt", "-o", folder / "out", "--json")
    assert [view["name"] for view in json.loads(said.out)["views"]] == sorted(names)


def test_names_that_look_alike_to_a_file_system_are_told_apart_or_refused(pristine, tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    assert unique_names([a / "IMG.tif", b / "img.tif"]) == ["a_IMG", "b_img"]
    assert unique_names([a / "i.tif", a / "i.jp2", b / "i.tif"]) == ["i.tif", "i.jp2", "i"]
    for pair in (["IMG", "img"], ["caf\u00e9", "cafe\u0301"]):
        images = placed(tmp_path / pair[0], pristine, pair)
        said = barpc("adjust", *images, "-o", tmp_path / "out")
        assert_one_line(said, 1, "cannot be told apart")


@pytest.mark.parametrize("names", [["img_1", "img_10", "img_100"], ["x__y", "y__x", "z"]])
def test_names_with_parts_of_others_are_names_of_pairs(names):
    require_pair_names(names)


@pytest.mark.parametrize("text", [*KEPT, "''=x", "'", "''", "' =x", "=", "", '="a"', "=a,b", "'\t"])
def test_a_cell_reads_back_and_is_never_a_formula(text):
    row = next(csv.reader([f"{cell(text)},1"]))
    assert row[1:] == ["1"]
    assert from_cell(row[0]) == text
    assert not row[0].lstrip(" ").startswith(tuple("=+-@＝＋－＠\t\r"))
    assert not cell(text).startswith("#")
