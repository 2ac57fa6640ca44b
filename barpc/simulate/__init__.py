"""Known truth: cameras, tie points and images whose exact geometry is on record.

`simulate_block` makes views, tie points and their truth without pixels; the modules below render images.
"""

from __future__ import annotations

from barpc.simulate.block import Block, BlockTruth, recentred, simulate_block
from barpc.simulate.orbit import Look, fly
from barpc.simulate.sites import BlockOptions

__all__ = ["Block", "BlockOptions", "BlockTruth", "Look", "fly", "recentred", "simulate_block"]
