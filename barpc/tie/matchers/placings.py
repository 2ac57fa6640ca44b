"""Placings of a picture in its camera's frame: mirrored, turned, at another size, or a crop.

Keypoints tell without any camera how one picture is turned and scaled against another: each match by its own
orientation and size, mirrored or not. What most of them say is tried as matching is, its keypoints laid as they would
be in the right picture: only matches on common epipolar lines count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from barpc.base.geodesy import Array
from barpc.base.statistics import OUTLIER
from barpc.scene import View, connected_groups
from barpc.sensor.rpc import RPC
from barpc.tie.matchers.features import Keypoints
from barpc.tie.matchers.guided import CLEAR_RATIO
from barpc.tie.pairing.epipolar import epipolar_segments
from barpc.tie.pairing.overlaps import Link

_SIZES = {0.25: "a quarter of the size", 1 / 3: "a third of the size", 0.5: "half the size", 2.0: "twice the size"}
_TURNED = {
    (False, 1): "turned by 90 degrees clockwise",
    (False, 2): "turned by 180 degrees",
    (False, 3): "turned by 90 degrees counter-clockwise",
    (True, 0): "mirrored, its rows reversed",
    (True, 1): "with rows and columns exchanged",
    (True, 2): "mirrored, its columns reversed",
    (True, 3): "with rows and columns exchanged and both reversed",
}


Placings = tuple["Placing | None", "Placing | None"]
"""How each picture of a pair lies if the other does as its camera says; None: not so."""

_SAID = "shows the picture {}{}, as keypoints of {} say: give the picture that its RPC is for, or the RPC of this one"


@dataclass(frozen=True)
class Placing:
    """Placing of a picture: its rows are reversed where it is mirrored, then it is turned, scaled and shifted."""

    mirrored: bool
    turns: int  # of 90 degrees, columns towards rows
    size: float  # pixels of the file a pixel of the camera
    start: tuple[float, float] = (0.0, 0.0)  # col, row of the file at which the camera's pixel (0, 0) lies

    @property
    def linear(self) -> Array:
        """Derivative (2, 2) of the place in the file by that in the camera's image."""
        turn = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), self.turns)
        return np.asarray(self.size * turn @ np.diag([1.0, -1.0 if self.mirrored else 1.0]))

    @property
    def words(self) -> str:
        """Description that continues "shows the picture ..."."""
        found = [_TURNED[self.mirrored, self.turns]] if self.mirrored or self.turns else []
        if self.size != 1.0:
            found.append(f"at {_SIZES.get(self.size, f'{self.size:.3g} times the size')} that its RPC is for")
        col, row = (-start for start in self.start)
        return (
            ", ".join(found)
            or f"moved by some {col:.2g} columns and {row:.2g} rows, more than was searched, as a crop is"
        )

    def is_stated(self, reach: float) -> bool:
        """Return whether the placing is the camera's, which may be wrong by `reach` [px]."""
        return not self.mirrored and not self.turns and self.size == 1.0 and bool(np.hypot(*self.start) <= reach)

    def fills(self, view: View) -> bool:
        """Return whether a view's RPC, at this size, covers its file exactly, as that of a whole image does."""
        if self.size == 1.0 or not isinstance(view.sensor, RPC):
            return False
        ends = view.sensor.image_offset + np.outer([-1.0, 1.0], view.sensor.image_scale) + [[-0.5], [0.5]]
        wrong = np.abs(self.linear) @ (ends[1] - ends[0]) - view.size
        return bool(max(np.abs(ends[0]).max(), np.abs(wrong).max() / max(self.size, 1.0)) <= 1.0)

    def undone(self, points: Keypoints) -> Keypoints:
        """Return keypoints of the file transformed into the picture that the camera is for."""
        back = np.linalg.inv(self.linear)
        direction = np.stack([np.cos(points.angle), np.sin(points.angle)], axis=-1) @ back.T
        return replace(
            points,
            xy=(points.xy - self.start) @ back.T,
            scale=points.scale / self.size,
            angle=np.arctan2(direction[:, 1], direction[:, 0]),
            descriptors=_mirrored(points.descriptors) if self.mirrored else points.descriptors,
        )


