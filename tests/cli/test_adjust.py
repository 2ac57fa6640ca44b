"""`barpc adjust` and `check` as a user meets them: results, and one line for what cannot be done."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from tests.geotiffs import write_image
from tests.reliability.conftest import assert_one_line, barpc, hashes
from tests.reliability.trials import SAMPLES

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def offset(said, when):
    """Median of the first pair's epipolar offsets [px] that a run printed."""
    return abs(json.loads(said.out)["pairs"][0][f"epipolar_{when}"]["median"])


def test_the_main_job_writes_what_other_tools_read(crops, tmp_path):
    before, folder = hashes(crops), tmp_path / "out"
    said = barpc("adjust", *crops, "-o", folder)
    assert (said.code, said.err) == (0, "")
    for word in ("; before: ", "view_00.vrt", "The adjustment moved the scene by", "  barpc dsm "):
        assert word in said.out
    names = {path.name for path in folder.iterdir()}
    assert {"view_00.vrt", "view_00_RPC.TXT", "view_01.vrt", "view_01_RPC.TXT", "summary.json"} <= names
    with rasterio.open(folder / "view_00.vrt") as new, rasterio.open(crops[0]) as old:
        assert new.rpcs is not None
        assert new.rpcs.to_dict() != old.rpcs.to_dict()
        np.testing.assert_array_equal(new.read(), old.read())
    assert hashes(crops) == before


@pytest.mark.slow
def test_check_shows_the_same_residuals_and_writes_nothing(crops, ran, tmp_path):
    before = hashes([tmp_path])
    said = barpc("check", *crops, "--json")
    assert said.code == 3  # the crops as delivered disagree
    assert json.loads(said.out)["kind"] == "check"
    assert offset(said, "before") > 5
    assert hashes([tmp_path]) == before
    said = barpc("check", *sorted(ran.glob("out/*.vrt")), "--json")
    assert said.code == 0
    assert offset(said, "before") < 0.03


@pytest.fixture
def twice(ran, tmp_path):
    """Folders of two runs on the crops, whose tie points are kept there."""
    return [
        Path(shutil.copytree(ran / "out/.barpc/cache", tmp_path / name / ".barpc/cache")).parents[1] for name in "ab"
    ]


@pytest.mark.slow
def test_images_can_be_copied_or_left_out_and_formats_chosen(crops, twice, tmp_path):
    said = barpc("adjust", *crops, "-o", twice[0], "--images", "copy", "--rpc-format", "rpb,geom")
    assert said.code == 0, said
    names = {path.name for path in twice[0].iterdir()}
    assert {"view_00.tif", "view_00.RPB", "view_00.geom"} <= names
    assert "view_00_RPC.TXT" not in names
    assert barpc("adjust", *crops, "-o", twice[1], "--images", "none").code == 0
    assert not list(twice[1].glob("*.vrt"))


@pytest.mark.slow
def test_an_existing_folder_needs_overwrite(crops, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/notes.txt").write_text("mine")
    command = ("adjust", *crops, "-o", tmp_path / "out")
    assert_one_line(barpc(*command), 1, "--overwrite")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["notes.txt"]
    assert barpc(*command, "--overwrite").code == 0
    assert (tmp_path / "out/notes.txt").read_text() == "mine"


@pytest.mark.landing(2)
@pytest.mark.slow  # before a commit: what is matched in them, in tests/tie/test_simulated
@pytest.mark.parametrize("kind", ["float32", "uint8", "int16", "uint16 with empty bands"])
def test_pixel_types_and_bands(crops, tmp_path, kind):
    top = {"uint8": 255.0, "float32": 1.0, "int16": 30000.0}.get(kind)
    for path in crops:
        with rasterio.open(path) as image:
            pixels, rpcs = image.read(1).astype(np.float64), image.rpcs
        bands = np.stack([pixels, 0 * pixels, 0 * pixels]) if top is None else pixels / pixels.max() * top
        if kind == "float32":
            bands[:20, :25] = np.nan
        path.unlink()
        write_image(path, bands.astype(kind.split()[0]), rpcs=rpcs)
    said = barpc("adjust", *crops, "-o", tmp_path / "out", "--json")
    assert said.code == 0, said
    assert offset(said, "after") < 0.05


@pytest.mark.slow
def test_options_from_a_file_and_flags_that_win(crops, twice, tmp_path):
    (tmp_path / "run.toml").write_text('images = "none"\n[adjust]\nmodel = "rotation"\n')
    run = ("adjust", *crops, "--options", tmp_path / "run.toml", "--json")
    said = barpc(*run, "-o", twice[0])
    assert said.code == 0, said
    summary = json.loads(said.out)
    assert summary["options"]["adjust"]["model"] == "rotation"
    assert summary["options"]["images"] == "none"
    assert len(summary["views"][0]["correction"]["unknowns"]) == 6  # and a drift
    said = barpc(*run, "-o", twice[1], "--model", "translation")
    assert json.loads(said.out)["options"]["adjust"]["model"] == "translation"


def test_an_output_folder_that_is_a_file(crops, tmp_path):
    (tmp_path / "o").write_text("mine")
    assert_one_line(barpc("adjust", *crops, "-o", tmp_path / "o"), 1, "is a file")
    assert (tmp_path / "o").read_text() == "mine"


def python(*words):
    """A Python of its own: what it says."""
    return subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True, check=False, timeout=600)


