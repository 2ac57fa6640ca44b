"""Inputs of a run besides images: control, terrain, matches, an earlier block; all of it hashed once."""

from __future__ import annotations

import logging
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import numpy as np

from barpc.base.declarations import declared
from barpc.base.errors import InputError
from barpc.base.identity import Input, Stamp, changed, fingerprint
from barpc.base.options import RunOptions
from barpc.base.remote import here, located, location
from barpc.base.safe_io import IMAGE, read_names, versioned
from barpc.base.tasks import Progress, ordered
from barpc.pipeline.control import IMAGE_MARGIN, load_altimetry, load_gcps
from barpc.pointio.matches import Links, read_links, tracks_of
from barpc.pointio.names import ViewNames
from barpc.rasters.dem import Dem
from barpc.rasters.raster import hashed
from barpc.rasters.vertical import ELLIPSOIDAL, FLAT, NO_GEOID, geoid_file
from barpc.report import Run
from barpc.report.runfiles import IMAGES, PRIOR_FILE, table_path
from barpc.scene import Tracks, View
from barpc.sensor.geometry import footprint
from barpc.tie import Matches
from barpc.tie.matchers.matcher import hook_files
from barpc.tie.pairing.epipolar import grouped
from barpc.tie.patches.channels import Sheet

logger = logging.getLogger(__name__)

_MAX_OUTSIDE_SHARE = 0.05  # of the points may lie farther off, where a matcher looks over borders; of other crops more


def side_inputs(options: RunOptions, views: Sequence[View]) -> Dem | None:
    """Return the terrain, read before any work starts.

    A file that cannot be used, those of ground points included, stops the run here (InputError), not after an hour.
    """
    dem = Dem.open(options.dem, options.geoid, options.heights) if options.dem else None
    for paths in (options.gcp, options.check_points):
        points = load_gcps(paths, views, options, dem)
        for line in () if points is None else points.said:
            logger.warning("%s", line)
    load_altimetry(options.altimetry, views, options.heights)
    for path in options.reference:
        Sheet.read(path)
    if dem is not None:
        outlines = [footprint(view.sensor, view.size, view.altitude) for view in views]
        dem.covering(*np.concatenate(outlines).T)
    return dem


def with_located(options: RunOptions) -> RunOptions:
    """Return the options with the rasters that may lie on other hosts found there; others are refused (ImageError)."""

    def at(path: str) -> str:
        found = located(path, options.allow_remote)
        return path if here([found]) else os.fspath(versioned(found, IMAGE))

    geoid, heights = (None if name is None else geoid_file(name) for name in (options.geoid, options.heights))
    geoid, heights = (path if path in (None, NO_GEOID, ELLIPSOIDAL, FLAT) else at(path) for path in (geoid, heights))
    dem, reference = (tuple(map(at, paths)) for paths in (options.dem, options.reference))
    return replace(options, dem=dem, geoid=geoid, heights=heights, reference=reference)


def reference_names(options: RunOptions) -> list[str]:
    """Return the references by the names that tasks use."""
    return [os.fspath(location(path).absolute()) for path in options.reference]


def input_files(options: RunOptions) -> list[Path]:
    """Return every file of this machine that the options name; none of them is ever written."""
    earlier = () if options.add_to is None else (PRIOR_FILE, IMAGES)
    found = [table_path(Path(str(options.add_to)), name) for name in earlier]
    for name, one in declared(RunOptions).items():
        value = getattr(options, name)
        if one.rule.unit == "file" and value is not None:
            paths = value if isinstance(value, tuple) else (value,)
            found += here(paths)
    return found


def read_pairs(path: str | Path, views: Sequence[View], left_out: Sequence[str | Path] = ()) -> list[tuple[int, int]]:
    """Read the pairs of a list: two image names or paths a line; blank lines and # comments are skipped.

    Relative paths start from where the list lies, or from the current folder; pairs with an image that was `left_out`
    of the run are passed over. InputError where a line is not two images of the run, or none is left.
    """
    lines = read_names(path, "a list of pairs")
    find = _finder(Path(path).parent, views, left_out)
    pairs = []
    for number, line in enumerate(lines, start=1):
        try:
            words = shlex.split(line.replace("\0", "?"), comments=True)  # no file's name holds a zero
            if len(words) not in (0, 2):
                raise ValueError(f"two image names are expected, found {len(words)}; quote names with spaces")
            found = [index for index in map(find, words) if index is not None]
            if len(found) == 2 and found[0] == found[1]:
                raise ValueError(f"{words[0]} is paired with itself")
        except ValueError as error:
            raise InputError(f"{path}, line {number}: {error}") from error
        if len(found) == 2:
            pairs.append((found[0], found[1]))
    if not pairs:
        raise InputError(f"{path}: lists no pair of the images given")
    return pairs


