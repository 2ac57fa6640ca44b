"""One door for a finished run: whatever was changed since, every verb says so in a line, or reads nothing of it."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from rasterio import Affine

from tests.geotiffs import write_image

from .conftest import Said, barpc, hashes
from .test_interruption import flipped
from .trials import SAMPLES, crop

VERBS: dict[str, tuple[str, ...]] = {
    "verify": ("verify", "run"),
    "check": ("check", "run"),
    "compare": ("report", "run", "other"),
    "convert": ("convert", "in/view_00.tif", "in/view_01.tif", "--rpc", "run", "-o", "out/convert"),
    "export": ("export", "run", "out/export", "--to", "s2p"),
    "points": ("export", "run", "out/points", "--to", "points"),
    "ortho": ("ortho", "run", "-o", "out/ortho"),
    "add-to": ("adjust", "in/view_02.tif", "--add-to", "run", "-o", "out/added"),
    "update": ("adjust", "in/view_02.tif", "--add-to", "run", "--update", "-o", "out/updated"),
    "calibrate": ("calibrate", "run", "other", "third", "--sensor", "S", "-o", "out/s.cal"),
    "report": ("report", "run"),
    "dsm": ("dsm", "run", "-o", "out/dsm.tif"),
}
ALL = set(VERBS)
PIXELS = {"verify", "check", "export", "ortho", "dsm", "add-to", "update", "calibrate"}
SCENE = {"verify", "export", "points", "ortho", "dsm"}
TIES = {*SCENE, "report"}


def grid(path: Path, metres: float) -> Path:
    """Heights around the samples."""
    place = Affine(0.01, 0.0, 5.2, 0.0, -0.01, 43.5)
    return write_image(path, np.full((40, 40), metres, np.float32), transform=place, crs="EPSG:4326")


def replaced(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def swapped(a: Path, b: Path) -> None:
    for old, new in ((a, "x"), (b, a.name), (a.with_name("x"), b.name)):
        old.rename(old.with_name(new))


def in_place_of(project: Path, name: str) -> None:
    """The file is gone, and another of its name lies in the working directory, and beside the run."""
    (project / "in" / name).unlink()
    grid(project / name, -500.0)


Edit = Callable[[Path], object]
EDITS: dict[str, tuple[Edit, set[str]]] = {
    "cameras changed": (
        lambda p: [replaced(p / f"run/view_0{k}.vrt", b'"LINE_OFF">', b'"LINE_OFF">1') for k in (0, 1)],
        {"verify", "check", "compare", "convert", *SCENE},
    ),
    "a camera is gone": (lambda p: (p / "run/view_00.vrt").unlink(), {"verify", "check", "compare", *SCENE}),
    "cameras swapped": (
        lambda p: swapped(p / "run/view_00.vrt", p / "run/view_01.vrt"),
        {"verify", "check", "compare", "convert", *SCENE},
    ),
    "an image changed": (lambda p: flipped(p / "in/view_00.tif"), PIXELS),
    "an image cut short": (lambda p: cut(p / "in/view_01.tif"), PIXELS),
    "an image is gone": (lambda p: (p / "in/view_00.tif").unlink(), {*PIXELS, "convert"}),
    "images swapped": (lambda p: swapped(p / "in/view_00.tif", p / "in/view_01.tif"), PIXELS),
    "an image of its name": (lambda p: in_place_of(p, "view_01.tif"), {*PIXELS, "convert"}),
    "the DEM changed": (lambda p: grid(p / "in/dem.tif", 250.0), {"verify", "ortho"}),
    "the DEM is gone": (lambda p: in_place_of(p, "dem.tif"), {"verify", "ortho"}),
    "the geoid changed": (lambda p: grid(p / "in/geoid.tif", -500.0), {"verify", "ortho"}),
    "the geoid is gone": (lambda p: in_place_of(p, "geoid.tif"), {"verify", "ortho"}),
    "the summary changed": (lambda p: replaced(p / "run/summary.json", b'"altitude_m": 1', b'"altitude_m": 2'), ALL),
    "the summary cut short": (lambda p: cut(p / "run/summary.json"), ALL),
    "ties changed": (lambda p: flipped(p / "run/tables/observations.csv"), TIES),
    "ties cut short": (lambda p: cut(p / "run/tables/residuals.csv"), TIES),
    "tables swapped": (lambda p: swapped(p / "run/tables/residuals.csv", p / "run/tables/observations.csv"), TIES),
    "outlines changed": (lambda p: flipped(p / "run/tables/footprints.geojson"), {"verify", "report"}),
    "pictures are gone": (lambda p: (p / "run/tables/pictures.json").unlink(), {"verify", "report"}),
    "the block changed": (
        lambda p: flipped(p / "run/tables/block.npz"), {"verify", "dsm", "add-to", "update", "calibrate"}
    ),
    "the images' list changed": (
        lambda p: replaced(p / "run/tables/images.json", b"view_00.tif", b"view_02.tif"),
        {"verify", "add-to", "update", "calibrate"},
    ),
    "the sums are gone": (lambda p: (p / "run/SHA256SUMS").unlink(), ALL),
    "the sums cut short": (lambda p: cut(p / "run/SHA256SUMS"), ALL),
    "the sums changed": (lambda p: replaced(p / "run/SHA256SUMS", b"# barpc ", b"# BARPC "), ALL),
}  # fmt: skip
"""What is done to a project -> the verbs that must refuse it; the others read nothing of it."""


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs of two images, and a third image."""
    folder = tmp_path_factory.mktemp("door") / "project"
    (folder / "in").mkdir(parents=True)
    images = [crop(path, folder / "in" / path.name) for path in SAMPLES]
    terrain = ("--dem", grid(folder / "in/dem.tif", 70.0), "--geoid", grid(folder / "in/geoid.tif", 50.0))
    for name, more in {"run": terrain, "other": (), "third": ("--drift", "0")}.items():
        assert barpc("adjust", *images[:2], "-o", folder / name, *more).code in (0, 3)
    return folder


