"""The tests' own distributions are those of scipy."""

from __future__ import annotations

import numpy as np
import pytest

from tests import distributions


@pytest.mark.slow
def test_the_distributions_are_those_of_scipy() -> None:
    from scipy import stats

    x = np.linspace(0.2, 9.0, 12)
    share = np.linspace(0.001, 0.999, 12)
    for own, theirs in (
        (distributions.norm.pdf(x, 1.0, 2.0), stats.norm.pdf(x, 1.0, 2.0)),
        (distributions.norm.logpdf(x), stats.norm.logpdf(x)),
        (distributions.norm.ppf(share), stats.norm.ppf(share)),
        (distributions.norm.sf(x), stats.norm.sf(x)),
        (distributions.chi2.ppf(share, 5), stats.chi2.ppf(share, 5)),
        (distributions.chi2.isf(share, 5), stats.chi2.isf(share, 5)),
        (distributions.chi2.sf(x, 5), stats.chi2.sf(x, 5)),
        (distributions.chi2.median(2), stats.chi2.median(2)),
        (distributions.f.sf(1.7, 36, 764), stats.f.sf(1.7, 36, 764)),
        (distributions.gamma.logpdf(x, 2.5, scale=3.0), stats.gamma.logpdf(x, 2.5, scale=3.0)),
        (distributions.hypergeom(60, 8, 10).sf(2), stats.hypergeom(60, 8, 10).sf(2)),
        (distributions.skew(x**2), stats.skew(x**2)),
        (distributions.kurtosis(x**2), stats.kurtosis(x**2, fisher=False)),
    ):
        np.testing.assert_allclose(own, theirs, rtol=1e-9)
    covariance = np.cov(np.random.default_rng(0).normal(size=(4, 30)))
    point = np.arange(4.0)
    own, theirs = (one.multivariate_normal(np.ones(4), covariance) for one in (distributions, stats))
    assert own.logpdf(point) == pytest.approx(theirs.logpdf(point))
