"""Rendered scenes: images with relief, buildings and light, whose cameras and ground are known.

`Scene` renders them, `write_scene` writes them as files, ``python -m tests.scenes OUT`` does it from the command line.
"""

from __future__ import annotations

from tests.scenes.files import write_scene
from tests.scenes.images import ImageOptions, Scene

__all__ = ["ImageOptions", "Scene", "write_scene"]
