"""The run folder: outputs that appear whole, stage results kept for resuming, one run at a time.

::

    OUT/                     what the user asked for
    OUT/.barpc/state.json    status, stages with seconds and peak memory, the files this run wrote
    OUT/.barpc/lock          held while a run is at work
    OUT/.barpc/cache/<stage>/<key>.npz   results of tasks; a damaged one is made again

The key of a stage is a hash of its inputs, its options and the code; resuming is running the same
command again. Nothing is ever pickled.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

import filelock
import numpy as np
import numpy.typing as npt

from barpc import __version__
from barpc.atomic import remove_leftovers, replacing, write_text
from barpc.errors import BarpcError, OutputError
from barpc.record import Record, load_npz

logger = logging.getLogger(__name__)

STATE = ".barpc"
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


def _is_name(name: str) -> bool:
    """Whether a system takes it for a path at all."""
    try:
        Path(name).stat()
    except (ValueError, OSError) as error:
        return getattr(error, "errno", None) in (errno.ENOENT, errno.ENOTDIR)
    return True


class Workspace:
    """A run folder, held by one run at a time.

    Parameters
    ----------
    folder : str or Path
        Where results go. A folder of an unfinished run is gone on with; any other that is not empty
        needs `overwrite`.
    overwrite : bool
        Replace the results of an earlier run (files that barpc did not write are left alone).
    keep : frozenset of Path
        Files that must never be written: the inputs.

    Raises
    ------
    OutputError
        The folder exists and is not empty, is in use by another run, or cannot be written.
    """

    def __init__(
        self, folder: str | Path, *, overwrite: bool = False, keep: frozenset[Path] = frozenset()
    ) -> None:
        self.folder = Path(folder).absolute()
        self._keep = frozenset(path.resolve() for path in keep)
        self._check_free(overwrite)
        self._start = time.perf_counter()
        self._made = [p for p in (self.folder, *self.folder.parents) if not p.exists()]
        try:
            (self.folder / STATE / "cache").mkdir(parents=True, exist_ok=True)
            self._lock = filelock.FileLock(self.folder / STATE / "lock", timeout=0)
            self._lock.acquire()
        except filelock.Timeout:
            raise OutputError(
                f"{self.folder}: another run is at work in it; wait, or choose another -o"
            ) from None
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written ({error.strerror or error})") from error
        self._clean()
        self.earlier_outputs = self._read_outputs()
        self.outputs: list[str] = []
        self.stages: list[dict[str, Any]] = []
        self._save_state("running")

    def _check_free(self, overwrite: bool) -> None:
        if self.folder.exists() and not self.folder.is_dir():
            raise OutputError(f"{self.folder}: is a file; give -o a folder")
        names = {path.name for path in self.folder.iterdir()} if self.folder.is_dir() else set()
        status = self._read_state().get("status")
        # without a state: nothing but our own folder is left by a run that was killed in its first moment
        unfinished = status in ("running", "failed") or (status is None and names <= {STATE})
        if names and not overwrite and not unfinished:
            raise OutputError(f"{self.folder}: exists and is not empty; give --overwrite or another -o")

    def __enter__(self) -> Workspace:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        refused = kind is not None and issubclass(kind, BarpcError)
        try:
            self._save_state("done" if kind is None else "failed")
        finally:
            self._lock.release()
            if refused and time.perf_counter() - self._start < KEEP_AFTER:
                self._discard()

    def _discard(self) -> None:
        """Take the folder away again, for a run that was refused before it made anything worth keeping."""
        if self.outputs or self.earlier_outputs:
            return
        shutil.rmtree(self.folder / STATE, ignore_errors=True)
        for made in self._made:  # innermost first; only what this run made, and only when empty
            try:
                made.rmdir()
            except OSError:
                return

    # -- stages ------------------------------------------------------------------------------------

    def cached(self, stage: str, key: str, make: Callable[[], Record]) -> Record:
        """The result of a stage: read back when it is there, made and kept otherwise.

        Parameters
        ----------
        stage : str
            Its name; a folder in the cache.
        key : str
            From `key_of`.
        make : callable
            Makes the result: a mapping of names to arrays.

        Returns
        -------
        record : dict of str to ndarray
        """
        record = self.load(stage, key)
        if record is None:
            record = make()
            self.store(stage, key, record)
        return record

    def load(self, stage: str, key: str) -> Record | None:
        """A kept result, or None; one that is damaged is taken away and counts as missing."""
        path = self._cache_path(stage, key)
        if not path.exists():
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
        with replacing(path, overwrite=True, durable=False) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **{k: np.asarray(v) for k, v in record.items()})

    @property
    def cache(self) -> Path:
        """Where results are kept."""
        return self.folder / STATE / "cache"

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
            It would replace an input, or cannot be written.
        """
        path = self.folder / name
        if path.resolve() in self._keep:
            raise OutputError(f"{path}: is an input and is never written; give another -o")
        with replacing(path, overwrite=True) as partial:
            yield partial
        self.outputs.append(name)
        self._save_state("running")

    def write_text(self, name: str, text: str) -> Path:
        """Write a text output whole."""
        with self.output(name) as partial:
            partial.write_bytes(text.encode())
        return self.folder / name

    def remove_stale(self) -> None:
        """Take away what an earlier run wrote here and this one did not."""
        for name in self.earlier_outputs:
            path = self.folder / name
            if name not in self.outputs and path.is_file() and path.resolve() not in self._keep:
                path.unlink()

    # -- state -------------------------------------------------------------------------------------

    def _read_state(self) -> dict[str, Any]:
        try:
            state = json.loads((self.folder / STATE / "state.json").read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return {}
        return state if isinstance(state, dict) else {}

    def _read_outputs(self) -> list[str]:
        """What an earlier run says it wrote; never a place outside the folder, whatever the file says."""
        named = self._read_state().get("outputs", [])
        names = [n for n in named if isinstance(n, str) and _is_name(n)] if isinstance(named, list) else []
        below = self.folder.resolve()
        return [name for name in names if (self.folder / name).resolve().parent.is_relative_to(below)]

    def _save_state(self, status: str) -> None:
        outputs = sorted({*self.outputs, *(self.earlier_outputs if status != "done" else ())})
        state = {"barpc": __version__, "status": status, "stages": self.stages, "outputs": outputs}
        write_text(self.folder / STATE / "state.json", json.dumps(state, indent=1) + "\n", overwrite=True)

    def _clean(self) -> None:
        """Leftovers of a run that was killed."""
        below = (p for p in self.folder.rglob("*") if p.is_dir() and not p.is_symlink())
        for folder in [self.folder, *below]:
            remove_leftovers(folder)
