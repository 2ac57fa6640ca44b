"""Range-Doppler models from what is delivered: folders, zips, annotations; a swath, a burst, a mosaic, a GRD."""

from __future__ import annotations

import re
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np

from barpc.errors import BarpcError, BarpcWarning, InputError, RpcError, RpcFormatError
from barpc.geodesy import Array
from barpc.safexml import MAX_BYTES
from barpc.sensor.sentinel1.annotation import (
    Annotation,
    StateVectors,
    read_annotation,
    read_orbit_file,
    seconds,
)
from barpc.sensor.sentinel1.frames import Bistatic, Delays, Frame, GroundFrame, SlantFrame, bistatic_constant
from barpc.sensor.sentinel1.orbit import MARGIN, Orbit, fit_orbit
from barpc.sensor.sentinel1.range_doppler import RangeDoppler
from barpc.sidefile import PRODUCT, opened, read_head

RELIEF = (200.0, 500.0)
"""How far the terrain may lie below the lowest and above the highest point of the geolocation grid [m]."""

_GRID_TOLERANCE = 5.0  # px and lines: a grid farther off does not belong to the orbit
_SAME = 1e-9  # relative: intervals and rates of the swaths of one mosaic
MOSAIC = "mosaic"
"""The swath of all swaths."""
_NAME = re.compile(r"s1[a-d]-(?P<swath>\w+)-(slc|grd)-(?P<pol>vv|hh|vh|hv)-.*\.xml", re.IGNORECASE)
_POLARISATIONS = ("vv", "hh", "vh", "hv")


@dataclass(frozen=True)
class BurstRows:
    """Where a burst stands in the stitched frame.

    Parameters
    ----------
    first_line : int
        Of the burst in the measurement file.
    first_row : int
        Frame row of that line.
    start, stop : int
        Frame rows [start, stop) that are taken from this burst.
    offset : float
        What rounding the burst's time to a row left [rows]: 1e-3, up to 0.15 before 2016.
    """

    first_line: int
    first_row: int
    start: int
    stop: int
    offset: float


def from_annotation(
    source: Path | Annotation,
    *,
    burst: int | None = None,
    orbit: Path | None = None,
    atmosphere: bool = False,
    bistatic: Bistatic | None = None,
) -> RangeDoppler:
    """The model of one SLC swath (bursts stitched, or stripmap), one burst, or a GRD.

    Column 0 is the annotation's pixel 0. Row 0 is its line 0; in a stitched swath rows go on by
    zero-Doppler time, and `burst_rows` says where the lines of each burst lie.

    Parameters
    ----------
    source : Path or Annotation
        The annotation XML.
    burst : int, optional
        The model of this burst alone, from 0; row 0 is its first line.
    orbit : Path, optional
        Precise orbit file (``.EOF``) to use in place of the annotated state vectors.
    atmosphere : bool
        Add the path delay of the atmosphere (see `Delays`).
    bistatic : "annotated" or "full", optional
        Add a bistatic correction (see `bistatic_constant`).

    Returns
    -------
    model : RangeDoppler

    Raises
    ------
    RpcError
        Not a Sentinel-1 annotation (an `RpcFormatError`), or an orbit that cannot be used.
    InputError
        No such burst, or a correction that this product does not take.

    Warns
    -----
    BarpcWarning
        The geolocation grid does not belong to the orbit; it is not used but for its range of heights.
    """
    annotation = source if isinstance(source, Annotation) else read_annotation(source)
    first, lines = _extent(annotation, burst)
    model = RangeDoppler(
        orbit=_orbit(annotation, orbit, first),
        epoch=first,
        frame=_frame(annotation, first),
        size=(annotation.samples, lines),
        alt_range=_alt_range([annotation]),
        delays=Delays(atmosphere, None if bistatic is None else bistatic_constant(annotation, bistatic)),
    )
    _warn_of_grid(annotation, model)
    return model


def _extent(annotation: Annotation, burst: int | None = None) -> tuple[np.datetime64, int]:
    """Time of row 0 and number of rows: of a burst, or of all there is, stitched."""
    if burst is not None:
        if not 0 <= burst < len(annotation.bursts):
            raise InputError(f"{annotation.name}: no burst {burst}, it has {len(annotation.bursts)}")
        return annotation.bursts[burst].time, annotation.lines_per_burst
    if not annotation.bursts:
        return annotation.first_line_time, annotation.lines
    last = max(b.first_row for b in burst_rows(annotation))
    return annotation.first_line_time, last + annotation.lines_per_burst


