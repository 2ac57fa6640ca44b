"""The command line: parse, call, print. No mathematics, no file formats.

The click command of a verb has its name, in a module that is loaded only when it is used: `barpc --help` imports
click and nothing else of weight.
"""

from __future__ import annotations

from barpc.cli.main import main

__all__ = ["main"]
