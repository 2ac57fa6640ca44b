"""SHA256SUMS: every file of a finished folder by its SHA-256, in lines that `sha256sum -c` reads.

::

    # barpc 0.4.0, code 58c1f0d2a9b3e647
    # <sha256>  report.html                                         replaced by a later layer
    <sha256>  summary.json
    # barpc 0.4.0, code 58c1f0d2a9b3e647, after <root>
    <sha256>  report.html
    <sha256>  dsm.tif

A layer is what one command wrote. The SHA-256 of this file is the root: it covers every file, inputs and options by
summary.json, and the earlier roots. No name, path or time of the folder itself is part of it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from barpc.base.errors import InputError
from barpc.base.safe_io import SUMMARY, read_bytes

SUMS = "SHA256SUMS"
LAST = "summary.json"  # of a run: with it its folder is complete
REPORT_FILE = "report.html"  # the one result that later commands make again
_ENTRY = re.compile(r"(?:# )?([0-9a-f]{64})  ((?!/)[^\0-\x1f\\]+)")
_AFTER = ", after "


@dataclass
class Layer:
    """Files that one command wrote: name in the folder, with slashes -> SHA-256; and what its first line says."""

    head: str
    files: dict[str, str] = field(default_factory=dict)

    @property
    def after(self) -> str:
        """Root of the layers before, or of the run that an export was made from; empty where there is none."""
        return self.head.partition(_AFTER)[2]


def head(version: str, code: str, after: str = "") -> str:
    """Return the first line of a layer: release, hash of its code, and the root before."""
    return f"barpc {version}, code {code}" + (after and _AFTER + after)


def render(layers: Sequence[Layer]) -> str:
    """Return the text of SHA256SUMS; of several contents of a file the last counts, the others are comments."""
    last = {name: number for number, layer in enumerate(layers) for name in layer.files}
    lines = []
    for number, layer in enumerate(layers):
        lines.append(f"# {layer.head}\n")
        lines += [f"{'# ' * (last[name] > number)}{sha}  {name}\n" for name, sha in sorted(layer.files.items())]
    return "".join(lines)


def parse(text: str) -> list[Layer]:
    """Return the layers of a SHA256SUMS; ValueError where `render` would not write this text."""
    layers: list[Layer] = []
    for line in text.split("\n")[:-1]:
        entry = _ENTRY.fullmatch(line)
        if entry is None:
            layers.append(Layer(line[2:]))
        elif layers and ".." not in entry[2].split("/"):
            layers[-1].files[entry[2]] = entry[1]
    if not layers or render(layers) != text:
        raise ValueError("its text is not as barpc writes it; were its line ends converted?")
    return layers


def root_of(layers: Sequence[Layer]) -> str:
    """Return the root of a folder that has these layers only, in 64 hexadecimal digits."""
    return hashlib.sha256(render(layers).encode()).hexdigest()


def read(folder: Path) -> tuple[str, list[Layer]]:
    """Return the root of a folder and its layers, the first one first.

    InputError where its SHA256SUMS is missing or damaged.
    """
    data = read_bytes(folder / SUMS, replace(SUMMARY, empty=True))
    try:
        return hashlib.sha256(data).hexdigest(), parse(data.decode())
    except ValueError as error:
        raise InputError(f"{folder / SUMS}: changed, {error}") from None
