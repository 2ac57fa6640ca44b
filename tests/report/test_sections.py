"""The page's questions: when each is asked, what is answered, and the maps and tables that show it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from barpc.report import page
from barpc.report.runfiles import Draped, ReliefWindow
from barpc.report.summary import StageEntry, TablesEntry, TracksEntry
from barpc.report.summary.block import DatumEntry, SceneEntry
from barpc.report.summary.ground_points import CheckPointEntry, ReferenceEntry, ReferenceViewEntry, SeenEntry
from barpc.report.summary.pairs import OffsetEntry
from barpc.report.summary.views import CenterEntry, EllipseEntry, FitEntry
from barpc.report.summary.words import STATUS_WORDS

from .made import a_correction, a_gcp, a_pair, a_square, a_summary, a_view, files_of, section, seen, without_points

pytest.importorskip("jinja2")

VIEWS = [a_view("A"), a_view("B"), a_view("C")]


def asked(key: str, views=VIEWS, pairs=(), outlines=(), observed=None, **fields):
    """The part of the page that has a key."""
    files = files_of(a_summary(views, pairs, **fields), outlines, observed=observed)
    return section(files, key)


def texts(table) -> list[list[str]]:
    return [[cell.text for cell in row] for row in table.rows]


def test_residuals_of_adjusted_images_are_no_accuracy():
    section = asked("images", pairs=[a_pair()])
    agreement = (
        "Residuals of tie points measure how well the images agree with each other, not their accuracy on the ground."
    )
    assert section.answer == f"3 of 3 images. {agreement}"
    (table,) = section.tables
    assert table.columns[:3] == ["image", "verdict", "used"]
    assert [row[0].text for row in table.rows] == ["A", "B", "C"]
    assert table.marks == ["0", "1", "2"]
    check = asked("images", [a_view(status="consistent", rmse_after=None)], kind="check")
    assert check.answer == "1 of 1 image."
    assert "after [px]" not in check.tables[0].columns
    assert "after [px]" in table.columns


def test_a_row_of_the_table_of_images_is_in_percent_and_pixels():
    view = a_view(
        "A", num_observations=60, num_rejected=20, tie_coverage=0.254, rmse_before=1.2345, rmse_after=0.1,
        held_out_px=0.12, correction=a_correction(), gsd_m=0.512, incidence_deg=12.34, status="doubtful",
    )  # fmt: skip
    (table,) = asked("images", [view]).tables
    assert texts(table) == [
        ["A", "needs review", "60", "0", "25.0", "25%", "1.234", "0.100", "0.120", "+1.00, -2.00", "0.51", "12.3"]
    ]
    assert [cell.key for cell in table.rows[0]][1:6] == [4, 60, 0, 25.0, 0.254]
    assert table.rows[0][1].kind == "status doubtful"
    none = a_view(num_observations=0, num_rejected=0)
    (nothing,) = asked("images", [none]).tables  # a column that is empty in all rows is none
    assert "rejected [%]" not in nothing.columns
    assert {len(row) for row in nothing.rows} == {len(nothing.columns)}
    (some,) = asked("images", [none, view]).tables
    assert [row[some.columns.index("rejected [%]")].text for row in some.rows] == ["-", "25.0"]


def test_the_images_to_use_are_counted_and_a_reservation_asks_for_a_review_first():
    bad = [replace(view, **BAD) for view in VIEWS]
    for views, passed, answer in (
        (VIEWS, True, "3 of 3 images."),
        (VIEWS, False, "3 of 3 images, after review."),
        ([VIEWS[0], *bad[1:]], False, "1 of 3 images, after review."),
        (bad, False, "0 of 3 images."),
    ):
        assert asked("images", views, passed=passed).answer == answer


def test_a_map_needs_an_outline_and_says_where_some_are_left_out(sized):
    outlines = [a_square(10.0, 0.0)] * 3
    assert asked("map", pairs=[a_pair()]).charts == []
    ((_, whole),) = asked("map", outlines=outlines).charts
    assert whole.startswith("Footprints at the altitude of the scene")
    sized(shown=2)
    ((_, some),) = asked("map", outlines=outlines).charts
    assert some == f"{whole} At most 2 of 3 footprints are drawn; all are in footprints.geojson."


def test_how_images_hang_together():
    def answer(pairs, num=4):
        tracks = TracksEntry(10, 26, {"2": 8, "3": 0, "5": 2})
        found = asked("map", [a_view(name) for name in "ABCD"[:num]], pairs, tracks=tracks).answer
        assert pairs == [] or ", with 10 matched tie points: 8 in 2 images, 2 in 5 images." in found
        return found.replace(", with 10 matched tie points: 8 in 2 images, 2 in 5 images", "")

    ring = [a_pair("A", "B"), a_pair("B", "C"), a_pair("C", "D"), a_pair("A", "D")]
    assert answer(ring) == "All images are connected."
    assert answer(ring[:3]) == "All images are connected. Connected to one other image only: A, D."
    assert answer(ring[:1]) == "The images form 3 separate groups. Connected to one other image only: A, B."
    assert answer(ring[:1], 2) == "All images are connected."
    assert answer([]) == "There are no tie points in use."
    pair = asked("map", VIEWS[:2], ring[:1], tracks=TracksEntry(10, 20, {"2": 10}))
    assert pair.answer == "All images are connected, with 10 matched tie points."


def pushed(view: int, cells: int, of: int):
    """Ten residuals in each of some cells of a row of an image, in so many of which they point one way."""
    rows = []
    for cell in range(of):
        for k in range(10):
            to = (1.0 + 0.01 * k, 0.0) if cell < cells else ((-1.0) ** k, 0.0)
            rows.append((view, k, (1000 / 8 * (cell + 0.5), 10.0), to, to, True))
    return rows


LEGEND = (
    " Thin lines are residuals (projected minus observed). The colour is their RMS in each of 8 x 8 cells. A bold "
    "arrow, at twice the scale, is the mean of a cell where that exceeds three standard errors."
)


def test_residuals_are_random_unless_most_cells_of_an_image_point_one_way():
    calm = asked("random", observed=seen([*pushed(0, 1, 2), *pushed(1, 0, 2)]))
    assert calm.answer == f"No image has a significant mean in most of its cells.{LEGEND}"
    assert len(calm.panels) == 3
    assert [words for words, _ in calm.folds] == ["Before the adjustment"]
    assert len(calm.folds[0][1]) == 3
    told = asked("random", observed=seen([*pushed(0, 1, 2), *pushed(1, 2, 3)]))
    assert told.answer == f"No. Most cells of B have a significant mean.{LEGEND}"
    check = asked("random", observed=seen(pushed(1, 2, 3)), kind="check")
    assert check.folds == []
    assert 'id="panel-before0-t"' in check.panels[0][0]
    assert 'id="panel-after0-t"' in calm.panels[0][0]
    assert asked("random", observed=seen([])) is None


YES = "Yes: no image has systematic residuals (F test: p < 1e-4)."
ABOVE = "Up to 0.06 px needs no review."


@pytest.mark.parametrize(("figures", "said"), [
    ([(0.3, 0.0, 0.0), (1e-4, 0.2, 0.0)], YES),
    ([(1.0, 0.0, 0.0), (1.0, 0.0, 0.0)], "No image has a significant mean in most of its cells."),  # too few to test
    ([(None, None, None), (0.2, 0.0, None)], YES),
    ([(6e-30, 0.0023, 0.0), (9e-5, 0.0014, 0.0)],
     f"Nearly. Systematic residuals (F test: p < 1e-4) in 2 images, at most 0.0023 px (A). {ABOVE}"),
    ([(0.4, 0.0, 0.0), (1e-9, 0.07, 0.0)],
     f"No. Systematic residuals (F test: p < 1e-4) in 1 image, at most 0.07 px (B). {ABOVE}"),
    ([(0.4, 0.0, 0.05), (0.4, 0.0, 0.0)],
     f"Nearly. Correlated neighbouring residuals in 1 image, at most 0.05 px (A). {ABOVE}"),
])  # fmt: skip
def test_systematic_residuals_are_said_with_their_size_and_the_limit_of_a_review(figures, said):
    """Many tie points show a thousandth of a pixel: the answer is by its size, too, and by the p of the table."""
    names = "systematic_p", "systematic_px", "neighbour_correlated_px"
    views = [a_view(name, **dict(zip(names, of, strict=True))) for name, of in zip("AB", figures, strict=True)]
    assert asked("random", views, observed=seen([*pushed(0, 1, 2), *pushed(1, 0, 2)])).answer == said + LEGEND
    decided = asked("decisions", views, scene=a_scene(model="rotation")).tables[0]
    if figures[0][0]:
        assert decided.rows[0][decided.columns.index("F test p")].text == f"{figures[0][0]:.1e}"


def test_pairs_are_told_by_the_worst_offset():
    pairs = [
        a_pair("A", "B", height_m_per_px=1.4),
        a_pair("A", "C", convergence_deg=0.9, base_to_height=0.02, height_m_per_px=0.712),
        a_pair("B", "C", convergence_deg=1.0, height_m_per_px=None),
    ]
    section = asked("pairs", pairs=pairs)
    assert (
        section.answer
        == "The largest epipolar offset of a pair is 0.100 px (RMS; A - B). Stereo needs less than 0.5 px."
    )
    assert section.tables[0].marks == ["0-1", "0-2", "1-2"]
    assert texts(section.tables[0])[0] == [
        "A - B",
        "100",
        "20.0",
        "0.35",
        "1.4",
        "+0.300 ± 0.200",
        "+0.000 ± 0.100",
        "0.100",
    ]
    kept = OffsetEntry(0.0, 0.08, 0.09, 50)  # of those in use: ranked by
    section = asked("pairs", pairs=[replace(pairs[0], epipolar_kept=kept)])
    assert texts(section.tables[0])[0][-2:] == ["+0.000 ± 0.100", "0.090"]
    assert "0.090 px (RMS; " in section.answer
    assert asked("pairs") is None


def test_corrections_are_told_by_the_farthest_move():
    ellipse = EllipseEntry(3.0, 1.0, 45.0, 5.0)
    views = [
        a_view("A", correction=a_correction(center_shift_px=(3.0, -4.0), angle_urad=2.0)),
        a_view(
            "B",
            correction=a_correction(center_sigma_px=(0.6, 0.8), ellipse=ellipse),
            camera_center=CenterEntry((0, 0, 0), 694e3, "line"),
        ),
    ]
    section = asked("moves", views)
    assert section.answer == (
        "The largest shift at an image centre is 5.00 px. The sigmas in the tables include the uncertainty of the "
        "scene's position."
    )
    assert [table.key for table in section.tables] == ["corrections", "places"]
    assert texts(section.tables[0])[0] == ["A", "+3.000 ± 0.10", "-4.000 ± 0.10", "2.00", "-"]
    assert texts(section.tables[0])[1][-1] == "694,000"
    assert [cell.key for cell in section.tables[0].rows[0]][1:3] == [3.0, -4.0]
    assert texts(section.tables[1])[1] == ["B", "3.00", "1.00", "45", "5.00"]
    assert not section.charts
    assert [table.key for table in asked("moves", views[:1]).tables] == ["corrections"]
    assert asked("moves", [views[0], a_view("B")]) is None


def a_scene(**fields) -> SceneEntry:
    usual = {
        "shift_enu_m": (0.0, 0.0, 0.0), "sigma_enu_m": (1.0, 1.0, 1.0), "radius_m": 9.0, "weakest_modes": (),
        "noise": 1.0, "drift_degree": 1, "drift_sigma_m": (), "prior_ratio": None, "cost_history": (),
        "num_held_in_height": 0, "gcp_residuals_enu_m": (), "solver": "done",
    }  # fmt: skip
    return SceneEntry(**{**usual, **fields})


def test_points_too_nearly_in_line_are_counted_where_the_scene_is_uncertain():
    pairs = [a_pair()]
    plain = asked("gauge", pairs=pairs, scene=a_scene()).answer
    assert plain == "Tie points fix the images relative to each other."
    held = asked("gauge", pairs=pairs, scene=a_scene(num_held_in_height=7))
    assert held.answer == f"{plain} The heights of 7 tie points with too small a convergence angle were constrained."
    assert held.tables == []
    assert asked("gauge") is None


def test_the_matches_of_a_reference_are_a_table():
    row = ReferenceViewEntry("A", 9.0, (1.0, -2.0), 50, 30, 20, 0.5)
    section = asked("gauge", scene=a_scene(), reference=ReferenceEntry(True, 0.5, 1.0, 20, (row,)))
    assert texts(section.tables[-1]) == [["A", "9.0", "+1.00", "-2.00", "50", "30", "20", "0.50"]]


def test_what_holds_the_scene_and_the_control_in_each_image_are_tables():
    datum = DatumEntry("up", 2.0, 0.996, 0.0, 0.0, 0.004, 0.0, None)
    views = [a_view("A", control_w=2.5, control_w_point="P"), a_view("B")]
    section = asked("gauge", views, scene=a_scene(datum=(datum,)), gcps=(a_gcp("P", 0.0, 0.0),))
    assert section.answer == "The position on the Earth comes from the delivered cameras."
    held = replace(datum, cameras=0.02, gcps=0.93, heights=0.05)
    both = asked("gauge", views, scene=a_scene(datum=(held,) * 3)).answer
    assert both == "The position on the Earth comes from the GCPs, the DEM or assumed heights."
    assert [table.key for table in section.tables] == ["datum", "gcps", "control"]
    assert texts(section.tables[0]) == [["up", "2.00", "100%"]]
    assert texts(section.tables[2]) == [["A", "2.5", "P"]]


def test_columns_of_what_tells_half_a_percent_of_any_motion_are_shown():
    some = DatumEntry("up", 2.0, 0.995, 0.0, 0.0, 0.005, 0.0, None)
    none = replace(some, part="east", gcps=0.0049, cameras=None)
    assert DatumEntry.columns([none]) == "part sigma_m"
    assert DatumEntry.columns([none, some]) == "part sigma_m cameras gcps"
    assert DatumEntry.columns([replace(some, reference=1.0)]).endswith("gcps reference")


def a_check(name: str, miss, *seen_in) -> CheckPointEntry:
    return CheckPointEntry(name, 0.0, 0.0, 0.0, miss, tuple(SeenEntry(f"V{k}", px) for k, px in enumerate(seen_in)))


def test_check_points_are_shown():
    points = (
        a_check("P", (3.0, 0.0, -0.4), (3.0, 4.0), (None, 1.0)),
        a_check("Q", (None, 1.0, 1.0), (0.0, 0.0)),
        a_check("R", (4.0, 0.0, 0.3)),
    )
    section = asked("accuracy", check_points=points)
    assert section.question == "How accurate is it on the ground?"
    assert [table.key for table in section.tables] == ["check-points"]
    assert section.answer == "The verdict has the RMS of 3 check points, which the adjustment did not use."
    assert texts(section.tables[0]) == [
        ["P", "1", "5.000", "+3.000", "0", "-0.400"], ["Q", "1", "0", "-", "+1.000", "+1.000"],
        ["R", "0", "-", "+4.000", "0", "+0.300"],
    ]  # fmt: skip
    assert asked("accuracy") is None


def test_files_are_held_to_what_their_readers_found():
    fit = FitEntry((1e-3, 2e-3), (4e-3, 3e-3), 0.9, 1e-5, 1.0, "lstsq", 500)
    outputs = {"A_RPC.TXT": {"gdal": 1e-9, "rpcm": "cannot read it"}, "A.json": {"barpc": 0.0}}
    section = asked("files", [a_view("A", fit=fit, outputs=outputs), a_view("B", fit=fit)])
    assert section.answer == "Yes, to within 0.004 px. The original images still carry the delivered RPC."
    fits, files = section.tables
    assert texts(fits)[0] == ["A", "1.0e-03, 2.0e-03", "4.0e-03", "0.900", "1.0e-05", "100%", "500", "lstsq"]
    assert files.columns == ["file", "gdal [px]", "rpcm [px]", "barpc [px]"]
    assert texts(files) == [["A_RPC.TXT", "1.0e-09", "cannot read it", "-"], ["A.json", "-", "-", "0"]]
    assert [cell.key for cell in files.rows[0][1:]] == [1e-9, 1e301, 1e300]
    assert asked("files", [a_view("A")]) is None
    partly = asked("files", [a_view("A", fit=fit, outputs=outputs), a_view("B")])
    assert partly.answer.startswith("Not known for every image.")
    exact = asked("files", [a_view("A", fit=replace(fit, max_px=(4e-9, 3e-9)))])
    assert exact.answer.startswith("Yes, to within 1e-06 px.")
    assert [table.key for table in partly.tables] == ["files"]
    unknown = asked("files", [a_view("A", fit=replace(fit, max_px=(None, 0.1)))])
    assert unknown.answer.startswith("Not known")


def test_how_it_was_made_says_its_options_and_no_time():
    stages = (StageEntry("matching", 8.0, 8.0, 100.4),)
    section = asked("run", stages=stages, options={"tie": {"band": 1}, "dem": None})
    assert section.answer == ""
    assert [texts(one) for one in section.tables] == [[["tie.band", "1"], ["dem", "None"]]]
    some = asked("run", tables=TablesEntry(900, 300, complete=False))
    assert some.answer == "Tables and charts show 300 tie points, sampled evenly."


def test_decisions_have_a_table_of_images_where_cameras_were_adjusted():
    section = asked("decisions", scene=a_scene(model="rotation"))
    assert [table.key for table in section.tables] == ["decided"]
    assert asked("decisions", kind="check") is None
    again = asked("decisions", pairs=[a_pair(tied_by="x", beaten=("y",))], kind="check")
    assert [table.key for table in again.tables] == ["again"]


@pytest.mark.parametrize(("num", "more"), [(400, False), (401, True)])
def test_a_verdict_of_four_hundred_sentences_is_shown_whole(tmp_path, num, more):
    summary = a_summary(VIEWS, verdict=tuple(f"s{k}." for k in range(num)))
    html = page.report_html(summary, without_points(tmp_path, len(VIEWS)))
    assert "<li>s399.</li>" in html
    assert ("And 1 more; all are in summary.json." in html) == more


# --- many images ------------------------------------------------------------------------------------------

BAD = {"status": "doubtful", "advice": "look", "cause": "held_out"}


def test_images_that_need_a_look_are_first_by_verdict_then_by_what_is_wrong():
    views = [
        a_view("A"),
        a_view("B", status="weak", advice="x", cause="few"),
        a_view("C", **BAD, held_out_px=3.0),
        a_view("D", **BAD, held_out_px=9.0),
        a_view("E", status="doubtful", advice="x", cause="contradicted"),
        a_view("F", status="failed", advice="x", cause="untied"),
        a_view("G", status="doubtful", advice="x"),  # of an earlier release
    ]
    (table,) = asked("images", views).tables
    assert [row[0].text for row in table.rows] == ["F", "E", "D", "C", "G", "B", "A"]
    assert table.marks == ["5", "4", "3", "2", "6", "1", "0"]
    assert [row[2].text for row in table.rows][:3] == [
        "not connected to the others",
        "contradicts the others",
        "large residuals of check tie points",
    ]
    assert "first" in table.caption
    assert table.columns[2] == "reservation"


def test_heights_need_images_without_reservation_thirty_matches_and_an_angle():
    none = "No pair of images that passed has 30 matches and a convergence angle that determines heights."
    best, doubted = a_pair("A", "B", 30, height_m_per_px=0.5), [VIEWS[0], a_view("B", **BAD), VIEWS[2]]
    assert none not in asked("pairs", pairs=[best]).answer
    for lacking in ({"num_matches": 29}, {"height_m_per_px": None}, {"convergence_deg": None}):
        assert asked("pairs", pairs=[replace(best, **lacking)]).answer.endswith(none)
    assert asked("pairs", doubted, pairs=[best]).answer.endswith(none)


def test_pairs_that_are_torn_are_first():
    pairs = [a_pair("A", "B"), a_pair("A", "C", epipolar_after=OffsetEntry(0.0, 0.1, 0.6, 9)),
             a_pair("B", "C", epipolar_after=OffsetEntry(0.0, 0.1, 0.9, 9))]  # fmt: skip
    section = asked("pairs", pairs=pairs)
    assert [row[0].text for row in section.tables[0].rows] == ["B - C", "A - C", "A - B"]
    assert section.tables[0].marks == ["1-2", "0-2", "0-1"]
    assert "0.900 px (RMS; B - C)" in section.answer


@pytest.mark.parametrize(("nmad", "told"), [(0.25, True), (None, False)])
def test_a_surface_is_shown_by_the_cameras_before_and_after_and_under_two_images(nmad, told):
    files = files_of(a_summary(VIEWS))
    assert section(files, "surface") is None
    before = ReliefWindow("delivered", (2, 2), 0.412, nmad, "QUJD")
    after = replace(before, cameras="corrected", share=0.933, nmad_m=0.5)
    shown = section(replace(files, reliefs=(before, after)), "surface")
    said = "41 % of the cells have a height with the delivered cameras, 93 % with the corrected ones."
    assert said in shown.answer
    assert ("differ by 25 cm and 50 cm" in shown.answer) == told
    assert [words.partition(",")[0] for _, words in shown.charts] == [
        "Surface from the delivered cameras", "Surface from the corrected cameras",
    ]  # fmt: skip
    draped = tuple(Draped(name, (2, 2), "QUJD") for name in "AC")
    (*_, (chart, words)) = section(replace(files, reliefs=(before, after), draped=draped), "surface").charts
    assert words.startswith("A (left) and C (right) draped over the surface from the corrected cameras: ")
    assert str(chart).count("QUJD") == 2


@pytest.mark.parametrize(("after", "said"), [(0.0, "is 0.000 px (RMS"), (None, "Unknown: no camera")])
def test_an_offset_of_nothing_is_not_one_that_is_unknown(after, said):
    offset = None if after is None else OffsetEntry(0.0, 0.0, after, 50)
    section = asked("pairs", pairs=(a_pair(epipolar_before=offset, epipolar_after=offset),))
    assert said in section.answer
    assert ("px (RMS" in section.answer) == (after is not None)


def test_no_rule_of_drawings_is_the_name_of_a_verdict():
    """An outline has its verdict as a class: a rule of that name drew outlines of tied images as dots."""
    css = Path(page.__file__).with_name("template.html.j2").read_text(encoding="utf-8")
    assert not re.findall(rf"(?:^|[}}\s])\.({'|'.join(STATUS_WORDS)})\b", css)
