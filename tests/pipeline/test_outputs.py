"""The writing gate: no file of a run counts as written unless what reads it sees the camera that was meant."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio

from barpc.base.errors import OutputError
from barpc.base.options import RunOptions
from barpc.fit import FitOptions, RpcFit, fit_rpc
from barpc.pipeline import outputs, verify_outputs
from barpc.pipeline.inputs import PRIOR_FILE
from barpc.pipeline.outputs import file_names, output_names, refuse_shadows, verify_files, write_views
from barpc.pipeline.verify_outputs import CONSUMERS, Consumer, Reading, verify
from barpc.report.page import can_render
from barpc.report.summary import OutputEntry
from barpc.report.tables import TABLES
from barpc.rpcio import read_rpc, write_rpc
from barpc.scene import View
from barpc.sensor.sampler import Sample
from barpc.workspace import Workspace
from tests.rpcio.conftest import make_rpc, write_image

SIZE, ALTITUDES = (2000, 1900), (30.0, 300.0)
ALL = ("txt", "rpb", "geom", "json", "xml")


@pytest.fixture(scope="module")
def fit() -> RpcFit:
    return fit_rpc(make_rpc(), SIZE, ALTITUDES, options=FitOptions(grid=(6, 6, 4)))


def write_view(
    run: Workspace, view: View, fit: RpcFit, model: Any, images: str, formats: Sequence[str]
) -> dict[str, dict[str, float | str]]:
    return write_views(run, [(view, fit, model)], images, formats)[0]


@dataclass(frozen=True)
class Said:
    of: str
    outputs: tuple[OutputEntry, ...] = ()
    empty: tuple[int, ...] = ()
    deep: dict[str, list[int]] | None = None


@pytest.fixture
def view(tmp_path: Path) -> View:
    path = write_image(tmp_path / "scene.tif", (1, SIZE[1], SIZE[0]), dtype="uint8")
    return View("scene", str(path), SIZE, make_rpc(), ALTITUDES)


@pytest.mark.parametrize("images", ["vrt", "copy", "none"])
def test_every_format_is_written_under_its_name_and_read_back(tmp_path, view, fit, images) -> None:
    with Workspace(tmp_path / "out") as run:
        written = write_view(run, view, fit, make_rpc(), images, ALL)
    carrier = {"vrt": ["scene.vrt"], "copy": ["scene.tif"], "none": []}[images]
    texts = ["scene_RPC.TXT", "scene.RPB", "scene.geom", "scene.rpc.json", "scene.rpc.xml"]
    assert list(written) == carrier + texts == file_names(view, images, ALL)
    for name, readings in written.items():
        assert read_rpc(tmp_path / "out" / name) == fit.rpc
        assert readings["barpc"] < 1e-5, name
        assert {type(value) for value in readings.values()} <= {float, str}


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="the names of open files are not to be had")
def test_every_file_is_put_on_the_disk_once_and_its_note_before_it(tmp_path, view, fit, monkeypatch) -> None:
    seen, sync = [], os.fsync

    def recorded(descriptor: int) -> None:
        seen.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        sync(descriptor)

    with Workspace(tmp_path / "out") as run:
        monkeypatch.setattr(os, "fsync", recorded)
        write_view(run, view, fit, make_rpc(), "vrt", ("txt",))
    mine = [name for name in seen if name.startswith(("scene", "outputs"))]
    assert mine == ["outputs.jsonl", "scene.vrt", "outputs.jsonl", "scene_RPC.TXT"]
    # the folder after every file, or a name could be lost
    assert [seen[seen.index(name) + 1] for name in ("scene.vrt", "scene_RPC.TXT")] == ["out", "out"]


@pytest.mark.parametrize("images", ["vrt", "none"])
@pytest.mark.parametrize(
    ("largest", "off", "fine"),
    [((0.3, 0.4), 1.000018, True), ((0.3, 0.4), 1.000022, False), ((0.0, 0.0), 1.8e-5, True),
     ((0.0, 0.0), 2.2e-5, False)],
)  # fmt: skip
def test_a_reading_may_be_off_by_twice_the_fit_s_largest_error(tmp_path, view, fit, images, largest, off, fine) -> None:
    """And by twice what printing leaves."""
    loose = replace(fit, max_ckp=np.array(largest))
    said = r"scene(\.vrt|_RPC\.TXT): barpc reads it with an error of \S+ px \(\); is the disk full"
    with nullcontext() if fine else pytest.raises(OutputError, match=said), Workspace(tmp_path / "a") as run:
        written = write_view(run, view, loose, make_rpc().crop(-off, 0.0), images, ("txt",))
        assert written["scene_RPC.TXT"]["barpc"] == pytest.approx(off, abs=1e-6)


def test_a_file_that_cannot_be_read_back_ends_the_run(tmp_path, view, fit) -> None:
    path, sample = tmp_path / "scene_RPC.TXT", Sample.grid(make_rpc(), view.size, view.alt_range)
    write_rpc(fit.rpc, path)
    assert verify_files([str(path)], fit, sample)[path.name]["barpc"] < 1e-5
    path.write_text(path.read_text()[:400])
    with pytest.raises(OutputError, match="barpc reads it with an error of nan px"):
        verify_files([str(path)], fit, sample)


@pytest.mark.parametrize(
    ("consumer", "ends"),
    [("barpc", True), ("gdal", True), ("gdal, beside an image", True), ("other", False)],
)
def test_only_what_the_tool_itself_and_gdal_say_ends_the_run(tmp_path, view, fit, monkeypatch, consumer, ends) -> None:
    def says(paths, *_):
        names = dict.fromkeys(("barpc", "gdal", "other", consumer))
        return [Reading(Path(path), name, 9.0 if name == consumer else 0.0) for path in paths for name in names]

    monkeypatch.setattr(outputs, "verify", says)
    with Workspace(tmp_path / "out") as run:
        if ends:
            with pytest.raises(OutputError, match=f"{consumer} reads it with an error of 9 px"):
                write_view(run, view, fit, make_rpc(), "none", ("txt",))
        else:
            written = write_view(run, view, fit, make_rpc(), "none", ("txt",))
            assert written == {"scene_RPC.TXT": {"barpc": 0.0, "gdal": 0.0, "other": 9.0}}


def test_a_reading_passes_up_to_a_millionth_of_a_pixel() -> None:
    assert Reading(Path("a"), "x", 1e-6).passed
    assert not Reading(Path("a"), "x", 1.01e-6).passed
    assert not Reading(Path("a"), "x", float("nan")).passed


def test_the_grid_spans_the_image_and_its_altitudes() -> None:
    rpc = make_rpc()
    sample = Sample.grid(rpc, SIZE, ALTITUDES)
    assert len(sample.ground) == 11 * 11 * 5
    np.testing.assert_allclose(sample.image.min(axis=0), [0, 0], atol=1e-6)
    np.testing.assert_allclose(sample.image.max(axis=0), [1999, 1899], atol=1e-6)
    assert sorted(set(sample.ground[:, 2])) == [30.0, 97.5, 165.0, 232.5, 300.0]
    assert sample.compare(rpc.project) < 1e-9
    assert sample.compare(rpc.crop(3.0, 4.0).project) == pytest.approx(5.0, abs=1e-9)


class Blind:
    """Sees no ground but in its first columns."""

    def __init__(self, columns: float) -> None:
        self.rpc, self.columns = make_rpc(), columns

    def project(self, ground):
        return self.rpc.project(ground)

    def localize(self, image, alt):
        ground = self.rpc.localize(image, alt)
        return np.where(np.asarray(image)[:, :1] <= self.columns, ground, np.nan)


def test_points_that_a_model_does_not_see_are_left_out_and_none_at_all_is_an_error(tmp_path) -> None:
    assert len(Sample.grid(Blind(1000.0), SIZE, ALTITUDES).ground) == 6 * 11 * 5
    write_rpc(make_rpc(), tmp_path / "a_RPC.TXT")
    assert verify([tmp_path / "a_RPC.TXT"], Sample.grid(Blind(1000.0), SIZE, ALTITUDES))[-1].passed
    with pytest.raises(OutputError, match="no ground point"):
        verify([tmp_path / "a_RPC.TXT"], Sample.grid(Blind(-1.0), SIZE, ALTITUDES))


def test_the_largest_error_of_all_points_is_what_counts(tmp_path, monkeypatch) -> None:
    rpc = make_rpc()

    def one_corner(path):
        def project(ground):
            image = rpc.project(ground)
            image[7] += [3.0, 4.0]
            return image

        return project

    def no_number(path):
        return lambda ground: np.full((len(ground), 2), np.nan)

    consumers = {
        "corner": Consumer("numpy", one_corner),
        "nan": Consumer("numpy", no_number),
        "absent": Consumer("no_such_package", no_number),
        "barpc": CONSUMERS["barpc"],
    }
    monkeypatch.setattr(verify_outputs, "_consumers", lambda path: consumers)
    write_rpc(rpc, tmp_path / "A_RPC.TXT")
    corner, nan, own = verify([tmp_path / "A_RPC.TXT"], Sample.grid(rpc, SIZE, ALTITUDES))
    assert own.passed
    assert (corner.consumer, corner.note) == ("corner", "")
    assert corner.max_error == pytest.approx(5.0)
    assert not nan.passed
    assert nan.note == "it projects to no finite point"


def test_an_rpc_across_the_antimeridian_is_read_where_it_is(tmp_path) -> None:
    rpc = make_rpc(lon=179.9999)
    write_rpc(rpc, tmp_path / "a.geom")
    for reading in verify([tmp_path / "a.geom"], Sample.grid(rpc, SIZE, ALTITUDES)):
        if reading.consumer == "shareloc":
            assert np.isnan(reading.max_error)
            assert "shareloc takes no longitude beyond 180 degrees" in reading.note
        else:
            assert reading.passed, reading


@pytest.mark.parametrize(
    ("old", "new"),
    [("polynomial_format:  B", "polynomial_format:  A"), ("ossimRpcModel", "ossimRpcProjection")],
)
def test_a_keyword_list_of_another_kind_is_not_read(tmp_path, old, new) -> None:
    path = tmp_path / "a.geom"
    write_rpc(make_rpc(), path)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    (keywords,) = (r for r in verify([path], Sample.grid(make_rpc(), SIZE, ALTITUDES)) if r.consumer == "keywords")
    assert not keywords.passed
    assert "not one of OSSIM's" in keywords.note


@pytest.mark.parametrize(
    ("beside", "images", "refused"),
    [
        ("scene.geom", "copy", True), ("scene.geom", "vrt", True), ("scene.RPB", "copy", True),
        ("scene.RPB", "vrt", False), ("scene_RPC.TXT", "copy", True), ("scene.geom", "none", False),
    ],
)  # fmt: skip
def test_a_foreign_file_that_would_be_read_first_is_refused(tmp_path, view, beside, images, refused) -> None:
    write_rpc(make_rpc(), tmp_path / beside)
    names = file_names(view, images, ())
    if refused:
        with pytest.raises(OutputError, match=f"{beside}: lies beside"):
            refuse_shadows(tmp_path, names)
    else:
        refuse_shadows(tmp_path, names)
    refuse_shadows(tmp_path, [*names, beside])  # written by this run itself
    refuse_shadows(tmp_path / "not yet", names)


def test_the_outputs_of_a_run_are_known_before_it_starts(tmp_path, view) -> None:
    other = replace(view, name="b__c")
    (tmp_path / "asp").mkdir()
    for name in ("scene__b__c.txt", "b__c__scene.txt", "scene__x.txt", "scene_b__c.txt", "scene.txt"):
        (tmp_path / "asp" / name).touch()
    names = {
        stop: output_names([view, other], RunOptions(stop_after=stop, rpc_formats=("rpb",)), tmp_path)
        for stop in ("matching", "adjustment", "all")
    }
    prior, common = (
        f"tables/{PRIOR_FILE}",
        [*(f"tables/{name}" for name in (*TABLES, "pictures.json")), "map.gpkg", "summary.json", "SHA256SUMS"]
        + ["report.html"] * can_render(),
    )
    pairs, known = ["asp/b__c__scene.txt", "asp/scene__b__c.txt"], "tables/images.json"
    assert sorted(names["matching"]) == sorted([*common, "matches.csv", "matches.npz", *pairs])
    assert sorted(names["adjustment"]) == sorted([*common, known, prior])
    ends = [".vrt", ".RPB", "_grid.tif", "_correction.tif"]  # grids where an RPC turns out not to do
    files = [name + end for name in ("scene", "b__c") for end in ends]
    assert sorted(names["all"]) == sorted([*common, *files, known, prior])
    assert sorted(output_names([view], RunOptions(stop_after="matching"), tmp_path / "new")) == sorted(
        [*common, "matches.csv", "matches.npz"]
    )


@pytest.mark.parametrize("page", [True, False])
def test_a_folder_with_a_summary_is_complete(tmp_path, monkeypatch, page: bool) -> None:
    """Tables, the page where it can be drawn, and the summary, in this order."""
    written = []
    monkeypatch.setattr(outputs, "TABLES", {"a.csv": lambda run, summary: [b"1"], "b.csv": lambda run, summary: [b"2"]})
    monkeypatch.setattr(outputs, "map_layers", lambda run, summary: [])
    monkeypatch.setattr(outputs, "can_render", lambda: page)
    monkeypatch.setattr(outputs, "report_html", lambda summary, folder: f"<p>{summary.of} in {folder.name}</p>")
    for method in ("write_text", "output"):
        real = getattr(Workspace, method)
        watched = lambda self, name, *given, real=real: (written.append(name), real(self, name, *given))[1]  # noqa: E731
        monkeypatch.setattr(Workspace, method, watched)
    with Workspace(tmp_path / "out") as run:
        plain = SimpleNamespace(reference=None, options=RunOptions())
        told = outputs.write_tables(run, plain, Said("what was found", deep={"a": [1, 2]}))  # type: ignore[arg-type]
    names = ["tables/a.csv", "tables/b.csv", "map.gpkg", *(["report.html"] if page else []), "summary.json"]
    assert list(dict.fromkeys(written)) == names
    folder = tmp_path / "out"
    assert [(folder / name).read_bytes() for name in names[:2]] == [b"1", b"2"]
    assert (folder / "map.gpkg").read_bytes().startswith(b"SQLite format 3")
    if page:
        assert (folder / "report.html").read_text() == "<p>what was found in out</p>"
    sums = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in sorted(names[:3])}
    rows = [f'{{"file": "{name}", "sha256": "{found}"}}' for name, found in sums.items()]
    assert (folder / "summary.json").read_text().splitlines() == [  # an item of a list a line
        "{", '"of": "what was found",', '"outputs": [', *(f"{row}," for row in rows[:2]), rows[2], "],", '"empty": [],',
        '"deep": {"a": [1, 2]}', "}",
    ]  # fmt: skip
    assert told.of == "what was found"
    assert [stage["stage"] for stage in run.stages] == ["tables", "report"]
    assert (folder / "summary.json").read_text().endswith("\n")


# --- its parts ---------------------------------------------------------------------------------------------


def test_what_ends_the_work_before_any_file_is_said_itself(tmp_path, view, fit) -> None:
    with Workspace(tmp_path / "out") as run, pytest.raises(KeyError, match="no format"):
        write_view(run, view, fit, make_rpc(), "none", ("no format",))


@pytest.mark.parametrize(
    ("stem", "pair"),
    [
        ("a__b", True), ("b__a", True), ("a__a", True), ("a__b__c", True), ("b__c__a", True), ("b__c__b__c", True),
        ("a", False), ("b__c", False), ("a__x", False), ("x__a", False), ("a_b", False), ("a__b__x", False),
        ("a____b", False), ("", False), ("__", False), ("a__", False),
    ],
)  # fmt: skip
def test_a_pair_is_two_names_of_views(stem, pair, tmp_path) -> None:
    """Only its matches in the folder are outputs that a run may replace."""
    (tmp_path / "asp").mkdir()
    (tmp_path / "asp" / f"{stem}.txt").touch()
    known: Any = [SimpleNamespace(name=name) for name in ("a", "b", "b__c")]
    names = outputs.output_names(known, RunOptions(stop_after="matching"), tmp_path)
    assert (f"asp/{stem}.txt" in names) == pair


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(28, "No space left on device"), r"out/scene_RPC\.TXT: cannot be written \(No space left on device\)"),
        (OutputError("it says itself"), "^it says itself$"), (OSError("of no number"), "^of no number$"),
    ],
)  # fmt: skip
def test_why_a_file_cannot_be_written_is_said_with_its_own_place(tmp_path, view, monkeypatch, error, said) -> None:
    def write(*given, **how):
        raise error

    monkeypatch.setattr(outputs, "write_camera", write)
    with pytest.raises(type(error) if error.errno is None else OutputError, match=said) as caught:
        outputs.make_files(view, make_rpc(), "none", ("txt",), str(tmp_path / "out"), str(tmp_path / "room"))
    assert (caught.value is error) == (error.errno is None)


def test_files_are_made_in_a_room_of_their_view_for_their_place(tmp_path, view) -> None:
    """Also where an earlier try left some of them; a VRT names its image from where it will lie."""
    out, room = tmp_path / "deep/out", tmp_path / "r"
    for _ in range(2):
        made = outputs.make_files(view, make_rpc(), "vrt", ("txt",), str(out), str(room))
        assert made == ("scene.vrt", "scene_RPC.TXT")
        assert {path.name for path in (room / "scene").iterdir()} == set(made)
        assert not out.exists()
    out.parent.mkdir()
    (room / "scene").rename(out)
    for name in made:
        assert read_rpc(out / name) == make_rpc()
    with rasterio.open(out / "scene.vrt") as vrt:
        assert (vrt.width, vrt.height) == view.size
        assert [Path(name).resolve() for name in vrt.files[1:]] == [Path(view.path)]
    (file := tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"deep/out/scene\.vrt: cannot be written \(Not a directory\)"):
        outputs.make_files(view, make_rpc(), "vrt", ("txt",), str(out), str(file))


@pytest.mark.parametrize(
    ("reference", "control", "adjusted", "written"),
    [
        (False, False, True, False),
        (True, False, True, False),
        (True, True, False, False),
        (True, True, True, True),
    ],
)
def test_points_of_a_reference_are_written_where_it_held_the_block(
    tmp_path, monkeypatch, reference, control, adjusted, written
) -> None:
    monkeypatch.setattr(outputs, "TABLES", {})
    monkeypatch.setattr(outputs, "map_layers", lambda run, summary: [])
    monkeypatch.setattr(outputs, "can_render", lambda: False)
    monkeypatch.setattr(outputs, "gcps_geojson", lambda run: b"points")
    held = SimpleNamespace(control=object() if control else None) if reference else None
    run = SimpleNamespace(reference=held, adjustment=object() if adjusted else None, options=None)
    with Workspace(tmp_path / "out") as workspace:
        outputs.write_tables(workspace, run, Said("x"))  # type: ignore[arg-type]
    assert (tmp_path / "out/tables/gcps.geojson").exists() == written
