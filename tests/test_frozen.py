"""What every frozen value promises, whatever it holds."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest

from barpc.errors import FitError, InputError, RpcError
from barpc.fit import Normalization
from barpc.frozen import Frozen
from barpc.scene import GroundPoints, Tracks, View
from barpc.sensor.corrected import ImageAffine
from barpc.sensor.curve import Curve
from barpc.sensor.direct_grid import DirectGrid
from barpc.sensor.rpc import RPC
from barpc.simulate import Look, fly

LONLAT = np.stack(np.meshgrid([5.0, 5.1, 5.2], [43.2, 43.1, 43.0]), axis=-1)[None].repeat(2, axis=0)
COEFFS = np.eye(4, 20) + np.array([[0.0], [1.0], [0.0], [1.0]]) * np.eye(1, 20)
MAKE = {
    "RPC": lambda: RPC(COEFFS, np.zeros(3), np.ones(3), np.zeros(2), np.ones(2), err_bias=2.0),
    "Normalization": lambda: Normalization(np.zeros(3), np.ones(3), np.zeros(2), -np.ones(2)),
    "Curve": lambda: Curve.polynomial(np.arange(6.0).reshape(2, 3), 0.0, 1.0),
    "Pushbroom": lambda: fly(np.array([5.4, 43.3, 200.0]), Look(12.0), (300, 200), 0.5),
    "DirectGrid": lambda: DirectGrid(np.arange(3.0), np.arange(3.0), np.array([0.0, 100.0]), LONLAT),
    "ImageAffine": lambda: ImageAffine(np.ones(2), np.zeros((2, 2))),
    "View": lambda: View("a", "", (10, 20), MAKE["RPC"](), (0.0, 1.0)),
    "Tracks": lambda: Tracks(np.array([0, 1]), np.array([0, 0]), np.ones((2, 2)), np.ones(2)),
    "GroundPoints": lambda: GroundPoints(
        ("p",), np.ones((1, 3)), np.ones((1, 3)), np.array([0]), np.array([2]), np.ones((1, 2)), np.ones(1)
    ),
}


@pytest.fixture(params=MAKE)
def make(request):
    return MAKE[request.param]


def arrays(value: Frozen) -> dict[str, np.ndarray]:
    return {name: v for name, v in vars(value).items() if isinstance(v, np.ndarray)}


def test_equal_contents_are_equal_and_hash_alike(make):
    a, b = make(), make()
    assert a is not b
    assert a == b
    assert {a: 1}[b] == 1
    assert a != "something else"


def test_every_array_takes_part(make):
    value = make()
    given = [field.name for field in fields(value) if field.init]
    for name in set(arrays(value)) & set(given):
        other = make()
        moved = getattr(other, name).copy()
        moved.flat[-1] += 1 if moved.dtype.kind == "i" else 1e-9
        object.__setattr__(other, name, moved)
        assert other != value, name
        assert hash(other) != hash(value), name


def test_copies_pickles_and_replacements_are_equal_and_stay_read_only(make):
    value = make()
    for twin in (pickle.loads(pickle.dumps(value)), copy.deepcopy(value), replace(value)):
        assert twin == value
        assert hash(twin) == hash(value)
        assert repr(twin) == repr(value)
        for name, array in arrays(twin).items():
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
            with pytest.raises(FrozenInstanceError):
                setattr(twin, name, array)


def test_an_array_that_is_changed_afterwards_changes_no_value():
    shift = np.ones(2)
    value = ImageAffine(shift, np.zeros((2, 2)))
    shift[:] = 7
    assert value.shift.tolist() == [1.0, 1.0]


def test_zero_has_no_sign_and_shapes_count():
    plus, minus = (ImageAffine(np.array([zero, 1.0]), np.zeros((2, 2))) for zero in (0.0, -0.0))
    assert plus == minus
    assert hash(plus) == hash(minus)
    one, two = (Curve(np.arange(n + 1.0), np.zeros((n, 2 // n, 3))) for n in (1, 2))
    assert one != two
    assert one != ImageAffine(np.ones(2), np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("wrong", "error", "said"),
    [
        (lambda: ImageAffine(np.ones(3), np.zeros((2, 2))), RpcError, r"ImageAffine shift: shape \(3,\)"),
        (lambda: Curve(np.arange(2.0), np.zeros((2, 1, 3))), RpcError, "Curve coeffs: shape"),
        (lambda: Curve(np.array([0.0, np.nan]), np.zeros((1, 1, 3))), RpcError, "Curve knots: not finite"),
        (lambda: Curve(np.zeros(2), np.zeros((1, 1, 3))), RpcError, "ascend"),
        (
            lambda: replace(MAKE["RPC"](), ground_scale=np.ones(2)),
            RpcError,
            r"RPC ground_scale: shape \(2,\)",
        ),
        (lambda: replace(MAKE["RPC"](), image_offset=[np.inf, 0]), RpcError, "RPC image_offset: not finite"),
        (lambda: replace(MAKE["Normalization"](), image_scale=[0, 1]), FitError, "Normalization image_scale"),
        (lambda: replace(MAKE["Tracks"](), sigma=[1.0, np.nan]), InputError, "Tracks sigma: not finite"),
        (lambda: replace(MAKE["Tracks"](), sigma=[1.0, 0.0]), InputError, "positive"),
    ],
)
def test_a_wrong_array_is_refused_by_name(wrong, error, said):
    with pytest.raises(error, match=said):
        wrong()
