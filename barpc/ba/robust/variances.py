"""Estimation of the prior standard deviations of the cameras: variance components, and views with larger errors.

With the posterior covariance C of n unknowns of prior standard deviation s, gamma = n - trace(C) / s^2 of them are
determined by the observations, and their squares have the expectation gamma s^2 (MacKay 1992, "Bayesian Interpolation",
eq. 4.8). This holds for each kind of unknowns: those that move the position of an image, whose accuracy is stated;
rotations about the line of sight; drifts, by degree. Where the squares of the first kind are significantly too large,
the prior was too narrow: of one odd view, if its correction alone explains them, else of all views. Several views can
be alternatives: the observations of three views in a row along the flight do not determine which of them is odd.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, gammaincinv

from barpc.ba.parameters.priors import NOISE_FLOOR, CameraPrior, states_accuracy
from barpc.ba.parameters.unknowns import Unknowns
from barpc.ba.robust.posterior import Posterior, QuadraticProblem
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import Minimum
from barpc.base.geodesy import Array
from barpc.base.options import AdjustOptions
from barpc.base.statistics import CHANCE, GROSS, ITERATIONS, LEVEL, STANDS, SURE, TIMES, pooled_variance
from barpc.scene import BoolArray, IntArray, View

logger = logging.getLogger(__name__)

# nats: least gain of log evidence of wider priors on odd views alone, over wider priors on all views
_LIKELIER = -np.log(LEVEL)
# drift caused by a rotation, over the rotation: the projection centre moves by some km while an image is taken
_CENTRE_MOTION_SHARE = 0.01
# a cautious standard deviation is the upper confidence limit with this probability of error; too narrow a prior bends
# all heights
_LOW = 0.1
SAME_PRIOR = 0.2  # log change of a standard deviation below which a block is not solved again
_MIN_FREEDOM = 0.5  # degrees of freedom below which nothing is estimated


@dataclass(frozen=True, eq=False)
class PriorTest:
    """Comparison of the corrections of the cameras with the given priors, and the factors on these."""

    # sum of squared constant corrections (rotation, translation) over the given variances, over the degrees of freedom:
    # about 1 where the priors hold; NaN where the observations determine none
    ratio: float
    freedom: float  # number of constant unknowns that the observations determine
    scale: Array  # (N,) factors on the given standard deviations; 1: unchanged
    odd: BoolArray  # (N,) views whose corrections alone explain the ratio; some can be alternatives
    # estimated standard deviation of the drift coefficients, by degree [m]
    drift_sigma: tuple[float, ...]
    shared: float = 1.0  # factor on standard deviations that RPCs state, for an error that all views have in common
    # sums of squares of this block and earlier ones (see `Variances.shown`)
    shown: Array | None = None
    failed: bool = False  # the matrix could not be factorised: nothing was estimated
    # factors on the standard deviations of the drift, by degree, and of rotations about the lines of sight
    wide: tuple[float, ...] = (1.0,)
    # (N,) views of which one alone explains the ratio about as well as wider priors on all; None: none does
    perhaps_odd: BoolArray | None = None


@dataclass(frozen=True, eq=False)
class Variances:
    """The given priors of a block, and which of them are estimated."""

    given: CameraPrior  # with the standard deviations as they were given
    unknowns: Unknowns  # meaning of each unknown
    cautious: bool  # whether estimates are upper confidence limits, as there is no control
    stated: BoolArray | None = None  # (N,) views whose RPCs state an accuracy that is in use; None: none does
    # (4 + D, 2) sums of an earlier block: squared corrections over the given variances, and degrees of freedom. The
    # views of that block have no prior of their own here. Rows: position; position of views with a stated accuracy;
    # number of these views, and 0; drift by degree; rotations about the lines of sight
    shown: Array | None = None
    widest: Array | None = None  # (D + 1,) upper limits, by tie points alone, of factors of drifts and rotations

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
        """Return the variances of a block, to be estimated as the options state."""
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
        """Number of constant unknowns of a view."""
        return self.unknowns.constants if self.unknowns.geometric else 0

    @property
    def _degrees(self) -> int:
        return self.unknowns.drift if self.unknowns.geometric else 0

    @property
    def learn_waves(self) -> bool:
        """Whether there are splines or steps, whose standard deviations are always estimated."""
        return self.unknowns.waves is not None

    @cached_property
    def _kinds(self) -> Array:
        """Mask (2 + D, q + 1) of unknowns by kind: position, drift by degree, rotation about the line of sight.

        The last column is this rotation. The columns before are the q unknowns, after this rotation is projected out.
        """
        kinds = np.zeros((2 + self._degrees, self.given.sigma.shape[1] + 1))
        kinds[0, : self.constants] = kinds[-1, -1] = 1.0
        for degree in range(self._degrees):
            kinds[1 + degree, self._drift_part(degree)] = 1.0
        return kinds

    def _drift_part(self, degree: int) -> slice:
        return slice(self.constants + 3 * degree, self.constants + 3 * degree + 3)

    def for_search(self) -> CameraPrior:
        """Return the wider priors of the robust steps, so that observations of a large drift are not rejected."""
        return self._prior(np.ones(len(self.given.sigma)), np.append(np.full(self._degrees, TIMES), 1.0))

    def learnt(
        self, problem: Problem, minimum: Minimum, last: PriorTest | None = None, exact: bool = False
    ) -> tuple[CameraPrior, PriorTest]:
        """Estimate the priors in the linearisation of a problem at its minimum.

        `last` is the test by which the present priors were estimated. In a large block variances are estimated from
        random probes, unless `exact`.
        """
        try:
            return self._learnt(problem, minimum, last, exact)
        except np.linalg.LinAlgError as error:  # priors so wide that rounding dominates the weakest mode
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
        perhaps: BoolArray | None = None
        prior = self._prior(scale, wide)
        if around.small and self.learns:
            _, params, covariance = around.under(prior)
        known = self._known(covariance, prior if around.small else now, exact)
        total, freedom = (float(x) for x in self._sums(params, known)[0])
        ratio = total / freedom if freedom > _MIN_FREEDOM else float("nan")
        shared = self._shared(params, known)
        # large block whose priors on constants were widened: its drift shrinks, and need not converge before the test
        stands = not around.small and last is not None and bool((last.scale > 1.0).any())
        for _ in range(ITERATIONS if self.learns or self.learn_waves else 0):
            before = prior
            if self.learn_waves:
                self = self._going_on(self._waves(params, known, prior.sigma))
            wide = self._beside(params, known, last) if self.learns else wide
            prior = self._prior(scale, wide)
            # a large drift or rotation looks like a wrong position: its size is estimated first
            other, least = (before, STANDS) if around.small else (now, SAME_PRIOR)
            stands |= same_prior(prior, other, least, slice(self.constants, self.constants + 3 * self._degrees))
            if stands and self.learns and self._too_large(params, known, scale):
                scale, odd, perhaps = self._widened(around, params, known, wide)
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
            perhaps_odd=perhaps,
        )
        return replace(prior, sigma=sigma), tested

    def _shared(self, params: Array, known: Array) -> Array:
        """Return the factors (N,) on the standard deviations of views with a stated accuracy, for their common error.

        Views that their supplier adjusted together have a common error. The independent errors are estimated from the
        corrections, as an upper limit of their share in the stated variance. The rest is the common error, which the
        mean of many views does not reduce. With independent priors on n views, each with two unknowns in each direction
        (rotation, translation), the standard deviation of the position would be sqrt(n / 2) times too small.
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
        """Return the second and third rows (2, 2) of `shown`, summed over earlier blocks and this one."""
        assert self.stated is not None
        of_place = self._by_view(params, known)[:, self.stated, 0].sum(axis=1)
        count = np.count_nonzero(known[self.stated, : self.constants].any(axis=1))
        return np.asarray(self._before[1:3] + np.array([of_place, [count, 0.0]]))

    @property
    def _before(self) -> Array:
        """The sums of an earlier block (4 + D, 2), see `shown`; zeros without one."""
        return np.zeros((4 + self._degrees, 2)) if self.shown is None else self.shown

    def _showing(self, params: Array, known: Array) -> Array:
        """Return `shown` for a later run: the sums of this block and earlier ones."""
        rest = self._before[1:3] if self.stated is None else self._of_stated(params, known)
        return np.insert(self._sums(params, known), [1, 1], rest, axis=0)

    def _going_on(self, sigma: Array) -> Variances:
        """Return a copy whose given prior has the standard deviations (N, q) of splines and steps."""
        part, given = self.unknowns.in_waves, self.given.sigma.copy()
        given[:, part] = sigma[:, part]
        return replace(self, given=replace(self.given, sigma=given))

    def _waves(self, params: Array, known: Array, sigma: Array) -> Array:
        """Return the standard deviations (N, q) with those of splines and steps estimated for each view."""
        assert self.unknowns.waves is not None
        first, bands = self.unknowns.in_waves.start, self.unknowns.waves.bands
        out = sigma.copy()
        for band in range(int(bands.max()) + 1):
            rows = first + np.flatnonzero(bands == band)
            learnt = np.isfinite(sigma[:, rows[0]])  # infinite: the prior is in the matrix of an earlier block
            squares, freedom = (learnt * part.sum(axis=1) for part in (params[:, rows] ** 2, known[:, rows]))
            common = (NOISE_FLOOR**2 + squares.sum()) / (1.0 + freedom.sum())
            size = np.sqrt(pooled_variance(squares, freedom, common))
            out[:, rows] = np.where(learnt, size, np.inf)[:, None]
        return out

    def _prior(self, scale: Array, wide: Array) -> CameraPrior:
        """Return the given prior with factors `scale` (N,) on constants and `wide` (D + 1,) on drifts and rotations."""
        sigma = self.given.sigma.copy()
        sigma[:, : self.constants] *= scale[:, None]
        for degree, factor in enumerate(wide[:-1]):
            part = self._drift_part(degree)
            sigma[:, part] *= factor
            if degree == 0 and self.learns:
                sigma[:, part] = np.hypot(sigma[:, part], _CENTRE_MOTION_SHARE * sigma[:, :3])
        # the factor on a rotation is at least that on the position
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
        """Return the squared corrections and the degrees of freedom (2, N, 2 + D) of each view and kind.

        The squared corrections are divided by the given variances.
        """
        off = (params - self.given.mean) / self.given.sigma
        along = (self.given.turn * off).sum(axis=1, keepdims=True)
        seen = np.hstack([off - along * self.given.turn, along])
        return np.stack([np.where(known > 0, seen**2, 0.0), known]) @ self._kinds.T

    def _sums(self, params: Array, known: Array) -> Array:
        """Return the sums (2 + D, 2) of `_by_view` over all views and earlier blocks."""
        return np.asarray(self._by_view(params, known).sum(axis=1).T + np.delete(self._before, [1, 2], axis=0))

    def _too_large(self, params: Array, known: Array, scale: Array) -> bool:
        """Return whether the corrections of the position are significantly larger than their prior."""
        squares, free = self._before[0]
        total, freedom = self._by_view(params, known)[..., 0]
        total, freedom = (total / scale**2).sum() + squares / float(np.min(scale)) ** 2, freedom.sum() + free
        return freedom > _MIN_FREEDOM and float(chdtrc(freedom, total)) < LEVEL

    def _widened(
        self, around: QuadraticProblem, params: Array, known: Array, wide: Array
    ) -> tuple[Array, BoolArray, BoolArray | None]:
        """Return the factors (N,) on the prior of each view, the mask of odd views, and `PriorTest.perhaps_odd`.

        Two explanations are compared by their evidence: wider priors on all views, or on a few odd views alone. Each is
        evaluated at its most likely factors. If neither is significantly better, the factors are the larger of both.
        The factors returned are upper confidence limits where the estimates are `cautious`.
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
            return careful, np.zeros(n, dtype=bool), None
        both, beyond, together = self._odd(around, wide, careful)
        if self.cautious:
            together = max(together, around.under(self._prior(usual, wide))[0])
        # rotations of all views would explain the error of an odd one: they are not widened here
        few, odd, alone = self._odd(around, np.append(wide[:-1], 1.0), np.ones(n), together)
        if alone >= together + _LIKELIER:
            return few, odd, None
        # the factor of the other views is estimated without the odd ones
        both = np.where(beyond, both, self._common(total[~beyond], freedom[~beyond], self.cautious))
        if alone < together - SURE:
            return both, beyond, None
        return np.maximum(few, both), beyond, odd  # wide enough for both

    def _common(self, total: Array, freedom: Array, careful: bool) -> float:
        """Return the common factor on the priors of views, at least 1, from squares and degrees of freedom (n,)."""
        squares, free = self._before[0] + np.array([total.sum(), freedom.sum()])
        return float(np.sqrt(max(self._likely(squares, free, careful), 1.0)))

    def _likely(self, total: float, freedom: float, careful: bool) -> float:
        """Return the estimate of a variance over the given variance.

        `total` is the sum of squares over the given variance, which has the weight of `STATED_FREEDOM` observations.
        With `careful`, the estimate is at least the upper confidence limit with a probability of error of `_LOW`.
        """
        likely = pooled_variance(total, freedom, 1.0)
        if not careful or freedom <= _MIN_FREEDOM:
            return float(likely)
        return float(max(likely, total / (2.0 * gammaincinv(0.5 * freedom, _LOW))))

    def _odd(
        self, around: QuadraticProblem, wide: Array, usual: Array, rival: float | None = None
    ) -> tuple[Array, BoolArray, float]:
        """Find odd views by forward selection; the other views have the factors `usual` (N,).

        In each step the view with the largest log evidence in each neighbourhood (views that share points) is chosen,
        if its gain exceeds the price, ln N. Views that explain the residuals as well as a chosen one are odd too.
        Returned are the factors (N,), the mask of odd views, and the log evidence minus the price of each choice.

        `rival` is the log evidence of another explanation. If it is given, at least one view is chosen. The search
        fails, with a log evidence of minus infinity, once further views cannot reach the rival.
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
            as_good = (chosen_near > -np.inf) & (evidence > chosen_near - SURE)  # as likely as the view chosen near it
            odd, scale = odd | as_good, np.where(as_good, np.maximum(size, scale), scale)
            chosen[tops] = size[tops]
            known = known.together(np.flatnonzero(tops), self._prior(chosen, wide))
            count += int(tops.sum())
        return scale, odd, known.evidence - count * price

    def _alone(self, known: Posterior, wide: Array, scale: Array) -> tuple[Array, Array]:
        """Return the log evidence (N,) with each view as an additional odd view, and the factors (N,) on its prior."""
        prior = self._prior(np.maximum(scale, GROSS), wide)
        _, offset, blocks = known.alone(prior)
        seen = self._share(blocks, prior, known.around.problem.free)
        total, freedom = self._by_view(offset + self.given.mean, seen)[..., 0]
        size = np.maximum(np.sqrt(pooled_variance(total, freedom, 1.0)), scale)
        return known.alone(self._prior(size, wide))[0], size

    def _beside(self, params: Array, known: Array, last: PriorTest | None) -> Array:
        """Return the factors (D + 1,) on the standard deviations of drifts and rotations about the lines of sight.

        They are at most `TIMES` those of the `last` linearisation, and at most `widest`. Without a limit, the factors
        of drifts and rotations that the observations hardly determine would grow with every linearisation.
        """
        waves = self.unknowns.waves  # no caution with splines or steps: they represent bent heights
        careful = self.cautious and not (waves and (waves.count or waves.edges.size))
        factors = [
            self._likely(total, freedom, careful and float(chdtrc(freedom, total)) < CHANCE)
            for total, freedom in self._sums(params, known)[1:]
        ]
        most = TIMES * (1.0 if last is None else np.array(last.wide))
        return np.minimum(np.sqrt(factors), most if self.widest is None else np.minimum(most, self.widest))


