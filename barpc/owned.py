"""Which files of a run folder are barpc's own: those with the content that a run there noted down.

A run notes the sha256 of an output before the output takes its name: in ``.barpc/outputs.jsonl`` while it is at
work, in ``.barpc/state.json`` when it is done. Only a file with a noted content is ever replaced or taken away.
The notes may be anybody's: a name counts only for a regular file inside the folder, reached through no
symbolic link, and a folder below with a run of its own is that run's.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from barpc.errors import OutputError

STATE = ".barpc"
STATE_FILE, NOTES, LOCK, PARTIAL, CACHE = "state.json", "outputs.jsonl", "lock", "partial", "cache"
_FILES = (STATE_FILE, NOTES, LOCK)
MAX_BYTES = 32 << 20
"""Larger state files (some 300,000 outputs) count as missing [bytes]."""

_CAREFUL = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def digest(path: Path) -> str | None:
    """The sha256 of a regular file; None for anything else. No link is followed, no FIFO waited for."""
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            return None
        with open(os.open(path, os.O_RDONLY | _CAREFUL), "rb") as file:  # noqa: PTH123  (no link)
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError):
        return None


def owns(folder: Path, name: str, sha: str) -> bool:
    """Whether the file of this name has this content, and is this folder's own."""
    parts = PurePosixPath(name)
    if not parts.parts or parts.is_absolute() or ".." in parts.parts or str(parts) != name:
        return False
    if parts.parts[0].lower() == STATE:  # (disks that do not tell case apart)
        return False
    path = folder / name
    try:
        inside = path.parent.resolve() == folder.resolve() / parts.parent
        below = [folder / parent for parent in parts.parents if str(parent) != "."]
        return inside and not any((p / STATE).exists() for p in below) and digest(path) == sha
    except (OSError, ValueError):
        return False


def read_state(folder: Path) -> dict[str, Any]:
    """What state.json holds; nothing where it is missing, damaged, too large or no regular file."""
    try:
        state = json.loads(_text(folder / STATE / STATE_FILE))
    except (ValueError, RecursionError):
        return {}
    return state if isinstance(state, dict) else {}


def read_own(folder: Path) -> dict[str, str]:
    """The outputs of a folder's runs and their sha256. A name without a hash (release 0.1) is none.

    Of an output that a killed run was about to replace two contents are known: the one it has counts.
    """
    listed = read_state(folder).get("outputs")
    known: dict[str, dict[str, None]] = {}
    for name, sha in [*(listed.items() if isinstance(listed, dict) else ()), *_notes(folder)]:
        if isinstance(name, str) and isinstance(sha, str):
            known.setdefault(name, {})[sha] = None
    own = {}
    for name, contents in known.items():
        found = digest(folder / name) if len(contents) > 1 else None
        own[name] = found if found in contents else next(iter(contents))
    return own


def own_files(folder: Path) -> set[str]:
    """The names of barpc's own files that are in a folder, as it wrote them."""
    return {name for name, sha in read_own(folder).items() if owns(folder, name, sha)}


def _notes(folder: Path) -> Iterator[tuple[object, object]]:
    for line in _text(folder / STATE / NOTES).split("\n"):
        try:
            name, sha = json.loads(line)
        except (ValueError, TypeError, RecursionError):  # the last line of a run that was killed
            continue
        yield name, sha


def note(folder: Path, name: str, sha: str) -> None:
    """Note the content of an output, on the disk before the output takes its name.

    Raises
    ------
    OutputError
        The notes cannot be written.
    """
    path = folder / STATE / NOTES
    line = "\n" + json.dumps([name, sha]) + "\n"  # on a line of its own, whatever a killed run left
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | _CAREFUL, 0o666)
        with open(descriptor, "ab") as file:  # noqa: PTH123  (no link)
            file.write(line.encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


def refuse_odd(folder: Path) -> None:
    """Raise where something else stands in the place of barpc's own files: a link, a FIFO, a user's file.

    Raises
    ------
    OutputError
        Names it.
    """
    own = folder / STATE
    for path in (own, own / PARTIAL, own / CACHE, *_entries(own / CACHE), *(own / name for name in _FILES)):
        try:
            found = path.lstat()
        except OSError:  # not there; where it cannot be reached, it cannot be written either
            continue
        if _is_odd(path, found):
            raise OutputError(
                f"{path}: cannot be written: it is not barpc's own; move {own} away, or give another -o"
            )


def _is_odd(path: Path, found: os.stat_result) -> bool:
    if path.name not in _FILES:
        return stat.S_ISLNK(found.st_mode) if path.parent.name == CACHE else not stat.S_ISDIR(found.st_mode)
    # these are written to as they stand, and old releases of filelock empty what they open
    shared = path.name in (LOCK, NOTES) and found.st_nlink > 1
    return not stat.S_ISREG(found.st_mode) or shared or (path.name == LOCK and found.st_size > 0)


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _text(path: Path) -> str:
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > MAX_BYTES:
            return ""
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
