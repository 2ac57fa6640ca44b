"""report.html: one self-contained page, made from summary.json and the tables of a run alone.

A section is a question that a user has, the answer in words, and the charts and tables that show it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from barpc.errors import BarpcError, visible
from barpc.geodesy import Array
from barpc.report import charts
from barpc.report.compare import flat_options
from barpc.report.decisions import decisions, second_attempts
from barpc.report.digest import SHOWN, flagged, offset_of, sentences, worst_first, worst_pairs
from barpc.report.maps import ground_map, residual_panels
from barpc.report.matrix import facts, pair_matrix
from barpc.report.records import Cell, Table, cell_of, table
from barpc.report.reservations import FEW_OBSERVATIONS, GOOD, GOOD_RMSE
from barpc.report.summary import StageEntry, Summary
from barpc.report.summary.known import GCPS, CheckPointEntry, GcpEntry, ReferenceViewEntry
from barpc.report.summary.pairs import PairEntry
from barpc.report.summary.views import ViewEntry
from barpc.report.summary.whole import DATUM, DatumEntry
from barpc.report.summary.words import STATUS_WORDS, counted, largest, listed, metres
from barpc.report.tables import Draped, ReliefWindow, RunFiles, read_summary, read_tables
from barpc.scene import connected_groups
from barpc.workspace import Workspace

NAME = "report.html"
_MOST_LINES = 200  # sentences of the verdict
_SHOWN_LINES = 16  # of these, before the rest is unfolded
_LENGTHS = "How many images see a tie point"
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
        shown = [replace(section, folded=section.key not in _OPEN, half=False) for section in shown]
    known = facts(files) if len(summary.views) <= charts.MAX_DRAWN else {"views": [], "pairs": []}
    return visible(
        _template().render(
            summary=summary,
            sections=shown,
            verdict=sentences(summary),
            large=len(summary.views) > SHOWN,
            shown_lines=_SHOWN_LINES,
            words=STATUS_WORDS,
            most_lines=_MOST_LINES,
            facts=json.dumps(known, separators=(",", ":")).replace("<", "\\u003c"),
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

    `points`: sentences; `panels`: small maps; `folds`: words and more of them that open on demand; `bars`: words, a
    value as text and a length in percent; `half`: half the width of a desk's screen is enough; `folded`: it opens on
    demand; `bars_called`: words under which many images fold the bars.
    """

    key: str
    question: str
    answer: str
    charts: Pictures = ()
    panels: Pictures = ()
    folds: Sequence[tuple[str, Pictures]] = ()
    points: Sequence[str] = ()
    bars: Sequence[tuple[str, str, float]] = ()
    tables: Sequence[Table] = ()
    half: bool = False
    folded: bool = False
    bars_called: str = ""


def _images(files: RunFiles) -> Section:
    views = files.summary.views
    good = sum(view.status in GOOD.values() for view in views)
    answer = f"{good} of {len(views)} without reservation."
    if any(view.advice for view in views):
        answer += " What to do about the others stands in the verdict above."
    caption = "Images: reprojection error (RMS) of the tie points that count"
    caption += "; those that need a look first" * any(view.advice for view in views)
    rows = worst_first(views)
    columns = ViewEntry.PAGE if any(view.cause for view in views) else ViewEntry.PAGE.replace("wrong ", "")
    shown = table("images", caption, rows, ViewEntry, columns, files.summary.adjusted)
    shown = shown.marked([f"{files.number[view.name]}" for view in rows])
    return Section("images", "Which images can I use?", answer, tables=[shown])


