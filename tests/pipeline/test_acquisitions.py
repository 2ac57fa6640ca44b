"""Bands of one acquisition get one correction; images whose RPCs only look alike do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

import barpc
from barpc.base.errors import InputError
from barpc.pipeline.acquisitions import one_each
from barpc.pipeline.loading import load_views
from barpc.sensor.rpc import RPC
from barpc.simulate import simulate_block
from tests.geotiffs import write_image
from tests.pipeline.known import SAMPLES as VIEWS

GRID = np.stack(np.meshgrid(np.linspace(0, 249, 6), np.linspace(0, 249, 6)), axis=-1).reshape(-1, 2)


def band(view: Path, path: Path, step: int = 4, *, turned: bool = False) -> Path:
    """A coarser image of the same place and time, in other grey values; `turned`: of something else."""
    with rasterio.open(view) as image:
        pixels = image.read(1).astype(np.float64)
    side = len(pixels) // step
    pixels = pixels[: side * step, : side * step].reshape(side, step, side, step).mean(axis=(1, 3))
    pixels = 3000.0 - 0.7 * pixels  # a band in which bright is dark
    rpc = barpc.read_rpc(view).window(0, 0, step, step)
    return write_image(path, (pixels[::-1, ::-1] if turned else pixels).astype(np.uint16), rpcs=rpc.to_rasterio())


@pytest.mark.nightly
def test_a_band_gets_the_correction_of_its_image(tmp_path: Path) -> None:
    coarse = band(VIEWS[0], tmp_path / "multi.tif")
    alone = barpc.adjust(VIEWS, tmp_path / "alone", points_per_image=500)
    found = barpc.adjust([*VIEWS, coarse], tmp_path / "run", points_per_image=500)
    assert found.record.status == "good"
    for one, other in zip(found.views, alone.views, strict=False):
        assert one.sensor == other.sensor
    (line,) = [line for line in found.record.verdict if "one acquisition" in line]
    assert line.startswith("multi: of one acquisition with view_00 ")
    (carried,) = found.record.carried or ()
    assert (carried.name, carried.lead) == ("multi", "view_00")
    assert set(carried.outputs) == {"multi.vrt", "multi_RPC.TXT"}
    assert [view.name for view in found.views] == ["view_00", "view_01", "view_02", "multi"]
    for file in ("multi.vrt", "multi_RPC.TXT"):
        written, lead = (barpc.read_rpc(tmp_path / "run" / name) for name in (file, "view_00.vrt"))
        for alt in (-50.0, 220.0, 550.0):
            ground = written.localize(GRID, np.full(len(GRID), alt))
            assert np.abs(lead.project(ground) - (4 * GRID + 1.5)).max() < 1e-4
    assert all(one.passed for one in barpc.verify(tmp_path / "run"))
    again = barpc.adjust([coarse, *VIEWS[::-1]], tmp_path / "again", points_per_image=500)
    assert again.record.carried[0].outputs == carried.outputs  # type: ignore[index]


def test_an_image_of_something_else_with_such_an_rpc_is_no_band(tmp_path: Path) -> None:
    right, wrong = band(VIEWS[0], tmp_path / "a.tif"), band(VIEWS[1], tmp_path / "b.tif", turned=True)
    loaded = load_views([VIEWS[0], VIEWS[1], right, wrong])
    kept, carried = one_each(loaded.views, loaded.sources, 1)
    assert [one.view.name for one in carried] == ["a"]
    assert [loaded.views[i].name for i in kept] == ["b", "view_00", "view_01"]


def test_the_finest_leads_and_parts_follow_the_whole(tmp_path: Path) -> None:
    middle, coarse = band(VIEWS[0], tmp_path / "b.tif", 2), band(VIEWS[0], tmp_path / "a.tif", 4)
    barpc.convert(VIEWS[0], tmp_path / "part.tif", window=(100, 200, 500, 600))
    loaded = load_views([coarse, middle, tmp_path / "part.tif", VIEWS[0], VIEWS[1]])
    _, carried = one_each(loaded.views, loaded.sources, 1)
    assert [(one.view.name, one.lead) for one in carried] == [("a", "view_00"), ("b", "view_00"), ("part", "view_00")]
    np.testing.assert_allclose(carried[0].step, 0.25, rtol=1e-9)
    np.testing.assert_allclose(carried[2].start, (-100.0, -200.0), atol=1e-6)


def test_neighbouring_frames_are_images_of_their_own(tmp_path: Path) -> None:
    for name, window in (("a", (0, 0, 1000, 560)), ("b", (0, 440, 1000, 560))):
        barpc.convert(VIEWS[0], tmp_path / f"{name}.tif", window=window)
    loaded = load_views([tmp_path / "a.tif", tmp_path / "b.tif", VIEWS[1]])
    assert one_each(loaded.views, loaded.sources, 1)[1] == ()


def test_an_image_and_its_band_alone_are_nothing_to_adjust(tmp_path: Path) -> None:
    coarse = band(VIEWS[0], tmp_path / "multi.tif")
    with pytest.raises(InputError, match="multi: a band of view_00, of one acquisition"):
        barpc.adjust([VIEWS[0], coarse], tmp_path / "run")


@pytest.mark.nightly
def test_a_band_is_added_with_other_images_and_not_alone(tmp_path: Path) -> None:
    few = {"points_per_image": 500}
    coarse = band(VIEWS[0], tmp_path / "multi.tif")
    barpc.adjust(VIEWS[:2], tmp_path / "a", **few)
    with pytest.raises(InputError, match=r"multi: has the camera of view_00 of .*a, up to scale and shift"):
        barpc.adjust([coarse], tmp_path / "b", add_to=str(tmp_path / "a"), **few)
    found = barpc.adjust([coarse, VIEWS[2]], tmp_path / "b", add_to=str(tmp_path / "a"), **few)
    assert [(one.name, one.lead) for one in found.record.carried or ()] == [("multi", "view_00")]
    written, lead = (barpc.read_rpc(tmp_path / name) for name in ("b/multi.vrt", "a/view_00.vrt"))
    ground = written.localize(GRID, np.full(len(GRID), 220.0))
    assert np.abs(lead.project(ground) - (4 * GRID + 1.5)).max() < 1e-3


@pytest.mark.slow
def test_a_real_multispectral_image_follows_its_panchromatic_one(shared_data: Path, tmp_path: Path) -> None:
    """It ended 4.2 px away from it."""
    views = [shared_data / f"optical/phr_ventoux/{side}_image.tif" for side in ("left", "right")]
    coarse = shared_data / "cross_sensor/phr_ventoux_xs/left_xs.tif"
    found = barpc.adjust([*views, coarse], tmp_path / "run")
    assert found.record.status == "good"
    assert [one.lead for one in found.record.carried or ()] == ["left_image"]
    band, lead = (barpc.read_rpc(tmp_path / "run" / name) for name in ("left_xs.vrt", "left_image.vrt"))
    at = GRID * 144 / 249
    for alt in (300.0, 1000.0, 1900.0):
        ground = band.localize(at, np.full(len(at), alt))
        assert np.abs(lead.project(ground) - (4 * at - (40.0, 42.0))).max() < 0.1


def test_the_cameras_of_a_pass_are_asked_for_all_others_at_once() -> None:
    asked: list[int] = []

    class Asked(RPC):
        def project(self, ground):
            asked.append(len(ground))
            return super().project(ground)

    (view,) = simulate_block(2, 20, seed=1, num_checks=0).views[:1]
    rpc = view.sensor
    assert isinstance(rpc, RPC)
    parts = rpc.ground_scale, rpc.image_offset, rpc.image_scale
    moved = [Asked(rpc.coeffs, rpc.ground_offset + [0.1 * n, 0.0, 0.0], *parts) for n in range(40)]
    views = [replace(view, name=f"v{n}", sensor=one) for n, one in enumerate(moved)]
    kept, carried = one_each(views, [None] * 40, 1)  # type: ignore[list-item]  # cameras are handed on alone
    assert (kept, carried) == (list(range(40)), ())
    assert asked == list(range(40))
