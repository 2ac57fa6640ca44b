"""The inputs of a run, hashed once: images with what they show, and every file that was opened for them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path

from barpc.identity import Input, Stamp, changed, take
from barpc.options import RunOptions
from barpc.pipeline.inputs import input_files
from barpc.raster import hashed
from barpc.remote import Remote, place
from barpc.report import Run
from barpc.tie.hook import hook_files
from barpc.tie.tasks import Progress, ordered

_TOGETHER = 64 << 20  # bytes that are hashed in one task, at least


def hash_inputs(
    run: Run,
    options: RunOptions,
    seen: Mapping[str, Stamp],
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> dict[str, Input]:
    """Every input of a run by the name that tasks call it by; InputError where one changed since it was read.

    `seen` holds the files that were opened so far. A matcher of the user's goes by its name, with all its files.
    """
    images = [view.path for view in run.views]
    references = [os.fspath(place(path).absolute()) for path in options.reference]
    rasters = dict.fromkeys([*images, *references])
    others = dict.fromkeys(
        [*seen, *(os.fspath(path.absolute()) for path in input_files(options) if path.is_file())]
    )
    names = [*rasters, *(name for name in others if name not in rasters)]
    groups = _groups(names)
    found = [one for group in ordered(executor, hash_files, groups, "hash", progress) for one in group]
    inputs: dict[str, Input] = dict(zip(names, found, strict=True))
    for one in [part for whole in found for part in whole.every()]:
        known = seen.get(one.path)
        if known is not None and one.stamp is not None and not known.matches(one.stamp):
            raise changed(one.path)
    if code := hook_files(options.tie.matcher):
        first, *rest = map(take, code)
        inputs[options.tie.matcher] = Input(first.path, first.size, first.sha256, first.stamp, tuple(rest))
    return inputs


def _groups(names: Sequence[str]) -> list[tuple[tuple[str, ...]]]:
    """Small files go together."""
    groups: list[list[str]] = [[]]
    size = 0
    for name in names:
        groups[-1].append(name)
        size += 0 if isinstance(name, Remote) else Path(name).stat().st_size
        if size >= _TOGETHER:
            groups.append([])
            size = 0
    return [(tuple(group),) for group in groups if group]


def hash_files(names: Sequence[str]) -> list[Input]:
    """Hash some files, in a worker."""
    return [hashed(name) for name in names]
