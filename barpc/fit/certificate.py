"""What an RPC is worth over a whole image: points that the fit has not seen, poles, round trips.

The points are drawn one a cell of the image and at an altitude of its own each, with more along its edges; where the
error is largest more are drawn around the worst, closer and closer. `RpcFit` is a fit
with its certificate, and says in words what is wrong with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from barpc.base.errors import FitError
from barpc.base.geodesy import CHUNK, Array, metres_per_unit, wrap_longitude
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC

BoolArray = npt.NDArray[np.bool_]

EXACT = 1e-6  # px: what no other method is tried on, and no round trip is held to
CELLS = 45
"""Along each side of the image: 2025 points of the whole."""
_EDGE = 12  # points along each edge of the image, at either end of the altitudes
_WORST, _AROUND, _ROUNDS = 16, 8, 5  # points that are looked around at, new ones around each, rounds, ever nearer


_WORDS = {
    "row": "go by the row (a swing of the attitude, bursts, a long pass): a grid of the camera follows it",
    "column": "go by the column (a lens, detectors, a scan): fit fewer columns, or take a grid",
    "altitude": "go by the altitude: fit a smaller altitude range",
    "place": "are in one place, about col {col:.0f}, row {row:.0f}: look at the camera there",
    "corner": "are in the corner at col {col:.0f}, row {row:.0f}: leave it out, or fit a smaller image",
    "pole": "are what the bound on denominators around the image costs: lower pole_margin, or fit a smaller image",
    "all": "are all over the image and its altitudes: not an RPC's shape, fit a smaller image, or take a grid",
}


@dataclass(frozen=True)
class Reason:
    """What most of an RPC's errors depend on: row, column, altitude, a place.

    Parameters
    ----------
    cause : str, "row", "column", "altitude", "place", "corner", "pole" or "all"
    share : float, part of the squared errors that is due to it; of "all", what is left by the best of the others
    size_px : float, root mean square of that part
    col, row : float, position of a place [px]
    """

    cause: str
    share: float
    size_px: float
    col: float = float("nan")
    row: float = float("nan")

    def __str__(self) -> str:
        words = _WORDS[self.cause].format(col=self.col, row=self.row)
        return f"{self.share:.0%} of its squares, {self.size_px:.3g} px RMS, {words}"


@dataclass
class Errors:
    """Running root mean square and largest error of (N, 2) residuals [px]."""

    count: int = 0
    squares: Array = field(default_factory=lambda: np.zeros(2))
    largest: Array = field(default_factory=lambda: np.zeros(2))
    # (k, 3) col, row [px], altitude [m] of the largest
    worst: Array = field(default_factory=lambda: np.empty((0, 3)))

    def add(self, residual: Array) -> None:
        """Add residuals (N, 2) [px]; one that is NaN makes the result NaN."""
        if len(residual):
            self.count += len(residual)
            self.squares = self.squares + np.einsum("ij,ij->j", residual, residual)
            self.largest = np.maximum(self.largest, np.abs(residual.T).max(axis=1))

    @property
    def rmse(self) -> Array:
        """Root mean square (2,) [px]."""
        return np.asarray(np.sqrt(self.squares / self.count)) if self.count else np.full(2, np.nan)


@dataclass(frozen=True, eq=False)
class Sample:
    """Points of a model all over an image of `size` (width, height) and a range of altitudes."""

    model: SensorModel
    size: tuple[int, int]
    alt_range: tuple[float, float]
    points: Array  # (N, 3) col, row [px], altitude [m] with a ground point; those all over the image come first
    ground: Array  # (N, 3) lon, lat [deg], alt [m]
    count: int  # of those all over the image
    missing: float  # part of the image and the altitudes without a ground point

    @classmethod
    def of(
        cls,
        model: SensorModel,
        size: tuple[int, int],
        alt_range: tuple[float, float],
        cells: int = CELLS,
        seed: int = 0,
    ) -> Sample:
        """Sample a model at one random point in each of `cells` x `cells` parts of an image, and along its edges."""
        if min(size) < 1:
            raise FitError(f"image size {size[0]} x {size[1]}: nothing to fit over")
        rng = np.random.default_rng(seed)
        cell = np.stack(np.meshgrid(*[np.arange(cells)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
        inside = np.column_stack([cell, rng.permutation(len(cell))]) + rng.random((len(cell), 3))
        inside /= [cells, cells, len(cell)]
        t, ends = np.linspace(0.0, 1.0, _EDGE), (0.0, 1.0)
        edges = [(*at, h) for u in t for end in ends for at in ((u, end), (end, u)) for h in ends]
        points = _scaled(np.concatenate([inside, edges]), size, alt_range)
        ground = model.localize(points[:, :2], points[:, 2])
        known: BoolArray = np.asarray(np.isfinite(ground).all(axis=1))
        share = float(known[: len(inside)].mean())
        return cls(model, size, alt_range, points[known], ground[known], int(known[: len(inside)].sum()), 1.0 - share)

    def also(self, points: Array) -> Sample:
        """Return the sample with more points (M, 3) col, row [px], altitude [m] to look for the worst around."""
        ground = self.model.localize(points[:, :2], points[:, 2])
        known = np.isfinite(ground).all(axis=1)
        more = np.concatenate([self.points, points[known]]), np.concatenate([self.ground, ground[known]])
        return replace(self, points=more[0], ground=more[1])

    def contradiction(self) -> float:
        """Return the largest distance [px] of the points from where the model projects their ground; infinite
        where it fails.

        At the altitudes that were asked for, whatever altitudes it gave back.
        """
        asked = np.column_stack([self.ground[:, :2], self.points[:, 2]])
        return float(_size(self.model.project(asked) - self.points[:, :2]).max(initial=0.0))

    def errors(self, rpc: RPC) -> tuple[Errors, Array]:
        """Return the errors of an RPC at the sampled points, and its largest errors (2,) [px] after searching
        around them.

        They are infinite where the RPC has no image point.
        """
        return self.sought(lambda ground, points: rpc.project(ground) - points[:, :2])

    def sought(self, off: Callable[[Array, Array], Array]) -> tuple[Errors, Array]:
        """Return an RPC's errors (N, 2) [px] at ground points (N, 3) and their (N, 3) col, row, altitude."""
        points, miss = self.points, _size(off(self.ground, self.points))
        errors = Errors()
        errors.add(miss[: self.count])
        rng, reach = np.random.default_rng(1), np.array([1.0 / CELLS, 1.0 / CELLS, 0.25])
        unit = (points - _scaled(np.zeros(3), self.size, self.alt_range)) / self._span
        for _ in range(_ROUNDS if float(miss.max(initial=0.0)) > EXACT else 0):
            worst = np.unique(np.concatenate([np.argsort(-miss[:, axis], kind="stable")[:_WORST] for axis in range(2)]))
            near = unit[np.repeat(worst, _AROUND)] + reach * rng.uniform(-1.0, 1.0, (len(worst) * _AROUND, 3))
            near = near.clip(0.0, 1.0)
            at = _scaled(near, self.size, self.alt_range)
            ground = self.model.localize(at[:, :2], at[:, 2])
            known = np.isfinite(ground).all(axis=1)
            found = _size(off(ground[known], at[known]))
            unit, miss, reach = np.concatenate([unit, near[known]]), np.concatenate([miss, found]), reach / 2
        if len(miss):
            errors.worst = _scaled(unit[miss.argmax(axis=0)], self.size, self.alt_range)
        return errors, miss.max(axis=0, initial=0.0)

    @property
    def _span(self) -> Array:
        return np.array([*self.size, max(self.alt_range[1] - self.alt_range[0], 1e-9)], dtype=np.float64)


