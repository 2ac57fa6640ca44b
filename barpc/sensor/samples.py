"""The camera of one image from samples of its orbit and attitude, whoever states them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.polynomial import polyfit, polyval

from barpc.base.errors import RpcError, RpcFormatError
from barpc.base.geodesy import Array, ecef_from_ground
from barpc.sensor.curve import EXTRAPOLATION, Curve, attitude_through
from barpc.sensor.pushbroom import Pushbroom

ATTITUDE_STEP = 0.02  # s: at which an attitude is sampled that is given otherwise

_GAP_STEPS = 4.0  # times the usual step: a longer one is a gap that nothing bridges
_FASTEST = 0.3  # rad/s: no imaging satellite turns so fast
_QUATERNION_TOLERANCE = 1e-3  # by which the length of a quaternion may miss 1
_RADII = (6.5e6, 8e6)  # m from the Earth's centre
_ORBIT, _RATE = 7e6, 1.2e-3  # m, rad/s: radius and turn of an orbit: of its Taylor series in time
_TRACK_DEGREES, _TERM_TOLERANCE = range(2, 7), 1e-5  # m: the first degree whose next term is smaller is taken
_SCATTER = 0.01  # m, RMS: samples farther from the polynomial are not noise
_MAX_VELOCITY_DIFFERENCE = 700.0  # m/s: above the Earth's rotation: of stated velocities and those of positions


@dataclass(frozen=True, eq=False)
class Samples:
    """Sampled positions and attitudes of a vendor, times in seconds from that of row 0."""

    name: str  # the file, for messages
    times: Array  # (N,) of the positions
    positions: Array  # (N, 3) of the camera, ECEF [m]
    velocities: Array  # (N, 3), stated [m/s]: they must agree with the positions
    ticks: Array  # (M,) of the attitudes
    quaternions: Array  # (M, 4) ecef_from_camera, scalar first, of either sign


@dataclass(frozen=True, eq=False)
class Detector:
    """Lines of sight of rows and columns in camera axes; see `Pushbroom`."""

    look: Array
    look_origin: float
    line_period: float
    size: tuple[int, int]  # width, height [px]


@dataclass(frozen=True, eq=False)
class Linescan:
    """A vendor's physical model and the size of its image."""

    model: Pushbroom
    size: tuple[int, int]
    kind: str = ""  # whose
    corners: Array | None = None  # (N, 4): lon, lat [deg] at altitude 0, col, row [px] of image points, as stated


def camera_of_samples(samples: Samples, detector: Detector, sigma: tuple[float, float] | None = None) -> Linescan:
    """Return the camera of samples; `sigma`: stated standard deviations of attitude [rad] and position [m].

    RpcFormatError for samples that cannot be those of one image.
    """
    name, last = samples.name, detector.line_period * (detector.size[1] - 1)
    span = (min(0.0, last), max(0.0, last))
    check_times(samples.times, span, "positions", name)
    check_times(samples.ticks, span, "attitudes", name)
    _check_orbit(samples)
    _check_turn(samples)
    try:
        mount, attitude = attitude_through(samples.ticks, samples.quaternions)
        orbit = _track(samples.times, samples.positions)
        model = Pushbroom(orbit, attitude, mount, detector.look, detector.look_origin, detector.line_period)
    except RpcError as error:
        raise RpcFormatError(f"{name}: {error}") from error
    middle = model.localize((np.array(detector.size) - 1) / 2, np.zeros(()))
    if not np.isfinite(middle).all():
        raise RpcFormatError(f"{name}: its camera does not look at the Earth; is the attitude that of the image?")
    if sigma is not None and min(sigma) > 0:
        place = model.position((detector.size[1] - 1) / 2)
        far = float(np.linalg.norm(ecef_from_ground(middle) - place))
        model = replace(model, accuracy=(sigma[0] * far, sigma[1]))
    return Linescan(model, detector.size)


