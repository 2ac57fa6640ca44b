"""The run folder: outputs that appear whole, stage results kept for resuming, one run at a time. Nothing is pickled.

::

    OUT/                     what the user asked for
    OUT/SHA256SUMS           written last: every output by its sha256 (`barpc.base.manifest`)
    OUT/.barpc/state.json    status, stages with seconds and peak memory, the outputs with their sha256
    OUT/.barpc/outputs.jsonl the same of the outputs of a run at work
    OUT/.barpc/lock          held while a run is at work
    OUT/.barpc/partial/      files on their way; emptied at the next start
    OUT/.barpc/cache/<stage>/<key>.npz   results of tasks (`barpc.base.tasks.Store`)

Resuming is running the same command again. A run notes the sha256 of an output before the output takes its name: only
a file with a noted content is ever replaced or taken away. The notes may be anybody's: a name counts only for a regular
file inside the folder, reached through no symbolic link, and a folder below with a run of its own is that run's.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import filelock
import numpy as np

from barpc import __version__
from barpc.base import manifest
from barpc.base.atomic import PARTIAL, STATE, replacing
from barpc.base.errors import BarpcError, InputError, OutputError
from barpc.base.fields import field_values, is_record
from barpc.base.identity import Stamp
from barpc.base.manifest import LAST, SUMS
from barpc.base.process import give_back, peak_memory
from barpc.base.sealed import (
    CAREFUL,
    NOTES,
    STATE_FILE,
    content_hash,
    digest,
    json_of_stamps,
    noted_outputs,
    read_state,
)
from barpc.base.tasks import Store

logger = logging.getLogger(__name__)

LOCK, CACHE = "lock", "cache"
_FILES = (STATE_FILE, NOTES, LOCK)

SIDECAR_ENDS = ".rpb", ".xml", ".txt", ".rpc", ".geom"
"""How names of files end that `barpc.rpcio` reads beside an image."""
KEEP_AFTER = 30.0
"""A run that is refused within so many seconds leaves nothing; after that its stages are kept."""


@cache
def code_version() -> str:
    """Return a hash of the release and of every source file: another code never reads this code's caches."""
    digest = hashlib.sha256(__version__.encode())
    root = Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def key_of(*parts: object) -> str:
    """Return the key of a stage, 32 hexadecimal digits: a hash of its inputs and options, and of the code.

    Parts are strings, numbers, None, sequences, mappings, dataclasses, arrays, paths.
    """
    text = json.dumps([code_version(), *parts], default=_key_form, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _key_form(value: object) -> object:
    if is_record(value):
        return {"type": type(value).__name__, **field_values(value)}
    if isinstance(value, np.ndarray):
        return [str(value.dtype), list(value.shape), hashlib.sha256(value.tobytes()).hexdigest()]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (Path, frozenset, set)):
        return str(value) if isinstance(value, Path) else sorted(value)
    raise TypeError(f"a {type(value).__name__} cannot be part of a stage's key")


@contextmanager
def timed(name: str, stages: list[dict[str, Any]]) -> Iterator[list[float]]:
    """Time a stage; its seconds and the peak memory so far go to the log and to `stages`.

    CPU seconds are those of this process and what is put into the list that it gives: those of workers.
    """
    start, cpu = time.perf_counter(), time.process_time()
    logger.info("%s ...", name)
    workers: list[float] = []
    yield workers
    give_back()
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu + sum(workers)
    memory = peak_memory() / 1e6
    rounded = {"seconds": round(seconds, 3), "cpu_seconds": round(cpu, 3), "peak_memory_mb": round(memory, 1)}
    stages.append({"stage": name, **rounded})
    logger.info("%s: %.2f s, peak memory %.0f MB", name, seconds, memory)


