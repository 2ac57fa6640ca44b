"""Images added to finished runs, whose files are given, moved, renamed, lost and edited; tie points are given."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from barpc.ba import BlockPrior
from barpc.base.errors import BarpcError, InputError
from barpc.pipeline import AdjustResult, RunOptions, adjust
from barpc.pipeline.proof import PASSED_STATES, prove
from barpc.pointio.matches import write_matches
from barpc.rpcio import read_rpc
from barpc.rpcio.images import put_tag
from barpc.scene import Tracks
from barpc.simulate import SimulatedBlock, simulate_block
from tests.pipeline.known import write_block

pytestmark = pytest.mark.filterwarnings("ignore:.*constrained in height")
COUNT = 12  # four sites in a square, three views each


@pytest.fixture(scope="module")
def made() -> SimulatedBlock:
    return simulate_block(COUNT, 70 * COUNT, seed=3, size=(2000, 2000))


@pytest.fixture(scope="module")
def archive(made: SimulatedBlock, tmp_path_factory) -> Path:
    """The block's images, of noise, with their RPCs, and its tie points."""
    folder, rng = tmp_path_factory.mktemp("archive"), np.random.default_rng(0)
    noise = rng.integers(0, 255, (COUNT, 20, 20), dtype=np.uint8)
    write_block(folder, made.views, made.tracks, lambda number: np.tile(noise[number], (100, 100)))
    return folder


def run(folder: Path, names: Any, out: str, archive: Path, **given: Any) -> AdjustResult:
    paths = [folder / f"{name}.tif" for name in names]
    options = RunOptions(matches=(str(archive / "ties.npz"),), matches_only=True, **given)
    return adjust(paths, folder / out, options)


@pytest.fixture(scope="module")
def eleven(archive: Path, tmp_path_factory) -> Path:
    """A finished run of all but one, beside the images."""
    folder = tmp_path_factory.mktemp("eleven")
    shutil.copytree(archive, folder, dirs_exist_ok=True)
    run(folder, [f"view_{i:04d}" for i in range(COUNT) if i != 4], "first", archive)
    return folder


def sound(folder: Path) -> None:
    assert {one.now for one in prove(folder)} <= set(PASSED_STATES)


def test_an_image_alone_is_added_to_a_run(eleven: Path, archive: Path, made: SimulatedBlock, tmp_path: Path) -> None:
    """Its camera is written, those of the run are not, and what they should do is said."""
    before = {path: path.read_bytes() for path in (eleven / "first").rglob("*") if path.is_file()}
    found = run(eleven, ["view_0004"], "second", archive, add_to=str(eleven / "first"))
    assert [view.name for view in found.views] == ["view_0004"]
    assert sorted(path.name for path in (eleven / "second").glob("*.vrt")) == ["view_0004.vrt"]
    assert {path: path.read_bytes() for path in before} == before
    whole = adjust([archive / f"{v.name}.tif" for v in made.views], tmp_path / "whole", RunOptions(
        matches=(str(archive / "ties.npz"),), matches_only=True))  # fmt: skip
    for pair in found.record.pairs:
        offset = pair.epipolar_after
        assert abs(offset.median) < 0.02 + 5.0 * offset.spread / np.sqrt(offset.count)
    said = "\n".join(found.summary["verdict"])
    assert "1 image added to the 11 images of first" in said
    assert "The cameras of first were held as they are written" in said
    assert found.summary["next"][0]["text"].startswith("Use view_0004.vrt")
    assert "clouds" not in said
    assert found.summary["status"] == whole.summary["status"]
    sound(eleven / "first")
    sound(eleven / "second")


def test_what_moves_is_written_where_that_is_asked_for(eleven: Path, archive: Path, made: SimulatedBlock) -> None:
    found = run(eleven, ["view_0004"], "updated", archive, add_to=str(eleven / "first"), update=True)
    block, before = (BlockPrior.load(eleven / one / "tables/block.npz") for one in ("updated", "first"))
    assert set(before.names) < set(block.names)
    assert "their new cameras are written here" in "\n".join(found.summary["verdict"])
    assert found.summary["next"][0]["text"].startswith("Use")
    written = {path.stem for path in (eleven / "updated").glob("*.vrt")}
    said = next(line for line in found.summary["verdict"] if "change by more" in line)
    assert {"view_0004", *(name for name in before.names if name in said)} <= written
    named = re.findall(r"(view_\d+) \(([\d.]+) px\)", said)
    assert named
    for name, px in named:  # where the block has them, not where they were
        view = made.views[int(name[-4:])]
        ground = view.sensor.localize(np.array([[1000.0, 1000.0]]), np.full(1, 300.0))
        there, was = (read_rpc(eleven / one / f"{name}.vrt").project(ground) for one in ("updated", "first"))
        assert np.linalg.norm(there - was) == pytest.approx(float(px), rel=0.2, abs=0.01)
    sound(eleven / "updated")


