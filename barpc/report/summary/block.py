"""The block: its shift, datum shares and weak modes, and the explanations of its residuals."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.constraints.gauge import MOTIONS
from barpc.ba.evidence.scan import ImageRegion
from barpc.ba.select.foreign_camera import FOREIGN_CAMERA, ForeignCamera
from barpc.ba.terms import TERMS
from barpc.ba.terms.term import Finding
from barpc.base.errors import listed
from barpc.base.geodesy import wrap_longitude
from barpc.base.statistics import BANDS
from barpc.report.outcome import LEAST_MOVED, MANY_REJECTED, Run
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
"""Motion of the scene -> its sentence."""
_MINORITY = 1 / 3  # of the tie points: twice as many stand still; of more either part may be the one that moved


class ModeEntry(Record):
    """A motion of the scene that the images determine poorly."""

    sigma_m: Number = column("Posterior standard deviation", "m")
    meaning: str = column("The motion", enum=MODES)
    motion_m: tuple[Number, ...] = column(
        "All motions for an error of this one by sigma_m: east, north, up, tilts, turn, scale, twist, bending",
        "m",
        min_length=7,
        max_length=len(MOTIONS),
    )
    words: str = column("Its sentence", min_length=1)


class DatumEntry(Record):
    """Sources of a motion of the scene, as shares of its information. Tie points have none."""

    part: str = column("Motion of the scene", head="motion", enum=MODES)
    sigma_m: Number = column("Posterior standard deviation (of turns: at the edge)", "m", "sigma", ".2f")
    cameras: Number = column("Accuracies of the cameras as delivered", head="cameras", form=".0%")
    earlier_run: Number = column("The earlier run", head="earlier run", form=".0%")
    fixed_views: Number = column("Fixed views", head="fixed views", form=".0%")
    gcps: Number = column("Ground control points", head="GCPs", form=".0%")
    heights: Number = column("The DEM, or altitudes assumed", head="heights", form=".0%")
    reference: Number = column("A reference orthoimage", head="reference", form=".0%", default=None)
    altimetry: Number = column(
        "Altimetry: heights without image coordinates", head="altimetry", form=".0%", default=None
    )

    @classmethod
    def columns(cls, entries: Sequence[DatumEntry]) -> str:
        """Return the columns of a table, without the sources that contribute to no motion."""
        part, sigma, *sources = cls.__dataclass_fields__
        told = [name for name in sources if any((getattr(one, name) or 0.0) >= 0.005 for one in entries)]
        return " ".join([part, sigma, *told])


class DemEntry(Record):
    """The constraint by the DEM, and the offset of the tie points from it."""

    num_held: Count = column("Tie points that it constrains")
    num_known: Count = column("Tie points where it has a height")
    num_tracks: Count = column("Tie points in use")
    offset_m: Number = column("Median of the tie points' altitudes minus the DEM's", "m")
    spread_m: Number = column("1.4826 times the median absolute deviation of these", "m")
    sigma_m: Number = column("Standard deviation of single heights, estimated from the tie points", "m", default=None)
    correlated_per_independent: Number = column("Number of correlated heights that count as one", default=None)
    relief: Number = column("The DEM's relief over the tie points'", default=None)


class AltimetryEntry(Record):
    """The constraint by altimetry: heights without image coordinates."""

    num_given: Count = column("Heights in the files")
    num_near: Count = column("Of these, those tested that lie on the surface of the tie points")
    num_agreeing: Count = column("Of these, those that agree on the position of the scene")
    spread_m: Number = column("1.4826 times the median absolute difference of those to the surface", "m")
    expected_m: Number = column("The same as expected from the stated accuracies and the surface", "m")
    motion_enu_m: Vector = column("Shift of the scene by altimetry after the tie points agree", "m")
    sigma_enu_m: Vector = column("Its standard deviation from altimetry alone", "m")
    why_not: str = column("Why they were not used; empty where they constrain the scene")


class JustificationEntry(Record):
    """Residuals of the simpler model, in the image where they are largest, that justified more parameters."""

    image: str = column("View")
    systematic_px: Number = column("RMS of its systematic residuals, noise subtracted", "px")
    systematic_p: Number = column("Probability of as much by noise alone (F test)")
    neighbour_correlated_px: Number = column("Error correlated between neighbouring observations", "px")
    num_images: Count = column("Views with a probability of the F test below 1e-4")


class ExplanationEntry(Record):
    """A selected hypothesis on the residuals of tie points, rejected ones among them."""

    PAGE: ClassVar = "sentence gain gap runner_up"

    name: str = column("Its kind", enum=[*TERMS, FOREIGN_CAMERA])
    sentence: str = column("The same as a sentence", head="explanation of residuals", min_length=1)
    image: str | None = column("View; null where it concerns several")
    gain: float = column("Logarithm of its evidence over that of the model without it", "nats", "gain", ".0f")
    gap: float = column("The same over the runner-up", "nats", "over the next", ".0f")
    runner_up: str | None = column("Kind of the runner-up; null for none", head="next", default=None)
    axis: str | None = column("Rows or columns", default=None, enum=AXES)
    first: Number = column("Its first row or column", "px", default=None)
    last: Number = column("Its last row or column", "px", default=None)
    size_px: Number = column("RMS displacement; of a sinusoid its amplitude", "px", default=None)
    period: Number = column("Period of a sinusoid in rows", "px", default=None)
    candidates: tuple[str, ...] | None = column("Other views that explain the tie points as well", default=None)
    share: Number = column("Share of tie points that move together", default=None)
    moved_m: Number = column("Their motion on the ground, apart from an effect of height", "m", default=None)
    between: tuple[str, ...] | None = column("From the first of these views to the second", default=None)
    box: tuple[float, ...] | None = column(
        "West, south, east, north limits of nine in ten of them", "deg", default=None
    )


class LeftEntry(Record):
    """Rows or columns of an image with significantly more rejected tie points, or larger residuals, than the rest."""

    PAGE: ClassVar = "image axis first last rejected off_px rejected_median_px gain"

    image: str = column("View", head="image")
    axis: str = column("Rows or columns", head="axis", enum=AXES)
    first: float = column("The first", "px", "first", ".0f")
    last: float = column("The last", "px", "last", ".0f")
    rejected: float = column("Share of their tie points that were rejected", head="rejected", form=".0%")
    off_px: float = column("Common residual of the others", "px", "common", ".2f")
    rejected_median_px: float = column("Median residual of the rejected ones", "px", "rejected by", ".2f")
    gain: float = column("Logarithm of the likelihood over that of a uniform image", "nats", "gain", ".0f")
    moving: bool = column("Whether the share is of a moving group, not of rejected tie points", default=False)
    moved_px: Number = column("The residual there as a mean over an eighth of the image", "px", default=None)

    @property
    def place(self) -> str:
        """Its rows or columns in words."""
        return f"{self.axis} {self.first:.0f}-{self.last:.0f}"


class HeldOutEntry(Record):
    """Rows, columns or a cell of an image in which check tie points have larger residuals than in the rest."""

    PAGE: ClassVar = "sentence count chance"

    image: str = column("View")
    sentence: str = column("The same as a sentence", head="larger residuals of check tie points", min_length=1)
    columns: tuple[float, float] | None = column("From, to; null for all", "px")
    rows: tuple[float, float] | None = column("From, to; null for all", "px")
    count: Count = column("Observations tested there", head="tested")
    far: float = column("Share of them with the same large residual")
    off_px: float = column("Median of the large residuals; without any the common residual", "px")
    chance: float = column("Probability of as much anywhere by chance, at most", head="p below", form=".0e")
    moved_px: Number = column(
        "The residual there as a mean over an eighth of the image; 0 of a cell", "px", default=None
    )


class SceneEntry(Record):
    """The block."""

    shift_enu_m: Vector = column("Mean shift of the tie points, east, north, up", "m")
    sigma_enu_m: Vector = column("Posterior standard deviation of the scene's position", "m")
    radius_m: Number = column(
        "RMS distance of the tie points from their centre: the edge of tilts, turn and scale", "m"
    )
    weakest_modes: tuple[ModeEntry, ...] = column("Poorly determined motions, the weakest first")
    noise: Number = column("Observed over stated standard deviation of the observations")
    drift_degree: Count = column("Degree of the rotation in the row")
    drift_sigma_m: tuple[Number, ...] = column("Its standard deviation at the first and last row, by degree", "m")
    prior_ratio: Number = column("Squared corrections over stated variances and degrees of freedom")
    cost_history: tuple[Number, ...] = column("Sum of squared whitened residuals, by linearisation")
    num_held_in_height: Count = column("Tie points with too small a convergence angle, constrained in height")
    gcp_residuals_enu_m: tuple[Vector, ...] = column("Adjusted minus given position of the GCPs", "m")
    solver: str = column("Termination of the solver")
    prior_shared: Number = column(
        "Factor by which stated accuracies were widened as errors common to all images", default=1.0
    )
    datum: tuple[DatumEntry, ...] = column("Sources of the scene's position and shape", default=())
    dem: DemEntry | None = column("Constraint by the DEM; null without one", default=None)
    altimetry: AltimetryEntry | None = column("Constraint by altimetry; null without any", default=None)
    gcp_scatter: Number = column(
        "RMS residual of the GCPs used over its expectation from their accuracies", default=None
    )
    num_held_out: Count = column("Observations of check tie points, kept out of the adjustment", default=0)
    model: str = column("Unknowns of each view", default="")
    drift_justification: JustificationEntry | None = column(
        "Residuals with a drift of one degree less, where one was added", default=None
    )
    jitter_justification: JustificationEntry | None = column(
        "Residuals without splines and steps, where these were added", default=None
    )
    rigid_model_px: Number = column(
        "RMS of check tie points with a rotation and translation, where an affine was selected", "px", default=None
    )
    explanations: tuple[ExplanationEntry, ...] = column(
        "Hypotheses on residuals in the order of their selection", default=()
    )
    left: tuple[LeftEntry, ...] = column("Rows and columns that are inconsistent with the rest in the end", default=())
    held_out_places: tuple[HeldOutEntry, ...] | None = column(
        "Regions with larger residuals of check tie points; null: not tested", default=None
    )


_REGION_FIELDS = attrgetter("view", "axis", "start", "stop", "share", "off", "apart", "gain", "moves", "part")
_HELD_OUT = attrgetter("columns", "rows", "count", "far", "off", "chance", "moved")
_ALTIMETRY = attrgetter("given", "near", "agree", "spread", "expected", "motion", "sigma", "why_not")
_DEM = attrgetter("held", "known", "total", "offset", "spread", "sigma", "alike", "relief")


def measure_scene(run: Run) -> SceneEntry | None:
    """Return the record of the block; None for a check."""
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
        rigid_model_px=adjustment.in_space_rms,
        drift_justification=_justification(adjustment, "drift"),
        jitter_justification=_justification(adjustment, "jitter"),
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


def _justification(adjustment: Adjustment, what: str) -> JustificationEntry | None:
    test = adjustment.asked.get(what)
    if test is None:
        return None
    found = test.found(0.0)
    i = int(np.argmax(np.maximum(np.where(found, test.rms, 0.0), test.shared)))
    rms, significance, shared = (float(values[i]) for values in (test.rms, test.significance, test.shared))
    return JustificationEntry(adjustment.names[i], rms, significance, shared, int(found.sum()))


def explanations(adjustment: Adjustment) -> tuple[ExplanationEntry, ...]:
    """Return the selected hypotheses in their order."""
    found, names = [], adjustment.names
    if (apart := adjustment.apart) is not None and apart.clear and np.isfinite(apart.gain):
        other = None if apart.runner_up is None else f"{FOREIGN_CAMERA}: {names[apart.runner_up]}"
        image = names[apart.view]
        what = "many tie points of {} are wrong, or its RPC" if apart.look.as_stated else "the RPC of {}"
        sentence = f"{what.format(image)} does not match the image: {strangeness(apart)}"
        found.append(ExplanationEntry(FOREIGN_CAMERA, sentence, image, apart.gain, apart.gap, other))
    rows = {(one.kind, one.gain) if TERMS[one.kind].OF_BLOCK else one: one for one in reversed(adjustment.findings)}
    found += [_explanation_entry(one, adjustment) for one in reversed(rows.values())]  # of all images, the first
    return tuple(found)


def _explanation_entry(one: Finding, adjustment: Adjustment) -> ExplanationEntry:
    """Return the record of a hypothesis; of a term of all images, with its largest displacement."""
    names = adjustment.names
    # two images only determine a relative displacement
    of_pair = len(names) == 2 and one.motion is None
    image, others = names[one.view], tuple(names[v] for v in ((1 - one.view,) if of_pair else one.or_of))
    of_all = one.motion is not None or TERMS[one.kind].OF_BLOCK
    same = [each for each in adjustment.findings if (each.kind, each.gain) == (one.kind, one.gain)]
    alike = same if of_all else [one]
    size = max(float(np.hypot(*each.size)) for each in alike)
    fields: dict[str, Any] = {"size_px": size, "period": one.period, "candidates": None if of_all else others or None}
    # two images do not determine displacements along their epipolar lines
    words: dict[str, Any] = {"size": size, "least": "at least " if len(names) == 2 else "", **fields}
    words["image"] = " or ".join([image, *others])
    if others and TERMS[one.kind].LOCAL:  # places are those of the first
        words["image"] = f"{image} (or the same ground in {' or '.join(others)}{', or it moves' * of_pair})"
    if one.motion is not None:
        box = one.motion.box
        middle = wrap_longitude(box[0] + (box[2] - box[0]) % 360.0 / 2.0), (box[1] + box[3]) / 2.0
        side = (
            f"in the {one.motion.side} of the block" if one.motion.side else "about {:.4f}, {:.4f} deg".format(*middle)
        )
        between = names[one.motion.between[0]], names[one.motion.between[1]]
        words |= {"share": 100.0 * one.motion.share, "side": f", {side},", "metres": one.motion.metres}
        words |= {"between": between, "cause": _motion_cause(*one.motion.dates), "larger": "", "control": ""}
        if one.motion.gcps:
            words["control"] = f", with the GCPs {listed(one.motion.gcps)}"
        if one.motion.share > _MINORITY:
            larger = "the smaller part, whose cameras are nearer to their priors,"
            larger = larger if one.motion.share > 0.5 else "the larger part of the ground"
            words["larger"] = f"; {larger} was taken to stand still"
        fields = {"share": one.motion.share, "moved_m": one.motion.metres, "between": between, "box": box}
    elif one.where is not None:
        axis, start, stop, origin, rate = one.where
        words |= {"origin": origin, "length": 1.0 / max(abs(rate), 1e-9), "end": "beginning" if rate > 0.0 else "end"}
        fields["axis"] = words["axis"] = AXES[axis]
        if TERMS[one.kind].OF_BLOCK:
            fields = {"axis": AXES[axis], "size_px": size}
            words["first"] = np.ceil(start)
        else:
            last = 2.0 * adjustment.cameras.unknowns.half[axis, one.view] - 1.0
            from_start = start <= 0.0  # of lines lost: rows behind them are seen early
            words["edge"] = np.ceil(stop if from_start else start)
            lost = "lost" if (one.size[1] < 0.0) != from_start else "repeated"
            words["lines"] = f"{size:.0f} line{'s were' if size > 1.5 else ' was'} {lost}"
            fields["first"], fields["last"] = np.clip((np.ceil(start), np.ceil(stop) - 1.0), 0.0, last).tolist()
            words |= fields
    numbers = one.gain, one.gap, one.runner_up or None
    return ExplanationEntry(
        one.kind, TERMS[one.kind].SENTENCE.format(**words), None if of_all else image, *numbers, **fields
    )


def _motion_cause(first: str, second: str) -> str:
    """Return the possible causes of a motion between two views, by their dates, which may be empty, in words."""
    objects, ground = "a cloud, water or shadows", "a glacier, a landslide, a fault"
    if first and second:
        return f"{objects}?" if first == second else f"{ground}, or change between {first} and {second}?"
    return f"{objects}, or, between dates, {ground}?"


def strangeness(apart: ForeignCamera) -> str:
    """Return the diagnosis of a foreign camera in words."""
    look, met = apart.look, "it would agree with the other images within its stated accuracy"
    if look.swapped:
        return f"with its axes swapped (samples for lines) {met}"
    if look.offset is not None:
        col, row = 0.0 - look.offset
        height = "" if look.height is None else f", or its heights by {-look.height:+.0f} m,"
        return f"shifted by {col:+.1f} columns and {row:+.1f} rows{height} {met}"
    if not apart.contradicted >= 0.01:
        return "as delivered its tie points contradict those of the other images, and these agree without it"
    part = "all" if apart.contradicted == 1.0 else f"more than {int(100 * apart.contradicted)} %"
    where = "; as delivered it agrees with them within its stated accuracy" if look.as_stated else ""
    return (
        f"{part} of its tie points contradict those of the other images for every shift and rotation, and these "
        f"agree without it{where}"
    )


def matters(one: LeftEntry | HeldOutEntry) -> bool:
    """Return whether the residuals of a region displace an eighth of the image by more than `LEAST_MOVED`."""
    return one.moved_px is not None and one.moved_px > LEAST_MOVED


def left_entries(adjustment: Adjustment) -> tuple[LeftEntry, ...]:
    """Return the regions that are inconsistent with the rest, the most significant first."""
    found = []
    for v, axis, start, stop, rejected, off, apart, gain, moving, part in map(_REGION_FIELDS, adjustment.left):
        residual = max(off, rejected * apart if rejected > MANY_REJECTED else 0.0)
        sizes = rejected, off, apart, gain, moving, residual * min(BANDS * part, 1.0)
        found.append(LeftEntry(adjustment.names[v], AXES[axis], start, stop - 1.0, *sizes))
    return tuple(found)


def held_out_places(places: Sequence[ImageRegion], names: Sequence[str]) -> tuple[HeldOutEntry, ...]:
    """Return the regions with larger residuals of check tie points, the most significant first."""
    found = []
    for one in places:
        ends = [
            f"{axis} {side[0]:.0f}-{side[1] - 1.0:.0f}"
            for axis, side in (("rows", one.rows), ("columns", one.columns))
            if side is not None
        ]
        what = f"share a residual of {one.off:.2f} px"
        if one.far:
            what = f"contradict the cameras, {100 * one.far:.0f} % by the same {one.off:.2f} px"
        place = f"{', '.join(ends)} of {names[one.view]}"
        sentence = f"{place[0].upper()}{place[1:]}: check tie points there {what}"
        found.append(HeldOutEntry(names[one.view], sentence, *_HELD_OUT(one)))
    return tuple(found)
