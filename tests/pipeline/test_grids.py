"""Grids of a run: written where one RPC does not do, reopened, owned, told."""

from __future__ import annotations

import json
import logging
import re
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from barpc.base.errors import FitError, ImageError, OutputError
from barpc.base.options import RunOptions
from barpc.cameras import open_camera
from barpc.cli import cli
from barpc.fit import FitOptions, RpcFit, fit_rpc
from barpc.pipeline import adjust, check
from barpc.pipeline import grid_outputs as grids
from barpc.pipeline.grid_outputs import write_grids
from barpc.rpcio import read_rpc
from barpc.rpcio.formats import CORRECTION, GRID_SUFFIX
from barpc.rpcio.grids import read_correction, write_correction
from barpc.scene import View
from barpc.sensor.csm import STATE_END
from barpc.sensor.direct_grid import LINEAR
from barpc.sensor.image_corrections import Calibrated, ColumnSpline, RowSpline, Splined
from barpc.sensor.sampler import Sample, Scattered
from barpc.simulate import Look, fly
from barpc.workspace import Workspace, own_files
from tests.fit.cameras import synthetic
from tests.jitter import scene
from tests.rpcio.conftest import make_rpc, write_image

from .test_growth import small_block

SIZE, ALTS = (1500, 2200), (0.0, 600.0)
ENDS = (GRID_SUFFIX, CORRECTION)


@pytest.fixture(scope="module")
def camera():
    """A swing of 0.3 px every 900 rows: two and a half in the image, which no RPC follows."""
    return scene(900.0, 0.3, SIZE, ALTS)


@pytest.fixture(scope="module")
def fit(camera) -> RpcFit:
    return fit_rpc(camera, SIZE, ALTS, strict=False)


@pytest.fixture(scope="module")
def easy(camera) -> RpcFit:
    return fit_rpc(camera.sensor, SIZE, ALTS)


@pytest.fixture(scope="module")
def view(tmp_path_factory, camera) -> View:
    path = write_image(tmp_path_factory.mktemp("in") / "a.tif", (1, SIZE[1], SIZE[0]), dtype="uint16")
    return View("a", str(path), SIZE, camera.sensor, ALTS)


def seen_by(camera, count=2000, low=(0.0, 0.0), high=SIZE):
    rng = np.random.default_rng(8)
    image = rng.uniform(np.array(low) - 0.5, np.array(high) - 0.5, (count, 2))
    return camera.localize(image, rng.uniform(*ALTS, count)), image


def run_of(folder: Path, *given, **options) -> list[dict[str, dict[str, float | str]]]:
    with Workspace(folder) as run:
        return write_grids(run, given, RunOptions(**options))


@pytest.mark.slow
def test_grids_are_written_where_the_rpc_misses_the_camera_and_nowhere_else(tmp_path, view, camera, fit, easy):
    assert 0.02 < fit.max_ckp.max() < 0.6
    other = replace(view, name="b")
    written = run_of(tmp_path / "out", (view, fit, camera), (other, easy, camera.sensor))
    assert [list(one) for one in written] == [["a" + GRID_SUFFIX, "a" + CORRECTION], []]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {".barpc", "a" + GRID_SUFFIX, "a" + CORRECTION}
    (written,) = run_of(tmp_path / "all", (other, easy, camera.sensor), grids=True)
    assert list(written) == ["b" + GRID_SUFFIX, "b" + CORRECTION]


def test_a_pushbroom_camera_is_written_as_a_state_that_reads_as_it(tmp_path, view):
    camera = fly(np.array([5.4, 43.3, 300.0]), Look(12.0, 140.0), SIZE, 0.5)
    fit = SimpleNamespace(rpc=make_rpc(), max_ckp=np.zeros(2))  # no grid is needed
    (written,) = run_of(tmp_path, (view, fit, camera))
    assert list(written) == ["a" + STATE_END]
    ground, image = seen_by(camera)
    off = np.linalg.norm(open_camera(tmp_path / f"a{STATE_END}").model.project(ground) - image, axis=1).max()
    assert 0.3 * written["a" + STATE_END]["barpc"] < off < 1e-3


