"""Whether a run is what it was, finding by finding; the command around it: tests/cli/test_verify.py."""

from __future__ import annotations

import json
import os
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.base.manifest import Layer, render
from barpc.pipeline import proof
from barpc.pipeline.grid_outputs import REOPENED
from barpc.pipeline.proof import ADDED, CHANGED, LATER, MISSING, MOVED, NOT_ASKED, PASSED_STATES, SAME, Proved
from barpc.rpcio import write_rpc
from barpc.rpcio.formats import CORRECTION, GRID_SUFFIX
from tests.rpcio.conftest import make_rpc

POINTS = [[5.4, 43.2, alt] for alt in (60.0, 120.0, 250.0)]


def noted(path: Path) -> Any:
    return SimpleNamespace(path=str(path), bytes=path.stat().st_size, sha256=sha256(path.read_bytes()).hexdigest())


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """What a summary says; its folder is `out`, which has no other file."""
    summary = SimpleNamespace(inputs=[], views=[])
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "summary.json").touch()
    listed(tmp_path / "out")
    monkeypatch.setattr(proof, "read_summary", lambda folder: summary)
    return summary


def listed(folder: Path, *later: dict[str, bytes]) -> str:
    """SHA256SUMS of the files of a folder, and of later contents; its root."""
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "SHA256SUMS"}
    layers: list[Layer] = []
    for part in (files, *later):
        after = f", after {sha256(render(layers).encode()).hexdigest()}" if layers else ""
        hashes = {name: sha256(data).hexdigest() for name, data in part.items()}
        layers.append(Layer(f"barpc 0, code 0{after}", hashes))
    (folder / "SHA256SUMS").write_text(render(layers))
    return sha256(render(layers).encode()).hexdigest()


def prove(folder: Path, places: Any = (), expected: str | None = None) -> list[Proved]:
    """What is said of inputs and cameras; of outputs and the root, what is wrong or later."""
    found = proof.prove(folder, places, expected)
    return [one for one in found if one.kind in ("input", "camera") or one.now != SAME]


def test_the_words_are_those_of_the_page() -> None:
    assert (SAME, MOVED, LATER, NOT_ASKED) == ("same", "moved", "later", "not asked")
    assert (CHANGED, MISSING, ADDED) == ("changed", "missing", "added")
    assert PASSED_STATES == (SAME, MOVED, LATER, NOT_ASKED)
    assert Proved("input", "a", SAME).note == ""


def test_a_run_without_sums_is_refused_and_so_is_one_whose_sums_are_not_as_barpc_writes_them(told, tmp_path) -> None:
    sums = tmp_path / "out" / "SHA256SUMS"
    text = sums.read_bytes()
    for bad in (
        b"",
        text[:-1],
        text.replace(b"\n", b"\r\n"),
        text + b"\n",
        text + text[-79:],
        text[1:],
        b"\xff" + text,
    ):
        sums.write_bytes(bad)
        with pytest.raises(InputError, match="SHA256SUMS: changed"):
            prove(tmp_path / "out")
    for name in ("../x", "/x", "a\\b", "a/../../x"):
        sums.write_bytes(text.replace(b"summary.json", name.encode()))
        with pytest.raises(InputError, match="SHA256SUMS: changed"):
            prove(tmp_path / "out")
    sums.unlink()
    with pytest.raises(InputError, match=r"SHA256SUMS: missing: the run was interrupted, or"):
        prove(tmp_path / "out")


def test_an_input_is_looked_for_in_the_run_beside_it_and_where_one_says(told, tmp_path) -> None:
    (path := tmp_path / "in.tif").write_bytes(b"one")
    told.inputs = [noted(path)]
    assert prove(tmp_path / "out") == [Proved("input", str(path), SAME)]
    path.write_bytes(b"two")
    assert prove(tmp_path / "out") == [Proved("input", str(path), CHANGED)]
    for place in (tmp_path / "out", tmp_path / "elsewhere"):
        place.mkdir(exist_ok=True)
        (place / "in.tif").write_bytes(b"one")
        found = prove(tmp_path / "out", [tmp_path / "elsewhere"])[-1]  # in the run: nobody put it there, besides
        assert found == Proved("input", str(path), MOVED, f"it is {place / 'in.tif'}")
        (place / "in.tif").unlink()
    path.unlink()
    assert prove(tmp_path / "out") == [Proved("input", str(path), MISSING)]
    told.inputs = [SimpleNamespace(path=str(tmp_path / "old" / "in.tif"), bytes=3, sha256=sha256(b"one").hexdigest())]
    path.write_bytes(b"one")  # beside the run
    (found,) = prove(tmp_path / "out")
    assert (found.now, found.note) == (MOVED, f"it is {path}")


