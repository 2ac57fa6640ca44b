"""Whether a finished run is still what it was: its inputs, its outputs, and what its files say of the cameras."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barpc.cameras import open_camera
from barpc.errors import BarpcError, InputError
from barpc.identity import take
from barpc.pipeline.beyond import REOPENED, RESAMPLED
from barpc.remote import is_url
from barpc.report import Summary
from barpc.report.summary.views import ViewEntry
from barpc.report.tables import read_summary
from barpc.rpcio import row_of
from barpc.rpcio.grids import CORRECTION, GRID

SAME, MOVED, CHANGED, MISSING, UNKNOWN = "same", "moved", "changed", "missing", "not asked"
GOOD = (SAME, MOVED)


@dataclass(frozen=True)
class Proved:
    """What became of a file: its `kind` (input, output or camera), a word for its state, and details."""

    kind: str
    file: str
    now: str
    note: str = ""


def prove(folder: Path, places: Sequence[Path] = ()) -> list[Proved]:
    """Compare a run with what its summary says of it; inputs that are gone are looked for by name in `places`.

    InputError where the folder holds no finished run, or one of a release that hashed nothing.
    """
    summary = read_summary(folder)
    if summary.inputs is None or summary.outputs is None:
        raise InputError(f"{folder}: its summary holds no hashes: an older release wrote it; run the adjustment again")
    return [
        *_inputs(summary, (folder, folder.parent, *places)),
        *_outputs(summary, folder),
        *_cameras(summary, folder),
    ]


def _inputs(summary: Summary, places: Iterable[Path]) -> Iterator[Proved]:
    for one in summary.inputs or ():
        if is_url(one.path):
            yield Proved("input", one.path, UNKNOWN, "on another host")
            continue
        found = _digest(Path(one.path))
        if found == one.sha256:
            yield Proved("input", one.path, SAME)
            continue
        elsewhere = (place / Path(one.path).name for place in places)
        moved = next((str(path) for path in elsewhere if _digest(path) == one.sha256), None)
        if moved is not None:
            yield Proved("input", one.path, MOVED, f"it is {moved}")
        else:
            yield Proved("input", one.path, MISSING if found is None else CHANGED)


def _outputs(summary: Summary, folder: Path) -> Iterator[Proved]:
    for one in summary.outputs or ():
        found = _digest(folder / one.file)
        now = SAME if found == one.sha256 else MISSING if found is None else CHANGED
        yield Proved("output", one.file, now)


def _cameras(summary: Summary, folder: Path) -> Iterator[Proved]:
    for view in summary.views:
        for name, consumers in view.outputs.items():
            stated = consumers.get("barpc")
            if view.certified and isinstance(stated, float) and _holds_camera(folder / name):
                yield _camera(view, folder / name, name, stated)


def _holds_camera(path: Path) -> bool:
    """Return whether a file holds the camera of its whole image: a resampled image has its own."""
    if path.name.endswith(RESAMPLED):
        return False
    return path.name.endswith((GRID, CORRECTION)) or row_of(path) is not None


def _camera(view: ViewEntry, path: Path, name: str, stated: float) -> Proved:
    """Read the camera of a file as a reader finds it: another file beside it may go before."""
    points = np.array(view.certified)
    try:
        off = np.linalg.norm(open_camera(path).model.project(points[:, :3]) - points[:, 3:], axis=1)
    except (BarpcError, OSError) as error:
        return Proved("camera", name, MISSING if not path.exists() else CHANGED, str(error))
    if off.max() <= stated + REOPENED:
        return Proved("camera", name, SAME)
    far = f"reads {off.max():.3g} px off the certified camera, {stated:.1g} stated"
    return Proved("camera", name, CHANGED, far)


def _digest(path: Path) -> str | None:
    try:
        return take(path).sha256 if path.is_file() else None
    except OSError:
        return None
