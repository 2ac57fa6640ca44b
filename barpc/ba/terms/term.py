"""The base class of terms: unknowns beside the cameras, with their columns, priors, price and methods of the search."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from barpc.ba.evidence.linearised import Linear
from barpc.ba.evidence.mixture import Group, MixtureFit
from barpc.ba.evidence.scan import Interval
from barpc.ba.parameters.additional_parameters import FIRST_SIGMA
from barpc.ba.terms.moving_ground import GroundMotion, Motion, MovingGroup
from barpc.base.geodesy import Array
from barpc.base.statistics import TIMES
from barpc.scene import IntArray

SIZE_PRICE = float(np.log(2.0 * np.log(TIMES)))
"""Price [nats] of a size whose prior is uniform in its logarithm, up to `TIMES` times smaller or larger."""
Where = tuple[int, float, float, float, float]
"""Part of an image: axis (0: columns, 1: rows), start and stop [px], origin [px] and rate [1/px] of the decay."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """A linearised block and its fit with the terms selected so far."""

    linear: Linear
    few: Linear  # a sample of its tracks, for a first choice of candidates
    ground: GroundMotion
    place: Array  # (2, K) image coordinates of observations [px]
    size: Array  # (2, N) of the images [px]
    base: MixtureFit  # the fit with the terms selected so far
    extra: Array  # (2, e, K) columns of these terms [px]
    sigma: Array  # (e,) their prior standard deviations [px]


@dataclass(frozen=True, eq=False)
class Term:
    """Unknowns of one view, of all, or of a group of tie points, with a normal prior."""

    view: int  # -1: of no single view
    columns: Array = field(repr=False)  # (2, e, K) displacement of observations by a unit of each unknown [px]
    sigma: Array = field(repr=False)  # (e,) prior standard deviations [px]
    price: float  # of the choice among positions and sizes [nats]
    where: Where | None = None
    period: float | None = None  # [px]
    parts: tuple[Term, ...] = field(default=(), repr=False)  # one for each view or detector; (): undivided
    group: Group | None = field(default=None, repr=False)  # of moving tracks

    NAME: ClassVar[str]  # in `summary.json`
    NOUN: ClassVar[str]  # in reports
    SENTENCE: ClassVar[str]  # in reports, a format string
    FOLLOWED: ClassVar[bool] = False  # whether it is estimated with the cameras, and its effect corrected
    LOCAL: ClassVar[bool] = False  # whether it displaces a part of an image
    OF_BLOCK: ClassVar[bool] = False  # whether it displaces all images

    @classmethod
    def may_be(cls, residuals: Residuals, intervals: list[Interval]) -> bool:
        """Return whether such a term may explain the significant intervals."""
        return True

    @classmethod
    def propose(cls, residuals: Residuals, interval: Interval) -> list[Self]:
        """Return terms of this kind for a significant interval."""
        return []

    def shapes(self, residuals: Residuals, fit: Callable[[Term], MixtureFit]) -> list[Self]:
        """Return the variants of the term to refine: itself, and one whose shape parameters a `fit` improved."""
        return [self]

    def refined(self, residuals: Residuals, found: MixtureFit, others: Array) -> Self:
        """Return the term with refined ends, and a prior as wide as its estimates.

        `found` is a fit with it as the last term; `others` (2, K) [px] are the displacements by the terms before it.
        """
        return replace(self, sigma=np.full(len(self.sigma), self.prior_width(found)))

    def prior_width(self, found: MixtureFit) -> float:
        """Return a prior standard deviation [px]: the root mean square of its unknowns in a fit, within limits."""
        moved = found.extra[-len(self.sigma) :]
        return float(np.clip(np.sqrt((moved**2).mean()), FIRST_SIGMA / TIMES, FIRST_SIGMA * TIMES))

    def amplitude(self, residuals: Residuals, found: MixtureFit) -> float:
        """Return its amplitude [px] for kinds that have a least amplitude; infinity for others."""
        return np.inf

    def alternatives(self, residuals: Residuals, found: MixtureFit) -> list[Term]:
        """Return terms of other kinds that its fitted displacement resembles."""
        return []

    def simpler(self, residuals: Residuals) -> Term | None:
        """Return a similar term with fewer shape parameters; None: there is none."""
        return None

    def size(self, residuals: Residuals, unknowns: Array) -> Array:
        """Return its size (2,), col and row [px], for the record: the root mean square displacement by default."""
        of_view = residuals.linear.view == self.view
        displaced = np.einsum("cek,e->ck", self.columns[:, :, of_view], unknowns)
        return np.asarray(np.sqrt((displaced**2).mean(axis=1)))

    def share(self, residuals: Residuals) -> float:
        """Return the share of the observations of its image (or of all) that it displaces."""
        rows = (residuals.linear.view == self.view) | (self.view < 0)
        return float(self.columns[:, :, rows].any(axis=(0, 1)).sum() / max(rows.sum(), 1))

    def differs(self, other: Term) -> bool:
        """Return whether another term is a different hypothesis.

        Terms of one kind at overlapping intervals of an axis of a view are not, nor are a term and one of its parts.
        """
        if self.view == other.view and (self._is_part_of(other) or other._is_part_of(self)):
            return False
        if (self.NAME, self.view) != (other.NAME, other.view):
            return True
        if self.where is None or other.where is None:
            return False
        axis, start, stop = self.where[:3]
        axis2, start2, stop2 = other.where[:3]
        return axis != axis2 or stop <= start2 or stop2 <= start

    def _is_part_of(self, other: Term) -> bool:
        """Return whether the parts of another term are of this kind, along the same axis."""
        kinds = {(one.NAME, one.where[0]) for one in other.parts if one.where is not None}
        return self.where is not None and (self.NAME, self.where[0]) in kinds

    def findings(self, residuals: Residuals, unknowns: Array, **fields: Any) -> Iterator[Finding]:
        """Yield its records: `unknowns` (e,) are from the fit with all terms, `fields` are fields of `Finding`."""
        size = self.size(residuals, unknowns)
        yield Finding(self.NAME, self.view, self.where, size, unknowns=unknowns, period=self.period, **fields)


@dataclass(frozen=True, eq=False)
class Finding:
    """The record of a selected term."""

    kind: str  # a name of `barpc.ba.terms.TERMS`
    view: int  # -1: of no single view
    where: Where | None
    # (2,) col and row [px]: of a step its displacement, of a sinusoid its amplitude, else the root mean square
    size: Array
    gain: float  # evidence over the model without it [nats]
    gap: float  # evidence over the runner-up [nats]
    runner_up: str  # kind of the runner-up; "": none
    unknowns: Array  # (e,) estimates [px]
    period: float | None = None  # [px]
    or_of: tuple[int, ...] = ()  # other views that it may belong to: their evidence is within `SURE`
    moved: MovingGroup | None = field(default=None, repr=False)  # of moving objects
    motion: Motion | None = None  # for the report


def in_both_coordinates(residuals: Residuals, rows: IntArray, basis: Array) -> Array:
    """Return columns (2, 2 m, K) of a basis (m, n) at observations `rows` (n,): m for col, then the same m for row."""
    columns = np.zeros((2, 2 * len(basis), len(residuals.linear.view)))
    columns[0, : len(basis), rows] = columns[1, len(basis) :, rows] = basis.T
    return columns