class Workspace:
    """A run folder, held by one run at a time.

    Parameters
    ----------
    folder : str or Path, that of an unfinished run is gone on with; another that is not empty needs `overwrite`
    overwrite : bool, replace what an earlier run wrote here and nobody has changed since; never anything else
    keep : iterable of Path, files that must never be written: the inputs
    names : iterable of str, the outputs to come, if known: what is in their way is refused before any work, and they
        where an image in the folder would be read with another RPC because of them
    adds : bool, other things may be in the folder: what earlier runs wrote stays theirs, free names are written

    Raises
    ------
    OutputError
        The folder is not empty, holds a file that is in the way or an image whose RPC would be hidden, is in use by
        another run, or cannot be written.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        overwrite: bool = False,
        keep: Iterable[Path] = (),
        names: Iterable[str] = (),
        adds: bool = False,
    ) -> None:
        self.folder = Path(folder).absolute()
        own = self.folder / STATE
        self.cache, self.partial = own / CACHE, own / PARTIAL
        self.store = Store(str(self.cache), str(self.partial))
        self._keep = frozenset(path.resolve() for path in keep)
        self._adds = adds
        self.outputs: dict[str, str] = {}
        self._stamps: dict[str, Any] = {}  # of outputs and inputs, by their paths from the folder
        self._noted = False  # whether an output was on its way to its name
        self.stages: list[dict[str, Any]] = []
        self.worker_seconds = 0.0  # of CPU, spent for this run in other processes
        self._check_free(overwrite, names)
        self._start = time.perf_counter()
        self._made = [p for p in (own, self.folder, *self.folder.parents) if not p.exists()]
        try:
            self.cache.mkdir(parents=True, exist_ok=True)
            self._lock = filelock.FileLock(own / LOCK, timeout=0)
            self._lock.acquire()
        except filelock.Timeout:
            raise OutputError(f"{self.folder}: another run is at work in it; wait, or choose another -o") from None
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written ({error.strerror or error})") from error
        shutil.rmtree(self.partial, ignore_errors=True)  # of a run that was killed
        self._earlier = noted_outputs(self.folder)  # again: another run may have ended in between
        # what is added to a finished run, or fails to be, leaves it finished: nothing else may replace its files
        before = read_state(self.folder) if adds else {}
        self._finished = before.get("status") == "done"
        self._home = str(before.get("folder", self.folder))
        stamps = before.get("stamps")
        self._stamps |= stamps if isinstance(stamps, dict) else {}
        stages = before.get("stages")
        self._before: list[Any] = stages if isinstance(stages, list) else []
        try:
            self._save_state("running")
        except BaseException:  # a full disk
            self._discard()
            self._lock.release()
            raise

    @classmethod
    def require_free(cls, folder: str | Path, overwrite: bool, keep: Iterable[Path], names: Iterable[str]) -> None:
        """Raise OutputError where a run cannot begin in a folder; nothing is made or written."""
        self = cls.__new__(cls)
        self.folder, self._adds = Path(folder).absolute(), False
        self._keep = frozenset(path.resolve() for path in keep)
        self._check_free(overwrite, names)

    def _check_free(self, overwrite: bool, names: Iterable[str]) -> None:
        if self.folder.exists() and not self.folder.is_dir():
            raise OutputError(f"{self.folder}: is a file; give -o a folder")
        _refuse_odd(self.folder)
        present = {path.name for path in self.folder.iterdir()} if self.folder.is_dir() else set()
        status = read_state(self.folder).get("status")
        # without a state: nothing but our own folder is left by a run that was killed in its first moment
        unfinished = status in ("running", "failed") or (status is None and present <= {STATE})
        self._may_replace = overwrite or unfinished
        self._earlier, self._named = noted_outputs(self.folder), set(names)
        self._refuse_hiding(self._named)
        if present and not self._adds and not self._may_replace:
            raise OutputError(f"{self.folder}: exists and is not empty; give --overwrite or another -o")
        for name in self._named:
            self._refuse_foreign(name)

    def _refuse_hiding(self, names: Iterable[str]) -> None:
        """Raise if a file to be written would be read in place of the RPC of an image that is there.

        For the inputs it does not matter whether barpc wrote such a file before.
        """
        if not any(name.lower().endswith(SIDECAR_ENDS) for name in names):
            return
        from barpc.rpcio import hidden_by  # with GDAL

        for path, image, _ in hidden_by(self.folder / name for name in names):
            known = "the input " * (image.resolve() in self._keep)
            if known or not (self.owns(image.name) or os.path.lexists(path)):
                raise OutputError(f"{path}: would be read in place of the RPC of {known}{image}; give another -o")

    def _refuse_foreign(self, name: str) -> None:
        path = self.folder / name
        if path.resolve() in self._keep:
            raise OutputError(f"{path}: is an input and is never written; give another -o")
        if path.parent != self.folder and (path.parent.is_symlink() or path.parent.is_file()):
            raise OutputError(f"{path.parent}: is no folder of barpc's own; move it away, or give another -o")
        if not os.path.lexists(path):
            return
        if not self._may_replace:
            raise OutputError(f"{path}: exists already; give --overwrite or another -o")
        if not self.owns(name):
            raise OutputError(
                f"{path}: not written by a run in this folder, or changed since, so it is not replaced; move it "
                "away, or give another -o"
            )

    def owns(self, name: str) -> bool:
        """Return whether a run in this folder wrote this file, and nobody has changed it since."""
        known = self._earlier | self.outputs
        return name in known and _owns(self.folder, name, known[name])

    def __enter__(self) -> Workspace:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        try:
            self._end("done" if error is None else "failed")
        finally:
            if isinstance(error, BarpcError) and time.perf_counter() - self._start < KEEP_AFTER:
                self._discard()
            self._lock.release()

    def _end(self, status: str) -> None:
        """Save the last state; of a run that failed, even here, the same command goes on: it has no summary."""
        try:
            if status == "done" and self._adds and self.outputs:
                self._add_layer()
            elif status == "failed" and LAST in self.outputs:
                with suppress(OSError):
                    (self.folder / LAST).unlink(missing_ok=True)
            self._save_state(status)
        except BarpcError:
            if status == "done":  # it may say so, and only the disk was not told
                with suppress(BarpcError):
                    self._end("failed")
            raise

    def _discard(self) -> None:
        """Take away what this run made, where it was refused before it made anything worth keeping."""
        if self._noted or self.folder / STATE not in self._made:  # an output may have its name, whatever came then
            return
        shutil.rmtree(self.folder / STATE, ignore_errors=True)
        for made in self._made[1:]:  # innermost first; only what this run made, and only when empty
            try:
                made.rmdir()
            except OSError:
                return

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage (see `timed`); state.json has it, too."""
        before = self.worker_seconds
        with timed(name, self.stages) as workers:
            yield
            workers.append(self.worker_seconds - before)
        self._save_state("running")

    @contextmanager
    def output(self, name: str) -> Iterator[Path]:
        """Yield a temporary path for an output of the folder, which takes its name when the block ends well.

        OutputError where it would replace an input or a file that is not barpc's own, or cannot be written.
        """
        with replacing(self.folder / name, overwrite=True, room=self.partial) as partial:
            yield partial
            self._refuse_foreign(name)
            if name not in self._named:
                self._refuse_hiding([name])
            sha = content_hash(partial)
            if sha is None:
                raise OutputError(f"{self.folder / name}: cannot be written (it is no regular file)")
            _append_record(self.folder, name, sha)
            self._noted = True
        self.outputs[name] = sha
        self.note({name: Stamp.of((self.folder / name).lstat())})

    def note(self, stamps: Mapping[str, Stamp]) -> None:
        """Note the stamps of files, by their paths from the folder, which need not be hashed while they have them."""
        self._stamps |= json_of_stamps(stamps)

    def write_text(self, name: str, text: str) -> Path:
        """Write a text output whole."""
        with self.output(name) as partial:
            partial.write_bytes(text.encode())
        return self.folder / name

    def seal(self, after: str = "", links: Mapping[str, str] | None = None) -> str:
        """Write SHA256SUMS of all outputs and return their root.

        `after`: the root of the run that they were made from; `links`: to inputs, with the SHA-256 of these.
        """
        files = self.outputs | dict(links or {})
        first = manifest.Layer(manifest.head(__version__, code_version(), after), files)
        self.write_text(SUMS, manifest.render([first]))
        return self.outputs[SUMS]

    def _add_layer(self) -> None:
        """Add what is new to the SHA256SUMS of a finished run; one that somebody changed stays, for `verify` to see."""
        try:
            root, layers = manifest.read(self.folder)
        except InputError:
            return
        known = {name: sha for layer in layers for name, sha in layer.files.items()}
        new = dict(self.outputs.items() - known.items())
        if new and self._earlier.setdefault(SUMS, root) == root:
            self._may_replace = True
            layers.append(manifest.Layer(manifest.head(__version__, code_version(), root), new))
            self.write_text(SUMS, manifest.render(layers))

    def remove_stale(self) -> None:
        """Take away what an earlier run wrote here, nobody has changed, and this run did not write."""
        for name in self._earlier.keys() - self.outputs.keys():
            if self.owns(name) and (self.folder / name).resolve() not in self._keep:
                (self.folder / name).unlink()

    def _save_state(self, status: str) -> None:
        """Write state.json with all that is known of the outputs: the notes of single ones have done.

        Not where a run failed: an output may have its name, and the run no word that it has.
        """
        earlier = {} if status == "done" and not self._adds else self._earlier
        outputs = dict(sorted((earlier | self.outputs).items()))
        told = "done" if self._finished else status
        stages = [*self._before, *self.stages]
        state = {"barpc": __version__, "status": told, "folder": self._home, "stages": stages, "outputs": outputs}
        state["stamps"] = self._stamps
        with replacing(self.folder / STATE / STATE_FILE, overwrite=True, room=self.partial) as partial:
            partial.write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")
        if status != "failed":
            (self.folder / STATE / NOTES).unlink(missing_ok=True)


