"""barpc from Python: a function a verb, with the habits of rasterio and numpy."""

from __future__ import annotations

import inspect
import json
import os
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from rasterio.io import MemoryFile

import barpc
from barpc.base import keywords
from barpc.base.declarations import Options, declared
from barpc.base.errors import BarpcError, BarpcWarning, InputError, Remark, UsageError
from barpc.base.options import AdjustOptions, FitOptions, RunOptions, TieOptions
from barpc.cli import COMMANDS, cli
from barpc.simulate import simulate_block
from barpc.verbs.images import every
from barpc.verbs.options import FLAG_NAMES, run_options
from barpc.verbs.python import in_keywords
from tests.docs.test_pages import script
from tests.pipeline.known import FOLDER as SAMPLES
from tests.pipeline.known import SAMPLES as VIEWS
from tests.rasters.test_dem import write_dem
from tests.report.conftest import run_of_block, written
from tests.rpcio.conftest import make_rpc
from tests.sealing import seal

GROUND = [5.4, 43.3, 120.0]
PUBLIC = [name for name in barpc.__all__ if name != "__version__"]


# --- a function a verb ------------------------------------------------------------------------------------


def test_every_verb_is_a_function_with_its_flags_as_keywords():
    assert set(COMMANDS) <= set(PUBLIC)
    positional = {"images", "points", "numbers", "files", "run_dir", "run_dirs", "places", "target"}
    printed = {"image_list", "options_file", "paper", "out", "output", "outlines", "help_all", "at"}
    printed |= {"dry_run"}  # `barpc.plan`
    for verb in COMMANDS:
        command = cli.get_command(click.Context(cli, **cli.context_settings), verb)
        assert command is not None
        taken = inspect.signature(getattr(barpc, verb)).parameters
        typed = str(taken["keywords"].annotation)[len("Unpack[") : -1] if "keywords" in taken else ""
        known = {*positional, *printed, *taken, *(getattr(keywords, typed).__annotations__ if typed else ())}
        for flag in command.params:
            assert re.sub(r"^flag_(tie_|adjust_|fit_)?", "", flag.name or "") in known, (verb, flag.name)


@pytest.mark.parametrize(
    ("verb", "given", "keyword", "wrong"),
    [
        ("export", ("run", "out", "s2p"), "alt", (1.0,)),
        ("export", ("run", "out", "s2p"), "alt_range", (1.0, 2.0)),
        ("verify", ("run",), "expect", "g" * 64),
        ("calibrate", (["a", "b", "c"], "s.cal"), "overwrite", "yes"),
        ("calibrate", (["a", "b", "c"], "s.cal"), "sensor", 3),
        ("info", (VIEWS[0],), "at", (5.4, 43.3)),
        ("info", (VIEWS[0],), "alt", float("nan")),
    ],
)
def test_what_a_verb_cannot_take_is_refused_by_the_names_of_both(verb, given, keyword, wrong):
    with pytest.raises(InputError, match=rf"^{verb}: .*{keyword}\b") as caught:
        getattr(barpc, verb)(*given, **{keyword: wrong})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("flag", "words"),
    [
        ("--alt", ("export", "r", "o", "--to", "s2p", "--alt", "1", "x")),
        ("--at", ("info", str(VIEWS[0]), "--at", "5.4", "43.3", "nan")),
    ],
)
def test_a_flag_that_holds_no_number_is_wrong_usage(flag, words):
    found = CliRunner().invoke(cli, words)
    assert found.exit_code == 2
    assert f"'{flag}'" in found.output


