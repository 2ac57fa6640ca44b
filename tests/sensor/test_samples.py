"""Which samples of orbit and attitude are those of one image, and what cameras they make: limits from either side."""

from __future__ import annotations

import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barpc.base.errors import InputError, RpcFormatError
from barpc.base.geodesy import ecef_from_ground
from barpc.sensor.samples import Detector, Linescan, Samples, camera_of_samples, check_times, unit
from tests.sensor import linescan_files
from tests.sensor.linescan_files import SIZE, Flight, dimap, isd, stamp

FLIGHT = Flight(swing=0.0)
LAST = (SIZE[1] - 1) * FLIGHT.period
IMAGE = np.array([[0.0, 0.0], [3999.0, 0.0], [1234.5, 7000.25], [3999.0, 19999.0]])


def detector(flight: Flight = FLIGHT, period: float | None = None) -> Detector:
    sensor = flight.sensor
    return Detector(sensor.look, sensor.look_origin, period or flight.period, flight.size)


def samples(flight: Flight = FLIGHT, rows: object = slice(None), **changes: object) -> Samples:
    """What was really flown, every 20 ms from two steps before row 0 to three after the last, or some of it."""
    times, turned = flight.times[rows], flight.body.as_quat(scalar_first=True)[rows]
    flown = Samples("a.xml", times, flight.positions[rows], flight.velocities[rows], times, turned)
    return replace(flown, **changes)


def kept(rows: np.ndarray, only: str = "both") -> Samples:
    """Some of the rows of positions and of attitudes."""
    s = samples()
    if only != "attitudes":
        s = replace(s, times=s.times[rows], positions=s.positions[rows], velocities=s.velocities[rows])
    if only != "positions":
        s = replace(s, ticks=s.ticks[rows], quaternions=s.quaternions[rows])
    return s


def refused(given: Samples, words: str, **how: object) -> None:
    with pytest.raises(RpcFormatError, match=f"a.xml: .*{words}") as told:
        camera_of_samples(given, detector(**how))
    assert "\n" not in str(told.value)


def held(given: Samples, ok: bool, words: str, flight: Flight = FLIGHT) -> None:
    """A camera of the flight's size is made of samples; or they are refused, in these words."""
    if ok:
        assert camera_of_samples(given, detector(flight)).size == flight.size
    else:
        refused(given, words, flight=flight)


def test_the_camera_of_samples_is_the_one_that_was_flown() -> None:
    found = camera_of_samples(samples(), detector())
    assert found.size == SIZE
    assert found.model.accuracy is None
    ground = FLIGHT.sensor.localize(IMAGE, np.full(4, 300.0))
    np.testing.assert_allclose(found.model.project(ground), IMAGE, rtol=0, atol=2e-3)


def test_stated_deviations_are_metres_on_the_ground_and_metres_of_the_place() -> None:
    model = camera_of_samples(samples(), detector(), sigma=(2e-6, 0.3)).model
    middle = (np.array(SIZE) - 1) / 2
    far = np.linalg.norm(ecef_from_ground(model.localize(middle, np.zeros(()))) - model.position(middle[1]))
    assert model.accuracy == pytest.approx((2e-6 * far, 0.3), rel=1e-9)
    for nothing in ((0.0, 0.3), (2e-6, 0.0), None):
        assert camera_of_samples(samples(), detector(), sigma=nothing).model.accuracy is None


@pytest.mark.parametrize("what", ["positions", "attitudes"])
def test_samples_may_end_two_steps_within_the_image_and_no_more(what: str) -> None:
    """Row 0 is at the third sample, the last row between the last but four and the last but three."""
    rows = np.arange(len(FLIGHT.times))
    step = 0.02
    assert camera_of_samples(kept(rows[4:], what), detector()).size == SIZE
    refused(kept(rows[5:], what), f"its {what} from 0.06 to")
    late = np.flatnonzero(FLIGHT.times >= LAST - 2 * step)[0]
    assert camera_of_samples(kept(rows[: late + 1], what), detector()).size == SIZE
    refused(kept(rows[:late], what), f"its {what} from -0.04 to")


