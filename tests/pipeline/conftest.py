"""Images through the whole tool, once a session: known ones, whole or a part of them, and real ones."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from barpc.pipeline import AdjustResult, RunOptions, adjust
from tests.pipeline.known import Known, part, whole


@pytest.fixture(scope="session")
def corner(tmp_path_factory) -> Known:
    """A part of the repository's images: what is fast enough to be run many times."""
    return part(tmp_path_factory.mktemp("corner"))


@pytest.fixture(scope="session", params=["part", pytest.param("whole", marks=pytest.mark.nightly)])
def known(request) -> Known:
    """Three images with truth: a part of them, at night the whole, too."""
    found: Known = request.getfixturevalue("corner") if request.param == "part" else whole()
    return found


@pytest.fixture(scope="session")
def matched(known, tmp_path_factory) -> tuple[AdjustResult, Path]:
    """The known images, matched."""
    out = tmp_path_factory.mktemp("matched") / "ties"
    return adjust(known.images, out, RunOptions(stop_after="matching")), out


@pytest.fixture(scope="session")
def adjusted(known, matched, tmp_path_factory) -> tuple[AdjustResult, Path]:
    """The known images, adjusted with the defaults, going on with what was matched."""
    out = tmp_path_factory.mktemp("known") / "adjusted"
    shutil.copytree(matched[1], out)
    return adjust(known.images, out, RunOptions(overwrite=True)), out


@pytest.fixture(scope="session")
def triplet(shared_data, tmp_path_factory) -> tuple[AdjustResult, Path]:
    """Three Pleiades crops, adjusted with the defaults."""
    out = tmp_path_factory.mktemp("triplet") / "adjusted"
    images = sorted((shared_data / "optical/phr_triplet_north").glob("*.tif"))
    return adjust(images, out), out


def _ventoux(shared_data: Path, folder: Path, right_geom: str) -> tuple[AdjustResult, Path]:
    source = shared_data / "optical/phr_ventoux"
    for name in ("left_image.tif", "left_image.geom", "right_image.tif"):
        shutil.copy(source / name, folder / name)
    shutil.copy(source / right_geom, folder / "right_image.geom")
    return adjust([folder / "left_image.tif", folder / "right_image.tif"], folder / "adjusted"), folder / "adjusted"


@pytest.fixture(scope="session")
def ventoux(shared_data, tmp_path_factory) -> tuple[AdjustResult, Path]:
    """Two Pleiades crops with little overlap and a 4.8 px error."""
    return _ventoux(shared_data, tmp_path_factory.mktemp("ventoux"), "right_image.geom")


@pytest.fixture(scope="session")
def ventoux_biased(shared_data, tmp_path_factory) -> tuple[AdjustResult, Path]:
    """The same with a synthetic 20 px bias."""
    return _ventoux(shared_data, tmp_path_factory.mktemp("biased"), "right_image_bias.geom")


def check_points(shared_data: Path, first: str, second: str) -> np.ndarray:
    """Independent check points (N, 4): col, row in the first and in the second image; the tool never sees them."""
    pair = f"{first}__{second}__ncc_check.csv"
    (path,) = (shared_data / "truth/ties").glob(f"*__{pair}")
    table = np.genfromtxt(path, delimiter=",", names=True)
    return np.stack([table[name] for name in ("col_a", "row_a", "col_b", "row_b")], axis=1)