def test_folders_with_the_name_of_a_verb_do_not_hide_it():
    """Whichever is imported first, and of `barpc` nothing that costs."""
    code = (
        "import sys, barpc; assert not {'numpy', 'typing'} & sys.modules.keys(); "
        "from barpc.fit import methods, fit_rpc; import barpc.dsm.surface, barpc.export.targets; "
        "from barpc import fit; "
        "assert fit is barpc.fit and methods is sys.modules['barpc.fit.methods']; "
        "assert fit_rpc is barpc.fit_rpc.__wrapped__; "
        "import importlib; importlib.reload(barpc); from barpc.fit.points import terrain_range; "
        "help(barpc.fit); print(barpc.fit.__name__, barpc.dsm.__name__, barpc.export.__name__)"
    )
    done = subprocess.run(
        [sys.executable, "-S", "-c", f"import site; site.main(); {code}"], capture_output=True, text=True
    )
    *told, names = done.stdout.splitlines() or [done.stderr]
    assert names == "fit dsm export", done.stderr
    assert told[0] == "Help on function fit in module barpc.verbs.fitting:"
    assert "alt_range" in done.stdout


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_says_what_it_returns_and_shows_how(name):
    thing = getattr(barpc, name)
    text = inspect.getdoc(thing) or ""
    if inspect.isfunction(thing):
        assert re.search(r"^Returns\n-------$", text, re.MULTILINE), name
    if not (inspect.isclass(thing) and issubclass(thing, (Exception, Warning, Options))):  # (of options: `run_options`)
        assert re.search(r"^Examples\n--------\n>>> ", text, re.MULTILINE), name


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda out: barpc.adjust(VIEWS, out), r"exists and is not empty; give overwrite=True or another out_dir$"),
        (lambda out: barpc.dsm(VIEWS, out), r"another out$|out the name of a new file"),
        (
            lambda out: barpc.convert(VIEWS, out_dir=out, window=(0, 0, 9, 9)),
            "^window goes with a TARGET, not with out",
        ),
        (lambda out: barpc.localize(VIEWS[0], [5, 5], 1.0, dem=out), "^give either alt or dem$"),
        (lambda out: barpc.verify(out, expect="12"), "^verify: expect 12: a root has 64"),
        (lambda out: barpc.adjust(VIEWS[:1], out / "new"), r"ground control points \(gcp\)"),
        (lambda out: barpc.adjust(["https://a.b/c.tif"] * 2, out / "new"), "give allow_remote a.b"),
        (lambda out: barpc.info(VIEWS[0], at=(43.3, 5.4, 0.0), alt=0.0), r"^at \(43.3"),
    ],
)
def test_errors_speak_of_keywords(call, words, tmp_path):
    (tmp_path / "own.txt").touch()
    with pytest.raises(BarpcError, match=words) as caught:
        call(tmp_path)
    assert not re.search(r"(?<!\w)--?[a-z]", str(caught.value).replace(str(tmp_path), ""))


def test_commands_and_names_of_files_in_errors_stay_as_they_are():
    said = "/a --gcp/b--dem.tif, x-o.tif: see 'barpc fit --keep-going', --no-such; give --gcp FILE, -j 2"
    assert in_keywords(said, "out") == said.replace("give --gcp", "give gcp").replace("-j 2", "jobs 2").replace(
        "/a --gcp/", "/a gcp/")  # fmt: skip


def test_a_warning_points_at_the_line_of_the_caller():
    calls = (
        lambda: barpc.project(VIEWS[0], [6.4, 44.3, 120.0]),
        lambda: barpc.localize(VIEWS[0], [500, 500]),
    )
    for call in calls:
        with pytest.warns(BarpcWarning) as caught:
            call()
        assert {one.filename for one in caught} == {__file__}


# --- types ------------------------------------------------------------------------------------------------


def test_the_keywords_are_what_the_records_declare():
    """And as the generator writes them: the file is no second declaration."""
    assert script("generate_options").keywords() == Path(keywords.__file__).read_text()
    of_run = {name for table in (RunOptions, TieOptions, AdjustOptions, FitOptions) for name in declared(table)}
    assert keywords.RunKeywords.__annotations__.keys() == of_run | set(FLAG_NAMES.values())
    for verb in PUBLIC:
        taken = inspect.signature(getattr(barpc, verb)).parameters.get("keywords") if verb in COMMANDS else None
        assert taken is None or re.fullmatch(r"Unpack\[\w+Keywords\]", taken.annotation), verb


CALLS = """
import barpc, os, pathlib
barpc.adjust("a.tif", pathlib.Path("out"), gcp=["a.csv", pathlib.Path("b.csv")], drift=None, images="copy")
barpc.dsm("run", "out.tif", gsd=2, alt=(0.0, 9.0))
barpc.fit("a.tif", alt_range=[0, 400], method="ridge")
barpc.adjust("a.tif", "out", gpc="a.csv")
barpc.adjust("a.tif", "out", solver="huber")
barpc.dsm("run", "out.tif", gsd="2")
barpc.export("run", "out", "s2p", alt_range=(1.0, 2.0))
barpc.fit("a.tif", matcher="guided")
"""


