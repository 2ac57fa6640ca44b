"""Inputs of a surface: views with their best cameras, their best pairs, and the accuracy of both.

Tile by tile the best pairs that see it are matched, intersected and gathered into its cells.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import combinations
from pathlib import Path

import numpy as np
import scipy.linalg as la
from pyproj import Transformer
from scipy.interpolate import BSpline

from barpc.ba import BlockPrior
from barpc.ba.parameters.projected import Cameras
from barpc.ba.parameters.unknowns import make_unknowns
from barpc.ba.result import height_derivatives
from barpc.ba.solving.structure import counting_sort
from barpc.ba.unseen import UnseenSteps
from barpc.base.errors import BarpcError, InputError
from barpc.base.geodesy import CHUNK, Array, IntArray, ecef_from_ground, parts
from barpc.base.options import TieOptions
from barpc.base.remote import is_url
from barpc.base.statistics import MAD
from barpc.cameras import open_camera
from barpc.dsm.consensus import F32, consensus, finite_median
from barpc.export.shots import read_scene
from barpc.pipeline import load_views
from barpc.report.finished import FinishedRun
from barpc.report.runfiles import PRIOR_FILE
from barpc.report.summary.block import AXES
from barpc.rpcio.formats import CORRECTION
from barpc.scene import View
from barpc.sensor.radar import Radar
from barpc.sensor.rational import monomials
from barpc.sensor.triangulation import intersect_pair
from barpc.tie.pairing.overlaps import Link, overlapping_pairs
from barpc.tie.patches.dense import (
    ACROSS,
    COLUMNS_PER_PIXEL,
    WINDOW,
    DenseMatches,
    dense_matches,
    epipolar_frame,
    span_of_surface,
)

logger = logging.getLogger(__name__)

MATCHED = 0.2
"""Share of the pixels of a part that is matched at least, or the pair says nothing there.

Of pictures of different ground 2 to 11 % are (22 trials, rendered, and real ones turned over), of pairs 92 to 97 %.
"""
TILE_NODES = 5
"""Places a side of a tile, at which cameras are asked."""
_NUM_ALTITUDES = 3  # altitudes
_MAX_DISPARITY_SPAN = (
    64.0  # px searched at once, else about a coarser picture: 0.5 of the time of 128, and of 32 no less
)
_COARSE = 8  # times a pixel at most of the coarser picture
_SPLIT = 3  # times that a part is halved at most
_CUBIC_MATCHES = 400  # matches that make a cubic, and as many that test it
_EXACT = 1e-3  # m: errors of a cubic in place of intersections; of Pleiades' 2e-6

TilePoints = tuple[Array, Array, float, float]
"""Points (n, 3) on the tile's map: east, north, altitude [m]; their standard deviations in height (n,) [m], the share
of the pixels matched, and the height that a pixel of disparity stands for [m].
"""
CONVERGENCE_RANGE = 2.0, 45.0
"""Convergence angles [deg] of pairs that are matched: below, a pixel is 30 of height; above, SGBM finds decoys."""
_RADAR = ("sentinel-1", "terrasar-x", "sicd")

Groups = Sequence[Sequence[Link]]
"""Pairs of views of a surface, the best first; of a difference those of the surface that is taken away, too."""


@dataclass(frozen=True)
class Tile:
    """Cells of a map: its CRS, the corner in the north-west, the side of a cell [m], `size` cells each way.

    `alts`: the altitudes [m] between which its ground is looked for.
    """

    crs: str
    west: float
    north: float
    step: float
    size: tuple[int, int]
    alts: tuple[float, float]

    def part(self, col: int, row: int, side: int) -> Tile:
        """Return the cells from a col, row on, so many each way or as many as there are."""
        size = min(side, self.size[0] - col), min(side, self.size[1] - row)
        return replace(self, west=self.west + self.step * col, north=self.north - self.step * row, size=size)

    def quarters(self) -> list[Tile]:
        """Return the tile's quarters, of as many cells of half the side."""
        width, height = (self.step * count / 2 for count in self.size)
        near = partial(replace, self, step=self.step / 2)
        return [near(west=self.west + i * width, north=self.north - j * height) for j in (0, 1) for i in (0, 1)]

    def nodes(self, count: tuple[int, int] = (TILE_NODES, TILE_NODES), edge: float = 0.0) -> Array:
        """Return the longitude, latitude (rows cols, 2) [deg] of a grid, `edge` cells inside, the north first."""
        col, row = np.meshgrid(*(np.linspace(edge, side - edge, n) for side, n in zip(self.size, count, strict=True)))
        east, north = self.west + self.step * col.ravel(), self.north - self.step * row.ravel()
        return np.column_stack(_map_transform(self.crs).transform(east, north, direction="INVERSE"))

    def on_map(self, ground: Array) -> Array:
        """Return the east, north, altitude (n, 3) [m] of ground points (n, 3)."""
        east, north = _map_transform(self.crs).transform(*ground[:, :2].T)
        return np.column_stack([east, north, ground[:, 2]])

    def ground(self) -> Array:
        """Return the ground points (NODES NODES, 3) of the nodes at the middle altitude."""
        return np.column_stack([self.nodes(), np.full(TILE_NODES**2, sum(self.alts) / 2)])


