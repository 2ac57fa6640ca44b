"""A decay: the displacement of rows of one image decreases from an origin on, as after a disturbance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np

from barpc.ba.evidence.mixture import MixtureFit, first_guess
from barpc.ba.evidence.scan import Interval
from barpc.ba.terms.step import ImagePart, Step, open_ended
from barpc.ba.terms.term import Residuals, Term
from barpc.base.geodesy import Array

LENGTHS = 2.0 ** np.arange(-7.0, 1.0)  # lengths of decays to try, as fractions of the length of the image


class Decaying(Term):
    """A term whose displacement decays exponentially along the rows."""

    def first_cost(self, residuals: Residuals) -> float:
        """Return the change of the sum of residual norms by the term, on a sample of tracks; negative: it helps."""
        precision = self.sigma**-2.0
        return first_guess(residuals.few, residuals.base, residuals.extra, self.columns, precision)[2]

    def shapes(self, residuals: Residuals, fit: Callable[[Term], MixtureFit]) -> list[Self]:
        """Return the term with the rate improved by a linearised fit, and the term itself."""
        return [self.with_rate_of(fit(self.with_rate_derivatives(residuals))), self]

    def with_rate_derivatives(self, residuals: Residuals) -> Self:
        """Return the term with columns (2, 2 e, K): its own, and their derivatives by the logarithm of the rate."""
        _, _, _, origin, rate = self.where  # type: ignore[misc]
        first_row = residuals.size[1, residuals.linear.view] if self.parts and rate < 0.0 else origin
        slope = -self.columns * np.maximum((residuals.place[1] - first_row) * rate, 0.0)
        return replace(self, columns=np.concatenate([self.columns, slope], axis=1), sigma=np.tile(self.sigma, 2))

    def with_rate_of(self, found: MixtureFit) -> Self:
        """Return the term with the rate of a fit with derivatives, within a factor of e; its columns are unchanged."""
        moved, slope = np.split(found.extra[-2 * len(self.sigma) :], 2)
        step = float(np.clip(moved @ slope / max(float(moved @ moved), 1e-30), -1.0, 1.0))
        *place, rate = self.where  # type: ignore[misc]
        return replace(self, where=(*place, rate * float(np.exp(step))))


class Decay(Decaying, ImagePart):
    """A displacement of rows of one image that decays exponentially from an origin, upwards or downwards."""

    NAME: ClassVar[str] = "decay"
    NOUN: ClassVar[str] = "a decaying displacement of the rows of an image"
    SENTENCE: ClassVar[str] = (
        "rows of {image} are displaced by {size:.2f} px at row {origin:.0f}, decaying in {length:.0f} rows"
    )
    NUM_SHAPES: ClassVar[int] = 2

    @classmethod
    def propose(cls, residuals: Residuals, interval: Interval) -> list[Self]:
        """Return the best decay downwards and the best upwards that begin at an end of the interval, if of rows."""
        if interval.axis == 0:
            return []
        # the interval is displaced, or the rest of the image is: both sides of both ends are tried
        size, own = float(residuals.size[1, interval.view]), interval.stop - interval.start
        found = []
        for sign in (1.0, -1.0):
            tried = []
            for origin in (interval.start, interval.stop):
                start, stop = (origin, size) if sign > 0 else (0.0, origin)
                ends = open_ended(start, stop, size)
                # lengths from half of the interval to the rest of the image
                halved = np.arange(np.ceil(np.log2(max(2.0 * (stop - start) / own, 1.0))) + 1.0)
                for length in (stop - start) * 0.5**halved if stop > start else ():
                    one = cls.at(residuals, interval.view, (1, *ends, origin, sign / float(length)))
                    tried.append((one.first_cost(residuals), one))
            found += [min(tried, key=lambda row: row[0])[1]] if tried else []
        return found

    def refined(self, residuals: Residuals, found: MixtureFit, others: Array) -> Self:
        """Return the decay with the origin of largest likelihood, and a prior as wide as the estimate."""
        place, gain = self.gains(residuals, found, others)
        axis, _, _, _, rate = self.where  # type: ignore[misc]
        size = float(residuals.size[axis, self.view])
        without = np.append(0.0, np.cumsum(gain)) * (1.0 if rate > 0.0 else -1.0)
        between = np.concatenate([[0.0], 0.5 * (place[1:] + place[:-1]), [size]])
        origin = float(between[int(without.argmin())])
        ends = open_ended(*((origin, size) if rate > 0.0 else (0.0, origin)), size)
        return self.at(residuals, self.view, (axis, *ends, origin, rate), self.prior_width(found))

    def simpler(self, residuals: Residuals) -> Term:
        """Return the step of the same rows, with the same prior."""
        axis, start, stop = self.where[:3]  # type: ignore[index]
        return replace(Step.at(residuals, self.view, (axis, start, stop, 0.0, 0.0)), sigma=self.sigma)
