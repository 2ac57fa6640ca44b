"""`barpc verify`: every file of a finished run is what it was, by one root, or is named."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import pytest

from barpc import adjust
from barpc.base import manifest
from barpc.base.options import RunOptions
from barpc.export.shots import read_scene
from barpc.pipeline import proof, remake
from barpc.pipeline.proof import PASSED_STATES, prove
from barpc.rpcio import read_rpc, write_rpc
from tests.reliability.conftest import barpc
from tests.reliability.trials import SAMPLES, crop
from tests.sealing import files, seal

SUMS = "SHA256SUMS"


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("verify")
    (folder / "in").mkdir()
    images = [crop(source, folder / "in" / source.name) for source in SAMPLES[:2]]
    adjust(images, folder / "out", RunOptions(grids=True, rpc_formats=("txt", "rpb")))
    return folder


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """A run whose inputs stayed where they were."""
    shutil.copytree(finished / "out", tmp_path / "out")
    return tmp_path / "out"


def findings(run: Path, *places: object) -> tuple[int, dict[tuple[str, str], str]]:
    said = barpc("verify", run, *places, "--json")
    rows = json.loads(said.out)
    return said.code, {(one["kind"], Path(one["file"]).name): one["now"] for one in rows}


def wrong(run: Path, root: str | None = None) -> set[tuple[str, str]]:
    """Files that are not what they were, and what became of them."""
    return {(one.file, one.now) for one in prove(run, (), root) if one.now not in PASSED_STATES}


def root_of(run: Path) -> str:
    return sha256((run / SUMS).read_bytes()).hexdigest()


@pytest.mark.slow
def test_a_run_that_nobody_touched_is_what_it_was(run) -> None:
    code, found = findings(run)
    assert code == 0
    assert set(found.values()) == {"same"}
    written = set(files(run)) - {SUMS}
    assert {name for kind, name in found if kind == "output"} == {Path(name).name for name in written}
    assert {name for kind, name in found if kind == "input"} >= {"view_00.tif", "view_01.tif"}
    cameras = {name for kind, name in found if kind == "camera"}
    assert {"view_00.vrt", "view_00_RPC.TXT", "view_00.RPB", "view_00_grid.tif"} <= cameras
    said = barpc("verify", run)
    assert said.err == ""
    assert f"outputs: {len(written)} same" in said.out
    assert f"root {SUMS}: same, {root_of(run)}, layer 1 of 1\n" in said.out


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="sha256sum is not installed")
def test_sha256sum_reads_what_the_run_lists_and_tells_its_root(run) -> None:
    def asked(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["sha256sum", *words], cwd=run, capture_output=True, text=True, check=False)

    told = asked("-c", "--strict", SUMS)
    assert told.returncode == 0, told
    assert len(told.stdout.splitlines()) == len(files(run)) - 1
    assert asked(SUMS).stdout.split()[0] == root_of(run)
    (run / "report.html").unlink()
    (run / "view_00.RPB").unlink()
    assert asked("-c", SUMS).returncode == 1


# --- any byte, any file -----------------------------------------------------------------------------------


def edits(data: bytes) -> dict[str, bytes]:
    """A file, changed: a bit at its beginning, in the middle and at its end; cut, emptied, lengthened."""
    flipped = {}
    for at in (0, len(data) // 2, len(data) - 1):
        flipped[f"bit of byte {at}"] = data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]
    return {**flipped, "cut": data[:-1], "empty": b"", "longer": data + b"\n"}


@pytest.fixture
def hashes_alone(monkeypatch) -> None:
    """No camera is compared with the certified one."""
    monkeypatch.setattr(proof, "_verify_cameras", lambda summary, folder: ())


def test_every_edit_of_every_file_is_named_and_so_is_its_absence(run, hashes_alone) -> None:
    root, names = root_of(run), files(run)
    assert len(names) > 20
    for name in names:
        path = run / name
        data, before = path.read_bytes(), path.stat()
        for how, changed in edits(data).items():
            path.write_bytes(changed)
            os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
            said = barpc("verify", run)
            assert said.code in ((1, 3) if name == SUMS else (3,)), (name, how)
            assert name in said.err, (name, how)
            assert barpc("verify", run, "--expect", root).code in (1, 3), (name, how)
        path.unlink()
        said = barpc("verify", run)
        assert (said.code, name in said.err) == (1 if name == SUMS else 3, True), name
        path.write_bytes(data)
    assert wrong(run, root) == set()


def test_every_consistent_edit_is_found_by_the_root_alone(run, hashes_alone) -> None:
    root = root_of(run)
    for name in set(files(run)) - {SUMS, "summary.json"}:
        data, sums = (run / name).read_bytes(), (run / SUMS).read_bytes()
        state = (run / ".barpc/state.json").read_bytes()
        (run / name).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        seal(run)
        assert wrong(run) == set(), name
        assert wrong(run, root) == {(SUMS, "changed")}, name
        for path, old in ((name, data), (SUMS, sums), (".barpc/state.json", state)):
            (run / path).write_bytes(old)
    assert wrong(run, root) == set()


BESIDE = ".RPB", ".XML", ".xml", "_rpc.txt", ".rpc", ".vrt.aux.xml", ".geom", ".vrt.RPB", "_RPB.TXT", "-RPC.txt", ".IMD"


@pytest.mark.parametrize("end", BESIDE)
def test_a_file_that_another_tool_would_read_first_is_named(run, end) -> None:
    for name in ("view_00", "view_01"):
        (run / f"{name}{end}").unlink(missing_ok=True)
    shutil.copy(run / "view_01_RPC.TXT", run / f"view_00{end}")
    found = wrong(run)
    now = "changed" if end == ".RPB" else "added"
    assert (f"view_00{end}", now) in found
    assert barpc("verify", run).code == 3
    # the same with a layer that lists it, as a later command would
    root, layers = root_of(run), manifest.read(run)[1]
    sha = sha256((run / f"view_00{end}").read_bytes()).hexdigest()
    layers.append(manifest.Layer(manifest.head("0", "0", root), {f"view_00{end}": sha}))
    (run / SUMS).write_text(manifest.render(layers))
    state = json.loads((run / ".barpc/state.json").read_text())
    (run / ".barpc/state.json").write_text(json.dumps({"folder": state["folder"]}))
    assert ((f"view_00{end}", now) in wrong(run, root)) == (end != ".IMD")  # which holds no RPC


def edited(run: Path, change: Callable[[dict], object]) -> None:
    """Edit the summary, which is valid afterwards."""
    summary = json.loads((run / "summary.json").read_text())
    change(summary)
    (run / "summary.json").write_text(json.dumps(summary))


def turned(run: Path) -> None:
    """Point a VRT at the other image, and give its hash."""
    path = run / "view_00.vrt"
    path.write_text(path.read_text().replace("view_00.tif", "view_01.tif"))
    sha = sha256(path.read_bytes()).hexdigest()
    edited(run, lambda s: [one.update(sha256=sha) for one in s["outputs"] if one["file"] == "view_00.vrt"])


FAULTS: dict[str, tuple[Callable[[Path], object], set[tuple[str, str]]]] = {
    "another report": (lambda run: (run / "report.html").write_text("All is well."), {("report.html", "changed")}),
    "no report": (lambda run: (run / "report.html").unlink(), {("report.html", "missing")}),
    "better figures": (
        lambda run: edited(run, lambda s: s["views"][0].update(rmse_after=1e-3)),
        {("summary.json", "changed")},
    ),
    "no certified camera": (
        lambda run: edited(run, lambda s: [view.update(certified=[]) for view in s["views"]]),
        {("summary.json", "changed")},
    ),
    "no outputs": (lambda run: edited(run, lambda s: s.update(outputs=[])), {("summary.json", "changed")}),
    "no inputs": (lambda run: edited(run, lambda s: s.update(inputs=[])), {("summary.json", "changed")}),
    "inputs elsewhere": (
        lambda run: edited(run, lambda s: [one.update(path="https://a.org/x.tif") for one in s["inputs"]]),
        {("summary.json", "changed")},
    ),
    "another image": (turned, {("summary.json", "changed"), ("view_00.vrt", "changed")}),
    "another folder": (lambda run: (run / "tables").rename(run / "Tables"), {("Tables/pairs.csv", "added")}),
    "no summary": (lambda run: (run / "summary.json").unlink(), {("summary.json", "missing")}),
    "a summary that is none": (lambda run: (run / "summary.json").write_text("{}"), {("summary.json", "changed")}),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_that_stays_within_what_a_summary_says_is_named(run, name) -> None:
    root, (fault, expected) = root_of(run), FAULTS[name]
    fault(run)
    assert expected <= wrong(run)
    assert barpc("verify", run).code == 3
    seal(run)  # with all hashes made right, the root that was printed tells
    assert barpc("verify", run, "--expect", root).code == 3


def test_line_ends_that_were_converted_are_named(run) -> None:
    ours = (run / SUMS).read_bytes()
    for name in files(run):
        if name.endswith((".csv", ".TXT", ".json", SUMS)):
            (run / name).write_bytes((run / name).read_bytes().replace(b"\n", b"\r\n"))
    said = barpc("verify", run)
    assert (said.code, said.out) == (1, "")
    assert f"{SUMS}: changed" in said.err
    assert "line ends" in said.err
    (run / SUMS).write_bytes(ours)
    assert {("tables/pairs.csv", "changed"), ("view_00_RPC.TXT", "changed")} <= wrong(run)


def test_an_output_that_was_changed_is_named(run) -> None:
    rpc = read_rpc(run / "view_01_RPC.TXT")
    write_rpc(rpc.crop(0.5, 0.0), run / "view_01_RPC.TXT", format="txt", overwrite=True)
    (run / "view_00.RPB").unlink()
    code, found = findings(run)
    assert code == 3
    assert {key: now for key, now in found.items() if now != "same"} == {
        ("output", "view_01_RPC.TXT"): "changed",
        ("camera", "view_01_RPC.TXT"): "changed",
        ("output", "view_00.RPB"): "missing",
        ("camera", "view_00.RPB"): "missing",
    }
    said = barpc("verify", run)
    assert "camera view_01_RPC.TXT: changed, differs from the certified camera by 0.5 px" in said.out
    assert "exit code 3" in said.err


# --- what later commands add ------------------------------------------------------------------------------


def test_a_report_that_is_made_again_is_the_same_file(run) -> None:
    root = root_of(run)
    (run / "report.html").unlink()
    assert findings(run)[0] == 3
    assert barpc("report", run).code == 0
    assert findings(run, "--expect", root)[0] == 0
    assert root_of(run) == root


@pytest.fixture
def of_release(monkeypatch) -> Callable[[str], None]:
    """Sets what a release makes of a report: what it is now, and a text."""
    page = remake.page_of
    return lambda text: monkeypatch.setattr(remake, "page_of", lambda files: page(files) + text)


def test_later_commands_add_layers_and_every_root_is_known(run, of_release) -> None:
    roots = [root_of(run)]
    for text in ("<!-- another release -->", "<!-- one more -->"):
        of_release(text)
        assert barpc("report", run).code == 0
        roots.append(root_of(run))
    assert barpc("convert", SAMPLES[2], "-o", run, "--rpc-format", "rpb").code == 0
    roots.append(root_of(run))
    assert len(set(roots)) == 4
    for number, root in enumerate(roots, start=1):
        said = barpc("verify", run, "--expect", root)
        assert said.code == 0, said
        assert f"same, {root}, layer {number} of 4" in said.out
        assert ("report.html: later, made again after that root" in said.out) == (number < 3)
        assert ("later, added after that root" in said.out) == (number < 4)
    head = (run / SUMS).read_text().splitlines()
    assert [line.partition(", after ")[2] for line in head if "code" in line] == ["", *roots[:3]]
    assert barpc("convert", SAMPLES[0], "-o", run, "--rpc-format", "rpb", "--overwrite").code == 0
    assert wrong(run, roots[0]) == {("view_00.vrt", "changed"), ("view_00.RPB", "changed")}  # results are the run's own
    (run / "report.html").write_text("theirs")
    assert {barpc("verify", run, "--expect", root).code for root in roots} == {3}


def test_a_later_command_hides_no_earlier_edit(run, of_release) -> None:
    root = root_of(run)
    (run / "view_00_RPC.TXT").write_bytes((run / "view_01_RPC.TXT").read_bytes())
    of_release("of another release")
    assert barpc("report", run).code == 0
    assert root_of(run) != root
    assert wrong(run) == wrong(run, root) == {("view_00_RPC.TXT", "changed")}
    sums = (run / SUMS).read_text().replace("# barpc 0", "# barpc 9", 1)
    (run / SUMS).write_text(sums)
    of_release("of one more")
    assert barpc("report", run).code == 1
    assert (run / SUMS).read_text() == sums  # changed by somebody: nothing is built on it
    assert (SUMS, "changed") in wrong(run)


def test_a_command_that_is_killed_before_its_layer_is_said_and_heals(run, of_release, monkeypatch) -> None:
    root, rename = root_of(run), Path.replace

    def killed(path: Path, target: Path) -> Path:
        if Path(target).name == SUMS:
            raise KeyboardInterrupt
        return rename(path, target)

    of_release("of another release")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed)
        assert barpc("report", run).code == 130
    assert root_of(run) == root
    said = barpc("verify", run)
    assert said.code == 3
    assert "output report.html: changed, by a command that did not come to its end: give it again" in said.out
    assert barpc("report", run).code == 0
    assert wrong(run, root) == set()


@pytest.mark.parametrize("target", ["satnerf --time 2020-06-01T10:30:00", "colmap --exact", "colmap --images"])
def test_an_export_has_a_root_of_its_own_that_names_the_run_s(run, tmp_path, target) -> None:
    root = root_of(run)
    for place in (tmp_path / "beside", run / "inside"):
        assert barpc("export", run, place, "--to", *target.split()).code == 0
        assert findings(run, "--expect", root) == findings(run)
        assert findings(run)[0] == 0
        assert f", after {root}\n" in (place / SUMS).read_text()
        own = root_of(place)
        assert wrong(place, own) == set()
        name = next(name for name in files(place) if name != SUMS and not (place / name).is_symlink())
        (place / name).write_bytes(b"other")
        assert (name, "changed") in wrong(place)
        settled_sums = manifest.read(place)[1]
        settled_sums[0].files[name] = sha256(b"other").hexdigest()
        (place / SUMS).write_text(manifest.render(settled_sums))
        assert (SUMS, "changed") in wrong(place, own)
    assert wrong(run) == {(f"inside/{SUMS}", "changed")}  # exports in the run are asked with it
    (run / "inside/mine.txt").touch()
    assert ("inside/mine.txt", "added") in wrong(run)
    (run / "inside" / SUMS).write_text("none")
    said = barpc("verify", run)
    assert (said.code, f"inside/{SUMS}: changed" in said.err) == (1, True)


# --- where it lies ----------------------------------------------------------------------------------------


def test_a_run_that_was_moved_or_copied_passes_and_a_whole_project_too(finished, run, tmp_path) -> None:
    root = root_of(run)
    run.rename(tmp_path / "Other name")
    assert findings(tmp_path / "Other name", "--expect", root)[0] == 0
    project = Path(shutil.copytree(finished, tmp_path / "disk" / "project"))
    shutil.rmtree(project / "out/.barpc")  # knows no place
    code, found = findings(project / "out", "--expect", root)
    assert code == 0
    assert set(found.values()) == {"same"}
    (project / "in").rename(project / "images")
    assert findings(project / "out")[0] == 3
    assert findings(project / "out", project / "images")[0] == 0
    (tmp_path / "link").symlink_to(project / "out")
    assert findings(tmp_path / "link", project / "images", "--expect", root.upper())[0] == 0


@pytest.mark.slow
def test_the_same_inputs_give_the_same_root_and_no_file_holds_time_or_place(finished, tmp_path, monkeypatch) -> None:
    """Another folder, seen from elsewhere, by other paths; a run that is gone on with; one that is made again."""
    shutil.copytree(finished / "in", tmp_path / "project/in")
    monkeypatch.chdir(tmp_path / "project/in")
    formats = ("--grids", "--rpc-format", "txt,rpb")
    said = barpc("adjust", "view_01.tif", "./view_00.tif", "-o", "../of another name", *formats)
    assert said.code == 0
    root = root_of(tmp_path / "project/of another name")
    assert root == root_of(finished / "out")
    assert root not in said.out
    assert root in barpc("verify", "../of another name").out
    assert barpc("adjust", ".", "-o", "../of another name", "--overwrite", *formats).code == 0
    assert root_of(tmp_path / "project/of another name") == root
    here = (str(tmp_path), str(finished), "seconds", "another name")
    for name in files(tmp_path / "project/of another name"):
        data = (tmp_path / "project/of another name" / name).read_bytes()
        assert not [word for word in here if word.encode() in data], name


def test_files_of_a_project_that_was_moved_are_found_from_any_folder(finished, tmp_path, monkeypatch) -> None:
    project = Path(shutil.copytree(finished, tmp_path / "elsewhere/project"))
    shutil.rmtree(project / "out/.barpc")
    monkeypatch.chdir(tmp_path)
    scene = read_scene(Path("elsewhere/project/out"))
    assert [shot.file for shot in scene.shots] == [str(project / "in" / f"view_0{k}.tif") for k in (0, 1)]
    shutil.copytree(finished / "out", tmp_path / "alone")  # knows where it was made
    files_of_both = [shot.file for shot in read_scene(Path("alone")).shots]
    assert files_of_both == [str(finished / "in" / f"view_0{k}.tif") for k in (0, 1)]


def test_paths_of_a_run_of_an_older_release_are_as_it_wrote_them(finished, run, monkeypatch) -> None:
    """Its images are absolute, its cameras' files as the command line had them."""
    images = [str(finished / "in" / f"view_0{k}.tif") for k in (0, 1)]

    def older(summary: dict) -> None:
        for view, image in zip(summary["views"], images, strict=True):
            view.update(path=image)
            view["rpc_source"].update(path=f"in/{Path(image).name}")

    edited(run, older)
    seal(run)
    shots = read_scene(run).shots
    assert [shot.file for shot in shots] == images


