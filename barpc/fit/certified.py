"""A fitted RPC and its certificate, and what is wrong with it in words."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from barpc.fit.certificate import EXACT
from barpc.fit.localisation import Localisation
from barpc.fit.reasons import Reason
from barpc.geodesy import Array
from barpc.sensor.rpc import RPC

_HOPE = 3.0  # times the tolerance: what ``minimax`` may bring below it


@dataclass(frozen=True)
class Free:
    """What an RPC reaches whose denominators are bounded over the image's own ground only.

    Parameters
    ----------
    rmse_px, max_px : float
        RMSE on its check points, the larger of col and row.
    pole : (lon, lat, alt)
        Place nearest to the middle of that ground where a denominator is 0; NaN where none was found.
    far : float
        Distance of that place, 1 being the end of the ground.
    """

    rmse_px: float
    max_px: float
    pole: tuple[float, ...]
    far: float

    def __str__(self) -> str:
        lon, lat, alt = self.pole
        pole = f"a pole at lon {lon:.4f}, lat {lat:.4f}, {alt:.0f} m, {self.far:.3g} times as far from the middle as"
        return f"without a margin around the image (pole_margin 0) up to {self.max_px:.3g} px, with " + (
            f"{pole} the image's end" if np.isfinite(self.far) else "small denominators around it, but no pole"
        )


@dataclass(frozen=True, eq=False)
class RpcFit:
    """A fitted RPC and its certificate.

    Parameters
    ----------
    rpc : RPC
        The result.
    rmse_cnp, max_cnp : (2,)
        Root mean square and largest error of col, row on the control points [px].
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
    coverage : float
        Share of the image inside the convex hull of the control points.
    h : (2,)
        Regularisation used for col, row.
    iterations : int
        Passes over the points.
    num_cnp, num_ckp : int
        Number of points.
    method : str
        The solver whose result this is.
    localisation : Localisation or None
        The certificate of `rpc.direct`, where it was asked for.
    contradiction : float
        Largest distance of a check point from where the model, not the RPC, projects the ground that it localises
        there [px]; 0 for given points. What else projects with the model may be off by as much more.
    free : Free or None
        Result without a margin around the ground, where its RMSE is less than half.
    reason : Reason or None
        Cause of a miss of the tolerance, of a model.
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
    free: Free | None = None
    reason: Reason | None = None

    def __repr__(self) -> str:
        return f"RpcFit({self.method}, at most {self.max_ckp.max():.2g} px at {self.num_ckp} check points, {self.rpc})"

    def summary(self) -> dict[str, Any]:
        """Return the certificate as plain numbers and lists, col before row, lengths in px."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "rpc"}
        for name in ("localisation", "free", "reason"):
            part = values.pop(name)
            values |= {} if part is None else {name: asdict(part)}
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}

    def as_written(self, rpc: RPC) -> RpcFit:
        """Return the fit of the RPC as read back from its file: the differences over its box are added to the
        errors.
        """
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
                + ", or fit by the method minimax" * (self.method == "gauss-newton" and worst < _HOPE * tolerance)
                + (f"; {self.free}" if self.free else "")
            )
        if not self.min_denominator > 0:
            return "the RPC has a pole near the scene: use more control points, or a smaller pole_margin"
        if not self.roundtrip <= max(tolerance, EXACT):
            return f"the RPC cannot be inverted over the scene (round trip {self.roundtrip:.3g} px)"
        return "" if self.localisation is None else self.localisation.verdict(tolerance)
