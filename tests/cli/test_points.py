"""Tables of points: every form in which they come in, and how they go out to the last digit."""

from __future__ import annotations

import io
import json
from pathlib import Path

import click
import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.cli.project import given_points
from barpc.rpcio import write_rpc
from barpc.sensor.rpc import RPC
from tests.cli.test_info import tilted
from tests.cli.test_main import run
from tests.rasters.test_dem import write_dem
from tests.rpcio.conftest import make_rpc

XYZ = ("lon", "lat", "alt")


def table(tmp_path: Path, text: str, fill: float | None = None, names: tuple[str, ...] = XYZ) -> list[list[float]]:
    (tmp_path / "t.csv").write_text(text)
    return given_points((), str(tmp_path / "t.csv"), names, fill).tolist()


# --- what comes in ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("numbers", "fill", "rows"),
    [
        ((1, 2, 3), None, [[1, 2, 3]]),
        ((1, 2, 3, 4, 5, 6), None, [[1, 2, 3], [4, 5, 6]]),
        ((1, 2), 9.0, [[1, 2, 9]]),
        ((1, 2, 3, 4), 9.0, [[1, 2, 9], [3, 4, 9]]),
    ],
)
def test_numbers_are_points_one_behind_the_other(
    numbers: tuple[float, ...], fill: float | None, rows: list[list[float]]
) -> None:
    assert given_points(numbers, None, XYZ, fill).tolist() == rows


@pytest.mark.parametrize(
    ("numbers", "fill", "told"),
    [((), None, "0 numbers; give LON LAT ALT of"), ((1, 2, 3, 4), None, "4 numbers; give LON LAT ALT of"),
     ((1, 2), None, "2 numbers; give LON LAT ALT of"),
     ((), 0.0, "0 numbers; give LON LAT of"), ((1, 2, 3), 0.0, "3 numbers; give LON LAT of")],
)  # fmt: skip
def test_numbers_that_are_no_whole_points_are_wrong_usage(
    numbers: tuple[float, ...], fill: float | None, told: str
) -> None:
    with pytest.raises(click.UsageError, match=f"^{told} each point, or --points FILE$"):
        given_points(numbers, None, XYZ, fill)


