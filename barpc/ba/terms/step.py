"""A step: rows or columns of one image are displaced as a whole, as by a detector, a lost line or a stitched part."""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np

from barpc.ba.evidence.mixture import MixtureFit, log_likelihoods
from barpc.ba.evidence.scan import Interval, price
from barpc.ba.parameters.additional_parameters import FIRST_SIGMA
from barpc.ba.terms.term import SIZE_PRICE, Residuals, Term, Where
from barpc.base.geodesy import Array
from barpc.base.statistics import SURE
from barpc.sensor.image_corrections import profile


class ImagePart(Term):
    """A displacement (col, row) of a part of one image, which may decay along it."""

    FOLLOWED: ClassVar[bool] = True
    LOCAL: ClassVar[bool] = True
    NUM_SHAPES: ClassVar[int]  # shape parameters that have a price: size, length of a decay

    @classmethod
    def at(cls, residuals: Residuals, view: int, where: Where, sigma: float = FIRST_SIGMA) -> Self:
        """Return the term for a part `where` of a view, with prior standard deviation `sigma` [px]."""
        axis, *shape = where
        own = residuals.linear.view == view
        part = np.where(own, profile(residuals.place[axis], *map(np.asarray, shape)), 0.0)
        columns = np.zeros((2, 2, len(part)))
        columns[0, 0] = columns[1, 1] = part
        cost = price(residuals.linear.choices) + cls.NUM_SHAPES * SIZE_PRICE
        return cls(view, columns, np.full(2, sigma), cost, where)

    def size(self, residuals: Residuals, unknowns: Array) -> Array:
        """Return the displacement (2,), col and row [px]; with a decay, that at its origin."""
        return unknowns

    def gains(self, residuals: Residuals, found: MixtureFit, others: Array) -> tuple[Array, Array]:
        """Return positions (n,) [px] of the observations of the view, ascending, and the log-likelihood gain (n,).

        The gain is that of displacing all observations, not only those in the part. `found`, `others`: see `refined`.
        """
        linear = residuals.linear
        axis, _, _, *decay = self.where  # type: ignore[misc]
        rows = np.flatnonzero(linear.view == self.view)
        rows = rows[np.argsort(residuals.place[axis, rows], kind="stable")]
        left = linear.residual_after(found.step) + others / linear.sigma
        displaced, place = left.copy(), residuals.place[axis, rows]
        everywhere = profile(place, -np.inf, np.inf, *decay)  # type: ignore[arg-type]
        displaced[:, rows] += found.extra[-len(self.sigma) :, None] * everywhere / linear.sigma[rows]
        gain = log_likelihoods(linear, displaced, found) - log_likelihoods(linear, left, found)
        return place, gain[rows]


class Step(ImagePart):
    """Rows or columns of one image are displaced as a whole."""

    NAME: ClassVar[str] = "step"
    NOUN: ClassVar[str] = "displaced rows or columns of an image"
    SENTENCE: ClassVar[str] = "{axis} {first:.0f}-{last:.0f} of {image} are displaced by {size:.2f} px"
    NUM_SHAPES: ClassVar[int] = 1

    @classmethod
    def propose(cls, residuals: Residuals, interval: Interval) -> list[Self]:
        """Return the step of an interval."""
        size = float(residuals.size[interval.axis, interval.view])
        ends = open_ended(interval.start, interval.stop, size)
        return [cls.at(residuals, interval.view, (interval.axis, *ends, 0.0, 0.0))]

    def refined(self, residuals: Residuals, found: MixtureFit, others: Array) -> Self:
        """Return the step with the ends of largest likelihood, and a prior as wide as its size."""
        place, gain = self.gains(residuals, found, others)
        axis = self.where[0]  # type: ignore[index]
        first, last = largest_part(gain)
        # an end within the image must be significant: few tie points beyond it may be wrong
        first = 0 if gain[:first].sum() > -SURE else first
        last = len(gain) - 1 if gain[last + 1 :].sum() > -SURE else last
        start = -np.inf if first == 0 else 0.5 * (place[first - 1] + place[first])
        stop = np.inf if last == len(gain) - 1 else 0.5 * (place[last] + place[last + 1])
        size = float(residuals.size[axis, self.view])
        ends = open_ended(max(start, 0.0), min(stop, size), size)
        return self.at(residuals, self.view, (axis, *ends, 0.0, 0.0), self.prior_width(found))


class LinesLost(Step):
    """A step by a whole number of rows: lost or repeated lines. `image_terms` makes it from a `Step`."""

    NAME: ClassVar[str] = "lines_lost"
    NOUN: ClassVar[str] = "lines lost, or repeated"
    SENTENCE: ClassVar[str] = "{lines} at row {edge:.0f} of {image}"

    @classmethod
    def propose(cls, residuals: Residuals, interval: Interval) -> list[Self]:
        """Return no terms: `Step` is proposed instead."""
        return []


def open_ended(start: float, stop: float, size: float) -> tuple[float, float]:
    """Return the ends of a part [px]; those at an end of the image of length `size` [px] are moved far beyond it."""
    return (-size if start <= 0.0 else start), (2.0 * size if stop >= size else stop)


def largest_part(gain: Array) -> tuple[int, int]:
    """Return the first and last index of the run of values of largest sum (maximum subarray)."""
    sums = np.concatenate([[0.0], np.cumsum(gain)])
    lowest = np.minimum.accumulate(sums[:-1])
    last = int((sums[1:] - lowest).argmax())
    return int(sums[: last + 1].argmin()), last
