"""The run folder: outputs that appear whole, stage results kept for resuming, one run at a time.

::

    OUT/                     what the user asked for
    OUT/.barpc/state.json    status, stages with seconds and peak memory, the outputs with their sha256
    OUT/.barpc/outputs.jsonl the same of the outputs of a run at work (see `barpc.owned`)
    OUT/.barpc/lock          held while a run is at work
    OUT/.barpc/partial/      files on their way; emptied at the next start
    OUT/.barpc/cache/<stage>/<key>.npz   results of tasks; a damaged one is made again

The key of a stage is a hash of its inputs, its options and the code; resuming is running the same
command again. Nothing is ever pickled.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

import filelock
import numpy as np
import numpy.typing as npt

from barpc import __version__, owned
from barpc.atomic import replacing
from barpc.errors import BarpcError, OutputError
from barpc.owned import STATE
from barpc.record import Record, load_npz

logger = logging.getLogger(__name__)

KEEP_AFTER = 30.0
"""A run that is refused within so many seconds leaves nothing; after that its stages are kept."""

_WHOLE_FILE = 64 << 20  # bytes: larger inputs are sampled for their fingerprint
_SAMPLE = 1 << 20


@cache
def code_version() -> str:
    """A hash of the release and of every source file: another code never reads this code's caches."""
    digest = hashlib.sha256(__version__.encode())
    root = Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def fingerprint(path: str | Path) -> str:
    """A hash of a file's content; of files above 64 MiB 64 samples, the size and the time of change."""
    path = Path(path)
    stat = path.stat()
    digest = hashlib.sha256(str(stat.st_size).encode())
    with path.open("rb") as file:
        if stat.st_size <= _WHOLE_FILE:
            while block := file.read(_SAMPLE):
                digest.update(block)
        else:
            digest.update(str(stat.st_mtime_ns).encode())
            for start in np.linspace(0, stat.st_size - _SAMPLE, 64).astype(np.int64):
                file.seek(int(start))
                digest.update(file.read(_SAMPLE))
    return digest.hexdigest()


def key_of(*parts: object) -> str:
    """The key of a stage: a hash of its inputs and options, and of the code.

    Parameters
    ----------
    *parts : object
        Strings, numbers, None, sequences, mappings, dataclasses, arrays, paths.

    Returns
    -------
    key : str
        32 hexadecimal digits.
    """
    text = json.dumps([code_version(), *parts], default=_plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _plain(value: object) -> object:
    if is_dataclass(value) and not isinstance(value, type):
        kept = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
        return {"type": type(value).__name__, **kept}
    if isinstance(value, np.ndarray):
        return [str(value.dtype), list(value.shape), hashlib.sha256(value.tobytes()).hexdigest()]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (Path, frozenset, set)):
        return str(value) if isinstance(value, Path) else sorted(value)
    raise TypeError(f"a {type(value).__name__} cannot be part of a stage's key")


def peak_memory() -> int:
    """Peak resident memory [bytes] of this process and its children so far; 0 where unknown."""
    try:
        import resource
    except ImportError:  # not on Windows
        return 0
    scale = 1 if os.uname().sysname == "Darwin" else 1024
    usage = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return max(resource.getrusage(who).ru_maxrss for who in usage) * scale