@pytest.mark.parametrize(
    ("text", "fill", "rows"),
    [
        ("1,2,3\n4,5,6\n", None, [[1, 2, 3], [4, 5, 6]]),
        ("1 2\t3", None, [[1, 2, 3]]),
        ("1,2,3,99\n", None, [[1, 2, 3]]),
        ("ALT, Lon ,lat\n3,1,2\n", None, [[1, 2, 3]]),
        ("lon lat alt # heads\n# nothing\n\n1 2 3 # here\n", None, [[1, 2, 3]]),
        ('"name","lon","lat","alt"\n"a,b",1,2,3\n', None, [[1, 2, 3]]),
        ("lon,lat\n1,2\n", 7.0, [[1, 2, 7]]),
        ("lat,lon\n2,1\n", 7.0, [[1, 2, 7]]),
        ("1,2\n3,4,5\n", 7.0, [[1, 2, 7], [3, 4, 5]]),
        ("lon,lat,alt\n1,2\n3,4,5\n", 7.0, [[1, 2, 7], [3, 4, 5]]),
        ("-1e1,+2.5,.5", None, [[-10, 2.5, 0.5]]),
        ("", None, []),
        ("lon,lat,alt\n", None, []),
    ],
)
def test_a_table_has_a_header_or_its_columns_in_order(
    text: str, fill: float | None, rows: list[list[float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert table(tmp_path, text, fill) == rows
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    assert given_points((), "-", XYZ, fill).tolist() == rows


@pytest.mark.parametrize(
    ("text", "fill", "told"),
    [
        ("lon,lat\n1,2\n", None, "columns lon, lat, alt expected, found lon, lat"),
        ("lon,alt\n1,2\n", 7.0, "columns lon, lat, alt expected, found lon, alt"),
        ("x,y,z\n1,2,3\n", None, "columns lon, lat, alt expected, found x, y, z"),
        ("1,2,3\n1,x,3\n", None, "point 2: 'x' is no number"),
        ("1,2,3\n4,5\n", None, "point 2 has 2 columns, expected lon, lat, alt"),
        ("1\n", 7.0, "point 1 has 1 columns, expected lon, lat, alt"),
        ("lon,lat,alt\n1,2,\n", 7.0, "point 1: '' is no number"),
    ],
)
def test_a_table_that_lacks_something_says_what(text: str, fill: float | None, told: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        table(tmp_path, text, fill)
    assert str(error.value) == f"{tmp_path / 't.csv'}: {told}"


# --- the verbs --------------------------------------------------------------------------------------------


@pytest.fixture
def rpc_file(tmp_path: Path) -> tuple[Path, RPC]:
    write_rpc(make_rpc(), tmp_path / "a.RPB")
    return tmp_path / "a.RPB", make_rpc()


def rows(text: str) -> np.ndarray:
    return np.array([[float(cell) for cell in line.split(",")] for line in text.splitlines()[1:]])


def test_project_prints_six_digits_and_takes_an_altitude_for_all(
    rpc_file: tuple[Path, RPC], capsys: pytest.CaptureFixture[str]
) -> None:
    file, rpc = rpc_file
    assert run("project", str(file), "5.4", "43.2", "5.401", "43.201", "--alt", "120") == 0
    told = capsys.readouterr().out
    expected = rpc.project([[5.4, 43.2, 120.0], [5.401, 43.201, 120.0]])
    np.testing.assert_allclose(rows(told), expected, atol=6e-7)
    assert all(len(cell.partition(".")[2]) == 6 for line in told.splitlines()[1:] for cell in line.split(","))


def test_localize_prints_ten_digits_of_degrees_and_four_of_metres(
    rpc_file: tuple[Path, RPC], capsys: pytest.CaptureFixture[str]
) -> None:
    file, rpc = rpc_file
    assert run("localize", str(file), "-12.25", "700.5", "--alt", "-3") == 0
    told = capsys.readouterr()
    expected = rpc.localize([-12.25, 700.5], -3.0)
    np.testing.assert_allclose(rows(told.out)[0], expected, atol=6e-11)
    assert [len(cell.partition(".")[2]) for cell in told.out.splitlines()[1].split(",")] == [10, 10, 4]
    assert told.err == ""


def test_altitudes_of_a_table_count_and_the_others_are_the_one_given(
    rpc_file: tuple[Path, RPC], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file, rpc = rpc_file
    (tmp_path / "t.csv").write_text("100,200,50\n300,400\n")
    assert run("localize", str(file), "--points", str(tmp_path / "t.csv"), "--alt", "80") == 0
    found = rows(capsys.readouterr().out)
    np.testing.assert_allclose(found, rpc.localize([[100.0, 200.0], [300.0, 400.0]], [50.0, 80.0]), atol=1e-9)
    monkeypatch.setattr("sys.stdin", io.StringIO((tmp_path / "t.csv").read_text()))
    assert run("localize", str(file), "--points", "-") == 0
    told = capsys.readouterr()
    assert rows(told.out)[:, 2].tolist() == pytest.approx([50.0, rpc.ground_offset[2]], abs=1e-4)
    assert "terrain height unknown" in told.err


def test_a_point_without_a_value_is_nan_or_null_and_the_exit_code_3(
    rpc_file: tuple[Path, RPC], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, rpc = rpc_file
    words = ("project", str(file), "5.4", "43.2", "-3.5", "nan", "43.2", "120", "5.4", "43.2", "inf")
    col, row = rpc.project([5.4, 43.2, -3.5])
    assert run(*words) == 3
    assert capsys.readouterr() == (
        f"col,row\n{col:.6f},{row:.6f}\nnan,nan\nnan,nan\n",
        "barpc: needs review (exit code 3): 2 of 3 points could not be projected\n",
    )
    assert run(*words, "--json") == 3
    nothing = {"col": None, "row": None}
    assert json.loads(capsys.readouterr().out) == [{"col": round(col, 6), "row": round(row, 6)}, nothing, nothing]
    assert run("localize", str(file), "100", "200", "--alt", "3.00004", "--json") == 0
    assert json.loads(capsys.readouterr().out)[0]["alt"] == 3.0
    assert run("localize", str(file), "1e12", "0", "--json") == 3
    told = capsys.readouterr()
    assert json.loads(told.out)[0]["lon"] is None
    assert "1 of 1 points have no ground point" in told.err
    (tmp_path / "none.csv").write_text("lon,lat,alt\n")
    assert run("project", str(file), "--points", str(tmp_path / "none.csv")) == 0
    assert capsys.readouterr() == ("col,row\n", "")


def test_a_dem_tells_the_altitudes_of_projected_points(
    rpc_file: tuple[Path, RPC], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, rpc = rpc_file
    row, col = np.mgrid[:101, :61]  # 100 m at 5.4 E, 44 N; a hundredth of a degree apart
    dem = write_dem(tmp_path / "d.tif", 4979, (60.0 + col + 0.5 * row).astype(np.float32))
    assert run("project", str(file), "5.404", "43.203", "--dem", str(dem)) == 0
    np.testing.assert_allclose(rows(capsys.readouterr().out)[0], rpc.project([5.404, 43.203, 140.25]), atol=6e-6)


@pytest.fixture
def three(tmp_path: Path) -> tuple[list[str], list[RPC]]:
    """Three cameras that look from three sides."""
    found = [tilted(tilt, -tilt) for tilt in (0.0, 0.09, -0.12)]
    files = [str(tmp_path / f"{number}.RPB") for number in range(3)]
    for file, rpc in zip(files, found, strict=True):
        write_rpc(rpc, file)
    return files, found


def test_triangulate_takes_the_images_that_see_a_point(
    three: tuple[list[str], list[RPC]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files, rpcs = three
    ground = np.array([[5.4, 43.2, 150.0], [5.402, 43.199, 100.0], [5.399, 43.201, 200.0]])
    seen = np.column_stack([rpc.project(ground) for rpc in rpcs])
    seen[1, 2:4] = np.nan  # two of the three
    seen[2, 2:] = np.nan  # one alone
    head = "col1,row1,col2,row2,col3,row3"
    np.savetxt(tmp_path / "t.csv", seen, delimiter=",", header=head, comments="", fmt="%.9f")
    assert run("triangulate", *files, "--points", str(tmp_path / "t.csv")) == 3
    told = capsys.readouterr()
    assert told.out.startswith("lon,lat,alt,error\n")
    found = rows(told.out)
    np.testing.assert_allclose(found[:2, :3], ground[:2], atol=2e-4)
    np.testing.assert_allclose(found[:2, :2], ground[:2, :2], atol=2e-9)
    np.testing.assert_allclose(found[:2, 3], 0.0, atol=1e-4)
    assert np.isnan(found[2, :3]).all()
    assert [len(cell.partition(".")[2]) for cell in told.out.splitlines()[1].split(",")] == [10, 10, 4, 4]
    assert told.err == "barpc: needs review (exit code 3): 1 of 3 points could not be intersected\n"


def test_triangulate_tells_the_root_mean_square_over_the_images(
    three: tuple[list[str], list[RPC]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files, rpcs = three
    exact = np.array([rpc.project([5.4, 43.2, 150.0]) for rpc in rpcs])
    seen = exact + [[2, -1], [-1, 2], [0.5, 1]]
    there, apart = ([word for col, row in at.tolist() for word in ("--at", col, row)] for at in (exact, seen))
    assert run("triangulate", *files, *there, "--json") == 0
    (point,) = json.loads(capsys.readouterr().out)
    assert [*point.values()] == pytest.approx([5.4, 43.2, 150.0, 0.0], abs=1e-4)
    assert run("triangulate", *files, *apart, "--json") == 3  # they are pixels apart
    told = capsys.readouterr()
    (point,) = json.loads(told.out)
    assert told.err.startswith("barpc: needs review (exit code 3): 1 of 1 points do not meet: they are up to 1.6")
    again = np.array([rpc.project([point["lon"], point["lat"], point["alt"]]) for rpc in rpcs])
    expected = np.sqrt(((again - seen) ** 2).sum(axis=1).mean())
    assert expected > 0.3
    assert point["error"] == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize(
    ("count", "words", "told"),
    [
        (1, ["--at", "1", "2"], "one image; the lines of sight of at least two can meet"),
        (2, ["--at", "1", "2"], "1 points given with --at for 2 images"),
        (2, [], "0 points given with --at for 2 images"),
        (2, ["--at", "1", "2"] * 3, "3 points given with --at for 2 images"),
    ],
)
def test_triangulate_needs_a_point_of_each_of_two_images(
    count: int, words: list[str], told: str, three: tuple[list[str], list[RPC]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("triangulate", *three[0][:count], *words) == 2
    assert told in capsys.readouterr().err
