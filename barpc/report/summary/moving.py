"""Where tie points move together: on which part of the ground, and what share of those there."""

from __future__ import annotations

import numpy as np

from barpc.geodesy import ground_from_ecef, wrap_longitude
from barpc.report.records import Record, said
from barpc.report.run import Run
from barpc.report.summary.words import Count, Share

_CELLS = 12  # of the ground, each way: of 3,000 tie points twenty lie in each


class MovingEntry(Record):
    """A cell of the ground in which tie points move together."""

    box: tuple[float, ...] = said("Its ends: west, south, east, north", "deg", minItems=4, maxItems=4)
    count: Count = said("Tie points in it, those that move among them")
    share: Share = said("Part of them that moves")


def moving_cells(run: Run) -> tuple[MovingEntry, ...]:
    """Cells of the ground of which tie points move, from south to north and west to east; all groups together."""
    found = run.adjustment
    if found is None or not found.moving.any():
        return ()
    moves, stays = np.zeros((2, run.tracks.num_points), dtype=bool)
    moves[run.tracks.point[found.moving]] = stays[run.tracks.point[found.inlier]] = True
    known = np.isfinite(found.points[:, 0])
    every = np.flatnonzero((moves | stays) & known)
    lonlat = ground_from_ecef(found.points[every])[:, :2]
    lonlat[:, 0] = wrap_longitude(lonlat[:, 0], lonlat[0, 0])
    of_ground = np.flatnonzero(stays[every]) if (stays & known).any() else np.arange(len(every))
    low, high = lonlat[of_ground].min(axis=0), lonlat[of_ground].max(axis=0)
    step = np.maximum(high - low, 1e-9) / _CELLS
    # what flies is seen beside the ground that it is over, beyond its ends at times
    col, row = np.clip((lonlat - low) / step, 0, _CELLS - 1).astype(np.int64).T
    cell, gone = row * _CELLS + col, moves[every]
    count = np.bincount(cell, minlength=_CELLS**2)
    share = np.bincount(cell, gone, _CELLS**2) / np.maximum(count, 1)
    entries = []
    for k in np.flatnonzero(share):
        corner = low + step * [k % _CELLS, k // _CELLS]
        west, east = (float(wrap_longitude(lon)) for lon in (corner[0], corner[0] + step[0]))
        box = west, float(corner[1]), east, float(corner[1] + step[1])
        entries.append(MovingEntry(box, int(count[k]), float(share[k])))
    return tuple(entries)
