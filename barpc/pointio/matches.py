"""Tie points: tables of them (image, col, row, track) as CSV and npz, and the matches that other programs write.

(0, 0) is the centre of the top-left pixel. CSV: a header with the columns `image, col, row, track` and, where it is
known, `sigma` [px], in any order. npz: arrays `names`, `view`, `track`, `xy` (K, 2) and `sigma`. Files of one pair
(ASP, LightGlue), or a folder of them, COLMAP's databases and hloc's HDF5: `barpc.pointio.third_party_matches`.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barpc.base.errors import InputError, plain
from barpc.base.frozen import Arrays, load_npz
from barpc.base.geodesy import Array
from barpc.base.safe_io import TABLE, read_head
from barpc.pointio.names import ViewNames, cell
from barpc.pointio.tables import IMAGE_SIGMA, distinct, index_texts, read_table
from barpc.pointio.third_party_matches import (
    COLMAP,
    HDF5,
    PairPoints,
    pair_files,
    pair_of,
    read_colmap,
    read_hloc,
    read_pair_files,
)
from barpc.scene import IntArray, Tracks, connected_labels, row_pairs

_MATCH_COLUMNS = ("image", "col", "row", "track")
_NO_TRACK = "no track is seen in two of the views"
_MAX_LINKED_DISTANCE = 16  # observations of a track are linked to so many after them: all of a usual track


@dataclass(frozen=True, eq=False)
class Links:
    """Points (K,) of views, and pairs of them (M, 2), as rows, that were matched."""

    view: IntArray  # (K,)
    xy: Array  # (K, 2) [px]
    sigma: Array  # (K,) standard deviation of each coordinate [px]
    ends: IntArray  # (M, 2)

    @staticmethod
    def of_pairs(pairs: Iterable[PairPoints]) -> Links:
        """Return the matches of pairs of views: points of a view at the very same place are one."""
        given = list(pairs)
        view = np.concatenate(
            [np.full(len(xy), i) for a, b, *ends in given for i, xy in zip((a, b), ends, strict=True)] or [np.zeros(0)]
        )
        xy = np.concatenate([xy for _, _, *ends in given for xy in ends] or [np.zeros((0, 2))])
        starts = np.cumsum([0, *(2 * len(first) for _, _, first, _ in given)])
        ends = [
            start + np.arange(2 * len(first)).reshape(2, -1).T
            for start, (_, _, first, _) in zip(starts, given, strict=False)
        ]
        joined = np.concatenate(ends) if given else np.zeros((0, 2), dtype=np.int64)
        return Links(view.astype(np.int64), xy, np.full(len(xy), IMAGE_SIGMA), joined).merged()

    @staticmethod
    def joined(parts: Sequence[Links]) -> Links:
        """Return the matches of several files."""
        starts = np.cumsum([0, *(len(part.view) for part in parts)])
        columns = ([getattr(part, name) for part in parts] for name in ("view", "xy", "sigma"))
        view, xy, sigma = map(np.concatenate, columns)
        ends = [start + part.ends for start, part in zip(starts, parts, strict=False)]
        whole = Links(view, xy, sigma, np.concatenate(ends))
        return whole.merged() if len(parts) > 1 else parts[0]

    def merged(self) -> Links:
        """Return the points of a view at the very same place as one, the most certain."""
        kept, number = distinct(np.column_stack([self.view, self.xy]), self.sigma)
        return Links(self.view[kept], self.xy[kept], self.sigma[kept], number[self.ends])

    @staticmethod
    def of_tracks(view: IntArray, track: IntArray, xy: Array, sigma: Array) -> Links:
        """Return the observations of tracks: each is linked to the next ones of its track."""
        order = np.lexsort((view, track))
        return Links(view, xy, sigma, order[row_pairs(track[order], _MAX_LINKED_DISTANCE).T])

    @property
    def joins_views(self) -> bool:
        """Whether any match is one of two views."""
        return bool((self.view[self.ends[:, 0]] != self.view[self.ends[:, 1]]).any())

    def tracks(self) -> IntArray:
        """Return the track (K,) of every point: points that are linked belong to one."""
        return connected_labels(len(self.view), self.ends)


def read_links(path: Path | str, names: Sequence[str]) -> Links:
    """Read the matches in a file, or a folder of files of pairs, between the views called `names`.

    What a file holds is told by its content. Points in other images are left out; InputError where it does not parse,
    or holds no match of these views: but files named after a pair of them may be of a matcher that found none.
    """
    path = Path(path)
    views = ViewNames(names, str(path))
    try:
        links = _read_by_kind(path, views)
    except OSError as error:
        raise InputError(f"{path}: cannot be read as tie points ({plain(error)})") from error
    if not (np.isfinite(links.xy).all() and np.isfinite(links.sigma).all() and (links.sigma > 0).all()):
        raise InputError(f"{path}: a coordinate is not finite, or a sigma not positive")
    if not links.joins_views and all(pair_of(one, views) is None for one in pair_files(path)):
        others = ", ".join(name[:60] for name in [*views.strangers][:3])
        found = f"; it names {others}, and the images are {', '.join(views.names[:3])}" if others else ""
        raise InputError(f"{path}: {_NO_TRACK}{found}")
    return links


def write_matches(path: Path | str, tracks: Tracks, names: Sequence[str]) -> None:
    """Write tie points as ``.csv`` or ``.npz``; `read_links` reads them back to the bit."""
    path = Path(path)
    if path.suffix.lower() == ".npz":
        path.write_bytes(matches_npz(tracks, names))
        return
    if path.suffix.lower() != ".csv":
        raise InputError(f"{path}: tie points are written as .csv or .npz")
    with path.open("w", encoding="utf-8", newline="") as text:
        text.write(",".join([*_MATCH_COLUMNS, "sigma"]) + "\r\n")
        cells = [cell(name) for name in names]
        rows = (array.tolist() for array in (tracks.view, tracks.point, tracks.xy, tracks.sigma))
        for view, point, (col, row), sigma in zip(*rows, strict=True):
            text.write(f"{cells[view]},{col!r},{row!r},{point},{sigma!r}\r\n")


def matches_npz(tracks: Tracks, names: Sequence[str]) -> bytes:
    """Return tie points as the bytes of an ``.npz``."""
    file, view, track = io.BytesIO(), tracks.view, tracks.point
    np.savez_compressed(file, names=np.array(names), view=view, track=track, xy=tracks.xy, sigma=tracks.sigma)
    return file.getvalue()


def asp_text(first: Array, second: Array) -> str:
    """Return the matches of a pair as an ASP text match file.

    The counts on the first line, then one keypoint a line, those of the first image (M, 2) first: x, y, their whole
    pixels, orientation, scale, interest, polarity, octave, scale level and the length of the descriptor (0).

    Examples
    --------
    >>> print(asp_text(np.array([[1.25, 2.0]]), np.array([[3.5, 4.0]])), end="")
    1 1
    1.25 2.0 1 2 0 1 1 0 0 0 0
    3.5 4.0 4 4 0 1 1 0 0 0 0
    """
    rows = [
        f"{col!r} {row!r} {round(col)} {round(row)} 0 1 1 0 0 0 0"
        for points in (first, second)
        for col, row in points.tolist()
    ]
    return "\n".join([f"{len(first)} {len(second)}", *rows]) + "\n"


def _read_by_kind(path: Path, views: ViewNames) -> Links:
    if path.is_dir():
        return Links.of_pairs(read_pair_files(pair_files(path), views))
    head, ending = read_head(path, TABLE, 16), path.suffix.lower()
    for magic, read in ((COLMAP, read_colmap), (HDF5, read_hloc)):
        if head.startswith(magic):
            return Links.of_pairs(read(path, views))
    if ending == ".npz" and "keypoints0" not in (arrays := load_npz(path)):
        return _read_npz(path, arrays, views)
    if ending == ".npz" or pair_files(path):
        return Links.of_pairs(read_pair_files([path], views))
    return _read_matches_csv(path, views)


def _read_matches_csv(path: Path, views: ViewNames) -> Links:
    _, table = read_table(
        path, {key: (key,) for key in (*_MATCH_COLUMNS, "sigma")}, _MATCH_COLUMNS, texts=("image", "track")
    )
    image, track = table["image"], table["track"]
    point = track.index
    if not isinstance(track.different, np.ndarray):
        point = index_texts((label.strip() for label in track.different), {})[point]
    spread = table.get("sigma", np.full(len(point), IMAGE_SIGMA))
    xy = np.column_stack([table["col"], table["row"]])
    return _tracks(views.of(map(str, image.different))[image.index], point, xy, spread)


def _read_npz(path: Path, file: Arrays, views: ViewNames) -> Links:
    try:
        index, point = (np.asarray(file[key], dtype=np.int64) for key in ("view", "track"))
        xy = np.asarray(file["xy"], dtype=np.float64)
        spread = np.asarray(file.get("sigma", np.full(len(index), IMAGE_SIGMA)), dtype=np.float64)
        if {(*index.shape, 2), (*point.shape, 2), (*spread.shape, 2), xy.shape} != {(len(xy), 2)}:
            raise ValueError(f"shapes {index.shape}, {point.shape}, {xy.shape}, {spread.shape}")
        if len(index) and index.min() < 0:
            raise ValueError("a view that has no name")
        view = views.of(str(name) for name in file["names"])[index]
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise InputError(f"{path}: not an npz of names, view, track, xy (K, 2) ({plain(error)})") from error
    return _tracks(view, point, xy, spread)


def _tracks(view: IntArray, point: IntArray, xy: Array, sigma: Array) -> Links:
    """Return the observations of tracks, those in other images than the views (-1) left out."""
    keep = view >= 0
    return Links.of_tracks(view[keep], point[keep], xy[keep], sigma[keep])


def tracks_of(links: Links, path: Path | str) -> Tracks:
    """Return the tracks of linked points, sorted by view, without those that are seen once, or twice in one view."""
    view, point = links.view, links.tracks()
    order = np.lexsort((view, point))
    track, seen = point[order], view[order]
    again = np.zeros(len(order), dtype=bool)
    again[1:] = (track[1:] == track[:-1]) & (seen[1:] == seen[:-1])
    good = np.bincount(point) >= 2
    good[track[again]] = False
    if not good.any():
        raise InputError(f"{path}: {_NO_TRACK}")
    kept = order[good[track]]
    closed = np.cumsum(good) - 1
    return Tracks(view[kept], closed[point[kept]], links.xy[kept], links.sigma[kept])
