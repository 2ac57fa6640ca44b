"""Every option of a run changes what the run does, and as its description says."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio import Affine
from scipy.interpolate import NearestNDInterpolator

from barpc.ba import AdjustOptions, BlockPrior
from barpc.base.errors import FitError, InputError
from barpc.base.geodesy import ground_from_ecef
from barpc.fit import FitOptions
from barpc.pipeline import AdjustResult, RunOptions, adjust
from barpc.pipeline.calibrations import CALIBRATION_SCHEMA
from barpc.tie import TieOptions
from tests.pipeline.known import part
from tests.rasters.test_dem import write_dem, write_geoid

SIDE = 160  # px of an image


class Run:
    """`run(name, gcp=...)`: the three images, matches of the first run unless others are asked for."""

    def __init__(self, scene: Path, out: Path, shared: Run | None) -> None:
        self.scene, self.out, self._shared = scene, out, shared
        self._kept: dict[str, AdjustResult] = {}

    def __call__(self, out: str = "out", matches: str | None = "first/matches.csv", **options: Any) -> AdjustResult:
        given = () if matches is None else str(self.scene / matches)
        images = options.pop("given", sorted(self.scene.glob("*.tif")))
        options = {"matches_only": matches is not None, **options}
        return adjust(images, self.out / out, RunOptions(matches=given, **options))

    def once(self, name: str, *given: Any, **options: Any) -> AdjustResult:
        """The same run for all tests of the module."""
        assert self._shared is not None
        kept = self._shared._kept
        if name not in kept:
            kept[name] = self._shared(name, *given, **options)
        return kept[name]

    @property
    def plain(self) -> AdjustResult:
        """The run without any option; its files: `folder`."""
        return self.once("plain")

    @property
    def folder(self) -> Path:
        """The files of the plain run."""
        return Path(self.plain.run.out_dir)

    @property
    def matched(self) -> AdjustResult:
        """The run that only matches."""
        return self.once("matched", None, stop_after="matching")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three small images, GCPs; a first run's matches; the terrain that it shows, 15 m higher, and a geoid of 40 m."""
    folder = tmp_path_factory.mktemp("scene") / "in"
    folder.mkdir()
    images = part(folder, SIDE, 240, gcps=4).images
    adjust(images, folder / "first", RunOptions(stop_after="matching"))
    first = RunOptions(matches_only=True, matches=str(folder / "first/matches.csv"), stop_after="adjustment")
    adjust(images[:2], folder / "earlier", first)
    (folder / "dem").mkdir()
    _write_terrain(folder / "dem/a.tif", adjust(images, folder / "shown", first))
    flat = np.full((200, 200), 300.0, np.float32)
    write_dem(folder / "dem/flat.tif", "EPSG:4326+5773", flat, transform=Affine(1e-3, 0, 5.3, 0, -1e-3, 43.4))
    write_geoid(folder / "dem/g.gtx", 40.0)
    return folder


def _write_terrain(path: Path, shown: AdjustResult) -> None:
    """What tie points show, 25 m lower, on a grid of a few metres around them."""
    points = shown.adjustment.points
    ground = ground_from_ecef(points[np.isfinite(points[:, 0])])
    low, high = ground[:, :2].min(axis=0) - 1e-3, ground[:, :2].max(axis=0) + 1e-3
    lon, lat = (np.arange(a, b, 2e-5) for a, b in zip(low, high, strict=True))
    nodes = np.stack(np.meshgrid(lon, lat[::-1]), axis=-1)
    heights = NearestNDInterpolator(ground[:, :2], ground[:, 2] - 25.0)(nodes).astype(np.float32)
    step = Affine(2e-5, 0, lon[0] - 1e-5, 0, -2e-5, lat[-1] + 1e-5)
    write_dem(path, "EPSG:4326+5773", heights, transform=step)