@pytest.fixture(scope="module")
def once(tmp_path_factory, view, camera, fit) -> tuple[Path, dict[str, dict[str, float | str]]]:
    """A folder with the grids of the view, and what is told of them; nothing is written there."""
    folder = tmp_path_factory.mktemp("once")
    (written,) = run_of(folder, (view, fit, camera))
    return folder, written


def test_what_is_told_of_a_grid_is_its_error(once, camera):
    tmp_path, written = once
    ground, image = seen_by(camera)
    for name in (GRID_SUFFIX, CORRECTION):
        off = np.linalg.norm(open_camera(tmp_path / f"a{name}").model.project(ground) - image, axis=1).max()
        told = written[f"a{name}"]["barpc"]
        assert 0.3 * told < off < 1.2 * told
        assert told < LINEAR
    assert LINEAR / 10 < written["a" + GRID_SUFFIX]["linear"] < LINEAR


def test_no_altitude_changes_what_is_added_to_the_rpc_of_a_correction(once, camera, fit):
    """The run's own RPC is not the one to add to: what it lacks is another at other altitudes."""
    rpc, lacking = read_correction(once[0] / f"a{CORRECTION}")
    at = seen_by(camera)[1]
    for alt in ALTS:
        ground = rpc.localize(at, np.full(len(at), alt))
        assert np.linalg.norm(lacking.apply(at) - camera.project(ground), axis=1).max() < LINEAR
    assert rpc.err_bias == fit.rpc.err_bias


def test_a_file_that_does_not_hold_what_was_written_ends_the_run(tmp_path, view, camera, fit):
    """Also one of a run that died, which is in the way, is written again first."""
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / ("a" + GRID_SUFFIX)).write_text("half")
    (tmp_path / "a" / ("a" + CORRECTION)).write_text("half")
    errors = grids.make_grids(view, fit.rpc, camera, grids.GridFiles(grids=True), str(tmp_path))
    assert set(grids.verify_grids(view, camera, errors, str(tmp_path / "a"))) == {"a" + GRID_SUFFIX, "a" + CORRECTION}
    rpc, lacking = read_correction(path := tmp_path / "a" / f"a{CORRECTION}")
    write_correction(replace(lacking, shift=-lacking.shift), rpc, path, overwrite=True)
    with pytest.raises(
        OutputError, match=r"a_correction\.tif: (gdal|barpc) reads it with errors of [01]\.\d+ px RMS, not 0\.00\d+; is"
    ):
        grids.verify_grids(view, camera, errors, str(tmp_path / "a"))


@pytest.mark.slow
def test_a_run_that_dies_half_way_leaves_nothing_half_written(tmp_path, view, camera, fit, monkeypatch):
    def dying(*given, **how):
        raise KeyboardInterrupt

    monkeypatch.setattr(grids, "write_correction", dying)
    with pytest.raises(KeyboardInterrupt):
        run_of(tmp_path / "out", (view, fit, camera), grids=True)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".barpc"]
    assert not list((tmp_path / "out" / ".barpc" / "partial").rglob("*.tif"))
    monkeypatch.undo()
    run_of(tmp_path / "out", (view, fit, camera), grids=True)
    assert own_files(tmp_path / "out") == {"a" + GRID_SUFFIX, "a" + CORRECTION}


def test_a_camera_without_ground_in_a_part_of_its_image_is_one_line(tmp_path, view, camera, fit):
    @dataclass(frozen=True)
    class Blind:
        def __getattr__(self, name):
            return getattr(camera, name)

        def localize(self, image, alt):
            return np.where(np.asarray(image)[..., :1] > 1400, np.nan, camera.localize(image, alt))

    with pytest.raises(OutputError, match=r"^a: no grid can be made of its camera") as caught:
        run_of(tmp_path / "out", (view, fit, Blind()), grids=True)
    assert "\n" not in str(caught.value)


