"""Certificate of an RPC over a whole image: its errors, poles and round trips, and the cause of its misfit.

`RpcFit` is a fit with its certificate, and names its fault in words.

The errors of an RPC, less what a small change of its coefficients takes away, are asked whether they are a function of
the row, the column or the altitude. If they are, those of neighbours in that order are alike: half the mean square of
their differences is what the function leaves (Yatchew, "An elementary estimator of the partial linear model", 1997). No
shape is assumed, so that oscillations, bursts and steps count equally.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from barpc.base.fields import field_values
from barpc.base.geodesy import Array, parts, wrap_longitude
from barpc.sensor.rational import monomials
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import NEGLIGIBLE_FIT_ERROR, Scattered

_ALTITUDE_POWERS = np.arange(1, 8)  # of altitudes
_CAUSE_CELLS = 4  # along each side: where all errors are in one of them, they are in one place
_DOMINANT_SHARE = 0.5  # of the squares: a cause of more is named
_CAUSE_WORDS = {
    "row": "depend on the row (attitude oscillation, bursts, a long pass): a grid of the camera represents them",
    "column": "depend on the column (a lens, detectors, a scan): fit fewer columns, or take a grid",
    "altitude": "depend on the altitude: fit a smaller altitude range",
    "place": "are in one place, about col {col:.0f}, row {row:.0f}: check the camera there",
    "corner": "are in the corner at col {col:.0f}, row {row:.0f}: leave it out, or fit a smaller image",
    "pole": "come from the bound on denominators around the image: lower pole_margin, or fit a smaller image",
    "all": "are all over the image and its altitudes: not an RPC's shape, fit a smaller image, or take a grid",
}


@dataclass(frozen=True)
class Reason:
    """The main dependence of an RPC's errors: row, column, altitude, a region.

    Parameters
    ----------
    cause : str, "row", "column", "altitude", "place", "corner", "pole" or "all"
    share : float, part of the squared errors that is due to it; of "all", the remainder of the best of the others
    size_px : float, root mean square of that part
    col, row : float, position of a place [px]
    """

    cause: str
    share: float
    size_px: float
    col: float = float("nan")
    row: float = float("nan")

    def __str__(self) -> str:
        words = _CAUSE_WORDS[self.cause].format(col=self.col, row=self.row)
        return f"{self.share:.0%} of its squares, {self.size_px:.3g} px RMS, {words}"


def roundtrip(rpc: RPC, ground: Array) -> float:
    """Return the largest distance [px] between ground points (N, 3) and where their projections are localised."""
    image, jacobian = rpc.project_jacobian(ground)
    back = rpc.localize(image, ground[:, 2])
    miss = back - ground
    miss[:, 0] = wrap_longitude(miss[:, 0])
    distance = np.abs(np.einsum("nij,nj->ni", jacobian, miss))
    return float(distance.max(initial=0.0)) if np.isfinite(distance).all() else float("inf")


def coverage(image: Array, low: Array, high: Array) -> float:
    """Return the share of the rectangle `low`, `high` (2,) [px] inside the convex hull of image points (N, 2) [px]."""
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])  # outside is beyond all in one direction
    reach = np.full(len(angle), -np.inf)
    for part in parts(len(image)):
        reach = np.maximum(reach, (direction @ ((image[part] - low) / (high - low)).T).max(axis=1))
    t = (np.arange(20) + 0.5) / 20
    cells = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    return float((cells @ direction.T <= reach + 1e-9).all(axis=1).mean())


@dataclass(frozen=True, eq=False)
class RpcFit:
    """A fitted RPC and its certificate.

    Parameters
    ----------
    rpc : RPC, the result
    rmse_cnp, max_cnp : (2,), root mean square and largest error of col, row on the control points [px]
    rmse_ckp, max_ckp : (2,)
        The same on check points all over image and altitudes, which the fit has not seen [px]; the largest error was
        also looked for around the worst of them.
    beyond : float
        Largest share of image and altitudes, with 95 % confidence, that misses by more than `max_ckp`. 1 for
        given points, which may lie anywhere.
    min_denominator : float
        Lower bound of the denominators over the hull of the image's own ground and a margin (`FitOptions.pole_margin`)
        around it, over what they are at its centre; above 0 there is no pole.
    roundtrip : float
        Largest distance of a check point from where its projection is localised [px]; infinite where that fails.
    coverage : float, share of the image inside the convex hull of the control points
    h : (2,), regularisation used for col, row
    iterations : int, passes over the points
    num_cnp, num_ckp : int, number of points
    method : str, the solver whose result this is
    contradiction : float
        Largest distance of a check point from where the model, not the RPC, projects the ground that it localises
        there [px]; 0 for given points. What else projects with the model may err by as much more.
    axes : str, exchanged longitude and latitude, or the altitude's sign, of a model or a grid, in words
    reason : Reason or None, cause of a miss of the tolerance, of a model
    height_px : float
        Standard deviation of projections [px] of ground 100 m above or below given points by the first power of the
        altitude alone, at least; 0 for a model.
    few : str, the model that fewer than 40 points carry, and its error, in words; empty for a whole RPC

    Examples
    --------
    >>> found = barpc.fit("data_samples/view_00.tif")
    >>> found.verdict(0.01), bool(found.max_ckp.max() < 1e-6)
    ('', True)
    """

    rpc: RPC
    rmse_cnp: Array
    max_cnp: Array
    rmse_ckp: Array
    max_ckp: Array
    beyond: float
    min_denominator: float
    roundtrip: float
    coverage: float
    h: Array
    iterations: int
    num_cnp: int
    num_ckp: int
    method: str
    contradiction: float = 0.0
    axes: str = ""
    reason: Reason | None = None
    height_px: float = 0.0
    few: str = ""

    def __repr__(self) -> str:
        return f"RpcFit({self.method}, at most {self.max_ckp.max():.2g} px at {self.num_ckp} check points, {self.rpc})"

    def summary(self) -> dict[str, Any]:
        """Return the certificate as plain numbers and lists, col before row, lengths in px."""
        values = {name: held for name, held in field_values(self).items() if name != "rpc"}
        if (part := values.pop("reason")) is not None:
            values["reason"] = field_values(part)
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}

    def as_written(self, rpc: RPC) -> RpcFit:
        """Return the fit of the RPC read back from its file: differences over its box are added to the errors."""
        lost = self.rpc.off(rpc)
        return replace(
            self,
            rpc=rpc,
            rmse_ckp=self.rmse_ckp + np.sqrt((lost**2).mean(axis=0)),
            max_ckp=self.max_ckp + lost.max(axis=0),
        )

    def verdict(self, tolerance: float) -> str:
        """Return the faults of this fit at a tolerance [px], in words; empty if there are none."""
        worst = float(self.max_ckp.max())
        if not self.contradiction <= max(tolerance, NEGLIGIBLE_FIT_ERROR):
            return (
                f"the model contradicts itself: ground that it localises it projects up to {self.contradiction:.3g} px "
                f"away, wanted {tolerance:g}: `project` and `localize` are not of one camera (an altitude left out of "
                "one, coordinates exchanged, half a pixel)"
            )
        if self.axes:
            return self.axes
        if not worst <= tolerance:
            return (
                f"the RPC misses its check points by up to {worst:.3g} px (RMSE col {self.rmse_ckp[0]:.3g}, "
                f"row {self.rmse_ckp[1]:.3g}), wanted {tolerance:g}: "
                + (f"{self.reason}" if self.reason else "fit a smaller altitude range or a smaller image")
                + ", or raise the tolerance"
            )
        if not self.min_denominator > 0:
            return "the RPC has a pole near the scene: use more control points, or a smaller pole_margin"
        if not self.roundtrip <= max(tolerance, NEGLIGIBLE_FIT_ERROR):
            return f"the RPC cannot be inverted over the scene (round trip {self.roundtrip:.3g} px)"
        if not self.height_px <= tolerance:
            low, high = self.rpc.ground_offset[2] + self.rpc.ground_scale[2] * np.array([-1.0, 1.0])
            return (
                f"the points determine no height terms: the RPC is valid at their altitudes alone, {low:.6g} to "
                f"{high:.6g} m, and 100 m beyond errs by {self.height_px:.3g} px or more: add points at other altitudes"
            )
        return ""


# --- causes of misfit -----------------------------------------------------------------------------------------


def reason(rpc: RPC, sample: Scattered) -> Reason | None:
    """Return the main dependence of an RPC's errors at the points of a sample; None where they are not finite."""
    ground, points = sample.ground[: sample.count], sample.points[: sample.count]
    error = rpc.project(ground) - points[:, :2]
    if not (np.isfinite(error).all() and error.any()):
        return None
    bases = [np.linalg.qr(_tangent(rpc, ground, axis))[0] for axis in range(2)]
    left = np.column_stack([e - q @ (q.T @ e) for e, q in zip(error.T, bases, strict=True)])
    total, rest = float((error**2).sum()), float((left**2).sum())
    share = {"pole": 1.0 - rest / total}
    for axis, name in enumerate(("column", "row", "altitude")):
        share[name] = _along(left, bases, points[:, axis]) * rest / total
    share["altitude"] = max(share["altitude"], _layered(left, bases, points, sample) * rest / total)
    where = np.minimum((points[:, :2] + 0.5) / sample.size * _CAUSE_CELLS, _CAUSE_CELLS - 1).astype(np.int64)
    squares = np.bincount(where @ [1, _CAUSE_CELLS], (error**2).sum(axis=1), minlength=_CAUSE_CELLS**2)
    share["place"] = float(squares.max()) / total
    cause, most = max(share.items(), key=lambda item: item[1])
    size = float(np.sqrt(most * total / len(error)))
    if most <= _DOMINANT_SHARE:
        return Reason("all", 1.0 - most, float(np.sqrt((1.0 - most) * total / len(error))))
    if cause == "place":
        col, row = points[(error**2).sum(axis=1).argmax(), :2].tolist()
        cell = np.array(divmod(int(squares.argmax()), _CAUSE_CELLS))
        return Reason("corner" if np.isin(cell, (0, _CAUSE_CELLS - 1)).all() else cause, most, size, col, row)
    return Reason(cause, most, size)


