"""Known truth: `simulate_block` makes views, tie points and their exact geometry, for thousands of views."""

from __future__ import annotations

from barpc.simulate.block import Block, BlockOptions, BlockTruth, recentred, simulate_block
from barpc.simulate.orbit import Look, fly

__all__ = [
    "Block",
    "BlockOptions",
    "BlockTruth",
    "Look",
    "fly",
    "recentred",
    "simulate_block",
]
