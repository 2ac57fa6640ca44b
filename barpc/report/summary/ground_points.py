"""Points whose place is given: control, a reference, checks; what is said of each, and how it is measured."""

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
    """A point whose place is given."""

    name: str = column("Name")
    lon: float = column("Longitude", "deg", minimum=-540, maximum=540)
    lat: float = column("Latitude", "deg", minimum=-90, maximum=90)
    alt_m: float = column("Altitude", ABOVE)


_MISS = "Found minus given place, east, north, up; null where fewer than two views see it"


class GcpEntry(KnownPoint):
    """A ground control point."""

    OWN: ClassVar = {"GCP": Column("GCP", lambda point: point.name)}
    PAGE: ClassVar = "GCP status residual_enu_m residual_px w image_w image_w_view sigma_m"
    TERMINAL: ClassVar = "GCP status residual_enu_m residual_px w"

    sigma_m: tuple[float, float, float] = column("Stated", "m", "sigma east, north, up", ".2g")
    residual_enu_m: Vector = column("Place by the others minus given", "m", ("east", "north", "up"), "+.3f")
    used: bool = column("Whether it holds the block", default=True)
    status: Literal["used", "contradicts", "rejected", "undecided", "not seen"] = column(
        "contradicts: used, off by more than 4 sigma; rejected: the others agree without it; undecided: weighs as much",
        head="verdict",
        default="used",
    )
    images: tuple[str, ...] = column("Views that show it", default=())
    w: Number = column("Largest component of the residual over its standard deviation", "", "w", ".1f", default=None)
    redundancy: Number = column("How far the others can tell, 0 to 1", default=None)
    residual_px: Number = column("The residual in the images that show it, RMS", "px", "in images", ".2f", default=None)

    image_w: Number = column("Largest w in the images (Baarda)", "", "w in images", ".1f", default=None)
    image_w_view: str | None = column("View that it is in", head="largest in", default=None)

    @classmethod
    def worst(cls, points: Sequence[GcpEntry], most: int) -> list[GcpEntry]:
        """At most so many points, in their order: those that are not used, and of the others the largest w."""
        order = sorted(points, key=lambda point: (point.used, -(point.w or 0.0)))[:most]
        return [point for point in points if any(point is one for one in order)]


class ControlTestEntry(Record):
    """The residuals of ground control, a reference's points too, in the images, each in units of its own deviation."""

    num: Count = column("Observations tested")
    critical: float = column("What chance exceeds once in a thousand coordinates")
    num_beyond: Count = column("Observations beyond that in a coordinate")
    expected: float = column("As many chance alone would put beyond it")
    largest_w: Number = column("The largest (Baarda's w)")
    image: str = column("The view that it is in")
    point: str = column("The point that it is of")


class ReferenceViewEntry(Record):
    """What a reference says of an image."""

    PAGE: ClassVar = "name peak offset_en_m num_tried num_passed num_points scatter_m"

    name: str = column("View", head="image")
    peak: Number = column("Standard deviations by which one shift stands out", "", "peak", ".1f")
    offset_en_m: Pixel | None = column(
        "Offset of the delivered camera, east, north", "m", ("off east", "north"), "+.2f"
    )
    num_tried: Count = column("Points looked for", head="points tried")
    num_passed: Count = column("That beat their decoy and came back", head="found")
    num_points: Count = column("That agree with each other and held the block", head="used")
    scatter_m: Number = column("Standard deviation of those across the line of sight", "m", "scatter", ".2f")


class ReferenceEntry(Record):
    """A reference orthoimage."""

    used: bool = column("Whether it holds the block")
    step_m: Number = column("Resolution at which it was matched", "m")
    sigma_m: Number = column("Standard deviation of its own place, along an axis", "m")
    num_points: Count = column("Points on the ground that hold the block")
    views: tuple[ReferenceViewEntry, ...] = column("What it says of each image")


class SeenEntry(Record):
    """Where a check point is seen."""

    view: str = column("Name")
    residual_px: Pixel = column("Projected minus observed col, row", "px")


def _gcp_rms(point: CheckPointEntry) -> float | None:
    return float(np.sqrt(np.mean(np.square(point.seen).sum(axis=1)))) if point.seen else None


class CheckPointEntry(KnownPoint):
    """A known point that stayed out of the adjustment."""

    OWN: ClassVar = {
        "point": Column("check point", lambda point: point.name),
        "images": Column("images", lambda point: len(point.seen)),
        "rms": Column("in the images [px]", _gcp_rms, ".3f"),
    }
    PAGE: ClassVar = "point images rms residual_enu_m"

    residual_enu_m: Vector = column(_MISS, "m", ("east", "north", "up"), "+.3f")
    observations: tuple[SeenEntry, ...] = column("Where it is seen")

    @property
    def seen(self) -> list[Any]:
        """Residuals in the images that see it."""
        return [seen.residual_px for seen in self.observations if None not in seen.residual_px]


# --- how they are measured --------------------------------------------------------------------------------


def measure_gcps(run: Run) -> tuple[GcpEntry, ...]:
    """Return the ground control, and what the adjustment said of it."""
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
    """Return every residual of control in the images in units of its own deviation; None without any."""
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
    """Return the places in `index` (n,) of each number below `num`."""
    order = np.argsort(index, kind="stable")
    return np.split(order, np.searchsorted(index[order], np.arange(1, num)))[:num]


def _shift_in_images(run: Run, given: Array, views: IntArray, residual: Array) -> float:
    """Return how far a residual (3,), east, north, up [m], moves a ground point in its images, RMS [px]."""
    if run.after is None or not np.isfinite(residual).all():
        return float("nan")
    moved = ground_from_ecef(ecef_from_ground(given) + residual @ enu_basis(given))
    moves = [run.after[v].project(moved) - run.after[v].project(given) for v in views]
    return float(np.sqrt(np.mean(np.square(moves).sum(axis=1)))) if moves else float("nan")


def measure_reference(run: Run) -> ReferenceEntry | None:
    """Return what an orthoimage said of each image; None without one."""
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
    """Return the points that stayed out of the adjustment: residuals in images, and the ground error."""
    points = run.check_points
    if points is None:
        return ()
    left = check_residuals(run.before if run.after is None else run.after, points)
    seen = [SeenEntry(run.views[i].name, r) for i, r in zip(points.view, left.image.tolist(), strict=True)]
    seen_of = [tuple(seen[row] for row in rows) for rows in _indices_by_number(points.point, len(points.names))]
    rows = zip(points.names, points.lonlatalt.tolist(), left.ground.tolist(), seen_of, strict=True)
    return tuple(CheckPointEntry(name, lon, lat, alt, miss, found) for name, (lon, lat, alt), miss, found in rows)
