"""Evidence for matching noise that neighbouring tie points share: the rival of every other explanation of residuals.

Templates overlap, and shadows or seasons displace neighbouring matches the same way. A step, a sinusoid or a moving
group may fit such noise. Therefore a term must gain more evidence than noise of which a part is common to all tie
points of a cell of the image.
"""

from __future__ import annotations

import numpy as np

from barpc.base.geodesy import Array
from barpc.base.statistics import FEW
from barpc.scene import IntArray

_SIDES = 2 ** np.arange(2, 6)  # grids to try: cells along each side of an image
_CORRELATED_SHARES = np.linspace(0.0, 1.0, 21)[1:-1]  # to try: part of the noise variance that is common to a cell


def shared_errors(view: IntArray, place: Array, size: Array, off: Array) -> Array:
    """Return the log-likelihood ratio (N,) [nats] of noise that cells share over independent noise, for each image.

    Parameters
    ----------
    view, place, off : (k,), (2, k), (2, k)
        Inliers: their images, image coordinates [px], and residuals in any unit.
    size : (2, N), of the images [px]

    Returns
    -------
    The ratio of the best grid and shared part, less the logarithm of the number of both; at least 0. The two
    coordinates are independent. Covariance of a cell (compound symmetry): (1 - a) I + a 11', a the shared part.
    """
    num = size.shape[1]
    count = np.bincount(view, minlength=num)
    scale = np.sqrt(np.bincount(view, (off**2).mean(axis=0), num) / np.maximum(count, 1))
    values = off / np.maximum(scale, np.finfo(np.float64).tiny)[view]
    found = np.zeros((len(_SIDES), len(_CORRELATED_SHARES), num))
    for k, side in enumerate(_SIDES.tolist()):
        col, row = (place / size[:, view] * side).astype(np.int64).clip(0, side - 1)
        cell = (view * side + row) * side + col
        n = np.bincount(cell, minlength=num * side**2).astype(np.float64)
        between = sum(np.bincount(cell, one, len(n)) ** 2 for one in values) / np.maximum(n, 1.0)
        total = np.bincount(cell, (values**2).sum(axis=0), len(n))
        for j, fraction in enumerate(_CORRELATED_SHARES.tolist()):
            inflation = 1.0 + (n - 1.0) * fraction  # variance of the sum of a cell over that of independent noise
            log_det = (n - 1.0) * np.log(1.0 - fraction) + np.log(inflation)
            squares = (total - between) / (1.0 - fraction) + between / inflation - total
            found[k, j] = -np.where(n > 0, log_det + 0.5 * squares, 0.0).reshape(num, -1).sum(axis=1)
    gain = found.max(axis=(0, 1)) - np.log(found[:, :, 0].size)
    return np.where(count >= FEW, np.maximum(gain, 0.0), 0.0)
