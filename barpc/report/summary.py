"""The summary of a run: what summary.json holds. Here alone stands what a value is, its column, how it is measured.

A new value is a field with what is `said` of it and a line in the function that measures its record; named among the
columns of a table there, it stands in that, too.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version as package_version
from operator import attrgetter
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from barpc import __version__
from barpc.ba import Adjustment, check_residuals
from barpc.ba.gauge import MOTIONS, Mode
from barpc.fit import RpcFit
from barpc.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.report.records import Cell, Column, Number, Record, plain, said, value_of
from barpc.report.run import Run
from barpc.scene import IntArray
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected, Correction, ImageCorrected
from barpc.sensor.geometry import (
    Several,
    base_to_height,
    convergence_angle,
    epipolar_offset,
    ground_sample_distance,
    view_angles,
)
from barpc.sensor.splined import RowSpline, Splined

SCHEMA = 2  # Version of summary.json
MAX_PER_PAIR = 1000  # Matches of a pair that its epipolar offset is measured on, evenly taken
MAX_GCPS = 20  # GCPs that the terminal shows; summary and page have all
CELLS = 8  # Cells of an image from left to right and from top to bottom

STATUS_WORDS = {
    "adjusted": "adjusted",
    "consistent": "consistent",
    "tied": "tied",
    "weak": "weakly tied",
    "doubtful": "doubtful",
    "failed": "not adjusted",
}
"""Status of a view -> what people read, from good to bad."""

_MODE_WORDS = {
    "east": "the whole scene may lie {0} farther east or west",
    "north": "the whole scene may lie {0} farther north or south",
    "up": "all heights may be {0} too high or too low",
    "tilt east": "the scene may be tilted: {0} up or down at its eastern and western edges",
    "tilt north": "the scene may be tilted: {0} up or down at its northern and southern edges",
    "turn": "the scene may be turned about the vertical: {0} at its edge",
    "scale": "the scene may be too large or too small: {0} at its edge",
}

_DATUM_HEADS = {
    "cameras": "cameras as delivered",
    "earlier_run": "earlier run",
    "fixed_views": "fixed views",
    "gcps": "GCPs",
    "heights": "heights",
    "reference": "reference",
}
GCPS = "Ground control: what all the others say of a point minus its given place"
DATUM = "What holds the scene: how well its motions are known, and what share of that comes from where"

Count = Annotated[int, {"minimum": 0}]
Side = Annotated[int, {"minimum": 1}]
Share = Annotated[float, {"minimum": 0, "maximum": 1}]
Pixel = tuple[Number, Number]
Vector = tuple[Number, Number, Number]
_ROWS = 400  # of an image, over which a spline is averaged
_ABOVE = "m above the ellipsoid"
_Plain = float | str | bool | None
_Value = _Plain | tuple[_Plain, ...] | tuple[tuple[_Plain, ...], ...]


# --- what it holds ----------------------------------------------------------------------------------------


class SourceEntry(Record):
    """Where a camera came from."""

    format: str = said("Syntax it was read from", head="RPC read from")
    path: str = said("File that holds it")
    notes: tuple[str, ...] = said("What the user should know")


class CorrectionEntry(Record):
    """How a camera was corrected: in space, or by a shift and slope in the image (no `center_shift_px` then)."""

    model: str = said("Unknowns of the adjustment")
    unknowns: tuple[float, ...] = said("In metres (rotation: angle x distance), or px in the image")
    sigma: tuple[float, ...] = said("Their posterior standard deviations, in the same units")
    center_shift_px: Pixel | None = said(
        "Move of the ground point in the middle, col, row", "px", "shift col, row", "+.2f", adjusted=True
    )
    center_sigma_px: Pixel | None = said(
        "Its posterior standard deviation, with the scene's own uncertain place", "px"
    )
    shift_px: Pixel | None = said("Models in the image: shift col, row", "px", default=None)
    slope: tuple[Pixel, ...] | None = said("Models in the image: by (col, row)", "px/px", default=None)
    rotation_urad: Vector | None = said("Rotation vector R, ECEF axes", "urad", default=None)
    angle_urad: Number = said("Its length", "urad", "rotation", ".2f", default=None)
    translation_m: Vector | None = said("Translation T, ECEF", "m", default=None)
    translation_norm_m: Number = said("Its length", "m", "translation", ".2f", default=None)
    drift_urad: tuple[Vector, ...] | None = said("Drift, for each power of the row", "urad", default=None)
    jitter_px: Number = said("RMS over the rows of the spline that follows in the image", "px", default=None)
    jitter_rows: Number = said("Rows between its knots", "px", default=None)
    detector_px: Number = said("RMS of the steps between detectors", "px", default=None)
    detectors: tuple[float, ...] | None = said("Columns where another detector begins", "px", default=None)


class CenterEntry(Record):
    """Where a camera stands."""

    ecef_m: Vector = said("Place, ECEF", "m")
    altitude_m: Number = said("Above the ellipsoid", "m")
    method: str = said("line, or nominal where that was not plausible", head="found by")


class FitEntry(Record):
    """The certificate of a refitted RPC: against P_BA, on points that the fit has not seen."""

    rmse_px: Pixel = said("Error col, row on check points", "px", "RMSE col, row", ".1e")
    max_px: Pixel = said("Largest error col, row on check points", "px")
    min_denominator: Number = said(
        "Over the box and 25 % around it, relative to its centre", "", "smallest denominator", ".3f"
    )
    roundtrip_px: Number = said(
        "Largest move by projection and back; null where it fails", "px", "round trip", ".1e"
    )
    coverage: Number = said("Share of the image that the fit's points cover")
    method: str = said("Solver", head="solver")
    num_check_points: Count = said("Check points", head="check points")
    localisation_m: Number = said(
        "Largest distance on the ground of the localisation RPC from P_BA", "m", default=None
    )


def largest(values: Sequence[float | None] | None) -> float | None:
    """The largest number; None where one is missing, which may be larger."""
    return None if not values or None in values else max(value for value in values if value is not None)


def listed(names: Sequence[str], most: int = 10) -> str:
    """Names in a sentence."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def median(values: Iterable[float | None]) -> float:
    """The median of the finite numbers; NaN without any."""
    found = np.array(list(values), dtype=np.float64)
    found = found[np.isfinite(found)]
    return float(np.median(found)) if len(found) else float("nan")


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share