def test_beyond_slow_samples_a_camera_is_believed_for_a_second() -> None:
    """Every 0.6 s: two steps are more than the second that any curve is believed for."""
    slow = Flight(swing=0.0, size=(4000, 60000))
    rows = np.arange(2, len(slow.times), 30)  # from row 0 on
    flown = samples(slow, rows)
    assert len(rows) > 6
    for shift, ok in ((0.95, True), (1.05, False)):  # the samples come late by so much
        late = replace(flown, times=flown.times + shift, ticks=flown.ticks + shift)
        held(late, ok, "the image lasts from 0.00", slow)


@pytest.mark.parametrize("what", ["positions", "attitudes"])
def test_a_gap_within_the_image_is_one_of_more_than_four_steps(what: str) -> None:
    rows = np.arange(len(FLIGHT.times))
    assert camera_of_samples(kept(np.delete(rows, range(30, 33)), what), detector()).size == SIZE
    refused(kept(np.delete(rows, range(30, 34)), what), f"no {what} from 0.54 to 0.64 s, within the image")


def with_more(times: np.ndarray) -> Samples:
    """The samples and some more before or after them."""
    s, turn = samples(), FLIGHT.attitude(times)
    place, speed = (v.T for v in FLIGHT.sensor.orbit(times + FLIGHT.sensor.first_line))
    every = np.r_[s.times, times]
    order = np.argsort(every)
    return Samples(
        "a.xml",
        every[order],
        np.vstack([s.positions, place])[order],
        np.vstack([s.velocities, speed])[order],
        every[order],
        np.vstack([s.quaternions, turn.as_quat(scalar_first=True)])[order],
    )


@pytest.mark.parametrize("times", [[-0.5, -0.48], [LAST + 0.5, LAST + 0.52]])
def test_a_gap_outside_of_the_image_does_not_matter(times: list[float]) -> None:
    assert camera_of_samples(with_more(np.array(times)), detector()).size == SIZE
    first, *_, last = FLIGHT.times
    late = Detector(FLIGHT.sensor.look, FLIGHT.sensor.look_origin, FLIGHT.period, SIZE)
    shifted = with_more(np.array(times))
    into = 0.3 if times[0] < 0 else -0.3  # now the image lies over it
    shifted = replace(shifted, times=shifted.times + into, ticks=shifted.ticks + into)
    assert first < 0 < last
    with pytest.raises(RpcFormatError, match=r"no positions from .*, within the image"):
        camera_of_samples(shifted, late)


@pytest.mark.parametrize(
    ("span", "ok"), [((0.5, 4.0), True), ((0.5, 4.25), False), ((20.0, 22.5), True), ((19.75, 22.5), False)]
)
def test_a_gap_may_begin_where_the_image_ends_and_end_where_it_begins(span: tuple[float, float], ok: bool) -> None:
    """The samples on either side of it are enough then."""
    times = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 20.0, 21.0, 22.0, 23.0])
    with nullcontext() if ok else pytest.raises(RpcFormatError, match=r"no positions from 4.00 to 20.00 s"):
        check_times(times, span, "positions", "a.xml")


@pytest.mark.parametrize("what", ["positions", "attitudes"])
def test_three_samples_or_times_that_do_not_rise_are_none(what: str) -> None:
    some = np.linspace(0, len(FLIGHT.times) - 1, 4).astype(int)
    assert camera_of_samples(kept(some, what), detector()).size == SIZE
    refused(kept(some[:3], what), f"3 {what}, or their times do not rise; four or more are needed")
    name = "times" if what == "positions" else "ticks"
    times = FLIGHT.times.copy()
    times[7] = times[6]
    refused(samples(**{name: times}), f"{len(times)} {what}, or their times do not rise")