@pytest.mark.nightly
def test_mypy_refuses_keywords_that_are_none(tmp_path):
    """A minute where nothing is cached."""
    mypy = pytest.importorskip("mypy.api")
    (tmp_path / "calls.py").write_text(CALLS)
    told, _, code = mypy.run([str(tmp_path / "calls.py"), "--follow-imports=silent"])
    wrong = [int(line.split(":")[1]) for line in told.splitlines() if ": error:" in line]
    assert (code, wrong) == (1, [6, 7, 8, 9, 10]), told
    assert 'Unexpected keyword argument "gpc" for "adjust"' in told


# --- images -----------------------------------------------------------------------------------------------


def test_a_path_a_dataset_a_view_and_a_camera_are_one_image():
    camera = barpc.open_camera(VIEWS[0])
    view = barpc.View("a", str(VIEWS[0]), camera.extent, camera.model, camera.alt_range)
    with rasterio.open(VIEWS[0]) as dataset:
        images = [VIEWS[0], str(VIEWS[0]), dataset, view, camera, camera.model]
        found = np.array([barpc.project(image, GROUND) for image in images])
        assert every(dataset) == [str(VIEWS[0])]
        assert every((VIEWS[0], dataset)) == [str(VIEWS[0])] * 2
        assert barpc.info(dataset, alt=120.0) == barpc.info(str(VIEWS[0]), alt=120.0)
    np.testing.assert_array_equal(found, np.tile(camera.model.project(GROUND), (len(images), 1)))
    assert every(f"{SAMPLES}/view_0[02].tif") == [str(VIEWS[0]), str(VIEWS[2])]
    assert len(barpc.info(f"{SAMPLES}/view_0[02].tif", alt=120.0)) == 2
    assert every(path for path in VIEWS) == list(map(str, VIEWS))
    with pytest.raises(InputError, match="3 is no image: give a path"):
        barpc.open_camera(3)


