"""Known truth: cameras, tie points and images whose exact geometry is on record.

`simulate_block` makes views, tie points and their truth without pixels, for thousands of views; `Scene`
renders images of a scene with relief, buildings and light, and `write_scene` writes them.
"""

from __future__ import annotations

from barpc.simulate.block import Block, BlockTruth, recentred, simulate_block
from barpc.simulate.files import write_scene
from barpc.simulate.images import ImageOptions, Scene
from barpc.simulate.orbit import Look, fly
from barpc.simulate.sites import BlockOptions

__all__ = [
    "Block",
    "BlockOptions",
    "BlockTruth",
    "ImageOptions",
    "Look",
    "Scene",
    "fly",
    "recentred",
    "simulate_block",
    "write_scene",
]
