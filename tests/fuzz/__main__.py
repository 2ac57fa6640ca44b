"""Fuzz all readers.

::

    python -m tests.fuzz 100000                                 # damaged samples, one process
    pip install atheris
    python -m tests.fuzz --atheris CORPUS -atheris_runs=1000000 -max_len=6000

Atheris watches which lines are reached; its corpus is filled with the samples first,
and a first byte chooses the reader.
"""

from __future__ import annotations

import argparse
import faulthandler
import logging
import resource
import sys
import time
from pathlib import Path


def _with_atheris() -> None:
    import atheris

    with atheris.instrument_imports(include=["barpc"]):  # the first import of what is to be watched
        from .runner import check, prepared, scratch
        from .samples import SAMPLES
    argv = [arg for arg in sys.argv if arg != "--atheris"]
    kinds, place = list(SAMPLES), scratch()
    folders = {kind: prepared(kind, place.name) for kind in kinds}
    if len(argv) > 1 and not argv[1].startswith("-"):
        corpus = Path(argv[1])
        corpus.mkdir(parents=True, exist_ok=True)
        for number, kind in enumerate(kinds):
            (corpus / kind.replace(" ", "_")).write_bytes(bytes([number]) + SAMPLES[kind].data())

    def one(data: bytes) -> None:
        if data:
            kind = kinds[data[0] % len(kinds)]
            check(kind, data[1:], folders[kind])

    atheris.Setup(argv, one)
    atheris.Fuzz()


def main() -> int:
    """Parse, run, print what was found; 1 where anything was."""
    if "--atheris" in sys.argv:
        _with_atheris()
        return 0
    from .runner import sweep
    from .samples import SAMPLES

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=int, nargs="?", default=100_000, help="in all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="kinds with this in their name")
    parser.add_argument("--keep", type=Path, help="a folder for the files that show what was found")
    given = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (6 << 30, 6 << 30))  # a bomb fails instead of filling the machine
    faulthandler.enable()  # what ends the process in C says where
    logging.disable()  # what an adjustment warns of
    kinds = [kind for kind in SAMPLES if given.only in kind]
    total, began, places = 0, time.process_time(), 0
    shares = sum(SAMPLES[kind].share for kind in kinds)
    for kind in kinds:
        found: dict[str, bytes] = {}
        each, start = -int(-given.runs * SAMPLES[kind].share // shares), time.process_time()
        accepted = sweep(kind, each, given.seed, found)
        seconds = time.process_time() - start
        print(f"{kind:18} {each:7} runs, {accepted:7} accepted, {seconds:6.1f} CPU s", flush=True)
        for number, (place, data) in enumerate(found.items()):
            print(f"    {place}", flush=True)
            if given.keep:
                given.keep.mkdir(parents=True, exist_ok=True)
                (given.keep / f"{kind.replace(' ', '_')}_{number}").write_bytes(data)
        total, places = total + each, places + len(found)
    seconds = time.process_time() - began
    print(f"{total} runs over {len(kinds)} kinds of file, {places} unexpected, {seconds:.0f} CPU s")
    return 1 if places else 0


if __name__ == "__main__":
    sys.exit(main())
