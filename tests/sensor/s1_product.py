"""A synthetic Sentinel-1: annotation and orbit files of a satellite on an exact circular orbit.

Truth is independent of barpc: the orbit is a formula, zero Doppler is found by bracketing.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.optimize import brentq

from barpc.base.geodesy import ecef_from_ground
from barpc.sensor.sentinel1 import RangeDoppler, read_annotation

RADIUS = 7_071_000.0
INCLINATION = np.deg2rad(98.18)
MEAN_MOTION = np.sqrt(3.986004418e14 / RADIUS**3)
EARTH_RATE = 7.2921159e-5
LIGHT = 299792458.0
INTERVAL = 2.055556299999998e-03
SAMPLING = 6.434523812571428e07
START = np.datetime64("2021-02-16T15:12:07.524369", "ns")
LATE = 2.925e-3
"""Half the range time at which the processor corrects the bistatic delay [s]."""


def stamp(seconds: float) -> str:
    """UTC text, to the microsecond, of seconds after START."""
    return str((START + np.timedelta64(round(seconds * 1e6), "us")).astype("datetime64[us]"))


@dataclass(frozen=True)
class Product:
    """One swath; the fields are what a test may vary."""

    swath: str = "IW1"
    product_type: str = "SLC"
    lon: float = 10.0
    argument: float = 0.75
    first_range_time: float = 5.34e-3
    samples: int = 21576
    first_burst: float = 0.0
    num_bursts: int = 9
    lines_per_burst: int = 1500
    burst_cycle: int = 1342
    states_from: float = -65.0
    num_states: int = 17
    step: float = 10.0
    stripmap: bool = False
    noise: float = 0.0
    sr0: float = 800_400.0

    @property
    def name(self) -> str:
        kind = self.product_type.lower()
        return f"s1a-{self.swath.lower()}-{kind}-vv-20210216t151207-20210216t151232-036617-044d40-004.xml"

    @property
    def lines(self) -> int:
        return self.num_bursts * self.lines_per_burst

    @property
    def duration(self) -> float:
        rows = (self.num_bursts - 1) * self.burst_cycle + self.lines_per_burst
        return ((rows if self.bursts else self.lines) - 1) * INTERVAL

    @property
    def bursts(self) -> bool:
        return self.product_type == "SLC" and not self.stripmap

    def state(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Exact ECEF position and velocity; the satellite is over `lon` 12.5 s after START."""
        ci, si = np.cos(INCLINATION), np.sin(INCLINATION)
        u = self.argument + MEAN_MOTION * (time - 12.5)
        node = np.deg2rad(self.lon) - np.arctan2(np.sin(self.argument) * ci, np.cos(self.argument))
        turn = node - EARTH_RATE * (time - 12.5)
        plane = RADIUS * np.array([np.cos(u), np.sin(u) * ci, np.sin(u) * si])
        speed = RADIUS * MEAN_MOTION * np.array([-np.sin(u), np.cos(u) * ci, np.cos(u) * si])
        c, s = np.cos(turn), np.sin(turn)
        spin = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        position = spin @ plane
        return position, spin @ speed - EARTH_RATE * np.array([-position[1], position[0], 0.0])

    def azimuth_range(self, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Zero-Doppler time [s after START] and two-way range time [s], by bracketing."""

        def solve(point: np.ndarray) -> tuple[float, float]:
            def doppler(time: float) -> float:
                position, velocity = self.state(time)
                return float(velocity @ (point - position))

            time = brentq(doppler, -120.0, 150.0, xtol=1e-13, rtol=1e-15)
            return time, 2.0 * float(np.linalg.norm(point - self.state(time)[0])) / LIGHT

        times = np.array([solve(point) for point in ecef_from_ground(ground)])
        return times[:, 0], times[:, 1]

    def model(self) -> RangeDoppler:
        """The model read from the annotation."""
        return _model(self)

    def xml(self) -> bytes:
        """The annotation, its geolocation grid computed from the truth."""
        return _annotation(self)

    def _annotation(self) -> bytes:
        rough = read_annotation(self._xml(np.zeros((1, 7))), name=self.name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # its grid is not there yet
            model = RangeDoppler.from_annotation(rough)
        step = self.lines_per_burst if self.bursts else self.lines // 9
        lines = np.arange(0, self.lines + 1, step) - np.r_[np.zeros(self.lines // step), 1]
        pixel, line = np.meshgrid(np.linspace(0, self.samples - 1, 5).round(), lines)
        row = line.ravel()
        if self.bursts:
            burst = np.minimum(row // self.lines_per_burst, self.num_bursts - 1)
            row = row - burst * (self.lines_per_burst - self.burst_cycle)
        alt = 100.0 + 300.0 * np.sin(np.arange(row.size)) ** 2
        ground = model.localize(np.stack([pixel.ravel(), row], axis=1), alt)
        times = self.azimuth_range(ground)
        late = LATE - 0.5 * times[1]  # the grid's lines are annotated with the bistatic correction
        ground = model.localize(np.stack([pixel.ravel(), row - late / INTERVAL], axis=1), alt)
        times = self.azimuth_range(ground)
        return self._xml(np.column_stack([*times, pixel.ravel(), line.ravel(), ground]))

    def _xml(self, grid: np.ndarray) -> bytes:
        rng = np.random.default_rng(7)
        states = ""
        for k in range(self.num_states):
            time = self.states_from + self.step * k
            position, velocity = self.state(time)
            velocity = velocity + self.noise * rng.normal(size=3)
            axes = ["".join(f"<{a}>{v:.6f}</{a}>" for a, v in zip("xyz", w, strict=True)) for w in (position, velocity)]
            states += (
                f"<orbit><time>{stamp(time)}</time><frame>Earth Fixed</frame>"
                f"<position>{axes[0]}</position><velocity>{axes[1]}</velocity></orbit>"
            )
        tags = ("slantRangeTime", "pixel", "line", "longitude", "latitude", "height")
        points = "".join(
            f"<geolocationGridPoint><azimuthTime>{stamp(row[0])}</azimuthTime>"
            + "".join(f"<{t}>{v:.15e}</{t}>" for t, v in zip(tags, row[1:], strict=True))
            + "</geolocationGridPoint>"
            for row in grid
        )
        slc = self.product_type == "SLC"
        first = 0.0 + self.first_burst
        return f"""<?xml version="1.0" encoding="UTF-8"?>
<product>
<adsHeader><missionId>S1A</missionId><productType>{self.product_type}</productType>
<polarisation>VV</polarisation><mode>{self.swath[:2]}</mode><swath>{self.swath}</swath></adsHeader>
<generalAnnotation><productInformation><rangeSamplingRate>{SAMPLING!r}</rangeSamplingRate></productInformation>
<downlinkInformationList><downlinkInformation><downlinkValues><pri>5.823e-04</pri><rank>9</rank>
</downlinkValues></downlinkInformation></downlinkInformationList>
<orbitList>{states}</orbitList></generalAnnotation>
<imageAnnotation><imageInformation>
<productFirstLineUtcTime>{stamp(first)}</productFirstLineUtcTime>
<productLastLineUtcTime>{stamp(first + self.duration)}</productLastLineUtcTime>
<slantRangeTime>{self.first_range_time!r}</slantRangeTime>
<rangePixelSpacing>{2.329562 if slc else 10.0}</rangePixelSpacing>
<azimuthTimeInterval>{INTERVAL!r}</azimuthTimeInterval>
<numberOfSamples>{self.samples}</numberOfSamples><numberOfLines>{self.lines}</numberOfLines>
</imageInformation><processingInformation><orbitSource>Auxiliary</orbitSource>
<bistaticDelayCorrectionApplied>true</bistaticDelayCorrectionApplied></processingInformation></imageAnnotation>
<swathTiming><linesPerBurst>{self.lines_per_burst if self.bursts else 0}</linesPerBurst>
{self._bursts() if self.bursts else ""}</swathTiming>
<geolocationGrid><geolocationGridPointList>{points}</geolocationGridPointList></geolocationGrid>
<coordinateConversion>{"" if slc else self._conversion()}</coordinateConversion>
</product>
""".encode()

    def _bursts(self) -> str:
        """Bursts whose first and last 20 lines are not valid."""
        valid = np.full(self.lines_per_burst, 100)
        valid[:20] = valid[-20:] = -1
        first, last = (
            " ".join(map(str, valid)),
            " ".join(map(str, np.where(valid < 0, -1, self.samples - 100))),
        )
        return (
            "<burstList>"
            + "".join(
                f"<burst><azimuthTime>{stamp(self.first_burst + k * self.burst_cycle * INTERVAL)}</azimuthTime>"
                f"<firstValidSample>{first}</firstValidSample><lastValidSample>{last}</lastValidSample></burst>"
                for k in range(self.num_bursts)
            )
            + "</burstList>"
        )

    def _conversion(self) -> str:
        """Ground range polynomials, drifting smoothly with time."""
        rows = ""
        for k in range(-2, 34):
            forward = [0.0, 1.98 + 1e-4 * k, -4.1e-6, 2.1e-11]
            backward = [self.sr0 + 3.0 * k, 0.505, 5.3e-7]
            lists = [" ".join(f"{c:.15e}" for c in cs) for cs in (forward, backward)]
            rows += (
                f"<coordinateConversion><azimuthTime>{stamp(k + 0.09)}</azimuthTime>"
                f"<sr0>{self.sr0 + 3.0 * k!r}</sr0><srgrCoefficients>{lists[0]}</srgrCoefficients>"
                f"<gr0>0.0</gr0><grsrCoefficients>{lists[1]}</grsrCoefficients></coordinateConversion>"
            )
        return f"<coordinateConversionList>{rows}</coordinateConversionList>"

    def eof(self, mission: str = "Sentinel-1A", start: float = -300.0, count: int = 70) -> bytes:
        """A precise orbit file of the same orbit."""
        rows = ""
        for k in range(count):
            position, velocity = self.state(start + 10.0 * k)
            values = zip(("X", "Y", "Z", "VX", "VY", "VZ"), [*position, *velocity], strict=True)
            numbers = "".join(f"<{tag}>{value:.6f}</{tag}>" for tag, value in values)
            rows += f"<OSV><UTC>UTC={stamp(start + 10.0 * k)}</UTC>{numbers}</OSV>"
        return f"""<?xml version="1.0"?><Earth_Explorer_File xmlns="http://x">
<Earth_Explorer_Header><Fixed_Header><Mission>{mission}</Mission></Fixed_Header>
<Variable_Header><Ref_Frame>EARTH_FIXED</Ref_Frame></Variable_Header></Earth_Explorer_Header>
<Data_Block type="xml"><List_of_OSVs count="{count}">{rows}</List_of_OSVs></Data_Block></Earth_Explorer_File>
""".encode()


@cache
def _annotation(product: Product) -> bytes:
    return product._annotation()


@cache
def _model(product: Product) -> RangeDoppler:
    return RangeDoppler.from_annotation(read_annotation(product.xml(), name=product.name))


IW = {
    "IW1": Product(),
    "IW2": Product(swath="IW2", first_range_time=5.34e-3 + 22000 / SAMPLING, samples=25000, first_burst=0.8),
    "IW3": Product(swath="IW3", first_range_time=5.34e-3 + 45000 / SAMPLING, samples=24300, first_burst=1.7),
}
"""The three swaths of one product."""

STRIPMAP = Product(swath="S3", stripmap=True, num_bursts=12, states_from=-10.0, step=1.0, num_states=60)

GRD = replace(Product(), swath="IW", product_type="GRD", samples=25000)