class Workspace:
    """A run folder, held by one run at a time.

    Parameters
    ----------
    folder : str or Path
        Where results go. A folder of an unfinished run is gone on with; any other that is not empty
        needs `overwrite`.
    overwrite : bool
        Replace what an earlier run wrote here and nobody has changed since; never anything else.
    keep : frozenset of Path
        Files that must never be written: the inputs.
    names : iterable of str
        The outputs to come, as far as they are known: what is in their way is refused before any work.
    adds : bool
        Other things may be in the folder: what earlier runs wrote stays theirs, names that are free are
        written.

    Raises
    ------
    OutputError
        The folder exists and is not empty, holds a file that is in the way, is in use by another run, or
        cannot be written.
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
        self._keep = frozenset(path.resolve() for path in keep)
        self._adds = adds
        self.outputs: dict[str, str] = {}
        self.stages: list[dict[str, Any]] = []
        self._check_free(overwrite, names)
        self._start = time.perf_counter()
        own = self.folder / STATE
        self._made = [p for p in (own, self.folder, *self.folder.parents) if not p.exists()]
        try:
            self.cache.mkdir(parents=True, exist_ok=True)
            self._lock = filelock.FileLock(own / owned.LOCK, timeout=0)
            self._lock.acquire()
        except filelock.Timeout:
            raise OutputError(
                f"{self.folder}: another run is at work in it; wait, or choose another -o"
            ) from None
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written ({error.strerror or error})") from error
        shutil.rmtree(self.partial, ignore_errors=True)  # of a run that was killed
        self._earlier = owned.read_own(self.folder)  # again: another run may have ended in between
        try:
            self._save_state("running")
        except BaseException:  # a full disk
            self._discard()
            self._lock.release()
            raise

    def _check_free(self, overwrite: bool, names: Iterable[str]) -> None:
        if self.folder.exists() and not self.folder.is_dir():
            raise OutputError(f"{self.folder}: is a file; give -o a folder")
        owned.refuse_odd(self.folder)
        present = {path.name for path in self.folder.iterdir()} if self.folder.is_dir() else set()
        status = owned.read_state(self.folder).get("status")
        # without a state: nothing but our own folder is left by a run that was killed in its first moment
        unfinished = status in ("running", "failed") or (status is None and present <= {STATE})
        self._may_replace = overwrite or unfinished
        if present and not self._adds and not self._may_replace:
            raise OutputError(f"{self.folder}: exists and is not empty; give --overwrite or another -o")
        self._earlier = owned.read_own(self.folder)
        for name in names:
            self._refuse_foreign(name)

    def _refuse_foreign(self, name: str) -> None:
        """Raise if an output may not take its name."""
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
        """Whether a run in this folder wrote this file, and nobody has changed it since."""
        known = self._earlier | self.outputs
        return name in known and owned.owns(self.folder, name, known[name])

    def __enter__(self) -> Workspace:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        refused = kind is not None and issubclass(kind, BarpcError)
        try:
            self._save_state("done" if kind is None else "failed")
        finally:
            if refused and time.perf_counter() - self._start < KEEP_AFTER:
                self._discard()
            self._lock.release()

    def _discard(self) -> None:
        """Take away what this run made, where it was refused before it made anything worth keeping."""
        if self.outputs or self.folder / STATE not in self._made:
            return
        shutil.rmtree(self.folder / STATE, ignore_errors=True)
        for made in self._made[1:]:  # innermost first; only what this run made, and only when empty
            try:
                made.rmdir()
            except OSError:
                return

    # -- stages ------------------------------------------------------------------------------------

    def load(self, stage: str, key: str) -> Record | None:
        """A kept result, or None; one that is damaged is taken away and counts as missing."""
        path = self._cache_path(stage, key)
        if path.is_symlink() or not path.is_file():
            return None
        try:
            return load_npz(path)
        except (OSError, ValueError) as error:
            logger.warning("%s: a damaged cache file is made again (%s)", path, error)
            path.unlink(missing_ok=True)
            return None

    def store(self, stage: str, key: str, record: Mapping[str, npt.NDArray[Any]]) -> None:
        """Keep a result, under a temporary name until it is whole."""
        path = self._cache_path(stage, key)
        with self.keeping(path) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **{k: np.asarray(v) for k, v in record.items()})

    @property
    def cache(self) -> Path:
        """Where results are kept."""
        return self.folder / STATE / owned.CACHE

    @property
    def partial(self) -> Path:
        """Where files are written before they take their names."""
        return self.folder / STATE / owned.PARTIAL

    def keeping(self, path: Path) -> AbstractContextManager[Path]:
        """A temporary path for a file among the caches, which can be made again."""
        return replacing(path, overwrite=True, durable=False, room=self.partial)

    def _cache_path(self, stage: str, key: str) -> Path:
        return self.cache / stage / f"{key}.npz"

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; its seconds and the peak memory so far go to the log, state.json and summary."""
        start, cpu = time.perf_counter(), time.process_time()
        logger.info("%s ...", name)
        yield
        entry = {
            "stage": name,
            "seconds": round(time.perf_counter() - start, 3),
            "cpu_seconds": round(time.process_time() - cpu, 3),
            "peak_memory_mb": round(peak_memory() / 1e6, 1),
        }
        self.stages.append(entry)
        logger.info("%s: %.2f s, peak memory %.0f MB", name, entry["seconds"], entry["peak_memory_mb"])
        self._save_state("running")

    # -- outputs -----------------------------------------------------------------------------------

    @contextmanager
    def output(self, name: str) -> Iterator[Path]:
        """A temporary path to write an output to; it takes its name when the block ends well.

        Parameters
        ----------
        name : str
            Relative to the run folder.

        Raises
        ------
        OutputError
            It would replace an input or a file that is not barpc's own, or cannot be written.
        """
        with replacing(self.folder / name, overwrite=True, room=self.partial) as partial:
            yield partial
            self._refuse_foreign(name)
            sha = owned.digest(partial)
            if sha is None:
                raise OutputError(f"{self.folder / name}: cannot be written (its temporary file is gone)")
            owned.note(self.folder, name, sha)
        self.outputs[name] = sha

    def write_text(self, name: str, text: str) -> Path:
        """Write a text output whole."""
        with self.output(name) as partial:
            partial.write_bytes(text.encode())
        return self.folder / name

    def remove_stale(self) -> None:
        """Take away what an earlier run wrote here, nobody has changed, and this run did not write."""
        for name in self._earlier.keys() - self.outputs.keys():
            if self.owns(name) and (self.folder / name).resolve() not in self._keep:
                (self.folder / name).unlink()

    # -- state -------------------------------------------------------------------------------------

    def _save_state(self, status: str) -> None:
        """Write state.json with all that is known of the outputs: the notes of single ones have done."""
        earlier = {} if status == "done" and not self._adds else self._earlier
        outputs = dict(sorted((earlier | self.outputs).items()))
        state = {"barpc": __version__, "status": status, "stages": self.stages, "outputs": outputs}
        with replacing(self.folder / STATE / owned.STATE_FILE, overwrite=True, room=self.partial) as partial:
            partial.write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")
        (self.folder / STATE / owned.NOTES).unlink(missing_ok=True)
