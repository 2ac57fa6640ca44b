"""Matches that other programs wrote, between two of a run's views.

Files named after a pair of images: ASP's `LEFT__RIGHT.txt` and `.match`, and npz dictionaries, LightGlue's and
SuperGlue's, arrays `keypoints0`, `keypoints1` (N, 2), and `matches0` or `matches`; without these the rows correspond.

COLMAP's databases (SQLite): verified matches of a pair where there are any, else all. COLMAP counts from the corner of
the first pixel: its centre is (0.5, 0.5).

HDF5 files as hloc and scripts around LightGlue write them. Keypoints of an image: a dataset `NAME/keypoints`, or `NAME`
itself; matches of a pair: `NAME0/NAME1/matches0`, or `NAME0/NAME1` (M, 2) itself, slashes of names written as dashes;
keypoints may lie in a file of their own. Needs h5py.
"""

from __future__ import annotations

import logging
import os
import sqlite3
from array import array
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from barpc.base.errors import BarpcError, InputError, plain
from barpc.base.frozen import DEFLATED, HEADER, Arrays, load_npz
from barpc.base.geodesy import Array
from barpc.base.safe_io import (
    BYTES_PER_NUMBER,
    MAX_DEPTH,
    MAX_ELEMENTS,
    TABLE,
    Kind,
    opened,
    opened_text,
    read_bytes,
    read_head,
)
from barpc.pointio.names import ViewNames
from barpc.scene import IntArray

logger = logging.getLogger(__name__)

PairPoints = tuple[int, int, Array, Array]
"""Two views, and points (M, 2), (M, 2) [px] of them that show the same ground."""

ENDINGS = (".txt", ".match", ".npz")
_CLEAN = "-clean"  # what ASP adds to a name once its own outliers are gone
_ASP_KEYPOINT_BYTES = 45  # bytes of a keypoint in ASP's binary files, before its descriptor
_DATABASE = Kind("a file of keypoints and matches", None)  # most of it are descriptors, which are not read
_CONTENT = Kind("the keypoints and matches of a COLMAP or HDF5 file", TABLE.most)
_MATCH_TABLE = replace(TABLE, empty=True)  # a pair without matches


def index_pairs(matches: npt.NDArray[np.generic], counts: tuple[int, int]) -> IntArray:
    """Return the numbers (M, 2) of matched keypoints, from such a table or the partner of each (-1: none).

    ValueError for another shape, or a number beyond the `counts` of keypoints.
    """
    if matches.dtype.kind not in "iu":
        raise ValueError(f"matches of type {matches.dtype}, not whole numbers")
    found = matches.astype(np.int64)
    if found.ndim == 1 and len(found) == counts[0]:
        found = np.column_stack([np.arange(len(found)), found])[found >= 0]
    if found.ndim != 2 or found.shape[1] != 2:
        raise ValueError(f"matches of shape {found.shape} of {counts[0]} and {counts[1]} keypoints")
    if len(found) and (found.min() < 0 or (found.max(axis=0) >= counts).any()):
        raise ValueError(f"a match of a keypoint beyond the {counts[0]} and {counts[1]} that there are")
    return found


_ImageKey = TypeVar("_ImageKey", bound=Hashable)


def _matched_points(
    views: Mapping[_ImageKey, int],
    keypoints: Callable[[_ImageKey], Array],
    matches: Iterable[tuple[_ImageKey, _ImageKey, Any]],
) -> Iterator[PairPoints]:
    """Yield the points that matches of keypoints, read when they are needed, join: images are known by their keys."""
    points = cache(keypoints)
    for a, b, numbers in matches:
        first, second = points(a), points(b)
        rows = index_pairs(numbers, (len(first), len(second)))
        yield views[a], views[b], first[rows[:, 0]], second[rows[:, 1]]


# --- files of pairs ---------------------------------------------------------------------------------------


