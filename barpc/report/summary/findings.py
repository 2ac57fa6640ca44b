"""What explains the tie points beside the cameras' errors as stated, and where something is left."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Any

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.apart import APART, Apart
from barpc.ba.evidence.places import Place
from barpc.ba.evidence.scan import Interval
from barpc.ba.judging.explanations import FADE, MOVING, SETTLING, STRIP, SWING, WANDER
from barpc.ba.judging.judge import Finding
from barpc.ba.judging.moving import Motion
from barpc.report.records import Number, Record, said
from barpc.report.summary.words import Count

AXES = "columns", "rows"
_WORDS = {
    STRIP: "{axis} {first:.0f}-{last:.0f} of {image} lie {size:.2f} px off the rest of it",
    FADE: "rows of {image} lie {size:.2f} px off at row {origin:.0f}, which fades within {length:.0f} rows",
    SETTLING: "rows at the {end} of all images lie off, by up to {size:.2f} px, which fades within {length:.0f} rows",
    WANDER: "rows of {image} wander by {size:.2f} px",
    SWING: "rows of {image} swing by {least}{size:.2f} px every {period:.0f} rows",
    MOVING: "{share} % of the tie points{side} move together (a cloud, water or shadows?), by {metres} from {first} to "
    "{second} beside what may be their height, and took no part",
}
RIVALS = {
    STRIP: "rows or columns of an image lie off",
    FADE: "rows of an image lie off and less and less",
    SETTLING: "rows at an end of all images lie off and less and less",
    WANDER: "rows of an image wander",
    SWING: "rows of an image swing",
    MOVING: "tie points move together",
}


class ExplanationEntry(Record):
    """Something that explains tie points, those that were cut among them, better than its rivals."""

    name: str = said("What it is", enum=[*_WORDS, APART])
    sentence: str = said("The same in words", minLength=1)
    image: str | None = said("View; null for what is of no single one")
    gain: float = said("Logarithm of the evidence, over that without it", "nats")
    gap: float = said("The same, over the runner-up", "nats")
    runner_up: str | None = said("What explains next as much; null for nothing", default=None)
    axis: str | None = said("Whether it is of rows or of columns", default=None, enum=[*AXES, None])
    first: Number = said("Its first row or column", "px", default=None)
    last: Number = said("Its last row or column", "px", default=None)
    size_px: Number = said("RMS displacement of what it moves; the amplitude of a swing", "px", default=None)
    period: Number = said("Rows after which a swing repeats itself", "px", default=None)
    or_of: tuple[str, ...] | None = said("Views that may be meant as well: ties do not tell which", default=None)
    share: Number = said("Tie points that move together: part of all of them", default=None)
    moved_m: Number = said("How far they move on the ground, beside what may be their height", "m", default=None)
    between: tuple[str, ...] | None = said("From the first of these views to the second", default=None)
    box: tuple[float, ...] | None = said(
        "Where nine in ten of them lie, each way: west, south, east, north", "deg", default=None
    )


class LeftEntry(Record):
    """Rows or columns of an image in which tie points were cut, or are off, more than elsewhere and chance allow."""

    image: str = said("View")
    axis: str = said("Rows or columns", enum=list(AXES))
    first: float = said("The first", "px")
    last: float = said("The last", "px")
    rejected: float = said("Share of their tie points that was cut")
    off_px: float = said("What the others have in common", "px")
    apart_px: float = said("Half of those that were cut contradict the others by more than this", "px")
    gain: float = said("Logarithm of the likelihood, over that of a whole image alike", "nats")
    moving: bool = said("Whether the share is not of what was cut, but of a group that moves", default=False)


class HeldOutEntry(Record):
    """Rows, columns or a cell of an image in which tie points that took no part are met worse than elsewhere in it."""

    image: str = said("View")
    sentence: str = said("The same in words", minLength=1)
    columns: tuple[float, float] | None = said("From, to; null for all", "px")
    rows: tuple[float, float] | None = said("From, to; null for all", "px")
    count: Count = said("Observations there that were looked at")
    far: float = said("Share of them that lies far off by the same")
    off_px: float = said("What the far ones are off by, by their median; else what the near ones share", "px")
    chance: float = said("Probability of as much anywhere where all places are alike, at most")


def explanations(adjustment: Adjustment) -> tuple[ExplanationEntry, ...]:
    """Return what was taken, the first first."""
    found = []
    if (apart := adjustment.apart) is not None and apart.clear and np.isfinite(apart.gain):
        other = None if apart.runner_up is None else f"{APART}: {adjustment.names[apart.runner_up]}"
        image = adjustment.names[apart.view]
        what = "many tie points of {} are wrong, or its RPC is" if apart.look.as_stated else "the RPC of {} is"
        sentence = f"{what.format(image)} not its own: {strangeness(apart)}"
        found.append(ExplanationEntry(APART, sentence, image, apart.gain, apart.gap, other))
    settling = [one for one in adjustment.findings if one.kind == SETTLING]
    for one in adjustment.findings:
        if one.motion is not None:
            found.append(_moving(one, one.motion, adjustment.names))
            continue
        if one.kind == SETTLING:
            found += [_settling(settling)] if one is settling[0] else []
            continue
        image, size = adjustment.names[one.view], float(np.hypot(*one.size))
        others = tuple(adjustment.names[v] for v in one.or_of)
        place: dict[str, Any] = {}
        words: dict[str, Any] = {"image": " or ".join([image, *others]), "size": size, "period": one.period}
        # two images do not tell what there is along their epipolar lines
        words["least"] = "at least " if len(adjustment.names) == 2 else ""
        if one.where is not None:
            axis, start, stop, origin, rate = one.where
            words |= {"origin": origin, "length": 1.0 / max(abs(rate), 1e-9)}
            last = 2.0 * adjustment.cameras.unknowns.half[axis, one.view] - 1.0
            ends = float(np.clip(np.ceil(start), 0.0, last)), float(np.clip(np.ceil(stop) - 1.0, 0.0, last))
            place |= dict(zip(("axis", "first", "last"), (AXES[axis], *ends), strict=True))
        sentence = _WORDS[one.kind].format(**words, **place)
        numbers = one.gain, one.gap, one.runner_up or None
        whole = {**place, "size_px": size, "period": one.period, "or_of": others or None}
        found.append(ExplanationEntry(one.kind, sentence, image, *numbers, **whole))
    return tuple(found)


def strangeness(apart: Apart) -> str:
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


def _settling(findings: Sequence[Finding]) -> ExplanationEntry:
    one = findings[0]
    assert one.where is not None
    rate, size = one.where[4], max(float(np.hypot(*each.size)) for each in findings)
    end = "beginning" if rate > 0.0 else "end"
    sentence = _WORDS[SETTLING].format(end=end, size=size, length=1.0 / max(abs(rate), 1e-9))
    return ExplanationEntry(SETTLING, sentence, None, one.gain, one.gap, one.runner_up or None, AXES[1], size_px=size)


def _moving(one: Finding, motion: Motion, names: Sequence[str]) -> ExplanationEntry:
    between = names[motion.between[0]], names[motion.between[1]]
    words = {"share": f"{100.0 * motion.share:.0f}", "side": f", {_place(motion)},"}
    words |= {"metres": f"{motion.metres:.2g} m", "first": between[0], "second": between[1]}
    sentence = _WORDS[one.kind].format(**words)
    numbers = one.gain, one.gap, one.runner_up or None
    whole: dict[str, Any] = {"share": motion.share, "moved_m": motion.metres}
    return ExplanationEntry(one.kind, sentence, None, *numbers, **whole, between=between, box=motion.box)


def _place(motion: Motion) -> str:
    """Return where most of a group lies: a side of the block where it is on one, and longitudes and latitudes."""
    west, south, east, north = motion.box
    # as many digits as tell the ends apart by a hundredth: of a scene of any size
    size = max(min((east - west) % 360.0, north - south), 1e-6)
    digits = int(np.clip(np.round(2.0 - np.log10(size)), 1, 6))
    box = f"{_degrees(west, east, 'WE', digits)}, {_degrees(south, north, 'SN', digits)}"
    return f"in the {motion.side} of the block ({box})" if motion.side else f"at {box}"


def _degrees(low: float, high: float, sides: str, digits: int) -> str:
    if low < 0.0 <= high or high < low:  # over the equator, Greenwich or the 180th meridian
        ends = (f"{abs(end):.{digits}f} {sides[end >= 0.0]}" for end in (low, high))
        return " to ".join(ends)
    ends = (f"{abs(end):.{digits}f}" for end in ((low, high) if low >= 0.0 else (high, low)))
    return f"{'-'.join(ends)} {sides[low >= 0.0]}"


def left_entries(adjustment: Adjustment) -> tuple[LeftEntry, ...]:
    """Return where something stands out at the end, the most first."""
    return tuple(_left(one, adjustment.names) for one in adjustment.left)


_HELD_OUT = attrgetter("columns", "rows", "count", "far", "off", "chance")


def held_out_places(places: Sequence[Place], names: Sequence[str]) -> tuple[HeldOutEntry, ...]:
    """Return where tie points that took no part are met worse, the surest first."""
    return tuple(HeldOutEntry(names[one.view], held_out_place(one, names), *_HELD_OUT(one)) for one in places)


def held_out_place(one: Place, names: Sequence[str]) -> str:
    """Return the same of one, in words."""
    ends = [
        f"{axis} {side[0]:.0f}-{side[1] - 1.0:.0f}"
        for axis, side in (("rows", one.rows), ("columns", one.columns))
        if side is not None
    ]
    what = f"lie {one.off:.2f} px off in common"
    if one.far:
        share, size = f"{100 * one.far:.0f} %", f"{one.off:.2f} px"
        what = f"contradict the cameras, {share} by the same {size}"
    place = ", ".join(ends)
    return f"{place[0].upper()}{place[1:]} of {names[one.view]}: tie points there that took no part {what}"


def _left(one: Interval, names: Sequence[str]) -> LeftEntry:
    place = names[one.view], AXES[one.axis], one.start, one.stop - 1.0
    return LeftEntry(*place, one.share, one.off, one.apart, one.gain, one.moves)
