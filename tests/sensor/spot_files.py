"""Metadata of SPOT 1A scenes (DIMAP 1) as CNES describes them, of an orbit and attitudes made here.

What they mean is worked out once more, without barpc's cameras: a circular orbit in the inertial frame under which the
Earth turns, the handbook's rotations written out, and PROJ for where a line of sight reaches an altitude.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyproj
from scipy.optimize import brentq

Array = np.ndarray

_TO_GROUND = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
_RADIUS, _INCLINATION, _MU, _TURN = 7.2006e6, np.radians(98.7), 3.986004418e14, 7.292115e-5


def still(time: Array) -> Array:
    """Yaw, pitch, roll (N, 3) of a satellite that flies level."""
    return np.zeros((len(np.atleast_1d(time)), 3))


def steered(time: Array) -> Array:
    """Yaw, pitch, roll (N, 3) [rad] that differ in size and sign, and change."""
    time = np.atleast_1d(time)[:, None]
    return np.array([0.051, -0.0021, 0.0013]) + time * [4e-5, 1.1e-5, -0.7e-5]


@dataclass
class Scene:
    """A scene, and its document; the fields are what a test may vary."""

    mission: int = 5
    size: tuple[int, int] = (1200, 1000)
    center_line: int = 480
    period: float = 1.504e-3
    center: str = "2005-05-09T23:59:59.731234"
    inside: tuple[float, float] = (0.006, 0.31)  # psi_x of the first detector, psi_y of it [rad]
    swath: tuple[float, float] = (0.002, 0.0144)  # what the last one adds
    step: float = 30.0  # s: of the ephemeris
    points: int = 9
    angles: Callable[[Array], Array] = steered
    argument: float = 2.2  # rad from the node: descending, north
    turned: float = 0.9  # rad: of the Earth at the scene's centre
    listed: int | None = None  # detectors with look angles; None: each of SPOT 5, two of others

    def flown(self, time: float) -> tuple[Array, Array]:
        """Position and velocity, ECEF, at a time [s from the scene's centre]."""
        rate = np.sqrt(_MU / _RADIUS**3)
        u, theta = self.argument + rate * time, self.turned + _TURN * time
        node, high = np.array([1.0, 0, 0]), np.array([0, np.cos(_INCLINATION), np.sin(_INCLINATION)])
        place = _RADIUS * (np.cos(u) * node + np.sin(u) * high)
        speed = _RADIUS * rate * (-np.sin(u) * node + np.cos(u) * high) - np.cross([0, 0, _TURN], place)
        c, s = np.cos(theta), np.sin(theta)
        earth = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        return earth @ place, earth @ speed

    def psi(self, col: float) -> tuple[float, float]:
        """Look angles [rad] of a column, counted from 1: linear of SPOT 1 to 4, bent of SPOT 5."""
        part = (col - 1) / (self.size[0] - 1)
        bend = 3e-6 * np.sin(3 * part) if self.mission == 5 else 0.0
        return self.inside[0] + self.swath[0] * part + bend, self.inside[1] + self.swath[1] * part - bend

    def sight(self, col: float, row: float, attitude: bool) -> tuple[Array, Array]:
        """Place and direction, ECEF, of a pixel counted from 1."""
        time = self.period * (row - self.center_line)
        place, speed = self.flown(time)
        psi_x, psi_y = self.psi(col)
        seen = np.array([-np.tan(psi_y), np.tan(psi_x), -1.0])
        if attitude:
            y, p, r = self.angles(time)[0]
            yaw = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
            roll = np.array([[np.cos(r), 0, -np.sin(r)], [0, 1, 0], [np.sin(r), 0, np.cos(r)]])
            pitch = np.array([[1, 0, 0], [0, np.cos(p), np.sin(p)], [0, -np.sin(p), np.cos(p)]])
            seen = pitch @ roll @ yaw @ seen
        up = place / np.linalg.norm(place)
        across = np.cross(speed, up) / np.linalg.norm(np.cross(speed, up))
        direction = np.stack([across, np.cross(up, across), up], axis=1) @ seen
        return place, direction / np.linalg.norm(direction)

    def ground(self, image: Array, alt: float, attitude: bool | None = None) -> Array:
        """Ground points (N, 3) of image points (N, 2), the first pixel's centre being (0, 0)."""
        attitude = self.mission == 5 if attitude is None else attitude
        out = []
        for col, row in np.asarray(image, dtype=float) + 1.0:
            place, d = self.sight(col, row, attitude)
            far = brentq(lambda s, o=place, d=d: _TO_GROUND.transform(*(o + s * d))[2] - alt, 5e5, 1.6e6, xtol=1e-6)
            out.append(_TO_GROUND.transform(*(place + far * d)))
        return np.array(out)

    def stamp(self, seconds: float) -> str:
        """UTC of a time [s from the scene's centre], in microseconds as delivered."""
        return str(np.datetime64(self.center, "us") + np.timedelta64(round(seconds * 1e6), "us"))

    def corners(self) -> list[tuple[int, int]]:
        """Column and row, from 1, of the corners as they are listed."""
        width, height = self.size
        return [(1, 1), (width, 1), (width, height), (1, height)]

    def text(self) -> str:
        """The document."""
        width, height = self.size
        rows = np.array(self.corners())
        frame = "".join(
            f"<Vertex><FRAME_LON>{lon:.7f}</FRAME_LON><FRAME_LAT>{lat:.7f}</FRAME_LAT><FRAME_ROW>{row}</FRAME_ROW>"
            f"<FRAME_COL>{col}</FRAME_COL></Vertex>"
            for (col, row), (lon, lat, _) in zip(rows, self.ground(rows - 1, 0.0), strict=True)
        )
        source = (
            "<Source_Information><SOURCE_TYPE>SCENE</SOURCE_TYPE><Scene_Source><IMAGING_DATE>2005-05-09</IMAGING_DATE>"
            f"<IMAGING_TIME>23:59:59</IMAGING_TIME><MISSION>SPOT</MISSION><MISSION_INDEX>{self.mission}</MISSION_INDEX>"
            f"<INSTRUMENT>{'HRG' if self.mission == 5 else 'HRV'}</INSTRUMENT><INSTRUMENT_INDEX>1</INSTRUMENT_INDEX>"
            "<SENSOR_CODE>A</SENSOR_CODE><INCIDENCE_ANGLE>20.5</INCIDENCE_ANGLE><SUN_AZIMUTH>151.5</SUN_AZIMUTH><SUN_ELEVATION>61.25</SUN_ELEVATION>"
            "</Scene_Source></Source_Information>"
        )
        begin, stop = (self.period * (row - self.center_line) for row in (1, height))
        middle = self.step * (self.points - 1) / 2 + 3.7
        points = "".join(self._point(self.step * k - middle) for k in range(self.points))
        ticks = np.arange(begin - 0.3, stop + 0.4, 0.125)
        return f"""<?xml version="1.0" encoding="ISO-8859-1"?>
<?xml-stylesheet type="text/xsl" href="STYLE.XSL"?>
<Dimap_Document name="METADATA.DIM"><Metadata_Id><METADATA_FORMAT version="1.1">DIMAP</METADATA_FORMAT>
<METADATA_PROFILE>SPOTSCENE_1A</METADATA_PROFILE></Metadata_Id>
<Dataset_Frame>{frame}<SCENE_ORIENTATION>12.9</SCENE_ORIENTATION></Dataset_Frame>
<Raster_Dimensions><NCOLS>{width}</NCOLS><NROWS>{height}</NROWS><NBANDS>1</NBANDS></Raster_Dimensions>
<Dataset_Sources>{source}{source}</Dataset_Sources>
<Data_Processing><PROCESSING_LEVEL>1A</PROCESSING_LEVEL></Data_Processing>
<Data_Access><Data_File><DATA_FILE_PATH href="IMAGERY.TIF"/></Data_File></Data_Access>
<Data_Strip><Satellite_Time><UT_DATE>{self.stamp(0)}</UT_DATE></Satellite_Time>
<Ephemeris><SATELLITE_ALTITUDE>832</SATELLITE_ALTITUDE><Points>{points}</Points></Ephemeris>
<Satellite_Attitudes>{self._attitudes(ticks)}</Satellite_Attitudes>
<Sensor_Configuration><Time_Stamp><LINE_PERIOD>{self.period:.12f}</LINE_PERIOD>
<SCENE_CENTER_TIME>{self.stamp(0)}</SCENE_CENTER_TIME><SCENE_CENTER_LINE>{self.center_line}</SCENE_CENTER_LINE>
<SCENE_CENTER_COL>{width // 2}</SCENE_CENTER_COL></Time_Stamp>
<Instrument_Look_Angles_List>{self._look(1)}{self._look(2, 1e-4)}</Instrument_Look_Angles_List>
</Sensor_Configuration></Data_Strip></Dimap_Document>
"""

    def _point(self, time: float) -> str:
        place, speed = self.flown(time)
        location, velocity = (
            "".join(f"<{axis}>{float(v)!r}</{axis}>" for axis, v in zip("XYZ", values, strict=True))
            for values in (place, speed)
        )
        return (
            f"<Point><Location>{location}</Location><Velocity>{velocity}</Velocity><TIME>{self.stamp(time)}</TIME>"
            "</Point>\n"
        )

    def _rows(self, tag: str, ticks: Array, values: Array) -> str:
        return "\n".join(
            f"<{tag}><TIME>{self.stamp(t)}</TIME><YAW>{float(y)!r}</YAW><PITCH>{float(p)!r}</PITCH>"
            f"<ROLL>{float(r)!r}</ROLL><OUT_OF_RANGE>N</OUT_OF_RANGE></{tag}>"
            for t, (y, p, r) in zip(ticks, values, strict=True)
        )

    def _attitudes(self, ticks: Array) -> str:
        speeds = (self.angles(ticks + 1e-3) - self.angles(ticks - 1e-3)) / 2e-3
        start = np.array([ticks[0] + 0.25])  # not at the first speed
        aocs = (
            f"<Angles_List>{self._rows('Angles', start, self.angles(start))}</Angles_List>"
            f"<Angular_Speeds_List>{self._rows('Angular_Speeds', ticks, speeds)}</Angular_Speeds_List>"
        )
        raw = f"<Raw_Attitudes><Aocs_Attitude>{aocs}</Aocs_Attitude></Raw_Attitudes>"
        if self.mission < 5:
            return raw
        fine = self._rows("Angles", ticks, self.angles(ticks))
        return (
            f"{raw}<Corrected_Attitudes><STAR_TRACKER_USED>Y</STAR_TRACKER_USED><Corrected_Attitude>{fine}"
            "</Corrected_Attitude></Corrected_Attitudes>"
        )

    def _look(self, band: int, more: float = 0.0) -> str:
        width = self.size[0]
        count = self.listed or (width if self.mission == 5 else 2)
        rows = "".join(
            f"<Look_Angles><DETECTOR_ID>{col}</DETECTOR_ID><PSI_X>{float(x) + more!r}</PSI_X>"
            f"<PSI_Y>{float(y)!r}</PSI_Y></Look_Angles>"
            for col in np.linspace(1, width, count).astype(int)
            for x, y in [self.psi(col)]
        )
        return (
            f"<Instrument_Look_Angles><BAND_INDEX>{band}</BAND_INDEX><Look_Angles_List>{rows}</Look_Angles_List>"
            "</Instrument_Look_Angles>"
        )
