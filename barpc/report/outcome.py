"""Results of a run, and the derived figures of its tie points."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.evidence.scan import CheckTies, ImageRegion, worst_regions
from barpc.ba.interior import Calibration
from barpc.base.geodesy import CHUNK, Array, HeightDatum, ground_from_ecef
from barpc.base.options import RunOptions
from barpc.base.statistics import CRITICAL
from barpc.fit import RpcFit
from barpc.report.ranking import SMOOTH_LEFT
from barpc.scene import BoolArray, Camera, GroundPoints, IntArray, Tracks, View, middle_altitude
from barpc.sensor import SensorModel
from barpc.sensor.centers import CameraCenter
from barpc.sensor.geometry import Several
from barpc.sensor.image_corrections import Calibrated, ImageAffine, ImageCorrected
from barpc.sensor.triangulation import Triangulation, triangulate
from barpc.tie import PairReport, ReferenceControl
from barpc.tie.detail import Gap, gap, in_parts
from barpc.tie.matchers.report import FINE_STRUCTURE

MAX_TRACKS = 200_000
"""Of more tracks, every n-th is written, so that the files of a huge run can still be opened."""
WHOLE_PIXEL_TOLERANCE, MIN_WHOLE_SHARE = 0.05, 0.9
"""A whole shift [px], and the share of a pair's matches, `MIN_COPY_MATCHES` or more, that must have it."""
COPIED = 0.5  # of the smaller image: less is what two frames of a pass have in common
MIN_COPY_MATCHES = 20  # Of others a hundredth lies at a whole shift by chance: 18 of 20 never do
WHOLE_PIXELS = 12**-0.5  # px: standard deviation of rounding to whole pixels, alike where images are shifted alike
LEAST_MOVED = 0.1  # px over an eighth of an image: a finding that moves what is handed over by less is a remark
MANY_REJECTED = 0.3  # A view that lost a larger share of its observations, not at random, is called doubtful


@dataclass(frozen=True, eq=False)
class PairTies:
    """The observations that two views, ascending, have in common: rows a, b (M,) of the tracks."""

    views: tuple[int, int]
    a: IntArray
    b: IntArray


@dataclass(frozen=True)
class ControlResidual:
    """A residual of a known point in an image: view, name of the point, Baarda's w."""

    view: int
    point: str
    w: float


@dataclass(frozen=True)
class Added:
    """Effect of added images on those of a finished run."""

    run: str  # name of its folder
    images: int  # that it has
    met: int  # of these, tied to new ones
    beyond: tuple[tuple[str, float], ...]  # those that move by more than the floor with all cameras free [px]
    largest: tuple[str, float]  # the one that moves farthest, and by how much [px]
    floor: float  # [px]
    updated: bool  # whether the cameras of those that move are written; else all were held
    contradicted: tuple[str, float, float] | None = None
    """An image whose check tie points contradict cameras held: RMS as written and with all cameras free [px]."""


@dataclass(frozen=True, eq=False)
class Carried:
    """An image that has the camera of another, up to a scale and a shift in the image, and gets its correction."""

    view: View
    source: Camera
    lead: str  # name of the view whose correction it gets
    step: Array  # (2,) pixels of this image a pixel of the lead's
    start: Array  # (2,) place of the lead's first pixel in this image [px]
    fit: RpcFit | None = None
    written: Mapping[str, Mapping[str, float | str]] = field(default_factory=dict)  # as of a `Run`

    def camera(self, lead: SensorModel) -> SensorModel:
        """Return the camera of this image by that of its lead."""
        return ImageCorrected(lead, ImageAffine(self.start, np.diag(self.step - 1.0)))


