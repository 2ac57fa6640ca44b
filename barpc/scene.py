"""The data that travels between the halves of barpc: cameras, views, tracks, ground points.

Frozen records of plain float64 arrays. `tie` makes tracks, `ba` reads them; neither knows the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from barpc.base.errors import InputError, RpcError
from barpc.base.frozen import Frozen
from barpc.base.geodesy import Array, HeightDatum
from barpc.base.geodesy import BoolArray as BoolArray
from barpc.base.geodesy import IntArray as IntArray
from barpc.base.remote import PathOrUrl
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC

SIGMA_RANGE = 1e-6, 1e9
"""Standard deviations of ground points [m, px] whose squares can be reckoned with."""

Terrain = Callable[[Array, Array], Array]
"""lon, lat (...) [deg] -> altitude (...) [m above the ellipsoid], NaN where it is unknown."""


@dataclass(frozen=True)
class Doubt:
    """A reason why a camera is not that of its image: a sentence on the image; `refused`: the camera is of no use."""

    sentence: str
    refused: bool = False


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera and where it came from."""

    model: SensorModel
    path: PathOrUrl
    """The file that holds it: what was given, or a file beside it."""
    format: str
    """What that file is: ``tag``, ``nitf``, a row of `barpc.rpcio.FORMATS`, or another row of `OPENERS`."""
    size: tuple[int, int] | None
    """Width, height [px] of the image; None where nothing states them."""
    alt_range: tuple[float, float]
    """The altitudes [m above the ellipsoid] that it is made for."""
    notes: tuple[str, ...] = ()
    """What the user should know."""
    doubts: tuple[Doubt, ...] = ()
    """Reasons why it is not the camera of its image, the worst first (`barpc.rpcio.plausible`)."""
    sensor: str = ""
    """The sensor and band that the metadata state (WV02_P, PHR1B_PAN); empty where they do not, or none were read."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the user should know, doubts included, in sentences."""
        return (*self.notes, *(doubt.sentence for doubt in self.doubts))

    def require_usable(self, image: PathOrUrl | str) -> None:
        """Raise RpcError where it is of no use for its image."""
        for doubt in self.doubts:
            if doubt.refused:
                raise RpcError(f"{image}: {doubt.sentence}: give the RPC of these pixels (IMAGE,camera=FILE)")

    def __repr__(self) -> str:
        place = self.path if len(str(self.path)) <= 50 else self.path.name
        return f"Camera({self.format} in {place}, size {self.size}, {self.model})"

    @property
    def rpc(self) -> RPC:
        """The RPC, where the model is one; InputError where it is not."""
        if isinstance(self.model, RPC):
            return self.model
        raise InputError(f"{self.path}: a camera of the kind {self.format}, no RPC; make one with 'barpc fit'")

    @property
    def extent(self) -> tuple[int, int]:
        """The image's size [px]; InputError where it is not known."""
        if self.size is None:
            raise InputError(f"{self.path}: a camera without its image; give the size: FILE,size=WIDTH:HEIGHT")
        return self.size

    @property
    def altitude(self) -> float:
        """Middle of the camera's altitudes [m]."""
        return (self.alt_range[0] + self.alt_range[1]) / 2


@dataclass(frozen=True, eq=False, repr=False)
class View(Frozen):
    """One image and its camera.

    Parameters
    ----------
    name : str, unique in a run: the file's stem, with its folder where stems repeat
    path : str, absolute path of the raster; empty for a view without pixels
    size : (int, int), width, height [px]
    sensor : SensorModel, the camera as delivered
    alt_range : (float, float), altitudes [m above the ellipsoid] that the camera is used for
    date : str, the day the image was taken (2013-04-17); empty where nobody says

    Examples
    --------
    >>> rpc = barpc.read_rpc("data_samples/view_00.tif")
    >>> barpc.View("view_00", "data_samples/view_00.tif", (1000, 1000), rpc, (-50.0, 550.0))
    View('view_00', 1000 x 1000 px, RPC for -50 to 550 m)
    """

    name: str
    path: str
    size: tuple[int, int]
    sensor: SensorModel
    alt_range: tuple[float, float]
    date: str = ""

    def __post_init__(self) -> None:
        if min(self.size) < 1:
            raise InputError(f"{self.name}: size {self.size} is empty")
        if not (np.isfinite(self.alt_range).all() and self.alt_range[0] <= self.alt_range[1]):
            raise InputError(f"{self.name}: altitude range {self.alt_range} is not an interval")

    @property
    def altitude(self) -> float:
        """Middle of the view's altitudes [m]."""
        return sum(self.alt_range) / 2.0

    def _told(self) -> str:
        (width, height), (low, high) = self.size, self.alt_range
        what = f"{self.name!r}, {width} x {height} px, {type(self.sensor).__name__} for {low:g} to {high:g} m"
        return f"{what}, {self.date}" if self.date else what


