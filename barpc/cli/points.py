"""What the verbs on points and cameras share: tables of points, and which files may be written."""

from __future__ import annotations

import csv
import json
import os
import sys
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from pathlib import Path

import click
import numpy as np

from barpc.cli.terminal import echo, say, tell_gate
from barpc.errors import InputError, OutputError
from barpc.geodesy import Array
from barpc.rpcio import FORMATS, hidden_by, sidecars
from barpc.sensor.rpc import RPC
from barpc.sidefile import TABLE, opened_text

NUMBERS = {"ignore_unknown_options": True}
"""Context settings under which -3.5 is a number, not an option."""

as_json = click.option("--json", "as_json", is_flag=True, help="JSON on stdout.")


def check_target(
    target: str | Path, sources: Sequence[str | Path], overwrite: bool, rpc: RPC | None = None
) -> None:
    """Raise if a file to be written is an input, or would be read in place of the RPC that an image has.

    Parameters
    ----------
    target : path
        The file to be written.
    sources : sequence of path
        What was given; the RPC files beside it belong to it.
    overwrite : bool
        An image may get another RPC; that is said. An input is never replaced.
    rpc : RPC, optional
        What the file will hold: where the image has the same, nothing changes for it.
    """
    target = Path(target)
    inputs = {p.resolve() for s in sources for p in (Path(s), *(sidecar.path for sidecar in sidecars(s)))}
    if os.path.lexists(target) and target.resolve() in inputs:
        raise OutputError(f"{target}: belongs to the input and is never replaced; give another name")
    text = FORMATS["txt"].write
    assert text is not None
    for _, image, now in hidden_by([target]):
        if rpc is not None and text(rpc) == text(now):
            continue
        if not overwrite:
            raise OutputError(
                f"{target}: would be read in place of the RPC that {image} has; give another folder or name, or "
                "--overwrite if that is meant"
            )
        say(f"{target} is read in place of the RPC that {image} had")


def read_points(
    numbers: Sequence[float], file: str | None, names: Sequence[str], fill: float | None = None
) -> Array:
    """Points from arguments, a CSV file, or standard input ("-").

    Parameters
    ----------
    numbers : sequence of float
        Arguments, a multiple of the number of columns.
    file : str or None
        CSV with a header that has the columns, or without one in their order; blanks separate, too.
    names : sequence of str
        Columns.
    fill : float, optional
        Value of the last column where it is not given.

    Returns
    -------
    points : (N, len(names))
    """
    if file is not None:
        with nullcontext(sys.stdin) if file == "-" else opened_text(file, TABLE, newline="") as stream:
            return _table(stream, file, names, fill)
    width = len(names) if fill is None else len(names) - 1
    if not numbers or len(numbers) % width:
        wanted = " ".join(names[:width]).upper()
        raise click.UsageError(f"{len(numbers)} numbers; give {wanted} of each point, or --points FILE")
    points = np.array(numbers, dtype=np.float64).reshape(-1, width)
    return points if fill is None else np.column_stack([points, np.full(len(points), fill)])


def _table(lines: Iterable[str], file: str, names: Sequence[str], fill: float | None) -> Array:
    rows = [row for line in lines if (row := _cells(line))]
    columns = list(range(len(names)))
    if rows and not _is_number(rows[0][0]):
        header = [cell.strip().lower() for cell in rows.pop(0)]
        columns = [header.index(name) if name in header else -1 for name in names]
        if -1 in columns[: -1 if fill is not None else None]:
            raise InputError(f"{file}: columns {', '.join(names)} expected, found {', '.join(header)}")
    points = np.empty((len(rows), len(names)))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            missing = column < 0 or column >= len(row)
            if missing and not (fill is not None and j == len(names) - 1):
                raise InputError(f"{file}: point {i + 1} has {len(row)} columns, expected {', '.join(names)}")
            text = str(fill) if missing else row[column]
            if not _is_number(text):
                raise InputError(f"{file}: point {i + 1}: {text!r} is no number")
            points[i, j] = float(text)
    return points


def _cells(line: str) -> list[str]:
    line = line.split("#", 1)[0].strip()
    return next(csv.reader([line])) if "," in line else line.split()


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def print_points(names: Sequence[str], values: Array, digits: Sequence[int], as_json: bool) -> None:
    """A table of points as CSV with a header, or as a JSON list of objects (null for NaN)."""
    if as_json:
        rows = [
            {
                name: (round(v, d) if np.isfinite(v) else None)
                for name, v, d in zip(names, row, digits, strict=True)
            }
            for row in values.tolist()
        ]
        echo(json.dumps(rows))
        return
    echo(",".join(names))
    for row in values.tolist():
        echo(",".join(f"{v:.{d}f}" for v, d in zip(row, digits, strict=True)))


def tell_failures(points: Array, what: str) -> int:
    """The exit code of a verb on points; where some came out without a value, it is said on stderr."""
    count = int((~np.isfinite(points).all(axis=1)).sum())
    return tell_gate(f"{count} of {len(points)} points {what}", []) if count else 0
