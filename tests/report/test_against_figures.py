"""Every sentence of a report against the figures beside it, over runs of all kinds.

A sentence without a row of `SENTENCES` fails: whoever adds one says what it must agree with.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from html import unescape
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

pytest.importorskip("jinja2")

from barpc.base.errors import listed
from barpc.report import Run, Summary
from barpc.report.page import SECTIONS
from barpc.report.records import json_form
from barpc.report.runfiles import ObservationTable, RunFiles
from barpc.report.summary import published_schema
from barpc.report.summary.block import DatumEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import enu, metres, two_digits
from barpc.report.verdict import summarize
from tests.lanes import rest_slow
from tests.report.worlds import WORLDS

NUM = r"([-+\d.e]+)"
LENGTH = r"([-+\d.]+ (?:m|cm|mm))"
SENTENCES: dict[str, Callable[..., Any]] = {}
"""Pattern of a sentence -> what it must agree with: asserted, or returned."""


def says(pattern: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register what a sentence must agree with: called with the summary and the groups of the pattern."""

    def register(check: Callable[..., None]) -> Callable[..., None]:
        SENTENCES[pattern] = check
        return check

    return register


def near(text: str, value: float | None) -> bool:
    """Assert that a number as written is the figure, to its digits."""
    digits = len(text.partition("e")[0].partition(".")[2])
    assert value is not None
    assert float(text) == pytest.approx(value, abs=0.51 * 10.0**-digits, rel=0.06 if "e" in text else 1e-9)
    return True


def median(values) -> float:
    return float(np.median([value for value in values if value is not None]))


def share(summary: Summary, *sources: str, parts: tuple[str, ...] = ("east", "north", "up")) -> list[float]:
    rows = [one for one in summary.scene.datum if one.part in parts]
    return [sum(getattr(one, source) or 0.0 for source in sources) for one in rows]


def used_gcps(s: Summary) -> int:
    return sum(gcp.used and gcp.status not in ("not seen", "rejected", "undecided") for gcp in s.gcps)


OTHERS = [name for name in DatumEntry.__dataclass_fields__ if name not in ("part", "sigma_m", "cameras", "heights")]


SENTENCES |= {
    r"There are no tie points: control alone constrains the cameras\.": lambda s: (
        s.tracks.num_observations == 0 and used_gcps(s) > 0
    ),
    r"There are no tie points: nothing shows whether the cameras agree\.": lambda s: (
        s.tracks.num_observations == 0 and all(view.rmse_before is None for view in s.views)
    ),
    r"There are no tie points in use\.(?: Connected .*)?": lambda s: not s.pairs,
    r"(\d+) tie points? of (\d+) images?, (\d+) observations?\.": lambda s, *counts: (
        [*map(int, counts)] == [s.tracks.num_tracks, len(s.views), s.tracks.num_observations]
    ),
    r"The adjustment moved the scene by ([-+].* up)\.": lambda s, shift: shift == enu(s.scene.shift_enu_m),
    r"Only (\S+) shows GCPs that are used: .*": lambda s, image: (
        {name for gcp in s.gcps if gcp.status in ("used", "contradicts") for name in gcp.images} == {image}
    ),
    r"By the reference, the delivered cameras are off by (.*)\.": lambda s, offsets: (
        offsets
        == listed([f"{np.hypot(*v.offset_en_m):.1f} m ({v.name})" for v in s.reference.views if v.offset_en_m], 5)
    ),
    r"The reference does not show .* and was not used: check .*": lambda s: not s.reference.used,
    rf"DEM errors are correlated: {NUM} points count as one\.": lambda s, alike: near(
        alike, s.scene.dem.correlated_per_independent
    ),
    r"(\d+) images? added to the (\d+) images? of (.*); (\d+) of these have new tie points\.": lambda s, new, old, *_: (
        int(new) + int(old) == len(s.views)
    ),
    r"(\S+) was left out: .*": lambda s, path: path in {file.path for file in s.left_out},
    r"p7 is outside of all images\.": lambda s: s.status != "good",
    r"Review (?!the )(.*?)(?: and \d+ more)? \((.*?)\).*\.": lambda s, names, _label: (
        {*names.split(", ")} <= {view.name for view in s.views if view.advice}
    ),
    r"Tie points were given: nothing was matched\.": lambda s: s.pairs and not any(pair.tied_by for pair in s.pairs),
    r"Each camera is corrected by (.*)\.": lambda s, model: model == s.scene.model.replace("+", " and "),
    r"No further parameters of the images were selected\.": lambda s: not s.scene.explanations,
    r"None of the additional parameters that were tested explains the inconsistent residuals\.": lambda s: (
        s.scene.left or s.scene.held_out_places or any(view.cause for view in s.views)
    ),
    r"The degree of the attitude drift, (\d+), was set by an option\.": lambda s, degree: (
        int(degree) == s.scene.drift_degree == s.options["adjust"]["drift"]
    ),
    rf"The largest shift at an image centre is {NUM} px\. The sigmas in the tables include .*": lambda s, most: near(
        most, max(np.hypot(*view.correction.center_shift_px) for view in s.views)
    ),
}


