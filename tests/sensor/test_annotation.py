"""Annotations that were read and do not go together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.base.errors import RpcFormatError
from barpc.sensor.sentinel1 import burst_rows, read_annotation
from barpc.sensor.sentinel1.annotation import read_orbit_file
from tests.sensor.s1_product import GRD, IW, START


@pytest.fixture(scope="module")
def annotation():
    return read_annotation(IW["IW1"].xml())


def test_bursts_follow_each_other_and_each_has_a_valid_line(annotation) -> None:
    bursts = list(annotation.bursts)
    assert len(burst_rows(annotation)) == len(bursts)
    blank = replace(bursts[3], first_valid=np.full_like(bursts[3].first_valid, -1))
    alone = bursts[3].first_valid.copy()
    alone[:700], alone[701:] = -1, -1
    swapped = [*bursts[:4], bursts[5], bursts[4], *bursts[6:]]
    twice = [*bursts[:5], bursts[4], *bursts[5:]]
    for wrong in ([*bursts[:3], blank, *bursts[4:]], [blank], swapped, twice):
        with pytest.raises(RpcFormatError, match="bursts out of order, or one without valid lines"):
            burst_rows(replace(annotation, bursts=tuple(wrong)))
    single = burst_rows(replace(annotation, bursts=(replace(bursts[3], first_valid=alone),)))
    assert (single[0].stop - single[0].start) == 1
    assert single[0].start - single[0].first_row == 700


def test_lines_beyond_the_bursts_go_on_by_the_nearest_one(annotation) -> None:
    lines, step = annotation.lines_per_burst, annotation.azimuth_time_interval
    first, last = annotation.bursts[0], annotation.bursts[-1]
    count = len(annotation.bursts)
    asked = np.array([-2.0, 0.0, lines - 1.0, lines, lines * (count - 1) + 3.0, lines * count + 5.0])
    found = annotation.line_time(asked)
    expected = [
        first.time + np.timedelta64(round(-2 * step * 1e9), "ns"),
        first.time,
        first.time + np.timedelta64(round((lines - 1) * step * 1e9), "ns"),
        annotation.bursts[1].time,
        last.time + np.timedelta64(round(3 * step * 1e9), "ns"),
        last.time + np.timedelta64(round((lines + 5) * step * 1e9), "ns"),
    ]
    assert (np.abs(found - np.array(expected)) <= np.timedelta64(1, "ns")).all()
    plain = replace(annotation, bursts=())
    assert plain.line_time(np.array(10.0)) - plain.first_line_time == np.timedelta64(round(10 * step * 1e9), "ns")


def test_of_an_orbit_file_the_vectors_around_the_image_are_taken(annotation, tmp_path) -> None:
    """Those of seventy seconds before its first line to seventy after its last, 25 s later."""
    path = tmp_path / "S1A.EOF"
    kind = b"<Mission>Sentinel-1A</Mission><File_Type>AUX_RESORB</File_Type>"
    path.write_bytes(IW["IW1"].eof().replace(b"<Mission>Sentinel-1A</Mission>", kind))
    states = read_orbit_file(path, annotation)
    assert states.source == "AUX_RESORB"
    since = (states.time - START) / np.timedelta64(1, "us") * 1e-6
    np.testing.assert_array_equal(since, np.arange(-70.0, 91.0, 10.0))
    for k in (0, 16):
        position, velocity = IW["IW1"].state(since[k])
        np.testing.assert_allclose(states.position[k], position, atol=1e-6)
        np.testing.assert_allclose(states.velocity[k], velocity, atol=1e-6)
    path.write_bytes(IW["IW1"].eof().replace(b"EARTH_FIXED", b" EARTH_FIXED "))
    assert len(read_orbit_file(path, annotation).time) == 17
    for mission, owner, ok in (("S1A", "", False), ("S1X", "S1X", True), ("S1C", "Sentinel-1C", True)):
        path.write_bytes(IW["IW1"].eof(mission=owner))
        if ok:
            assert len(read_orbit_file(path, replace(annotation, mission=mission)).time) == 17
        else:
            with pytest.raises(RpcFormatError, match="the orbit of no known mission, the image is of S1A"):
                read_orbit_file(path, replace(annotation, mission=mission))


def test_ground_range_polynomials_have_one_length_and_rising_times() -> None:
    xml = GRD.xml()
    found = read_annotation(xml).ground_range
    assert found.ground_from_slant.shape == (36, 4)
    assert found.slant_from_ground.shape == (36, 3)
    assert found.slant_origin[:3].tolist() == [800394.0, 800397.0, 800400.0]
    assert found.ground_from_slant[0].tolist() == [0.0, 1.98 - 2e-4, -4.1e-6, 2.1e-11]
    for tag in (b"srgr", b"grsr"):
        longer = xml.replace(b"<%sCoefficients>" % tag, b"<%sCoefficients>1.0 " % tag, 1)
        with pytest.raises(RpcFormatError, match="ground range polynomials of different lengths"):
            read_annotation(longer)
    stamps = [b"<azimuthTime>%s</azimuthTime><sr0>" % part.split(b"<")[0] for part in xml.split(b"<azimuthTime>")[1:]]
    first, second = [one for one in stamps if one in xml][:2]
    for twice in (
        xml.replace(second, first),
        xml.replace(first, b"@").replace(second, first).replace(b"@", second),
    ):
        with pytest.raises(RpcFormatError, match="times of the ground range polynomials do not rise"):
            read_annotation(twice)
