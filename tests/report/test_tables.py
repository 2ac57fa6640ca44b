"""The machine outputs hold what the run found, under the names that users of ASP know."""

from __future__ import annotations

import csv
import json
import shutil
import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.export.files import ply
from barpc.report import summarize
from barpc.report.geopackage import geopackage
from barpc.report.records import json_form
from barpc.report.runfiles import OBSERVATION_COLUMNS, RESIDUALS, read_tables, run_key
from barpc.report.tables import TABLES, gcps_geojson, map_layers

from .made import a_pair, a_summary, a_view, without_points


def rows_of(finished, name: str = "residuals.csv") -> list[dict[str, str]]:
    """The rows of a table of a run, by column."""
    with (finished.folder / "tables" / name).open(newline="", encoding="utf-8") as file:
        rows = [*csv.DictReader(file)]
    assert not [row for row in rows if None in row or None in row.values()]  # of another number of cells
    return rows


def test_residuals_have_the_column_names_of_asp(block_run):
    names = [*rows_of(block_run)[0]]
    assert names[:5] == ["lon", "lat", "height_above_datum", "mean_residual", "num_observations"]


def test_a_row_of_residuals_is_a_track_where_the_new_cameras_see_it(block_run):
    """With its errors before and after in the observations that count."""
    run, rows = block_run.run, rows_of(block_run)
    places = np.array([[row[name] for name in ("lon", "lat", "height_above_datum")] for row in rows], dtype=float)
    usable = np.flatnonzero(np.isfinite(run.ground).all(axis=1))
    assert [int(row["track"]) for row in rows] == usable.tolist()
    np.testing.assert_allclose(places[:, :2], run.ground[usable, :2], rtol=0, atol=1e-9)
    np.testing.assert_allclose(places[:, 2], run.ground[usable, 2], rtol=0, atol=1e-4)
    for row in rows[:40]:
        own = np.flatnonzero((run.tracks.point == int(row["track"])) & run.adjustment.inlier)
        place = run.ground[int(row["track"])]
        for key, cameras in (("mean_residual", run.after), ("mean_residual_before", None)):
            residuals = run.ties_before.residuals[own]
            if cameras:
                residuals = [cameras[run.tracks.view[k]].project(place) - run.tracks.xy[k] for k in own]
            assert float(row[key]) == pytest.approx(np.hypot(*np.transpose(residuals)).mean(), abs=6e-5)
        assert int(row["num_observations"]) == len(own)


def test_observations_give_the_errors_of_the_summary_back(block_run):
    rows = [[*row.values()] for row in rows_of(block_run, "observations.csv")]
    assert tuple(rows_of(block_run, "observations.csv")[0]) == OBSERVATION_COLUMNS
    for view in block_run.summary["views"]:
        own = [row for row in rows if row[0] == view["name"] and row[8] == "1"]
        assert len(own) == view["num_observations"]
        for when, columns in (("before", slice(4, 6)), ("after", slice(6, 8))):
            residuals = np.array([row[columns] for row in own], dtype=float)
            rmse = np.sqrt((residuals**2).sum(axis=1).mean())
            assert rmse == pytest.approx(view[f"rmse_{when}"], abs=1e-4)


def test_outliers_are_in_the_table_with_the_residual_that_had_them_cut(block_run):
    run = block_run.run
    files = read_tables(block_run.record, block_run.folder)
    cut = ~files.observations.used & np.isfinite(files.observations.after).all(axis=1)
    assert cut.sum() > 50
    assert np.median(np.hypot(*files.observations.after[cut].T)) > 3.0
    assert (~run.adjustment.inlier).sum() >= cut.sum()


def test_pairs_hold_the_figures_of_the_summary(block_run):
    rows, pairs = rows_of(block_run, "pairs.csv"), block_run.summary["pairs"]
    assert len(rows) == len(pairs)
    row, pair = rows[0], pairs[0]
    assert (row["a"], row["b"], int(row["num_matches"])) == (pair["a"], pair["b"], pair["num_matches"])
    assert float(row["convergence_deg"]) == pytest.approx(pair["convergence_deg"], abs=1e-5)
    assert float(row["epipolar_after_rms_px"]) == pytest.approx(pair["epipolar_after"]["rms"], abs=1e-5)


def test_the_same_run_gives_the_same_bytes(block_run):
    run, summary = block_run.run, block_run.record
    # tables and report count, too, once they are written
    again = replace(summarize(run), stages=summary.stages, inputs=summary.inputs, outputs=summary.outputs)
    assert again == summary
    assert json.dumps(json_form(again)) == json.dumps(block_run.summary)
    for name, content in TABLES.items():
        assert b"".join(content(run, again)) == (block_run.folder / "tables" / name).read_bytes(), name
    assert geopackage(map_layers(run, again)) == (block_run.folder / "map.gpkg").read_bytes()


