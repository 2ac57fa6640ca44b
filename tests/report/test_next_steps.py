"""What a run says to do next: predictions against runs with the input that they speak of, and what is left unsaid."""

from __future__ import annotations

from dataclasses import replace

import click
import numpy as np
import pytest

from barpc import simulate
from barpc.ba import Adjustment, adjust_tracks
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis
from barpc.base.options import AdjustOptions, RunOptions
from barpc.cli import cli
from barpc.cli.terminal import print_summary
from barpc.export.targets import TARGETS
from barpc.report import Run, Summary, verdict
from barpc.report.next_steps import next_steps
from barpc.report.outcome import Added
from barpc.report.page import report_html
from barpc.report.summary import LeftOutEntry, StepEntry
from barpc.report.summary.words import CAUSES
from barpc.scene import GroundPoints
from barpc.simulate import Look, simulate_block

from .made import a_correction, a_gcp, a_pair, a_summary, a_view, files_of, section, seen
from .worlds import exact_cameras, on_terrain, seen_by

OFF = 1.5  # a prediction is right to this factor, both ways
OPTIONS = AdjustOptions(dem_sigma=2.0)


class Hills:
    """A terrain whose vertical datum is known, `off` metres too high."""

    known = True

    def __init__(self, off: float = 0.0) -> None:
        self.off = off

    def __call__(self, lon: Array, lat: Array) -> Array:
        return np.asarray(300.0 + self.off + 120.0 * np.sin(lon * 700.0) * np.cos(lat * 500.0))


class Case:
    """A block whose tie points lie on the hills, seen by the true cameras, and its ground control."""

    def __init__(self, views: int, **options: object) -> None:
        made, self.rng = simulate_block(views, 1200, seed=3, num_gcps=0, **options), np.random.default_rng(7)
        self.exact = exact_cameras(made)
        self.block = on_terrain(made, Hills()(*made.truth.ground[:, :2].T), self.rng)
        self.ground = self.block.truth.ground

    def control(self, num: int, wrong: float = 0.0) -> GroundPoints:
        """Points of 1 m and 0.5 px spread over the block; the first one `wrong` metres too far east."""
        tracks = self.block.tracks
        long = np.flatnonzero(np.bincount(tracks.point) == min(len(self.exact), 3))
        angle = 2.0 * np.pi * np.arange(num) / num
        at = (self.ground[:, :2] - self.ground[:, :2].mean(axis=0)) / self.ground[:, :2].std(axis=0)
        want = np.column_stack([np.cos(angle), np.sin(angle)])
        chosen = np.array([long[np.argmin(((at[long] - one) ** 2).sum(axis=1))] for one in want])
        rows = np.flatnonzero(np.isin(tracks.point, chosen))
        point = np.searchsorted(np.sort(chosen), tracks.point[rows])
        ground = self.ground[np.sort(chosen)].copy()
        xy = seen_by(self.exact, ground, point, tracks.view[rows]) + self.rng.normal(0.0, 0.5, (len(rows), 2))
        metre = np.array([1.0 / 81000.0, 1.0 / 111000.0, 1.0])
        ground += self.rng.normal(0.0, 1.0, ground.shape) * metre
        ground[0, 0] += wrong * metre[0]
        names = tuple(f"P{k}" for k in range(num))
        return GroundPoints(names, ground, np.ones((num, 3)), point, tracks.view[rows], xy, np.full(len(rows), 0.5))

    def adjusted(self, gcps: GroundPoints | None = None, dem: Hills | None = None) -> tuple[Summary, Adjustment]:
        block = self.block
        found = adjust_tracks(block.views, block.tracks, OPTIONS, gcps, dem)
        options = RunOptions(adjust=OPTIONS, gcp=("p.gcp",) if gcps else (), dem=("dem.tif",) if dem else ())
        written = tuple({f"{view.name}.vrt": {"gdal": 1e-9}, f"{view.name}_RPC.TXT": {}} for view in block.views)
        run = Run("adjust", block.views, (), block.tracks, adjustment=found, options=options, gcps=gcps)
        return verdict.summarize(replace(run, written=written)), found

    def off(self, found: Adjustment) -> Array:
        """How far the scene lies from its true place, east, north, up [m]."""
        moved = (found.points[: len(self.ground)] - ecef_from_ground(self.ground)) @ enu_basis(self.ground[0]).T
        return np.asarray(np.nanmean(moved, axis=0))


@pytest.fixture(scope="module", params=[(2, {}), (3, {}), (5, {"per_site": 5}), (3, {"attitude": 40e-6})], ids=str)
def case(request) -> Case:
    views, options = request.param
    return Case(views, **options)


