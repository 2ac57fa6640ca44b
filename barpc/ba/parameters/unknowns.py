"""The unknowns of each view in metres (or pixels), and the camera correction that they parametrise.

Geometric models scale rotations to metres on the ground (angle x distance to the scene), so that all unknowns have
similar effects. The unknowns of image models are displacements at the edge of the image [px].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from barpc.ba.parameters.additional_parameters import AdditionalParameters
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.scene import IntArray, View
from barpc.sensor import SensorModel
from barpc.sensor.centers import camera_centers
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.image_corrections import ImageAffine, ImageCorrected, Splined
from barpc.sensor.rpc import localize_stack

_IMAGE_TERMS = {"shift": (0,), "shift-drift": (0, 2), "affine": (0, 1, 2)}
"""Image model -> indices of the terms (1, col, row) in the correction of each coordinate."""


@dataclass(frozen=True)
class Unknowns:
    """Layout of the unknowns of N views."""

    model: str  # a name of `AdjustOptions.model`
    drift: int  # degree of the rotation as a polynomial in the image row; 0: constant
    center: Array  # (N, 3) camera centres [m], ECEF
    distance: Array  # (N,) from the centre to the scene [m]: a rotation unknown is angle x distance
    middle: Array  # (2, N) middle of each image, col and row [px]
    half: Array  # (2, N) half the width and height of each image [px]
    # (N, 2) ground position of the middle of each image, east and north of their mean [m]
    place: Array = field(default_factory=lambda: np.zeros((0, 2)))
    waves: AdditionalParameters | None = None  # additional parameters in the images
    direction: Array | None = None  # (N, 3) line of sight of the middle of each image, ECEF

    @property
    def geometric(self) -> bool:
        """Whether the correction moves the camera in space; else it moves image points."""
        return self.model not in _IMAGE_TERMS

    @property
    def size(self) -> int:
        """Number of unknowns q of a view."""
        return self._model_size + (0 if self.waves is None else self.waves.size)

    @property
    def _model_size(self) -> int:
        """Number of unknowns of a view before its additional parameters."""
        return self.constants + 3 * self.drift if self.geometric else 2 * len(_IMAGE_TERMS[self.model])

    @property
    def constants(self) -> int:
        """Number of unknowns of the constant rotation and translation of a view; the drift follows."""
        return 3 * (self.rotates + self.translates)

    @property
    def in_waves(self) -> slice:
        """Slice of the additional parameters among the unknowns of a view."""
        return slice(self._model_size, self.size)

    @property
    def sight(self) -> Array | None:
        """Unit changes (N, q) of the unknowns that rotate a view about its line of sight; None without rotations."""
        if self.direction is None or not self.geometric or not self.rotates:
            return None
        out = np.zeros((len(self.direction), self.size))
        out[:, :3] = self.direction
        return out

    @property
    def rotates(self) -> bool:
        """Whether the model has rotations."""
        return "rotation" in self.model

    @property
    def translates(self) -> bool:
        """Whether the model has translations."""
        return "translation" in self.model

    def rotation(self, params: Array, views: slice = slice(None)) -> Array:
        """Return the rotation vectors (n, 3) [rad] at the middle row, for unknowns (n, q) of the views."""
        if not self.rotates:
            return np.zeros((len(params), 3))
        return params[:, :3] / self.distance[views, None]

    def translation(self, params: Array) -> Array:
        """Return the translations (N, 3) [m]."""
        if not self.translates:
            return np.zeros((len(params), 3))
        start = 3 * self.rotates
        return params[:, start : start + 3]

    def drift_vectors(self, params: Array, views: slice = slice(None)) -> Array:
        """Return the drift (n, D, 3) [rad]: rotation vectors that multiply the powers 1 to D of the normalised row."""
        vectors = params[:, self.constants : self._model_size].reshape(len(params), self.drift, 3)
        return vectors / self.distance[views, None, None]

    def normalized(self, image: Array, index: IntArray) -> Array:
        """Return col, row (2, n) [px] normalised: -1 at the left and the top, 1 at the right and the bottom."""
        return (image - self.middle[:, index]) / self.half[:, index]

    def drift_rotation(self, params: Array, views: slice, count: IntArray, row: Array) -> Array:
        """Return the rotations (3, n) [rad] of the drift at normalised rows (n,): `count` (V,) rows for each view."""
        vectors = np.repeat(self.drift_vectors(params, views).transpose(1, 2, 0), count, axis=2)  # (D, 3, n)
        rotation: Array = vectors[-1] * row
        for degree in range(self.drift - 2, -1, -1):
            rotation = (rotation + vectors[degree]) * row
        return rotation

    def stack(
        self, by_rotation: Array, by_drift: Array, by_point: Array, inverse: Array, row: Array | None, out: Array
    ) -> None:
        """Write derivatives by the unknowns into `out` (2, q, n), from those (2, 3, n) by rotation, drift and point.

        The first two are in px/rad. `inverse` (n,) is 1 / distance of each view [1/m], `row` (n,) the normalised row.
        """
        at = 0
        if self.rotates:
            np.multiply(by_rotation, inverse, out=out[:, :3])
            at = 3
        if self.translates:
            np.negative(by_point, out=out[:, at : at + 3])
            at += 3
        scale = inverse
        for _ in range(self.drift):
            assert row is not None
            scale = scale * row
            np.multiply(by_drift, scale, out=out[:, at : at + 3])
            at += 3

    def add_waves(self, image: Array, by_unknown: Array, params: Array, index: IntArray, seen: Array) -> None:
        """Add the displacements by additional parameters at observed points `seen` (2, n) [px], and derivatives."""
        assert self.waves is not None
        row = (seen[1] - self.middle[1, index]) / self.half[1, index]
        basis = self.waves.basis(row, seen, index)
        image += self.waves.displaced(params[:, self.in_waves], index, basis)
        if by_unknown.shape[1]:
            self.waves.stack(by_unknown[:, self.in_waves], basis)

    def in_image(self, params: Array, index: IntArray, image: Array, by_point: Array) -> tuple[Array, Array, Array]:
        """Return image points (2, n) corrected by the image model, and their derivatives by point and by unknown."""
        basis = np.vstack([np.ones((1, image.shape[1])), self.normalized(image, index)])
        chosen = list(_IMAGE_TERMS[self.model])
        m = len(chosen)
        coefficients = np.zeros((2, 3, image.shape[1]))
        coefficients[:, chosen] = np.moveaxis(params[:, : 2 * m].reshape(-1, 2, m)[index], 0, -1)
        moved = image + (coefficients * basis).sum(axis=1)
        slope = coefficients[:, 1:] / self.half[:, index]
        by_moved = by_point + slope[:, 0, None] * by_point[0] + slope[:, 1, None] * by_point[1]
        by_unknown = np.zeros((2, self.size, image.shape[1]))
        by_unknown[0, :m] = by_unknown[1, m : 2 * m] = basis[chosen]
        return moved, by_moved, by_unknown

    def corrected(self, params: Array, views: Sequence[View]) -> tuple[SensorModel, ...]:
        """Return the sensor of each view with its correction by the unknowns (N, q)."""
        found = self._in_space(params, views) if self.geometric else self._in_images(params, views)
        if self.waves is not None:
            for i, one in enumerate(params[:, self.in_waves]):
                of_rows = float(self.middle[1, i]), float(self.half[1, i])
                found[i] = Splined(found[i], self.waves.correction(one, i, *of_rows))
        return tuple(found)

    def _in_space(self, params: Array, views: Sequence[View]) -> list[SensorModel]:
        """Return the sensor of each view with its correction in space."""
        vectors = self.rotation(params), self.translation(params), self.center, self.drift_vectors(params)
        rows = zip(self.middle[1].tolist(), self.half[1].tolist(), strict=True)
        corrections = [
            Correction(*of_view, *(row if self.drift else ())) for *of_view, row in zip(*vectors, rows, strict=True)
        ]
        return [Corrected(v.sensor, c) for v, c in zip(views, corrections, strict=True)]

    def _in_images(self, params: Array, views: Sequence[View]) -> list[SensorModel]:
        """Return the sensor of each view with its correction in the image."""
        normalized = np.zeros((len(params), 2, 3))
        normalized[..., list(_IMAGE_TERMS[self.model])] = params[:, : self._model_size].reshape(len(params), 2, -1)
        slope = normalized[..., 1:] / self.half.T[:, None]
        shift = normalized[..., 0] - np.einsum("nij,jn->ni", slope, self.middle)
        return [ImageCorrected(v.sensor, ImageAffine(*one)) for v, *one in zip(views, shift, slope, strict=True)]


def make_unknowns(
    views: Sequence[View],
    model: str,
    drift: int,
    centers: Array | None = None,
    waves: AdditionalParameters | None = None,
) -> Unknowns:
    """Return the layout for N views; `centers` (N, 3), ECEF [m], are estimated from the sensors if None."""
    size = np.array([view.size for view in views], dtype=np.float64).reshape(-1, 2)
    if model in _IMAGE_TERMS:
        centers = np.zeros((len(views), 3))
    elif centers is None:
        found = camera_centers([v.sensor for v in views], [v.size for v in views], [v.alt_range for v in views])
        centers = np.array([center.ecef for center in found]).reshape(-1, 3)
    altitude, number = np.array([view.altitude for view in views]), np.arange(len(views) + 1)
    scene = ecef_from_ground(localize_stack([v.sensor for v in views], (size - 1.0) / 2.0, altitude, number))
    distance = np.linalg.norm(centers - scene, axis=1)
    direction = (scene - centers) / distance[:, None]
    middle = scene.mean(axis=0)
    place = (scene - middle) @ enu_basis(ground_from_ecef(middle))[:2].T
    half = size.T / 2.0
    return Unknowns(model, drift, centers, distance, half - 0.5, half, place, waves, direction)