@says(rf"Tie points of (\d+) images? have residuals of {NUM} px \(median of the images' RMS(?:; before: {NUM} px)?\)\.")
def _(s, num, after, before):
    assert int(num) == sum(view.num_observations > 0 for view in s.views)
    near(after, median(view.rmse_after for view in s.views))
    assert before is None or near(before, median(view.rmse_before for view in s.views))


@says(
    rf"Tie points of (\d+) images? have residuals of {NUM} px with the cameras as given \(median of the images' RMS\)\."
)
def _(s, num, now):
    assert int(num) == len(s.views)
    near(now, median(view.rmse_before for view in s.views))


@says(
    rf"A jump between (rows|columns) of (\w+) by up to {NUM} px would not show in two images\. Heights behind it would "
    rf"be off by up to {LENGTH}\."
)
def _(s, axis, name, pixels, height):
    worst = max(s.scene.unseen, key=lambda one: one.height_m)
    assert (worst.image, worst.axis) == (name, axis)
    near(pixels, worst.largest_px)
    assert height == metres(worst.height_m)


@says(
    r"(With \d+ GCPs?|With the DEM|Without(?: consistent)? ground control|The scene's position)(?:, the scene's "
    r"position)? is uncertain by (.*) \(east, north, up; 1 sigma\)\."
)
def _(s, start, sigma):
    assert sigma == ", ".join(map(metres, s.scene.sigma_enu_m))
    if start.startswith("Without"):
        assert max(share(s, *OTHERS)) < 0.05
        assert not (s.scene.dem and s.scene.dem.num_held)
        assert ("consistent" in start) == bool(s.gcps)
    elif "GCP" in start:
        assert int(start.split()[1]) == used_gcps(s) > 0
        assert max(share(s, "gcps")) > 0.0
    elif "DEM" in start:
        assert s.scene.dem.num_held > 0
        assert share(s, "heights", parts=("up",))[0] > 0.05
    else:
        assert max(share(s, *OTHERS)) > 0.05


@says(r"Nothing checks (it|them): an error in a GCP would not show\.")
def _(s, what):
    assert {gcp.status for gcp in s.gcps} <= {"used", "not seen"}
    assert (what == "it") == (used_gcps(s) == 1)
    assert all((gcp.redundancy or 0.0) < 0.5 for gcp in s.gcps)


@says(r"(\d+) GCPs? rejected, as the others contradict (it|them): (.*), predicted minus given\. Check coordinates, .*")
def _(s, num, them, names):
    gone = [gcp for gcp in s.gcps if gcp.status == "rejected"]
    assert int(num) == len(gone)
    assert (them == "it") == (len(gone) == 1)
    for gcp in gone:
        assert f"{gcp.name} ({enu(gcp.residual_enu_m)}, w = {gcp.w:.1f})" in names
    assert used_gcps(s) > len(gone)


