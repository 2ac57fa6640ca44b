"""Next steps of a run: files to use, inputs that would improve it with their expected gain, parts to review."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import partial
from textwrap import shorten

import numpy as np

from barpc.ba.constraints.gauge import MOTIONS, SIMILAR
from barpc.ba.constraints.ground import KNOWN_BIAS
from barpc.base.errors import listed
from barpc.base.geodesy import Array
from barpc.pointio.tables import GROUND_SIGMA, IMAGE_SIGMA
from barpc.report.constraints import lengths
from barpc.report.outcome import Added
from barpc.report.ranking import flagged, sure_pairs
from barpc.report.records import value_of
from barpc.report.summary import ExpectedEntry, StepEntry, Summary
from barpc.report.summary.block import SceneEntry
from barpc.report.summary.words import CAUSES, NAMED, STATUS_WORDS, counted, metres

LEAST_GAIN = 1.5  # A standard deviation that falls by less is not worth an input: the prediction is as good as that
NUM_GCPS = 3  # the fewest of which two can outvote a wrong one
_POSITION = slice(0, 3)  # of the scene's motions: east, north, up
_DEM_MOTIONS = [MOTIONS.index(name) for name in ("up", "tilt east", "tilt north")]  # a DEM's level and slopes
NEW_ANGLE = 20.0  # deg between a third image and both of a pair: of stereo, and of matching without loss
_BY_CAMERAS = 0.99  # share of the cameras in the height, above which its uncertainty is that of their directions

_REPORT_PARTS = {
    **dict.fromkeys(("no_overlap", "untied", "few", "none", "few_gcps", "gap"), "map"),
    **dict.fromkeys(("contradicted", "systematic", "rejected", "wrong_matches", "place", "beside"), "random"),
    **dict.fromkeys(("held_out", "left", "moving_objects"), "random"),
    **dict.fromkeys(("foreign_camera", "odd"), "moves"),
    **dict.fromkeys(("one_rpc_misses", "follows_more"), "files"),
}
"""Cause of a reservation -> the part of the report that shows it; others: the table of images."""


def next_steps(summary: Summary, added: Added | None = None) -> tuple[StepEntry, ...]:
    """Return the next steps of a run with its verdict, at most one of each kind: use, improve, review.

    `added` is the effect of its images on those of an earlier run, where they were added to one.
    """
    use = _use if summary.adjusted else _adjustment_step
    if added is not None and added.contradicted is not None:
        use = partial(_update, added)
    return (*use(summary), *_improve(summary), *_review(summary))


# --- files to use -------------------------------------------------------------------------------------------


def _use(summary: Summary) -> Iterator[StepEntry]:
    """Yield the files of the images without reservation, and the commands that such images are enough for."""
    good = [view for view in summary.views if view.outputs and not view.advice]
    if not good:
        return
    # the file that stands for the image, before texts of RPCs alone
    files = [next((f for f in view.outputs if f.endswith((".vrt", ".tif"))), next(iter(view.outputs))) for view in good]
    heights = [pair for pair in sure_pairs(summary.views, summary.pairs) if pair.height_m_per_px]
    commands = ["barpc ortho . -o ortho"]
    best = ""
    if heights:
        pair = min(heights, key=lambda pair: pair.height_m_per_px or np.inf)
        height = metres(pair.height_m_per_px or np.nan)
        best = f" Best pair for heights: {pair.a} - {pair.b} (one pixel of parallax is {height} of height)."
        commands = ["barpc dsm . -o dsm.tif", "barpc export . s2p --to s2p", *commands]
    start = "Use" if summary.passed else "After review, use"
    yield StepEntry("use", f"{start} {listed(files, NAMED)}.{best}", tuple(commands))


def _update(added: Added, summary: Summary) -> Iterator[StepEntry]:
    """Yield the update of an earlier run whose cameras, as they are written, and the new ones do not agree."""
    if any(view.outputs for view in summary.views):
        yield StepEntry("use", f"Run again with --update: cameras of {added.run} and new ones do not agree.")


def _adjustment_step(summary: Summary) -> Iterator[StepEntry]:
    """Yield the adjustment of cameras that disagree, or with the tie points of a match."""
    if any(view.cause == "disagrees" for view in summary.views):
        yield StepEntry("use", "The cameras disagree: adjust them.", ("barpc adjust IMAGE... -o adjusted",))
    if summary.kind == "match" and summary.tracks.num_tracks:
        command = "barpc adjust IMAGE... --matches matches.npz --matches-only -o adjusted"
        yield StepEntry("use", "Adjust the cameras with these tie points.", (command,))


# --- inputs that would improve it --------------------------------------------------------------------------------


def _improve(summary: Summary) -> Iterator[StepEntry]:
    """Yield the inputs that lower a standard deviation of the scene's position by more than `LEAST_GAIN`."""
    scene, covariance = summary.scene, None if summary.scene is None else _scene_covariance(summary.scene)
    # of GCPs in use that do not agree the covariance is not that of the scene
    if scene is None or covariance is None or any(gcp.status == "contradicts" for gcp in summary.gcps):
        return
    now = np.sqrt(np.diag(covariance))[_POSITION]
    options, found, words = summary.options or {}, list[ExpectedEntry](), list[str]()
    lower = "would lower the uncertainty"
    if not (summary.reference and summary.reference.used) and not (scene.dem and scene.dem.num_held):
        level = _dem_observations(options)
        then = _sigma_with(covariance, *level)
        if now[2] > LEAST_GAIN * then[2]:
            found.append(ExpectedEntry("dem", (None, None, float(then[2]))))
            a_dem = f"A DEM good to {metres(np.sqrt(level[1][0]))} (--dem FILE --geoid NAME)"
            words.append(f"{a_dem} {lower} of the height to {metres(then[2])}.")
    up = now[2] * _height_ratio(summary, scene)
    if now[2] > LEAST_GAIN * up:
        found.append(ExpectedEntry("image", (None, None, float(up))))
        words.append(f"A third image {NEW_ANGLE:g} deg from both {lower} of the height to {metres(up)}.")
    then = _sigma_with(covariance, *_gcp_observations(summary, scene))
    if (now > LEAST_GAIN * then).any():
        found.append(ExpectedEntry("gcps", tuple(then.tolist())))
        accuracy = f"{metres(GROUND_SIGMA)} and {IMAGE_SIGMA:g} px"
        words.append(
            f"GCPs at {NUM_GCPS} points, good to {accuracy} (--gcp FILE), {lower} of the position to {lengths(then)}."
        )
    if found:
        yield StepEntry("improve", " ".join(words), expected=tuple(found), part="gauge")


