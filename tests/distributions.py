"""The few distributions that fast tests ask for, under the names of scipy.stats, which takes a second to import."""

from __future__ import annotations

from math import comb

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betainc, gammaincc, gammainccinv, gammaincinv, gammaln, ndtr, ndtri


class norm:
    """Normal."""

    @staticmethod
    def logpdf(x: ArrayLike, mean: float = 0.0, sigma: float = 1.0) -> np.ndarray:
        return -0.5 * ((np.asarray(x) - mean) / sigma) ** 2 - np.log(sigma * np.sqrt(2.0 * np.pi))

    @classmethod
    def pdf(cls, x: ArrayLike, mean: float = 0.0, sigma: float = 1.0) -> np.ndarray:
        return np.exp(cls.logpdf(x, mean, sigma))

    @staticmethod
    def ppf(share: ArrayLike) -> np.ndarray:
        return ndtri(share)

    @staticmethod
    def sf(x: ArrayLike) -> np.ndarray:
        return ndtr(-np.asarray(x))


class chi2:
    """Chi-square of so many degrees of freedom."""

    @staticmethod
    def ppf(share: ArrayLike, freedom: ArrayLike) -> np.ndarray:
        return 2.0 * gammaincinv(np.asarray(freedom) / 2.0, share)

    @staticmethod
    def isf(share: ArrayLike, freedom: ArrayLike) -> np.ndarray:
        return 2.0 * gammainccinv(np.asarray(freedom) / 2.0, share)

    @staticmethod
    def sf(x: ArrayLike, freedom: ArrayLike) -> np.ndarray:
        return gammaincc(np.asarray(freedom) / 2.0, np.asarray(x) / 2.0)

    @classmethod
    def median(cls, freedom: float) -> float:
        return float(cls.ppf(0.5, freedom))


class f:
    """Fisher's ratio of two variances."""

    @staticmethod
    def sf(x: ArrayLike, above: float, below: float) -> np.ndarray:
        return betainc(below / 2.0, above / 2.0, below / (below + above * np.asarray(x)))


class gamma:
    """Gamma, of a shape and a scale."""

    @staticmethod
    def logpdf(x: ArrayLike, shape: ArrayLike, scale: ArrayLike = 1.0) -> np.ndarray:
        z = np.asarray(x) / scale
        return (np.asarray(shape) - 1.0) * np.log(z) - z - gammaln(shape) - np.log(scale)


class hypergeom:
    """How many of `count` drawn from `whole` are among `alike` of these."""

    def __init__(self, whole: int, alike: int, count: int) -> None:
        ways = [comb(alike, k) * comb(whole - alike, count - k) for k in range(min(alike, count) + 1)]
        self.shares = [one / comb(whole, count) for one in ways]

    def sf(self, k: int) -> float:
        """Probability of more than k."""
        return sum(self.shares[k + 1 :])


class multivariate_normal:
    """Normal of some dimensions."""

    def __init__(self, mean: np.ndarray, covariance: np.ndarray) -> None:
        self.mean, self.covariance = mean, covariance

    def logpdf(self, x: np.ndarray) -> float:
        off = x - self.mean
        squares = off @ np.linalg.solve(self.covariance, off)
        return float(-0.5 * (squares + np.linalg.slogdet(2.0 * np.pi * self.covariance)[1]))


def _moment(z: np.ndarray, order: int) -> float:
    return float((((z - z.mean()) / z.std()) ** order).mean())


def skew(z: np.ndarray) -> float:
    """Third moment."""
    return _moment(z, 3)


def kurtosis(z: np.ndarray) -> float:
    """Fourth moment: 3 of a normal."""
    return _moment(z, 4)