def _mirrored(descriptors: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the descriptors (N, 128) of mirrored patches: SIFT's 4 x 4 cells, of which the first number is across the
    orientation, hold 8 directions each.
    """
    cells = descriptors.reshape(-1, 4, 4, 8)[:, ::-1][..., -np.arange(8) % 8]
    return cells.reshape(descriptors.shape)


def stretched(views: tuple[View, View], first: Array, second: Array) -> bool:
    """Return whether matches (M, 2), (M, 2) [px] have the scale of pictures of another size, or mirrored ones.

    Across the epipolar lines, where relief has no effect, it is nearer to half or twice the cameras'.
    """
    if not len(first):
        return False
    where = epipolar_segments(*views, first)
    said = where.across + where.slope * (where.turn(second)[:, 0] - where.along)
    said, seen = said - said.mean(), where.turn(second)[:, 1]
    sum_of_squares = float(said @ said)
    if not sum_of_squares > 0.0:
        return False
    scale = float(said @ seen) / sum_of_squares
    sigma = float(np.std(seen - scale * said)) / sum_of_squares**0.5
    return abs(scale - 1.0) > OUTLIER * sigma and not 0.5**0.5 < scale < 2.0**0.5


def likeliest_placing(views: tuple[View, View], keypoints: tuple[Keypoints, Keypoints]) -> tuple[Placing, int]:
    """Return the placing of the second picture relative to the first that most keypoints support, and their number."""
    a, b = keypoints
    where = epipolar_segments(*views, a.xy)
    places = where.place(np.zeros(len(a)))
    direction = np.stack([np.cos(a.angle), np.sin(a.angle)], axis=-1) @ where.linear.T
    towards, grown = np.arctan2(direction[:, 1], direction[:, 0]), np.sqrt(abs(np.linalg.det(where.linear)))
    best, most = Placing(False, 0, 1.0), 0
    for mirrored in (False, True):
        rows, cols = _mutual_nearest(_mirrored(a.descriptors) if mirrored else a.descriptors, b.descriptors)
        turn = b.angle[cols] + (towards if mirrored else -towards)[rows]
        ratio = b.scale[cols] / (grown * a.scale[rows])
        size = np.maximum(np.rint(ratio), 1.0) / np.maximum(np.rint(1.0 / ratio), 1.0)
        kind = np.stack([np.rint(turn / (0.5 * np.pi)) % 4, size], axis=1)
        kinds, of, count = np.unique(kind, axis=0, return_inverse=True, return_counts=True)
        if len(kinds) and count.max() > most:
            k, most = int(count.argmax()), int(count.max())
            best = Placing(mirrored, int(kinds[k, 0]), float(kinds[k, 1]))
            said = of.reshape(-1) == k
            start = np.nanmedian(b.xy[cols[said]] - places[rows[said]] @ best.linear.T, axis=0)
            best = replace(best, start=(float(start[0]), float(start[1])))
    return best, most


def _mutual_nearest(first: npt.NDArray[np.uint8], second: npt.NDArray[np.uint8]) -> tuple[npt.NDArray[np.int64], ...]:
    """Return the rows of mutually nearest descriptors by a clear ratio."""
    a, b = (x.astype(np.float32) for x in (first, second))  # whole numbers: their products are exact on any machine
    if min(len(a), len(b)) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    length = [np.maximum(np.linalg.norm(x, axis=1), np.float32(1e-6)) for x in (a, b)]
    cosine = a @ b.T / length[0][:, None] / length[1]
    nearest = cosine.argmax(axis=1)
    rows = np.flatnonzero(cosine.argmax(axis=0)[nearest] == np.arange(len(a)))
    two = np.sqrt(np.maximum(2.0 - 2.0 * np.partition(cosine[rows], -2, axis=1)[:, -2:], 0.0))
    rows = rows[two[:, 1] <= CLEAR_RATIO * two[:, 0]]
    return rows, nearest[rows]


def misplaced(views: Sequence[View], links: Sequence[Link], placings: Mapping[Link, Placings]) -> dict[str, str]:
    """Return sentences, by view name, on pictures with another placing than their RPC's, by the `placings` of pairs.

    Views of the largest group tied by `links` have none.
    """
    groups, said = connected_groups(len(views), links), dict[str, str]()
    right = set(groups[0] if len(groups) > 1 and len(groups[0]) > len(groups[1]) else ())
    for (i, j), (first, second) in placings.items():
        ends = [(v, other, how) for v, other, how in ((i, j, first), (j, i, second)) if how and v not in right]
        likely = (
            [end for end in ends if end[1] in right] or [end for end in ends if end[2].fills(views[end[0]])] or ends
        )
        for view, other, how in likely[-1:]:
            doubt = f", or {views[other].name} the reverse" if len(likely) > 1 else ""
            said.setdefault(views[view].name, _SAID.format(how.words, doubt, views[other].name))
    return said
