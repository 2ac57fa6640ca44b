"""The summary of a run, which summary.json stores: the one declaration of each value, and its column.

A new value is a field declared by `column` and a line in the function of `barpc.report.measures` that measures its
record; a table shows it if it is named among the columns here. A module each: views, pairs, the block, ground points.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import msgspec

from barpc.report.records import Number, Record, column
from barpc.report.summary.block import SceneEntry
from barpc.report.summary.ground_points import CheckPointEntry, ControlTestEntry, GcpEntry, ReferenceEntry
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import ABOVE, Count, Vector

SCHEMA: Literal[3] = 3  # Version of summary.json
_Plain = int | float | str | bool | None
_Value = _Plain | tuple[_Plain | tuple[_Plain, ...], ...]


class LeftOutEntry(Record):
    """A file that was left out."""

    path: str = column("File")
    reason: str = column("Reason")

    @property
    def reason_text(self) -> str:
        """The same as a sentence."""
        return f"{self.path} was left out: {self.reason.removeprefix(f'{self.path}: ')}"


class InputEntry(Record):
    """A file that the run read."""

    path: str = column("File; for a matcher given by name its module")
    bytes: Count = column("Its size")
    sha256: str = column("SHA-256 of its bytes; for a file on another host, of its URL and version")


class OutputEntry(Record):
    """A file that the run wrote."""

    file: str = column("Its name in the run folder")
    sha256: str = column("SHA-256 of its bytes")


class ExpectedEntry(Record):
    """The standard deviation to expect with a further input, by the covariance."""

    source: Literal["dem", "image", "gcps"] = column("A DEM of known vertical datum; a third image; three GCPs")
    sigma_enu_m: Vector = column("Standard deviation of the scene's position with it; null: not predicted", "m")


class StepEntry(Record):
    """A next step: use of the results, a further input, or a review."""

    kind: Literal["use", "improve", "review"] = column("Files to use; further inputs; parts to review")
    text: str = column("The step as a sentence", min_length=1)
    commands: tuple[str, ...] = column("Commands for it, where . is the run folder", default=())
    expected: tuple[ExpectedEntry, ...] = column("Effect of further inputs", default=())
    part: str | None = column("Part of report.html that shows it", default=None)


class TracksEntry(Record):
    """The tie points."""

    num_tracks: Count = column("Tie points")
    num_observations: Count = column("Their observations")
    by_length: Mapping[str, int] = column("Number of views -> tie points observed in that many")


class TablesEntry(Record):
    """Share of the tie points in the tables."""

    num_usable_tracks: Count = column("Tie points with a ground position")
    num_written_tracks: Count = column("Of these, in the tables (at most 200,000, evenly sampled)")
    complete: bool = column("Whether these are all")


class CarriedEntry(Record):
    """An image of the same acquisition as another one, whose correction it gets."""

    name: str = column("Name of the image")
    path: str = column("Its file")
    lead: str = column("The view whose correction it gets")
    outputs: Mapping[str, Mapping[str, float | str | None]] = column("Files with its camera, as of a view")


class StageEntry(Record):
    """A stage of the run."""

    stage: str = column("Name", head="stage")
    seconds: float = column("Wall time in seconds", head="seconds", form=".2f")
    cpu_seconds: float = column("CPU time in seconds", head="CPU seconds", form=".2f")
    peak_memory_mb: float = column("Peak memory so far", "MB", "peak memory", ".0f")


class Summary(Record):
    """summary.json of a run."""

    schema: Literal[3] = column("Version of this description")
    barpc: str = column("Release of barpc")
    kind: Literal["adjust", "check", "match"] = column("Whether cameras were adjusted, checked, or only matched")
    status: Literal["good", "look", "bad"] = column("The verdict on the run")
    headline: str = column("The verdict in a sentence")
    verdict: tuple[str, ...] = column("Sentences: results, uncertainty, reservations")
    reasons: tuple[str, ...] = column("The reservations among them")
    passed: bool = column("Whether it is good: no image, point or file has a reservation (exit code 0, else 3)")
    altitude_m: Number = column("Median altitude of the tie points", ABOVE)
    views: tuple[ViewEntry, ...] = column("The images", min_length=1)
    pairs: tuple[PairEntry, ...] = column("Pairs with common tie points")
    left_out: tuple[LeftOutEntry, ...] = column("Files that were left out")
    tracks: TracksEntry = column("Tie points")
    tables: TablesEntry = column("Contents of the tables")
    scene: SceneEntry | None = column("The block; null for a check")
    gcps: tuple[GcpEntry, ...] = column("Ground control")
    check_points: tuple[CheckPointEntry, ...] = column("Check points, which the adjustment did not use")
    options: Mapping[str, _Value | Mapping[str, _Value | Mapping[str, _Value]]] | None = column("Options of the run")
    versions: Mapping[str, str] = column("Versions of Python and packages")
    next: tuple[StepEntry, ...] = column("Next steps, at most one of a kind", default=())
    control_test: ControlTestEntry | None = column("Test of the residuals of control", default=None)
    reference: ReferenceEntry | None = column("A reference orthoimage, where one was given", default=None)
    carried: tuple[CarriedEntry, ...] | None = column("Images that get the correction of another", default=None)
    inputs: tuple[InputEntry, ...] | None = column("Every input file, for `barpc verify`", default=None)
    outputs: tuple[OutputEntry, ...] | None = column(
        "Every output file but this, the report and its pictures", default=None
    )
    out_dir: str | None = column("Folder of the results; not in the file", default=None)
    stages: tuple[StageEntry, ...] | None = column("Stages of the run; not in the file", default=None)

    def __repr__(self) -> str:
        return f"Summary({self.kind} of {len(self.views)} views, {self.status}: {self.headline})"

    @property
    def adjusted(self) -> bool:
        """Whether cameras were adjusted."""
        return self.kind == "adjust"


def published_schema() -> dict[str, Any]:
    """Return the JSON schema of summary.json."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "summary.json of a barpc run",
        "description": "Pixel (0, 0) is the centre of the first one. A number that is not finite is null. "
        "Paths are relative to the run folder.",
        **msgspec.json.schema(Summary),
    }
