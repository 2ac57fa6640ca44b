"""The manual's example of dense stereo: what it says must stay true."""

from __future__ import annotations

import pytest

import barpc
from benchmarks import stereo


@pytest.fixture(scope="module")
def ventoux(shared_data, tmp_path_factory):
    """A real pair that is 4.8 px off across its epipolar lines, and its adjusted cameras."""
    folder = shared_data / "optical" / "phr_ventoux"
    images = [folder / "left_image.tif", folder / "right_image.tif"]
    out = tmp_path_factory.mktemp("ventoux") / "adjusted"
    barpc.adjust(images, out)
    return images, out


@pytest.mark.slow
def test_adjusted_cameras_bring_a_pair_onto_its_epipolar_lines_and_find_its_surface(ventoux):
    images, out = ventoux
    before = stereo.measure(images, images, out)
    after = stereo.measure(images, [out / f"{path.stem}.vrt" for path in images], out)
    assert before.patches > 30
    assert after.patches > 30
    assert abs(before.offset) > 4
    assert abs(after.offset) < 0.05
    assert after.far == 0
    assert before.valid < 0.3  # by semi-global matching
    assert after.valid > 0.9


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_cars_reads_the_same_camera_from_the_files_that_the_manual_gives_it(ventoux, tmp_path):
    models = pytest.importorskip("shareloc.geomodels")
    out = ventoux[1]
    rpc = barpc.read_rpc(out / "left_image.vrt")
    geom = tmp_path / "left_image.geom"
    barpc.write_rpc(rpc, geom)
    lon, lat, alt = 5.1954, 44.2075, 530.0
    expected = rpc.project([lon, lat, alt])
    for source in (out / "left_image.vrt", geom):
        row, col, _ = models.GeoModel(str(source), "RPC").inverse_loc(lon, lat, alt)
        assert abs(col[0] - 0.5 - expected[0]) < 1e-6
        assert abs(row[0] - 0.5 - expected[1]) < 1e-6