def _track(times: Array, positions: Array) -> Curve:
    """Return the position over time: a polynomial that any orbit follows for so long, or else a spline.

    Dense samples scatter by millimetres, which a curve through them all carries beyond the first by centimetres.
    """
    half = 0.5 * (times[-1] - times[0])
    terms = ((d, _ORBIT * (_RATE * half) ** (d + 1) / math.factorial(d + 1)) for d in _TRACK_DEGREES)
    degree = next((d for d, term in terms if term < _TERM_TOLERANCE), 0)
    if degree and len(times) > degree + 1:
        since = times - times[0]
        coeffs = polyfit(since, positions, degree)
        if np.sqrt(((polyval(since, coeffs).T - positions) ** 2).mean()) <= _SCATTER:
            return Curve.polynomial(coeffs, times[0], times[-1])
    return Curve.through(times, positions)


def unit(quaternions: Array, name: str) -> Array:
    """Return quaternions (N, 4) scaled to length 1; RpcFormatError where theirs is another."""
    length = np.linalg.norm(quaternions, axis=1)
    if not (np.abs(length - 1.0) < _QUATERNION_TOLERANCE).all():
        raise RpcFormatError(f"{name}: a quaternion of length {length[np.abs(length - 1).argmax()]:.4g}, not 1")
    return np.asarray(quaternions / length[:, None])


def check_times(times: Array, span: tuple[float, float], what: str, name: str) -> None:
    """Raise RpcFormatError where the times (N,) of samples do not rise, or leave a part of a span [s] without any."""
    steps = np.diff(times)
    if len(times) < 4 or not (steps > 0).all():
        raise RpcFormatError(f"{name}: {len(times)} {what}, or their times do not rise; four or more are needed")
    usual = float(np.median(steps))
    margin = min(EXTRAPOLATION, 0.5 * _GAP_STEPS * usual)  # as far as from a sample in the longest gap
    if times[0] - margin > span[0] or times[-1] + margin < span[1]:
        raise RpcFormatError(
            f"{name}: the image lasts from {span[0]:.2f} to {span[1]:.2f} s, its {what} from {times[0]:.2f} to "
            f"{times[-1]:.2f} s; is the list complete?"
        )
    gap = (steps > _GAP_STEPS * usual) & (times[1:] > span[0]) & (times[:-1] < span[1])
    if gap.any():
        at = int(np.argmax(gap))
        raise RpcFormatError(
            f"{name}: no {what} from {times[at]:.2f} to {times[at + 1]:.2f} s, within the image: they come every "
            f"{usual:.3g} s"
        )


def _check_orbit(samples: Samples) -> None:
    radius = np.linalg.norm(samples.positions, axis=1)
    if not ((radius > _RADII[0]) & (radius < _RADII[1])).all():
        raise RpcFormatError(
            f"{samples.name}: positions {radius.min():.4g} to {radius.max():.4g} m from the Earth's centre, no "
            "satellite's orbit; metres and ECEF are expected"
        )
    moved = np.gradient(samples.positions, samples.times, axis=0)
    off = np.linalg.norm(moved - samples.velocities, axis=1)[1:-1]
    if not off.max() < _MAX_VELOCITY_DIFFERENCE:
        raise RpcFormatError(
            f"{samples.name}: positions move by {off.max():.4g} m/s otherwise than their stated velocities; are the "
            "times right?"
        )


def _check_turn(samples: Samples) -> None:
    q = unit(samples.quaternions, samples.name)
    half = np.arccos(np.minimum(np.abs((q[1:] * q[:-1]).sum(axis=1)), 1.0))
    rate = 2.0 * half / np.diff(samples.ticks)
    if not rate.max() < _FASTEST:
        at = int(rate.argmax())
        raise RpcFormatError(
            f"{samples.name}: the attitude turns by {rate[at]:.3g} rad/s at {samples.ticks[at]:.2f} s, as no "
            "satellite does; a damaged quaternion"
        )
