"""Priors on the cameras that learn from the block: variance components, and views that are odd.

A prior's standard deviation is a guess. What the observations say about it is the size of the corrections that they
determine: with the posterior covariance C of unknowns whose prior is s, gamma = n - trace(C) / s^2 of them are
determined, and their squares sum to gamma s^2 on average (MacKay 1992, "Bayesian Interpolation", eq. 4.8). That holds
for each kind of unknowns by itself: those that move an image's middle, of which an accuracy is stated; turns about the
line of sight, which tie points determine well and which say nothing of the place; drifts degree by degree.
Where the sum of the first is larger than chance allows, some prior was too narrow: that of one view, if its correction
alone explains it (every view that would is held possible: three in a row along the flight do not determine it), else
that of all.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg as la
from scipy.special import chdtrc, gammaincinv

from barpc.ba.parameters.priors import NOISE_FLOOR, CameraPrior, states_accuracy
from barpc.ba.parameters.unknowns import Unknowns
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import Minimum
from barpc.ba.solving.structure import unknowns_of
from barpc.base.geodesy import Array
from barpc.base.options import AdjustOptions
from barpc.base.statistics import CHANCE, GROSS, ITERATIONS, LEVEL, SMALL, STANDS, STATED_FREEDOM, SURE, TIMES
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
    # by how much those of the drift's degrees, and of turns about the lines of sight, were widened
    wide: tuple[float, ...] = (1.0,)


@dataclass(frozen=True, eq=False)
class QuadraticProblem:
    """The problem near a minimum, quadratic: its cost, minimum and covariance under other priors."""

    problem: Problem
    minimum: Minimum

    @property
    def small(self) -> bool:
        """Whether it can be solved many times."""
        return len(self.problem.free) <= SMALL

    def change(self, now: CameraPrior, prior: CameraPrior) -> Array:
        """Return the change of the information (N, q, q) from one prior to another; that of fixed views is 0."""
        free = self.problem.free.reshape(now.sigma.shape)
        return (prior.precision() - now.precision()) * free[..., None]

    def under(self, prior: CameraPrior) -> tuple[float, Array, Covariance]:
        """Return the evidence (logarithm, but for a constant), unknowns (N, q) and covariance under other priors."""
        now, reduced, start = self.problem.camera_prior, self.minimum.reduced, self.minimum.state.params
        change, free = self.change(now, prior), self.problem.free
        other = reduced.with_diagonal(change)
        factor = other.factor(free)
        covariance = Covariance(other, factor, free)
        offset = start - now.mean
        pulled = (change @ offset[..., None])[..., 0]
        step = -covariance.solve(pulled.ravel()).reshape(start.shape)
        # the data's own cost rises by -step (change moved), as the new minimum is where both pull alike
        cost = float(((offset + step) * pulled).sum())
        volume = factor.log_determinant + float(_log_variance(prior, free).sum())
        return -0.5 * (cost + volume), start + step, covariance

    def posterior(self, prior: CameraPrior) -> _Posterior:
        """Return the information on every view under other priors."""
        evidence, params, covariance = self.under(prior)
        return _Posterior(self, evidence, params - prior.mean, covariance.of_views(), prior, covariance)


def _log_variance(prior: CameraPrior, free: BoolArray) -> Array:
    """Return the logarithms (N,) of the determinants of proper priors on free unknowns; others add nothing."""
    sigma = prior.sigma
    use = free.reshape(sigma.shape) & np.isfinite(sigma)
    along = (prior.turn**2 * use * np.log(prior.wider)).sum(axis=1)
    return np.asarray(2.0 * (np.log(sigma, where=use, out=np.zeros(sigma.shape)).sum(axis=1) + along))


@dataclass(frozen=True, eq=False)
class _Posterior:
    """The information on every view under some priors: other priors of a view are an update of rank q."""

    around: QuadraticProblem
    evidence: float  # logarithm, but for a constant
    offset: Array  # (N, q) unknowns minus their priors' means
    blocks: Array  # (N, q, q) covariance of every view's unknowns
    prior: CameraPrior
    covariance: Covariance  # without the updates (N q, m), (m, m) that were made since
    updates: tuple[tuple[Array, Array], ...] = ()

    def together(self, views: IntArray, prior: CameraPrior) -> _Posterior:
        """Return the same under other priors of some views (n,), all of them: by the update of `alone`."""
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
        """Return evidence (N,), offset (N, q) and covariance (N, q, q) of every view if its prior alone were another.

        With its change D of precision and its covariance C the determinant of all grows by |I + D C|, and the
        inverse changes by C_v M C_v^T, M = (I + D C)^-1 D (matrix determinant lemma, Woodbury).
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


