"""Calibration of a sensor from finished runs (`calibrate`)."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from barpc import __version__
from barpc.ba.calibration import Learnt, Line, SensorTies, learn
from barpc.base.atomic import refuse_existing, write_text
from barpc.base.declarations import with_values
from barpc.base.errors import InputError, listed
from barpc.base.geodesy import Array, metres_per_unit
from barpc.base.statistics import SURE
from barpc.base.verb_options import CalibrateOptions
from barpc.pipeline.calibrations import CALIBRATION_SCHEMA, KNOWN_TO
from barpc.pipeline.earlier import Earlier
from barpc.rpcio.line import LinePlace, line_place
from barpc.scene import BoolArray, Camera, IntArray, Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.image_corrections import Splined

if TYPE_CHECKING:
    from typing import Unpack

    from barpc.base.keywords import CalibrateKeywords, PathLike
    from barpc.base.tasks import Progress

logger = logging.getLogger(__name__)

_OTHERWISE_BINNED = 1.1  # times as many columns: products of one sensor are trimmed or padded by up to 5 %
_FEWEST_WHOLE = 3  # images of the longest line, by which shorter ones find their place
_PLACED_TO = 20.0  # px: a curve of 0.3 px over 3000 columns changes by 0.002 px over it
_FEWEST_RUNS = 3  # of two, held out in turn, each is judged by the other alone
_MUST_KNOW = 0.5  # of a curve's size: known no better than that, it is taken off by guess
_SAME_DIRECTION = 30.0  # deg: rows that run within so much of each other are of one direction


@dataclass(frozen=True, eq=False)
class _CalibratedRun:
    """A finished run's information on a sensor, the directions of its images' rows, clockwise from north [deg], the
    images and their places on the line; `seen`: those of them with tie points.
    """

    folder: Path
    root: str
    ties: SensorTies
    directions: Array
    paths: tuple[str, ...]
    on_line: _OnLine
    seen: IntArray


def calibrate(
    runs: Sequence[PathLike],
    out: PathLike,
    *,
    progress: Progress | None = None,
    **keywords: Unpack[CalibrateKeywords],
) -> dict[str, Any]:
    """Estimate the interior distortion of one sensor from finished runs, for `adjust` to apply.

    Parameters
    ----------
    runs : sequence of path, three finished runs or more, whose images still are where they were
    out : path, the file to write (JSON)
    progress : callable, optional, `progress(stage, done, total)`
    **keywords : fields of `CalibrateOptions`: sensor, overwrite

    Returns
    -------
    dict, the content of the file

    Raises
    ------
    InputError
        Runs that cannot be used or that determine no curve: it changes with time, directions do not suffice, or the
        residuals of runs left out do not improve. Nothing is written then.

    Examples
    --------
    >>> barpc.calibrate(["monday", "tuesday"], "sensor.cal")
    Traceback (most recent call last):
    barpc.base.errors.InputError: 2 runs given: at least 3 finished runs are needed, to hold some out
    """
    out, chosen = Path(out), with_values(CalibrateOptions(), keywords, "calibrate")
    refuse_existing(out, chosen.overwrite)
    if len(runs) < _FEWEST_RUNS:
        raise InputError(f"{len(runs)} runs given: at least {_FEWEST_RUNS} finished runs are needed, to hold some out")
    opened, tell = list[_RunImages](), progress or (lambda *_: None)
    for number, folder in enumerate(runs, start=1):
        opened.append(_images_of(Path(folder)))
        tell("open", number, len(runs))
    _refuse_shared_images(runs, opened)
    name = _one_sensor([[one.sensor for one in sources] for *_, sources in opened], chosen.sensor)
    found = list[_CalibratedRun]()
    for folder, run, on_line in zip(runs, opened, _on_one_line(runs, opened, name), strict=True):
        found.append(_finished_run(Path(folder), run, on_line))
        tell("read", len(found), len(opened))
    roots = _one_root_each(found)
    order = sorted(range(len(found)), key=lambda i: (found[i].ties.date, roots[i]))
    found, roots = [found[i] for i in order], [roots[i] for i in order]
    _refuse_unsure(name, learnt := learn([one.ties for one in found]), found)
    content = _content(name, learnt, found, roots, _starts(learnt, found))
    write_text(out, json.dumps(content, indent=1) + "\n", overwrite=chosen.overwrite)
    return content


_RunImages = tuple[Earlier, list[View], Sequence[SensorModel], Sequence[Camera]]


def _images_of(folder: Path) -> _RunImages:
    """Return a run, its images with their corrected cameras, and the cameras as delivered."""
    earlier = Earlier.open(folder)
    names = {view.name for view in earlier.run.summary.views}
    images = [image for image in earlier.images if image.name in names]
    if gone := [image for image in images if image.choices is None]:
        raise InputError(f"{gone[0].path or gone[0].name}: an image of {folder} whose camera came from no file")
    views, sensors, sources = earlier.corrected(images, earlier.prior)
    return earlier, views, sensors, sources


def _refuse_shared_images(runs: Sequence[PathLike], opened: Sequence[_RunImages]) -> None:
    """Raise InputError where two runs have an image in common, which would count twice."""
    seen: dict[str, PathLike] = {}
    for folder, (earlier, *_) in zip(runs, opened, strict=True):
        for image in earlier.images:
            if image.sha256 in seen and seen[image.sha256] != folder:
                raise InputError(f"{folder}: {image.path} is an image of {seen[image.sha256]}, too, and would count "
                                 "twice: give one of both runs")  # fmt: skip
            if image.sha256:
                seen[image.sha256] = folder


def _one_sensor(stated: Sequence[Sequence[str]], given: str | None) -> str:
    """Return the name of the one sensor; InputError where there are several or none."""
    names = sorted({name for run in stated for name in run})
    if given is not None:
        if given not in names and any(names):
            raise InputError(f"--sensor {given}: the images state {listed([name or 'none' for name in names])}")
        return given
    if len(names) != 1 or not names[0]:
        said = (
            "no image states its sensor" if names == [""] else f"the images are of {listed([n or '?' for n in names])}"
        )
        raise InputError(f"{said}: name the one that is meant (--sensor NAME)")
    return names[0]


@dataclass(frozen=True, eq=False)
class _OnLine:
    """Images of a run that are of the sensor (n,), where they lie on its line, and `columns` (n,) of their products."""

    index: list[int]
    line: Line
    columns: Array


def _on_one_line(runs: Sequence[PathLike], opened: Sequence[_RunImages], name: str) -> list[_OnLine]:
    """Return where the images of each run lie on the line of a sensor.

    The line is the longest of all. A product of fewer columns lies somewhere within it: in its middle, to a standard
    deviation of the columns it lacks over sqrt(12), until tie points tell. InputError where the place of an image is
    unknown, lines are binned otherwise, or too few images hold the others.
    """
    places: list[list[tuple[int, LinePlace]]] = []
    for folder, (_, views, _, sources) in zip(runs, opened, strict=True):
        of_run = list[tuple[int, LinePlace]]()
        for i, (view, source) in enumerate(zip(views, sources, strict=True)):
            if source.sensor in ("", name):
                try:
                    of_run.append((i, line_place(source, view.size)))
                except InputError as error:
                    raise InputError(f"{view.path}: its place on the line of {name} is not known: {error}") from error
        if len(of_run) < 2:
            raise InputError(f"{folder}: {len(of_run)} images of {name}: nothing is told")
        places.append(of_run)
    columns = [place.columns for of_run in places for _, place in of_run]
    width = round(max(columns))
    if width > _OTHERWISE_BINNED * min(columns):
        raise InputError(f"{name}: products of {min(columns):.0f} and of {width} columns: these are of other bands, "
                         "binned, or of another sensor: calibrate each by its own runs")  # fmt: skip
    exact = sum(width - one <= KNOWN_TO for one in columns)
    if exact < len(columns) and exact < _FEWEST_WHOLE:
        raise InputError(f"{name}: {exact} images of lines of {width} columns, the others of fewer: at least "
                         f"{_FEWEST_WHOLE} are needed, to find the place of the others by")  # fmt: skip
    return [_on_line(of_run, width) for of_run in places]


def _on_line(places: Sequence[tuple[int, LinePlace]], width: int) -> _OnLine:
    columns = np.array([place.columns for _, place in places])
    missing = width - columns
    start = np.array([place.start for _, place in places]) + missing / 2.0
    loose = np.where(missing <= KNOWN_TO, 0.0, missing / np.sqrt(12.0))
    return _OnLine([i for i, _ in places], Line(width, start, loose), columns)


def _finished_run(folder: Path, opened: _RunImages, on_line: _OnLine) -> _CalibratedRun:
    earlier, views, sensors, _ = opened
    tables, used = earlier.run.tables(), on_line.index
    number = {views[i].name: k for k, i in enumerate(used)}
    place = np.array([number.get(view.name, -1) for view in tables.summary.views])
    table = tables.observations
    keep: BoolArray = (place[table.view] >= 0) & np.isin(table.track, tables.tracks)
    if not keep.any():
        raise InputError(f"{folder}: {len(used)} images without a tie point in common: nothing is told")
    order = np.argsort(tables.tracks)
    point = order[np.searchsorted(tables.tracks[order], table.track[keep])]
    tracks = Tracks(place[table.view[keep]], point, table.xy[keep], np.ones(keep.sum()))
    chosen = [views[i] for i in used]
    behind = [one.sensor if isinstance(one, Splined) else one for one in (sensors[i] for i in used)]
    ties = SensorTies.of(str(folder), chosen, tracks, behind, tables.points[:, :3], on_line.line)
    directions = np.array([_row_direction(v, s) for v, s in zip(chosen, behind, strict=True)])
    seen = np.unique(tracks.view)
    return _CalibratedRun(
        folder, earlier.run.sealed.root, ties, directions, tuple(v.path for v in chosen), on_line, seen
    )


def _row_direction(view: View, sensor: SensorModel) -> float:
    """Return the directions of rows over the ground, clockwise from north [deg]."""
    middle = (view.size[0] - 1) / 2
    first, last = sensor.localize(np.array([[middle, 0.0], [middle, view.size[1] - 1.0]]), np.full(2, view.altitude))
    east, north = ((last - first) * metres_per_unit(first))[:2]
    return float(np.degrees(np.arctan2(east, north)) % 360.0)


def _one_root_each(found: Sequence[_CalibratedRun]) -> list[str]:
    roots = [one.root for one in found]
    twice = [one.folder for one, root in zip(found, roots, strict=True) if roots.count(root) > 1]
    if twice:
        raise InputError(f"{twice[0]}: is given twice")
    return roots


def _starts(learnt: Learnt, found: Sequence[_CalibratedRun]) -> dict[int, float]:
    """Return the column of the line at which shorter products begin, by their columns; InputError where one is not
    found, or two of one length disagree.
    """
    begun: dict[int, list[float]] = {}
    for one, shift, sigma in zip(found, learnt.shifts, learnt.shift_sigmas, strict=True):
        for k, v in enumerate(one.seen.tolist()):
            if not one.on_line.line.loose[v]:
                continue
            if sigma[k] > _PLACED_TO:
                raise InputError(f"{one.paths[v]}: its place on a line of {one.ties.width} columns is found to "
                                 f"{sigma[k]:.0f} px: leave {one.folder} out")  # fmt: skip
            columns = one.on_line.columns[v]
            begun.setdefault(round(columns), []).append((one.ties.width - columns) / 2.0 + shift[k])
    for columns, places in begun.items():
        if np.ptp(places) > 2.0 * _PLACED_TO:
            raise InputError(f"products of {columns} columns begin at columns {min(places):.0f} to {max(places):.0f} "
                             "of the line: their number of columns does not tell where")  # fmt: skip
    return {columns: float(np.mean(places)) for columns, places in sorted(begun.items())}


def _refuse_unsure(name: str, learnt: Learnt, found: Sequence[_CalibratedRun]) -> None:
    """Raise InputError where the curve is none of the sensor's in all of its images."""
    at, nats = learnt.change
    if nats > SURE:
        day = found[at].ties.date or f"of {found[at].folder}"
        raise InputError(f"{name}: its distortion changes, most probably before {day}: calibrate the runs before and "
                         "those from then on apart")  # fmt: skip
    size, sigma = (float(np.linalg.norm(learnt.curve.sizes(one))) for one in (learnt.unknowns, learnt.covariance))
    if sigma > _MUST_KNOW * size and sigma > learnt.noise_px / np.sqrt(len(found)):
        double = np.exp(2j * np.radians(np.concatenate([one.directions for one in found])))
        mean = float(np.degrees(np.angle(double.mean())) / 2 % 180.0)
        flat = abs(double.mean()) > np.cos(np.radians(_SAME_DIRECTION))
        more = (
            f"whose rows run across those of these, near {(mean + 90) % 180:.0f} degrees of north" if flat else "more"
        )
        raise InputError(f"{name}: a distortion of {size:.3f} px has a standard deviation of {sigma:.3f} px by these "
                         f"runs: runs {more} are needed")  # fmt: skip
    better = int((learnt.gain > 0).sum())
    if not (learnt.gain.sum() > 2.0 * SURE and 2 * better > len(found)):
        raise InputError(f"{name}: the distortion estimated from the others improves the residuals of only {better} of "
                         f"{len(found)} runs left out in turn: these images do not share it")  # fmt: skip