@pytest.mark.parametrize(("radius", "ok"), [(6.45e6, False), (6.55e6, True), (7.95e6, True), (8.05e6, False)])
def test_satellites_fly_between_6500_and_8000_km_from_the_earth_s_centre(radius: float, ok: bool) -> None:
    s = samples()
    scale = radius / np.linalg.norm(s.positions, axis=1).mean()
    moved = replace(s, positions=s.positions * scale, velocities=s.velocities * scale)
    held(moved, ok, "no satellite's orbit; metres and ECEF are expected")


@pytest.mark.parametrize(("off", "ok"), [(690.0, True), (710.0, False)])
def test_a_stated_velocity_may_be_that_of_the_inertial_frame(off: float, ok: bool) -> None:
    """The Earth's rotation is 500 m/s up there: more than 700 m/s are another error."""
    s = samples()
    velocities = s.velocities.copy()
    velocities[9] += off * np.array([0.6, 0.0, -0.8])
    held(replace(s, velocities=velocities), ok, "otherwise than their stated velocities; are the times right")
    velocities = s.velocities.copy()
    velocities[[0, -1]] += 5000.0  # of differences to one side nothing is asked
    assert camera_of_samples(replace(s, velocities=velocities), detector()).size == SIZE


@pytest.mark.parametrize(("rate", "ok"), [(0.28, True), (0.32, False)])
def test_no_satellite_turns_by_a_third_of_a_radian_a_second(rate: float, ok: bool) -> None:
    """From one sample to the next, of either sign of the quaternions."""
    s = samples()
    jump = np.where(np.arange(len(s.ticks)) < 40, 0.0, rate * 0.02)[:, None] * [0.0, 0.0, 1.0]
    body = FLIGHT.body * Rotation.from_rotvec(jump)
    q = body.as_quat(scalar_first=True) * np.where(np.arange(len(s.ticks)) % 2, 1.0, -1.0)[:, None]
    held(replace(s, quaternions=q), ok, r"turns by 0.3\d* rad/s at 0.74 s, as no satellite does")


@pytest.mark.parametrize(("length", "ok"), [(0.9992, True), (1.0008, True), (0.998, False), (1.002, False)])
def test_a_quaternion_has_the_length_of_one(length: float, ok: bool) -> None:
    q = np.array([[1.0, 0, 0, 0], [0.5, 0.5, 0.5, -0.5]])
    q[1] *= length
    if ok:
        np.testing.assert_allclose(unit(q, "a"), [[1, 0, 0, 0], [0.5, 0.5, 0.5, -0.5]], rtol=1e-15)
    else:
        with pytest.raises(RpcFormatError, match=f"^a: a quaternion of length {length:.4g}, not 1"):
            unit(q, "a")


@pytest.mark.parametrize(("noise", "smoothed"), [(0.008, True), (0.015, False)])
def test_positions_that_scatter_by_millimetres_are_smoothed_by_centimetres_not(noise, smoothed) -> None:
    """The least root mean square that is left makes the difference: 1 cm."""
    s = samples()
    rng = np.random.default_rng(0)
    shaken = s.positions + rng.normal(0, noise, s.positions.shape)
    model = camera_of_samples(replace(s, positions=shaken), detector()).model
    orbit = model.orbit
    off = np.abs(orbit(s.times)[0].T - shaken)[3:-3].max()
    assert (off > noise) == smoothed
    assert (len(orbit.coeffs) == 1) == smoothed
    seen = model.project(FLIGHT.sensor.localize(IMAGE, np.full(4, 300.0)))
    assert (np.abs(seen - IMAGE).max() < 0.02) == smoothed
    if not smoothed:
        assert off < 1e-6