class Place:
    """A path as other libraries have it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __fspath__(self) -> str:
        return str(self.path)


def test_open_datasets_and_other_peoples_paths_are_files_everywhere(tmp_path):
    where = rasterio.Affine(0.01, 0, 5.36, 0, -0.01, 43.34)
    write_dem(tmp_path / "dem.tif", "EPSG:4326+4979", np.full((8, 8), 120.0, np.float32), transform=where)
    expected = barpc.localize(VIEWS[0], [[500, 500]], 120.0)
    with rasterio.open(VIEWS[0]) as image, rasterio.open(tmp_path / "dem.tif") as dem:
        for given, terrain in ((image, dem), (Place(VIEWS[0]), Place(tmp_path / "dem.tif")), (VIEWS[0], [dem])):
            np.testing.assert_allclose(
                barpc.localize(given, [[500, 500]], dem=terrain, geoid="none"), expected, rtol=0, atol=1e-4
            )
            assert barpc.read_rpc(given) == barpc.read_rpc(VIEWS[0])
            assert barpc.info(given, dem=terrain, geoid="none")["center_alt_m"] == pytest.approx(120.0)
            barpc.write_rpc(barpc.read_rpc(given), Place(tmp_path / "a.RPB"), overwrite=True)
        assert barpc.fit(image, Place(tmp_path / "f_RPC.TXT"), dem=[dem], geoid="none").max_ckp.max() < 0.01
    assert barpc.convert(Place(VIEWS[0]), Place(tmp_path / "b.RPB")).passed
    (tmp_path / "o.toml").write_text("[tie]\nband = 2\n")
    assert run_options(Place(tmp_path / "o.toml")).tie.band == 2


def test_a_dataset_in_memory_has_no_file_that_can_be_read():
    with MemoryFile(VIEWS[0].read_bytes()) as memory, memory.open() as dataset:
        with pytest.raises(InputError, match=r"/vsimem/.*: a dataset without a file.*write it to disk"):
            barpc.project(dataset, GROUND)


# --- options ----------------------------------------------------------------------------------------------


def test_options_are_a_record_a_mapping_a_file_or_keywords(tmp_path):
    (tmp_path / "o.toml").write_text("[tie]\nband = 2\n")
    expected = barpc.RunOptions(tie=barpc.TieOptions(band=2), gcp=("a.csv",))
    for given in (
        run_options(barpc.RunOptions(tie=barpc.TieOptions(band=2)), gcp="a.csv"),
        run_options({"tie": {"band": 2}}, gcp=["a.csv"]),
        run_options(tmp_path / "o.toml", gcp=Path("a.csv")),
        run_options(str(tmp_path / "o.toml"), gcp=("a.csv",)),
        run_options(band=2, gcp="a.csv"),
        run_options(tie=barpc.TieOptions(band=2), gcp="a.csv"),
        run_options(tie={"band": 2}, gcp="a.csv"),
        run_options(tie={"band": 3}, band=2, gcp="a.csv"),
    ):
        assert given == expected
    assert run_options(rpc_format=("txt", "rpb")) == run_options(rpc_formats=("txt", "rpb"))
    with pytest.raises(InputError, match=r"unknown option 'gpc'; is 'gcp' meant\?"):
        run_options(gpc="a.csv")
    with pytest.raises(InputError, match="drift"):
        run_options(drift=1e9)


# --- points -----------------------------------------------------------------------------------------------


def test_leading_axes_stay():
    lon, lat = np.meshgrid(5.4 + 1e-4 * np.arange(4), 43.3 + 1e-4 * np.arange(3))
    seen = barpc.project(VIEWS[0], np.stack([lon, lat], axis=-1), alt=120.0)
    assert seen.shape == (3, 4, 2)
    back = barpc.localize(VIEWS[0], seen, alt=np.full((3, 4), 120.0))
    np.testing.assert_allclose(back, np.stack([lon, lat, np.full((3, 4), 120.0)], axis=-1), atol=1e-9)
    at = np.stack([seen, barpc.project(VIEWS[2], back)], axis=-2)
    ground, error = barpc.triangulate([VIEWS[0], VIEWS[2]], at)
    assert (ground.shape, error.shape) == ((3, 4, 3), (3, 4))
    np.testing.assert_allclose(ground, back, atol=1e-6)
    assert error.max() < 1e-6
    at[1, 2, 0] = np.nan
    ground, error = barpc.triangulate([VIEWS[0], VIEWS[2]], at)
    assert np.isnan(ground[1, 2]).all()
    assert np.isfinite(error).sum() == 11


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda m: m.project([5.4, 43.3]), r"ground points of shape \(2,\): \(\.\.\., 3\) is expected, lon, lat"),
        (lambda m: m.project(np.zeros((3, 5))), r"\(3, 5\).*altitude \[m\] on the last axis; transpose them"),
        (lambda m: m.project("abc"), r"ground points: numbers are expected"),
        (lambda m: m.project_jacobian(np.zeros((4, 2))), r"ground points of shape \(4, 2\)"),
        (lambda m: m.localize(np.zeros((2, 5)), 0.0), r"image points of shape \(2, 5\): \(\.\.\., 2\).*transpose"),
        (lambda m: m.localize(np.zeros((5, 2)), np.zeros(4)), r"altitudes of shape \(4,\).*broadcasts with \(5,\)"),
        (lambda m: m.localize(7.0, 0.0), r"image points of shape \(\)"),
    ],
)
def test_a_wrong_shape_names_the_axis_expected(call, words):
    rpc = make_rpc()
    correction = barpc.Correction(np.zeros(3), np.zeros(3), np.array([4.6e6, 4.4e5, 4.4e6]))
    for model in (rpc, barpc.Corrected(rpc, correction)):
        with pytest.raises(InputError, match=words):
            call(model)
        with pytest.raises(ValueError):  # what numpy's users catch
            call(model)


def test_what_is_masked_is_not_seen_and_complex_numbers_are_refused():
    """Whatever its fill value, which is a number as any other."""
    ground = np.ma.masked_array([GROUND, GROUND, GROUND], mask=[[False] * 3, [False, False, True], [True] * 3])
    for given in (ground, list(ground)):
        seen = barpc.project(VIEWS[0], given)
        assert type(seen) is np.ndarray
        np.testing.assert_array_equal(np.isnan(seen).any(axis=1), [False, True, True])
        np.testing.assert_array_equal(seen[0], barpc.project(VIEWS[0], GROUND))
    alt = np.ma.masked_equal([120.0, -9999.0], -9999.0)
    np.testing.assert_array_equal(
        np.isnan(barpc.project(VIEWS[0], [GROUND[:2]] * 2, alt=alt)).any(axis=1), [False, True]
    )
    np.testing.assert_array_equal(np.isnan(barpc.localize(VIEWS[0], [[5, 5]] * 2, alt=alt)).any(axis=1), [False, True])
    image = np.ma.masked_array([[[5.0, 5.0], [6.0, 6.0]]], mask=[[[True, False], [False, False]]])
    assert np.isnan(barpc.triangulate(VIEWS[:2], image)[0]).all()
    model = barpc.open_camera(VIEWS[0]).model
    calls = [
        lambda: model.project(np.array(GROUND) + 1j), lambda: model.localize([1j, 2.0], 0.0),
        lambda: model.localize([1.0, 2.0], 1j), lambda: barpc.project(VIEWS[0], [5.4, 43.3], alt=100 + 1j),
        lambda: barpc.triangulate(VIEWS[:2], np.zeros((2, 2), complex)),
        lambda: barpc.fit_rpc_points(np.ones((50, 3), complex), np.ones((50, 2)), size=(9, 9)),
        lambda: barpc.Tracks([0, 1], [0, 0], np.ma.masked_array(np.ones((2, 2)), mask=[[1, 0], [0, 0]]), [1.0, 1.0]),
        lambda: barpc.Tracks([0, 1], [0, 0], np.ones((2, 2)) + 1j, [1.0, 1.0]),
    ]  # fmt: skip
    for call in calls:
        with pytest.raises(BarpcError, match="complex numbers"):
            call()
    holes = np.ma.masked_array(np.ones((50, 3)), mask=np.eye(50, 3))
    with pytest.raises(BarpcError, match="3 of 50 are not finite"):
        barpc.fit_rpc_points(holes, np.ones((50, 2)), size=(9, 9))


def test_a_camera_is_opened_from_everything_that_info_takes():
    camera = barpc.open_camera(VIEWS[0])
    block = simulate_block(2, 20, seed=1)
    with rasterio.open(VIEWS[0]) as dataset:
        for given in (str(VIEWS[0]), dataset, camera, block.views[0], camera.model):
            found = barpc.open_camera(given)
            assert found.model == (block.views[0].sensor if given is block.views[0] else camera.model)
            assert barpc.info(given, alt=100.0)["altitude_range_m"] == list(found.alt_range)
    with pytest.raises(InputError, match="size given for a Camera"):
        barpc.open_camera(camera, size=(9, 9))


def test_longitude_and_latitude_exchanged_warn_and_right_ones_do_not():
    assert np.isfinite(barpc.project(VIEWS[0], GROUND)).all()
    with pytest.warns(BarpcWarning, match="give LON first, then LAT"):
        barpc.project(VIEWS[0], [GROUND[1], GROUND[0], GROUND[2]])
    with pytest.warns(BarpcWarning, match="1 of 1 points lie beyond the image by more than its size"):
        far = barpc.project(VIEWS[0], [6.4, 44.3, 120.0])  # elsewhere, and not exchanged
    assert far.shape == (2,)
    with pytest.raises(InputError, match="exchanged"):
        barpc.info(VIEWS[0], at=(43.3, 5.4, 120.0), alt=120.0)


def test_an_altitude_that_is_assumed_is_said_and_two_contradict():
    with pytest.warns(Remark, match="terrain height unknown, 250 m assumed"):
        found = barpc.localize(VIEWS[0], [500, 500])
    assert found[2] == 250.0
    with pytest.raises(UsageError, match="geoid goes with dem"):
        barpc.project(VIEWS[0], GROUND, geoid="egm96")
    with pytest.raises(InputError, match=r"image points of shape \(2, 2\) for 3 images: \(\.\.\., 3, 2\)"):
        barpc.triangulate(VIEWS, np.zeros((2, 2)))
    with pytest.raises(UsageError, match="one image"):
        barpc.triangulate(VIEWS[0], np.zeros((1, 2)))


def test_a_run_adjusted_again_has_its_new_altitude(tmp_path):
    """The altitude beside an image is that of its run as it is now, not as it was."""
    folder = tmp_path / "run"
    written(run_of_block(3, 60, size=(900, 700)), folder)
    summary = json.loads((folder / "summary.json").read_text())
    (name,) = summary["views"][0]["outputs"]
    camera = barpc.open_camera(f"{folder / name},size=900:700")
    before = barpc.info(camera)["center_alt_m"]
    assert before == summary["altitude_m"]
    (folder / "summary.json").write_text(json.dumps({**summary, "altitude_m": before + 5.0}))
    os.utime(folder / "summary.json", ns=(1, 1))
    with pytest.warns(Remark, match="terrain height unknown"):  # somebody has edited it
        assert barpc.info(camera)["center_alt_m"] != before + 5.0
    seal(folder)
    os.utime(folder / "summary.json", ns=(2, 2))
    assert barpc.info(camera)["center_alt_m"] == before + 5.0


# --- files ------------------------------------------------------------------------------------------------


def test_a_fit_that_misses_writes_nothing_and_says_so(tmp_path):
    options: dict[str, Any] = {"alt_range": (0, 400), "tolerance": 1e-13}
    with pytest.raises(barpc.BarpcError, match="nothing written"):
        barpc.fit(VIEWS[0], tmp_path / "a_RPC.TXT", **options)
    assert not list(tmp_path.iterdir())
    assert barpc.fit(VIEWS[0], **options).verdict(1e-13)
    barpc.fit(VIEWS[0], tmp_path / "a_RPC.TXT", barpc.FitOptions(tolerance=1e-13), alt_range=(0, 400), keep_going=True)
    assert barpc.read_rpc(tmp_path / "a_RPC.TXT").off(barpc.read_rpc(VIEWS[0])).max() < 1e-3
    with pytest.raises(InputError, match="unknown option 'altrange'"):
        barpc.fit(VIEWS[0], altrange=(0, 400))


def test_what_is_converted_is_a_sentence_with_the_worst_reader(tmp_path):
    done = barpc.convert(VIEWS, out_dir=tmp_path / "handoff", rpc_format="txt,rpb")
    assert done.passed
    assert len(done.paths) == 9
    assert all(path.is_file() for path in done.paths)
    number = re.fullmatch(r"3 images written, all readers agree to (\S+) px\.", str(done))
    assert number is not None
    assert 0 <= float(number[1]) < 1e-9
    assert float(number[1]) == float(f"{max(one.max_error for one in done.readings):.1g}")
    with pytest.raises(UsageError, match="give SOURCE and TARGET, or images and out_dir DIR"):
        barpc.convert(VIEWS, tmp_path / "a.RPB")
    with pytest.raises(InputError, match=r"unknown option 'windw'; did you mean window\?"):
        barpc.convert(VIEWS[0], tmp_path / "a.tif", windw=(0, 0, 9, 9))
    assert barpc.convert(VIEWS[0], tmp_path / "a.tif", window=(10, 20, 30, 40)).window == (10, 20, 30, 40)


def test_verbs_that_take_time_say_how_far_they_are(tmp_path):
    told: dict[str, list[tuple[int, int]]] = {}

    def progress(stage, done, total):
        told.setdefault(stage, []).append((done, total))

    barpc.convert(VIEWS, out_dir=tmp_path / "handoff", progress=progress)
    barpc.ortho(VIEWS[0], tmp_path / "maps", alt=120, gsd=1, progress=progress)
    run = tmp_path / "ties"
    barpc.match(VIEWS[:2], run, points_per_image=300, progress=progress)
    assert all(one.passed for one in barpc.verify(run, progress=progress))
    barpc.fit(VIEWS[0], alt_range=(0, 400), progress=progress)
    assert {"convert", "ortho view_00", "verify outputs", "verify inputs", "match"} <= told.keys()
    assert told["fit"] == [(0, 1), (1, 1)]
    for stage, rows in told.items():
        assert rows[-1][0] == rows[-1][1] > 0, stage
        assert [done for done, _ in rows] == sorted(done for done, _ in rows), stage


# --- who works --------------------------------------------------------------------------------------------


def test_jobs_are_processes_a_cluster_or_the_executor_given(monkeypatch):
    asked = list[Any]()
    monkeypatch.setattr("barpc.pipeline.check", lambda *_, executor, **__: asked.append(executor))
    monkeypatch.setattr("barpc.verbs.workers._processes", lambda jobs: nullcontext(("processes", jobs)))
    monkeypatch.setattr("barpc.verbs.workers._cluster", lambda address: nullcontext(("cluster", address)))
    own: Any = object()
    for how in ({}, {"jobs": 1}, {"jobs": 3}, {"jobs": "tcp://a:1"}, {"executor": own}, {"executor": own, "jobs": 3}):
        barpc.check(VIEWS, **how)
    assert asked == [None, None, ("processes", 3), ("cluster", "tcp://a:1"), own, own]
    for jobs in (0, -2):
        with pytest.raises(InputError, match=f"jobs {jobs}: a number of processes"):
            barpc.check(VIEWS, jobs=jobs)


def test_a_verb_works_in_the_process_that_calls_it_unless_told_otherwise():
    """Processes of its own need a script behind `if __name__ == "__main__":`."""
    verbs = {name: getattr(barpc, name) for name in COMMANDS if name in PUBLIC}
    defaults = {name: inspect.signature(verb).parameters.get("jobs") for name, verb in verbs.items()}
    found = {name: parameter.default for name, parameter in defaults.items() if parameter is not None}
    assert set(found) >= {"adjust", "match", "check", "dsm"}
    assert set(found.values()) == {1}
