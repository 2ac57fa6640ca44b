"""The pipeline: the only place that knows every stage.

The names below are imported when first used: a worker process, which does the tasks of a stage, loads no other stage.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

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
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES.get(name, f"{__name__}.run")), name)
