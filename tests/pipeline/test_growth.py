"""What a run costs for each image does not grow with their number: calls are counted, not seconds."""

from __future__ import annotations

import os
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import BarpcError
from barpc.base.geodesy import ground_from_ecef
from barpc.base.options import RunOptions
from barpc.pipeline import adjust, load_views, outputs, run
from barpc.report import Run, verdict
from barpc.rpcio import formats
from barpc.sensor.geometry import Several
from barpc.sensor.rpc import RPC
from barpc.sensor.triangulation import epipolar_offset
from barpc.simulate import SimulatedBlock, simulate_block
from tests.pipeline.known import write_block

SIDE = 256
LAYOUT = {"size": (SIDE, SIDE), "gsd": 40.0, "attitude": 5e-5}


def small_block(folder: Path, num: int) -> tuple[SimulatedBlock, list[Path]]:
    """A block with small images, which differ."""
    block = simulate_block(num, 40 * num, seed=3, num_checks=0, **LAYOUT)
    ramp = np.add.outer(np.arange(SIDE), np.arange(SIDE)).astype(np.uint16)
    paths = write_block(folder, block.views, block.tracks, lambda number: ramp + np.uint16(number))
    os.utime(folder, (1e9, 1e9))  # nothing was written there for long
    return block, paths


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("block")


@pytest.fixture(scope="module")
def block(folder) -> tuple[SimulatedBlock, list[Path]]:
    return small_block(folder, 12)


def counted(monkeypatch, owner: object, name: str, counts: Counter[str]) -> None:
    real = getattr(owner, name)

    def watched(*given, **options):
        counts[name] += 1
        return real(*given, **options)

    monkeypatch.setattr(owner, name, watched)


@pytest.mark.slow
def test_a_folder_is_listed_once_for_all_its_images_and_again_when_it_changes(block, folder, monkeypatch):
    counts: Counter[str] = Counter()
    os.utime(folder, (2e9, 2e9))  # what is known of it no longer holds
    os.utime(folder, (1e9 + 1, 1e9 + 1))
    counted(monkeypatch, os, "scandir", counts)
    assert len(load_views(block[1]).views) == 12
    assert counts["scandir"] == 1
    names = set(formats.files_of(folder))
    (folder / "NEW.txt").touch()
    assert set(formats.files_of(folder)) == names | {"new.txt"}
    (folder / "NEW.txt").unlink()
    assert set(formats.files_of(folder)) == names
    os.utime(folder, (1e9, 1e9))


@pytest.mark.parametrize("keep_going", [False, True])
def test_other_workers_read_the_same_views_and_the_first_error_counts(block, folder, sized, keep_going):
    sized(images_together=3)
    told = []
    given = [*block[1], folder / "missing.tif", folder / "none.tif"]
    with ThreadPoolExecutor(2) as executor:
        options = {"executor": executor, "progress": lambda *state: told.append(state)}
        if not keep_going:
            with pytest.raises(BarpcError, match=r"missing\.tif"):
                load_views(given, **options)
            return
        found = load_views(given, keep_going=True, **options)
    alone = load_views(block[1])
    assert found.views == alone.views
    assert [Path(path).name for path, _ in found.left_out] == ["missing.tif", "none.tif"]
    assert told == [("cameras", done, 14) for done in (3, 6, 9, 12, 14)]
    assert (alone.worker_seconds, found.worker_seconds > 0) == (0.0, True)


@pytest.mark.slow
def test_a_summary_asks_each_camera_as_often_in_a_large_block_as_in_a_small_one(monkeypatch):
    calls = []
    for num in (12, 48):
        block = simulate_block(num, 40 * num, seed=3, num_checks=0, **LAYOUT)
        counts: Counter[str] = Counter()
        with monkeypatch.context() as patch:
            for name in ("localize", "project", "project_jacobian"):
                counted(patch, RPC, name, counts)
            summary = verdict.summarize(Run("check", block.views, (), block.tracks))
        assert len(summary.pairs) > 3 * num
        calls.append(counts.total() / num)
    assert calls[1] < 1.3 * calls[0] < 100


@pytest.mark.slow
def test_pairs_measured_together_are_as_measured_alone(block):
    found = Run("check", block[0].views, (), block[0].tracks)
    entries = {(pair.a, pair.b): pair for pair in verdict.summarize(found).pairs}
    xy, point = found.tracks.xy, found.tracks.point
    for ties in found.pairs:
        i, j = ties.views
        alt = ground_from_ecef(found.ties_before.points)[point[ties.a], 2]
        pair = entries[found.views[i].name, found.views[j].name]
        alone, _ = epipolar_offset(found.before[i], found.before[j], xy[ties.a], xy[ties.b], alt, steps=2)
        alone = alone[np.isfinite(alone)]
        near = {"rel": 1e-9, "abs": 1e-10}  # px: many cameras' polynomials are scaled to pixels beforehand
        assert pair.epipolar_before.median == pytest.approx(np.median(alone), **near)
        spread = 1.4826 * np.median(np.abs(alone - np.median(alone)))
        assert pair.epipolar_before.spread == pytest.approx(spread, **near)
        assert pair.epipolar_before.rms == pytest.approx(np.sqrt(np.mean(alone**2)), **near)
        assert pair.epipolar_before.count == len(alone)


def test_no_point_of_several_cameras_is_asked_of_none(block):
    sensors = [view.sensor for view in block[0].views[:3]]
    assert not len(Several(sensors, np.zeros(0, dtype=np.int64)).project(np.zeros((0, 3))))


@pytest.mark.slow
def test_a_run_that_was_stopped_in_writing_goes_on_after_the_fits(block, folder, tmp_path, monkeypatch):
    """The fits are kept, and the files are opened again whatever was kept."""
    counts: Counter[str] = Counter()
    for name in ("fit_rpc", "write_views"):
        counted(monkeypatch, run, name, counts)
    options = RunOptions(matches=str(folder / "ties.npz"), matches_only=True)

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("barpc.pipeline.outputs.make_files", stop)
        adjust(block[1], tmp_path / "out", options)
    assert (counts["fit_rpc"], counts["write_views"]) == (12, 1)
    told: Counter[str] = Counter()
    counted(monkeypatch, outputs, "verify", told)
    result = adjust(block[1], tmp_path / "out", options)
    assert (counts["fit_rpc"], counts["write_views"], told["verify"]) == (12, 2, 12)
    assert all(view.outputs for view in result.record.views)
    assert not any((tmp_path / "out" / ".barpc" / "partial").glob("**/*"))
