"""A model is asked both ways: what it localises it must project where it was, and show the ground as from above."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import RPCTransformer

from barpc.base.errors import FitError
from barpc.fit import fit_rpc, fit_rpc_points
from barpc.rpcio import read_rpc
from tests.fit.models import Frame

SIZE, ALTS = (4000, 3000), (0.0, 600.0)
HONEST = Frame(5.4, 43.2, 5000.0, 4000.0, SIZE)
SWAP = [1, 0]


@dataclass(frozen=True)
class Crooked:
    """A pinhole camera, and what is done to what goes in and comes out of either direction."""

    fault: str = "none"
    camera: Frame = HONEST

    def project(self, ground):
        if self.fault.startswith("lon and lat exchanged"):
            return self.camera.project(ground[..., [1, 0, 2]])
        image = self.camera.project(ground)
        if self.fault.startswith("col and row exchanged"):
            image = image[..., SWAP]
        if self.fault == "bump in the middle":
            away = ((image - np.array(SIZE) / 2) ** 2).sum(axis=-1, keepdims=True)
            image = image + 2.0 * np.exp(-away / 400.0**2)
        if self.fault == "nothing projected":
            image = image + np.nan
        return image + {"half a pixel": 0.5, "2 px": 2.0, "less than wanted": 0.004}.get(self.fault, 0.0)

    def localize(self, image, alt):
        if self.fault == "altitude ignored":
            ground = self.camera.localize(image, 0.0 * alt + 300.0)
            return np.concatenate([ground[..., :2], np.asarray(alt)[..., None]], axis=-1)
        if self.fault == "another altitude":
            return self.camera.localize(image, 0.0 * alt + 300.0)
        ground = self.camera.localize(image, alt)
        return ground[..., [1, 0, 2]] if self.fault == "lon and lat exchanged, both ways" else ground


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("fault", "largest"),
    [
        # 300 m of 4,400 at half the diagonal of 4,000 px, straight down: 150 px and more
        ("altitude ignored", (130.0, 145.0)),
        ("another altitude", (130.0, 145.0)),
        ("2 px", (2.0, 2.0)),
        ("half a pixel", (0.5, 0.5)),
        ("bump in the middle", (1.9, 2.0)),
        ("lon and lat exchanged, one way", (5e3, np.inf)),
        ("col and row exchanged, one way", (3e3, 4.1e3)),
        ("nothing projected", (np.inf, np.inf)),
    ],
)
def test_directions_of_two_cameras_are_refused_with_how_far_they_are_apart(fault, largest):
    with pytest.raises(FitError, match="the model contradicts itself"):
        fit_rpc(Crooked(fault), SIZE, ALTS)
    fit = fit_rpc(Crooked(fault), SIZE, ALTS, strict=False)
    assert largest[0] * (1 - 1e-6) <= fit.contradiction <= largest[1] * (1 + 1e-6)
    assert "contradicts itself" in fit.verdict(0.01)
    assert fit.summary()["contradiction"] == fit.contradiction


def test_axes_out_of_range_are_named():
    far = Crooked("lon and lat exchanged, both ways", Frame(105.4, 43.2, 5000.0, 4000.0, SIZE))
    with pytest.raises(FitError, match=r"is not a latitude: are the columns swapped"):
        fit_rpc(far, SIZE, ALTS)


def test_an_honest_model_passes_and_so_does_one_within_the_tolerance():
    assert fit_rpc(Crooked(), SIZE, ALTS).contradiction < 1e-7
    near = fit_rpc(Crooked("less than wanted"), SIZE, ALTS)
    assert near.contradiction == pytest.approx(0.004, rel=1e-5)
    assert near.verdict(0.01) == ""
    assert "contradicts itself" in near.verdict(0.003)
    # of who projects with the model, the RPC is off by no more than both
    image = np.random.default_rng(1).uniform(0, 1, (2000, 2)) * SIZE
    ground = HONEST.localize(image, np.linspace(*ALTS, 2000))
    off = np.abs(near.rpc.project(ground) - Crooked("less than wanted").project(ground)).max()
    assert 0.9 * near.contradiction < off <= 1.2 * near.max_ckp.max() + near.contradiction


@dataclass(frozen=True)
class Gdal:
    """GDAL's projection of a file's RPC, whose first pixel's centre is (0.5, 0.5), and our localisation of it."""

    path: Path
    centre: float

    def project(self, ground):
        with rasterio.open(self.path) as dataset:
            given = dataset.rpcs
        flat = ground.reshape(-1, 3)
        with RPCTransformer(given) as transformer:
            row, col = transformer.rowcol(*flat.T, op=lambda value: value)
        return (np.column_stack([col, row]) - self.centre).reshape(*ground.shape[:-1], 2)

    def localize(self, image, alt):
        return read_rpc(self.path).localize(image, alt)


def test_half_a_pixel_between_gdals_convention_and_ours_is_seen(shared_data):
    path = shared_data / "optical" / "phr_triplet_north" / "img_01.tif"
    size, alts = (1024, 560), (0.0, 500.0)
    assert fit_rpc(Gdal(path, 0.5), size, alts).contradiction < 1e-6
    with pytest.raises(FitError, match=r"projects up to 0\.5 px away"):
        fit_rpc(Gdal(path, 0.0), size, alts)


def test_given_points_have_no_other_direction():
    image = np.random.default_rng(0).uniform(0, 1, (300, 2)) * SIZE
    assert fit_rpc_points(HONEST.localize(image, np.linspace(*ALTS, 300)), image).contradiction == 0.0


@pytest.mark.slow
def test_a_lens_beyond_its_fold_is_refused_in_one_line():
    """Its distances from the middle shrink again: the way back ends anywhere, and no solver is at home there."""
    size = (14000, 10000)
    folded = Frame(5.4, 43.2, 5000.0, 9000.0, size, -0.3)
    with pytest.raises(FitError, match="the model contradicts itself"):
        fit_rpc(folded, size, (0.0, 600.0))