@pytest.mark.parametrize(("rows", "degree"), [(3000, 2), (20000, 3), (60000, 4)])
def test_an_orbit_takes_the_least_degree_whose_next_term_is_below_a_hundredth_of_a_millimetre(
    rows: int, degree: int
) -> None:
    """Of the Taylor series of a circle of 7000 km that is flown at 1.2 mrad/s, over half the time."""
    flight = Flight(swing=0.0, size=(500, rows))
    flown = samples(flight)
    half = 0.5 * np.ptp(flight.times)
    terms = {d: 7e6 * (1.2e-3 * half) ** (d + 1) / np.prod(np.arange(1.0, d + 2)) for d in range(2, 7)}
    assert next(d for d in terms if terms[d] < 1e-5) == degree
    orbit = camera_of_samples(flown, detector(flight)).model.orbit
    assert orbit.coeffs.shape == (1, degree + 1, 3)
    np.testing.assert_allclose(orbit(flight.times)[0].T, flight.positions, rtol=0, atol=2e-5)
    few = np.linspace(0, len(flight.times) - 1, degree + 1).astype(int)
    if len(few) >= 4:  # no more samples than unknowns: the curve goes through them
        held = replace(flown, times=flown.times[few], positions=flown.positions[few], velocities=flown.velocities[few])
        there = camera_of_samples(held, detector(flight)).model.orbit
        np.testing.assert_allclose(there(held.times)[0].T, held.positions, rtol=0, atol=1e-7)
        assert there != orbit


def test_a_camera_that_looks_into_space_is_refused() -> None:
    turned = (FLIGHT.body * Rotation.from_rotvec([np.pi, 0.0, 0.0])).as_quat(scalar_first=True)
    refused(samples(quaternions=turned), "does not look at the Earth; is the attitude that of the image")


def test_an_image_that_was_turned_over_lasts_from_its_last_row_to_its_first() -> None:
    back = replace(samples(), times=FLIGHT.times - LAST, ticks=FLIGHT.times - LAST)
    found = camera_of_samples(back, detector(period=-FLIGHT.period)).model
    ground = FLIGHT.sensor.localize(IMAGE, np.full(4, 300.0))
    last = SIZE[1] - 1
    np.testing.assert_allclose(
        found.project(ground), np.column_stack([IMAGE[:, 0], last - IMAGE[:, 1]]), rtol=0, atol=2e-3
    )
    refused(samples(), "the image lasts from -", period=-FLIGHT.period)


# --- Maxar ---------------------------------------------------------------------------------------------------


def read(folder: Path, text: str, **choices: object) -> Linescan:
    """A camera of straight light, if nothing else is chosen."""
    return linescan_files.read(folder, text, **{"aberration": False, "refraction": False, **choices})


ISD, FLOWN = isd(FLIGHT)


def lines(entries: list[tuple[float, float]], text: str = ISD, late: float = 0.0) -> str:
    """The document with other line times: of lines, seconds after a TLCTIME that is `late`."""
    rows = "".join(f"<TLCLIST>{line!r} {time!r}</TLCLIST>" for line, time in entries)
    text = re.sub(r"<TLCLISTList>.*</TLCLISTList>", f"<TLCLISTList>{rows}</TLCLISTList>", text)
    text = text.replace(f"<TLCTIME>{stamp(0)}", f"<TLCTIME>{stamp(late)}")
    return text.replace("<NUMTLC>2<", f"<NUMTLC>{len(entries)}<")


@pytest.mark.parametrize(("line", "late"), [(0.0, 0.0), (4000.0, 0.0), (4000.0, -0.3), (-50.0, 0.2)])
def test_one_line_time_and_the_rate_give_all_of_them(tmp_path, line: float, late: float) -> None:
    text = lines([(line, line * FLIGHT.period - late)], late=late)
    model = read(tmp_path, text).model
    assert model.line_period == pytest.approx(FLIGHT.period, rel=1e-12)
    assert FLOWN.misses(model, IMAGE) < 5e-4


