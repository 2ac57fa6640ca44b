"""report.html: one self-contained page, made from summary.json and the tables of a run alone.

A section is a question that a user has, the answer in words, and the charts and tables that show it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.errors import BarpcError, visible
from barpc.report.compare import flat_options
from barpc.report.digest import SHOWN, decisions, flagged, offset_of, sentences, worst_first, worst_pairs
from barpc.report.maps import ground_map, residual_panels, tag
from barpc.report.records import MAX_SHOWN, Record, Table, cell_of, table, value_of
from barpc.report.reservations import FEW_OBSERVATIONS, GOOD_RMSE
from barpc.report.summary import StageEntry, Summary
from barpc.report.summary.known import GCPS, CheckPointEntry, GcpEntry, ReferenceViewEntry
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.whole import DATUM, DatumEntry, ExplanationEntry, HeldOutEntry, LeftEntry
from barpc.report.summary.words import NAMED, counted, largest, listed, metres
from barpc.report.tables import Draped, ReliefWindow, RunFiles, read_summary, read_tables
from barpc.scene import connected_groups
from barpc.workspace import Workspace

NAME = "report.html"
_SHOWN_LINES = 16  # sentences of the verdict, before the rest is unfolded
_OPEN = "images", "map", "random", "accuracy"  # sections that many images leave open
REPORT = "report"  # the stage that makes the page, which cannot tell how long it took


def can_render() -> bool:
    """Return whether jinja2, which the page needs, is installed (the extra ``report``)."""
    return find_spec("jinja2") is not None


def report_html(summary: Summary, folder: Path | str) -> str:
    """Return the page of a run whose tables lie in a folder; the same files give the same text.

    Raises
    ------
    InputError
        A table is missing or damaged.
    """
    files = read_tables(summary, Path(folder))
    shown = [section for make in SECTIONS if (section := make(files)) is not None]
    if len(summary.views) > SHOWN:
        shown = [replace(section, folded=section.key not in _OPEN) for section in shown]
    return visible(
        _template().render(
            summary=summary,
            sections=shown,
            verdict=sentences(summary),
            large=len(summary.views) > SHOWN,
            shown_lines=_SHOWN_LINES,
            folded=_FOLDED,
            most=MAX_SHOWN,
        )
    )


@cache
def _template() -> Any:
    import jinja2

    loader, undefined = jinja2.PackageLoader("barpc.report", ""), jinja2.StrictUndefined
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=undefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("template.html.j2")


def remake_report(folder: Path | str) -> Path:
    """Make report.html of a finished run again, from its files.

    Raises
    ------
    InputError
        The folder holds no finished run.
    OutputError
        There is a report.html that barpc did not write, or that was changed since.
    BarpcError
        jinja2 is not installed.
    """
    folder = Path(folder)
    summary = read_summary(folder)
    if not can_render():
        raise BarpcError("the report needs jinja2: pip install 'barpc[report]'")
    html = report_html(summary, folder)
    with Workspace(folder, overwrite=True, names=[NAME], adds=True) as workspace:
        workspace.write_text(NAME, html)
    return folder / NAME


Pictures = Sequence[tuple[str, str]]  # SVG texts with their captions


@dataclass(frozen=True)
class Section:
    """A question and its answer, with what shows it.

    `points`: sentences; `panels`: small maps; `folds`: words and more of them that open on demand; `folded`: it opens
    on demand.
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


