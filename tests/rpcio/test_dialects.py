"""What other tools write of one RPC, in their own words: units, indices from 0, prefixes, orders, adjustments."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio

from barpc.base.errors import Remark, RpcFormatError
from barpc.rpcio import FORMATS, read_rpc, write_camera, write_rpc
from barpc.rpcio.formats import parse_rpc
from barpc.rpcio.sources import stated_in_xml
from barpc.rpcio.text import COEFFICIENTS, KEYS, fields_from_rpc
from barpc.sensor.rpc import RPC
from tests.rpcio.conftest import A_ORDER, grid, in_order, make_rpc, polynomials, rpc_domain, write_image, write_nitf

UNITS = {"LINE": "pixels", "SAMP": "pixels", "LAT": "degrees", "LONG": "degrees", "HEIGHT": "meters", "ERR": "meters"}


def written(fields, units=UNITS, key=lambda name: name):
    """A line each number, with its unit behind."""
    lines = []
    for name, values in fields.items():
        unit = units.get(name.split("_")[0], "") if len(values) == 1 else ""
        names = [f"{name}_{i}" for i in range(1, 21)] if len(values) > 1 else [name]
        lines += [f"{key(n)}: {value!r} {unit}".rstrip() for n, value in zip(names, values, strict=True)]
    return "\n".join(lines) + "\n"


def read(text):
    return parse_rpc(text.encode(), "memory")[0]


# --- units ------------------------------------------------------------------------------------------------


def domain_with(units):
    """GDAL's metadata with a unit behind every offset and scale."""
    text = f"<PAMDataset>\n{rpc_domain(make_rpc())}\n</PAMDataset>\n"

    def unit(match):
        return f"{match[1]} {units[match[2].split('_')[0]]}</MDI>"

    return re.sub(r'(<MDI key="(\w+_(?:OFF|SCALE|BIAS|RAND))">[^<]*)</MDI>', unit, text)


SAME = [
    UNITS,
    dict(UNITS, HEIGHT="metres", LAT="deg", LINE="px", SAMP="lines"),
    dict(UNITS, HEIGHT="m above the ellipsoid", LAT="°", LONG="Degrees.", ERR="(m)"),
    dict(UNITS, HEIGHT="[metre]", LAT="decimal degrees", LINE="// of the image", SAMP="# of the centre"),
]


@pytest.mark.parametrize("units", SAME)
def test_a_unit_behind_a_number_says_what_is_meant_anyway(units, rpc):
    assert read(written(fields_from_rpc(rpc), units)) == rpc
    assert read(domain_with(units)) == rpc


def test_a_unit_is_read_in_every_syntax_of_numbers(rpc):
    for name, old, new in (
        ("rpb", "heightOffset = 166.6667;", "heightOffset = 166.6667 meters;"),
        ("xml", "<LATSCALE>0.0045<", "<LATSCALE>0.0045 degrees<"),
        ("json", '"row_offset": 950.7', '"row_offset": "950.7 pixels"'),
        ("geom", "height_scale:  142.8571", "height_scale:  142.8571 m"),
        ("txt", "LINE_OFF: 950.7", "LINE_OFF: 950.7pixels"),
    ):
        text = FORMATS[name].write(rpc)
        assert old in text
        assert read(text.replace(old, new)) == rpc, name


@pytest.mark.parametrize(
    ("unit", "size"),
    [("feet", 0.3048), ("ft", 0.3048), ("Foot", 0.3048), ("US survey feet", 1200 / 3937), ("ftUS", 1200 / 3937)],
)
def test_heights_in_feet_are_converted_offset_and_scale_alike(unit, size, rpc):
    """A polynomial of normalised heights is the same in every unit: offset and scale are all there is to convert."""
    fields = fields_from_rpc(rpc)
    for key in ("HEIGHT_OFF", "HEIGHT_SCALE"):
        fields[key] = [fields[key][0] / size]
    for text in (written(fields, dict(UNITS, HEIGHT=unit)), json_of(fields, unit)):
        found = read(text)
        np.testing.assert_allclose(found.project(grid(rpc)), rpc.project(grid(rpc)), rtol=0, atol=1e-8)
        assert found.ground_scale[2] == pytest.approx(rpc.ground_scale[2], rel=1e-14)


