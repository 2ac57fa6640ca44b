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
_MIN_PERIODS = 1.5  # least number of periods in an image; also the half width of a peak of the spectrum
_FREQUENCY_OVERSAMPLING = 4  # number of tested frequencies in a step of one cycle per image
_BIN = _SHORTEST / _FREQUENCY_OVERSAMPLING  # rows in a bin: their mean has 90 % of the shortest period's amplitude


@dataclass(frozen=True)
class Period:
    """A significant sinusoidal displacement of the rows of a view."""

    view: int
    period: float  # [px]
    gain: float  # minus the log of the p-value of the period, less `price_of_period` [nats]


def price_of_period(rows: float, views: int) -> float:
    """Return the log of the number of independent tests of periods in all views, of `rows` rows each [nats]."""
    # about as many as frequencies are tested, at the significance levels used (Baluev 2008)
    return float(np.log(max(_FREQUENCY_OVERSAMPLING * rows / _SHORTEST, 1.0) * views))


def find_periods(
    view: IntArray, row: Array, size: Array, right: Array, off: Array, least: float = SURE
) -> list[Period]:
    """Find the most significant period of each view, if its gain exceeds `least` [nats]; largest gain first.

    Parameters
    ----------
    view, row : (K,), view and row [px] of observations, in images of `size` (2, N) [px]
    right : (K,), weights: probabilities of being an inlier
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
            best = _Periodogram(row[own], rows, right[own], clipped).largest(price + least)
            if best is not None:
                found.append(Period(v, best[0], best[1] - price))
    return sorted(found, key=lambda one: -one.gain)


class _Periodogram:
    """Periodogram of the residuals of one image, summed over `_BIN` rows, by frequency [cycles per image]."""

    def __init__(self, row: Array, rows: float, right: Array, off: Array) -> None:
        self.row, self.off, self.right = row, off, right
        self.bins = int(np.ceil(rows / _BIN))
        self.cycles = np.arange(int(_FREQUENCY_OVERSAMPLING * rows / _SHORTEST)) / _FREQUENCY_OVERSAMPLING
        self.first = int(np.ceil(_FREQUENCY_OVERSAMPLING * _MIN_PERIODS))

    def largest(self, least: float) -> tuple[float, float] | None:
        """Return the most significant period [px] and minus the log of its p-value; None if that is `least` or less."""
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
        """Return half the chi-square that a cosine and a sine explain in both coordinates, at each tested frequency."""
        right, last = self.right, len(self.cycles)
        centred = (off - (off @ right / right.sum())[:, None]) * right
        spread = centred @ centred.T / right.sum()  # covariance: ground points absorb mostly one direction
        spread[np.diag_indices(2)] += 1e-9 * np.trace(spread) + 1e-30
        whitened = np.linalg.cholesky(np.linalg.inv(spread)).T @ centred  # of unit covariance
        at = (self.row / _BIN).astype(np.int64).clip(0, self.bins - 1)
        sums = np.array([np.bincount(at, weight, self.bins) for weight in whitened])
        found = np.fft.rfft(sums, _FREQUENCY_OVERSAMPLING * self.bins, axis=1)[:, :last]
        real, imag = found.real.copy(), found.imag.copy()
        # transform of the weights at twice the frequency, by the squares of cosine and sine
        count = np.fft.rfft(np.bincount(at, right, self.bins), _FREQUENCY_OVERSAMPLING // 2 * self.bins)[:last]
        half, twice, both = 0.5 * right.sum(), 0.5 * count.real, 0.5 * count.imag
        determinant = np.maximum(half**2 - twice**2 - both**2, 1e-12 * half**2)
        gain = (half - twice) * (real * real).sum(axis=0) + (half + twice) * (imag * imag).sum(axis=0)
        return np.asarray((0.5 * gain - both * (real * imag).sum(axis=0)) / determinant)

    def _level(self, k: int, period: float) -> float:
        """Return the level of the spectrum near peak k, with its `period` removed, over that of noise; at least 1."""
        basis = np.vstack([np.ones(len(self.row)), sine_and_cosine(self.row, np.array(period))])
        weighted = basis * self.right
        gain = self._spectrum(self.off - (np.linalg.solve(weighted @ basis.T, weighted @ self.off.T)).T @ basis)
        away = np.abs(self.cycles - self.cycles[k])
        beside = (away > _MIN_PERIODS) & (away < SURE + self.cycles[k])
        beside[: self.first] = False
        of_noise = 0.5 * chdtri(4.0, 0.5)  # median of half a chi-square
        return max(float(np.median(gain[beside]) / of_noise), 1.0) if beside.any() else 1.0


def _minus_log_p(gain: float) -> float:
    """Return minus the log of the probability that the spectrum of noise exceeds `gain` at one frequency."""
    return float(gain - np.log1p(gain))


def parabola_vertex(gain: Array, k: int) -> float:
    """Return the position, relative to k, of the maximum of the parabola through elements k - 1 to k + 1 of `gain`.

    It is between -0.5 and 0.5; 0 at the ends of `gain` (n,) and where the parabola has no maximum.
    """
    if not 0 < k < len(gain) - 1:
        return 0.0
    bend = gain[k - 1] - 2.0 * gain[k] + gain[k + 1]
    return float(np.clip(0.5 * (gain[k - 1] - gain[k + 1]) / bend, -0.5, 0.5)) if bend < 0 else 0.0