def _percent_of(name: str) -> Callable[[Any], float | None]:
    return lambda record: _percent(getattr(record, name))


def _verdict(view: ViewEntry) -> Cell:
    return Cell(STATUS_WORDS[view.status], list(STATUS_WORDS).index(view.status), f"status {view.status}")


def _rejected(view: ViewEntry) -> float | None:
    every = view.num_observations + view.num_rejected
    return _percent(view.num_rejected / every) if every else None


def _kilometres(view: ViewEntry) -> float | None:
    altitude = value_of(view, "camera_center.altitude_m")
    return None if altitude is None else float(altitude) / 1e3


def _moves(view: ViewEntry) -> list[Cell]:
    shift, sigma = (value_of(view, f"correction.center_{what}_px") for what in ("shift", "sigma"))
    return [Cell(f"{value:+.3f} ± {error:.2f}", value) for value, error in zip(shift, sigma, strict=True)]


class ViewEntry(Record):
    """One image."""

    OWN: ClassVar = {
        "verdict": Column("verdict", _verdict),
        "rejected": Column("rejected [%]", _rejected, ".1f"),
        "covered": Column("covered [%]", lambda view: _percent(view.tie_coverage), ".0f"),
        "moves": Column(("col [px]", "row [px]"), _moves, ".3f"),
        "kilometres": Column("camera centre [km]", _kilometres, ".0f"),
        "largest": Column("largest [px]", lambda view: largest(value_of(view, "fit.max_px")), ".1e"),
        "about": Column(
            "RPC fit [px]", lambda view: largest(value_of(view, "fit.max_px")), ".0e", adjusted=True
        ),
        "fitted": Column("covered [%]", lambda view: _percent(value_of(view, "fit.coverage")), ".0f"),
    }
    PAGE: ClassVar = (
        "name verdict num_observations rejected covered rmse_before rmse_after held_out_px correction.center_shift_px "
        "gsd_m incidence_deg rpc_source.format"
    )
    TERMINAL: ClassVar = (
        "name verdict num_observations rmse_before rmse_after correction.center_shift_px about"
    )
    CORRECTIONS: ClassVar = (
        "name moves correction.angle_urad correction.translation_norm_m kilometres camera_center.method"
    )
    FITS: ClassVar = (
        "name fit.rmse_px largest fit.min_denominator fit.roundtrip_px fitted fit.num_check_points fit.method"
    )
    FOOTPRINT: ClassVar = "name path status num_observations rmse_before rmse_after gsd_m"

    name: str = said("Unique in the run", head="image", minLength=1)
    path: str = said("The image; empty for a view without pixels")
    size: tuple[Side, Side] = said("Width, height", "px")
    alt_range_m: tuple[float, float] = said("Altitudes that the camera is used for", _ABOVE)
    rpc_source: SourceEntry | None = said("Where the camera came from; null: not from a file")
    gsd_m: Number = said("Ground sampling distance in the middle of the image", "m", "GSD", ".2f")
    incidence_deg: Number = said(
        "Angle between the vertical and the direction to the sensor", "deg", "incidence", ".1f"
    )
    azimuth_deg: Number = said("Direction to the sensor, clockwise from north", "deg")
    num_observations: Count = said("Tie-point observations that count", head="tie points")
    num_rejected: Count = said("Observations that the adjustment cut as wrong")
    num_gcps: Count = said("Observations of ground control points")
    tie_coverage: Share = said("Share of the cells of an 8 x 8 grid that hold a tie point")
    rmse_before: Number = said("RMS reprojection error through the delivered cameras", "px", "before", ".3f")
    rmse_after: Number = said(
        "The same through the new cameras; null for a check", "px", "after", ".3f", adjusted=True
    )
    smooth_px: Number = said("RMS of what is smooth in the residuals left, less noise", "px")
    prior_scale: Number = said("By how much the camera's stated standard deviations were widened")
    correction: CorrectionEntry | None = said("The correction; null for a check")
    camera_center: CenterEntry | None = said("Centre about which the camera was turned")
    fit: FitEntry | None = said("Certificate of the refitted RPC; null where none was fitted")
    outputs: Mapping[str, Mapping[str, float | str | None]] = said(
        "File -> consumer that reopened it -> difference to P_BA in px, or why it does not read it",
        propertyNames={"pattern": "^[^/]+$"},
    )
    status: Literal["adjusted", "consistent", "tied", "weak", "doubtful", "failed"] = said(
        "Verdict on the image"
    )
    advice: str = said("What to do; empty when all is well")
    held_out_px: Number = said(
        "RMS reprojection error of tie points that took no part in the adjustment, by their median",
        "px",
        "not used",
        ".3f",
        default=None,
    )
    date: str | None = said("Day it was taken, where its metadata say so", default=None)