def pair_files(path: Path) -> list[Path]:
    """Return the files of pairs in a folder, of two that ASP wrote of a pair the clean one; or a file that is one."""
    if not path.is_dir():
        return [path] if "__" in path.name and path.suffix.lower() in ENDINGS else []
    found = sorted(one for ending in ENDINGS for one in path.glob(f"*_*{ending}"))
    return [one for one in found if one.with_stem(one.stem + _CLEAN) not in found]


def read_pair_files(paths: Sequence[Path], views: ViewNames) -> Iterator[PairPoints]:
    """Read the matches of the files between two of the views."""
    for path in paths:
        pair = pair_of(path, views)
        if pair is not None:
            first, second = _MATCH_READERS[path.suffix.lower()](path)
            if not len(first):
                logger.warning("%s: holds no match", path)
            yield *pair, first, second


def pair_of(path: Path, views: ViewNames) -> tuple[int, int] | None:
    """Return the two views that a file's name means; None where one is none of them."""
    left, right = (views.find(name) for name in _images_of_file(path, views))
    return None if left is None or right is None or left == right else (left, right)


def _images_of_file(path: Path, views: ViewNames) -> tuple[str, str]:
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


def _read_asp_text(path: Path) -> tuple[Array, Array]:
    """Read an ASP text file: counts on the first line, then one keypoint a line, col and row first."""
    try:
        with opened_text(path, _MATCH_TABLE) as lines:
            left, right = (int(word) for word in next(lines, "0 0").split()[:2])
            points = array("d")
            for words in (line.split(None, 2)[:2] for line in lines):
                if words:
                    col, row = map(float, words)
                    points.extend((col, row))
    except ValueError as error:
        raise InputError(f"{path}: not an ASP text match file ({plain(error)})") from error
    xy = np.array(points).reshape(-1, 2)
    if left != right or len(xy) != left + right:
        raise InputError(f"{path}: says {left} and {right} keypoints but holds {len(xy)}")
    return xy[:left], xy[left:]


def _asp_binary(path: Path) -> tuple[Array, Array]:
    """Read two counts of 8 bytes, then the records of both images, each with a descriptor of one length."""
    data = read_bytes(path, _MATCH_TABLE)
    if not any(data) and len(data) in (0, 16):  # of a matcher that found nothing
        return np.empty((0, 2)), np.empty((0, 2))
    try:
        count, other = np.frombuffer(data, "<u8", 2).tolist()
        size = _ASP_KEYPOINT_BYTES + 4 * int(np.frombuffer(data, "<u8", 1, 16 + _ASP_KEYPOINT_BYTES - 8)[0])
        if count != other or 16 + 2 * count * size != len(data):
            raise ValueError(f"{len(data)} bytes are not {count} and {other} keypoints of {size} bytes")
        layout: Any = {"names": ["xy", "length"], "formats": [("<f4", 2), "<u8"], "itemsize": size}
        layout["offsets"] = [0, _ASP_KEYPOINT_BYTES - 8]
        records: Any = np.frombuffer(data, np.dtype(layout), 2 * count, 16)
        if len(set(records["length"].tolist())) != 1:
            raise ValueError("descriptors of unlike lengths")
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: not an ASP match file ({plain(error)})") from error
    points: Array = records["xy"].astype(np.float64)
    return points[:count], points[count:]


def matched_keypoints(path: Path, arrays: Arrays) -> tuple[Array, Array]:
    """Return the points (M, 2), (M, 2) that the arrays of one pair say."""
    try:
        first, second = (_point_array(arrays[key]) for key in ("keypoints0", "keypoints1"))
        known = arrays.get("matches0", arrays.get("matches"))
        if known is None:
            if len(first) != len(second):
                raise ValueError(f"no matches0, and {len(first)} and {len(second)} keypoints")
            return first, second
        pairs = index_pairs(known, (len(first), len(second)))
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not an npz of keypoints0, keypoints1 (N, 2), matches0 ({plain(error)})") from error
    return first[pairs[:, 0]], second[pairs[:, 1]]


def _point_array(array: object) -> Array:
    points = np.asarray(array, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"keypoints of shape {points.shape}")
    return points


