"""`python -m barpc`."""

import sys
from pathlib import Path

import barpc

# `-m` puts the current folder first, whose files may be anybody's: no module named by an option is taken from there
if not sys.flags.safe_path and Path(sys.path[0]) == Path.cwd() != Path(barpc.__file__).parents[1]:
    del sys.path[0]

from barpc.cli import main

main()
