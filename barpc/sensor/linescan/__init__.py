"""Physical camera models of pushbroom images, from the orbit and attitude in a vendor's XML metadata.

`read_linescan` knows Maxar's image support data (`maxar`) and Airbus' DIMAP (`dimap`).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from barpc.errors import RpcFormatError
from barpc.sensor.document import Fields
from barpc.sensor.linescan import dimap, maxar
from barpc.sensor.linescan.samples import Linescan
from barpc.sensor.pushbroom import Light
from barpc.sidefile import parse_xml

__all__ = ["Linescan", "read_linescan"]

_VENDORS = {maxar.ROOT: (maxar.camera_of_isd, maxar.KIND), dimap.ROOT: (dimap.camera_of_dimap, dimap.KIND)}


def read_linescan(
    path: Path,
    *,
    band: str | None = None,
    aberration: bool | None = None,
    refraction: bool | None = None,
) -> Linescan:
    """Return the physical model in an XML file.

    Parameters
    ----------
    path : Path, Maxar's image support data or Airbus' ``DIM_*.XML``
    band : str, optional, the band whose detector is taken, where they have detectors of their own
    aberration, refraction : bool, optional
        Bending of the line of sight (`Light`); None: both kinds for Maxar, by the settings of a DIMAP for Airbus.

    Raises
    ------
    RpcFormatError
        There is no such model, or it is damaged.
    """
    root = Fields(parse_xml(path, strip_namespaces=True), str(path))
    vendor = _VENDORS.get(root.element.tag)
    if vendor is None:
        known = ", ".join(f"<{tag}>" for tag in _VENDORS)
        raise RpcFormatError(
            f"{path}: no physical camera model; its root is <{root.element.tag}>, expected one of {known}"
        )
    read, kind = vendor
    found, usual = read(root, band)
    light = Light(
        usual.aberration if aberration is None else aberration,
        usual.refraction if refraction is None else refraction,
    )
    return replace(found, model=replace(found.model, light=light), kind=kind)
