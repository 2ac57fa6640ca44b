"""What may be wrong beside the cameras as stated: a table of explanations, each a set of unknowns with a prior."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from barpc.ba.evidence.linearised import Linear
from barpc.ba.evidence.mixture import Group, MixtureFit, first_guess, log_likelihoods
from barpc.ba.evidence.periods import Swing, price_of_period
from barpc.ba.evidence.scan import BINS, Interval, price
from barpc.ba.judging import moving
from barpc.ba.parameters.additional_parameters import DRIFTS, FIRST_SIGMA, MIN_SPLINES, AdditionalParameters
from barpc.ba.robust.systematic_residuals import SPLINES
from barpc.base.geodesy import Array
from barpc.base.statistics import FEW, SURE, TIMES
from barpc.scene import IntArray
from barpc.sensor.image_corrections import profile
from barpc.sensor.image_corrections import sine_and_cosine as waves_of

STRIP = "step"
FADE = "decay"
TRANSIENT = "transient"
WANDER = "low_frequency"
SWING = "sinusoid"
MOVING = "moving_objects"
LOCAL = STRIP, FADE
"""Those of a part of an image."""
FOLLOWED = *LOCAL, TRANSIENT, SWING
"""Those that the adjustment follows; others may be beside them."""
_LENGTHS = 2.0 ** np.arange(-7.0, 1.0)  # of an image: over what it may fade
SCALE = float(np.log(2.0 * np.log(TIMES)))
"""Nats that are paid for a size, alike in its logarithm."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """Unknowns of one view, or of a group of ties, with a prior: a candidate for what the cameras do not explain."""

    kind: str  # a name of `EXPLANATIONS`
    view: int  # -1: of none
    extra: Array = field(repr=False)  # (2, e, K) how a unit of each moves observations [px]
    sigma: Array = field(repr=False)  # (e,) their prior [px]
    price: float  # of the choice among places and sizes [nats]
    where: Where | None = None
    period: float | None = None  # after which it repeats itself [px]
    parts: tuple[Explanation, ...] = field(default=(), repr=False)  # one a view, where it is of all
    group: Group | None = field(default=None, repr=False)


Where = tuple[int, float, float, float, float]
"""Axis (0: columns, 1: rows), start, stop, and from where and how fast it fades [px, 1/px] (`RowSpline.strips`)."""


@dataclass(frozen=True, eq=False)
class BlockResiduals:
    """Observations in the form that explanations use."""

    linear: Linear
    few: Linear  # of it some tracks, to choose with
    ground: moving.GroundMotion
    place: Array  # (2, K) [px]
    size: Array  # (2, N) of the images [px]
    base: MixtureFit  # what was found so far
    extra: Array  # (2, e, K) what of it is beside the cameras [px]
    sigma: Array  # (e,) its prior [px]


def strip(seen: BlockResiduals, interval: Interval, sigma: float = FIRST_SIGMA) -> list[Explanation]:
    """Return the explanation that a stretch of rows or columns of one image is displaced as a whole."""
    start, stop = _open_ended(interval.start, interval.stop, float(seen.size[interval.axis, interval.view]))
    return [_local(STRIP, seen, interval.view, (interval.axis, start, stop, 0.0, 0.0), sigma)]


def fade(seen: BlockResiduals, interval: Interval) -> list[Explanation]:
    """Return the explanation that rows are displaced at one end of an interval, fading upwards or downwards.

    Either the interval lies off, or the rest of its image: what fades is tried on both sides of both ends.
    """
    if interval.axis == 0:
        return []
    size, own = float(seen.size[1, interval.view]), interval.stop - interval.start
    found = []
    for sign in (1.0, -1.0):
        tried = []
        for origin in (interval.start, interval.stop):
            start, stop = (origin, size) if sign > 0 else (0.0, origin)
            ends = _open_ended(start, stop, size)
            # over what is seen to lie off and half of that at least, over the rest of the image at most
            halved = np.arange(np.ceil(np.log2(max(2.0 * (stop - start) / own, 1.0))) + 1.0)
            for length in (stop - start) * 0.5**halved if stop > start else ():
                one = _local(FADE, seen, interval.view, (1, *ends, origin, sign / float(length)), FIRST_SIGMA)
                # less than without it: others may be touched by another
                tried.append((first_guess(seen.few, seen.base, seen.extra, one.extra, one.sigma**-2.0)[2], one))
        found += [min(tried, key=lambda row: row[0])[1]] if tried else []
    return found


def _local(kind: str, seen: BlockResiduals, view: int, where: Where, sigma: float) -> Explanation:
    axis, *shape = where
    part = np.where(seen.linear.view == view, profile(seen.place[axis], *map(np.asarray, shape)), 0.0)
    extra = np.zeros((2, 2, len(part)))
    extra[0, 0] = extra[1, 1] = part
    cost = price(seen.linear.choices) + SCALE * (2.0 if kind == FADE else 1.0)
    return Explanation(kind, view, extra, np.full(2, sigma), cost, where)


def step_of(seen: BlockResiduals, one: Explanation) -> Explanation:
    """Return a decay without its decay: the rows that it begins at are displaced as a whole."""
    assert one.where is not None
    axis, start, stop = one.where[:3]
    return replace(_local(STRIP, seen, one.view, (axis, start, stop, 0.0, 0.0), FIRST_SIGMA), sigma=one.sigma)


def transient(seen: BlockResiduals, _interval: Interval) -> list[Explanation]:
    """Return the explanation that the first, or last, rows of all images are displaced and fade, each image
    by its own amount.

    So does a satellite that settles after it has turned, before every image.
    """
    shapes = [sign / length for sign in (1.0, -1.0) for length in _LENGTHS * float(np.median(seen.size[1]))]
    tried = [_transient(seen, rate, FIRST_SIGMA) for rate in shapes]
    costs = [first_guess(seen.few, seen.base, seen.extra, one.extra, one.sigma**-2.0)[2] for one in tried]
    return [tried[int(np.argmin(costs))]]


def _transient(seen: BlockResiduals, rate: float, sigma: float) -> Explanation:
    parts = []
    for v, size in enumerate(seen.size[1].tolist()):
        where = (1, *_open_ended(0.0, size, size), 0.0 if rate > 0.0 else size, rate)
        parts.append(_local(FADE, seen, v, where, sigma))
    extra = np.concatenate([part.extra for part in parts], axis=1)
    cost, where = float(np.log(2.0)) + 2.0 * SCALE, (1, -np.inf, np.inf, 0.0, rate)
    return Explanation(TRANSIENT, -1, extra, np.full(extra.shape[1], sigma), cost, where, parts=tuple(parts))


def bent(seen: BlockResiduals, one: Explanation) -> Explanation:
    """Return a fade with two more unknowns: the effect of a change of the logarithm of its rate."""
    assert one.where is not None
    _, _, _, origin, rate = one.where
    if one.parts and rate < 0.0:
        origin = seen.size[1, seen.linear.view]
    slope = -one.extra * np.maximum((seen.place[1] - origin) * rate, 0.0)
    return replace(one, extra=np.concatenate([one.extra, slope], axis=1), sigma=np.tile(one.sigma, 2))


def faster(one: Explanation, found: MixtureFit) -> Explanation:
    """Return a fade with the rate that a fit of `bent` asks for, changed by a factor e at most; only `where` is new."""
    assert one.where is not None
    moved, slope = np.split(found.extra[-2 * len(one.sigma) :], 2)
    step = float(np.clip(moved @ slope / max(float(moved @ moved), 1e-30), -1.0, 1.0))
    return replace(one, where=(*one.where[:4], one.where[4] * float(np.exp(step))))


def sharpened(seen: BlockResiduals, one: Explanation, found: MixtureFit, others: Array) -> Explanation:
    """Return an explanation with ends where single ties put them and a prior as wide as it is large.

    `found` is a fit with it, its own unknowns the last; `others` (2, K) is what those before it move [px].
    """
    moved = found.extra[-len(one.sigma) :]
    sigma = float(np.clip(np.sqrt((moved**2).mean()), FIRST_SIGMA / TIMES, FIRST_SIGMA * TIMES))
    if one.where is None:
        return replace(one, sigma=np.full(len(moved), sigma))
    if one.parts:
        return _transient(seen, one.where[4], sigma)
    axis = one.where[0]
    rows = np.flatnonzero(seen.linear.view == one.view)
    rows = rows[np.argsort(seen.place[axis, rows], kind="stable")]
    left = seen.linear.left(found.step) + others / seen.linear.sigma
    displaced = left.copy()
    everywhere = profile(seen.place[axis, rows], -np.inf, np.inf, *one.where[3:])  # type: ignore[arg-type]
    displaced[:, rows] += moved[:, None] * everywhere / seen.linear.sigma[rows]
    gain = (log_likelihoods(seen.linear, displaced, found) - log_likelihoods(seen.linear, left, found))[rows]
    place, size = seen.place[axis, rows], float(seen.size[axis, one.view])
    if one.kind == FADE:
        return _begun(seen, one, gain, place, sigma)
    first, last = _largest_part(gain)
    # an end within the image has to gain: few ties beyond it, some of them wrong, are none
    first, last = (
        (0 if gain[:first].sum() > -SURE else first),
        (len(gain) - 1 if gain[last + 1 :].sum() > -SURE else last),
    )
    start = -np.inf if first == 0 else 0.5 * (place[first - 1] + place[first])
    stop = np.inf if last == len(rows) - 1 else 0.5 * (place[last] + place[last + 1])
    ends = _open_ended(max(start, 0.0), min(stop, size), size)
    return _local(STRIP, seen, one.view, (axis, *ends, 0.0, 0.0), sigma)


def _begun(seen: BlockResiduals, one: Explanation, gain: Array, place: Array, sigma: float) -> Explanation:
    """Return a fade that begins where single ties say, by their gains in the order of their places (n,)."""
    assert one.where is not None
    axis, _, _, _, rate = one.where
    size = float(seen.size[axis, one.view])
    without = np.append(0.0, np.cumsum(gain)) * (1.0 if rate > 0.0 else -1.0)
    between = np.concatenate([[0.0], 0.5 * (place[1:] + place[:-1]), [size]])
    origin = float(between[int(without.argmin())])
    ends = (origin, size) if rate > 0.0 else (0.0, origin)
    return _local(FADE, seen, one.view, (axis, *_open_ended(*ends, size), origin, rate), sigma)


def _open_ended(start: float, stop: float, size: float) -> tuple[float, float]:
    """Return a strip that reaches an image's end goes on beyond it."""
    return (-size if start <= 0.0 else start), (2.0 * size if stop >= size else stop)


