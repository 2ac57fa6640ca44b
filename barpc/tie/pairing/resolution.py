"""Pairs of other resolutions: the finer image is brought to the pixel of the coarser one before anything compares them.

A view that takes part in such a pair is looked at once more, by means of whole pixels along its columns and rows: a
look. It is a view like any other: all stages work on looks, with their thresholds in pixels that both images of a pair
resolve. Tracks go back to the pixels of the files at the end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from barpc.base.frozen import Frozen
from barpc.base.geodesy import Array, metres_per_unit
from barpc.scene import IntArray, Tracks, View
from barpc.sensor import SensorModel
from barpc.tie.pairing.overlaps import Pair

PixelFactors = tuple[int, int]


@dataclass(frozen=True, eq=False, repr=False)
class Coarser(Frozen):
    """Camera of an image averaged over whole blocks of pixels.

    Parameters
    ----------
    sensor : SensorModel, of the image as it is
    pixel : (2,), columns and rows of it that a pixel holds
    """

    sensor: SensorModel
    pixel: Array

    def project(self, ground: Array) -> Array:
        """Project ground points, as in `SensorModel`."""
        return coarser(self.sensor.project(ground), self.pixel)

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Project ground points with derivatives, as in `SensorModel`."""
        image, jacobian = self.sensor.project_jacobian(ground)
        return coarser(image, self.pixel), jacobian / self.pixel[:, None]

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points, as in `SensorModel`."""
        return self.sensor.localize(finer(image, self.pixel), alt)


def coarser(xy: Array, pixel: Array) -> Array:
    """Return places (..., 2) [px] counted in blocks of pixels (2,); for blocks of one pixel the same bits."""
    return np.asarray((xy - 0.5 * (pixel - 1.0)) / pixel)


def finer(xy: Array, pixel: Array) -> Array:
    """Return places counted in pixels from those in blocks: the inverse of `coarser`."""
    return np.asarray(xy * pixel + 0.5 * (pixel - 1.0))


@dataclass(frozen=True, eq=False)
class Looks:
    """Views of a block, each with its looks: averaged versions for partners of coarser pixels."""

    views: tuple[View, ...]
    """All looks, those of a view together, itself first."""
    pixel: Array  # (L, 2) columns and rows of the file that a look's pixel holds
    of: IntArray  # (L,) the view that each is of
    ends: Mapping[PixelFactors, PixelFactors]
    """Pairs of views, ascending -> the looks, ascending, at which they are compared."""

    @classmethod
    def at(cls, views: Sequence[View], pairs: Sequence[Pair], apart: bool = True) -> Looks:
        """Return the looks that pairs need; with none of other resolutions (`apart`) the views themselves."""
        scale, whole = [_scale(view) for view in views], (1, 1)
        most = [(math.isqrt(v.size[0]), math.isqrt(v.size[1])) for v in views]  # a look is not smaller than its pixel
        wanted = {
            (i, j): _reduction_factors((scale[i], scale[j]), (most[i], most[j])) if apart else (whole, whole)
            for i, j in (p.views for p in pairs)
        }
        each = {(i, whole) for i in range(len(views))}
        each |= {end for pair, pixels in wanted.items() for end in zip(pair, pixels, strict=True)}
        looks = sorted(each)
        number = {look: k for k, look in enumerate(looks)}
        ends = {(i, j): (number[i, pixels[0]], number[j, pixels[1]]) for (i, j), pixels in wanted.items()}
        seen = tuple(views[i] if pixel == whole else _reduced_view(views[i], pixel) for i, pixel in looks)
        pixel, of = np.array([pixel for _, pixel in looks]), np.array([i for i, _ in looks])
        return cls(seen, pixel.astype(np.float64).reshape(-1, 2), of, ends)

    def pair(self, pair: Pair) -> Pair:
        """Return a pair of views as a pair of looks."""
        return replace(pair, views=self.ends[pair.views])

    def places(self, pair: PixelFactors, xy: Array) -> Array:
        """Return places (M, 2, 2) [px] in two views counted in the pixels of their looks."""
        return coarser(xy, self.pixel[list(self.ends[pair])])

    def tracks(self, found: Tracks) -> Tracks:
        """Return tracks over looks as tracks over views; of two looks of a view the more accurate one counts."""
        pixel, view = self.pixel[found.view], self.of[found.view]
        sigma = found.sigma * pixel.max(axis=1)
        order = np.lexsort((sigma, view, found.point))
        rows = order[np.unique(np.stack([found.point, view])[:, order], axis=1, return_index=True)[1]]
        return Tracks(view[rows], found.point[rows], finer(found.xy, pixel)[rows], sigma[rows])


def _scale(view: View) -> Array:
    """Return the derivative (2, 2) of the place in an image by that on the ground, in its middle [px/m east, north]."""
    ground = view.sensor.localize((np.array(view.size) - 1.0) / 2.0, np.array(view.altitude))
    return view.sensor.project_jacobian(ground)[1][:, :2] / metres_per_unit(ground)[:2]


def _reduction_factors(
    scales: tuple[Array, Array], most: tuple[PixelFactors, PixelFactors]
) -> tuple[PixelFactors, PixelFactors]:
    """Return the columns and rows, at most `most`, that a pixel of the looks of two images of scales (2, 2) holds.

    The whole number nearest to the other's pixel over its own, along either axis: below a ratio of 1.5 images are
    compared as they are, above it by pixels that differ by a third at most. Registration takes that for distortion.
    """
    if not all(np.isfinite(scale).all() and np.linalg.det(scale) for scale in scales):
        return (1, 1), (1, 1)
    across = scales[1] @ np.linalg.inv(scales[0])  # d(second)/d(first)
    found = []
    for step, limit in zip((across, np.linalg.inv(across)), most, strict=True):
        columns, rows = np.rint(1.0 / np.linalg.norm(step, axis=0)).clip(1, limit).astype(int).tolist()
        found.append((columns, rows))
    return found[0], found[1]


def _reduced_view(view: View, pixel: PixelFactors) -> View:
    """Return a view by means of so many columns and rows."""
    size = view.size[0] // pixel[0], view.size[1] // pixel[1]
    return replace(view, size=size, sensor=Coarser(view.sensor, np.array(pixel, dtype=np.float64)))
