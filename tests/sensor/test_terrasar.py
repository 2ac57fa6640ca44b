"""TerraSAR-X: the model of an annotation against zero Doppler found by bracketing, and what is refused.

Of damage anywhere: `tests/fuzz/test_readers.py`.
"""

from __future__ import annotations

import re
import warnings
from contextlib import nullcontext

import numpy as np
import pytest

from barpc.base.errors import BarpcWarning, InputError, RpcFormatError
from barpc.base.safe_io import parse_xml
from barpc.cameras import open_camera
from barpc.fit import fit_rpc
from barpc.sensor.document import XmlFields
from barpc.sensor.geometry import view_angles
from barpc.sensor.terrasar import open_terrasar
from tests.sensor.terrasar_files import INTERVAL, NAME, SIZE, SPACING, START, Terrasar


@pytest.mark.parametrize("look", ["right", "left"])
def test_points_are_seen_at_their_zero_doppler_and_range_times_with_their_delays(tmp_path, look):
    product = Terrasar(look)
    model = open_terrasar(product.write(tmp_path))
    ground = product.ground()
    truth = product.image(ground)
    np.testing.assert_allclose(model.project(ground), truth, rtol=0, atol=2e-3)  # velocities in mm/s
    there = model.localize(truth, ground[:, 2])
    np.testing.assert_allclose(model.project(there), truth, rtol=0, atol=1e-6)
    assert model.size == SIZE
    assert model.alt_range == (103 - 200, 899 + 500)
    assert model.look == look


def test_without_its_delays_a_product_is_off_by_them_and_says_so(tmp_path):
    product = Terrasar()
    path = product.write(tmp_path)
    (tmp_path / "ANNOTATION" / "GEOREF.xml").unlink()
    with pytest.warns(BarpcWarning, match="no ANNOTATION/GEOREF.xml"):
        model = open_terrasar(path)
    off = model.project(product.ground()) - product.image(product.ground())
    wanted = -np.array(product.late) / (SPACING, INTERVAL)  # col 1.6 px to the left, row 0.7 px down
    np.testing.assert_allclose(off, np.tile(wanted, (len(off), 1)), rtol=0, atol=2e-3)
    assert model.alt_range == (-550.0, 1450.0)


def test_a_folder_is_opened_as_its_annotation_and_an_rpc_follows(tmp_path):
    path = Terrasar().write(tmp_path)
    cameras = [open_camera(tmp_path), open_camera(path)]
    assert [c.format for c in cameras] == ["terrasar-x", "terrasar-x"]
    assert cameras[0].model == cameras[1].model
    assert cameras[0].size == SIZE
    fit = fit_rpc(cameras[0].model, SIZE, cameras[0].alt_range)
    assert fit.max_ckp.max() < 1e-3
    (tmp_path / NAME.replace("TSX1", "TDX1")).write_bytes(path.read_bytes())
    with pytest.raises(RpcFormatError, match="no Sentinel-1 annotation"):  # two: not one product
        open_camera(tmp_path)


NOT_READ = {
    "a ground range product": (">SLANTRANGE<", ">GROUNDRANGE<", "GROUNDRANGE projection.*SSC"),
    "a map": (">SLANTRANGE<", ">MAP<", "MAP projection"),
    "ScanSAR": (">SM<", ">SC<", "mode SC, read are SM"),
    "bistatic": ('fileName="TSX1_SAR__SSC______SM', 'fileName="TSX1_SAR__SSC_BRX2_SM', "another satellite"),
    "squinted": (">ZERODOPPLER<", ">ACQUISITION<", "imageCoordinateType is ACQUISITION"),
    "far range first": (">EARLYAZNEARRG<", ">EARLYAZFARRG<", "imageDataStartWith is EARLYAZFARRG"),
}
LIES = {
    "another look": (">RIGHT<", ">DOWN<", "lookDirection is 'DOWN'"),
    "a row less": (
        f"<numberOfRows>{SIZE[1]}",
        "<numberOfRows>19997",
        "19997 rows every 0.00026 s do not last",
    ),
    "columns of another length": (f">{SPACING!r}<", ">8.1e-09<", "12000 columns every 8.1e-09 s do not last"),
    "an inertial orbit": (">WGS84<", ">ICRF<", "state vectors in ICRF"),
    "an inertial orbit of a like name": (">WGS84<", ">ITRF2014 TOD<", "state vectors in ITRF2014 TOD"),
    "no orbit": ("stateVec", "stateVek", "orbit: 0 state vectors"),
    "an orbit of another time": ("T15:1[123]:", "T16:11:", "orbit: .*state vectors"),
    "no number": ("<sceneAverageHeight>4.5E", "<sceneAverageHeight>high", "sceneAverageHeight is not a list"),
    "no TerraSAR-X": ("level1Product", "level1Produce", "no TerraSAR-X annotation"),
}


