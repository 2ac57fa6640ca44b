"""What lies on the pictures of the images: tie points, flagged parts; residuals along rows; strips; histograms."""

from __future__ import annotations

import base64
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

pytest.importorskip("jinja2")

from types import SimpleNamespace

from barpc.report import pictures
from barpc.report.runfiles import Draped, PairStrip
from barpc.report.summary.block import ExplanationEntry, HeldOutEntry, LeftEntry
from tests.report.made import Drawing, a_summary, a_view, corners, files_of, seen

JPEG = base64.b64encode(bytes(cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1])).decode()
LEFT = LeftEntry("B", "columns", 100.0, 300.0, 0.6, 0.1, 2.0, 50.0)
WORSE = HeldOutEntry("B", "a cell <of B>", (0.0, 125.0), (700.0, 900.0), 40, 0.5, 0.4, 1e-9)
STEP = ExplanationEntry(
    "step", "rows 600-799 of A are displaced by 2.00 px", "A", 90.0, 40.0, axis="rows", first=600.0, last=799.0
)


def scene(*explanations, left=(), worse=()):
    return SimpleNamespace(explanations=explanations, left=left, held_out_places=worse)


def pictured(views, rows=(), names=None, **fields):
    files = files_of(a_summary(views, **fields), observed=seen(list(rows)))
    names = [view.name for view in views] if names is None else names
    return replace(files, thumbnails=[Draped(name, (48, 38), JPEG) for name in names])


def test_tie_points_lie_where_they_were_measured_and_rejected_ones_are_told_apart():
    zero = (0.0, 0.0), (0.0, 0.0)
    rows = [(0, 0, (0.0, 0.0), *zero, True), (0, 1, (999.0, 799.0), *zero, False), (1, 2, (499.5, 399.5), *zero, True)]
    (one, caption), (other, _) = pictures.image_panels(pictured([a_view("A", num_rejected=1), a_view("B")], rows))
    drawn = Drawing(one)
    assert drawn.box == (300, 240)
    assert [corners(e.get("d")) for e in drawn.all("path", "kept")] == [[(0.0, 0.0)]]
    assert [corners(e.get("d")) for e in drawn.all("path", "cut")] == [[(300.0, 240.0)]]
    assert corners(Drawing(other).all("path", "kept")[0].get("d")) == [(150.0, 120.0)]
    assert (caption, drawn.described) == ("A", pictures.PICTURE_KEY)
    assert drawn.all("image")[0].get("href") == f"data:image/jpeg;base64,{JPEG}"
    assert drawn.root.get("data-v") == "0"


def test_flagged_parts_are_outlined_on_their_image_and_on_no_other():
    views = [a_view("A"), a_view("B", status="doubtful", advice="look", cause="left")]
    files = pictured(
        views, scene=scene(STEP, replace(STEP, name="moving_objects", image=None), left=(LEFT,), worse=(WORSE,))
    )
    (bad, caption), (good, _) = pictures.image_panels(files)  # the worst first
    assert caption == "B: needs review"
    scale = 300 / 1000
    columns, cell = Drawing(bad).rects("flag")
    assert columns == pytest.approx((100 * scale, 0, 200 * scale, 240), abs=0.01)
    assert cell == pytest.approx((0, 700 * scale, 125 * scale, 100 * scale), abs=0.01)  # cut at the image's end
    assert Drawing(bad).titles("flag") == ["columns 100-300", "a cell <of B>"]
    assert Drawing(good).rects("flag") == [pytest.approx((0, 600 * scale, 300, 199 * scale), abs=0.01)]
    assert Drawing(good).described.endswith("1 part with reservations.")


def test_rows_with_few_tie_points_are_outlined_as_others_are():
    gap = tuple((5.0, 43.0, col, row) for col in (-0.5, 999.5) for row in (199.5, 399.5))
    ((svg, _), *_rest) = pictures.image_panels(pictured([a_view("A", gap=gap), a_view("B")]))
    assert Drawing(svg).rects("flag") == [pytest.approx((0, 59.85, 299.85, 60), abs=0.01)]
    assert Drawing(svg).titles("flag") == ["few tie points"]


def test_images_without_a_picture_are_left_out_and_a_run_without_any_has_no_panels():
    views = [a_view("A"), a_view("B")]
    assert [caption.split(":")[0] for _, caption in pictures.image_panels(pictured(views, names=["B"]))] == ["B"]
    assert pictures.image_panels(files_of(a_summary(views))) == []
    assert pictures.pair_strips(files_of(a_summary(views))) == []


