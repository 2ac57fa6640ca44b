"""Clocks of radars: what they add, where the figures on them come from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import RpcError, RpcFormatError
from barpc.base.geodesy import SPEED_OF_LIGHT, ecef_from_ground
from barpc.sensor.sentinel1 import RangeDoppler, read_annotation
from barpc.sensor.sicd import open_sicd
from barpc.sensor.timing import Clocked, Timed, Timing
from tests.sensor.radar_documents import KINDS, SIZE, document
from tests.sensor.s1_product import GRD, INTERVAL, SAMPLING, Product

MODELS = ("slc", "grd", "delays", *KINDS)


def model_of(kind: str, folder: Path) -> Clocked:
    if kind in KINDS:
        (folder / "image.xml").write_text(document(kind))
        return open_sicd(folder / "image.xml")
    annotation = read_annotation((GRD if kind == "grd" else Product()).xml(), name=kind)
    more = {"atmosphere": True, "bistatic": "full"} if kind == "delays" else {}
    return RangeDoppler.from_annotation(annotation, **more)


@pytest.mark.few(3)
@pytest.mark.parametrize("kind", MODELS)
def test_derivatives_by_range_and_azimuth_time_are_central_differences(kind, tmp_path):
    model, rng = model_of(kind, tmp_path), np.random.default_rng(3)
    assert isinstance(model, Clocked)
    middle = model.size[model.azimuth_axis] / 2
    timing = Timing([[3.0, 2e-4], [0.4, 1e-5]], middle, middle)
    ground = model.localize(rng.uniform(0.1, 0.9, (20, 2)) * model.size, rng.uniform(0, 300, 20))
    image, by_ground, by_timing, along = model.timed(timing).timing_jacobian(ground)
    again, jacobian = model.timed(timing).project_jacobian(ground)
    np.testing.assert_array_equal(image, again)
    np.testing.assert_array_equal(by_ground, jacobian)
    assert np.abs(along - image[:, model.azimuth_axis]).max() < 1.0  # px; of a radar with delays
    for degree, u in enumerate((np.ones(20), (along - middle) / middle)):
        for k, step in enumerate((0.01, 1e-6)):
            change = np.zeros((2, 2))
            change[degree, k] = step
            high, low = (
                model.timed(replace(timing, coeffs=timing.coeffs + s * change)).project(ground) for s in (1, -1)
            )
            numeric = (high - low) / (2 * step)
            np.testing.assert_allclose(
                u[:, None] * by_timing[:, :, k], numeric, rtol=0, atol=2e-6 * np.abs(numeric).max()
            )


def test_a_range_doppler_model_adds_them_to_its_times():
    """From the definitions: the orbit is a formula, zero Doppler is bracketed."""
    product = Product()
    model, rng = product.model(), np.random.default_rng(4)
    ground = model.localize(rng.uniform(2000, 10000, (30, 2)), rng.uniform(0, 300, 30))
    azimuth, both_ways = product.azimuth_range(ground)
    u = (azimuth / INTERVAL - 6000.0) / 5000.0
    timed = Timed(model, Timing([[3.0, 2e-3], [0.7, -1e-4]], 6000.0, 5000.0))
    col = (both_ways + 2.0 * (3.0 + 0.7 * u) / SPEED_OF_LIGHT - product.first_range_time) * SAMPLING
    row = (azimuth + 2e-3 - 1e-4 * u) / INTERVAL
    np.testing.assert_allclose(timed.project(ground), np.column_stack([col, row]), rtol=0, atol=2e-5)
    assert (timed.project(ground) - model.project(ground) > [1.0, 0.9]).all()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # sarkit's own
@pytest.mark.parametrize("side", "RL")
def test_a_sicd_image_moves_as_another_implementation_adjusts_it(side, tmp_path):
    """One time for all pixels (PFA): the standard's adjustable offsets of orbit and receive time say the same."""
    projection = pytest.importorskip("sarkit.sicd.projection", reason="sarkit is another SICD implementation")
    etree = pytest.importorskip("lxml.etree")
    (tmp_path / "image.xml").write_text(document("PFA", side=side))
    model, rng = open_sicd(tmp_path / "image.xml"), np.random.default_rng(5)
    image, far, late, time = rng.uniform(0, SIZE, (12, 2)), 3.0, 4e-4, np.array([3.0])
    ground = Timed(model, Timing([[far, late]])).localize(image, np.full(12, 200.0))
    (position, speed), (then, fast) = model.orbit(time - late), model.orbit(time)
    said = projection.MetadataParams.from_xml(etree.parse(tmp_path / "image.xml"))
    offsets = projection.AdjustableParameterOffsets(
        delta_tx_SCP_COA=0.0,
        delta_tr_SCP_COA=-2.0 * far / SPEED_OF_LIGHT,
        delta_ARP_SCP_COA=(position - then)[:, 0],
        delta_VARP=(speed - fast)[:, 0],
    )
    plane = (image[:, ::-1] - model.origin) * model.spacing
    for k in range(12):
        sets = projection.apply_apos(said, projection.compute_projection_sets(said, plane[k : k + 1]), offsets)
        there, *_ = projection.r_rdot_to_constant_hae_surface(
            said.LOOK, said.SCP, sets, 200.0, delta_hae_max=1e-9, nlim=50
        )
        assert np.abs(np.ravel(there) - ecef_from_ground(ground[k])).max() < 1e-6
    moved = ecef_from_ground(ground) - ecef_from_ground(model.localize(image, np.full(12, 200.0)))
    assert 4.0 < np.linalg.norm(moved, axis=1).min() < 8.0


def test_a_timing_of_nothing_is_refused():
    for coeffs, scale in (
        ([[1.0]], 1.0),
        (np.zeros((0, 2)), 1.0),
        ([[1.0, 0.0]], 0.0),
        ([[np.nan, 0.0]], 1.0),
    ):
        with pytest.raises(RpcError, match=r"[Tt]iming"):
            Timing(coeffs, 0.0, scale)


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