@pytest.mark.nightly
def test_what_steps_leave_is_told(tmp_path, view, camera, fit, caplog):
    """A grid does not hold a step between detectors in the cell that it runs through: said, with how much it is."""

    class Stepped:
        sensor = camera.sensor

        def localize(self, image, alt):
            image = np.asarray(image)
            return camera.localize(image - 0.1 * (image[..., :1] > 700.3), alt)

        def project(self, ground):
            image = camera.project(ground)
            return image + 0.1 * (image[..., :1] > 700.25)

        def project_jacobian(self, ground):
            return self.project(ground), camera.project_jacobian(ground)[1]

    with caplog.at_level(logging.WARNING):
        (written,) = run_of(tmp_path, (view, fit, Stepped()), grids=True)
    for end in (GRID_SUFFIX, CORRECTION):  # whoever reads a file sees the step that was seen as it was written
        (told,) = re.findall(rf"a{end}: errors of \S+ px RMS, up to (0\.\d+) px", caplog.text)
        assert 0.02 < 0.99 * float(told) <= written["a" + end]["barpc"] < 0.3


# --- its parts ---------------------------------------------------------------------------------------------


def plane(*left: float) -> SimpleNamespace:
    """As much of a fit as is looked at: its largest errors."""
    return SimpleNamespace(max_ckp=np.array(left), rpc="rpc")


@pytest.fixture
def tasks(monkeypatch) -> list:
    """What would be written: of each view, whether it has grids."""
    found: list = []

    def write(run, tasks, executor, progress):
        found.extend((view.name, rpc, files.grids) for view, rpc, _, files in tasks)
        return [{f"{view.name}.x": {"barpc": 1.0}} for view, *_ in tasks]

    monkeypatch.setattr(grids, "_write_grids", write)
    return found


def test_grids_are_for_cameras_that_their_rpc_misses_by_a_fiftieth_of_a_pixel(tmp_path, view, tasks) -> None:
    """Also where it is not known by how much; the names of the others are kept apart."""
    misses = {"a": (0.02, 0.0), "b": (0.0121, 0.0161), "c": (np.nan, 0.0), "d": (0.0119, 0.0159)}  # d: 0.0199 together
    given = [(replace(view, name=name), plane(*left), None) for name, left in misses.items()]
    written = run_of(tmp_path / "out", *given)
    assert tasks == [("b", "rpc", True), ("c", "rpc", True)]
    assert written == [{}, {"b.x": {"barpc": 1.0}}, {"c.x": {"barpc": 1.0}}, {}]
    tasks.clear()
    run_of(tmp_path / "asked", *given, grids=True)
    assert tasks == [(name, "rpc", True) for name in "abcd"]


def test_a_stage_of_grids_is_only_where_there_are_some(tmp_path, view, tasks) -> None:
    for options, stages in (({}, []), ({"grids": True}, ["grids"])):
        with Workspace(tmp_path / "-".join(["run", *stages])) as run:
            write_grids(run, [(view, plane(0.0, 0.0), None)], RunOptions(**options))
            assert [stage["stage"] for stage in run.stages] == stages


def read_as(monkeypatch, **rms: float) -> list:
    """Readers of files that see these errors; what each of them was asked for."""
    asked: list = []

    def verify(path, sample):
        asked.append((path.name, len(sample.points)))
        return [SimpleNamespace(consumer=name, rms=px, max_error=2 * px, note="") for name, px in rms.items()]

    monkeypatch.setattr(grids, "verify_grid", verify)
    return asked


@pytest.mark.parametrize(
    ("rms", "fine"),
    [
        ({"barpc": 0.005, "gdal": 0.005}, True), ({"barpc": 0.005009, "gdal": 0.004991}, True),
        ({"barpc": 0.005011}, False), ({"barpc": 0.004989}, False), ({"gdal": 0.005011}, False),
        ({"gdal": np.nan}, False), ({"linear": 9.0}, True),
    ],
)  # fmt: skip
def test_a_reader_sees_the_error_that_was_seen_in_writing(tmp_path, view, monkeypatch, rms, fine) -> None:
    asked = read_as(monkeypatch, **rms)
    where = np.array([[3.0, 4.0, 5.0], [6.0, 7.0, 8.0]])
    errors = {"a" + GRID_SUFFIX: SimpleNamespace(rms=0.005, worst=where)}
    model = make_rpc()
    if fine:
        found = grids.verify_grids(view, model, errors, str(tmp_path))
        assert found == {"a" + GRID_SUFFIX: {name: 2 * px for name, px in rms.items()}}
        count = len(Scattered.over(model, view.size, grids.widened(view.alt_range)).points)
        assert asked == [("a" + GRID_SUFFIX, count + 2)]
        return
    ((name, px),) = rms.items()
    said = rf"a_grid\.tif: {name} reads it with errors of {px:.3g} px RMS, not 0\.005; is the disk full"
    with pytest.raises(OutputError, match=said):
        grids.verify_grids(view, model, errors, str(tmp_path))