@pytest.mark.few(6)
@pytest.mark.parametrize("lie", [*NOT_READ, *LIES])
def test_what_is_not_read_or_lies_is_said_in_one_line(tmp_path, lie):
    path = Terrasar().write(tmp_path)
    old, new, words = {**NOT_READ, **LIES}[lie]
    text = re.sub(old, new, path.read_text())
    assert text != path.read_text()
    path.write_text(text)
    with pytest.raises(InputError if lie in NOT_READ else RpcFormatError, match=words) as told:
        open_terrasar(path)
    assert "\n" not in str(told.value)
    assert NAME in str(told.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("gridPoint", "gridpoint", "no gridPoint"),
        ("-0.00018<", "-0.18<", "azimuthShift is -0.18 s"),
        (r"<lat>[^<]*<", "<lat>north<", "lat is not a list"),
        ("<referencePoint>[^<]*<", "<referencePoint><", "no referencePoint"),
    ],
)
def test_a_georef_that_lies_is_said_in_one_line(tmp_path, old, new, words):
    path = Terrasar().write(tmp_path)
    georef = tmp_path / "ANNOTATION" / "GEOREF.xml"
    text = re.sub(old, new, georef.read_text())
    assert text != georef.read_text()
    georef.write_text(text)
    with pytest.raises(RpcFormatError, match=f"GEOREF.xml: .*{words}"):
        open_terrasar(path)


def test_times_of_the_frame_begin_with_the_first_row(tmp_path):
    model = open_terrasar(Terrasar().write(tmp_path))
    late = (model.epoch - np.datetime64("2021-02-16T15:12:07.524369", "ns")) / np.timedelta64(1, "ns")
    assert late == pytest.approx((START + 1.8e-4) * 1e9, abs=1)


def opened(path, old, new):
    """The model of an annotation in which one thing is changed."""
    text = re.sub(old, new, path.read_text())
    assert text != path.read_text()
    path.write_text(text)
    return open_terrasar(path)


@pytest.mark.few(3)
@pytest.mark.parametrize(("tag", "count"), [("Rows", SIZE[1]), ("Columns", SIZE[0])])
@pytest.mark.parametrize(("off", "ok"), [(1, True), (-1, True), (3, False), (-3, False)])
def test_rows_and_columns_last_as_long_as_their_number_to_two(tmp_path, tag, count, off, ok):
    path, change = Terrasar().write(tmp_path), (f"<numberOf{tag}>{count}<", f"<numberOf{tag}>{count + off}<")
    if ok:
        assert opened(path, *change).size[tag == "Rows"] == count + off
    else:
        with pytest.raises(RpcFormatError, match=f"{count + off} {tag.lower()} every .* do not last"):
            opened(path, *change)


