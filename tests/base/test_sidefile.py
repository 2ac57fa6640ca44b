"""Files from elsewhere are opened in one place, in time that grows as they do, and no reader goes around it."""

from __future__ import annotations

import ast
import contextlib
import io
import json
import math
import os
import re
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import barpc
from barpc.base.errors import BarpcError, InputError
from barpc.base.frozen import load_npz
from barpc.base.safe_io import (
    ARRAYS,
    GEOJSON,
    MAX_LINE_BYTES,
    MAX_NUMBER,
    MB,
    NAMES,
    SUMMARY,
    TABLE,
    Kind,
    encoding_of,
    opened,
    opened_text,
    parse_json,
    plain_path,
    read_bytes,
    read_head,
    read_json,
    read_names,
    read_text,
    unread,
)
from barpc.rpcio import FORMATS
from barpc.rpcio.formats import parse_rpc
from barpc.rpcio.text import ReadOptions
from tests.fuzz.samples import SAMPLES
from tests.lanes import diagonal, rest_slow

SMALL = Kind("a list of names", 100)
READERS: dict[str, Callable[[Path], object]] = {
    "read_bytes": lambda path: read_bytes(path, SMALL),
    "read_text": lambda path: read_text(path, SMALL),
    "read_json": lambda path: read_json(path, SMALL),
    "read_head": lambda path: read_head(path, SMALL, 10),
    "load_npz": lambda path: load_npz(path, SMALL),
}


