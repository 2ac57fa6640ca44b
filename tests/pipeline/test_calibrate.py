"""Sensors calibrated by finished runs, and runs with a calibration; tie points are given, images are empty."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

import barpc
from barpc.ba.calibration import Line, SensorTies, learn
from barpc.ba.interior import Calibration, LineCurve
from barpc.base.errors import InputError, OutputError
from barpc.base.options import AdjustOptions, RunOptions
from barpc.base.statistics import SURE
from barpc.cameras import open_camera
from barpc.cli import cli
from barpc.pipeline import AdjustResult, adjust
from barpc.pipeline.calibrate import _CalibratedRun, _OnLine, _refuse_unsure, _row_direction
from barpc.pipeline.calibrations import calibrations_of, common_errors, read_calibration
from barpc.pipeline.proof import PASSED_STATES, prove
from barpc.report import Run
from barpc.rpcio.acquisition import read_acquisition
from barpc.scene import Camera
from barpc.sensor.sentinel1 import RangeDoppler, read_annotation
from barpc.simulate import Look
from benchmarks.calibrate import Scene, Sensor, any_looks, parts, scene
from tests.pipeline.known import write_block
from tests.sensor.s1_product import Product

SIZE = (4000, 3000)
RUNS = 5
pytestmark = pytest.mark.filterwarnings("ignore")


def files(made: Scene, folder: Path, sensor: str = "SIM1") -> list[Path]:
    """Write a scene's images, with their metadata, and its tie points."""
    folder.mkdir(parents=True)
    said = {"satellite_id": sensor, "instrument": "PAN", "acquired": "2020-01-01T10:00:00Z"}
    for view in made.views if sensor else ():
        (folder / f"{view.name}_metadata.json").write_text(json.dumps(said))
    return write_block(folder, made.views, made.tracks)


def run(paths: list[Path], out: str = "adjusted", **given: Any) -> AdjustResult:
    folder = paths[0].parent
    # what one block takes for jitter of its own is the sensor's
    options = RunOptions(
        matches=(str(folder / "ties.npz"),), matches_only=True, adjust=AdjustOptions(jitter="off"), **given
    )
    return adjust(paths, folder / out, options)


@pytest.fixture(scope="module")
def line() -> Sensor:
    return Sensor.made("polynomials", 3, chips=4, size=SIZE)


