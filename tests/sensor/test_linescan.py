"""Physical models in vendors' metadata, against what the samples mean and against the RPC of the same image.

Of damage anywhere: `tests/fuzz/test_readers.py`.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barpc.base.errors import FitError, InputError, RpcFormatError
from barpc.base.geodesy import ecef_from_ground, enu_basis
from barpc.fit import fit_rpc
from barpc.rpcio import read_rpc
from barpc.sensor.linescan import read_linescan
from barpc.sensor.pushbroom import STRAIGHT, Light
from tests.sensor.linescan_files import Flight, dimap, inertial_sight, isd, read

FLIGHT = Flight()
IMAGE = np.array([[0.0, 0.0], [3999.0, 0.0], [1234.5, 7000.25], [0.0, 19999.0], [3999.0, 19999.0], [2000.0, 333.0]])


# --- Maxar --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "how",
    [{}, {"angle": 0.7, "along": 1.5}, {"camera": Rotation.from_rotvec([0.002, -0.03, 0.5])}],
    ids=["plain", "turned detector", "turned camera"],
)
def test_an_isd_means_what_its_samples_say(tmp_path, how):
    text, truth = isd(FLIGHT, **how)
    found = read(tmp_path, text, aberration=False, refraction=False)
    assert found.size == FLIGHT.size
    assert truth.misses(found.model, IMAGE) < 5e-4
    wrong = replace(found.model, look_origin=found.model.look_origin + 1)
    assert truth.misses(wrong, IMAGE) == pytest.approx(1.0, abs=0.1)


def test_aberration_is_that_of_the_inertial_frame(tmp_path):
    text, _ = isd(FLIGHT)
    model = read(tmp_path, text, refraction=False).model
    assert model.light == Light(aberration=True)
    ground = model.localize(IMAGE, np.full(len(IMAGE), 300.0))
    origin, seen = model.line_of_sight(IMAGE)
    velocity = model.orbit(model.time(IMAGE[:, 1]))[1].T
    for k in range(len(IMAGE)):
        np.testing.assert_allclose(inertial_sight(ground[k], origin[k], velocity[k]), seen[k], rtol=0, atol=2e-10)
    straight = replace(model, light=STRAIGHT).localize(IMAGE, np.full(len(IMAGE), 300.0))
    off = np.linalg.norm(ecef_from_ground(ground) - ecef_from_ground(straight), axis=1)
    assert ((off > 15) & (off < 25)).all()


@pytest.mark.parametrize("alt", [0.0, 3000.0])
def test_refraction_is_that_of_a_ray_through_the_air(tmp_path, alt):
    text, _ = isd(FLIGHT)
    model = read(tmp_path, text, aberration=False).model
    assert model.light == Light(refraction=True)
    ground = model.localize(IMAGE[2], np.array(alt))
    straight = replace(model, light=STRAIGHT).localize(IMAGE[2], np.array(alt))
    enu = enu_basis(ground)
    shift = enu @ (ecef_from_ground(ground) - ecef_from_ground(straight))
    to_nadir = enu @ (model.position(IMAGE[2, 1]) - ecef_from_ground(ground))
    zenith = np.arctan2(np.hypot(*to_nadir[:2]), to_nadir[2])
    heights = np.linspace(alt, 80e3, 40001)
    sine = np.sin(zenith) / (1 + 2.8e-4 * np.exp(-heights / 8e3))  # Snell
    bent = np.trapezoid(np.tan(zenith) - np.tan(np.arcsin(sine)), heights)
    assert bent == pytest.approx(1.3 * np.exp(-alt / 8e3), rel=0.1)
    assert shift[:2] @ to_nadir[:2] / np.hypot(*to_nadir[:2]) == pytest.approx(bent, rel=0.05)


# What the files of two satellites say, against their RPC over five altitudes: mean and spread [px]. Both were put
# together from tiles by other software, which fitted the RPC anew with strong damping, of WV03 without aberration and
# refraction and of WV01 with both: the spread is that fit's. The mean is the model's.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "bent", "mean", "spread"),
    [
        ("1040010074793300.xml", False, (-0.03, 0.02), (0.87, 0.48)),
        ("10200100A1865800.r100.xml", True, (-0.02, -0.12), (1.69, 1.10)),
    ],
)
def test_the_model_is_that_of_the_rpc_in_the_same_file(shared_data, name, bent, mean, spread):
    path = shared_data / "physical_maxar" / name
    found, rpc = read_linescan(path, aberration=bent, refraction=bent), read_rpc(path)
    image = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 15) for n in found.size)), -1).reshape(-1, 2)
    low, high = rpc.ground_offset[2] - rpc.ground_scale[2], rpc.ground_offset[2] + rpc.ground_scale[2]
    off = np.array(
        [
            rpc.project(found.model.localize(image, np.full(len(image), alt))) - image
            for alt in np.linspace(low, high, 5)
        ]
    )
    np.testing.assert_allclose(off.mean(axis=(0, 1)), mean, atol=0.15)
    np.testing.assert_allclose(off.std(axis=(0, 1)), spread, atol=0.15)
    straight = read_linescan(path, aberration=not bent, refraction=not bent).model
    other = rpc.project(straight.localize(image, np.full(len(image), low))) - image
    assert np.hypot(*other.mean(axis=0)) > 20


# Corners that the vendor computed: (lon, lat, alt, col, row) of the first tile of the WV01 image.
_CORNERS = np.array(
    [[50.59096874, -77.01128208, 3431.44, 0, 0], [49.81876988, -77.01468990, 3468.26, 35179, 0]],
)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("aberration", "refraction", "low", "high"),
    [(True, True, 0.0, 0.06), (True, False, 1.0, 1.2), (False, True, 18, 19), (False, False, 19, 20)],
)
def test_the_vendor_s_own_corners_lie_where_bent_light_has_them(shared_data, aberration, refraction, low, high):
    path = shared_data / "physical_maxar" / "10200100A1865800.r100.xml"
    model = read_linescan(path, aberration=aberration, refraction=refraction).model
    off = np.abs(model.project(_CORNERS[:, :3]) - _CORNERS[:, 3:])
    assert low <= off.max() <= high


@pytest.mark.parametrize(("aberration", "low", "high"), [(True, 0.0, 0.02), (False, 25, 40)])
def test_a_vendor_s_corner_of_unknown_height_lies_on_the_line_of_sight_with_aberration(
    shared_data, aberration, low, high
):
    path = shared_data / "physical_maxar" / "1040010074793300.xml"
    model = read_linescan(path, aberration=aberration).model
    corner = np.array([[-156.8255209, 71.3953744, alt] for alt in (0.0, 10.0)])  # of pixel (0, 0)
    (off, _), along = model.project(corner), np.diff(model.project(corner), axis=0)[0]
    across = abs(off[0] * along[1] - off[1] * along[0]) / np.hypot(*along)
    assert low <= across <= high


@pytest.mark.slow
def test_a_fit_to_an_attitude_that_swings_says_why_it_fails(tmp_path):
    model = read(tmp_path, isd(Flight(swing=2e-5))[0]).model
    with pytest.raises(FitError, match="attitude oscillation"):
        fit_rpc(model, FLIGHT.size, (0.0, 500.0))
    assert FLIGHT.sensor.advice == ""


# --- DIMAP --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("poly", [True, False])
@pytest.mark.parametrize("unit", [1e-3, 1e-6])
def test_a_dimap_means_what_its_parts_say(tmp_path, poly, unit):
    flight = Flight(swing=0.0)
    text, truth = dimap(flight, poly=poly, unit=unit)
    found = read(tmp_path, text)
    assert found.size == flight.size
    assert found.model.light == STRAIGHT
    assert found.model.line_period == pytest.approx(flight.period, rel=1e-12)
    assert truth.misses(found.model, IMAGE) < 2e-3
    assert truth.misses(replace(found.model, look_origin=found.model.look_origin - 1), IMAGE) > 0.9


@pytest.mark.parametrize(
    ("speed", "air", "light"),
    [
        ("false", "true", Light(refraction=True)),  # as a Pleiades Neo product says
        ("true", "false", Light(aberration=True)),
        ("false", "false", STRAIGHT),
    ],
)
def test_a_dimap_says_what_bends_its_light(tmp_path, speed, air, light):
    text, _ = dimap(FLIGHT, poly=False)
    said = (
        f"<LIGHT_SPEED_SETTING>{speed}</LIGHT_SPEED_SETTING>"
        f"<ATMOSPHERIC_REFRACTION_SETTING>{air}</ATMOSPHERIC_REFRACTION_SETTING>"
    )
    part = "<Processing_Information><Product_Settings><Geometric_Settings>{}</Geometric_Settings></Product_Settings>"
    text = text.replace("<Raster_Data>", part.format(said) + "</Processing_Information><Raster_Data>")
    assert read(tmp_path, text).model.light == light
    assert read(tmp_path, text, aberration=False, refraction=False).model.light == STRAIGHT


def test_commas_may_stand_between_coordinates(tmp_path):
    text, truth = dimap(FLIGHT, poly=False)
    commas = re.sub(r"<LOCATION_XYZ>(\S+) (\S+) (\S+)<", r"<LOCATION_XYZ>\1, \2,\3<", text)
    assert commas != text
    assert read(tmp_path, commas).model == read(tmp_path, text).model
    assert truth.misses(read(tmp_path, commas).model, IMAGE) < 2e-3


def test_the_attitude_of_an_image_after_midnight_counts_from_its_day(tmp_path):
    flight = Flight(swing=0.0)
    text, truth = dimap(flight)
    seconds = float(re.search(r"<OFFSET>(.*?)<", text)[1])
    assert seconds > 86399
    early = text.replace(f"<OFFSET>{seconds!r}", f"<OFFSET>{seconds - 86400!r}")
    assert truth.misses(read(tmp_path, early).model, IMAGE) < 2e-3


# --- files that lie -----------------------------------------------------------------------------------------

ISD, DIMAP = isd(FLIGHT)[0], dimap(FLIGHT)[0]
_ROW = re.compile(r"<(ATT|EPHEM)LIST>[^<]*</\1LIST>\n")


def cut(text, tag, keep):
    """Without the rows of a list that `keep` refuses, and with a number of points that says so."""
    rows = re.findall(rf"<{tag}>[^<]*</{tag}>\n", text)
    for k, row in enumerate(rows):
        if not keep(k):
            text = text.replace(row, "")
    return text.replace(f"<NUMPOINTS>{len(rows)}<", f"<NUMPOINTS>{sum(map(keep, range(len(rows))))}<")


def other(text, tag, row, change):
    """One row of a list with other numbers."""
    found = re.findall(rf"<{tag}>([^<]*)</{tag}>", text)[row]
    return text.replace(found, " ".join(map(repr, change([float(v) for v in found.split()]))))


LIES = {
    "no GEO": (re.sub(r"(?s)<GEO>.*</GEO>", "", ISD), "no GEO"),
    "a list cut short": (_ROW.sub("", ISD, count=20), "of 80|of 79|holds"),
    "samples of another time": (
        ISD.replace("2026-05-07T23:59:59.2", "2026-05-07T23:58:59.2", 2),
        "image lasts|FIRSTLINE",
    ),
    "a component's sign": (other(ISD, "ATTLIST", 7, lambda v: [v[0], -v[1], *v[2:]]), "turns by"),
    "a row that lacks a number": (other(ISD, "ATTLIST", 7, lambda v: v[:-1]), "hold 14, 15 numbers"),
    "nan": (other(ISD, "EPHEMLIST", 3, lambda v: [v[0], float("nan"), *v[2:]]), "not finite"),
    "words": (ISD.replace("<DETPITCH>0.008", "<DETPITCH>eight"), "not a list of numbers"),
    "two interval lengths": (
        ISD.replace("<TIMEINTERVAL>0.02", "<TIMEINTERVAL>0.03"),
        "otherwise than their stated|image lasts",
    ),
    "a resampled product": (ISD.replace(">LV1B<", ">LV2A<"), "only 1B"),
    "a distortion": (ISD.replace("<POLYORDER>-1", "<POLYORDER>2"), "distortion"),
    "two detectors": (
        re.sub(r"(<DETECTOR_ARRAY>.*</DETECTOR_ARRAY>)", r"\1\1", ISD, flags=re.S),
        "2 detector arrays",
    ),
    "rows without end": (re.sub(r"<NUMROWS>\d+", "<NUMROWS>1e300", ISD), "absurdly large"),
    "an entity": (ISD.replace("<isd>", '<!DOCTYPE isd [<!ENTITY a "b">]><isd>'), "DOCTYPE"),
    "an RPC alone": ("<isd><RPB/></isd>", "no IMD/PRODUCTLEVEL"),
    "another document": ("<product/>", "no physical camera model"),
    "DIMAP of an ortho": (
        re.sub(r"(?s)<Refined_Model>.*</Refined_Model>", "", DIMAP),
        "no Geometric_Data/Refined_Model",
    ),
    "no ephemeris": (re.sub(r"<Point>.*</Point>", "", DIMAP), "0 positions"),
    "a coefficient short": (DIMAP.replace("<DEGREE>3", "<DEGREE>2", 1), "4 numbers, expected 3"),
}


@pytest.mark.few(9)
@pytest.mark.parametrize("lie", LIES)
def test_a_file_that_lies_gives_one_line(tmp_path, lie):
    text, words = LIES[lie]
    with pytest.raises(RpcFormatError, match=words) as told:
        read(tmp_path, text)
    assert "\n" not in str(told.value)
    assert "metadata.xml" in str(told.value)


def test_bands_are_told_apart_by_name(tmp_path):
    second = ISD.replace("<BAND_P>", "<BAND_N>").replace("</BAND_P>", "</BAND_N>")
    both = ISD.replace(
        "</BAND_P>",
        "</BAND_P>" + re.search("(?s)<BAND_N>.*</BAND_N>", second)[0].replace("<DETORIGINX>0.0", "<DETORIGINX>0.8"),
    )
    with pytest.raises(InputError, match="band=NAME of P, N"):
        read(tmp_path, both)
    first, other_band = (read(tmp_path, both, band=name).model for name in ("p", "N"))
    moved = other_band.project(first.localize(IMAGE, np.zeros(len(IMAGE)))) - IMAGE
    assert (np.abs(np.abs(moved[:, 1]) - 108) < 8).all()
    assert np.abs(moved[:, 0]).max() < 3
    with pytest.raises(InputError, match="band=NAME"):
        read(tmp_path, both, band="R")
