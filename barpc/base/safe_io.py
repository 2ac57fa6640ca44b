"""Files from elsewhere, opened in one place: regular files only, of bounded size, and nothing in them is ever run.

A pipe would wait for a writer that never comes and a device has no end, so what a path stands for is asked of
the open file itself: nothing can be put in its place between the question and the reading.
"""

from __future__ import annotations

import codecs
import io
import json
import math
import os
import re
import stat
import unicodedata
from array import array
from collections.abc import Container, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, TextIO
from xml.etree import ElementTree
from xml.parsers import expat

from barpc.base import identity
from barpc.base.errors import BarpcError, ImageError, InputError, RpcFormatError, plain, visible
from barpc.base.remote import REQUEST_BYTES, PathOrUrl, Remote, RemoteFile, location, pinned

MB = 1 << 20
BYTES_PER_NUMBER = 8
"""Bytes of what an element of a file becomes in memory, however small it is kept there."""
MAX_XML = 32 * MB  # the largest in use, a day of precise orbits, has 5 MB
_OPEN_FLAGS = os.O_RDONLY
for _system_flag in ("O_NONBLOCK", "O_CLOEXEC", "O_NOCTTY", "O_BINARY"):  # not every system has all
    _OPEN_FLAGS |= getattr(os, _system_flag, 0)
_KINDS = {stat.S_ISDIR: "a folder", stat.S_ISFIFO: "a pipe", stat.S_ISSOCK: "a socket"}
_ENCODING_BYTES, _MIN_LETTERS = 16, 4  # bytes that tell an encoding; letters of them, at least


@dataclass(frozen=True)
class Kind:
    """A kind of file."""

    words: str  # what a message calls it
    most: int | None  # larger files are refused [bytes]; None for images, which are never read whole
    error: type[BarpcError] = InputError
    lines: int | None = None  # texts of more lines, or of a line of more than `MAX_LINE_BYTES` bytes, are refused
    empty: bool = False  # whether a file of no bytes says something
    values: int = 8 * MB  # of JSON, which take 60 to 110 bytes each in memory: 1 GB at most

    def check(self, path: Path | str, size: int) -> None:
        """Raise if a file of `size` bytes is too large."""
        if self.most is not None and size > self.most:
            raise self.error(f"{path}: {size} bytes, too large for {self.words} (at most {self.most} are read)")

    def check_lines(self, path: Path | str, file: BinaryIO) -> None:
        """Raise if a text has more or longer lines than are read, before it is parsed; end at its beginning."""
        count = 0
        for part in iter(lambda: file.read(MAX_LINE_BYTES), b"") if self.lines else ():
            ends = max(part.count(b"\n"), part.count(b"\r"))
            if not ends and len(part) == MAX_LINE_BYTES:
                raise self.error(f"{path}: a line of more than {MAX_LINE_BYTES} bytes, too long for {self.words}")
            count += ends
        if self.lines and count > self.lines:
            raise self.error(f"{path}: {count} lines, too many for {self.words} (at most {self.lines} are read)")
        file.seek(0)


MAX_LINE_BYTES = MB
"""Bytes of a line of a table, a ground point in thousands of images; the longest one may have twice as many."""
_MAX_TABLE_LINES = 16 * MB  # of a table: names and numbers of a line take 150 bytes in memory, 2.5 GB at most

IMAGE = Kind("an image", None, ImageError)
PRODUCT = Kind("a product", None, RpcFormatError)
GRID = Kind("a height grid", None)
RPC_FILE = Kind("an RPC file", 32 * MB, RpcFormatError)
XML = Kind("an XML file", MAX_XML, RpcFormatError)
TABLE = Kind("a table of points", 1024 * MB, lines=_MAX_TABLE_LINES)
ARRAYS = Kind("an archive of arrays", 1024 * MB)
GEOJSON = Kind("a GeoJSON file", 256 * MB)
OPTIONS = Kind("an options file", MB, empty=True)
CALIBRATION = Kind("a calibration", 4 * MB)
NAMES = Kind("a list of names", 16 * MB)
CAMERA_STATE = Kind("a camera's state", 64 * MB, RpcFormatError)
SUMMARY = Kind("a run's summary", 512 * MB, values=32 * MB)


