"""A finished run as exports need it: images, corrected RPCs, tie points, and a metric frame on the ground."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from barpc.base.errors import BarpcError, InputError
from barpc.base.geodesy import Array, Box, ecef_from_ground, enu_basis, ground_from_ecef, wrap_longitude
from barpc.base.remote import is_url
from barpc.base.safe_io import plain_path
from barpc.rasters.raster import open_raster, sources_of
from barpc.report.compare import is_own, written_rpc
from barpc.report.finished import FinishedRun
from barpc.report.ranking import sure_pairs
from barpc.report.runfiles import RunFiles
from barpc.report.summary import Summary
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.rpcio import CARRIERS
from barpc.rpcio.acquisition import Acquisition, read_acquisition
from barpc.scene import IntArray
from barpc.sensor.centers import camera_center
from barpc.sensor.geometry import footprint
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import GRID_NODES, Sample, image_grid
from barpc.sensor.triangulation import triangulate

ALTITUDE_MARGIN = 20.0
"""m that the altitudes of a scene reach beyond its tie points, besides a tenth of their range."""
_TAIL_PERCENT = 0.5  # per cent of the tie points at either end that do not count for it


@dataclass(frozen=True, eq=False)
class Shot:
    """An image of a run with its corrected camera.

    `entry`: its record in `run`, the newest that used it; `writer`: the newest run that wrote its camera, into the
    files `written`; `file`: the image, or its URL; `carrier`: the VRT or copy of those with the RPC in it, if there is
    one; `index` (n,), `xy` (n, 2): its tie points, places among the scene's points, and where it shows them [px].
    """

    entry: ViewEntry
    run: FinishedRun
    rpc: RPC
    writer: FinishedRun
    written: tuple[str, ...]
    file: str
    carrier: Path | None
    light: Acquisition
    index: IntArray
    xy: Array

    @property
    def name(self) -> str:
        """Name of the image in the run."""
        return self.entry.name

    @property
    def size(self) -> tuple[int, int]:
        """Width, height [px]."""
        return self.entry.size


@dataclass(frozen=True, eq=False)
class Scene:
    """A run: its shots in order, pairs, tie points (P, 3), lon, lat [deg], alt [m], and the altitudes that it spans."""

    run: FinishedRun
    shots: tuple[Shot, ...]
    pairs: tuple[PairEntry, ...]
    points: Array
    tracks: IntArray
    alt_range: tuple[float, float]
    noise: float
    """Standard deviation of an observed coordinate [px], by what the adjustment left."""

    @property
    def folder(self) -> Path:
        """The run's folder, as given."""
        return self.run.folder

    @property
    def summary(self) -> Summary:
        """The run's summary."""
        return self.run.summary

    @cached_property
    def origin(self) -> Array:
        """Lon, lat [deg], alt [m] of the frame's origin."""
        middle = sum(self.alt_range) / 2
        rings = [footprint(shot.rpc, shot.size, middle) for shot in self.shots]
        places = np.concatenate(rings) if not len(self.points) else self.points[:, :2]
        lon = wrap_longitude(places[:, 0], places[0, 0])
        return np.array([wrap_longitude((lon.min() + lon.max()) / 2), np.median(places[:, 1]), middle])

    @property
    def world_to_ecef(self) -> Array:
        """The matrix (4, 4) that takes east, north, up of the origin [m] to ECEF."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = enu_basis(self.origin).T, ecef_from_ground(self.origin)
        return matrix

    def world(self, ground: Array) -> Array:
        """Return the east, north, up (N, 3) of the origin [m] of ground points (N, 3)."""
        away = ecef_from_ground(ground) - ecef_from_ground(self.origin)
        return np.asarray(away @ enu_basis(self.origin).T)

    def samples(self, shot: Shot, part: Box | None = None, checked: bool = False) -> Sample:
        """Return the points over an image, or a part of it, and altitudes; to measure errors on, more of them."""
        nodes = (2 * GRID_NODES[0] - 1, 2 * GRID_NODES[1] - 1) if checked else GRID_NODES  # between them, too
        col, row, *size = part or (0, 0, *shot.size)
        image, alt = image_grid((size[0], size[1]), self.alt_range, nodes)
        image += [col, row]
        ground = shot.rpc.localize(image, alt)
        known = np.isfinite(ground).all(axis=1)
        if known.sum() < 12:
            raise InputError(f"{shot.name}: its RPC sees no ground between {self.alt_range} m")
        return Sample(self.world(ground[known]), image[known])

    def middle(self, shot: Shot) -> Array:
        """Return the ground (3,) in the middle of a shot, at the altitude of the origin."""
        return np.asarray(shot.rpc.localize((np.array(shot.size) - 1.0) / 2, np.array(self.origin[2])))

    def sight_of(self, shot: Shot) -> tuple[Array, float]:
        """Return the unit vector (3,) in the world from a shot's ground middle to its sensor, and the distance [m]."""
        away = camera_center(shot.rpc, shot.size, self.alt_range).ecef - ecef_from_ground(self.middle(shot))
        far = float(np.linalg.norm(away))
        return enu_basis(self.origin) @ away / far, far

    def file_names(self, out: Path) -> list[str]:
        """Return the images' names for files in `out`: file names where all lie in one folder, else relative paths."""
        if len({PurePath(shot.file).parent for shot in self.shots}) == 1:
            return [PurePath(shot.file).name for shot in self.shots]
        return [relative_link(shot.file, out) for shot in self.shots]


