"""What `fit`, `check`, `report`, `adjust` and `export` say and return, with their work done by stand-ins."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from barpc.base.options import FitOptions
from barpc.base.verb_options import ExportOptions
from barpc.export import targets
from barpc.rpcio import write_rpc
from barpc.verbs import fitting, runs
from tests.cli.test_main import run
from tests.reliability.conftest import assert_one_line, barpc
from tests.report.made import a_summary
from tests.rpcio.conftest import make_rpc

# --- fit --------------------------------------------------------------------------------------------------


def a_fit(**changes: Any) -> Any:
    usual = {
        "method": "ridge", "iterations": 4, "h": (1e-6, 0.25), "num_cnp": 1000, "num_ckp": 500, "coverage": 0.985,
        "rmse_cnp": (1e-3, 2e-3), "max_cnp": (3e-3, 4e-3), "rmse_ckp": (5e-3, 6e-3), "max_ckp": (7e-3, 8e-3),
        "beyond": 0.0123, "min_denominator": 0.9, "roundtrip": 1e-9,
        "contradiction": 3e-9, "few": "",
    }  # fmt: skip
    return SimpleNamespace(**{**usual, **changes})


@pytest.fixture
def source(tmp_path: Path) -> str:
    write_rpc(make_rpc(), tmp_path / "a.RPB")
    return f"{tmp_path / 'a.RPB'},size=600:500"


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """What every fit is asked for (size, altitudes, options), and what may be put in the place of camera and fit."""
    stand = SimpleNamespace(asked=[], fit=fitting.fit_rpc, camera=None)

    def fit_rpc(model: Any, size: Any, alts: Any, *, options: Any, strict: bool) -> Any:
        stand.asked.append((size, tuple(alts), options, strict))
        return stand.fit(model, size, alts, options=options, strict=strict)

    real = fitting.open_camera
    monkeypatch.setattr(fitting, "fit_rpc", fit_rpc)
    monkeypatch.setattr(fitting, "open_camera", lambda source: stand.camera or real(source))
    return stand


def test_a_certificate_has_a_figure_in_every_line(
    source: str, fits: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    fits.fit = lambda *_, **__: a_fit(verdict=lambda tolerance: "")
    assert run("fit", source) == 0
    assert capsys.readouterr().out.splitlines() == [
        "method        ridge, 4 passes, h 1e-06 0.25",
        "points        1000 control, 500 check, 98% of the image covered",
        "              col [px]     row [px]",
        "control rmse  0.001        0.002",
        "control max   0.003        0.004",
        "check rmse    0.005        0.006",
        "check max     0.007        0.008",
        "beyond        1.23% of the image at most may have larger errors (95 % confidence)",
        "denominators  at least 0.9 of their value at the centre, over the ground and a margin",
        "round trip    1e-09 px; the camera's own 3e-09",
        "verdict       within tolerance",
    ]
    fits.fit = lambda *_, **__: a_fit(beyond=1.0, verdict=lambda tolerance: "it misses")
    assert run("fit", source) == 3
    given = capsys.readouterr().out.splitlines()
    assert not any(line.startswith("beyond") for line in given)
    assert given[-1] == "verdict       it misses"


def test_a_fit_measures_writes_and_is_quiet_when_told(
    source: str, tmp_path: Path, fits: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("fit", source) == 0
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == "verdict       within tolerance"
    assert said.err == ""
    (size, alts, options, strict) = fits.asked[0]
    assert (size, strict, options.tolerance) == ((600, 500), False, FitOptions().tolerance)
    assert alts == pytest.approx((166.6667 - 142.8571, 166.6667 + 142.8571))
    out = tmp_path / "b.geom"
    assert run("-q", "fit", source, "-o", str(out), "--alt-range", "10", "400", "--tolerance", "0.5") == 0
    assert capsys.readouterr().out == ""
    assert out.is_file()
    assert fits.asked[1][1] == (10.0, 400.0)
    assert fits.asked[1][2].tolerance == 0.5
    assert run("fit", source, "-o", str(out)) == 1
    assert run("fit", source, "-o", str(out), "--overwrite") == 0
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == f"written       {out} (read back: these are its figures)"
    assert run("fit", source, "-o", str(tmp_path / "a.RPB"), "--overwrite") == 1


def test_a_miss_writes_nothing_unless_told_to(source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "b.geom"
    words = ("fit", source, "-o", str(out), "--tolerance", "1e-15")
    assert run(*words) == 3
    said = capsys.readouterr()
    assert said.err.endswith("; nothing written (--keep-going writes it all the same)\n")
    assert "written  " not in said.out
    assert not out.exists()
    assert run(*words, "--json") == 3
    assert json.loads(capsys.readouterr().out)["output"] is None
    assert run(*words, "--keep-going", "--json") == 3
    said = capsys.readouterr()
    assert said.err.endswith("; written all the same\n")
    assert json.loads(said.out)["output"] == str(out)
    assert json.loads(said.out)["verdict"] != ""
    assert out.is_file()


@pytest.mark.parametrize(("wide", "count"), [("", 1), ("too far", 2)])
def test_all_ground_on_earth_is_tried_first_where_a_camera_asks_for_it(
    wide: str, count: int, source: str, fits: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    everywhere, own = (-500.0, 9000.0), (1.0, 200.5)
    usable = {"doubts": (), "require_usable": lambda _: None}
    model = SimpleNamespace(all_ground=everywhere)
    fits.camera = SimpleNamespace(model=model, extent=(5, 5), size=(5, 5), alt_range=own, **usable)
    fits.fit = lambda model, size, alts, **_: a_fit(verdict=lambda tolerance: wide if alts == everywhere else "")
    assert run("fit", source) == 0
    assert [alts for _, alts, *_ in fits.asked] == [everywhere, own][:count]
    error = capsys.readouterr().err
    assert ("fitted over the scene's altitudes, 1 to 200.5 m" in error) == (count == 2)
    fits.asked.clear()
    assert run("fit", source, "--alt-range", "0", "9") == 0
    assert run("fit", f"{source},swath=MOSAIC") == 0
    assert [alts for _, alts, *_ in fits.asked][:2] == [(0.0, 9.0), everywhere]
    assert fits.asked[-1][2].grid == (20, 20, 10) != fits.asked[0][2].grid


# --- check, report, adjust --------------------------------------------------------------------------------


def test_the_summary_of_one_run_is_not_printed_again() -> None:
    assert_one_line(barpc("report", "one", "--json"), 2, "--json goes with two runs")


@pytest.fixture
def result(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """What `barpc check` finds."""
    found = SimpleNamespace(summary={"a": 1}, record=a_summary([], verdict=("One.",)), passed=True, root="")
    monkeypatch.setattr(runs, "check", lambda *_, **__: found)
    return found


@pytest.mark.parametrize(
    ("flags", "out"), [((), "All well.\nOne.\n"), (("-q",), ""), (("-q", "--json"), '{\n "a": 1\n}\n')]
)
def test_a_result_is_printed_once_and_its_exit_code_says_whether_it_passes(
    flags: tuple[str, ...], out: str, result: SimpleNamespace, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("check", "a.tif", *flags) == 0
    assert capsys.readouterr() == (out, "")
    result.passed, result.record = False, a_summary([], verdict=("One.",), reasons=("One.",), passed=False)
    out = out.replace("well.", "well (exit code 3).")
    assert run("check", "a.tif", *flags) == 3
    headline = "" if flags else "All well. "
    assert capsys.readouterr() == (out, f"barpc: needs review (exit code 3): {headline}One.\n")


# --- export -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("target", "vrt", "told"), [("s2p", True, True), ("s2p", False, False), ("points", True, False)]
)
def test_an_export_names_its_files_and_says_where_images_stay(
    target: str, vrt: bool, told: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    if vrt:
        (tmp_path / "a.vrt").touch()
    asked = list[Any]()
    monkeypatch.setattr(targets, "export_run", lambda *a, **k: asked.append((a, k)) or [Path("x"), Path("y")])
    words = ("export", str(tmp_path), "out", "--to", target)
    assert run(*words) == 0
    said = capsys.readouterr()
    assert said.out == "x\ny\n"
    assert ("the images are not copied" in said.err) == told
    assert run(*words, "--json", "--overwrite", "--alt", "80", "320") == 0
    said = capsys.readouterr()
    assert (json.loads(said.out), said.err) == (["x", "y"], "")
    assert asked == [
        ((str(tmp_path), target, "out", ExportOptions()), {}),
        ((str(tmp_path), target, "out", ExportOptions(alt=(80.0, 320.0), overwrite=True)), {}),
    ]
