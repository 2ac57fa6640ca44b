"""Comparison of a finished run, or an export, with its checksums: its files, inputs and cameras."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np

from barpc.base import manifest
from barpc.base.atomic import STATE
from barpc.base.errors import BarpcError, InputError, listed
from barpc.base.identity import fingerprint
from barpc.base.manifest import LAST, SUMS, Layer
from barpc.base.remote import is_url
from barpc.base.sealed import Sealed
from barpc.cameras import open_camera
from barpc.report.runfiles import read_summary
from barpc.report.summary import Summary
from barpc.report.summary.views import ViewEntry
from barpc.rpcio import format_for, hidden_by
from barpc.sensor.sampler import Sample

if TYPE_CHECKING:
    from barpc.base.tasks import Progress

REOPENED = 1e-5  # px: what a reopened file may differ by from what was written (15-digit printing)
SAME, MOVED, LATER, NOT_ASKED = "same", "moved", "later", "not asked"
PASSED_STATES = (SAME, MOVED, LATER, NOT_ASKED)
CHANGED, MISSING, ADDED = "changed", "missing", "added"


@dataclass(frozen=True)
class Proved:
    """The state of a verified file: its `kind` (root, input, output or camera), a word for the state, and details."""

    kind: str
    file: str
    now: str
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the file counts as unchanged."""
        return self.now in PASSED_STATES


class Verification(tuple[Proved, ...]):
    """The state of every file of a folder, a `Proved` each; it is false where one of them has changed."""

    def __bool__(self) -> bool:
        return all(one.passed for one in self)

    def __repr__(self) -> str:
        wrong = [f"{one.file} {one.now}" for one in self if not one.passed]
        return f"Verification({len(self)} files, {listed(wrong, 3) or 'none has changed'})"


def prove(
    folder: Path, places: Sequence[Path] = (), expected: str | None = None, progress: Progress | None = None
) -> list[Proved]:
    """Compare a run, or an export, with its SHA256SUMS, and that with an `expected` root, of any of its layers.

    Inputs that are gone are looked for by name in `places`. InputError where SHA256SUMS is missing or damaged.
    """
    if not os.path.lexists(folder / SUMS):
        read_summary(folder)
    sealed = Sealed.open(folder)
    root, layers, noted, listed = sealed.root, sealed.layers, sealed.noted, sealed.listed
    roots = {root, *(layer.after for layer in layers[1:])}
    tell = progress or (lambda *_: None)
    found = [*_roots(root, noted.get(SUMS, root), layers, expected)]
    for number, one in enumerate(_outputs(folder, listed, noted, roots), start=1):
        tell("verify outputs", min(number, len(listed)), len(listed))  # more of them where files were added
        found.append(one)
    for path, image, _ in hidden_by(folder / name for name in listed if name not in layers[0].files):
        if image.name in layers[0].files:  # no command of barpc writes such a file
            found.append(Proved("output", path.name, ADDED, f"for some tools it goes before the RPC of {image.name}"))
    if LAST in listed:
        try:
            summary = read_summary(folder)
        except InputError as error:
            return [*found, Proved("input", LAST, MISSING, f"what it says of inputs: {error}")]
        for number, one in enumerate(_inputs(summary, sealed, places), start=1):
            tell("verify inputs", number, len(summary.inputs or ()))
            found.append(one)
        found += _verify_cameras(summary, folder)
    return found


def _roots(root: str, noted: str, layers: Sequence[Layer], expected: str | None) -> Iterator[Proved]:
    """Yield the state of SHA256SUMS against the expected root, now or before a later layer, and later files."""
    if noted != root != expected:
        yield Proved("root", SUMS, CHANGED, f"its root is {root}, and {noted} was noted")
    elif expected in (None, root):
        yield Proved("root", SUMS, SAME, f"{root}, layer {len(layers)} of {len(layers)}")
    if expected in (None, root):
        return
    number = next((k for k in range(1, len(layers)) if layers[k].after == expected), 0)
    if not number or manifest.root_of(layers[:number]) != expected:
        yield Proved("root", SUMS, CHANGED, f"its root is {root}, and none of its {len(layers)} layers has {expected}")
        return
    yield Proved("root", SUMS, SAME, f"{expected}, layer {number} of {len(layers)}")
    before = {name for layer in layers[:number] for name in layer.files}
    for name in sorted({name for layer in layers[number:] for name in layer.files}):
        yield Proved("root", name, LATER, "made again after that root" if name in before else "added after that root")


