"""Text that prints, and paths that every file can carry."""

from __future__ import annotations

import os
import unicodedata
from pathlib import Path

from barpc.errors import InputError

_REFUSED = "\ufffe\uffff" + (
    "\\" if os.sep == "/" else ""
)  # no XML; GDAL splits a file's name at a backslash


def plain_path(path: str | os.PathLike[str]) -> Path:
    """A path as it is, once every file that barpc writes can carry it.

    Raises
    ------
    InputError
        It holds a control character, the end of a line, bytes that are no text, or a backslash that does not
        separate folders.
    """
    name = os.fspath(path)
    for char in name:
        if unicodedata.category(char) in ("Cc", "Cs", "Zl", "Zp") or char in _REFUSED:
            what = "bytes that are not UTF-8" if "\ud800" <= char <= "\udfff" else f"the character {char!a}"
            raise InputError(
                f"{visible(name)}: its path holds {what}, which not every file and tool takes;"
                " rename it, or give a link to it"
            )
    return Path(name)


def visible(text: str) -> str:
    r"""A text with everything that does not print escaped; lines stay lines.

    Examples
    --------
    >>> visible("a\x1b[31m\tb±")
    'a\\u001b[31m\\u0009b±'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else _escaped(c) for c in text)


def _escaped(char: str) -> str:
    return f"\\u{ord(char):04x}" if ord(char) < 0x10000 else f"\\U{ord(char):08x}"  # as JSON has it
