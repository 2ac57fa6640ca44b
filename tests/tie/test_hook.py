"""A matcher of the user's own, named on the command line: it is run, believed no more than others, and told of."""

from __future__ import annotations

import sys
import types
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from barpc.base.errors import InputError, TiePointError
from barpc.base.options import TieOptions, read_options
from barpc.pipeline import RunOptions, adjust
from barpc.scene import View
from barpc.tie import Matches, find_tracks
from barpc.tie.matchers.matcher import Hook, Prediction, hook_files, hooked
from barpc.tie.matchers.pair_search import MATCHERS, matcher_named
from barpc.tie.pairing.epipolar import EpipolarSegments
from tests.lanes import rest_slow
from tests.tie.test_pairs import METRE, camera, views

ROOT = Path(__file__).parents[2]
TEXT = '''
import cv2, numpy as np
from barpc.rasters.raster import open_raster
calls, known = [], []
def match(a, b, prediction):
    """SIFT of both images, matched everywhere."""
    calls.append(a.name)
    if not known:
        known.append(everywhere(a, b))
    return known[0]
def everywhere(a, b):
    found = []
    for view in (a, b):
        with open_raster(view.path) as image:
            grey = image.read(1).astype(float)
        low, high = np.percentile(grey, [0.5, 99.5])
        grey = (255 * ((grey - low) / (high - low)).clip(0, 1)).astype("u1")
        found.append(cv2.SIFT.create(1500).detectAndCompute(grey, None))
    pairs = cv2.BFMatcher(crossCheck=True).match(found[0][1], found[1][1])
    xy = np.array([[found[0][0][m.queryIdx].pt, found[1][0][m.trainIdx].pt] for m in pairs])
    return RETURN
def wrong_shape(a, b, prediction):
    return np.zeros((3, 4))
def broken(a, b, prediction):
    raise RuntimeError("no weights\\nhere")
number = 3
'''


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """`module("xy")`: a module of a user's own whose function returns that; the name of the module."""

    def make(returns: str = "xy", name: str = "users_matcher") -> str:
        (tmp_path / f"{name}.py").write_text(TEXT.replace("RETURN", returns))
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(sys.modules, name, raising=False)
        return name

    yield make
    sys.modules.pop("users_matcher", None)


@pytest.mark.slow
@pytest.mark.parametrize("returns", rest_slow(["xy, np.array([m.distance for m in pairs])", "xy"]))
def test_a_function_is_a_matcher_with_and_without_scores(scene, module, returns: str) -> None:
    options = TieOptions(matcher=f"{module(returns)}:match")
    result = find_tracks(scene.views, options)
    assert result.keypoints == (0, 0)
    assert result.pairs[0].control_share <= 0.01
    assert result.tracks.num_points > 200
    assert scene.typical(result.tracks).max() <= 0.1
    assert 3 <= len(sys.modules["users_matcher"].calls) <= 12


@pytest.mark.parametrize(
    ("name", "error", "says"),
    [
        ("nowhere_at_all:match", InputError, "No module named 'nowhere_at_all'.* PYTHONPATH"),
        ("users_matcher:absent", InputError, "no attribute 'absent'"),
        ("users_matcher:number", InputError, "neither a function nor a class"),
        (
            "users_matcher:wrong_shape",
            TiePointError,
            r"view_00 - view_01: .*\(M, 2, 2\) are expected.*\(3, 4\)",
        ),
        ("users_matcher:broken", TiePointError, "RuntimeError: no weights here"),
    ],
)
def test_what_is_wrong_with_it_is_said_in_one_line(scene, module, name: str, error: type, says: str) -> None:
    module()
    with pytest.raises(error, match=says) as caught:
        find_tracks(scene.views, TieOptions(matcher=name))
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["", "guide", "os.system", "a:b:c", "a: b", "../x:y", "a:b()", ":b", "a:", "a\n:b"])
def test_a_name_that_is_none_is_refused_before_anything_is_imported(name: str) -> None:
    with pytest.raises(InputError, match=r"one of guided.*or module:name"):
        TieOptions(matcher=name)


def test_an_options_file_names_no_code_and_reading_it_imports_nothing(tmp_path: Path) -> None:
    (tmp_path / "o.toml").write_text('[tie]\nmatcher = "antigravity:match"\n')
    with pytest.raises(InputError, match=r"o\.toml \[tie\]: matcher 'antigravity:match' would run code.*--matcher"):
        read_options(tmp_path / "o.toml")
    assert "antigravity" not in sys.modules
    (tmp_path / "o.toml").write_text('[tie]\nmatcher = "structure"\n')
    assert read_options(tmp_path / "o.toml").tie.matcher == "structure"


