"""Interface of matchers: their input, a prediction, and their output, matches.

A matcher is a class of one file and one row in `barpc.tie.matchers.matching.MATCHERS`: `match(a, b, prediction)` looks
for points of view A in view B. A view has a path to read pixels from and the camera; the prediction says where
in B any point of A may lie. What is found goes, whatever found it, the same way: bands that hold no true match
tell how many are false, a robust fit throws out what does not lie on the epipolar lines, matches that share a
point are linked into tracks, and these are registered to sub-pixel places.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from modulefinder import ModuleFinder
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from barpc.base.errors import BarpcError, InputError, TiePointError
from barpc.base.geodesy import Array, Box
from barpc.base.options import TieOptions
from barpc.scene import BoolArray, IntArray, View
from barpc.tie.matchers.features import Keypoints
from barpc.tie.pairing.epipolar import EpipolarSegments

DUPLICATE_DISTANCE = 2
"""Places that are no farther apart [px] are the same."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Bands in B in which points of A may lie."""

    where: Callable[[Array], EpipolarSegments]  # of points of A (N, 2) [px]; one axis for all predictions of a pair
    half_width: float  # how far across the epipolar lines to look [px]
    windows: Callable[[], Sequence[Box]]  # those of A that B may see, as far as the cameras may be wrong
    probes: int | None = None
    """So many points, spread evenly, are enough and only clear matches count: the cameras' error is looked for."""
    aside: float = 0.0  # how far the bands are moved across the epipolar lines [px]

    def at(self, xy: Array) -> EpipolarSegments:
        """Return the epipolar frame of points of A (N, 2) [px]; NaN: nowhere."""
        return self.where(xy).moved(self.aside)

    def chosen(self, count: int) -> IntArray:
        """Return the ascending indices of the probes among `count` points."""
        return np.linspace(0, count - 1, min(count, self.probes or count)).astype(np.int64)

    def contains(self, xy: Array) -> BoolArray:
        """Return the matches (M, 2, 2) that lie in the bands, for a matcher that looks everywhere."""
        return self.judge(xy[:, 0], xy[:, 1])[0]

    def judge(self, first: Array, second: Array) -> tuple[BoolArray, Array]:
        """Return the mask of places (M, 2), (M, 2) in the bands, and distances from the middles (M,), 1 at the edge.

        False matches lie anywhere in a band: where nothing else tells how alike two places look, this does.
        """
        where = self.at(first)
        along, across = where.errors(second).T
        aside = np.abs(across) / self.half_width
        return (along >= where.before) & (along <= where.after) & (aside <= 1.0), aside


@dataclass(frozen=True, eq=False)
class Matches:
    """Corresponding image points of two views."""

    xy: Array  # (M, 2, 2) col, row in the first and in the second view [px]
    score: Array  # (M,) how unlike the two places look: 0 or more, comparable among all calls for a pair
    index: IntArray
    """(M, 2) number of the point in either view: points of a view that two pairs number alike belong to one track."""
    sigma: float = float("nan")  # standard deviation of each coordinate [px], measured once they are verified

    def __len__(self) -> int:
        """Number of matches M."""
        return len(self.xy)

    @property
    def ends(self) -> tuple[Array, Array]:
        """Places (M, 2), (M, 2) [px] in either view."""
        return self.xy[:, 0], self.xy[:, 1]

    @staticmethod
    def of_places(xy: Array, score: Array) -> Matches:
        """Return the matches whose points are numbered by the pixel in which they lie."""
        pixel = np.rint(xy).astype(np.int64)
        return Matches(xy, score, (pixel[..., 1] << 32) + pixel[..., 0])

    def and_others(self, more: Matches) -> Matches:
        """Return the union with the matches of `more` whose points are new in both views."""
        new = ~(np.isin(more.index[:, 0], self.index[:, 0]) | np.isin(more.index[:, 1], self.index[:, 1]))
        some = more.select(new)
        columns = ((getattr(one, name) for one in (self, some)) for name in ("xy", "score", "index"))
        xy, score, index = map(np.concatenate, map(list, columns))
        return replace(self, xy=xy, score=score, index=index)

    def select(self, keep: IntArray | BoolArray) -> Matches:
        """Return the matches of a mask or of indices."""
        return replace(self, xy=self.xy[keep], score=self.score[keep], index=self.index[keep])