def _tangent(rpc: RPC, ground: Array, axis: int) -> Array:
    """Return the directions (N, 39) of points under small changes of the coefficients of col (`axis` 0) or row (1)."""
    basis = monomials(rpc.normalize(ground)).T
    above, below = basis @ rpc.coeffs[2 * axis], basis @ rpc.coeffs[2 * axis + 1]
    rows = np.hstack([basis, -(above / below)[:, None] * basis[:, 1:]]) / below[:, None]
    return np.asarray(rows / np.linalg.norm(rows, axis=0))


def _along(left: Array, bases: list[Array], place: Array) -> float:
    """Return the share of errors (N, 2) explained by a function of `place` (N,)."""
    order, rest = np.argsort(place, kind="stable"), 0.0
    for error, basis in zip(left[order].T, bases, strict=True):
        change, turn = np.diff(error), np.diff(basis[order], axis=0)
        found = np.linalg.lstsq(turn, change, rcond=None)[0]
        rest += 0.5 * float(((change - turn @ found) ** 2).mean()) * len(change) / (len(change) - len(found))
    return 1.0 - rest / float((left**2).sum() / len(left))


def _layered(left: Array, bases: list[Array], points: Array, sample: Scattered) -> float:
    """Return the share of errors (N, 2) that goes by the altitude, otherwise from place to place of the image."""
    away = (points[:, :2] - (np.array(sample.size) - 1) / 2) / (max(sample.size) / 2)
    low, high = sample.alt_range
    up = ((points[:, 2:] - 0.5 * (low + high)) / (0.5 * (high - low))) ** _ALTITUDE_POWERS
    layers, rest = np.hstack([up, up * away[:, :1], up * away[:, 1:]]), 0.0
    for error, basis in zip(left.T, bases, strict=True):
        shape = layers - basis @ (basis.T @ layers)
        rest += float(((error - shape @ np.linalg.lstsq(shape, error, rcond=1e-10)[0]) ** 2).sum())
    return 1.0 - rest / float((left**2).sum())
