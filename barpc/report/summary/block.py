"""The block as a whole: where it went, what holds it, what its images cannot tell, what else explains tie points."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.apart import FOREIGN_CAMERA, ForeignCamera
from barpc.ba.constraints.gauge import MOTIONS
from barpc.ba.evidence.scan import ImageRegion
from barpc.ba.judging.explanations import FADE, MOVING, STRIP, SWING, TRANSIENT, WANDER
from barpc.ba.judging.judge import Finding
from barpc.base.geodesy import wrap_longitude
from barpc.report.outcome import Run
from barpc.report.records import Number, Record, column
from barpc.report.summary.words import Count, Vector, metres

AXES = "columns", "rows"
DATUM = "Uncertainty of the scene's position and shape (1 sigma), and the shares of its sources"
MODES = {
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
"""Motion of the scene -> in words."""
_EXPLANATION_SENTENCES = {
    STRIP: "{axis} {first:.0f}-{last:.0f} of {image} lie {size:.2f} px off the rest of it",
    FADE: "rows of {image} lie {size:.2f} px off at row {origin:.0f}, which fades within {length:.0f} rows",
    TRANSIENT: "rows at the {end} of all images lie off, by up to {size:.2f} px, which fades within {length:.0f} rows",
    WANDER: "rows of {image} wander by {size:.2f} px",
    SWING: "rows of {image} swing by {least}{size:.2f} px every {period:.0f} rows",
    MOVING: "{share:.0f} % of the tie points{side} move together (a cloud, water or shadows?), by {metres:.2g} m from "
    "{between[0]} to {between[1]} beside what may be their height, and took no part",
}
EXPLANATION_WORDS = {
    STRIP: "rows or columns of an image lie off",
    FADE: "rows of an image lie off and less and less",
    TRANSIENT: "rows at an end of all images lie off and less and less",
    WANDER: "rows of an image wander",
    SWING: "rows of an image swing",
    MOVING: "tie points move together",
}
"""Explanation -> what it is, in words."""


class ModeEntry(Record):
    """A motion of the scene that the images cannot tell."""

    sigma_m: Number = column("Posterior standard deviation", "m")
    meaning: str = column("Which motion", enum=list(MODES))
    motion_m: tuple[Number, ...] = column(
        "All motions where this one is off by that: east, north, up, tilts, turn, scale, twist, bending",
        "m",
        minItems=7,
        maxItems=len(MOTIONS),
    )
    words: str = column("The same in words", minLength=1)


class DatumEntry(Record):
    """Sources of a motion of the scene, as shares of its information. Tie points have none."""

    part: str = column("Motion of the scene", head="motion", enum=list(MODES))
    sigma_m: Number = column("Posterior standard deviation (of turns: at the edge)", "m", "known to", ".2f")
    cameras: Number = column("Accuracies of the cameras as delivered", head="cameras", form=".0%")
    earlier_run: Number = column("The earlier run", head="earlier run", form=".0%")
    fixed_views: Number = column("Views that are fixed", head="fixed views", form=".0%")
    gcps: Number = column("Ground control points", head="GCPs", form=".0%")
    heights: Number = column("The DEM, or altitudes assumed", head="heights", form=".0%")
    reference: Number = column("A reference orthoimage", head="reference", form=".0%", default=None)
    altimetry: Number = column("Heights without image coordinates", head="altimetry", form=".0%", default=None)

    @classmethod
    def columns(cls, entries: Sequence[DatumEntry]) -> str:
        """Return the columns of a table: sources that tell nothing of any motion are left out."""
        part, sigma, *sources = cls.__dataclass_fields__
        told = [name for name in sources if any((getattr(one, name) or 0.0) >= 0.005 for one in entries)]
        return " ".join([part, sigma, *told])


class DemEntry(Record):
    """What the DEM did, and how the tie points lie to it."""

    num_held: Count = column("Tie points that it holds")
    num_known: Count = column("Tie points where it has a height")
    num_tracks: Count = column("Tie points that count")
    offset_m: Number = column("Median of the tie points' altitudes minus the DEM's", "m")
    spread_m: Number = column("1.4826 times the median absolute deviation of these", "m")
    sigma_m: Number = column("Standard deviation of single heights, where the tie points tell", "m", default=None)
    alike: Number = column("As many heights are worth one, as their errors resemble each other", default=None)
    relief: Number = column("The DEM's relief over the tie points'", default=None)


class AltimetryEntry(Record):
    """What heights without image coordinates did."""

    num_given: Count = column("Heights in the files")
    num_near: Count = column("Those looked at that lie on the surface of the tie points")
    num_agreeing: Count = column("Those of them that agree on where the scene lies")
    spread_m: Number = column("1.4826 times the median absolute difference of those to the surface", "m")
    expected_m: Number = column("What was expected of it by the accuracies stated and the surface", "m")
    motion_enu_m: Vector = column("By how much they ask the scene to move, once tie points agree", "m")
    sigma_enu_m: Vector = column("How well they know that by themselves", "m")
    why_not: str = column("Why they hold nothing; empty where they hold the scene")


class AskedEntry(Record):
    """What was left in the image with most of it, before more was solved for."""

    image: str = column("View")
    smooth_px: Number = column("RMS of what was smooth in its residuals, less noise", "px")
    smooth_p: Number = column("Probability that noise alone leaves as much (F test)")
    shared_px: Number = column("Error that an observation shared with its neighbour", "px")
    num_images: Count = column("Views in which the F test's probability was below 1e-4")


class ExplanationEntry(Record):
    """Something that explains tie points, those that were cut among them, better than its rivals."""

    PAGE: ClassVar = "sentence gain gap runner_up"

    name: str = column("What it is", enum=[*_EXPLANATION_SENTENCES, FOREIGN_CAMERA])
    sentence: str = column("The same in words", head="what explains tie points", minLength=1)
    image: str | None = column("View; null for what is of no single one")
    gain: float = column("Logarithm of the evidence, over that without it", "nats", "gain", ".0f")
    gap: float = column("The same, over the runner-up", "nats", "over the next", ".0f")
    runner_up: str | None = column("What explains next as much; null for nothing", head="next", default=None)
    axis: str | None = column("Whether it is of rows or of columns", default=None, enum=[*AXES, None])
    first: Number = column("Its first row or column", "px", default=None)
    last: Number = column("Its last row or column", "px", default=None)
    size_px: Number = column("RMS displacement of what it moves; the amplitude of a swing", "px", default=None)
    period: Number = column("Rows after which a swing repeats itself", "px", default=None)
    or_of: tuple[str, ...] | None = column("Views that may be meant as well: ties do not tell which", default=None)
    share: Number = column("Tie points that move together: part of all of them", default=None)
    moved_m: Number = column("How far they move on the ground, beside what may be their height", "m", default=None)
    between: tuple[str, ...] | None = column("From the first of these views to the second", default=None)
    box: tuple[float, ...] | None = column("West, south, east, north of nine in ten", "deg", default=None)


class LeftEntry(Record):
    """Rows or columns of an image in which tie points were cut, or are off, more than elsewhere and chance allow."""

    PAGE: ClassVar = "image axis first last rejected off_px apart_px gain"

    image: str = column("View", head="image")
    axis: str = column("Rows or columns", head="axis", enum=list(AXES))
    first: float = column("The first", "px", "first", ".0f")
    last: float = column("The last", "px", "last", ".0f")
    rejected: float = column("Share of their tie points that was cut", head="rejected", form=".0%")
    off_px: float = column("What the others have in common", "px", "off", ".2f")
    apart_px: float = column("Half of those that were cut contradict the others by more than this", "px", "by", ".2f")
    gain: float = column("Logarithm of the likelihood, over that of a whole image alike", "nats", "gain", ".0f")
    moving: bool = column("Whether the share is not of what was cut, but of a group that moves", default=False)


class HeldOutEntry(Record):
    """Rows, columns or a cell of an image in which tie points that took no part are met worse than elsewhere in it."""

    PAGE: ClassVar = "sentence count chance"

    image: str = column("View")
    sentence: str = column("The same in words", head="where tie points that took no part are met worse", minLength=1)
    columns: tuple[float, float] | None = column("From, to; null for all", "px")
    rows: tuple[float, float] | None = column("From, to; null for all", "px")
    count: Count = column("Observations there that were looked at", head="looked at")
    far: float = column("Share of them that lies far off by the same")
    off_px: float = column("What the far ones are off by, by their median; else what the near ones share", "px")
    chance: float = column("Chance of as much anywhere, at most", head="p below", form=".0e")


class SceneEntry(Record):
    """The block as a whole."""

    MORE: ClassVar = Any  # of earlier releases

    shift_enu_m: Vector = column("Mean move of the tie points, east, north, up", "m")
    sigma_enu_m: Vector = column("Posterior standard deviation of the scene's place", "m")
    radius_m: Number = column(
        "RMS distance of the tie points from their middle: the edge of tilts, turn and scale", "m"
    )
    weakest_modes: tuple[ModeEntry, ...] = column("What the images cannot tell, the weakest first")
    noise: Number = column("Observed over stated standard deviation of the observations")
    drift_degree: Count = column("Degree of the rotation in the row")
    drift_sigma_m: tuple[Number, ...] = column("Its standard deviation at the first and last row, by degree", "m")
    prior_ratio: Number = column("Squared corrections over stated variances and degrees of freedom")
    cost_history: tuple[Number, ...] = column("Sum of squared whitened residuals, by linearisation")
    num_held_in_height: Count = column("Tie points seen under too small an angle, held in height")
    gcp_residuals_enu_m: tuple[Vector, ...] = column("Adjusted GCPs minus their given place", "m")
    solver: str = column("What the solver did")
    prior_shared: Number = column("Times by which stated accuracies were widened, as shared", default=1.0)
    datum: tuple[DatumEntry, ...] = column("Sources of the scene's position and shape", default=())
    dem: DemEntry | None = column("What the DEM did; null without one", default=None)
    altimetry: AltimetryEntry | None = column("What heights alone did", default=None)
    gcp_scatter: Number = column("RMS residual of the GCPs used over what their accuracies let expect", default=None)
    num_held_out: Count = column("Observations that took no part, to be measured on", default=0)
    model: str = column("Unknowns of each view that were solved for", default="")
    drift_asked: AskedEntry | None = column("What a drift of one degree less left, where one was added", default=None)
    jitter_asked: AskedEntry | None = column(
        "What was left without splines and steps, where these follow", default=None
    )
    in_space_px: Number = column("What a rotation and translation left where an affine was taken", "px", default=None)
    explanations: tuple[ExplanationEntry, ...] = column(
        "What explains tie points beside the cameras, the first first", default=()
    )
    left: tuple[LeftEntry, ...] = column("Rows and columns that stand out at the end", default=())
    held_out_places: tuple[HeldOutEntry, ...] | None = column(
        "Where tie points that took no part are met worse; null: not tested", default=None
    )


_REGION_FIELDS = attrgetter("view", "axis", "start", "stop", "share", "off", "apart", "gain", "moves")
_HELD_OUT = attrgetter("columns", "rows", "count", "far", "off", "chance")
_ALTIMETRY = attrgetter("given", "near", "agree", "spread", "expected", "motion", "sigma", "why_not")
_DEM = attrgetter("held", "known", "total", "offset", "spread", "sigma", "alike", "relief")


def measure_scene(run: Run) -> SceneEntry | None:
    """Return the block as a whole; None for a check."""
    adjustment = run.adjustment
    if adjustment is None:
        return None
    gauge, prior, terrain = adjustment.gauge, adjustment.prior, adjustment.terrain
    datum = [
        DatumEntry(part, float(sigma), **{key: float(row[m]) for key, row in adjustment.datum.items()})
        for m, (part, sigma) in enumerate(zip(MOTIONS, gauge.motion_sigma, strict=True))
    ]
    words = [MODES[mode.meaning].format(metres(mode.sigma)) for mode in gauge.modes]
    modes = [ModeEntry(m.sigma, m.meaning, m.motion.tolist(), text) for m, text in zip(gauge.modes, words, strict=True)]
    return SceneEntry(
        shift_enu_m=gauge.shift.tolist(),
        sigma_enu_m=gauge.sigma.tolist(),
        radius_m=gauge.radius,
        weakest_modes=tuple(modes),
        datum=tuple(datum),
        gcp_scatter=None if adjustment.control is None else adjustment.control.scatter,
        dem=None if terrain is None else DemEntry(*_DEM(terrain)),
        altimetry=None if adjustment.altimetry is None else AltimetryEntry(*_ALTIMETRY(adjustment.altimetry)),
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
        left=left_entries(adjustment),
        held_out_places=held_out_places(run.met_worse, adjustment.names),
    )


def _asked(adjustment: Adjustment, what: str) -> AskedEntry | None:
    test = adjustment.asked.get(what)
    if test is None:
        return None
    found = test.found(0.0)
    i = int(np.argmax(np.maximum(np.where(found, test.rms, 0.0), test.shared)))
    rms, significance, shared = (float(values[i]) for values in (test.rms, test.significance, test.shared))
    return AskedEntry(adjustment.names[i], rms, significance, shared, int(found.sum()))


def explanations(adjustment: Adjustment) -> tuple[ExplanationEntry, ...]:
    """Return what was taken, the first first."""
    found, names = [], adjustment.names
    if (apart := adjustment.apart) is not None and apart.clear and np.isfinite(apart.gain):
        other = None if apart.runner_up is None else f"{FOREIGN_CAMERA}: {names[apart.runner_up]}"
        image = names[apart.view]
        what = "many tie points of {} are wrong, or its RPC is" if apart.look.as_stated else "the RPC of {} is"
        sentence = f"{what.format(image)} not its own: {strangeness(apart)}"
        found.append(ExplanationEntry(FOREIGN_CAMERA, sentence, image, apart.gain, apart.gap, other))
    settling = [one for one in adjustment.findings if one.kind == TRANSIENT]
    found += [_explanation_entry(one, adjustment) for one in adjustment.findings if one not in settling[1:]]
    return tuple(found)


def _explanation_entry(one: Finding, adjustment: Adjustment) -> ExplanationEntry:
    """Return an explanation; of a settling of all images, the largest is told of."""
    names = adjustment.names
    # of two images each is only seen against the other
    of_pair = len(names) == 2 and one.motion is None
    image, others = names[one.view], tuple(names[v] for v in ((1 - one.view,) if of_pair else one.or_of))
    of_all = one.motion is not None or one.kind == TRANSIENT
    alike = [each for each in adjustment.findings if each.kind == TRANSIENT] if one.kind == TRANSIENT else [one]
    size = max(float(np.hypot(*each.size)) for each in alike)
    fields: dict[str, Any] = {"size_px": size, "period": one.period, "or_of": None if of_all else others or None}
    # two images do not tell what there is along their epipolar lines
    words: dict[str, Any] = {"size": size, "least": "at least " if len(names) == 2 else "", **fields}
    words["image"] = " or ".join([image, *others])
    if others and one.kind in (STRIP, FADE):  # places are those of the first
        words["image"] = f"{image} (or what {' or '.join(others)} shows of them)"
    if one.motion is not None:
        box = one.motion.box
        middle = wrap_longitude(box[0] + (box[2] - box[0]) % 360.0 / 2.0), (box[1] + box[3]) / 2.0
        side = (
            f"in the {one.motion.side} of the block" if one.motion.side else "about {:.4f}, {:.4f} deg".format(*middle)
        )
        between = names[one.motion.between[0]], names[one.motion.between[1]]
        words |= {"share": 100.0 * one.motion.share, "side": f", {side},", "metres": one.motion.metres}
        words["between"] = between
        fields = {"share": one.motion.share, "moved_m": one.motion.metres, "between": between, "box": box}
    elif one.where is not None:
        axis, start, stop, origin, rate = one.where
        words |= {"origin": origin, "length": 1.0 / max(abs(rate), 1e-9), "end": "beginning" if rate > 0.0 else "end"}
        fields["axis"] = words["axis"] = AXES[axis]
        if one.kind == TRANSIENT:
            fields = {"axis": AXES[1], "size_px": size}
        else:
            last = 2.0 * adjustment.cameras.unknowns.half[axis, one.view] - 1.0
            fields["first"], fields["last"] = np.clip((np.ceil(start), np.ceil(stop) - 1.0), 0.0, last).tolist()
            words |= fields
    numbers = one.gain, one.gap, one.runner_up or None
    return ExplanationEntry(
        one.kind, _EXPLANATION_SENTENCES[one.kind].format(**words), None if of_all else image, *numbers, **fields
    )


def strangeness(apart: ForeignCamera) -> str:
    """Return what is known of a view whose RPC is not its own."""
    look, met = apart.look, "it would agree with the other images as well as is stated of it"
    if look.swapped:
        return f"with its axes swapped, samples taken for lines, {met}"
    if look.offset is not None:
        col, row = 0.0 - look.offset
        height = "" if look.height is None else f", or with its heights moved by {-look.height:+.0f} m,"
        return f"moved by {col:+.1f} columns and {row:+.1f} rows{height} {met}"
    part = "all" if apart.contradicted == 1.0 else f"more than {int(100 * apart.contradicted)} %"
    where = "; as delivered it meets them to what is stated of it" if look.as_stated else ""
    return (
        f"{part} of its tie points contradict those of the other images, wherever it is moved or turned to, and these "
        f"agree without it{where}"
    )


def left_entries(adjustment: Adjustment) -> tuple[LeftEntry, ...]:
    """Return where something stands out at the end, the most first."""
    found = [(adjustment.names[v], AXES[axis], *rest) for v, axis, *rest in map(_REGION_FIELDS, adjustment.left)]
    return tuple(LeftEntry(image, axis, start, stop - 1.0, *rest) for image, axis, start, stop, *rest in found)


def held_out_places(places: Sequence[ImageRegion], names: Sequence[str]) -> tuple[HeldOutEntry, ...]:
    """Return where tie points that took no part are met worse, the surest first."""
    found = []
    for one in places:
        ends = [
            f"{axis} {side[0]:.0f}-{side[1] - 1.0:.0f}"
            for axis, side in (("rows", one.rows), ("columns", one.columns))
            if side is not None
        ]
        what = f"lie {one.off:.2f} px off in common"
        if one.far:
            what = f"contradict the cameras, {100 * one.far:.0f} % by the same {one.off:.2f} px"
        place = f"{', '.join(ends)} of {names[one.view]}"
        sentence = f"{place[0].upper()}{place[1:]}: tie points there that took no part {what}"
        found.append(HeldOutEntry(names[one.view], sentence, *_HELD_OUT(one)))
    return tuple(found)
