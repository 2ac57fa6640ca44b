"""Control from a reference orthoimage: it and an image, brought onto one grid on the ground, are matched densely.

An image is projected through its camera and the terrain onto a local grid, at the coarser of the two resolutions. First
many blocks vote together for one shift of the whole camera, within `VOTE_RADIUS` metres, or, where nothing is found
there, `FAR_RADIUS`; how far the peak stands above
the rest of the sum says whether this is the same place. With the camera moved so, points on a regular grid on the
ground, the same for all views, are looked for one by one (`barpc.tie.patches.channels`), and those are kept that agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from barpc.base.geodesy import NEWTON_STEPS, Array, metres_per_unit
from barpc.base.options import TieOptions
from barpc.base.statistics import MAD, SURELY, robust_spread
from barpc.base.tasks import HERE, Work
from barpc.scene import BoolArray, GroundPoints, IntArray, Reference, View
from barpc.sensor.geometry import footprint, ground_sample_distance, sight_enu
from barpc.tie.matchers.structural import GRID_POINTS
from barpc.tie.pairing.epipolar import grouped
from barpc.tie.pairing.overlaps import Terrain
from barpc.tie.patches.channels import INVALID_MARGIN, Patch, Sheet, correlation, of_image, of_reference, picture_share
from barpc.tie.patches.oriented import HALF, PatchTile
from barpc.tie.pixels import CELL, SPAN, FloatImage

VOTE_RADIUS, FAR_RADIUS = 150.0, 1000.0  # m: how far a camera may be off; where nothing is found within the first
PEAK = 6.5  # a vote whose peak has fewer standard deviations is none: other places reach 5.1
_SEARCH = 6, 5.0  # px and m: what the vote and the terrain leave, together
_VOTE_RESOLUTION, _BLOCKS = 2.0, 8  # of the first vote: m a pixel, at least; blocks along a side
_VOTE_REFINEMENT = 4.0  # times, from one vote to the next
_MIN_PICTURE_SHARES = 0.5, 0.3  # of a block and of the reference around it
_MIN_AGREEING_POINTS = TieOptions().min_matches  # points that agree in a view
_DECOY_MARGIN = 0.1  # by which a correlation beats its decoy's


@dataclass(frozen=True)
class ViewMatch:
    """Result of matching a view to a reference."""

    name: str
    peak: float  # standard deviations of the vote's peak above the median
    offset: tuple[float, float]  # how far off the camera shows everything, east, north [m]
    tried: int = 0  # points looked for
    passed: int = 0  # that beat their decoys and came back
    points: int = 0  # of them, those that agree with each other
    scatter: float = float("nan")  # of those, across the line of sight [m]
    along: float = float("nan")  # the same along it, where errors of the terrain's heights move points [m]
    slope: float = 0.0  # how far a metre of height moves them along it [m]
    gsd: float = float("nan")  # of the view [m]

    @property
    def heights(self) -> float:
        """Height errors [m] of the terrain that would explain the scatter, point by point."""
        more = max(self.along**2 - self.scatter**2, 0.0)
        return float(np.sqrt(more) / self.slope) if self.slope > 0 else 0.0

    def shows_heights(self, sigma: float) -> bool:
        """Return whether points scatter along the line of sight more than a terrain known to `sigma` [m] allows.

        Measured: 0.5 to 1.3 times what is expected, over a terrain of another place, mirrored or flat 6 to 9 times.
        """
        return bool(self.along > SURELY * np.hypot(self.scatter, self.slope * sigma))


@dataclass(frozen=True, eq=False)
class ReferenceControl:
    """Control from a reference, where any view was matched, and the result of each view."""

    control: Reference | None
    views: tuple[ViewMatch, ...]
    step: float  # resolution at which they were matched [m]
    sigma: float  # standard deviation of its own place, along an axis [m]

    @property
    def refusal(self) -> str:
        """Reason why a reference is no control, as a clause."""
        best = max(self.views, key=lambda view: view.peak, default=ViewMatch("", 0.0, (0.0, 0.0)))
        if best.peak < PEAK:
            return (
                f"does not show what the images show (its highest peak has {best.peak:.1f} standard deviations, "
                f"{PEAK:g} are needed)"
            )
        tried, passed = sum(view.tried for view in self.views), max(view.passed for view in self.views)
        return (
            f"shows the place of the images (its highest peak has {best.peak:.1f} standard deviations), but "
            f"of {tried} points looked for there no {_MIN_AGREEING_POINTS} of an image agree with "
            f"each other ({passed} found at most)"
        )


@dataclass(frozen=True)
class Accuracy:
    """Standard deviations of a reference [m].

    Parameters
    ----------
    place : float, optional, of the orthoimages' own place; None: a quarter of their pixel, but at least half a metre
    height, heights : float, of single heights of the terrain, and of all together
    """

    place: float | None = None
    height: float = 10.0
    heights: float = 5.0


DEFAULT_REFERENCE_ACCURACY = Accuracy()


def register_views(
    views: Sequence[View],
    paths: Sequence[str],
    terrain: Terrain,
    band: int,
    accuracy: Accuracy = DEFAULT_REFERENCE_ACCURACY,
    work: Work = HERE,
) -> ReferenceControl:
    """Register views to orthoimages and a terrain.

    Parameters
    ----------
    views, band : sequence of View, int, images, and which band of them
    paths : sequence of str, orthoimages with a CRS; where several show a place, the first
    terrain : callable, lon, lat (n,) [deg] -> altitude [m above the ellipsoid], NaN outside
    accuracy : Accuracy, of the orthoimages and the terrain
    work : Work, who works on it
    """
    sheets = [Sheet.read(path) for path in paths]
    middles = [_on_terrain(view, terrain, (np.array([view.size]) - 1.0) / 2.0)[0] for view in views]
    known = [middle[:2] for middle in middles if np.isfinite(middle).all()]
    pixels = [min(sheet.step(place) for sheet in sheets) for place in known]
    own = [float(ground_sample_distance(view.sensor, _middle(view))[1]) for view in views]
    found = _ReferenceWork(tuple(views), sheets, terrain, band, max(pixels + own), work)
    place = max(0.5, 0.25 * max(pixels, default=0.0)) if accuracy.place is None else accuracy.place
    return found.search(found.vote(), replace(accuracy, place=place))


# --- tasks ------------------------------------------------------------------------------------------------


def vote(view: View, band: int, paths: tuple[str, ...], patch: Patch, reach: int) -> FloatImage | None:
    """Correlate a block of an image, the middle of a patch, with the reference at shifts of up to `reach` px.

    (2 reach + 1, 2 reach + 1) correlations; None where it or the reference shows nothing.
    """
    template = of_image(view, band, patch)[:, reach:-reach, reach:-reach]
    if picture_share(template) < _MIN_PICTURE_SHARES[0]:
        return None
    area = of_reference(paths, patch)
    return None if picture_share(area) < _MIN_PICTURE_SHARES[1] else correlation(template[None], area[None])[0]


def search(
    view: View, band: int, paths: tuple[str, ...], patch: Patch, points: Array, reach: int
) -> tuple[Array, BoolArray]:
    """Match points x, y (n, 2) [px] of the reference on a patch with an image: shifts, and whether they beat decoys."""
    tile = PatchTile.same((of_reference(paths, patch), of_image(view, band, patch)), points, reach, HALF)
    place, ok, score = tile.found()
    return place - tile.at, ok & (score > tile.decoys() + _DECOY_MARGIN) & tile.shown(place) & tile.returns(place)


# --- all of it --------------------------------------------------------------------------------------------


def _middle(view: View) -> Array:
    return view.sensor.localize((np.array(view.size) - 1.0) / 2.0, np.array(view.altitude))


def _on_terrain(view: View, terrain: Terrain, image: Array) -> Array:
    """Return the ground points (n, 3) that pixels (n, 2) show, NaN where the terrain is unknown."""
    ground = view.sensor.localize(image, np.full(len(image), view.altitude))
    for _ in range(6):
        ground = view.sensor.localize(image, terrain(ground[:, 0], ground[:, 1]))
    return ground


def peak(votes: Sequence[FloatImage | None]) -> tuple[float, Array]:
    """Return the height of the peak of summed votes in standard deviations, and its place x, y from the middle."""
    cast = [one for one in votes if one is not None]
    if not cast:
        return 0.0, np.zeros(2)
    total = np.sum(cast, axis=0, dtype=np.float64)
    middle = np.median(total)
    spread = robust_spread(total.ravel(), middle)
    row, col = np.unravel_index(total.argmax(), total.shape)
    z = float((total.max() - middle) / spread) if spread > 0 else 0.0
    return z, np.array([col, row], dtype=np.float64) - total.shape[0] // 2


@dataclass(frozen=True, eq=False)
class _PointTile:
    """Points of a view that are searched together."""

    points: IntArray  # which
    patch: Patch
    at: Array  # where on it they are, x, y (n, 2) [px]


@dataclass(frozen=True, eq=False)
class _ReferenceWork:
    """Views, and the orthoimages and terrain that they are registered to."""

    views: tuple[View, ...]
    sheets: list[Sheet]
    terrain: Terrain
    band: int
    step: float  # of the grids [m]
    work: Work

    @property
    def paths(self) -> tuple[str, ...]:
        return tuple(sheet.path for sheet in self.sheets)

    def vote(self) -> list[tuple[float, Array]]:
        """Return, for every view, the peak of its vote and the camera's error (2,) [m]."""
        coarse = max(self.step, _VOTE_RESOLUTION)
        none = [np.zeros(2)] * len(self.views)
        found = self._votes(none, coarse, VOTE_RADIUS, "reference: vote")
        # at the border of what was tried it is the flank of a peak beyond
        found = [(0.0 if np.abs(at).max() > VOTE_RADIUS - 2.0 * coarse else z, at) for z, at in found]
        if any(z < PEAK for z, _ in found):
            found = self._from_far(found, coarse)
        if coarse == self.step:
            return found
        near = [shift for _, shift in found]
        again = self._votes(
            near, max(self.step, coarse / _VOTE_REFINEMENT), _VOTE_REFINEMENT * coarse, "reference: second vote"
        )
        return [(z, shift) for (z, _), (_, shift) in zip(found, again, strict=True)]

    def _from_far(self, found: list[tuple[float, Array]], coarse: float) -> list[tuple[float, Array]]:
        """Return the votes, of views without a peak around where a vote within `FAR_RADIUS` has one."""
        some = replace(self, views=tuple(v for v, (z, _) in zip(self.views, found, strict=True) if z < PEAK))
        step = _VOTE_REFINEMENT * coarse
        far = some._votes([np.zeros(2)] * len(some.views), step, FAR_RADIUS, "reference: far vote")
        again = some._votes([shift for _, shift in far], coarse, 2.0 * step, "reference: vote")
        # the places of one peak are few: both must tell
        better = iter((z, at) if min(z, y) >= PEAK else None for (y, _), (z, at) in zip(far, again, strict=True))
        return [one if one[0] >= PEAK else next(better) or one for one in found]

    def _votes(self, moved: Sequence[Array], step: float, reach: float, stage: str) -> list[tuple[float, Array]]:
        px, tasks, ends = int(np.ceil(reach / step)), [], [0]
        for view, shift in zip(self.views, moved, strict=True):
            tasks += [(view, self.band, self.paths, patch, px) for patch in self._blocks(view, shift, step, px)]
            ends.append(len(tasks))
        cast = self.work.ordered(vote, tasks, stage)
        peaks = [peak(cast[start:stop]) for start, stop in pairwise(ends)]
        # a block of the image that the reference shows `at` px away: the camera is off by the rest
        return [(z, shift - at * [step, -step]) for (z, at), shift in zip(peaks, moved, strict=True)]

    def _blocks(self, view: View, moved: Array, step: float, reach: int) -> list[Patch]:
        """Return the patches around blocks of an image, evenly spread, that the reference may show."""
        wide = CELL * step / float(ground_sample_distance(view.sensor, _middle(view))[1])
        axes = []
        for length in view.size:
            edge = 0.5 * min(wide, length)
            axes.append(np.linspace(edge, length - edge, int(np.clip((length - edge) // wide, 1, _BLOCKS))))
        ground = _on_terrain(view, self.terrain, np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
        ground = ground[np.isfinite(ground).all(axis=1)]
        metres = metres_per_unit(ground)[:, :2]
        places = ground[:, :2] - moved / metres
        count = CELL + 2 * reach
        corner = np.array([-0.5, 0.5]) * count * step
        seen = np.any([sheet.shows(places) for sheet in self.sheets], axis=0) if len(places) else []
        return [
            Patch.on(self.terrain, place + corner / scale, step, (count, count), moved)
            for place, scale, here in zip(places, metres, seen, strict=True)
            if here
        ]

    def search(self, votes: Sequence[tuple[float, Array]], accuracy: Accuracy) -> ReferenceControl:
        """Return the control from points searched in every view with a significant vote."""
        told = [(view, moved) for view, (z, moved) in zip(self.views, votes, strict=True) if z >= PEAK]
        far = max([VOTE_RADIUS, *(float(np.linalg.norm(moved)) for _, moved in told)])
        places, heights = self._lattice([view for view, _ in told], far)
        reach = int(np.ceil(_SEARCH[0] + _SEARCH[1] / self.step))
        tiles = [
            self._tiles(view, moved, places, heights, reach) if z >= PEAK else []
            for view, (z, moved) in zip(self.views, votes, strict=True)
        ]
        tasks = [
            (view, self.band, self.paths, tile.patch, np.rint(tile.at), reach)
            for view, own in zip(self.views, tiles, strict=True)
            for tile in own
        ]
        done = iter(self.work.ordered(search, tasks, "reference: points"))
        reports, rows = [], []
        for i, (view, (z, moved), own) in enumerate(zip(self.views, votes, tiles, strict=True)):
            none = ViewMatch(view.name, z, (float(moved[0]), float(moved[1])))
            report, kept = self._agreeing(view, none, [(tile, next(done)) for tile in own], places)
            reports.append(report)
            if kept is not None:
                rows.append((np.full(len(kept[0]), i), *kept))
        ground = np.column_stack([places, heights])
        control = self._control(ground, reports, list(zip(*rows, strict=True)), accuracy) if rows else None
        return ReferenceControl(control, tuple(reports), self.step, float(accuracy.place or 0.0))

    def _control(
        self, ground: Array, reports: Sequence[ViewMatch], columns: Sequence[Sequence[Any]], accuracy: Accuracy
    ) -> Reference:
        """Return those of the places (n, 3) that views show: by views' columns view, point, image point and sigma."""
        view_of, point, xy, xy_sigma = map(np.concatenate, columns)
        used, closed = np.unique(point, return_inverse=True)
        shown = [r.heights for r in reports if r.points and r.shows_heights(accuracy.height)]
        height, bias, sigma = max([accuracy.height, *shown]), max([accuracy.heights, *shown]), accuracy.place or 0.0
        single = np.tile([0.1 * self.step, 0.1 * self.step, height], (len(used), 1))
        names = tuple(f"reference_{n}" for n in used)
        points = GroundPoints(names, ground[used], single, closed, view_of, xy, xy_sigma)
        offset = np.array([r.offset if r.points else (np.nan, np.nan) for r in reports])
        return Reference(points, np.array([sigma, sigma, bias]), offset, (2 * HALF + 1) * self.step)

    def _lattice(self, views: Sequence[View], far: float) -> tuple[Array, Array]:
        """Return the places (n, 2) [deg] on a grid over views and `far` [m] around, where the reference is, and their
        heights (n,).
        """
        if not views:
            return np.zeros((0, 2)), np.zeros(0)
        rings = [footprint(view.sensor, view.size, view.altitude) for view in views]
        origin = np.concatenate(rings).mean(axis=0)
        metres = metres_per_unit(np.append(origin, 0.0))[:2]
        local = [(ring - origin) * metres for ring in rings]
        areas = [0.5 * abs(float((x * np.roll(y, 1) - y * np.roll(x, 1)).sum())) for x, y in (r.T for r in local)]
        apart = self.step * max(HALF // 2, round((max(areas) / GRID_POINTS[-1]) ** 0.5 / self.step))
        every = np.concatenate(local)
        low = np.floor((every.min(axis=0) - far) / apart)
        high = np.ceil((every.max(axis=0) + far) / apart)
        grid = np.meshgrid(*(apart * np.arange(a, b + 1) for a, b in zip(low, high, strict=True)))
        places = origin + np.stack(grid, axis=-1).reshape(-1, 2) / metres
        places = places[np.any([sheet.shows(places) for sheet in self.sheets], axis=0)]
        heights = self.terrain(places[:, 0], places[:, 1])
        return places[np.isfinite(heights)], heights[np.isfinite(heights)]

    def _tiles(self, view: View, moved: Array, places: Array, heights: Array, reach: int) -> list[_PointTile]:
        """Return the points of a view, tile by tile."""
        metres = metres_per_unit(np.append(places.mean(axis=0), 0.0))[:2]
        at = view.sensor.project(np.column_stack([places + moved / metres, heights]))
        edge = 0.5 * HALF * self.step / float(ground_sample_distance(view.sensor, _middle(view))[1])
        with np.errstate(invalid="ignore"):
            inside = np.flatnonzero(((at >= edge) & (at <= np.array(view.size) - 1.0 - edge)).all(axis=1))
        pad = HALF + 3 * reach + 2 * INVALID_MARGIN  # where decoys end
        tiles = []
        for rows in grouped(*np.floor(places[inside] * metres / self.step / SPAN).T):
            points = inside[rows]
            first = np.array([places[points, 0].min(), places[points, 1].max()])
            scale = metres_per_unit(np.append(first, 0.0))[:2]
            px = (places[points] - first) * scale / self.step * [1.0, -1.0] + pad
            shape = (int(px[:, 1].max()) + pad + 2, int(px[:, 0].max()) + pad + 2)
            corner = first + np.array([-pad, pad]) * self.step / scale
            tiles.append(_PointTile(points, Patch.on(self.terrain, corner, self.step, shape, moved), px))
        return tiles

    def _agreeing(
        self, view: View, report: ViewMatch, parts: Sequence[tuple[_PointTile, tuple[Array, BoolArray]]], places: Array
    ) -> tuple[ViewMatch, tuple[IntArray, Array, Array] | None]:
        """Return a view's points that agree with an affine: report; their index, image points, sigmas [px]."""
        if not parts:
            return report, None
        point = np.concatenate([tile.points for tile, _ in parts])
        shift, passed = (np.concatenate(column) for column in zip(*(found for _, found in parts), strict=True))
        report = replace(report, tried=len(point), passed=int(passed.sum()))
        middle = np.append(places[point].mean(axis=0), view.altitude)
        local = (places[point] - middle[:2]) * metres_per_unit(middle)[:2]
        sight, up = np.split(sight_enu(view.sensor, middle), [2])
        aside = max(float(np.linalg.norm(sight)), 1e-9)
        sight = sight / aside
        turned = np.stack([[sight[1], -sight[0]], sight])  # across it; along it, where the terrain's errors move points
        agreed = affine_of_shifts(local, shift * [self.step, -self.step] @ turned.T, passed, self.step)
        if agreed is None:
            return report, None
        fitted, keep, (scatter, along) = agreed
        xy = np.concatenate([tile.patch.seen(view, tile.at + part) for tile, (part, _) in parts])
        east, north = ((fitted @ turned)[keep].mean(axis=0) + report.offset).tolist()
        report = replace(report, offset=(east, north), points=int(keep.sum()), scatter=scatter)
        gsd = float(ground_sample_distance(view.sensor, middle)[1])
        report = replace(report, along=along, slope=aside / abs(float(up[0])), gsd=gsd)
        return report, (point[keep], xy[keep], np.full(int(keep.sum()), scatter / gsd))


def affine_of_shifts(
    local: Array, shift: Array, passed: BoolArray, step: float
) -> tuple[Array, BoolArray, tuple[float, float]] | None:
    """Return an affine through most shifts (n, 2) [m] at places `local` (n, 2) [m], its inliers and their sigmas.

    Its values (n, 2), which of those that `passed` (n,) agree, and the standard deviations along both axes. The search
    starts where most shifts lie together, within `SURELY` pixels of `step` [m]. None where too few agree.
    """
    if passed.sum() < _MIN_AGREEING_POINTS:
        return None
    design = np.column_stack([np.ones(len(local)), local / max(float(np.abs(local).max()), 1.0)])
    apart = np.linalg.norm(shift[passed, None] - shift[None, passed], axis=2)
    fitted = np.broadcast_to(shift[passed][(apart < SURELY * step).sum(axis=1).argmax()], shift.shape)
    scale, keep = np.full(2, step), passed
    for _ in range(NEWTON_STEPS):
        keep = passed & (np.abs(shift - fitted) < SURELY * scale).all(axis=1)
        if keep.sum() < _MIN_AGREEING_POINTS:
            return None
        fitted = design @ np.linalg.lstsq(design[keep], shift[keep], rcond=None)[0]
        scale = robust_spread((shift - fitted)[keep].T).clip(MAD * 0.02 * step)
    return fitted, keep, (float(scale[0]), float(scale[1]))