@says(r"GCPs contradict each other, (.*) against (.*?)(?: \(.*\))?, and none was used\. Check .*")
def _(s, one, other):
    assert used_gcps(s) == 0
    for name in filter(None, f"{one}, {other}".split(", ")):
        assert name.strip() in {gcp.name for gcp in s.gcps if gcp.status == "undecided"}


@says(rf"The vertical datum of the heights of .* is not stated\. .* the scene is {LENGTH} too (low|high).*")
def _(s, far, side):
    assert float(far.split()[0]) > s.scene.sigma_enu_m[2]
    assert side == "low"


@says(
    r"DEM heights constrain (\d+) of (\d+) used tie points?(: the DEM has no height where one is needed)?"
    r"(?:; the DEM covers (\d+) %)?\."
)
def _(s, held, num, nowhere, percent):
    dem = s.scene.dem
    assert (int(held), int(num)) == (dem.num_held, dem.num_tracks)
    assert bool(nowhere) == (dem.num_held == 0)
    near(percent or "100", 100.0 * dem.num_known / dem.num_tracks)


@says(
    rf"DEM accuracy assumed: {LENGTH} shared by all points, {LENGTH} each(?:; measured: the tie points lie {LENGTH} "
    rf"(above|below) it \(median; scatter {LENGTH}\))?\."
)
def _(s, _shared, sigma, offset, side, spread):
    dem = s.scene.dem
    assert dem.sigma_m is None or sigma == metres(dem.sigma_m)
    assert (offset is None) == (dem.num_known == 0)
    if offset:
        assert (offset, spread) == (metres(abs(dem.offset_m)), metres(dem.spread_m))
        assert (side == "above") == (dem.offset_m > 0)


@says(rf"The DEM was not used: its relief is {NUM} times that of the tie points\. Check .*")
def _(s, relief):
    assert float(relief) == pytest.approx(s.scene.dem.relief, rel=0.06)
    assert max(share(s, "heights")) < 0.05


@says(r"The reference was matched at (\d+) of (\d+) points? in (\d+) images?, to .*")
def _(s, points, tried, images):
    seen = [view for view in s.reference.views if view.offset_en_m]
    assert s.reference.used
    assert int(images) == len(seen)
    assert (int(points), int(tried)) == (sum(v.num_points for v in seen), sum(v.num_tried for v in seen))


@says(
    rf"(\d+) of (\d+) altimetry heights agree with the surface of the tie points to {LENGTH} \({LENGTH} "
    r"expected\); (.*)\."
)
def _(s, agree, near_, spread, expected, motion):
    one = s.scene.altimetry
    assert (int(agree), int(near_)) == (one.num_agreeing, one.num_near)
    assert (spread, expected) == (metres(one.spread_m), metres(one.expected_m))
    assert motion == f"they shifted it by {enu(one.motion_enu_m)}"
    assert share(s, "altimetry", parts=("up",))[0] > 0.5


@says(rf"The altimetry scatters about the surface by {NUM} times what is expected \((\d+) of (\d+) on .*\)\. Check .*")
def _(s, ratio, agree, near_):
    one = s.scene.altimetry
    assert ratio == two_digits(one.spread_m / one.expected_m)
    assert (int(agree), int(near_)) == (one.num_agreeing, one.num_near)
    assert one.spread_m > 2.5 * one.expected_m


@says(rf"More than {NUM} % of the tie points of (.*) were rejected; neighbours err in random directions, .*")
def _(s, percent, names):
    for name in names.split(", "):
        (view,) = [view for view in s.views if view.name == name]
        assert 100 * view.lost > float(percent)


@says(
    rf"The cameras of (.*) were held as they are written; they move by up to {NUM} px \((\S+)\) where --update adjusts "
    r"all together\."
)
def _(s, _run, far, name):
    assert float(far) >= 0.0
    assert name in {view.name for view in s.views}


@says(rf"Residuals of (\d+) check points? \(RMS\): {NUM} px in the images, (.*) on the ground \(east, north, up\)\.")
def _(s, num, pixels, ground):
    assert int(num) == len(s.check_points)
    miss = np.array([point.residual_enu_m for point in s.check_points])
    assert ground == ", ".join(map(metres, np.sqrt((miss**2).mean(axis=0))))
    seen = np.array([one for point in s.check_points for one in point.seen])
    near(pixels, np.sqrt((seen**2).sum(axis=1).mean()))


