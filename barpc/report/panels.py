"""Small maps of each image's residuals: are they random, and is a part of an image worse?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from barpc.geodesy import Array
from barpc.report.load import Observations
from barpc.report.svg import path, sheet, tag

Record = Mapping[str, Any]

_MOST = 60  # images on the page: those with the largest systematic part
_VECTORS = 6000
_CELLS = 8
_PANEL = 180.0
_REACH = 12.0  # units of a long residual


@dataclass(frozen=True, eq=False)
class Cells:
    """Residuals of one image by the cells of a grid.

    Parameters
    ----------
    rms : (n, n)
        Root mean square reprojection error by row and column of cells [px]; NaN for an empty cell.
    mean : (n, n, 2)
        Mean residual col, row [px].
    systematic : (n, n)
        Whether the mean is larger than chance allows: three times its standard error, in cells of ten or
        more observations.
    """

    rms: Array
    mean: Array
    systematic: Array

    @property
    def share(self) -> float:
        """Part of the filled cells that are systematic."""
        filled = np.isfinite(self.rms).sum()
        return float(self.systematic.sum() / filled) if filled else 0.0


def cells_of(xy: Array, residuals: Array, size: Sequence[int]) -> Cells:
    """Mean and spread of residuals (m, 2) [px] over a grid of cells on the image."""
    col, row = ((xy + 0.5) / np.array(size) * _CELLS).astype(np.int64).clip(0, _CELLS - 1).T
    cell, num = row * _CELLS + col, _CELLS**2
    count = np.bincount(cell, minlength=num)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.stack([np.bincount(cell, r, num) / count for r in residuals.T], axis=-1)
        square = np.bincount(cell, (residuals**2).sum(axis=1), num) / count
        spread = np.maximum(square - (mean**2).sum(axis=1), 0.0)
        systematic = ((mean**2).sum(axis=1) > 9 * spread / count) & (count >= 10)
    shape = (_CELLS, _CELLS)
    return Cells(np.sqrt(square).reshape(shape), mean.reshape(*shape, 2), systematic.reshape(shape))


@dataclass(frozen=True, eq=False)
class Panels:
    """The small maps of all images.

    Parameters
    ----------
    charts : list of (str, str)
        SVG texts and captions, of the `_MOST` images with the largest systematic part.
    shares : list of float
        Part of each image's cells that are systematic.
    key : str
        What the lengths stand for.
    """

    charts: list[tuple[str, str]]
    shares: list[float]
    key: str


def residual_panels(views: Sequence[Record], observations: Observations, when: str) -> Panels:
    """A small map of every image's residuals.

    Cells are darker where the error is larger; thin lines are single residuals; a bold arrow is the mean of
    a cell where it is larger than chance allows.

    Parameters
    ----------
    views : sequence of mapping
        Of the summary.
    observations : Observations
        Of the tables.
    when : {"before", "after"}
        Whose residuals.
    """
    residuals: Array = getattr(observations, when)
    use = observations.used & np.isfinite(residuals).all(axis=1)
    norm = np.hypot(*residuals[use].T)
    longest = (float(np.quantile(norm, 0.95)) if len(norm) else 0.0) or 1.0
    most = min(_VECTORS // min(max(len(views), 20), _MOST), 300)
    grids, shares = [], []
    for k, view in enumerate(views):
        rows = np.flatnonzero(use & (observations.view == k))
        grids.append((rows, cells_of(observations.xy[rows], residuals[rows], view["size"])))
        shares.append(grids[-1][1].share)
    charts = []
    for k in sorted(sorted(range(len(views)), key=lambda k: -shares[k])[:_MOST]):
        rows, cells = grids[k]
        rows = rows[:: max(1, -(-len(rows) // most))]
        svg = _panel(f"{when}{k}", views[k], cells, observations.xy[rows], residuals[rows], longest)
        charts.append((svg, f"{k + 1} {views[k]['name']}: {_note(cells)}"))
    key = (
        f"A thin line of a {_PANEL / _REACH:.0f}th of a panel's width is {longest:.2g} px;"
        " bold arrows are drawn twice as long."
    )
    if len(charts) < len(views):
        key += f" The {len(charts)} of {len(views)} images with the largest systematic part are shown."
    return Panels(charts, shares, key)


def _note(cells: Cells) -> str:
    if not np.isfinite(cells.rms).any():
        return "no tie points"
    return f"{100 * cells.share:.0f} % systematic"


def _panel(key: str, view: Record, cells: Cells, xy: Array, residuals: Array, longest: float) -> str:
    width, height = view["size"]
    tall = _PANEL * min(max(height / width, 0.4), 2.5)
    stretch = np.array([_PANEL / width, tall / height])
    parts = [tag("rect", x=0, y=0, width=_PANEL, height=tall, class_="empty")]
    side = np.array([_PANEL, tall]) / _CELLS
    for (i, j), rms in np.ndenumerate(cells.rms):
        if np.isfinite(rms):
            opacity = 0.06 + 0.5 * min(float(rms) / (2 * longest), 1.0)
            place = {"x": j * side[0], "y": i * side[1], "width": side[0], "height": side[1]}
            cell = tag("rect", **place, class_="heat", fill_opacity=opacity)
            parts.append(cell)
    start = (xy + 0.5) * stretch
    end = start + residuals * (_REACH / longest)
    shafts = "".join(
        f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}"
        for (x, y), (u, v) in zip(start.tolist(), end.tolist(), strict=True)
    )
    parts.append(tag("path", d=shafts or "M0 0", class_="vector"))
    for i, j in np.argwhere(cells.systematic):
        middle = side * (j + 0.5, i + 0.5)
        parts.append(_arrow(middle, cells.mean[i, j] * (2 * _REACH / longest)))
    described = f"{len(residuals)} residuals are drawn; {_note(cells)}."
    title = f"Residuals over {view['name']}"
    return sheet(f"panel-{key}", title, described, tall, parts, width=_PANEL, class_="panel")


def _arrow(middle: Array, vector: Array) -> str:
    """An arrow centred on a cell, not longer than reaches its neighbours' middles."""
    length = float(np.hypot(*vector))
    vector = vector * min(1.0, 24.0 / max(length, 1e-9))
    length = min(length, 24.0)
    tip, tail = middle + vector / 2, middle - vector / 2
    along = vector / max(length, 1e-9) * min(5.0, length / 2)
    across = np.array([-along[1], along[0]]) * 0.6
    barbs = [tip - along + across, tip, tip - along - across]
    return path(np.array([tail, tip]).tolist(), "mean") + path(np.array(barbs).tolist(), "mean")