def expected(summary: Summary) -> dict[str, tuple[float | None, ...]]:
    return {one.source: one.sigma_enu_m for step in summary.next for one in step.expected}


@pytest.mark.nightly
def test_a_dem_and_control_do_what_was_promised_of_them(case):
    plain, _ = case.adjusted()
    promised = expected(plain)
    assert set(promised) - {"image"} == {"dem", "gcps"}
    with_dem, by_dem = case.adjusted(dem=Hills(5.0))
    up = promised["dem"][2]
    assert up is not None
    assert 1 / OFF < by_dem.gauge.sigma[2] / up < OFF
    assert abs(case.off(by_dem)[2]) < 3.0 * up  # of heights that are 5 m too high
    _, by_gcps = case.adjusted(case.control(3))
    ratio = by_gcps.gauge.sigma / promised["gcps"]
    assert (ratio > 1 / OFF).all(), ratio
    assert (ratio < OFF).all(), ratio
    assert (np.abs(case.off(by_gcps)) < 4.0 * np.array(promised["gcps"], float)).all()
    # what was given is not asked for again, and what is left is told of the run as it is
    assert "dem" not in expected(with_dem)


@pytest.mark.landing(1)
@pytest.mark.few(1)
@pytest.mark.parametrize("between", [1.5, 6.0, 12.0, 20.0])
def test_a_third_image_does_to_the_height_what_was_promised_of_it(monkeypatch, between):
    """Of a pair of good angle a third one is not asked for."""
    half, third = np.tan(np.radians([between / 2.0, 10.0])) * [1.0, 2.0]
    slopes = [(-half, 0.0), (half, 0.0), (0.0, np.sqrt(third**2 - half**2))]
    looks = [Look(np.degrees(np.arctan(np.hypot(*t))), np.degrees(np.arctan2(*t)) % 360.0) for t in slopes]
    monkeypatch.setattr(simulate, "looks", lambda count, *_: looks[:count])
    (pair, _), (triplet, _) = (Case(n, per_site=n, attitude=3e-6).adjusted() for n in (2, 3))
    ratio = triplet.scene.sigma_enu_m[2] / pair.scene.sigma_enu_m[2]
    promised = expected(pair).get("image")
    if between == 20.0:
        assert promised is None
        assert ratio > 1 / OFF
    else:
        assert 1 / OFF < triplet.scene.sigma_enu_m[2] / promised[2] < OFF
    assert "image" not in expected(triplet)


def test_a_pair_that_widened_its_priors_is_too_uncertain_for_the_promise_of_an_image():
    """What a pair learns of priors is three times what three images learn."""
    pair, _ = Case(2, per_site=2, attitude=100e-6).adjusted()
    assert max(view.prior_scale for view in pair.views) > 2.0
    assert "image" not in expected(pair)
    as_stated = replace(pair, views=tuple(replace(view, prior_scale=1.0) for view in pair.views))
    narrow = replace(pair.pairs[0], base_to_height=0.1)
    steps = next_steps(replace(as_stated, pairs=(narrow,)))
    assert "image" in {one.source for step in steps for one in step.expected}


def kinds(summary: Summary) -> list[str]:
    return [step.kind for step in summary.next]


@pytest.fixture(scope="module")
def triplet() -> Case:
    return Case(3)


@pytest.fixture(scope="module")
def plain(triplet) -> Summary:
    """What is said of three images by themselves."""
    return triplet.adjusted()[0]


def test_a_clean_run_hands_over_its_files_and_names_no_part_to_review(plain):
    assert kinds(plain) == ["use", "improve"]
    use, improve = plain.next
    files = "view_0000.vrt, view_0001.vrt, view_0002.vrt"
    assert use.text.startswith(f"Use {files}. Best pair for heights: ")
    best = min(plain.pairs, key=lambda pair: pair.height_m_per_px)
    assert f"{best.a} - {best.b} (one pixel of parallax is " in use.text
    assert [command.split()[1:4] for command in use.commands] == [
        ["dsm", ".", "-o"], ["export", ".", "s2p"], ["ortho", ".", "-o"]
    ]  # fmt: skip
    for command in use.commands:
        verb = cli.get_command(click.Context(cli, **cli.context_settings), command.split()[1])
        assert verb is not None
        verb.make_context(None, command.replace(" . ", " adjusted ").split(" && ")[0].split()[2:])
    assert use.commands[1].split()[3] in TARGETS
    assert improve.part == "gauge"
    assert "--dem" in improve.text
    assert "--gcp" in improve.text


def test_a_run_with_good_control_asks_for_nothing(triplet):
    summary, _ = triplet.adjusted(triplet.control(5))
    assert summary.passed
    assert kinds(summary) == ["use"]


