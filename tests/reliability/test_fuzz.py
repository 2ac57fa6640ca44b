"""Options, control points and tie points that are damaged at random: a value or one error, never another."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from .fuzzing import SAMPLES, check, scratch, sweep


@pytest.mark.parametrize("kind", SAMPLES)
def test_a_sample_is_accepted_as_it_is(kind, tmp_path):
    assert check(kind, SAMPLES[kind][2], tmp_path)


@pytest.mark.parametrize("kind", SAMPLES)
@pytest.mark.parametrize("runs", [300, pytest.param(5000, marks=pytest.mark.slow)])
def test_mutations_are_a_value_or_one_error(kind, runs):
    accepted = sweep(kind, runs, seed=runs)
    assert accepted < runs


@pytest.mark.parametrize("kind", SAMPLES)
@settings(max_examples=60, deadline=None)
@given(data=st.binary(max_size=300) | st.text(max_size=200).map(lambda text: text.encode("utf-8", "replace")))
@example(data=b"")
@example(data=b"\xff\xfe\x00")
@example(data=b"[" * 5000)
@example(data=b'{"features": ' * 3000)
def test_any_bytes_are_a_value_or_one_error(kind, data):
    with scratch() as folder:
        check(kind, data, Path(folder))
