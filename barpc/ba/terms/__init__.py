"""Terms that explain residuals beside the cameras, one a module: columns, prior, price, refinement, report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from barpc.ba.evidence.periods import Period
from barpc.ba.evidence.scan import Interval
from barpc.ba.terms.common_edge import CommonEdge
from barpc.ba.terms.decay import Decay
from barpc.ba.terms.detector_line import DetectorLine
from barpc.ba.terms.low_frequency import LowFrequency
from barpc.ba.terms.moving_objects import MovingObjects
from barpc.ba.terms.sinusoid import Sinusoid
from barpc.ba.terms.step import LinesLost, Step
from barpc.ba.terms.term import Residuals, Term
from barpc.ba.terms.transient import Transient

__all__ = ["TERMS", "CommonEdge", "LinesLost", "LowFrequency", "MovingObjects", "Sinusoid", "Transient", "proposed"]

TERMS: dict[str, type[Term]] = {
    term.NAME: term
    for term in (Step, LinesLost, DetectorLine, Decay, Transient, CommonEdge, LowFrequency, Sinusoid, MovingObjects)
}
"""Name -> class of the term, in the order of proposals."""


def proposed(
    residuals: Residuals,
    intervals: list[Interval],
    periods: list[Period],
    without: Sequence[type[Term]] = (),
) -> Iterator[Term]:
    """Yield the terms for significant intervals and periods, once for each interval, image or block, by their kind."""
    for period in periods:
        yield Sinusoid.of(residuals, period)
    kinds = [kind for kind in TERMS.values() if kind not in without]
    known = set[tuple[object, ...]]()
    for interval in intervals:
        for kind in kinds:
            place = (interval.axis, interval.start, interval.stop) if kind.LOCAL else ()
            key = (kind.NAME, *(() if kind.OF_BLOCK else (interval.view, *place)))
            if key not in known and kind.may_be(residuals, intervals):
                known.add(key)
                yield from kind.propose(residuals, interval)
