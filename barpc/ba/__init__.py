"""Tracks to corrections: the bundle adjustment.

`adjust_tracks` is the entry; `AdjustOptions` says how it runs, `Adjustment` what it found. `consistent_observations`
moves no camera and says which observations agree; `passes_told` tells how far they are. `block_prior` keeps what a
block knows for a later run with more views; `pair_heights` says how well a stereo pair knows heights; `split_points`
and `check_residuals` keep known points out of the solve and measure it by them.
"""

from barpc.ba.adjustment import adjust_tracks, consistent_observations
from barpc.ba.constraints.incremental import BlockPrior
from barpc.ba.result import Adjustment, PairHeights, block_prior, pair_heights
from barpc.ba.robust.heldout import CheckResiduals, check_residuals, split_points
from barpc.ba.solving.solve import passes_told
from barpc.base.options import AdjustOptions

__all__ = [
    "AdjustOptions",
    "Adjustment",
    "BlockPrior",
    "CheckResiduals",
    "PairHeights",
    "adjust_tracks",
    "block_prior",
    "check_residuals",
    "consistent_observations",
    "pair_heights",
    "passes_told",
    "split_points",
]
