"""A line of detectors: each detector of one image is displaced by itself, between edges at two or more columns."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np

from barpc.ba.evidence.mixture import MixtureFit, off_from_right
from barpc.ba.evidence.scan import Interval
from barpc.ba.parameters.additional_parameters import DRIFTS, FIRST_SIGMA
from barpc.ba.terms.step import Step, open_ended
from barpc.ba.terms.term import Finding, Residuals, Term
from barpc.base.geodesy import Array
from barpc.base.statistics import FEW, SURE


class DetectorLine(Term):
    """Columns of one image between successive edges are displaced, each part by itself."""

    NAME: ClassVar[str] = "detector_line"
    NOUN: ClassVar[str] = "displaced detectors of an image"
    SENTENCE: ClassVar[str] = Step.SENTENCE
    FOLLOWED: ClassVar[bool] = True

    @classmethod
    def may_be(cls, residuals: Residuals, intervals: list[Interval]) -> bool:
        """Return whether some columns are significant."""
        return any(one.axis == 0 for one in intervals)

    @classmethod
    def propose(cls, residuals: Residuals, interval: Interval) -> list[Self]:
        """Return the line of the interval's image, if its residuals change at two columns or more."""
        if interval.axis:
            return []
        base = residuals.base
        edges = change_points(residuals, interval.view, base, np.einsum("cek,e->ck", residuals.extra, base.extra))
        return [cls.at(residuals, interval.view, edges)] if len(edges) > 1 else []

    @classmethod
    def at(cls, residuals: Residuals, view: int, edges: list[float], sigma: float = FIRST_SIGMA) -> Self:
        """Return the line with edges at columns [px], and the prior standard deviation of its displacements [px].

        Displacements are relative to the columns before the first edge.
        """
        width = float(residuals.size[0, view])
        ends = (open_ended(start, stop, width) for start, stop in pairwise([*edges, width]))
        parts = tuple(Step.at(residuals, view, (0, *one, 0.0, 0.0), sigma) for one in ends)
        columns = np.concatenate([part.columns for part in parts], axis=1)
        price = sum(part.price for part in parts)
        return cls(view, columns, np.full(columns.shape[1], sigma), price, parts=parts)

    def refined(self, residuals: Residuals, found: MixtureFit, others: Array) -> Self:
        """Return the line with edges by the cameras of the fit, and a prior as wide as its displacements."""
        edges = change_points(residuals, self.view, found, others)
        return self.at(residuals, self.view, edges, self.prior_width(found)) if len(edges) > 1 else self

    def findings(self, residuals: Residuals, unknowns: Array, **fields: Any) -> Iterator[Finding]:
        """Yield a step for each part."""
        for part, own in zip(self.parts, np.split(unknowns, len(self.parts)), strict=True):
            yield from part.findings(residuals, own, **fields)


def change_points(residuals: Residuals, view: int, found: MixtureFit, others: Array) -> list[float]:
    """Return the columns [px], ascending, at which the mean residual of a view changes significantly.

    Residuals are those of a fit `found` with displacements `others` (2, K) [px], against ground points intersected from
    inliers. Candidates are found by binary segmentation. The least significant one beside the others and a trend, which
    the cameras follow, is removed until all are significant.
    """
    linear, price = residuals.linear, Step.at(residuals, view, (0, 0.0, 1.0, 0.0, 0.0)).price + SURE
    off, _ = off_from_right(linear, linear.left(found.step) + others / linear.sigma, found.right)
    rows = np.flatnonzero((linear.view == view) & linear.taking_part & (found.right > 0.5))
    rows = rows[np.argsort(residuals.place[0, rows], kind="stable")]
    col, values = residuals.place[0, rows], off[:, rows].T / found.noise
    edges = _divided(np.vstack([np.zeros(2), np.cumsum(values, axis=0)]), 0, len(rows), price)
    smooth, at = np.vander(2.0 * col / residuals.size[0, view] - 1.0, DRIFTS), np.arange(len(rows))
    while edges:
        design = np.column_stack([at[:, None] >= edges, smooth])
        inverse = np.linalg.pinv(design.T @ design)
        jumps = (inverse @ design.T @ values)[: len(edges)]
        gain = 0.5 * (jumps**2).sum(axis=1) / inverse.diagonal()[: len(edges)]
        if gain.min() > price:
            break
        del edges[int(gain.argmin())]
    return [0.5 * float(col[n - 1] + col[n]) for n in edges]


def _divided(sums: Array, first: int, stop: int, price: float) -> list[int]:
    """Return the indices between `first` and `stop` at which a mean changes, ascending, by binary segmentation.

    `sums` (n + 1, 2) are cumulative sums of values of unit variance. A part is divided where the log-likelihood gain is
    largest, with at least `FEW` values on each side, if it exceeds `price` [nats].
    """
    count, whole = np.arange(FEW, stop - first - FEW + 1), stop - first
    if not len(count):
        return []
    left, right = sums[first + count] - sums[first], sums[stop] - sums[first + count]
    change = left / count[:, None] - right / (whole - count)[:, None]
    gain = 0.5 * (change**2).sum(axis=1) * count * (whole - count) / whole
    at = first + int(count[gain.argmax()])
    return [*_divided(sums, first, at, price), at, *_divided(sums, at, stop, price)] if gain.max() > price else []
