"""The sensor models that the contract tests run over: one line a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from barpc.base.geodesy import ecef_from_ground
from barpc.sensor import SensorModel, terrasar
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.curve import Orbit, fit_orbit
from barpc.sensor.direct_grid import DirectGrid
from barpc.sensor.image_corrections import CorrectionGrid, Displaced, ImageAffine, ImageCorrected, RowSpline, Splined
from barpc.sensor.pushbroom import Light, Pushbroom
from barpc.sensor.rpc import RPC
from barpc.sensor.sentinel1 import range_doppler
from barpc.sensor.sicd import open_sicd
from barpc.sensor.terrasar import open_terrasar
from barpc.simulate import Look, fly
from tests.sensor.radar_documents import document
from tests.sensor.s1_product import Product
from tests.sensor.terrasar_files import Terrasar


@dataclass(frozen=True)
class Case:
    """A model and where it is tried."""

    model: SensorModel
    size: tuple[int, int]
    alt_range: tuple[float, float]


def make_rpc(lon: float = 5.4, lat: float = 43.2, seed: int = 3) -> RPC:
    """An RPC with all of its coefficients at work: a camera 25 deg off nadir, GSD near 0.5 m."""
    rng = np.random.default_rng(seed)
    coeffs = rng.normal(0, 2e-6, (4, 20))
    coeffs[0, :4] += [1e-3, 1.0, 0.02, -0.04]
    coeffs[2, :4] += [-2e-3, 0.03, -1.0, 0.025]
    coeffs[1::2, 1:4] += rng.normal(0, 1e-4, (2, 3))
    coeffs[1::2, 0] = 1.0
    return RPC(coeffs, [lon, lat, 500.0], [0.12, 0.09, 500.0], [10000.0, 9500.0], [10100.0, 9800.0], 3.0, 0.5)


def slopes(model: SensorModel, ground: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Central differences (N, 2, 3) of image points by lon, lat and alt, of steps (3,) or (N, 3) [deg, deg, m]."""
    moves = np.eye(3)[:, None] * steps
    ends = [model.project(ground + move) - model.project(ground - move) for move in moves]
    return np.stack(ends, axis=-1) / (2.0 * moves.sum(axis=-1).T[:, None])


def slopes_off(model: SensorModel, ground: np.ndarray, steps: np.ndarray) -> float:
    """How far its derivatives are from central differences, at most, in parts of the largest by an axis."""
    jacobian, numeric = model.project_jacobian(ground)[1], slopes(model, ground, steps)
    return float((np.abs(jacobian - numeric).max(axis=(0, 1)) / np.abs(numeric).max(axis=(0, 1))).max())


def _correction(lon: float = 5.4, lat: float = 43.2) -> Correction:
    return Correction([2e-5, -3e-5, 1e-5], [4.0, -3.0, 2.0], ecef_from_ground([lon + 2.0, lat - 1.0, 7e5]))


def _row_spline() -> RowSpline:
    coeffs = np.random.default_rng(5).normal(0, 40.0, (13, 2))  # some hundredths of a pixel a row
    return RowSpline(coeffs, 9499.5, 9500.0)


def _pushbroom(lon: float) -> Pushbroom:
    return fly(np.array([lon, 43.2, 500.0]), Look(25.0, 100.0), (20000, 19000), 0.5)


def _curved() -> Pushbroom:
    """Its pixels shrink by a tenth towards one edge, and its detector line is an arc."""
    given = _pushbroom(5.4)
    step = np.abs(given.look[:, 1]).max()
    bend = step / 1e4 * np.array([[0.02, 1e-6], [0.03, 2e-6]])
    return replace(given, look=np.hstack([given.look, bend]))


def _turned_over() -> Pushbroom:
    """The last row first, under aberration and refraction."""
    given = _pushbroom(5.4)
    last = given.first_line + 18999 * given.line_period
    return replace(given, first_line=last, line_period=-given.line_period, light=Light(True, True))


def _range_doppler(lon: float) -> Case:
    model = Product(lon=lon - 5.0).model()
    return Case(model, model.size, model.alt_range)


def _corrected_range_doppler() -> Case:
    case = _range_doppler(5.4)
    correction = Correction([2e-6, -3e-6, 1e-6], [4.0, -3.0, 2.0], ecef_from_ground([10.0, 42.0, 7e5]))
    return Case(Corrected(case.model, correction), case.size, case.alt_range)


def _sicd(kind: str, lon: float = 5.4, **said: object) -> Case:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "image.xml"
        path.write_text(document(kind, ground=(lon, 43.3, 120.0), **said))
        model = open_sicd(path)
    return Case(model, model.size, model.alt_range)


def _terrasar(lon: float) -> Case:
    with TemporaryDirectory() as folder:
        model = open_terrasar(Terrasar("left", orbit=Product(lon=lon + 4.4)).write(Path(folder)))
    return Case(model, model.size, model.alt_range)


