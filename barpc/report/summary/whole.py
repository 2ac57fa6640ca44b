"""The block as a whole: where it went, what holds it, what its images cannot tell."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import ClassVar

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.altimetry import AltimetryTest
from barpc.ba.held.gauge import MOTIONS, Mode
from barpc.geodesy import ground_from_ecef, wrap_longitude
from barpc.report.outcome import Run
from barpc.report.records import Column, Number, Record, said
from barpc.report.summary.findings import (
    ExplanationEntry,
    HeldOutEntry,
    LeftEntry,
    explanations,
    held_out_places,
    left_entries,
)
from barpc.report.summary.words import Count, Share, Vector, metres, percent_of

_LEVEL = 1e-4  # probability of the F test below which something is called smooth
_MODE_WORDS = {
    "east": "the whole scene may lie {0} farther east or west",
    "north": "the whole scene may lie {0} farther north or south",
    "up": "all heights may be {0} too high or too low",
    "tilt east": "the scene may be tilted: {0} up or down at its eastern and western edges",
    "tilt north": "the scene may be tilted: {0} up or down at its northern and southern edges",
    "turn": "the scene may be turned about the vertical: {0} at its edge",
    "scale": "the scene may be too large or too small: {0} at its edge",
    "twist": "heights may be twisted: by {0} from one corner of the scene to the next",
    "bend east": "heights may be bent: by {0} from the middle of the scene to its eastern and western edges",
    "bend north": "heights may be bent: by {0} from the middle of the scene to its northern and southern edges",
}

_DATUM_HEADS = {
    "cameras": "cameras",
    "earlier_run": "earlier run",
    "fixed_views": "fixed views",
    "gcps": "GCPs",
    "heights": "heights",
    "reference": "reference",
    "altimetry": "altimetry",
}
DATUM = "What holds the scene: how well its motions are known, and what share of that comes from where"
_CELLS = 12  # of the ground, each way: of 3,000 tie points twenty lie in each


class MovingEntry(Record):
    """A cell of the ground in which tie points move together."""

    box: tuple[float, ...] = said("Its ends: west, south, east, north", "deg", minItems=4, maxItems=4)
    count: Count = said("Tie points in it, those that move among them")
    share: Share = said("Part of them that moves")


class ModeEntry(Record):
    """A motion of the scene that the images cannot tell."""

    sigma_m: Number = said("Posterior standard deviation", "m")
    meaning: str = said("Which motion", enum=list(_MODE_WORDS))
    motion_m: tuple[Number, ...] = said(
        "All motions where this one is off by that: east, north, up; tilts, turn, scale at the edge; twist and "
        "bending, from the lowest to the highest place",
        "m",
        minItems=7,
        maxItems=len(MOTIONS),
    )
    words: str = said("The same in words", minLength=1)


class DatumEntry(Record):
    """What holds a motion of the scene: shares of what is known of it. Tie points have none."""

    OWN: ClassVar = {"part": Column("motion", lambda one: one.part)} | {
        name: Column(f"{head} [%]", percent_of(name), ".0f") for name, head in _DATUM_HEADS.items()
    }

    part: str = said("Motion of the scene", enum=list(_MODE_WORDS))
    sigma_m: Number = said(
        "Posterior standard deviation; at the edge for tilts, turn and scale, from the lowest to the highest place for "
        "twist and bending",
        "m",
        "known to",
        ".2f",
    )
    cameras: Number = said("Accuracies of the cameras as delivered")
    earlier_run: Number = said("The earlier run")
    fixed_views: Number = said("Views that are fixed")
    gcps: Number = said("Ground control points")
    heights: Number = said("The DEM, or altitudes assumed for tie points seen under too small an angle")
    reference: Number = said("A reference orthoimage", default=None)
    altimetry: Number = said("Heights without image coordinates", default=None)

    @classmethod
    def columns(cls, entries: Sequence[DatumEntry]) -> str:
        """Return the columns of a table: sources that tell nothing of any motion are left out."""
        told = [name for name in _DATUM_HEADS if any((getattr(one, name) or 0.0) >= 0.005 for one in entries)]
        return " ".join(["part", "sigma_m", *told])


class DemEntry(Record):
    """What the DEM did, and how the tie points lie to it."""

    num_held: Count = said("Tie points that it holds")
    num_known: Count = said("Tie points where it has a height")
    num_tracks: Count = said("Tie points that count")
    offset_m: Number = said("Median of the tie points' altitudes minus the DEM's", "m")
    spread_m: Number = said("1.4826 times the median absolute deviation of these", "m")
    sigma_m: Number = said("Standard deviation of single heights, where the tie points tell", "m", default=None)
    alike: Number = said("As many heights are worth one, as their errors resemble each other", default=None)
    relief: Number = said(
        "The DEM's relief as a multiple of the tie points'; far from 1: another terrain", default=None
    )


class AltimetryEntry(Record):
    """What heights without image coordinates did."""

    num_given: Count = said("Heights in the files")
    num_near: Count = said("Those looked at that lie on the surface of the tie points")
    num_agreeing: Count = said("Those of them that agree on where the scene lies")
    spread_m: Number = said("1.4826 times the median absolute difference of those to the surface", "m")
    expected_m: Number = said("What was expected of it by the accuracies stated and the surface", "m")
    motion_enu_m: Vector = said("By how much they ask the scene to move, once tie points agree", "m")
    sigma_enu_m: Vector = said("How well they know that by themselves", "m")
    why_not: str = said("Why they hold nothing; empty where they hold the scene")


class AskedEntry(Record):
    """What was left in the image with most of it, before more was solved for."""

    image: str = said("View")
    smooth_px: Number = said("RMS of what was smooth in its residuals, less noise", "px")
    smooth_p: Number = said("Probability that noise alone leaves as much (F test)")
    shared_px: Number = said("Error that an observation shared with its neighbour", "px")
    num_images: Count = said("Views in which the F test's probability was below 1e-4")


class SceneEntry(Record):
    """The block as a whole."""

    shift_enu_m: Vector = said("Mean move of the tie points, east, north, up", "m")
    sigma_enu_m: Vector = said("Posterior standard deviation of the scene's place", "m")
    radius_m: Number = said("RMS distance of the tie points from their middle: the edge of tilts, turn and scale", "m")
    weakest_modes: tuple[ModeEntry, ...] = said("What the images cannot tell, the weakest first")
    noise: Number = said("Observed over stated standard deviation of the observations")
    drift_degree: Count = said("Degree of the rotation in the row")
    drift_sigma_m: tuple[Number, ...] = said(
        "Standard deviation of the drift at the first and last row, by degree; null where an earlier run tells",
        "m",
    )
    prior_ratio: Number = said("Squared corrections over stated variances and degrees of freedom")
    cost_history: tuple[Number, ...] = said("Sum of squared whitened residuals, by linearisation")
    num_held_in_height: Count = said("Tie points seen under too small an angle, held in height")
    gcp_residuals_enu_m: tuple[Vector, ...] = said("Adjusted GCPs minus their given place", "m")
    solver: str = said("What the solver did")
    prior_shared: Number = said(
        "Times by which accuracies that RPCs state were widened, as images share what they are off by; 1: not at all",
        default=1.0,
    )
    datum: tuple[DatumEntry, ...] = said("What holds the scene", default=())
    dem: DemEntry | None = said("What the DEM did; null without one", default=None)
    altimetry: AltimetryEntry | None = said(
        "What heights without image coordinates did; null without any", default=None
    )
    gcp_scatter: Number = said("RMS residual of the GCPs used over what their accuracies let expect", default=None)
    num_held_out: Count = said("Observations that took no part, to be measured on", default=0)
    model: str = said("Unknowns of each view that were solved for", default="")
    drift_asked: AskedEntry | None = said("What a drift of one degree less left, where one was added", default=None)
    jitter_asked: AskedEntry | None = said("What was left without splines and steps, where these follow", default=None)
    in_space_px: Number = said(
        "Where an affine in the image was chosen: what a rotation and translation leave of the same tie points",
        "px",
        default=None,
    )
    explanations: tuple[ExplanationEntry, ...] = said(
        "What explains tie points beside the cameras' errors as stated, the first taken first", default=()
    )
    moving: tuple[MovingEntry, ...] = said(
        "Where tie points move together: cells of the ground, as many each way, that hold any", default=()
    )
    left: tuple[LeftEntry, ...] = said("Rows and columns that stand out at the end", default=())
    held_out_places: tuple[HeldOutEntry, ...] | None = said(
        "Where tie points that took no part are met worse than in the rest of an image; null: not tested",
        default=None,
    )


_DEM = attrgetter("held", "known", "total", "offset", "spread", "sigma", "alike", "relief")


def measure_scene(run: Run) -> SceneEntry | None:
    """Return the block as a whole; None for a check."""
    adjustment = run.adjustment
    if adjustment is None:
        return None
    gauge, prior, terrain = adjustment.gauge, adjustment.prior, adjustment.terrain
    datum = []
    for m, part in enumerate(MOTIONS):
        shares = {key: float(row[m]) for key, row in adjustment.datum.items()}
        datum.append(DatumEntry(part, float(gauge.motion_sigma[m]), **shares))
    modes = [ModeEntry(m.sigma, m.meaning, m.motion.tolist(), mode_in_words(m)) for m in gauge.modes]
    return SceneEntry(
        shift_enu_m=gauge.shift.tolist(),
        sigma_enu_m=gauge.sigma.tolist(),
        radius_m=gauge.radius,
        weakest_modes=tuple(modes),
        datum=tuple(datum),
        gcp_scatter=None if adjustment.control is None else adjustment.control.scatter,
        dem=None if terrain is None else DemEntry(*_DEM(terrain)),
        altimetry=_altimetry(adjustment.altimetry),
        noise=adjustment.noise,
        num_held_out=int(np.count_nonzero(adjustment.held_out)),
        model=adjustment.cameras.unknowns.model,
        in_space_px=adjustment.in_space_rms,
        drift_asked=_asked(adjustment, "drift"),
        jitter_asked=_asked(adjustment, "jitter"),
        drift_degree=adjustment.cameras.unknowns.drift,
        drift_sigma_m=tuple(prior.drift_sigma),
        prior_ratio=prior.ratio,
        prior_shared=prior.shared,
        cost_history=tuple(adjustment.cost_history),
        num_held_in_height=int(np.count_nonzero(adjustment.held)),
        gcp_residuals_enu_m=adjustment.gcp_residuals.tolist(),
        solver=adjustment.status,
        explanations=explanations(adjustment),
        moving=moving_cells(run),
        left=left_entries(adjustment),
        held_out_places=held_out_places(run.met_worse, adjustment.names),
    )


def _altimetry(test: AltimetryTest | None) -> AltimetryEntry | None:
    if test is None:
        return None
    counts, spreads = (test.given, test.near, test.agree), (test.spread, test.expected)
    return AltimetryEntry(*counts, *spreads, tuple(test.motion), tuple(test.sigma), test.why_not)


def _asked(adjustment: Adjustment, what: str) -> AskedEntry | None:
    test = adjustment.asked.get(what)
    if test is None:
        return None
    found = test.significance < _LEVEL
    i = int(np.argmax(np.maximum(np.where(found, test.rms, 0.0), test.shared)))
    rms, significance, shared = (float(values[i]) for values in (test.rms, test.significance, test.shared))
    return AskedEntry(adjustment.names[i], rms, significance, shared, int(found.sum()))


def mode_in_words(mode: Mode) -> str:
    """Return one weak mode of the scene as a sentence without its full stop."""
    return _MODE_WORDS[mode.meaning].format(metres(mode.sigma))


def moving_cells(run: Run) -> tuple[MovingEntry, ...]:
    """Return the cells of the ground whose tie points move, south to north, west to east; all groups together."""
    found = run.adjustment
    if found is None or not found.moving.any():
        return ()
    moves, stays = np.zeros((2, run.tracks.num_points), dtype=bool)
    moves[run.tracks.point[found.moving]] = stays[run.tracks.point[found.inlier]] = True
    known = np.isfinite(found.points[:, 0])
    every = np.flatnonzero((moves | stays) & known)
    lonlat = ground_from_ecef(found.points[every])[:, :2]
    lonlat[:, 0] = wrap_longitude(lonlat[:, 0], lonlat[0, 0])
    of_ground = np.flatnonzero(stays[every]) if (stays & known).any() else np.arange(len(every))
    low, high = lonlat[of_ground].min(axis=0), lonlat[of_ground].max(axis=0)
    step = np.maximum(high - low, 1e-9) / _CELLS
    # what flies is seen beside the ground that it is over, beyond its ends at times
    col, row = np.clip((lonlat - low) / step, 0, _CELLS - 1).astype(np.int64).T
    cell, gone = row * _CELLS + col, moves[every]
    count = np.bincount(cell, minlength=_CELLS**2)
    share = np.bincount(cell, gone, _CELLS**2) / np.maximum(count, 1)
    entries = []
    for k in np.flatnonzero(share):
        corner = low + step * [k % _CELLS, k // _CELLS]
        west, east = (float(wrap_longitude(lon)) for lon in (corner[0], corner[0] + step[0]))
        box = west, float(corner[1]), east, float(corner[1] + step[1])
        entries.append(MovingEntry(box, int(count[k]), float(share[k])))
    return tuple(entries)