def test_tables_are_written_and_read_in_parts_of_any_size(block_run, tmp_path, sized):
    rows = 7
    tables, whole = block_run.folder / "tables", read_tables(block_run.record, block_run.folder)
    assert len(whole.tracks) % rows
    sized(rows_together=rows)
    for name, content in TABLES.items():
        assert b"".join(content(block_run.run, block_run.record)) == (tables / name).read_bytes(), name
    again = read_tables(block_run.record, block_run.folder)
    assert (again.points == whole.points)[np.isfinite(whole.points)].all()
    assert (again.tracks == whole.tracks).all()
    for name in ("view", "track", "xy", "before", "used"):
        assert (getattr(again.observations, name) == getattr(whole.observations, name)).all(), name
    text = (tables / "residuals.csv").read_text().splitlines()
    shutil.copytree(tables, torn := tmp_path / "tables")
    (torn / "residuals.csv").write_text("\n".join([*text[: 1 + rows], text[1 + rows][:9], *text[2 + rows :]]))
    with pytest.raises(InputError, match=rf"residuals.csv, line {2 + rows}: expected lon, lat"):
        read_tables(block_run.record, torn.parent)


def test_a_huge_run_is_thinned_evenly_and_says_so(block_run, sized):
    sized(tracks_in_tables=100)
    summary = summarize(block_run.run)
    found = summary.tables
    assert not found.complete
    assert 50 < found.num_written_tracks <= 100
    lines = b"".join(TABLES["residuals.csv"](block_run.run, summary)).decode().splitlines()
    assert len(lines) == found.num_written_tracks + 1
    table = b"".join(TABLES["observations.csv"](block_run.run, summary)).decode()
    observed = {line.split(",")[1] for line in table.split()[1:]}
    assert len(observed) == found.num_written_tracks
    assert block_run.summary["tables"]["complete"]


def test_names_with_commas_and_quotes_come_back(antimeridian_run):
    files = read_tables(antimeridian_run.record, antimeridian_run.folder)
    tracks = antimeridian_run.run.tracks
    usable = np.isfinite(antimeridian_run.run.ground).all(axis=1)[tracks.point]
    assert (files.observations.view == tracks.view[usable]).all()
    assert rows_of(antimeridian_run, "pairs.csv")[0]["a"] == antimeridian_run.views[0].name


def test_a_check_has_the_errors_of_the_cameras_as_they_are_and_none_of_new_ones(check_run):
    assert {(*row.values(),)[6:8] for row in rows_of(check_run, "observations.csv")} == {("", "")}
    first = rows_of(check_run)[0]
    assert first["mean_residual"] == first["mean_residual_before"] != ""


# --- read back --------------------------------------------------------------------------------------------

HEAD, ROW = ",".join(OBSERVATION_COLUMNS), "A,3,1.5,2.5,0.1,0.2,,,1"
PLACES, PLACE = ",".join(RESIDUALS), "10,20,30,0.5,3,0.7,8"


@pytest.fixture
def read(tmp_path):
    """Reads the tables of a run of the images A and B, of which some texts are given."""

    def made(**texts: str):
        return read_tables(a_summary([a_view("A"), a_view("B")]), without_points(tmp_path, 2, **texts))

    return made


def test_observations_are_read_with_what_is_missing(read):
    found = read(observations=f"{HEAD}\nB,4,1,2,3,4,5,6,0\n{ROW}\n").observations
    assert (found.view.tolist(), found.track.tolist(), found.used.tolist()) == ([1, 0], [4, 3], [False, True])
    assert found.xy.tolist() == [[1, 2], [1.5, 2.5]]
    assert found.before.tolist() == [[3, 4], [0.1, 0.2]]
    assert found.after[0].tolist() == [5, 6]
    assert np.isnan(found.after[1]).all()
    nothing = read()
    assert (len(nothing.observations.view), len(nothing.points), len(nothing.tracks)) == (0, 0, 0)


def test_places_are_read_with_their_numbers(read):
    found = read(residuals=f"{PLACES}\n{PLACE}\n10,20,30,,3,,999999999999\n10,20,-1e12,1e12,3,,0")
    assert found.points[0].tolist() == [10, 20, 30, 0.5]
    assert np.isnan(found.points[1, 3])
    assert found.points[2].tolist() == [10, 20, -1e12, 1e12]
    assert found.tracks.tolist() == [8, 999999999999, 0]


