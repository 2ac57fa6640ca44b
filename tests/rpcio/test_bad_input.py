"""Files that are damaged or hostile: one line that names the file, never anything else.

Of damage anywhere, of flipped bytes and of edits: `tests/fuzz/test_readers.py`.
"""

from __future__ import annotations

import contextlib
import os
import re
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from barpc.base.errors import BarpcError, ImageError, RpcFormatError
from barpc.base.safe_io import RPC_FILE
from barpc.rpcio import read_rpc, write_rpc_copy
from barpc.rpcio.formats import parse_rpc
from barpc.rpcio.images import RPC_TAG, read_directory, tag_values
from tests.rpcio.conftest import DIALECTS, WRITABLE, each_written, make_rpc, write_image

RPC = make_rpc()
SAMPLES = {row.name: row.write(RPC) for row in WRITABLE} | {name: make(RPC) for name, make in DIALECTS.items()}
each_sample = pytest.mark.parametrize("sample", SAMPLES)


def outcome(data: bytes) -> str:
    """What becomes of a file's bytes: "read", or the message of the one error that is allowed."""
    try:
        parse_rpc(data, "bad.file")
    except RpcFormatError as error:
        message = str(error)
        assert message.startswith("bad.file"), message
        assert len(message) < 500
        return message
    return "read"


@each_sample
def test_a_file_that_is_cut_off_anywhere_in_its_numbers_is_refused(sample):
    data = SAMPLES[sample].encode()
    last = max(
        m.end() for m in re.finditer(rb"SAMP_DEN|samp_den|sampDen|col_den|COL_DEN|SAMPDEN|</F_ROW|,\n  1(?=})", data)
    )
    for size in np.linspace(1, last, 60).astype(int):
        assert outcome(data[:size]) != "read", size


@each_sample
@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "NaN", "1e999", "abc", ""])
def test_a_coefficient_that_is_no_finite_number_is_refused(sample, value):
    text = SAMPLES[sample]
    number = repr(float(RPC.coeffs[0, 1]))
    assert number in text
    assert outcome(text.replace(number, value, 1).encode()) != "read"


@each_written
@pytest.mark.parametrize("scale", [980.9, 1010.3, 0.0062, 0.0045])
def test_a_scale_of_zero_is_refused(row, scale):
    text = re.sub(rf"(?<![\d.]){re.escape(str(scale))}(?!\d)", "0", row.write(RPC))
    assert "scale" in outcome(text.encode())


@each_written
def test_a_missing_field_is_named(row):
    lines = row.write(RPC).splitlines(keepends=True)
    needle = re.compile(r"height.?off|alt_offset", re.IGNORECASE)
    message = outcome("".join(line for line in lines if not needle.search(line)).encode())
    assert re.search(r"HEIGHT_?OFF|HEIGHTOFFSET", message)


def test_nineteen_and_twenty_one_coefficients_are_refused():
    text = SAMPLES["txt"]
    assert "expected 20" in outcome(text.replace("LINE_NUM_COEFF_20", "LINE_NUM_COEFF_21").encode())
    assert "expected 20" in outcome((text + "LINE_NUM_COEFF_21: 1\n").encode())
    assert "expected 20" in outcome((text + f"LINE_NUM_COEFF_{'1' * 5000}: 1\n").encode())
    assert "given twice" in outcome((text + "LINE_NUM_COEFF_01: 3\n").encode())
    assert "19 numbers" in outcome(re.sub(r"lineNumCoef = \(\n[^\n]*\n", "lineNumCoef = (\n", SAMPLES["rpb"]).encode())


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"   \n\n",
        b"hello",
        b"\x00\xff\xfe" * 50,
        b"{",
        b"{}",
        b"[1, 2]",
        b"<a>",
        b"<a/>",
        b"%PDF-1.4",
        b"\xef\xbb\xbf",
    ],
)
def test_what_is_no_rpc_file_is_refused(data):
    assert outcome(data) != "read"


def test_a_huge_file_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "huge_RPC.TXT"
    with path.open("wb") as file:
        file.write(b"LINE_OFF: 1\n")
        file.truncate(1 << 40)
    with pytest.raises(BarpcError):  # zeros: no text
        read_rpc(path)
    assert "too large" in outcome(b"x" * (RPC_FILE.most + 1))


def test_json_that_nests_without_end_is_refused():
    assert outcome(b'{"row_num": ' + b"[" * 100_000) != "read"
    assert outcome(b'{"a":' * 5000 + b'"row_num"' + b"}" * 5000) != "read"


@pytest.mark.parametrize("sample", ["xml", "dimap v2", "dimap v3", "enmap"])
def test_an_entity_bomb_is_refused(sample):
    bomb = '<!DOCTYPE lolz [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]>'
    text = re.sub(r"^<\?xml[^>]*\?>", "", SAMPLES[sample])
    assert "DOCTYPE" in outcome((bomb + text).encode())
    assert outcome((f'<?xml version="1.0"?>{bomb}' + text).encode("utf-16")) != "read"


@pytest.mark.parametrize("encoding", ["utf-16", "utf-32", "utf-7"])
@each_sample
def test_an_unexpected_encoding_is_refused_or_read_the_same(sample, encoding):
    data = SAMPLES[sample].encode(encoding)
    if outcome(data) == "read":
        assert parse_rpc(data, "bad.file")[0].coeffs.shape == (4, 20)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=400))
def test_any_bytes_are_refused(data):
    assert outcome(data) != "read"  # 400 bytes hold no 80 coefficients


@pytest.fixture
def tagged(tmp_path):
    """A small image with the RPC in its tag."""
    write_rpc_copy(RPC, write_image(tmp_path / "a.tif", shape=(1, 4, 4)), tmp_path / "b.tif")
    return tmp_path / "b.tif"


def test_a_tiff_with_any_byte_of_its_directory_flipped_never_raises_anything_else(tagged, tmp_path):
    data = tagged.read_bytes()
    rng = np.random.default_rng(3)
    directory = np.concatenate([np.arange(16), np.arange(len(data) - 320, len(data))])
    for position in rng.choice(directory, 300):
        broken = bytearray(data)
        broken[position] ^= 1 << rng.integers(0, 8)
        (tmp_path / "c.tif").write_bytes(broken)
        with contextlib.suppress(RpcFormatError, ImageError):
            read_rpc(tmp_path / "c.tif")


@pytest.mark.parametrize("index", [2, 7, 12, 50])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_tag_with_a_number_that_is_not_finite_is_refused(index, value, tagged):
    values = tag_values(RPC)
    bent = struct.pack("<92d", *[value if i == index else v for i, v in enumerate(values)])
    tagged.write_bytes(tagged.read_bytes().replace(struct.pack("<92d", *values), bent))
    with pytest.raises(RpcFormatError, match=r"b\.tif.*not finite"):
        read_rpc(tagged)


def test_a_tag_with_the_wrong_count_is_refused(tagged):
    with tagged.open("rb") as file:
        assert read_directory(file, "b.tif").find(RPC_TAG).count == 92
    right, wrong = (struct.pack("<HHI", RPC_TAG, 12, count) for count in (92, 91))
    tagged.write_bytes(tagged.read_bytes().replace(right, wrong))
    with pytest.raises(RpcFormatError, match="91 values"):
        read_rpc(tagged)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ImageError, match="a pipe"):
        read_rpc(tmp_path / "pipe")
