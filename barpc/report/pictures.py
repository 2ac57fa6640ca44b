"""Pictures of the images and their flagged parts, residuals along rows, tiles of a pair, histograms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from barpc.base.geodesy import Array
from barpc.report.maps import WIDTH, panel_box, round_ticks, template, thin
from barpc.report.ranking import TABLE_ROWS_SHOWN, worst_first
from barpc.report.records import MAX_SHOWN
from barpc.report.runfiles import RunFiles
from barpc.report.summary.block import AXES, ExplanationEntry, LeftEntry
from barpc.report.summary.words import STATUS_WORDS, counted, medians

PICTURE_KEY = (
    "On the pictures tie points used in an image are blue; those rejected there, but used in other images, are red."
)


def image_panels(files: RunFiles) -> list[tuple[str, str]]:
    """Draw the thumbnails of images with tie points, used and rejected, and flagged parts: the worst first."""
    seen, number, panels = files.observations, files.number, []
    parts = _flagged_parts(files)
    pictures = {one.image: one for one in files.thumbnails}
    for view in worst_first([view for view in files.summary.views if view.name in pictures]):
        k = number[view.name]
        box, own = panel_box(view), seen.view == k
        kept, cut = (
            thin((seen.xy[rows] + 0.5) * (box / view.size), MAX_SHOWN) for rows in (own & seen.used, own & ~seen.used)
        )
        boxes = [(words, *_clipped(place, view.size, box)) for words, place in parts.get(view.name, ())]
        text = template("drawings.svg.j2").module.thumbnail(
            number=k,
            view=view,
            width=box[0],
            height=box[1],
            shown=pictures[view.name],
            kept=kept.tolist(),
            cut=cut.tolist(),
            parts=boxes,
            described=PICTURE_KEY + f" {counted(len(boxes), 'part')} with reservations." * bool(boxes),
        )
        panels.append((text, view.name + f": {STATUS_WORDS[view.status]}" * bool(view.advice)))
    return panels


Limits = tuple[tuple[float, float] | None, tuple[float, float] | None]  # of columns and rows [px]; None: all


def _flagged_parts(files: RunFiles) -> dict[str, list[tuple[str, Limits]]]:
    """Return rows, columns and cells of images that a table names, by the image: a sentence and limits each."""
    found: dict[str, list[tuple[str, Limits]]] = {}
    for one in _named_lines(files):
        for ends in _interval_ends(one):
            words = one.place if isinstance(one, LeftEntry) else one.sentence
            limits: Limits = (ends, None) if one.axis == AXES[0] else (None, ends)
            found.setdefault(str(one.image), []).append((words, limits))
    for worse in () if files.summary.scene is None else files.summary.scene.held_out_places or ():
        found.setdefault(worse.image, []).append((worse.sentence, (worse.columns, worse.rows)))
    for view in files.summary.views:
        if view.gap:
            columns, rows = ((min(ends), max(ends)) for ends in list(zip(*view.gap, strict=True))[2:])
            found.setdefault(view.name, []).append(("few tie points", (columns, rows)))
    return found


def _named_lines(files: RunFiles) -> list[ExplanationEntry | LeftEntry]:
    """Return explanations of the residuals of one image, and its inconsistent rows and columns."""
    scene = files.summary.scene
    found: list[ExplanationEntry | LeftEntry] = [] if scene is None else [*scene.explanations, *scene.left]
    return [one for one in found if one.image in files.number]


def _interval_ends(one: ExplanationEntry | LeftEntry) -> list[tuple[float, float]]:
    """Return the first and last row or column, where there are some."""
    known = one.axis is not None and one.first is not None and one.last is not None
    return [(float(one.first or 0.0), float(one.last or 0.0))] if known else []


def _clipped(limits: Limits, size: Sequence[int], box: Array) -> list[float]:
    """Return x, y, width, height on a panel of limits on an image."""
    ends = np.array([one or (0.0, n) for one, n in zip(limits, size, strict=True)])
    ends = np.clip(ends, 0.0, np.array(size)[:, None]) * (box / size)[:, None]
    return [*ends[:, 0].tolist(), *np.diff(ends)[:, 0].tolist()]


def pair_strips(files: RunFiles) -> list[tuple[str, str]]:
    """Draw the tiles of the worst pair along its epipolar lines, with captions."""
    draw = template("drawings.svg.j2").module.strip
    words = (
        "{0.image}: {0.tiles} tie points, each in a window of ±{0.half_px:.0f} px whose rows are epipolar lines. "
        "Where cameras are correct a feature lies on the same row in both images; shifts along it come from heights."
    )
    told = [(one, words.format(one)) for one in files.strips]
    return [(draw(one, said, WIDTH, WIDTH * one.size[1] / one.size[0]), said) for one, said in told]


# --- residuals along rows or columns ----------------------------------------------------------------------------

_PROFILE_PARTS = 48  # parts of an image's rows or columns, of which a line of residuals takes the medians
_MIN_IN_BIN = 3
_PROFILE = 420.0, 230.0  # units
_PROFILE_LEFT, _PROFILE_RIGHT = 46.0, 412.0


def profile_charts(files: RunFiles) -> list[tuple[str, str]]:
    """Draw residuals along the rows or columns that an explanation or an inconsistent region names, with captions."""
    named: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for one in _named_lines(files):
        named.setdefault((str(one.image), AXES.index(one.axis or AXES[1])), []).extend(_interval_ends(one))
    charts = (_chart(files, image, axis, bands) for (image, axis), bands in named.items())
    return [chart for chart in charts if chart is not None][:TABLE_ROWS_SHOWN]


def _chart(files: RunFiles, image: str, axis: int, bands: Sequence[tuple[float, float]]) -> tuple[str, str] | None:
    number, seen = files.number[image], files.observations
    length = files.summary.views[number].size[axis]
    own = seen.view == number
    bins = np.clip((seen.xy[own, axis] + 0.5) * (_PROFILE_PARTS / length), 0, _PROFILE_PARTS - 1).astype(np.int64)
    middles = (np.arange(_PROFILE_PARTS) + 0.5) * (length / _PROFILE_PARTS)
    known = np.bincount(bins, minlength=_PROFILE_PARTS) >= _MIN_IN_BIN
    lines = {}
    for kind, residuals in (("before", seen.before[own]), ("after", seen.after[own])):
        found = np.stack([medians(column, bins, _PROFILE_PARTS) for column in residuals.T])
        use = known & np.isfinite(found).all(axis=0)
        if kind == "before" and use.sum() > 2:
            found = np.stack([row - np.polyval(np.polyfit(middles[use], row[use], 1), middles) for row in found])
        lines[kind] = middles[use], found[:, use]
    if len(lines["before"][0]) <= 2:
        return None
    reach = max(float(np.abs(found).max(initial=0.0)) for _, found in lines.values()) * 1.1 or 1.0
    wide, high = (_PROFILE_RIGHT - _PROFILE_LEFT) / length, (_PROFILE[1] - 46.0) / 2
    rows = []
    for k, words in enumerate(("column", "row")):
        zero = 10.0 + high * (k + 0.5) + 14.0 * k
        marks = [(zero - t * high / (2 * reach), f"{t:g}") for t in round_ticks(-reach, reach, 4)]
        y = {kind: zero - found[k] * high / (2 * reach) for kind, (_, found) in lines.items()}
        drawn = [
            (f"line {kind}", np.column_stack([_PROFILE_LEFT + at * wide, y[kind]]).tolist())
            for kind, (at, _) in lines.items()
            if len(at)
        ]
        rows.append((f"{words} residual [px]", marks, drawn))
    text = template("drawings.svg.j2").module.profile(
        key=f"profile-{number}-{axis}",
        title=f"Residuals of {image} along its {AXES[axis]}",
        described=f"Medians in {_PROFILE_PARTS} parts; {counted(int(own.sum()), 'observation')}.",
        width=_PROFILE[0],
        height=_PROFILE[1],
        bands=[tuple(_PROFILE_LEFT + np.clip(band, 0, length) * wide) for band in bands],
        rows=rows,
        ticks=[(_PROFILE_LEFT + t * wide, f"{t:g}") for t in round_ticks(0, length, 5)],
        left=_PROFILE_LEFT,
        right=_PROFILE_RIGHT,
    )
    caption = f"{image}: medians of the residuals along its {AXES[axis]}, delivered cameras less a straight line"
    caption += " (orange), new RPCs (blue)" if len(lines["after"][0]) else ""
    return text, caption + "; shaded: the part that is named." * bool(bands) + "." * (not bands)


def length_bars(by_length: Mapping[str, int]) -> str:
    """Draw the number of tie points by the number of images that see them."""
    shown = [(length, count) for length, count in by_length.items() if count]
    most, wide = max(count for _, count in shown), (WIDTH - 8.0) / len(shown)
    columns = [(4 + k * wide, 0.84 * wide, 120.0 * n / most, length, n) for k, (length, n) in enumerate(shown)]
    described = f"From {shown[0][0]} to {shown[-1][0]} images; the largest column: {most} tie points."
    text: str = template("drawings.svg.j2").module.bars(
        "lengths", "Tie points by the number of images that see them", described, WIDTH, 160.0, columns
    )
    return text
