"""Values that never change, how they are kept as plain named arrays without pickle, and archives of such arrays."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import uuid
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from barpc.errors import BarpcError, InputError, OutputError
from barpc.remote import Remote
from barpc.sidefile import ARRAYS, NUMBER, Kind, opened


class Frozen:
    """Base of frozen dataclasses (declared with ``eq=False, repr=False``) that hold arrays and plain values.

    Arrays are copies of their own and read-only, after unpickling too; equality and hash go by the content of the
    fields that are given to the constructor; one line is printed.
    """

    def __post_init__(self) -> None:
        for name in self._given():
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                self._keep(name, value.copy())

    def _keep(self, name: str, value: Any) -> None:
        """Set a field; an array becomes read-only."""
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        object.__setattr__(self, name, value)

    def _array(
        self,
        name: str,
        shape: tuple[int | None, ...],
        error: type[BarpcError] = InputError,
        dtype: npt.DTypeLike = np.float64,
        finite: bool = True,
    ) -> Any:
        """Make a field a read-only array of the given shape (None: any length), its numbers `finite` if so asked."""
        value: npt.NDArray[Any] = np.array(getattr(self, name), dtype=dtype)
        what = f"{type(self).__name__} {name}"
        if value.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, value.shape, strict=True)):
            raise error(f"{what}: shape {value.shape}, expected {shape}")
        if finite and not np.isfinite(value).all():
            raise error(f"{what}: not finite ({value[~np.isfinite(value)][0]})")
        self._keep(name, value)
        return value

    def _given(self) -> list[str]:
        return [field.name for field in fields(self) if field.init]  # type: ignore[arg-type]  # children are dataclasses

    def _told(self) -> str:
        """Return the fields to be printed."""
        return ", ".join(f"{name}={_short(getattr(self, name))}" for name in self._given())

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._told()})"

    def _content(self) -> tuple[object, ...]:
        return tuple(_plain(getattr(self, name)) for name in self._given())

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and isinstance(other, Frozen) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            self._keep(name, value)


def _plain(value: object) -> object:
    """Return a value in the form in which it is compared; -0.0 is 0.0."""
    if not isinstance(value, np.ndarray):
        return value
    return value.shape, (value + 0.0 if value.dtype.kind == "f" else value).tobytes()


def _short(value: object) -> str:
    """Return a value in a few words: of an array with more than three numbers its shape."""
    if isinstance(value, np.ndarray) and value.size > 3:
        return f"{' x '.join(map(str, value.shape))} numbers"
    return np.array2string(value, precision=6) if isinstance(value, np.ndarray) else repr(value)


# --- values as named arrays -------------------------------------------------------------------------------

Arrays = dict[str, npt.NDArray[Any]]  # named plain arrays: what an ``.npz`` file holds

_FRAME = "frame"


def to_arrays(value: Any) -> Arrays:
    """Return the named arrays that hold a value: its own, with their bits, and around them a text (JSON).

    A value is None, bool, int, float, str, an array, tuple, list, mapping with string keys, or a dataclass of barpc
    of such; TypeError where anything else is in it.

    Examples
    --------
    >>> from_arrays(to_arrays({"xy": np.arange(3.0), "name": "a", "size": (2, None)}))
    {'xy': array([0., 1., 2.]), 'name': 'a', 'size': (2, None)}
    """
    arrays: Arrays = {}
    frame = _encode(value, arrays)
    arrays[_FRAME] = np.frombuffer(json.dumps(frame).encode(), dtype=np.uint8)
    return arrays


def from_arrays(arrays: Mapping[str, npt.NDArray[Any]], *, sent: bool = False) -> Any:
    """Return the value that `to_arrays` took apart; ValueError where it is damaged or no dataclass of barpc.

    A Remote is taken of arrays that were `sent` by our own process only: those of a file may be anybody's.
    """
    try:
        frame = json.loads(np.asarray(arrays[_FRAME], dtype=np.uint8).tobytes())
        return _decode(frame, arrays, sent)
    except (KeyError, TypeError, AttributeError, IndexError, RecursionError, UnicodeDecodeError) as error:
        raise ValueError(f"not a stage result: {error!r}") from error


def _encode(value: Any, arrays: Arrays) -> Any:
    if isinstance(value, Remote):
        return {"remote": [str(value), value.size, value.tag]}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError("an array of Python objects cannot be kept")
        name = f"array{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_encode(v, arrays) for v in value]}
    if isinstance(value, Mapping):
        return {"map": [[str(k), _encode(v, arrays)] for k, v in value.items()]}
    if is_dataclass(value) and type(value).__module__.split(".")[0] == "barpc":
        kept = {f.name: _encode(getattr(value, f.name), arrays) for f in fields(value) if f.init}
        return {"class": [type(value).__module__, type(value).__qualname__], "fields": kept}
    raise TypeError(f"a {type(value).__name__} cannot be kept")


def _decode(frame: Any, arrays: Mapping[str, npt.NDArray[Any]], sent: bool = False) -> Any:
    if not isinstance(frame, dict):
        return frame
    if "array" in frame:
        return arrays[frame["array"]]
    if "remote" in frame:
        if not sent:
            raise ValueError("a Remote in a file")
        return Remote(*frame["remote"])
    if "tuple" in frame:
        return tuple(_decode(v, arrays, sent) for v in frame["tuple"])
    if "list" in frame:
        return [_decode(v, arrays, sent) for v in frame["list"]]
    if "map" in frame:
        return {k: _decode(v, arrays, sent) for k, v in frame["map"]}
    module, name = frame["class"]
    kind = getattr(sys.modules.get(module), name, None)
    if module.split(".")[0] != "barpc" or not (isinstance(kind, type) and is_dataclass(kind)):
        raise ValueError(f"{module}.{name} is not a record of barpc")
    return kind(**{k: _decode(v, arrays, sent) for k, v in frame["fields"].items()})


DEFLATED = 1032  # bytes at most that one byte of a deflated stream stands for
HEADER = 1 << 12


def load_npz(path: Path | str, kind: Kind = ARRAYS) -> Arrays:
    """Return the arrays of an ``.npz`` file, unpacked of no more bytes than `kind` allows, with its error.

    What the archive claims is added up before anything is unpacked: a few kilobytes can hold gigabytes of zeros.
    """
    with opened(path, kind) as file:
        return _unpack(file, path, kind)


def _unpack(file: IO[bytes], path: Path | str, kind: Kind) -> Arrays:
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            kind.check(f"{path}, unpacked", sum(member.file_size for member in members))
            kind.check(f"{path}, as numbers", NUMBER * sum(_header(archive, m)[0] for m in members))
            return {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
    except BarpcError:
        raise
    except Exception as error:
        raise kind.error(
            f"{path}: not {kind.words} (.npz) that can be read ({type(error).__name__}: {error})"
        ) from error


def _header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> tuple[int, int]:
    """Return the elements and bytes of a member that the archive claims; ValueError where it cannot hold them."""
    packed = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: DEFLATED}.get(member.compress_type)
    if packed is None or member.file_size > packed * member.compress_size + HEADER:
        raise ValueError(f"{member.filename} claims more bytes than it can hold")
    with archive.open(member) as file:
        version = npy.read_magic(file)
        read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        shape, _, dtype = read_header(file)
        if dtype.hasobject:
            raise ValueError(f"{member.filename} holds Python objects")
        if math.prod(shape) * dtype.itemsize != member.file_size - file.tell():
            raise ValueError(f"{member.filename} holds another number of bytes than its shape {shape} asks for")
    return math.prod(shape), member.file_size


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray[Any]:
    """Return a member whose header was looked at."""
    with archive.open(member) as file:
        return np.asarray(npy.read_array(file, allow_pickle=False))


# --- files that are written whole or not at all -----------------------------------------------------------


_MARK = ".barpc-partial-"
STATE, PARTIAL = ".barpc", "partial"
"""Where a run folder keeps what is on its way, and is emptied at the next start: nothing there need last."""


@contextmanager
def replacing(
    path: Path | str, *, overwrite: bool = False, durable: bool = True, room: Path | None = None
) -> Iterator[Path]:
    """Yield a temporary path for `path`, renamed to it when the block ends without an error.

    It has the target's own name, in a folder of its own: what a writer takes from a name stays right, however long.

    Parameters
    ----------
    path : Path or str, the file to be written; its folder is made where it is missing
    overwrite : bool, replace an existing file, else an OutputError
    durable : bool, wait until the file is on the disk; not needed for what can be made again, never for what is on
        its way through a run folder's room
    room : Path, optional, where the temporary folder is made, on the same disk; None: beside `path`
    """
    path = Path(path)
    refuse_existing(path, overwrite)
    durable = durable and f"/{STATE}/{PARTIAL}/" not in path.as_posix()
    place = (room or path.parent) / f"{_MARK}{uuid.uuid4().hex[:12]}"
    partial = place / path.name
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        place.mkdir(parents=True)
        yield partial
        if durable:
            _sync(partial)
        refuse_existing(path, overwrite)  # it may have come while the block was at work
        partial.replace(path)
        if durable:
            _sync(path.parent)
    except OSError as error:
        if isinstance(error, OutputError) or error.errno is None:
            raise
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        shutil.rmtree(place, ignore_errors=True)


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise an OutputError where a file would be replaced that may not be."""
    if not overwrite and os.path.lexists(path):
        raise OutputError(f"{path}: exists already; choose another name or allow overwriting")


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path | str, text: str, *, overwrite: bool = False) -> None:
    """Write `text` to `path` as UTF-8 with the line ends it has, whole or not at all (`replacing`)."""
    with replacing(path, overwrite=overwrite) as partial:
        partial.write_bytes(text.encode())
