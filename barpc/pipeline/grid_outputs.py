"""Cameras that one RPC does not hold: grids, reopened like every output."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.atomic import write_text
from barpc.base.errors import BarpcError, FitError, OutputError, RpcError
from barpc.base.options import RunOptions
from barpc.base.tasks import Progress, ordered
from barpc.fit import RpcFit
from barpc.fit.points import widened
from barpc.fit.refit import fit_only
from barpc.pipeline.executor import CachingExecutor
from barpc.pipeline.proof import REOPENED
from barpc.pipeline.verify_outputs import verify_grid
from barpc.rpcio.formats import CORRECTION, GRID_SUFFIX
from barpc.rpcio.grids import write_correction, write_grid
from barpc.scene import View
from barpc.sensor import Behind, SensorModel
from barpc.sensor.csm import STATE_END as STATE
from barpc.sensor.csm import is_writable, open_state, state_text
from barpc.sensor.direct_grid import LINEAR, DirectGrid
from barpc.sensor.image_corrections import CorrectionGrid, Displaced
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import Errors, Scattered
from barpc.workspace import Workspace

logger = logging.getLogger(__name__)

MISFIT = 0.02
"""A camera that its RPC misses by more [px] gets grids, too."""

Written = dict[str, dict[str, float | str]]
"""File -> consumer -> difference to P_BA [px], or why it does not read it."""
Misses = dict[str, Errors]  # file -> how far it is off the camera that it holds


@dataclass(frozen=True)
class GridFiles:
    """Files to be written of a view beside its RPC."""

    grids: bool
    state: bool = False

    def names(self, view: View) -> list[str]:
        """Return their names."""
        return [view.name + end for end in [STATE] * self.state + [GRID_SUFFIX, CORRECTION] * self.grids]


def grid_names(view: View) -> list[str]:
    """Return the files that `write_grids` may write for a view, before the misfit of its RPC is known."""
    return GridFiles(grids=True, state=is_writable(view.sensor)).names(view)


def write_grids(
    run: Workspace,
    fitted: Sequence[tuple[View, RpcFit, SensorModel]],
    options: RunOptions,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> list[Written]:
    """Write requested grids, and those for RPC misfits above `MISFIT`; reopen every file.

    OutputError where a file cannot be written, or reads back differently.
    """
    files = []
    for _, fit, model in fitted:
        grids = options.grids or not np.linalg.norm(fit.max_ckp) <= MISFIT
        files.append(GridFiles(grids, is_writable(model)))
    written: list[Written] = [{} for _ in fitted]
    some = [i for i, one in enumerate(files) if one.names(fitted[i][0])]
    if some:
        with run.stage("grids"):
            tasks = [(fitted[i][0], fitted[i][1].rpc, fitted[i][2], files[i]) for i in some]
            for i, found in zip(some, _write_grids(run, tasks, executor, progress), strict=True):
                written[i] |= found
    return written


GridTask = tuple[View, RPC, SensorModel, GridFiles]


def made_in_room(
    run: Workspace,
    executor: Executor,
    make: Callable[..., Any],
    tasks: Sequence[Any],
    what: str,
    progress: Progress | None,
) -> list[Any]:
    """Write files of views by workers into a temporary subfolder of the run folder, then move them to the run folder.

    `make` takes a task, which begins with its view, and the subfolder; it returns the names of the files, which it puts
    there into a folder named after the view.
    """
    room = run.partial / what
    try:
        made = ordered(executor, make, [(*task, str(room)) for task in tasks], what, progress)
        for (view, *_), names in zip(tasks, made, strict=True):
            for name in names:
                with run.output(name) as partial:
                    (room / view.name / name).replace(partial)
    finally:
        shutil.rmtree(room, ignore_errors=True)
    return made


def _write_grids(
    run: Workspace, tasks: Sequence[GridTask], executor: Executor | None, progress: Progress | None
) -> list[Written]:
    """Write grids and verify the reopened files; return the differences by file and consumer."""
    with CachingExecutor(run, {}, executor, keep=False) as fresh:
        made = made_in_room(run, fresh, make_grids, tasks, "grids", progress)
        pairs, folder = zip(tasks, made, strict=True), str(run.folder)
        again = [(view, model, errors, folder) for (view, _, model, _), errors in pairs]
        written = ordered(fresh, verify_grids, again, "verify grids", progress)
    for errors, seen in zip(made, written, strict=True):
        for name, off in errors.items():
            read = seen[name]["barpc"]
            worst = max(off.far, read) if isinstance(read, float) else off.far
            if not worst <= MISFIT:
                why = "it has no refraction" if name.endswith(STATE) else "at steps?"
                logger.warning("%s: errors of %.3g px RMS, up to %.3g px (%s)", name, off.rms, worst, why)
    return written


def make_grids(view: View, rpc: RPC, model: SensorModel, files: GridFiles, room: str) -> Misses:
    """Write the grids of a view into a temporary folder; return the errors of each [px]."""
    place, alts = Path(room) / view.name, widened(view.alt_range)
    place.mkdir(parents=True, exist_ok=True)
    sample, errors = Scattered.over(model, view.size, alts), Misses()
    try:
        if files.state:
            text = state_text(model, view.size, alts)
            write_text(place / (view.name + STATE), text, overwrite=True)
            errors[view.name + STATE] = sample.compare(open_state(place / (view.name + STATE))[0].project)
        if files.grids:
            grid = DirectGrid.of(model, view.size, alts)
            errors[view.name + GRID_SUFFIX] = sample.compare(grid.project)
            write_grid(grid, place / (view.name + GRID_SUFFIX), overwrite=True)
            rpc, lacking, errors[view.name + CORRECTION] = grid_correction(rpc, sample)
            write_correction(lacking, rpc, place / (view.name + CORRECTION), overwrite=True)
    except (RpcError, FitError) as failure:
        raise OutputError(f"{view.name}: no grid can be made of its camera: {failure}") from failure
    return errors


def grid_correction(rpc: RPC, sample: Scattered) -> tuple[RPC, CorrectionGrid, Errors]:
    """Return an RPC and its correction grid, and the errors of both together against the camera of a sample.

    The correction of `rpc` may depend on the altitude, where its denominators absorb errors along the rows. Then that
    of the camera without its displacements in the image and their grid are better together: the better is returned.
    """
    model, size, alts = sample.model, sample.size, sample.alt_range
    found: list[tuple[Errors, RPC, CorrectionGrid]] = []
    failed: BarpcError | None = None
    for given in (rpc, None):
        try:
            one = given or fit_only(_undisplaced(model), size, alts)
            lacking = CorrectionGrid.between(one, model, size, float(np.mean(alts)))
        except (RpcError, FitError) as error:
            failed = error
            continue
        found.append((sample.compare(Displaced(one, lacking).project), one, lacking))
        if found[-1][0].far <= LINEAR:
            break
    if not found:
        assert failed is not None
        raise failed
    # the largest error is at a step, if there is one
    errors, best, lacking = min(found, key=lambda row: row[0].rms)
    return replace(best, err_bias=rpc.err_bias, err_rand=rpc.err_rand), lacking, errors


def _undisplaced(model: Any) -> Any:
    """Return a camera without the displacements of its image points, whatever stands in front of them."""
    if not isinstance(model, Behind):
        return model
    plain = _undisplaced(model.sensor)
    return plain if isinstance(model, Displaced) else replace(model, sensor=plain)


def verify_grids(view: View, model: SensorModel, errors: Misses, folder: str) -> Written:
    """Open the files of a view as their consumers do; OutputError where barpc or GDAL reads other errors than theirs.

    Errors at the same points are compared: a narrow step between them may be found or missed.
    """
    every, written = Scattered.over(model, view.size, widened(view.alt_range)), Written()
    for name, off in errors.items():
        path = Path(folder) / name
        readings = verify_grid(path, every.also(off.worst))  # the same points as when it was written
        for reading in readings:
            same = reading.rms == off.rms or abs(reading.rms - off.rms) <= REOPENED  # infinite: rows are lost there
            if reading.consumer in ("barpc", "gdal") and not same:
                raise OutputError(
                    f"{path}: {reading.consumer} reads it with errors of {reading.rms:.3g} px RMS, not {off.rms:.3g}"
                    f"{f' ({reading.note})' if reading.note else ''}; is the disk full, or another RPC file beside it?"
                )
        written[name] = {one.consumer: one.note or one.max_error for one in readings}
    return written
