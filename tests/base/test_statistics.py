"""Constants and samples that several rooms share."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.base.statistics import SAMPLE, evenly, pooled_variance


@pytest.mark.parametrize(
    ("count", "most", "step"),
    [(0, None, 1), (1, None, 1), (SAMPLE, None, 1), (SAMPLE + 1, None, 2), (30, 10, 3), (31, 10, 4)],
)
def test_a_sample_is_even_and_no_larger_than_it_may_be(count: int, most: int | None, step: int) -> None:
    chosen = np.arange(count)[evenly(count, most)]
    np.testing.assert_array_equal(chosen, np.arange(0, count, step))
    assert len(chosen) <= (most or SAMPLE)


def test_a_stated_variance_counts_as_four_observations() -> None:
    assert pooled_variance(0.0, 0.0, 9.0) == 9.0
    np.testing.assert_allclose(pooled_variance(np.array([4.0, 12.0]), 4.0, 1.0), [1.0, 2.0])
