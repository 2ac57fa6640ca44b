"""Every error that barpc raises on purpose.

A message is one line that says which file or view, what was found, and what to do.
"""

from __future__ import annotations

import errno
import mmap
import re
import sys
from collections.abc import Mapping, Sequence

_MAX_MESSAGE_LENGTH = 1500  # characters of a message


class BarpcError(Exception):
    """Base of all errors that barpc raises on purpose.

    MemoryError instead where it would put another sentence on an error that only says that memory is out.
    """

    def __init__(self, *args: object) -> None:
        super().__init__(*args)
        cause = sys.exception()
        if out_of_memory(cause) and not has_room():
            raise MemoryError from cause

    def __str__(self) -> str:
        """One printable line of bounded length, whatever a damaged file has put into the message."""
        text = super().__str__()
        if len(text) > _MAX_MESSAGE_LENGTH:
            text = f"{text[: _MAX_MESSAGE_LENGTH // 2]} ... {text[-_MAX_MESSAGE_LENGTH // 2 :]}"
        return visible(text).replace("\n", "\\n")


class RpcError(BarpcError, ValueError):
    """A camera model cannot be used: a coefficient is not finite, a scale is zero, a shape is wrong."""


class RpcFormatError(RpcError):
    """A file is not an RPC file that barpc reads."""


class ImageError(BarpcError, OSError):
    """A raster cannot be read, or carries no RPC."""


class MissingRpcError(ImageError):
    """An image without an RPC, and no file beside it that holds one."""


class TiePointError(BarpcError):
    """Too few tie points between views."""


class DisconnectedError(TiePointError):
    """The views fall into groups that share no tie point: `groups`, tuples of their names, the largest first; `said`,
    known faults of some of them, by name.
    """

    def __init__(
        self, message: str, groups: Sequence[Sequence[str]] = (), said: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(message)
        self.groups, self.said = tuple(tuple(group) for group in groups), dict(said or {})


class AdjustError(BarpcError):
    """The adjustment has no usable solution."""


class FitError(BarpcError):
    """A fitted RPC misses its tolerance."""


class InputError(BarpcError, ValueError):
    """Options or side files (GCPs, tie points, AOI, DEM) contradict each other or do not parse."""


class UsageError(InputError):
    """Arguments that do not go together, or that name nothing in the input: exit code 2 of a command."""


class OutputError(BarpcError, OSError):
    """A result cannot be written: it exists already, the disk is full, the folder is read-only."""


class ReservationError(BarpcError):
    """A run has a reservation (exit code 3), which `check=True` makes an error: `result`, whose files are written."""

    def __init__(self, message: str, result: object = None) -> None:
        super().__init__(message)
        self.result = result


class BarpcWarning(UserWarning):
    """Something the user should know that does not stop the run."""


class Remark(BarpcWarning):
    """An assumption that a result is based on, or a side effect: a command prints it and ends with exit code 0."""


_MEMORY_ALLOWANCE = 256 << 20  # bytes: more than is mapped at once where that fails and others still do not
_MEMORY = re.compile(
    r"failed to map segment|annot (?:allocate|map)|[Oo]ut of memory|[Ii]nsufficient memory|emory allocation failed|"
    r"nable to allocate|ot enough memory|can't start new thread"
)
_OTHER = re.compile(r"static TLS|not permitted")  # too many libraries of a kind; a disk that nothing may run from


def has_room(size: int = _MEMORY_ALLOWANCE) -> bool:
    """Return whether this process can still map so many bytes of memory."""
    try:
        mmap.mmap(-1, size).close()
    except (OSError, MemoryError):
        return False
    return True


def out_of_memory(error: BaseException | None) -> bool:
    """Return whether an error, or one that it came from, says that memory is out.

    MemoryError, ENOMEM and OpenCV's error -4 do. What others say - the loader of libraries, GDAL, HDF5, threads -
    counts where no memory can be had: a loader fails so for want of leave to run a file, GDAL on a damaged one.
    """
    seen, words = list[BaseException](), ""
    while error is not None and error not in seen:
        seen.append(error)
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
            return True
        if type(error).__module__ == "cv2" and "(-4:" in str(error):
            return True
        words = words if isinstance(error, BarpcError) else f"{words} {error}"
        error = error.__cause__ or error.__context__
    return bool(_MEMORY.search(words)) and not _OTHER.search(words) and not has_room()


def listed(names: Sequence[str], most: int = 10) -> str:
    """Return names as a sentence says them: so many, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def visible(text: str) -> str:
    r"""Return a text with everything that does not print escaped as in JSON; lines stay lines.

    Examples
    --------
    >>> visible("a\x1b[31m\tb±")
    'a\\u001b[31m\\u0009b±'
    """
    if text.replace("\n", "").isprintable():
        return text
    return text.translate({ord(c): _escaped(c) for c in set(text) if not c.isprintable() and c != "\n"})


def _escaped(char: str) -> str:
    return f"\\u{ord(char):04x}" if ord(char) < 0x10000 else f"\\U{ord(char):08x}"


_OWN_WORDS = {
    r"could not convert string to (?:float|complex): (.*)": "{} is no number",
    r"invalid literal for int\(\) with base \d+: (.*)": "{} is no whole number",
    r"(?:not enough|too many) values to unpack.*|zip\(\) argument.*": "too many or too few values",
    r"(.*): line (\d+) column (\d+) \(char \d+\)": "{} at line {}, column {}",
}
_OF_PYTHON = re.compile(
    r"object\b|\bargument\b(?<!Invalid argument)|cannot (?:reshape|cast|convert|unpack|be interpreted)|broadcast|"
    r"setting an array|inhomogeneous|index|buffer|unpack|operand|Cannot parse header|all the input|embedded null|codec|"
    r"must be (?:a |an |real |str)|math domain|float NaN|indices|Python int"
)


def plain(error: BaseException) -> str:
    """Return the message of an error on a file in plain words; of barpc's own errors their text.

    Examples
    --------
    >>> plain(KeyError("ji")), plain(ValueError("could not convert string to float: 'high'")), plain(IndexError("list"))
    ("no 'ji'", "'high' is no number", 'a value is missing, or of another kind')
    """
    text = str(error)
    if isinstance(error, BarpcError):
        return text
    if isinstance(error, KeyError):
        return f"no {text}"
    for pattern, words in _OWN_WORDS.items():
        if found := re.fullmatch(pattern, text, re.DOTALL):
            return words.format(*(group[:60].replace("\\n", "") for group in found.groups()))
    library = isinstance(error, (ValueError, OSError)) or type(error).__module__ not in (
        "builtins",
        "struct",
        "tokenize",
    )
    if not library or _OF_PYTHON.search(text):
        return "a value is missing, or of another kind"
    return (error.strerror if isinstance(error, OSError) else None) or text
