"""The day an image was taken: from the files beside it, from its tags, and from nothing that is none."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from barpc.rpcio.sources import date_taken


@pytest.mark.parametrize(
    ("tags", "day"),
    [
        ({"ACQUISITIONDATETIME": "2013-04-17T10:36:02Z"}, "2013-04-17"),
        ({"TIFFTAG_DATETIME": "2013:04:17 10:36:02"}, "2013-04-17"),
        ({"NITF_IDATIM": "20130417103602"}, "2013-04-17"),
        ({"NITF_IDATIM": "20130417103602", "TIFFTAG_DATETIME": "2020:01:01 00:00:00"}, "2013-04-17"),
        ({"ACQUISITIONDATETIME": "2013-04-17", "NITF_IDATIM": "20020101000000"}, "2013-04-17"),
        ({"ACQUISITIONDATETIME": "--", "NITF_IDATIM": "20130417103602"}, "2013-04-17"),
        ({"TIFFTAG_DATETIME": "0000:00:00 00:00:00"}, ""),
        ({"TIFFTAG_DATETIME": "1900:01:01 00:00:00"}, ""),
        ({"TIFFTAG_DATETIME": "2013:13:41 00:00:00"}, ""),
        ({"NITF_IDATIM": "17103602ZAPR13"}, ""),
        ({"AREA_OR_POINT": "Area"}, ""),
    ],
)
def test_tags_state_a_day(tmp_path: Path, tags: dict[str, str], day: str) -> None:
    image = tmp_path / "a.tif"
    assert date_taken(image, image, tags) == day


@pytest.mark.parametrize(
    ("image", "beside", "text"),
    [
        ("a.tif", "a.IMD", "\tcloudCover = 0.1;\n\tfirstLineTime = 2013-04-17T10:36:02.1Z;\n"),
        ("a.tif", "A.xml", "<isd><IMD><FIRSTLINETIME>2013-04-17T10:36:02Z</FIRSTLINETIME></IMD></isd>"),
        ("IMG_PHR_X_R1C1.TIF", "DIM_PHR_X.XML", "<IMAGING_DATE>2013-04-17</IMAGING_DATE>"),
        ("IMG_PHR_X.TIF", "DIM_PHR_X.XML", "<IMAGING_DATE>2013-04-17</IMAGING_DATE>"),
    ],
)
def test_the_makers_file_beside_an_image_goes_before_its_tags(
    tmp_path: Path, image: str, beside: str, text: str
) -> None:
    (tmp_path / beside).write_text(text)
    path = tmp_path / image
    assert date_taken(path, path, {"TIFFTAG_DATETIME": "2020:01:01 00:00:00"}) == "2013-04-17"


def test_the_file_of_the_camera_is_asked_first(shared_data: Path, tmp_path: Path) -> None:
    image = tmp_path / "a.tif"
    (tmp_path / "a.imd").write_text("firstLineTime = 2013-04-17T10:36:02Z;")
    camera = shared_data / "rpc_formats/WV02_10300100D0772D00.r100.xml"
    assert date_taken(image, camera, {}) == "2022-04-19"
    assert date_taken(image, shared_data / "rpc_formats/wv3_30.RPB", {}) == "2013-04-17"  # states none


def test_a_file_that_cannot_be_read_or_says_nonsense_states_nothing(tmp_path: Path) -> None:
    image = tmp_path / "a.tif"
    os.mkfifo(tmp_path / "a.imd")
    (tmp_path / "a.xml").write_bytes(b"\xff\x00<IMAGING_DATE>2013-99-17</IMAGING_DATE>" + b"firstLineTime = " * 1000)
    assert date_taken(image, tmp_path, {"TIFFTAG_DATETIME": "2013:04:17 00:00:00"}) == "2013-04-17"
