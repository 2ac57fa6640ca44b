"""Pictures for the report: thumbnails of the images, and the worst pair along its epipolar lines."""

from __future__ import annotations

import base64
import json
import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from barpc.base.errors import BarpcError, listed
from barpc.base.geodesy import Array, ground_from_ecef
from barpc.base.remote import is_url
from barpc.base.tasks import Work
from barpc.pipeline.executor import by_groups
from barpc.report import Run, Summary
from barpc.report.outcome import PairTies
from barpc.report.ranking import offset_of, worst_first
from barpc.report.runfiles import FOLDER, MAX_PICTURES, PICTURES
from barpc.scene import IntArray, View
from barpc.sensor import SensorModel
from barpc.tie.patches.channels import picture, ticks
from barpc.tie.pixels import Stretch, jpeg, thumbnail
from barpc.workspace import Workspace

logger = logging.getLogger(__name__)

_THUMBNAIL_SIDE = 480  # px of a thumbnail: a third of a page that fills a desk's screen
_MOST_BYTES = 60_000  # of a picture
_ALL_BYTES = 1_500_000  # of all thumbnails: two of the six MB that a page of many images may have
_TILES, _TILE_SIDE = 6, 120  # places of a strip, and pixels of their sides
_HALF_PX = 12.0, 80.0  # of the image, from a tile's middle to its edge: at least, at most
_PER_OFFSET = 5.0  # times the offset: it moves what is seen by a tenth of a tile
_HEIGHT_STEP = 10.0  # m: two ends of a piece of an epipolar line


