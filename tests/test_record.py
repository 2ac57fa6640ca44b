"""Stage results survive a file to the bit, and nothing else is ever made of one."""

from __future__ import annotations

import json

import numpy as np
import pytest

from barpc.base.frozen import from_arrays, to_arrays
from barpc.scene import Tracks

from .sensor.conftest import make_rpc


def through_a_file(value, path):
    np.savez(path, **to_arrays(value))
    with np.load(path, allow_pickle=False) as data:
        return from_arrays({name: data[name] for name in data.files})


def test_values_come_back_to_the_bit(tmp_path):
    rng = np.random.default_rng(1)
    value = {
        "a": (1, 2.5, None, True, "é\n"),
        "b": [rng.normal(size=(3, 2)), np.arange(4, dtype=np.uint8)],
        "c": {},
    }
    back = through_a_file(value, tmp_path / "x.npz")
    assert back["a"] == value["a"]
    assert back["c"] == {}
    for old, new in zip(value["b"], back["b"], strict=True):
        assert old.dtype == new.dtype
        np.testing.assert_array_equal(old, new)


def test_dataclasses_of_barpc_come_back(tmp_path):
    rpc = make_rpc()
    assert through_a_file(rpc, tmp_path / "x.npz") == rpc
    tracks = Tracks([0, 1], [0, 0], [[1, 2], [3, 4]], [0.1, 0.2])
    back = through_a_file((tracks,), tmp_path / "y.npz")[0]
    np.testing.assert_array_equal(back.xy, tracks.xy)


@pytest.mark.parametrize("value", [object(), {1, 2}, np.array([None]), 3j, Exception("x")])
def test_anything_else_is_refused(value):
    with pytest.raises(TypeError):
        to_arrays(value)


@pytest.mark.parametrize(
    "frame",
    [
        {"class": ["os", "system"], "fields": {}},
        {"class": ["subprocess", "Popen"], "fields": {"args": "true"}},
        {"class": ["barpc.cli", "main"], "fields": {}},
        {"class": ["barpc.scene", "Nothing"], "fields": {}},
        {"array": "missing"},
        {"unknown": 1},
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