def _map(files: RunFiles) -> Section | None:
    views, pairs = files.summary.views, files.summary.pairs
    shown = []
    if any(files.outlines):
        caption = (
            "Outlines at the altitude of the scene, named where there is room, those that need a look on top; dots are"
            " tie points; a stronger line stands for more matches."
        )
        if files.summary.gcps or files.summary.check_points:
            caption += " Triangles are GCPs, those on their tip check points."
        if files.summary.scene is not None and files.summary.scene.moving:
            caption += " Shaded: where tie points move together, stronger with more of them; dashed: where most are."
        shown.append((ground_map(files), caption))
    if shown and len(views) > charts.MAX_DRAWN:
        more = f"At most {charts.MAX_DRAWN} of {len(views)} outlines are drawn, good ones evenly taken, and no matrix"
        shown[0] = (shown[0][0], f"{shown[0][1]} {more}; all are in footprints.geojson and pairs.csv.")
    if pairs and 2 < len(views) <= charts.MAX_DRAWN:
        caption = "Every two images with tie points in common; point at a cell for their names."
        shown.append((pair_matrix(files), caption))
    question = "Where are the images, and which hold together?"
    return Section("map", question, _bonds(files), shown, bars=_lengths(files), bars_called=_LENGTHS)


def _lengths(files: RunFiles) -> list[tuple[str, str, float]]:
    """Return how many images see a tie point, as bars."""
    found = {length: num for length, num in files.summary.tracks.by_length.items() if num}
    most = max(found.values(), default=1)
    return [(f"Tie points in {length} images", f"{num}", 100 * num / most) for length, num in found.items()]


def _bonds(files: RunFiles) -> str:
    views, number = files.summary.views, files.number
    links = [(number[pair.a], number[pair.b]) for pair in files.summary.pairs]
    groups = len(connected_groups(len(views), links))
    partners = np.bincount(np.array(links, dtype=np.int64).ravel(), minlength=len(views))
    lonely = [view.name for view, n in zip(views, partners, strict=True) if n == 1]
    answer = f"By tie points they fall into {groups} groups." if groups > 1 else "All images hang together."
    return answer + f" Tied to one other image only: {listed(lonely, 6)}." * bool(lonely and len(views) > 2)


def _errors(files: RunFiles) -> Section | None:
    found = files.observations
    norms = [np.hypot(*r[found.used & np.isfinite(r).all(axis=1)].T) for r in (found.before, found.after)]
    if not any((norm > 0).any() for norm in norms):
        return None
    shown = [(charts.histogram(*norms), "All observations that count; each curve is drawn to its own peak.")]
    if not files.summary.adjusted:
        answer = f"Half of the observations lie within {np.median(norms[0]):.3f} px of where their cameras put them."
        return Section("errors", "How large are the errors?", answer, shown)
    before, after = map(np.median, norms)
    answer = (
        f"The median reprojection error went from {before:.3f} px to {after:.3f} px."
        " These are the points the adjustment was made of: it shows agreement, not accuracy on the ground."
    )
    return Section("errors", "Did the adjustment help?", answer, shown)


def _randomness(files: RunFiles) -> Section | None:
    if not len(files.observations.view):
        return None
    views, adjusted, folds = files.summary.views, files.summary.adjusted, []
    first = [files.number[view.name] for view in flagged(views)]
    when = "after" if adjusted else "before"
    panels, shares, key = residual_panels(views, files.observations, when, first)
    marked = [view.name for view, share in zip(views, shares, strict=True) if share > 0.5]
    answer = "Mostly: in no image do residuals point the same way in more than half of the cells."
    if marked:
        answer = f"Not in {listed(marked, 6)}: in most of their cells the residuals point the same way."
        usual = " Small ones are usual (attitude jitter, relief); where they matter, the verdict says so."
        answer += usual * adjusted
    answer += (
        " A cell is darker where its error is larger; thin lines are single residuals; a bold arrow is the mean of a"
        f" cell that is larger than chance allows. {key}"
    )
    if len(panels) > SHOWN:
        folds.append((f"{len(panels) - SHOWN} more images", panels[SHOWN:]))
        panels = panels[:SHOWN]
    if adjusted:
        before, _, key = residual_panels(views, files.observations, "before", first)
        folds.append((f"Before the adjustment. {key}", before))
    return Section("random", "Are the residuals random?", answer, panels=panels, folds=folds)


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
    shown = [_relief(one) for one in files.reliefs]
    if files.draped:
        shown.append(_swiped(*files.draped))
    return Section("surface", "What do they make of the ground?", answer, shown)


