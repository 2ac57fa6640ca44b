"""Finished folders: files by SHA256SUMS, notes of the state, and places of inputs.

An input is found by its content; a file of its name with another content is not it. Asked are, in this order: its path
as seen from the folder, which may have been moved, or be a link; the same path as seen from where the folder was made;
a file of its name in the folder, beside it, and in places given.

Files are hashed. Of those larger than `READ_WHOLE`, the size, times and number that they had when the run hashed them
are enough (`barpc.base.identity`): what leaves all of these as they were, as a bad disk does, only `barpc verify` sees,
which hashes all.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

from barpc.base import manifest
from barpc.base.atomic import STATE
from barpc.base.errors import InputError
from barpc.base.identity import Stamp, fingerprint
from barpc.base.manifest import REPORT_FILE, SUMS, Layer
from barpc.base.remote import is_url
from barpc.base.safe_io import MAX_XML

STATE_FILE, NOTES = "state.json", "outputs.jsonl"
READ_WHOLE = 8 << 20  # bytes: 6 ms to hash
CAREFUL = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


@dataclass(frozen=True, eq=False)
class Sealed:
    """A finished folder: its root, its layers, and notes of its state.

    `noted`: SHA-256 of outputs; `made`: where it was made; `stamps`: of large files, by their paths from the folder.
    """

    folder: Path
    root: str
    layers: Sequence[Layer]
    noted: Mapping[str, str]
    made: Path
    stamps: Mapping[str, Stamp]

    @classmethod
    def open(cls, folder: Path) -> Sealed:
        """Read SHA256SUMS and the state; InputError where SHA256SUMS is missing or damaged."""
        if not os.path.lexists(folder / SUMS):
            raise InputError(
                f"{folder / SUMS}: missing: the run was interrupted, or the file was removed; without it nothing "
                "can be verified: run the adjustment again"
            )
        root, layers = manifest.read(folder)
        state, stamps = read_state(folder), dict[str, Stamp]()
        with suppress(AttributeError, TypeError):
            stamps = {path: Stamp(*values) for path, values in state.get("stamps", {}).items()}
        return cls(folder, root, layers, noted_outputs(folder), Path(str(state.get("folder", folder))), stamps)

    @cached_property
    def listed(self) -> Mapping[str, str]:
        """SHA-256 of every file; of what the first command wrote a later one makes the report again, nothing else."""
        first = self.layers[0].files
        every = {name: sha for layer in self.layers for name, sha in layer.files.items()}
        return every | {name: sha for name, sha in first.items() if name != REPORT_FILE}

    def file(self, name: str) -> Path:
        """Return the path of a file, or of none that was written; InputError where it is not as a command wrote it."""
        path = self.folder / name
        if name not in self.listed and not os.path.lexists(path):
            return path
        if self.noted.get(SUMS, self.root) != self.root:
            raise self._edited(self.folder / SUMS, "was changed")
        last = None if name in self.layers[0].files else self.noted.get(name)  # of a later command that was ended
        if not any(sha and self.holds(path, name, sha) for sha in (self.listed.get(name), last)):
            raise self._edited(path, "was changed" if os.path.lexists(path) else "is gone")
        return path

    def _edited(self, path: Path, what: str) -> InputError:
        return InputError(f"{path}: {what} since the run wrote it (barpc verify {self.folder}): run it again")

    def holds(self, path: Path, key: str, sha: str, size: int | None = None, whole: bool = False) -> bool:
        """Return whether a file has a content; one that is none, or cannot be read, has not.

        `key`: its path from the folder, for its stamp; `size`: of the content, if known; `whole`: hash it in any case.
        """
        try:
            found = path.stat()
            if size is not None and found.st_size != size:
                return False
            if not whole and key in self.stamps and Stamp.of(found).matches(self.stamps[key]):
                return True
            return fingerprint(path).sha256 == sha
        except (OSError, ValueError):  # no such file, a name that is too long, a folder
            return False

    @cached_property
    def homes(self) -> Sequence[Path]:
        """Folders from which paths may be seen: this one, where it really lies, and where it was made."""
        return tuple(dict.fromkeys((self.folder.absolute(), Path(os.path.realpath(self.folder)), self.made)))

    def seen(self, path: str) -> list[Path]:
        """Return where a file of a path may be, as seen from the folder."""
        return [Path(os.path.normpath(home / path)) for home in self.homes]

    def find(
        self, path: str, sha: str, size: int | None = None, more: Iterable[Path] = (), whole: bool = False
    ) -> Path | None:
        """Return the file with the content of an input, absolute; None where none of the places has it."""
        beside = (place / Path(path).name for place in chain((self.homes[0], self.homes[0].parent), more))
        return next((at for at in chain(self.seen(path), beside) if self.holds(at, path, sha, size, whole)), None)

    def input(self, path: str, sha: str, size: int | None = None, more: Iterable[Path] = ()) -> str:
        """Return the absolute path of an input; a URL, or none, as it is. InputError where no place has its content."""
        if not path or is_url(path):
            return path
        found = self.find(path, sha, size, more) if sha else self.located(path)
        if found is None:
            there = self.located(path)
            now = f"is not the file that {self.folder} was made of" if os.path.lexists(there) else "is gone"
            raise InputError(
                f"{there}: {now}, and no file of its name in {self.folder} or beside it has its content; put it back, "
                "or run the adjustment again"
            )
        return str(found)

    def located(self, path: str) -> Path:
        """Return where a file would be whatever its content."""
        places = self.seen(path)
        return next((place for place in places if os.path.lexists(place)), places[0])


def portable(path: str, folder: Path) -> str:
    """Return a path relative to a run folder, with slashes, as its files hold it; a URL, or none, as it is."""
    if not path or is_url(path):
        return path
    try:
        return Path(os.path.relpath(Path(path).absolute(), folder.absolute())).as_posix()
    except ValueError:  # on another drive
        return path


# --- the state of a folder --------------------------------------------------------------------------------


def json_of_stamps(stamps: Mapping[str, Stamp]) -> dict[str, Any]:
    """Return stamps as `Sealed` reads them."""
    return {path: astuple(stamp) for path, stamp in stamps.items() if stamp.size > READ_WHOLE}


def content_hash(path: Path) -> str | None:
    """Return the sha256 of a regular file, no link; None for anything else, OSError where it cannot be read."""
    if not stat.S_ISREG(path.lstat().st_mode):
        return None
    with open(os.open(path, os.O_RDONLY | CAREFUL), "rb") as file:  # noqa: PTH123  (no link)
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest(path: Path) -> str | None:
    """Hash as `content_hash`; None also where there is nothing, or it cannot be read. No FIFO is waited for."""
    try:
        return content_hash(path)
    except (OSError, ValueError):
        return None


def read_state(folder: Path) -> dict[str, Any]:
    """Read state.json; nothing where it is missing, damaged, too large or no regular file."""
    try:
        state = json.loads(_bounded_text(folder / STATE / STATE_FILE))
    except (ValueError, RecursionError):
        return {}
    return state if isinstance(state, dict) else {}


def noted_outputs(folder: Path) -> dict[str, str]:
    """Return the sha256 of every output as the commands in a folder noted it; none where its state was deleted.

    Of two contents (a killed run's) it is that of the one there.
    """
    listed = read_state(folder).get("outputs")
    known: dict[str, dict[str, None]] = {}
    pairs: list[Any] = list(listed.items()) if isinstance(listed, dict) else []
    for line in _bounded_text(folder / STATE / NOTES).split("\n"):
        with suppress(ValueError, RecursionError):  # the last line of a run that was killed
            pairs.append(json.loads(line))
    for pair in pairs:
        if isinstance(pair, (list, tuple)) and [type(part) for part in pair] == [str, str]:
            known.setdefault(pair[0], {})[pair[1]] = None
    own = {}
    for name, contents in known.items():
        found = digest(folder / name) if len(contents) > 1 else None
        own[name] = found if found in contents else next(iter(contents))
    return own


def _bounded_text(path: Path) -> str:
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > MAX_XML:
            return ""
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
