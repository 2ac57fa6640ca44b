"""Records of the pairs of a run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from barpc.report.records import Cell, Column, Number, Record, column
from barpc.report.summary.words import Count


class OffsetEntry(Record):
    """Distance of a pair's matches from their epipolar lines."""

    median: float = column("Median signed distance from the epipolar line", "px")
    spread: float = column("1.4826 times the median absolute deviation", "px")
    rms: float = column("Root mean square", "px")
    count: Count = column("Matches measured: at most 1000, evenly taken")


def _offset_cell(offset: OffsetEntry | None) -> Cell | None:
    if offset is None:
        return None
    return Cell(f"{offset.median:+.3f} ± {offset.spread:.3f}", float(f"{abs(offset.median):.6g}"))


class PairEntry(Record):
    """Two images with common tie points."""

    OWN: ClassVar = {
        "pair": Column("pair", lambda pair: f"{pair.a} - {pair.b}"),
        "before": Column(
            "before [px]",
            lambda pair: _offset_cell(pair.epipolar_before),
            ".3f",
            text="Delivered cameras, all verified matches",
        ),
        "beaten": Column("instead of", lambda pair: "; ".join(pair.beaten)),
        "after": Column(
            "after [px]",
            lambda pair: _offset_cell(pair.epipolar_after),
            ".3f",
            adjusted=True,
            text="New cameras, all verified matches",
        ),
        "rms": Column(
            "RMS [px]",
            lambda pair: pair.offset_rms[0] if pair.epipolar_after is None else pair.offset_rms[1],
            ".3f",
            text="Root mean square: new cameras, matches in use; in a check all verified matches",
        ),
    }
    CAPTION: ClassVar = "Pairs: offset from the epipolar line, median ± spread (1.4826 MAD)"
    PAGE: ClassVar = (
        "pair num_matches tied_by decoy_share convergence_deg base_to_height height_m_per_px before after rms"
    )
    AGAIN: ClassVar = "pair tied_by num_matches beaten"
    TERMINAL: ClassVar = "pair num_matches convergence_deg base_to_height before after"
    CSV: ClassVar = (
        "a b num_matches convergence_deg base_to_height height_m_per_px epipolar_before.median epipolar_before.spread "
        "epipolar_before.rms epipolar_after.median epipolar_after.spread epipolar_after.rms "
        "tied_by decoy_share noise_px"
    )

    a: str = column("First view")
    b: str = column("Second view")
    num_matches: Count = column("Common tie points in use", head="used")
    convergence_deg: Number = column("Angle between the lines of sight", "deg", "angle", ".1f")
    base_to_height: Number = column("Base-to-height ratio by the angle of the lines of sight", head="B/H", form=".2f")
    height_m_per_px: Number = column("Height of one pixel of parallax", "m", "height per px", ".3g")
    epipolar_before: OffsetEntry | None = column(
        "Epipolar offset through the delivered cameras, of all verified matches"
    )
    epipolar_after: OffsetEntry | None = column("The same through the new cameras")
    matching: Mapping[str, Any] | None = column("Report of the matcher; null: not matched")
    tied_by: str | None = column(
        "Matcher that succeeded, and whether its thresholds were relaxed", head="matched by", default=None
    )
    decoy_share: Number = column(
        "Estimated share of false matches: as many as a search in wrong places finds",
        head="false matches",
        form=".1%",
        default=None,
    )
    noise_px: Number = column(
        "Spread across epipolar lines of matches before their positions are refined", "px", default=None
    )
    beaten: tuple[str, ...] = column("Attempts with too few matches: matcher, matches of those required", default=())
    chosen_by: str | None = column("Reason of its selection: overlap and angle, same date, listed, ...", default=None)
    epipolar_kept: OffsetEntry | None = column("The same, of the matches in use", default=None)

    @property
    def offset_rms(self) -> tuple[float | None, float | None]:
        """RMS of the offsets before and after."""
        before, after = self.epipolar_before, self.epipolar_kept or self.epipolar_after
        return None if before is None else before.rms, None if after is None else after.rms
