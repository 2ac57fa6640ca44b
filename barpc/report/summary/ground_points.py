"""Records of the points of given position: GCPs, reference, check points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np

from barpc.report.records import Column, Number, Record, column
from barpc.report.summary.words import ABOVE, Count, Pixel, Vector

GCP_CAPTION = "GCP residuals, each with that GCP left out (predicted minus given position)"


class KnownPoint(Record):
    """A point of given position."""

    name: str = column("Name")
    lon: float = column("Longitude", "deg", ge=-540, le=540)
    lat: float = column("Latitude", "deg", ge=-90, le=90)
    alt_m: float = column("Altitude", ABOVE)


_MISS = "Intersected minus given position, east, north, up; none with fewer than two views"


class GcpEntry(KnownPoint):
    """A ground control point."""

    OWN: ClassVar = {"GCP": Column("GCP", lambda point: point.name)}
    PAGE: ClassVar = "GCP status residual_enu_m residual_px w image_w image_w_view sigma_m"
    TERMINAL: ClassVar = "GCP status residual_enu_m residual_px w"

    sigma_m: tuple[float, float, float] = column(
        "Stated standard deviation, east, north, up", "m", "sigma east, north, up", ".3g"
    )
    residual_enu_m: Vector = column("Position predicted without it, minus given", "m", ("east", "north", "up"), "+.3f")
    used: bool = column("Whether it constrains the block", default=True)
    status: Literal["used", "contradicts", "rejected", "undecided", "not seen"] = column(
        "contradicts: used, its residual exceeds 4 sigma; rejected by the others; undecided: no majority, not used",
        head="verdict",
        default="used",
    )
    images: tuple[str, ...] = column("Views with an observation of it", default=())
    w: Number = column(
        "Largest component of the residual over its standard deviation (Baarda's w)", "", "w", ".1f", default=None
    )
    redundancy: Number = column("Redundancy number, 0 to 1: how far the others control it", default=None)
    residual_px: Number = column("RMS of the residual in its images", "px", "in images", ".2f", default=None)

    image_w: Number = column(
        "Largest Baarda's w of its single image observations", "", "w in images", ".1f", default=None
    )
    image_w_view: str | None = column("Image of the largest w", head="largest in", default=None)

    @classmethod
    def worst(cls, points: Sequence[GcpEntry], most: int) -> list[GcpEntry]:
        """Return at most `most` points in their order: first those not used, then those of the largest w."""
        order = sorted(points, key=lambda point: (point.used, -(point.w or 0.0)))[:most]
        return [point for point in points if any(point is one for one in order)]


class ControlTestEntry(Record):
    """Test of the image residuals of GCPs and reference points, each over its standard deviation."""

    num: Count = column("Observations tested")
    critical: float = column("Critical value, exceeded by chance once in a thousand coordinates")
    num_beyond: Count = column("Observations beyond it in a coordinate")
    expected: float = column("Observations expected beyond it by chance")
    largest_w: Number = column("The largest w (Baarda)")
    image: str = column("View of the largest w")
    point: str = column("Point of the largest w")


class ReferenceViewEntry(Record):
    """Matches of a reference in an image."""

    PAGE: ClassVar = "name peak offset_en_m num_tried num_passed num_points scatter_m"

    name: str = column("View", head="image")
    peak: Number = column("Height of the correlation peak in standard deviations", "", "peak", ".1f")
    offset_en_m: Pixel | None = column(
        "Offset of the delivered camera, east, north", "m", ("offset east", "north"), "+.2f"
    )
    num_tried: Count = column("Points searched for", head="points tried")
    num_passed: Count = column("Matched better than a decoy, forwards and backwards", head="matched")
    num_points: Count = column("Consistent ones, which constrain the block", head="used")
    scatter_m: Number = column("Standard deviation of these across the line of sight", "m", "scatter", ".2f")


class ReferenceEntry(Record):
    """A reference orthoimage."""

    used: bool = column("Whether it constrains the block")
    step_m: Number = column("Resolution of the matches", "m")
    sigma_m: Number = column("Standard deviation of its own position along an axis", "m")
    num_points: Count = column("Ground points that constrain the block")
    views: tuple[ReferenceViewEntry, ...] = column("Its matches in each image")


class SeenEntry(Record):
    """Observation of a check point in a view."""

    view: str = column("Name of the view")
    residual_px: Pixel = column("Projected minus observed col, row", "px")


def _gcp_rms(point: CheckPointEntry) -> float | None:
    return float(np.sqrt(np.mean(np.square(point.seen).sum(axis=1)))) if point.seen else None


class CheckPointEntry(KnownPoint):
    """A check point, which the adjustment did not use."""

    OWN: ClassVar = {
        "point": Column("check point", lambda point: point.name),
        "images": Column("images", lambda point: len(point.seen)),
        "rms": Column("in the images [px]", _gcp_rms, ".3f"),
    }
    PAGE: ClassVar = "point images rms residual_enu_m"

    residual_enu_m: Vector = column(_MISS, "m", ("east", "north", "up"), "+.3f")
    observations: tuple[SeenEntry, ...] = column("Its observations")

    @property
    def seen(self) -> list[Any]:
        """Finite residuals in its images."""
        return [seen.residual_px for seen in self.observations if None not in seen.residual_px]