NONE_MET = "meets", "too few", "no tie point", "opened", "groups"
"""Words of causes: the new image shares tie points with none of those that can be opened."""


def refused(work: Callable[[], object], *words: str) -> bool:
    """Whether some work was refused, for one of these causes."""
    try:
        work()
    except BarpcError as error:
        if any(word in str(error) for word in words):
            return True
        raise
    return False


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(50))
def test_a_chain_of_runs_refuses_nothing_without_cause_and_says_nothing_false(
    seed: int, archive: Path, tmp_path: Path
) -> None:
    """Images added by one and two; old ones renamed, lost and given again; and the chain is as it was written."""
    rng = np.random.default_rng(seed)
    shutil.copytree(archive, tmp_path, dirs_exist_ok=True)
    order = [f"view_{i:04d}" for i in rng.permutation(COUNT)]
    have, rest, last = order[:6], order[6:], ""
    if refused(lambda: run(tmp_path, have, "run0", archive), "groups", "too few"):  # they do not hang together
        return
    last, lost, renamed = "run0", dict[str, bytes](), dict[str, str]()
    for step in range(1, 20):
        if not rest:
            break
        what = rng.choice(["add", "add", "add two", "rename", "lose", "again"])
        known = [name for name in have if name not in lost and name not in renamed]
        if what == "rename" and known:
            name = str(rng.choice(known))
            (tmp_path / f"{name}.tif").rename(tmp_path / f"other_{name}.tif")
            renamed[name] = f"other_{name}"
        elif what == "lose" and len(known) > 3:
            name = str(rng.choice(known))
            lost[name] = (tmp_path / f"{name}.tif").read_bytes()
            (tmp_path / f"{name}.tif").unlink()
        elif what == "again":
            for name, data in lost.items():
                (tmp_path / f"{name}.tif").write_bytes(data)
            for name, other in renamed.items():
                (tmp_path / f"{other}.tif").rename(tmp_path / f"{name}.tif")
            lost, renamed = {}, {}
            with pytest.raises(InputError, match="there is none to add"):
                run(tmp_path, [str(rng.choice(have))], "none", archive, add_to=str(tmp_path / last))
            assert not (tmp_path / "none").exists()
        else:
            new = [rest.pop() for _ in range(min(len(rest), 1 + (what == "add two")))]
            out = f"run{step}"
            names, to = [*new, *renamed.values()], str(tmp_path / last)
            if refused(lambda: run(tmp_path, names, out, archive, add_to=to), *NONE_MET):  # noqa: B023
                assert not (tmp_path / out / "summary.json").exists()
                continue
            said = " ".join(json.loads((tmp_path / out / "summary.json").read_text())["verdict"])
            assert "clouds" not in said
            assert f"added to the {len(have)} images of {last}" in said
            have, last = [*have, *new], out
            block = BlockPrior.load(tmp_path / out / "tables/block.npz")
            assert set(block.names) == set(have)
    for folder in tmp_path.glob("run*"):
        wrong = [one for one in prove(folder) if one.now not in PASSED_STATES]  # images that were lost or renamed since
        unlike = [one for one in wrong if (one.kind, one.now) != ("input", "missing") or not one.file.endswith(".tif")]
        assert not unlike


