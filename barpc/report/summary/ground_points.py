"""Points of given position (GCPs, reference, check points): their records, and how these are measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from scipy.special import ndtri

from barpc.ba import check_residuals
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.base.statistics import CHANCE
from barpc.report.outcome import Run
from barpc.report.records import Column, Number, Record, column
from barpc.report.summary.words import ABOVE, Count, Pixel, Vector
from barpc.scene import IntArray

GCP_CAPTION = "GCP residuals, each predicted without that GCP (prediction minus given)"


class KnownPoint(Record):
    """A point of given position."""

    name: str = column("Name")
    lon: float = column("Longitude", "deg", ge=-540, le=540)
    lat: float = column("Latitude", "deg", ge=-90, le=90)
    alt_m: float = column("Altitude", ABOVE)


_MISS = "Intersected minus given position, east, north, up; null with fewer than two views"


class GcpEntry(KnownPoint):
    """A ground control point."""

    OWN: ClassVar = {"GCP": Column("GCP", lambda point: point.name)}
    PAGE: ClassVar = "GCP status residual_enu_m residual_px w image_w image_w_view sigma_m"
    TERMINAL: ClassVar = "GCP status residual_enu_m residual_px w"

    sigma_m: tuple[float, float, float] = column(
        "Stated standard deviation, east, north, up", "m", "sigma east, north, up", ".2g"
    )
    residual_enu_m: Vector = column("Position predicted without it, minus given", "m", ("east", "north", "up"), "+.3f")
    used: bool = column("Whether it constrains the block", default=True)
    status: Literal["used", "contradicts", "rejected", "undecided", "not seen"] = column(
        "contradicts: used, residual above 4 sigma; rejected: the others contradict it; undecided: no majority",
        head="verdict",
        default="used",
    )
    images: tuple[str, ...] = column("Views with an observation of it", default=())
    w: Number = column("Largest component of the residual over its standard deviation", "", "w", ".1f", default=None)
    redundancy: Number = column("Redundancy number, 0 to 1: how far the others control it", default=None)
    residual_px: Number = column("RMS of the residual in its images", "px", "in images", ".2f", default=None)

    image_w: Number = column("Largest w in the images (Baarda)", "", "w in images", ".1f", default=None)
    image_w_view: str | None = column("View of the largest w", head="largest in", default=None)

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


# --- measurement ------------------------------------------------------------------------------------------


def measure_gcps(run: Run) -> tuple[GcpEntry, ...]:
    """Return the records of the GCPs with their test in the adjustment."""
    points = run.gcps
    if points is None:
        return ()
    tested = None if run.adjustment is None else run.adjustment.control
    left = np.full_like(points.sigma, np.nan) if tested is None else tested.residual
    worst = {test.point: test for test in sorted(run.control_tests, key=lambda test: test.w)}  # the largest is last
    entries = []
    for g, (name, rows) in enumerate(
        zip(points.names, _indices_by_number(points.point, len(points.names)), strict=True)
    ):
        views, test = points.view[rows], worst.get(name)
        lon, lat, alt = points.lonlatalt[g].tolist()
        status = "not seen" if not len(views) else "used" if tested is None else tested.status(g)
        entry = GcpEntry(
            *(name, lon, lat, alt, points.sigma[g].tolist(), left[g].tolist()),
            used=status in ("used", "contradicts"),
            status=status,  # type: ignore[arg-type]  # one of these words
            images=tuple(run.views[i].name for i in views),
            w=None if tested is None else tested.w[g],
            redundancy=None if tested is None else tested.redundancy[g],
            residual_px=_shift_in_images(run, points.lonlatalt[g], views, left[g]),
            image_w=None if test is None else test.w,
            image_w_view=None if test is None else run.views[test.view].name,
        )
        entries.append(entry)
    return tuple(entries)


def measure_control(run: Run) -> ControlTestEntry | None:
    """Return the test of all image residuals of control; None without any."""
    tests = run.control_tests
    if not tests:
        return None
    worst, count = max(tests, key=lambda test: test.w), len(tests)
    critical = -float(ndtri(CHANCE / 2.0))
    beyond = sum(test.w > critical for test in tests)
    chance = 1.0 - (1.0 - CHANCE) ** 2  # of two coordinates
    name = run.views[worst.view].name
    return ControlTestEntry(count, critical, beyond, chance * count, worst.w, name, worst.point)


def _indices_by_number(index: IntArray, num: int) -> list[IntArray]:
    """Return the positions in `index` (n,) of each number below `num`."""
    order = np.argsort(index, kind="stable")
    return np.split(order, np.searchsorted(index[order], np.arange(1, num)))[:num]


def _shift_in_images(run: Run, given: Array, views: IntArray, residual: Array) -> float:
    """Return the RMS image shift [px] of a ground point by its residual (3,) east, north, up [m]."""
    if run.after is None or not np.isfinite(residual).all():
        return float("nan")
    moved = ground_from_ecef(ecef_from_ground(given) + residual @ enu_basis(given))
    moves = [run.after[v].project(moved) - run.after[v].project(given) for v in views]
    return float(np.sqrt(np.mean(np.square(moves).sum(axis=1)))) if moves else float("nan")


def measure_reference(run: Run) -> ReferenceEntry | None:
    """Return the record of the reference orthoimage; None without one."""
    found, adjustment = run.reference, run.adjustment
    if found is None:
        return None
    kept, points = [0] * len(run.views), 0
    if found.control is not None and adjustment is not None:
        held, rows = found.control.points, adjustment.reference_inlier
        kept = np.bincount(held.view[rows], minlength=len(run.views)).tolist()
        points = len(np.unique(held.point[rows]))
    views = tuple(
        ReferenceViewEntry(
            *(view.name, view.peak, view.offset if view.points else None, view.tried, view.passed, count, view.scatter)
        )
        for view, count in zip(found.views, kept, strict=True)
    )
    return ReferenceEntry(points > 0, found.step, found.sigma, points, views)


def measure_check_points(run: Run) -> tuple[CheckPointEntry, ...]:
    """Return the records of the check points: residuals in images and on the ground."""
    points = run.check_points
    if points is None:
        return ()
    left = check_residuals(run.before if run.after is None else run.after, points)
    seen = [SeenEntry(run.views[i].name, r) for i, r in zip(points.view, left.image.tolist(), strict=True)]
    seen_of = [tuple(seen[row] for row in rows) for rows in _indices_by_number(points.point, len(points.names))]
    rows = zip(points.names, points.lonlatalt.tolist(), left.ground.tolist(), seen_of, strict=True)
    return tuple(CheckPointEntry(name, lon, lat, alt, miss, found) for name, (lon, lat, alt), miss, found in rows)
