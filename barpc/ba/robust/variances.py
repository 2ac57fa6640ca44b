"""Priors on the cameras that learn from the block: variance components, and views that are odd.

A prior's standard deviation is a guess. What the observations say about it is the size of the corrections that they
determine: with the posterior covariance C of unknowns whose prior is s, gamma = n - trace(C) / s^2 of them are
determined, and their squares sum to gamma s^2 on average (MacKay 1992, "Bayesian Interpolation", eq. 4.8). Where the
sum is larger than chance allows, some prior was too narrow: that of one view, if its correction alone explains it
(every view that would is held possible: three in a row along the flight do not determine which), else that of all.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, gammaincinv

from barpc.ba.parameters.priors import NOISE_FLOOR, CameraPrior, states_accuracy
from barpc.ba.parameters.unknowns import Unknowns
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import Minimum
from barpc.ba.solving.structure import unknowns_of
from barpc.base.geodesy import Array
from barpc.base.options import AdjustOptions
from barpc.base.statistics import CHANCE, GROSS, ITERATIONS, KEPT, LEVEL, SMALL, STANDS, STATED_FREEDOM, SURE, TIMES
from barpc.scene import BoolArray, IntArray, View

logger = logging.getLogger(__name__)

_LIKELIER = -np.log(LEVEL)  # but one odd view is named where all being worse than stated is as improbable beside it
_CENTRE_MOTION_SHARE = 0.01  # of a rotation, as drift: the centre it turns about flies some km while an image is taken
_LOW = 0.1  # then as much is let be as leaves what is seen this likely: a prior too narrow bends all heights alike
SAME_PRIOR = 0.2  # change of a standard deviation, as a logarithm, below which a block is not solved again
_MIN_FREEDOM = 0.5  # degrees of freedom below which nothing is said


@dataclass(frozen=True, eq=False)
class PriorTest:
    """Comparison of the views' corrections with the priors that were given."""

    # squared constant corrections (rotation, translation) over the variances given, over their degrees of
    # freedom: about 1 where the priors hold. NaN where the observations determine nothing
    ratio: float
    freedom: float  # constant unknowns that the observations determine
    scale: Array  # (N,) by how much the standard deviations given were widened; 1: not at all
    odd: BoolArray  # (N,) views whose camera alone explains the corrections. More than one: any of them would
    # standard deviation of the drift's coefficients in use, degree by degree [m]
    drift_sigma: tuple[float, ...]
    shared: float = 1.0  # by how much standard deviations that RPCs state were widened, as all views share what is off
    # what the corrections show, with those of an earlier block (see `Variances.shown`)
    shown: Array | None = None
    failed: bool = False  # the matrix could not be factorised: nothing was learnt


@dataclass(frozen=True, eq=False)
class _Around:
    """The problem near a minimum, quadratic: its cost, minimum and covariance under other priors."""

    problem: Problem
    minimum: Minimum

    @property
    def small(self) -> bool:
        """Whether it can be solved many times."""
        return len(self.problem.free) <= SMALL

    def under(self, prior: CameraPrior) -> tuple[float, Array, Covariance]:
        """Return the evidence (logarithm, but for a constant), unknowns (N, q) and covariance under other priors."""
        now, reduced, start = self.problem.camera_prior, self.minimum.reduced, self.minimum.state.params
        free = self.problem.free
        change = np.where(free.reshape(start.shape), 1.0 / prior.sigma**2 - 1.0 / now.sigma**2, 0.0)
        other = reduced.with_diagonal(change)
        factor = other.factor(free)
        covariance = Covariance(other, factor, free)
        offset = start - now.mean
        step = -covariance.solve((change * offset).ravel()).reshape(start.shape)
        # the data's own cost rises by -step (change moved), as the new minimum is where both pull alike
        cost = float((change * (offset + step) * offset).sum())
        volume = factor.log_determinant + float(_log_variance(prior.sigma, free).sum())
        return -0.5 * (cost + volume), start + step, covariance

    def posterior(self, prior: CameraPrior) -> _Posterior:
        """Return the information on every view under other priors."""
        evidence, params, covariance = self.under(prior)
        free = self.problem.free.reshape(params.shape)
        return _Posterior(evidence, params - prior.mean, covariance.of_views(), prior.sigma, free, covariance)


