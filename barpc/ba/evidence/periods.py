"""Sinusoidal displacements of the rows of an image: a periodogram of the residuals along them.

The score test of a cosine and a sine in each coordinate (Lomb 1976, Scargle 1982) at all frequencies at once, by the
fast Fourier transform of residuals summed over few rows. Noise alone exceeds x with the probability (1 + x) exp(-x);
errors that change along the rows without a period raise whole stretches of the spectrum, and a peak is measured by
those beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import chdtri

from barpc.base.geodesy import Array
from barpc.base.statistics import FEW, OUTLIER, SURE
from barpc.scene import IntArray
from barpc.sensor.image_corrections import sine_and_cosine

_SHORTEST = 32.0  # rows: of what is shorter a matcher's window shows the mean
_MIN_PERIODS = 1.5  # waves of an image: fewer are no swing yet, and what is nearer to a peak is its own
_FREQUENCY_OVERSAMPLING = 4  # frequencies a wave more
_BIN = _SHORTEST / _FREQUENCY_OVERSAMPLING  # rows summed: a tenth of the shortest is lost


@dataclass(frozen=True)
class Period:
    """A significant period."""

    view: int
    period: float  # [px]
    gain: float  # nats, what the choice among all frequencies and views costs taken off


def price_of_period(rows: float, views: int) -> float:
    """Return the cost of choosing a period, in images of so many rows, and a view [nats]."""
    # as many as the frequencies count as tests (Baluev 2008, near the levels asked for)
    return float(np.log(max(_FREQUENCY_OVERSAMPLING * rows / _SHORTEST, 1.0) * views))


def find_periods(
    view: IntArray, row: Array, size: Array, right: Array, off: Array, least: float = SURE
) -> list[Period]:
    """Find the most significant period of every view, the best first; none that gains less than `least` [nats].

    Parameters
    ----------
    view, row : (K,), where observations are [px], in images of `size` (2, N)
    right : (K,), weights; 0 of those that tell nothing
    off : (2, K), residuals in standard deviations
    """
    views = size.shape[1]
    told = np.flatnonzero(right > 0.0)
    by_view = told[np.argsort(view[told], kind="stable")]
    found = []
    for v, mine in enumerate(np.split(by_view, np.searchsorted(view[by_view], np.arange(1, views)))):
        rows = float(size[1, v])
        costs = price_of_period(rows, views)
        if len(mine) >= FEW and rows > 2.0 * _MIN_PERIODS * _SHORTEST:
            clipped = np.clip(off[:, mine], -OUTLIER, OUTLIER)
            best = _Rows(row[mine], rows, right[mine], clipped).largest(costs + least)
            if best is not None:
                found.append(Period(v, best[0], best[1] - costs))
    return sorted(found, key=lambda one: -one.gain)


class _Rows:
    """Residuals of one image, summed over few rows."""

    def __init__(self, row: Array, rows: float, right: Array, off: Array) -> None:
        self.row, self.off, self.right = row, off, right
        self.bins = int(np.ceil(rows / _BIN))
        self.waves = np.arange(int(_FREQUENCY_OVERSAMPLING * rows / _SHORTEST)) / _FREQUENCY_OVERSAMPLING  # of an image
        self.first = int(np.ceil(_FREQUENCY_OVERSAMPLING * _MIN_PERIODS))

    def largest(self, costs: float) -> tuple[float, float] | None:
        """Return the period, and minus the logarithm of its chance at one frequency; None below `costs`."""
        gain = self._spectrum(self.off)
        if _worth(gain.max(initial=0.0)) <= costs:
            return None
        band = np.floor(2.0 * np.log2(self.waves[self.first :]))
        starts = self.first + np.flatnonzero(np.diff(band, prepend=-1.0))
        best = None
        for start, stop in pairwise([*starts.tolist(), len(gain)]):
            k = start + int(gain[start:stop].argmax())
            if _worth(gain[k]) > max(costs, 0.0 if best is None else best[1]):
                period = self.bins * _BIN / (self.waves[k] + parabola_vertex(gain, k) / _FREQUENCY_OVERSAMPLING)
                worth = _worth(gain[k] / self._level(k, period))
                if worth > max(costs, 0.0 if best is None else best[1]):
                    best = float(period), worth
        return best

    def _spectrum(self, off: Array) -> Array:
        """Return the half the chi-square that a cosine and a sine of both coordinates take away, by frequency."""
        right, last = self.right, len(self.waves)
        centred = (off - (off @ right / right.sum())[:, None]) * right
        spread = centred @ centred.T / right.sum()  # what noise leaves of it once points have followed
        spread[np.diag_indices(2)] += 1e-9 * np.trace(spread) + 1e-30
        alike = np.linalg.cholesky(np.linalg.inv(spread)).T @ centred  # what noise leaves alike in every direction
        at = (self.row / _BIN).astype(np.int64).clip(0, self.bins - 1)
        sums = np.array([np.bincount(at, weight, self.bins) for weight in alike])
        found = np.fft.rfft(sums, _FREQUENCY_OVERSAMPLING * self.bins, axis=1)[:, :last]
        real, imag = found.real.copy(), found.imag.copy()
        count = np.fft.rfft(np.bincount(at, right, self.bins), _FREQUENCY_OVERSAMPLING // 2 * self.bins)[
            :last
        ]  # of twice the frequency
        half, twice, both = 0.5 * right.sum(), 0.5 * count.real, 0.5 * count.imag
        determinant = np.maximum(half**2 - twice**2 - both**2, 1e-12 * half**2)
        gain = (half - twice) * (real * real).sum(axis=0) + (half + twice) * (imag * imag).sum(axis=0)
        return np.asarray((0.5 * gain - both * (real * imag).sum(axis=0)) / determinant)

    def _level(self, k: int, period: float) -> float:
        """Return the level of the spectrum beside a peak over that of noise, the peak taken away: at least 1."""
        basis = np.vstack([np.ones(len(self.row)), sine_and_cosine(self.row, np.array(period))])
        weighted = basis * self.right
        gain = self._spectrum(self.off - (np.linalg.solve(weighted @ basis.T, weighted @ self.off.T)).T @ basis)
        away = np.abs(self.waves - self.waves[k])
        beside = (away > _MIN_PERIODS) & (away < SURE + self.waves[k])
        beside[: self.first] = False
        of_noise = 0.5 * chdtri(4.0, 0.5)  # the median of half a chi-square
        return max(float(np.median(gain[beside]) / of_noise), 1.0) if beside.any() else 1.0


def _worth(gain: float) -> float:
    """Return minus the logarithm of the probability that noise takes away as much at one frequency."""
    return float(gain - np.log1p(gain))


def parabola_vertex(gain: Array, k: int) -> float:
    """Return the offset from k of the vertex of the parabola through values k - 1 to k + 1 of `gain` (n,), in steps.

    Half a step at most; 0 at the ends, and where the values have no peak there.
    """
    if not 0 < k < len(gain) - 1:
        return 0.0
    bend = gain[k - 1] - 2.0 * gain[k] + gain[k + 1]
    return float(np.clip(0.5 * (gain[k - 1] - gain[k + 1]) / bend, -0.5, 0.5)) if bend < 0 else 0.0
