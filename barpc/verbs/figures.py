"""A second reading: the figures that a run printed, measured again by readers that share nothing with barpc's own.

Ground points of the tables are projected into the cameras that lie on disk, as GDAL and other tools read them; the RMS
of their distances from the tie points in use is compared with that of each image in summary.json.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from barpc.base.errors import BarpcError, InputError, out_of_memory
from barpc.base.geodesy import Array
from barpc.export.shots import Shot, read_scene
from barpc.pipeline.proof import CHANGED, NOT_ASKED, SAME, Proved
from barpc.pipeline.verify_outputs import CONSUMERS, projection_by
from barpc.rpcio import format_for

FIGURE_TOLERANCE = 0.005  # px: a hundredth of the largest RMS of a good image; tables hold positions to 0.001 px


def reread_figures(folder: Path) -> Iterator[Proved]:
    """Yield, for each camera file of a finished adjustment's images, whether other tools find the RMS that was printed.

    A run that added images has those of the run behind it, too, whose cameras it held.
    """
    try:
        scene = read_scene(folder, of_images=False)
        tables = scene.run.tables()
    except InputError as error:
        yield Proved("figure", folder.name, CHANGED, str(error))
        return
    seen, order = tables.observations, np.argsort(tables.tracks)
    rows = np.flatnonzero(seen.used & np.isin(seen.track, tables.tracks))
    ground = tables.points[order[np.searchsorted(tables.tracks[order], seen.track[rows])], :3]
    shots = {shot.name: shot for shot in scene.shots}
    for i, view in enumerate(scene.summary.views):
        of_view = seen.view[rows] == i
        yield from _reread(shots[view.name], view.rmse_after, ground[of_view], seen.xy[rows[of_view]])


def _reread(shot: Shot, printed: float | None, ground: Array, xy: Array) -> Iterator[Proved]:
    """Yield the result for each file with the camera of an image that shows ground points (n, 3) at (n, 2) [px]."""
    for name in shot.written:
        if (row := format_for(name)) is None:  # a grid
            continue
        tools = [tool for tool in row.consumers if CONSUMERS[tool].installed]
        if printed is None or not len(xy) or not tools:
            why = "no other tool that reads it is installed" if len(xy) else "no tie points in use"
            yield Proved("figure", name, NOT_ASKED, why)
            continue
        found = {tool.partition(",")[0]: _rms(shot, name, tool, ground, xy) for tool in tools}
        worst = max(found, key=lambda tool: np.nan_to_num(abs(found[tool] - printed), nan=np.inf))
        now = SAME if abs(found[worst] - printed) <= FIGURE_TOLERANCE else CHANGED
        yield Proved("figure", name, now, f"{printed:.3f} px printed, {found[worst]:.3f} px by {worst}")


def _rms(shot: Shot, name: str, tool: str, ground: Array, xy: Array) -> float:
    """Return the RMS [px] as a tool reads a file; NaN where it cannot."""
    try:
        off = projection_by(tool, shot.writer.folder / name)(ground) - xy
    except Exception as failure:  # whatever a reader raises is its finding
        if out_of_memory(failure):
            raise MemoryError from failure
        if isinstance(failure, BarpcError | OSError | ValueError | LookupError | ArithmeticError):
            return float("nan")
        raise
    return float(np.sqrt((off**2).sum(axis=1).mean()))