# --- an image ---------------------------------------------------------------------------------------------


def figures(view: ViewEntry, text: str) -> None:
    """Figures of an image's sentence against its cells."""
    for pattern, value in (
        (rf"Only {NUM} tie points", view.num_observations),
        (rf"Only {NUM} GCPs?", view.num_gcps),
        (rf"{NUM} % of its tie points were rejected", 100 * view.lost),
        (rf"Check tie points have residuals of {NUM} px", view.held_out_px),
        (rf"misses it by {NUM} px", view.fit and float(np.hypot(*view.fit.rmse_px))),
        (rf"RMS; {NUM} px at most", view.fit and max(view.fit.max_px)),
        (rf"Its RPC is {NUM} times less", view.prior_scale),
        (r"Tie points have residuals of (\d[\d.]*) px\. Adjust", view.rmse_before),
        (rf"Tie points keep residuals of {NUM} px", view.rmse_after),
    ):
        if found := re.search(pattern, text):
            near(found[1], value)
    assert not re.search(r"more than 0 %", text)
    assert ("No tie points" not in text) or view.num_observations == 0


# --- next steps -------------------------------------------------------------------------------------------


@says(
    r"(After review, use|Use) (.*?)(?: and (\d+) more)?\."
    r"(?: Best pair for heights: (\S+) - (\S+) \(one pixel of parallax is (.*) of height\)\.)?"
)
def _(s, start, names, more, a, b, per_pixel):
    assert (start == "Use") == s.passed
    good = {name for view in s.views if not view.advice for name in view.outputs}
    assert {*names.split(", ")} <= good
    assert len(names.split(", ")) + int(more or 0) == len(good)
    pairs = {(pair.a, pair.b): pair for pair in s.pairs}
    assert a is None or per_pixel == metres(pairs[a, b].height_m_per_px)
    assert a is None or not any(view.advice for view in s.views if view.name in (a, b))


@says(r"(A DEM good to .*|A third image .*|GCPs at .*)\.")
def _(s, gains):
    (step,) = [step for step in s.next if step.expected]
    to = re.findall(r"would lower the uncertainty of the (?:height|position) to (.*?)\.(?: |$)", f"{gains}.")
    assert to == [", ".join(metres(sigma) for sigma in one.sigma_enu_m if sigma is not None) for one in step.expected]
    for one in step.expected:
        better = [a / b for a, b in zip(s.scene.sigma_enu_m, one.sigma_enu_m, strict=True) if b is not None]
        assert max(better) > 1.5
    assert ("--dem" in gains) <= (s.scene.dem is None or s.scene.dem.num_held == 0)


@says(
    r"(Review: .*|Check the files that were left out: |The cameras disagree: adjust them|"
    r"Adjust the cameras with these).*"
)
def _(s, start):
    if start.startswith("Review"):
        first, rest = re.fullmatch(r"Review: (.*?)(?: \(and (\d+) more reservations?\))?\.", start).groups()
        assert s.reasons[0].startswith(first.removesuffix(" [...]"))
        assert len(s.reasons) == 1 + int(rest or 0)
    assert not start.startswith("Check") or s.left_out
    assert not start.startswith("The cameras disagree") or min(view.rmse_before for view in s.views) > 0.5
    assert not start.startswith("Adjust") or s.tracks.num_tracks


# --- decisions --------------------------------------------------------------------------------------------


@says(r"The attitude drift is estimated as a polynomial of the row, of degree (\d+)(.*)\.")
def _(s, degree, rest):
    assert int(degree) == s.scene.drift_degree
    assert s.options["adjust"]["drift"] is None
    assert ("as in the earlier run" in rest) == (None in s.scene.drift_sigma_m)
    if found := re.search(r"sigma of the drift is (.*) on the ground, at the first", rest):
        assert found[1].removesuffix(" (by degree)") == ", ".join(map(metres, s.scene.drift_sigma_m))