@dataclass(frozen=True, eq=False)
class Variances:
    """The priors of a block and those of them that may be estimated."""

    given: CameraPrior  # with the standard deviations as they were given
    unknowns: Unknowns  # which unknown is what
    cautious: bool  # rather too wide than too narrow: no control holds the scene
    stated: BoolArray | None = None  # (N,) views whose RPCs state what counts here; None: none does
    # (4 + D, 2) of an earlier block, whose views have no prior of their own here: squared corrections over the
    # variances given, and their freedom, of the place, of those that are stated, of the drift degree by degree, and
    # along the lines of sight; in the third row the number of views that state
    shown: Array | None = None
    widest: Array | None = None  # (D + 1,) largest factors of drifts and turns, of tie points alone

    @classmethod
    def of(
        cls,
        given: CameraPrior,
        unknowns: Unknowns,
        options: AdjustOptions,
        control: bool,
        views: Sequence[View] = (),
        shown: Array | None = None,
        widest: tuple[float, ...] | None = None,
    ) -> Variances:
        """Return the priors to be learnt by the options, with control points or without."""
        own = options.sigma_attitude is None and options.sigma_position is None and len(views) > 0
        stated = np.array([states_accuracy(view) for view in views]) if own else None
        most = None if widest is None else np.array([*widest[: unknowns.drift], widest[-1]])
        return cls(given, unknowns, not control, stated, shown, most)

    @property
    def learns(self) -> bool:
        """Whether the standard deviations of constants and drifts may change."""
        return self.unknowns.geometric

    @property
    def constants(self) -> int:
        """Constant unknowns of a view."""
        return self.unknowns.constants if self.unknowns.geometric else 0

    @property
    def _degrees(self) -> int:
        return self.unknowns.drift if self.unknowns.geometric else 0

    @property
    def learn_waves(self) -> bool:
        """Whether there are splines or steps, whose sizes are always learnt."""
        return self.unknowns.waves is not None

    @cached_property
    def _kinds(self) -> Array:
        """(2 + D, q + 1) which unknowns are of which kind: the place, the drift by degree, the turns.

        The last is a turn about the line of sight, which the constants are without.
        """
        kinds = np.zeros((2 + self._degrees, self.given.sigma.shape[1] + 1))
        kinds[0, : self.constants] = kinds[-1, -1] = 1.0
        for degree in range(self._degrees):
            kinds[1 + degree, self._drift_part(degree)] = 1.0
        return kinds

    def _drift_part(self, degree: int) -> slice:
        return slice(self.constants + 3 * degree, self.constants + 3 * degree + 3)

    def for_search(self) -> CameraPrior:
        """Return the wider priors used while outliers are looked for, so that unexpected drift is not cut."""
        return self._prior(np.ones(len(self.given.sigma)), np.append(np.full(self._degrees, TIMES), 1.0))

    def learnt(
        self, problem: Problem, minimum: Minimum, last: PriorTest | None = None, exact: bool = False
    ) -> tuple[CameraPrior, PriorTest]:
        """Estimate the priors that the block supports, in its linearisation at a minimum.

        `last` is what the priors of the problem were learnt with, where they were. A large block's variances are
        probed unless they are to be `exact`.
        """
        try:
            return self._learnt(problem, minimum, last, exact)
        except np.linalg.LinAlgError as error:  # priors so wide that rounding is what holds the weakest mode
            logger.info("the priors of the cameras are left as they are: %s", error)
            n = len(minimum.state.params)
            ones, none = (1.0,) * (1 + self._degrees), np.zeros(n, dtype=bool)
            nothing = PriorTest(float("nan"), 0.0, np.ones(n), none, (), shown=self.shown, failed=True, wide=ones)
            return problem.camera_prior, nothing

    def _learnt(
        self, problem: Problem, minimum: Minimum, last: PriorTest | None, exact: bool
    ) -> tuple[CameraPrior, PriorTest]:
        """Return the result of `learnt`, where the matrix can be factorised."""
        if self.learn_waves:
            self = self._going_on(problem.camera_prior.sigma)
        around = QuadraticProblem(problem, minimum)
        now, params = problem.camera_prior, minimum.state.params
        covariance = minimum.covariance(problem.free)
        scale, wide, odd = np.ones(len(params)), np.ones(1 + self._degrees), np.zeros(len(params), dtype=bool)
        prior = self._prior(scale, wide)
        if around.small and self.learns:
            _, params, covariance = around.under(prior)
        known = self._known(covariance, prior if around.small else now, exact)
        total, freedom = (float(x) for x in self._sums(params, known)[0])
        ratio = total / freedom if freedom > _MIN_FREEDOM else float("nan")
        shared = self._shared(params, known)
        # constants of a large block that were widened take from the drift, which need not stand again
        stands = not around.small and last is not None and bool((last.scale > 1.0).any())
        for _ in range(ITERATIONS if self.learns or self.learn_waves else 0):
            before = prior
            if self.learn_waves:
                self = self._going_on(self._waves(params, known, prior.sigma))
            wide = self._beside(params, known, last) if self.learns else wide
            prior = self._prior(scale, wide)
            # a drift or a turn larger than thought looks like a place that is: it is learnt before that is asked
            other, least = (before, STANDS) if around.small else (now, SAME_PRIOR)
            stands |= same_prior(prior, other, least, slice(self.constants, self.constants + 3 * self._degrees))
            if stands and self.learns and self._too_large(params, known, scale):
                scale, odd = self._widened(around, params, known, wide)
                prior = self._prior(scale, wide)
            if not around.small or same_prior(prior, before, STANDS):
                break
            _, params, covariance = around.under(prior)
            known = self._known(covariance, prior)
        drift = tuple(float(np.median(prior.sigma[:, self._drift_part(d).start])) for d in range(self._degrees))
        sigma = prior.sigma.copy()
        sigma[:, : self.constants] *= shared[:, None]
        tested = PriorTest(
            ratio,
            freedom,
            scale,
            odd,
            drift,
            float(shared.max()),
            self._showing(params, known),
            wide=tuple(wide.tolist()),
        )
        return replace(prior, sigma=sigma), tested

    def _shared(self, params: Array, known: Array) -> Array:
        """Return the factors (N,) by which views that state an accuracy are widened, as they share the error
        that they state.

        Views that were adjusted together agree: what each is off by, they all are. Independent errors would leave
        them as large a part of the variance stated as their corrections show, at most. The rest does not average:
        n views of two unknowns (rotation, translation) a direction would tell the place sqrt(n / 2) times too well.
        """
        wider = np.ones(len(params))
        if self.stated is None or not self.learns:
            return wider
        (squares, freedom), (count, _) = self._of_stated(params, known)
        if freedom > _MIN_FREEDOM:
            alone = min(float(squares / (2.0 * gammaincinv(0.5 * freedom, CHANCE))), 1.0)
            wider[self.stated] = np.sqrt(max(alone + (1.0 - alone) * count * 3.0 / self.constants, 1.0))
        return wider

    def _of_stated(self, params: Array, known: Array) -> Array:
        """Return the second and third row of `shown` (2, 2), of an earlier block and of this."""
        assert self.stated is not None
        of_place = self._by_view(params, known)[:, self.stated, 0].sum(axis=1)
        count = np.count_nonzero(known[self.stated, : self.constants].any(axis=1))
        return np.asarray(self._before[1:3] + np.array([of_place, [count, 0.0]]))

    @property
    def _before(self) -> Array:
        """The sums of an earlier block (4 + D, 2), see `shown`; zeros without one."""
        return np.zeros((4 + self._degrees, 2)) if self.shown is None else self.shown

    def _showing(self, params: Array, known: Array) -> Array:
        """Return `shown` for a later run: by this block and those before it."""
        rest = self._before[1:3] if self.stated is None else self._of_stated(params, known)
        return np.insert(self._sums(params, known), [1, 1], rest, axis=0)

    def _going_on(self, sigma: Array) -> Variances:
        """Return the priors with splines and steps as large as in the standard deviations (N, q)."""
        part, given = self.unknowns.in_waves, self.given.sigma.copy()
        given[:, part] = sigma[:, part]
        return replace(self, given=replace(self.given, sigma=given))

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

    def _prior(self, scale: Array, wide: Array) -> CameraPrior:
        """Return the priors given, constants wider by `scale` (N,), drifts and turns about the lines of sight by
        `wide` (D + 1,).
        """
        sigma = self.given.sigma.copy()
        sigma[:, : self.constants] *= scale[:, None]
        for degree, factor in enumerate(wide[:-1]):
            part = self._drift_part(degree)
            sigma[:, part] *= factor
            if degree == 0 and self.learns:
                sigma[:, part] = np.hypot(sigma[:, part], _CENTRE_MOTION_SHARE * sigma[:, :3])
        # where a place is less known than stated, a turn is not known better
        return replace(self.given, sigma=sigma, wider=np.maximum(wide[-1] / scale, 1.0)[:, None])

    def _known(self, covariance: Covariance, prior: CameraPrior, exact: bool = True) -> Array:
        """Return the share (N, q + 1), 0 to 1, by which the observations determine each unknown."""
        probed = covariance.is_large and not exact
        blocks = covariance.probed_views() if probed else covariance.of_views()
        return self._share(blocks, prior, covariance.free)

    def _share(self, blocks: Array, prior: CameraPrior, free: BoolArray) -> Array:
        """Return the share (N, q + 1) by which observations determine each unknown, from covariances (N, q, q)."""
        use = free.reshape(prior.sigma.shape) & np.isfinite(prior.sigma)
        inverse = np.where(use, 1.0 / prior.sigma, 0.0)
        turn = prior.turn * use
        whitened = inverse[:, :, None] * blocks * inverse[:, None]
        along = ((whitened @ turn[..., None])[..., 0] * turn).sum(axis=1, keepdims=True)
        rest = np.eye(whitened.shape[1]) - turn[:, :, None] * turn[:, None]
        across = use - ((rest @ whitened) * rest).sum(axis=2) - turn**2
        return np.hstack([across, (turn**2).sum(axis=1, keepdims=True) - along / prior.wider**2]).clip(0.0, 1.0)

    def _by_view(self, params: Array, known: Array) -> Array:
        """Return the squared unknowns of every view and kind over the variances given, their freedom (2, N, 2 + D)."""
        off = (params - self.given.mean) / self.given.sigma
        along = (self.given.turn * off).sum(axis=1, keepdims=True)
        seen = np.hstack([off - along * self.given.turn, along])
        return np.stack([np.where(known > 0, seen**2, 0.0), known]) @ self._kinds.T

    def _sums(self, params: Array, known: Array) -> Array:
        """Return the same of all views and those of an earlier block (2 + D, 2)."""
        return np.asarray(self._by_view(params, known).sum(axis=1).T + np.delete(self._before, [1, 2], axis=0))

    def _too_large(self, params: Array, known: Array, scale: Array) -> bool:
        """Return whether the corrections are larger than chance allows."""
        squares, free = self._before[0]
        total, freedom = self._by_view(params, known)[..., 0]
        total, freedom = (total / scale**2).sum() + squares / float(np.min(scale)) ** 2, freedom.sum() + free
        return freedom > _MIN_FREEDOM and float(chdtrc(freedom, total)) < LEVEL

    def _widened(self, around: QuadraticProblem, params: Array, known: Array, wide: Array) -> tuple[Array, BoolArray]:
        """Return the factors (N,) by which each view's prior is widened, and the views that are odd.

        Explanations are compared where each is likeliest, and priors are then as wide as they may be.
        """
        n, free = len(params), around.problem.free
        total, freedom = self._by_view(params, known)[..., 0]
        usual = np.full(n, self._common(total, freedom, False))
        for _ in range(ITERATIONS if around.small and n > 2 else 0):  # under wider priors corrections are larger
            last, there = usual[0], around.posterior(self._prior(usual, wide))
            shares = self._share(there.blocks, there.prior, free)
            total, freedom = self._by_view(there.offset + self.given.mean, shares)[..., 0]
            usual = np.full(n, self._common(total, freedom, False))
            if abs(np.log(usual[0] / last)) < STANDS:
                break
        careful = np.full(n, self._common(total, freedom, self.cautious))
        if n <= 2:
            return careful, np.zeros(n, dtype=bool)
        both, beyond, together = self._odd(around, wide, careful)
        if self.cautious:
            together = max(together, around.under(self._prior(usual, wide))[0])
        # turns of all views explain what a wrong one shows: it is looked for without
        few, odd, alone = self._odd(around, np.append(wide[:-1], 1.0), np.ones(n), together)
        if alone >= together + _LIKELIER:
            return few, odd
        # which the others need not be as wide for
        both = np.where(beyond, both, self._common(total[~beyond], freedom[~beyond], self.cautious))
        return (np.maximum(few, both) if alone >= together - SURE else both), beyond  # priors that cover either

    def _common(self, total: Array, freedom: Array, careful: bool) -> float:
        """Return the factor by which the priors of views are widened together, by their squares and freedoms (n,)."""
        squares, free = self._before[0] + np.array([total.sum(), freedom.sum()])
        return float(np.sqrt(max(self._likely(squares, free, careful), 1.0)))

    def _likely(self, total: float, freedom: float, careful: bool) -> float:
        """Return a variance, in units of the one given, by squares and their freedom, that given counting for a few;
        if one is `careful`, the largest that still makes so few squares likely enough.
        """
        likely = (STATED_FREEDOM + total) / (STATED_FREEDOM + freedom)
        if not careful or freedom <= _MIN_FREEDOM:
            return float(likely)
        return float(max(likely, total / (2.0 * gammaincinv(0.5 * freedom, _LOW))))

    def _odd(
        self, around: QuadraticProblem, wide: Array, usual: Array, rival: float | None = None
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
            known = known.together(np.flatnonzero(tops), self._prior(chosen, wide))
            count += int(tops.sum())
        return scale, odd, known.evidence - count * price

    def _alone(self, known: _Posterior, wide: Array, scale: Array) -> tuple[Array, Array]:
        """Return the evidence (N,) for each view being odd as well, and the factor that its prior then needs."""
        prior = self._prior(np.maximum(scale, GROSS), wide)
        _, offset, blocks = known.alone(prior)
        seen = self._share(blocks, prior, known.around.problem.free)
        total, freedom = self._by_view(offset + self.given.mean, seen)[..., 0]
        size = np.maximum(np.sqrt((STATED_FREEDOM + total) / (STATED_FREEDOM + freedom)), scale)
        return known.alone(self._prior(size, wide))[0], size

    def _beside(self, params: Array, known: Array, last: PriorTest | None) -> Array:
        """Return the factors (D + 1,) on the standard deviations of the drift and of turns about the lines of sight,
        the given ones counting for a few.

        No more than so many times those of the `last` linearisation, which holds no further: a mode that hardly
        anything determines would grow without end.
        """
        waves = self.unknowns.waves  # of which splines and steps follow what else bends heights
        careful = self.cautious and not (waves and (waves.count or waves.edges.size))
        factors = [
            self._likely(total, freedom, careful and float(chdtrc(freedom, total)) < CHANCE)
            for total, freedom in self._sums(params, known)[1:]
        ]
        most = TIMES * (1.0 if last is None else np.array(last.wide))
        return np.minimum(np.sqrt(factors), most if self.widest is None else np.minimum(most, self.widest))


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


def same_prior(a: CameraPrior, b: CameraPrior, share: float, part: slice | None = None) -> bool:
    """Return whether the standard deviations of two priors differ by less than a share; infinite ones are
    infinite in both.

    Of all unknowns, or a part; those along the lines of sight among them.
    """
    one, other = (prior.sigma[:, slice(None) if part is None else part] for prior in (a, b))
    finite = np.isfinite(one) & np.isfinite(other)
    apart = np.append(np.log(one[finite] / other[finite]), np.log(np.divide(a.wider, b.wider)))
    return bool((np.abs(apart) < share).all())