@dataclass(frozen=True, eq=False, repr=False)
class Tracks(Frozen):
    """Tie points over the views, one row an observation.

    Parameters
    ----------
    view : (K,), index of the view
    point : (K,), index of the track, 0 .. P-1; rows of one track stand together, views ascending
    xy : (K, 2), col, row [px]
    sigma : (K,), standard deviation of each coordinate [px]

    Examples
    --------
    >>> barpc.Tracks([0, 1], [0, 0], [[10.0, 20.0], [11.0, 21.0]], [0.3, 0.3])
    Tracks(1 tie points, ...)
    """

    view: IntArray
    point: IntArray
    xy: Array
    sigma: Array

    def __post_init__(self) -> None:
        view = self._array("view", (None,), dtype=np.int64)
        k = len(view)
        self._array("point", (k,), dtype=np.int64)
        self._array("xy", (k, 2))
        sigma = self._array("sigma", (k,))
        if not (sigma > 0).all():
            raise InputError("tracks: coordinates must be finite and sigmas positive")
        if k and (view.min() < 0 or self.point.min() < 0):
            raise InputError("tracks: negative view or track index")

    def __len__(self) -> int:
        return len(self.view)

    def _told(self) -> str:
        return f"{self.num_points} tie points, {_observation_words(self.view, self.sigma)}"

    @property
    def num_points(self) -> int:
        """Number of tracks P."""
        return int(self.point.max()) + 1 if len(self.point) else 0

    def select(self, keep: BoolArray) -> Tracks:
        """Return the observations of a mask (K,); tracks left with fewer than two views go, indices close up."""
        count = np.bincount(self.point[keep], minlength=self.num_points)
        keep = keep & (count[self.point] >= 2)
        _, point = np.unique(self.point[keep], return_inverse=True)
        return Tracks(self.view[keep], point, self.xy[keep], self.sigma[keep])


@dataclass(frozen=True, eq=False, repr=False)
class GroundPoints(Frozen):
    """Points of known position (GCPs or check points), and where they are seen.

    Parameters
    ----------
    names : tuple of str, one a point
    lonlatalt : (G, 3), lon, lat [deg], alt [m above the ellipsoid]
    sigma : (G, 3), east, north, up standard deviation [m]
    point, view : (M,), observations: index of the ground point, index of the view
    xy : (M, 2), col, row [px]
    xy_sigma : (M,), standard deviation of each coordinate [px]
    strangers : tuple of str, images that their file names and that are none of the views
    left_out : tuple of str, points left out of their files, with the reason, in sentences
    said : tuple of str, how their files were read, where that had to be guessed or converted, in sentences
    datums : tuple of HeightDatum, what the altitudes of their files were taken to count from, where no person said it

    Examples
    --------
    >>> place = {"lonlatalt": [[5.4, 43.3, 120.0]], "sigma": [[1.0, 1.0, 2.0]]}
    >>> barpc.GroundPoints(("A",), **place, point=[0], view=[0], xy=[[509.8, 494.6]], xy_sigma=[0.3])
    GroundPoints(...)
    """

    names: tuple[str, ...]
    lonlatalt: Array
    sigma: Array
    point: IntArray
    view: IntArray
    xy: Array
    xy_sigma: Array
    strangers: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    said: tuple[str, ...] = ()
    datums: tuple[HeightDatum, ...] = ()

    def __post_init__(self) -> None:
        g = len(self.names)
        self._array("lonlatalt", (g, 3))
        sigma = self._array("sigma", (g, 3), finite=False)
        point = self._array("point", (None,), dtype=np.int64)
        m = len(point)
        self._array("view", (m,), dtype=np.int64)
        self._array("xy", (m, 2), finite=False)
        xy_sigma = self._array("xy_sigma", (m,), finite=False)
        low, high = SIGMA_RANGE
        if not all(((spread >= low) & (spread <= high)).all() for spread in (sigma, xy_sigma)):
            raise InputError(f"ground points: sigmas positive, from {low:g} to {high:g}, are needed")
        if m and (point.min() < 0 or point.max() >= g):
            raise InputError("ground points: an observation names a point that does not exist")

    def _told(self) -> str:
        return f"{len(self.names)} points, {_observation_words(self.view, self.xy_sigma)}"

    @classmethod
    def none(cls) -> GroundPoints:
        """Return an empty set of points."""
        index, places = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        return cls((), places, places, index, index, np.zeros((0, 2)), np.zeros(0))

    def select(self, keep: BoolArray) -> GroundPoints:
        """Return the points of a mask (G,) with their observations."""
        rows = keep[self.point]
        return replace(
            self,
            names=tuple(name for name, kept in zip(self.names, keep, strict=True) if kept),
            lonlatalt=self.lonlatalt[keep],
            sigma=self.sigma[keep],
            point=(np.cumsum(keep) - 1)[self.point[rows]],
            view=self.view[rows],
            xy=self.xy[rows],
            xy_sigma=self.xy_sigma[rows],
        )


