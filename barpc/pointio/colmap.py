"""Matches of a COLMAP database (SQLite): verified ones of a pair where there are any, else all.

COLMAP counts from the corner of the first pixel: its centre is (0.5, 0.5).
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from barpc.errors import InputError
from barpc.geodesy import Array
from barpc.pointio.links import PairPoints, index_pairs
from barpc.pointio.names import ViewNames
from barpc.scene import IntArray
from barpc.sidefile import MB, NUMBER, Kind, opened, read_head

MAGIC = b"SQLite format 3\0"
_DATABASE = Kind("a COLMAP database", None)  # most of it are descriptors, which are not read
_CONTENT = Kind("the keypoints and matches of a database", 1024 * MB)
_JOURNAL = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"  # a rollback journal begins so while it counts
_IDS = 2147483647  # a pair's number is that of its first image times this, and that of the second
_TABLES = ("images", "keypoints", "two_view_geometries", "matches")
_STEPS = 2000  # of 100,000 instructions of SQLite, seconds of work: a damaged file may hold a loop


def read_colmap(path: Path, views: ViewNames) -> Iterator[PairPoints]:
    """Read the matches between two of the views; InputError where the file is no such database."""
    with opened(path, _DATABASE):  # no pipe, no device
        pass
    for log in (path.with_name(f"{path.name}-{end}") for end in ("wal", "journal")):
        if _is_hot(log):
            raise InputError(f"{path}: another program has not finished writing it ({log.name}); close it first")
    where = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(where, uri=True)) as database:
            yield from _matches(_Tables(path, database), views)
    except (sqlite3.Error, ValueError, TypeError, OverflowError, MemoryError) as error:
        raise InputError(f"{path}: not a COLMAP database that can be read ({error})") from error


def _is_hot(log: Path) -> bool:
    """Return whether a log holds what the database has not; one of zeros is over, and kept for the next time."""
    if not os.path.lexists(log):
        return False
    return any(read_head(log, _DATABASE, len(_JOURNAL)))


class _Tables:
    """The few tables that are read: plain ones, by plain queries, so that nothing in the file is run."""

    def __init__(self, path: Path, database: sqlite3.Connection) -> None:
        self._path, self._database, self._bytes = path, database, 0
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 1024 * MB)
        database.execute("PRAGMA trusted_schema = OFF")
        database.execute("PRAGMA cell_size_check = ON")
        kinds = dict(database.execute("SELECT name, type FROM sqlite_master WHERE type IN ('table', 'view')"))
        if wrong := [name for name in _TABLES if kinds.get(name, "table") != "table"]:
            raise ValueError(f"{wrong[0]} is a {kinds[wrong[0]]}")
        if missing := [name for name in _TABLES[:2] if name not in kinds]:
            raise ValueError(f"no table {missing[0]}")
        self.names = [name for name in _TABLES if name in kinds]
        database.set_authorizer(_allowed)
        steps = iter(range(_STEPS))
        database.set_progress_handler(lambda: int(next(steps, None) is None), 100_000)

    def rows(self, columns: str, table: str) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a table, in order of their first column."""
        yield from self._database.execute(f"SELECT {columns} FROM {table}")  # noqa: S608  (names of ours)

    def array(self, table: str, key: str, number: int, dtype: str) -> Array | IntArray | None:
        """Return the array (rows, cols) of an image or pair; None where there is none."""
        query = f"SELECT rows, cols, data FROM {table} WHERE {key} = ?"  # noqa: S608
        found = self._database.execute(query, (number,)).fetchone()
        if found is None or not found[0]:
            return None
        data = found[2] or b""
        self._bytes += NUMBER * (len(data) // np.dtype(dtype).itemsize)
        _CONTENT.check(self._path, self._bytes)
        return np.frombuffer(data, dtype).reshape(found[0], found[1])


def _allowed(action: int, first: str | None, _second: str | None, _base: str | None, source: str | None) -> int:
    """Authorise reading the known tables, and nothing by a view or trigger."""
    good = action == sqlite3.SQLITE_SELECT or (action == sqlite3.SQLITE_READ and first in _TABLES)
    return sqlite3.SQLITE_OK if good and source is None else sqlite3.SQLITE_DENY


def _matches(tables: _Tables, views: ViewNames) -> Iterator[PairPoints]:
    known = {
        int(number): view
        for number, name in tables.rows("image_id, name", "images")
        if (view := views.find(str(name))) is not None
    }

    @cache
    def keypoints(image: int) -> Array:
        found = tables.array("keypoints", "image_id", image, "<f4")
        if found is None or found.shape[1] < 2:
            raise ValueError(f"no keypoints of image {image}")
        return found[:, :2].astype(np.float64) - 0.5

    for pair, ends in _pairs(tables, known).items():
        for table in tables.names[2:]:
            numbers = tables.array(table, "pair_id", pair, "<u4")
            if numbers is not None:
                first, second = (keypoints(image) for image in ends)
                rows = index_pairs(numbers, (len(first), len(second)))
                yield known[ends[0]], known[ends[1]], first[rows[:, 0]], second[rows[:, 1]]
                break


def _pairs(tables: _Tables, known: Mapping[int, int]) -> dict[int, tuple[int, int]]:
    """Return the pair number -> its images, of those that are views."""
    numbers = sorted({int(row[0]) for table in tables.names[2:] for row in tables.rows("pair_id", table)})
    found = {number: divmod(number, _IDS) for number in numbers}
    return {number: (a, b) for number, (a, b) in found.items() if {a, b} <= known.keys() and a != b}