@contextmanager
def opened(path: Path | str, kind: Kind) -> Iterator[io.BufferedReader]:
    """Open a regular file for reading; links are followed.

    One line of the class of `kind` where there is no such file, it is a folder, pipe or device, empty, or cannot be
    read.
    """
    try:
        with _regular(path, kind) as file:
            if not (kind.empty or file.peek(1)):
                raise kind.error(f"{path}: the file is empty")
            yield file
    except BarpcError:
        raise
    except OSError as error:
        raise kind.error(f"{path}: cannot be read ({error.strerror or error})") from error


def versioned(path: PathOrUrl, kind: Kind) -> PathOrUrl:
    """Return a Remote with the version that its file has now, which all who are given it read; a Path as it is."""
    if not isinstance(path, Remote):
        return path
    try:
        return pinned(path)
    except FileNotFoundError as error:
        raise kind.error(f"{path}: no such file ({error}); {kind.words} is needed") from error
    except OSError as error:
        raise kind.error(f"{path}: cannot be read ({error})") from error


def _regular(path: Path | str, kind: Kind) -> io.BufferedReader:
    if isinstance(path, Remote):
        elsewhere = RemoteFile(versioned(path, kind))
        kind.check(path, elsewhere.size)
        return io.BufferedReader(elsewhere, REQUEST_BYTES)
    try:
        descriptor = os.open(path, _OPEN_FLAGS)
    except (FileNotFoundError, NotADirectoryError):
        raise kind.error(f"{path}: no such file; {kind.words} is needed") from None
    except ValueError as error:  # a zero byte in the name
        raise kind.error(f"{path}: cannot be read ({error})") from error
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            what = next((words for test, words in _KINDS.items() if test(found.st_mode)), "a device")
            raise kind.error(f"{path}: {what}, not a file; {kind.words} is needed{unread(Path(path))}")
        kind.check(path, found.st_size)
        identity.note(path, found)
    except BaseException:
        os.close(descriptor)
        raise
    return open(descriptor, "rb")  # noqa: PTH123  (a descriptor, no path)


def unread(path: Path) -> str:
    """Return the addition to a message on a folder or archive that barpc cannot read, with the remedy; else nothing."""
    named = path.name.lower().endswith((".zarr", ".zarr.zip"))
    if not (named or any((path / name).is_file() for name in (".zgroup", ".zmetadata", "zarr.json"))):
        return ""
    return "; a Zarr store, which is not read: of Sentinel-1 take the same product as SAFE, else the image as GeoTIFF"


