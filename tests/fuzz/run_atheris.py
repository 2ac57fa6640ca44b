"""Fuzz the readers under atheris, which is no dependency of the tests.

::

    pip install atheris
    python -m tests.fuzz.run_atheris CORPUS_FOLDER -atheris_runs=1000000 -max_len=6000

The folder is filled with a sample of every format first; further arguments are libFuzzer's.
"""

from __future__ import annotations

import sys
from pathlib import Path


def main() -> None:
    """Write the seeds and start."""
    import atheris

    with atheris.instrument_imports(include=["barpc"]):  # the first import of what is to be watched
        from tests.fuzz.samples import SAMPLES, seed
        from tests.fuzz.targets import check_all
    if len(sys.argv) > 1 and not sys.argv[1].startswith("-"):
        folder = Path(sys.argv[1])
        folder.mkdir(parents=True, exist_ok=True)
        for name in SAMPLES:
            (folder / name.replace(" ", "_")).write_bytes(seed(name))
    atheris.Setup(sys.argv, check_all)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
