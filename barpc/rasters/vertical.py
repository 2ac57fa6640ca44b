"""Vertical datum and unit of heights: one place determines them from the file and the user's options.

Readers report a CRS, the unit of a band and a person's word; what follows is a `Vertical`: metres a unit, the reference
surface, the geoid that leads from it to the ellipsoid, and whether that was stated or is nobody's but the default.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

from barpc.base.errors import InputError
from barpc.base.geodesy import DEFAULT, STATED
from barpc.base.remote import location

ELLIPSOID, UNKNOWN = "ellipsoid", "unknown"
NO_GEOID, ELLIPSOIDAL = "none", "ellipsoidal"
FLAT = "flat"  # ellipsoidal, of points that are all at the same altitude, where else that is taken for a default
"""Said in place of a geoid: heights are ellipsoidal."""
_GEOID_NAMES = (("egm2008", "egm2008"), ("egm08", "egm2008"), ("egm96", "egm96"), ("egm84", "egm96"))
_OTHERS = "egm96"  # of any other orthometric datum, from which it lies a metre or two
_HEIGHT_UNITS = {
    word: size
    for size, words in (
        (1.0, "m metre meter metres meters mt 1"),
        (0.3048, "ft foot feet internationalfoot ift"),
        (1200 / 3937, "ussurveyfoot ussurveyfeet ussurveyft usfoot usfeet usft footus ftus sft surveyfoot surveyfeet "
         "surveyft"),
        (0.01, "cm centimetre centimeter"), (0.1, "dm decimetre decimeter"),
        (0.001, "mm millimetre millimeter"), (1000.0, "km kilometre kilometer"),
    )
    for word in words.split()
}  # fmt: skip
_VERTICAL = re.compile(r"\b(?:VERTCRS|VERT_CS|VERTICALCRS)\s*\[|CS\[ellipsoidal,\s*3|AXIS\[\"Ellipsoidal height")


@dataclass(frozen=True)
class Vertical:
    """Vertical datum of heights."""

    reference: str = UNKNOWN  # `ELLIPSOID`, the name of a geoid or datum, or `UNKNOWN`
    metres: float = 1.0  # of a unit, upwards
    unit: str = ""  # its name, where it is no metre
    geoid: str | None = None  # grid that makes the heights ellipsoidal; None: they are, or are taken so
    provenance: str = DEFAULT  # `STATED` by the file or a person, `INFERRED` of its format; else taken as ellipsoidal

    @property
    def stated(self) -> bool:
        """Whether the file or the user states the datum."""
        return self.provenance == STATED

    def by(self, geoid: str | None) -> Vertical:
        """Return the same with the user's geoid: a name or a file, `NO_GEOID`, or nothing (None)."""
        if geoid is None:
            return self
        return replace(self, geoid=None if geoid.lower() in (NO_GEOID, ELLIPSOIDAL, FLAT) else geoid, provenance=STATED)


def metres_of(unit: str) -> float | None:
    """Return the length [m] of a unit of heights by its name; None for a name that is none."""
    return _HEIGHT_UNITS.get(re.sub(r"[\s_-]", "", unit.lower()))


def vertical_of(wkt: str, unit: str = "", of: str = "heights") -> Vertical:
    """Return the vertical datum of heights with a CRS (WKT) and the unit of their band, if stated.

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
    geoid = next((grid for text, grid in _GEOID_NAMES if text in plain), _OTHERS)
    return Vertical(name, metres, unit, geoid, STATED)


# --- geoids by name ---------------------------------------------------------------------------------------

_GEOID_GRIDS = {"egm96": Path(__file__).with_name("egm96_15.tif")}
"""15 arc minutes, rounded to 1/128 m: of the US National Geospatial-Intelligence Agency, in the public domain."""
_IN_PROJ = {"egm2008": ("us_nga_egm08_25.tif", "egm08_25.gtx")}
GEOIDS = (*_GEOID_GRIDS, *_IN_PROJ)
WORDS = (NO_GEOID, ELLIPSOIDAL, FLAT, *GEOIDS)


def geoid_file(given: str | os.PathLike[str]) -> str:
    """Return the file of a geoid grid, given by its path or as one of `GEOIDS`; "none" is none.

    Raises
    ------
    InputError
        It is a name, and none of PROJ's folders holds its grid: the message says where to get it.
    """
    text = os.fspath(given)
    name = text.lower()
    if name == NO_GEOID:
        return name
    if name not in GEOIDS or Path(text).exists():
        return text
    if name in _GEOID_GRIDS:
        return str(_GEOID_GRIDS[name])
    folders = proj_folders()
    for folder in folders:
        for file in _IN_PROJ[name]:
            if (folder / file).is_file():
                return str(folder / file)
    first = _IN_PROJ[name][0]
    raise InputError(
        f"geoid {name}: no {' or '.join(_IN_PROJ[name])} in PROJ's folders ({', '.join(map(str, folders)) or 'none'}); "
        f"get it by 'projsync --file {first}' or from https://cdn.proj.org/{first} and give its path, or take egm96"
    )


def geoid_places() -> Iterator[Path]:
    """Yield the folders in which geoids are that are given by their names."""
    yield from (path.parent for path in _GEOID_GRIDS.values())
    yield from proj_folders()


def proj_folders() -> list[Path]:
    """Return the folders in which PROJ looks for grids: of its variables, the user, Python packages, the system."""
    said = [part for name in ("PROJ_DATA", "PROJ_LIB") for part in os.environ.get(name, "").split(os.pathsep)]
    data = {
        "win32": os.environ.get("LOCALAPPDATA", Path.home()),
        "darwin": Path.home() / "Library/Application Support",
    }.get(sys.platform, os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share")
    folders = [Path(part) for part in said if part] + [Path(data) / "proj"]
    for package, place in (("rasterio", "proj_data"), ("pyproj", "proj_dir/share/proj")):
        spec = find_spec(package)
        folders += [Path(spec.origin).parent / place] if spec is not None and spec.origin else []
    folders += [Path(root) / "share/proj" for root in (sys.prefix, "/usr/local", "/usr")]
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


def geoid_of(own: Vertical, said: Vertical, by_person: bool) -> tuple[str | None, str, bool]:
    """Return the geoid file for heights with a datum as `said`, a remark on it, and whether the remark is a warning."""
    if said.geoid is None:
        if said.provenance != DEFAULT:
            return None, "ellipsoidal" if own.reference == ELLIPSOID else "taken as ellipsoidal, as is said", False
        advice = (
            "say --geoid egm96 for heights above the sea, --geoid none for ellipsoidal ones: up to 100 m lie between"
        )
        return None, f"TAKEN AS ELLIPSOIDAL; {advice}", True
    of_file = own.reference.lower().replace(" ", "")
    try:
        file = geoid_file(said.geoid)
    except InputError:
        if by_person:
            raise
        file = geoid_file("egm96")  # a metre from it
    done = f"made ellipsoidal with {location(file).name}"
    other = not by_person and not any(name in of_file and name in Path(file).name for name in GEOIDS)
    return file, f"{done}, which lies within some 2 m of it" if other else done, other
