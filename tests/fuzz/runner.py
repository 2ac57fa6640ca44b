"""One damaged file to its reader: a value, or one error of barpc in one printable line that names the file."""

from __future__ import annotations

import re
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

from barpc.base.errors import BarpcError

from .ends import mutate_ends
from .mutate import mutate_bytes
from .samples import SAMPLES
from .used import not_finite

LONGEST = 10.0
"""No file of a sample's size takes so many CPU seconds."""


PYTHON = re.compile(
    r"\b[A-Z][a-z]+\w*(?:Error|Exception)\b|could not convert|invalid literal for|to unpack|NoneType|Traceback"
    r"|object (?:is|has|of|cannot|does)|(?:list|tuple|string) index|index \S+ is out|not subscriptable|has no attribute"
    r"|must be (?:an? )?(?:str|real|int|bytes|list|tuple|dict)\b|indices must|codec can't|arguments|argument \d"
    r"|cannot (?:reshape|cast|be interpreted|convert)|could not broadcast|requires a buffer|buffer (?:is|size)"
    r"|unsupported operand|inhomogeneous|\(char \d+\)"
)
"""What Python and numpy say of their own, which tells no user what to do."""


class Unexpected(AssertionError):
    """A reader did what none may."""


def check(kind: str, data: bytes, folder: Path) -> bool:
    """Whether the reader takes the bytes.

    `folder` is a place of the kind's own, as `prepared` makes it.
    """
    sample = SAMPLES[kind]
    path = folder / sample.name
    path.write_bytes(data)
    began = time.process_time()
    refused: BaseException | None = None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = sample.read(path)
        if (odd := not_finite(value)) is not None:
            raise AssertionError(f"accepted with {odd}")
    except BarpcError as error:
        refused = error
    except Exception as error:
        raise Unexpected(f"{kind}: {error!r}") from error
    if time.process_time() - began > LONGEST:
        raise Unexpected(f"{kind}: {time.process_time() - began:.0f} CPU s for {len(data)} bytes")
    if refused is not None and (not _is_one_line(str(refused), path) or PYTHON.search(str(refused))):
        raise Unexpected(f"{kind}: says {str(refused)!r}")
    return refused is None


def _is_one_line(message: str, path: Path) -> bool:
    return message.isprintable() and len(message) < 2000 and (path.name in message or path.stem in message)


def prepared(kind: str, place: str) -> Path:
    """A folder for the files of a kind."""
    folder = Path(place) / kind.replace(" ", "_")
    folder.mkdir(exist_ok=True)
    SAMPLES[kind].beside(folder)
    return folder


def scratch() -> tempfile.TemporaryDirectory[str]:
    """A folder in memory where there is one: a million files are written."""
    shm = Path("/dev/shm")
    return tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None)


def sweep(kind: str, runs: int, seed: int, found: dict[str, bytes] | None = None) -> int:
    """So many damaged files of a kind: a quarter in bytes, a quarter at the ends of numbers, the others in their
    structure; how many were accepted.

    Parameters
    ----------
    kind : str
        A row of `SAMPLES`.
    runs, seed : int
        How many, and where the damage starts from.
    found : dict, optional
        Gathers what was unexpected, with a file that shows it, where given; raised otherwise.
    """
    rng = np.random.default_rng([seed, *kind.encode()])
    data, mutations, accepted = SAMPLES[kind].data(), SAMPLES[kind].mutations, 0
    with scratch() as place:
        folder = prepared(kind, place)
        for k in range(runs):
            general = (mutate_bytes, mutate_ends)
            by_structure = mutations and k % 4 > 1
            mutate = mutations[int(rng.integers(len(mutations)))] if by_structure else general[k % 2]
            mutant = mutate(data, rng)
            try:
                accepted += check(kind, mutant, folder)
            except Unexpected as error:
                if found is None:
                    raise
                found.setdefault(_place(error), mutant)
    return accepted


def _place(error: Unexpected) -> str:
    """Where in barpc it happened."""
    trace = error.__cause__.__traceback__ if error.__cause__ else None
    where = ""
    while trace is not None:
        code = trace.tb_frame.f_code
        if "barpc/" in code.co_filename.replace("\\", "/") and "/tests/" not in code.co_filename:
            where = f"{code.co_filename.rpartition('barpc/')[2]}:{trace.tb_lineno}"
        trace = trace.tb_next
    return f"{where} {str(error)[:220]}" if where else str(error)[:220]