@pytest.mark.parametrize(
    ("listed", "scan", "sign"),
    [
        *(((line,), ">reverse<", sign) for line in (0.0, 4000.0) for sign in ("", "-")),
        ((0.0, SIZE[1] - 1.0), ">Forward<", ""),  # two times tell by themselves
    ],
)
def test_line_times_of_a_reverse_scan_go_back_in_time(tmp_path, listed: list[float], scan: str, sign: str) -> None:
    """The last row is taken first, whatever sign the rate has."""
    last = SIZE[1] - 1
    text = lines([(line, (last - line) * FLIGHT.period) for line in listed]).replace(">Forward<", scan)
    text = text.replace("<AVGLINERATE>", f"<AVGLINERATE>{sign}")
    text = re.sub(r"<FIRSTLINETIME>.*?<", f"<FIRSTLINETIME>{stamp(last * FLIGHT.period)}<", text)
    model = read(tmp_path, text).model
    assert model.line_period == pytest.approx(-FLIGHT.period, rel=1e-12)
    seen = model.project(FLOWN.ground(IMAGE, 200.0))
    np.testing.assert_allclose(seen, np.column_stack([IMAGE[:, 0], last - IMAGE[:, 1]]), rtol=0, atol=2e-3)


def test_a_forward_scan_goes_on_in_time_whatever_sign_its_rate_has(tmp_path) -> None:
    text = lines([(0.0, 0.0)]).replace("<AVGLINERATE>", "<AVGLINERATE>-")
    assert FLOWN.misses(read(tmp_path, text).model, IMAGE) < 5e-4


@pytest.mark.parametrize(("bent", "ok"), [(0.008, True), (-0.008, True), (0.012, False), (-0.012, False)])
def test_line_times_lie_on_a_straight_line_to_a_hundredth_of_a_row(tmp_path, bent: float, ok: bool) -> None:
    period = FLIGHT.period
    text = lines([(0.0, 0.0), (9000.0, (9000.0 + bent) * period), (20000.0, 20000.0 * period)])
    if ok:
        assert FLOWN.misses(read(tmp_path, text).model, IMAGE) < 5e-4
    else:
        with pytest.raises(RpcFormatError, match=r"the line rate changes \(0.012 rows in TLCLIST\)"):
            read(tmp_path, text)


@pytest.mark.parametrize(("late", "ok"), [(0.9, True), (-0.9, True), (1.1, False), (-1.1, False)])
def test_the_first_line_is_within_a_row_of_its_stated_time(tmp_path, late: float, ok: bool) -> None:
    text = ISD.replace(f"<FIRSTLINETIME>{stamp(0)}", f"<FIRSTLINETIME>{stamp(late * FLIGHT.period)}")
    if ok:
        assert FLOWN.misses(read(tmp_path, text).model, IMAGE) < 5e-4  # TLCLIST is what counts
    else:
        with pytest.raises(RpcFormatError, match=f"FIRSTLINETIME is {late:.1f}.* rows from TLCLIST's"):
            read(tmp_path, text)


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ([(0.0, 0.0), (0.0, 1.0)], "TLCLIST gives 0 s a row"),
        ([(0.0, 0.0), (100.0, 100.0)], "TLCLIST gives 1 s a row"),
        ([(0.0, 0.0), (100.0, 0.0)], "TLCLIST gives 0 s a row"),
    ],
)
def test_line_times_that_are_none(tmp_path, entries, words: str) -> None:
    with pytest.raises(RpcFormatError, match=words):
        read(tmp_path, lines(entries))
    with pytest.raises(RpcFormatError, match="holds 2 of 3 entries; is the file complete"):
        read(tmp_path, ISD.replace("<NUMTLC>2<", "<NUMTLC>3<"))


def test_samples_count_from_one_at_the_start_of_their_list(tmp_path) -> None:
    """The first two rows are gone: those left keep their numbers, and so their times."""
    text = ISD
    for tag in ("EPHEMLIST", "ATTLIST"):
        rows = re.findall(rf"<{tag}>[^<]*</{tag}>\n", text)
        for row in rows[:2]:
            text = text.replace(row, "")
        text = text.replace(f"<NUMPOINTS>{len(rows)}<", f"<NUMPOINTS>{len(rows) - 2}<", 1)
    assert FLOWN.misses(read(tmp_path, text).model, IMAGE) < 5e-4


