"""What the user may change about tie points, and how their tasks are handed to whoever works on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields
from typing import Any

from barpc.errors import InputError


@dataclass(frozen=True)
class TieOptions:
    """How tie points are found; every length is in full-resolution pixels.

    Parameters
    ----------
    band : int
        Band of the images, from 1.
    detector : str
        A row of `barpc.tie.features.DETECTORS`.
    matcher : str
        A row of `barpc.tie.matching.MATCHERS`.
    tile : int
        Side of the tiles that are read and searched for keypoints [px].
    cell : int
        Side of the cells that each hold at most `keypoints_per_cell` [px].
    keypoints_per_cell : int
        Strongest keypoints kept in a cell.
    keypoints_per_image : int
        Bound for an image; cells hold fewer where it would be passed.
    contrast : float
        SIFT's contrast threshold.
    min_overlap : float
        Smallest share of the smaller footprint that a pair of views must have in common.
    min_angle, max_angle : float
        Convergence angles of a pair [deg].
    neighbours : int
        Best partners tried for a view, on top of what connects all views.
    search : float
        How far a camera may be wrong, in any direction [px].
    tolerance : float
        Half the width of the band about the corrected epipolar line [px].
    ratio : float
        Largest descriptor distance of the best candidate over that of the second best.
    false_share : float
        Share of false matches that is accepted, as control bands estimate it.
    min_matches : int
        Verified matches that a pair needs to count.
    patch : int
        Side of the patches that are registered [px], odd.
    min_correlation : float
        Smallest correlation of two registered patches.
    points_per_image : int
        Bound on the observations kept in an image, evenly spread.
    """

    band: int = 1
    detector: str = "sift"
    matcher: str = "guided"
    tile: int = 1024
    cell: int = 64
    keypoints_per_cell: int = 40
    keypoints_per_image: int = 100_000
    contrast: float = 0.01
    min_overlap: float = 0.05
    min_angle: float = 0.0
    max_angle: float = 60.0
    neighbours: int = 8
    search: float = 700.0
    tolerance: float = 3.0
    ratio: float = 0.85
    false_share: float = 0.01
    min_matches: int = 12
    patch: int = 21
    min_correlation: float = 0.8
    points_per_image: int = 5000

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, str):
                continue
            least = 0 if field.name in ("min_overlap", "min_angle") else 1e-9
            if not value >= least:
                raise InputError(f"tie points: {field.name} = {value} must be positive")
        if self.patch % 2 == 0 or self.patch < 9:
            raise InputError(f"tie points: patch = {self.patch} must be odd and at least 9")
        if self.tile < 128 or self.cell < 8 or self.min_matches < 4:
            raise InputError("tie points: tile >= 128, cell >= 8 and min_matches >= 4 are needed")
        if self.min_overlap > 1 or self.ratio > 1 or self.min_correlation >= 1:
            raise InputError("tie points: min_overlap, ratio and min_correlation are shares, at most 1")


Progress = Callable[[str, int, int], None]
"""Called with the stage, how much is done, of how much."""


def ordered(
    executor: Executor | None,
    function: Callable[..., Any],
    tasks: Sequence[tuple[Any, ...]],
    stage: str,
    progress: Progress | None = None,
) -> list[Any]:
    """Results of `function(*task)` in the order of the tasks; the rest is cancelled when one fails.

    Parameters
    ----------
    executor : Executor or None
        Works on the tasks; None: they are worked on here, one after the other.
    function : callable
        Of a module, so that it can be sent to another process.
    tasks, stage, progress
        Its arguments; `progress(stage, done, total)` is called as they are done.
    """
    results = []
    futures = [executor.submit(function, *task) for task in tasks] if executor is not None else []
    try:
        for done, task in enumerate(tasks, start=1):
            results.append(futures[done - 1].result() if futures else function(*task))
            if progress is not None:
                progress(stage, done, len(tasks))
    finally:
        for future in futures:
            future.cancel()
    return results