_TABLES: dict[str, tuple[str, type[Record], str]] = {
    "images": ("Images: errors (RMS) of the tie points that count; worst first", ViewEntry, ViewEntry.PAGE),
    "pairs": ("Pairs: offset from the epipolar line, median ± spread (1.4826 MAD)", PairEntry, PairEntry.PAGE),
    "corrections": ("Corrections: shift in the middle of the image ± one sigma", ViewEntry, ViewEntry.CORRECTIONS),
    "places": (
        "Ground in the middle of each image: one-sigma ellipse, CE90 and CE90 stated",
        ViewEntry,
        ViewEntry.PLACES,
    ),
    "gcps": (GCPS, GcpEntry, GcpEntry.PAGE),
    "control": ("Control in each image: the largest residual (Baarda's w)", ViewEntry, ViewEntry.CONTROL),
    "reference": ("Reference: what it says of each delivered camera", ReferenceViewEntry, ReferenceViewEntry.PAGE),
    "decided": ("Figures of each image: its prior widened, what was cut, what is left", ViewEntry, ViewEntry.DECISIONS),
    "explained": ("What explains tie points beside the cameras' errors", ExplanationEntry, ExplanationEntry.PAGE),
    "left": ("What still stands out", LeftEntry, LeftEntry.PAGE),
    "worse": ("Tie points that took no part", HeldOutEntry, HeldOutEntry.PAGE),
    "again": ("Pairs that were tried again, and what found too few matches", PairEntry, PairEntry.AGAIN),
    "check-points": ("Check points: found minus given place", CheckPointEntry, CheckPointEntry.PAGE),
    "fits": ("Refitted RPCs against the corrected cameras, on points new to the fit", ViewEntry, ViewEntry.FITS),
    "stages": ("Stages of the run", StageEntry, StageEntry.PAGE),
}
"""Key of a table -> its caption, and the columns of its records."""
_FOLDED = "places", "control", "decided", "again", "options"


def _table(key: str, rows: Sequence[Record], adjusted: bool = True, without: str = " ", more: str = "") -> list[Table]:
    """Return a table, if it has rows; `without`: columns that have nothing to say."""
    caption, kind, columns = _TABLES[key]
    columns = columns.replace(without, " ") + more
    return [table(key, caption, rows, kind, columns, adjusted)] if rows else []


def _images(files: RunFiles) -> Section:
    views, number = worst_first(files.summary.views), files.number
    answer = f"{sum(not view.advice for view in views)} of {len(views)} without reservation."
    if files.summary.adjusted:
        answer += " What is left after the adjustment is agreement, not accuracy on the ground."
    nothing = " " if any(view.cause for view in views) else " wrong "
    shown = _table("images", views, files.summary.adjusted, nothing)
    marks = [f"{number[view.name]}" for view in views]
    return Section("images", "Which images can I use?", answer, tables=[replace(one, marks=marks) for one in shown])


def _map(files: RunFiles) -> Section:
    summary, number, num = files.summary, files.number, len(files.summary.views)
    links = [(number[pair.a], number[pair.b]) for pair in summary.pairs]
    groups = len(connected_groups(num, links))
    partners = np.bincount(np.array(links, dtype=np.int64).ravel(), minlength=num)
    lonely = [view.name for view, n in zip(summary.views, partners, strict=True) if n == 1 and num > 2]
    answer = f"By tie points they fall into {groups} groups." if groups > 1 else "All images hang together."
    answer += f" Tied to one other image only: {listed(lonely)}." * bool(lonely)
    lengths = [f"{count} in {length}" for length, count in summary.tracks.by_length.items() if count]
    answer += f" Tie points are seen in so many images: {', '.join(lengths)}." * bool(lengths)
    caption = (
        "Outlines at the altitude of the scene, those that need a look on top; dots are tie points, triangles GCPs, "
        "those on their tip check points; a stronger line stands for more matches; dashed: where tie points move."
    )
    if num > MAX_SHOWN:
        caption += f" At most {MAX_SHOWN} of {num} outlines are drawn; all are in footprints.geojson."
    shown = [(ground_map(files), caption)] if any(files.outlines) else []
    return Section("map", "Where are the images, and which hold together?", answer, shown)


def _randomness(files: RunFiles) -> Section | None:
    if not len(files.observations.view):
        return None
    views, adjusted, folds = files.summary.views, files.summary.adjusted, []
    first = [files.number[view.name] for view in flagged(views)]
    panels, shares, key = residual_panels(views, files.observations, "after" if adjusted else "before", first)
    marked = [view.name for view, share in zip(views, shares, strict=True) if share > 0.5]
    answer = "Mostly: in no image do residuals point the same way in more than half of the cells."
    if marked:
        answer = f"Not in {listed(marked)}: in most of their cells the residuals point the same way."
    answer += (
        " A cell is darker where its error is larger; thin lines are single residuals; a bold arrow is the mean of a"
        f" cell that is larger than chance allows. {key}"
    )
    if len(panels) > SHOWN:
        folds.append((f"{len(panels) - SHOWN} more images", panels[SHOWN:]))
    if adjusted:
        before, _, key = residual_panels(views, files.observations, "before", first)
        folds.append((f"Before the adjustment. {key}", before))
    return Section("random", "Are the residuals random?", answer, panels=panels[:SHOWN], folds=folds)


