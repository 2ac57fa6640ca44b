"""report.html: one file, the same for the same run, safe, and complete."""

from __future__ import annotations

import re
import sys
import time
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner

from barpc.base.errors import BarpcError, InputError
from barpc.cli import cli
from barpc.pipeline.remake import remake_report
from barpc.report import Run, summarize
from barpc.report.page import page_of, report_html
from barpc.report.ranking import worst_first
from barpc.report.runfiles import MAX_PICTURES, Draped, ObservationTable, RunFiles, read_tables
from barpc.report.tables import TABLES
from barpc.scene import Tracks
from tests.lanes import rest_slow
from tests.report.conftest import run_of_block, written

pytest.importorskip("jinja2")

RUNS = pytest.mark.parametrize("fixture", ["block_run", "check_run", "antimeridian_run"])


def html_of(finished):
    return (finished.folder / "report.html").read_text(encoding="utf-8")


@RUNS
def test_the_report_made_again_from_the_files_is_the_same_to_the_byte_and_said_where(fixture, request, copied):
    finished = request.getfixturevalue(fixture)
    folder = copied(finished)
    (folder / "report.html").unlink()
    result = CliRunner().invoke(cli, ["report", str(folder)], standalone_mode=False)
    assert result.exception is None
    assert result.output.strip() == str(folder / "report.html")
    assert (folder / "report.html").read_bytes() == (finished.folder / "report.html").read_bytes()


@RUNS
def test_it_loads_nothing_from_elsewhere(fixture, request):
    html = html_of(request.getfixturevalue(fixture))
    assert not re.search(r'(src|href)="(?!#|data:)', html)
    assert "url(" not in html
    assert "@import" not in html
    assert "default-src 'none'" in html


@RUNS
def test_every_chart_is_well_formed_with_a_title_and_a_description(fixture, request):
    html = html_of(request.getfixturevalue(fixture))
    charts = re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL)
    assert len(charts) > 5
    for chart in charts:
        root = ElementTree.fromstring(chart)
        assert root.get("role") == "img"
        named = root.get("aria-labelledby").split()
        assert [root[0].get("id"), root[1].get("id")] == named
        assert all(element.text for element in root[:2])
        assert "nan" not in chart.replace("nanometre", "").lower()
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))


def test_names_cannot_carry_markup_into_the_page(antimeridian_run):
    html = html_of(antimeridian_run)
    assert "<b>bold</b>" not in html
    assert "&lt;b&gt;bold&lt;/b&gt;" in html


def test_every_question_is_asked_of_a_full_run(block_run):
    html = html_of(block_run)
    questions = re.findall(r"<h2[^>]*>([^<]+)</h2>", html)
    assert questions == [
        "Which images can I use?",
        "Where are the images, and which are connected?",
        "Are the residuals random?",
        "Do the pairs fit for stereo and heights?",
        "How was each camera corrected?",
        "How uncertain are position and shape of the scene?",
        "What was decided, and why?",
        "Do the new RPC files reproduce the corrected cameras?",
        "With which options?",
    ]
    for view in block_run.summary["views"]:
        assert f"{view['rmse_after']:.3f}" in html
    assert "cannot read it" in html
    for gcp in block_run.summary["gcps"]:
        assert gcp["name"] in html


def test_a_check_asks_only_what_it_can_answer(check_run):
    html = html_of(check_run)
    assert "How was each camera corrected?" not in html
    assert "new RPC files" not in html


def test_a_page_of_many_images_shows_the_worst_and_says_so(block_run, sized):
    sized(pictures=4, shown=5)
    html = report_html(block_run.record, block_run.folder)
    assert "Of 9 images 4 are shown: those with the largest systematic part." in html
    assert "the first 5 of 9, all in the files beside this page" in html
    assert html.count('id="panel-after') == 2 * 4  # title and description


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore:.*constrained in height")
def test_fifty_images_make_less_than_3_mb_in_seconds(tmp_path):
    run = run_of_block(50, 20_000, outliers=0.05)
    start = time.process_time()
    summary = summarize(run)
    (tmp_path / "tables").mkdir()
    for name, content in TABLES.items():
        (tmp_path / "tables" / name).write_bytes(b"".join(content(run, summary)))
    html = report_html(summary, tmp_path)
    assert time.process_time() - start < 25.0  # CPU s; some 3 on a machine of its own
    assert len(html.encode()) < 3e6


