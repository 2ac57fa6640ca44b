"""Cameras whose attitude swings while they scan: no RPC holds them. Flown, not made of barpc's corrections."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barpc.fit import fit_rpc
from barpc.sensor import SensorModel
from barpc.sensor.curve import Curve
from barpc.sensor.pushbroom import Pushbroom
from barpc.sensor.rpc import RPC
from barpc.simulate import Look, fly


@dataclass(frozen=True)
class Delivered:
    """A camera that came with an RPC, as a corrected one does."""

    sensor: RPC
    model: SensorModel

    def project(self, ground):
        return self.model.project(ground)

    def project_jacobian(self, ground):
        return self.model.project_jacobian(ground)

    def localize(self, image, alt):
        return self.model.localize(image, alt)


def jittered(camera: Pushbroom, period: float, pixels: float, distance: float = 1.4e6) -> Pushbroom:
    """A camera that swings about all its axes by `pixels` with a period of rows; 694 km fly by at 0.5 m pixels."""
    start, stop = camera.attitude.knots[[0, -1]]
    count = int((stop - start) / (period * camera.line_period) * 24) + 60
    times = np.linspace(start, stop, count)
    phase = 2 * np.pi * (times - camera.first_line)[:, None] / (period * camera.line_period)
    swing = pixels / distance * np.sin(phase + np.array([0.0, 1.0, 2.0]))
    return replace(camera, attitude=Curve.through(times, camera.attitude(times)[0].T + swing, degree=3))


def scene(period: float, pixels: float, size: tuple[int, int] = (8000, 8000), alt_range=(0.0, 1000.0)) -> Delivered:
    """A full camera with its RPC as delivered, which knows nothing of the jitter."""
    camera = fly(np.array([5.4, 43.3, 500.0]), Look(22.0, 140.0), size, 0.5)
    return Delivered(fit_rpc(camera, size, alt_range).rpc, jittered(camera, period, pixels))
