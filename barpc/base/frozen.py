"""Values that never change, how they are kept as plain named arrays without pickle, and archives of such arrays."""

from __future__ import annotations

import json
import math
import sys
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from barpc.base.errors import BarpcError, InputError, plain
from barpc.base.fields import Value, field_names, given, is_record
from barpc.base.remote import Remote
from barpc.base.safe_io import ARRAYS, BYTES_PER_NUMBER, Kind, opened


class Frozen(Value):
    """Base of frozen dataclasses (declared with ``eq=False, repr=False``) that hold arrays and plain values.

    Arrays are copies of their own and read-only, after unpickling too, and compared by their content.
    """

    def __post_init__(self) -> None:
        for name, value in given(self).items():
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
        found = getattr(self, name)
        # of another record, which nobody can write to either
        kept = isinstance(found, np.ndarray) and found.flags.owndata and not found.flags.writeable
        what = f"{type(self).__name__} {name}"
        if np.any(getattr(found, "mask", False)) or np.iscomplexobj(found):
            raise error(f"{what}: masked or complex numbers; leave them out, or give their real parts")
        value: npt.NDArray[Any] = np.array(found, dtype=dtype, copy=None if kept else True)
        if value.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, value.shape, strict=True)):
            raise error(f"{what}: shape {value.shape}, expected {shape}")
        if finite and not np.isfinite(value).all():
            raise error(f"{what}: not finite ({value[~np.isfinite(value)][0]})")
        self._keep(name, value)
        return value

    def _told(self) -> str:
        return ", ".join(f"{name}={_short(value)}" for name, value in given(self).items())

    def _content(self) -> tuple[object, ...]:
        return tuple(map(_comparable, given(self).values()))

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            self._keep(name, value)


def joined(parts: Sequence[Any]) -> dict[str, Any]:
    """Return the fields of records of one class, each with the arrays or tuples of all, one after the other."""
    columns = {name: [getattr(part, name) for part in parts] for name in field_names(parts[0].__class__)}
    return {k: sum(v, ()) if isinstance(v[0], tuple) else np.concatenate(v) for k, v in columns.items()}


def _comparable(value: object) -> object:
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

_FRAME_KEY = "frame"


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
    arrays[_FRAME_KEY] = np.frombuffer(json.dumps(frame).encode(), dtype=np.uint8)
    return arrays


def from_arrays(arrays: Mapping[str, npt.NDArray[Any]], *, sent: bool = False) -> Any:
    """Return the value that `to_arrays` took apart; ValueError where it is damaged or no dataclass of barpc.

    A Remote is taken of arrays that were `sent` by our own process only: those of a file may be anybody's.
    """
    try:
        frame = json.loads(np.asarray(arrays[_FRAME_KEY], dtype=np.uint8).tobytes())
        return _decode(frame, arrays, sent)
    except (KeyError, TypeError, AttributeError, IndexError, RecursionError, UnicodeDecodeError) as error:
        raise ValueError(f"not a stage result: {plain(error)}") from error


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
    if is_record(value) and type(value).__module__.split(".")[0] == "barpc":
        kept = {name: _encode(held, arrays) for name, held in given(value).items()}
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
    if module.split(".")[0] != "barpc" or not (isinstance(kind, type) and hasattr(kind, "__dataclass_fields__")):
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
            kind.check(f"{path}, as numbers", BYTES_PER_NUMBER * sum(_npy_header(archive, m)[0] for m in members))
            return {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
    except BarpcError:
        raise
    except Exception as error:
        raise kind.error(f"{path}: not {kind.words} (.npz) that can be read ({plain(error)})") from error


def _npy_header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> tuple[int, int]:
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
