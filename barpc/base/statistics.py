"""Statistical constants: significance levels, robust estimation, sample sizes and limits of iterations."""

from typing import Any

import numpy as np

from barpc.base.geodesy import Array

# --- significance -----------------------------------------------------------------------------------------

LEVEL = 0.05
"""Usual significance level of a test."""

CHANCE = 1e-3
"""Significance level of a test with a finding in the verdict: one false alarm in a thousand sound blocks."""

SURE = 5.0
"""Log evidence [nats] that selects a hypothesis over another: a Bayes factor of 150."""

SURELY = 3.0
"""Standard deviations of a significant difference: exceeded by normal errors once in 370."""

OUTLIER = 5.0
"""Standard deviations of an outlier: not one of a million normal errors is larger."""

CRITICAL = 4.0
"""Critical value of a test of many residuals: exceeded by a component once in 16,000, by one of five points once in a
thousand."""

BIWEIGHT = 4.685
"""Constant of Tukey's biweight: 95 % efficiency for normal errors."""

MAD = 1.4826
"""Standard deviation of normal errors over their median absolute deviation."""

MUCH_NOISE = 1.5
"""Upper limit of a noise estimate over the stated noise."""

LEAST_NOISE = 0.25
"""Lower limit of a noise estimate over the stated noise: less is a chance fit of few observations."""

TIMES = 30.0
"""Largest ratio of an estimate to its initial value, either way."""

GROSS = 100.0
"""Standard deviations of an effectively unconstrained quantity, or of a gross error."""

# --- sample sizes and iterations --------------------------------------------------------------------------

FEW = 30
"""Sample size that determines a standard deviation to an eighth, 1 / sqrt(2 n)."""

FEWEST = 20
"""Degrees of freedom that determine a variance to a third, sqrt(2 / n)."""

MANY = 100
"""Sample size for a mixture of two classes, or for check observations."""

SAMPLE = 2000
"""Size of a representative subsample."""

BEST = 0.2
"""Lower quantile of residuals assumed free of outliers."""

BANDS = 8
"""Parts of the rows, or of the columns, of an image: a displacement counts by its mean over one of them."""

TRIALS = 150
"""Random samples of three: with half inliers, none is free of outliers once in 5e8."""

STATED_FREEDOM = 4.0
"""Degrees of freedom of a stated standard deviation as a prior."""

RIVALS = 3
"""Hypotheses kept in a beam search."""

TRIED = 6
"""Most candidates tried one by one, each with its own solution."""

STEPS = 3
"""Iterations of a nearly linear problem: kilometres away, the remainder is below a micrometre."""

BACKFITTING = 6
"""Sweeps of backfitting: the influence of initial values is below a thousandth."""

ITERATIONS = 100
"""Most iterations of a convergent procedure."""

STANDS = 0.05
"""Relative change at convergence of an estimate that others are iterated with."""

CONVERGED = 1e-3
"""Relative change at convergence of a single estimate."""

SLIGHT = 1e-3
"""Negligible share of the observations."""

SHRINK = 0.25
"""Least factor of a loss scale in one step of graduated non-convexity."""

# --- arithmetic -------------------------------------------------------------------------------------------

KEPT = 1_000_000
"""Most observations with derivatives kept between steps, some 200 bytes each."""

ROUNDING = 1e-9
"""Relative rounding error: limit of equality, and of linear dependence of columns."""

RIDGE = 1e-6
"""Relative weight of a ridge that keeps undetermined unknowns at their initial values."""

LARGEST = 12_000
"""Most unknowns of a block in which hypotheses on parts of it are tested."""

SMALL = 400
"""Most unknowns of a block that is solved again for every hypothesis."""


def evenly(count: int, most: int | None = None) -> slice:
    """Return the slice of every n-th of `count` elements that leaves at most `most`; by default `SAMPLE`."""
    return slice(None, None, max(-(-count // (most or SAMPLE)), 1))


def pooled_variance(squares: Any, freedom: Any, stated: Any) -> Any:
    """Return the variance by a sum of squares of so many degrees of freedom, with the stated one as a prior."""
    return (STATED_FREEDOM * stated + squares) / (STATED_FREEDOM + freedom)


def kd_tree(places: Array) -> Any:
    """Return scipy's k-d tree of places (n, d)."""
    from scipy.spatial import cKDTree  # a tenth of a second, which runs with matches given do not need

    return cKDTree(places)


def robust_spread(values: Array, center: float | Array = 0.0) -> Any:
    """Return the robust standard deviation: `MAD` times the median over the last axis of the distances from a centre.

    Residuals are measured from zero; a sample that is stated with its median from that median. Of none it is 0.
    """
    if not len(values):
        return 0.0
    distance = np.abs(values - center)
    spread = MAD * (np.median(distance, axis=-1) if distance.ndim > 1 else _quick_median(distance))
    return spread if spread.ndim else float(spread)


def _quick_median(values: Array) -> Any:
    """Return the median of values (n,), NaN where one is: `np.median`, which takes six times as long for a hundred."""
    middle = len(values) // 2
    part = np.partition(values, [middle - 1, middle, -1] if len(values) > 1 else 0)
    low = part[middle - 1 + len(values) % 2]
    return part[-1] if np.isnan(part[-1]) else (low + part[middle]) / 2
