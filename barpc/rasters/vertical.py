"""What heights count from, and in which unit: one place decides it, by what a file or a person says.

Readers report a CRS, the unit of a band and a person's word; what follows is a `Vertical`: metres a unit, the reference
surface, the geoid that leads from it to the ellipsoid, and whether that was stated or is nobody's but the default.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from barpc.base.errors import InputError
from barpc.base.geodesy import DEFAULT, STATED

ELLIPSOID, UNKNOWN = "ellipsoid", "unknown"
NONE, ELLIPSOIDAL = "none", "ellipsoidal"
"""Said in place of a geoid: heights are ellipsoidal."""
_GEOIDS = (("egm2008", "egm2008"), ("egm08", "egm2008"), ("egm96", "egm96"), ("egm84", "egm96"))
_OTHERS = "egm96"  # of any other orthometric datum, from which it lies a metre or two
_UNITS = {
    "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0, "mt": 1.0, "1": 1.0,
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "international foot": 0.3048, "ift": 0.3048,
    "us survey foot": 1200 / 3937, "us_survey_foot": 1200 / 3937, "foot_us": 1200 / 3937, "ftus": 1200 / 3937,
    "us-ft": 1200 / 3937, "sft": 1200 / 3937, "us survey feet": 1200 / 3937,
    "cm": 0.01, "centimetre": 0.01, "centimeter": 0.01, "dm": 0.1, "decimetre": 0.1, "decimeter": 0.1,
    "mm": 0.001, "millimetre": 0.001, "millimeter": 0.001, "km": 1000.0, "kilometre": 1000.0, "kilometer": 1000.0,
}  # fmt: skip
_VERTICAL = re.compile(r"\b(?:VERTCRS|VERT_CS|VERTICALCRS)\s*\[|CS\[ellipsoidal,\s*3|AXIS\[\"Ellipsoidal height")


@dataclass(frozen=True)
class Vertical:
    """What heights count from."""

    reference: str = UNKNOWN  # `ELLIPSOID`, the name of a geoid or datum, or `UNKNOWN`
    metres: float = 1.0  # of a unit, upwards
    unit: str = ""  # its name, where it is no metre
    geoid: str | None = None  # grid that makes the heights ellipsoidal; None: they are, or are taken so
    provenance: str = DEFAULT  # `STATED` by the file or a person, `INFERRED` of its format; else taken as ellipsoidal

    @property
    def stated(self) -> bool:
        """Whether the file or a person says what heights count from."""
        return self.provenance == STATED

    def by(self, geoid: str | None) -> Vertical:
        """Return the same with what a person says of its geoid: a name or a file, `NONE`, or nothing (None)."""
        if geoid is None:
            return self
        return replace(self, geoid=None if geoid.lower() in (NONE, ELLIPSOIDAL) else geoid, provenance=STATED)


def metres_of(unit: str) -> float | None:
    """Return the length [m] of a unit of heights by its name; None for a name that is none."""
    return _UNITS.get(unit.strip().lower())


def vertical_of(wkt: str, unit: str = "", of: str = "heights") -> Vertical:
    """Return what heights with a CRS (WKT) and the unit of their band, where that is said, count from.

    Raises
    ------
    InputError
        A unit that is no length.
    """
    found = _of_crs(wkt) if _VERTICAL.search(wkt) else Vertical()
    if not unit.strip():
        return found
    metres = metres_of(unit)
    if metres is None:
        raise InputError(f"{of}: the unit {unit!r} of its heights is not known here; convert them to metres")
    sign = 1.0 if found.metres > 0 else -1.0
    return replace(found, metres=sign * metres, unit="" if metres == 1.0 else unit.strip())


def _of_crs(wkt: str) -> Vertical:
    from pyproj import CRS  # a twentieth of a second, of heights with a CRS of their own
    from pyproj.exceptions import CRSError

    try:
        crs = CRS.from_wkt(wkt)
    except CRSError as error:
        raise InputError(f"a CRS of heights that PROJ does not read: {wkt[:60]}") from error
    parts = [part for part in crs.sub_crs_list if part.is_vertical] or [crs]
    axis = parts[0].axis_info[-1]
    metres = axis.unit_conversion_factor * (-1.0 if axis.direction.lower() == "down" else 1.0)
    unit = "" if axis.unit_conversion_factor == 1.0 else axis.unit_name
    name = parts[0].name
    if parts[0] is crs or "ellipsoid" in name.lower():
        return Vertical(ELLIPSOID, metres, unit, None, STATED)
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    geoid = next((grid for text, grid in _GEOIDS if text in plain), _OTHERS)
    return Vertical(name, metres, unit, geoid, STATED)