def _largest_part(gain: Array) -> tuple[int, int]:
    """Return the first and last of the run of values whose sum is the largest."""
    sums = np.concatenate([[0.0], np.cumsum(gain)])
    lowest = np.minimum.accumulate(sums[:-1])
    last = int((sums[1:] - lowest).argmax())
    return int(sums[: last + 1].argmin()), last


def wander(seen: BlockResiduals, interval: Interval) -> list[Explanation]:
    """Return the explanation that the rows of an image wander: splines, orthogonal to the drift."""
    view = interval.view
    rows = np.flatnonzero(seen.linear.view == view)
    u = 2.0 * seen.place[1, rows] / seen.size[1, view] - 1.0
    each = int(np.median(np.bincount(seen.linear.view[seen.linear.taking_part]))) // FEW
    one = _on_both(
        seen, WANDER, view, rows, AdditionalParameters(min(max(each, MIN_SPLINES), SPLINES)).splines(u), FIRST_SIGMA
    )
    return [replace(one, price=one.price + SCALE)]


def swing(seen: BlockResiduals, found: Swing) -> Explanation:
    """Return the explanation that all rows of an image swing with one period."""
    rows = np.flatnonzero(seen.linear.view == found.view)
    basis = waves_of(seen.place[1, rows], np.array(found.period))
    one = _on_both(seen, SWING, found.view, rows, basis, FIRST_SIGMA)
    costs = price_of_period(float(seen.size[1, found.view]), seen.linear.choices) + SCALE
    return replace(one, price=costs, period=found.period)