@pytest.mark.parametrize(
    ("written", "read", "told"),
    [
        (0.02, 0.019, None), (0.0201, 0.01, "0.0201"), (0.01, 0.0301, "0.0301"), (0.05, 0.03, "0.05"),
        (0.01, "cannot be read", None), (np.nan, 0.01, "nan"),
    ],
)  # fmt: skip
def test_the_larger_of_the_errors_written_and_read_is_told(
    tmp_path, view, monkeypatch, caplog, written, read, told
) -> None:
    def made(view, rpc, model, files, room):
        place = Path(room) / view.name
        place.mkdir(parents=True)
        (place / "a.x").write_text("grid")
        return {"a.x": SimpleNamespace(rms=0.007, far=written)}

    monkeypatch.setattr(grids, "make_grids", made)
    monkeypatch.setattr(grids, "verify_grids", lambda *given: {"a.x": {"barpc": read, "gdal": 9.0}})
    with Workspace(tmp_path / "out") as run:
        found = grids._write_grids(run, [(view, None, None, None)], None, None)  # type: ignore[arg-type, list-item]
        assert not (run.partial / "grids").exists()
    assert found == [{"a.x": {"barpc": read, "gdal": 9.0}}]
    assert (tmp_path / "out/a.x").read_text() == "grid"
    lines = [record.getMessage() for record in caplog.records]
    assert lines == ([] if told is None else [f"a.x: errors of 0.007 px RMS, up to {told} px (at steps?)"])


@pytest.mark.parametrize(
    ("largest", "rms", "chosen", "tried"),
    [
        ((0.005, 9), (0.005, 0), "given", 1),  # as exact as a grid: no other is tried
        ((0.0051, 0.005), (0.006, 0.005), "plain", 2),
        ((0.4, 0.5), (0.2, 0.1), "plain", 2),  # the RMS counts, not the largest
        ((0.5, 0.4), (0.1, 0.2), "given", 2),
        ((0.5, None), (0.3, None), "given", 2),  # one that fails is passed over
        ((None, None), (None, None), "", 2),  # the last reason is given
    ],
)
def test_the_rpc_that_lacks_least_is_the_one_that_is_added_to(monkeypatch, largest, rms, chosen, tried) -> None:
    assert LINEAR == 0.005
    names = ("given", "plain")
    known = {name: SimpleNamespace(rms=one, far=big) for name, one, big in zip(names, rms, largest, strict=True)}
    rpcs = {name: replace(make_rpc(), err_bias=5.0, err_rand=float(n)) for n, name in enumerate(names)}
    given = replace(rpcs["given"], err_bias=1.5, err_rand=0.25)
    asked: list[str] = []

    def fit(model, size, alts):
        assert (model, size, alts) == ("model", (10, 20), (100.0, 300.0))
        if known["plain"].rms is None:
            asked.append("plain")
            raise FitError("no fit")
        return rpcs["plain"]

    def between(rpc, model, size, alt):
        assert (model, size, alt) == ("model", (10, 20), 200.0)
        asked.append("given" if rpc is given else "plain")
        if known[asked[-1]].rms is None:
            raise FitError("nothing lies there")
        return asked[-1]

    monkeypatch.setattr(grids, "fit_only", fit)
    monkeypatch.setattr(grids, "CorrectionGrid", SimpleNamespace(between=between))
    monkeypatch.setattr(grids, "Displaced", lambda rpc, lacking: SimpleNamespace(project=lacking))
    sample = SimpleNamespace(model="model", size=(10, 20), alt_range=(100.0, 300.0), compare=known.get)
    if not chosen:
        with pytest.raises(FitError, match="no fit"):
            grids.grid_correction(given, sample)  # type: ignore[arg-type]
        return
    rpc, lacking, miss = grids.grid_correction(given, sample)  # type: ignore[arg-type]
    assert asked == list(names[:tried])
    assert lacking == chosen
    assert miss is known[chosen]
    assert (rpc.err_bias, rpc.err_rand) == (1.5, 0.25)


