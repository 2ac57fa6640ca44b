"""The command line: parse, call, print. No mathematics, no file formats.

One module a verb, each with a click command named `command`, loaded only when it is used: `barpc --help`
imports click and nothing else of weight.
"""

from __future__ import annotations

from barpc.cli.main import main

__all__ = ["main"]