def _log_variance(sigma: Array, free: BoolArray) -> Array:
    """Return the logarithms (N, q) of the variances of proper priors on free unknowns; 0 for all others."""
    use = free.reshape(sigma.shape) & np.isfinite(sigma)
    return 2.0 * np.log(sigma, where=use, out=np.zeros(sigma.shape))


@dataclass(frozen=True, eq=False)
class _Posterior:
    """The information on every view under some priors: other priors of a view are an update of rank q."""

    evidence: float  # logarithm, but for a constant
    offset: Array  # (N, q) unknowns minus their priors' means
    blocks: Array  # (N, q, q) covariance of every view's unknowns
    sigma: Array  # (N, q) of the priors
    free: BoolArray  # (N, q)
    start: Covariance  # of all unknowns, before the updates
    # of every update the covariance (N, q, m) with the m unknowns whose priors changed, and M (m, m)
    updates: tuple[tuple[Array, Array], ...] = ()

    def _change(self, sigma: Array) -> Array:
        """Return the change (N, q) of the precisions of the priors to other standard deviations (N, q)."""
        return np.where(self.free, 1.0 / sigma**2 - 1.0 / self.sigma**2, 0.0)

    def alone(self, sigma: Array) -> tuple[Array, Array, Array]:
        """Return evidence (N,), offset (N, q) and variances (N, q) of every view if its prior alone were another.

        With its change D of precision and its covariance C the determinant of all grows by |I + D C|, and the
        inverse changes by C_v M C_v^T, M = (I + D C)^-1 D (matrix determinant lemma, Woodbury).
        """
        change = self._change(sigma)[:, :, None]
        system = np.eye(sigma.shape[1]) + change * self.blocks
        gain = np.linalg.solve(system, change * np.eye(sigma.shape[1]))
        pulled = gain @ self.offset[:, :, None]
        cost = (self.offset[:, :, None] * pulled).sum(axis=(1, 2))
        sign, volume = np.linalg.slogdet(system)
        volume += (_log_variance(sigma, self.free) - _log_variance(self.sigma, self.free)).sum(axis=1)
        offset = self.offset - (self.blocks @ pulled)[:, :, 0]
        less = (self.blocks @ gain * self.blocks).sum(axis=2)
        evidence = np.where(sign > 0, self.evidence - 0.5 * (cost + volume), -np.inf)
        return evidence, offset, self.blocks.diagonal(axis1=1, axis2=2) - less

    def under(self, prior: CameraPrior, around: _Around) -> _Posterior:
        """Return the same under other priors, which differ in few views from those that it has."""
        change = self._change(prior.sigma)
        views = np.flatnonzero(change.any(axis=1))
        if not len(views):
            return replace(self, sigma=prior.sigma)
        rows = unknowns_of(views, change.shape[1])
        if (len(self.updates) + 1) * change.size * len(rows) > 30 * KEPT:  # 240 MB
            return around.posterior(prior)
        columns = self._columns(rows)
        own, offset = columns.reshape(-1, len(rows))[rows], self.offset[views].ravel()
        system = np.eye(len(rows)) + change[views].reshape(-1, 1) * own
        gain = np.asarray(np.linalg.solve(system, np.diag(change[views].ravel())), dtype=np.float64)
        pulled = gain @ offset
        volume = np.linalg.slogdet(system)[1]
        volume += (_log_variance(prior.sigma, self.free) - _log_variance(self.sigma, self.free)).sum()
        return replace(
            self,
            evidence=self.evidence - 0.5 * float(offset @ pulled + volume),
            offset=self.offset - columns @ pulled,
            blocks=self.blocks - columns @ gain @ columns.swapaxes(1, 2),
            sigma=prior.sigma,
            updates=(*self.updates, (columns, gain)),
        )

    def _columns(self, rows: IntArray) -> Array:
        """Return the covariance (N, q, m) of all unknowns with m of them."""
        unit = np.zeros((self.offset.size, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        out = self.start.solve(unit).reshape(*self.offset.shape, -1)
        for columns, gain in self.updates:
            out -= columns @ (gain @ columns.reshape(-1, columns.shape[2])[rows].T)
        return out


@dataclass(frozen=True, eq=False)
class Variances:
    """The priors of a block and those of them that may be estimated."""

    given: CameraPrior  # with the standard deviations as they were given
    unknowns: Unknowns  # which unknown is what
    learn_constant: bool  # whether the constants' standard deviations may change
    learn_drift: bool
    cautious: bool  # rather too wide than too narrow: no control holds the scene
    stated: BoolArray | None = None  # (N,) views whose RPCs state what counts here; None: none does
    # (3 + D, 2) of an earlier block, whose views have no prior of their own here: squared corrections over the
    # variances given, and their freedom, of constants, of those that are stated, and of the drift degree by degree; in
    # the third row the number of views that state
    shown: Array | None = None

    @classmethod
    def of(
        cls,
        given: CameraPrior,
        unknowns: Unknowns,
        options: AdjustOptions,
        control: bool,
        views: Sequence[View] = (),
        shown: Array | None = None,
    ) -> Variances:
        """Return the priors to be learnt by the options, with control points or without."""
        geometric = unknowns.geometric and options.learn_priors
        own = options.sigma_attitude is None and options.sigma_position is None and len(views) > 0
        stated = np.array([states_accuracy(view) for view in views]) if own else None
        return cls(given, unknowns, geometric, geometric, not control, stated, shown)

    @property
    def constants(self) -> int:
        """Constant unknowns of a view."""
        return self.unknowns.constants if self.unknowns.geometric else 0

    def for_search(self) -> CameraPrior:
        """Return the wider priors used while outliers are looked for, so that unexpected drift is not cut."""
        return self._prior(np.ones(len(self.given.sigma)), np.full(self._degrees, TIMES))

    def learnt(
        self, problem: Problem, minimum: Minimum, last: PriorTest | None = None, exact: bool = False
    ) -> tuple[CameraPrior, PriorTest]:
        """Estimate the priors that the block supports, in its linearisation at a minimum.

        `last` is what the priors of the problem were learnt with, where they were. A large block's variances are
        probed unless they are to be `exact`.
        """
        widened = last is not None and bool((last.scale > 1.0).any())
        try:
            return self._learnt(problem, minimum, widened, exact)
        except np.linalg.LinAlgError as error:  # priors so wide that rounding is what holds the weakest mode
            logger.info("the priors of the cameras are left as they are: %s", error)
            n = len(minimum.state.params)
            nothing = PriorTest(
                float("nan"), 0.0, np.ones(n), np.zeros(n, dtype=bool), (), shown=self.shown, failed=True
            )
            return problem.camera_prior, nothing

    def _learnt(self, problem: Problem, minimum: Minimum, widened: bool, exact: bool) -> tuple[CameraPrior, PriorTest]:
        """Return the result of `learnt` for a problem whose constants' priors were `widened` or not."""
        if self.learn_waves:
            self = self._going_on(problem.camera_prior.sigma)
        around = _Around(problem, minimum)
        now, params = problem.camera_prior, minimum.state.params
        covariance = minimum.covariance(problem.free)
        scale, wide, odd = np.ones(len(params)), np.ones(self._degrees), np.zeros(len(params), dtype=bool)
        prior = self._prior(scale, wide)
        if around.small and (now.sigma != prior.sigma).any():
            _, params, covariance = around.under(prior)
        known = self._known(covariance, prior if around.small else now, exact)
        total, freedom = (float(part.sum()) for part in self._squares(params, known))
        ratio = total / freedom if freedom > _MIN_FREEDOM else float("nan")
        shared = self._shared(params, known)
        # constants of a large block that were widened take from the drift, which need not stand again
        stands = not self.learn_drift or (not around.small and widened)
        for _ in range(ITERATIONS):
            before = prior
            if self.learn_waves:
                self = self._going_on(self._waves(params, known, prior.sigma))
            wide = self._drift(params, known) if self.learn_drift else wide
            prior = self._prior(scale, wide)
            # a drift that is larger than thought looks like constants that are: it is learnt before they are asked
            last, least = (before, STANDS) if around.small else (now, SAME_PRIOR)
            stands |= same_prior(prior, last, least, self._of_drift)
            if stands and self.learn_constant and self._too_large(params, known, scale):
                scale, odd = self._widened(around, params, known, wide)
                prior = self._prior(scale, wide)
            if not around.small or same_prior(prior, before, STANDS):
                break
            _, params, covariance = around.under(prior)
            known = self._known(covariance, prior)
        drift = tuple(float(np.median(prior.sigma[:, self._drift_part(d).start])) for d in range(self._degrees))
        sigma = prior.sigma.copy()
        sigma[:, : self.constants] *= shared[:, None]
        shown = self._showing(params, known)
        tested = PriorTest(ratio, freedom, scale, odd, drift, float(shared.max()), shown)
        return CameraPrior(prior.mean, sigma), tested

    def _shared(self, params: Array, known: Array) -> Array:
        """Return the factors (N,) by which views that state an accuracy are widened, as they share the error
        that they state.

        Views that were adjusted together agree: what each is off by, they all are. Independent errors would leave
        them as large a part of the variance stated as their corrections show, at most. The rest does not average:
        n views of two unknowns (rotation, translation) a direction would tell the place sqrt(n / 2) times too well.
        """
        wider = np.ones(len(params))
        if self.stated is None or not self.learn_constant:
            return wider
        (squares, freedom), (count, _) = self._of_stated(params, known)
        if freedom > _MIN_FREEDOM:
            alone = min(float(squares / (2.0 * gammaincinv(0.5 * freedom, CHANCE))), 1.0)
            wider[self.stated] = np.sqrt(max(alone + (1.0 - alone) * count * 3.0 / self.constants, 1.0))
        return wider

    def _of_stated(self, params: Array, known: Array) -> Array:
        """Return the second and third row of `shown` (2, 2), of an earlier block and of this."""
        assert self.stated is not None
        squares, freedom = (part[self.stated].sum() for part in self._squares(params, known))
        count = np.count_nonzero(known[self.stated, : self.constants].any(axis=1))
        return np.asarray(self._before(slice(1, 3)) + np.array([[squares, freedom], [count, 0.0]]))

    def _before(self, rows: int | slice) -> Array:
        """Return the rows of an earlier block; zeros without one."""
        return np.asarray((np.zeros((3 + self._degrees, 2)) if self.shown is None else self.shown)[rows])

    def _showing(self, params: Array, known: Array) -> Array:
        """Return `shown` for a later run: by this block and those before it."""
        out = self._before(slice(None)).copy()
        out[0] += [part.sum() for part in self._squares(params, known)]
        if self.stated is not None:
            out[1:3] = self._of_stated(params, known)
        for degree in range(self._degrees):
            out[3 + degree] += [x.sum() for x in self._squares(params, known, part=self._drift_part(degree))]
        return out

    @property
    def learn_waves(self) -> bool:
        """Whether there are splines or steps, whose sizes are always learnt."""
        return self.unknowns.waves is not None

    def _going_on(self, sigma: Array) -> Variances:
        """Return the priors with splines and steps as large as in the standard deviations (N, q)."""
        part, given = self.unknowns.in_waves, self.given.sigma.copy()
        given[:, part] = sigma[:, part]
        return replace(self, given=CameraPrior(self.given.mean, given))

    def _waves(self, params: Array, known: Array, sigma: Array) -> Array:
        """Return the standard deviations (N, q), splines and steps as large as each view's show."""
        assert self.unknowns.waves is not None
        first, bands = self.unknowns.in_waves.start, self.unknowns.waves.bands
        out = sigma.copy()
        for band in range(int(bands.max()) + 1):
            rows = first + np.flatnonzero(bands == band)
            learnt = np.isfinite(sigma[:, rows[0]])  # those of an earlier block are in its matrix
            squares, freedom = (learnt * part.sum(axis=1) for part in (params[:, rows] ** 2, known[:, rows]))
            common = (NOISE_FLOOR**2 + squares.sum()) / (1.0 + freedom.sum())
            size = np.sqrt((STATED_FREEDOM * common + squares) / (STATED_FREEDOM + freedom))
            out[:, rows] = np.where(learnt, size, np.inf)[:, None]
        return out

    @property
    def _degrees(self) -> int:
        return self.unknowns.drift if self.unknowns.geometric else 0

    @property
    def _of_drift(self) -> slice:
        return slice(self.constants, self.constants + 3 * self._degrees)

    def _drift_part(self, degree: int) -> slice:
        return slice(self.constants + 3 * degree, self.constants + 3 * degree + 3)

    def _prior(self, scale: Array, wide: Array) -> CameraPrior:
        """Return the priors given, constants wider by `scale` (N,), drifts by `wide` (D,)."""
        sigma = self.given.sigma.copy()
        sigma[:, : self.constants] *= scale[:, None]
        for degree, factor in enumerate(wide):
            part = self._drift_part(degree)
            sigma[:, part] *= factor
            if degree == 0 and self.learn_drift:
                sigma[:, part] = np.hypot(sigma[:, part], _CENTRE_MOTION_SHARE * sigma[:, :3])
        return CameraPrior(self.given.mean, sigma)

    def _known(self, covariance: Covariance, prior: CameraPrior, exact: bool = True) -> Array:
        """Return the share (N, q), 0 to 1, by which the observations determine each unknown."""
        shape = prior.sigma.shape
        use = covariance.free.reshape(shape) & np.isfinite(prior.sigma)
        probed = covariance.is_large and not exact
        variance = covariance.probed_variances() if probed else covariance.variances()
        known = 1.0 - variance / prior.sigma**2
        return np.where(use, known.clip(0.0, 1.0), 0.0)

    def _squares(
        self, params: Array, known: Array, scale: Array | float = 1.0, part: slice | None = None
    ) -> tuple[Array, Array]:
        """Return the squared unknowns (constants, or a part) of every view over their variances, their freedom (N,)."""
        part = slice(self.constants) if part is None else part
        sigma = self.given.sigma[:, part] * np.reshape(scale, (-1, 1))
        squared = ((params - self.given.mean)[:, part] / sigma) ** 2
        return np.where(known[:, part] > 0, squared, 0.0).sum(axis=1), known[:, part].sum(axis=1)

    def _too_large(self, params: Array, known: Array, scale: Array) -> bool:
        """Return whether the corrections are larger than chance allows."""
        squares, free = self._before(0)
        total, freedom = (float(part.sum()) for part in self._squares(params, known, scale))
        total, freedom = total + squares / float(np.min(scale)) ** 2, freedom + free
        return freedom > _MIN_FREEDOM and float(chdtrc(freedom, total)) < LEVEL

    def _widened(self, around: _Around, params: Array, known: Array, wide: Array) -> tuple[Array, BoolArray]:
        """Return the factors (N,) by which each view's prior is widened, and the views that are odd."""
        n = len(params)
        total, freedom = self._squares(params, known)
        common = np.full(n, self._common(total, freedom))
        if n <= 2:
            return common, np.zeros(n, dtype=bool)
        both, beyond, together = self._odd(around, wide, common)
        few, odd, alone = self._odd(around, wide, np.ones(n), together)
        if alone >= together + _LIKELIER:
            return few, odd
        if beyond.any():  # which the others need not be as wide for
            both = np.where(beyond, both, self._common(total[~beyond], freedom[~beyond]))
        return (np.maximum(few, both) if alone >= together - SURE else both), beyond  # priors that cover either

    def _common(self, total: Array, freedom: Array) -> float:
        """Return the factor by which the priors of views are widened together, by their squares and freedoms (n,)."""
        squares, free = self._before(0) + np.array([total.sum(), freedom.sum()])
        factor = max((STATED_FREEDOM + squares) / (STATED_FREEDOM + free), 1.0)
        if self.cautious:
            factor = max(factor, _possible(squares, free))
        return float(np.sqrt(factor))

    def _odd(
        self, around: _Around, wide: Array, usual: Array, rival: float | None = None
    ) -> tuple[Array, BoolArray, float]:
        """Find a few views whose cameras explain the corrections beside those of `usual` widened priors (N,), by
        forward selection: the factors, the views and the evidence for them.

        One is added of those that share points, at a time, where it is likelier than its choice among all views. Where
        there is the evidence of a rival, one at least is chosen, and none once they cannot come near it: what further
        ones add becomes less.
        """
        n = len(usual)
        odd, chosen, scale = np.zeros(n, dtype=bool), usual.copy(), usual.copy()
        known, price, count = around.posterior(self._prior(usual, wide)), float(np.log(n)), 0
        while count < max(1, n // 3):
            evidence, size = self._alone(known, wide, chosen)
            evidence[chosen > usual] = -np.inf
            gains = np.sort(evidence - known.evidence)
            if rival is not None and known.evidence + gains[n - n // 3 + count :].clip(0.0).sum() < rival - SURE:
                return usual, np.zeros(n, dtype=bool), -np.inf
            pairs = around.problem.structure.pair_view
            tops = _first_of_largest(evidence, pairs)
            tops &= evidence - known.evidence >= (gains[-1] if rival is not None and not count else max(SURE, price))
            if not tops.any():
                break
            chosen_near = _neighbour_maximum(np.where(tops, evidence, -np.inf), pairs)
            as_good = (chosen_near > -np.inf) & (evidence > chosen_near - SURE)  # explain as well as one that is
            odd, scale = odd | as_good, np.where(as_good, np.maximum(size, scale), scale)
            chosen[tops] = size[tops]
            known, count = known.under(self._prior(chosen, wide), around), count + int(tops.sum())
        return scale, odd, known.evidence - count * price

    def _alone(self, known: _Posterior, wide: Array, scale: Array) -> tuple[Array, Array]:
        """Return the evidence (N,) for each view being odd as well, and the factor that its prior then needs."""
        prior = self._prior(np.maximum(scale, GROSS), wide)
        _, offset, variance = known.alone(prior.sigma)
        seen = 1.0 - variance / prior.sigma**2
        seen = np.where(known.free & np.isfinite(prior.sigma), seen.clip(0.0, 1.0), 0.0)
        total, freedom = self._squares(offset + self.given.mean, seen)
        size = np.maximum(np.sqrt((STATED_FREEDOM + total) / (STATED_FREEDOM + freedom)), scale)
        return known.alone(self._prior(size, wide).sigma)[0], size

    def _drift(self, params: Array, known: Array) -> Array:
        """Return the factors (D,) on the drift's standard deviations, the given ones counting for a few."""
        waves = self.unknowns.waves  # of which splines and steps follow what else bends heights
        careful = self.cautious and not (waves and (waves.count or waves.edges.size))
        factors = np.ones(self._degrees)
        for degree in range(self._degrees):
            own = self._squares(params, known, part=self._drift_part(degree))
            total, freedom = self._before(3 + degree) + np.array([x.sum() for x in own])
            factors[degree] = (STATED_FREEDOM + total) / (STATED_FREEDOM + freedom)
            if careful and freedom > _MIN_FREEDOM and chdtrc(freedom, total) < CHANCE:
                factors[degree] = max(factors[degree], _possible(total, freedom))
        return np.sqrt(factors)


def _neighbour_maximum(values: Array, pairs: IntArray) -> Array:
    """Return the largest (N,) of the values of every view and of those that it shares points with."""
    i, j = pairs.T
    out = values.copy()
    np.maximum.at(out, i, values[j])
    np.maximum.at(out, j, values[i])
    return out


def _first_of_largest(values: Array, pairs: IntArray) -> BoolArray:
    """Return whether every view (N,) has the largest value of those that it shares points with; the first of equals."""
    i, j = pairs.T
    tops: BoolArray = values == _neighbour_maximum(values, pairs)
    tops[j[tops[i] & tops[j]]] = False
    return tops


def _possible(total: float, freedom: float) -> float:
    """Return a variance, in units of the one given, that still makes such a sum of squares likely enough."""
    return float(total / (2.0 * gammaincinv(0.5 * freedom, _LOW)))


def same_prior(a: CameraPrior, b: CameraPrior, share: float, part: slice | None = None) -> bool:
    """Return whether the standard deviations of two priors differ by less than a share; infinite ones are
    infinite in both.

    Of all unknowns, or a part.
    """
    one, other = (prior.sigma[:, slice(None) if part is None else part] for prior in (a, b))
    finite = np.isfinite(one) & np.isfinite(other)
    return bool((np.abs(np.log(one[finite] / other[finite])) < share).all())
