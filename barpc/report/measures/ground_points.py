"""Points of given position (GCPs, reference, check points), measured."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from barpc.ba import check_residuals
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.base.statistics import CHANCE
from barpc.report.outcome import Run
from barpc.report.summary.ground_points import (
    CheckPointEntry,
    ControlTestEntry,
    GcpEntry,
    ReferenceEntry,
    ReferenceViewEntry,
    SeenEntry,
)
from barpc.scene import IntArray


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
