"""Files from elsewhere, opened in one place: regular files only, of bounded size.

A pipe would wait for a writer that never comes and a device has no end, so what a path stands for is asked of
the open file itself: nothing can be put in its place between the question and the reading.
"""

from __future__ import annotations

import io
import json
import logging
import math
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, TextIO

from barpc.errors import BarpcError, ImageError, InputError, RpcFormatError

logger = logging.getLogger(__name__)

MB = 1 << 20
_FLAGS = (
    os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOCTTY", 0)
    | getattr(os, "O_BINARY", 0)
)  # fmt: skip
_KINDS = {stat.S_ISDIR: "a folder", stat.S_ISFIFO: "a pipe", stat.S_ISSOCK: "a socket"}
_DIGITS = 18  # of a whole number: more do not fit 64 bits
_LONG = 64 * MB  # what takes longer than two seconds to read and parse says so
_LINE = 4 * 4096
_LARGEST = 1e100  # no number of a side file comes near, and its square is finite


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Parameters
    ----------
    words : str
        What a message calls it.
    most : int or None
        Larger files are refused [bytes]; None for images, which are never read whole.
    error : type of BarpcError
        What is raised.
    """

    words: str
    most: int | None
    error: type[BarpcError] = InputError

    def raising(self, error: type[BarpcError]) -> Kind:
        """The same kind with another class of error."""
        return replace(self, error=error)

    def check(self, path: Path | str, size: int) -> None:
        """Raise if a file of `size` bytes is too large."""
        if self.most is not None and size > self.most:
            raise self.error(
                f"{path}: {size} bytes, too large for {self.words} (at most {self.most} are read)"
            )


IMAGE = Kind("an image", None, ImageError)
PRODUCT = Kind("a product", None, RpcFormatError)
GRID = Kind("a height grid", None)
RPC_FILE = Kind("an RPC file", 32 * MB, RpcFormatError)
TABLE = Kind("a table of points", 1024 * MB)
ARRAYS = Kind("an archive of arrays", 1024 * MB)
GEOJSON = Kind("a GeoJSON file", 256 * MB)
OPTIONS = Kind("an options file", MB)
NAMES = Kind("a list of names", 16 * MB)
SUMMARY = Kind("a run's summary", 512 * MB)


@contextmanager
def opened(path: Path | str, kind: Kind) -> Iterator[BinaryIO]:
    """A regular file, open for reading; what fails while it is read is told as one line.

    Parameters
    ----------
    path : Path or str
        The file; links are followed.
    kind : Kind
        What it should be.

    Raises
    ------
    BarpcError
        Of the class of `kind`: there is no such file, it is a folder, pipe or device, it is too large or cannot
        be read. The message names it.
    """
    try:
        with _regular(path, kind) as file:
            yield file
    except BarpcError:
        raise
    except OSError as error:
        raise kind.error(f"{path}: cannot be read ({error.strerror or error})") from error


def _regular(path: Path | str, kind: Kind) -> BinaryIO:
    try:
        descriptor = os.open(path, _FLAGS)
    except (FileNotFoundError, NotADirectoryError):
        raise kind.error(f"{path}: no such file; {kind.words} is needed") from None
    except ValueError as error:  # a zero byte in the name
        raise kind.error(f"{path}: cannot be read ({error})") from error
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            what = next((words for test, words in _KINDS.items() if test(found.st_mode)), "a device")
            raise kind.error(f"{path}: {what}, not a file; {kind.words} is needed")
        kind.check(path, found.st_size)
        if kind.most is not None and found.st_size > _LONG:
            logger.warning("%s: reading %d MB, which takes a while", path, found.st_size >> 20)
    except BaseException:
        os.close(descriptor)
        raise
    return open(descriptor, "rb")  # noqa: PTH123  (a descriptor, no path)


@contextmanager
def opened_text(path: Path | str, kind: Kind, newline: str | None = None) -> Iterator[TextIO]:
    """As `opened`, for UTF-8 text, with or without a byte order mark."""
    try:
        with (
            opened(path, kind) as file,
            io.TextIOWrapper(file, encoding="utf-8-sig", newline=newline) as text,
        ):
            yield text
    except UnicodeDecodeError as error:
        raise kind.error(f"{path}: not a UTF-8 text, so not {kind.words} ({error.reason})") from error


def read_bytes(path: Path | str, kind: Kind) -> bytes:
    """All bytes of a file (see `opened`)."""
    with opened(path, kind) as file:
        data = file.read() if kind.most is None else file.read(kind.most + 1)
        kind.check(path, len(data))  # it may have grown, and /proc knows no sizes
        return data


def read_head(path: Path | str, kind: Kind, size: int) -> bytes:
    """The first `size` bytes of a file, however large it is."""
    with opened(path, replace(kind, most=None)) as file:
        return file.read(size)


def read_text(path: Path | str, kind: Kind) -> str:
    """All of a UTF-8 text, line ends of one kind (see `opened`)."""
    data = io.BytesIO(read_bytes(path, kind))
    try:
        return io.TextIOWrapper(data, encoding="utf-8-sig").read()
    except UnicodeDecodeError as error:
        raise kind.error(f"{path}: not a UTF-8 text, so not {kind.words} ({error.reason})") from error


def read_names(path: Path | str, words: str) -> list[str]:
    """The lines of a list of names, called `words` (see `opened`); no line is longer than two paths can be."""
    kind = replace(NAMES, words=words)
    lines = read_text(path, kind).splitlines()
    for number, line in enumerate(lines, start=1):
        if len(line) > _LINE:
            raise kind.error(f"{path}, line {number}: {len(line)} characters, no name is so long")
    return lines


def read_json(path: Path | str, kind: Kind) -> Any:
    """What a JSON file holds (see `parse_json`)."""
    text = read_text(path, kind)
    try:
        return parse_json(text)
    except ValueError as error:
        raise kind.error(f"{path}: not JSON that can be read, so not {kind.words} ({error})") from error


def parse_json(text: str | bytes) -> Any:
    """What a JSON text holds: its numbers are finite, its whole numbers fit 64 bits.

    Raises
    ------
    ValueError
        Not JSON, a number beyond these bounds, or nested too deep.
    """
    try:
        return json.loads(text, parse_constant=_refuse, parse_int=_whole, parse_float=_finite)
    except RecursionError:
        raise ValueError("nested too deep") from None


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no finite number")


def _whole(digits: str) -> int:
    if len(digits) > _DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def _finite(text: str) -> float:
    value = float(text)
    if not math.fabs(value) <= _LARGEST:
        raise ValueError(f"{text[:40]} is beyond {_LARGEST:g}")
    return value
