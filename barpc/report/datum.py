"""The vertical datum assumed for heights, tested against the delivered cameras and other heights."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.constraints.ground import KNOWN_BIAS
from barpc.base.geodesy import DEFAULT, STATED, HeightDatum
from barpc.base.statistics import SURE, SURELY
from barpc.report.summary.words import metres

_HEIGHT_SHARES = {"gcps": ("gcps",), "heights": ("heights", "reference"), "altimetry": ("altimetry",)}
"""Source of heights -> the shares of the scene's height that depend on it."""
_SIDE_SHARES = {"gcps": "gcps", "heights": "reference"}
"""Source of heights -> the share of the scene's position of the points in images that have these heights."""
_FLAGS = ("--heights ellipsoidal", "--heights egm96"), ("--geoid none", "--geoid egm96")
"""Flags for ellipsoidal heights and for those above sea level: of points, of a DEM."""
_UP = 2  # place of the scene's height among its motions, after east and north

_AS_UNDULATION, _LEAST_UNDULATION = 3.0, 10.0
"""How near a shift is to the geoid's height that it equals, and the least height that tells it from none [m]."""

Evidence = list[tuple[float, float]]
"""Offsets of heights above others, and their standard deviations [m]."""


def datum_reasons(datums: Iterable[HeightDatum], adjustment: Adjustment, lean: float) -> Iterator[str]:
    """Yield heights that seem to have another vertical datum than assumed, and those whose datum stays unknown.

    The likelihoods of both are compared, as `SURE` asks. An unknown datum is reported where the file does not state it,
    and the other would shift the scene by more than the standard deviation of its height, or horizontally by more than
    that of its position: lines of sight that have a slope `lean` in common meet points at wrong heights beside them.
    """
    for one in datums:
        share = sum(np.nan_to_num(adjustment.datum[name][_UP]) for name in _HEIGHT_SHARES[one.source])
        evidence = [*one.above, *_beside_cameras(one.source, adjustment, share)]
        offset, sigma = np.array(evidence).reshape(-1, 2).T
        taken, other = (float((((offset + more) / sigma) ** 2).sum()) for more in (0.0, one.otherwise))
        fits = SURELY**2 * len(offset)
        if other <= fits < taken and taken - other > 2.0 * SURE:
            yield _contradiction(one, offset[np.argmin(sigma)])
        elif one.source == "gcps" and _is_undulation(one, adjustment, share):
            yield (
                f"{one.name} move the scene by {abs(one.otherwise):.0f} m in height, which is the height of the geoid "
                "here. Their altitudes seem to be "
                f"{'ellipsoidal' if one.converted else 'above sea level'}. {_cure(one)}"
            )
        elif one.provenance == DEFAULT and not (taken <= fits and other - taken > 2.0 * SURE):
            ellipsoidal, geoid = _FLAGS[one.source == "heights"]
            if shifts := _shifts(one, adjustment, share, lean):
                yield (
                    f"The vertical datum of the heights of {one.name} is not stated. They were taken as ellipsoidal: "
                    f"if they are above sea level, the scene is {shifts}. Give {ellipsoidal}, or {geoid}."
                )


def _cure(one: HeightDatum) -> str:
    if one.provenance == STATED:
        return "Their file states the opposite: check it."
    flags = _FLAGS[one.source == "heights"]
    return f"Give {flags[not one.converted]}, or {flags[one.converted]} to confirm the present datum."


def _is_undulation(one: HeightDatum, adjustment: Adjustment, share: float) -> bool:
    """Return whether control moves the scene by the height of the geoid, and by no camera error."""
    gauge = adjustment.gauge
    with np.errstate(all="ignore"):
        up, aside = gauge.shift[_UP] / share, np.abs(gauge.shift[:_UP]) / gauge.delivered_sigma[:_UP]
    far = abs(one.otherwise) > _LEAST_UNDULATION
    return bool(far and abs(up + one.otherwise) <= _AS_UNDULATION and (aside <= 1.0).all())


def _shifts(one: HeightDatum, adjustment: Adjustment, share: float, lean: float) -> str:
    """Return the shifts of the scene by the other datum that exceed their standard deviations, in words."""
    sigma, fixed = adjustment.gauge.sigma, adjustment.datum.get(_SIDE_SHARES.get(one.source, ""))
    up, aside = abs(one.otherwise) * np.array([share, 0.0 if fixed is None else lean * fixed[:_UP].mean()])
    words = [f"{metres(up)} too {'low' if one.otherwise > 0 else 'high'}"] * bool(up > sigma[_UP])
    return " and ".join(words + [f"up to {metres(aside)} off horizontally"] * bool(aside > np.hypot(*sigma[:_UP])))


def _contradiction(one: HeightDatum, offset: float) -> str:
    geoid = f"{metres(abs(one.otherwise))} {'above' if (one.otherwise > 0) != one.converted else 'below'}"
    seems = "ellipsoidal" if one.converted else "above sea level"
    return (
        f"The heights of {one.name} lie {metres(abs(offset))} {'above' if offset > 0 else 'below'} those by the "
        f"cameras or other heights; the geoid lies {geoid} the ellipsoid here. They seem to be {seems}. {_cure(one)}"
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
