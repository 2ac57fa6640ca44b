"""A term: unknowns beside the cameras, with their columns, prior and price, and its part in the search."""

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
"""Price of a size whose prior is uniform in its logarithm [nats]."""
Where = tuple[int, float, float, float, float]
"""Axis (0: columns, 1: rows), start, stop, origin and rate of the decay [px, 1/px] (`RowSpline.strips`)."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a block, linear in its unknowns, after the fit with the terms taken so far."""

    linear: Linear
    few: Linear  # a sample of its tracks, for a first choice
    ground: GroundMotion
    place: Array  # (2, K) where observations are [px]
    size: Array  # (2, N) of the images [px]
    base: MixtureFit  # with the terms taken so far
    extra: Array  # (2, e, K) columns of these [px]
    sigma: Array  # (e,) their prior [px]


@dataclass(frozen=True, eq=False)
class Term:
    """Unknowns of one view, of all, or of a group of tie points, with a normal prior."""

    view: int  # -1: of none
    columns: Array = field(repr=False)  # (2, e, K) displacement of observations by a unit of each unknown [px]
    sigma: Array = field(repr=False)  # (e,) prior standard deviations [px]
    price: float  # of the choice among places and sizes [nats]
    where: Where | None = None
    period: float | None = None  # [px]
    parts: tuple[Term, ...] = field(default=(), repr=False)  # one a view, for a term of all images
    group: Group | None = field(default=None, repr=False)

    NAME: ClassVar[str]  # in `summary.json`
    NOUN: ClassVar[str]
    SENTENCE: ClassVar[str]
    FOLLOWED: ClassVar[bool] = False  # whether it is estimated with the cameras and corrected
    LOCAL: ClassVar[bool] = False  # whether it is of a part of an image
    OF_BLOCK: ClassVar[bool] = False  # whether it is of all images

    @classmethod
    def may_be(cls, residuals: Residuals, intervals: list[Interval]) -> bool:
        """Return whether the significant intervals may be of such a term."""
        return True

    @classmethod
    def propose(cls, residuals: Residuals, interval: Interval) -> list[Self]:
        """Return such terms for a significant interval; none for a kind that others propose."""
        return []

    def shapes(self, residuals: Residuals, fit: Callable[[Term], MixtureFit]) -> list[Self]:
        """Return the shapes to refine: its own, and those that a fit with derivatives suggests."""
        return [self]

    def refined(self, residuals: Residuals, found: MixtureFit, others: Array) -> Self:
        """Return the term with its ends from single tie points, and a prior as wide as its estimates.

        `found` is a fit with it, its unknowns the last; `others` (2, K) are the displacements by the terms before [px].
        """
        return replace(self, sigma=np.full(len(self.sigma), self.prior_width(found)))

    def prior_width(self, found: MixtureFit) -> float:
        """Return the standard deviation [px] of a prior as wide as its unknowns in a fit, within limits."""
        moved = found.extra[-len(self.sigma) :]
        return float(np.clip(np.sqrt((moved**2).mean()), FIRST_SIGMA / TIMES, FIRST_SIGMA * TIMES))

    def amplitude(self, residuals: Residuals, found: MixtureFit) -> float:
        """Return its amplitude [px] where a minimum applies to it; else infinity."""
        return np.inf

    def alternatives(self, residuals: Residuals, found: MixtureFit) -> list[Term]:
        """Return the terms that its fitted displacement resembles most."""
        return []

    def simpler(self, residuals: Residuals) -> Term | None:
        """Return a term with fewer shape parameters that may explain as much; None: there is none."""
        return None

    def size(self, residuals: Residuals, unknowns: Array) -> Array:
        """Return its size (2,) for the record, col and row [px]: the root mean square if not overridden."""
        of_view = residuals.linear.view == self.view
        displaced = np.einsum("cek,e->ck", self.columns[:, :, of_view], unknowns)
        return np.asarray(np.sqrt((displaced**2).mean(axis=1)))

    def share(self, residuals: Residuals) -> float:
        """Return the part of its image that it displaces."""
        rows = (residuals.linear.view == self.view) | (self.view < 0)
        return float(self.columns[:, :, rows].any(axis=(0, 1)).sum() / max(rows.sum(), 1))

    def differs(self, other: Term) -> bool:
        """Return whether another term is another hypothesis: overlapping intervals of one axis of a view are one."""
        if (self.NAME, self.view) != (other.NAME, other.view):
            return True
        if self.where is None or other.where is None:
            return False
        axis, start, stop = self.where[:3]
        axis2, start2, stop2 = other.where[:3]
        return axis != axis2 or stop <= start2 or stop2 <= start

    def findings(self, residuals: Residuals, unknowns: Array, **said: Any) -> Iterator[Finding]:
        """Yield its records, with estimated unknowns (e,) beside a fit with all terms."""
        size = self.size(residuals, unknowns)
        yield Finding(self.NAME, self.view, self.where, size, unknowns=unknowns, period=self.period, **said)


@dataclass(frozen=True, eq=False)
class Finding:
    """The record of a term that was taken."""

    kind: str  # a name of `barpc.ba.terms.TERMS`
    view: int  # -1: of none
    where: Where | None
    # (2,) displacement, col and row [px]: of a step with its sign, of a sinusoid its amplitude, else root mean square
    size: Array
    gain: float  # nats over the next without it
    gap: float  # nats over the runner-up
    runner_up: str  # its kind, or "" for none
    unknowns: Array  # (e,) of the term [px]
    period: float | None = None  # [px]
    or_of: tuple[int, ...] = ()  # other views that may be meant: their evidence is within `SURE` of the view's
    moved: MovingGroup | None = field(default=None, repr=False)
    motion: Motion | None = None  # for the report


def in_both_coordinates(residuals: Residuals, rows: IntArray, basis: Array) -> Array:
    """Return columns (2, 2 m, K): a basis (m, n) at observations `rows` (n,) for col, then the same for row."""
    columns = np.zeros((2, 2 * len(basis), len(residuals.linear.view)))
    columns[0, : len(basis), rows] = columns[1, len(basis) :, rows] = basis.T
    return columns
