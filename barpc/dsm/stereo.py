"""What a surface is made of: views with the cameras to be believed, their best pairs, and what is known of both."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import scipy.linalg as la

from barpc.ba import BlockPrior
from barpc.ba.estimated.projected import Cameras
from barpc.ba.estimated.unknowns import make_unknowns
from barpc.ba.result import height_by_unknowns
from barpc.base.errors import BarpcError, InputError
from barpc.base.geodesy import Array, ecef_from_ground
from barpc.base.options import TieOptions
from barpc.base.remote import is_url
from barpc.cameras import open_camera
from barpc.export.shots import read_scene
from barpc.pipeline import load_views
from barpc.pipeline.inputs import PRIOR
from barpc.report.runfiles import read_summary, table_path
from barpc.report.summary import Summary
from barpc.rpcio.grids import CORRECTION
from barpc.scene import View
from barpc.sensor.geometry import is_radar
from barpc.tie.pairing.overlaps import overlapping_pairs

logger = logging.getLogger(__name__)

ANGLES = 2.0, 45.0
"""Convergence angles [deg] of pairs that are matched: below, a pixel is 30 of height; above, SGBM finds decoys."""
_RADAR = ("sentinel-1", "terrasar-x", "sicd")

Link = tuple[int, int]
Groups = Sequence[Sequence[Link]]
"""Pairs of views of a surface, the best first; of a difference those of the surface that is taken away, too."""


class NoSurfaceError(BarpcError):
    """Images of which no surface can be made, with the reason."""


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """Views of an adjusted block behind their corrections, and the covariance (V q, V q) of their unknowns."""

    cameras: Cameras
    covariance: Array

    @classmethod
    def of(cls, prior: BlockPrior, views: Sequence[View]) -> CameraErrors:
        """Return the errors that an adjustment left in the cameras of these views; those that it held fixed have none.

        The derivatives are those at the corrected cameras: corrections are so small that they change none of them.
        """
        names, q = tuple(view.name for view in views), prior.params.shape[1]
        free = np.flatnonzero(np.isin(names, prior.names))
        if not len(free):
            raise InputError("the block's covariance names none of the run's images: run the adjustment again")
        at = np.array([prior.names.index(names[i]) for i in free])
        centers = prior.center[at] if len(free) == len(views) else None
        unknowns = make_unknowns(views, prior.model, prior.drift, centers, prior.waves(names))
        if unknowns.size != q:
            raise InputError(f"the block's covariance is of {q} unknowns an image, its cameras have {unknowns.size}")
        theirs, own = ((index[:, None] * q + np.arange(q)).ravel() for index in (at, free))
        try:
            found = la.cho_solve(la.cho_factor(prior.dense()), np.eye(prior.params.size)[:, theirs])[theirs]
        except la.LinAlgError as error:
            raise InputError(f"the block's information is damaged ({error})") from error
        covariance = np.zeros((len(views) * q, len(views) * q))
        covariance[np.ix_(own, own)] = 0.5 * (found + found.T)
        return cls(Cameras(views, unknowns), covariance)

    def rows(self, groups: Groups, ground: Array) -> Array:
        """Return the derivative (n, V q) by all unknowns of the mean height that the first group's pairs measure at
        ground points (n, 3), minus those of the others.
        """
        count, num = len(self.cameras.sensors), len(ground)
        params, ecef = np.zeros((count, self.cameras.unknowns.size)), ecef_from_ground(ground)
        out = np.zeros((num, *params.shape))
        for sign, group in zip((1, -1), groups, strict=False):
            for pair in group:
                out[:, pair] += sign / len(group) * height_by_unknowns(self.cameras, params, pair, ecef)
        return out.reshape(num, -1)

    def sigma(self, rows: Array) -> Array:
        """Return the standard deviation (n,) [m] of heights, or differences of them, of these derivatives (n, V q)."""
        square: Array = np.einsum("ni,ij,nj->n", rows, self.covariance, rows)
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))


@dataclass(frozen=True, eq=False)
class Block:
    """Views with the cameras that are believed, their pairs, and the errors of the cameras where known.

    `run`: what was said of the run that they are of.
    """

    views: Sequence[View]
    groups: Groups
    source: str
    errors: CameraErrors | None = None
    run: Summary | None = None


def block_of_run(folder: Path, alts: tuple[float, float] | None = None, minus: str | None = None) -> Block:
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
        _refuse_radar(shot.name, source is not None and source.format in _RADAR)
        if is_url(shot.file):
            raise InputError(f"{shot.file}: is on another host; a surface is made of images on this one")
        if not shot.file:
            raise InputError(f"{folder}: {shot.name} has no pixels")
        grid, date = shot.name + CORRECTION, (shot.light.time or "")[:10]
        camera = open_camera(folder / grid).model if grid in shot.entry.outputs else shot.rpc
        views.append(View(shot.name, shot.file, shot.size, camera, scene.alt_range, date))
    ties = {frozenset((pair.a, pair.b)): float(pair.num_matches) for pair in scene.summary.pairs}
    worth = {
        (i, j): ties.get(frozenset((views[i].name, views[j].name)), 0.0) for i, j in combinations(range(len(views)), 2)
    }
    there = None if minus is None else {view.name for view in read_summary(Path(minus)).views}
    parts = [[i for i, v in enumerate(views) if there is None or (v.name in there) == old] for old in (False, True)]
    if there is None:
        del parts[1]
    elif min(map(len, parts)) < 2:
        raise InputError(
            f"{minus}: has {len(parts[1])} of the {len(views)} images of {folder}; a change, and what dates share, "
            "is told by a run with at least two images of each, minus one of a single date: adjust both together"
        )
    flagged = frozenset(i for i, shot in enumerate(scene.shots) if shot.entry.advice)
    groups = [_best(views, worth, flagged, part) for part in parts]
    errors = CameraErrors.of(BlockPrior.load(table_path(folder, PRIOR)), views)
    return Block(views, groups, f"{folder}" if minus is None else f"{folder} minus {minus}", errors, scene.summary)


def block_of_images(images: Sequence[str], alts: tuple[float, float] | None = None, band: int = 1) -> Block:
    """Return the images with the cameras that come with them; altitudes are those of the cameras unless given."""
    views = [replace(view, alt_range=alts or view.alt_range) for view in load_views(images, band=band).views]
    for view in views:
        _refuse_radar(view.name, is_radar(view.sensor))
    return Block(views, [_best(views)], ", ".join(view.name for view in views))


def _refuse_radar(name: str, radar: bool) -> None:
    if radar:
        raise NoSurfaceError(f"{name}: a radar image: its speckle and layover are nothing that SGBM matches")


def _best(
    views: Sequence[View],
    ties: dict[Link, float] | None = None,
    flagged: frozenset[int] = frozenset(),
    among: Sequence[int] | None = None,
) -> list[Link]:
    """Return the pairs (`among` some views) by what they say of heights: of one date first, without `flagged` views
    first, then by tie points times the squared tangent of the angle.

    A height's variance is that of a match over (B/H)^2, and where tie points are found, dense matches are. Without
    tie points the overlap and the angle stand for them (`barpc.tie.pairing.overlaps.Pair.score`).
    """
    found = overlapping_pairs(views, TieOptions(angles=(0.0, 180.0)))
    found = [pair for pair in found if among is None or set(pair.views) <= set(among)]
    rows = []
    for pair in found:
        if ANGLES[0] <= pair.angle <= ANGLES[1]:
            worth = (pair.score if ties is None else ties[pair.views]) * np.tan(np.radians(pair.angle)) ** 2
            dates = {views[i].date for i in pair.views}
            rows.append((len(dates), not flagged.isdisjoint(pair.views), -worth, pair.views))
    if not rows:
        said = [f"{views[p.views[0]].name} and {views[p.views[1]].name} {p.angle:.1f} deg" for p in found[:3]]
        raise NoSurfaceError(
            f"no pair meets under {ANGLES[0]:g} to {ANGLES[1]:g} degrees, where SGBM can match "
            f"({'; '.join(said) or 'no two images overlap at the altitudes that they are used for'})"
        )
    rows.sort()
    rows = [row for row in rows if row[0] == rows[0][0]]
    late = sorted({views[i].name for row in rows if row[1] for i in flagged.intersection(row[3])})
    if late and not rows[0][1]:
        words = "%s: the verdict of the run has a reservation, so pairs with it come after the others"
        logger.warning(words, ", ".join(late))
    return [row[3] for row in rows]