def json_of(fields, unit):
    named = {key.lower(): values if len(values) > 1 else values[0] for key, values in fields.items()}
    return json.dumps({key: f"{v} {unit}" if key.startswith("height") else v for key, v in named.items()})


def test_angles_in_radians_and_accuracies_in_feet_are_converted(rpc):
    fields = fields_from_rpc(rpc)
    for key in ("LAT_OFF", "LAT_SCALE", "LONG_OFF", "LONG_SCALE"):
        fields[key] = [float(np.radians(fields[key][0]))]
    fields["ERR_BIAS"] = [10.0]
    found = read(written(fields, dict(UNITS, LAT="radians", LONG="rad", ERR="feet")))
    np.testing.assert_allclose(found.project(grid(rpc)), rpc.project(grid(rpc)), rtol=0, atol=1e-6)
    assert found.err_bias == pytest.approx(3.048, rel=1e-14)


@pytest.mark.parametrize(
    ("axis", "unit", "expected"),
    [
        ("HEIGHT", "yards", "metres"),
        ("HEIGHT", "degrees", "metres"),
        ("HEIGHT", "km", "metres"),
        ("LINE", "meters", "pixels"),
        ("LAT", "gon", "degrees"),
        ("LAT", "arc seconds", "degrees"),
        ("LONG", "° W", "degrees"),
        ("LAT", "S", "degrees"),
        ("ERR", "pixels", "metres"),
    ],
)
def test_what_is_no_unit_of_a_field_is_refused_by_name(axis, unit, expected, rpc):
    for text in (written(fields_from_rpc(rpc), dict(UNITS, **{axis: unit})), domain_with(dict(UNITS, **{axis: unit}))):
        with pytest.raises(RpcFormatError, match=rf"memory: {axis}_\w+ is in '{unit}', expected {expected}"):
            read(text)


def test_feet_of_an_offset_alone_say_nothing_of_the_scale(rpc):
    text = FORMATS["txt"].write(rpc)
    for one, other in (("OFF", "SCALE"), ("SCALE", "OFF")):
        half = re.sub(rf"(HEIGHT_{one}: \S+)", r"\1 feet", text)
        with pytest.raises(RpcFormatError, match="HEIGHT_OFF and HEIGHT_SCALE one states a unit"):
            read(half)
        both = re.sub(rf"(HEIGHT_{other}: \S+)", r"\1 metres", half)
        assert read(both).ground_scale[2] == pytest.approx(rpc.ground_scale[2] * (0.3048 if one == "SCALE" else 1))
        assert read(re.sub(rf"(HEIGHT_{one}: \S+)", r"\1 metres", text)) == rpc


# --- names and indices ------------------------------------------------------------------------------------


@pytest.mark.parametrize("digits", ["", "02"])
@pytest.mark.parametrize("first", [0, 1])
def test_coefficients_may_be_numbered_from_0(first, digits, rpc):
    text = FORMATS["txt"].write(rpc)
    text = re.sub(r"(COEFF_)(\d+):", lambda m: f"{m[1]}{int(m[2]) - 1 + first:{digits}}:", text)
    assert f"COEFF_{19 + first}:" in text
    assert read(text) == rpc


@pytest.mark.parametrize("prefix", ["RPC_", "rpc.", "Image0.", "RPC_METADATA_"])
@pytest.mark.parametrize("separator", ["=", ": "])
def test_keys_may_have_a_prefix_all_of_them_the_same(prefix, separator, rpc):
    text = re.sub(r"(?m)^(\w+): ", rf"{prefix}\1{separator}", FORMATS["txt"].write(rpc))
    assert f"{prefix}LINE_OFF{separator}950.7" in text
    assert read(text) == rpc
    assert read(text + "OTHER_ERR_BIAS: 77\n") == rpc
    second = text.replace(prefix, "B_" + prefix)
    with pytest.raises(RpcFormatError, match="RPCs of several images"):
        read(text + second)


