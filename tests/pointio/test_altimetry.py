"""Files of altimetry: what each spelling holds arrives, and what lies is said in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.pointio.correspondences import GROUND_SIGMA, HEIGHT_SIGMA, read_altimetry
from tests.pointio.conftest import refused

WANTED = [[5.44, 43.25, 120.5], [5.45, 43.26, 130.0]]


@pytest.mark.parametrize(
    "text",
    [
        "lon,lat,alt\n5.44,43.25,120.5\n5.45,43.26,130\n",
        "lat,lon,alt\n43.25,5.44,120.5\n43.26,5.45,130\n",
        "# ATL06\n\ndelta_time\tlatitude\tlongitude\th_li\n1\t43.25\t5.44\t120.5\n2\t43.26\t5.45\t130\n",
        "Latitude; Longitude; Height\n43,25; 5,44; 120,5\n43,26; 5,45; 130\n",
        "lon_lowestmode lat_lowestmode elev_lowestmode\n5.44 43.25 120.5\n5.45   43.26 130\n",
        "5.44 43.25 120.5\n5.45 43.26 130\n",
        "\ufefflon [deg],lat [deg],alt [m]\r\n5.44,43.25,120.5\r\n5.45,43.26,130\r\n",
        "lon,lat,alt\n5.44,43.25,120.5\n5.45,43.26,130\n5.46,43.27,-9999\n5.46,43.2,3.4e38\n5.46,43.2,\n5.4,43.2,nan\n",
    ],
)
def test_every_spelling_gives_the_same_heights(tmp_path: Path, text: str):
    file = tmp_path / "a.csv"
    file.write_text(text, encoding="utf-8")
    found = read_altimetry(file)
    np.testing.assert_array_equal(found.lonlatalt, WANTED)
    np.testing.assert_array_equal(found.sigma, HEIGHT_SIGMA)
    np.testing.assert_array_equal(found.sigma_flat, GROUND_SIGMA)


def test_accuracies_are_taken_where_they_are_stated(tmp_path: Path):
    file = tmp_path / "a.csv"
    file.write_text("lon,lat,alt,sigma,sigma_flat\n5.44,43.25,120.5,0.2,3\n5.45,43.26,130,,0\n")
    found = read_altimetry(file)
    np.testing.assert_array_equal(found.sigma, [0.2, HEIGHT_SIGMA])
    np.testing.assert_array_equal(found.sigma_flat, [3.0, 0.0])
    file.write_text("5.44 43.25 120.5 0.2 3\n5.45 43.26 130 0.3 4\n")
    np.testing.assert_array_equal(read_altimetry(file).sigma_flat, [3.0, 4.0])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "the file is empty"),
        ("lon,lat,alt\n", "holds no height"),
        ("lon,lat,alt\n5.44,43.25,-9999\n", "holds no height"),
        ("lon,lat\n5.44,43.25\n", "no column alt"),
        ("east,north,alt\n1,2,3\n", "no column lon, lat"),
        ("lon,lat,alt\n5.44,43.25,12x\n", "line 2: expected lon, lat, alt"),
        ("lon,lat,alt\n5.44,,120\n", "is no longitude and latitude in degrees"),
        ("lon,lat,alt\n602000,4795000,120\n", "is no longitude and latitude in degrees"),
        ("5.44 43.25 120 0.2 1 7\n", "no column lon, lat, alt among the 6"),
        ("lon,lat,alt,sigma\n5.44,43.25,120,0\n", "sigmas positive"),
        ("lon,lat,alt,sigma\n5.44,43.25,120,-1\n", "sigmas positive"),
        ("lon,lat,alt,sigma\n5.44,43.25,120,inf\n", "not finite"),
        ("lon,lat,alt,sigma_flat\n5.44,43.25,120,-1\n", "sigmas positive"),
        ('lon,lat,alt\n"5.44,43.25,120\n' + "1" * 200_000 + "\n", "line"),
    ],
)
def test_what_is_wrong_is_one_line_with_the_file(tmp_path: Path, text: str, told: str):
    file = tmp_path / "a.csv"
    file.write_text(text)
    refused(read_altimetry, file, told)


def test_what_is_no_text_is_refused(tmp_path: Path):
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(range(256)))
    for path in (tmp_path / "a.h5", tmp_path, tmp_path / "missing.csv"):
        with pytest.raises(InputError):
            read_altimetry(path)


def test_heights_are_those_that_there_are_on_earth(tmp_path: Path):
    (tmp_path / "a.csv").write_text(
        "lon,lat,alt\n" + "".join(f"5,43,{alt}\n" for alt in (-1000.5, -1000, 9500, 9500.5))
    )
    assert read_altimetry(tmp_path / "a.csv").lonlatalt[:, 2].tolist() == [-1000.0, 9500.0]
