"""SICD: radar images of Umbra, Capella, ICEYE and others, by the projection that their metadata state.

`open_sicd` makes the model from the XML alone, as a file or within a NITF (NGA.STND.0024, SICD volumes 1 and 3).
"""

from barpc.sensor.sicd.formation import Formation, ImagePlane, PolarFormat, RangeAzimuth, ZeroDoppler
from barpc.sensor.sicd.metadata import find_sicd, is_sicd, open_sicd
from barpc.sensor.sicd.monostatic import Monostatic

__all__ = [
    "Formation",
    "ImagePlane",
    "Monostatic",
    "PolarFormat",
    "RangeAzimuth",
    "ZeroDoppler",
    "find_sicd",
    "is_sicd",
    "open_sicd",
]
