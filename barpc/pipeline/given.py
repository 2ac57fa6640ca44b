"""Matches that a run is given, for its views."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from barpc.errors import InputError
from barpc.pointio.links import Links
from barpc.pointio.matches import read_links, tracks_of
from barpc.scene import Tracks, View
from barpc.tie import Matches
from barpc.tie.epipolar import grouped

logger = logging.getLogger(__name__)

_MARGIN = 1.5  # px beyond the centres of the outermost pixels that a matcher may still mean
_ASTRAY = (
    0.05  # of the points may lie farther off, where a matcher looks over borders; of other crops more do
)


def given_tracks(paths: Sequence[str | Path], views: Sequence[View]) -> Tracks:
    """The tie points of files as they are."""
    return tracks_of(_linked(paths, views), ", ".join(map(str, paths)))


def given_matches(
    paths: Sequence[str | Path], views: Sequence[View], *, partly: bool = False
) -> dict[tuple[int, int], Matches]:
    """The matches of files, pair by pair; one without any is an error, but for a part (`partly`) of the images."""
    links = _linked(paths, views, partly)
    swapped = links.view[links.ends[:, 0]] > links.view[links.ends[:, 1]]
    ends = np.where(swapped[:, None], links.ends[:, ::-1], links.ends)
    places = links.xy[ends].reshape(-1, 4)  # so that the order of the file does not matter
    ends = ends[np.lexsort(places[:, ::-1].T)]
    first, second = links.view[ends].T
    found = {}
    for rows in grouped(first, second):
        pair, chosen = (int(first[rows[0]]), int(second[rows[0]])), ends[rows]
        if pair[0] != pair[1]:
            found[pair] = Matches(links.xy[chosen], np.zeros(len(chosen)), -1 - chosen)
    return found


def _linked(paths: Sequence[str | Path], views: Sequence[View], partly: bool = False) -> Links:
    """What the files say of the views, all of it inside their images."""
    parts = [Links.of_pairs([])]
    for path in paths:
        try:
            parts.append(read_links(path, [view.name for view in views]))
        except InputError as error:
            if not partly:
                raise
            logger.warning("%s", error)
            continue
        parts[-1] = _inside(path, views, parts[-1])
    return Links.joined(parts[1:] or parts)


def _inside(path: str | Path, views: Sequence[View], links: Links) -> Links:
    """Without points that lie outside their images; InputError where they are more than a few."""
    beyond = np.array([view.size for view in views])[links.view] + (_MARGIN - 1.0)
    inside = np.asarray(((links.xy >= -_MARGIN) & (links.xy <= beyond)).all(axis=1))
    wrong = np.flatnonzero(~inside)
    if not len(wrong):
        return links
    of, (col, row) = views[links.view[wrong[0]]], links.xy[wrong[0]].tolist()
    said = (
        f"{path}: {len(wrong)} of {len(inside)} points lie outside their images, as ({col:g}, {row:g}) in {of.name},"
        f" {of.size[0]} x {of.size[1]} pixels"
    )
    if len(wrong) > _ASTRAY * len(inside):
        raise InputError(f"{said}; were they found in other crops, or in reduced images?")
    logger.warning("%s: they are left out", said)
    number = np.cumsum(inside) - 1
    ends = links.ends[inside[links.ends].all(axis=1)]
    return Links(links.view[inside], links.xy[inside], links.sigma[inside], number[ends])
