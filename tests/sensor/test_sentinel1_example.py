"""The example from a product to an orthoimage, run on a product with pixels."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import rasterio

from barpc.sensor.sentinel1 import burst_rows, read_annotation
from tests.geotiffs import write_image
from tests.sensor.s1_product import Product

HEIGHT = 250.0
SMALL = replace(Product(), samples=900, num_bursts=3, lines_per_burst=200, burst_cycle=150)


@pytest.fixture
def example() -> ModuleType:
    path = Path(__file__).parents[2] / "examples" / "sentinel1_rpc.py"
    spec = importlib.util.spec_from_file_location("sentinel1_rpc", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def picture(ground: np.ndarray) -> np.ndarray:
    """What the ground looks like: bright waves of about a kilometre."""
    return 1000.0 + 300.0 * np.sin(ground[..., 0] * 500.0) + 300.0 * np.cos(ground[..., 1] * 600.0)


@pytest.fixture
def safe(tmp_path: Path) -> Path:
    """A product whose bursts each show the ground where they see it; the overlaps show it twice."""
    folder = tmp_path / "S1A.SAFE"
    (folder / "annotation").mkdir(parents=True)
    (folder / "measurement").mkdir()
    (folder / "annotation" / SMALL.name).write_bytes(SMALL.xml())
    annotation, model = read_annotation(SMALL.xml()), SMALL.model()
    pixels = np.zeros((SMALL.lines, SMALL.samples), dtype=np.complex64)
    for burst in burst_rows(annotation):
        rows = burst.first_row + np.arange(SMALL.lines_per_burst)
        image = np.stack(np.meshgrid(np.arange(SMALL.samples), rows), axis=-1).astype(float)
        lines = slice(burst.first_line, burst.first_line + SMALL.lines_per_burst)
        pixels[lines] = picture(model.localize(image, np.array(HEIGHT))) * np.exp(1j)
        pixels[burst.first_line : burst.first_line + 20] = 0
        pixels[burst.first_line + SMALL.lines_per_burst - 20 : lines.stop] = 0
    name = folder / "measurement" / SMALL.name.replace(".xml", ".tiff")
    write_image(name, pixels)
    return folder


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_gdal_orthorectifies_a_stitched_swath_with_its_rpc(example: ModuleType, safe: Path) -> None:
    out = safe.parent / "out"
    example.main([str(safe), str(out), "--height", str(HEIGHT), "--pixel", "15"])
    with rasterio.open(out / "iw1.tif") as stitched:
        pixels = stitched.read(1)
        assert stitched.rpcs is not None
        assert (pixels[20:480] > 0).all()  # no seam
        assert (pixels[:20] == 0).all()
    with rasterio.open(out / "iw1_ortho.tif") as ortho:
        values = ortho.read(1)
        row, col = np.nonzero(values)
        step_lon, _, west, _, step_lat, north = ortho.transform[:6]
    lon, lat = west + (col + 0.5) * step_lon, north + (row + 0.5) * step_lat
    expected = picture(np.stack([lon, lat], axis=-1))
    error = np.abs(values[row, col] - expected)
    assert len(row) > 20000
    assert np.median(error) <= 0.6  # half a pixel off: 3 along the range, 8 along the track
    assert np.quantile(error, 0.95) <= 2.5