def test_an_input_on_another_host_is_not_asked(told, tmp_path) -> None:
    told.inputs = [SimpleNamespace(path="https://a.org/x.tif", sha256="0")]
    assert prove(tmp_path / "out") == [Proved("input", "https://a.org/x.tif", NOT_ASKED, "on another host")]


def test_an_output_is_the_same_changed_or_missing(told, tmp_path) -> None:
    (path := tmp_path / "out" / "a.csv").write_bytes(b"one")
    assert prove(tmp_path / "out") == [Proved("output", "a.csv", ADDED, "by nobody who noted it")]
    listed(tmp_path / "out")
    assert prove(tmp_path / "out") == []
    assert Proved("output", "a.csv", SAME) in proof.prove(tmp_path / "out")
    path.write_bytes(b"two")
    assert prove(tmp_path / "out") == [Proved("output", "a.csv", CHANGED)]
    path.unlink()
    assert prove(tmp_path / "out") == [Proved("output", "a.csv", MISSING)]
    path.mkdir()
    assert prove(tmp_path / "out") == [Proved("output", "a.csv", MISSING)]


def test_what_cannot_be_read_counts_as_missing(told, tmp_path, monkeypatch) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(path)

    monkeypatch.setattr(proof, "fingerprint", refuse)
    assert prove(tmp_path / "out") == [Proved("output", "summary.json", MISSING)]


# --- layers -----------------------------------------------------------------------------------------------


def test_a_root_is_that_of_any_layer_and_what_came_after_is_said(told, tmp_path) -> None:
    out = tmp_path / "out"
    (out / "report.html").write_bytes(b"first")
    first = listed(out)
    layers = ({"dsm.tif": b"surface", "report.html": b"second"}, {"report.html": b"third"})
    second, last = listed(out, layers[0]), listed(out, *layers)
    (out / "report.html").write_bytes(b"third")
    (out / "dsm.tif").write_bytes(b"surface")
    assert len({first, second, last}) == 3
    assert prove(out) == prove(out, (), last) == []
    again = Proved("root", "report.html", LATER, "made again after that root")
    assert prove(out, (), second) == [again]
    assert prove(out, (), first) == [Proved("root", "dsm.tif", LATER, "added after that root"), again]
    of = {expected: proof.prove(out, (), expected)[0] for expected in (None, first, second, last)}
    assert {one.now for one in of.values()} == {SAME}
    assert of[first].note == f"{first}, layer 1 of 3"
    assert of[second].note == f"{second}, layer 2 of 3"
    assert of[last].note == of[None].note == f"{last}, layer 3 of 3"
    for wrong in ("0" * 64, sha256(b"").hexdigest()):
        (one,) = prove(out, (), wrong)
        assert (one.kind, one.file, one.now) == ("root", "SHA256SUMS", CHANGED)
        assert one.note == f"its root is {last}, and none of its 3 layers has {wrong}"


def test_a_later_layer_vouches_for_no_other_result_of_the_run(told, tmp_path) -> None:
    """A result that is replaced, and a forged layer that lists it: the first layer says what it was."""
    (out := tmp_path / "out").joinpath("a_RPC.TXT").write_bytes(b"ours")
    first = listed(out)
    listed(out, {"a_RPC.TXT": b"theirs", "b": b"new"})
    out.joinpath("a_RPC.TXT").write_bytes(b"theirs")
    out.joinpath("b").write_bytes(b"new")
    for expected in (None, first):
        assert Proved("output", "a_RPC.TXT", CHANGED) in prove(out, (), expected)
    out.joinpath("a_RPC.TXT").write_bytes(b"ours")
    assert prove(out) == []


