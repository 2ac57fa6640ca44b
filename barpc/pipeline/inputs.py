"""What a run is given besides images: control, terrain, matches, an earlier block; all of it hashed once."""

from __future__ import annotations

import logging
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import numpy as np

from barpc.ba import BlockPrior
from barpc.dem import Dem
from barpc.errors import InputError
from barpc.geoids import geoid_file
from barpc.identity import Input, Stamp, changed, take
from barpc.options import RunOptions, declared
from barpc.pipeline.control import load_altimetry, load_gcps
from barpc.pointio.links import Links
from barpc.pointio.matches import read_links, tracks_of
from barpc.pointio.names import ViewNames
from barpc.raster import hashed
from barpc.remote import here, located, location
from barpc.report import Run
from barpc.scene import BoolArray, Tracks, View
from barpc.sensor.geometry import footprint
from barpc.sidefile import IMAGE, read_names, versioned
from barpc.tie import Matches
from barpc.tie.matchers.matcher import hook_files
from barpc.tie.pairing.epipolar import grouped
from barpc.tie.patches.channels import Sheet
from barpc.tie.tasks import Progress, ordered
from barpc.workspace import table_path

logger = logging.getLogger(__name__)

PRIOR = "block.npz"  # the file in a run folder that a later run starts from
_TOGETHER = 64 << 20  # bytes that are hashed in one task, at least
_MARGIN = 1.5  # px beyond the centres of the outermost pixels that a matcher may still mean
_ASTRAY = 0.05  # of the points may lie farther off, where a matcher looks over borders; of other crops more


def side_inputs(options: RunOptions, views: Sequence[View]) -> tuple[Dem | None, BlockPrior | None]:
    """Return the terrain, and what an earlier run knows about its views, read before any work starts.

    A file that cannot be used, those of ground points included, stops the run here (InputError), not after an hour.
    """
    for paths in (options.gcp, options.check_points):
        points = load_gcps(paths, views, options)
        for line in () if points is None else points.left_out:
            logger.warning("%s", line)
    load_altimetry(options.altimetry, views)
    if options.adjust.dem_for_weak and options.dem is None:
        raise InputError("dem_for_weak is given without dem: there are no heights to hold the tie points to")
    for path in options.reference:
        Sheet.read(path)
    dem = None if options.dem is None else Dem.open(options.dem, options.geoid)
    if dem is not None:
        _require_cover(dem, str(options.dem), views)
    prior = None if options.fixed_run is None else BlockPrior.load(table_path(Path(options.fixed_run), PRIOR))
    return dem, prior


def _require_cover(dem: Dem, path: str, views: Sequence[View]) -> None:
    """Raise unless the terrain is known somewhere along the outlines of the views."""
    rings = [footprint(view.sensor, view.size, view.altitude) for view in views]
    lon, lat = np.concatenate(rings).T
    if np.isnan(dem(lon, lat)).all():
        raise InputError(
            f"{path}: holds no height at the images' place ({lon[0]:.4f}, {lat[0]:.4f}); is it another tile?"
        )


def with_located(options: RunOptions) -> RunOptions:
    """Return the options with the rasters that may lie on other hosts found there; others are refused (ImageError)."""

    def at(path: str) -> str:
        found = located(path, options.allow_remote)
        return path if here([found]) else os.fspath(versioned(found, IMAGE))

    geoid = None if options.geoid is None else geoid_file(options.geoid)
    dem, geoid = (path if path is None else at(path) for path in (options.dem, geoid))
    return replace(options, dem=dem, geoid=geoid, reference=tuple(map(at, options.reference)))


def reference_names(options: RunOptions) -> list[str]:
    """Return the references by the names that tasks use."""
    return [os.fspath(location(path).absolute()) for path in options.reference]


def input_files(options: RunOptions) -> list[Path]:
    """Return every file of this machine that the options name; none of them is ever written."""
    found = [] if options.fixed_run is None else [table_path(Path(options.fixed_run), PRIOR)]
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
    """Return what finds a view by path or name: its index, None if it was left out, InputError if unknown."""
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


def only_new(tracks: Tracks, old: BoolArray) -> Tracks:
    """Return the tracks with observations that an earlier block, of the views `old` (N,), did not have.

    Tracks without a new view are left out. Of those seen in several old views one old observation is kept: how
    these views lie to each other is in the earlier block's normal matrix already.
    """
    is_old = old[tracks.view]
    has_new = np.bincount(tracks.point, ~is_old, minlength=tracks.num_points) > 0
    order = np.lexsort((tracks.sigma, tracks.point))  # the surest old observation of a track comes first
    order = order[is_old[order]]
    _, first = np.unique(tracks.point[order], return_index=True)
    keep = ~is_old
    keep[order[first]] = True
    return tracks.select(keep & has_new[tracks.point])


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
    images = [view.path for view in run.views]
    rasters = dict.fromkeys([*images, *reference_names(options)])
    given = (os.fspath(path.absolute()) for path in input_files(options) if path.is_file())
    others = dict.fromkeys([*seen, *given])
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
    """Group files into tasks, small ones together."""
    groups: list[list[str]] = [[]]
    size = 0
    for name in names:
        groups[-1].append(name)
        size += sum(path.stat().st_size for path in here([name]))
        if size >= _TOGETHER:
            groups.append([])
            size = 0
    return [(tuple(group),) for group in groups if group]


def hash_files(names: Sequence[str]) -> list[Input]:
    """Hash some files, in a worker."""
    return [hashed(name) for name in names]


def given_tracks(paths: Sequence[str | Path], views: Sequence[View]) -> Tracks:
    """Return the tie points of files as they are."""
    return tracks_of(_linked(paths, views), ", ".join(map(str, paths)))


def given_matches(
    paths: Sequence[str | Path], views: Sequence[View], *, partly: bool = False
) -> dict[tuple[int, int], Matches]:
    """Read the matches of files by pairs; InputError for a file without any, but for part (`partly`) of the images."""
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
        parts[-1] = _in_images(path, views, parts[-1])
    return Links.joined(parts[1:] or parts)


def _in_images(path: str | Path, views: Sequence[View], links: Links) -> Links:
    """Return the matches without points outside their images; InputError where these are more than a few."""
    beyond = np.array([view.size for view in views])[links.view] + (_MARGIN - 1.0)
    inside = np.asarray(((links.xy >= -_MARGIN) & (links.xy <= beyond)).all(axis=1))
    wrong = np.flatnonzero(~inside)
    if not len(wrong):
        return links
    of, (col, row) = views[links.view[wrong[0]]], links.xy[wrong[0]].tolist()
    said = (
        f"{path}: {len(wrong)} of {len(inside)} points lie outside their images, as ({col:g}, {row:g}) in {of.name},"
        f" {of.size[0]} x {of.size[1]} pixels"
    )
    if len(wrong) > _ASTRAY * len(inside):
        raise InputError(f"{said}; were they found in other crops, or in reduced images?")
    logger.warning("%s: they are left out", said)
    number = np.cumsum(inside) - 1
    ends = links.ends[inside[links.ends].all(axis=1)]
    return Links(links.view[inside], links.xy[inside], links.sigma[inside], number[ends])
