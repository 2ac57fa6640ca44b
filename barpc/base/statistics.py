"""Numbers that mean the same wherever something is decided or computed, each in one place."""

from typing import Any

import numpy as np

from barpc.base.geodesy import Array

# --- what is sure -----------------------------------------------------------------------------------------

LEVEL = 0.05
"""Usual level of a test: what is less probable by chance is asked about."""

CHANCE = 1e-3
"""Level of a test that names something in a block: one sound block in a thousand."""

SURE = 5.0
"""Nats: an explanation that gains less is none, and of two that differ by less (a factor of 150) none is ruled out."""

SURELY = 3.0
"""Standard deviations: normal errors are larger once in 370."""

OUTLIER = 5.0
"""Standard deviations: of a million normal errors not one is larger. What is farther off is something else."""

CRITICAL = 4.0
"""Standard deviations of what many are tested by: a component is larger by chance once in 16,000, one of five points
once in a thousand."""

BIWEIGHT = 4.685
"""Standard deviations at which Tukey's biweight ends: 95 % as efficient as least squares where all is normal."""

MAD = 1.4826
"""Of a median of distances: the standard deviation of normal errors."""

MUCH_NOISE = 1.5
"""Times what is stated: more noise than that is no noise."""

LEAST_NOISE = 0.25
"""Times what is stated: less noise than that is a few that fit by chance."""

TIMES = 30.0
"""What is learnt lies within so many times of what is guessed, either way."""

GROSS = 100.0
"""Standard deviations of what holds nothing: of another place, or open."""

# --- what is enough ---------------------------------------------------------------------------------------

FEW = 30
"""Observations that tell a standard deviation to an eighth, 1 / sqrt(2 n): fewer tell nothing by themselves."""

FEWEST = 20
"""Observations, or degrees of freedom, that tell a variance to a third, sqrt(2 / n): of fewer nothing is said."""

MANY = 100
"""Observations that can be told apart into two kinds, or of which some can be spared."""

SAMPLE = 2000
"""Observations or points that stand for all."""

BEST = 0.2
"""Part of the observations, the nearest: even where many are wrong right ones are among them."""

TRIALS = 150
"""Draws of three: where half are right, all of them miss three right ones once in 5e8."""

STATED_FREEDOM = 4.0
"""Observations, or degrees of freedom, that a figure stated counts for beside what is seen."""

RIVALS = 3
"""Ways to explain the same, the best and those after it, that are gone on with."""

TRIED = 6
"""What is tried, or taken, one by one where each is a solve of its own, at most."""

STEPS = 3
"""Of what is nearly linear: kilometres away, what is left is below a micrometre."""

BACKFITTING = 6
"""Turns of parts that are fitted in turn: what is left of a guess is below a thousandth of it."""

ITERATIONS = 100
"""Of what ends by itself when it stands, at most."""

STANDS = 0.05
"""Change of a size, as part of it, below which it stands."""

SLIGHT = 1e-3
"""Part of the observations that decides nothing."""

SHRINK = 0.25
"""Of a loss's scale that is left in one step, at least: it follows what is right out of what is wrong."""

# --- arithmetic -------------------------------------------------------------------------------------------

KEPT = 1_000_000
"""Observations whose derivatives are kept from one step to the next, some 200 bytes each."""

ROUNDING = 1e-9
"""Of a size: what differs by less is the same but for rounding, and a column that adds less to others is none."""

RIDGE = 1e-6
"""Of the weight of what is known: what nothing tells stays where it is."""

LARGEST = 12_000
"""Unknowns of a block up to which parts of it are solved again for what may explain them."""

SMALL = 400
"""Unknowns up to which a block is solved again for every explanation that is tried."""


def robust_spread(values: Array, center: float | Array = 0.0) -> Any:
    """Return the robust standard deviation: `MAD` times the median over the last axis of the distances from a centre.

    Residuals are measured from zero; a sample that is stated with its median from that median. Of none it is 0.
    """
    if not len(values):
        return 0.0
    spread = MAD * np.median(np.abs(values - center), axis=-1)
    return spread if spread.ndim else float(spread)