def stepped(offset: float, slope: float = 0.01, num: int = 2000, after: float = 0.0):
    """Residuals of rows 0-799 of an image, of which those from 600 on are displaced, on a slope of the cameras."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, 1, (num, 2)) * (999, 799)
    row = slope * xy[:, 1] + np.where(xy[:, 1] >= 600, offset, 0.0) + rng.normal(0, 0.05, num)
    wrong = rng.uniform(size=num) < 0.1  # which medians pass over
    row[wrong] += 40.0
    zero = np.zeros(num)
    return [(0, k, xy[k], (zero[k], row[k]), (zero[k], after), True) for k in range(num)]


@pytest.mark.parametrize("offset", [2.0, -2.0])
def test_residuals_along_rows_show_the_step_that_is_named_where_it_is_and_its_sign(offset):
    files = files_of(a_summary([a_view("A")], scene=scene(STEP)), observed=seen(stepped(offset)))
    ((svg, caption),) = pictures.profile_charts(files)
    drawn = Drawing(svg)
    column, row = (np.array(line) for line in drawn.points("line before"))
    assert len(row) == 48
    jumps = np.abs(np.diff(row[:, 1]))
    x = row[int(jumps.argmax()), 0]
    ((left, _, wide, _),) = drawn.rects("band")
    assert x == pytest.approx(left, abs=9.0)  # a part of 48 is 7.6 units
    assert left + wide == pytest.approx(412, abs=1.0)
    up = row[int(jumps.argmax()) + 1, 1] - row[int(jumps.argmax()), 1]
    assert np.sign(up) == -np.sign(offset)  # y counts down
    texts = [(float(text), y) for text, _, y, anchor in drawn.texts("tick") if anchor == "end"]
    (low, y_low), *_, (high, y_high) = texts[len(texts) // 2 :]
    assert abs(up) * (high - low) / (y_low - y_high) == pytest.approx(2.0, abs=0.4)  # as the axis says, of pixels
    assert np.ptp(column[:, 1]) < 3.0
    assert "delivered cameras less a straight line" in caption
    assert "new RPCs (blue); shaded" in caption
    assert np.ptp([y for _, y in drawn.points("line after")[1]]) == 0.0


def test_residuals_of_a_check_have_one_line_and_few_points_none():
    rows = stepped(1.0, after=np.nan)
    rows = [(*row[:4], (np.nan, np.nan), True) for row in rows]
    summary = a_summary([a_view("A")], scene=scene(replace(STEP, axis=None, first=None, last=None)))
    ((svg, caption),) = pictures.profile_charts(files_of(summary, observed=seen(rows)))
    assert not Drawing(svg).points("line after")
    assert not Drawing(svg).rects("band")
    assert caption.endswith("less a straight line.")
    assert pictures.profile_charts(files_of(summary, observed=seen(rows[:5]))) == []
    assert pictures.profile_charts(files_of(replace(summary, scene=None), observed=seen(rows))) == []


def test_parts_of_one_axis_share_a_chart_and_charts_are_at_most_ten():
    views = [a_view(f"V{k}") for k in range(12)]
    rows = [(k, n, (n * 9.0, n * 7.0), (0.1, 0.1), (0.0, 0.0), True) for k in range(12) for n in range(110)]
    left = [replace(LEFT, image=view.name, axis="columns") for view in views]
    files = files_of(
        a_summary(views, scene=scene(left=[*left, replace(left[0], first=500.0, last=600.0)])), observed=seen(rows)
    )
    charts = pictures.profile_charts(files)
    assert len(charts) == 10
    assert len(Drawing(charts[0][0]).rects("band")) == 2
    assert "along its columns" in charts[0][1]


def test_a_strip_names_its_rows_and_draws_a_line_through_each():
    strip = PairStrip("A - B", (720, 360), JPEG, ("A", "B, delivered cameras", "B, corrected cameras"), 6, 12.0)
    ((svg, caption),) = pictures.pair_strips(replace(files_of(a_summary([a_view("A"), a_view("B")])), strips=[strip]))
    drawn = Drawing(svg)
    assert drawn.box == (420, 210)
    assert [text for text, *_ in drawn.texts("name")] == list(strip.rows)
    assert drawn.points("epipolar") == [[(0, y), (420, y)] for y in (35, 105, 175)]
    assert caption.startswith("A - B: 6 tie points, each in a window of ±12 px whose rows are epipolar lines.")


@pytest.mark.parametrize("num", [5, 39, 400])
def test_counts_by_images_are_columns_to_one_scale(num):
    counts = {str(k): 1000 // k for k in range(2, num + 2)}
    drawn = Drawing(pictures.length_bars(counts))
    bars = drawn.rects("bar")
    assert len(bars) == num
    assert [high / bars[0][3] for *_, high in bars] == pytest.approx([n / 500 for n in counts.values()], abs=0.01)
    assert all(x >= 0 and x + wide <= 420 for x, _, wide, _ in bars)
    labels = sorted((x, 4.0 * len(text)) for text, x, y, _ in drawn.texts("tick") if y == 155)
    assert all(b - a > half + other for (a, half), (b, other) in pairwise(labels))
    assert "500" in [text for text, *_ in drawn.texts("tick")]
