"""Small scenes to break, and the command run in this process with everything it said."""

from __future__ import annotations

import contextlib
import io
import logging
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.cli import main
from tests.geotiffs import write_image

from .trials import SAMPLES, crop


@dataclass(frozen=True)
class Said:
    """What a run of the command left: its exit code and what it printed."""

    code: int
    out: str
    err: str


def barpc(*args: object) -> Said:
    """Run the command in this process; warnings are its own affair, as they are at a prompt."""
    out, err = io.StringIO(), io.StringIO()
    code: object = None
    handlers = logging.root.handlers[:]
    with warnings.catch_warnings(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        warnings.simplefilter("default")
        try:
            main([str(arg) for arg in args])
        except SystemExit as stop:
            code = stop.code
    logging.root.handlers[:] = handlers
    return Said(code if isinstance(code, int) else -1, out.getvalue(), err.getvalue())


def assert_one_line(said: Said, code: int, *words: str) -> None:
    """The documented exit code, and one line that names what is wrong."""
    assert said.code == code, said
    assert said.out == "", said
    lines = said.err.strip().splitlines()
    assert len(lines) == 1, said
    assert lines[0].startswith("barpc: "), said
    assert len(lines[0]) < 1000, said
    for word in ("Traceback", "unexpected", "<", "object at 0x"):
        assert word not in lines[0], said
    for word in words:
        assert word in lines[0], said


def hashes(paths: Sequence[Path]) -> dict[Path, str]:
    """The content of every regular file among and below the paths."""
    found: dict[Path, str] = {}
    for path in paths:
        for file in [path, *(path.rglob("*") if path.is_dir() else ())]:
            if file.is_file():
                found[file] = sha256(file.read_bytes()).hexdigest()
    return found


def rewrite(
    path: Path,
    *,
    dtype: str = "uint16",
    count: int = 1,
    pixels: Callable[[np.ndarray], np.ndarray] | None = None,
    camera: Callable[[rasterio.rpc.RPC], None] | None = None,
    **profile: object,
) -> Path:
    """Write an image anew with other pixels, another type, another camera."""
    with rasterio.open(path) as image:
        values, rpcs = image.read(1), image.rpcs
    values = values if pixels is None else pixels(values.astype(np.float64))
    if camera is not None:
        camera(rpcs)
    path.unlink()
    return write_image(path, np.stack([values.astype(dtype)] * count), rpcs=rpcs, **profile)


@pytest.fixture(autouse=True)
def _no_georeference() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        yield


@pytest.fixture(scope="session")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three overlapping crops; never written to."""
    folder = tmp_path_factory.mktemp("pristine")
    return [crop(path, folder / path.name) for path in SAMPLES]


@pytest.fixture(scope="session")
def ran(pristine: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the first two crops in `in` and a finished run on them in `out`; never written to."""
    folder = tmp_path_factory.mktemp("ran")
    (folder / "in").mkdir()
    images = [Path(shutil.copy(path, folder / "in")) for path in pristine[:2]]
    assert barpc("adjust", *images, "-o", folder / "out", "--overwrite").code == 0
    return folder


@pytest.fixture
def out(ran: Path, crops: list[Path], tmp_path: Path) -> Path:
    """A finished run on `crops`, of one's own: what it kept is found again."""
    return Path(shutil.copytree(ran / "out", tmp_path / "out"))


@pytest.fixture
def crops(pristine: list[Path], tmp_path: Path) -> list[Path]:
    """Two overlapping crops of one's own."""
    (tmp_path / "in").mkdir()
    return [Path(shutil.copy(path, tmp_path / "in")) for path in pristine[:2]]