def _height_ratio(summary: Summary, scene: SceneEntry) -> float:
    """Return the factor of the height's standard deviation by a third image of a pair; 1 where it does not apply.

    Its variance goes with 1 / sum of the squared distances (B/H) of lines of sight over their number. Priors that a
    pair alone has widened are too uncertain to predict from.
    """
    cameras = next((one.cameras for one in scene.datum if one.part == "up"), None) or 0.0
    widened = max(view.prior_scale or 1.0 for view in summary.views) > LEAST_GAIN
    if len(summary.views) != 2 or not summary.pairs or cameras < _BY_CAMERAS or widened:
        return 1.0
    apart, new = summary.pairs[0].base_to_height or np.nan, 2.0 * np.tan(np.radians(NEW_ANGLE / 2.0))
    return float(np.nan_to_num(np.sqrt((apart**2 / 2.0) / ((apart**2 + 2.0 * new**2) / 3.0)), nan=1.0))


def _scene_covariance(scene: SceneEntry) -> Array | None:
    """Return the covariance (10, 10) of the scene's motions [m^2]; None where it is not known."""
    found = np.full((len(MOTIONS), len(MOTIONS)), np.nan)
    for mode in scene.weakest_modes:
        column = np.array([mode.sigma_m, *mode.motion_m], dtype=np.float64)
        if len(column) == len(MOTIONS) + 1:
            found[:, MOTIONS.index(mode.meaning)] = column[0] * column[1:]
    return 0.5 * (found + found.T) if np.isfinite(found).all() else None