NO_MATCHES = Matches(np.empty((0, 2, 2)), np.empty(0), np.empty((0, 2), dtype=np.int64))


class Matcher(Protocol):
    """A matcher of one pair of views, asked several times: in wide bands, narrow ones, and decoy bands aside."""

    detects: ClassVar[bool]
    """Whether it wants the views' keypoints: they are found once a view, for all its pairs."""

    def __init__(self, options: TieOptions, keypoints: tuple[Keypoints, Keypoints]) -> None: ...

    def match(self, a: View, b: View, prediction: Prediction) -> Matches:
        """Return the unambiguous matches inside the bands of the prediction, and no others; in any order."""
        ...


@dataclass(frozen=True)
class Hook:
    """A user's function as a matcher: it may look everywhere, matches inside the bands count."""

    name: str
    function: Callable[[View, View, Prediction], Any]
    detects: ClassVar[bool] = False

    def __call__(self, options: TieOptions, keypoints: tuple[Keypoints, Keypoints]) -> Matcher:
        """The matcher of a pair."""
        return self

    def match(self, a: View, b: View, prediction: Prediction) -> Matches:
        """Return the function's matches inside the bands; errors name the function and the pair."""
        try:
            xy, score = _match_coordinates(self.function(a, b, prediction))
        except BarpcError:
            raise
        except Exception as error:
            said = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
            raise TiePointError(f"matcher {self.name}, {a.name} - {b.name}: {said}") from error
        inside, aside = prediction.judge(xy[:, 0], xy[:, 1])
        for end, view in enumerate((a, b)):
            inside &= ((xy[:, end] >= -0.5) & (xy[:, end] <= np.array(view.size) - 0.5)).all(axis=1)
        return Matches.of_places(xy, aside if score is None else score).select(inside)


def _match_coordinates(found: Any) -> tuple[Any, Any]:
    """Return the places (M, 2, 2) [px] and dissimilarities (M,), or None, in the result of a user's function."""
    if isinstance(found, Matches):
        found = found.xy, found.score
    xy, score = found if isinstance(found, tuple) else (found, None)
    xy = np.asarray(xy, dtype=np.float64)
    score = None if score is None else np.asarray(score, dtype=np.float64)
    if xy.ndim != 3 or xy.shape[1:] != (2, 2) or (score is not None and score.shape != xy.shape[:1]):
        shapes = f"{xy.shape}" + ("" if score is None else f" and {score.shape}")
        raise ValueError(f"places (M, 2, 2) are expected, and scores (M,) or none; found {shapes}")
    if not np.isfinite(xy).all() or not (score is None or np.isfinite(score).all()):
        raise ValueError("a place or score is not finite")
    return xy, score


def hooked(name: str) -> type[Matcher] | Hook:
    """Import the matcher that `module:name` names; InputError where there is none."""
    module, _, attribute = name.partition(":")
    try:
        found = getattr(import_module(module), attribute)
    except Exception as error:
        said = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        raise InputError(f"matcher {name}: cannot be imported ({said}); is its folder in PYTHONPATH?") from error
    if not callable(found):
        raise InputError(f"matcher {name}: neither a function nor a class")
    return found if isinstance(found, type) else Hook(name, found)


def hook_files(name: str) -> list[Path]:
    """Return the files of `module:name`: its module, imports from the same folder, and declared files.

    `name.files`, paths from where the module lies, are files that decide what it finds, such as weights. None for a
    matcher of the table, or a module without a file.
    """
    if ":" not in name:
        return []
    matcher = hooked(name)
    function = matcher.function if isinstance(matcher, Hook) else matcher
    module = sys.modules[name.partition(":")[0]]
    if getattr(module, "__file__", None) is None:
        return []
    first = Path(str(module.__file__))
    found = ModuleFinder([str(first.parents[module.__name__.count(".") + (first.name == "__init__.py")])])
    try:
        found.run_script(str(first))
    except Exception as error:
        raise InputError(f"matcher {name}: {first} cannot be looked through ({error})") from error
    beside = {Path(one.__file__) for one in found.modules.values() if one.__file__}  # type: ignore[attr-defined]
    declared = [first.parent / path for path in getattr(function, "files", ())]
    for path in declared:
        if not path.is_file():
            raise InputError(f"matcher {name}: declares {path}, which is no file")
    return [first, *sorted({*beside, *declared} - {first})]