class OffsetEntry(Record):
    """Distance of a pair's matches from their epipolar lines."""

    median: float = said("Median signed distance from the epipolar line", "px")
    spread: float = said("1.4826 times the median absolute deviation", "px")
    rms: float = said("Root mean square", "px")
    count: Count = said("Matches measured: at most 1000, evenly taken")


def _offset_cell(offset: OffsetEntry | None) -> Cell | None:
    if offset is None:
        return None
    return Cell(f"{offset.median:+.3f} ± {offset.spread:.3f}", float(f"{abs(offset.median):.6g}"))


class PairEntry(Record):
    """Two images with tie points in common."""

    OWN: ClassVar = {
        "pair": Column("pair", lambda pair: f"{pair.a} - {pair.b}"),
        "before": Column("before [px]", lambda pair: _offset_cell(pair.epipolar_before), ".3f"),
        "after": Column("after [px]", lambda pair: _offset_cell(pair.epipolar_after), ".3f", adjusted=True),
    }
    PAGE: ClassVar = (
        "pair num_matches tied_by decoy_share noise_px convergence_deg base_to_height height_m_per_px "
        "before after"
    )
    TERMINAL: ClassVar = "pair num_matches convergence_deg base_to_height before after"
    CSV: ClassVar = (
        "a b num_matches convergence_deg base_to_height height_m_per_px epipolar_before.median epipolar_before.spread "
        "epipolar_before.rms epipolar_after.median epipolar_after.spread epipolar_after.rms "
        "tied_by decoy_share noise_px"
    )

    a: str = said("First view")
    b: str = said("Second view")
    num_matches: Count = said("Tie points that both see", head="matches")
    convergence_deg: Number = said("Angle between the lines of sight", "deg", "angle", ".1f")
    base_to_height: Number = said("B/H along the lines of sight", head="B/H", form=".2f")
    height_m_per_px: Number = said(
        "Height whose parallax is a pixel; null for parallel rays", "m", "height per px", ".3g"
    )
    epipolar_before: OffsetEntry | None = said("Through the delivered cameras")
    epipolar_after: OffsetEntry | None = said("Through the new cameras")
    matching: Mapping[str, Any] | None = said(
        "What became of it in matching; null for tie points taken as given (matches_only)"
    )
    tied_by: str | None = said(
        "Matcher that tied it, and whether with loosened thresholds; null as there",
        head="tied by",
        default=None,
    )
    decoy_share: Number = said(
        "Share of its matches that bands which hold no true one say is false",
        head="decoys",
        form=".3f",
        default=None,
    )
    noise_px: Number = said(
        "Robust spread of its matches across the epipolar lines, before registration",
        "px",
        "noise",
        ".2f",
        default=None,
    )
    chosen_by: str | None = said(
        "Why it was tried: overlap and angle, same date, quick score, connects all, second path, listed, given",
        default=None,
    )

    @property
    def offset_rms(self) -> tuple[float | None, float | None]:
        """RMS of the offsets before and after."""
        before, after = self.epipolar_before, self.epipolar_after
        return None if before is None else before.rms, None if after is None else after.rms


class LeftOutEntry(Record):
    """A file that was left out."""

    path: str = said("File")
    reason: str = said("Why")


class TracksEntry(Record):
    """The tie points."""

    num_tracks: Count = said("Tie points")
    num_observations: Count = said("Their observations")
    by_length: Mapping[str, int] = said("Number of views -> tie points seen in so many")


class TablesEntry(Record):
    """How much of the tie points the tables hold."""

    num_usable_tracks: Count = said("Tie points with a ground position")
    num_written_tracks: Count = said("Of these, in the tables (at most 200,000, evenly taken)")
    complete: bool = said("Whether that is all")


class ModeEntry(Record):
    """A motion of the scene that the images cannot tell."""

    sigma_m: Number = said("Posterior standard deviation", "m")
    meaning: str = said("Its largest motion", enum=list(_MODE_WORDS))
    motion_m: tuple[Number, ...] = said(
        "East, north, up; tilts, turn, scale at the edge", "m", minItems=7, maxItems=7
    )
    words: str = said("The same in words", minLength=1)


class DatumEntry(Record):
    """What holds a motion of the scene: shares of what is known of it. Tie points have none."""

    OWN: ClassVar = {"part": Column("motion", lambda one: one.part)} | {
        name: Column(f"{head} [%]", _percent_of(name), ".0f") for name, head in _DATUM_HEADS.items()
    }

    part: str = said("Motion of the scene", enum=list(_MODE_WORDS))
    sigma_m: Number = said(
        "Posterior standard deviation; at the edge for tilts, turn and scale", "m", "known to", ".2f"
    )
    cameras: Number = said("Accuracies of the cameras as delivered")
    earlier_run: Number = said("The earlier run")
    fixed_views: Number = said("Views that are fixed")
    gcps: Number = said("Ground control points")
    heights: Number = said("The DEM, or altitudes assumed for tie points seen under too small an angle")
    reference: Number = said("A reference orthoimage", default=None)

    @classmethod
    def columns(cls, entries: Sequence[DatumEntry]) -> str:
        """The columns of a table: sources that tell nothing of any motion are left out."""
        told = [name for name in _DATUM_HEADS if any((getattr(one, name) or 0.0) >= 0.005 for one in entries)]
        return " ".join(["part", "sigma_m", *told])


class DemEntry(Record):
    """What the DEM did, and how the tie points lie to it."""

    num_held: Count = said("Tie points that it holds")
    num_known: Count = said("Tie points where it has a height")
    num_tracks: Count = said("Tie points that count")
    offset_m: Number = said("Median of the tie points' altitudes minus the DEM's", "m")
    spread_m: Number = said("1.4826 times the median absolute deviation of these", "m")