@dataclass(frozen=True, eq=False)
class Run:
    """The results of a run.

    `sources`: cameras as opened (empty: not from files); `matched`: reports of matched pairs (empty: given tie points);
    `adjustment`, `centers`, `fits`: of an adjustment as far as it went; `written`, per view: file, consumer that
    reopened it, largest difference to P_BA [px] or the reason without one; `left_out`: files and reasons; `stages`:
    their seconds and peak memory so far; `check_points` were not used; `reference`: matches of an orthoimage; `datums`:
    vertical datums assumed for heights that constrain the scene, if the user stated none; `detail`: density of the
    views' keypoints, from which tie points are expected.
    """

    kind: Literal["adjust", "check", "match"]
    views: tuple[View, ...]
    sources: tuple[Camera, ...]
    tracks: Tracks
    matched: tuple[PairReport, ...] = ()
    adjustment: Adjustment | None = None
    agreeing: BoolArray | None = None  # observations (K,) of a check that agree with the cameras as they are
    centers: tuple[CameraCenter, ...] = ()
    fits: tuple[RpcFit, ...] = ()
    written: tuple[Mapping[str, Mapping[str, float | str]], ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    options: RunOptions = field(default_factory=RunOptions)
    stages: Sequence[Mapping[str, Any]] = field(default_factory=list)
    out_dir: str = ""
    gcps: GroundPoints | None = None
    check_points: GroundPoints | None = None
    reference: ReferenceControl | None = None
    datums: tuple[HeightDatum, ...] = ()
    detail: tuple[IntArray, ...] = ()
    unwritten: frozenset[str] = frozenset()  # names of its images whose cameras this run leaves as they are
    added: Added | None = None
    joint: Adjustment | None = None  # with the cameras of the earlier run free, where `adjustment` holds them
    calibrated: Mapping[str, Calibration] = field(default_factory=dict)  # view -> what its sensor does in every image
    carried: tuple[Carried, ...] = ()  # other bands of its images, which get their corrections

    @property
    def known(self) -> frozenset[str]:
        """Names of the views that are images of an earlier run."""
        held = None if self.adjustment is None else self.adjustment.earlier
        return frozenset(() if held is None else held.names)

    @cached_property
    def before(self) -> tuple[SensorModel, ...]:
        """The cameras as delivered."""
        return tuple(view.sensor for view in self.views)

    @cached_property
    def after(self) -> tuple[SensorModel, ...] | None:
        """The refitted cameras; P_BA where they were not refitted; None for a check."""
        if self.fits:
            return tuple(fit.rpc for fit in self.fits)
        return None if self.adjustment is None else self.cameras

    @cached_property
    def cameras(self) -> tuple[SensorModel, ...]:
        """P_BA of every view, behind its sensor's calibration where it has one."""
        assert self.adjustment is not None
        pairs = zip(self.views, self.adjustment.sensors, strict=True)
        used = self.calibrated
        return tuple(Calibrated(one, used[v.name].spline) if v.name in used else one for v, one in pairs)

    def undistorted(self, view: IntArray, xy: Array) -> Array:
        """Return image positions (K, 2) [px] of views (K,) as cameras without a calibration have them."""
        out = xy.copy()
        for v, one in enumerate(self.views):
            if one.name in self.calibrated:
                rows = view == v
                out[rows] = self.calibrated[one.name].spline.undo(xy[rows])
        return out

    def _rows(self, name: str, none: bool = False) -> BoolArray:
        """Return a mask of the observations (K,) from the adjustment; without one all of them alike."""
        return np.full(len(self.tracks), none) if self.adjustment is None else getattr(self.adjustment, name)

    @cached_property
    def keep(self) -> BoolArray:
        """The observations (K,) in use: of an adjustment its inliers, of a check those that agree with its cameras."""
        return self._rows("inlier", none=True) if self.agreeing is None else self.agreeing

    @cached_property
    def held_out(self) -> BoolArray:
        """The observations (K,) of check tie points, which the adjustment did not use."""
        return self._rows("held_out")

    @cached_property
    def moving(self) -> BoolArray:
        """The observations (K,) of tie points that move together, which were excluded."""
        return self._rows("moving")

    @cached_property
    def gaps(self) -> dict[int, Gap]:
        """The columns or rows of views without tie points, although their detail makes these expected."""
        found, tracks = dict[int, Gap](), self.tracks
        for v, (view, detail) in enumerate(zip(self.views, self.detail, strict=False)):
            one = gap(detail, in_parts(tracks.xy[tracks.view == v], view.size), view.size)
            found |= {} if one is None else {v: one}
        return found

    @cached_property
    def met_worse(self) -> list[ImageRegion]:
        """Rows, columns and cells of images with larger residuals of check tie points than in the rest."""
        found, tracks = self.adjustment, self.tracks
        if found is None or not found.held_out.any():
            return []
        known = np.isfinite(found.held_out_noise)
        if found.apart is not None and found.apart.clear:
            known[found.apart.view] = False
        noise = np.where(known, found.held_out_noise, np.nan)
        rows = found.held_out & known[tracks.view] & np.isfinite(found.residuals).all(axis=1)
        seen = np.bincount(tracks.point[found.held_out], minlength=tracks.num_points)[tracks.point[rows]]
        # of a track's coordinates three go into its point
        free = np.maximum(2.0 * seen - 3.0, 1.0) / np.maximum(seen, 1)
        deviation = noise[tracks.view[rows]] * tracks.sigma[rows] * np.sqrt(free)
        unused = CheckTies(tracks.view[rows], tracks.xy[rows].T, found.residuals[rows].T, deviation)
        size = np.array([view.size for view in self.views], dtype=np.float64).T
        return worst_regions(unused, size, CRITICAL, SMOOTH_LEFT, MANY_REJECTED)

    @cached_property
    def beside(self) -> dict[int, int]:
        """Views of which most check tie points are also observed in a view that contradicts the others.

        View -> that view: tie points are intersected with its rays, so its errors are in the residuals of all.
        """
        view, point, num = self.tracks.view, self.tracks.point, len(self.views)
        kept = np.bincount(view[self.keep], minlength=num)
        cut = np.bincount(view[~(self.keep | self.held_out | self.moving)], minlength=num)
        held = np.bincount(view[self.held_out], minlength=num)
        found: dict[int, int] = {}
        for bad in np.flatnonzero(cut > kept).tolist():
            seen = np.zeros(self.tracks.num_points, dtype=bool)
            seen[point[view == bad]] = True
            shared = np.bincount(view[self.held_out & seen[point]], minlength=num)
            found |= {v: bad for v in np.flatnonzero(2 * shared > held).tolist() if v != bad}
        return found

    @cached_property
    def whole_pixels(self) -> frozenset[str]:
        """Names of the views with most matches at whole pixels: their rounding error may be common to all."""
        count: dict[bool, Counter[str]] = {True: Counter(), False: Counter()}
        for report in self.matched:
            for name in report.names if report.status == "ok" else ():
                count[report.matcher == FINE_STRUCTURE][name] += report.verified
        return frozenset(name for name, whole in count[True].items() if whole > count[False][name])

    @cached_property
    def control_tests(self) -> list[ControlResidual]:
        """The residuals of control and of a reference's points in the images that could be tested."""
        found, reference = self.adjustment, None if self.reference is None else self.reference.control
        if found is None:
            return []
        of_reference = None if reference is None else reference.points
        return [
            ControlResidual(int(points.view[k]), points.names[points.point[k]], float(w[k]))
            for points, w in ((self.gcps, found.gcp_w), (of_reference, found.reference_w))
            if points is not None
            for k in np.flatnonzero(np.isfinite(w)).tolist()
        ]

    @cached_property
    def number(self) -> dict[str, int]:
        """Name of a view -> its index."""
        return {view.name: i for i, view in enumerate(self.views)}

    @cached_property
    def pairs(self) -> list[PairTies]:
        """The observations that pairs of views have in common."""
        return pair_ties(self.tracks, self.keep)

    @cached_property
    def copies(self) -> dict[str, str]:
        """Views with the same pixels as another one -> that view and the shift, in words.

        Two images of one scene never match by whole pixels: only one that is a part, or a copy, of the other.
        """
        found: dict[str, str] = {}
        for ties in self.pairs:
            shift = self.tracks.xy[ties.b] - self.tracks.xy[ties.a]
            if len(shift) < MIN_COPY_MATCHES:
                continue
            whole = np.rint(np.median(shift, axis=0))
            if np.mean((np.abs(shift - whole) <= WHOLE_PIXEL_TOLERANCE).all(axis=1)) < MIN_WHOLE_SHARE:
                continue  # most pairs
            first, second = (np.array(self.views[i].size) for i in ties.views)
            common = np.minimum(first, second - whole) - np.maximum(0.0, -whole)
            if np.prod(common) < COPIED * min(np.prod(first), np.prod(second)):
                continue  # neighbouring frames of one pass
            names = [self.views[i].name for i in ties.views]
            for name, other, (col, row) in zip(names, names[::-1], (whole, 0.0 - whole), strict=True):
                found.setdefault(name, f"{other}, moved by {col:.0f} columns and {row:.0f} rows")
        return found

    @cached_property
    def ties_before(self) -> Triangulation:
        """The tie points through the delivered cameras."""
        return triangulate_tracks(self.tracks, self.before, middle_altitude(self.views), self.keep)

    @cached_property
    def ties_after(self) -> Triangulation | None:
        """The tie points through the new cameras; None for a check."""
        if self.after is None:
            return None
        return triangulate_tracks(self.tracks, self.after, middle_altitude(self.views), self.keep)

    @cached_property
    def ground(self) -> Array:
        """The tie points (P, 3), lon, lat [deg], alt [m], through the best cameras there are."""
        return ground_from_ecef((self.ties_after or self.ties_before).points)

    @property
    def written_tracks(self) -> IntArray:
        """The tracks that the tables hold: those with a ground point, evenly taken above `MAX_TRACKS`."""
        usable = np.flatnonzero(np.isfinite(self.ground).all(axis=1))
        return usable[:: -(-len(usable) // MAX_TRACKS)] if len(usable) else usable

    @cached_property
    def altitude(self) -> float:
        """Altitude of the scene [m]: the median of its tie points; without any, where they would start."""
        alt = self.ground[np.isfinite(self.ground).all(axis=1), 2]
        return float(np.median(alt)) if len(alt) else middle_altitude(self.views)


def pair_ties(tracks: Tracks, keep: BoolArray | None = None) -> list[PairTies]:
    """Return all pairs of views with tracks in common, in ascending order; `keep` (K,): the observations to count."""
    rows = np.arange(len(tracks)) if keep is None else np.flatnonzero(keep)
    rows = rows[np.lexsort((tracks.view[rows], tracks.point[rows]))]
    point = tracks.point[rows]
    found = [np.empty((2, 0), dtype=np.int64)]
    for step in range(1, int(np.bincount(point).max(initial=1))):
        together = point[step:] == point[:-step]
        found.append(np.stack([rows[:-step][together], rows[step:][together]]))
    a, b = np.concatenate(found, axis=1)
    views = np.stack([tracks.view[a], tracks.view[b]])
    order = np.lexsort((a, *views[::-1]))
    a, b, views = a[order], b[order], views[:, order]
    starts = np.flatnonzero((np.diff(views, axis=1, prepend=-1) != 0).any(axis=0))
    return [
        PairTies((int(views[0, s]), int(views[1, s])), a[s:e], b[s:e]) for s, e in pairwise([*starts.tolist(), len(a)])
    ]


def triangulate_tracks(tracks: Tracks, sensors: Sequence[SensorModel], alt: float, keep: BoolArray) -> Triangulation:
    """Return all tracks intersected through given cameras from the observations (K,) that count, starting at `alt` [m].

    The residuals of the others are measured against the same points; a track with fewer than two observations that
    count is NaN.
    """
    points, residuals = np.full((tracks.num_points, 3), np.nan), np.full((len(tracks), 2), np.nan)
    rows = np.flatnonzero(keep)
    rows = rows[np.argsort(tracks.point[rows], kind="stable")]
    point = tracks.point[rows]
    for part in np.split(rows, np.searchsorted(point, np.unique(point[CHUNK::CHUNK]))):  # of whole tracks
        own = tracks.point[part]
        first = int(own[0]) if len(own) else 0
        found = triangulate(sensors, tracks.view[part], own - first, tracks.xy[part], tracks.sigma[part], alt=alt)
        points[first : first + len(found.points)] = found.points
        residuals[part] = found.residuals
    ground = ground_from_ecef(points)
    rest = np.flatnonzero(~keep)
    projected = Several(sensors, tracks.view[rest]).project(ground[tracks.point[rest]])
    residuals[rest] = projected - tracks.xy[rest]
    return Triangulation(points, residuals, np.isfinite(points).all(axis=1))
