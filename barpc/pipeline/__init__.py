"""The pipeline: the only place that knows every stage.

The names below are imported when first used: a worker process, which does the tasks of a stage, loads no other stage.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from barpc.base import used_later
from barpc.base.options import RunOptions

if TYPE_CHECKING:
    from barpc.pipeline.loading import LoadedViews, load_views
    from barpc.pipeline.run import AdjustResult, adjust, check

__all__ = ["AdjustResult", "LoadedViews", "RunOptions", "adjust", "check", "load_views"]
__getattr__ = used_later(
    __name__,
    dict.fromkeys(("AdjustResult", "adjust", "check"), "run") | dict.fromkeys(("LoadedViews", "load_views"), "loading"),
)
