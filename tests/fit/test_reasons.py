"""A fit that misses says why: each kind of error by its name and size, and none that is not there."""

from __future__ import annotations

import numpy as np
import pytest

from barpc import open_camera
from barpc.base.errors import FitError
from barpc.fit import FitOptions, RpcFit, fit_rpc
from tests.costs import once
from tests.fit.models import Bent, Frame, bump, pushbroom, waves
from tests.lanes import rest_slow

SIZE, ALTS = (20000, 20000), (0.0, 1500.0)


def along(axis: int, function, *, out: int = 0):
    """Moves of col (`out` 0) or row (1) by a function of col (`axis` 0) or row (1), which runs from -1 to 1."""

    def moves(image):
        off = function(image[..., axis] / 1e4 - 1.0)
        return np.stack([off, 0.0 * off] if out == 0 else [0.0 * off, off], axis=-1)

    return moves


class Layered:
    """A pushbroom whose columns swing with the altitude."""

    sensor_ = pushbroom(45.0)

    def _moves(self, alt):
        return 0.5 * np.stack([np.cos(6.0 * (alt / 750.0 - 1.0)), 0.0 * alt], axis=-1)

    def project(self, ground):
        return self.sensor_.project(ground) + self._moves(ground[..., 2])

    def localize(self, image, alt):
        return self.sensor_.localize(image - self._moves(np.broadcast_to(alt, image.shape[:-1])), alt)


def field(image):
    """What goes by nothing: waves across each other."""
    x, y = (image / 1e4 - 1.0)[..., 0], (image / 1e4 - 1.0)[..., 1]
    return 0.5 * np.stack([np.sin(9 * x + 4 * y) * np.cos(5 * x * y), np.cos(7 * x - 6 * y)], axis=-1)


def bent(moves):
    return Bent(pushbroom(45.0), moves)


CASES = {
    # cause, size of it [px], RMS
    "a swing of 7 waves": (lambda: bent(waves(20000, 7.0, 0.5)), "row", (0.45, 0.52)),
    "crossing waves": (lambda: bent(field), "all", (0.3, 0.5)),
    "two steps": (lambda: bent(along(0, lambda u: 0.7 * (u > -0.6) + 1.0 * (u > 0.5))), "column", (0.11, 0.18)),
    "a lens": (lambda: Frame(5.4, 43.2, 9000.0, 15000.0, SIZE, -0.05), "column", (1e-3, 0.05)),
    "a camera low over high ground": (
        lambda: Frame(5.4, 43.2, 3500.0, 12000.0, SIZE, -0.05),
        "altitude",
        (1e-3, 0.5),
    ),
    "an altitude": (Layered, "altitude", (0.2, 0.36)),
    "a swing of 150 waves": (lambda: bent(waves(20000, 150.0, 0.5)), "row", (0.4, 0.52)),
    "bursts": (lambda: bent(along(1, lambda v: 0.3 * np.sign(np.sin(20 * v)), out=1)), "row", (0.1, 0.3)),
    "one step": (lambda: bent(along(0, lambda u: 1.0 * (u > -0.27))), "column", (0.05, 0.09)),
    "a step of the rows": (lambda: bent(along(0, lambda u: 0.4 * (u > 0.1), out=1)), "column", (0.055, 0.09)),
    "a bent detector": (lambda: bent(along(0, lambda u: 0.5 * np.sin(9 * u))), "column", (0.05, 0.5)),
    "a bump": (lambda: bent(bump(SIZE, 250.0, 0.5, (0.37, 0.61))), "place", (0.005, 0.05)),
    "a bump in a corner": (lambda: bent(bump(SIZE, 250.0, 0.5, (0.01, 0.99))), "corner", (0.005, 0.05)),
    "a detector like a pole": (
        lambda: bent(along(0, lambda u: 20.0 * np.exp(6.0 * (u - 1.0)))),
        "pole",
        (0.005, 0.03),
    ),
}
PLACES = {"a bump": (7400, 12200), "a bump in a corner": (200, 19800)}
"""Column and row where an error lies, of those that lie at a place."""


@once
def fitted(name: str) -> RpcFit:
    return fit_rpc(CASES[name][0](), SIZE, ALTS, strict=False)


@pytest.mark.parametrize("name", rest_slow(list(CASES), keep=2))
def test_each_cause_is_named_with_its_size_and_its_place(name):
    _, cause, (low, high) = CASES[name]
    fit = fitted(name)
    assert fit.reason is not None
    assert fit.reason.cause == cause
    assert 0.5 < fit.reason.share <= 1.0
    assert low < fit.reason.size_px < high
    assert fit.reason.size_px <= 1.5 * fit.max_ckp.max()
    assert fit.reason.size_px == pytest.approx(np.sqrt(fit.reason.share) * np.hypot(*fit.rmse_ckp), rel=0.05)
    if name in PLACES:
        assert (fit.reason.col, fit.reason.row) == pytest.approx(PLACES[name], abs=300)
    words = fit.verdict(0.01)
    assert "misses its check points by up to" in words
    assert str(fit.reason) in words
    assert fit.summary()["reason"]["cause"] == cause


@pytest.mark.slow
def test_the_refusal_says_it_too_and_a_fit_that_holds_says_nothing():
    model = CASES["a swing of 7 waves"][0]()
    with pytest.raises(FitError, match=r"wanted 0\.01: 9\d% of its squares, 0\.4\d+ px RMS, depend on the row"):
        fit_rpc(model, SIZE, ALTS)
    held = fit_rpc(model, SIZE, ALTS, options=FitOptions(tolerance=1.0))
    assert held.reason is None
    assert "reason" not in held.summary()
    assert "smaller altitude range or a smaller image" in held.verdict(0.01)  # it was not asked


def test_what_goes_by_the_row_goes_by_the_column_of_the_image_turned():
    """The names are not exchanged: the same waves over the columns are no swing of the attitude."""
    turned = bent(along(0, lambda u: 0.5 * np.sin(22 * u), out=1))
    found = fit_rpc(turned, SIZE, ALTS, strict=False).reason
    assert found is not None
    assert found.cause == "column"
    assert found.share > 0.9


@pytest.mark.slow
def test_a_delivered_worldview_camera_swings_with_its_rows(shared_data):
    camera = open_camera(shared_data / "physical_maxar" / "10200100A1865800.r100.xml", model="physical")
    fit = fit_rpc(camera.model, camera.extent, camera.alt_range, strict=False)
    assert fit.reason is not None
    assert fit.reason.cause == "row"
    assert fit.reason.share > 0.8
    assert 0.4 < fit.reason.size_px < 0.8
