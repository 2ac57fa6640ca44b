"""A matcher of the user's own, by the name of its module: `module:name`.

The name is a function `match(view_a, view_b, prediction)`, or a class that keeps the protocol `Matcher`. Every process
that works on pairs imports it by that name; nothing but an option can name it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from modulefinder import ModuleFinder
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from barpc.errors import BarpcError, InputError, TiePointError
from barpc.options import TieOptions
from barpc.scene import View
from barpc.tie.matchers.features import Keypoints
from barpc.tie.matchers.matcher import Matcher, Matches, Prediction


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
            xy, score = _places(self.function(a, b, prediction))
        except BarpcError:
            raise
        except Exception as error:
            said = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
            raise TiePointError(f"matcher {self.name}, {a.name} - {b.name}: {said}") from error
        inside, aside = prediction.judge(xy[:, 0], xy[:, 1])
        for end, view in enumerate((a, b)):
            inside &= ((xy[:, end] >= -0.5) & (xy[:, end] <= np.array(view.size) - 0.5)).all(axis=1)
        return Matches.of_places(xy, aside if score is None else score).select(inside)


def _places(found: Any) -> tuple[Any, Any]:
    """Return the places (M, 2, 2) [px] and how unlike they look (M,), or None, of what a function gave back."""
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
    """Return the files of `module:name`: its module, those beside it that it imports, and those that it
    declares.

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
