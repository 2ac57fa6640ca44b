"""RPCs that were exchanged among the images of a run are told by where matches lie across epipolar lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import pytest

import barpc
from barpc.base.errors import InputError
from barpc.pipeline import AdjustResult
from barpc.pipeline.exchanged import exchanged_cameras
from barpc.scene import View
from tests.lanes import rest_slow
from tests.pipeline.known import SAMPLES as VIEWS

ORDERS = [order for order in permutations(range(3)) if order != (0, 1, 2)]


def with_cameras_of(views: Sequence[View], order: Sequence[int]) -> list[View]:
    return [replace(view, sensor=views[k].sensor) for view, k in zip(views, order, strict=True)]


@pytest.fixture(scope="module")
def samples() -> AdjustResult:
    return barpc.check(VIEWS, points_per_image=800)


@pytest.mark.parametrize("order", ORDERS)
def test_every_exchange_of_three_is_found_by_matches(samples: AdjustResult, order: tuple[int, ...]) -> None:
    views, tracks = samples.run.views, samples.tracks
    found = exchanged_cameras(with_cameras_of(views, order), tracks)
    assert found is not None
    back = dict(zip(found.views, found.cameras, strict=True))
    assert [order[back.get(i, i)] for i in range(3)] == [0, 1, 2]
    assert found.exchanged < 0.05 < 0.4 < found.scatter


def test_right_cameras_and_bad_ones_are_not_exchanged(samples: AdjustResult) -> None:
    views, tracks = samples.run.views, samples.tracks
    assert exchanged_cameras(views, tracks) is None
    rpc = views[1].sensor
    bent = rpc.coeffs.copy()
    bent[0, 2] += 0.01  # columns by latitude: 5 px over the image
    bad = [views[0], replace(views[1], sensor=replace(rpc, coeffs=bent)), views[2]]
    assert exchanged_cameras(bad, tracks) is None
    moved = replace(views[2], sensor=rpc.crop(300.0, -200.0))  # of another image, which is not there
    assert exchanged_cameras([views[0], views[1], moved], tracks) is None


@pytest.mark.nightly
@pytest.mark.parametrize("keep_going", [False, True])
def test_a_run_with_exchanged_rpcs_ends_or_leaves_them_out(tmp_path: Path, keep_going: bool) -> None:
    given = [f"{VIEWS[0]},camera={VIEWS[1]}", f"{VIEWS[1]},camera={VIEWS[0]}", str(VIEWS[2])]
    with pytest.raises(InputError, match=r"view_00 and view_01 fit each other's RPC and not the one given: matches"):
        barpc.adjust(given, tmp_path / "run", points_per_image=500, keep_going=keep_going)
    assert not (tmp_path / "run/summary.json").exists()
    with pytest.raises(InputError, match="give each image its own RPC"):
        barpc.check(given, points_per_image=500)


@pytest.mark.costs(3)
@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("order", rest_slow([*ORDERS, (1, 0)], 2, mark=pytest.mark.nightly))
def test_so_it_is_among_real_images(shared_data: Path, order: tuple[int, ...]) -> None:
    names = [f"optical/phr_triplet_whole/img_0{i}.tif" for i in (1, 2, 3)]
    if len(order) == 2:
        names = [f"optical/phr_ventoux/{side}_image.tif" for side in ("left", "right")]
    files = [shared_data / name for name in names]
    cameras = [barpc.open_camera(file) for file in files]
    views = [View(f.stem, str(f), c.extent, c.model, c.alt_range) for f, c in zip(files, cameras, strict=True)]
    barpc.check(views)
    with pytest.raises(InputError, match=r"fits? .*RPC"):
        barpc.check(with_cameras_of(views, order))
