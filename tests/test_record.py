"""Stage results survive a file to the bit, and nothing else is ever made of one."""

from __future__ import annotations

import json

import numpy as np
import pytest

from barpc.base.frozen import from_arrays, to_arrays


@pytest.mark.parametrize("value", [{1, 2}, Exception("x")])
def test_what_is_no_value_is_refused(value):
    with pytest.raises(TypeError):
        to_arrays(value)


def test_values_come_back_to_the_bit(tmp_path):
    rng = np.random.default_rng(1)
    value = {"a": (1, 2.5, None, True, "é\n"), "b": [rng.normal(size=(3, 2)), np.arange(4, dtype=np.uint8)], "c": {}}
    np.savez(tmp_path / "x.npz", **to_arrays(value))
    with np.load(tmp_path / "x.npz", allow_pickle=False) as data:
        back = from_arrays({name: data[name] for name in data.files})
    assert back["a"] == value["a"]
    assert back["c"] == {}
    for old, new in zip(value["b"], back["b"], strict=True):
        assert old.dtype == new.dtype
        np.testing.assert_array_equal(old, new)


@pytest.mark.parametrize(
    "frame",
    [
        {"class": ["os", "system"], "fields": {}},
        {"class": ["subprocess", "Popen"], "fields": {"args": "true"}},
        {"class": ["barpc.cli", "main"], "fields": {}},
        {"class": ["barpc.scene", "Nothing"], "fields": {}},
    ],
)
def test_a_forged_record_makes_nothing(frame):
    with pytest.raises(ValueError):
        from_arrays({"frame": np.frombuffer(json.dumps(frame).encode(), dtype=np.uint8)})


def test_a_damaged_record_is_a_value_error():
    with pytest.raises(ValueError):
        from_arrays({})
    with pytest.raises(ValueError):
        from_arrays({"frame": np.frombuffer(b"{half", dtype=np.uint8)})
