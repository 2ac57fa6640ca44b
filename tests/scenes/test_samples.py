"""The committed sample images are what the command beside them makes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.rpcio import read_rpc
from tests.scenes import ImageOptions, Scene

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(ImageOptions(seed=1, gcps=5))


def test_the_samples_stay_small():
    assert sum(path.stat().st_size for path in SAMPLES.iterdir()) < 6e6


@pytest.mark.slow
def test_the_samples_carry_the_cameras_that_the_command_makes(scene):
    """To 1e-6 px: another processor may round the last digit of a cosine differently."""
    truth = json.loads((SAMPLES / "truth.json").read_text())
    ground = scene.candidates(100)
    for shot, view in zip(scene.shots, truth["views"], strict=True):
        there = read_rpc(SAMPLES / view["file"]).project(ground)
        assert np.abs(there - shot.delivered.project(ground)).max() < 1e-6
        assert np.allclose(view["rotation"], shot.correction.rotation, rtol=1e-12, atol=0)


@pytest.mark.nightly
def test_the_samples_have_the_pixels_that_the_command_renders(scene):
    numbers = scene.picture(1).numbers.astype(int)
    with rasterio.open(SAMPLES / "view_01.tif") as dataset:
        there = dataset.read(1).astype(int)
    # where a ray meets an edge another processor's rounding may take it past: a spot of some pixels in a million
    assert (np.abs(there - numbers) > 1).mean() < 1e-4
    assert (there != numbers).mean() < 1e-3
