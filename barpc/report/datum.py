"""The vertical datum assumed for heights, tested against the delivered cameras and other heights."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.constraints.ground import KNOWN_BIAS
from barpc.base.geodesy import DEFAULT, HeightDatum
from barpc.base.statistics import SURE, SURELY
from barpc.report.summary.words import metres

_HEIGHT_SHARES = {"gcps": ("gcps",), "heights": ("heights", "reference"), "altimetry": ("altimetry",)}
"""Source of heights -> the shares of the scene's height that depend on it."""
_UP = 2  # place of the scene's height among its motions

Evidence = list[tuple[float, float]]
"""Offsets of heights above others, and their standard deviations [m]."""


def datum_reasons(datums: Iterable[HeightDatum], adjustment: Adjustment) -> Iterator[str]:
    """Yield heights that seem to have another vertical datum than assumed, and those whose datum stays unknown.

    The likelihoods of both are compared, as `SURE` asks. An unknown datum is reported where the file does not state it,
    and the other would shift the scene by more than the standard deviation of its height.
    """
    for one in datums:
        share = sum(np.nan_to_num(adjustment.datum[name][_UP]) for name in _HEIGHT_SHARES[one.source])
        evidence = [*one.above, *_beside_cameras(one.source, adjustment, share)]
        offset, sigma = np.array(evidence).reshape(-1, 2).T
        taken, other = (float((((offset + more) / sigma) ** 2).sum()) for more in (0.0, one.otherwise))
        fits = SURELY**2 * len(offset)
        if other <= fits < taken and taken - other > 2.0 * SURE:
            yield _contradicted(one, offset[np.argmin(sigma)])
        elif one.provenance == DEFAULT and not (taken <= fits and other - taken > 2.0 * SURE):
            moves = abs(one.otherwise) * share
            if moves > adjustment.gauge.sigma[_UP]:
                yield (
                    f"The vertical datum of the heights of {one.name} is not stated. They were taken as ellipsoidal; "
                    f"if they are above sea level, the scene is {metres(moves)} too "
                    f"{'low' if one.otherwise > 0 else 'high'}, and neither the cameras nor other heights show it. "
                    "Give --heights ellipsoidal, or --heights egm96."
                )


def _contradicted(one: HeightDatum, offset: float) -> str:
    geoid = f"{metres(abs(one.otherwise))} {'above' if (one.otherwise > 0) != one.converted else 'below'}"
    seems = (
        ("be above sea level", "--heights egm96") if not one.converted else ("be ellipsoidal", "--heights ellipsoidal")
    )
    flag = seems[1] if one.source != "heights" else "--geoid egm96" if not one.converted else "--geoid none"
    return (
        f"The heights of {one.name} lie {metres(abs(offset))} {'above' if offset > 0 else 'below'} the ground by the "
        f"delivered cameras, or by other heights, and the geoid lies {geoid} the ellipsoid here: they seem to "
        f"{seems[0]}. Give {flag}, or the opposite to confirm the present datum."
    )


def _beside_cameras(source: str, adjustment: Adjustment, share: float) -> Evidence:
    """Return the offset of heights above the ground by the delivered cameras, and its standard deviation."""
    if source == "heights":
        terrain = adjustment.terrain
        if terrain is None or not terrain.beyond[0] > 0.0:
            return []
        offset, sigma = -terrain.delivered[0], abs(terrain.delivered[0] / terrain.beyond[0])
        cameras = sigma**2 - terrain.bias**2  # of a bias a geoid that is left out is no part here
        sigma = float(np.sqrt(max(cameras, 0.0) + KNOWN_BIAS**2))
    else:
        control, gauge = adjustment.control, adjustment.gauge
        widened = max(1.0, float(np.median(adjustment.prior.scale))) if len(adjustment.prior.scale) else 1.0
        with np.errstate(all="ignore"):
            offset, sigma = gauge.shift[_UP] / share, gauge.delivered_sigma[_UP] / widened
        if source == "gcps" and control is not None and not control.used.any():
            offset, sigma = -float(np.median(control.residual[:, _UP])), float(gauge.sigma[_UP])
    return [(float(offset), float(sigma))] if np.isfinite([offset, sigma]).all() and sigma > 0.0 else []
