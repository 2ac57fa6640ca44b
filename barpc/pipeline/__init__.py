"""The pipeline: the only place that knows every stage."""

from __future__ import annotations

from barpc.options import RunOptions
from barpc.pipeline.run import AdjustResult, adjust, check
from barpc.pipeline.views import LoadedViews, load_views

__all__ = ["AdjustResult", "LoadedViews", "RunOptions", "adjust", "check", "load_views"]