def test_rows_of_the_table_and_classes_are_what_they_are() -> None:
    assert matcher_named("guided") is MATCHERS["guided"]
    assert hooked("barpc.tie.matchers.guided:Guided") is MATCHERS["guided"]
    with pytest.raises(InputError, match="cannot be imported"):
        hook_files("nowhere_at_all.x:match")


@pytest.mark.slow
def test_a_changed_module_is_run_again_an_unchanged_one_not(scene, module, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    options = RunOptions(tie=TieOptions(matcher=f"{module()}:match"), stop_after="matching", overwrite=True)
    counts = []
    for returns in ("xy", "xy", "xy[::2]"):
        module(returns)
        result = adjust(scene.views, tmp_path / "run", options)
        counts.append((len(getattr(sys.modules.get("users_matcher"), "calls", [])), result.run.matched[0].verified))
    assert counts[0][0] > 0
    assert counts[1] == (0, counts[0][1])
    assert 0.4 < counts[2][1] / counts[0][1] < 0.6


def everywhere(xy: np.ndarray) -> EpipolarSegments:
    """Predictions of a place in B that is that of A, ten pixels along the rows either way."""
    x, y = xy.T
    zero, ten = np.zeros(len(xy)), np.full(len(xy), 10.0)
    return EpipolarSegments(np.array([1.0, 0.0]), x, y, zero, -ten, ten, lambda: np.eye(2))


def test_a_matcher_of_ones_own_sees_the_images_as_their_files_are(monkeypatch) -> None:
    """It opens them: half the resolution is for those that read through barpc."""
    seen: list[tuple[tuple[int, int], tuple[int, int]]] = []
    users = types.ModuleType("users_of_two_sizes")

    def match(a: View, b: View, prediction: Prediction) -> np.ndarray:
        seen.append((a.size, b.size))
        return np.empty((0, 2, 2))

    users.match = match  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "users_of_two_sizes", users)
    fine, coarse = views(camera(0.0), camera(METRE).window(0, 0, 2, 2))
    with pytest.raises(TiePointError, match="no common offset"):
        find_tracks([fine, replace(coarse, size=(500, 500))], TieOptions(matcher="users_of_two_sizes:match"))
    assert set(seen) == {((1000, 1000), (500, 500))}


def test_what_a_function_finds_counts_in_the_band_and_on_the_images() -> None:
    prediction = Prediction(everywhere, 2.0, list)
    first, second = (View(name, "", (100, 50), None, (0.0, 1.0)) for name in "ab")  # type: ignore[arg-type]
    rows = [
        ((20, 20), (29.9, 21.0), True), ((20, 20), (30.1, 21.0), False), ((20, 20), (10.1, 18.1), True),
        ((20, 20), (20, 17.9), False), ((-0.4, 5), (0, 5), True), ((-0.6, 5), (0, 5), False),
        ((99.4, 49.4), (99, 49), True), ((99.6, 49), (99, 49), False), ((99, 49), (99, 49.6), False),
        ((99, 49.6), (99, 49), False), ((5, 5), (-0.6, 5), False), ((5, 0), (5, -0.4), True),
    ]  # fmt: skip
    xy = np.array([[a, b] for a, b, _ in rows], dtype=float)
    found = Hook("m:f", lambda *_: xy).match(first, second, prediction)
    inside = np.array([good for *_, good in rows])
    np.testing.assert_array_equal(found.xy, xy[inside])
    np.testing.assert_allclose(found.score, np.abs(xy[inside, 1, 1] - xy[inside, 0, 1]) / 2.0)
    for given in ((xy, np.arange(12.0)), Matches.of_places(xy, np.arange(12.0))):
        scored = Hook("m:f", lambda *_, given=given: given).match(first, second, prediction)
        assert scored.score.tolist() == np.flatnonzero(inside).tolist()


@pytest.mark.parametrize(
    "given",
    [np.zeros((3, 2)), np.zeros((3, 2, 3)), np.zeros((3, 3, 2)), (np.zeros((3, 2, 2)), np.zeros(2)),
     (np.zeros((3, 2, 2)), np.zeros((3, 1))), np.full((3, 2, 2), np.inf), (np.zeros((3, 2, 2)), np.full(3, np.nan))],
)  # fmt: skip
def test_no_other_shape_and_nothing_that_is_not_finite_is_taken(given) -> None:
    first, second = (View(name, "", (100, 50), None, (0.0, 1.0)) for name in "ab")  # type: ignore[arg-type]
    with pytest.raises(TiePointError, match=r"matcher m:f, a - b: ValueError: (places \(M, 2, 2\)|a place or score)"):
        Hook("m:f", lambda *_: given).match(first, second, Prediction(everywhere, 2.0, list))