def _outputs(folder: Path, listed: Mapping[str, str], noted: Mapping[str, str], roots: Set[str]) -> Iterator[Proved]:
    """Compare every file with its `listed` hash; one that is `noted` otherwise is of a command that was ended.

    Of folders below with a SHA256SUMS, exports of a run with one of the `roots` are compared, too.
    """
    for name, sha in sorted(listed.items()):
        found = _file_digest(folder / name)
        now = SAME if found == sha else MISSING if found is None else CHANGED
        yield Proved("output", name, now, _ENDED if found == noted.get(name) and now == CHANGED else "")
    parents = {parent.as_posix() for name in listed for parent in PurePosixPath(name).parents}
    for name, below in _folder_files(folder, parents):
        if below is None and name not in listed and name != SUMS:
            yield Proved("output", name, ADDED, _ENDED if name in noted else "by nobody who noted it")
        elif below is not None and manifest.read(below)[1][0].after in roots:  # an export of this run
            yield from (replace(one, file=f"{name}/{one.file}") for one in prove(below))
        elif below is not None:
            yield Proved("output", name, NOT_ASKED, f"not of this run: barpc verify {below}")


_ENDED = "by a command that did not come to its end: give it again"


def _folder_files(folder: Path, parents: Set[str]) -> Iterator[tuple[str, Path | None]]:
    """Yield every file and link in a folder by name, but its state; of a folder below with a SHA256SUMS only that."""

    def refuse(error: OSError) -> None:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror})")

    for top, folders, files in os.walk(folder, onerror=refuse):
        at, no_folders, kept = Path(top).relative_to(folder), set(files), []
        for name in sorted([*folders, *files]):
            path, known = folder / at / name, (at / name).as_posix()
            if name in no_folders or path.is_symlink():
                yield known, None
            elif (path / SUMS).is_file() and known not in parents:
                yield known, path
            elif known != STATE:
                kept.append(name)
        folders[:] = kept


def _inputs(summary: Summary, sealed: Sealed, places: Sequence[Path]) -> Iterator[Proved]:
    for one in summary.inputs or ():
        if is_url(one.path):
            yield Proved("input", one.path, NOT_ASKED, "on another host")
            continue
        found = sealed.find(one.path, one.sha256, one.bytes, places, whole=True)
        if found is None:
            yield Proved("input", one.path, CHANGED if os.path.lexists(sealed.located(one.path)) else MISSING)
        elif found in sealed.seen(one.path):
            yield Proved("input", one.path, SAME)
        else:
            yield Proved("input", one.path, MOVED, f"it is {found}")


def _verify_cameras(summary: Summary, folder: Path) -> Iterator[Proved]:
    for view in summary.views:
        for name, consumers in view.outputs.items():
            stated = consumers.get("barpc")
            if view.certified and isinstance(stated, float) and format_for(name) is not None:
                yield _camera(view, folder / name, name, stated)


def _camera(view: ViewEntry, path: Path, name: str, stated: float) -> Proved:
    """Read the camera of a file as a reader finds it: another file beside it may go before."""
    points = np.array(view.certified)
    try:
        off = Sample(points[:, :3], points[:, 3:]).compare(open_camera(path).model.project)
    except (BarpcError, OSError) as error:
        return Proved("camera", name, MISSING if not path.exists() else CHANGED, str(error))
    if off <= stated + REOPENED:
        return Proved("camera", name, SAME)
    far = f"differs from the certified camera by {off:.3g} px, {stated:.1g} stated"
    return Proved("camera", name, CHANGED, far)


def _file_digest(path: Path) -> str | None:
    try:
        return fingerprint(path).sha256 if path.is_file() else None
    except OSError:
        return None