def _surface(files: RunFiles) -> Section | None:
    if not files.reliefs:
        return None
    before, after = files.reliefs
    answer = (
        f"A window of the surface made of it: {100 * before.share:.0f} % of its cells have a height by the delivered"
        f" cameras, {100 * after.share:.0f} % by the corrected ones."
    )
    if before.nmad_m is not None and after.nmad_m is not None:
        answer += f" Pairs of images disagree by {metres(before.nmad_m)} and by {metres(after.nmad_m)} (medians)."
    lit = "The ground by the {} cameras, lit from the north-west; black: no height"
    shown = [_picture(lit.format(one.cameras), "", one) for one in files.reliefs]
    if files.draped:
        words = "{} (left) and {} (right) on the surface by the corrected cameras"
        more = ": move over it to swipe, click to flicker. What stands still has the right height"
        shown.append(_picture(words.format(*(one.image for one in files.draped)), more, *files.draped))
    return Section("surface", "What do they make of the ground?", answer, shown)


def _picture(words: str, more: str, *parts: ReliefWindow | Draped) -> tuple[str, str]:
    """Return pictures over each other, with a seam between two, and the caption."""
    width, height = parts[0].size
    shown = [
        tag("image", href=f"data:image/jpeg;base64,{one.picture}", width=width, height=height, class_=class_)
        for one, class_ in zip(parts, ("under", "over"), strict=False)
    ]
    swipe = {"class_": "swipe", "tabindex": 0} if len(parts) > 1 else {}
    seam = [tag("rect", class_="seam", width=2, height=height)] * bool(swipe)
    box = f"0 0 {width} {height}"
    return tag("svg", *shown, *seam, viewBox=box, role="img", aria_label=words, **swipe), f"{words}{more}."


def _pairs(files: RunFiles) -> Section | None:
    pairs, number = worst_pairs(files.summary.pairs), files.number
    if not pairs:
        return None
    worst = max(pairs, key=offset_of)
    answer = (
        f"The epipolar offset, which no height explains, is {offset_of(worst):.3f} px (RMS) in the worst pair"
        f" ({worst.a} - {worst.b}); stereo matching along epipolar lines wants it well below {GOOD_RMSE:g} px."
    )
    doubted = {view.name for view in files.summary.views if view.advice}
    sure = [p for p in pairs if p.num_matches >= FEW_OBSERVATIONS and not {p.a, p.b} & doubted]
    heights = [(p.height_m_per_px, p.convergence_deg, p) for p in sure if p.height_m_per_px and p.convergence_deg]
    if heights:
        per_pixel, angle, best = min(heights, key=lambda one: one[0])
        answer += (
            f" Heights come best from {best.a} - {best.b}: the rays meet under {angle:.1f} degrees, so one pixel of"
            f" parallax is {metres(per_pixel)} of height."
        )
    else:
        answer += f" No pair of images without reservation, {FEW_OBSERVATIONS} matches and an angle tells of heights."
    shown = _table("pairs", pairs, files.summary.adjusted)
    marks = ["{}-{}".format(*sorted((number[pair.a], number[pair.b]))) for pair in pairs]
    question = "Do the pairs fit for stereo, and can heights be measured?"
    return Section("pairs", question, answer, tables=[replace(one, marks=marks) for one in shown])


def _corrections(files: RunFiles) -> Section | None:
    views = files.summary.views
    known = [(one.center_shift_px, one.center_sigma_px) for view in views if (one := view.correction)]
    moves = [
        float(np.linalg.norm(np.array(shift, float)))
        for shift, sigma in known
        if shift and sigma and None not in (*shift, *sigma)
    ]
    if len(moves) < len(views):
        return None
    answer = f"Up to {max(moves):.2f} px in the middle of an image."
    if not files.summary.gcps:
        answer += " Most of that is common to all images: the scene's own place, which no tie point can tell."
    radars = any(value_of(view, "correction.range_m") is not None for view in views)
    tables = _table("corrections", views, more=ViewEntry.CLOCKS * radars)
    tables += _table("places", views if any(value_of(view, "correction.ellipse") for view in views) else ())
    return Section("moves", "What was changed in each camera?", answer, tables=tables)


