"""`barpc adjust` and `check` as a user meets them: results, and one line for what cannot be done."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from tests.geotiffs import write_image
from tests.reliability.conftest import barpc as command
from tests.reliability.trials import SAMPLES as VIEWS
from tests.reliability.trials import SIDE

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def barpc(*args):
    """Run the command in this process: exit code, stdout, stderr."""
    said = command(*args)
    return said.code, said.out, said.err


def alone(*args):
    """Run the command in a process of its own."""
    words = [sys.executable, "-m", "barpc", *map(str, args)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=3600)
    return done.returncode, done.stdout, done.stderr


def crop(source, target, size=SIDE, *, dtype=None, count=1, change=None, rpc=True, start=300):
    """A crop of a sample with an exact RPC, changed at will."""
    with rasterio.open(source) as image:
        pixels = image.read(1, window=rasterio.windows.Window(start, start, size, size)).astype(np.float64)
        camera = image.rpcs
    camera.samp_off -= start
    camera.line_off -= start
    if change is not None:
        pixels = change(pixels)
    bands = np.stack([pixels] + [np.zeros_like(pixels)] * (count - 1)).astype(dtype or "uint16")
    return write_image(target, bands, rpcs=camera if rpc else None)


@pytest.fixture(scope="module")
def crops(tmp_path_factory):
    folder = tmp_path_factory.mktemp("crops")
    return [crop(path, folder / path.name) for path in VIEWS[:2]]


@pytest.fixture(scope="module")
def hashes(crops):
    """Of the crops before any run."""
    return [sha256(path.read_bytes()).hexdigest() for path in crops]


@pytest.fixture(scope="module")
def ran(crops, hashes, tmp_path_factory):
    """A run on the crops: its folder, and what it printed."""
    out = tmp_path_factory.mktemp("finished") / "out"
    code, told, err = barpc("adjust", *crops, "-o", out)
    assert (code, err) == (0, "")
    return out, told


@pytest.fixture(scope="module")
def finished(ran):
    """The folder of that run, and its summary."""
    return ran[0], json.loads((ran[0] / "summary.json").read_text())


def assert_refused(code, out, err, folder, *words, exit_code=1, kept=False):
    """One clear line, the documented exit code, nothing written."""
    assert code == exit_code, err
    assert out == ""
    assert len(err.strip().splitlines()) == 1, err
    assert err.startswith("barpc: ")
    for word in words:
        assert word in err
    left = {path.name for path in folder.iterdir()} if folder.exists() else set()
    assert not left or (kept and left == {".barpc"})  # of a run that took long: what the next one need not do again


def test_the_main_job_writes_what_other_tools_read(crops, hashes, ran):
    folder, out = ran
    for word in ("; before: ", "view_00.vrt", "The adjustment moved the scene by", "  barpc dsm "):
        assert word in out
    names = sorted(path.name for path in folder.iterdir())
    for name in ("view_00.vrt", "view_00_RPC.TXT", "view_01.vrt", "view_01_RPC.TXT", "summary.json"):
        assert name in names
    with rasterio.open(folder / "view_00.vrt") as new, rasterio.open(crops[0]) as old:
        assert new.rpcs is not None
        assert new.rpcs.to_dict() != old.rpcs.to_dict()
        np.testing.assert_array_equal(new.read(), old.read())
    assert [sha256(path.read_bytes()).hexdigest() for path in crops] == hashes


@pytest.mark.slow
def test_check_shows_the_same_residuals_and_writes_nothing(crops, finished):
    before = sorted(path.name for path in crops[0].parent.iterdir())
    code, out, _ = barpc("check", *crops, "--json")
    assert code == 3  # the crops as delivered disagree
    summary = json.loads(out)
    assert summary["kind"] == "check"
    assert abs(summary["pairs"][0]["epipolar_before"]["median"]) > 5
    assert sorted(path.name for path in crops[0].parent.iterdir()) == before
    code, out, _ = barpc("check", *sorted(finished[0].glob("*.vrt")), "--json")
    assert code == 0
    assert abs(json.loads(out)["pairs"][0]["epipolar_before"]["median"]) < 0.03


@pytest.mark.slow
def test_images_can_be_copied_or_left_out_and_formats_chosen(crops, finished, tmp_path):
    for name in "ab":
        shutil.copytree(finished[0] / ".barpc/cache", tmp_path / name / ".barpc/cache")
    code, _, err = barpc("adjust", *crops, "-o", tmp_path / "a", "--images", "copy", "--rpc-format", "rpb,geom")
    assert code == 0, err
    names = {path.name for path in (tmp_path / "a").iterdir()}
    assert {"view_00.tif", "view_00.RPB", "view_00.geom"} <= names
    assert "view_00_RPC.TXT" not in names
    code, _, _ = barpc("adjust", *crops, "-o", tmp_path / "b", "--images", "none")
    assert code == 0
    assert not list((tmp_path / "b").glob("*.vrt"))
    code, out, err = barpc("adjust", *crops, "-o", tmp_path / "c", "--rpc-format", "doc")
    assert_refused(code, out, err, tmp_path / "c", "doc", "txt, rpb", exit_code=2)


@pytest.mark.slow
def test_an_existing_folder_needs_overwrite(crops, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/notes.txt").write_text("mine")
    code, _, err = barpc("adjust", *crops, "-o", tmp_path / "out")
    assert code == 1
    assert "--overwrite" in err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["notes.txt"]
    code, _, _ = barpc("adjust", *crops, "-o", tmp_path / "out", "--overwrite")
    assert code == 0
    assert (tmp_path / "out/notes.txt").read_text() == "mine"


@pytest.mark.landing(2)
@pytest.mark.slow  # before a commit: what is matched in them, in tests/tie/test_simulated
@pytest.mark.parametrize("kind", ["float32", "uint8", "int16", "uint16 with nan bands"])
def test_pixel_types_and_bands(tmp_path, kind):
    if kind == "uint16 with nan bands":
        images = [crop(p, tmp_path / p.name, count=3) for p in VIEWS[:2]]
    else:
        top = {"uint8": 255.0, "float32": 1.0, "int16": 30000.0}[kind]

        def change(pixels):
            pixels = pixels / pixels.max() * top
            if kind == "float32":
                pixels[:20, :25] = np.nan
            return pixels

        images = [crop(p, tmp_path / p.name, dtype=kind, change=change) for p in VIEWS[:2]]
    code, out, err = barpc("adjust", *images, "-o", tmp_path / "out", "--json")
    assert code == 0, err
    assert abs(json.loads(out)["pairs"][0]["epipolar_after"]["median"]) < 0.05


def test_one_image_alone(crops, tmp_path):
    assert_refused(*barpc("adjust", crops[0], "-o", tmp_path / "o"), tmp_path / "o", "view_00.tif", "at least 2")


def test_no_image_at_all(tmp_path):
    assert_refused(*barpc("adjust", "-o", tmp_path / "o"), tmp_path / "o", "at least 2")


def test_the_same_image_twice(crops, tmp_path):
    copy = shutil.copy(crops[0], tmp_path / "other.tif")
    for twin in (crops[0], copy):
        result = barpc("adjust", crops[0], twin, "-o", tmp_path / "o")
        assert_refused(*result, tmp_path / "o", "the same", Path(twin).name)


def test_an_image_without_rpc(crops, tmp_path):
    bare = crop(VIEWS[1], tmp_path / "bare.tif", rpc=False)
    assert_refused(*barpc("adjust", crops[0], bare, "-o", tmp_path / "o"), tmp_path / "o", "bare.tif", "RPC")


def test_files_that_are_no_images(crops, tmp_path):
    (tmp_path / "text.tif").write_text("hello")
    (tmp_path / "empty.tif").write_bytes(b"")
    for name, word in (("text.tif", "not a raster"), ("empty.tif", "empty"), ("gone.tif", "no such file")):
        result = barpc("adjust", crops[0], tmp_path / name, "-o", tmp_path / "o")
        assert_refused(*result, tmp_path / "o", name, word)


def test_images_that_do_not_overlap(crops, tmp_path):
    far = tmp_path / "far.tif"
    with rasterio.open(crops[1]) as image:
        pixels, camera = image.read(), image.rpcs
    camera.long_off += 1.0
    write_image(far, pixels, rpcs=camera)
    result = barpc("adjust", crops[0], far, "-o", tmp_path / "o")
    assert_refused(*result, tmp_path / "o", "view_00", "far", "overlap")


@pytest.mark.parametrize(
    "what", ["nodata", "constant", pytest.param("noise", marks=[pytest.mark.slow, pytest.mark.costs(4)])]
)
def test_images_that_show_nothing_in_common(crops, tmp_path, what):
    rng = np.random.default_rng(3)
    change = {
        "nodata": lambda pixels: np.zeros_like(pixels),
        "constant": lambda pixels: np.full_like(pixels, 700.0),
        "noise": lambda pixels: rng.uniform(300, 3000, pixels.shape),
    }[what]
    blank = crop(VIEWS[1], tmp_path / "blank.tif", change=change)
    result = barpc("adjust", crops[0], blank, "-o", tmp_path / "o")
    assert_refused(*result, tmp_path / "o", "view_00", "blank", "keypoints", kept=what == "noise")


@pytest.mark.slow
def test_a_bad_file_among_good_ones_is_left_out_with_keep_going(crops, tmp_path):
    (tmp_path / "bad.tif").write_text("hello")
    code, out, err = barpc("adjust", *crops, tmp_path / "bad.tif", "-o", tmp_path / "o", "--keep-going")
    assert code == 3
    assert "bad.tif" in err
    assert "left out" in out
    assert (tmp_path / "o/view_00.vrt").exists()


@pytest.mark.slow
def test_options_from_a_file_and_flags_that_win(crops, finished, tmp_path):
    for name in "ab":
        shutil.copytree(finished[0] / ".barpc/cache", tmp_path / name / ".barpc/cache")
    (tmp_path / "run.toml").write_text('images = "none"\n[adjust]\nmodel = "rotation"\n')
    run = ("adjust", *crops, "--options", tmp_path / "run.toml", "--json")
    code, out, err = barpc(*run, "-o", tmp_path / "a")
    assert code == 0, err
    summary = json.loads(out)
    assert summary["options"]["adjust"]["model"] == "rotation"
    assert summary["options"]["images"] == "none"
    assert len(summary["views"][0]["correction"]["unknowns"]) == 6  # and a drift
    code, out, _ = barpc(*run, "-o", tmp_path / "b", "--model", "translation")
    assert json.loads(out)["options"]["adjust"]["model"] == "translation"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[adjust\n", ("run.toml", "TOML")),
        ("colour = 3\n", ("run.toml", "unknown option 'colour'")),
        ('[adjust]\nmodel = "magic"\n', ("run.toml", "magic", "rotation")),
        ('[tie]\nband = "one"\n', ("run.toml", "band", "whole number")),
        ("tie = 3\n", ("run.toml", "[tie]")),
    ],
)
def test_a_bad_options_file(crops, tmp_path, text, words):
    (tmp_path / "run.toml").write_text(text)
    result = barpc("adjust", *crops, "-o", tmp_path / "o", "--options", tmp_path / "run.toml")
    assert_refused(*result, tmp_path / "o", *words)


def test_wrong_usage_is_exit_code_2_with_a_suggestion(tmp_path):
    code, _, err = barpc("adjust", "--overwrit", "-o", tmp_path / "o")
    assert code == 2
    assert "--overwrite" in err
    code, _, err = barpc("adjsut")
    assert code == 2
    assert "'adjust'" in err


def test_an_output_folder_that_is_a_file(crops, tmp_path):
    (tmp_path / "o").write_text("mine")
    code, _, err = barpc("adjust", *crops, "-o", tmp_path / "o")
    assert code == 1
    assert "is a file" in err
    assert (tmp_path / "o").read_text() == "mine"


def test_help_imports_nothing_heavy():
    code = (
        "import sys\nfrom barpc.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'scipy', 'cv2', 'rasterio', 'matplotlib', 'distributed'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "adjust" in done.stdout


@pytest.mark.parametrize(
    ("command", "unwanted"),
    [
        ("main()", "scipy.linalg scipy.sparse scipy.spatial scipy.special cv2 shapely jinja2 boto3 barpc.ba barpc.tie"),
        (
            "_enter_worker(); import barpc.pipeline.executor, barpc.pipeline.loading",
            "barpc.ba barpc.report.outcome boto3",
        ),
        ("sys.argv[1:] = ['adjust', 'none.tif', 'no.tif', '-o', 'out']; main()", "scipy.spatial scipy.optimize jinja2"),
    ],
    ids=["info", "worker", "adjust"],
)
def test_what_is_not_needed_is_not_loaded(command, unwanted, tmp_path):
    (tmp_path / "boto3.py").write_text("")
    code = (
        f"import sys\nsys.path.append({str(tmp_path)!r})\nsys.argv = ['barpc', 'info', 'none.tif']\n"
        "from barpc.cli import main\nfrom barpc.verbs.workers import _enter_worker\n"
        f"try:\n    {command}\nexcept SystemExit:\n    pass\nimport rasterio\n"
        f"print(*(name for name in {unwanted.split()} if sys.modules.get(name) is not None))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr


def test_in_a_process_of_others_rasterio_has_what_it_looks_for(tmp_path):
    (tmp_path / "boto3.py").write_text("")
    code = f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\nimport barpc.pipeline.run\nimport boto3\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_warnings_are_not_shown_as_python_sees_them(crops):
    assert issubclass(NotGeoreferencedWarning, UserWarning)
    code, _, err = alone("info", *crops, "--alt", "0")
    assert code == 0
    assert "Warning" not in err


def test_a_foreign_rpc_file_that_would_shadow_the_new_one_is_refused(crops, tmp_path):
    (tmp_path / "o").mkdir()
    shadow = tmp_path / "o/view_00.RPB"
    barpc("convert", crops[0], shadow)
    content = shadow.read_bytes()
    code, _, err = barpc("adjust", *crops, "-o", tmp_path / "o", "--overwrite", "--images", "copy")
    assert code == 1
    assert "view_00.RPB" in err
    assert [path.name for path in (tmp_path / "o").iterdir() if path.suffix in (".tif", ".TXT")] == []
    assert shadow.read_bytes() == content


def test_the_accuracy_stated_in_a_new_rpc_is_what_is_known_now(finished):
    folder, summary = finished
    sigma = summary["scene"]["sigma_enu_m"][:2]
    with rasterio.open(folder / "view_00.vrt") as image:
        assert image.rpcs.err_bias == pytest.approx(np.sqrt(np.mean(np.square(sigma))), rel=1e-6)
        assert image.rpcs.err_rand == pytest.approx(0.1)


@pytest.mark.slow
def test_adjusted_images_can_be_adjusted_again(crops, finished, tmp_path):
    code, out, err = barpc("adjust", *sorted(finished[0].glob("*.vrt")), "-o", tmp_path / "two", "--json")
    assert code == 0, err
    assert abs(json.loads(out)["pairs"][0]["epipolar_after"]["median"]) < 0.03
    text = (tmp_path / "two/view_00.vrt").read_text()
    assert str(crops[0].name) in text
    with rasterio.open(tmp_path / "two/view_00.vrt") as new, rasterio.open(crops[0]) as old:
        np.testing.assert_array_equal(new.read(), old.read())


def test_a_dry_run_needs_no_folder_and_a_run_does(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = barpc("adjust", *VIEWS, "--dry-run")
    assert code == 0
    assert out.startswith("3 images, 3 pairs to match first: about ")
    assert not list(tmp_path.iterdir())
    code, _, err = barpc("adjust", *VIEWS)
    assert (code, "Missing option '-o' / '--out-dir'" in err) == (2, True)
