"""Sinusoidal displacements of the rows of an image: a periodogram of the residuals along the rows.

The score test of a cosine and a sine in each coordinate (Lomb 1976, Scargle 1982), at all frequencies at once by the
fast Fourier transform of residuals summed over a few rows. Noise exceeds x with probability (1 + x) exp(-x). Errors
along the rows without a period raise broad parts of the spectrum. Therefore a peak is divided by the level of the
spectrum beside it.
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

_SHORTEST = 32.0  # rows: the window of a matcher averages shorter periods
_MIN_PERIODS = 1.5  # least number in an image; frequencies nearer to a peak than this belong to it
_FREQUENCY_OVERSAMPLING = 4  # frequencies tested per period in an image
_BIN = _SHORTEST / _FREQUENCY_OVERSAMPLING  # rows summed: the shortest period loses a tenth of its amplitude


@dataclass(frozen=True)
class Period:
    """A significant period."""

    view: int
    period: float  # [px]
    gain: float  # log-likelihood ratio less the price of the choice of frequency and view [nats]


def price_of_period(rows: float, views: int) -> float:
    """Return the price [nats] of choosing a period and a view, in images of `rows` rows."""
    # number of independent tests: that of the frequencies (Baluev 2008, near the levels used)
    return float(np.log(max(_FREQUENCY_OVERSAMPLING * rows / _SHORTEST, 1.0) * views))


def find_periods(
    view: IntArray, row: Array, size: Array, right: Array, off: Array, least: float = SURE
) -> list[Period]:
    """Find the most significant period of each view, the best first, that gains at least `least` [nats].

    Parameters
    ----------
    view, row : (K,), view and row [px] of observations, in images of `size` (2, N)
    right : (K,), weights; 0: not used
    off : (2, K), residuals in standard deviations
    """
    views = size.shape[1]
    in_use = np.flatnonzero(right > 0.0)
    by_view = in_use[np.argsort(view[in_use], kind="stable")]
    found = []
    for v, own in enumerate(np.split(by_view, np.searchsorted(view[by_view], np.arange(1, views)))):
        rows = float(size[1, v])
        price = price_of_period(rows, views)
        if len(own) >= FEW and rows > 2.0 * _MIN_PERIODS * _SHORTEST:
            clipped = np.clip(off[:, own], -OUTLIER, OUTLIER)
            best = _Rows(row[own], rows, right[own], clipped).largest(price + least)
            if best is not None:
                found.append(Period(v, best[0], best[1] - price))
    return sorted(found, key=lambda one: -one.gain)


class _Rows:
    """Residuals of one image in bins of `_BIN` rows, and the frequencies to test [cycles per image]."""

    def __init__(self, row: Array, rows: float, right: Array, off: Array) -> None:
        self.row, self.off, self.right = row, off, right
        self.bins = int(np.ceil(rows / _BIN))
        self.cycles = np.arange(int(_FREQUENCY_OVERSAMPLING * rows / _SHORTEST)) / _FREQUENCY_OVERSAMPLING
        self.first = int(np.ceil(_FREQUENCY_OVERSAMPLING * _MIN_PERIODS))

    def largest(self, least: float) -> tuple[float, float] | None:
        """Return the period and minus the log of its p-value at one frequency; None if not above `least`."""
        gain = self._spectrum(self.off)
        if _minus_log_p(gain.max(initial=0.0)) <= least:
            return None
        band = np.floor(2.0 * np.log2(self.cycles[self.first :]))
        starts = self.first + np.flatnonzero(np.diff(band, prepend=-1.0))
        best = None
        for start, stop in pairwise([*starts.tolist(), len(gain)]):
            k = start + int(gain[start:stop].argmax())
            if _minus_log_p(gain[k]) > max(least, 0.0 if best is None else best[1]):
                period = self.bins * _BIN / (self.cycles[k] + parabola_vertex(gain, k) / _FREQUENCY_OVERSAMPLING)
                log_p = _minus_log_p(gain[k] / self._level(k, period))
                if log_p > max(least, 0.0 if best is None else best[1]):
                    best = float(period), log_p
        return best

    def _spectrum(self, off: Array) -> Array:
        """Return half the chi-square that a cosine and a sine explain in both coordinates, at each frequency."""
        right, last = self.right, len(self.cycles)
        centred = (off - (off @ right / right.sum())[:, None]) * right
        spread = centred @ centred.T / right.sum()  # covariance of the residuals, which ground points reduce
        spread[np.diag_indices(2)] += 1e-9 * np.trace(spread) + 1e-30
        whitened = np.linalg.cholesky(np.linalg.inv(spread)).T @ centred  # of unit covariance
        at = (self.row / _BIN).astype(np.int64).clip(0, self.bins - 1)
        sums = np.array([np.bincount(at, weight, self.bins) for weight in whitened])
        found = np.fft.rfft(sums, _FREQUENCY_OVERSAMPLING * self.bins, axis=1)[:, :last]
        real, imag = found.real.copy(), found.imag.copy()
        # at twice the frequency
        count = np.fft.rfft(np.bincount(at, right, self.bins), _FREQUENCY_OVERSAMPLING // 2 * self.bins)[:last]
        half, twice, both = 0.5 * right.sum(), 0.5 * count.real, 0.5 * count.imag
        determinant = np.maximum(half**2 - twice**2 - both**2, 1e-12 * half**2)
        gain = (half - twice) * (real * real).sum(axis=0) + (half + twice) * (imag * imag).sum(axis=0)
        return np.asarray((0.5 * gain - both * (real * imag).sum(axis=0)) / determinant)

    def _level(self, k: int, period: float) -> float:
        """Return the level of the spectrum beside a peak over that of noise, with the peak removed: at least 1."""
        basis = np.vstack([np.ones(len(self.row)), sine_and_cosine(self.row, np.array(period))])
        weighted = basis * self.right
        gain = self._spectrum(self.off - (np.linalg.solve(weighted @ basis.T, weighted @ self.off.T)).T @ basis)
        away = np.abs(self.cycles - self.cycles[k])
        beside = (away > _MIN_PERIODS) & (away < SURE + self.cycles[k])
        beside[: self.first] = False
        of_noise = 0.5 * chdtri(4.0, 0.5)  # median of half a chi-square
        return max(float(np.median(gain[beside]) / of_noise), 1.0) if beside.any() else 1.0


def _minus_log_p(gain: float) -> float:
    """Return minus the log of the probability that noise reaches a gain at one frequency."""
    return float(gain - np.log1p(gain))


def parabola_vertex(gain: Array, k: int) -> float:
    """Return the offset from k of the vertex of the parabola through values k - 1 to k + 1 of `gain` (n,), in steps.

    Half a step at most; 0 at the ends, and where the values have no peak there.
    """
    if not 0 < k < len(gain) - 1:
        return 0.0
    bend = gain[k - 1] - 2.0 * gain[k] + gain[k + 1]
    return float(np.clip(0.5 * (gain[k - 1] - gain[k + 1]) / bend, -0.5, 0.5)) if bend < 0 else 0.0