def _decisions(files: RunFiles) -> Section | None:
    summary, scene = files.summary, files.summary.scene
    points = decisions(summary)
    tables = _table("decided", summary.views if summary.adjusted else ())
    if scene is not None:
        tables += _table("explained", scene.explanations) + _table("left", scene.left)
        tables += _table("worse", scene.held_out_places or ())
    tables += _table("again", [pair for pair in summary.pairs if pair.beaten])
    answer = "Figures that the run decided by; what was asked for by an option is said to be."
    return Section("decisions", "What was decided, and why?", answer, points=points, tables=tables) if points else None


def _gauge(files: RunFiles) -> Section | None:
    scene, reference = files.summary.scene, files.summary.reference
    if scene is None:
        return None
    points = [f"{mode.words[0].upper()}{mode.words[1:]}." for mode in scene.weakest_modes[:NAMED] if mode.sigma_m]
    answer = "Images fix each other, not their place on the Earth. What is left open, one sigma, the weakest first."
    if scene.num_held_in_height:
        answer += f" {scene.num_held_in_height} tie points seen under too small an angle were held in height."
    if not files.summary.gcps and not (reference and reference.used):
        answer += " Ground control points (--gcp) are what helps where it matters."
    columns = DatumEntry.columns(scene.datum)
    tables = [table("datum", DATUM, scene.datum, DatumEntry, columns)] if scene.datum else []
    tables += _table("gcps", files.summary.gcps)
    tables += _table("control", [view for view in files.summary.views if view.control_w is not None])
    tables += _table("reference", () if reference is None else reference.views)
    return Section("gauge", "What can the images not tell?", answer, points=points, tables=tables)


def _check_points(files: RunFiles) -> Section | None:
    points = files.summary.check_points
    answer = f"{counted(len(points), 'check point')}, which the adjustment did not see; "
    answer += "what they are met to, the verdict says."
    shown = _table("check-points", points)
    return Section("accuracy", "How accurate is it on the ground?", answer, tables=shown) if points else None


def _files(files: RunFiles) -> Section | None:
    views = files.summary.views
    tables = _table("fits", views if all(view.fit for view in views) else ())
    if outputs := {file: found for view in views for file, found in view.outputs.items()}:
        consumers = list(dict.fromkeys(consumer for found in outputs.values() for consumer in found))
        rows = [
            [cell_of(file), *(cell_of(found.get(name), ".1e") for name in consumers)] for file, found in outputs.items()
        ]
        caption = "Files reopened as their readers do: largest difference to the corrected cameras [px]"
        tables.append(Table("files", caption, ["file", *(f"{consumer} [px]" for consumer in consumers)], rows))
    worst = largest([value for view in views for value in (view.fit.max_px if view.fit else (None,))])
    answer = f"Yes, to {worst or 0.0:.1e} px at worst, on check points over each image and its altitudes."
    answer = "Not known for every image." if worst is None else answer
    answer += " Give other tools these files, never the old image alone."
    question = "Do the new RPC files hold the corrected cameras?"
    return Section("files", question, answer, tables=tables) if tables else None


def _run(files: RunFiles) -> Section:
    summary, tracks = files.summary, files.summary.tracks
    stages = [stage for stage in summary.stages if stage.stage != REPORT]
    counts = f"{counted(tracks.num_tracks, 'tie point')}, {counted(tracks.num_observations, 'observation')}"
    seconds = f", {sum(stage.seconds for stage in stages):.1f} s" if stages else ""
    answer = f"{counted(len(summary.views), 'image')}, {counts}{seconds}."
    if not summary.tables.complete:
        answer += f" Tables and charts hold {summary.tables.num_written_tracks} tie points, evenly taken."
    rows = [[cell_of(key), cell_of(str(value))] for key, value in flat_options(summary.options or {}).items()]
    options = Table("options", "Options of the run", ["option", "value"], rows)
    question = "How was this made, and how long did it take?"
    return Section("run", question, answer, tables=[*_table("stages", stages), options])


SECTIONS: Sequence[Callable[[RunFiles], Section | None]] = (
    _images, _map, _randomness, _pairs, _surface, _corrections, _gauge, _decisions, _check_points, _files, _run
)  # fmt: skip
"""In the order of the page; a section that has nothing to show is None."""