def mosaic(
    sources: Sequence[Path | Annotation],
    *,
    orbit: Path | None = None,
    atmosphere: bool = False,
    bistatic: Bistatic | None = None,
) -> RangeDoppler:
    """One model for the swaths of an SLC product, side by side.

    Column 0 is pixel 0 of the nearest swath (IW1, EW1) and row 0 the earliest line 0; the other swaths
    start at ``mosaic_offsets``.

    Parameters
    ----------
    sources : sequence of Path or Annotation
        Annotations of swaths of one product.
    orbit : Path, optional
        Precise orbit file.
    atmosphere : bool
        Add the path delay of the atmosphere.
    bistatic : "annotated", optional
        Add the bistatic correction of the product; the full one jumps between swaths.

    Returns
    -------
    model : RangeDoppler

    Raises
    ------
    InputError
        A GRD, swaths that are not of one product, or the full bistatic correction.
    """
    swaths = [s if isinstance(s, Annotation) else read_annotation(s) for s in sources]
    if bistatic == "full":
        raise InputError("the full bistatic correction jumps between swaths: take one swath, or 'annotated'")
    offsets = mosaic_offsets(swaths)
    nearest = min(swaths, key=lambda a: a.slant_range_time)
    epoch = min(a.first_line_time for a in swaths)
    size = np.rint((offsets + [[a.samples, _extent(a)[1]] for a in swaths]).max(axis=0))
    model = RangeDoppler(
        orbit=_orbit(nearest, orbit, epoch),
        epoch=epoch,
        frame=_frame(nearest, epoch),
        size=(int(size[0]), int(size[1])),
        alt_range=_alt_range(swaths),
        delays=Delays(atmosphere, None if bistatic is None else bistatic_constant(nearest, bistatic)),
    )
    for annotation in swaths:
        _warn_of_grid(annotation, model)
    return model


def mosaic_offsets(swaths: Sequence[Annotation]) -> Array:
    """Where the stitched frame of each swath begins in the frame of their mosaic.

    Parameters
    ----------
    swaths : sequence of Annotation
        Swaths of one SLC product.

    Returns
    -------
    offsets : (S, 2)
        col, row [px]: whole numbers to within 1e-3 in products since 2016.

    Raises
    ------
    InputError
        A GRD, or swaths that are not of one product.
    """
    if not swaths:
        raise InputError("a mosaic of no swaths: give the annotations of IW1, IW2 and IW3")
    first = swaths[0]
    for other in swaths:
        if other.product_type != "SLC" or not other.bursts:
            raise InputError(f"{other.name}: a mosaic takes TOPS SLC swaths, this is {_kind(other)}")
        apart = abs(seconds(other.first_line_time, first.first_line_time))
        rates = other.azimuth_time_interval / first.azimuth_time_interval - 1.0
        rates = max(abs(rates), abs(other.range_sampling_rate / first.range_sampling_rate - 1.0))
        if (
            other.mission != first.mission
            or apart > other.lines * other.azimuth_time_interval
            or rates > _SAME
        ):
            raise InputError(f"{other.name}: not of the same product as {first.name}")
    near = min(a.slant_range_time for a in swaths)
    epoch = min(a.first_line_time for a in swaths)
    return np.array(
        [
            [
                (a.slant_range_time - near) * a.range_sampling_rate,
                seconds(a.first_line_time, epoch) / a.azimuth_time_interval,
            ]
            for a in swaths
        ]
    )


