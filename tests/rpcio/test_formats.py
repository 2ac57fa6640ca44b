"""Every syntax of RPC files: what is written reads back to the bit, and dialects read as meant."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from barpc.base.errors import ImageError, RpcFormatError
from barpc.rpcio import FORMATS, read_rpc, read_rpc_source, write_rpc
from barpc.rpcio.formats import parse_rpc
from barpc.rpcio.text import COEFFICIENTS, OFFSETS, SCALES, fields_from_rpc, write_rpb, write_txt
from tests.rpcio.conftest import DIALECTS, WRITABLE, alos, dimap_v2, each_written, enmap, envi, grid, make_rpc

NAMES = [f"scene{case}" for row in WRITABLE for end in row.suffixes for case in dict.fromkeys((end, end.lower()))]


@pytest.mark.parametrize("name", NAMES)
def test_what_is_written_reads_back_to_the_bit(name, rpc, tmp_path):
    write_rpc(rpc, tmp_path / name)
    assert read_rpc(tmp_path / name) == rpc


@each_written
def test_an_unknown_accuracy_is_never_written_as_perfect(row):
    unknown = make_rpc(err_bias=None, err_rand=None)
    text = row.write(unknown)
    found, name = parse_rpc(text.encode(), "memory")
    assert name == row.name
    assert (found.err_bias, found.err_rand) == (None, None)
    if row.name != "geom":  # OSSIM asks for the keys, and takes 0 for unknown
        assert not re.search(r"err", text, re.IGNORECASE)


def test_an_accuracy_of_zero_in_a_file_is_unknown(rpc):
    text = write_rpb(rpc).replace("errBias = 3.1", "errBias = 0.0")
    assert parse_rpc(text.encode(), "memory")[0].err_bias is None


@pytest.mark.parametrize("name", ["a.tif", "a.doc", "a"])
def test_a_name_that_no_format_has_is_refused_with_the_ones_that_are(name, rpc, tmp_path):
    with pytest.raises(RpcFormatError, match=r"choose one of txt .*\.geom"):
        write_rpc(rpc, tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("dialect", [name for name in DIALECTS if name != "enmap"])
def test_a_dialect_that_is_only_read_gives_the_camera_that_went_in(dialect, rpc):
    found, name = parse_rpc(DIALECTS[dialect](rpc).encode(), "memory")
    assert name == dialect.split()[0]
    np.testing.assert_allclose(found.project(grid(rpc)), rpc.project(grid(rpc)), rtol=0, atol=1e-9)


def test_enmap_has_an_rpc_for_every_band(rpc, tmp_path):
    path = tmp_path / "METADATA.XML"
    path.write_text(enmap(rpc))
    shift = read_rpc(path).project(grid(rpc)) - read_rpc(path, band=2).project(grid(rpc))
    np.testing.assert_allclose(shift, [[0.0, 100.0]] * len(shift), atol=1e-9)
    with pytest.raises(RpcFormatError, match="no RPC of band 3"):
        read_rpc(path, band=3)


@pytest.mark.parametrize(("first", "shift"), [(None, 0.0), (1.0, 0.0), (0.5, 0.5), (0.0, 1.0)])
def test_the_pixel_convention_of_a_dimap_can_be_overruled(first, shift, rpc, tmp_path):
    """Airbus counts from 1; SPOT 6/7 is disputed: some tools subtract nothing."""
    path = tmp_path / "RPC_S6.XML"
    path.write_text(dimap_v2(rpc))
    found = read_rpc(path, first_pixel=first)
    np.testing.assert_allclose(found.image_offset, rpc.image_offset + shift, rtol=0, atol=1e-12)


def test_the_direct_model_and_the_fit_error_of_a_dimap_are_left_behind(rpc):
    found, _ = parse_rpc(dimap_v2(rpc).encode(), "memory")
    assert found.err_bias is None  # ERR_BIAS_ROW is in pixels, of the vendor's own fit
    for row in WRITABLE:
        assert "7.5" not in row.write(found)


def test_maxar_xml_reads_in_a_namespace_too(rpc):
    text = FORMATS["xml"].write(rpc)
    spaced = re.sub(r"<(/?)([A-Za-z]+)", r"<\1lv1b:\2", text).replace("<lv1b:isd>", '<lv1b:isd xmlns:lv1b="http://x">')
    assert parse_rpc(spaced.encode(), "memory") == (rpc, "xml")


def test_maxar_xml_may_begin_with_its_rpb_and_say_nothing_of_errors(rpc):
    text = FORMATS["xml"].write(rpc)
    bare = text.replace("<isd>\n", "").replace("</isd>\n", "")
    assert bare != text
    assert parse_rpc(bare.encode(), "memory") == (rpc, "xml")
    silent = re.sub(r".*<ERR(BIAS|RAND)>.*\n", "", text)
    assert parse_rpc(silent.encode(), "memory") == (replace(rpc, err_bias=None, err_rand=None), "xml")
    nameless = re.sub(r".*<SPECID>.*\n", "", text)
    assert parse_rpc(nameless.encode(), "memory") == (rpc, "xml")
    with pytest.raises(RpcFormatError, match="order 'RPC00C', only RPC00A and RPC00B"):
        parse_rpc(text.replace("RPC00B", "RPC00C").encode(), "memory")
    with pytest.raises(RpcFormatError, match="<LATSCALE> is missing or empty"):
        parse_rpc(re.sub(r".*<LATSCALE>.*\n", "", text).encode(), "memory")


def test_an_envi_header_may_leave_its_last_three_numbers_out(rpc):
    text = envi(rpc)
    less = re.sub(r",\s*0,\s*0,\s*1\s*}", "}", text)
    assert less != text
    assert parse_rpc(less.encode(), "memory")[0] == parse_rpc(text.encode(), "memory")[0]
    for wrong, count in ((text.replace("}", ", 0}"), 94), (less.replace("}", ", 0}"), 91)):
        with pytest.raises(RpcFormatError, match=f"rpc info has {count} numbers, expected 90 or 93"):
            parse_rpc(wrong.encode(), "memory")


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda t: t.replace("\n", "\r\n"), "CRLF"),
        (lambda t: t.replace("\n", "\r\r\n"), "CR CR LF"),
        (lambda t: "\ufeff" + t, "a byte order mark"),
        (lambda t: re.sub(r"(LAT_OFF: \S+)", r"\1 degrees", t), "units"),
        (lambda t: re.sub(r"(LAT_OFF: \S+)", r"\1 °", t), "a degree sign"),
        (lambda t: re.sub(r": (\d)", r": +00\1", t), "signs and leading zeros"),
        (lambda t: t.replace("e-", "D-"), "D exponents"),
        (lambda t: t.replace("LINE_", "line_"), "lower case"),
        (lambda t: t.replace(": ", " = "), "equals signs"),
        (lambda t: "\n".join(reversed(t.splitlines())), "another order"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_the_text_format_is_read_with(change, what, rpc):
    assert parse_rpc(change(write_txt(rpc)).encode(), "memory") == (rpc, "txt")


def test_a_latin_1_degree_sign_is_read(rpc):
    assert parse_rpc(write_txt(rpc).replace("LAT_OFF: 43.2", "LAT_OFF: 43.2 °").encode("latin-1"), "m")[0] == rpc


def test_a_denominator_that_does_not_start_with_one_is_kept(rpc):
    text = write_txt(rpc).replace("LINE_DEN_COEFF_1: 1\n", "LINE_DEN_COEFF_1: 0.99995\n")
    assert parse_rpc(text.encode(), "memory")[0].coeffs[3, 0] == 0.99995


def test_both_dialects_of_json_are_read(rpc):
    rpcm = FORMATS["json"].write(rpc)
    plain = {key.lower(): v[0] if len(v) == 1 else v for key, v in fields_from_rpc(rpc).items()}
    gdal = {key: str(v[0]) if len(v) == 1 else " ".join(map(repr, v)) for key, v in fields_from_rpc(rpc).items()}
    bare = json.loads(rpcm)["rpc"]
    for document in (json.loads(rpcm), bare, plain, {"rpcs": plain}, gdal):
        assert parse_rpc(json.dumps(document).encode(), "memory") == (rpc, "json")


def test_an_rpc_may_lie_three_objects_deep_in_json_and_no_deeper(rpc):
    document = json.loads(FORMATS["json"].write(rpc))["rpc"]
    for depth in range(4):
        assert parse_rpc(json.dumps(document).encode(), "memory") == (rpc, "json"), depth
        document = {"other": [1, 2], "inner": document}
    with pytest.raises(RpcFormatError):
        parse_rpc(json.dumps(document).encode(), "memory")


def test_alos_columns_are_read(tmp_path):
    path = tmp_path / "RPC-ALPSMW000000000-O1B1___W.txt"
    path.write_text(alos() + "\r\n")
    source = read_rpc_source(path)
    assert source.format == "alos"
    np.testing.assert_array_equal(source.rpc.ground_offset, [-139.7671, -35.6812, 500.0])
    np.testing.assert_array_equal(source.rpc.ground_scale, [0.35, 0.3, 510.0])
    np.testing.assert_array_equal(source.rpc.image_offset, [3550.0, 6500.0])
    np.testing.assert_array_equal(source.rpc.image_scale, [3551.0, 6501.0])
    np.testing.assert_array_equal(source.rpc.coeffs[:, 2], [3.25e-2, 4.25e-2, 1.25e-2, 2.25e-2])


# --- how other constellations write the known syntaxes ------------------------------------------------------

# Written here after public descriptions, of no product: BlackSky and SkySat are told of as `_rpc.txt` with these keys
# (ossimlabs/ossim, pull request 264), GDAL's manual has KOMPSAT's and EROS' .rpc and Maxar's .RPB and XML. ZY-3, GF-7,
# SuperView and Jilin-1 are delivered as .rpb or _rpc.txt; their signs and blanks are taken to be as theirs.


def _signed(text: str) -> str:
    return re.sub(r": (\d)", r": +\1", text)


def _units(text: str) -> str:
    units = {"LINE": "pixels", "SAMP": "pixels", "LAT": "degrees", "LONG": "degrees", "HEIGHT": "meters"}
    return re.sub(r"(?m)^((LINE|SAMP|LAT|LONG|HEIGHT)_(OFF|SCALE): \S+)$", lambda m: f"{m[1]} {units[m[2]]}", text)


def _in_lines(text: str) -> str:
    """Twenty coefficients in a line, as GDAL shows them."""
    keys = ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF")
    lists = [f"  {key}={' '.join(re.findall(rf'(?m)^{key}_[0-9]+: (.*)$', text))}" for key in keys]
    return "\n".join([*(line for line in text.splitlines() if "COEFF" not in line), *lists])


CONSTELLATIONS = {
    "GDAL's own listing: coefficients in lines": ("txt", _in_lines),
    "GF: .rpb without semicolons, signs behind tabs": (
        "rpb",
        lambda t: re.sub(r"= (\d)", r"= \t+\1", t).replace(";", ""),
    ),
    "BlackSky, Satellogic: _rpc.txt in any order": ("txt", lambda t: "\n".join(sorted(t.splitlines()))),
    "KOMPSAT, ZY-3, Jilin-1: signs and units": ("txt", lambda t: _units(_signed(t))),
    "GF-7, SuperView: .rpb with CRLF and tabs": (
        "rpb",
        lambda t: t.replace('"????"', '"GF7"').replace("\n", "\r\n").replace(" = ", "=\t"),
    ),
    "GF-7: a list that closes on a line of its own": ("rpb", lambda t: t.replace(");", "\n\t\t\t);")),
    "Legion: image support data in full": (
        "xml",
        lambda t: t.replace("<isd>", "<isd><IMD><IMAGE><SATID>LG01</SATID></IMAGE></IMD><EPH/><ATT/><GEO/>"),
    ),
}


@pytest.mark.parametrize("constellation", CONSTELLATIONS)
def test_a_constellation_s_way_of_writing_is_read(constellation, rpc):
    kind, change = CONSTELLATIONS[constellation]
    assert FORMATS[kind].write is not None
    text = FORMATS[kind].write(rpc)
    assert change(text) != text
    assert parse_rpc(change(text).encode(), "memory") == (rpc, kind)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("rowOff: 1\ncolOff: 2\nrowNum_1: 3\nrowNum_2: 4\n", "alos\\)$"),
        ("<Doc><Date>x</Date><RFM><LineNum>1 2</LineNum></RFM></Doc>", "alos\\)$"),
        ('{"date": 1, "camera": {"rpcCoeffs": [1, 2]}}', "alos\\)$"),
        ("1 2 3 4", "alos\\)$"),
        ("<isd><ATT><ATTLISTList><ATTLIST>1</ATTLIST></ATTLISTList></ATT></isd>", "model=physical$"),
        (
            "<Dimap_Document><Geometric_Data><Refined_Model/></Geometric_Data></Dimap_Document>",
            "model=physical$",
        ),
    ],
)
def test_an_unknown_file_is_refused_with_what_is_known(text, found):
    with pytest.raises(RpcFormatError, match=found) as told:
        parse_rpc(text.encode(), "memory")
    assert "known: txt, rpb" in str(told.value)


def test_hdf5_is_named_as_what_is_not_read(tmp_path):
    path = tmp_path / "PRS_L1.he5"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(200))
    with pytest.raises(ImageError, match=r"not a raster that is read here .*write its coefficients as an _RPC\.TXT"):
        read_rpc(path)


def plain(rpc, order: tuple[str, ...] = (*OFFSETS, *SCALES, *COEFFICIENTS)) -> list[str]:
    """The numbers of an RPC without their names."""
    fields = fields_from_rpc(rpc)
    return [repr(value) for key in order for value in fields[key]]


@pytest.mark.parametrize("between", [",", " ", "\n", ", ", " ,\r\n", "\t"])
def test_numbers_without_names_are_read_in_the_order_of_envi(between, rpc):
    text = between.join(plain(rpc)) + "\n"
    found, kind = parse_rpc(text.encode(), "memory")
    assert kind == "bare"
    assert found == replace(rpc, err_bias=None, err_rand=None)
    assert parse_rpc((text + "0 0 1").encode(), "memory") == (found, "bare")


def test_numbers_without_names_that_are_no_rpc_are_refused_with_what_was_found(rpc):
    with pytest.raises(RpcFormatError, match=r"would begin with .*those of an RPC begin with 1"):
        parse_rpc(" ".join(plain(rpc, (*OFFSETS, *SCALES, *reversed(COEFFICIENTS)))).encode(), "memory")
    for wrong in (plain(rpc)[:-1], [*plain(rpc), "1"], [*plain(rpc)[:-1], "x"]):
        with pytest.raises(RpcFormatError, match="no RPC format recognised"):
            parse_rpc(",".join(wrong).encode(), "memory")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
@each_written
def test_a_text_in_utf_16_is_read(row, encoding, rpc, tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(row.write(rpc).encode(encoding))
    assert read_rpc_source(path).rpc == rpc