BAD = {
    "no folder": (lambda run: shutil.rmtree(run), "no summary.json, so no finished run"),
    "unfinished": (lambda run: (run / "summary.json").unlink(), "summary.json: is gone since the run wrote it"),
    "without its block": (lambda run: (run / "tables/block.npz").unlink(), "block.npz: is gone since"),
    "of another release": (lambda run: (run / "tables/images.json").unlink(), "images.json: is gone since"),
    "an edited list": (
        lambda run: (run / "tables/images.json").write_text('{"images": []}'), "images.json: was changed since"
    ),
    "an edited block": (lambda run: (run / "tables/block.npz").write_bytes(b"x"), "block.npz: was changed since"),
    "no sums": (lambda run: (run / "SHA256SUMS").unlink(), "SHA256SUMS: missing"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_run_that_cannot_be_gone_on_from_is_refused_in_a_line(
    case: str, eleven: Path, archive: Path, tmp_path
) -> None:
    shutil.copytree(eleven / "first", tmp_path / "first")
    damage, message = BAD[case]
    damage(tmp_path / "first")
    with pytest.raises(InputError, match=message) as error:
        run(eleven, ["view_0004"], str(tmp_path / "out"), archive, add_to=str(tmp_path / "first"))
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_an_image_that_was_changed_since_is_refused(eleven: Path, archive: Path, tmp_path: Path) -> None:
    shutil.copytree(eleven, tmp_path / "all")
    (tmp_path / "all/first/.barpc/state.json").unlink()  # where it was made, the images are as they were
    for name in ("view_0003", "view_0005"):
        shutil.copy(tmp_path / "all/view_0000.tif", tmp_path / f"all/{name}.tif")
    with pytest.raises(InputError, match=r"is not the file that .*first was made of"):
        run(tmp_path / "all", ["view_0004"], "out", archive, add_to=str(tmp_path / "all/first"))
    assert not (tmp_path / "all/out/summary.json").exists()


def test_an_image_that_meets_none_is_refused(eleven: Path, archive: Path, tmp_path: Path) -> None:
    shutil.copy(eleven / "view_0004.tif", tmp_path / "far.tif")
    rpc = read_rpc(eleven / "view_0004.tif")
    put_tag(tmp_path / "far.tif", replace(rpc, ground_offset=rpc.ground_offset + [3.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="none of its images meets the images given"):
        adjust([tmp_path / "far.tif"], tmp_path / "out", RunOptions(add_to=str(eleven / "first")))
    assert not (tmp_path / "out").exists()


def test_images_that_are_tied_to_each_other_only_are_refused(
    eleven: Path, made: SimulatedBlock, tmp_path: Path
) -> None:
    names, own = ["view_0004", "fresh"], made.tracks.view == 4
    shutil.copy(eleven / "view_0004.tif", tmp_path / "fresh.tif")
    with rasterio.open(tmp_path / "fresh.tif", "r+") as image:
        image.write(image.read()[:, ::-1, ::-1])  # what another image shows, or it were a band of this one
    rpc = read_rpc(eleven / "view_0004.tif")
    put_tag(tmp_path / "fresh.tif", replace(rpc, image_offset=rpc.image_offset + 1.0))
    xy, point = made.tracks.xy[own], np.arange(own.sum())
    both = Tracks(np.repeat([0, 1], len(xy)), np.tile(point, 2), np.vstack([xy, xy + 1.0]), np.full(2 * len(xy), 0.3))
    write_matches(tmp_path / "ties.npz", both, names)
    options = RunOptions(matches=(str(tmp_path / "ties.npz"),), matches_only=True, add_to=str(eleven / "first"))
    with pytest.raises(BarpcError, match=r"no tie point of the images given is seen in one of .*first"):
        adjust([eleven / "view_0004.tif", tmp_path / "fresh.tif", eleven / "view_0003.tif"], tmp_path / "out", options)


def test_a_list_of_images_is_the_whole_blocks(eleven: Path, archive: Path) -> None:
    run(eleven, ["view_0004"], "listed", archive, add_to=str(eleven / "first"))
    rows = json.loads((eleven / "listed/tables/images.json").read_text())["images"]
    assert [row["name"] for row in rows] == list(BlockPrior.load(eleven / "listed/tables/block.npz").names)
    assert all((eleven / "listed" / row["path"]).resolve() == eleven / f"{row['name']}.tif" for row in rows)


def test_old_images_that_are_given_are_written_and_no_flag_is_asked_for(eleven: Path, archive: Path) -> None:
    every = [f"view_{i:04d}" for i in range(COUNT)]
    found = run(eleven, every, "given", archive, add_to=str(eleven / "first"))
    said = "\n".join(found.summary["verdict"])
    left = set(every) - {path.stem for path in (eleven / "given").glob("*.vrt")}  # that meet none: they stay
    assert "The cameras of first were held as they are written" in said
    assert "view_0004" not in left
    for name in set(every) - left - {"view_0004"}:
        ground = read_rpc(eleven / f"{name}.tif").localize(np.array([[0.0, 0.0], [1999.0, 1999.0]]), np.full(2, 300.0))
        one, other = (read_rpc(eleven / run / f"{name}.vrt").project(ground) for run in ("given", "first"))
        np.testing.assert_allclose(one, other, atol=1e-4)
