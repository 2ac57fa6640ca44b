"""Tables of tie points: CSV and npz (image, col, row, track), and the text matches of ASP.

(0, 0) is the centre of the top-left pixel. CSV: a header with the columns `image, col, row, track` and, where it is
known, `sigma` [px], in any order. npz: arrays `names`, `view`, `track`, `xy` (K, 2) and `sigma`. ASP: files
`[prefix-]LEFT__RIGHT.txt` or a folder of them, as `--matches-as-txt` writes them.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from barpc.errors import InputError
from barpc.frozen import load_npz
from barpc.geodesy import Array
from barpc.pointio.names import ViewNames, cell, from_cell
from barpc.scene import IntArray, Tracks, connected_labels
from barpc.sidefile import TABLE, opened_text, read_text

SIGMA = 0.5  # standard deviation of each coordinate [px] where the file states none

_COLUMNS = ("image", "col", "row", "track")


def read_matches(path: Path | str, names: Sequence[str]) -> Tracks:
    """Tie points of a file; tracks with fewer than two views, or with two observations in one, are left out.

    A CSV, an npz, an ASP text match file or a folder of these; observations in other images than the views called
    `names` are left out. InputError where it does not parse, or holds no track of these views.
    """
    path = Path(path)
    views = ViewNames(names, str(path))
    try:
        if path.is_dir():
            view, point, xy, spread = _read_asp(sorted(path.glob("*__*.txt")), views)
        elif path.suffix.lower() == ".npz":
            view, point, xy, spread = _read_npz(path, views)
        elif "__" in path.name and path.suffix.lower() in (".txt", ".match"):
            view, point, xy, spread = _read_asp([path], views)
        else:
            view, point, xy, spread = _read_csv(path, views)
    except (OSError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as tie points ({error})") from error
    if not (np.isfinite(xy).all() and np.isfinite(spread).all() and (spread > 0).all()):
        raise InputError(f"{path}: a coordinate is not finite, or a sigma not positive")
    return _tracks(path, view, point, xy, spread)


def write_matches(path: Path | str, tracks: Tracks, names: Sequence[str]) -> None:
    """Write tie points as ``.csv`` or ``.npz``; `read_matches` reads them back to the bit."""
    path = Path(path)
    if path.suffix.lower() == ".npz":
        with path.open("wb") as file:
            view, track = tracks.view, tracks.point
            np.savez_compressed(
                file, names=np.array(names), view=view, track=track, xy=tracks.xy, sigma=tracks.sigma
            )
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
    """The matches of a pair as an ASP text match file.

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


Columns = tuple[IntArray, IntArray, Array, Array]


def _read_csv(path: Path, views: ViewNames) -> Columns:
    with opened_text(path, TABLE, newline="") as text:
        lines = csv.reader(line for line in text if line.strip() and not line.startswith("#"))
        header = [word.strip().lower() for word in next(lines, [])]
        if missing := [name for name in _COLUMNS if name not in header]:
            raise InputError(
                f"{path}: no column {', '.join(missing)}; found {', '.join(header) or 'nothing'}"
            )
        image, *numbers = (header.index(name) for name in _COLUMNS)
        spread = header.index("sigma") if "sigma" in header else None
        rows, tracks = [], []
        for line in lines:
            try:
                view = views.find(from_cell(line[image]))
                col, row = (float(line[i]) for i in numbers[:2])
                own = SIGMA if spread is None else float(line[spread])
                track = line[numbers[2]].strip()
            except (ValueError, IndexError) as error:
                raise InputError(
                    f"{path}: {', '.join(line)!r} does not hold image, col, row, track"
                ) from error
            if view is not None:
                rows.append((view, col, row, own))
                tracks.append(track)
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    _, first, inverse = np.unique(np.array(tracks, dtype=str), return_index=True, return_inverse=True)
    point = np.argsort(np.argsort(first))[inverse.ravel()] if len(rows) else np.zeros(0, dtype=np.int64)
    return table[:, 0].astype(np.int64), point, table[:, 1:3], table[:, 3]


def _read_npz(path: Path, views: ViewNames) -> Columns:
    file = load_npz(path)
    try:
        own = np.array([-1 if (i := views.find(str(name))) is None else i for name in file["names"]])
        index, point = (np.asarray(file[key], dtype=np.int64) for key in ("view", "track"))
        xy = np.asarray(file["xy"], dtype=np.float64)
        spread = np.asarray(file.get("sigma", np.full(len(index), SIGMA)), dtype=np.float64)
        if {(*index.shape, 2), (*point.shape, 2), (*spread.shape, 2), xy.shape} != {(len(xy), 2)}:
            raise ValueError(f"shapes {index.shape}, {point.shape}, {xy.shape}, {spread.shape}")
        if len(index) and not 0 <= index.min() <= index.max() < len(own):
            raise ValueError("a view that has no name")
        view = own[index]
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not an npz of names, view, track, xy (K, 2) ({error})") from error
    keep = view >= 0
    return view[keep], point[keep], xy[keep], spread[keep]


def _read_asp(paths: Sequence[Path], views: ViewNames) -> Columns:
    """Pairs that share a keypoint are one track."""
    view, xy, pairs = [], [], []
    count = 0
    for path in paths:
        left, right = (views.find(name) for name in _asp_images(path, views))
        if left is None or right is None:
            continue
        first, second = _asp_points(path)
        n = len(first)
        view += [np.full(n, left), np.full(n, right)]
        xy += [first, second]
        pairs.append(count + np.column_stack([np.arange(n), n + np.arange(n)]))
        count += 2 * n
    if not count:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros(0)
    keypoints = np.column_stack([np.concatenate(view), np.concatenate(xy)])
    unique, index = np.unique(keypoints, axis=0, return_inverse=True)
    point = connected_labels(len(unique), index.ravel()[np.concatenate(pairs)])
    return unique[:, 0].astype(np.int64), point, unique[:, 1:], np.full(len(unique), SIGMA)


def _asp_images(path: Path, views: ViewNames) -> tuple[str, str]:
    """The two images that a match file's name means, a run's prefix before the first one left out."""
    stem = path.name.removesuffix(".txt").removesuffix(".match")
    cuts = [(stem[:i], stem[i + 2 :]) for i in range(len(stem) - 1) if stem.startswith("__", i)]
    for left, right in cuts:  # either name may hold the two lines, too
        if views.exact(left) is not None and views.exact(right) is not None:
            return left, right
    for left, right in cuts:
        while views.find(left) is None and "-" in left:
            left = left.split("-", 1)[1]
        if views.find(left) is not None and views.find(right) is not None:
            return left, right
    return cuts[0]


def _asp_points(path: Path) -> tuple[Array, Array]:
    """Points (M, 2) of both images: counts on the first line, then one keypoint a line, col and row first."""
    try:
        lines = read_text(path, TABLE).split("\n")
        left, right = (int(word) for word in lines[0].split()[:2])
        rows = [line.split()[:2] for line in lines[1:] if line.strip()]
        points = np.array(rows, dtype=np.float64).reshape(-1, 2)
    except ValueError as error:
        raise InputError(f"{path}: not an ASP text match file ({error})") from error
    if left != right or len(points) != left + right:
        raise InputError(f"{path}: says {left} and {right} keypoints but holds {len(points)}")
    return points[:left], points[left:]


def _tracks(path: Path, view: IntArray, point: IntArray, xy: Array, sigma: Array) -> Tracks:
    """Tracks sorted by point and view, without those that are seen once, or twice in one view."""
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
