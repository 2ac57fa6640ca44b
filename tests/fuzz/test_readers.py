"""Damaged files of every kind: a value, or one error in one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from .runner import check, prepared, scratch, sweep
from .samples import SAMPLES


@pytest.mark.parametrize("kind", SAMPLES)
def test_a_sample_is_accepted_as_it_is(kind, tmp_path):
    assert check(kind, SAMPLES[kind].data(), prepared(kind, str(tmp_path)))


@pytest.mark.parametrize(
    "runs", [30, pytest.param(120, marks=pytest.mark.nightly), pytest.param(1200, marks=pytest.mark.nightly)]
)
@pytest.mark.parametrize("kind", SAMPLES)
def test_damage_is_a_value_or_one_error(kind, runs):
    runs = int(runs * SAMPLES[kind].share)
    assert sweep(kind, runs, seed=runs) <= runs


@pytest.mark.parametrize("kind", SAMPLES)
@settings(max_examples=10, deadline=None)
@given(data=st.binary(max_size=300) | st.text(max_size=200).map(lambda text: text.encode("utf-8", "replace")))
@example(data=b"")
@example(data=b"\xff\xfe\x00")
@example(data=b"[" * 20_000)
@example(data=b'{"features": ' * 3000)
@example(data=b"<a>" * 20_000)
@example(data=b"PK\x05\x06" + bytes(18))
def test_any_bytes_are_a_value_or_one_error(kind, data):
    with scratch() as place:
        check(kind, data, prepared(kind, Path(place)))