@pytest.mark.parametrize(
    "row",
    [
        "A,3,,2.5,0.1,0.2,,,1",  # a place is missing
        "A,-3,1.5,2.5,0.1,0.2,,,1",
        "A,1234567890123456789,1.5,2.5,0.1,0.2,,,1",
        "A,3,1.1e12,2.5,0.1,0.2,,,1",
        "A,3,1.5,2.5,-1.1e12,0.2,,,1",
        "A,3,inf,2.5,0.1,0.2,,,1",
        "C,3,1.5,2.5,0.1,0.2,,,1",
        "A,3,1.5,2.5,0.1,0.2,,1",
        "A,x,1.5,2.5,0.1,0.2,,,1",
    ],
)
def test_an_observation_that_cannot_be_is_refused(read, row):
    read(observations=f"{HEAD}\n{ROW}")
    with pytest.raises(InputError, match=r"observations\.csv(: damaged|, line 2: expected)"):
        read(observations=f"{HEAD}\n{row}")


@pytest.mark.parametrize(
    "place", [(540.0, 90.0), (-540.0, -90.0), (540.1, 0.0), (-540.1, 0.0), (0.0, 90.1), (0.0, -90.1)]
)
def test_a_place_is_on_the_earth_up_to_a_turn_and_a_half(read, place):
    points = f"{PLACES}\n{place[0]},{place[1]},30,0.5,3,0.7,8"
    outline = outlines(polygon([[0, 0], [1, 0], list(place), [0, 0]]), None)
    if abs(place[0]) <= 540 and abs(place[1]) <= 90:
        found = read(residuals=points, footprints=outline)
        assert len(found.points) == 1
        assert len(found.outlines[0][0]) == 4
        return
    for texts in ({"residuals": points}, {"footprints": outline}):
        with pytest.raises(InputError, match="no longitude and latitude"):
            read(**texts)


def polygon(*rings):
    return {"type": "Polygon", "coordinates": rings}


def outlines(*geometries) -> str:
    return json.dumps({"features": [{"geometry": one} for one in geometries]})


def test_outlines_are_the_outer_rings(read):
    square = [[0, 0], [1, 0], [1, 1], [0, 0]]
    parts = {"type": "MultiPolygon", "coordinates": [[square, "hole"], [square]]}
    one, two = read(footprints=outlines(parts, polygon(square, "hole"))).outlines
    assert (len(one), len(two), two[0].tolist()) == (2, 1, square)
    assert [len(rings) for rings in read(footprints=outlines(None, parts)).outlines] == [0, 2]
    for ring in (square[:3], [[0, 0, 0]] * 4, [0, 0, 0, 0]):
        with pytest.raises(InputError, match="outline of shape"):
            read(footprints=outlines(polygon(ring), None))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{PLACES}x\n{PLACE}\n", "no column track among the 7 of its first line"),
        (f"{PLACES}\n{PLACE}\n3\n", "residuals.csv, line 3: expected lon, lat"),
        ("", "the file is empty"),
    ],
)
def test_a_table_with_other_columns_is_refused(read, text, said):
    with pytest.raises(InputError, match=said):
        read(residuals=text)


def test_numbers_of_a_table():
    pair = a_pair("a,b", "c", 7, convergence_deg=0.123456, base_to_height=float("nan"), epipolar_after=None)
    head, row = b"".join(TABLES["pairs.csv"](None, a_summary([], [pair]))).decode().splitlines()
    assert row.startswith('"a,b",c,7,')
    found = dict(zip(head.split(","), *csv.reader([row]), strict=True))
    assert (found["convergence_deg"], found["base_to_height"], found["epipolar_after_rms_px"]) == ("0.12346", "", "")


def test_as_many_outlines_as_images_are_needed(read):
    with pytest.raises(InputError, match="1 outlines of 2 images"):
        read(footprints=outlines(None))


# --- written ----------------------------------------------------------------------------------------------


def test_an_observation_s_numbers_have_three_and_four_decimals(block_run, check_run):
    for finished, wanted in ((block_run, [3, 3, 4, 4, 4, 4]), (check_run, [4, 4, 4, 4])):
        cells = [*rows_of(finished, "observations.csv")[0].values()][2:8]
        assert [len(cell.partition(".")[2]) for cell in cells][: len(wanted)] == wanted