def many_times(found: RunFiles, copies: int) -> RunFiles:
    """A run's files as if its scene lay there many times, side by side, every image with a reservation."""
    summary, seen, num = found.summary, found.observations, len(found.summary.views)
    views, pairs, outlines, points, tracks = [], [], [], [], []
    for copy in range(copies):
        step = [0.4 * (copy % 40), 0.4 * (copy // 40)]
        for view in summary.views:
            outputs = {f"{copy}_{name}": value for name, value in view.outputs.items()}
            views.append(replace(view, name=f"{copy}_{view.name}", status="doubtful", outputs=outputs))
        pairs += [replace(pair, a=f"{copy}_{pair.a}", b=f"{copy}_{pair.b}") for pair in summary.pairs]
        outlines += [[ring + step for ring in rings] for rings in found.outlines]
        points.append(found.points + [*step, 0.0, 0.0])
        tracks.append(found.tracks)
    lines = [f"{view.name}: doubtful: look for clouds, water, change, or wrong matches." for view in views]
    columns = (seen.track, seen.xy, seen.before, seen.after, seen.used)
    observations = ObservationTable(
        np.concatenate([seen.view + copy * num for copy in range(copies)]),
        *(np.concatenate([column] * copies) for column in columns),
    )
    told = replace(summary, views=tuple(views), pairs=tuple(pairs), verdict=tuple(lines))
    every = worst_first(told.views)[:MAX_PICTURES]  # as large as a run writes them
    small = [Draped(view.name, (480, 480), "A" * (4 * 25_000 // 3 // 4 * 4)) for view in every]
    return RunFiles(told, observations, np.concatenate(points), np.concatenate(tracks), outlines, thumbnails=small)


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("num", rest_slow([300, 1000]))
def test_the_page_of_many_images_is_bounded_and_says_what_it_leaves_out(block_run, num):
    files = many_times(read_tables(block_run.record, block_run.folder), -(-num // 9))
    html = page_of(files)
    views = len(files.summary.views)
    assert 3e6 < len(html.encode()) < 6e6
    assert html.count("data:image/jpeg") == 60
    assert (f"And {views - 400} more; all are in summary.json." in html) == (num == 1000)
    assert html.count('class="outline doubtful"') == (views if num == 300 else views // 3)
    assert ("At most 400 of 1008 footprints are drawn" in html) == (num == 1000)


def test_a_run_without_a_single_tie_point_still_has_a_page(block_run, tmp_path):
    none = Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))
    written(Run("check", block_run.run.views, (), none), tmp_path / "run")
    html = (tmp_path / "run/report.html").read_text()
    assert "Which images can I use?" in html
    assert "weakly connected" in html


def test_a_folder_without_a_finished_run_is_refused_with_a_reason(tmp_path):
    for text, said in ((None, "no finished run"), ("{", "not JSON that can be read"), ('{"schema": 1}', "schema 1")):
        if text is not None:
            (tmp_path / "summary.json").write_text(text)
        with pytest.raises(InputError, match=said):
            remake_report(tmp_path)


@pytest.mark.parametrize("name", ["residuals.csv", "observations.csv", "footprints.geojson"])
@pytest.mark.parametrize("damage", [None, "nonsense\n1,2,3\n"])
def test_a_table_that_is_missing_or_damaged_is_named(block_run, copied, name, damage):
    folder = copied(block_run)
    (folder / "tables" / name).unlink()
    if damage is not None:
        (folder / "tables" / name).write_text(damage)
    with pytest.raises(InputError, match=re.escape(name)):
        remake_report(folder)


def test_without_jinja2_the_run_is_whole_and_the_verb_says_what_to_install(block_run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    written(block_run.run, tmp_path / "run")
    assert (tmp_path / "run/summary.json").is_file()
    assert not (tmp_path / "run/report.html").exists()
    with pytest.raises(BarpcError, match=r"pip install 'barpc\[report\]'"):
        remake_report(tmp_path / "run")
