"""The block, measured: its shift and weak modes, and the explanations of its residuals in words."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any

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
from barpc.report.summary.block import (
    AXES,
    MODES,
    AltimetryEntry,
    DatumEntry,
    DemEntry,
    ExplanationEntry,
    HeldOutEntry,
    JustificationEntry,
    LeftEntry,
    ModeEntry,
    SceneEntry,
    UnseenEntry,
)
from barpc.report.summary.words import metres

_MINORITY = 1 / 3  # of the tie points: twice as many stand still; of more either part may be the one that moved

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
        unseen=_unseen_entries(adjustment),
        held_out_places=held_out_places(run.met_worse, adjustment.names),
    )


def _unseen_entries(adjustment: Adjustment) -> tuple[UnseenEntry, ...]:
    if (unseen := adjustment.unseen) is None:
        return ()
    places = [(v, axis) for v in range(2) for axis in range(2)]
    of = adjustment.names
    return tuple(UnseenEntry(of[v], AXES[a], float(unseen.pixels[v, a]), float(unseen.metres[v, a])) for v, a in places)


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