@says(rf"Corrections exceed the pointing error of {NUM} px that is assumed where no file states one: (.*)\.")
def _(s, assumed, names):
    near(assumed, np.sqrt(2.0) * 7.5 / median([view.gsd_m for view in s.views]))
    for name, shift in re.findall(r"(\S+) \((\d+) px\)", names):
        view = next(one for one in s.views if one.name == name)
        near(shift, float(np.hypot(*view.correction.center_shift_px)))
        assert view.prior_scale > 1.0
        assert float(shift) >= float(assumed)


@says(
    r"The corrections are larger than the prior sigmas of the cameras allow\. The prior sigmas of position and "
    rf"attitude of (\d+) images? were multiplied by (?:up to )?{NUM}(?: \((.*)\))?\."
)
def _(s, num, times, name):
    wide = {view.name: view.prior_scale for view in s.views if (view.prior_scale or 1.0) > 1.005}
    assert int(num) == len(wide)
    near(times, max(wide.values()))
    assert name is None or wide[name] == max(wide.values())
    assert name is not None or len({f"{scale:.1f}" for scale in wide.values()}) == 1 < len(wide)


@says(
    r"Observations of tie points: (\d+) used, (\d+) check \(independent of the adjustment\), (\d+) rejected \(false or "
    r"imprecise\)(?:, (\d+) excluded \(they move together\))?\."
)
def _(s, *counts):
    names = "num_observations", "num_check", "num_rejected", "num_moving"
    assert [int(count or 0) for count in counts] == [sum(getattr(view, name) for view in s.views) for name in names]
    assert sum(int(count or 0) for count in counts) == s.tracks.num_observations
    assert int(counts[1]) == s.scene.num_held_out


@says(rf"Degree (\d+) left systematic residuals of {NUM} px in (\S+?)(?:, and .*)?\.")
def _(s, degree, size, image):
    one = s.scene.drift_justification
    assert (int(degree) + 1, image) == (s.scene.drift_degree, one.image)
    near(size, one.systematic_px)


@says(r"No part of an image has significantly larger residuals of check tie points than the rest\.")
def _(s):
    assert s.scene.held_out_places == ()
    errors = [view.held_out_px for view in s.views if view.num_observations]
    assert None not in errors
    assert max(errors) < 5.0 * max(median(view.rmse_after for view in s.views), 0.05)


@says(
    rf"Of (\d+) residuals? of control points in the images, (\d+) ha(?:s|ve) Baarda's w above {NUM} in column or row "
    rf"\({NUM} expected by chance\)\. The largest w is {NUM} \((\S+) in (\S+)\)\."
)
def _(s, num, beyond, critical, expected, w, point, image):
    test = s.control_test
    assert (int(beyond), int(num), point, image) == (test.num_beyond, test.num, test.point, test.image)
    near(w, test.largest_w)
    assert (test.largest_w > float(critical)) == (test.num_beyond > 0)
    assert float(expected) == pytest.approx(test.expected, rel=0.5)


# --- answers of sections ----------------------------------------------------------------------------------


@says(r"(\d+) of (\d+) images?(, after review)?\.( Residuals of tie points measure .*)?")
def _(s, good, num, review, agree):
    assert (int(good), int(num)) == (sum(not view.advice for view in s.views), len(s.views))
    assert bool(review) == (int(good) > 0 and not s.passed)
    assert bool(agree) == (s.kind == "adjust" and any(view.num_observations for view in s.views))


@says(
    r"(All images are connected|The images form (\d+) separate groups), with (\d+) matched tie points?(: .*?)?\."
    r"(?: Connected to one .*?\.)?"
)
def _(s, how, groups, num, lengths):
    linked = {pair.a for pair in s.pairs} | {pair.b for pair in s.pairs}
    assert linked
    assert (how[0] == "A") <= ({view.name for view in s.views} == linked)
    assert (how[0] == "A") == (groups is None)
    assert int(num) == s.tracks.num_tracks == sum(s.tracks.by_length.values())
    for count, length in re.findall(r"(\d+) in (\d+)", lengths or ""):
        assert s.tracks.by_length[length] == int(count)