# --- which files are barpc's own --------------------------------------------------------------------------


def _owns(folder: Path, name: str, sha: str) -> bool:
    """Return whether the file of this name has this content, and is this folder's own."""
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


def own_files(folder: Path) -> set[str]:
    """Return the names of barpc's own files that are in a folder, as it wrote them."""
    return {name for name, sha in noted_outputs(folder).items() if _owns(folder, name, sha)}


def _append_record(folder: Path, name: str, sha: str) -> None:
    path = folder / STATE / NOTES
    line = "\n" + json.dumps([name, sha]) + "\n"  # on a line of its own, whatever a killed run left
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | CAREFUL, 0o666)
        with open(descriptor, "ab") as file:  # noqa: PTH123  (no link)
            file.write(line.encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


def _refuse_odd(folder: Path) -> None:
    """Raise where something else stands in the place of barpc's own files: a link, a FIFO, a user's file."""
    own = folder / STATE
    try:
        stages = sorted((own / CACHE).iterdir())
    except OSError:
        stages = []
    for path in (own, own / PARTIAL, own / CACHE, *stages, *(own / name for name in _FILES)):
        try:
            found = path.lstat()
        except OSError:  # not there; where it cannot be reached, it cannot be written either
            continue
        if _is_odd(path, found):
            raise OutputError(f"{path}: cannot be written: it is not barpc's own; move {own} away, or give another -o")


def _is_odd(path: Path, found: os.stat_result) -> bool:
    if path.name not in _FILES:
        return stat.S_ISLNK(found.st_mode) if path.parent.name == CACHE else not stat.S_ISDIR(found.st_mode)
    # these are written to as they stand, and old releases of filelock empty what they open
    shared = path.name in (LOCK, NOTES) and found.st_nlink > 1
    return not stat.S_ISREG(found.st_mode) or shared or (path.name == LOCK and found.st_size > 0)