def _relief(one: ReliefWindow) -> tuple[str, str]:
    words = f"The ground by the {one.cameras} cameras, lit from the north-west; black: no height"
    return _svg(one.size, words, _jpeg(one)), f"{words}."


def _swiped(left: Draped, right: Draped) -> tuple[str, str]:
    words = f"{left.image} (left) and {right.image} (right) on the surface by the corrected cameras"
    seam = charts.tag("rect", class_="seam", width=2, height=left.size[1])
    svg = _svg(left.size, words, _jpeg(left), _jpeg(right, class_="over"), seam, class_="swipe", tabindex=0)
    return svg, f"{words}: move over it to swipe, click to flicker. What stands still has the right height."


def _svg(size: tuple[int, int], words: str, *children: str, **attributes: object) -> str:
    box = f"0 0 {size[0]} {size[1]}"
    return charts.tag("svg", *children, viewBox=box, role="img", aria_label=words, **attributes)


def _jpeg(one: ReliefWindow | Draped, **attributes: object) -> str:
    href, (width, height) = f"data:image/jpeg;base64,{one.picture}", one.size
    return charts.tag("image", href=href, width=width, height=height, **attributes)


def _pairs(files: RunFiles) -> Section | None:
    pairs, number = worst_pairs(files.summary.pairs), files.number
    if not pairs:
        return None
    ends = [sorted((number[pair.a], number[pair.b])) for pair in pairs]
    worst = max(pairs, key=offset_of)
    answer = (
        f"The epipolar offset, which no height explains, is {offset_of(worst):.3f} px (RMS) in the worst pair"
        f" ({worst.a} - {worst.b}); stereo matching along epipolar lines wants it well below {GOOD_RMSE:g} px."
    )
    seen = [pair for pair in pairs if None not in (pair.convergence_deg, pair.base_to_height)]
    if seen:
        answer += _heights(seen, {view.name for view in files.summary.views if view.advice})
    caption = "Pairs: distance of matches from the epipolar line, median ± spread (1.4826 MAD)"
    found = table("pairs", caption, pairs, PairEntry, PairEntry.PAGE, files.summary.adjusted)
    found = found.marked([f"{a}-{b}" for a, b in ends])
    question = "Do the pairs fit for stereo, and can heights be measured?"
    return Section("pairs", question, answer, tables=[found])


def _heights(pairs: Sequence[PairEntry], doubted: Set[str]) -> str:
    """Which pair heights come best from: of images without reservation, with enough matches to know it."""
    if not any(pair.height_m_per_px for pair in pairs):
        return " No pair says anything about heights: all rays are parallel."
    sure = [
        pair
        for pair in pairs
        if pair.height_m_per_px and pair.num_matches >= FEW_OBSERVATIONS and not {pair.a, pair.b} & doubted
    ]
    best = min(sure, key=lambda pair: pair.height_m_per_px or np.inf, default=None)
    if best is None or best.height_m_per_px is None:
        few = f"{FEW_OBSERVATIONS} matches or more"
        return f" No pair of images without reservation has {few}: none is named for heights."
    words = (
        f" Heights come best from {best.a} - {best.b}: the rays meet under {best.convergence_deg:.1f} degrees"
        f" (B/H {best.base_to_height:.2f}), so one pixel of parallax is {metres(best.height_m_per_px)} of height."
    )
    weak = sum((pair.convergence_deg or 0.0) < 1.0 for pair in pairs)
    if weak:
        words += f" {weak} of {len(pairs)} pairs meet under less than one degree and say next to nothing about heights."
    return words


