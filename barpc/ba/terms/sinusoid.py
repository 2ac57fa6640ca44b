"""A sinusoid: all rows of one image are displaced with one period, as by a vibration of the platform."""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np

from barpc.ba.evidence.mixture import MixtureFit
from barpc.ba.evidence.periods import Period, price_of_period
from barpc.ba.parameters.additional_parameters import FIRST_SIGMA
from barpc.ba.terms.term import SIZE_PRICE, Residuals, Term, in_both_coordinates
from barpc.base.geodesy import Array
from barpc.sensor.image_corrections import sine_and_cosine


class Sinusoid(Term):
    """A cosine and a sine of the rows of one image, in both coordinates."""

    NAME: ClassVar[str] = "sinusoid"
    NOUN: ClassVar[str] = "a sinusoidal displacement of the rows of an image"
    SENTENCE: ClassVar[str] = (
        "rows of {image} have a sinusoidal displacement of {least}{size:.2f} px with a period of {period:.0f} rows"
    )
    FOLLOWED: ClassVar[bool] = True

    @classmethod
    def of(cls, residuals: Residuals, found: Period) -> Self:
        """Return the sinusoid of a significant period."""
        rows = np.flatnonzero(residuals.linear.view == found.view)
        columns = in_both_coordinates(
            residuals, rows, sine_and_cosine(residuals.place[1, rows], np.array(found.period))
        )
        cost = price_of_period(float(residuals.size[1, found.view]), residuals.linear.choices) + SIZE_PRICE
        return cls(found.view, columns, np.full(columns.shape[1], FIRST_SIGMA), cost, period=found.period)

    def amplitude(self, residuals: Residuals, found: MixtureFit) -> float:
        """Return its amplitude [px]."""
        return float(np.hypot(*_amplitude(found.extra[-len(self.sigma) :])))

    def size(self, residuals: Residuals, unknowns: Array) -> Array:
        """Return its amplitude (2,), col and row [px]."""
        return _amplitude(unknowns)


def _amplitude(unknowns: Array) -> Array:
    """Return the amplitude (2,), col and row, of a cosine and a sine in each coordinate."""
    amplitude: Array = np.hypot(*unknowns.reshape(2, 2).T)
    return amplitude
