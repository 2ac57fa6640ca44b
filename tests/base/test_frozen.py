"""What every frozen value promises, whatever it holds."""

from __future__ import annotations

import copy
import pickle
import zipfile
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import FitError, InputError, RpcError
from barpc.base.frozen import Frozen, from_arrays, load_npz, to_arrays
from barpc.base.remote import Remote
from barpc.fit import Normalization, fit_rpc
from barpc.scene import Camera, GroundPoints, Tracks, View
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.curve import Curve
from barpc.sensor.direct_grid import DirectGrid
from barpc.sensor.image_corrections import ImageAffine
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


def test_a_value_comes_back_from_its_arrays_with_all_that_it_holds(make):
    value = {"one": make(), "more": (1, [2.5, None, "a", True], {}), "xy": np.arange(4.0)[::2], "n": np.float64(3)}
    kept = to_arrays(value)
    assert all(isinstance(part, np.ndarray) and not part.dtype.hasobject for part in kept.values())
    back = from_arrays(kept)
    assert (back["one"], back["more"], back["n"]) == (make(), value["more"], 3.0)
    np.testing.assert_array_equal(back["xy"], [0.0, 2.0])
    remote = Remote("https://a.b/c.tif", 5, "tag")
    assert from_arrays(to_arrays((remote,)), sent=True) == (remote,)
    with pytest.raises(ValueError, match="a Remote in a file"):
        from_arrays(to_arrays((remote,)))


def test_what_is_no_value_is_neither_kept_nor_taken():
    for wrong in (object(), {"a": [1j]}, np.array([None]), Path()):
        with pytest.raises(TypeError, match="cannot be kept"):
            to_arrays(wrong)
    for frame in (b"[", b'{"array": "b"}', b'{"class": ["pathlib", "Path"], "fields": {}}', b'{"map": 1}', b'{"a": 1}',
                  b'{"class": ["barpc.base.frozen", "to_arrays"], "fields": {}}'):  # fmt: skip
        with pytest.raises(ValueError):
            from_arrays({"frame": np.frombuffer(frame, dtype=np.uint8)})


def test_one_line_is_printed_with_figures_and_no_long_array(make):
    for value in (make(), replace(make())):
        said = repr(value)
        assert said.startswith(f"{type(value).__name__}(")
        assert 20 < len(said) < 150
        assert not {"array", "\n", "Array"} & {*said, *said.split("(")}


def test_what_is_printed_is_what_it_holds():
    """Figures of each are told by eye, from the values given."""
    rpc = RPC(
        COEFFS,
        np.array([5.4, 43.3, 250.0]),
        np.array([0.1, -0.2, 300.0]),
        np.full(2, 499.5),
        np.full(2, 500.0),
    )
    box = "RPC(lon 5.3000 to 5.5000, lat 43.1000 to 43.5000, -50 to 550 m, col -0.5 to 999.5, row -0.5 to 999.5)"
    assert repr(rpc) == box
    assert repr(View("left", "", (20, 10), rpc, (-50.0, 550.0))) == "View('left', 20 x 10 px, RPC for -50 to 550 m)"
    assert repr(replace(MAKE["View"](), date="2013-04-17")).endswith("m, 2013-04-17)")
    sigmas = np.array([0.1, 0.1, 0.3, 0.5, 0.7])
    tracks = Tracks(np.array([0, 1, 3, 0, 1]), np.array([0, 0, 0, 1, 1]), np.ones((5, 2)), sigmas)
    assert repr(tracks) == "Tracks(2 tie points, 5 observations in 3 views, to 0.3 px)"
    assert repr(GroundPoints.none()) == "GroundPoints(0 points, no observations)"
    correction = Correction(np.array([3e-6, 0, 4e-6]), np.array([0, -2.0, 0]), np.full(3, 6e6), np.eye(3)[:1] * 1e-7)
    assert repr(Corrected(rpc, correction)) == (
        f"Corrected(sensor={box}, correction=Correction(rotation 5 urad, translation 2 m, drift 0.1 urad))"
    )
    camera = Camera(rpc, Path("left.tif"), "tag", (20, 10), (-50.0, 550.0))
    assert repr(camera) == f"Camera(tag in left.tif, size (20, 10), {box})"
    fit = fit_rpc(MAKE["Pushbroom"](), (300, 200), (0.0, 500.0))
    worst = f"{fit.max_ckp.max():.2g} px at {fit.num_ckp} check points"
    assert repr(fit) == f"RpcFit({fit.method}, at most {worst}, {fit.rpc})"
    pushbroom = repr(fly(np.array([5.4, 43.3, 200.0]), Look(0.0, altitude=500e3), (300, 200), 0.5))
    assert 495 < float(pushbroom.partition("(")[2].split()[0]) < 505


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


@pytest.mark.parametrize(("version", "taken"), [((1, 0), True), ((2, 0), True), ((3, 0), False)])
def test_archives_hold_arrays_with_a_header_of_either_size(version, taken, tmp_path):
    path, values = tmp_path / "a.npz", np.arange(6.0)
    with zipfile.ZipFile(path, "w") as archive, archive.open("values.npy", "w") as file:
        np.lib.format.write_array(file, values, version=version)
    if taken:
        np.testing.assert_array_equal(load_npz(path)["values"], values)
    else:
        with pytest.raises(InputError, match="not "):
            load_npz(path)