def _corrections(files: RunFiles) -> Section | None:
    views = files.summary.views
    known = [(c.center_shift_px, c.center_sigma_px) for view in views if (c := view.correction)]
    moves = [(shift, sigma) for shift, sigma in known if shift and sigma and None not in (*shift, *sigma)]
    if len(moves) < len(views):
        return None
    farthest, sigma = (max(float(np.hypot(*pair)) for pair in pairs) for pairs in zip(*moves, strict=True))
    answer = (
        f"Up to {farthest:.2f} px in the middle of an image. The adjustment itself predicts this to be known to"
        f" {sigma:.2g} px (one sigma, the worst image)."
    )
    if not files.summary.gcps:
        answer += " Most of that is common to all images: the scene's own place, which no tie point can tell."
    caption = "Corrections: shift in the middle of the image ± one sigma, size of rotation and translation"
    radars = any(view.correction and view.correction.range_m is not None for view in views)
    columns = ViewEntry.CORRECTIONS + ViewEntry.CLOCKS * radars
    found = table("corrections", caption, views, ViewEntry, columns)
    tables = [found]
    if any(view.correction and view.correction.ellipse for view in views):
        caption = "Place on the ground of the middle of each image, its altitude given: one-sigma ellipse, CE90, and"
        caption += " CE90 as stated with the camera as delivered (-: nothing is)"
        tables.append(table("places", caption, views, ViewEntry, ViewEntry.PLACES).fold())
    return Section("moves", "What was changed in each camera?", answer, tables=tables, half=True)


def _decisions(files: RunFiles) -> Section | None:
    summary, views = files.summary, files.summary.views
    points = decisions(summary)
    if not points:
        return None
    tables = []
    if summary.adjusted:
        caption = "What was decided by of each image: its prior widened, what was cut, what is left that is smooth"
        tables.append(table("decided", caption, views, ViewEntry, ViewEntry.DECISIONS).fold())
    again = second_attempts(summary.pairs)
    tables += [again] if again else []
    answer = "Figures that the run decided by; what was asked for by an option is said to be."
    return Section("decisions", "What was decided, and why?", answer, points=points, tables=tables)


def _gauge(files: RunFiles) -> Section | None:
    scene, gcps = files.summary.scene, files.summary.gcps
    if scene is None:
        return None
    modes = [(mode.words, mode.sigma_m) for mode in scene.weakest_modes if mode.sigma_m]
    most = max([sigma for _, sigma in modes], default=1.0)
    bars = [(f"{words[0].upper()}{words[1:]}", metres(sigma), 100 * sigma / most) for words, sigma in modes]
    answer = "Images fix each other, not their place on the Earth. What is left open, one sigma, the weakest first."
    if scene.num_held_in_height:
        answer += f" {scene.num_held_in_height} tie points seen under too small an angle were held in height."
    if not gcps and not (files.summary.reference and files.summary.reference.used):
        answer += " Ground control points (--gcp) are what helps where it matters."
    tables = []
    if scene.datum:
        tables.append(table("datum", DATUM, scene.datum, DatumEntry, DatumEntry.columns(scene.datum)))
    tables += [table("gcps", GCPS, gcps, GcpEntry, GcpEntry.PAGE)] if gcps else []
    if tested := [view for view in files.summary.views if view.control_w is not None]:
        caption = "Control in each image: the largest residual in units of its own deviation (Baarda's w)"
        tables.append(table("control", caption, tested, ViewEntry, ViewEntry.CONTROL).fold())
    if (reference := files.summary.reference) is not None:
        caption = "Reference: what it says of each camera as delivered"
        kind = ReferenceViewEntry
        tables.append(table("reference", caption, reference.views, kind, kind.PAGE))
    return Section("gauge", "What can the images not tell?", answer, bars=bars, tables=tables, half=True)


