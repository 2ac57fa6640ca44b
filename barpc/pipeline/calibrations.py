"""Calibration files, read and applied to a run of their sensor's images."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from barpc.ba import Adjustment
from barpc.ba.calibration import Line, SensorTies, contradicts, share_shown
from barpc.ba.interior import LINE_SPLINES, Calibration, CommonErrors
from barpc.base.errors import InputError, RpcError, plain
from barpc.base.geodesy import Array, ground_from_ecef
from barpc.base.identity import fingerprint
from barpc.base.remote import is_url
from barpc.base.safe_io import CALIBRATION, read_json
from barpc.report import Run
from barpc.report.records import Record, column
from barpc.rpcio.line import line_place
from barpc.scene import Camera, Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.image_corrections import Calibrated, ColumnSpline
from barpc.sensor.radar import Radar

logger = logging.getLogger(__name__)

CALIBRATION_SCHEMA = "barpc calibration 1"
SUFFIX = ".cal"
KNOWN_TO = 5.0  # px: a curve changes by less than 0.001 px over it
_ABSURD = 1e3  # px: no curve is larger
_MOST_EDGES = 64  # focal planes have up to some thirty detectors, and 40 steps are learnt
_ZERO_VARIANCE = 1e-4  # of the largest variance: what five digits a number leave of eigenvalues that are zero


def read_calibration(path: str | Path) -> Calibration:
    """Read a file of `calibrate`; InputError where it is none, or damaged."""
    found = read_json(path, CALIBRATION)
    schema = found.get("schema") if isinstance(found, dict) else None
    if schema != CALIBRATION_SCHEMA:
        raise InputError(f"{path}: schema {schema!r}, not a calibration that this release reads ({CALIBRATION_SCHEMA})")
    try:
        file = _CalibrationFile.read(found)
        starts = {int(columns): start for columns, start in (file.starts_px or {}).items()}
        return Calibration(file.sensor, *file.curve(), str(path), fingerprint(path).sha256, starts)
    except (ValueError, RpcError) as error:
        raise InputError(f"{path}: damaged ({plain(error)}); make it again (barpc calibrate)") from error


_PixelCount = Annotated[float, msgspec.Meta(gt=-_ABSURD, lt=_ABSURD)]


class _CalibrationFile(Record):
    """Fields of a calibration file, with their limits."""

    sensor: str = column("Sensor", min_length=1, max_length=200)
    columns: int = column("Columns of its line", ge=2, le=1 << 24)
    coefficients_px: tuple[tuple[_PixelCount, _PixelCount], ...] = column(
        "Spline coefficients", min_length=LINE_SPLINES, max_length=LINE_SPLINES
    )
    edges: tuple[float, ...] = column("Columns at which another detector begins", max_length=_MOST_EDGES)
    steps_px: tuple[tuple[_PixelCount, _PixelCount], ...] = column("What is added from each on", max_length=_MOST_EDGES)
    covariance_px2: tuple[float, ...] = column("Lower triangle of the covariance of the coefficients and steps")
    starts_px: Mapping[str, float] | None = column(
        "Columns of the line at which products of fewer columns begin, by their columns", default=None
    )

    def curve(self) -> tuple[ColumnSpline, Array]:
        """Return the correction and its covariance; an error where they do not go together."""
        edges = np.array(self.edges)
        if not ((edges > -0.5) & (edges < self.columns - 0.5)).all():
            raise ValueError(f"edges outside the line of {self.columns} columns")
        steps, coeffs = np.array(self.steps_px).reshape(-1, 2), np.array(self.coefficients_px)
        spline = ColumnSpline(self.columns, coeffs, edges, steps)
        size = 2 * (LINE_SPLINES + len(edges))
        if len(self.covariance_px2) != size * (size + 1) // 2:
            raise ValueError(f"{len(self.covariance_px2)} numbers of a covariance of {size} unknowns")
        covariance = np.zeros((size, size))
        covariance[np.tril_indices(size)] = self.covariance_px2
        covariance += np.tril(covariance, -1).T
        if not _may_be_covariance(covariance):
            raise ValueError("its covariance is none")
        return spline, covariance


def _may_be_covariance(matrix: Array) -> bool:
    """Return whether a matrix [px^2] is positive definite, but for constants and slopes, which have no variance."""
    variance = np.diag(matrix)
    if not (np.isfinite(matrix).all() and (variance > 0.0).all() and (variance < _ABSURD**2).all()):
        return False
    try:
        np.linalg.cholesky(matrix + _ZERO_VARIANCE * variance.max() * np.eye(len(matrix)))
    except np.linalg.LinAlgError:
        return False
    return True


def calibrations_of(
    paths: Sequence[str], views: Sequence[View], sources: Sequence[Camera], *, some: bool = False
) -> dict[str, Calibration]:
    """Return the calibration of each view that has one, by its name: given for its sensor, or beside its image.

    An image that states no sensor takes the one that is given alone. `some`: the views may be some of a run's only.

    Raises
    ------
    InputError
        A file that is none, for no image, or for images of another number of columns; two for one sensor.
    """
    given = [read_calibration(path) for path in paths]
    for i, one in enumerate(given):
        if one.sensor in {other.sensor for other in given[:i]}:
            raise InputError(f"{one.path}: another calibration of {one.sensor} is given; give one")
    by_sensor, found = {one.sensor: one for one in given}, dict[str, Calibration]()
    for view, source in zip(views, sources, strict=True):
        if (used := _own(view, source.sensor, by_sensor)) is None:
            continue
        found[view.name] = _on_its_columns(used, view, source)
    for one in () if some else given:
        if one.sha256 not in {used.sha256 for used in found.values()}:
            raise InputError(f"{one.path}: is of {one.sensor}, and no image given is")
    return found


def _on_its_columns(used: Calibration, view: View, source: Camera) -> Calibration:
    """Return a calibration for an image, with its place on the line; InputError without one."""
    width = used.spline.width
    try:
        place = line_place(source, view.size)
    except InputError as error:
        raise InputError(f"{used.path}: the place of {view.path} on its line of {width} columns is not known: {error}; "
                         "leave it out")  from error  # fmt: skip
    start = 0.0 if abs(place.columns - width) <= KNOWN_TO else used.starts.get(round(place.columns))
    if start is None:
        raise InputError(f"{used.path}: of a line of {width} columns, {view.path} is of one of {place.columns:.0f}: "
                         "leave it out, or calibrate with such images")  # fmt: skip
    return replace(used, spline=replace(used.spline, start=place.start + start))


def calibrated(sensors: Sequence[SensorModel], used: Sequence[Calibration | None]) -> list[SensorModel]:
    """Return cameras behind their calibrations, of those that have one."""
    return [s if one is None else Calibrated(s, one.spline) for s, one in zip(sensors, used, strict=True)]


def common_errors(run: Run) -> CommonErrors:
    """Return the errors of interior distortion that the views of a run have in common: by calibration, or unknown.

    Images without a calibration that state no sensor count as of one, as far as they have as many columns.
    """
    found = []
    for view, source in zip(run.views, run.sources, strict=True):
        used = run.calibrated.get(view.name)
        if used is None and not isinstance(view.sensor, Radar):
            used = Calibration.prior(source.sensor, view.size[0])
        found.append(used)
    return CommonErrors(tuple(found))


def _own(view: View, sensor: str, given: Mapping[str, Calibration]) -> Calibration | None:
    if not sensor:
        return next(iter(given.values())) if len(given) == 1 else None
    if sensor in given or is_url(view.path):
        return given.get(sensor)
    beside = Path(view.path).parent / f"{sensor}{SUFFIX}"
    if not beside.is_file():
        return None
    found = read_calibration(beside)
    if found.sensor != sensor:
        raise InputError(f"{beside}: is of {found.sensor}, not of {sensor} as its name says: rename it")
    return found


def refuse_strange(run: Run, adjustment: Adjustment) -> None:
    """Raise InputError where the tie points of a run contradict a calibration that it was adjusted with."""
    for used, ties in _ties_by_calibration(run, adjustment):
        shown, sigma = share_shown(ties, used.spline)
        logger.info("%s: tie points show %.2f +- %.2f of it", used.path, shown, sigma)
        if contradicts(shown, sigma):
            raise InputError(
                f"{used.path}: is not of these images: their tie points show {shown:.2f} +- {sigma:.2f} of its "
                "distortion (another sensor, or columns in the other order?); leave it out"
            )


def _ties_by_calibration(run: Run, adjustment: Adjustment) -> Iterator[tuple[Calibration, SensorTies]]:
    ground = ground_from_ecef(adjustment.points)
    for used in {one.sha256: one for one in run.calibrated.values()}.values():
        of = np.array([run.calibrated.get(view.name) is not None and run.calibrated[view.name].sha256 == used.sha256
                       for view in run.views])  # fmt: skip
        index, tracks = np.cumsum(of) - 1, run.tracks
        rows = of[tracks.view] & np.isfinite(ground[tracks.point]).all(axis=1)
        if np.bincount(tracks.point[rows], minlength=1).max() < 2:
            continue
        part = Tracks(index[tracks.view[rows]], tracks.point[rows], tracks.xy[rows], tracks.sigma[rows])
        chosen = np.flatnonzero(of)
        views, bases = [run.views[i] for i in chosen], [adjustment.bases[i] for i in chosen]
        start = np.array([run.calibrated[view.name].spline.start for view in views])
        line = Line(used.spline.width, start, np.zeros(len(views)))
        whole = replace(used, spline=replace(used.spline, start=0.0))
        yield whole, SensorTies.of(used.path, views, part, bases, ground, line)
