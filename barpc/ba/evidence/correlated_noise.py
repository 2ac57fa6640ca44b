"""Correlated errors of neighbouring tie points: a rival of all explanations by cameras, ground and matches.

Templates overlap, suns, shadows and seasons pull many matches the same way. The noise of ties of one cell of an image
is then alike. A correction that follows it as a step, a sinusoid or a cloud is bent by it, so whatever explains ties
has to gain more than noise of which a part is common to a cell.
"""

from __future__ import annotations

import numpy as np

from barpc.base.geodesy import Array
from barpc.base.statistics import FEW
from barpc.scene import IntArray

_SIDES = 2 ** np.arange(2, 6)  # cells along each side of an image
_CORRELATED_SHARES = np.linspace(0.0, 1.0, 21)[1:-1]  # part of the noise's variance that a cell shares


def shared_errors(view: IntArray, place: Array, size: Array, off: Array) -> Array:
    """Return by how much noise that cells share is likelier than noise of each tie by itself (N,) [nats].

    Parameters
    ----------
    view, place, off : (k,), (2, k), (2, k)
        Views of tie points, their places [px] and residuals there, in any unit; without wrong ones.
    size : (2, N), of the images [px]

    Returns
    -------
    Of the best grid of cells and the best part that is shared, the choice of them paid for; 0 at least. Both
    coordinates count as if each was seen by itself. Compound symmetry: (1 - a) I + a 11' of the ties of a cell.
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
        all_of = np.bincount(cell, (values**2).sum(axis=0), len(n))
        for j, alike in enumerate(_CORRELATED_SHARES.tolist()):
            more = 1.0 + (n - 1.0) * alike  # variance of a cell's sum, over that of as many by themselves
            rooms = (n - 1.0) * np.log(1.0 - alike) + np.log(more)
            squares = (all_of - between) / (1.0 - alike) + between / more - all_of
            found[k, j] = -np.where(n > 0, rooms + 0.5 * squares, 0.0).reshape(num, -1).sum(axis=1)
    gain = found.max(axis=(0, 1)) - np.log(found[:, :, 0].size)
    return np.where(count >= FEW, np.maximum(gain, 0.0), 0.0)