def _check_points(files: RunFiles) -> Section | None:
    points = files.summary.check_points
    if not points:
        return None
    image = [r for point in points for r in point.seen]
    ground = [point.residual_enu_m for point in points if None not in point.residual_enu_m]
    parts = []
    if image:
        parts.append(f"{np.hypot(*_rms(image)):.2f} px in the images")
    if ground:
        parts.append(f"{', '.join(map(metres, _rms(ground)))} east, north, up on the ground")
    found = " and ".join(parts) or "nothing: no camera sees them"
    answer = f"{len(points)} check points, which the adjustment did not see, are met to {found} (RMS)."
    caption = "Check points: found minus given place"
    tables = [table("check-points", caption, points, CheckPointEntry, CheckPointEntry.PAGE)]
    return Section("accuracy", "How accurate is it on the ground?", answer, tables=tables)


def _rms(rows: Any) -> Array:
    """Return the root mean square of each column."""
    found: Array = np.sqrt((np.array(rows, dtype=np.float64) ** 2).mean(axis=0))
    return found


def _files(files: RunFiles) -> Section | None:
    views, tables = files.summary.views, []
    if all(view.fit for view in views):
        caption = "Refitted RPCs against the corrected cameras, on points that the fit has not seen"
        tables.append(table("fits", caption, views, ViewEntry, ViewEntry.FITS))
    outputs = {file: found for view in views for file, found in view.outputs.items()}
    if outputs:
        consumers = list(dict.fromkeys(consumer for found in outputs.values() for consumer in found))
        heads = ["file", *(f"{consumer} [px]" for consumer in consumers)]
        rows = []
        for file, found in outputs.items():
            rows.append([cell_of(file), *(_reading(found.get(consumer)) for consumer in consumers)])
        caption = "Files reopened as their readers do: largest difference to the corrected cameras [px]"
        tables.append(Table("files", caption, heads, rows))
    if not tables:
        return None
    worst = largest([value for view in views for value in (view.fit.max_px if view.fit else (None,))])
    answer = f"Yes, to {worst or 0.0:.1e} px at worst, on check points over each image and its altitudes."
    if worst is None:
        answer = "Not known for every image."
    answer += (
        " Every file was reopened and compared before it counted as written. Give other tools these files, never the"
        " old image alone."
    )
    return Section("files", "Do the new RPC files hold the corrected cameras?", answer, tables=tables)


def _reading(found: float | str | None) -> Cell:
    """Return what a consumer read, or why it did not."""
    return Cell(found, 1e301) if isinstance(found, str) else cell_of(found, ".1e")


def _run(files: RunFiles) -> Section:
    summary, tracks = files.summary, files.summary.tracks
    stages = [stage for stage in summary.stages if stage.stage != REPORT]
    counts = f"{counted(tracks.num_tracks, 'tie point')}, {counted(tracks.num_observations, 'observation')}"
    seconds = f", {sum(stage.seconds for stage in stages):.1f} s" if stages else ""
    answer = f"{counted(len(summary.views), 'image')}, {counts}{seconds}."
    if not summary.tables.complete:
        answer += f" Tables and charts hold {summary.tables.num_written_tracks} tie points, evenly taken."
    longest = max([stage.seconds for stage in stages], default=1.0) or 1.0
    bars = [(s.stage, f"{s.seconds:.2f} s", 100 * s.seconds / longest) for s in stages]
    options = flat_options(summary.options or {})
    rows = [[cell_of(key), cell_of(str(value))] for key, value in options.items()]
    tables = [
        table("stages", "Stages of the run", stages, StageEntry, StageEntry.PAGE).fold(),
        Table("options", "Options of the run", ["option", "value"], rows, folded=True),
    ]
    return Section("run", "How was this made, and how long did it take?", answer, bars=bars, tables=tables)


SECTIONS: Sequence[Callable[[RunFiles], Section | None]] = (
    _images, _map, _errors, _randomness, _pairs, _surface, _corrections, _gauge, _decisions, _check_points, _files,
    _run,
)  # fmt: skip
"""In the order of the page; a section that has nothing to show is None."""
