"""Why an RPC misses a camera: what its errors go by.

The errors of an RPC, less what a small change of its coefficients takes away, are asked whether they are a function of
the row, the column or the altitude. If they are, those of neighbours in that order are alike: half the mean square of
their differences is what the function leaves (Yatchew, "An elementary estimator of the partial linear model", 1997). No
shape is assumed, so that swings, bursts and steps count alike.
"""

from __future__ import annotations

import numpy as np

from barpc.base.geodesy import Array
from barpc.fit.certificate import Reason, Sample
from barpc.sensor.rational import monomials
from barpc.sensor.rpc import RPC

_POWERS = np.arange(1, 8)  # of altitudes
_CELLS = 4  # along each side: where all errors are in one of them, they are in one place
_MOST = 0.5  # of the squares: a cause of more is named


def reason(rpc: RPC, sample: Sample) -> Reason | None:
    """Return what most of an RPC's errors at the points of a sample depend on; None where they are not finite."""
    ground, points = sample.ground[: sample.count], sample.points[: sample.count]
    error = rpc.project(ground) - points[:, :2]
    if not (np.isfinite(error).all() and error.any()):
        return None
    bases = [np.linalg.qr(_tangent(rpc, ground, axis))[0] for axis in range(2)]
    left = np.column_stack([e - q @ (q.T @ e) for e, q in zip(error.T, bases, strict=True)])
    total, rest = float((error**2).sum()), float((left**2).sum())
    share = {"pole": 1.0 - rest / total}
    for axis, name in enumerate(("column", "row", "altitude")):
        share[name] = _along(left, bases, points[:, axis]) * rest / total
    share["altitude"] = max(share["altitude"], _layered(left, bases, points, sample) * rest / total)
    where = np.minimum((points[:, :2] + 0.5) / sample.size * _CELLS, _CELLS - 1).astype(np.int64)
    squares = np.bincount(where @ [1, _CELLS], (error**2).sum(axis=1), minlength=_CELLS**2)
    share["place"] = float(squares.max()) / total
    cause, most = max(share.items(), key=lambda item: item[1])
    size = float(np.sqrt(most * total / len(error)))
    if most <= _MOST:
        return Reason("all", 1.0 - most, float(np.sqrt((1.0 - most) * total / len(error))))
    if cause == "place":
        col, row = points[(error**2).sum(axis=1).argmax(), :2].tolist()
        cell = np.array(divmod(int(squares.argmax()), _CELLS))
        return Reason("corner" if np.isin(cell, (0, _CELLS - 1)).all() else cause, most, size, col, row)
    return Reason(cause, most, size)


def _tangent(rpc: RPC, ground: Array, axis: int) -> Array:
    """Return the directions (N, 39) of points under small changes of the coefficients of col (`axis` 0) or row (1)."""
    basis = monomials(rpc.normalize(ground)).T
    above, below = basis @ rpc.coeffs[2 * axis], basis @ rpc.coeffs[2 * axis + 1]
    rows = np.hstack([basis, -(above / below)[:, None] * basis[:, 1:]]) / below[:, None]
    return np.asarray(rows / np.linalg.norm(rows, axis=0))


def _along(left: Array, bases: list[Array], place: Array) -> float:
    """Return the share of errors (N, 2) that is a function of `place` (N,)."""
    order, rest = np.argsort(place, kind="stable"), 0.0
    for error, basis in zip(left[order].T, bases, strict=True):
        change, turn = np.diff(error), np.diff(basis[order], axis=0)
        found = np.linalg.lstsq(turn, change, rcond=None)[0]
        rest += 0.5 * float(((change - turn @ found) ** 2).mean()) * len(change) / (len(change) - len(found))
    return 1.0 - rest / float((left**2).sum() / len(left))


def _layered(left: Array, bases: list[Array], points: Array, sample: Sample) -> float:
    """Return the share of errors (N, 2) that goes by the altitude, otherwise from place to place of the image."""
    away = (points[:, :2] - (np.array(sample.size) - 1) / 2) / (max(sample.size) / 2)
    low, high = sample.alt_range
    up = ((points[:, 2:] - 0.5 * (low + high)) / (0.5 * (high - low))) ** _POWERS
    layers, rest = np.hstack([up, up * away[:, :1], up * away[:, 1:]]), 0.0
    for error, basis in zip(left.T, bases, strict=True):
        shape = layers - basis @ (basis.T @ layers)
        rest += float(((error - shape @ np.linalg.lstsq(shape, error, rcond=1e-10)[0]) ** 2).sum())
    return 1.0 - rest / float((left**2).sum())