@dataclass(frozen=True, eq=False, repr=False)
class Reference(Frozen):
    """Control points from an orthoimage and a terrain, which share the errors of both.

    Parameters
    ----------
    points : GroundPoints, their sigmas without the errors in common
    bias : (3,), standard deviation of what all of them are wrong by together, east, north, up [m]
    offset : (N, 2), how far each view was found to be off as delivered, east, north [m]; NaN where it was not matched
    width : float, of the templates that its points were found with [m]: nearer ones share part of their noise
    """

    points: GroundPoints
    bias: Array
    offset: Array
    width: float = 0.0

    def __post_init__(self) -> None:
        if not (self._array("bias", (3,)) > 0).all():
            raise InputError("reference: standard deviations must be positive")
        self._array("offset", (None, 2), finite=False)
        if not 0.0 <= self.width < np.inf:
            raise InputError("reference: its templates are as wide as they are, 0 m or more")


@dataclass(frozen=True, eq=False, repr=False)
class Altimetry(Frozen):
    """Heights of the ground from altimetry (a laser), without image coordinates.

    Parameters
    ----------
    lonlatalt : (A, 3), lon, lat [deg], alt [m above the ellipsoid]
    sigma : (A,), standard deviation of the altitude [m]
    sigma_flat : (A,), standard deviation of the place along an axis, each point's own [m]
    datums : tuple of HeightDatum, what is known of what the altitudes count from, where no person said it
    """

    lonlatalt: Array
    sigma: Array
    sigma_flat: Array
    datums: tuple[HeightDatum, ...] = ()

    def __post_init__(self) -> None:
        count = len(self._array("lonlatalt", (None, 3)))
        sigma, flat = self._array("sigma", (count,)), self._array("sigma_flat", (count,))
        low, high = SIGMA_RANGE
        if not ((sigma >= low) & (sigma <= high) & (flat >= 0.0) & (flat <= high)).all():
            raise InputError(f"altimetry: sigmas positive, from {low:g} to {high:g}, are needed")

    def _told(self) -> str:
        return f"{len(self.sigma)} heights"


def _observation_words(view: IntArray, sigma: Array) -> str:
    """Return the observations in a few words."""
    if not len(view):
        return "no observations"
    return f"{len(view)} observations in {len(np.unique(view))} views, to {np.median(sigma):.2g} px"


def row_pairs(label: IntArray, most: float = np.inf) -> IntArray:
    """Return all pairs (2, n) of rows with equal labels, which stand together, at most `most` rows apart."""
    found, step = [np.empty((2, 0), np.int64)], 1
    while step < len(label) and step <= most and len(rows := np.flatnonzero(label[step:] == label[:-step])):
        found.append(np.stack([rows, rows + step]))
        step += 1
    return np.concatenate(found, axis=1)


def middle_altitude(views: Sequence[View]) -> float:
    """Return the mean of the views' middle altitudes [m], where triangulation starts."""
    return float(np.mean([view.alt_range for view in views]))


def connected_labels(num: int, links: npt.ArrayLike) -> IntArray:
    """Return the connected component (num,) of each node, numbered by its first; links (M, 2) join two."""
    first, second = np.asarray(links, dtype=np.int64).reshape(-1, 2).T
    label = np.arange(num)
    while True:  # the least of both for both and where they point to, and from there on: as often as log2 of the chain
        least, now = np.minimum(label[first], label[second]), label.copy()
        for place in (first, second, label[first], label[second]):
            np.minimum.at(now, place, least)
        now = now[now]
        if (now == label).all():
            return np.unique(label, return_inverse=True)[1].astype(np.int64)
        label = now


def connected_groups(num_views: int, pairs: Sequence[tuple[int, int]]) -> list[list[int]]:
    """Return the connected components of the views, the largest first (then by first view); each ascending."""
    groups: dict[int, list[int]] = {}
    for view, label in enumerate(connected_labels(num_views, pairs).tolist() if num_views else []):
        groups.setdefault(label, []).append(view)
    return sorted(groups.values(), key=lambda g: (-len(g), g[0]))
