"""Old names in summary.json -> those of this release: schema 2, of releases up to 0.3, is read until the next one."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from barpc.base.errors import BarpcWarning, InputError
from barpc.base.safe_io import SUMMARY, read_json
from barpc.report.summary import SCHEMA

OLD_SCHEMA = 2
_RENAMED_RESIDUALS = {
    "smooth_px": "systematic_px",
    "smooth_p": "systematic_p",
    "shared_px": "neighbour_correlated_px",
}
RENAMED_KEYS = {
    "views": _RENAMED_RESIDUALS,
    "views.correction": {"strip_px": "step_px", "swing_px": "sinusoid_px", "swing_rows": "sinusoid_rows"},
    "scene": {
        "drift_asked": "drift_justification",
        "jitter_asked": "jitter_justification",
        "in_space_px": "rigid_model_px",
    },
    "scene.drift_justification": _RENAMED_RESIDUALS,
    "scene.jitter_justification": _RENAMED_RESIDUALS,
    "scene.dem": {"alike": "correlated_per_independent"},
    "scene.explanations": {"or_of": "candidates"},
    "scene.left": {"apart_px": "rejected_median_px"},
}
"""Record -> its old keys and the new ones; a record after the one whose key leads to it."""
RENAMED_KINDS = {
    "strip": "step",
    "fade": "decay",
    "settling": "transient",
    "wander": "low_frequency",
    "swing": "sinusoid",
    "moving": "moving_objects",
    "apart": "foreign_camera",
}
RENAMED_VALUES = {
    ("views", "cause"): {"apart": "foreign_camera", "smooth": "systematic", "moving": "moving_objects"},
    ("scene.explanations", "name"): RENAMED_KINDS,
    ("scene.explanations", "runner_up"): RENAMED_KINDS,
}
"""Record and key -> its old values and the new ones; a colon and an image may follow."""


def is_old(path: Path) -> bool:
    """Return whether a summary.json is of schema 2, whose runs have no SHA256SUMS."""
    found = read_json(path, SUMMARY)
    return isinstance(found, dict) and type(found.get("schema")) is int and found["schema"] == OLD_SCHEMA


def with_new_names(found: Any, path: Path) -> Any:
    """Return the parsed summary.json of schema 2 under the names of schema 3, changed in place; others untouched.

    A BarpcWarning names the file. What is damaged stays, for the validation that follows; InputError for both names.
    """
    if not isinstance(found, dict) or type(found.get("schema")) is not int or found["schema"] != OLD_SCHEMA:
        return found
    for place, names in RENAMED_KEYS.items():
        for record in _records(found, place.split(".")):
            if both := [old for old, new in names.items() if old in record and new in record]:
                raise InputError(f"{path}: damaged, {place} has {both[0]} and its new name: run the adjustment again")
            record.update({new: record.pop(old) for old, new in names.items() if old in record})
    for (place, key), values in RENAMED_VALUES.items():
        for record in _records(found, place.split(".")):
            if isinstance(value := record.get(key), str):
                kind, colon, image = value.partition(":")
                record[key] = values.get(kind, kind) + colon + image
    found["schema"] = SCHEMA
    warnings.warn(
        f"{path}: has the names of release 0.3, which the next release will not read, and nothing proves it: run the "
        "adjustment again",
        BarpcWarning,
        stacklevel=2,
    )
    return found


def _records(value: Any, steps: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the mappings at a place of parsed JSON, those of lists each."""
    if isinstance(value, list):
        for item in value:
            yield from _records(item, steps)
    elif isinstance(value, dict) and steps:
        yield from _records(value.get(steps[0]), steps[1:])
    elif isinstance(value, dict):
        yield value
