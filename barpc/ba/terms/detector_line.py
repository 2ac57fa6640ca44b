"""A line of detectors: each detector of one image has a displacement, between edges at two or more columns."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np

from barpc.ba.evidence.mixture import MixtureFit, residuals_from_inliers
from barpc.ba.evidence.scan import Interval
from barpc.ba.parameters.additional_parameters import DRIFTS, FIRST_SIGMA
from barpc.ba.terms.step import Step, open_ended
from barpc.ba.terms.term import Finding, Residuals, Term
from barpc.base.geodesy import Array
from barpc.base.statistics import FEW, OUTLIER, SURE, robust_spread


class DetectorLine(Term):
    """Displacements of the columns of one image between successive edges, one for each part."""

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
        """Return the line of the image, if its mean residuals change at two columns or more."""
        if interval.axis:
            return []
        base = residuals.base
        others = np.einsum("cek,e->ck", residuals.extra, base.extra)
        edges = change_points(residuals, interval.view, base, others)
        return [cls.at(residuals, interval.view, edges)] if len(edges) > 1 else []

    @classmethod
    def at(cls, residuals: Residuals, view: int, edges: list[float], sigma: float = FIRST_SIGMA) -> Self:
        """Return the line with edges at columns [px], and prior standard deviation `sigma` of displacements [px].

        Displacements are relative to the columns before the first edge.
        """
        width = float(residuals.size[0, view])
        ends = (open_ended(start, stop, width) for start, stop in pairwise([*edges, width]))
        parts = tuple(Step.at(residuals, view, (0, *one, 0.0, 0.0), sigma) for one in ends)
        columns = np.concatenate([part.columns for part in parts], axis=1)
        price = sum(part.price for part in parts)
        return cls(view, columns, np.full(columns.shape[1], sigma), price, parts=parts)

    def refined(self, residuals: Residuals, found: MixtureFit, others: Array) -> Self:
        """Return the line with edges found beside the cameras of the fit, and a prior as wide as the estimates."""
        own = np.einsum("cek,e->ck", self.columns, found.extra[-len(self.sigma) :])
        edges = change_points(residuals, self.view, found, others, own)
        return self.at(residuals, self.view, edges, self.prior_width(found)) if len(edges) > 1 else self

    def findings(self, residuals: Residuals, unknowns: Array, **fields: Any) -> Iterator[Finding]:
        """Yield a step for each part."""
        for part, own in zip(self.parts, np.split(unknowns, len(self.parts)), strict=True):
            yield from part.findings(residuals, own, **fields)


def change_points(
    residuals: Residuals, view: int, found: MixtureFit, others: Array, own: Array | None = None
) -> list[float]:
    """Return the columns [px], ascending, at which the mean residual of a view changes significantly.

    Residuals are those of the fit `found`, beside displacements `others` (2, K) [px] by other terms. Ground points are
    intersected from inliers. If a line is in the fit, its displacements `own` (2, K) [px] are removed for that only.
    Without `own`, rejected observations are used, too: those of displaced detectors may be rejected.

    Candidates are found by binary segmentation. They are estimated together with a trend, which the cameras may absorb.
    The least significant one is removed until all are significant.
    """
    linear, price = residuals.linear, Step.at(residuals, view, (0, 0.0, 1.0, 0.0, 0.0)).price + SURE
    left = linear.residual_after(found.step) + others / linear.sigma
    off, known = residuals_from_inliers(linear, left, found.right)
    right = found.right > 0.5
    rows = (linear.view == view) & linear.in_tracks & (known | right if own is None else right)
    order = np.flatnonzero(rows)[np.argsort(residuals.place[0, rows], kind="stable")]
    col, plain = residuals.place[0, order], _limited(off[:, order].T / found.noise)
    values = plain
    if own is not None:  # points of two and of three images absorb different shares of a large displacement
        moved = own / linear.sigma
        off, _ = residuals_from_inliers(linear, left + moved, found.right)
        values = _limited((off - moved)[:, order].T / found.noise)
    edges = _segmented(_cumulative_sums(values), 0, len(order), price)
    smooth, at = np.vander(2.0 * col / residuals.size[0, view] - 1.0, DRIFTS), np.arange(len(order))
    while edges:
        design = np.column_stack([at[:, None] >= edges, smooth])
        inverse = np.linalg.pinv(design.T @ design)
        jumps = (inverse @ design.T @ values)[: len(edges)]
        gain = 0.5 * (jumps**2).sum(axis=1) / inverse.diagonal()[: len(edges)]
        if gain.min() > price:
            break
        del edges[int(gain.argmin())]
    sums = _cumulative_sums(plain)
    for n in range(len(edges)):  # each again, as its neighbours were found after it
        first, stop = (edges[n - 1] if n else 0), (edges[n + 1] if n + 1 < len(edges) else len(order))
        edges[n] = _best_split(sums, first, stop)[0]
    return [0.5 * float(col[n - 1] + col[n]) for n in edges]


def _limited(values: Array) -> Array:
    """Return values (n, 2), limited to `OUTLIER` times their spread."""
    most = OUTLIER * max(robust_spread(values.ravel()), 1.0) if len(values) else 0.0
    return np.clip(values, -most, most)


def _cumulative_sums(values: Array) -> Array:
    """Return the sums (n + 1, 2) of the first 0, 1 ... n of the values (n, 2)."""
    return np.vstack([np.zeros(2), np.cumsum(values, axis=0)])


def _segmented(sums: Array, first: int, stop: int, price: float) -> list[int]:
    """Return the indices between `first` and `stop` at which the mean changes, ascending, by binary segmentation.

    A part is divided at its `_best_split`, if the gain of that exceeds `price` [nats].
    """
    at, gain = _best_split(sums, first, stop)
    return [*_segmented(sums, first, at, price), at, *_segmented(sums, at, stop, price)] if gain > price else []


def _best_split(sums: Array, first: int, stop: int) -> tuple[int, float]:
    """Return the index that divides values `first` to `stop` into two means of largest likelihood, and the gain [nats].

    `sums` (n + 1, 2) are cumulative sums of values of unit variance. Both sides have at least `FEW` values; without
    such an index the gain is 0.
    """
    count, whole = np.arange(FEW, stop - first - FEW + 1), stop - first
    if not len(count):
        return first, 0.0
    left, right = sums[first + count] - sums[first], sums[stop] - sums[first + count]
    change = left / count[:, None] - right / (whole - count)[:, None]
    gain = 0.5 * (change**2).sum(axis=1) * count * (whole - count) / whole
    return first + int(count[gain.argmax()]), float(gain.max())