def _size(values: Array) -> Array:
    return np.nan_to_num(np.abs(values), nan=np.inf)


def _scaled(unit: Array, size: tuple[int, int], alt_range: tuple[float, float]) -> Array:
    """Return the col, row, altitude (..., 3) of places in 0 .. 1."""
    low, high = alt_range
    return np.asarray(unit * [*size, high - low] + [-0.5, -0.5, low])


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
    for start in range(0, len(image), CHUNK):
        part = (image[start : start + CHUNK] - low) / (high - low)
        reach = np.maximum(reach, (direction @ part.T).max(axis=1))
    t = (np.arange(20) + 0.5) / 20
    cells = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    return float((cells @ direction.T <= reach + 1e-9).all(axis=1).mean())


@dataclass(frozen=True)
class Localisation:
    """The certificate of a localisation RPC, on the check points of the fit.

    Parameters
    ----------
    rmse_m, max_m : float, root mean square and largest distance on the ground from where the camera localises them [m]
    rmse_px, max_px : float, the same from where the fitted RPC projects the places found [px]
    min_denominator : float, as for the RPC, over image and altitudes
    method : str, the solver whose result this is
    """

    rmse_m: float
    max_m: float
    rmse_px: float
    max_px: float
    min_denominator: float
    method: str

    def verdict(self, tolerance: float) -> str:
        """Return the faults at a tolerance [px], in words; empty if there are none."""
        if not self.max_px <= tolerance:
            return (
                f"the localisation RPC misses the ground by up to {self.max_m:.3g} m ({self.max_px:.3g} px), wanted "
                f"{tolerance:g} px: fit a smaller altitude range or a smaller image, raise the tolerance, or do "
                "without it"
            )
        return "" if self.min_denominator > 0 else "the localisation RPC has a pole near the scene: do without it"


