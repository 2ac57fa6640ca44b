"""A common edge: in all images of one line of detectors, the columns beyond an edge have the same displacement.

A ground point that all images see beyond the edge absorbs the displacement. Only points that some images see before the
edge and others beyond it determine it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np

from barpc.ba.evidence.mixture import MixtureFit
from barpc.ba.evidence.scan import Interval
from barpc.ba.parameters.additional_parameters import FIRST_SIGMA
from barpc.ba.terms.step import Step, open_ended
from barpc.ba.terms.term import SIZE_PRICE, Finding, Residuals, Term
from barpc.base.geodesy import Array


class CommonEdge(Term):
    """A displacement of the columns beyond an edge, the same in all images."""

    NAME: ClassVar[str] = "common_edge"
    NOUN: ClassVar[str] = "a step at the same column of all images"
    SENTENCE: ClassVar[str] = (
        "columns from about {first:.0f} on are displaced by {least}{size:.2f} px in all images, as by an edge between "
        "detectors (`detectors = [{first:.0f}]`, `barpc calibrate`)"
    )
    FOLLOWED: ClassVar[bool] = True
    OF_BLOCK: ClassVar[bool] = True

    @classmethod
    def may_be(cls, residuals: Residuals, intervals: list[Interval]) -> bool:
        """Return whether the images are equally wide, as of one line of detectors, and some columns are significant."""
        widths = residuals.size[0]
        return bool((widths == widths[0]).all()) and any(one.axis == 0 for one in intervals)

    @classmethod
    def propose(cls, residuals: Residuals, interval: Interval) -> list[Self]:
        """Return the edge with the largest gain (`edge_gains`); the interval does not matter."""
        col, gain = edge_gains(residuals)
        return [cls.at(residuals, float(col[int(gain.argmax())]))] if len(col) else []

    @classmethod
    def at(cls, residuals: Residuals, col: float, sigma: float = FIRST_SIGMA) -> Self:
        """Return the edge at a column [px], with the prior standard deviation of its displacement [px]."""
        width = float(residuals.size[0, 0])
        where = (0, *open_ended(col, width, width), 0.0, 0.0)
        parts = tuple(Step.at(residuals, v, where, sigma) for v in range(residuals.size.shape[1]))
        columns = np.sum([part.columns for part in parts], axis=0)
        return cls(-1, columns, np.full(2, sigma), float(np.log(width)) + SIZE_PRICE, where, parts=parts)

    def refined(self, residuals: Residuals, found: MixtureFit, others: Array) -> Self:
        """Return the edge with the prior of its displacement as wide as the estimate."""
        return self.at(residuals, self.where[1], self.prior_width(found))  # type: ignore[index]

    def findings(self, residuals: Residuals, unknowns: Array, **fields: Any) -> Iterator[Finding]:
        """Yield a record for each view."""
        for part in self.parts:
            for one in part.findings(residuals, unknowns, **fields):
                yield replace(one, kind=self.NAME)


def edge_gains(residuals: Residuals) -> tuple[Array, Array]:
    """Return positions (m,) [px] midway between columns of observations, and the gain (m,) [nats] of an edge there.

    The gain is the score test S' M^-1 S / 2 of one displacement of all observations beyond the edge, with ground points
    eliminated: S is the gradient of their weighted residuals, M the information. Tracks are weighted by the inverse of
    their residual norm, to approximate the L1 norm.
    """
    linear, base = residuals.linear, residuals.base
    left = linear.residual_after(base.step) + np.einsum("cek,e->ck", residuals.extra, base.extra) / linear.sigma
    cols, sums, matrices = [np.zeros(0)], [np.zeros((0, 2))], [np.zeros((0, 2, 2))]
    for tracks in linear.tracks:
        count, n = tracks.rows.shape
        order = np.argsort(residuals.place[0][tracks.rows], axis=1)
        rows = np.take_along_axis(tracks.rows, order, axis=1)
        scale = 1.0 / linear.sigma[rows]
        basis = tracks.point_bases[:, :3].reshape(count, 3, n, 2)
        off = left[:, tracks.rows].transpose(1, 2, 0)
        off = off - np.einsum("tcni,tc->tni", basis, np.einsum("tcni,tni->tc", basis, off))
        weight = 1.0 / np.sqrt((off**2).sum(axis=(1, 2)) + base.noise**2)
        off, basis = off[np.arange(count)[:, None], order], np.take_along_axis(basis, order[:, None, :, None], axis=2)
        # sums over the observations beyond each edge: information, less the part that the ground point absorbs
        followed = (basis * scale[:, None, :, None])[:, :, ::-1].cumsum(axis=2)[:, :, ::-1]
        own = (scale**2)[:, ::-1].cumsum(axis=1)[:, ::-1, None, None] * np.eye(2)
        matrix = (own - np.einsum("tcni,tcnj->tnij", followed, followed)) * weight[:, None, None, None]
        cols.append(residuals.place[0][rows].ravel())
        sums.append((off * (weight[:, None] * scale)[..., None]).reshape(-1, 2))
        matrices.append(-np.diff(matrix, axis=1, append=0.0).reshape(-1, 2, 2))
    col, by_col = np.concatenate(cols), np.argsort(np.concatenate(cols), kind="stable")
    beyond, known = (np.concatenate(one)[by_col][::-1].cumsum(axis=0)[::-1][1:] for one in (sums, matrices))
    known = known + np.eye(2) * FIRST_SIGMA**-2.0
    gain = 0.5 * np.einsum("mi,mi->m", beyond, np.linalg.solve(known, beyond[..., None])[..., 0])
    ordered = col[by_col]
    return 0.5 * (ordered[1:] + ordered[:-1]), gain
