"""Real images: the tool's own tie points aside, detector points in, independent check points measured.

The check points never enter a solve.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.base.errors import BarpcWarning
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
from barpc.pointio.gcps import read_gcps
from barpc.rasters.dem import Dem
from barpc.rpcio import read_rpc
from barpc.scene import GroundPoints, Tracks, View
from barpc.sensor.rpc import altitude_range
from barpc.sensor.triangulation import epipolar_offset, triangulate
from tests.geotiffs import write_image
from tests.lanes import rest_slow

TRIPLET = [("img_01", "img_02"), ("img_01", "img_03"), ("img_02", "img_03")]


def _table(shared: Path, scene: str, pair: tuple[str, str], kind: str) -> np.ndarray:
    path = shared / "truth" / "ties" / f"{scene}__{pair[0]}__{pair[1]}__{kind}.csv"
    rows = np.loadtxt(path, delimiter=",", skiprows=1)[:, :4]
    return rows.reshape(-1, 2, 2)


def _pairs(shared: Path, scene: str, pairs, names, kind: str) -> Tracks:
    view, point, xy, count = [], [], [], 0
    for pair in pairs:
        rows = _table(shared, scene, pair, kind)
        view += [np.tile([names.index(name) for name in pair], len(rows))]
        point += [count + np.repeat(np.arange(len(rows)), 2)]
        xy += [rows.reshape(-1, 2)]
        count += len(rows)
    view = np.concatenate(view)
    return Tracks(view, np.concatenate(point), np.concatenate(xy), np.full(len(view), 0.3))


def _view(path: Path, rpc, size) -> View:
    return View(path.stem, str(path), size, rpc, altitude_range(rpc))


@pytest.fixture(scope="module")
def triplet(shared_data) -> list[View]:
    folder = shared_data / "optical" / "phr_triplet_north"
    sizes = {"img_01": (1024, 560), "img_02": (1028, 530), "img_03": (1021, 490)}
    return [_view(folder / f"{n}.tif", read_rpc(folder / f"{n}.tif"), size) for n, size in sizes.items()]


@pytest.fixture(scope="module", params=rest_slow(["right_image", "right_image_bias"]))
def ventoux(shared_data, request) -> list[View]:
    folder = shared_data / "optical" / "phr_ventoux"
    left = read_rpc(folder / "left_image.geom").crop(5000, 5000)
    right = read_rpc(folder / f"{request.param}.geom").crop(4915, 5162)
    return [
        _view(folder / "left_image.tif", left, (500, 500)),
        _view(folder / "right_image.tif", right, (498, 495)),
    ]


def _offsets(shared, found: Adjustment, scene, pairs) -> list[np.ndarray]:
    sensors = dict(zip(found.names, found.sensors, strict=True))
    out = []
    for pair in pairs:
        rows = _table(shared, scene, pair, "ncc_check")
        out.append(epipolar_offset(sensors[pair[0]], sensors[pair[1]], rows[:, 0], rows[:, 1], 300.0)[0])
    return out


def _shift(views, found: Adjustment, checks: Tracks) -> np.ndarray:
    before = triangulate([v.sensor for v in views], checks.view, checks.point, checks.xy).points
    after = triangulate(list(found.sensors), checks.view, checks.point, checks.xy).points
    enu = enu_basis(ground_from_ecef(before[0]))
    return enu @ np.nanmean(after - before, axis=0)


@pytest.mark.slow
def test_the_triplet_agrees_and_stays_where_it_was(shared_data, triplet):
    names = [view.name for view in triplet]
    tracks = _pairs(shared_data, "phr_triplet_north", TRIPLET, names, "sift")
    checks = _pairs(shared_data, "phr_triplet_north", TRIPLET, names, "ncc_check")
    capped = adjust_tracks(triplet, tracks, AdjustOptions(noise_floor=0.1))
    assert np.abs(_shift(triplet, capped, checks)).max() <= 0.1
    found = adjust_tracks(triplet, tracks)
    for offset in _offsets(shared_data, found, "phr_triplet_north", TRIPLET):
        assert abs(np.median(offset)) <= 0.03
    shift = _shift(triplet, found, checks)
    # metres, from detector points: 0.45 up, where 67 are not known; a metre is what is trusted
    assert np.abs(shift).max() <= 0.5
    assert np.abs(shift[:2]).max() <= 0.15
    assert (np.abs(shift) < found.gauge.sigma).all()
    assert found.gauge.sigma[2] > 10.0  # and it says that it does not know the height


@pytest.mark.slow
def test_without_a_cap_many_points_move_the_scene_by_metres(shared_data, triplet):
    names = [view.name for view in triplet]
    tracks = _pairs(shared_data, "phr_triplet_north", TRIPLET, names, "sift")
    checks = _pairs(shared_data, "phr_triplet_north", TRIPLET, names, "ncc_check")
    found = adjust_tracks(triplet, tracks, AdjustOptions(noise_floor=0.0))
    assert np.abs(_shift(triplet, found, checks)).max() > 2.0


def test_ventoux_agrees_and_stays_where_it_was(shared_data, ventoux):
    pairs = [("left_image", "right_image")]
    names = [view.name for view in ventoux]
    tracks = _pairs(shared_data, "phr_ventoux", pairs, names, "sift")
    checks = _pairs(shared_data, "phr_ventoux", pairs, names, "ncc_check")
    found = adjust_tracks(ventoux, tracks)
    (offset,) = _offsets(shared_data, found, "phr_ventoux", pairs)
    assert abs(np.median(offset)) <= 0.10
    assert np.abs(_shift(ventoux, found, checks)).max() <= 1.0


def test_one_quickbird_image_is_refined_by_its_gcps(shared_data):
    path = shared_data / "optical" / "qb2_single" / "qb2_basic1b.tif"
    view = _view(path, read_rpc(path), (850, 1450))
    gcps = read_gcps(path.parent / "gcps.geojson", [view.name])
    before = view.sensor.project(gcps.lonlatalt) - gcps.xy
    none = np.zeros(0, dtype=int)
    found = adjust_tracks([view], Tracks(none, none, np.zeros((0, 2)), np.zeros(0)), None, gcps)
    after = found.sensors[0].project(gcps.lonlatalt) - gcps.xy
    assert np.sqrt((before**2).mean()) > 1.0
    assert np.sqrt((after**2).mean()) < 0.5 * np.sqrt((before**2).mean())


@pytest.mark.slow
def test_a_gcp_that_was_left_out_lies_nearer_than_before(shared_data):
    path = shared_data / "optical" / "qb2_single" / "qb2_basic1b.tif"
    view = _view(path, read_rpc(path), (850, 1450))
    gcps = read_gcps(path, [view.name])
    none = np.zeros(0, dtype=int)
    empty = Tracks(none, none, np.zeros((0, 2)), np.zeros(0))
    before, after = [], []
    for left_out in range(len(gcps.names)):
        keep = np.arange(len(gcps.names)) != left_out
        rest = GroundPoints(
            tuple(np.array(gcps.names)[keep]), gcps.lonlatalt[keep], gcps.sigma[keep], np.arange(keep.sum()),
            gcps.view[keep], gcps.xy[keep], gcps.xy_sigma[keep],
        )  # fmt: skip
        found = adjust_tracks([view], empty, None, rest)
        for sensor, rows in ((view.sensor, before), (found.sensors[0], after)):
            rows.append(sensor.project(gcps.lonlatalt[left_out]) - gcps.xy[left_out])
    assert np.sqrt(np.mean(np.square(after))) < np.sqrt(np.mean(np.square(before)))
    assert ecef_from_ground(gcps.lonlatalt).shape == (5, 3)


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("ventoux", ["right_image"], indirect=True)
@pytest.mark.parametrize("with_geoid", [True, False])
def test_a_dem_that_holds_ventoux_moves_it_by_no_more_than_is_stated(shared_data, ventoux, with_geoid, tmp_path):
    """Also one that does not say what its heights count from: the tile's without its name."""
    names = [view.name for view in ventoux]
    pairs = [("left_image", "right_image")]
    tracks = _pairs(shared_data, "phr_ventoux", pairs, names, "sift")
    checks = _pairs(shared_data, "phr_ventoux", pairs, names, "ncc_check")
    path = shared_data / "dem/N44E005.hgt"
    if not with_geoid:
        with rasterio.open(path) as tile:
            profile, heights = tile.profile | {"driver": "GTiff"}, tile.read()
        path = write_image(tmp_path / "unnamed.tif", heights, **profile)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BarpcWarning)
        dem = Dem.open(path, shared_data / "dem/egm96_15.gtx" if with_geoid else None)
    found = adjust_tracks(ventoux, tracks, AdjustOptions(), dem=dem)
    free = adjust_tracks(ventoux, tracks, AdjustOptions())
    moved = _shift(ventoux, found, checks)
    assert np.linalg.norm(moved[:2]) < 7.0  # with errors that average away it was 15 m
    assert (np.abs(moved) < 2.5 * free.gauge.sigma).all()
    together = 5.0 if with_geoid else 18.0  # 5 or 20 m, as it is known what the heights count from
    assert found.gauge.sigma[2] == pytest.approx(together, rel=0.1)
    assert free.gauge.sigma[2] > 2.0 * found.gauge.sigma[2]
    assert found.terrain.held == found.terrain.total > 200
    ground = ground_from_ecef(free.points[np.isfinite(free.points[:, 0])])
    offset = float(np.nanmedian(ground[:, 2] - dem(*ground[:, :2].T)))
    assert offset == pytest.approx(4.0 if with_geoid else 55.0, abs=3.0)
    assert abs(found.terrain.offset) < abs(offset)
    assert free.datum["heights"].max() == 0.0
    assert 0.5 < found.datum["heights"][2] < (0.99 if with_geoid else 0.9)