class SceneEntry(Record):
    """The block as a whole."""

    shift_enu_m: Vector = said("Mean move of the tie points, east, north, up", "m")
    sigma_enu_m: Vector = said("Posterior standard deviation of the scene's place", "m")
    radius_m: Number = said(
        "RMS distance of the tie points from their middle: the edge of tilts, turn and scale", "m"
    )
    weakest_modes: tuple[ModeEntry, ...] = said("What the images cannot tell, the weakest first")
    noise: Number = said("Observed over stated standard deviation of the observations")
    drift_degree: Count = said("Degree of the rotation in the row")
    drift_sigma_m: tuple[float, ...] = said(
        "Standard deviation of the drift at the first and last row, by degree", "m"
    )
    prior_ratio: Number = said("Squared corrections over stated variances and degrees of freedom")
    cost_history: tuple[Number, ...] = said("Sum of squared whitened residuals, by linearisation")
    num_held_in_height: Count = said("Tie points seen under too small an angle, held in height")
    gcp_residuals_enu_m: tuple[Vector, ...] = said("Adjusted GCPs minus their given place", "m")
    solver: str = said("What the solver did")
    datum: tuple[DatumEntry, ...] = said("What holds the scene", default=())
    dem: DemEntry | None = said("What the DEM did; null without one", default=None)
    gcp_scatter: Number = said(
        "RMS residual of the GCPs used over what their accuracies let expect", default=None
    )
    num_held_out: Count = said("Observations that took no part, to be measured on", default=0)
    model: str = said("Unknowns of each view that were solved for", default="")
    in_space_px: Number = said(
        "Where an affine in the image was chosen: what a rotation and translation leave of the same tie points",
        "px",
        default=None,
    )


class KnownPoint(Record):
    """A point whose place is given."""

    name: str = said("Name")
    lon: float = said("Longitude", "deg", minimum=-540, maximum=540)
    lat: float = said("Latitude", "deg", minimum=-90, maximum=90)
    alt_m: float = said("Altitude", _ABOVE)


_MISS = "Found minus given place, east, north, up; null where fewer than two views see it"


class GcpEntry(KnownPoint):
    """A ground control point."""

    OWN: ClassVar = {"GCP": Column("GCP", lambda point: point.name)}
    PAGE: ClassVar = "GCP status residual_enu_m residual_px w sigma_m"
    TERMINAL: ClassVar = "GCP status residual_enu_m residual_px w"

    sigma_m: tuple[float, float, float] = said("Stated", "m", "sigma east, north, up", ".2g")
    residual_enu_m: Vector = said(
        "What all the others say of it minus its given place, east, north, up; null where nothing tells",
        "m",
        ("east", "north", "up"),
        "+.3f",
    )
    used: bool = said("Whether it holds the block", default=True)
    status: Literal["used", "contradicts", "rejected", "not seen"] = said(
        "used; contradicts: used, and off by more than 4 standard deviations; rejected: not used for that",
        head="verdict",
        default="used",
    )
    images: tuple[str, ...] = said("Views that show it", default=())
    w: Number = said(
        "Largest component of the residual over its standard deviation", "", "w", ".1f", default=None
    )
    redundancy: Number = said("How far the others can tell, 0 to 1", default=None)
    residual_px: Number = said(
        "The residual in the images that show it, RMS", "px", "in images", ".2f", default=None
    )

    @classmethod
    def worst(cls, points: Sequence[GcpEntry]) -> list[GcpEntry]:
        """At most `MAX_GCPS` points, in their order: those that are not used, and of the others the largest w."""
        order = sorted(points, key=lambda point: (point.used, -(point.w or 0.0)))[:MAX_GCPS]
        return [point for point in points if any(point is one for one in order)]


class ReferenceViewEntry(Record):
    """What a reference says of an image."""

    PAGE: ClassVar = "name peak offset_en_m num_tried num_passed num_points scatter_m"

    name: str = said("View", head="image")
    peak: Number = said(
        "By how many standard deviations the vote for one shift stands out; below 6.5 it is none",
        "",
        "peak",
        ".1f",
    )
    offset_en_m: Pixel | None = said(
        "How far off the camera as delivered shows everything, east, north",
        "m",
        ("off east", "north"),
        "+.2f",
    )
    num_tried: Count = said("Points looked for", head="points tried")
    num_passed: Count = said("That beat their decoy and came back", head="found")
    num_points: Count = said("That agree with each other and held the block", head="used")
    scatter_m: Number = said("Standard deviation of those across the line of sight", "m", "scatter", ".2f")


class ReferenceEntry(Record):
    """A reference orthoimage."""

    used: bool = said("Whether it holds the block")
    step_m: Number = said("Resolution at which it was matched", "m")
    sigma_m: Number = said("Standard deviation of its own place, along an axis", "m")
    num_points: Count = said("Points on the ground that hold the block")
    views: tuple[ReferenceViewEntry, ...] = said("What it says of each image")


class SeenEntry(Record):
    """Where a check point is seen."""

    view: str = said("Name")
    residual_px: Pixel = said("Projected minus observed col, row", "px")


def _rms(point: CheckPointEntry) -> float | None:
    return float(np.sqrt(np.mean(np.square(point.seen).sum(axis=1)))) if point.seen else None


