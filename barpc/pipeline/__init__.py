"""The pipeline: the only place that knows every stage.

The names below are imported when first used: a worker process, which does the tasks of a stage, loads no other stage.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from barpc.base import used_later

if TYPE_CHECKING:
    from barpc.base.options import RunOptions
    from barpc.pipeline.loading import LoadedViews, load_views
    from barpc.pipeline.planning import Plan
    from barpc.pipeline.results import OpenedRun
    from barpc.pipeline.run import AdjustResult, adjust, check, plan

__all__ = ["AdjustResult", "LoadedViews", "OpenedRun", "Plan", "RunOptions", "adjust", "check", "load_views", "plan"]
_MODULES = {
    "RunOptions": "barpc.base.options",
    "OpenedRun": f"{__name__}.results",
    "Plan": f"{__name__}.planning",
    **dict.fromkeys(("LoadedViews", "load_views"), f"{__name__}.loading"),
    **dict.fromkeys(("AdjustResult", "adjust", "check", "plan"), f"{__name__}.run"),
}
__getattr__ = used_later(__name__, _MODULES)