_MATCH_READERS: dict[str, Callable[[Path], tuple[Array, Array]]] = {
    ".txt": _read_asp_text,
    ".match": _asp_binary,
    ".npz": lambda path: matched_keypoints(path, load_npz(path)),
}


# --- COLMAP -----------------------------------------------------------------------------------------------

COLMAP = b"SQLite format 3\0"
_JOURNAL = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"  # a rollback journal begins so while it counts
_IDS = 2147483647  # a pair's number is that of its first image times this, and that of the second
_SQL_TABLES = ("images", "keypoints", "two_view_geometries", "matches")
_MAX_SQLITE_STEPS = 2000  # of 100,000 instructions of SQLite, seconds of work: a damaged file may hold a loop


def read_colmap(path: Path, views: ViewNames) -> Iterator[PairPoints]:
    """Read the matches between two of the views; InputError where the file is no such database."""
    with opened(path, _DATABASE):  # no pipe, no device
        pass
    for log in (path.with_name(f"{path.name}-{end}") for end in ("wal", "journal")):
        # one of zeros is over, and kept for the next time
        if os.path.lexists(log) and any(read_head(log, _DATABASE, len(_JOURNAL))):
            raise InputError(f"{path}: another program has not finished writing it ({log.name}); close it first")
    where = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(where, uri=True)) as database:
            yield from _pairs_of_database(path, database, views)
    except (sqlite3.Error, ValueError, TypeError, OverflowError, MemoryError) as error:
        raise InputError(f"{path}: not a COLMAP database that can be read ({plain(error)})") from error


def _pairs_of_database(path: Path, database: sqlite3.Connection, views: ViewNames) -> Iterator[PairPoints]:
    tables, total = _plain_tables(database), 0

    def array(table: str, key: str, number: int, dtype: str) -> Any:
        """Return the array (rows, cols) of an image or pair; None where there is none."""
        nonlocal total
        query = f"SELECT rows, cols, data FROM {table} WHERE {key} = ?"  # noqa: S608  (names of ours)
        found = database.execute(query, (number,)).fetchone()
        if found is None or not found[0]:
            return None
        data = found[2] or b""
        total += BYTES_PER_NUMBER * (len(data) // np.dtype(dtype).itemsize)
        _CONTENT.check(path, total)
        return np.frombuffer(data, dtype).reshape(found[0], found[1])

    def keypoints(image: int) -> Array:
        found = array("keypoints", "image_id", image, "<f4")
        if found is None or found.shape[1] < 2:
            raise ValueError(f"no keypoints of image {image}")
        return np.asarray(found[:, :2], dtype=np.float64) - 0.5

    images = {
        int(number): views.find(str(name)) for number, name in database.execute("SELECT image_id, name FROM images")
    }
    known = {number: view for number, view in images.items() if view is not None}
    numbers = {int(row[0]) for table in tables[2:] for row in database.execute(f"SELECT pair_id FROM {table}")}  # noqa: S608

    def matches() -> Iterator[tuple[int, int, Any]]:
        for number in sorted(numbers):
            a, b = divmod(number, _IDS)
            if {a, b} <= known.keys() and a != b:
                found = (array(table, "pair_id", number, "<u4") for table in tables[2:])
                rows = next((rows for rows in found if rows is not None), None)
                if rows is not None:
                    yield a, b, rows

    yield from _matched_points(known, keypoints, matches())


def _plain_tables(database: sqlite3.Connection) -> list[str]:
    """Return the tables that are read, from now on by plain queries only, so that nothing in the file is run."""
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _CONTENT.most or 0)
    database.execute("PRAGMA trusted_schema = OFF")
    database.execute("PRAGMA cell_size_check = ON")
    kinds = dict(database.execute("SELECT name, type FROM sqlite_master WHERE type IN ('table', 'view')"))
    if wrong := [name for name in _SQL_TABLES if kinds.get(name, "table") != "table"]:
        raise ValueError(f"{wrong[0]} is a {kinds[wrong[0]]}")
    if missing := [name for name in _SQL_TABLES[:2] if name not in kinds]:
        raise ValueError(f"no table {missing[0]}")
    database.set_authorizer(_allowed)
    steps = iter(range(_MAX_SQLITE_STEPS))
    database.set_progress_handler(lambda: int(next(steps, None) is None), 100_000)
    return [name for name in _SQL_TABLES if name in kinds]


