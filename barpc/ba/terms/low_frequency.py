"""A low-frequency displacement of the rows of one image, beyond the polynomial drift."""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np

from barpc.ba.evidence.mixture import MixtureFit
from barpc.ba.evidence.scan import BINS, Interval
from barpc.ba.parameters.additional_parameters import (
    DRIFTS,
    FIRST_SIGMA,
    MIN_SPLINES,
    AdditionalParameters,
    most_splines,
)
from barpc.ba.robust.systematic_residuals import SPLINES
from barpc.ba.terms.decay import LENGTHS, Decay
from barpc.ba.terms.step import ImagePart, Step, open_ended
from barpc.ba.terms.term import SIZE_PRICE, Residuals, Term, in_both_coordinates
from barpc.sensor.image_corrections import profile


class LowFrequency(Term):
    """A displacement of rows of one image by splines that are orthogonal to the polynomials of the drift."""

    NAME: ClassVar[str] = "low_frequency"
    NOUN: ClassVar[str] = "a low-frequency displacement of the rows of an image"
    SENTENCE: ClassVar[str] = "rows of {image} have a low-frequency displacement of {size:.2f} px"

    @classmethod
    def propose(cls, residuals: Residuals, interval: Interval) -> list[Self]:
        """Return the splines of the image of an interval; their number is limited by the observations of an image."""
        view, linear = interval.view, residuals.linear
        rows = np.flatnonzero(linear.view == view)
        u = 2.0 * residuals.place[1, rows] / residuals.size[1, view] - 1.0
        most = most_splines(linear.view[linear.in_tracks])
        basis = AdditionalParameters(min(max(most, MIN_SPLINES), SPLINES)).splines(u)
        sigma = np.full(2 * len(basis), FIRST_SIGMA)
        cost = float(np.log(linear.choices)) + SIZE_PRICE
        return [cls(view, in_both_coordinates(residuals, rows, basis), sigma, cost)]

    def alternatives(self, residuals: Residuals, found: MixtureFit) -> list[Term]:
        """Return the step and the decay that most resemble the fitted curve, apart from a drift."""
        size = float(residuals.size[1, self.view])
        rows = (np.arange(BINS) + 0.5) / BINS * size
        splines = AdditionalParameters(len(self.sigma) // 2 + DRIFTS).splines(2.0 * rows / size - 1.0)
        curve = found.extra[-len(self.sigma) :].reshape(2, -1) @ splines
        drift = np.linalg.qr(np.vander(rows / size - 0.5, 3))[0]
        ends = np.stack(np.triu_indices(BINS + 1, 1)) / BINS * size
        nothing = np.zeros(ends.shape[1])
        grid = np.meshgrid(np.arange(BINS) / BINS * size, LENGTHS * size, (-1.0, 1.0))
        origin, length, sign = (values.ravel() for values in grid)
        start, stop = np.where(sign > 0.0, origin, -size), np.where(sign > 0.0, 2.0 * size, origin)
        kinds: tuple[tuple[type[ImagePart], tuple[np.ndarray, ...]], ...] = (
            (Step, (*ends, nothing, nothing)),
            (Decay, (start, stop, origin, sign / length)),
        )
        terms: list[Term] = []
        for kind, shapes in kinds:
            parts = profile(rows[:, None], *shapes)
            parts -= drift @ (drift.T @ parts)
            explained = ((curve @ parts) ** 2).sum(axis=0) / np.maximum((parts**2).sum(axis=0), 0.1)
            first, last, *rest = (float(shape[int(explained.argmax())]) for shape in shapes)
            terms.append(kind.at(residuals, self.view, (1, *open_ended(first, last, size), rest[0], rest[1])))
        return terms