def test_the_camera_may_stand_off_the_place_that_is_listed(tmp_path) -> None:
    """At (1.5, -0.7, 2.0) m in the axes of the body: the listed places are as much nearer to its origin."""
    arm, flight = np.array([1.5, -0.7, 2.0]), Flight(swing=0.0)
    flight.positions = flight.positions - flight.body.apply(arm)
    text, truth = isd(flight)
    for axis, value in zip("XYZ", arm, strict=True):
        text = text.replace(f"<C{axis}>0.0<", f"<C{axis}>{float(value)!r}<")
    model = read(tmp_path, text).model
    assert truth.misses(model, IMAGE) < 5e-4
    assert truth.misses(read(tmp_path, isd(flight)[0]).model, IMAGE) > 1.0
    other = re.sub(r"(<ATT><STARTTIME>)[^<]*", rf"\g<1>{stamp(FLIGHT.times[0] + 1e-3)}", text)
    assert other != text
    with pytest.raises(RpcFormatError, match="PERSPECTIVE_CENTER with positions and attitudes of other times"):
        read(tmp_path, other)


def test_a_camera_s_own_deviations_are_those_of_its_covariances(tmp_path) -> None:
    """A third of the trace, a turn being twice the quaternion's; nothing where one of them is zero."""
    flight = Flight(swing=0.0)
    model = read(tmp_path, isd(flight)[0]).model
    middle = (np.array(SIZE) - 1) / 2
    far = np.linalg.norm(ecef_from_ground(model.localize(middle, np.zeros(()))) - model.position(middle[1]))
    turn, place = 2 * np.sqrt((4 + 3 + 2 + 3) * 1e-12 / 3), np.sqrt((0.01 + 0.02 + 0.03) / 3)
    assert model.accuracy == pytest.approx((turn * far, place), rel=1e-6)
    zero = re.sub(r" 0.01 0.0 0.0 0.02 0.0 0.03<", " 0.0 0.0 0.0 0.0 0.0 0.0<", isd(flight)[0])
    assert zero != isd(flight)[0]
    assert read(tmp_path, zero).model.accuracy is None


@pytest.mark.parametrize(("tag", "kept"), [("EPHEMLIST", 7), ("ATTLIST", 5)])
def test_without_one_of_its_covariances_a_camera_states_no_accuracy(tmp_path, tag: str, kept: int) -> None:
    text = ISD
    for row in re.findall(rf"<{tag}>([^<]*)</{tag}>", ISD):
        text = text.replace(row, " ".join(row.split()[:kept]))
    model = read(tmp_path, text).model
    assert model.accuracy is None
    assert FLOWN.misses(model, IMAGE) < 5e-4


def test_the_only_band_needs_no_name(tmp_path) -> None:
    assert read(tmp_path, ISD).model == read(tmp_path, ISD, band="p").model
    none = ISD.replace("BAND_P>", "BANT_P>")
    with pytest.raises(InputError, match="give band=NAME of none"):
        read(tmp_path, none)


def test_what_bends_light_is_chosen_one_by_one(tmp_path) -> None:
    both = read(tmp_path, ISD, aberration=None, refraction=None).model.light
    assert (both.aberration, both.refraction) == (True, True)
    for aberration, refraction in ((False, None), (None, False), (True, False)):
        light = read(tmp_path, ISD, aberration=aberration, refraction=refraction).model.light
        assert light.aberration == (aberration is not False)
        assert light.refraction == (refraction is not False)


# --- DIMAP ---------------------------------------------------------------------------------------------------


PHR, PHR_FLOWN = dimap(FLIGHT)


def test_the_first_column_is_one_where_none_is_said(tmp_path) -> None:
    text, truth = dimap(FLIGHT, first_col=1)
    bare = re.sub(r"<Swath_Range>.*</Swath_Range>", "", text)
    assert truth.misses(read(tmp_path, bare).model, IMAGE) < 2e-3
    assert truth.misses(read(tmp_path, text).model, IMAGE) < 2e-3
    assert read(tmp_path, bare).model.look_origin == 0.0
    assert read(tmp_path, PHR).model.look_origin == -30.0


