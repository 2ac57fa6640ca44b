"""A first surface of a block, with its uncertainty: the proof of its cameras in metres on the ground."""

from __future__ import annotations

from barpc.dsm.stereo import NoSurfaceError
from barpc.dsm.surface import Surface, make_dsm

__all__ = ["NoSurfaceError", "Surface", "make_dsm"]