def encoding_of(head: bytes) -> str:
    """Return the encoding of a text: UTF-16 where a byte order mark or zeros between its first letters say so."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    for name, zeros, letters in (
        ("utf-16-le", head[1:16:2], head[:16:2]),
        ("utf-16-be", head[:16:2], head[1:16:2]),
    ):
        if len(zeros) >= _MIN_LETTERS and not any(zeros) and all(letters):
            return name
    return "utf-8-sig"


@contextmanager
def opened_text(path: Path | str, kind: Kind, newline: str | None = None) -> Iterator[TextIO]:
    """Open a text as `opened` does, in UTF-8, with or without a byte order mark, or UTF-16."""
    with opened(path, kind) as file, _utf8(file, path, kind, newline) as text:
        yield text


@contextmanager
def _utf8(file: BinaryIO, path: Path | str, kind: Kind, newline: str | None = None) -> Iterator[TextIO]:
    kind.check_lines(path, file)
    encoding = encoding_of(file.read(_ENCODING_BYTES))
    file.seek(0)
    try:
        with io.TextIOWrapper(file, encoding=encoding, newline=newline) as text:
            yield text
    except UnicodeDecodeError as error:
        name = "UTF-16" if "16" in encoding else "UTF-8"
        raise kind.error(f"{path}: not a {name} text, so not {kind.words} ({error.reason})") from error


def read_bytes(path: Path | str, kind: Kind) -> bytes:
    """Read all bytes of a file (see `opened`)."""
    with opened(path, kind) as file:
        most = -1 if kind.most is None else kind.most + 1
        data = file.read(min(MB, most) if most >= 0 else MB)  # 32 MB at once are new memory for every small file
        if len(data) == MB:
            data += file.read(max(most - MB, 0) if most >= 0 else -1)
        kind.check(path, len(data))  # it may have grown, and /proc knows no sizes
        return data


def read_head(path: Path | str, kind: Kind, size: int = 4096) -> bytes:
    """Read the first `size` bytes of a file, however large it is."""
    with opened(path, replace(kind, most=None)) as file:
        return file.read(size)


def read_text(path: Path | str, kind: Kind) -> str:
    """Read all of a UTF-8 text, line ends of one kind (see `opened`)."""
    with _utf8(io.BytesIO(read_bytes(path, kind)), path, kind) as text:
        return text.read()


_MAX_NAME_LENGTH = 4 * 4096  # no line of names is longer than two paths can be


def read_names(path: Path | str, words: str) -> list[str]:
    """Read the lines of a list of names, called `words` (see `opened`)."""
    kind = replace(NAMES, words=words)
    lines = read_text(path, kind).splitlines()
    for number, line in enumerate(lines, start=1):
        if len(line) > _MAX_NAME_LENGTH:
            raise kind.error(f"{path}, line {number}: {len(line)} characters, no name is so long")
    return lines


# No XML takes the first two, GDAL splits a name at the third.
_REFUSED = "\ufffe\uffff" + ("\\" if os.sep == "/" else "")


def plain_path(path: str | os.PathLike[str]) -> PathOrUrl:
    """Return a path or a Remote unchanged if every output format can store it.

    InputError for a control character, an end of line, bytes that are no text, a backslash that separates no folders.
    """
    name = os.fspath(path)
    for char in name:
        if unicodedata.category(char) in ("Cc", "Cs", "Zl", "Zp") or char in _REFUSED:
            what = "bytes that are not UTF-8" if "\ud800" <= char <= "\udfff" else f"the character {char!a}"
            raise InputError(
                f"{visible(name)}: its path holds {what}, which not every file and tool takes;"
                " rename it, or give a link to it"
            )
    return location(path)


# --- JSON -------------------------------------------------------------------------------------------------

MAX_DIGITS = 18  # of a whole number: more do not fit 64 bits
MAX_NUMBER = 1e100
"""No number of a side file comes near, and its square is finite."""

MAX_DEPTH = 100
"""Levels of JSON and XML."""
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_NO_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))
_BRACKET_STEPS = bytes.maketrans(b"[]{}", b"\x01\xff\x01\xff")  # one level down or up, as signed bytes


def read_json(path: Path | str, kind: Kind) -> Any:
    """Read the content of a JSON file (see `parse_json`)."""
    text = read_text(path, kind)
    try:
        return parse_json(text, kind.values)
    except ValueError as error:
        raise kind.error(f"{path}: not JSON that can be read, so not {kind.words} ({plain(error)})") from error


def parse_json(text: str, most: int = Kind.values) -> Any:
    """Parse a JSON text.

    ValueError for numbers that are not finite or beyond 64 bits, too many values or levels, and halves of characters.
    """
    values = sum(map(text.count, ",:[{"))  # one, or the name of one, behind each
    if values > most:
        raise ValueError(f"{values} values, at most {most} are read")
    if _depth(text) > MAX_DEPTH:  # how deep json itself goes differs between versions of Python
        raise ValueError(f"nested too deep, at most {MAX_DEPTH} levels are read")
    found = json.loads(text, parse_constant=_refuse_constant, parse_int=_parse_integer, parse_float=_parse_float)
    if _SURROGATE.search(text):  # json takes half of a pair, what writes it only such as a name's odd bytes become
        try:
            json.dumps(found, ensure_ascii=False).encode(errors="surrogateescape")
        except UnicodeEncodeError as error:
            raise ValueError(f"{error.object[error.start]!a} is half of a character") from None
    return found


def _depth(text: str) -> int:
    """Return the nesting depth of a JSON text, strings left out; an upper bound where it is small."""
    few = text.count("[") + text.count("{")
    if few <= MAX_DEPTH:
        return few
    plain = text.replace(r"\\", "").replace(r"\"", "")
    outside = "".join(plain.split('"')[::2]).encode("ascii", "ignore")
    return max(accumulate(array("b", outside.translate(_BRACKET_STEPS, _NO_BRACKETS))), default=0)


def _refuse_constant(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no finite number")


def _parse_integer(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def _parse_float(text: str) -> float:
    value = float(text)
    if not math.fabs(value) <= MAX_NUMBER:
        raise ValueError(f"{text[:40]} is beyond {MAX_NUMBER:g}")
    return value


# --- XML --------------------------------------------------------------------------------------------------

MAX_ELEMENTS = 2_000_000
"""Of an XML or HDF5 file."""


class _Builder:
    """Makes the tree of a document: its root, and of the other elements all, or those called `only` with all in them.

    Others are gone through alone: of a vendor's metadata all but some lines are orbit and attitude. Refuses trees that
    are too large, and a document type that the encoding hides from a search of the bytes.
    """

    def __init__(self, strip_namespaces: bool, only: Container[str]) -> None:
        self._strip, self._only = strip_namespaces, only
        self._depth = self._count = self._kept = 0  # the last: levels of elements that are kept with all in them
        self._tree = ElementTree.TreeBuilder()
        self._parser = expat.ParserCreate(namespace_separator="}")
        self._parser.buffer_text = True
        self._parser.StartElementHandler, self._parser.EndElementHandler = self._start, self._end
        self._parser.StartDoctypeDeclHandler = self._doctype

    def parse(self, data: bytes) -> ElementTree.Element:
        self._parser.Parse(data, True)  # at once: expat before 2.6 looks at an unfinished token again with every part
        return self._tree.close()

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._depth, self._count = self._depth + 1, self._count + 1
        if self._depth > MAX_DEPTH or self._count > MAX_ELEMENTS:
            raise ValueError(f"{self._count} elements, {self._depth} deep: too many")
        tag = name.rpartition("}")[2] if self._strip else _universal(name)
        if self._kept:
            self._kept += 1
        elif not self._only or tag in self._only:
            self._kept, self._parser.CharacterDataHandler = 1, self._tree.data
        if self._kept or self._depth == 1:
            self._tree.start(tag, attributes and {_universal(key): value for key, value in attributes.items()})

    def _end(self, name: str) -> None:
        if self._kept or self._depth == 1:
            self._tree.end(name)
        self._depth -= 1
        if self._kept:
            self._kept -= 1
            if not self._kept:
                self._parser.CharacterDataHandler = None

    def _doctype(self, *_: object) -> NoReturn:
        raise ValueError("it declares a DOCTYPE")


def _universal(name: str) -> str:
    """Return a name as ElementTree has it: ``{namespace}name``."""
    return f"{{{name}" if "}" in name else name


def parse_xml(
    source: bytes | Path,
    *,
    name: str | None = None,
    max_bytes: int = MAX_XML,
    strip_namespaces: bool = False,
    only: Container[str] = (),
) -> ElementTree.Element:
    """Return the root element of an XML document, of bytes or a file; messages call it `name`, or by its path.

    No document type: an entity cannot be declared without one, so neither "billion laughs" nor a reference to another
    file can be written. `strip_namespaces` drops the ``{namespace}`` of every tag. Of elements `only`, the root has
    these alone, each directly in it. RpcFormatError where it cannot be read, has more than `max_bytes`, or is not
    well-formed.
    """
    name = name or (str(source) if isinstance(source, Path) else "XML document")
    data = read_bytes(source, replace(XML, most=max_bytes)) if isinstance(source, Path) else source
    if len(data) > max_bytes:
        raise RpcFormatError(f"{name}: {len(data)} bytes of XML, at most {max_bytes} are read")
    if b"!" in data and (b"<!DOCTYPE" in data or b"<!ENTITY" in data):
        raise RpcFormatError(f"{name}: refused, it declares a DOCTYPE; remove the declaration")
    try:
        return _Builder(strip_namespaces, only).parse(data)
    except (expat.ExpatError, LookupError, ValueError) as error:
        raise RpcFormatError(f"{name}: not an XML document that can be read ({error})") from error