def test_help_imports_nothing_heavy():
    code = (
        "import sys\nfrom barpc.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'scipy', 'cv2', 'rasterio', 'matplotlib', 'distributed'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = python("-c", code)
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
    done = python("-c", code)
    assert (done.returncode, done.stdout) == (0, "\n"), done.stderr


def test_in_a_process_of_others_rasterio_has_what_it_looks_for(tmp_path):
    (tmp_path / "boto3.py").write_text("")
    code = f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\nimport barpc.pipeline.run\nimport boto3\n"
    done = python("-c", code)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_warnings_are_not_shown_as_python_sees_them(crops):
    assert issubclass(NotGeoreferencedWarning, UserWarning)
    done = python("-m", "barpc", "info", *crops, "--alt", "0")
    assert done.returncode == 0
    assert "Warning" not in done.stderr


def test_a_foreign_rpc_file_that_would_shadow_the_new_one_is_refused(crops, tmp_path):
    (tmp_path / "o").mkdir()
    shadow = tmp_path / "o/view_00.RPB"
    barpc("convert", crops[0], shadow)
    content = shadow.read_bytes()
    said = barpc("adjust", *crops, "-o", tmp_path / "o", "--overwrite", "--images", "copy")
    assert said.code == 1
    assert "view_00.RPB" in said.err
    assert [path.name for path in (tmp_path / "o").iterdir() if path.suffix in (".tif", ".TXT")] == []
    assert shadow.read_bytes() == content


def test_the_accuracy_stated_in_a_new_rpc_is_what_is_known_now(ran):
    sigma = json.loads((ran / "out/summary.json").read_text())["scene"]["sigma_enu_m"][:2]
    with rasterio.open(ran / "out/view_00.vrt") as image:
        assert image.rpcs.err_bias == pytest.approx(np.sqrt(np.mean(np.square(sigma))), rel=1e-6)
        assert image.rpcs.err_rand == pytest.approx(0.1)


@pytest.mark.slow
def test_adjusted_images_can_be_adjusted_again(crops, ran, tmp_path):
    said = barpc("adjust", *sorted(ran.glob("out/*.vrt")), "-o", tmp_path / "two", "--json")
    assert said.code == 0, said
    assert offset(said, "after") < 0.03
    text = (tmp_path / "two/view_00.vrt").read_text()
    assert str(crops[0].name) in text
    with rasterio.open(tmp_path / "two/view_00.vrt") as new, rasterio.open(crops[0]) as old:
        np.testing.assert_array_equal(new.read(), old.read())


def test_a_dry_run_needs_no_folder_and_a_run_does(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = barpc("adjust", *SAMPLES, "--dry-run")
    assert said.code == 0
    assert said.out.startswith("3 images, 3 pairs to match first: about ")
    assert not list(tmp_path.iterdir())
    said = barpc("adjust", *SAMPLES)
    assert (said.code, "Missing option '-o' / '--out-dir'" in said.err) == (2, True)
