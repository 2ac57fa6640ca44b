"""Damaged files of every kind: a value, or one error in one line."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.lanes import rest_slow

from .ends import EDITS, by_exponent, cut_number, end_of_doubles, mutate_npz_ends, twice
from .runner import check, prepared, scratch, sweep
from .samples import SAMPLES


@pytest.mark.few(22)
@pytest.mark.parametrize("kind", SAMPLES)
def test_a_sample_is_accepted_as_it_is(kind, tmp_path):
    assert check(kind, SAMPLES[kind].data(), prepared(kind, str(tmp_path)))


# GDAL's words of a damaged file may be no text, which rasterio then says of itself
@pytest.mark.few(22)
@pytest.mark.filterwarnings("ignore:.*rasterio._env.log_error:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("runs", rest_slow([10, 20, 120, 1200], mark=pytest.mark.nightly))
@pytest.mark.parametrize("kind", SAMPLES)
def test_damage_is_a_value_or_one_error(kind, runs):
    runs = int(runs * SAMPLES[kind].share)
    assert sweep(kind, runs, seed=runs) <= runs


def test_numbers_go_to_the_ends_of_doubles_lose_theirs_and_stand_there_twice():
    rng = np.random.default_rng(0)
    text = b'{"a": 12.5, "b": [3, 4]}\n'
    found = {edit: {edit(text, rng) for _ in range(300)} for edit in EDITS}
    assert b'{"a": 1e999, "b": [3, 4]}\n' in found[end_of_doubles]
    assert {b'{"a": 12.', b'{"a": 1, "b": [3, 4]}\n'} <= found[cut_number]
    assert any(one.count(b'"a"') == 2 and one.count(b"\n") == 1 for one in found[twice])
    assert text + text in found[twice]
    numbers = np.array([1.5, -2.0])
    bent = [np.frombuffer(by_exponent(numbers.tobytes(), rng)) for _ in range(300)]
    assert any(np.isinf(one).any() for one in bent)
    assert any(np.isnan(one).any() for one in bent)
    assert any(((one != 0) & (np.abs(one) < 2.3e-308)).any() for one in bent)


def test_an_archive_is_bent_and_holds_up():
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(200):
        with np.load(io.BytesIO(mutate_npz_ends(SAMPLES["points npz"].data(), rng))) as file:
            seen |= {str(value) for name in file.files for value in file[name].ravel()}
    assert {"nan", "inf", "-inf", "5e-324", "1e+308"} <= seen


ODD = [b"", b"\xff\xfe\x00", b"[" * 20_000, b'{"features": ' * 3000, b"<a>" * 20_000, b"PK\x05\x06" + bytes(18)]


@pytest.mark.few(22)
@pytest.mark.parametrize("kind", SAMPLES)
def test_odd_bytes_are_a_value_or_one_error(kind, tmp_path):
    place = prepared(kind, str(tmp_path))
    for data in ODD:
        check(kind, data, place)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SAMPLES)
@settings(max_examples=10, deadline=None)
@given(data=st.binary(max_size=300) | st.text(max_size=200).map(lambda text: text.encode("utf-8", "replace")))
def test_any_bytes_are_a_value_or_one_error(kind, data):
    with scratch() as place:
        check(kind, data, prepared(kind, Path(place)))