def _check_names(folder: Path, *names: str) -> None:
    """Raise InputError, which names the summary, for names that not every tool takes."""
    for name in names:
        try:
            plain_path(name)
        except InputError as error:
            raise InputError(f"{folder / 'summary.json'}: {error}") from error


def relative_link(target: Path | str, folder: Path) -> str:
    """Return the path of a file relative to a folder, with slashes, so that both may move; a URL as it is."""
    if is_url(str(target)):
        return str(target)
    absolute = os.path.abspath(target)  # noqa: PTH100  (no link is followed: it may be meant)
    return Path(os.path.relpath(absolute, folder.absolute())).as_posix()


def read_scene(folder: Path, alt_range: tuple[float, float] | None = None, of_images: bool = True) -> Scene:
    """Read the scene of a run folder; altitudes [m] by its tie points unless they are given.

    A run that added images to another (`--add-to`) has the images of both, and the tie points of both, intersected with
    the cameras as the newest run that wrote them has them. Without `of_images` these are not asked for, and nothing is
    known of their light.

    Raises
    ------
    InputError
        No finished adjustment, without RPC files, or one whose files contradict each other or were changed since; with
    `of_images`, an image that was.
    """
    run = FinishedRun.open(folder)
    if run.summary.kind != "adjust":
        raise InputError(f"{folder / 'summary.json'}: a run of the kind {run.summary.kind}, without corrected cameras")
    shots, pairs, ties = list[Shot](), dict[frozenset[str], PairEntry](), list[_Ties]()
    for one in run.lineage:
        ties.append(_Ties.of(one))
        pairs = {frozenset((pair.a, pair.b)): pair for pair in one.summary.pairs} | pairs
        known = {shot.name for shot in shots}
        shots += [_shot(run, one, view, of_images) for view in one.summary.views if view.name not in known]
    number = {shot.name: i for i, shot in enumerate(shots)}
    view, point, xy = (np.concatenate(part) for part in zip(*_rows_of(ties, number), strict=True))
    points = np.concatenate([one.points for one in ties])
    if len(ties) > 1:
        middle = float(np.median(points[:, 2])) if len(points) else 0.0
        found = triangulate([shot.rpc for shot in shots], view, point, xy, alt=middle)
        points = ground_from_ecef(np.concatenate([found.points, np.full((len(points) - len(found.points), 3), np.nan)]))
    if alt_range is None:
        alt_range = _scene_altitudes(points[np.isfinite(points[:, 2]), 2], run.summary)
    for i, shot in enumerate(shots):
        rows = view == i
        shots[i] = replace(shot, index=point[rows], xy=xy[rows])
    tracks = ties[0].tracks if len(ties) == 1 else np.arange(len(points))
    return Scene(run, tuple(shots), tuple(pairs.values()), points, tracks, alt_range, ties[0].noise)


@dataclass(frozen=True, eq=False)
class _Ties:
    """Tie points of a run in use: their numbers (P,) and places (P, 3); observations (K,): name of the image, index of
    the point, position; `noise` as of a `Scene`.
    """

    tracks: IntArray
    points: Array
    names: Sequence[str]
    view: IntArray
    index: IntArray
    xy: Array
    noise: float

    @classmethod
    def of(cls, run: FinishedRun) -> _Ties:
        files = run.tables()
        order = np.argsort(files.tracks, kind="stable")
        index, found = _positions_in(files.tracks[order], files.observations.track)
        counted = np.flatnonzero(found & files.observations.used)
        seen = files.observations.view[counted], order[index[counted]], files.observations.xy[counted]
        names = [view.name for view in run.summary.views]
        return cls(files.tracks, files.points[:, :3], names, *seen, _noise(files, counted))


def _rows_of(ties: Sequence[_Ties], number: Mapping[str, int]) -> Iterator[tuple[IntArray, IntArray, Array]]:
    """Yield the observations of each run's tie points by numbers of all images and all points."""
    before = 0
    for one in ties:
        places = np.array([number[name] for name in one.names], dtype=np.int64)
        yield places[one.view], one.index + before, one.xy
        before += len(one.points)


