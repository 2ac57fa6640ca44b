"""What a surface is made of: views with the cameras to be believed, their best pairs, what is known of the cameras."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from barpc.ba import BlockPrior
from barpc.base.errors import BarpcError, InputError
from barpc.base.options import TieOptions
from barpc.base.remote import is_url
from barpc.cameras import open_camera
from barpc.dsm.sigma import CameraErrors
from barpc.export.shots import read_scene
from barpc.pipeline import load_views
from barpc.pipeline.inputs import PRIOR
from barpc.report.runfiles import read_summary
from barpc.report.summary import Summary
from barpc.rpcio.grids import CORRECTION
from barpc.scene import View
from barpc.sensor.geometry import base_to_height, is_radar
from barpc.tie.pairing.overlaps import overlapping_pairs
from barpc.workspace import table_path

logger = logging.getLogger(__name__)

ANGLES = 2.0, 45.0
"""Convergence angles [deg] of pairs that are matched: below, a pixel is 30 of height; above, SGBM finds decoys."""
_RADAR = ("sentinel-1", "terrasar-x", "sicd")


Pairs = tuple[tuple[int, int], ...]
"""Indices of two views each, the best pair first."""


class NoSurfaceError(BarpcError):
    """Images of which no surface can be made, with the reason."""


@dataclass(frozen=True, eq=False)
class Block:
    """Views with the cameras that are believed, their pairs, and the covariance of the cameras where known.

    `groups`: the pairs of which a surface is made; of a difference those of the surface that is taken away, too;
    `run`: what was said of the run that they are of.
    """

    views: tuple[View, ...]
    groups: tuple[Pairs, ...]
    errors: CameraErrors | None
    source: str
    run: Summary | None = None


def block_of_run(folder: Path, alts: tuple[float, float] | None = None, minus: Path | None = None) -> Block:
    """Return the images of a finished run behind its corrected cameras; altitudes by its tie points unless given.

    `minus`: a run of some of these images (an earlier one, that this one went on from); they are another group then.

    Raises
    ------
    InputError
        No finished adjustment, or an image that is on another host.
    NoSurfaceError
        Images that are not matched: radar, angles.
    """
    scene = read_scene(folder, alts)
    views = []
    for shot in scene.shots:
        source = shot.entry.rpc_source
        if source is not None and source.format in _RADAR:
            raise NoSurfaceError(_radar(shot.name))
        if is_url(shot.file):
            raise InputError(f"{shot.file}: is on another host; a surface is made of images on this one")
        if not shot.file:
            raise InputError(f"{folder}: {shot.name} has no pixels")
        grid, date = shot.name + CORRECTION, (shot.light.time or "")[:10]
        camera = open_camera(folder / grid).model if grid in shot.entry.outputs else shot.rpc
        views.append(View(shot.name, shot.file, shot.size, camera, scene.alt_range, date))
    ties = {frozenset((pair.a, pair.b)): float(pair.num_matches) for pair in scene.summary.pairs}
    names = [view.name for view in views]
    errors = CameraErrors.of(BlockPrior.load(table_path(folder, PRIOR)), views)
    worth = {(i, j): ties.get(frozenset((names[i], names[j])), 0.0) for i, j in combinations(range(len(views)), 2)}
    parts = [range(len(views))] if minus is None else _split(folder, names, minus)
    flagged = frozenset(i for i, shot in enumerate(scene.shots) if shot.entry.advice)
    groups = tuple(_best(views, worth, part, flagged) for part in parts)
    name = str(folder) + ("" if minus is None else f" minus {minus}")
    return Block(tuple(views), groups, errors, name, scene.summary)


def _split(folder: Path, names: Sequence[str], minus: Path) -> list[list[int]]:
    """Return the images that another run does not have, and those that it has; InputError where either are too few."""
    there = {view.name for view in read_summary(minus).views}
    parts = [[i for i, name in enumerate(names) if (name in there) == old] for old in (False, True)]
    if min(map(len, parts)) < 2:
        raise InputError(
            f"{minus}: has {len(parts[1])} of the {len(names)} images of {folder}; a change, and what dates share, "
            "is told by a run with at least two images of each, minus one of a single date: adjust both together"
        )
    return parts


def block_of_images(images: Sequence[str], alts: tuple[float, float] | None = None, band: int = 1) -> Block:
    """Return the images with the cameras that come with them; altitudes are those of the cameras unless given."""
    views = [replace(view, alt_range=alts or view.alt_range) for view in load_views(images, band=band).views]
    for view in views:
        if is_radar(view.sensor):
            raise NoSurfaceError(_radar(view.name))
    return Block(tuple(views), (_best(views),), None, ", ".join(view.name for view in views))


def _radar(name: str) -> str:
    return f"{name}: a radar image: its speckle and layover are nothing that SGBM matches"


def _best(
    views: Sequence[View],
    ties: dict[tuple[int, int], float] | None = None,
    among: Sequence[int] | None = None,
    flagged: frozenset[int] = frozenset(),
) -> Pairs:
    """Return the pairs (`among` some views) by what they say of heights: of one date first, without `flagged` views
    first, then by tie points times (B/H)^2.

    A height's variance is that of a match over (B/H)^2, and where tie points are found, dense matches are. Without
    tie points the overlap and the angle stand for them (`barpc.tie.pairing.overlaps.Pair.score`).
    """
    found = overlapping_pairs(views, TieOptions(angles=(0.0, 180.0)))
    found = [pair for pair in found if among is None or set(pair.views) <= set(among)]
    rows = []
    for pair in found:
        if not ANGLES[0] <= pair.angle <= ANGLES[1]:
            continue
        first, second = (views[i] for i in pair.views)
        middle = first.sensor.localize((np.array(first.size) - 1.0) / 2.0, np.array(first.altitude))
        worth = pair.score if ties is None else ties[pair.views]
        worth *= float(base_to_height(first.sensor, second.sensor, middle)) ** 2
        rows.append((first.date != second.date, not flagged.isdisjoint(pair.views), -worth, pair.views))
    if not found:
        raise NoSurfaceError("no two images overlap at the altitudes that they are used for")
    if not rows:
        said = [f"{views[p.views[0]].name} and {views[p.views[1]].name} {p.angle:.1f} deg" for p in found[:3]]
        raise NoSurfaceError(
            f"no pair meets under {ANGLES[0]:g} to {ANGLES[1]:g} degrees, where SGBM can match ({'; '.join(said)})"
        )
    rows = sorted([row for row in rows if not row[0]] or rows)
    late = sorted({views[i].name for row in rows if row[1] for i in flagged.intersection(row[3])})
    if late and not rows[0][1]:
        words = "%s: the verdict of the run has a reservation, so pairs with it come after the others"
        logger.warning(words, ", ".join(late))
    return tuple(row[3] for row in rows)