@pytest.fixture(scope="module")
def archive(line: Sensor, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The folders of finished runs of one sensor."""
    place, rng, found = tmp_path_factory.mktemp("archive"), np.random.default_rng(5), []
    for i in range(RUNS):
        paths = files(scene(any_looks(3, rng), line, rng, 300, size=SIZE), place / f"scene{i}")
        run(paths)
        found.append(paths[0].parent / "adjusted")
    return found


@pytest.fixture(scope="module")
def calibration(archive: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("cal") / "SIM1_PAN.cal"
    barpc.calibrate(archive, out)
    return out


def straight(curve: np.ndarray, cols: np.ndarray) -> np.ndarray:
    fit = np.polynomial.polynomial.polyfit(cols, curve, 1)
    return curve - np.polynomial.polynomial.polyval(cols, fit).T


def missed(found: Calibration, line: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """How far a calibration is off the line [px], a column a row, 5 px from its edges; and the truth there."""
    cols = np.arange(5.0, SIZE[0] - 5.0)
    cols = cols[np.abs(cols[:, None] - line.edges).min(axis=1) > 5.0]
    truth = straight(line.curve(cols), cols)
    return straight(found.spline.at(cols), cols) - truth, truth


def rms_of(done: AdjustResult) -> float:
    """The RMS [px] of the tie points in use."""
    return float(np.sqrt((done.adjustment.residuals[done.adjustment.inlier] ** 2).mean()))


@pytest.mark.nightly
def test_runs_tell_the_curve_and_how_well(calibration: Path, archive: list[Path], line: Sensor) -> None:
    found, text = read_calibration(calibration), json.loads(calibration.read_text())
    off, truth = missed(found, line)
    wrong = np.sqrt((off**2).mean(axis=0))
    assert np.linalg.norm(wrong) < 0.2 * np.sqrt((truth**2).sum(axis=1).mean())
    assert np.linalg.norm(wrong) < 2.5 * np.linalg.norm(text["sigma_px"])
    assert np.linalg.norm(text["sigma_px"]) < 0.1
    assert text["sensor"] == "SIM1_PAN"
    assert [one["name"] for one in text["runs"]] == ["adjusted"] * RUNS
    assert len({one["root"] for one in text["runs"]}) == RUNS
    assert sum(one["gain"] > 0 for one in text["runs"]) == RUNS
    assert calibration.stat().st_size < 60_000
    for key, digits in {"coefficients_px": 7, "steps_px": 7, "size_px": 5, "sigma_px": 5, "held_out_noise": 4}.items():
        np.testing.assert_array_equal(text[key], np.round(text[key], digits))


@pytest.mark.nightly
def test_a_run_with_a_calibration_writes_it_and_is_calibrated_again_to_the_same(
    calibration: Path, archive: list[Path], line: Sensor, tmp_path: Path
) -> None:
    """Cameras that were written hold the distortion, once; runs with and without a calibration tell the same curve."""
    rng = np.random.default_rng(11)
    made = scene(any_looks(3, rng), line, rng, 500, size=SIZE)
    paths = files(made, tmp_path / "new")
    plain, with_it = run(paths, "plain"), run(paths, "with", calibration=(str(calibration),))
    assert {one.sensor for one in plain.adjustment.common.of_view} == {"SIM1_PAN"}  # type: ignore[union-attr]
    bends = [one.adjustment.gauge.motion_sigma[7:] for one in (plain, with_it)]  # of a prior, and of what is known
    assert (bends[1] < bends[0]).all()
    assert rms_of(with_it) < 0.9 * rms_of(plain)
    camera, spline = with_it.run.cameras[0], read_calibration(calibration).spline
    ground = made.ground[made.tracks.point[made.tracks.view == 0]]
    seen = camera.project(ground)
    np.testing.assert_allclose(seen - with_it.adjustment.sensors[0].project(ground), spline.at(seen[:, 0]), atol=1e-6)
    grid = open_camera(tmp_path / "new/with/v0_grid.tif").model
    far = np.linalg.norm(grid.project(ground) - seen, axis=1)
    assert np.median(far) < 0.02
    run(paths[:2], "two")
    shutil.copy(calibration, tmp_path / "new" / "SIM1_PAN.cal")  # beside the images it is found
    beside = run(paths, "beside")
    assert set(beside.run.calibrated) == {"v0", "v1", "v2"}
    assert {one.now for one in prove(tmp_path / "new/beside")} <= set(PASSED_STATES)
    assert any(one["path"].endswith("SIM1_PAN.cal") for one in beside.summary["inputs"])
    np.testing.assert_array_equal(beside.adjustment.params, with_it.adjustment.params)
    both = [
        barpc.calibrate([*archive, tmp_path / "new" / name], tmp_path / f"{name}.cal") for name in ("plain", "with")
    ]
    curves = [
        read_calibration(tmp_path / f"{name}.cal").spline.at(np.arange(0.0, 4000.0, 50)) for name in ("plain", "with")
    ]
    assert np.abs(curves[0] - curves[1]).max() < np.linalg.norm(both[0]["sigma_px"])
    with pytest.raises(InputError, match="was made with no calibration"):
        run(paths[2:], "added", add_to=str(tmp_path / "new/two"))


@pytest.mark.nightly
def test_what_is_not_of_the_images_is_refused(calibration: Path, line: Sensor, tmp_path: Path) -> None:
    """A mirrored line, another sensor, and another number of columns."""
    rng = np.random.default_rng(12)
    paths = files(scene(any_looks(3, rng), line, rng, 500, size=SIZE), tmp_path / "new")
    text = json.loads(calibration.read_text())
    signs = np.array(
        [-1.0, 1.0]
    )  # columns count from the other side: their displacements turn round, not those of rows
    steps, coeffs = np.array(text["steps_px"]), np.array(text["coefficients_px"])
    mirrored = {**text, "edges": [3999.0 - e for e in text["edges"][::-1]], "steps_px": (-signs * steps[::-1]).tolist()}
    mirrored["coefficients_px"] = (signs * (coeffs[::-1] + steps.sum(axis=0))).tolist()
    one, other = read_calibration(calibration), tmp_path / "mirrored.cal"
    other.write_text(json.dumps(mirrored))
    cols = np.arange(0.0, 4000.0, 7)
    wanted = signs * one.spline.at(3999.0 - cols)
    np.testing.assert_allclose(read_calibration(other).spline.at(cols), wanted, atol=1e-6)
    with pytest.raises(InputError, match="is not of these images"):
        run(paths, "mirrored", calibration=(str(other),))
    assert not (tmp_path / "new/mirrored/summary.json").exists()
    for change, words in (({"sensor": "SIM2_PAN"}, "no image given is"), ({"columns": 2000}, "of 2000 columns")):
        other.write_text(json.dumps({**text, **change}))
        with pytest.raises(InputError, match=words):
            run(paths, "wrong", calibration=(str(other),))


@pytest.mark.nightly
def test_an_archive_of_parts_tells_the_line_and_a_new_part_is_corrected_by_its_columns(
    line: Sensor, tmp_path: Path
) -> None:
    """RPCs that were moved with their parts state where these lie."""
    rng, runs = np.random.default_rng(8), []

    def part(name: str) -> tuple[Scene, list[Path], Line]:
        made, where = parts(scene(any_looks(3, rng), line, rng, 2500, size=SIZE), rng, 0.7)
        return made, files(made, tmp_path / name), where

    for i in range(6):
        run(paths := part(f"scene{i}")[1])
        runs.append(paths[0].parent / "adjusted")
    barpc.calibrate(runs, tmp_path / "SIM1_PAN.cal")
    found, text = read_calibration(tmp_path / "SIM1_PAN.cal"), json.loads((tmp_path / "SIM1_PAN.cal").read_text())
    assert abs(found.spline.width - SIZE[0]) <= 1
    wrong, _ = missed(found, line)
    assert np.sqrt((wrong**2).mean()) < 0.06
    assert np.linalg.norm(np.sqrt((wrong**2).mean(axis=0))) < 2.5 * np.linalg.norm(text["sigma_px"])
    _, paths, where = part("new")
    shutil.copy(tmp_path / "SIM1_PAN.cal", paths[0].parent)
    done = run(paths)
    starts = [done.run.calibrated[view.name].spline.start for view in done.run.views]
    np.testing.assert_allclose(starts, where.start, atol=1.0)
    (paths[0].parent / "SIM1_PAN.cal").unlink()
    assert rms_of(done) < 0.95 * rms_of(run(paths, "plain"))


@pytest.mark.nightly
def test_the_verb_says_what_it_found_or_why_it_did_not(archive: list[Path], tmp_path: Path) -> None:
    def said(*words: object) -> Result:
        return CliRunner().invoke(cli, ["calibrate", *map(str, words)], standalone_mode=False, obj={"quiet": False})

    first = said(*archive, "-o", tmp_path / "a.cal")
    assert first.return_value == 0
    assert f"of {RUNS} runs left out in turn the residuals of {RUNS} improve" in first.output
    again = said(*archive, "-o", tmp_path / "a.cal")
    assert isinstance(again.exception, OutputError)
    few = said(*archive[:2], "-o", tmp_path / "b.cal")
    assert isinstance(few.exception, InputError)
    assert not (tmp_path / "b.cal").exists()
    one, other = tmp_path / "a.cal", tmp_path / "c.cal"
    assert said(*archive[::-1], "-o", other).return_value == 0  # whatever the order
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.nightly
def test_runs_that_cannot_be_used_are_named(archive: list[Path], tmp_path: Path) -> None:
    out, place = tmp_path / "x.cal", tmp_path / "copy"

    def refused(words: str, *more: Path, sensor: str | None = None) -> None:
        with pytest.raises(InputError, match=words) as caught:
            barpc.calibrate([*archive[:2], *more], out, sensor=sensor)
        assert "\n" not in str(caught.value)
        assert not out.exists()

    def copied(changed: str, text: str | None) -> Path:
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(archive[2], place)
        path = place / changed
        path.unlink() if text is None else path.write_text(text)
        return place

    refused("2 runs given: at least 3")
    refused("is given twice", archive[0])
    refused("no finished run", tmp_path / "nowhere")
    told: list[Any] = []
    with pytest.raises(InputError, match="is given twice"):
        barpc.calibrate([archive[0]] * 3, tmp_path / "a.cal", progress=lambda *now: told.append(now))
    assert told == [(stage, number, 3) for stage in ("open", "read") for number in (1, 2, 3)]
    refused("was changed since", copied("tables/observations.csv", "view,track\n"))
    table = (archive[2] / "tables/observations.csv").read_text()
    refused("was changed since", copied("tables/observations.csv", table[: len(table) // 2]))
    refused("was changed since", copied("tables/residuals.csv", ""))
    refused("is gone since", copied("tables/images.json", None))
    refused("missing", copied("SHA256SUMS", None))
    refused("was changed since", copied("summary.json", '{"schema": "barpc-summary-1"}'))
    refused("is gone since", copied("summary.json", None))
    refused("the images state SIM1_PAN", archive[2], sensor="WV02_P")


def stated(path: Path) -> Camera:
    """The camera of an image as a run loads it, with the sensor that its metadata state."""
    return replace(open_camera(path), sensor=read_acquisition(path).sensor)


def test_errors_are_common_to_images_of_one_sensor_and_width(tmp_path: Path) -> None:
    """Images that state none count as of one; a calibration is in place of the prior."""
    rng = np.random.default_rng(6)
    made = scene(any_looks(3, rng), Sensor.made("waves", 1, size=SIZE), rng, 30, size=SIZE)
    names = [files(made, tmp_path / (name or "none"), name) for name in ("SIM1", "SIM2", "")]
    views = [replace(view, name=f"{i} {view.name}", path=str(path))
             for i, paths in enumerate(names) for view, path in zip(made.views, paths, strict=True)]  # fmt: skip
    views[-1] = replace(views[-1], size=(4001, 3000))
    sources = [stated(Path(view.path)) for view in views]
    own = Calibration.prior("SIM1_PAN", SIZE[0])
    run = Run("adjust", tuple(views), tuple(sources), made.tracks, calibrated={views[0].name: own})
    found = common_errors(run).of_view
    assert found[0] is own
    keys = [one.sha256 for one in found if one is not None]
    assert [keys.index(key) for key in keys] == [0, 0, 0, 3, 3, 3, 6, 6, 8]
    radar = replace(views[1], sensor=RangeDoppler.from_annotation(read_annotation(Product().xml(), name="slc")))
    assert common_errors(replace(run, views=(radar,), sources=tuple(sources[1:2]))).of_view == (None,)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty"),
        ("{", "not JSON"),
        ("[]", "schema None"),
        ('{"schema": "barpc calibration 9"}', "not a calibration that this release reads"),
        ('{"schema": "barpc calibration 1"}', "damaged"),
        (
            '{"schema": "barpc calibration 1", "edges": [2, 1], "steps_px": [[0, 0], [0, 0]], "columns": 9, '
            f'"sensor": "a", "coefficients_px": {[[0.0, 0.0]] * 28}, "covariance_px2": []}}',
            "damaged",
        ),
    ],
)
def test_a_damaged_calibration_is_one_line(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.cal"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_calibration(path)
    assert str(path) in str(caught.value)


def written(path: Path, sensor: str = "SIM1_PAN", **changes: Any) -> Path:
    """A calibration of two edges, whose numbers are random."""
    rng = np.random.default_rng(1)
    root = rng.normal(0, 0.1, (60, 60))
    content = {
        "schema": "barpc calibration 1", "sensor": sensor, "columns": SIZE[0], "edges": [900.5, 2100.5],
        "coefficients_px": rng.normal(0, 0.3, (28, 2)).tolist(), "steps_px": [[0.1, -0.2], [0.3, 0.4]],
        "covariance_px2": (root @ root.T)[np.tril_indices(60)].tolist(),
    }  # fmt: skip
    path.write_text(json.dumps({**content, **changes}))
    return path


def test_a_calibration_is_read_as_it_stands(tmp_path: Path) -> None:
    path = written(tmp_path / "a.cal")
    found, text = read_calibration(path), json.loads(path.read_text())
    assert (found.sensor, found.spline.width, found.path) == ("SIM1_PAN", SIZE[0], str(path))
    for name, key in (("coeffs", "coefficients_px"), ("edges", "edges"), ("steps", "steps_px")):
        np.testing.assert_array_equal(getattr(found.spline, name), text[key])
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    np.testing.assert_array_equal(found.covariance[np.tril_indices(60)], text["covariance_px2"])
    numbers = text["covariance_px2"]
    for changes in (
        {"columns": 4000.0}, {"sensor": 5}, {"coefficients_px": [[0, 0]] * 27}, {"coefficients_px": [[1e3, 0]] * 28},
        {"steps_px": [[0.0, 0.0], [0.0, -1e3]]}, {"edges": [900.5]}, {"covariance_px2": numbers[:-1]},
        {"covariance_px2": [-1.0, *numbers[1:]]}, {"covariance_px2": 0.0}, {"covariance_px2": [0.0] * len(numbers)},
        {"covariance_px2": [n * 1e90 for n in numbers]}, {"covariance_px2": list(map(str, numbers))},
        {"covariance_px2": [numbers[0], numbers[0] * 1.1, *numbers[2:]]}, {"edges": [900.5, 4100.5]},
        {"edges": [-1.0, 2100.5]}, {"edges": ["900.5", "2100.5"]}, {"edges": [2100.5, 900.5]}, {"columns": True},
        {"edges": list(range(3000)), "steps_px": [[0.0, 0.0]] * 3000, "covariance_px2": 0.0}, {"columns": 10**15},
    ):  # fmt: skip
        with pytest.raises(InputError, match=r"a\.cal: damaged \(.*\); make it again"):
            read_calibration(written(path, **changes))
    read_calibration(written(path, coefficients_px=[[999.0, -999.0]] * 28))


@pytest.mark.parametrize("edges", [0, 1, 40, 64])
def test_a_covariance_of_curves_without_constant_and_slope_is_one_with_the_digits_that_are_written(
    edges: int, tmp_path: Path
) -> None:
    curve = LineCurve(SIZE[0], np.linspace(100.5, 3900.5, edges))
    root = curve.bent @ np.random.default_rng(edges).normal(0, 0.1, (2 * curve.size, 20))

    def read(matrix: np.ndarray) -> Calibration:
        steps, lower = [[0.0, 0.0]] * edges, matrix[np.tril_indices(len(matrix))].tolist()
        path = written(tmp_path / "a.cal", edges=curve.edges.tolist(), steps_px=steps, covariance_px2=lower)
        return read_calibration(path)

    for scale in (1e-4, 1.0, 100.0):
        matrix = np.vectorize(lambda value: float(f"{value:.5g}"))(scale * root @ root.T)
        np.testing.assert_array_equal(read(matrix).covariance, matrix)
        matrix[0, 1] = matrix[1, 0] = 1.1 * np.sqrt(matrix[0, 0] * matrix[1, 1])
        with pytest.raises(InputError, match="damaged"):
            read(matrix)


def test_an_image_takes_the_calibration_of_its_sensor_or_of_none(tmp_path: Path) -> None:
    """Given, or beside it under the sensor's name; what states no sensor takes what is given alone."""
    made = scene(any_looks(3, rng := np.random.default_rng(6)), Sensor.made("waves", 1, size=SIZE), rng, 30, size=SIZE)
    paths = [
        files(made, tmp_path / name, sensor)[0] for name, sensor in (("one", "SIM1"), ("two", "SIM2"), ("none", ""))
    ]
    views = [replace(made.views[0], name=path.parent.name, path=str(path)) for path in paths]
    sources = [stated(path) for path in paths]

    def of(*given: Path, some: bool = False) -> dict[str, str]:
        found = calibrations_of([str(path) for path in given], views, sources, some=some)
        return {name: one.path for name, one in found.items()}

    one, other = written(tmp_path / "a.cal"), written(tmp_path / "b.cal", "SIM3_PAN")
    assert of() == {}
    assert of(one) == {"one": str(one), "none": str(one)}
    assert of(one, other, some=True) == {"one": str(one)}
    assert of(other, some=True) == {"none": str(other)}
    with pytest.raises(InputError, match=r"b\.cal: is of SIM3_PAN, and no image given is"):
        of(one, other)
    with pytest.raises(InputError, match=r"c\.cal: another calibration of SIM1_PAN is given"):
        of(one, written(tmp_path / "c.cal"))
    with pytest.raises(InputError, match=r"a\.cal: of a line of 4100 columns, .* is of one of 4000"):
        of(written(one, columns=SIZE[0] + 100))
    beside = written(tmp_path / "two/SIM2_PAN.cal", "SIM2_PAN")
    assert of(written(one)) == {"one": str(one), "two": str(beside), "none": str(one)}
    written(beside)
    with pytest.raises(InputError, match=r"SIM2_PAN\.cal: is of SIM1_PAN, not of SIM2_PAN as its name says"):
        of()


def test_runs_of_one_direction_are_refused_with_the_one_that_is_missing(line: Sensor) -> None:
    """Pairs of one track, all of the same: along their epipolar lines, which are their rows, nothing is told."""
    rng, found = np.random.default_rng(4), []
    for i in range(4):
        made = scene([Look(12.0, 12.0), Look(12.0, 192.0)], line, rng, 250, size=SIZE)
        ties = SensorTies.of(f"run{i}", made.views, made.tracks, made.cameras, made.ground)
        directions = np.array([_row_direction(v, s) for v, s in zip(made.views, made.cameras, strict=True)])
        on_line = _OnLine([0, 1], Line(SIZE[0], np.zeros(2), np.zeros(2)), np.full(2, SIZE[0]))
        found.append(_CalibratedRun(Path(f"run{i}"), "", ties, directions, ("a", "b"), on_line, np.arange(2)))
    assert np.abs(np.concatenate([one.directions for one in found]) - 192.0).max() < 1.0
    learnt = learn([one.ties for one in found])
    with pytest.raises(InputError, match=r"rows run across those of these, near 102 degrees of north are needed"):
        _refuse_unsure("A", learnt, found)
    sure = replace(learnt, covariance=0.0 * learnt.covariance, change=(2, SURE))
    _refuse_unsure("A", replace(sure, gain=np.array([2.0 * SURE, 0.5, 0.6, -1.0])), found)
    for fields, why in (
        ({"gain": np.array([3.0 * SURE, 0.5, -0.1, 0.0])}, "of only 2 of 4 runs left out in turn"),
        ({"gain": np.full(4, SURE / 2.0)}, "of only 4 of 4 runs left out in turn"),
        ({"change": (2, SURE + 0.1)}, f"before {found[2].ties.date}: calibrate"),
    ):
        with pytest.raises(InputError, match=why):
            _refuse_unsure("A", replace(sure, **fields), found)