def alike(seen: BlockResiduals, one: Explanation, found: MixtureFit) -> list[Explanation]:
    """Return the strip and the fade that a view's wandering rows resemble most, drift aside."""
    size, view = float(seen.size[1, one.view]), one.view
    rows = (np.arange(BINS) + 0.5) / BINS * size
    unknowns = found.extra[-len(one.sigma) :]
    curve = unknowns.reshape(2, -1) @ AdditionalParameters(len(unknowns) // 2 + DRIFTS).splines(2.0 * rows / size - 1.0)
    drift = np.linalg.qr(np.vander(rows / size - 0.5, 3))[0]
    ends = np.stack(np.triu_indices(BINS + 1, 1)) / BINS * size
    nothing = np.zeros(ends.shape[1])
    origin, length, sign = (
        grid.ravel() for grid in np.meshgrid(np.arange(BINS) / BINS * size, _LENGTHS * size, (-1.0, 1.0))
    )
    start, stop = np.where(sign > 0.0, origin, -size), np.where(sign > 0.0, 2.0 * size, origin)
    told = []
    for kind, shapes in ((STRIP, (*ends, nothing, nothing)), (FADE, (start, stop, origin, sign / length))):
        parts = profile(rows[:, None], *shapes)
        parts -= drift @ (drift.T @ parts)
        explained = ((curve @ parts) ** 2).sum(axis=0) / np.maximum((parts**2).sum(axis=0), 0.1)
        first, last, *rest = (float(shape[int(explained.argmax())]) for shape in shapes)
        told.append(_local(kind, seen, view, (1, *_open_ended(first, last, size), rest[0], rest[1]), FIRST_SIGMA))
    return told


def _on_both(seen: BlockResiduals, kind: str, view: int, rows: IntArray, basis: Array, sigma: float) -> Explanation:
    extra = np.zeros((2, 2 * len(basis), len(seen.linear.view)))
    extra[0, : len(basis), rows] = extra[1, len(basis) :, rows] = basis.T
    return Explanation(kind, view, extra, np.full(2 * len(basis), sigma), float(np.log(seen.linear.choices)))


def group(seen: BlockResiduals, _interval: Interval) -> list[Explanation]:
    """Return the explanation that the ties of a part of the ground move."""
    one = moving.proposal(seen.linear, seen.ground, seen.base, seen.extra, seen.sigma)
    if one is None:
        return []
    none = np.zeros((2, 0, len(seen.linear.view)))
    return [Explanation(MOVING, -1, none, np.zeros(0), moving.price_of_group(seen.linear, one.cell), group=one)]


EXPLANATIONS: dict[str, Callable[[BlockResiduals, Interval], list[Explanation]]] = {
    STRIP: strip,
    FADE: fade,
    TRANSIENT: transient,
    WANDER: wander,
    MOVING: group,
}
"""Name -> unknowns, proposed where an interval of an image stands out; `SWING` is, where a period does."""
_OF_BLOCK = (MOVING, TRANSIENT)


def proposed(
    seen: BlockResiduals, intervals: list[Interval], periods: list[Swing], known_kinds: Collection[str] = ()
) -> Iterator[Explanation]:
    """Yield the explanations proposed by the intervals and periods that stand out; those of a whole image, or
    block, once.

    None of the kinds that are known.
    """
    yield from (swing(seen, one) for one in periods)
    known = set[tuple[object, ...]]()
    for interval in intervals:
        for kind in [kind for kind in EXPLANATIONS if kind not in known_kinds]:
            if kind == TRANSIENT and not _at_one_end(seen, intervals):
                continue
            place = (interval.axis, interval.start, interval.stop) if kind in LOCAL else ()
            place = () if kind in _OF_BLOCK else (interval.view, *place)
            if (kind, *place) not in known:
                known.add((kind, *place))
                yield from EXPLANATIONS[kind](seen, interval)


def _at_one_end(seen: BlockResiduals, intervals: list[Interval]) -> bool:
    """Return whether all that stands out is where images begin, or all where they end, as no wandering is."""
    at_end = [
        (one.start <= 0.0, one.stop >= seen.size[1, one.view]) if one.axis == 1 else (False, False) for one in intervals
    ]
    return any(map(all, zip(*at_end, strict=True)))
