"""The machine outputs hold what the run found, under the names that users of ASP know."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from barpc.geodesy import ecef_from_ground, enu_basis
from barpc.report import run as runs
from barpc.report import summarize
from barpc.report.records import plain
from barpc.report.tables import OBSERVATIONS, RESIDUALS, TABLES, read_tables


def rows_of(path):
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return header, rows


def test_residuals_have_the_column_names_of_asp(block_run):
    header, _ = rows_of(block_run.folder / "residuals.csv")
    assert header[:5] == ["lon", "lat", "height_above_datum", "mean_residual", "num_observations"]


def test_a_row_of_residuals_is_a_track_where_the_new_cameras_see_it(block_run):
    run = block_run.run
    _, rows = rows_of(block_run.folder / "residuals.csv")
    table = np.array(rows, dtype=float)
    usable = np.flatnonzero(np.isfinite(run.ground).all(axis=1))
    assert len(table) == len(usable)
    assert np.abs(table[:, :2] - run.ground[usable, :2]).max() < 1e-9
    assert np.abs(table[:, 2] - run.ground[usable, 2]).max() < 1e-4
    track = usable[7]
    seen = np.flatnonzero((run.tracks.point == track) & run.adjustment.inlier)
    ecef = run.ground[track]
    errors = [np.hypot(*(run.after[run.tracks.view[k]].project(ecef) - run.tracks.xy[k])) for k in seen]
    assert table[7, 3] == pytest.approx(np.mean(errors), abs=1e-4)
    assert table[7, 4] == len(seen)


def test_observations_give_the_errors_of_the_summary_back(block_run):
    header, rows = rows_of(block_run.folder / "observations.csv")
    assert tuple(header) == OBSERVATIONS
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


def test_geojson_holds_the_same_rows_as_the_csv(block_run):
    collection = json.loads((block_run.folder / "residuals.geojson").read_text())
    header, rows = rows_of(block_run.folder / "residuals.csv")
    assert len(collection["features"]) == len(rows)
    first, row = collection["features"][3], dict(zip(header, map(float, rows[3]), strict=True))
    assert first["geometry"]["type"] == "Point"
    assert first["geometry"]["coordinates"] == [row["lon"], row["lat"], row["height_above_datum"]]
    assert first["properties"] == row
    assert tuple(first["properties"]) == RESIDUALS


def test_pairs_hold_the_figures_of_the_summary(block_run):
    header, rows = rows_of(block_run.folder / "pairs.csv")
    assert len(rows) == len(block_run.summary["pairs"])
    row, pair = dict(zip(header, rows[0], strict=True)), block_run.summary["pairs"][0]
    assert (row["a"], row["b"], int(row["num_matches"])) == (pair["a"], pair["b"], pair["num_matches"])
    assert float(row["convergence_deg"]) == pytest.approx(pair["convergence_deg"], abs=1e-5)
    assert float(row["epipolar_after_rms_px"]) == pytest.approx(pair["epipolar_after"]["rms"], abs=1e-5)


def test_the_point_cloud_is_the_tie_points_about_the_origin_it_states(block_run):
    data = (block_run.folder / "points.ply").read_bytes()
    head, body = data.split(b"end_header\n", 1)
    words = next(line for line in head.decode().splitlines() if line.startswith("comment")).split()
    origin = np.array([float(words[words.index(key) + 1]) for key in ("lon", "lat", "alt")])
    kind = np.dtype(
        [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("mean_residual", "<f4"), ("num_observations", "<i4")]
    )
    cloud = np.frombuffer(body, dtype=kind)
    assert f"element vertex {len(cloud)}" in head.decode()
    local = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=-1)
    ecef = local @ enu_basis(origin) + ecef_from_ground(origin)
    usable = np.isfinite(block_run.run.ground).all(axis=1)
    assert (
        np.abs(ecef - ecef_from_ground(block_run.run.ground[usable])).max() < 1e-3
    )  # the origin's 9 decimals


def test_the_same_run_gives_the_same_bytes(block_run):
    run, summary = block_run.run, block_run.record
    again = replace(
        summarize(run), stages=summary.stages
    )  # tables and report count, too, once they are written
    assert again == summary
    assert json.dumps(plain(again)) == json.dumps(block_run.summary)
    for name, content in TABLES.items():
        assert content(run, again) == (block_run.folder / name).read_bytes(), name


def test_a_huge_run_is_thinned_evenly_and_says_so(block_run, monkeypatch):
    monkeypatch.setattr(runs, "MAX_TRACKS", 100)
    summary = summarize(block_run.run)
    found = summary.tables
    assert not found.complete
    assert 50 < found.num_written_tracks <= 100
    lines = TABLES["residuals.csv"](block_run.run, summary).decode().splitlines()
    assert len(lines) == found.num_written_tracks + 1
    observed = {
        line.split(",")[1] for line in TABLES["observations.csv"](block_run.run, summary).decode().split()[1:]
    }
    assert len(observed) == found.num_written_tracks
    assert block_run.summary["tables"]["complete"]


def test_names_with_commas_and_quotes_come_back(antimeridian_run):
    files = read_tables(antimeridian_run.record, antimeridian_run.folder)
    tracks = antimeridian_run.run.tracks
    usable = np.isfinite(antimeridian_run.run.ground).all(axis=1)[tracks.point]
    assert (files.observations.view == tracks.view[usable]).all()
    _, pairs = rows_of(antimeridian_run.folder / "pairs.csv")
    assert pairs[0][0] == antimeridian_run.views[0].name


def test_a_check_leaves_the_columns_of_new_cameras_empty(check_run):
    _, rows = rows_of(check_run.folder / "observations.csv")
    assert {tuple(row[6:8]) for row in rows} == {("", "")}
