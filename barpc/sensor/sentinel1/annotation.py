"""Geometric content of a Sentinel-1 annotation file, and of a precise orbit file.

Names are the annotation's own, in snake case; times are numpy datetime64[ns], which holds the microseconds
of the files exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from barpc.base.errors import RpcFormatError
from barpc.base.geodesy import Array
from barpc.base.safe_io import parse_xml
from barpc.sensor.curve import ORBIT_MARGIN
from barpc.sensor.document import XmlFields, seconds

TimeArray = npt.NDArray[np.datetime64]

MISSIONS = {"S1A": "Sentinel-1A", "S1B": "Sentinel-1B", "S1C": "Sentinel-1C", "S1D": "Sentinel-1D"}
"""Mission of an annotation -> mission of an orbit file."""


@dataclass(frozen=True, eq=False)
class StateVectors:
    """Earth-fixed orbit state vectors."""

    time: TimeArray  # (N,): datetime64[ns], UTC
    position: Array  # (N, 3): ECEF [m]
    velocity: Array  # (N, 3): ECEF [m/s]
    source: str  # where they come from: "Auxiliary", "Downlink", or the type of the orbit file, "AUX_POEORB"


@dataclass(frozen=True, eq=False)
class Burst:
    """One burst of a TOPS swath."""

    time: np.datetime64  # zero-Doppler time of the burst's first line (`azimuthTime`)
    first_valid: npt.NDArray[np.int64]  # (L,): first valid sample of every line; -1: the line is not valid
    last_valid: npt.NDArray[np.int64]  # (L,): the last one


@dataclass(frozen=True)
class BurstRows:
    """Rows of a burst in the stitched frame."""

    first_line: int  # of the burst in the measurement file
    first_row: int  # frame row of that line
    start: int  # the first frame row that is taken from this burst
    stop: int  # the row behind the last one
    offset: float  # what rounding the burst's time to a row left [rows]: 1e-3, up to 0.15 before 2016


@dataclass(frozen=True, eq=False)
class GroundRange:
    """Slant range to ground range, as polynomials listed in time (`coordinateConversion`)."""

    time: TimeArray  # (M,): datetime64[ns]
    slant_origin: Array  # (M,): `sr0` [m]
    ground_from_slant: Array  # (M, K): ascending powers of (slant - sr0) [m]
    slant_from_ground: Array  # (M, K): of (ground - gr0) [m]


@dataclass(frozen=True, eq=False)
class GridPoints:
    """The product's own geolocation grid."""

    time: TimeArray  # (G,): azimuth time, datetime64[ns]
    range_time: Array  # (G,): two-way slant range time [s]
    image: Array  # (G, 2): the annotation's (pixel, line)
    ground: Array  # (G, 3): lon, lat [deg], alt [m]


