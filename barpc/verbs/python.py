"""The functions of barpc as Python calls them: open datasets stand for their files, errors name keywords, not flags."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable
from functools import cache, wraps
from pathlib import PurePath
from typing import Any

from barpc.base import options, verb_options
from barpc.base.declarations import Options, declared
from barpc.base.errors import BarpcError
from barpc.verbs.options import FLAG_NAMES


def of_python(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a public function, or verb, that takes open datasets as their files, and whose errors name keywords."""
    target = next((name for name in inspect.signature(function).parameters if name in _OUTPUT_NAMES), _OUTPUT_NAMES[0])

    @wraps(function)
    def called(*args: Any, **keywords: Any) -> Any:
        try:
            return function(*map(_file, args), **{name: _file(value) for name, value in keywords.items()})
        except BarpcError as error:
            error.args = tuple(in_keywords(one, target) if isinstance(one, str) else one for one in error.args)
            raise

    return called


def _file(value: Any) -> Any:
    """Return the path of an open dataset or path-like object, also in a list; anything else as it is."""
    if type(value) in (list, tuple):
        return type(value)(map(_file, value))
    if isinstance(value, os.PathLike) and not isinstance(value, PurePath):
        return os.fspath(value)
    if not hasattr(value, "crs"):
        return value
    from barpc.cameras import file_of  # with all that opens cameras

    return file_of(value)


_OUTPUT_NAMES = "out_dir", "out", "output"
"""Keywords for -o."""


@cache
def _verb_keywords() -> dict[str, str]:
    """Return the flags that set options, and the keywords that do, as a sentence has them."""
    records = [one for module in (options, verb_options) for one in vars(module).values() if inspect.isclass(one)]
    fields = [declared(one).items() for one in records if issubclass(one, Options) and one is not Options]
    known = {name: one.kind for record in fields for name, one in record} | dict.fromkeys(FLAG_NAMES.values(), str)
    words = {name: f"{name}=True" if kind is bool else name for name, kind in known.items()}
    flags = {f"--{name.replace('_', '-')}": text for name, text in words.items()}
    return flags | {"--csv": "csv=True", "--images": "images", "--options": "options", "-j": "jobs"}


def in_keywords(sentence: str, target: str = _OUTPUT_NAMES[0]) -> str:
    """Return a sentence with the keywords of Python in place of flags; `target`: that of -o. Commands stay.

    Examples
    --------
    >>> in_keywords("run: exists; give --overwrite or another -o, and --gcp-crs EPSG:32631")
    'run: exists; give overwrite=True or another out_dir, and gcp_crs EPSG:32631'
    """

    def keyword(found: re.Match[str]) -> str:
        return found[0] if found[0].startswith("'") else {**_verb_keywords(), "-o": target}.get(found[0], found[0])

    return re.sub(r"'barpc [^']*'|(?<![\w/.-])(?:--[a-z][a-z-]*|-[oj])\b", keyword, sentence)