def test_a_key_without_a_prefix_goes_before_others(rpc):
    assert read("SCENE_LINE_OFF: 1\n" + FORMATS["txt"].write(rpc) + "SCENE_LAT_OFF: 7\n") == rpc


def test_a_geom_may_have_a_prefix(rpc):
    text = re.sub(r"(?m)^", "image0.", FORMATS["geom"].write(rpc).rstrip("\n")) + "\n"
    assert read(text) == rpc


# --- the order of the terms -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("rpb", 'SpecId = "RPC00B"', 'SpecId = "RPC00A"'),
        ("xml", "<SPECID>RPC00B<", "<SPECID>RPC00A<"),
        ("geom", "polynomial_format:  B", "polynomial_format:  A"),
    ],
)
def test_the_order_that_a_file_states_is_the_order_of_its_terms(name, old, new, rpc):
    """The file's numbers, summed in the order of RPC00A (STDI-0002), not by a permutation of ours."""
    text = FORMATS[name].write(rpc)
    assert old in text
    found, points = read(text.replace(old, new)), grid(rpc)
    np.testing.assert_allclose(rpc.project(points), in_order(rpc, points), rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.project(points), in_order(rpc, points, A_ORDER), rtol=0, atol=1e-8)
    assert np.abs(found.project(points) - rpc.project(points)).max() > 1e-3
    with pytest.raises(RpcFormatError, match="only RPC00A and RPC00B are read"):
        read(text.replace(old, new.replace("RPC00A", "RPC00Z").replace("  A", "  Z")))
    if name != "geom":  # by others than the vendor
        assert read(text.replace(old, new.replace("RPC00A", "XXX"))) == rpc


def rpc_of_fitting_numbers():
    """Every number as the record holds it, every coefficient at work."""
    coeffs = np.round(np.random.default_rng(9).uniform(-1, 1, (4, 20)) * 0.01, 6)
    coeffs[1::2] *= 0.1
    coeffs[:, 0] = [0.01, 1.0, -0.02, 1.0]
    coeffs[0, 1], coeffs[2, 2] = 0.9, -0.9
    return RPC(np.round(coeffs, 6), [5.4, 43.2, 500.0], [0.1, 0.2, 500.0], [999.0, 950.0], [1010.0, 980.0])


def test_the_terms_of_an_rpc00a_record_stand_in_their_own_order(tmp_path):
    """The record's numbers, used in the order of RPC00A (GDAL takes terms 7 to 10 otherwise: no oracle here)."""
    rpc = rpc_of_fitting_numbers()
    path = tmp_path / "a.ntf"
    write_nitf(rpc, write_image(tmp_path / "scene.tif"), path)
    data = path.read_bytes()
    assert data.count(b"RPC00B01041") == 1
    path.write_bytes(data.replace(b"RPC00B01041", b"RPC00A01041"))
    found = read_rpc(path)
    ground = grid(rpc)
    np.testing.assert_allclose(found.project(ground), in_order(rpc, ground, A_ORDER), atol=1e-8)
    assert np.abs(found.project(ground) - rpc.project(ground)).max() > 1.0


def test_a_record_says_of_itself_that_it_is_valid(tmp_path):
    path = tmp_path / "a.ntf"
    write_nitf(rpc_of_fitting_numbers(), write_image(tmp_path / "scene.tif"), path)
    path.write_bytes(path.read_bytes().replace(b"RPC00B010411", b"RPC00B010410"))
    with pytest.raises(Exception, match="SUCCESS flag"):
        read_rpc(path)


# --- OSSIM's adjustments ----------------------------------------------------------------------------------