def test_what_is_no_root_is_wrong_usage(run) -> None:
    for given in ("", "1234", root_of(run)[:-1], root_of(run) + "0", "g" * 64):
        said = barpc("verify", run, "--expect", given)
        assert (said.code, said.out) == (2, "")
    said = barpc("verify", run, "--expect", "0" * 64)
    assert said.code == 3
    assert f"none of its 1 layers has {'0' * 64}" in said.out


def test_a_run_without_its_sums_is_one_line(run) -> None:
    (run / SUMS).unlink()
    said = barpc("verify", run)
    assert (said.code, said.out) == (1, "")
    assert len(said.err.splitlines()) == 1
    assert f"{run / SUMS}: missing" in said.err
    assert barpc("verify", run.parent / "nowhere").code == 1


def test_inputs_that_changed_are_told_from_those_that_moved(finished, run, tmp_path) -> None:
    summary = json.loads((run / "summary.json").read_text())
    archive = tmp_path / "archive"
    archive.mkdir()
    shutil.copy(finished / "in" / "view_00.tif", archive)
    (archive / "view_01.tif").write_bytes((finished / "in" / "view_01.tif").read_bytes()[:-1] + b"?")
    for one in summary["inputs"]:
        one["path"] = str(tmp_path / "gone" / Path(one["path"]).name)
    (run / "summary.json").write_text(json.dumps(summary))
    seal(run)
    code, found = findings(run)
    assert code == 3
    assert {now for (kind, _), now in found.items() if kind == "input"} == {"missing"}
    code, found = findings(run, archive)
    assert code == 3
    assert found["input", "view_00.tif"] == "moved"
    assert found["input", "view_01.tif"] == "missing"
    shutil.copy(finished / "in" / "view_01.tif", archive)
    assert findings(run, archive)[0] == 0
    (tmp_path / "gone").mkdir()
    shutil.copy(finished / "in" / "view_00.tif", tmp_path / "gone" / "view_01.tif")
    assert findings(run)[1]["input", "view_01.tif"] == "changed"
