"""The pipeline: the only place that knows every stage."""

from __future__ import annotations

from barpc.base.options import RunOptions
from barpc.pipeline.loading import LoadedViews, load_views
from barpc.pipeline.run import AdjustResult, adjust, check

__all__ = ["AdjustResult", "LoadedViews", "RunOptions", "adjust", "check", "load_views"]
