"""Comparison of two runs: their errors, cameras and options."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.errors import BarpcError, InputError
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis
from barpc.base.keywords import PathLike
from barpc.base.options import file_options
from barpc.base.remote import is_url
from barpc.report.finished import FinishedRun
from barpc.report.records import flat_options, json_form
from barpc.report.summary import Summary
from barpc.report.summary.views import COVERAGE_CELLS, ViewEntry
from barpc.report.summary.words import enu, median, metres
from barpc.rpcio import read_rpc
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import Sample, image_grid
from barpc.sensor.triangulation import triangulate

_MOTION_NODES = 3  # along each side of an image: places at which the motion of the ground is measured
_NO_EFFECT = ("overwrite", "keep_going")  # Options that do not change a finished run


def compare_runs(folder_a: PathLike, folder_b: PathLike) -> dict[str, Any]:
    """Compare the results of two runs of the same images, by their folders.

    Returns ``views`` in both: errors, and ``rpc_difference_px``, the largest distance between where the two runs' RPC
    files put the same ground points, as a whole and without each image's mean shift (null where one wrote none);
    ``moved_enu_m``, the median motion of the ground from A to B, east, north, up (null where no place is in two
    images); ``pairs`` in both; ``only_a``, ``only_b``: images of one run alone; ``options`` that differ; ``lines``:
    sentences.
    InputError where a folder holds no finished run, or they have no image in common.
    """
    opened = FinishedRun.open(folder_a), FinishedRun.open(folder_b)
    folders, runs = (opened[0].folder, opened[1].folder), (opened[0].summary, opened[1].summary)
    a, b = ({view.name: view for view in run.views} for run in runs)
    same = [name for name in a if name in b and not _other_file(a[name].path, b[name].path, runs)]
    if not same:
        why = "images of the same names are other files, so these runs have none in common"
        if not a.keys() & b.keys():
            first, second = (run.views[0].name for run in runs)
            why = f"the runs have no image in common ({first} and others there, {second} here)"
        raise InputError(f"{folder_a} and {folder_b}: {why}: nothing to compare")
    given = [flat_options(run.options or {}) for run in runs]
    placed = [
        _absolute_options(one, folder) for one, folder in zip(given, folders, strict=True)
    ]  # from folders of two depths
    comparison = {
        "a": str(folder_a),
        "b": str(folder_b),
        "views": [_view(opened, (a[name], b[name])) for name in same],
        "moved_enu_m": _scene_motion(opened, [(a[name], b[name]) for name in same], runs[0].altitude_m),
        "pairs": _compared_pairs(*runs),
        "only_a": [name for name in a if name not in same],
        "only_b": [name for name in b if name not in same],
        "options": [
            {"option": key, "values": [one.get(key) for one in placed]}
            for key in given[0] | given[1]
            if all(one.get(key) != other.get(key) for one, other in (given, placed)) and key not in _NO_EFFECT
        ],
        "versions": [run.barpc for run in runs],
    }
    found: dict[str, Any] = json_form({**comparison, "lines": _comparison_lines(comparison)})
    return found


def _absolute_options(options: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the options of a run with absolute paths."""

    def at(path: Any) -> Any:
        if isinstance(path, (list, tuple)):
            return [at(one) for one in path]
        return path if not isinstance(path, str) or is_url(path) else os.path.normpath(folder.absolute() / path)

    return {**options, **{name: at(options[name]) for name in file_options() if options.get(name)}}


def _other_file(path_a: str, path_b: str, runs: tuple[Summary, Summary]) -> bool:
    """Whether images of one name are different files, by their hashes."""
    content = [
        {one.path: one.sha256 for one in run.inputs or ()}.get(path)
        for path, run in zip((path_a, path_b), runs, strict=True)
    ]
    return None not in content and content[0] != content[1]


def _view(runs: tuple[FinishedRun, FinishedRun], views: tuple[ViewEntry, ViewEntry]) -> dict[str, Any]:
    whole, relative = _rpc_difference(runs, views)
    return {
        "name": views[0].name,
        "status": [view.status for view in views],
        "num_observations": [view.num_observations for view in views],
        "rmse": [view.rmse_before if view.rmse_after is None else view.rmse_after for view in views],
        "rpc_difference_px": whole,
        "rpc_difference_without_shift_px": relative,
    }


