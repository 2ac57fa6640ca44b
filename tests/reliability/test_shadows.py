"""No verb makes an image that is there seem another camera, whatever it writes beside it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.cameras import open_camera
from barpc.export.targets import TARGETS
from barpc.rasters.raster import open_raster
from tests.lanes import rest_slow
from tests.reliability.conftest import barpc


def seen(folder: Path) -> dict[str, object]:
    """What barpc and GDAL make of every image in a folder, and its bytes."""
    found: dict[str, object] = {}
    for path in sorted(folder.glob("view_*.tif")):
        with open_raster(path) as image:
            ground = open_camera(path).model.localize(np.array([[0.0, 0.0], [99.0, 7.0]]), np.array([90.0, 99.0]))
            found[path.name] = (path.read_bytes(), image.shape, ground.tobytes())
        with rasterio.open(path) as image:
            found[f"gdal {path.name}"] = str(image.rpcs)
    return found


NOON = "2020-06-01T11:30:00"
VERBS = {
    **{f"export {one}": ("export", "{run}", "{in}", "--to", one, "--time", NOON, "--overwrite") for one in TARGETS},
    "adjust": ("adjust", "{a}", "{b}", "-o", "{in}", "--overwrite", "--rpc-format", "geom"),
    "match": ("match", "{a}", "{b}", "-o", "{in}", "--overwrite"),
    "convert to a folder": ("convert", "{a}", "{b}", "-o", "{in}", "--rpc", "{run}", "--overwrite"),
    **{
        f"convert to .{end}": ("convert", "{run}/view_00.vrt", f"{{in}}/view_00{sep}{end}")
        for sep, end in ((".", "RPB"), ("_", "RPC.TXT"), (".", "geom"), (".", "rpc"))
    },
    "fit": ("fit", "{run}/view_00.vrt", "-o", "{in}/view_00_RPC.TXT", "--keep-going"),
    "report": ("report", "{run}"),
}


FITTED = ("export colmap",)  # beside the images as the others; pinholes are fitted: tests/export


@pytest.mark.few(2)
@pytest.mark.parametrize("verb", rest_slow(sorted(VERBS, key=lambda verb: verb in FITTED), len(TARGETS) + 1))
def test_an_image_stays_the_camera_that_it_was(ran, tmp_path, verb) -> None:
    folder = tmp_path / "in"
    shutil.copytree(ran / "in", folder)
    places = {"run": ran / "out", "in": folder, "a": folder / "view_00.tif", "b": folder / "view_01.tif"}
    before = seen(folder)
    if verb.startswith("export"):  # of a run whose images these are
        shutil.copytree(ran / "out", tmp_path / "run")
        summary = tmp_path / "run" / "summary.json"
        summary.write_text(summary.read_text().replace(str(ran / "in"), str(folder)))
        places["run"] = tmp_path / "run"
    said = barpc(*(word.format(**places) for word in VERBS[verb]))
    assert "unexpected" not in said.err
    assert seen(folder) == before, said