def _content(
    name: str, learnt: Learnt, found: Sequence[_CalibratedRun], roots: Sequence[str], starts: Mapping[int, float]
) -> dict[str, Any]:
    spline = learnt.spline
    rows = np.tril_indices(len(learnt.unknowns))
    dates = [one.ties.date for one in found if one.ties.date]
    return {
        "schema": CALIBRATION_SCHEMA,
        "barpc": __version__,
        "sensor": name,
        "columns": spline.width,
        "starts_px": {str(columns): round(start, 2) for columns, start in starts.items()},
        "coefficients_px": np.round(spline.coeffs, 7).tolist(),
        "edges": spline.edges.tolist(),
        "steps_px": np.round(spline.steps, 7).tolist(),
        "size_px": np.round(learnt.curve.sizes(learnt.unknowns), 5).tolist(),
        "sigma_px": np.round(learnt.curve.sizes(learnt.covariance), 5).tolist(),
        "held_out_noise": np.round(learnt.rms, 4).tolist(),
        "dates": [dates[0], dates[-1]] if dates else [],
        "runs": [
            {"name": one.folder.resolve().name, "root": root, "date": one.ties.date, "images": len(one.paths),
             "gain": round(float(gain), 1)}
            for one, root, gain in zip(found, roots, learnt.gain, strict=True)
        ],
        "covariance_px2": [float(f"{value:.5g}") for value in learnt.covariance[rows]],
    }  # fmt: skip
