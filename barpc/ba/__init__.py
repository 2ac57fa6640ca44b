"""Tracks to corrections: the bundle adjustment.

`adjust_tracks` is the entry; `AdjustOptions` says how it runs, `Adjustment` what it found.
"""

from barpc.ba.adjustment import adjust_tracks
from barpc.ba.options import AdjustOptions
from barpc.ba.result import Adjustment

__all__ = ["AdjustOptions", "Adjustment", "adjust_tracks"]
