"""A made-up TerraSAR-X product: annotation and GEOREF.xml of a satellite on an exact circular orbit."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from barpc.sensor.sentinel1 import RangeDoppler
from tests.sensor.s1_product import Product, stamp

NAME = "TSX1_SAR__SSC______SM_S_SRA_20210216T151215_20210216T151220.xml"
SIZE = (12000, 20001)  # columns, rows
START, INTERVAL = 8.0, 2.6e-4  # s after the orbit's epoch, s
NEAR, SPACING = 5.34e-3, 9.1e-9  # s


@cache
def _near(orbit: Product) -> RangeDoppler:
    """A model that tells which ground is near the swath."""
    return orbit.model()


@dataclass(frozen=True)
class Terrasar:
    """One product; the fields are what a test may vary."""

    look: str = "right"
    late: tuple[float, float] = (1.47e-8, -1.8e-4)  # s: of range and azimuth, as in a product of 2008
    orbit: Product = field(default_factory=Product)

    def ground(self, count: int = 60) -> np.ndarray:
        """Points near the swath, on the side that is looked at."""
        rng = np.random.default_rng(2)
        image = rng.uniform([0.0, START / 2.0556e-3], [6000.0, (START + 5.2) / 2.0556e-3], (count, 2))
        return replace(_near(self.orbit), look=self.look).localize(image, rng.uniform(-200.0, 3000.0, count))

    def image(self, ground: np.ndarray) -> np.ndarray:
        """Where the points are seen, by bracketing zero Doppler."""
        azimuth, delay = self.orbit.azimuth_range(ground)
        col = (delay + self.late[0] - NEAR) / SPACING
        return np.column_stack([col, (azimuth + self.late[1] - START) / INTERVAL])

    def main(self) -> str:
        """The annotation."""
        vectors = ""
        for time in np.arange(-35.0, 75.0, 10.0):
            position, velocity = self.orbit.state(float(time))
            values = zip("XYZ", position.tolist(), velocity.tolist(), strict=True)
            cells = "".join(f"<pos{a}>{p!r}</pos{a}><vel{a}>{v:.3f}</vel{a}>" for a, p, v in values)
            vectors += f'<stateVec num="1"><timeUTC>{stamp(float(time))}</timeUTC>{cells}</stateVec>\n'
        cols, rows = SIZE
        return f"""<?xml version="1.0" encoding="UTF-8"?>
<level1Product xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
<generalHeader fileName="{NAME}"><mission>TSX-1</mission></generalHeader>
<productInfo><acquisitionInfo><imagingMode>SM</imagingMode><lookDirection>{self.look.upper()}</lookDirection>
</acquisitionInfo><productVariantInfo><productVariant>SSC</productVariant><projection>SLANTRANGE</projection>
</productVariantInfo><imageDataInfo><imageRaster><numberOfRows>{rows}</numberOfRows>
<numberOfColumns>{cols}</numberOfColumns><rowSpacing units="s">{SPACING!r}</rowSpacing>
<columnSpacing units="s">{INTERVAL!r}</columnSpacing></imageRaster></imageDataInfo>
<sceneInfo><start><timeUTC>{stamp(START)}Z</timeUTC></start>
<stop><timeUTC>{stamp(START + (rows - 1) * INTERVAL)}Z</timeUTC></stop>
<rangeTime><firstPixel>{NEAR!r}</firstPixel><lastPixel>{NEAR + (cols - 1) * SPACING!r}</lastPixel></rangeTime>
<sceneAverageHeight>4.5E+02</sceneAverageHeight></sceneInfo></productInfo>
<productSpecific><complexImageInfo><imageCoordinateType>ZERODOPPLER</imageCoordinateType>
<imageDataStartWith>EARLYAZNEARRG</imageDataStartWith></complexImageInfo></productSpecific>
<platform><orbit><orbitHeader><stateVectorRefFrame>WGS84</stateVectorRefFrame></orbitHeader>
{vectors}</orbit></platform></level1Product>
"""

    def georef(self) -> str:
        """The delays, range's in two parts and one of them a polynomial, and the geolocation grid."""
        middle = NEAR + (SIZE[0] - 1) * SPACING / 2
        parts = [
            ("rangeDelay", NEAR, (2e-10, 1e-12)),
            ("rangeDelay", middle, (self.late[0] - 2e-10 - 1e-12 * (middle - NEAR),)),
            ("azimuthShift", middle, (self.late[1],)),
        ]
        delays = "".join(
            f"<{tag}><referencePoint>{at!r}</referencePoint>"
            + "".join(f'<coefficient exponent="{k}">{c!r}</coefficient>' for k, c in enumerate(coeffs))
            + f"</{tag}>"
            for tag, at, coeffs in parts
        )
        ground = self.ground(12)
        ground[:, 2] = np.linspace(103.0, 899.0, 12)  # the heights of the grid
        image = self.image(ground)
        points = "".join(
            f"<gridPoint><t>{row * INTERVAL!r}</t><tau>{col * SPACING!r}</tau><lat>{lat!r}</lat><lon>{lon!r}</lon>"
            f"<row>{round(row) + 1}</row><col>{round(col) + 1}</col><height>{alt!r}</height></gridPoint>\n"
            for (col, row), (lon, lat, alt) in zip(image.tolist(), ground.tolist(), strict=True)
        )
        return f"""<geoReference><signalPropagationEffects>{delays}</signalPropagationEffects>
<geolocationGrid><gridReferenceTime><tReferenceTimeUTC>{stamp(START)}Z</tReferenceTimeUTC>
<tauReferenceTime>{NEAR!r}</tauReferenceTime></gridReferenceTime>
{points}</geolocationGrid></geoReference>
"""

    def write(self, folder: Path) -> Path:
        """The product in a folder; the path of its annotation."""
        (folder / "ANNOTATION").mkdir(parents=True, exist_ok=True)
        (folder / "ANNOTATION" / "GEOREF.xml").write_text(self.georef())
        (folder / NAME).write_text(self.main())
        return folder / NAME
