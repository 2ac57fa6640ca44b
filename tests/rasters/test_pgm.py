"""GeographicLib's geoid grids: numbers of 16 bits from the north pole and Greenwich on, heights by the header."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import ImageError, InputError
from barpc.rasters.dem import Dem, HeightGrid
from tests.rasters.test_dem import write_dem

HEAD = (
    "P5\n# Geoid file in PGM format for the GeographicLib::Geoid class\n# Offset {offset}\n# Scale {scale}\n"
    "# Origin 90N 0E\n# AREA_OR_POINT Point\n{cols} {rows}\n65535\n"
)


def write(path: Path, numbers: np.ndarray, offset: str = "-108", scale: str = "0.003", head: str = HEAD) -> Path:
    rows, cols = numbers.shape
    text = head.format(offset=offset, scale=scale, cols=cols, rows=rows)
    path.write_bytes(text.encode() + numbers.astype(">u2").tobytes())
    return path


def bilinear(numbers: np.ndarray, lon: float, lat: float, offset: float, scale: float) -> float:
    """GeographicLib's: cells of 360 / width and 180 / (height - 1) degrees, the last column beside the first."""
    rows, cols = numbers.shape
    x, y = (lon % 360.0) * cols / 360.0, (90.0 - lat) * (rows - 1) / 180.0
    i, j = min(int(y), rows - 2), int(x)
    u, v = x - j, y - i
    (a, b), (c, d) = ([float(numbers[i + k, (j + m) % cols]) for m in (0, 1)] for k in (0, 1))
    return offset + scale * ((1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d))


@pytest.mark.parametrize("shape", [(19, 36), (61, 120), (3, 2)])
def test_heights_are_those_of_the_nodes_and_bilinear_between(shape, tmp_path):
    rng = np.random.default_rng(2)
    numbers = rng.integers(0, 65536, shape)
    numbers[0, 0], numbers[-1, -1] = 65535, 0
    grid = HeightGrid.open(write(tmp_path / "g.pgm", numbers, "-71.5", "0.0125"))
    places = np.column_stack([rng.uniform(-180, 540, 500), rng.uniform(-90, 90, 500)])
    edges = [(0, 90), (0, -90), (359.999, 89.9), (-0.001, 0.3), (180, 0), (-180, 0), (360, 45), (5.4, -89.9999)]
    for lon, lat in [*places.tolist(), *edges]:
        expected = bilinear(numbers, lon, lat, -71.5, 0.0125)
        assert grid.sample(lon, lat) == pytest.approx(expected, abs=2e-3 if (lon, lat) in edges else 1e-6), (lon, lat)
    lon, lat = np.arange(shape[1]) * 360 / shape[1], 90 - np.arange(shape[0]) * 180 / (shape[0] - 1)
    found = grid.sample(*np.meshgrid(lon, lat))
    np.testing.assert_allclose(found, -71.5 + 0.0125 * numbers, rtol=0, atol=1e-9)
    assert grid.vertical.reference == "ellipsoid"
    assert np.isnan(grid.sample([0.0, 0.0], [90.1, -91.0])).all()


def test_a_dem_is_made_ellipsoidal_with_it(tmp_path):
    level = write_dem(tmp_path / "dem.tif", "EPSG:4326+5773", np.full((20, 30), 200.0, np.float32))
    dem = Dem.open(level, write(tmp_path / "egm.PGM", np.full((19, 36), 52_000)))
    assert dem(5.1, 43.9) == pytest.approx(200.0 - 108.0 + 156.0)
    assert "egm.PGM" in dem.description


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda d: b"", "the file is empty"),
        (lambda d: d.replace(b"P5", b"P2"), "no .pgm of 16-bit"),
        (lambda d: d.replace(b"\n65535\n", b"\n255\n"), "no .pgm of 16-bit"),
        (lambda d: d.replace(b"# Scale 0.003\n", b""), "state '# Offset' and '# Scale'"),
        (lambda d: d.replace(b"Offset -108", b"Offset nan"), "state '# Offset' and '# Scale'"),
        (lambda d: d.replace(b"Scale 0.003", b"Scale 0"), "state '# Offset' and '# Scale'"),
        (lambda d: d.replace(b"90N 0E", b"90N 180W"), "Origin 90N 180W"),
        (lambda d: d.replace(b"Point\n", b"Area\n"), "only grids of points"),
        (lambda d: d[:-1], "needs"),
        (lambda d: d + b"\0", "needs"),
        (lambda d: d.replace(b"36 19", b"999999 999999"), "needs"),
    ],
)  # fmt: skip
def test_what_is_no_such_grid_is_refused(change, what, tmp_path):
    path = write(tmp_path / "g.pgm", np.full((19, 36), 7))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises((InputError, ImageError), match=what) as told:
        HeightGrid.open(path)
    assert str(path) in str(told.value)


def test_comments_may_stand_anywhere_in_the_header(tmp_path):
    head = "P5\n# Offset {offset}\n{cols} {rows}\n# Scale {scale}\n# of no meaning\n65535\n"
    grid = HeightGrid.open(write(tmp_path / "g.pgm", np.full((19, 36), 1000), head=head))
    assert grid.sample(12.0, 34.0) == pytest.approx(-105.0)


def test_a_grid_that_ends_while_it_is_read_is_said(tmp_path):
    path = write(tmp_path / "g.pgm", np.full((19, 36), 1000))
    grid = HeightGrid.open(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match="needs"):
        grid.sample(12.0, -89.0)


def test_the_case_from_the_field(shared_data):
    path = shared_data / "field_cases" / "egm96_3deg.pgm"
    if not path.is_file():
        pytest.skip("no field cases in the shared data")
    assert HeightGrid.open(path).sample(5.4, 43.3) == pytest.approx(48.98, abs=5e-3)