def adjusted(rpc, *sizes, number=0, current=0, sigma=(50, 50, 50, 50, 0.1), center=(0, 0, 0, 0, 0)):
    """A .geom whose adjustments add up to `sizes`: rows, columns, scale of rows, of columns, rotation [deg]."""
    lines = [f"current_adjustment:  {current}", f"number_of_adjustments:  {number + 1}"]
    for i, (size, s, c) in enumerate(zip(sizes, sigma, center, strict=False)):
        head = f"adjustment_{number}.adj_param_{i}"
        lines += [f"{head}.center:  {c}", f"{head}.parameter:  {(size - c) / s!r}", f"{head}.sigma:  {s}"]
        lines += [f"{head}.description:  any", f"{head}.units:  pixel", f"{head}.lock_flag:  0"]
    return FORMATS["geom"].write(rpc) + "\n".join(lines) + "\n"


def by_ossim(rpc, points, rows, cols, row_scale, col_scale, turn):
    """ossimRpcModel::worldToLineSample, in its own letters."""
    pv, qv, pu, qu = polynomials(rpc, points)
    u_rot, v_rot, a = pu / qu, pv / qv, np.radians(turn)
    u, v = u_rot * np.cos(a) + v_rot * np.sin(a), v_rot * np.cos(a) - u_rot * np.sin(a)
    line = u * (rpc.image_scale[1] + row_scale) + rpc.image_offset[1] + rows
    samp = v * (rpc.image_scale[0] + col_scale) + rpc.image_offset[0] + cols
    return np.column_stack([samp, line])


@pytest.mark.parametrize(
    "sizes", [(25.0, -10.0, 0, 0, 0), (0, 0, 3.5, -1.25, 0), (7.0, 3.0, -2.0, 4.0, 0), (0.0,) * 5, (1.5, 0.25)]
)
def test_adjustments_of_offset_and_scale_are_applied_as_ossim_applies_them(sizes, rpc):
    found = read(adjusted(rpc, *sizes))
    expected = by_ossim(rpc, grid(rpc), *sizes, *[0.0] * (5 - len(sizes)))
    np.testing.assert_allclose(found.project(grid(rpc)), expected, rtol=0, atol=1e-8)
    assert (found == rpc) == (not any(sizes))


def test_a_center_counts_and_the_adjustment_in_use_is_the_current_one(rpc):
    sizes = (25.0, -10.0, 1.0, 2.0, 0.0)
    expected = by_ossim(rpc, grid(rpc), *sizes)
    found = read(adjusted(rpc, *sizes, center=(20, -11, 3, 1, 0)))
    np.testing.assert_allclose(found.project(grid(rpc)), expected, rtol=0, atol=1e-8)
    found = read(adjusted(rpc, *sizes, number=1, current=1))
    np.testing.assert_allclose(found.project(grid(rpc)), expected, rtol=0, atol=1e-8)
    assert read(adjusted(rpc, *sizes, number=1, current=0)) == rpc


def test_a_rotation_is_applied_under_one_denominator_else_refused(rpc):
    sizes = (2.0, -3.0, 1.5, -0.5, 0.7)
    with pytest.raises(RpcFormatError, match=r"memory: adjusted by a rotation of 0\.7 degrees"):
        read(adjusted(rpc, *sizes))
    shared = replace(rpc, coeffs=rpc.coeffs[[0, 1, 2, 1]])
    found = read(adjusted(shared, *sizes))
    expected = by_ossim(shared, grid(rpc), *sizes)
    np.testing.assert_allclose(found.project(grid(rpc)), expected, rtol=0, atol=1e-8)
    opposite = by_ossim(shared, grid(rpc), *sizes[:4], -0.7)
    assert np.abs(found.project(grid(rpc)) - opposite).max() > 10.0


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("adjustment_0.adj_param_5.center:  0.5\n", "adj_param_5 is no adjustment"),
        ("adjustment_0.adj_param_1.parameter:  0.5\n", "adj_param_1 .* has no sigma"),
        ("adjustment_0.adj_param_1.center:  many\n", "adj_param_1.center is not a number"),
        ("adjustment_0.adj_param_2.center:  -980.9\n", "a scale is zero"),
    ],
)
def test_an_adjustment_that_is_none_is_refused(text, what, rpc):
    with pytest.raises(RpcFormatError, match=what):
        read(FORMATS["geom"].write(rpc) + text)


