"""The one door to the terminal: whatever names, files and errors hold, no control character leaves it."""

from __future__ import annotations

import logging
from typing import Any

import click

from barpc.errors import visible

EXIT_GATE = 3
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_REASONS = 5  # in the line that says why a run does not pass

as_json = click.option("--json", "as_json", is_flag=True, help="JSON on stdout.")


def echo(text: object = "", *, err: bool = False, nl: bool = True, **style: Any) -> None:
    """Print lines, with everything that does not print escaped; `style` as `click.style` has it."""
    click.secho(visible(str(text)), err=err, nl=nl, **style)


def say(message: str) -> None:
    """One line on stderr, of this command."""
    echo(f"barpc: {' '.join(message.split())}", err=True)


def tell_gate(headline: str, reasons: list[str]) -> int:
    """Say why a command that finished does not pass; its exit code."""
    more = [f"and {len(reasons) - _REASONS} more"] if len(reasons) > _REASONS else []
    say(" ".join([f"exit code {EXIT_GATE}:", headline, *reasons[:_REASONS], *more]))
    return EXIT_GATE


class Formatter(logging.Formatter):
    """Records of the log as single lines; only a traceback has more."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The line of a record."""
        return visible(super().formatMessage(record).replace("\n", " "))

    def formatException(self, ei: Any) -> str:
        """A traceback."""
        return visible(super().formatException(ei))
