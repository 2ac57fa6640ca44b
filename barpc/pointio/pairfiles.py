"""Matches in files named after a pair of images: ASP's `LEFT__RIGHT.txt` and `.match`, npz dictionaries of matchers.

The dictionaries are LightGlue's and SuperGlue's, arrays `keypoints0`, `keypoints1` (N, 2), and `matches0` or `matches`;
without these the rows correspond.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from barpc.errors import InputError
from barpc.frozen import Arrays, load_npz
from barpc.geodesy import Array
from barpc.pointio.links import PairPoints, index_pairs
from barpc.pointio.names import ViewNames
from barpc.sidefile import TABLE, read_bytes, read_text

ENDINGS = (".txt", ".match", ".npz")
_CLEAN = "-clean"  # what ASP adds to a name once its own outliers are gone
_HEAD = 45  # bytes of a keypoint in ASP's binary files, before its descriptor


def in_folder(folder: Path) -> list[Path]:
    """Return the files of pairs in a folder; of two that ASP wrote of a pair, the clean one."""
    found = sorted(path for ending in ENDINGS for path in folder.glob(f"*_*{ending}"))
    return [path for path in found if path.with_stem(path.stem + _CLEAN) not in found]


def read_pair_files(paths: Sequence[Path], views: ViewNames) -> Iterator[PairPoints]:
    """Read the matches of the files between two of the views."""
    for path in paths:
        pair = pair_of(path, views)
        if pair is not None:
            yield *pair, *_READERS[path.suffix.lower()](path)


def pair_of(path: Path, views: ViewNames) -> tuple[int, int] | None:
    """Return the two views that a file's name means; None where one is none of them."""
    left, right = (views.find(name) for name in _images(path, views))
    return None if left is None or right is None or left == right else (left, right)


def is_dictionary(arrays: Arrays) -> bool:
    """Return whether the arrays of an npz file are the matches of one pair."""
    return "keypoints0" in arrays


def _images(path: Path, views: ViewNames) -> tuple[str, str]:
    """Return the two images that a file's name means, a run's prefix before the first one left out."""
    stem = path.stem.removesuffix(_CLEAN)
    cuts = [(stem[:i], stem[i + 2 :]) for i in range(len(stem) - 1) if stem.startswith("__", i)]
    bare = stem.removesuffix("_matches")
    single = [(bare[:i], bare[i + 1 :]) for i in range(len(bare)) if bare[i] == "_"]
    for left, right in cuts + single:  # either name may hold the lines, too
        if views.exact(left) is not None and views.exact(right) is not None:
            return left, right
    for left, right in cuts:
        while views.find(left) is None and "-" in left:
            left = left.split("-", 1)[1]
        if views.find(left) is not None and views.find(right) is not None:
            return left, right
    return (cuts or single or [(stem, stem)])[0]


def _asp_text(path: Path) -> tuple[Array, Array]:
    """Read an ASP text file: counts on the first line, then one keypoint a line, col and row first."""
    try:
        lines = read_text(path, TABLE).split("\n")
        left, right = (int(word) for word in lines[0].split()[:2])
        rows = [line.split()[:2] for line in lines[1:] if line.strip()]
        points = np.array(rows, dtype=np.float64).reshape(-1, 2)
    except ValueError as error:
        raise InputError(f"{path}: not an ASP text match file ({error})") from error
    if left != right or len(points) != left + right:
        raise InputError(f"{path}: says {left} and {right} keypoints but holds {len(points)}")
    return points[:left], points[left:]


def _asp_binary(path: Path) -> tuple[Array, Array]:
    """Read two counts of 8 bytes, then the records of both images, each with a descriptor of one length."""
    data = read_bytes(path, TABLE)
    try:
        count, other = np.frombuffer(data, "<u8", 2).tolist()
        size = _HEAD + 4 * int(np.frombuffer(data, "<u8", 1, 16 + _HEAD - 8)[0])
        if count != other or 16 + 2 * count * size != len(data):
            raise ValueError(f"{len(data)} bytes are not {count} and {other} keypoints of {size} bytes")
        layout: Any = {"names": ["xy", "length"], "formats": [("<f4", 2), "<u8"], "offsets": [0, _HEAD - 8]}
        layout["itemsize"] = size
        records: Any = np.frombuffer(data, np.dtype(layout), 2 * count, 16)
        if len(set(records["length"].tolist())) != 1:
            raise ValueError("descriptors of unlike lengths")
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: not an ASP match file ({error})") from error
    points: Array = records["xy"].astype(np.float64)
    return points[:count], points[count:]


def matched_keypoints(path: Path, arrays: Arrays) -> tuple[Array, Array]:
    """Return the points (M, 2), (M, 2) that the arrays of one pair say."""
    try:
        first, second = (_points(arrays[key]) for key in ("keypoints0", "keypoints1"))
        known = arrays.get("matches0", arrays.get("matches"))
        if known is None:
            if len(first) != len(second):
                raise ValueError(f"no matches0, and {len(first)} and {len(second)} keypoints")
            return first, second
        pairs = index_pairs(known, (len(first), len(second)))
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not an npz of keypoints0, keypoints1 (N, 2), matches0 ({error})") from error
    return first[pairs[:, 0]], second[pairs[:, 1]]


def _points(array: object) -> Array:
    points = np.asarray(array, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"keypoints of shape {points.shape}")
    return points


_READERS: dict[str, Callable[[Path], tuple[Array, Array]]] = {
    ".txt": _asp_text,
    ".match": _asp_binary,
    ".npz": lambda path: matched_keypoints(path, load_npz(path)),
}