def test_with_a_dem_only_control_is_asked_for_and_with_wrong_control_the_part_that_shows_it(triplet):
    summary, _ = triplet.adjusted(dem=Hills())
    assert list(expected(summary)) == ["gcps"]
    wrong, _ = triplet.adjusted(triplet.control(5, wrong=60.0))
    assert not wrong.passed
    last = wrong.next[-1]
    assert (last.kind, last.part) == ("review", "gauge")
    assert any("P0" in reason for reason in wrong.reasons)
    assert wrong.next[0].text.startswith("After review, use")


def test_control_in_use_that_does_not_agree_promises_nothing(plain):
    assert expected(plain)
    torn = replace(plain, gcps=(a_gcp("P", 5.0, 43.0, status="contradicts"),))
    assert not {step.kind for step in next_steps(torn)} & {"improve"}


@pytest.mark.parametrize("motion", [None, float("nan")])
def test_a_covariance_that_is_not_known_promises_nothing(plain, motion):
    scene, first = plain.scene, plain.scene.weakest_modes[0]
    modes = (replace(first, motion_m=(motion, *first.motion_m[1:])), *scene.weakest_modes[1:])
    for some in (modes, scene.weakest_modes[:-1], ()):
        steps = next_steps(replace(plain, scene=replace(scene, weakest_modes=some)))
        assert not expected(replace(plain, next=steps))


def test_no_gain_is_promised_that_is_smaller_than_the_prediction_is_sure_of(plain):
    """A DEM that is wrong by more than the cameras are."""
    coarse = {**plain.options, "adjust": {"dem_bias_sigma": plain.scene.sigma_enu_m[2]}}
    steps = next_steps(replace(plain, options=coarse))
    assert [one.source for step in steps for one in step.expected] == ["gcps"]


def flagged_view(cause: str | None, name: str = "B", **fields):
    known = CAUSES.get(cause or "")
    status = known.status if known else "doubtful"
    return a_view(name, cause=cause, advice="something", status=status, outputs={f"{name}.vrt": {}}, **fields)


PARTS = {
    "map": "no_overlap untied few none few_gcps gap",
    "random": "contradicted systematic rejected wrong_matches place beside held_out left moving_objects",
    "moves": "foreign_camera odd",
    "files": "one_rpc_misses follows_more",
}
"""Part of the page -> the causes that it shows; others: the table of images."""


@pytest.mark.parametrize("cause", [*CAUSES, None])
def test_a_flagged_image_is_not_handed_over_and_the_part_that_shows_it_is_linked(cause):
    good = [a_view(name, outputs={f"{name}_RPC.TXT": {}, f"{name}.tif": {}}) for name in "AC"]
    views = [good[0], flagged_view(cause), good[1]]
    pairs = [a_pair("A", "B", height_m_per_px=0.1), a_pair("A", "C", height_m_per_px=2.0)]
    use, review = next_steps(a_summary(views, pairs, passed=False, status="look"))
    assert "A.tif" in use.text
    assert "C.tif" in use.text
    assert "B." not in use.text
    assert "A - C (one pixel of parallax is 2.0 m of height)" in use.text
    assert review.text.startswith("Review B (")
    views = [replace(view, correction=a_correction()) for view in views]
    files = files_of(a_summary(views, pairs), observed=seen([(0, 0, (0.0, 0.0), (1.0, 1.0), (0.1, 0.1), True)]))
    assert section(files, review.part) is not None
    assert review.part == next((part for part, causes in PARTS.items() if cause in causes.split()), "images")


def test_one_line_names_some_of_three_hundred_images_and_counts_the_others():
    views = [a_view(f"v{k:03d}", outputs={f"v{k:03d}.vrt": {}}) for k in range(280)]
    views += [flagged_view("few", f"w{k:02d}") for k in range(20)]
    views += [flagged_view("contradicted", f"x{k:02d}") for k in range(3)]
    steps = next_steps(a_summary(views, passed=False, status="look"))
    assert all(len(step.text) < 250 for step in steps)
    assert "then 20 more images" in steps[-1].text


def test_one_image_is_handed_over_for_an_orthoimage_and_for_no_surface():
    (use,) = next_steps(a_summary([a_view("A", outputs={"A.vrt": {}})]))
    assert len(use.commands) == 1
    assert "ortho" in use.commands[0]
    assert "Best pair" not in use.text


def test_nothing_is_handed_over_of_a_run_that_wrote_nothing():
    assert not next_steps(a_summary([a_view("A"), a_view("B")], [a_pair()]))


