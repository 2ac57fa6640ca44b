"""Annotations that were read and do not go together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.errors import RpcFormatError
from barpc.sensor.sentinel1 import burst_rows, read_annotation
from tests.sensor.s1_product import IW


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
    assert plain.line_time(np.array(10.0)) - plain.first_line_time == np.timedelta64(
        round(10 * step * 1e9), "ns"
    )
