"""Tracks of a file of matches, as a run takes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from barpc.pointio.matches import read_links, tracks_of
from barpc.scene import Tracks


def read_matches(path: Path | str, names: Sequence[str]) -> Tracks:
    """Points that are linked, by way of others too, are one track."""
    return tracks_of(read_links(path, names), path)
