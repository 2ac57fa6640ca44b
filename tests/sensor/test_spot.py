"""SPOT 1 to 5 scenes of level 1A: what a `METADATA.DIM` means, worked out by `tests.sensor.spot_files`."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import BarpcError, InputError, RpcFormatError
from barpc.rpcio.plausible import corners_off
from barpc.sensor.linescan import read_linescan
from barpc.sensor.pushbroom import STRAIGHT
from barpc.sensor.samples import Linescan
from tests.sensor.linescan_files import Flight, dimap
from tests.sensor.spot_files import Scene, still

SPOT5, SPOT2 = Scene(), Scene(mission=2, center="1994-02-28T10:11:12.123456", period=3.008e-3)
TEXTS = {5: SPOT5.text(), 2: SPOT2.text()}
IMAGE = np.array([[0.0, 0.0], [1199.0, 0.0], [600.25, 333.5], [0.0, 999.0], [1199.0, 999.0]])


def read(tmp_path: Path, text: str, **choices: str) -> Linescan:
    path = tmp_path / "METADATA.DIM"
    path.write_text(text, encoding="latin-1")
    return read_linescan(path, **choices)


def miss(found: Linescan, ground: np.ndarray) -> float:
    return float(np.abs(found.model.project(ground) - IMAGE).max())


@pytest.mark.parametrize("scene", [SPOT5, SPOT2], ids=["5", "2"])
def test_a_scene_means_what_the_handbook_says(tmp_path: Path, scene: Scene) -> None:
    found = read(tmp_path, TEXTS[scene.mission])
    assert (found.size, found.kind, found.model.light) == ((1200, 1000), "spot physical model", STRAIGHT)
    for alt in (0.0, 2500.0):
        assert miss(found, scene.ground(IMAGE, alt)) < 1e-4
    alts = np.linspace(-100, 4000, len(IMAGE))
    back = found.model.project(found.model.localize(IMAGE, alts))
    np.testing.assert_allclose(back, IMAGE, rtol=0, atol=1e-7)
    said, doubts = corners_off(found.model, found.corners)
    assert (said, doubts) == ("the corners that its producer states are met within 0.0 m", ())


@pytest.mark.parametrize(
    ("change", "moved"),
    [
        ({"inside": (0.0061, 0.31)}, (0.0, -1.0)),  # psi_x up: it looks further along the flight, so earlier there
        ({"inside": (0.006, 0.3101)}, (-1.0, 0.0)),  # psi_y up: towards -X, as the later detectors
        ({"angles": lambda t: still(t) + [1e-3, 0.0, 0.0]}, None),
        ({"angles": lambda t: still(t) + [0.0, 1e-4, 0.0]}, None),
        ({"angles": lambda t: still(t) + [0.0, 0.0, 1e-4]}, None),
    ],
    ids=["psi_x", "psi_y", "yaw", "pitch", "roll"],
)
def test_each_angle_has_its_own_sign(tmp_path: Path, change: dict, moved: tuple[float, float] | None) -> None:
    level = replace(SPOT5, angles=still)
    before, after = read(tmp_path, level.text()), read(tmp_path, replace(level, **change).text())
    assert miss(after, replace(level, **change).ground(IMAGE, 500.0)) < 1e-4
    off = after.model.project(before.model.localize(IMAGE, np.zeros(5))) - IMAGE
    assert np.abs(off).max() > 2  # px: a sign that is wrong moves twice as far
    if moved is not None:
        main = int(np.argmax(np.abs(moved)))
        assert (np.sign(off[:, main]) == np.sign(moved[main])).all()


def test_raw_attitudes_are_taken_where_they_are_asked_for(tmp_path: Path) -> None:
    raw = read(tmp_path, TEXTS[2], attitudes="raw")
    assert miss(raw, SPOT2.ground(IMAGE, 500.0, attitude=True)) < 1e-3  # speeds are differences of angles
    assert miss(raw, SPOT2.ground(IMAGE, 500.0)) > 100
    assert raw.corners is None  # the producer's leave them out
    for text, choice in ((TEXTS[2], "fine"), (TEXTS[5], "raw"), (dimap(Flight(size=(500, 3000)))[0], "raw")):
        with pytest.raises(InputError, match="SPOT 1 to 4"):
            read(tmp_path, text, attitudes=choice)


def test_a_band_has_its_own_detectors(tmp_path: Path) -> None:
    first, second = read(tmp_path, TEXTS[5], band="1").model, read(tmp_path, TEXTS[5], band="2").model
    assert first == read(tmp_path, TEXTS[5]).model
    off = second.project(first.localize(IMAGE, np.zeros(5))) - IMAGE
    assert (off[:, 1] < -5).all()  # it looks 0.1 mrad further along the flight
    with pytest.raises(InputError, match="of band 7; it has 1, 2"):
        read(tmp_path, TEXTS[5], band="7")


def test_what_files_have_and_none_needs(tmp_path: Path) -> None:
    text, model = TEXTS[5], read(tmp_path, TEXTS[5]).model
    points = re.findall(r"(?s)<Point>.*?</Point>\n", text)
    corrected = re.search(r"(?s)<Corrected_Attitude>.*?</Corrected_Attitude>", text)[0]
    angles = re.findall(r"(?s)<Angles>.*?</Angles>", corrected)
    turned = corrected.replace(angles[0], "").replace("</Corrected_A", f"{angles[0]}</Corrected_A")
    wild = re.sub(r"<YAW>.*?<", "<YAW>9999<", angles[3]).replace(">N<", ">Y<")
    ticks = re.compile(r"(<TIME>.*?)(</TIME>)")
    same = {
        "a Z": ticks.sub(r"\1Z\2", text),
        "points in any order": text.replace("".join(points), "".join(points[::-1])),
        "attitudes in any order": text.replace(corrected, turned),
        "one out of range": text.replace(corrected, corrected.replace(angles[3], wild + angles[3])),
        "a blank": text.replace("<PSI_X>", "<PSI_X> "),
        "latin-1": text.replace("<Metadata_Id>", "<Metadata_Id><A>\u00e9t\u00e9 \u00a9</A>"),
        "the index in the name": text.replace(">SPOT<", ">SPOT 5<").replace("<MISSION_INDEX>5</MISSION_INDEX>", ""),
        "a level elsewhere": re.sub("<PROCESSING_LEVEL>.*?</PROCESSING_LEVEL>", "", text),
        "no frame": re.sub("(?s)<Dataset_Frame>.*</Dataset_Frame>", "", text),
    }
    for what, changed in same.items():
        assert changed != text, what
        found = read(tmp_path, changed)
        near = found.model.project(model.localize(IMAGE, np.zeros(5))) - IMAGE
        assert np.abs(near).max() < 1e-6, what
        assert (found.corners is None) == (what == "no frame")


@pytest.mark.parametrize("listed", [3, 40])
def test_detectors_may_be_listed_in_part(tmp_path: Path, listed: int) -> None:
    scene = replace(SPOT2, listed=listed)
    assert miss(read(tmp_path, scene.text()), scene.ground(IMAGE, 0.0)) < 1e-4


def test_look_angles_of_six_decimals_are_read(tmp_path: Path) -> None:
    rounded = re.sub(r"<(PSI_[XY])>(.*?)<", lambda m: f"<{m[1]}>{float(m[2]):.6f}<", TEXTS[5])
    assert miss(read(tmp_path, rounded), SPOT5.ground(IMAGE, 0.0)) < 0.1  # px of 12 urad


def test_attitudes_that_begin_late_are_held_for_a_second(tmp_path: Path) -> None:
    level = replace(SPOT5, size=(1200, 4000), angles=lambda t: still(t) + [0.05, -0.002, 0.001])
    text = level.text()
    corrected = re.search(r"(?s)<Corrected_Attitude>.*?</Corrected_Attitude>", text)[0]
    angles = re.findall(r"(?s)<Angles>.*?</Angles>\n?", corrected)
    late = read(tmp_path, text.replace(corrected, corrected.replace("".join(angles[:9]), "")))
    assert miss(late, level.ground(IMAGE, 0.0)) < 1e-4  # they begin 0.8 s after row 0
    with pytest.raises(RpcFormatError, match=r"its attitudes from 1\.2"):
        read(tmp_path, text.replace(corrected, corrected.replace("".join(angles[:12]), "")))
    with pytest.raises(RpcFormatError, match=r"no attitudes from 2\.08 to 2\.95 s"):
        read(tmp_path, text.replace(corrected, corrected.replace("".join(angles[20:26]), "")))


def test_a_frame_of_another_scene_is_a_doubt(tmp_path: Path) -> None:
    away = read(tmp_path, re.sub(r"(<FRAME_LON>\d+\.)\d", r"\g<1>0", TEXTS[5]))
    _, doubts = corners_off(away.model, away.corners)
    assert re.fullmatch(r"the corners that its producer states lie \d+ m from the camera's", doubts[0].sentence)
    assert not doubts[0].refused


def _without(text: str, tag: str) -> str:
    return re.sub(rf"(?s)<{tag}>.*</{tag}>", "", text)


def _later(text: str, tag: str, hours: int) -> str:
    """All times in an element moved by hours of a day that has them."""
    part = re.search(rf"(?s)<{tag}>.*?</{tag}>", text)[0]
    return text.replace(part, re.sub(r"T10:", f"T{10 + hours:02d}:", part))


_FIRST_POINT = re.search(r"(?s)<Point>.*?</Point>\n", TEXTS[2])[0]
LIES: dict[str, tuple[str, str]] = {
    "level 1B": (TEXTS[5].replace(">1A<", ">1B<"), "level 1B, resampled"),
    "level 2A by its profile": (
        _without(TEXTS[5], "PROCESSING_LEVEL").replace("SCENE_1A", "SCENE_2A"),
        "level 2A, resampled",
    ),
    "a map": (
        TEXTS[5]
        .replace("SPOTSCENE_1A", "SPOTView")
        .replace("PROCESSING_LEVEL>1A", "GEOMETRIC_PROCESSING>Precision(2B)")
        .replace("PROCESSING_LEVEL>", "GEOMETRIC_PROCESSING>"),
        "level 2B, resampled",
    ),
    "another satellite": (TEXTS[5].replace(">SPOT<", ">FORMOSAT<"), "a scene of FORMOSAT 5; of DIMAP 1 only SPOT"),
    "SPOT 7": (TEXTS[5].replace("_INDEX>5<", "_INDEX>7<"), "a scene of SPOT 7"),
    "no mission": (re.sub("<MISSION.*?</MISSION_INDEX>", "", TEXTS[5]), "a scene of no MISSION"),
    "no strip": (_without(TEXTS[5], "Data_Strip"), "no Data_Strip"),
    "no ephemeris": (_without(TEXTS[5], "Points"), "0 positions"),
    "no velocity": (TEXTS[5].replace("Velocity>", "Speed>"), "no Velocity/X"),
    "no attitudes": (_without(TEXTS[5], "Corrected_Attitudes"), "no Corrected_Attitudes"),
    "no look angles": (_without(TEXTS[5], "Instrument_Look_Angles_List"), "no Instrument_Look_Angles at all"),
    "no time": (TEXTS[2].replace("SCENE_CENTER_TIME>", "CENTER>"), "no SCENE_CENTER_TIME"),
    "no size": (TEXTS[2].replace("NCOLS>", "COLS>"), "no NCOLS"),
    "detectors to 900": (TEXTS[2].replace("_ID>1200<", "_ID>900<"), "2 Look_Angles, of detectors 1 to 900"),
    "a detector twice": (TEXTS[2].replace("_ID>1<", "_ID>1200<"), "of detectors 1200 to 1200"),
    "detectors of one angle": (re.sub("<(PSI_.)>.*?<", r"<\1>0.1<", TEXTS[2]), "of one direction"),
    "a detector elsewhere": (re.sub("<PSI_Y>.*?<", "<PSI_Y>0.32<", TEXTS[5], count=1), "px from a smooth line"),
    "the ephemeris of another hour": (_later(TEXTS[2], "Ephemeris", 1), "the image lasts from 0.00 to"),
    "the ephemeris of before": (_later(TEXTS[2], "Ephemeris", -1), "its positions from -37"),
    "one time twice": (TEXTS[2].replace(_FIRST_POINT, _FIRST_POINT * 2), "10 positions, or their times do not rise"),
    "kilometres": (re.sub(r"(<[XYZ]>-?\d+)\d{3}\.", r"\1.", TEXTS[2]), "from the Earth's centre"),
    "attitudes in degrees": (re.sub(r"<YAW>.*?<", "<YAW>2.92<", TEXTS[5]), "are these radians"),
    "a period of 1.5": (re.sub("<LINE_PERIOD>.*?<", "<LINE_PERIOD>1.504<", TEXTS[5]), "LINE_PERIOD is 1.504"),
    "a period of 0": (re.sub("<LINE_PERIOD>.*?<", "<LINE_PERIOD>0<", TEXTS[5]), "LINE_PERIOD is 0"),
    "a center beyond": (TEXTS[5].replace("_LINE>480<", "_LINE>1e300<"), "absurdly large"),
    "nan": (re.sub("<PSI_X>.*?<", "<PSI_X>nan<", TEXTS[5], count=1), "PSI_X holds a number that is not finite"),
    "a word": (re.sub("<ROLL>.*?<", "<ROLL>level<", TEXTS[5]), "ROLL is not a list of numbers"),
    "another time": (TEXTS[2].replace("1994-02-28T", "28.02.1994 "), "is not a UTC time"),
    "an entity": (TEXTS[5].replace("<Dimap_Document", '<!DOCTYPE a [<!ENTITY a "b">]><Dimap_Document'), "DOCTYPE"),
    "an end that lacks": (TEXTS[5][:-500], "not an XML document"),
}


@pytest.mark.few(5)
@pytest.mark.parametrize("lie", LIES)
def test_a_scene_that_lies_gives_one_line(tmp_path: Path, lie: str) -> None:
    text, words = LIES[lie]
    assert text not in TEXTS.values()
    with pytest.raises(RpcFormatError, match=words) as told:
        read(tmp_path, text)
    assert "\n" not in str(told.value)
    assert "METADATA.DIM" in str(told.value)


def test_damage_anywhere_is_one_line(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    brief = re.sub(r"(?s)<Look_Angles_List>.*?</Look_Angles_List>", "", TEXTS[5])
    for k in range(40):
        text = bytearray((TEXTS[2] if k % 2 else brief).encode())
        for at in rng.integers(60, len(text), 3):
            text[at] = rng.choice(list(b"<>0x-e.9 /"))
        path = tmp_path / "METADATA.DIM"
        path.write_bytes(text[: rng.integers(1, len(text)) if k % 7 == 0 else None])
        said = ""
        try:
            read_linescan(path)
        except BarpcError as error:
            said = str(error)
        assert "\n" not in said
