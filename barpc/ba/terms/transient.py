"""A transient: a decaying displacement of the first, or last, rows of all images, as after a turn of the platform."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np

from barpc.ba.evidence.mixture import MixtureFit
from barpc.ba.evidence.scan import Interval
from barpc.ba.parameters.additional_parameters import FIRST_SIGMA
from barpc.ba.terms.decay import LENGTHS, Decay, Decaying
from barpc.ba.terms.step import open_ended
from barpc.ba.terms.term import SIZE_PRICE, Finding, Residuals
from barpc.base.geodesy import Array


class Transient(Decaying):
    """A displacement of the first, or last, rows of all images, each with its own size, and one rate of decay."""

    NAME: ClassVar[str] = "transient"
    NOUN: ClassVar[str] = "a decaying displacement at one end of all images"
    SENTENCE: ClassVar[str] = (
        "rows at the {end} of all images are displaced by up to {size:.2f} px, decaying in {length:.0f} rows"
    )
    FOLLOWED: ClassVar[bool] = True
    OF_BLOCK: ClassVar[bool] = True

    @classmethod
    def may_be(cls, residuals: Residuals, intervals: list[Interval]) -> bool:
        """Return whether all significant intervals are at the beginning of images, or all at their end."""
        at_end = [
            (one.start <= 0.0, one.stop >= residuals.size[1, one.view]) if one.axis == 1 else (False, False)
            for one in intervals
        ]
        return any(map(all, zip(*at_end, strict=True)))

    @classmethod
    def propose(cls, residuals: Residuals, interval: Interval) -> list[Self]:
        """Return the best of the transients of all lengths, at the first or at the last rows."""
        lengths = LENGTHS * float(np.median(residuals.size[1]))
        tried = [cls.at_rate(residuals, sign / length, FIRST_SIGMA) for sign in (1.0, -1.0) for length in lengths]
        return [tried[int(np.argmin([one.first_cost(residuals) for one in tried]))]]

    @classmethod
    def at_rate(cls, residuals: Residuals, rate: float, sigma: float) -> Self:
        """Return the transient of a rate [1/px] (negative: of the last rows), and prior standard deviations [px]."""
        parts = []
        for v, size in enumerate(residuals.size[1].tolist()):
            where = (1, *open_ended(0.0, size, size), 0.0 if rate > 0.0 else size, rate)
            parts.append(Decay.at(residuals, v, where, sigma))
        columns = np.concatenate([part.columns for part in parts], axis=1)
        cost, where = float(np.log(2.0)) + 2.0 * SIZE_PRICE, (1, -np.inf, np.inf, 0.0, rate)
        return cls(-1, columns, np.full(columns.shape[1], sigma), cost, where, parts=tuple(parts))

    def refined(self, residuals: Residuals, found: MixtureFit, others: Array) -> Self:
        """Return the transient with a prior as wide as the estimates."""
        return self.at_rate(residuals, self.where[4], self.prior_width(found))  # type: ignore[index]

    def findings(self, residuals: Residuals, unknowns: Array, **fields: Any) -> Iterator[Finding]:
        """Yield a record for each view."""
        for part, own in zip(self.parts, np.split(unknowns, len(self.parts)), strict=True):
            for one in part.findings(residuals, own, **fields):
                yield replace(one, kind=self.NAME)
