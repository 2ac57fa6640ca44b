"""Why an RPC misses a camera: what its errors go by.

The errors of an RPC, less what a small change of its coefficients takes away, are asked whether they are a function of
the row, the column or the altitude. If they are, those of neighbours in that order are alike: half the mean square of
their differences is what the function leaves (Yatchew, "An elementary estimator of the partial linear model", 1997). No
shape is assumed, so that swings, bursts and steps count alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barpc.fit.certificate import Sample
from barpc.geodesy import Array
from barpc.sensor.rational import monomials
from barpc.sensor.rpc import RPC

_POWERS = np.arange(1, 8)  # of a lens, of the squared distance from the middle; of altitudes
_CELLS = 4  # along each side: where all errors are in one of them, they are in one place
_MOST = 0.5  # of the squares: a cause of more is named
_FEW, _MANY = 5, 20  # points of 2025 either side of a step: a four hundredth and a hundredth of the image
_WORDS = {
    "row": "go by the row (a swing of the attitude, bursts, a long pass): a grid of the camera follows it",
    "step": "are a step at column {col:.0f} (detectors): fit the columns on either side apart, or take a grid",
    "column": "go by the column (the shape of a detector, a scan): fit fewer columns, or take a grid",
    "altitude": "go by the altitude: fit a smaller altitude range",
    "radial": "go by the distance from the middle (a lens): take the distortion out of the image first, or take a grid",
    "place": "are in one place, about col {col:.0f}, row {row:.0f}: look at the camera there",
    "corner": "are in the corner at col {col:.0f}, row {row:.0f}: leave it out, or fit a smaller image",
    "pole": "are what the bound on denominators around the image costs: lower pole_margin, or fit a smaller image",
    "all": "are all over the image and its altitudes: not an RPC's shape, fit a smaller image",
}


@dataclass(frozen=True)
class Reason:
    """What most of an RPC's errors depend on: row, column, altitude, a place.

    Parameters
    ----------
    cause : str
        "row", "step" (at a column), "column", "altitude", "radial", "place", "corner", "pole" or "all".
    share : float
        Part of the squared errors that is due to it; of "all", what is left by the best of the others.
    size_px : float
        Root mean square of that part; of a step its height.
    col, row : float
        Position of a step or a place [px].
    """

    cause: str
    share: float
    size_px: float
    col: float = float("nan")
    row: float = float("nan")

    def __str__(self) -> str:
        size = f"{self.size_px:.3g} px" + (" high" if self.cause == "step" else " RMS")
        return f"{self.share:.0%} of its squares, {size}, {_WORDS[self.cause].format(col=self.col, row=self.row)}"


def reason(rpc: RPC, sample: Sample) -> Reason | None:
    """Return what most of the errors of an RPC at the points of a sample depend on; None where errors are not
    finite.
    """
    ground, points = sample.ground[: sample.count], sample.points[: sample.count]
    error = rpc.project(ground) - points[:, :2]
    if not (np.isfinite(error).all() and error.any()):
        return None
    bases = [np.linalg.qr(_tangent(rpc, ground, axis))[0] for axis in range(2)]
    left = np.column_stack([e - q @ (q.T @ e) for e, q in zip(error.T, bases, strict=True)])
    total, rest = float((error**2).sum()), float((left**2).sum())
    share = {"pole": 1.0 - rest / total}
    smooth = {}
    for axis, name in enumerate(("column", "row", "altitude")):
        part, smooth[name] = _along(left, bases, points[:, axis])
        share[name] = part * rest / total
    for name, shapes in _shapes(points, sample).items():
        share[name] = max(share.get(name, 0.0), _shaped(left, bases, shapes) * rest / total)
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
    if cause == "column":
        height, col = _step(smooth["column"], points[:, 0])
        if height:
            return Reason("step", most, height, col)
    return Reason(cause, most, size)


def _tangent(rpc: RPC, ground: Array, axis: int) -> Array:
    """Return the directions (N, 39) that small changes of the coefficients of col (`axis` 0) or row (1) move
    its points in.
    """
    basis = monomials(rpc.normalize(ground)).T
    above, below = basis @ rpc.coeffs[2 * axis], basis @ rpc.coeffs[2 * axis + 1]
    rows = np.hstack([basis, -(above / below)[:, None] * basis[:, 1:]]) / below[:, None]
    return np.asarray(rows / np.linalg.norm(rows, axis=0))


def _along(left: Array, bases: list[Array], place: Array) -> tuple[float, Array]:
    """Return the share of errors (N, 2) that is a function of `place` (N,), that function and the rest (N,
    2), in its order.
    """
    order, rest = np.argsort(place, kind="stable"), 0.0
    smooth = left[order].copy()
    for axis, basis in enumerate(bases):
        across = basis[order]
        change, turn = np.diff(smooth[:, axis]), np.diff(across, axis=0)
        found = np.linalg.lstsq(turn, change, rcond=None)[0]
        smooth[:, axis] -= across @ found
        rest += 0.5 * float(((change - turn @ found) ** 2).mean()) * len(change) / (len(change) - len(found))
    return 1.0 - rest / float((left**2).sum() / len(left)), smooth


def _shapes(points: Array, sample: Sample) -> dict[str, list[Array]]:
    """Return the shapes (N, k) of col and of row that a lens gives, and an altitude range that changes from
    place to place.
    """
    away = (points[:, :2] - (np.array(sample.size) - 1) / 2) / (max(sample.size) / 2)
    lens = (away**2).sum(axis=1)[:, None] ** _POWERS  # in either coordinate the same
    low, high = sample.alt_range
    up = ((points[:, 2:] - 0.5 * (low + high)) / (0.5 * (high - low))) ** _POWERS
    layers = np.hstack([up, up * away[:, :1], up * away[:, 1:]])
    nothing = np.zeros_like(layers)
    return {
        "radial": [away[:, :1] * lens, away[:, 1:] * lens],
        "altitude": [np.hstack([layers, nothing]), np.hstack([nothing, layers])],
    }


def _shaped(left: Array, bases: list[Array], shapes: list[Array]) -> float:
    """Return the share of errors (N, 2) that shapes of col and row give together."""
    rows = np.vstack([shape - basis @ (basis.T @ shape) for shape, basis in zip(shapes, bases, strict=True)])
    error = left.T.ravel()
    rest = error - rows @ np.linalg.lstsq(rows, error, rcond=1e-10)[0]
    return 1.0 - float(rest @ rest) / float(error @ error)


def _step(smooth: Array, cols: Array) -> tuple[float, float]:
    """Return the height [px] and column of the largest step of errors (N, 2) in the order of columns (N,); 0
    where there is none.

    A step is as high between means of few points as of many; what is smooth changes by less the nearer they are.
    """
    sums = np.cumsum(np.vstack([np.zeros((1, 2)), smooth]), axis=0)
    heights = []
    for n in (_FEW, _MANY):
        mean = (sums[n:] - sums[:-n]) / n
        change = np.linalg.norm(mean[n:] - mean[:-n], axis=1)  # at i: between points i .. i + n - 1 and the n after
        heights.append(np.pad(change, (n - 1, n)))  # at i: between points i and i + 1
    at = _MANY - 1 + int(heights[0][_MANY - 1 : len(heights[1]) - _MANY].argmax())  # as far as both reach
    if heights[0][at] < np.sqrt(_FEW / _MANY) * heights[1][at]:  # halfway between no step and nothing else
        return 0.0, float("nan")
    return float(heights[0][at]), float(np.sort(cols)[at : at + 2].mean())