def copied(project: Path, folder: Path) -> Path:
    """The project at another place, as if it had been made there: where it was made, nothing is changed."""
    copy = Path(shutil.copytree(project, folder / "copy"))
    for run in ("run", "other", "third"):
        replaced(copy / run / ".barpc/state.json", str(project).encode(), str(copy).encode())
    return copy


def outcomes(project: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, Said, dict[str, str]]]:
    """Every verb in the project: what it said, and the files that it made."""
    monkeypatch.chdir(project)
    for verb, words in VERBS.items():
        said = barpc(*words)
        said = Said(said.code, *(text.replace(str(project), "PROJECT") for text in (said.out, said.err)))
        made = {path.relative_to(project / "out").as_posix(): sha for path, sha in hashes([project / "out"]).items()}
        if verb == "report" and said.code == 0:
            made["report.html"] = hashes([project / "run/report.html"])[project / "run/report.html"]
        yield verb, said, {name: sha for name, sha in made.items() if "/.barpc/" not in name}
        shutil.rmtree(project / "out", ignore_errors=True)


@pytest.fixture(scope="module")
def undisturbed(project: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Said, dict[str, str]]]:
    with pytest.MonkeyPatch.context() as patch:
        found = {verb: rest for verb, *rest in outcomes(copied(project, tmp_path_factory.mktemp("door")), patch)}
    assert {verb for verb, (said, _) in found.items() if said.code not in (0, 3)} == {"calibrate"}, found
    assert {verb for verb, (_, made) in found.items() if not made} == {"verify", "check", "compare", "calibrate"}
    return {verb: (said, made) for verb, (said, made) in found.items()}


@pytest.mark.costs(3)
@pytest.mark.landing(3)
@pytest.mark.slow
@pytest.mark.parametrize("edit", EDITS)
def test_no_verb_is_silent_about_an_edit(project, undisturbed, tmp_path, monkeypatch, caplog, edit) -> None:
    copy, (change, refused_by) = copied(project, tmp_path), EDITS[edit]
    change(copy)
    refused = set()
    for verb, said, made in outcomes(copy, monkeypatch):
        before, files = undisturbed[verb]
        if (said.code, made) == (before.code, files) and said.out == before.out and said.err == before.err:
            continue
        refused.add(verb)
        if verb in ("add-to", "update") and "is not matched: no such file any more" in caplog.text:
            continue  # without that image, and said so
        if verb != "verify" or said.code != 3:
            assert (said.code, made, said.out) == (1, {}, ""), (verb, said)
            assert len(said.err.strip().splitlines()) == 1, said
        assert "bug" not in said.err, said
    assert refused == refused_by


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("how", ["all is moved", "all is copied", "the runs are copied", "the inputs are beside"])
def test_every_verb_goes_on_where_files_were_moved(project, undisturbed, tmp_path, monkeypatch, how) -> None:
    copy = Path(shutil.copytree(project, tmp_path / "copy"))  # (knows where it was made)
    if how == "all is moved":
        copy = copied(project, tmp_path / "deep").rename(tmp_path / "moved")
    elif how == "the inputs are beside":
        copy = copied(project, tmp_path / "beside")
        for path in (copy / "in").iterdir():
            shutil.copy(path, copy)
    elif how == "the runs are copied":
        (copy / "in/view_00.tif").unlink()
    for verb, said, made in outcomes(copy, monkeypatch):
        if verb in ("check", "convert") and how == "the runs are copied":
            continue  # the image that is gone is named on the command line, or in a VRT
        before, files = undisturbed[verb]
        assert (said.code, set(made)) == (before.code, set(files)), (verb, said)
        if verb not in ("export", "add-to", "update"):  # which name images by their places
            assert made == files, verb


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("table", ["run/summary.json", "run/tables/images.json"])
def test_names_that_are_too_long_are_one_line(project, tmp_path, monkeypatch, caplog, table) -> None:
    from tests.sealing import seal

    copy = copied(project, tmp_path)
    text = (copy / table).read_text()
    (copy / table).write_text(text.replace("view_00.tif", "v" * 300 + ".tif"))
    seal(copy / "run")
    for verb, said, _ in outcomes(copy, monkeypatch):
        assert "bug" not in said.err, (verb, said)
        assert said.code in (0, 3) or len(said.err.strip().splitlines()) == 1, (verb, said)
    monkeypatch.chdir(copy)
    said = barpc(*VERBS["ortho" if table == "run/summary.json" else "update"])
    assert "is gone" in said.err or "no such file any more" in caplog.text
