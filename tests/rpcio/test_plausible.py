"""An RPC of another image, of other pixels or of a coarser product is named before anything is matched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

import barpc
from barpc.base.errors import FitError, InputError, Remark, RpcError
from barpc.rpcio.plausible import RasterFrame, doubts_of, reach_of_corners
from barpc.sensor.rpc import RPC
from tests.rpcio.conftest import ended

ROOT = Path(__file__).resolve().parents[2]
SIZE = 1000, 1000
VIEWS = [str(ROOT / f"data_samples/view_0{i}.tif") for i in range(3)]


def the_rpc(number: int = 0) -> RPC:
    return barpc.read_rpc(VIEWS[number])


def kinds(rpc: RPC, size: tuple[int, int] = SIZE, frame: RasterFrame | None = None) -> list[str]:
    words = {"geotransform": "map", "half widths": "ground", " px, and its RPC": "size"}
    found = [one.sentence for one in doubts_of(rpc, size, frame)]
    return [next(kind for word, kind in words.items() if word in sentence) for sentence in found]


@pytest.mark.parametrize("times", [2, 3, 4, 8])
def test_rpcs_of_coarser_and_finer_products_are_named(times: int) -> None:
    coarser, finer = (the_rpc().window(0.0, 0.0, step, step) for step in (times, 1.0 / times))
    assert kinds(coarser) == ["ground", "size"]
    assert any(f"{times} times coarser" in one.sentence for one in doubts_of(coarser, SIZE))
    assert doubts_of(coarser, SIZE)[0].refused == (times > 2)
    assert kinds(finer) == ["size"]
    assert f"{times} times finer" in doubts_of(finer, SIZE)[0].sentence


@pytest.mark.parametrize("off", [(500, 0), (-500, 0), (0, 500), (0, -500), (500, -500)])
def test_an_rpc_that_is_half_an_image_off_is_named(off: tuple[int, int]) -> None:
    assert kinds(the_rpc().crop(*off)) == ["ground"]
    assert 1.5 < reach_of_corners(the_rpc().crop(*off), SIZE) < 2.0


def test_parts_with_their_own_rpc_and_bands_are_right() -> None:
    rpc = the_rpc()
    assert kinds(rpc) == []
    for col, row, width, height in ((100, 50, 300, 700), (0, 400, 1000, 600), (600, 0, 400, 1000)):
        assert kinds(rpc.crop(col, row), (width, height)) == []
    assert kinds(rpc.window(0, 0, 4, 4), (250, 250)) == []
    assert kinds(rpc.window(200, 300, 0.5, 0.5), (800, 600)) == []
    assert kinds(rpc, (600, 1000)) == ["size"]  # its right part cut off, or more of it


def test_right_images_have_no_doubt(shared_data: Path) -> None:
    folders = ("optical", "cross_sensor", "passes", "truth")
    files = [path for folder in folders for path in sorted((shared_data / folder).rglob("*.tif"))]
    files += [shared_data / "rpc_formats/wv3_20.NTF", *map(Path, VIEWS)]
    asked = 0
    for file in files:
        try:
            camera = barpc.open_camera(file)
        except barpc.BarpcError:
            continue  # a DEM, an orthoimage
        asked += isinstance(camera.model, RPC) and camera.size is not None
        assert camera.doubts == (), file
    assert asked >= 18


def test_the_case_from_the_field(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rpcs = [shared_data / f"field_cases/pan_with_ms_rpc/view_0{i}_RPC.TXT" for i in range(3)]
    given = [f"{view},camera={rpc}" for view, rpc in zip(VIEWS, rpcs, strict=True)]
    assert all(5.0 < reach_of_corners(barpc.read_rpc(rpc), SIZE) < 7.0 for rpc in rpcs)
    assert ended("adjust", *given, "-o", tmp_path / "run") == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "view_00.tif: its corners lie outside of the ground that its RPC was made for, 6.0 half widths from" in said
    assert not (tmp_path / "run").exists()
    with pytest.raises(RpcError, match="half widths from the middle"):
        barpc.ortho(given[0], tmp_path / "map", alt=200)
    with pytest.raises(RpcError, match="half widths from the middle"):
        barpc.fit(given[0])
    assert ended("info", given[0]) == 0
    assert "4 times coarser" in capsys.readouterr().out


# --- the map that a file says it is on -----------------------------------------------------------------------


def at_one_altitude(rpc: RPC, alt: float) -> tuple[RPC, RasterFrame]:
    """An image resampled to a map at one altitude: the RPC refitted to its pixels, and its frame."""
    size = 400, 300
    lon, lat = rpc.ground_offset[:2] - (0.002, -0.0015)
    step = 1e-5
    frame = RasterFrame(size, Affine(step, 0.0, lon, 0.0, -step, lat), rasterio.crs.CRS.from_epsg(4326))

    def image(ground: np.ndarray) -> np.ndarray:
        at = rpc.project(ground)
        flat = rpc.localize(at, np.full(len(at), alt))
        return np.column_stack([(flat[:, 0] - lon) / step, (lat - flat[:, 1]) / step]) - 0.5

    axes = [np.linspace(lon - 0.0005, lon + 0.0045, 12), np.linspace(lat - 0.0035, lat + 0.0005, 12)]
    ground = np.stack(np.meshgrid(*axes, np.linspace(-50, 550, 5), indexing="ij"), axis=-1).reshape(-1, 3)
    return barpc.fit_rpc_points(ground, image(ground), size=size).rpc, frame


@pytest.mark.parametrize("alt", [0.0, 230.0, 500.0])
def test_an_image_on_a_map_at_one_altitude_agrees_with_its_rpc(alt: float) -> None:
    ready, frame = at_one_altitude(the_rpc(), alt)
    assert kinds(ready, frame.size, frame) == []
    away = replace(frame, transform=frame.transform @ Affine.translation(12.0, -9.0))
    assert kinds(ready, frame.size, away) == []  # a pointing error that somebody corrected
    assert kinds(the_rpc(), frame.size, frame)[0] == "map"
    turned = Affine(0.0, 1e-5, frame.transform.c, 1e-5, 0.0, frame.transform.f)
    assert kinds(ready, frame.size, replace(frame, transform=turned))[0] == "map"


def test_an_orthoimage_with_the_rpc_of_its_image_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maps = barpc.ortho(VIEWS[:1], tmp_path / "maps", alt=220)
    assert maps[0].doubts == ()
    given = f"{maps[0].path},camera={VIEWS[0]}"
    camera = barpc.open_camera(given)
    assert "an orthoimage with the RPC of the image it was made of" in camera.doubts[0].sentence
    with pytest.raises(FitError, match="an orthoimage"):
        barpc.fit(given, tmp_path / "x_RPC.TXT")
    assert not (tmp_path / "x_RPC.TXT").exists()
    assert ended("ortho", given, "--alt", "220", "-o", tmp_path / "again") == 3
    assert "an orthoimage" in capsys.readouterr().err
    assert ended("convert", given, tmp_path / "y_RPC.TXT") == 0
    assert "an orthoimage" in capsys.readouterr().err


def reduced(path: Path) -> np.ndarray:
    with rasterio.open(path) as image:
        return image.read(1).reshape(500, 2, 500, 2).mean(axis=(1, 3)).astype(np.uint16)


def cut(path: Path) -> np.ndarray:
    with rasterio.open(path) as image:
        return image.read(1)[250:750, 200:800]


@pytest.mark.parametrize("change", [reduced, cut])
def test_pictures_that_were_changed_under_their_rpc_need_a_look(
    change: Callable[[Path], np.ndarray], tmp_path: Path
) -> None:
    for view in map(Path, VIEWS[:2]):
        pixels = change(view)
        shape = {"width": pixels.shape[1], "height": pixels.shape[0], "count": 1, "dtype": pixels.dtype}
        with rasterio.open(
            tmp_path / view.name, "w", driver="GTiff", **shape, rpcs=barpc.read_rpc(view).to_rasterio()
        ) as image:
            image.write(pixels, 1)
    found = barpc.adjust(sorted(tmp_path.glob("*.tif")), tmp_path / "run", points_per_image=400)
    assert found.record.status == "look"
    assert {view.cause for view in found.record.views} == {"other_pixels"}
    assert all("its RPC was made for 1000 x 1000 px" in reason for reason in found.record.reasons[:2])


def test_the_folder_of_a_run_is_no_image_and_its_images_are_adjusted(tmp_path: Path) -> None:
    barpc.adjust(VIEWS[:2], tmp_path / "run", points_per_image=300)
    with pytest.raises(InputError, match="the folder of a finished run, with adjusted cameras"):
        barpc.open_camera(tmp_path / "run")
    with pytest.warns(Remark, match="its cameras are adjusted already"):
        assert len(barpc.info(tmp_path / "run", alt=200.0)) == 2
