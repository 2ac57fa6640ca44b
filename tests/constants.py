"""Constants that stand beside the code that uses them, set like options: whatever is tuned is shown to act."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any, TypeVar
from unittest import mock

import pytest

from barpc.base.declarations import Options
from barpc.base.options import AdjustOptions, FitOptions, TieOptions

Record = TypeVar("Record", bound=Options)

CONSTANTS: dict[type[Options], dict[str, tuple[str, ...]]] = {
    TieOptions: {
        "cell": ("barpc.tie.pixels.CELL", "barpc.tie.matchers.features.CELL"),
        "keypoints_per_cell": ("barpc.tie.matchers.features.PER_CELL",),
        "keypoints_per_image": ("barpc.tie.matchers.features.PER_IMAGE",),
        "false_share": ("barpc.tie.matchers.matching.FALSE_SHARE",),
        "contrast": ("barpc.tie.matchers.features.CONTRAST",),
        "tolerance": ("barpc.tie.matchers.pair_search.BAND_HALFWIDTH",),
        "patch": ("barpc.tie.patches.register.PATCH",),
        "min_correlation": ("barpc.tie.patches.register.MIN_CORRELATION",),
    },
    AdjustOptions: {
        "robust_threshold": ("barpc.ba.robust.rounds.CRITICAL",),
        "sigma_drift": ("barpc.ba.parameters.priors.DRIFT_SIGMA",),
        "sigma_shift": ("barpc.ba.parameters.priors.IMAGE_MODEL_SIGMA",),
        "num_passes": ("barpc.ba.robust.rounds.TRIED",),
        "tolerance": ("barpc.ba.robust.rounds.TOLERANCE",),
        "min_observations": ("barpc.ba.constraints.block.MIN_OBSERVATIONS",),
    },
    FitOptions: {"tau": ("barpc.fit.system.TAU", "barpc.fit.methods.TAU"), "weighted": ("barpc.fit.methods.WEIGHTED",)},
}
"""Record -> name -> where the constant is read."""


def home(place: str) -> tuple[ModuleType, str]:
    """The module of a constant, and its name there: `barpc.fit` is a verb, and leads to no module."""
    module, _, name = place.rpartition(".")
    return import_module(module), name


@contextmanager
def chosen(record: type[Record], **values: Any) -> Iterator[Record]:
    """The record of options; values of constants hold as long as the context does."""
    with ExitStack() as stack:
        for name, places in CONSTANTS[record].items():
            if name in values:
                value = values.pop(name)
                for place in places:
                    stack.enter_context(mock.patch.object(*home(place), value))
        yield record(**values)


SIZES = {
    "altimetry_points": ("barpc.base.statistics.SAMPLE",),
    "scene_points": ("barpc.base.statistics.SAMPLE",),
    "set_points": ("barpc.ba.control.agreement._MAX_SET_POINTS",),
    "tests_kept": ("barpc.ba.control.snooping.KEPT",),
    "heights_measured": ("barpc.ba.result.MANY",),
    "terms_kept": ("barpc.ba.robust.systematic_residuals.KEPT",),
    "unknowns_tried": ("barpc.ba.robust.posterior.SMALL",),
    "columns_kept": ("barpc.ba.solving.covariance.KEPT",),
    "dense_unknowns": ("barpc.ba.solving.covariance._DENSE_UNKNOWNS",),
    "fronts_in_memory": ("barpc.ba.solving.linear.IN_MEMORY",),
    "observations_together": ("barpc.ba.solving.normal.CHUNK",),
    "dense_views": ("barpc.ba.solving.normal.LEAF",),
    "products_kept": ("barpc.ba.solving.problem.KEPT",),
    "steps": ("barpc.ba.solving.solve.ITERATIONS",),
    "front_views": ("barpc.ba.solving.structure.LEAF",),
    "cells_read": ("barpc.rasters.dem._MAX_CELLS",),
    "points_together": ("barpc.sensor.rpc.CHUNK",),
    "unknowns_searched": ("barpc.ba.select.search.LARGEST",),
    "observations_searched": ("barpc.ba.select.search.MAX_OBSERVATIONS",),
    "unknowns_together": ("barpc.ba.select.search.SMALL",),
    "views_together": ("barpc.ba.select.search._NEAREST",),
    "elements_linearised": ("barpc.ba.select.search.KEPT",),
    "rivals": ("barpc.ba.select.beam.RIVALS",),
    "pixels_together": ("barpc.tie.pixels.SPAN",),
    "keypoints_per_image": ("barpc.tie.matchers.features.PER_IMAGE",),
    "candidates_together": ("barpc.tie.matchers.guided.PIECE",),
    "places_together": ("barpc.tie.matchers.structural.PIECE",),
    "sides_crossed": ("barpc.tie.pairing.area._MOST_CROSSED",),
    "sides_together": ("barpc.tie.pairing.area._TOGETHER",),
    "patches_together": ("barpc.tie.patches.register.CHUNK",),
    "rows_refined": ("barpc.tie.patches.dense._STRIP_ROWS",),
    "newton_steps": ("barpc.tie.patches.register.NEWTON_STEPS",),
    "kept_after": ("barpc.workspace.KEEP_AFTER",),
    "rows_together": ("barpc.report.tables.CHUNK",),
    "tracks_in_tables": ("barpc.report.outcome.MAX_TRACKS",),
    "observations_intersected": ("barpc.report.outcome.CHUNK",),
    "matches_measured": ("barpc.report.measures.pairs.MAX_PER_PAIR",),
    "shown": ("barpc.report.maps.MAX_SHOWN", "barpc.report.page.MAX_SHOWN"),
    "pictures": ("barpc.report.maps.MAX_PICTURES",),
    "images_together": ("barpc.pipeline.loading.GROUP", "barpc.pipeline.executor.GROUP"),
    "surface_block": ("barpc.dsm.surface.BLOCK_SIZE",),
    "windows_together": ("barpc.tie.patches.oriented.PIECE",),
}
"""Name -> constants from which on work is done in parts, sampled, thinned or given up: small things count as large."""

Sized = Callable[..., None]


def sized(monkeypatch: pytest.MonkeyPatch) -> Sized:
    """Return the function that sets sizes by their names as long as a test runs."""

    def put(**values: Any) -> None:
        for name, value in values.items():
            for place in SIZES[name]:
                monkeypatch.setattr(*home(place), value)

    return put
