"""Constants that stand beside the code that uses them, set like options: whatever is tuned is shown to act."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar
from unittest import mock

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
        "tolerance": ("barpc.tie.matchers.matching.BAND_HALFWIDTH",),
        "patch": ("barpc.tie.patches.register.PATCH",),
        "min_correlation": ("barpc.tie.patches.register.MIN_CORRELATION",),
    },
    AdjustOptions: {
        "robust_threshold": ("barpc.ba.robust.rounds.CRITICAL",),
        "sigma_drift": ("barpc.ba.parameters.priors.DRIFT_SIGMA",),
        "sigma_shift": ("barpc.ba.parameters.priors.IMAGE_MODEL_SIGMA",),
        "num_passes": ("barpc.ba.robust.rounds.TRIED",),
        "max_steps": ("barpc.ba.solving.solve.ITERATIONS",),
        "tolerance": ("barpc.ba.robust.rounds.TOLERANCE",),
        "min_observations": ("barpc.ba.constraints.block.MIN_OBSERVATIONS",),
    },
    FitOptions: {
        "tau": ("barpc.fit.system.TAU", "barpc.fit.methods.TAU"),
        "weighted": ("barpc.fit.methods.WEIGHTED",),
    },
}
"""Record -> name -> where the constant is read."""


@contextmanager
def chosen(record: type[Record], **values: Any) -> Iterator[Record]:
    """The record of options; values of constants hold as long as the context does."""
    with ExitStack() as stack:
        for name, places in CONSTANTS[record].items():
            if name in values:
                value = values.pop(name)
                for place in places:
                    stack.enter_context(mock.patch(place, value))
        yield record(**values)
