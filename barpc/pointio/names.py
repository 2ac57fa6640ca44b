"""Names of images, and the view meant by a name in a file.

Views get their names before any work, so that every file of a run carries them and reads back to the same image.
"""

from __future__ import annotations

import os
import re
import unicodedata
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import PurePath, PureWindowsPath

import numpy as np
import numpy.typing as npt

from barpc.base.errors import InputError, listed
from barpc.base.remote import PathOrUrl, pure

MAX_NAME = 120
"""Bytes of a view's name: the file of a pair's matches carries two, and 255 are what a file system takes."""
_FORMULA = frozenset("=+-@＝＋－＠\t\r")


def unique_names(files: Sequence[PathOrUrl]) -> list[str]:
    """Return a unique name for each file: its stem, with as many folders before it as necessary.

    Names that differ in case or composition only are taken for one, as file systems and GDAL do; two files of one
    folder that differ in their ending alone keep it. InputError for a name longer than `MAX_NAME`, or files that
    cannot be told apart.

    Examples
    --------
    >>> from pathlib import Path
    >>> unique_names([Path("a/img.tif"), Path("b/img.tif"), Path("b/other.tif")])
    ['a_img', 'b_img', 'other']
    >>> unique_names([Path("a/img.tif"), Path("a/img.jp2")])
    ['img.tif', 'img.jp2']
    """
    places = [pure(file) for file in dict.fromkeys(files)]
    names = _told_apart(places)
    for name, file in zip(names, places, strict=True):
        if name.startswith("."):
            raise InputError(
                f"{file}: its name in this run, {name!r}, begins with a dot, and files of such names are hidden; "
                "rename it, or give a link to it"
            )
        if len(os.fsencode(name)) > MAX_NAME:
            raise InputError(
                f"{file}: its name in this run has more than {MAX_NAME} bytes, too long for the files that carry it;"
                " rename it, or give a link with a shorter name"
            )
    found = dict(zip(dict.fromkeys(files), names, strict=True))
    return [found[file] for file in files]


def _told_apart(places: Sequence[PurePath]) -> list[str]:
    """Return the stems of files behind as many of their folders as make the names different."""
    stems = Counter((file.parent, _folded(file.stem)) for file in places)
    ends = [file.stem if stems[file.parent, _folded(file.stem)] == 1 else file.name for file in places]
    depth = [1] * len(places)
    while True:
        names = ["_".join([*file.parts[-n:-1], end]) for file, end, n in zip(places, ends, depth, strict=True)]
        count = Counter(map(_folded, names))
        again = [i for i, name in enumerate(names) if count[_folded(name)] > 1]
        deeper = [i for i in again if depth[i] < len(places[i].relative_to(places[i].anchor).parts)]
        if not deeper:
            break
        for i in deeper:
            depth[i] += 1
    if again:
        twin = next(i for i in again[1:] if _folded(names[i]) == _folded(names[again[0]]))
        raise InputError(
            f"{places[again[0]]} and {places[twin]}: their names cannot be told apart; rename one, or give a link to it"
        )
    return names


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def pair_name(first: str, second: str) -> str:
    """Return the name of the match file of two views, without its ending."""
    return f"{first}__{second}"


def require_pair_names(names: Sequence[str]) -> None:
    """Raise InputError unless every `pair_name` of two of the views means these two alone."""
    known, ordered = set(names), sorted(names)
    for long in names:
        for size in range(1, len(long)):
            short, rest = long[:size], f"{long[size:]}__"
            if short not in known or not rest.startswith("__"):
                continue
            start = rest[2:]  # long__x is short__(start + x)
            for other in ordered[bisect_left(ordered, start) :]:
                if not other.startswith(start):
                    break
                second = other.removeprefix(start)
                if second in known and second != long and other != short:
                    raise InputError(
                        f"{short}, {long}, {second} and {other}: a match file {pair_name(short, other)}.txt would mean"
                        " two pairs; rename an image"
                    )


def cell(text: str) -> str:
    r"""Return a text as a cell of a CSV table: quoted where it must be, never a spreadsheet's formula.

    A text that a spreadsheet would compute gets an apostrophe in front, which `from_cell` takes away.

    Examples
    --------
    >>> cell("view"), cell("=1+1"), cell('a"b'), cell("#1")
    ('view', '"\'=1+1"', '"a""b"', '"#1"')
    """
    if _computes(text):
        text = f"'{text}"
    plain = all(c.isalnum() or c in "_-.'" for c in text)
    return text if text and plain else '"' + text.replace('"', '""') + '"'


def from_cell(text: str) -> str:
    """Return the text of a cell, as `csv` gives it, that `cell` wrote."""
    return text[1:] if text.startswith("'") and _computes(text[1:]) else text


def _computes(text: str) -> bool:
    return text.lstrip(" '")[:1] in _FORMULA


class ViewNames:
    """Views found by any of the names that files use for them; `source` is the file that is read, for messages."""

    def __init__(self, names: Sequence[str], source: str) -> None:
        self.names, self.source = tuple(names), source
        self.strangers: dict[str, int] = {}
        self._index: dict[str, int] = {}
        ambiguous: set[str] = set()
        for i, name in enumerate(names):
            for key in {PurePath(name).name, PurePath(name).stem} - {""}:
                if key in self._index:
                    ambiguous.add(key)
                self._index[key] = i
        for key in ambiguous:
            del self._index[key]
        self._exact = {name: i for i, name in enumerate(names)}
        self._index.update(self._exact)
        self._known: dict[str, int | None] = {}  # what names meant: a table repeats them in every line
        folded = Counter(_folded(key) for key in self._index)
        self._loose = {_folded(key): i for key, i in self._index.items() if folded[_folded(key)] == 1}

    def exact(self, name: str) -> int | None:
        """Return the index of the view that has this very name."""
        return self._exact.get(name)

    def find(self, name: str) -> int | None:
        """Return the index of the view that `name` means; None where it means none, which `strangers` counts."""
        if name not in self._known:
            self._known[name] = self._meant(name)
        found = self._known[name]
        if found is None:
            self.strangers[name] = self.strangers.get(name, 0) + 1
        return found

    def of(self, names: Iterable[str]) -> npt.NDArray[np.int64]:
        """Return the index of the view that each name means, -1 where it means none."""
        return np.array([-1 if (one := self.find(name)) is None else one for name in names], dtype=np.int64)

    def _meant(self, name: str) -> int | None:
        bare = name.strip()
        for text in dict.fromkeys((name, bare, bare.strip('"'))):
            path = PurePath(text)
            for key in (text, path.name, path.stem):
                if key in self._index:
                    return self._index[key]
        path = PureWindowsPath(bare.strip('"'))  # folders either way
        return next((self._loose[key] for key in map(_folded, (path.name, path.stem)) if key in self._loose), None)

    def among(self, file: str) -> int | None:
        """Return the index of the view whose name a file of its points begins with, the longest; None without."""
        keys = [key for key in self._loose if re.match(rf"{re.escape(key)}(?![^\W_])", _folded(file))]
        return self._loose[max(keys, key=len)] if keys else None

    def said(self) -> str:
        """Return which names meant a view of another name, but for folders and endings."""
        loose = {name: self.names[i] for name, i in self._known.items() if i is not None}
        others = [f"{name} is {view}" for name, view in loose.items() if PurePath(view).stem not in name]
        return listed(others, 3)

    def index(self, name: str) -> int:
        """Return the index of the view that `name` means; InputError where there is none."""
        found = self.find(name)
        if found is None:
            raise InputError(f"{self.source}: no view is named {name!r}; there are {listed(self.names)}")
        return found
