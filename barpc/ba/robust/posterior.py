"""The posterior of a block under other priors than those of its adjustment: evidence, unknowns, covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as la

from barpc.ba.parameters.priors import CameraPrior
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import Minimum
from barpc.ba.solving.structure import unknowns_of
from barpc.base.geodesy import Array
from barpc.base.statistics import SMALL
from barpc.scene import BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class QuadraticProblem:
    """The quadratic approximation of a problem at its minimum: evidence and solution under other priors."""

    problem: Problem
    minimum: Minimum

    @property
    def small(self) -> bool:
        """Whether the block is small enough to be solved many times."""
        return len(self.problem.free) <= SMALL

    def change(self, now: CameraPrior, prior: CameraPrior) -> Array:
        """Return the change of the prior information (N, q, q) from one prior to another; 0 for fixed views."""
        free = self.problem.free.reshape(now.sigma.shape)
        return (prior.precision() - now.precision()) * free[..., None]

    def under(self, prior: CameraPrior) -> tuple[float, Array, Covariance]:
        """Return the log evidence (up to a constant), the unknowns (N, q) and their covariance under another prior."""
        now, reduced, start = self.problem.camera_prior, self.minimum.reduced, self.minimum.state.params
        change, free = self.change(now, prior), self.problem.free
        other = reduced.with_diagonal(change)
        factor = other.factor(free)
        covariance = Covariance(other, factor, free)
        offset = start - now.mean
        pulled = (change @ offset[..., None])[..., 0]
        step = -covariance.solve(pulled.ravel()).reshape(start.shape)
        # with N the present normal matrix, N step = -change (offset + step) at the new minimum; the cost rises by this:
        cost = float(((offset + step) * pulled).sum())
        volume = factor.log_determinant + float(_log_variance(prior, free).sum())
        return -0.5 * (cost + volume), start + step, covariance

    def posterior(self, prior: CameraPrior) -> Posterior:
        """Return the posterior under another prior."""
        evidence, params, covariance = self.under(prior)
        return Posterior(self, evidence, params - prior.mean, covariance.of_views(), prior, covariance)


def _log_variance(prior: CameraPrior, free: BoolArray) -> Array:
    """Return the log determinants (N,) of the prior covariances of free unknowns; improper priors add nothing."""
    sigma = prior.sigma
    use = free.reshape(sigma.shape) & np.isfinite(sigma)
    along = (prior.turn**2 * use * np.log(prior.wider)).sum(axis=1)
    return np.asarray(2.0 * (np.log(sigma, where=use, out=np.zeros(sigma.shape)).sum(axis=1) + along))


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior of each view under a prior. Another prior on one view is an update of rank q."""

    around: QuadraticProblem
    evidence: float  # log evidence, up to a constant
    offset: Array  # (N, q) unknowns minus their priors' means
    blocks: Array  # (N, q, q) covariance of every view's unknowns
    prior: CameraPrior
    covariance: Covariance  # before the `updates`, pairs of matrices (N q, m) and (m, m)
    updates: tuple[tuple[Array, Array], ...] = ()

    def together(self, views: IntArray, prior: CameraPrior) -> Posterior:
        """Return the posterior under another prior on the views (n,), changed in one update."""
        n, q = self.offset.shape
        place = unknowns_of(views, q)
        columns = self.covariance.columns(place)
        for earlier, told in self.updates:
            columns -= earlier @ (told @ earlier[place].T)
        change = la.block_diag(*self.around.change(self.prior, prior)[views])
        system = np.eye(len(place)) + change @ columns[place]
        gain = np.asarray(np.linalg.solve(system, change), np.float64)
        mine = self.offset.ravel()[place]
        pulled = gain @ mine
        sign, volume = np.linalg.slogdet(system)
        if sign <= 0:
            raise np.linalg.LinAlgError("priors together too wide for what the observations determine")
        free = self.around.problem.free
        volume += float((_log_variance(prior, free) - _log_variance(self.prior, free)).sum())
        return replace(
            self,
            evidence=self.evidence - 0.5 * float(mine @ pulled + volume),
            offset=self.offset - (columns @ pulled).reshape(n, q),
            blocks=self.blocks - (columns @ gain).reshape(n, q, -1) @ np.swapaxes(columns.reshape(n, q, -1), 1, 2),
            prior=prior,
            updates=(*self.updates, (columns, gain)),
        )

    def alone(self, prior: CameraPrior) -> tuple[Array, Array, Array]:
        """Return evidence (N,), offset (N, q) and covariance (N, q, q), each with another prior on that view alone.

        D is the change of the prior precision of the view, and C its covariance. The determinant of the normal matrix
        grows by the factor |I + D C|. The covariance of all unknowns decreases by C_v M C_v^T, with M = (I + D C)^-1 D
        and C_v the columns of the view (matrix determinant lemma, Woodbury).
        """
        change = self.around.change(self.prior, prior)
        system = np.eye(change.shape[1]) + change @ self.blocks
        gain = np.linalg.solve(system, change)
        pulled = gain @ self.offset[:, :, None]
        cost = (self.offset[:, :, None] * pulled).sum(axis=(1, 2))
        sign, volume = np.linalg.slogdet(system)
        new, old = (_log_variance(one, self.around.problem.free) for one in (prior, self.prior))
        volume += new - old
        offset = self.offset - (self.blocks @ pulled)[:, :, 0]
        evidence = np.where(sign > 0, self.evidence - 0.5 * (cost + volume), -np.inf)
        return evidence, offset, self.blocks - self.blocks @ gain @ self.blocks
