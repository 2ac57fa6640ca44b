"""The Sentinel-1 Range-Doppler model, against an exact orbit and against the products' own grids.

The synthetic product of `s1_product` runs everywhere; the real annotations only where they are present.
"""

from __future__ import annotations

import csv
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import BarpcError, BarpcWarning, FitError, InputError, RpcError, RpcFormatError
from barpc.base.geodesy import ecef_from_ground
from barpc.base.safe_io import parse_xml
from barpc.fit import FitOptions, fit_rpc
from barpc.sensor.curve import Curve
from barpc.sensor.document import seconds
from barpc.sensor.geometry import view_angles
from barpc.sensor.sentinel1 import (
    RangeDoppler,
    burst_rows,
    fit_orbit,
    grid_residuals,
    mosaic,
    mosaic_offsets,
    open_product,
    read_annotation,
)
from tests.fuzz.mutate import mutate_xml
from tests.lanes import diagonal, rest_slow
from tests.sensor.conftest import slopes_off
from tests.sensor.s1_product import GRD, INTERVAL, IW, SAMPLING, START, STRIPMAP, Product

IW1 = IW["IW1"]
AUXILIARY = ["20210216t151207", "20220104t170558", "20211223t051122"]
SLC = ["20160114t054006", "20210216t151207", "20220104t170558", "20210401t052624", "20190803t164007"]


def annotation_path(shared_data: Path, stamp: str) -> Path:
    return next((shared_data / "sar").glob(f"*-{stamp}-*.xml"))


