"""Two runs side by side: what changed in their errors, their cameras and their options."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from barpc.errors import BarpcError, InputError
from barpc.report.load import read_summary
from barpc.report.summary import plain
from barpc.rpcio import read_rpc
from barpc.sensor.rpc import RPC

Record = Mapping[str, Any]

_NODES = 7
_NO_EFFECT = ("overwrite", "keep_going")
"""Options that do not change a finished run."""


def compare_runs(folder_a: Path | str, folder_b: Path | str) -> dict[str, Any]:
    """What two runs of the same images found.

    Parameters
    ----------
    folder_a, folder_b : path
        Folders of finished runs.

    Returns
    -------
    comparison : dict
        ``views`` in both, by name: errors, and ``rpc_difference_px``, the largest distance between where the
        two runs' RPC files put the same ground points, as a whole and with each image's mean shift taken away
        (null where one wrote none); ``pairs`` in both; ``only_a``, ``only_b``: images of one run alone;
        ``options`` that differ; ``lines``: sentences.

    Raises
    ------
    InputError
        A folder holds no finished run, or they have no image in common.
    """
    folders = (Path(folder_a), Path(folder_b))
    runs = tuple(read_summary(folder) for folder in folders)
    by_name = tuple({view["name"]: view for view in run["views"]} for run in runs)
    common = [name for name in by_name[0] if name in by_name[1]]
    if not common:
        raise InputError(f"{folder_a} and {folder_b}: the runs have no image in common")
    views = [_view(name, folders, (by_name[0][name], by_name[1][name])) for name in common]
    comparison = {
        "a": str(folder_a),
        "b": str(folder_b),
        "views": views,
        "pairs": _pairs(*runs),
        "only_a": [name for name in by_name[0] if name not in by_name[1]],
        "only_b": [name for name in by_name[1] if name not in by_name[0]],
        "options": _options(*runs),
        "versions": [run["barpc"] for run in runs],
    }
    found: dict[str, Any] = plain({**comparison, "lines": _lines(comparison)})
    return found


def _view(name: str, folders: tuple[Path, Path], views: tuple[Record, Record]) -> dict[str, Any]:
    whole, relative = _rpc_difference(folders, views)
    return {
        "name": name,
        "status": [view["status"] for view in views],
        "num_observations": [view["num_observations"] for view in views],
        "rmse": [_rmse(view) for view in views],
        "rpc_difference_px": whole,
        "rpc_difference_without_shift_px": relative,
    }


def _rmse(view: Record) -> float | None:
    """RMS reprojection error at the end of a run [px]."""
    last: float | None = view["rmse_before"] if view["rmse_after"] is None else view["rmse_after"]
    return last


def _rpc_difference(
    folders: tuple[Path, Path], views: tuple[Record, Record]
) -> tuple[float | None, float | None]:
    rpcs = [_written_rpc(folder, view) for folder, view in zip(folders, views, strict=True)]
    first, second = rpcs
    if first is None or second is None:
        return None, None
    t = np.linspace(0.0, 1.0, _NODES)
    low, high = views[0]["alt_range_m"]
    share = np.stack(np.meshgrid(t, t, t, indexing="ij"), axis=-1).reshape(-1, 3)
    size = np.array(views[0]["size"], dtype=np.float64)
    with np.errstate(all="ignore"):  # where the second has no value there is no difference
        ground = first.localize(share[:, :2] * (size - 1), low + share[:, 2] * (high - low))
        difference = second.project(ground) - first.project(ground)
    difference = difference[np.isfinite(difference).all(axis=1)]
    if not len(difference):
        return None, None
    relative = difference - difference.mean(axis=0)
    return float(np.hypot(*difference.T).max()), float(np.hypot(*relative.T).max())


def _written_rpc(folder: Path, view: Record) -> RPC | None:
    """The RPC that a run wrote for a view, from the first of its files that can be read.

    Only what lies in the folder itself is opened, whatever the summary names.
    """
    for name in view["outputs"]:
        try:
            path = (folder / name).resolve()
            if path.parent == folder.resolve() and path.is_file():
                return read_rpc(path)
        except (BarpcError, OSError, ValueError):  # ValueError: a zero byte in the name
            continue
    return None


def _pairs(run_a: Record, run_b: Record) -> list[dict[str, Any]]:
    of_b = {(pair["a"], pair["b"]): pair for pair in run_b["pairs"]}
    return [
        {
            "a": pair["a"],
            "b": pair["b"],
            "num_matches": [pair["num_matches"], of_b[pair["a"], pair["b"]]["num_matches"]],
            "epipolar_rms": [_rms(pair), _rms(of_b[pair["a"], pair["b"]])],
        }
        for pair in run_a["pairs"]
        if (pair["a"], pair["b"]) in of_b
    ]


def _rms(pair: Record) -> float | None:
    offset = pair["epipolar_after"] or pair["epipolar_before"]
    return None if offset is None else offset["rms"]


def _options(run_a: Record, run_b: Record) -> list[dict[str, Any]]:
    a, b = (flat_options(run["options"] or {}) for run in (run_a, run_b))
    keys = [*a, *(key for key in b if key not in a)]
    changed = [key for key in keys if a.get(key) != b.get(key) and key not in _NO_EFFECT]
    return [{"option": key, "values": [a.get(key), b.get(key)]} for key in changed]


def flat_options(options: Record, before: str = "") -> dict[str, Any]:
    """Nested options as one level, names joined by dots.

    Examples
    --------
    >>> flat_options({"tie": {"band": 1}, "overwrite": False})
    {'tie.band': 1, 'overwrite': False}
    """
    flat: dict[str, Any] = {}
    for key, value in options.items():
        if isinstance(value, Mapping) and value:
            flat |= flat_options(value, f"{before}{key}.")
        else:
            flat[before + key] = value
    return flat


def _lines(comparison: Record) -> list[str]:
    views = comparison["views"]
    medians = [_median([view["rmse"][k] for view in views]) for k in (0, 1)]
    lines = [
        f"{len(views)} images in both: their tie points agree to {medians[0]:.3f} px in A, {medians[1]:.3f} px in B."
    ]
    moved = [view for view in views if view["rpc_difference_px"] is not None]
    if moved:
        most = max(moved, key=lambda view: view["rpc_difference_px"])
        bend = max(view["rpc_difference_without_shift_px"] for view in moved)
        lines.append(
            f"Their RPCs differ by up to {most['rpc_difference_px']:.3g} px ({most['name']}), "
            f"by {bend:.3g} px once the mean shift of each image is taken away."
        )
    for key, run in (("only_a", "A"), ("only_b", "B")):
        if comparison[key]:
            lines.append(f"In {run} alone: {', '.join(comparison[key])}.")
    options = comparison["options"]
    return lines + [f"Option {o['option']}: {o['values'][0]} in A, {o['values'][1]} in B." for o in options]


def _median(values: list[float | None]) -> float:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else float("nan")