@lru_cache
def _map_transform(crs: str) -> Transformer:
    """Return the transform from longitude, latitude to a map."""
    return Transformer.from_crs("EPSG:4326", crs, always_xy=True)


def surface_tile(pairs: Sequence[tuple[View, View]], tile: Tile, band: int) -> tuple[F32, ...]:
    """Compute the cells of a tile in a worker: the median of each pair's matches, then of the heights of the pairs that
    agree (`barpc.dsm.stereo`).

    Returns
    -------
    height, nmad, sigma : (rows, cols) [m], NaN where unknown; of the disagreement of all pairs, and of the noise of one
        match through the intersection (root mean square of the pairs that are taken)
    seen : (rows, cols), as float32: bit k is set where the height of pair k is taken
    shares : (pairs,), of the pixels that both images show so many were matched; NaN: they show nothing of it
    """
    cells = np.full((2, len(pairs), tile.size[1], tile.size[0]), np.nan, np.float32)
    shares, metres = np.full((2, len(pairs)), np.nan, np.float32)
    for k, pair in enumerate(pairs):
        if found := _tile_points(pair, tile, band):
            ground, sigma, share, pixel = zip(*found, strict=True)
            shares[k], metres[k] = np.mean(share), np.max(pixel)
            if shares[k] >= MATCHED:
                cells[:, k] = gathered(tile, np.concatenate(ground), np.concatenate(sigma))
    taken = consensus(cells[0], metres)
    height = finite_median(np.where(taken, cells[0], np.nan))
    several = np.isfinite(cells[0]).sum(axis=0) > 1
    nmad = np.where(several, MAD * finite_median(np.abs(cells[0] - height)), np.nan)
    seen = np.tensordot(1 << np.arange(len(pairs)), taken, axes=1)
    total, count = np.where(taken, cells[1] ** 2, 0.0).sum(axis=0), np.where(seen > 0, taken.sum(axis=0), np.nan)
    return (*(one.astype(np.float32) for one in (height, nmad, np.sqrt(total / count), seen)), shares)