@dataclass(frozen=True, eq=False)
class Annotation:
    """One annotation file: one swath of an SLC, or a GRD."""

    name: str  # the file, for messages
    mission: str  # S1A; all in upper case
    product_type: str  # SLC or GRD
    mode: str  # IW, EW, S1 .. S6, WV
    swath: str  # IW1, EW3, S4, IW (GRD)
    polarisation: str  # VV ...
    states: StateVectors
    first_line_time: np.datetime64
    last_line_time: np.datetime64
    azimuth_time_interval: float  # between lines [s]
    slant_range_time: float  # two-way, of the first sample [s]
    range_sampling_rate: float  # [Hz]
    range_pixel_spacing: float  # [m]; ground range in a GRD
    samples: int  # of a line of the measurement file
    lines: int  # of the measurement file
    lines_per_burst: int  # 0 where there are no bursts
    bursts: tuple[Burst, ...]
    ground_range: GroundRange | None  # of a GRD
    grid: GridPoints
    rank: int  # pulses on their way between sending and receiving
    pulse_interval: float  # [s]
    bistatic_applied: bool  # whether the processor corrected the bistatic delay, at mid range

    @property
    def kind(self) -> str:
        """Kind of product, for messages."""
        return f"a {self.mode} {self.product_type} of {self.swath}"

    def line_time(self, line: Array) -> TimeArray:
        """Return the annotated times (...), datetime64[ns], of lines (...) of the measurement file."""
        start, rest = np.array([self.first_line_time]), np.asarray(line, dtype=np.float64)
        index = np.zeros(rest.shape, dtype=np.int64)
        if self.bursts:
            start = np.array([b.time for b in self.bursts])
            index = np.clip(rest // self.lines_per_burst, 0, len(start) - 1).astype(np.int64)
            rest = rest - index * self.lines_per_burst
        since = np.rint(rest * self.azimuth_time_interval * 1e9).astype("timedelta64[ns]")
        return np.asarray(start[index] + since)


def burst_rows(annotation: Annotation) -> list[BurstRows]:
    """Return the rows of a TOPS swath's bursts in the stitched frame; overlaps are cut at their middle.

    RpcFormatError for bursts out of order, or one without a valid line.
    """
    since = [seconds(b.time, annotation.first_line_time) for b in annotation.bursts]
    exact = [float(time / annotation.azimuth_time_interval) for time in since]
    first = [round(row) for row in exact]
    valid = [np.flatnonzero(b.first_valid >= 0) for b in annotation.bursts]
    if any(not len(v) for v in valid) or any(b <= a for a, b in pairwise(first)):
        raise RpcFormatError(f"{annotation.name}: bursts out of order, or one without valid lines")
    spans = [(row + int(v[0]), row + int(v[-1]) + 1) for row, v in zip(first, valid, strict=True)]
    cuts = [(a[1] + b[0]) // 2 for a, b in pairwise(spans)]
    starts, stops = [spans[0][0], *cuts], [*cuts, spans[-1][1]]
    return [
        BurstRows(k * annotation.lines_per_burst, first[k], starts[k], stops[k], exact[k] - first[k])
        for k in range(len(first))
    ]


def read_annotation(source: bytes | Path, name: str | None = None) -> Annotation:
    """Read a Sentinel-1 product annotation (``annotation/s1a-iw1-slc-vv-....xml``), called `name` in messages.

    RpcFormatError where it is none, or a field that the geometry needs is missing or not a number.
    """
    name = name or (source.name if isinstance(source, Path) else "annotation")
    root = parse_xml(source, name=str(source) if isinstance(source, Path) else name)
    if root.tag != "product" or root.find("adsHeader/missionId") is None:
        raise RpcFormatError(
            f"{name}: not a Sentinel-1 product annotation (its root is <{root.tag}>); "
            "give annotation/s1?-*.xml, not calibration, noise or rfi"
        )
    info, timing = "imageAnnotation/imageInformation/", "swathTiming/"
    values, processing = XmlFields(root, name), "imageAnnotation/processingInformation/"
    downlink = "generalAnnotation/downlinkInformationList/downlinkInformation/downlinkValues/"
    return Annotation(
        name=name,
        mission=values.text("adsHeader/missionId").upper(),
        product_type=values.text("adsHeader/productType").upper(),
        mode=values.text("adsHeader/mode").upper(),
        swath=values.text("adsHeader/swath").upper(),
        polarisation=values.text("adsHeader/polarisation").upper(),
        states=_annotated_states(values),
        first_line_time=values.time(info + "productFirstLineUtcTime"),
        last_line_time=values.time(info + "productLastLineUtcTime"),
        azimuth_time_interval=values.positive(info + "azimuthTimeInterval", most=1.0),
        slant_range_time=values.positive(info + "slantRangeTime"),
        range_sampling_rate=values.positive("generalAnnotation/productInformation/rangeSamplingRate"),
        range_pixel_spacing=values.positive(info + "rangePixelSpacing"),
        samples=int(values.positive(info + "numberOfSamples")),
        lines=int(values.positive(info + "numberOfLines")),
        lines_per_burst=int(values.numbers(timing + "linesPerBurst")[0]),
        bursts=tuple(_burst(burst) for burst in values.all(timing + "burstList/burst")),
        ground_range=_ground_range(values),
        grid=_grid(values),
        rank=int(values.numbers(downlink + "rank")[0]),
        pulse_interval=values.positive(downlink + "pri"),
        bistatic_applied=root.findtext(processing + "bistaticDelayCorrectionApplied", "").strip() == "true",
    )


def read_orbit_file(path: Path, annotation: Annotation) -> StateVectors:
    """Return the state vectors around an image in an orbit file (``S1A_OPER_AUX_POEORB_....EOF``).

    RpcFormatError where it is no orbit file, another satellite's, or without a vector near that time.
    """
    mission, start, stop = annotation.mission, annotation.first_line_time, annotation.last_line_time
    root = parse_xml(path, strip_namespaces=True)
    vectors = XmlFields(root, str(path)).all("Data_Block/List_of_OSVs/OSV")
    if not vectors:
        raise RpcFormatError(f"{path}: not a Sentinel-1 orbit file (no List_of_OSVs)")
    owner = root.findtext("Earth_Explorer_Header/Fixed_Header/Mission", "").strip()
    if owner != MISSIONS.get(mission, mission):
        raise RpcFormatError(f"{path}: the orbit of {owner or 'no known mission'}, the image is of {mission}")
    frame = root.findtext("Earth_Explorer_Header/Variable_Header/Ref_Frame", "EARTH_FIXED").strip()
    if frame != "EARTH_FIXED":
        raise RpcFormatError(f"{path}: state vectors in {frame}, EARTH_FIXED is needed")
    times = _row_times(vectors, "UTC")
    pad = np.timedelta64(int(ORBIT_MARGIN * 1e9), "ns")
    near = np.flatnonzero((times >= start - pad) & (times <= stop + pad))
    if not len(near):
        raise RpcFormatError(
            f"{path}: covers {times.min()} to {times.max()}, the image is of {start}; take the orbit file of that day"
        )
    kind = root.findtext("Earth_Explorer_Header/Fixed_Header/File_Type", "").strip()
    return _states([vectors[i] for i in near], "UTC", ("X", "Y", "Z", "VX", "VY", "VZ"), kind)


def _row_times(rows: Sequence[XmlFields], tag: str) -> TimeArray:
    return np.array([row.time(tag) for row in rows], dtype="datetime64[ns]")


def _states(vectors: Sequence[XmlFields], time: str, tags: Sequence[str], source: str) -> StateVectors:
    """Return the state vectors whose time is named `time`, and x, y, z of position and of velocity by `tags`."""
    table = np.reshape([[v.numbers(tag)[0] for tag in tags] for v in vectors], (-1, 6))
    return StateVectors(_row_times(vectors, time), table[:, :3], table[:, 3:], source)


def _annotated_states(root: XmlFields) -> StateVectors:
    vectors = root.all("generalAnnotation/orbitList/orbit")
    if any(v.text("frame") != "Earth Fixed" for v in vectors):
        raise RpcFormatError(f"{root.name}: orbit state vectors are not Earth fixed; give an orbit file")
    source = root.element.findtext("imageAnnotation/processingInformation/orbitSource", "annotation")
    tags = [f"{part}/{axis}" for part in ("position", "velocity") for axis in "xyz"]
    return _states(vectors, "time", tags, source.strip())


def _burst(burst: XmlFields) -> Burst:
    first, last = (burst.numbers(tag).astype(np.int64) for tag in ("firstValidSample", "lastValidSample"))
    if first.shape != last.shape:
        raise RpcFormatError(f"{burst.name}: a burst lists {len(first)} first and {len(last)} last valid samples")
    return Burst(burst.time("azimuthTime"), first, last)


def _ground_range(root: XmlFields) -> GroundRange | None:
    rows = root.all("coordinateConversion/coordinateConversionList/coordinateConversion")
    if not rows:
        return None
    forward, backward = ([row.numbers(tag) for row in rows] for tag in ("srgrCoefficients", "grsrCoefficients"))
    if len({len(c) for c in forward}) > 1 or len({len(c) for c in backward}) > 1:
        raise RpcFormatError(f"{root.name}: ground range polynomials of different lengths")
    time = _row_times(rows, "azimuthTime")
    if not (np.diff(time) > np.timedelta64(0, "ns")).all():
        raise RpcFormatError(f"{root.name}: the times of the ground range polynomials do not rise")
    origin = np.array([row.numbers("sr0")[0] for row in rows])
    return GroundRange(time, origin, np.array(forward), np.array(backward))


def _grid(root: XmlFields) -> GridPoints:
    points = root.all("geolocationGrid/geolocationGridPointList/geolocationGridPoint")
    if not points:
        raise RpcFormatError(f"{root.name}: no geolocation grid; is the file complete?")
    tags = ("slantRangeTime", "pixel", "line", "longitude", "latitude", "height")
    table = np.array([[point.numbers(tag)[0] for tag in tags] for point in points])
    return GridPoints(_row_times(points, "azimuthTime"), table[:, 0], table[:, 1:3], table[:, 3:6])