@pytest.mark.parametrize("inner", [False, True])
def test_what_is_added_to_the_rpc_of_a_displaced_camera_is_of_no_altitude(inner) -> None:
    """Swings in front of a rotation, and a distortion behind it too: an RPC that follows them leaves other rests."""
    camera = synthetic()
    model = camera.model
    if inner:
        bent = ColumnSpline(camera.size[0], np.random.default_rng(1).normal(0, 0.3, (12, 2)))
        model = replace(model, sensor=Calibrated(camera.rpc, bent))
    model = Splined(model, RowSpline(np.zeros((0, 2)), periods=[9000.0], amplitudes=[[[0.5, 0.35], [-0.35, 0.5]]]))
    sample = Scattered.over(model, camera.size, camera.alt_range)
    options = FitOptions(method="gauss-newton")
    followed = fit_rpc(model, camera.size, camera.alt_range, options=options, strict=False).rpc
    rpc, lacking, errors = grids.grid_correction(followed, sample)
    image = np.random.default_rng(3).uniform([100.0, 100.0], np.array(camera.size) - 100.0, (2000, 2))

    def rest(rpc, alt):
        return model.project(rpc.localize(image, np.full(len(image), alt))) - image

    assert np.abs(rest(rpc, 0.0) - rest(rpc, 1000.0)).max() < 1e-6 < np.abs(rest(rpc, 0.0)).max()
    assert np.abs(rest(followed, 0.0) - rest(followed, 1000.0)).max() > 0.1
    for alt in camera.alt_range:
        assert np.linalg.norm(lacking.at(image) - rest(rpc, alt), axis=1).max() < 1.2 * errors.far
    assert errors.rms < 0.5 * LINEAR


def test_a_camera_is_off_by_root_mean_square_and_by_most(view) -> None:
    rpc = make_rpc()
    errors = Scattered.over(rpc, (2000, 1900), (30.0, 300.0), cells=5).compare(rpc.crop(-3.0, 4.0).project)
    assert errors.rms == pytest.approx(5.0, abs=1e-5)
    assert errors.far == pytest.approx(5.0, abs=1e-5)
    assert errors.worst.shape[1] == 3


# --- whole runs -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    folder = tmp_path_factory.mktemp("block")
    return small_block(folder, 3)[1], str(folder / "ties.npz")


@pytest.mark.nightly
def test_a_run_with_everything_is_told_and_the_same_whatever_the_workers(block, tmp_path):
    images, matches = block
    options = RunOptions(matches=matches, matches_only=True, grids=True)
    result = adjust(images, tmp_path / "a", options)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        adjust(images, tmp_path / "b", options, executor=executor)
    for view in result.record.views:
        ends = [".vrt", "_RPC.TXT", *ENDS]
        assert list(view.outputs) == [view.name + end for end in ends]
        for name in view.outputs:
            assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
        assert all(isinstance(px, float) and px < LINEAR for one in view.outputs.values() for px in one.values())
        for end in ENDS:
            found = open_camera(tmp_path / "a" / (view.name + end)).model
            ground = found.localize(np.array([[10.0, 20.0], [200.0, 250.0]]), np.array([*view.alt_range_m]))
            rpc = read_rpc(tmp_path / "a" / f"{view.name}_RPC.TXT")
            assert np.abs(rpc.project(ground) - [[10.0, 20.0], [200.0, 250.0]]).max() < 1e-3
    adjust(images, tmp_path / "a", replace(options, grids=False, overwrite=True))
    left = {path.name for path in (tmp_path / "a").iterdir()}
    assert not [name for name in left if name.endswith(ENDS)]


