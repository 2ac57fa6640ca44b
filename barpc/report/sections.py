"""The sections of the report: a question that a user has, the answer in words, the charts that show it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from barpc.report import charts, datatables
from barpc.report.datatables import DataTable
from barpc.report.load import RunFiles
from barpc.report.maps import ground_map
from barpc.report.panels import residual_panels
from barpc.report.svg import MAX_ROWS, numbered
from barpc.report.verdict import GOOD, metres
from barpc.scene import connected_groups

Record = Mapping[str, Any]

_NO_FIT: Record = {"max_px": [None]}


@dataclass(frozen=True)
class Section:
    """A question and its answer.

    Parameters
    ----------
    key : str
        Anchor on the page.
    question : str
        The heading.
    answer : str
        A sentence or two.
    charts : sequence of (str, str)
        SVG texts with their captions.
    panels : sequence of (str, str)
        Small maps with their captions.
    folds : sequence of (str, panels)
        Words, and more small maps that open on demand.
    bars : sequence of (str, str, float)
        Words, a value as text, and the length of a bar in percent.
    tables : sequence of DataTable
        Tables.
    half : bool
        Whether half the width of a desk's screen is enough.
    """

    key: str
    question: str
    answer: str
    charts: Sequence[tuple[str, str]] = ()
    panels: Sequence[tuple[str, str]] = ()
    folds: Sequence[tuple[str, Sequence[tuple[str, str]]]] = ()
    bars: Sequence[tuple[str, str, float]] = ()
    tables: Sequence[DataTable] = ()
    half: bool = False


def _images(files: RunFiles) -> Section:
    summary = files.summary
    good = sum(view["status"] in GOOD.values() for view in summary["views"])
    answer = f"{good} of {len(summary['views'])} without reservation."
    todo = [view for view in summary["views"] if view["advice"]]
    answer += " What to do about the others stands in the verdict above." if todo else ""
    table = datatables.views_table(summary)
    return Section("images", "Which images can I use?", answer, tables=[table])


def _map(files: RunFiles) -> Section | None:
    views, pairs = files.summary["views"], files.summary["pairs"]
    known = files.summary["gcps"] + files.summary["check_points"]
    shown = []
    if any(files.outlines):
        caption = (
            "Outlines at the altitude of the scene with their numbers in the table of images; dots are tie points;"
            " a stronger line stands for more matches."
            + " Triangles are GCPs, those on their tip check points."
            * bool(known)
        )
        shown.append((ground_map(files), caption))
    if pairs and len(views) > 2:
        caption = "Numbers as in the table of images; a thicker line is a pair with more matches."
        shown.append((charts.connections(views, pairs), caption))
    return Section("map", "Where are the images, and which hold together?", _bonds(views, pairs), shown)


def _bonds(views: Sequence[Record], pairs: Sequence[Record]) -> str:
    index = {view["name"]: k for k, view in enumerate(views)}
    links = [(index[pair["a"]], index[pair["b"]]) for pair in pairs]
    groups = connected_groups(len(views), links)
    partners = np.bincount(np.array(links, dtype=np.int64).ravel(), minlength=len(views))
    lonely = [view["name"] for view, n in zip(views, partners, strict=True) if n == 1]
    answer = (
        "All images hang together."
        if len(groups) == 1
        else f"By tie points they fall into {len(groups)} groups."
    )
    if lonely and len(views) > 2:
        answer += f" Tied to one other image only: {_some(lonely)}."
    return answer


def _some(names: Sequence[str], most: int = 6) -> str:
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")


def _errors(files: RunFiles) -> Section | None:
    table = files.observations
    if not len(table.view):
        return None
    norms = [np.hypot(*r[table.used & np.isfinite(r).all(axis=1)].T) for r in (table.before, table.after)]
    if not any((norm > 0).any() for norm in norms):
        return None
    views = files.summary["views"]
    labels = numbered([view["name"] for view in views])
    rows = [
        charts.Row(text, view["name"], view["rmse_before"], view["rmse_after"])
        for text, view in zip(labels, views, strict=True)
    ]
    adjusted = files.summary["kind"] == "adjust"
    shown = [(charts.histogram(*norms), "All observations that count; each curve is drawn to its own peak.")]
    axis = "root mean square reprojection error [px], logarithmic"
    shown.append(
        (charts.dumbbells("rmse", "Error of each image", axis, rows), _which(rows, "images", "error"))
    )
    if not adjusted:
        answer = f"Half of the observations lie within {np.median(norms[0]):.3f} px of where their cameras put them."
        return Section("errors", "How large are the errors?", answer, shown)
    medians = [float(np.median(norm)) for norm in norms]
    answer = (
        f"The median reprojection error went from {medians[0]:.3f} px to {medians[1]:.3f} px."
        " These are the points the adjustment was made of: it shows agreement, not accuracy on the ground."
    )
    return Section("errors", "Did the adjustment help?", answer, shown)


def _which(rows: Sequence[Any], what: str, by: str) -> str:
    if len(rows) <= MAX_ROWS:
        return f"All {what}."
    return f"The {MAX_ROWS} of {len(rows)} {what} with the largest {by}."


def _randomness(files: RunFiles) -> Section | None:
    if not len(files.observations.view):
        return None
    views, adjusted = files.summary["views"], files.summary["kind"] == "adjust"
    panels = residual_panels(views, files.observations, "after" if adjusted else "before")
    marked = [view["name"] for view, share in zip(views, panels.shares, strict=True) if share > 0.5]
    if marked:
        answer = f"Not in {_some(marked)}: in most of their cells the residuals point the same way."
        answer += (
            " Small ones are usual (attitude jitter, relief); where they matter, the verdict says so."
            * adjusted
        )
    else:
        answer = "Mostly: in no image do residuals point the same way in more than half of the cells."
    answer += (
        " A cell is darker where its error is larger; thin lines are single residuals; a bold arrow is the mean of a"
        f" cell that is larger than chance allows. {panels.key}"
    )
    folds = []
    if adjusted:
        before = residual_panels(views, files.observations, "before")
        folds.append((f"Before the adjustment. {before.key}", before.charts))
    return Section("random", "Are the residuals random?", answer, panels=panels.charts, folds=folds)


def _pairs(files: RunFiles) -> Section | None:
    pairs = files.summary["pairs"]
    if not pairs:
        return None
    number = {view["name"]: k + 1 for k, view in enumerate(files.summary["views"])}
    rows = []
    for pair in pairs:
        both = (pair["epipolar_before"], pair["epipolar_after"])
        rms = [None if offset is None else offset["rms"] for offset in both]
        numbers = f"{number[pair['a']]} - {number[pair['b']]}"
        rows.append(charts.Row(numbers, f"{pair['a']} - {pair['b']}", rms[0], rms[1]))
    answer = (
        f"The epipolar offset, which no height explains, is {max(row.last for row in rows):.3f} px (RMS) in the worst"
        " pair; stereo matching along epipolar lines wants it well below 0.5 px."
    )
    axis = "RMS distance from the epipolar line [px], logarithmic"
    chart = charts.dumbbells("epipolar", "Epipolar offset of each pair", axis, rows)
    shown = [(chart, f"{_which(rows, 'pairs', 'offset')} Numbers are those of the images.")]
    seen = [pair for pair in pairs if None not in (pair["convergence_deg"], pair["base_to_height"])]
    if seen:
        caption = "One dot a pair. Small angles give weak heights; beyond about 35 degrees images look too different."
        shown.append((charts.convergence(seen), caption))
        answer += _heights(seen)
    table = datatables.pairs_table(files.summary)
    return Section(
        "pairs", "Do the pairs fit for stereo, and can heights be measured?", answer, shown, tables=[table]
    )


def _heights(pairs: Sequence[Record]) -> str:
    best = min(pairs, key=lambda pair: pair["height_m_per_px"] or np.inf)
    if not best["height_m_per_px"]:
        return " No pair says anything about heights: all rays are parallel."
    words = (
        f" Heights come best from {best['a']} - {best['b']}: the rays meet under {best['convergence_deg']:.1f} degrees"
        f" (B/H {best['base_to_height']:.2f}), so one pixel of parallax is {metres(best['height_m_per_px'])} of height."
    )
    weak = sum(pair["convergence_deg"] < 1.0 for pair in pairs)
    if weak:
        words += f" {weak} of {len(pairs)} pairs meet under less than one degree and say next to nothing about heights."
    return words


def _corrections(files: RunFiles) -> Section | None:
    views = files.summary["views"]
    moves = [view["correction"] or {} for view in views]
    keys = ("center_shift_px", "center_sigma_px")
    if any(move.get(key) is None or None in move[key] for move in moves for key in keys):
        return None
    largest = max(float(np.hypot(*move["center_shift_px"])) for move in moves)
    sigma = max(float(np.hypot(*move["center_sigma_px"])) for move in moves)
    answer = (
        f"Up to {largest:.2f} px in the middle of an image. The adjustment itself predicts this to be known to"
        f" {sigma:.2g} px (one sigma, the worst image)."
    )
    if not files.summary["gcps"]:
        answer += " Most of that is common to all images: the scene's own place, which no tie point can tell."
    labels = numbered([view["name"] for view in views])
    chart = (charts.corrections(views, labels), _which(views, "images", "shift"))
    table = datatables.corrections_table(files.summary)
    return Section("moves", "What was changed in each camera?", answer, [chart], tables=[table], half=True)


def _gauge(files: RunFiles) -> Section | None:
    scene = files.summary["scene"]
    if scene is None:
        return None
    modes = scene["weakest_modes"]
    most = max([mode["sigma_m"] for mode in modes if mode["sigma_m"]], default=1.0)
    bars = [
        (_sentence(m["words"]), metres(m["sigma_m"]), 100 * m["sigma_m"] / most)
        for m in modes
        if m["sigma_m"]
    ]
    answer = "Images fix each other, not their place on the Earth. What is left open, one sigma, the weakest first."
    if scene["num_held_in_height"]:
        answer += (
            f" {scene['num_held_in_height']} tie points seen under too small an angle were held in height."
        )
    tables = [datatables.gcps_table(files.summary)] if files.summary["gcps"] else []
    if not tables:
        answer += " Ground control points (--gcp) are what helps where it matters."
    return Section("gauge", "What can the images not tell?", answer, bars=bars, tables=tables, half=True)


def _sentence(words: str) -> str:
    return f"{words[0].upper()}{words[1:]}"


def _check_points(files: RunFiles) -> Section | None:
    points = files.summary["check_points"]
    if not points:
        return None
    observations = [o["residual_px"] for point in points for o in point["observations"]]
    image = np.array([r for r in observations if None not in r]).reshape(-1, 2)
    ground = np.array([p["residual_enu_m"] for p in points if None not in p["residual_enu_m"]]).reshape(-1, 3)
    parts = []
    if len(image):
        parts.append(f"{np.sqrt((image**2).sum(axis=1).mean()):.2f} px in the images")
    if len(ground):
        rms = ", ".join(metres(value) for value in np.sqrt((ground**2).mean(axis=0)))
        parts.append(f"{rms} east, north, up on the ground")
    found = " and ".join(parts) or "nothing: no camera sees them"
    answer = f"{len(points)} check points, which the adjustment did not see, are met to {found} (RMS)."
    table = datatables.check_points_table(files.summary)
    return Section("accuracy", "How accurate is it on the ground?", answer, tables=[table])


def _files(files: RunFiles) -> Section | None:
    summary = files.summary
    tables = [datatables.fits_table(summary)] if all(view["fit"] for view in summary["views"]) else []
    if any(view["outputs"] for view in summary["views"]):
        tables.append(datatables.files_table(summary))
    if not tables:
        return None
    worst = datatables.largest(
        [value for view in summary["views"] for value in (view["fit"] or _NO_FIT)["max_px"]]
    )
    answer = (
        "Not known for every image."
        if worst is None
        else f"Yes, to {worst:.1e} px at worst, on check points over each image and its altitudes."
    )
    answer += (
        " Every file was reopened and compared before it counted as written. Give other tools these files, never the"
        " old image alone."
    )
    return Section("files", "Do the new RPC files hold the corrected cameras?", answer, tables=tables)


def _run(files: RunFiles) -> Section:
    summary = files.summary
    seconds = sum(stage["seconds"] for stage in summary["stages"])
    tracks = summary["tracks"]
    answer = (
        f"{len(summary['views'])} images, {tracks['num_tracks']} tie points, {tracks['num_observations']} observations"
        + (f", {seconds:.1f} s." if summary["stages"] else ".")
    )
    if not summary["tables"]["complete"]:
        answer += (
            f" Tables and charts hold {summary['tables']['num_written_tracks']} tie points, evenly taken."
        )
    longest = max([stage["seconds"] for stage in summary["stages"]], default=1.0) or 1.0
    bars = [(s["stage"], f"{s['seconds']:.2f} s", 100 * s["seconds"] / longest) for s in summary["stages"]]
    tables = [datatables.stages_table(summary), datatables.options_table(summary)]
    return Section("run", "How was this made, and how long did it take?", answer, bars=bars, tables=tables)


SECTIONS: Sequence[Callable[[RunFiles], Section | None]] = (
    _images,
    _map,
    _errors,
    _randomness,
    _pairs,
    _corrections,
    _gauge,
    _check_points,
    _files,
    _run,
)
"""In the order of the page; a section that has nothing to show is None."""


def sections(files: RunFiles) -> list[Section]:
    """All sections of a run."""
    return [section for make in SECTIONS if (section := make(files)) is not None]