# -- the example --------------------------------------------------------------------------------------


class Disk:
    """What `kornia.feature.DISK` is called with and gives, with OpenCV's detector inside."""

    @staticmethod
    def from_pretrained(checkpoint: str) -> Disk:
        assert checkpoint == "depth"
        return Disk()

    def eval(self) -> Disk:
        return self

    def __call__(self, images: np.ndarray, n: int, *, pad_if_not_divisible: bool) -> list[types.SimpleNamespace]:
        assert images.ndim == 4
        assert images.shape[:2] == (1, 3)
        assert images.dtype == np.float32
        assert 0 <= images.min() <= images.max() <= 1
        assert pad_if_not_divisible
        points, described = cv2.SIFT.create(n).detectAndCompute((255 * images[0, 0]).astype(np.uint8), None)
        xy = np.array([point.pt for point in points], np.float32)
        return [types.SimpleNamespace(keypoints=xy, descriptors=described)]


class LightGlueMatcher:
    """The same of `kornia.feature.LightGlueMatcher`."""

    def __init__(self, features: str) -> None:
        assert features == "disk"

    def eval(self) -> LightGlueMatcher:
        return self

    def __call__(self, first, second, frames_1, frames_2, hw1, hw2) -> tuple[np.ndarray, np.ndarray]:
        assert frames_1.shape == (1, len(first), 2, 3)
        assert frames_2.shape == (1, len(second), 2, 3)
        for (height, width), places in ((hw1, frames_1), (hw2, frames_2)):
            assert (places[0, :, :, 2] <= [width, height]).all()
        found = cv2.BFMatcher(crossCheck=True).match(first, second)
        score = np.array([[np.exp(-m.distance / 200.0)] for m in found], np.float32)  # higher is better
        return score, np.array([(m.queryIdx, m.trainIdx) for m in found]).reshape(-1, 2)


def frames(xy: np.ndarray, scale: np.ndarray) -> np.ndarray:
    assert scale.shape == (1, xy.shape[1], 1, 1)
    return np.concatenate([scale * np.eye(2), xy[..., None]], axis=3)


@pytest.mark.nightly
def test_the_example_of_the_manual_runs_with_what_has_kornias_interface(render, monkeypatch) -> None:
    feature = types.ModuleType("kornia.feature")
    feature.DISK, feature.LightGlueMatcher, feature.laf_from_center_scale_ori = Disk, LightGlueMatcher, frames
    kornia, torch = types.ModuleType("kornia"), types.ModuleType("torch")
    kornia.feature = feature
    torch.from_numpy, torch.inference_mode = np.asarray, nullcontext
    torch.Tensor = type("Tensor", (), {})  # looked for by whoever asks whether an array is one
    torch.ones = lambda *shape: np.ones(shape)
    for name, stand_in in {"kornia": kornia, "kornia.feature": feature, "torch": torch}.items():
        monkeypatch.setitem(sys.modules, name, stand_in)
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    monkeypatch.delitem(sys.modules, "lightglue_matcher", raising=False)
    scene = render(views=2, size=(400, 400))
    result = find_tracks(scene.views, TieOptions(matcher="lightglue_matcher:match", tile=400))
    assert result.tracks.num_points > 400
    places, unlike = sys.modules["lightglue_matcher"].match(*scene.views, None)  # as remembered
    true = np.hypot(*(scene.place(0, 1, places[:, 0]) - places[:, 1]).T) < 1.0
    assert np.median(unlike[true]) < 0.9 * np.median(unlike[~true])
    assert scene.typical(result.tracks).max() <= 0.1


OWN = """
from users_helper import keep
import numpy as np

def match(a, b, prediction):
    x = np.stack(np.meshgrid(np.arange(10, 150, 12.0), np.arange(10, 150, 12.0)), axis=-1).reshape(-1, 2)
    return keep(np.stack([x, x], axis=1))

match.files = ["weights.bin"]
"""


def test_all_that_a_matcher_of_ones_own_is_made_of_counts(tmp_path, monkeypatch) -> None:
    (tmp_path / "users_own.py").write_text(OWN)
    (tmp_path / "users_helper.py").write_text("def keep(places):\n    return places\n")
    (tmp_path / "weights.bin").write_bytes(b"1")
    monkeypatch.syspath_prepend(tmp_path)
    found = hook_files("users_own:match")
    assert [path.name for path in found] == ["users_own.py", "users_helper.py", "weights.bin"]
    assert hook_files("guided") == []
    (tmp_path / "weights.bin").unlink()
    with pytest.raises(InputError, match=r"declares .*weights\.bin, which is no file"):
        hook_files("users_own:match")