@says(
    r"(Yes|Nearly|No)(?:: no image has systematic residuals \(F test: p < 1e-4\)|\. (.*)|( image has a significant "
    r"mean in most of its cells))\. Thin lines are .*"
)
def _(s, start, found, untested):
    sure = [view for view in s.views if view.systematic_p is not None and view.systematic_p < 1e-4]
    alike = [view for view in s.views if view.neighbour_correlated_px]
    if untested:
        assert all(view.systematic_p in (None, 1.0) for view in s.views)
    elif start == "Yes":
        assert not sure + alike
    sizes = rf"in (\d+) images?, at most {NUM} px \((\S+)\)"
    for what, views, field in (
        ("Systematic residuals", sure, "systematic_px"),
        ("Correlated neighbouring residuals", alike, "neighbour_correlated_px"),
    ):
        told = re.search(rf"{what}[^.]*? {sizes}", found or "")
        assert bool(told) == bool(views)
        if told:
            largest = max(views, key=lambda view: (getattr(view, field), view.name))
            assert (int(told[1]), told[3]) == (len(views), largest.name)
            assert float(told[2]) == pytest.approx(getattr(largest, field), rel=0.06)
            assert (start == "No") >= (getattr(largest, field) > 0.06)


@says(
    rf"(?:Unknown: .*|The largest epipolar offset of a pair is {NUM} px \(RMS; \S+ - \S+\)\. Stereo needs less "
    r"than 0\.5 px\.)( No pair .*)?"
)
def _(s, offset, none):
    if offset:
        ends = [pair.epipolar_kept if s.kind == "adjust" else pair.epipolar_before for pair in s.pairs]
        near(offset, max(end.rms for end in ends if end))
    assert not none or not any("Best pair" in step.text for step in s.next)


@says(
    r"(Tie points fix the images relative to each other\. ?)?(?:The position on the Earth comes from (.*?)\. ?)?"
    r"(?:The heights of (\d+) tie points? .*)?"
)
def _(s, ties, sources, held):
    assert bool(ties) == any(view.num_observations for view in s.views)
    heads = {"delivered cameras": "cameras", "GCPs": "gcps", "DEM or assumed heights": "heights"}
    told = {heads.get(one, one.replace(" ", "_")) for one in sources.removeprefix("the ").split(", the ")}
    for source in ("cameras", "heights", *OTHERS):
        assert (source in told) == (max(share(s, source)) >= 0.05)
    assert int(held or 0) == s.scene.num_held_in_height


@says(
    r"The scene may be tilted, by (.*) at its eastern and (.*) at its northern edge \((.*) out\), and bent, by (.*)\. "
    r"Add GCPs .*"
)
def _(s, east, north, out, bent):
    sigma = {one.part: one.sigma_m for one in s.scene.datum}
    assert (east, north) == (metres(sigma["tilt east"]), metres(sigma["tilt north"]))
    bends = [sigma[part] for part in ("twist", "bend east", "bend north")]
    assert (out, bent) == (metres(s.scene.radius_m), metres(max(bends)))


@says(r"The verdict has the RMS of (\d+) check points?, which the adjustment did not use\.")
def _(s, num):
    assert int(num) == len(s.check_points)
    assert any(re.match(rf"Residuals of {num} check points? \(RMS\)", line) for line in s.verdict)


@says(rf"(\d+) parts of the columns of (.+) are displaced by up to {NUM} px, as by detectors with edges at (.+)\.")
def _(s, count, image, size, edges) -> None:
    parts = [one for one in s.scene.explanations if (one.name, one.axis, one.image) == ("step", "columns", image)]
    assert int(count) == len(parts) > 2
    near(size, max(one.size_px for one in parts))
    assert edges == listed([f"{edge:.0f}" for edge in sorted(one.first for one in parts if one.first)])


