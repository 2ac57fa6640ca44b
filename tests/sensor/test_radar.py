"""How well radars are known: where the figures come from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import RpcFormatError
from barpc.base.geodesy import ecef_from_ground
from barpc.sensor.sentinel1 import RangeDoppler, read_annotation
from barpc.sensor.sicd import open_sicd
from tests.sensor.radar_documents import document
from tests.sensor.s1_product import Product


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("kind", "delays", "wanted"),
    [
        ("AUX_POEORB", True, (0.5025, 0.5025)),
        ("AUX_RESORB", True, (0.5099, 0.5099)),
        ("AUX_PREORB", False, (3.5228, 4.0200)),
        ("unknown", True, (2.5495, 2.5495)),
        (None, False, (3.5228, 4.0200)),
    ],
)
def test_the_accuracy_of_a_range_doppler_model_is_that_of_its_orbit_and_of_what_is_not_corrected(
    kind, delays, wanted, tmp_path
):
    path, product = tmp_path / "orbit.EOF", Product()
    mission = "<Mission>Sentinel-1A</Mission>"
    path.write_bytes(product.eof().replace(mission.encode(), f"{mission}<File_Type>{kind}</File_Type>".encode()))
    model = RangeDoppler.from_annotation(
        read_annotation(product.xml(), name="a"),
        orbit=path if kind else None,
        atmosphere=delays,
        bistatic="full" if delays else None,
    )
    assert model.accuracy == pytest.approx(wanted, abs=1e-4)


def test_a_downlinked_orbit_is_known_to_metres():
    told = Product().xml().replace(b"Auxiliary", b"Downlink")
    model = RangeDoppler.from_annotation(read_annotation(told, name="a"), atmosphere=True)
    assert model.accuracy == pytest.approx((np.hypot(2.5, 0.5), np.hypot(2.5, 4.0)))


def stated(*fields: str, folder: Path) -> tuple[float, float] | None:
    """The accuracy of a SICD image with these error statistics."""
    text = f"<ErrorStatistics>{''.join(fields)}</ErrorStatistics></SICD>"
    (folder / "image.xml").write_text(document("PFA", squint=0.0).replace("</SICD>", text))
    return open_sicd(folder / "image.xml").accuracy


def errors_of_orbit(frame: str, *sigma: float) -> str:
    axes = "".join(f"<P{k}>{value}</P{k}>" for k, value in enumerate(sigma, 1))
    return (
        f"<Components><PosVelErr><Frame>{frame}</Frame>{axes}</PosVelErr>"
        "<RadarSensor><RangeBias>2.0</RangeBias></RadarSensor></Components>"
    )


def test_the_accuracy_of_a_sicd_image_is_what_it_states(tmp_path):
    whole = "<CompositeSCP><Rg>1.5</Rg><Az>2.5</Az><RgAz>0.1</RgAz></CompositeSCP>"
    assert stated(whole, folder=tmp_path) == (1.5, 2.5)
    assert stated(whole.replace("<Rg>1.5</Rg>", "<Rg>0</Rg>"), folder=tmp_path) is None
    assert stated(errors_of_orbit("NED", 1.0, 2.0, 3.0), folder=tmp_path) is None
    nowhere = "<X>0</X><Y>0</Y><Z>0</Z></ARPVel>"
    text = document("PFA").replace(
        "</SICD>", f"<ErrorStatistics>{errors_of_orbit('RIC_ECF', 1, 2, 3)}</ErrorStatistics></SICD>"
    )
    begin, end = text.index("<ARPVel>") + 8, text.index("</ARPVel>") + 9
    (tmp_path / "image.xml").write_text(text[:begin] + nowhere + text[end:])
    assert open_sicd(tmp_path / "image.xml").accuracy is None
    with pytest.raises(RpcFormatError, match="not a list of numbers"):
        stated(whole.replace("1.5", "good"), folder=tmp_path)


@pytest.mark.parametrize(("frame", "aside"), [("RIC_ECF", 0.0), ("RIC_ECI", 0.048)])
def test_errors_of_an_orbit_are_taken_along_the_lines_that_they_act_on(frame, aside, tmp_path):
    """At 35 degrees of incidence a range sees radial and across by the look angle; in inertial axes the flight over the
    turning Earth goes a little aside."""
    for radial, along, across in ((3.0, 1.0, 1e-6), (1e-6, 2.0, 1e-6), (1e-6, 1e-6, 4.0)):
        far, late = stated(errors_of_orbit(frame, radial, along, across), folder=tmp_path)
        position = open_sicd(tmp_path / "image.xml").orbit(np.array([3.0]))[0][:, 0]
        sight = position - ecef_from_ground(np.array([5.4, 43.3, 120.0]))
        look = np.arccos(sight @ position / np.linalg.norm(sight) / np.linalg.norm(position))
        assert 0.5 < look < 0.6
        assert far == pytest.approx(np.hypot(2.0, np.hypot(radial * np.cos(look), across * np.sin(look))), rel=0.01)
        assert late == pytest.approx(np.hypot(along * np.sqrt(1 - aside**2), aside * across), rel=0.01, abs=0.01)
    assert stated(errors_of_orbit("ECF", 3.0, 3.0, 3.0), folder=tmp_path) == pytest.approx((np.hypot(2, 3), 3.0))