@pytest.mark.parametrize("contradicted", [None, ("A", 0.3, 0.1)])
@pytest.mark.parametrize("moved", [(), (("old", 4.385),)])
def test_new_cameras_are_used_with_old_ones_that_they_fit(moved, contradicted):
    """A run that added A; `old` is an image of the earlier run."""
    added = Added("first", 3, 3, moved, ("old", 4.385), 0.02, updated=False, contradicted=contradicted)
    (use,) = next_steps(a_summary([a_view("A", outputs={"A.vrt": {}})]), added)
    if contradicted:
        assert use.text == "Run again with --update: cameras of first and new ones do not agree."
        assert not use.commands
    else:
        assert use.text == "Use A.vrt."
    assert not next_steps(a_summary([a_view("A")]), added)  # no camera was written


def test_files_that_were_left_out_and_reservations_of_the_block_are_reviewed():
    views = [a_view("A"), a_view("B")]
    summary = a_summary(views, passed=False, reasons=("x " * 300,))
    (step,) = next_steps(summary)
    assert step.part == "decisions"
    assert len(step.text) <= 160
    of_dem = "The DEM was not used: its relief is 0.1 times that of the tie points. Check its place."
    (step,) = next_steps(replace(summary, reasons=(of_dem,)))
    assert step.text == "Review: The DEM was not used."
    (step,) = next_steps(replace(summary, reasons=("p7 is outside of all images.", of_dem, of_dem)))
    assert step.text == "Review: p7 is outside of all images (and 2 more reservations)."
    (step,) = next_steps(replace(summary, left_out=(LeftOutEntry("c.tif", "no RPC"),)))
    assert "c.tif" in step.text


@pytest.mark.parametrize(("kind", "cause", "words"), [
    ("check", "disagrees", "barpc adjust IMAGE... -o adjusted"),
    ("match", None, "barpc adjust IMAGE... --matches matches.npz --matches-only -o adjusted"),
])  # fmt: skip
def test_a_check_and_matches_lead_to_an_adjustment(kind, cause, words):
    views = [flagged_view(cause) if cause else a_view("B"), a_view("A")]
    assert next_steps(a_summary(views, kind=kind))[0].commands == (words,)


def test_a_check_of_cameras_that_agree_has_no_next_step():
    assert not next_steps(a_summary([a_view("A"), a_view("B")], [a_pair()], kind="check"))


def test_the_terminal_ends_with_the_steps_and_the_folder_that_was_written(plain, capsys):
    print_summary(replace(plain, out_dir="a run"))
    lines = capsys.readouterr().out.splitlines()
    commands = ["dsm 'a run' -o dsm.tif", "export 'a run' s2p --to s2p", "ortho 'a run' -o ortho"]
    assert lines[-5:] == [plain.next[0].text, *(f"  barpc {one}" for one in commands), plain.next[1].text]


def test_the_page_shows_the_steps_before_its_questions_and_links_to_parts_that_it_has(block_run):
    pytest.importorskip("jinja2")
    steps = (StepEntry("use", "Use <it>.", ("barpc dsm . -o dsm.tif",)), StepEntry("review", "Look.", part="gauge"))
    html = report_html(replace(block_run.record, next=steps), block_run.folder)
    box = html[html.index('<div class="next">') : html.index("<nav")]
    assert "<li>Use &lt;it&gt;. In this folder: <code>barpc dsm . -o dsm.tif</code></li>" in box
    assert '<li>Look. <a href="#gauge">' in box
    assert '<section id="gauge"' in html
    gone = (replace(steps[1], part="accuracy"),)  # there are no check points
    assert '<a href="#accuracy">' not in report_html(replace(block_run.record, next=gone), block_run.folder)
    assert '<div class="next">' not in report_html(replace(block_run.record, next=()), block_run.folder)


@pytest.mark.parametrize("apart", [0.05, 0.15, 0.25])
def test_a_third_line_of_sight_tells_of_the_height_what_least_squares_say(apart):
    """Of points seen along lines of slopes t: places on the ground are x + t h, of one accuracy each."""
    pair, _ = Case(2, per_site=2, attitude=3e-6).adjusted()
    far = 2.0 * np.tan(np.radians(10.0))
    slopes = np.array([[-apart / 2.0, 0.0], [apart / 2.0, 0.0], [0.0, np.sqrt(far**2 - apart**2 / 4.0)]])
    sigma = []
    for count in (2, 3):
        rows = np.vstack([np.column_stack([np.eye(2), slope]) for slope in slopes[:count]])
        sigma.append(np.sqrt(np.linalg.inv(rows.T @ rows)[2, 2]))
    as_narrow = replace(pair, pairs=(replace(pair.pairs[0], base_to_height=apart),))
    (found,) = [one for step in next_steps(as_narrow) for one in step.expected if one.source == "image"]
    assert found.sigma_enu_m[2] / pair.scene.sigma_enu_m[2] == pytest.approx(sigma[1] / sigma[0], rel=1e-6)