def test_look_angles_may_be_of_any_degree(tmp_path) -> None:
    """Column c looks along (tan psi_y, -tan psi_x, 1): the powers of each axis are its own."""
    more = PHR.replace("<YLOS_0>0.003</YLOS_0>", "<YLOS_0>0.003</YLOS_0><YLOS_1>2e-8</YLOS_1><XLOS_2>3e-13</XLOS_2>")
    model = read(tmp_path, more).model
    straight = read(tmp_path, PHR).model
    expected = np.zeros((2, 3))
    expected[:, :2] = straight.look
    expected[0, 1], expected[1, 2] = 2e-8, -3e-13
    np.testing.assert_allclose(model.look, expected, rtol=1e-12)
    assert straight.look[0].tolist() == [0.003, 0.0]
    assert straight.look[1, 1] < 0
    gap = PHR.replace("<YLOS_0>0.003</YLOS_0>", "<YLOS_0>0.003</YLOS_0><XLOS_3>3e-13</XLOS_3>")
    assert read(tmp_path, gap).model.look.shape == (2, 2)  # powers end where one is missing
    for lost in ("XLOS_0", "YLOS_0"):
        with pytest.raises(RpcFormatError, match="without YLOS_0, XLOS_0 and XLOS_1"):
            read(tmp_path, PHR.replace(lost, "LOST"))


def test_bands_have_detectors_of_their_own(tmp_path) -> None:
    angles = re.search(r"<Polynomial_Look_Angles>.*</Polynomial_Look_Angles>", PHR)[0]
    bands = "".join(
        f"<Band_Calibration><BAND_ID>{name}</BAND_ID>{angles.replace('0.003', along)}</Band_Calibration>"
        for name, along in (("B0", "0.003"), ("B1", "0.0031"))
    )
    text = PHR.replace(angles, f"<Band_Calibration_List>{bands}</Band_Calibration_List>")
    assert read(tmp_path, text).model == read(tmp_path, PHR).model
    assert read(tmp_path, text, band="B0").model == read(tmp_path, PHR).model
    assert read(tmp_path, text, band="B1").model.look[0, 0] == 0.0031
    with pytest.raises(InputError, match="no detector of band B9; it has B0, B1"):
        read(tmp_path, text, band="B9")
    with pytest.raises(InputError, match="no detector of band B1; it has one for all"):
        read(tmp_path, PHR, band="B1")


@pytest.mark.parametrize("unit_of", [1.0, 1e-3, 1e-6])
def test_a_line_period_is_of_the_unit_that_fits_the_time_of_the_last_row(tmp_path, unit_of: float) -> None:
    text, truth = dimap(FLIGHT, unit=unit_of)
    assert truth.misses(read(tmp_path, text).model, IMAGE) < 2e-3


@pytest.mark.parametrize(("share", "ok"), [(1.008, True), (0.992, True), (1.013, False), (0.987, False)])
def test_a_line_period_agrees_to_a_hundredth_with_what_the_image_lasts(tmp_path, share: float, ok: bool) -> None:
    period = FLIGHT.period * share
    text = re.sub(r"<LINE_PERIOD>.*?<", f"<LINE_PERIOD>{1e3 * period!r}<", PHR)
    with nullcontext() if ok else pytest.raises(RpcFormatError, match="from START to END, in no unit"):
        assert read(tmp_path, text).model.line_period == pytest.approx(period)


def test_a_short_image_may_miss_by_two_rows(tmp_path) -> None:
    """END may be the time of the last row, or one row later."""
    flight = Flight(swing=0.0, size=(500, 60))
    text, _ = dimap(flight)
    for late, ok in ((-1.9, True), (1.9, True), (2.9, False), (-2.9, False)):
        end = re.sub(r"<END>.*?<", f"<END>{stamp((60 + late) * flight.period)}<", text)
        with nullcontext() if ok else pytest.raises(RpcFormatError, match="in no unit"):
            assert read(tmp_path, end).model.line_period == pytest.approx(flight.period)
