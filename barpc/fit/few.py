"""RPCs of fewer points than determine one: the smaller models that points carry, compared by leaving each point out.

Coefficients that are not of a model are 0, those of a denominator's constant 1: the result is an RPC as any other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barpc.base.errors import FitError
from barpc.base.geodesy import Array
from barpc.sensor.rational import monomials

WHOLE = 40
"""Points that determine the 39 unknowns of each coordinate of a whole RPC, and one to spare."""
NOISY = 400
"""Points from which on the noise of a whole RPC's unknowns is a third of that of a point, or less."""
BETTER = 0.9  # times the error left out: a larger model must be better by a tenth, the scatter of an error of 16 points
_PASSES = 4  # in which a projective model is weighted by its denominator: it varies by some per cent


@dataclass(frozen=True)
class SmallModel:
    """A model of few terms: its name, terms of a numerator, whether denominators are linear, the points it needs."""

    name: str
    terms: int
    projective: bool
    least: int


MODELS = (
    SmallModel("an affine without heights", 3, False, 4),
    SmallModel("an affine with heights", 4, False, 8),
    SmallModel("a projective camera", 4, True, 11),
    SmallModel("quadratic polynomials", 10, False, 16),
)
"""The simplest first; of points at one altitude the first alone."""


@dataclass(frozen=True, eq=False)
class FewFit:
    """Coefficients (4, 20) of a model, and the residuals (N, 2) [px, normalised] of points left out in turn."""

    model: SmallModel
    coeffs: Array
    left_out: Array

    @property
    def error(self) -> float:
        """Root mean square of the residuals left out."""
        return float(np.sqrt((self.left_out**2).sum(axis=1).mean()))


def fit_few(place: Array, image: Array, weight: Array | None = None) -> FewFit:
    """Fit the largest model that few points carry.

    Parameters
    ----------
    place, image : (N, 3), (N, 2), normalised ground and image points
    weight : (N,) or None, 1 / standard deviation

    Returns
    -------
    FewFit

    Raises
    ------
    FitError
        Fewer than four points.
    """
    count, flat = len(place), not np.ptp(place[:, 2]) > 0.0
    root = np.ones(count) if weight is None else weight
    usable = [model for model in MODELS if count >= model.least and (model.terms == 3 or not flat)]
    if not usable:
        raise FitError(f"points: {count} are too few: 4 give an affine at their altitude, {WHOLE} a whole RPC")
    best = _fitted(usable[0], place, image, root)
    for model in usable[1:]:
        tried = _fitted(model, place, image, root)
        if tried.error < BETTER * best.error or best.model.terms == 3:  # heights are asked for where they vary
            best = tried
    return best


def _fitted(model: SmallModel, place: Array, image: Array, root: Array) -> FewFit:
    out = np.empty_like(image)
    for n in range(len(place)):
        kept = np.arange(len(place)) != n
        coeffs = _coefficients(model, place[kept], image[kept], root[kept])
        out[n] = (_projected(coeffs, place[n : n + 1]) - image[n])[0]
    return FewFit(model, _coefficients(model, place, image, root), out)


def _projected(coeffs: Array, place: Array) -> Array:
    col, col_den, row, row_den = coeffs @ monomials(place.T)
    return np.column_stack([col / col_den, row / row_den])


def _coefficients(model: SmallModel, place: Array, image: Array, root: Array) -> Array:
    """Return the coefficients (4, 20), numerator and denominator of the column, then of the row, by least squares."""
    terms = monomials(place.T)[: model.terms].T
    coeffs = np.zeros((4, 20))
    coeffs[1::2, 0] = 1.0
    if not model.projective:
        found = np.linalg.lstsq(terms * root[:, None], image * root[:, None], rcond=None)[0]
        coeffs[[0, 2], : model.terms] = found.T
        return coeffs
    none, weight = np.zeros_like(terms), root
    for _ in range(_PASSES):
        of_col = np.hstack([terms, none, -image[:, :1] * terms[:, 1:]])
        of_row = np.hstack([none, terms, -image[:, 1:] * terms[:, 1:]])
        rows, right = np.vstack([of_col, of_row]) * np.tile(weight, 2)[:, None], image.T.ravel() * np.tile(weight, 2)
        found = np.linalg.lstsq(rows, right, rcond=None)[0]
        coeffs[0, :4], coeffs[2, :4] = found[:4], found[4:8]
        coeffs[1, 1:4] = coeffs[3, 1:4] = found[8:]
        weight = root / np.abs(1.0 + terms[:, 1:] @ found[8:])
    return coeffs
