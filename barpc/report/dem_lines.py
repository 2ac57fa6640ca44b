"""A DEM in words: what it did, how the tie points lie to it, and what is wrong with it."""

from __future__ import annotations

import numpy as np

from barpc.ba import Adjustment
from barpc.ba.held.ground import TerrainTest
from barpc.ba.usual import SURELY
from barpc.report.summary.words import metres

_GEOID = 110.0  # m: no geoid lies farther from the ellipsoid


def dem_lines(adjustment: Adjustment) -> list[str]:
    """Return what the DEM did."""
    terrain, options = adjustment.terrain, adjustment.options
    if terrain is None or not terrain.shows:
        return []
    if not terrain.total and holds_reference(adjustment):  # which stands on it: no tie point does
        return []
    if not terrain.total:
        return ["The DEM holds nothing: there are no tie points."]
    held = f"The DEM holds {terrain.held} of {terrain.total} tie point{'s' * (terrain.total != 1)}"
    if terrain.held:
        single, common = metres(options.dem_sigma), metres(terrain.bias)
        if np.isfinite(terrain.sigma):
            single = f"{metres(terrain.sigma)}, of which {terrain.alike:.1f} are worth one,"
        held += f", each to {single} and all together to {common}"
    elif options.dem_for_weak and terrain.known and not adjustment.held.any():
        least = f"{options.min_convergence:g} degree{'' if options.min_convergence == 1 else 's'}"
        held += f": all rays meet under more than {least}; without --dem-for-weak it holds the scene"
    else:
        held += ": it has no height where it is needed"
    share = 100 * terrain.known / terrain.total
    lie = f"they lie {terrain.offset:+.1f} m above it (median; spread {terrain.spread:.1f} m)"
    lines = [
        f"{held}.",
        f"It has a height for {share:.0f} % of the tie points{f'; {lie}' if terrain.known else ''}.",
    ]
    if not terrain.is_known and not holds_reference(adjustment):
        lines.append(
            "Nothing says that its heights count from the ellipsoid: give --geoid, or they may be wrong by up to 100 m."
        )
    return lines


def dem_reasons(adjustment: Adjustment | None) -> list[str]:
    """Return what is wrong with the DEM."""
    if adjustment is None or adjustment.terrain is None:
        return []
    terrain = adjustment.terrain
    if not terrain.shows:
        return [
            f"The DEM does not show the terrain of the tie points: its relief is {terrain.relief:.2g} times theirs. "
            "Another place, other units, heights that are all alike, or cameras that are farther off than its hills "
            "are wide. It was not used, and moved nothing."
        ]
    out = _against(terrain)
    if not terrain.is_known and holds_reference(adjustment) and not any("--geoid" in line for line in out):
        out.append(
            "The reference stands on the DEM, and nothing says that its heights count from the ellipsoid: if a "
            "geoid was left out, give --geoid, or the scene may lie up to 100 m too high or low, and its images aside "
            "by what they look aside over that. If they are ellipsoidal, its CRS should say so (EPSG:4979)."
        )
    return out


def holds_reference(adjustment: Adjustment) -> bool:
    """Return whether points of a reference hold the scene."""
    return bool(adjustment.reference_inlier.any())


def _against(terrain: TerrainTest) -> list[str]:
    """Return how the DEM contradicts the cameras as delivered."""
    level, *rises = terrain.beyond
    out = []
    if level > SURELY:
        off = terrain.delivered[0]
        why = "its heights, the datum that they count from, or the cameras are not as stated"
        if not terrain.is_known and abs(off) < _GEOID:
            why = "nothing says that its heights count from the ellipsoid: a geoid was left out, give --geoid"
        out.append(
            f"The DEM is {abs(off):.1f} m {'below' if off > 0 else 'above'} the tie points as the delivered cameras "
            f"put them, {level:.1f} times what the accuracies of both let expect: {why}."
        )
    tilts = [
        f"{abs(off):.1f} m to the {'east' if axis == 0 else 'north'}"
        for axis, (off, times) in enumerate(zip(terrain.delivered[1:], rises, strict=True))
        if times > SURELY
    ]
    if tilts:
        out.append(
            f"The DEM is tilted against the tie points as delivered, by {' and '.join(tilts)} at the scene's edge, "
            f"more than {SURELY:g} times what the accuracies of it and of the cameras let expect."
        )
    return out