@pytest.fixture(scope="module")
def shared(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return Run(scene, tmp_path_factory.mktemp("shared"), None)


@pytest.fixture
def run(scene: Path, tmp_path: Path, shared: Run) -> Run:
    return Run(scene, tmp_path, shared)


def stop_after(run: Run, out: Path, scene: Path) -> None:
    matched = Path(run.matched.run.out_dir)
    assert (matched / "matches.csv").exists()
    assert not (matched / "tables/block.npz").exists()
    run("a", stop_after="adjustment")
    assert (out / "a/tables/block.npz").exists()
    assert not list((out / "a").glob("*.vrt"))
    assert list(run.folder.glob("*.vrt"))


def keep_going(run: Run, out: Path, scene: Path) -> None:
    (out / "bad.tif").write_bytes(b"no image")
    given = [*sorted(scene.glob("*.tif")), out / "bad.tif"]
    with pytest.raises(Exception, match=r"bad\.tif"):
        run("a", given=given)
    found = run("b", given=given, keep_going=True, stop_after="adjustment")
    assert [Path(row["path"]).name for row in found.summary["left_out"]] == ["bad.tif"]
    assert not found.passed
    hard = FitOptions(tolerance=1e-15)
    with pytest.raises(FitError, match="view_00"):
        run("c", fit=hard)
    assert not run("d", fit=hard, keep_going=True).passed
    assert list((out / "d").glob("*.vrt"))


def matches_only(run: Run, out: Path, scene: Path) -> None:
    rows = (scene / "first/matches.csv").read_text().splitlines()
    (scene / "fewer.csv").write_text("\n".join(rows[: len(rows) // 2]) + "\n")
    few, many = run("a", "fewer.csv", stop_after="adjustment"), run.plain
    assert 0 < len(few.tracks) < len(many.tracks)
    assert len(few.run.matched) == 0


def altimetry(run: Run, out: Path, scene: Path) -> None:
    """The tie points' own surface, 12 m higher."""
    free = run.plain
    ground = ground_from_ecef(free.adjustment.points)
    ground = ground[np.isfinite(ground).all(axis=1)]
    rows = [f"{lon:.9f},{lat:.9f},{alt + 12.0:.3f},0.2,0" for lon, lat, alt in ground]
    (scene / "heights.csv").write_text("\n".join(["lon,lat,alt,sigma,sigma_flat", *rows]))
    held = run("b", altimetry=(str(scene / "heights.csv"),), stop_after="adjustment")
    told = held.summary["scene"]["altimetry"]
    assert free.summary["scene"].get("altimetry") is None
    assert told["num_given"] == len(rows)
    assert told["why_not"] == ""
    assert held.summary["scene"]["sigma_enu_m"][2] < 0.1 * free.summary["scene"]["sigma_enu_m"][2]
    ups = [one.summary["scene"]["shift_enu_m"][2] for one in (held, free)]
    assert 11.0 < ups[0] - ups[1] < 13.0


def gcp_crs(run: Run, out: Path, scene: Path) -> None:
    """Points on a map hold the block as those in degrees do, the reference system said; unsaid they are refused."""
    known = json.loads((scene / "gcps.geojson").read_text(encoding="utf-8"))
    to_map = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32631", always_xy=True).transform
    for feature in known["features"]:
        place = feature["geometry"]["coordinates"]
        place[:2] = to_map(*place[:2])
    path = out / "map.geojson"
    path.write_text(json.dumps(known), encoding="utf-8")
    degrees = run("b", gcp=(str(scene / "gcps.geojson"),), stop_after="adjustment")
    metres = run("c", gcp=(str(path),), gcp_crs="EPSG:32631", stop_after="adjustment")
    np.testing.assert_allclose(metres.adjustment.params, degrees.adjustment.params, atol=1e-4)
    with pytest.raises(InputError, match="map coordinates"):
        run("d", gcp=(str(path),))


def add_to(run: Run, out: Path, scene: Path) -> None:
    free, held = run.plain, run("b", add_to=str(scene / "earlier"), stop_after="adjustment")
    assert 0 < len(held.tracks) < len(free.tracks)
    before = BlockPrior.load(scene / "earlier/tables/block.npz")
    rows = [held.adjustment.names.index(name) for name in before.names]
    np.testing.assert_array_equal(held.adjustment.params[rows], before.params)


def update(run: Run, out: Path, scene: Path) -> None:
    together = run("c", add_to=str(scene / "earlier"), update=True, stop_after="adjustment")
    np.testing.assert_allclose(together.adjustment.params, run.plain.adjustment.params, atol=0.2)


def _height(found: AdjustResult) -> float:
    points = found.adjustment.points
    return float(np.median(ground_from_ecef(points[np.isfinite(points[:, 0])])[:, 2]))


TIGHT = AdjustOptions(dem_sigma=2.0, dem_bias_sigma=0.01)


def _held(run: Run) -> AdjustResult:
    """The scene held to the terrain's heights."""
    given = {"dem": str(run.scene / "dem/a.tif"), "geoid": str(run.scene / "dem/g.gtx")}
    return run.once("held", adjust=TIGHT, stop_after="adjustment", **given)


def _far(folder: Path) -> str:
    """A DEM that says nothing of its heights, at another place."""
    where = Affine(0.01, 0, 100, 0, -0.01, 10)
    folder.mkdir(parents=True, exist_ok=True)
    return str(write_dem(folder / "far.tif", 4326, np.zeros((9, 9), np.float32), transform=where))


def dem(run: Run, out: Path, scene: Path) -> None:
    held = _held(run)
    assert held.summary.get("reference") is None  # a terrain alone is none
    assert _height(held) - _height(run.plain) == pytest.approx(15.0, abs=1.5)
    more = run("two", adjust=TIGHT, stop_after="adjustment", dem=(_far(out), str(scene / "dem/a.tif")), geoid="none")
    alone = run("one", adjust=TIGHT, stop_after="adjustment", dem=str(scene / "dem/a.tif"), geoid="none")
    assert _height(more) == pytest.approx(_height(alone) + 49.0, abs=4.0)  # of two each counts from what it names
    assert [Path(path).name for path in more.summary["options"]["dem"]] == ["far.tif", "a.tif"]
    with pytest.raises(InputError):
        run("c", dem=str(out / "nowhere.tif"))


@pytest.mark.filterwarnings("ignore::barpc.base.errors.BarpcWarning")
def geoid(run: Run, out: Path, scene: Path) -> None:
    with_geoid = _held(run)
    given = {"adjust": TIGHT, "dem": str(scene / "dem/a.tif"), "stop_after": "adjustment"}
    none, own = run("b", geoid="none", **given), run("c", **given)
    assert _height(with_geoid) - _height(none) == pytest.approx(40.0, abs=4.0)
    assert _height(own) - _height(none) == pytest.approx(49.0, abs=4.0)  # EGM96's here, which the terrain names


def heights(run: Run, out: Path, scene: Path) -> None:
    """What nothing says it for: a file that names its geoid keeps that, and a person's word on a DEM's comes first."""
    with rasterio.open(scene / "dem/a.tif") as file:
        unsaid = write_dem(scene / "dem/unsaid.tif", "EPSG:4326", file.read(1), transform=file.transform)
    given = {"adjust": TIGHT, "dem": str(unsaid), "stop_after": "adjustment"}
    none, sea, mine = (run(f"h{k}", **more, **given) for k, more in enumerate(HEIGHTS))
    assert _height(sea) - _height(none) == pytest.approx(49.0, abs=4.0)
    assert _height(mine) == pytest.approx(_height(none), abs=0.1)
    assert not any("--heights" in reason for found in (none, sea, mine) for reason in found.summary["reasons"])


HEIGHTS = {"heights": "ellipsoidal"}, {"heights": "egm96"}, {"heights": "egm96", "geoid": "none"}


def _referred(run: Run, sigma: float | None) -> AdjustResult:
    """With the terrain for a reference: it shows nothing of what the images show."""
    dem, geoid = str(run.scene / "dem/flat.tif"), str(run.scene / "dem/g.gtx")
    given = {"dem": dem, "geoid": geoid, "reference": (dem,), "reference_sigma": sigma}
    return run.once(f"reference {sigma}", stop_after="adjustment", **given)


def reference(run: Run, out: Path, scene: Path) -> None:  # what it does to a block: test_reference
    found = _referred(run, None)
    assert found.summary["reference"]["used"] is False
    assert any("does not show" in reason for reason in found.summary["reasons"])
    assert run.plain.summary.get("reference") is None


def reference_sigma(run: Run, out: Path, scene: Path) -> None:
    sigmas = [_referred(run, size).summary["reference"]["sigma_m"] for size in (None, 7.0)]
    assert sigmas == [pytest.approx(0.25 * 111.0, rel=0.3), 7.0]  # a quarter of its pixel


def tie(run: Run, out: Path, scene: Path) -> None:
    few = run("a", None, stop_after="matching", tie=TieOptions(points_per_image=80))
    assert 0 < len(few.tracks) < 0.7 * len(run.matched.tracks)


def adjust_(run: Run, out: Path, scene: Path) -> None:
    found = run("a", adjust=AdjustOptions(model="rotation"), stop_after="adjustment")
    assert found.adjustment.params.shape[1] == 6  # and a drift


def fit(run: Run, out: Path, scene: Path) -> None:
    found = run("a", fit=FitOptions(grid=(5, 6, 4)))
    assert {fitted.num_cnp for fitted in found.run.fits} == {120}


def calibration(run: Run, out: Path, scene: Path) -> None:  # what it does: test_calibrate
    width, path = 1001, scene / "line.cal"  # of the images that these are parts of
    text = {"schema": CALIBRATION_SCHEMA, "sensor": "A", "columns": width, "edges": [], "steps_px": []}
    text |= {
        "coefficients_px": [[0.0, 0.0]] * 28,
        "covariance_px2": [1e-4 * (i == j) for i in range(56) for j in range(i + 1)],
    }
    path.write_text(json.dumps(text))
    with pytest.raises(InputError, match="1001 columns are no whole line of a sensor"):
        run("b", calibration=str(path))
    with patch("barpc.rpcio.line.LEAST_LINE", 1000):
        found = run("b", calibration=str(path), stop_after="adjustment")
    np.testing.assert_allclose(found.adjustment.params, run.plain.adjustment.params, atol=1e-9)
    # of a sensor without one the prior of its distortion is wider
    assert (found.adjustment.covariance.variances() < run.plain.adjustment.covariance.variances()).all()
    path.write_text(json.dumps(text | {"columns": width + 100}))
    with (
        patch("barpc.rpcio.line.LEAST_LINE", 1000),
        pytest.raises(InputError, match=f"a line of {width + 100} columns"),
    ):
        run("c", calibration=str(path))


ROWS = {
    row.__name__.rstrip("_"): row
    for row in (
        matches_only, stop_after, keep_going, add_to, update, gcp_crs, heights, dem, geoid, altimetry, calibration,
        reference_sigma, reference, tie, adjust_, fit,
    )
}  # fmt: skip


ELSEWHERE = {
    "images": "cli/test_adjust.py::test_images_can_be_copied_or_left_out_and_formats_chosen",
    "rpc_formats": "cli/test_adjust.py::test_images_can_be_copied_or_left_out_and_formats_chosen",
    "overwrite": "cli/test_adjust.py::test_an_existing_folder_needs_overwrite",
    "grids": "pipeline/test_grids.py::test_a_run_with_everything_is_told_and_the_same_whatever_the_workers",
    "matches": "pipeline/test_given.py::test_noisy_matches_of_real_images_become_as_exact_as_our_own",
    "overlap_list": "pipeline/test_pairs_and_area.py::test_only_the_listed_pairs_are_matched_and_only_in_the_area",
    "aoi": "pipeline/test_pairs_and_area.py::test_only_the_listed_pairs_are_matched_and_only_in_the_area",
    "gcp": "pipeline/test_inputs.py::test_control_points_put_the_scene_in_its_place",
    "check_points": "pipeline/test_inputs.py::test_check_points_are_measured_and_not_used",
    "allow_remote": "remote/test_remote.py::test_without_leave_nothing_is_asked",
}
"""Options of which another test shows all that a row would."""


def test_every_option_has_a_row_or_a_test_elsewhere() -> None:
    assert sorted([*ROWS, *ELSEWHERE]) == sorted(field.name for field in fields(RunOptions))
    for place in ELSEWHERE.values():
        file, _, test = place.partition("::")
        assert f"def {test}(" in (Path(__file__).parents[1] / file).read_text(encoding="utf-8"), place


LATER = "geoid", "dem", "keep_going", "reference", "tie"
"""Options whose fast tests stand in tests/rasters/test_dem, tests/tie and tests/reliability, or beside them:
matches_only, reference_sigma."""


SLOW = "calibration", "gcp_crs", "reference_sigma", "stop_after", "altimetry", "fit", "add_to", "update"
"""Options that take a run or two of their own: the landing check tries them."""


@pytest.mark.landing(5)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.nightly] * (name in LATER) + [pytest.mark.slow] * (name in SLOW))
        for name in ROWS
    ],
)
def test_an_option_does_what_it_says(name: str, run: Run, tmp_path: Path, scene: Path) -> None:
    before = {path.name: path.read_bytes() for path in scene.iterdir() if path.is_file()}
    ROWS[name](run, tmp_path, scene)  # asserts what the option does
    after = {path.name: path.read_bytes() for path in scene.iterdir() if path.is_file()}
    assert {name: after.get(name) for name in before} == before  # and none of them touches an input


@pytest.mark.slow
def test_a_result_prints_its_counts(run: Run) -> None:
    found = run("a" * 200, stop_after="adjustment")
    assert len(repr(found)) < 150
    assert repr(found).startswith(f"AdjustResult(adjust: 3 views, {found.tracks.num_points} tie points, ")
    assert found.summary["status"] in repr(found)
    used = int(found.adjustment.inlier.sum())
    said = f"Adjustment(3 views, {found.tracks.num_points} tie points, {used} of {len(found.tracks)} observations: "
    assert repr(found.adjustment).startswith(said)
    assert len(repr(found.adjustment)) < 250
    assert repr(found.record) == f"Summary(adjust of 3 views, {found.record.status}: {found.record.headline})"