# --- as others read what is written -----------------------------------------------------------------------


def by_line(text):
    """As readers that know no names: the n-th line is the n-th number (MicMac's ASCII mode, learned stereo)."""
    values = np.array([float(line.split()[1]) for line in text.splitlines()[:90]])
    offset, scale, coeffs = values[:5], values[5:10], values[10:].reshape(4, 20)  # row, col, lat, lon, alt
    return RPC(coeffs[[2, 3, 0, 1]], offset[[3, 2, 4]], scale[[3, 2, 4]], offset[[1, 0]], scale[[1, 0]])


@pytest.mark.parametrize("changes", [{}, {"err_bias": None, "err_rand": None}])
def test_a_reader_that_goes_by_the_line_finds_every_number(changes, tmp_path):
    rpc = replace(make_rpc(), **changes)
    write_rpc(rpc, tmp_path / "a_RPC.TXT")
    text = (tmp_path / "a_RPC.TXT").read_text()
    np.testing.assert_allclose(in_order(by_line(text), grid(rpc)), rpc.project(grid(rpc)), rtol=0, atol=1e-9)
    behind = [line.split(":")[0] for line in text.splitlines()[90:]]
    assert [key for key in behind if key.startswith("ERR")] == (["ERR_BIAS", "ERR_RAND"] if rpc.err_bias else [])
    assert read(text) == rpc


def test_maxar_xml_states_the_size_of_the_image_where_it_is_known(rpc, tmp_path):
    """GDAL takes rows and columns, and the RPC, from one file beside an image."""
    image = write_image(tmp_path / "scene.tif", (1, 40, 60))
    write_rpc(rpc, tmp_path / "scene.XML", size=(60, 40))
    root = ElementTree.parse(tmp_path / "scene.XML").getroot()
    assert (root.findtext("IMD/NUMROWS"), root.findtext("IMD/NUMCOLUMNS")) == ("40", "60")
    assert stated_in_xml(tmp_path / "scene.XML") == ((60, 40), False)
    assert read_rpc(tmp_path / "scene.XML") == read_rpc(image) == rpc
    with rasterio.open(image) as dataset:
        assert dataset.rpcs.line_off == rpc.image_offset[1]
        assert dataset.tags(ns="IMD")["NUMROWS"] == "40"
    write_rpc(rpc, tmp_path / "other.XML")
    assert "NUM" not in (tmp_path / "other.XML").read_text().replace("NUMCOEF", "")
    for name, wide in (("b.XML", True), ("b_RPC.TXT", False)):
        write_camera(rpc, tmp_path / name, image, size=(7, 9))
        assert ("<NUMCOLUMNS>7<" in (tmp_path / name).read_text()) == wide


# --- names and orders of other programs -------------------------------------------------------------------


def test_an_inverse_beside_the_rpc_is_passed_over_and_said_to_be(rpc):
    """The 170 lines of WHU-TLC and SatMVS, whatever their inverse is worth."""
    lines = written(fields_from_rpc(replace(rpc, err_bias=None, err_rand=None)))
    inverse = {f"{axis}_{part}_COEFF": [0.1] * 20 for axis in ("LAT", "LONG") for part in ("NUM", "DEN")}
    with pytest.warns(Remark, match="its inverse"):
        assert read(lines + written(inverse)) == replace(rpc, err_bias=None, err_rand=None)


@pytest.mark.parametrize("between", [",", "\n", ", ", " "])
def test_ninety_two_numbers_are_those_of_the_geotiff_tag(between, rpc):
    known = replace(rpc, err_bias=3.5, err_rand=0.25)
    numbers = [
        3.5,
        0.25,
        *(value for key, values in fields_from_rpc(known).items() if key in KEYS[2:] for value in values),
    ]
    assert len(numbers) == 92
    assert read(between.join(map(repr, numbers))) == known
    numbers[32] = 0.3  # the first of a denominator
    with pytest.raises(RpcFormatError, match="those of an RPC begin with 1"):
        read(between.join(map(repr, numbers)))