class CheckPointEntry(KnownPoint):
    """A known point that stayed out of the adjustment."""

    OWN: ClassVar = {
        "point": Column("check point", lambda point: point.name),
        "images": Column("images", lambda point: len(point.seen)),
        "rms": Column("in the images [px]", _rms, ".3f"),
    }
    PAGE: ClassVar = "point images rms residual_enu_m"

    residual_enu_m: Vector = said(_MISS, "m", ("east", "north", "up"), "+.3f")
    observations: tuple[SeenEntry, ...] = said("Where it is seen")

    @property
    def seen(self) -> list[Any]:
        """Residuals in the images that see it."""
        return [seen.residual_px for seen in self.observations if None not in seen.residual_px]


class StageEntry(Record):
    """A stage of the run."""

    MORE: ClassVar = _Plain
    PAGE: ClassVar = "stage seconds cpu_seconds peak_memory_mb"

    stage: str = said("Name", head="stage")
    seconds: float = said("Wall time in seconds", head="seconds", form=".2f")
    cpu_seconds: float = said("CPU time in seconds", head="CPU seconds", form=".2f")
    peak_memory_mb: float = said("Peak memory so far", "MB", "peak memory", ".0f")


class Summary(Record):
    """summary.json of a run."""

    schema: int = said("Version of this description", const=SCHEMA)
    barpc: str = said("Release")
    kind: Literal["adjust", "check", "match"] = said("Whether cameras were adjusted, looked at, or only tied")
    status: Literal["good", "look", "bad"] = said("The verdict on the whole")
    headline: str = said("The verdict in a sentence")
    verdict: tuple[str, ...] = said("What was reached, what is unknown, what needs a look")
    reasons: tuple[str, ...] = said("Those of its sentences that say why it is not good")
    passed: bool = said("Whether it is good: no image, point or file has a reservation (exit code 0, else 3)")
    out_dir: str = said("Where the results are")
    altitude_m: Number = said("Median altitude of the tie points", _ABOVE)
    views: tuple[ViewEntry, ...] = said("The images", minItems=1)
    pairs: tuple[PairEntry, ...] = said("Pairs with tie points in common")
    left_out: tuple[LeftOutEntry, ...] = said("Files that were left out")
    tracks: TracksEntry = said("Tie points")
    tables: TablesEntry = said("What the tables hold")
    scene: SceneEntry | None = said("The block as a whole; null for a check")
    gcps: tuple[GcpEntry, ...] = said("Ground control")
    check_points: tuple[CheckPointEntry, ...] = said("Points that stayed out of the adjustment")
    stages: tuple[StageEntry, ...] = said("Stages of the run")
    options: Mapping[str, _Value | Mapping[str, _Value | Mapping[str, _Value]]] | None = said(
        "Options of the run"
    )
    versions: Mapping[str, str] = said("Versions of Python and packages")
    reference: ReferenceEntry | None = said("A reference orthoimage, where one was given", default=None)

    @property
    def adjusted(self) -> bool:
        """Whether cameras were adjusted."""
        return self.kind == "adjust"


