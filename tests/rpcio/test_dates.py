"""The day an image was taken: from the files beside it, from its tags, and from nothing that is none."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from barpc.rpcio.acquisition import Acquisition, read_acquisition


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
    assert read_acquisition(image, image).day(tags) == day


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
    assert read_acquisition(path, path).day({"TIFFTAG_DATETIME": "2020:01:01 00:00:00"}) == "2013-04-17"


def test_the_file_of_the_camera_is_asked_first(shared_data: Path, tmp_path: Path) -> None:
    image = tmp_path / "a.tif"
    (tmp_path / "a.imd").write_text("firstLineTime = 2013-04-17T10:36:02Z;")
    camera = shared_data / "rpc_formats/WV02_10300100D0772D00.r100.xml"
    assert read_acquisition(image, camera).day({}) == "2022-04-19"
    assert read_acquisition(image, shared_data / "rpc_formats/wv3_30.RPB").day({}) == "2013-04-17"  # states none


def test_a_file_that_cannot_be_read_or_says_nonsense_states_nothing(tmp_path: Path) -> None:
    image = tmp_path / "a.tif"
    os.mkfifo(tmp_path / "a.imd")
    (tmp_path / "a.xml").write_bytes(b"\xff\x00<IMAGING_DATE>2013-99-17</IMAGING_DATE>" + b"firstLineTime = " * 1000)
    assert read_acquisition(image, tmp_path).day({"TIFFTAG_DATETIME": "2013:04:17 00:00:00"}) == "2013-04-17"


@pytest.mark.parametrize("name", ["a.tif", "link.tif", "hard.tif", "a.ntf", "hidden.rpc"])
def test_pixels_are_never_searched_whatever_the_image_is_called(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The name of a camera's file that is an image: relative, by a link, or the text's ending on a raster."""
    monkeypatch.chdir(tmp_path)
    Path("a.tif").write_bytes(b"II*\0" + b'firstLineTime = 2013-04-17T10:36:02Z;\nsatId = "WV02";\nmeanSunEl = 30;\n')
    Path("link.tif").symlink_to("a.tif")
    os.link("a.tif", "hard.tif")
    Path("a.ntf").write_bytes(b"NITF02.10" + Path("a.tif").read_bytes())
    Path("hidden.rpc").write_bytes(Path("a.tif").read_bytes())
    for image, camera in ((name, name), (Path(name).absolute(), name), (name, tmp_path / name), ("other.tif", name)):
        assert read_acquisition(image, camera) == Acquisition()


def test_words_are_found_in_any_case_and_between_many_numbers(tmp_path: Path) -> None:
    lines = "".join(f"<P>{i} -{i}.5e-07 {i * i}.125</P>\n" for i in range(20_000))
    stated = "<SATID>WV03</SATID><S1UN>sat 1D bandid</S1UN><mIsSiOnX>9</mIsSiOnX><BANDID>P</BANDID>"
    stated += "<MEANSUNEL>29.4</MEANSUNEL>"
    (tmp_path / "a.xml").write_text(
        f"<isd>{lines}{stated}<TLCTIME>2022-04-17T22:51:49.05Z</TLCTIME>{lines}<meansunaz>187</meansunaz></isd>"
    )
    (tmp_path / "a.imd").symlink_to("a.xml")  # one file, once
    wanted = Acquisition(29.4, 187.0, "2022-04-17T22:51:49.05Z", "WV03_P")
    assert read_acquisition(tmp_path / "a.tif") == wanted