def _finder(folder: Path, views: Sequence[View], left_out: Sequence[str | Path]) -> Callable[[str], int | None]:
    """Return a function from a path or name to the index of a view; None if left out, InputError if unknown."""
    names = ViewNames([view.name for view in views], "the list of pairs")
    without = ViewNames([Path(path).name for path in left_out], "")
    places: dict[object, int | None] = {_resolved(path): None for path in left_out}
    places |= {_resolved(view.path): index for index, view in enumerate(views)}

    def find(word: str) -> int | None:
        for at in (word, *((start / word).resolve() for start in (folder, Path()))):
            if at in places:
                return places[at]
        unused = names.find(word) is None and without.find(word) is not None
        return None if unused else names.index(word)

    return find


def _resolved(path: str | Path) -> object:
    return location(path).resolve()


def hash_inputs(
    run: Run,
    options: RunOptions,
    seen: Mapping[str, Stamp],
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> dict[str, Input]:
    """Return every hashed input by its name in tasks; InputError where one changed since it was read.

    `seen` holds the files that were opened so far. A matcher of the user's goes by its name, with all its files.
    """
    images = [view.path for view in (*run.views, *(one.view for one in run.carried))]
    rasters = dict.fromkeys([*images, *reference_names(options)])
    given = (os.fspath(path.absolute()) for path in input_files(options) if path.is_file())
    others = dict.fromkeys([*seen, *given])
    names = [*rasters, *(name for name in others if name not in rasters)]
    found: list[Input] = ordered(executor, hashed, [(name,) for name in names], "hash", progress)
    inputs: dict[str, Input] = dict(zip(names, found, strict=True))
    for one in [part for whole in found for part in whole.every()]:
        known = seen.get(one.path)
        if known is not None and one.stamp is not None and not known.matches(one.stamp):
            raise changed(one.path)
    if code := hook_files(options.tie.matcher):
        first, *rest = map(fingerprint, code)
        inputs[options.tie.matcher] = Input(first.path, first.size, first.sha256, first.stamp, tuple(rest))
    return inputs


def given_tracks(paths: Sequence[str | Path], views: Sequence[View]) -> Tracks:
    """Return the tie points of files as they are."""
    return tracks_of(_linked(paths, views), ", ".join(map(str, paths)))


def linked_names(paths: Sequence[str | Path], new: Sequence[str], old: Sequence[str]) -> list[str]:
    """Return which images of an earlier run files have matches of with new ones, by their names."""
    names, found = [*new, *old], set[int]()
    for path in paths:
        links = read_links(path, names)
        ends = links.view[links.ends]
        found.update(ends[(ends < len(new)).any(axis=1)].ravel().tolist())
    return [names[i] for i in sorted(found) if i >= len(new)]


def given_matches(
    paths: Sequence[str | Path], views: Sequence[View], *, partly: bool = False
) -> dict[tuple[int, int], Matches]:
    """Read the matches of files by pairs; InputError for a file of other images, but for part (`partly`) of them."""
    links = _linked(paths, views, partly)
    swapped = links.view[links.ends[:, 0]] > links.view[links.ends[:, 1]]
    ends = np.where(swapped[:, None], links.ends[:, ::-1], links.ends)
    places = links.xy[ends].reshape(-1, 4)  # so that the order of the file does not matter
    ends = ends[np.lexsort(places[:, ::-1].T)]
    first, second = links.view[ends].T
    found = {}
    for rows in grouped(first, second):
        pair, chosen = (int(first[rows[0]]), int(second[rows[0]])), ends[rows]
        if pair[0] != pair[1]:
            found[pair] = Matches(links.xy[chosen], np.zeros(len(chosen)), -1 - chosen)
    return found


def _linked(paths: Sequence[str | Path], views: Sequence[View], partly: bool = False) -> Links:
    """Read the matches of files for the views, all of them inside their images."""
    parts = [Links.of_pairs([])]
    for path in paths:
        try:
            parts.append(read_links(path, [view.name for view in views]))
        except InputError as error:
            if not partly:
                raise
            logger.warning("%s", error)
            continue
        if not parts[-1].joins_views:
            logger.warning("%s: holds no match between two of the images and has no effect", path)
        parts[-1] = _matches_inside(path, views, parts[-1])
    return Links.joined(parts[1:] or parts)


def _matches_inside(path: str | Path, views: Sequence[View], links: Links) -> Links:
    """Return the matches without points outside their images; InputError where these are more than a few."""
    beyond = np.array([view.size for view in views])[links.view] + (IMAGE_MARGIN - 1.0)
    inside = np.asarray(((links.xy >= -IMAGE_MARGIN) & (links.xy <= beyond)).all(axis=1))
    wrong = np.flatnonzero(~inside)
    if not len(wrong):
        return links
    of, (col, row) = views[links.view[wrong[0]]], links.xy[wrong[0]].tolist()
    said = (
        f"{path}: {len(wrong)} of {len(inside)} points lie outside their images, as ({col:g}, {row:g}) in {of.name},"
        f" {of.size[0]} x {of.size[1]} pixels"
    )
    if len(wrong) > _MAX_OUTSIDE_SHARE * len(inside):
        raise InputError(f"{said}; were they found in other crops, or in reduced images?")
    logger.warning("%s: they are left out", said)
    number = np.cumsum(inside) - 1
    ends = links.ends[inside[links.ends].all(axis=1)]
    return Links(links.view[inside], links.xy[inside], links.sigma[inside], number[ends])