def _rpc_difference(runs: tuple[FinishedRun, FinishedRun], views: tuple[ViewEntry, ViewEntry]) -> list[float | None]:
    """Return the largest distance between both RPCs [px], and that without their mean shift; None: not known."""
    first, second = (written_rpc(run, view.outputs) for run, view in zip(runs, views, strict=True))
    if first is None or second is None:
        return [None, None]
    with np.errstate(all="ignore"):  # where the second has no value there is no difference
        (grid,) = Sample.grids([(first, views[0].size, views[0].alt_range_m)], (COVERAGE_CELLS, COVERAGE_CELLS))
        apart = second.project(grid.ground) - grid.image
    apart = apart[np.isfinite(apart).all(axis=1)]
    if not len(apart):
        return [None, None]
    return [float(np.hypot(*one.T).max()) for one in (apart, apart - apart.mean(axis=0))]


def _scene_motion(
    runs: tuple[FinishedRun, FinishedRun], views: Sequence[tuple[ViewEntry, ViewEntry]], altitude: float | None
) -> Array | None:
    """Return the median motion (3,) of the ground from the first run to the second, east, north, up [m].

    Ground points of a grid in each image are projected with the RPCs of the first run, and intersected with those of
    the second, where two images or more show them.
    """
    rpcs = [[written_rpc(run, view.outputs) for run, view in zip(runs, pair, strict=True)] for pair in views]
    both = [(pair[0].size, *found) for pair, found in zip(views, rpcs, strict=True) if None not in found]
    if len(both) < 2 or altitude is None:
        return None
    sizes, old, new = zip(*both, strict=True)
    with np.errstate(all="ignore"):
        flat = [image_grid(size, (altitude, altitude), (_MOTION_NODES, 1)) for size in sizes]
        ground = np.concatenate([rpc.localize(*grid) for rpc, grid in zip(old, flat, strict=True)])
        xy = np.stack([rpc.project(ground) for rpc in old])  # (N, P, 2)
        seen = np.asarray(((xy >= 0.0) & (xy <= np.array(sizes)[:, None] - 1.0)).all(axis=2))
    several = seen.sum(axis=0) > 1
    if not several.any():
        return None
    ground, (view, point) = ground[several], np.nonzero(seen[:, several])
    found = triangulate(new, view, point, xy[:, several][view, point], alt=altitude)
    basis = enu_basis(ground[found.ok])
    moved = np.einsum("pij,pj->pi", basis, found.points[found.ok] - ecef_from_ground(ground[found.ok]))
    return np.asarray(np.median(moved, axis=0)) if len(moved) else None


def written_rpc(run: FinishedRun, files: Iterable[str]) -> RPC | None:
    """Return the first RPC of files that a run wrote; InputError where it was changed since."""
    for name in files:
        if is_own(run.folder, name):
            path = run.sealed.file(name)
            with suppress(BarpcError, OSError):
                return read_rpc(path)
    return None


def is_own(folder: Path, name: str) -> bool:
    """Return whether a name is one of a file right in a folder."""
    try:
        return (folder / name).resolve().parent == folder.resolve()
    except (OSError, ValueError):  # a name that is too long, a zero byte
        return False


def _compared_pairs(run_a: Summary, run_b: Summary) -> list[dict[str, Any]]:
    of_b, rows = {(pair.a, pair.b): pair for pair in run_b.pairs}, []
    for both in ((pair, of_b.get((pair.a, pair.b))) for pair in run_a.pairs):
        if both[1] is not None:
            rms = [one.offset_rms[one.epipolar_after is not None] for one in both if one]
            matches = [one.num_matches for one in both if one]
            rows.append({"a": both[0].a, "b": both[0].b, "num_matches": matches, "epipolar_rms": rms})
    return rows


def _comparison_lines(comparison: Mapping[str, Any]) -> list[str]:
    views = comparison["views"]
    a, b = (median([view["rmse"][k] for view in views]) for k in (0, 1))
    lines = [f"{len(views)} images in both: their tie points have residuals of {a:.3f} px in A, {b:.3f} px in B."]
    moved = [view for view in views if view["rpc_difference_px"] is not None]
    if moved:
        most = max(moved, key=itemgetter("rpc_difference_px"))
        bend = max(view["rpc_difference_without_shift_px"] for view in moved)
        lines.append(
            f"Their RPCs differ by up to {most['rpc_difference_px']:.3g} px ({most['name']}), "
            f"by {bend:.3g} px once the mean shift of each image is taken away."
        )
    if comparison.get("moved_enu_m") is not None:
        motion = comparison["moved_enu_m"]
        lines.append(f"The scene moved by {enu(motion)}, {metres(float(np.linalg.norm(motion)))} in all, from A to B.")
    alone = {run: comparison[f"only_{run.lower()}"] for run in "AB"}
    lines += [f"In {run} alone: {', '.join(names)}." for run, names in alone.items() if names]
    options = comparison["options"]
    return lines + [f"Option {o['option']}: {o['values'][0]} in A, {o['values'][1]} in B." for o in options]