def _shot(newest: FinishedRun, run: FinishedRun, view: ViewEntry, of_images: bool) -> Shot:
    """Return an image with its corrected camera, without tie points."""
    folder = run.folder
    _check_names(folder, view.name, view.path)
    if PurePath(view.name).name != view.name or view.name == "..":
        raise InputError(f"{folder / 'summary.json'}: an image is called {view.name}, no name of a file")
    writer, files, rpc = _newest_rpc(newest, run, view)
    file, light = str(run.sealed.located(view.path)), Acquisition()
    if of_images:
        file, source = (run.input(path) for path in (view.path, view.rpc_source.path if view.rpc_source else ""))
        light = _acquisition_of(view, file, source)
    none: IntArray = np.empty(0, dtype=np.int64)
    carrier = _carrier(writer, view.name, files)
    return Shot(view, run, rpc, writer, files, file, carrier, light, none, np.empty((0, 2)))


def _acquisition_of(view: ViewEntry, file: str, source: str) -> Acquisition:
    """Return the sensor, time and sun of an image by its files; the day that the run was given where these state none.

    The date of a TIFF is that of the file: it is none of an acquisition.
    """
    tags: Mapping[str, str] = {}
    if not is_url(file):
        with suppress(BarpcError), open_raster(file) as dataset:
            tags = dataset.tags()
    light = read_acquisition(file, source or None, tags)
    return light if light.time or view.date == light.day(tags) else replace(light, time=view.date)


def _newest_rpc(newest: FinishedRun, run: FinishedRun, view: ViewEntry) -> tuple[FinishedRun, tuple[str, ...], RPC]:
    """Return the newest run that wrote the camera of an image, the files there that hold it, and its RPC."""
    of_view = [one for before in run.lineage for one in before.summary.views if one.name == view.name]
    names = tuple(dict.fromkeys(name for one in of_view for name in one.outputs))
    for one in newest.lineage:
        files = tuple(name for name in names if name in one.sealed.listed)
        if (rpc := written_rpc(one, files)) is not None:
            return one, files, rpc
    raise InputError(f"{run.folder / 'summary.json'}: names no RPC file of {view.name} that can be read: run it again")


def _positions_in(known: IntArray, asked: IntArray) -> tuple[IntArray, Any]:
    """Return the positions of numbers (K,) in an ascending list, and whether they are in it."""
    if not len(known):
        return np.zeros(len(asked), dtype=np.int64), np.zeros(len(asked), dtype=bool)
    at = np.minimum(np.searchsorted(known, asked), len(known) - 1)
    return at, known[at] == asked


def _scene_altitudes(alt: Array, summary: Summary) -> tuple[float, float]:
    """Return the altitudes of a scene: those of its tie points and a margin, or of its cameras without any."""
    if not len(alt):
        ranges = np.array([view.alt_range_m for view in summary.views])
        return float(ranges[:, 0].min()), float(ranges[:, 1].max())
    low, high = np.percentile(alt, [_TAIL_PERCENT, 100.0 - _TAIL_PERCENT])
    margin = ALTITUDE_MARGIN + 0.1 * (high - low)
    return float(np.floor(low - margin)), float(np.ceil(high + margin))


def _carrier(run: FinishedRun, image: str, written: Collection[str]) -> Path | None:
    """Return the raster with the corrected RPC that a run wrote for an image, in its own folder."""
    for name in (image + end for row in CARRIERS.values() for end in row.suffixes):
        if name in written and is_own(run.folder, name):
            path = run.sealed.file(name).absolute()
            with suppress(InputError):  # of a run that was moved without its images, whose VRTs show none
                for source in sources_of(path):
                    run.ask(source)
                return path
    return None


def _noise(files: RunFiles, counted: Any) -> float:
    """Return the standard deviation [px] of a coordinate: residuals over their degrees of freedom."""
    left = files.observations.after[counted]
    left = left[np.isfinite(left).all(axis=1)]
    free = left.size - 3 * len(np.unique(files.observations.track[counted]))
    return float(np.sqrt(np.square(left).sum() / free)) if free > 0 else float("nan")


def pairs_of(scene: Scene) -> Sequence[tuple[str, str]]:
    """Return the pairs that stereo is made of: of images without reservation, at an angle that shows heights; else all.

    Of those under such an angle: two images without reservation with enough matches, where there are any.
    """
    shown = [pair for pair in scene.pairs if 2.0 <= (pair.convergence_deg or 0.0) <= 50.0]
    sure = sure_pairs([shot.entry for shot in scene.shots], shown)
    return [(pair.a, pair.b) for pair in sure or shown or scene.pairs]
