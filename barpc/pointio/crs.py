"""Places of any reference system to longitude and latitude on WGS84, by pyproj, which is imported when one is asked."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import Any

import numpy as np

from barpc.base.errors import InputError
from barpc.base.geodesy import STATED, Array
from barpc.rasters.vertical import ELLIPSOID, Vertical, vertical_of

_MAX_CRS_LETTERS = 50_000  # of a reference system: the longest WKT of EPSG has a fifth
_NOTEWORTHY_ACCURACY = (
    1.0  # m: transformations that are better known than this need no word; ensembles as WGS84 are no better
)


@contextmanager
def _offline() -> Iterator[None]:
    """Take no grid from the network, whatever PROJ is set to: results are not to depend on it, nor to fail without."""
    network: Any = import_module("pyproj.network")

    was = network.is_network_enabled()
    network.set_network_enabled(False)
    try:
        yield
    finally:
        network.set_network_enabled(was)


def to_wgs84(place: Array, crs: str, source: str) -> tuple[Array, Vertical, str]:
    """Bring places (N, 3), east, north and altitude in the units of a reference system, to lon, lat [deg] and altitude.

    Returns the places, what their altitudes (still in their unit) count from, and words: the system's name and how well
    it is known on WGS84. InputError where PROJ knows no such system of places; `source` says so for messages.
    """
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError, ProjError

    try:
        system = CRS.from_user_input(crs[:_MAX_CRS_LETTERS])
        level, *upper = system.sub_crs_list if system.is_compound else [system]
        if not (level.is_geographic or level.is_projected or level.is_geocentric):
            raise CRSError("no places")
        solid = len(level.axis_info) == 3
        with _offline(), warnings.catch_warnings():  # of missing grids: how well the others know the place is said
            warnings.simplefilter("ignore")
            to = Transformer.from_crs(level, "EPSG:4979" if solid else "EPSG:4326", always_xy=True)
            x, y, z = to.transform(place[:, 0], place[:, 1], np.nan_to_num(place[:, 2]))
            known = 0.0
            with suppress(ProjError):  # WGS84 itself: nothing was done
                known = to.get_last_used_operation().accuracy
        vertical = (
            vertical_of(system.to_wkt()) if upper else Vertical(ELLIPSOID, provenance=STATED) if solid else Vertical()
        )
    except (CRSError, ProjError, UnicodeError) as error:
        raise InputError(
            f"{source}: {crs[:60]!r} is no reference system of places that PROJ knows; say it with --gcp-crs, such as "
            "EPSG:32631, or EPSG:26910+5703 with its heights"
        ) from error
    alt = np.where(np.isnan(place[:, 2]), np.nan, z) if solid else place[:, 2]
    return (
        np.column_stack([x, y, alt]),
        vertical,
        system.name + (f", known to {known:g} m" if known > _NOTEWORTHY_ACCURACY else ""),
    )