def _tile_points(pair: tuple[View, View], tile: Tile, band: int, halved: int = 0) -> list[TilePoints]:
    """Return the points of a tile, part by part; of one unseen nothing. Coarser pictures narrow the altitudes."""
    zoom, nodes, coarse = _COARSE, tile.nodes(), None
    while True:
        levels = np.repeat(np.linspace(tile.alts[0], max(tile.alts[1], tile.alts[0] + 1.0), _NUM_ALTITUDES), len(nodes))
        ground = np.column_stack([np.tile(nodes, (_NUM_ALTITUDES, 1)), levels])
        a, b = (view.sensor.project(ground) + 0.5 for view in pair)
        if not np.isfinite(a + b).all():
            return []
        frame = epipolar_frame(a - 0.5, b - 0.5, levels)
        zoom = min(zoom, 1 << max(0, int(np.ceil(np.log2(frame.num / (COLUMNS_PER_PIXEL * _MAX_DISPARITY_SPAN))))))
        if zoom == 1 and frame.across > ACROSS and halved < _SPLIT:
            return [one for part in tile.quarters() for one in _tile_points(pair, part, band, halved + 1)]
        frame = epipolar_frame(a / zoom - 0.5, b / zoom - 0.5, levels)  # of pictures of means of `zoom` px a side
        sizes = [(view.size[0] // zoom, view.size[1] // zoom) for view in pair]
        near = None if coarse is None else (*((one + 0.5) / zoom - 0.5 for one in coarse[:2]), coarse[2] / zoom)
        found = dense_matches([view.path for view in pair], sizes, frame, band, near)
        if found is None:
            return []
        if zoom == 1:
            return [(_intersected(pair, tile, found), found.sigma * frame.metres, found.share, frame.metres)]
        if found.share < MATCHED or not len(found.sigma):
            return [(np.empty((0, 3)), np.empty(0), found.share, frame.metres)]
        low, high = span_of_surface(found.alt, frame.metres)
        tile = replace(tile, alts=(max(tile.alts[0], low), min(tile.alts[1], high)))
        coarse = (found.a + 0.5) * zoom - 0.5, (found.b + 0.5) * zoom - 0.5, zoom
        zoom //= 2


def _intersected(pair: tuple[View, View], tile: Tile, found: DenseMatches) -> Array:
    """Return the points (n, 3) of matches on the tile's map; NaN or infinite where the rays do not meet.

    They are those of a cubic in col, row and disparity through some matches, if it meets others within `_EXACT`.
    """
    sensors, points = [view.sensor for view in pair], np.empty((found.place.shape[1], 3))

    def intersected(of: slice | IntArray) -> Array:
        some = found.some(of)
        return tile.on_map(intersect_pair(sensors, (some.a, some.b), some.alt))

    def basis(of: slice | IntArray) -> Array:
        return monomials((found.place[:, of] - middle) / size)

    if len(points) > CHUNK:
        middle, size = found.place.mean(axis=1, keepdims=True), np.ptp(found.place, axis=1, keepdims=True) + 1.0
        ends = np.concatenate([found.place.argmin(axis=1), found.place.argmax(axis=1)])
        tried = np.append(np.random.default_rng(0).choice(len(points), 2 * _CUBIC_MATCHES, replace=False), ends)
        exact, terms = intersected(tried), basis(tried).T
        if np.isfinite(exact).all():
            coeffs = np.linalg.lstsq(terms[:_CUBIC_MATCHES], exact[:_CUBIC_MATCHES] - exact[0], rcond=None)[0]
            if np.abs(terms @ coeffs + exact[0] - exact).max() < _EXACT:
                for part in parts(len(points)):
                    points[part] = basis(part).T @ coeffs + exact[0]
                return points
    for part in parts(len(points)):
        points[part] = intersected(part)
    return points


def gathered(tile: Tile, points: Array, sigma: Array) -> F32:
    """Return the median height of the points (n, 3) on the map in each cell and its sigma (2, rows, cols); NaN where
    there is none.
    """
    (width, height), (east, north, heights) = tile.size, points.T
    col, row = (np.floor(one / tile.step) for one in (east - tile.west, tile.north - north))
    inside = np.flatnonzero((col >= 0) & (col < width) & (row >= 0) & (row < height))  # none that has no place
    cell, alt = (row[inside] * width + col[inside]).astype(np.int64), heights[inside]
    variance = np.bincount(cell, sigma[inside] ** 2, height * width)
    order = np.argsort(alt)
    order = order[counting_sort(cell[order], width * height)[0]]
    cell, alt = cell[order], alt[order]
    start = np.flatnonzero(np.diff(cell, prepend=-1))
    of, count = cell[start], np.diff(start, append=len(cell))
    cells = np.full((2, height * width), np.nan, np.float32)
    cells[0, of] = (alt[start + (count - 1) // 2] + alt[start + count // 2]) / 2
    cells[1, of] = np.sqrt(variance[of] / count) * noise_of_mean(np.sqrt(count))
    return cells.reshape(2, height, width)


def noise_of_mean(side: Array) -> Array:
    """Return the share of sigma that remains in the mean of `side` x `side` matches with overlapping windows.

    Each is a mean over WINDOW of steps that look at WINDOW pixels: matches correlate as a cubic B-spline of their
    distance, with knots every WINDOW. A sum over all pairs, axis by axis, interpolated between whole sides.
    """
    lag = np.arange(int(np.ceil(side.max(initial=1.0))))
    far, num = lag / WINDOW, lag + 1.0
    spline = BSpline.basis_element(np.arange(-2, 3), extrapolate=False)
    alike = np.nan_to_num(spline(far)) / spline(0.0)
    alike[0] = 0.5  # a match is once beside itself, and twice beside another
    left = 2.0 * (num * np.cumsum(alike) - np.cumsum(lag * alike)) / num**2
    return np.asarray(np.interp(side, num, left))


class NoSurfaceError(BarpcError):
    """Images of which no surface can be made, with the reason."""


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """Views of an adjusted block behind their corrections, and the covariance (V q, V q) of their unknowns.

    `unseen`: displacements that two images do not show, further unknowns with variances of one.
    """

    cameras: Cameras
    covariance: Array
    unseen: UnseenSteps | None = None

    @classmethod
    def of(cls, prior: BlockPrior, views: Sequence[View]) -> CameraErrors:
        """Return the errors that an adjustment left in the cameras of these views; those that it held fixed have none.

        The derivatives are those at the corrected cameras: corrections are so small that they change none of them.
        """
        names, q = tuple(view.name for view in views), prior.params.shape[1]
        free = np.flatnonzero(np.isin(names, prior.names))
        if not len(free):
            raise InputError("the block's covariance names none of the run's images: run the adjustment again")
        known = prior.marginal(names)
        own = np.array([names.index(name) for name in known.names])
        centers = known.center[np.argsort(own)] if len(free) == len(views) else None
        unknowns = make_unknowns(views, prior.model, prior.drift, centers, prior.waves(names))
        if unknowns.size != q:
            raise InputError(f"the block's covariance is of {q} unknowns an image, its cameras have {unknowns.size}")
        own = (own[:, None] * q + np.arange(q)).ravel()
        try:
            found = la.inv(known.dense())
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
        out, steps = np.zeros((num, *params.shape)), [np.zeros((num, 0))]
        for sign, group in zip((1, -1), groups, strict=False):
            for pair in group:
                by_unknown, pull, image = height_derivatives(self.cameras, params, pair, ecef)
                out[:, pair] += sign / len(group) * by_unknown
                steps += [] if self.unseen is None else [self.unseen.heights(image, pull)]
        return np.concatenate([out.reshape(num, -1), *steps], axis=1)

    def sigma(self, rows: Array) -> Array:
        """Return the standard deviation (n,) [m] of heights, or differences of them, of these derivatives (n, V q)."""
        known = rows[:, : len(self.covariance)]
        square: Array = np.einsum("ni,ij,nj->n", known, self.covariance, known)
        square += (rows[:, len(self.covariance) :] ** 2).sum(axis=1)
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))


@dataclass(frozen=True, eq=False)
class StereoBlock:
    """Views with their best cameras, their pairs, and the errors of the cameras where known.

    `run`: theirs.
    """

    views: Sequence[View]
    groups: Groups
    source: str
    errors: CameraErrors | None = None
    run: FinishedRun | None = None


def block_of_run(folder: Path, alts: tuple[float, float] | None = None, minus: str | None = None) -> StereoBlock:
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
        camera = open_camera(shot.writer.sealed.file(grid)).model if grid in shot.written else shot.rpc
        views.append(View(shot.name, shot.file, shot.size, camera, scene.alt_range, date))
    ties = {frozenset((pair.a, pair.b)): float(pair.num_matches) for pair in scene.pairs}
    worth = {
        (i, j): ties.get(frozenset((views[i].name, views[j].name)), 0.0) for i, j in combinations(range(len(views)), 2)
    }
    before = () if minus is None else FinishedRun.open(minus).lineage
    there = None if minus is None else {view.name for run in before for view in run.summary.views}
    parts = [[i for i, v in enumerate(views) if there is None or (v.name in there) == old] for old in (False, True)]
    if there is None:
        del parts[1]
    elif min(map(len, parts)) < 2:
        raise InputError(
            f"{minus}: has {len(parts[1])} of the {len(views)} images of {folder}; a change, and what dates share, "
            "is told by a run with at least two images of each, minus one of a single date: adjust both together"
        )
    flagged = frozenset(i for i, shot in enumerate(scene.shots) if shot.entry.advice)
    groups = [_ranked_pairs(views, worth, flagged, part) for part in parts]
    errors = CameraErrors.of(BlockPrior.load(scene.run.table(PRIOR_FILE)), views)
    if len(views) == 2 and scene.run.summary.scene is not None and (told := scene.run.summary.scene.unseen):
        sizes, found = np.array([view.size for view in views], dtype=np.float64), np.zeros((2, 2, 2))
        for one in told:
            at = [view.name for view in views].index(one.image), AXES.index(one.axis)
            found[(slice(None), *at)] = one.largest_px, one.height_m
        errors = replace(errors, unseen=UnseenSteps(sizes, *found))
    images = " minus ".join(", ".join(views[i].name for i in part) for part in parts)
    return StereoBlock(views, groups, images, errors, scene.run)


def block_of_images(images: Sequence[str], alts: tuple[float, float] | None, band: int) -> StereoBlock:
    """Return the images with the cameras that come with them; altitudes are those of the cameras unless given."""
    views = [replace(view, alt_range=alts or view.alt_range) for view in load_views(images, band=band).views]
    for view in views:
        _refuse_radar(view.name, isinstance(view.sensor, Radar))
    return StereoBlock(views, [_ranked_pairs(views)], ", ".join(view.name for view in views))


def _refuse_radar(name: str, radar: bool) -> None:
    if radar:
        raise NoSurfaceError(f"{name}: a radar image: its speckle and layover are nothing that SGBM matches")


def _ranked_pairs(
    views: Sequence[View],
    ties: dict[Link, float] | None = None,
    flagged: frozenset[int] = frozenset(),
    among: Sequence[int] | None = None,
) -> list[Link]:
    """Return the pairs (`among` some views), ranked for heights: those of one date first, those without `flagged`
    views first, then by tie points times the squared tangent of the angle.

    A height's variance is that of a match over (B/H)^2, and where tie points are found, dense matches are. Without
    tie points the overlap and the angle stand for them (`barpc.tie.pairing.overlaps.Pair.score`).
    """
    found = overlapping_pairs(views, TieOptions(angles=(0.0, 180.0)))
    found = [pair for pair in found if among is None or set(pair.views) <= set(among)]
    rows = []
    for pair in found:
        if CONVERGENCE_RANGE[0] <= pair.angle <= CONVERGENCE_RANGE[1]:
            worth = (pair.score if ties is None else ties[pair.views]) * np.tan(np.radians(pair.angle)) ** 2
            dates = {views[i].date for i in pair.views}
            rows.append((len(dates), not flagged.isdisjoint(pair.views), -worth, pair.views))
    if not rows:
        said = [f"{views[p.views[0]].name} and {views[p.views[1]].name} {p.angle:.1f} deg" for p in found[:3]]
        raise NoSurfaceError(
            f"no pair has a convergence angle of {CONVERGENCE_RANGE[0]:g} to {CONVERGENCE_RANGE[1]:g} degrees for SGBM "
            f"({'; '.join(said) or 'no two images overlap at the altitudes that they are used for'})"
        )
    rows.sort()
    rows = [row for row in rows if row[0] == rows[0][0]]
    late = sorted({views[i].name for row in rows if row[1] for i in flagged.intersection(row[3])})
    if late and not rows[0][1]:
        words = "%s: the verdict of the run has a reservation, so pairs with it come after the others"
        logger.warning(words, ", ".join(late))
    return [row[3] for row in rows]
