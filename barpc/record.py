"""Values as plain named arrays, and back: how stage results are kept without pickle.

Arrays keep their type and bits. Around them stands a text (JSON) of numbers, strings, tuples, lists,
mappings and barpc's own frozen dataclasses; nothing else is written, and nothing else is ever made when
reading.
"""

from __future__ import annotations

import json
import math
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from barpc.errors import BarpcError
from barpc.sidefile import ARRAYS, Kind, opened

Record = dict[str, npt.NDArray[Any]]
"""Named plain arrays: what an ``.npz`` file holds."""

_FRAME = "frame"
_DEFLATE = 1032  # bytes at most that one byte of a deflated stream stands for
_HEADER = 1 << 12


def load_npz(path: Path | str, kind: Kind = ARRAYS) -> Record:
    """The arrays of an ``.npz`` file; nothing in it is ever run.

    What the archive claims is added up before anything is unpacked: a file of a few kilobytes can hold gigabytes
    of zeros.

    Parameters
    ----------
    path : Path or str
        The file.
    kind : Kind
        What it should be; the arrays may have as many bytes as it allows, unpacked.

    Raises
    ------
    BarpcError
        Of the class of `kind`: it is missing, no archive of plain arrays, damaged, or too large.
    """
    with opened(path, kind) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                members = archive.infolist()
                kind.check(f"{path}, unpacked", sum(member.file_size for member in members))
                return {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}
        except BarpcError:
            raise
        except Exception as error:
            raise kind.error(
                f"{path}: not {kind.words} (.npz) that can be read ({type(error).__name__}: {error})"
            ) from error


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray[Any]:
    """A member, after its header was found to claim as many bytes as the archive does."""
    packed = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: _DEFLATE}.get(member.compress_type)
    if packed is None or member.file_size > packed * member.compress_size + _HEADER:
        raise ValueError(f"{member.filename} claims more bytes than it can hold")
    with archive.open(member) as file:
        version = npy.read_magic(file)
        read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        shape, _, dtype = read_header(file)
        if dtype.hasobject:
            raise ValueError(f"{member.filename} holds Python objects")
        if math.prod(shape) * dtype.itemsize != member.file_size - file.tell():
            raise ValueError(
                f"{member.filename} holds another number of bytes than its shape {shape} asks for"
            )
    with archive.open(member) as file:
        return np.asarray(npy.read_array(file, allow_pickle=False))


def to_record(value: Any) -> Record:
    """Named arrays that hold a value.

    Parameters
    ----------
    value : object
        None, bool, int, float, str, array, tuple, list, mapping with string keys, or a dataclass of barpc of
        such.

    Raises
    ------
    TypeError
        Anything else is in it.

    Examples
    --------
    >>> from_record(to_record({"xy": np.arange(3.0), "name": "a", "size": (2, None)}))
    {'xy': array([0., 1., 2.]), 'name': 'a', 'size': (2, None)}
    """
    record: Record = {}
    frame = _encode(value, record)
    record[_FRAME] = np.frombuffer(json.dumps(frame).encode(), dtype=np.uint8)
    return record


def from_record(record: Mapping[str, npt.NDArray[Any]]) -> Any:
    """The value that `to_record` took apart.

    Raises
    ------
    ValueError
        The record is damaged, or names a class that is not a loaded dataclass of barpc.
    """
    try:
        frame = json.loads(np.asarray(record[_FRAME], dtype=np.uint8).tobytes())
        return _decode(frame, record)
    except (KeyError, TypeError, AttributeError, IndexError, RecursionError, UnicodeDecodeError) as error:
        raise ValueError(f"not a stage result: {error!r}") from error


def _encode(value: Any, record: Record) -> Any:
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError("an array of Python objects cannot be kept")
        name = f"array{len(record)}"
        record[name] = value
        return {"array": name}
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_encode(v, record) for v in value]}
    if isinstance(value, Mapping):
        return {"map": [[str(k), _encode(v, record)] for k, v in value.items()]}
    if is_dataclass(value) and type(value).__module__.split(".")[0] == "barpc":
        kept = {f.name: _encode(getattr(value, f.name), record) for f in fields(value) if f.init}
        return {"class": [type(value).__module__, type(value).__qualname__], "fields": kept}
    raise TypeError(f"a {type(value).__name__} cannot be kept")


def _decode(frame: Any, record: Mapping[str, npt.NDArray[Any]]) -> Any:
    if not isinstance(frame, dict):
        return frame
    if "array" in frame:
        return record[frame["array"]]
    if "tuple" in frame:
        return tuple(_decode(v, record) for v in frame["tuple"])
    if "list" in frame:
        return [_decode(v, record) for v in frame["list"]]
    if "map" in frame:
        return {k: _decode(v, record) for k, v in frame["map"]}
    module, name = frame["class"]
    kind = getattr(sys.modules.get(module), name, None)
    if module.split(".")[0] != "barpc" or not (isinstance(kind, type) and is_dataclass(kind)):
        raise ValueError(f"{module}.{name} is not a record of barpc")
    return kind(**{k: _decode(v, record) for k, v in frame["fields"].items()})