@pytest.mark.parametrize(
    ("head", "encoding"),
    [
        ("col,row\n".encode("utf-16-le"), "utf-16-le"),
        ("col,row\n".encode("utf-16-be"), "utf-16-be"),
        ("col,row\n".encode("utf-16"), "utf-16"),
        ("col,row\n".encode("utf-8-sig"), "utf-8-sig"),
        (b"col,row\n", "utf-8-sig"),
        ("a,b\n".encode("utf-16-le"), "utf-16-le"),
        ("a,b".encode("utf-16-le"), "utf-8-sig"),
        (bytes(16), "utf-8-sig"),
        (b"a\0b\0c\0dxe\0", "utf-8-sig"),
        (b"a\0b\0\0\0d\0e\0", "utf-8-sig"),
        (b"", "utf-8-sig"),
    ],
    ids=repr,
)
def test_utf_16_is_known_by_its_mark_or_by_zeros_between_at_least_four_letters(head: bytes, encoding: str) -> None:
    assert encoding_of(head) == encoding


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_only_a_regular_file_is_read(read, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for path, words in (
        (tmp_path / "pipe", "a pipe"),
        (tmp_path / "link", "a pipe"),
        (Path("/dev/zero"), "a device"),
        (tmp_path, "a folder"),
        (tmp_path / "none", "no such file"),
        (tmp_path / "zero\0byte", "cannot be read"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            read(path)
        assert str(caught.value).startswith(str(path).split("\0")[0])
        assert str(caught.value).isprintable()


@pytest.mark.parametrize("kind", [NAMES, ARRAYS])
def test_a_file_that_is_too_large_is_refused_with_its_size_before_it_is_read(kind, tmp_path):
    path = tmp_path / "huge"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match=rf"huge: {1 << 40} bytes.*at most {kind.most}"):
        read_bytes(path, kind)


def test_a_file_without_a_size_is_not_read_beyond_the_bound():
    path = Path("/proc/self/smaps")
    if not path.exists():
        pytest.skip("no /proc here")
    with pytest.raises(InputError, match="101 bytes"):
        read_bytes(path, SMALL)


def test_no_descriptor_is_left_open(tmp_path):
    folder = Path("/proc/self/fd")
    if not folder.is_dir():
        pytest.skip("no /proc here")
    before = len(list(folder.iterdir()))
    for path in (tmp_path, Path("/dev/zero"), tmp_path / "none"):
        with pytest.raises(InputError), opened(path, SMALL):
            pass
    assert len(list(folder.iterdir())) == before


@pytest.mark.parametrize(
    "text",
    ["NaN", "[Infinity]", "1e999", "-1e101", "9" * 19, "9" * 5000, "[" * 100_000, '{"a":' * 100_000, "{", ""],
)
def test_json_holds_finite_numbers_and_is_not_endlessly_deep(text):
    with pytest.raises(ValueError) as caught:
        parse_json(text)
    assert len(str(caught.value)) < 200


def test_the_largest_numbers_are_read_and_none_beyond() -> None:
    assert parse_json(f"[{MAX_NUMBER}, -{MAX_NUMBER}, 0.5]") == [MAX_NUMBER, -MAX_NUMBER, 0.5]
    with pytest.raises(ValueError, match="is beyond"):
        parse_json(f"[{math.nextafter(MAX_NUMBER, math.inf)}]")


@pytest.mark.parametrize(("start", "end"), [("[", "]"), ('{"a":', "}"), ('[1,{"}":', '},"]"]')])
def test_json_is_read_to_a_hundred_levels_by_any_python(start, end):
    """What is deeper is refused for that, whether or not it ends; how deep json itself reads differs by version."""
    fits = 100 // (start.count("[") + start.count("{"))
    for text in (start * fits + "1" + end * fits, f"[{start * (fits - 1)}1{end * (fits - 1)}, {{}}]"):
        assert parse_json(text) == json.loads(text)
    for text in (
        start * (fits + 1) + "1" + end * (fits + 1),
        start * (fits + 1),
        start * 1800 + "1" + end * 1800,
    ):
        with pytest.raises(ValueError, match="nested too deep"):
            parse_json(text)


@pytest.mark.parametrize("inner", ["[" * 200, '\\"[' * 200, '\\\\\\"{' * 200, "\\u005b[" * 200, "é[" * 200])
def test_brackets_in_the_strings_of_json_are_no_levels(inner):
    text = f'{{"a": "{inner}", "b{inner}": [1, "\\\\"]}}'
    assert parse_json(text) == json.loads(text)
    with pytest.raises(ValueError, match="nested too deep"):
        parse_json(f'["{inner}\\\\", {"[" * 100}')


@pytest.mark.parametrize("half", [r"\ud800", r"\uDFFF", r"\udc00\ud800", r"\ud83d \ude00"])
def test_half_a_character_is_refused_in_names_and_texts_of_json(half):
    for text in (f'["a{half}"]', f'{{"a": {{"{half}": 1}}}}'):
        with pytest.raises(ValueError, match=r"^'\\ud[8-f]\w\w' is half of a character$"):
            parse_json(text)


def test_bytes_of_a_name_that_are_no_text_come_back_from_json():
    name = os.fsdecode(b"\x80t\xff")
    assert parse_json(json.dumps([name, {name: 1}])) == [name, {name: 1}]


def test_a_whole_pair_and_an_escape_of_an_escape_are_characters():
    text = r'["\ud83d\ude00", "\\ud800", "\u00e9", "\u0d80"]'
    assert parse_json(text) == ["\U0001f600", r"\ud800", "\u00e9", "\u0d80"]


def test_json_of_many_values_is_not_deep():
    assert parse_json(json.dumps([[[k, k]] for k in range(1000)]))[999] == [[999, 999]]


def bomb(path: Path, claimed: int, stored: bytes, compression: int = zipfile.ZIP_DEFLATED) -> Path:
    """An archive whose array claims so many bytes."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (claimed,)})
    with zipfile.ZipFile(path, "w", compression) as archive, archive.open("names.npy", "w") as file:
        file.write(header.getvalue() + stored)
    return path


def test_an_archive_that_claims_more_than_it_holds_is_refused_before_anything_is_allocated(tmp_path):
    path = bomb(tmp_path / "liar.npz", 10**15, b"\0" * 100)  # 1 PB: an allocation would fail otherwise
    with pytest.raises(InputError, match=r"liar\.npz.*another number of bytes"):
        load_npz(path)
    data = bytearray(bomb(tmp_path / "zip.npz", 10**6, b"\0" * 10**6).read_bytes())
    directory = data.rindex(b"PK\1\2")
    data[directory + 24 : directory + 28] = (10**9).to_bytes(4, "little")  # the directory's claim
    (tmp_path / "zip.npz").write_bytes(data)
    with pytest.raises(InputError, match=r"zip\.npz.*claims more bytes than it can hold"):
        load_npz(tmp_path / "zip.npz")


def test_an_archive_of_python_objects_is_refused_by_its_header(tmp_path):
    np.savez(tmp_path / "objects.npz", names=np.array([{}, None]))
    with pytest.raises(InputError, match=r"objects\.npz.*names\.npy holds Python objects"):
        load_npz(tmp_path / "objects.npz")


def test_an_archive_that_holds_too_much_is_refused_unpacked(tmp_path):
    path = bomb(tmp_path / "bomb.npz", 10**6, b"\0" * 10**6)
    assert path.stat().st_size < 5000
    with pytest.raises(InputError, match=r"bomb\.npz, unpacked: 1000\d* bytes.*at most 100000"):
        load_npz(path, Kind("a small archive", 100_000))


# --- time -------------------------------------------------------------------------------------------------

FILLS: dict[str, str] = {
    "blank lines": "\n",
    "blanks": " ",
    "tabs and lines": "\t\n",
    "opening brackets": "(",
    "opening lists": "a: [\n",
    "pairs of nothing": "a=(",
    "digits": "7",
    "letters": "a",
    "angles": "<",
    "tags": "<a>",
    "tiles": "<NTILES_SIZE ",
    "declarations": "<?xml ?",
    "quotes": '"',
    "values in blanks": "x   ",
    "dashes": "\n - 1",
    "keys": "LINE_OFF: 1 \n",
}


def cpu(work: Callable[[], object]) -> float:
    began = time.process_time()
    with contextlib.suppress(BarpcError, ValueError):
        work()
    return time.process_time() - began


def sniff_and_read(name: str, text: str) -> None:
    row = FORMATS[name]
    row.sniff(text)
    row.read(text, "x", ReadOptions())


PREFIXES = ["", "LINE_OFF: ", "lineNumCoef = (", "rpc info = {", "<?xml ", "line_num_coeff: ["]


@pytest.mark.few(6)
@pytest.mark.parametrize(("fill", "prefix"), diagonal(FILLS, PREFIXES, mark=pytest.mark.nightly))
def test_sniffers_and_readers_take_time_in_proportion_to_the_text(fill, prefix):
    small, large = (prefix + FILLS[fill] * n for n in (10_000, 40_000))
    for name in FORMATS:
        last = cpu(partial(sniff_and_read, name, large))
        if last < 0.1:  # below some milliseconds it is the clock that is measured
            continue
        first = min(cpu(partial(sniff_and_read, name, small)) for _ in range(3))
        last = min(last, *(cpu(partial(sniff_and_read, name, large)) for _ in range(2)))
        assert last < max(8 * first, 0.1), name  # a square takes 16 times as long, a cube 64


@pytest.mark.nightly
@pytest.mark.parametrize("fill", rest_slow(["<", "\n", " ", "(", "7", "<a>", "a"], mark=pytest.mark.nightly))
def test_the_largest_rpc_file_that_is_read_ends_in_sensible_time(fill):
    data = (fill * (32 << 20))[: 32 << 20].encode()
    assert cpu(lambda: parse_rpc(b"x" + data[1:], "x")) < 20
    for name in ("txt", "rpb", "xml", "json"):
        assert cpu(partial(sniff_and_read, name, data.decode())) < 60


@pytest.mark.few(8)
@pytest.mark.parametrize(
    ("kind", "fill"),
    diagonal(
        [kind for kind in SAMPLES if not kind.startswith(("rpc", "dem", "state", "grid"))],
        ["\n", " ", "7", "(", "[", ","],
        mark=pytest.mark.nightly,
    ),
)
def test_readers_take_time_in_proportion_to_the_file(kind, fill, tmp_path):
    sample = SAMPLES[kind]
    sample.beside(tmp_path)
    path = tmp_path / sample.name

    def read(n: int) -> float:
        path.write_bytes(sample.data()[:20] + fill.encode() * n)
        return cpu(lambda: sample.read(path))

    first = read(20_000)
    assert any(read(80_000) < max(8 * first, 0.2) for _ in range(3))  # a pause of the machine is no reader's


# --- no way around ----------------------------------------------------------------------------------------

DIRECT = {
    "base/safe_io.py": "the one place",
    "base/atomic.py": "syncs what was written",
    "pipeline/verify_outputs.py": "reopens what barpc has just written, as its consumers do",
    "rasters/raster.py": "images, checked there",
    "base/identity.py": "any input, to hash it: below sidefile, which asks it; regular files only",
    "pointio/tables.py": "no file: lines that were read",
    "base/process.py": "what libraries the process has loaded, as Linux tells",
    "base/sealed.py": "outputs, to hash them, and the state",
    "workspace.py": "barpc's own source, the state",
    "pipeline/executor.py": "arrays that the caller has put down for its workers",
    "cameras.py": "no file: a row of the table of openers",
    "report/runfiles.py": "the schema, which is part of the package",
    "cli/process.py": "the null device",
}
"""Modules that may open a file for reading by themselves, and what they open."""
ARRAYS_OF_A_PATH = ("load", "fromfile", "genfromtxt", "loadtxt")
OF_A_FILE = ("memmap", "ZipFile", "is_zipfile")  # taken of a file that `opened` has opened
OPENS = re.compile(rf"\b({'|'.join((*ARRAYS_OF_A_PATH, *OF_A_FILE, 'open', 'read_text', 'read_bytes'))})\b")


def direct_opens(source: str) -> list[int]:
    """Lines with a call that opens a path for reading by itself."""
    if not OPENS.search(source):  # most modules: they need not be parsed
        return []
    return [node.lineno for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call) and _opens(node)]


def _opens(call: ast.Call) -> bool:
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    words = {getattr(a, "value", None) for a in (*call.args, *(k.value for k in call.keywords))}
    if name in OF_A_FILE:
        return getattr(call.args[0], "id", "") not in ("file", "archive")
    if not isinstance(call.func, ast.Attribute):
        return name == "open"
    owner = getattr(call.func.value, "id", getattr(getattr(call.func.value, "func", None), "attr", ""))
    if name in ARRAYS_OF_A_PATH:
        return owner == "np"
    writes = bool(words & {"w", "wb", "r+b"})
    members = owner in ("archive", "ZipFile", "Dem", "HeightGrid", "Earlier", "FinishedRun", "Sealed", "cls")
    return name in ("open", "read_text", "read_bytes") and not writes and not members


@pytest.mark.slow
def test_no_module_opens_a_file_by_itself():
    root = Path(barpc.__file__).parent
    around = {}
    for path in root.rglob("*.py"):
        name = path.relative_to(root).as_posix()
        if name not in DIRECT and (found := direct_opens(path.read_text())):
            around[name] = found
    assert around == {}


@pytest.mark.parametrize(
    "line",
    ["Path(p).read_text()", "open(p)", "p.open('rb')", "np.load(p)", "os.open(p, 0)", "zipfile.ZipFile(p)",
     "np.memmap(p, mode='r')", "rasterio.open(p)", "p.read_bytes()"],
)  # fmt: skip
def test_a_new_reader_that_goes_around_is_found(line):
    assert direct_opens(line)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("line", ["1,2,3", "", "# no number"])
def test_a_table_of_more_lines_than_memory_is_meant_for_is_refused(line, end, tmp_path):
    path, text = tmp_path / "a.csv", 6 * f"{line}\n"
    path.write_bytes(text.replace("\n", end).encode())
    kind = replace(TABLE, lines=6)
    assert read_text(path, kind) == text
    with opened_text(path, kind) as file:
        assert file.read() == text
    fewer = replace(TABLE, lines=5)
    said = f"{path}: 6 lines, too many for a table of points (at most 5 are read)"
    with pytest.raises(InputError, match=re.escape(said)):
        read_text(path, fewer)
    with pytest.raises(InputError, match=re.escape(said)), opened_text(path, fewer):
        pass


def test_a_line_of_a_table_without_end_is_refused_and_long_ones_are_read(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(f"x\n{'a,' * (MAX_LINE_BYTES // 2 - 1)}\nx\n")
    assert len(read_text(path, TABLE)) == MAX_LINE_BYTES + 3
    path.write_text(f"x\n{'a,' * MAX_LINE_BYTES}\nx\n")
    with pytest.raises(InputError, match=f"a line of more than {MAX_LINE_BYTES} bytes, too long for a table of points"):
        read_text(path, TABLE)
    assert len(read_text(path, GEOJSON)) == 2 * MAX_LINE_BYTES + 5  # of one line, as most are


@pytest.mark.parametrize(
    ("text", "values"),
    [('{"a": [1, 1, 1]}', 5), ("[[[[[]]]]]", 5), ('[{"a": 1}, {}]', 5), ('["a,b:c[d{"]', 5)],
    ids=["numbers", "levels", "objects", "an upper bound"],
)
def test_what_a_json_holds_is_counted_before_it_is_parsed(text, values, tmp_path):
    path = tmp_path / "a.json"
    path.write_text(text)
    assert read_json(path, replace(GEOJSON, values=values)) == json.loads(text)
    with pytest.raises(InputError, match=f"{values} values, at most {values - 1} are read"):
        read_json(path, replace(GEOJSON, values=values - 1))
    assert (parse_json("[]"), GEOJSON.values, SUMMARY.values) == ([], 8 * MB, 32 * MB)


def test_a_path_that_not_every_file_can_hold_is_refused(tmp_path):
    assert plain_path(tmp_path / "a é b.tif") == tmp_path / "a é b.tif"
    for char, what in (("\n", r"the character '\\n'"), ("\x7f", "the character"), ("\\", "the character"),
                       ("\u2028", "the character"), ("\uffff", "the character"), ("\udc80", "bytes that are not UTF-8"),
                       ("\udfff", "bytes that are not UTF-8"), ("\ud800", "bytes that are not UTF-8")):  # fmt: skip
        with pytest.raises(InputError, match=f"its path holds {what}.*, which not every file and tool takes"):
            plain_path(f"a{char}b.tif")


def test_a_list_of_names_has_no_endless_line(tmp_path):
    path = tmp_path / "names.txt"
    path.write_text("a\n" + "b" * 16384 + "\n")
    assert [len(one) for one in read_names(path, "a list")] == [1, 16384]
    path.write_text("a\n" + "b" * 16385 + "\n")
    with pytest.raises(InputError, match=r"names.txt, line 2: 16385 characters, no name is so long"):
        read_names(path, "a list")


def test_a_zarr_store_is_called_by_its_name(tmp_path):
    (tmp_path / "b").mkdir()
    assert unread(tmp_path / "b") == unread(tmp_path / "a.zip") == ""
    (tmp_path / "b/.zgroup").write_text("{}")
    for name in ("b", "a.zarr", "A.ZARR.zip"):
        assert unread(tmp_path / name).startswith("; a Zarr store, which is not read")