def _allowed(action: int, first: str | None, _second: str | None, _base: str | None, source: str | None) -> int:
    """Authorise reading the known tables, and nothing by a view or trigger."""
    good = action == sqlite3.SQLITE_SELECT or (action == sqlite3.SQLITE_READ and first in _SQL_TABLES)
    return sqlite3.SQLITE_OK if good and source is None else sqlite3.SQLITE_DENY


# --- HDF5 -------------------------------------------------------------------------------------------------

HDF5 = b"\x89HDF\r\n\x1a\n"
_KEYPOINTS_DATASET, _MATCHES_DATASET = "keypoints", "matches0"
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
            keypoints = matches if matches.keypoints else _Datasets(_features(path), files, h5py)
            yield from _pairs_of_datasets(matches, keypoints, views)
    except BarpcError:
        raise
    except Exception as error:  # h5py raises what the damage happens to hit
        said = " ".join(plain(error).split())[:200]
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
            if count > MAX_ELEMENTS or depth > MAX_DEPTH:
                raise ValueError(f"more than {MAX_ELEMENTS} objects, or groups nested more than {MAX_DEPTH} deep")
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
        file = files.enter_context(h5py.File(files.enter_context(opened(path, _DATABASE)), "r"))
        self.keypoints: dict[str, Any] = {}
        self.matches: dict[tuple[str, str], Any] = {}
        for name, found in _datasets(file, h5py):
            *parts, last = name.split("/")
            if last == _KEYPOINTS_DATASET or (found.ndim == 2 and found.shape[1] == 2 and found.dtype.kind == "f"):
                self.keypoints["-".join(parts if last == _KEYPOINTS_DATASET else [*parts, last])] = found
            elif len(ends := parts if last == _MATCHES_DATASET else [*parts, last]) == 2 and found.dtype.kind in "iu":
                self.matches[ends[0], ends[1]] = found

    def array(self, found: Any) -> Any:
        """Return the content of a dataset that lies in the file itself."""
        if found.is_virtual or found.external:
            raise ValueError(f"{found.name} lies in another file")
        if found.nbytes > DEFLATED * found.id.get_storage_size() + HEADER:
            raise ValueError(f"{found.name} claims more bytes than it can hold")
        self._bytes += found.size * max(BYTES_PER_NUMBER, found.dtype.itemsize)
        _CONTENT.check(self._path, self._bytes)
        return np.asarray(found[()])

    def coordinates(self, name: str) -> Array:
        """Return the columns and rows (N, 2) [px] of an image's keypoints (N, 2 or more); ValueError for others."""
        found = self.array(self.keypoints[name])
        if found.ndim != 2 or found.shape[1] < 2 or found.dtype.kind not in "fiu":
            raise ValueError(f"keypoints of {name} of shape {found.shape} and type {found.dtype}")
        return np.asarray(found[:, :2], dtype=np.float64)


def _pairs_of_datasets(matches: _Datasets, keypoints: _Datasets, views: ViewNames) -> Iterator[PairPoints]:
    # an image is known by its name with slashes, its matches by that with dashes for them
    places = {
        name: found.name.strip("/").removesuffix(f"/{_KEYPOINTS_DATASET}")
        for name, found in keypoints.keypoints.items()
    }
    known = {name: view for name, place in places.items() if (view := views.find(place)) is not None}
    wanted = (
        (a, b, matches.array(numbers))
        for (a, b), numbers in matches.matches.items()
        if known.keys() >= {a, b} and known[a] != known[b]
    )
    yield from _matched_points(known, keypoints.coordinates, wanted)