def write_pictures(workspace: Workspace, run: Run, summary: Summary, work: Work) -> None:
    """Write the pictures of a run that its report shows; images that cannot be read again are left out.

    Parameters
    ----------
    workspace : Workspace
    run : Run, with the paths of its images as they can be opened
    summary : Summary, of this run with its verdict
    work : Work
    """
    chosen = [run.views[run.number[view.name]] for view in worst_first(summary.views)[:MAX_PICTURES]]
    band = run.options.tie.band
    most = min(_MOST_BYTES, _ALL_BYTES // max(len(chosen), 1))
    found = by_groups(work.executor, thumbnails, chosen, (band, most), "pictures", None)
    images = [one for group in found for one in group if "picture" in one]
    if left := [one for group in found for one in group if "picture" not in one]:
        logger.warning("%s: no picture in the report, as %s", listed([one["image"] for one in left]), left[0]["error"])
    pairs = [strip] if (strip := _worst_pair(run, summary, band)) else []
    workspace.write_text(f"{FOLDER}/{PICTURES}", json.dumps({"images": images, "pairs": pairs}))


def thumbnails(group: Sequence[View], band: int, most: int) -> list[dict[str, Any]]:
    """Return the thumbnails of some views as `barpc.report.runfiles.Draped`; of one that cannot be read, the error."""
    found = list[dict[str, Any]]()
    for view in group:
        try:
            grey = None if is_url(view.path) else thumbnail(view.path, view.size, _THUMBNAIL_SIDE, band)
        except (BarpcError, OSError) as error:
            found.append({"image": view.name, "error": str(error)})
            continue
        if grey is not None:
            found.append({"image": view.name, **encoded(grey, most)})
    return found


def encoded(grey: npt.NDArray[np.uint8], most: int = _MOST_BYTES) -> dict[str, object]:
    """Return a grey picture as the report's records hold it: its size, and a JPEG in base64."""
    return {"size": [grey.shape[1], grey.shape[0]], "picture": base64.b64encode(jpeg(grey, most)).decode()}


# --- a pair along its epipolar lines ------------------------------------------------------------------------


def _worst_pair(run: Run, summary: Summary, band: int) -> dict[str, Any] | None:
    """Return places of the worst pair in both images, as `barpc.report.runfiles.PairStrip`; None where there are none.

    A row of tiles of the first image, and under it of the second through the cameras before and after: every tile is
    resampled so that a feature stands on the line through the middle where both cameras agree.
    """
    worst = max(summary.pairs, key=offset_of, default=None)
    if worst is None or worst.epipolar_before is None:
        return None
    names = [view.name for view in run.views]
    ties = next(one for one in run.pairs if {names[v] for v in one.views} == {worst.a, worst.b})
    half = float(np.clip(_PER_OFFSET * worst.epipolar_before.rms, *_HALF_PX))
    rows = _spread(run, ties, half)
    cameras = [("delivered", run.before, run.ties_before.points)]
    if run.after is not None and run.ties_after is not None:
        cameras.append(("corrected", run.after, run.ties_after.points))
    views = [run.views[v] for v in ties.views]
    if not len(rows) or any(is_url(view.path) for view in views):
        return None
    at = run.tracks.xy[ties.a[rows]], run.tracks.xy[ties.b[rows]]
    lines = list[npt.NDArray[np.uint8]]()
    try:
        for _, sensors, points in cameras:
            alt = ground_from_ecef(points)[run.tracks.point[ties.a[rows]], 2]
            places = _along_lines([sensors[v] for v in ties.views], at, alt, half)
            for view, nodes in list(zip(views, places, strict=True))[bool(lines) :]:  # of the first image once
                lines.append(np.hstack([_tile(view, band, one) for one in nodes]))
    except (BarpcError, OSError) as error:
        logger.warning("%s - %s: no pictures along epipolar lines, as %s", *(view.name for view in views), error)
        return None
    words = [views[0].name, *(f"{views[1].name}, {name} cameras" for name, *_ in cameras)]
    told = {"rows": words, "tiles": len(rows), "half_px": half}
    return {"image": " - ".join(view.name for view in views), **told, **encoded(np.vstack(lines))}


def _spread(run: Run, ties: PairTies, half: float) -> IntArray:
    """Return rows of the matches of a pair, from left to right, whose tiles lie within both images."""
    within = np.ones(len(ties.a), dtype=bool)
    for rows, v in ((ties.a, ties.views[0]), (ties.b, ties.views[1])):
        xy, margin = run.tracks.xy[rows], 1.5 * half
        within &= ((xy > margin) & (xy < np.array(run.views[v].size) - margin)).all(axis=1)
    rows = np.flatnonzero(within)
    rows = rows[np.argsort(run.tracks.xy[ties.a[rows], 0], kind="stable")]
    return rows[np.linspace(0, len(rows) - 1, min(_TILES, len(rows))).astype(np.int64)]


def _along_lines(
    sensors: Sequence[SensorModel], at: tuple[Array, Array], alt: Array, half: float
) -> tuple[Array, Array]:
    """Return positions (n, m, m, 2) [px] of the nodes of tiles in both images, whose rows are epipolar lines.

    The tile of the second image is that of the first, `half` px about its point, as the plane at the altitude (n,) [m]
    takes it there, moved along the epipolar line to the foot of the observed point: the rest of the distance
    between both is across the line.
    """
    (first, second), (here, there) = sensors, at

    def taken(xy: Array, height: Array) -> Array:
        return np.asarray(second.project(np.column_stack([first.localize(xy, height)[:, :2], height])))

    middle = taken(here, alt)
    linear = np.stack([taken(here + step, alt) - middle for step in np.eye(2)], axis=-1)
    line = taken(here, alt + _HEIGHT_STEP) - middle
    line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-9)
    foot = middle + line * ((there - middle) * line).sum(axis=1, keepdims=True)
    # by the adjugate: a matrix without an inverse, as of cameras without a parallax, gives a tile that shows nothing
    along = np.einsum("nij,nj->ni", linear[:, ::-1, ::-1].swapaxes(1, 2) * [[1.0, -1.0], [-1.0, 1.0]], line)
    with np.errstate(invalid="ignore"):
        along *= np.where(along[:, :1] < 0, -1.0, 1.0) / np.linalg.norm(along, axis=1, keepdims=True)  # to the right
    across = np.column_stack([-along[:, 1], along[:, 0]])
    side = half * (2.0 * ticks(_TILE_SIDE) / (_TILE_SIDE - 1) - 1.0)
    grid = np.stack(np.meshgrid(side, side), axis=-1)
    offsets = np.einsum("ijk,nkl->nijl", grid, np.stack([along, across], axis=1))
    return here[:, None, None] + offsets, foot[:, None, None] + np.einsum("nlm,nijm->nijl", linear, offsets)


def _tile(view: View, band: int, nodes: Array) -> npt.NDArray[np.uint8]:
    """Return an image at the nodes (m, m, 2) [px] of a tile, in 8 bits, black where it is unknown."""
    grey, known = picture(view.path, (band,), view.size, nodes, (_TILE_SIDE, _TILE_SIDE))
    stretch = Stretch.of(grey[known])
    return (
        np.zeros(grey.shape, np.uint8)
        if stretch is None
        else np.where(known, stretch.apply(grey, known), 0).astype(np.uint8)
    )