def _neighbour_maximum(values: Array, pairs: IntArray) -> Array:
    """Return the maximum (N,) of `values` over each view and the views that it shares points with."""
    i, j = pairs.T
    out = values.copy()
    np.maximum.at(out, i, values[j])
    np.maximum.at(out, j, values[i])
    return out


def _first_of_largest(values: Array, pairs: IntArray) -> BoolArray:
    """Return the mask (N,) of views with the largest value among the views that share points with them.

    Of views with equal values, only the first is in the mask.
    """
    i, j = pairs.T
    tops: BoolArray = values == _neighbour_maximum(values, pairs)
    tops[j[tops[i] & tops[j]]] = False
    return tops


def same_prior(a: CameraPrior, b: CameraPrior, share: float, part: slice | None = None) -> bool:
    """Return whether the logarithms of the standard deviations of two priors differ by less than `share`.

    The standard deviations of all unknowns are compared, or those of `part`. Rotations about the lines of sight are
    always compared. Infinite standard deviations are not compared.
    """
    one, other = (prior.sigma[:, slice(None) if part is None else part] for prior in (a, b))
    finite = np.isfinite(one) & np.isfinite(other)
    apart = np.append(np.log(one[finite] / other[finite]), np.log(np.divide(a.wider, b.wider)))
    return bool((np.abs(apart) < share).all())
