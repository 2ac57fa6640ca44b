"""What is measured of views, pairs and known points: against figures by hand, with cameras that are simple."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.interior import Calibration
from barpc.ba.robust.systematic_residuals import SmoothTest
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
from barpc.report import Run, summarize
from barpc.report import outcome as runs
from barpc.report.measures.block import measure_scene
from barpc.report.measures.ground_points import measure_check_points, measure_control, measure_gcps, measure_reference
from barpc.report.measures.pairs import MAX_PER_PAIR
from barpc.report.measures.views import ce90, measure_views, rmse_by_view
from barpc.report.outcome import ControlResidual, pair_ties, triangulate_tracks
from barpc.report.records import json_form
from barpc.report.summary.ground_points import GcpEntry
from barpc.report.summary.views import cell_numbers
from barpc.scene import Tracks, middle_altitude
from barpc.sensor.image_corrections import Calibrated, ColumnSpline, RowSpline, Splined
from barpc.sensor.triangulation import epipolar_offset
from barpc.tie.detail import Gap
from barpc.tie.reference import ReferenceControl, ViewMatch
from tests.distributions import norm

from .made import a_gcp
from .worlds import only


def tracks_of(*rows: tuple[int, int, float, float], sigma: float = 0.1) -> Tracks:
    """Rows of point, view, col, row."""
    point, view, col, row = (np.array(column) for column in zip(*rows, strict=True))
    return Tracks(view, point, np.column_stack([col, row]), np.full(len(rows), sigma))


# --- tie points -------------------------------------------------------------------------------------------


def test_pairs_have_the_observations_of_the_tracks_that_both_see():
    tracks = tracks_of((0, 0, 1, 1), (0, 1, 2, 2), (0, 2, 3, 3), (1, 1, 4, 4), (1, 2, 5, 5), (2, 0, 6, 6), (2, 2, 7, 7))
    found = {ties.views: (ties.a.tolist(), ties.b.tolist()) for ties in pair_ties(tracks)}
    assert found == {(0, 1): ([0], [1]), (0, 2): ([0, 5], [2, 6]), (1, 2): ([1, 3], [2, 4])}
    assert list(found) == sorted(found)
    keep = np.array([1, 1, 0, 1, 1, 1, 1], bool)
    found = {ties.views: (ties.a.tolist(), ties.b.tolist()) for ties in pair_ties(tracks, keep)}
    assert found == {(0, 1): ([0], [1]), (0, 2): ([5], [6]), (1, 2): ([3], [4])}
    none = Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))
    assert pair_ties(none) == []


def copies(shift=(12.0, -7.0), num=20, others=0, off=0.0, sizes=((500, 500), (500, 500))):
    """The copies of two views whose matches have one shift, but for `others` of them."""
    xy = np.random.default_rng(2).uniform(0, 500, (num, 2))
    second = xy + shift + off
    second[:others] += 3.3
    tracks = Tracks(
        np.tile([0, 1], num), np.repeat(np.arange(num), 2), np.stack([xy, second], 1).reshape(-1, 2), np.ones(2 * num)
    )
    views = tuple(SimpleNamespace(name=name, size=size) for name, size in zip("AB", sizes, strict=True))
    return Run("check", views, (), tracks).copies  # type: ignore[arg-type]


def test_a_copy_is_an_image_whose_matches_have_one_whole_shift():
    assert copies() == {"A": "B, moved by 12 columns and -7 rows", "B": "A, moved by -12 columns and 7 rows"}
    assert copies(shift=(0.0, 0.0)) == {
        "A": "B, moved by 0 columns and 0 rows",
        "B": "A, moved by 0 columns and 0 rows",
    }
    assert copies(off=0.04)
    assert not copies(off=0.06)
    assert copies(shift=(0.0, -240.0))
    assert not copies(shift=(0.0, -260.0))  # the next frame of a pass
    assert copies(shift=(-300.0, -280.0), sizes=((500, 500), (150, 200)))  # a part
    assert copies(off=-0.04)
    assert not copies(num=19)
    assert copies(others=2)  # nine of ten
    assert not copies(others=3)
    assert (runs.WHOLE_PIXEL_TOLERANCE, runs.MIN_WHOLE_SHARE, runs.MIN_COPY_MATCHES) == (0.05, 0.9, 20)


def test_errors_of_a_view_are_the_root_of_the_mean_square_distance():
    residuals = np.array([[3.0, 4.0], [0.0, 0.0], [np.nan, 1.0], [1.0, 0.0]])
    found = rmse_by_view(residuals, np.array([0, 0, 0, 2]), 3)
    np.testing.assert_allclose(found, [np.sqrt(12.5), np.nan, 1.0])


def test_cells_are_counted_by_rows_from_the_corner_of_the_first_pixel():
    xy = np.array([[-0.5, -0.5], [99.4, 0.0], [99.6, 0.0], [0.0, 49.6], [799.4, 399.4], [900.0, -90.0]])
    assert cell_numbers(xy, (800, 400)).tolist() == [0, 0, 1, 8, 63, 7]
    sizes = np.array([[800, 400], [80, 40]])
    assert cell_numbers(np.array([[150.0, 60.0], [15.0, 6.0]]), sizes).tolist() == [9, 9]


@pytest.mark.parametrize("minor", [0.0, 0.05, 0.2, 0.5, 0.9, 1.0])
def test_the_circle_of_ninety_per_cent_is_that_of_an_integral(minor):
    """The integral over the angle of what lies within a radius, in closed form along the radius."""
    radius, angle = ce90(1.0, minor), (np.arange(20000) + 0.5) / 20000 * np.pi
    if not minor:
        assert ce90(0.0, 0.0) == 0.0
        assert radius == pytest.approx(norm.ppf(0.95), abs=2e-5)
        return
    inverse = np.cos(angle) ** 2 + (np.sin(angle) / minor) ** 2
    inside = np.mean((1.0 - np.exp(-0.5 * radius**2 * inverse)) / (inverse * minor))
    assert inside == pytest.approx(0.9, abs=1e-5)
    assert ce90(3.0, 3.0 * minor) == pytest.approx(3.0 * radius)


@pytest.mark.parametrize("axis", [0, 1])
def test_rows_with_few_tie_points_are_placed_by_the_new_camera(check_run, block_run, axis: int) -> None:
    """From the first row's upper edge to the last one's lower edge, on the ground of the scene."""
    for finished in (check_run, block_run):
        run = replace(finished.run)
        run.__dict__["gaps"] = {1: Gap(axis, 100.0, 199.0, 0, 50)}
        first, second = measure_views(run)[:2]
        assert first.gap is None
        corners = np.array(second.gap)
        model, (width, height) = (run.after or run.before)[1], run.views[1].size
        low, high = corners[:, 2:].min(axis=0), corners[:, 2:].max(axis=0)
        wanted = [[-0.5, -0.5], [width - 0.5, height - 0.5]]
        wanted[0][axis], wanted[1][axis] = 99.5, 199.5
        assert [low.tolist(), high.tolist()] == wanted
        ground = np.column_stack([corners[:, :2], np.full(4, run.altitude)])
        assert model.project(ground) == pytest.approx(corners[:, 2:], abs=1e-3)
        x, y = corners[:, 2:].T
        assert 0.5 * abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) == pytest.approx((high - low).prod())  # a ring


@pytest.mark.parametrize("rows", [50, 333])
def test_tracks_are_intersected_alike_in_parts_of_any_size(block_run, sized, rows):
    run = block_run.run
    keep = run.keep & (np.arange(len(run.tracks)) % 7 > 0) & (run.tracks.point > 3)
    whole = triangulate_tracks(run.tracks, run.after, run.altitude, keep)
    sized(observations_intersected=rows)
    parts = triangulate_tracks(run.tracks, run.after, run.altitude, keep)
    assert (parts.ok == whole.ok).all()
    assert not parts.ok[:4].any()
    assert np.nanmax(np.abs(parts.points - whole.points)) < 1e-6
    assert (np.isnan(parts.residuals) == np.isnan(whole.residuals)).all()
    assert np.nanmax(np.abs(parts.residuals - whole.residuals)) < 1e-6


def test_a_track_is_intersected_from_what_counts_and_the_rest_is_measured_against_it(block_run):
    """Outliers do not bend the points that errors are measured at."""
    run, tracks = block_run.run, block_run.run.tracks
    keep, xy = run.keep.copy(), tracks.xy.copy()
    long = np.flatnonzero(np.bincount(tracks.point[keep]) > 2)[0]
    away = np.flatnonzero((tracks.point == long) & keep)[0]
    keep[away] = False
    xy[away] += [30.0, -40.0]
    found = triangulate_tracks(replace(tracks, xy=xy), run.after, run.altitude, keep)
    assert found.points.shape == (tracks.num_points, 3)
    counted = np.bincount(tracks.point[keep], minlength=tracks.num_points) > 1
    assert np.isnan(found.points[~counted]).all()
    clean, kept = tracks.select(keep), keep & counted[tracks.point]
    alone = triangulate_tracks(clean, run.after, middle_altitude(run.views), np.ones(len(clean), dtype=bool))
    assert np.abs(found.residuals[kept] - alone.residuals).max() < 1e-6
    assert np.abs((run.ties_after.residuals - found.residuals)[kept & (tracks.point != long)]).max() < 1e-6
    assert np.hypot(*found.residuals[away]) == pytest.approx(50.0, abs=3.0)


def test_the_tables_hold_every_so_many_th_track(sized, block_run):
    run = replace(block_run.run)
    usable = np.flatnonzero(np.isfinite(run.ground).all(axis=1))
    assert runs.MAX_TRACKS == 200_000
    for most, step in ((len(usable), 1), (len(usable) - 1, 2), (len(usable) // 2 - 1, 3)):
        sized(tracks_in_tables=most)
        assert run.written_tracks.tolist() == usable[::step].tolist()


def test_a_summary_counts_tie_points_by_the_views_that_see_them(check_run):
    tracks = tracks_of(
        *((p, v, 10.0 * p, 5.0) for p, views in enumerate([(0, 1), (0, 1, 2), (1, 2), (0, 2)]) for v in views)
    )
    run = Run("check", check_run.views, (), tracks)
    found = summarize(run)
    assert found.tracks.by_length == {"2": 3, "3": 1}
    assert (found.tracks.num_tracks, found.tracks.num_observations) == (4, 9)
    assert found.tables.num_usable_tracks == np.isfinite(run.ground).all(axis=1).sum()
    assert found.tables.complete
    assert [view.tie_coverage for view in found.views[:4]] == [1 / 64, 1 / 64, 1 / 64, 0.0]
    assert [view.num_observations for view in found.views[:4]] == [3, 3, 3, 0]
    assert found.scene is found.control_test is found.reference is None


# --- pairs ------------------------------------------------------------------------------------------------


def test_the_offset_of_a_pair_is_measured_on_a_thousand_matches_evenly(block_run, sized):
    assert MAX_PER_PAIR == 1000
    run = block_run.run
    ties = max(pair_ties(run.tracks), key=lambda one: len(one.a))  # all that were verified
    sized(matches_measured=40)
    found = summarize(run).pairs[[one.views for one in run.pairs].index(ties.views)].epipolar_after
    picks = np.linspace(0, len(ties.a) - 1, 40).astype(int)
    i, j = ties.views
    a, b = run.tracks.xy[ties.a[picks]], run.tracks.xy[ties.b[picks]]
    offset, _ = epipolar_offset(run.after[i], run.after[j], a, b, 0.0, steps=20)
    assert found.count == 40
    assert found.median == pytest.approx(np.median(offset), abs=1e-7)
    assert found.spread == pytest.approx(1.4826 * np.median(np.abs(offset - np.median(offset))), rel=1e-5)
    assert found.rms == pytest.approx(np.sqrt(np.mean(offset**2)), rel=1e-5)


# --- known points -----------------------------------------------------------------------------------------


def test_worst_gcps_are_those_not_used_then_those_of_the_largest_w():
    points = [a_gcp(f"P{k}", 0, 0, w=float(k)) for k in range(25)]
    assert [point.name for point in GcpEntry.worst(points, 20)] == [f"P{k}" for k in range(5, 25)]
    points[2] = a_gcp("P2", 0, 0, w=None, used=False)
    assert [point.name for point in GcpEntry.worst(points, 20)] == ["P2", *(f"P{k}" for k in range(6, 25))]
    assert GcpEntry.worst(points[:3], 20) == points[:3]


def test_a_gcp_is_seen_where_it_is_and_its_residual_is_carried_into_the_images(block_run):
    run = block_run.run
    points, tested = run.gcps, run.adjustment.control
    for g, entry in enumerate(measure_gcps(run)):
        views = points.view[points.point == g]
        assert entry.images == tuple(run.views[v].name for v in views)
        assert (entry.lon, entry.lat, entry.alt_m) == tuple(points.lonlatalt[g])
        assert entry.sigma_m == points.sigma[g].tolist()
        assert (entry.w, entry.redundancy) == (tested.w[g], tested.redundancy[g])
        at = points.lonlatalt[g]
        moved = ground_from_ecef(ecef_from_ground(at) + enu_basis(at).T @ tested.residual[g])
        moves = [np.hypot(*(run.after[v].project(moved) - run.after[v].project(at))) for v in views]
        assert entry.residual_px == pytest.approx(np.sqrt(np.mean(np.square(moves))), rel=1e-6)


def test_a_gcp_that_no_image_shows_is_not_seen_and_one_rejected_is_not_used(block_run):
    run = block_run.run
    keep = run.gcps.point != 2
    tested = run.adjustment.control
    control = replace(tested, used=np.arange(6) != 1, w=np.where(np.arange(6) == 3, 9.0, 1.0))
    adjustment = replace(run.adjustment, control=control, gcp_w=run.adjustment.gcp_w[keep])
    found = measure_gcps(replace(run, gcps=only(run.gcps, keep), adjustment=adjustment))
    status = ["used", "rejected", "not seen", "contradicts", "used", "used"]
    assert [entry.status for entry in found] == status
    assert [entry.used for entry in found] == [True, False, False, True, True, True]
    assert found[2].images == ()
    assert np.isnan(found[2].residual_px)
    before = measure_gcps(replace(run, adjustment=None, fits=()))
    assert {entry.status for entry in before} == {"used"}
    assert all(np.isnan(entry.residual_px) and entry.w is None for entry in before)
    assert measure_gcps(replace(run, gcps=None)) == ()


def control_run(*tests: tuple[int, str, float]) -> Any:
    return SimpleNamespace(
        control_tests=[ControlResidual(*test) for test in tests], views=[SimpleNamespace(name=n) for n in "ABC"]
    )


def test_the_residuals_of_control_beyond_what_chance_allows_are_counted():
    found = measure_control(control_run((0, "P", 3.29), (2, "Q", 3.3), (1, "R", 1.0)))
    assert (found.num, found.critical, found.num_beyond, found.largest_w) == (3, pytest.approx(3.29, abs=1e-3), 1, 3.3)
    assert (found.image, found.point) == ("C", "Q")
    inside = 1.0 - 1e-3
    assert found.expected == pytest.approx(3 * (1.0 - inside**2), rel=1e-9)
    assert measure_control(control_run()) is None


def test_residuals_that_could_not_be_tested_are_none_and_a_reference_s_points_are_control_too():
    gcps = SimpleNamespace(view=np.array([0, 1]), point=np.array([0, 0]), names=("P",))
    points = SimpleNamespace(view=np.array([2]), point=np.array([1]), names=("x", "R"))
    adjustment = SimpleNamespace(gcp_w=np.array([1.5, np.nan]), reference_w=np.array([2.5]))
    run = Run("adjust", (), (), None, adjustment=adjustment, gcps=gcps)
    assert run.control_tests == [ControlResidual(0, "P", 1.5)]
    reference = SimpleNamespace(control=SimpleNamespace(points=points))
    run = Run("adjust", (), (), None, adjustment=adjustment, gcps=gcps, reference=reference)
    assert run.control_tests == [ControlResidual(0, "P", 1.5), ControlResidual(2, "R", 2.5)]
    assert Run("check", (), (), None, gcps=gcps).control_tests == []
    assert Run("adjust", (), (), None, adjustment=adjustment).control_tests == []  # ties alone


def test_a_reference_is_said_to_hold_the_points_that_were_kept():
    points = SimpleNamespace(view=np.array([0, 0, 2, 0]), point=np.array([0, 1, 1, 2]))
    matches = (
        ViewMatch("A", 9.0, (1.0, -2.0), 50, 30, 3, 0.4),
        ViewMatch("B", 2.0, (7.0, 7.0), 40),
        ViewMatch("C", 8.0, (0.5, 0.0), 9, 8, 1, 0.3),
    )
    found = ReferenceControl(SimpleNamespace(points=points), matches, 0.5, 1.25)
    adjustment = SimpleNamespace(reference_inlier=np.array([True, True, True, False]))
    run = SimpleNamespace(reference=found, adjustment=adjustment, views=[0, 0, 0])
    entry = measure_reference(run)
    assert (entry.used, entry.step_m, entry.sigma_m, entry.num_points) == (True, 0.5, 1.25, 2)
    assert [view.num_points for view in entry.views] == [2, 0, 1]
    assert [view.offset_en_m for view in entry.views] == [(1.0, -2.0), None, (0.5, 0.0)]
    first = entry.views[0]
    assert (first.name, first.peak, first.num_tried, first.num_passed, first.scatter_m) == ("A", 9.0, 50, 30, 0.4)
    unused = measure_reference(
        SimpleNamespace(reference=replace(found, control=None), adjustment=adjustment, views=[0, 0, 0])
    )
    assert (unused.used, unused.num_points, [view.num_points for view in unused.views]) == (False, 0, [0, 0, 0])
    assert not measure_reference(SimpleNamespace(reference=found, adjustment=None, views=[0, 0, 0])).used
    assert measure_reference(SimpleNamespace(reference=None, adjustment=adjustment)) is None


@pytest.mark.slow
def test_check_points_are_measured_with_the_new_cameras_or_the_old_ones(block_run):
    run = replace(block_run.run, gcps=None, check_points=block_run.run.gcps)
    points = run.check_points
    for sensors, changed in ((run.after, run), (run.before, replace(run, adjustment=None, fits=()))):
        entries = measure_check_points(changed)
        assert [entry.name for entry in entries] == list(points.names)
        for g, entry in enumerate(entries):
            rows = np.flatnonzero(points.point == g)
            assert [seen.view for seen in entry.observations] == [run.views[points.view[k]].name for k in rows]
            for k, seen in zip(rows, entry.observations, strict=True):
                off = sensors[points.view[k]].project(points.lonlatalt[g]) - points.xy[k]
                assert seen.residual_px == pytest.approx(off, abs=1e-9)
    assert measure_check_points(block_run.run) == ()


# --- what was left, and decided by ------------------------------------------------------------------------


def test_what_asked_for_more_is_the_image_with_the_largest_part_that_is_no_chance(block_run):
    run = block_run.run

    def asking(rms, significance, shared, what="drift"):
        """What is said of three of the images; of the others there is nothing."""
        given = (rms, 0.0), (significance, 1.0), ([0.0] * 3, 0.0), (shared, 0.0)
        test = SmoothTest(*(np.append(values, np.full(6, rest)) for values, rest in given))
        return measure_scene(replace(run, adjustment=replace(run.adjustment, asked={what: test})))

    names, chance = [view.name for view in run.views], [1e-3, 1e-9, 1e-5]
    scene = asking([0.9, 0.4, 0.3], chance, [0.1, 0.0, 0.35])
    found = scene.drift_justification
    assert (found.image, found.systematic_px, found.systematic_p) == (names[1], 0.4, 1e-9)
    assert (found.neighbour_correlated_px, found.num_images) == (0.0, 2)
    assert asking([0.9, 0.4, 0.3], chance, [0.5, 0.0, 0.35]).drift_justification.image == names[0]
    at = asking([0.9, 0.4, 0.3], [1e-4, 0.99e-4, 1.0], [0.1, 0.0, 0.35], "jitter")
    assert at.jitter_justification.num_images == 1
    assert scene.jitter_justification is at.drift_justification is None


def followed(run: Run, spline: RowSpline) -> dict[str, Any]:
    """What the summary says of corrections in the image of a view, whose camera has this one."""
    first, *others = run.adjustment.sensors
    changed = replace(run, adjustment=replace(run.adjustment, sensors=(Splined(first, spline), *others)))
    entries = [json_form(view.correction) for view in measure_views(changed)[:2]]
    found, without = (
        {key: one[key] for key in one if re.match("jitter|detector|step_|sinusoid", key)} for one in entries
    )
    assert without == {}
    return found


def test_what_follows_in_the_image_is_the_rms_over_its_rows_and_of_its_steps(block_run):
    """A spline that is a straight line, from -3 px in the first row to 3 px in the last: over the root of three."""
    run, line, steps = block_run.run, np.array([-9.0, -3.0, 3.0, 9.0])[:, None] * [0.6, 0.8], np.zeros((3, 2))
    steps[1:] = (3.0, 4.0), (0.0, -1.0)
    plain = followed(run, RowSpline(line, 500.0, 400.0))
    assert plain == {"jitter_px": pytest.approx(3.0 / np.sqrt(3.0), rel=3e-3), "jitter_rows": 800.0}
    both = followed(run, RowSpline(line, 500.0, 400.0, np.array([99.5, 199.5]), steps))
    detectors = {"detector_px": pytest.approx(np.sqrt(26.0 / 3.0)), "detectors": [100.0, 200.0]}
    assert both == {**plain, **detectors}  # the steps are no part of the jitter
    alone = followed(run, RowSpline(np.zeros((0, 2)), 0.0, 1.0, np.array([9.5]), steps[:2]))
    assert set(alone) == {"detector_px", "detectors"}
    strips = {"steps": np.zeros((2, 5)), "step_sizes": np.array([[3.0, 4.0], [0.0, 1.0]])}
    swings = {
        "periods": np.array([90.0, 70.0]),
        "amplitudes": np.array([[[0.3, 0.0], [0.0, 0.4]], [[0.0, 0.0], [1.2, 0.0]]]),
    }
    assert followed(run, RowSpline(np.zeros((0, 2)), **strips, **swings)) == {
        "step_px": pytest.approx(np.sqrt(26.0 / 2.0)),
        "sinusoid_px": pytest.approx(1.3),
        "sinusoid_rows": [90.0, 70.0],
    }


def test_places_are_brought_back_to_where_cameras_without_a_calibration_see_them(block_run):
    run = block_run.run
    spline = ColumnSpline(20_000, np.random.default_rng(1).normal(0, 2.0, (28, 2)))
    used = replace(run, calibrated={run.views[1].name: replace(Calibration.prior("A", 20_000), spline=spline)})
    xy = np.array([[100.0, 5.0], [7000.0, 9.0], [300.0, 3.0], [19_000.0, 7.0]])
    found = used.undistorted(np.array([0, 1, 2, 1]), xy)
    np.testing.assert_allclose(xy - found, np.where([[0], [1], [0], [1]], spline.at(xy[:, 0]), 0.0), atol=1e-12)
    np.testing.assert_array_equal(run.undistorted(np.array([0, 1, 2, 1]), xy), xy)
    assert isinstance(used.cameras[1], Calibrated)
    assert used.cameras[0] is run.cameras[0]


def test_parts_without_ties_are_those_of_the_image_that_has_detail_there(block_run):
    run = block_run.run
    size = run.views[1].size
    lost = (run.tracks.view == 1) & (run.tracks.xy[:, 1] < 0.3 * size[1])
    bare = replace(run, tracks=run.tracks.select(~lost), detail=tuple(np.full((2, 64), 300) for _ in run.views))
    ((view, one),) = bare.gaps.items()
    assert (view, one.axis) == (1, 1)
    assert (one.first, one.last) == pytest.approx((0.0, 0.3 * size[1]), abs=0.06 * size[1])
    assert replace(bare, detail=()).gaps == {}
