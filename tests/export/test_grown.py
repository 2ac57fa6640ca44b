"""Exports, surfaces and orthoimages of a run that added images have those of the run behind it, too."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import barpc
from barpc.base.errors import InputError
from barpc.dsm.stereo import block_of_run
from barpc.export.shots import read_scene
from tests.reliability.trials import SAMPLES, crop

FEW = {"points_per_image": 400}


def pair_and_one(folder: Path) -> list[Path]:
    """Write the images and two runs, of a pair and of an image added to it; return the images."""
    images = [crop(path, folder / path.name, side=320, start=300) for path in SAMPLES[:3]]
    barpc.adjust(images[:2], folder / "january", **FEW)
    barpc.adjust(images[2:], folder / "february", add_to=str(folder / "january"), **FEW)
    return images


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """A folder with the images and three runs: a pair, and an image added without and with `update`."""
    folder = tmp_path_factory.mktemp("grown")
    images = pair_and_one(folder)
    barpc.adjust(images[2:], folder / "updated", add_to=str(folder / "january"), update=True, **FEW)
    return folder


def test_the_scene_has_all_images_with_the_newest_cameras(runs: Path) -> None:
    for name in ("february", "updated"):
        scene = read_scene(runs / name)
        assert [shot.name for shot in scene.shots] == ["view_00", "view_01", "view_02"]
        for shot in scene.shots:
            newest = name if (runs / name / f"{shot.name}.vrt").exists() else "january"
            assert shot.writer.folder.name == newest
            assert shot.rpc == barpc.read_rpc(runs / newest / f"{shot.name}.vrt")
            assert len(shot.xy) > 50
            off = shot.rpc.project(scene.points[shot.index]) - shot.xy
            assert np.sqrt((off**2).sum(axis=1).mean()) < 0.2
        assert {frozenset((pair.a, pair.b)) for pair in scene.pairs} == {
            frozenset(pair) for pair in (("view_00", "view_01"), ("view_00", "view_02"), ("view_01", "view_02"))
        }


def test_a_surface_takes_all_pairs_and_states_its_uncertainty(runs: Path, tmp_path: Path) -> None:
    block = block_of_run(runs / "february")
    assert {tuple(sorted(pair)) for pair in block.groups[0]} == {(0, 1), (0, 2), (1, 2)}
    made = barpc.dsm(runs / "february", tmp_path / "dsm.tif")
    assert len(made.pairs) == 3
    assert made.sigma_cameras > 0.0
    assert made.datum > 1.0


def test_orthoimages_and_exports_are_of_all_images(runs: Path, tmp_path: Path) -> None:
    assert [one.path.name for one in barpc.ortho(runs / "february", tmp_path / "maps", gsd=4)] == [
        "view_00.tif",
        "view_01.tif",
        "view_02.tif",
    ]
    barpc.export(runs / "february", tmp_path / "s2p", "s2p")
    assert len(json.loads((tmp_path / "s2p/config.json").read_text())["images"]) == 3
    barpc.export(runs / "february", tmp_path / "stac", "stac", date=["2020-06-01"])
    item = json.loads((tmp_path / "stac/view_00.json").read_text())
    assert {(tmp_path / "stac" / one["href"]).resolve().parent.name for one in item["assets"].values()} >= {"january"}


def test_both_folders_move_together(runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs, tmp_path / "moved")
    assert len(read_scene(tmp_path / "moved/february").shots) == 3


@pytest.mark.landing(1)
@pytest.mark.few(1)
@pytest.mark.parametrize("harm", ["gone", "another", "camera"])
def test_an_earlier_run_that_is_not_what_it_was_is_named(tmp_path: Path, harm: str) -> None:
    pair_and_one(tmp_path)
    january = tmp_path / "january"
    if harm == "camera":
        for name in ("view_00_RPC.TXT", "view_00.vrt"):
            (january / name).write_text((january / name).read_text() + "\n")
    else:
        shutil.rmtree(january)
    if harm == "another":
        barpc.adjust(sorted(tmp_path.glob("view_0[01].tif")), january, **FEW, drift=0)
    with pytest.raises(InputError, match="january"):
        read_scene(tmp_path / "february")