def test_points_of_a_reference_are_written_as_control_is_read():
    points = SimpleNamespace(
        lonlatalt=np.array([[10.0, 20.0, 30.0], [1.0, 2.0, 3.0]]), sigma=np.array([[1.0, 1.0, 2.0]] * 2),
        names=("P", "Q"),
        xy=np.array([[1.00004, 2.0], [3.0, 4.0], [5.0, 6.0]]), point=np.array([0, 1, 1]), view=np.array([1, 0, 1]),
    )  # fmt: skip
    run = SimpleNamespace(
        reference=SimpleNamespace(control=SimpleNamespace(points=points)),
        adjustment=SimpleNamespace(reference_inlier=np.array([True, False, True])),
        views=[SimpleNamespace(path="/a/x.tif"), SimpleNamespace(path="/b/y.tif")],
    )
    first, second = json.loads(gcps_geojson(run))["features"]
    assert first["properties"] == {"id": "P", "filename": "y.tif", "ji": [1.0, 2.0], "sigma_m": [1.0, 1.0, 2.0]}
    assert first["geometry"] == {"type": "Point", "coordinates": [10.0, 20.0, 30.0]}
    assert (second["properties"]["id"], second["properties"]["ji"]) == ("Q", [5.0, 6.0])


RELIEF = {"size": [2, 2], "share": 0.9, "nmad_m": 0.3, "picture": "QUJD"}


def test_a_surface_is_shown_beside_the_results_that_it_was_made_of_alone(block_run, tmp_path):
    shutil.copytree(block_run.folder / "tables", tmp_path / "tables")
    summary = block_run.record
    shown = [{"cameras": cameras, **RELIEF} for cameras in ("delivered", "corrected")]
    path = tmp_path / "tables/surface.json"
    path.write_text(json.dumps({"run": run_key(summary), "shown": shown}))
    assert [one.cameras for one in read_tables(summary, tmp_path).reliefs] == ["delivered", "corrected"]
    images = [{"image": name, **{key: RELIEF[key] for key in ("size", "picture")}} for name in "ab"]
    path.write_text(json.dumps({"run": run_key(summary), "shown": shown + images}))
    found = read_tables(summary, tmp_path)
    assert ([one.cameras for one in found.reliefs], [one.image for one in found.draped]) == (
        ["delivered", "corrected"], ["a", "b"]
    )  # fmt: skip
    first, *others = summary.outputs
    later = replace(summary, outputs=(replace(first, sha256="0" * 64), *others))
    assert read_tables(later, tmp_path).reliefs == ()  # of an earlier run in the same folder
    path.write_text("[]")
    assert read_tables(replace(summary, outputs=()), tmp_path).reliefs == ()  # a run at work looks at none
    wrong = (shown[:1], shown[::-1], shown + images[:1], shown + images + images[:1])
    for text in ("[]", "{}", *(json.dumps({"run": run_key(summary), "shown": rows}) for rows in wrong)):
        path.write_text(text)
        with pytest.raises(InputError, match=r"surface\.json: damaged"):
            read_tables(summary, tmp_path)


def test_small_pictures_are_those_of_images_and_pairs(block_run, tmp_path):
    shutil.copytree(block_run.folder / "tables", tmp_path / "tables")
    image = {"image": "a", "size": [2, 2], "picture": "QUJD"}
    strip = {**image, "rows": ["before"], "tiles": 3, "half_px": 8.0}
    path = tmp_path / "tables/pictures.json"
    path.write_text(json.dumps({"images": [image, image], "pairs": [strip]}))
    found = read_tables(block_run.record, tmp_path)
    assert ([one.image for one in found.thumbnails], [one.tiles for one in found.strips]) == (["a", "a"], [3])
    for wrong in ([], {"images": [image]}, {"images": [], "pairs": {}}, {"images": [{"image": "a"}], "pairs": []}):
        path.write_text(json.dumps(wrong))
        with pytest.raises(InputError, match=r"pictures\.json: damaged"):
            read_tables(block_run.record, tmp_path)


def test_points_in_a_ply_are_read_as_its_head_says():
    columns = {"x": np.array([1.5, -2.0]), "s": np.array([0.5, 4.0], np.float32), "n": np.array([7, -9], np.int32),
               "red": np.array([255, 3], np.uint8)}  # fmt: skip
    head, rows = ply(columns, "one", "two").split(b"end_header\n")
    assert head.decode().splitlines() == [
        "ply", "format binary_little_endian 1.0", "comment one", "comment two", "element vertex 2",
        "property double x", "property float s", "property int n", "property uchar red",
    ]  # fmt: skip
    assert [*struct.iter_unpack("<dfiB", rows)] == [(1.5, 0.5, 7, 255), (-2.0, 4.0, -9, 3)]