def _sigma_with(covariance: Array, rows: Array, variance: Array) -> Array:
    """Return standard deviations (3,) east, north, up [m] after observations `rows` (n, 10) of given variance (n,)."""
    gain = np.linalg.solve(rows @ covariance @ rows.T + np.diag(variance), rows @ covariance)
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance - covariance @ rows.T @ gain), 0.0))[_POSITION])


def _dem_observations(options: Mapping[str, object]) -> tuple[Array, Array]:
    """Return the observations of a DEM: level and slopes, with the error common to its heights."""
    adjust = options.get("adjust")
    given = adjust.get("dem_bias_sigma") if isinstance(adjust, Mapping) else None
    bias = float(given or KNOWN_BIAS)
    return np.eye(len(MOTIONS))[_DEM_MOTIONS], np.full(len(_DEM_MOTIONS), bias**2)


def _gcp_observations(summary: Summary, scene: SceneEntry) -> tuple[Array, Array]:
    """Return the observations of GCPs around the scene, at the RMS distance of its tie points from their centre.

    The variance is that of the GCP, of its image coordinates in as many images as a tie point has, and of the bending
    of the scene, whose sigmas are ranges: half of each from the middle.
    """
    angle = 2.0 * np.pi * np.arange(NUM_GCPS) / NUM_GCPS
    east, north, one, zero = np.cos(angle), np.sin(angle), np.ones(NUM_GCPS), np.zeros(NUM_GCPS)
    by_motion = np.zeros((3, NUM_GCPS, len(MOTIONS)))  # of the motions before bends, as the gauge counts them
    by_motion[0, :, :SIMILAR] = np.column_stack([one, zero, zero, zero, zero, -north, east])
    by_motion[1, :, :SIMILAR] = np.column_stack([zero, one, zero, zero, zero, east, north])
    by_motion[2, :, :SIMILAR] = np.column_stack([zero, zero, one, east, north, zero, zero])
    seen = max(summary.tracks.num_observations / max(summary.tracks.num_tracks, 1), 1.0)
    pixel = float(np.median([view.gsd_m or 0.0 for view in summary.views]))
    per_pixel = [pair.height_m_per_px for pair in summary.pairs if pair.height_m_per_px]
    flat = (IMAGE_SIGMA * pixel) ** 2 / seen
    # a parallax is the difference of two image coordinates
    up = 2.0 * (IMAGE_SIGMA * min(per_pixel, default=pixel)) ** 2
    bends = [mode.sigma_m or 0.0 for mode in scene.weakest_modes if MOTIONS.index(mode.meaning) >= SIMILAR]
    up += float(np.sum(np.square(bends))) / 4.0
    variance = GROUND_SIGMA**2 + np.repeat([flat, flat, up], NUM_GCPS)
    return by_motion.reshape(-1, len(MOTIONS)), variance


# --- parts to review ---------------------------------------------------------------------------------------


def _review(summary: Summary) -> Iterator[StepEntry]:
    """Yield the worst reservation: of images first, then of files that were left out, then of the block."""
    if views := flagged(summary.views):
        alike = [view.name for view in views if (view.cause, view.status) == (views[0].cause, views[0].status)]
        label = CAUSES[views[0].cause].label if views[0].cause in CAUSES else STATUS_WORDS[views[0].status]
        rest = len(views) - len(alike)
        more = f", then {counted(rest, 'more image')}" if rest else ""
        part = _REPORT_PARTS.get(views[0].cause or "", "images")
        yield StepEntry("review", f"Review {listed(alike, NAMED)} ({label}){more}.", part=part)
    elif summary.left_out:
        names = listed([one.path for one in summary.left_out], NAMED)
        yield StepEntry("review", f"Check the files that were left out: {names}.")
    elif summary.reasons:
        of_control = any(gcp.status not in ("used", "not seen") for gcp in summary.gcps)
        first, rest = shorten(re.split(r"[.:] |\.$", summary.reasons[0])[0], 110), len(summary.reasons) - 1
        text = f"Review: {first}" + f" (and {counted(rest, 'more reservation')})" * bool(rest) + "."
        yield StepEntry("review", text, part="gauge" if of_control or value_of(summary, "scene.dem") else "decisions")