def quiet_model(path: Path) -> RangeDoppler:
    """The model of a product whose grid may be inconsistent."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BarpcWarning)
        return RangeDoppler.from_annotation(path)


def scatter(model: RangeDoppler, alt: tuple[float, float], count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    return rng.uniform(0, 1, (count, 2)) * (np.array(model.size) - 1), rng.uniform(*alt, count)


@pytest.fixture(scope="module")
def model() -> RangeDoppler:
    return IW1.model()


@pytest.fixture(scope="module")
def grd() -> RangeDoppler:
    return GRD.model()


# --- geometry against an exact orbit


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "product",
    [
        *(IW["IW1"], GRD, STRIPMAP, Product(lon=-180.0, argument=0.3)),
        *rest_slow([Product(swath="EW1", noise=5e-3), IW["IW2"], IW["IW3"]], keep=0),
    ],
)
def test_times_are_those_of_the_exact_orbit(product: Product) -> None:
    built = product.model()
    image, alt = scatter(built, (-500.0, 9000.0), 60)
    ground = built.localize(image, alt)
    azimuth_time, range_time = built.azimuth_range(ground)
    truth = product.azimuth_range(ground)
    epoch = seconds(built.epoch, START)
    assert np.abs(azimuth_time + epoch - truth[0]).max() <= 1e-6 * INTERVAL
    assert np.abs(range_time - truth[1]).max() * SAMPLING <= 1e-6


@pytest.mark.few(2)
@pytest.mark.parametrize("delays", [{}, {"atmosphere": True}, {"bistatic": "annotated"}, {"bistatic": "full"}])
def test_localisation_inverts_projection_from_the_dead_sea_to_everest(delays: dict[str, bool]) -> None:
    built = RangeDoppler.from_annotation(read_annotation(IW1.xml()), **delays)
    image, alt = scatter(built, (-500.0, 9000.0))
    assert np.abs(built.project(built.localize(image, alt)) - image).max() <= 1e-8


def test_a_grd_localises_back_through_its_ground_range_polynomials(grd: RangeDoppler) -> None:
    image, alt = scatter(grd, (-500.0, 9000.0))
    assert np.abs(grd.project(grd.localize(image, alt)) - image).max() <= 1e-8


@pytest.mark.parametrize(
    ("product", "bistatic", "atmosphere"),
    diagonal([IW["IW1"], GRD], [None, "annotated"], [False, True]),
)
def test_derivatives_with_delays_are_central_differences(
    product: Product, atmosphere: bool, bistatic: str | None
) -> None:
    annotation = read_annotation(product.xml())
    built = RangeDoppler.from_annotation(annotation, atmosphere=atmosphere, bistatic=bistatic)
    rng = np.random.default_rng(2)
    rows = (0.59 + np.arange(20)) / INTERVAL  # away from the times where polynomials of a GRD join
    image = np.stack([rng.uniform(0, built.size[0], 20), rows % (built.size[1] - 1000)], axis=1)
    ground = built.localize(image, rng.uniform(0, 3000, 20))
    assert slopes_off(built, ground, np.array([1e-4, 1e-4, 10.0])) <= 1e-7


def test_a_left_looking_model_sees_the_other_side_of_the_track(model: RangeDoppler) -> None:
    left = replace(model, look="left")
    image, alt = scatter(left, (0.0, 3000.0), 200)
    ground = left.localize(image, alt)
    assert np.abs(left.project(ground) - image).max() <= 1e-8
    assert np.isnan(model.project(ground)).all()
    position, velocity, _ = left.orbit.states(left.azimuth_range(ground)[0])
    right = np.cross(velocity, position, axis=0)
    assert (((ecef_from_ground(ground).T - position) * right).sum(axis=0) < 0).all()


def test_points_the_orbit_does_not_pass_are_nan(model: RangeDoppler) -> None:
    ground = model.localize(np.array([10000.0, 6000.0]), np.array(0.0))
    far = np.array([ground + [0, 20.0, 0], ground - [0, 20.0, 0], [ground[0] + 180.0, -ground[1], 0.0]])
    assert np.isnan(model.project(far)).all()
    assert np.isnan(model.localize(np.array([[10000.0, 1e6], [-4e5, 6000.0]]), np.zeros(2))[:, :2]).all()


# --- orbit


def test_noisy_velocities_do_not_move_the_orbit() -> None:
    quiet, noisy = Product().model(), Product(noise=5e-3).model()
    times = np.linspace(0.0, 25.0, 50)
    difference = noisy.orbit.states(times)[0] - quiet.orbit.states(times)[0]
    assert np.abs(difference).max() <= 2e-5


def test_whole_microseconds_of_the_state_vectors_do_not_raise_the_degree() -> None:
    product = Product()
    time_ = -65.0 + 10.0 * np.arange(17)
    jitter = np.random.default_rng(1).uniform(-5e-7, 5e-7, 17)
    states = [product.state(t + dt) for t, dt in zip(time_, jitter, strict=True)]
    position, velocity = (np.array(s) for s in zip(*states, strict=True))
    orbit = fit_orbit(time_, position, velocity, (0.0, 25.0))
    assert 1e-3 <= orbit.sigma[0] <= 6e-3
    assert orbit.sigma[1] <= 2e-4
    assert orbit.coeffs.shape[1] - 1 <= 8
    exact, velocity = (np.array([product.state(t)[k] for t in np.linspace(0, 25, 20)]) for k in (0, 1))
    off = orbit.states(np.linspace(0, 25, 20))[0].T - exact
    along = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    late = (off * along).sum(axis=1, keepdims=True)
    assert np.abs(late).max() <= 3e-3  # the mean of 17 times, each 3 mm off
    assert np.linalg.norm(off - late * along, axis=1).max() <= 1e-4


def test_any_curve_may_be_the_orbit(model: RangeDoppler) -> None:
    times = np.arange(-60.0, 91.0, 10.0)
    splined = replace(model, orbit=Curve.through(times, model.orbit(times)[0].T))
    ground = model.localize(*scatter(model, (0.0, 3000.0), 200))
    assert np.abs(splined.project(ground) - model.project(ground)).max() <= 1e-4


def test_the_order_and_repetition_of_state_vectors_do_not_matter() -> None:
    product = Product()
    times = -65.0 + 10.0 * np.arange(17)
    position, velocity = (np.array(s) for s in zip(*map(product.state, times), strict=True))
    orbit = fit_orbit(times, position, velocity, (0.0, 25.0))
    shuffled = np.random.default_rng(0).permutation(np.r_[np.arange(17), 3, 4])
    assert fit_orbit(times[shuffled], position[shuffled], velocity[shuffled], (0.0, 25.0)) == orbit


def test_a_precise_orbit_file_gives_the_same_model(tmp_path: Path, model: RangeDoppler) -> None:
    path = tmp_path / "S1A_OPER_AUX_POEORB.EOF"
    path.write_bytes(IW1.eof())
    annotation = read_annotation(IW1.xml())
    precise = RangeDoppler.from_annotation(annotation, orbit=path)
    ground = model.localize(*scatter(model, (0.0, 3000.0), 200))
    assert np.abs(precise.project(ground) - model.project(ground)).max() <= 3e-4
    path.write_bytes(IW1.eof(start=20000.0))
    with pytest.raises(RpcFormatError, match="take the orbit file of that day"):
        RangeDoppler.from_annotation(annotation, orbit=path)
    path.write_bytes(IW1.eof().replace(b"EARTH_FIXED", b"MEAN_OF_DATE"))
    with pytest.raises(RpcFormatError, match="MEAN_OF_DATE"):
        RangeDoppler.from_annotation(annotation, orbit=path)
    path.write_bytes(IW1.xml())
    with pytest.raises(RpcFormatError, match="not a Sentinel-1 orbit file"):
        RangeDoppler.from_annotation(annotation, orbit=path)


# --- frames


def test_bursts_are_cut_in_the_middle_of_their_overlap() -> None:
    rows = burst_rows(read_annotation(IW1.xml()))
    assert [r.first_line for r in rows] == [1500 * k for k in range(9)]
    assert [r.first_row for r in rows] == [1342 * k for k in range(9)]
    assert rows[0].start == 20
    assert rows[-1].stop == 8 * 1342 + 1480
    for before, after in pairwise(rows):
        assert before.stop == after.start
        last_of_before, first_of_after = before.first_row + 1480, after.first_row + 20
        assert abs((last_of_before - before.stop) - (after.start - first_of_after)) <= 1
    assert max(abs(r.offset) for r in rows) <= 5e-4


def test_a_burst_is_a_window_of_the_stitched_frame(model: RangeDoppler) -> None:
    annotation = read_annotation(IW1.xml())
    rows = burst_rows(annotation)
    for k in (0, 4, 8):
        burst = RangeDoppler.from_annotation(annotation, burst=k)
        assert burst.size == (IW1.samples, IW1.lines_per_burst)
        ground = burst.localize(*scatter(burst, (0.0, 2000.0), 50))
        shifted = burst.project(ground) + [0.0, rows[k].first_row + rows[k].offset]
        assert np.abs(shifted - model.project(ground)).max() <= 1e-6


@pytest.mark.slow
def test_swaths_stand_side_by_side_in_the_mosaic() -> None:
    annotations = [read_annotation(product.xml()) for product in IW.values()]
    whole = mosaic(annotations)
    offsets = mosaic_offsets(annotations)
    for annotation, offset in zip(annotations, offsets, strict=True):
        swath = RangeDoppler.from_annotation(annotation)
        ground = swath.localize(*scatter(swath, (0.0, 2000.0), 50))
        assert np.abs(whole.project(ground) - swath.project(ground) - offset).max() <= 1e-6
    assert mosaic(annotations[::-1]) == whole


def test_the_annotated_bistatic_correction_meets_the_lines_of_the_grid() -> None:
    for product in (IW1, GRD):
        annotation = read_annotation(product.xml())
        built = RangeDoppler.from_annotation(annotation, bistatic="annotated")
        row = seconds(annotation.line_time(annotation.grid.image[:, 1]), built.epoch) / INTERVAL
        difference = built.project(annotation.grid.ground)[:, 1] - row
        assert np.abs(difference).max() <= 1e-3
        plain = RangeDoppler.from_annotation(annotation).project(annotation.grid.ground)[:, 1] - row
        assert 0.04 <= np.abs(plain).max() <= 0.2


def test_a_bistatic_correction_completes_that_of_the_processor_only() -> None:
    annotation = replace(read_annotation(IW1.xml()), bistatic_applied=False)
    with pytest.raises(InputError, match="no bistatic correction by the processor"):
        RangeDoppler.from_annotation(annotation, bistatic="annotated")


def test_the_atmosphere_lengthens_the_path_by_its_zenith_delay_over_the_cosine() -> None:
    annotation = read_annotation(IW1.xml())
    with_air = RangeDoppler.from_annotation(annotation, atmosphere=True)
    without = RangeDoppler.from_annotation(annotation)
    ground = without.localize(np.array([10000.0, 6000.0]), np.array([0.0, 3000.0]))
    shift = (with_air.project(ground) - without.project(ground))[:, 0] * 2.329562
    cosine = np.cos(np.deg2rad(view_angles(without, ground)[0]))
    np.testing.assert_allclose(shift * cosine, [2.41, 2.41 - 3000 / 3411 + 9e6 / 8.55e7], rtol=1e-6)


# --- products


def test_a_grd_is_not_taken_for_a_swath(tmp_path: Path) -> None:
    path = tmp_path / GRD.name
    path.write_bytes(GRD.xml())
    assert open_product(path).size == (GRD.samples, GRD.lines)
    with pytest.raises(InputError, match="no swath iw1; choose one of iw"):
        open_product(path, swath="iw1")
    with pytest.raises(InputError, match="this is a IW GRD of IW"):
        mosaic([path])
    with pytest.raises(InputError, match="no burst 0"):
        open_product(path, burst=0)
    with pytest.raises(InputError, match="of one SLC swath"):
        open_product(path, bistatic="full")


def test_a_stripmap_image_is_one_frame_without_bursts(tmp_path: Path) -> None:
    path = tmp_path / STRIPMAP.name
    path.write_bytes(STRIPMAP.xml())
    strip = open_product(path, swath="s3", bistatic="full")
    assert strip.size == (STRIPMAP.samples, STRIPMAP.lines)


# --- bad input


def broken(xml: bytes) -> Iterator[tuple[str, bytes, str]]:
    """Ways in which an annotation can be wrong: what, bytes, message."""
    yield "truncated", xml[: len(xml) // 2], "not an XML document"
    yield "doctype", xml.replace(b"<product>", b"<!DOCTYPE product []><product>"), "DOCTYPE"
    yield "another root", b"<calibration/>", "not a Sentinel-1 product annotation"
    yield "no orbit", _without(xml, b"orbitList"), "0 state vectors"
    yield "no grid", _without(xml, b"geolocationGrid"), "no geolocation grid"
    yield "no spacing", _without(xml, b"azimuthTimeInterval"), "no imageAnnotation/imageInformation/azimuth"
    yield "not a number", xml.replace(b"<rank>9<", b"<rank>nine<"), "not a list of numbers"
    yield "infinite", xml.replace(b"<pri>5.823e-04<", b"<pri>inf<"), "not finite or absurdly large"
    yield "negative", xml.replace(b"<pri>5", b"<pri>-5"), "expected above 0"
    yield "no date", xml.replace(b"<productFirstLineUtcTime>2021", b"<productFirstLineUtcTime>x"), "UTC time"
    yield "inertial orbit", xml.replace(b"Earth Fixed", b"Inertial"), "not Earth fixed"
    yield "an odd burst", xml.replace(b"<lastValidSample>-1", b"<lastValidSample>"), "last valid samples"
    yield "raw data", xml.replace(b">SLC<", b">RAW<"), "no geometry that is known"


def _without(xml: bytes, tag: bytes) -> bytes:
    start, stop = xml.index(b"<" + tag + b">"), xml.index(b"</" + tag + b">") + len(tag) + 3
    return xml[:start] + xml[stop:]


@pytest.mark.few(5)
@pytest.mark.parametrize("index", range(13), ids=[what for what, _, _ in broken(IW["IW1"].xml())])
def test_a_broken_annotation_is_refused_with_what_and_where(index: int) -> None:
    _, xml, message = list(broken(IW1.xml()))[index]
    with pytest.raises(RpcError, match=message):
        RangeDoppler.from_annotation(read_annotation(xml, name="s1a.xml"))


@pytest.mark.slow
@pytest.mark.parametrize("count", rest_slow([20, 200]))
def test_no_mutation_of_an_annotation_gets_past_the_errors_that_are_meant(count: int) -> None:
    rng = np.random.default_rng(4)
    small = replace(IW["IW1"], samples=900, num_bursts=3, lines_per_burst=60, burst_cycle=50)
    sources = [small.xml(), replace(GRD, samples=900, num_bursts=1, lines_per_burst=300).xml()]
    for k in range(count):
        xml = mutate_xml(sources[k % 2], rng)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", BarpcWarning)
                annotation = read_annotation(xml, name="mutated.xml")
                built = RangeDoppler.from_annotation(annotation, bistatic="annotated" if k % 3 else None)
            built.project_jacobian(built.localize(np.array([10.0, 10.0]), np.array(0.0)))
        except BarpcError as error:
            assert "\n" not in str(error)  # noqa: PT017 - anything else must surface


def test_too_few_state_vectors_and_extrapolation_are_refused() -> None:
    with pytest.raises(RpcError, match="3 state vectors within 70 s of the image, at least 4 needed"):
        Product(states_from=0.0, num_states=3).model()
    with pytest.raises(RpcError, match="give a precise orbit file that covers it"):
        Product(states_from=2.0).model()
    with pytest.raises(RpcError, match="give a precise orbit file that covers it"):
        Product(states_from=-65.0, num_states=9).model()
    assert Product(states_from=0.5, num_states=4).model().orbit.coeffs.shape[1] - 1 <= 4


# --- RPCs


def test_an_rpc_of_a_swath_keeps_a_thousandth_of_a_pixel_and_its_rows_to_the_floor(
    model: RangeDoppler,
) -> None:
    fit = fit_rpc(model, model.size, model.alt_range)
    assert fit.rmse_ckp[0] <= 1.5e-4
    assert fit.rmse_ckp[1] <= 1e-6


def test_a_point_costs_microseconds(model: RangeDoppler) -> None:
    ground = model.localize(*scatter(model, (0.0, 2000.0), 25000))
    best = np.inf
    for _ in range(5):
        start = time.process_time()
        model.project(ground)
        best = min(best, time.process_time() - start)
    assert best <= 0.2  # 25,000 points; the figure itself is in the benchmarks


# --- real products


@pytest.mark.parametrize("stamp", rest_slow(AUXILIARY))
def test_an_auxiliary_orbit_meets_the_grid_of_the_product(shared_data: Path, stamp: str) -> None:
    annotation = read_annotation(annotation_path(shared_data, stamp))
    range_, azimuth = grid_residuals(annotation, RangeDoppler.from_annotation(annotation)).T
    assert np.abs(range_).max() <= 1e-4
    assert azimuth.std() <= 2.5e-4
    assert abs(azimuth.mean()) <= 7e-4


def _of_three(shared_data: Path) -> list[Path]:
    return sorted((shared_data / "radar" / "s1_three_swaths").glob("*_iw[13].xml"))


@pytest.mark.few(1)
@pytest.mark.parametrize("number", rest_slow(range(-1, 10), keep=2))
def test_a_downlinked_orbit_meets_the_grid_by_the_velocities_it_states(shared_data: Path, number: int) -> None:
    """They are not the derivatives of its positions, by which rows are 0.005 to 0.12 lines off."""
    path = annotation_path(shared_data, "20210401t052624") if number < 0 else _of_three(shared_data)[number]
    annotation = read_annotation(path)
    model = RangeDoppler.from_annotation(annotation)
    assert annotation.states.source == "Downlink"
    range_, azimuth = grid_residuals(annotation, model).T
    assert np.abs(azimuth).max() <= 1.2e-3
    assert azimuth.std() <= 2.5e-4
    assert np.abs(range_).max() <= 3e-4
    derived = replace(model, orbit=replace(model.orbit, stated=np.zeros((1, 3))))
    assert np.abs(grid_residuals(annotation, derived)[:, 1]).max() > 0.012


@pytest.mark.slow
def test_velocities_that_only_scatter_are_not_followed(shared_data: Path) -> None:
    """A smooth difference of 10 mm/s is; the same as noise is not, nor one of a tenth of a millimetre."""
    annotation = read_annotation(annotation_path(shared_data, AUXILIARY[0]))
    states, noise = (
        annotation.states,
        np.random.default_rng(5).normal(0, 6e-3, (len(annotation.states.time), 3)),
    )
    smooth = np.array([6e-3, -6e-3, 6e-3]) * np.linspace(0.5, 1.5, len(noise))[:, None] ** 2
    for wrong, followed in (
        (smooth, True),
        (noise, False),
        (5e-3 * smooth, False),
        (smooth + 0.1 * noise, True),
    ):
        moved = replace(annotation, states=replace(states, velocity=states.velocity + wrong))
        model = RangeDoppler.from_annotation(moved)
        assert bool(model.orbit.stated.any()) == followed
        if followed:
            at = np.array([12.0])  # s
            times = (states.time - model.epoch) / np.timedelta64(1, "s")
            given = [np.interp(at, times, axis) for axis in smooth.T]
            found = model.orbit.states(at)[1] - replace(model.orbit, stated=np.zeros((1, 3))).states(at)[1]
            np.testing.assert_allclose(found, given, atol=1e-3)


def test_a_product_of_2016_meets_its_grid(shared_data: Path) -> None:
    annotation = read_annotation(annotation_path(shared_data, "20160114t054006"))
    range_, azimuth = grid_residuals(annotation, RangeDoppler.from_annotation(annotation)).T
    assert np.abs(azimuth - np.median(azimuth)).max() <= 2.5e-3
    assert np.abs(range_).max() <= 6e-4


def test_an_inconsistent_grid_is_reported(shared_data: Path) -> None:
    with pytest.warns(BarpcWarning, match=r"difference 128\.3 samples, 1404\.6 lines"):
        RangeDoppler.from_annotation(annotation_path(shared_data, "20190803t164007"))


@pytest.mark.parametrize("stamp", rest_slow(AUXILIARY))
def test_incidence_angles_are_those_of_the_grid(shared_data: Path, stamp: str) -> None:
    path = annotation_path(shared_data, stamp)
    points = parse_xml(path).iter("geolocationGridPoint")
    stated = np.array([float(point.findtext("incidenceAngle")) for point in points])
    built, ground = RangeDoppler.from_annotation(path), read_annotation(path).grid.ground
    assert np.abs(view_angles(built, ground)[0] - stated).max() <= 0.04  # the grid counts from the Earth's centre
    ecef = ecef_from_ground(ground).T
    sight = built.orbit.states(built.azimuth_range(ground)[0])[0] - ecef
    cosine = (sight * ecef).sum(axis=0) / np.linalg.norm(sight, axis=0) / np.linalg.norm(ecef, axis=0)
    assert np.abs(np.rad2deg(np.arccos(cosine)) - stated).max() <= 1e-4


@pytest.mark.landing(3)
@pytest.mark.slow
@pytest.mark.parametrize("stamp", rest_slow([*SLC[:1], "20211223t051122", *SLC[1:]], keep=2))
def test_an_independent_tool_finds_the_same_image_points(shared_data: Path, stamp: str) -> None:
    """Another tool's points; its orbit is of degree 11, and its times are UNIX seconds in a float.

    Its velocities are the derivatives of positions, by which downlinked vectors do not meet their product's grid.
    """
    path = annotation_path(shared_data, stamp)
    built, annotation = quiet_model(path), read_annotation(path)
    built = replace(built, orbit=replace(built.orbit, stated=np.zeros((1, 3))))
    with (shared_data / "truth" / "sar" / f"{path.name}.csv").open() as file:
        rows = list(csv.DictReader(file))
    table = {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}
    ground = np.stack([table["lon"], table["lat"], table["h"]], axis=1)
    image = built.project(ground)
    origin = np.zeros(2)
    if annotation.bursts:
        first = annotation.bursts[0].first_valid
        valid = first >= 0
        origin = np.array([min(b.first_valid[b.first_valid >= 0].min() for b in annotation.bursts), valid.argmax()])
    col = np.abs(image[:, 0] - origin[0] - table["eos_col"]).max()
    row = np.abs(image[:, 1] - origin[1] - table["eos_row"]).max()
    downlinked = annotation.states.source == "Downlink"
    assert row <= (4e-3 if downlinked else 2e-4)
    assert col <= (2.1e-2 if downlinked else 1e-4)


@pytest.mark.slow
def test_rpcs_of_real_swaths_reach_the_stated_accuracy(shared_data: Path) -> None:
    box, inside, rows = [], [], []
    for stamp in SLC:
        built = quiet_model(annotation_path(shared_data, stamp))
        options = FitOptions(space="ground", grid=(50, 50, 10))
        box.append(fit_rpc(built, built.size, built.alt_range, options=options).rmse_ckp[0])
        rpc = fit_rpc(built, built.size, built.alt_range).rpc
        image, alt = scatter(built, built.alt_range, 5000)
        error = rpc.project(built.localize(image, alt)) - image
        inside.append(np.sqrt((error[:, 0] ** 2).mean()))
        rows.append(np.sqrt((error[:, 1] ** 2).mean()))
    assert np.mean(box) <= 1.6e-4
    assert np.mean(inside) <= 6e-5
    assert np.max(inside) <= 1.5e-4
    assert np.max(rows) <= 1e-6


@pytest.mark.slow
def test_an_rpc_of_three_swaths_reaches_two_thousandths_of_a_pixel(shared_data: Path) -> None:
    errors = []
    for stamp in SLC[:4]:
        swath = quiet_model(annotation_path(shared_data, stamp))
        whole = replace(swath, size=(69300, 13450))
        fit = fit_rpc(
            whole,
            whole.size,
            whole.alt_range,
            options=FitOptions(grid=(20, 20, 10), tolerance=0.02),  # in the corners
        )
        image, alt = scatter(whole, whole.alt_range, 5000)
        error = fit.rpc.project(whole.localize(image, alt)) - image
        errors.append(np.sqrt((error[:, 0] ** 2).mean()))
    assert np.mean(errors) <= 2e-3
    assert np.max(errors) <= 2.6e-3  # at 57 degrees north; the others stay below 1.8e-3


@pytest.mark.slow
def test_the_rpc_of_a_grd_is_refused(shared_data: Path) -> None:
    built = RangeDoppler.from_annotation(annotation_path(shared_data, "20211223t051122"))
    with pytest.raises(FitError, match=r"misses its check points by .* take the SLC of the scene$"):
        fit_rpc(built, built.size, built.alt_range)
