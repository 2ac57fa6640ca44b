"""Deformations of images by corrections: displacements of the corners of an image relative to each other.

The position of an image on the ground is given to metres, its shape to centimetres. A deformation of many prior
standard deviations is real if the tie points determine it. They do not always: a drift of two images about their base
is free. Wrong control (a DEM of another terrain) may then cause it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barpc.ba.solving.problem import Problem
from barpc.base.geodesy import Array, ecef_from_ground
from barpc.scene import View
from barpc.sensor.rpc import localize_stack

MOST_SIGMAS = 5.0  # largest deformation of an image by control alone, in prior standard deviations
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])


@dataclass(frozen=True)
class Deformation:
    """A deformation of an image that control causes and the tie points do not confirm."""

    view: int
    sigmas: float  # largest displacement of a corner relative to the mean of all, over its prior sigma
    px: float  # the same displacement [px]
    control: tuple[str, ...]  # kinds of control of the block


def shape_change(problem: Problem, params: Array, views: Sequence[View]) -> tuple[Array, Array]:
    """Return the deformation of each image by its unknowns, in prior standard deviations and in pixels.

    Parameters
    ----------
    problem : Problem
        With the priors as given, not widened.
    params : (N, q)
    views : sequence of N views

    Returns
    -------
    sigmas, px : (N,)
        Largest displacement of a corner of an image minus the mean of all four. Additional parameters are excluded:
        tie points determine them.
    """
    unknowns, count = problem.cameras.unknowns, len(views)
    corners = unknowns.middle.T[:, None] + unknowns.half.T[:, None] * _CORNERS
    image, bounds = corners.reshape(-1, 2), 4 * np.arange(count + 1)
    altitude = np.array([view.altitude for view in views])
    ground = localize_stack([view.sensor for view in views], image, np.repeat(altitude, 4), bounds)
    prior = problem.camera_prior
    cameras = problem.cameras.seeing(image.T)
    found = cameras.project(np.zeros_like(params), ecef_from_ground(ground).T, bounds).by_unknown
    by_unknown = found[:, : unknowns.in_waves.start].reshape(2, -1, count, 4)
    by_unknown = by_unknown - by_unknown.mean(axis=3, keepdims=True)
    moved, sigma = (rows[:, : unknowns.in_waves.start] for rows in (params, prior.loosest()))
    px = np.linalg.norm(np.einsum("cqnk,nq->cnk", by_unknown, moved), axis=0)
    with np.errstate(invalid="ignore", over="ignore"):
        expected = np.sqrt(np.einsum("cqnk,nq->nk", by_unknown**2, np.where(np.isfinite(sigma), sigma, 1e9) ** 2))
        times = px / np.maximum(expected, 1e-12)
    return np.nan_to_num(times.max(axis=1)), np.nan_to_num(px.max(axis=1))
