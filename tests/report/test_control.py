"""What the residuals of control say in every image: who is the worst, and whether that is chance."""

from __future__ import annotations

from dataclasses import replace
from html import unescape

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.report import Run, verdict
from barpc.report.decisions import decisions
from barpc.report.page import report_html


def summary_of(run: Run, gcps, **options):
    adjustment = adjust_tracks(run.views, run.tracks, AdjustOptions(**options), gcps)
    return adjustment, verdict.summarize(replace(run, adjustment=adjustment, gcps=gcps, fits=(), written=()))


def test_control_that_is_as_stated_is_within_what_chance_allows(block_run):
    found, gcps = block_run.record, block_run.run.gcps
    w = block_run.run.adjustment.gcp_w
    assert np.isfinite(w).all()
    assert 0.5 < np.sqrt(np.mean(w**2)) < 2.0  # the larger of two of about one
    test = found.control_test
    assert (test.num, test.num_beyond) == (len(gcps.view), 0)
    assert test.critical == pytest.approx(3.29, abs=1e-3)
    assert test.expected == pytest.approx(0.002 * test.num, rel=0.01)
    assert test.largest_w == pytest.approx(w.max())
    for entry in found.gcps:
        rows = np.flatnonzero(gcps.point == gcps.names.index(entry.name))
        worst = rows[np.argmax(w[rows])]
        assert entry.image_w == pytest.approx(w[worst])
        assert entry.image_w_view == found.views[gcps.view[worst]].name
    for v, view in enumerate(found.views):
        rows = np.flatnonzero(gcps.view == v)
        worst = rows[np.argmax(w[rows])]
        assert view.control_w == pytest.approx(w[worst])
        assert view.control_w_point == gcps.names[gcps.point[worst]]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*constrained in height")
def test_a_wrong_position_in_one_image_is_found_there_and_said(block_run):
    run, gcps = block_run.run, block_run.run.gcps
    run = replace(run, tracks=run.tracks.select(run.keep))  # no wrong matches: nothing has to be cut
    wrong, xy = 7, gcps.xy.copy()
    xy[wrong, 1] += 12.0 * gcps.xy_sigma[wrong]
    adjustment, summary = summary_of(run, replace(gcps, xy=xy))
    assert adjustment.gcp_inlier.all()
    assert int(np.argmax(adjustment.gcp_w)) == wrong
    plain = np.abs(adjustment.gcp_w)[wrong]
    assert plain > 6.0
    name, point = run.views[gcps.view[wrong]].name, gcps.names[gcps.point[wrong]]
    test = summary.control_test
    assert test.num_beyond >= 1
    assert (test.image, test.point) == (name, point)
    sentence = decisions(summary)[-1]
    assert sentence.startswith(f"Of {test.num} residuals of control points in the images, {test.num_beyond} ha")
    assert sentence.endswith(f" ({point} in {name}).")


def test_the_page_shows_it_by_point_and_by_image(block_run):
    html = report_html(block_run.record, block_run.folder)
    assert "w in images" in html
    assert 'id="t-control"' in html
    assert decisions(block_run.record)[-1] in unescape(html)
    without = replace(block_run.record, views=tuple(replace(v, control_w=None) for v in block_run.record.views))
    assert 'id="t-control"' not in report_html(without, block_run.folder)
