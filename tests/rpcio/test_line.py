"""The place of real images, and of parts of them, on the line of their sensor: known to 5 px, or one true sentence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from barpc.base.errors import InputError
from barpc.cameras import open_camera
from barpc.rpcio.line import line_place
from barpc.scene import Camera
from tests.rpcio.conftest import make_rpc


def place_of(path: Path) -> tuple[float, float]:
    camera = open_camera(path)
    found = line_place(camera, camera.size)
    assert found.sigma <= 5.0
    return found.start, found.columns


@pytest.mark.parametrize(
    ("name", "start", "columns"),
    [
        ("optical/phr_ventoux/left_image.tif", 5792, 40000),  # col 5000 of a product that begins at column 792
        ("optical/phr_ventoux/right_image.tif", 5729, 40000),
        ("cross_sensor/phr_ventoux_xs/left_xs.tif", 1438, 10000),  # a quarter of that line; 1438 * 4 = 5752
        ("rpc_formats/wv3_20.NTF", 501, 42501),
        ("physical_maxar/10200100A1865800.r100.xml", 0, 35180),
        ("csm/1040010074793300.adjusted_state.json", 0, 43008),
    ],
)
def test_a_part_whose_rpc_was_moved_with_it_has_its_place(shared_data, name, start, columns):
    found = place_of(shared_data / name)
    assert found == pytest.approx((start, columns), abs=2.0)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "optical/phr_triplet_whole/img_01.tif",
            "columns 18144 to 19168 for an image of 1024, and the ground of 59862",
        ),
        ("optical/phr_triplet_north/img_03.tif", "these are not the columns of a whole product"),
        ("cross_sensor/ngi_2015/ngi_05_0182.tif", "640 columns are no whole line of a sensor"),
        ("rpc_formats/PHR1B_P_201709281038393_SEN_PRG_FC_178609-001.tif", "cropped after its RPC was made"),
    ],
)
def test_else_the_reason_is_said(shared_data, name, words):
    with pytest.raises(InputError, match=words):
        place_of(shared_data / name)


def camera(first: float, last: float, width: int = 8000) -> Camera:
    """An RPC that states columns, of an image of a width."""
    rpc = make_rpc()
    offset, scale = rpc.image_offset.copy(), rpc.image_scale.copy()
    offset[0], scale[0] = (first + last) / 2.0, (last - first) / 2.0
    return Camera(
        replace(rpc, image_offset=offset, image_scale=scale), Path("a.tif"), "tag", (width, 2000), (0.0, 500.0)
    )


def test_whole_products_begin_at_the_first_column_and_parts_where_their_rpc_says():
    assert line_place(camera(0.0, 7999.0), (8000, 2000)).start == 0.0
    assert line_place(camera(-60.0, 8100.0), (8000, 2000)).start == 0.0  # it reaches beyond its image
    assert line_place(camera(-75680.0, 83680.0), (8000, 2000)).columns == 8000  # one scale for both axes
    for start in (1000.0, 3500.0):
        part = line_place(camera(-start, 7999.0 - start), (4000, 2000))
        assert (part.start, part.columns) == (start, 8000.0)


@pytest.mark.parametrize(("first", "width"), [(500.0, 4000), (-5000.0, 4000)])
def test_an_image_beyond_the_columns_that_its_rpc_states_has_no_place(first, width):
    with pytest.raises(InputError, match="not the columns of a whole product"):
        line_place(camera(first, first + 7999.0), (width, 2000))
