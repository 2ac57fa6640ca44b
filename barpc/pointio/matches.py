"""Tie points: tables of them (image, col, row, track) as CSV and npz, and the matches that other programs write.

(0, 0) is the centre of the top-left pixel. CSV: a header with the columns `image, col, row, track` and, where it is
known, `sigma` [px], in any order. npz: arrays `names`, `view`, `track`, `xy` (K, 2) and `sigma`. Files of one pair
(ASP, LightGlue), or a folder of them: `barpc.pointio.pairfiles`; also COLMAP's databases and hloc's HDF5.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from barpc.errors import InputError
from barpc.frozen import Arrays, load_npz
from barpc.geodesy import Array
from barpc.pointio.colmap import MAGIC as COLMAP
from barpc.pointio.colmap import read_colmap
from barpc.pointio.correspondences import IMAGE_SIGMA, require_columns
from barpc.pointio.hloc import MAGIC as HDF5
from barpc.pointio.hloc import read_hloc
from barpc.pointio.links import Links
from barpc.pointio.names import ViewNames, cell, from_cell
from barpc.pointio.pairfiles import (
    ENDINGS,
    in_folder,
    is_dictionary,
    matched_keypoints,
    pair_of,
    read_pair_files,
)
from barpc.scene import Tracks
from barpc.sidefile import TABLE, opened_text, read_head

_COLUMNS = ("image", "col", "row", "track")


def read_links(path: Path | str, names: Sequence[str]) -> Links:
    """Read the matches in a file, or a folder of files of pairs, between the views called `names`.

    What a file holds is told by its content. Points in other images are left out; InputError where it does not parse,
    or holds no match of these views.
    """
    path = Path(path)
    views = ViewNames(names, str(path))
    try:
        links = _read(path, views)
    except (OSError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as tie points ({error})") from error
    if not (np.isfinite(links.xy).all() and np.isfinite(links.sigma).all() and (links.sigma > 0).all()):
        raise InputError(f"{path}: a coordinate is not finite, or a sigma not positive")
    if not (links.view[links.ends[:, 0]] != links.view[links.ends[:, 1]]).any():
        others = ", ".join(name[:60] for name in [*views.strangers][:3])
        found = f"; it names {others}, and the images are {', '.join(views.names[:3])}" if others else ""
        raise InputError(f"{path}: no track is seen in two of the views{found}")
    return links


def read_matches(path: Path | str, names: Sequence[str]) -> Tracks:
    """Read the tie points that a file states; tracks of fewer than two views, or two points in one, are left out.

    As `read_links`; points that are linked, by way of others too, are one track.
    """
    return tracks_of(read_links(path, names), path)


def write_matches(path: Path | str, tracks: Tracks, names: Sequence[str]) -> None:
    """Write tie points as ``.csv`` or ``.npz``; `read_matches` reads them back to the bit."""
    path = Path(path)
    if path.suffix.lower() == ".npz":
        with path.open("wb") as file:
            view, track = tracks.view, tracks.point
            np.savez_compressed(file, names=np.array(names), view=view, track=track, xy=tracks.xy, sigma=tracks.sigma)
        return
    if path.suffix.lower() != ".csv":
        raise InputError(f"{path}: tie points are written as .csv or .npz")
    with path.open("w", encoding="utf-8", newline="") as text:
        text.write(",".join([*_COLUMNS, "sigma"]) + "\r\n")
        cells = [cell(name) for name in names]
        rows = (array.tolist() for array in (tracks.view, tracks.point, tracks.xy, tracks.sigma))
        for view, point, (col, row), sigma in zip(*rows, strict=True):
            text.write(f"{cells[view]},{col!r},{row!r},{point},{sigma!r}\r\n")


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


def _read(path: Path, views: ViewNames) -> Links:
    if path.is_dir():
        return Links.of_pairs(read_pair_files(in_folder(path), views))
    head, ending = read_head(path, TABLE, 16), path.suffix.lower()
    for magic, read in ((COLMAP, read_colmap), (HDF5, read_hloc)):
        if head.startswith(magic):
            return Links.of_pairs(read(path, views))
    if ending == ".npz" and not is_dictionary(arrays := load_npz(path)):
        return _table(path, arrays, views)
    if ending == ".npz":
        pair = pair_of(path, views)
        return Links.of_pairs([] if pair is None else [(*pair, *matched_keypoints(path, arrays))])
    if "__" in path.name and ending in ENDINGS:
        return Links.of_pairs(read_pair_files([path], views))
    return _read_csv(path, views)


def _read_csv(path: Path, views: ViewNames) -> Links:
    with opened_text(path, TABLE, newline="") as text:
        lines = csv.reader(line for line in text if line.strip() and not line.startswith("#"))
        header = [word.strip().lower() for word in next(lines, [])]
        require_columns(path, _COLUMNS, header, header)
        image, *numbers = (header.index(name) for name in _COLUMNS)
        spread = header.index("sigma") if "sigma" in header else None
        rows, tracks = [], []
        for line in lines:
            try:
                view = views.find(from_cell(line[image]))
                col, row = (float(line[i]) for i in numbers[:2])
                own = IMAGE_SIGMA if spread is None else float(line[spread])
                track = line[numbers[2]].strip()
            except (ValueError, IndexError) as error:
                line_at = f"{path}: line {lines.line_num}"  # whatever it holds
                raise InputError(f"{line_at} does not hold image, col, row, track") from error
            if view is not None:
                rows.append((view, col, row, own))
                tracks.append(track)
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    _, first, inverse = np.unique(np.array(tracks, dtype=str), return_index=True, return_inverse=True)
    point = np.argsort(np.argsort(first))[inverse.ravel()] if len(rows) else np.zeros(0, dtype=np.int64)
    return Links.of_tracks(table[:, 0].astype(np.int64), point, table[:, 1:3], table[:, 3])


def _table(path: Path, file: Arrays, views: ViewNames) -> Links:
    try:
        own = np.array([-1 if (i := views.find(str(name))) is None else i for name in file["names"]])
        index, point = (np.asarray(file[key], dtype=np.int64) for key in ("view", "track"))
        xy = np.asarray(file["xy"], dtype=np.float64)
        spread = np.asarray(file.get("sigma", np.full(len(index), IMAGE_SIGMA)), dtype=np.float64)
        if {(*index.shape, 2), (*point.shape, 2), (*spread.shape, 2), xy.shape} != {(len(xy), 2)}:
            raise ValueError(f"shapes {index.shape}, {point.shape}, {xy.shape}, {spread.shape}")
        if len(index) and not 0 <= index.min() <= index.max() < len(own):
            raise ValueError("a view that has no name")
        view = own[index]
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not an npz of names, view, track, xy (K, 2) ({error})") from error
    keep = view >= 0
    return Links.of_tracks(view[keep], point[keep], xy[keep], spread[keep])


def tracks_of(links: Links, path: Path | str) -> Tracks:
    """Return the tracks of linked points, sorted by view, without those that are seen once, or twice in one view."""
    view, point, xy, sigma = links.view, links.tracks(), links.xy, links.sigma
    order = np.lexsort((view, point))
    view, point, xy, sigma = view[order], point[order], xy[order], sigma[order]
    twice = np.zeros(len(view), dtype=bool)
    twice[1:] = (point[1:] == point[:-1]) & (view[1:] == view[:-1])
    good = ~np.isin(point, point[twice])
    _, index, count = np.unique(point, return_inverse=True, return_counts=True)
    keep = good & (count[index] >= 2)
    if not keep.any():
        raise InputError(f"{path}: no track is seen in two of the views")
    _, closed = np.unique(point[keep], return_inverse=True)
    return Tracks(view[keep], closed, xy[keep], sigma[keep])