def off(rpc: RPC, found: Array, ground: Array, image: Array) -> Array:
    """Return the distances (N, 2) of places `found` (N, 3) from ground points [m], and of their projections [px]."""
    miss = found - ground
    miss[:, 0] = wrap_longitude(miss[:, 0])
    metres = np.linalg.norm((miss * metres_per_unit(ground))[:, :2], axis=1)
    return np.column_stack([metres, np.linalg.norm(rpc.project(found) - image, axis=1)])


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
    localisation : Localisation or None, the certificate of `rpc.direct`, where it was asked for
    contradiction : float
        Largest distance of a check point from where the model, not the RPC, projects the ground that it localises
        there [px]; 0 for given points. What else projects with the model may be off by as much more.
    reason : Reason or None, cause of a miss of the tolerance, of a model
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
    localisation: Localisation | None = None
    contradiction: float = 0.0
    reason: Reason | None = None

    def __repr__(self) -> str:
        return f"RpcFit({self.method}, at most {self.max_ckp.max():.2g} px at {self.num_ckp} check points, {self.rpc})"

    def summary(self) -> dict[str, Any]:
        """Return the certificate as plain numbers and lists, col before row, lengths in px."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "rpc"}
        for name in ("localisation", "reason"):
            part = values.pop(name)
            values |= {} if part is None else {name: asdict(part)}
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}

    def as_written(self, rpc: RPC) -> RpcFit:
        """Return the fit of the RPC as read back from its file: what differs over its box is added to the errors."""
        lost = self.rpc.off(rpc)
        return replace(
            self,
            rpc=rpc,
            rmse_ckp=self.rmse_ckp + np.sqrt((lost**2).mean(axis=0)),
            max_ckp=self.max_ckp + lost.max(axis=0),
            localisation=None if rpc.direct is None else self.localisation,
        )

    def verdict(self, tolerance: float) -> str:
        """Return the faults of this fit at a tolerance [px], in words; empty if there are none."""
        worst = float(self.max_ckp.max())
        if not self.contradiction <= max(tolerance, EXACT):
            return (
                f"the model contradicts itself: ground that it localises it projects up to {self.contradiction:.3g} px "
                f"away, wanted {tolerance:g}: `project` and `localize` are not of one camera (an altitude left out of "
                "one, coordinates exchanged, half a pixel)"
            )
        if not worst <= tolerance:
            return (
                f"the RPC misses its check points by up to {worst:.3g} px (RMSE col {self.rmse_ckp[0]:.3g}, "
                f"row {self.rmse_ckp[1]:.3g}), wanted {tolerance:g}: "
                + (f"{self.reason}" if self.reason else "fit a smaller altitude range or a smaller image")
                + ", or raise the tolerance"
                + ", or fit by the method minimax"
                * (self.method == "gauss-newton" and bool(self.rmse_ckp.max() <= tolerance))
            )
        if not self.min_denominator > 0:
            return "the RPC has a pole near the scene: use more control points, or a smaller pole_margin"
        if not self.roundtrip <= max(tolerance, EXACT):
            return f"the RPC cannot be inverted over the scene (round trip {self.roundtrip:.3g} px)"
        return "" if self.localisation is None else self.localisation.verdict(tolerance)