@says(rf"(?:Not known for every image|Yes, to within {NUM} px)\. The original images .*")
def _(s, worst):
    errors = [max(view.fit.max_px) for view in s.views if view.fit]
    assert worst is None or float(worst) == pytest.approx(max(*errors, 1e-6), rel=0.06)


# --- the runs ---------------------------------------------------------------------------------------------


def files_of(run: Run, summary: Summary) -> RunFiles:
    """A run's tables without a folder."""
    tracks, before = run.tracks, run.ties_before.residuals
    after = np.full_like(before, np.nan) if run.ties_after is None else run.ties_after.residuals
    seen = ObservationTable(tracks.view, tracks.point, tracks.xy, before, after, run.keep)
    return RunFiles(summary, seen, np.zeros((0, 4)), np.zeros(0, int), [()] * len(run.views))


KINDS = [pytest.param(kind, marks=pytest.mark.filterwarnings("ignore")) for kind in WORLDS]


@pytest.fixture(scope="module", params=rest_slow(KINDS, 8))
def made(request) -> tuple[Summary, list[str]]:
    """The summary of a run, and every sentence of its page but those of images."""
    run = WORLDS[request.param]()
    summary = summarize(run)
    found = [section for make in SECTIONS if (section := make(files_of(run, summary))) is not None]
    page = [text for section in found for text in (section.answer, *section.points) if text]
    steps = [step.text for step in summary.next]
    return summary, [unescape(str(text)) for text in (*summary.verdict, *steps, *page)]


@pytest.mark.landing(16)
def test_no_sentence_is_against_its_figure(made):
    """Of summaries that follow the published schema, and come back from their file as they were."""
    summary, sentences = made
    kept = json.loads(json.dumps(json_form(summary)))
    Draft202012Validator(published_schema()).validate(kept)
    assert Summary.read(kept) == summary
    of_images = {view.reservation: view for view in summary.views if view.advice}
    told = {
        f"{one.sentence[0].upper()}{one.sentence[1:]}." for one in (summary.scene.explanations if summary.scene else ())
    }
    assert set(of_images) <= set(summary.verdict)
    for sentence in sentences:
        if sentence in of_images:
            figures(of_images[sentence], sentence)
        elif sentence not in told:
            rows = [
                (check, found) for pattern, check in SENTENCES.items() if (found := re.fullmatch(pattern, sentence))
            ]
            assert rows, f"no row of SENTENCES: {sentence}"
            check, found = rows[0]
            outcome = check(summary, *found.groups())
            assert outcome is None or outcome, sentence


@pytest.mark.landing(16)
def test_what_is_flagged_comes_first_and_the_headline_counts_it(made):
    summary, _ = made
    bad = [view.name for view in summary.views if view.status == "failed"]
    look = [view.name for view in summary.views if view.advice and view.status != "failed"]
    counts = [int(num) for num in re.findall(r"(\d+)(?: of \d+ images?)? needs? review", summary.headline)]
    assert counts == [len(look)] * bool(look)
    gone = [int(num) for num in re.findall(r"(\d+) of \d+ images? (?:is|are) not", summary.headline)]
    assert gone == [len(bad) + len(summary.left_out)] * bool(bad or summary.left_out)
    assert summary.passed == (summary.status == "good") == (not summary.reasons)
    assert summary.reasons == summary.verdict[len(summary.verdict) - len(summary.reasons) :]


CURE = re.compile(r"\b(?:check|add|give|use|run|leave|compare|supply|lower|adjust)\b", re.IGNORECASE)


@pytest.mark.landing(16)
def test_a_reservation_ends_with_its_cure(made):
    summary, _ = made
    of_files = {file.reason_text for file in summary.left_out}
    for reason in {*summary.reasons} - of_files - {"p7 is outside of all images."}:
        *_, last = re.split(r"[.:;] ", reason)
        assert CURE.search(last), reason


def test_there_are_thirty_kinds_and_listed_names_end_as_the_patterns_read_them():
    assert len(WORLDS) >= 30
    assert listed([f"v{k}" for k in range(7)], 5).endswith("v4 and 2 more")
