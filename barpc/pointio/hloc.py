"""Matches in HDF5 files as hloc and scripts around LightGlue write them: keypoints in one file, matches in another.

Keypoints of an image: a dataset `NAME/keypoints`, or `NAME` itself; matches of a pair: `NAME0/NAME1/matches0`, or
`NAME0/NAME1` (M, 2) itself, slashes of names written as dashes. Needs h5py.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from barpc.errors import BarpcError, InputError
from barpc.frozen import DEFLATED, HEADER
from barpc.geodesy import Array
from barpc.pointio.links import PairPoints, index_pairs
from barpc.pointio.names import ViewNames
from barpc.sidefile import MB, NUMBER, Kind, opened

MAGIC = b"\x89HDF\r\n\x1a\n"
_FILE = Kind("an HDF5 file", None)  # most of it are descriptors, which are not read
_CONTENT = Kind("the keypoints and matches of an HDF5 file", 1024 * MB)
_KEYPOINTS, _MATCHES = "keypoints", "matches0"
_MOST, _DEEPEST = 2_000_000, 32  # objects, and groups in each other
_FEATURES = ("features.h5", "keypoints.h5")


def read_hloc(path: Path, views: ViewNames) -> Iterator[PairPoints]:
    """Read the matches between two of the views; the keypoints are looked for in the file, then beside it."""
    try:
        import h5py
    except ImportError:
        raise InputError(f"{path}: HDF5 is read with h5py, which is not installed: pip install h5py") from None
    try:
        with ExitStack() as files:
            matches = _Datasets(path, files, h5py)
            keypoints = matches
            if not matches.keypoints:
                keypoints = _Datasets(_features(path), files, h5py)
            yield from _matches(matches, keypoints, views)
    except BarpcError:
        raise
    except Exception as error:  # h5py raises what the damage happens to hit
        said = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: not an HDF5 file of matches that can be read ({said})") from error


def _features(path: Path) -> Path:
    """Return the file of the keypoints that belongs to a file of matches."""
    names = [*([path.stem.split("_matches")[0] + path.suffix] if "_matches" in path.stem else []), *_FEATURES]
    for name in names:
        if (path.parent / name).is_file():
            return path.parent / name
    raise InputError(f"{path}: holds no keypoints; they are looked for beside it as {', '.join(names)}")


def _datasets(file: Any, h5py: Any) -> Iterator[tuple[str, Any]]:
    """Yield the datasets of a file by their names; links, to other files and within, are passed over."""
    waiting, count = [(file, "", 0)], 0
    while waiting:
        group, place, depth = waiting.pop()
        for name in group:
            count += 1
            if count > _MOST or depth > _DEEPEST:
                raise ValueError(f"more than {_MOST} objects, or groups nested more than {_DEEPEST} deep")
            if group.get(name, getlink=True).__class__ is not h5py.HardLink:
                continue
            found = group[name]
            if isinstance(found, h5py.Dataset):
                yield place + name, found
            elif isinstance(found, h5py.Group):
                waiting.append((found, f"{place}{name}/", depth + 1))


class _Datasets:
    """The arrays of a file by image and by pair; links to other files are not followed."""

    def __init__(self, path: Path, files: ExitStack, h5py: Any) -> None:
        self._path, self._bytes = path, 0
        file = files.enter_context(h5py.File(files.enter_context(opened(path, _FILE)), "r"))
        self.keypoints: dict[str, Any] = {}
        self.matches: dict[tuple[str, str], Any] = {}

        for name, found in _datasets(file, h5py):
            *parts, last = name.split("/")
            if last == _KEYPOINTS or (found.ndim == 2 and found.shape[1] == 2 and found.dtype.kind == "f"):
                self.keypoints["-".join(parts if last == _KEYPOINTS else [*parts, last])] = found
            elif len(ends := parts if last == _MATCHES else [*parts, last]) == 2 and found.dtype.kind in "iu":
                self.matches[ends[0], ends[1]] = found

    def array(self, found: Any) -> Any:
        """Return the content of a dataset that lies in the file itself."""
        if found.is_virtual or found.external:
            raise ValueError(f"{found.name} lies in another file")
        if found.nbytes > DEFLATED * found.id.get_storage_size() + HEADER:
            raise ValueError(f"{found.name} claims more bytes than it can hold")
        self._bytes += found.size * max(NUMBER, found.dtype.itemsize)
        _CONTENT.check(self._path, self._bytes)
        return np.asarray(found[()])


def _matches(matches: _Datasets, keypoints: _Datasets, views: ViewNames) -> Iterator[PairPoints]:
    named = {name: _view(name, keypoints, views) for name in keypoints.keypoints}
    known = {name: view for name, view in named.items() if view is not None}
    points: dict[str, Any] = {}
    for ends, numbers in matches.matches.items():
        if not known.keys() >= set(ends) or known[ends[0]] == known[ends[1]]:
            continue
        for name in set(ends) - points.keys():
            points[name] = _coordinates(name, keypoints.array(keypoints.keypoints[name]))
        first, second = (points[name] for name in ends)
        rows = index_pairs(matches.array(numbers), (len(first), len(second)))
        yield known[ends[0]], known[ends[1]], first[rows[:, 0]], second[rows[:, 1]]


def _coordinates(name: str, found: Any) -> Array:
    """Return the columns and rows (N, 2) [px] of keypoints (N, 2 or more); ValueError for an array of anything else."""
    if found.ndim != 2 or found.shape[1] < 2 or found.dtype.kind not in "fiu":
        raise ValueError(f"keypoints of {name} of shape {found.shape} and type {found.dtype}")
    return np.asarray(found[:, :2], dtype=np.float64)


def _view(name: str, keypoints: _Datasets, views: ViewNames) -> int | None:
    """Return the view of an image, by its name with slashes or with dashes for them."""
    path = keypoints.keypoints[name].name.strip("/").removesuffix(f"/{_KEYPOINTS}")
    return views.find(path)