def test_a_file_of_the_user_is_never_replaced(block, tmp_path):
    images, matches = block
    out = tmp_path / "out"
    out.mkdir()
    (out / f"{images[0].stem}{GRID_SUFFIX}").write_text("mine")
    options = RunOptions(matches=matches, matches_only=True, overwrite=True)
    with pytest.raises(OutputError, match=r"_grid\.tif"):
        adjust(images, out, options)
    assert (out / f"{images[0].stem}{GRID_SUFFIX}").read_text() == "mine"


@pytest.mark.slow
def test_with_grids_a_camera_that_no_rpc_holds_is_no_failure(block, tmp_path):
    """The image's RPC is given with a tolerance that no fit meets: refused without grids, and told with them."""
    images, matches = block
    options = RunOptions(matches=matches, matches_only=True, fit=FitOptions(tolerance=1e-12))
    with pytest.raises(Exception, match="wanted 1e-12"):
        adjust(images, tmp_path / "a", options)
    result = adjust(images, tmp_path / "b", replace(options, grids=True))
    assert {view.status for view in result.record.views}.isdisjoint({"failed"})


@pytest.fixture(scope="module")
def gridded(block, tmp_path_factory) -> Path:
    """The folder of a run with grids; nothing is written there."""
    folder: Path = tmp_path_factory.mktemp("gridded") / "a"
    adjust(block[0], folder, RunOptions(matches=block[1], matches_only=True, grids=True))
    return folder


@pytest.mark.slow
def test_verbs_understand_grids(block, gridded, tmp_path):
    name = block[0][0].stem
    grid, rpc = str(gridded / f"{name}{GRID_SUFFIX}"), str(gridded / f"{name}.vrt")

    def said(*words):
        found = CliRunner().invoke(cli, [str(word) for word in words], standalone_mode=False)
        assert found.exception is None, found
        return found.return_value, found.stdout

    code, text = said("info", "--json", grid, gridded / f"{name}{CORRECTION}")
    assert [one["size_px"] for one in json.loads(text)] == [[256, 256], [256, 256]]
    assert [one["rpc"].split(" in ")[0] for one in json.loads(text)] == ["grid", "correction"]
    assert said("convert", grid, tmp_path / "b_RPC.TXT")[0] == 0
    assert read_rpc(tmp_path / "b_RPC.TXT").off(read_rpc(rpc)).max() < 1e-2
    code, text = said("convert", rpc, tmp_path / f"c{GRID_SUFFIX}", "--json")
    assert (code, json.loads(text)[-1]["consumer"]) == (0, "barpc")
    assert open_camera(tmp_path / f"c{GRID_SUFFIX}").model.lonlat.shape == open_camera(grid).model.lonlat.shape
    one, other = open_camera(rpc), open_camera(grid)
    assert Sample.grid(one.model, (256, 256), one.alt_range).compare(other.model.project) < 1e-3
    assert said("fit", grid)[0] == 0


@pytest.mark.slow
def test_a_grid_is_the_camera_of_an_image_and_no_image(block, gridded):
    images, matches = block
    for end in (GRID_SUFFIX, CORRECTION):
        given = [f"{path},camera={gridded / (path.stem + end)}" for path in images]
        found = check(given, RunOptions(matches=matches, matches_only=True))
        assert found.record.views[0].rmse_before < 0.5
        with pytest.raises(ImageError, match="a grid and no image"):
            check([str(gridded / (images[0].stem + end)), images[1]])


@pytest.mark.slow
def test_a_grid_that_no_rpc_holds_is_not_converted(tmp_path, once):
    path = once[0] / f"a{GRID_SUFFIX}"
    found = CliRunner().invoke(cli, ["convert", str(path), str(tmp_path / "a_RPC.TXT")], standalone_mode=False)
    assert str(path) in str(found.exception)
    assert "wanted 0.01" in str(found.exception)
    assert not (tmp_path / "a_RPC.TXT").exists()