def published_schema() -> dict[str, Any]:
    """The JSON schema of summary.json."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "summary.json of a barpc run",
        "description": "Pixel (0, 0) is the centre of the first one. A number that is not finite is null.",
        **Summary.json_schema(),
    }


# --- how it is measured -----------------------------------------------------------------------------------

_SOURCE = attrgetter("format", "path", "notes")
_CENTER = attrgetter("ecef", "altitude", "method")
_DEM = attrgetter("held", "known", "total", "offset", "spread")
_FIT = attrgetter("rmse_ckp", "max_ckp", "min_denominator", "roundtrip", "coverage", "method", "num_ckp")


def _fit_entry(fit: RpcFit) -> FitEntry:
    place = fit.localisation
    return replace(FitEntry(*_FIT(fit)), localisation_m=None if place is None else place.max_m)


def measure(run: Run) -> Summary:
    """The summary of a run, without the verdict on it. Numbers may be NaN here."""
    usable, written = int(np.isfinite(run.ground).all(axis=1).sum()), len(run.written_tracks)
    lengths = np.bincount(np.bincount(run.tracks.point))
    names = ("numpy", "scipy", "opencv-python-headless", "rasterio", "shapely")
    return Summary(
        schema=SCHEMA,
        barpc=__version__,
        kind=run.kind,
        status="good",
        headline="",
        verdict=(),
        reasons=(),
        passed=True,
        out_dir=run.out_dir,
        altitude_m=run.altitude,
        views=_views(run),
        pairs=_pairs(run),
        left_out=tuple(LeftOutEntry(path, reason) for path, reason in run.left_out),
        tracks=TracksEntry(
            num_tracks=run.tracks.num_points,
            num_observations=len(run.tracks),
            by_length={str(n): int(count) for n, count in enumerate(lengths) if n and count},
        ),
        tables=TablesEntry(usable, written, complete=written == usable),
        scene=None if run.adjustment is None else _scene(run.adjustment),
        gcps=_gcps(run),
        check_points=_check_points(run),
        reference=_reference(run),
        stages=tuple(StageEntry.read(stage) for stage in run.stages),
        options=plain(run.options),
        versions={"python": platform.python_version(), **{name: package_version(name) for name in names}},
    )


def _views(run: Run) -> tuple[ViewEntry, ...]:
    num, tracks, keep, adjustment = len(run.views), run.tracks, run.keep, run.adjustment
    after = run.ties_after
    first = rmse_by_view(run.ties_before.residuals[keep], tracks.view[keep], num)
    last = None if after is None else rmse_by_view(after.residuals[keep], tracks.view[keep], num)
    count, lost = (np.bincount(tracks.view[rows], minlength=num) for rows in (keep, ~(keep | run.held_out)))
    gcps = np.zeros(num, np.int64) if run.gcps is None else np.bincount(run.gcps.view, minlength=num)
    covered, middle = _coverage(run), _middles(run)
    incidence, azimuth = view_angles(Several(run.before, np.arange(num)), middle)
    pixel = ground_sample_distance(Several(run.before, np.arange(num)), middle)[1]
    entries = []
    for i, view in enumerate(run.views):
        entry = ViewEntry(
            name=view.name,
            path=view.path,
            size=view.size,
            alt_range_m=view.alt_range,
            rpc_source=SourceEntry(*_SOURCE(run.sources[i])) if run.sources else None,
            gsd_m=float(pixel[i]),
            incidence_deg=float(incidence[i]),
            azimuth_deg=float(azimuth[i]),
            num_observations=int(count[i]),
            num_rejected=int(lost[i]),
            num_gcps=int(gcps[i]),
            tie_coverage=float(covered[i]),
            rmse_before=first[i],
            rmse_after=None if last is None else last[i],
            held_out_px=None if adjustment is None else adjustment.held_out_rms[i],
            smooth_px=None if adjustment is None else adjustment.smooth.rms[i],
            prior_scale=None if adjustment is None else adjustment.prior.scale[i],
            correction=None if adjustment is None else _correction(adjustment, i, middle[i]),
            camera_center=CenterEntry(*_CENTER(run.centers[i])) if run.centers else None,
            fit=_fit_entry(run.fits[i]) if run.fits else None,
            outputs=dict(run.written[i]) if run.written else {},
            date=view.date or None,
            status="adjusted",
            advice="",
        )
        entries.append(entry)
    return tuple(entries)


def _middles(run: Run) -> Array:
    """The ground (N, 3) in the middle of each image, at the altitude of the scene."""
    at = (np.array([view.size for view in run.views]) - 1) / 2
    return Several(run.before, np.arange(len(at))).localize(at, np.full(len(at), run.altitude))


def _coverage(run: Run) -> Array:
    """Share (N,) of the cells of each image that hold a tie point."""
    view, size = run.tracks.view[run.keep], np.array([view.size for view in run.views])
    cells = cell_numbers(run.tracks.xy[run.keep], size[view]) + view * CELLS**2
    return np.bincount(np.unique(cells) // CELLS**2, minlength=len(size)) / CELLS**2


def rmse_by_view(residuals: Array, view: IntArray, num_views: int) -> Array:
    """RMS of each view (N,) [px]: sqrt(mean(dcol^2 + drow^2)) over those residuals (K, 2) that are not NaN."""
    use = np.isfinite(residuals).all(axis=1)
    squares = np.bincount(view[use], (residuals[use] ** 2).sum(axis=1), minlength=num_views)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(squares / np.bincount(view[use], minlength=num_views)))


def cell_numbers(xy: Array, size: Sequence[int] | IntArray) -> IntArray:
    """Which of the `CELLS` x `CELLS` cells of an image, or each of its own (n, 2), points (n, 2) [px] lie in."""
    col, row = ((xy + 0.5) / np.asarray(size) * CELLS).astype(np.int64).clip(0, CELLS - 1).T
    number: IntArray = row * CELLS + col
    return number


def _pairs(run: Run) -> tuple[PairEntry, ...]:
    reports = {report.names: report for report in run.matched}
    geometry, before = _pair_geometry(run), _pair_offsets(run, run.before, run.altitudes_before)
    after: list[OffsetEntry | None] = [None] * len(before)
    if run.after is not None:
        after = _pair_offsets(run, run.after, run.ground[:, 2])
    entries = []
    for ties, (angle, base, height), first, last in zip(run.pairs, geometry, before, after, strict=True):
        names = (run.views[ties.views[0]].name, run.views[ties.views[1]].name)
        report = reports.get(names)
        entry = PairEntry(*names, len(ties.a), angle, base, height, first, last, None)
        if report is not None:
            tied = report.matcher + ", loosened" * report.loosened
            share, noise = report.control_share, report.spread
            entry = replace(entry, matching=plain(report), tied_by=tied, decoy_share=share, noise_px=noise)
            entry = replace(entry, chosen_by=report.reason)
        entries.append(entry)
    return tuple(entries)


def _pair_geometry(run: Run) -> list[list[float]]:
    """Medians over about a hundred of each pair's points: convergence angle [deg], B/H, height of a pixel [m]."""
    picks = [slice(None, None, max(1, len(ties.a) // 100)) for ties in run.pairs]
    a, b, pair = _rows(run, picks)
    seen = np.isfinite(run.ground[run.tracks.point[a]]).all(axis=1)
    a, b, pair = a[seen], b[seen], pair[seen]
    at = run.ground[run.tracks.point[a]]
    first, second = (Several(run.before, run.tracks.view[rows]) for rows in (a, b))
    base = base_to_height(first, second, at)
    finer = np.minimum(ground_sample_distance(first, at)[1], ground_sample_distance(second, at)[1])
    with np.errstate(divide="ignore"):
        values = (convergence_angle(first, second, at), base, finer / base)
    found = np.array([medians(value, pair, len(run.pairs)) for value in values]).T
    return [list(row) for row in found.tolist()]


def _pair_offsets(run: Run, sensors: Sequence[SensorModel], alt: Array) -> list[OffsetEntry | None]:
    """The epipolar offsets of each pair's matches.

    The tracks' altitudes (P,) [m] through these cameras are so near to where a pair's own rays pass each other that
    two steps from there arrive.
    """
    counts = [len(ties.a) for ties in run.pairs]
    picks = [np.linspace(0, n - 1, min(n, MAX_PER_PAIR)).astype(np.int64) for n in counts]
    a, b, pair = _rows(run, picks)
    height = alt[run.tracks.point[a]]
    seen = np.isfinite(height)
    a, b, pair = a[seen], b[seen], pair[seen]
    first, second = (Several(sensors, run.tracks.view[rows]) for rows in (a, b))
    offset, _ = epipolar_offset(first, second, run.tracks.xy[a], run.tracks.xy[b], height[seen], steps=2)
    known = np.isfinite(offset)
    offset, pair, num = offset[known], pair[known], len(counts)
    center = medians(offset, pair, num)
    spread = 1.4826 * medians(np.abs(offset - center[pair]), pair, num)
    count, square = np.bincount(pair, minlength=num), np.bincount(pair, offset**2, minlength=num)
    rms = np.sqrt(square / np.maximum(count, 1))
    rows = zip(center.tolist(), spread.tolist(), rms.tolist(), count.tolist(), strict=True)
    return [OffsetEntry(*row) if row[3] else None for row in rows]


def _rows(run: Run, picks: Sequence[slice | IntArray]) -> tuple[IntArray, IntArray, IntArray]:
    """Of all pairs together, those matches that are picked: their observations in both views, and which pair it is."""
    none = np.empty(0, dtype=np.int64)
    a = [ties.a[pick] for ties, pick in zip(run.pairs, picks, strict=True)]
    b = [ties.b[pick] for ties, pick in zip(run.pairs, picks, strict=True)]
    return (
        np.concatenate([none, *a]),
        np.concatenate([none, *b]),
        np.repeat(np.arange(len(a)), [len(rows) for rows in a]),
    )


def medians(values: Array, group: IntArray, num: int) -> Array:
    """The median (num,) of each group of values (n,); NaN without any."""
    ordered = values[np.lexsort((values, group))]
    count = np.bincount(group, minlength=num)
    start, some = np.cumsum(count) - count, count > 0
    out = np.full(num, np.nan)
    low, high = ((start + (count - odd) // 2)[some] for odd in (1, 0))
    out[some] = 0.5 * (ordered[low] + ordered[high])
    return out


def _correction(adjustment: Adjustment, i: int, middle: Array) -> CorrectionEntry:
    """The correction of a view, at the ground point (3,) in the middle of its image."""
    whole, model = adjustment.sensors[i], adjustment.cameras.unknowns.model
    sensor, spline = (whole.sensor, whole.correction) if isinstance(whole, Splined) else (whole, None)
    assert isinstance(sensor, Corrected | ImageCorrected)
    correction, covariance = sensor.correction, adjustment.covariance.view(i)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    common = (model, adjustment.params[i].tolist(), sigma)
    if not isinstance(correction, Correction):
        shift, slope = correction.shift.tolist(), correction.slope.tolist()
        return CorrectionEntry(*common, None, None, shift_px=shift, slope=slope)
    assert isinstance(sensor, Corrected)
    moved, uncertain = shift_in_image(sensor, covariance, model, middle)
    return CorrectionEntry(
        *common,
        moved.tolist(),
        uncertain.tolist(),
        rotation_urad=(correction.rotation * 1e6).tolist(),
        angle_urad=float(np.linalg.norm(correction.rotation)) * 1e6,
        translation_m=correction.translation.tolist(),
        translation_norm_m=float(np.linalg.norm(correction.translation)),
        drift_urad=(correction.drift * 1e6).tolist(),
        **_in_image(spline),
    )


def _in_image(spline: RowSpline | None) -> dict[str, Any]:
    """What follows the correction in the image."""
    if spline is None:
        return {}
    found: dict[str, Any] = {}
    if len(spline.coeffs):
        rows = spline.row_offset + spline.row_scale * np.linspace(-1, 1, _ROWS)
        along = replace(spline, edges=np.zeros(0), steps=np.zeros((0, 2))).at(np.column_stack([rows, rows]))
        found |= {"jitter_px": _size(along), "jitter_rows": spline.spacing}
    if len(spline.steps):
        found |= {"detector_px": _size(spline.steps), "detectors": tuple((spline.edges + 0.5).tolist())}
    return found


def _size(displacement: Array) -> float:
    return float(np.sqrt((displacement**2).sum(axis=-1).mean()))


def shift_in_image(model: Corrected, covariance: Array, unknowns: str, ground: Array) -> tuple[Array, Array]:
    """How far P_BA moves a ground point (3,) near the middle of the image, and the standard deviation of that.

    Parameters
    ----------
    model : Corrected
        P_BA.
    covariance : (q, q)
        Of rotation (metres: angle x distance), translation [m], then any drift, which is zero in the middle row.
    unknowns : str
        "rotation", "translation" or "rotation+translation".
    ground : (3,)
        lon, lat [deg], alt [m].

    Returns
    -------
    shift, sigma : (2,)
        col, row [px].
    """
    ecef = ecef_from_ground(ground)
    image, _, by_rotation, by_translation = model.project_ecef(ecef)
    distance = np.linalg.norm(ecef - model.correction.center)
    parts = {"rotation": by_rotation / distance, "translation": by_translation}
    jacobian = np.hstack([part for name, part in parts.items() if name in unknowns])
    q = jacobian.shape[1]
    variance = np.einsum("ij,jk,ik->i", jacobian, covariance[:q, :q], jacobian)
    return image - model.sensor.project(ground), np.sqrt(np.maximum(variance, 0.0))


def _scene(adjustment: Adjustment) -> SceneEntry:
    gauge, prior, terrain = adjustment.gauge, adjustment.prior, adjustment.terrain
    datum = [
        DatumEntry(
            part,
            float(gauge.motion_sigma[m]),
            **{key: float(row[m]) for key, row in adjustment.datum.items()},
        )
        for m, part in enumerate(MOTIONS)
    ]
    modes = [ModeEntry(m.sigma, m.meaning, m.motion.tolist(), mode_in_words(m)) for m in gauge.modes]
    return SceneEntry(
        shift_enu_m=gauge.shift.tolist(),
        sigma_enu_m=gauge.sigma.tolist(),
        radius_m=gauge.radius,
        weakest_modes=tuple(modes),
        datum=tuple(datum),
        gcp_scatter=None if adjustment.control is None else adjustment.control.scatter,
        dem=None if terrain is None else DemEntry(*_DEM(terrain)),
        noise=adjustment.noise,
        num_held_out=int(np.count_nonzero(adjustment.held_out)),
        model=adjustment.cameras.unknowns.model,
        in_space_px=adjustment.in_space_rms,
        drift_degree=adjustment.cameras.unknowns.drift,
        drift_sigma_m=tuple(prior.drift_sigma),
        prior_ratio=prior.ratio,
        cost_history=tuple(adjustment.cost_history),
        num_held_in_height=int(np.count_nonzero(adjustment.held)),
        gcp_residuals_enu_m=adjustment.gcp_residuals.tolist(),
        solver=adjustment.status,
    )


def metres(value: float) -> str:
    """A length with a unit that keeps it readable.

    Examples
    --------
    >>> metres(3.14159), metres(0.0421), metres(0.00012)
    ('3.1 m', '4.2 cm', '0.1 mm')
    """
    for factor, unit in ((1.0, "m"), (1e2, "cm"), (1e3, "mm")):
        if abs(value) * factor >= 1.0:
            return f"{value * factor:.1f} {unit}"
    return f"{value * 1e3:.1f} mm"


def mode_in_words(mode: Mode) -> str:
    """One weak mode of the scene as a sentence without its full stop."""
    return _MODE_WORDS[mode.meaning].format(metres(mode.sigma))


def _gcps(run: Run) -> tuple[GcpEntry, ...]:
    points = run.gcps
    if points is None:
        return ()
    tested = None if run.adjustment is None else run.adjustment.control
    left = np.full_like(points.sigma, np.nan) if tested is None else tested.residual
    entries = []
    seen = _grouped(points.point, len(points.names))
    places, sigmas = points.lonlatalt.tolist(), points.sigma.tolist()
    for g, (name, (lon, lat, alt), sigma) in enumerate(zip(points.names, places, sigmas, strict=True)):
        images = tuple(run.views[i].name for i in points.view[seen[g]])
        status = "not seen" if not images else "used" if tested is None else tested.status(g)
        entries.append(
            GcpEntry(
                name,
                lon,
                lat,
                alt,
                sigma,
                left[g].tolist(),
                used=status in ("used", "contradicts"),
                status=status,  # type: ignore[arg-type]  # one of these words
                images=images,
                w=None if tested is None else tested.w[g],
                redundancy=None if tested is None else tested.redundancy[g],
                residual_px=_in_images(run, points.lonlatalt[g], points.view[seen[g]], left[g]),
            )
        )
    return tuple(entries)


def _grouped(index: IntArray, num: int) -> list[IntArray]:
    """The places in `index` (n,) of each number below `num`."""
    order = np.argsort(index, kind="stable")
    return np.split(order, np.searchsorted(index[order], np.arange(1, num)))[:num]


def _in_images(run: Run, given: Array, views: IntArray, residual: Array) -> float:
    """How far a residual (3,), east, north, up [m], of a ground point moves it in the images that show it, RMS [px]."""
    if run.after is None or not np.isfinite(residual).all():
        return float("nan")
    moved = ground_from_ecef(ecef_from_ground(given) + residual @ enu_basis(given))
    moves = [run.after[v].project(moved) - run.after[v].project(given) for v in views]
    return float(np.sqrt(np.mean(np.square(moves).sum(axis=1)))) if moves else float("nan")


def _reference(run: Run) -> ReferenceEntry | None:
    found, adjustment = run.reference, run.adjustment
    if found is None:
        return None
    control = None if adjustment is None else found.control
    kept = np.zeros(len(run.views), np.int64)
    points = 0
    if control is not None and adjustment is not None:
        rows = adjustment.reference_inlier
        kept = np.bincount(control.points.view[rows], minlength=len(run.views))
        points = len(np.unique(control.points.point[rows]))
    views = tuple(
        ReferenceViewEntry(
            name=view.name,
            peak=view.peak,
            offset_en_m=view.offset if view.points else None,
            num_tried=view.tried,
            num_passed=view.passed,
            num_points=int(count),
            scatter_m=view.scatter,
        )
        for view, count in zip(found.views, kept, strict=True)
    )
    return ReferenceEntry(points > 0, found.step, found.sigma, points, views)


def _check_points(run: Run) -> tuple[CheckPointEntry, ...]:
    """Points that stayed out of the adjustment: image residuals of each observation, and the ground error."""
    points = run.check_points
    if points is None:
        return ()
    left = check_residuals(run.before if run.after is None else run.after, points)
    seen = [SeenEntry(run.views[i].name, r) for i, r in zip(points.view, left.image.tolist(), strict=True)]
    seen_of = [tuple(seen[row] for row in rows) for rows in _grouped(points.point, len(points.names))]
    rows = zip(points.names, points.lonlatalt.tolist(), left.ground.tolist(), seen_of, strict=True)
    return tuple(
        CheckPointEntry(name, lon, lat, alt, miss, found) for name, (lon, lat, alt), miss, found in rows
    )
