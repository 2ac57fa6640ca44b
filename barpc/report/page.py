"""report.html: one self-contained page, made from summary.json and the tables of a run alone.

A section is a user's question, its answer, and the charts and tables behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.errors import listed, visible
from barpc.report.decisions import decisions
from barpc.report.maps import doubted, ground_map, largest_miss, residual_panels, template
from barpc.report.pictures import PICTURE_KEY, image_panels, length_bars, pair_strips, profile_charts
from barpc.report.ranking import (
    GOOD_RMSE,
    MIN_PAIR_MATCHES,
    SMOOTH_LEFT,
    TABLE_ROWS_SHOWN,
    VERDICT_SENTENCES,
    flagged,
    offset_of,
    sentences,
    sure_pairs,
    worst_first,
    worst_pairs,
)
from barpc.report.records import MAX_SHOWN, Record, Table, cell_of, flat_options, table, value_of
from barpc.report.runfiles import RunFiles, read_tables
from barpc.report.summary import Summary
from barpc.report.summary.block import DATUM, DatumEntry, ExplanationEntry, HeldOutEntry, LeftEntry
from barpc.report.summary.ground_points import GCP_CAPTION, CheckPointEntry, GcpEntry, ReferenceViewEntry
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.words import capital, counted, known, largest, metres, two_digits
from barpc.scene import connected_groups

_OPEN = "images", "map", "random", "accuracy"  # sections that many images leave open
MAX_LENGTHS_SAID = 4  # numbers of a sentence; more are a chart
_ZERO_PX = 1e-6  # px
_SYSTEMATIC = 1e-4  # probability of the F test below which residuals are systematic: `SmoothTest.found`
_FOOTER = (
    "Altitudes are above the WGS84 ellipsoid. Pixel (0, 0) is the centre of the first pixel. The numbers of this page "
    "are in summary.json and in the folder tables/: residuals.csv, observations.csv, pairs.csv, footprints.geojson."
)
REPORT_STAGE = "report"  # the stage that makes the page


def can_render() -> bool:
    """Return whether jinja2, which the page needs, is installed (the extra ``report``)."""
    return find_spec("jinja2") is not None


def report_html(summary: Summary, folder: Path | str) -> str:
    """Return the page of a run from its summary and the tables of its folder; the same files give the same text.

    InputError where a table is missing or damaged.
    """
    return page_of(read_tables(summary, Path(folder)))


def page_of(files: RunFiles) -> str:
    """Return the page of a run from its files."""
    summary = files.summary
    shown = [section for make in SECTIONS if (section := make(files)) is not None]
    if len(summary.views) > TABLE_ROWS_SHOWN:
        shown = [replace(section, folded=section.key not in _OPEN) for section in shown]
    return visible(
        template("template.html.j2").render(
            summary=summary,
            sections=shown,
            keys={section.key: section.question for section in shown},
            verdict=[*chain.from_iterable(sentences(summary))],
            large=len(summary.views) > TABLE_ROWS_SHOWN,
            shown_lines=VERDICT_SENTENCES,
            folded=_FOLDED,
            most=MAX_SHOWN,
            footer=_FOOTER,
        )
    )


Pictures = Sequence[tuple[str, str]]  # SVG texts with their captions


@dataclass(frozen=True)
class Section:
    """A question, its answer, and its charts and tables.

    `points`: sentences; `panels`: small maps; `folds`: captions and further panels that open on demand; `folded`: the
    section opens on demand.
    """

    key: str
    question: str
    answer: str
    charts: Pictures = ()
    panels: Pictures = ()
    folds: Sequence[tuple[str, Pictures]] = ()
    points: Sequence[str] = ()
    tables: Sequence[Table] = ()
    folded: bool = False


_TABLE_CAPTIONS: dict[str, tuple[str, type[Record], str]] = {
    "images": (ViewEntry.CAPTION, ViewEntry, ViewEntry.PAGE),
    "pairs": (PairEntry.CAPTION, PairEntry, PairEntry.PAGE),
    "corrections": (
        "Corrections: shift at the image centre (corrected minus delivered) ± 1 sigma",
        ViewEntry,
        ViewEntry.CORRECTIONS,
    ),
    "places": (
        "Horizontal uncertainty where the line of sight of each image centre meets a given altitude",
        ViewEntry,
        ViewEntry.PLACES,
    ),
    "gcps": (GCP_CAPTION, GcpEntry, GcpEntry.PAGE),
    "control": ("Control in each image: the largest residual (Baarda's w)", ViewEntry, ViewEntry.CONTROL),
    "reference": ("Reference: offset of each delivered camera", ReferenceViewEntry, ReferenceViewEntry.PAGE),
    "decided": ("Images: prior sigmas, rejected observations, systematic residuals", ViewEntry, ViewEntry.DECISIONS),
    "explained": ("Hypotheses selected to explain residuals", ExplanationEntry, ExplanationEntry.PAGE),
    "left": ("Rows and columns inconsistent with the rest", LeftEntry, LeftEntry.PAGE),
    "worse": ("Regions with larger residuals of check tie points", HeldOutEntry, HeldOutEntry.PAGE),
    "again": ("Pairs matched again, and attempts with too few matches", PairEntry, PairEntry.AGAIN),
    "check-points": ("Check points: intersected minus given position", CheckPointEntry, CheckPointEntry.PAGE),
    "fits": ("Refitted RPCs against the corrected cameras, on independent points", ViewEntry, ViewEntry.FITS),
}
"""Key of a table -> its caption, and the columns of its records."""
_FOLDED = "places", "control", "decided", "again", "fits", "files", "options"


def _tables_of(key: str, rows: Sequence[Record], adjusted: bool = True) -> list[Table]:
    """Return a table, if it has rows, without the columns that are empty in all of them."""
    caption, kind, columns = _TABLE_CAPTIONS[key]
    found = table(key, caption, rows, kind, columns, adjusted)
    filled = [k for k in range(len(found.columns)) if any(row[k].text != "-" for row in found.rows)]
    heads, texts = ([every[k] for k in filled] for every in (found.columns, found.meanings))
    cells = [[row[k] for k in filled] for row in found.rows]
    return [replace(found, columns=heads, rows=cells, meanings=texts)] if rows else []


def _images_section(files: RunFiles) -> Section:
    views, number, adjusted = worst_first(files.summary.views), files.number, files.summary.adjusted
    (shown,) = _tables_of("images", views, adjusted)
    marks = [f"{number[view.name]}" for view in views]
    shown = replace(shown, caption=shown.caption + "; worst first" * bool(flagged(views)), marks=marks)
    good, panels = sum(not view.advice for view in views), image_panels(files)
    answer = f"{good} of {counted(len(views), 'image')}{', after review' * (good and not files.summary.passed)}."
    if adjusted and files.summary.pairs:
        answer += (
            " Residuals of tie points measure how well the images agree with each other, not their accuracy on the "
        )
        answer += "ground."
    answer += f" {PICTURE_KEY}" * bool(panels)
    return Section("images", "Which images can I use?", answer, tables=[shown], **_panels(panels))


def _panels(panels: Pictures) -> dict[str, Any]:
    """Return small maps as parts of a section: those beyond `TABLE_ROWS_SHOWN` open on demand."""
    shown, more = panels[:TABLE_ROWS_SHOWN], panels[TABLE_ROWS_SHOWN:]
    return {"panels": shown, "folds": [(f"{len(more)} more images", more)] if more else []}


def _map_section(files: RunFiles) -> Section:
    summary, number, num = files.summary, files.number, len(files.summary.views)
    links = [(number[pair.a], number[pair.b]) for pair in summary.pairs]
    partners = np.bincount(np.array(links, dtype=np.int64).ravel(), minlength=num)
    lonely = [view.name for view, n in zip(summary.views, partners, strict=True) if n == 1 and num > 2]
    miss = largest_miss(summary.gcps)
    drawn = {
        "Footprints at the altitude of the scene": True,
        "those that need review on top": any(view.advice for view in summary.views),
        "dots: tie points": len(files.points),
        f"triangles: GCPs{', red where they contradict others' * any(map(doubted, summary.gcps))}": summary.gcps,
        f"arrows: their residuals in plan (predicted minus given), the longest {metres(miss)}": miss,
        "inverted triangles: check points": summary.check_points,
        "thicker lines: more matches": len(links) > 1,
        "dashed: tie points that move": any(one.box for one in (summary.scene.explanations if summary.scene else ())),
        "shaded: rows or columns with few tie points": any(view.gap for view in summary.views),
    }
    caption = f"{'; '.join(words for words, some in drawn.items() if some)}."
    if num > MAX_SHOWN:
        caption += f" At most {MAX_SHOWN} of {num} footprints are drawn; all are in footprints.geojson."
    lengths = {length: count for length, count in summary.tracks.by_length.items() if count}
    charts = [(ground_map(files), caption)] if any(files.outlines) else []
    groups = len(connected_groups(num, links))
    tied = "All images are connected" if groups == 1 else f"The images form {groups} separate groups"
    said = ", ".join(f"{count} in {images} images" for images, count in lengths.items())
    said = f": {said}" * (1 < len(lengths) <= MAX_LENGTHS_SAID)
    answer = f"{tied}, with {counted(summary.tracks.num_tracks, 'matched tie point')}{said}."
    answer = answer if links else "There are no tie points in use."
    answer += f" Connected to one other image only: {listed(lonely)}." * bool(lonely)
    if len(lengths) > MAX_LENGTHS_SAID:
        charts.append((length_bars(lengths), "Tie points by the number of images that see them."))
    return Section("map", "Where are the images, and which are connected?", answer, charts=charts)


def _randomness_section(files: RunFiles) -> Section | None:
    if not len(files.observations.view):
        return None
    views, adjusted = files.summary.views, files.summary.adjusted
    first = [files.number[view.name] for view in flagged(views)]
    panels, shares, key = residual_panels(views, files.observations, "after" if adjusted else "before", first)
    marked = [view.name for view, share in zip(views, shares, strict=True) if share > 0.5]
    parts = _panels(panels)
    if adjusted:
        parts["folds"].append(("Before the adjustment", residual_panels(views, files.observations, "before", first)[0]))
    answer = f"{_randomness(views, marked)} {_LEGEND} {key}".strip()
    return Section("random", "Are the residuals random?", answer, **parts)


_LEGEND = (
    "Thin lines are residuals (projected minus observed). The colour is their RMS in each of 8 x 8 cells. A bold "
    "arrow, at twice the scale, is the mean of a cell where that exceeds three standard errors."
)


def _randomness(views: Sequence[ViewEntry], marked: Sequence[str]) -> str:
    """Return whether residuals are random; `marked`: images in most of whose cells they have a significant mean."""
    systematic = [(view.systematic_px or 0.0, view.name) for view in views if known(view.systematic_p) < _SYSTEMATIC]
    correlated = [(size, view.name) for view in views if (size := view.neighbour_correlated_px)]
    tests = ("systematic residuals (F test: p < 1e-4)", systematic), ("correlated neighbouring residuals", correlated)
    found = [
        f"{what} in {counted(len(sizes), 'image')}, at most {two_digits(max(sizes)[0])} px ({max(sizes)[1]})."
        for what, sizes in tests
        if sizes
    ]
    large = max([*systematic, *correlated], default=(0.0, ""))[0] > SMOOTH_LEFT
    found += [f"Up to {SMOOTH_LEFT:g} px needs no review."] * bool(found)
    if marked:
        found.append(f"Most cells of {listed(marked)} have a significant mean.")
    if found:
        return f"{'No' if marked or large else 'Nearly'}. {' '.join(map(capital, found))}"
    if all(view.systematic_p in (None, 1.0) for view in views):  # too few to test
        return "No image has a significant mean in most of its cells."
    return f"Yes: no image has {tests[0][0]}."


def _surface_section(files: RunFiles) -> Section | None:
    if not files.reliefs:
        return None
    before, after = files.reliefs
    picture = template("drawings.svg.j2").module.picture
    lit = "Surface from the {} cameras, lit from the north-west; black: no height"
    charts = [(picture(words := lit.format(one.cameras), [one]), f"{words}.") for one in files.reliefs]
    if files.draped:
        words = "{} (left) and {} (right) draped over the surface from the corrected cameras"
        words = words.format(*(one.image for one in files.draped))
        more = "move over it to swipe, click to flicker. Details at the right height do not move."
        charts.append((picture(words, files.draped), f"{words}: {more}"))
    answer = (
        f"In a sample of the surface model {100 * before.share:.0f} % of the cells have a height with the delivered "
        f"cameras, {100 * after.share:.0f} % with the corrected ones."
    )
    if before.nmad_m is not None and after.nmad_m is not None:
        answer += f" Heights of different pairs differ by {metres(before.nmad_m)} and {metres(after.nmad_m)} (NMAD)."
    return Section("surface", "Which ground do they reconstruct?", answer, charts=charts)


def _pairs_section(files: RunFiles) -> Section | None:
    pairs, number = worst_pairs(files.summary.pairs), files.number
    if not pairs:
        return None
    heights = any(pair.height_m_per_px and pair.convergence_deg for pair in sure_pairs(files.summary.views, pairs))
    worst, answer = max(pairs, key=offset_of), "Unknown: no camera of a pair projects the tie points of the other."
    if set(worst.offset_rms) != {None}:
        answer = f"The largest epipolar offset of a pair is {offset_of(worst):.3f} px (RMS; {worst.a} - {worst.b})."
        answer += f" Stereo needs less than {GOOD_RMSE} px."
    if not heights:
        enough = f"{MIN_PAIR_MATCHES} matches and a convergence angle that determines heights"
        answer += f" No pair of images that passed has {enough}."
    marks = ["{}-{}".format(*sorted((number[pair.a], number[pair.b]))) for pair in pairs]
    shown = replace(_tables_of("pairs", pairs, files.summary.adjusted)[0], marks=marks)
    return Section("pairs", "Do the pairs fit for stereo and heights?", answer, pair_strips(files), tables=[shown])


def _corrections_section(files: RunFiles) -> Section | None:
    views = files.summary.views
    known = [(one.center_shift_px, one.center_sigma_px) for view in views if (one := view.correction)]
    moves = [
        float(np.linalg.norm(np.array(shift, float)))
        for shift, sigma in known
        if shift and sigma and None not in (*shift, *sigma)
    ]
    if len(moves) < len(views):
        return None
    tables = _tables_of("corrections", views)
    tables += _tables_of("places", views if any(value_of(view, "correction.ellipse") for view in views) else ())
    answer = f"The largest shift at an image centre is {max(moves):.2f} px. The sigmas in the tables include the "
    answer += "uncertainty of the scene's position."
    return Section("moves", "How was each camera corrected?", answer, tables=tables)


def _decisions_section(files: RunFiles) -> Section | None:
    summary, scene = files.summary, files.summary.scene
    if not (points := decisions(summary)):
        return None
    tables = _tables_of("decided", summary.views if summary.adjusted else ())
    if scene is not None:
        tables += _tables_of("explained", scene.explanations) + _tables_of("left", scene.left)
        tables += _tables_of("worse", scene.held_out_places or ())
    tables += _tables_of("again", [pair for pair in summary.pairs if pair.beaten])
    return Section(
        "decisions", "What was decided, and why?", "", points=points, charts=profile_charts(files), tables=tables
    )


def _gauge_section(files: RunFiles) -> Section | None:
    summary, scene = files.summary, files.summary.scene
    if scene is None:
        return None
    shown = table("datum", DATUM, scene.datum, DatumEntry, DatumEntry.columns(scene.datum))
    tables = [shown] if scene.datum else []
    tables += _tables_of("gcps", summary.gcps)
    tables += _tables_of("control", [view for view in summary.views if view.control_w is not None])
    tables += _tables_of("reference", () if summary.reference is None else summary.reference.views)
    answer = "Tie points fix the images relative to each other. " * bool(summary.pairs)
    if placed := DatumEntry.columns(scene.datum[:3], least=0.05).split()[2:]:  # of east, north, up
        sources = table("", "", (), DatumEntry, " ".join(placed)).columns
        answer += f"The position on the Earth comes from {listed([f'the {source}' for source in sources])}. "
    if scene.num_held_in_height:
        held = counted(scene.num_held_in_height, "tie point")
        answer += f"The heights of {held} with too small a convergence angle were constrained."
    return Section("gauge", "How uncertain are position and shape of the scene?", answer.strip(), tables=tables)


def _check_points_section(files: RunFiles) -> Section | None:
    points = files.summary.check_points
    if not points:
        return None
    answer = f"The verdict has the RMS of {counted(len(points), 'check point')}, which the adjustment did not use."
    return Section("accuracy", "How accurate is it on the ground?", answer, tables=_tables_of("check-points", points))


def _files_section(files: RunFiles) -> Section | None:
    views = files.summary.views
    tables = _tables_of("fits", views if all(view.fit for view in views) else ())
    if outputs := {file: found for view in views for file, found in view.outputs.items()}:
        consumers = list(dict.fromkeys(consumer for found in outputs.values() for consumer in found))
        rows = [
            [cell_of(file), *(cell_of(found.get(name), ".1e") for name in consumers)] for file, found in outputs.items()
        ]
        caption = "Written files, read again by each program: largest difference from the corrected cameras"
        tables.append(Table("files", caption, ["file", *(f"{consumer} [px]" for consumer in consumers)], rows))
    worst = largest([value for view in views for value in (view.fit.max_px if view.fit else (None,))])
    if not tables:
        return None
    exact = "Not known for every image" if worst is None else f"Yes, to within {two_digits(max(worst, _ZERO_PX))} px"
    answer = f"{exact}. The original images still carry the delivered RPC."
    return Section("files", "Do the new RPC files reproduce the corrected cameras?", answer, tables=tables)


def _run_section(files: RunFiles) -> Section:
    rows = [[cell_of(key), cell_of(str(value))] for key, value in flat_options(files.summary.options or {}).items()]
    options = Table("options", "Options of the run", ["option", "value"], rows)
    some = f"Tables and charts show {files.summary.tables.num_written_tracks} tie points, sampled evenly."
    return Section("run", "With which options?", some * (not files.summary.tables.complete), tables=[options])


SECTIONS: Sequence[Callable[[RunFiles], Section | None]] = (
    _images_section, _map_section, _randomness_section, _pairs_section, _surface_section, _corrections_section,
    _gauge_section, _decisions_section, _check_points_section, _files_section, _run_section,
)  # fmt: skip
"""In the order of the page; an empty section is None."""