def test_earlier_layers_cannot_be_rewritten(told, tmp_path) -> None:
    (out := tmp_path / "out").joinpath("a").write_bytes(b"ours")
    first = listed(out)
    listed(out, {"b": b"new"})
    out.joinpath("b").write_bytes(b"new")
    sums = out / "SHA256SUMS"
    assert prove(out, (), first) == [Proved("root", "b", LATER, "added after that root")]
    out.joinpath("a").write_bytes(b"theirs")
    sums.write_text(sums.read_text().replace(sha256(b"ours").hexdigest(), sha256(b"theirs").hexdigest()))
    assert prove(out) == []  # all alike: the root alone can tell
    (one,) = prove(out, (), first)
    assert (one.file, one.now) == ("SHA256SUMS", CHANGED)


def test_the_root_that_was_noted_is_told_from_that_of_sums_that_were_changed(told, tmp_path) -> None:
    out, sums = tmp_path / "out", tmp_path / "out" / "SHA256SUMS"
    root = sha256(sums.read_bytes()).hexdigest()
    (out / ".barpc").mkdir()
    state = {"outputs": {"SHA256SUMS": root, "added": sha256(b"1").hexdigest(), "odd": 3}}
    (out / ".barpc/state.json").write_text(json.dumps(state))
    assert prove(out) == prove(out, (), root) == []
    (out / "added").write_bytes(b"1")
    ended = "by a command that did not come to its end: give it again"
    assert prove(out) == [Proved("output", "added", ADDED, ended)]
    (out / "added").unlink()
    sums.write_text(sums.read_text().replace("barpc 0,", "barpc 1,"))
    new = sha256(sums.read_bytes()).hexdigest()
    assert prove(out) == [Proved("root", "SHA256SUMS", CHANGED, f"its root is {new}, and {root} was noted")]
    assert prove(out, (), new) == []  # that root was kept elsewhere


# --- what lies in the folder ------------------------------------------------------------------------------


def test_links_pipes_and_folders_that_hide_files_are_found(told, tmp_path) -> None:
    out = tmp_path / "out"
    (out / "tables").mkdir()
    (elsewhere := tmp_path / "elsewhere").mkdir()
    (elsewhere / "x").write_bytes(b"")
    listed_by_hand = Layer("barpc 0, code 0", dict.fromkeys(("summary.json", "tables/a"), sha256(b"").hexdigest()))
    (out / "SHA256SUMS").write_text(render([listed_by_hand]))
    (out / "tables/a").symlink_to(elsewhere / "x")
    assert prove(out) == []  # of the same content: what a store of large files leaves
    (out / "tables/SHA256SUMS").touch()  # no folder of its own: the run's files are in it
    (out / "more").symlink_to(elsewhere, target_is_directory=True)
    os.mkfifo(out / "pipe")
    (out / ".BARPC").mkdir()
    (out / ".BARPC/x").touch()
    (out / "Summary.json").touch()
    (out / "empty").mkdir()
    (out / "deep/er").mkdir(parents=True)
    (out / "deep/er/SUMMARY.JSON").touch()
    (out / "deep/.barpc").mkdir()
    (out / "deep/.barpc/a_RPC.TXT").touch()
    (out / ".barpc").mkdir()
    (out / ".barpc/state.json").touch()  # not asked
    added = [".BARPC/x", "Summary.json", "deep/.barpc/a_RPC.TXT", "deep/er/SUMMARY.JSON", "more", "pipe"]
    added.append("tables/SHA256SUMS")
    assert sorted(one.file for one in prove(out) if one.now == ADDED) == added
    assert len(prove(out)) == len(added)