@pytest.mark.few(2)
@pytest.mark.parametrize(("late", "ok"), [(0.9e-3, True), (-0.9e-3, True), (1.1e-3, False), (-1.1e-3, False)])
def test_no_signal_is_late_by_more_than_a_millisecond(tmp_path, late, ok):
    product = Terrasar(late=(1.47e-8, late))
    path = product.write(tmp_path)
    with nullcontext() if ok else pytest.raises(RpcFormatError, match=r"azimuthShift is .* s, expected at most 0\.001"):
        ground = product.ground(5)
        np.testing.assert_allclose(open_terrasar(path).project(ground), product.image(ground), rtol=0, atol=2e-3)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("rows", "columns", "warned"), [(4.9, 0, False), (5.1, 0, True), (0, -4.9, False), (0, 5.1, True)]
)
def test_a_grid_five_pixels_off_belongs_to_another_orbit(tmp_path, rows, columns, warned):
    path = Terrasar().write(tmp_path)
    georef = tmp_path / "ANNOTATION" / "GEOREF.xml"
    text = re.sub(r"<t>([^<]*)</t>", lambda m: f"<t>{float(m[1]) + rows * INTERVAL!r}</t>", georef.read_text())
    text = re.sub(r"<tau>([^<]*)</tau>", lambda m: f"<tau>{float(m[1]) + columns * SPACING!r}</tau>", text)
    georef.write_text(text)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        open_terrasar(path)
    assert [issubclass(one.category, BarpcWarning) for one in told] == [True] * warned
    for one in told:
        assert f"difference {abs(columns):.1f} samples, {abs(rows):.1f} lines" in str(one.message)


@pytest.mark.slow
def test_state_vectors_are_those_of_the_earth(tmp_path):
    path = Terrasar().write(tmp_path)
    whole = open_terrasar(path)
    for frame in ("WGS84-G873", "WGS84-G1150", "WGS84 (G1762)", "ITRF97", "ITRF2014", "IGS08", "IGb14"):
        assert opened(path, ">(WGS|ITRF|IG)[^<]*<", f">{frame}<") == whole
    assert opened(path, "<orbitHeader>.*</orbitHeader>", "") == whole  # it says nothing of them
    assert whole.frame.sampling_rate == pytest.approx(1 / SPACING)
    assert whole.frame.interval == INTERVAL
    assert not whole.delays


@pytest.mark.few(2)
@pytest.mark.parametrize("mode", ["SM", "SL", "HS", "HS300", "ST"])
def test_stripmaps_and_spotlights_are_read(tmp_path, mode):
    path = Terrasar().write(tmp_path)
    if mode != "SM":
        assert opened(path, "<imagingMode>SM<", f"<imagingMode>{mode}<").size == SIZE
    assert open_camera(path).alt_range == (-97.0, 1399.0)


def test_the_corners_of_a_delivered_product_are_on_their_rows(shared_data):
    """By lon, lat and range time of each corner its height is solved for; the row is the product's own word."""
    path = next((shared_data / "radar").glob("TDX1_SAR__SSC*.xml"))
    with pytest.warns(BarpcWarning, match=r"no ANNOTATION/GEOREF\.xml"):
        model = open_terrasar(path)
    corners = XmlFields(parse_xml(path, strip_namespaces=True), "").all("productInfo/sceneInfo/sceneCornerCoord")
    lon, lat, col, row, incidence = np.array(
        [[k.number(tag) for tag in ("lon", "lat", "refColumn", "refRow", "incidenceAngle")] for k in corners]
    ).T
    height = np.zeros(4)
    for _ in range(5):
        at = np.column_stack([lon, lat, height])
        image, slope = model.project_jacobian(at)
        height -= (image[:, 0] - (col - 1)) / slope[:, 0, 2]
    image = model.project(np.column_stack([lon, lat, height]))
    np.testing.assert_allclose(image[:, 0], col - 1, rtol=0, atol=1e-6)
    np.testing.assert_allclose(image[:, 1], row - 1, rtol=0, atol=0.03)  # px: 0.023 of all four
    assert np.ptp(image[:, 1] - row) < 0.002
    np.testing.assert_allclose(view_angles(model, np.column_stack([lon, lat, height]))[0], incidence, atol=0.02)
    assert (np.abs(height[[1, 3]] + 28.0) < 3.0).all()  # m: the sea, 24 to 26 m below the ellipsoid, 2 m in range late
