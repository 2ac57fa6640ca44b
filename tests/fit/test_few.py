"""Few points get the largest model that they carry, with its error by leaving each out, never called a whole RPC."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import barpc
from barpc.base.errors import FitError
from barpc.cli import cli
from barpc.fit.given import MODELS, WHOLE, fit_few
from barpc.sensor.rational import monomials

RPC = barpc.read_rpc(Path(__file__).resolve().parents[2] / "data_samples/view_00.tif")


def points(count: int, noise: float = 0.0, seed: int = 0, alts: tuple[float, float] = (100.0, 300.0)):
    rng = np.random.default_rng(seed)
    image = rng.uniform(0.0, 1000.0, (count, 2))
    ground = RPC.localize(image, rng.uniform(*alts, count))
    return ground, image + rng.normal(0.0, noise, image.shape)


def error(rpc: barpc.RPC) -> float:
    ground, image = points(500, seed=99)
    return float(np.sqrt(((rpc.project(ground) - image) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize(
    ("count", "names", "most"),
    [
        (8, ("an affine with heights",), 0.3),
        (11, ("an affine with heights", "a projective camera"), 0.2),
        (16, ("a projective camera", "quadratic polynomials"), 0.1),
        (39, ("a projective camera", "quadratic polynomials"), 0.01),
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_exact_points_carry_more_the_more_there_are(count, names, most, seed):
    found = barpc.fit_rpc_points(*points(count, seed=seed), strict=False)
    assert found.method in names
    assert error(found.rpc) < most
    assert f"{count} points carry {found.method}" in found.few


@pytest.mark.parametrize("count", [10, 24, 60, pytest.param(120, marks=pytest.mark.nightly)])
def test_noisy_points_get_no_more_than_they_carry_and_the_error_that_is_said(count):
    """A whole RPC of 60 points of 0.3 px of noise errs by 0.4 px."""
    ratio, worst = [], 0.0
    for seed in range(5):
        found = barpc.fit_rpc_points(*points(count, 0.3, seed), strict=False)
        worst = max(worst, error(found.rpc))
        noise = 0.3 * np.sqrt(2.0)
        ratio.append(np.linalg.norm(found.rmse_ckp) / np.hypot(error(found.rpc), noise))
        assert bool(found.few) == (count < WHOLE)
    assert worst < (1.0 if count < 16 else 0.4)
    assert 0.7 < np.median(ratio) < 1.4


def test_exact_points_of_a_whole_rpc_keep_it():
    for count in (40, 200):
        found = barpc.fit_rpc_points(*points(count), strict=False)
        assert found.method == "ridge"
        assert not found.few
        assert error(found.rpc) < 1e-3


def test_points_at_one_altitude_get_an_affine_without_heights():
    ground, image = points(12, alts=(200.0, 200.0))
    found = barpc.fit_rpc_points(ground, image, strict=False)
    assert found.method == "an affine without heights"
    assert "no height terms" in found.verdict(5.0)


def test_fewer_than_four_are_none():
    ground, image = points(3)
    with pytest.raises(FitError):
        barpc.fit_rpc_points(ground, image)
    with pytest.raises(FitError, match="4 give an affine at their altitude, 40 a whole RPC"):
        fit_few(np.eye(3), np.eye(3)[:, :2])


def test_weights_count():
    ground, image = points(20, 0.0, 5)
    image[0] += 30.0
    sigma = np.ones(20)
    sigma[0] = 1e3
    plain, weighted = (barpc.fit_rpc_points(ground, image, sigma=s, strict=False) for s in (None, sigma))
    assert error(weighted.rpc) < 0.1 < error(plain.rpc)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_each_model_is_found_again_by_exact_points_of_its_own(model):
    rng = np.random.default_rng(4)
    place = rng.uniform(-1.0, 1.0, (30, 3)) * [1.0, 1.0, model.terms > 3]
    coeffs = np.zeros((4, 20))
    coeffs[1::2, 0] = 1.0
    coeffs[[0, 2], : model.terms] = rng.normal(0.0, 1.0, (2, model.terms))
    if model.projective:
        coeffs[1, 1:4] = coeffs[3, 1:4] = rng.normal(0.0, 0.05, 3)
    col, col_den, row, row_den = coeffs @ monomials(place.T)
    found = fit_few(place, np.column_stack([col / col_den, row / row_den]))
    np.testing.assert_allclose(found.coeffs, coeffs, atol=1e-9)


def test_the_verb_writes_it_and_ends_with_3(tmp_path):
    ground, image = points(16, 0.2)
    rows = [",".join(map(repr, [*g, *xy])) for g, xy in zip(ground.tolist(), image.tolist(), strict=True)]
    (tmp_path / "points.csv").write_text("\n".join(["lon,lat,alt,col,row", *rows]) + "\n")
    out = tmp_path / "a_RPC.TXT"
    words = ["fit", f"{tmp_path / 'points.csv'},size=1000:1000", "-o", str(out), "--tolerance", "2"]
    done = CliRunner().invoke(cli, words, standalone_mode=False, obj={"quiet": False})
    assert done.return_value == 3
    assert error(barpc.read_rpc(out)) < 0.5