def test_keys_and_values_may_have_a_comma_between(rpc):
    assert read(written(fields_from_rpc(rpc), units={}).replace(": ", ",")) == rpc


def test_vissat_s_words(rpc):
    fields = fields_from_rpc(replace(rpc, err_bias=None, err_rand=None))
    words = dict(zip(("LINE", "SAMP", "LAT", "LONG", "HEIGHT"), ("row", "col", "lat", "lon", "alt"), strict=True))
    parts = {"OFF": "Off", "SCALE": "Scale", "NUM": "Num", "DEN": "Den"}
    found = {words[k.split("_")[0]] + parts[k.split("_")[1]]: v[0] if len(v) == 1 else v for k, v in fields.items()}
    assert read(json.dumps({"rpc": found, "height": 7})) == replace(rpc, err_bias=None, err_rand=None)


def test_radarsat_s_rational_functions(rpc):
    """Names by GDAL's driver: pixel for sample, latitude and longitude in full."""
    words = {"SAMP": "pixel", "LINE": "line", "LAT": "latitude", "LONG": "longitude", "HEIGHT": "height"}
    parts = {"OFF": "Offset", "SCALE": "Scale", "NUM": "NumeratorCoefficients", "DEN": "DenominatorCoefficients"}
    lines = []
    for key, values in fields_from_rpc(rpc).items():
        axis, part = key.split("_")[:2]
        if axis in words:
            tag = words[axis] + parts[part]
            lines.append(f"<{tag} units='m'>{' '.join(map(repr, values))}</{tag}>")
    errors = "".join(f"<{w}>{v!r}</{w}>" for w, v in (("biasError", rpc.err_bias), ("randomError", rpc.err_rand)) if v)
    inside = f"<rationalFunctions>{errors}{''.join(lines)}</rationalFunctions>"
    text = f"<product xmlns='http://www.rsi.ca/rs2'><imageGenerationParameters>{inside}</imageGenerationParameters></product>"
    assert read(text) == rpc


@pytest.mark.parametrize("part", ["ATTITUDE", "EPHEMERIS"])
def test_a_part_of_maxar_s_camera_is_refused_by_name(part):
    with pytest.raises(RpcFormatError, match=rf"Maxar's {part.lower()} file, .*give the product's \.XML"):
        read(f'satId = "WV02";\nBEGIN_GROUP = {part}\n\tnumPoints = 2;\n')


# --- the cases of the shared data -------------------------------------------------------------------------

P = np.array([[5.4, 43.3, 250.0]])


@pytest.mark.parametrize(
    ("file", "expected"),
    [
        ("refined.geom", (499.7732, 565.4442)),
        ("rpc_units.tif", (509.7732, 540.4442)),
        ("rpc_zero_based_RPC.TXT", (509.7732, 540.4442)),
        ("spec_xxx.rpb", (509.7732, 540.4442)),
        ("rpc92_comma.txt", (509.7732, 540.4442)),
        ("satellitesfm_meta.json", (509.7732, 540.4442)),
        pytest.param(
            "rpc_with_inverse_170.rpc", (509.7732, 540.4442), marks=pytest.mark.filterwarnings("ignore:.*its inverse")
        ),
    ],
)
def test_a_case_from_the_field_projects_as_its_oracle(file, expected, shared_data):
    folder = shared_data / "field_cases"
    if not folder.is_dir():
        pytest.skip("no field cases in the shared data")
    np.testing.assert_allclose(read_rpc(folder / file).project(P)[0], expected, rtol=0, atol=1e-4)


def test_the_keys_of_these_tests_are_those_of_the_reader():
    assert set(fields_from_rpc(make_rpc())) == set(KEYS) >= set(COEFFICIENTS)
