"""Moving objects: the tie points of a part of the ground move between views: a cloud, water, a glacier, a fault."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Self

import numpy as np

from barpc.ba.evidence.mixture import MixtureFit
from barpc.ba.terms import moving_ground
from barpc.ba.terms.term import Finding, Residuals, Term
from barpc.base.geodesy import Array


class MovingObjects(Term):
    """Motions of a group of tie points on the ground, one for each view; each cell has a share of moving tracks."""

    NAME: ClassVar[str] = "moving_objects"
    NOUN: ClassVar[str] = "moving objects"
    SENTENCE: ClassVar[str] = (
        "{share:.0f} % of the tie points{side} move together ({cause}), by {metres:.2g} m from {between[0]} to "
        "{between[1]} apart from an effect of height, and were excluded{control}{larger}"
    )

    @staticmethod
    def may_move(residuals: Residuals) -> bool:
        """Return whether a region of the ground may move (`moving_ground.may_move`)."""
        seen = residuals
        return moving_ground.may_move(seen.linear, seen.ground, seen.base, seen.extra, seen.sigma)

    @classmethod
    def of(cls, residuals: Residuals) -> list[Self]:
        """Return the most likely moving group."""
        linear = residuals.linear
        one = moving_ground.proposal(linear, residuals.ground, residuals.base, residuals.extra, residuals.sigma)
        none, cost = np.zeros((2, 0, len(linear.view))), moving_ground.price_of_group(linear, one.cell)
        return [cls(-1, none, np.zeros(0), cost, group=one)]

    def amplitude(self, residuals: Residuals, found: MixtureFit) -> float:
        """Return `Motion.metres` in pixels of the coarser of the two views; infinity for an empty group."""
        if self.group is None or not (found.moving > 0.5).any():
            return np.inf
        linear, ground = residuals.linear, residuals.ground
        one = moving_ground.group_of(linear, ground, self.group, found)
        return one.metres / max(ground.pixel_of(np.flatnonzero(linear.view == v)) for v in one.between)

    def findings(self, residuals: Residuals, unknowns: Array, **fields: Any) -> Iterator[Finding]:
        """Yield the record of the group, with its members."""
        assert self.group is not None
        group = moving_ground.group_of(residuals.linear, residuals.ground, self.group, residuals.base)
        yield Finding(self.NAME, self.view, None, np.zeros(2), unknowns=unknowns, moved=group, **fields)