def test_a_state_that_is_a_link_is_no_state(told, tmp_path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out/.barpc").symlink_to(tmp_path / "elsewhere")
    assert prove(tmp_path / "out") == [Proved("output", ".barpc", ADDED, "by nobody who noted it")]


def test_a_folder_below_with_sums_is_named_and_not_asked(told, tmp_path) -> None:
    (export := tmp_path / "out/nerf").mkdir()
    (export / "a.json").touch()
    (found,) = prove(tmp_path / "out")
    assert (found.file, found.now) == ("nerf/a.json", ADDED)
    listed(export)
    assert prove(tmp_path / "out") == [Proved("output", "nerf", NOT_ASKED, f"not of this run: barpc verify {export}")]
    assert prove(export) == []
    (export / "a.json").write_bytes(b"1")
    assert prove(export) == [Proved("output", "a.json", CHANGED)]


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may read anywhere")
def test_a_folder_that_cannot_be_read_is_no_empty_one(told, tmp_path) -> None:
    (hidden := tmp_path / "out/hidden").mkdir()
    hidden.chmod(0)
    with pytest.raises(InputError, match="hidden: cannot be read"):
        prove(tmp_path / "out")


# --- cameras ----------------------------------------------------------------------------------------------


@pytest.fixture
def camera(told, tmp_path) -> Any:
    """A view with an RPC file and what it was certified to show."""
    rpc = make_rpc()
    write_rpc(rpc, tmp_path / "out" / "a_RPC.TXT")
    points = np.array(POINTS)
    view = SimpleNamespace(
        certified=np.hstack([points, rpc.project(points)]).tolist(), outputs={"a_RPC.TXT": {"barpc": 1e-9}}
    )
    told.views = [view]
    listed(tmp_path / "out")
    return view


def test_a_camera_that_reads_as_certified_is_the_same(camera, tmp_path) -> None:
    assert prove(tmp_path / "out") == [Proved("camera", "a_RPC.TXT", SAME)]


@pytest.mark.parametrize(("off", "now"), [(0.9, SAME), (1.2, CHANGED)])
def test_a_camera_may_be_off_by_what_is_stated_and_the_rounding_of_its_file(camera, tmp_path, off, now) -> None:
    camera.outputs["a_RPC.TXT"]["barpc"] = 0.3
    camera.certified[1][3] += off * (0.3 + REOPENED)
    (found,) = prove(tmp_path / "out")
    assert found.now == now
    if now == CHANGED:
        assert found.note == "differs from the certified camera by 0.36 px, 0.3 stated"


def test_one_point_that_is_off_is_enough_in_both_directions(camera, tmp_path) -> None:
    camera.certified[2][4] -= 5.0
    said = "differs from the certified camera by 5 px, 1e-09 stated"
    assert prove(tmp_path / "out") == [Proved("camera", "a_RPC.TXT", CHANGED, said)]


def test_a_camera_that_cannot_be_opened_says_why(camera, tmp_path) -> None:
    (tmp_path / "out" / "a_RPC.TXT").write_text("LINE_OFF: 1\n")
    _, found = prove(tmp_path / "out")
    assert (found.kind, found.now) == ("camera", CHANGED)
    assert "a_RPC.TXT" in found.note
    (tmp_path / "out" / "a_RPC.TXT").unlink()
    _, found = prove(tmp_path / "out")
    assert found.now == MISSING


@pytest.mark.parametrize(
    ("name", "stated", "certified"),
    [
        ("a_RPC.TXT", "no RPC", True),  # nobody read it then
        ("a_RPC.TXT", None, True),
        ("a_RPC.TXT", 1e-9, False),
        ("a.csv", 1e-9, True),
    ],
)
def test_what_holds_no_certified_camera_is_not_opened(camera, tmp_path, name, stated, certified) -> None:
    camera.outputs = {name: {} if stated is None else {"barpc": stated, "gdal": 0.0}}
    camera.certified = camera.certified if certified else []
    assert prove(tmp_path / "out") == []


@pytest.mark.parametrize(("end", "holds"), [(GRID_SUFFIX, 1), (CORRECTION, 1), ("_table.csv", 0), ("_RPC.TXT", 1)])
def test_a_grid_holds_the_camera_of_its_image_and_a_table_does_not(camera, tmp_path, end, holds) -> None:
    """What holds one is looked for."""
    camera.outputs = {f"view{end}": {"barpc": 1e-9}}
    assert [(one.kind, one.file) for one in prove(tmp_path / "out")] == [("camera", f"view{end}")] * holds