def _grid(lon: float) -> DirectGrid:
    cols, rows, alts = (
        np.arange(-500.0, 21000, 1000),
        np.arange(-500.0, 20000, 900),
        np.arange(-100.0, 1200, 300),
    )
    nodes = np.stack(np.meshgrid(cols, rows), axis=-1)
    return DirectGrid(cols, rows, alts, _pushbroom(lon).localize(nodes, alts[:, None, None])[..., :2])


def _lacking() -> CorrectionGrid:
    """Displacements that grow evenly, so that they have one slope all over the image."""
    cols, rows = np.linspace(-2000.0, 22000.0, 9), np.linspace(-2000.0, 21000.0, 5)
    col, row = np.meshgrid(cols, rows)
    shift = np.stack([2.0 + 1e-4 * col - 2e-4 * row, -3.0 + 3e-4 * col + 1e-4 * row], axis=-1)
    return CorrectionGrid(cols, rows, shift)


MODELS: dict[str, Callable[[], Case]] = {
    "rpc": lambda: Case(make_rpc(), (20000, 19000), (0.0, 1000.0)),
    "rpc across the antimeridian": lambda: Case(make_rpc(lon=179.98), (20000, 19000), (0.0, 1000.0)),
    "rpc near the pole": lambda: Case(make_rpc(lat=84.9), (20000, 19000), (0.0, 1000.0)),
    "corrected rpc": lambda: Case(Corrected(make_rpc(), _correction()), (20000, 19000), (0.0, 1000.0)),
    "corrected rpc across the antimeridian": lambda: Case(
        Corrected(make_rpc(lon=-179.98), _correction(lon=-179.98)), (20000, 19000), (0.0, 1000.0)
    ),
    "corrected rpc with drift": lambda: Case(
        Corrected(
            make_rpc(),
            replace(_correction(), drift=[[5e-6, 1e-5, -1e-5]], row_offset=9500.0, row_scale=9500.0),
        ),
        (20000, 19000),
        (0.0, 1000.0),
    ),
    "corrected rpc behind a row spline": lambda: Case(
        Splined(Corrected(make_rpc(), _correction()), _row_spline()), (20000, 19000), (0.0, 1000.0)
    ),
    "rpc corrected in the image": lambda: Case(
        ImageCorrected(make_rpc(), ImageAffine([3.0, -4.0], [[1e-4, 2e-4], [-1e-4, 3e-4]])),
        (20000, 19000),
        (0.0, 1000.0),
    ),
    "rpc and what it lacks": lambda: Case(Displaced(make_rpc(), _lacking()), (20000, 19000), (0.0, 1000.0)),
    "pushbroom": lambda: Case(_pushbroom(5.4), (20000, 19000), (0.0, 1000.0)),
    "pushbroom across the antimeridian": lambda: Case(_pushbroom(180.0), (20000, 19000), (0.0, 1000.0)),
    "pushbroom of a curved detector": lambda: Case(_curved(), (20000, 19000), (0.0, 1000.0)),
    "pushbroom that sees bent light, turned over": lambda: Case(_turned_over(), (20000, 19000), (0.0, 1000.0)),
    "localisation grid": lambda: Case(_grid(5.4), (20000, 19000), (0.0, 1000.0)),
    "localisation grid across the antimeridian": lambda: Case(_grid(180.0), (20000, 19000), (0.0, 1000.0)),
    "corrected pushbroom": lambda: Case(Corrected(_pushbroom(5.4), _correction()), (20000, 19000), (0.0, 1000.0)),
    "range-doppler": lambda: _range_doppler(5.4),
    "range-doppler across the antimeridian": lambda: _range_doppler(180.0),
    "corrected range-doppler": _corrected_range_doppler,
    "terrasar-x to the left, across the antimeridian": lambda: _terrasar(180.0),
    "sicd, polar format": lambda: _sicd("PFA"),
    "sicd, zero doppler, to the left": lambda: _sicd("INCA", side="L"),
    "sicd, ground plane across the antimeridian": lambda: _sicd("PLANE", lon=180.0),
}


@pytest.fixture(scope="session", autouse=True)
def _orbits() -> Iterator[None]:
    """An orbit through the same state vectors is fitted once: twenty tests change something else of one product."""
    known: dict[tuple[object, ...], Orbit] = {}

    def once(*vectors: np.ndarray, window: tuple[float, float]) -> Orbit:
        key = (*(part.tobytes() for part in vectors), *window)
        if key not in known:
            known[key] = fit_orbit(*vectors, window)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        for module in (range_doppler, terrasar):
            patch.setattr(module, "fit_orbit", lambda *given: once(*given[:3], window=given[3]))
        yield


@pytest.fixture(scope="module", params=list(MODELS))
def case(request: pytest.FixtureRequest) -> Case:
    """Every model in turn."""
    return MODELS[request.param]()
