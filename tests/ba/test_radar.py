"""Radars in a block: their clocks are found. Truth is made of moved orbits, which no clock follows to the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from barpc.ba import Adjustment, AdjustOptions, BlockPrior, adjust_tracks, block_prior
from barpc.ba.parameters.priors import prior_sigmas
from barpc.ba.parameters.projected import Cameras
from barpc.ba.parameters.unknowns import make_unknowns
from barpc.base.errors import InputError
from barpc.base.geodesy import (
    SPEED_OF_LIGHT,
    Array,
    ecef_from_ground,
    enu_basis,
    ground_from_ecef,
    metres_per_unit,
)
from barpc.report import Run, summarize
from barpc.report.records import json_form
from barpc.scene import GroundPoints, Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Correction
from barpc.sensor.curve import Curve
from barpc.sensor.geometry import triangulate
from barpc.sensor.pushbroom import Pushbroom
from barpc.sensor.sicd import Aperture, Formation, open_sicd
from barpc.sensor.timing import Clocked, Timing
from barpc.simulate import Look, fly
from tests.lanes import diagonal, rest_slow
from tests.sensor.radar_documents import document
from tests.sensor.s1_product import Product

TIED = 300
NOISE = 0.1  # px
Move = Callable[[Curve], Curve]


@dataclass(frozen=True)
class Opaque:
    """A camera of which nothing is known but its three methods."""

    model: Clocked

    def project(self, ground: Array) -> Array:
        return self.model.project(ground)

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        return self.model.project_jacobian(ground)

    def localize(self, image: Array, alt: Array) -> Array:
        return self.model.localize(image, alt)


def moved(off: tuple[float, ...], rate: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Move:
    """An orbit put aside along the flight, across and up [m], and more every second [m/s]."""

    def move(orbit: Curve) -> Curve:
        middle = orbit.knots.mean()
        position, velocity = (part[:, 0] for part in orbit(np.array([middle])))
        across = np.cross(velocity, position)
        axes = np.stack([velocity, across, np.cross(across, velocity)])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        coeffs = orbit.coeffs.copy()
        coeffs[:, 0] += (off - np.array(rate) * (middle - orbit.knots[0])) @ axes
        coeffs[:, 1] += rate @ axes
        return Curve(orbit.knots, coeffs)

    return move


@dataclass(frozen=True)
class Scene:
    """Views as delivered, their exact cameras, and ground that all see: tie points, then others."""

    views: tuple[View, ...]
    exact: tuple[SensorModel, ...]
    ground: Array

    def image(self) -> Array:
        """Where the exact cameras see the ground (N, P, 2) [px]."""
        return np.stack([camera.project(self.ground) for camera in self.exact])

    def tracks(self, views: int = 3) -> Tracks:
        noise = np.random.default_rng(6).normal(0, NOISE, (3, TIED, 2))
        xy = (self.image()[:, :TIED] + noise)[:views].reshape(-1, 2)
        view, point = np.repeat(np.arange(views), TIED), np.tile(np.arange(TIED), views)
        return Tracks(view, point, xy, np.full(len(xy), NOISE))

    def as_one_of(self, change: Callable[[SensorModel], SensorModel]) -> Scene:
        """The same with another camera of the radar view, the last."""
        *others, radar = self.views
        return replace(self, views=(*others, replace(radar, sensor=change(radar.sensor))))

    def misses(self, cameras: tuple[SensorModel, ...]) -> tuple[Array, Array]:
        """Of ground that took no part: RMS (N, 2) [px] in each view, and errors east, north, up [m]."""
        seen, count = self.image()[:, TIED:], len(self.ground) - TIED
        rows = np.repeat(np.arange(3), count), np.tile(np.arange(count), 3), seen.reshape(-1, 2)
        found = triangulate(cameras, *rows, alt=float(self.ground[:, 2].mean()))
        error = (found.points - ecef_from_ground(self.ground[TIED:])) @ enu_basis(self.ground[0]).T
        return np.sqrt((found.residuals.reshape(3, count, 2) ** 2).mean(axis=1)), error


def swung(camera: Pushbroom, rng: np.random.Generator) -> Pushbroom:
    """A pushbroom whose attitude is off by microradians and goes on so, its orbit by metres."""
    attitude, orbit = camera.attitude.coeffs.copy(), camera.orbit.coeffs.copy()
    attitude[:, 0] += rng.normal(0, 8e-6, 3)
    attitude[:, 1] += rng.normal(0, 1e-7, 3)
    orbit[:, 0] += rng.normal(0, 2.0, 3)
    return replace(camera, orbit=Curve(camera.orbit.knots, orbit), attitude=Curve(camera.attitude.knots, attitude))


@dataclass(frozen=True)
class Elsewhere:
    """What a SICD image states, of an antenna that was not where it states, and of ranges that are shorter."""

    formation: Formation
    track: Curve
    far: float

    def at(self, x: Array, y: Array, orbit: Curve) -> Aperture:
        stated = self.formation.at(x, y, orbit)
        position, velocity = self.track(stated.time)
        return stated._replace(position=position, velocity=velocity, distance=stated.distance - self.far)


def radars(kind: str, folder: Path, move: Move, far: float) -> tuple[Clocked, Clocked]:
    """A radar as delivered and as it was: on another orbit, its ranges less by `far` [m]."""
    if kind == "slc":
        radar = Product().model()
        frame = replace(radar.frame, first_range_time=radar.frame.first_range_time - 2.0 * far / SPEED_OF_LIGHT)
        return radar, replace(radar, orbit=move(radar.orbit), frame=frame)
    (folder / "image.xml").write_text(document(kind, squint=0.1))
    image = open_sicd(folder / "image.xml")
    return image, replace(image, formation=Elsewhere(image.formation, move(image.orbit), far))


def scene_of(kind: str, folder: Path, move: Move, far: float = 0.0, seed: int = 3) -> Scene:
    """A radar on a moved orbit and two optical images, 12 degrees to both sides."""
    rng, (radar, exact) = np.random.default_rng(seed), radars(kind, folder, move, far)
    target, side, half, alt = np.array([5.4, 43.3, 120.0]), 2000, 250.0, (-100.0, 400.0)
    if kind == "slc":
        target = radar.localize(np.array([1e4, 6e3]), np.array(300.0))
        side, half, alt = 20000, 4000.0, (0.0, 1000.0)
    flown = [fly(target, Look(12.0, azimuth), (side, side), 0.5) for azimuth in (10.0, 190.0)]
    views = [View(f"optical{k}", "", (side, side), swung(camera, rng), alt) for k, camera in enumerate(flown)]
    views.append(View("radar", "", radar.size, radar, alt))
    spread = np.array([half, half, 0.2 * (alt[1] - alt[0])]) / metres_per_unit(target)
    return Scene(tuple(views), (*flown, exact), target + rng.uniform(-1, 1, (2 * TIED, 3)) * spread)


MOVED = moved((4.0, -3.0, 2.0), (0.02, -0.03, 0.03)), 3.0


@pytest.fixture(scope="module", params=rest_slow(["slc", "PFA", "PLANE"], keep=1))
def scene(request, tmp_path_factory) -> Scene:
    if request.param == "slc":
        return request.getfixturevalue("slc")
    return scene_of(request.param, tmp_path_factory.mktemp("radar"), *MOVED)


@pytest.fixture(scope="module")
def slc(tmp_path_factory) -> Scene:
    return scene_of("slc", tmp_path_factory.mktemp("slc"), *MOVED)


@pytest.fixture(scope="module")
def found(slc: Scene) -> Adjustment:
    return adjust_tracks(slc.views, slc.tracks())


@pytest.mark.landing(1)
@pytest.mark.slow
def test_a_moved_orbit_is_followed_by_clocks_as_well_as_by_an_attitude(request, scene: Scene) -> None:
    known = scene is request.getfixturevalue("slc")
    clocks = request.getfixturevalue("found") if known else adjust_tracks(scene.views, scene.tracks())
    turned = adjust_tracks(scene.as_one_of(Opaque).views, scene.tracks())
    (before, _), (after, error), (there, other) = (
        scene.misses(cameras) for cameras in ([view.sensor for view in scene.views], clocks.sensors, turned.sensors)
    )
    assert before.max() > 2.0
    assert before[2].max() > 0.5
    assert 0.0005 < after.max() < 0.03
    assert (after < there + 0.004).all()
    shape, turned_shape = (np.sqrt(((e - e.mean(axis=0)) ** 2).mean()) for e in (error, other))
    assert shape < 1.2 * turned_shape + 1e-3 < 0.1
    assert isinstance(clocks.corrections[2], Timing)
    assert isinstance(turned.corrections[2], Correction)
    assert 0.9 < clocks.noise < 1.2


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize(("kind", "alone"), diagonal(["PFA", "slc"], [False, True]))
def test_reflectors_seen_by_the_radar_alone_tell_both_offsets(kind, alone, tmp_path) -> None:
    """Ranges are written too long, so that range is added; the orbit is late, so that time is taken off."""
    far, late, count = 4.2, 6e-4, 6
    made = scene_of(kind, tmp_path, lambda orbit: Curve(orbit.knots - late, orbit.coeffs), far)
    index, rng = np.arange(count), np.random.default_rng(1)
    corners = GroundPoints(
        tuple("abcdef"),
        made.ground[:count],
        np.full((count, 3), 0.01),
        index,
        np.full(count, 0 if alone else 2),
        made.image()[2, :count] + rng.normal(0, 0.01, (count, 2)),
        np.full(count, 0.01),
    )
    views, tracks = (made.views[2:], made.tracks(0)) if alone else (made.views, made.tracks())
    result = adjust_tracks(views, tracks, AdjustOptions(noise_floor=1e-6, drift=0), corners)
    (told,), known = result.corrections[-1].coeffs, result.covariance.view(len(views) - 1)
    assert told[0] == pytest.approx(far, abs=0.03)
    assert told[1] == pytest.approx(-late, abs=1e-5)
    assert np.sqrt(np.diag(known)[:2]).max() < 0.1  # m
    if not alone:
        assert made.misses(result.sensors)[0].max() < 0.02


@pytest.mark.slow
def test_a_radar_that_is_known_well_gives_the_block_its_place(slc: Scene) -> None:
    """The two directions that it measures are as exact as its clocks are said to be; the attitude of a camera not."""
    near = scene_of("slc", Path(), moved((0.3, -0.2, 0.2)))
    near = near.as_one_of(lambda model: replace(model, accuracy=(0.5, 0.5)))
    clocks, turned = (adjust_tracks(s.views, s.tracks()) for s in (near, near.as_one_of(Opaque)))
    off, apart = (
        np.abs(near.exact[2].project(ground_from_ecef(found.points)) - near.image()[2, :TIED]).mean(axis=0)
        * [2.33, 13.9]
        for found in (clocks, turned)
    )
    assert off.max() < 0.6  # m
    assert apart.max() > 3 * off.max()
    assert 0.1 * turned.gauge.sigma.min() < clocks.gauge.sigma.min() < 0.3 * turned.gauge.sigma.min()


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("model", "drift"),
    [("rotation+translation", 0), ("translation", 0), ("rotation", 2), ("rotation+translation", 1)],
)
def test_derivatives_by_unknowns_are_central_differences(slc: Scene, model, drift) -> None:
    unknowns = make_unknowns(slc.views, model, drift)
    params = np.random.default_rng(3).normal(0, 5.0, (3, unknowns.size))
    ecef, bounds = ecef_from_ground(np.tile(slc.ground[:10], (3, 1))).T, np.array([0, 10, 20, 30])
    seen = slc.image()[:, :10].reshape(-1, 2).T
    cameras = Cameras(slc.views, unknowns, seen)
    found = cameras.project(params, ecef, bounds)
    for j in range(unknowns.size):
        step = np.zeros_like(params)
        step[:, j] = 0.5
        high, low = (cameras.project(params + s * step, ecef, bounds, "image").image for s in (1, -1))
        np.testing.assert_allclose(found.by_unknown[:, j], high - low, rtol=0, atol=1e-5)
    used = np.abs(found.by_unknown[:, :, 20:]).max(axis=(0, 2)) > 0
    starts = [0, *range(unknowns.size - 3 * drift, unknowns.size, 3)]
    assert np.flatnonzero(used).tolist() == [at + k for at in starts for k in range(2)]
    alone = unknowns.corrected(params, slc.views)[2].project(slc.ground[:10])
    np.testing.assert_allclose(found.image[:, 20:].T, alone, rtol=0, atol=1e-7)
    assert np.abs(alone - slc.views[2].sensor.project(slc.ground[:10])).min() > 0.01


def test_priors_of_clocks_stand_at_their_unknowns(slc: Scene) -> None:
    silent = slc.as_one_of(lambda model: replace(model, accuracy=None)).views
    for views, wanted in ((slc.views, slc.views[2].sensor.accuracy), (silent, (7.5, 7.5))):
        np.testing.assert_allclose(prior_sigmas(views, AdjustOptions(), 1)[2, :2], wanted)
        np.testing.assert_allclose(prior_sigmas(views, AdjustOptions(model="translation"), 0)[2, :2], wanted)
        given = prior_sigmas(views, AdjustOptions(sigma_position=2.0, sigma_attitude=9.0), 1)
        np.testing.assert_array_equal(given[2, [0, 1, 6, 7]], [2.0, 2.0, 0.2, 0.2])
    assert (prior_sigmas(slc.views, AdjustOptions(sigma_attitude=9.0), 1)[0, :3] == 9.0).all()
    off = np.array([0.0, 0.0, 30.0])
    np.testing.assert_array_equal(prior_sigmas(slc.views, AdjustOptions(), 0, off)[2, :2], 30.0)


@pytest.mark.slow
def test_a_radar_goes_on_as_a_radar_only(slc: Scene, found: Adjustment, tmp_path) -> None:
    block_prior(found).save(tmp_path / "prior.npz")
    prior = BlockPrior.load(tmp_path / "prior.npz")
    assert prior.radars == ("radar",)
    held = adjust_tracks(slc.views, slc.tracks(), AdjustOptions(fixed=("radar",)))
    assert block_prior(held).radars == ()  # a view that was fixed is not handed on
    again = adjust_tracks(slc.views, slc.tracks(), prior=prior)
    np.testing.assert_allclose(again.corrections[2].coeffs[0], found.corrections[2].coeffs[0], atol=0.05)
    with pytest.raises(InputError, match="corrected radar otherwise, as a radar or not as one"):
        adjust_tracks(slc.as_one_of(Opaque).views, slc.tracks(), prior=prior)
    with pytest.raises(InputError, match="corrected radar otherwise"):
        adjust_tracks(slc.views, slc.tracks(), prior=replace(prior, radars=()))


@pytest.mark.slow
def test_the_summary_states_metres_and_milliseconds(slc: Scene, found: Adjustment) -> None:
    summary = summarize(Run("adjust", slc.views, (), slc.tracks(), adjustment=found))
    told, (first, _, radar) = found.corrections[2], (view.correction for view in summary.views)
    assert (radar.range_m, radar.azimuth_ms) == pytest.approx((told.coeffs[0, 0], 1e3 * told.coeffs[0, 1]))
    np.testing.assert_allclose(radar.timing_slopes, told.coeffs[1:] * [1.0, 1e3])
    np.testing.assert_allclose(radar.timing_sigma, np.array(radar.sigma[:2]) / [1.0, 7.59], rtol=1e-3)
    middle = slc.views[2].sensor.localize((np.array(slc.views[2].size) - 1) / 2, np.array(300.0))
    shift = found.sensors[2].project(middle) - slc.views[2].sensor.project(middle)
    np.testing.assert_allclose(radar.center_shift_px, shift, atol=1e-3)
    np.testing.assert_allclose(radar.center_sigma_px, np.array(radar.timing_sigma) * [0.4293, 0.4865], rtol=1e-3)
    assert radar.rotation_urad is None
    assert first.range_m is None
    line = next(line for line in summary.verdict if "timing" in line)
    assert line.startswith(f"Radar timing corrections: radar: range {told.coeffs[0, 0]:+.2f} ± ")
    assert line.endswith(" ms.")
    assert json_form(summary)["views"][2]["correction"]["range_m"] == radar.range_m
