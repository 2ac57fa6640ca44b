"""The adjustment written a second time, plainly: one residual vector, differenced, solved densely.

Nothing of `barpc.ba` or `barpc.sensor` is called here: pyproj turns coordinates, scipy turns vectors, the
rational functions are spelled out. What the solver reduces and whitens must agree with this.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyproj
from scipy.spatial.transform import Rotation

_TO_GROUND = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
_TO_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def ecef_of(ground: Any) -> np.ndarray:
    """lon, lat, alt (..., 3) -> ECEF [m]."""
    return np.stack(_TO_ECEF.transform(*np.moveaxis(np.asarray(ground, dtype=float), -1, 0)), axis=-1)


def ground_of(ecef: Any) -> np.ndarray:
    """ECEF (..., 3) [m] -> lon, lat, alt."""
    return np.stack(_TO_GROUND.transform(*np.moveaxis(np.asarray(ecef, dtype=float), -1, 0)), axis=-1)


def enu_of(lon: float, lat: float) -> np.ndarray:
    """Rows east, north, up."""
    a, b = np.radians([lon, lat])
    up = [np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)]
    east = [-np.sin(a), np.cos(a), 0.0]
    return np.array([east, np.cross(up, east), up])


def project_rpc(rpc: Any, ground: np.ndarray) -> np.ndarray:
    """Col, row (n, 2) of ground points (n, 3), the twenty terms of RPC00B spelled out."""
    L, P, H = ((ground - rpc.ground_offset) / rpc.ground_scale).T
    terms = np.array([
        L**0, L, P, H, L * P, L * H, P * H, L * L, P * P, H * H, P * L * H, L**3, L * P**2, L * H**2, L**2 * P,
        P**3, P * H**2, L**2 * H, P**2 * H, H**3,
    ])  # fmt: skip
    col, col_den, row, row_den = rpc.coeffs @ terms
    return np.stack([col / col_den, row / row_den], axis=1) * rpc.image_scale + rpc.image_offset


@dataclass
class Plain:
    """A block of RPC views: rotation and translation each, drift of a degree, GCPs, a sloping terrain."""

    views: Any
    centers: np.ndarray
    drift: int
    view: np.ndarray
    point: np.ndarray
    xy: np.ndarray
    sigma: np.ndarray
    camera_sigma: np.ndarray
    gcps: list[tuple[int, np.ndarray, np.ndarray]] = field(default_factory=list)  # point, lonlatalt, sigma
    planes: list[tuple[int, Any, float]] = field(default_factory=list)  # point, point -> height above, sigma
    design: np.ndarray | None = None  # common errors of these heights, a column each [m]

    def __post_init__(self) -> None:
        middle = [
            ecef_of(view.sensor.localize((np.array(view.size) - 1) / 2, sum(view.alt_range) / 2)) for view in self.views
        ]
        self.distance = np.linalg.norm(self.centers - middle, axis=1)

    def image(self, v: int, params: np.ndarray, ecef: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Where view v sees points (n, 3) through its correction, the drift being that of rows (n,)."""
        view, distance = self.views[v], self.distance[v]
        turned = Rotation.from_rotvec(params[:3] / distance).apply(ecef - params[3:6] - self.centers[v])
        t = (row - (view.size[1] - 1) / 2) / (view.size[1] / 2)
        omega = np.zeros((len(ecef), 3))
        for k in range(self.drift):
            omega = omega + t[:, None] ** (k + 1) * params[6 + 3 * k : 9 + 3 * k] / distance
        turned = Rotation.from_rotvec(omega).apply(turned)
        return project_rpc(view.sensor, ground_of(turned + self.centers[v]))

    def residual(self, params: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Every whitened residual: ties, camera priors, GCPs, heights."""
        seen = np.empty_like(self.xy)
        for v in range(len(params)):
            rows = self.view == v
            seen[rows] = self.image(v, params[v], points[self.point[rows]], self.xy[rows, 1])
        rows = [((seen - self.xy) / self.sigma[:, None]).ravel()]
        rows.append((params / self.camera_sigma).ravel())
        for p, lonlatalt, sigma in self.gcps:
            rows.append(enu_of(*lonlatalt[:2]) @ (points[p] - ecef_of(lonlatalt)) / sigma)
        if self.planes:
            heights = np.array([float(plane(points[p])[()]) for p, plane, _ in self.planes])
            covariance = np.diag([sigma**2 for _, _, sigma in self.planes])
            if self.design is not None:
                covariance = covariance + self.design @ self.design.T
            rows.append(np.linalg.solve(np.linalg.cholesky(covariance), heights))
        return np.concatenate(rows)

    def jacobian(self, params: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Central differences, cameras first, then points."""
        flat = np.concatenate([params.ravel(), points.ravel()])
        split = params.size

        def at(x: np.ndarray) -> np.ndarray:
            return self.residual(x[:split].reshape(params.shape), x[split:].reshape(points.shape))

        columns = []
        for i in range(len(flat)):
            step = np.zeros(len(flat))
            step[i] = 1.0
            columns.append((at(flat + step) - at(flat - step)) / 2.0)
        return np.array(columns).T
