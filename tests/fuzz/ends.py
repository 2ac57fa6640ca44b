"""Damage of another kind, which keeps a file's outline: numbers at the ends of doubles, what is there twice, what ends
in the middle of a number. It suits texts and bytes alike, so every kind of file meets it."""

from __future__ import annotations

import io
import re
import warnings
import zipfile
from collections.abc import Callable

import numpy as np

from .mutate import pick

Rng = np.random.Generator

ENDS = (
    "1e308", "-1e308", "1.7976931348623157e308", "5e-324", "-5e-324", "1e-310", "2.2250738585072014e-308", "nan",
    "inf", "-inf", "1e999", "-1e999", "1e-999", "-0.0", "0x7ff0000000000000", "0x7fefffffffffffff", "1e154", "1e155",
    "1e-162", "9007199254740993", "4503599627370497.5", "1.0000000000000002", "-nan",
)  # fmt: skip
"""The ends of doubles, and where their squares end."""
_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?")
_PAIR = re.compile(rb'"[^"\n]{1,40}"\s*:\s*(?:"[^"]*"|[-+.\w]+|\[[^][{}]*\])')  # of JSON, with a plain value
_EXPONENT = {"f8": (0x7FF0000000000000, "u8"), "f4": (0x7F800000, "u4")}


def mutate_ends(data: bytes, rng: Rng) -> bytes:
    """One to three such edits."""
    for _ in range(rng.integers(1, 4)):
        edit: Callable[[bytes, Rng], bytes] = EDITS[int(rng.integers(len(EDITS)))]
        data = edit(data, rng)
    return data


def _one(pattern: re.Pattern[bytes], data: bytes, rng: Rng) -> re.Match[bytes] | None:
    """One of the places of a pattern, sought from a place by chance: a large file is not gone through."""
    at = int(rng.integers(len(data) + 1))
    start = data.rfind(b"\n", 0, at) + 1 if rng.integers(2) else max(0, at - 40)
    found = list(pattern.finditer(data, start, start + 400)) or list(pattern.finditer(data, 0, 400))
    return found[int(rng.integers(len(found)))] if found else None


def end_of_doubles(data: bytes, rng: Rng) -> bytes:
    """A number becomes one of the ends."""
    found = _one(_NUMBER, data, rng)
    if found is None:
        return data
    return data[: found.start()] + str(pick(rng, ENDS)).encode() + data[found.end() :]


def cut_number(data: bytes, rng: Rng) -> bytes:
    """A number loses its end, with the rest of the file or without."""
    found = _one(_NUMBER, data, rng)
    if found is None or found.end() - found.start() < 2:
        return data
    cut = int(rng.integers(found.start() + 1, found.end()))
    return data[:cut] + (b"" if rng.integers(3) == 0 else data[found.end() :])


def twice(data: bytes, rng: Rng) -> bytes:
    """A key, or a line, stands there twice: again as it is, or with another number."""
    pair = _one(_PAIR, data, rng) if rng.integers(2) else None
    if pair is not None:
        again, at, between = pair[0], pair.end(), b", "
    else:
        start = data.rfind(b"\n", 0, int(rng.integers(len(data) + 1))) + 1
        end = data.find(b"\n", start)
        again, at, between = data[start : end if end >= 0 else len(data)], start, b"\n"
        if rng.integers(2):  # further down
            at = data.find(b"\n", end + 1) + 1 or len(data)
    if rng.integers(2):
        again = end_of_doubles(again, rng) if rng.integers(2) else cut_number(again, rng)
    return data[:at] + (between + again if between == b", " else again + between) + data[at:]


def by_exponent(data: bytes, rng: Rng) -> bytes:
    """The exponent of a binary number is all ones (infinite, none) or zeros (denormal), in either order of bytes."""
    kind = str(pick(rng, list(_EXPONENT)))
    mask, whole = _EXPONENT[kind]
    width = int(kind[1])
    if len(data) < width:
        return data
    steps = (len(data) - width) // (4 if rng.integers(4) else 1) + 1
    at = int(rng.integers(steps)) * (len(data) - width) // max(1, steps - 1) if steps > 1 else 0
    at -= at % 4 if rng.integers(4) else 0
    order = "<" if rng.integers(2) else ">"
    word = int(np.frombuffer(data[at : at + width], order + whole)[0])
    changed = word | mask if rng.integers(2) else word & ~mask
    return data[:at] + np.array(changed, order + whole).tobytes() + data[at + width :]


EDITS = (end_of_doubles, end_of_doubles, cut_number, twice, by_exponent)


def bent(value: np.ndarray, rng: Rng) -> np.ndarray:
    """An array with some of its numbers at the ends of its type."""
    value = value.copy()
    if not value.size or value.dtype.kind not in "fiu":
        return value
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(value.size)) if rng.integers(4) else slice(None)
        if value.dtype.kind == "f":
            kind = f"{value.dtype.kind}{value.dtype.itemsize}"
            if kind in _EXPONENT and rng.integers(2):
                mask, whole = _EXPONENT[kind]
                words = np.ascontiguousarray(value).view(whole).reshape(-1)
                words[at] = (
                    words[at] | whole_type(whole, mask) if rng.integers(2) else words[at] & ~whole_type(whole, mask)
                )
                value = words.view(value.dtype).reshape(value.shape)
                continue
            with np.errstate(all="ignore"):
                value.reshape(-1)[at] = float(str(pick(rng, [e for e in ENDS if "x" not in e])))
        else:
            ends = np.iinfo(value.dtype)
            value.reshape(-1)[at] = int(
                pick(rng, [n for n in (ends.max, ends.min, 0, 1, 2**31) if ends.min <= n <= ends.max])  # type: ignore[call-overload]
            )
    return value


def whole_type(whole: str, mask: int) -> np.generic:
    """A mask as a number of the words that it goes with."""
    return np.dtype(whole).type(mask)


def mutate_npz_ends(data: bytes, rng: Rng) -> bytes:
    """An archive that holds up, of arrays with numbers at their ends; a member may be there twice."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    numbers = [name for name, value in arrays.items() if value.size and value.dtype.kind in "fiu"]
    for _ in range(rng.integers(1, 3)):
        if numbers:
            name = str(pick(rng, numbers))
            arrays[name] = bent(arrays[name], rng)
    members = list(arrays.items())
    if members and rng.random() < 0.2:
        name, value = members[int(rng.integers(len(members)))]
        members.append((name, bent(value, rng)))
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a name that is there twice
        for name, value in members:
            member = io.BytesIO()
            np.save(member, value)
            archive.writestr(f"{name}.npy", member.getvalue())
    return out.getvalue()