def burst_rows(annotation: Annotation) -> list[BurstRows]:
    """Where the bursts stand in the stitched frame; overlaps are cut at their middle.

    Parameters
    ----------
    annotation : Annotation
        A TOPS SLC swath.

    Returns
    -------
    rows : list of BurstRows

    Raises
    ------
    RpcFormatError
        Bursts out of order, or one without a valid line.
    """
    exact = [
        seconds(b.time, annotation.first_line_time) / annotation.azimuth_time_interval
        for b in annotation.bursts
    ]
    first = [round(float(row)) for row in exact]
    valid = [np.flatnonzero(b.first_valid >= 0) for b in annotation.bursts]
    if any(not len(v) for v in valid) or any(b <= a for a, b in pairwise(first)):
        raise RpcFormatError(f"{annotation.name}: bursts out of order, or one without valid lines")
    spans = [(row + int(v[0]), row + int(v[-1]) + 1) for row, v in zip(first, valid, strict=True)]
    cuts = [(a[1] + b[0]) // 2 for a, b in pairwise(spans)]
    starts, stops = [spans[0][0], *cuts], [*cuts, spans[-1][1]]
    return [
        BurstRows(k * annotation.lines_per_burst, first[k], starts[k], stops[k], float(exact[k]) - first[k])
        for k in range(len(first))
    ]


def grid_residuals(annotation: Annotation, model: RangeDoppler) -> Array:
    """The model against the product's own geolocation grid.

    Parameters
    ----------
    annotation : Annotation
        Of the product (or one swath of a mosaic).
    model : RangeDoppler

    Returns
    -------
    residuals : (G, 2)
        Range [samples of `range_sampling_rate`], azimuth [lines]: model - grid, geometry only.
    """
    grid = annotation.grid
    azimuth_time, range_time = model.azimuth_range(grid.ground)
    return np.stack(
        [
            (range_time - grid.range_time) * annotation.range_sampling_rate,
            (azimuth_time - seconds(grid.time, model.epoch)) / annotation.azimuth_time_interval,
        ],
        axis=1,
    )


def _orbit(annotation: Annotation, file: Path | None, epoch: np.datetime64) -> Orbit:
    """The orbit over the image, its times counted from `epoch`."""
    window = annotation.first_line_time, annotation.last_line_time
    states: StateVectors = annotation.states
    if file is not None:
        states = read_orbit_file(file, annotation.mission, window, MARGIN)
    image = float(seconds(window[0], epoch)), float(seconds(window[1], epoch))
    return fit_orbit(seconds(states.time, epoch), states.position, states.velocity, image)


def _frame(annotation: Annotation, epoch: np.datetime64) -> Frame:
    """The frame of an SLC, or of a GRD (which has ground range polynomials)."""
    interval, convert = annotation.azimuth_time_interval, annotation.ground_range
    if annotation.product_type == "SLC":
        return SlantFrame(annotation.slant_range_time, annotation.range_sampling_rate, interval)
    if annotation.product_type != "GRD" or convert is None:
        raise RpcFormatError(f"{annotation.name}: {_kind(annotation)} has no geometry that is known here")
    return GroundFrame(
        interval,
        annotation.range_pixel_spacing,
        seconds(convert.time, epoch),
        convert.slant_origin,
        convert.ground_from_slant,
        float(convert.slant_from_ground[:, 1].mean()),
    )


def _alt_range(annotations: Sequence[Annotation]) -> tuple[float, float]:
    """Lowest and highest altitude [m]: those of the geolocation grids and the relief between its points."""
    alt = np.concatenate([a.grid.ground[:, 2] for a in annotations])
    return float(np.floor(alt.min()) - RELIEF[0]), float(np.ceil(alt.max()) + RELIEF[1])


def _warn_of_grid(annotation: Annotation, model: RangeDoppler) -> None:
    """Say so when the geolocation grid is not that of the orbit."""
    worst = np.abs(grid_residuals(annotation, model)).max(axis=0)
    if not (worst <= _GRID_TOLERANCE).all():
        warnings.warn(
            f"{annotation.name}: the geolocation grid does not belong to the orbit (off by {worst[0]:.1f} "
            f"samples, {worst[1]:.1f} lines); the model follows the orbit, the grid is not used",
            BarpcWarning,
            stacklevel=3,
        )


def _kind(annotation: Annotation) -> str:
    return f"a {annotation.mode} {annotation.product_type} of {annotation.swath}"


def open_product(
    path: str | Path,
    *,
    swath: str | None = None,
    polarisation: str | None = None,
    orbit: str | Path | None = None,
    burst: int | None = None,
    atmosphere: bool = False,
    bistatic: Bistatic | None = None,
) -> RangeDoppler:
    """The model of a Sentinel-1 product.

    Parameters
    ----------
    path : str or Path
        A ``.SAFE`` folder, its ``manifest.safe``, a ``.zip`` of it, or one annotation XML.
    swath : str, optional
        "iw1", "s3", ..., or "mosaic" for all of them; may be left out where there is one.
    polarisation : str, optional
        "vv", "vh", "hh" or "hv"; the geometry is the same, the first one is taken if left out.
    orbit : str or Path, optional
        Precise orbit file (``.EOF``).
    burst : int, optional
        One burst of the swath alone, from 0.
    atmosphere : bool
        Add the path delay of the atmosphere.
    bistatic : "annotated" or "full", optional
        Add a bistatic correction.

    Returns
    -------
    model : RangeDoppler
        With `size` [px] and `alt_range` [m].

    Raises
    ------
    InputError
        No such swath or polarisation, or a choice that does not go with the product; the message lists
        what there is.
    RpcFormatError
        Not a Sentinel-1 product.
    """
    try:
        return _open(Path(path), swath, polarisation, orbit, burst, atmosphere, bistatic)
    except RpcError as error:
        guilty = Path(path if orbit is None else orbit)
        if guilty.name in str(error):
            raise
        raise type(error)(f"{guilty}: {error}") from error


def _open(
    path: Path,
    swath: str | None,
    polarisation: str | None,
    orbit: str | Path | None,
    burst: int | None,
    atmosphere: bool,
    bistatic: Bistatic | None,
) -> RangeDoppler:
    found = _choose(path, polarisation)
    precise = None if orbit is None else Path(orbit)
    name = None if swath is None else swath.lower()
    if name == MOSAIC:
        if burst is not None:
            raise InputError(f"{path}: burst {burst} of the mosaic; choose one swath")
        swaths = [file.read() for file in found.values()]
        return mosaic(swaths, orbit=precise, atmosphere=atmosphere, bistatic=bistatic)
    if name is None and len(found) == 1:
        name = next(iter(found))
    if name not in found:
        wanted = "the product has several swaths" if name is None else f"no swath {name}"
        choices = [*sorted(found), MOSAIC] if len(found) > 1 else sorted(found)
        raise InputError(f"{path}: {wanted}; choose one of {', '.join(choices)}")
    annotation = found[name].read()
    return from_annotation(annotation, burst=burst, orbit=precise, atmosphere=atmosphere, bistatic=bistatic)


@dataclass(frozen=True, order=True)
class _File:
    """An annotation: its swath, its polarisation, and where it is."""

    swath: str
    polarisation: str
    path: Path
    member: str | None = None

    def read(self) -> Annotation:
        if self.member is None:
            return read_annotation(self.path)
        name = PurePosixPath(self.member).name
        try:
            with opened(self.path, PRODUCT) as archive, zipfile.ZipFile(archive).open(self.member) as file:
                data = file.read(MAX_BYTES + 1)
        except BarpcError:
            raise
        except Exception as error:
            raise RpcFormatError(f"{self.path}: {name} cannot be read from it ({error})") from error
        return read_annotation(data, name=name)


def _annotations(path: Path) -> list[_File]:
    """The annotations of a product, in order of swath and polarisation."""
    if path.name == "manifest.safe":
        path = path.parent
    if path.is_dir():
        names = [str(p.relative_to(path)) for p in path.glob("annotation/*.xml")]
        files = [_named(path / name, None) for name in names]
    elif read_head(path, PRODUCT, 4) in (b"PK\3\4", b"PK\5\6"):
        names = [name for name in _members(path) if PurePosixPath(name).parent.name == "annotation"]
        files = [_named(path, name) for name in names]
    else:
        annotation = read_annotation(path)
        files = [_File(annotation.swath.lower(), annotation.polarisation.lower(), path)]
    return sorted(file for file in files if file is not None)


def _members(path: Path) -> list[str]:
    try:
        with opened(path, PRODUCT) as file, zipfile.ZipFile(file) as archive:
            return archive.namelist()
    except BarpcError:
        raise
    except Exception as error:
        raise RpcFormatError(f"{path}: a zip file that cannot be read ({error})") from error


def _named(path: Path, member: str | None) -> _File | None:
    """The file, if its name is that of an annotation."""
    match = _NAME.fullmatch(path.name if member is None else PurePosixPath(member).name)
    return match and _File(match["swath"].lower(), match["pol"].lower(), path, member)


def _choose(path: Path, polarisation: str | None) -> dict[str, _File]:
    """Swath -> annotation, of one polarisation."""
    files = _annotations(path)
    if not files:
        raise RpcFormatError(f"{path}: no Sentinel-1 annotation (annotation/s1?-*.xml) in it")
    there = sorted({f.polarisation for f in files}, key=_POLARISATIONS.index)
    wanted = polarisation.lower() if polarisation else there[0]
    chosen = {f.swath: f for f in files if f.polarisation == wanted}
    if not chosen:
        raise InputError(f"{path}: no polarisation {wanted}; choose one of {', '.join(there)}")
    if len(chosen) < sum(f.polarisation == wanted for f in files):
        raise InputError(f"{path}: several images of one swath; give the annotation XML of one of them")
    return chosen
